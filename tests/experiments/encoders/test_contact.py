"""Readers of contact: the difference finds the presses of a film, and an undecided frame counts as such."""

from __future__ import annotations

import sys

import cv2
import numpy as np
from measuring import measuring_weights
from press_films import SENSORS, gel_frame, press_film

from anytouch_jax.data.manifest import manifest as manifests
from experiments.encoders import contact
from experiments.records import read_records


def test_readers_are_compared_on_the_frames_of_films(tmp_path, monkeypatch):
    rows = {name: [] for name in ("path", "sensor", "sequence", "frame_index", "split", "background_path")}
    rows["label.force"] = []
    cv2.imwrite(str(tmp_path / "gel.png"), gel_frame("coloured", 0.0)[..., ::-1])
    for film, shape in enumerate(("ball", "bar")):
        for number, (frame, touched) in enumerate(zip(*press_film("coloured", 0.5, shape, 12), strict=True)):
            path = f"{film}_{number}.png"
            cv2.imwrite(str(tmp_path / path), frame[..., ::-1])
            values = (path, SENSORS["coloured"], f"film {film}", number, "test", "gel.png", float(touched))
            for name, value in zip(rows, values, strict=True):
                rows[name].append(value)
    manifests.write(manifests.from_columns(rows, tmp_path / "m.csv"), tmp_path / "m.csv")
    model, out = measuring_weights(tmp_path / "w.safetensors"), tmp_path / "contact.jsonl"
    monkeypatch.setattr(sys, "argv", ["", "films", str(tmp_path / "m.csv"), f"--model={model}", f"--out={out}"])
    contact.main()
    records = read_records(out)
    assert len(records) == 5 and all(one["frames"] == 24 for one in records.values())
    own = records["films, difference, own picture"]
    assert own["auroc"][0] == own["hits"][0] == own["decided"][0] == 1 and own["alarms"][0] == 0
    assert all(0 <= one["auroc"][0] <= 1 for one in records.values())
    undecided = contact.figures(np.array([np.nan, 1, 9, 9]), np.full(4, 5.0), np.array([0, 0, 1, 1]), np.arange(4))
    assert undecided["decided"][0] == 0.75 and undecided["hits"][0] == undecided["auroc"][0] == 1
