"""`experiments/results/README.md`, rendered from `matrix.jsonl` alone, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from anytouch_jax.files import atomic_write
from experiments.tables import pictures, questions
from experiments.tables.plan import LABELS
from experiments.tables.questions import Part
from experiments.tables.results import CLAIM, NOT_NOTED, Run, comparable, differences, drawn, read, simulated
from experiments.tables.tables import by_chance, tally

_INTRO = f"""Made by `make experiments` from `matrix.jsonl` alone. `make experiments RENDER=1` makes it
again without running anything. Every number is the mean over seeds of training, with its 95 % interval over
seeds (Student's t; of two seeds the two numbers themselves, and with one seed the interval of the run itself, over
test objects). Accuracies are in %, by a linear probe of frozen features on objects never touched in training. Protocol
`honest`: the penalty is chosen without the test set.

An interval over seeds is one of trainings for these test objects, which are the same for every seed: it does not say
how other objects would come out (the records hold no numbers by object, so these cannot be drawn again here).

A sign is that of the difference of two rows, seed by seed. It *agrees* when the interval leaves zero out on the paper's
side, is *undecided* when zero lies within, and is not claimed below {CLAIM} seeds. The data are simulated, the network
is preset tiny made smaller still, trained from scratch for minutes, and cross-sensor matching is contrast with all
other touches of the batch instead of the paper's pairs (`Size` in `tables/plan.py` says why): compared is the direction
of an effect, never the paper's absolute numbers, which are printed next to ours. Columns: *seen* is a data
set trained on (as TAG); *seen sensor, other data* one never trained on (as Feel), whose objects are held out from the
probe (their kinds may have been met in pre-training); *unseen sensor* a sensor never trained on (as OF 1.0 and OF 2.0).
Recipes of one stage are trained for that stage's steps alone, AnyTouch for both. *No tactile pre-training* is the image
tower of our AnyTouch: it never saw a touch, but was trained here towards touch, photographs and text; the paper's CLIP
never met touch. Statements on dynamic tasks and on the grasp test the paper's claim, not a number of its."""
_TITLE = "# The paper's questions, answered"
CAUSES = "causes.md"  # next to the page, written by hand: why a sign does not agree


def parts(runs: Sequence[Run]) -> dict[str, Part]:
    """The sections, by question. Without runs, or where they differ in what they must share, there is no table."""
    result, kept = {}, comparable(runs)
    for name, make in questions.OF.items():
        wrong = differences([run.about for run in runs if run.question == name])
        result[name] = make(kept)
        if not any(run.question == name for run in runs):
            result[name] = result[name]._replace(text="**Not run.**")
        if wrong:
            text = f"**No table: these runs differ in what they must share ({wrong}).** Make them again in one folder."
            result[name] = Part(result[name].title, text, ())
    return result


def text(runs: Sequence[Run], figures: Sequence[Path] = ()) -> str:
    """The whole page."""
    result = parts(runs)
    by_name = {path.stem: path for path in figures}
    lines = [
        _TITLE,
        _INTRO,
        tally({p.title: p.statements for p in result.values() if p.statements}),
        by_chance([one for part in result.values() for one in part.statements]),
    ]
    sizes = sorted({size_of(run, runs) for run in runs})
    if sizes not in ([], ["full"]):
        lines.append(f"**Sizes in these results: {', '.join(sizes)}. Numbers of toy sizes mean nothing.**")
    if unlike := recipes(runs):
        lines.append(f"The questions are of different recipes: {unlike}. A table never mixes them.")
    for name, part in result.items():
        lines += [f"## {part.title}", part.text]
        if name in by_name:
            lines.append(f"![{part.title}](figures/{by_name[name].name})")
    return "\n\n".join([*lines, "## The runs", provenance(runs)]) + "\n"


