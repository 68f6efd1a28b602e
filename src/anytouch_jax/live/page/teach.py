"""Recordings of live touch, and a classifier that is taught by them.

A recording is a touch with a name: frames in a folder, and rows in its manifest.parquet. The head
is fitted as `anytouch probe label --save` does. Recordings are left out to calibrate it, and to
compare it with raw pixels.
"""

import math
import os
import queue
import re
import shutil
import threading
import time
import unicodedata
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import cv2
import numpy as np
import pyarrow as pa

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.data.images import encode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import EMPTY
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.embed import Features, Pooling, embed_rows, save_npz
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.encoder.linear_head import (
    COVERAGE,
    FALSE_ALARMS,
    LinearHead,
    load_head,
    save_head,
)
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache, heads, probing, splits
from anytouch_jax.evaluate.heads import Scaling
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.live.page.tables import FeatureMap, Table

_QUICK = (cv2.IMWRITE_PNG_COMPRESSION, 1)
_WAITING = 64  # pictures that wait for the disk: more are dropped and counted
_FRAMES = 20  # frames of a recording that are fitted on, evenly spread
# penalties, of measuring a head: all that there are take three times as long
_TRIED = (1.0, 0.1, 0.01)
_BATCH = 4  # frames embedded at once: live touch waits for them
SCORE = "label.contact_score"


class LiveRecorder:
    """Writes frames of recordings into a folder, which is hidden until it is whole, and then its
    manifest.parquet.
    """

    def __init__(self, out: Path, sensor: str | None) -> None:
        self.out = out.expanduser().resolve()
        self.named = out
        self.sensor = sensor or UNIVERSAL
        self.file = self.out / "manifest.parquet"
        # of recorded frames, by their path in the manifest
        self.features: dict[str, Array] = {}
        self._queue: queue.Queue[tuple[Array, float, Array] | None] | None = None
        self._thread: threading.Thread | None = None
        self._written = 0
        self._lost = 0
        self._name = ""
        self._done = ""

    def state(self) -> dict[str, Any]:
        """Return the state for the page."""
        about = {
            "written": self._written,
            "lost": self._lost,
            "name": self._name,
            "done": self._done,
        }
        return about | {"on": self._queue is not None}

    def start(self, name: str, gel: Array | None) -> None:
        """Begin a recording of a touch called `name`. Raises UserError."""
        printed = "".join(one for one in name if one.isprintable() or one.isspace())
        name = unicodedata.normalize("NFC", " ".join(printed.split())[:100].strip())
        if name.lower() in EMPTY:
            raise UserError(
                f"{name} is no name. Type another."
                if name
                else "Type a name for what you touch first."
            )
        if self._queue is not None:
            raise UserError("A recording is on already. Stop it first.")
        self._join()
        stem = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:40] or "touch"
        begun = f"{time.strftime('%Y%m%d_%H%M%S')}_{stem}"
        names = (begun, *(f"{begun}_{number}" for number in range(2, 100)))
        target = next(self.out / each for each in names if not (self.out / each).exists())
        self._written = 0
        self._lost = 0
        self._name = name
        self._done = ""
        waiting: queue.Queue[tuple[Array, float, Array] | None] = queue.Queue()
        # A second Ctrl-C must not end it, so it is no daemon.
        self._thread = threading.Thread(
            target=self._write, args=(waiting, target, gel), daemon=False
        )
        self._thread.start()
        self._queue = waiting

    def add(self, picture: Array, score: float, values: Array) -> None:
        """Store a frame RGB u8 (h, w, 3), its contact score, NaN if unknown, and its features if a
        recording is on.
        """
        waiting = self._queue
        if waiting is not None and waiting.qsize() < _WAITING:
            waiting.put((picture, score, values))
        elif waiting is not None:
            self._lost += 1

    def stop(self) -> None:
        """End the recording, and wait until it is on the disk."""
        waiting = self._queue
        self._queue = None
        if waiting is not None:
            waiting.put(None)
        self._join()

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join()

    def _write(self, waiting: Any, target: Path, gel: Array | None) -> None:
        part = target.with_name(f".{target.name}")
        scores = list[float | None]()
        features = list[Array]()
        try:
            part.mkdir(parents=True)
            if gel is not None:
                (part / "background.png").write_bytes(encode(gel, ".png", *_QUICK))
            while (frame := waiting.get()) is not None:
                picture, score, values = frame
                (part / f"{self._written:06d}.png").write_bytes(encode(picture, ".png", *_QUICK))
                scores.append(None if score != score else round(score, 3))
                features.append(values)
                self._written += 1
            if not self._written:
                self._done = "No frame came, and nothing was written."
                return
            part.rename(target)
            self._add_rows(target.name, scores, gel is not None)
            self.features |= {
                f"{target.name}/{number:06d}.png": values for number, values in enumerate(features)
            }
            self._done = f"{self._written} frames of {self._name} are in {self.named / target.name}"
        except (OSError, UserError) as error:
            self._queue = None
            self._done = f"The recording failed: {error}"
            if self._written and part.exists():
                part.rename(target)
                self._done += f". Its first {self._written} frames are in {target}, without rows in a manifest."
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def _add_rows(self, folder: str, scores: list[float | None], has_background: bool) -> None:
        count = len(scores)
        columns: dict[str, list[Any]] = {
            "path": [f"{folder}/{number:06d}.png" for number in range(count)],
            "sensor": [self.sensor] * count,
            "sequence": [folder] * count,
            "frame_index": list(range(count)),
            "split": ["train"] * count,
            "object": [self._name] * count,
            SCORE: scores,
            "background_path": [f"{folder}/background.png" if has_background else None] * count,
        }
        new = manifests.from_columns(columns, self.file)
        if self.file.exists():
            tables = [manifests.read(self.file).table, new.table]
            new = manifests.from_columns(
                pa.concat_tables(tables, promote_options="permissive").to_pydict(), self.file
            )
        manifests.write(new, self.file)


