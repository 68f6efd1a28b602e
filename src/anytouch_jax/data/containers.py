"""Files that hold arrays of frames: HDF5, zarr, .npz and .npy.

A frame of such a file has a path of its own in a manifest, and stays where it is:

* `press.h5/data/demo_0/obs/tactile/17` is frame 17 of the dataset `data/demo_0/obs/tactile`.
* `replay.zarr/data/camera0_rgb/17`, the same of a folder `.zarr` or a file `.zarr.zip`.
* `press.npz/frames/17` and `press.npy/17` are frames of a NumPy file.

Frames are pixels (u8, u16 or floats; channels last, first or none), or files of images (JPEG,
PNG) in bytes, which are handed on as they are.

Such files come from strangers, so what a format can do beyond holding arrays is refused: HDF5 may
point to other files (external and virtual datasets, links), and zarr may name a codec that
unpickles, which runs code.
"""

from __future__ import annotations

import io
import math
import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.image_headers import JPEG, PNG
from anytouch_jax.data.names import natural
from anytouch_jax.data.pixels import check_shape
from anytouch_jax.doors import lacking
from anytouch_jax.errors import UserError
from anytouch_jax.files import placeholder, read_arrays

Array = npt.NDArray[Any]

HDF5 = (".h5", ".hdf5", ".hdf", ".he5")
ZARR = (".zarr", ".zarr.zip")
NUMPY = (".npy", ".npz")
_ROW = re.compile(
    r"(.+?\.(?:h5|hdf5|hdf|he5|zarr|zarr\.zip|npy|npz))/(?:(.+)/)?(\d+)", re.IGNORECASE
)
_CHANNELS = (1, 3, 4)
_SMALLEST = 8  # pixels of a side: a smaller array is a vector or a matrix, not an image
# Bytes of a chunk, and of all chunks in memory. A chunk is unpacked as a whole, so a small file
# could fill the memory.
_MOST = 1 << 29
_MOST_ARRAYS = 200_000  # of a file
_LOOKED_AT = 5  # frames of floats that tell whether they count to 1 or to 255
_IMAGE_STARTS = (JPEG, PNG)
# Codecs of zarr that only compress, or order bytes. Others are refused: `pickle` runs code.
_CODECS = {
    "blosc", "zlib", "gzip", "zstd", "lz4", "lzma", "bz2", "bytes", "transpose", "crc32", "crc32c",
    "adler32", "fletcher32", "shuffle", "bitshuffle", "delta", "astype", "fixedscaleoffset",
    "packbits", "vlen-utf8", "vlen-bytes", "sharding_indexed", "endian",
}  # fmt: skip


class ContainerError(UserError):
    """A file of arrays that cannot be read; the message names it."""


class FrameForm(NamedTuple):
    """How an array holds frames."""

    frames: int
    layout: str  # HWC, CHW, HW, or "files" for images in bytes
    height: int = 0  # 0 where only the images tell
    width: int = 0
    single: bool = False  # the array is one frame, without an axis of frames

    def words(self, dtype: str) -> str:
        """Return the form in words, as "84 x 84 uint8 HWC"."""
        if self.layout == "files":
            return "JPEG or PNG files"
        return f"{self.width} x {self.height} {dtype} {self.layout}"


class ArrayInfo(NamedTuple):
    """An array of a container. `form` is None for one that holds no frames."""

    key: str
    shape: tuple[int, ...]
    dtype: str
    form: FrameForm | None


class Stored(Protocol):
    """An array as h5py, zarr and NumPy give it: parts of it are read by indices."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Its sides."""

    @property
    def dtype(self) -> Any:
        """Its type."""

    def __getitem__(self, index: Any, /) -> Any:
        """Return a part of it."""


