"""The touch encoder with its image and text towers: features, similarity, matching, preprocessing."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import UNIVERSAL, Config, ModelConfig, check_spelling
from anytouch_jax.data.gels import RunningGel, other_unit, same_unit, untouched_gel
from anytouch_jax.data.images import to_rgb
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer
from anytouch_jax.data.transforms import Flip, orient_frame, subtract_background, touch_evaluation, vision_evaluation
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import BATCH, Join, Log, Pooling, warn
from anytouch_jax.encoder.engines import EngineChoice
from anytouch_jax.encoder.fields import Fields, Measure, missing, scale_of
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import normalise_image, normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.ops.fields import FieldOutput
from anytouch_jax.shown import count_of, described, leaves

Params = dict[str, Any]
_PART_NAMES = {"image": "image tower", "text": "text tower", "matcher": "matching head", "logit_scale": "temperature"}


@dataclass(frozen=True, repr=False)
class Encoder:
    """A touch encoder with its parameters, and the image and text towers if the weights have them.

    `config` and `params` are those of the touch encoder alone, `source` is the path of the weights. If training never
    drew the universal tokens (`universal_drawn`), the mean of the trained sensors' tokens is used instead. `others` are
    the parameters of towers, decoder and heads of the `whole` model: they stay on the host until they are used.
    `engine` computes touch by what `exporter` returns (`cached_export`); XLA computes all else.
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
        """Return what a user wants to know: family, parameters, input, background, features and sensors."""
        model, count = self.config.model, sum(math.prod(leaf.shape) for leaf in leaves(self.params))
        towers = [_PART_NAMES[name] for name in ("image", "text") if name in self.others]
        trained = self.trained_sensors
        background = "subtracted if it is given" if self.subtracts else "not used"
        return {
            "family": f"AnyTouch, width {model.touch.width}, depth {model.touch.depth}, {model.touch.heads} heads"
            + (f", with {' and '.join(towers)}" if towers else ""),
            "parameters": count_of(count) + (" of the touch encoder" if towers else "") if count else "",
            "input": f"uint8 RGB {model.image_size} x {model.image_size}, 1 frame or clips of {model.frames} or more",
            "background": "needed, the picture of the untouched gel" if self.needs_background else background,
            "features": str(model.embed + model.sight),
            "sensors": f"trained on {', '.join(trained)}" if trained else ", ".join(model.sensors),
        }

    def __getstate__(self) -> dict[str, Any]:  # compiled programs stay in their process
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def net(self) -> Net:
        """The network of the touch encoder."""
        return build(self.config.model)

    def sensor_row(self, name: str, log: Log = warn) -> int:
        """Return the row of a sensor, or, logged, of the universal tokens (Sec. 3.5). SpellingError for a near name."""
        model, name = self.config.model, str(name)
        drawn, known = self.universal_drawn or not self.trained_sensors, name in model.sensors
        if known and (drawn if name == UNIVERSAL else self.trained_sensors is None or name in self.trained_sensors):
            return model.sensors.index(name)
        check_spelling(name, model.sensors)
        why = f"is not in this model's table ({', '.join(model.sensors)})"
        if known:
            why = f"was not in training, which had {', '.join(self.trained_sensors or ())}"
        used = "the universal tokens" if drawn else "the mean of the trained sensors' tokens (no universal ones)"
        log(f"sensor {name!r} {why}: using {used}")
        return model.sensors.index(name) if known else model.universal_row

    def computed_in(self, dtype: Literal["trained", "float32", "bfloat16"]) -> Encoder:
        """Return the same encoder with float32 or bfloat16 arithmetic; "trained" is that of its training."""
        if dtype == "trained":
            return self
        whole = self.whole and replace(self.whole, dtype=dtype)
        return replace(self, config=self.config.with_settings({"model.dtype": dtype}), whole=whole)

    @property
    def subtracts(self) -> bool:
        """Whether it subtracts the background of a touch that has one (`data.background`)."""
        return self.config.data.background != "keep"

    @property
    def needs_background(self) -> bool:
        """Whether it was trained on background-subtracted touches only."""
        return self.config.data.background == "subtract"

    @property
    def gels(self) -> dict[str, np.ndarray]:
        """Pictures of the untouched gel by unit, of an exported encoder that stores some."""
        return {}

    @cached_property
    def fingerprint(self) -> str:
        """CRC-32 of the touch encoder's parameters, in hexadecimal."""
        return f"{zlib.crc32(b''.join(np.ascontiguousarray(x).tobytes() for x in jax.tree.leaves(self.params))):08x}"

    @property
    def blank(self) -> np.ndarray:
        """A prepared frame of zeros: its shape and type are those of the input."""
        return np.zeros((self.config.model.image_size, self.config.model.image_size, 3), np.uint8)

    def input_form(self, frames: int) -> dict[str, Any]:
        """Return what an exported encoder says about its input, and how a picture becomes a frame of it."""
        side, subtracts = self.config.model.image_size, self.subtracts
        difference = ", background-subtracted: clip(frame - gel + 128, 0, 255)" if subtracts else ""
        return {
            "input": f"frames: uint8 RGB (B, {frames}, {side}, {side}, 3){difference}; sensor: int32 (B,)",
            "resize": f"the whole picture to {side} x {side}, its shape not kept: OpenCV's INTER_AREA where the "
            f"shorter side is above {side} pixels, else INTER_LINEAR"
            + ("; the background is subtracted before" if subtracts else ""),
        }

    @property
    def contract(self) -> str:
        """Everything but the parameters that decides its features, as text."""
        return json.dumps(asdict(self.config.model), sort_keys=True)

    def untrained(self, seed: int = 0) -> Encoder:
        """Return an untrained encoder of the same form: the control of every probe."""
        return random_encoder(self.config, seed)

    def bare(self) -> Encoder:
        """Return what prepares frames, without parameters."""
        return Encoder(self.config, {}, self.source)

    def traceable(self, pooling: Pooling = "class", join: Join = "mean") -> Callable[..., jax.Array]:
        """Return the function from params, touches u8 (B, T, H, W, 3) and sensor rows (B,) to features (B, E)."""
        return partial(touch_features, net=self.net, pooling=pooling, join=join)

    def prepare(self, frame: np.ndarray, background: np.ndarray | None = None) -> np.ndarray:
        """Return a frame u8 (h, w, 3) as the network reads it, its `background` subtracted if there is one."""
        frames = [frame] if background is None else subtract_background([frame], background)
        return touch_evaluation(frames, self.config.model.image_size)[0]

    def preprocess(self, frame: npt.ArrayLike, background: npt.ArrayLike | None = None) -> np.ndarray:
        """Return a frame (h, w, 3) as RGB u8 (size, size, 3), background-subtracted if the encoder does so.

        Raises UserError if the encoder needs a `background`, and there is none. `untouched_gel(frames)` makes one.
        """
        if self.needs_background and background is None:
            raise UserError(
                f"{self.source} subtracts the untouched gel. Give its picture, or that of some frames: "
                "encoder.preprocess(frame, at.untouched_gel(frames)). Or prepare all frames with "
                "at.Preprocess(encoder, frames=frames)."
            )
        return Preprocess(self, background)(frame)

    def encode_touch(
        self, frames: Any, sensor: str | Sequence[str] | np.ndarray = UNIVERSAL, *, pooling: Pooling = "class",
        join: Join = "mean",
    ) -> np.ndarray:  # fmt: skip
        """Return features f32 (B, E) of touches u8 RGB (B, T, H, W, 3), (B, H, W, 3) or (H, W, 3); not unit-norm.

        H and W are the model's size, see `preprocess`. T is 1 (a still), 3 (a clip) or more: then features of segments
        of three are joined by `join`. `sensor` is one name, names (B,), or rows i32 (B,). `pooling`: the class token
        (which alignment trains), the mean of the patch tokens, or both (B, 2E). Raises UserError.
        """
        frames = as_clips(frames)
        side = self.config.model.image_size
        if frames.dtype != np.uint8 or frames.ndim != 5 or frames.shape[2:] != (side, side, 3):
            convert = "convert values 0 to 255 by np.asarray(frames, np.uint8), and " * (frames.dtype != np.uint8)
            raise UserError(
                f"touches must be uint8 RGB of {side} x {side} pixels, (B, T, {side}, {side}, 3), not {frames.dtype} "
                f"{frames.shape}; {convert}resize each frame with encoder.preprocess(frame)"
            )
        arrays.check_frames(self.config.model, frames.shape[1])
        check_choices(pooling, join)
        if len(frames) and (run := self.exported(frames.shape[1], pooling)) is not None:
            rows = arrays.rows_of_sensors(sensor, len(frames), self.sensor_row, len(self.config.model.sensors))
            return run(frames, rows)
        return self._encode(frames, sensor, self.traceable(pooling, join), (pooling, join))

    def exported(self, frames: int, pooling: Pooling = "class", *, fields: bool = False) -> Any:
        """Return the export on its engine for touches of `frames` frames, None if XLA computes them."""
        if self.engine == "xla" or self.exporter is None:
            return None
        refuse_forked()
        key = ("exported", frames, pooling, fields)
        if key not in self._compiled:
            self._compiled[key] = self.exporter(self, frames, pooling, fields=fields)
        return self._compiled[key]

    def _encode(self, clips: np.ndarray, sensor: Any, run: Callable[..., jax.Array], key: Any) -> np.ndarray:
        """Return `run` of the parameters, clips (B, ...) and rows of their sensors, compiled for a few B and `key`s."""
        rows = arrays.rows_of_sensors(sensor, len(clips), self.sensor_row, len(self.config.model.sensors))
        if key not in self._compiled:
            self._compiled[key] = jax.jit(run)
        with precision(self.config):
            values = self._compiled[key](self._placed, arrays.filled(clips), arrays.filled(rows))
        return np.asarray(values)[: len(clips)]

    @cached_property
    def _placed(self) -> Params:
        """The parameters on the device."""
        return jax.device_put(self.params)

    @cached_property
    def _compiled(self) -> dict[Any, Any]:
        """What was called: touch by pooling and join, other parts by their method."""
        return {}

    @cached_property
    def tokenizer(self) -> Tokenizer | None:
        """The tokenizer of the text tower."""
        return None if self.tokenizer_file is None else load_tokenizer(self.tokenizer_file)

    def encode_image(self, images: Any, *, batch: int = 64) -> np.ndarray:
        """Return embeddings f32 (B, E) of photographs RGB (h, w, 3), not unit-norm. UserError without a tower."""

        def run(net: Net, params: Params, pixels: jax.Array) -> jax.Array:
            return net.encode_image(params, normalise_image(pixels)).astype(jnp.float32)

        tower, size = self._part("encode_image", run, "image", "lora"), self.config.model.image_size
        images = [images] if getattr(images, "ndim", 0) == 3 else images
        pixels = (vision_evaluation(to_rgb(np.asarray(image), "the image"), size) for image in images)
        return self._embeddings(tower, pixels, batch)

    def encode_text(self, texts: str | Sequence[str], *, batch: int = 64) -> np.ndarray:
        """Return embeddings f32 (L, E) of texts, not unit-norm. Raises UserError without a text tower or tokenizer."""

        def run(net: Net, params: Params, batch: tuple[jax.Array, jax.Array]) -> jax.Array:
            return net.encode_text(params, *batch).astype(jnp.float32)

        tower = self._part("encode_text", run, "text")
        assert self.whole is not None and self.whole.text is not None
        tokenizer, text = self.tokenizer, self.whole.text
        if tokenizer is None:
            raise UserError(f"there is no tokenizer.json in the folder of {self.source}; copy the one of its training")
        if tokenizer.vocab_size > text.vocab:
            raise UserError(
                f"{self.tokenizer_file} has {tokenizer.vocab_size} tokens, the text tower of {self.source} has "
                f"{text.vocab}; copy the tokenizer of its training"
            )
        texts = [texts] if isinstance(texts, str) else list(texts)
        if not all(isinstance(sentence, str) for sentence in texts):
            raise UserError("texts must be a string or a sequence of strings")
        ids, mask = tokenizer.encode(texts, text.length)
        return self._embeddings(tower, zip(ids, mask, strict=True), batch)

    def measure(
        self, frames: Any, background: npt.ArrayLike | None = None, sensor: str = UNIVERSAL, *,
        width_mm: float | None = None, log: Log = warn,
    ) -> Fields:  # fmt: skip
        """Return depth, shear, contact and force of B frames in mm and N, with their deviations.

        `frames` are those of the camera, not prepared: (h, w), (h, w, 3), (B, h, w, 3) or clips (B, T, h, w, 3), whose
        last frame is measured. A still shows little of slip. `background` is the untouched gel. A sensor that
        is not in `fields.GELS` needs `width_mm`, the mm that the picture's width shows. Without it lengths are shares
        of that width, and there is no force. Raises UserError if the weights do not measure.
        """
        measure = self.measure_of(sensor, background, width_mm, log)
        frames = arrays.as_array(frames, "frames")
        clips = as_clips(frames[..., None] if frames.ndim == 2 else frames)
        if clips.ndim != 5 or not len(clips):
            raise UserError(f"frames must be (h, w, 3), (B, h, w, 3) or clips (B, T, h, w, 3), not {frames.shape}")
        arrays.check_frames(self.config.model, clips.shape[1])
        clips = clips[:, -self.config.model.frames :]
        aspect, row = np.log(clips.shape[2] / clips.shape[3]), self.sensor_row(sensor, log)
        parts = []
        for start in range(0, len(clips), BATCH):
            part = clips[start : start + BATCH]
            ready = np.stack([[self.preprocess(frame, background) for frame in clip] for clip in part])
            numbers = np.full(len(part), row, np.int32), np.full(len(part), aspect, np.float32)
            parts.append(self.encode_and_measure(ready, *numbers)[1])
        out = FieldOutput._make(arrays.check_features(np.concatenate(values)) for values in zip(*parts, strict=True))
        return measure(out, [to_rgb(clip[-1], "the frame") for clip in clips])

    def measure_of(
        self, sensor: str, background: npt.ArrayLike | None = None, width_mm: float | None = None, log: Log = warn,
        *, rotate: int = 0, flip: Flip = "none",
    ) -> Measure:  # fmt: skip
        """Return what turns outputs for frames of a sensor into `Fields`: `stream` takes it. Raises UserError."""
        gel = None if background is None else to_rgb(arrays.as_array(background, "the background"), "the background")
        if not self.measures:
            raise missing(self.source)
        return Measure(scale_of(self.metadata, sensor, width_mm), sensor, gel, log, rotate, flip)

    @property
    def measures(self) -> bool:
        """Whether the weights measure depth, shear, contact and force."""
        return "fields" in self.others

    def encode_and_measure(
        self, clips: np.ndarray, rows: np.ndarray, aspect: np.ndarray, pooling: Pooling = "class"
    ) -> tuple[np.ndarray, FieldOutput]:
        """Return features and raw fields, see `nn.fields`, of prepared clips u8 (B, T, H, W, 3) in one pass.

        `rows` (B,) are those of the sensor, `aspect` (B,) logarithms of the pictures' height over width.
        """
        if self.measures and (run := self.exported(clips.shape[1], pooling, fields=True)) is not None:
            return run.measure(np.asarray(clips), np.asarray(rows), np.asarray(aspect))
        if (key := ("fields", pooling)) not in self._compiled:
            net = build(usable(self.whole or self.config.model))
            self._compiled[key] = jax.jit(partial(features_and_fields, net=net, pooling=pooling))
        with precision(self.config):
            values, out = self._compiled[key](self._placed_fields, *map(arrays.filled, (clips, rows, aspect)))
        return np.asarray(values)[: len(clips)], FieldOutput._make(np.asarray(x)[: len(clips)] for x in out)

    @cached_property
    def _placed_fields(self) -> Params:
        if not self.measures:
            raise missing(self.source)
        return self._placed | jax.device_put({"fields": self.part_params("fields")})

    def _embeddings(self, tower: Callable[[Any], jax.Array], items: Any, batch: int) -> np.ndarray:
        values = arrays.run_in_batches(lambda part: tower(jax.tree.map(arrays.filled, part)), items, batch)
        return values if len(values) else np.zeros((0, self.config.model.embed), np.float32)

    def similarity(
        self, touch: npt.ArrayLike, texts: str | Sequence[str] | np.ndarray, *, probabilities: bool = False
    ) -> np.ndarray:
        """Return the cosine similarity f32 (B, L) of touch features (B, E) and texts, or text embeddings (L, E).

        `probabilities` are their softmax with the learned temperature: a zero-shot classifier. UserError without a
        tower.
        """
        embeddings = texts if isinstance(texts, np.ndarray) and texts.dtype.kind == "f" else self.encode_text(texts)  # type: ignore[arg-type]
        z_touch, z_text = self._aligned(touch), np.asarray(embeddings, np.float32)
        if z_touch.ndim != 2 or z_text.ndim != 2 or z_touch.shape[1] != z_text.shape[1]:
            width = z_text.shape[-1]
            raise UserError(f"touch must be features (B, {width}) with pooling class, not {z_touch.shape}")
        cosine = _unit(z_touch) @ _unit(z_text).T
        if not probabilities:
            return np.asarray(np.clip(cosine, -1, 1))
        scale = self._part("scale", lambda net, params: net.scale(params), "logit_scale")
        return np.asarray(jax.nn.softmax(scale() * cosine, axis=1))

    def match(self, first: npt.ArrayLike, second: npt.ArrayLike) -> np.ndarray:
        """Return matching logits f32 (B,) of two sets of touch features (B, E), pooling class (Eq. 5).

        A positive logit predicts the same place. Raises UserError without a matching head, and for other shapes.
        """

        def run(net: Net, params: Params, first: jax.Array, second: jax.Array) -> jax.Array:
            return net.match(params, losses.normalise(first), losses.normalise(second))

        head, one, other = self._part("match", run, "matcher"), *(self._aligned(x) for x in (first, second))
        if one.shape != other.shape or one.ndim != 2:
            raise UserError(f"match takes two sets of features of one shape (B, E), not {one.shape}, {other.shape}")
        return np.asarray(head(arrays.filled(one), arrays.filled(other)))[: len(one)]

    def _aligned(self, touch: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Return what alignment and matching train of touch features (B, E + sight): not what sight adds."""
        values, model = np.asarray(touch, np.float32), self.config.model
        with_sight = values.ndim == 2 and values.shape[1] == model.embed + model.sight
        return values[:, : model.embed] if with_sight else values

    def _part(self, method: str, run: Callable[..., jax.Array], name: str, *more: str) -> Callable[..., jax.Array]:
        """Return `run` (net, params, ...) compiled with the parameters `name` and `more`, which go to the device."""
        params = {name: self.part_params(name)}
        if method not in self._compiled:
            params |= {key: self.others[key] for key in more if key in self.others}
            net = build(usable(self.whole or self.config.model))
            with precision(self.config):
                self._compiled[method] = partial(jax.jit(partial(run, net)), jax.device_put(params))
        compiled = self._compiled[method]

        def call(*arguments: Any) -> jax.Array:
            with precision(self.config):
                return compiled(*arguments)

        return call

    def part_params(self, name: str) -> Params:
        """Return the parameters of a part: image, text, decoder, matcher or logit_scale. Raises UserError."""
        if name not in self.others:
            raise UserError(f"{self.source} has no {_PART_NAMES.get(name, name)}; give a run or file that has one")
        return dict(self.others)[name]


class Preprocess:
    """Frames of one sensor in the form that an encoder was trained on.

    They are turned by `rotate` degrees, mirrored by `flip` (`data.transforms.orient_frame`) and resized. For an encoder
    that `subtracts`, the `background` (a picture of the untouched gel) is subtracted first, or the `untouched_gel` of
    `frames`. Without either, the first frame chooses among the `known` pictures of a head. If none is of its unit,
    `log` gets a warning, and the frames so far give a running estimate, as for an encoder that needs a background.

    >>> features = encoder.encode_touch(Preprocess(encoder, frames=frames)(camera.read()), "digit")
    """

    def __init__(
        self, encoder: Encoder, background: npt.ArrayLike | None = None, *,
        frames: Iterable[npt.ArrayLike] | None = None, rotate: int = 0, flip: Flip = "none",
        known: Mapping[str, np.ndarray] | None = None, log: Log = warn,
    ) -> None:  # fmt: skip
        if background is not None and frames is not None:
            raise UserError("Give a background, or the frames that it is taken from, not both.")
        self._prepare = encoder.bare().prepare  # workers get no parameters
        self._subtracts = encoder.subtracts
        self._orient = partial(orient_frame, rotate=rotate, flip=flip)
        self._known, self._log = dict(known or {}), log
        self._running = RunningGel() if encoder.needs_background or self._known else None
        self._background = None if frames is None else untouched_gel(frames)
        if background is not None:
            self._background = to_rgb(arrays.as_array(background, "the background"), "the background")
        self._gel: tuple[np.ndarray | None, np.ndarray] = None, np.zeros((0, 0, 3), np.uint8)

    @property
    def background(self) -> np.ndarray | None:
        """The picture of the untouched gel, RGB u8 (h, w, 3), as the camera takes it; None if there is none (yet)."""
        return self._running.picture if self._background is None and self._running else self._background

    @property
    def estimated(self) -> bool:
        """Whether the background is a running estimate that is not settled."""
        return self._background is None and self._running is not None and not self._running.settled

    def __repr__(self) -> str:
        gel, encoder = self._background, getattr(self._prepare, "__self__", None)
        known = "the first frame" if gel is None else f"a picture of {gel.shape[1]} x {gel.shape[0]}"
        used = f"minus {known}" if self._subtracts else "without a background"
        turned = " ".join(f"{name}={value!r}" for name, value in self._orient.keywords.items())
        return f"Preprocess(frames of {getattr(encoder, 'source', 'an encoder')}, {used}, {turned})"

    def __call__(self, frame: npt.ArrayLike) -> np.ndarray:
        """Return a camera's frame (h, w, 3), or grey, RGBA, u16 or floats in 0..1, as the encoder reads it."""
        frame = to_rgb(arrays.as_array(frame, "the frame"), "the frame")
        if self._background is None and self._known:
            known, self._known = self._known, {}
            gel, why = same_unit(known, frame)
            self._background = None if why else gel
            if why:
                self._log(other_unit(why))
        if self._background is None and self._running is not None:
            self._running.add(frame)
        frame, gel = np.ascontiguousarray(self._orient(frame)), self.background
        if gel is None or not self._subtracts:
            return self._prepare(frame)
        if self._gel[0] is not gel:
            self._gel = gel, np.ascontiguousarray(self._orient(gel))
        return self._prepare(frame, self._gel[1])


def _unit(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return rows divided by their length, or by 1e-12 if that is larger, as `losses.normalise`."""
    wide = np.asarray(values, np.float64)
    return np.asarray(wide / np.maximum(np.linalg.norm(wide, axis=-1, keepdims=True), 1e-12), np.float32)


def precision(config: Config) -> AbstractContextManager[Any]:
    """Return a context with 64 bits for a float64 model, else 32. Raises UserError if this process cannot use jax."""
    refuse_forked()
    return jax.enable_x64(config.model.dtype == "float64")


def as_clips(frames: Any) -> np.ndarray:
    """Return frames (H, W, 3), (B, H, W, 3) or (B, T, H, W, 3) as clips. Raises UserError for frames of two sizes."""
    frames = arrays.as_array(frames, "frames")
    return frames[None, None] if frames.ndim == 3 else frames[:, None] if frames.ndim == 4 else frames


def check_choices(pooling: Pooling, join: Join) -> None:
    """Raise UserError for another pooling or join than there are."""
    for name, value, kind in (("pooling", pooling, Pooling), ("join", join, Join)):
        if value not in get_args(kind):
            raise UserError(f"{name} is one of {', '.join(get_args(kind))}, not {value!r}")


def touch_features(
    params: Any, clips: jax.Array, sensor: jax.Array, *, net: Net, pooling: Pooling, join: Join
) -> jax.Array:
    """Return features f32 (B, E) of touches u8 (B, T, H, W, 3) and sensor rows (B,): a traceable `encode_touch`."""
    check_choices(pooling, join)
    clips = normalise_touch(clips)
    if pooling == "class":
        values = [net.encode_touch(params, clips, sensor, join)]
    else:
        both = net.encode_poolings(params, clips, sensor, join)  # an unused half is not computed
        values = [*(both if pooling == "both" else both[1:])]
    if net.model.sight:
        values.append(net.see(params, clips, sensor, join))
    return jnp.concatenate(values, axis=-1).astype(jnp.float32)


def features_and_fields(
    params: Any, clips: jax.Array, sensor: jax.Array, aspect: jax.Array, *, net: Net, pooling: Pooling
) -> tuple[jax.Array, FieldOutput]:
    """Return features f32 (B, E) and fields of touches u8 (B, T, H, W, 3), sensor rows and aspects (B,)."""
    check_choices(pooling, "mean")
    clips = normalise_touch(clips)
    token, mean, out = net.encode_and_measure(params, clips, sensor, aspect)
    values = {"class": [token], "mean": [mean], "both": [token, mean]}[pooling]
    if net.model.sight:
        values.append(net.see(params, clips, sensor))
    wide = jax.tree.map(lambda value: value.astype(jnp.float32), out)
    return jnp.concatenate(values, axis=-1).astype(jnp.float32), wide


def random_encoder(config: Config, seed: int = 0) -> Encoder:
    """Return an untrained encoder of the same form: the control of every probe."""
    config = touch_only(config)
    with precision(config):
        params = {"touch": build(config.model).init(jax.random.key(seed))["touch"]}
    return Encoder(config, params, f"random({seed})")


def bare_model(model: ModelConfig) -> ModelConfig:
    """Return a model without towers and heads."""
    return replace(usable(model), image=None, text=None, match_head="none", lora_rank=0, fields=0)


def touch_only(config: Config) -> Config:
    """Return the configuration of the touch encoder alone."""
    return replace(config, model=bare_model(config.model), data=replace(config.data, on_bad_sample="error"))
