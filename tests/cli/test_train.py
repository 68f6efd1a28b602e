import contextlib
import json
import os
import pkgutil
import pty
import re
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import jax
import pytest
from places import ROOT
from runs import SIZES, read_metrics, run_config, saved_steps, train
from toy_process import finish, free_address, spawn

from anytouch_jax.cli import train as command
from anytouch_jax.cli.app import main
from anytouch_jax.cli.output import log
from anytouch_jax.config import preset
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.progress import Record, progress


def options_of(sizes: dict[str, object]) -> list[str]:
    return [str(word) for name, value in sizes.items() for word in (f"--{name}", value)]


SMALL = options_of(SIZES)
# The sizes of `tiny_run`.
TINY_RUN = options_of(
    {name: value for name, value in SIZES.items() if "clip-fraction" not in name}
    | {"model.touch.depth": 2}
)


def parse(*words: object) -> command.TrainRequest:
    return command.parse(
        command.TrainOptions, "train", ["--data", "m.csv", "--run", "r", *map(str, words)]
    )


def test_sections_come_after_the_preset_the_recipe_and_the_short_options():
    words = ("--recipe", "release", "--steps", 40, "--batch", 8, "--seed", 3, "--preset", "small")
    config = parse(
        *words, "--objective.mask-ratio", 0.5, "--data.threads=1", "--model.touch.heads", 3
    ).config
    usual = preset("small", stage=1, recipe="release")
    assert (
        config.objective.mask_ratio == 0.5
        and config.optim == usual.optim
        and config.recipe == "release"
    )
    assert (
        config.data.manifests == ("m.csv",)
        and config.data.threads == 1
        and config.data.batch_size == 8
    )
    assert (config.run.steps, config.run.seed) == (40, 3)
    assert config.model.touch == replace(usual.model.touch, heads=3)
    assert parse("--data.batch-size", 5, "--batch", 8).config.data.batch_size == 5


def test_help_all_lists_and_explains_every_field_with_the_defaults_of_the_preset(anytouch):
    done = anytouch("train", "--help-all", "--preset", "small")
    assert done.status == 0 and "(default: 384)" in done.out
    lines = [line.strip("│ ") for line in done.out.splitlines()]
    fields = [place for place, line in enumerate(lines) if line.startswith("--")]
    assert len(fields) > 60 and not [
        lines[place] for place in fields if lines[place + 1].startswith("(default")
    ]
    for option in (
        "--model.touch.width",
        "--objective.mask-ratio",
        "--optim.learning-rate",
        "--data.threads",
    ):
        assert option in done.out


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("--steps", 0), "--steps"),
        (("--model.patch", 13), "patch"),
        (("--model.decoder.width", 18, "--model.decoder.heads", 2), "--model.decoder.width"),
        (("--stage", 2, "--towers", "pretrained"), "--clip-weights"),
        (("--stage", 1, "--towers", "pretrained"), "--clip-weights"),
        (("--stage", 2, "--clip-weights", "c"), "--towers"),
        (("--init", "gone"), "gone"),
    ],
)
def test_a_wrong_value_is_named_and_starts_no_run(words, option, anytouch, tmp_path, world):
    done = anytouch("train", "--data", world, "--run", tmp_path / "r", *words)
    assert done.status == 2 and option in " ".join(done.err.replace("│", " ").split())
    assert "Traceback" not in done.err and not (tmp_path / "r").exists()


