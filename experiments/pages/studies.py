"""Pages of the studies beside the matrix, from their records alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.weights.registry import DEFAULT
from experiments.benchmarks.untouched_gel import NAME as GELS
from experiments.benchmarks.untouched_gel import WAYS
from experiments.encoders.by_contact import NAME as CONTACTS
from experiments.encoders.by_contact import WAYS as CONTACT_WAYS
from experiments.pages.page import Measure, Page, Value, compare, over_seeds
from experiments.pouring import table as pours
from experiments.real.scores import HEADS, TASKS, TRAINED, Score
from experiments.records import Record, read_records
from experiments.tables.by_object import gathered
from experiments.translation.settings import OURS, PIXELS, TRANSLATIONS, one_table, runs_of

PATCHES = {"": "plain", "_convolutional": "convolutional"}
HELD_OUT = "held_out.jsonl"
FIRST, PAYS = next(iter(CONTACT_WAYS)), 1.3  # the plain way, and how many times as fast another has to be
NAMED, UNNAMED = ("hardness", "roughness", "material"), "indenter"


def records_of(path: Path) -> dict[str, Record]:
    """Return the records of a file. Raises UserError without any."""
    records = read_records(path)
    if not records:
        raise UserError(f"{path} has no record. Run the study first.")
    return records


def by_objects(counts: np.ndarray, right: Sequence[np.ndarray], minus: Sequence[np.ndarray] | None = None) -> Value:
    """Return the share in % that seeds have right, or its difference from another, with the interval over objects."""
    mean = np.mean(right, 0) - (0 if minus is None else np.mean(minus, 0))
    rows = np.repeat(mean / counts, counts)
    low, high = mean_interval(rows, np.repeat(np.arange(len(counts)), counts))
    return Value(float(rows.mean()), low, high).times(100)


def teaching(folder: Path) -> Page:
    """Retrieval by encoders that were trained on simulated scenes for hours."""
    names = ("stage 2", "stage 1", "untrained", "untrained, whole picture", "pixels", "vector")
    rows, findings = [], []
    for suffix, patches in PATCHES.items():
        for grade, several in _grades(folder / f"teaching{suffix}.jsonl").items():
            counts, right = gathered([one["retrieval"]["top1"] for one in several])
            _, five = gathered([one["retrieval"]["top5"] for one in several])
            best = right["stage 2"]
            ahead = {name: by_objects(counts, best, right[name]) for name in names[1:]}
            rows += [
                (f"{patches} patches", f"{grade} texture", name, by_objects(counts, right[name]), ahead.get(name),
                 by_objects(counts, five[name])) for name in names
            ]  # fmt: skip
            what = f"{grade} texture, {patches} patches"
            findings += [compare("AnyTouch", words, ahead[name], what) for name, words in _RIVALS.items()]
    return Page(
        "teaching", "Does training on simulated scenes find the same touch by another sensor?",
        "Encoders are trained on simulated touch for hours. Then the same touch by another sensor and unit is searched "
        "among 50 touches that resemble it in place, depth and force. The objects were never touched in training. "
        "Patches are read by one linear layer (plain) or by small convolutions. The vector is contact area, place and "
        "force. Intervals are over objects.",
        ("encoder", "scenes", "features", Measure("first of 50, %"), Measure("stage 2 minus it", "+.1f"),
         Measure("among the first five, %")),
        rows, findings, ("teaching.jsonl", "teaching_convolutional.jsonl"), "python -m experiments.tables.teaching",
    )  # fmt: skip


_RIVALS = {"stage 1": "its first stage", "pixels": "raw pixels"}


def _grades(path: Path) -> dict[str, list[Record]]:
    """Return the records of every grade, seed by seed. Raises UserError for other settings."""
    records = records_of(path)
    if len({str(one["settings"]) for one in records.values()}) > 1:
        raise UserError(f"{path} has records of different settings. Remove those of one.")
    result: dict[str, list[Record]] = {}
    for key, one in records.items():
        result.setdefault(key.rsplit("-", 1)[0], []).append(one)
    if len({len(several) for several in result.values()}) > 1:
        raise UserError(f"{path} lacks a seed of {min(result, key=lambda grade: len(result[grade]))}. Run it again.")
    return dict(sorted(result.items(), reverse=True))


def left_out(folder: Path) -> Page:
    """Probes of a sensor that was left out of training."""
    rows, findings = [], []
    for sensor, data, patches, several, best in _left_out(folder):
        for title, labels in (("the three that captions name", NAMED), ("the indenter", (UNNAMED,))):
            each = [gathered([one[label] for one in several]) for label in labels]
            counts = each[0][0]
            right = {
                name: [np.mean(seed, 0) for seed in zip(*(found[name] for _, found in each), strict=True)]
                for name in (best, "untrained", "pixels")
            }
            change = {name: by_objects(counts, right[best], right[name]) for name in ("untrained", "pixels")}
            rows.append((sensor, data, f"{patches} patches", title, by_objects(counts, right[best]), *change.values()))
            what = f"{sensor}, {data}, {patches} patches, {title}"
            findings += [compare("AnyTouch", "an untrained encoder", change["untrained"], what)]
    found, also = _held_out(folder)
    rows, findings = rows + found, findings + also
    return Page(
        "left_out", "Do features carry over to a sensor left out of training?",
        "One sensor is left out of training, DIGIT only of stage 2. Linear probes read the labels of its "
        "contact frames, on objects never touched in training. Captions name hardness, roughness and material. They do "
        "not name the indenter. How well these labels can be learned at all is on the page [named](named.md). "
        "Intervals are over objects.",
        ("sensor", "training", "encoder", "label", Measure("AnyTouch, %"), Measure("minus untrained", "+.1f"),
         Measure("minus pixels", "+.1f")),
        rows, findings, [
            *(f"{name}{suffix}.jsonl" for name in ("teaching", "named") for suffix in PATCHES),
            *([HELD_OUT] if found else []),
        ],
        "python -m experiments.tables.teaching",
    )  # fmt: skip


def _held_out(folder: Path) -> tuple[list[tuple[Any, ...]], list[str]]:
    """Return rows and findings of an encoder whose stage 2 on a GPU left one sensor out."""
    rows, findings = [], []
    for sensor, record in (read_records(folder / HELD_OUT) if (folder / HELD_OUT).exists() else {}).items():
        for label, scores in record["labels"].items():
            change = {
                name: Value(scores[name]["minus"], *scores[name]["minus_interval"]).times(100)
                for name in ("untrained", "pixels")
            }  # fmt: skip
            ours = Value(scores["AnyTouch"]["share"], *scores["AnyTouch"]["interval"]).times(100)
            words = (sensor.upper(), "stage 2 for minutes on a GPU", "convolutional patches", label)
            rows.append((*words, ours, *change.values()))
            what = f"{words[0]}, left out of stage 2, {label}"
            findings.append(compare("AnyTouch", "an untrained encoder", change["untrained"], what))
    return rows, findings


def _left_out(folder: Path) -> Iterator[tuple[str, str, str, list[Mapping[str, Any]], str]]:
    for suffix, patches in PATCHES.items():
        for grade, several in _grades(folder / f"teaching{suffix}.jsonl").items():
            yield "GelSlim", f"{grade} texture, hours", patches, [one["probes"] for one in several], "stage 2"
    for suffix, patches in PATCHES.items():
        several = [*records_of(folder / f"named{suffix}.jsonl").values()]
        yield "DuraGel", "minutes", patches, [one["probes"] for one in several], "AnyTouch"


CONVOLUTIONAL = "convolutional, with labels"


def named(folder: Path) -> Page:
    """Training with the labels themselves."""
    rows, findings = [], []
    for suffix, patches in PATCHES.items():
        runs = [*records_of(folder / f"named{suffix}.jsonl").values()]
        for label in (*NAMED, UNNAMED):
            ways = {f"our encoder, {patches} patches": [run["scores"][label] for run in runs]}
            if not suffix:
                ways["a convolutional network"] = [run[CONVOLUTIONAL]["scores"][label] for run in runs]
            for name, scores in ways.items():
                part = {part: over_seeds([one[part] for one in scores]).times(100) for part in ("train", "test")}
                common = [one["commonest"] for one in ways[next(iter(ways))]]
                ahead = over_seeds([a["test"] - b for a, b in zip(scores, common, strict=True)]).times(100)
                rows.append((label, name, part["train"], part["test"], ahead))
                findings += [compare(name, "the commonest answer", ahead, label)] if not suffix else []
    return Page(
        "named", "Can a network learn what captions name?",
        "Networks are trained with the labels themselves, on contact frames of four sensors. They are "
        "tested on objects "
        "never touched in training. Captions name hardness, roughness and material. They do not name the indenter. "
        "Intervals are over seeds.",
        ("label", "network", Measure("frames of training, %"), Measure("objects never touched, %"),
         Measure("minus the commonest answer", "+.1f")),
        sorted(rows, key=lambda row: (*NAMED, UNNAMED).index(row[0])), findings,
        ("named.jsonl", "named_convolutional.jsonl"), "python -m experiments.tables.caption_probes",
    )  # fmt: skip


def long_clips(folder: Path) -> Page:
    """Longer clips: cost and gain."""
    records = records_of(folder / "long_clips.jsonl")
    lengths = [("1", "mean"), ("3", "mean"), *((n, join) for n in ("5", "7") for join in ("mean", "sum", "concat"))]
    if lost := [key for key in ("time", *("-".join(one) for one in lengths)) if key not in records]:
        raise UserError(f"{folder / 'long_clips.jsonl'} has no record {lost[0]}. Run `make long-clips`.")
    rows = []
    for (frames, join), ms in zip(lengths, records["time"]["ms"], strict=True):
        tasks = records[f"{frames}-{join}"]["tasks"]
        values = [Value(one["mean"], one["low"], one["high"]).times(100) for one in tasks.values()]
        rows.append((f"{frames} frame{'s' * (frames != '1')}", join if int(frames) > 3 else "", ms, *values))
    first, last = rows[1], rows[-3]
    findings = [f"Seven frames take {last[2] / first[2]:.1f} times as long as three."]
    for number, task in enumerate(records["3-mean"]["tasks"], 3):
        inside = all(row[number].low <= first[number].mean <= row[number].high for row in rows[2:])
        findings.append(
            f"{task}: {'no longer clip leaves' if inside else 'a longer clip leaves'} the interval of three frames."
        )
    return Page(
        "long_clips", "Do longer clips show more?",
        "A clip of more than three frames is embedded in segments of three. Their features are averaged, summed or "
        "joined. Linear probes read the same moments at every length, on objects never touched in training. Intervals "
        "are over objects. Force is an R2 in percent, the others are accuracies. One encoder was scored.",
        ("clip", "segments", Measure("ms", ".2f", False),
         *(Measure(f"{task}, %") for task in records["3-mean"]["tasks"])),
        rows, findings, ("long_clips.jsonl",), "make long-clips",
    )  # fmt: skip


def pouring(folder: Path) -> Page:
    """Pouring by touch alone."""
    rows, findings, files = [], [], []
    for name, demonstrations in (("pouring_200", 200), ("pouring", 1000)):
        path = folder / f"{name}.jsonl"
        records_of(path)
        files.append(path.name)
        found = {(row.name, row.mode): row for row in pours.read_rows(path)}
        blind = found.get(("blind", "bound"))
        order = [(one, mode) for one in pours.TITLES for mode in (*pours.MODES, "bound") if (one, mode) in found]
        for one, mode in order:
            row, change = found[one, mode], None
            if blind is not None and one in pours.PAPER:
                change = _grams(pours.difference(row, blind))
            number = pours.MODES.index(mode) if mode in pours.MODES else None
            theirs = pours.PAPER[one][number] if one in pours.PAPER and number is not None else None
            shown = mode if mode in pours.MODES else ""
            value = Value(row.error.mean, row.error.low, row.error.high)
            rows.append((f"{demonstrations} demonstrations", pours.TITLES[one], shown, value, change, theirs))
        for mode in pours.MODES:
            for other in ("none", "t3", "static", "blind"):
                a, b = found.get(("anytouch", mode)), found.get((other, "bound" if other == "blind" else mode))
                change = None if a is None or b is None else _grams(pours.difference(a, b))
                what = f"error, {demonstrations} demonstrations, {mode}"
                findings.append(compare("AnyTouch", pours.TITLES[other], change, what, " g"))
    return Page(
        "pouring", "Can a policy pour by touch alone?",
        "A simulated robot pours beads until 60 g have left the cylinder. It feels the gel and sees no "
        "scales. The value "
        "is the mean error. Policies learn from demonstrations, over a frozen encoder or with it. Intervals are over "
        "seeds of learning. The paper's numbers are of a robot, so compare the order alone.",
        ("data", "policy", "encoder", Measure("error, g"), Measure("minus blind", "+.1f"),
         Measure("the paper", ".2f", False)),
        rows, findings, files, "make pouring",
    )  # fmt: skip


def _grams(change: pours.Difference) -> Value:
    return Value(change.mean, change.low, change.high, len(change.each))


def translation(folder: Path) -> Page:
    """One sensor's touch as another would feel it."""
    rows, findings, files = [], [], []
    for name, steps in (("translation", 400), ("translation_3000", 3000)):
        path = folder / f"{name}.jsonl"
        records_of(path)
        files.append(path.name)
        runs = [*runs_of(path).values()]
        one_table([one["settings"] for one in runs], path)
        errors: dict[tuple[str, str], dict[str, dict[int, float]]] = {}
        for one in runs:
            about = one["settings"]
            tune = "scratch" if about["name"] == PIXELS else about["fit"]["tune"]
            row = errors.setdefault((about["name"], tune), {})
            row.setdefault(f"{about['from']}-{about['to']}", {})[about["fit"]["seed"]] = one["error"]
        for (encoder, tune), by_task in errors.items():
            values = [over_seeds([*by_task[task].values()]) if task in by_task else None for task in TRANSLATIONS]
            rows.append((f"{steps} steps", _TRANSLATORS.get(encoder, encoder), _TUNES[tune], *values))
        for (encoder, tune), by_task in errors.items():
            other = errors.get(("t3", tune), {})
            for task, words in TRANSLATIONS.items() if encoder in OURS[:1] else ():
                shared = sorted(by_task.get(task, {}).keys() & other.get(task, {}).keys())
                change = over_seeds([by_task[task][seed] - other[task][seed] for seed in shared]) if shared else None
                what = f"error, {words}, {_TUNES[tune]}, {steps} steps"
                findings.append(compare("AnyTouch", "T3-style", change, what, "", ".4f"))
    return Page(
        "translation", "Can one sensor's touch be turned into another's?",
        "A generator turns the picture of one sensor into the picture or the force field of another. It reads the "
        "features of an encoder. The pairs are simulated, and the test objects are new. The value is the mean squared "
        "error, in units of the training deviation. Intervals are over seeds. Steps are those of stage 1.",
        ("stage 1", "encoder", "use", *(Measure(words, ".4f") for words in TRANSLATIONS.values())),
        rows, findings, files, "make translation",
    )  # fmt: skip


