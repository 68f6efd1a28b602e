"""Which way does the object turn or slide? A small antisymmetric head on the patch tokens of a
frozen encoder.

    python -m experiments.encoders.motion anytouch-tiny --data data/corpus/*/manifest.parquet

Features that are averaged over an image say little about the sign of a turn. The head reads a
vector from every patch: how its token differs from that of the clip played backwards. A clip has
the first, the middle and the last touched frame, and its tokens are those after a third and two
thirds of the blocks. Playing it backwards turns all vectors around. A turn is the sum of the
vectors' moments about the touched place, a slide is their mean.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import run_in_batches
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.evaluate import heads
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.evaluate.tables import plain
from anytouch_jax.objectives import normalise_touch
from experiments.benchmarks import machine
from experiments.real.run import load
from experiments.records import write_record

Array = np.ndarray
TURNS = ("clockwise", "counterclockwise")
SLIDES = ("left", "right", "up", "down")
MIRRORED = dict(zip((*TURNS, *SLIDES[:2]), (*TURNS[::-1], *SLIDES[1::-1]), strict=True))
HIDDEN = 48
EPOCHS = 15
BATCH = 64
RATE = 2e-3
TOUCHED = 0.08  # mm of the deepest point that count as contact


class Clips(NamedTuple):
    """Tokens f16 (n, 2, P, E) of clips played backwards and forwards, with columns (n,) of the
    manifest.
    """

    tokens: Array
    turn: Array
    slide: Array
    sensor: Array
    split: Array
    touch: Array


def read(encoder: Encoder, paths: list[Path], most: int) -> Clips:
    """Embed clips that turn or slide, at most `most` of them, and those of the training split in a
    mirror too.
    """
    manifest = manifests.read(paths)
    names = ("label.twist", "label.slide", "sensor", "split", "touch")
    columns = {name: manifest.text_column(name) for name in names}
    touched = manifest.number_column("label.depth") > TOUCHED
    moves = np.isin(columns["label.twist"], TURNS) | np.isin(columns["label.slide"], SLIDES)
    sequence = manifest.codes("sequence", own=True)
    frame = np.asarray(manifest.table["frame_index"])
    rows = np.flatnonzero(touched & moves & (columns["split"] != "background"))
    rows = rows[np.lexsort((frame[rows], sequence[rows]))]
    starts = np.flatnonzero(np.diff(sequence[rows], prepend=-1))
    ends = np.append(starts[1:], len(rows)) - 1
    three = np.stack([rows[starts], rows[(starts + ends + 1) // 2], rows[ends]], 1)[ends > starts]
    three = three[np.random.default_rng(0).permutation(len(three))[:most]]
    train = np.flatnonzero(columns["split"][three[:, 2]] == "train")
    last = {
        name: np.concatenate([columns[name][three[:, 2]], columns[name][three[train, 2]]])
        for name in names
    }
    last["label.twist"][len(three) :] = [
        MIRRORED.get(one, one) for one in last["label.twist"][len(three) :]
    ]
    last["label.slide"][len(three) :] = [
        MIRRORED.get(one, one) for one in last["label.slide"][len(three) :]
    ]

    def clip(row: Array) -> Array:
        gel = decode(manifest.file(int(row[0]), "background_path"))
        return np.stack([encoder.preprocess(decode(manifest.file(int(one))), gel) for one in row])

    def both_ways() -> Iterator[tuple[Array, np.int32]]:
        for number, row in enumerate(np.concatenate([three, three[train]])):
            frames = clip(row)
            sensor = np.int32(encoder.sensor_row(columns["sensor"][row[2]]))
            frames = frames[:, :, ::-1] if number >= len(three) else frames
            yield from ((frames[::-1], sensor), (frames, sensor))

    @jax.jit
    def tokens(params: Any, clips: jax.Array, rows: jax.Array) -> jax.Array:
        states = encoder.net.bind(params).touch.states(normalise_touch(clips), rows, 4)
        # after a third and two thirds
        first = encoder.net.model.touch.width
        last = 3 * encoder.net.model.touch.width
        return states[:, 1 + encoder.net.model.sensor_tokens :, first:last].astype(jnp.float16)

    values = run_in_batches(lambda part: tokens(encoder.params, *part), both_ways(), 64)
    return Clips(values.reshape(-1, 2, *values.shape[1:]), *last.values())


def init(width: int, seed: int = 0) -> dict[str, jax.Array]:
    """Return the parameters of a head on tokens of `width` values."""
    keys = jax.random.split(jax.random.key(seed), 2)
    return {
        "first": jax.random.normal(keys[0], (2 * width, HIDDEN)) / np.sqrt(2 * width),
        "bias": jnp.zeros(HIDDEN),
        "second": jax.random.normal(keys[1], (HIDDEN, 3)) / np.sqrt(HIDDEN),
        "place": jnp.zeros(width),
        "scale": jnp.zeros(2),
    }


def head(params: dict[str, jax.Array], tokens: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the logit of a clockwise turn (B,) and those of SLIDES (B, 4) of token pairs (B, 2, P,
    E).

    Exchanging the pair changes the sign of the turn, and exchanges left and right, up and down.
    """
    before = tokens[:, 0]
    after = tokens[:, 1]
    change = after - before
    state = (after + before) / 2

    def vectors(change: jax.Array) -> jax.Array:
        hidden = jax.nn.gelu(
            jnp.concatenate([change, state], -1) @ params["first"] + params["bias"][None, None]
        )
        return jnp.asarray(hidden @ params["second"])

    # (B, P, 3): x, y and a turn within the patch
    field = vectors(change) - vectors(-change)
    weight = jax.nn.softmax(state @ params["place"], axis=-1)[..., None]
    side = round(tokens.shape[2] ** 0.5)
    y, x = jnp.mgrid[:side, :side].reshape(2, -1) * (2 / side)
    place = jnp.stack([x, y], -1)[None]
    arm = place - (weight * place).sum(1, keepdims=True)
    moment = arm[..., 0] * field[..., 1] - arm[..., 1] * field[..., 0] + field[..., 2]
    turn = jnp.exp(params["scale"][0]) * (weight[..., 0] * moment).sum(1)
    slide = jnp.exp(params["scale"][1]) * (weight * field[..., :2]).sum(1)
    return turn, jnp.stack([-slide[:, 0], slide[:, 0], -slide[:, 1], slide[:, 1]], -1)


