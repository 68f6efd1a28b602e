"""Do unlabelled recordings of the same sensor help a head of few labels?

    anytouch embed --data MANIFEST --pooling both --out features.npz
    python -m experiments.real.unlabelled features.npz --data MANIFEST

One recording of each object of train is labelled, and the others are not. Recordings of test are
named by the mean of their frames. Four draws of the labelled ones; intervals are over recordings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from anytouch_jax.evaluate.statistics import mean_interval
from experiments.real import recordings, scores

Array = np.ndarray


def within(x: Array, sequence: Array) -> Array:
    """Return the covariance (d, d) of frames within their recordings."""
    _, number, counts = np.unique(sequence, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), x.shape[1]))
    np.add.at(sums, number, x)
    centred = x - (sums / counts[:, None])[number]
    return centred.T @ centred / len(x)


def whitened(x: Array, rows: Array, sequence: Array) -> Array:
    """Return x (n, d) scaled so that frames of one recording of `rows` vary alike everywhere."""
    values, vectors = np.linalg.eigh(within(x[rows], sequence[rows]))
    return x @ (vectors / np.sqrt(values + 0.1 * values.mean()))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("features", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/real_touch2/manifest.csv"))
    given = parser.parse_args()
    data = recordings.read(given.data)
    x = np.load(given.features)["features"].astype(np.float64)
    y = np.searchsorted(data.names, data.object)
    sequence = np.char.add(data.recording, data.finger)
    train = np.flatnonzero(data.split == "train")
    right: dict[str, list[Array]] = {}

    def score(name: str, values: Array, split: Array, labels: Array = y) -> None:
        found = scores.recording_score(values, labels, data.recording, split, len(data.names))
        right.setdefault(name, []).append(found.correct.astype(float))

    for seed in range(4):
        rng = np.random.default_rng(seed)
        chosen = [
            rng.choice(np.unique(data.recording[train][data.object[train] == one]))
            for one in np.unique(data.object[train])
        ]
        has_label = np.isin(data.recording, chosen)
        split = np.where((data.split == "train") & ~has_label, "unused", data.split)
        labelled = train[has_label[train]]
        score("labelled alone", x, split)
        score("whitened by labelled", whitened(x, labelled, sequence), split)
        score("whitened by all", whitened(x, train, sequence), split)
        centred = (x - x[train].mean(0)) / x[train].std(0)
        axes = np.linalg.svd(centred[train], full_matrices=False)[2][:100]
        score("components of all", centred @ axes.T, split)
    for name, several in right.items():
        change = np.mean(several, 0) - np.mean(right["labelled alone"], 0)
        low, high = mean_interval(change, np.arange(len(change)))
        ends = f"[{100 * (low or 0):+.1f}, {100 * (high or 0):+.1f}]"
        print(f"{name}: {100 * np.mean(several):.1f} %, {100 * change.mean():+.1f} {ends}")


if __name__ == "__main__":
    main()
