"""A classifier that is taught by recordings of live touch, and used at once."""

from __future__ import annotations

import os
import threading
import time
import zipfile
from collections.abc import Callable
from functools import partial
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.encoder.arrays import Array, Pooling
from anytouch_jax.encoder.embed import Features, embed_rows, save_npz
from anytouch_jax.encoder.linear_head import load_head, save_head
from anytouch_jax.errors import UserError
from anytouch_jax.live.page.accuracy import RESULT, measure_head
from anytouch_jax.live.page.feature_map import FeatureMap
from anytouch_jax.live.page.fitting import fit_head
from anytouch_jax.live.page.longer import LongerTraining
from anytouch_jax.live.page.recorder import SCORE, LiveRecorder
from anytouch_jax.live.page.tables import Table

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import Head

_LOOK = 1.0  # seconds between looks for the recordings of other pages
_BATCH = 4  # frames embedded at once: live touch waits for them


class Teacher:
    """The recordings of a folder, and the `head` that was fitted on them.

    The head and its features lie in the folder, for the next start too.
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
        self.head_file, self._features = recorder.head_files()
        self.head: Head | None = None
        self.space: FeatureMap | None = None
        self.table: Table | None = None
        self.version = 0  # rises with every recording and every head, also of other pages
        self._stamp: tuple[int, int, int] | None = (
            None  # of the manifest that `table` was read from
        )
        self._noticed: tuple[int, int, int] | None = None  # of a manifest that was not read yet
        self._looked = 0.0
        self._was_longer = False
        self._training = threading.Lock()
        self._counting = threading.Lock()  # threads of several pages, of the camera and of training
        self._fault = ""
        self.longer = LongerTraining(encoder, recorder, log)
        self.reload()
        if self.head_file.is_file() and self._features.is_file():
            try:
                self._use(load_head(self.head_file))
            except UserError as error:
                log(f"The head in {recorder.out} is not used. {error}")
        self.longer.reopen(self.head_file)

    def reload(self) -> None:
        """Read the manifest again, after a recording. Raises UserError."""
        manifest = self._recorder.manifest
        # The stamp is taken first: a change that comes while it is read is noticed the next time.
        self._stamp = manifest.stamp()
        if self._stamp is not None:
            self.table = Table(manifest.read(), self._recorder.out.name)
        self._changed()

    def _changed(self) -> None:
        with self._counting:
            self.version += 1

    def look(self) -> None:
        """Raise the version if another page has changed the manifest.

        It costs nothing, so that every live frame may ask for it.
        """
        now = time.monotonic()
        if now - self._looked > _LOOK:
            self._looked = now
            if self.longer.is_on or self._was_longer:
                # The page shows the time left, and then the result.
                self._changed()
            self._was_longer = self.longer.is_on
            stamp = self._recorder.manifest.stamp()
            if stamp not in (self._stamp, self._noticed):
                self._noticed = stamp
                self._changed()

    def about(self) -> dict[str, Any]:
        """Return the names with their recordings, what is known of the head, and what it lacks."""
        if self._recorder.manifest.stamp() != self._stamp:
            self.reload()
        names = {} if self.table is None else self._names(self.table.manifest)
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
            "longer": self.longer.about(),
            "result": {name: float(result[name]) for name in RESULT if name in result},
        }

    def _names(self, manifest: Manifest) -> dict[str, dict[str, Any]]:
        """Return each name with its recordings, its firmest row and its last recording."""
        objects = manifest.text_column("object")
        sequences = manifest.text_column("sequence")
        is_ours = manifest.text_column("sensor") == self._recorder.sensor
        is_used = (manifest.text_column("split") == "train") & (objects != "")
        scores = np.nan_to_num(manifest.number_column(SCORE))
        names = {}
        for name in np.unique(objects[is_ours & is_used]):
            rows = np.flatnonzero(is_ours & is_used & (objects == name))
            several = list(dict.fromkeys(sequences[rows].tolist()))
            names[str(name)] = {
                "recordings": len(several),
                "row": int(rows[scores[rows].argmax()]),
                "last": several[-1],
            }
        return names

    def train(self) -> None:
        """Fit a head on all recordings, in a thread.

        Raises UserError without two names, and while one is fitted.
        """
        if missing := self.about()["missing"]:
            raise UserError(missing)
        if not self._training.acquire(blocking=False):
            raise UserError("A head is being trained already.")
        self.longer.forget()
        self._changed()  # the page says that it trains
        threading.Thread(target=self._train, daemon=True).start()

    def train_longer(self) -> None:
        """Fine-tune the encoder on all recordings, in a thread.

        Raises UserError without two names, and while something is trained.
        """
        if missing := self.about()["missing"]:
            raise UserError(missing)
        if self._training.locked():
            raise UserError("A head is being trained already.")
        self.longer.start()

    def leave_out(self, sequence: str) -> None:
        """Mark a recording as unused. Its frames stay. Raises UserError."""
        self._recorder.manifest.leave_out(sequence)
        self.reload()

    def archive(self) -> IO[bytes]:
        """Return a ZIP of the manifest and its images, and of the head with its features."""
        out = self._recorder.out
        files = {self._recorder.file, self.head_file, self._features}
        if self.table is not None:
            manifest = self.table.manifest
            for column in ("path", "background_path"):
                rows = np.flatnonzero(manifest.present(column)).tolist()
                files |= {manifest.file(row, column) for row in rows}
        packed = TemporaryFile()  # noqa: SIM115 - the answer closes it
        with zipfile.ZipFile(packed, "w") as archive:
            for file in sorted(files):
                # A manifest could name files elsewhere: they are none of the page's to give away.
                if file.is_file() and file.is_relative_to(out):
                    archive.write(file, f"{out.name}/{file.relative_to(out)}")
        packed.seek(0)
        return packed

    def _train(self) -> None:
        # Live touch comes first, so this thread is nice to it.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)
        try:
            self._fault = ""
            self._fit(self._recorder.manifest.read())
        except (UserError, OSError, ValueError) as error:
            self._fault = str(error)
        finally:
            self._training.release()
            self._changed()

    def _fit(self, table: Manifest) -> None:
        """Fit a head and let it name live touch, then measure it."""
        fitted = fit_head(
            self._encoder,
            table,
            self._recorder.sensor,
            self._pooling,
            partial(self._embed, table),
            self._log,
        )
        ids = fitted.ids
        keys = {
            name: table.text_column(name)[ids] for name in ("path", "sensor", "sequence", "object")
        }
        keys["frame_index"] = np.asarray(table.table["frame_index"])[ids]
        features = Features(fitted.x, ids, keys)
        about = {
            "encoder": self._encoder.source,
            "weights": self._encoder.fingerprint,
            "input": str(self._recorder.file),
            "pooling": self._pooling,
            "frames": "1",
        }
        # The two files belong together: another page must not write one of them between.
        with self._recorder.manifest.locked():
            # Again, because another page may have been the first to train.
            self.head_file, self._features = self._recorder.head_files()
            save_npz(self._features, features, about)
            save_head(self.head_file, fitted.head)
        self._use(fitted.head)
        if len(fitted.repeated):
            # It takes longer than the fit, and live touch has its names meanwhile.
            result = measure_head(table, fitted)
            about |= {name: str(value) for name, value in result.items()}
            save_npz(self._features, features, about)
            self._use(fitted.head)

    def _embed(self, table: Manifest, ids: Array) -> Array:
        """Return features (n, E) of rows: of live touch, and of frames of an earlier start."""
        known = self._recorder.features
        paths = table.text_column("path")[ids].tolist()
        unknown = [place for place, path in enumerate(paths) if path not in known]
        if unknown:
            found, values = embed_rows(
                self._encoder,
                table,
                ids[unknown],
                pooling=self._pooling,
                batch=_BATCH,
                log=self._log,
            )
            if len(found) < len(unknown):
                raise UserError(
                    f"{len(unknown) - len(found)} recorded frames have no image of the untouched "
                    "gel."
                )
            known |= {paths[place]: one for place, one in zip(unknown, values, strict=True)}
        return np.stack([known[path] for path in paths])

    def _use(self, head: Head) -> None:
        """Let live touch be named by a head that lies in the folder.

        Raises UserError for one of another encoder.
        """
        self.reload()
        space = FeatureMap(self._features, [] if self.table is None else [self.table])
        head.check(self._encoder.source, self._encoder.fingerprint, self._pooling, 1)
        space.index.check(self._encoder.source, self._encoder.fingerprint)
        self.head = head
        self.space = space
