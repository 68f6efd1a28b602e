"""Does a head know when it does not know, and does the health check find faults? Figures on
recordings of your own.

    anytouch embed --data ../shared/real_touch2/manifest.csv --out known.npz --on-bad-sample skip
    anytouch embed --data ../shared/real_touch/manifest.csv --out others.npz --on-bad-sample skip
    python -m experiments.real.trust "real, object" ../shared/real_touch2/manifest.csv --features
    known.npz \\
        --strange others.npz
    python -m experiments.real.trust "real" ../shared/real_touch2/manifest.csv --health

Recordings are split at random, again and again: 60 % to fit a head, 20 % to calibrate it with parts
of the 60, and 20 % to test it. Intervals are 95 %, over groups of recordings. A line of each name
goes to `experiments/results/trust.jsonl`. `make results` makes the pages from that file alone.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, probing, splits
from anytouch_jax.evaluate.statistics import Array
from anytouch_jax.files import read_arrays
from anytouch_jax.live import health
from anytouch_jax.sim.sensing.sensors import SENSORS, bases
from experiments.command import run_script
from experiments.real.faults import FAULTS, most_different
from experiments.records import write_record

DRAWS = 200  # of a bootstrap over groups


@dataclass(frozen=True)
class TrustOptions:
    """Measure calibration, coverage and novelty, or with --health the faults of sensor units."""

    name: str  # Of the record.
    data: Path  # Manifest.
    features: Path | None = None  # Its features, by anytouch embed.
    # Features of another manifest by the same encoder, for sensors never met.
    strange: Path | None = None
    label: str = "object"  # Label column.
    group: str = ""  # Column of groups that no split cuts.
    penalty: float = 0.1  # Of the heads.
    coverage: float = 0.9
    false_alarms: float = 0.05
    # Random splits. With 20 of them the coverage of 36 groups is uncertain by 2 points.
    repeats: int = 100
    held_out: int = 5  # Folds of classes that are left out in turn, for classes never met.
    health: bool = False  # Check the units, and made faults of them.
    # With --health, compare with the real gels in the package too, for sensors of one unit.
    package: bool = False
    # Units whose name contains one of these are not in good order.
    skip_units: tuple[str, ...] = ("unknown",)
    out: Path = Path("experiments/results/trust.jsonl")  # JSON lines.


@dataclass(frozen=True, eq=False)
class Touches:
    """Features (n, d) with class names, groups and sensors (n,)."""

    x: Array
    y: Array
    groups: Array
    sensors: Array


def read_touches(options: TrustOptions) -> Touches:
    """Return the labelled rows of the manifest that have features. Raises UserError."""
    table = manifests.read(options.data)
    arrays = read_arrays(options.features or "")
    rows, _ = probing.label_rows(table, options.label, group=options.group)
    rows = rows.take(np.flatnonzero(np.isin(rows.rows[:, 0], arrays["rows"])))
    place = np.argsort(arrays["rows"])
    x = arrays["features"][place[np.searchsorted(arrays["rows"][place], rows.rows[:, 0])]]
    return Touches(x, rows.labels, rows.groups, rows.sensors)


def auroc(known: Array, strange: Array) -> float:
    """Return the chance that a strange score is above a known one."""
    order = np.argsort(np.argsort(np.concatenate([known, strange]), kind="stable"), kind="stable")
    above = order[len(known) :].sum() - len(strange) * (len(strange) - 1) / 2
    return float(above / (len(known) * len(strange)))


def calibration_error(p: Array, correct: Array, bins: int = 15) -> float:
    """Return the expected calibration error: the mean gap of confidence `p` (n,) and accuracy over
    bins of equal width.

    `correct` (n,) says whether the likeliest class was right (Guo et al. 2017, Eq. 5).
    """
    place = np.minimum((np.asarray(p) * bins).astype(int), bins - 1)
    sizes = np.bincount(place, minlength=bins)
    gaps = np.bincount(place, np.asarray(correct, float) - p, minlength=bins)
    return float(np.abs(gaps).sum() / max(sizes.sum(), 1))


def over_groups(value: Callable[[Array], float], groups: Array) -> list[float]:
    """Return a figure of row numbers, and the ends of its interval under a bootstrap over
    groups.
    """
    rng = np.random.default_rng(0)
    names = np.unique(groups)
    members = [np.flatnonzero(groups == name) for name in names]
    draws = [
        value(np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))]))
        for _ in range(DRAWS)
    ]
    return [value(np.arange(len(groups))), *map(float, np.nanpercentile(draws, [2.5, 97.5]))]


def random_split(groups: Array, seed: int) -> tuple[Array, Array, Array]:
    """Return masks (n,) of the rows to fit on, to calibrate on and to test, 60, 20 and 20 % of the
    groups.
    """
    names, ids = np.unique(groups, return_inverse=True)
    place = np.random.default_rng(seed).permutation(len(names))[ids] / len(names)
    return place < 0.6, (place >= 0.6) & (place < 0.8), place >= 0.8


def fitted(data: Touches, fit: Array, val: Array, options: TrustOptions) -> LinearHead:
    """Return a head of the rows of `fit`, calibrated on parts of them and on `val`, bool (n,)."""
    rows = np.flatnonzero(fit)
    names, numbers = np.unique(data.y, return_inverse=True)
    (model,) = heads.linear_path(data.x[rows], numbers[rows], (options.penalty,))
    head = heads.linear_head(model, names, label="", pooling="class", frames=1, fingerprint="")
    folds = splits.group_folds(rows, data.groups, numbers, splits.FOLDS)
    return heads.calibrate_head(
        head,
        data.x,
        data.y,
        data.groups,
        data.sensors,
        rows,
        np.flatnonzero(val),
        folds,
        options.penalty,
        coverage=options.coverage,
        false_alarms=options.false_alarms,
    )


def calibration_record(data: Touches, options: TrustOptions) -> dict[str, Any]:
    """Return accuracy, calibration error, coverage and false alarms on recordings that a head never
    met.
    """
    columns: dict[str, list[Array]] = defaultdict(list)
    counts = []
    for seed in range(options.repeats):
        fit, val, test = random_split(data.groups, seed)
        head = fitted(data, fit, val, options)
        assert head.calibration is not None
        counts.append(head.calibration.recordings)
        rows = np.flatnonzero(test & np.isin(data.y, head.classes))
        seen = head.assess(data.x[rows])
        y = data.y[rows]
        several = {
            "groups": data.groups[rows],
            "right": seen.label == y,
            "p": seen.p.max(1),
            "novel": seen.novel,
            "size": seen.in_set.sum(1),
            "sure": ~seen.abstains,
            "covered": seen.in_set[np.arange(len(rows)), np.searchsorted(head.classes, y)],
        }
        for name, values in several.items():
            columns[name].append(values)
    whole = {name: np.concatenate(values) for name, values in columns.items()}
    groups = whole["groups"]
    right = whole["right"]
    error = calibration_error
    weights = (
        1 / np.unique(groups, return_counts=True)[1][np.unique(groups, return_inverse=True)[1]]
    )

    def fraction(
        name: str,
    ) -> list[float]:  # a recording has the same weight, however many frames it has
        return over_groups(lambda i: float(np.average(whole[name][i], weights=weights[i])), groups)

    return {
        "accuracy": fraction("right"),
        "coverage": fraction("covered"),
        "novel": fraction("novel"),
        "decided": fraction("sure"),
        "ece": over_groups(lambda i: error(whole["p"][i], right[i]), groups),
        "size": float(whole["size"].mean()),
        "classes": len(np.unique(data.y)),
        "groups": len(np.unique(data.groups)),
        "calibration_groups": float(np.mean(counts)),
    }


def classes_never_met(data: Touches, options: TrustOptions) -> dict[str, list[float]]:
    """Return the AUROC of the novelty, and of a low probability, for classes that are left out of
    the fit in turn.
    """
    classes = np.random.default_rng(0).permutation(np.unique(data.y))
    parts = []
    for fold in range(options.held_out):
        out = np.isin(data.y, classes[fold :: options.held_out])
        (fit, val, test) = random_split(data.groups, fold)
        head = fitted(data, fit & ~out, val & ~out, options)
        seen = head.assess(data.x)
        rows = np.flatnonzero(test | out)
        parts.append((rows, out[rows], seen.novelty[rows], 1 - seen.p.max(1)[rows]))

    def area(column: int) -> Callable[[Array], float]:
        def mean(chosen: Array) -> float:
            counts = np.bincount(chosen, minlength=len(data.y))
            areas = []
            for rows, new, *scores in parts:
                times = counts[rows]
                score = scores[column]
                if times[new].any() and times[~new].any():
                    areas.append(
                        auroc(
                            np.repeat(score[~new], times[~new]), np.repeat(score[new], times[new])
                        )
                    )
            return float(np.mean(areas))

        return mean

    return {
        name: over_groups(area(i), data.groups)
        for i, name in enumerate(("novelty", "low probability"))
    }


def sensors_never_met(data: Touches, options: TrustOptions) -> dict[str, dict[str, Any]]:
    """Return the AUROC and the fraction called novel of each sensor that the head never met."""
    fit, val, test = random_split(data.groups, 0)
    head = fitted(data, fit, val, options)
    other = read_arrays(options.strange or "")
    result = {}
    assert head.calibration is not None
    known = head.assess(data.x[test]).novelty
    for name in np.setdiff1d(other["key/sensor"], data.sensors):
        of_sensor = other["key/sensor"] == name
        score = head.calibration.novelty(head.scaled(other["features"][of_sensor]))
        both = np.concatenate([known, score])
        groups = [*data.groups[test], *other["key/sequence"][of_sensor]]

        def area(i: Array, both: Array = both) -> float:
            old, new = (both[i[(i < len(known)) == is_known]] for is_known in (True, False))
            if len(old) and len(new):
                return auroc(old, new)
            return np.nan

        novel = float((score > head.calibration.novelty_limit).mean())
        result[str(name)] = {
            "auroc": over_groups(area, np.array(groups)),
            "novel": novel,
            "frames": len(score),
        }
    return result


def thinned(unit: health.UnitFrames) -> health.UnitFrames:
    """Return the unit with some nine recordings of two frames: faults of all images take
    minutes.
    """
    step = max(1, len(unit.recordings) // 8)
    return replace(unit, recordings=[recording[:3:2] for recording in unit.recordings[::step]])


def health_record(
    units: Sequence[health.UnitFrames], backgrounds: Mapping[str, list[Array]]
) -> dict[str, Any]:
    """Return false alarms on the units, and {fault: [reported, made, undecided]} of faults made
    from each.

    `backgrounds` are images of more untouched gels by sensor.
    """
    alarms = [
        f"{result.sensor} {result.unit}: {check.name} ({check.value})"
        for result in health.check_units(units, backgrounds)
        for check in result.faults
    ]
    units = [thinned(unit) for unit in units]
    counts = {fault: [0, 0, 0] for fault in FAULTS}
    for unit in units:
        others = [other for other in units if other.sensor == unit.sensor and other is not unit]
        references = [*backgrounds.get(unit.sensor, ()), *(other.untouched() for other in others)]
        good = {check.name for check in health.examine(unit, references, others).checks if check.ok}
        for fault, (name, make) in FAULTS.items():
            other = most_different(unit, units)
            if name not in good or (other is None and fault == "two units mixed"):
                counts[fault][2] += 1
                continue
            bad = make(unit, other, np.random.default_rng(0))
            (check,) = health.examine(bad, references, others, only=name).checks
            counts[fault][0] += check.ok is False
            counts[fault][1] += 1
    return {"units": len(units), "alarms": alarms, "faults": counts}


def run(options: TrustOptions) -> int:
    """Measure, store and print a record."""
    if options.health:
        units = [
            unit
            for unit in health.read_units(manifests.read(options.data))
            if not any(word in unit.unit for word in options.skip_units)
        ]
        real = [sensor for sensor in SENSORS.values() if options.package and sensor.real]
        backgrounds = {sensor.name: list((255 * bases(sensor)).astype("uint8")) for sensor in real}
        kind = "health"
        record = health_record(units, backgrounds)
    elif options.features is not None:
        data = read_touches(options)
        kind = "trust"
        record = calibration_record(data, options) | {
            "asked": options.coverage,
            "false_alarms": options.false_alarms,
            "repeats": options.repeats,
            "label": options.label,
            "never_met": classes_never_met(data, options) if options.held_out else {},
            "sensors": {} if options.strange is None else sensors_never_met(data, options),
        }
    else:
        raise UserError("Give --features, by anytouch embed, or --health.")
    write_record(options.out, f"{kind}/{options.name}", record)
    for name, value in record.items():
        print(f"{name}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(run_script(TrustOptions, run))
