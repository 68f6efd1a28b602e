"""Heads on frozen features: linear, nearest-neighbour, ridge and gradient-trained; and saved linear heads.

A head is fitted once for all its options, from which a protocol selects one. The options are penalties (linear, ridge),
numbers of neighbours (kNN) or epochs (the authors' gradient-trained layer).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from anytouch_jax.bars import tracked
from anytouch_jax.encoder import novelty
from anytouch_jax.encoder.arrays import binary_scale, unit_rows
from anytouch_jax.encoder.novelty import Assessment, Calibration
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import logistic
from anytouch_jax.evaluate.logistic import Logistic
from anytouch_jax.evaluate.statistics import Array
from anytouch_jax.files import atomic_path, read_arrays

if TYPE_CHECKING:
    from anytouch_jax.encoder.embed import Pooling

HeadName = Literal["linear", "knn", "gradient"]
Scaling = Literal["column", "common"]
Predict = Callable[[Array], list[Array]]  # features (m, d) -> class numbers or numbers (m,) for each option

PENALTIES = (1.0, 0.1, 0.01, 0.001, 0.0001)  # of logistic regression
RIDGE = (100.0, 10.0, *PENALTIES)
NEIGHBOURS = (20, 10, 5, 1)
FORMATS = ("anytouch_jax.head.2", "anytouch_jax.head.1")  # the second has no calibration


@dataclass(frozen=True)
class GradientRecipe:
    """The authors' probe: one linear layer on unscaled features, AdamW, cosine decay to 0 without warm-up.

    The defaults are those of `run_probe_OF1.sh` in the released code for two devices. The batch is that of both.
    """

    epochs: int = 50
    batch: int = 128
    rate: float = 1e-3
    decay: float = 0.01
    beta1: float = 0.9
    beta2: float = 0.99


@dataclass(frozen=True)
class ProbeHead:
    """A head to fit; on numbers "linear" is ridge regression.

    `scaling` "column" brings every feature to unit variance. "common" divides all by one factor, which keeps the
    ranking of principal components. `options` replace the default penalties, numbers of neighbours or epochs. They are
    sorted, as a strong penalty is a good start for the next weaker one. `recipe` and `seed` are of "gradient". Raises
    UserError for an unknown head, and for options that are not above 0.
    """

    name: HeadName = "linear"
    scaling: Scaling = "column"
    options: tuple[float, ...] | None = None
    recipe: GradientRecipe = GradientRecipe()
    seed: int = 0

    def __post_init__(self) -> None:
        if self.name not in get_args(HeadName):
            raise UserError(f"Unknown head {self.name!r}. Choose among {', '.join(get_args(HeadName))}.")
        if self.options is not None:
            if not self.options or min(self.options) <= 0:
                raise UserError(f"Penalties and numbers of neighbours must be above 0, not {list(self.options)}.")
            object.__setattr__(self, "options", tuple(sorted(set(map(float, self.options)), reverse=True)))


class FittedHead(NamedTuple):
    """A fit for each option; `models` are those of logistic regression, empty for the other heads."""

    options: tuple[float, ...]
    predict: Predict
    models: Sequence[LinearModel] = ()


class LinearModel(NamedTuple):
    """Standardised logistic regression: features (m, d) -> class numbers (m,)."""

    mean: Array
    scale: Array
    classes: Array
    fit: Logistic

    def __call__(self, x: Array) -> Array:
        return self.classes[self.fit((x - self.mean) / self.scale)]


def fit_head(
    head: ProbeHead, x: Array, y: Array, classes: int, *, weights: Array | None = None, start: LinearModel | None = None
) -> FittedHead:
    """Fit all options of a head on features f32 (n, d) and class numbers below `classes` (0: y are numbers).

    `weights` (n,): how often each row counts, a whole number except in logistic regression. `start`: a fit that it
    starts from.
    """
    epochs = range(1, head.recipe.epochs + 1)
    defaults = {"linear": PENALTIES if classes else RIDGE, "knn": NEIGHBOURS, "gradient": epochs}
    options = head.options or tuple(map(float, defaults[head.name]))
    if classes and len(np.unique(y)) == 1:  # a small fold or bootstrap may hold one class only
        return FittedHead(options, lambda rows: [np.full(len(rows), y[0])] * len(options))
    if head.name == "linear" and classes:
        models = linear_path(x, y, options, scaling=head.scaling, weights=weights, start=start)
        return FittedHead(options, lambda rows: [model(rows) for model in models], models)
    if weights is not None:
        times = weights.astype(np.int64)
        x, y = np.repeat(x, times, 0), np.repeat(y, times)
    if head.name == "gradient":
        return FittedHead(options, _fit_gradient(x, y, classes, options, head.recipe, head.seed))
    if head.name == "linear":
        return FittedHead(options, fit_ridge(x, y, options, head.scaling))
    z_train, numbers = unit_rows(x), list(map(int, options))

    def neighbours(rows: Array) -> list[Array]:
        near, cosines = nearest(z_train, unit_rows(rows), max(numbers))
        if classes:
            return [vote(y[near[:, :k]], cosines[:, :k], classes) for k in numbers]
        return [y[near[:, :k]].mean(1) for k in numbers]

    return FittedHead(options, neighbours)


def head_score(predicted: Array, truth: Array, classes: int) -> float:
    """Return the accuracy, or minus the mean squared error of numbers (0 classes)."""
    return float(np.mean(predicted == truth)) if classes else -float(np.mean((predicted - truth) ** 2))


def linear_path(
    x: Array, y: Array, penalties: Sequence[float], *, scaling: Scaling = "column", weights: Array | None = None,
    start: LinearModel | None = None,
) -> list[LinearModel]:  # fmt: skip
    """Return logistic regression of `y` (n,), of two classes or more, for each penalty, strongest first.

    Each starts from the one before, the first from `start`. `weights` (n,): how often each row counts.
    """
    mean, scale = _mean_and_scale(x, weights, scaling)
    classes, numbers = np.unique(y, return_inverse=True)
    first = start.fit if start is not None and np.array_equal(start.classes, classes) else None
    fits = logistic.path((x - mean) / scale, numbers, len(classes), penalties, first, weights)
    return [LinearModel(mean, scale, classes, fit) for fit in tracked(fits, "penalties", len(penalties))]


def _mean_and_scale(x: Array, weights: Array | None = None, scaling: Scaling = "column") -> tuple[Array, Array]:
    """Return the mean and deviation (d,) of each column, "common": one for all; a constant column gets deviation 1."""
    shares = None if weights is None else weights / weights.sum(dtype=np.float64)
    mean = (x.mean(0, dtype=np.float64) if shares is None else shares @ x).astype(np.float32)
    centred = x - mean
    power = binary_scale(centred, 0)
    squares = np.ldexp(centred, -power) ** 2
    variance = np.mean(squares, 0, dtype=np.float64) if shares is None else shares @ squares
    variance = np.ldexp(variance, 2 * power[0])
    if scaling == "common":
        variance = np.full_like(variance, variance.mean())
    scale = np.sqrt(variance)
    return mean, np.where(scale > 1e-6 * np.abs(mean), scale, 1.0).astype(np.float32)


def fit_ridge(x: Array, y: Array, penalties: Sequence[float], scaling: Scaling = "column") -> Predict:
    """Return a function from features (m, d) to ridge predictions (m,), one array a penalty.

    One eigendecomposition of the covariance serves all penalties. A penalty is added to the mean squared error.
    """
    mean, scale = _mean_and_scale(x, scaling=scaling)
    scaled = (x - mean).astype(np.float64) / scale
    values, vectors = np.linalg.eigh(scaled.T @ scaled / len(x))
    target = vectors.T @ (scaled.T @ (y - y.mean()) / len(x))

    def predict(rows: Array) -> list[Array]:
        turned = (rows - mean).astype(np.float64) / scale @ vectors
        return [turned @ (target / (np.maximum(values, 0) + penalty)) + y.mean() for penalty in penalties]

    return predict


def nearest(z_train: Array, z_rows: Array, k: int) -> tuple[Array, Array]:
    """Return row numbers in `z_train` and cosines of the k nearest of each unit row of `z_rows`, nearest first."""
    # scikit-learn's NearestNeighbors, brute force, takes 1.5 (euclidean) to 6 times longer (cosine) on 100,000 rows.
    k = min(k, len(z_train))
    ids, cosines = np.empty((len(z_rows), k), np.int64), np.empty((len(z_rows), k), np.float32)
    for start in range(0, len(z_rows), 512):
        part = slice(start, start + 512)
        ids[part], cosines[part] = _largest(z_rows[part] @ z_train.T, k)
    return ids, cosines


def _largest(values: Array, k: int, block: int = 64) -> tuple[Array, Array]:
    """Return columns and values of the k largest of each row, largest first."""
    # They lie in the k blocks of columns with the largest maxima. Partitioning whole rows takes ten times longer.
    blocks = values.shape[1] // block
    columns = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    if blocks > 2 * k:
        whole = values[:, : blocks * block].reshape(len(values), blocks, block)
        best = np.argpartition(-whole.max(2), k - 1, axis=1)[:, :k]
        inside = (best[:, :, None] * block + np.arange(block)).reshape(len(values), -1)
        columns = np.concatenate([inside, columns[:, blocks * block :]], axis=1)
    candidates = np.take_along_axis(values, columns, 1)
    near = np.argpartition(-candidates, k - 1, axis=1)[:, :k]
    near = np.take_along_axis(near, np.argsort(-np.take_along_axis(candidates, near, 1), axis=1, kind="stable"), 1)
    return np.take_along_axis(columns, near, 1), np.take_along_axis(candidates, near, 1)


def vote(labels: Array, cosines: Array, classes: int) -> Array:
    """Return the most frequent class of each row of `labels` (n, k); of equals the one of larger summed cosine."""
    votes = np.zeros((len(labels), classes))
    rows = np.repeat(np.arange(len(labels)), labels.shape[1])
    np.add.at(votes, (rows, labels.ravel()), (1 + 1e-3 * cosines / labels.shape[1]).ravel())
    return votes.argmax(1)


def _fit_gradient(
    x: Array, y: Array, classes: int, options: Sequence[float], recipe: GradientRecipe, seed: int
) -> Predict:
    """Fit the authors' layer; numbers are fitted in standard deviations. An option is an epoch, counted from 1."""
    rng = np.random.default_rng(seed)
    x, (n, d), columns = np.asarray(x, np.float32), x.shape, classes if classes > 2 else 1
    middle, spread = (0.0, 1.0) if classes else (float(y.mean()), float(y.std()) or 1.0)
    target = y.astype(np.int32) if classes > 2 else ((y - middle) / spread).astype(np.float32)
    params = (
        np.asarray(0.01 * rng.standard_normal((d, columns)), np.float32),
        np.asarray(rng.uniform(-1, 1, columns) / np.sqrt(d), np.float32),
    )
    init, step = _gradient_step(recipe, classes)
    state, batch, epochs = init(params), min(recipe.batch, n), list[tuple[Array, Array]]()
    steps = n // batch  # the last, smaller batch of an epoch is left out
    for epoch in tracked(range(recipe.epochs), "epochs"):
        for number, rows in enumerate(rng.permutation(n)[: steps * batch].reshape(steps, batch), epoch * steps):
            rate = recipe.rate * 0.5 * (1 + np.cos(np.pi * number / (steps * recipe.epochs)))
            params, state = step(params, state, x[rows], target[rows], np.float32(rate))
        epochs.append((np.asarray(params[0]), np.asarray(params[1])))

    def predict(rows: Array) -> list[Array]:
        logits = [rows @ weights + bias for weights, bias in (epochs[int(epoch) - 1] for epoch in options)]
        if classes > 2:
            return [each.argmax(1) for each in logits]
        return [(each[:, 0] > 0).astype(np.int64) if classes else each[:, 0] * spread + middle for each in logits]

    return predict


