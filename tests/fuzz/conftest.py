"""What hostile inputs are made from: a small world, a run, weights, features and a head that are
whole.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import make_world
from tiny_models import tiny_config
from weights_world import params_of, save_run

from anytouch_jax.cli.app import main
from anytouch_jax.config import Config
from anytouch_jax.encoder.linear_head import LinearHead, save_head


@dataclass(frozen=True)
class Things:
    """Whole inputs: a manifest, a folder with one image, a run, its weights, features of the
    manifest and a head.
    """

    manifest: Path
    frames: Path
    run: Path
    config: Config
    weights: Path
    release: Path
    features: Path
    head: Path


@pytest.fixture(scope="session")
def things(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    manifest = make_world(folder / "world")
    config = tiny_config()
    run = save_run(
        folder / "run",
        config,
        params_of(config.model),
        seen=["digit", "gelsight_mini"],
        data="0" * 64,
    )
    (run / "metrics.jsonl").write_text(
        "".join(json.dumps({"step": i, "loss": 1 / (i + 1)}) + "\n" for i in range(3))
    )
    frames = folder / "frames"
    frames.mkdir()
    cv2.imwrite(
        str(frames / "0.png"), np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    )
    paths = {
        name: folder / f"{name}.{end}"
        for name, end in {
            "weights": "safetensors",
            "release": "safetensors",
            "features": "npz",
            "head": "npz",
        }.items()
    }
    assert (
        main(["export", "--to", "safetensors", "--model", str(run), "--out", str(paths["weights"])])
        == 0
    )
    assert (
        main(["export", "--to", "release", "--model", str(run), "--out", str(paths["release"])])
        == 0
    )
    assert (
        main(
            ["embed", "--model", str(run), "--data", str(manifest), "--out", str(paths["features"])]
        )
        == 0
    )
    with np.load(paths["features"]) as file:
        fingerprint = str(file["about/weights"])
    arrays = (np.zeros((12, 1)), np.zeros(1), np.zeros(12), np.ones(12))
    save_head(
        paths["head"],
        LinearHead(np.array(["ball", "cube"]), *arrays, "object", "class", 1, fingerprint),
    )
    return Things(manifest, frames, run, config, **paths)
