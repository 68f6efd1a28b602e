"""File scan: existence, decoding, size, hash and colours of every file of a manifest; wrong
images.

Some copies of a dataset (TVL among them) hold touch images where the RGB images should be. Touch
images of one sensor look alike and RGB images do not, so colours raise a suspicion. A background
image of the sensor confirms it: images that resemble it are touch images.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
import pyarrow.compute as pc

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.images import ImageError, decode_bytes, to_rgb
from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest.files import read_file, split_shard_path
from anytouch_jax.data.manifest.manifest import Files, Manifest, distinct_files, group_rows
from anytouch_jax.data.manifest.schema import EXAMPLES, shown
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

STATES = ("ok", "missing", "outside", "empty", "truncated", "unreadable")
OK = STATES.index("ok")
FIELDS = 4  # colours are the means of 4 x 4 fields
SPREAD, BOTTOM, BORDER, CHROMA, NOISE = range(5)  # columns of Scan.looks
_CROP = 128  # side of the middle of an image where noise is measured
_MAX_REASONS = 1000  # a million broken files must not fill the memory


class Scan(NamedTuple):
    """The state of every distinct file i of n.

    `state` u8 (n,) indexes STATES. `size` i32 (n, 2) is width and height, 0 if not decoded.
    `digest` S32 (n,) is the first half of the SHA-256 in hex. `colours` is u8 (n, 48). `looks` f32
    (n, 5) are the measures of `_looks`, and `pixels` u32 (n,) is a checksum of the pixels. `bits`
    u8 (n,) are those that an image of 16 bits uses, else 0. `reasons` explains the first thousand
    bad files.
    """

    files: Files
    state: np.ndarray
    size: np.ndarray
    digest: np.ndarray
    colours: np.ndarray
    looks: np.ndarray
    pixels: np.ndarray
    bits: np.ndarray
    reasons: dict[int, str]

    def states(self, column: str) -> np.ndarray:
        """Return the state of the file in every cell of a column, u8 (rows,). A null cell is OK."""
        code = self.files.code[column]
        return np.where(code < 0, OK, self.state[code])

    @property
    def decoded(self) -> np.ndarray:
        """Whether each file is a whole image that was decoded, bool (n,)."""
        return (self.state == OK) & (self.size[:, 0] > 0)


Level = Literal["error", "warning", "info"]


class Finding(NamedTuple):
    """One kind of fault: the row ids i64 that it concerns, sentences about the first few, and the
    first files.
    """

    kind: str
    level: Level
    sentence: str
    rows: np.ndarray
    examples: tuple[str, ...] = ()
    column: str | None = None
    files: tuple[str, ...] = ()


def finding(
    manifest: Manifest,
    kind: str,
    level: Level,
    rows: np.ndarray,
    words: str,
    *columns: str,
    column: str | None = None,
) -> Iterator[Finding]:
    """Yield a finding of `rows` if there are any: their number and `words`, with their values in
    `columns`.

    Args:
        manifest: the frames.
        kind: a short name of the finding.
        level: how bad it is.
        rows: i64 (n,) that it is about.
        words: what is said after their number.
        columns: whose values the examples show.
        column: that the finding is about, by default the first of `columns`.
    """
    if rows.size:
        examples = (
            f"{manifest.where(row)}: "
            f"{', '.join(shown(manifest.value(row, name)) for name in columns)}"
            for row in rows[:EXAMPLES]
        )
        yield Finding(
            kind, level, f"{rows.size} {words}", rows, tuple(examples), column or columns[0]
        )


class _FileState(NamedTuple):
    state: str
    size: tuple[int, int] = (0, 0)
    digest: bytes = b""
    colours: np.ndarray | None = None
    looks: np.ndarray | None = None
    pixels: int = 0
    bits: int = 0
    reason: str = ""


def scan(manifest: Manifest, *, decode: bool = True, threads: int = 4) -> Scan:
    """Read every distinct file, in some 100 bytes of memory each.

    Without `decode`, it must exist and not be empty.
    """
    files = distinct_files(manifest)
    count = len(files)
    result = Scan(
        files,
        np.zeros(count, np.uint8),
        np.zeros((count, 2), np.int32),
        np.zeros(count, "S32"),
        np.zeros((count, 3 * FIELDS * FIELDS), np.uint8),
        np.zeros((count, 5), np.float32),
        np.zeros(count, np.uint32),
        np.zeros(count, np.uint8),
        {},
    )

    def inspect(file: int) -> _FileState:
        row = int(files.row[file])
        column = str(files.column[file])
        is_field = column == "field_path" or (
            column == "path" and manifest.value(row, "sensor") in FIELD_SENSORS
        )
        try:
            path = manifest.file(row, column)
        except UserError as error:
            return _FileState("outside", reason=str(error))
        try:
            if not decode and not split_shard_path(path):
                return _FileState("ok" if os.stat(path).st_size else "empty")
            data = read_file(path)
        except FileNotFoundError:
            return _FileState("missing")
        except (OSError, ValueError, MemoryError) as error:
            return _FileState("unreadable", reason=str(getattr(error, "strerror", None) or error))
        if data:
            return _judge(data, path, decode and not is_field)
        return _FileState("empty")

    with closing(bounded_map(inspect, range(count), threads, 8 * max(threads, 1))) as states:
        for file, state in enumerate(tracked(states, "files checked", count)):
            result.state[file] = STATES.index(state.state)
            result.size[file], result.digest[file] = state.size, state.digest
            if state.colours is not None:
                result.colours[file], result.looks[file] = state.colours, state.looks
                result.pixels[file], result.bits[file] = state.pixels, state.bits
            if state.reason and len(result.reasons) < _MAX_REASONS:
                result.reasons[file] = state.reason
    return result


def _judge(data: bytes, path: Path, is_image: bool) -> _FileState:
    digest = hashlib.sha256(data).hexdigest()[:32].encode()
    if not is_image:
        return _FileState("ok", digest=digest)
    try:
        stored = decode_bytes(data, path, as_stored=True)
        pixels = to_rgb(stored, path)
    except ImageError as error:
        reason = str(error).removeprefix(f"{path} ").removeprefix("cannot be read: ")
        return _FileState(
            "truncated" if "cut short" in reason else "unreadable", digest=digest, reason=reason
        )
    height, width = pixels.shape[:2]
    # alpha is full
    colour = stored[..., :3] if stored.ndim == 3 else stored
    bits = (
        int(colour.max()).bit_length() if stored.dtype.kind == "u" and stored.itemsize == 2 else 0
    )
    colours = cv2.resize(pixels, (FIELDS, FIELDS), interpolation=cv2.INTER_AREA).reshape(-1)
    return _FileState(
        "ok", (width, height), digest, colours, _looks(pixels), zlib.crc32(pixels.data), bits
    )


def _looks(pixels: np.ndarray) -> np.ndarray:
    """Return measures of RGB u8 (h, w, 3) as f32 (5,).

    In order: the standard deviation, and the fraction of rows at the bottom of one colour other
    than black. The fraction of the largest black border. The mean range of a pixel's channels. The
    fraction of the variance that is noise from pixel to pixel.
    """
    # OpenCV needs a tenth of NumPy's time for these.
    rows, columns = (cv2.reduce(pixels, dim, cv2.REDUCE_MAX).reshape(-1, 3) for dim in (1, 0))
    dark = [most.max(axis=1) <= 16 for most in (rows, columns)]
    black = [_leading(side) for one in dark for side in (one, one[::-1])]
    least = cv2.reduce(pixels, 1, cv2.REDUCE_MIN).reshape(-1, 3)
    # A cut JPEG is filled with exactly one grey.
    same = ((rows == pixels[-1, 0]) & (least == pixels[-1, 0])).all(axis=1)
    bottom = 0.0 if black[1] else _leading(same[::-1])
    height, width = pixels.shape[:2]
    top = max(0, (height - _CROP) // 2)
    left = max(0, (width - _CROP) // 2)
    grey = cv2.cvtColor(pixels[top : top + _CROP, left : left + _CROP], cv2.COLOR_RGB2GRAY).astype(
        np.float32
    )
    variance = float(grey.var())
    noise = 0.0
    if variance > 100 and min(grey.shape) > 1:
        noise = min(
            float((np.diff(grey, axis=axis) ** 2).mean()) / (2 * variance) for axis in (0, 1)
        )
    spread = float(cv2.meanStdDev(pixels)[1].max())
    red, green, blue = cv2.split(pixels)
    ranges = cv2.subtract(cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue))
    chroma = float(cv2.mean(ranges)[0])
    return np.array([spread, bottom, max(black), chroma, noise], np.float32)


def _leading(flags: np.ndarray) -> float:
    """Return the fraction of flags bool (n,) before the first that is false, 0 if none is false."""
    return float(np.argmin(flags)) / len(flags)


# Images that decode but cannot be right: of one colour, cut, noise, repeated, turned, or unlike
# their recording. Cameras, disks and scripts leave them behind. An image is judged alone, or by
# the other frames of its sequence.
_FEWEST = 5  # frames of a sequence that show what is usual in it
_NARROW = 14  # bits of 16: more may be all that a dark image uses
_FROZEN = 3  # equal images in a row: cameras have noise
_LAGS = (2, 3, 4)  # images of so many sensors may take turns in a sequence
_ALONE = (
    ("flat", "of one colour"),
    ("cut", "of one colour from some row to the bottom, as a file is that was cut"),
    ("border", "with a black border"),
    ("noise", "of noise only"),
)
_IN_SEQUENCE = (
    ("frozen", f"equal to the frames before ({_FROZEN} or more in a row)"),
    ("alternating", "in sequences that jump between the images of several sensors"),
    ("grey", "grey where their sequence is coloured"),
    ("dark", "much darker than their sequence"),
    ("inverted", "with inverted brightness for their sequence"),
    ("channels", "with red and blue exchanged for their sequence"),
    ("turned", "rotated or mirrored for their sequence"),
)


def image_faults(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield the kinds of images that cannot be right."""
    looks = scanned.looks
    narrow = np.zeros(len(scanned.bits), bool)
    source = np.stack([manifest.codes("dataset"), manifest.codes("sensor")], 1)
    for column, code in scanned.files.code.items():
        rows = np.flatnonzero((code >= 0) & (scanned.bits[code] > 0))
        for group in group_rows(rows, source[rows]):
            files = code[group]
            if (bits := int(scanned.bits[files].max())) <= _NARROW:
                narrow[files] = True
                scaled = f"cv2.imread(file, cv2.IMREAD_UNCHANGED) * {2 ** (16 - bits)}"
                words = (
                    f"rows whose {column} has values that use {bits} of 16 bits, and looks black. "
                    "Scale it: "
                )
                words += f"cv2.imwrite(file, {scaled})"
                yield from finding(manifest, "bits", "warning", group, words, column)
    flat = (looks[:, SPREAD] < 1) & ~narrow
    alone = {
        "flat": flat,
        "cut": looks[:, BOTTOM] > 0.1,
        "border": looks[:, BORDER] > 0.03,
        "noise": looks[:, NOISE] > 0.6,
    }
    alone = {kind: wrong & ~narrow & (~flat | (kind == "flat")) for kind, wrong in alone.items()}
    for column, code in scanned.files.code.items():
        for kind, words in _ALONE:
            rows = np.flatnonzero((code >= 0) & (scanned.decoded & alone[kind])[code])
            yield from finding(
                manifest, kind, "warning", rows, f"rows whose {column} is {words}", column
            )
    files = scanned.files.code["path"]
    frame = np.asarray(manifest.table["frame_index"])
    faults: dict[str, list[np.ndarray]] = {kind: [] for kind, _ in _IN_SEQUENCE}
    rows = np.flatnonzero((scanned.decoded & ~np.any([*alone.values()], axis=0))[files])
    for members in group_rows(rows, manifest.codes("sequence", own=True)[rows], frame[rows]):
        for kind, wrong in _faults_of_sequence(scanned, files[members]).items():
            faults[kind].append(members[wrong])
    for kind, words in _IN_SEQUENCE:
        rows = np.sort(np.concatenate([np.empty(0, np.int64), *faults[kind]]))
        yield from finding(manifest, kind, "warning", rows, f"touch images {words}", "path")


