"""Tokens trained on simulated touches: only they move, an interrupted training goes on, worse ones
are not saved.
"""

import signal
from itertools import count
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from runs import run_config

from anytouch_jax.cli import app
from anytouch_jax.config import to_json
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.nn.functional import build
from anytouch_jax.sim.endless import SimulatedTouches
from anytouch_jax.sim.fitting import comparison, contrast, tokens
from anytouch_jax.sim.sensing.own import OwnSensor, write_sensor
from anytouch_jax.sim.sensing.sensors import SENSORS, look
from anytouch_jax.train import pace
from anytouch_jax.weights import checkpoint
from anytouch_jax.weights.tree import flatten


def felt(key, world, *, size):
    """Touches of random patterns. Your sensor shows their negative."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    seen = (
        rng.integers(80, 176, (contrast.COUNT, 1, 1, 4, 4, 3))
        .repeat(size // 4, 3)
        .repeat(size // 4, 4)
    )
    clip = np.concatenate([seen, 255 - seen], 1).astype(np.uint8)
    sensor = np.stack([1 + np.arange(contrast.COUNT) % 2, np.zeros(contrast.COUNT, int)], 1).astype(
        np.int32
    )
    none = np.zeros(contrast.COUNT, np.int32)
    thing = np.arange(contrast.COUNT, dtype=np.int32)
    return SimulatedTouches(
        clip, np.full_like(clip[:, :, 0], 128), sensor, thing, none, None, None, None, None, {}
    )


def found(share, objects=100, first=0):
    """Held-out touches of which a share is found, some of each object."""
    order = (np.arange(200) * 61 + first) % 200
    return comparison.Found(order < round(200 * share), np.arange(200, dtype=np.int32) % objects)


@pytest.fixture
def mine(tmp_path):
    gel = np.full((1, 30, 40, 3), 90, np.uint8)
    return write_sensor(
        tmp_path / "mine.sensor",
        OwnSensor("mine", 18.0, 13.5, (24, 32), 0.7, sure={}),
        gel,
        look(SENSORS["digit"]),
    )


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr(tokens, "own_touches", felt)
    monkeypatch.setattr(tokens, "own_world", lambda *_: None)
    ticks = count()
    # a step takes 0.1 s
    monkeypatch.setattr(pace, "time", SimpleNamespace(monotonic=lambda: 0.1 * next(ticks)))
    config = run_config(tmp_path / "none.csv").with_settings({"data.background": "subtract"})
    params = build(config.model).init(jax.random.key(0))
    params["touch"]["sensor_tokens"] = params["touch"]["sensor_tokens"] * 20
    store = checkpoint.Checkpoints(
        tmp_path / "run" / "checkpoints",
        keep=1,
        config_json=to_json(config),
        metadata={"seen": ["gelsight", "digit"]},
    )
    store.save(3, {"trainable": params}, {"loss": 1.0})
    store.close()
    return tmp_path / "run"


def stopping(monkeypatch, steps):
    """Let Ctrl-C arrive while the batch of a step is made."""
    real = tokens.felt_batches

    def batches(start, stop, **options):
        for step, batch, info in real(start, stop, **options):
            if step == steps - 1:
                signal.raise_signal(signal.SIGINT)
            yield step, batch, info

    monkeypatch.setattr(tokens, "felt_batches", batches)


@pytest.mark.parametrize("deep", [False, True])
def test_an_interrupted_training_ends_as_an_undisturbed_one_and_moves_only_what_it_may(
    run, mine, tmp_path, monkeypatch, capsys, deep
):
    words = [
        "adapt",
        "--model",
        str(run),
        "--sensor",
        str(mine),
        "--minutes",
        "0.05",
        "--out",
        str(tmp_path / "out"),
    ]
    words += ["--deep"] * deep
    with monkeypatch.context() as stopped:
        stopping(stopped, 18)
        assert app.main(words) == 130
    state = tmp_path / "out.part"
    assert state.is_dir() and not (tmp_path / "out").exists()
    scores = iter((found(0.2), found(0.4)) * 2)
    monkeypatch.setattr(tokens, "found_touches", lambda *_: next(scores))
    assert app.main(words) == 0 and not state.exists()
    assert "continuing from the checkpoint of step 18 of 30" in capsys.readouterr().err
    assert app.main([*words[: -1 - deep], str(tmp_path / "undisturbed"), *["--deep"] * deep]) == 0
    resumed, undisturbed = (
        flatten(checkpoint.load_params(tmp_path / name)[0]) for name in ("out", "undisturbed")
    )
    assert all(np.array_equal(values, undisturbed[name]) for name, values in resumed.items())
    before, after = (flatten(checkpoint.load_params(path)[0]) for path in (run, tmp_path / "out"))
    moved = {name for name, values in before.items() if not np.array_equal(values, after[name])}
    assert all(name.startswith("touch/") for name in moved) and "touch/sensor_tokens" in moved
    assert {name.split("/")[1] for name in moved} == (
        {"sensor_tokens", "patch", "blocks"} if deep else {"sensor_tokens"}
    )
    table = after["touch/sensor_tokens"]
    old = before["touch/sensor_tokens"]
    np.testing.assert_array_equal(table[: len(old)], old)
    assert (
        len(table) == len(old) + 1 and load_encoder(tmp_path / "out").trained_sensors[-1] == "mine"
    )


@pytest.mark.parametrize(
    ("universal", "trained", "objects", "kept"),
    [
        (0.40, 0.60, 100, "trained"),
        (0.40, 0.60, 1, "universal"),  # one object shows nothing about another one
    ],
)
def test_tokens_are_kept_if_they_are_shown_to_find_more(
    run, mine, tmp_path, monkeypatch, capsys, universal, trained, objects, kept
):
    scores = iter((found(universal, objects), found(trained, objects, first=7)))
    monkeypatch.setattr(tokens, "found_touches", lambda *_: next(scores))
    out = tmp_path / "out"
    words = ["adapt", "--model", str(run), "--sensor", str(mine), "--minutes", "0.01"]
    assert app.main([*words, "--out", str(out), "--deep"]) == 0
    printed = capsys.readouterr().out
    assert f"{trained:.1%}" in printed and f"{universal:.1%}" in printed
    assert ("no interval" if objects == 1 else "95 % interval") in printed
    assert ("keeps the universal tokens" in printed) == (kept == "universal")
    before, after = (flatten(checkpoint.load_params(path)[0]) for path in (run, out))
    moved = [
        name
        for name, values in before.items()
        if not np.array_equal(values, after[name][: len(values)])
    ]
    assert bool(moved) == (kept == "trained"), "with the universal tokens nothing else is trained"
    encoder = load_encoder(out)
    assert encoder.trained_sensors[-1] == "mine"


@pytest.mark.parametrize(
    ("universal", "trained", "objects", "shown"),
    [
        (0.40, 0.20, 100, False),
        (0.46, 0.48, 100, False),  # 2 points of 200 touches are chance
        (0.40, 0.60, 100, True),
        (0.40, 0.60, 1, False),
    ],
)
def test_a_gain_is_shown_if_chance_does_not_explain_it(universal, trained, objects, shown):
    compared = comparison.compare_found(found(universal, objects), found(trained, objects, first=7))
    assert compared.shown == shown


def test_the_interval_is_of_pairs_and_of_objects():
    """The same touches are compared, and those of one object count once."""
    alike = np.arange(200) % 2 == 0
    few = alike.copy()
    few[1:9:2] = True
    compared = comparison.compare_found(
        comparison.Found(alike, np.arange(200)), comparison.Found(few, np.arange(200))
    )
    assert compared.shown and compared.low > 0, "four touches more, and none less"
    assert (compared.universal, compared.trained, compared.touches) == (0.5, 0.52, 200)
    # The same four touches are of one object, which is drawn or is not.
    objects = np.where(np.arange(200) < 9, 0, np.arange(200))
    compared = comparison.compare_found(
        comparison.Found(alike, objects), comparison.Found(few, objects)
    )
    assert not compared.shown and compared.low == 0 and compared.objects == 192
    # Without pairs the interval would be as wide as that of two samples: some 10 points.
    assert compared.high - compared.low < 0.08


def test_training_finds_touches_that_the_universal_tokens_do_not(run, mine, monkeypatch):
    monkeypatch.setattr(tokens, "BATCHES", 2)
    monkeypatch.setattr(contrast, "DEEP_RATE", 3e-3)
    adapted = tokens.adapt_by_simulation(run, mine, minutes=0.25, deep=True)
    compared = adapted.metadata["source"]["compared"]
    assert len(adapted.losses) == 150 and compared["trained"] > compared["universal"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--sensor", "my_gel"], "or a sensor of `anytouch sensor fit`"),
        (["--sensor", "mine.sensor", "--labels", "x"], "--labels has no effect"),
        (["--sensor", "gone.sensor"], "gone.sensor/sensor.json: No such file"),
        (["--sensor", "my_gel", "--data", "x.csv", "--deep"], "--deep has no effect"),
    ],
)
def test_mistakes_are_one_sentence(run, tmp_path, monkeypatch, capsys, words, named):
    monkeypatch.chdir(tmp_path)
    assert app.main(["adapt", "--model", str(run), "--out", str(tmp_path / "out"), *words]) == 2
    assert named in capsys.readouterr().err
