"""`anytouch export`: what is written and said."""

import numpy as np

from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.encoder.export import load


def test_export_writes_an_artefact_and_says_how_far_it_is_from_the_live_model(anytouch, tmp_path, tiny_run):
    out = tmp_path / "made" / "model.bin"
    said = anytouch("export", "--run", tiny_run, "--out", out, "--frames", 1, "--platforms", "cpu, cuda")
    assert said.status == 0, said
    assert "for cpu, cuda" in said.out and "from the live model (1 and 5 touches)" in said.out
    assert f"{out}.json: how to call it" in said.out
    frames = np.random.default_rng(0).integers(0, 256, (2, 1, 28, 28, 3), np.uint8)
    live = load_encoder(tiny_run).encode_touch(frames, "digit")
    np.testing.assert_allclose(load(out)(frames, "digit"), live, atol=1e-5)
    assert anytouch("export", "--run", tiny_run, "--out", out, "--dtype", "bfloat16").status == 0
    assert 1e-5 < np.abs(load(out)(frames, "digit") - live).max() / np.abs(live).max() < 0.05


def test_mistakes_of_export(mistake, tmp_path, tiny_run):
    args = ("export", "--run", tiny_run, "--out", tmp_path / "m.bin")
    assert "not gpu" in mistake(*args, "--platforms", "cpu,gpu")
    assert "a clip needs 3 frames" in mistake(*args, "--frames", 2)
    assert "no run folder" in mistake("export", "--run", tmp_path / "gone", "--out", tmp_path / "m.bin")
    assert list(tmp_path.iterdir()) == []
