"""A pouring policy from the command line: learned from the simulated expert or from your
recordings, then tried.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from anytouch_jax.config.parsing import Count, Range, Seed
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.tables import markdown_table
from anytouch_jax.files import atomic_write
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import to_stderr as log
from experiments.command import run_script
from experiments.pouring import bounds, policy, recordings, trials
from experiments.pouring.physics import Task


@dataclass(frozen=True)
class Pour:
    """Pour 60 g of 100 g of beads by touch alone, in simulation: imitation learning over features,
    then trials.

    Example: python -m experiments.pouring.run --model runs/stage2 --trials 10

    Prints the mass of each trial and the mean error, compared with a blind policy and the expert.
    OUT gets the numbers and the policy. With --recordings it learns from your runs and is compared
    with the hand on split test.
    """

    model: Path | None = None
    """Run folder or weights file (.pth, .safetensors)."""
    recordings: Path | None = None
    """Manifest of recorded runs to learn from: a row a moment (five a second), label.action pour,
    wait or retract.
    """
    record: Path | None = None
    """Only write the expert's demonstrations to this folder, in the form of --recordings."""
    size: Annotated[int, Range(14, 1024, "14 to 1024")] = 112
    """Side of the recorded frames in pixels."""
    trials: Count[int] = 10
    """Runs of the learned policy, with cylinders, beads, grips and sensors that are new to it."""
    out: Path | None = None
    """Folder for pour.json and the policy (default: pour in the run's folder)."""
    demos: Count[int] = 120
    """Demonstrations of the expert, who sees the scales. A thousand are better (5 GB of memory at
    84 pixels).
    """
    stills: bool = False
    """Use features of single frames, not of segments of three."""
    fine_tune: bool = False
    """Train the encoder too: minutes, for a third to a half less error in our table."""
    steps: Count[int | None] = None
    """Steps of the policy's training (default 3000)."""
    markers: bool = True
    """Give the gel markers. Without them shear hardly shows."""
    seed: Seed = 0
    """Seed of demonstrations, learning and trials."""


def run(options: Pour) -> int:
    """Record demonstrations, or learn a policy and try it."""
    enable_compilation_cache()
    if options.record is not None:
        return _record(options, options.record)
    if options.model is None:
        raise UserError(
            "Give --model, whose features the policy learns from, or --record to write "
            "demonstrations."
        )
    folder = options.model if options.model.is_dir() else options.model.parent
    out = options.out or folder / "pour"
    encoder = load_encoder(options.model)
    about = {"model": str(options.model), "seed": options.seed, "stills": options.stills}
    about |= {"fine_tuned": options.fine_tune, "steps": options.steps}
    if options.recordings:
        return _recorded(options, encoder, out, about)
    return _simulated(options, encoder, out, about)


def _record(options: Pour, folder: Path) -> int:
    if (folder / "manifest.parquet").exists():
        raise UserError(f"{folder} holds a recording already. Choose another folder with --record.")
    if options.demos < 2:
        raise UserError("--demos must be 2 or more with --record: some are kept for the test.")
    task = Task(markers=options.markers)
    log(f"the expert pours {options.demos} times")
    demonstrations = policy.demonstrate(task, options.seed, options.demos, side=options.size)
    print(recordings.write(folder, demonstrations, task))
    return 0


def _learn(
    options: Pour, encoder: Encoder, demonstrations: trials.Trials, sensor: str
) -> tuple[policy.Touch, policy.Learning]:
    """Return the policy learned from demonstrations, and how it was learned."""
    learning = policy.Learning(seed=options.seed)
    tune_steps = max(learning.tune_steps, len(demonstrations.steps))
    learning = replace(learning, steps=options.steps or learning.steps, tune_steps=tune_steps)
    log("learning from it")
    learned = policy.learn_frozen(
        encoder, demonstrations, learning, stills=options.stills, sensor=sensor
    )
    return (
        policy.fine_tune(learned, demonstrations, learning) if options.fine_tune else learned
    ), learning