def _faults_of_sequence(scanned: Scan, files: np.ndarray) -> dict[str, np.ndarray]:
    """Return which frames of a sequence have each fault, bool (frames,); `files` are in the order
    of the frames.
    """
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
    usual = np.median(colours, axis=0)
    chroma = scanned.looks[files, CHROMA]
    faults["grey"] = (chroma < 1.5) & (np.median(chroma) > 6)
    faults["dark"] = (colours.mean(axis=1) < usual.mean() / 4) & (usual.mean() > 20)
    away = np.abs(colours - usual).mean(axis=1)
    spread = float(np.median(away))
    for at in np.flatnonzero((away > max(6.0, 3 * spread)) & ~faults["grey"] & ~faults["dark"]):
        kind, near = min(
            ((kind, float(np.abs(other - usual).mean())) for kind, other in _variants(colours[at])),
            key=lambda p: p[1],
        )
        if near < min(away[at] / 3, max(3.0, 2 * spread)):
            faults.setdefault(kind, np.zeros(len(files), bool))[at] = True
    return faults


def _alternates(colours: np.ndarray) -> bool:
    """Return whether neighbours differ much more than frames further apart, for colours f32
    (frames, 48).
    """
    if len(colours) < 2 * _FEWEST - 2:
        return False
    step = np.median(np.abs(np.diff(colours, axis=0)).mean(axis=1))
    return step > 2 and any(
        len(colours) >= 3 * lag
        and 4 * np.median(np.abs(colours[lag:] - colours[:-lag]).mean(axis=1)) < step
        for lag in _LAGS
    )


