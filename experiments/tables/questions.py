"""The questions, one by one: which columns their tables have, and which signs of the paper they test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from anytouch_jax.evaluate.statistics import markdown_table
from experiments.tables import paper, plan, scores
from experiments.tables.real import OURS, PIXELS, UNTRAINED
from experiments.tables.results import Change, Column, Run, spread
from experiments.tables.tables import Pair, Statement, Table, against, block, cell, judge, published, sentence, title
from experiments.verdicts import seed_interval, verdict


def four(task: str) -> tuple[Column, ...]:
    """The columns of the paper's tables, of one task."""
    return (
        Column("seen", "seen", task), Column("seen sensor, other data", "seen, other data", task),
        Column("unseen sensor", "unseen", task), Column("unseen sensor, other data", "unseen, other data", task),
    )  # fmt: skip


FOUR, FORM = four("material"), four("indenter")
FOUR_PAPER = ("TAG", "Feel", "OF 1.0", "OF 2.0")
SIX = (
    Column("material", "seen", "material"),
    Column("roughness", "seen", "roughness"),
    Column("hardness", "seen", "hardness"),
    *FOUR[1:],
)
SIX_PAPER = ("TAG material", "roughness", "hardness", "Feel", "OF 1.0", "OF 2.0")


def dynamic(view: str) -> tuple[Column, ...]:
    """The columns of the dynamic tasks under one view."""
    return (
        Column("slip", view, "slip"), Column("force (R2)", view, "force", "r2"), Column("twist", view, "twist"),
        Column("slide", view, "slide"),
    )  # fmt: skip


SPACE = (
    Column("top-1", "class token", "top-1", "share"),
    Column("top-5", "class token", "top-5", "share"),
    Column("silhouette by sensor", "class token", "silhouette by sensor", "silhouette by sensor", 1.0, -1, 3),
    Column("silhouette by object", "class token", "silhouette by object", "silhouette by object", 1.0, 1, 3),
    Column("alignment", "class token", "alignment", "alignment", 1.0, -1, 3),
    Column("uniformity", "class token", "uniformity", "uniformity", 1.0, -1, 3),
)
STATIC = tuple(Column(task, "static", task) for task in ("material", "roughness", "hardness"))
ANY = "any"
GRASP = (Column("during the grasp", "during", "grasp"), Column("after the grasp", "after", "grasp"))


class Part(NamedTuple):
    """A section of the results: its title, its Markdown, and the statements that it makes."""

    title: str
    text: str
    statements: Sequence[Statement]


def q1(runs: Sequence[Run]) -> Part:
    """Table 1: every row against the row before; with all sensors against one, on the unseen one."""
    table = Table("q1", (*paper.TABLE1,), FOUR, paper.TABLE1, FOUR_PAPER)
    pairs = []
    for before, name in zip(table.names, table.names[1:], strict=False):
        expected = [a - b for a, b in zip(paper.TABLE1[name], paper.TABLE1[before], strict=True)]  # type: ignore[operator]
        label = f"{title(name)} against {title(before)}"
        pairs.append(Pair(label, name, before, expected, None if before == "no_pretraining" else (2, 3)))
    first, last = table.names[1], table.names[-1]
    expected = [a - b for a, b in zip(paper.TABLE1[last], paper.TABLE1[first], strict=True)]  # type: ignore[operator]
    pairs.append(Pair("more sensors help the unseen one: four against one", last, first, expected, (2, 3)))
    return Part("Q1: what each sensor's data adds (Table 1)", *_both(runs, table, pairs))


def _both(runs: Sequence[Run], table: Table, pairs: Sequence[Pair]) -> tuple[str, list[Statement]]:
    """A table of materials and, with the same signs expected, of forms: its text and statements."""
    result = judge(runs, table.question, FOUR, pairs)
    form = judge(runs, table.question, FORM, [pair._replace(label=f"form: {pair.label}") for pair in pairs])
    text = (
        f"The material, which captions name:\n\n{block(runs, table, result)}\n\n"
        "The form of the indenter, which no caption names (the same signs are expected):\n\n"
        f"{block(runs, table._replace(columns=FORM, paper={}, paper_titles=()), form)}"
    )
    return text, [*result, *form]


