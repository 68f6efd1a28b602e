"""Imitation learning of the pouring task: features of the last segments -> pour, wait or retract (a
small MLP).

A frozen encoder computes its features once. Fine-tuning trains it with the MLP.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optax

from anytouch_jax.config.parsing import Below1, Count, check
from anytouch_jax.data.transforms import touch_evaluation
from anytouch_jax.encoder.embed import Pooling, run_in_batches
from anytouch_jax.encoder.encoder import Encoder, touch_features
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Net
from experiments.pouring.physics import ACTIONS, WAIT, Setup, State, Task
from experiments.pouring.trials import FRAMES, SENSOR, START, Expert, Replay, Trials, draw_runs, run

Array = npt.NDArray[Any]
UNSEEN = 20_000  # added to a seed: runs that no demonstration met
VERSION = 5  # of how a policy learns from the same demonstrations
LATEST = 80  # moments, 20 degrees
LOOKS = 30  # times that the held-out demonstrations are looked at while a policy learns
LAG = 3  # moments from the segment before to the last one
# the number of the first segment of the lifted cylinder; number 0 is of the standing one
LIFTED = START - FRAMES + 1


@dataclass(frozen=True)
class Learning:
    """How a policy learns: `steps` of AdamW at `rate` on batches of `batch` moments, `width` hidden
    units.

    Features (`pooling` as in `Encoder.embed`) are many and gels few, which an MLP soon knows by
    heart: it is given the first `components` principal components of its inputs, leaves out a
    fraction `dropout` of them and of its hidden units at every step (Srivastava et al. 2014), and
    the weights are kept that did best on a fraction `held_out` of the demonstrations. The policy
    acts on the mean of the log-probabilities of the last `votes` moments: one that retracts by
    mistake cannot go back. Fine-tuning goes on for `tune_steps` on `tune_moments` of each of
    `tune_runs` runs, at `tune_rate` (the encoder's; the MLP's is twice `rate`), which rises for a
    tenth of the steps and then falls.
    """

    steps: Count[int] = 3000
    rate: float = 1e-3
    batch: Count[int] = 1024
    width: Count[int] = 128
    decay: float = 1e-2
    components: Count[int] = 128
    dropout: Below1 = 0.3
    votes: Count[int] = 5
    pooling: Pooling = "both"
    held_out: float = 0.2
    tune_steps: Count[int] = 400
    tune_runs: Count[int] = 16
    tune_moments: Count[int] = 4
    tune_rate: float = 5e-4
    seed: int = 0

    def __post_init__(self) -> None:
        check(self)


class Head(NamedTuple):
    """The MLP over inputs (n, d): their `mean` (d,), the `basis` (d, k) of their principal
    components of unit spread, weights and biases of its layers.
    """

    mean: Any
    basis: Any
    layers: tuple[tuple[Any, Any], ...]


def late_hands(seed: int, count: int, late: int = LATEST) -> Array:
    """How many moments (count,) the hand of each demonstration is late."""
    return np.random.default_rng([seed % 2**63, count, late]).integers(0, late + 1, count)


def demonstrate(
    task: Task,
    seed: int,
    count: int,
    *,
    side: int | None,
    late: int = LATEST,
    patient: bool = True,
    chunk: int = 10,
) -> Trials:
    """`count` runs of the expert, with frames of `side` pixels, or without (None).

    The hand is late by 0 to `late` moments, drawn for each run: runs that all end at the target
    would teach to retract only where one is retracting already (noise in demonstrations: Laskey et
    al. 2017).
    """
    setups, keys = draw_runs(task, seed, count)
    hand = late_hands(seed, count, late)
    expert = Expert(task, patient=patient)
    plain = run(task, setups, keys, expert, late=hand)
    if side is None:
        return plain
    # Runs of like length together: a batch is drawn until its longest has ended. One array, since
    # videos are large.
    frames = np.zeros((*plain.actions.shape, side, side, 3), np.uint8)
    order = np.argsort(plain.steps, kind="stable")
    for start in range(0, count, chunk):
        part = order[start : start + chunk]
        some: Setup = jax.tree.map(lambda x, part=part: x[part], setups)
        shown = run(
            task, some, keys[part], Replay(plain.actions[:, part]), side=side, video=len(part)
        )
        assert shown.frames is not None
        frames[: len(shown.frames), part] = shown.frames
    return plain._replace(frames=frames)


def features(
    encoder: Encoder,
    trials: Trials,
    *,
    stills: bool,
    pooling: Pooling = "both",
    sensor: str = SENSOR,
    batch: int = 64,
    sides: Array | None = None,
    learned: Array | None = None,
) -> Array:
    """Features (S - 2, B, E) of the segment that ends at each moment from the third on; 0 after a
    run's end.

    `sides` (B, 2): in which mirrors the runs are shown (`segments`). `learned` (S - START, B):
    embed the segments of these moments of choice alone, and those of the standing and of the lifted
    cylinder; the others are 0.
    """
    if trials.frames is None:
        raise UserError("these demonstrations have no frames; record them with an image size")
    wanted = trials.taken[FRAMES - 1 :].copy()
    if learned is not None:
        wanted[1:LIFTED], wanted[LIFTED + 1 :] = False, (wanted[LIFTED:] & learned)[1:]
    where = np.argwhere(wanted)
    ahead = 1 if stills else FRAMES
    width = encoder.config.model.embed * (2 if pooling == "both" else 1)
    result = np.zeros((*wanted.shape, width), np.float32)
    frames = trials.frames

    def encode(part: Array) -> Array:
        clips = segments(encoder, frames, part, ahead, sides)
        return encoder.encode_touch(clips, sensor, pooling=pooling)

    if len(where):
        result[tuple(where.T)] = run_in_batches(encode, where, batch)
    return result


def subtracted(encoder: Encoder, frames: Array, first: Array) -> Array:
    """Return frames u8 (..., B, side, side, 3) as the encoder reads them: untouched, or minus the
    `first` frames.

    `first` u8 (B, side, side, 3) show the gel that holds the standing cylinder.
    """
    if not encoder.subtracts:
        return frames
    return np.clip(frames.astype(np.int16) - first + 128, 0, 255).astype(np.uint8)


def segments(
    encoder: Encoder, frames: Array, where: Array, ahead: int, sides: Array | None = None
) -> Array:
    """Segments (n, ahead, ...) that end at moments `where` (n, 2), number of the segment and run,
    as `subtracted`.

    A gel in a mirror bears the same load: runs are shown upside down where the first of `sides` (B,
    2) is 1, left to right where the second is.
    """
    ends = where[:, 0] + FRAMES - 1
    runs = where[:, 1]
    first = frames[0, runs]
    clips = np.stack(
        [
            subtracted(encoder, frames[ends - back, runs], first)
            for back in range(ahead - 1, -1, -1)
        ],
        1,
    )
    if sides is None:
        return clips
    turns = 1 - 2 * sides[runs]
    return np.stack([clip[:, ::up, ::left] for clip, (up, left) in zip(clips, turns, strict=True)])


def inputs(now: Any, before: Any, lifted: Any, standing: Any, xp: Any = np) -> Any:
    """What the MLP is given (..., 4 E): changes between the features of four segments.

    The last two, the first of the lifted cylinder, whose beads are known, and that of the standing
    one, the tare.
    """
    return xp.concatenate([now - standing, lifted - standing, now - lifted, now - before], -1)


def input_table(z: Array) -> Array:
    """`inputs` (S - LIFTED, B, 4 E) at the moments of choice, from features (S, B, E) of all
    segments.
    """
    now = z[LIFTED:]
    before = now[np.maximum(np.arange(len(now)) - LAG, 0)]
    return np.asarray(inputs(now, before, *(np.broadcast_to(z[i], now.shape) for i in (LIFTED, 0))))


def forward(head: Head, x: Any, dropout: float = 0.0, key: jax.Array | None = None) -> jax.Array:
    """Logits (n, 3) of the actions; with a `key`, a fraction `dropout` of what each layer is given
    is left out.
    """

    def layer(number: int, x: jax.Array) -> jax.Array:
        weight, bias = head.layers[number]
        if dropout and key is not None:
            kept = jax.random.bernoulli(jax.random.fold_in(key, number), 1 - dropout, x.shape)
            x = jnp.where(kept, x / (1 - dropout), 0)
        return x @ weight + bias[None]

    x = (x - head.mean[None]) @ head.basis
    for number in range(len(head.layers) - 1):
        x = jax.nn.gelu(layer(number, x), approximate=False)
    return layer(len(head.layers) - 1, x)


@jax.jit
def _log_probabilities(head: Head, x: Any) -> jax.Array:
    return jax.nn.log_softmax(forward(head, x))


def log_probabilities(head: Head, x: Array) -> Array:
    """Log-probabilities (n, 3) of the actions."""
    return np.asarray(_log_probabilities(head, x))


def new_head(x: Array, learning: Learning) -> Head:
    """An untrained MLP for the principal components of inputs like `x` (n, d)."""
    mean = x.mean(0)
    spread, axes = np.linalg.eigh(np.cov(x - mean, rowvar=False).reshape(x.shape[1], -1))
    spread = spread[::-1][: learning.components]
    axes = axes[:, ::-1][:, : learning.components]
    basis = axes / np.sqrt(np.maximum(spread, 1e-6 * spread[0] + 1e-12))
    sizes = (basis.shape[1], learning.width, learning.width, len(ACTIONS))
    keys = jax.random.split(jax.random.key(learning.seed), len(sizes) - 1)
    shapes = list(zip(sizes[:-1], sizes[1:], keys, strict=True))
    layers = tuple(
        (jax.random.normal(key, (a, b)) * (1 / a) ** 0.5, jnp.zeros(b)) for a, b, key in shapes
    )
    return Head(jnp.asarray(mean, jnp.float32), jnp.asarray(basis, jnp.float32), layers)


def imitation_loss(logits: jax.Array, choices: jax.Array) -> jax.Array:
    """Mean cross-entropy of logits (n, 3) against the expert's choices (n,)."""
    return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, choices))


