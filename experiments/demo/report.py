"""The report of the demo: what it gained in words, then a figure for each thing that it says."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import anytouch_jax as at
from anytouch_jax.evaluate.pages import Section, write_report
from anytouch_jax.evaluate.plots import panels, write_figure
from anytouch_jax.evaluate.statistics import (
    classification_sums,
    fraction_interval,
    mean_interval,
    paired_gain,
)
from experiments.demo.touches import NAMES, Touches, unstretched
from experiments.demo.training import Course

PACKAGE, NOTHING = "anytouch-tiny", "the same network from nothing"
HEAD, PIXELS, COMMONEST = "its head alone, in seconds", "a head on pixels", "the commonest shape"
COLOURS = {PACKAGE: "#00656f", HEAD: "#6fb3ba", NOTHING: "#b4552d", PIXELS: "#8d969e"}
GREY = "#8d969e"
SHOWN = 8  # presses of a figure
RELOAD = 10  # seconds: the first page waits for the last one
WEAK = 0.5  # N: below it most is read too small
LEAST = 0.05  # N, where the axes of force begin
DEEPEST = 1.0  # mm of the lightest colour


class Findings(NamedTuple):
    """What the demo measured on its held-out touches."""

    test: Touches
    package: Course
    nothing: Course
    pixels: np.ndarray  # (n,) numbers of NAMES that a head on raw pixels gives
    commonest: int  # the shape with most touches of train
    force: np.ndarray  # (m,) N, as the encoder of the package measures the first touches
    usual_force: float  # N, the median of train
    trained_on: int  # touches


class Score(NamedTuple):
    """A fraction with its 95 % interval over objects."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"


def score_of(named: np.ndarray, test: Touches) -> Score:
    """Return how many touches are named rightly."""
    right = named == test.shape
    low, high = fraction_interval(right, test.object)
    return Score(float(right.mean()), float(low or 0.0), float(high or 1.0))


def gain_of(new: np.ndarray, old: np.ndarray, test: Touches) -> str:
    """Return by how many points `new` names more than `old`, with the paired interval."""
    first, second = ([classification_sums(one == test.shape, test.object)] for one in (new, old))
    gain = paired_gain(first, second, regression=False)
    value, low, high = (100 * float(gain[name] or 0.0) for name in ("difference", "low", "high"))
    return f"{value:+.0f} points [{low:+.0f}, {high:+.0f}]"


def first_report(out: Path) -> Path:
    """Write what the encoder in the package says before any training, and return the page."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "first.png"
        _draw_examples(path)
        section = Section(
            "Before any training: the depth of two presses",
            "The encoder in the package reads depth and force from the image of a press. Above "
            "are the images of two presses by three sensors, below is what it reads: violet is "
            f"the untouched gel, and yellow is {DEEPEST:.0f} mm deep.",
            figure=path,
        )
        lead = [
            "In some minutes this page tells how well the encoder has learned to name shapes on a "
            "sensor that it had never met.",
            "It is training now, and the page appears by itself.",
        ]
        title = "Naming shapes on a sensor that the encoder has never met"
        return write_report(out, [section], title=title, lead=lead, reload=RELOAD)


def write_findings(found: Findings, out: Path, minutes: float) -> Path:
    """Write the report, and return the path of report.md."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sections = [
            _scores_section(found, folder),
            _curve_section(found, folder),
            _presses_section(found, folder),
            *_force_sections(found, folder),
        ]
        numbers = _numbers(found, minutes)
        title = "Naming shapes on a sensor that the encoder had never met"
        lead = sentences(found)
        return write_report(out, sections, title=title, lead=lead, numbers=numbers)


def sentences(found: Findings) -> list[str]:
    """Return what was learned, what was not, and what more steps bring."""
    test = found.test
    last = found.package.points[-1]
    end = last.named
    scores = {name: score_of(named, test) for name, named in _named(found).items()}
    learned = (
        f"Learned: on a sensor that it had never met, {PACKAGE} names {scores[PACKAGE]} of "
        f"{len(test.shape)} touches of held-out objects after {_duration(last.seconds)} of "
        f"training, {NOTHING} names {scores[NOTHING]} after as many steps, {PIXELS} "
        f"{scores[PIXELS]}, and always saying {NAMES[found.commonest]!r} {scores[COMMONEST]}."
    )
    rights = {
        name: score_of(end[test.shape == number], _rows(test, test.shape == number))
        for number, name in enumerate(NAMES)
        if np.sum(test.shape == number) > 1
    }
    worst = min(rights, key=lambda name: rights[name].value)
    head = found.package.points[0].named
    not_learned = (
        f"Not learned: of the {len(rights)} shapes in the test it knows the {worst} least, "
        f"{rights[worst]}, where chance is {100 / len(NAMES):.0f} %. Most of what it knows came "
        "with the package: "
        f"{HEAD}, names {scores[HEAD]}, and training the whole encoder adds "
        f"{gain_of(end, head, test)}."
    )
    points = found.package.points
    before = points[len(points) * 2 // 3]
    other = found.nothing.points
    more = (
        f"More steps: the last {last.step - before.step} of {last.step} steps brought "
        f"{gain_of(end, before.named, test)}, and from nothing they brought "
        f"{gain_of(other[-1].named, other[len(other) * 2 // 3].named, test)}. Intervals are of "
        "95 %, over objects."
    )
    return [learned, not_learned, more]


def _rows(test: Touches, rows: np.ndarray) -> Touches:
    return Touches(*(values[rows] for values in test))


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} seconds"
    return f"{seconds / 60:.1f} minutes"


