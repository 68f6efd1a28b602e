"""What a run can draw from: stills, clips and touches felt twice, cut into strata, each with its stream of epochs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from anytouch_jax.config import Config, UserError
from anytouch_jax.data import text as texts
from anytouch_jax.data.manifest import Manifest, ManifestError, sensor_rows
from anytouch_jax.data.matching import Keys, Matches
from anytouch_jax.data.sampling import Strata, Stream

STILL, CLIP = 0, 1
_ALIGN, _ANCHOR = 100, 200  # tags that keep the random streams of one seed apart


class Pool(NamedTuple):
    """Windows of rows i64 (M, T) to draw from; `members[s]` the ids of stratum s in `windows`, `streams[s]` over it."""

    windows: np.ndarray
    strata: Strata
    members: tuple[np.ndarray, ...]
    streams: tuple[Stream, ...]


class Pairs(NamedTuple):
    """Matching: windows of rows i64 (M, T), the matches between them, and the stream over their anchors."""

    windows: np.ndarray
    matches: Matches
    anchors: Stream


class Sources(NamedTuple):
    """All there is to draw from, by kind: `pools` (stills, and clips if any), `pairs` (None where there are none).

    `sensor` i32 (rows of the manifest,) sensor-table rows; `tokenizer` the one in use; `notes` to tell the user.
    """

    pools: tuple[Pool, ...]
    pairs: tuple[Pairs | None, Pairs | None]
    sensor: np.ndarray
    tokenizer: texts.Tokenizer | None
    notes: list[str]


def find_sources(manifest: Manifest, config: Config, tokenizer: texts.Tokenizer | None, devices: int) -> Sources:
    """Look through the split `config.data.split`. Raises UserError: an empty split, an unknown sensor, no tokenizer."""
    rows, sensor, notes = _usable(manifest, config)
    finder = _Finder(manifest, config, rows, sensor)
    has_image, has_text = finder.modalities()
    captioned = rows[has_text[rows]]
    if captioned.size:
        captions = [str(manifest.value(row, "text")) for row in captioned]
        tokenizer, note = _choose_tokenizer(tokenizer, captions, config)
        notes += note
    length = config.model.frames + (config.stage == 1 or config.objective.reconstruct)
    pools = tuple(
        finder.pool(kind, windows, has_image[windows[:, -1]], has_text[windows[:, -1]], devices)
        for kind in (STILL, CLIP)
        if len(windows := finder.windows(kind, length))
    )
    if len(pools) == 1:
        notes.append(f"split {config.data.split!r} has no clip of {length} frames: all batches are stills")
    pairs: tuple[Pairs | None, Pairs | None] = (None, None)
    if config.stage == 2:
        pairs, note = finder.both_pairs(len(pools) > 1)
        notes += note
    return Sources(pools, pairs, sensor, tokenizer, notes)


def _usable(manifest: Manifest, config: Config) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Rows of the split that have images of a known sensor, the sensor-table row of every row, notes."""
    split, unknown = config.data.split, config.data.on_bad_sample
    rows = manifest.rows_of(split)
    sensor, notes = sensor_rows(manifest, config.model, rows, unknown=unknown)
    rows = rows[sensor[rows] >= 0]
    if not rows.size:
        files = ", ".join(map(str, manifest.files))
        raise ManifestError(f"{files}: split {split!r} has no row of a known sensor with images")
    return rows, sensor, notes


def _choose_tokenizer(
    given: texts.Tokenizer | None, captions: list[str], config: Config
) -> tuple[texts.Tokenizer, list[str]]:
    tower, notes = config.model.text, []
    assert tower is not None
    if given is None and config.data.tokenizer is not None:
        given = texts.load(config.data.tokenizer)
    if given is None:
        given = texts.train(captions, tower.vocab)
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

    def modalities(self) -> tuple[np.ndarray, np.ndarray]:
        """Which rows of the manifest have a picture and a caption that the model has a tower for."""
        model, none = self.config.model, np.zeros(len(self.manifest), bool)
        if self.config.stage == 1:
            return none, none
        image = self.manifest.present("image_path") if model.image else none
        text = self.manifest.present("text") if model.text else none
        return image, text

    def windows(self, kind: int, length: int) -> np.ndarray:
        if kind == STILL:
            return self.rows[:, None]
        clips = self.manifest.clips(length, self.config.data.split)
        return clips[(self.sensor[clips] >= 0).all(axis=1)]

    def pool(self, kind: int, windows: np.ndarray, image: np.ndarray, text: np.ndarray, devices: int) -> Pool:
        seed = self.config.run.seed
        members = tuple(np.flatnonzero(here) for here in (image & ~text, image & text, ~image & text, ~image & ~text))
        streams = tuple(Stream(len(ids), seed, _ALIGN + 4 * kind + s) for s, ids in enumerate(members))
        strata = Strata([len(ids) for ids in members], self.config.data.batch_size, devices)
        return Pool(windows, strata, members, streams)

    def both_pairs(self, has_clips: bool) -> tuple[tuple[Pairs | None, Pairs | None], list[str]]:
        codes, notes = self.manifest.codes, []
        keys = Keys(codes("touch", own=True), self.sensor, codes("unit"), codes("object"), codes("dataset"))
        stills, clips = self._pairs(STILL, keys), self._pairs(CLIP, keys)
        if stills is None:
            notes.append(
                "no touch was felt by two sensors or units (column 'touch'): there is no cross-sensor matching"
            )
        elif stills.matches.one_object:
            notes.append("all touches are of one object: negatives of matching are other places of it")
        if stills and has_clips and clips is None:
            notes.append("no two clips share a touch: matching uses stills only")
        return (stills, clips), notes

    def _pairs(self, kind: int, keys: Keys) -> Pairs | None:
        windows = self.windows(kind, self.config.model.frames)
        matches = Matches(windows[:, -1], keys)
        if not matches.anchors.size:
            return None
        return Pairs(windows, matches, Stream(len(matches.anchors), self.config.run.seed, _ANCHOR + kind))
