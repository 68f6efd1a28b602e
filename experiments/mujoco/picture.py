"""The picture and the video of the documentation: a gripper lifts a can, and what its pads see.

    python -m experiments.mujoco.picture

The scene is drawn by MuJoCo's rays, so no graphics library is needed.
"""

from __future__ import annotations

import argparse
import copy
from pathlib import Path

import cv2
import mujoco
import numpy as np
from PIL import Image

from anytouch_jax.sim.mujoco import TouchSensor, nominal_unit
from anytouch_jax.sim.mujoco.pad import widen
from experiments.mujoco.gripper import gripper_scene
from experiments.mujoco.tasks import CAN, SENSOR

PICTURES = Path(__file__).parents[2] / "docs" / "pictures"
SIZE = (300, 400)  # pixels (height, width) of the scene
TWICE = 2  # rays to a pixel along each side
LIGHT = np.array([0.3, -0.6, 0.75])
SKY = np.array([0.97, 0.97, 1.0])


def scene_picture(model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> np.ndarray:
    """Return a picture u8 (h, w, 3) of a scene by a camera: a ray to a pixel, lit by its normal."""
    rows, columns = (TWICE * side for side in SIZE)
    number = model.camera(camera).id
    half = np.tan(np.deg2rad(model.cam_fovy[number]) / 2)
    y, x = np.meshgrid(
        np.linspace(half, -half, rows),
        np.linspace(-half, half, columns) * columns / rows,
        indexing="ij",
    )
    ways = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways = ways @ data.cam_xmat[number].reshape(3, 3).T
    count = len(ways)
    met = np.full(count, -1, np.int32)
    far = np.zeros(count)
    normal = np.zeros(3 * count)
    eye = data.cam_xpos[number]
    wide = copy.copy(model)
    widen(wide)
    mujoco.mj_multiRay(
        wide, data, eye, ways.reshape(-1), None, True, -1, met, far, normal, count, 10.0
    )
    normals = normal.reshape(-1, 3)
    lit = 0.45 + 0.55 * np.abs(normals @ (LIGHT / np.linalg.norm(LIGHT)))
    colour = model.geom_rgba[met, :3] * lit[:, None]
    table = met == model.geom("table").id
    place = eye + ways * far[:, None]
    checks = (np.floor(place[:, 0] / 0.02) + np.floor(place[:, 1] / 0.02)) % 2
    colour[table] = (0.8 + 0.08 * checks[table])[:, None]
    # Things stand on the table: a soft shadow around each.
    away = np.hypot(*(place[:, :2] - data.body("object").xpos[:2]).T)
    shade = 1 - 0.35 * np.exp(-((away / 0.02) ** 2))
    colour[table] *= shade[table, None]
    colour[met < 0] = SKY
    picture = (255 * np.clip(colour, 0, 1)).astype(np.uint8).reshape(rows, columns, 3)
    return cv2.resize(picture, SIZE[::-1], interpolation=cv2.INTER_AREA)


def frames() -> list[np.ndarray]:
    """Return the frames of a lift: too light a grip, which slips, and then a firmer one."""
    model = mujoco.MjModel.from_xml_string(gripper_scene(SENSOR, CAN, half=11.0))
    data = mujoco.MjData(model)
    pads = ("left_pad", "right_pad")
    touch = TouchSensor(model, pads, SENSOR, size=112, unit=nominal_unit(SENSOR, dots=True))
    made = []
    for step in range(52):
        second = step / 12.5
        grip = np.interp(second, [0, 0.2, 1.9, 2.2], [0.2, 0.72, 0.72, 2.2])
        part = np.clip((second - 0.6) / 2.6, 0, 1)
        for _ in range(8):
            data.ctrl[0] = 0.045 * part**2 * (3 - 2 * part)
            data.ctrl[2:] = grip
            mujoco.mj_step(model, data, 5)
        reading = touch.read(data)
        gels = [cv2.resize(one, (200, 150)) for one in reading.image]
        view = scene_picture(model, data, "view")
        words = (
            f"grip {reading.force[0, 2]:.2f} N   shear {reading.force[0, 1]:.2f} N   "
            f"slip {reading.slip[0]:.0%}"
        )
        cv2.putText(view, words, (10, 288), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, 16)
        made.append(np.hstack([view, np.vstack(gels)]))
    return made


def main() -> None:
    """Write the picture and the video."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=PICTURES)
    folder = parser.parse_args().out
    made = frames()
    Image.fromarray(made[-1]).save(folder / "mujoco.png")
    images = [Image.fromarray(one) for one in made]
    images[0].save(
        folder / "mujoco.webp",
        save_all=True,
        append_images=images[1:],
        duration=80,
        loop=0,
        quality=60,
        method=6,
    )
    for name in ("mujoco.png", "mujoco.webp"):
        print(folder / name, (folder / name).stat().st_size)


if __name__ == "__main__":
    main()
