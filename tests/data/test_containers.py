"""Frames in HDF5, zarr and NumPy files: what is read as it was written, and what is refused."""

import json
import pickle
import shutil
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor

import cv2
import h5py
import numpy as np
import pytest
import zarr

from anytouch_jax.data import containers, zarr_nodes
from anytouch_jax.data.containers import ContainerError, open_container, split_row
from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.errors import UserError

RNG = np.random.default_rng(0)
FRAMES = RNG.integers(0, 256, (7, 24, 32, 3), np.uint8)
JPEGS = [cv2.imencode(".jpg", frame)[1] for frame in FRAMES]
PADDED = np.stack([np.pad(one, (0, max(map(len, JPEGS)) - len(one))) for one in JPEGS])
FORMS = {
    "u8": FRAMES,
    "channels first": np.moveaxis(FRAMES, -1, 1),
    "u16": FRAMES.astype(np.uint16) * 257,
    "floats to 1": (FRAMES / 255).astype(np.float32),
    "floats to 255": FRAMES.astype(np.float32),
    "floats, channels first": np.moveaxis(FRAMES / 255, -1, 1),
    "grey": FRAMES[..., 0],
    "one axis of grey": FRAMES[..., :1],
}


@pytest.fixture(autouse=True)
def closed():
    yield
    containers.close_containers()


def write(path, arrays):
    """Write arrays of frames; three frames share a chunk."""
    if path.suffix in (".h5", ".hdf5"):
        with h5py.File(path, "w") as file:
            for key, array in arrays.items():
                chunks = (3, *array.shape[1:])
                file.create_dataset(key, data=array, chunks=chunks, compression="gzip")
        return
    store = str(path)
    if path.suffix == ".zip":
        store = zarr.storage.ZipStore(path, mode="w")
    version = 2 if path.stem.endswith("2") else 3
    group = zarr.open_group(store, mode="w", zarr_format=version)
    for key, array in arrays.items():
        group.create_array(key, data=array, chunks=(3, *array.shape[1:]))
    if path.suffix == ".zip":
        store.close()


@pytest.mark.parametrize("name", ["a.h5", "v2.zarr", "v3.zarr", "a.zarr.zip"])
def test_pixels_are_those_that_were_written(tmp_path, name):
    write(tmp_path / name, FORMS)
    for form in FORMS:
        wanted = FRAMES
        if "grey" in form:
            wanted = np.repeat(FRAMES[..., :1], 3, -1)
        for row in (6, 0, 2, 3):
            np.testing.assert_array_equal(decode(tmp_path / name / form / str(row)), wanted[row])


def test_numpy_files_are_containers_too(tmp_path):
    np.save(tmp_path / "s.npy", FORMS["channels first"])
    np.savez(tmp_path / "s.npz", frames=FRAMES, time=np.arange(7.0))
    for path in ("s.npy/4", "s.npz/frames/4"):
        np.testing.assert_array_equal(decode(tmp_path / path), FRAMES[4])