def _named(found: Findings) -> dict[str, np.ndarray]:
    """Return what is named by each contender, the best known first."""
    return {
        PACKAGE: found.package.points[-1].named,
        HEAD: found.package.points[0].named,
        NOTHING: found.nothing.points[-1].named,
        PIXELS: found.pixels,
        COMMONEST: np.full(len(found.test.shape), found.commonest),
    }


def _scores_section(found: Findings, folder: Path) -> Section:
    """Return the bars of all contenders."""
    path = folder / "scores.png"
    named = _named(found)
    scores = {name: score_of(values, found.test) for name, values in named.items()}
    figure, axes = panels(1, 1, 9.0, 2.9)
    axis = axes[0][0]
    for place, (name, score) in enumerate(scores.items()):
        colour = COLOURS.get(name, GREY)
        axis.barh(place, 100 * score.value, color=colour, height=0.66)
        axis.plot([100 * score.low, 100 * score.high], [place, place], color="#1a1e21", lw=1.4)
        axis.text(100 * score.high + 1.2, place, f"{100 * score.value:.0f} %", va="center")
    axis.set_yticks(range(len(scores)), list(scores))
    axis.set(xlim=(0, 100), xlabel="held-out touches named rightly, %")
    axis.invert_yaxis()
    _bare(axis)
    write_figure(path, figure)
    text = (
        f"Which of {len(NAMES)} shapes is it? All learn from the same {found.trained_on} touches. "
        "The test has other objects: no pair of a shape and a surface is in both."
    )
    return Section("What was gained", text, figure=path)


def _curve_section(found: Findings, folder: Path) -> Section:
    """Return the curve of both trainings."""
    path = folder / "curve.png"
    figure, axes = panels(1, 1, 9.0, 3.3)
    axis = axes[0][0]
    for name, course in ((PACKAGE, found.package), (NOTHING, found.nothing)):
        steps = [point.step for point in course.points]
        scores = [score_of(point.named, found.test) for point in course.points]
        values, low, high = (100 * np.array(column) for column in zip(*scores, strict=True))
        axis.fill_between(steps, low, high, color=COLOURS[name], alpha=0.15, lw=0)
        axis.plot(steps, values, color=COLOURS[name], lw=2.4, marker="o", ms=5)
        axis.annotate(
            name,
            (steps[-1], values[-1]),
            (8, 0),
            textcoords="offset points",
            va="center",
            color=COLOURS[name],
        )
    others = {PIXELS: found.pixels, COMMONEST: _named(found)[COMMONEST]}
    for name, named in others.items():
        height = 100 * score_of(named, found.test).value
        axis.axhline(height, color=GREY, ls="--", lw=1)
        axis.text(0, height + 1, name, color="#57626b", fontsize=9)
    axis.set(ylim=(0, 100), xlabel="training steps", ylabel="named rightly, %")
    axis.set_xlim(right=1.42 * found.package.points[-1].step)
    _bare(axis)
    write_figure(path, figure)
    text = (
        "At step 0 a head is fitted on features that stay as they are, which takes a second. Then "
        "encoder and head learn together. Bands are intervals of 95 % over objects."
    )
    return Section("While it learned", text, figure=path)


def _presses_section(found: Findings, folder: Path) -> Section:
    """Return presses with the names that they were given."""
    path = folder / "presses.png"
    test = found.test
    # One press of each shape: the one that changes the image most, since some hardly show.
    change = np.abs(test.frame.astype(np.float32) - test.background).mean((1, 2, 3))
    order = np.argsort(-change, kind="stable")
    chosen = [order[test.shape[order] == number][:1] for number in range(len(NAMES))]
    rows = np.concatenate(chosen)[:SHOWN]
    named = _named(found)
    figure, axes = panels(1, len(rows), 1.25, 1.95)
    for axis, row in zip(axes[0], rows, strict=True):
        axis.imshow(unstretched(test.frame[row]))
        axis.set(xticks=[], yticks=[])
        axis.set_title(NAMES[test.shape[row]], fontsize=10, weight="bold")
        for place, name in enumerate((PACKAGE, NOTHING)):
            given = named[name][row]
            right = given == test.shape[row]
            axis.text(
                0.5,
                -0.13 - 0.17 * place,
                NAMES[given],
                transform=axis.transAxes,
                ha="center",
                va="center",
                fontsize=10,
                color=COLOURS[name] if right else GREY,
                fontstyle="normal" if right else "italic",
            )
    write_figure(path, figure)
    text = (
        "The clearest held-out press of each shape, and below it the name by "
        f"{PACKAGE} and then by {NOTHING}. Wrong names are grey and slanted."
    )
    return Section("Presses and their names", text, figure=path)