def test_a_missing_manifest_is_one_sentence(mistake, tmp_path):
    missing = tmp_path / "none.csv"
    assert str(missing) in mistake("train", "--data", missing, "--run", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_corrupt_image_is_named_and_may_be_skipped_and_counted(
    anytouch, mistake, tmp_path, world
):
    manifest = shutil.copytree(world.parent, tmp_path / "world") / world.name
    (manifest.parent / "a1.png").write_bytes(b"not a picture")
    words = ("train", "--data", manifest, "--batch", 8, "--steps", 4, "--save-every", 4, *SMALL)
    sentence = mistake(*words, "--run", tmp_path / "strict", "--stop-after", 1)
    assert "a1.png" in sentence and "line 3 of" in sentence
    done = anytouch(*words, "--run", tmp_path / "r", "--on-bad-sample", "skip", "--stop-after", 1)
    assert done.status == 0 and "a1.png" in done.err and "another sample replaces it" in done.err
    line = json.loads((tmp_path / "r" / "metrics.jsonl").read_text())
    assert (
        line["skipped"] == line["skipped_batches"] == 0
        and line["skipped_samples"] >= 1
        and line["loss"] > 0
    )


def test_a_run_folder_that_is_taken_is_one_sentence(mistake, tiny_run, world, tmp_path):
    (tmp_path / "afile").write_text("")
    assert "afile" in mistake("train", "--data", world, "--run", tmp_path / "afile")
    assert "--run" in mistake("train", "--stage", 2, "--data", world, "--run", tiny_run)


def test_a_run_continues_and_refuses_other_settings(anytouch, mistake, tmp_path, world, tiny_run):
    shutil.copytree(tiny_run, tmp_path / "r")
    words = [
        "train",
        "--data",
        world,
        "--run",
        tmp_path / "r",
        "--steps",
        4,
        "--save-every",
        4,
        "--batch",
        8,
        *TINY_RUN,
    ]
    assert "run.steps" in mistake(*words, "--steps", 5)
    done = anytouch(*words, "--stop-after", 3)
    assert done.status == 0 and "step 2" in done.err and "3 of 4 steps" in done.err


@pytest.mark.parametrize(
    "place",
    [
        "anytouch_jax.data.manifest.manifest.read",
        "anytouch_jax.weights.checkpoint.Checkpoints.latest",
    ],
)
def test_a_termination_before_the_first_step_is_polite(
    anytouch, tmp_path, world, monkeypatch, place
):
    module, _, name = place.rpartition(".")
    owner = pkgutil.resolve_name(module)
    before = signal.getsignal(signal.SIGTERM)
    real = getattr(owner, name)

    def terminated(*args, **options):
        signal.raise_signal(signal.SIGTERM)
        return real(*args, **options)

    words = ["train", "--data", world, "--run", tmp_path / "r", "--steps", 4, "--batch", 8, *SMALL]
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, terminated)
        done = anytouch(*words)
    assert (
        done.status == 0 and "SIGTERM" in done.err.splitlines()[-1] and "Traceback" not in done.err
    )
    assert signal.getsignal(signal.SIGTERM) is before
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} <= {"config.json", ".lock"}
    assert anytouch(*words, "--stop-after", 0).status == 0


@pytest.mark.parametrize(
    "place",
    [
        "anytouch_jax.data.manifest.manifest.read",
        "anytouch_jax.weights.checkpoint.Checkpoints.latest",
    ],
)
def test_ctrl_c_before_the_first_step_says_how_to_continue(
    anytouch, tmp_path, world, monkeypatch, place
):
    module, _, name = place.rpartition(".")
    owner = pkgutil.resolve_name(module)

    def interrupted(*args, **options):
        raise KeyboardInterrupt

    words = ["train", "--data", world, "--run", tmp_path / "r", "--steps", 4, "--batch", 8, *SMALL]
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, interrupted)
        done = anytouch(*words)
    last = done.err.splitlines()[-1]
    assert done.status == 130 and "Ctrl-C before the first step" in last
    assert str(tmp_path / "r") in last and "same command" in last


@contextlib.contextmanager
def terminal(monkeypatch):
    """A terminal as the error stream; gives a list that has what was written, once it is closed."""
    leader, follower = pty.openpty()
    written = []

    def read():
        while chunk := _read(leader):
            written.append(chunk.decode())

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    with monkeypatch.context() as patch, os.fdopen(follower, "w") as stream:
        patch.setenv("TERM", "xterm")
        patch.setenv("COLUMNS", "100")
        patch.setattr(sys, "stderr", stream)
        yield written
    # The last writer is gone, which ends the reader.
    reader.join(10)
    os.close(leader)


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 1 << 16)
    except OSError:  # the other end is closed
        return b""


