"""Options of probes: one record for a label column, one for named tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from anytouch_jax.encoder.arrays import Aggregation, Pooling
from anytouch_jax.encoder.linear_head import COVERAGE, FALSE_ALARMS
from anytouch_jax.evaluate.feature_cache import FeatureSource, Order
from anytouch_jax.evaluate.heads import GradientRecipe, HeadName
from anytouch_jax.evaluate.statistics import Protocol
from anytouch_jax.evaluate.tasks import Regression, Task

Paths = Sequence[str | Path]
Tasks = Sequence[str | Task] | Literal["all"]
# names, run folders, weights files, or features that are at hand
Models = Sequence[str | Path | FeatureSource]


@dataclass(frozen=True, kw_only=True)
class ProbeOptions:
    """Options that all probes of manifests share.

    Attributes:
        features: .npz files with features of other encoders, as `anytouch embed` writes them.
        controls: also probe raw pixels, a random encoder, and an ImageNet network if its package is
            installed.
        cache: folder that keeps features by content, so that each frame is encoded once.
        out: file for the results as JSON.
        seeds: bootstraps of the train groups (a label), or random splits of the groups (tasks).
        protocol: "grouped" selects the penalty on validation data. "released" selects it on test,
            as the authors' released code does.
        pooling: class token, mean of the patch tokens, or both.
        aggregation: how the segments of a clip longer than the model's are joined.
        regression: whether the label is continuous. "auto" goes by its column: numbers with a
            fraction are. Then a score is R2, with the mean absolute error and Spearman's
            correlation beside it.
    """

    features: Paths = ()
    controls: bool = True
    cache: Path | None = None
    out: Path | None = None
    seeds: int = 5
    protocol: Protocol = "grouped"
    pooling: Pooling = "class"
    aggregation: Aggregation = "mean"
    regression: Regression = "auto"


@dataclass(frozen=True, kw_only=True)
class LabelProbeOptions(ProbeOptions):
    """Options of `probe_label`.

    Attributes:
        label: the column; the prefix "label." may be left out.
        group: column whose values never appear in two splits. By default the first of
            grasp_group, object, touch and sequence that the manifest has and that is not the label.
        leave_out: column of which every value is held out in turn, instead of the splits.
        where: keep rows whose column is above a number.
        sensor: keep rows of this sensor.
        train_sensor: fit on rows of this sensor, and test on rows of `test_sensor`.
        test_sensor: of the same classes.
        frames: of a touch: 1 for stills, 3 or more for the clip that ends at each row.
        save: file for the linear head of the only model, with its calibration.
        coverage: fraction of touches whose set of classes holds the true one, of a saved head.
        false_alarms: fraction of known touches that a saved head calls novel.
    """

    label: str = "object"
    group: str = ""
    leave_out: str | None = None
    where: tuple[str, float] | None = None
    sensor: str | None = None
    train_sensor: str | None = None
    test_sensor: str | None = None
    frames: int = 1
    save: Path | None = None
    coverage: float = COVERAGE
    false_alarms: float = FALSE_ALARMS


@dataclass(frozen=True, kw_only=True)
class TaskProbeOptions(ProbeOptions):
    """Options of `probe_tasks`.

    Attributes:
        heads: "linear", "knn" and "gradient", which is the authors'.
        frames: of a touch, instead of those of each task.
        order: shuffles the frames of clips, or repeats the last.
        max_rows: largest number of rows of a task, drawn with a fixed seed.
        universal: the universal tokens for all sensors.
        recipe: of the gradient head.
        paper: the accuracy of AnyTouch in the paper, for the table.
        train_sensors: names or patterns of the sensors to train on, all without any.
        test_sensors: those to test on.
        train_units: names or patterns of the sensor instances to train on.
        test_units: those to test on.
    """

    heads: Sequence[HeadName] = ("linear",)
    frames: int | None = None
    order: Order = "right"
    max_rows: int | None = None
    universal: bool = False
    recipe: GradientRecipe | None = None
    paper: float | None = None
    train_sensors: Sequence[str] | None = None
    test_sensors: Sequence[str] | None = None
    train_units: Sequence[str] | None = None
    test_units: Sequence[str] | None = None

    @property
    def sides(self) -> dict[str, Sequence[str] | None]:
        """The sensors and sensor instances of both sides of a split, by their names here."""
        return {
            "train_sensors": self.train_sensors,
            "test_sensors": self.test_sensors,
            "train_units": self.train_units,
            "test_units": self.test_units,
        }
