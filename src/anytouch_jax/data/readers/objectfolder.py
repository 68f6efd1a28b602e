"""ObjectFolder 1.0 and 2.0 (Gao et al., CoRL 2021, CVPR 2022): rendered touches of neural objects.

Layout in AnyTouch's code: pictures `obj1.0/<id>/<n>.png` (by TACTO) and `obj2.0/touch/<id>/<n>.png` (by Taxim), with
`obj2.0/label.json` (id -> material number) and `obj2.0/split.json` (train, test: lists of [id, n]) for both. Ids up to
100 are 1.0, and 2.0 leaves them out. The material numbers have no names. ObjectFolder is CC BY 4.0 (its repository).

The sensors are `tacto` and `taxim`, never trained on in the paper. The split is the benchmark's and by picture, so an
object is in train and test. Every picture is a sequence. Pictures in no list are `unused`.
"""

from __future__ import annotations

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_json

LAST_OF_1 = 100
PLACES = ("obj1.0", "obj2.0/touch", "touch", ".")


def read(index: DatasetIndex) -> None:
    """Add every picture of both parts. Raises DatasetError without pictures, label.json or split.json."""
    places = [place for place in PLACES if _ids(index, place)]
    if not places:
        raise DatasetError(f"expected obj1.0/<id>/<n>.png or obj2.0/touch/<id>/<n>.png under {index.root}; is ROOT the "
                           "folder that holds 'obj1.0' and 'obj2.0'?")  # fmt: skip
    labels, splits = _lists(index)
    for place in places:
        prefix = "" if place == "." else f"{place}/"
        for name in _ids(index, place):
            first = int(name) <= LAST_OF_1
            if (place.endswith("touch") and first) or (place == "obj1.0" and not first):
                index.skip(f"id that does not belong to {place} (1.0 ends at {LAST_OF_1})", f"{prefix}{name}")
                continue
            files = index.listing(f"{place}/{name}")[1]
            frames = index.numbered(files, r"(\d+)\.(?:png|jpe?g)", f"{prefix}{name}")
            index.add(
                [f"{prefix}{name}/{file}" for _, file in frames],
                sensor="tacto" if first else "taxim",
                dataset="objectfolder1" if first else "objectfolder2",
                sequence=[f"{name}/{number}" for number, _ in frames],
                frame_index=0,
                split=[splits.pop((int(name), number), "unused") for number, _ in frames],
                object=name,
                **{"label.material": labels.get(int(name))},
            )
            index.skip("id without a label (kept without)", f"{prefix}{name}", int(name) not in labels)
    index.skip("picture of split.json that is not on disk", str(next(iter(splits), "")), len(splits))


def _ids(index: DatasetIndex, place: str) -> list[str]:
    if not (index.root / place).is_dir():
        return []
    return [name for name in index.listing(place, count=False)[0] if name.isdecimal()]


def _lists(index: DatasetIndex) -> tuple[dict[int, int], dict[tuple[int, int], str]]:
    """Return id -> material number, and (id, n) -> split."""
    folders = (index.root / "obj2.0", index.root)
    paths = {name: index.find_file([name], *folders) for name in ("label.json", "split.json")}
    for name, path in paths.items():
        if path is None:
            raise DatasetError(f"expected {name} in {folders[0]} or {folders[1]}, or in the folder of --lists")
    label, split = (read_json(path) for path in paths.values() if path is not None)
    splits: dict[tuple[int, int], str] = {}
    try:
        labels = {int(name): int(value) for name, value in label.items()}
        for part in ("train", "val", "test"):
            for name, number in split.get(part, []):
                key = int(name), int(number)
                if splits.setdefault(key, part) != part:
                    raise DatasetError(f"{paths['split.json']}: {list(key)} is in {splits[key]} and in {part}")
    except (AttributeError, TypeError, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{' or '.join(map(str, paths.values()))} is not as expected (id -> number; train, test: "
                           f"lists of [id, number]): {error}") from None  # fmt: skip
    return labels, splits


READER = DatasetReader(
    read,
    license="CC-BY-4.0",
    url="https://github.com/rhgao/ObjectFolder",
    citation="Gao et al., ObjectFolder, CoRL 2021; ObjectFolder 2.0, CVPR 2022",
    uses=("lists",),
)
