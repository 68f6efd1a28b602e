"""Options of fine-tuning: one record for Python, the command and the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.encoder.linear_head import COVERAGE, FALSE_ALARMS
from anytouch_jax.evaluate.tasks import Regression


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How head and encoder are trained. The defaults were chosen on validation recordings.

    Attributes:
        rate: learning rate of the encoder's last block.
        head_rate: learning rate of the head.
        depth_decay: factor on the rate from a block to the one before it (layer decay, Clark et
            al. 2020).
        weight_decay: of matrices.
        batch: touches of a step.
        passes: over the touches at most, because more of them learn the recordings by heart.
        smoothing: of the labels of classes.
    """

    rate: float = 6e-5
    head_rate: float = 2e-4
    depth_decay: float = 0.7
    weight_decay: float = 0.05
    batch: int = 32
    passes: int = 20
    smoothing: float = 0.1


@dataclass(frozen=True, kw_only=True)
class FinetuneOptions:
    """Options of `finetune`.

    Attributes:
        label: the column; the prefix "label." may be left out.
        minutes: of the whole run, on this machine.
        group: column whose values are held out whole, as in `LabelProbeOptions`.
        where: keep rows whose column is above a number.
        sensor: keep rows of this sensor.
        frames: of a touch: 1 for stills, 3 or more for the clip that ends at each row.
        pooling: class token, mean of the patch tokens, or both.
        regression: whether the label is a number, as in `ProbeOptions`.
        augment: shift, zoom and colour gain of the touches. A label that depends on the place of
            the contact needs False.
        coverage: fraction of touches whose set of classes (or interval) holds the truth.
        false_alarms: fraction of known touches that the head calls novel.
        seed: of all draws.
        recipe: how it is trained.
    """

    label: str = "object"
    minutes: float = 10.0
    group: str = ""
    where: tuple[str, float] | None = None
    sensor: str | None = None
    frames: int = 1
    pooling: Pooling = "both"
    regression: Regression = "auto"
    augment: bool = True
    coverage: float = COVERAGE
    false_alarms: float = FALSE_ALARMS
    seed: int = 0
    recipe: Recipe = Recipe()


@dataclass(frozen=True)
class State:
    """Where a run is, for a bar: the time left in seconds, and the scores on held-out recordings.

    `score` is the best so far, and `before` that of the linear head. Both are "" before the linear
    head is fitted. `looks` counts the looks at held-out recordings.
    """

    left: float
    score: str = ""
    before: str = ""
    looks: int = 0


Watch = Callable[[State], None]
