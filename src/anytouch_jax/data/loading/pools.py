"""What a run can draw from: stills, clips and touches felt twice, cut into strata, each with its stream of epochs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.config import RELEASE_WEIGHTS, Config
from anytouch_jax.data import tokenizer as texts
from anytouch_jax.data.loading.labels import Force, find_force
from anytouch_jax.data.loading.matching import Matches, MatchKeys, is_shared_touch
from anytouch_jax.data.loading.sampling import EpochSampler, StratumQuota
from anytouch_jax.data.manifest.manifest import Manifest, ManifestError, sensor_rows
from anytouch_jax.data.prepare.contact import known_contact
from anytouch_jax.errors import UserError

STILL, CLIP = 0, 1
_BARE = 3  # stratum of windows without picture and caption, the last (`_Finder.pool`)
_ALIGN, _ANCHOR = 100, 200  # tags that keep the random streams of one seed apart
_WITHHELD = "downstream_test"  # column of frames in a test split of a downstream task (paper, appendix: fairness)
_NOT_SET = ("", "0", "0.0", "false", "no", "none")


class Pool(NamedTuple):
    """Windows of rows i64 (M, T) to draw from; `members[s]` the ids of stratum s in `windows`, `streams[s]` over it."""

    windows: np.ndarray
    strata: StratumQuota
    members: tuple[np.ndarray, ...]
    streams: tuple[EpochSampler, ...]

    @property
    def draws(self) -> int:
        """Windows that an epoch draws: each once, or as the weights say."""
        return sum(stream.size for stream in self.streams)


class Pairs(NamedTuple):
    """Matching: windows of rows i64 (M, T), the matches between them, and the stream over their anchors."""

    windows: np.ndarray
    matches: Matches
    anchors: EpochSampler


class Pools(NamedTuple):
    """All there is to draw from, by kind: `pools` (stills, and clips if any), `pairs` (None where there are none).

    `sensor` i32 (rows of the manifest,) sensor-table rows; `tokenizer` the one in use; `notes` to tell the user;
    `force` the labels of a run with a force head.
    """

    pools: tuple[Pool, ...]
    pairs: tuple[Pairs | None, Pairs | None]
    sensor: np.ndarray
    tokenizer: texts.Tokenizer | None
    notes: list[str]
    force: Force | None


def find_pools(manifest: Manifest, config: Config, tokenizer: texts.Tokenizer | None, devices: int) -> Pools:
    """Look through the split `config.data.split`. Raises UserError: an empty split, nothing to learn, an unknown
    sensor, no tokenizer."""
    rows, sensor, notes = _usable(manifest, config)
    weights, note = _weights(manifest, config, rows)
    notes += note
    if weights is not None:
        rows = rows[weights[rows] > 0]
        sensor = np.where(weights > 0, sensor, -1)
    rows, drawn, note = _required(manifest, config, rows)
    notes += note
    finder = _Finder(manifest, config, rows, sensor, weights, drawn, {})
    has_image, has_text = finder.modalities()
    captioned = rows[has_text[rows]]
    if captioned.size:
        tokenizer, note = _choose_tokenizer(tokenizer, manifest, captioned, config)
        notes += note
    if config.stage == 2 and config.model.text:
        notes += _say_withheld(manifest, config, rows)
    length = config.model.frames + (config.stage == 1 or config.objective.reconstruct)
    pools = tuple(
        finder.pool(kind, windows, has_image[windows[:, -1]], has_text[windows[:, -1]], devices)
        for kind in ((STILL, CLIP) if config.data.clip_share else (STILL,))
        if len(windows := finder.windows(kind, length))
    )
    if len(pools) == 1 and config.data.clip_share:
        notes.append(f"split {config.data.split!r} has no clip of {length} frames: all batches are stills")
    pairs: tuple[Pairs | None, Pairs | None] = (None, None)
    if config.stage == 2 and config.model.match_head != "none":
        pairs, note = finder.both_pairs(len(pools) > 1)
        notes += note
    if config.stage == 2:
        _something_to_learn(config, pools, pairs)
    force = find_force(manifest, config, rows, pools[CLIP].windows if len(pools) > 1 else None)
    return Pools(pools, pairs, sensor, tokenizer, notes, force)


def _something_to_learn(config: Config, pools: tuple[Pool, ...], pairs: tuple[Pairs | None, ...]) -> None:
    """Raise UserError where stage 2 would have a loss of 0 at every step."""
    shown = any(len(ids) for pool in pools for ids in pool.members[:_BARE])
    if not shown and not any(pairs) and not config.objective.reconstruct:
        raise UserError(
            f"stage 2 has nothing to learn from split {config.data.split!r}: no photograph (image_path), no caption "
            "(text) that this run has a tower for, and no touch felt twice (touch) that this run matches; add one, or "
            "train stage 1"
        )


def _usable(manifest: Manifest, config: Config) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Rows of the split that have images of a known sensor, the sensor-table row of every row, notes."""
    split, unknown = config.data.split, config.data.on_bad_sample
    rows = manifest.rows_of(split)
    sensor, notes = sensor_rows(manifest, config.model, rows, unknown=unknown)
    rows = rows[sensor[rows] >= 0]
    files = ", ".join(map(str, manifest.files))
    if not rows.size:
        raise ManifestError(f"{files}: split {split!r} has no row of a known sensor with images")
    if config.data.background == "subtract":
        bare = rows[~manifest.present("background_path")[rows]]
        if len(bare) == len(rows) or (len(bare) and unknown == "error"):
            raise ManifestError(
                f"{manifest.where(int(bare[0]))} and {len(bare) - 1} other rows have no background_path, which "
                "--loader.background subtract takes off; --on-bad-sample skip leaves such rows out"
            )
        if len(bare):
            notes.append(f"left out {len(bare)} rows without background_path, which data.background subtract takes off")
            sensor = sensor.copy()
            sensor[bare] = -1
            rows = rows[sensor[rows] >= 0]
    return rows, sensor, notes


