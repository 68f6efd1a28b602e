"""Engines that run an ONNX model (onnxruntime, OpenVINO), and its int8 form."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np

from anytouch_jax.batch import FieldOutput
from anytouch_jax.encoder.arrays import Engine as Engine
from anytouch_jax.encoder.arrays import EngineChoice as EngineChoice
from anytouch_jax.errors import UserError
from anytouch_jax.export.graph import BLOCK
from anytouch_jax.export.graph import touch_graph as touch_graph
from anytouch_jax.export.packages import imported as imported
from anytouch_jax.export.packages import needed

CALIBRATION = 200  # touches that the ranges of int8 are measured on
_PARTS = 20  # in which these are given
_QUIET = 3  # onnxruntime's level of errors


def quantised(data: bytes, touches: np.ndarray, rows: np.ndarray) -> bytes:
    """Return `touch_graph` with the linear layers of its blocks in int8.

    Weights are quantised per channel, activations per tensor. Weights have 7 bits, so that sums of
    two products fit in 16 bits on a CPU without VNNI. The patch projection stays float32, because
    brightness multiplies its errors.

    Args:
        data: the model.
        touches: u8 (200, T, H, W, 3), on which ranges are measured.
        rows: i32 (200,), their sensors.

    Raises:
        UserError: another number of touches, or a package that is not installed.
    """
    if len(touches) != CALIBRATION:
        raise UserError(
            f"int8 is calibrated on {CALIBRATION} touches, not on {len(touches)}; give that many"
        )
    with needed("anytouch_jax[engines]"):
        import onnx
        from onnxruntime import quantization
        from onnxruntime.quantization.quant_utils import add_pre_process_metadata

    parts = zip(np.split(touches, _PARTS), np.split(rows, _PARTS), strict=True)
    given = ({"frames": frames, "sensor": sensor} for frames, sensor in parts)
    model = onnx.load_from_string(data)
    # The quantiser warns about a model without this mark. There is nothing to fold or fuse before.
    add_pre_process_metadata(model)
    constants = {constant.name for constant in model.graph.initializer}
    # Products of blocks with a constant: not those of attention, whose factors are both computed.
    linear = [
        node.name
        for node in model.graph.node
        if BLOCK in node.name and constants & {*node.input[1:2]}
    ]
    reader = SimpleNamespace(get_next=lambda: next(given, None))
    with TemporaryDirectory() as folder:
        out = Path(folder) / "int8.onnx"
        quantization.quantize_static(
            model,
            out,
            reader,
            per_channel=True,
            reduce_range=True,
            op_types_to_quantize=["MatMul"],
            nodes_to_quantize=linear,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
        )
        return out.read_bytes()


def session(data: bytes, engine: Engine = "onnxruntime") -> Callable[..., Any]:
    """Return the function of an ONNX model on an engine.

    It takes touches u8 and sensor rows i32 (B,), and returns features f32 (B, E). A model with
    fields takes aspects f32 (B,) too, and returns features and `FieldOutput`. Raises UserError
    without the engine.
    """
    package = imported(engine)
    if engine == "openvino":
        core = package.Core()
        settings = {
            "INFERENCE_NUM_THREADS": _threads(),
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": "f32",
        }
        model = core.compile_model(core.read_model(data), "CPU", settings)
        names = [output.get_any_name() for output in model.outputs]
        return _call(names, lambda given: [np.asarray(value) for value in model(given).values()])
    options = package.SessionOptions()
    options.intra_op_num_threads = _threads()
    options.log_severity_level = _QUIET
    # Threads that spin for work between the frames of a camera take a core from all else.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    running = package.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in running.get_outputs()]
    return _call(names, lambda given: running.run(names, given))


def _threads() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _call(
    names: list[str], run: Callable[[dict[str, np.ndarray]], list[Any]]
) -> Callable[..., Any]:
    """Return the function of a model with these outputs; features are the first."""

    def call(*given: np.ndarray) -> Any:
        values = run(dict(zip(("frames", "sensor", "aspect"), given, strict=False)))
        if len(names) == 1:
            return np.asarray(values[0])
        return values[0], FieldOutput(*values[1:])

    return call
