"""Recordings of robots in MCAP files and in ROS 1 and ROS 2 bags: topics of images become
sequences.
"""

from __future__ import annotations

import base64
import difflib
import json
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import cv2
import numpy as np

from anytouch_jax.data.images import decode_bytes
from anytouch_jax.datasets.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.datasets.readers.exports import Export, exported
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

FAR = 100_000_000  # nanoseconds: a label that is further from its frame is empty
# OpenCV names the second row
_BAYER = {
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
}
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {  # channels, bytes of each, change of colours
    "rgb8": (3, 1, None),
    "bgr8": (3, 1, cv2.COLOR_BGR2RGB),
    "rgba8": (4, 1, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, 1, cv2.COLOR_BGRA2RGB),
    "mono8": (1, 1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, 1, cv2.COLOR_GRAY2RGB),
    "8UC3": (3, 1, cv2.COLOR_BGR2RGB),
    "8UC4": (4, 1, cv2.COLOR_BGRA2RGB),
    "mono16": (1, 2, cv2.COLOR_GRAY2RGB),
    "rgb16": (3, 2, None),
    "bgr16": (3, 2, cv2.COLOR_BGR2RGB),
    "yuv422": (2, 1, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, 1, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2RGB_YUYV),
    "yuyv": (2, 1, cv2.COLOR_YUV2RGB_YUYV),
    **{
        f"bayer_{name}{8 * size}": (1, size, change)
        for name, change in _BAYER.items()
        for size in (1, 2)
    },
}


class BagError(DatasetError):
    """A recording that is damaged."""


class Message(NamedTuple):
    """A message: topic, time of its log in nanoseconds, type, and content, None for an encoding
    that is not read.
    """

    topic: str
    time: int
    kind: str
    content: Any


def _bags(index: DatasetIndex) -> None:
    """MCAP files, ROS 1 bags and folders of ROS 2 (with metadata.yaml): topics of images become
    sequences of PNG.

    The time of a frame is that of its header, else that of the log, in nanoseconds (column `time`).
    Labels are the values of other topics that are nearest in time, at most a tenth of a second
    away. Their `values` read NAME=TOPIC:FIELD. What is no image that can be read is left out, and
    counted by topic.
    """
    index.need_sensor()
    places = _labels_wanted(index.options.values)
    index.wanted += [f"label.{name}" for name in places]
    for path in _bag_files(index):
        index.need_export(f"the recording {path}")
        try:
            _add_recording(index, path, places)
        except BagError as error:
            index.skip("recording that cannot be read", str(error))


class _Streams(NamedTuple):
    """What was read of a recording.

    `times` are those of the images of each topic, in nanoseconds, and `exports` where they were
    written. `series` are the values (time, value) of each label. `topics` are all topics that were
    seen.
    """

    times: dict[str, list[int]]
    exports: dict[str, Export]
    series: dict[str, list[tuple[int, Any]]]
    topics: set[str]


def _add_recording(index: DatasetIndex, path: str, places: dict[str, tuple[str, str]]) -> None:
    """Write the images of a recording, all or none, and add its rows.

    `places` are the topic and the field of each label by its name.
    """
    # The exports are complete when the stack closes: an error before that leaves no image.
    with ExitStack() as stack:
        streams = _read_streams(index, path, places, stack)
    if not streams.times:
        index.skip("recording without images of the chosen topics", path)
    for name, (topic, _) in places.items():
        if streams.times and topic not in streams.topics:
            near = difflib.get_close_matches(topic, streams.topics, 1)
            if near:
                hint = f"did you mean {near[0]}?"
            else:
                hint = f"there are {', '.join(sorted(streams.topics))}"
            index.notes.append(
                f"{path} has no message of the topic {topic}, so label.{name} has no value; {hint}"
            )
    # One recording is one group: topics of it show the same moments, so they share its split.
    split = index.split_of(path) if streams.times else None
    for topic, times in streams.times.items():
        labels = {}
        for name, series in streams.series.items():
            values = nearest_values(np.array(times), series)
            labels[f"label.{name}"] = values
            where = f"{path}, topic {topic}, frame "
            _report_far(index, name, places[name][0], where, np.array(times), series, values)
        index.add(
            [f"{streams.exports[topic].folder}/{at:06d}.png" for at in range(len(times))],
            sensor=index.options.sensor,
            unit=topic,
            sequence=f"{path}{topic}",
            frame_index=list(range(len(times))),
            time=times,
            split=split,
            **labels,
        )


