"""Pages of the paper's questions, from the records of the matrix alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from experiments.pages.page import Measure, Page, Value, compare, over_seeds
from experiments.tables import paper, pictures, plan, real, scores
from experiments.tables.columns import ANY, FORM, FOUR, SIX, UNSEEDED, dynamic, title
from experiments.tables.results import Column, Run, Seeds, differences, read, values

NAME = "matrix.jsonl"
ACCURACY = "Each value is the accuracy of a linear probe on frozen features."
OBJECTS = "The test objects were never touched in training. Values are means over seeds of training."
SMALL = "Networks are small and touch is simulated. Compare the direction of an effect with the paper, not the numbers."
ABOUT = f"{ACCURACY} {OBJECTS} {SMALL}"
NAMES = {"+".join(plan.SENSORS): "an encoder of all four sensors", "gelsight": "an encoder of GelSight alone"}
MOST = f"{scores.FRAMES[-1]} labelled"
NAMES |= {f"{kind}, {MOST}": f"{kind} tokens with the most frames" for kind in ("fitted", "universal")}
MOVING = tuple(number for number, name in enumerate(("slip", "force", "twist", "slide")) if name != "force")


class Matrix:
    """The runs of one question."""

    def __init__(self, runs: Sequence[Run], question: str) -> None:
        self.question = question
        self.runs = [run for run in runs if run.question == question]

    def seeds(self, name: str, columns: Sequence[Column]) -> Seeds:
        """Return {seed: mean over the columns}, for seeds that have all of them."""
        each = [values(self.runs, self.question, name, column) for column in columns]
        shared = set.intersection(*(set(one) for one in each))
        return {seed: float(np.mean([one[seed] for one in each])) for seed in sorted(shared)}

    def value(self, name: str, columns: Sequence[Column]) -> Value | None:
        """Return the score of a model; what is not trained has one value and no interval."""
        several = self.seeds(name, columns)
        if not several:
            return None
        return Value(next(iter(several.values()))) if name in UNSEEDED else over_seeds([*several.values()])

    def change(self, first: str, second: str, columns: Sequence[Column]) -> Value | None:
        """Return the score of `first` minus that of `second`, seed by seed."""
        a, b = self.seeds(first, columns), self.seeds(second, columns)
        if second in UNSEEDED and b:
            b = dict.fromkeys(a, next(iter(b.values())))
        shared = sorted(a.keys() & b.keys())
        return over_seeds([a[seed] - b[seed] for seed in shared]) if shared and first != second else None

    def sentence(self, first: str, second: str, columns: Sequence[Column], what: str = "", **form: str) -> str:
        """Return what the seeds say of two models, on `what`."""
        names = (NAMES.get(name, title(name)) for name in (first, second))
        return compare(*names, self.change(first, second, columns), what, **form)

    def by_view(self, name: str, views: Sequence[str]) -> list[Run]:
        """Return the views of a model as models, so that they can be compared."""
        result = []
        for run in (run for run in self.runs if run.name == name):
            for view in views:
                rows = [row | {"view": ANY} for row in run.about["rows"] if row["view"] == view]
                result.append(Run(self.question, view, run.seed, {"rows": rows}))
        return result


def q1(runs: Sequence[Run]) -> Page:
    """Table 1."""
    of, rows, findings = Matrix(runs, "q1"), [], []
    one, every = [*paper.TABLE1][1], [*paper.TABLE1][-1]
    theirs = {name: float(np.mean(row[2:])) for name, row in paper.TABLE1.items()}  # type: ignore[arg-type]
    for label, columns in (("material", FOUR[2:]), ("indenter", FORM[2:])):
        rows += [
            (label, title(name), of.value(name, columns), of.change(name, one, columns),
             theirs[name] - theirs[one] if label == "material" and name != one else None)
            for name in paper.TABLE1
        ]  # fmt: skip
        what = label
        findings += [of.sentence(every, one, columns, what), of.sentence(one, "no_pretraining", columns, what)]
    return Page(
        "sensors", "Does data of more sensors help on a sensor never seen?",
        f"{ABOUT} The score is the mean over two data sets of a sensor that no encoder was trained on. "
        "Captions name the material. They do not name the indenter.",
        ("label", "trained on", Measure("accuracy, %"), Measure("minus gelsight alone", "+.1f"),
         Measure("the paper's change", "+.2f", False)),
        rows, findings, (NAME,), "make experiments ONLY=q1",
        "Accuracy as sensors are added, for each data set. The grey line is the paper's, on the right axis.",
        partial(pictures.q1, of.runs),
    )  # fmt: skip


def q2(runs: Sequence[Run]) -> Page:
    """Figure 4."""
    of = Matrix(runs, "q2")
    names = ("pixels", "contact", "untrained", "masked", "aligned", "matched", "matched_mlp")
    top = [Column("", "class token", "top-1", "share")]
    sensor, thing = (
        [Column("", "class token", f"silhouette by {what}", f"silhouette by {what}", 1.0)]
        for what in ("sensor", "object")
    )
    order = {"unit": "", "form": ".3f"}
    findings = [of.sentence("matched", other, top, "retrieval") for other in ("aligned", "untrained", "pixels")]
    pairs = (("masked", "untrained", sensor), ("aligned", "masked", sensor), ("matched", "aligned", sensor),
             ("matched", "aligned", thing))  # fmt: skip
    findings += [of.sentence(a, b, columns, columns[0].task, **order) for a, b, columns in pairs]
    return Page(
        "space", "Do touches by different sensors share one space?",
        f"The same touch by another sensor is searched among 50 similar touches. {OBJECTS} {SMALL} "
        "A silhouette by sensor near zero means that sensors are mixed. A high one by object means that "
        "objects are apart.",
        ("space", Measure("first of 50, %"), Measure("silhouette by sensor", ".3f"),
         Measure("silhouette by object", ".3f")),
        [(title(name), of.value(name, top), of.value(name, sensor), of.value(name, thing)) for name in names],
        findings, (NAME,), "make experiments ONLY=q2",
        "Touches in four spaces. A mark is a sensor. A colour with its dashed lines is one touch.",
        partial(pictures.q2, of.runs),
    )  # fmt: skip


def q3(runs: Sequence[Run]) -> Page:
    """Tables 2 to 4."""
    of = Matrix(runs, "q3")
    names = ("pixels", "untrained", "no_pretraining", "unitouch", "tlv_link", "t3", "static_only", "anytouch")
    moving = [dynamic("clips")[i] for i in MOVING]
    findings = [of.sentence("anytouch", name, SIX, "static tasks") for name in names[:-1]]
    findings += [of.sentence("anytouch", name, moving, "dynamic tasks") for name in ("untrained", "t3", "static_only")]
    return Page(
        "perception", "Is one representation for all sensors better?",
        f"{ABOUT} Static tasks are material, roughness and hardness on four kinds of data. "
        "Dynamic tasks are slip, twist and slide, from clips.",
        ("features", Measure("static, %"), Measure("AnyTouch minus it", "+.1f"), Measure("dynamic, %"),
         Measure("AnyTouch minus it, dynamic", "+.1f")),
        [(title(name), of.value(name, SIX), of.change("anytouch", name, SIX), of.value(name, moving),
          of.change("anytouch", name, moving)) for name in names],
        findings, (NAME,), "make experiments ONLY=q3",
        "Each task by itself. The dotted line is the commonest answer for all.", partial(pictures.q3, of.runs),
    )  # fmt: skip


def ablations(runs: Sequence[Run]) -> Page:
    """Table 6."""
    of, whole = Matrix(runs, "ablations"), paper.TABLE6["anytouch"]
    rows = [
        (title(name), of.value(name, FOUR), of.change(name, "anytouch", FOUR), of.change(name, "anytouch", FORM),
         None if name == "anytouch" else float(np.mean(np.subtract(theirs, whole))))  # type: ignore[arg-type]
        for name, theirs in paper.TABLE6.items()
    ]  # fmt: skip
    findings = [of.sentence(name, "anytouch", FOUR, "material") for name in paper.TABLE6 if name != "anytouch"]
    return Page(
        "ablations", "Which part of AnyTouch matters?",
        f"{ABOUT} Each row leaves out one part. The score of the material is a mean over four kinds of data.",
        ("model", Measure("material, %"), Measure("minus AnyTouch", "+.1f"),
         Measure("indenter, minus AnyTouch", "+.1f"),
         Measure("the paper's change", "+.2f", False)),
        rows, findings, (NAME,), "make experiments ONLY=ablations",
        "What leaving out a part changes, for each kind of data.", partial(pictures.ablations, of.runs),
    )  # fmt: skip


def restricted(runs: Sequence[Run]) -> Page:
    """The control of Table 2."""
    of, theirs = Matrix(runs, "restricted"), paper.RESTRICTED
    gain = [a - b for a, b in zip(theirs["no_matching"], theirs["unitouch"], strict=True) if None not in (a, b)]  # type: ignore[operator]
    return Page(
        "same_data", "Is AnyTouch better on the same data?",
        f"{ABOUT} Both see the data of two sensors only, and no touch twice. So AnyTouch trains without matching.",
        ("model", Measure("accuracy, %"), Measure("minus UniTouch-style", "+.1f"),
         Measure("the paper's change", "+.2f", False)),
        [(title(name), of.value(name, SIX), of.change(name, "unitouch", SIX), float(np.mean(gain))
         if name != "unitouch" else None)
         for name in theirs],
        [of.sentence("no_matching", "unitouch", SIX)], (NAME,), "make experiments ONLY=restricted",
    )  # fmt: skip


def grasp(runs: Sequence[Run]) -> Page:
    """Frames after the grasp against frames during it."""
    of, column = Matrix(runs, "grasp"), [Column("", ANY, "grasp")]
    views = Matrix(of.by_view("anytouch", ("during", "after")), "grasp")
    during, after = paper.FEEL_AFTER
    change = views.change("after", "during", column)
    return Page(
        "grasp", "Are frames after a grasp easier than frames during it?",
        f"The task is whether a grasp held or slipped. {ABOUT} A press stands for the closing of a gripper. "
        "A slide or twist stands for the lift.",
        ("frames", Measure("accuracy, %"), Measure("after minus during", "+.1f"), Measure("the paper", ".2f", False)),
        [("during the grasp", views.value("during", column), None, during),
         ("after the grasp", views.value("after", column), change, after)],
        [compare("frames after the grasp", "frames during it", change, "accuracy")],
        (NAME,), "make experiments ONLY=grasp",
    )  # fmt: skip


def new_sensor(runs: Sequence[Run]) -> Page:
    """Tokens for a sensor left out of training."""
    of, columns = Matrix(runs, "new_sensor"), [Column("", ANY, task) for task in scores.STATIC]
    views = [scores.NOTHING]
    views += [f"{kind}, {count} labelled" for count in scores.FRAMES for kind in ("universal", "fitted")]
    both = Matrix([*of.by_view("left_out", views), *of.by_view("seen", ("seen",))], "new_sensor")
    start = views[0]
    widest = f"fitted, {MOST}"
    return Page(
        "new_sensor", "Do a few labelled frames of a new sensor help?",
        f"{ABOUT} One sensor is left out of training. Its tokens are the universal ones, or they are "
        "fitted to labelled "
        "frames. The labelled frames also join the training rows of the probe.",
        ("tokens and frames", Measure("accuracy, %"), Measure("minus no frame", "+.1f")),
        [(title(name), both.value(name, columns), both.change(name, start, columns)) for name in (*views, "seen")],
        [both.sentence(widest, start, columns), both.sentence("seen", start, columns),
         both.sentence(widest, widest.replace("fitted", "universal"), columns)],
        (NAME,), "make experiments ONLY=new_sensor",
        "Accuracy against the number of frames. Dashes: an encoder that was trained on the sensor.",
        partial(pictures.new_sensor, of.runs),
    )  # fmt: skip


VIEWS = {"clips": "clips of three frames", "stills": "the last frame", "shuffled": "clips, frames shuffled"}


def dynamics(runs: Sequence[Run]) -> Page:
    """Clips, stills and shuffled clips."""
    of, rows = Matrix(runs, "dynamics"), []
    for name in ("anytouch", "static_only", "no_flips"):
        views = Matrix(of.by_view(name, [*VIEWS]), "dynamics")
        moving, force = [dynamic(ANY)[i] for i in MOVING], [dynamic(ANY)[1]]
        rows += [
            (
                title(name),
                words,
                views.value(view, moving),
                views.change("clips", view, moving),
                views.value(view, force),
            )
            for view, words in VIEWS.items()
        ]
    clips = [dynamic("clips")[i] for i in MOVING]
    ours = Matrix(of.by_view("anytouch", [*VIEWS]), "dynamics")
    findings = [
        compare("AnyTouch on clips", f"AnyTouch on {words}", ours.change("clips", view, moving))
        for view, words in [*VIEWS.items()][1:]
    ]
    findings += [of.sentence("anytouch", "static_only", clips), of.sentence("no_flips", "anytouch", clips)]
    return Page(
        "dynamics", "Does the encoder feel motion?",
        f"{ABOUT} The score is the mean of slip, twist and slide. Twist and slide are directions in the picture. "
        "Training mirrors touches, so the encoder learns to overlook directions. One row trains without mirrors.",
        ("model", "input", Measure("accuracy, %"), Measure("clips minus it", "+.1f"), Measure("force, R2 in %")),
        rows, findings, (NAME,), "make experiments ONLY=dynamics",
        "Each task by itself: AnyTouch in blue, the encoder of stills in grey.", partial(pictures.dynamics, of.runs),
    )  # fmt: skip


def real_training(runs: Sequence[Run]) -> Page:
    """Both stages on simulated and real touch, probed on real touch."""
    of = [run for run in runs if run.question == "real"]
    rows, findings = [], []

    def score(task: str, view: str) -> Value | None:
        found = [row for run in of for row in run.about["rows"] if (row["task"], row["view"]) == (task, view)]
        found = [row for row in found if row["low"] is not None]
        if not found:
            return None
        sides = min(row["low"] for row in found), max(row["high"] for row in found)
        return Value(float(np.mean([row["mean"] for row in found])), *sides, len(found)).times(100)

    for task in dict.fromkeys(row["task"] for run in of for row in run.about["rows"]):
        views = [real.OURS, real.UNTRAINED, real.PIXELS]
        rows += [(task, view, score(task, view), score(task, f"{real.OURS} - {view}")) for view in views]
        findings += [
            compare("the trained encoder", words, score(task, f"{real.OURS} - {view}"), task)
            for view, words in ((real.UNTRAINED, "an untrained one"), (real.PIXELS, "raw pixels"))
        ]
    return Page(
        "real_training", "What does training on real touch add?",
        "Both stages are trained on simulated touch and on real frames of a GelSight Mini. Linear "
        "probes then read real "
        "touch. Recordings of the test are new. For slip and fingers the encoder met most recordings without labels. "
        "Values are means over seeds of training. An interval is over the test groups, and covers those of all seeds.",
        ("task", "features", Measure("accuracy, %"), Measure("trained minus it", "+.1f")),
        rows, findings, (NAME,), "make experiments ONLY=real",
    )  # fmt: skip


OF: Mapping[str, Callable[[Sequence[Run]], Page]] = {
    "q1": q1, "q2": q2, "q3": q3, "ablations": ablations, "restricted": restricted, "grasp": grasp,
    "new_sensor": new_sensor, "dynamics": dynamics, "real": real_training,
}  # fmt: skip


def pages(results: Path) -> list[Page]:
    """Return the pages of the questions that have runs. Raises UserError for runs that make no table together."""
    runs: list[Run] = read(results)
    made: list[Any] = []
    for question, make in OF.items():
        mine = [run for run in runs if run.question == question]
        if wrong := differences([run.about for run in mine]):
            raise UserError(f"{results}: runs of {question} differ ({wrong}). Make them again in one folder.")
        made += [make(runs)] if mine else []
    return made
