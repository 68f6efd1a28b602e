"""Heads on frozen features: linear, nearest-neighbour, ridge and gradient-trained, each fitted for
all its options.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from threadpoolctl import ThreadpoolController

from anytouch_jax.encoder.arrays import binary_scale, unit_rows
from anytouch_jax.encoder.embed import nearest
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.evaluate.statistics import Array
from anytouch_jax.progress import tracked
from anytouch_jax.shown import shown_short

if TYPE_CHECKING:
    from anytouch_jax.encoder.arrays import Pooling

HeadName = Literal["linear", "knn", "gradient"]
Scaling = Literal["column", "common"]
# features (m, d) -> class numbers or numbers (m,) for each option
Predict = Callable[[Array], list[Array]]

PENALTIES = (1.0, 0.1, 0.01, 0.001, 0.0001)  # of logistic regression
RIDGE = (100.0, 10.0, *PENALTIES)
NEIGHBOURS = (20, 10, 5, 1)
STEPS = 300  # of logistic regression


@dataclass(frozen=True)
class GradientRecipe:
    """The authors' probe: a linear layer, AdamW, cosine decay to 0.

    Defaults are of `run_probe_OF1.sh`, two devices.
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

    `scaling` "column" brings every feature to unit variance, "common" divides all by one factor.
    `options` replace the default penalties, numbers of neighbours or epochs, and are sorted.
    `recipe` and `seed` are of "gradient". Raises UserError for an unknown head, and for options
    that are not above 0.
    """

    name: HeadName = "linear"
    scaling: Scaling = "column"
    options: tuple[float, ...] | None = None
    recipe: GradientRecipe = GradientRecipe()
    seed: int = 0

    def __post_init__(self) -> None:
        if self.name not in get_args(HeadName):
            raise UserError(
                f"Unknown head {self.name!r}. Choose among {', '.join(get_args(HeadName))}."
            )
        if self.options is not None:
            if not self.options or min(self.options) <= 0:
                raise UserError(
                    "Penalties and numbers of neighbours must be above 0, not "
                    f"{list(self.options)}."
                )
            object.__setattr__(
                self, "options", tuple(sorted(set(map(float, self.options)), reverse=True))
            )


@shown_short
class FittedHead(NamedTuple):
    """A fit for each option; `models` are those of logistic regression, empty for the other
    heads.
    """

    options: tuple[float, ...]
    predict: Predict
    models: Sequence[LinearModel] = ()


@shown_short
class LinearModel(NamedTuple):
    """Standardised logistic regression: features (m, d) -> class numbers (m,)."""

    mean: Array
    scale: Array
    classes: Array
    fit: Logistic

    def __call__(self, x: Array) -> Array:
        return self.classes[self.fit((x - self.mean) / self.scale)]


def fit_head(
    head: ProbeHead,
    x: Array,
    y: Array,
    classes: int,
    *,
    weights: Array | None = None,
    start: LinearModel | None = None,
) -> FittedHead:
    """Fit all options of a head on features f32 (n, d) and class numbers below `classes` (0: y are
    numbers).

    `weights` (n,): how often each row counts, whole except in logistic regression. `start`: a fit
    that it starts from.
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
        x = np.repeat(x, times, 0)
        y = np.repeat(y, times)
    if head.name == "gradient":
        return FittedHead(options, _fit_gradient(x, y, classes, options, head.recipe, head.seed))
    if head.name == "linear":
        return FittedHead(options, fit_ridge(x, y, options, head.scaling))
    z_train = unit_rows(x)
    numbers = list(map(int, options))

    def neighbours(rows: Array) -> list[Array]:
        near, cosines = nearest(z_train, unit_rows(rows), max(numbers))
        if classes:
            return [vote(y[near[:, :k]], cosines[:, :k], classes) for k in numbers]
        return [y[near[:, :k]].mean(1) for k in numbers]

    return FittedHead(options, neighbours)


