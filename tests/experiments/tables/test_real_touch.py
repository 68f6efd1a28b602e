"""`experiments/tables/real_touch.py` from top to bottom on a small world."""

from __future__ import annotations

import json
import runpy

import pytest
from places import EXPERIMENTS
from touch_world import make_touches

from anytouch_jax.data.manifest import manifest as manifests

SCRIPT = EXPERIMENTS / "tables" / "real_touch.py"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_every_table_is_written(tmp_path, tiny_run, monkeypatch, capsys):
    file = make_touches(tmp_path / "data", touches={"train": 16, "val": 8, "test": 8}, frames=5, size=28, each=2)
    table = manifests.read(file)
    columns = {name: table.column(name).to_pylist() for name in table.table.column_names}
    number = [int(name.split("/")[1]) for name in columns["sequence"]]
    columns |= {"sensor": ["gelsight_mini"] * len(number), "label.contact_score": [9.0] * len(number)}
    columns |= {"object": [f"thing{n % 4}" for n in number], "label.object": [f"thing{n % 4}" for n in number]}
    columns["label.slip"] = [str(n // 2 % 2) for n in number]
    manifests.write(manifests.from_columns(columns, file), file)
    paths = {"DATA": file, "STAGE1": tiny_run, "STAGE2": tiny_run, "OUT": tmp_path / "out", "LABELLED": tmp_path / "l"}
    for name, value in (paths | {"LABELLED_STEPS": 2}).items():
        monkeypatch.setenv(name, str(value))
    runpy.run_path(str(SCRIPT))
    text = (tmp_path / "out" / "real_touch.md").read_text()
    for title in ("Stage 1: pixels", "Object, test recordings", "Trained with labels: ", "Slip, objects left out"):
        assert title in text
    record = json.loads((tmp_path / "out" / "real_touch.json").read_text())
    assert {"pixels", "object", "differences", "slip", "labelled_train"} <= record.keys()
