"""Feel, "The Feeling of Success" (Calandra et al., CoRL 2017): grasps with two GelSight fingers that failed or held.

Layout in AnyTouch's code: `<object>/touch_{before,during,after}/<n>_{A,B}.png`, `vision_{...}/<n>.png`, `feel.csv`
without header (object, n, success), `split_<k>.npy` (a pickled dict of train and test object lists). The original
files are `calandra_corl2017_*.h5`. No licence of the data is stated.

* The split of a `during` frame is its object's. `before` (open fingers) is background, and the background of the
  others. `after` shows the outcome and is `unused`. Every frame is a sequence: no clip spans the phases.
* `grasp_group` is the grasp, the same for both fingers (`unit` A and B). They press opposite sides and not one place,
  so it is no `touch`, and nothing is matched by it.
* The split is that of `split_<k>.npy`, or of `split_<k>.json` with the same content. Without either it is by hash of
  the object.
* From the original files, `export` first writes the pictures as PNG (needs `pip install h5py`).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.bars import tracked
from anytouch_jax.data.images import encode
from anytouch_jax.data.names import natural
from anytouch_jax.data.readers.common import (
    DatasetError,
    DatasetIndex,
    DatasetReader,
    published_splits,
    read_json,
    read_lines,
    read_pickle,
)
from anytouch_jax.files import atomic_write

PHASES = ("before", "during", "after")
PICTURES = {
    **{f"kinectA_rgb_{phase}": (f"vision_{phase}", "") for phase in PHASES},
    **{f"gelsight{finger}_{phase}": (f"touch_{phase}", f"_{finger}") for phase in PHASES for finger in "AB"},
}


def read(index: DatasetIndex) -> None:
    """Add every picture of every grasp in feel.csv. Raises DatasetError for .h5 files without it and `export`."""
    base = index.find_folder("feel", "", inside=("feel.csv",))
    if base is None:
        original = [name for name in index.listing("")[1] if name.endswith(".h5")]
        if not original:
            return
        index.need_export(f"{len(original)} original .h5 files and no feel.csv")
        count = export_grasps(index.root, original)
        index.notes.append(f"{count} grasps written from {len(original)} .h5 files")
        base = ""
    splits = _splits_of_fold(index, base)
    table = index.root / base / "feel.csv"
    files: dict[str, set[str]] = {}
    for line, row in tracked(read_lines(table), "rows read"):
        if len(row) != 3 or not row[1].isdecimal() or row[2] not in ("0", "1"):
            raise DatasetError(f"{table}, line {line}: expected object,number,0 or 1, found {','.join(row)}")
        name = row[0]
        if name not in files:
            folders = index.listing(f"{base}{name}")[0] if (index.root / base / name).is_dir() else []
            files[name] = {f"{sub}/{file}" for sub in folders for file in index.listing(f"{base}{name}/{sub}")[1]}
        if splits is not None and name not in splits:
            index.skip(f"grasp of an object that is in no list of split {index.options.fold} (split unused)", name)
        split = index.split_of(name) if splits is None else splits.get(name, "unused")
        _add_grasp(index, f"{base}{name}", name, int(row[1]), int(row[2]), split, files[name])


def _add_grasp(
    index: DatasetIndex, folder: str, name: str, number: int, success: int, split: str, files: set[str]
) -> None:
    grasp = f"{name}/{number}"
    for finger in "AB":
        before = f"touch_before/{number}_{finger}.png"
        for phase, part in zip(PHASES, ("background", split, "unused"), strict=True):
            file, photo = f"touch_{phase}/{number}_{finger}.png", f"vision_{phase}/{number}.png"
            if file not in files:
                index.skip("picture of feel.csv that is not on disk", f"{folder}/{file}")
                continue
            index.add(
                [f"{folder}/{file}"],
                sensor="gelsight",
                unit=finger,
                sequence=f"{grasp}/{phase}/{finger}",
                frame_index=0,
                split=part,
                object=name,
                grasp_group=grasp if phase == "during" else None,
                image_path=f"{folder}/{photo}" if photo in files else None,
                background_path=f"{folder}/{before}" if before in files else None,
                **{"label.success": success if phase == "during" else None,
                   "label.contact": 0 if phase == "before" else None},
            )  # fmt: skip


def _splits_of_fold(index: DatasetIndex, base: str) -> dict[str, str] | None:
    """Return object -> split from split_<fold>.json or .npy, None without a file."""
    fold = index.options.fold
    path = index.find_file([f"split_{fold}.json", f"split_{fold}.npy"], base)
    if path is None and fold:
        raise DatasetError(f"there is no split_{fold}.npy or .json for --fold {fold} in {index.root / base}")
    if path is None:
        index.notes.append(f"no split_{fold}.npy or .json: split by hash of the object")
        return None
    table: Any = read_json(path) if path.suffix == ".json" else np.ravel(read_pickle(path))[0]
    lists = table.values() if isinstance(table, dict) and {"train", "test"} <= table.keys() else [None]
    if not all(isinstance(names, list) for names in lists):
        raise DatasetError(f"{path}: expected the lists 'train' and 'test' of object names")
    return published_splits(path, table)


def export_grasps(root: Path, names: Sequence[str]) -> int:
    """Write the grasps of the HDF5 files `names` in `root` as PNG, and feel.csv last; return the number of grasps.

    Raises DatasetError if h5py is not installed or a file cannot be read.
    """
    try:
        import h5py  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        raise DatasetError("the original files of Feel are HDF5; run pip install h5py") from None
    lines: list[list[Any]] = []
    numbers: dict[str, int] = {}
    for name in tracked(sorted(names, key=natural), "files read"):
        try:
            with h5py.File(root / name, "r") as file:
                for grasp in _grasps(file):
                    obj, success = (_value(grasp, key) for key in ("object_name", "is_gripping"))
                    obj = _object_name(obj)
                    number = numbers[obj] = numbers.get(obj, -1) + 1
                    for key in PICTURES.keys() & grasp.keys():
                        sub, ending = PICTURES[key]
                        _save(root / obj / sub / f"{number}{ending}.png", np.asarray(grasp[key][()]))
                    lines.append([obj, number, int(np.ravel(success)[0])])
        except (OSError, KeyError, ValueError) as error:
            raise DatasetError(f"{root / name} is not a file of Feel: {error}") from None
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    atomic_write(root / "feel.csv", text.getvalue())
    return len(lines)


def _save(file: Path, picture: np.ndarray) -> None:
    """Write a picture RGB u8 (h, w, 3) as PNG. Raises ValueError for a file that has another."""
    data = encode(np.ascontiguousarray(picture))
    if not file.is_file():
        atomic_write(file, data, sync=False)
    elif file.read_bytes() != data:
        raise ValueError(f"{file} holds another picture; move it elsewhere")


def _grasps(group: Any) -> Iterator[Any]:
    """Yield every group with the pictures of a grasp, at any depth."""
    if "gelsightA_during" in group:
        yield group
        return
    for key in sorted(group, key=natural):
        if hasattr(group[key], "keys"):
            yield from _grasps(group[key])


def _value(group: Any, key: str) -> Any:
    """Return a small value, stored as a dataset or as an attribute."""
    return group[key][()] if key in group else group.attrs[key]


def _object_name(value: Any) -> str:
    """Return the name of an object as a folder, from text, bytes or an array of codes."""
    array = np.asarray(value)
    data = array.item() if array.size == 1 else array.astype(np.uint8).tobytes()
    text = data.decode() if isinstance(data, bytes) else str(data)
    name = text.rstrip("\0").strip().replace("/", "_").replace("\\", "_")
    if name.strip(".") == "":
        raise ValueError(f"a grasp has the object name {text!r}")
    return name


READERS = {
    "feel": DatasetReader(
        read,
        "feel.csv and <object>/touch_during/0_A.png",
        "Calandra et al., The Feeling of Success: Does Touch Sensing Help Predict Grasp Outcomes?, CoRL 2017",
        url="https://sites.google.com/view/the-feeling-of-success",
        uses=("val", "test", "lists", "fold", "export"),
    )
}