_TRANSLATORS = {
    "anytouch": "AnyTouch", "anytouch_between": "AnyTouch, half-way to stage 2", "stage1": "AnyTouch, stage 1",
    "anytouch_layer_decay": "AnyTouch, layer decay", "t3": "T3-style", PIXELS: "pixels, no encoder",
}  # fmt: skip
_TUNES = {"frozen": "frozen", "fine": "fine-tuned", "scratch": "from scratch"}


def real(folder: Path) -> Page:
    """Encoders on real recordings."""
    path = folder / "real.jsonl"
    records = records_of(path)
    if len({record["data"] for record in records.values()}) > 1:
        raise UserError(f"The records of {path} are of different data. Run all of them again.")
    rows, findings = [], []
    encoders = [
        name for name in records if records[name].get("kind") == "encoder" and not name.startswith("untrained:")
    ]
    for task in TASKS:
        for head in (*HEADS, TRAINED):
            key = f"{task}, {head}"
            scores = {name: _score(one["tasks"][key]) for name, one in records.items() if key in one["tasks"]}
            for name, score in sorted(scores.items(), key=lambda item: -item[1].share):
                twins = sorted((other for other in scores if other.startswith("untrained:")), key=len)
                fresh = f"untrained:{name}" if f"untrained:{name}" in twins else next(iter(twins), "")
                changes = [_minus(score, scores.get(other)) if other != name else None for other in ("pixels", fresh)]
                rows.append((task, head, name, Value(score.share, *score.interval()).times(100), *changes))
                if name in encoders and head in HEADS:
                    findings += [
                        compare(f"`{name}`", words, change, f"{task}, {head} head")
                        for words, change in zip(("pixels", "an untrained encoder"), changes, strict=True)
                    ]
                if name.startswith(f"{DEFAULT}-") and head in HEADS:
                    change = _minus(score, scores.get(DEFAULT))
                    findings.append(compare(f"`{name}`", f"`{DEFAULT}`", change, f"{task}, {head} head"))
    for count in ("1", "2", "5"):
        shares = {name: one["label_curve"][count] for name, one in records.items() if "label_curve" in one}
        rows += [
            (f"object, {count} recordings of each", "linear", name, Value(share).times(100), None, None)
            for name, share in sorted(shares.items(), key=lambda item: -item[1])
        ]
    times = [
        f"`{name}` takes {records[name]['milliseconds']:.0f} ms a frame on a CPU."
        for name in encoders
        if "milliseconds" in records[name]
    ]
    return Page(
        "real", "What is an encoder worth on real recordings?",
        "Heads are trained on recordings of 39 real objects by a GelSight Mini. A recording gets the mean score of its "
        "frames. The penalty and the number of neighbours are chosen on validation recordings. Intervals are over "
        "recordings, and differences are paired. One task tests the finger whose camera the head never met. The slip "
        "task leaves objects out.",
        ("task", "head", "features", Measure("right, %"), Measure("minus pixels", "+.1f"),
         Measure("minus untrained", "+.1f")),
        rows, [*findings, *times], (path.name,),
        "python -m experiments.real.run anytouch-tiny untrained:anytouch-tiny anytouch-tiny-conv "
        "untrained:anytouch-tiny-conv",
    )  # fmt: skip


