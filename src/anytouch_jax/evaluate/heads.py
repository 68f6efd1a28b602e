"""Heads on frozen features: linear, nearest-neighbour, ridge and gradient-trained.

Each is fitted for all its options (penalties, numbers of neighbours, epochs) at once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from anytouch_jax.encoder.arrays import binary_scale, unit_rows
from anytouch_jax.encoder.embed import nearest
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.evaluate.discriminant import discriminant_path
from anytouch_jax.evaluate.logistic import Logistic, logistic_path, path_seconds
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
# Above so many classes a linear head is a discriminant. On 211 and 220 recordings of real touch as
# classes it named 65.2 and 68.3 % of the frames, logistic regression 63.7 and 67.1 %, in 0.3 s
# instead of 20. On 31 and 40 objects it is 2.3 and 0.7 points worse, where regression is fast.
MANY_CLASSES = 200
_LONG = 10.0  # seconds of fitting that are announced


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

    Attributes:
        name: "linear", "knn" or "gradient".
        scaling: "column" brings every feature to unit variance. "common" divides all by one factor,
            which keeps the small components of pixels small.
        options: instead of the default penalties, numbers of neighbours or epochs; they are sorted,
            the strongest first.
        recipe: of "gradient".
        seed: of "gradient".

    Raises:
        UserError: for an unknown head, and for options that are not above 0.
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
            options = sorted(set(map(float, self.options)), reverse=True)
            object.__setattr__(self, "options", tuple(options))


@shown_short
class FittedHead(NamedTuple):
    """A fit for each option.

    `models` are those of logistic regression, empty for the other heads.
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
    """Fit all options of a head.

    Args:
        head: which head, and its options.
        x: features f32 (n, d).
        y: class numbers (n,) below `classes`, or continuous labels.
        classes: how many there are; 0 for continuous labels.
        weights: how often each row counts (n,), whole numbers except in logistic regression.
        start: a fit that logistic regression starts from.
    """
    options = head.options or _default_options(head, classes)
    # a small fold or bootstrap may hold one class only
    if classes and len(np.unique(y)) == 1:
        return FittedHead(options, lambda rows: [np.full(len(rows), y[0])] * len(options))
    if head.name == "linear" and classes:
        models = linear_path(
            x, y, options, scaling=head.scaling, weights=weights, start=start, total=classes
        )
        return FittedHead(options, lambda rows: [model(rows) for model in models], models)
    if weights is not None:
        # The other heads have no weights: a row that counts twice is given twice.
        times = weights.astype(np.int64)
        x = np.repeat(x, times, 0)
        y = np.repeat(y, times)
    if head.name == "gradient":
        return FittedHead(options, _fit_gradient(x, y, classes, options, head.recipe, head.seed))
    if head.name == "linear":
        return FittedHead(options, fit_ridge(x, y, options, head.scaling))
    return FittedHead(options, _fit_neighbours(x, y, classes, options))


def _default_options(head: ProbeHead, classes: int) -> tuple[float, ...]:
    """Return the penalties, numbers of neighbours or epochs of a head without options."""
    if head.name == "knn":
        return tuple(map(float, NEIGHBOURS))
    if head.name == "gradient":
        return tuple(map(float, range(1, head.recipe.epochs + 1)))
    if classes:
        return PENALTIES
    return RIDGE


def _fit_neighbours(x: Array, y: Array, classes: int, options: Sequence[float]) -> Predict:
    """Return a function from features to the vote, or mean, of the k nearest by cosine."""
    z_train = unit_rows(x)
    numbers = list(map(int, options))

    def predict(rows: Array) -> list[Array]:
        # The largest k is searched once: the others are its beginnings.
        near, cosines = nearest(z_train, unit_rows(rows), max(numbers))
        if classes:
            return [vote(y[near[:, :k]], cosines[:, :k], classes) for k in numbers]
        return [y[near[:, :k]].mean(1) for k in numbers]

    return predict


