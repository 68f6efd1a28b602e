"""`anytouch pour`: imitation learning and trials of the simulated pouring task with a trained encoder."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anytouch_jax.cli.output import check_folder
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config.parsing import SEED, in_range
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from experiments.command import run_script

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder
    from experiments.pouring.policy import Learning, Touch
    from experiments.pouring.trials import Trials


@dataclass(frozen=True)
class Pour:
    """Pour 60 g of 100 g of beads by touch alone, in simulation: imitation learning over a run's features, then trials.

    Example: python -m experiments.pouring.run --run runs/stage2 --trials 10

    Prints the mass of each trial and the mean error beside a blind policy and the expert; OUT gets a film, JSON and the
    policy. With --recordings it learns from your own runs and is compared with the hand on those of split test.
    """

    run: Path | None = None
    """Run folder or weights file (.pth, .safetensors)."""
    recordings: Path | None = None
    """Manifest of recorded runs to learn from: a row a moment (five a second), label.action pour, wait or retract."""
    record: Path | None = None
    """Only write the expert's demonstrations to this folder, as images and manifest in the form of --recordings."""
    size: int = 112
    """Side of the recorded frames in pixels."""
    trials: int = 10
    """Runs of the learned policy, with cylinders, beads, grips and sensors that it has not met."""
    out: Path | None = None
    """Folder for pour.gif (the first trial), pour.json and the policy (default: pour in the run's folder)."""
    demos: int = 120
    """Demonstrations of the expert, who sees the scales; a thousand are better (memory: 5 GB of 84 pixels)."""
    stills: bool = False
    """Features of single frames, not of segments of three."""
    fine_tune: bool = False
    """Train the encoder too: minutes, for a third to a half less error in our table."""
    steps: int | None = None
    """Steps of the policy's training (default 3000)."""
    markers: bool = True
    """The gel has markers; without them shear is hardly to be seen."""
    seed: int = 0
    """Seed of demonstrations, learning and trials."""


def run(options: Pour) -> int:
    """Record demonstrations, learn a policy over the run's features, pour; print the masses, write film and JSON."""
    _check(options)
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    in_range("--", options, seed=SEED)
    if options.record is not None:
        return _record(options, options.record)
    out = _home(options)
    return _simulated(options, out) if options.recordings is None else _recorded(options, options.recordings, out)


def _home(options: Pour) -> Path:
    """Where the results go: --out, else `pour` in the run's folder, or beside a weights file."""
    assert options.run is not None
    run = Path(options.run)
    return options.out or (run if run.is_dir() else run.parent) / "pour"


