"""Corpora in shards that stay unchanged, Parquet and WebDataset tars, and small packs that need no
layout.

Layouts are those of public code: the schema and the read-me of gelsight-mini-pretrain
(github.com/Yuxiang-Ma), and `WdsWriter` and the loader of T3 (github.com/alanzjl/t3) with the data
set card of FoTa. With `url` the shards stay in an object store, and only their metadata are read.
"""

from __future__ import annotations

import importlib.metadata
import re
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.config import parse_json
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import ShardError, tar_members
from anytouch_jax.data.manifest.schema import PATHS, typed_label
from anytouch_jax.datasets.readers.common import (
    TACTILE,
    DatasetError,
    DatasetIndex,
    DatasetReader,
    label_cells,
    split_word,
)
from anytouch_jax.datasets.readers.exports import exported
from anytouch_jax.errors import UserError

_CC_BY = "CC-BY-4.0"
_TACTILE_MNIST = "CC-BY-2.0"
SOURCES = {  # of gelsight-mini-pretrain, and the licence of each by its read-me
    "fota_labeled": "MIT",
    "fota_unlabeled": "MIT",
    "threedcal": _CC_BY,
    "feats": "MIT",
    "gelslam": "MIT",
    "tactile_tracking": "MIT",
    "real_tactile_mnist": _TACTILE_MNIST,
    "feelanyforce": _CC_BY,
    "unit": "BSD-3-Clause",
    "tacquad": _CC_BY,
    "sim_tactile_mnist": _TACTILE_MNIST,
    "sim_starstruck": _TACTILE_MNIST,
    "sparsh": "CC-BY-NC-4.0",
}
_LABELS = {
    "markered": "markered",
    "domain": "domain",
    "indenter": "indenter",
    "indenter_param": "indenter_param",
    "digit_class": "digit",
    "f_x": "force_x",
    "f_y": "force_y",
    "f_z": "force_z",
    **{name: name for name in ("x_mm", "y_mm", "z_mm", "quat_x", "quat_y", "quat_z", "quat_w")},
}
_IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
_TEXTS = ("txt", "text", "cls")
_CAPTION = re.compile(r"caption|text|prompt|sentence|instruction|description", re.IGNORECASE)
_BACKGROUND = re.compile(
    r"background|untouched|no_?contact|reference|(?<![a-z])(?:bg|ref)(?![a-z])", re.IGNORECASE
)
_DERIVED = re.compile(r"depth|mask|seg|normal|flow|marker|diff|label", re.IGNORECASE)
_PHOTO = re.compile(
    r"photo|rgb|vision|visual|colou?r|camera|(?<![a-z])cam|scene|image|img|wrist|head|kinect|realsense|"
    r"third|overhead|front",
    re.IGNORECASE,
)
_SIDE = re.compile(
    r"^(?:\d+|[a-d]|l|r|left|right|thumb|index|middle|ring|little|pinky|finger_?\d*)$",
    re.IGNORECASE,
)
_SENSORS = {
    "gelsight_mini": r"mini",
    "digit": r"digit|tvl",
    "gelsight_wedge": r"wedge",
    "gelsight_svelte": r"svelte",
    "gelsight_finray": r"finray",
    "densetact": r"densetact",
    "gelslim": r"objectfolder",
    "gelsight": r"visgel|yuan|calandra|ycb|touch_?and_?go|cloth",
}


def _gelsight_mini(index: DatasetIndex) -> None:
    """GelSight Mini touches of 13 public sources, one schema of 30 columns:
    <source>/<split>-<n>.parquet.

    The licence is that of the source. A frame of a video (`frame_idx`) belongs to its capture, any
    other is a sequence. Splits called test* are test, and those of no usual name are by hash of the
    capture.
    """
    for path, opened in index.shards(".parquet"):
        with opened() as file:
            try:
                table = pa.parquet.ParquetFile(file)
                names = table.schema_arrow.names
                if not {"image", "source", "capture"} <= {*names}:
                    index.skip("Parquet file without image, source and capture", path)
                    continue
                wanted = {"source", "capture", "split", "frame_idx", "obj_name", "side", *_LABELS}
                rows = table.read(sorted(wanted & {*names})).to_pylist()
            except (pa.ArrowException, OSError) as error:
                raise DatasetError(
                    f"{path} is no whole Parquet file: {error}; download it again"
                ) from None
        counts = Counter((row["capture"], row.get("side"), row.get("frame_idx")) for row in rows)
        for number, row in enumerate(rows):
            source = str(row["source"])
            side = row.get("side")
            frame = row.get("frame_idx")
            base = next((name for name in SOURCES if source.startswith(name)), None)
            if base is None:
                index.skip("row of an unknown source (licence not stated)", source)
            licence = SOURCES.get(base or "", "not stated")
            capture = "/".join(
                str(part) for part in (source, row["capture"], side) if part is not None
            )
            is_video = frame is not None and counts[row["capture"], side, frame] == 1
            split = str(row.get("split") or Path(path).name.split("-")[0])
            index.add(
                [f"{path}/image/{number}"],
                sensor="gelsight_mini",
                dataset=f"gelsight_mini_pretrain/{source}",
                sequence=capture if is_video else f"{capture}/{Path(path).stem}/{number}",
                frame_index=frame if is_video else 0,
                object=row.get("obj_name"),
                unit=side,
                split=split
                if split in ("train", "val")
                else "test"
                if split.startswith("test")
                else index.split_of(capture),
                license=licence,
                commercial=licence != "not stated" and "NC" not in licence,
                **{
                    f"label.{ours}": int(value)
                    if isinstance(value := row.get(name), bool)
                    else value
                    for name, ours in _LABELS.items()
                },
            )


