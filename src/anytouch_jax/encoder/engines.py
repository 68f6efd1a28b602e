"""A touch encoder as an ONNX graph, its int8 form, and the engines that run it (onnxruntime, OpenVINO).

Blocks are written out one after the other and constants are folded, so that engines can fuse them. The network is that
of `nn.touch`.
"""

from __future__ import annotations

import operator
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Literal

import jax
import numpy as np

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, ModelConfig
from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.errors import UserError

Engine = Literal["xla", "onnxruntime", "openvino"]
CALIBRATION = 200  # touches that the ranges of int8 are measured on
OPSET = 20  # the first with Gelu
_BLOCK = "block"  # start of the names of nodes in blocks
_SCALE = 1 / (255 * np.asarray(IMAGENET_STD, np.float64))
_SHIFT = -np.asarray(IMAGENET_MEAN, np.float64) / IMAGENET_STD


@contextmanager
def _needed(package: str) -> Iterator[None]:
    """Turn an import that fails into a UserError that says what to install."""
    try:
        yield
    except ImportError as error:
        raise UserError(f'{error.name} is not installed: pip install "{package}"') from None


class _Graph:
    """Nodes and constants so far. A value is the name of a node's output, a constant, or an input of the graph."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.part = ""

    def __call__(self, kind: str, *inputs: Any, **attributes: Any) -> str:
        """Add a node and return its output. Inputs that are no names are constants, f32 or i64."""
        from onnx import helper

        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        output = f"{self.part}{kind}.{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, names, [output], output, **attributes))
        return output

    def constant(self, value: Any) -> str:
        from onnx import numpy_helper

        value, name = np.asarray(value), f"constant.{len(self.constants)}"
        kind = np.float32 if value.dtype.kind == "f" else np.int64
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value, kind), name))
        return name

    def dense(self, x: str, params: Any) -> str:
        y = self("MatMul", x, params["kernel"])
        return self("Add", y, params["bias"]) if "bias" in params else y

    def norm(self, x: str, params: Any, eps: float) -> str:
        return self("LayerNormalization", x, params["scale"], params["bias"], axis=-1, epsilon=eps)


def touch_graph(params: Any, model: ModelConfig, frames: int, pooling: Pooling = "class") -> bytes:
    """Return an ONNX model of touches u8 (B, T, H, W, 3) and sensor rows i32 (B,) to features f32 (B, E).

    Raises UserError for touches of more than one segment.
    """
    with _needed("anytouch_jax[engines]"):
        from onnx import TensorProto, helper

    if frames not in (1, model.frames):
        raise UserError(f"ONNX is written for touches of 1 or {model.frames} frames, not of {frames}; use --to jax")
    touch, graph, side = jax.tree.map(np.asarray, params["touch"]), _Graph(), model.image_size
    x = _tokens(graph, touch, model, frames)
    x = graph.norm(x, touch["pre_norm"], model.norm_eps) if model.pre_norm else x
    for number in range(model.touch.depth):
        graph.part = f"{_BLOCK}{number}."
        last = number == model.touch.depth - 1
        block = jax.tree.map(operator.itemgetter(number), touch["blocks"])
        x = _block(graph, x, block, model, first=last and pooling == "class")
    graph.part, values = "", []
    if pooling != "mean":
        token = graph("Squeeze", graph("Slice", x, [0], [1], [1]), [1])
        values.append(graph.dense(graph.norm(token, touch["post_norm"], model.norm_eps), touch["projection"]))
    if pooling != "class":
        start = 1 + model.sensor_tokens
        patches = graph("Slice", x, [start], [start + model.patches], [1])
        values.append(graph.dense(graph("ReduceMean", patches, [1], keepdims=0), touch["projection"]))
    graph.nodes.append(helper.make_node("Concat", values, ["features"], "features", axis=-1))
    count = len(values) * model.embed
    about = helper.make_tensor_value_info
    inputs = [about("frames", TensorProto.UINT8, ("B", frames, side, side, 3)), about("sensor", TensorProto.INT32, "B")]
    outputs = [about("features", TensorProto.FLOAT, ("B", count))]
    made = helper.make_graph(graph.nodes, "touch_encoder", inputs, outputs, graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    return bytes(helper.make_model(made, opset_imports=opset, ir_version=10).SerializeToString())


def _tokens(graph: _Graph, touch: Any, model: ModelConfig, frames: int) -> str:
    """Return the input sequence (B, 1 + S + N, D) of pixels (B, T, H, W, 3)."""
    p, n, patch, position = model.patch, model.image_size // model.patch, touch["patch"], touch["position"]
    x = graph("Reshape", "frames", [-1, frames, n, p, n, p, 3])
    x = graph("Transpose", x, perm=[0, 2, 4, 1, 3, 5, 6])
    x = graph("Cast", x, to=1)  # float32
    kernel = np.asarray(patch["kernel"], np.float64)
    kernel = kernel.sum(axis=-3, keepdims=True) if frames == 1 else kernel
    if model.patch_encoder == "convolutional":
        x = _convolutional(graph, patch, kernel, model, graph("Reshape", x, [-1, frames, p, p, 3]))
    else:  # kernels (..., T, P*P*3, D), and normalisation of the pixels is folded into them
        x = graph("Reshape", x, [-1, n * n, frames * p * p * 3])
        each = kernel.reshape(*kernel.shape[:-2], p * p, 3, kernel.shape[-1])
        matrix = (each * _SCALE[:, None]).reshape(*kernel.shape[:-3], -1, kernel.shape[-1])
        bias = (each * _SHIFT[:, None]).sum(axis=(-4, -3, -2))
        if model.patch_encoder == "sensor":
            x = graph("MatMul", x, graph("Gather", graph.constant(matrix), "sensor"))
            x = graph("Add", x, graph("Gather", graph.constant(bias[:, None]), "sensor"))
        else:
            x, position = graph("MatMul", x, matrix), np.concatenate([position[:1], position[1:] + bias])
    x = graph("Add", x, position[1:])
    rows = touch["sensor_tokens"]
    start = np.broadcast_to(touch["class_token"] + position[0], (len(rows), 1, rows.shape[-1]))
    return graph("Concat", graph("Gather", np.concatenate([start, rows], axis=1), "sensor"), x, axis=1)


def _convolutional(graph: _Graph, patch: Any, kernel: np.ndarray, model: ModelConfig, x: str) -> str:
    """Return convolutional patches (B, N, D) of pixels (B * N, T, P, P, 3)."""
    p, frames, few = model.patch, len(kernel), kernel.shape[-1]
    x = graph("Add", graph("Mul", x, _SCALE), _SHIFT)
    x = graph("Reshape", graph("Transpose", x, perm=[0, 1, 4, 2, 3]), [-1, frames * 3, p, p])
    first = kernel.reshape(frames, 5, 5, 3, few).transpose(4, 0, 3, 1, 2).reshape(few, -1, 5, 5)
    second = patch["second"]["kernel"].reshape(3, 3, few, -1).transpose(3, 2, 0, 1)
    for number, weights in enumerate((first, second), 1):
        side = weights.shape[-1]
        x = graph("Conv", x, weights, kernel_shape=[side] * 2, pads=[side // 2] * 4, strides=[2, 2])
        x = graph.norm(graph("Transpose", x, perm=[0, 2, 3, 1]), patch[f"norm{number}"], model.norm_eps)
        x = graph("Gelu", x)
        x = graph("Transpose", x, perm=[0, 3, 1, 2]) if number == 1 else x
    last = patch["last"]
    return graph.dense(graph("Reshape", x, [-1, model.patches, len(last["kernel"])]), last)


def _block(graph: _Graph, x: str, block: Any, model: ModelConfig, *, first: bool) -> str:
    """Return the tokens (B, S, D) after a pre-norm block; of the `first` token alone, (B, 1, D)."""
    width, heads, own = model.touch.width, model.touch.heads, block["attention"]
    normed = graph.norm(x, block["norm1"], model.norm_eps)
    scale, fused = (width // heads) ** -0.5, ("key", "value") if first else ("query", "key", "value")
    own = own | {"query": {name: value * scale for name, value in own["query"].items()}}
    packed = {name: np.concatenate([own[part][name] for part in fused], axis=-1) for name in ("kernel", "bias")}
    packed_out = graph.dense(normed, packed)
    parts = {part: graph("Slice", packed_out, [at * width], [(at + 1) * width], [2]) for at, part in enumerate(fused)}
    if first:
        x = graph("Slice", x, [0], [1], [1])
        parts["query"] = graph.dense(graph("Slice", normed, [0], [1], [1]), own["query"])
    shape, order = [0, 0, heads, width // heads], {"query": [0, 2, 1, 3], "key": [0, 2, 3, 1], "value": [0, 2, 1, 3]}
    q, k, v = (graph("Transpose", graph("Reshape", parts[part], shape), perm=order[part]) for part in order)
    y = graph("MatMul", graph("Softmax", graph("MatMul", q, k), axis=-1), v)
    y = graph("Reshape", graph("Transpose", y, perm=[0, 2, 1, 3]), [0, 0, width])
    x = graph("Add", x, graph.dense(y, own["out"]))
    y = graph.dense(graph.norm(x, block["norm2"], model.norm_eps), block["mlp"]["up"])
    quick = model.activation == "quick_gelu"
    y = graph("Mul", y, graph("Sigmoid", graph("Mul", y, 1.702))) if quick else graph("Gelu", y)
    return graph("Add", x, graph.dense(y, block["mlp"]["down"]))


def quantised(data: bytes, touches: np.ndarray, rows: np.ndarray) -> bytes:
    """Return `touch_graph` with the linear layers of its blocks in int8: weights per channel, activations per tensor.

    The ranges of activations are those on `touches` u8 (200, T, H, W, 3) of sensor `rows` i32 (200,). Weights have 7
    bits, so that sums of two products fit in 16 bits on a CPU without VNNI. The patch projection stays float32: a small
    error of its weights is multiplied by the brightness of the picture. Raises UserError for another number of touches.
    """
    if len(touches) != CALIBRATION:
        raise UserError(f"int8 is calibrated on {CALIBRATION} touches, not on {len(touches)}; give that many")
    with _needed("anytouch_jax[engines]"):
        import onnx
        from onnxruntime import quantization
        from onnxruntime.quantization.quant_utils import add_pre_process_metadata

    parts = zip(np.split(touches, 20), np.split(rows, 20), strict=True)
    given = (dict(zip(("frames", "sensor"), part, strict=True)) for part in parts)
    model = onnx.load_from_string(data)
    add_pre_process_metadata(model)  # there is nothing to fold or fuse before
    constants = {constant.name for constant in model.graph.initializer}
    blocks = [node.name for node in model.graph.node if _BLOCK in node.name and constants & {*node.input[1:2]}]
    reader = SimpleNamespace(get_next=lambda: next(given, None))
    with TemporaryDirectory() as folder:
        out = Path(folder) / "int8.onnx"
        quantization.quantize_static(
            model, out, reader, per_channel=True, reduce_range=True, op_types_to_quantize=["MatMul"],
            nodes_to_quantize=blocks, activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
        )  # fmt: skip
        return out.read_bytes()


def session(data: bytes, engine: Engine = "onnxruntime") -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the function of an ONNX model on an engine: touches u8, sensor rows i32 (B,) to features f32 (B, E).

    It uses every core that the process may use, in float32. Raises UserError for an engine that is not installed.
    """
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if engine == "openvino":
        silenced: dict[str, Any] = {"openvino_telemetry": None}  # it forks, to report what is run
        sys.modules.update(silenced)
        with _needed("openvino"):
            import openvino
        core = openvino.Core()
        settings = {"INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
        model = core.compile_model(core.read_model(data), "CPU", settings)
        return lambda frames, rows: np.asarray(model({"frames": frames, "sensor": rows})["features"])
    with _needed("anytouch_jax[engines]"):
        import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 3
    running = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    return lambda frames, rows: np.asarray(running.run(["features"], {"frames": frames, "sensor": rows})[0])
