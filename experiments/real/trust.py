"""Does a head know when it does not know, and does the health check find faults? Figures on recordings of your own.

    anytouch embed --data ../shared/real_touch2/manifest.csv --out known.npz
    anytouch embed --data ../shared/real_touch/manifest.csv --out others.npz
    python -m experiments.real.trust ../shared/real_touch2/manifest.csv --features known.npz --strange others.npz
    python -m experiments.real.trust ../shared/real_touch2/manifest.csv --health

Heads are fitted on split train, calibrated on train and val, and measured on test. Intervals are 95 %, over groups.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder import health, novelty
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, probing, splits, tasks
from anytouch_jax.evaluate.statistics import Array, markdown_table
from anytouch_jax.files import atomic_write, read_arrays
from experiments.command import run_script
from experiments.real.faults import FAULTS, most_different

DRAWS = 2000


@dataclass(frozen=True)
class TrustOptions:
    """Measure calibration, coverage, novelty and health."""

    data: Path  # Manifest.
    features: Path | None = None  # Its features, by anytouch embed.
    strange: Path | None = None  # Features of another manifest by the same encoder, for sensors never met.
    label: str = "object"  # Label column.
    group: str = ""  # Column of groups that no split cuts.
    penalty: float = 0.1  # Of the heads.
    coverage: float = 0.9
    false_alarms: float = 0.05
    held_out: int = 5  # Folds of classes that are left out in turn, for objects never met.
    health: bool = False  # Check the units, and made faults of them.
    skip_units: tuple[str, ...] = ("unknown",)  # Units whose name contains one of these are not in good order.
    out: Path | None = None  # Markdown page.


def interval(value: Any, groups: Array) -> str:
    """Return a figure of row numbers, and its interval under a bootstrap over groups."""
    rng, names = np.random.default_rng(0), np.unique(groups)
    members = [np.flatnonzero(groups == name) for name in names]
    draws = [value(np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))]))
             for _ in range(DRAWS // 10)]  # fmt: skip
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return f"{value(np.arange(len(groups))):.3f} ({low:.3f} to {high:.3f})"


def auroc(known: Array, strange: Array) -> float:
    """Return the chance that a strange score is above a known one."""
    order = np.argsort(np.argsort(np.concatenate([known, strange]), kind="stable"), kind="stable")
    above = order[len(known) :].sum() - len(strange) * (len(strange) - 1) / 2
    return float(above / (len(known) * len(strange)))


def calibration_error(p: Array, correct: Array, bins: int = 15) -> float:
    """Return the expected calibration error: the mean gap of confidence `p` (n,) and accuracy over bins of equal width.

    `correct` (n,) says whether the likeliest class was right (Guo et al. 2017, Eq. 5).
    """
    place = np.minimum((np.asarray(p) * bins).astype(int), bins - 1)
    sizes = np.bincount(place, minlength=bins)
    gaps = np.bincount(place, np.asarray(correct, float) - p, minlength=bins)
    return float(np.abs(gaps).sum() / max(sizes.sum(), 1))


def fitted(x: Array, y: Array, rows: tasks.TaskRows, keep: Array, options: TrustOptions) -> LinearHead:
    """Return a calibrated head of the train rows in `keep`, bool (n,)."""
    fit, val = (np.flatnonzero((rows.split == name) & keep) for name in ("train", "val"))
    names, numbers = np.unique(y, return_inverse=True)
    (model,) = heads.linear_path(x[fit], numbers[fit], (options.penalty,))
    head = heads.linear_head(model, names, label="", pooling="class", frames=1, fingerprint="")
    folds = splits.group_folds(fit, rows.groups, numbers, splits.FOLDS)
    return heads.calibrate(head, x, y, rows.groups, rows.sensors, fit, val, folds, options.penalty,
                           coverage=options.coverage, false_alarms=options.false_alarms)  # fmt: skip


def trust_table(options: TrustOptions) -> str:
    """Return the figures of calibration and novelty."""
    table, arrays = manifests.read(options.data), read_arrays(options.features or "")
    rows, _ = probing.label_rows(table, options.label, group=options.group)
    kept = np.isin(rows.rows[:, 0], arrays["rows"])
    rows = rows.take(np.flatnonzero(kept))
    place = np.argsort(arrays["rows"])
    x = arrays["features"][place[np.searchsorted(arrays["rows"][place], rows.rows[:, 0])]]
    y, everything = rows.labels, np.ones(len(rows.labels), bool)
    head = fitted(x, y, rows, everything, options)
    known = head.calibration
    assert known is not None
    test = np.flatnonzero((rows.split == "test") & np.isin(y, head.classes))
    seen, groups = head.assess(x[test]), rows.groups[test]
    right, p = seen.label == y[test], seen.p.max(1)
    plain = novelty.probabilities(head.scaled(x[test]) @ head.weights + head.bias)
    covered = seen.in_set[np.arange(len(test)), np.searchsorted(head.classes, y[test])]
    error = calibration_error
    lines = [
        ("accuracy", interval(lambda i: right[i].mean(), groups)),
        ("ECE before calibration", interval(lambda i: error(plain[i].max(1), right[i]), groups)),
        ("ECE", interval(lambda i: error(p[i], right[i]), groups)),
        (f"coverage of sets at {options.coverage:g}", interval(lambda i: covered[i].mean(), groups)),
        ("classes in a set, of " + str(len(head.classes)), f"{seen.in_set.sum(1).mean():.1f}"),
        (f"novel at {options.false_alarms:g}", interval(lambda i: seen.novel[i].mean(), groups)),
        ("groups in calibration, in test", f"{known.recordings}, {len(np.unique(groups))}"),
    ]
    classes, scores = np.random.default_rng(0).permutation(np.unique(y)), []
    for fold in range(options.held_out):
        out = np.isin(y, classes[fold :: options.held_out])
        part = fitted(x, y, rows, ~out, options)
        assert part.calibration is not None
        score = part.calibration.novelty(part.scaled(x[test]))
        scores.append(auroc(score[~out[test]], score[out[test]]))
    if scores:
        lines.append((f"AUROC, {options.label} never met (folds)", f"{np.mean(scores):.3f} ± {np.std(scores):.3f}"))
    if options.strange is not None:
        other = read_arrays(options.strange)
        sensors = other["key/sensor"]
        for name in np.setdiff1d(sensors, rows.sensors[rows.split == "train"]):
            score = known.novelty(head.scaled(other["features"][sensors == name]))
            both = np.concatenate([groups, [f"strange {i}" for i in range(len(score))]])
            every = np.concatenate([seen.novelty, score])

            def area(i: Array, every: Array = every, cut: int = len(groups)) -> float:
                return auroc(every[i[i < cut]], every[i[i >= cut]]) if (i >= cut).any() and (i < cut).any() else np.nan

            lines.append((f"AUROC, sensor {name} ({len(score)} frames)", interval(area, both)))
            lines.append((f"novel, sensor {name}", f"{(score > known.novelty_limit).mean():.3f}"))
    return markdown_table(("figure", "value"), lines)


def thinned(unit: health.UnitFrames) -> health.UnitFrames:
    """Return the unit with some nine recordings of two frames: faults of all pictures take minutes."""
    step = max(1, len(unit.recordings) // 8)
    return replace(unit, recordings=[recording[:3:2] for recording in unit.recordings[::step]])


def health_table(options: TrustOptions) -> str:
    """Return false alarms on the units, and the share of made faults that the right check reports."""
    units = [unit for unit in health.read_units(manifests.read(options.data))
             if not any(word in unit.unit for word in options.skip_units)]  # fmt: skip
    results = health.check_units(units, {})
    units = [thinned(unit) for unit in units]
    found, alarms, undecided = defaultdict[str, list[bool]](list), list[str](), defaultdict[str, int](int)
    for unit, result in zip(units, results, strict=True):
        others = [other for other in units if other.sensor == unit.sensor and other is not unit]
        references = [other.untouched() for other in others]
        alarms += [f"{unit.sensor} {unit.unit}: {check.name} ({check.value})" for check in result.faults]
        good = {check.name for check in result.checks if check.ok}
        for fault, (name, make) in FAULTS.items():
            other = most_different(unit, units)
            if name not in good or (other is None and fault == "two units mixed"):
                undecided[fault] += 1
                continue
            bad = make(unit, other, np.random.default_rng(0))
            (check,) = health.examine(bad, references, others, only=name).checks
            found[fault].append(check.ok is False)
    lines = [(fault, f"{sum(found[fault])} of {len(found[fault])}", undecided[fault]) for fault in FAULTS]
    every = [one for several in found.values() for one in several]
    lines.append(("all", f"{sum(every)} of {len(every)} ({np.mean(every):.1%})", ""))
    count = len({alarm.partition(":")[0] for alarm in alarms})
    text = f"False alarms: {count} of {len(units)} units. " + " ".join(alarms)
    return f"{text}\n\n{markdown_table(('made fault', 'reported', 'units where it cannot be decided'), lines)}"


def run(options: TrustOptions) -> int:
    """Print the tables, and write them with --out."""
    if options.features is None and not options.health:
        raise UserError("Give --features, by anytouch embed, or --health.")
    parts = [trust_table(options)] if options.features is not None else []
    parts += [health_table(options)] if options.health else []
    print("\n\n".join(parts))
    if options.out is not None:
        atomic_write(options.out, "\n\n".join(parts) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(run_script(TrustOptions, run))
