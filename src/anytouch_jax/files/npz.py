"""Arrays of .npz files, read with limits: no pickled objects, and no more bytes than there are."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING

from anytouch_jax.files.placeholders import placeholder

if TYPE_CHECKING:  # commands that read no arrays start faster
    import numpy as np

# A file of zeros is compressed a thousandfold. This much is always allowed, and four times the
# file's own size.
_ALWAYS = 1 << 30
_TIMES = 4


def read_arrays(
    file: str | Path | IO[bytes], *, only: Callable[[str], bool] = lambda _: True
) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name.

    Every header is read before any array. Pickled objects, sizes that the file does not have, and
    more than 1 GiB in a file a quarter as large are refused.

    Args:
        file: A path, or an open file.
        only: Which names are wanted. The other arrays are zeros of their shape and type that take
            no memory.

    Raises:
        OSError: If the file cannot be opened.
        ValueError: If it is not such a file.
    """
    if isinstance(file, str | Path):
        kind = placeholder(file)
        if kind:
            raise ValueError(f"it is {kind}")
    try:
        with zipfile.ZipFile(file) as archive:
            return _read_members(archive, only)
    except (OSError, ValueError):
        raise
    except Exception as error:  # damaged bytes raise any type of error
        raise ValueError(
            f"it is damaged or not an .npz file ({type(error).__name__}: {str(error)[:200]})"
        ) from error


def _read_members(archive: zipfile.ZipFile, only: Callable[[str], bool]) -> dict[str, np.ndarray]:
    import numpy as np

    members = [(info, info.filename.removesuffix(".npy")) for info in archive.infolist()]
    names = {name for _, name in members}
    if len(names) < len(members):
        raise ValueError("two of its arrays have one name")
    arrays = {}
    for info, name in members:
        with archive.open(info) as member:
            arrays[name] = _check_header(member, info.file_size, name)
    # The headers agree with the sizes of the members by now, so the sum is what will be unpacked.
    total = sum(array.nbytes for name, array in arrays.items() if only(name))
    stored = sum(info.compress_size for info, _ in members)
    if total > max(_ALWAYS, _TIMES * stored):
        raise ValueError(f"its arrays take {total:,} bytes in a file of {stored:,}")
    for info, name in members:
        if only(name):
            with archive.open(info) as member:
                arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
    return arrays


def _check_header(file: IO[bytes], file_size: int, name: str) -> np.ndarray:
    """Return zeros of the form of an array, which take no memory.

    Raises ValueError if the array does not have the bytes that its header gives.
    """
    import numpy as np

    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"its array {name[:80]} has an unknown form")
    size = math.prod(shape) * dtype.itemsize
    # An array of objects is a pickle, and a pickle can run code.
    if dtype.hasobject or min(shape, default=0) < 0 or size != file_size - file.tell():
        raise ValueError(
            f"its array {name[:80]} of shape {shape} has other bytes than its header says"
        )
    return np.broadcast_to(np.zeros((), dtype), shape)


def check_array(name: str, array: np.ndarray, shape: tuple[int, ...], kinds: str = "f") -> None:
    """Raise ValueError unless an array has the form that its reader expects, and finite values.

    Args:
        name: What the message calls it.
        array: Of any shape and type.
        shape: The shape that it must have.
        kinds: Allowed kinds of its type, as in `dtype.kind`: "f" floats, "u" unsigned, "U" text.
    """
    import numpy as np

    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(f"its {name} is {array.dtype} {array.shape}, not of shape {shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"its {name} has values that are not finite")
