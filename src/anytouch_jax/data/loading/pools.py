"""Pools to draw from: stills, clips and matching pairs of a split, in strata by modality.

`find_pools` runs once before the first step. It selects the rows of the split, finds the clips
among them, and gives each stratum a sampler. The loader then draws from the pools by step number.

A window is one row (a still) or the rows of a clip, oldest first. Its last row is the one that
labels, images and captions are taken from.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.config import RELEASE_WEIGHTS, Config
from anytouch_jax.data.background.contact import known_contact
from anytouch_jax.data.background.rule import ADVICE, Backgrounds
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

# kinds of windows, which index the pools
STILL = 0
CLIP = 1
_NEITHER = 3  # the last stratum: windows without RGB image and caption
_STRATA = 4
# tags that keep the random streams of one seed apart
_ALIGN = 100
_ANCHOR = 200
# column of frames in a test split of a downstream task (paper, appendix: fairness)
_DOWNSTREAM = "downstream_test"
_FALSE_WORDS = ("", "0", "0.0", "false", "no", "none")


class Pool(NamedTuple):
    """Windows of one kind, in strata.

    Attributes:
        windows: Rows i64 (M, T).
        quota: How many of each stratum a batch takes.
        members: For each stratum its ids in `windows`.
        samplers: For each stratum a sampler over its members.
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
    """Windows of one kind for matching.

    Attributes:
        windows: Rows i64 (M, T).
        matches: The matches among them.
        anchors: A sampler over the anchors of these.
    """

    windows: np.ndarray
    matches: Matches
    anchors: EpochSampler


class Pools(NamedTuple):
    """All pools of a run.

    Attributes:
        touch: Of stills, and of clips if there are any.
        match: Of stills and of clips, None if they have no match.
        sensor: i32 (rows,), rows of the sensor table, -1 for rows that are left out.
        tokenizer: Of the captions, None without any.
        notes: Sentences for the user.
    """

    touch: tuple[Pool, ...]
    match: tuple[MatchPool | None, MatchPool | None]
    sensor: np.ndarray
    tokenizer: Tokenizer | None
    notes: list[str]


class _Usable(NamedTuple):
    """Rows that a run may use. All but `rows` have a value for each row of the manifest.

    Attributes:
        sensor: As in `Pools`.
        rows: i64 ids of rows that may be drawn.
        weights: f64, draws an epoch, None for 1 each.
        ends: Whether a clip may end there. Its earlier frames may be rows that are not drawn.
        has_image: False without an image tower.
        has_text: False without a text tower.
    """

    sensor: np.ndarray
    rows: np.ndarray
    weights: np.ndarray | None
    ends: np.ndarray
    has_image: np.ndarray
    has_text: np.ndarray

    def weights_of(self, windows: np.ndarray) -> np.ndarray | None:
        """Return the draws an epoch of windows, those of their last rows."""
        if self.weights is None:
            return None
        return self.weights[windows[:, -1]]


def find_pools(
    manifest: Manifest,
    config: Config,
    tokenizer: Tokenizer | None,
    devices: int,
    backgrounds: Backgrounds | None = None,
) -> Pools:
    """Return the pools of the split `config.data.split`.

    Args:
        manifest: The frames.
        config: Of the run.
        tokenizer: Of the captions; without it one is read or trained if it is needed.
        devices: The image and text slots of a batch are a multiple of it.
        backgrounds: The backgrounds that are subtracted, if any are. Rows without one are left out
            if the model needs one.

    Raises:
        UserError: For an empty split, an unknown sensor, an unfit tokenizer, and data without a
            training signal.
    """
    usable, notes = _usable_rows(manifest, config, backgrounds)
    tokenizer, note = _tokenizer_of(manifest, config, usable, tokenizer)
    notes += note
    if config.stage == 2 and config.model.text:
        notes += _withheld_notes(manifest, config, usable.rows)
    data = config.data
    # with the next frame, if it is predicted
    length = config.model.frames + config.reconstructs
    stills = usable.rows[:, None]
    clips = _clips(manifest, config, usable, length)
    shards = _shards(manifest) if data.parts else None
    touch = tuple(
        _pool(config, usable, kind, windows, devices, shards)
        for kind, windows in ((STILL, stills), (CLIP, clips))
        if len(windows)
    )
    if len(touch) == 1 and data.clip_fraction:
        notes.append(
            f"split {data.split!r} has no clip of {length} frames, so all batches are stills"
        )
    match: tuple[MatchPool | None, MatchPool | None] = (None, None)
    if config.stage == 2 and config.model.match_head != "none":
        # Matching predicts no frame, so its clips are shorter.
        if length != config.model.frames:
            clips = _clips(manifest, config, usable, config.model.frames)
        match, note = _match_pools(manifest, config, usable, stills, clips)
        notes += note
        if match[STILL] and match[CLIP] is None and len(touch) > 1:
            notes.append("no two clips share a touch: matching uses stills only")
    _check_signal(config, touch, match)
    return Pools(touch, match, usable.sensor, tokenizer, notes)


