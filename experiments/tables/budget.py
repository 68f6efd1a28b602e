"""Costs of the matrix of experiments, and its parts of equal cost.

Rates are medians of 83 trainings and 96 runs, most made two at a time on two slow CPU cores with a load of 2 to 8.
Alone on a quiet machine a training takes about two thirds. At preset tiny with 112 pixels: stage
1 1.15 s a step of 64; stage 2 4.7 s a step of 32, of which the touch to align 1.2 s, photographs 0.3 s, text 0.2 s and
the three touches of a match 3.0 s; in proportion to the tokens for smaller pictures, to the weights for smaller towers
(but seven tenths of stage 1, its decoder and pixels, are the same for all); 100 simulated frames a second and 10 s for
the program of a sensor; about 25 s to start and end a training; a run's scores 6 to 350 s (220 s for those of real
touch are reckoned: its recordings are tested in ten folds). `--plan` prints the sum for any size; eight
chunks, each of which makes its data again, stay below 75 minutes. Two processes side by side (`--jobs 2`) do 1.35
times as much an hour.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from experiments.tables import plan
from experiments.tables.plan import Leaf, Scenes, Size, Training

START = 25.0  # s to compile, read and save
FRAMES = 100.0  # simulated a second
SENSOR = 10.0  # s to compile a sensor, or to read it from the cache
SCORES: Mapping[str, float] = {
    "q1": 30, "q2": 6, "q3": 60, "ablations": 30, "dynamics": 85, "grasp": 30, "restricted": 30, "new_sensor": 350,
    "real": 220,
}  # fmt: skip
_TOY = 0.12  # a toy's share of these
_DECODER = 0.7  # of a step of stage 1 at preset tiny


def of_training(one: Training) -> float:
    """Seconds of one stage."""
    config = one.config
    batch, steps = config.data.batch_size, config.run.steps
    picture = (config.model.patches + 6) / 70  # tokens beside those of 112 pixels
    stack = config.model.touch
    share = max(_TOY, stack.width**2 * stack.depth / (192**2 * 6))  # of the work of preset tiny
    if config.stage == 1:
        step = 1.15 * picture * batch / 64 * (_DECODER / share + 1 - _DECODER)
    else:
        touches = (0.7 if config.model.match_head == "cosine" else 1.0) * config.objective.match_keep
        parts = (1.2, 0.3 * bool(config.model.image), 3.0 * touches * matches(one))
        step = (sum(parts) * picture + 0.2 * bool(config.model.text)) * batch / 32
    return (START if share > _TOY else START * _TOY) + steps * step * share


def matches(one: Training) -> bool:
    """Whether its data have touches felt twice, and it has a head for them."""
    return one.config.model.match_head != "none" and bool({*plan.ALIGNED, plan.REAL} & set(one.config.data.manifests))


def of_scenes(one: Scenes, size: Size) -> float:
    """Seconds of one data set."""
    return len(one.sensors) * (SENSOR + one.touches * size.frames / FRAMES)


def of_scores(leaf: Leaf) -> float:
    """Seconds of the scores of a run whose model is there."""
    return SCORES[leaf.question] * (_TOY * 2 if leaf.size.stack.width < 100 else 1.0)


def missing(leaf: Leaf, ready: Iterable[str]) -> tuple[list[Scenes], list[Training]]:
    """The data sets and trainings that a run needs and whose names or keys are not `ready`, in order."""
    have = set(ready)
    return (
        [one for one in plan.scenes(leaf.size) if one.name not in have],
        [one for one in leaf.trainings if one.key not in have],
    )


def cost(leaf: Leaf, ready: Iterable[str]) -> float:
    """Seconds that a run takes with what is `ready`."""
    sets, trainings = missing(leaf, ready)
    return sum(of_scenes(one, leaf.size) for one in sets) + sum(map(of_training, trainings)) + of_scores(leaf)


def costs(leaves: Sequence[Leaf]) -> list[float]:
    """Seconds of each run where those before it are done."""
    ready: set[str] = set()
    found = []
    for leaf in leaves:
        found.append(cost(leaf, ready))
        ready |= {one.name for one in plan.scenes(leaf.size)} | {one.key for one in leaf.trainings}
    return found


def chunk(leaves: Sequence[Leaf], number: int, of: int) -> list[Leaf]:
    """Part `number` (from 1) of `of` parts, in order, of about the same cost each; together they are all runs.

    A part that is made elsewhere makes again what it shares with the parts before it.
    """
    if not 1 <= number <= of:
        raise ValueError(f"chunk {number} of {of}: count from 1")
    seconds = costs(leaves)
    total, done, part = sum(seconds), 0.0, []
    for leaf, one in zip(leaves, seconds, strict=True):
        middle = done + one / 2
        if min(of, int(of * middle / total) + 1) == number:
            part.append(leaf)
        done += one
    return part


def lines(leaves: Sequence[Leaf], done: Iterable[str] = ()) -> list[str]:
    """Return the plan as text: each run with its minutes and shared trainings, and the sum. `done` are keys of runs."""
    there, seen = set(done), set[str]()
    found, seconds = [], costs(leaves)
    for leaf, one in zip(leaves, seconds, strict=True):
        keys = [training.key for training in leaf.trainings]
        shared = sum(key in seen for key in keys)
        seen |= set(keys)
        share = f"{len(keys) - shared} to train, {shared} shared" if keys else "nothing to train"
        mark = "done" if leaf.key in there else f"{one / 60:5.1f} min"
        found.append(f"{leaf.question:11} {leaf.name:32} seed {leaf.seed}  {mark:>9}  {share}")
    left = sum(one for leaf, one in zip(leaves, seconds, strict=True) if leaf.key not in there)
    found.append(
        f"{len(leaves)} runs, {len(seen)} trainings, {sum(seconds) / 60:.0f} min; {left / 60:.0f} min are left"
    )
    return found