def backgrounds(folder: Path) -> Page:
    """An encoder on real recordings, by what is subtracted."""
    path = folder / "backgrounds.jsonl"
    records, rows, findings = records_of(path), [], []
    words = {
        "own": "the unit's own picture",
        "rule": "the rule: its own picture, else the median of 100 frames",
        "median": "the median of 100 training frames of the unit",
        "all": "the median of all training frames of the unit",
        "ten": "the median of 10 training frames of the unit",
        "half": "the median of the 50 flattest of 100 frames",
        "recordings": "the median of the medians of its recordings",
        "estimated": "an estimate by `anytouch data contact`",
        "first": "the first frame of the recording",
        "pixels": "raw pixels, with the median of 100 frames",
    }
    for task in TASKS:
        for head in HEADS:
            scores = {kind: _score(records[kind]["tasks"][f"{task}, {head}"]) for kind in words if kind in records}
            for kind, score in scores.items():
                change = None if kind == "own" else _minus(score, scores["own"])
                rows.append((task, head, words[kind], Value(score.share, *score.interval()).times(100), change))
                if change is not None and head == "linear" and kind in ("rule", "median", "first"):
                    findings.append(compare(words[kind], "the unit's own picture", change, task))
            if head == "linear" and "pixels" in scores:
                change = _minus(scores["median"], scores["pixels"])
                findings.append(compare("the encoder, with the median of 100 frames,", "raw pixels", change, task))
    return Page(
        "backgrounds", "What if there is no picture of the untouched gel?",
        f"The features are those of `{next(iter(records.values()))['encoder']}`, which subtracts the untouched gel. "
        "The recordings begin in contact or near it, so the first frame is a hard case. "
        "It was the rule before, and it stands in where a unit has no picture, or no estimate is sure. "
        "Scores are as on the page of real recordings.",
        ("task", "head", "subtracted", Measure("right, %"), Measure("minus own picture", "+.1f")),
        rows, findings, (path.name,), "python -m experiments.real.run anytouch-tiny --backgrounds",
    )  # fmt: skip