def _recorded(options: Pour, encoder: Encoder, out: Path, about: dict[str, Any]) -> int:
    """Learn from recorded runs, and compare with the hand on those of split test."""
    assert options.recordings is not None
    data = recordings.read(options.recordings, encoder.config.model.image_size)
    about |= {"recordings": str(options.recordings), "data": data.data}
    _check_unused(out, about)
    learned_from = data.part(False)
    test = data.part(True)
    log(
        f"{len(learned_from.steps)} runs of {data.sensor} to learn from, {len(test.steps)} of "
        "split test"
    )
    learned, learning = _learn(options, encoder, learned_from, data.sensor)
    rate = Task().rate
    rows = {
        "touch": recordings.agreement(learned, test, rate),
        "blind": recordings.agreement_blind(learned_from, test, learning, rate),
    }
    head = (
        "policy",
        "moments as the hand chose",
        "mean over actions",
        "turns back, off by (median)",
    )
    cells = [
        (k, f"{100 * a.fraction:.1f} %", f"{100 * a.balanced:.1f} %", f"{a.turn:.1f} s")
        for k, a in rows.items()
    ]
    print(markdown_table(head, cells))
    results = {"sensor": learned.sensor} | {name: one._asdict() for name, one in rows.items()}
    return _write(out, learned, about | results)


def _simulated(options: Pour, encoder: Encoder, out: Path, about: dict[str, Any]) -> int:
    """Learn from the expert, and pour."""
    side = encoder.config.model.image_size
    task = Task(markers=options.markers)
    about |= {"target": task.target, "demonstrations": options.demos, "markers": options.markers}
    _check_unused(out, about)
    log(f"the expert pours {options.demos} times")
    demonstrations = policy.demonstrate(task, options.seed, options.demos, side=side)
    learned, learning = _learn(options, encoder, demonstrations, trials.SENSOR)
    negatives: dict[str, trials.Controller] = {
        "blind": bounds.learn_blind(task, options.seed, options.demos, learning),
        "expert": trials.Expert(task),
    }
    log(f"the policy pours {options.trials} times")
    setups, keys = trials.draw_runs(task, options.seed + policy.UNSEEN, options.trials)
    tried = trials.run(task, setups, keys, learned, side=side)
    cells = [
        (str(i + 1), f"{g:.1f}", f"{abs(g - task.target):.1f}") for i, g in enumerate(tried.poured)
    ]
    print(markdown_table(("trial", "poured, g", "error, g"), cells))
    results = {"touch": tried} | {
        k: trials.run(task, setups, keys, rival) for k, rival in negatives.items()
    }
    for name, one in results.items():
        result = trials.error(one.poured, task.target)
        interval = "" if result.low is None else f" (95 %: {result.low:.1f} to {result.high:.1f})"
        print(f"{name}: mean error {result.mean:.1f} g{interval}")
    poured = {name: [round(float(g), 3) for g in one.poured] for name, one in results.items()}
    return _write(out, learned, about | {"poured": poured})


def _check_unused(out: Path, about: Mapping[str, Any]) -> None:
    """Raise UserError where a folder holds the results of other settings: a policy would be
    lost.
    """
    try:
        before = dict(json.loads((out / "pour.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return  # no results
    other = sorted(name for name in ("recordings", *about) if before.get(name) != about.get(name))
    if other:
        raise UserError(
            f"{out} holds a policy of other settings ({', '.join(other)}). Choose another --out."
        )


def _write(out: Path, learned: policy.Touch, results: Mapping[str, Any]) -> int:
    recordings.save_policy(out, learned)
    atomic_write(out / "pour.json", json.dumps(results, indent=2) + "\n")
    log(f"policy and results in {out}")
    return 0


main = partial(run_script, Pour, run)

if __name__ == "__main__":
    sys.exit(main())