class Container:
    """An open file of arrays: what is in it, in natural order of names.

    Attributes:
        path: The file, or the folder of a zarr.
        arrays: The arrays by key, a path with slashes inside the file.
        refused: Arrays that are not read, with the reason.
        is_mixed: Whether it may hold anything beside frames, so that an array must look like them.
    """

    def __init__(
        self,
        path: Path,
        arrays: dict[str, Stored],
        refused: dict[str, str],
        attributes: Callable[[str], Mapping[str, Any]],
        close: Callable[[], None],
    ) -> None:
        self.path = path
        self.is_mixed = kind_of(path) in ("hdf5", "zarr")
        self.arrays = arrays
        self.refused = refused
        self._attributes = attributes
        self._close = close

    def __enter__(self) -> Container:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def attributes(self, key: str) -> dict[str, Any]:
        """Return the attributes of a group or an array that can be read; "" is the root."""
        found: dict[str, Any] = {}
        # h5py has many kinds of errors for a damaged attribute
        with suppress(Exception):
            stored = self._attributes(key)
            for name in stored:
                with suppress(Exception):
                    found[str(name)] = stored[name]
        return found

    def fields(self) -> list[ArrayInfo]:
        """Return the arrays and how they hold frames."""
        return [
            ArrayInfo(key, tuple(one.shape), _type_name(one), _form_of(one, self.is_mixed))
            for key, one in self.arrays.items()
        ]

    def read(self, key: str) -> Array:
        """Return an array as a whole. Raises ContainerError, also for one that is too large."""
        stored = self.arrays[key]
        if math.prod(stored.shape) * max(stored.dtype.itemsize, 1) > _MOST:
            raise ContainerError(f"{self.path}/{key} has more than {_MOST} bytes")
        with _explained(f"{self.path}/{key}"):
            return np.asarray(stored[()])


