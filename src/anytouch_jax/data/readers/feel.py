"""Feel, "The Feeling of Success" (Calandra et al., CoRL 2017): grasps with two GelSight fingers, failed or held.

Seen in AnyTouch's code: `<object>/touch_{before,during,after}/<n>_{A,B}.png`, `vision_{...}/<n>.png`, `feel.csv`
without header (object, n, success), `split_<k>.npy` (a pickled dict of train and test object lists); and how these
folders are made from the original `calandra_corl2017_*.h5`. No licence of the data is stated.

* The split of a `during` frame is its object's; `before` (open fingers) is background and the background of the
  others; `after` shows the outcome and is `unused`. Every frame is a sequence of its own: no clip spans the phases.
* `grasp_group` is the grasp: both fingers (`unit` A and B) have it. They press opposite sides, not one place, so it is
  no `touch`: nothing is matched by it.
* A pickled split file is never unpickled as code: `split_<k>.npy` is read by a reader that knows lists and strings
  only; `split_<k>.json` with the same content is read too. Without either: by hash of the object.
* Only original files: say `export` and they are written as PNG first (needs `pip install h5py`).
"""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    IndexOptions,
    Notes,
    RowBuilder,
    find_file,
    hash_split,
    listing,
    read_csv,
    read_json,
)
from anytouch_jax.data.readers.feel_files import export_grasps, strings_in_pickle

PHASES = ("before", "during", "after")


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every picture of every grasp in feel.csv. Raises DatasetError without it."""
    base = next((root / name for name in ("feel", ".") if (root / name / "feel.csv").is_file()), root)
    if not (base / "feel.csv").is_file():
        original = [name for name in listing(root, notes)[1] if name.endswith(".h5")]
        if not original:
            raise DatasetError(f"expected feel.csv and <object>/touch_during/0_A.png under {root}; is ROOT the folder "
                               "that holds 'feel.csv'?")  # fmt: skip
        if not options.export:
            raise DatasetError(f"{root} has {len(original)} original .h5 files and no feel.csv; add --export to write "
                               "the pictures beside them (needs pip install h5py)")  # fmt: skip
        notes.log(f"{export_grasps(root, original)} grasps written from {len(original)} .h5 files")
    splits = _splits(base, options, notes)
    prefix = "" if base == root else f"{base.relative_to(root).as_posix()}/"
    rows = RowBuilder(
        "object", "unit", "grasp_group", "image_path", "background_path", "label.success", "label.contact"
    )
    there: dict[str, set[str]] = {}
    table = base / "feel.csv"
    for line, row in enumerate(read_csv(table), 1):
        if len(row) != 3 or not row[1].isdecimal() or row[2] not in ("0", "1"):
            raise DatasetError(f"{table}, line {line}: expected object,number,0 or 1, found {','.join(row)}")
        name, number, success = row
        if name not in there:
            there[name] = _files(base / name, notes)
        if splits is not None and name not in splits:
            notes.skip(f"grasp of an object that is in no list of split {options.fold} (split unused)", name)
        split = hash_split("feel", name, options) if splits is None else splits.get(name, "unused")
        _grasp(rows, notes, prefix, name, int(number), int(success), split, there[name])
    return rows.columns()


def _files(folder: Path, notes: Notes) -> set[str]:
    if not folder.is_dir():
        return set()
    return {f"{sub}/{file}" for sub in listing(folder, notes)[0] for file in listing(folder / sub, notes)[1]}


def _grasp(rows: RowBuilder, notes: Notes, prefix: str, name: str, number: int, success: int, split: str,
           there: set[str]) -> None:  # fmt: skip
    grasp = f"{name}/{number}"
    for finger in "AB":
        before = f"touch_before/{number}_{finger}.png"
        for phase, part in zip(PHASES, ("background", split, "unused"), strict=True):
            file, photo = f"touch_{phase}/{number}_{finger}.png", f"vision_{phase}/{number}.png"
            if file not in there:
                notes.skip("picture of feel.csv that is not on disk", f"{prefix}{name}/{file}")
                continue
            rows.add(
                [f"{prefix}{name}/{file}"],
                sensor="gelsight",
                unit=finger,
                sequence=f"{grasp}/{phase}/{finger}",
                frame_index=0,
                split=part,
                object=name,
                grasp_group=grasp if phase == "during" else None,
                image_path=f"{prefix}{name}/{photo}" if photo in there else None,
                background_path=f"{prefix}{name}/{before}" if before in there else None,
                **{"label.success": success if phase == "during" else None,
                   "label.contact": 0 if phase == "before" else None},
            )  # fmt: skip


def _splits(base: Path, options: IndexOptions, notes: Notes) -> dict[str, str] | None:
    """object -> split, from split_<fold>.json or .npy; None without a file."""
    path = find_file([f"split_{options.fold}.json", f"split_{options.fold}.npy"], options.lists, base)
    if path is None and options.fold:
        raise DatasetError(f"there is no split_{options.fold}.npy or .json for --fold {options.fold} under {base}")
    if path is None:
        notes.log(f"no split_{options.fold}.npy or .json: split by hash of the object")
        return None
    table = read_json(path) if path.suffix == ".json" else strings_in_pickle(path)
    lists = table.values() if isinstance(table, dict) else ()
    if not isinstance(table, dict) or not {"train", "test"} <= table.keys() or not all(map(_is_list, lists)):
        raise DatasetError(f"{path}: expected the lists 'train' and 'test' of object names")
    splits: dict[str, str] = {}
    for part in ("train", "val", "test"):
        for name in table.get(part, []):
            if splits.setdefault(str(name), part) != part:
                raise DatasetError(f"{path}: the object {name} is in {splits[str(name)]} and in {part}")
    return splits


def _is_list(one: object) -> bool:
    return hasattr(one, "__len__") and not isinstance(one, str | bytes | dict)


READER = DatasetReader(
    name="feel",
    read=read,
    sensor="gelsight",
    license="not stated",
    commercial=False,
    about="9,269 grasps with two fingers; label success (a downstream task of the paper)",
    url="https://sites.google.com/view/the-feeling-of-success",
    citation="Calandra et al., The Feeling of Success: Does Touch Sensing Help Predict Grasp Outcomes?, CoRL 2017",
    uses=("val", "test", "lists", "fold", "export"),
)
