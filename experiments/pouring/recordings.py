"""Recordings of pouring, of a robot or of the simulation, as demonstrations; and policies on disk.

The form: a manifest whose sequences are runs, one row a moment of choice (five a second),
`label.action` pour, wait or retract. In the first STAND moments of a run the fingers hold the
cylinder while it still stands; then it is lifted. A column `label.choice` says what should have
been done where that differs (a hand that was late). Nothing is learned from split test.
"""

from __future__ import annotations

import io
import json
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.config import parse_json
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest, group_rows
from anytouch_jax.data.transforms import touch_evaluation
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, read_arrays
from experiments.pouring.bounds import blind_inputs, imitate_plainly
from experiments.pouring.physics import ACTIONS, STAND, Task
from experiments.pouring.policy import Head, Learning, Touch, forward
from experiments.pouring.trials import SENSOR, START, Controller, Trials

POLICY = "policy.npz"

Array = npt.NDArray[Any]
LEARNING = ("train", "val", "test")  # splits that are read; the others take no part
WEIGHTS = "encoder.safetensors"


class Recordings(NamedTuple):
    """Runs as trials of B (masses are unknown: NaN), those of the test split last: `test` (B,);
    their sensor, and the content hash of their manifest (`data`).
    """

    trials: Trials
    test: Array
    sensor: str
    data: str

    def part(self, test: bool) -> Trials:
        """The runs of test, or those to learn from; no copy."""
        first = len(self.test) - int(self.test.sum())
        keep = slice(first, None) if test else slice(first)
        over_time = {name: getattr(self.trials, name) for name in Trials._fields[2:]}
        cut: dict[str, Any] = {
            name: None if x is None else x[:, keep] for name, x in over_time.items()
        }
        return Trials(self.trials.poured[keep], self.trials.steps[keep], **cut)


def write(folder: Path, trials: Trials, task: Task, *, held_out: float = 0.25) -> Path:
    """Write trials with frames as PNG files and `manifest.parquet`, the last `held_out` of the runs
    as split test.

    Masses stand in `label.mass` (g), which no policy reads. Gives back the manifest's path. Raises
    UserError.
    """
    import cv2

    if trials.frames is None:
        raise UserError("these demonstrations have no frames; record them with an image size")
    rows: list[dict[str, Any]] = []
    if len(trials.steps) < 2:
        raise UserError("one run is too few: of two or more, some are kept for the test")
    first_test = len(trials.steps) - max(1, round(held_out * len(trials.steps)))
    for run, steps in enumerate(trials.steps):
        for moment in range(int(steps)):
            name = f"run_{run:04d}/{moment:04d}.png"
            png = cv2.imencode(".png", np.ascontiguousarray(trials.frames[moment, run][..., ::-1]))[
                1
            ]
            atomic_write(folder / name, png.tobytes(), sync=False)
            action, choice = (
                ACTIONS[int(one[moment, run])] for one in (trials.actions, trials.choices)
            )
            rows.append(
                {
                    "path": name,
                    "sensor": SENSOR,
                    "sequence": f"run_{run:04d}",
                    "frame_index": moment,
                    "split": "test" if run >= first_test else "train",
                    "label.action": action,
                    "label.choice": choice,
                    "label.mass": float(trials.mass[moment, run]),
                    "dataset": f"pouring {task.target:g} g",
                }
            )
    path = folder / "manifest.parquet"
    manifests.write(
        manifests.from_columns({name: [row[name] for row in rows] for name in rows[0]}, path), path
    )
    return path