def _webdataset(index: DatasetIndex) -> None:
    """Tars of WebDataset: a sample is the files of one key, which ends at the first point of their
    names.

    Images are touches, RGB images or backgrounds by their field. Values of .json and .cls become
    labels, `object` the object, .txt the caption. Every touch is a sequence. The split is that of a
    folder or shard called train or val, or `split` of the JSON, or the hash of object or key.
    """
    sensor = index.need_sensor()
    _tars(index, lambda path: sensor)


def _fota(index: DatasetIndex) -> None:
    """FoTa, 13 sensors, by the name of the data set or else --sensor: <data
    set>/{train,val}/data-000000.tar.
    """

    def sensor_of(path: str) -> str:
        name = "/".join(path.lower().split("/")[:-2]) or path.lower()
        found = next(
            (sensor for sensor, words in _SENSORS.items() if re.search(words, name)),
            index.options.sensor,
        )
        if found is None:
            raise DatasetError(
                f"the name {name} says nothing about the sensor; name it with --sensor"
            )
        return found

    _tars(index, sensor_of)


def _tars(index: DatasetIndex, sensor_of: Any) -> None:
    shards: dict[tuple[str, str], str] = {}  # the shard of a sample's key
    for path, opened in index.shards(".tar"):
        inside = path.removeprefix(index.options.url or "").lstrip("/")
        sensor = sensor_of(inside)
        folders = inside.split("/")[:-1]
        words = [*reversed(folders), *re.split(r"[\W\d_]+", Path(inside).stem)]
        part = next((split for word in words if (split := split_word(word))), None)
        dataset = "/".join(name for name in folders if split_word(name) is None) or index.name
        with opened() as file:
            try:
                members = tar_members(Path(path), file)
            except ShardError as error:
                raise DatasetError(str(error)) from None
            # key -> field -> number of the file in the tar
            samples: dict[str, dict[str, int]] = {}
            for number, (name, *_) in enumerate(members):
                folder, _, base = name.removeprefix("./").rpartition("/")
                key, _, field = base.partition(".")
                samples.setdefault(f"{folder}/{key}".strip("/"), {}).setdefault(
                    field.lower(), number
                )
            texts = {
                (key, field): _read_text(file, path, members[number])
                for key, fields in samples.items()
                for field, number in fields.items()
                if field.rpartition(".")[2] in ("json", *_TEXTS)
            }
        for key, fields in samples.items():
            shown = (
                dataset
                if shards.setdefault((f"{dataset}/{part}", key), path) == path
                else f"{dataset}/{inside}"
            )
            own = {field: texts[key, field] for field in fields if (key, field) in texts}
            place = f"{shown}/{part or ''}/{key}"
            _add_sample(
                index, path, place, fields, own, sensor=sensor, dataset=dataset, split=part, key=key
            )
    _one_type(index)