def q2(runs: Sequence[Run]) -> Part:
    """Figure 4 in numbers: what each component does to the space."""
    names = ("pixels", "contact", "untrained", "masked", "aligned", "matched", "matched_mlp")
    # The paper in words: masked modelling draws the touches of a sensor together; alignment begins to blend the
    # sensors; matching mixes them and gathers the touches of an object. Signs are of what is better: to find the
    # touch, not to be ordered by sensor.
    result = []
    for label, first, second, column, sign in (
        ("masked modelling gathers each sensor's touches", "masked", "untrained", 2, -1),
        ("alignment begins to blend the sensors", "aligned", "masked", 2, 1),
        ("matching mixes the sensors", "matched", "aligned", 2, 1),
        ("matching gathers the touches of an object", "matched", "aligned", 3, 1),
    ):
        result += judge(runs, "q2", SPACE[column : column + 1], [Pair(label, first, second, (sign,))])
    finds = (1, 1)
    result += judge(runs, "q2", SPACE[:2], [
        Pair("retrieval: alignment above masked modelling", "aligned", "masked", finds),
        Pair("retrieval: matching above alignment", "matched", "aligned", finds),
        Pair("retrieval: matching above no pre-training", "matched", "untrained", finds),
        Pair("our control: matching above raw pixels", "matched", "pixels", finds),
        Pair("our control: matching above area, place and force", "matched", "contact", finds),
    ])  # fmt: skip
    table = Table("q2", names, SPACE)
    return Part("Q2: the space of touches (Figure 4)", f"{_chances(runs)}{block(runs, table, result)}", result)


def _chances(runs: Sequence[Run]) -> str:
    """What top-1 and top-5 are among, and what chance gives."""
    rows = [row for run in runs if run.question == "q2" for row in run.about["rows"] if "gallery" in row]
    if not rows:
        return ""
    chance = {row["task"]: f"{100 * row['chance']:.0f} %" for row in rows}
    among = " or ".join(sorted({str(row["gallery"]) for row in rows}))
    words = ", ".join(f"{task} {value}" for task, value in chance.items())
    known = [row for row in rows if row.get("nearness") is not None]
    near = ""
    if known:
        near = f" of {known[0]['of']} (they lie {known[0]['nearness']:.2f} times as far as all do)"
    return (
        f"Retrieved among the {among} touches{near} that are nearest in place, depth and force; by chance {words}.\n\n"
    )


def q3(runs: Sequence[Run]) -> Part:
    """Tables 2 and 3 (static) and Table 4's models on dynamic tasks."""
    names = ("pixels", "untrained", "no_pretraining", "unitouch", "tlv_link", "t3", "static_only", "anytouch")
    static = Table("q3", names, SIX, paper.TABLES23, SIX_PAPER)
    rivals = [pair for pair in against(static, "anytouch", None) if pair.second in paper.TABLES23]
    one = judge(runs, "q3", SIX, [*rivals, *_controls(len(SIX))])
    shape = [pair._replace(label=f"form: {pair.label}", expected=_of_form(pair)) for pair in rivals]
    form = judge(runs, "q3", FORM, [*shape, *_controls(len(FORM), "form: ")])
    moving = Table("q3", names, dynamic("clips"), paper.TABLE4, ("pouring, fine-tuned (g)", "frozen (g)"))
    ahead = [
        Pair(f"AnyTouch against {title(name)}", "anytouch", name, (1, 1, 1, 1), (0, 2, 3))  # R2 is no accuracy
        for name in paper.TABLE4 if name != "anytouch"
    ]  # fmt: skip
    two = judge(runs, "q3", moving.columns, [*ahead, *_controls(len(moving.columns), "dynamic tasks: ", (0, 2, 3))])
    text = (
        f"Static tasks (Tables 2 and 3):\n\n{block(runs, static, one)}\n\n{_read(runs)}"
        "The form of the indenter, which no caption names (signs as of the materials):\n\n"
        f"{block(runs, Table('q3', names, FORM), form)}\n\n"
        "Dynamic tasks, probes on clips; beside them the paper's pouring with a robot (Table 4,\n"
        f"less is better):\n\n{block(runs, moving, two)}"
    )
    return Part("Q3: static and dynamic perception (Tables 2, 3, 4)", text, (*one, *form, *two))


