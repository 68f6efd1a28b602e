import json
import signal
from functools import partial

import jax
import numpy as np
import pytest
from toy_process import WIDE, batches_of, config_of, finish, start
from train_toy import toy_loss, toy_params

from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.train import mesh as distributed
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import joined, make_mesh, process_count

SLURM = {"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "3", "SLURM_LOCALID": "1"}
# without srun
ALLOCATION = {"SLURM_JOB_ID": "1", "SLURM_NTASKS": "4", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
OMPI = {"OMPI_COMM_WORLD_SIZE": "4", "OMPI_COMM_WORLD_RANK": "3", "OMPI_COMM_WORLD_LOCAL_RANK": "1"}
ADDRESS = {"JAX_COORDINATOR_ADDRESS": "node1:29400"}
BY_HAND = ADDRESS | {"JAX_NUM_PROCESSES": "4", "JAX_PROCESS_ID": "3"}


@pytest.fixture
def initialized(monkeypatch):
    """The arguments of each call of `jax.distributed.initialize`, which does nothing; exits raise
    SystemExit.
    """
    calls = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **kwargs: calls.append(kwargs))
    monkeypatch.setattr(jax.distributed, "shutdown", lambda: None)
    monkeypatch.setattr(
        distributed.os, "_exit", lambda status: (_ for _ in ()).throw(SystemExit(status))
    )
    return calls


@pytest.mark.parametrize(
    ("environ", "count"),
    [
        ({}, 1),
        ({"JAX_NUM_PROCESSES": "1"}, 1),
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1"}, 1),
        (ALLOCATION, 1),
        (SLURM | {"SLURM_STEP_NUM_TASKS": "1"}, 1),
        (BY_HAND, 4),
        (BY_HAND | {"JAX_NUM_PROCESSES": "2"} | SLURM, 2),
        (SLURM, 4),
        (OMPI, 4),
    ],
)
def test_processes_of_the_environment(environ, count, initialized):
    assert process_count(environ) == count
    with joined(environ) as process:
        assert (process is None) == (count == 1)
    assert [call["num_processes"] for call in initialized] == [count] * (count > 1)


def test_numbers_set_by_hand_go_before_detection(initialized):
    for environ in (BY_HAND, BY_HAND | SLURM, SLURM | ADDRESS):
        with joined(environ):
            pass
    by_hand, before_slurm, slurm = initialized
    assert by_hand == before_slurm
    assert by_hand["process_id"] == 3 and by_hand["cluster_detection_method"] == "deactivate"
    assert slurm["coordinator_address"] == "node1:29400" and "process_id" not in slurm


@pytest.mark.parametrize(
    ("name", "value"), [("JAX_NUM_PROCESSES", "two"), ("JAX_PROCESS_ID", "one")]
)
def test_a_number_that_is_none_is_named(name, value, initialized, capfd):
    with pytest.raises((ConfigError, SystemExit)) as raised, joined(BY_HAND | {name: value}):
        raise AssertionError("it must not run")
    message = capfd.readouterr().err or str(raised.value)
    assert name in message and message.count("\n") < 2 and not initialized


def test_one_process_raises_its_errors():
    with pytest.raises(UserError, match="a mistake"), joined({}):
        raise UserError("a mistake")


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (UserError("batch_size 3"), 2),
        (KeyboardInterrupt(), 130),
        (jax.errors.JaxRuntimeError("Gloo all-reduce failed:\n Connection closed by peer"), 1),
        (ValueError("odd"), 1),
    ],
)
def test_a_process_that_fails_exits_at_once(error, status, initialized, capfd):
    with pytest.raises(SystemExit) as exit_, joined(BY_HAND):
        raise error
    message = capfd.readouterr().err
    assert exit_.value.code == status and "process 0 of 1" in message
    assert " ".join(str(error).split()) in message
    assert ("Traceback" in message) == (type(error) is ValueError)