def _add_sample(
    index: DatasetIndex,
    path: str,
    place: str,
    fields: dict[str, int],
    texts: dict[str, Any],
    *,
    split: str | None,
    key: str,
    **cells: Any,
) -> None:
    """Add a row for each tactile image of a sample.

    Its other files are RGB images, captions and labels. `fields` are the files by the end of their
    name, with their place in the tar at `path`; `texts` those that were read as text or JSON.
    `place` is the sequence of the sample, `key` its name, and `split` that of its tar, if stated.
    """
    images = {
        field: kind_of_picture(field, index.options.keys)
        for field in fields
        if f".{field.rpartition('.')[2]}" in _IMAGES
    }
    touches = _touches_of(images, index.options.keys)
    for field in fields:
        kind = images.get(field)
        where = f"{path}/{key}.{field}"
        if kind == "other" or (kind == "touch" and field not in touches):
            index.leave_out("image that no word calls tactile (--keys names its field)", where)
        elif kind is None and field not in texts:
            index.skip("file of a sample that is no image, label or text", where)
    values, captions = _values_and_captions(texts)
    stated = split_word(str(values.get("split"))) if split is None else None
    if stated is not None:
        values.pop("split")
    obj = values.pop("object", values.pop("object_name", None))
    labels: dict[str, Any] = {}
    for name, value in values.items():
        for label, (cell,) in label_cells(name, [value]).items():
            labels[f"label.{label.removeprefix('has_')}"] = cell
    # Reversed, so that the first image of a kind stays.
    others = {kind: f"{path}/{fields[field]}" for field, kind in reversed(images.items())}
    if not touches:
        index.skip("sample without a tactile image", f"{path}/{key}")
    has_several = len(touches) > 1
    for field in touches:
        unit = field.rpartition(".")[0] or None
        index.add(
            [f"{path}/{fields[field]}"],
            sequence=f"{place}/{unit or field}" if has_several else place,
            unit=unit if has_several else None,
            frame_index=0,
            object=None if obj is None else str(obj),
            text=" ".join(captions) or None,
            image_path=others.get("photo"),
            background_path=others.get("background"),
            split=split or stated or index.split_of(str(obj or key)),
            **cells,
            **labels,
        )


def _touches_of(images: Mapping[str, str], keys: Sequence[str]) -> list[str]:
    """Return the fields of a sample that are tactile images.

    A bare `jpg` is one where no image with a name is: beside `gel.jpg` it is something else,
    unless --keys names it.
    """
    is_named = any(kind == "touch" and "." in field for field, kind in images.items())
    touches = []
    for field, kind in images.items():
        counts = "." in field or not is_named or field in keys
        if kind == "touch" and counts:
            touches.append(field)
    return touches


