"""Encoders of other families, under the interface of `Encoder`: their own preprocessing, networks
and features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from PIL import Image

from anytouch_jax.config import UNIVERSAL, Config, DataConfig, check_spelling
from anytouch_jax.data.images import decode, to_rgb
from anytouch_jax.encoder.arrays import Aggregation, Log, Pooling, warn
from anytouch_jax.encoder.base import Encoder, as_clips, check_choices, precision
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Part
from anytouch_jax.nn.vit import Vit, VitConfig, VitOutput
from anytouch_jax.ops import losses
from anytouch_jax.renamed import keywords
from anytouch_jax.weights.tree import nest
from anytouch_jax.zoo import families
from anytouch_jax.zoo.efficientnet import ConvEncoder, ConvModel, conv_encoder
from anytouch_jax.zoo.families import Family, FamilyModel, Preparation, Size

Params = dict[str, Any]
_FALLBACK = "gs_green"  # the file that T3's authors take for a sensor without a file
# SITR's choices of its 18
_CALIBRATIONS = {4: (1, 3, 7, 9), 8: (1, 3, 7, 9, 10, 12, 16, 18), 9: tuple(range(1, 10))}


@dataclass(frozen=True, repr=False)
class FamilyEncoder(Encoder):
    """An encoder of another family: `form` describes its network in full, `preparation` what
    `preprocess` does.
    """

    family: Family = field(kw_only=True)
    form: VitConfig = field(kw_only=True)
    preparation: Preparation = field(kw_only=True)
    image_size: Size = field(kw_only=True)
    calibration: np.ndarray | None = field(default=None, kw_only=True, repr=False)

    def about(self) -> dict[str, str]:
        """Return what a user wants to know, from `describe_family`."""
        title, *lines = describe_family(self)
        family, _, rest = title.partition(": ")
        count, _, form = rest.partition(" parameters, ")
        more = dict(line.split(": ", 1) for line in lines if ": " in line)
        shown = ("input", "features", "sensors")
        return {
            "family": f"{family}, {form}",
            "parameters": count,
            **{name: more[name] for name in shown},
        }

    @property
    def part(self) -> Part:
        """The network, with the arithmetic of `config`."""
        return Part(Vit, replace(self.form, model=self.config.model))

    @property
    def blank(self) -> np.ndarray:
        """A prepared frame of zeros, f32 (height, width, 3)."""
        return np.zeros((*self.image_size, 3), np.float32)

    def input_form(self, frames: int) -> dict[str, Any]:
        """Return what an exported encoder says about its input, and the steps of its
        preparation.
        """
        shape = ", ".join(map(str, self.image_size))
        return {
            "input": (
                f"frames: float32 (B, {frames}, {shape}, 3), oldest first, each from "
                f"encoder.preprocess of {self.family.title}; sensor: int32 (B,)"
            ),
            "preparation": asdict(self.preparation),
            "frame_shape": [*self.image_size, 3],
            "frame_dtype": "float32",
        }

    @property
    def contract(self) -> str:
        """Everything but the parameters that decides its features, as text."""
        calibration = None if self.calibration is None else self.calibration.tobytes()
        form = asdict(self.form)
        return repr(
            (
                super().contract,
                self.family.name,
                form,
                self.preparation,
                self.image_size,
                calibration,
            )
        )

    def untrained(self, seed: int = 0) -> Encoder:
        """Return an untrained encoder of the same form and preparation."""
        with precision(self.config):
            fresh = self.part.init(jax.random.key(seed))
            fresh = jax.tree.map(
                lambda x, trained: jnp.broadcast_to(x, trained.shape), fresh, self.params
            )
        computed = {name: self.params[name] for name in ("frequency", "periods") if name in fresh}
        return replace(self, params=fresh | computed, source=f"random({seed})")

    def bare(self) -> Encoder:
        """Return what prepares frames, without parameters."""
        return replace(self, params={})

    def sensor_row(self, name: str, log: Log = warn) -> int:
        """Return the row of a sensor. A family without sensors ignores it, which is logged once."""
        names = self.config.model.sensors
        name = families.ALIASES.get(str(name), str(name))
        check_spelling(name, names)
        if len(names) == 1:
            if name != UNIVERSAL and "sensor" not in self._logged:
                self._logged.add("sensor")
                log(f"{self.family.title} does not know sensors: the sensor {name!r} is ignored")
            return 0
        if name in names and (name != UNIVERSAL or self.form.model.sensor_tokens):
            return names.index(name)
        if self.form.model.sensor_tokens:
            log(f"sensor {name!r} has no tokens in {self.source}: using the universal tokens")
            return names.index(UNIVERSAL)
        if len(names) > 2 and _FALLBACK not in names:
            raise UserError(
                f"{self.source} has no file for sensor {name!r}; choose one of "
                f"{', '.join(names[:-1])}"
            )
        used = names[0] if len(names) == 2 else _FALLBACK
        log(f"there is no file for sensor {name!r}: using that of {used}")
        return names.index(used)

    @cached_property
    def _logged(self) -> set[str]:
        return set()

    def prepare(self, frame: np.ndarray, background: np.ndarray | None = None) -> np.ndarray:
        """Return a frame u8 (h, w, 3) as the network reads it, f32 (height, width, 3).

        Raises UserError.
        """
        return prepare(frame, background, self.preparation, self.image_size)

    def calibrated(
        self, frames: Sequence[npt.ArrayLike], background: npt.ArrayLike
    ) -> FamilyEncoder:
        """Return the encoder of a sensor with SITR's calibration images, and the image of its
        untouched gel.

        `frames` are 9 presses of a sphere, then 9 of a cube's corner, row by row. Raises UserError
        for another number.
        """
        need = self.form.calibration
        if not need:
            raise UserError(f"{self.family.title} has no calibration images")
        if len(frames) == 18 and need in _CALIBRATIONS:
            frames = [frames[place - 1] for place in _CALIBRATIONS[need]]
        if len(frames) != need:
            raise UserError(
                f"{self.source} needs {need} calibration images (or all 18), not {len(frames)}"
            )
        gel = to_rgb(np.asarray(background), "the background")
        images = [self.prepare(to_rgb(np.asarray(x), "a calibration image"), gel) for x in frames]
        return replace(self, calibration=np.stack(images))

    @keywords(join="aggregation")
    def encode_touch(
        self,
        frames: Any,
        sensor: str | Sequence[str] | np.ndarray = UNIVERSAL,
        *,
        pooling: Pooling = "class",
        aggregation: Aggregation = "mean",
    ) -> np.ndarray:
        """Return features f32 (B, E) of prepared frames (B, T, H, W, 3), (B, H, W, 3) or (H, W, 3),
        oldest first.

        A family of clips takes exactly its frames, or enough consecutive ones to choose them at its
        stride, or a still. One of stills takes any number, and their features are joined. `pooling`
        "class" is the family's own feature. H and W may be others than `image_size` if the
        positions allow it. Raises UserError for another shape or type.
        """
        return self._encode(
            self._checked(frames),
            sensor,
            self.traceable(pooling, aggregation),
            (pooling, aggregation),
        )

    def encode_tokens(
        self, frames: Any, sensor: str | Sequence[str] | np.ndarray = UNIVERSAL
    ) -> np.ndarray:
        """Return the tokens f32 (B, S, D) that the family's authors publish, for frames as in
        `encode_touch`.
        """
        return self._encode(self._checked(frames), sensor, self._tokens, "tokens")

    def _checked(self, frames: Any) -> np.ndarray:
        frames = as_clips(frames)
        patch = self.form.model.patch
        fixed = self.form.resample == "none" and self.form.grid is not None
        sides = frames.shape[2:4]
        is_clip = frames.ndim == 5 and frames.shape[-1] == 3
        fits = (
            sides == tuple(self.image_size)
            if fixed
            else all(side and not side % patch for side in sides)
        )
        if frames.dtype != np.float32 or not is_clip or not fits:
            high, wide = self.image_size
            raise UserError(
                f"frames must be float32 of {high} x {wide} pixels, (B, T, {high}, {wide}, 3), not "
                f"{frames.dtype} {frames.shape}; prepare each frame with encoder.preprocess(frame)"
            )
        return frames

    @keywords(join="aggregation")
    def traceable(
        self, pooling: Pooling = "class", aggregation: Aggregation = "mean"
    ) -> Callable[..., jax.Array]:
        """Return the function from params, frames (B, T, H, W, 3) and sensor rows (B,) to features
        (B, E).
        """
        return partial(self._features, pooling=pooling, aggregation=aggregation)

    def _features(
        self,
        params: Any,
        clips: jax.Array,
        rows: jax.Array,
        *,
        pooling: Pooling,
        aggregation: Aggregation,
    ) -> jax.Array:
        check_choices(pooling, aggregation)
        clips = self._clips(clips)
        parts = []
        # one for a family of clips
        for part in jnp.moveaxis(clips, 1, 0):
            parts.append(pooled(self.family, self.form, self._run(params, part, rows), pooling))
        if aggregation == "concat":
            return jnp.concatenate(parts, axis=-1).astype(jnp.float32)
        total = reduce(jnp.add, parts)
        return (total / len(parts) if aggregation == "mean" else total).astype(jnp.float32)

    def _tokens(self, params: Any, clips: jax.Array, rows: jax.Array) -> jax.Array:
        clips = self._clips(clips)
        if clips.shape[1] > 1:
            raise UserError(
                f"{self.family.title} gives the tokens of one frame, not of {clips.shape[1]}"
            )
        output = self._run(params, clips[:, 0], rows)
        return {
            "hidden": output.hidden,
            "normed": output.normed,
            "patches": output.normed[:, self.form.start :],
        }[self.family.tokens].astype(jnp.float32)

    def _clips(self, clips: jax.Array) -> jax.Array:
        """Return the network's clips (B, P, F, H, W, 3): P is 1 for a family of clips, and F is 1
        for one of stills.
        """
        count = self.form.model.frames
        stride = self.preparation.stride
        given = clips.shape[1]
        span = (self.form.model.frames - 1) * self.preparation.stride + 1
        if count == 1:
            return clips[:, :, None]
        if given == 1:
            clips = jnp.repeat(clips, count, axis=1)
        elif given >= span:
            clips = clips[:, given - span :: stride]
        elif given != count:
            raise UserError(
                f"{self.family.title} takes 1 frame, {count} frames ({stride} apart), or at least "
                f"{span} consecutive ones, not {given}"
            )
        return (clips[:, ::-1] if self.preparation.newest_first else clips)[:, None]

    def _run(self, params: Any, clips: jax.Array, rows: jax.Array) -> VitOutput:
        if self.form.calibration and self.calibration is None:
            raise UserError(
                f"{self.family.title} needs the calibration images of the sensor: "
                "encoder.calibrated(frames, background), or a folder calibration beside the "
                "weights with 0000.png (the untouched gel) to 0018.png"
            )
        network = self.part
        more = () if self.calibration is None else (jnp.asarray(self.calibration),)
        if self.family.name != "t3" or len(self.form.model.sensors) <= 2:
            output: VitOutput = network.apply(params, clips, rows, *more)
            return output

        names = self.form.model.sensors
        other = names.index(_FALLBACK) if _FALLBACK in names else 0
        rows = jnp.where(rows == len(names) - 1, other, rows)

        def one(item: tuple[jax.Array, jax.Array]) -> VitOutput:
            own = {
                name: x if name in families.SHARED else jax.tree.map(lambda x: x[item[1]], x)
                for name, x in params.items()
            }
            output: VitOutput = network.apply(own, item[0][None], item[1][None])
            return VitOutput(*(x[0] for x in output))

        return jax.lax.map(one, (clips, rows))


def pooled(family: Family, form: VitConfig, output: VitOutput, pooling: Pooling) -> jax.Array:
    """Return features (B, E) from the tokens of a family: its own feature, the mean of the patches,
    or both.

    Args:
        family: the kind of encoder.
        form: sizes of its network.
        output: tokens of the network.
        pooling: "class" for the family's own feature, "mean" or "both".
    """
    patches = output.projected if family.feature == "projected" else output.normed
    mean = jnp.mean(patches[:, form.start :], axis=1)
    own = {"class": output.normed, "mean": output.normed}.get(family.feature, output.projected)[
        :, 0
    ]
    if family.feature == "unit":
        own = losses.normalise(own)
    own = (
        mean if family.feature == "mean" or (family.feature == "pooled" and not form.pool) else own
    )
    if pooling != "both":
        return {"class": own, "mean": mean}[pooling]
    return jnp.concatenate([own, mean], axis=-1)


def prepare(
    frame: np.ndarray, background: np.ndarray | None, steps: Preparation, size: Size
) -> np.ndarray:
    """Return a frame u8 (h, w, 3) prepared by the steps of a family, f32 (height, width, 3) of
    `size`.

    Args:
        frame: u8 (h, w, 3).
        background: the untouched gel u8 (h, w, 3), if there is one.
        steps: of the family.
        size: (height, width) of the result.
    """
    if background is not None and background.shape != frame.shape:
        if (
            abs(background.shape[1] * frame.shape[0] / (background.shape[0] * frame.shape[1]) - 1)
            > 0.05
        ):
            raise UserError(
                f"the background {background.shape} and the frame {frame.shape} have other "
                "proportions"
            )
        background = cv2.resize(background, frame.shape[1::-1], interpolation=cv2.INTER_AREA)
    image = frame
    if background is not None and steps.difference == "levels":  # 127: the authors truncate 127.5
        image = np.clip(frame.astype(np.int16) - background + 127, 0, 255).astype(np.uint8)
    elif background is not None and steps.difference == "offset":
        image = np.clip((frame.astype(np.float32) - background + 130) / np.float32(255), 0, 1)
    elif background is not None and steps.difference == "plain":
        image = frame.astype(np.float32) - background
    image = np.rot90(image, -1) if steps.portrait and image.shape[1] > image.shape[0] else image
    high, wide = image.shape[:2]
    if steps.crop == "rows" and high / wide != 4 / 3:
        kept = int(high * 3 / 4)
        image = image[int((high - kept) / 2) : int((high + kept) / 2)]
    elif steps.crop == "square" and image.shape[:2] != size:
        side = min(high, wide)
        image = image[(high - side) // 2 :][:side, (wide - side) // 2 :][:, :side]
    elif steps.crop == "centre":
        shorter = steps.shorter or round(max(size) * 8 / 7)
        short = min(high, wide)
        image = _resized(
            image, (int(shorter * high / short), int(shorter * wide / short)), steps.filter
        )
        top, left = (
            round((there - wanted) / 2) for there, wanted in zip(image.shape[:2], size, strict=True)
        )
        image = image[top : top + size[0], left : left + size[1]]
    image = _resized(image, size, steps.filter)
    image = image.astype(np.float32) / np.float32(255) if image.dtype == np.uint8 else image
    return (image - np.asarray(steps.mean, np.float32)) / np.asarray(steps.std, np.float32)


def _resized(image: np.ndarray, size: Size, kernel: str) -> np.ndarray:
    """Resize by Pillow, with its antialiasing; floats stay floats."""
    if image.shape[:2] == size:
        return image
    resampling = Image.Resampling[kernel.upper()]
    if image.dtype == np.uint8:
        return np.asarray(
            Image.fromarray(np.ascontiguousarray(image)).resize((size[1], size[0]), resampling)
        )
    planes = (Image.fromarray(np.ascontiguousarray(image[..., colour])) for colour in range(3))
    return np.stack(
        [np.asarray(plane.resize((size[1], size[0]), resampling)) for plane in planes], axis=-1
    )


def family_encoder(
    model: FamilyModel | ConvModel, source: str, path: Path
) -> FamilyEncoder | ConvEncoder:
    """Return the encoder of what a file of a family has.

    SITR's calibration images may be next to it.
    """
    if isinstance(model, ConvModel):
        return conv_encoder(model, source)
    background = model.preparation.background
    encoder = FamilyEncoder(
        Config(model.form.model, data=DataConfig(background=background)),
        nest(model.params),
        source,
        family=model.family,
        form=model.form,
        preparation=model.preparation,
        image_size=model.image_size,
    )
    images = sorted((path if path.is_dir() else path.parent).glob("calibration/[0-9]*.png"))
    if model.form.calibration and len(images) > 1:
        gel, *frames = (decode(image) for image in images)
        encoder = encoder.calibrated(frames, gel)
    return encoder


def describe_family(encoder: FamilyEncoder | ConvEncoder) -> list[str]:
    """Return lines about a family's encoder: size, licence, sensors, input."""
    if isinstance(encoder, ConvEncoder):
        return [f"{name}: {value}" for name, value in encoder.about().items()]
    form = encoder.form
    steps = encoder.preparation
    (high, wide) = encoder.image_size
    count = sum(np.size(leaf) for leaf in jax.tree.leaves(encoder.params)) / 1e6
    frames = (
        "one frame"
        if form.model.frames == 1
        else f"{form.model.frames} frames, {steps.stride} apart,"
    )
    names = ", ".join(name for name in form.model.sensors if name != UNIVERSAL)
    settings = (
        f"{name} {value}"
        for name, value in asdict(steps).items()
        if value not in (False, "none", None)
    )
    kinds = {
        "mean": "the mean of its patch tokens",
        "unit": "a unit-norm embedding",
        "pooled": "from its pooling head",
    }
    feature = kinds.get(
        "mean" if encoder.family.feature == "pooled" and not form.pool else encoder.family.feature
    )
    return [
        f"{encoder.family.title}: {count:.1f} M parameters, width {form.model.touch.width}, depth "
        f"{form.model.touch.depth + form.trunk}, {form.model.touch.heads} heads",
        f"licence of the weights: {encoder.family.licence}",
        f"sensors: {encoder.family.sensors}" + (f" (--sensor: {names})" if names else ""),
        f"input: {frames} of {high} x {wide} pixels in patches of {form.model.patch}",
        f"preparation: {', '.join(settings)}",
        f"features: {form.model.embed} values, {feature or 'from the class token'}",
        "use it with embed, stream, probe, retrieve and export --to jax",
    ]
