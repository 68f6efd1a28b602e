"""Pools to draw from: the stills, clips and matching pairs of a split, cut into strata by modality.

`find_pools` runs once before the first step. It selects the rows of the split, finds the clips
among them, and gives each stratum a sampler. The loader then draws from the pools by step number.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.config import RELEASE_WEIGHTS, Config
from anytouch_jax.data.background.contact import known_contact
from anytouch_jax.data.background.rule import ADVICE, UnitGels
from anytouch_jax.data.loading.sampling import (
    EpochSampler,
    Matches,
    MatchKeys,
    PartSampler,
    StratumQuota,
    is_shared_touch,
)
from anytouch_jax.data.manifest.manifest import Manifest, ManifestError, sensor_rows
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer, train_tokenizer
from anytouch_jax.errors import UserError

STILL = 0
CLIP = 1
_NEITHER = 3  # the last stratum: windows without photograph and caption
# tags that keep the random streams of one seed apart
_ALIGN = 100
_ANCHOR = 200
# column of frames in a test split of a downstream task (paper, appendix: fairness)
_DOWNSTREAM = "downstream_test"
_FALSE_WORDS = ("", "0", "0.0", "false", "no", "none")


class Pool(NamedTuple):
    """Windows of rows i64 (M, T); for each stratum its ids in `windows` (`members`) and a sampler
    over these.
    """

    windows: np.ndarray
    quota: StratumQuota
    members: tuple[np.ndarray, ...]
    samplers: tuple[EpochSampler | PartSampler, ...]

    @property
    def draws(self) -> int:
        """Windows that an epoch draws."""
        return sum(sampler.size for sampler in self.samplers)


class MatchPool(NamedTuple):
    """Windows of rows i64 (M, T) for matching, the matches among them, and a sampler over the
    anchors.
    """

    windows: np.ndarray
    matches: Matches
    anchors: EpochSampler


class Pools(NamedTuple):
    """All pools of a run, None or absent if empty; `sensor` i32 (rows,) are sensor-table rows, -1
    for rows left out.
    """

    touch: tuple[Pool, ...]
    match: tuple[MatchPool | None, MatchPool | None]
    sensor: np.ndarray
    tokenizer: Tokenizer | None
    notes: list[str]


class _Usable(NamedTuple):
    """Rows that a run may use: `rows` i64 ids that may be drawn; the other arrays have a value per
    manifest row.

    `sensor` is as in `Pools`, `weights` f64 draws per epoch (None: 1), `ends` whether a clip may
    end there. `has_image` and `has_text` are False without a tower.
    """

    sensor: np.ndarray
    rows: np.ndarray
    weights: np.ndarray | None
    ends: np.ndarray
    has_image: np.ndarray
    has_text: np.ndarray

    def weights_of(self, windows: np.ndarray) -> np.ndarray | None:
        if self.weights is None:
            return None
        return self.weights[windows[:, -1]]


def find_pools(
    manifest: Manifest,
    config: Config,
    tokenizer: Tokenizer | None,
    devices: int,
    gels: UnitGels | None = None,
) -> Pools:
    """Return the pools of the split `config.data.split`; `devices` sets the multiple of the slots.

    `gels` are the pictures that are subtracted, if any are. Rows without one are left out if the
    model needs one. Raises UserError for an empty split, an unknown sensor, an unfit tokenizer, and
    for data without a training signal.
    """
    usable, notes = _usable_rows(manifest, config, gels)
    captioned = usable.rows[usable.has_text[usable.rows]]
    if captioned.size and tokenizer is None:
        tokenizer, note = choose_tokenizer(manifest, captioned, config)
        notes += note
    if (
        captioned.size
        and tokenizer
        and config.model.text
        and tokenizer.vocab_size > config.model.text.vocab
    ):
        raise UserError(
            f"the tokenizer has {tokenizer.vocab_size} tokens but the text tower only "
            f"{config.model.text.vocab}: "
            f"set --model.text.vocab {tokenizer.vocab_size} or give another tokenizer"
        )
    if config.stage == 2 and config.model.text:
        notes += _withheld_notes(manifest, config, usable.rows)
    data = config.data
    frames = config.model.frames
    length = frames + config.reconstructs
    stills = usable.rows[:, None]
    clips = _clips(manifest, config, usable, length)
    shards = _shards(manifest) if data.parts else None
    kinds = [(kind, ids) for kind, ids in enumerate((stills, clips)) if len(ids)]
    touch = tuple(_pool(config, usable, kind, ids, devices, shards) for kind, ids in kinds)
    if len(touch) == 1 and data.clip_share:
        notes.append(
            f"split {data.split!r} has no clip of {length} frames, so all batches are stills"
        )
    match: tuple[MatchPool | None, MatchPool | None] = (None, None)
    if config.stage == 2 and config.model.match_head != "none":
        clips = clips if length == frames else _clips(manifest, config, usable, frames)
        match, note = _match_pools(manifest, config, usable, stills, clips)
        notes += note
        if match[STILL] and match[CLIP] is None and len(touch) > 1:
            notes.append("no two clips share a touch: matching uses stills only")
    has_modality = any(len(ids) for pool in touch for ids in pool.members[:_NEITHER])
    if config.stage == 2 and not (has_modality or any(match) or config.reconstructs):
        raise UserError(
            f"stage 2 has nothing to learn from split {data.split!r}. It needs photographs "
            "(image_path), captions "
            "(text), or places touched by two sensors (touch). Add one with its tower or head, or "
            "train stage 1."
        )
    return Pools(touch, match, usable.sensor, tokenizer, notes)


def _clips(manifest: Manifest, config: Config, usable: _Usable, length: int) -> np.ndarray:
    """Return the clips of usable rows, i64 (clips, length); none for a run of stills."""
    if not config.data.clip_share:
        return np.empty((0, length), np.int64)
    clips = manifest.clips(length, config.data.split)
    good = usable.ends[clips[:, -1]]
    for frame in clips.T:
        good &= usable.sensor[frame] >= 0
    if good.all():
        return clips
    return clips[good]


def _shards(manifest: Manifest) -> np.ndarray:
    """Return the shard of each row, i64 (rows,): its manifest with its path without the entry, or
    its folder.
    """
    folder = pc.replace_substring_regex(manifest.column("path").combine_chunks(), r"/[^/]*$", "")
    place = pc.replace_substring_regex(folder, r"\.parquet/[^/]*$", ".parquet")
    codes = np.asarray(place.dictionary_encode().indices).astype(np.int64)
    return codes * len(manifest.files) + manifest.source


def _pool(
    config: Config,
    usable: _Usable,
    kind: int,
    windows: np.ndarray,
    devices: int,
    shards: np.ndarray | None,
) -> Pool:
    has_image = usable.has_image[windows[:, -1]]
    has_text = usable.has_text[windows[:, -1]]
    strata = (
        has_image & ~has_text,
        has_image & has_text,
        ~has_image & has_text,
        ~has_image & ~has_text,
    )
    members = tuple(np.flatnonzero(stratum) for stratum in strata)
    samplers: tuple[EpochSampler | PartSampler, ...] = tuple(
        EpochSampler(
            len(ids), config.run.seed, _ALIGN + 4 * kind + s, usable.weights_of(windows[ids])
        )
        for s, ids in enumerate(members)
    )
    if shards is not None:
        if config.stage != 1 or usable.weights is not None:
            raise UserError(
                "--data.parts is for stage 1 without --data.weights; leave one of them out"
            )
        size = config.data.batch_size
        at = shards[windows[:, -1]]
        none = [EpochSampler(0, 0, 0)] * _NEITHER
        samplers = (
            *none,
            PartSampler(at, size, config.data.parts, config.run.seed, _ALIGN + 4 * kind + _NEITHER),
        )
    quota = StratumQuota([sampler.size for sampler in samplers], config.data.batch_size, devices)
    return Pool(windows, quota, members, samplers)


def _match_pools(
    manifest: Manifest, config: Config, usable: _Usable, stills: np.ndarray, clips: np.ndarray
) -> tuple[tuple[MatchPool | None, MatchPool | None], list[str]]:
    """Return the matching pools of stills and clips, and notes."""

    def codes(name: str, own: bool = False) -> np.ndarray:
        codes = manifest.codes(name, own=own)
        if codes.max(initial=0) < 1 << 31:
            return codes.astype(np.int32)
        return codes

    keys = MatchKeys(
        codes("touch", own=True), usable.sensor, codes("unit"), codes("object"), codes("dataset")
    )
    same_sensor = config.data.negatives == "same_sensor"
    seed = config.run.seed

    def pool(kind: int, windows: np.ndarray) -> MatchPool | None:
        other_object = config.recipe == "release"
        matches = Matches(windows[:, -1], keys, same_sensor=same_sensor, other_object=other_object)
        if not matches.anchors.size:
            return None
        weights = usable.weights_of(windows[matches.anchors])
        return MatchPool(
            windows, matches, EpochSampler(len(matches.anchors), seed, _ANCHOR + kind, weights)
        )

    still = pool(STILL, stills)
    clip = pool(CLIP, clips) if config.data.clip_share else None
    notes = []
    if still is None:
        reason = "no place (column 'touch') was touched by two sensors or units"
        if same_sensor:
            reason = "no place was touched by two sensors, one of which also touched another place"
        option = " with data.negatives=same_sensor" if same_sensor else ""
        notes.append(f"{reason}: there is no cross-sensor matching{option}")
    elif still.matches.one_object:
        notes.append(
            "all touches are of one object: the negatives of matching are other places on it"
        )
    return (still, clip), notes


def _usable_rows(
    manifest: Manifest, config: Config, gels: UnitGels | None
) -> tuple[_Usable, list[str]]:
    """Return the rows of the split with images of a known sensor, a weight, and all that is
    required; and notes.
    """
    split = config.data.split
    on_bad = config.data.on_bad_sample
    rows = manifest.rows_of(split)
    sensor, notes = sensor_rows(manifest, config.model, rows, unknown=on_bad)
    rows = rows[sensor[rows] >= 0]
    if not rows.size:
        files = ", ".join(map(str, manifest.files))
        raise ManifestError(
            f"{files}: split {split!r} has no row of a known sensor with images; "
            "add some, or the sensor by --model.sensors"
        )
    if gels is not None:
        notes.append(gels.report(rows))
        missing = rows[~gels.has(rows)] if config.data.background == "subtract" else rows[:0]
        if len(missing) == len(rows):
            raise ManifestError(
                f"{manifest.where(int(rows[0]))} and {len(rows) - 1} other rows have no picture of "
                "the untouched gel, "
                f"which --data.background subtract requires. {ADVICE}"
            )
        if len(missing):
            notes.append(
                f"{len(missing)} of {len(rows)} rows have no picture of the untouched gel, and are "
                "left out"
            )
            sensor = sensor.copy()
            rows = np.setdiff1d(rows, missing)
            sensor[missing] = -1
    weights, note = epoch_weights(manifest, config, rows)
    notes += note
    if weights is not None:
        rows = rows[weights[rows] > 0]
        sensor = np.where(weights > 0, sensor, -1)
    text = manifest.present("text") & ~withheld_text(
        manifest, aligned_text=config.data.aligned_text
    )
    has = {"image": manifest.present("image_path"), "text": text}
    allowed, note = _required(manifest, config, rows, has)
    model = config.model
    aligns = config.stage == 2
    none = np.zeros(len(manifest), bool)
    has_image = has["image"] if aligns and model.image else none
    has_text = text if aligns and model.text else none
    return _Usable(sensor, rows[allowed[rows]], weights, allowed, has_image, has_text), notes + note


def _required(
    manifest: Manifest, config: Config, rows: np.ndarray, has: dict[str, np.ndarray]
) -> tuple[np.ndarray, list[str]]:
    """Return which rows of the manifest `data.require` and `data.contact_only` allow, bool (rows,),
    and notes.
    """
    wanted = [*config.data.require, *(["contact"] if config.data.contact_only else [])]
    if not wanted:
        return np.ones(len(manifest), bool), []
    if config.data.contact_only:
        if "label.contact" not in manifest.table.column_names:
            raise UserError(
                "--data.contact-only needs the column 'label.contact', which `anytouch data "
                "contact` writes"
            )
        # rows of unknown contact stay
        has = {**has, "contact": known_contact(manifest) != 0}
    allowed = np.logical_and.reduce([has[name] for name in wanted])
    count = int(allowed[rows].sum())
    words = " and ".join(wanted)
    option = "data.contact_only" if wanted == ["contact"] else "data.require"
    if not count:
        split = config.data.split
        raise UserError(
            f"{option}: no row of split {split!r} has {words}; add some, or leave the option out"
        )
    return allowed, [f"{count} of {len(rows)} rows have {words}; only they are drawn ({option})"]


def epoch_weights(
    manifest: Manifest, config: Config, rows: np.ndarray
) -> tuple[np.ndarray | None, list[str]]:
    """Return how often an epoch draws each row of the manifest, f64 (rows,), None if each comes
    once; and notes.
    """
    column = manifest.column("dataset")
    split = config.data.split
    datasets = pc.unique(column.take(rows)).drop_null().to_pylist()
    wanted = config.data.weights
    if wanted is not None:  # simulated touches are no rows
        wanted = tuple(pair for pair in wanted if pair[0] != "simulated")
    if wanted is None:
        # its stage 1 draws every row once
        released = config.recipe == "release" and config.stage == 2
        wanted = tuple(pair for pair in RELEASE_WEIGHTS if pair[0] in datasets) if released else ()
    for name, weight in wanted:
        if name not in datasets:
            known = ", ".join(sorted(datasets)) or "none: its column 'dataset' is empty"
            raise UserError(
                f"--data.weights names the dataset {name!r}, but split {split!r} has {known}"
            )
        if not 0 <= weight < 1e6:
            raise UserError(
                f"--data.weights of {name!r} is the number of draws per epoch, not {weight}"
            )
    if len(set(dict(wanted))) < len(wanted):
        raise UserError("--data.weights names a dataset twice; name it once")
    if not wanted:
        return None, []
    weights = np.ones(len(manifest))
    for name, weight in wanted:
        weights[np.asarray(pc.fill_null(pc.equal(column, name), False))] = weight
    if not weights[rows].any():
        raise UserError(
            f"--data.weights leaves out every row of split {split!r}; name a dataset that has some"
        )
    counts = ", ".join(
        f"{name} {weight:g} times" if weight else f"{name} not at all" for name, weight in wanted
    )
    return weights, [f"an epoch draws {counts}, other datasets once"]


def withheld_text(manifest: Manifest, *, aligned_text: bool = True) -> np.ndarray:
    """Return the rows whose text is not trained on, bool (rows,).

    These are in a test split of a downstream task (column `downstream_test`; paper, appendix), and
    without `aligned_text` touches shared by sensors or units (Table 6, "w/o Text in TacQuad").
    """
    tested = _in_downstream_test(manifest)
    if aligned_text:
        return tested
    return tested | _is_aligned(manifest)


def _is_aligned(manifest: Manifest) -> np.ndarray:
    return is_shared_touch(
        *(manifest.codes(name, own=name == "touch") for name in ("touch", "sensor", "unit"))
    )


def _in_downstream_test(manifest: Manifest) -> np.ndarray:
    if _DOWNSTREAM not in manifest.table.column_names:
        return np.zeros(len(manifest), bool)
    word = pc.utf8_lower(manifest.table[_DOWNSTREAM].cast(pa.string()))
    return ~np.asarray(pc.is_in(pc.fill_null(word, ""), value_set=pa.array(_FALSE_WORDS)))


def _withheld_notes(manifest: Manifest, config: Config, rows: np.ndarray) -> list[str]:
    text = manifest.present("text")[rows]
    notes = []
    if count := int((text & _in_downstream_test(manifest)[rows]).sum()):
        notes.append(
            f"the text of {count} rows is withheld: they are in a test split of a downstream task"
        )
    if not config.data.aligned_text:
        shared = (
            f"the text of {int((text & _is_aligned(manifest)[rows]).sum())} of {int(text.sum())} "
            "rows is withheld"
        )
        notes.append(f"{shared}: other sensors or units share the touch (data.aligned_text)")
    return notes


def training_captions(
    manifest: Manifest, rows: np.ndarray, *, aligned_text: bool = True
) -> list[str]:
    """Return the distinct captions of `rows` that may be trained on (see `withheld_text`),
    sorted.
    """
    allowed = rows[~withheld_text(manifest, aligned_text=aligned_text)[rows]]
    return sorted(pc.unique(manifest.column("text").take(allowed)).drop_null().to_pylist())


def choose_tokenizer(
    manifest: Manifest,
    rows: np.ndarray,
    config: Config,
    *,
    file: Path | None = None,
    vocabulary: int | None = None,
) -> tuple[Tokenizer | None, list[str]]:
    """Return the tokenizer of a run, and notes: from `file`, else `data.tokenizer`, else trained on
    the captions.

    Captions are those of `rows` that may be trained on; without any it is None. A trained one has
    at most `vocabulary` tokens, by default as many as the text tower. Raises UserError.
    """
    path = file or config.data.tokenizer
    if path is not None:
        return load_tokenizer(path), []
    captions = training_captions(manifest, rows, aligned_text=config.data.aligned_text)
    if not captions or config.model.text is None:
        return None, []
    tokenizer = train_tokenizer(captions, vocabulary or config.model.text.vocab)
    return tokenizer, [
        f"no tokenizer was given: one of {tokenizer.vocab_size} tokens was trained on the captions"
    ]
