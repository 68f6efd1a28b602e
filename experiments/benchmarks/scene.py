"""Frames and patches left out of a stream: time against recall@1 of look-alikes and against slip accuracy.

    python -m experiments.benchmarks.scene scores --fine data/corpus/00000 --coarse data/corpus/01700
    python -m experiments.benchmarks.scene times

The first command takes long, and can share its machine. The second needs a quiet one. A line a variant, and a line of
times, go to `experiments/results/scene.jsonl`. `make results` makes the page from that file alone.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from tyro.conf import Positional

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import run_in_batches
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.encoder.stream import Reuse
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import retrieval
from anytouch_jax.nn.functional import Net
from anytouch_jax.nn.layers import read_blocks
from anytouch_jax.objectives import normalise_touch
from experiments.benchmarks import machine
from experiments.benchmarks.speed import interleaved
from experiments.command import run_script
from experiments.real import recordings, scores
from experiments.records import write_record

Array = npt.NDArray[Any]

NAME, TIMES = "scene.jsonl", "times"
REAL = "real"
SHARES = (25, 50, 100)  # percent of the patches in the programs that are compiled
MERGED = 4  # mean tokens that stand for the patches left out: one a quarter of the picture
FREE = 3.0  # label.contact_score of real frames below which often nothing is to be seen
UNTOUCHED = 128  # the grey level of an untouched gel once its background is subtracted


@dataclass(frozen=True)
class Variant:
    """What is left out. `percent` of the patches are kept, those that changed most since the background.

    With a `limit` in grey levels the smallest of SHARES is kept that holds all patches that changed more. The others
    are dropped or, if `merge`, replaced by MERGED tokens. `reuse` is the factor of `encoder.stream.Reuse`.
    """

    name: str
    percent: int = 100
    merge: bool = False
    limit: float | None = None
    reuse: float | None = None


VARIANTS = (
    Variant("whole"),
    *(Variant(f"{share} % of the patches, others dropped", share) for share in (75, 50, 25)),
    Variant("50 % of the patches, others merged", 50, True),
    *(Variant(f"patches changed by {limit} levels, others dropped", limit=limit) for limit in (2, 3, 4, 6)),
    *(Variant(f"frames reused within {factor} times the noise", reuse=factor) for factor in (0, 1, 2, 3, 4, 6)),
)  # fmt: skip


@dataclass(frozen=True)
class SceneOptions:
    """Leave frames and patches out of a stream, and measure what it saves and what it costs."""

    part: Positional[Literal["scores", "times"]]
    model: str = "anytouch-tiny"
    fine: Path | None = None  # Folder of simulated touches, a dent at the same place for every sensor.
    coarse: Path | None = None  # Folder of simulated touches by hand.
    real: Path = Path("../shared/real_touch2/manifest.csv")  # Manifest of real recordings.
    rounds: int = 200  # Rounds of timing.
    out: Path = Path("experiments/results") / NAME  # JSON lines.


@dataclass(frozen=True, eq=False)
class Frames:
    """Prepared frames u8 (n, S, S, 3) in the order of time, with rows of the sensor table and `camera` names (n,)."""

    pixels: Array
    sensor: Array
    camera: Array
    free: Array  # whether the gel is untouched and was so one frame before
    patch: int

    @cached_property
    def change(self) -> Array:
        """How much each patch differs from the untouched gel, f32 (n, N)."""
        return np.stack([patch_change(one, self.patch) for one in self.pixels])

    def sources(self, factor: float | None) -> Array:
        """Return the number of the frame whose features each frame gets (n,): its own if it is embedded."""
        source = np.arange(len(self.pixels))
        for camera in np.unique(self.camera) if factor is not None else ():
            own, reuse = np.flatnonzero(self.camera == camera), Reuse(factor or 0.0)
            for _ in range(2):  # the noise of the camera is known from the first time on
                known = [reuse(self.pixels[frame, None]) for frame in own]
            for before, frame, is_known in zip(own, own[1:], known[1:], strict=False):
                source[frame] = source[before] if is_known else frame
        return source


def patch_change(frame: Array, patch: int) -> Array:
    """Return the mean absolute difference of each patch from the untouched gel, in grey levels, f32 (N,)."""
    side = frame.shape[0] // patch
    change = np.abs(frame.astype(np.int16) - UNTOUCHED)
    return change.reshape(side, patch, side, -1).mean((1, 3), dtype=np.float32).reshape(-1)


def patches_by_change(change: Array) -> Array:
    """Return patch numbers i32 (..., N), those that changed most first."""
    return np.argsort(-change, axis=-1, kind="stable").astype(np.int32)


def pruned_features(
    params: Any, frames: Array, sensor: Array, order: Array, *, net: Net, keep: int, merge: bool
) -> Any:
    """Return features f32 (B, E) of frames u8 (B, S, S, 3) by the first `keep` patches of `order` (B, N)."""
    clips = normalise_touch(frames)[:, None]
    if keep == order.shape[1]:
        return net.encode_touch(params, clips, sensor).astype(jnp.float32)
    if not merge:
        return net.encode_touch(params, clips, sensor, keep_ids=order[:, :keep]).astype(jnp.float32)
    touch, model = net.bind(params).touch, net.model
    x = touch.tokens(clips, sensor)
    special, patches = jnp.split(x, [1 + model.sensor_tokens], axis=1)
    patches = jnp.take_along_axis(patches, order[..., None], axis=1)
    side = model.image_size // model.patch
    row, column = jnp.divmod(order[:, keep:], side)
    quarter = jax.nn.one_hot(2 * (2 * row // side) + 2 * column // side, MERGED, axis=1, dtype=x.dtype)
    quarter = jnp.where(quarter.any(2, keepdims=True), quarter, 1)  # one that is kept whole gets the mean of the rest
    weights = quarter / jnp.maximum(quarter.sum(2, keepdims=True), 1)
    x = jnp.concatenate([special, patches[:, :keep], weights @ patches[:, keep:]], axis=1)
    x = x if touch.pre_norm is None else touch.pre_norm(x)
    return touch.embedding(read_blocks(touch.blocks, x, remat=False)).astype(jnp.float32)


class Embedder:
    """Features of frames by the patches kept, each computed once."""

    def __init__(self, encoder: Encoder, frames: Frames) -> None:
        self.frames, self._params = frames, jax.device_put(encoder.params)
        self._net, self._patches = encoder.net, encoder.config.model.patches
        self._known: dict[tuple[int, bool], dict[int, Array]] = {}

    def __call__(self, percent: int, merge: bool, numbers: Array) -> Array:
        """Return features (n, E) of the frames `numbers` (n,) by `percent` of their patches."""
        known = self._known.setdefault((percent, merge), {})
        new = [number for number in np.unique(numbers).tolist() if number not in known]
        run = jax.jit(partial(pruned_features, net=self._net, keep=percent * self._patches // 100, merge=merge))
        frames, order = self.frames, patches_by_change(self.frames.change)
        items = ((frames.pixels[one], frames.sensor[one], order[one]) for one in new)
        values = run_in_batches(lambda batch: run(self._params, *batch), items)
        known |= dict(zip(new, values, strict=True))
        return np.stack([known[number] for number in numbers.tolist()])

    def kept(self, variant: Variant) -> Array:
        """Return the percent of patches that each frame keeps (n,)."""
        if variant.limit is None:
            return np.full(len(self.frames.pixels), variant.percent)
        count = (self.frames.change > variant.limit).mean(1)
        return np.array(SHARES)[np.searchsorted(SHARES, 100 * count)]

    def features(self, variant: Variant, numbers: Array) -> tuple[Array, dict[str, Any]]:
        """Return features (n, E) of the frames `numbers` (n,), and what is done on average for a frame of all."""
        source, percent = self.frames.sources(variant.reuse), self.kept(variant)
        own, values = source[numbers], np.zeros((len(numbers), 0), np.float32)
        for share in np.unique(percent[own]).tolist():
            some = percent[own] == share
            part = self(share, variant.merge and share < 100, own[some])
            values = values if values.size else np.zeros((len(numbers), part.shape[1]), np.float32)
            values[some] = part
        embedded = source == np.arange(len(source))
        runs = {
            program(share, variant.merge): float(np.mean(embedded & (percent == share))) for share in (25, 50, 75, 100)
        }
        runs |= {"compare": float(variant.reuse is not None), "choose": float(embedded.mean())}
        if variant.limit is None and variant.percent == 100:
            runs["choose"] = 0.0
        free = float(np.mean(~embedded[self.frames.free])) if self.frames.free.any() else None
        return values, {"runs": {name: share for name, share in runs.items() if share}, "reused_free": free}


def program(percent: int, merge: bool) -> str:
    """Return the name of a compiled program."""
    return f"{percent} %{' merged' * (merge and percent < 100)}"


def simulated(encoder: Encoder, path: Path) -> tuple[Frames, Array, manifests.Manifest]:
    """Return the frames of the test split, their rows (n,), and the manifest."""
    table = manifests.read(path)
    rows, names = table.rows_of("test"), table.text_column("sensor")
    gel = lru_cache(maxsize=8)(decode)
    pixels = np.stack([
        encoder.preprocess(decode(table.file(row)), gel(table.file(row, "background_path"))) for row in rows
    ])  # fmt: skip
    sensor = np.array([encoder.sensor_row(name) for name in names[rows]], np.int32)
    free = np.asarray(table.column("label.depth"))[rows] == 0
    free = still(free, table.text_column("sequence")[rows])
    return Frames(pixels, sensor, names[rows], free, encoder.config.model.patch), rows, table  # a unit has six frames


def still(free: Array, recording: Array) -> Array:
    """Return whether frames (n,) are free and follow a free one of their recording."""
    return free & np.roll(free, 1) & (recording == np.roll(recording, 1))


def recall(encoder: Encoder, path: Path) -> dict[str, dict[str, Any]]:
    """Return the recall@1 of each variant by name, the difference from the first, and how often programs run."""
    frames, rows, table = simulated(encoder, path)
    embedder, deepest = Embedder(encoder, frames), retrieval.deepest_rows(table, rows)
    made = {one.name: embedder.features(one, np.searchsorted(rows, deepest)) for one in VARIANTS}
    values = {name: features for name, (features, _) in made.items()}
    found = retrieval.cross_sensor_retrieval(table, values, deepest, centre=(True,))
    pooled = {one.name: one for one in found if one.query_sensor == retrieval.ALL}
    return {
        name: {
            "share": one.top1, "interval": [one.low, one.high],
            "minus": retrieval.difference(one, pooled[VARIANTS[0].name]), **made[name][1],
        }
        for name, one in pooled.items()
    }  # fmt: skip


def slip(encoder: Encoder, path: Path) -> dict[str, dict[str, Any]]:
    """Return the slip accuracy of each variant by name and head, as `recall`. Heads are fitted on whole frames."""
    data = recordings.read(path)
    pixels = np.stack([
        encoder.preprocess(frame, data.backgrounds[place])
        for frame, place in zip(data.frames, data.background, strict=True)
    ])  # fmt: skip
    sensor = np.full(len(pixels), encoder.sensor_row("gelsight_mini"), np.int32)
    table = manifests.read(path)
    rows = np.flatnonzero(
        (table.text_column("dataset") == recordings.SET) & (table.text_column("split") != "background")
    )
    contact = [one is not None and float(one) < FREE for one in table.column("label.contact_score").to_pylist()]
    free = still(np.array(contact)[rows], table.text_column("sequence")[rows])
    frames = Frames(pixels, sensor, data.finger, free, encoder.config.model.patch)
    embedder = Embedder(encoder, frames)
    result: dict[str, dict[str, Any]] = {}
    whole, first = np.zeros(0), dict[str, scores.Score]()
    for one in VARIANTS:
        values, about = embedder.features(one, np.arange(len(pixels)))
        whole = whole if whole.size else values
        result[one.name] = about
        for head, fit in scores.HEADS.items():
            score = slip_score(whole, values, data, fit)
            minus = score.minus(first.setdefault(head, score))
            result[one.name][head] = {"share": score.share, "interval": score.interval(), "minus": minus}
        print(one.name, about, {head: result[one.name][head]["minus"] for head in scores.HEADS}, flush=True)
    return result


def slip_score(whole: Array, values: Array, data: recordings.Recordings, fit: Any) -> scores.Score:
    """Return `scores.slip_score` of `values` (n, E) with heads that are fitted on `whole` (n, E)."""
    scale, parts = whole.std(0) + 1e-6, []
    for fold in range(5):
        split = np.where(data.fold == fold, "test", np.where(data.fold == (fold + 1) % 5, "val", "train"))
        x = np.where((split == "test")[:, None], values, whole) / scale
        parts.append(scores.recording_score(x, data.slip, data.recording, split, 2, fit))
    correct, groups = (np.concatenate([getattr(part, name) for part in parts]) for name in ("correct", "groups"))
    return scores.Score(correct, groups, float(np.median([part.option for part in parts])))


def times(encoder: Encoder, rounds: int) -> dict[str, Any]:
    """Return the ms of each program on one frame, and its ratio to the whole encoder in the same round."""
    model, params = encoder.config.model, jax.device_put(encoder.params)
    rng = np.random.default_rng(0)
    frame = rng.integers(100, 156, (model.image_size, model.image_size, 3), np.uint8)
    sensor, clip = np.zeros(1, np.int32), np.stack([frame] * model.frames)
    order = patches_by_change(patch_change(frame, model.patch))[None]

    def embed(percent: int, merge: bool) -> Callable[[], Any]:
        keep = percent * model.patches // 100
        run = partial(pruned_features, net=encoder.net, keep=keep, merge=merge)
        compiled = jax.jit(run).lower(params, frame[None], sensor, order).compile()
        return lambda: np.asarray(compiled(params, frame[None], sensor, order))

    def compiled_clip(function: Callable[..., Any]) -> Callable[[], Any]:
        compiled = jax.jit(function).lower(params, clip[None], sensor).compile()
        return lambda: np.asarray(compiled(params, clip[None], sensor))

    def projection(params: Any, clip: Array, sensor: Array) -> Any:
        return encoder.net.bind(params).touch.tokens(normalise_touch(clip), sensor)

    reuse, other = Reuse(2.0), rng.integers(100, 156, frame.shape, np.uint8)
    calls: dict[str, Callable[[], Any]] = {program(100, False): embed(100, False)}
    calls |= {program(share, merge): embed(share, merge) for share in (75, 50, 25) for merge in (False, True)}
    calls |= {
        "compare": lambda: [reuse(one[None]) for one in (frame, other)],
        "choose": lambda: patches_by_change(patch_change(frame, model.patch)),
        "clip": compiled_clip(encoder.traceable()), "projection of a clip": compiled_clip(projection),
    }  # fmt: skip
    for _ in range(100):
        calls["compare"]()
    seconds = [one[:, 0] for one in interleaved([*calls.values()], rounds)]
    seconds[[*calls].index("compare")] /= 2  # of two frames
    result = {
        name: {
            "ms": 1e3 * float(np.median(one)), "ratio": float(np.median(one / seconds[0])),
            "quartiles": np.percentile(one / seconds[0], (25, 75)).tolist(),
        }
        for name, one in zip(calls, seconds, strict=True)
    }  # fmt: skip
    return {"rounds": rounds, "programs": result, "machine": dataclasses.asdict(machine.describe())}


def run(options: SceneOptions) -> int:
    """Measure a part, store it and print."""
    encoder = load_encoder(options.model)
    about = {"encoder": options.model, "fingerprint": encoder.fingerprint}
    if options.part == "times":
        record = about | times(encoder, options.rounds)
        write_record(options.out, TIMES, record)
        print(record["programs"])
        return 0
    if options.fine is None or options.coarse is None:
        raise UserError("Scores need --fine and --coarse, two folders of simulated touches.")
    found = {"slip": slip(encoder, options.real)}
    for grade in ("fine", "coarse"):
        found[grade] = recall(encoder, getattr(options, grade) / "manifest.parquet")
        print(grade, {name: one["minus"] for name, one in found[grade].items()}, flush=True)
    for place, one in enumerate(VARIANTS):
        write_record(
            options.out, f"{place:02d}", about | {"name": one.name} | {what: found[what][one.name] for what in found}
        )
    return 0


if __name__ == "__main__":
    sys.exit(run_script(SceneOptions, run))