@contextmanager
def _explained(name: object) -> Iterator[None]:
    """Turn all errors of the packages that read arrays into a ContainerError with a name.

    They raise OSError, KeyError, RuntimeError, and errors of their own for damaged bytes.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ContainerError(f"{name} cannot be read: {said}") from None


def kind_of(path: Path) -> str | None:
    """Return "hdf5", "zarr", "npz" or "npy" by the name of a file, None for another."""
    name = path.name.lower()
    if name.endswith(HDF5):
        return "hdf5"
    if name.endswith(ZARR):
        return "zarr"
    if name.endswith(NUMPY):
        return name[-3:]
    return None


def split_row(path: Path) -> tuple[Path, str, int] | None:
    """Return (container, key, row) of the path of a frame in a container, None for another."""
    if not (path.name.isascii() and path.name.isdecimal()):
        return None
    match = _ROW.fullmatch(str(path))
    return match and (Path(match[1]), match[2] or "", int(match[3]))


def open_container(path: Path) -> Container:
    """Open a file of arrays. Close it with `with`.

    Raises ContainerError for one that is missing or damaged, and UserError without its package.
    """
    if not path.exists():
        raise ContainerError(f"there is no {path}; copy it from where the data are")
    if path.is_file() and (kind := placeholder(path)):
        raise ContainerError(f"{path} is {kind}")
    kind = kind_of(path)
    with _explained(path):
        if kind == "hdf5":
            return _open_hdf5(path)
        if kind == "zarr":
            return _open_zarr(path)
        if kind == "npz":
            arrays: dict[str, Stored] = {**read_arrays(path)}
            return _of_numpy(path, arrays)
        if kind == "npy":
            return _of_numpy(path, {"": np.lib.format.open_memmap(path, mode="r")})
    raise ContainerError(
        f"{path} is no file of arrays; its name ends in {', '.join((*HDF5, *ZARR, *NUMPY))}"
    )


def stack_rows(path: Path) -> dict[str, list[Path]] | None:
    """Return the paths of the frames in a .npy or .npz file by array, None for one image in .npy.

    A file without frames has none. Raises ContainerError for a damaged file.
    """
    with open_container(path) as container:
        forms = {one.key: one.form for one in container.fields() if one.form is not None}
        names = list(container.arrays)
    if kind_of(path) == "npy" and any(form.single for form in forms.values()):
        return None
    return {
        key: [path / key / str(row) for row in range(form.frames)]
        for key, form in _stacks_among(forms, names).items()
    }


def _stacks_among(forms: dict[str, FrameForm], names: Collection[str]) -> dict[str, FrameForm]:
    """Return which arrays of a NumPy file are the frames, among those that could be some.

    Maps of depth, without channels, lie beside frames with channels, and rows of features or
    forces have the form of one grey image.
    """
    if {"features", "rows"} <= set(names):
        return {}
    with_channels = {key: form for key, form in forms.items() if form.layout != "HW"}
    stacks = {key: form for key, form in forms.items() if not form.single}
    coloured = {key: form for key, form in stacks.items() if key in with_channels}
    # An .npz of one image is a stack of one.
    return coloured or stacks or (with_channels if len(with_channels) == 1 else {})


def _of_numpy(path: Path, arrays: dict[str, Stored]) -> Container:
    return Container(path, arrays, {}, lambda _: {}, lambda: None)


def _open_hdf5(path: Path) -> Container:
    try:
        import h5py  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        raise lacking(f"{path.name} is HDF5, which", "h5py", "hdf5") from None
    file = h5py.File(path, "r")
    arrays: dict[str, Stored] = {}
    refused: dict[str, str] = {}

    def visit(name: str | bytes, node: Any) -> None:
        # `visititems` follows no soft and no external link, and enters each group once.
        if not isinstance(node, h5py.Dataset):
            return
        if len(arrays) >= _MOST_ARRAYS:
            raise ContainerError(f"{path} has more than {_MOST_ARRAYS:,} datasets; split it")
        # A name that is not UTF-8 comes as bytes.
        key = name if isinstance(name, str) else name.decode("utf-8", "surrogateescape")
        reason = _unfit_key(key)
        if node.is_virtual or node.external:
            reason = "its values are in another file"
        elif node.chunks and math.prod(node.chunks) * node.dtype.itemsize > _MOST:
            reason = f"its chunks have more than {_MOST} bytes"
        if reason:
            refused[key.encode(errors="backslashreplace").decode()] = reason
        else:
            arrays[key] = node

    try:
        file.visititems(visit)
    except BaseException:
        file.close()
        raise
    return Container(
        path,
        _in_order(arrays),
        refused,
        lambda key: file[key].attrs if key else file.attrs,
        file.close,
    )


def _open_zarr(path: Path) -> Container:
    try:
        import zarr  # type: ignore[import-not-found, unused-ignore]
        from zarr.storage import (  # type: ignore[import-not-found, unused-ignore]
            LocalStore,
            ZipStore,
        )
    except ImportError:
        raise lacking(f"{path.name} is zarr, which", "zarr", "hdf5") from None
    from anytouch_jax.data.zarr_nodes import read_nodes

    nodes = read_nodes(path)
    store = LocalStore(path, read_only=True) if path.is_dir() else ZipStore(path, mode="r")
    arrays: dict[str, Stored] = {}
    refused: dict[str, str] = {}
    try:
        for key, node in nodes.items():
            if not node.is_array:
                continue
            reason = _unfit_key(key)
            unknown = sorted(node.codecs - _CODECS)
            if unknown:
                reason = f"its codec {unknown[0]!r} is not read"
            elif node.chunk_bytes > _MOST:
                reason = f"its chunks have more than {_MOST} bytes"
            if reason:
                refused[key] = reason
                continue
            # Only now, because opening an array reads its fill value through its codecs.
            with _explained(f"{path}/{key}"):
                arrays[key] = zarr.open_array(store, path=key, mode="r", zarr_format=node.version)
    except BaseException:
        store.close()
        raise
    attributes = {key: node.attributes for key, node in nodes.items()}
    return Container(
        path, _in_order(arrays), refused, lambda key: attributes.get(key, {}), store.close
    )


def _unfit_key(key: str) -> str:
    """Return why a key cannot be a part of a path, "" for one that can."""
    if key.encode(errors="ignore").decode() != key or "\\" in key or "\0" in key:
        return "its name is not usable as a path"
    if any(part in ("", ".", "..") for part in key.split("/")) and key:
        return "its name is not usable as a path"
    return ""


def _in_order(arrays: dict[str, Stored]) -> dict[str, Stored]:
    """Return arrays by key, where demo_2 comes before demo_10."""
    return dict(sorted(arrays.items(), key=lambda item: list(map(natural, item[0].split("/")))))


def _type_name(stored: Stored) -> str:
    return "bytes" if stored.dtype.kind in "OSVT" else str(stored.dtype)


def _form_of(stored: Stored, is_mixed: bool) -> FrameForm | None:
    """Return how an array holds frames, None if it holds none.

    Where other arrays lie beside it (`is_mixed`), sides below 8 pixels are those of a vector or a
    matrix, and floats count as pixels only with an axis of channels. In a NumPy file, which holds
    frames and little else, three axes are grey frames unless the last has channels.
    """
    shape = tuple(stored.shape)
    if 0 in shape:
        return None
    is_bytes = stored.dtype == np.uint8
    if is_mixed and (stored.dtype.kind in "OSVT" or (is_bytes and len(shape) < 3)):
        form = _form_of_files(stored, shape, is_vector=is_bytes)
        if form is not None or not is_bytes:
            return form
    if not (stored.dtype.kind == "f" or (stored.dtype.kind == "u" and stored.dtype.itemsize <= 2)):
        return None
    least = _SMALLEST if is_mixed else 1
    if len(shape) == 4:
        return _frames_form(shape[1:], shape[0], least)
    if len(shape) == 3:
        one = _frames_form(shape, 1, least)
        if one is not None and (is_mixed or one.layout == "HWC"):
            return one._replace(single=True)
        if min(shape[1:]) >= least and (stored.dtype.kind == "u" or not is_mixed):
            return FrameForm(shape[0], "HW", shape[1], shape[2])
    if len(shape) == 2 and min(shape) >= least and (is_bytes or not is_mixed):
        return FrameForm(1, "HW", shape[0], shape[1], single=True)
    return None


def _frames_form(sides: tuple[int, ...], frames: int, least: int) -> FrameForm | None:
    """Return the form of images with three sides of `least` pixels, channels last or first."""
    if sides[2] in _CHANNELS and min(sides[:2]) >= least:
        return FrameForm(frames, "HWC", sides[0], sides[1])
    if sides[0] in _CHANNELS and min(sides[1:]) >= least:
        return FrameForm(frames, "CHW", sides[1], sides[2])
    return None


def _form_of_files(stored: Stored, shape: tuple[int, ...], *, is_vector: bool) -> FrameForm | None:
    """Return the form of JPEG and PNG files: values of a varying length, or padded rows of u8."""
    axes = len(shape) - is_vector
    if axes not in (0, 1):
        return None
    try:
        first = file_bytes(stored[0] if axes else stored[()])
    except Exception:  # a damaged value; it is reported where it is used
        return None
    if not first.startswith(_IMAGE_STARTS):
        return None
    return FrameForm(shape[0] if axes else 1, "files", single=not axes)


def file_bytes(value: Any) -> bytes:
    """Return a stored value as the bytes of a file, without the zeros that pad it."""
    if isinstance(value, str):
        return b""
    if isinstance(value, bytes):
        return value
    array = np.asarray(value)
    if array.dtype.kind in "uSV":
        return array.tobytes().rstrip(b"\0")
    if array.dtype.kind == "O" and array.ndim == 0:
        return file_bytes(array.item())
    return b""


class _Blocks:
    """The blocks of rows that were read last, up to _MOST bytes.

    A compressed chunk holds many frames, and would be unpacked again for each of them.
    """

    def __init__(self) -> None:
        self._held: OrderedDict[tuple[object, int], Array] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[object, int], load: Callable[[], Array]) -> Array:
        """Return a block, loaded if it is not held."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key]
        block = load()
        with self._lock:
            self._held[key] = block
            while sum(map(_bytes_of, self._held.values())) > _MOST and len(self._held) > 1:
                self._held.popitem(last=False)
        return block

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._held.clear()


