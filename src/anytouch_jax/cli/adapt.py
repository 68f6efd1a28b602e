"""`anytouch adapt`: sensor tokens for a sensor that a run was not trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from anytouch_jax.cli.output import check_home, log, refuse_unused
from anytouch_jax.config.parsing import Count, NotNegative, Seed


@dataclass(frozen=True)
class AdaptOptions:
    """Fit sensor tokens for a new sensor to a few of its frames. All other parameters stay frozen.

    Example: anytouch adapt --model runs/stage1 --data mine.csv --sensor my_gel --labels material --out runs/my_gel
    """

    model: Path
    """Encoder: a name of `anytouch info encoders`, a run folder, a weights file, or hf://user/repo."""
    data: tuple[Path, ...]  # Manifests with frames of the sensor in split train.
    sensor: str  # Name of the sensor, as in the column sensor of the manifest.
    out: Path  # Run folder to write, for embed, probe and retrieve.
    frames: NotNegative[int] = 100
    """Number of frames to fit on, spread over the recordings. 0 copies the universal tokens unchanged."""
    labels: str | None = None
    """Label column whose classes the frames are fitted to. Known sensors must have examples of them."""
    steps: Count[int] = 200  # Steps of the fit.
    seed: Seed = 0  # Random seed.


def run(options: AdaptOptions) -> int:
    """Fit the tokens of a new sensor and write a run folder."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder.adapt import adapt, check_empty, save
    from anytouch_jax.train.mesh import enable_compilation_cache

    if not options.frames:
        refuse_unused(options, ("labels", "steps", "seed"), "with --frames 0, which fits nothing")
    check_empty(options.out)
    check_home(options.out)
    enable_compilation_cache()
    table = manifests.read([str(path) for path in options.data])
    adapted = adapt(
        options.model, table, options.sensor, frames=options.frames, labels=options.labels, steps=options.steps,
        seed=options.seed, log=log,
    )  # fmt: skip
    save(adapted, options.model, options.out)
    if not options.frames:
        print(f"{options.out}: {options.sensor} has the universal tokens")
        return 0
    where = "of split val" if adapted.measured == "val" else "of the fit"
    print(
        f"{options.out}: tokens of {options.sensor} fitted to {options.frames} frames. "
        f"The loss on frames {where} went from {adapted.before:.4f} to {adapted.after:.4f}."
    )
    return 0
