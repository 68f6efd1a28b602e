"""Pictures that decode but cannot be right: of one colour, cut, noise, repeated, turned, or unlike their recording.

Cameras, disks and scripts leave them behind. A picture is judged alone, or by the other frames of its sequence.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from anytouch_jax.data.manifest.manifest import Manifest, group_rows
from anytouch_jax.data.prepare.scan import BORDER, BOTTOM, CHROMA, FIELDS, NOISE, SPREAD, Finding, Scan, finding

_FEWEST = 5  # frames of a sequence that show what is usual in it
_FROZEN = 3  # equal pictures in a row: cameras have noise
_LAGS = (2, 3, 4)  # pictures of so many sensors may take turns in a sequence
_ALONE = (
    ("flat", "of one colour"),
    ("cut", "of one colour from some row to the bottom, as a file is that was cut"),
    ("border", "with a black border"),
    ("noise", "of noise only"),
)
_IN_SEQUENCE = (
    ("frozen", f"equal to the frames before ({_FROZEN} or more in a row)"),
    ("alternating", "in sequences that jump between the pictures of several sensors"),
    ("grey", "grey where their sequence is coloured"),
    ("dark", "much darker than their sequence"),
    ("inverted", "with inverted brightness for their sequence"),
    ("channels", "with red and blue exchanged for their sequence"),
    ("turned", "rotated or mirrored for their sequence"),
)


def picture_faults(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield the kinds of pictures that cannot be right."""
    looks = scanned.looks
    flat = looks[:, SPREAD] < 1
    alone = {
        "flat": flat, "cut": ~flat & (looks[:, BOTTOM] > 0.1), "border": ~flat & (looks[:, BORDER] > 0.03),
        "noise": ~flat & (looks[:, NOISE] > 0.6),
    }  # fmt: skip
    for column, code in scanned.files.code.items():
        for kind, words in _ALONE:
            rows = np.flatnonzero((code >= 0) & (scanned.decoded & alone[kind])[code])
            yield from finding(manifest, kind, "warning", rows, f"rows whose {column} is {words}", column)
    files, frame = scanned.files.code["path"], np.asarray(manifest.table["frame_index"])
    faults: dict[str, list[np.ndarray]] = {kind: [] for kind, _ in _IN_SEQUENCE}
    rows = np.flatnonzero((scanned.decoded & ~np.any([*alone.values()], axis=0))[files])
    for members in group_rows(rows, manifest.codes("sequence", own=True)[rows], frame[rows]):
        for kind, wrong in _faults_of_sequence(scanned, files[members]).items():
            faults[kind].append(members[wrong])
    for kind, words in _IN_SEQUENCE:
        rows = np.sort(np.concatenate([np.empty(0, np.int64), *faults[kind]]))
        yield from finding(manifest, kind, "warning", rows, f"touch images {words}", "path")


def _faults_of_sequence(scanned: Scan, files: np.ndarray) -> dict[str, np.ndarray]:
    """Return which frames of a sequence have each fault, bool (frames,); `files` are in the order of the frames."""
    pixels = scanned.pixels[files]
    runs = np.split(np.arange(len(files)), np.flatnonzero(np.diff(pixels.astype(np.int64))) + 1)
    frozen = np.zeros(len(files), bool)
    for run in (run for run in runs if len(run) >= _FROZEN):
        frozen[run[1:]] = True
    faults = {"frozen": frozen}
    if len(files) < _FEWEST:
        return faults
    colours = scanned.colours[files].astype(np.float32)
    faults["alternating"] = np.full(len(files), _alternates(colours))
    if faults["alternating"].any():
        return faults
    usual, chroma = np.median(colours, axis=0), scanned.looks[files, CHROMA]
    faults["grey"] = (chroma < 1.5) & (np.median(chroma) > 6)
    faults["dark"] = (colours.mean(axis=1) < usual.mean() / 4) & (usual.mean() > 20)
    away = np.abs(colours - usual).mean(axis=1)
    spread = float(np.median(away))
    for at in np.flatnonzero((away > max(6.0, 3 * spread)) & ~faults["grey"] & ~faults["dark"]):
        kind, near = min(
            ((kind, float(np.abs(other - usual).mean())) for kind, other in _variants(colours[at])), key=lambda p: p[1]
        )
        if near < min(away[at] / 3, max(3.0, 2 * spread)):
            faults.setdefault(kind, np.zeros(len(files), bool))[at] = True
    return faults


def _alternates(colours: np.ndarray) -> bool:
    """Return whether neighbours differ much more than frames further apart, for colours f32 (frames, 48)."""
    if len(colours) < 2 * _FEWEST - 2:
        return False
    step = np.median(np.abs(np.diff(colours, axis=0)).mean(axis=1))
    return step > 2 and any(
        len(colours) >= 3 * lag and 4 * np.median(np.abs(colours[lag:] - colours[:-lag]).mean(axis=1)) < step
        for lag in _LAGS
    )


def _variants(colours: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the colours f32 (48,) of a picture as they were before each fault, with its kind."""
    fields = colours.reshape(FIELDS, FIELDS, 3)
    yield "inverted", 255 - colours
    yield "channels", fields[..., ::-1].ravel()
    for turns, mirror in itertools.product(range(4), (False, True)):
        if turns or mirror:
            yield "turned", np.rot90(fields[:, ::-1] if mirror else fields, turns).ravel()
