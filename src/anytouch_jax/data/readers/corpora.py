"""Corpora in shards that stay unchanged: Parquet with pictures in a column, and WebDataset tars.

Layouts are those of public code: the schema and the read-me of gelsight-mini-pretrain (github.com/Yuxiang-Ma), and
`WdsWriter` and the loader of T3 (github.com/alanzjl/t3) with the data set card of FoTa. With `url` the shards stay in
an object store, and only their metadata are read.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet

from anytouch_jax.config import parse_json
from anytouch_jax.data.manifest.files import ShardError, tar_members
from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.errors import UserError

_CC_BY, _TACTILE_MNIST = "CC-BY-4.0", "CC-BY-2.0"
SOURCES = {  # of gelsight-mini-pretrain, and the licence of each by its read-me
    "fota_labeled": "MIT", "fota_unlabeled": "MIT", "threedcal": _CC_BY, "feats": "MIT", "gelslam": "MIT",
    "tactile_tracking": "MIT", "real_tactile_mnist": _TACTILE_MNIST, "feelanyforce": _CC_BY, "unit": "BSD-3-Clause",
    "tacquad": _CC_BY, "sim_tactile_mnist": _TACTILE_MNIST, "sim_starstruck": _TACTILE_MNIST,
    "sparsh": "CC-BY-NC-4.0",
}  # fmt: skip
_LABELS = {
    "markered": "markered", "domain": "domain", "indenter": "indenter", "indenter_param": "indenter_param",
    "digit_class": "digit", "f_x": "force_x", "f_y": "force_y", "f_z": "force_z",
    **{name: name for name in ("x_mm", "y_mm", "z_mm", "quat_x", "quat_y", "quat_z", "quat_w")},
}  # fmt: skip
_PICTURES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
_SENSORS = {
    "gelsight_mini": r"mini", "digit": r"digit|tvl", "gelsight_wedge": r"wedge", "gelsight_svelte": r"svelte",
    "gelsight_finray": r"finray", "densetact": r"densetact", "gelslim": r"objectfolder",
    "gelsight": r"visgel|yuan|calandra|ycb|touch_?and_?go|cloth",
}  # fmt: skip


def _gelsight_mini(index: DatasetIndex) -> None:
    """GelSight Mini touches of 13 public sources, one schema of 30 columns: <source>/<split>-<n>.parquet.

    The licence is that of the source. A frame of a film (`frame_idx`) belongs to the sequence of its capture. Any
    other frame is a sequence. Splits called test* are test, and those of no usual name are by hash of the capture.
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
                raise DatasetError(f"{path} is no whole Parquet file: {error}; download it again") from None
        counts = Counter((row["capture"], row.get("side"), row.get("frame_idx")) for row in rows)
        for number, row in enumerate(rows):
            source, side, frame = str(row["source"]), row.get("side"), row.get("frame_idx")
            base = next((name for name in SOURCES if source.startswith(name)), None)
            if base is None:
                index.skip("row of an unknown source (licence not stated)", source)
            licence = SOURCES.get(base or "", "not stated")
            capture = "/".join(str(part) for part in (source, row["capture"], side) if part is not None)
            is_film = frame is not None and counts[row["capture"], side, frame] == 1
            split = str(row.get("split") or Path(path).name.split("-")[0])
            index.add(
                [f"{path}/image/{number}"], sensor="gelsight_mini", dataset=f"gelsight_mini_pretrain/{source}",
                sequence=capture if is_film else f"{capture}/{Path(path).stem}/{number}",
                frame_index=frame if is_film else 0, object=row.get("obj_name"), unit=side,
                split=split if split in ("train", "val") else "test" if split.startswith("test")
                else index.split_of(capture),
                license=licence, commercial=licence != "not stated" and "NC" not in licence,
                **{f"label.{ours}": _plain(row.get(name)) for name, ours in _LABELS.items()},
            )  # fmt: skip


def _webdataset(index: DatasetIndex) -> None:
    """Tars of WebDataset with `key.jpg` and `key.json`. Simple values of the JSON become labels, `object` the object.

    Every picture is a sequence, because shards are in a random order. A folder called train or val gives the split,
    which else is by hash of the object, or of the key.
    """
    sensor = index.need_sensor()
    _tars(index, lambda path: sensor)


