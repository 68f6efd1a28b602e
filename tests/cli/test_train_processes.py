"""`anytouch train` by several processes: the same run as by one, on whatever number of devices it goes on."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from places import ROOT, SUPPORT
from runs import SIZES, arrays_of, read_metrics, run_config, saved_steps, train

from anytouch_jax.train.mesh import make_mesh

PROCESS = """
import sys
from pathlib import Path
from runs import run_config
from anytouch_jax.cli.train import run
from anytouch_jax.cli.options import Train
from test_train_processes import config_of
sys.exit(run(Train((), Path({run!r}), stage={stage}), config_of(Path({world!r}), {stage}, **{more!r})))
"""


@pytest.fixture(autouse=True)
def _compiled_once(compiled_once):
    """Most runs here share their programs."""


def config_of(world: Path, stage: int, *, steps: int = 20, **run):
    """Stage 1, or stage 2 with photographs and captions for some; a rate at which rounding stays rounding."""
    config = run_config(world, stage, steps=steps, **({"save_every": 5} | run))
    data = replace(config.data, clip_share=1.0) if stage == 2 else config.data
    return replace(config, data=data, optim=replace(config.optim, learning_rate=1e-4))


def processes(world, run_dir, stage, *, devices=1, **more):
    """Two processes train a run to its end; returns their error streams."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    script = PROCESS.format(tests=str(ROOT / "tests"), run=str(run_dir), world=str(world), stage=stage, more=more)
    path = os.pathsep.join(
        [str(ROOT / "src"), str(SUPPORT), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    )
    common = os.environ | {
        "PYTHONPATH": path,
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "true",
        "JAX_NUM_CPU_DEVICES": str(devices),
        "JAX_COORDINATOR_ADDRESS": address,
        "JAX_NUM_PROCESSES": "2",
    }
    started = [
        subprocess.Popen(
            [sys.executable, "-c", script],
            env=common | {"JAX_PROCESS_ID": str(i)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(2)
    ]
    try:
        said = [process.communicate(timeout=900)[1] for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [0, 0], said
    return said


def agree(one: Path, other: Path) -> None:
    """The losses of two runs to 1e-5, their terms and the gradient's norm to 1e-4 (a term of few rows is small).

    Not the update's: Adam makes a whole step of the sign of a gradient that is only noise (a key's bias).
    """
    rows = [read_metrics(run) for run in (one, other)]
    assert [[row["step"] for row in run] for run in rows] == [list(range(20))] * 2
    for a, b in zip(*rows, strict=True):
        assert a.keys() == b.keys()
        for name in a.keys() - {"wait", "wait_share", "match_accuracy", "update_norm"}:
            close = 1e-5 if name in ("loss", "align", "match", "reconstruction", "next_frame") else 1e-4
            assert b[name] == pytest.approx(a[name], rel=close, abs=1e-6), (a["step"], name)


@pytest.fixture(scope="module", params=[1, 2], ids=["stage 1", "stage 2"])
def lock(request, tmp_path_factory, world, compiled_once):
    """(stage, run folder, result) of twenty steps on one device."""
    run = tmp_path_factory.mktemp("alone") / "run"
    return request.param, run, train(config_of(world, request.param), run, mesh=make_mesh(1))


@pytest.mark.slow
def test_one_two_and_four_devices_and_two_processes_give_the_same_losses(lock, world, tmp_path):
    stage, run, _ = lock
    if stage == 2:  # InfoNCE over the global batch: some rows have no photograph or caption
        assert 0 < read_metrics(run)[0]["touch_text_pairs"] < 8
    for devices, fsdp in ((2, 1), (4, 2)):
        train(config_of(world, stage, fsdp=fsdp), tmp_path / f"{devices}", mesh=make_mesh(devices // fsdp, fsdp))
        agree(run, tmp_path / f"{devices}")
    first, second = processes(world, tmp_path / "two", stage, fsdp=2)
    assert "20 of 20 steps" in first and second == ""
    agree(run, tmp_path / "two")
    assert saved_steps(tmp_path / "two") == saved_steps(run)


@pytest.mark.slow
def test_from_four_devices_to_one_and_back_the_parameters_are_the_same(lock, world, tmp_path):
    stage, run, result = lock
    for stop, devices, fsdp in ((5, 4, 1), (10, 1, 1), (15, 4, 4), (20, 1, 1)):
        mesh = make_mesh(devices // fsdp, fsdp)
        part = train(config_of(world, stage, fsdp=fsdp), tmp_path / "r", mesh=mesh, stop_after=stop)
        assert part.step == stop and part.resumed == stop - 5
    agree(run, tmp_path / "r")
    wanted, found = arrays_of(result), arrays_of(part)
    for name, array in wanted.items():
        # A key's bias moves no output: its gradient is rounding, and Adam makes whole steps of its sign.
        if not name.startswith("opt_state") and not name.endswith("attention/key/bias"):
            np.testing.assert_allclose(found[name], array, rtol=0, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_a_figure_is_drawn_once(world, tmp_path):
    processes(world, tmp_path / "r", 1, steps=2, fsdp=2, figure_every=2)
    assert [path.name for path in (tmp_path / "r" / "figures").iterdir()] == ["reconstruction_000002.png"]


@pytest.mark.slow
def test_the_script_starts_processes_by_hand(world, tmp_path):
    command = tmp_path / "anytouch"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m anytouch_jax "$@"\n')
    command.chmod(0o755)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    sizes = [word for name, value in SIZES.items() for word in (f"--{name}", str(value))]
    options = ["--stage", "1", "--data", str(world), "--run", str(tmp_path / "run"), "--steps", "2", "--batch", "8"]
    environ = os.environ | {"ANYTOUCH": str(command), "COORDINATOR": address, "PYTHONPATH": str(ROOT / "src")}
    script = ROOT / "experiments" / "launch" / "by_hand.sh"
    for expected in ("2 of 2 steps", "nothing to do"):
        done = subprocess.run(
            [script, *options, *sizes], env=environ, capture_output=True, text=True, timeout=900, check=False
        )
        assert done.returncode == 0 and expected in done.stderr, done.stderr
    assert saved_steps(tmp_path / "run") == [2]
    done = subprocess.run(
        [script, *options, *sizes, "--loop.seed", "1"],
        env=environ,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 1 and "was killed" not in done.stderr, done.stderr
    for process in range(2):  # each finds the mistake by itself, and none is aborted by the other's end
        assert f"process {process} of 2: the run in" in done.stderr and "run.seed was 0 and is now 1" in done.stderr
    assert jax.process_count() == 1