class Teacher:
    """The recordings of a folder, and the `head` that was fitted on them with its features, for the
    next start too.
    """

    def __init__(
        self,
        encoder: Encoder,
        recorder: LiveRecorder,
        pooling: Pooling = "class",
        log: Callable[[str], None] = print,
    ) -> None:
        self._encoder = encoder
        self._recorder = recorder
        self._pooling = pooling
        self._log = log
        self.head_file = recorder.out / "head.npz"
        self._features = recorder.out / "features.npz"
        self.head: LinearHead | None = None
        self.space: FeatureMap | None = None
        self.table: Table | None = None
        self.version = 0  # rises with every recording and every head
        self._training = threading.Lock()
        self._fault = ""
        self.reload()
        if self.head_file.is_file() and self._features.is_file():
            try:
                self._use(load_head(self.head_file))
            except UserError as error:
                log(f"The head in {recorder.out} is not used. {error}")

    def reload(self) -> None:
        """Read the manifest again, after a recording. Raises UserError."""
        if self._recorder.file.is_file():
            self.table = Table(manifests.read(self._recorder.file), self._recorder.out.name)
        self.version += 1

    def about(self) -> dict[str, Any]:
        """Return the names with their recordings, what is known of the head, and what is missing
        for one.
        """
        names: dict[str, dict[str, Any]] = {}
        if self.table is not None:
            manifest = self.table.manifest
            objects, sequences, split = (
                manifest.text_column(name) for name in ("object", "sequence", "split")
            )
            own = (
                (manifest.text_column("sensor") == self._recorder.sensor)
                & (split == "train")
                & (objects != "")
            )
            for name in np.unique(objects[own]):
                rows = np.flatnonzero(own & (objects == name))
                firm = rows[np.nan_to_num(manifest.number_column(SCORE)[rows]).argmax()]
                several = list(dict.fromkeys(sequences[rows].tolist()))
                names[str(name)] = {
                    "recordings": len(several),
                    "row": int(firm),
                    "last": several[-1],
                }
        missing = "" if len(names) > 1 else "Record two names or more to train."
        result = {} if self.space is None else self.space.index.about
        return {
            "version": self.version,
            "names": names,
            "missing": missing,
            "training": self._training.locked(),
            "fault": self._fault,
            "trained": self.head is not None,
            "file": str(self._recorder.named / self.head_file.name),
            "result": {name: float(result[name]) for name in _RESULT if name in result},
        }

    def train(self) -> None:
        """Fit a head on all recordings, in a thread.

        Raises UserError without two names, and while one is fitted.
        """
        if missing := self.about()["missing"]:
            raise UserError(missing)
        if not self._training.acquire(blocking=False):
            raise UserError("A head is being trained already.")
        threading.Thread(target=self._train, daemon=True).start()

    def leave_out(self, sequence: str) -> None:
        """Mark a recording as unused. Its frames stay. Raises UserError."""
        if self.table is None or sequence not in (
            sequences := self.table.manifest.text_column("sequence")
        ):
            raise UserError("There is no such recording.")
        split = np.where(sequences == sequence, "unused", self.table.manifest.text_column("split"))
        manifests.write(
            manifests.replace_column(self.table.manifest, "split", split.tolist()),
            self._recorder.file,
        )
        self.reload()

    def archive(self) -> IO[bytes]:
        """Return a ZIP of the recordings: the manifest and its pictures, and the head with its
        features.
        """
        out = self._recorder.out
        files = {self._recorder.file, self.head_file, self._features}
        if self.table is not None:
            manifest = self.table.manifest
            for column in ("path", "background_path"):
                files |= {
                    manifest.file(int(row), column)
                    for row in np.flatnonzero(manifest.present(column))
                }
        packed = TemporaryFile()  # noqa: SIM115 - the answer closes it
        with zipfile.ZipFile(packed, "w") as archive:
            for file in sorted(
                file for file in files if file.is_file() and file.is_relative_to(out)
            ):
                archive.write(file, f"{out.name}/{file.relative_to(out)}")
        packed.seek(0)
        return packed

    def _train(self) -> None:
        # live touch comes first
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)
        try:
            self._fault = ""
            self._fit(manifests.read(self._recorder.file))
        except (UserError, OSError, ValueError) as error:
            self._fault = str(error)
        finally:
            self._training.release()
            self.version += 1

    def _fit(self, table: Manifest) -> None:
        """Fit a head and let it name live touch, then measure it."""
        encoder = self._encoder
        sensor = self._recorder.sensor
        rows, _ = probing.label_rows(table, "object", group="sequence", sensor=sensor)
        rows = rows.take(_typical(table, rows, THRESHOLDS.get(sensor, DEFAULT_THRESHOLD)))
        ids = rows.rows[:, 0]
        x = self._embed(table, ids)
        data, cut, _ = splits.check_rows(x, rows.labels, rows.groups, rows.split, tested=False)
        penalty = splits.select_option(
            heads.ProbeHead(), data, cut._replace(val=cut.val[:0]), "honest"
        ).option
        (model,) = data.fit(heads.ProbeHead(options=(penalty,)), cut.fit).models
        about: dict[str, Any] = {"label": "object", "pooling": self._pooling, "frames": 1}
        head = heads.linear_head(model, data.names, **about, fingerprint=encoder.fingerprint)
        # the name of each recording
        recorded = dict(zip(rows.groups.tolist(), rows.labels.tolist(), strict=True))
        names, times = np.unique(list(recorded.values()), return_counts=True)
        # recordings that can be left out
        several = int(times[times > 1].sum())
        gels = UnitGels(table)
        if encoder.subtracts:
            head = replace(head, gels=gels.pictures(ids))
        if several:
            # What so few recordings can promise: a share of 0.9 takes nine. A fold that lacks a
            # name is not counted.
            once = len(recorded) - several
            count = max(1, several - once * math.ceil(len(recorded) / splits.FOLDS))
            shares = {"coverage": min(COVERAGE, math.floor(100 * count / (count + 1)) / 100)}
            shares |= {"false_alarms": max(FALSE_ALARMS, math.ceil(100 / (count + 1)) / 100)}
            head = probing.calibrated(head, x, rows, penalty, self._log, **shares)
        keys = {
            name: table.text_column(name)[ids] for name in ("path", "sensor", "sequence", "object")
        }
        features = Features(
            x, ids, keys | {"frame_index": np.asarray(table.table["frame_index"])[ids]}
        )
        known = {
            "encoder": encoder.source,
            "weights": encoder.fingerprint,
            "input": str(self._recorder.file),
        }
        known |= {"pooling": self._pooling, "frames": "1"}
        save_npz(self._features, features, known)
        save_head(self.head_file, head)
        self._use(head)
        if several:
            pixels = feature_cache.pixel_components(
                feature_cache.pixel_features(table, gels=gels), rows
            )
            result = _measure(x, pixels, rows, np.isin(rows.labels, names[times > 1]))
            result["once"] = once
            save_npz(
                self._features,
                features,
                known | {name: str(value) for name, value in result.items()},
            )
            self._use(head)

    def _embed(self, table: Manifest, ids: Array) -> Array:
        """Return features (n, d) of rows: those that live touch had, and those of frames recorded
        before.
        """
        features = self._recorder.features
        paths = table.text_column("path")[ids].tolist()
        unknown = [place for place, path in enumerate(paths) if path not in features]
        if unknown:
            about: dict[str, Any] = {"pooling": self._pooling, "batch": _BATCH, "log": self._log}
            found, values = embed_rows(self._encoder, table, ids[unknown], **about)
            if len(found) < len(unknown):
                raise UserError(
                    f"{len(unknown) - len(found)} recorded frames have no picture of the untouched "
                    "gel."
                )
            features |= {paths[place]: one for place, one in zip(unknown, values, strict=True)}
        return np.stack([features[path] for path in paths])

    def _use(self, head: LinearHead) -> None:
        """Let live touch be named by a head that lies in the folder.

        Raises UserError for one of another encoder.
        """
        self.reload()
        space = FeatureMap(self._features, [] if self.table is None else [self.table])
        head.check(self._encoder.source, self._encoder.fingerprint, self._pooling, 1)
        space.index.check(self._encoder.source, self._encoder.fingerprint)
        self.head = head
        self.space = space


