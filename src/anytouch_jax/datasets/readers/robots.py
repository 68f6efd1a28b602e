"""Touches by robots: VisGel, Cloth, YCB-Slide, Octopi, ObjectFolder 1.0, 2.0 and Real, and Feel.

Objects or recordings are split by hash where a data set has no split. Contact lists of the authors
come from TacQuad's download. ObjectFolder is CC BY 4.0 by its repository, as is assumed for its
real touches.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.images import encode
from anytouch_jax.data.names import natural
from anytouch_jax.datasets.readers import common
from anytouch_jax.datasets.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.files import atomic_write
from anytouch_jax.progress import tracked

VISGEL = (
    "images/touch/",
    "touch/",
    "data_seen/touch/",
    "data_unseen/touch/",
    "images/data_seen/touch/",
    "images/data_unseen/touch/",
)
CLOTH_FRAMES = ("gelsight_frame", "gsframes")
CLOTH_PROPERTIES = (
    "fuzziness",
    "thickness",
    "smoothness",
    "wool",
    "stretchiness",
    "endurance",
    "softness",
    "wind_resistance",
    "season",
    "wash_method",
    "textile_type",
)
LAST_OF_1 = 100
PLACES = ("obj1.0/", "obj2.0/touch/", "touch/", "")
# folder -> (folder, files) of the camera views in it
Views = dict[str, list[tuple[str, list[str]]]]
PHASES = ("before", "during", "after")
IMAGES = {
    **{f"kinectA_rgb_{phase}": (f"vision_{phase}", "") for phase in PHASES},
    **{
        f"gelsight{finger}_{phase}": (f"touch_{phase}", f"_{finger}")
        for phase in PHASES
        for finger in "AB"
    },
}


def _visgel(index: DatasetIndex) -> None:
    """A robot pokes 195 objects with a GelSight while a camera watches.

    AnyTouch's code has the layout of READERS, with the RGB image of the same moment under the same
    path in `vision`. T3 has `data_seen` and `data_unseen` with two levels of folders as downloaded,
    where `frame0000.jpg` is the touch-free reference. Assumed: the same `touch` / `vision` pair
    within these. `data_unseen` is the test part.
    """
    index.read_contact_list(("contact_visgel.csv", "images/contact_visgel.csv"), "touch")
    for place in VISGEL:
        for inside, folders, files in index.walk(place):
            folder = f"{place}{inside}"
            vision = f"{place.removesuffix('touch/')}vision/{inside}"
            if folders:
                index.skip(
                    "file that is not a frame by its name",
                    f"{folder}/{''.join(files[:1])}",
                    len(files),
                )
            elif files:
                frames = index.frames(folder, r"frame(\d+)\.jpe?g", files)
                on_disk = index.listing(vision)[1]
                index.add_recording(
                    frames,
                    folder,
                    split="test" if "data_unseen" in place else index.split_of(inside),
                    key=inside,
                    sensor="gelsight",
                    sequence=folder,
                    image_path=index.rgb_images(vision, frames.values(), set(on_disk)),
                    background_path=f"{folder}/{frames[0]}" if 0 in frames else None,
                )


def _cloth(index: DatasetIndex) -> None:
    """A robot squeezes 153 pieces of clothing with a GelSight; the cloth is the object.

    AnyTouch has the layout of READERS, with the frames of `GelSight_video.mp4` of each trial. T3
    has `gsframes/frame%06d.jpg`. `cloth_metadata.json` (AnyTouch 2, T3) holds the numbers
    CLOTH_PROPERTIES of each cloth.
    """
    base = index.find_folder("Data_ICRA18/Data", "Data")
    if base is None:
        return
    table = index.find_file(["cloth_metadata.json"], base.removesuffix("Data/"), "")
    properties = common.read_json(table) if table else {}
    if not properties:
        index.notes.append("no cloth_metadata.json: no labels of the cloth's properties")
    index.read_contact_list(("contact_yuan.csv", "Data_ICRA18/contact_yuan.csv"), "Data")
    for cloth in index.tracked(index.listing(base)[0]):
        labels = _cloth_labels(properties.get(cloth), table, cloth)
        if properties and not labels:
            index.skip("cloth without properties (kept without labels)", cloth)
        for trial in index.listing(f"{base}{cloth}")[0]:
            folders, files = index.listing(f"{base}{cloth}/{trial}")
            inside = next(
                (f"{cloth}/{trial}/{name}" for name in CLOTH_FRAMES if name in folders), None
            )
            if inside is None:
                reason = (
                    "video that is not unpacked"
                    if "GelSight_video.mp4" in files
                    else "trial without frames"
                )
                index.skip(
                    f"{reason} (expected {CLOTH_FRAMES[0]}/0000.png)", f"{base}{cloth}/{trial}"
                )
                continue
            frames = index.frames(f"{base}{inside}", r"(?:frame)?(\d+)\.(?:png|jpe?g)")
            index.add_recording(
                frames,
                f"{base}{inside}",
                split=index.split_of(cloth),
                key=inside,
                sensor="gelsight",
                sequence=f"{cloth}/{trial}",
                object=cloth,
                **labels,
            )


def _cloth_labels(values: object, table: Path | None, cloth: str) -> dict[str, int]:
    if values is None:
        return {}
    try:
        numbers = [float(value) for value in values] if isinstance(values, list) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != len(CLOTH_PROPERTIES) or not all(number.is_integer() for number in numbers):
        raise DatasetError(
            f"{table}: cloth {cloth!r} must have {len(CLOTH_PROPERTIES)} whole numbers, has "
            f"{values}"
        )
    return {
        f"label.{name}": int(number) for name, number in zip(CLOTH_PROPERTIES, numbers, strict=True)
    }


def _ycb_slide(index: DatasetIndex) -> None:
    """A DIGIT slides over ten YCB objects, five times 60 s at 30 Hz each; with ten objects a split
    may stay empty.

    The layout is that of the dataset's read-me; its simulated part is left out, as in the paper.
    Neighbouring frames differ too little: a clip takes every third, as in AnyTouch, so every row
    has stride 3 and keeps its number.
    """
    base = index.find_folder("real", "dataset/real", "") or ""
    for obj in index.tracked(index.listing(base)[0]):
        for name in index.listing(f"{base}{obj}")[0]:
            folder = f"{base}{obj}/{name}/frames"
            if not name.startswith("dataset_") or not (index.root / folder).is_dir():
                index.skip("folder that is no dataset_<k>/frames", f"{base}{obj}/{name}")
                continue
            index.add_recording(
                index.frames(folder, r"frame_(\d+)\.jpe?g"),
                folder,
                split=index.split_of(obj),
                sensor="digit",
                sequence=f"{obj}/{name}",
                object=obj,
                stride=3,
            )


def _octopi(index: DatasetIndex) -> None:
    """PhysiCLeAR: a GelSight Mini is pressed on and rubbed over 74 everyday objects.

    The authors' script turns 476 videos `dataset/<object>_<k>.mov` into
    `physiclear_<object>_<k>/%010d.jpg` (only frames that move, so numbers have gaps). It writes
    `{train,val,test}_samples.json` (object -> folders), whose folder names give the split if all
    three exist. AnyTouch calls the output folder `processed`.
    """
    base = index.find_folder("processed", "") or ""
    index.read_contact_list(
        ("contact_text_octopi.csv", "contact_octopi.csv", "contact.csv"), "processed"
    )
    lists = [(part, index.find_file([f"{part}_samples.json"], base, "")) for part in common.PARTS]
    paths = [(part, path) for part, path in lists if path]
    splits: dict[str, str] = {}
    if len(paths) == len(common.PARTS):
        folders = {
            part: [f for fs in common.read_json(path, list).values() for f in fs]
            for part, path in paths
        }
        name_of = lambda folder: Path(str(folder).replace("\\", "/")).name  # noqa: E731
        splits = common.published_splits(paths[0][1].with_name("*_samples.json"), folders, name_of)
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
        index.add_recording(
            frames,
            f"{base}{sample}",
            key=sample,
            sensor="gelsight_mini",
            sequence=sample,
            object=obj,
            split=splits.get(sample, "unused") if splits else index.split_of(obj),
            caption_id=captions,
        )
    gone = sorted(splits.keys() - {*index.listing(base)[0]})
    index.skip_all("sample of *_samples.json that is not on disk", gone)


def _rendered(index: DatasetIndex) -> None:
    """Touches rendered by TACTO (1.0) and Taxim (2.0), two sensors that the paper never trains on.

    AnyTouch's code has `obj1.0/<id>/<n>.png` and `obj2.0/touch/<id>/<n>.png`, with
    `obj2.0/label.json` (id -> material number, without names) and `obj2.0/split.json` (train, test:
    lists of [id, n]) for both. Ids up to 100 are 1.0, and 2.0 leaves them out. The split is the
    benchmark's and by image, so an object is in train and test. Every image is a sequence.
    Images in no list are `unused`. Raises DatasetError without label.json or split.json.
    """
    ids = {
        place: [name for name in index.listing(place, count=False)[0] if name.isdecimal()]
        for place in PLACES
    }
    ids = {place: names for place, names in ids.items() if names}
    if not ids:
        return
    labels, splits = _objectfolder_lists(index)
    for place, names in ids.items():
        for name in index.tracked(names):
            folder = f"{place}{name}"
            number = int(name)
            first = int(name) <= LAST_OF_1
            if (place.endswith("touch/") and first) or (place == "obj1.0/" and not first):
                index.skip(
                    f"id that does not belong to {place.rstrip('/')} (1.0 ends at {LAST_OF_1})",
                    folder,
                )
                continue
            frames = index.frames(folder)
            index.add(
                [f"{folder}/{file}" for file in frames.values()],
                sensor="tacto" if first else "taxim",
                frame_index=0,
                dataset="objectfolder1" if first else "objectfolder2",
                sequence=[f"{name}/{n}" for n in frames],
                split=[splits.pop((number, n), "unused") for n in frames],
                object=name,
                **{"label.material": labels.get(number)},
            )
            index.skip("id without a label (kept without)", folder, number not in labels)
    index.skip("image of split.json that is not on disk", str(next(iter(splits), "")), len(splits))


def _objectfolder_lists(index: DatasetIndex) -> tuple[dict[int, int], dict[tuple[int, int], str]]:
    """Return id -> material number, and (id, n) -> split."""
    tables: list[dict[str, Any]] = []
    paths = []
    for name in ("label.json", "split.json"):
        path = index.find_file([name], "obj2.0", "")
        if path is None:
            raise DatasetError(
                f"expected {name} in {index.root} or its folder obj2.0, or in the folder of --lists"
            )
        paths.append(path)
        tables.append(common.read_json(path))
    try:
        labels = {int(name): int(value) for name, value in tables[0].items()}
        splits = common.published_splits(
            paths[1], tables[1], lambda pair: (int(pair[0]), int(pair[1]))
        )
    except (TypeError, ValueError) as error:
        raise DatasetError(
            f"{' or '.join(map(str, paths))} is not as expected (id -> number; train, test: "
            f"lists of [id, number]): {error}"
        ) from None
    return labels, splits


def _real(index: DatasetIndex) -> None:
    """A robot touches 100 household objects with a GelSlim: every folder called `gelsight` is a
    recording.

    T3 and Sparsh have `<object>/tactile_data/<trial>/0/gelsight/<n>.png`, AnyTouch the same under
    `tactile/`. T3 has `objectfolder_real_metadata.csv` with Index,Name,Material. The authors'
    `contact_text_obj.csv` has touch frame, RGB image and caption number, where both paths start
    below `tactile/`. The names of the two camera folders are unknown. Assumed: they are siblings of
    `gelsight` with the same numbers. The first two by name are `image_path` and `image2_path`,
    unless the list names the RGB image. The object is the first number in the path.
    """
    base = index.find_folder("tactile", "real/tactile", "") or ""
    table = index.find_file(["objectfolder_real_metadata.csv"])
    objects = {row["Index"]: row for row in common.read_table(table, "Index")} if table else {}
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
    for folder, files in (
        view for parent, siblings in views.items() if parent not in parents for view in siblings
    ):
        index.skip(
            "file outside a folder 'gelsight' and its siblings", f"{folder}/{files[0]}", len(files)
        )
    for inside, files in recordings:
        frames = index.frames(f"{base}{inside}", files=files)
        obj = next((part for part in inside.split("/") if part.isdecimal()), inside.split("/")[0])
        metadata = objects.get(obj, {})
        photos = [photo.rpartition("tactile/")[2] for photo in index.listed(inside, frames, 1)]
        captions = index.listed(inside, frames, 2)
        missing = sum(bool(photo) and photo not in on_disk for photo in photos)
        index.skip("listed RGB image that is not on disk (kept without)", inside, missing)
        first, second = _camera_views(index, base, views[inside.rpartition("/")[0]], list(frames))
        listed = [f"{base}{photo}" if photo in on_disk else None for photo in photos]
        index.add_recording(
            frames,
            f"{base}{inside}",
            split=index.split_of(obj),
            key=inside,
            sensor="gelslim",
            sequence=inside.removesuffix("/gelsight"),
            object=obj,
            image_path=[a or b for a, b in zip(listed, first, strict=True)],
            image2_path=second,
            caption_id=[f"obj_{caption}" if caption else None for caption in captions],
            **{"label.material": metadata.get("Material"), "label.object": metadata.get("Name")},
        )


def _camera_views(
    index: DatasetIndex, base: str, siblings: list[tuple[str, list[str]]], numbers: list[int]
) -> list[list[str | None]]:
    """Return the images of the first two camera views (by name) with the numbers of the touch
    frames, else None.
    """
    views: list[list[str | None]] = []
    for folder, files in sorted(siblings):
        names = index.frames(folder, common.NUMBERED, files, count=False)
        views.append([f"{base}{folder}/{names[n]}" if n in names else None for n in numbers])
    return ([view for view in views if any(view)] + [[None] * len(numbers)] * 2)[:2]


def _feel(index: DatasetIndex) -> None:
    """Grasps with two GelSight fingers: `<object>/touch_{before,during,after}/<n>_{A,B}.png`,
    `vision_{...}/<n>.png`.

    `feel.csv` has no header: object, n, success. `split_<k>.npy` is a pickled dict of train and
    test object lists, as `split_<k>.json` may be; without either the split is by hash. The original
    files are `calandra_corl2017_*.h5`, of which `export` writes the images as PNG (needs `pip
    install h5py`). Raises DatasetError for them without it.

    * The split of a `during` frame is its object's. `before` (open fingers) is background, and the
      background of the others. `after` shows the outcome and is `unused`. Every frame is a
      sequence: no clip spans the phases.
    * `grasp_group` is the grasp, the same for both fingers (`unit` A and B). They press opposite
      sides and not one place, so it is no `touch`, and nothing is matched by it.
    """
    base = index.find_folder("feel", "", inside=("feel.csv",))
    if base is None:
        original = [name for name in index.listing("")[1] if name.endswith(".h5")]
        if not original:
            return
        index.need_export(f"{len(original)} original .h5 files and no feel.csv")
        count = export_grasps(index.root, original)
        index.notes.append(f"{count} grasps written from {len(original)} .h5 files")
        base = ""
    splits = _splits_of_fold(index, base)
    table = index.root / base / "feel.csv"
    files: dict[str, set[str]] = {}
    for line, row in tracked(common.read_lines(table), "rows read"):
        if len(row) != 3 or not row[1].isdecimal() or row[2] not in ("0", "1"):
            raise DatasetError(
                f"{table}, line {line}: expected object,number,0 or 1, found {','.join(row)}"
            )
        name = row[0]
        if name not in files:
            folders = index.listing(f"{base}{name}")[0]
            files[name] = {
                f"{sub}/{file}"
                for sub in folders
                for file in index.listing(f"{base}{name}/{sub}")[1]
            }
        if splits is not None and name not in splits:
            index.skip(
                f"grasp of an object that is in no list of split {index.options.fold} (split "
                "unused)",
                name,
            )
        split = index.split_of(name) if splits is None else splits.get(name, "unused")
        _add_grasp(index, f"{base}{name}", name, int(row[1]), int(row[2]), split, files[name])


def _add_grasp(
    index: DatasetIndex,
    folder: str,
    name: str,
    number: int,
    success: int,
    split: str,
    files: set[str],
) -> None:
    grasp = f"{name}/{number}"
    for finger in "AB":
        before = f"touch_before/{number}_{finger}.png"
        for phase, part in zip(PHASES, ("background", split, "unused"), strict=True):
            file = f"touch_{phase}/{number}_{finger}.png"
            photo = f"vision_{phase}/{number}.png"
            if file not in files:
                index.skip("image of feel.csv that is not on disk", f"{folder}/{file}")
                continue
            index.add(
                [f"{folder}/{file}"],
                sensor="gelsight",
                unit=finger,
                sequence=f"{grasp}/{phase}/{finger}",
                frame_index=0,
                split=part,
                object=name,
                grasp_group=grasp if phase == "during" else None,
                image_path=f"{folder}/{photo}" if photo in files else None,
                background_path=f"{folder}/{before}" if before in files else None,
                **{
                    "label.success": success if phase == "during" else None,
                    "label.contact": 0 if phase == "before" else None,
                },
            )


def _splits_of_fold(index: DatasetIndex, base: str) -> dict[str, str] | None:
    """Return object -> split from split_<fold>.json or .npy, None without a file."""
    fold = index.options.fold
    path = index.find_file([f"split_{fold}.json", f"split_{fold}.npy"], base)
    if path is None and fold:
        raise DatasetError(
            f"there is no split_{fold}.npy or .json for --fold {fold} in {index.root / base}"
        )
    if path is None:
        index.notes.append(f"no split_{fold}.npy or .json: split by hash of the object")
        return None
    table: Any = (
        common.read_json(path) if path.suffix == ".json" else np.ravel(common.read_pickle(path))[0]
    )
    lists = (
        table.values() if isinstance(table, dict) and {"train", "test"} <= table.keys() else [None]
    )
    if not all(isinstance(names, list) for names in lists):
        raise DatasetError(f"{path}: expected the lists 'train' and 'test' of object names")
    return common.published_splits(path, table)


def export_grasps(root: Path, names: Sequence[str]) -> int:
    """Write the grasps of HDF5 files as PNG, feel.csv last, and return their number.

    Raises DatasetError.
    """
    try:
        import h5py  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        raise DatasetError(
            'the original files of Feel are HDF5; run pip install "anytouch_jax[hdf5]"'
        ) from None
    lines: list[list[Any]] = []
    numbers: dict[str, int] = {}
    for name in tracked(sorted(names, key=natural), "files read"):
        try:
            with h5py.File(root / name, "r") as file:
                for grasp in _grasps(file):
                    # stored as data sets or as attributes
                    names_of = ("object_name", "is_gripping")
                    obj, success = (
                        grasp[key][()] if key in grasp else grasp.attrs[key] for key in names_of
                    )
                    obj = _object_name(obj)
                    number = numbers[obj] = numbers.get(obj, -1) + 1
                    for key in IMAGES.keys() & grasp.keys():
                        sub, ending = IMAGES[key]
                        _save_once(
                            root / obj / sub / f"{number}{ending}.png", np.asarray(grasp[key][()])
                        )
                    lines.append([obj, number, int(np.ravel(success)[0])])
        except (OSError, KeyError, ValueError) as error:
            raise DatasetError(f"{root / name} is not a file of Feel: {error}") from None
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    atomic_write(root / "feel.csv", text.getvalue())
    return len(lines)


def _save_once(file: Path, image: np.ndarray) -> None:
    """Write an image RGB u8 (h, w, 3) as PNG. Raises ValueError for a file that has another."""
    data = encode(np.ascontiguousarray(image))
    if not file.is_file():
        atomic_write(file, data, sync=False)
    elif file.read_bytes() != data:
        raise ValueError(f"{file} holds another image; move it elsewhere")


def _grasps(group: Any) -> Iterator[Any]:
    """Yield every group with the images of a grasp, at any depth."""
    if "gelsightA_during" in group:
        yield group
        return
    for key in sorted(group, key=natural):
        if hasattr(group[key], "keys"):
            yield from _grasps(group[key])


def _object_name(value: Any) -> str:
    """Return the name of an object as a folder, from text, bytes or an array of codes."""
    array = np.asarray(value)
    data = array.item() if array.size == 1 else array.astype(np.uint8).tobytes()
    text = data.decode() if isinstance(data, bytes) else str(data)
    name = text.rstrip("\0").strip().replace("/", "_").replace("\\", "_")
    if name.strip(".") == "":
        raise ValueError(f"a grasp has the object name {text!r}")
    return name


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
        "Yuan et al., Active Clothing Material Perception using Tactile Sensing and Deep Learning, "
        "ICRA 2018",
        url="http://data.csail.mit.edu/active_clothing/Data_ICRA18.tar",
        uses=("val", "test", "lists"),
        paper=587_000,
    ),
    "ycb_slide": DatasetReader(
        _ycb_slide,
        "real/<object>/dataset_0/frames/frame_0000000.jpg",
        "Suresh et al., MidasTouch: Monte-Carlo inference over distributions across sliding touch, "
        "CoRL 2022",
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
    "objectfolder": DatasetReader(
        _rendered,
        "obj1.0/<id>/<n>.png or obj2.0/touch/<id>/<n>.png",
        "Gao et al., ObjectFolder, CoRL 2021; ObjectFolder 2.0, CVPR 2022",
        "CC-BY-4.0",
        "https://github.com/rhgao/ObjectFolder",
        uses=("lists",),
    ),
    "objectfolder_real": DatasetReader(
        _real,
        "tactile/<object>/<trial>/gelsight/<n>.png",
        "Gao et al., The ObjectFolder Benchmark: Multisensory Learning with Neural and Real "
        "Objects, CVPR 2023",
        "CC-BY-4.0",
        "https://objectfolder.stanford.edu/objectfolder-real-download",
        uses=("val", "test", "lists"),
        paper=1_165_000,
    ),
    "feel": DatasetReader(
        _feel,
        "feel.csv and <object>/touch_during/0_A.png",
        "Calandra et al., The Feeling of Success: Does Touch Sensing Help Predict Grasp Outcomes?, "
        "CoRL 2017",
        url="https://sites.google.com/view/the-feeling-of-success",
        uses=("val", "test", "lists", "fold", "export"),
    ),
}
