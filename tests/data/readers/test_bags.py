"""Recordings of robots: MCAP files, ROS 1 and ROS 2 bags written in the test, images by time and labels by nearest."""

from __future__ import annotations

import base64
import json
import sys

import numpy as np
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.data.readers import bags
from anytouch_jax.errors import UserError
from tests.data.manifest.test_containers import png

rosbags = pytest.importorskip("rosbags.rosbag2")
mcap = pytest.importorskip("mcap.writer")
START = 5_000_000_000


def ros_messages(store, *, ros1: bool):
    """(topic, type, time, message): four pictures with a padded row, and a force that is late for the last."""
    kinds = store.types
    Image, Header, Time = (
        kinds[n] for n in ("sensor_msgs/msg/Image", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    Wrench, Vector, Stamped = (
        kinds[f"geometry_msgs/msg/{name}"] for name in ("Wrench", "Vector3", "WrenchStamped")
    )  # fmt: skip

    def header(time):
        stamp = Time(sec=time // 10**9, nanosec=time % 10**9)
        return Header(seq=0, stamp=stamp, frame_id="") if ros1 else Header(stamp=stamp, frame_id="")

    for i in range(4):
        time = START + i * 50_000_000
        pixels = np.zeros((8, 26), np.uint8)
        pixels[:, :24] = np.tile([10 * i, 0, 200], 8)  # blue, green, red and two bytes of padding
        message = Image(
            header=header(time), height=8, width=8, encoding="bgr8", is_bigendian=0, step=26, data=pixels.ravel()
        )
        yield "/gel/left", "sensor_msgs/msg/Image", time + 1_000_000, message
        force = Vector(x=0.0, y=0.0, z=float(i))
        late = 0 if i < 3 else 200_000_000
        stamped = Stamped(header=header(time + late + 10_000_000), wrench=Wrench(force=force, torque=force))
        yield "/ft", "geometry_msgs/msg/WrenchStamped", time + late + 20_000_000, stamped


def write_ros(folder, version):
    from rosbags.typesys import Stores, get_typestore

    if version == 1:
        from rosbags.rosbag1 import Writer

        store, target, options = get_typestore(Stores.ROS1_NOETIC), folder / "run.bag", {}
    else:
        from rosbags.rosbag2 import Writer

        store, target, options = get_typestore(Stores.ROS2_HUMBLE), folder / "run", {"version": 8}
    with Writer(target, **options) as writer:
        places = {}
        for topic, kind, time, message in ros_messages(store, ros1=version == 1):
            if topic not in places:
                places[topic] = writer.add_connection(topic, kind, typestore=store)
            write = store.serialize_ros1 if version == 1 else store.serialize_cdr
            writer.write(places[topic], time, write(message, kind))
    return target


def write_mcap(file):
    """Foxglove's JSON: compressed pictures."""
    with file.open("wb") as stream:
        writer = mcap.Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        other = writer.register_schema("force", "jsonschema", b"{}")
        image = writer.register_channel("/gel", "json", schema)
        force = writer.register_channel("/force", "json", other)
        for i in range(3):
            data = {"timestamp": {"sec": 7, "nsec": i}, "data": base64.b64encode(png(i)).decode(), "format": "png"}
            writer.add_message(image, log_time=i * 10, publish_time=0, data=json.dumps(data).encode())
            writer.add_message(force, log_time=7 * 10**9 + i, publish_time=0, data=json.dumps({"f": [0, i]}).encode())
        writer.finish()


def write_protobuf(file):
    """Foxglove's protobuf: a topic of compressed pictures, one of raw pictures, a number, and a type of no picture."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    types = {"TYPE_BYTES": 12, "TYPE_STRING": 9, "TYPE_FIXED32": 7, "TYPE_DOUBLE": 1, "TYPE_MESSAGE": 11}
    ours = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto", package="foxglove", dependency=[stamp.name], syntax="proto3"
    )
    for name, fields in {
        "CompressedImage": {"data": "TYPE_BYTES", "format": "TYPE_STRING"},
        "RawImage": {"width": "TYPE_FIXED32", "height": "TYPE_FIXED32", "encoding": "TYPE_STRING",
                     "step": "TYPE_FIXED32", "data": "TYPE_BYTES"},
        "Force": {"z": "TYPE_DOUBLE"},
    }.items():  # fmt: skip
        kind = ours.message_type.add(name=name)
        kind.field.add(
            name="timestamp", number=1, type=types["TYPE_MESSAGE"], label=1, type_name=".google.protobuf.Timestamp"
        )
        for number, (field, code) in enumerate(fields.items(), 2):
            kind.field.add(name=field, number=number, type=types[code], label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(stamp)
    pool.Add(ours)
    content = descriptor_pb2.FileDescriptorSet(file=[stamp, ours]).SerializeToString()
    row = bytes([0, 0, 200, 9])  # blue, green, red and a byte of padding
    with file.open("wb") as stream:
        writer = mcap.Writer(stream)
        writer.start()
        for topic, name, values in (
            ("/gel", "CompressedImage", lambda i: {"data": png(i), "format": "png"}),
            ("/raw", "RawImage", lambda i: {"width": 1, "height": 2, "encoding": "bgr8", "step": 4, "data": row * 2}),
            ("/ft", "Force", lambda i: {"z": 1.5 * i}),
        ):
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))
            channel = writer.register_channel(
                topic, "protobuf", writer.register_schema(f"foxglove.{name}", "protobuf", content)
            )
            for i in range(3):
                message = kind(timestamp={"seconds": 7, "nanos": i}, **values(i))
                writer.add_message(channel, log_time=i, publish_time=0, data=message.SerializeToString())
        writer.finish()


@pytest.mark.parametrize("version", [1, 2])
def test_images_of_a_bag_have_their_times_and_the_nearest_force(read, tmp_path, version):
    write_ros(tmp_path, version)
    values = ("force_z=/ft:wrench.force.z",)
    with pytest.raises(UserError, match="--export"):
        read("bags", sensor="digit", values=values)
    table = read("bags", sensor="digit", values=values, export=True)
    assert table["path"] == [f"run/gel.left/{i:06d}.png" for i in range(4)] and table["frame_index"] == [0, 1, 2, 3]
    assert table["time"] == [START + i * 50_000_000 for i in range(4)]  # of the header, not of the log
    assert table["label.force_z"] == [0, 1, 2, 2]
    np.testing.assert_array_equal(decode(tmp_path / "run/gel.left/000002.png")[0, 0], [200, 0, 20])
    assert set(table["unit"]) == {"/gel/left"} and len(table.clips(3)) == 2


def test_json_in_mcap_is_read_and_topics_are_chosen(read, tmp_path):
    write_mcap(tmp_path / "run.mcap")
    table = read("bags", sensor="digit", keys=("/gel",), values=("f=/force:f[1]",), export=True)
    assert table["time"] == [7 * 10**9 + i for i in range(3)] and table["label.f"] == [0, 1, 2]
    assert [decode(tmp_path / path)[0, 0, 0] for path in table["path"]] == [0, 1, 2]
    with pytest.raises(UserError, match="without images"):
        read("bags", sensor="digit", keys=("/other",), export=True)
    for value, words in {"f=/force": "NAME=TOPIC:FIELD", "f=/force:g": "have no g", "f=/force:f": "no number"}.items():
        with pytest.raises(UserError, match=words):
            read("bags", sensor="digit", values=(value,), export=True)


def test_protobuf_in_mcap_is_read(read, tmp_path):
    pytest.importorskip("mcap_protobuf")
    write_protobuf(tmp_path / "run.mcap")
    table = read("bags", sensor="digit", values=("z=/ft:z",), export=True)
    assert [row["time"] for row in table.rows.values()] == [7 * 10**9 + i for i in range(3)] * 2
    assert table["label.z"] == [0, 1.5, 3] * 2
    pictures = [decode(tmp_path / path) for path in table["path"]]
    assert [picture[0, 0, 0] for picture in pictures[:3]] == [0, 1, 2]
    assert pictures[3].tolist() == [[[200, 0, 0]]] * 2


def test_without_the_package_for_protobuf_only_its_messages_are_an_error(read, tmp_path, monkeypatch):
    write_mcap(tmp_path / "plain.mcap")
    write_protobuf(tmp_path / "run.mcap")
    monkeypatch.setitem(sys.modules, "mcap_protobuf.decoder", None)
    with pytest.raises(UserError, match=r"run\.mcap needs a package.*anytouch_jax\[bags\]"):
        read("bags", sensor="digit", export=True)
    (tmp_path / "run.mcap").unlink()
    assert len(read("bags", sensor="digit", export=True)["path"]) == 3


def test_a_damaged_recording_is_one_sentence(read, tmp_path):
    write_mcap(tmp_path / "run.mcap")
    (tmp_path / "run.mcap").write_bytes((tmp_path / "run.mcap").read_bytes()[:300])
    with pytest.raises(UserError, match="cannot be read"):
        read("bags", sensor="digit", export=True)
    (tmp_path / "run.mcap").unlink()
    (tmp_path / "run.bag").write_bytes(b"nothing")
    with pytest.raises(UserError, match="cannot be read"):
        read("bags", sensor="digit", export=True)


def test_the_nearest_value_within_a_tenth_of_a_second():
    series = [(0, "a"), (10**8, "b"), (10**9, "c")]
    times = np.array([-1, 4 * 10**7, 6 * 10**7, 5 * 10**8, 10**9 + 10**8, 2 * 10**9])
    assert bags.nearest_values(times, series) == ["a", "a", "b", None, "c", None]
    assert bags.nearest_values(times[:2], []) == [None, None] and bags.nearest_values(times[:2], series[:1]) == [
        "a",
        "a",
    ]
