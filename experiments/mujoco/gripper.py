"""A gripper of two fingers with tactile pads, made by hand in MJCF, and what it holds.

It slides up and down (`lift`), turns about the axis through its pads (`wrist`), and presses with
two motors whose controls are newtons. The frame of a pad is that of its site: x and y as in the
image, z out of the gel.
"""

from __future__ import annotations

from anytouch_jax.sim.sensing.own import find_sensor

MM = 1e-3
OPEN = 30.0  # mm from the middle to a pad when the gripper is open
HEIGHT = 20.0  # mm of the pads above the table when it is down


def gripper_scene(sensor: str, held: str, *, half: float, gravity: float = 9.81) -> str:
    """Return MJCF of the gripper and an object.

    Args:
        sensor: Its pads are as large as the gel of this sensor.
        held: The geoms of the object, whose origin is between the pads.
        half: mm of the object's half width, which the fingers close to at first.
        gravity: m/s2 downwards.
    """
    height, width = (side / 2 * MM for side in find_sensor(sensor).field)
    # x of an image is x of the site: for both pads y points down.
    fingers = "".join(
        f"""
        <body name="{name}" pos="{side * half * MM} 0 0">
          <joint name="{name}" type="slide" axis="{-side} 0 0" range="-.03 .03" damping="6"/>
          <geom type="box" size=".004 .006 .03" pos="{side * 0.013} 0 .03" contype="0"
            conaffinity="0" rgba=".25 .27 .3 1" mass=".02"/>
          <geom type="box" size=".006 {width} {height}" pos="{side * 0.0075} 0 0" contype="0"
            conaffinity="0" rgba=".25 .27 .3 1" mass=".01"/>
          <geom name="{name}_gel" type="box" size=".0015 {width} {height}" pos="{side * 0.0015} 0 0"
            rgba=".75 .8 .9 1" mass=".01" friction="0.05"/>
          <site name="{name}_pad" type="box" size="{width} {height} .0002"
            xyaxes="0 {side} 0 0 0 -1" rgba="0 0 0 0"/>
        </body>"""
        for name, side in (("left", -1), ("right", 1))
    )
    return f"""
<mujoco model="gripper">
  <option timestep="0.002" cone="elliptic" impratio="100" gravity="0 0 {-gravity}"/>
  <visual><global offwidth="640" offheight="480"/><headlight ambient=".4 .4 .4"/></visual>
  <asset>
    <texture name="grid" type="2d" builtin="checker" rgb1=".9 .9 .92" rgb2=".82 .83 .86"
      width="256" height="256"/>
    <material name="table" texture="grid" texrepeat="12 12"/>
    <texture name="sky" type="skybox" builtin="flat" rgb1=".97 .97 1" width="64" height="64"/>
  </asset>
  <worldbody>
    <light pos=".1 -.3 .5" dir="-.2 .6 -1"/>
    <camera name="view" pos=".04 -.2 .11" xyaxes="1 .2 0 -.06 .28 1" fovy="42"/>
    <geom name="table" type="plane" size=".5 .5 .01" material="table" contype="2" conaffinity="2"/>
    <body name="hand" pos="0 0 {HEIGHT * MM}">
      <joint name="lift" type="slide" axis="0 0 1" damping="20"/>
      <joint name="wrist" type="hinge" axis="1 0 0" damping=".05"/>
      <geom type="box" size=".045 .01 .01" pos="0 0 .068" contype="0" conaffinity="0"
        rgba=".2 .2 .22 1" mass=".3"/>{fingers}
    </body>
    <body name="object" pos="0 0 {HEIGHT * MM}">
      <freejoint name="object"/>
      {held}
    </body>
  </worldbody>
  <actuator>
    <position name="lift" joint="lift" kp="4000" kv="120"/>
    <position name="wrist" joint="wrist" kp="60" kv="1"/>
    <motor name="left" joint="left"/>
    <motor name="right" joint="right"/>
  </actuator>
</mujoco>"""
