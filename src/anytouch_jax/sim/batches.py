"""Batches of simulated touches for training, alone or mixed with real recordings.

Touches are simulated inside the training program (`sim.endless`), and none repeats. Real recordings
are kept on the device at the model's size, because a batch is put together there. A batch depends
on the seed and the step alone, so a run that was stopped continues to the bit.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.pools import CLIP, STILL
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.tokenizer import Tokenizer
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.sim import endless
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.endless import Sampling, SimulatedTouches, World
from anytouch_jax.sim.modalities import (
    WORDINGS,
    Texts,
    caption_tokenizer,
    photo_bank,
    real_captions,
    training_objects,
    wordings,
)
from anytouch_jax.sim.preparation import augmented, field_batch, misregistered_background, prepared
from anytouch_jax.sim.real import Pairs, Real, load_real
from anytouch_jax.sim.sensing.own import find_sensor

# `caption_tokenizer` is used by those who make a loader, which needs its result.
__all__ = ["FIELDS", "SIMULATED", "SimulatedLoader", "caption_tokenizer"]

SIMULATED = "simulated"  # the word of --data that stands for simulated touches
WEIGHT = 9.0  # of simulated touches (--data.weights simulated) over all real ones
# fraction of the touches of stage 1 and 2 that show an untouched gel, if fields are learned
FREE = (0.06, 0.02)
TRIES = 8  # draws in which a partner by another unit is looked for
FIELD_FRACTION = 0.5  # of a batch's touches: those whose fields are learned
FIELDS = ("displacement", "shear", "pressure")
MEDIAN = 0.4  # fraction of real touches whose background is the median, and not the stored image
Batch = TouchBatch | Stage2Batch
Info = dict[str, int]


# One program for all loaders of one form.
_sample = jax.jit(endless.sample_touches, static_argnames=("sampling", "count"))


class SimulatedLoader:
    """Batches for `config.stage` with the interface of `Loader`.

    Args:
        config: The run.
        manifest: Real recordings, or None.
        tokenizer: That of `caption_tokenizer`, which a text tower needs.
        devices: Devices of the mesh, of which packed images and texts are a multiple.
        log: Called with sentences about the data.

    Raises:
        UserError: For settings that do not fit.
    """

    def __init__(
        self,
        config: Config,
        manifest: Manifest | None = None,
        *,
        tokenizer: Tokenizer | None = None,
        devices: int = 1,
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        simulated = config.simulated
        model = config.model
        size = config.data.batch_size
        if config.recipe == "release":
            raise UserError("--data simulated is for the recipe paper; leave out --recipe release")
        self.config = config
        self.tokenizer = tokenizer
        self.notes = list[str]()
        self.objects = training_objects(config)
        world = endless.make_world(
            self.objects, simulated.sensors, places=simulated.places, seed=simulated.seed
        )
        self._rows = np.array(
            [model.sensor_row(find_sensor(name).name) for name in simulated.sensors]
            + [model.universal_row],
            np.int32,
        )
        self._real = None if manifest is None else load_real(manifest, config, log)
        self._count = size
        if self._real is not None:
            weight = dict(config.data.weights or ()).get(SIMULATED, WEIGHT)
            # At least one touch of each kind.
            self._count = max(1, min(size - 1, round(size * weight / (weight + 1))))
        self._photos: Array | None = None
        self._texts: Texts | None = None
        if config.stage == 2 and model.image is not None and simulated.vision:
            self._photos = jax.device_put(
                photo_bank(self.objects, np.asarray(world.places), model.image_size)
            )
        if config.stage == 2 and model.text is not None:
            self._texts = jax.device_put(self._encode(manifest))
        self._world = jax.device_put(world)
        self._key = jax.random.key(config.run.seed)
        self._pool: tuple[tuple[int, int], SimulatedTouches] | None = None
        has_clips = self._real is None or self._real.windows[CLIP] is not None
        self._has_clips = has_clips and config.data.clip_fraction > 0
        self._assemble = jax.jit(
            partial(_assemble, config=config, rows=self._rows, devices=devices)
        )

    @staticmethod
    def train_tokenizer(config: Config, manifest: Manifest | None) -> Tokenizer:
        """Return `caption_tokenizer`."""
        return caption_tokenizer(config, manifest)

    @property
    def steps_per_epoch(self) -> int:
        """Steps of a warm-up: simulated touches have no epoch."""
        return 1 << 30

    @property
    def trained_sensors(self) -> list[str]:
        """Names of the sensors that batches are drawn from, in the order of the sensor table."""
        rows = set(self._rows[:-1].tolist())
        if self._real is not None:
            rows |= set(np.asarray(self._real.sensor).tolist())
        return [name for number, name in enumerate(self.config.model.sensors) if number in rows]

    def _encode(self, manifest: Manifest | None) -> Texts:
        """Return the tokens of all captions, and of an empty one last."""
        tower = self.config.model.text
        tokenizer = self.tokenizer
        assert tower is not None and tokenizer is not None
        texts = [*wordings(self.objects), *real_captions(manifest)]
        # A multiple of eight, so that few lengths are compiled.
        length = min(tower.length, -(-tokenizer.longest(texts) // 8) * 8)
        return Texts(*tokenizer.encode([*texts, ""], length))

    def frames(self, step: int) -> int:
        """Return the frames of the touches of a step: 1 for stills."""
        fraction = self.config.data.clip_fraction if self._has_clips else 0.0
        is_clip = np.floor((step + 1) * fraction) > np.floor(step * fraction)
        if is_clip:
            return self.config.model.frames + self.config.reconstructs
        return 1

    def _sampled(self, step: int) -> tuple[Array, World, Sampling, int, Array]:
        """Return what the simulated touches of a step are sampled from."""
        config = self.config
        simulated = config.simulated
        sampling = Sampling(
            frames=self.frames(step),
            takes=config.stage,
            size=config.model.image_size,
            coarse=simulated.coarse,
            free=FREE[config.stage - 1] if config.model.fields else 0.0,
            vision=simulated.vision if self._photos is not None else 0.0,
            wild=simulated.wild,
            depth=simulated.depth,
            fields=FIELDS if config.model.fields else (),
            field_size=config.model.image_size // 2,
        )
        key = jax.random.fold_in(jax.random.fold_in(self._key, 1), step // simulated.reuse)
        gallery = jax.random.randint(
            jax.random.fold_in(key, sampling.frames), (), 0, len(simulated.sensors)
        )
        return key, self._world, sampling, self._count, gallery

    def touches(self, step: int) -> SimulatedTouches:
        """Return the simulated touches that a step draws from, on the device."""
        refuse_forked()
        name = (step // self.config.simulated.reuse, self.frames(step))
        if self._pool is None or self._pool[0] != name:
            self._pool = (name, _sample(*self._sampled(step)))
        return self._pool[1]

    @property
    def examples(self) -> list[tuple[Batch, Callable[[], Batch]]]:
        """A batch of stills and one of clips, if the run has both.

        Each is its shapes, and a function that makes it.
        """

        def shapes(step: int) -> Batch:
            key, world, sampling, count, gallery = self._sampled(step)
            sample = partial(endless.sample_touches, sampling=sampling, count=count)
            touches = jax.eval_shape(sample, key, world, gallery=gallery)
            batch: Batch = jax.eval_shape(
                self._assemble, key, touches, self._real, self._photos, self._texts
            )
            return batch

        first = {self.frames(step): step for step in range(20, -1, -1)}
        return [(shapes(step), partial(self.batch, step)) for step in first.values()]

    def stream(self, start: int, stop: int) -> Iterator[tuple[int, Batch, Info]]:
        """Yield (step, batch on the device, info) for steps start .. stop - 1."""
        for step in range(start, stop):
            yield step, self.batch(step), {"skipped_samples": 0}

    def batch(self, step: int) -> Batch:
        """Return the batch of a step, on the device."""
        key = jax.random.fold_in(jax.random.fold_in(self._key, 2), step)
        return self._assemble(key, self.touches(step), self._real, self._photos, self._texts)


class _Touches(NamedTuple):
    """Prepared touches."""

    clip: Array  # u8 (B, T, S, S, 3)
    sensor: Array  # (B,) rows of the sensor table


def _assemble(
    key: Array,
    touches: SimulatedTouches,
    real: Real | None,
    photos: Array | None,
    texts: Texts | None,
    *,
    config: Config,
    rows: np.ndarray,
    devices: int,
) -> Batch:
    """Return the batch of a step from simulated touches and the real frames.

    Args:
        key: Of the step. Each use has a key of its own, so leaving out a part changes no other.
        touches: As many as the batch has simulated ones.
        real: Real frames, which fill the rest of the batch.
        photos: u8 (objects, places, S, S, 3), or None without an image tower.
        texts: Captions, or None without a text tower.
        config: The run.
        rows: Rows of the sensor table of the simulated families, and of the universal tokens.
        devices: Devices of the mesh.
    """
    count = len(touches.object)
    sensor = jnp.asarray(rows)[touches.sensor]
    touches = misregistered_background(jax.random.fold_in(key, 7), touches)
    keys = jax.random.split(key, 6)
    takes = [
        _Touches(
            prepared(keys[m], touches.clip[:, m], touches.background[:, m], config), sensor[:, m]
        )
        for m in range(touches.clip.shape[1])
    ]
    fields = None
    if touches.fields is not None:
        fields = field_batch(
            keys[2], touches, sensor, config, _slots(count * FIELD_FRACTION, devices)
        )
    kind = STILL if touches.clip.shape[2] == 1 else CLIP
    if config.stage == 1:
        one = takes[0]
        if real is not None:
            one = _joined(one, _real_batch(keys[3], keys[4], real, kind, count, config))
        return TouchBatch(one.clip, one.sensor, fields)
    first, second = takes
    place = jnp.arange(count, dtype=jnp.int32)
    caption = _drawn_captions(keys[5], touches, texts, config)
    if real is not None:
        pairs = real.pairs[kind] if real.pairs[kind] is not None else real.pairs[STILL]
        assert pairs is not None
        at = _drawn(keys[3], pairs.fraction, config.data.batch_size - count)
        other = _partners(keys[4], pairs, at)
        first_key = jax.random.fold_in(keys[3], 1)
        first = _joined(first, _real_touches(first_key, real, pairs.rows[at], config))
        second_key = jax.random.fold_in(keys[4], 1)
        second = _joined(second, _real_touches(second_key, real, pairs.rows[other], config))
        place = jnp.concatenate([place, count + pairs.place[at]])
        own = real.caption[pairs.rows[at][:, -1]]
        # Captions of real rows come after the simulated ones, and an empty one is last.
        first_real = 0 if texts is None else len(texts.ids) - 2 - jnp.max(real.caption, initial=-1)
        caption = jnp.concatenate([caption, jnp.where(own >= 0, first_real + own, -1)])
    match = MatchBatch(first.clip, first.sensor, second.clip, second.sensor, place=place)
    if photos is None and texts is None:
        return Stage2Batch(None, match, fields)
    return Stage2Batch(_aligned(first, touches, caption, photos, texts, devices), match, fields)


def _real_batch(
    key: Array, draw_key: Array, real: Real, kind: int, count: int, config: Config
) -> _Touches:
    """Return the real touches that fill a batch of stage 1 with `count` simulated ones."""
    windows = real.windows[kind]
    assert windows is not None
    at = _drawn(draw_key, windows.fraction, config.data.batch_size - count)
    return _real_touches(key, real, windows.rows[at], config)


def _drawn_captions(
    key: Array, touches: SimulatedTouches, texts: Texts | None, config: Config
) -> Array:
    """Return the number of a caption of each touch (B,), -1 without."""
    count = len(touches.object)
    if texts is None:
        return jnp.full(count, -1)
    pick = jax.random.randint(key, (count,), 0, WORDINGS)
    has = jax.random.uniform(jax.random.fold_in(key, 1), (count,)) < config.simulated.text
    return jnp.where(has, touches.object * WORDINGS + pick, -1)


def _aligned(
    touch: _Touches,
    touches: SimulatedTouches,
    caption: Array,
    photos: Array | None,
    texts: Texts | None,
    devices: int,
) -> AlignBatch:
    """Return touches with the RGB images and captions that they have, in slots."""
    size = len(touch.sensor)
    # An unused slot has the row after the last one, and is dropped.
    image = jnp.zeros((0, *touch.clip.shape[2:]), jnp.uint8)
    image_row = jnp.zeros(0, jnp.int32)
    if photos is not None:
        count = len(touches.object)
        slots = min(_slots(count / 2, devices), count)
        # touches with an RGB image come first
        seen = jnp.argsort(touches.photo < 0, stable=True)[:slots]
        image = photos[touches.object[seen], jnp.maximum(touches.photo[seen], 0)]
        image_row = jnp.where(touches.photo[seen] >= 0, seen, size).astype(jnp.int32)
    text = jnp.zeros((0, 2), jnp.int32)
    mask = jnp.zeros((0, 2), bool)
    text_row = jnp.zeros(0, jnp.int32)
    if texts is not None:
        # number -1 is the empty caption, which is the last one
        text = texts.ids[caption]
        mask = texts.mask[caption]
        text_row = jnp.where(caption >= 0, jnp.arange(size), size).astype(jnp.int32)
    return AlignBatch(touch.clip, touch.sensor, image, image_row, text, mask, text_row)


def _slots(count: float, devices: int) -> int:
    """Return at least `count` rows, in a multiple of the devices."""
    return devices * max(1, -(-int(count) // devices))


def _joined(one: _Touches, other: _Touches) -> _Touches:
    """Return the touches of both."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)


