"""`anytouch simulate`: touch scenes on disk."""

from __future__ import annotations

from anytouch_jax.commands.words import say
from anytouch_jax.options import Simulate


def run(options: Simulate) -> int:
    """Simulate a data set, or finish one that was begun; 130 after Ctrl-C (what is finished is kept)."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from anytouch_jax.sim.dataset import simulate
    from anytouch_jax.sim.scene import Scenes
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    scenes = Scenes(
        touches=options.touches,
        sensors=_names(options.sensors),
        seed=options.seed,
        grade=options.grade,
        fidelity=options.fidelity,
        frames=options.frames,
        objects=options.objects,
        depth=options.depth,
        vision=options.vision,
        text=options.text,
        held_out=options.held_out,
        fields=_names(options.fields),
        size=options.size,
        units=options.units,
    )
    columns = TextColumn("touches"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("touches", total=options.touches)
        path = simulate(
            scenes,
            options.out,
            threads=options.threads,
            progress=lambda done, of: bar.update(task, completed=done, total=of),
        )
    say(f"{path}: {options.touches} touches by {', '.join(scenes.sensors)}")
    return 0


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
