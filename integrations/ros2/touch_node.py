"""A ROS 2 node that publishes features and contact of a live camera: /touch/features and /touch/contact.

ros2 run needs a package. This file runs alone: python integrations/ros2/touch_node.py --ros-args -p sensor:=digit
"""

import contextlib

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from std_msgs.msg import Bool, Float32MultiArray

import anytouch_jax as at
from anytouch_jax.data.images import decode
from anytouch_jax.encoder.novelty import ContactGate
from anytouch_jax.encoder.stream import open_source, stream


def main() -> None:
    rclpy.init()
    node, any_type = Node("touch"), ParameterDescriptor(dynamic_typing=True)  # camera:=0 is a number for ROS
    values = {name: str(node.declare_parameter(name, default, any_type).value) for name, default in (
        ("model", "anytouch-tiny"), ("camera", "0"), ("sensor", "digit"), ("background", ""))}  # fmt: skip
    features = node.create_publisher(Float32MultiArray, "touch/features", 1)  # a queue of one: the newest counts
    contact = node.create_publisher(Bool, "touch/contact", 1)
    encoder, (source, live) = at.load_encoder(values["model"]), open_source(values["camera"])
    gel = decode(values["background"]) if values["background"] else None
    preprocess = at.Preprocess(encoder, gel)  # without a picture it estimates one from the frames
    gate, row = ContactGate(preprocess, values["sensor"]), encoder.sensor_row(values["sensor"])
    frames = stream(encoder, source, preprocess, live=live, sensor=row, contact=gate)
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(frames):
        for frame in frames:
            if not rclpy.ok():  # Ctrl-C has ended ROS, which then refuses to publish
                break
            features.publish(Float32MultiArray(data=frame.values.tolist()))
            if frame.contact == frame.contact:  # NaN without a background: contact is unknown
                contact.publish(Bool(data=bool(frame.contact)))
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