def _drawn(key: Array, fraction: Leaf, count: int) -> Array:
    """Return `count` numbers drawn by their cumulative probabilities."""
    # The last probability may be rounded to just below one.
    return jnp.minimum(
        jnp.searchsorted(fraction, jax.random.uniform(key, (count,))), len(fraction) - 1
    )


def _partners(key: Array, pairs: Pairs, at: Array) -> Array:
    """Return a touch of the same place for each of `at`.

    It is by another unit if TRIES draws find one, else another touch, else the same.
    """
    draw = jax.random.uniform(key, (len(at), TRIES))
    tries = pairs.order[pairs.low[at][:, None] + (draw * pairs.many[at][:, None]).astype(jnp.int32)]
    score = 2 * (pairs.unit[tries] != pairs.unit[at][:, None]) + (tries != at[:, None])
    return jnp.take_along_axis(tries, jnp.argmax(score, 1)[:, None], 1)[:, 0]


def _real_touches(key: Array, real: Real, rows: Array, config: Config) -> _Touches:
    """Return augmented and prepared real touches of windows of rows (B, T)."""
    warp, gel, prepare = jax.random.split(key, 3)
    # The index 1 is the median, which a user without an image of the gel will have.
    which = jax.random.bernoulli(gel, MEDIAN, (len(rows),)).astype(jnp.int32)
    background = real.gel[real.gel_of[rows[:, -1]], which]
    moved = augmented(warp, jnp.concatenate([real.frame[rows], background[:, None]], 1), config)
    return _Touches(
        prepared(prepare, moved[:, :-1], moved[:, -1], config), real.sensor[rows[:, -1]]
    )
