import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adam_moments import moments
from places import ROOT, SUPPORT
from runs import TIMING
from train_toy import (
    ROWS,
    stopping_batches,
    toy_batch,
    toy_batches,
    toy_config,
    toy_loss,
    toy_params,
)

from anytouch_jax.errors import UserError
from anytouch_jax.train import loop
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.progress import chart, progress
from anytouch_jax.weights import checkpoint


def run(run_dir, config=None, *, said=None, **more):
    options = {"params": toy_params(), "loss_fn": toy_loss, "batches": toy_batches} | more
    said = [] if said is None else said
    return fit(config or toy_config(), run_dir=run_dir, log=said.append, **options)


def clips(start, stop):
    """Clips only, which makes one program instead of two."""
    for step in range(start, stop):
        yield step, toy_batch(2 * step + 1), {"samples": ROWS}


def rows(run_dir):
    found = [
        json.loads(line) for line in (Path(run_dir) / "metrics.jsonl").read_text().splitlines()
    ]
    return [{name: value for name, value in row.items() if name not in TIMING} for row in found]


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.fixture(params=[False, True], ids=["kept", "donated"])
def donates(request, monkeypatch):
    """Whether a step may overwrite its state, as on an accelerator; on a CPU it can, but is not
    allowed to.
    """
    if request.param:
        with monkeypatch.context() as patch:
            patch.setattr(jax, "default_backend", lambda: "gpu")
            allowed = loop.meshes.donated()
        monkeypatch.setattr(loop.meshes, "donated", lambda: allowed)
    return request.param


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Eight steps in one go: (folder, result)."""
    run_dir = tmp_path_factory.mktemp("undisturbed")
    return run_dir, run(run_dir)


def test_a_run_leaves_its_folder_and_a_line_a_step(undisturbed):
    run_dir, result = undisturbed
    assert {entry.name for entry in run_dir.iterdir()} == {
        ".lock",
        "config.json",
        "metrics.jsonl",
        "checkpoints",
        "figures",
    }
    found = rows(run_dir)
    assert [row["step"] for row in found] == list(range(8))
    wanted = {
        "loss",
        "reconstruction",
        "grad_norm",
        "param_norm",
        "update_norm",
        "learning_rate",
        "p_u",
    }
    wanted |= {"samples", "skipped_samples", "skipped", "skipped_batches"}
    assert wanted <= set(found[0])
    assert found[0]["learning_rate"] == 0 and found[4]["p_u"] == pytest.approx(0.375)
    assert (result.step, result.resumed, result.interrupted) == (8, 0, None)
    # one a kind of batch
    assert result.state.step == 8 and result.metrics["step"] == 7 and result.traces == 2
    assert all(value is not None for row in found for value in row.values())


@pytest.mark.parametrize("devices", [1, 4])
def test_the_callers_parameters_survive(tmp_path, devices, donates):
    params = jax.tree.map(jnp.asarray, toy_params())
    run(tmp_path, params=params, stop_after=1, mesh=make_mesh(devices))
    assert_same(params, toy_params())


@pytest.mark.parametrize("stops", [(2, 4), (1, 2, 3, 7)])
def test_parts_of_a_run_equal_the_whole_bit_for_bit(undisturbed, tmp_path, stops):
    for done in stops:
        part = run(tmp_path, stop_after=done)
        assert part.step == done and part.state.step == done
    result = run(tmp_path)
    assert result.resumed == stops[-1]
    assert_same(result.state, undisturbed[1].state)
    assert rows(tmp_path) == rows(undisturbed[0])


def test_another_number_of_devices_goes_on(tmp_path):
    def part(name, fsdp, **more):
        # A small rate: Adam makes a whole step of the sign of a gradient that is only noise.
        config = toy_config(fsdp=fsdp, optim={"learning_rate": 1e-4})
        return run(tmp_path / name, config, params=toy_params(8192), batches=clips, **more)

    one = part("one", 1, mesh=make_mesh(1))
    first = part("moving", 4, stop_after=4)
    for array in (first.state.trainable["trunk"]["kernel"], first.state.opt_state.mu[-1]):
        assert {shard.data.shape for shard in array.addressable_shards} == {(12, 2048)}
    assert part("moving", 2, stop_after=6).resumed == 4
    last = part("moving", 1, mesh=make_mesh(1))
    assert last.resumed == 6
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), last.params, one.params
    )
    losses = [[row["loss"] for row in rows(tmp_path / name)] for name in ("one", "moving")]
    np.testing.assert_allclose(*losses, rtol=1e-5)
    assert not np.array_equal(one.params["trunk"]["kernel"], toy_params(8192)["trunk"]["kernel"])


def test_skipped_steps_are_counted_and_change_nothing(tmp_path):
    batches = partial(toy_batches, bad=(2, 3, 5))
    result = run(tmp_path, toy_config(save_every=2), batches=batches, stop_after=6)
    found = rows(tmp_path)
    assert [row["skipped"] for row in found] == [0, 0, 1, 1, 0, 1]
    assert [row["skipped_batches"] for row in found] == [0, 0, 1, 2, 2, 3]
    assert found[2]["loss"] is None and found[2]["update_norm"] == 0
    assert moments(result.state.opt_state, result.state.trainable)["trunk"]["kernel"].updates == 3


def test_too_many_skipped_in_a_row_end_the_run(tmp_path):
    batches = partial(toy_batches, bad=range(2, 100))
    config = toy_config(save_every=2, max_skipped=3)
    with pytest.raises(UserError, match=r"4 steps in a row, up to step 5.* --optim.grad-clip"):
        run(tmp_path, config, batches=batches)
    assert [row["step"] for row in rows(tmp_path)] == list(range(6))
    # going on recalls those before
    with pytest.raises(UserError, match="4 steps in a row, up to step 5"):
        run(tmp_path, config, batches=batches)
    good = run(tmp_path, config, stop_after=8)
    assert good.step == 8 and good.resumed == 4


def test_metrics_are_fetched_while_the_next_step_runs(tmp_path, monkeypatch):
    events = []
    fetch = jax.device_get
    compiled = loop._Loop.compile

    def watched(self, *args):
        step = compiled(self, *args)
        return lambda *operands: events.append("step") or step(*operands)

    monkeypatch.setattr(jax, "device_get", lambda tree: events.append("fetch") or fetch(tree))
    monkeypatch.setattr(loop._Loop, "compile", watched)
    run(tmp_path, toy_config(save_every=0), stop_after=6)
    assert events[:8] == ["step", "step", "fetch", "step", "fetch", "step", "fetch", "step"]
    assert events.count("fetch") == events.count("step") == 6


class Clock:
    """Time that passes only when it is told to."""

    now = 100.0

    def perf_counter(self):
        return self.now


class Step:
    """A step that ends `after` seconds after it began (None: never) by that clock."""

    def __init__(self, clock, after):
        self.clock = clock
        self.after = after

    def began(self, metrics):
        self.start = self.clock.now

    def ended(self):
        done = self.after is not None and self.start + self.after <= self.clock.now
        if done:
            return self.start + self.after
        return None


@pytest.mark.parametrize(
    ("after", "first", "other"),
    [(0, 6, 3), (1, 5, 2), (None, 3, 0)],
    ids=["at once", "in a second", "busy"],
)
def test_the_time_that_a_step_waits_for_its_batch_is_written(
    tmp_path, monkeypatch, after, first, other
):
    """A batch takes 3 s and the rest of a step 1 s.

    What counts is the time in which no step runs.
    """
    clock = Clock()

    def batches(start, stop):
        for item in toy_batches(start, stop):
            clock.now += 3
            yield item

    def put(batch, sharding):
        clock.now += 1
        return put_batch(batch, sharding)

    put_batch = loop.meshes.put_batch
    monkeypatch.setattr(loop.meshes, "put_batch", put)
    monkeypatch.setattr(loop, "time", clock)
    monkeypatch.setattr(loop, "LastStep", lambda: Step(clock, after))
    run(tmp_path, toy_config(save_every=0), batches=batches, stop_after=4)
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    # A line is written when the next batch has come: the first one tells of two batches, the last
    # one of none.
    assert [line["wait"] for line in lines] == [first, other, other, 0]
    assert [line["wait_fraction"] for line in lines] == [first / 8, other / 4, other / 4, 0]


@pytest.mark.parametrize("fsdp", [1, 4])
def test_no_step_compiles_after_the_first_of_its_kind(tmp_path, caplog, fsdp):
    """Neither with checkpoints between nor, for a second time, after a resume."""
    seen = []

    def batches(start, stop):
        for step, batch, info in toy_batches(start, stop):
            seen.append(
                (
                    step,
                    sum(
                        "XLA compilation of jit(step)" in record.message
                        for record in caplog.records
                    ),
                )
            )
            yield step, batch, info

    with jax.log_compiles():
        config = toy_config(fsdp=fsdp)
        for stop in (6, 8):
            seen.clear()
            run(tmp_path, config, params=toy_params(8192), batches=batches, stop_after=stop)
            counts = dict(seen)
            kinds = [counts[step + 1] - counts[step] for step in range(min(counts), stop - 1)]
            # A program for stills and one for clips, then nothing.
            assert all(kinds[:2] if stop == 6 else kinds[:1]) and not any(kinds[2:]), seen


def test_nothing_is_transferred_to_the_device_unasked(tmp_path):
    with jax.transfer_guard("disallow"):
        run(tmp_path, toy_config(save_every=0), stop_after=4)


def test_reports_come_every_so_often_and_at_the_end_and_cannot_end_the_run(tmp_path):
    seen = []
    said = []

    def report(step, params, batch):
        seen.append((step, batch.clip.shape[0], sorted(params["decoder"])))
        np.testing.assert_array_equal(batch.clip, toy_batch(step - 1).clip)
        if step == 3:
            raise RuntimeError("no display")

    run(tmp_path, toy_config(steps=8, figure_every=3), on_report=report, said=said)
    assert seen == [(step, ROWS, ["clip_head", "position", "still_head"]) for step in (3, 6, 8)]
    assert "no figures at step 3: RuntimeError: no display" in said
    seen.clear()
    run(tmp_path / "even", toy_config(steps=8, figure_every=4), on_report=report)
    # the last one once, although it is the end too
    assert [step for step, *_ in seen] == [4, 8]


def test_the_checkpoints_metrics_are_the_mean_since_the_one_before(tmp_path, monkeypatch):
    saved = {}
    partial = []

    class Watched(loop.Checkpoints):
        def save(self, step, state, metrics):
            saved[step] = metrics["loss"]
            partial.append(bool(metrics.get("partial")))
            super().save(step, state, metrics)

    monkeypatch.setattr(loop, "Checkpoints", Watched)
    run(tmp_path)
    losses = [row["loss"] for row in rows(tmp_path)]
    assert list(saved) == [3, 6, 8]
    assert list(saved.values()) == pytest.approx(
        [np.mean(losses[a:b]) for a, b in ((0, 3), (3, 6), (6, 8))]
    )
    assert partial == [False, False, True], "two steps against three: never the best"


def test_batches_out_of_order_or_too_few_are_refused(tmp_path):
    with pytest.raises(ValueError, match="gave step 1 instead of step 0"):
        run(tmp_path / "a", batches=lambda start, stop: toy_batches(start + 1, stop))
    with pytest.raises(UserError, match="the data ended after 3 of 8 steps"):
        run(tmp_path / "b", batches=lambda start, stop: toy_batches(start, 3))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_finishes_the_step_saves_and_restores_the_handlers(undisturbed, tmp_path, number):
    before = [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)]
    said = []
    result = run(tmp_path, batches=partial(stopping_batches, at=4, number=number), said=said)
    assert (result.interrupted, result.step) == (number, 5)
    assert [signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGINT)] == before
    assert any(f"stopped by {number.name} after step 5" in line for line in said)
    result = run(tmp_path)
    assert result.resumed == 5
    assert_same(result.state, undisturbed[1].state)
    assert rows(tmp_path) == rows(undisturbed[0])


def test_a_second_interrupt_is_not_held_back(tmp_path):
    def batches(start, stop):
        for step, batch, info in toy_batches(start, stop):
            if step == 2:
                # handled in this thread: two kills at once may arrive as one
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGINT)
            yield step, batch, info

    # Workers of pytest-xdist ignore SIGINT; a program does not.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, batches=batches)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def child(run_dir, at, number):
    env = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    }
    command = [
        sys.executable,
        str(SUPPORT / "train_toy.py"),
        str(run_dir),
        str(at),
        str(int(number)),
    ]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=120)


def test_a_killed_run_goes_on_and_ends_as_if_undisturbed(undisturbed, tmp_path):
    # before the first checkpoint, and right after it (the save may be under way)
    for at in (2, 5):
        assert child(tmp_path, at, signal.SIGKILL).returncode == -signal.SIGKILL
    result = run(tmp_path)
    assert result.resumed in (0, 3)
    assert_same(result.state, undisturbed[1].state)
    assert rows(tmp_path) == rows(undisturbed[0])


def test_a_full_disk_ends_a_run_before_its_first_step(tmp_path, monkeypatch):
    def no_batches(start, stop):
        raise AssertionError("no batch was needed")

    run(tmp_path / "run", stop_after=2)
    usage = checkpoint.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(checkpoint.shutil, "disk_usage", lambda _: usage._replace(free=400))
    for folder in ("new", "run"):
        with pytest.raises(
            UserError, match=r"the disk is full. It needs [\d,]+ bytes and has 400\."
        ):
            run(tmp_path / folder, batches=no_batches)
    monkeypatch.undo()
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == ["00000002"]
    assert run(tmp_path / "run", stop_after=3).resumed == 2
    assert run(tmp_path / "new", stop_after=1).resumed == 0


def test_figures_are_drawn_from_a_live_batch_and_live_parameters(tmp_path, monkeypatch, donates):
    states = []
    seen = []
    compiled = loop._Loop.compile

    def watched(self, *args):
        step = compiled(self, *args)
        return lambda state, *rest: states.append(state) or step(state, *rest)

    def report(step, params, batch):
        host = jax.tree.map(np.array, (params, batch))
        assert_same(host[1], toy_batch(step - 1))
        seen.append(host[0])

    monkeypatch.setattr(loop._Loop, "compile", watched)
    said = []
    result = run(tmp_path, toy_config(figure_every=1), on_report=report, said=said, stop_after=3)
    assert not any("no figures" in line for line in said), said
    assert_same(seen[-1], result.params)
    assert not np.array_equal(seen[0]["trunk"]["kernel"], seen[-1]["trunk"]["kernel"])
    gone = [state.trainable["trunk"]["kernel"].is_deleted() for state in states]
    # jax 0.11 copies one that a NumPy view of it still holds
    assert gone[0] == donates and (donates or not any(gone))


def row(step, **more):
    return {"step": step, "loss": 0.5, "samples_per_second": 30.4, "skipped_batches": 0} | more


def test_the_curve_falls_with_the_loss():
    lines = chart([8.0] * 50 + [1.0] * 50, width=10, height=4).splitlines()
    assert [line[10:] for line in lines] == ["█████     "] * 3 + ["█████▁▁▁▁▁"]
    assert lines[0].startswith("   8.0000 ") and lines[-1].startswith("   1.0000 ")
    # no change, no division by zero
    assert len(set(chart([2.0, 2.0]).splitlines()[-1][10:])) == 1


def test_elsewhere_some_twenty_lines_are_said():
    said = []
    with progress(100, 1100, said.append) as advance:
        for step in range(100, 1100):
            advance(row(step))
    assert len(said) == 21
    assert said[0] == "step 101/1100  loss 0.5000  30 samples/s" and said[-1].startswith(
        "step 1100/1100"
    )