def test_files_of_images_are_handed_on_as_they_are(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        lengths = file.create_dataset("varying", (7,), h5py.vlen_dtype(np.uint8))
        for row, one in enumerate(JPEGS):
            lengths[row] = one
        file["padded"] = PADDED
        file["opaque"] = np.void(PADDED[0].tobytes())
        file["one"] = JPEGS[0]
    for key, row in (("varying", 3), ("padded", 3), ("opaque", 0), ("one", 0)):
        assert containers.read_row(path, key, row) == JPEGS[row].tobytes()
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    array = group.create_array(
        "frames", shape=(7,), dtype=zarr.dtype.VariableLengthBytes(), chunks=(4,)
    )
    array[:] = np.array([one.tobytes() for one in JPEGS], object)
    assert containers.read_row(tmp_path / "a.zarr", "frames", 5) == JPEGS[5].tobytes()


def test_a_chunk_is_unpacked_once_for_all_its_frames(tmp_path, monkeypatch):
    write(tmp_path / "a.h5", {"frames": FRAMES})
    read = []
    inner = h5py.Dataset.__getitem__

    def counted(self, index, *rest):
        read.append(index)
        return inner(self, index, *rest)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", counted)
    for row in range(7):
        containers.read_row(tmp_path / "a.h5", "frames", row)
    assert read == [slice(0, 3), slice(3, 6), slice(6, 9)]


def test_many_threads_read_the_same_pixels(tmp_path):
    write(tmp_path / "a.h5", {"frames": FRAMES, "more": FRAMES[::-1]})
    paths = [tmp_path / "a.h5" / key / str(n % 7) for n in range(70) for key in ("frames", "more")]
    with ThreadPoolExecutor(8) as pool:
        for path, frame in zip(paths, pool.map(decode, paths), strict=True):
            row = int(path.name)
            wanted = FRAMES[row if path.parent.name == "frames" else 6 - row]
            np.testing.assert_array_equal(frame, wanted)


def test_vectors_and_matrices_are_no_frames(tmp_path):
    arrays = {
        "actions": np.zeros((7, 7), np.float32),
        "markers": np.zeros((7, 9, 7, 2), np.float32),
        "points": np.zeros((70, 500, 3), np.float32),
        "pose": np.zeros((7, 4, 4)),
        "names": np.zeros((7, 20), np.uint8),
        "flags": np.zeros(7, bool),
    }
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for key, array in arrays.items():
            file[key] = array
    with open_container(tmp_path / "a.h5") as opened:
        forms = {one.key: one.form for one in opened.fields()}
    assert forms.pop("points").single, "it could be an image, so it is one of floats"
    assert set(forms.values()) == {None}


def test_a_path_says_where_the_container_ends(tmp_path):
    for text, wanted in (
        ("a/b.h5/data/demo_0/x/17", ("a/b.h5", "data/demo_0/x", 17)),
        ("a.HDF5/x/1", ("a.HDF5", "x", 1)),
        ("x.zarr.zip/c/4", ("x.zarr.zip", "c", 4)),
        ("x.zarr/3", ("x.zarr", "", 3)),
        ("s.npy/3", ("s.npy", "", 3)),
    ):
        path, key, row = split_row(tmp_path / text)
        assert (str(path.relative_to(tmp_path)), key, row) == wanted
    for text in ("a.h5", "a.h5/x/y", "a.zip/3", "folder/3", "a.h5x/3", "a.h5/x/²"):
        assert split_row(tmp_path / text) is None


class Evil:
    """Its pickle calls print when it is read."""

    def __reduce__(self):
        return print, ("code of the file runs",)


def test_a_zarr_that_unpickles_is_not_opened(tmp_path, capsys):
    write(tmp_path / "v2.zarr", {"frames": FRAMES})
    for key in ("objects", "fill"):
        folder = tmp_path / "v2.zarr" / key
        folder.mkdir()
        about = {"zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "order": "C"}
        about |= {"compressor": None, "filters": [{"id": "pickle"}], "fill_value": None}
        (folder / ".zarray").write_text(json.dumps(about))
        (folder / "0").write_bytes(pickle.dumps(np.array([Evil()], object)))
    with open_container(tmp_path / "v2.zarr") as opened:
        assert list(opened.arrays) == ["frames"]
        assert "pickle" in opened.refused["objects"]
    with pytest.raises(ContainerError, match="codec 'pickle' is not read"):
        containers.read_row(tmp_path / "v2.zarr", "objects", 0)
    assert "runs" not in capsys.readouterr().out


@pytest.mark.parametrize("place", ["codecs", "inside a shard"])
def test_a_codec_of_version_3_is_refused_wherever_it_is(tmp_path, place):
    write(tmp_path / "v3.zarr", {"frames": FRAMES})
    file = tmp_path / "v3.zarr" / "frames" / "zarr.json"
    about = json.loads(file.read_text())
    bad = [{"name": "numcodecs.pickle", "configuration": {}}]
    if place == "inside a shard":
        inner = {"chunk_shape": [1, 24, 32, 3], "codecs": bad, "index_codecs": []}
        bad = [{"name": "sharding_indexed", "configuration": inner}]
    about["codecs"] = bad
    file.write_text(json.dumps(about))
    with open_container(tmp_path / "v3.zarr") as opened:
        assert not opened.arrays and "pickle" in opened.refused["frames"]


def test_hdf5_does_not_lead_into_other_files(tmp_path):
    (tmp_path / "secret.bin").write_bytes(FRAMES.tobytes())
    write(tmp_path / "other.h5", {"frames": FRAMES})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        outside = [(tmp_path / "secret.bin", 0, FRAMES.nbytes)]
        file.create_dataset("raw", FRAMES.shape, np.uint8, external=outside)
        layout = h5py.VirtualLayout(FRAMES.shape, np.uint8)
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "frames", FRAMES.shape)
        file.create_virtual_dataset("virtual", layout)
        file["link"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "frames")
        file["loop"] = file["/"]
        file["own"] = FRAMES
    with open_container(tmp_path / "a.h5") as opened:
        assert list(opened.arrays) == ["own"]
        assert set(opened.refused) == {"raw", "virtual"}
    for key in ("raw", "virtual", "link"):
        with pytest.raises(ContainerError):
            containers.read_row(tmp_path / "a.h5", key, 0)


def test_declared_sizes_fill_no_memory(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("bomb", (4, 40_000, 40_000, 3), np.uint8, chunks=(1, 40_000, 40_000, 3))
        file.create_dataset("wide", (4, 40_000, 40_000, 3), np.uint8, chunks=(1, 100, 100, 3))
    with open_container(tmp_path / "a.h5") as opened:
        assert "bomb" in opened.refused
    with pytest.raises(ImageError, match="wide"):
        decode(tmp_path / "a.h5" / "wide" / "0")
    write(tmp_path / "v2.zarr", {"frames": FRAMES})
    file = tmp_path / "v2.zarr" / "frames" / ".zarray"
    about = json.loads(file.read_text())
    file.write_text(json.dumps(about | {"chunks": [7, 24_000, 32_000, 3]}))
    with open_container(tmp_path / "v2.zarr") as opened:
        assert "bytes" in opened.refused["frames"]


def test_a_name_that_is_no_path_is_not_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["good"] = FRAMES
        for name in ("..", "a\\b", b"bad\xff"):
            file.create_group(name)["frames"] = FRAMES
    with open_container(tmp_path / "a.h5") as opened:
        assert list(opened.arrays) == ["good"] and len(opened.refused) == 3


@pytest.mark.parametrize("name", ["a.h5", "a.zarr.zip", "a.npz", "a.npy", "b.zarr"])
def test_damaged_files_are_one_sentence(tmp_path, name):
    path = tmp_path / name
    with pytest.raises(ContainerError, match="there is no"):
        open_container(path)
    contents = (b"", b"no such file", b"\x89HDF\r\n\x1a\n" + bytes(100), b"PK\x03\x04" + bytes(50))
    if name == "b.zarr":
        path.mkdir()
        (path / "zarr.json").write_text("{")
        contents = ()
    for content in (*contents, None):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError) as error:
            open_container(path)
        assert name in str(error.value) and "\n" not in str(error.value)
    if name != "b.zarr":
        path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
        with pytest.raises(UserError, match="git lfs pull"):
            open_container(path)


def test_damaged_chunks_and_frames_that_are_not_there_are_one_sentence(tmp_path):
    for name in ("a.h5", "v2.zarr", "a.zarr.zip"):
        write(tmp_path / name, {"frames": FRAMES})
    data = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "a.h5").write_bytes(data[:-4000] + bytes(4000))
    chunk = tmp_path / "v2.zarr" / "frames" / "1.0.0.0"
    chunk.write_bytes(b"not compressed")
    for path in ("a.h5/frames/6", "v2.zarr/frames/4", "a.zarr.zip/frames/7", "a.zarr.zip/gone/0"):
        with pytest.raises(ImageError) as error:
            decode(tmp_path / path)
        assert "\n" not in str(error.value)


