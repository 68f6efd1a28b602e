"""A pickle of a data set holds values. It can name no function, also none inside of numpy."""

import io
import pickle
import struct
from collections import OrderedDict

import numpy as np
import pytest

from anytouch_jax.datasets.readers.common import DatasetError, read_pickle

# Each calls a function, or reaches an attribute that can. The names lie within packages whose other
# names a pickle of arrays needs.
NAMES = [
    ("numpy.testing._private.utils", "runstring"),
    ("numpy.testing", "rundocs"),
    ("numpy", "load"),
    ("numpy", "fromfile"),
    ("numpy", "memmap"),
    ("numpy", "ndarray.tofile"),
    ("numpy", "f2py.os.system"),
    ("numpy.lib.npyio", "load"),
    ("numpy._core.multiarray", "fromfile"),
    ("numpy.core.multiarray", "fromfile"),
    ("numpy._core.numeric", "fromfunction"),
    ("_codecs", "lookup"),
    ("_codecs", "register"),
    ("collections", "namedtuple"),
    ("collections", "OrderedDict.fromkeys"),
    ("os", "system"),
    ("builtins", "eval"),
    ("builtins", "getattr"),
]


def text(word):
    data = word.encode()
    return pickle.SHORT_BINUNICODE + struct.pack("<B", len(data)) + data


def naming(module, name):
    """A pickle that holds the object `module`.`name`, and calls nothing."""
    return pickle.PROTO + b"\x04" + text(module) + text(name) + pickle.STACK_GLOBAL + pickle.STOP


@pytest.mark.parametrize(("module", "name"), NAMES, ids=[".".join(words) for words in NAMES])
def test_a_pickle_that_names_a_function_is_refused(tmp_path, module, name):
    (tmp_path / "a.pkl").write_bytes(naming(module, name))
    with pytest.raises(DatasetError, match=f"it asks for {module}.{name}"):
        read_pickle(tmp_path / "a.pkl")


class Runs:
    """An object whose pickle runs a program when it is read: numpy's own helper calls `exec`."""

    def __init__(self, program):
        self.program = program

    def __reduce__(self):
        from numpy.testing._private.utils import runstring

        return runstring, (self.program, {})


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize("form", ["a.pkl", "a.npy"])
def test_no_code_of_a_pickle_is_run(tmp_path, form, protocol):
    mark = tmp_path / "it_ran"
    program = f"import pathlib; pathlib.Path({str(mark)!r}).touch()"
    data = pickle.dumps([np.arange(3), Runs(program)], protocol)
    pickle.loads(data)
    assert mark.exists(), "the pickle is one that runs code"
    mark.unlink()
    (tmp_path / form).write_bytes(b"a line of the header\n" * (form == "a.npy") + data)
    with pytest.raises(DatasetError, match="it asks for numpy"):
        read_pickle(tmp_path / form)
    assert not mark.exists()


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_plain_values_and_arrays_are_read(tmp_path, protocol):
    values = {"force": np.arange(6.0).reshape(2, 3), "depth": np.float32(0.5), "name": "cup"}
    values |= {"bytes": b"\x00\xff", "table": OrderedDict(row=[1, None, True])}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(values, protocol))
    found = read_pickle(tmp_path / "a.pkl")
    np.testing.assert_array_equal(found.pop("force"), values.pop("force"))
    assert found == values


def test_an_array_of_objects_behind_a_header_is_read(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"force": 1.5}, None], object))
    assert read_pickle(tmp_path / "a.npy").tolist() == [{"force": 1.5}, None]
    np.save(file := io.BytesIO(), np.array([Runs("1")], object))
    (tmp_path / "b.npy").write_bytes(file.getvalue())
    with pytest.raises(DatasetError, match="runstring"):
        read_pickle(tmp_path / "b.npy")
