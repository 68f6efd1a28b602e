"""The original files of Feel: HDF5 written out as pictures, and its pickled split lists read without unpickling."""

from __future__ import annotations

import csv
import io
import pickletools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from anytouch_jax.data.images import natural
from anytouch_jax.data.readers.common import DatasetError
from anytouch_jax.files import atomic_write

PARTS = ("train", "val", "test")
PICTURES = {
    **{f"kinectA_rgb_{phase}": (f"vision_{phase}", "") for phase in ("before", "during", "after")},
    **{f"gelsight{finger}_{phase}": (f"touch_{phase}", f"_{finger}") for phase in ("before", "during", "after")
       for finger in "AB"},
}  # fmt: skip


def strings_in_pickle(path: Path) -> dict[str, list[str]]:
    """The lists of names under 'train', 'val', 'test' in a .npy file that holds a pickled dict of lists.

    The pickle is scanned, never run: names are taken in order, each for the last of the three keys before it. Raises
    DatasetError for anything else in the lists, which a scan could misread.
    """
    lists: dict[str, list[str]] = {}
    memo: dict[int, str] = {}
    last, current = "", ""
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            header(file)
            ops = list(pickletools.genops(file.read()))
    except (OSError, ValueError, IndexError) as error:
        raise DatasetError(f"{path} is not a .npy file with a pickled dict: {error}") from None
    for op, argument, _ in ops:
        value: Any = argument
        if op.name == "MEMOIZE":
            memo[len(memo)] = last
        elif op.name in ("BINPUT", "LONG_BINPUT"):
            memo[value] = last
        elif current and op.name in ("GLOBAL", "STACK_GLOBAL", "REDUCE"):
            raise DatasetError(f"{path} holds more than lists of names; save it as {path.with_suffix('.json').name}")
        word = memo.get(value, "") if op.name in ("BINGET", "LONG_BINGET") else value if "UNICODE" in op.name else None
        last = word if isinstance(word, str) else ""
        if word in PARTS:
            current = word
            lists[current] = []
        elif word and current:
            lists[current].append(word)
    return lists


def export_grasps(root: Path, names: Sequence[str]) -> int:
    """Write the grasps of the HDF5 files `names` in `root` as PNG, and feel.csv last; the number of grasps.

    Raises DatasetError when h5py is not installed or a file cannot be read.
    """
    try:
        import h5py  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        raise DatasetError("the original files of Feel are HDF5; run pip install h5py") from None
    lines: list[list[Any]] = []
    count: dict[str, int] = {}
    for name in sorted(names, key=natural):
        try:
            with h5py.File(root / name, "r") as file:
                for grasp in _grasps(file):
                    obj = _text(_value(grasp, "object_name"))
                    number = count[obj] = count.get(obj, -1) + 1
                    _write_grasp(root / obj, number, grasp)
                    lines.append([obj, number, int(np.ravel(_value(grasp, "is_gripping"))[0])])
        except (OSError, KeyError, ValueError) as error:
            raise DatasetError(f"{root / name} is not a file of Feel: {error}") from None
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    atomic_write(root / "feel.csv", text.getvalue())
    return len(lines)


def _grasps(group: Any) -> Iterator[Any]:
    """Every group that holds the pictures of a grasp, wherever it is nested."""
    if "gelsightA_during" in group:
        yield group
        return
    for key in sorted(group, key=natural):
        if hasattr(group[key], "keys"):
            yield from _grasps(group[key])


def _value(group: Any, key: str) -> Any:
    """A small value, stored as a dataset or as an attribute."""
    return group[key][()] if key in group else group.attrs[key]


def _text(value: Any) -> str:
    value = value.item() if isinstance(value, np.generic | np.ndarray) and np.size(value) == 1 else value
    if isinstance(value, np.ndarray):
        value = value.astype(np.uint8).tobytes()
    text = value.decode() if isinstance(value, bytes) else str(value)
    name = text.rstrip("\0").strip().replace("/", "_").replace("\\", "_")
    if name.strip(".") == "":
        raise ValueError(f"a grasp has the object name {text!r}")
    return name


def _write_grasp(folder: Path, number: int, grasp: Any) -> None:
    for key, (sub, ending) in PICTURES.items():
        if key not in grasp:
            continue
        pixels = np.asarray(grasp[key][()])
        path = folder / sub / f"{number}{ending}.png"
        data = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
        atomic_write(path, data, sync=False)
