"""A touch encoder (`nn.touch`) as an ONNX graph, its int8 form, and its engines (onnxruntime, OpenVINO).

Blocks are written out one after the other and constants are folded, so that engines can fuse them.
"""

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
from anytouch_jax.nn.sight import BLOCKS, READ, STEM, UNTOUCHED
from anytouch_jax.ops.fields import FORCE, HALF, LENGTH, STATES, STRESS, TORQUE, FieldOutput

Engine = Literal["xla", "onnxruntime", "openvino"]
EngineChoice = Engine | Literal["auto"]
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

    If `params` have fields, it takes aspects f32 (B,) too and returns `FieldOutput`. UserError for several segments.
    """
    with _needed("anytouch_jax[engines]"):
        from onnx import TensorProto, helper

    if frames not in (1, model.frames):
        raise UserError(f"ONNX is written for touches of 1 or {model.frames} frames, not of {frames}; use --to jax")
    touch, graph, side = jax.tree.map(np.asarray, params["touch"]), _Graph(), model.image_size
    x = _tokens(graph, touch, model, frames)
    x = graph.norm(x, touch["pre_norm"], model.norm_eps) if model.pre_norm else x
    depth, measures = model.touch.depth, "fields" in params
    read, states = [round(number * depth / (STATES - 1)) for number in range(STATES)], [x]
    for number in range(depth):
        graph.part = f"{_BLOCK}{number}."
        last = number == depth - 1
        block = jax.tree.map(operator.itemgetter(number), touch["blocks"])
        x = _block(graph, x, block, model, first=last and pooling == "class" and not measures)
        states += [x] * read.count(number + 1)
    graph.part, values = "", []
    if pooling != "mean":
        token = graph("Squeeze", graph("Slice", x, [0], [1], [1]), [1])
        values.append(graph.dense(graph.norm(token, touch["post_norm"], model.norm_eps), touch["projection"]))
    if pooling != "class":
        start = 1 + model.sensor_tokens
        patches = graph("Slice", x, [start], [start + model.patches], [1])
        values.append(graph.dense(graph("ReduceMean", patches, [1], keepdims=0), touch["projection"]))
    count = len(values) * model.embed + model.sight
    if model.sight:
        values.append(_sight(graph, touch["sight"], frames))
    graph.nodes.append(helper.make_node("Concat", values, ["features"], "features", axis=-1))
    about = helper.make_tensor_value_info
    inputs = [about("frames", TensorProto.UINT8, ("B", frames, side, side, 3)), about("sensor", TensorProto.INT32, "B")]
    outputs = [about("features", TensorProto.FLOAT, ("B", count))]
    if measures:
        inputs.append(about("aspect", TensorProto.FLOAT, "B"))
        shapes = _fields(graph, jax.tree.map(np.asarray, params["fields"]), model, frames, states)
        outputs += [about(name, TensorProto.FLOAT, ("B", *shape)) for name, shape in shapes.items()]
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
    # Kernels are (..., T, P*P*3, D), and normalisation of the pixels is folded into them.
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


def _sight(graph: _Graph, own: Any, frames: int) -> str:
    """Return the values (B, model.sight) of `nn.sight.Sight` for the last frame of pixels (B, T, H, W, 3)."""
    x = graph("Squeeze", graph("Slice", "frames", [frames - 1], [frames], [1]), [1])
    x = graph("Sub", graph("Mul", graph("Cast", x, to=1), np.float32(1 / UNTOUCHED)), np.float32(1))
    x = graph("Transpose", x, perm=[0, 3, 1, 2])

    def convolved(x: str, part: Any, side: int, stride: int, group: int = 1) -> str:
        kernel = part["kernel"].reshape(side, side, -1, part["kernel"].shape[-1]).transpose(3, 2, 0, 1)
        settings: dict[str, Any] = {"kernel_shape": [side] * 2, "pads": [side // 2] * 4, "strides": [stride] * 2}
        return graph("Conv", x, kernel, part["bias"], group=group, **settings)

    def clipped(x: str) -> str:
        return graph("Clip", x, np.float32(0), np.float32(6))

    x, means = clipped(convolved(x, own["stem"], 3, 2)), []
    for number, form in enumerate(BLOCKS):
        block, inside = own[f"block{number}"], x
        if "wide" in block:
            inside = clipped(convolved(inside, block["wide"], 1, 1))
        inside = clipped(convolved(inside, block["depth"], form.side, form.stride, form.inside))
        y = convolved(inside, block["narrow"], 1, 1)
        # The first block has other channels than its input, and so has each with a stride.
        before = BLOCKS[number - 1].outputs if number else STEM
        x = graph("Add", x, y) if form.stride == 1 and form.outputs == before else y
        if number in READ:
            means.append(graph("ReduceMean", x, [2, 3], keepdims=0))
    return graph.dense(graph("Concat", *means, axis=-1), own["read"])


def _fields(graph: _Graph, own: Any, model: ModelConfig, frames: int, states: list[str]) -> dict[str, tuple[int, ...]]:
    """Add the outputs of `nn.fields.FieldDecoder` from states (B, 1 + S + N, D), and return their shapes."""
    from onnx import helper

    half, grid, eps = model.image_size // HALF, model.image_size // model.patch, model.norm_eps

    def convolved(x: str, name: str, stride: int = 1) -> str:
        part = own[name]
        if "norm" in part:
            x = graph("Gelu", graph.norm(x, part["norm"], eps))
        count, outputs = part["kernel"].shape
        inputs = len(part["norm"]["scale"]) if "norm" in part else 6
        side = round((count // inputs) ** 0.5)
        kernel = part["kernel"].reshape(side, side, inputs, outputs).transpose(3, 2, 0, 1)
        settings: dict[str, Any] = {"kernel_shape": [side] * 2, "pads": [side // 2] * 4, "strides": [stride] * 2}
        x = graph("Conv", graph("Transpose", x, perm=[0, 3, 1, 2]), kernel, part["bias"], **settings)
        return graph("Transpose", x, perm=[0, 2, 3, 1])

    def resized(x: str, factor: float) -> str:
        x = graph("Transpose", x, perm=[0, 3, 1, 2])
        x = graph("Resize", x, "", [1.0, 1.0, factor, factor], mode="linear")
        return graph("Transpose", x, perm=[0, 2, 3, 1])

    def refined(x: str, *names: str) -> str:
        for name in names:
            x = graph("Add", x, convolved(x, name))
        return x

    clip = graph("Cast", "frames", to=1)  # float32
    last, first = (graph("Squeeze", graph("Slice", clip, [at], [at + 1], [1]), [1]) for at in (frames - 1, 0))
    change = graph("Mul", graph("Sub", last, first), _SCALE)
    sharp = convolved(graph("Concat", graph("Add", graph("Mul", last, _SCALE), _SHIFT), change, axis=-1), "stem", 2)
    x = convolved(sharp, "down", 2)
    joined, start = graph("Concat", *states, axis=-1), 1 + model.sensor_tokens
    aspect = graph("Unsqueeze", "aspect", [1])
    tokens = graph.dense(graph("Slice", joined, [start], [start + model.patches], [1]), own["read"])
    tokens = graph("Add", tokens, graph("Unsqueeze", graph.dense(aspect, own["aspect"]), [1]))
    coarse = graph("Reshape", tokens, [-1, grid, grid, own["read"]["kernel"].shape[1]])
    quarter, eighth = (half + 1) // 2, (half + 3) // 4
    x = convolved(graph("Concat", resized(coarse, quarter / grid), x, axis=-1), "middle1")
    x = refined(x, "middle2")
    deep = refined(convolved(x, "deep", 2), "deep1", "deep2")
    light = graph.dense(graph("Gelu", graph("ReduceMean", deep, [1, 2], keepdims=1)), own["light"])
    deep = refined(graph("Add", deep, light), "deep3", "deep4")
    x = graph("Add", x, resized(graph.dense(graph("Gelu", deep), own["up"]), quarter / eighth))
    pooled = graph("ReduceMean", x, [1, 2], keepdims=0)
    x = refined(convolved(graph("Concat", resized(x, half / quarter), sharp, axis=-1), "fine1"), "fine2")
    maps = graph.dense(graph("Gelu", x), own["maps"])
    token = graph("Squeeze", graph("Slice", joined, [0], [1], [1]), [1])
    whole = graph.dense(graph("Concat", token, pooled, axis=-1), own["whole"]["up"])
    whole = graph.dense(graph("Gelu", whole), own["whole"]["down"])

    def part(x: str, at: int, axis: int) -> str:
        return graph("Squeeze", graph("Slice", x, [at], [at + 1], [axis]), [axis])

    pressure = graph("Mul", graph("Softplus", part(maps, 4, 3)), graph("Sigmoid", part(maps, 3, 3)))
    pressure = graph("Mul", pressure, STRESS)
    normal = graph("Mul", graph("ReduceMean", pressure, [1, 2], keepdims=0), graph("Exp", "aspect"))
    sideways = graph("Mul", graph("Slice", whole, [0], [2], [1]), FORCE)
    made = (
        graph("Mul", part(maps, 0, 3), LENGTH), graph("Mul", graph("Slice", maps, [1], [3], [3]), LENGTH),
        part(maps, 3, 3), pressure, part(maps, 5, 3), part(maps, 6, 3),
        graph("Concat", sideways, graph("Unsqueeze", normal, [1]), axis=1),
        graph("Mul", part(whole, 2, 1), TORQUE), part(whole, 3, 1), graph("Slice", whole, [4], [6], [1]),
        part(whole, 6, 1), part(whole, 7, 1),
    )  # fmt: skip
    values = dict(zip(FieldOutput._fields, made, strict=True))
    graph.nodes += [helper.make_node("Identity", [value], [name], name) for name, value in values.items()]
    flat = dict.fromkeys(("depth", "contact", "pressure", "depth_log", "shear_log"), (half, half))
    shapes: dict[str, tuple[int, ...]] = {**flat, "shear": (half, half, 2), "force": (3,), "force_log": (2,)}
    return {name: shapes.get(name, ()) for name in values}


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

    Ranges are those on `touches` u8 (200, T, H, W, 3) of sensor `rows` i32 (200,). Weights have 7 bits, so that sums of
    two products fit in 16 bits on a CPU without VNNI. The patch projection stays float32: brightness multiplies its
    errors. Raises UserError for another number of touches.
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


def imported(engine: Engine) -> Any:
    """Return the package of an engine. Raises UserError if it is not installed."""
    if engine == "openvino":
        silenced: dict[str, Any] = {"openvino_telemetry": None}  # it forks, to report what is run
        sys.modules.update(silenced)
        with _needed("openvino"):
            import openvino

            return openvino
    with _needed("anytouch_jax[engines]"):
        import onnxruntime

        return onnxruntime


def session(data: bytes, engine: Engine = "onnxruntime") -> Callable[..., Any]:
    """Return the function of an ONNX model on an engine: touches u8, sensor rows i32 (B,) to features f32 (B, E).

    A model with fields takes aspects f32 (B,) too, and returns `FieldOutput`. UserError without the engine.
    """
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    package = imported(engine)
    if engine == "openvino":
        core = package.Core()
        settings = {"INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
        model = core.compile_model(core.read_model(data), "CPU", settings)
        names = [output.get_any_name() for output in model.outputs]
        return _call(names, lambda given: [np.asarray(value) for value in model(given).values()])
    options = package.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 3
    # Threads that spin for work between the frames of a camera take a core from all else.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    running = package.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in running.get_outputs()]
    return _call(names, lambda given: running.run(names, given))


def _call(names: list[str], run: Callable[[dict[str, np.ndarray]], list[Any]]) -> Callable[..., Any]:
    """Return the function of a model with these outputs; features are the first."""

    def call(*given: np.ndarray) -> Any:
        values = run(dict(zip(("frames", "sensor", "aspect"), given, strict=False)))
        return np.asarray(values[0]) if len(names) == 1 else (values[0], FieldOutput(*values[1:]))

    return call