@pytest.mark.parametrize(
    "error", [RuntimeError("DEADLINE_EXCEEDED"), ValueError("undefined"), KeyError("URI")]
)
def test_a_failed_join_is_one_sentence_that_names_the_variables(
    error, initialized, monkeypatch, capfd
):
    def fail(**kwargs):
        raise error

    monkeypatch.setattr(jax.distributed, "initialize", fail)
    with pytest.raises(SystemExit, match="2"), joined(SLURM):
        raise AssertionError("it must not run")
    message = capfd.readouterr().err
    assert str(error) in message and message.count("\n") == 1
    assert all(name in message for name in BY_HAND)


def test_a_ballot_gives_the_largest_vote():
    flags = distributed.FlagReduction(make_mesh(fsdp=2))
    assert [[int(one) for one in flags.cast(number, 3)] for number in (0, 15)] == [[0, 3], [15, 3]]


def lock(run_dir, mesh=None, **more):
    """The same run in this process."""
    return fit(
        config_of(**{"steps": 12} | more.pop("run", {})),
        params=toy_params(WIDE),
        loss_fn=toy_loss,
        batches=batches_of(0, 1),
        run_dir=run_dir,
        mesh=mesh or make_mesh(1),
        log=lambda sentence: None,
        **more,
    )


def column(run_dir, name="loss"):
    return [json.loads(line)[name] for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("undisturbed")
    return run_dir, lock(run_dir)


def same(result, run_dir, undisturbed):
    """The parameters and every loss of a run are those of the undisturbed one."""
    close = partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6)
    jax.tree.map(close, result.params, undisturbed[1].params)
    np.testing.assert_allclose(column(run_dir), column(undisturbed[0]), rtol=1e-5)


def test_two_processes_train_as_one_stop_as_one_and_go_on_elsewhere(tmp_path, undisturbed):
    """SIGTERM reaches one of them at step 4; parameters are shared between them; four devices take
    over.
    """
    ended = finish(start(tmp_path, hit=1, at=4, number=signal.SIGTERM, steps=12, fsdp=2))
    assert [status for status, _ in ended] == [0, 0], ended
    (_, first), (_, second) = ended
    assert first.count("stopped by SIGTERM after step 6 and saved") == 1 and "step 1/12" in first
    assert second == ""  # one of them speaks
    assert sorted(entry.name for entry in (tmp_path / "checkpoints").iterdir()) == [
        "00000003",
        "00000006",
    ]
    assert column(tmp_path, "skipped_samples") == [1 + 2] * 6  # by both
    result = lock(tmp_path, mesh=make_mesh(fsdp=4), run={"fsdp": 4})
    assert result.resumed == 6
    kernel = result.state.trainable["trunk"]["kernel"]
    assert {shard.data.shape for shard in kernel.addressable_shards} == {(12, WIDE // 4)}
    same(result, tmp_path, undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize("number", [signal.SIGKILL, -1], ids=["killed", "failed"])
def test_a_lost_process_ends_the_other_and_the_next_start_goes_on(
    tmp_path, undisturbed, lost, number
):
    """The checkpoint of step 3 is complete before that of step 6 is begun, and at step 7 one is
    lost.
    """
    ended = finish(start(tmp_path, hit=lost, at=7, number=number, steps=12, fsdp=2))
    (status, message) = ended[lost]
    (other_status, other_message) = ended[1 - lost]
    assert status == (-signal.SIGKILL if number > 0 else 2)
    assert number > 0 or message.count(f"process {lost} of 2: no such row") == 1
    assert other_status != 0 and "Traceback" not in message + other_message
    again = finish(start(tmp_path, steps=12, fsdp=2))
    assert [status for status, _ in again] == [0, 0], again
    assert "continuing from the checkpoint of step 3" in again[0][1] or "of step 6" in again[0][1]
    same(lock(tmp_path, run={"fsdp": 2}), tmp_path, undisturbed)


@pytest.mark.slow
def test_two_processes_of_two_devices_each(tmp_path, undisturbed):
    ended = finish(start(tmp_path, devices=2, steps=12, fsdp=4))
    assert [status for status, _ in ended] == [0, 0], ended
    assert column(tmp_path, "skipped_samples") == [1 + 2] * 12
    same(lock(tmp_path, run={"fsdp": 2}), tmp_path, undisturbed)
