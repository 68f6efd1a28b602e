"""From a manifest to batches: a step's content is a function of (manifest, config, step) alone.

Stills and clips each have a sequence of epochs. An epoch is a seeded permutation, and a batch takes
the next B of it. A batch that reaches past the end of an epoch can hold a row twice, always if
there are fewer rows than B.

A batch is *planned* before it is filled. The plan says which sample goes into which slot, and is
the same in each process of a run. Threads then read the samples, each into its own slot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from anytouch_jax.batch import AlignBatch, BatchSource, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.pools import CLIP, STILL, MatchPool, Pool, find_pools
from anytouch_jax.data.loading.samples import NAMED, SampleReader, fill_slot
from anytouch_jax.data.loading.sampling import (
    BOTH,
    TEXT,
    VISION,
    Shard,
    StepSchedule,
    uniform_per_step,
)
from anytouch_jax.data.loading.threads import BatchJobs, prefetch_batches, run_jobs
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.tokenizer import Tokenizer
from anytouch_jax.errors import UserError

Batch = TouchBatch[np.ndarray] | Stage2Batch[np.ndarray]
Info = dict[str, int]
_KINDS: tuple[Literal["still"], Literal["clip"]] = ("still", "clip")
_NONE = -1  # a step without this part
_EIGHT = 8  # captions are padded to a multiple of it
_SEEDS = 2**63  # numpy's generators take no negative seeds
# strata
_WITH_IMAGE = (VISION, BOTH)
_WITH_TEXT = (BOTH, TEXT)
# tags that keep the random streams of one seed apart
_KIND = 1
_PART = 2
_ORDER = 3
_TRIPLE = 4
_GALLERY = 5


class _Draw(NamedTuple):
    """A sample of a batch: a member of a stratum, in a pass over it."""

    stratum: int
    member: int
    epoch: int


class _Place(NamedTuple):
    """Where a sample of a stratum goes: slots of this shard, None for those of others."""

    stratum: int
    touch: int | None
    image: int | None
    text: int | None


class Loader(BatchSource):
    """Batches for `config.stage` from the split `config.data.split` of a manifest.

    Args:
        manifest: The frames.
        config: Of the run.
        tokenizer: Of the captions; without it one is read or trained if it is needed.
        devices: The image and text slots are a multiple of it.
        shard: (index, count): this process reads and returns its part of every batch. The parts
            joined in order are the whole batch.
        log: Gets a sentence for each of the first NAMED samples that are replaced.

    Attributes:
        manifest: As given.
        config: As given.
        tokenizer: The one in use, or None.
        notes: Sentences for the user: rows left out, no clips, no pairs.

    Raises:
        UserError: ManifestError for an empty split or an unknown sensor, SampleError (from `batch`
            and `stream`) for a bad sample.
    """

    def __init__(
        self,
        manifest: Manifest,
        config: Config,
        *,
        tokenizer: Tokenizer | None = None,
        devices: int = 1,
        shard: tuple[int, int] = (0, 1),
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        if devices < 1:
            raise UserError(f"devices must be 1 or more, not {devices}")
        self.manifest = manifest
        self.config = config
        self._shard = Shard(*shard)
        self._seed = config.run.seed % _SEEDS
        size = config.data.batch_size
        # In the release a matching batch is of half the size, and a step of its own.
        self._match_size = max(1, size // 2) if config.splits_steps else size
        # instead of a third touch
        self._in_batch_negatives = config.model.match_head == "cosine"
        self._check_groups()
        self._shard.check(devices, "devices")
        self._shard.check(size, "batch_size")
        self._reader = SampleReader(manifest, config)
        self._log = log
        self._replaced = set[str]()
        pools = find_pools(manifest, config, tokenizer, devices, self._reader.backgrounds)
        self._pools = pools.touch
        self._match_pools = pools.match
        self._sensor = pools.sensor
        self.tokenizer = pools.tokenizer
        self.notes = pools.notes
        # Batches are drawn from these pools: of stills and clips, or of clips only.
        clips_only = len(self._pools) > 1 and config.data.clip_fraction == 1
        self._drawn = self._pools[1:] if clips_only else self._pools
        still, clip = self._match_pools
        drawn_matches = (clip,) if clip and clips_only else (still, clip)
        self._drawn_matches = [pool for pool in drawn_matches if pool]
        self._text_length = self._caption_length()
        self._align_fraction = self._fraction_of_align_steps()
        self._align = StepSchedule(self._align_kinds)
        self._match = StepSchedule(self._match_kinds)

    def _check_groups(self) -> None:
        """Raise UserError if the groups of negatives do not divide the batches of stage 2."""
        groups = self.config.objective.groups
        contrasted = [self.config.data.batch_size]
        if self._in_batch_negatives:
            contrasted.append(self._match_size)
        for rows in contrasted:
            if self.config.stage == 2 and rows % groups:
                raise UserError(
                    f"a batch of {rows} touches does not divide by --objective.groups {groups}; "
                    "change one of them"
                )

    def __repr__(self) -> str:
        rows = len(self.manifest)
        data = self.config.data
        return (
            f"Loader(stage {self.config.stage}, split {data.split} of {rows:,} rows, batches of "
            f"{data.batch_size})"
        )

    def kind(self, step: int) -> Literal["still", "clip"]:
        """Return whether the batch of `step` holds stills or clips."""
        align = self._align.at(step)[0]
        match = self._match.at(step)[0]
        return _KINDS[match if align == _NONE else align]

    @property
    def examples(self) -> tuple[()]:
        """Nothing: a batch of each structure is compiled when it comes."""
        return ()

    @property
    def steps_per_epoch(self) -> int:
        """Batches that hold every still and every clip once.

        If matching has separate steps, they hold every anchor once too.
        """
        size = self.config.data.batch_size
        steps = sum(-(-pool.draws // size) for pool in self._drawn)
        if self.config.splits_steps:
            steps += sum(-(-pool.anchors.size // self._match_size) for pool in self._drawn_matches)
        return steps

    @property
    def trained_sensors(self) -> list[str]:
        """Names of the sensors that batches are drawn from, in the order of the sensor table."""
        windows = [pool.windows for pool in self._drawn]
        windows += [pool.windows for pool in self._drawn_matches]
        rows = np.concatenate([ids[:, -1] for ids in windows])
        return [self.config.model.sensors[row] for row in np.unique(self._sensor[rows])]

    def batch(self, step: int) -> Batch:
        """Return the batch of `step`, filled in this thread.

        It is a TouchBatch in stage 1, and a Stage2Batch in stage 2.
        """
        return run_jobs(self._plan(step))[0]

    def stream(self, start: int, stop: int) -> Iterator[tuple[int, Batch, Info]]:
        """Yield (step, batch, info) for steps start .. stop - 1, filled ahead by threads.

        The bytes do not depend on the threads. `info` counts `skipped_samples` of this shard, and
        `images` and `texts` of the whole batch. Close the iterator to stop early.
        """
        data = self.config.data
        return prefetch_batches(self._plan, range(start, stop), data.threads, data.prefetch)

    def _fraction_of_align_steps(self) -> float:
        """Return the fraction of steps that align; 1 if each step does.

        In separate steps (release) it is that of an epoch, so that rows and anchors come equally
        often.
        """
        if not self.config.splits_steps or not self._drawn_matches:
            return 1.0
        align = sum(pool.draws for pool in self._drawn) / self.config.data.batch_size
        match = sum(pool.anchors.size for pool in self._drawn_matches) / self._match_size
        return align / (align + match)

    def _kinds(self, steps: np.ndarray) -> np.ndarray:
        """Return whether each of the steps i64 (n,) is of stills (0) or clips (1)."""
        fraction = self.config.data.clip_fraction if len(self._pools) > 1 else 0.0
        if self.config.data.order == "alternate":
            # a clip wherever the number of clips due so far has grown
            return (np.floor((steps + 1) * fraction) > np.floor(steps * fraction)).astype(np.int8)
        return (uniform_per_step(self.config.run.seed, _KIND, steps) < fraction).astype(np.int8)

    def _align_kinds(self, steps: np.ndarray) -> np.ndarray:
        """Return the kind of the alignment in each of the steps i64 (n,), _NONE without one."""
        aligns = uniform_per_step(self.config.run.seed, _PART, steps) < self._align_fraction
        return np.where(aligns, self._kinds(steps), _NONE)

    def _match_kinds(self, steps: np.ndarray) -> np.ndarray:
        """Return the kind of the matching in each of the steps i64 (n,), _NONE without one."""
        if self._match_pools[STILL] is None:
            return np.full(len(steps), _NONE)
        kinds = np.full(len(steps), STILL)
        if self._match_pools[CLIP] is not None:
            kinds = self._kinds(steps)
        if self.config.splits_steps:
            return np.where(self._align_kinds(steps) == _NONE, kinds, _NONE)
        return kinds

    def _plan(self, step: int) -> BatchJobs[Batch]:
        """Return an empty batch, and a job for each slot that reads and writes one sample."""
        kind, rank = self._align.at(step)
        align = None
        if kind != _NONE:
            align = self._plan_align(step, self._pools[kind], rank)
        if self.config.stage == 1:
            assert align is not None
            touch = TouchBatch(align.batch.clip, align.batch.sensor)
            return BatchJobs(touch, align.jobs, align.info)
        kind, rank = self._match.at(step)
        match = None
        if kind != _NONE:
            match = self._plan_match(step, kind, rank)
        batch = Stage2Batch(
            align=None if align is None else align.batch,
            match=None if match is None else match.batch,
        )
        jobs: list[Callable[[], int]] = []
        info = {"images": 0, "texts": 0}
        if align is not None:
            jobs += align.jobs
            info = align.info
        if match is not None:
            jobs += match.jobs
        return BatchJobs(batch, jobs, info)

    def _plan_align(self, step: int, pool: Pool, rank: int) -> BatchJobs[AlignBatch[np.ndarray]]:
        """Take rows of all strata in a seeded order; their images and texts fill the slots so."""
        rows = self.config.data.batch_size
        draws = self._align_draws(step, pool, rank)
        # The rows of the batch that have an image, or a text, in the order of their slots.
        with_image = [row for row, draw in enumerate(draws) if draw.stratum in _WITH_IMAGE]
        with_text = [row for row, draw in enumerate(draws) if draw.stratum in _WITH_TEXT]
        # An unused slot has the row behind the last one.
        image_row = np.full(pool.quota.images, rows, np.int32)
        text_row = np.full(pool.quota.texts if self.tokenizer is not None else 0, rows, np.int32)
        image_row[: len(with_image)] = with_image
        text_row[: len(with_text)] = with_text
        image_slot = {row: slot for slot, row in enumerate(with_image)}
        text_slot = {row: slot for slot, row in enumerate(with_text)}
        clip, sensor = self._empty(rows, pool.windows.shape[1])
        batch = AlignBatch(clip, sensor, *self._empty_slots(image_row, text_row))
        jobs: list[Callable[[], int]] = []
        for row, draw in enumerate(draws):
            # The parts of a sample may belong to different processes, because images and texts are
            # packed.
            touch = self._shard.place(row, rows)
            image = self._shard.place(image_slot.get(row), len(image_row))
            text = self._shard.place(text_slot.get(row), len(text_row))
            if touch is None and image is None and text is None:
                continue
            write = partial(
                self._write_align, batch, pool, _Place(draw.stratum, touch, image, text)
            )
            size = len(pool.members[draw.stratum])
            job = self._job(write, size, step, row, draw.member, draw.epoch)
            # A bad sample is counted once, by the process that has its touch.
            jobs.append(job if touch is not None else partial(_uncounted, job))
        return BatchJobs(batch, jobs, {"images": len(with_image), "texts": len(with_text)})

    def _align_draws(self, step: int, pool: Pool, rank: int) -> list[_Draw]:
        """Return the samples of a batch, in the order of its rows."""
        before, now = pool.quota.at(rank)
        draws = []
        for stratum, sampler in enumerate(pool.samplers):
            for member, epoch in sampler.take(int(before[stratum]), int(now[stratum])):
                draws.append(_Draw(stratum, member, epoch))
        if self.config.data.parts:  # a slot belongs to its part
            return draws
        # Otherwise the rows of a stratum would stand together, and one process would have all of
        # the images.
        order = np.random.default_rng([self._seed, _ORDER, step]).permutation(len(draws))
        return [draws[at] for at in order]

    def _plan_match(self, step: int, kind: int, rank: int) -> BatchJobs[MatchBatch[np.ndarray]]:
        """Take the next anchors of the epoch. Positives and negatives are drawn with each."""
        pool = self._match_pools[kind]
        rows = self._match_size
        assert pool is not None
        self._shard.check(rows, "the rows of a matching batch")
        frames = pool.windows.shape[1]
        batch = MatchBatch(*self._empty(rows, frames), *self._empty(rows, frames))
        if self._in_batch_negatives:
            batch = batch._replace(place=np.zeros(len(batch.sensor), np.int32))
        else:
            clip, sensor = self._empty(rows, frames)
            batch = batch._replace(negative=clip, negative_sensor=sensor)
        jobs: list[Callable[[], int]] = []
        gallery = self._gallery_sensor(step, pool)
        for row, (index, epoch) in enumerate(pool.anchors.take(rank * rows, rows)):
            mine = self._shard.place(row, rows)
            if mine is None:
                continue
            write = partial(self._write_match, batch, pool, mine, gallery)
            # Slots of matching come after those of alignment, so that their replacements are drawn
            # apart.
            slot = self.config.data.batch_size + row
            size = len(pool.matches.anchors)
            jobs.append(self._job(write, size, step, slot, index, epoch))
        return BatchJobs(batch, jobs)

    def _job(
        self,
        write: Callable[[int, int], None],
        size: int,
        step: int,
        slot: int,
        index: int,
        epoch: int,
    ) -> Callable[[], int]:
        """Return a job that writes sample `index` of `size`, or a replacement, into a slot."""
        return partial(
            fill_slot, write, size, step, slot, self.config, index, epoch, self._name_replaced
        )

    def _name_replaced(self, error: str) -> None:
        """Log a sample that was replaced, once, if it is one of the first few."""
        if len(self._replaced) < NAMED and error not in self._replaced:
            self._replaced.add(error)
            is_last = len(self._replaced) == NAMED
            more = ". `anytouch data verify` names all" if is_last else ""
            self._log(f"{error}; another sample replaces it{more}")

    def _gallery_sensor(self, step: int, pool: MatchPool) -> int | None:
        """Return the one sensor of all positives of a step, None if they may differ.

        Positives of other pairs are the negatives there. For negatives of the positive's sensor all
        must be of one. It is drawn as a partner is.
        """
        if not (self._in_batch_negatives and self.config.data.negatives == "same_sensor"):
            return None
        rng = np.random.default_rng([self._seed, _GALLERY, step])
        partner, _ = pool.matches.draw(int(rng.choice(pool.matches.anchors)), rng)
        return int(self._sensor[pool.windows[partner, -1]])

    def _caption_length(self) -> int:
        """Return the padded length of captions.

        It is that of the longest, rounded up: positions behind the end token change nothing, and
        CLIP's 77 would take several times longer.
        """
        tower = self.config.model.text
        if tower is None or self.tokenizer is None:
            return 0
        captions = self.manifest.column("text").unique().drop_null().to_pylist()
        eights = -(-self.tokenizer.longest(captions) // _EIGHT)
        return min(tower.length, eights * _EIGHT)

    def _empty(self, rows: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the empty clips and sensors of this shard, of a batch of so many rows."""
        size = self.config.model.image_size
        rows = self._shard.fraction(rows)
        return np.zeros((rows, frames, size, size, 3), np.uint8), np.zeros(rows, np.int32)

    def _empty_slots(self, image_row: np.ndarray, text_row: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the empty image and text slots of this shard, in the order of AlignBatch."""
        size = self.config.model.image_size
        length = self._text_length
        image_row = self._shard.cut(image_row)
        text_row = self._shard.cut(text_row)
        image = np.zeros((len(image_row), size, size, 3), np.uint8)
        if self.tokenizer is None or not len(text_row):
            text = np.zeros((0, length), np.int32)
            mask = np.zeros((0, length), bool)
        else:
            # padding alone has a NaN gradient
            text, mask = self.tokenizer.encode([""] * len(text_row), length)
        return image, image_row, text, mask, text_row

    def _write_align(
        self, batch: AlignBatch[np.ndarray], pool: Pool, place: _Place, index: int, epoch: int
    ) -> None:
        """Write sample `index` of a stratum into the slots of this shard."""
        rows = pool.windows[pool.members[place.stratum][index]]
        row = rows[-1]
        has_image = place.stratum in _WITH_IMAGE
        # The replacement of a bad sample must not depend on the shard, so with "skip" every part is
        # read, also those of other shards.
        read_all = self.config.data.on_bad_sample == "skip"
        if read_all or place.touch is not None:
            out = None if place.touch is None else batch.clip[place.touch]
            self._reader.touch(rows, epoch, out)
        image = None
        if has_image and (read_all or place.image is not None):
            image = self._reader.vision(row, epoch)
        # Nothing is written before all could be read.
        if place.touch is not None:
            batch.sensor[place.touch] = self._sensor[row]
        if place.image is not None:
            batch.image[place.image] = image
        if place.text is not None and self.tokenizer is not None:
            caption = str(self.manifest.value(row, "text"))
            ids, mask = self.tokenizer.encode([caption], batch.text.shape[1])
            batch.text[place.text] = ids[0]
            batch.text_mask[place.text] = mask[0]

    def _write_match(
        self,
        batch: MatchBatch[np.ndarray],
        pool: MatchPool,
        slot: int,
        gallery: int | None,
        index: int,
        epoch: int,
    ) -> None:
        """Write the anchor `index`, with a positive and maybe a negative, into a slot."""
        anchor = int(pool.matches.anchors[index])
        row = int(pool.windows[anchor, -1])
        rng = np.random.default_rng([self._seed, _TRIPLE, epoch, row])
        positive, negative = pool.matches.draw(anchor, rng, gallery)
        # The touch of the gallery's sensor is the positive, whichever was drawn first.
        if gallery is not None and self._sensor[row] == gallery:
            anchor, positive = positive, anchor

        def write(clip: np.ndarray, sensor: np.ndarray, touch: int) -> None:
            rows = pool.windows[touch]
            self._reader.touch(rows, epoch, clip[slot])
            sensor[slot] = self._sensor[rows[-1]]

        if batch.place is not None:
            batch.place[slot] = pool.matches.place(anchor)
        write(batch.clip, batch.sensor, anchor)
        write(batch.positive, batch.positive_sensor, positive)
        if batch.negative is not None and batch.negative_sensor is not None:
            write(batch.negative, batch.negative_sensor, negative)


def _uncounted(job: Callable[[], int]) -> int:
    """Run a job whose skipped samples another shard counts."""
    job()
    return 0
