"""The strict ground all tests stand on: four CPU devices, no silent broadcasting, warnings are
errors (pyproject).
"""

import ctypes
import gc
import os
import resource
import sys
from pathlib import Path

# Set before jax is imported; child processes of the tests inherit it. The four devices below they
# do not.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# As the command does: jaxlib 0.10.1 logs a spurious error for a program that it reads from the
# cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax
import pytest

# Tests compile far more than they compute: both together make compilation five times faster. The
# flag is of jax 0.10; another version might not know it, and XLA ends the process for a flag that
# it does not know.
if jax.__version_info__[:2] == (0, 10):
    os.environ["XLA_FLAGS"] = (
        os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"
    )
jax.config.update("jax_disable_most_optimizations", True)
# Tracing makes many objects and no garbage: collecting it as often as usual takes a third of the
# time of tracing.
gc.set_threshold(50_000, 20, 50)

LIBC = ctypes.CDLL(None)
STATM = Path("/proc/self/statm")
ROOT = Path(__file__).resolve().parents[1]
# experiments, tests.parity and the tests' helpers
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]


def pytest_configure(config):
    from program_count import ProgramCount

    config.pluginmanager.register(ProgramCount(), "programs")


jax.config.update("jax_num_cpu_devices", 4)
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory):
    """Compile each program once for all modules, workers and commands, in a folder of this session.

    Nothing is written to the home of whoever runs the tests.
    """
    from anytouch_jax.train.mesh import enable_compilation_cache

    folder = tmp_path_factory.getbasetemp()
    if (
        "PYTEST_XDIST_WORKER" in os.environ
    ):  # workers have folders of their own below that of the session
        folder = folder.parent
    settings = {
        "jax_compilation_cache_dir": None,
        "jax_persistent_cache_min_compile_time_secs": 0.1,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        for name, value in (
            settings | {"jax_compilation_cache_dir": enable_compilation_cache()}
        ).items():
            patch.setenv(name.upper(), str(value))  # for child processes
        yield


@pytest.fixture(scope="module", autouse=True)
def _free_compiled_programs():
    """Drop compiled programs where a worker has grown to 1.2 GB: one that keeps them all grows to
    5.
    """
    yield
    pages = int(STATM.read_text().split()[1]) if STATM.exists() else None
    if pages is not None and pages * resource.getpagesize() < 1.2e9:
        return
    jax.clear_caches()
    gc.collect()
    if hasattr(LIBC, "malloc_trim"):  # of glibc: else free memory stays with the process
        LIBC.malloc_trim(0)


@pytest.fixture(autouse=True)
def _no_other_packages(monkeypatch):
    """Probes have the same controls whether or not a package with an ImageNet network is there."""
    monkeypatch.setattr("anytouch_jax.weights.registry.is_installed", lambda name: False)


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """The manifest of a small world on disk (see runs.py)."""
    from runs import make_world

    return make_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory, world):
    """A run folder of stage 1 after two steps: one of stills, one of clips."""
    from runs import run_config, train

    run = tmp_path_factory.mktemp("tiny") / "stage1"
    train(run_config(world), run, stop_after=2)
    return run
