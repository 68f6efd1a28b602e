import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from torch_files import Call, Global, Tensor, tensor

from anytouch_jax.errors import UserError
from anytouch_jax.weights.load import read_weights
from anytouch_jax.zoo.torch_file import read_torch

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("legacy", [False, True])
def test_reads_every_plain_type(write_torch, legacy):
    arrays = {
        "f8": RNG.normal(size=(2, 3)),
        "f4": RNG.normal(size=(4,)).astype("f4"),
        "f2": RNG.normal(size=(2, 2)).astype("f2"),
        "i8": np.arange(-3, 3),
        "i4": np.arange(3, dtype="i4"),
        "u1": np.arange(3, dtype="u1"),
        "bool": np.array([True, False]),
        "scalar": np.float32(2.5),
        "empty": np.zeros((0, 4), "f4"),
    }
    content = {name: tensor(array) for name, array in arrays.items()}
    read = read_torch(write_torch(content, legacy=legacy))
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        assert read[name].dtype == array.dtype and read[name].shape == array.shape
        np.testing.assert_array_equal(read[name], array)


def test_views_fraction_and_stride(write_torch):
    data = np.arange(12, dtype="f4")
    grid = data.reshape(3, 4)
    views = {
        "whole": ((3, 4), (4, 1), 0, grid),
        "transposed": ((4, 3), (1, 4), 0, grid.T),
        "column": ((3,), (4,), 2, grid[:, 2]),
        "expanded": ((2, 3), (0, 1), 9, [[9, 10, 11]] * 2),
    }
    read = read_torch(write_torch({name: Tensor(data, *one[:3]) for name, one in views.items()}))
    for name, (*_, wanted) in views.items():
        np.testing.assert_array_equal(read[name], wanted)
        assert read[name].flags.c_contiguous


def test_bfloat16_and_byte_order(write_torch):
    values = np.array([1.0, -2.5, 3.140625, 0.0], "f4")  # exact in bfloat16
    half = (values.view(np.uint32) >> 16).astype("u2")
    path = write_torch({"b": Tensor(half, (4,), (1,), kind="BFloat16")})
    np.testing.assert_array_equal(read_torch(path)["b"], values)
    path = write_torch({"x": tensor(values)}, order="big")
    np.testing.assert_array_equal(read_torch(path)["x"], values)


@pytest.mark.parametrize("wrapper", ["model", "state_dict", None])
def test_opens_the_usual_wrappings(write_torch, wrapper):
    state = {"module.a": tensor(np.ones(2, "f4")), "module.b": tensor(np.zeros(1, "f4"))}
    ordered = Call(Global("collections", "OrderedDict"), (), {"_metadata": {"version": 1}})
    namespace = Call(Global("argparse", "Namespace"), (), {"lr": 2e-4, "device": "cuda"})
    content = (
        {wrapper: state, "optimizer": {"state": {0: ordered}}, "args": namespace, "epoch": 3}
        if wrapper
        else state
    )
    assert list(read_weights(write_torch(content))) == ["a", "b"]


WICKED = {
    "os.system": "touch {0}",
    "posix.system": "touch {0}",
    "builtins.eval": "open('{0}', 'w')",
    "builtins.open": "{0}",
    "__builtin__.getattr": "{0}",
    "pathlib.Path": "{0}",
    "numpy.load": "{0}",
    "torch._utils.os": "{0}",
    "torch.load": "{0}",
    "torch.storage._load_from_bytes": "{0}",
}


@pytest.mark.parametrize("which", WICKED)
@pytest.mark.parametrize("legacy", [False, True])
def test_code_in_a_pickle_is_refused_by_name(write_torch, tmp_path, which, legacy):
    marker = tmp_path / "marker"
    call = Call(Global(*which.rsplit(".", 1)), (WICKED[which].format(marker),))
    content = {"model": {"w": tensor(np.ones(1, "f4"))}, "extra": call}
    with pytest.raises(UserError, match=f"'{which}'.*refused"):
        read_torch(write_torch(content, legacy=legacy))
    assert not marker.exists()