def fit(clips: Clips, train: Array, val: Array) -> dict[str, jax.Array]:
    """Train a head on the clips `train`. The epoch with the least loss on `val` wins."""
    mean = clips.tokens[train].mean((0, 1, 2), np.float64)
    scale = clips.tokens[train].std((0, 1, 2), np.float64)
    x = ((clips.tokens - mean) / (scale + 1e-6)).astype(np.float32)
    turn = np.where(clips.turn == TURNS[0], 1.0, np.where(clips.turn == TURNS[1], 0.0, np.nan))
    slide = np.array([SLIDES.index(one) if one in SLIDES else -1 for one in clips.slide])

    def loss(params: Any, x: jax.Array, turn: jax.Array, slide: jax.Array) -> jax.Array:
        logit, logits = head(params, x)
        turns = optax.sigmoid_binary_cross_entropy(logit, jnp.nan_to_num(turn))
        slides = optax.softmax_cross_entropy_with_integer_labels(logits, jnp.maximum(slide, 0))
        return jnp.where(jnp.isnan(turn), 0, turns).mean() + jnp.where(slide < 0, 0, slides).mean()

    steps = max(1, len(train) // BATCH)
    optimiser = optax.adamw(optax.cosine_decay_schedule(RATE, steps * EPOCHS), weight_decay=0.05)
    params = init(x.shape[-1])
    state = optimiser.init(params)
    rng = np.random.default_rng(0)
    best = (np.inf, params)

    @jax.jit
    def step(params: Any, state: Any, *batch: jax.Array) -> tuple[Any, Any]:
        updates, state = optimiser.update(jax.grad(loss)(params, *batch), state, params)
        return optax.apply_updates(params, updates), state

    check = jax.jit(loss)
    for _ in range(EPOCHS):
        for rows in np.array_split(rng.permutation(train)[: steps * BATCH], steps):
            params, state = step(params, state, x[rows], turn[rows], slide[rows])
        best = min(
            best,
            (float(check(params, x[val], turn[val], slide[val])), params),
            key=lambda pair: pair[0],
        )
    return best[1] | {"mean": jnp.asarray(mean), "spread": jnp.asarray(scale + 1e-6)}


def score(params: dict[str, jax.Array], clips: Clips, rows: Array) -> dict[str, Any]:
    """Return the fractions of turns and slides named right on `rows`, with 95 % intervals over
    touches.
    """
    x = (clips.tokens[rows] - np.asarray(params["mean"])) / np.asarray(params["spread"])
    logit, logits = jax.jit(head)({name: params[name] for name in init(1)}, x.astype(np.float32))
    named = {
        "turn": np.where(np.asarray(logit) > 0, *TURNS),
        "slide": np.array(SLIDES)[np.argmax(logits, -1)],
    }
    result: dict[str, Any] = {}
    for what, truth in (("turn", clips.turn[rows]), ("slide", clips.slide[rows])):
        known = truth != "none"
        right = (named[what] == truth)[known].astype(float)
        result[what] = {
            "clips": int(known.sum()),
            "fraction": float(right.mean()) if known.any() else None,
            "interval": mean_interval(right, clips.touch[rows][known]),
        }
    return result


def pooled_score(clips: Clips, splits: dict[str, Array]) -> float:
    """Return the fraction of test turns that a linear probe names right on the change of the mean
    token.
    """
    change = (clips.tokens[:, 1].astype(np.float32) - clips.tokens[:, 0]).mean(1)
    rows = {split: one[clips.turn[one] != "none"] for split, one in splits.items()}
    models = heads.linear_path(change[rows["train"]], clips.turn[rows["train"]], (1.0, 0.1, 0.01))

    def fraction(model: heads.LinearModel, split: str) -> float:
        return float(np.mean(model(change[rows[split]]) == clips.turn[rows[split]]))

    return fraction(max(models, key=lambda model: fraction(model, "val")), "test")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+")
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--most", type=int, default=8000, help="clips")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/motion.jsonl"))
    options = parser.parse_args()
    for name in options.models:
        clips = read(load(name), options.data, options.most)
        splits = {split: np.flatnonzero(clips.split == split) for split in ("train", "val", "test")}
        record = {
            "all sensors": score(fit(clips, splits["train"], splits["val"]), clips, splits["test"])
        }
        # the head never saw this sensor
        for sensor in np.unique(clips.sensor):
            parts = {split: rows[(clips.sensor[rows] != sensor)] for split, rows in splits.items()}
            own = splits["test"][clips.sensor[splits["test"]] == sensor]
            record[f"without {sensor}"] = score(
                fit(clips, parts["train"], parts["val"]), clips, own
            )
        about = {
            "clips": len(clips.turn),
            "machine": plain(machine.describe()),
            "pooled": pooled_score(clips, splits),
        }
        write_record(options.out, name, about | {"scores": record})
        print(name, about["pooled"], record, flush=True)


if __name__ == "__main__":
    main()
