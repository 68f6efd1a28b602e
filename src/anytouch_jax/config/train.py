"""The configuration of a training run: losses, optimiser, data, schedule. Frozen dataclasses, no arrays, no jax."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from anytouch_jax.config.model import ModelConfig
from anytouch_jax.config.parsing import ABOVE_0, BELOW_1, COUNT, NORMAL, NOT_NEGATIVE, SEED, SHARE, chosen, in_range

Recipe = Literal["paper", "release"]
Towers = Literal["none", "scratch", "pretrained"]
PresetName = Literal["tiny", "small", "base", "large"]
RELEASE_WEIGHTS = (("touch_and_go", 2.0), ("octopi", 3.0))  # how often the release draws these in an epoch
# Mean and spread of RGB in 0..1, for touch images (ImageNet) and for photographs (CLIP), as the release.
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True)
class LossConfig:
    """Weights and choices of the losses (Sec. 3.2 to 3.6 and appendix)."""

    mask_ratio: float = 0.75  # share of the patches that is hidden
    norm_pix_loss: bool = False  # predict pixels that are normalised within each patch
    next_frame: bool = True  # a clip predicts the frame after it, too
    alpha_tv: float = 1.0  # weight of touch and vision (Eq. 4)
    alpha_tl: float = 1.0  # weight of touch and text
    alpha_vl: float = 0.2  # weight of vision and text
    touch_text_sum: bool = False  # touch and text by alpha (the release) instead of alpha / 2 (Eq. 4)
    match_weight: float = 0.1  # weight of cross-sensor matching beside alignment
    match_keep: float = 1.0  # share of the patches that a touch keeps in matching (ours, after FLIP)
    reconstruct: bool = False  # keep the loss of stage 1 on the align batches of stage 2 (the release)
    groups: int = 1  # shares of the batch within which negatives stay; 1: the whole batch
    centre: bool = False  # embeddings less their batch mean (towers from scratch, which else collapse to a point)
    universal_start: float = 0.0  # share of samples that get the universal tokens, first step (Sec. 3.5)
    universal_end: float = 0.75  # ... and last step; linear in between
    universal_shared: bool = False  # one draw for the whole batch (the release)
    differences: float = 0.0  # stage 1: weight of the differences between frames (ours)
    force: float = 0.0  # stage 1: weight of force and its change, by model.force_head (ours)

    def __post_init__(self) -> None:
        shares = ("mask_ratio", "match_keep", "universal_start", "universal_end")
        in_range("--objective.", self, groups=COUNT, **dict.fromkeys(shares, SHARE))
        in_range("--objective.", self, match_keep=ABOVE_0)
        weights = ("alpha_tv", "alpha_tl", "alpha_vl", "match_weight", "differences", "force")
        in_range("--objective.", self, **dict.fromkeys(weights, NOT_NEGATIVE))

    @property
    def keep_ratio(self) -> float:
        """Share of the patches that stays visible."""
        return 1.0 - self.mask_ratio

    @property
    def pair_weights(self) -> tuple[float, float, float]:
        """Factors of (TV, TL, VL) on the sum of both directions of InfoNCE (Eq. 4)."""
        text = self.alpha_tl if self.touch_text_sum else self.alpha_tl / 2
        return self.alpha_tv / 2, text, self.alpha_vl / 2


@dataclass(frozen=True)
class OptimConfig:
    """AdamW and its schedule (appendix "Implementation details")."""

    learning_rate: float = 2e-4  # the highest, after the warm-up
    min_rate: float = 0.0  # the last one
    warmup: int | None = None  # steps; None: an epoch, or a share of the run where that is less
    decay: Literal["linear", "cosine"] = "linear"  # how the rate falls after the warm-up
    beta1: float = 0.9  # AdamW's
    beta2: float = 0.99  # AdamW's
    eps: float = 1e-8  # AdamW's
    weight_decay: float = 0.1  # of matrices; vectors have none
    layer_decay: float = 1.0  # rate of a layer of the touch encoder as a share of the next one's; 1: all alike (ours)
    clip_norm: float | None = None  # largest norm of the gradient; None: any
    ema: float | None = None  # decay of an average of the parameters, which is then what is used; None: no average
    accumulate: int = 1  # batches whose gradients make one update

    def __post_init__(self) -> None:
        chosen("--optim.", self)
        in_range("--optim.", self, beta1=BELOW_1, beta2=BELOW_1, clip_norm=ABOVE_0, ema=BELOW_1, accumulate=COUNT)
        in_range("--optim.", self, layer_decay=SHARE)
        in_range("--optim.", self, eps=NORMAL)  # without it a gradient of 0 is divided by 0
        others = ("learning_rate", "min_rate", "warmup", "weight_decay")
        in_range("--optim.", self, **dict.fromkeys(others, NOT_NEGATIVE))


@dataclass(frozen=True)
class DataConfig:
    """What is read and how it is augmented (`data` in config.json).

    `contact_only` is there because the paper's frames are contact frames; rows of which nothing is known stay, and a
    clip counts by its last frame. `background` "subtract" leaves the contact on middle grey, not the unit's own tint,
    lights and dots (beyond the paper; its successor does). `weights` None is what the recipe does: the release in stage
    2 RELEASE_WEIGHTS, where they are there.
    """

    manifests: tuple[str, ...] = ()  # files to train on (--data)
    split: str = "train"  # rows to train on
    batch_size: int = 64  # samples a step (--batch)
    clip_share: float = 0.5  # share of clips; the rest are stills
    order: Literal["alternate", "random"] = "alternate"  # stills and clips take turns, or are mixed (the release)
    split_steps: bool = False  # stage 2: align and match batches in separate steps (the release)
    weights: tuple[tuple[str, float], ...] | None = None  # dataset, times an epoch (0: never; 1 if not named)
    negatives: Literal["any", "same_sensor"] = "any"  # sensors of matching's negatives: any, the positive's
    require: tuple[Literal["image", "text"], ...] = ()  # draw only rows that have these
    contact_only: bool = False  # leave out rows that `label.contact` calls free (`anytouch data contact`)
    aligned_text: bool = True  # use the text of rows whose touch other sensors or units felt too
    background: Literal["keep", "subtract"] = "keep"  # as it is, or less the untouched gel (`background_path`)
    flip: float = 0.5  # chance of a mirror image, for each direction
    affine: tuple[float, float, float] = (0.0, 0.0, 0.0)  # at most: degrees, shift and growth as shares of the side
    jitter: tuple[float, float, float, float] = (0.4, 0.4, 0.5, 0.3)  # brightness, contrast, saturation, hue
    rotation: float = 20.0  # photographs are turned by so many degrees at most
    tokenizer: str | None = None  # file; None: the run's own, else CLIP's (--clip), else made of the captions
    threads: int = 2  # that read and augment
    prefetch: int = 4  # batches made ahead
    cache: int = 512  # MB of frames that are kept in memory
    on_bad_sample: Literal["error", "skip"] = "error"  # a file that cannot be read: stop, or replace and count it

    def __post_init__(self) -> None:
        chosen("--data.", self)
        in_range("--data.", self, batch_size=COUNT, clip_share=SHARE, flip=SHARE)
        others = ("affine", "jitter", "rotation", "threads", "prefetch", "cache")
        in_range("--data.", self, **dict.fromkeys(others, NOT_NEGATIVE))


@dataclass(frozen=True)
class RunConfig:
    """One training run (`run` in config.json)."""

    seed: int = 0  # of everything drawn
    steps: int = 1000  # of the whole schedule
    save_every: int = 200  # steps between checkpoints; 0: the last one alone
    keep: int = 3  # checkpoints that stay beside the best: the last ones
    figure_every: int = 200  # steps between pictures; 0: none
    max_skipped: int = 20  # steps in a row that may be skipped since loss or gradient is not finite
    tensorboard: bool = False  # write TensorBoard events too
    fsdp: int = 1  # devices that share parameters and moments

    def __post_init__(self) -> None:
        in_range("--run.", self, seed=SEED, steps=COUNT, keep=COUNT, fsdp=COUNT)
        in_range("--run.", self, save_every=NOT_NEGATIVE, figure_every=NOT_NEGATIVE, max_skipped=NOT_NEGATIVE)


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
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self) -> None:
        chosen("", self)

    @property
    def warmup(self) -> int:
        """Warm-up steps: as set, else a twentieth (stage 1) or a twelfth (stage 2) of the run."""
        if self.optim.warmup is not None:
            return self.optim.warmup
        return max(1, self.run.steps // (20 if self.stage == 1 else 12))

    @property
    def frozen(self) -> tuple[tuple[str, bool], ...]:
        """(regex over parameter names, frozen?) rules; the first match decides."""
        rules: list[tuple[str, bool]] = [(r"decoder/position$", True)]
        if self.towers == "pretrained":
            rules += [(r"text/", True), (r"image/blocks/" if self.recipe == "release" else r"image/", True)]
        return (*rules, (r"", False))

    @property
    def weight_decay(self) -> tuple[tuple[str, float], ...]:
        """(regex over parameter names, weight decay) rules: none for vectors (golden Q8)."""
        return ((r"(bias|scale|class_token)$", 0.0), (r"", self.optim.weight_decay))
