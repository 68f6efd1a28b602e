"""ObjectFolder 1.0, 2.0 and Real: rendered touches of neural objects, and a robot's touches of 100 real ones.

All are CC BY 4.0 by their repository, as is assumed for the real touches.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from anytouch_jax.data.readers.common import (
    NUMBERED,
    DatasetError,
    DatasetIndex,
    DatasetReader,
    published_splits,
    read_json,
    read_table,
)

LAST_OF_1 = 100
PLACES = ("obj1.0/", "obj2.0/touch/", "touch/", "")
Views = dict[str, list[tuple[str, list[str]]]]  # folder -> (folder, files) of the camera views in it


def _rendered(index: DatasetIndex) -> None:
    """Touches rendered by TACTO (1.0) and Taxim (2.0), two sensors that the paper never trains on.

    AnyTouch's code has `obj1.0/<id>/<n>.png` and `obj2.0/touch/<id>/<n>.png`, with `obj2.0/label.json` (id -> material
    number, without names) and `obj2.0/split.json` (train, test: lists of [id, n]) for both. Ids up to 100 are 1.0, and
    2.0 leaves them out. The split is the benchmark's and by picture, so an object is in train and test. Every picture
    is a sequence. Pictures in no list are `unused`. Raises DatasetError without label.json or split.json.
    """
    ids = {place: [] if not (index.root / place).is_dir() else index.listing(place, count=False)[0] for place in PLACES}
    ids = {place: found for place, names in ids.items() if (found := [name for name in names if name.isdecimal()])}
    if not ids:
        return
    labels, splits = _lists(index)
    for place, names in ids.items():
        for name in index.tracked(names):
            folder, number, first = f"{place}{name}", int(name), int(name) <= LAST_OF_1
            if (place.endswith("touch/") and first) or (place == "obj1.0/" and not first):
                index.skip(f"id that does not belong to {place.rstrip('/')} (1.0 ends at {LAST_OF_1})", folder)
                continue
            frames = index.frames(folder)
            index.add(
                [f"{folder}/{file}" for file in frames.values()],
                sensor="tacto" if first else "taxim",
                dataset="objectfolder1" if first else "objectfolder2",
                sequence=[f"{name}/{n}" for n in frames],
                frame_index=0,
                split=[splits.pop((number, n), "unused") for n in frames],
                object=name,
                **{"label.material": labels.get(number)},
            )
            index.skip("id without a label (kept without)", folder, number not in labels)
    index.skip("picture of split.json that is not on disk", str(next(iter(splits), "")), len(splits))


def _lists(index: DatasetIndex) -> tuple[dict[int, int], dict[tuple[int, int], str]]:
    """Return id -> material number, and (id, n) -> split."""
    tables: list[dict[str, Any]] = []
    paths = []
    for name in ("label.json", "split.json"):
        path = index.find_file([name], "obj2.0", "")
        if path is None:
            raise DatasetError(f"expected {name} in {index.root} or its folder obj2.0, or in the folder of --lists")
        paths.append(path)
        tables.append(read_json(path))
    try:
        labels = {int(name): int(value) for name, value in tables[0].items()}
        splits = published_splits(paths[1], tables[1], lambda pair: (int(pair[0]), int(pair[1])))
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{' or '.join(map(str, paths))} is not as expected (id -> number; train, test: "
                           f"lists of [id, number]): {error}") from None  # fmt: skip
    return labels, splits


def _real(index: DatasetIndex) -> None:
    """A robot touches 100 household objects with a GelSlim: every folder called `gelsight` is a recording.

    T3 and Sparsh have `<object>/tactile_data/<trial>/0/gelsight/<n>.png`, AnyTouch the same under `tactile/`. T3 has
    `objectfolder_real_metadata.csv` with Index,Name,Material. The authors' `contact_text_obj.csv` has touch frame,
    photograph and caption number, where both paths start below `tactile/`. The names of the two camera folders are
    unknown. Assumed: they are siblings of `gelsight` with the same numbers. The first two by name are `image_path` and
    `image2_path`, unless the list names the photograph. The object is the first number in the path.
    """
    base = index.find_folder("tactile", "real/tactile", "") or ""
    table = index.find_file(["objectfolder_real_metadata.csv"])
    objects = {row["Index"]: row for row in read_table(table, "Index")} if table else {}
    index.read_contact_list(("contact_text_obj.csv", "contact_obj.csv"), "tactile")
    on_disk: set[str] = set()
    recordings: list[tuple[str, list[str]]] = []
    views: Views = defaultdict(list)
    for inside, _, files in index.walk(base):
        on_disk.update(f"{inside}/{name}" for name in files if index.contact is not None)
        parent, _, name = inside.rpartition("/")
        if name == "gelsight":
            recordings.append((inside, files))
        elif files and inside:
            views[parent].append((inside, files))
    parents = {inside.rpartition("/")[0] for inside, _ in recordings}
    for folder, files in (view for parent, siblings in views.items() if parent not in parents for view in siblings):
        index.skip("file outside a folder 'gelsight' and its siblings", f"{folder}/{files[0]}", len(files))
    for inside, files in recordings:
        frames = index.frames(f"{base}{inside}", files=files)
        obj = next((part for part in inside.split("/") if part.isdecimal()), inside.split("/")[0])
        metadata = objects.get(obj, {})
        photos = [photo.rpartition("tactile/")[2] for photo in index.listed(inside, frames, 1)]
        captions = index.listed(inside, frames, 2)
        missing = sum(bool(photo) and photo not in on_disk for photo in photos)
        index.skip("listed photograph that is not on disk (kept without)", inside, missing)
        first, second = _camera_views(index, base, views[inside.rpartition("/")[0]], list(frames))
        listed = [f"{base}{photo}" if photo in on_disk else None for photo in photos]
        index.add_recording(
            frames, f"{base}{inside}",
            split=index.split_of(obj), key=inside,
            sensor="gelslim", sequence=inside.removesuffix("/gelsight"), object=obj,
            image_path=[a or b for a, b in zip(listed, first, strict=True)],
            image2_path=second,
            caption_id=[f"obj_{caption}" if caption else None for caption in captions],
            **{"label.material": metadata.get("Material"), "label.object": metadata.get("Name")},
        )  # fmt: skip


def _camera_views(
    index: DatasetIndex, base: str, siblings: list[tuple[str, list[str]]], numbers: list[int]
) -> list[list[str | None]]:
    """Return the pictures of the first two camera views (by name) with the numbers of the touch frames, else None."""
    views: list[list[str | None]] = []
    for folder, files in sorted(siblings):
        names = index.frames(folder, NUMBERED, files, count=False)
        views.append([f"{base}{folder}/{names[n]}" if n in names else None for n in numbers])
    return ([view for view in views if any(view)] + [[None] * len(numbers)] * 2)[:2]


READERS = {
    "objectfolder": DatasetReader(
        _rendered, "obj1.0/<id>/<n>.png or obj2.0/touch/<id>/<n>.png",
        "Gao et al., ObjectFolder, CoRL 2021; ObjectFolder 2.0, CVPR 2022", "CC-BY-4.0",
        "https://github.com/rhgao/ObjectFolder", uses=("lists",),
    ),
    "objectfolder_real": DatasetReader(
        _real, "tactile/<object>/<trial>/gelsight/<n>.png",
        "Gao et al., The ObjectFolder Benchmark: Multisensory Learning with Neural and Real Objects, CVPR 2023",
        "CC-BY-4.0", "https://objectfolder.stanford.edu/objectfolder-real-download", uses=("val", "test", "lists"),
        paper=1_165_000,
    ),
}  # fmt: skip
