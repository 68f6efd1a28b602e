"""Training longer on the recordings of a page: fine-tuning in a thread, and what it left."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.linear_head import HEAD, Head, load_head
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from anytouch_jax.live.page.fitting import false_alarms_of, recordings_of
from anytouch_jax.live.page.recorder import SCORE, LiveRecorder

if TYPE_CHECKING:
    from pathlib import Path

    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.finetuning.options import State

MINUTES = 5.0
_FOLDER = "tuned"
_SENSOR = "sensor.txt"  # in it: of which sensor it is


class Tuned(NamedTuple):
    """An encoder that was fine-tuned on the recordings, and its head."""

    encoder: Encoder
    head: Head

    def features(self, prepared: Array, row: int) -> Array:
        """Return features (E,) of a prepared frame u8 (H, W, 3) of sensor `row`."""
        rows = np.array([row], np.int32)
        return self.encoder.encode_touch(prepared, rows, pooling=self.head.pooling)[0]


class LongerTraining:
    """Fine-tunes the page's encoder on its recordings, and keeps the result in their folder.

    Live touch is embedded by both encoders then: the page's own one measures fields and finds
    similar recordings, and `tuned` names.
    """

    def __init__(
        self, encoder: Encoder, recorder: LiveRecorder, log: Callable[[str], None]
    ) -> None:
        self.tuned: Tuned | None = None
        self._encoder = encoder
        self._recorder = recorder
        self._log = log
        self._folder = self._own_folder()
        self._busy = threading.Lock()
        self._stops = False
        self._until = 0.0
        self._score = ""
        self._before = ""
        self._said = ""
        self._fault = ""

    @property
    def is_on(self) -> bool:
        """Whether it trains."""
        return self._busy.locked()

    def about(self) -> dict[str, Any]:
        """Return what the page shows of it."""
        return {
            "on": self.is_on,
            "left": max(0.0, self._until - time.monotonic()) if self.is_on else 0.0,
            "score": self._score,
            "before": self._before,
            "said": self._said,
            "fault": self._fault,
            "used": self.tuned is not None,
            "folder": str(self._recorder.named / self._folder.name),
        }

    def _own_folder(self) -> Path:
        """Return the folder of the result: tuned, or tuned_SENSOR beside that of another sensor.

        Two pages on different sensors may share the recordings, and each has a result of its own.
        """
        folder = self._recorder.out / _FOLDER
        sensor = self._recorder.sensor
        with suppress(OSError, UnicodeDecodeError):
            if (folder / _SENSOR).read_text(encoding="utf-8") != sensor:
                return folder.with_name(f"{_FOLDER}_{sensor}")
        return folder

    def reopen(self, head_file: Path) -> None:
        """Use the result of an earlier start, unless a head was trained after it."""
        own = self._folder / HEAD
        if not own.is_file():
            return
        if head_file.is_file() and head_file.stat().st_mtime > own.stat().st_mtime:
            return
        try:
            self._open()
        except UserError as error:
            self._log(f"The encoder in {self._folder} is not used. {error}")

    def forget(self) -> None:
        """Name by the linear head again, which has newer recordings."""
        self.tuned = None
        self._said = ""

    def start(self) -> None:
        """Begin, in a thread. Raises UserError while it trains already."""
        if not self._busy.acquire(blocking=False):
            raise UserError("It is training already.")
        self._stops = False
        self._fault = self._said = self._score = self._before = ""
        self._until = time.monotonic() + 60 * MINUTES
        threading.Thread(target=self._run, daemon=True).start()

    def stop(self) -> None:
        """End the training and keep the best."""
        self._stops = True

    def _run(self) -> None:
        # Live touch comes first, so this thread is nice to it.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        try:
            self._train()
        except (UserError, OSError, ValueError) as error:
            self._fault = str(error)
        finally:
            self._busy.release()

    def _train(self) -> None:
        from anytouch_jax.finetuning import FinetuneOptions, finetune

        sensor = self._recorder.sensor
        # Made beside the old result, which stays until the new one is whole.
        fresh = self._folder.with_name(f".{_FOLDER}_{sensor}.new")
        shutil.rmtree(fresh, ignore_errors=True)
        options = FinetuneOptions(
            false_alarms=false_alarms_of(recordings_of(self._recorder.file, sensor)),
            minutes=MINUTES,
            group="sequence",
            sensor=sensor,
            where=(SCORE, THRESHOLDS.get(sensor, DEFAULT_THRESHOLD)),
        )
        result = finetune(
            self._recorder.file,
            "object",
            out=fresh,
            model=self._encoder.source,
            options=options,
            log=self._log,
            watch=self._watch,
            ended=lambda: self._stops,
        )
        atomic_write(fresh / _SENSOR, sensor)
        with self._recorder.manifest.locked():
            self._folder = self._own_folder()  # another page may have been the first to train
            shutil.rmtree(self._folder, ignore_errors=True)
            os.replace(fresh, self._folder)
        self._said = result.sentence
        self._open()

    def _watch(self, state: State) -> None:
        self._score = state.score
        self._before = state.before

    def _open(self) -> None:
        from anytouch_jax.encoder.encoder import load_encoder

        self.tuned = Tuned(load_encoder(self._folder), load_head(self._folder))
