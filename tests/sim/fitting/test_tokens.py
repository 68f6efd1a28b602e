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
from anytouch_jax.errors import CheckError
from anytouch_jax.nn.functional import build
from anytouch_jax.sim.endless import SimulatedTouches
from anytouch_jax.sim.fitting import contrast, tokens
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
    return SimulatedTouches(
        clip, np.full_like(clip[:, :, 0], 128), sensor, none, none, None, None, None, None, {}
    )


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
    scores = iter((0.2, 0.4) * 2)
    monkeypatch.setattr(tokens, "_found", lambda *_: next(scores))
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


def test_tokens_that_find_fewer_touches_are_not_saved(run, mine, tmp_path, monkeypatch):
    scores = iter((0.4, 0.2))
    monkeypatch.setattr(tokens, "_found", lambda *_: next(scores))
    with pytest.raises(CheckError, match=r"find 20\.0% .* nothing is saved"):
        tokens.adapt_by_simulation(run, mine, minutes=0.01)


def test_training_finds_touches_that_the_universal_tokens_do_not(run, mine, monkeypatch):
    monkeypatch.setattr(tokens, "BATCHES", 2)
    monkeypatch.setattr(contrast, "DEEP_RATE", 3e-3)
    adapted = tokens.adapt_by_simulation(run, mine, minutes=0.25, deep=True)
    assert len(adapted.losses) == 150 and adapted.after > adapted.before


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
