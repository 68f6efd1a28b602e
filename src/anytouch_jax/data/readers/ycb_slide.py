"""YCB-Slide (Suresh et al., CoRL 2022): a DIGIT slid over ten YCB objects, five times 60 s at 30 Hz each.

Seen: the dataset's read-me: `real/<object>/dataset_{0..4}/frames/frame_%07d.jpg`; its licence is MIT. The webcam
pictures are left out, as in the paper, and so is the simulated part.

Neighbouring frames differ too little: a clip takes every third, as AnyTouch does, so every row has stride 3 and keeps
its own number. The object is the group of the hash split (with ten objects a share may stay empty).
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
    hash_split,
    listing,
    numbered,
)

STRIDE = 3


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every recording of every object. Raises DatasetError when there is none."""
    place = next((p for p in ("real", "dataset/real") if (root / p).is_dir()), ".")
    prefix = "" if place == "." else f"{place}/"
    rows = RowBuilder("object", "stride")
    recordings = 0
    for obj in listing(root / place, notes)[0]:
        for name in listing(root / place / obj, notes)[0]:
            frames = f"{obj}/{name}/frames"
            if not name.startswith("dataset_") or not (root / place / frames).is_dir():
                notes.skip("folder that is no dataset_<k>/frames", f"{prefix}{obj}/{name}")
                continue
            recordings += 1
            found = numbered(listing(root / place / frames, notes)[1], r"frame_(\d+)\.jpe?g", notes, frames)
            add_recording(rows, found, f"{prefix}{frames}", split=hash_split("ycb_slide", obj, options),
                          sensor="digit", sequence=f"{obj}/{name}", object=obj, stride=STRIDE)  # fmt: skip
    if not recordings:
        raise DatasetError(f"expected real/<object>/dataset_0/frames/frame_0000000.jpg under {root}; is ROOT the "
                           "folder that holds 'real'?")  # fmt: skip
    return rows.columns()


READER = DatasetReader(
    name="ycb_slide",
    read=read,
    sensor="digit",
    license="MIT",
    commercial=True,
    about="a DIGIT sliding over ten YCB objects",
    url="https://github.com/rpl-cmu/YCB-Slide",
    citation="Suresh et al., MidasTouch: Monte-Carlo inference over distributions across sliding touch, CoRL 2022",
    paper=183_000,
)
