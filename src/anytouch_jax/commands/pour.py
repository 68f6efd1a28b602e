"""`anytouch pour`: imitation learning and trials of the simulated pouring task with a trained encoder."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from anytouch_jax.commands.words import say
from anytouch_jax.config import UserError
from anytouch_jax.options_use import Pour

if TYPE_CHECKING:
    from anytouch_jax.evaluate.pouring import Trials


def run(options: Pour) -> int:
    """Record demonstrations, learn a policy over the run's features, pour; print the masses, write film and JSON."""
    _check(options)
    from anytouch_jax.evaluate import pouring, pouring_policy
    from anytouch_jax.evaluate.features import load_encoder
    from anytouch_jax.evaluate.sections import markdown
    from anytouch_jax.sim.pouring import Task
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    encoder = load_encoder(options.run)
    side = encoder.config.model.image_size
    task = Task(markers=options.markers)
    learning = pouring_policy.Learning(seed=options.seed, **({"steps": options.steps} if options.steps else {}))
    say(f"the expert pours {options.demos} times")
    shown = pouring_policy.demonstrate(task, options.seed, options.demos, side=side)
    say("learning from it")
    policy = pouring_policy.learn_frozen(encoder, shown, learning, stills=options.stills)
    if options.fine_tune:
        policy = pouring_policy.fine_tune(policy, shown, learning)
    rivals: dict[str, pouring.Controller] = {
        "blind": pouring_policy.learn_blind(task, options.seed, options.demos, learning),
        "count": pouring.best_counter(task, *pouring.draw_runs(task, options.seed, options.demos)),
        "expert": pouring.Expert(task),
    }
    say(f"the policy pours {options.trials} times")
    setups, keys = pouring.draw_runs(task, options.seed + pouring_policy.UNSEEN, options.trials)
    trials = pouring.run(task, setups, keys, policy, side=side, film=options.out is not None)
    lines = [(str(i + 1), f"{g:.1f}", f"{abs(g - task.target):.1f}") for i, g in enumerate(trials.poured)]
    print(markdown(("trial", "poured, g", "error, g"), lines))
    results = {"touch": trials} | {k: pouring.run(task, setups, keys, rival) for k, rival in rivals.items()}
    for name, one in results.items():
        print(f"{name}: mean error {sentence(one, task.target)}")
    if options.out is not None:
        from anytouch_jax.evaluate.plots import write_bytes

        pouring.write_film(options.out / "pour.gif", trials, task)
        found = {name: [round(float(g), 3) for g in one.poured] for name, one in results.items()}
        about = {"run": str(options.run), "target": task.target, "demonstrations": options.demos, "seed": options.seed}
        about |= {"stills": options.stills, "fine_tuned": options.fine_tune, "markers": options.markers}
        write_bytes(options.out / "pour.json", (json.dumps(about | {"poured": found}, indent=2) + "\n").encode())
        say(f"film and results in {options.out}")
    return 0


def sentence(trials: Trials, target: float) -> str:
    """The mean error of trials in words."""
    from anytouch_jax.evaluate.pouring import error

    found = error(trials.poured, target)
    interval = "" if found.low is None else f" (95 %: {found.low:.1f} to {found.high:.1f})"
    return f"{found.mean:.1f} g{interval}"


def _check(options: Pour) -> None:
    for name in ("trials", "demos"):
        if getattr(options, name) < 1:
            raise UserError(f"--{name} must be at least 1, not {getattr(options, name)}")
    if options.out is not None:
        try:
            options.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot make the folder {options.out}: {error.strerror}") from None
    if options.steps is not None and options.steps < 1:
        raise UserError(f"--steps must be at least 1, not {options.steps}")
