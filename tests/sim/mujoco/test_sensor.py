"""A touch sensor in MuJoCo scenes: what it reads, what it forgets, and what it refuses."""

import math
import subprocess
import sys

import jax
import numpy as np
import pytest
from refused import refused

mujoco = pytest.importorskip("mujoco")

import anytouch_jax as at  # noqa: E402
from anytouch_jax.sim.mujoco import TouchSensor, nominal_unit  # noqa: E402
from anytouch_jax.sim.mujoco.pad import Rays, gel_stiffness  # noqa: E402
from anytouch_jax.sim.sensing.sensors import SENSORS  # noqa: E402
from experiments.mujoco.scenes import MM, SHAPES, height_map, loaded, pressing_scene  # noqa: E402

SIZE = 48
PAD = 'type="box" size="0.007125 0.0095 .0005"'


def scene(shape="ball", sensor="digit", **options):
    return loaded(pressing_scene(SHAPES[shape], sensor, **options))


def sensor_of(model, sensor="digit", **options):
    return TouchSensor(model, options.pop("site", "pad"), sensor, size=SIZE, **options)


def pressed(model, data, newton, steps=300, **start):
    """Press the object with a weight until it rests."""
    data.qpos[:2] = start.get("x", 0.0), start.get("y", 0.0)
    data.qpos[3] = start.get("turn", 0.0)
    data.qfrc_applied[2] = -newton
    mujoco.mj_step(model, data, steps)


def slide(model, data, by, steps=10, dt=0.01):
    """Move the object by (x m, y m, turn rad) in small steps, at a speed that explains it."""
    data.qvel[:] = 0
    for joint, way in zip((0, 1, 3), by, strict=True):
        data.qpos[joint] += way
        data.qvel[joint] = way / dt
    data.time += dt
    mujoco.mj_forward(model, data)
    data.qvel[:] = 0


def test_a_press_is_that_of_simulate_touch():
    key = jax.random.split(jax.random.key(0), 2)[1]
    unit = nominal_unit("digit")
    simulate = jax.jit(lambda relief, pose: at.simulate_touch(relief, pose, size=SIZE, unit=unit))
    for shape in ("ball", "box"):
        model, data = scene(shape)
        touch = sensor_of(model)
        for x, y, turn, newton in ((0.0, 0.0, 0.0, 0.5), (1.5, -2.0, 0.4, 1.0)):
            mujoco.mj_resetData(model, data)
            touch.reset()
            pressed(model, data, newton, x=x * MM, y=y * MM, turn=turn)
            reading = touch.read(data, key)
            c, s = math.cos(turn), math.sin(turn)
            pose = [-(c * x + s * y), s * x - c * y, turn, float(reading.indentation)]
            other = simulate(height_map(SHAPES[shape]), np.asarray([pose], np.float32))
            inside = np.asarray(other.pressure[0]) > 0.02 * np.asarray(other.pressure[0]).max()
            apart = np.abs(reading.image.astype(float) - np.asarray(other.image[0])).mean(-1)
            assert inside.any() and apart[inside].mean() < 1
            # MuJoCo's force, ours, and the other's
            np.testing.assert_allclose(reading.force[2], newton, rtol=1e-2)
            np.testing.assert_allclose(other.force[0, 2], newton, rtol=2e-2)
            assert reading.touched and reading.depth.max() > 0.1


def test_stick_partial_slip_and_slip_follow_the_pull():
    model, data = scene(friction=0.6)
    touch = sensor_of(model)
    pressed(model, data, 1.0, 500)
    slips = []
    for pull in (0.0, 0.3, 0.5):
        data.qfrc_applied[:2] = pull * np.cos(0.5), pull * np.sin(0.5)
        mujoco.mj_step(model, data, 100)
        reading = touch.read(data)
        np.testing.assert_allclose(reading.force, [*data.qfrc_applied[:2], 1.0], atol=2e-2)
        slips.append(float(reading.slip))
        held = reading
    assert slips[0] < slips[1] < slips[2] < 1
    assert np.abs(held.shear).max() > 0.2
    # beyond friction it slides, in the direction of its velocity
    model.dof_damping[:2] = 8.0
    data.qfrc_applied[:2] = 1.2 * np.cos(2.0), 1.2 * np.sin(2.0)
    mujoco.mj_step(model, data, 60)
    reading = touch.read(data)
    way = math.atan2(data.qvel[1], data.qvel[0])
    along = math.atan2(reading.force[1], reading.force[0])
    assert abs((along - way + math.pi) % (2 * math.pi) - math.pi) < math.radians(15)
    assert reading.slip > 0.7
    # the image's x and y are the pad's
    assert reading.force[0] < 0 < reading.force[1]


