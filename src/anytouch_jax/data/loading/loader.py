"""From a manifest to batches: the content of a step is a function of (manifest, config, step)
alone.

Stills and clips each have a sequence of epochs. An epoch is a seeded permutation, and a batch takes
the next B of it. A batch that reaches past the end of an epoch can hold a row twice, always if
there are fewer rows than B.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal

import numpy as np

from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
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

Batch = TouchBatch | Stage2Batch
Info = dict[str, int]
_KINDS: tuple[Literal["still"], Literal["clip"]] = ("still", "clip")
_NONE = -1  # a step without this part
# strata
_WITH_IMAGE = (VISION, BOTH)
_WITH_TEXT = (BOTH, TEXT)
# tags that keep the random streams of one seed apart
_KIND = 1
_PART = 2
_ORDER = 3
_TRIPLE = 4
_GALLERY = 5


class Loader:
    """Batches for `config.stage` from the split `config.data.split` of a manifest.

    `notes` are sentences for the user (rows left out, no clips, no pairs). `tokenizer` is the one
    in use, or None. The image and text slots are a multiple of `devices`. With `shard` (index,
    count) this process reads and returns its part of every batch; the parts joined in order are the
    whole batch. `log` gets a sentence for each of the first NAMED samples that are replaced. Raises
    UserError: ManifestError for an empty split or an unknown sensor, SampleError (from `batch` and
    `stream`) for a bad sample.
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
        size = config.data.batch_size
        groups = config.objective.groups
        self._seed = config.run.seed % 2**63
        self._match_size = max(1, size // 2) if config.splits_steps else size
        # instead of a third touch
        self._in_batch_negatives = config.model.match_head == "cosine"
        contrasted = [size, self._match_size] if self._in_batch_negatives else [size]
        if config.stage == 2 and (odd := [rows for rows in contrasted if rows % groups]):
            raise UserError(
                f"a batch of {odd[0]} touches does not divide by --objective.groups {groups}; "
                "change one of them"
            )
        for name, number in (("devices", devices), ("batch_size", size)):
            self._shard.check(number, name)
        self._reader = SampleReader(manifest, config)
        self._log = log
        self._replaced = set[str]()
        self._pools, self._match_pools, self._sensor, self.tokenizer, self.notes = find_pools(
            manifest, config, tokenizer, devices, self._reader.gels
        )
        # Batches are drawn from these pools: of stills and clips, or of clips only.
        clips_only = len(self._pools) > 1 and config.data.clip_share == 1
        self._drawn = self._pools[1:] if clips_only else self._pools
        still, clip = self._match_pools
        self._drawn_matches = [
            pool for pool in ((clip,) if clip and clips_only else (still, clip)) if pool
        ]
        self._text_length = self._caption_length()
        self._align_share = self._share_of_align_steps()
        self._align = StepSchedule(self._align_kinds)
        self._match = StepSchedule(self._match_kinds)

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
        """Batches that hold every still and every clip once (and every anchor, if matching has
        separate steps).
        """
        size = self.config.data.batch_size
        steps = sum(-(-pool.draws // size) for pool in self._drawn)
        if self.config.splits_steps:
            steps += sum(-(-pool.anchors.size // self._match_size) for pool in self._drawn_matches)
        return steps

    @property
    def trained_sensors(self) -> list[str]:
        """Names of the sensors that batches are drawn from, in the order of the sensor table."""
        windows = [pool.windows for pool in self._drawn] + [
            pool.windows for pool in self._drawn_matches
        ]
        rows = np.unique(self._sensor[np.concatenate([ids[:, -1] for ids in windows])])
        return [self.config.model.sensors[row] for row in rows]

    def batch(self, step: int) -> Batch:
        """Return the batch of `step`, filled in this thread: TouchBatch in stage 1, Stage2Batch in
        stage 2.
        """
        return run_jobs(self._plan(step))[0]

    def stream(self, start: int, stop: int) -> Iterator[tuple[int, Batch, Info]]:
        """Yield (step, batch, info) for steps start .. stop - 1, filled ahead by `data.threads`
        threads.

        The bytes do not depend on the threads. `info` counts `skipped_samples` of this shard, and
        `images` and `texts` of the whole batch. Close the iterator to stop early.
        """
        return prefetch_batches(
            self._plan, range(start, stop), self.config.data.threads, self.config.data.prefetch
        )

    def _share_of_align_steps(self) -> float:
        """Return 1, or in separate steps (release) the share of align batches among all batches of
        an epoch.
        """
        pools = self._drawn_matches
        if not self.config.splits_steps or not pools:
            return 1.0
        align = sum(pool.draws for pool in self._drawn) / self.config.data.batch_size
        return align / (align + sum(pool.anchors.size for pool in pools) / self._match_size)

    def _kinds(self, steps: np.ndarray) -> np.ndarray:
        share = self.config.data.clip_share if len(self._pools) > 1 else 0.0
        if self.config.data.order == "alternate":
            return (np.floor((steps + 1) * share) > np.floor(steps * share)).astype(np.int8)
        return (uniform_per_step(self.config.run.seed, _KIND, steps) < share).astype(np.int8)

    def _align_kinds(self, steps: np.ndarray) -> np.ndarray:
        aligns = uniform_per_step(self.config.run.seed, _PART, steps) < self._align_share
        return np.where(aligns, self._kinds(steps), _NONE)

    def _match_kinds(self, steps: np.ndarray) -> np.ndarray:
        if self._match_pools[STILL] is None:
            return np.full(len(steps), _NONE)
        kinds = (
            self._kinds(steps)
            if self._match_pools[CLIP] is not None
            else np.full(len(steps), STILL)
        )
        if self.config.splits_steps:
            return np.where(self._align_kinds(steps) == _NONE, kinds, _NONE)
        return kinds

    def _plan(self, step: int) -> BatchJobs[Batch]:
        """Return an empty batch, and a job for each slot that reads and writes one sample."""
        align_kind, align_rank = self._align.at(step)
        match_kind, match_rank = self._match.at(step)
        align = (
            self._plan_align(step, self._pools[align_kind], align_rank)
            if align_kind != _NONE
            else None
        )
        if self.config.stage == 1:
            assert align is not None
            return BatchJobs(
                TouchBatch(align.batch.clip, align.batch.sensor), align.jobs, align.info
            )
        match = self._plan_match(step, match_kind, match_rank) if match_kind != _NONE else None
        batch = Stage2Batch(align.batch if align else None, match.batch if match else None)
        jobs = [*(align.jobs if align else ()), *(match.jobs if match else ())]
        return BatchJobs(batch, jobs, align.info if align else {"images": 0, "texts": 0})

    def _plan_align(self, step: int, pool: Pool, rank: int) -> BatchJobs[AlignBatch]:
        """Take rows of all strata in a seeded order; their images and texts fill the slots in that
        order.
        """
        before, now = pool.quota.at(rank)
        draws = [
            (stratum, *draw)
            for stratum, sampler in enumerate(pool.samplers)
            for draw in sampler.take(int(before[stratum]), int(now[stratum]))
        ]
        rows = self.config.data.batch_size
        if not self.config.data.parts:  # else a slot belongs to its part
            order = np.random.default_rng([self._seed, _ORDER, step]).permutation(rows)
            draws = [draws[at] for at in order]
        with_image = [slot for slot, (stratum, *_) in enumerate(draws) if stratum in _WITH_IMAGE]
        with_text = [slot for slot, (stratum, *_) in enumerate(draws) if stratum in _WITH_TEXT]
        image_row = np.full(pool.quota.images, rows, np.int32)
        text_row = np.full(pool.quota.texts if self.tokenizer is not None else 0, rows, np.int32)
        image_row[: len(with_image)] = with_image
        text_row[: len(with_text)] = with_text
        image_slot, text_slot = (
            {slot: i for i, slot in enumerate(slots)} for slots in (with_image, with_text)
        )
        batch = AlignBatch(
            *self._empty(rows, pool.windows.shape[1]), *self._empty_slots(image_row, text_row)
        )
        jobs: list[Callable[[], int]] = []
        for slot, (stratum, index, epoch) in enumerate(draws):
            parts = (
                (slot, rows),
                (image_slot.get(slot), len(image_row)),
                (text_slot.get(slot), len(text_row)),
            )
            touch, image, text = mine = [self._shard.place(*part) for part in parts]
            if mine == [None, None, None]:
                continue
            write = partial(self._write_align, batch, pool, stratum, touch, image, text)
            size = len(pool.members[stratum])
            job = partial(
                fill_slot, write, size, step, slot, self.config, index, epoch, self._name_replaced
            )
            jobs.append(job if touch is not None else partial(_uncounted, job))
        return BatchJobs(batch, jobs, {"images": len(with_image), "texts": len(with_text)})

    def _plan_match(self, step: int, kind: int, rank: int) -> BatchJobs[MatchBatch]:
        pool = self._match_pools[kind]
        rows = self._match_size
        assert pool is not None
        self._shard.check(rows, "the rows of a matching batch")
        parts = [
            self._empty(rows, pool.windows.shape[1])
            for _ in range(2 if self._in_batch_negatives else 3)
        ]
        batch = MatchBatch(*(array for part in parts for array in part))
        if self._in_batch_negatives:
            batch = batch._replace(place=np.zeros(len(batch.sensor), np.int32))
        jobs: list[Callable[[], int]] = []
        gallery = self._gallery_sensor(step, pool)
        for slot, (index, epoch) in enumerate(pool.anchors.take(rank * rows, rows)):
            mine = self._shard.place(slot, rows)
            if mine is None:
                continue
            write = partial(self._write_match, batch, pool, mine, gallery)
            # Slots of matching come after those of alignment, so that their replacements are drawn
            # apart.
            place = self.config.data.batch_size + slot
            size = len(pool.matches.anchors)
            jobs.append(
                partial(
                    fill_slot,
                    write,
                    size,
                    step,
                    place,
                    self.config,
                    index,
                    epoch,
                    self._name_replaced,
                )
            )
        return BatchJobs(batch, jobs)

    def _name_replaced(self, error: str) -> None:
        """Log a sample that was replaced, once, if it is one of the first few."""
        if len(self._replaced) < NAMED and error not in self._replaced:
            self._replaced.add(error)
            more = "" if len(self._replaced) < NAMED else ". `anytouch data verify` names all"
            self._log(f"{error}; another sample replaces it{more}")

    def _gallery_sensor(self, step: int, pool: MatchPool) -> int | None:
        """Return the one sensor of all positives of a step, drawn as a partner is, for negatives of
        that sensor.
        """
        if not (self._in_batch_negatives and self.config.data.negatives == "same_sensor"):
            return None
        rng = np.random.default_rng([self._seed, _GALLERY, step])
        partner, _ = pool.matches.draw(int(rng.choice(pool.matches.anchors)), rng)
        return int(self._sensor[pool.windows[partner, -1]])

    def _caption_length(self) -> int:
        """Return the padded length of captions: the longest in eights, as positions behind its end
        change nothing.
        """
        tower = self.config.model.text
        if tower is None or self.tokenizer is None:
            return 0
        captions = self.manifest.column("text").unique().drop_null().to_pylist()
        return min(tower.length, -(-self.tokenizer.longest(captions) // 8) * 8)

    def _empty(self, rows: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
        size = self.config.model.image_size
        rows = self._shard.share(rows)
        return np.zeros((rows, frames, size, size, 3), np.uint8), np.zeros(rows, np.int32)

    def _empty_slots(self, image_row: np.ndarray, text_row: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the empty image and text slots of this shard."""
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
        self,
        batch: AlignBatch,
        pool: Pool,
        stratum: int,
        touch: int | None,
        image: int | None,
        text: int | None,
        index: int,
        epoch: int,
    ) -> None:
        """Write sample `index` into the slots `touch`, `image` and `text`, None for those of other
        shards.
        """
        rows = pool.windows[pool.members[stratum][index]]
        # The replacement of a bad sample must not depend on the shard, so with "skip" every part is
        # read.
        read_all = self.config.data.on_bad_sample == "skip"
        if read_all or touch is not None:
            self._reader.touch(rows, epoch, None if touch is None else batch.clip[touch])
        photograph = None
        if stratum in _WITH_IMAGE and (read_all or image is not None):
            photograph = self._reader.vision(rows[-1], epoch)
        if touch is not None:
            batch.sensor[touch] = self._sensor[rows[-1]]
        if image is not None:
            batch.image[image] = photograph
        if text is not None and self.tokenizer is not None:
            caption = str(self.manifest.value(rows[-1], "text"))
            ids, mask = self.tokenizer.encode([caption], batch.text.shape[1])
            batch.text[text], batch.text_mask[text] = ids[0], mask[0]

    def _write_match(
        self,
        batch: MatchBatch,
        pool: MatchPool,
        slot: int,
        gallery: int | None,
        index: int,
        epoch: int,
    ) -> None:
        anchor = int(pool.matches.anchors[index])
        row = int(pool.windows[anchor, -1])
        rng = np.random.default_rng([self._seed, _TRIPLE, epoch, row])
        positive, negative = pool.matches.draw(anchor, rng, gallery)
        if gallery is not None and self._sensor[row] == gallery:
            anchor, positive = positive, anchor
        triple: list[tuple[Any, Any, int]] = [(batch.clip, batch.sensor, anchor)]
        triple.append((batch.positive, batch.positive_sensor, positive))
        if batch.place is not None:
            batch.place[slot] = pool.matches.place(anchor)
        else:
            triple.append((batch.negative, batch.negative_sensor, negative))
        for clip, sensors, touch in triple:
            rows = pool.windows[touch]
            self._reader.touch(rows, epoch, clip[slot])
            sensors[slot] = self._sensor[rows[-1]]


def _uncounted(job: Callable[[], int]) -> int:
    """Run a job whose skipped samples another shard counts."""
    return 0 * job()
