"""Cloth (Yuan et al., ICRA 2018): a robot squeezes 153 pieces of clothing with a GelSight.

Layout in others' code: `Data_ICRA18/Data/<cloth>/<trial>/gelsight_frame/%04d.png` (AnyTouch), with the frames of
`GelSight_video.mp4` of each trial, or `gsframes/frame%06d.jpg` (T3). `cloth_metadata.json` (AnyTouch 2, T3) holds
eleven numbers for each cloth, in the order of PROPERTIES. No licence is stated. The camera pictures are left out, as
in the paper.

The cloth is the group of the hash split. `contact_yuan.csv` marks the contact frames.
"""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_json

FOLDERS = ("gelsight_frame", "gsframes")
VIDEO = "GelSight_video.mp4"
PROPERTIES = ("fuzziness", "thickness", "smoothness", "wool", "stretchiness", "endurance", "softness",
              "wind_resistance", "season", "wash_method", "textile_type")  # fmt: skip


def read(index: DatasetIndex) -> None:
    """Add every trial of every cloth, with the cloth's properties as labels if they are known."""
    base = index.find_folder("Data_ICRA18/Data", "Data")
    prefix = index.prefix(base)
    table = index.find_file(["cloth_metadata.json"], base.parent, index.root)
    properties = read_json(table) if table else {}
    if not properties:
        index.notes.append("no cloth_metadata.json: no labels of the cloth's properties")
    index.read_contact_list(("contact_yuan.csv", "Data_ICRA18/contact_yuan.csv"), "Data")
    for cloth in index.listing(base)[0]:
        labels = _labels(properties.get(cloth), table, cloth)
        if properties and not labels:
            index.skip("cloth without properties (kept without labels)", cloth)
        for trial in index.listing(base / cloth)[0]:
            folders, files = index.listing(base / cloth / trial)
            inside = next((f"{cloth}/{trial}/{name}" for name in FOLDERS if name in folders), None)
            if inside is None:
                reason = "video that is not unpacked" if VIDEO in files else "trial without frames"
                index.skip(f"{reason} (expected {FOLDERS[0]}/0000.png)", f"{base / cloth / trial}")
                continue
            frames = index.numbered(index.listing(base / inside)[1], r"(?:frame)?(\d+)\.(?:png|jpe?g)", inside)
            index.add_recording(frames, f"{prefix}{inside}", split=index.split_of(cloth), key=inside,
                                sensor="gelsight", sequence=f"{cloth}/{trial}", object=cloth, **labels)  # fmt: skip


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
    read,
    url="http://data.csail.mit.edu/active_clothing/Data_ICRA18.tar",
    citation="Yuan et al., Active Clothing Material Perception using Tactile Sensing and Deep Learning, ICRA 2018",
    uses=("val", "test", "lists"),
    paper=587_000,
)
