"""The ROS 2 node, run against the documented interface of rclpy (docs.ros.org, rclpy.node.Node)."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from places import ROOT


class Ros:
    """What the node sees of ROS: parameters keep the type of their default, and nothing is published after the end."""

    def __init__(self, given: dict, frames: int) -> None:
        self.given, self.frames, self.sent, self.destroyed, self.is_on = given, frames, [], False, False

    def modules(self) -> dict[str, ModuleType]:
        ros = self

        class Node:
            def __init__(self, node_name: str) -> None:
                assert ros.is_on

            def declare_parameter(self, name, value=None, descriptor=None, ignore_override=False):
                override = ros.given.get(name, value)
                if type(override) is not type(value) and not (descriptor and descriptor.dynamic_typing):
                    raise TypeError(f"InvalidParameterTypeException: {name}")
                return SimpleNamespace(value=override)

            def create_publisher(self, msg_type, topic, qos_profile):
                def publish(message):
                    assert ros.is_on and type(message) is msg_type
                    ros.sent.append((topic, message.data))

                return SimpleNamespace(publish=publish)

            def destroy_node(self):
                ros.destroyed = True

        class Bool:
            def __init__(self, *, data: bool) -> None:
                assert type(data) is bool
                self.data = data

        class Float32MultiArray:
            def __init__(self, *, data: list) -> None:
                assert all(type(value) is float for value in data)
                self.data = data

        def ok() -> bool:  # Ctrl-C comes after some frames
            self.is_on = self.is_on and sum(topic == "touch/features" for topic, _ in self.sent) < self.frames
            return self.is_on

        def switch(on: bool):
            return lambda: setattr(self, "is_on", on)

        content = {
            "rclpy": {"init": switch(True), "ok": ok, "try_shutdown": switch(False)}, "rclpy.node": {"Node": Node},
            "rcl_interfaces.msg": {"ParameterDescriptor": SimpleNamespace},
            "std_msgs.msg": {"Bool": Bool, "Float32MultiArray": Float32MultiArray},
        }  # fmt: skip
        modules = {part: ModuleType(part) for name in content for part in (name.partition(".")[0], name)}
        for name, values in content.items():
            vars(modules[name]).update(values)
        return modules


@pytest.mark.parametrize(("frames", "background"), [(99, True), (2, False)])
def test_features_and_contact_of_every_frame_until_ros_ends(monkeypatch, tmp_path, tiny_run, frames, background):
    monkeypatch.chdir(tmp_path)
    gel = np.full((48, 48, 3), 90, np.uint8)
    press = gel.copy()
    press[10:30, 10:30] += 90
    cv2.imwrite("gel.png", gel)
    writer = cv2.VideoWriter("7.avi", cv2.VideoWriter_fourcc(*"MJPG"), 30, (48, 48))
    for picture in (gel, gel, press, press):
        writer.write(picture)
    writer.release()
    (tmp_path / "7.avi").rename("7")  # a number, as camera:=0 is for ROS
    given = {"model": str(tiny_run), "camera": 7, "background": "gel.png" if background else ""}
    ros = Ros(given, frames)
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("touch_node", ROOT / "integrations" / "ros2" / "touch_node.py")
    node = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(node)
    node.main()
    features = [data for topic, data in ros.sent if topic == "touch/features"]
    assert len(features) == min(frames, 4) and len({len(one) for one in features}) == 1
    contact = [data for topic, data in ros.sent if topic == "touch/contact"]
    assert contact == ([False, False, True, True] if background else [])
    assert ros.destroyed and not ros.is_on