_RESULT = (
    "once",
    "right",
    "right_low",
    "right_high",
    "pixels",
    "pixels_low",
    "pixels_high",
    "chance",
)


def _measure(x: Array, pixels: Array, rows: TaskRows, tested: Array) -> dict[str, float]:
    """Return the accuracy of features and of raw pixels on recordings that are left out, for
    `tested` (n,) rows.
    """
    result = {
        "chance": float(np.unique(rows.labels[tested], return_counts=True)[1].max() / tested.sum())
    }
    scalings: dict[str, Scaling] = {"right": "column", "pixels": "common"}
    for name, values in (("right", x), ("pixels", pixels)):
        arrays = values[tested], rows.labels[tested], rows.groups[tested]
        found = probing.leave_groups_out(
            *arrays, folds=splits.FOLDS, penalties=_TRIED, scaling=scalings[name]
        )
        result[name] = found.accuracy
        if found.low is not None and found.high is not None:
            result |= {f"{name}_low": found.low, f"{name}_high": found.high}
    return result


def _typical(table: Manifest, rows: TaskRows, threshold: float) -> Array:
    """Return places of rows to fit on: at most _FRAMES of a recording, those with contact where
    there are any.
    """
    scores = table.number_column(SCORE)
    chosen = []
    for group in dict.fromkeys(rows.groups.tolist()):
        places = np.flatnonzero(rows.groups == group)
        touched = places[scores[rows.rows[places, 0]] > threshold]
        places = touched if len(touched) else places
        chosen.append(
            places[
                np.unique(np.linspace(0, len(places) - 1, min(_FRAMES, len(places))).astype(int))
            ]
        )
    return np.concatenate(chosen)
