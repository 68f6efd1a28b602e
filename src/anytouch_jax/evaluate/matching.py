"""The matcher of a stage-2 run on held-out touches: did two touches, by two sensors, come from the same place? (Eq. 5)

Negatives are drawn both ways: from any sensor, and from the positive's sensor. Drawn from any, the sensors alone give
much of the answer away (a positive never has the anchor's); what they give away is said beside each score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import from_json
from anytouch_jax.data.loading.matching import Matches, MatchKeys
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import text_column
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.nn.functional import build
from anytouch_jax.ops.losses import normalise
from anytouch_jax.weights import checkpoint

Array = npt.NDArray[Any]
Negatives = Literal["any", "same_sensor"]
WAYS: tuple[Negatives, ...] = ("any", "same_sensor")
DRAWS = 5  # triples of each anchor


@dataclass(frozen=True)
class MatchScore:
    """How a matcher tells positives from `negatives`; shares are in 0..1, chance is 0.5.

    `accuracy`: logits on the right side of 0, positives and negatives alike; `low`, `high`: its 95 % interval when the
    anchors' objects are drawn anew, None with fewer than two. `auc`: chance that a positive's logit is above a
    negative's. `sensors_alone`: accuracy of the best rule that sees the two sensors only (`best_rule`).
    """

    negatives: Negatives
    accuracy: float
    low: float | None
    high: float | None
    auc: float
    sensors_alone: float
    triples: int
    anchors: int


def score_matching(run: str | Path, manifest: Manifest, rows: Array, features: Array) -> list[MatchScore]:
    """Scores of a run's matcher, both ways, on manifest `rows` (n,) with its touch `features` (n, E), class pooling.

    Raises UserError for a run without a matching head, and where no touch was felt by two sensors.
    """
    logits = matcher(run)
    objects = text_column(manifest, "object")[rows]
    found = []
    for negatives in WAYS:
        anchor, positive, negative = draw_triples(manifest, rows, negatives)
        right, wrong = logits(features[anchor], features[positive]), logits(features[anchor], features[negative])
        correct = np.mean([right > 0, wrong <= 0], axis=0)
        sensor = manifest.codes("sensor")[rows]
        codes = [sensor[anchor] * (1 + sensor.max()) + sensor[other] for other in (positive, negative)]
        guess = best_rule(codes[0], codes[1], anchor)
        low, high = mean_interval(correct, objects[anchor])
        count = len(np.unique(anchor))
        shares = (float(correct.mean()), low, high, auc(right, wrong), guess)
        found.append(MatchScore(negatives, *shares, len(anchor), count))
    return found


def matcher(run: str | Path) -> Any:
    """The matching head of a run: (features (n, E), features (n, E)) -> logits f32 (n,). Raises UserError."""
    params, text, _ = checkpoint.load_params(run)
    model = from_json(text).model
    if model.match_head == "cosine":
        raise UserError("the run matches by cosines, without a head: see its retrieval")
    if "matcher" not in params:
        raise UserError("the run has no matching head; give one of stage 2")
    net, kept = build(model), {"matcher": params["matcher"]}

    @jax.jit
    def logits(first: Any, second: Any) -> jax.Array:
        return net.apply(kept, "match", normalise(first), normalise(second))

    return lambda first, second: np.asarray(logits(first, second))


def draw_triples(
    manifest: Manifest, rows: Array, negatives: Negatives, *, draws: int = DRAWS, seed: int = 0
) -> tuple[Array, Array, Array]:
    """(anchors, positives, negatives) as places in `rows`, i64 (m,) each: `draws` of every anchor, as in training."""
    names = ("touch", "sensor", "unit", "object", "dataset")
    keys = MatchKeys(*(manifest.codes(name, own=name == "touch") for name in names))
    matches = Matches(rows, keys, same_sensor=negatives == "same_sensor", other_object=True)
    if not matches.anchors.size:
        which = "" if negatives == "any" else ", one of which felt another place"
        raise UserError(f"no touch of these rows was felt by two sensors{which}: there is nothing to match")
    triples = [
        (int(anchor), *matches.draw(int(anchor), np.random.default_rng([seed, int(anchor), turn])))
        for anchor in matches.anchors
        for turn in range(draws)
    ]
    anchor, positive, negative = np.asarray(triples, np.int64).T
    return anchor, positive, negative


def auc(right: Array, wrong: Array) -> float:
    """Chance that one of `right` (n,) is above one of `wrong` (m,); a tie counts half."""
    values = np.sort(np.asarray(wrong, np.float64))
    below, upto = (np.searchsorted(values, np.asarray(right, np.float64), side) for side in ("left", "right"))
    return float((below + upto).mean() / (2 * len(values)))


def best_rule(right: Array, wrong: Array, anchor: Array) -> float:
    """Accuracy of the best rule that sees a code only: codes i64 (n,) of positives and of negatives, each class half.

    It is learned on half of the anchors (`anchor` i64 (n,)) and scored on the other, then the halves change places:
    scored where it was learned, it would find something in codes that say nothing. It guesses where it learned nothing.
    """
    names, place = np.unique(anchor, return_inverse=True)
    half = (np.random.default_rng(0).permutation(len(names)) % 2)[place]
    codes, code = np.unique(np.stack([right, wrong]), return_inverse=True)
    code, yes = code.reshape(2, -1), np.empty((2, len(place)))
    for side in (0, 1):
        seen = [np.bincount(one[half != side], minlength=len(codes)) for one in code]
        yes[:, half == side] = (0.5 + 0.5 * np.sign(seen[0] - seen[1]))[code[:, half == side]]
    return float((yes[0].mean() + 1 - yes[1].mean()) / 2)


def table(found: Sequence[MatchScore]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """(head, rows) of a table: negatives, accuracy with its interval, AUC, what the sensors alone reach, triples."""
    words = {"any": "of any sensor", "same_sensor": "of the positive's sensor"}
    rows: list[tuple[str, ...]] = []
    for one in found:
        between = "" if one.low is None or one.high is None else f" ({100 * one.low:.1f} to {100 * one.high:.1f})"
        share = f"{100 * one.accuracy:.1f} %{between}"
        lock = f"{100 * one.sensors_alone:.1f} %"
        rows.append((words[one.negatives], share, f"{one.auc:.3f}", lock, str(one.triples)))
    return ("negatives", "accuracy (chance 50 %)", "AUC", "by the sensors alone", "triples"), rows
