"""The page of the translation study, made from the records of its runs alone, and its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.plots import sample_grid
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.records import read_records
from experiments.translation import training
from experiments.translation.encoders import retrieval_table
from experiments.translation.generator import Generator
from experiments.verdicts import seed_interval, verdict

Task = tuple[str, str]
Record = dict[str, Any]

TASKS: tuple[Task, ...] = (("gelsight_mini", "duragel"), ("gelsight_mini", "tac3d"), ("digit", "tac3d"))
PIXELS, MEAN = "pixels", "mean of the training targets"
OURS = ("anytouch", "stage1")  # its variants, and its stage 1
_TITLES = {"gelsight_mini": "GelSight Mini", "digit": "DIGIT", "duragel": "DuraGel", "tac3d": "Tac3D"}
_HEAD = tuple(f"{_TITLES[a]} -> {_TITLES[b]}" for a, b in TASKS)


def page(results: Path) -> str:
    """Return the page of a file of results.

    Raises UserError without a run, and for runs that make no table together.
    """
    records = list(runs_of(results).values())
    if not records:
        raise UserError(f"{results} has no run. Run this page without TABLE=1.")
    one_table([record["settings"] for record in records], results)
    rows = Rows(records)
    lines = [
        "# One sensor's touch as another would feel it",
        "",
        _about(records),
        "",
        markdown_table(("mean squared error, lower is better", *_HEAD), rows.errors()),
        "",
    ]
    if claims := rows.claims():
        lines += [
            markdown_table(("is the paper's order found? (and is it below both references?)", *_HEAD), claims),
            "",
        ]
    lines += [
        "Images: normalised pixels (ImageNet's mean and deviation). Fields: each of the six channels in deviations "
        "over the training fields. The paper, on its own recordings (units not stated): T3 0.2261, 0.0167, 0.0155; "
        "AnyTouch 0.2159, 0.0151, 0.0144.",
        "",
        "The same in units, root mean square of a pixel (0..255), or of a point's displacement and force:",
        "",
        markdown_table(("", *_HEAD), rows.in_units()),
        "",
        f"Objects of the pairs that an encoder was trained on in its last stage: {_met(results, rows.names)}.",
        "",
    ]
    if again := retrieval_table(results):
        title = "The same touch by another sensor and unit, objects never seen, found by the encoder itself:"
        lines += [title, "", again, ""]
    if not any(record["critic"] for record in records):
        lines += ["No critic judged the images.", ""]
    lines += ["Input, output, truth and difference, first seed, firm presses on objects never seen:", ""]
    lines += [f"![{path.stem.removeprefix(results.stem)[1:]}](figures/{path.name})" for path in pictures(results)]
    return "\n".join([*lines, ""])


def runs_of(results: Path) -> dict[str, Record]:
    """Return the records of translations by key, without those of retrieval and of overlap."""
    return {key: record for key, record in read_records(results).items() if "settings" in record}


def pictures(results: Path) -> list[Path]:
    """Return the pictures of the runs of a file of results."""
    return sorted((results.parent / "figures").glob(f"{results.stem}-*.png"))


def one_table(several: Sequence[dict[str, Any]], results: Path) -> None:
    """Raise UserError for settings of runs that make no table together: other pairs or steps, another view of the touch
    (errors of pictures of another size are no rivals), two encoders of one name and seed."""
    kinds = ("touches", "size", "subtracts", "version", "steps1")
    ways = {(*(one.get(kind, 1) for kind in kinds), one["fit"]["steps"]) for one in several}
    known = {(one["name"], one["fit"]["seed"], one["encoder"]) for one in several}
    made = {(one["from"], one["to"], one["pairs"], one.get("simulator")) for one in several}
    if len(ways) > 1 or len(known) > len({one[:2] for one in known}) or len(made) > len({one[:2] for one in made}):
        raise UserError(
            f"{results}: runs on other pairs, of other steps, size or background, or of two encoders of one name "
            f"make no table together ({sorted(map(str, ways | known | made))}): choose another OUT"
        )


def _about(records: Sequence[Record]) -> str:
    """What the runs are of, and the command."""
    first, settings = records[0], [record["settings"] for record in records]
    ours = {(one["name"], one["encoder"]) for one in settings if one["name"] != PIXELS}
    own = len(ours) > len({name for name, _ in ours})
    tunes = {one["fit"]["tune"] for one in settings if one["name"] != PIXELS}
    seeds = sorted({one["fit"]["seed"] for one in settings})
    steps1 = first["settings"].get("steps1")  # where it is not that of `make experiments`
    longer = f"stage 1, T3-style's too, of {steps1} steps; " if steps1 else ""
    asked = f"STEPS1={steps1} " if steps1 else ""
    today = first["settings"].get("version") == training.VERSION
    return (
        f"Simulated fine-aligned pairs, one device of each sensor; {first['pairs'][0]} to train on, "
        f"{first['pairs'][2]} of objects never seen to test on; {first['settings']['fit']['steps']} steps; {longer}"
        f"mean and deviation over {len(seeds)} seeds, each over "
        f"{'encoders of its own' if own else 'the same encoders'}. By "
        f"`{asked}SEEDS={','.join(map(str, seeds))} {'TUNE=frozen,fine ' if len(tunes) > 1 else ''}make translation`."
        + ("" if today else " Translations of today's code learn otherwise.")
    )


def _met(results: Path, names: Sequence[str]) -> str:
    """How many objects of the pairs each encoder was trained on."""
    known = read_records(results)["overlap"]
    counted = dict.fromkeys([*known, *(name.split(", ")[0] for name in names if PIXELS not in name)])
    return ", ".join(f"{name} {known.get(name, 'not counted')}" for name in counted)


class Rows:
    """The runs by row (encoder, frozen or fine-tuned) and task (column)."""

    def __init__(self, records: Sequence[Record]) -> None:
        self._found: dict[tuple[str, Task], list[Record]] = {}
        for record in records:
            about = record["settings"]
            self._found.setdefault((_row_name(about), (about["from"], about["to"])), []).append(record)

    @cached_property
    def names(self) -> list[str]:
        return sorted({name for name, _ in self._found}, key=lambda name: (PIXELS in name, name))

    def of(self, name: str, task: Task) -> list[Record]:
        return self._found.get((name, task), [])

    def errors(self) -> list[tuple[str, ...]]:
        """Mean and deviation over seeds of every row, and the mean of the training targets."""
        cells = [(name, *(_spread([r["error"] for r in self.of(name, task)]) for task in TASKS)) for name in self.names]
        means = (_spread([r["mean_target"] for r in self.of(self.names[0], task)][:1]) for task in TASKS)
        return [*cells, (MEAN, *means)]

    def claims(self) -> list[tuple[str, ...]]:
        """Whether each row of ours is below its rivals, with the interval of the difference over seeds."""
        return [
            (f"{one} below {rival}", *(self._against(task, one, rival) for task in TASKS))
            for one in self.names
            if one.startswith(OURS)
            for rival in self._rivals(one)
        ]

    def in_units(self) -> list[tuple[str, ...]]:
        """Grey levels (0..255) for images, mm of displacement and mN of force for fields."""
        return [(name, *(_in_units(self.of(name, task)) for task in TASKS)) for name in self.names]

    def _rivals(self, name: str) -> list[str]:
        """What a row is compared with: rows of others, tuned alike, AnyTouch as it is, and the references."""
        tune = name.split(", ")[-1]
        alike = [one for one in self.names if one.split(", ")[-1] == tune and not one.startswith(OURS)]
        plain = {f"anytouch, {tune}"} & {*self.names} - {name}
        return [*alike, *plain, *(one for one in self.names if PIXELS in one), MEAN]

    def _against(self, task: Task, better: str, worse: str) -> str:
        """Error of one row less that of another, seed by seed on the same pairs, with a 95 % interval over seeds."""
        ours = _by_seed(self.of(better, task))
        theirs = _by_seed(self.of(better, task), "mean_target") if worse == MEAN else _by_seed(self.of(worse, task))
        change = [ours[seed] - theirs[seed] for seed in sorted(ours.keys() & theirs.keys())]
        if not change:
            return "-"
        low, high = seed_interval(change)
        interval = "" if low is None or high is None else f" ({low:+.4f} to {high:+.4f})"
        return f"{np.mean(change):+.4f}{interval}, {verdict(low, high, len(change), wanted=-1)}"


def _row_name(about: dict[str, Any]) -> str:
    if about["name"] == PIXELS:
        return "U-Net / MLP on pixels, from scratch"
    return f"{about['name']}, {'fine-tuned' if about['fit']['tune'] == 'fine' else 'frozen'}"


def _by_seed(records: Sequence[Record], what: str = "error") -> dict[int, float]:
    return {record["settings"]["fit"]["seed"]: record[what] for record in records}


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    return f"{np.mean(values):.4f}" + (f" +- {np.std(values, ddof=1):.4f}" if len(values) > 1 else "")


def _in_units(records: Sequence[Record]) -> str:
    if not records:
        return "-"
    rms = np.sqrt(np.mean([np.square(record["rms"]) for record in records], axis=0))
    length = np.linalg.norm
    if len(rms) == 3:
        return f"{length(rms) / np.sqrt(3):.2f}"
    return f"{length(rms[:3]):.4f} mm, {1e3 * length(rms[3:]):.2f} mN"


# Pictures -------------------------------------------------------------------------------------------------------------

_Z = 2  # displacement along the normal, mm, the channel of a field that is drawn
_GAIN = 2.0  # by which the difference of images is enlarged


def picture_grid(path: Path, generator: Generator, images: np.ndarray, targets: np.ndarray, rows: int = 6) -> None:
    """A grid of `rows` pairs spread over those given: a PNG, four columns.

    Images: the difference is twice enlarged about grey. Fields: indentation, on one scale a row; the difference from
    blue (too little) through white to red. Raises OSError.
    """
    chosen = np.linspace(0, len(images) - 1, min(rows, len(images))).round().astype(int)
    given, truth = images[chosen], targets[chosen]
    made = generator(given)
    draw = _field_pictures if generator.design.shape.field else _image_pictures
    names = [f"pair {row}" for row in chosen]
    design = generator.design
    columns = (f"input: {design.source}", f"output: {design.target}", "truth", "output - truth")
    sample_grid(path, [[x, *draw(a, b)] for x, a, b in zip(given, made, truth, strict=True)], names, columns)


def _image_pictures(made: np.ndarray, truth: np.ndarray) -> list[np.ndarray]:
    away = _GAIN * (made.astype(np.float32) - truth) + 128
    return [made, truth, np.clip(away, 0, 255).astype(np.uint8)]


def _field_pictures(made: np.ndarray, truth: np.ndarray) -> list[np.ndarray]:
    from matplotlib import colormaps

    a, b = made[..., _Z], truth[..., _Z]
    low, high = float(b.min()), float(b.max())
    span = max(high - low, 1e-9)
    plain = [colormaps["viridis"](np.clip((one - low) / span, 0, 1)) for one in (a, b)]
    coloured = [*plain, colormaps["bwr"](np.clip((a - b) / span + 0.5, 0, 1))]
    return [np.rint(255 * one[..., :3]).astype(np.uint8) for one in coloured]
