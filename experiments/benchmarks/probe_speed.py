"""Benchmark of a linear probe on 100,000 features.

Multinomial logistic regression with five penalties (chosen on 20,000 rows), then the fit on all rows: 384 features, 20
classes, and spreads of the directions from 1 to 100, as a network has. With `SKLEARN=1` scikit-learn's fit for the
chosen penalty follows: its time, and the loss of both.

`python -m experiments.benchmarks.probe_speed`; `ROWS=10000` is a trial of a second.
"""

from __future__ import annotations

import os
import time

import numpy as np
from sklearn.linear_model import LogisticRegression

from anytouch_jax.evaluate import heads
from anytouch_jax.evaluate.probing import probe_features
from experiments.tables import env

ROWS, OTHERS = env.number("ROWS", 100_000), 10_000
WIDTH, CLASSES = 384, 20


def main() -> None:
    rng = np.random.default_rng(0)
    mixing = np.linalg.qr(rng.normal(size=(WIDTH, WIDTH)))[0] * np.geomspace(1, 100, WIDTH)
    labels = rng.integers(CLASSES, size=ROWS + 2 * OTHERS)
    hidden = rng.normal(size=(len(labels), WIDTH)) + 0.12 * rng.normal(size=(CLASSES, WIDTH))[labels]
    features = (hidden @ mixing).astype(np.float32)
    split = np.repeat(["train", "val", "test"], [ROWS, OTHERS, OTHERS])
    start, spent = time.perf_counter(), time.process_time()
    result = probe_features(features, labels, np.arange(len(labels)), split, seeds=0)
    wall, spent = time.perf_counter() - start, time.process_time() - spent
    penalty = result.penalty
    assert penalty is not None
    print(f"{ROWS} features of {WIDTH}, {CLASSES} classes, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}:")
    print(f"{wall:.1f} s ({spent:.1f} s of processor), penalty {penalty:g}, accuracy {result.accuracy:.3f}")
    if env.switch("SKLEARN"):
        x = (features[:ROWS] - features[:ROWS].mean(0)) / features[:ROWS].std(0)
        ours = next(heads.logistic_path(x, labels[:ROWS], CLASSES, [penalty])).loss
        start, spent = time.perf_counter(), time.process_time()
        model = LogisticRegression(C=1 / (penalty * ROWS), tol=1e-4, max_iter=1000).fit(x, labels[:ROWS])
        wall, spent = time.perf_counter() - start, time.process_time() - spent
        right = model.predict_log_proba(x)[np.arange(ROWS), labels[:ROWS]]
        theirs = -right.mean(dtype=np.float64) + penalty / 2 * np.sum(model.coef_.astype(np.float64) ** 2)
        print(f"scikit-learn, that penalty alone: {wall:.1f} s ({spent:.1f} s); loss {theirs:.6f}, ours {ours:.6f}")


if __name__ == "__main__":
    main()