def untouched_gel(folder: Path) -> Page:
    """Contact in recordings without a picture of the untouched gel."""
    path = folder / GELS
    rows: list[Any] = []
    findings, every = [], list[Mapping[str, int]]()
    for sensor, record in records_of(path).items():
        least: dict[str, list[float]] = {way: [100.0, 100.0] for way in WAYS}
        for share, ways in record["pressed"].items():
            for way, one in ways.items():
                low, high = binomtest(one["decided"], one["films"]).proportion_ci(method="wilson")
                decided = Value(one["decided"] / one["films"], low, high).times(100)
                right = 100 * one["right"] / one["frames"] if one["frames"] else 100.0
                rows.append((sensor, f"{share} % pressed", way, decided, right, one["inverted"]))
                least[way] = [min(*both) for both in zip(least[way], (decided.mean, right), strict=True)]
                every.append(one)
        alone, picture = least.values()
        findings.append(
            f"`{sensor}`: at least {alone[0]:.0f} % of recordings are decided alone. At least {alone[1]:.0f} % of "
            f"their frames are right, and {picture[1]:.0f} % of all frames {WAYS[1]}."
        )
    findings.append(
        f"{sum(one['inverted'] for one in every)} of {sum(one['decided'] for one in every):,} are inverted."
    )
    return Page(
        "untouched_gel", "Is contact found without a picture of the untouched gel?",
        "`anytouch data contact` estimates the untouched gel from the frames of a recording, or leaves the label "
        "empty. Recordings are films of simulated frames, pressed for some share of the time. Their short side is 120 "
        "or 240 pixels. Light and noise change from frame to frame. A press is deeper than 0.08 mm, so some are too "
        "light to see. Each film is "
        f"decided {WAYS[0]} or {WAYS[1]}.",
        ("sensor", "recordings", "decided", Measure("decided, %", ".0f"), Measure("frames right, %", ".1f", False),
         Measure("inverted", ".0f", False)),
        rows, findings, (GELS,), "python -m experiments.benchmarks.untouched_gel MANIFEST",
        "The share of recordings that are decided, with its interval.",
    )  # fmt: skip