def rows_of_terminal(text: str) -> list[str]:
    """The rows that a terminal shows: each part between line feeds and carriage returns, plain."""
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
    return [row.strip() for row in re.split(r"[\r\n]+", plain)]


def test_a_sentence_beside_the_bar_has_a_line_of_its_own(monkeypatch):
    with terminal(monkeypatch) as written, progress(0, 3, log) as advance:
        for step in range(3):
            advance({"step": step, "loss": 1.0, "samples_per_second": 5.0, "skipped_batches": 0})
            log(f"sentence {step}")
    rows = rows_of_terminal("".join(written))
    assert [row for row in rows if "sentence" in row] == [f"sentence {step}" for step in range(3)]


def test_ctrl_c_leaves_the_sentence_that_says_how_to_continue(tmp_path, world, monkeypatch):
    real = Record.write

    def write(record, step, numbers):
        if step == 1:
            signal.raise_signal(signal.SIGINT)
        return real(record, step, numbers)

    monkeypatch.setattr(Record, "write", write)
    words = ["train", "--data", world, "--run", tmp_path / "r", "--steps", 9, "--batch", 8, *SMALL]
    with terminal(monkeypatch) as written:
        assert main([str(word) for word in words]) == 130
    rows = [row for row in rows_of_terminal("".join(written)) if row]
    assert rows[-1].startswith("stopped by SIGINT after step 3 and saved in")
    assert rows[-1].endswith("the same command continues from here")
    assert saved_steps(tmp_path / "r") == [3]


NOT_WORDS = """
import sys
from anytouch_jax.cli.app import main
status = main(sys.argv[1:])
print(status, "jax" in sys.modules)
"""


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--model.sensors", "DIGITT", "universal"], "did you mean digit"),
        (["--simulated.sensors", "Digit"], "did you mean digit"),
        (["--data.split", "trian"], "train, val, test"),
        (["--objective.terms", "field", "1"], "no objective"),
        (["--init", "gone"], "--init gone does not exist"),
        (["--towers", "pretrained", "--clip-weights", "gone"], "--clip-weights gone does not"),
        (["--data", "simulatd"], "Did you mean --data simulated?"),
        (["--data", "gone.parquet"], "gone.parquet"),
    ],
)
def test_wrong_words_are_refused_before_jax_is_loaded(words, named, world, tmp_path):
    data = [] if "--data" in words else ["--data", str(world)]
    done = subprocess.run(
        [sys.executable, "-c", NOT_WORDS, "train", *data, "--run", str(tmp_path / "r"), *words],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        timeout=300,
        check=False,
    )
    assert done.stdout.split() == ["2", "False"], done.stderr
    assert named in done.stderr and len(done.stderr.strip().splitlines()) == 1


def test_a_run_that_continues_does_not_need_its_start(anytouch, tmp_path, world, tiny_run):
    shutil.copytree(tiny_run, tmp_path / "r")
    words = ["--steps", 4, "--save-every", 4, "--batch", 8, *TINY_RUN, "--stop-after", 2]
    done = anytouch("train", "--data", world, "--run", tmp_path / "r", "--init", "gone", *words)
    assert done.status == 0 and "gone is not read" in done.err


# The run is the same as that of one process, on whatever number of devices it continues.

PROCESS = """
import sys
from pathlib import Path
from anytouch_jax.cli.train import TrainOptions, TrainRequest, run
from test_train import config_of
options = TrainOptions((), Path({run!r}), stage={stage})
sys.exit(run(TrainRequest(options, config_of(Path({world!r}), {stage}, **{more!r}))))
"""


def config_of(world: Path, stage: int, *, steps: int = 20, **run):
    """Stage 1, or stage 2 with RGB images and captions for some; a rate at which rounding stays
    rounding.
    """
    config = run_config(world, stage, steps=steps, **({"save_every": 5} | run))
    data = replace(config.data, clip_fraction=1.0) if stage == 2 else config.data
    return replace(config, data=data, optim=replace(config.optim, learning_rate=1e-4))


