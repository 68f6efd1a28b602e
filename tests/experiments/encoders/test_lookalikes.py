"""Recall@1 among look-alikes, and a sensor that was left out: perfect encoders, noise, pixels, and the pages."""

from __future__ import annotations

import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from touch_world import make_touches

from anytouch_jax.data.manifest import manifest as manifests
from experiments.encoders import held_out, lookalikes
from experiments.encoders.train import leave_out
from experiments.pages import studies
from experiments.pages.studies import lookalikes as page
from experiments.records import write_record


def test_a_perfect_encoder_finds_every_touch_and_noise_finds_chance(tmp_path, monkeypatch):
    data = make_touches(tmp_path / "data", touches={"test": 52, "train": 2}, frames=1)
    rng = np.random.default_rng(0)

    def embed(encoder, table, rows, **_):
        codes = table.codes("touch")[rows] if encoder != "noise" else np.arange(len(rows))
        if encoder == "without digit":
            codes = np.where(table.text_column("sensor")[rows] == "digit", np.arange(len(rows)), codes)
        return rows, rng.normal(size=(1000, 16))[codes].astype(np.float32)

    monkeypatch.setattr(lookalikes, "embed_rows", embed)
    record = lookalikes.recall({"a": "perfect", "b": "noise"}, data)
    scores = {name: one["share"] for name, one in record["scores"].items()}
    assert set(scores) == {"a", "b", "pixels"} and record["touches"] == 52 * 3
    assert scores["a"] == 1.0 and scores["b"] < 0.1
    write_record(tmp_path / "lookalikes.jsonl", "fine", record | {"encoders": {"a": "mark"}})
    made = page(tmp_path)
    assert made.rows[0][:2] == ("fine alignment", "a") and made.rows[0][2].mean == pytest.approx(100)
    assert made.findings == [f"fine alignment: `a` names 100 % of the touches, pixels {100 * scores['pixels']:.0f} %."]
    record = lookalikes.recall({"a": "without digit", "b": "perfect"}, data, "digit")
    assert record["scores"]["a"]["share"] < 0.1 and record["scores"]["b"]["share"] == 1.0
    write_record(tmp_path / "lookalikes.jsonl", "fine digit", record | {"encoders": {"a": "mark"}, "left_out": "digit"})
    assert "fine alignment, queries by digit, left out of stage 2" in [row[0] for row in page(tmp_path).rows]


def test_a_manifest_without_a_sensor(tmp_path):
    data = make_touches(tmp_path / "data", touches={"test": 2, "train": 2}, frames=1)
    rest = leave_out(data, "digit")
    left = manifests.read(rest)
    assert set(left.text_column("sensor")) == set(manifests.read(data).text_column("sensor")) - {"digit"}
    assert left.file(0).exists()


@pytest.mark.slow
def test_probes_of_a_sensor_left_out(tmp_path, monkeypatch):
    """Features that hold a label read it on new objects, and noise does not."""
    data = make_touches(tmp_path / "data", touches={"test": 30, "train": 60, "val": 20}, frames=1)
    table = manifests.read(data)
    labels = table.codes("touch") % 2
    names = [f"label.{name}" for name in held_out.LABELS]
    wide = table.table.drop_columns([name for name in names if name in table.table.column_names])
    for name in names:
        wide = wide.append_column(name, pa.array(labels.astype(str)))
    pq.write_table(wide, path := data.with_name("labelled.parquet"))

    def embed(encoder, table, rows, **_):
        noise = np.random.default_rng(0).normal(size=(len(rows), 8))
        return rows, (noise + 5 * labels[rows, None] * (encoder == "run")).astype(np.float32)

    class Encoder(str):
        fingerprint = "mark"

    monkeypatch.setattr(held_out, "embed_rows", embed)
    monkeypatch.setattr(held_out, "load", Encoder)
    monkeypatch.setattr(
        sys, "argv", ["held_out", "--model", "run", "--data", str(path), "--out", str(tmp_path / "held_out.jsonl")]
    )
    held_out.main()
    rows, findings = studies._held_out(tmp_path)
    assert [row[3] for row in rows] == list(held_out.LABELS)
    assert rows[0][4].mean > 95 and rows[0][5].low > 10
    assert all("points above an untrained encoder" in one for one in findings)
