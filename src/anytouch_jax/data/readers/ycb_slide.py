"""YCB-Slide (Suresh et al., CoRL 2022): a DIGIT slides over ten YCB objects, five times 60 s at 30 Hz each.

Layout (the dataset's read-me): `real/<object>/dataset_{0..4}/frames/frame_%07d.jpg`. The licence is MIT. The webcam
pictures are left out, as in the paper, and so is the simulated part.

Neighbouring frames differ too little. A clip takes every third, as in AnyTouch, so every row has stride 3 and keeps
its number. The object is the group of the hash split. With ten objects a share may stay empty.
"""

from __future__ import annotations

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader

STRIDE = 3


def read(index: DatasetIndex) -> None:
    """Add every recording of every object. Raises DatasetError if there is none."""
    base = next((index.root / place for place in ("real", "dataset/real") if (index.root / place).is_dir()), index.root)
    prefix, recordings = index.prefix(base), 0
    for obj in index.listing(base)[0]:
        for name in index.listing(base / obj)[0]:
            folder = f"{obj}/{name}/frames"
            if not name.startswith("dataset_") or not (base / folder).is_dir():
                index.skip("folder that is no dataset_<k>/frames", f"{prefix}{obj}/{name}")
                continue
            recordings += 1
            frames = index.numbered(index.listing(base / folder)[1], r"frame_(\d+)\.jpe?g", folder)
            index.add_recording(frames, f"{prefix}{folder}", split=index.split_of(obj), sensor="digit",
                                sequence=f"{obj}/{name}", object=obj, stride=STRIDE)  # fmt: skip
    if not recordings:
        raise DatasetError(f"expected real/<object>/dataset_0/frames/frame_0000000.jpg under {index.root}; is ROOT the "
                           "folder that holds 'real'?")  # fmt: skip


READER = DatasetReader(
    read,
    license="MIT",
    url="https://github.com/rpl-cmu/YCB-Slide",
    citation="Suresh et al., MidasTouch: Monte-Carlo inference over distributions across sliding touch, CoRL 2022",
    paper=183_000,
)
