"""ONNX graphs of the touch encoder (`nn.touch`) and of the decoder of fields (`fields.module`).

The layers are written out by hand from the parameters. Blocks follow one after the other and
constants are folded, so that engines can fuse them: a graph that is converted from a trace keeps
the loop over blocks, which no engine fuses.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, ModelConfig
from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.errors import UserError
from anytouch_jax.export.packages import needed
from anytouch_jax.fields.outputs import (
    DIFFERENCE,
    FORCE,
    HALF,
    LENGTH,
    STATES,
    STRESS,
    TORQUE,
    TOUCHED_BORDER,
)
from anytouch_jax.fields.poisson import border, inverse_spectrum, transforms

OPSET = 20  # the first with Gelu
BLOCK = "block"  # start of the names of nodes in blocks
_FLOAT32 = 1  # ONNX's number of the type
# Pixels 0 to 255 are normalised as (pixel / 255 - mean) / std = pixel * _SCALE + _SHIFT.
_SCALE = 1 / (255 * np.asarray(IMAGENET_STD, np.float64))
_SHIFT = -np.asarray(IMAGENET_MEAN, np.float64) / IMAGENET_STD


class Graph:
    """Nodes and constants so far.

    A value is the name of a node's output, a constant, or an input of the graph.
    """

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.part = ""  # start of the names of the nodes to come

    def __call__(self, kind: str, *inputs: Any, **attributes: Any) -> str:
        """Add a node and return its output. Inputs that are no names are constants, f32 or i64."""
        from onnx import helper

        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        output = f"{self.part}{kind}.{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, names, [output], output, **attributes))
        return output

    def name_output(self, value: str, name: str) -> None:
        """Give a value the name of an output of the graph."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [value], [name], name))

    def constant(self, value: Any) -> str:
        """Add a constant, f32 or i64, and return its name."""
        from onnx import numpy_helper

        value = np.asarray(value)
        name = f"constant.{len(self.constants)}"
        kind = np.float32 if value.dtype.kind == "f" else np.int64
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value, kind), name))
        return name

    def dense(self, x: str, params: Any) -> str:
        """Add a linear layer with or without a bias."""
        y = self("MatMul", x, params["kernel"])
        if "bias" in params:
            return self("Add", y, params["bias"])
        return y

    def norm(self, x: str, params: Any, eps: float) -> str:
        """Add a layer norm over the last axis."""
        return self("LayerNormalization", x, params["scale"], params["bias"], axis=-1, epsilon=eps)

    def part_of(self, x: str, start: int, stop: int, axis: int) -> str:
        """Take places from `start` to `stop` of an axis.

        Args:
            x: name of an array.
            start: first place.
            stop: place after the last.
            axis: whose places they are.
        """
        return self("Slice", x, [start], [stop], [axis])

    def one_of(self, x: str, at: int, axis: int) -> str:
        """Take one place of an axis, which vanishes."""
        return self("Squeeze", self.part_of(x, at, at + 1, axis), [axis])