def _values_and_captions(texts: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the values of a sample by name, and its captions.

    JSON gives several values. A text is a caption if it has no name or that of one.
    """
    values: dict[str, Any] = {}
    captions = []
    for field, text in texts.items():
        name, _, kind = field.rpartition(".")
        if kind == "json":
            values |= text
        elif kind in ("txt", "text") and (not name or _CAPTION.search(name)):
            captions.append(" ".join(str(text).split()))
        else:
            values[name or kind] = text
    return values, captions


def kind_of_picture(field: str, keys: Sequence[str] = ()) -> str:
    """Return touch, photo, background or other for a field.

    No name, as jpg, and a side, as left.jpg, are touch.
    """
    name = field.rpartition(".")[0]
    if keys:
        if field in keys or name in keys:
            return "touch"
        if _PHOTO.search(name):
            return "photo"
        return "other"
    kinds = (
        ("background", _BACKGROUND),
        ("other", _DERIVED),
        ("touch", TACTILE),
        ("photo", _PHOTO),
        ("touch", _SIDE),
    )
    if name:
        return next((kind for kind, words in kinds if words.search(name)), "other")
    return "touch"


def _read_text(file: Any, path: str, member: tuple[str, int, int]) -> Any:
    """Return the values of a JSON file of a tar, or its text as a number if it is one.

    Raises DatasetError.
    """
    name, offset, size = member
    file.seek(offset)
    data = file.read(size)
    if name.lower().endswith(".json"):
        return _parsed(data, f"{path}, {name}")
    try:
        text = data.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise DatasetError(
            f"{path}, {name} is not text in UTF-8; correct it or download it again"
        ) from None
    if name.lower().endswith(".cls"):
        return typed_label(pa.chunked_array([pa.array([text])]))[0].as_py()
    return text


def _parsed(data: bytes, where: str) -> dict[str, Any]:
    """Return a JSON object, or its value under the name `value`. Raises DatasetError."""
    try:
        values = parse_json(data)
        # T3's writer encodes twice
        while isinstance(values, str):
            values = parse_json(values)
    except UserError as error:
        raise DatasetError(f"{where} {error}; correct it or download it again") from None
    if isinstance(values, dict):
        return {str(name): value for name, value in values.items()}
    return {"value": values}


def _one_type(index: DatasetIndex) -> None:
    """Make labels that are a number in one data set and text in another text in all, and whole
    numbers floats.
    """
    for name, column in index.table.items():
        kinds = {type(value) for value in column} - {type(None)}
        if name.startswith("label.") and len(kinds) > 1:
            kind = str if str in kinds else float
            index.table[name] = [None if value is None else kind(value) for value in column]


def _real_touch(index: DatasetIndex) -> None:
    """Real frames from public repositories, with their own manifest.csv; label.contact_score is
    computed.
    """
    if not (index.root / "manifest.csv").is_file():
        return
    table = manifests.read(index.root / "manifest.csv").table
    on_disk = {
        f"{folder}/{name}".lstrip("/")
        for folder, _, files in index.walk(count=False)
        for name in files
    }
    exists = [path in on_disk for path in table["path"].to_pylist()]
    gone = [path for path in table["path"].to_pylist() if path not in on_disk]
    index.skip_all("file of the manifest that is not on disk", gone)
    columns = {name: pc.filter(table[name], exists).to_pylist() for name in table.column_names}
    for name in set(PATHS[1:]) & columns.keys():
        missing = [path is not None and path not in on_disk for path in columns[name]]
        index.skip(f"{name} that is not on disk (kept without)", name, sum(missing))
        columns[name] = [
            None if gone else path for gone, path in zip(missing, columns[name], strict=True)
        ]
    index.add(columns.pop("path"), **columns)


def _taxim_presses(index: DatasetIndex) -> None:
    """Presses of a steel ball on a GelSight and a GelSight Mini, in the package `taxim` (1.4.1),
    which is not imported.

    `calib/<sensor>/dataPack.npz` has `f0`, the untouched gel, `imgs`, BGR u8 480 x 640,
    `touch_center` and `touch_radius` in pixels. Images are written into ROOT/taxim_presses.
    `lists` may name another `calib` folder. Every press is a sequence, split by hash. Raises
    DatasetError without the package.
    """
    calib = index.options.lists
    if calib is None:
        try:
            calib = Path(str(importlib.metadata.distribution("taxim").locate_file("taxim/calib")))
        except importlib.metadata.PackageNotFoundError:
            raise DatasetError(
                "the package taxim is not installed; run pip install taxim"
            ) from None
    for sensor in ("gelsight", "gelsight_mini"):
        path = calib / sensor / "dataPack.npz"
        place = f"taxim_presses/{sensor}"
        if not path.is_file():
            index.skip("sensor without dataPack.npz", str(path))
            continue
        try:
            with np.load(path, allow_pickle=False) as pack:
                gel, presses, centres, radii = (
                    pack[key] for key in ("f0", "imgs", "touch_center", "touch_radius")
                )
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DatasetError(f"{path} is not a calibration pack of taxim: {error}") from None
        names = [f"press_{i:02d}" for i in range(len(presses))]
        with exported(index, place, sensor, [path]) as images:
            for name, image in zip(("background", *names), (gel, *presses), strict=True):
                images.save(f"{name}.png", image[..., ::-1])
        place = images.folder
        cells = {"sensor": sensor, "unit": f"taxim/{sensor}", "frame_index": 0}
        index.add(
            [f"{place}/{name}.png" for name in names],
            **cells,
            object="ball",
            sequence=[f"{sensor}/{name}" for name in names],
            split=[index.split_of(f"{sensor}/{name}") for name in names],
            background_path=f"{place}/background.png",
            **{
                "label.contact": 1,
                "label.radius_px": [float(r) for r in radii],
                "label.x_px": [float(x) for x, _ in centres],
                "label.y_px": [float(y) for _, y in centres],
            },
        )
        index.add(
            [f"{place}/background.png"],
            **cells,
            sequence=f"{sensor}/background",
            split="background",
            **{"label.contact": 0},
        )


READERS = {
    "gelsight_mini_pretrain": DatasetReader(
        _gelsight_mini,
        "<source>/train-00000.parquet",
        "the data set card of yxma/gelsight-mini-pretrain, and each source",
        "by row",
        "https://huggingface.co/datasets/yxma/gelsight-mini-pretrain",
        uses=("val", "test", "url"),
    ),
    "fota": DatasetReader(
        _fota,
        "<data set>/train/data-000000.tar",
        "Zhao et al., Transferable Tactile Transformers for Representation Learning Across Diverse "
        "Sensors and Tasks, CoRL 2024",
        "MIT",
        "https://huggingface.co/datasets/alanz-mit/FoundationTactile",
        uses=("val", "test", "url", "sensor"),
    ),
    "webdataset": DatasetReader(
        _webdataset,
        "<folder>/000000.tar",
        "nothing, unless their owner asks for it",
        "as their owner says",
        uses=("val", "test", "url", "sensor", "keys"),
    ),
    "real_touch": DatasetReader(
        _real_touch, "manifest.csv", "the sources named in the pack's read-me", "by row", uses=()
    ),
    "taxim_presses": DatasetReader(
        _taxim_presses,
        "dataPack.npz in the folder calib of the package taxim",
        "Si and Yuan, Taxim: An Example-Based Simulation Model for GelSight Tactile Sensors, RA-L "
        "2022",
        "MIT",
        "https://pypi.org/project/taxim",
        uses=("val", "test", "lists"),
    ),
}