def _required(manifest: Manifest, config: Config, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """`rows` that have what `data.require` and `contact_only` ask; which rows of the manifest (None: any); notes."""
    wanted = [*config.data.require, *(["contact"] if config.data.contact_only else [])]
    if not wanted:
        return rows, None, []
    text = manifest.present("text") & ~withheld_text(manifest, aligned_text=config.data.aligned_text)
    has = {"image": manifest.present("image_path"), "text": text}
    if config.data.contact_only:
        if "label.contact" not in manifest.table.column_names:
            raise UserError("--loader.contact-only reads the column 'label.contact', which `anytouch contact` writes")
        has["contact"] = known_contact(manifest) != 0  # or nothing is known
    drawn = np.logical_and.reduce([has[name] for name in wanted])
    kept, what = rows[drawn[rows]], " and ".join(wanted)
    named = "data.contact_only" if wanted == ["contact"] else "data.require"
    if not kept.size:
        raise UserError(f"{named}: no row of split {config.data.split!r} has {what}")
    return kept, drawn, [f"{len(kept)} of {len(rows)} rows have {what}; only they are drawn ({named})"]


def _weights(manifest: Manifest, config: Config, rows: np.ndarray) -> tuple[np.ndarray | None, list[str]]:
    """How often an epoch draws each row of the manifest, f64 (rows,), None where all are drawn once; and notes."""
    column = manifest.column("dataset")
    there = pc.unique(column.take(rows)).drop_null().to_pylist()
    wanted = config.data.weights
    if wanted is None:
        own = config.recipe == "release" and config.stage == 2  # its stage 1 draws every row once
        wanted = tuple(pair for pair in RELEASE_WEIGHTS if pair[0] in there) if own else ()
    for name, weight in wanted:
        if name not in there:
            known = ", ".join(sorted(there)) or "none: its column 'dataset' is empty"
            raise UserError(f"--loader.weights names the dataset {name!r}, but split {config.data.split!r} has {known}")
        if not 0 <= weight < 1e6:
            raise UserError(f"--loader.weights of {name!r} is how often it is drawn in an epoch, not {weight}")
    if len(set(dict(wanted))) < len(wanted):
        raise UserError("--loader.weights names a dataset twice")
    if not wanted:
        return None, []
    weights = np.ones(len(manifest))
    for name, weight in wanted:
        weights[np.asarray(pc.fill_null(pc.equal(column, name), False))] = weight
    if not weights[rows].any():
        raise UserError(f"--loader.weights leaves out every row of split {config.data.split!r}")
    said = ", ".join(f"{name} {weight:g} times" if weight else f"{name} not at all" for name, weight in wanted)
    return weights, [f"an epoch draws {said}, other datasets once"]


def withheld_text(manifest: Manifest, *, aligned_text: bool = True) -> np.ndarray:
    """Rows in a test split of a downstream task (column `downstream_test`): their text is not trained on, bool (rows,).

    So a text that tells the label is never seen with a frame that a probe is tested on (paper, appendix). Without
    `aligned_text` also the rows whose touch several sensors or units felt (Table 6, "w/o Text in TacQuad").
    """
    tested = _downstream(manifest)
    return tested if aligned_text else tested | _aligned(manifest)


def _aligned(manifest: Manifest) -> np.ndarray:
    return is_shared_touch(*(manifest.codes(name, own=name == "touch") for name in ("touch", "sensor", "unit")))


def _say_withheld(manifest: Manifest, config: Config, rows: np.ndarray) -> list[str]:
    text, tested = manifest.present("text")[rows], _downstream(manifest)[rows]
    notes = []
    if (text & tested).any():
        count = int((text & tested).sum())
        notes.append(f"the text of {count} rows is withheld: they are in a test split of a downstream task")
    if not config.data.aligned_text:
        count = int((text & _aligned(manifest)[rows]).sum())
        notes.append(
            f"the text of {count} of {int(text.sum())} rows is withheld: other sensors or units felt the same touch "
            "(data.aligned_text)"
        )
    return notes


def _downstream(manifest: Manifest) -> np.ndarray:
    if _WITHHELD not in manifest.table.column_names:
        return np.zeros(len(manifest), bool)
    word = pc.utf8_lower(manifest.table[_WITHHELD].cast(pa.string()))
    return ~np.asarray(pc.is_in(pc.fill_null(word, ""), value_set=pa.array(_NOT_SET)))


def training_captions(manifest: Manifest, rows: np.ndarray, *, aligned_text: bool = True) -> list[str]:
    """The different captions of `rows` that may be trained on (see `withheld_text`), in order."""
    kept = rows[~withheld_text(manifest, aligned_text=aligned_text)[rows]]
    return sorted(pc.unique(manifest.column("text").take(kept)).drop_null().to_pylist())


def _choose_tokenizer(
    given: texts.Tokenizer | None, manifest: Manifest, rows: np.ndarray, config: Config
) -> tuple[texts.Tokenizer, list[str]]:
    tower, notes = config.model.text, []
    assert tower is not None
    if given is None and config.data.tokenizer is not None:
        given = texts.load_tokenizer(config.data.tokenizer)
    if given is None:
        given = texts.train_tokenizer(training_captions(manifest, rows), tower.vocab)
        notes.append(f"no tokenizer is given: one of {given.vocab_size} tokens was trained on the captions")
    if given.vocab_size > tower.vocab:
        raise UserError(
            f"the tokenizer has {given.vocab_size} tokens but the text tower only {tower.vocab}: "
            f"set --model.text.vocab {given.vocab_size} or give another tokenizer"
        )
    return given, notes


class _Finder(NamedTuple):
    manifest: Manifest
    config: Config
    rows: np.ndarray
    sensor: np.ndarray
    weights: np.ndarray | None
    drawn: np.ndarray | None  # rows of the manifest that may end a window, None: any
    found: dict[int, np.ndarray]  # clips by their length

    def modalities(self) -> tuple[np.ndarray, np.ndarray]:
        """Which rows of the manifest have a picture and a caption that the model has a tower for."""
        model, none = self.config.model, np.zeros(len(self.manifest), bool)
        if self.config.stage == 1:
            return none, none
        image = self.manifest.present("image_path") if model.image else none
        if not model.text:
            return image, none
        kept = ~withheld_text(self.manifest, aligned_text=self.config.data.aligned_text)
        return image, self.manifest.present("text") & kept

    def windows(self, kind: int, length: int) -> np.ndarray:
        if kind == STILL:
            return self.rows[:, None]
        if length not in self.found:
            clips = self.manifest.clips(length, self.config.data.split)
            good = np.ones(len(clips), bool)
            for frame in clips.T:
                good &= self.sensor[frame] >= 0
            if self.drawn is not None:
                good &= self.drawn[clips[:, -1]]
            self.found[length] = clips if good.all() else clips[good]
        return self.found[length]

    def pool(self, kind: int, windows: np.ndarray, image: np.ndarray, text: np.ndarray, devices: int) -> Pool:
        seed = self.config.run.seed
        members = tuple(np.flatnonzero(here) for here in (image & ~text, image & text, ~image & text, ~image & ~text))
        streams = tuple(
            EpochSampler(len(ids), seed, _ALIGN + 4 * kind + s, self._weights_of(windows[ids]))
            for s, ids in enumerate(members)
        )
        strata = StratumQuota([stream.size for stream in streams], self.config.data.batch_size, devices)
        return Pool(windows, strata, members, streams)

    def _weights_of(self, windows: np.ndarray) -> np.ndarray | None:
        return None if self.weights is None else self.weights[windows[:, -1]]

    def both_pairs(self, has_clips: bool) -> tuple[tuple[Pairs | None, Pairs | None], list[str]]:
        def codes(name: str, own: bool = False) -> np.ndarray:
            found = self.manifest.codes(name, own=own)
            return found.astype(np.int32) if found.max(initial=0) < 1 << 31 else found

        notes = []
        keys = MatchKeys(codes("touch", own=True), self.sensor, codes("unit"), codes("object"), codes("dataset"))
        stills, clips = self._pairs(STILL, keys), self._pairs(CLIP, keys) if self.config.data.clip_share else None
        if stills is None:
            notes.append(
                "no touch was felt by two sensors or units (column 'touch'): there is no cross-sensor matching"
                if self.config.data.negatives == "any"
                else "no touch was felt by two sensors, one of which felt another place: there is no cross-sensor "
                "matching with data.negatives=same_sensor"
            )
        elif stills.matches.one_object:
            notes.append("all touches are of one object: negatives of matching are other places of it")
        if stills and has_clips and clips is None:
            notes.append("no two clips share a touch: matching uses stills only")
        return (stills, clips), notes

    def _pairs(self, kind: int, keys: MatchKeys) -> Pairs | None:
        windows = self.windows(kind, self.config.model.frames)
        wanted = {"same_sensor": self.config.data.negatives == "same_sensor"}
        matches = Matches(windows[:, -1], keys, **wanted, other_object=self.config.recipe == "release")
        if not matches.anchors.size:
            return None
        weights, seed = self._weights_of(windows[matches.anchors]), self.config.run.seed
        return Pairs(windows, matches, EpochSampler(len(matches.anchors), seed, _ANCHOR + kind, weights))
