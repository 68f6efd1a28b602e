"""The interface of a touch encoder, and the preprocessing of its frames.

To add an encoder, write one class: inherit `TouchEncoder`, set its three attributes and define its
four methods. `embed_rows`, `run_in_batches`, `Preprocess`, probes, `stream` and retrieval then take
it. `tests/encoder/test_interface.py` adds one.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax import renamed
from anytouch_jax.config import UNIVERSAL, Config, check_spelling
from anytouch_jax.data.background.rule import (
    RunningBackground,
    estimate_background,
    other_unit,
    same_unit,
)
from anytouch_jax.data.images import to_rgb
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import Aggregation, Log, Params, Pooling, warn
from anytouch_jax.encoder.measured import missing
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.errors import UserError


class TouchEncoder(ABC):
    """An encoder of touch: frames of a camera become features.

    A subclass must have the attributes below, and define `fingerprint`, `blank`, `prepare` and
    `encode_touch`. The other methods have defaults, which fit an encoder that knows no sensors, was
    not trained on background-subtracted frames, and computes nothing but features.

    Attributes:
        config: `config.model` names the sensors, the side of a frame (`image_size`) and the frames
            of a clip (`frames`). `config.data.background` says whether the background is subtracted
            ("subtract", "either") or not ("keep").
        params: the parameters, arrays in nested dictionaries. {} if there are none for jax.
        source: the name or path that a user knows it by.
    """

    config: Config
    params: Params
    source: str

    # What an encoder must define.

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """A short text that is equal for equal parameters, and else differs."""

    @property
    @abstractmethod
    def blank(self) -> np.ndarray:
        """A prepared frame of zeros: its shape and type are those of the input."""

    @abstractmethod
    def prepare(self, frame: np.ndarray, background: np.ndarray | None = None) -> np.ndarray:
        """Return a frame RGB u8 (h, w, 3) as the network reads it.

        `background` is the untouched gel, of the frame's size, if there is an image of it.
        """

    @renamed.keywords(join="aggregation")
    @abstractmethod
    def encode_touch(
        self,
        frames: Any,
        sensor: str | Sequence[str] | np.ndarray = UNIVERSAL,
        *,
        pooling: Pooling = "class",
        aggregation: Aggregation = "mean",
    ) -> np.ndarray:
        """Return features f32 (B, E) of prepared frames (B, T, ...).

        Args:
            frames: B touches of T frames in the form of `blank`, oldest first.
            sensor: one name, names (B,), or rows i32 (B,) of the table of sensors.
            pooling: the class token, the mean of the patch tokens, or both (B, 2E). An encoder that
                has only one kind of feature may ignore it.
            aggregation: the temporal aggregation of the segments of a long clip.
        """

    # What most encoders leave as it is.

    @property
    def trained_sensors(self) -> tuple[str, ...] | None:
        """The sensors that it was trained on, None if nobody knows."""
        return None

    @property
    def subtracts(self) -> bool:
        """Whether it subtracts the background of a touch that has one (`data.background`)."""
        return self.config.data.background != "keep"

    @property
    def needs_background(self) -> bool:
        """Whether it was trained on background-subtracted touches only."""
        return self.config.data.background == "subtract"

    @property
    def backgrounds(self) -> dict[str, np.ndarray]:
        """Images of the untouched gel by unit, of an encoder that stores some."""
        return {}

    @property
    def gels(self) -> dict[str, np.ndarray]:
        """The old name of `backgrounds`."""
        renamed.warn("encoder.gels", "encoder.backgrounds")
        return self.backgrounds

    @property
    def contract(self) -> str:
        """Everything but the parameters that decides its features, as text."""
        return json.dumps(asdict(self.config.model), sort_keys=True)

    @property
    def measures(self) -> bool:
        """Whether the weights measure depth, shear, contact and force."""
        return False

    @property
    def runs_in_jax(self) -> bool:
        """Whether `traceable` gives it as a function of jax. If not, only `encode_touch` runs."""
        return False

    def sensor_row(self, name: str, log: Log = warn) -> int:
        """Return the row of a sensor, or, logged, that which serves all others.

        Raises SpellingError for a name that is nearly a known one.
        """
        names = self.config.model.sensors
        word = resolve_sensor(name)
        name = word.name
        if name in names:
            return names.index(name)
        if not word.is_fitted:
            check_spelling(name, names)
        log(f"sensor {name!r} is not in this model's table ({', '.join(names)})")
        return self.config.model.universal_row

    def untrained(self, seed: int = 0) -> TouchEncoder:
        """Return an untrained encoder of the same form, the control of every probe."""
        raise UserError(f"{self.source} has no untrained form; probe it without controls")

    def bare(self) -> TouchEncoder:
        """Return what prepares frames, without parameters: it is sent to worker processes."""
        return self

    def exported(self, frames: int, pooling: Pooling = "class", *, fields: bool = False) -> Any:
        """Return the export on its engine for touches of `frames` frames.

        It is None where `encode_touch` computes them.
        """
        return None

    @renamed.keywords(join="aggregation")
    def traceable(
        self, pooling: Pooling = "class", aggregation: Aggregation = "mean"
    ) -> Callable[..., Any]:
        """Return the function from params, touches (B, T, ...) and sensor rows (B,) to features."""
        raise UserError(f"{self.source} has no function for jax; call its encode_touch")

    def measure_of(
        self,
        sensor: str,
        background: npt.ArrayLike | None = None,
        width_mm: float | None = None,
        log: Log = warn,
        *,
        rotate: int = 0,
        flip: Flip = "none",
    ) -> Any:
        """Raise UserError: it measures nothing."""
        raise missing(self.source)

    def preprocess(
        self, frame: npt.ArrayLike, background: npt.ArrayLike | None = None
    ) -> np.ndarray:
        """Return a frame (h, w, 3) as RGB u8 (size, size, 3).

        It is background-subtracted if the encoder does so. Raises UserError if the encoder needs a
        `background`, and there is none. `estimate_background(frames)` makes one.
        """
        if self.needs_background and background is None:
            raise UserError(
                f"{self.source} subtracts the untouched gel. Give its image, or that of some "
                "frames: encoder.preprocess(frame, at.estimate_background(frames)). Or prepare all "
                "frames with at.Preprocess(encoder, frames=frames)."
            )
        return Preprocess(self, background)(frame)


class Preprocess:
    """Frames of one sensor in the form that an encoder was trained on.

    They are turned by `rotate` degrees, mirrored by `flip` (`data.transforms.orient_frame`) and
    resized. For an encoder that `subtracts`, the `background` (an image of the untouched gel) is
    subtracted first, or the `estimate_background` of `frames`. Without either, the first frame
    chooses among the `known` images of a head. If none is of its unit, `log` gets a warning, and
    the frames so far give a running estimate, as for an encoder that needs a background.

    >>> features = encoder.encode_touch(Preprocess(encoder, frames=frames)(camera.read()), "digit")
    """

    def __init__(
        self,
        encoder: TouchEncoder,
        background: npt.ArrayLike | None = None,
        *,
        frames: Iterable[npt.ArrayLike] | None = None,
        rotate: int = 0,
        flip: Flip = "none",
        known: Mapping[str, np.ndarray] | None = None,
        log: Log = warn,
    ) -> None:
        if background is not None and frames is not None:
            raise UserError("Give a background, or the frames that it is taken from, not both.")
        # Workers get no parameters: this object is pickled for each of them.
        self._prepare = encoder.bare().prepare
        self._subtracts = encoder.subtracts
        self._orient = partial(orient_frame, rotate=rotate, flip=flip)
        self._known = dict(known or {})
        self._log = log
        self._running = RunningBackground() if encoder.needs_background or self._known else None
        self._background = None if frames is None else estimate_background(frames)
        if background is not None:
            self._background = to_rgb(
                arrays.as_array(background, "the background"), "the background"
            )
        # The background as the camera takes it, and the same oriented like the frames.
        self._gel: tuple[np.ndarray | None, np.ndarray] = None, np.zeros((0, 0, 3), np.uint8)

    @property
    def background(self) -> np.ndarray | None:
        """The image of the untouched gel, RGB u8 (h, w, 3), as the camera takes it.

        It is None if there is none (yet).
        """
        if self._background is None and self._running:
            return self._running.image
        return self._background

    @property
    def estimated(self) -> bool:
        """Whether the background is a running estimate that is not settled."""
        return self._background is None and self._running is not None and not self._running.settled

    def __repr__(self) -> str:
        gel = self._background
        encoder = getattr(self._prepare, "__self__", None)
        if gel is None:
            known = "the first frame"
        else:
            known = f"an image of {gel.shape[1]} x {gel.shape[0]}"
        used = f"minus {known}" if self._subtracts else "without a background"
        turned = " ".join(f"{name}={value!r}" for name, value in self._orient.keywords.items())
        return f"Preprocess(frames of {getattr(encoder, 'source', 'an encoder')}, {used}, {turned})"

    def __call__(self, frame: npt.ArrayLike) -> np.ndarray:
        """Return a camera's frame as the encoder reads it.

        `frame` is (h, w, 3) RGB, grey or RGBA, u8, u16 or floats in 0..1.
        """
        frame = to_rgb(arrays.as_array(frame, "the frame"), "the frame")
        if self._background is None and self._known:
            self._choose_known(frame)
        if self._background is None and self._running is not None:
            self._running.add(frame)
        frame = np.ascontiguousarray(self._orient(frame))
        gel = self.background
        if gel is None or not self._subtracts:
            return self._prepare(frame)
        # A running estimate is replaced by another array when it improves, so identity is enough.
        if self._gel[0] is not gel:
            self._gel = gel, np.ascontiguousarray(self._orient(gel))
        return self._prepare(frame, self._gel[1])

    def _choose_known(self, frame: np.ndarray) -> None:
        """Take the known image of the unit that shows in the first frame, or log that none is."""
        known = self._known
        self._known = {}
        gel, why = same_unit(known, frame)
        if why:
            self._log(other_unit(why))
        else:
            self._background = gel
