"""Configuration of a training run: losses, optimiser, data, schedule, and its strict JSON.

Frozen dataclasses without arrays. The comment of each field is its help text on the command line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal

from anytouch_jax.config import parsing
from anytouch_jax.config.model import ModelConfig
from anytouch_jax.config.parsing import (
    Above0,
    Below1,
    Count,
    NotNegative,
    Range,
    Ratio,
    Seed,
    check,
)
from anytouch_jax.config.scenes import SceneOptions
from anytouch_jax.errors import ConfigError
from anytouch_jax.renamed import fields
from anytouch_jax.shown import shown_short

Recipe = Literal["paper", "release"]
Towers = Literal["none", "scratch", "pretrained"]
PresetName = Literal["tiny", "small", "base", "large"]
# how often the release draws these in an epoch
RELEASE_WEIGHTS = (("touch_and_go", 2.0), ("octopi", 3.0))
# Mean and standard deviation of RGB in 0..1: touch images (ImageNet) and RGB images (CLIP), as in
# the release.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


@shown_short
@dataclass(frozen=True)
class LossConfig:
    """Weights and choices of the losses (Sec. 3.2 to 3.6 and appendix)."""

    mask_ratio: Ratio = 0.75  # Fraction of the patches that is masked.
    norm_pix_loss: bool = False  # Predict pixels that are normalised within each patch.
    next_frame: bool = True  # Predict the next frame of a clip too.
    # Predict what changes from the last frame to the next one. Not in the paper.
    next_frame_residual: bool = False
    alpha_tv: NotNegative[float] = 1.0  # Weight of touch and vision (Eq. 4).
    alpha_tl: NotNegative[float] = 1.0  # Weight of touch and text (Eq. 4).
    alpha_vl: NotNegative[float] = 0.2  # Weight of vision and text (Eq. 4).
    # Weight of cross-sensor matching relative to alignment (lambda, Eq. 9).
    match_weight: NotNegative[float] = 0.1
    match_keep: Annotated[float, Range(math.ulp(0.0), 1, "above 0, and 1 at most")] = 1.0
    """Fraction of the patches that matching encodes. Not in the paper (after FLIP)."""
    # Weight of depth, shear and force (--model.fields). Not in the paper.
    field_weight: NotNegative[float] = 0.1
    terms: NotNegative[tuple[tuple[str, float], ...]] = ()
    """Further terms of the loss (doors.OBJECTIVES) and their weights."""
    # Parts of the batch within which negatives stay. 1 uses the whole batch.
    groups: Count[int] = 1
    # Subtract the batch mean from embeddings, against collapse of untrained towers.
    center_embeddings: bool = False
    # Probability of the universal tokens at the first step (p_u, Sec. 3.5).
    universal_start: Ratio = 0.0
    # Probability of the universal tokens at the last step, reached linearly.
    universal_end: Ratio = 0.75

    def __post_init__(self) -> None:
        check(self, "--objective.")
        names = [name for name, _ in self.terms]
        if len(set(names)) < len(names):
            raise ConfigError(f"--objective.terms names an objective twice: {', '.join(names)}")
        if "fields" in names:
            raise ConfigError(
                "the weight of fields is --objective.field-weight; leave it out of "
                "--objective.terms"
            )
        if self.next_frame_residual and not self.next_frame:
            raise ConfigError(
                "--objective.next-frame-residual needs --objective.next-frame; remove one of them"
            )

    @property
    def keep_ratio(self) -> float:
        """Fraction of the patches that stays visible."""
        return 1.0 - self.mask_ratio


@shown_short
@dataclass(frozen=True)
class OptimConfig:
    """AdamW and its schedule (appendix "Implementation details")."""

    learning_rate: NotNegative[float] = 2e-4  # Highest learning rate, reached after the warm-up.
    min_rate: NotNegative[float] = 0.0  # Learning rate at the end.
    # Warm-up steps. None: one epoch, or a fraction of the run if that is shorter.
    warmup: NotNegative[int | None] = None
    decay: Literal["linear", "cosine"] = "linear"  # Form of the decay after the warm-up.
    beta1: Below1 = 0.9  # AdamW's decay of the first moment.
    beta2: Below1 = 0.99  # AdamW's decay of the second moment.
    # AdamW's epsilon.
    eps: Annotated[float, Range(1.2e-38, math.inf, "1.2e-38 or more (float32)")] = 1e-8
    weight_decay: NotNegative[float] = 0.1  # Weight decay of matrices. Vectors have none.
    # Learning-rate decay from a block of the touch encoder to the one before. 1: off.
    layer_decay: Ratio = 1.0
    grad_clip: Above0[float | None] = None  # Largest norm of the gradient. None: no limit.
    accumulate: Count[int] = 1  # Batches whose gradients make one update.

    def __post_init__(self) -> None:
        check(self, "--optim.")


@shown_short
@fields(clip_share="clip_fraction")
@dataclass(frozen=True)
class DataConfig:
    """Reading and augmentation of the data."""

    manifests: tuple[str, ...] = ()  # Manifests to train on (--data).
    split: str = "train"  # Split to train on.
    batch_size: Count[int] = 64  # Samples of a step (--batch).
    clip_fraction: Ratio = 0.5  # Fraction of clips. The rest are stills.
    # Batches of stills and clips: in turn, or mixed (release).
    order: Literal["alternate", "random"] = "alternate"
    weights: NotNegative[tuple[tuple[str, float], ...] | None] = None
    """Dataset and how often an epoch draws it. 0: never."""
    # Sensors of the negatives of matching: any, or the positive's.
    negatives: Literal["any", "same_sensor"] = "any"
    parts: NotNegative[int] = 0
    """Cut large data into this many parts of whole shards. A slot of a batch draws from its own
    part, so that a host reads its parts alone. 0: any row with any other. Stage 1 only.
    """
    # Draw only rows that have these modalities.
    require: tuple[Literal["image", "text"], ...] = ()
    # Leave out rows that label.contact marks as free. Unmarked rows stay.
    contact_only: bool = False
    aligned_text: bool = True  # Use the text of touches that other sensors or units recorded too.
    # Subtract the untouched gel (docs/sensor.md), or for half of the samples, at random. Not in the
    # paper.
    background: Literal["keep", "subtract", "either"] = "keep"
    flip: Ratio = 0.5  # Probability of a mirror image, for each direction.
    affine: NotNegative[tuple[float, float, float]] = (0.0, 0.0, 0.0)
    """Largest turn (degrees), shift and zoom (fractions of the side)."""
    jitter: NotNegative[tuple[float, float, float, float]] = (0.4, 0.4, 0.5, 0.3)
    """Brightness, contrast, saturation, hue."""
    rotation: NotNegative[float] = 20.0  # Largest rotation of RGB images, degrees.
    # Tokenizer file. None: the run's, else CLIP's, else trained on the captions.
    tokenizer: str | None = None
    threads: NotNegative[int] = 2  # Threads that read and augment.
    prefetch: NotNegative[int] = 4  # Batches prepared ahead.
    cache: NotNegative[int] = 512  # Memory for frames, MB.
    # Stop at a file that cannot be read, or replace and count it.
    on_bad_sample: Literal["error", "skip"] = "error"

    def __post_init__(self) -> None:
        check(self, "--data.")


@shown_short
@dataclass(frozen=True)
class SimulatedConfig:
    """Simulated touches that training draws from (--data simulated). No data set is written."""

    # Where a default differs from that of `SceneOptions`, it does so on purpose. This is what the
    # encoders of the package learned from, and wants variety: more objects, every camera, lighter
    # touches. That one is a small data set. Neither may change, because runs and data sets on disk
    # were made with them. The other seed makes the objects of the two different ones.
    objects: Count[int] = 480  # Objects of the catalogue, before a part of them is held out.
    variants: Count[int] = 1  # Objects of each kind, with other sizes and phases.
    seed: NotNegative[int] = 41  # Seed of the objects and of the kinds that are held out.
    sensors: tuple[str, ...] = (
        "gelsight_mini",
        "digit",
        "gelsight",
        "gelslim",
        "duragel",
        "9dtact",
    )
    """Sensors that are simulated: names, or folders NAME.sensor of `anytouch sensor fit`."""
    coarse: Ratio = 0.4  # Fraction of touches at which each sensor touches as by hand.
    # Fraction of touches by sensors that mix two others, for the universal tokens.
    wild: Ratio = 0.0
    depth: NotNegative[tuple[float, float]] = (0.15, 1.0)  # Range of the deepest press, mm.
    vision: Ratio = 0.4  # Fraction of touches with an RGB image.
    text: Ratio = SceneOptions.text  # Fraction of touches with a caption.
    places: Count[int] = 4  # Photographed places of each object.
    # Steps that draw from the same simulated touches, with new masks and augmentations.
    reuse: Count[int] = 1

    def __post_init__(self) -> None:
        check(self, "--simulated.")


@dataclass(frozen=True)
class RunConfig:
    """Course of one training run."""

    seed: Seed = 0  # Seed of every random draw.
    steps: Count[int] = 1000  # Steps of the whole schedule.
    save_every: NotNegative[int] = 200  # Steps between checkpoints. 0 saves the last one only.
    keep: Count[int] = 3  # Latest checkpoints to keep, besides the best one.
    figure_every: NotNegative[int] = 200  # Steps between images. 0: none.
    # Steps in a row that may be skipped for a loss or gradient that is not finite.
    max_skipped: NotNegative[int] = 20
    tensorboard: bool = False  # Write TensorBoard events too.
    fsdp: Count[int] = 1  # Devices that share parameters and optimiser moments.

    def __post_init__(self) -> None:
        check(self, "--run.")


@shown_short
@dataclass(frozen=True)
class Config:
    """A whole run. Build one with `preset(...)`, change it with `dataclasses.replace`."""

    model: ModelConfig
    stage: Literal[1, 2] = 1
    recipe: Recipe = "paper"
    towers: Towers = "none"
    preset: str = "custom"
    objective: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    data: DataConfig = field(default_factory=DataConfig)
    simulated: SimulatedConfig = field(default_factory=SimulatedConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self) -> None:
        check(self)

    def with_settings(self, settings: Mapping[str, Any]) -> Config:
        """Return a copy with other values of some settings, by section.field."""
        config = self
        for place, value in settings.items():
            section, name = place.split(".")
            config = replace(
                config, **{section: replace(getattr(config, section), **{name: value})}
            )
        return config

    @property
    def warmup(self) -> int:
        """Warm-up steps: as set, else a twentieth (stage 1) or a twelfth (stage 2) of the run."""
        if self.optim.warmup is not None:
            return self.optim.warmup
        return max(1, self.run.steps // (20 if self.stage == 1 else 12))

    @property
    def reconstructs(self) -> bool:
        """Whether batches need the next frame.

        Stage 1 does, and stage 2 of the release, which keeps the loss of stage 1.
        """
        return self.stage == 1 or self.recipe == "release"

    @property
    def splits_steps(self) -> bool:
        """Whether alignment and matching take turns in separate steps (stage 2 of the release)."""
        return self.stage == 2 and self.recipe == "release"

    @property
    def pair_weights(self) -> tuple[float, float, float]:
        """Factors of (TV, TL, VL) on the sum of both directions of InfoNCE (Eq. 4)."""
        objective = self.objective
        text = objective.alpha_tl / 2
        if self.recipe == "release":
            # The release does not halve touch and text, which gives twice the paper's weight.
            text = objective.alpha_tl
        return objective.alpha_tv / 2, text, objective.alpha_vl / 2

    @property
    def frozen(self) -> tuple[tuple[str, bool], ...]:
        """Rules (regex over parameter names, frozen?). The first match decides."""
        rules: list[tuple[str, bool]] = [(r"decoder/position$", True)]
        if self.towers == "pretrained":
            # LoRA adapts the image tower. The release trains what is outside of its blocks whole.
            image = r"image/blocks/" if self.recipe == "release" else r"image/"
            rules += [(r"text/", True), (image, True)]
        return (*rules, (r"", False))

    @property
    def weight_decay(self) -> tuple[tuple[str, float], ...]:
        """Rules (regex over parameter names, weight decay). Vectors have none (the release)."""
        return ((r"(bias|scale|class_token)$", 0.0), (r"", self.optim.weight_decay))


# Settings of older versions: new names, and below those that are gone, with the value that
# changes nothing.
_RENAMED = {
    ("objective", "centre"): "center_embeddings",
    ("optim", "clip_norm"): "grad_clip",
    ("data", "clip_share"): "clip_fraction",
}
_RECIPE = "what the recipe implies"
_RETIRED: dict[str, dict[str, Any]] = {
    "model": {"force_head": False},
    "objective": {
        "differences": 0.0,
        "force": 0.0,
        "touch_text_sum": _RECIPE,
        "reconstruct": _RECIPE,
        "universal_shared": _RECIPE,
    },
    "optim": {"ema": None},
    "data": {"split_steps": _RECIPE},
}


def to_json(config: Any) -> str:
    """Write a config dataclass as indented JSON. `from_json` reads it back to an equal value."""
    return json.dumps(asdict(config), indent=2)


def from_json(text: str, cls: type = Config, *, allow_retired: bool = True) -> Any:
    """Read a config written by `to_json`, of this version or an older one.

    Settings that no longer exist are dropped. With `allow_retired` False, one that changed the
    training is an error: the run cannot be continued. Raises ConfigError, which names an unknown,
    missing, mistyped or retired setting.
    """
    try:
        data = parsing.parse_json(text)
    except ConfigError as error:
        raise ConfigError(f"the configuration {error}") from None
    whole = data if cls is Config else {"model": data}
    if isinstance(whole, dict):
        _rename(whole)
        _drop_retired(whole, allow_retired=allow_retired)
    where = "config" if cls is Config else cls.__name__.lower()
    return parsing.read_value(cls, data, where)


def _rename(whole: dict[str, Any]) -> None:
    """Give the settings of older versions their new names, in place."""
    for (section, name), new_name in _RENAMED.items():
        settings = whole.get(section)
        if isinstance(settings, dict) and name in settings:
            settings[new_name] = settings.pop(name)


def _drop_retired(whole: dict[str, Any], *, allow_retired: bool) -> None:
    """Remove settings that no longer exist, in place. Raises ConfigError, see `from_json`."""
    for section, retired in _RETIRED.items():
        settings = whole.get(section)
        if not isinstance(settings, dict):
            continue
        for name in retired.keys() & settings.keys():
            value = settings.pop(name)
            inert = retired[name]
            if inert == _RECIPE:
                in_stage2 = whole.get("stage") == 2 or name == "touch_text_sum"
                inert = whole.get("recipe") == "release" and in_stage2
            if not allow_retired and value != inert:
                raise ConfigError(
                    f"the run sets {section}.{name} to {value!r}, which this version no longer "
                    "has. Continue it with version 0.1, or start a new run from it with --init."
                )
