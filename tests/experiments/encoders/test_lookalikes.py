import numpy as np
import pytest
from touch_world import make_touches

from experiments.encoders import lookalikes
from experiments.pages.encoders import lookalikes as page
from experiments.records import write_record


def test_a_perfect_encoder_finds_every_touch_and_noise_finds_chance(tmp_path, monkeypatch):
    data = make_touches(tmp_path / "data", touches={"test": 52, "train": 2}, frames=1)
    rng = np.random.default_rng(0)

    def embed(encoder, table, rows, **_):
        codes = table.codes("touch")[rows] if encoder != "noise" else np.arange(len(rows))
        return rows, rng.normal(size=(1000, 16))[codes].astype(np.float32)

    monkeypatch.setattr(lookalikes, "embed_rows", embed)
    record = lookalikes.recall({"a": "perfect", "b": "noise"}, data)
    scores = {name: one["share"] for name, one in record["scores"].items()}
    assert set(scores) == {"a", "b", "pixels"} and record["touches"] == 52 * 3
    assert scores["a"] == 1.0 and scores["b"] < 0.1
    write_record(tmp_path / "lookalikes.jsonl", "fine", record | {"encoders": {"a": "mark"}})
    made = page(tmp_path)
    assert made.tables[0][0][:2] == ("fine alignment", "a") and made.readme["a"].mean == pytest.approx(100)
    assert made.findings == [f"fine alignment: `a` finds 100 %, and pixels {100 * scores['pixels']:.0f} %."]
