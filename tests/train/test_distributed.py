"""Several processes: who they are, that they train as one, stop as one, and end when one of them is lost."""

from __future__ import annotations

import json
import signal

import jax
import numpy as np
import pytest
from toy_process import WIDE, batches_of, config_of, finish, start
from train_toy import toy_loss, toy_params

from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.train import distributed
from anytouch_jax.train.distributed import Place, find_place, joined
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import make_mesh

SLURM = {"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": "3", "SLURM_LOCALID": "1"}
OMPI = {"OMPI_COMM_WORLD_SIZE": "4", "OMPI_COMM_WORLD_RANK": "3", "OMPI_COMM_WORLD_LOCAL_RANK": "1"}
HERE = {"JAX_COORDINATOR_ADDRESS": "node1:29400"}
HAND = HERE | {"JAX_NUM_PROCESSES": "4", "JAX_PROCESS_ID": "3"}
URI = {"OMPI_MCA_orte_hnp_uri": "1531576320.0;tcp://10.96.0.1:34911"}


@pytest.mark.parametrize(
    ("environ", "place"),
    [
        ({}, None),
        ({"JAX_NUM_PROCESSES": "1"}, None),
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1"}, None),  # any pod, also one alone
        ({"SLURM_JOB_ID": "1", "SLURM_NTASKS": "4", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}, None),  # no srun
        (SLURM | {"SLURM_STEP_NUM_TASKS": "1", "SLURM_PROCID": "0"}, None),
        (HERE | {"JAX_NUM_PROCESSES": "1", "JAX_PROCESS_ID": "0"}, None),
        (HAND, Place(4, 3, None, "node1:29400")),
        (HAND | SLURM, Place(4, 3, None, "node1:29400")),
        (SLURM, Place(4, 3, 1, None, "slurm")),
        (SLURM | HERE, Place(4, 3, 1, "node1:29400", "slurm")),
        (OMPI | URI, Place(4, 3, 1, None, "ompi")),
        (OMPI | HERE, Place(4, 3, 1, "node1:29400", "ompi")),
    ],
)
def test_the_environment_tells_who_this_process_is(environ, place):
    assert find_place(environ) == place