def test_motion_twist_and_their_history():
    """With load depth the motion alone drives the shear: no force of MuJoCo is asked for."""
    model, data = scene("box")
    touch = sensor_of(model, load="depth")
    data.qpos[2] = -0.4 * MM
    mujoco.mj_forward(model, data)
    first = touch.read(data)
    assert np.abs(first.force[:2]).max() < 1e-3 and abs(first.torque) < 0.05
    np.testing.assert_allclose(first.indentation, 0.4, atol=1e-3)
    slide(model, data, (0.2 * MM, 0, 0))
    right = touch.read(data)
    assert right.force[0] > 0.1 and abs(right.force[1]) < 0.1 * right.force[0]
    slide(model, data, (-0.1 * MM, 0, 0))
    back = touch.read(data)
    assert back.force[0] < 0.9 * right.force[0]
    slide(model, data, (0, 0, 0.1))
    assert touch.read(data).torque > 0.5
    # a jump that no velocity explains forgets, as reset does
    data.qpos[0] += 3 * MM
    mujoco.mj_forward(model, data)
    assert np.abs(touch.read(data).force[:2]).max() < 0.1 * right.force[0]
    slide(model, data, (0.2 * MM, 0, 0))
    assert touch.read(data).force[0] > 0.1
    touch.reset()
    assert np.abs(touch.read(data).force[:2]).max() < 0.1 * right.force[0]
    # so does time that goes back
    slide(model, data, (0.2 * MM, 0, 0))
    assert touch.read(data).force[0] > 0.1
    data.time = 0
    assert np.abs(touch.read(data).force[:2]).max() < 0.1 * right.force[0]


def test_nothing_touched_is_the_background_with_its_noise():
    model, data = scene()
    touch = sensor_of(model)
    data.qpos[2] = 5 * MM
    mujoco.mj_forward(model, data)
    one, two = touch.read(data), touch.read(data)
    assert not one.touched and not one.depth.any() and not one.force.any()
    apart = one.image.astype(int) - one.background
    assert apart.any() and abs(apart).mean() < 2
    assert (one.image != two.image).any()
    # the noise starts again, and a key repeats it
    touch.reset()
    np.testing.assert_array_equal(touch.read(data).image, one.image)
    key = jax.random.key(7)
    np.testing.assert_array_equal(touch.read(data, key).image, touch.read(data, key).image)


def gripper(ball="0 0 0"):
    pad = """<geom name="{0}" type="box" size=".007125 .0095 .002" pos="0 0 -.002"/>
      <site name="{0}_pad" type="box" size="0.007125 0.0095 .0005"/>"""
    return f"""<mujoco><option gravity="0 0 0" cone="elliptic" impratio="100"/><worldbody>
      <body name="left" pos="-.0045 0 0" euler="0 90 0">
        <joint name="left" type="slide" axis="0 0 1"/>{pad.format("left")}</body>
      <body name="right" pos=".0045 0 0" euler="0 -90 0">{pad.format("right")}</body>
      <body name="ball" pos="{ball}"><freejoint/>
        <geom name="ball" type="sphere" size=".004" mass=".02"/></body>
    </worldbody></mujoco>"""


def test_two_pads_are_one_batch_and_several_scenes_too():
    model = mujoco.MjModel.from_xml_string(gripper())
    touch = TouchSensor(model, ("left_pad", "right_pad"), size=SIZE)
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = 0.5
    mujoco.mj_step(model, data, 300)
    both = touch.read(data)
    assert both.image.shape == (2, 64, 48, 3) and both.touched.all()
    np.testing.assert_allclose(both.force[:, 2], 0.5, rtol=0.05)
    free = mujoco.MjData(model)
    mujoco.mj_forward(model, free)
    touch.reset()
    scenes = touch.read([data, free])
    assert scenes.touched.tolist() == [[True, True], [False, False]]
    assert scenes.depth.shape == (2, 2, 64, 48)
    np.testing.assert_allclose(scenes.depth[0], both.depth, atol=1e-4)