def _tokenizer_of(
    manifest: Manifest, config: Config, usable: _Usable, tokenizer: Tokenizer | None
) -> tuple[Tokenizer | None, list[str]]:
    """Return the tokenizer, chosen if there are captions and none is given, and notes.

    Raises UserError if it has more tokens than the text tower.
    """
    captioned = usable.rows[usable.has_text[usable.rows]]
    if not captioned.size:
        return tokenizer, []
    notes: list[str] = []
    if tokenizer is None:
        tokenizer, notes = choose_tokenizer(manifest, captioned, config)
    tower = config.model.text
    if tokenizer and tower and tokenizer.vocab_size > tower.vocab:
        raise UserError(
            f"the tokenizer has {tokenizer.vocab_size} tokens but the text tower only "
            f"{tower.vocab}: set --model.text.vocab {tokenizer.vocab_size} or give another "
            "tokenizer"
        )
    return tokenizer, notes


def _check_signal(
    config: Config, touch: tuple[Pool, ...], match: tuple[MatchPool | None, MatchPool | None]
) -> None:
    """Raise UserError if stage 2 has nothing to learn from these pools."""
    has_modality = any(len(ids) for pool in touch for ids in pool.members[:_NEITHER])
    if config.stage == 2 and not (has_modality or any(match) or config.reconstructs):
        raise UserError(
            f"stage 2 has nothing to learn from split {config.data.split!r}. It needs RGB images "
            "(image_path), captions (text), or places touched by two sensors (touch). Add one with "
            "its tower or head, or train stage 1."
        )


def _clips(manifest: Manifest, config: Config, usable: _Usable, length: int) -> np.ndarray:
    """Return the clips of usable rows, i64 (clips, length); none for a run of stills."""
    if not config.data.clip_fraction:
        return np.empty((0, length), np.int64)
    clips = manifest.clips(length, config.data.split)
    good = usable.ends[clips[:, -1]]
    for frame in clips.T:
        good &= usable.sensor[frame] >= 0
    # a copy of millions of clips is spared
    if good.all():
        return clips
    return clips[good]


def _shards(manifest: Manifest) -> np.ndarray:
    """Return the shard of each row as a code, i64 (rows,).

    A shard is a file of a manifest, so its path without the entry: touch/0.zip of touch/0.zip/17.
    For loose files it is their folder. In a Parquet file, the entry has a column too.
    """
    path = manifest.column("path").combine_chunks()
    folder = pc.replace_substring_regex(path, r"/[^/]*$", "")
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
    """Return the pool of windows of one kind, cut into strata in the order of `StratumQuota`."""
    has_image = usable.has_image[windows[:, -1]]
    has_text = usable.has_text[windows[:, -1]]
    strata = (
        has_image & ~has_text,
        has_image & has_text,
        ~has_image & has_text,
        ~has_image & ~has_text,
    )
    members = tuple(np.flatnonzero(stratum) for stratum in strata)
    seed = config.run.seed
    first_tag = _ALIGN + _STRATA * kind
    samplers: list[EpochSampler | PartSampler]
    if shards is None:
        samplers = [
            EpochSampler(len(ids), seed, first_tag + stratum, usable.weights_of(windows[ids]))
            for stratum, ids in enumerate(members)
        ]
    else:
        if config.stage != 1 or usable.weights is not None:
            raise UserError(
                "--data.parts is for stage 1 without --data.weights; leave one of them out"
            )
        # In stage 1 nothing has an image or a caption, so all windows are of the last stratum.
        shard_of = shards[windows[:, -1]]
        parts = config.data.parts
        last = PartSampler(shard_of, config.data.batch_size, parts, seed, first_tag + _NEITHER)
        samplers = [*[EpochSampler(0, 0, 0)] * _NEITHER, last]
    quota = StratumQuota([sampler.size for sampler in samplers], config.data.batch_size, devices)
    return Pool(windows, quota, members, tuple(samplers))


