"""`anytouch retrieve` and `anytouch report`.

The first is cross-sensor retrieval of the same touch, or a search among stored ones. The second
evaluates a stage-1 and a stage-2 run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import (
    check_folder,
    check_home,
    log,
    log_default,
    print_table,
    refuse_unused,
)
from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL, check_spelling
from anytouch_jax.config.parsing import Count, Range, Seed
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.evaluate.retrieval import Retrieval


@dataclass(frozen=True)
class RetrieveOptions:
    """Retrieve the same touch felt by another sensor, or search stored touches.

    Example: anytouch retrieve --model runs/stage2 --data data/scenes/manifest.parquet

    You get recall@1 and recall@5 with controls and intervals. A gallery holds the true touch once,
    and the touches most similar to it in position, depth and force. With --index, list the stored
    touches nearest to --query instead.
    """

    # Manifest with the columns touch and unit, and contact labels (label.x, y, depth, force).
    data: Path | None = None
    index: Path | None = None  # Features of `anytouch embed` to search in, of any sensors.
    # What to look for in --index: an image, a folder or video (last clip), or a sentence.
    query: str | None = None
    sensor: str | None = None  # Sensor of the query. Without it the universal tokens are used.
    background: Path | None = None  # Image of the untouched gel of the query.
    count: Count[int] = 10  # Nearest touches to list.
    # Search in the nearest cells alone (FAISS), for very many features.
    approximate: bool = False
    # Encoders to compare: names, run folders or weights files (default: anytouch-tiny).
    model: tuple[Path, ...] = ()
    split: str = "test"  # Split to retrieve in.
    # Frames of a touch: 1 for stills, 3 or more for the clip that ends at each deepest frame.
    frames: Count[int] = 1
    # Features: class token, mean of the patch tokens, or both.
    pooling: Literal["class", "mean", "both"] = "class"
    # Touches in a gallery.
    gallery: Annotated[int, Range(2, math.inf, "2 or more, with the touch")] = 50
    by_chance: bool = False  # Draw the galleries at random, not by similarity.
    seeds: Count[int] = 5  # Galleries drawn for each query, with --by-chance.
    controls: bool = True
    """Also score a random encoder, background-subtracted pixels, and the contact's area, centroid
    and force.
    """
    out: Path | None = None  # Write the results as JSON.


def run_retrieve(options: RetrieveOptions) -> int:
    """Score cross-sensor retrieval, or search an index, and print a table."""
    if options.index is not None:
        return _search(options, options.index)
    refuse_unused(
        options, ("query", "sensor", "background", "count", "approximate"), "without --index"
    )
    if options.data is None:
        raise UserError("Give a manifest with --data, or features to search in with --index.")
    if not options.by_chance:
        refuse_unused(options, ("seeds",), "without --by-chance")
    check_folder(options.out, read=(options.data, *options.model))
    return _score(options, options.data)


def _score(options: RetrieveOptions, data: Path) -> int:
    """Score retrieval by every encoder and control, print a table, and write JSON with --out."""
    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder import embed as embedding
    from anytouch_jax.evaluate import retrieval
    from anytouch_jax.evaluate.report import VECTOR
    from anytouch_jax.evaluate.tables import markdown_table, plain
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    table = manifests.read(data)
    rows = _rows(options, table)
    encoders = _encoders(options)
    backgrounds = Backgrounds(table)
    for encoder in encoders.values():
        rows = embedding.rows_with_gel(encoder, backgrounds, rows, log)
    settings: dict[str, Any] = {
        "gallery_size": options.gallery,
        "match": None if options.by_chance else retrieval.COVARIATES,
        "seeds": options.seeds,
    }
    # raises for an impossible gallery, before the work
    retrieval.cross_sensor_retrieval(table, {}, rows, **settings)
    log(backgrounds.report(rows))
    values = _features(options, encoders, table, rows, backgrounds)
    scores = retrieval.cross_sensor_retrieval(
        table, values, rows, metrics={VECTOR: "euclidean"}, **settings
    )
    print_table(markdown_table(_COLUMNS, [_cells(score) for score in scores]))
    for note in dict.fromkeys(note for score in scores for note in score.notes):
        log(note)
    if options.out is not None:
        about = {"data": table.content_hash, "split": options.split, "frames": options.frames}
        atomic_write(options.out, json.dumps(about | {"results": plain(scores)}, indent=2) + "\n")
    log_default(options.model)
    return 0


def _encoders(options: RetrieveOptions) -> dict[str, Encoder]:
    """Return the encoders by name, and an untrained one as a control."""
    from anytouch_jax.encoder import encoder as loading

    models = options.model or (Path(DEFAULT),)
    encoders = {str(path): loading.load_encoder(path) for path in models}
    if options.controls:
        first = next(iter(encoders.values()))
        encoders["random encoder"] = loading.random_encoder(first.config)
    for encoder in encoders.values():
        loading.check_frames(encoder.config.model, options.frames)
    return encoders


def _rows(options: RetrieveOptions, table: Manifest) -> np.ndarray:
    """Return the deepest rows of the split, of sensors with images."""
    import numpy as np

    from anytouch_jax.evaluate import retrieval

    rows = table.rows_of(options.split)
    rows = rows[~np.isin(table.text_column("sensor")[rows], FIELD_SENSORS)]
    return retrieval.deepest_rows(table, rows, frames=options.frames)


def _features(
    options: RetrieveOptions,
    encoders: Mapping[str, Encoder],
    table: Manifest,
    rows: np.ndarray,
    backgrounds: Backgrounds,
) -> dict[str, np.ndarray]:
    """Return the features of the rows by every encoder, and by the controls without one."""
    from anytouch_jax.encoder.embed import embed_rows
    from anytouch_jax.evaluate import retrieval
    from anytouch_jax.evaluate.feature_cache import background_difference
    from anytouch_jax.evaluate.report import PIXELS, VECTOR

    values = {}
    for name, encoder in encoders.items():
        kept, values[name] = embed_rows(
            encoder, table, rows, options.frames, options.pooling, backgrounds=backgrounds, log=log
        )
        if len(kept) < len(rows):
            raise UserError(
                f"{len(rows) - len(kept)} of {len(rows)} rows cannot be read. Repair the manifest "
                "first."
            )
    if options.controls:
        pixels = partial(background_difference, backgrounds=backgrounds)
        for name, make in ((PIXELS, pixels), (VECTOR, retrieval.contact_vector)):
            try:
                values[name] = make(table, rows)
            except UserError as error:
                log(f"no control by {name}: {error}")
    return values


def _search(options: RetrieveOptions, index_file: Path) -> int:
    """List the stored touches nearest to a query."""
    from anytouch_jax.encoder.embed import load_index
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.errors import shorten
    from anytouch_jax.evaluate.tables import markdown_table
    from anytouch_jax.train.mesh import enable_compilation_cache

    others = ("data", "split", "frames", "pooling", "gallery", "by_chance", "seeds", "controls")
    refuse_unused(options, others, "with --index, whose features are searched")
    if options.query is None:
        raise UserError(
            "Give what to look for with --query: an image, a folder, a video or a sentence."
        )
    if len(options.model) > 1:
        raise UserError(f"A search takes one encoder, not {len(options.model)}. Give one --model.")
    if options.sensor is not None:
        check_spelling(options.sensor)  # before the encoder is loaded, which takes seconds
    check_folder(options.out, read=(index_file, *options.model))
    index = load_index(index_file, approximate=options.approximate)
    enable_compilation_cache()
    model = options.model[0] if options.model else Path(DEFAULT)
    encoder = load_encoder(model)
    index.check(encoder.source, encoder.fingerprint)
    query = _query(options, options.query, encoder, index.about, index.backgrounds)
    ids, cosines = index.search(query, options.count)
    hits = []
    for row, cosine in zip(ids[0], cosines[0], strict=True):
        hits.append({"cosine": f"{cosine:.3f}"} | index.describe(row))
    head = list(hits[0])
    print_table(markdown_table(head, [[shorten(hit[name]) for name in head] for hit in hits]))
    if options.out is not None:
        about = {"index": str(index_file), "query": options.query}
        atomic_write(options.out, json.dumps(about | {"hits": hits}, indent=2) + "\n")
    log_default(options.model)
    return 0


def _query(
    options: RetrieveOptions,
    query: str,
    encoder: Encoder,
    about: dict[str, str],
    known: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Return features (1, d) of what is looked for.

    Args:
        options: of the command.
        query: an image, a folder or video, of which the last clip counts, or a sentence.
        encoder: that the index was made by.
        about: how the features of the index were made.
        known: backgrounds by sensor instance, of the index.
    """
    import numpy as np

    from anytouch_jax.cli.embed import choose_gel
    from anytouch_jax.encoder.base import Preprocess

    path = Path(query)
    pooling: Any = about.get("pooling", "class")
    if not path.exists():
        refuse_unused(
            options,
            ("sensor", "background"),
            f"on the sentence {path!s:.60}. There is no such file",
        )
        if pooling != "class":
            raise UserError(
                f"A sentence is compared with features of pooling class, not {pooling}. Embed "
                "again."
            )
        # A sentence says nothing of what a convolutional trunk adds to the features.
        return np.pad(encoder.encode_text(query), ((0, 0), (0, encoder.config.model.sight)))
    length = 1
    if about.get("frames", "1").isdecimal():
        length = int(about.get("frames", "1"))
    frames = _last_frames(path, length)
    gel, _ = choose_gel(encoder, options.background, path, known, "the index was made with")
    preprocess = Preprocess(encoder, gel)
    clip = np.stack([preprocess(frame) for frame in frames])[None]
    aggregation: Any = about.get("join", "mean")
    return encoder.encode_touch(
        clip, options.sensor or UNIVERSAL, pooling=pooling, aggregation=aggregation
    )


