from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from anytouch_jax.train import pace
from anytouch_jax.train.pace import Deadline, MeasuredPace, StepPace

METRICS = {"loss": jnp.zeros(())}


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is set."""
    now = SimpleNamespace(seconds=100.0)
    monkeypatch.setattr(pace, "time", SimpleNamespace(monotonic=lambda: now.seconds))
    return now


def test_a_given_number_of_steps_leaves_progress_to_the_step():
    steps = StepPace()
    assert steps.total is None and steps.progress(7) is None
    assert steps.stepped(8, METRICS) is False and steps.numbers() == {}


def test_a_deadline_counts_from_the_end_of_the_first_step(clock):
    deadline = Deadline(160.0)
    assert deadline.progress(0) == 0
    clock.seconds = 140.0  # the first step was compiled
    assert deadline.progress(0) == 0 and not deadline.stepped(1, METRICS)
    clock.seconds = 150.0
    assert deadline.progress(1) == 0.5 and not deadline.stepped(2, METRICS)
    clock.seconds = 161.0
    assert deadline.progress(2) == 1 and deadline.stepped(3, METRICS)


@pytest.mark.parametrize(("each", "total"), [(0.5, 120), (2.0, 30), (100.0, 2)])
def test_the_first_steps_decide_how_many_there_are(clock, each, total):
    measured = MeasuredPace(60.0, timed=4)
    done = 0
    over = False
    while not over:
        if measured.total is None:
            assert measured.progress(done) == 0
        else:
            assert measured.progress(done) == pytest.approx(done / total)
        clock.seconds += each if done else 1000.0  # the first one is compiled
        done += 1
        over = measured.stepped(done, METRICS)
    assert done == measured.total == total
    assert measured.numbers() == {"total_steps": total}


def test_a_measured_pace_continues_with_the_number_that_was_stored(clock):
    measured = MeasuredPace(60.0, timed=4)
    measured.resume({"step": 17, "total_steps": 20})
    assert measured.progress(18) == pytest.approx(0.9)
    assert not measured.stepped(19, METRICS) and measured.stepped(20, METRICS)
    measured.resume({"step": 2})  # it was interrupted before the number was known
    assert measured.total is None