def _read(runs: Sequence[Run]) -> str:
    """The same features by other heads and poolings than the tables'; nothing where no run was read so."""
    columns = (*(Column(task, ANY, task) for task in scores.STATIC), Column("form", ANY, scores.FORM))
    ways = {"seen": "linear, class token and mean of patches"}
    ways |= {f"read: {way}": way if "pooling" in options else f"{way}, class token and mean of patches"
             for way, options in scores.WAYS.items()}  # fmt: skip
    parts = []
    for name in scores.READ:
        several = [run for run in runs if run.name == name and any(r["view"] in [*ways][1:] for r in run.about["rows"])]
        if several:
            result = [replace(run, name=ways[run.name]) for run in by_view(several, "q3", name, [*ways])]
            text = block(result, Table("q3", [*ways.values()], columns), ())
            parts.append(f"{title(name)}, by head and pooling:\n\n{text}\n\n")
    return "".join(parts)


def _controls(columns: int, label: str = "", whole: Sequence[int] | None = None) -> list[Pair]:
    """What the paper has no row for: AnyTouch above what was never trained, and above raw pixels."""
    return [
        Pair(f"{label}our control: AnyTouch above {title(name)}", "anytouch", name, (1,) * columns, whole)
        for name in ("untrained", "pixels")
    ]


def _of_form(pair: Pair) -> tuple[float | None, ...]:
    """What is expected of the columns of forms: the signs of material among the columns of `SIX`."""
    return (pair.expected[0], *pair.expected[3:])


def ablations(runs: Sequence[Run]) -> Part:
    """Table 6."""
    table = Table("ablations", (*paper.TABLE6,), FOUR, paper.TABLE6, FOUR_PAPER)
    return Part("Ablations (Table 6)", *_both(runs, table, against(table, None, "anytouch")))


def restricted(runs: Sequence[Run]) -> Part:
    """The control of Table 2: the rival's data for both."""
    table = Table("restricted", ("unitouch", "no_matching"), SIX, paper.RESTRICTED, SIX_PAPER)
    result = judge(runs, "restricted", SIX, against(table, "no_matching", None))
    text = (
        f"Both see {' and '.join(plan.RESTRICTED)} alone, without touches felt twice (so AnyTouch has no matching).\n"
        "In the paper both had trained on Feel and on OF 2.0, so those two columns are not of unseen data there.\n\n"
    )
    return Part("The same restricted data (control of Table 2)", text + block(runs, table, result), result)


def grasp(runs: Sequence[Run]) -> Part:
    """Compare frames after the grasp with frames during it."""
    table = Table("grasp", ("anytouch",), GRASP, {"anytouch": paper.FEEL_AFTER}, ("Feel, during", "Feel, after"))
    pair = Pair("frames after the grasp are easier than frames during it", "after", "during", (1,))
    views = by_view(runs, "grasp", "anytouch", ("during", "after"))
    result = judge(views, "grasp", (Column("held or slipped", ANY, "grasp"),), (pair,))
    text = (
        "A simulated recording has no gripper: the press stands for the closing (the frame in which it is done), the\n"
        "end of the slide or twist for the lift, and a touch slipped when more than half of its contact slid half-way\n"
        "through the motion.\n\n"
    )
    if any("values" not in row for run in runs if run.question == "grasp" for row in run.about["rows"]):
        text += "Each number is of one fit on the data set's own split; other tables deal the objects five times.\n\n"
    return Part("Feel: frames after the grasp beside frames during it", text + block(runs, table, result), result)


def by_view(runs: Sequence[Run], question: str, name: str, views: Sequence[str]) -> list[Run]:
    """The views of one model as runs of their own, so that they can be set against each other."""
    result = []
    for run in runs:
        if (run.question, run.name) == (question, name):
            for view in views:
                rows = [row | {"view": ANY} for row in run.about["rows"] if row["view"] == view]
                result.append(Run(question, view, run.seed, {"rows": rows}))
    return result