def _bytes_of(block: Array) -> int:
    """Return the bytes of a block, with those of the files in it."""
    if block.dtype.kind == "O":
        return sum(len(one) for one in block.ravel())
    return block.nbytes


_BLOCKS = _Blocks()


class Frames:
    """The frames of one array. Reading is safe from many threads.

    Raises ContainerError for an array that holds none.
    """

    def __init__(self, container: Container, key: str) -> None:
        self._name = f"{container.path}/{key}".rstrip("/")
        if key not in container.arrays:
            reason = container.refused.get(key, "index the data again")
            raise ContainerError(f"{container.path} has no array {key} that can be read; {reason}")
        self._stored = container.arrays[key]
        with _explained(self._name):
            form = _form_of(self._stored, container.is_mixed)
        if form is None:
            raise ContainerError(
                f"{self._name} holds no frames: it is {_type_name(self._stored)} "
                f"{tuple(self._stored.shape)}"
            )
        if form.layout != "files":
            # before any is read, because a file can declare what fills the memory
            check_shape((form.height, form.width, 3), f"a frame of {self._name}")
        self.form = form
        self._lock = threading.Lock()
        self._rows = self._rows_of_a_block()
        self._scale = self._find_scale()

    def _rows_of_a_block(self) -> int:
        """Return how many rows are read at once: those of a chunk, if they fit into the memory."""
        chunks = getattr(self._stored, "chunks", None)
        if not chunks or self.form.single:
            return 1
        row_bytes = math.prod(self._stored.shape[1:]) * self._stored.dtype.itemsize
        return int(chunks[0]) if chunks[0] * row_bytes <= _MOST else 1

    def _find_scale(self) -> float:
        """Return what a float of full intensity is: 1, or 255 as in some replay buffers."""
        if self._stored.dtype.kind != "f":
            return 1.0
        spread = np.unique(np.linspace(0, self.form.frames - 1, _LOOKED_AT).astype(int))
        highest = max(float(np.max(self._pixels(int(row)))) for row in spread)
        return 255.0 if 1 < highest <= 255 else 1.0

    def file(self, row: int) -> bytes:
        """Return a frame as the bytes of a file: the stored image, or pixels as .npy."""
        if not 0 <= row < self.form.frames:
            raise ContainerError(
                f"{self._name} has {self.form.frames} frames, no frame {row}; index the data again"
            )
        if self.form.layout == "files":
            return file_bytes(self._value(row))
        pixels = self._pixels(row)
        if self._scale != 1:
            pixels = np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
        if self.form.layout == "CHW":
            pixels = np.moveaxis(pixels, 0, -1)
        stream = io.BytesIO()
        np.save(stream, np.ascontiguousarray(pixels), allow_pickle=False)
        return stream.getvalue()

    def _pixels(self, row: int) -> Array:
        return np.asarray(self._value(row))

    def _value(self, row: int) -> Any:
        with _explained(f"frame {row} of {self._name}"), self._lock:
            if self.form.single:
                return self._stored[()]
            if self._rows == 1:
                return self._stored[row]
            number = row // self._rows
            first = number * self._rows
            block = _BLOCKS.get(
                (self, number),
                lambda: np.asarray(self._stored[first : first + self._rows]),
            )
            return block[row - first]


class _Open:
    """The container of a path and the arrays of it that were read, kept open."""

    def __init__(self, path: Path) -> None:
        self._container = open_container(path)
        self._frames: dict[str, Frames] = {}
        self._lock = threading.Lock()

    def frames(self, key: str) -> Frames:
        """Return the frames of an array."""
        with self._lock:
            if key not in self._frames:
                self._frames[key] = Frames(self._container, key)
            return self._frames[key]


_open = lru_cache(16)(_Open)


def read_row(path: Path, key: str, row: int) -> bytes:
    """Return a frame of a container as the bytes of a file. Raises ContainerError."""
    return _open(path).frames(key).file(row)


def close_containers() -> None:
    """Close all open containers, so that they can be written."""
    _open.cache_clear()
    _BLOCKS.clear()