def _read_streams(
    index: DatasetIndex, path: str, places: dict[str, tuple[str, str]], stack: ExitStack
) -> _Streams:
    """Read a recording once: write the images of each topic, and keep the values of labels."""
    file = index.root / path
    keys = index.options.keys
    sources = sorted(one for one in file.iterdir() if one.is_file()) if file.is_dir() else [file]
    wanted = {*keys, *(topic for topic, _ in places.values())} if keys else None
    counts: Counter[str] = Counter()  # of all images of a topic, also of those left out
    streams = _Streams({}, {}, {name: [] for name in places}, set())
    for message in read_messages(file, wanted):
        streams.topics.add(message.topic)
        for name, (topic, field) in places.items():
            if message.topic == topic:
                value = _field(message.content, field, message.topic)
                streams.series[name].append((_time(message), value))
        if keys and message.topic not in keys:
            continue
        where = f"{path}, topic {message.topic}, frame {counts[message.topic]}"
        try:
            image = image_of(message)
        except UserError as error:
            index.leave_out(str(error), where)
            counts[message.topic] += 1
            continue
        if image is None:  # a message of another kind
            continue
        counts[message.topic] += 1
        if message.topic not in streams.exports:
            topic_folder = message.topic.strip("/").replace("/", ".")
            folder = f"{Path(path).with_suffix('').as_posix()}/{topic_folder}"
            export = exported(index, folder, f"{file.name}{message.topic}", sources)
            streams.exports[message.topic] = stack.enter_context(export)
        own = streams.times.setdefault(message.topic, [])
        streams.exports[message.topic].save(f"{len(own):06d}.png", image)
        own.append(_time(message))
    return streams


def _report_far(
    index: DatasetIndex,
    name: str,
    topic: str,
    where: str,
    times: np.ndarray,
    series: list[tuple[int, Any]],
    values: list[Any],
) -> None:
    """Report frames that no value of a label is near to, with how far the nearest is."""
    empty = [at for at, value in enumerate(values) if value is None]
    if not series or not empty:
        return
    known = np.array([time for time, _ in series])
    away = min(float(np.abs(known - times[at]).min()) for at in empty) / 1e9
    index.skip(
        f"frame without label.{name}: no value of {topic} within {FAR / 1e9:g} s of it (the "
        f"nearest is {away:.3g} s away)",
        f"{where}{empty[0]}",
        len(empty),
    )


def nearest_values(times: np.ndarray, series: list[tuple[int, Any]]) -> list[Any]:
    """Return the value of a series (time, value) that is nearest to each time, None if all are
    further than FAR.
    """
    if not series:
        return [None] * len(times)
    order = sorted(series, key=lambda one: one[0])
    stamps = np.array([time for time, _ in order])
    last = len(stamps) - 1
    after = np.clip(np.searchsorted(stamps, times), min(1, last), last)
    before = np.maximum(after - 1, 0)
    chosen = np.where(
        np.abs(stamps[before] - times) <= np.abs(stamps[after] - times), before, after
    )
    return [
        order[at][1] if abs(stamps[at] - time) <= FAR else None
        for at, time in zip(chosen, times, strict=True)
    ]


def _labels_wanted(values: tuple[str, ...]) -> dict[str, tuple[str, str]]:
    places = {}
    for value in values:
        match = re.fullmatch(r"(\w+)=([^:=]+):([\w.\[\]]+)", value)
        if match is None:
            raise UserError(
                f"--values {value!r} is no NAME=TOPIC:FIELD; write force_z=/ft:wrench.force.z"
            )
        places[match[1]] = (match[2], match[3])
    return places


def _bag_files(index: DatasetIndex) -> Iterator[str]:
    """Yield the paths of recordings below ROOT: files .mcap and .bag, and folders with
    metadata.yaml.
    """
    for folder, _, files in index.walk():
        if "metadata.yaml" in files:
            yield folder
            continue
        yield from (
            f"{folder}/{name}".lstrip("/") for name in files if name.endswith((".mcap", ".bag"))
        )


def read_messages(path: Path, topics: set[str] | None = None) -> Iterator[Message]:
    """Yield the messages of a recording in the order of their times, of some topics or of all.

    Raises BagError.
    """
    try:
        if path.suffix == ".mcap":
            yield from _mcap_messages(path, topics)
            return
        from rosbags.highlevel import AnyReader

        with AnyReader([path]) as reader:
            wanted = [one for one in reader.connections if topics is None or one.topic in topics]
            total = sum(one.msgcount for one in wanted)
            for connection, time, data in tracked(
                reader.messages(wanted) if wanted else (), "messages read", total
            ):
                yield Message(
                    connection.topic,
                    time,
                    connection.msgtype,
                    reader.deserialize(data, connection.msgtype),
                )
    except ImportError as error:
        raise DatasetError(
            f"{path} needs a package: {error}; run pip install 'anytouch_jax[bags]'"
        ) from None
    except (UserError, GeneratorExit):
        raise
    except Exception as error:  # both packages have many kinds of errors for a damaged file
        raise BagError(
            f"{path}: {error}; record it again, or repair it with mcap recover"
        ) from None


