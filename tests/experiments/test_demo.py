"""The demo: its sensor, its training and its sentences."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from tiny_models import compiled, tiny_config

from anytouch_jax.sim.sensing.own import read_sensor
from anytouch_jax.sim.sensing.sensors import POWERS, look
from experiments.demo.report import (
    COMMONEST,
    HEAD,
    NOTHING,
    PACKAGE,
    Findings,
    sentences,
    write_findings,
)
from experiments.demo.run import measured_force
from experiments.demo.touches import NAMES, Touches, write_ring_light
from experiments.demo.training import (
    POINTS,
    RATE,
    Course,
    Learner,
    Point,
    from_nothing,
    train_course,
    with_head,
)


def touches(count: int, size: int = 28, seed: int = 0) -> Touches:
    """Touches whose shape is the brightness of a square, on a grey background."""
    rng = np.random.default_rng(seed)
    shape = np.arange(count) % len(NAMES)
    frame = np.full((count, size, size, 3), 120, np.uint8)
    for number, one in enumerate(shape):
        frame[number, 4:20, 4:20] += np.uint8(12 * one)
    frame = (frame + rng.integers(0, 4, frame.shape)).astype(np.uint8)
    background = np.full((count, size, size, 3), 120, np.uint8)
    depth = rng.uniform(0.3, 1.0, count)
    return Touches(frame, background, shape, np.arange(count) // 2, depth, 3 * depth)


def test_the_light_is_the_same_from_all_sides(tmp_path: Path) -> None:
    """The sensor glows by x^2 + y^2 of the normal, so no tilt differs from its opposite."""
    photometry = look(read_sensor(write_ring_light(tmp_path / "ring_light.sensor")))
    slopes = np.random.default_rng(0).normal(size=(50, 2))
    turned = slopes @ np.array([[0, 1], [-1, 0]])

    def colour(tilt: np.ndarray) -> np.ndarray:
        terms = np.stack([tilt[:, 0] ** a * tilt[:, 1] ** b for a, b in POWERS], 1)
        return terms @ np.asarray(photometry.normal)[:, 0]

    glow = colour(slopes)
    np.testing.assert_allclose(glow, colour(-slopes), rtol=1e-6)
    np.testing.assert_allclose(glow, colour(turned), rtol=1e-5)
    assert (glow[:, 0] > glow[:, 2]).all() and not np.asarray(photometry.halo).any()


@pytest.fixture(scope="module")
def learner() -> Learner:
    config = tiny_config(1).with_settings({"data.background": "subtract"})
    return Learner(compiled(config.model).net, config)


def test_a_training_is_tested_before_during_and_after(learner: Learner) -> None:
    train = touches(90)
    test = touches(36, seed=1)
    said: list[str] = []
    params = with_head(learner, from_nothing(learner)["touch"], train)
    course = train_course(learner, params, (train, test), rate=RATE, steps=12, log=said.append)
    assert [point.step for point in course.points] == [0, 2, 4, 6, 8, 10, 12]
    assert len(said) == POINTS + 1
    # a head in closed form names what differs so plainly, and training moves the encoder
    assert np.mean(course.points[0].named == test.shape) > 0.5
    before = jax.tree.leaves(params["touch"])
    after = jax.tree.leaves(course.params["touch"])
    assert any(
        np.abs(np.asarray(a) - np.asarray(b)).max() > 0 for a, b in zip(before, after, strict=True)
    )
    # from nothing it knows nothing: all scores are equal
    blank = train_course(
        learner, from_nothing(learner), (train, test), rate=0.0, steps=POINTS, log=said.append
    )
    assert set(blank.points[0].named.tolist()) == {0}


def findings(right: dict[str, float], force_error: float) -> Findings:
    """Findings in which each contender names that part of the touches."""
    test = touches(180)
    rng = np.random.default_rng(3)

    def named(part: float) -> np.ndarray:
        wrong = (test.shape + 1) % len(NAMES)
        return np.where(rng.random(len(test.shape)) < part, test.shape, wrong)

    def course(first: float, last: float) -> Course:
        levels = np.linspace(first, last, POINTS + 1)
        points = [Point(10 * i, 5.0 * i, named(level)) for i, level in enumerate(levels)]
        return Course(points, {})

    return Findings(
        test,
        course(right[HEAD], right[PACKAGE]),
        course(0.1, right[NOTHING]),
        named(0.2),
        0,
        test.force + rng.normal(0, force_error, len(test.force)),
        float(np.median(test.force)),
        500,
    )


def test_the_sentences_say_what_was_measured() -> None:
    found = findings({HEAD: 0.7, PACKAGE: 0.9, NOTHING: 0.3}, 0.1)
    learned, not_learned, more = sentences(found)
    test = found.test
    right = np.mean(found.package.points[-1].named == test.shape)
    assert f"{PACKAGE} names {100 * right:.0f} % [" in learned
    assert f"of {len(test.shape)} touches" in learned and "after 30 seconds" in learned
    chance = np.mean(test.shape == 0)
    assert f"always saying 'ball' {100 * chance:.0f} %" in learned
    rights = [np.mean(found.package.points[-1].named[test.shape == n] == n) for n in range(9)]
    assert f"it knows the {NAMES[int(np.argmin(rights))]} least" in not_learned
    gain = right - np.mean(found.package.points[0].named == test.shape)
    assert f"adds {100 * gain:+.0f} points [" in not_learned
    assert more.startswith("More steps: the last 20 of 60 steps brought ")


def test_a_page_has_no_section_without_something_to_say(tmp_path: Path) -> None:
    """Where force is not better than a constant guess, it does not appear."""
    titles: dict[str, list[Any]] = {}
    for name, error in (("good", 0.05), ("bad", 3.0)):
        found = findings({HEAD: 0.7, PACKAGE: 0.9, NOTHING: 0.3}, error)
        page = write_findings(found, tmp_path / name, 1.0)
        titles[name] = re.findall(r"^## (.+)$", page.read_text(), re.MULTILINE)
        html = page.with_suffix(".html").read_text()
        assert html.count("<img") == len(titles[name]) and html.index("Learned: ") < 6000
        assert not re.search(r'(src|href)="(?!data:)', html)
    assert titles["good"][:-1] == titles["bad"]
    assert COMMONEST not in page.read_text().split("\n\n")[0]


class Seeing:
    """An encoder that keeps the shapes of what it measures, and says what it does not know."""

    def __init__(self) -> None:
        self.shapes: set[tuple[int, ...]] = set()

    def measure(self, frame: Any, background: Any, sensor: str, log: Any) -> Any:
        self.shapes |= {frame.shape, background.shape}
        log(f"sensor {sensor!r} has no tokens of its own here")
        log("it looks odd")
        return SimpleNamespace(force=np.ones((1, 3)))


def test_force_is_measured_in_the_proportions_of_the_gel(tmp_path: Path, capsys: Any) -> None:
    """Simulated images are stretched to squares. What nobody can act on is not said."""
    folder = write_ring_light(tmp_path / "ring_light.sensor")
    height, width = read_sensor(folder).field
    encoder = Seeing()
    measured_force(encoder, folder, touches(3))  # type: ignore[arg-type]
    assert [one[0] / one[1] for one in encoder.shapes] == [pytest.approx(height / width)]
    told = capsys.readouterr().out
    assert told.count("it looks odd") == 3 and "tokens" not in told


def test_the_section_on_force_says_where_it_fails(tmp_path: Path) -> None:
    found = findings({HEAD: 0.7, PACKAGE: 0.9, NOTHING: 0.3}, 0.0)
    weak = found.test.force < 1.2
    found.test.force[weak] /= 10
    found.force[:] = np.where(weak, 0.0, found.test.force)
    text = write_findings(found, tmp_path, 1.0).read_text()
    assert f"{100 * np.mean(~weak):.0f} % of {len(weak)} touches are read within half" in text
    assert f"Of the {weak.sum()} touches below 0.5 N it is 0 %." in text