def cost_sentence(x: Array, y: Array, classes: int, fits: int) -> str:
    """Return how the linear head of many classes is fitted, and how long that takes if it is long.

    Args:
        x: features f32 (n, d).
        y: class numbers (n,).
        classes: how many there are; 0 for continuous labels.
        fits: how often all penalties are fitted.
    """
    if classes > MANY_CLASSES:
        return (
            f"{classes} classes are more than {MANY_CLASSES}: the linear head is a linear "
            "discriminant, which takes one factorisation a fit"
        )
    if not classes:
        return ""
    mean, scale = _mean_and_scale(x)
    seconds = fits * path_seconds((x - mean) / scale, y, classes, PENALTIES[0])
    if seconds < _LONG:
        return ""
    rounded = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} minutes"
    return f"The linear head of {classes} classes takes about {rounded} for each set of features"


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
    total: int = 0,
) -> list[LinearModel]:
    """Return a linear model for each penalty.

    It is logistic regression, each fitted from the one before, up to MANY_CLASSES, and a linear
    discriminant above.

    Args:
        x: features f32 (n, d), standardised here.
        y: class numbers (n,).
        penalties: the strongest first.
        scaling: as of `ProbeHead`.
        weights: of the rows (n,).
        start: a fit of the same classes that the first one starts from.
        total: classes of the whole probe, by which the kind of model is chosen: a fold that lacks
            some must not have another kind than its neighbour.
    """
    mean, scale = _mean_and_scale(x, weights, scaling)
    classes, numbers = np.unique(y, return_inverse=True)
    first = None
    if start is not None and np.array_equal(start.classes, classes):
        first = start.fit
    scaled = (x - mean) / scale
    if max(total, len(classes)) > MANY_CLASSES and len(classes) > 2:
        fits = discriminant_path(scaled, numbers, len(classes), penalties, weights)
    else:
        fits = logistic_path(scaled, numbers, len(classes), penalties, first, weights)
    models = []
    for fit in tracked(fits, "penalties", len(penalties)):
        models.append(LinearModel(mean, scale, classes, fit))
    return models


def _mean_and_scale(
    x: Array, weights: Array | None = None, scaling: Scaling = "column"
) -> tuple[Array, Array]:
    """Return the mean and standard deviation (d,) of each column, or with "common" one for all.

    A constant column gets 1, up to the rounding of float32.
    """

    def average(values: Array) -> Array:
        if weights is None:
            return np.asarray(np.mean(values, 0, dtype=np.float64))
        return np.asarray(weights / weights.sum(dtype=np.float64) @ values)

    mean = average(x).astype(np.float32)
    centred = x - mean
    # Divided by a power of two, so that squares of very large or small features stay in float32.
    power = binary_scale(centred, 0)
    squares = np.ldexp(centred, -power) ** 2
    variance = np.ldexp(average(squares), 2 * power[0])
    if scaling == "common":
        variance = np.full_like(variance, variance.mean())
    scale = np.sqrt(variance)
    return mean, np.where(scale > 1e-6 * np.abs(mean), scale, 1.0).astype(np.float32)


def fit_ridge(
    x: Array, y: Array, penalties: Sequence[float], scaling: Scaling = "column"
) -> Predict:
    """Return a function from features (m, d) to ridge predictions (m,), one array a penalty.

    Args:
        x: f32 (n, d).
        y: numbers (n,).
        penalties: the factor of the squared weights beside the mean squared error, each.
        scaling: "column" divides each column by its deviation, "common" all by one number.
    """
    # here, so that other heads are fitted without it
    from sklearn.linear_model import Ridge

    mean, scale = _mean_and_scale(x, scaling=scaling)
    # One target a penalty: scikit-learn then factors X'X once for all of them. Its penalty is
    # beside the sum of squares, so ours is times n.
    targets = np.repeat(y[:, None], len(penalties), 1)
    model = Ridge(len(x) * np.asarray(penalties), solver="cholesky")
    model.fit((x - mean).astype(np.float64) / scale, targets)

    def predict(rows: Array) -> list[Array]:
        scaled = (rows - mean).astype(np.float64) / scale
        return list(model.predict(scaled).reshape(len(rows), -1).T)

    return predict


def vote(labels: Array, cosines: Array, classes: int) -> Array:
    """Return the most frequent class of each row of `labels` (n, k).

    Of equals it is the one of larger summed `cosines` (n, k).
    """
    # All cosines of a row together weigh a thousandth of one vote: they break ties alone.
    weights = 1 + 1e-3 * cosines / labels.shape[1]
    # The votes for the class of each neighbour, (n, k): a table of all classes would have
    # 90 million cells for 30,000 rows of 3,000.
    votes = np.zeros(labels.shape)
    for place in range(labels.shape[1]):
        same = labels == labels[:, place, None]
        votes += np.where(same, weights[:, place, None], 0.0)
    # of classes with equal votes the smallest
    leading = votes == votes.max(axis=1, keepdims=True)
    return np.where(leading, labels, classes).min(axis=1)


