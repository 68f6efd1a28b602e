"""A ROS 2 node of a live camera: features, contact, force and points of touch.

It publishes /touch/features, /touch/contact, /touch/wrench (N, N m) and /touch/points (m).

ros2 run needs a package. This file runs alone:

    python integrations/ros2/touch_node.py --ros-args -p sensor:=digit

Wrench and points need an encoder that measures. Their frame is the parameter frame, the optical
frame of the camera (REP 103), which is right-handed: x to the right of the image, y down, z away
from the camera, towards the object. The wrench is that of the object on the gel, about the centre
of pressure: a press has a negative z. The surface of the gel lies at z = 0, and at negative z where
it is pressed.
"""

import contextlib

import rclpy
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Bool, Float32MultiArray, Header

import anytouch_jax as at
from anytouch_jax.data.images import decode
from anytouch_jax.encoder.linear_head import ContactGate
from anytouch_jax.live.stream import open_source, stream

PARAMETERS = {
    "model": "anytouch-tiny",
    "camera": "0",
    "sensor": "digit",
    "background": "",
    "width_mm": "0",
    "frame": "touch",
}


def wrench(fields, header: Header) -> WrenchStamped:
    x, y, into_the_gel = map(float, fields.force[0])
    # The gel lies between the camera and the object, so into the gel is towards the camera.
    z = -into_the_gel
    # The torque turns from x to y, which is about z.
    turn = Vector3(x=0.0, y=0.0, z=float(fields.torque[0]) / 1000)
    return WrenchStamped(header=header, wrench=Wrench(force=Vector3(x=x, y=y, z=z), torque=turn))


def cloud(fields, header: Header) -> PointCloud2:
    points = fields.points()[0].astype("<f4") / 1000  # mm to m
    axes = [
        PointField(name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1)
        for place, name in enumerate("xyz")
    ]
    height, width = points.shape[:2]
    return PointCloud2(
        header=header,
        height=height,
        width=width,
        fields=axes,
        is_bigendian=False,
        point_step=12,
        row_step=12 * width,
        data=points.tobytes(),
        is_dense=True,
    )


def parameters(node: Node) -> dict[str, str]:
    """Declare the parameters and return their values as text."""
    # camera:=0 is a number for ROS, and a word for us.
    any_type = ParameterDescriptor(dynamic_typing=True)
    return {
        name: str(node.declare_parameter(name, default, any_type).value)
        for name, default in PARAMETERS.items()
    }


def publishers(node: Node) -> dict:
    """Return what publishes each kind of message by its name. Only the newest is kept."""
    kinds = {
        "features": Float32MultiArray,
        "contact": Bool,
        "wrench": WrenchStamped,
        "points": PointCloud2,
    }
    return {
        name: node.create_publisher(kind, f"touch/{name}", 1).publish
        for name, kind in kinds.items()
    }


def frames_of(values: dict[str, str]):
    """Open the camera and the encoder, and return the embedded frames."""
    encoder = at.load_encoder(values["model"])
    source, live = open_source(values["camera"])
    gel = decode(values["background"]) if values["background"] else None
    # Without an image of the gel, one is estimated from the frames.
    preprocess = at.Preprocess(encoder, gel)
    length = 1
    measure = None
    if encoder.measures:
        # Shear and slip are those from frame to frame, so they need a clip.
        length = encoder.config.model.frames
        width = float(values["width_mm"]) or None
        measure = encoder.measure_of(values["sensor"], gel, width)
    return stream(
        encoder,
        source,
        preprocess,
        live=live,
        sensor=encoder.sensor_row(values["sensor"]),
        contact=ContactGate(preprocess, values["sensor"]),
        frames=length,
        measure=measure,
    )


def main() -> None:
    rclpy.init()
    node = Node("touch")
    values = parameters(node)
    send = publishers(node)
    frames = frames_of(values)
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(frames):
        for frame in frames:
            # Ctrl-C has ended ROS, which then refuses to publish.
            if not rclpy.ok():
                break
            send["features"](Float32MultiArray(data=frame.values.tolist()))
            # NaN without a background: contact is unknown, and nothing is said.
            if frame.contact == frame.contact:
                send["contact"](Bool(data=bool(frame.contact)))
            # Force is None if nobody knows the mm that the image shows.
            if frame.fields is not None and frame.fields.force is not None:
                header = Header(stamp=node.get_clock().now().to_msg(), frame_id=values["frame"])
                send["wrench"](wrench(frame.fields, header))
                send["points"](cloud(frame.fields, header))
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
