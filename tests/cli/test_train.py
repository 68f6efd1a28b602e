import json
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import pytest
from places import ROOT
from runs import SIZES, read_metrics, run_config, saved_steps, train
from toy_process import finish, free_address, spawn

from anytouch_jax.cli import train as command
from anytouch_jax.config import preset
from anytouch_jax.train.mesh import make_mesh


def options_of(sizes: dict[str, object]) -> list[str]:
    return [str(word) for name, value in sizes.items() for word in (f"--{name}", value)]


SMALL = options_of(SIZES)
# The sizes of `tiny_run`.
TINY_RUN = options_of(
    {name: value for name, value in SIZES.items() if "clip-share" not in name}
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


def test_a_corrupt_picture_is_named_and_may_be_skipped_and_counted(
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
    """Stage 1, or stage 2 with photographs and captions for some; a rate at which rounding stays
    rounding.
    """
    config = run_config(world, stage, steps=steps, **({"save_every": 5} | run))
    data = replace(config.data, clip_share=1.0) if stage == 2 else config.data
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
        for name in a.keys() - {"wait", "wait_share", "match_accuracy", "update_norm"}:
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
    if stage == 2:  # InfoNCE over the global batch: some rows have no photograph or caption
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
