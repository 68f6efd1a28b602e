"""The AnyTouch encoder: features of touch, and its fields in millimetres and newtons.

Its image and text towers are in `encoder.towers`.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import numpy.typing as npt

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import UNIVERSAL, Config, ModelConfig, check_spelling
from anytouch_jax.data.images import to_rgb
from anytouch_jax.data.transforms import Flip, subtract_background, touch_evaluation
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import BATCH, Aggregation, EngineChoice, Log, Params, Pooling, warn
from anytouch_jax.encoder.features import as_clips as as_clips
from anytouch_jax.encoder.features import bare_model as bare_model
from anytouch_jax.encoder.features import check_choices as check_choices
from anytouch_jax.encoder.features import features_and_fields, network
from anytouch_jax.encoder.features import precision as precision
from anytouch_jax.encoder.features import touch_features as touch_features
from anytouch_jax.encoder.features import touch_only as touch_only
from anytouch_jax.encoder.interface import Preprocess as Preprocess
from anytouch_jax.encoder.measured import Fields, Measure, missing, open_measure
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.encoder.towers import PART_NAMES, Towers
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.renamed import keywords
from anytouch_jax.shown import count_of, described, leaves

# Touches at once up to which onnxruntime is faster than XLA (`experiments.benchmarks.batches`). An
# engine fuses a small network into fewer calls, and XLA has the faster products of large matrices.
FEW = 4


@dataclass(frozen=True, repr=False)
class Encoder(Towers):
    """A touch encoder with its parameters, and the image and text towers if the weights have them.

    `config` and `params` are those of the touch encoder alone, `source` is the path of the weights.
    If training never drew the universal tokens (`universal_drawn`), the mean of the trained
    sensors' tokens is used instead. `others` are the parameters of towers, decoder and heads of the
    `whole` model: they stay on the host until they are used. `engine` computes touch by what
    `exporter` returns (`cached_export`); XLA computes all else.
    """

    config: Config = field(repr=False)
    params: Params = field(repr=False)
    source: str
    trained_sensors: tuple[str, ...] | None = None
    universal_drawn: bool = True
    whole: ModelConfig | None = field(default=None, repr=False)
    others: Params = field(default_factory=dict, repr=False)
    tokenizer_file: Path | None = field(default=None, repr=False)
    metadata: Mapping[str, Any] = field(default_factory=dict, repr=False)
    engine: EngineChoice = field(default="xla", repr=False)
    exporter: Callable[..., Any] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return described(f"{type(self).__name__} {self.source}", **self.about())

    def about(self) -> dict[str, str]:
        """Return what a user wants to know.

        That is family, parameters, input, background, features and sensors.
        """
        model = self.config.model
        towers = [PART_NAMES[name] for name in ("image", "text") if name in self.others]
        family = (
            f"AnyTouch, width {model.touch.width}, depth {model.touch.depth}, "
            f"{model.touch.heads} heads"
        )
        if towers:
            family += f", with {' and '.join(towers)}"
        count = sum(math.prod(leaf.shape) for leaf in leaves(self.params))
        parameters = count_of(count) if count else ""
        if count and towers:
            parameters += " of the touch encoder"
        if self.needs_background:
            background = "needed, the image of the untouched gel"
        elif self.subtracts:
            background = "subtracted if it is given"
        else:
            background = "not used"
        sensors = ", ".join(model.sensors)
        if self.trained_sensors:
            sensors = f"trained on {', '.join(self.trained_sensors)}"
        return {
            "family": family,
            "parameters": parameters,
            "input": (
                f"uint8 RGB {model.image_size} x {model.image_size}, 1 frame or clips of "
                f"{model.frames} or more"
            ),
            "background": background,
            "features": str(model.embed + model.sight),
            "sensors": sensors,
        }

    def __getstate__(self) -> dict[str, Any]:
        # Compiled programs, which are cached properties, stay in their process.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def sensor_row(self, name: str, log: Log = warn) -> int:
        """Return the row of a sensor, or, logged, of the universal tokens (Sec. 3.5).

        Raises SpellingError for a name that is nearly a known one.
        """
        model = self.config.model
        word = resolve_sensor(name)
        name = word.name
        if word.family in model.sensors and name not in model.sensors:
            name = word.family
        in_table = name in model.sensors
        # Without trained sensors nobody knows whether the universal tokens were drawn.
        drawn = self.universal_drawn or not self.trained_sensors
        if name == UNIVERSAL:
            is_trained = drawn
        else:
            is_trained = self.trained_sensors is None or name in self.trained_sensors
        if in_table and is_trained:
            return model.sensors.index(name)
        if not word.is_fitted:
            check_spelling(name, model.sensors)
        why = f"is not in this model's table ({', '.join(model.sensors)})"
        if word.is_fitted:
            why = "has no tokens of its own here, which `anytouch adapt` makes"
        if in_table:
            why = f"was not in training, which had {', '.join(self.trained_sensors or ())}"
        used = "the mean of the trained sensors' tokens (no universal ones)"
        if drawn:
            used = "the universal tokens"
        log(f"sensor {name!r} {why}: using {used}")
        # `weights.convert.serve_unseen` has put the tokens that serve it into the row of a sensor
        # of the table that was never trained.
        if in_table:
            return model.sensors.index(name)
        return model.universal_row

    def computed_in(self, dtype: Literal["trained", "float32", "bfloat16"]) -> Encoder:
        """Return the same encoder with float32 or bfloat16 arithmetic.

        "trained" is that of its training.
        """
        if dtype == "trained":
            return self
        whole = self.whole and replace(self.whole, dtype=dtype)
        return replace(self, config=self.config.with_settings({"model.dtype": dtype}), whole=whole)

    @cached_property
    def fingerprint(self) -> str:
        """CRC-32 of the touch encoder's parameters, in hexadecimal."""
        parts = [np.ascontiguousarray(leaf).tobytes() for leaf in jax.tree.leaves(self.params)]
        return f"{zlib.crc32(b''.join(parts)):08x}"

    @property
    def blank(self) -> np.ndarray:
        """A prepared frame of zeros: its shape and type are those of the input."""
        side = self.config.model.image_size
        return np.zeros((side, side, 3), np.uint8)

    def input_form(self, frames: int) -> dict[str, Any]:
        """Return what an exported encoder says about its input.

        It says how an image becomes a frame of it, too.
        """
        side = self.config.model.image_size
        difference = ""
        resize = (
            f"the whole image to {side} x {side}, its shape not kept: OpenCV's INTER_AREA where "
            f"the shorter side is above {side} pixels, else INTER_LINEAR"
        )
        if self.subtracts:
            difference = ", background-subtracted: clip(frame - gel + 128, 0, 255)"
            resize += "; the background is subtracted before"
        return {
            "input": (
                f"frames: uint8 RGB (B, {frames}, {side}, {side}, 3){difference}; sensor: int32 "
                "(B,)"
            ),
            "resize": resize,
        }

    def untrained(self, seed: int = 0) -> Encoder:
        """Return an untrained encoder of the same form: the control of every probe."""
        return random_encoder(self.config, seed)

    def bare(self) -> Encoder:
        """Return what prepares frames, without parameters."""
        return Encoder(self.config, {}, self.source)

    @property
    def runs_in_jax(self) -> bool:
        """Whether `traceable` gives it as a function of jax."""
        return True

    @keywords(join="aggregation")
    def traceable(
        self, pooling: Pooling = "class", aggregation: Aggregation = "mean"
    ) -> Callable[..., jax.Array]:
        """Return the function from params, touches and sensor rows to features (B, E).

        Touches are u8 (B, T, H, W, 3), rows (B,).
        """
        return partial(touch_features, net=self.net, pooling=pooling, aggregation=aggregation)

    def prepare(self, frame: np.ndarray, background: np.ndarray | None = None) -> np.ndarray:
        """Return a frame u8 (h, w, 3) as the network reads it.

        Its `background` is subtracted if there is one.
        """
        frames = [frame] if background is None else subtract_background([frame], background)
        return touch_evaluation(frames, self.config.model.image_size)[0]

    @keywords(join="aggregation")
    def encode_touch(
        self,
        frames: Any,
        sensor: str | Sequence[str] | np.ndarray = UNIVERSAL,
        *,
        pooling: Pooling = "class",
        aggregation: Aggregation = "mean",
    ) -> np.ndarray:
        """Return features f32 (B, E) of touches, not unit-norm.

        Args:
            frames: u8 RGB (B, T, H, W, 3), (B, H, W, 3) or (H, W, 3). H and W are the model's size,
                see `preprocess`. T is 1 (a still), 3 (a clip) or more: then features of segments of
                three are joined by `aggregation`.
            sensor: one name, names (B,), or rows i32 (B,).
            pooling: the class token (which alignment trains), the mean of the patch tokens, or both
                (B, 2E).
            aggregation: the temporal aggregation of segments.

        Raises:
            UserError: touches of another form, or another sensor or pooling than there are.
        """
        frames = as_clips(frames)
        side = self.config.model.image_size
        if frames.dtype != np.uint8 or frames.ndim != 5 or frames.shape[2:] != (side, side, 3):
            convert = ""
            if frames.dtype != np.uint8:
                convert = "convert values 0 to 255 by np.asarray(frames, np.uint8), and "
            raise UserError(
                f"touches must be uint8 RGB of {side} x {side} pixels, (B, T, {side}, {side}, 3), "
                f"not {frames.dtype} {frames.shape}; {convert}resize each frame with "
                "encoder.preprocess(frame)"
            )
        arrays.check_frames(self.config.model, frames.shape[1])
        check_choices(pooling, aggregation)
        run = None
        if len(frames) and self.uses_engine(len(frames)):
            run = self.exported(frames.shape[1], pooling)
        if run is not None:
            return run(frames, self._rows(sensor, len(frames)))
        return self._encode(
            frames, sensor, self.traceable(pooling, aggregation), (pooling, aggregation)
        )

    def _rows(self, sensor: Any, count: int) -> np.ndarray:
        """Return rows i32 (count,) of a sensor, see `encode_touch`."""
        return arrays.rows_of_sensors(
            sensor, count, self.sensor_row, len(self.config.model.sensors)
        )

    def uses_engine(self, count: int) -> bool:
        """Return whether `count` touches at once are computed by an engine, where there is one.

        "auto" leaves more than FEW to XLA, and an engine that was named computes all.
        """
        return self.engine not in ("xla", "auto") or (self.engine == "auto" and count <= FEW)

    def exported(self, frames: int, pooling: Pooling = "class", *, fields: bool = False) -> Any:
        """Return the export on its engine for touches of `frames` frames.

        It is None if XLA computes them.
        """
        if self.engine == "xla" or self.exporter is None:
            return None
        refuse_forked()
        key = ("exported", frames, pooling, fields)
        if key not in self._compiled:
            self._compiled[key] = self.exporter(self, frames, pooling, fields=fields)
        return self._compiled[key]

    def _encode(
        self, clips: np.ndarray, sensor: Any, run: Callable[..., jax.Array], key: Any
    ) -> np.ndarray:
        """Return `run` of the parameters, clips (B, ...) and rows of their sensors.

        It is compiled once for each `key` and for a few B.
        """
        rows = self._rows(sensor, len(clips))
        if key not in self._compiled:
            self._compiled[key] = jax.jit(run)
        with precision(self.config):
            values = self._compiled[key](self._placed, arrays.filled(clips), arrays.filled(rows))
        return np.asarray(values)[: len(clips)]

    @cached_property
    def _placed(self) -> Params:
        """The parameters on the device."""
        return jax.device_put(self.params)

    def measure(
        self,
        frames: Any,
        background: npt.ArrayLike | None = None,
        sensor: str = UNIVERSAL,
        *,
        width_mm: float | None = None,
        log: Log = warn,
    ) -> Fields:
        """Return depth, shear, contact and force of B frames in mm and N, with their deviations.

        Args:
            frames: those of the camera, not prepared: (h, w), (h, w, 3), (B, h, w, 3) or clips (B,
                T, h, w, 3), whose last frame is measured. A still shows little of slip.
            background: the untouched gel.
            sensor: its name, or the folder NAME.sensor of a fitted one.
            width_mm: the mm that the image's width shows. A name that is not in
                `fields.measure.GELS` needs it. Without it lengths are fractions of that width, and
                there is no force.
            log: takes a sentence on each fault of the frames.

        Raises:
            UserError: the weights do not measure, or the frames have another form.
        """
        measure = self.measure_of(sensor, background, width_mm, log)
        frames = arrays.as_array(frames, "frames")
        clips = as_clips(frames[..., None] if frames.ndim == 2 else frames)
        if clips.ndim != 5 or not len(clips):
            raise UserError(
                "frames must be (h, w, 3), (B, h, w, 3) or clips (B, T, h, w, 3), not "
                f"{frames.shape}"
            )
        arrays.check_frames(self.config.model, clips.shape[1])
        clips = clips[:, -self.config.model.frames :]
        aspect = np.log(clips.shape[2] / clips.shape[3])
        row = self.sensor_row(sensor, log)
        parts = []
        for start in range(0, len(clips), BATCH):
            part = clips[start : start + BATCH]
            ready = np.stack(
                [[self.preprocess(frame, background) for frame in clip] for clip in part]
            )
            rows = np.full(len(part), row, np.int32)
            aspects = np.full(len(part), aspect, np.float32)
            parts.append(self.encode_and_measure(ready, rows, aspects)[1])
        out: FieldOutput[np.ndarray] = FieldOutput._make(
            arrays.check_features(np.concatenate(values)) for values in zip(*parts, strict=True)
        )
        return measure(out, [to_rgb(clip[-1], "the frame") for clip in clips])

    def measure_of(
        self,
        sensor: str,
        background: npt.ArrayLike | None = None,
        width_mm: float | None = None,
        log: Log = warn,
        *,
        rotate: int = 0,
        flip: Flip = "none",
    ) -> Measure:
        """Return what turns outputs for frames of a sensor into `Fields`: `stream` takes it.

        Args:
            sensor: its name, or the folder NAME.sensor of a fitted one.
            background: the untouched gel, RGB (h, w, 3), as the camera takes it.
            width_mm: the mm that the image's width shows, see `measure`.
            log: takes a sentence on each fault of the first frame.
            rotate: degrees by which frames are turned clockwise, as `Preprocess` does.
            flip: how they are mirrored after that.

        Raises:
            UserError: the weights do not measure.
        """
        gel = None
        if background is not None:
            gel = to_rgb(arrays.as_array(background, "the background"), "the background")
        if not self.measures:
            raise missing(self.source)
        return open_measure(
            self.metadata,
            sensor,
            gel,
            width_mm=width_mm,
            log=log,
            rotate=rotate,
            flip=flip,
            weights=lambda: self.fields_fingerprint,
        )

    @cached_property
    def fields_fingerprint(self) -> str:
        """CRC-32 of the parameters of touch encoder and fields, in hexadecimal."""
        parts = jax.tree.leaves(self.part_params("fields")) if "fields" in self.others else []
        digest = int(self.fingerprint, 16)
        for leaf in parts:
            digest = zlib.crc32(np.ascontiguousarray(leaf).tobytes(), digest)
        return f"{digest:08x}"

    @property
    def measures(self) -> bool:
        """Whether the weights measure depth, shear, contact and force."""
        return "fields" in self.others

    def encode_and_measure(
        self, clips: np.ndarray, rows: np.ndarray, aspect: np.ndarray, pooling: Pooling = "class"
    ) -> tuple[np.ndarray, FieldOutput]:
        """Return features and raw fields of prepared clips in one pass.

        Args:
            clips: u8 (B, T, H, W, 3).
            rows: (B,), those of the sensor.
            aspect: (B,), logarithms of the images' height over width.
            pooling: that of the features.
        """
        if self.measures and self.uses_engine(len(clips)):
            run = self.exported(clips.shape[1], pooling, fields=True)
            if run is not None:
                return run.measure(np.asarray(clips), np.asarray(rows), np.asarray(aspect))
        key = ("fields", pooling)
        if key not in self._compiled:
            net = network(self.whole or self.config.model)
            self._compiled[key] = jax.jit(partial(features_and_fields, net=net, pooling=pooling))
        count = len(clips)
        given = [arrays.filled(one) for one in (clips, rows, aspect)]
        with precision(self.config):
            values, out = self._compiled[key](self._placed_fields, *given)
        return np.asarray(values)[:count], FieldOutput._make(np.asarray(x)[:count] for x in out)

    @cached_property
    def _placed_fields(self) -> Params:
        """The parameters of touch encoder and fields on the device."""
        if not self.measures:
            raise missing(self.source)
        return self._placed | jax.device_put({"fields": self.part_params("fields")})


def random_encoder(config: Config, seed: int = 0) -> Encoder:
    """Return an untrained encoder of the same form: the control of every probe."""
    config = touch_only(config)
    with precision(config):
        params = {"touch": network(config.model).init(jax.random.key(seed))["touch"]}
    return Encoder(config, params, f"random({seed})")