def read(path: Path, side: int) -> Recordings:
    """The runs of a manifest, frames resized to `side` pixels.

    Raises UserError: no labels, gaps, too short a run.
    """
    table = manifests.read(path)
    split = table.text_column("split")
    part = np.isin(split, LEARNING)
    if not table.present("label.action")[part].all():
        raise UserError(
            f"{path}: label.action must be {', '.join(ACTIONS)} on every row of "
            f"{', '.join(LEARNING)}"
        )
    sensors = np.unique(table.text_column("sensor")[part])
    if len(sensors) > 1:
        raise UserError(f"{path}: one sensor a policy, not {', '.join(sensors)}")
    runs = sorted(_runs(table, path), key=lambda rows: split[rows[0]] == "test")
    test = np.array([split[rows[0]] == "test" for rows in runs])
    if not test.any() or test.all():
        raise UserError(
            f"{path}: runs to learn from and runs of split test are needed; it has {len(runs)} runs"
        )
    steps = np.array([len(rows) for rows in runs])
    padded = [
        np.concatenate([rows, np.repeat(rows[-1:], steps.max() - len(rows))]) for rows in runs
    ]
    order = np.stack(padded, 1)  # (S, B) row numbers
    actions = _numbers(table, "label.action")
    choices = actions
    if "label.choice" in table.table.column_names:
        choices = np.where(table.present("label.choice"), _numbers(table, "label.choice"), actions)
    # a run that has ended repeats its last one
    frame = lru_cache(len(runs))(partial(_frame, table, side))
    frames = np.stack([np.stack([frame(int(row)) for row in rows]) for rows in order])
    unknown = np.full(order.shape, np.nan)
    trials = Trials(
        unknown[-1], steps, choices[order], actions[order], unknown, unknown, unknown, frames
    )
    return Recordings(trials, test, str(sensors[0]), table.content_hash)


def _runs(table: Manifest, path: Path) -> list[Array]:
    """The rows of each run in time.

    Raises UserError for runs that are of two splits or have gaps, and short ones.
    """
    split = table.text_column("split")
    sequence = table.text_column("sequence")
    number = table.number_column("frame_index")
    rows = np.flatnonzero(np.isin(split, LEARNING))
    if not len(rows):
        raise UserError(f"{path}: no row is of split {', '.join(LEARNING)}")
    runs = group_rows(rows, sequence[rows], number[rows])
    for run in runs:
        name = f"{path}: run {sequence[run[0]]}"
        sides = np.unique(split[run])
        if len(sides) > 1:
            raise UserError(f"{name} is in the splits {' and '.join(sides)}; a run is of one")
        stride = np.array([table.value(int(row), "stride") or 1 for row in run[1:]])
        if len(gaps := np.flatnonzero(np.diff(number[run]) != stride)):
            first, second = number[run][gaps[0] : gaps[0] + 2]
            raise UserError(f"{name}: frame {first:g} is followed by {second:g}, a gap or a repeat")
        if len(run) <= START:
            raise UserError(
                f"{name} has {len(run)} frames; {STAND} standing ones, and more than {START} in all"
            )
    return runs


def _numbers(table: Manifest, column: str) -> Array:
    names = np.where(table.present(column), table.text_column(column), ACTIONS[0])
    unknown = sorted(set(names) - set(ACTIONS))
    if unknown:
        raise UserError(f"{column} {str(unknown[0])!r} is no action; use {', '.join(ACTIONS)}")
    return np.array([ACTIONS.index(name) for name in names], np.int32)


def _frame(table: Manifest, side: int, row: int) -> Array:
    return touch_evaluation([decode(table.file(row))], side)[0]


class Agreement(NamedTuple):
    """How a policy follows the hand on runs that it did not learn: the fraction of moments with the
    same action (mean of runs), the mean share over the three actions, and |moment of turning back -
    the hand's| in s (median of runs).
    """

    fraction: float
    balanced: float
    turn: float


def agreement(policy: Controller, trials: Trials, rate: float) -> Agreement:
    """Show the frames of recorded runs to a policy, as the hand's actions led to them; `rate`
    moments a second.
    """
    assert trials.frames is not None
    policy.begin(len(trials.steps))
    predicted = np.stack([policy.act(frames, None) for frames in trials.frames])  # type: ignore[arg-type]
    return compare(predicted, trials, rate)


def agreement_blind(shown: Trials, unseen: Trials, learning: Learning, rate: float) -> Agreement:
    """The agreement of the same MLP that gets the time and the hand's actions so far, not the
    touch.
    """
    head = imitate_plainly(shown, blind_inputs(shown.actions)[START:], learning)
    predicted = [np.asarray(forward(head, x)).argmax(-1) for x in blind_inputs(unseen.actions)]
    return compare(np.stack(predicted), unseen, rate)