def _last_frames(path: Path, length: int) -> list[np.ndarray]:
    """Return the last frames of a folder or video, or an image as often as a clip is long."""
    from anytouch_jax.data import images

    files = images.image_files(path)
    if files is None:
        frames = list(images.frames_from_video(path))[-length:]
    else:
        if not path.is_dir():
            files = files * length  # a still is a clip of equal frames
        frames = [images.decode(file) for file in files[-length:]]
    if len(frames) < length:
        raise UserError(
            f"{path} has {len(frames)} frames, and the index holds clips of {length}. Give more "
            "frames."
        )
    return frames


_COLUMNS = (
    "features",
    "query",
    "gallery",
    "centred",
    "recall@1",
    "95 %",
    "recall@5",
    "chance",
    "of",
    "queries",
)


def _cells(score: Retrieval) -> tuple[str, ...]:
    """Return the cells of _COLUMNS."""
    from anytouch_jax.evaluate.tables import fraction_text, interval_text

    return (
        score.name,
        score.query_sensor,
        score.gallery_sensor,
        "yes" if score.centred else "no",
        fraction_text(score.top1),
        interval_text(score.low, score.high),
        fraction_text(score.top5),
        fraction_text(score.chance1),
        str(score.gallery),
        str(score.queries),
    )


@dataclass(frozen=True)
class ReportOptions:
    """Report what a stage-1 and a stage-2 run have learned, beside guesses.

    Example: anytouch report --data data/scenes/manifest.parquet --stage1 runs/stage1 --stage2
    runs/stage2 --out report

    It begins with three sentences, and has retrieval, probes, hidden patches and losses.
    """

    data: Path  # Manifest of simulated scenes, or one with the same columns.
    stage1: Path  # Run folder of stage 1.
    stage2: Path  # Run folder of stage 2.
    # Folder for report.html (one file with its images), report.md, report.json, figures/.
    out: Path
    # Touches of the test split to use, and half as many of train and val.
    touches: Count[int] = 200
    # Touches in a retrieval gallery.
    gallery: Annotated[int, Range(2, math.inf, "2 or more")] = 50
    seed: Seed = 0  # Random seed.


def run_report(options: ReportOptions) -> int:
    """Write report.html, report.md, report.json and figures/."""
    from anytouch_jax.evaluate.report import demo_report
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_home(options.out)
    enable_compilation_cache()
    demo_report(
        options.data,
        options.stage1,
        options.stage2,
        options.out,
        log,
        touches=options.touches,
        gallery_size=options.gallery,
        seed=options.seed,
    )
    return 0
