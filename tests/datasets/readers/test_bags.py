import base64
import json
import sys

import numpy as np
import pytest
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers import bags
from tests.data.manifest.test_containers import png

rosbags = pytest.importorskip("rosbags.rosbag2")
mcap = pytest.importorskip("mcap.writer")
START = 5_000_000_000


def ros_messages(store, *, ros1: bool):
    """(topic, type, time, message): four images with a padded row, and a force that is late for
    the last.
    """
    names = (
        "sensor_msgs/Image std_msgs/Header builtin_interfaces/Time geometry_msgs/Wrench "
        "geometry_msgs/Vector3"
    )
    types = [
        store.types[name.replace("/", "/msg/")]
        for name in [*names.split(), "geometry_msgs/WrenchStamped"]
    ]
    Image, Header, Time, Wrench, Vector, Stamped = types

    def header(time):
        stamp = Time(sec=time // 10**9, nanosec=time % 10**9)
        return Header(stamp=stamp, frame_id="", **{"seq": 0} if ros1 else {})

    for i in range(4):
        time = START + i * 50_000_000
        late = 200_000_000 * (i == 3)
        pixels = np.zeros((8, 26), np.uint8)
        # blue, green, red and two bytes of padding
        pixels[:, :24] = np.tile([10 * i, 0, 200], 8)
        about = {"height": 8, "width": 8, "encoding": "bgr8", "is_bigendian": 0, "step": 26}
        message = Image(header=header(time), data=pixels.ravel(), **about)
        yield "/gel/left", "sensor_msgs/msg/Image", time + 1_000_000, message
        force = Vector(x=0.0, y=0.0, z=float(i))
        stamped = Stamped(
            header=header(time + late + 10_000_000), wrench=Wrench(force=force, torque=force)
        )
        yield "/ft", "geometry_msgs/msg/WrenchStamped", time + late + 20_000_000, stamped


def write_ros(folder, version):
    from rosbags.typesys import Stores, get_typestore

    if version == 1:
        from rosbags.rosbag1 import Writer

        store = get_typestore(Stores.ROS1_NOETIC)
        target = folder / "run.bag"
        options = {}
    else:
        from rosbags.rosbag2 import Writer

        store = get_typestore(Stores.ROS2_HUMBLE)
        target = folder / "run"
        options = {"version": 8}
    with Writer(target, **options) as writer:
        places = {}
        for topic, kind, time, message in ros_messages(store, ros1=version == 1):
            if topic not in places:
                places[topic] = writer.add_connection(topic, kind, typestore=store)
            write = store.serialize_ros1 if version == 1 else store.serialize_cdr
            writer.write(places[topic], time, write(message, kind))
    return target


def write_protobuf(file):
    """Foxglove's protobuf: a topic of compressed images, and one of a number."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    types = {"TYPE_BYTES": 12, "TYPE_STRING": 9, "TYPE_DOUBLE": 1, "TYPE_MESSAGE": 11}
    ours = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto", package="foxglove", dependency=[stamp.name], syntax="proto3"
    )
    for name, fields in {
        "CompressedImage": {"data": "TYPE_BYTES", "format": "TYPE_STRING"},
        "Force": {"z": "TYPE_DOUBLE"},
    }.items():
        kind = ours.message_type.add(name=name)
        kind.field.add(
            name="timestamp",
            number=1,
            type=types["TYPE_MESSAGE"],
            label=1,
            type_name=".google.protobuf.Timestamp",
        )
        for number, (field, code) in enumerate(fields.items(), 2):
            kind.field.add(name=field, number=number, type=types[code], label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(stamp)
    pool.Add(ours)
    content = descriptor_pb2.FileDescriptorSet(file=[stamp, ours]).SerializeToString()
    with file.open("wb") as stream:
        writer = mcap.Writer(stream)
        writer.start()
        for topic, name, values in (
            ("/gel", "CompressedImage", lambda i: {"data": png(i), "format": "png"}),
            ("/ft", "Force", lambda i: {"z": 1.5 * i}),
        ):
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))
            channel = writer.register_channel(
                topic, "protobuf", writer.register_schema(f"foxglove.{name}", "protobuf", content)
            )
            for i in range(3):
                message = kind(timestamp={"seconds": 7, "nanos": i}, **values(i))
                writer.add_message(
                    channel, log_time=i, publish_time=0, data=message.SerializeToString()
                )
        writer.finish()


@pytest.mark.parametrize("version", [1, 2])
def test_images_of_a_bag_have_their_times_and_the_nearest_force(read, tmp_path, version):
    write_ros(tmp_path, version)
    values = ("force_z=/ft:wrench.force.z",)
    refused("--export", read, "bags", sensor="digit", values=values)
    table = read("bags", sensor="digit", values=values, export=True)
    assert table["path"] == [f"run/gel.left/{i:06d}.png" for i in range(4)] and table[
        "frame_index"
    ] == [0, 1, 2, 3]
    # of the header, not of the log
    assert table["time"] == [START + i * 50_000_000 for i in range(4)]
    assert table["label.force_z"] == [0, 1, 2, 2]
    np.testing.assert_array_equal(decode(tmp_path / "run/gel.left/000002.png")[0, 0], [200, 0, 20])
    assert set(table["unit"]) == {"/gel/left"} and len(table.clips(3)) == 2


def test_json_in_mcap_is_read_and_topics_are_chosen(read, tmp_path):
    forces = ("/force", "force", [(i / 30, {"f": [0, i]}) for i in range(4)])
    write_topics(tmp_path / "run.mcap", [GEL, ("/other", GEL[1], GEL[2]), forces])
    table = read("bags", sensor="digit", keys=("/gel",), values=("f=/force:f[1]",), export=True)
    assert table["time"] == [round((1000 + i / 30) * 1e9) for i in range(4)] and table[
        "label.f"
    ] == [0, 1, 2, 3]
    assert [decode(tmp_path / path)[0, 0, 0] for path in table["path"]] == [0, 10, 20, 30]
    refused("without images", read, "bags", sensor="digit", keys=("/none",), export=True)
    for value, words in {
        "f=/force": "NAME=TOPIC:FIELD",
        "f=/force:g": "have no g",
        "f=/force:f": "no number",
    }.items():
        refused(words, read, "bags", sensor="digit", values=(value,), export=True)


def test_protobuf_in_mcap_is_read_and_without_its_package_only_its_messages_are_an_error(
    read, tmp_path, monkeypatch
):
    pytest.importorskip("mcap_protobuf")
    write_protobuf(tmp_path / "run.mcap")
    table = read("bags", sensor="digit", values=("z=/ft:z",), export=True)
    assert table["time"] == [7 * 10**9 + i for i in range(3)] and table["label.z"] == [0, 1.5, 3]
    assert [decode(tmp_path / path)[0, 0, 0] for path in table["path"]] == [0, 1, 2]
    write_topics(tmp_path / "plain.mcap", [GEL])
    monkeypatch.setitem(sys.modules, "mcap_protobuf.decoder", None)
    refused(
        r"run\.mcap needs a package.*anytouch_jax\[bags\]",
        read,
        "bags",
        sensor="digit",
        export=True,
    )
    (tmp_path / "run.mcap").unlink()
    assert len(read("bags", sensor="digit", export=True)["path"]) == 4


@pytest.mark.parametrize("name", ["run.mcap", "run.bag"])
def test_a_damaged_recording_is_one_sentence(read, tmp_path, name):
    write_topics(tmp_path / name, [GEL])
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:300])
    refused("cannot be read", read, "bags", sensor="digit", export=True)


def write_topics(file, topics):
    """An MCAP of JSON: (topic, type, messages as (seconds, content)) each."""
    with file.open("wb") as stream:
        writer = mcap.Writer(stream)
        writer.start()
        for topic, kind, messages in topics:
            channel = writer.register_channel(
                topic, "json", writer.register_schema(kind, "jsonschema", b"{}")
            )
            for number, (seconds, content) in enumerate(messages):
                whole, rest = divmod(round((1000 + seconds) * 1e9), 10**9)
                data = json.dumps({"timestamp": {"sec": whole, "nsec": rest}} | content).encode()
                writer.add_message(channel, 10**18 + number, data, 0)
        writer.finish()


def image(grey=0):
    return {"data": base64.b64encode(png(grey)).decode(), "format": "png"}


def raw(encoding, pixels, **more):
    pixels = np.asarray(pixels)
    about = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "step": pixels.nbytes // pixels.shape[0],
    }
    return (
        about | {"encoding": encoding, "data": base64.b64encode(pixels.tobytes()).decode()} | more
    )


GEL = ("/gel", "foxglove.CompressedImage", [(i / 30, image(10 * i)) for i in range(4)])
MOSAIC = {
    "rggb": (200, 120, 120, 40),
    "bggr": (40, 120, 120, 200),
    "gbrg": (120, 40, 200, 120),
    "grbg": (120, 200, 40, 120),
}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        *(
            (
                raw(f"bayer_{name}8", np.tile(np.reshape(cells, (2, 2)), (8, 8)).astype("u1")),
                (200, 120, 40),
            )
            for name, cells in MOSAIC.items()
        ),
        (
            raw(
                "bayer_rggb16",
                np.tile(np.reshape(MOSAIC["rggb"], (2, 2)), (8, 8)).astype("<u2") * 257,
            ),
            (200, 120, 40),
        ),
        (raw("yuv422_yuy2", np.tile(np.array([200, 128], "u1"), (16, 16, 1))), (214, 214, 214)),
        (raw("yuv422", np.tile(np.array([128, 200], "u1"), (16, 16, 1))), (214, 214, 214)),
        (raw("mono16", np.full((16, 16), 200 * 257, "<u2")), (200, 200, 200)),
        (raw("mono16", np.full((16, 16), 200 * 257, ">u2"), is_bigendian=1), (200, 200, 200)),
        (raw("32FC1", np.ones((16, 16), "f4")), "encoding 32FC1"),
        (raw("16UC1", np.ones((16, 16), "u2")), "16UC1"),
        (raw("rgb8", np.ones((16, 16, 3), "u1"), step=0), "16 x 16 pixels and 0 bytes a row"),
        (raw("rgb8", np.ones((16, 16, 3), "u1"), height=17), "cut short"),
        (raw("yuyv", np.ones((16, 15, 2), "u1")), "15 x 16 pixels in yuyv"),
    ],
)
def test_other_encodings_are_read_or_left_out_and_named(read, tmp_path, content, expected):
    write_topics(
        tmp_path / "run.mcap",
        [GEL, ("/head", "foxglove.RawImage", [(i / 30, content) for i in range(3)])],
    )
    table = read("bags", sensor="digit", export=True)
    assert table["unit"].count("/gel") == 4
    if isinstance(expected, str):
        ((reason, (count, example)),) = table.report.skipped.items()
        assert expected in reason and (count, example) == (3, "run.mcap, topic /head, frame 0")
        assert len(table.rows) == 4 and table.report.left_out == 3
        assert not (tmp_path / "run/head").exists()
    else:
        image = decode(tmp_path / table.report.manifest.value(4, "path"))
        np.testing.assert_allclose(image[4:12, 4:12].reshape(-1, 3), [expected] * 64, atol=1)


def test_one_bad_image_or_recording_beside_good_ones_is_counted_by_place(read, tmp_path):
    bad = [
        (0, image(0)),
        (1 / 30, image(10) | {"data": base64.b64encode(png(10)[:40]).decode()}),
        (2 / 30, image(20)),
    ]
    others = [
        (
            "/depth",
            "foxglove.CompressedImage",
            [(0, image() | {"format": "16UC1; compressedDepth png"})],
        ),
        ("/video", "foxglove.CompressedVideo", [(0, {"format": "h264", "data": ""})]),
    ]
    write_topics(tmp_path / "run.mcap", [("/gel", "foxglove.CompressedImage", bad), *others])
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "run.mcap").read_bytes()[:400])
    table = read("bags", sensor="digit", export=True)
    assert [decode(tmp_path / path)[0, 0, 0] for path in table["path"]] == [0, 20] and table[
        "frame_index"
    ] == [0, 1]
    examples = {example for _, example in table.report.skipped.values()}
    assert {
        f"run.mcap, topic {topic}, frame {at}"
        for topic, at in (("/gel", 1), ("/depth", 0), ("/video", 0))
    } < examples
    assert any(str(tmp_path / "cut.mcap") in example for example in examples) and len(examples) == 4


def test_a_recording_made_again_and_two_of_one_name_have_their_own_images(read, tmp_path):
    for grey, topics in ((1, ("/gel", "/g/el")), (7, ("/gel", "/g/el", "/g.el"))):
        write_topics(
            tmp_path / "run.mcap",
            [
                (
                    topic,
                    "foxglove.CompressedImage",
                    [(i / 30, image(10 * at + grey)) for i in range(3)],
                )
                for at, topic in enumerate(topics)
            ],
        )
        table = read("bags", sensor="digit", export=True)
        assert len(table.rows) == 3 * len(topics)
        for path, row in table.rows.items():
            assert decode(tmp_path / path)[0, 0, 0] == 10 * topics.index(row["unit"]) + grey


@pytest.mark.parametrize(
    ("shift", "topic", "found", "words"),
    [
        (0, "/ft", 4, None),
        (-1.5, "/ft", 0, "no value of /ft within 0.1 s of it (the nearest is 1.4 s away): 4"),
        (0, "/f_t", 0, "no message of the topic /f_t, so label.f has no value; did you mean /ft?"),
        (-0.15, "/ft", 2, "no value of /ft within 0.1 s of it (the nearest is 0.117 s away): 2"),
    ],
)
def test_labels_that_are_not_found_are_reported(read, tmp_path, shift, topic, found, words):
    write_topics(
        tmp_path / "run.mcap",
        [GEL, ("/ft", "Force", [(i / 30 + shift, {"z": i}) for i in range(4)])],
    )
    report = read("bags", sensor="digit", export=True, values=(f"f={topic}:z",)).report
    assert words is None or any(words in line for line in report.lines())
    cells = report.manifest.table.to_pylist()
    assert sum(row.get("label.f") is not None for row in cells) == found
    assert any("no row has a value of label.f" in note for note in report.notes) == (found == 0)
    assert any(f"labels found: f {found}" in line for line in report.lines()) == (found > 0)


def test_the_nearest_value_within_a_tenth_of_a_second():
    series = [(0, "a"), (10**8, "b"), (10**9, "c")]
    times = np.array([-1, 4 * 10**7, 6 * 10**7, 5 * 10**8, 10**9 + 10**8, 2 * 10**9])
    assert bags.nearest_values(times, series) == ["a", "a", "b", None, "c", None]
    assert bags.nearest_values(times[:2], []) == [None, None]
    assert bags.nearest_values(times[:2], series[:1]) == ["a", "a"]