def motion(folder: Path) -> Page:
    """The sign of a turn and the direction of a slide, from frozen tokens."""
    path = folder / "motion.jsonl"
    rows, findings = [], []
    for name, record in records_of(path).items():
        for row, found in record["scores"].items():
            values = [Value(one["share"], *one["interval"]).times(100) for one in (found["turn"], found["slide"])]
            rows.append((name, row, *values))
        every = record["scores"]["all sensors"]
        findings += [
            f"`{name}`: the head names {100 * every['turn']['share']:.0f} % of turns and "
            f"{100 * every['slide']['share']:.0f} % of slides of new objects.",
            f"`{name}`: a linear probe on the change of the mean token names {100 * record['pooled']:.0f} % of turns.",
        ]
    return Page(
        "motion", "Do frozen features show which way an object turns?",
        "A small antisymmetric head reads the patch tokens of the first and the last touched frame of a clip. "
        "Clips are simulated. Test clips are of objects that the head never met. "
        "In the rows `without` a sensor, the head never met that "
        "sensor either. Chance is half for a turn and a quarter for a slide. Intervals are over touches.",
        ("encoder", "head", Measure("turns right, %"), Measure("slides right, %")),
        rows, findings, (path.name,),
        "python -m experiments.encoders.motion anytouch-tiny --data data/corpus/00000/*.parquet "
        "data/corpus/00850/*.parquet",
    )  # fmt: skip


