from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.encoder.embed import TouchIndex
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.evaluate.plots import alignment, uniformity
from anytouch_jax.evaluate.retrieval import Galleries, score_galleries
from anytouch_jax.ops.losses import normalise
from tests.fuzz.harness import Case, pick

LENGTHS = (0.0, 1e-45, 1e-38, 1e-25, 1e-13, 1e-7, 1.0, 1e20, 1e37)
WIDTH = 12
load = lru_cache(1)(load_encoder)


def unit(x: Any, least: float = 0.0) -> Any:
    """Return rows over their lengths in float64, a row of zeros unchanged."""
    x = np.asarray(x, np.float64)
    length = np.linalg.norm(x, axis=1, keepdims=True)
    return x / np.maximum(np.where(length > 0, length, 1.0), least)


def cosines(x: Any) -> Any:
    return unit(x) @ unit(x).T


def searched(x: Any, things: Any) -> Any:
    index = TouchIndex(unit_rows(x), np.arange(len(x)), {}, {})
    ids, values = index.search(x, len(x))
    return np.take_along_axis(values, np.argsort(ids, axis=1), 1)


def ranked(x: Any, things: Any) -> Any:
    """The fraction of rows that find themselves, in galleries of all rows."""
    rows = np.arange(len(x))
    items = np.stack([np.concatenate([[row], np.delete(rows, row)]) for row in rows])[None]
    return score_galleries(x, x, Galleries(rows, items, (0.0, 0.0), 0))[0]


def ranks(x: Any) -> Any:
    near = cosines(x)
    return 1 / np.sum(near >= np.diag(near)[:, None] - 1e-6, axis=1)


# What is computed, and what it is in float64.
FUNCTIONS = {
    "normalise": (lambda x, _: np.asarray(normalise(x)), lambda x: unit(x, 1e-12)),
    "unit rows": (lambda x, _: unit_rows(x), unit),
    "similarity": (
        lambda x, things: load(things.run).similarity(x, x),
        lambda x: unit(x, 1e-12) @ unit(x, 1e-12).T,
    ),
    "search": (searched, cosines),
    "recall": (ranked, ranks),
    "alignment": (
        lambda x, _: alignment(x, x[::-1]),
        lambda x: np.square(unit(x) - unit(x)[::-1]).sum(1).mean(),
    ),
    "uniformity": (
        lambda x, _: uniformity(x),
        lambda x: np.log(
            np.mean(np.exp(2 * np.minimum(cosines(x)[np.triu_indices(len(x), 1)] - 1, 0) * 2))
        ),
    ),
}


def make(rng, folder: Path, things) -> Case:
    name = pick(rng, FUNCTIONS)
    lengths = rng.choice(LENGTHS, (6, 1))
    x = (unit(rng.standard_normal((6, WIDTH))) * lengths).astype(np.float32)
    bad = rng.random() < 0.2
    if bad:
        x[int(rng.integers(6)), int(rng.integers(WIDTH))] = pick(rng, (np.nan, np.inf, -np.inf))
    results = []

    def compute() -> int:
        function, _ = FUNCTIONS[name]
        results.append(function(x, things))
        return 0

    def check():
        if bad:
            if np.isfinite(results[0]).all():
                return "a value for a vector that is not finite"
            return None
        expected = FUNCTIONS[name][1](x)
        error = np.abs(results[0] - expected).max()
        # NaN is an error, too
        if error < 1e-5:
            return None
        return f"an error of {error:.2g}"

    return Case(
        f"{name}, lengths {lengths.ravel().tolist()}, {'not ' * bad}finite", compute, False, check
    )
