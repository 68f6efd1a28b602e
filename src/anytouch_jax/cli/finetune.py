"""`anytouch finetune`: the encoder and a head, trained on your labels in minutes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import check_home, log
from anytouch_jax.config.parsing import Above0, Count, Finite, Range, Seed

if TYPE_CHECKING:
    from anytouch_jax.finetuning.options import State

Inner = Annotated[float, Range(0.001, 0.999, "between 0.001 and 0.999")]


@dataclass(frozen=True, kw_only=True)
class TuningOptions:
    """Train the encoder and a head on a label column, in minutes.

    Example: anytouch finetune --data mine.csv --label object --minutes 10 --out mine

    It starts from the linear head of `probe label`. Whole recordings are held out: they stop the
    training, and what scores best on them is kept, which is the linear head if nothing beats it.
    embed, stream, view, probe and export take the folder by --model, with its head. Ctrl-C keeps
    the best so far.
    """

    data: tuple[Path, ...]  # Manifests with the label.
    label: str = "object"  # Label column. The prefix "label." may be left out.
    out: Path  # Folder to write.
    # Encoder to start from: a name, a run, a weights file, or a folder of an earlier finetune.
    model: Path = Path(DEFAULT)
    minutes: Above0[float] = 10.0  # Minutes of the whole run.
    group: str = ""
    """Column whose values are held out whole (default: the first of grasp_group, object, touch,
    sequence that the manifest has and that is not the label).
    """
    where: Finite[tuple[str, float] | None] = None  # Keep rows whose column is above a number.
    sensor: str | None = None  # Keep rows of this sensor.
    # Frames of a touch: 1 for stills, 3 or more for the clip that ends at each row.
    frames: Count[int] = 1
    # Features: class token, mean of the patch tokens, or both.
    pooling: Literal["class", "mean", "both"] = "both"
    regression: Literal["auto", "yes", "no"] = "auto"
    """Whether the label is a number. By auto it is if the column has numbers with a fraction."""
    augment: bool = True
    """Shift, zoom and tint the touches at random. Give --no-augment for a label that depends on the
    place or the size of the contact.
    """
    # Share of touches whose set of classes, or interval, holds the truth.
    coverage: Inner = 0.9
    false_alarms: Inner = 0.05  # Share of known touches that the head calls novel.
    seed: Seed = 0  # Random seed.


def run(options: TuningOptions) -> int:
    """Fine-tune and write the folder."""
    from anytouch_jax.finetuning import FinetuneOptions as Settings
    from anytouch_jax.finetuning import finetune
    from anytouch_jax.finetuning.folder import refuse_filled
    from anytouch_jax.train.mesh import enable_compilation_cache

    refuse_filled(options.out)
    check_home(options.out)
    enable_compilation_cache()
    names = {field.name for field in fields(Settings)}
    settings = Settings(**{name: value for name, value in vars(options).items() if name in names})
    with _bar(60 * options.minutes) as watch:
        result = finetune(
            options.data,
            out=options.out,
            model=options.model,
            options=settings,
            log=log,
            watch=watch,
        )
    print(f"{result.folder}: use it as --model of embed, stream, view, probe and export")
    return 0


@contextlib.contextmanager
def _bar(seconds: float) -> Iterator[Callable[[State], None]]:
    """Show the time left and the held-out score: as a bar on a terminal, else as some lines."""
    import sys

    from anytouch_jax.progress import bar

    is_terminal = sys.stderr.isatty()
    logged = 0
    with bar(round(seconds), "reading touches") as advance:

        def show(state: State) -> None:
            words = f"held-out {state.score}, linear head {state.before}"
            if not state.score:
                words = "linear head"
            nonlocal logged
            advance(round(seconds - state.left), words)
            if not is_terminal and state.looks > logged:
                logged = state.looks
                log(f"{_clock(state.left)} left, {words}")

        yield show


def _clock(seconds: float) -> str:
    """Return minutes and seconds, as 2:05."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