def lookalikes(folder: Path) -> Page:
    """The same touch by another sensor, among 50 that resemble it."""
    path = folder / "lookalikes.jsonl"
    rows, findings = [], []
    for key, record in sorted(records_of(path).items(), reverse=True):
        scores, sensor = record["scores"], record.get("left_out")
        grade = key.partition(" ")[0] + " alignment" + (f", queries by {sensor}, left out of stage 2" if sensor else "")
        for name, one in sorted(scores.items(), key=lambda item: -item[1]["share"]):
            rows.append((grade, name, Value(one["share"], *one["interval"]).times(100)))
        findings += [
            f"{grade}: `{name}` names {100 * scores[name]['share']:.0f} % of the touches, pixels "
            f"{100 * scores['pixels']['share']:.0f} %."
            for name in record["encoders"]
        ]
    return Page(
        "lookalikes", "Do the encoders in the package find the same touch by another sensor?",
        "Touches are simulated, of objects that training left out, by the six sensors of training. The right answer "
        "stands among 50 touches that resemble it most in place, depth and force. With fine alignment all sensors "
        "touch in the same way. With coarse alignment each touches as by hand. Intervals are over objects. The row "
        "`held_out` is another encoder, with convolutional patches.",
        ("touches", "features", Measure("recall@1, %")), rows, findings, (path.name,),
        "python -m experiments.encoders.lookalikes anytouch-tiny anytouch-tiny-conv untrained:anytouch-tiny "
        "--fine data/corpus/00000 --coarse data/corpus/01700",
    )  # fmt: skip


