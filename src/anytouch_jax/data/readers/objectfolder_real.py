"""ObjectFolder Real (Gao et al., CVPR 2023): a robot touches 100 household objects with a GelSlim.

Seen in others' code: `<object>/tactile_data/<trial>/0/gelsight/<n>.png` (T3, Sparsh), the same under `tactile/`
(AnyTouch); `objectfolder_real_metadata.csv` with Index,Name,Material (T3); the authors' `contact_text_obj.csv`: touch
frame, photograph, caption number, both paths below `tactile/`. Not seen: the names of the folders of the two camera
views. Assumed: they lie beside `gelsight` and number their pictures alike; the first two by name are `image_path` and
`image2_path`, unless the list names the photograph. ObjectFolder is CC BY 4.0 (its repository); assumed here too.

Any folder called `gelsight` is one recording. The object (the first number in its path) is the group of the split.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    IndexOptions,
    Notes,
    RowBuilder,
    add_recording,
    contact_list,
    find_file,
    hash_split,
    miss_listed,
    numbered,
    read_table,
    walk,
)

FRAME = r"(\d+)\.(?:png|jpe?g)"
LISTS = ("contact_text_obj.csv", "contact_obj.csv")


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every folder `gelsight` under ROOT. Raises DatasetError when there is none."""
    base = next((root / place for place in ("tactile", "real/tactile") if (root / place).is_dir()), root)
    place = "" if base == root else f"{base.relative_to(root).as_posix()}/"
    table = find_file(["objectfolder_real_metadata.csv"], options.lists, root)
    objects = {row.get("Index", ""): row for row in read_table(table)} if table else {}
    listed = contact_list(root, options, LISTS, "tactile")
    on_disk: set[str] = set()
    recordings: list[tuple[str, list[str]]] = []
    views: dict[str, list[tuple[str, list[str]]]] = defaultdict(list)
    for inside, _, files in walk(base, notes):
        on_disk.update(f"{inside}/{name}" for name in files if listed is not None)
        if Path(inside).name == "gelsight":
            recordings.append((inside, files))
        elif files and inside:
            views[str(Path(inside).parent)].append((inside, files))
    if not recordings:
        raise DatasetError(f"expected tactile/<object>/<trial>/gelsight/<n>.png under {root}; is ROOT the folder "
                           "that holds 'tactile'?")  # fmt: skip
    for parent, others in views.items():
        if not any(str(Path(inside).parent) == parent for inside, _ in recordings):
            for inside, files in others:
                notes.skip("file outside a folder 'gelsight' and not beside one", f"{inside}/{files[0]}", len(files))
    rows = RowBuilder(
        "object", "image_path", "image2_path", "caption_id", "label.contact", "label.material", "label.object"
    )
    found = 0
    for inside, files in recordings:
        frames = numbered(files, FRAME, notes, inside)
        obj = next((part for part in inside.split("/") if part.isdecimal()), inside.split("/")[0])
        about = objects.get(obj, {})
        cells = [(listed or {}).get(f"{inside}/{name}", [""]) for _, name in frames]
        photos = [row[1].rpartition("tactile/")[2] if len(row) > 2 else "" for row in cells]
        notes.skip("listed photograph that is not on disk (kept without)", inside,
                   sum(bool(photo) and photo not in on_disk for photo in photos))  # fmt: skip
        first, second = _views(views[str(Path(inside).parent)], [number for number, _ in frames], place)
        listed_photos = [f"{place}{photo}" if photo in on_disk else None for photo in photos]
        found += add_recording(
            rows, frames, f"{place}{inside}",
            split=hash_split("objectfolder_real", obj, options), listed=listed, key=inside,
            sensor="gelslim", sequence=inside.removesuffix("/gelsight"), object=obj,
            image_path=[a or b for a, b in zip(listed_photos, first, strict=True)],
            image2_path=second,
            caption_id=[f"obj_{row[2]}" if len(row) > 2 else None for row in cells],
            **{"label.material": about.get("Material"), "label.object": about.get("Name")},
        )  # fmt: skip
    miss_listed(notes, listed, found)
    return rows.columns()


def _views(beside: list[tuple[str, list[str]]], numbers: list[int], place: str) -> list[list[str | None]]:
    """The pictures of the first two camera views (by name) that have the numbers of the touch frames, None without."""
    found: list[list[str | None]] = []
    for folder, files in sorted(beside):
        pictures = {number: f"{place}{folder}/{name}" for number, name in numbered(files, FRAME, Notes(), folder)}
        found.append([pictures.get(number) for number in numbers])
    with_any = [view for view in found if any(view)][:2]
    return with_any + [[None] * len(numbers)] * (2 - len(with_any))


READER = DatasetReader(
    name="objectfolder_real",
    read=read,
    sensor="gelslim",
    license="CC-BY-4.0",
    commercial=True,
    about="a robot touching 100 household objects",
    url="https://objectfolder.stanford.edu/objectfolder-real-download",
    citation="Gao et al., The ObjectFolder Benchmark: Multisensory Learning with Neural and Real Objects, CVPR 2023",
    uses=("val", "test", "lists"),
    paper=1_165_000,
)