def head_score(predicted: Array, truth: Array, classes: int) -> float:
    """Return the accuracy, or minus the mean squared error of numbers (0 classes)."""
    if classes:
        return float(np.mean(predicted == truth))
    return -float(np.mean((predicted - truth) ** 2))


def linear_path(
    x: Array,
    y: Array,
    penalties: Sequence[float],
    *,
    scaling: Scaling = "column",
    weights: Array | None = None,
    start: LinearModel | None = None,
) -> list[LinearModel]:
    """Return logistic regression of `y` (n,) for each penalty, each from the fit before; `weights`
    (n,) of the rows.
    """
    mean, scale = _mean_and_scale(x, weights, scaling)
    classes, numbers = np.unique(y, return_inverse=True)
    first = start.fit if start is not None and np.array_equal(start.classes, classes) else None
    fits = logistic_path((x - mean) / scale, numbers, len(classes), penalties, first, weights)
    return [
        LinearModel(mean, scale, classes, fit) for fit in tracked(fits, "penalties", len(penalties))
    ]


def _mean_and_scale(
    x: Array, weights: Array | None = None, scaling: Scaling = "column"
) -> tuple[Array, Array]:
    """Return the mean and deviation (d,) of each column, "common": one for all; a constant column
    gets deviation 1.
    """
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


def fit_ridge(
    x: Array, y: Array, penalties: Sequence[float], scaling: Scaling = "column"
) -> Predict:
    """Return a function from features (m, d) to ridge predictions (m,), one array a penalty of the
    mean square.
    """
    # here, so that other heads are fitted without it
    from sklearn.linear_model import Ridge

    mean, scale = _mean_and_scale(x, scaling=scaling)
    model = Ridge(len(x) * np.asarray(penalties), solver="cholesky")
    model.fit((x - mean).astype(np.float64) / scale, np.repeat(y[:, None], len(penalties), 1))
    return lambda rows: list(
        model.predict((rows - mean).astype(np.float64) / scale).reshape(len(rows), -1).T
    )


def vote(labels: Array, cosines: Array, classes: int) -> Array:
    """Return the most frequent class of each row of `labels` (n, k); of equals the one of larger
    summed cosine.
    """
    votes = np.zeros((len(labels), classes))
    rows = np.repeat(np.arange(len(labels)), labels.shape[1])
    np.add.at(votes, (rows, labels.ravel()), (1 + 1e-3 * cosines / labels.shape[1]).ravel())
    return votes.argmax(1)


def _fit_gradient(
    x: Array, y: Array, classes: int, options: Sequence[float], recipe: GradientRecipe, seed: int
) -> Predict:
    """Fit the authors' layer; numbers are fitted in standard deviations.

    An option is an epoch, counted from 1.
    """
    refuse_forked()
    rng = np.random.default_rng(seed)
    x, (n, d), columns = np.asarray(x, np.float32), x.shape, classes if classes > 2 else 1
    middle, spread = (0.0, 1.0) if classes else (float(y.mean()), float(y.std()) or 1.0)
    target = y.astype(np.int32) if classes > 2 else ((y - middle) / spread).astype(np.float32)
    params = (
        np.asarray(0.01 * rng.standard_normal((d, columns)), np.float32),
        np.asarray(rng.uniform(-1, 1, columns) / np.sqrt(d), np.float32),
    )
    init, step = _gradient_step(recipe, classes)
    state = init(params)
    batch = min(recipe.batch, n)
    epochs = list[tuple[Array, Array]]()
    steps = n // batch  # the last, smaller batch of an epoch is left out
    for epoch in tracked(range(recipe.epochs), "epochs"):
        for number, rows in enumerate(
            rng.permutation(n)[: steps * batch].reshape(steps, batch), epoch * steps
        ):
            rate = recipe.rate * 0.5 * (1 + np.cos(np.pi * number / (steps * recipe.epochs)))
            params, state = step(params, state, x[rows], target[rows], np.float32(rate))
        epochs.append((np.asarray(params[0]), np.asarray(params[1])))

    def predict(rows: Array) -> list[Array]:
        logits = [
            rows @ weights + bias for weights, bias in (epochs[int(epoch) - 1] for epoch in options)
        ]
        if classes > 2:
            return [each.argmax(1) for each in logits]
        return [
            (each[:, 0] > 0).astype(np.int64) if classes else each[:, 0] * spread + middle
            for each in logits
        ]

    return predict