def _mcap_messages(path: Path, topics: set[str] | None) -> Iterator[Message]:
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    stores: dict[str, Any] = {}
    protobuf: Any = None
    with path.open("rb") as file:
        reader = make_reader(file)
        total = None
        if (about := reader.get_summary()) is not None and about.statistics is not None:
            known = [
                one
                for one, channel in about.channels.items()
                if topics is None or channel.topic in topics
            ]
            total = sum(about.statistics.channel_message_counts.get(one, 0) for one in known)
        for schema, channel, message in tracked(
            reader.iter_messages(topics), "messages read", total
        ):
            encoding = channel.message_encoding
            kind = "" if schema is None else schema.name
            if encoding == "json":
                content = json.loads(message.data, object_hook=lambda one: SimpleNamespace(**one))
            elif encoding in ("cdr", "ros1") and schema is not None:
                name = kind if kind.count("/") == 2 else kind.replace("/", "/msg/")
                if name not in stores:
                    stores[name] = get_typestore(Stores.EMPTY)
                    stores[name].register(get_types_from_msg(schema.data.decode(), name))
                read = (
                    stores[name].deserialize_cdr
                    if encoding == "cdr"
                    else stores[name].deserialize_ros1
                )
                content = read(message.data, name)
            elif encoding == "protobuf" and schema is not None:
                if protobuf is None:
                    from mcap_protobuf.decoder import DecoderFactory

                    protobuf = DecoderFactory()
                content = protobuf.decoder_for(encoding, schema)(message.data)
            else:
                content = None
            yield Message(channel.topic, message.log_time, kind, content)


def image_of(message: Message) -> np.ndarray | None:
    """Return the image RGB u8 of a message of sensor_msgs or foxglove, None for another.

    Raises UserError.
    """
    kind = message.kind.rsplit("/", 1)[-1].rsplit(".", 1)[-1]
    content = message.content
    if not re.search(r"Image|Video", kind):
        return None
    if content is None or kind not in ("CompressedImage", "Image", "RawImage"):
        raise DatasetError(f"{kind} of a form that is not read")
    data = base64.b64decode(content.data) if isinstance(content.data, str) else bytes(content.data)
    if kind == "CompressedImage":
        if "compressedDepth" in str(content.format):
            raise DatasetError("image of depth")
        return decode_bytes(data, "image")
    if content.encoding not in _ENCODINGS:
        raise DatasetError(f"image of encoding {content.encoding}, which is not read")
    (channels, size, change) = _ENCODINGS[content.encoding]
    width = int(content.width)
    height = int(content.height)
    step = int(content.step)
    row = width * channels * size
    if step < row or not width or not height:
        raise DatasetError(f"image of {width} x {height} pixels and {step} bytes a row")
    if height * step > len(data):
        raise DatasetError("image that is cut short")
    flat = np.frombuffer(data, np.uint8, height * step).reshape(height, step)[:, :row]
    image = np.ascontiguousarray(flat)
    if size == 2:
        wide = image.view(">u2" if getattr(content, "is_bigendian", False) else "<u2")
        image = ((wide.astype(np.uint32) + 128) // 257).astype(np.uint8)
    image = image.reshape(height, width, channels)
    try:
        if change is None:
            return image
        return cv2.cvtColor(image, change)
    except cv2.error as error:  # of an odd width or height
        raise DatasetError(
            f"image of {width} x {height} pixels in {content.encoding}: {error.err}"
        ) from None


def _time(message: Message) -> int:
    """Return the time of a message in nanoseconds: of its header, else when it was logged."""
    header = getattr(message.content, "header", message.content)
    stamp = getattr(header, "stamp", getattr(header, "timestamp", None))
    seconds, rest = (
        next((int(getattr(stamp, name)) for name in names if hasattr(stamp, name)), 0)
        for names in (("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos"))
    )
    if seconds or rest:
        return seconds * 1_000_000_000 + rest
    return int(message.time)


def _field(content: Any, field: str, topic: str) -> Any:
    """Return a number or text in a message, by its names and places, as position[2].

    Raises DatasetError.
    """
    value = content
    try:
        for name, place in re.findall(r"(\w+)|\[(\d+)\]", field):
            value = value[int(place)] if place else getattr(value, name)
    except (AttributeError, IndexError, TypeError):
        raise DatasetError(f"messages of {topic} have no {field}; correct --values") from None
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return int(value)
    if not isinstance(value, int | float | str):
        raise DatasetError(f"{field} of {topic} is no number or text; name a field in it")
    return value


READERS = {
    "bags": DatasetReader(
        _bags,
        "<recording>.mcap, <recording>.bag, or a folder with metadata.yaml",
        "nothing, unless their owner asks for it",
        "as their owner says",
        uses=("val", "test", "sensor", "keys", "values", "export"),
    ),
}