def test_a_large_member_of_a_zip_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(zarr_nodes, "_MOST_MEMBER", 1 << 20)
    write(tmp_path / "a.zarr.zip", {"frames": FRAMES})
    with open_container(tmp_path / "a.zarr.zip") as opened:
        assert list(opened.arrays) == ["frames"]
    with (
        zipfile.ZipFile(tmp_path / "a.zarr.zip", "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("frames/c/9/0/0/0", "w", force_zip64=True) as member,
    ):
        member.write(bytes((1 << 20) + 1))
    with pytest.raises(UserError, match="has more than"):
        open_container(tmp_path / "a.zarr.zip")


@pytest.mark.parametrize(("name", "package"), [("a.h5", "h5py"), ("v3.zarr", "zarr")])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, name, package):
    write(tmp_path / name, {"frames": FRAMES})
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=rf'{package}.*pip install "anytouch_jax\[hdf5\]"'):
        open_container(tmp_path / name)


def test_a_folder_that_moved_says_so(tmp_path):
    write(tmp_path / "v3.zarr", {"frames": FRAMES})
    assert decode(tmp_path / "v3.zarr" / "frames" / "0").shape == (24, 32, 3)
    shutil.rmtree(tmp_path / "v3.zarr")
    containers.close_containers()
    with pytest.raises(ImageError, match="there is no"):
        decode(tmp_path / "v3.zarr" / "frames" / "0")
