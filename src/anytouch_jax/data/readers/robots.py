"""Datasets in which a robot makes recordings of numbered frames, one folder each: VisGel, Cloth, YCB-Slide, Octopi.

All have a hash split of objects or recordings, where they have no split themselves. Contact lists of the authors come
from TacQuad's download. Only VisGel's photographs are used, as in the paper.
"""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.data.readers.common import (
    PARTS,
    DatasetError,
    DatasetIndex,
    DatasetReader,
    published_splits,
    read_json,
)

VISGEL = ("images/touch/", "touch/", "data_seen/touch/", "data_unseen/touch/", "images/data_seen/touch/",
          "images/data_unseen/touch/")  # fmt: skip
CLOTH_FRAMES = ("gelsight_frame", "gsframes")
CLOTH_PROPERTIES = ("fuzziness", "thickness", "smoothness", "wool", "stretchiness", "endurance", "softness",
                    "wind_resistance", "season", "wash_method", "textile_type")  # fmt: skip


def _visgel(index: DatasetIndex) -> None:
    """A robot pokes 195 objects with a GelSight while a camera watches.

    AnyTouch's code has the layout of READERS, with the photograph of the same moment under the same path in `vision`.
    T3 has `data_seen` and `data_unseen` with two levels of folders as downloaded, where `frame0000.jpg` is the
    touch-free reference. Assumed: the same `touch` / `vision` pair within these. `data_unseen` is the test part.
    """
    index.read_contact_list(("contact_visgel.csv", "images/contact_visgel.csv"), "touch")
    for place in (place for place in VISGEL if (index.root / place).is_dir()):
        for inside, folders, files in index.walk(place):
            folder, vision = f"{place}{inside}", f"{place.removesuffix('touch/')}vision/{inside}"
            if folders:
                index.skip("file that is not a frame by its name", f"{folder}/{''.join(files[:1])}", len(files))
            elif files:
                frames = index.frames(folder, r"frame(\d+)\.jpe?g", files)
                on_disk = index.listing(vision)[1] if (index.root / vision).is_dir() else []
                index.add_recording(
                    frames, folder,
                    split="test" if "data_unseen" in place else index.split_of(inside),
                    key=inside, sensor="gelsight", sequence=folder,
                    image_path=index.photographs(vision, frames.values(), set(on_disk)),
                    background_path=f"{folder}/{frames[0]}" if 0 in frames else None,
                )  # fmt: skip


def _cloth(index: DatasetIndex) -> None:
    """A robot squeezes 153 pieces of clothing with a GelSight; the cloth is the object.

    AnyTouch has the layout of READERS, with the frames of `GelSight_video.mp4` of each trial. T3 has
    `gsframes/frame%06d.jpg`. `cloth_metadata.json` (AnyTouch 2, T3) holds the numbers CLOTH_PROPERTIES of each cloth.
    """
    base = index.find_folder("Data_ICRA18/Data", "Data")
    if base is None:
        return
    table = index.find_file(["cloth_metadata.json"], base.removesuffix("Data/"), "")
    properties = read_json(table) if table else {}
    if not properties:
        index.notes.append("no cloth_metadata.json: no labels of the cloth's properties")
    index.read_contact_list(("contact_yuan.csv", "Data_ICRA18/contact_yuan.csv"), "Data")
    for cloth in index.tracked(index.listing(base)[0]):
        labels = _cloth_labels(properties.get(cloth), table, cloth)
        if properties and not labels:
            index.skip("cloth without properties (kept without labels)", cloth)
        for trial in index.listing(f"{base}{cloth}")[0]:
            folders, files = index.listing(f"{base}{cloth}/{trial}")
            inside = next((f"{cloth}/{trial}/{name}" for name in CLOTH_FRAMES if name in folders), None)
            if inside is None:
                reason = "video that is not unpacked" if "GelSight_video.mp4" in files else "trial without frames"
                index.skip(f"{reason} (expected {CLOTH_FRAMES[0]}/0000.png)", f"{base}{cloth}/{trial}")
                continue
            frames = index.frames(f"{base}{inside}", r"(?:frame)?(\d+)\.(?:png|jpe?g)")
            index.add_recording(frames, f"{base}{inside}", split=index.split_of(cloth), key=inside,
                                sensor="gelsight", sequence=f"{cloth}/{trial}", object=cloth, **labels)  # fmt: skip


def _cloth_labels(values: object, table: Path | None, cloth: str) -> dict[str, int]:
    if values is None:
        return {}
    try:
        numbers = [float(value) for value in values] if isinstance(values, list) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != len(CLOTH_PROPERTIES) or not all(number.is_integer() for number in numbers):
        raise DatasetError(f"{table}: cloth {cloth!r} must have {len(CLOTH_PROPERTIES)} whole numbers, has {values}")
    return {f"label.{name}": int(number) for name, number in zip(CLOTH_PROPERTIES, numbers, strict=True)}