def _fota(index: DatasetIndex) -> None:
    """FoTa, 13 sensors: <data set>/{train,val}/data-000000.tar, with `key.jpg` and `key.json`.

    The sensor comes from the name of the data set. The option `sensor` serves names that say nothing.
    """

    def sensor_of(path: str) -> str:
        name = "/".join(path.lower().split("/")[:-2]) or path.lower()
        found = next((sensor for sensor, words in _SENSORS.items() if re.search(words, name)), index.options.sensor)
        if found is None:
            raise DatasetError(f"the name {name} says nothing about the sensor; name it with --sensor")
        return found

    _tars(index, sensor_of)


def _tars(index: DatasetIndex, sensor_of: Any) -> None:
    for path, opened in index.shards(".tar"):
        inside = path.removeprefix(index.options.url or "").lstrip("/")
        sensor, folders = sensor_of(inside), inside.split("/")[:-1]
        part = next((name for name in reversed(folders) if name in ("train", "val", "test")), None)
        dataset = "/".join(name for name in folders if name != part) or index.name
        with opened() as file:
            try:
                members = tar_members(Path(path), file)
            except ShardError as error:
                raise DatasetError(str(error)) from None
            values: dict[str, dict[str, Any]] = {}
            for name, offset, size in members:
                if name.endswith(".json"):
                    file.seek(offset)
                    values[name.removesuffix(".json")] = _parsed(file.read(size), f"{path}, {name}")
        for number, (name, *_) in enumerate(members):
            key, suffix = str(Path(name).with_suffix("")), Path(name).suffix.lower()
            if suffix not in _PICTURES:
                index.skip("file of a tar that is no picture", f"{path}/{name}", suffix not in (".json", ".txt"))
                continue
            own = values.get(key, {})
            obj = own.pop("object", own.pop("object_name", None))
            labels = {f"label.{name.removeprefix('has_')}": value for name, value in own.items()}
            index.add(
                [f"{path}/{number}"], sensor=sensor, dataset=dataset, sequence=f"{dataset}/{part or ''}/{key}",
                frame_index=0, object=None if obj is None else str(obj),
                split=part or index.split_of(str(obj or key)), **labels,
            )  # fmt: skip
    _one_type(index)


def _parsed(data: bytes, where: str) -> dict[str, Any]:
    """Return the simple values of a JSON object. Raises DatasetError."""
    try:
        values = parse_json(data)
        while isinstance(values, str):  # T3's writer encodes twice
            values = parse_json(values)
    except UserError as error:
        raise DatasetError(f"{where} {error}; correct it or download it again") from None
    if not isinstance(values, dict):
        return {}
    return {str(name): _plain(value) for name, value in values.items() if isinstance(value, str | int | float)}


def _plain(value: Any) -> Any:
    return int(value) if isinstance(value, bool) else value


def _one_type(index: DatasetIndex) -> None:
    """Make labels that are a number in one data set and text in another text in all, and whole numbers floats."""
    for name, column in index.table.items():
        kinds = {type(value) for value in column} - {type(None)}
        if name.startswith("label.") and len(kinds) > 1:
            kind = str if str in kinds else float
            index.table[name] = [None if value is None else kind(value) for value in column]


READERS = {
    "gelsight_mini_pretrain": DatasetReader(
        _gelsight_mini, "<source>/train-00000.parquet",
        "the data set card of yxma/gelsight-mini-pretrain, and each source", "by row",
        "https://huggingface.co/datasets/yxma/gelsight-mini-pretrain", uses=("val", "test", "url"),
    ),
    "fota": DatasetReader(
        _fota, "<data set>/train/data-000000.tar",
        "Zhao et al., Transferable Tactile Transformers for Representation Learning Across Diverse Sensors and Tasks, "
        "CoRL 2024", "MIT",
        "https://huggingface.co/datasets/alanz-mit/FoundationTactile", uses=("val", "test", "url", "sensor"),
    ),
    "webdataset": DatasetReader(
        _webdataset, "<folder>/000000.tar", "nothing, unless their owner asks for it", "as their owner says",
        uses=("val", "test", "url", "sensor"),
    ),
}  # fmt: skip