def _match_pools(
    manifest: Manifest, config: Config, usable: _Usable, stills: np.ndarray, clips: np.ndarray
) -> tuple[tuple[MatchPool | None, MatchPool | None], list[str]]:
    """Return the matching pools of stills and clips, and notes."""

    def codes(name: str, own: bool = False) -> np.ndarray:
        codes = manifest.codes(name, own=own)
        # half the memory for millions of rows
        if codes.max(initial=0) < 1 << 31:
            return codes.astype(np.int32)
        return codes

    # Names of units, objects and data sets mean the same in every manifest; places do not.
    keys = MatchKeys(
        codes("touch", own=True), usable.sensor, codes("unit"), codes("object"), codes("dataset")
    )
    same_sensor = config.data.negatives == "same_sensor"
    other_object = config.recipe == "release"

    def pool(kind: int, windows: np.ndarray) -> MatchPool | None:
        matches = Matches(windows[:, -1], keys, same_sensor=same_sensor, other_object=other_object)
        if not matches.anchors.size:
            return None
        weights = usable.weights_of(windows[matches.anchors])
        anchors = EpochSampler(len(matches.anchors), config.run.seed, _ANCHOR + kind, weights)
        return MatchPool(windows, matches, anchors)

    still = pool(STILL, stills)
    clip = pool(CLIP, clips) if config.data.clip_fraction else None
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
    manifest: Manifest, config: Config, backgrounds: Backgrounds | None
) -> tuple[_Usable, list[str]]:
    """Return the rows of the split that may be drawn, and notes.

    They have an image of a known sensor, a background if the model needs one, a weight, and all
    that the user requires.
    """
    split = config.data.split
    rows = manifest.rows_of(split)
    sensor, notes = sensor_rows(manifest, config.model, rows, unknown=config.data.on_bad_sample)
    rows = rows[sensor[rows] >= 0]
    if not rows.size:
        files = ", ".join(map(str, manifest.files))
        raise ManifestError(
            f"{files}: split {split!r} has no row of a known sensor with images; "
            "add some, or the sensor by --model.sensors"
        )
    if backgrounds is not None:
        notes.append(backgrounds.report(rows))
        missing, note = _without_background(manifest, config, rows, backgrounds)
        notes += note
        if len(missing):
            sensor = sensor.copy()
            rows = np.setdiff1d(rows, missing)
            sensor[missing] = -1
    weights, note = epoch_weights(manifest, config, rows)
    notes += note
    if weights is not None:
        rows = rows[weights[rows] > 0]
        sensor = np.where(weights > 0, sensor, -1)
    withheld = withheld_text(manifest, aligned_text=config.data.aligned_text)
    has = {"image": manifest.present("image_path"), "text": manifest.present("text") & ~withheld}
    allowed, note = _required(manifest, config, rows, has)
    notes += note
    aligns = config.stage == 2
    none = np.zeros(len(manifest), bool)
    usable = _Usable(
        sensor=sensor,
        rows=rows[allowed[rows]],
        weights=weights,
        ends=allowed,
        has_image=has["image"] if aligns and config.model.image else none,
        has_text=has["text"] if aligns and config.model.text else none,
    )
    return usable, notes


