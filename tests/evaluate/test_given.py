"""`anytouch probe --features`: features from a file stand beside those of a run."""

from __future__ import annotations

import json

import numpy as np
import pytest
from touch_world import make_touches

from anytouch_jax.cli.app import main


@pytest.fixture(scope="module")
def touches(tmp_path_factory):
    return make_touches(tmp_path_factory.mktemp("touches"), touches={"train": 8, "val": 4, "test": 4}, each=1)


@pytest.fixture(scope="module")
def features(tmp_path_factory, touches, tiny_run):
    """What `embed` gives for the whole manifest."""
    out = tmp_path_factory.mktemp("given") / "mine.npz"
    words = ["embed", "--run", tiny_run, "--input", touches, "--pooling", "both", "--out", out]
    assert main([str(word) for word in words]) == 0
    return out


@pytest.mark.parametrize("what", [["--label", "hardness"], ["--tasks", "hardness"]])
def test_features_of_a_file_score_as_the_run_that_made_them(touches, tiny_run, features, tmp_path, what):
    out = tmp_path / "r.json"
    words = ["probe", "--run", tiny_run, "--features", features, "--data", touches, "--seeds", "1", "--no-controls"]
    assert main([str(word) for word in [*words, *what, "--out", out]]) == 0
    found = json.loads(out.read_text())
    found = found["results"] if isinstance(found, dict) else found
    name = "features" if "features" in found[0] else "probe"
    ours, mine = ([one for one in found if one[name].startswith(str(path))] for path in (tiny_run, features))
    assert ours and len(ours) == len(mine)
    for one, other in zip(ours, mine, strict=True):
        for key in ("accuracy", "mean", "low", "high", "train", "test", "n_test", "penalty"):
            assert one.get(key) == other.get(key)


def test_a_file_that_does_not_fit_is_one_sentence(touches, tiny_run, features, tmp_path, capsys):
    def told(path, *words, run="--features"):
        args = ["probe", run, path, "--data", touches, "--label", "hardness", "--no-controls", *words]
        assert main([str(word) for word in args]) == 1
        return capsys.readouterr().err

    with np.load(features) as file:
        arrays = dict(file)

    def written(**change):
        path = tmp_path / "odd.npz"
        np.savez(path, **{name: one for name, one in (arrays | change).items() if one is not None})
        return path

    few = {name: arrays[name][3:] for name in ("features", "rows", "key/path")}
    assert "odd.npz lacks 3 of the 48 rows that are probed" in told(written(**few))
    assert "needs the arrays features (n, d) and rows (n,)" in told(written(rows=None))
    assert "rows must each be named once, from 0 to 47" in told(written(rows=np.arange(48) + 1))
    assert "features of another manifest" in told(written(rows=np.arange(48)[::-1]))
    assert "3 frames a touch; 1 are probed: give --frames 3" in told(written(**{"about/frames": "3"}))
    assert "mine.npz is a features file" in (said := told(features, run="--run")) and "as --features" in said