def compare(predicted: Array, trials: Trials, rate: float) -> Agreement:
    """The agreement of actions `predicted` (S, B) with those that the hand chose."""
    taken = trials.taken.copy()
    taken[:START] = False
    same = (predicted == trials.choices) & taken
    by_action = [
        same[chosen].mean()
        for a in range(len(ACTIONS))
        if (chosen := taken & (trials.choices == a)).any()
    ]
    back = ACTIONS.index("retract")
    moment = np.arange(len(predicted))[:, None]
    turns = [
        np.where((one == back) & taken, moment, trials.steps).min(0)
        for one in (predicted, trials.choices)
    ]
    late = np.abs(turns[0] - turns[1]) / rate
    return Agreement(
        float((same.sum(0) / taken.sum(0)).mean()),
        float(np.mean(by_action)),
        float(np.median(late)),
    )


def save_policy(folder: Path, policy: Touch) -> None:
    """Write the MLP to `policy.npz` and the encoder next to it, each in one move.

    Raises UserError.
    """
    from anytouch_jax.config import to_json
    from anytouch_jax.weights import safetensors

    folder.mkdir(parents=True, exist_ok=True)
    encoder = policy.encoder
    head = policy.head
    about = {
        safetensors.MODEL_KEY: to_json(encoder.config.model),
        safetensors.BACKGROUND_KEY: encoder.config.data.background,
    }
    if encoder.trained_sensors is not None:
        about[safetensors.SEEN_KEY] = ",".join(encoder.trained_sensors)
    safetensors.export_safetensors(folder / WEIGHTS, encoder.params, about)
    layers = {f"w/{i}": np.asarray(weight) for i, (weight, _) in enumerate(head.layers)}
    layers |= {f"b/{i}": np.asarray(bias) for i, (_, bias) in enumerate(head.layers)}
    metadata = {
        "stills": policy.stills,
        "pooling": policy.pooling,
        "sensor": policy.sensor,
        "votes": policy.votes,
    }
    data = io.BytesIO()
    arrays: dict[str, Any] = {
        "mean": np.asarray(head.mean),
        "basis": np.asarray(head.basis),
        **layers,
    }
    np.savez(
        data, about=np.asarray(json.dumps(metadata | {"encoder": encoder.fingerprint})), **arrays
    )
    atomic_write(folder / POLICY, data.getvalue())


def load_policy(folder: Path | str) -> Touch:
    """The policy that `save_policy` wrote.

    `begin(1)`, then `act(frame[None])` at every moment: 0 pour, 1 wait, 2 retract
    (`sim.pouring.ACTIONS`). Raises UserError when files are missing or do not belong together.
    """
    folder = Path(folder)
    encoder = load_encoder(folder / WEIGHTS)
    try:
        arrays = read_arrays(folder / POLICY)
        metadata = dict(parse_json(str(arrays["about"])))
        stills = bool(metadata["stills"])
        sensor = str(metadata["sensor"])
        mark = metadata["encoder"]
        # of earlier policies
        pooling = metadata.get("pooling", "class")
        votes = int(metadata.get("votes", 1))
        count = sum(name.startswith("w/") for name in arrays)
        layers = tuple((arrays[f"w/{i}"], arrays[f"b/{i}"]) for i in range(count))
        head = Head(arrays["mean"], arrays["basis"], layers)
        numbers = {name: array for name, array in arrays.items() if name != "about"}
        if wrong := [
            name for name, x in numbers.items() if x.dtype.kind != "f" or not np.isfinite(x).all()
        ]:
            raise ValueError(f"{wrong[0]} has values that are not finite numbers")
        _check_head(head)
        if pooling not in ("class", "mean", "both") or not 0 < votes < 1 << 20:
            raise ValueError(f"it has pooling {str(pooling)[:40]} and {votes} votes")
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise UserError(f"{folder / POLICY} is no pouring policy ({error})") from None
    if mark != encoder.fingerprint:
        raise UserError(
            f"{folder / POLICY} was learned over another encoder than {folder / WEIGHTS}. Learn "
            "the policy again."
        )
    return Touch(encoder, head, stills=stills, pooling=pooling, sensor=sensor, votes=votes)


def _check_head(head: Head) -> None:
    """Raise ValueError for arrays of an MLP that do not fit together."""
    width = head.mean.shape
    for weight, bias in ((head.basis, None), *head.layers):
        if (
            weight.ndim != 2
            or weight.shape[:1] != width
            or (bias is not None and bias.shape != weight.shape[1:])
        ):
            raise ValueError(f"a layer of shape {weight.shape} does not fit the one before")
        width = weight.shape[1:]
    if not head.layers or width != (len(ACTIONS),):
        raise ValueError(f"it needs a layer with {len(ACTIONS)} actions")
