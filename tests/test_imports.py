"""Importing the package changes nothing in the process: settings wait for the first use."""

import json
import subprocess
import sys

from places import ROOT

PACKAGE = ROOT / "src" / "anytouch_jax"
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in PACKAGE.rglob("*.py")
    if path.name != "__main__.py"  # it runs the command
)

# Other packages change warnings and signals when they are imported. So the modules of ours are
# imported twice: the second time, after ours alone were forgotten, only we can change something.
SCRIPT = """
    import importlib, json, os, signal, sys, threading, warnings

    modules = json.loads(sys.argv[1])

    def state():
        import cv2
        handlers = [signal.getsignal(number) for number in signal.valid_signals()]
        return {
            "excepthook": repr(sys.excepthook),
            "threads of cv2": cv2.getNumThreads(),
            "log level of cv2": cv2.getLogLevel() if hasattr(cv2, "getLogLevel") else None,
            "warnings": [repr(one) for one in warnings.filters],
            "signals": [repr(one) for one in handlers],
            "environment": dict(os.environ),
            "own threads": sorted(one.name for one in threading.enumerate()),
            "hooks of forks": len(hooks),
        }

    hooks = []
    register = os.register_at_fork

    def counted(**them):
        hooks.append(them)
        register(**them)

    def load():
        missing = []
        for module in modules:
            try:
                importlib.import_module(module)
            except ModuleNotFoundError as error:
                if (error.name or "").startswith("anytouch_jax"):
                    raise
                missing.append(error.name)
        return missing

    missing = load()
    for name in [name for name in sys.modules if name.partition(".")[0] == "anytouch_jax"]:
        del sys.modules[name]
    import cv2
    cv2.setNumThreads(3)
    if hasattr(cv2, "setLogLevel"):
        cv2.setLogLevel(4)
    sys.excepthook = sys.__excepthook__
    warnings.resetwarnings()
    os.environ.pop("OPENCV_FFMPEG_LOGLEVEL", None)
    os.register_at_fork = counted
    before = state()
    assert load() == missing
    after = state()
    print(json.dumps([before, after, missing]))
"""


def ran(code: str, *words: str) -> str:
    lines = "\n".join(line.removeprefix("    ") for line in code.splitlines())
    done = subprocess.run(
        [sys.executable, "-c", lines, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_an_import_of_any_module_leaves_the_process_as_it_was() -> None:
    before, after, _ = json.loads(ran(SCRIPT, json.dumps(MODULES)).splitlines()[-1])
    assert after == before


def test_the_first_use_sets_opencv_up() -> None:
    code = """
    import cv2, numpy as np
    from anytouch_jax.data.images import decode_bytes
    cv2.setNumThreads(3)
    data = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    decode_bytes(data, "x")
    assert cv2.getNumThreads() == 1
    """
    ran(code)


FORKS = """
    import os, sys, warnings
    warnings.simplefilter("ignore")
    import jax, jax.numpy as jnp
    from anytouch_jax.errors import UserError, refuse_forked

    def answer(computes):
        if computes:
            (jnp.ones(3) + 1).block_until_ready()
        try:
            refuse_forked()
        except UserError as error:
            return "refused" if "spawn" in str(error) else "?"
        (jnp.ones(3) + 1).block_until_ready()
        return "computes"

    def forked(computes=False):
        read, write = os.pipe()
        if not os.fork():
            os.write(write, answer(computes).encode())
            os._exit(0)
        os.wait()
        return os.read(read, 99).decode()

    order = sys.argv[1]
    if order == "fresh":
        print(forked(), forked(computes=True))
    if order == "ours first":
        refuse_forked()
        jnp.ones(3).block_until_ready()
        print(forked())
    if order == "theirs alone":
        jnp.ones(3).block_until_ready()
        print(forked())
"""


def test_a_fork_is_found_though_nothing_watched_when_the_package_was_imported() -> None:
    assert ran(FORKS, "fresh").split() == ["computes", "computes"]
    assert ran(FORKS, "ours first").split() == ["refused"]
    assert ran(FORKS, "theirs alone").split() == ["refused"]
