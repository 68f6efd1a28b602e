"""VisGel (Li et al., CVPR 2019): a robot pokes 195 objects with a GelSight while a camera watches.

Seen in others' code: `images/touch/<...>/frame%04d.jpg`, the photograph of the same moment under the same path in
`images/vision/` (AnyTouch); `data_seen/` and `data_unseen/` with two levels of folders as downloaded, `frame0000.jpg`
the touch-free reference (T3). Assumed: the same `touch` / `vision` pair within `data_seen` and `data_unseen`.
No licence is stated.

`data_unseen` is the dataset's own test part. A recording is the group of the hash split otherwise. The authors' list
`contact_visgel.csv` (from TacQuad's download) marks the contact frames where it is there.
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
    add_recording,
    contact_list,
    hash_split,
    listing,
    miss_listed,
    numbered,
    walk,
)

PLACES = ("images/touch", "touch", "data_seen/touch", "data_unseen/touch", "images/data_seen/touch",
          "images/data_unseen/touch")  # fmt: skip


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every recording under `touch` with its photographs under `vision`. Raises DatasetError when there is none."""
    bases = [root / place for place in PLACES if (root / place).is_dir()]
    if not bases:
        raise DatasetError(
            f"expected images/touch/<recording>/frame0000.jpg under {root}; is ROOT the folder that holds 'images'?"
        )
    listed = contact_list(root, options, ("contact_visgel.csv", "images/contact_visgel.csv"), "touch")
    rows = RowBuilder("image_path", "background_path", "label.contact")
    found = 0
    for base in bases:
        place = base.relative_to(root).as_posix()
        for inside, folders, files in walk(base, notes):
            if files and not folders:
                found += _recording(rows, notes, root, place, inside, files, listed, options)
            elif files:
                notes.skip("file that is not a frame by its name", f"{base / inside}/{files[0]}", len(files))
    miss_listed(notes, listed, found)
    return rows.columns()


def _recording(rows: RowBuilder, notes: Notes, root: Path, place: str, inside: str, files: list[str],
               listed: dict[str, list[str]] | None, options: IndexOptions) -> int:  # fmt: skip
    folder = f"{place}/{inside}"
    frames = numbered(files, r"frame(\d+)\.jpe?g", notes, folder)
    vision = f"{place.removesuffix('touch')}vision/{inside}"
    photos = set(listing(root / vision, notes)[1]) if (root / vision).is_dir() else set()
    notes.skip("photograph missing (kept without)", vision, sum(name not in photos for _, name in frames))
    split = "test" if "data_unseen" in place else hash_split("visgel", inside, options)
    return add_recording(
        rows, frames, folder,
        split=split, listed=listed, key=inside, sensor="gelsight", sequence=folder,
        image_path=[f"{vision}/{name}" if name in photos else None for _, name in frames],
        background_path=f"{folder}/{frames[0][1]}" if frames and frames[0][0] == 0 else None,
    )  # fmt: skip


READER = DatasetReader(
    name="visgel",
    read=read,
    sensor="gelsight",
    license="not stated",
    commercial=False,
    about="a robot poking 195 objects, with video of the scene",
    url="http://visgel.csail.mit.edu",
    citation="Li et al., Connecting Touch and Vision via Cross-Modal Prediction, CVPR 2019",
    uses=("val", "test", "lists"),
    paper=587_000,
)