def _score(task: Record) -> Score:
    return Score(np.array(task["correct"], bool), np.array(task["groups"]), task["option"])


def _minus(score: Score, other: Score | None) -> Value | None:
    return None if other is None else Value(*score.minus(other)).times(100)


def by_contact(folder: Path) -> Page:
    """Stage 1 with masks and losses by contact: steps to the error and the recall of the paper's way."""
    records = [*records_of(folder / CONTACTS).values()]
    best = 0.0
    plain = {one["seed"]: np.array(one["curve"]) for one in records if one["way"] == FIRST}
    rows, findings = [], []
    for way in dict.fromkeys(one["way"] for one in records):
        curves = {one["seed"]: np.array(one["curve"]) for one in records if one["way"] == way}
        ends = [over_seeds([curve[-1, column] for curve in curves.values()]) for column in (1, 2, 3)]
        gains = {
            what: [_fewer_steps(curve[:, column] * sign, plain[seed][:, column] * sign) for seed, curve in
                   curves.items()]
            for what, column, sign in (("error", 1, 1), ("error of contact", 2, 1), ("recall@1", 3, -1))
        }  # fmt: skip
        rows.append(
            (
                way,
                *(end.times(factor) for end, factor in zip(ends, (1000, 1000, 100), strict=True)),
                *(float(np.mean(gain)) for gain in gains.values()),
            )
        )
        if way != FIRST:
            findings += [
                f"{way}: the same {what} is reached {np.mean(gain):.2f} times as fast." if min(gain) > 0 else
                f"{way}: the same {what} is not reached with every seed." for what, gain in gains.items()
            ]  # fmt: skip
            best = max(best, *(float(np.mean(gain)) for gain in gains.values()))
    if best < PAYS:
        findings.append(f"no way is {PAYS} times as fast, so none is an option of the package.")
    one = records[0]
    return Page(
        "by_contact",
        "Does stage 1 learn faster where something touches?",
        f"A small encoder learns {one['touches'][0]:,} stills of 56 pixels for {one['steps']:,} steps. The "
        f"untouched gel is subtracted. It is judged on {one['touches'][1]:,} touches of other objects, with masks by "
        "chance. The error is that of all hidden patches, and of hidden patches with contact. Recall@1 is the share of "
        "touches whose lighter frame finds its deepest frame among all by the same sensor. A gain is the number of "
        "steps after which the paper's way is at its best, divided by the steps until this way is as good. It is 0 "
        "for a seed that never is. From and to are over three seeds.",
        ("way", Measure("1000 x error", ".1f"), Measure("1000 x error of contact", ".1f"),
         Measure("recall@1, %", ".1f"),
         *(Measure(f"gain, {what}", ".2f", False) for what in ("error", "error of contact", "recall@1"))),
        rows, findings, (CONTACTS,), "python -m experiments.encoders.by_contact MANIFEST",
    )  # fmt: skip


def _fewer_steps(values: np.ndarray, base: np.ndarray) -> float:
    """Return the factor by which a falling curve reaches the best of another with fewer steps, 0 if it never does."""
    reached = np.flatnonzero(values <= base.min())
    return float(base.argmin() + 1) / (reached[0] + 1) if len(reached) else 0.0
