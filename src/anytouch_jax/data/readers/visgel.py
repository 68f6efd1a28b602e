"""VisGel (Li et al., CVPR 2019): a robot pokes 195 objects with a GelSight while a camera watches.

Layout in others' code: `images/touch/<...>/frame%04d.jpg`, with the photograph of the same moment under the same path
in `images/vision/` (AnyTouch). T3 has `data_seen/` and `data_unseen/` with two levels of folders as downloaded, where
`frame0000.jpg` is the touch-free reference. Assumed: the same `touch` / `vision` pair within `data_seen` and
`data_unseen`. No licence is stated.

`data_unseen` is the dataset's own test part. Otherwise a recording is the group of the hash split. The authors' list
`contact_visgel.csv` (from TacQuad's download) marks the contact frames.
"""

from __future__ import annotations

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader

PLACES = ("images/touch", "touch", "data_seen/touch", "data_unseen/touch", "images/data_seen/touch",
          "images/data_unseen/touch")  # fmt: skip


def read(index: DatasetIndex) -> None:
    """Add every recording under `touch` with its photographs under `vision`. Raises DatasetError if there is none."""
    bases = [index.root / place for place in PLACES if (index.root / place).is_dir()]
    if not bases:
        raise DatasetError(f"expected images/touch/<recording>/frame0000.jpg under {index.root}; is ROOT the folder "
                           "that holds 'images'?")  # fmt: skip
    index.read_contact_list(("contact_visgel.csv", "images/contact_visgel.csv"), "touch")
    for base in bases:
        place = base.relative_to(index.root).as_posix()
        for inside, folders, files in index.walk(base):
            if files and not folders:
                _add_recording(index, place, inside, files)
            elif files:
                index.skip("file that is not a frame by its name", f"{base / inside}/{files[0]}", len(files))


def _add_recording(index: DatasetIndex, place: str, inside: str, files: list[str]) -> None:
    folder, vision = f"{place}/{inside}", f"{place.removesuffix('touch')}vision/{inside}"
    frames = index.numbered(files, r"frame(\d+)\.jpe?g", folder)
    photos = set(index.listing(vision)[1]) if (index.root / vision).is_dir() else set()
    index.skip("photograph missing (kept without)", vision, sum(name not in photos for _, name in frames))
    index.add_recording(
        frames, folder,
        split="test" if "data_unseen" in place else index.split_of(inside),
        key=inside, sensor="gelsight", sequence=folder,
        image_path=[f"{vision}/{name}" if name in photos else None for _, name in frames],
        background_path=f"{folder}/{frames[0][1]}" if frames and frames[0][0] == 0 else None,
    )  # fmt: skip


READER = DatasetReader(
    read,
    url="http://visgel.csail.mit.edu",
    citation="Li et al., Connecting Touch and Vision via Cross-Modal Prediction, CVPR 2019",
    uses=("val", "test", "lists"),
    paper=587_000,
)