def processes(world, run_dir, stage, **more):
    """Two processes train a run to its end; returns their error streams."""
    script = PROCESS.format(run=str(run_dir), world=str(world), stage=stage, more=more)
    ended = finish(spawn(["-c", script], 2, 1, Path(__file__).parent), 900)
    assert [status for status, _ in ended] == [0, 0], ended
    return [message for _, message in ended]


def agree(run: Path, other: Path) -> None:
    """The losses of two runs to 1e-5, their terms and the gradient's norm to 1e-4 (a term of few
    rows is small).

    Not the update's: Adam makes a whole step of the sign of a gradient that is only noise (a key's
    bias).
    """
    rows = [read_metrics(folder) for folder in (run, other)]
    assert [[row["step"] for row in lines] for lines in rows] == [list(range(20))] * 2
    for a, b in zip(*rows, strict=True):
        assert a.keys() == b.keys()
        for name in a.keys() - {"wait", "wait_fraction", "match_accuracy", "update_norm"}:
            close = (
                1e-5 if name in ("loss", "align", "match", "reconstruction", "next_frame") else 1e-4
            )
            assert b[name] == pytest.approx(a[name], rel=close, abs=1e-6), (a["step"], name)


@pytest.fixture(scope="module", params=[1, 2], ids=["stage 1", "stage 2"])
def lone(request, tmp_path_factory, world):
    """(stage, run folder, result) of twenty steps on one device."""
    run = tmp_path_factory.mktemp("alone") / "run"
    return request.param, run, train(config_of(world, request.param), run, mesh=make_mesh(1))


@pytest.mark.slow
def test_one_two_and_four_devices_and_two_processes_give_the_same_losses(lone, world, tmp_path):
    stage, run, _ = lone
    if stage == 2:  # InfoNCE over the global batch: some rows have no RGB image or caption
        assert 0 < read_metrics(run)[0]["touch_text_pairs"] < 8
    for devices, fsdp in ((2, 1), (4, 2)):
        train(
            config_of(world, stage, fsdp=fsdp),
            tmp_path / f"{devices}",
            mesh=make_mesh(devices // fsdp, fsdp),
        )
        agree(run, tmp_path / f"{devices}")
    first, second = processes(world, tmp_path / "two", stage, fsdp=2)
    assert "20 of 20 steps" in first and second == ""
    agree(run, tmp_path / "two")
    assert saved_steps(tmp_path / "two") == saved_steps(run)


@pytest.mark.slow
def test_a_figure_is_drawn_once(world, tmp_path):
    processes(world, tmp_path / "r", 1, steps=2, fsdp=2, figure_every=2)
    assert [path.name for path in (tmp_path / "r" / "figures").iterdir()] == [
        "reconstruction_000002.png"
    ]


@pytest.mark.slow
def test_the_script_starts_processes_by_hand(world, tmp_path):
    program = tmp_path / "anytouch"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m anytouch_jax "$@"\n')
    program.chmod(0o755)
    options = [
        "--stage",
        "1",
        "--data",
        str(world),
        "--run",
        str(tmp_path / "run"),
        "--steps",
        "2",
        "--batch",
        "8",
    ]
    environ = os.environ | {
        "ANYTOUCH": str(program),
        "COORDINATOR": free_address(),
        "PYTHONPATH": str(ROOT / "src"),
    }
    script = [ROOT / "experiments" / "launch" / "by_hand.sh", *options, *SMALL]

    def launch(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*script, *more], env=environ, capture_output=True, text=True, timeout=900, check=False
        )

    for expected in ("2 of 2 steps", "nothing to do"):
        done = launch()
        assert done.returncode == 0 and expected in done.stderr, done.stderr
    assert saved_steps(tmp_path / "run") == [2]
    done = launch("--run.seed", "1")
    assert done.returncode == 2 and "was killed" not in done.stderr, done.stderr
    # each finds the mistake by itself, and none is aborted by the other's end
    for process in range(2):
        assert (
            f"process {process} of 2: the run in" in done.stderr
            and "run.seed was 0 and is now 1" in done.stderr
        )
    assert jax.process_count() == 1
