"""`experiments/onnx_export` but for the converter: in its place stands the very function that it is to convert."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from places import ROOT

from anytouch_jax.config import SENSORS

CONVERTER = """\
#!{python}
import logging, runpy, sys, types
import numpy as np

class Session:
    def __init__(self, target, providers):
        assert open(target, "rb").read() == b"onnx"
    def run(self, names, given):
        return [{factor} * np.asarray(kept[0](given["touches"], given["sensor"]))]

def to_onnx(function, **names):
    kept.append(function)
    for what in ("The value type for shape [1] is not known.", "This matters."):
        logging.getLogger("onnx_ir.serde").warning(what)

kept = []
fakes = dict(
    onnx=dict(save_model=lambda model, target: open(target, "wb").write(b"onnx")),
    onnxruntime=dict(set_default_logger_severity=lambda level: None, InferenceSession=Session),
    jax2onnx=dict(to_onnx=to_onnx),
)
for name, members in fakes.items():
    sys.modules[name] = types.ModuleType(name)
    vars(sys.modules[name]).update(members)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "frames", "same"), [(1.0, 3, True), (1.001, 1, False)])
def test_what_differs_from_the_live_model_is_not_written(tmp_path, tiny_run, factor, frames, same):
    converter, out = tmp_path / "converter", tmp_path / "new" / "encoder.onnx"
    converter.write_text(CONVERTER.format(python=sys.executable, factor=factor))
    converter.chmod(0o755)
    command = [sys.executable, str(ROOT / "experiments" / "onnx_export" / "run.py"), "--run", str(tiny_run)]
    command += ["--out", str(out), "--frames", str(frames), "--python", str(converter)]
    env = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == (0 if same else 1), done.stderr
    assert sorted(file.name for file in out.parent.iterdir()) == ([out.name, f"{out.name}.json"] if same else [])
    if same:
        about = json.loads(out.with_name(f"{out.name}.json").read_text())
        assert about["sensors"]["digit"] == SENSORS.index("digit") and about["frames"] == frames
        assert about["input"].startswith("touches: uint8 RGB") and about["background"] == "keep"
    assert ("nothing is written" in done.stderr) is not same
    assert "This matters" in done.stderr and "The value type" not in done.stderr
    if same:  # a place that cannot be written is named before the work
        command[command.index("--out") + 1] = str(out.parent)
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
        assert (
            done.returncode == 1 and done.stderr == f"onnx_export: {out.parent} is a folder; name a file with --out\n"
        )
