"""ObjectFolder 1.0 and 2.0 (Gao et al., CoRL 2021, CVPR 2022): touches of neural objects, rendered.

Seen in AnyTouch's code: pictures `obj1.0/<id>/<n>.png` (by TACTO) and `obj2.0/touch/<id>/<n>.png` (by Taxim), with
`obj2.0/label.json` (id -> material number) and `obj2.0/split.json` (train, test: lists of [id, n]) for both; ids up to
100 are 1.0, and 2.0 leaves them out. The material numbers have no names. ObjectFolder is CC BY 4.0 (its repository).

Sensors are `tacto` and `taxim`, never trained on in the paper. The split is the benchmark's own and by picture, so an
object is in train and test; every picture is a sequence of its own. Pictures in no list are `unused`.
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
    listing,
    numbered,
    read_json,
)

LAST_OF_1 = 100
PLACES = ("obj1.0", "obj2.0/touch", "touch", ".")


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every picture of both parts that are there. Raises DatasetError without pictures, label.json or split.json."""
    places = [place for place in PLACES if _ids(root / place)]
    if not places:
        raise DatasetError(f"expected obj1.0/<id>/<n>.png or obj2.0/touch/<id>/<n>.png under {root}; is ROOT the "
                           "folder that holds 'obj1.0' and 'obj2.0'?")  # fmt: skip
    labels, splits = _lists(root, options)
    rows = RowBuilder("object", "dataset", "label.material")
    for place in places:
        prefix = "" if place == "." else f"{place}/"
        for name in _ids(root / place):
            first = int(name) <= LAST_OF_1
            if (place.endswith("touch") and first) or (place == "obj1.0" and not first):
                notes.skip(f"id that does not belong to {place} (1.0 ends at {LAST_OF_1})", f"{prefix}{name}")
                continue
            frames = numbered(listing(root / place / name, notes)[1], r"(\d+)\.(?:png|jpe?g)", notes, f"{prefix}{name}")
            rows.add(
                [f"{prefix}{name}/{file}" for _, file in frames],
                sensor="tacto" if first else "taxim",
                dataset="objectfolder1" if first else "objectfolder2",
                sequence=[f"{name}/{number}" for number, _ in frames],
                frame_index=0,
                split=[splits.pop((int(name), number), "unused") for number, _ in frames],
                object=name,
                **{"label.material": labels.get(int(name))},
            )
            notes.skip("id without a label (kept without)", f"{prefix}{name}", int(name) not in labels)
    notes.skip("picture of split.json that is not on disk", str(next(iter(splits), "")), len(splits))
    return rows.columns()


def _ids(folder: Path) -> list[str]:
    return [name for name in listing(folder, Notes())[0] if name.isdecimal()] if folder.is_dir() else []


def _lists(root: Path, options: IndexOptions) -> tuple[dict[int, int], dict[tuple[int, int], str]]:
    """id -> material number, and (id, n) -> split."""
    found = []
    for name in ("label.json", "split.json"):
        path = find_file([name], options.lists, root / "obj2.0", root)
        if path is None:
            raise DatasetError(f"expected {name} in {root / 'obj2.0'} or {root} (or say where with --lists)")
        found.append((path, read_json(path)))
    (label_path, label), (split_path, split) = found
    splits: dict[tuple[int, int], str] = {}
    try:
        labels = {int(name): int(value) for name, value in label.items()}
        for part in ("train", "val", "test"):
            for name, number in split.get(part, []):
                if splits.setdefault((int(name), int(number)), part) != part:
                    raise DatasetError(f"{split_path}: [{name}, {number}] is in {splits[int(name), int(number)]} "
                                       f"and in {part}")  # fmt: skip
    except (AttributeError, TypeError, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{label_path} or {split_path} is not as expected (id -> number; train, test: lists of "
                           f"[id, number]): {error}") from None  # fmt: skip
    return labels, splits


READER = DatasetReader(
    name="objectfolder",
    read=read,
    sensor="tacto, taxim",
    license="CC-BY-4.0",
    commercial=True,
    about="ObjectFolder 1.0 and 2.0: rendered touches of 1,000 objects; label material (downstream tasks of the paper)",
    url="https://github.com/rhgao/ObjectFolder",
    citation="Gao et al., ObjectFolder, CoRL 2021; ObjectFolder 2.0, CVPR 2022",
    uses=("lists",),
)