def test_the_pad_is_as_soft_as_its_gel():
    model, data = scene("ball")
    sensor_of(model)
    pressed(model, data, 0.5, 800)
    stiffness = gel_stiffness(SENSORS["digit"].gel)
    np.testing.assert_allclose(-data.qpos[2] * stiffness, 0.5, rtol=0.1)
    hard, data = scene("ball")
    sensor_of(hard, compliant=False)
    pressed(hard, data, 0.5, 800)
    assert -data.qpos[2] * stiffness < 0.25


def test_wrong_scenes_are_told_in_a_sentence():
    xml = pressing_scene(SHAPES["ball"], "digit")
    refused("has no site nose; it has pad", sensor_of, loaded(xml)[0], site="nose")
    round_site = xml.replace('<site name="pad" type="box"', '<site name="pad" type="sphere"')
    refused("pad has no extent: make it a box", sensor_of, loaded(round_site)[0])
    small = xml.replace(
        'type="box" size="0.007125 0.0095 .0005"', 'type="box" size=".001 .001 .001"'
    )
    refused(r"is 2 x 2 mm, but the gel of digit is 14\.25 x 19 mm", sensor_of, loaded(small)[0])
    off = xml.replace(f'<site name="pad" {PAD}', f'<site name="pad" pos="0 0 .003" {PAD}')
    assert off != xml
    refused("lies 3 mm in front of the surface", sensor_of, loaded(off)[0])
    down = xml.replace(f'<site name="pad" {PAD}', f'<site name="pad" euler="180 0 0" {PAD}')
    refused("is not on a pad", sensor_of, loaded(down)[0])
    refused("tac3d has no camera", sensor_of, loaded(xml)[0], "tac3d")
    refused("there is no simulated sensor", sensor_of, loaded(xml)[0], "nose")
    refused("load is", sensor_of, loaded(xml)[0], load="weight")
    model, data = loaded(xml)
    data.qpos[2] = -3.5 * MM
    mujoco.mj_forward(model, data)
    refused("object is 3.5 mm inside the pad pad at the start", sensor_of(model).read, data)
    # around the whole pad, MuJoCo may push it away to any side
    large = SHAPES["ball"]._replace(geom='type="sphere" size=".03"')
    model, data = loaded(pressing_scene(large, "digit"))
    data.qpos[0], data.qpos[2] = 0.012, -0.008
    mujoco.mj_forward(model, data)
    refused("mm inside the pad pad at the start", sensor_of(model).read, data)


def test_data_of_another_scene_are_told():
    touch = sensor_of(scene()[0])
    other = mujoco.MjData(mujoco.MjModel.from_xml_string(gripper()))
    refused("another model", touch.read, other)
    refused("no scene to read", touch.read, [])