def _fit_gradient(
    x: Array, y: Array, classes: int, options: Sequence[float], recipe: GradientRecipe, seed: int
) -> Predict:
    """Fit the authors' layer; continuous labels are fitted in standard deviations.

    An option is an epoch, counted from 1.
    """
    refuse_forked()
    rng = np.random.default_rng(seed)
    x = np.asarray(x, np.float32)
    n, d = x.shape
    middle = 0.0
    spread = 1.0
    if not classes:
        middle = float(y.mean())
        spread = float(y.std()) or 1.0
    # Two classes share one logit, as in the released code.
    columns = 1
    target = ((y - middle) / spread).astype(np.float32)
    if classes > 2:
        columns = classes
        target = y.astype(np.int32)
    # The bias is drawn as torch's nn.Linear does.
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
        batches = rng.permutation(n)[: steps * batch].reshape(steps, batch)
        for number, rows in enumerate(batches, epoch * steps):
            rate = recipe.rate * 0.5 * (1 + np.cos(np.pi * number / (steps * recipe.epochs)))
            params, state = step(params, state, x[rows], target[rows], np.float32(rate))
        epochs.append((np.asarray(params[0]), np.asarray(params[1])))

    def predict(rows: Array) -> list[Array]:
        logits = []
        for option in options:
            weights, bias = epochs[int(option) - 1]
            logits.append(rows @ weights + bias)
        if classes > 2:
            return [each.argmax(1) for each in logits]
        if classes:
            return [(each[:, 0] > 0).astype(np.int64) for each in logits]
        return [each[:, 0] * spread + middle for each in logits]

    return predict


@functools.cache
def _gradient_step(
    recipe: GradientRecipe, classes: int
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return optax's `init` and a compiled step of AdamW.

    Two classes share one logit, as in the released code.
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


def calibrate_head(  # noqa: PLR0913 - a linear head's calibration reads all that a probe knows of rows
    head: LinearHead,
    features: Array,
    y: Array,
    groups: Array,
    sensors: Array,
    fit: Array,
    val: Array,
    folds: Iterable[tuple[Array, Array]],
    penalty: float,
    **limits: float,
) -> LinearHead:
    """Return the head with a calibration from rows that it was not fitted on.

    Rows of `fit` are predicted by heads that were fitted again without their groups, since val
    alone is often too small for a limit that holds.

    Args:
        head: fitted on the rows `fit`.
        features: f32 (N, d) of all rows.
        y: class names (N,).
        groups: names (N,).
        sensors: names (N,).
        fit: row numbers that were fitted on.
        val: row numbers that were not.
        folds: yields rows of `fit` to fit on, and rows left out.
        penalty: of the head, and of those that are fitted again.
        limits: `coverage` and `false_alarms` of `LinearHead.calibrated`.

    Raises:
        UserError: if no row is left.
    """
    count = len(head.classes)
    logits = [head.scaled(features[val]) @ head.weights + head.bias]
    used = [val]
    numbers = np.searchsorted(head.classes, y)
    for inside, outside in folds:
        classes = np.unique(numbers[inside])
        # A class that the fold lacks cannot be predicted: its rows would look like errors of the
        # head, which knows the class.
        kept = outside[np.isin(numbers[outside], classes)]
        if not len(kept) or len(classes) < min(count, 3):
            continue
        (model,) = linear_path(features[inside], numbers[inside], (penalty,), total=count)
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
        np.concatenate(logits), y[rows], groups[rows], features, groups, sensors, fit, val, **limits
    )


def linear_head(
    model: LinearModel, names: Array, *, label: str, pooling: Pooling, frames: int, fingerprint: str
) -> LinearHead:
    """Return the head of a fitted `LinearModel`, whose class numbers index `names`.

    Args:
        model: whose class numbers index `names`.
        names: str (K,) of classes.
        label: the column.
        pooling: of the features it was fitted on.
        frames: of a clip.
        fingerprint: of the encoder.
    """
    classes = np.asarray(names)[model.classes].astype(str)
    arrays = (classes, model.fit.weights, model.fit.bias, model.mean, model.scale)
    return LinearHead(*arrays, label, pooling, frames, fingerprint)
