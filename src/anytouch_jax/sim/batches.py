"""Batches of simulated touches for training, alone or mixed with real recordings.

Touches are simulated inside the training program (`sim.endless`), and none repeats. Real recordings
are kept on the device at the model's size. A batch depends on the seed and the step alone.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.ndimage import map_coordinates

from anytouch_jax.batch import AlignBatch, FieldBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.pools import CLIP, STILL, MatchPool, Pools, epoch_weights, find_pools
from anytouch_jax.data.loading.samples import SampleReader, read_image
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer, train_tokenizer
from anytouch_jax.data.transforms import UNTOUCHED, touch_evaluation
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.sim import endless, scene
from anytouch_jax.sim.contact.mechanics import KPA_MM2
from anytouch_jax.sim.endless import Sampling, SimulatedTouches, World
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.photo import seeded_photograph
from anytouch_jax.sim.world.objects import Object, caption

SIMULATED = "simulated"  # the word of --data that stands for simulated touches
WORDINGS = 8  # captions of each object
VOCABULARY = 2048
WEIGHT = 9.0  # of simulated touches (--data.weights simulated) over all real ones
# share of the touches of stage 1 and 2 that show an untouched gel, if fields are learned
FREE = (0.06, 0.02)
TRIES = 8  # draws in which a partner by another unit is looked for
MOST_PIXELS = 4_000_000_000  # bytes of real frames that are kept on the device
FIELD_SHARE = 0.5  # of a batch's touches: those whose fields are learned
FIELDS = ("displacement", "shear", "pressure")
SUBTRACTED = 0.7  # share of touches whose background is subtracted with --data.background either
# Largest deviation, in pixels, of the place of a gel since its picture: 0.2 on still recordings of
# a GelSight Mini.
MOVED = 0.5
Batch = TouchBatch | Stage2Batch
Info = dict[str, int]


class Real(NamedTuple):
    """Real frames on the device.

    `windows` and `pairs` have an entry for stills and one for clips, or None.
    """

    frame: Any  # u8 (N, S, S, 3)
    # u8 (G, 2, S, S, 3): the stored picture of the untouched gel, and the median of the unit
    gel: Any
    gel_of: Any  # i32 (N,)
    sensor: Any  # i32 (N,)
    caption: Any  # i32 (N,), -1 without
    windows: tuple[Any, ...]  # (rows i32 (W, T), cumulative share f32 (W,))
    pairs: tuple[Any, ...]  # _Pairs


class _Pairs(NamedTuple):
    """Touches that others share: rows (W, T), and for each its group among `order`, which sorts
    them by place.
    """

    rows: Any  # i32 (W, T)
    share: Any  # f32 (W,) cumulative
    order: Any  # i32 (W,)
    low: Any  # i32 (W,)
    count: Any  # i32 (W,)
    place: Any  # i32 (W,)
    unit: Any  # i32 (W,)


class Texts(NamedTuple):
    """Token ids (n, S) and masks of all captions: WORDINGS for each simulated object, then those of
    real rows.
    """

    ids: Any
    mask: Any


# One program for all loaders of one form.
_sample = jax.jit(endless.sample_touches, static_argnames=("sampling", "count"))


class SimulatedLoader:
    """Batches for `config.stage` with the interface of `Loader`.

    `manifest` has real recordings, or is None.

    A text tower needs the `tokenizer` of `caption_tokenizer`. Raises UserError for settings that do
    not fit.
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
        weight = dict(config.data.weights or ()).get(SIMULATED, WEIGHT)
        self._count = (
            size
            if self._real is None
            else max(1, min(size - 1, round(size * weight / (weight + 1))))
        )
        self._photos = None
        self._texts = None
        if config.stage == 2 and model.image is not None and simulated.vision:
            self._photos = jax.device_put(photo_bank(self.objects, world.places, model.image_size))
        if config.stage == 2 and model.text is not None:
            self._texts = jax.device_put(self._encode(manifest))
        self._world = jax.device_put(world)
        self._key = jax.random.key(config.run.seed)
        self._pool: tuple[tuple[int, int], SimulatedTouches] | None = None
        kinds = sum(1 for part in self._real.windows if part is not None) if self._real else 2
        self._has_clips = kinds > 1 and config.data.clip_share > 0
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
        rows = {
            *self._rows[:-1].tolist(),
            *(() if self._real is None else np.asarray(self._real.sensor).tolist()),
        }
        return [name for number, name in enumerate(self.config.model.sensors) if number in rows]

    def _encode(self, manifest: Manifest | None) -> Texts:
        """Return the tokens of all captions, and an empty caption last."""
        tower = self.config.model.text
        tokenizer = self.tokenizer
        assert tower is not None and tokenizer is not None
        texts = [*wordings(self.objects), *real_captions(manifest)]
        length = min(tower.length, -(-tokenizer.longest(texts) // 8) * 8)
        return Texts(*tokenizer.encode([*texts, ""], length))

    def frames(self, step: int) -> int:
        """Return the frames of the touches of a step: 1 for stills."""
        share = self.config.data.clip_share if self._has_clips else 0.0
        is_clip = np.floor((step + 1) * share) > np.floor(step * share)
        if is_clip:
            return self.config.model.frames + self.config.reconstructs
        return 1

    def _sampled(self, step: int) -> tuple[Array, World, Sampling, int, Array]:
        """Return what the simulated touches of a step are sampled from."""
        config, simulated = self.config, self.config.simulated
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
        pool = self._pool
        if pool is None or pool[0] != name:
            pool = self._pool = (name, _sample(*self._sampled(step)))
        return pool[1]

    @property
    def examples(self) -> list[tuple[Batch, Callable[[], Batch]]]:
        """A batch of stills and one of clips, if the run has both: its shapes, and a function that
        makes it.
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


def training_objects(config: Config) -> tuple[Object, ...]:
    """Return the objects that are touched in training: those of the train split, and variants of
    them.
    """
    simulated = config.simulated
    scenes = scene.Scenes(objects=simulated.objects, seed=simulated.seed, depth=simulated.depth)
    return endless.objects_of(scenes, "train", variants=simulated.variants)


def wordings(things: Sequence[Object], count: int = WORDINGS) -> list[str]:
    """Return `count` captions of each object."""
    return [
        caption(thing, np.random.default_rng([thing.seed, scene.CAPTION, number]))
        for thing in things
        for number in range(count)
    ]


def real_captions(manifest: Manifest | None) -> list[str]:
    """Return the distinct captions of a manifest, in the order of their codes."""
    if manifest is None:
        return []
    return [
        str(text)
        for text in manifest.column("text")
        .combine_chunks()
        .dictionary_encode()
        .dictionary.to_pylist()
    ]


def caption_tokenizer(config: Config, manifest: Manifest | None) -> Tokenizer:
    """Return the tokenizer `data.tokenizer`, or one trained on captions of the objects and of the
    manifest.
    """
    if config.data.tokenizer is not None:
        return load_tokenizer(config.data.tokenizer)
    assert config.model.text is not None
    texts = [*wordings(training_objects(config), 4 * WORDINGS), *real_captions(manifest)]
    return train_tokenizer(texts, min(VOCABULARY, config.model.text.vocab))


def photo_bank(things: Sequence[Object], places: np.ndarray, size: int) -> np.ndarray:
    """Return photographs u8 (objects, places, size, size, 3) of the places (objects, places, 2) mm
    of each object.
    """
    pairs = zip(things, places, strict=True)
    jobs = [(thing, place, (thing.seed, scene.PHOTO)) for thing, spots in pairs for place in spots]
    pictures = endless.over_cores(partial(seeded_photograph, size=size), jobs)
    return np.stack(pictures).reshape(*places.shape[:2], size, size, 3)


def load_real(manifest: Manifest, config: Config, log: Callable[[str], None]) -> Real:
    """Return the real frames of the training split on the device.

    Raises UserError if they are too many.
    """
    plain = config.with_settings({"data.background": "keep"})
    pools: Pools = find_pools(manifest, plain.with_settings({"data.tokenizer": None}), None, 1)
    for note in pools.notes:
        log(note)
    size = config.model.image_size
    windows = [pool.windows for pool in pools.touch] + [
        pool.windows for pool in pools.match if pool is not None
    ]
    rows = np.unique(np.concatenate([part.ravel() for part in windows]))
    if len(rows) * size * size * 3 > MOST_PIXELS:
        raise UserError(
            f"{len(rows)} real frames of {size} x {size} pixels do not fit on the device next to "
            "simulated touches; "
            "give fewer recordings, or train on them without `simulated`"
        )
    place = np.full(len(manifest), -1, np.int32)
    place[rows] = np.arange(len(rows))
    reader = SampleReader(manifest, plain)
    frame = np.concatenate([reader.touch(row[None], None) for row in rows])
    gels, gel_of = _real_gels(manifest, rows, frame, size)
    column = manifest.column("text").combine_chunks().dictionary_encode()
    caption = column.indices.fill_null(-1).to_numpy(False)[rows].astype(np.int32)
    weights, _ = epoch_weights(manifest, config, rows)
    weights = np.ones(len(manifest)) if weights is None else weights
    kinds = [
        (place[pool.windows], _cumulative(weights[pool.windows[:, -1]])) for pool in pools.touch
    ]
    windows_of = (*kinds, *[None] * (2 - len(kinds)))
    pairs = tuple(_pairs(manifest, match, place, weights) for match in pools.match)
    real = Real(
        frame, gels, gel_of, pools.sensor[rows].astype(np.int32), caption, windows_of, pairs
    )
    return jax.device_put(real)


def _real_gels(
    manifest: Manifest, rows: np.ndarray, frame: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return pictures of untouched gels u8 (G, 2, S, S, 3), stored and median of the unit, and that
    of each row.
    """
    stored = manifest.codes("background_path")[rows]
    unit = manifest.codes("unit")[rows]
    sensor = manifest.codes("sensor")[rows]
    owner = np.where(unit >= 0, unit, -1 - sensor)
    _, first, group = np.unique(
        np.stack([owner, stored]), axis=1, return_index=True, return_inverse=True
    )
    medians = dict[int, np.ndarray]()
    gels = []
    for place in first:
        if (own := int(owner[place])) not in medians:
            same = np.flatnonzero(owner == own)
            medians[own] = np.median(frame[same[:: max(1, len(same) // 300)]], axis=0).astype(
                np.uint8
            )
        picture = medians[own]
        if stored[place] >= 0:
            picture = touch_evaluation(
                [read_image(manifest, int(rows[place]), "background_path")], size
            )[0]
        gels.append(np.stack([picture, medians[own]]))
    return np.stack(gels), group.ravel().astype(np.int32)


def _cumulative(weights: np.ndarray) -> np.ndarray:
    return (np.cumsum(weights) / weights.sum()).astype(np.float32)


def _pairs(
    manifest: Manifest, match: MatchPool | None, place: np.ndarray, weights: np.ndarray
) -> _Pairs | None:
    if match is None:
        return None
    windows = match.windows[match.matches.anchors]
    last = windows[:, -1]
    touch = manifest.codes("touch", own=True)[last]
    order = np.argsort(touch, kind="stable")
    low = np.searchsorted(touch[order], touch)
    count = np.searchsorted(touch[order], touch, side="right") - low
    numbers = (order, low, count, touch, manifest.codes("unit")[last])
    return _Pairs(
        place[windows], _cumulative(weights[last]), *(x.astype(np.int32) for x in numbers)
    )


class _Touches(NamedTuple):
    """Prepared touches: clip u8 (B, T, S, S, 3), sensor rows (B,)."""

    clip: Array
    sensor: Array


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
    """Return the batch of a step from simulated touches and the real frames."""
    count = len(touches.object)
    missing = config.data.batch_size - len(touches.object)
    sensor = jnp.asarray(rows)[touches.sensor]
    touches = moved_gel(jax.random.fold_in(key, 7), touches)
    keys = jax.random.split(key, 6)
    takes = [
        _Touches(
            prepared(keys[m], touches.clip[:, m], touches.background[:, m], config), sensor[:, m]
        )
        for m in range(touches.clip.shape[1])
    ]
    fields = None
    if touches.fields is not None:
        fields = field_batch(keys[2], touches, sensor, config, _slots(count * FIELD_SHARE, devices))
    kind = STILL if touches.clip.shape[2] == 1 else CLIP
    if config.stage == 1:
        one = takes[0]
        if real is not None:
            picked, share = real.windows[kind]
            one = _joined(
                one, _real_touches(keys[3], real, picked[_drawn(keys[4], share, missing)], config)
            )
        return TouchBatch(one.clip, one.sensor, fields)
    first, second = takes
    place = jnp.arange(count, dtype=jnp.int32)
    caption = jnp.full(count, -1)
    if texts is not None:
        pick = jax.random.randint(keys[5], (count,), 0, WORDINGS)
        has = jax.random.uniform(jax.random.fold_in(keys[5], 1), (count,)) < config.simulated.text
        caption = jnp.where(has, touches.object * WORDINGS + pick, -1)
    if real is not None:
        pairs: _Pairs = real.pairs[kind] if real.pairs[kind] is not None else real.pairs[STILL]
        at = _drawn(keys[3], pairs.share, missing)
        other = _partners(keys[4], pairs, at)
        first = _joined(
            first, _real_touches(jax.random.fold_in(keys[3], 1), real, pairs.rows[at], config)
        )
        second = _joined(
            second, _real_touches(jax.random.fold_in(keys[4], 1), real, pairs.rows[other], config)
        )
        place = jnp.concatenate([place, count + pairs.place[at]])
        own = real.caption[pairs.rows[at][:, -1]]
        # Captions of real rows come after the simulated ones, and an empty one is last.
        first_real = 0 if texts is None else len(texts.ids) - 2 - jnp.max(real.caption, initial=-1)
        caption = jnp.concatenate([caption, jnp.where(own >= 0, first_real + own, -1)])
    match = MatchBatch(first.clip, first.sensor, second.clip, second.sensor, place=place)
    size = len(first.sensor)
    image = jnp.zeros((0, *first.clip.shape[2:]), jnp.uint8)
    image_row = jnp.zeros(0, jnp.int32)
    if photos is not None:
        slots = min(_slots(count / 2, devices), count)
        # touches with a photograph come first
        seen = jnp.argsort(touches.photo < 0, stable=True)[:slots]
        image = photos[touches.object[seen], jnp.maximum(touches.photo[seen], 0)]
        image_row = jnp.where(touches.photo[seen] >= 0, seen, size).astype(jnp.int32)
    text = jnp.zeros((0, 2), jnp.int32)
    mask = jnp.zeros((0, 2), bool)
    text_row = jnp.zeros(0, jnp.int32)
    if texts is not None:
        # row -1 is the empty caption
        text = texts.ids[caption]
        mask = texts.mask[caption]
        text_row = jnp.where(caption >= 0, jnp.arange(size), size).astype(jnp.int32)
    align = AlignBatch(first.clip, first.sensor, image, image_row, text, mask, text_row)
    has_towers = photos is not None or texts is not None
    return Stage2Batch(align if has_towers else None, match, fields)


def _slots(count: float, devices: int) -> int:
    """Return at least `count` rows, in a multiple of the devices."""
    return devices * max(1, -(-int(count) // devices))


def _joined(one: _Touches, other: _Touches) -> _Touches:
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)


def _drawn(key: Array, share: Array, count: int) -> Array:
    """Return `count` numbers drawn by their cumulative shares."""
    return jnp.minimum(jnp.searchsorted(share, jax.random.uniform(key, (count,))), len(share) - 1)


def _partners(key: Array, pairs: _Pairs, at: Array) -> Array:
    """Return a touch of the same place for each of `at`: by another unit if TRIES draws find one,
    else another one.
    """
    draw = jax.random.uniform(key, (len(at), TRIES))
    tries = pairs.order[
        pairs.low[at][:, None] + (draw * pairs.count[at][:, None]).astype(jnp.int32)
    ]
    score = 2 * (pairs.unit[tries] != pairs.unit[at][:, None]) + (tries != at[:, None])
    return jnp.take_along_axis(tries, jnp.argmax(score, 1)[:, None], 1)[:, 0]


def _real_touches(key: Array, real: Real, rows: Array, config: Config) -> _Touches:
    """Return augmented and prepared real touches of windows of rows (B, T)."""
    warp, gel, prepare = jax.random.split(key, 3)
    # the stored picture, or the median
    which = jax.random.bernoulli(gel, 0.4, (len(rows),)).astype(jnp.int32)
    background = real.gel[real.gel_of[rows[:, -1]], which]
    moved = augmented(warp, jnp.concatenate([real.frame[rows], background[:, None]], 1), config)
    return _Touches(
        prepared(prepare, moved[:, :-1], moved[:, -1], config), real.sensor[rows[:, -1]]
    )


def augmented(key: Array, clip: Array, config: Config) -> Array:
    """Return clips u8 (B, T, S, S, 3), each mirrored, turned, shifted, zoomed and stretched, its
    frames alike.
    """
    toss, turn = jax.random.split(key)
    across, down = jax.random.bernoulli(toss, config.data.flip, (2, len(clip), 1, 1, 1, 1))
    clip = jnp.where(across, clip[:, :, :, ::-1], clip)
    clip = jnp.where(down, clip[:, :, ::-1], clip)
    if not any(config.data.affine):
        return clip
    draws = jax.random.uniform(turn, (len(clip), 5), minval=-1.0)
    return jax.vmap(partial(_warped, affine=config.data.affine))(clip, draws)


def _warped(clip: Array, draw: Array, affine: tuple[float, float, float]) -> Array:
    """Turn, zoom, stretch and shift a clip u8 (T, S, S, 3) about its centre by shares `draw` (5,)
    of the most.
    """
    degrees, share, growth = affine
    angle = jnp.deg2rad(draw[0] * degrees)
    zoom = (1 + growth) ** draw[1]
    stretch = 1.25 ** draw[4]
    height, width = clip.shape[1:3]
    y, x = jnp.mgrid[:height, :width]
    y = y - (height - 1) / 2 - draw[2] * share * height
    x = x - (width - 1) / 2 - draw[3] * share * width
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
    key: Array, clip: Array, background: Array, config: Config, *, jitter: bool = True
) -> Array:
    """Return clips u8 (B, T, S, S, 3), the background subtracted or not; `jitter` changes
    brightness and colours.
    """
    choice, light = jax.random.split(key)
    frames = clip.astype(jnp.float32)
    gel = background[:, None].astype(jnp.float32)
    size = (len(clip), 1, 1, 1, 3)
    share = {"keep": 0.0, "subtract": 1.0, "either": SUBTRACTED}[config.data.background]
    subtract = jax.random.bernoulli(choice, share, (len(clip), 1, 1, 1, 1))
    x = jnp.where(subtract, frames - gel, frames - UNTOUCHED)
    if jitter:
        gain, colour, level = jax.random.normal(light, (3, *size))
        x = x * jnp.exp(0.15 * gain[..., :1] + 0.08 * colour) + 3.0 * level
    return jnp.round(jnp.clip(x + UNTOUCHED, 0, 255)).astype(jnp.uint8)


def moved_gel(key: Array, touches: SimulatedTouches, most: float = MOVED) -> SimulatedTouches:
    """Return touches whose backgrounds are shifted by fractions of a pixel: a gel gives way in its
    mount.
    """
    share, to = jax.random.split(key)
    size = touches.background.shape[:2]
    shift = most * jax.random.uniform(share, (*size, 1)) * jax.random.normal(to, (*size, 2))

    def moved(picture: Array, by: Array) -> Array:
        picture = picture.astype(jnp.float32)
        return jax.image.scale_and_translate(
            picture, picture.shape, (0, 1), jnp.ones(2), by, "linear", antialias=False
        )

    return touches._replace(background=jax.vmap(jax.vmap(moved))(touches.background, shift))


def field_batch(
    key: Array, touches: SimulatedTouches, sensor: Array, config: Config, count: int
) -> FieldBatch:
    """Return the first `count` touches of the last take with their fields, free of scale.

    `sensor` (B, M) are rows.
    """
    clip = touches.clip[:count, -1, -config.model.frames :]
    width = touches.width[:count, -1]
    labels = {name: x[:count, -1, -1] for name, x in touches.labels.items()}
    fields = touches.fields[:count, -1]
    stiff = touches.modulus[:count, -1]
    aspect = touches.aspect[:count, -1]
    scale = stiff * width**2 * KPA_MM2
    force = jnp.stack([labels["force_x"], labels["force_y"], labels["force"]], -1) / scale[:, None]
    shown = fields[..., 3] / stiff[:, None, None]
    # Force outside of the picture cannot be seen.
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