@functools.cache
def _gradient_step(recipe: GradientRecipe, classes: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return optax's `init` and a compiled step of AdamW; two classes share one logit, as in the released code."""
    import jax  # here, so that a saved head is read without it
    import optax

    tx = optax.adamw(1.0, b1=recipe.beta1, b2=recipe.beta2, eps=1e-8, weight_decay=recipe.decay)

    def loss(params: Any, x: Any, target: Any) -> Any:
        logits = x @ params[0] + params[1][None]
        if classes > 2:
            return optax.softmax_cross_entropy_with_integer_labels(logits, target).mean()
        if classes:
            return optax.sigmoid_binary_cross_entropy(logits[:, 0], target).mean()
        return optax.l2_loss(logits[:, 0], target).mean()

    def step(params: Any, state: Any, x: Any, target: Any, rate: Any) -> tuple[Any, Any]:
        updates, state = tx.update(jax.grad(loss)(params, x, target), state, params)
        return optax.apply_updates(params, jax.tree.map(lambda update: rate * update, updates)), state

    return tuple(jax.enable_x64(False)(function) for function in (tx.init, jax.jit(step)))  # whatever JAX_ENABLE_X64


@dataclass(frozen=True, eq=False)
class LinearHead:
    """A saved linear classifier of features, with its calibration (None in files of older versions).

    `classes` (K,) str; `weights` (d, columns) and `bias` (columns,), one column for two classes, else K; features minus
    `mean` (d,) are divided by `scale` (d,). It predicts `label` from features of `frames` a touch and `pooling` by the
    encoder with that `fingerprint`.
    """

    classes: Array
    weights: Array
    bias: Array
    mean: Array
    scale: Array
    label: str
    pooling: Pooling
    frames: int
    fingerprint: str
    calibration: Calibration | None = None

    def __call__(self, features: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the likeliest class (n,) str and probabilities f32 (n, K) of features (n, d)."""
        temperature = 1.0 if self.calibration is None else self.calibration.temperature
        p = novelty.probabilities(self.scaled(features) @ self.weights + self.bias, temperature)
        return self.classes[p.argmax(1)], p

    def scaled(self, features: npt.ArrayLike) -> Array:
        """Return features (n, d) minus the mean, over the scale. Raises UserError for another shape."""
        x = np.asarray(features, np.float32)
        if x.ndim != 2 or x.shape[1] != len(self.mean):
            raise UserError(f"This head reads features (n, {len(self.mean)}), not {x.shape}.")
        return (x - self.mean) / self.scale

    def assess(self, features: npt.ArrayLike) -> Assessment:
        """Return what the head predicts for features (n, d), and whether to believe it.

        Raises UserError for a head without calibration.
        """
        label, p = self(features)
        known = self.calibration
        if known is None:
            raise UserError("This head has no calibration. Save it again with `anytouch probe label --save`.")
        distance = known.novelty(self.scaled(features))
        return Assessment(label, p, 1 - p <= known.set_limit, distance, distance > known.novelty_limit)

    def check(self, source: str, fingerprint: str, pooling: str, frames: int, join: str = "mean") -> None:
        """Raise UserError unless the head was fitted on features of that encoder, pooling and number of frames."""
        pairs = (("pooling", self.pooling, pooling), ("frames", self.frames, frames), ("join", "mean", join))
        wrong = [f"--{name} {own}" for name, own, other in pairs if own != other]
        if wrong:
            raise UserError(f"The head was fitted on other features. Give {' '.join(wrong)}.")
        if fingerprint != self.fingerprint:
            raise UserError(
                f"The head was fitted on features of another encoder ({self.fingerprint}) than {source} "
                f"({fingerprint}). Fit one with `anytouch probe label --save`."
            )


def calibrate(
    head: LinearHead, features: Array, y: Array, groups: Array, sensors: Array, fit: Array, val: Array,
    folds: Iterable[tuple[Array, Array]], penalty: float, *, coverage: float = novelty.COVERAGE,
    false_alarms: float = novelty.FALSE_ALARMS,
) -> LinearHead:  # fmt: skip
    """Return the head with a calibration from rows that it was not fitted on.

    `features` (N, d), class names `y` (N,) str, `groups` (N,) and `sensors` (N,) are of all rows. `fit` and `val` are
    row numbers. `folds` yields rows of `fit` to fit on and left out: heads fitted again with `penalty` predict these.
    Rows of a class that a fit lacks are not used. Raises UserError if none is left.
    """
    count, logits, used = len(head.classes), [head.scaled(features[val]) @ head.weights + head.bias], [val]
    numbers = np.searchsorted(head.classes, y)
    for inside, outside in folds:
        classes = np.unique(numbers[inside])
        kept = outside[np.isin(numbers[outside], classes)]
        if not len(kept) or len(classes) < min(count, 3):
            continue
        (model,) = linear_path(features[inside], numbers[inside], (penalty,))
        several = (features[kept] - model.mean) / model.scale @ model.fit.weights + model.fit.bias
        if len(classes) < count:
            partial = several
            several = np.full((len(kept), count), -1e3, np.float32)  # e**-1000 is 0: classes that the fit lacks
            several[:, classes] = partial
        logits.append(several)
        used.append(kept)
    rows, z = np.concatenate(used), np.concatenate(logits).astype(np.float64)
    known = np.isin(y[rows], head.classes)
    rows, z = rows[known], z[known]
    if not len(rows):
        raise UserError("No row is left to calibrate on. Give rows of split val, or classes of several groups.")
    truth = numbers[rows]
    temperature = novelty.fit_temperature(z, truth, groups[rows])
    p = novelty.probabilities(z, temperature)
    limit = novelty.conformal_limit(1 - p[np.arange(len(truth)), truth], groups[rows], coverage)
    chosen = fit[novelty.choose_references(groups[fit])]
    both = np.concatenate([fit, val])
    whitening = novelty.fit_whitening(head.scaled(features[fit]))
    references, x = (head.scaled(features[some]) @ whitening for some in (chosen, both))
    scores = novelty.novelty_scores(x, references, groups[both], groups[chosen])
    novel = novelty.conformal_limit(scores, groups[both], 1 - false_alarms)
    recordings = len(np.unique(groups[rows]))
    limits = (coverage, limit, false_alarms, novel, recordings)
    return replace(head, calibration=Calibration(temperature, *limits, whitening, references, sensors[chosen]))


def linear_head(
    model: LinearModel, names: Array, *, label: str, pooling: Pooling, frames: int, fingerprint: str
) -> LinearHead:
    """Return the head of a fitted `LinearModel`, whose class numbers index `names`."""
    classes = np.asarray(names)[model.classes].astype(str)
    arrays = (classes, model.fit.weights, model.fit.bias, model.mean, model.scale)
    return LinearHead(*arrays, label, pooling, frames, fingerprint)


def save_head(path: str | Path, head: LinearHead) -> None:
    """Write a head as `.npz` atomically. Raises OSError."""
    known = head.calibration
    arrays = {"mark" if name == "fingerprint" else name: value for name, value in vars(head).items()}
    del arrays["calibration"]
    arrays |= {} if known is None else known.arrays()
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, format=FORMATS[known is None], **arrays)


def load_head(path: str | Path) -> LinearHead:
    """Load the head that `anytouch probe label --save` wrote. Raises UserError for any other file."""
    if not Path(path).is_file():
        raise UserError(f"There is no head {path}. `anytouch probe label --save` writes one.")
    try:
        arrays: dict[str, Any] = read_arrays(path)
        for name in ("format", "label", "pooling", "mark"):
            if arrays[name].shape != () or arrays[name].dtype.kind != "U" or arrays[name].dtype.itemsize > 4096:
                raise ValueError(f"{name} is not a short text")
            arrays[name] = str(arrays[name])
        if arrays.pop("format") not in FORMATS:
            raise ValueError("it has no format of a head")
        known = Calibration.from_arrays(arrays, len(arrays["mean"]))
        arrays = {name: value for name, value in arrays.items() if not name.startswith("calibration/")}
        head = LinearHead(frames=int(arrays.pop("frames")), fingerprint=arrays.pop("mark"), calibration=known, **arrays)
        _check_head(head)
        return head
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise UserError(
            f"{path} is not the head of a probe ({reason}). `anytouch probe label --save` writes one."
        ) from None


def _check_head(head: LinearHead) -> None:
    """Raise ValueError for arrays of a head that do not fit together or are not finite."""
    count, width = len(head.classes), len(head.mean)
    columns = 1 if count == 2 else count
    shapes = {"classes": (count,), "weights": (width, columns), "bias": (columns,), "mean": (width,), "scale": (width,)}
    for name, shape in shapes.items():
        array = getattr(head, name)
        if array.shape != shape or array.dtype.kind != ("U" if name == "classes" else "f"):
            raise ValueError(f"{name} is {array.dtype} {array.shape}, not of shape {shape}")
        if name != "classes" and not np.isfinite(array).all():
            raise ValueError(f"{name} has values that are not finite")
    if count < 2 or not width or not (head.scale > 0).all() or not (head.label and head.fingerprint):
        raise ValueError("it needs two classes, features, scales above 0, a label and the mark of an encoder")
    if len(set(head.classes)) < count:
        raise ValueError("it has a class twice")
    if head.pooling not in ("class", "mean", "both") or not 0 < head.frames < 1 << 20:
        raise ValueError(f"it has pooling {head.pooling[:40]} and {head.frames} frames")