def new_sensor(runs: Sequence[Run]) -> Part:
    """How much of the gap to a seen sensor a few frames close."""
    views = [scores.NOTHING]
    for frames in scores.FRAMES:
        views += [f"universal, {frames} labelled", f"fitted, {frames} labelled"]
    several = [*by_view(runs, "new_sensor", "left_out", views), *by_view(runs, "new_sensor", "seen", ("seen",))]
    columns = [Column(task, ANY, task) for task in scores.STATIC]
    lines = []
    for name in (*views, "seen"):
        cells = [cell(several, "new_sensor", name, one) + _closed(several, name, one) for one in columns]
        lines.append((title(name), str(len({run.seed for run in several if run.name == name})), *cells))
    on_test = published(several, Table("new_sensor", (*views, "seen"), columns))
    text = (
        f"{plan.UNSEEN} is left out of training. Its tokens are the universal ones, or they are fitted to the\n"
        "material of labelled frames, with all else frozen. The labelled frames also join the training rows of the\n"
        "probe. Without them the probe learns from the other sensors alone. In brackets at the end: the share of the\n"
        "gap to a model "
        "trained on the sensor that is closed (- below 3 points). No sign is claimed.\n\n"
    )
    table = markdown_table(("tokens, frames", "seeds", *scores.STATIC), lines)
    wide = (f"fitted, {scores.FRAMES[-1]} labelled", "seen")
    pairs = [
        Pair(f"{title(one)} against {title(scores.NOTHING)}", one, scores.NOTHING, (None,) * len(columns))
        for one in wide
    ]
    result = judge(several, "new_sensor", columns, pairs)
    parts = (f"{text}{table}", on_test.rstrip(), "\n".join(map(sentence, result)))
    return Part("A new sensor", "\n\n".join(part for part in parts if part), result)


def _closed(runs: Sequence[Run], name: str, column: Column) -> str:
    start, here, goal = (spread(runs, "new_sensor", one, column) for one in (scores.NOTHING, name, "seen"))
    if start is None or here is None or goal is None or name == "seen":
        return ""
    gap = goal[0] - start[0]
    return " (-)" if gap < 3 else f" ({100 * (here[0] - start[0]) / gap:.0f} %)"


def dynamics(runs: Sequence[Run]) -> Part:
    """Clips against stills, shuffled and repeated frames; what training makes of them."""
    names = ("anytouch", "static_only", "no_flips")
    parts = [f"{what}:\n\n{block(runs, Table('dynamics', names, dynamic(view)), ())}" for view, what in VIEWS.items()]
    parts.append(f"Static tasks, from a still:\n\n{block(runs, Table('dynamics', names, STATIC), ())}")
    views = by_view(runs, "dynamics", "anytouch", tuple(VIEWS))
    # The paper compares models, not views: differences of views are shown and no sign is expected of them.
    pairs = [Pair(f"AnyTouch, clips against {view}", "clips", view, (None,) * 4) for view in ("stills", "shuffled")]
    result = judge(views, "dynamics", dynamic(ANY), pairs)
    trained = Pair("dynamic training against stills only, on clips", "anytouch", "static_only", (1, 1, 1, 1), (0, 2, 3))
    result += judge(runs, "dynamics", dynamic("clips"), (trained,))
    for name in names[2:]:
        for columns, what in ((dynamic("clips"), "on clips"), (STATIC, "static tasks")):
            pair = Pair(f"{title(name)}, against AnyTouch, {what}", name, "anytouch", (None,) * len(columns))
            result += judge(runs, "dynamics", columns, (pair,))
    text = (
        "Twist and slide are directions of the picture as it is. Training flips touches, and the positive of a match\n"
        "apart from its anchor, which asks the encoder to overlook directions; a probe sees frames unflipped. The\n"
        "row without flips shows what that costs. The encoder takes a still as that frame three times over, so stills\n"
        "and the last frame repeated are one measurement. What the paper claims is that dynamic training is better\n"
        "(Table 4 compares models); what a clip shows beside a still is no claim of its.\n\n"
    )
    return Part("Dynamics", text + "\n\n".join(parts) + "\n\n" + "\n".join(map(sentence, result)), result)


VIEWS = {
    "clips": "Clips of three frames",
    "stills": "Stills (the last frame)",
    "shuffled": "Clips, frames shuffled",
    "repeated": "Clips, the last frame repeated",
}
REAL_TITLE = "Real touch"


