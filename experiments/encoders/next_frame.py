"""Next-frame prediction against copying the last frame, on held-out objects.

    python -m experiments.encoders.next_frame --steps 200

Stage 1 trains on simulated clips from the encoder in the package, with --objective.next-frame-
residual, so that the decoder predicts what changes. The test has other objects. Its moving half are
the clips in which copying the last frame is worst.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import Config, preset
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch, reconstruct
from anytouch_jax.ops import tokens
from anytouch_jax.sim import endless
from anytouch_jax.sim.batches import SIMULATED, prepared
from anytouch_jax.sim.endless import Sampling
from anytouch_jax.sim.scene import training_scenes
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import to_stderr as log
from anytouch_jax.training import pretrain
from anytouch_jax.weights.load import load_model
from experiments.benchmarks import machine
from experiments.records import write_record

BATCH = 24
TESTED = 10  # batches
OUT = Path("experiments/results/next_frame.jsonl")


def configure(steps: int, masked: float, *, residual: bool) -> Config:
    """Return stage 1 on clips alone, with the tower and the sensors of the encoder."""
    return preset("tiny", stage=1).with_settings(
        {
            "model.embed": 192,
            "objective.next_frame_residual": residual,
            "objective.mask_ratio": masked,
            "data.manifests": (SIMULATED,),
            "data.background": "subtract",
            "data.jitter": (0.0, 0.0, 0.0, 0.0),
            "data.batch_size": BATCH,
            "data.clip_fraction": 1.0,
            "optim.learning_rate": 5e-4,
            "optim.grad_clip": 5.0,
            "run.steps": steps,
            "run.save_every": 0,
            "run.keep": 1,
            "run.figure_every": 0,
            "simulated.reuse": 4,
        }
    )


def errors(params: Any, config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors (n,) of the next frame, those of a copy of the last one, and the objects."""
    net = build(config.model)
    scenes = training_scenes(config.simulated)
    held_out = endless.objects_of(scenes, "test")
    # As many as in training, in turn, and drawn alike: so the simulator is not compiled again.
    count = len(endless.objects_of(scenes, "train", variants=config.simulated.variants))
    things = [held_out[number % len(held_out)] for number in range(count)]
    sensors = config.simulated.sensors
    made = endless.make_world(things, sensors, places=config.simulated.places)
    world = jax.device_put(made)
    rows = np.array([config.model.sensor_row(name) for name in sensors], np.int32)
    sampling = Sampling(
        frames=config.model.frames + 1,
        takes=1,
        size=config.model.image_size,
        coarse=config.simulated.coarse,
        depth=config.simulated.depth,
        field_size=config.model.image_size // 2,
    )
    gallery = jnp.int32(0)  # for second takes, of which there are none
    sample = jax.jit(endless.sample_touches, static_argnames=("sampling", "count"))

    @jax.jit
    def compared(clip: Any, sensor: Any, noise: Any) -> tuple[Any, Any]:
        clip = normalise_touch(clip)
        pixels, _ = reconstruct(params, clip, sensor, noise, net=net, config=config)
        target = tokens.patchify(clip, config.model.patch)
        wrong = jnp.mean((pixels[:, :, -1] - target[:, :, -1]) ** 2, (1, 2))
        copied = jnp.mean((target[:, :, -2] - target[:, :, -1]) ** 2, (1, 2))
        return wrong, copied

    parts = []
    for number in range(TESTED):
        key = jax.random.fold_in(jax.random.key(77), number)
        touches = sample(key, world, sampling=sampling, count=BATCH, gallery=gallery)
        clip = prepared(key, touches.clip[:, 0], touches.background[:, 0], config, jitter=False)
        noise = jax.random.uniform(key, (BATCH, config.model.patches))
        found = compared(clip, rows[np.asarray(touches.sensor[:, 0])], noise)
        touched = np.asarray(touches.labels["depth"][:, 0, -1]) > endless.LEAST_DEPTH
        parts.append(np.stack([*found, np.asarray(touches.object) % len(held_out)])[:, touched])
    own, copied, objects = np.concatenate(parts, 1)
    return own, copied, objects


def scores(own: np.ndarray, copied: np.ndarray, objects: np.ndarray) -> dict[str, Any]:
    """Return the mean errors, and by how much that of a copy is larger, with its interval."""
    return {
        "clips": len(own),
        "error": float(own.mean()),
        "copy": float(copied.mean()),
        "gain": float((copied - own).mean()),
        "interval": mean_interval(copied - own, objects),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--stop-after", type=int, help="end after so many steps")
    parser.add_argument("--masked", type=float, default=0.75, help="fraction of the patches")
    parser.add_argument(
        "--whole", action="store_true", help="predict the whole frame, as the paper"
    )
    parser.add_argument("--folder", type=Path, default=Path("runs/next_frame"))
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    enable_compilation_cache()
    config = configure(options.steps, options.masked, residual=not options.whole)
    name = f"{'whole' if options.whole else 'residual'}, {100 * options.masked:.0f} % masked"
    run = options.folder / name.replace(", ", "-").replace(" % ", "-").replace(" ", "-")
    result = pretrain(config, run, init="anytouch-tiny", stop_after=options.stop_after, log=log)
    loaded = load_model(run)
    own, copied, objects = errors(loaded.params, config)
    moving = copied > np.median(copied)
    record = {
        "steps": result.step,
        "all": scores(own, copied, objects),
        "moving": scores(own[moving], copied[moving], objects[moving]),
        "machine": dataclasses.asdict(machine.describe()),
    }
    write_record(options.out, name, record)
    print(name, record, flush=True)


if __name__ == "__main__":
    main()
