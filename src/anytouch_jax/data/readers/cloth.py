"""Cloth (Yuan et al., ICRA 2018): a robot squeezes 153 pieces of clothing with a GelSight.

Seen in others' code: `Data_ICRA18/Data/<cloth>/<trial>/gelsight_frame/%04d.png` (AnyTouch), the frames taken from
`GelSight_video.mp4` of each trial, or `gsframes/frame%06d.jpg` (T3); `cloth_metadata.json` (AnyTouch 2, T3): eleven
numbers a cloth, in the order of PROPERTIES. No licence is stated. The camera pictures are left out, as in the paper.

The cloth is the group of the hash split. `contact_yuan.csv` marks the contact frames where it is there.
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
    find_file,
    find_folder,
    hash_split,
    listing,
    miss_listed,
    numbered,
    read_json,
)

FOLDERS = ("gelsight_frame", "gsframes")
VIDEO = "GelSight_video.mp4"
PROPERTIES = ("fuzziness", "thickness", "smoothness", "wool", "stretchiness", "endurance", "softness",
              "wind_resistance", "season", "wash_method", "textile_type")  # fmt: skip


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every trial of every cloth, with the cloth's properties as labels where they are there."""
    base = find_folder(root, "Data_ICRA18/Data", "Data")
    place = base.relative_to(root).as_posix()
    table = find_file(["cloth_metadata.json"], options.lists, base.parent, root)
    properties = read_json(table) if table else {}
    if not properties:
        notes.log("no cloth_metadata.json: no labels of the cloth's properties")
    listed = contact_list(root, options, ("contact_yuan.csv", "Data_ICRA18/contact_yuan.csv"), "Data")
    rows = RowBuilder("object", "label.contact", *(f"label.{name}" for name in PROPERTIES))
    found = 0
    for cloth in listing(base, notes)[0]:
        labels = _labels(properties.get(cloth), table, cloth)
        if properties and not labels:
            notes.skip("cloth without properties (kept without labels)", cloth)
        for trial in listing(base / cloth, notes)[0]:
            folders, files = listing(base / cloth / trial, notes)
            inside = next((f"{cloth}/{trial}/{name}" for name in FOLDERS if name in folders), None)
            if inside is None:
                reason = "video that is not unpacked" if VIDEO in files else "trial without frames"
                notes.skip(f"{reason} (expected {FOLDERS[0]}/0000.png)", f"{base / cloth / trial}")
                continue
            frames = numbered(listing(base / inside, notes)[1], r"(?:frame)?(\d+)\.(?:png|jpe?g)", notes, inside)
            split = hash_split("cloth", cloth, options)
            found += add_recording(rows, frames, f"{place}/{inside}", split=split, listed=listed, key=inside,
                                   sensor="gelsight", sequence=f"{cloth}/{trial}", object=cloth, **labels)  # fmt: skip
    miss_listed(notes, listed, found)
    return rows.columns()


def _labels(values: object, table: Path | None, cloth: str) -> dict[str, int]:
    if values is None:
        return {}
    try:
        numbers = [float(value) for value in values if value is not None] if isinstance(values, list) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != len(PROPERTIES) or numbers != [int(number) for number in numbers]:
        raise DatasetError(f"{table}: cloth {cloth!r} must have {len(PROPERTIES)} whole numbers, has {values}")
    return {f"label.{name}": int(number) for name, number in zip(PROPERTIES, numbers, strict=True)}


READER = DatasetReader(
    name="cloth",
    read=read,
    sensor="gelsight",
    license="not stated",
    commercial=False,
    about="a robot squeezing clothes; eleven properties of each as labels",
    url="http://data.csail.mit.edu/active_clothing/Data_ICRA18.tar",
    citation="Yuan et al., Active Clothing Material Perception using Tactile Sensing and Deep Learning, ICRA 2018",
    uses=("val", "test", "lists"),
    paper=587_000,
)
