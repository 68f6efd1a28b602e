"""One of several processes that train the toy problem together: a script for the tests, and how
they start it.
"""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
from places import ROOT, SUPPORT
from train_toy import ROWS, toy_batch, toy_config, toy_loss, toy_params

from anytouch_jax.errors import UserError

SRC = ROOT / "src"
WIDE = 8192  # wide enough for the parameters to be cut


def config_of(**run):
    # A small rate: Adam makes a whole step of the sign of a gradient that is only noise.
    return toy_config(optim={"learning_rate": 1e-4}, **run)


def batches_of(index: int, count: int, *, at: int = -1, number: int = 0):
    """The rows of process `index` of every batch, for which it skips `index` + 1 samples.

    Before step `at` it gets the signal `number`, or fails (-1).
    """
    mine = slice(index * ROWS // count, (index + 1) * ROWS // count)

    def batches(start: int, stop: int):
        for step in range(start, stop):
            if step == at and number < 0:
                raise UserError("no such row")
            if step == at:
                os.kill(os.getpid(), number)
            batch = toy_batch(2 * step + 1)  # clips: one program
            yield step, jax.tree.map(lambda part: part[mine], batch), {"skipped_samples": index + 1}

    return batches


def start(
    run_dir: Path,
    count: int = 2,
    *,
    devices: int = 1,
    hit: int = -1,
    at: int = -1,
    number: int = 0,
    **run,
):
    """Start `count` processes that train in `run_dir`; process `hit` gets the signal `number`
    before step `at`.
    """
    settings = json.dumps(
        {"run_dir": str(run_dir), "hit": hit, "at": at, "number": number, "run": run}
    )
    return spawn([__file__, settings], count, devices)


def free_address() -> str:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return f"localhost:{free.getsockname()[1]}"


def spawn(words: list[str], count: int = 2, devices: int = 1, *folders: Path):
    """Start `count` processes of Python that find each other, with the tests' helpers and `folders`
    in their path.
    """
    path = [str(SRC), str(SUPPORT), *map(str, folders), os.environ.get("PYTHONPATH", "")]
    common = os.environ | {
        "PYTHONPATH": os.pathsep.join(path),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "true",
        "JAX_NUM_CPU_DEVICES": str(devices),
        "JAX_COORDINATOR_ADDRESS": free_address(),
        "JAX_NUM_PROCESSES": str(count),
    }
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    places = [common | {"JAX_PROCESS_ID": str(index)} for index in range(count)]
    return [
        subprocess.Popen([sys.executable, *words], env=place, text=True, **pipes)
        for place in places
    ]


def finish(processes, timeout: float = 600):
    """(exit status, error stream) of each, in order."""
    try:
        lines = [process.communicate(timeout=timeout)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, text) for process, text in zip(processes, lines, strict=True)]


def main(run_dir: str, hit: int, at: int, number: int, run: dict) -> None:
    from anytouch_jax.train.loop import fit
    from anytouch_jax.train.mesh import joined

    with joined() as place:
        index = place.index
        fit(
            config_of(**run),
            params=toy_params(WIDE),
            loss_fn=toy_loss,
            batches=batches_of(
                index, jax.process_count(), at=at if index == hit else -1, number=number
            ),
            run_dir=Path(run_dir),
        )


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
