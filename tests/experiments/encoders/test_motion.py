import numpy as np
import pytest

from experiments.encoders import motion

RNG = np.random.default_rng(0)


@pytest.mark.slow
def test_it_learns_a_field_that_no_mean_shows():
    """The first two values of a token change with the field of a turn, whose mean over the picture is zero."""
    n, side = 300, 4
    y, x = np.mgrid[:side, :side].reshape(2, -1) / side - 0.375
    sign = RNG.choice([-1.0, 1.0], n)
    tokens = RNG.standard_normal((n, 2, side * side, 6)).astype(np.float32)
    tokens[:, 1] = tokens[:, 0] + 0.1 * RNG.standard_normal(tokens[:, 0].shape)
    tokens[:, 1, :, :2] += sign[:, None, None] * np.stack([-y, x], -1)
    turn = np.where(sign > 0, *motion.TURNS)
    split = np.array(["train", "train", "val", "test"])[np.arange(n) % 4]
    clips = motion.Clips(tokens, turn, np.full(n, "none"), np.full(n, "digit"), split, np.arange(n))
    splits = {name: np.flatnonzero(split == name) for name in ("train", "val", "test")}
    found = motion.score(motion.fit(clips, splits["train"], splits["val"]), clips, splits["test"])
    assert found["turn"]["share"] > 0.95 and found["slide"]["clips"] == 0
    assert motion.pooled_score(clips, splits) < 0.75
