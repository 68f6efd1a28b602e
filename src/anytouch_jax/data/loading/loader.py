"""From a manifest to batches: what a step holds is a function of (manifest, config, step) alone.

Stills and clips have a stream of epochs each; an epoch is a seeded permutation, and a batch takes the next B of it.
Where a batch reaches over the end of an epoch (always, where there are fewer rows than B) a row can be in it twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal

import numpy as np

from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.loading.labels import UNKNOWN
from anytouch_jax.data.loading.pools import CLIP, STILL, Pairs, Pool, find_pools
from anytouch_jax.data.loading.samples import SampleError, SampleReader, fill_slot
from anytouch_jax.data.loading.sampling import BOTH, TEXT, VISION, Shard, Slots, StepSchedule, uniform
from anytouch_jax.data.loading.threads import Work, do, pump
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.tokenizer import Tokenizer
from anytouch_jax.errors import UserError

__all__ = ["Loader", "SampleError", "evaluation"]

Batch = TouchBatch | Stage2Batch
Info = dict[str, int]
_KINDS: tuple[Literal["still"], Literal["clip"]] = ("still", "clip")
_NEVER = -1
_PICTURED, _TOLD = (VISION, BOTH), (BOTH, TEXT)  # strata whose rows have an image, a text
_KIND, _PART, _ORDER, _TRIPLE, _GALLERY = 1, 2, 3, 4, 5  # tags that keep the random streams of one seed apart


class Loader:
    """Batches for `config.stage` from the split `config.data.split` of a manifest.

    `notes` are sentences to tell the user once (rows left out, no clips, no pairs); `tokenizer` is the one in use, or
    None; `steps_per_epoch` is how many batches hold every still and every clip once (or as `data.weights` says).
    `devices`: image and text slots are a multiple of it. `shard` (index, count): this process reads the files of its
    part of every batch only, and gives that part; joined in order the parts are the batch of one process. Raises
    UserError: ManifestError for an empty split or an unknown sensor, SampleError (from `batch` and `stream`) for a
    bad sample.
    """

    def __init__(
        self,
        manifest: Manifest,
        config: Config,
        *,
        tokenizer: Tokenizer | None = None,
        devices: int = 1,
        shard: tuple[int, int] = (0, 1),
    ) -> None:
        if devices < 1:
            raise UserError(f"devices must be 1 or more, not {devices}")
        if config.stage == 2 and config.data.batch_size % config.objective.groups:
            raise UserError(
                f"a batch of {config.data.batch_size} does not divide by --objective.groups {config.objective.groups}"
            )
        self.manifest, self.config, self._shard = manifest, config, Shard(*shard)
        if config.stage == 2 and config.model.match_head == "cosine" and self._match_size % config.objective.groups:
            raise UserError(
                f"{self._match_size} touches to match do not divide by --objective.groups {config.objective.groups}"
            )
        for name, number in (("devices", devices), ("batch_size", config.data.batch_size)):
            self._shard.check(number, name)
        self._reader = SampleReader(manifest, config)
        found = find_pools(manifest, config, tokenizer, devices)
        self._pools, self._pairs, self._sensor, self.tokenizer, self.notes, self._force = found
        self._length = self._caption_length()
        self._align_share = self._share_of_align()
        self._align, self._match = StepSchedule(self._align_kinds), StepSchedule(self._match_kinds)

    # What a step holds ------------------------------------------------------------------------------------------

    def kind(self, step: int) -> Literal["still", "clip"]:
        """Whether the batch of `step` holds stills or clips."""
        align, match = self._align.at(step)[0], self._match.at(step)[0]
        return _KINDS[match if align == _NEVER else align]

    @property
    def steps_per_epoch(self) -> int:
        """Batches that hold every still and every clip once (and every anchor, where matching has its own steps)."""
        size = self.config.data.batch_size
        steps = sum(-(-pool.draws // size) for pool in self._drawn)
        if self.config.data.split_steps:
            steps += sum(-(-pairs.anchors.size // self._match_size) for pairs in self._drawn_pairs)
        return steps

    @property
    def _no_stills(self) -> bool:
        return len(self._pools) > 1 and self.config.data.clip_share == 1

    @property
    def _drawn(self) -> tuple[Pool, ...]:
        """Those of stills and clips that batches are drawn from."""
        return self._pools[1:] if self._no_stills else self._pools

    @property
    def _drawn_pairs(self) -> list[Pairs]:
        """Those of stills and clips that matching draws from (`_match_kinds`)."""
        still, clip = self._pairs
        chosen = (clip,) if clip is not None and self._no_stills else (still, clip)
        return [pairs for pairs in chosen if pairs is not None]

    @property
    def trained_sensors(self) -> list[str]:
        """Names of the sensors that batches are drawn from, in the order of the table."""
        drawn = [pool.windows[:, -1] for pool in self._drawn] + [pair.windows[:, -1] for pair in self._drawn_pairs]
        rows = np.unique(self._sensor[np.concatenate(drawn)])
        return [self.config.model.sensors[row] for row in rows]

    def batch(self, step: int) -> Batch:
        """The batch of `step`, made in this thread: TouchBatch in stage 1, Stage2Batch in stage 2."""
        return do(self._plan(step))[0]

    def stream(self, start: int, stop: int) -> Iterator[tuple[int, Batch, Info]]:
        """(step, batch, info) for steps start .. stop - 1, made ahead by `data.threads` threads.

        The bytes do not depend on the threads. `info` counts `skipped_samples` of this shard, `images` and `texts` of
        the whole batch. Close the iterator to stop early; its threads end with it.
        """
        return pump(self._plan, range(start, stop), self.config.data.threads, self.config.data.prefetch)

    def _plan(self, step: int) -> Work[Batch]:
        align_kind, align_rank = self._align.at(step)
        match_kind, match_rank = self._match.at(step)
        align = self._plan_align(step, self._pools[align_kind], align_rank) if align_kind != _NEVER else None
        if self.config.stage == 1:
            assert align is not None
            part, force = align.batch
            return Work(TouchBatch(part.clip, part.sensor, force), align.jobs, align.info)
        match = self._plan_match(step, match_kind, match_rank) if match_kind != _NEVER else None
        batch = Stage2Batch(align.batch[0] if align else None, match.batch if match else None)
        jobs = [*(align.jobs if align else ()), *(match.jobs if match else ())]
        return Work(batch, jobs, align.info if align else {"images": 0, "texts": 0})

    # Which kind a step takes ------------------------------------------------------------------------------------

    def _kinds(self, steps: np.ndarray) -> np.ndarray:
        share = self.config.data.clip_share if len(self._pools) > 1 else 0.0
        if self.config.data.order == "alternate":
            return (np.floor((steps + 1) * share) > np.floor(steps * share)).astype(np.int8)
        return (uniform(self.config.run.seed, _KIND, steps) < share).astype(np.int8)

    def _aligns(self, steps: np.ndarray) -> np.ndarray:
        return uniform(self.config.run.seed, _PART, steps) < self._align_share

    def _align_kinds(self, steps: np.ndarray) -> np.ndarray:
        return np.where(self._aligns(steps), self._kinds(steps), _NEVER)

    def _match_kinds(self, steps: np.ndarray) -> np.ndarray:
        if self._pairs[STILL] is None:
            return np.full(len(steps), _NEVER)
        kinds = self._kinds(steps) if self._pairs[CLIP] is not None else np.full(len(steps), STILL)
        return np.where(self._aligns(steps), _NEVER, kinds) if self.config.data.split_steps else kinds

    def _share_of_align(self) -> float:
        """Share of the steps that align: all, or as many as align batches there are to match batches (release)."""
        pairs = self._drawn_pairs
        if not self.config.data.split_steps or not pairs:
            return 1.0
        align = sum(pool.draws for pool in self._drawn) / self.config.data.batch_size
        return align / (align + sum(pair.anchors.size for pair in pairs) / self._match_size)

    @property
    def _match_size(self) -> int:
        size = self.config.data.batch_size
        return max(1, size // 2) if self.config.data.split_steps else size

    # Filling a batch --------------------------------------------------------------------------------------------

    def _empty(self, rows: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
        size, rows = self.config.model.image_size, self._shard.share(rows)
        return np.zeros((rows, frames, size, size, 3), np.uint8), np.zeros(rows, np.int32)

    def _plan_align(self, step: int, pool: Pool, rank: int) -> Work[tuple[AlignBatch, np.ndarray | None]]:
        """Rows of all strata in a seeded order; images and texts are packed into the slots in that order.

        Beside the batch: force labels f32 (rows, 2) of this shard, or None.
        """
        before, now = pool.strata.at(rank)
        draws = [
            (stratum, *draw)
            for stratum, stream in enumerate(pool.streams)
            for draw in stream.take(int(before[stratum]), int(now[stratum]))
        ]  # fmt: skip
        seed, rows = self.config.run.seed % 2**63, self.config.data.batch_size
        order = np.random.default_rng([seed, _ORDER, step]).permutation(rows)
        draws = [draws[at] for at in order]
        pictured, told = ([slot for slot, draw in enumerate(draws) if draw[0] in kinds] for kinds in (_PICTURED, _TOLD))
        image_row, text_row = np.full(pool.strata.images, rows, np.int32), np.full(self._texts(pool), rows, np.int32)
        image_row[: len(pictured)], text_row[: len(told)] = pictured, told
        image, text = ({slot: i for i, slot in enumerate(slots)} for slots in (pictured, told))
        clip, sensor = self._empty(rows, pool.windows.shape[1])
        batch = AlignBatch(clip, sensor, *self._slots(image_row, text_row))
        force = None if self._force is None else np.full((len(sensor), 2), UNKNOWN)
        jobs: list[Any] = []
        for slot, (stratum, index, epoch) in enumerate(draws):
            mine = Slots(
                self._shard.place(slot, rows),
                self._shard.place(image.get(slot), len(image_row)),
                self._shard.place(text.get(slot), len(text_row)),
            )
            if mine == Slots(None, None, None):
                continue
            write = partial(self._write_align, batch, force, pool, stratum, mine)
            size = len(pool.members[stratum])
            job = partial(fill_slot, write, size, step, slot, self.config, index, epoch)
            jobs.append(job if mine.touch is not None else partial(_uncounted, job))
        return Work((batch, force), jobs, {"images": len(pictured), "texts": len(told)})

    def _caption_length(self) -> int:
        """How many tokens a caption is padded to: the longest of the manifest, in eights, at most the text tower's.

        The tower is causal and reads its embedding at the end token, so positions behind it change nothing.
        """
        tower = self.config.model.text
        if tower is None or self.tokenizer is None:
            return 0
        captions = self.manifest.column("text").unique().drop_null().to_pylist()
        return min(tower.length, -(-self.tokenizer.longest(captions) // 8) * 8)

    def _texts(self, pool: Pool) -> int:
        return pool.strata.texts if self.tokenizer is not None else 0

    def _slots(self, image_row: np.ndarray, text_row: np.ndarray) -> tuple[np.ndarray, ...]:
        """This shard's image and text slots, still empty. An unused text slot is an empty caption, so that no tower
        meets a text of nothing but padding (its gradient could be NaN even where its value is dropped)."""
        size, length = self.config.model.image_size, self._length
        image_row, text_row = self._shard.cut(image_row), self._shard.cut(text_row)
        image = np.zeros((len(image_row), size, size, 3), np.uint8)
        if self.tokenizer is None or not len(text_row):
            text, mask = np.zeros((0, length), np.int32), np.zeros((0, length), bool)
        else:
            text, mask = self.tokenizer.encode([""] * len(text_row), length)
        return image, image_row, text, mask, text_row

    def _write_align(
        self, batch: AlignBatch, force: np.ndarray | None, pool: Pool, stratum: int, mine: Slots, index: int, epoch: int
    ) -> None:  # fmt: skip
        rows = pool.windows[pool.members[stratum][index]]
        # Which sample replaces a bad one must not depend on the shard, so where bad ones are skipped all is read.
        whole = self.config.data.on_bad_sample == "skip"
        if whole or mine.touch is not None:
            self._reader.touch(rows, epoch, None if mine.touch is None else batch.clip[mine.touch])
        picture = None
        if stratum in _PICTURED and (whole or mine.image is not None):
            picture = self._reader.vision(rows[-1], epoch)
        if mine.touch is not None:
            batch.sensor[mine.touch] = self._sensor[rows[-1]]
            if force is not None and self._force is not None:
                force[mine.touch] = self._force.of(rows)
        if mine.image is not None:
            batch.image[mine.image] = picture
        if mine.text is not None and self.tokenizer is not None:
            ids, mask = self.tokenizer.encode([self._reader.caption(rows[-1])], batch.text.shape[1])
            batch.text[mine.text], batch.text_mask[mine.text] = ids[0], mask[0]

    def _plan_match(self, step: int, kind: int, rank: int) -> Work[MatchBatch]:
        pairs, rows = self._pairs[kind], self._match_size
        assert pairs is not None
        self._shard.check(rows, "the rows of a matching batch")
        parts = [self._empty(rows, pairs.windows.shape[1]) for _ in range(2 if self._alone else 3)]
        batch = MatchBatch(*(array for part in parts for array in part))
        if self._alone:
            batch = batch._replace(place=np.zeros(len(batch.sensor), np.int32))
        jobs: list[Any] = []
        sensor = self._gallery_sensor(step, pairs)
        for slot, (index, epoch) in enumerate(pairs.anchors.take(rank * rows, rows)):
            mine = self._shard.place(slot, rows)
            if mine is None:
                continue
            write = partial(self._write_match, batch, pairs, mine, sensor)
            # Slots of matching come after those of alignment, so that a replacement is drawn apart from theirs.
            place, size = self.config.data.batch_size + slot, len(pairs.matches.anchors)
            jobs.append(partial(fill_slot, write, size, step, place, self.config, index, epoch))
        return Work(batch, jobs)

    @property
    def _alone(self) -> bool:
        """Whether the other pairs of the batch are the negatives, and no third touch is read."""
        return self.config.model.match_head == "cosine"

    def _gallery_sensor(self, step: int, pairs: Pairs) -> int | None:
        """The sensor that touches to be found in a step's batch are of, where negatives are of the positive's.

        Drawn as a partner's is, so that a sensor that felt few places is asked for as seldom.
        """
        if not (self._alone and self.config.data.negatives == "same_sensor"):
            return None
        rng = np.random.default_rng([self.config.run.seed % 2**63, _GALLERY, step])
        partner, _ = pairs.matches.draw(int(rng.choice(pairs.matches.anchors)), rng)
        return int(self._sensor[pairs.windows[partner, -1]])

    def _write_match(
        self, batch: MatchBatch, pairs: Pairs, slot: int, sensor: int | None, index: int, epoch: int
    ) -> None:
        anchor = int(pairs.matches.anchors[index])
        row = int(pairs.windows[anchor, -1])
        rng = np.random.default_rng([self.config.run.seed % 2**63, _TRIPLE, epoch, row])
        positive, negative = pairs.matches.draw(anchor, rng, sensor)
        if sensor is not None and self._sensor[pairs.windows[anchor, -1]] == sensor:
            anchor, positive = positive, anchor
        triple = [(batch.clip, batch.sensor, anchor), (batch.positive, batch.positive_sensor, positive)]
        if batch.place is not None:
            batch.place[slot] = pairs.matches.place(anchor)
        else:
            triple.append((batch.negative, batch.negative_sensor, negative))
        for clip, sensors, touch in triple:
            rows = pairs.windows[touch]
            self._reader.touch(rows, epoch, clip[slot])
            sensors[slot] = self._sensor[rows[-1]]


def _uncounted(job: Callable[[], int]) -> int:
    """Another shard has the row itself and counts what was skipped."""
    job()
    return 0
