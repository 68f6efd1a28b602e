from collections import Counter

import numpy as np
import pytest

from anytouch_jax.data.loading import sampling as s
from anytouch_jax.data.loading.sampling import EpochSampler


def test_uniform_is_a_function_of_seed_tag_and_step():
    steps = np.arange(20_000)
    draw = s.uniform_per_step(3, 1, steps)
    assert draw.min() >= 0 and draw.max() < 1
    counts, _ = np.histogram(draw, 20, (0, 1))
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)
    assert abs(np.corrcoef(draw[1:], draw[:-1])[0, 1]) < 0.03
    np.testing.assert_array_equal(s.uniform_per_step(3, 1, steps[500:600]), draw[500:600])
    for seed, tag in ((4, 1), (3, 2), (-3, 1)):
        assert abs(np.corrcoef(s.uniform_per_step(seed, tag, steps), draw)[0, 1]) < 0.03


def test_turns_count_the_earlier_steps_of_a_kind():
    turns = s.StepSchedule(lambda steps: (steps * 7 % 5 < 2).astype(np.int64))
    earlier = {0: 0, 1: 0}
    for step in [*range(50), 3000]:
        if step == 3000:
            earlier = {k: sum((i * 7 % 5 < 2) == k for i in range(3000)) for k in (0, 1)}
        kind, rank = turns.at(step)
        assert kind == (step * 7 % 5 < 2) and rank == earlier[kind]
        earlier[kind] += 1
    # no need to walk there
    assert s.StepSchedule(lambda steps: steps % 3 == 0).at(3000) == (1, 1000)
    with pytest.raises(ValueError, match="from 0"):
        turns.at(-1)


@pytest.mark.parametrize(("size", "batch"), [(7, 3), (5, 5), (3, 8), (1, 4), (64, 16)])
def test_every_epoch_of_a_stream_holds_all_once(size, batch):
    stream = s.EpochSampler(size, 0, 9)
    drawn = [pair for k in range(4 * size) for pair in stream.take(k * batch, batch)]
    for epoch in range(4):
        assert sorted(thing for thing, e in drawn if e == epoch) == list(range(size))
    orders = {tuple(thing for thing, e in drawn if e == epoch) for epoch in range(4)}
    assert size < 5 or len(orders) == 4
    assert s.EpochSampler(size, 0, 9).take(3 * batch, batch) == drawn[3 * batch : 4 * batch]
    assert size < 5 or s.EpochSampler(size, 1, 9).take(0, size) != drawn[:size]
    assert s.EpochSampler(0, 0, 9).take(0, 0) == []


CASES = [
    ((3, 5, 7, 9), 8, 1),
    ((0, 0, 0, 9), 4, 1),
    ((0, 9, 0, 0), 4, 4),
    ((9, 0, 0, 0), 4, 1),
    ((5, 0, 5, 0), 3, 1),
    ((1, 0, 0, 1999), 64, 1),
    ((0, 1999, 0, 1), 64, 1),
    ((350, 250, 510, 450), 64, 4),
    ((13, 2, 0, 500), 16, 8),
    ((1, 1, 1, 1), 1, 1),
    ((2, 3, 1, 0), 5, 2),
]


@pytest.mark.parametrize(("sizes", "batch", "multiple"), CASES)
def test_strata_fill_a_batch_and_visit_everything(sizes, batch, multiple):
    strata = s.StratumQuota(sizes, batch, multiple)
    total = np.zeros(4, np.int64)
    steps = 6 * sum(sizes)
    for k in range(steps):
        before, now = strata.at(k)
        np.testing.assert_array_equal(before, total)
        assert now.sum() == batch and (now >= 0).all()
        assert now[s.VISION] + now[s.BOTH] <= strata.images
        assert now[s.TEXT] + now[s.BOTH] <= strata.texts
        total += now
    fractions = np.array(sizes) * batch / sum(sizes)
    assert ((total > 0) == (np.array(sizes) > 0)).all()
    # nobody loses more than half
    assert (total / steps >= fractions / 2 - batch / steps).all()
    for slots, fraction in (
        (strata.images, fractions[:2].sum()),
        (strata.texts, fractions[1:3].sum()),
    ):
        assert fraction - 1e-9 <= slots <= batch
        assert slots == batch or (slots % multiple == 0 and slots < fraction + multiple)
    # straight to one step
    again = s.StratumQuota(sizes, batch, multiple).at(steps - 1)
    np.testing.assert_array_equal(again[0] + again[1], total)


@pytest.mark.parametrize("multiple", [1, 2, 4, 16])
def test_slots_are_full_but_for_what_the_devices_add_and_a_batch_does_not_depend_on_them(multiple):
    lock, strata = (s.StratumQuota((350, 250, 510, 450), 64, m) for m in (1, multiple))
    # of 64 * 600 / 1560 = 24.6 and 64 * 760 / 1560 = 31.2
    assert (lock.images, lock.texts) == (25, 32)
    assert strata.images == -(-25 // multiple) * multiple and strata.texts % multiple == 0
    for k in range(500):
        before, now = strata.at(k)
        np.testing.assert_array_equal([before, now], lock.at(k))
        assert now[s.VISION] + now[s.BOTH] == lock.images
        assert now[s.TEXT] + now[s.BOTH] == lock.texts


def test_a_rare_stratum_is_visited_at_even_distances():
    strata = s.StratumQuota((0, 90000, 0, 110), 64)
    visits = np.flatnonzero([strata.at(k)[1][s.NEITHER] for k in range(3000)])
    assert np.diff([-1, *visits, 3000]).max() <= 21


@pytest.mark.parametrize(
    "weights", [[2, 2, 2, 1, 1], [3, 0.5, 0.5, 0.5, 0.5], [1, 2.5, 2.5, 1, 1], [0.2] * 5]
)
def test_an_epoch_draws_each_thing_by_its_weight(weights):
    weights = np.array(weights, float)
    stream = EpochSampler(5, 0, 9, weights)
    epochs = 400
    drawn = stream.take(0, epochs * stream.size)
    for e in range(20):
        counts = Counter(thing for thing, _ in drawn[e * stream.size : (e + 1) * stream.size])
        for weight in np.unique(weights):
            of = [counts[t] for t in np.flatnonzero(weights == weight)]
            assert sum(of) == max(1, round(weight * len(of))) and max(of) - min(of) <= 1
    many = Counter(thing for thing, _ in drawn)
    for weight in np.unique(weights):
        ids = np.flatnonzero(weights == weight)
        fraction = max(1, round(weight * len(ids))) / len(ids)
        assert all(abs(many[t] / epochs - fraction) < 0.15 for t in ids)
    # each time with another augmentation
    assert len(set(drawn)) == len(drawn)
    # no need to walk there
    assert EpochSampler(5, 0, 9, weights).take(377, 20) == drawn[377:397]
    assert stream.take(0, stream.size) != stream.take(stream.size, stream.size)