def _claim(out: Path, about: Mapping[str, Any]) -> None:
    """Make the folder of the results. Raises UserError where it holds those of other settings: a policy would go."""
    check_folder(out / "pour.json")
    try:
        before = dict(json.loads((out / "pour.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return  # nothing there, or nothing of ours
    other = sorted(name for name in ("recordings", *about) if before.get(name) != about.get(name))
    if other:
        raise UserError(
            f"{out} holds a policy of other settings ({', '.join(other)}); choose another folder with --out"
        )


def _record(options: Pour, folder: Path) -> int:
    from experiments.pouring import policy as pouring_policy
    from experiments.pouring import recordings
    from experiments.pouring.physics import Task

    task, path = Task(markers=options.markers), folder / "manifest.parquet"
    if path.exists():
        raise UserError(f"{path} is there already; record into another folder, or remove this one first")
    check_folder(path, "--record")
    log(f"the expert pours {options.demos} times")
    shown = pouring_policy.demonstrate(task, options.seed, options.demos, side=options.size)
    print(recordings.write(folder, shown, task))
    return 0


def _policy(options: Pour, encoder: Encoder, shown: Trials, sensor: str) -> tuple[Touch, Learning]:
    """The policy learned from demonstrations, as the options say."""
    from experiments.pouring import policy as pouring_policy
    from experiments.pouring import tuning

    learning = pouring_policy.Learning(seed=options.seed)
    learning = replace(
        learning, steps=options.steps or learning.steps, tune_steps=max(learning.tune_steps, len(shown.steps))
    )
    log("learning from it")
    policy = pouring_policy.learn_frozen(encoder, shown, learning, stills=options.stills, sensor=sensor)
    return (tuning.fine_tune(policy, shown, learning) if options.fine_tune else policy), learning


def _recorded(options: Pour, path: Path, out: Path) -> int:
    """Learn from recorded runs, and compare with the hand on those of split test."""
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.evaluate.statistics import markdown
    from experiments.pouring import recordings
    from experiments.pouring.physics import Task

    encoder = load_encoder(str(options.run))
    about = {"run": str(options.run), "recordings": str(path), "seed": options.seed}
    about |= {"stills": options.stills, "fine_tuned": options.fine_tune, "steps": options.steps}
    found = recordings.read(path, encoder.config.model.image_size)
    about["data"] = found.data
    _claim(out, about)
    shown, unseen = found.part(False), found.part(True)
    log(f"{len(shown.steps)} runs of {found.sensor} to learn from, {len(unseen.steps)} of split test")
    policy, learning = _policy(options, encoder, shown, found.sensor)
    rate = Task().rate
    rows = {
        "touch": recordings.agreement(policy, unseen, rate),
        "blind": recordings.agreement_blind(shown, unseen, learning, rate),
    }
    head = ("policy", "moments as the hand chose", "mean over actions", "turns back, off by (median)")
    lines = [
        (name, f"{100 * a.share:.1f} %", f"{100 * a.balanced:.1f} %", f"{a.turn:.1f} s") for name, a in rows.items()
    ]
    print(markdown(head, lines))
    recordings.save_policy(out, policy)
    found_text = json.dumps(
        about | {"sensor": policy.sensor} | {name: one._asdict() for name, one in rows.items()}, indent=2
    )
    atomic_write(out / "pour.json", found_text + "\n")
    log(f"policy and results in {out}")
    return 0


def _simulated(options: Pour, out: Path) -> int:
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.evaluate.statistics import markdown
    from experiments.pouring import bounds, recordings
    from experiments.pouring import policy as pouring_policy
    from experiments.pouring import trials as pouring
    from experiments.pouring.physics import Task

    encoder = load_encoder(str(options.run))
    side = encoder.config.model.image_size
    task = Task(markers=options.markers)
    about = {"run": str(options.run), "target": task.target, "demonstrations": options.demos, "seed": options.seed}
    about |= {"stills": options.stills, "fine_tuned": options.fine_tune, "markers": options.markers}
    about |= {"steps": options.steps}
    _claim(out, about)
    log(f"the expert pours {options.demos} times")
    shown = pouring_policy.demonstrate(task, options.seed, options.demos, side=side)
    policy, learning = _policy(options, encoder, shown, pouring.SENSOR)
    rivals: dict[str, pouring.Controller] = {
        "blind": bounds.learn_blind(task, options.seed, options.demos, learning),
        "count": pouring.best_counter(task, *pouring.draw_runs(task, options.seed, options.demos)),
        "expert": pouring.Expert(task),
    }
    log(f"the policy pours {options.trials} times")
    setups, keys = pouring.draw_runs(task, options.seed + pouring_policy.UNSEEN, options.trials)
    trials = pouring.run(task, setups, keys, policy, side=side, film=1)
    lines = [(str(i + 1), f"{g:.1f}", f"{abs(g - task.target):.1f}") for i, g in enumerate(trials.poured)]
    print(markdown(("trial", "poured, g", "error, g"), lines))
    results = {"touch": trials} | {k: pouring.run(task, setups, keys, rival) for k, rival in rivals.items()}
    for name, one in results.items():
        print(f"{name}: mean error {sentence(one, task.target)}")
    recordings.save_policy(out, policy)
    found = {name: [round(float(g), 3) for g in one.poured] for name, one in results.items()}
    atomic_write(out / "pour.json", json.dumps(about | {"poured": found}, indent=2) + "\n")
    pouring.write_film(out / "pour.gif", trials, task)
    log(f"film, policy and results in {out}")
    return 0


def sentence(trials: Trials, target: float) -> str:
    """The mean error of trials in words."""
    from experiments.pouring.trials import error

    found = error(trials.poured, target)
    interval = "" if found.low is None else f" (95 %: {found.low:.1f} to {found.high:.1f})"
    return f"{found.mean:.1f} g{interval}"


def _check(options: Pour) -> None:
    if options.run is None and options.record is None:
        raise UserError("give --run, whose features the policy learns from, or --record to write demonstrations alone")
    if options.size < 14:
        raise UserError(f"--size must be at least 14 pixels, not {options.size}")
    for name in ("trials", "demos"):
        if getattr(options, name) < 1:
            raise UserError(f"--{name} must be at least 1, not {getattr(options, name)}")
    if options.record is not None and options.demos < 2:
        raise UserError("--demos 1 is too few to record: of two or more, some are kept for the test")
    if options.record is not None:
        learning = ("run", "recordings", "out", "trials", "stills", "fine_tune", "steps")
        refuse(options, learning, "with --record, which only writes demonstrations")
    elif options.recordings is not None:
        refuse(options, ("demos", "trials", "markers"), "with --recordings, which are what there is to learn from")
    if options.record is None:
        refuse(options, ("size",), "without --record")
    if options.steps is not None and options.steps < 1:
        raise UserError(f"--steps must be at least 1, not {options.steps}")


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args`; return the exit status."""
    return run_script(Pour, run, args)


if __name__ == "__main__":
    sys.exit(main())
