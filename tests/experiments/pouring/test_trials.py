"""Pouring closed loop: the expert, imitation on a signal that can be learned, the blind policy, film and table."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from tiny_models import tiny_config

from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.errors import UserError
from experiments.pouring import bounds
from experiments.pouring import policy as pouring_policy
from experiments.pouring import trials as pouring
from experiments.pouring.physics import POUR, RETRACT, WAIT, Task
from experiments.pouring.policy import Learning
from experiments.pouring.trials import START

pytestmark = pytest.mark.slow

TASK, SIDE = Task(), 28
FAST = Learning(steps=600, width=32, tune_steps=2, tune_runs=2)


@pytest.fixture(scope="module")
def reported() -> pouring.Trials:
    """Demonstrations without frames: the flow alone."""
    return pouring_policy.demonstrate(TASK, 0, 20, side=None, late=0, chunk=20)


@pytest.fixture(scope="module")
def late() -> pouring.Trials:
    """The same, by a late hand: what policies learn from."""
    return pouring_policy.demonstrate(TASK, 0, 20, side=None, chunk=20)


@pytest.fixture(scope="module")
def shown() -> pouring.Trials:
    """Two short demonstrations with frames."""
    return pouring_policy.demonstrate(replace(TASK, limit=9), 0, 2, side=SIDE)


@pytest.fixture(scope="module")
def encoder():
    return random_encoder(tiny_config())


def test_the_expert_pours_the_target(reported):
    wrong = np.abs(reported.poured - TASK.target)
    assert wrong.mean() < 1.5 and wrong.max() < 6
    assert set(np.unique(reported.actions[reported.taken])) == {POUR, WAIT, RETRACT}
    for run in range(len(reported.poured)):
        mine = reported.actions[: reported.steps[run], run]
        assert (mine[:5] == WAIT).all() and (mine[-12:] == RETRACT).all()
        assert (np.diff(reported.mass[: reported.steps[run], run]) <= 0).all()
    assert reported.steps.std() > 5


def test_the_same_seed_is_the_same_run_in_any_company(reported):
    lock = pouring_policy.demonstrate(TASK, 0, 3, side=None, late=0, chunk=3)
    np.testing.assert_array_equal(lock.poured, reported.poured[:3])
    longest = len(lock.actions)
    taken = lock.taken
    np.testing.assert_array_equal(lock.actions[taken], reported.actions[:longest, :3][taken])
    other = pouring_policy.demonstrate(TASK, 1, 3, side=None, late=0, chunk=3)
    assert np.abs(other.tilt[0] - lock.tilt[0]).min() > 1e-3


def test_a_late_hand_changes_what_is_done_and_not_the_choice(reported, late):
    assert (reported.choices == reported.actions).all()
    for run in range(20):
        mine = late.choices[: late.steps[run], run], late.actions[: late.steps[run], run]
        first = int((mine[0] == RETRACT).argmax())
        assert (mine[0][first:] == RETRACT).all() and (mine[0][:first] == mine[1][:first]).all()
        over = int((mine[1][first:] == RETRACT).argmax())
        assert (mine[1][first : first + over] == POUR).all() and (mine[1][first + over :] == RETRACT).all()
        same = min(first, reported.steps[run])
        np.testing.assert_array_equal(late.mass[:same, run], reported.mass[:same, run])
    assert late.poured.std() > 5 and late.poured.min() > 59


@pytest.mark.slow
def test_a_blind_policy_pours_but_cannot_know():
    blind = bounds.learn_blind(TASK, 0, 20, FAST)
    setups, keys = pouring.draw_runs(TASK, pouring_policy.UNSEEN, 20)
    result = pouring.run(TASK, setups, keys, blind)
    assert 4 < pouring.error(result.poured, TASK.target).mean < 30
    assert result.poured.std() > 4  # the runs differ, it does not


@pytest.mark.slow
def test_counting_is_the_best_it_can_be_and_no_more(reported):
    counter = pouring.best_counter(TASK, *pouring.draw_runs(TASK, 0, 20))
    setups, keys = pouring.draw_runs(TASK, 0, 20)
    errors = {}
    for more in (-24, 0, 24):
        result = pouring.run(TASK, setups, keys, pouring.Counter(counter.pours + more))
        errors[more] = pouring.error(result.poured, TASK.target).mean
        assert ((result.actions == POUR) & result.taken).sum(0).max() == counter.pours + more
    assert 4 < errors[0] < min(errors[-24], errors[24])


class Seer:
    """A policy over a toy signal: the mass with noise, through the same inputs and MLP as touch."""

    looks = False

    def __init__(self, head) -> None:
        self._head = head

    def begin(self, count):
        self._z = []

    def act(self, frames, state):
        self._z.append(toy(np.asarray(state.mass), len(self._z)))
        if len(self._z) < 6:
            return np.full(len(state.mass), WAIT)
        z = np.stack(self._z[2:])
        return np.asarray(pouring_policy.forward(self._head, pouring_policy.input_table(z)[-1])).argmax(-1)


def toy(mass, step):
    noise = np.random.default_rng(step).normal(0, 1, (len(mass), 4))
    return (np.stack([mass, np.sqrt(np.maximum(mass, 0)), mass**2 / 100, 0 * mass], -1) + noise).astype(np.float32)


@pytest.mark.slow
def test_imitation_learns_a_toy_signal_and_beats_blind(late):
    z = np.stack([toy(mass, step) for step, mass in enumerate(late.mass)])[2:]
    head, loss = pouring_policy.imitate(
        *pouring_policy.moments(late, pouring_policy.input_table(z)), replace(FAST, steps=1500)
    )
    assert loss < 0.5 * np.log(3)
    setups, keys = pouring.draw_runs(TASK, pouring_policy.UNSEEN, 20)
    received = pouring.run(TASK, setups, keys, Seer(head))
    blind = pouring.run(TASK, setups, keys, bounds.learn_blind(TASK, 0, 20, FAST))
    assert pouring.error(received.poured, TASK.target).mean < 4
    assert np.mean(np.abs(received.poured - 60) < np.abs(blind.poured - 60)) > 0.6


@pytest.mark.slow
def test_the_loss_is_that_of_demonstrations_held_out_at_their_best():
    rng = np.random.default_rng(0)
    runs = np.repeat(np.arange(10), 12)
    noise = rng.normal(size=(120, 40)).astype(np.float32)  # each run can be learned by heart, and predicts no other
    choices = rng.integers(0, 3, 120)
    learning = replace(FAST, steps=600, batch=256, components=40, dropout=0.0)
    head, loss = pouring_policy.imitate(noise, choices, runs, learning)
    logits = pouring_policy.forward(head, noise[runs >= 8])
    assert loss == pytest.approx(float(pouring_policy.imitation_loss(logits, choices[runs >= 8])), rel=1e-4)
    learned = pouring_policy.forward(head, noise[runs < 8]).argmax(-1)
    assert (np.asarray(learned) == choices[runs < 8]).mean() < 0.95  # stopped before all was learned by heart
    head, _ = pouring_policy.imitate(noise, choices, runs, replace(learning, components=3))
    assert head.basis.shape == (40, 3)
    spread = np.asarray((noise[runs < 8] - np.asarray(head.mean)) @ np.asarray(head.basis)).std(0)
    np.testing.assert_allclose(spread, 1, atol=0.02)


def test_dropout_leaves_out_its_share_while_a_policy_learns_and_nothing_when_it_acts():
    head = pouring_policy.Head(jnp.zeros(100), jnp.eye(100), ((jnp.eye(100), jnp.zeros(100)),))
    x, key = jnp.ones((400, 100)), jax.random.key(0)
    np.testing.assert_allclose(pouring_policy.forward(head, x, 0.3), 1)  # no key: it acts
    result = np.asarray(pouring_policy.forward(head, x, 0.3, key))
    assert (result == 0).mean() == pytest.approx(0.3, abs=0.01)
    np.testing.assert_allclose(result[result != 0], 1 / 0.7, rtol=1e-6)  # so the mean stays


@pytest.mark.slow
def test_dropout_keeps_features_from_being_learned_by_heart_and_policies_over_loads_have_none(late, monkeypatch):
    rng = np.random.default_rng(0)
    runs = np.repeat(np.arange(10), 12)
    signal = rng.integers(0, 3, 120)
    x = np.concatenate([np.eye(3)[signal] + rng.normal(0, 0.7, (120, 3)), rng.normal(size=(120, 40))], 1)
    losses = [
        pouring_policy.imitate(x.astype(np.float32), signal, runs, replace(FAST, components=43, dropout=dropout))[1]
        for dropout in (0.0, 0.3)
    ]
    assert losses[1] < losses[0]
    met = []
    monkeypatch.setattr(bounds, "imitate", lambda *a: met.append(a[-1]) or (None, 0.0))
    bounds.imitate_plainly(late, bounds.blind_inputs(late.actions)[START:], FAST)
    assert met[0].dropout == 0 < FAST.dropout


@pytest.mark.slow
def test_the_load_alone_is_enough_to_pour_by():
    head = bounds.learn_loads(TASK, 0, 20, Learning())
    setups, keys = pouring.draw_runs(TASK, pouring_policy.UNSEEN, 20)
    reported = pouring.run(TASK, setups, keys, bounds.Scales(TASK, setups, head))
    blind = pouring.run(TASK, setups, keys, bounds.learn_blind(TASK, 0, 20, Learning()))
    assert pouring.error(reported.poured, TASK.target).mean < 0.75 * pouring.error(blind.poured, TASK.target).mean


def test_inputs_are_changes_from_the_standing_and_the_lifted_cylinder():
    z = np.arange(10, dtype=np.float32)[:, None, None] ** 2 * np.ones((1, 2, 1), np.float32)
    table = pouring_policy.input_table(z)
    assert table.shape == (7, 2, 4)
    np.testing.assert_array_equal(table[5, 1], [64, 9, 64 - 9, 64 - 25])  # segment 8
    np.testing.assert_array_equal(table[0, 0], [9, 9, 0, 0])
    np.testing.assert_array_equal(table[1, 0], [16, 9, 7, 7])


def test_blind_inputs_hold_time_and_own_actions_only():
    actions = np.array([[WAIT], [POUR], [POUR], [RETRACT]])
    result = bounds.blind_inputs(actions)[:, 0] * 100
    np.testing.assert_allclose(result, [[0, 0, 0, 0], [1, 0, 1, 0], [2, 1, 1, 0], [3, 2, 1, 0]], atol=1e-4)


def test_the_loss_by_hand():
    logits, choices = jnp.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]), jnp.array([1, 0])
    assert float(pouring_policy.imitation_loss(logits, choices)) == pytest.approx(np.log(3) / 2, rel=1e-6)


def test_features_of_demonstrations_are_those_of_the_encoder(shown, encoder):
    z = pouring_policy.features(encoder, shown, stills=False, batch=8)
    assert z.shape == (7, 2, 24)
    clip = shown.frames[2:5, 1][None]
    np.testing.assert_allclose(z[2, 1], encoder.encode_touch(clip, "gelsight_mini", pooling="both")[0], atol=1e-5)
    still = pouring_policy.features(encoder, shown, stills=True, pooling="mean", batch=8)
    frame = encoder.encode_touch(shown.frames[4, 1], "gelsight_mini", pooling="mean")
    np.testing.assert_allclose(still[2, 1], frame[0], atol=1e-5)
    assert np.abs(z[..., 12:] - still).max() > 1e-4


def test_moments_that_are_learned_have_all_their_inputs(shown, encoder):
    """Every LAG-th moment: the segment before one is that of another, so the rest need not be embedded."""
    z = pouring_policy.features(encoder, shown, stills=True, batch=8)
    learned = (np.arange(4)[:, None] - np.array([0, 1])) % pouring_policy.LAG == 0
    part = pouring_policy.features(encoder, shown, stills=True, batch=8, learned=learned)
    assert (part != 0).any(-1).sum() == 3 + 3 < (z != 0).any(-1).sum()  # of run 0 the numbers 0, 3, 6, of run 1 0, 3, 4
    whole, few = (pouring_policy.moments(shown, pouring_policy.input_table(one), learned) for one in (z, part))
    assert len(whole[0]) == 3
    for one, other in zip(whole, few, strict=True):
        np.testing.assert_array_equal(one, other)


def test_touch_sees_in_a_run_what_it_learned_from(shown, encoder):
    """The closed loop feeds the MLP the same inputs as the table of the demonstrations; its last moments vote."""
    policy = pouring_policy.learn_frozen(encoder, shown, replace(FAST, steps=5, votes=3), stills=False)
    z = pouring_policy.features(encoder, shown, stills=False, batch=8)
    lines = pouring_policy.log_probabilities(policy.head, pouring_policy.input_table(z).reshape(8, -1)).reshape(4, 2, 3)
    policy.begin(2)
    acted = [policy.act(frames, None) for frames in shown.frames]
    assert (np.stack(acted[:5]) == WAIT).all()
    voted = np.stack([lines[max(0, moment - 2) : moment + 1].mean(0) for moment in range(4)])
    np.testing.assert_array_equal(np.stack(acted[5:]), voted.argmax(-1))


def test_a_moment_astray_is_outvoted_and_two_are_not(encoder, monkeypatch):
    quiet, astray = np.log([[0.9, 0.09, 0.01]]), np.log([[0.05, 0.05, 0.9]])
    for moments, wanted in (
        ([quiet, quiet, astray, quiet], [POUR] * 4),
        ([quiet, astray, astray], [POUR, POUR, RETRACT]),
    ):
        lines = iter(moments)
        monkeypatch.setattr(pouring_policy, "log_probabilities", lambda head, x, lines=lines: next(lines))
        policy = pouring_policy.Touch(encoder, None, stills=True, votes=3)
        policy.begin(1)
        frames = np.zeros((1, SIDE, SIDE, 3), np.uint8)
        acted = [int(policy.act(frames)[0]) for _ in range(START + len(moments))]
        assert acted == [WAIT] * START + wanted
    assert pouring_policy.Touch(encoder, None, stills=True).votes == 1


def test_fine_tuning_trains_the_encoder_and_keeps_the_first_policy(shown, encoder):
    policy = pouring_policy.learn_frozen(encoder, shown, replace(FAST, steps=5), stills=False)
    before = jax.tree.map(np.array, encoder.params)
    tuned = pouring_policy.fine_tune(policy, shown, FAST)
    moved = jax.tree.map(lambda a, b: float(np.abs(np.asarray(a) - np.asarray(b)).max()), tuned.encoder.params, before)
    assert max(jax.tree.leaves(moved)) > 1e-5
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(np.array, encoder.params), before)
    result = pouring.run(replace(TASK, limit=9), *pouring.draw_runs(TASK, 3, 2), tuned, side=SIDE)
    assert result.poured.shape == (2,) and result.frames is None


def test_fine_tuning_that_diverges_is_reported(shown, encoder):
    policy = pouring_policy.learn_frozen(encoder, shown, replace(FAST, steps=5), stills=False)
    with pytest.raises(UserError, match=r"went astray .*lower tune_rate"):
        pouring_policy.fine_tune(policy, shown, replace(FAST, tune_steps=12, tune_rate=1e30))


def test_fine_tuning_decides_on_what_the_closed_loop_sees(shown, encoder):
    """Before the first step, the logits of a chain are those of the frozen policy at its moments."""
    policy = pouring_policy.learn_frozen(encoder, shown, replace(FAST, steps=5), stills=False)
    z = pouring_policy.features(encoder, shown, stills=False, batch=8)
    wanted = np.asarray(pouring_policy.forward(policy.head, pouring_policy.input_table(z).reshape(8, -1)))
    chains = pouring_policy.draw_chains(np.random.default_rng(0), shown.steps, 6, 3)
    where = np.stack([chains.numbers, np.broadcast_to(chains.runs[:, None], chains.numbers.shape)], -1)
    clips = pouring_policy.segments(encoder, shown.frames, where.reshape(-1, 2), 3).reshape(6, 6, 3, SIDE, SIDE, 3)
    params = {"encoder": encoder.params, "head": {"basis": policy.head.basis, "layers": policy.head.layers}}
    row = encoder.sensor_row(policy.sensor)
    result = pouring_policy.logits_of(params, clips, net=encoder.net, pooling="both", mean=policy.head.mean, sensor=row)
    moment = chains.numbers[:, 3:] - pouring_policy.LIFTED
    runs = np.broadcast_to(chains.runs[:, None], moment.shape)
    expected = wanted.reshape(4, 2, 3)[moment, runs]
    np.testing.assert_allclose(result[chains.inside], expected[chains.inside], atol=1e-4 * np.abs(wanted).max())


def test_every_moment_of_choice_is_as_likely_in_a_chain():
    steps = np.array([START + 1, START + 20])
    chains = pouring_policy.draw_chains(np.random.default_rng(0), steps, 30_000, 3)
    now, before = chains.numbers[:, 3:], chains.numbers[:, 2:-1]
    np.testing.assert_array_equal(np.maximum(now - pouring_policy.LAG, pouring_policy.LIFTED)[chains.inside],
                                  before[chains.inside])  # fmt: skip
    for run, moments in enumerate(steps - START):
        met = np.bincount((now - pouring_policy.LIFTED)[(chains.runs == run)[:, None] & chains.inside])
        assert len(met) == moments and met.min() > 0.9 * met.mean() and met.max() < 1.1 * met.mean()


def test_a_mirror_turns_whole_runs(shown, encoder):
    where, sides = np.array([[0, 0], [3, 1]]), np.array([[1, 0], [0, 1]])
    plain, turned = (pouring_policy.segments(encoder, shown.frames, where, 3, one) for one in (None, sides))
    np.testing.assert_array_equal(turned[0], plain[0, :, ::-1])
    np.testing.assert_array_equal(turned[1], plain[1, :, :, ::-1])


def test_without_a_look_nothing_is_drawn(monkeypatch):
    monkeypatch.setattr(pouring, "hold", lambda *a, **k: pytest.fail("contact was solved"))
    monkeypatch.setattr(pouring, "look", lambda *a, **k: pytest.fail("a frame was drawn"))
    setups, keys = pouring.draw_runs(TASK, 0, 2)
    assert pouring.run(replace(TASK, limit=4), setups, keys, pouring.Expert(TASK)).frames is None


def test_mistakes_are_one_sentence(reported, encoder):
    with pytest.raises(UserError, match="no frames"):
        pouring_policy.features(encoder, reported, stills=True)
    with pytest.raises(UserError, match="not finite"):
        pouring_policy.imitate(np.full((4, 2), np.nan), np.zeros(4, int), np.arange(4), FAST)
    with pytest.raises(UserError, match="tune_steps"):
        Learning(tune_steps=0)
    with pytest.raises(UserError, match=r"dropout .*below 1, not 1"):
        Learning(dropout=1.0)


def test_the_film_shows_every_page(shown, tmp_path):
    pouring.write_film(tmp_path / "deep" / "run.gif", shown, TASK, every=3)
    with Image.open(tmp_path / "deep" / "run.gif") as film:
        assert film.n_frames == 4 and film.size == (440, 180)
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(3)
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - first).mean() > 0.2