@pytest.mark.parametrize(
    ("environ", "sentence"),
    [
        (HERE, "JAX_NUM_PROCESSES must be a number, not ''"),
        (HERE | {"JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "one"}, "JAX_PROCESS_ID must be a number, not 'one'"),
        (HAND | {"JAX_PROCESS_ID": "4"}, "JAX_PROCESS_ID must be below JAX_NUM_PROCESSES=4, not 4"),
        ({"JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "1"}, "JAX_NUM_PROCESSES needs JAX_COORDINATOR_ADDRESS"),
        (OMPI, "add -x JAX_COORDINATOR_ADDRESS=host:port"),
    ],
)
def test_half_an_environment_is_one_sentence(environ, sentence):
    with pytest.raises(ConfigError, match=sentence):
        find_place(environ)


def test_a_process_alone_is_left_alone(monkeypatch):
    monkeypatch.setattr(jax.distributed, "initialize", None)
    with joined({}) as place:
        assert place is None
    with pytest.raises(UserError, match="a mistake"), joined({}):
        raise UserError("a mistake")


@pytest.mark.parametrize(
    ("error", "said", "status"),
    [
        (UserError("batch_size 3"), "process 1 of 2: batch_size 3", 1),
        (KeyboardInterrupt(), "process 1 of 2 was interrupted", 130),
        (jax.errors.JaxRuntimeError("Gloo all-reduce failed:\n Connection closed by peer"), "another one was lost", 1),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory"), "RESOURCE_EXHAUSTED", 1),
        (ValueError("odd"), "ValueError: odd", 1),
    ],
)
def test_what_is_said_in_the_end(error, said, status):
    sentence, code = distributed._farewell(error, Place(2, 1))
    assert said in sentence and code == status
    assert ("another one was lost" in sentence) == ("Gloo" in str(error))


def test_a_lost_process_is_the_cause_whatever_it_led_to():
    try:
        try:
            raise jax.errors.JaxRuntimeError("UNAVAILABLE: Gloo: connection reset by peer")
        except jax.errors.JaxRuntimeError as error:
            raise UserError("could not write checkpoint 3") from error
    except UserError as error:
        assert "process 1 of 2 ends because another one was lost" in distributed._farewell(error, Place(2, 1))[0]


def test_of_one_process_everything_is_whole_and_the_first_tells_itself(tmp_path):
    tree = {"a": jax.numpy.ones(3)}
    assert distributed.whole(tree) is tree and distributed.told_by_first(7) == 7
    distributed.check_shared(tmp_path / "nowhere")


def test_it_is_told_when_a_process_ends_without_a_word(capfd):
    distributed._last_words(Place(2, 1)).communicate(b".")
    assert capfd.readouterr().err == ""
    distributed._last_words(Place(2, 1)).communicate(b"")
    said = capfd.readouterr().err
    assert said.startswith("process 1 of 2 was killed, or gave up") and said.count("\n") == 1
    assert said.endswith("the same command goes on from the last complete checkpoint\n")


def test_a_coordinator_that_does_not_answer_is_one_sentence(monkeypatch, capfd):
    def nobody(*args, **kwargs):
        assert args == ("node1:29400", 4, 3) and kwargs["cluster_detection_method"] == "deactivate"
        assert kwargs["local_device_ids"] == 1
        raise RuntimeError("DEADLINE_EXCEEDED: Deadline Exceeded")

    def left(status):
        raise SystemExit(status)

    monkeypatch.setattr(jax.distributed, "initialize", nobody)
    monkeypatch.setattr(distributed.os, "_exit", left)
    with pytest.raises(SystemExit, match="1"), joined(SLURM | HERE):
        raise AssertionError("it must not run")
    said = capfd.readouterr().err
    assert said.startswith("process 3 of 4: could not join the other processes at node1:29400 (DEADLINE_EXCEEDED")
    assert said.count("\n") == 1


def test_a_ballot_gives_the_largest_vote():
    ballot = distributed.Ballot(make_mesh(fsdp=2))
    assert [[int(one) for one in ballot.cast(number, 3)] for number in (0, 15)] == [[0, 3], [15, 3]]


# Two processes ------------------------------------------------------------------------------------------------------


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
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), result.params, undisturbed[1].params
    )
    np.testing.assert_allclose(column(run_dir), column(undisturbed[0]), rtol=1e-5)


def test_two_processes_train_as_one_stop_as_one_and_go_on_elsewhere(tmp_path, undisturbed):
    """SIGTERM reaches one of them at step 4; parameters are shared between them; four devices take over."""
    ended = finish(start(tmp_path, hit=1, at=4, number=signal.SIGTERM, steps=12, fsdp=2))
    assert [status for status, _ in ended] == [0, 0], ended
    (_, first), (_, second) = ended
    assert first.count("stopped by SIGTERM after step 6; saved") == 1 and "step 1/12" in first
    assert second == ""  # one of them speaks
    assert sorted(entry.name for entry in (tmp_path / "checkpoints").iterdir()) == ["00000003", "00000006"]
    assert column(tmp_path, "skipped_samples") == [1 + 2] * 6  # by both
    result = lock(tmp_path, mesh=make_mesh(fsdp=4), run={"fsdp": 4})
    assert result.resumed == 6
    kernel = result.state.trainable["trunk"]["kernel"]
    assert {shard.data.shape for shard in kernel.addressable_shards} == {(12, WIDE // 4)}
    same(result, tmp_path, undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize("number", [signal.SIGKILL, -1], ids=["killed", "failed"])
def test_a_lost_process_ends_the_other_and_the_next_start_goes_on(tmp_path, undisturbed, lost, number):
    """The checkpoint of step 3 is complete before that of step 6 is begun, and at step 7 one is lost."""
    ended = finish(start(tmp_path, hit=lost, at=7, number=number, steps=12, fsdp=2))
    (status, said), (left, words) = ended[lost], ended[1 - lost]
    assert status == (-signal.SIGKILL if number > 0 else 1)
    assert said.count("\n" if lost and number < 0 else f"process {lost} of 2") == 1, said
    assert ("was killed, or gave up" if number > 0 else f"process {lost} of 2: no such row") in said
    assert left != 0 and words.count(f"process {1 - lost} of 2") == 1, words
    assert words.count("another one was lost") == 1 and "the last complete checkpoint" in words
    assert "Traceback" not in said + words
    again = finish(start(tmp_path, steps=12, fsdp=2))
    assert [status for status, _ in again] == [0, 0], again
    assert "going on from the checkpoint of step 3" in again[0][1] or "of step 6" in again[0][1]
    same(lock(tmp_path, run={"fsdp": 2}), tmp_path, undisturbed)


@pytest.mark.slow
def test_two_processes_of_two_devices_each(tmp_path, undisturbed):
    ended = finish(start(tmp_path, devices=2, steps=12, fsdp=4))
    assert [status for status, _ in ended] == [0, 0], ended
    assert column(tmp_path, "skipped_samples") == [1 + 2] * 12
    same(lock(tmp_path, run={"fsdp": 2}), tmp_path, undisturbed)
