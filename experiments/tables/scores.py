"""What is measured of a run's encoder, question by question: rows {view, task, protocol, metric,
mean, low, high, ...}.

A view says of which data and how: `seen` (the sensors trained on), `seen, other data` (a data set
never trained on), `unseen` and `unseen, other data` (a sensor never trained on), `clips`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.evaluate import plots, retrieval
from anytouch_jax.evaluate.feature_cache import (
    FeatureSource,
    background_difference,
    encoder_features,
    pixel_features,
)
from anytouch_jax.evaluate.probing import probe_tasks
from anytouch_jax.evaluate.retrieval import contact_vector
from experiments.image_tower import image_tower_encoder
from experiments.tables import cuts, plan
from experiments.tables.plan import Leaf

if TYPE_CHECKING:
    from experiments.tables.work import Work

Row = dict[str, Any]
STATIC = ("material", "roughness", "hardness")
FORM = "indenter"  # no caption names it
DYNAMIC = ("slip", "force", "twist", "slide")
BOTH = "released"  # reports both protocols
PIXELS = "pixels"
CONTACT = "contact"
SHOWN = ("gelsight", "digit", "gelsight_mini")  # of the t-SNE, as the paper shows three
TOUCHES = 30


def score(leaf: Leaf, work: Work) -> dict[str, Any]:
    """The results of a run: `rows`, `data` (names of the manifests read), and what else the
    question wants.
    """
    return _OF[leaf.question](leaf, work)


def encoder_of(leaf: Leaf, work: Work) -> Encoder:
    """The encoder of a run: trained, the image tower of a trained model, or untrained."""
    if leaf.model is None:
        return random_encoder(untrained(leaf), leaf.seed)
    run = work.run_of(leaf.model)
    if leaf.tower:
        return image_tower_encoder(run)
    return load_encoder(run)


def untrained(leaf: Leaf) -> Config:
    """The configuration of the encoder of a run that trains nothing."""
    return plan.training(leaf.size, "no_stage2", leaf.seed).config


def quiet(_: str) -> None:
    """An unseen sensor is served by the universal tokens: that is what is asked here."""


def _probes(
    leaf: Leaf,
    work: Work,
    name: str,
    tasks: Sequence[str],
    view: str,
    encoder: Encoder | None,
    **options: Any,
) -> list[Row]:
    """Results of `probe_tasks` on a manifest (by its file name in a data set), for an encoder or
    (None) raw pixels.
    """
    dataset, _, file = name.partition("/")
    table = manifests.read(work.folder / dataset / file)
    shared: dict[str, Any] = {"seeds": leaf.size.refits, "max_rows": leaf.size.max_rows} | options
    cache = work.folder / "cache"
    if encoder is None:
        source = FeatureSource(PIXELS, pixel_features(table, folder=cache), None, "common")
    else:
        source = FeatureSource("encoder", encoder_features(encoder, table, folder=cache), encoder)
    results = probe_tasks([source], table, tasks, controls=False, log=quiet, **shared)["results"]
    return [
        {"view": view} | {key: value for key, value in one.items() if key != "features"}
        for one in results
    ]


def _four_columns(
    leaf: Leaf, work: Work, seen: Sequence[str], tasks: Sequence[str] = ("material",)
) -> list[Row]:
    """The columns of the paper's tables: `seen` sensors (TAG), other data (Feel), an unseen sensor
    (OF 1.0, OF 2.0).

    Of each the material and the form of the indenter; of the first also `tasks`.
    """
    encoder = None if leaf.name == PIXELS else encoder_of(leaf, work)
    rows = []
    for view, name, sensors, labels in (
        ("seen", "own", tuple(seen), tasks),
        ("seen, other data", "other", plan.SENSORS[:1], ("material",)),
        ("unseen", "own", (plan.UNSEEN,), ("material",)),
        ("unseen, other data", "other", (plan.UNSEEN,), ("material",)),
    ):
        labels = (*labels, FORM)
        options = {"train_sensors": sensors, "test_sensors": sensors, "protocol": BOTH}
        rows += _probes(leaf, work, f"{name}/{cuts.WHOLE}", labels, view, encoder, **options)
    return rows


def _q1(leaf: Leaf, work: Work) -> dict[str, Any]:
    return {"rows": _four_columns(leaf, work, plan.SENSORS[:1]), "data": ["own", "other"]}


def _q3(leaf: Leaf, work: Work) -> dict[str, Any]:
    rows = _four_columns(leaf, work, plan.SENSORS, STATIC) + _dynamic(leaf, work)
    return {"rows": rows, "data": ["own", "other"]}


def _ablations(leaf: Leaf, work: Work) -> dict[str, Any]:
    return {"rows": _four_columns(leaf, work, plan.SENSORS), "data": ["own", "other"]}


def _dynamic(leaf: Leaf, work: Work) -> list[Row]:
    """The dynamic tasks, from clips."""
    encoder = None if leaf.name == PIXELS else encoder_of(leaf, work)
    options = {
        "train_sensors": plan.SENSORS,
        "test_sensors": plan.SENSORS,
        "protocol": BOTH,
        "frames": 3,
    }
    return _probes(leaf, work, f"own/{cuts.WHOLE}", DYNAMIC, "clips", encoder, **options)


def _q2(leaf: Leaf, work: Work) -> dict[str, Any]:
    """The space of the test touches by the sensors trained on: numbers, and the t-SNE of some
    touches.
    """
    table = manifests.read(work.folder / "own" / cuts.STATIC)
    sensors = table.text_column("sensor")
    rows = table.rows_of("test")
    rows = rows[np.isin(sensors[rows], plan.SENSORS)]
    if leaf.name == PIXELS:
        found = {"class token": background_difference(table, rows)}
    elif leaf.name == CONTACT:
        found = {"class token": contact_vector(table, rows)}
    else:
        encoder = encoder_of(leaf, work)
        found = {"class token": embed_rows(encoder, table, rows, log=quiet)[1]}
    metric: retrieval.Metric = "euclidean" if leaf.name == CONTACT else "cosine"
    results = [
        row for view, values in found.items() for row in _space(table, rows, values, view, metric)
    ]
    return {
        "rows": results,
        "points": _points(table, rows, found["class token"], leaf.seed),
        "data": ["own"],
    }


def _space(
    table: Any, rows: np.ndarray, values: np.ndarray, view: str, metric: retrieval.Metric
) -> list[Row]:
    sensors = table.text_column("sensor")[rows]
    touch = table.codes("touch", own=True)[rows]
    about = plots.describe(values, sensors, table.text_column("object")[rows], touch)
    fewest = min(len(np.unique(touch[sensors == one])) for one in np.unique(sensors))
    pooled = retrieval.cross_sensor_retrieval(
        table,
        {view: values},
        rows,
        gallery_size=min(retrieval.GALLERY, fewest),
        centre=(False,),
        metrics={view: metric},
    )[-1]
    plain = {
        "alignment": about.alignment,
        "uniformity": about.uniformity,
        "silhouette by sensor": about.silhouette_sensor,
        "silhouette by object": about.silhouette_object,
    }
    shared = {"view": view, "protocol": "grouped", "test": len(rows)}
    found = [
        shared | {"task": name, "metric": name, "mean": value} for name, value in plain.items()
    ]
    for name, mean, low, high, chance in (
        ("top-1", pooled.top1, pooled.low, pooled.high, pooled.chance1),
        ("top-5", pooled.top5, pooled.top5_low, pooled.top5_high, pooled.chance5),
    ):
        about_it = {
            "task": name,
            "metric": "fraction",
            "mean": mean,
            "low": low,
            "high": high,
            "chance": chance,
        }
        found.append(
            shared
            | about_it
            | {"gallery": pooled.gallery, "of": fewest, "nearness": pooled.nearness}
        )
    return found


def _points(table: Any, rows: np.ndarray, values: np.ndarray, seed: int) -> list[Row]:
    """The t-SNE of some touches by three sensors: {x, y, sensor, touch} of each."""
    sensors = table.text_column("sensor")[rows]
    touch = table.codes("touch", own=True)[rows]
    names = np.unique(touch)
    # the same touches for all
    some = np.random.default_rng(0).permutation(names)[:TOUCHES]
    keep = np.isin(sensors, SHOWN) & np.isin(touch, some)
    places = plots.tsne(values[keep], seed=seed)
    return [
        {
            "x": round(float(x), 3),
            "y": round(float(y), 3),
            "sensor": str(sensor),
            "touch": int(code),
        }
        for (x, y), sensor, code in zip(places, sensors[keep], touch[keep], strict=True)
    ]


_OF: Mapping[str, Callable[[Leaf, Work], dict[str, Any]]] = {
    "q1": _q1,
    "q2": _q2,
    "q3": _q3,
    "ablations": _ablations,
}