def touch_graph(params: Any, model: ModelConfig, frames: int, pooling: Pooling = "class") -> bytes:
    """Return an ONNX model of a touch encoder.

    It takes touches u8 (B, T, H, W, 3) and sensor rows i32 (B,), and returns features f32 (B, E).
    If `params` have fields, it takes aspects f32 (B,) too and returns `FieldOutput`.

    Args:
        params: those of the touch encoder, and of fields.
        model: their form.
        frames: T, 1 or that of the model's clips.
        pooling: see `Encoder.encode_touch`.

    Raises:
        UserError: several segments, or a package that is not installed.
    """
    with needed("anytouch_jax[engines]"):
        from onnx import TensorProto, helper

    if frames not in (1, model.frames):
        raise UserError(
            f"ONNX is written for touches of 1 or {model.frames} frames, not of {frames}; use --to "
            "jax"
        )
    touch = jax.tree.map(np.asarray, params["touch"])
    measures = "fields" in params
    graph = Graph()
    x = _tokens(graph, touch, model, frames)
    if model.pre_norm:
        x = graph.norm(x, touch["pre_norm"], model.norm_eps)
    states = _blocks(graph, x, touch, model, only_class=pooling == "class" and not measures)
    values = _pooled(graph, states[-1], touch, model, pooling)
    width = len(values) * model.embed + model.sight
    if model.sight:
        values.append(_sight(graph, touch["sight"], frames))
    graph.nodes.append(helper.make_node("Concat", values, ["features"], "features", axis=-1))

    side = model.image_size
    about = helper.make_tensor_value_info
    inputs = [
        about("frames", TensorProto.UINT8, ("B", frames, side, side, 3)),
        about("sensor", TensorProto.INT32, "B"),
    ]
    outputs = [about("features", TensorProto.FLOAT, ("B", width))]
    if measures:
        inputs.append(about("aspect", TensorProto.FLOAT, "B"))
        own = jax.tree.map(np.asarray, params["fields"])
        read = [
            states[round(number * model.touch.depth / (STATES - 1))] for number in range(STATES)
        ]
        shapes = _FieldGraph(graph, own, model, frames).add(read)
        outputs += [about(name, TensorProto.FLOAT, ("B", *shape)) for name, shape in shapes.items()]
    made = helper.make_graph(graph.nodes, "touch_encoder", inputs, outputs, graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    return bytes(helper.make_model(made, opset_imports=opset, ir_version=10).SerializeToString())


def _tokens(graph: Graph, touch: Any, model: ModelConfig, frames: int) -> str:
    """Return the input sequence (B, 1 + S + N, D) of pixels (B, T, H, W, 3)."""
    p = model.patch
    n = model.image_size // model.patch
    patch = touch["patch"]
    position = touch["position"]
    x = graph("Reshape", "frames", [-1, frames, n, p, n, p, 3])
    x = graph("Transpose", x, perm=[0, 2, 4, 1, 3, 5, 6])
    x = graph("Cast", x, to=_FLOAT32)
    x = graph("Reshape", x, [-1, n * n, frames * p * p * 3])
    # Kernels are (..., T, P*P*3, D). A still is the same frame three times, so its kernel is the
    # sum of the three.
    kernel = np.asarray(patch["kernel"], np.float64)
    if frames == 1:
        kernel = kernel.sum(axis=-3, keepdims=True)
    # The normalisation of pixels is folded into the kernel and the positions.
    each = kernel.reshape(*kernel.shape[:-2], p * p, 3, kernel.shape[-1])
    matrix = (each * _SCALE[:, None]).reshape(*kernel.shape[:-3], -1, kernel.shape[-1])
    bias = (each * _SHIFT[:, None]).sum(axis=(-4, -3, -2))
    if model.patch_encoder == "sensor":  # one kernel a sensor (T3)
        x = graph("MatMul", x, graph("Gather", graph.constant(matrix), "sensor"))
        x = graph("Add", x, graph("Gather", graph.constant(bias[:, None]), "sensor"))
    else:
        x = graph("MatMul", x, matrix)
        position = np.concatenate([position[:1], position[1:] + bias])
    x = graph("Add", x, position[1:])
    rows = touch["sensor_tokens"]
    start = np.broadcast_to(touch["class_token"] + position[0], (len(rows), 1, rows.shape[-1]))
    table = np.concatenate([start, rows], axis=1)
    return graph("Concat", graph("Gather", table, "sensor"), x, axis=1)


def _blocks(graph: Graph, x: str, touch: Any, model: ModelConfig, *, only_class: bool) -> list[str]:
    """Return the tokens before the first block and after each.

    With `only_class` the last block gives the class token alone, because nothing reads the others.
    """
    states = [x]
    for number in range(model.touch.depth):
        graph.part = f"{BLOCK}{number}."
        # Blocks are stacked along the first axis of their parameters.
        block = jax.tree.map(operator.itemgetter(number), touch["blocks"])
        is_last = number == model.touch.depth - 1
        x = _block(graph, x, block, model, first=is_last and only_class)
        states.append(x)
    graph.part = ""
    return states


def _pooled(graph: Graph, x: str, touch: Any, model: ModelConfig, pooling: Pooling) -> list[str]:
    """Return the features of tokens (B, S, D), class token before mean."""
    values = []
    if pooling != "mean":
        token = graph.one_of(x, 0, 1)
        normed = graph.norm(token, touch["post_norm"], model.norm_eps)
        values.append(graph.dense(normed, touch["projection"]))
    if pooling != "class":
        start = 1 + model.sensor_tokens
        patches = graph.part_of(x, start, start + model.patches, 1)
        mean = graph("ReduceMean", patches, [1], keepdims=0)
        values.append(graph.dense(mean, touch["projection"]))
    return values


def _block(graph: Graph, x: str, block: Any, model: ModelConfig, *, first: bool) -> str:
    """Return the tokens (B, S, D) after a pre-norm block; of the `first` token alone, (B, 1, D)."""
    width = model.touch.width
    heads = model.touch.heads
    own = block["attention"]
    normed = graph.norm(x, block["norm1"], model.norm_eps)
    # The scale of the logits is folded into the projection of queries.
    scale = (width // heads) ** -0.5
    own = own | {"query": {name: value * scale for name, value in own["query"].items()}}
    # One product for all projections of the same tokens.
    fused = ("key", "value") if first else ("query", "key", "value")
    packed = {
        name: np.concatenate([own[part][name] for part in fused], axis=-1)
        for name in ("kernel", "bias")
    }
    projected = graph.dense(normed, packed)
    parts = {
        part: graph.part_of(projected, at * width, (at + 1) * width, 2)
        for at, part in enumerate(fused)
    }
    if first:
        x = graph.part_of(x, 0, 1, 1)
        parts["query"] = graph.dense(graph.part_of(normed, 0, 1, 1), own["query"])
    # Keys are transposed for the product with queries.
    orders = {"query": [0, 2, 1, 3], "key": [0, 2, 3, 1], "value": [0, 2, 1, 3]}
    split = {}
    for part, order in orders.items():
        by_head = graph("Reshape", parts[part], [0, 0, heads, width // heads])
        split[part] = graph("Transpose", by_head, perm=order)
    weights = graph("Softmax", graph("MatMul", split["query"], split["key"]), axis=-1)
    y = graph("MatMul", weights, split["value"])
    y = graph("Reshape", graph("Transpose", y, perm=[0, 2, 1, 3]), [0, 0, width])
    x = graph("Add", x, graph.dense(y, own["out"]))
    y = graph.dense(graph.norm(x, block["norm2"], model.norm_eps), block["mlp"]["up"])
    if model.activation == "quick_gelu":
        y = graph("Mul", y, graph("Sigmoid", graph("Mul", y, 1.702)))
    else:
        y = graph("Gelu", y)
    return graph("Add", x, graph.dense(y, block["mlp"]["down"]))


def _sight(graph: Graph, own: Any, frames: int) -> str:
    """Return the values (B, model.sight) of the trunk (`nn.sight.Sight`) for the last frame."""
    # Here, because an artefact is loaded without the code of the network.
    from anytouch_jax.nn.sight import BLOCKS, MIDDLE, RANGE, READ

    graph.part = "sight."
    x = graph("Cast", graph.one_of("frames", frames - 1, 1), to=_FLOAT32)
    x = graph("Div", graph("Sub", x, float(MIDDLE)), float(RANGE))
    x = graph("Transpose", x, perm=[0, 3, 1, 2])
    x = _clipped(graph, _same_convolution(graph, x, own["trunk"]["stem"], 3, 2))
    means = []
    for number, form in enumerate(BLOCKS):
        block = own["trunk"][f"block{number}"]
        y = x
        if "wide" in block:
            y = _clipped(graph, _same_convolution(graph, y, block["wide"], 1, 1))
        y = _same_convolution(graph, y, block["depth"], form.side, form.stride, form.inside)
        y = _same_convolution(graph, _clipped(graph, y), block["narrow"], 1, 1)
        is_residual = form.stride == 1 and number and form.outputs == BLOCKS[number - 1].outputs
        x = graph("Add", x, y) if is_residual else y
        if number in READ:
            means.append(graph("ReduceMean", x, [2, 3], keepdims=0))
    values = graph.dense(graph("Concat", *means, axis=-1), own["read"])
    graph.part = ""
    return values


def _same_convolution(
    graph: Graph, x: str, part: Any, side: int, stride: int, groups: int = 1
) -> str:
    """Add a convolution of maps (B, C, H, W), padded as in `nn.sight`."""
    kernel = part["kernel"].reshape(side, side, -1, part["kernel"].shape[-1])
    return graph(
        "Conv",
        x,
        kernel.transpose(3, 2, 0, 1),
        part["bias"],
        kernel_shape=[side] * 2,
        auto_pad="SAME_UPPER",
        strides=[stride] * 2,
        group=groups,
    )


def _clipped(graph: Graph, x: str) -> str:
    return graph("Clip", x, 0.0, 6.0)


class _FieldGraph:
    """The decoder of fields (`fields.module.FieldDecoder`) as nodes of a graph, layer by layer."""

    def __init__(self, graph: Graph, own: Any, model: ModelConfig, frames: int) -> None:
        self._graph = graph
        self._own = own
        self._model = model
        self._frames = frames
        self._half = model.image_size // HALF

    def add(self, states: Sequence[str]) -> dict[str, tuple[int, ...]]:
        """Add the outputs from states (B, 1 + S + N, D), and return their shapes."""
        graph = self._graph
        half = self._half
        quarter = (half + 1) // 2
        sharp = self._sharp()
        x = self._convolved(sharp, "down", 2)
        joined = graph("Concat", *states, axis=-1)
        coarse = self._coarse(joined)
        grid = self._model.image_size // self._model.patch
        resized = self._resized(coarse, quarter / grid)
        x = self._convolved(graph("Concat", resized, x, axis=-1), "middle1")
        x = self._refined(x, "middle2")
        x = self._with_deep(x)
        pooled = graph("ReduceMean", x, [1, 2], keepdims=0)
        resized = self._resized(x, half / quarter)
        x = self._convolved(graph("Concat", resized, sharp, axis=-1), "fine1")
        x = graph("Gelu", self._refined(x, "fine2"))
        token = graph.one_of(joined, 0, 1)
        whole = graph.dense(graph("Concat", token, pooled, axis=-1), self._own["whole"]["up"])
        whole = graph.dense(graph("Gelu", whole), self._own["whole"]["down"])
        return self._name_outputs(x, whole)

    def _sharp(self) -> str:
        """Return the finest features (B, H / 2, W / 2, C) of the last frame and its change."""
        graph = self._graph
        clip = graph("Cast", "frames", to=_FLOAT32)
        last = graph.one_of(clip, self._frames - 1, 1)
        first = graph.one_of(clip, 0, 1)
        change = graph("Mul", graph("Sub", last, first), _SCALE)
        normalised = graph("Add", graph("Mul", last, _SCALE), _SHIFT)
        return self._convolved(graph("Concat", normalised, change, axis=-1), "stem", 2)

    def _coarse(self, joined: str) -> str:
        """Return the patch tokens of all states as a map (B, h, w, C)."""
        graph = self._graph
        model = self._model
        read = self._own["read"]
        aspect = graph("Unsqueeze", "aspect", [1])
        start = 1 + model.sensor_tokens
        tokens = graph.dense(graph.part_of(joined, start, start + model.patches, 1), read)
        of_aspect = graph("Unsqueeze", graph.dense(aspect, self._own["aspect"]), [1])
        tokens = graph("Add", tokens, of_aspect)
        grid = model.image_size // model.patch
        return graph("Reshape", tokens, [-1, grid, grid, read["kernel"].shape[1]])

    def _with_deep(self, x: str) -> str:
        """Return the map with what a grid of an eighth sees: slopes add up over the contact."""
        graph = self._graph
        quarter = (self._half + 1) // 2
        eighth = (self._half + 3) // 4
        deep = self._refined(self._convolved(x, "deep", 2), "deep1", "deep2")
        # The whole image shows the lights of the unit.
        mean = graph("ReduceMean", deep, [1, 2], keepdims=1)
        light = graph.dense(graph("Gelu", mean), self._own["light"])
        deep = self._refined(graph("Add", deep, light), "deep3", "deep4")
        up = graph.dense(graph("Gelu", deep), self._own["up"])
        return graph("Add", x, self._resized(up, quarter / eighth))

    def _filled(self, slope: str, maps: str) -> str:
        """Return the depth (B, h, w) whose gradient is `slope` (`fields.module._filled`)."""
        graph = self._graph
        half = self._half
        values, divergence, _ = transforms(half)
        # Batches of matrices (B, h, w): rows are products from the left, columns from the right.
        across = graph("MatMul", graph("MatMul", values, graph.one_of(slope, 0, 3)), divergence.T)
        down = graph("MatMul", graph("MatMul", divergence, graph.one_of(slope, 1, 3)), values.T)
        spectrum = graph("Mul", graph("Add", across, down), inverse_spectrum(half, half))
        rise = graph("MatMul", graph("MatMul", values.T, spectrum), values)
        touched = graph("Neg", graph.one_of(maps, 3, 3))
        free = graph("Add", graph("Sigmoid", touched), TOUCHED_BORDER)
        weight = graph("Mul", free, border(half, half))
        missing = graph("Mul", weight, graph("Sub", graph.one_of(maps, 0, 3), rise))
        total = graph("ReduceSum", missing, [1, 2], keepdims=1)
        level = graph("Div", total, graph("ReduceSum", weight, [1, 2], keepdims=1))
        return graph("Add", rise, level)

    def _name_outputs(self, x: str, whole: str) -> dict[str, tuple[int, ...]]:
        """Name the outputs as `FieldOutput` does, and return their shapes.

        `x` are the finest features.
        """
        graph = self._graph
        maps = graph.dense(x, self._own["maps"])
        slope = self._convolved(x, "slope")
        differences = graph("Mul", graph.part_of(slope, 0, 2, 3), DIFFERENCE)
        depth = self._filled(differences, maps)
        press = graph("Concat", x, graph("Unsqueeze", depth, [3]), axis=-1)
        press = graph("Gelu", graph.dense(press, self._own["press"]["up"]))
        press = graph.dense(press, self._own["press"]["down"])
        contact = graph("Add", graph.one_of(maps, 3, 3), graph.one_of(press, 0, 3))
        strength = graph("Add", graph.one_of(maps, 4, 3), graph.one_of(press, 1, 3))
        pressure = graph("Mul", graph("Softplus", strength), graph("Sigmoid", contact))
        pressure = graph("Mul", pressure, STRESS)
        # The normal force is the integral of the pressure: there is none without contact.
        mean = graph("ReduceMean", pressure, [1, 2], keepdims=0)
        normal = graph("Mul", mean, graph("Exp", "aspect"))
        sideways = graph("Mul", graph.part_of(whole, 0, 2, 1), FORCE)
        # In the order of `FieldOutput`: a session takes outputs by their place.
        out = {
            "depth": graph("Mul", depth, LENGTH),
            "shear": graph("Mul", graph.part_of(maps, 1, 3, 3), LENGTH),
            "contact": contact,
            "pressure": pressure,
            "depth_log": graph.one_of(maps, 5, 3),
            "shear_log": graph.one_of(maps, 6, 3),
            "force": graph("Concat", sideways, graph("Unsqueeze", normal, [1]), axis=1),
            "torque": graph("Mul", graph.one_of(whole, 2, 1), TORQUE),
            "slip": graph.one_of(whole, 3, 1),
            "force_log": graph.part_of(whole, 4, 6, 1),
            "torque_log": graph.one_of(whole, 6, 1),
            "slip_log": graph.one_of(whole, 7, 1),
        }
        for name, value in out.items():
            graph.name_output(value, name)
        half = self._half
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(out, ())
        shapes |= dict.fromkeys(
            ("depth", "contact", "pressure", "depth_log", "shear_log"), (half, half)
        )
        shapes |= {"shear": (half, half, 2), "force": (3,), "force_log": (2,)}
        return shapes

    def _convolved(self, x: str, name: str, stride: int = 1) -> str:
        """Add a square convolution (`fields.module.Convolution`)."""
        graph = self._graph
        part = self._own[name]
        inputs = 6  # of the first: a frame and its change, three colours each
        if name == "slope":
            inputs = len(self._own["maps"]["kernel"])
        if "norm" in part:
            x = graph("Gelu", graph.norm(x, part["norm"], self._model.norm_eps))
            inputs = len(part["norm"]["scale"])
        count, outputs = part["kernel"].shape
        side = round((count // inputs) ** 0.5)
        # The network keeps channels last, ONNX has them first.
        kernel = part["kernel"].reshape(side, side, inputs, outputs).transpose(3, 2, 0, 1)
        x = graph(
            "Conv",
            graph("Transpose", x, perm=[0, 3, 1, 2]),
            kernel,
            part["bias"],
            kernel_shape=[side] * 2,
            pads=[side // 2] * 4,
            strides=[stride] * 2,
        )
        return graph("Transpose", x, perm=[0, 2, 3, 1])

    def _resized(self, x: str, factor: float) -> str:
        """Add a linear resize of a map (B, h, w, C)."""
        graph = self._graph
        x = graph("Transpose", x, perm=[0, 3, 1, 2])
        x = graph("Resize", x, "", [1.0, 1.0, factor, factor], mode="linear")
        return graph("Transpose", x, perm=[0, 2, 3, 1])

    def _refined(self, x: str, *names: str) -> str:
        """Add residual convolutions."""
        for name in names:
            x = self._graph("Add", x, self._convolved(x, name))
        return x