def real(runs: Sequence[Run]) -> Part:
    """Object and slip: whether ours is above raw pixels and above an untrained encoder by more than the interval."""
    several = [run for run in runs if run.question == "real"]
    if not several:
        return Part(REAL_TITLE, "**Not run.**", [Statement("real touch", Change("not run"), {})])
    tasks = list(dict.fromkeys(row["task"] for run in several for row in run.about["rows"]))
    lines, statements = [], []
    for task in tasks:
        views = list(dict.fromkeys(r["view"] for run in several for r in run.about["rows"] if r["task"] == task))
        for view in views:
            cells = _over_seeds(several, task, view)
            lines.append((task, view, *cells))
        statements += [ahead_of_control(several, task, name) for name in (PIXELS, UNTRAINED)]
    text = (
        "Stages 1 and 2 on the simulated data and the training split of the pack; GelSight Mini with markers, frames\n"
        "in contact. Object: test recordings. Every recording tested (ten folds), slip and fingers: recordings of all\n"
        "splits, so the encoder (not the probe) has seen most of them in pre-training: without labels, but with\n"
        "captions and photographs of some.\n"
        "The paper has no such probe: tested is that ours is above the controls by more than the interval, in every\n"
        "seed. Each number is of one fit (for slip one a fold), not the mean of five deals as in the tables above.\n"
        "Fingers: trained on the units of one camera, tested on those of the other; the two fingers of a grasp are on\n"
        "both sides, so this is another gel and camera, not another grasp. Each gel felt objects of its own beside\n"
        "two that several felt, so the commonest answers of one are mostly wrong of the other.\n\n"
    )
    between = "95 % over test groups, by seed"
    head = ("task", "features", "accuracy, mean over seeds", between, "commonest", "test frames")
    table = markdown_table(head, lines)
    signs = "\n".join(f"- {one.label}: **{one.row.word}**{_by_seed(one)}." for one in statements)
    return Part(REAL_TITLE, f"{text}{table}\n\n{signs}", statements)


def ahead_of_control(runs: Sequence[Run], task: str, name: str) -> Statement:
    """Whether ours is above a control: in each seed the paired interval over test groups is above zero."""
    result = [
        row for run in runs for row in run.about["rows"] if (row["task"], row["view"]) == (task, f"{OURS} - {name}")
    ]
    means = [100 * row["mean"] for row in result]
    label = f"{task}: above {'raw pixels' if name == PIXELS else 'an untrained encoder'}"
    low, high = seed_interval(means)
    if not result:
        return Statement(label, Change("not run"), {})
    words = {verdict(row["low"], row["high"], len(result)) for row in result}
    word = words.pop() if len(words) == 1 else "undecided"
    each = {f"seed {i}": Change("", *(None if row[k] is None else 100 * row[k] for k in ("mean", "low", "high")))
            for i, row in enumerate(result)}  # fmt: skip
    return Statement(label, Change(word, float(np.mean(means)), low, high, len(result)), each)


def _by_seed(one: Statement) -> str:
    result = [f"{c.mean:+.1f} ({c.low:+.1f} to {c.high:+.1f})" if c.low is not None and c.high is not None else "-"
             for c in one.columns.values()]  # fmt: skip
    return f", by seed {'; '.join(result)}" if result else ""


def _over_seeds(runs: Sequence[Run], task: str, view: str) -> tuple[str, str, str, str]:
    rows = [row for run in runs for row in run.about["rows"] if (row["task"], row["view"]) == (task, view)]
    rows = [row for row in rows if row["mean"] is not None]
    if not rows:
        return "-", "-", "-", "-"
    common = f"{100 * rows[0]['chance']:.1f}" if "chance" in rows[0] else "-"
    between = [f"{100 * row['low']:.1f} to {100 * row['high']:.1f}" if row["low"] is not None else "-" for row in rows]
    return (
        f"{100 * np.mean([row['mean'] for row in rows]):.1f}",
        "; ".join(between),
        common,
        str(rows[0].get("test", "")),
    )


OF: Mapping[str, Callable[[Sequence[Run]], Part]] = {
    "q1": q1, "q2": q2, "q3": q3, "ablations": ablations, "restricted": restricted, "grasp": grasp,
    "new_sensor": new_sensor, "dynamics": dynamics, "real": real,
}  # fmt: skip
