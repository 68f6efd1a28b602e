"""Touches with measured forces and poses: TacBench as Sparsh publishes it, ToucHD-Force,
FreeTacMan.

Layouts are those of public code: the loaders of github.com/facebookresearch/sparsh
(`data/digit/utils.py` and its read-me) and `data/downstream_dataset.py` of
github.com/GeWu-Lab/AnyTouch2. That of FreeTacMan is in `start_collect.py` and `pose_to_joint.py` of
github.com/OpenDriveLab/FreeTacMan. Its data set card has the names of files.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.images import ImageError
from anytouch_jax.data.manifest.schema import is_text, read_text_csv, typed_label
from anytouch_jax.datasets.readers import common
from anytouch_jax.datasets.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.datasets.readers.exports import Export, export_video, exported

_SPARSH = (
    "Higuera et al., Sparsh: Self-supervised touch representations for vision-based tactile "
    "sensing, CoRL 2024"
)
_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}
TEST_BATCHES = ("flat/batch_1",)  # the tests of Sparsh's configuration
# of AnyTouch 2's probe of ToucHD
TEST_OBJECTS = (18, 22, 61)
TRAIN_OBJECTS = (6, 41, 52, 53, 59, 69, 70)


def _force(index: DatasetIndex) -> None:
    """Presses and slides of three indenters on DIGIT and GelSight Mini:
    <indenter>/batch_<k>/dataset_<sensor>_<n>.pkl.

    `dataset_slip_forces.pkl` has for each slide the frames (`indexes`), forces in newtons and slip.
    Frames outside slides are unused, and the first free one is the background. The test is
    Sparsh's: flat/batch_1.
    """
    folders = [folder for folder, _, files in index.walk() if "dataset_slip_forces.pkl" in files]
    if folders:
        index.need_export(f"{len(folders)} batches of TacBench in pickles")
    for folder in index.tracked(folders):
        files = [
            name
            for name in index.listing(folder)[1]
            if re.match(r"dataset_(digit|gelsight)_\d+\.pkl", name)
        ]
        frames = [frame for name in files for frame in _list(index.root / folder / name)]
        content = common.read_pickle(index.root / folder / "dataset_slip_forces.pkl")
        slides = content.get("trajectories", content) if isinstance(content, dict) else None
        if not isinstance(slides, dict) or not files:
            raise DatasetError(
                f"{index.root / folder} has no slides or no frames; download it again"
            )
        sources = [index.root / folder / name for name in files]
        with exported(index, f"{folder}/frames", "frames", sources) as images:
            written = enumerate(index.tracked(frames, "frames written"))
            names = [_image(images, frame, f"{i:06d}", sources[0]) for i, frame in written]
        names = [f"{images.folder}/{name}" for name in names]
        contact = np.ravel(content.get("in_contact", np.ones(len(names))))
        free = np.flatnonzero(contact == 0)
        gel = names[int(free[0])] if len(free) and free[0] < len(names) else None
        sensor = "digit" if "digit" in files[0] else "gelsight_mini"
        cells = {
            "sensor": sensor,
            "object": folder.split("/")[-2] if "/" in folder else folder,
            "background_path": gel,
        }
        part = "test" if folder.endswith(TEST_BATCHES) else "train"
        used = set()
        for name, slide in slides.items():
            try:
                where = np.ravel(slide["indexes"]).astype(int)
                force = np.asarray(slide["forces"], float).reshape(len(where), -1)
                slip = np.ravel(slide["slip_label"])
                if (
                    where.min(initial=0) < 0
                    or where.max(initial=0) >= len(names)
                    or force.shape[1] < 3
                ):
                    raise ValueError("frames or forces are missing")
            except (KeyError, TypeError, ValueError, IndexError) as error:
                raise DatasetError(
                    f"{index.root / folder}, slide {name}: {error} does not fit; download it"
                ) from None
            slips = [int(slip[i]) if i < len(slip) else None for i in range(len(where))]
            index.skip(
                "frame of a slide without slip", f"{folder}, slide {name}", slips.count(None)
            )
            used.update(where.tolist())
            index.add(
                [names[i] for i in where],
                sequence=f"{folder}/{name}",
                frame_index=where.tolist(),
                split=part,
                **cells,
                **{"label.slip": slips, "label.contact": 1},
                **{f"label.force_{axis}": force[:, i].tolist() for i, axis in enumerate("xyz")},
            )
        rest = [i for i in range(len(names)) if i not in used]
        index.add(
            [names[i] for i in rest],
            sequence=f"{folder}/rest",
            frame_index=rest,
            split="unused",
            **cells,
        )


def _pose(index: DatasetIndex) -> None:
    """A hand of three DIGITs on an object that is moved: {train,test}/<object>/bag_<n>.pkl.

    Labels are the change of pose over five frames that Sparsh sorts into classes: `t_x`, `t_y` and
    `yaw` in degrees, as its code names them. Backgrounds are bgs/digit_<finger>.png.
    """
    for part in ("train", "test"):
        for folder, _, files in index.walk(f"{part}/"):
            bags = [name for name in files if name.endswith(".pkl")]
            if bags:
                index.need_export(f"{len(bags)} bags of TacBench in pickles")
            for bag in index.tracked(bags, "files read"):
                _add_bag(index, part, folder, bag)


def _add_bag(index: DatasetIndex, part: str, folder: str, bag: str) -> None:
    path = index.root / part / folder / bag
    content = common.read_pickle(path)
    for finger in ("index", "middle", "ring"):
        try:
            frames = content[f"digit_{finger}"]
            poses = np.asarray(content[f"object_{finger}_rel_pose_n5"], float)
            count = min(len(frames), len(poses))
            turns = poses[:count, :3, :3]
            shifts = poses[:count, :3, 3]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}: {error} is missing or of an odd shape; download it again"
            ) from None
        index.leave_out(
            "frame or pose without the other", f"{path}, {finger}", abs(len(frames) - len(poses))
        )
        name = f"{part}/{folder}/{bag.removesuffix('.pkl')}/{finger}"
        with exported(index, name, finger, [path]) as images:
            written = index.tracked(range(count), "frames written")
            names = [_image(images, frames[i], f"{i:06d}", path) for i in written]
        names = [f"{images.folder}/{one}" for one in names]
        gel = f"bgs/digit_{finger}.png"
        # the last of Euler's angles "xyz"
        yaw = np.degrees(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))
        index.add(
            names,
            sensor="digit",
            unit=finger,
            sequence=name,
            frame_index=list(range(count)),
            split=part,
            object=folder.split("/")[-1],
            background_path=gel if (index.root / gel).is_file() else None,
            **{
                "label.t_x": shifts[:, 1].tolist(),
                "label.t_y": shifts[:, 0].tolist(),
                "label.yaw": yaw.tolist(),
            },
        )


def _list(path: Path) -> list[Any]:
    frames = common.read_pickle(path)
    if not isinstance(frames, list):
        raise DatasetError(f"{path} is no list of images; download it again")
    return frames


def _image(images: Export, frame: Any, name: str, path: Path) -> str:
    """Write a frame of a pickle, an encoded image or an array, and return the name of its
    file.
    """
    if isinstance(frame, bytes):
        name += next((end for magic, end in _MAGIC.items() if frame.startswith(magic)), ".png")
        images.save(name, frame)
        return name
    image = np.asarray(frame)
    if image.dtype != np.uint8 or image.ndim != 3:
        raise DatasetError(f"frame {name} of {path} is no image; download the data again")
    images.save(f"{name}.png", image)
    return f"{name}.png"


def _touchd(index: DatasetIndex) -> None:
    """ToucHD's forces: <obj41_speed..>/<sensor>/image_<n>.png and all_data_direction.json.

    The table has [number, f_x, f_y, f_z] of every image of an object, speed and sensor. f_z is
    turned, so that pressing is positive. image_1 is the background. Objects of AnyTouch 2's probe
    keep its split, others are by hash.
    """
    table = index.find_file(["all_data_direction.json"])
    if table is None:
        return
    for folder, sensors in index.tracked(common.read_json(table, dict).items()):
        number = re.search(r"obj(\d+)", folder.split("_speed")[0])
        known = int(number[1]) if number else -1
        split = "test" if known in TEST_OBJECTS else "train" if known in TRAIN_OBJECTS else None
        for unit, rows in sensors.items():
            names = {"digit": "digit", "gelsight": "gelsight_mini", "duragel": "duragel"}
            sensor = next((name for word, name in names.items() if word in unit), unit)
            place = f"{folder}/{unit}"
            on_disk = set(index.listing(place)[1])
            try:
                rows = [(int(row[0]), *(float(value) for value in row[1:4])) for row in rows]
                kept = [row for row in rows if f"image_{row[0]}.png" in on_disk and len(row) == 4]
            except (TypeError, ValueError, IndexError) as error:
                raise DatasetError(
                    f"{table}, {place}: {error}; each row is [number, f_x, f_y, f_z]"
                ) from None
            index.skip("image of the table that is not on disk", place, len(rows) - len(kept))
            index.add(
                [f"{place}/image_{row[0]}.png" for row in kept],
                sensor=sensor,
                unit=unit,
                object=folder.split("_")[0],
                sequence=place,
                frame_index=[row[0] for row in kept],
                stride=2 if sensor == "digit" else 1,
                split=split or index.split_of(folder.split("_")[0]),
                background_path=f"{place}/image_1.png" if "image_1.png" in on_disk else None,
                **{
                    f"label.force_{axis}": [row[i + 1] * (-1 if axis == "z" else 1) for row in kept]
                    for i, axis in enumerate("xyz")
                },
            )


def _freetacman(index: DatasetIndex) -> None:
    """FreeTacMan's demonstrations: <task>/<task>_<n>_<camera>.mp4, with <...>_timestamps.txt if
    they are there.

    Cameras called tactile are read, or those of the option `keys`. A demonstration is an object's
    recording. The number columns of <task>_<n>_traj.csv, such as `gripper_distance`, become labels
    if it has a row a frame.
    """
    wanted = index.options.keys or ("tactile",)
    for folder, _, files in index.tracked(list(index.walk())):
        for name in (name for name in files if name.endswith(".mp4")):
            stem = Path(name).stem
            if not any(key in stem for key in wanted):
                index.skip("video of another camera", f"{folder}/{name}")
                continue
            index.need_export(f"{name} and other videos")
            try:
                place = export_video(index, f"{folder}/{name}".lstrip("/"))
            except ImageError as error:
                index.skip("video that cannot be read", str(error))
                continue
            frames = index.frames(place)
            times: Any = _times(index, index.root / folder / f"{stem}_timestamps.txt", len(frames))
            task = folder.split("/")[-1] or stem.split("_")[0]
            camera = next(key for key in wanted if key in stem)
            demonstration = stem.partition(f"_{camera}")[0]
            poses: Any = _poses(
                index, index.root / folder / f"{demonstration}_traj.csv", len(frames)
            )
            index.add_recording(
                frames,
                place,
                split=index.split_of(demonstration),
                sensor="freetacman",
                object=task,
                sequence=place,
                unit=stem[stem.index(camera) :],
                time=times,
                **poses,
            )


def _poses(index: DatasetIndex, path: Path, count: int) -> dict[str, list[Any]]:
    """Return the number columns of a trajectory as labels, {} if there are not `count` rows.

    Raises ManifestError.
    """
    if not path.is_file():
        index.skip("recording without a trajectory (no labels)", str(path))
        return {}
    if (table := read_text_csv(path)).num_rows != count:
        counts = f"{table.num_rows}, not {count}"
        index.skip(
            f"trajectory that has not a line for each frame (no labels): {counts}", str(path)
        )
        return {}
    columns = {name: typed_label(table[name]) for name in table.column_names}
    texts = [name for name, column in columns.items() if is_text(column.type)]
    index.skip(
        "column of a trajectory that is no number (no label)",
        f"{path}, {''.join(texts[:1])}",
        len(texts),
    )
    return {
        f"label.{name}": column.to_pylist() for name, column in columns.items() if name not in texts
    }


def _times(index: DatasetIndex, path: Path, count: int) -> list[float] | None:
    """Return the time stamps of a video, one a line, None if there are not `count` of them."""
    try:
        times = [float(line.split()[-1]) for line in path.read_text().splitlines() if line.strip()]
    except (OSError, ValueError, IndexError):
        index.skip("video without readable time stamps (no column time)", str(path))
        return None
    if len(times) == count:
        return times
    counts = f"{len(times)}, not {count}"
    index.skip(
        f"time stamps that have not a line for each frame (no column time): {counts}", str(path)
    )
    return None


READERS = {
    "tacbench_force": DatasetReader(
        _force,
        "<indenter>/batch_1/dataset_digit_00.pkl and dataset_slip_forces.pkl",
        _SPARSH,
        "CC-BY-NC-4.0",
        "https://huggingface.co/datasets/facebook/digit-force-estimation",
        uses=("export",),
    ),
    "tacbench_pose": DatasetReader(
        _pose,
        "train/<object>/bag_00.pkl",
        _SPARSH,
        "CC-BY-NC-4.0",
        "https://huggingface.co/datasets/facebook/digit-pose-estimation",
        uses=("export",),
    ),
    "touchd_force": DatasetReader(
        _touchd,
        "all_data_direction.json and <object_speed>/<sensor>/image_1.png",
        "AnyTouch 2: General Optical Tactile Representation Learning For Dynamic Tactile "
        "Perception, ICLR 2026",
        url="https://huggingface.co/datasets/BAAI/ToucHD-Force",
    ),
    "freetacman": DatasetReader(
        _freetacman,
        "<task>/<task>_1_tactile.mp4",
        "Wu et al., FreeTacMan: Robot-free Visuo-Tactile Data Collection System for Contact-rich "
        "Manipulation, 2025",
        "MIT",
        "https://huggingface.co/datasets/OpenDriveLab/FreeTacMan",
        uses=("val", "test", "keys", "export"),
    ),
}
