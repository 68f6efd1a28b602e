"""Training of the encoder in the package: stage 1, stage 2, then the folder with its card.

    python -m experiments.encoders.train --minutes 12 --real data/real/pack2/manifest.csv --out
    runs/anytouch-tiny

Each stage gets a fraction of the time, compilation included, and its schedule follows the time. The
next call starts from the weights in OUT/state, on this machine or another, and trains stage 2 again
for its whole time: a cycle. Touches are simulated in the training program. With a GPU the batches
are large and the arithmetic has 16 bits.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import jax

from anytouch_jax.config import Config, preset
from anytouch_jax.sim.batches import SIMULATED
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import to_stderr as log
from anytouch_jax.training import CHECKPOINTS, pretrain
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import PARTS, write_encoder

SETTINGS: dict[str, Any] = {
    "model.embed": 192,
    "model.fields": 32,
    "data.background": "either",
    "data.jitter": (0.0, 0.0, 0.0, 0.0),
    "data.affine": (10.0, 0.05, 0.15),
    "run.figure_every": 0,
    "run.save_every": 2000,
    "run.keep": 1,
    "run.steps": 10_000,
    "optim.warmup": 400,
    "optim.grad_clip": 10.0,
    "simulated.wild": 0.25,
    "simulated.variants": 3,
    "simulated.vision": 0.0,
}
STAGES: dict[int, dict[str, Any]] = {
    1: {
        "optim.learning_rate": 1e-3,
        "objective.norm_pix_loss": True,
        "objective.field_weight": 0.1,
    },
    2: {
        "optim.learning_rate": 8e-4,
        "model.match_head": "cosine",
        "objective.match_weight": 4.0,
        "objective.field_weight": 0.2,
        "data.clip_fraction": 0.34,
    },
}
# Device: touches of a batch of stage 1, pairs of stage 2, fraction of the patches that matching
# encodes, more settings.
DEVICES: dict[str, tuple[int, int, float, dict[str, Any]]] = {
    "gpu": (1024, 640, 0.6, {"model.dtype": "bfloat16"}),
    "cpu": (32, 32, 0.5, {"simulated.reuse": 4}),
}
STATE = "state"
ALL = (*PARTS, "decoder", "fields")


def configure(
    stage: Literal[1, 2], real: Sequence[str], cycle: int, changes: Mapping[str, Any]
) -> Config:
    """Return the configuration of a stage of the recipe on this device."""
    first, second, keep, more = DEVICES["cpu" if jax.default_backend() == "cpu" else "gpu"]
    settings = (
        SETTINGS | STAGES[stage] | more | {"run.seed": cycle, "data.manifests": (SIMULATED, *real)}
    )
    settings["data.batch_size"] = first if stage == 1 else second
    if real:
        settings |= {
            "data.contact_only": True,
            "data.weights": ((SIMULATED, 9.0 if stage == 1 else 6.0),),
        }
    config = preset("tiny", stage=stage)
    if stage == 2:
        assert config.model.text is not None
        text = replace(config.model.text, stack=replace(config.model.text.stack, depth=2))
        settings |= {"objective.match_keep": keep, "model.image": None, "model.text": text}
    return config.with_settings({**settings, **changes})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--minutes", type=float, default=12.0, help="wall time of this call, compilation included"
    )
    parser.add_argument("--real", nargs="*", default=[], help="manifests of real recordings")
    parser.add_argument("--out", type=Path, default=Path("runs/anytouch-tiny"))
    parser.add_argument(
        "--stage1-fraction", type=float, default=0.3, help="of the time of the first call"
    )
    parser.add_argument(
        "--stages", type=int, nargs="+", default=[1, 2], help="stages to train in a first call"
    )
    parser.add_argument(
        "--set",
        nargs="*",
        default=[],
        metavar="SECTION.FIELD=VALUE",
        help="other settings, as JSON",
    )
    given = parser.parse_args()
    changes = {
        name: json.loads(value) for name, _, value in (word.partition("=") for word in given.set)
    }
    begun = time.monotonic()
    end = begun + 60 * given.minutes
    state = given.out / STATE
    enable_compilation_cache()
    cycle = len(list(given.out.glob("cycle-*")))
    init = state if state.exists() else None
    stages = [2] if init else given.stages
    for stage in stages:
        run = given.out / f"cycle-{cycle:02d}" / f"stage{stage}"
        until = end if stage == stages[-1] else begun + 60 * given.minutes * given.stage1_fraction
        config = configure(stage, given.real, cycle, changes)
        result = pretrain(config, run, init=init, log=log, until=until)
        log(
            f"stage {stage}: {result.step} steps of {config.data.batch_size}, loss "
            f"{result.metrics.get('loss')}"
        )
        if result.interrupted:
            raise SystemExit(130)
        loaded = load_model(run)
        tokenizer = run / "tokenizer.json"
        write_encoder(state, loaded, parts=ALL, tokenizer=tokenizer if tokenizer.exists() else None)
        shutil.copyfile(run / "metrics.jsonl", given.out / f"cycle-{cycle:02d}-stage{stage}.jsonl")
        if stage == 2:
            notes = Path(__file__).with_name("anytouch-tiny.md").read_text(encoding="utf-8")
            write_encoder(
                given.out / "anytouch-tiny",
                loaded,
                notes,
                parts=(*PARTS, "fields"),
                tokenizer=tokenizer,
            )
        shutil.rmtree(run / CHECKPOINTS)  # the state is what goes on
        init = state


if __name__ == "__main__":
    main()