@functools.cache
def _gradient_step(
    recipe: GradientRecipe, classes: int
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return optax's `init` and a compiled step of AdamW; two classes share one logit, as in the
    released code.
    """
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
        return optax.apply_updates(
            params, jax.tree.map(lambda update: rate * update, updates)
        ), state

    # whatever JAX_ENABLE_X64
    return tuple(jax.enable_x64(False)(function) for function in (tx.init, jax.jit(step)))


def calibrate(
    head: LinearHead,
    features: Array,
    y: Array,
    groups: Array,
    sensors: Array,
    fit: Array,
    val: Array,
    folds: Iterable[tuple[Array, Array]],
    penalty: float,
    **shares: float,
) -> LinearHead:
    """Return the head with a calibration from rows that it was not fitted on.

    `features` (N, d), class names `y` (N,), `groups` (N,) and `sensors` (N,) are of all rows. `fit`
    and `val` are row numbers. `folds` yields rows of `fit` to fit on and left out: heads fitted
    again with `penalty` predict these. `shares` are those of `LinearHead.calibrated`. Raises
    UserError if no row is left.
    """
    count = len(head.classes)
    logits = [head.scaled(features[val]) @ head.weights + head.bias]
    used = [val]
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
            # e**-1000 is 0: classes that the fit lacks
            several = np.full((len(kept), count), -1e3, np.float32)
            several[:, classes] = partial
        logits.append(several)
        used.append(kept)
    rows = np.concatenate(used)
    return head.calibrated(
        np.concatenate(logits), y[rows], groups[rows], features, groups, sensors, fit, val, **shares
    )


def linear_head(
    model: LinearModel, names: Array, *, label: str, pooling: Pooling, frames: int, fingerprint: str
) -> LinearHead:
    """Return the head of a fitted `LinearModel`, whose class numbers index `names`."""
    classes = np.asarray(names)[model.classes].astype(str)
    arrays = (classes, model.fit.weights, model.fit.bias, model.mean, model.scale)
    return LinearHead(*arrays, label, pooling, frames, fingerprint)


# Logistic regression for 100,000 rows: preconditioned L-BFGS along falling penalties. Features of a
# network are correlated, which costs L-BFGS hundreds of passes. The Hessian at equal probabilities
# is known: 1/K (I - 11'/K) (x) X'X/n. We change to the coordinates of its Cholesky factor, with the
# penalty on the diagonal. There tens of passes suffice. Arithmetic on the features is float32, and
# losses are summed in float64.


class Logistic(NamedTuple):
    """A fit: `weights` f32 (d, columns), `bias` (columns,), one column for two classes; `finished`:
    within STEPS.
    """

    weights: Array
    bias: Array
    loss: float
    finished: bool

    def __call__(self, x: Array) -> Array:
        """Return class numbers i64 (n,) of features (n, d)."""
        logits = x @ self.weights + self.bias
        if logits.shape[1] == 1:
            return (logits[:, 0] > 0).astype(np.int64)
        return logits.argmax(1)


def logistic_path(
    x: Array,
    y: Array,
    classes: int,
    penalties: Sequence[float],
    start: Logistic | None = None,
    weights: Array | None = None,
) -> Iterator[Logistic]:
    """Yield multinomial logistic regressions of class numbers `y` (n,) below `classes` on features
    `x` f32 (n, d).

    A penalty is the factor of half the squared weights, added to the mean log loss; the bias is
    free. Give standardised features, and the strongest penalty first: each starts from the fit
    before. `weights` (n,) of rows in that mean.
    """
    x = np.ascontiguousarray(x, np.float32)
    columns = 1 if classes == 2 else classes
    counts = np.ones(len(x)) if weights is None else weights
    shares = (counts / np.sum(counts, dtype=np.float64)).astype(np.float32)[:, None]
    with threads(x.size * columns):
        covariance = (x.T @ (x * shares)).astype(np.float64)
        for penalty in penalties:
            start = _fit(x, y, shares, columns, penalty, covariance, start)
            yield start


def _fit(
    x: Array,
    y: Array,
    shares: Array,
    columns: int,
    penalty: float,
    covariance: Array,
    start: Logistic | None,
) -> Logistic:
    d = x.shape[1]
    share = 0.25 if columns == 1 else 1 / columns
    # A small diagonal keeps the factor when there are fewer rows than features.
    diagonal = penalty + 1e-6 * share * np.trace(covariance) / d
    factor = cholesky(share * covariance + diagonal * np.eye(d), lower=True, check_finite=False)
    back = functools.partial(solve_triangular, factor, lower=True, trans="T", check_finite=False)
    forth = functools.partial(solve_triangular, factor, lower=True, check_finite=False)

    def unpacked(v: Array) -> tuple[Array, Array]:
        v = v.reshape(d + 1, columns)
        return back(v[:d]), v[d] / np.sqrt(share)

    def value(v: Array) -> tuple[float, Array]:
        weights, bias = unpacked(v)
        loss, slope = _log_loss(x @ weights.astype(np.float32) + bias.astype(np.float32), y, shares)
        loss += penalty / 2 * float(np.sum(weights**2))
        by_weights = (x.T @ slope).astype(np.float64) + penalty * weights
        by_bias = slope.sum(0, dtype=np.float64)
        return loss, np.concatenate([forth(by_weights), by_bias[None] / np.sqrt(share)]).ravel()

    first = np.zeros((d + 1, columns))
    if start is not None and start.weights.shape == (d, columns):
        first = np.concatenate([factor.T @ start.weights, np.sqrt(share) * start.bias[None]])
    options = {"maxiter": STEPS, "maxfun": 2 * STEPS, "maxcor": 20, "ftol": 1e-7, "gtol": 1e-6}
    optimum = minimize(value, first.ravel(), jac=True, method="L-BFGS-B", options=options)
    weights, bias = unpacked(optimum.x)
    return Logistic(
        weights.astype(np.float32), bias.astype(np.float32), float(optimum.fun), optimum.nit < STEPS
    )


def _log_loss(logits: Array, y: Array, shares: Array) -> tuple[float, Array]:
    """Return the log loss, weighted by `shares` (n, 1), and its gradient by the logits (n,
    columns), overwritten.
    """
    if logits.shape[1] == 1:
        signed = np.where(y == 1, logits[:, 0], -logits[:, 0])
        loss = float(np.sum(shares[:, 0] * np.logaddexp(0, -signed), dtype=np.float64))
        slope = np.where(y == 1, -1, 1) / (1 + np.exp(np.minimum(signed, 80)))
        return loss, (slope[:, None] * shares).astype(np.float32)
    rows = np.arange(len(y))
    logits -= logits.max(1, keepdims=True)
    right = logits[rows, y]
    np.exp(logits, out=logits)
    total = logits.sum(1, keepdims=True)
    loss = float(np.sum(shares[:, 0] * (np.log(total[:, 0]) - right), dtype=np.float64))
    logits *= shares / total
    logits[rows, y] -= shares[:, 0]
    return loss, logits


# finding the libraries takes longer than a small fit
_libraries = functools.cache(ThreadpoolController)


def threads(size: int) -> contextlib.AbstractContextManager[Any]:
    """Limit numerical libraries to one thread for a small fit, where more threads are slower."""
    return _libraries().limit(limits=1 if size < 1e8 else None)