def test_a_rounded_pad_is_touched_in_its_middle():
    """The surface of the gel is that of the pad's geom: a box touches a ball in the middle."""
    flat = pressing_scene(SHAPES["box"], "digit")
    place = flat.index('<geom name="pad" type="box"')
    end = flat.index("friction", place)
    ball = flat[:place] + '<geom name="pad" type="sphere" size=".02" pos="0 0 -.02" ' + flat[end:]
    edges = []
    for xml in (flat, ball):
        model, data = loaded(xml)
        touch = sensor_of(model)
        pressed(model, data, 0.3)
        pressure = np.asarray(touch.read(data).pressure)
        rows, columns = pressure.shape
        middle = pressure[rows // 2 - 2 : rows // 2 + 2, columns // 2 - 2 : columns // 2 + 2].mean()
        edges.append(pressure.max() / middle)
    assert edges[0] > 1.3 and edges[1] < 1.1


def test_a_scene_with_nan_is_not_one_without_contact():
    model, data = scene()
    touch = sensor_of(model)
    data.qpos[0] = np.nan
    refused("NaN in its state", touch.read, data)
    # MuJoCo resets such a scene by itself, and the scene looks well again
    mujoco.mj_step(model, data)
    assert np.isfinite(data.qpos).all()
    refused("MuJoCo has reset it", touch.read, data)
    touch.reset()
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    touch.read(data)


@pytest.mark.parametrize("word", ["poses", "sizes"])
def test_nan_outside_of_the_state_is_not_without_contact_either(word):
    """MuJoCo moves a mocap body to NaN, and may find no contact of a geom without a size."""
    xml = pressing_scene(SHAPES["ball"], "digit")
    model, data = loaded(xml.replace('<body name="finger">', '<body name="finger" mocap="true">'))
    touch = sensor_of(model)
    pressed(model, data, 0.5)
    assert touch.read(data).touched
    if word == "poses":
        data.mocap_quat[:] = np.nan
    else:
        model.geom_size[:] = np.nan
    mujoco.mj_forward(model, data)
    assert np.isfinite(data.qpos).all()
    refused(f"NaN in its {word}", touch.read, data)


def test_a_flex_is_refused():
    flex = """<flexcomp name="cloth" type="grid" count="5 5 1" spacing=".003 .003 .003"
      pos="0 0 -.0002" radius=".001" mass=".01"><contact selfcollide="none"/></flexcomp>"""
    xml = pressing_scene(SHAPES["ball"], "digit").replace("</worldbody>", flex + "</worldbody>")
    model, data = loaded(xml)
    touch = sensor_of(model)
    data.qpos[2] = 0.02
    mujoco.mj_forward(model, data)
    refused("a flex touches the pad pad", touch.read, data)


def test_a_finger_behind_which_something_lies_feels_what_is_in_front():
    """Rays start far behind the pad; other geoms of the touched body there are left out."""
    xml = pressing_scene(SHAPES["ball"], "digit").replace(
        '<geom name="object"',
        '<geom name="behind" type="box" size=".02 .02 .002" pos="0 0 -.02" mass="0"/>'
        '<geom name="object"',
    )
    before = None
    for text in (pressing_scene(SHAPES["ball"], "digit"), xml):
        model, data = loaded(text)
        touch = sensor_of(model)
        data.qpos[2] = -0.5 * MM
        data.qfrc_applied[2] = -0.5
        mujoco.mj_forward(model, data)
        reading = touch.read(data)
        assert reading.touched
        if before is not None:
            np.testing.assert_allclose(reading.depth, before.depth, atol=1e-4)
        before = reading


def test_rays_meet_what_a_ray_meets():
    """Many geoms to a body, some of which collide by a pair alone or not at all."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        geoms = ""
        for kind in rng.choice(["box", "sphere", "capsule", "cylinder", "ellipsoid"], 4):
            size, place, turn = rng.uniform(0.003, 0.01, 3), *rng.uniform(-0.03, 0.03, (2, 3))
            words = [" ".join(map(str, one)) for one in (size, place, 6000 * turn)]
            mask = rng.integers(2)
            geoms += (
                f'<geom type="{kind}" size="{words[0]}" pos="{words[1]}" euler="{words[2]}" '
                f'contype="{mask}" conaffinity="{mask}" mass=".1" rgba="1 1 1 {mask}"/>'
            )
        model, data = loaded(
            f'<mujoco><worldbody><site name="pad" euler="{rng.integers(360)} 70 20"/>'
            f"<body><freejoint/>{geoms}</body></worldbody></mujoco>"
        )
        mujoco.mj_forward(model, data)
        points = tuple(rng.uniform(-0.03, 0.03, (2, 40)))
        along, _ = Rays(model).along(data, 0, [0, 1, 2, 3], points)
        model.geom_rgba[:, 3] = 1
        frame = data.site_xmat[0].reshape(3, 3)
        for x, y, z in zip(*points, along, strict=True):
            start = frame @ [x, y, -1]
            far = mujoco.mj_ray(model, data, start, frame[:, 2], None, 1, -1, np.zeros(1, np.int32))
            # Beside a rim the rays, which are not quite parallel, may pass.
            if np.isfinite(z) and far >= 0:
                assert abs(z - 1e3 * (far - 1)) < 0.1
            assert np.isfinite(z) == (far >= 0)


def test_the_core_imports_none_of_it_and_the_extra_is_named():
    code = (
        "import sys, anytouch_jax as at\n"
        "assert not {'mujoco', 'gymnasium', 'anytouch_jax.sim'} & set(sys.modules)\n"
        "sys.modules['mujoco'] = None\n"
        "try:\n    at.sim.mujoco.TouchSensor\n"
        "except at.UserError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert 'pip install "anytouch_jax[mujoco]"' in done.stdout, done.stderr
