"""The half of `run.py` that knows ONNX: converts the encoder in a folder, runs it by onnxruntime, compares.

Inputs of the model: touches uint8 RGB (B, T, H, W, 3) and sensor rows int32 (B,); output: features f32 (B, E).
"""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
from jax2onnx import to_onnx
from safetensors import safe_open

from anytouch_jax.config import ModelConfig, from_json
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.weights.tree import nest

TOLERANCE = 1e-4  # of the largest feature


def encoder_of(folder: Path):
    """(touches, sensor) -> features, with the parameters inside."""
    with safe_open(folder / "params.safetensors", framework="numpy") as file:
        model = from_json(file.metadata()["model"], ModelConfig)
        params = nest({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    net = build(replace(model, attention="xla"))  # the form that takes any number of touches

    def encode(touches: jax.Array, sensor: jax.Array) -> jax.Array:
        return net.encode_touch(params, normalise_touch(touches), sensor).astype(jnp.float32)

    return encode


def _is_worth_telling(record: logging.LogRecord) -> bool:
    """Return whether to log a record: not that an inner value has no type, since the result is checked."""
    return not record.getMessage().startswith("The value type for shape ")


def main(folder: Path) -> int:
    with np.load(folder / "cases.npz") as file:
        cases = dict(file)
    counts = sorted(int(name.removeprefix("touches")) for name in cases if name.startswith("touches"))
    shape = cases[f"touches{counts[0]}"].shape[1:]
    inputs = [jax.ShapeDtypeStruct(("B", *shape), jnp.uint8), jax.ShapeDtypeStruct(("B",), jnp.int32)]
    logging.getLogger("onnx_ir.serde").addFilter(_is_worth_telling)
    target, names = str(folder / "model.onnx"), ["touches", "sensor"]
    model = to_onnx(
        encoder_of(folder), inputs=inputs, model_name="touch_encoder", input_names=names, output_names=["features"]
    )
    onnx.save_model(model, target)  # one file: "file" mode puts the parameters into a second one
    onnxruntime.set_default_logger_severity(3)  # not every constant that it finds superfluous
    session = onnxruntime.InferenceSession(target, providers=["CPUExecutionProvider"])
    worst = 0.0
    for count in counts:
        given = (cases[f"touches{count}"], cases[f"sensor{count}"])
        (result,) = session.run(["features"], dict(zip(names, given, strict=True)))
        live = cases[f"features{count}"]
        worst = max(worst, float(np.abs(result - live).max() / np.abs(live).max()))
    print(f"inputs {names}; at most {worst:.1e} of the largest feature from the live model ({counts} touches)")
    return int(not worst <= TOLERANCE)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
