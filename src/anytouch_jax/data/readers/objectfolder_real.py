"""ObjectFolder Real (Gao et al., CVPR 2023): a robot touches 100 household objects with a GelSlim.

Layout in others' code: `<object>/tactile_data/<trial>/0/gelsight/<n>.png` (T3, Sparsh), the same under `tactile/`
(AnyTouch), and `objectfolder_real_metadata.csv` with Index,Name,Material (T3). The authors' `contact_text_obj.csv` has
touch frame, photograph and caption number, where both paths start below `tactile/`. The names of the two camera folders
are unknown. Assumed: they are siblings of `gelsight` with the same numbers. The first two by name are `image_path` and
`image2_path`, unless the list names the photograph. ObjectFolder is CC BY 4.0 (its repository), as assumed here.

Any folder called `gelsight` is one recording. The object (the first number in its path) is the group of the split.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_table

FRAME = r"(\d+)\.(?:png|jpe?g)"
LISTS = ("contact_text_obj.csv", "contact_obj.csv")


def read(index: DatasetIndex) -> None:
    """Add every folder `gelsight` under ROOT. Raises DatasetError if there is none."""
    root = index.root
    base = next((root / place for place in ("tactile", "real/tactile") if (root / place).is_dir()), root)
    prefix = index.prefix(base)
    table = index.find_file(["objectfolder_real_metadata.csv"])
    objects = {row.get("Index", ""): row for row in read_table(table)} if table else {}
    index.read_contact_list(LISTS, "tactile")
    on_disk: set[str] = set()
    recordings: list[tuple[str, list[str]]] = []
    views: dict[str, list[tuple[str, list[str]]]] = defaultdict(list)
    for inside, _, files in index.walk(base):
        on_disk.update(f"{inside}/{name}" for name in files if index.contact is not None)
        if Path(inside).name == "gelsight":
            recordings.append((inside, files))
        elif files and inside:
            views[str(Path(inside).parent)].append((inside, files))
    if not recordings:
        raise DatasetError(f"expected tactile/<object>/<trial>/gelsight/<n>.png under {root}; is ROOT the folder "
                           "that holds 'tactile'?")  # fmt: skip
    parents = {str(Path(inside).parent) for inside, _ in recordings}
    for inside, files in (view for parent, siblings in views.items() if parent not in parents for view in siblings):
        index.skip("file outside a folder 'gelsight' and its siblings", f"{inside}/{files[0]}", len(files))
    for inside, files in recordings:
        frames = index.numbered(files, FRAME, inside)
        obj = next((part for part in inside.split("/") if part.isdecimal()), inside.split("/")[0])
        metadata = objects.get(obj, {})
        cells = [(index.contact or {}).get(f"{inside}/{name}", [""]) for _, name in frames]
        photos = [row[1].rpartition("tactile/")[2] if len(row) > 2 else "" for row in cells]
        missing = sum(bool(photo) and photo not in on_disk for photo in photos)
        index.skip("listed photograph that is not on disk (kept without)", inside, missing)
        first, second = _views(index, views[str(Path(inside).parent)], [number for number, _ in frames], prefix)
        listed = [f"{prefix}{photo}" if photo in on_disk else None for photo in photos]
        index.add_recording(
            frames, f"{prefix}{inside}",
            split=index.split_of(obj), key=inside,
            sensor="gelslim", sequence=inside.removesuffix("/gelsight"), object=obj,
            image_path=[a or b for a, b in zip(listed, first, strict=True)],
            image2_path=second,
            caption_id=[f"obj_{row[2]}" if len(row) > 2 else None for row in cells],
            **{"label.material": metadata.get("Material"), "label.object": metadata.get("Name")},
        )  # fmt: skip


def _views(
    index: DatasetIndex, siblings: list[tuple[str, list[str]]], numbers: list[int], prefix: str
) -> list[list[str | None]]:
    """Return the pictures of the first two camera views (by name) with the numbers of the touch frames, else None."""
    views: list[list[str | None]] = []
    for folder, files in sorted(siblings):
        frames = index.numbered(files, FRAME, folder, count=False)
        pictures = {number: f"{prefix}{folder}/{name}" for number, name in frames}
        views.append([pictures.get(number) for number in numbers])
    with_any = [view for view in views if any(view)][:2]
    return with_any + [[None] * len(numbers)] * (2 - len(with_any))


READER = DatasetReader(
    read,
    license="CC-BY-4.0",
    url="https://objectfolder.stanford.edu/objectfolder-real-download",
    citation="Gao et al., The ObjectFolder Benchmark: Multisensory Learning with Neural and Real Objects, CVPR 2023",
    uses=("val", "test", "lists"),
    paper=1_165_000,
)