def _ycb_slide(index: DatasetIndex) -> None:
    """A DIGIT slides over ten YCB objects, five times 60 s at 30 Hz each; with ten objects a split may stay empty.

    The layout is that of the dataset's read-me; its simulated part is left out, as in the paper. Neighbouring frames
    differ too little: a clip takes every third, as in AnyTouch, so every row has stride 3 and keeps its number.
    """
    base = index.find_folder("real", "dataset/real", "") or ""
    for obj in index.tracked(index.listing(base)[0]):
        for name in index.listing(f"{base}{obj}")[0]:
            folder = f"{base}{obj}/{name}/frames"
            if not name.startswith("dataset_") or not (index.root / folder).is_dir():
                index.skip("folder that is no dataset_<k>/frames", f"{base}{obj}/{name}")
                continue
            index.add_recording(index.frames(folder, r"frame_(\d+)\.jpe?g"), folder, split=index.split_of(obj),
                                sensor="digit", sequence=f"{obj}/{name}", object=obj, stride=3)  # fmt: skip


def _octopi(index: DatasetIndex) -> None:
    """PhysiCLeAR: a GelSight Mini is pressed on and rubbed over 74 everyday objects.

    The authors' script turns 476 videos `dataset/<object>_<k>.mov` into `physiclear_<object>_<k>/%010d.jpg` (only
    frames that move, so numbers have gaps). It writes `{train,val,test}_samples.json` (object -> folders), whose folder
    names give the split if all three exist. AnyTouch calls the output folder `processed`.
    """
    base = index.find_folder("processed", "") or ""
    index.read_contact_list(("contact_text_octopi.csv", "contact_octopi.csv", "contact.csv"), "processed")
    lists = [(part, index.find_file([f"{part}_samples.json"], base, "")) for part in PARTS]
    paths = [(part, path) for part, path in lists if path]
    splits: dict[str, str] = {}
    if len(paths) == len(PARTS):
        folders = {part: [f for fs in read_json(path, list).values() for f in fs] for part, path in paths}
        name_of = lambda folder: Path(str(folder).replace("\\", "/")).name  # noqa: E731
        splits = published_splits(paths[0][1].with_name("*_samples.json"), folders, name_of)
    else:
        index.notes.append("no train_, val_ and test_samples.json: split by hash of the object")
    for sample in index.tracked(index.listing(base)[0]):
        files = index.listing(f"{base}{sample}")[1]
        if not files:
            index.skip("folder without files", f"{base}{sample}")
            continue
        frames = index.frames(f"{base}{sample}", files=files)
        obj = sample.removeprefix("physiclear_").rpartition("_")[0] or sample
        if splits and sample not in splits:
            index.skip("sample in no *_samples.json (split unused)", sample)
        captions = [f"octopi_{cell}" if cell else None for cell in index.listed(sample, frames, 1)]
        index.add_recording(frames, f"{base}{sample}", key=sample, sensor="gelsight_mini", sequence=sample, object=obj,
                            split=splits.get(sample, "unused") if splits else index.split_of(obj),
                            caption_id=captions)  # fmt: skip
    gone = sorted(splits.keys() - {*index.listing(base)[0]})
    index.skip("sample of *_samples.json that is not on disk", "".join(gone[:1]), len(gone))


READERS = {
    "visgel": DatasetReader(
        _visgel,
        "images/touch/<recording>/frame0000.jpg",
        "Li et al., Connecting Touch and Vision via Cross-Modal Prediction, CVPR 2019",
        url="http://visgel.csail.mit.edu",
        uses=("val", "test", "lists"),
        paper=587_000,
    ),
    "cloth": DatasetReader(
        _cloth,
        "Data_ICRA18/Data/<cloth>/<trial>/gelsight_frame/0000.png",
        "Yuan et al., Active Clothing Material Perception using Tactile Sensing and Deep Learning, ICRA 2018",
        url="http://data.csail.mit.edu/active_clothing/Data_ICRA18.tar",
        uses=("val", "test", "lists"),
        paper=587_000,
    ),
    "ycb_slide": DatasetReader(
        _ycb_slide,
        "real/<object>/dataset_0/frames/frame_0000000.jpg",
        "Suresh et al., MidasTouch: Monte-Carlo inference over distributions across sliding touch, CoRL 2022",
        "MIT",
        "https://github.com/rpl-cmu/YCB-Slide",
        paper=183_000,
    ),
    "octopi": DatasetReader(
        _octopi,
        "processed/<sample>/0000000000.jpg, as Octopi's process_dataset.py writes it,",
        "Yu et al., Octopi: Object Property Reasoning with Large Tactile-Language Models, RSS 2024",
        url="https://github.com/clear-nus/octopi",
        uses=("val", "test", "lists"),
        paper=39_000,
    ),
}
