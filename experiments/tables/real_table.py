"""The section on real touch: probes beside raw pixels and an untrained encoder, differences paired by test frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from anytouch_jax.evaluate.statistics import markdown, verdict
from anytouch_jax.evaluate.statistics import seed_interval as interval
from experiments.tables.questions import Part
from experiments.tables.real import OURS, PIXELS, UNTRAINED
from experiments.tables.results import Change, Run
from experiments.tables.tables import Statement


def real(runs: Sequence[Run]) -> Part:
    """Object and slip: whether ours is above raw pixels and above an untrained encoder by more than the interval."""
    several = [run for run in runs if run.question == "real"]
    if not several:
        return Part(_TITLE, "**Not run.**", [Statement("real touch", Change("not run"), {})])
    tasks = list(dict.fromkeys(row["task"] for run in several for row in run.about["rows"]))
    lines, statements = [], []
    for task in tasks:
        views = list(dict.fromkeys(r["view"] for run in several for r in run.about["rows"] if r["task"] == task))
        for view in views:
            cells = _over_seeds(several, task, view)
            lines.append((task, view, *cells))
        statements += [ahead(several, task, name) for name in (PIXELS, UNTRAINED)]
    text = (
        "Stages 1 and 2 on the simulated data and the training split of the pack; GelSight Mini with markers, frames\n"
        "in contact. Object: test recordings. Every recording tested (ten folds), slip and fingers: recordings of all\n"
        "splits, so the encoder (not the probe) has seen most of them in pre-training: without labels, but with\n"
        "captions and photographs of some.\n"
        "The paper has no such probe: tested is that ours is above the controls by more than the interval, in every\n"
        "seed. Each number is of one fit (for slip one a fold), not the mean of five deals as in the tables above.\n"
        "Fingers: trained on the units of one camera, tested on those of the other; the two fingers of a grasp are on\n"
        "both sides, so this is another gel and camera, not another grasp. Each gel felt objects of its own beside\n"
        "two that several felt, so the commonest answers of one are mostly wrong of the other.\n\n"
    )
    between = "95 % over test groups, by seed"
    head = ("task", "features", "accuracy, mean over seeds", between, "commonest", "test frames")
    table = markdown(head, lines)
    said = "\n".join(f"- {one.label}: **{one.row.word}**{_by_seed(one)}." for one in statements)
    return Part(_TITLE, f"{text}{table}\n\n{said}", statements)


_TITLE = "Real touch"


def ahead(runs: Sequence[Run], task: str, name: str) -> Statement:
    """Whether ours is above a control: in each seed the paired interval over test groups is above zero."""
    found = [
        row for run in runs for row in run.about["rows"] if (row["task"], row["view"]) == (task, f"{OURS} - {name}")
    ]
    means = [100 * row["mean"] for row in found]
    label = f"{task}: above {'raw pixels' if name == PIXELS else 'an untrained encoder'}"
    low, high = interval(means)
    if not found:
        return Statement(label, Change("not run"), {})
    words = {verdict(row["low"], row["high"], len(found)) for row in found}
    word = words.pop() if len(words) == 1 else "undecided"
    each = {f"seed {i}": Change("", *(None if row[k] is None else 100 * row[k] for k in ("mean", "low", "high")))
            for i, row in enumerate(found)}  # fmt: skip
    return Statement(label, Change(word, float(np.mean(means)), low, high, len(found)), each)


def _by_seed(one: Statement) -> str:
    found = [f"{c.mean:+.1f} ({c.low:+.1f} to {c.high:+.1f})" if c.low is not None and c.high is not None else "-"
             for c in one.columns.values()]  # fmt: skip
    return f", by seed {'; '.join(found)}" if found else ""


def _over_seeds(runs: Sequence[Run], task: str, view: str) -> tuple[str, str, str, str]:
    rows = [row for run in runs for row in run.about["rows"] if (row["task"], row["view"]) == (task, view)]
    rows = [row for row in rows if row["mean"] is not None]
    if not rows:
        return "-", "-", "-", "-"
    common = f"{100 * rows[0]['chance']:.1f}" if "chance" in rows[0] else "-"
    between = [f"{100 * row['low']:.1f} to {100 * row['high']:.1f}" if row["low"] is not None else "-" for row in rows]
    return (
        f"{100 * np.mean([row['mean'] for row in rows]):.1f}",
        "; ".join(between),
        common,
        str(rows[0].get("test", "")),
    )
