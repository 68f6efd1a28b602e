"""Preparation of touches on the device: augmentation, background subtraction, scale-free fields.

These are pure functions of a key. They serve real frames on the device and simulated ones alike, so
that the two cannot be told apart by their preparation.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.ndimage import map_coordinates

from anytouch_jax.batch import FieldBatch
from anytouch_jax.config import Config
from anytouch_jax.config.augmentation import TouchAugmentation
from anytouch_jax.data.transforms import UNTOUCHED
from anytouch_jax.sim.contact.mechanics import KPA_MM2
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.endless import SimulatedTouches

# Fraction of touches whose background is subtracted, by --data.background.
SUBTRACTED = {"keep": 0.0, "subtract": 1.0, "either": 0.7}
# Largest deviation, in pixels, of the place of a gel since its image: 0.2 on still recordings of
# a GelSight Mini.
MOVED = 0.5


def augmented(key: Array, clip: Leaf, config: Config) -> Array:
    """Return clips u8 (B, T, S, S, 3), mirrored, turned, shifted, zoomed and stretched.

    Frames of a clip move alike. This is `data.transforms.touch_transform` on the device.
    """
    settings = TouchAugmentation.of(config.data)
    toss, turn = jax.random.split(key)
    across, down = jax.random.bernoulli(toss, settings.flip, (2, len(clip), 1, 1, 1, 1))
    clip = jnp.where(across, clip[:, :, :, ::-1], clip)
    clip = jnp.where(down, clip[:, :, ::-1], clip)
    if not any((settings.turn, settings.shift, settings.zoom)):
        return clip
    draws = jax.random.uniform(turn, (len(clip), 5), minval=-1.0)
    return jax.vmap(partial(_warped, settings=settings))(clip, draws)


def _warped(clip: Array, draw: Array, settings: TouchAugmentation) -> Array:
    """Turn, zoom, stretch and shift a clip u8 (T, S, S, 3) about its centre.

    `draw` (5,) in -1..1 are parts of the largest turn, zoom, shift down, shift across and stretch.
    """
    angle = jnp.deg2rad(draw[0] * settings.turn)
    zoom = (1 + settings.zoom) ** draw[1]
    stretch = settings.stretch ** draw[4]
    height, width = clip.shape[1:3]
    # From a place in the result back to its source: shift, turn, then zoom, each inverted.
    y, x = jnp.mgrid[:height, :width]
    y = y - (height - 1) / 2 - draw[2] * settings.shift * height
    x = x - (width - 1) / 2 - draw[3] * settings.shift * width
    source = jnp.stack(
        [jnp.cos(angle) * y - jnp.sin(angle) * x, jnp.sin(angle) * y + jnp.cos(angle) * x]
    )
    source = source / (zoom * jnp.stack([stretch**0.5, stretch**-0.5]))[:, None, None]
    source = source + jnp.array([(height - 1) / 2, (width - 1) / 2])[:, None, None]
    planes = jnp.moveaxis(clip, -1, 1).reshape(-1, height, width).astype(jnp.float32)
    warped = jax.vmap(lambda plane: map_coordinates(plane, list(source), order=1, mode="mirror"))(
        planes
    )
    warped = jnp.round(warped).astype(jnp.uint8).reshape(clip.shape[0], 3, height, width)
    return jnp.moveaxis(warped, 1, -1)


def prepared(
    key: Array, clip: Leaf, background: Leaf, config: Config, *, jitter: bool = True
) -> Array:
    """Return clips u8 (B, T, S, S, 3), the background (B, S, S, 3) subtracted or not.

    Args:
        key: of the jitter.
        clip: u8 (B, T, S, S, 3).
        background: u8 (B, S, S, 3), the untouched gels.
        config: says whether the background is subtracted, and how strong the jitter is.
        jitter: change brightness and colours, about the grey of an untouched gel.
    """
    settings = TouchAugmentation.of(config.data)
    choice, light = jax.random.split(key)
    frames = clip.astype(jnp.float32)
    gel = background[:, None].astype(jnp.float32)
    size = (len(clip), 1, 1, 1, 3)
    fraction = SUBTRACTED[config.data.background]
    subtract = jax.random.bernoulli(choice, fraction, (len(clip), 1, 1, 1, 1))
    x = jnp.where(subtract, frames - gel, frames - UNTOUCHED)
    if jitter:
        gain, colour, level = jax.random.normal(light, (3, *size))
        factor = jnp.exp(settings.brightness * gain[..., :1] + settings.colour * colour)
        x = x * factor + settings.level * level
    return jnp.round(jnp.clip(x + UNTOUCHED, 0, 255)).astype(jnp.uint8)


def misregistered_background(
    key: Array, touches: SimulatedTouches, most: float = MOVED
) -> SimulatedTouches:
    """Return touches whose backgrounds are shifted by fractions of a pixel.

    A gel gives way in its mount, so a real background is never quite in register.
    """
    fraction, to = jax.random.split(key)
    size = touches.background.shape[:2]
    shift = most * jax.random.uniform(fraction, (*size, 1)) * jax.random.normal(to, (*size, 2))

    def moved(image: Leaf, by: Array) -> Array:
        image = image.astype(jnp.float32)
        return jax.image.scale_and_translate(
            image, image.shape, (0, 1), jnp.ones(2), by, "linear", antialias=False
        )

    return touches._replace(background=jax.vmap(jax.vmap(moved))(touches.background, shift))


def field_batch(
    key: Array, touches: SimulatedTouches, sensor: Array, config: Config, count: int
) -> FieldBatch:
    """Return the first `count` touches of the last take with their fields, free of scale.

    Lengths are over the width of the image, pressure is over the gel's modulus, and forces are
    over modulus times width squared. So a gel of twice the size that is touched by an object of
    twice the size has the same fields.

    Args:
        key: of the preparation.
        touches: simulated, of M takes each.
        sensor: rows (B, M) of the sensor table.
        config: of the run.
        count: of touches with fields.
    """
    assert touches.fields is not None
    clip = touches.clip[:count, -1, -config.model.frames :]
    width = touches.width[:count, -1]
    labels = {name: x[:count, -1, -1] for name, x in touches.labels.items()}
    fields = touches.fields[:count, -1]
    stiff = touches.modulus[:count, -1]
    aspect = touches.aspect[:count, -1]
    scale = stiff * width**2 * KPA_MM2
    force = jnp.stack([labels["force_x"], labels["force_y"], labels["force"]], -1) / scale[:, None]
    shown = fields[..., 3] / stiff[:, None, None]
    # Force outside of the image cannot be seen, so the normal force is the sum of what is shown:
    # the mean pressure times the area, which is width times height.
    force = force.at[:, 2].set(jnp.mean(shown, (1, 2)) * jnp.exp(aspect))
    return FieldBatch(
        prepared(key, clip, touches.background[:count, -1], config, jitter=False),
        sensor[:count, -1],
        aspect,
        fields[..., 0] / width[:, None, None],
        fields[..., 1:3] / width[:, None, None, None],
        shown,
        force,
        labels["torque"] / (scale * width),
        labels["slip"],
    )