def recipes(runs: Sequence[Run]) -> str:
    """Which questions are of which simulator and settings, those that differ, in words; empty where none does."""
    by_question: dict[str, dict[str, str]] = {}
    for run in comparable(runs):
        settings = {name: str(value) for name, value in (run.about.get("settings") or {}).items() if name not in LABELS}
        by_question[run.question] = {"simulator": str(simulated(run.about)), **settings}
    names = dict.fromkeys(name for one in by_question.values() for name in one)
    differ = [name for name in names if len({one.get(name) for one in by_question.values()}) > 1]
    groups: dict[str, list[str]] = {}
    for question, one in by_question.items():
        words = ", ".join(f"{name} {one.get(name, NOT_NOTED)}" for name in differ)
        groups.setdefault(words, []).append(question)
    return "; ".join(f"{', '.join(of)}: {words}" for words, of in groups.items()) if len(groups) > 1 else ""


def size_of(run: Run, runs: Sequence[Run]) -> str:
    """The name of a run's size: "full" where its settings are those of a run that is."""
    ours = run.about.get("settings")
    return "full" if ours and any(_alike(ours, one) for one in runs) else str(run.about.get("size"))


def _alike(settings: Mapping[str, Any], other: Run) -> bool:
    theirs = other.about.get("settings") or {}
    names = (settings.keys() | theirs.keys()) - set(LABELS)
    return other.about.get("size") == "full" and all(settings.get(name) == theirs.get(name) for name in names)


def provenance(runs: Sequence[Run]) -> str:
    """How many runs, what they cost, where they ran."""
    rows = []
    for question in dict.fromkeys(run.question for run in runs):
        several = [run for run in runs if run.question == question]
        trained = {one["key"]: one["seconds"] for run in several for one in run.about["trained"]}
        seconds = (sum(trained.values()), sum(run.about["seconds"] for run in several))
        names = ", ".join(f"`{run.name}-{run.seed}`" for run in several)
        rows.append((question, str(len(several)), str(len(trained)), *(f"{one / 60:.1f}" for one in seconds), names))
    every = {one["key"]: one for run in runs for one in run.about["trained"]}
    total = (sum(one["seconds"] for one in every.values()) + sum(run.about["seconds"] for run in runs)) / 60
    machines = sorted({run.about["machine"].split("; load")[0] for run in runs})
    versions = sorted({f"{run.about['version']} ({run.about['source']})" for run in runs})
    notes = f"{len(runs)} runs, {len(every)} trainings, {total:.0f} minutes without the data. Version (hash of its "
    notes += f"source): {', '.join(versions) or '-'}. Machine: {' | '.join(machines) or '-'}."
    last = sum(bool(one.get("resumed_at_step")) and "parts" not in one for one in every.values())
    notes += f" {last} trainings were gone on with and note their last part alone." if last else ""
    simulators = sorted({simulated(run.about) for run in runs})
    notes += f" Version of the simulator: {', '.join(map(str, simulators)) or '-'}."
    if again := drawn(runs):
        notes += " The same scenes gave tables of other content (another kind of processor, by the machines above): "
        notes += f"{again}."
    head = ("question", "runs", "trainings", "training, min", "scores, min", "names")
    return f"{notes}\n\nTrainings that several questions share are counted in each row.\n\n{markdown_table(head, rows)}"


def check_page(out: Path) -> None:
    """Raise UserError where `out`/README.md is another page than that of `write`."""
    page = out / "README.md"
    if page.exists() and page.read_text(encoding="utf-8", errors="replace").split("\n", 1)[0] != _TITLE:
        raise UserError(f"{page} is not a page of these results; give another folder with --out")


def write(results: Path, out: Path) -> Path:
    """Render a file of results to `out`/README.md and `out`/figures and return the page.

    Raises UserError where `out`/README.md is another page.
    """
    check_page(out)
    runs, page = read(results), out / "README.md"
    figures = pictures.draw_all(comparable(runs), out / "figures")
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(page, whole(runs, figures, out))
    return page


def whole(runs: Sequence[Run], figures: Sequence[Path], out: Path) -> str:
    """The page with what is written by hand in `out`."""
    causes = out / CAUSES
    return text(runs, figures) + ("\n" + causes.read_text(encoding="utf-8") if causes.exists() else "")