def _variants(colours: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the colours f32 (48,) of an image as they were before each fault, with its kind."""
    fields = colours.reshape(FIELDS, FIELDS, 3)
    yield "inverted", 255 - colours
    yield "channels", fields[..., ::-1].ravel()
    for turns, mirror in itertools.product(range(4), (False, True)):
        if turns or mirror:
            yield "turned", np.rot90(fields[:, ::-1] if mirror else fields, turns).ravel()


# Folders of touch images and RGB images that are swapped.
_MIN_PAIRS = 8  # different pairs of images that are needed for an opinion on swapped folders
_WIDER = 1.5  # touch images may spread this much more than RGB images before they are suspect
# fraction of the rows that must resemble the background images to call a dataset swapped
_CERTAIN = 0.95


class SwapVerdict(NamedTuple):
    """A dataset with its rows that have both images, those that look swapped, whether all do, and
    whether a background image confirms it.
    """

    dataset: str | None
    rows: np.ndarray
    swapped: np.ndarray
    whole: bool
    confirmed: bool


def swap_verdicts(manifest: Manifest, scanned: Scan) -> list[SwapVerdict]:
    """Return a verdict for every dataset and sensor with rows that look swapped."""
    code = scanned.files.code
    if "image_path" not in code or not scanned.colours.any():
        return []
    touch = code["path"]
    vision = code["image_path"]
    background = np.asarray(pc.equal(manifest.table["split"], "background"))
    usable = np.flatnonzero(
        (vision >= 0) & scanned.decoded[touch] & scanned.decoded[vision] & ~background
    )
    source = np.stack([manifest.codes("dataset"), manifest.codes("sensor")], 1)
    result = []
    for rows in group_rows(usable, source[usable]):
        if len(np.unique(np.stack([touch[rows], vision[rows]], 1), axis=0)) < _MIN_PAIRS:
            continue
        others = np.flatnonzero(background & (vision < 0) & (source == source[rows[0]]).all(axis=1))
        backgrounds = _background_colours(manifest, scanned, others, rows)
        swapped, whole = _judge_swap(scanned.colours, rows, touch[rows], vision[rows], backgrounds)
        if swapped.size:
            dataset = manifest.value(rows[0], "dataset")
            result.append(SwapVerdict(dataset, rows, swapped, whole, bool(len(backgrounds))))
    return result


def in_touch_folder(manifest: Manifest, column: str) -> np.ndarray:
    """Return which rows name a file in `column` that lies in the folder of their touch image, bool
    (rows,).
    """
    folders = [
        pc.replace_substring_regex(manifest.column(name), r"[^/]*$", "")
        for name in (column, "path")
    ]
    return np.asarray(pc.fill_null(pc.equal(*folders), False))


def _background_colours(
    manifest: Manifest, scanned: Scan, others: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Return the colours f32 (k, 48) of the sensor's background images, k = 0 if it has none.

    They are of `others`, background rows without an RGB image, and of `rows`, but for those in the
    folder of the touch images.
    """
    code = scanned.files.code
    files = [code["path"][others]]
    if "background_path" in code:
        files.append(
            code["background_path"][rows[~in_touch_folder(manifest, "background_path")[rows]]]
        )
    # A background that is also an RGB image would confirm anything.
    ids = np.setdiff1d(np.concatenate(files), [-1, *np.unique(code["image_path"])])
    return scanned.colours[ids[scanned.decoded[ids]][:64]].astype(np.float32)


def _judge_swap(
    colours: np.ndarray,
    rows: np.ndarray,
    touch: np.ndarray,
    vision: np.ndarray,
    backgrounds: np.ndarray,
) -> tuple[np.ndarray, bool]:
    """Return the rows that look swapped, and whether the whole dataset does; `touch` and `vision`
    are their files.
    """
    if len(backgrounds):
        bad = _distance(colours[vision], backgrounds) < _distance(colours[touch], backgrounds)
        whole = bool(bad.mean() >= _CERTAIN)
        return rows if whole else rows[bad], whole
    # one RGB image may serve many rows
    each = [colours[np.unique(files)] for files in (touch, vision)]
    centre, other = (np.median(part, axis=0)[None] for part in each)
    spreads = [
        float(np.median(_distance(part, middle))) if len(part) >= _MIN_PAIRS else 0.0
        for part, middle in zip(each, (centre, other), strict=True)
    ]
    if spreads[1] and spreads[0] > _WIDER * spreads[1]:
        return rows, True
    far = _distance(colours[touch], centre)
    near = _distance(colours[vision], centre)
    return rows[(far > 3 * max(spreads[0], 1.0)) & (near < far / 2)], False


def _distance(colours: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference f32 (n,) of colours u8 (n, 48) to the nearest of centres
    (k, 48).
    """
    return np.min(
        [np.abs(colours.astype(np.float32) - centre).mean(axis=1) for centre in centres], axis=0
    )


def swapped_folders(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield data sets and rows whose touch images and RGB images look swapped."""
    for verdict in swap_verdicts(manifest, scanned):
        name = (
            f"dataset {shown(verdict.dataset)}" if verdict.dataset else "the rows without a dataset"
        )
        reason = (
            "the background frames show it"
            if verdict.confirmed
            else "suspected from the colours; look at some"
        )
        what = (
            "all touch images and RGB images are"
            if verdict.whole
            else f"{verdict.swapped.size} rows are"
        )
        kind = "swapped" if verdict.whole else "swapped_rows"
        level: Level = "error" if verdict.confirmed else "warning"
        for fault in finding(
            manifest, kind, level, verdict.swapped, "", "path", "image_path", column="image_path"
        ):
            yield fault._replace(sentence=f"{name}: {what} swapped ({reason})")