def imitate(x: Array, actions: Array, runs: Array, learning: Learning) -> tuple[Head, float]:
    """Train the MLP on inputs (n, d), actions (n,) of the demonstrations `runs` (n,); also its loss
    on those held out.

    A single demonstration is held out and learned from. Raises UserError on inputs of NaN, and on a
    single input.
    """
    if not np.isfinite(x).all():
        raise UserError("the policy's inputs are not finite; look at the encoder's weights")
    names = np.unique(runs)
    late = np.isin(runs, names[len(names) - max(1, round(learning.held_out * len(names))) :])
    known = late if late.all() else ~late
    if known.sum() < 2:
        raise UserError("there is one moment of choice to learn from; record more or longer runs")
    head = new_head(x[known], learning)
    optimiser = optax.adamw(
        optax.cosine_decay_schedule(learning.rate, learning.steps), weight_decay=learning.decay
    )
    data = tuple(
        (jnp.asarray(x[part], jnp.float32), jnp.asarray(actions[part])) for part in (known, late)
    )

    @jax.jit
    def train(
        layers: Any, head: Head, data: Any
    ) -> tuple[Any, jax.Array]:  # (constants would be compiled again)
        (x, actions), unseen = data

        def loss(
            layers: Any, x: jax.Array, actions: jax.Array, key: jax.Array | None = None
        ) -> jax.Array:
            return imitation_loss(
                forward(head._replace(layers=layers), x, learning.dropout, key), actions
            )

        def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
            layers, state = carry
            drawn, left_out = jax.random.split(key)
            ids = jax.random.randint(drawn, (learning.batch,), 0, len(x))
            change, state = optimiser.update(
                jax.grad(loss)(layers, x[ids], actions[ids], left_out), state, layers
            )
            return (optax.apply_updates(layers, change), state), None

        def look(carry: Any, keys: jax.Array) -> tuple[Any, None]:
            now, best, least = carry
            now, _ = jax.lax.scan(step, now, keys)
            value = loss(now[0], *unseen)
            kept = jax.tree.map(lambda new, old: jnp.where(value < least, new, old), now[0], best)
            return (now, kept, jnp.minimum(value, least)), None

        every = max(1, learning.steps // LOOKS)
        keys = jax.random.split(
            jax.random.key(learning.seed + 1), (-(-learning.steps // every), every)
        )
        begin = ((layers, optimiser.init(layers)), layers, jnp.asarray(jnp.inf))
        (_, layers, least), _ = jax.lax.scan(look, begin, keys)
        return layers, least

    layers, least = train(head.layers, head, data)
    return head._replace(layers=layers), float(least)


class Touch:
    """A policy that sees tactile frames of `sensor` only: an encoder and the MLP over its last
    features.

    `pooling`: of its features. `votes`: moments that have a say in an action (`Learning`). `loss`:
    of imitation, on the demonstrations held out (of a fine-tuned one: of its last steps).
    """

    looks = True

    def __init__(
        self,
        encoder: Encoder,
        head: Head,
        *,
        stills: bool,
        pooling: Pooling = "both",
        sensor: str = SENSOR,
        votes: int = 1,
        loss: float = math.nan,
    ) -> None:
        self.encoder = encoder
        self.head = head
        self.sensor = sensor
        self.loss = loss
        self.stills = stills
        self.pooling = pooling
        self.votes = votes

    def begin(self, count: int) -> None:
        """Forget the frames and features of the last runs."""
        self._first: Array | None = None
        self._frames: list[Array] = []
        self._z: list[Array] = []
        self._said: list[Array] = []

    def act(self, frames: Array | None, state: State | None = None) -> Array:
        """Actions (B,) from the frames u8 (B, h, w, 3) so far; it waits until it has subtracted a
        segment.
        """
        assert frames is not None
        frames = np.stack(
            [touch_evaluation([frame], self.encoder.config.model.image_size)[0] for frame in frames]
        )
        self._first = frames if self._first is None else self._first
        frames = subtracted(self.encoder, frames, self._first)
        self._frames = [*self._frames[-FRAMES + 1 :], frames]
        if len(self._frames) < FRAMES:
            return np.full(len(frames), WAIT)
        stack = np.stack(self._frames[-1:] if self.stills else self._frames, 1)
        self._z.append(self.encoder.encode_touch(stack, self.sensor, pooling=self.pooling))
        if len(self._z) <= LIFTED:
            return np.full(len(frames), WAIT)
        before = self._z[max(len(self._z) - 1 - LAG, LIFTED)]
        x = inputs(self._z[-1], before, self._z[LIFTED], self._z[0])
        self._said = [*self._said, log_probabilities(self.head, x)][-self.votes :]
        return np.asarray(np.mean(self._said, 0).argmax(-1))


def moments(trials: Trials, x: Array, learned: Array | None = None) -> tuple[Array, Array, Array]:
    """The moments of choice of all demonstrations, from inputs x (S - START, B, d): inputs, choices
    and runs (n,).

    `learned` (S - START, B): only these.
    """
    taken = trials.taken[START:] if learned is None else trials.taken[START:] & learned
    return x[taken], trials.choices[START:][taken], np.nonzero(taken)[1]


def learn_frozen(
    encoder: Encoder, trials: Trials, learning: Learning, *, stills: bool, sensor: str = SENSOR
) -> Touch:
    """Return a policy over frozen features of `sensor`, from demonstrations and their mirror
    images.

    It learns from every LAG-th moment of a run: those between resemble them, and cost as much.
    """
    rng = np.random.default_rng(learning.seed % 2**63)
    pooling = learning.pooling
    sides = rng.choice(np.array([[0, 1], [1, 0], [1, 1]]), len(trials.steps))
    first = rng.integers(LAG, size=len(trials.steps))
    learned = (np.arange(len(trials.actions) - START)[:, None] - first) % LAG == 0
    views = [
        features(
            encoder,
            trials,
            stills=stills,
            pooling=pooling,
            sensor=sensor,
            sides=side,
            learned=learned,
        )
        for side in (None, sides)
    ]
    result = [moments(trials, input_table(z), learned) for z in views]
    x, actions, runs = (np.concatenate(both) for both in zip(*result, strict=True))
    head, loss = imitate(x, actions, runs, learning)
    return Touch(
        encoder,
        head,
        stills=stills,
        pooling=pooling,
        sensor=sensor,
        votes=learning.votes,
        loss=loss,
    )


# Fine-tuning
# --------------------------------------------------------------------------------------------------
#
# Demonstrations are few, and an encoder soon fits their gels by heart. So a step draws many runs,
# mirrored at random, with a few moments each. The segments of the standing and of the lifted
# cylinder are embedded once a run, and the last segment of a moment is the one before of the next.

Params = Any


class Chains(NamedTuple):
    """Moments of R runs, C of each in a chain: the `runs` (R,), the `numbers` (R, 3 + C) of the
    segments to embed (standing, lifted, the one before the chain, the C of the chain) and `inside`
    (R, C), which moments there are.
    """

    runs: Array
    numbers: Array
    inside: Array


def draw_chains(rng: np.random.Generator, steps: Array, runs: int, moments: int) -> Chains:
    """Chains of `moments`, `LAG` apart, in `runs` runs drawn from those that took `steps` (B,)
    actions.

    Each moment of choice of a run is as likely as the others; a chain may stick out at either end
    of its run.
    """
    drawn = rng.integers(len(steps), size=runs)
    last = (steps[drawn] - FRAMES)[:, None]
    end = rng.integers(LIFTED, last + 1 + LAG * (moments - 1))
    chain = end - LAG * np.arange(moments, -1, -1)
    inside = (chain[:, 1:] >= LIFTED) & (chain[:, 1:] <= last)
    known = np.broadcast_to([0, LIFTED], (runs, 2))
    return Chains(drawn, np.concatenate([known, np.clip(chain, LIFTED, last)], 1), inside)


def fine_tune(policy: Touch, trials: Trials, learning: Learning) -> Touch:
    """Go on from a policy over frozen features with the encoder's parameters trained too, on all
    demonstrations.

    The policy's `loss` then is that of its last tenth of steps. Raises UserError when that is not
    finite.
    """
    assert trials.frames is not None
    encoder = policy.encoder
    stills = policy.stills
    runs = learning.tune_runs
    step, state, params = _tuner(policy, learning)
    rng = np.random.default_rng(learning.seed % 2**63)
    losses: list[jax.Array] = []
    for _ in range(learning.tune_steps):
        chains = draw_chains(rng, trials.steps, runs, learning.tune_moments)
        where = np.stack(
            [chains.numbers, np.broadcast_to(chains.runs[:, None], chains.numbers.shape)], -1
        )
        sides = rng.integers(2, size=(len(trials.steps), 2))
        clips = segments(
            encoder, trials.frames, where.reshape(-1, 2), 1 if stills else FRAMES, sides
        )
        clips = clips.reshape(runs, -1, *clips.shape[1:])
        choices = trials.choices[chains.numbers[:, 3:] + FRAMES - 1, chains.runs[:, None]]
        params, state, loss = step(params, state, clips, choices, chains.inside)
        losses.append(loss)
    tuned = replace(encoder, params=params["encoder"], source=f"{encoder.source}, fine-tuned")
    head = policy.head._replace(**params["head"])
    late = float(np.mean(jax.device_get(losses[-max(1, learning.tune_steps // 10) :])))
    if not math.isfinite(late):
        raise UserError(
            f"fine-tuning went astray (its loss is {late}); lower tune_rate, "
            f"{learning.tune_rate:g} now"
        )
    return Touch(
        tuned,
        head,
        stills=stills,
        pooling=policy.pooling,
        sensor=policy.sensor,
        votes=policy.votes,
        loss=late,
    )


def _tuner(
    policy: Touch, learning: Learning
) -> tuple[Callable[..., tuple[Params, Any, jax.Array]], Any, Params]:
    """The compiled step of fine-tuning, its optimiser's state and its parameters."""
    encoder = policy.encoder
    head = policy.head
    params = {"encoder": encoder.params, "head": {"basis": head.basis, "layers": head.layers}}
    steps = learning.tune_steps

    def optimiser_of(rate: float) -> optax.GradientTransformation:
        rates = optax.warmup_cosine_decay_schedule(0.0, rate, steps // 10, steps)
        return optax.adamw(rates, weight_decay=learning.decay)

    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.multi_transform(
            {"encoder": optimiser_of(learning.tune_rate), "head": optimiser_of(2 * learning.rate)},
            {"encoder": "encoder", "head": "head"},
        ),
    )
    sensor = encoder.sensor_row(policy.sensor)
    logits = partial(
        logits_of, net=encoder.net, pooling=policy.pooling, mean=head.mean, sensor=sensor
    )

    def loss_of(
        params: Params, clips: jax.Array, choices: jax.Array, inside: jax.Array
    ) -> jax.Array:
        losses = optax.softmax_cross_entropy_with_integer_labels(logits(params, clips), choices)
        return jnp.sum(losses * inside) / jnp.maximum(jnp.sum(inside), 1)

    @jax.jit
    def step(
        params: Params, state: Any, clips: jax.Array, choices: jax.Array, inside: jax.Array
    ) -> Any:
        loss, slope = jax.value_and_grad(loss_of)(params, clips, choices, inside)
        change, state = optimiser.update(slope, state, params)
        return optax.apply_updates(params, change), state, loss

    return step, optimiser.init(params), params


def logits_of(
    params: Params, clips: jax.Array, *, net: Net, pooling: Pooling, mean: jax.Array, sensor: int
) -> jax.Array:
    """Logits (R, C, 3) of the moments of chains, from their segments (R, 3 + C, T, h, w, 3), and
    parameters of the encoder and of the MLP with its basis.
    """
    runs, count = clips.shape[:2]
    flat = clips.reshape(runs * count, *clips.shape[2:])
    rows = jnp.full(len(flat), sensor, jnp.int32)
    z = touch_features(params["encoder"], flat, rows, net=net, pooling=pooling, aggregation="mean")
    z = z.reshape(runs, count, -1)
    before = z[:, 2:-1]
    now = z[:, 3:]
    standing, lifted = (jnp.broadcast_to(z[:, i : i + 1], now.shape) for i in (0, 1))
    x = inputs(now, before, lifted, standing, jnp)
    return forward(Head(mean, **params["head"]), x.reshape(-1, x.shape[-1])).reshape(
        *now.shape[:2], -1
    )