def _force_sections(found: Findings, folder: Path) -> list[Section]:
    """Return the section on force, or nothing if a constant guess is as good."""
    test = _rows(found.test, np.arange(len(found.force)))
    off = np.abs(found.force - test.force)
    guess = np.abs(found.usual_force - test.force)
    low, high = mean_interval(guess - off, test.object)
    if low is None or low <= 0:
        return []
    path = folder / "force.png"
    figure, axes = panels(1, 1, 6.4, 4.4)
    axis = axes[0][0]
    # An error of force is a factor, so equal factors are equally long.
    reach = np.array([LEAST, 2 * max(test.force.max(), found.force.max())])
    axis.fill_between(reach, reach / 2, 2 * reach, color=COLOURS[PACKAGE], alpha=0.12, lw=0)
    axis.plot(reach, reach, color=COLOURS[PACKAGE], lw=1)
    axis.axhline(found.usual_force, color=GREY, ls="--", lw=1)
    shown = np.maximum(test.force, LEAST), np.maximum(found.force, LEAST)
    axis.scatter(*shown, s=14, color=COLOURS[PACKAGE], lw=0, alpha=0.8, clip_on=False, zorder=3)
    axis.set(xscale="log", yscale="log", xlim=reach, ylim=reach)
    ticks = [tick for tick in (0.1, 0.3, 1, 3, 10, 30, 100) if tick <= reach[1]]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.set(xlabel="true force, N", ylabel="measured force, N")
    notes = {
        f"always {found.usual_force:.1f} N": found.usual_force * 1.1,
        "shaded: half to twice the true force": 0.6 * reach[1],
    }
    for words, height in notes.items():
        axis.text(1.15 * reach[0], height, words, color="#57626b", fontsize=9)
    _bare(axis)
    write_figure(path, figure)
    weak = test.force < WEAK
    weakest = ""
    if weak.any():
        near = _within_twice(found.force[weak], test.force[weak])
        weakest = f"Of the {weak.sum()} touches below {WEAK} N it is {near}. "
    text = (
        f"{_within_twice(found.force, test.force)} of {len(found.force)} touches are read within "
        f"half to twice their force, and {_within_twice(found.usual_force, test.force)} by always "
        f"saying {found.usual_force:.1f} N. {weakest}The mean error is {off.mean():.2f} N, and "
        f"{guess.mean():.2f} N by that guess, {np.mean(guess - off):.2f} N more [{low:.2f}, "
        f"{high:.2f}]. The package was trained on no touch of this sensor. It knows the size and "
        "the stiffness of the gel."
    )
    return [Section("Force, without any training", text, figure=path)]


def _within_twice(measured: Any, force: np.ndarray) -> str:
    """Return how many forces are measured within a factor of two."""
    right = np.abs(np.log(np.maximum(measured, 1e-6) / np.maximum(force, 1e-6))) <= np.log(2)
    return f"{100 * right.mean():.0f} %"


def _draw_examples(path: Path) -> None:
    """Draw the example touches of the package above their measured depth."""
    encoder = at.load_encoder(PACKAGE)
    touches = at.example_touches()
    figure, axes = panels(2, len(touches), 1.7, 1.6)
    for column, touch in enumerate(touches):
        fields = encoder.measure(touch.frame, touch.background, touch.sensor)
        shown = fields.at(*touch.frame.shape[:2])
        axes[0][column].imshow(touch.frame)
        axes[0][column].set_title(f"{touch.press}, {touch.sensor}", fontsize=8)
        axes[1][column].imshow(shown.depth[0], cmap="viridis", vmin=0, vmax=DEEPEST)
        told = f"{shown.depth[0].max():.2f} mm, {fields.force[0, 2]:.1f} N"
        axes[1][column].set_xlabel(told, fontsize=8)
        for axis in (axes[0][column], axes[1][column]):
            axis.set(xticks=[], yticks=[])
    write_figure(path, figure)


def _bare(axis: Any) -> None:
    """Leave the frame of a chart away, but for its axes."""
    axis.spines[["top", "right"]].set_visible(False)


def _numbers(found: Findings, minutes: float) -> dict[str, Any]:
    """Return what report.json holds."""
    named: dict[str, np.ndarray] = _named(found)

    def curve(points: Sequence[Any]) -> list[dict[str, float]]:
        return [
            {
                "step": point.step,
                "seconds": round(point.seconds, 1),
                "right": score_of(point.named, found.test).value,
            }
            for point in points
        ]

    return {
        "scores": {name: score_of(one, found.test)._asdict() for name, one in named.items()},
        "package": curve(found.package.points),
        "nothing": curve(found.nothing.points),
        "touches": {"train": found.trained_on, "test": len(found.test.shape)},
        "minutes": round(minutes, 1),
    }
