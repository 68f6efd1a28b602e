import numpy as np
import pytest
from touch_world import make_touches

from anytouch_jax.config import from_json, to_json
from anytouch_jax.nn.functional import build
from anytouch_jax.sim.batches import SIMULATED
from anytouch_jax.weights.tree import flatten
from experiments.encoders import lookalikes, motion, trunk
from experiments.encoders.train import configure
from experiments.pages.encoders import lookalikes as page
from experiments.records import write_record


def test_a_stage_is_understood_and_its_encoder_keeps_its_size():
    for stage in (1, 2):
        config = configure(stage, ["a.csv"], 3, {"data.batch_size": 16})
        assert config.stage == stage and config.run.seed == 3 and config.data.batch_size == 16
        assert (
            config.data.manifests == (SIMULATED, "a.csv") and from_json(to_json(config)) == config
        )
        params = build(config.model).abstract()
        millions = {
            name: sum(leaf.size for leaf in flatten(part).values()) / 1e6
            for name, part in params.items()
        }
        assert millions["touch"] < 4 and millions["fields"] < 2


RNG = np.random.default_rng(0)


@pytest.mark.slow
def test_it_learns_a_field_that_no_mean_shows(monkeypatch):
    """The first two values of a token change with the field of a turn, whose mean over the image
    is zero.
    """
    monkeypatch.setattr(motion, "EPOCHS", 30)
    n = 300
    side = 4
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
    assert found["turn"]["fraction"] > 0.95 and found["slide"]["clips"] == 0
    assert motion.pooled_score(clips, splits) < 0.75


def test_a_perfect_encoder_finds_every_touch_and_noise_finds_chance(tmp_path, monkeypatch):
    data = make_touches(tmp_path / "data", touches={"test": 52, "train": 2}, frames=1)
    rng = np.random.default_rng(0)

    def embed(encoder, table, rows, **_):
        codes = table.codes("touch")[rows] if encoder != "noise" else np.arange(len(rows))
        return rows, rng.normal(size=(1000, 16))[codes].astype(np.float32)

    monkeypatch.setattr(lookalikes, "embed_rows", embed)
    record = lookalikes.recall({"a": "perfect", "b": "noise"}, data)
    scores = {name: one["fraction"] for name, one in record["scores"].items()}
    assert set(scores) == {"a", "b", "pixels"} and record["touches"] == 52 * 3
    assert scores["a"] == 1.0 and scores["b"] < 0.1
    write_record(tmp_path / "lookalikes.jsonl", "fine", record | {"encoders": {"a": "mark"}})
    made = page(tmp_path)
    assert made.tables[0][0][:2] == ("fine alignment", "a") and made.readme[
        "a"
    ].mean == pytest.approx(100)
    assert made.findings == [
        f"fine alignment: `a` finds 100 %, and pixels {100 * scores['pixels']:.0f} %."
    ]


def test_the_readout_takes_out_what_units_differ_by() -> None:
    rng = np.random.default_rng(0)
    names = np.repeat([f"touch {number}" for number in range(40)], 2)
    own = np.repeat(rng.standard_normal((40, 6)), 2, axis=0)
    unit = np.tile(["cam0", "cam2"], 40)
    # The first two features tell the unit, and little of the touch.
    features = own + np.where(unit == "cam0", 3.0, -3.0)[:, None] * np.array([1, -1, 0, 0, 0, 0])
    images = np.zeros((80, 1, 1, 3), np.uint8)
    pairs = rng.standard_normal((30, 1, 6)) + rng.normal(0, 0.1, (30, 2, 6))
    touches = trunk.RealTouches(images, names, unit)
    kernel = trunk.whitening(trunk.scatter_within(features, touches, pairs))
    assert np.allclose(kernel, kernel.T)

    def apart(values: np.ndarray) -> float:
        between = values[unit == "cam0"].mean(0) - values[unit == "cam2"].mean(0)
        return float(np.linalg.norm(between) / values.std())

    assert apart(features @ kernel) < 0.6 * apart(features)
    # Where no unit differs, nothing is preferred.
    assert np.allclose(trunk.whitening(np.eye(6)), trunk.whitening(np.eye(6))[0, 0] * np.eye(6))