def _without_background(
    manifest: Manifest, config: Config, rows: np.ndarray, backgrounds: Backgrounds
) -> tuple[np.ndarray, list[str]]:
    """Return the rows that are left out for want of a background, and notes.

    Raises ManifestError if these are all.
    """
    if config.data.background != "subtract":
        return rows[:0], []
    missing = rows[~backgrounds.has(rows)]
    if len(missing) == len(rows):
        raise ManifestError(
            f"{manifest.where(int(rows[0]))} and {len(rows) - 1} other rows have no image of "
            f"the untouched gel, which --data.background subtract requires. {ADVICE}"
        )
    if not len(missing):
        return missing, []
    return missing, [
        f"{len(missing)} of {len(rows)} rows have no image of the untouched gel, and are left out"
    ]


def _required(
    manifest: Manifest, config: Config, rows: np.ndarray, has: dict[str, np.ndarray]
) -> tuple[np.ndarray, list[str]]:
    """Return which rows of the manifest the user's requirements allow, bool (rows,), and notes.

    These are `data.require` and `data.contact_only`. `has` says which rows have a modality.
    """
    wanted: list[str] = [*config.data.require]
    if config.data.contact_only:
        wanted.append("contact")
        if "label.contact" not in manifest.table.column_names:
            raise UserError(
                "--data.contact-only needs the column 'label.contact', which `anytouch data "
                "contact` writes"
            )
        # rows of unknown contact stay
        has = {**has, "contact": known_contact(manifest) != 0}
    if not wanted:
        return np.ones(len(manifest), bool), []
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
    """Return how often an epoch draws each row of the manifest, f64 (rows,), and notes.

    It is None if each row comes once. `rows` are those of the split.
    """
    column = manifest.column("dataset")
    split = config.data.split
    datasets = pc.unique(column.take(rows)).drop_null().to_pylist()
    wanted: tuple[tuple[str, float], ...] = ()
    if config.data.weights is not None:
        # simulated touches are no rows
        wanted = tuple(pair for pair in config.data.weights if pair[0] != "simulated")
    elif config.recipe == "release" and config.stage == 2:
        # its stage 1 draws every row once
        wanted = tuple(pair for pair in RELEASE_WEIGHTS if pair[0] in datasets)
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
    if len(dict(wanted)) < len(wanted):
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
    counts = [
        f"{name} {weight:g} times" if weight else f"{name} not at all" for name, weight in wanted
    ]
    return weights, [f"an epoch draws {', '.join(counts)}, other datasets once"]


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
    """Return the rows whose touch sensors or units share, bool (rows,)."""
    touch = manifest.codes("touch", own=True)
    return is_shared_touch(touch, manifest.codes("sensor"), manifest.codes("unit"))


def _in_downstream_test(manifest: Manifest) -> np.ndarray:
    """Return the rows in a test split of a downstream task, bool (rows,)."""
    if _DOWNSTREAM not in manifest.table.column_names:
        return np.zeros(len(manifest), bool)
    word = pc.utf8_lower(manifest.table[_DOWNSTREAM].cast(pa.string()))
    return ~np.asarray(pc.is_in(pc.fill_null(word, ""), value_set=pa.array(_FALSE_WORDS)))


def _withheld_notes(manifest: Manifest, config: Config, rows: np.ndarray) -> list[str]:
    text = manifest.present("text")[rows]
    notes = []
    tested = int((text & _in_downstream_test(manifest)[rows]).sum())
    if tested:
        notes.append(
            f"the text of {tested} rows is withheld: they are in a test split of a downstream task"
        )
    if not config.data.aligned_text:
        shared = int((text & _is_aligned(manifest)[rows]).sum())
        notes.append(
            f"the text of {shared} of {int(text.sum())} rows is withheld: other sensors or units "
            "share the touch (data.aligned_text)"
        )
    return notes


def training_captions(
    manifest: Manifest, rows: np.ndarray, *, aligned_text: bool = True
) -> list[str]:
    """Return the distinct captions of `rows` that may be trained on, sorted.

    Which ones may is told by `withheld_text`.
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
    """Return the tokenizer of a run, None without captions, and notes.

    It is read from `file`, else from `data.tokenizer`, else trained on the captions.

    Args:
        manifest: The frames.
        rows: Rows whose captions it is trained on, as far as these may be.
        config: Of the run.
        file: A tokenizer.json or its folder.
        vocabulary: Most tokens of a trained one, by default as many as the text tower has.

    Raises:
        UserError: For a file that is missing or unfit.
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
