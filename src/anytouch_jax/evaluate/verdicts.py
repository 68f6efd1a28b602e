"""Verdicts: a sentence on each set of features against the best control of a probe.

A control is what a user has without the encoder: raw pixels, an untrained network. Compared is with
the best of them by any head, since beating a weak control shows nothing. Differences are paired:
both are scored on the same test rows, and the interval is of the difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from anytouch_jax.evaluate import statistics
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.sources import CONTROLS
from anytouch_jax.evaluate.statistics import RANDOM, GroupSums

# the test rows of every seed, by (features, task, head, protocol)
Runs = dict[tuple[str, ...], list[GroupSums]]
Gain = Mapping[str, float | None]


class ScoredHead(NamedTuple):
    """A head on one set of features: its test rows, one for each seed."""

    features: str
    head: str
    runs: Sequence[GroupSums]

    @property
    def name(self) -> str:
        """Features and head, to stand in a sentence."""
        if self.features == RANDOM:
            return f"an untrained encoder ({self.head})"
        if not self.head:
            return f"the {self.features}"
        return f"{self.features} ({self.head})"

    def gain(self, other: ScoredHead, regression: bool) -> dict[str, float | None]:
        """Return by how much it is above another one, with the paired interval."""
        return statistics.paired_gain(self.runs, other.runs, regression)


def verdict(
    name: str, gain: Gain, control: str = "raw pixels", task: str = "", regression: bool = False
) -> str:
    """Return a sentence on features against a control, from a `paired_gain`.

    Args:
        name: of the features, with their head.
        gain: of the features over the control.
        control: the best one.
        task: what was probed, if there are several tasks.
        regression: the gain is of R2, not of an accuracy.
    """
    of = f"{task}: " if task else ""
    by = _by(gain, regression)
    if gain["low"] is None:
        return f"{of}{name} is {by} from {control}, by too few test recordings to be sure."
    interval = _interval(gain, regression)
    if gain["low"] > 0:
        by = by.removeprefix("+")
        return f"{of}{name} is {by} above the best control, {control} {interval}."
    return (
        f"{of}{name} is no better than the best control, {control}: {by} {interval}. Try --pooling "
        "both, more recordings, or another encoder, and look at the untouched gel with `anytouch "
        "view`."
    )


def _by(gain: Gain, regression: bool) -> str:
    """Return a difference with its sign and unit."""
    difference = gain["difference"] or 0.0
    if regression:
        return f"{difference:+.2f} of R2"
    return f"{100 * difference:+.0f} points"


def _interval(gain: Gain, regression: bool) -> str:
    low = gain["low"] or 0.0
    high = gain["high"] or 0.0
    if regression:
        return f"({low:.2f} to {high:.2f})"
    return f"({100 * low:.0f} to {100 * high:.0f})"


def _untrained(own: ScoredHead, untrained: ScoredHead, task: str, regression: bool) -> str:
    """Return a sentence where an untrained encoder is above a trained one, else "".

    Then what the score shows is the architecture and the images, not what training has taught.
    """
    gain = untrained.gain(own, regression)
    if (gain["difference"] or 0.0) <= 0:
        return ""
    of = f"{task}: " if task else ""
    sure = "" if (gain["low"] or 0.0) > 0 else ", which may be chance"
    by = _by(gain, regression).removeprefix("+")
    interval = "" if gain["low"] is None else f" {_interval(gain, regression)}"
    line = f"{of}{untrained.name} is {by} better than {own.name}{interval}{sure}."
    return line[0].upper() + line[1:]


def sentences(
    own: ScoredHead, controls: Sequence[ScoredHead], task: str = "", regression: bool = False
) -> list[str]:
    """Return what is to say of a head on features of a user, beside the controls of a probe.

    Args:
        own: the head on the user's features.
        controls: on raw pixels, a random encoder and so on.
        task: what was probed, if there are several tasks.
        regression: whether scores are R2, not accuracies.
    """
    if not controls:
        return []
    # the control over which the features gain least
    gains = [own.gain(control, regression) for control in controls]
    place = min(range(len(gains)), key=lambda number: gains[number]["difference"] or 0.0)
    best = controls[place]
    lines = [verdict(own.name, gains[place], best.name, task, regression)]
    untrained = [control for control in controls if control.features == RANDOM]
    if untrained and best.features != RANDOM:
        lowest = min(untrained, key=lambda one: own.gain(one, regression)["difference"] or 0.0)
        line = _untrained(own, lowest, task, regression)
        if line:
            lines.append(line)
    return lines


def label_verdicts(results: Sequence[ProbeResult]) -> list[str]:
    """Return sentences on each source of features of `probe_label` against the best control.

    A source is judged by its first head, the linear one. Controls are judged by all: a user may
    take whichever is best. The commonest class, or the mean of train, is one of them.
    """
    scored: list[ScoredHead] = []
    constants: list[ScoredHead] = []
    regression = False
    for result in results:
        if result.outcome is None:
            continue
        regression = result.regression
        features, has_head, head = result.probe.rpartition(": ")
        if has_head:
            scored.append(ScoredHead(features, head, [result.outcome.sums]))
        else:
            constants.append(ScoredHead(result.probe, "", [result.outcome.sums]))
    controls = [one for one in scored if one.features in CONTROLS]
    if controls:
        controls += constants
    lines = []
    judged = set()
    for one in scored:
        if one.features not in CONTROLS and one.features not in judged:
            judged.add(one.features)
            lines += sentences(one, controls, regression=regression)
    return lines


def task_verdicts(runs: Runs, kinds: Mapping[str, bool]) -> list[str]:
    """Return sentences on each source, task, head and protocol against the best control.

    `kinds` says of which tasks the label is continuous.
    """
    lines = []
    for (features, task, head, protocol), own in runs.items():
        if features in CONTROLS:
            continue
        controls = []
        for (name, other_task, other_head, other_protocol), several in runs.items():
            if name in CONTROLS and (other_task, other_protocol) == (task, protocol):
                controls.append(ScoredHead(name, other_head, several))
        lines += sentences(ScoredHead(features, head, own), controls, task, kinds[task])
    return lines
