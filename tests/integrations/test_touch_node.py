"""The ROS 2 node, run against the documented interface of rclpy (docs.ros.org, rclpy.node.Node)."""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from measuring import measuring_weights
from places import ROOT
from videos import write_video


class Ros:
    """What the node sees of ROS: parameters keep the type of their default, and nothing is
    published after the end.
    """

    def __init__(self, given: dict, frames: int) -> None:
        self.given = given
        self.frames = frames
        self.sent = []
        self.destroyed = False
        self.is_on = False

    def modules(self) -> dict[str, ModuleType]:
        ros = self

        class Node:
            def __init__(self, node_name: str) -> None:
                assert ros.is_on

            def declare_parameter(self, name, value=None, descriptor=None, ignore_override=False):
                override = ros.given.get(name, value)
                if type(override) is not type(value) and not (
                    descriptor and descriptor.dynamic_typing
                ):
                    raise TypeError(f"InvalidParameterTypeException: {name}")
                return SimpleNamespace(value=override)

            def create_publisher(self, msg_type, topic, qos_profile):
                def publish(message):
                    assert ros.is_on and type(message) is msg_type
                    ros.sent.append((topic, getattr(message, "data", message)))

                return SimpleNamespace(publish=publish)

            def get_clock(self):
                return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "stamp"))

            def destroy_node(self):
                ros.destroyed = True

        def message(title: str, /, **kinds: type) -> type:
            """A message of ROS: keyword arguments alone, each of its own type."""

            def init(self, **given):
                assert given.keys() <= kinds.keys(), given
                assert all(type(value) is kinds[key] for key, value in given.items()), given
                vars(self).update(given)

            return type(title, (), {"__init__": init, "FLOAT32": 7})

        Bool = message("Bool", data=bool)
        Float32MultiArray = message("Float32MultiArray", data=list)
        three = dict.fromkeys("xyz", float)
        Vector3 = message("Vector3", **three)
        Header = message("Header", stamp=str, frame_id=str)
        Wrench = message("Wrench", force=Vector3, torque=Vector3)
        WrenchStamped = message("WrenchStamped", header=Header, wrench=Wrench)
        PointField = message("PointField", name=str, offset=int, datatype=int, count=int)
        PointCloud2 = message(
            "PointCloud2",
            header=Header,
            height=int,
            width=int,
            fields=list,
            is_bigendian=bool,
            point_step=int,
            row_step=int,
            data=bytes,
            is_dense=bool,
        )

        def ok() -> bool:  # Ctrl-C comes after some frames
            self.is_on = (
                self.is_on
                and sum(topic == "touch/features" for topic, _ in self.sent) < self.frames
            )
            return self.is_on

        def switch(on: bool):
            return lambda: setattr(self, "is_on", on)

        content = {
            "rclpy": {"init": switch(True), "ok": ok, "try_shutdown": switch(False)},
            "rclpy.node": {"Node": Node},
            "rcl_interfaces.msg": {"ParameterDescriptor": SimpleNamespace},
            "std_msgs.msg": {
                "Bool": Bool,
                "Float32MultiArray": Float32MultiArray,
                "Header": Header,
            },
            "geometry_msgs.msg": {
                "Vector3": Vector3,
                "Wrench": Wrench,
                "WrenchStamped": WrenchStamped,
            },
            "sensor_msgs.msg": {"PointCloud2": PointCloud2, "PointField": PointField},
        }
        modules = {
            part: ModuleType(part) for name in content for part in (name.partition(".")[0], name)
        }
        for name, values in content.items():
            vars(modules[name]).update(values)
        return modules


@pytest.mark.parametrize(
    ("frames", "background", "measures"), [(99, True, False), (2, False, False), (99, True, True)]
)
def test_what_every_frame_publishes_until_ros_ends(
    monkeypatch, tmp_path, tiny_run, frames, background, measures
):
    monkeypatch.chdir(tmp_path)
    gel = np.tile(np.array([90, 110, 140], np.uint8), (48, 48, 1))
    press = gel.copy()
    press[10:30, 10:30] += 90
    cv2.imwrite("gel.png", gel)
    write_video("7.avi", (gel, gel, press, press), 30)
    (tmp_path / "7.avi").rename("7")  # a number, as camera:=0 is for ROS
    model = measuring_weights(tmp_path / "weights.safetensors") if measures else tiny_run
    given = {
        "model": str(model),
        "width_mm": 10.0,
        "sensor": "tacto" if measures else "digit",
        "camera": 7,
        "background": "gel.png" if background else "",
    }
    ros = Ros(given, frames)
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location(
        "touch_node", ROOT / "integrations" / "ros2" / "touch_node.py"
    )
    node = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(node)
    node.main()
    features = [data for topic, data in ros.sent if topic == "touch/features"]
    assert (
        len(features) == min(frames, 2 if measures else 4)
        and len({len(one) for one in features}) == 1
    )
    contact = [data for topic, data in ros.sent if topic == "touch/contact"]
    assert contact == ([False, False, True, True] if background else [])[-len(features) :]
    wrenches = [one.wrench for topic, one in ros.sent if topic == "touch/wrench"]
    clouds = [
        np.frombuffer(data, "<f4").reshape(14, 14, 3)
        for topic, data in ros.sent
        if topic == "touch/points"
    ]
    assert len(wrenches) == len(clouds) == (2 if measures else 0)
    # a press pushes the gel towards the camera, which is against z
    assert all(one.force.z < 0 for one in wrenches)
    # N, N m and metres
    for force, points in zip(wrenches, clouds, strict=True):
        assert abs(force.force.z) > abs(force.torque.z) and np.ptp(points[..., 0]) == pytest.approx(
            0.01 * 13 / 14
        )
    assert ros.destroyed and not ros.is_on