class _Benign:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("protocol", range(6))
def test_a_reduce_of_every_protocol_never_runs(tmp_path, protocol):
    marker = tmp_path / "marker"
    path = tmp_path / "weights.pth"
    wicked = pickle.dumps({"model": _Benign(marker)}, protocol)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", wicked)
    with pytest.raises(UserError, match=r"mkdir"):
        read_torch(path)
    assert not marker.exists()
    pickle.loads(wicked)
    assert marker.exists()  # the same bytes do run in an ordinary reader


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (b"(S'touch x'\nios\nsystem\n.", "os system"),  # INST
        (b"\x80\x02\x82\x01.", "EXT1"),  # the extension registry
        (b"\x80\x02ccollections\nOrderedDict\n(dcos\nsystem\nb.", "os.system"),
        (b"\x80\x02}(ccollections\nOrderedDict\nK\x01u.", "dictionary"),  # a class as a key
        (b"\x80\x02R.", "not there"),
        (b"\x80\x04\x8d" + b"\xff" * 7 + b"\x3f.", "."),  # a text of 2**62 bytes
        (
            b"\x80\x02}()" + b"\x85" * 150_000 + b"K\x01u.",
            "tuple as the key",
        ),  # its hash would end the process
    ],
)
def test_crafted_pickles_are_errors_not_crashes(tmp_path, body, named):
    path = tmp_path / "weights.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", body)
    with pytest.raises(UserError, match=named):
        read_torch(path)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": (5,)},
        {"offset": 1},
        {"stride": (2,)},
        {"stride": (-1,)},
        {"shape": (-1,)},
        {"offset": -1},
        {"stride": (1, 1)},
        {"shape": (1 << 40,), "stride": (0,)},
        {"length": 1 << 40},
        {"length": 3},
        {"kind": "QUInt8"},
        {"kind": "Double"},
    ],
)
def test_views_beyond_their_storage_are_errors(write_torch, change):
    view = {
        "data": np.arange(4, dtype="f4"),
        "shape": (4,),
        "stride": (1,),
        "kind": "Float",
    } | change
    with pytest.raises(UserError, match=r"weights\.pth"):
        read_torch(write_torch({"x": Tensor(**view)}))


def test_foreign_files_are_one_sentence(write_torch, tmp_path):
    members = {
        "bomb.pth": {"archive/data.pkl": b"\x80\x02" + b"N0" * 1_000_000},
        "other.bin": {"hello.txt": b"hello"},
        "script.pt": {"a/data.pkl": b"\x80\x02N.", "a/constants.pkl": b""},
    }
    for name, content in members.items():
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, data in content.items():
                archive.writestr(member, data)
    for name in ("text.pth", "words.safetensors", "words.npz", "weights.h5"):
        (tmp_path / name).write_text("just words")
    np.savez(tmp_path / "objects.npz", a=np.array([{"x": 1}], dtype=object))
    write_torch([1, 2], "list.pth")
    write_torch({"epoch": 3}, "dict.pth")
    for name, words in {
        "bomb.pth": "claims",
        "script.pt": "TorchScript",
        "other.bin": "data.pkl",
        "list.pth": "state_dict, but list",
        "text.pth": "damaged or not a torch file",
        "dict.pth": "epoch is no tensor",
        "absent.pth": "no weights file",
        "absent.safetensors": "no weights file",
        "words.safetensors": "not a whole safetensors file",
        "words.npz": "not a whole npz file",
        "objects.npz": "objects",
        "weights.h5": "unknown type",
    }.items():
        with pytest.raises(UserError, match=words) as caught:
            read_weights(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)


def test_many_tensors_over_one_storage_are_refused_before_memory_is_taken(write_torch):
    data = np.zeros(1, "f4")
    views = {f"x{i}": Tensor(data, shape=(1024, 1024), stride=(0, 0)) for i in range(100)}
    with pytest.raises(UserError, match="many times larger than the file"):
        read_torch(write_torch(views))
