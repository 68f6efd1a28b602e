"""`anytouch data`: manifests made from data sets or simulated, marked, checked, captioned and
packed.
"""

from __future__ import annotations

import math
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional

from anytouch_jax.cli import output
from anytouch_jax.config.parsing import (
    Above0,
    Count,
    Finite,
    NotNegative,
    Range,
    Ratio,
    Threads,
)
from anytouch_jax.config.scenes import SceneOptions
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from anytouch_jax.progress import bar

if TYPE_CHECKING:
    from anytouch_jax.datasets.captions import CaptionResult, CostEstimate, Endpoint
    from anytouch_jax.sim.scene import Scenes


Portion = Annotated[float | None, Range(0, 1, "0 to 1")]


@dataclass(frozen=True)
class _OutputFolder:
    """The first option of `SimulateOptions`: a base of its own, so that it has no default."""

    out: Path  # Folder for images and manifest.parquet.


@dataclass(frozen=True)
class SimulateOptions(SceneOptions, _OutputFolder):
    """Simulate touches felt by several sensors, with RGB images, captions, forces and slip.

    Example: anytouch data simulate --out data/scenes --touches 400 --sensors gelsight_mini digit
    --seed 0

    Run the same command again to continue after an interruption.
    """

    threads: Threads = 2  # Threads that render RGB images and write files.


def run_simulate(options: SimulateOptions) -> int:
    """Simulate a data set, or finish one that was interrupted; 130 after Ctrl-C."""
    from anytouch_jax.sim.dataset import simulate
    from anytouch_jax.sim.scene import Scenes
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    scenes = Scenes(**{each.name: getattr(options, each.name) for each in fields(SceneOptions)})
    missing = _missing_splits(scenes)
    if missing:
        output.log(
            f"no touch is in split {' or '.join(missing)}. Use more touches or about 16 objects or "
            "more."
        )
    last = -1
    with bar(options.touches, "touches") as advance, _exit_on_interrupt():

        def report(done: int, of: int) -> None:
            nonlocal last
            if last < 0 and done < of:
                output.log(
                    f"compiling the contact solver for {', '.join(scenes.sensors)}: about a minute "
                    "at first"
                )
            elif not sys.stderr.isatty() and 10 * done // of > 10 * last // of:
                output.log(f"{done} of {of} touches")
            last = done
            advance(done)

        path = simulate(scenes, options.out, threads=options.threads, progress=report)
    output.log(
        f"{path}: {options.touches} touches by {', '.join(scenes.sensors)}{_unconverged(path)}"
    )
    return 0


@contextmanager
def _exit_on_interrupt() -> Iterator[None]:
    """Exit at once on Ctrl-C.

    A thread that compiles would not react for a minute. Files are written atomically, so nothing is
    left half done.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # ignored, as in a script's background
        yield
        return

    def end(*_: Any) -> None:
        from rich.console import Console

        Console(stderr=True).show_cursor()  # which the bar hides
        output.log(
            "interrupted: finished touches are kept. Run the same command again to continue."
        )
        os._exit(130)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _missing_splits(scenes: Scenes) -> list[str]:
    """Return the splits without a touch, where objects are held out."""
    from anytouch_jax.sim.scene import draw_touch, objects_and_splits

    splits = objects_and_splits(scenes)[1]
    # one turn of each object
    numbers = range(scenes.first, scenes.first + min(scenes.touches, len(splits)))
    present = {draw_touch(scenes, number, splits).split for number in numbers}
    return [name for name in ("val", "test") if scenes.held_out and name not in present]


def _unconverged(manifest: Path) -> str:
    """Return how many frames of fidelity exact did not converge, in words; "" for none."""
    import pyarrow.parquet as pq

    if "label.converged" not in pq.read_schema(manifest).names:
        return ""
    table = pq.read_table(manifest, columns=["label.converged"])
    column = table["label.converged"].drop_null().to_numpy()
    count = int((column < 1).sum())
    if count:
        return f". {count} of {len(column)} frames did not converge (label.converged)"
    return ""


@dataclass(frozen=True)
class DatasetOptions:
    """Make a manifest of a downloaded dataset or of your recordings: one row per tactile frame.

    Example: anytouch data index ycb_slide ~/data/YCB-Slide --out ~/data/YCB-Slide/ycb_slide.parquet

    Datasets: touch_and_go, visgel, cloth, objectfolder_real, tvl, ssvtp, ycb_slide, octopi,
    tacquad, feel, objectfolder, real_touch, taxim_presses, gelsight_mini_pretrain, fota,
    tacbench_force, tacbench_pose, touchd_force, freetacman, webdataset, lerobot, bags, hdf5, zarr,
    recordings. Use recordings for your data: a folder of images or a stack of frames (.npy,
    .npz) for each recording, as OBJECT/RECORDING/0.png. Put background.png, photo.jpg and
    caption.txt there or in a folder above. For hdf5 and zarr, `anytouch info FILE` lists the keys.
    """

    name: Positional[str]  # Name of the dataset.
    # Folder that holds the unpacked dataset. hdf5, zarr: or one file.
    root: Positional[Path]
    # Manifest to write, .parquet or .csv, in ROOT or above it (default: ROOT/NAME.parquet).
    out: Path | None = None
    # Keep your edits of the manifest OUT: columns, splits, texts and labels, matched by path.
    keep: bool = False
    val: Portion = None
    """Fraction of the objects or recordings in split val, for a dataset without splits (default:
    0.05. recordings, hdf5, zarr: of fewer than 100, 5 of them, but at most a tenth).
    """
    test: Portion = None
    """Fraction of the objects or recordings in split test, for a dataset without splits (default:
    0.05. recordings, hdf5, zarr: of fewer than 200, 10 of them, but at most a fifth).
    """
    lists: Path | None = None  # Folder of the dataset's list files, if they are not in ROOT.
    # touch_and_go: the task whose lists decide the split.
    task: Literal["material", "rough"] = "material"
    fold: NotNegative[int] = 0  # feel: the fold k whose split_<k>.npy decides the split.
    # Let the reader write images into ROOT, for a dataset of arrays or videos.
    export: bool = False
    sensor: str | None = None
    """recordings, webdataset, lerobot, bags, hdf5, zarr: the sensor, by its name, a new name or a
    folder NAME.sensor.
    """
    split_by: str | None = None
    """recordings: what is held out: object, recording (a single image is one), a column of the
    labels, or the part of the path in the parentheses of a pattern, as '(p[0-9]+)_'. Default:
    object. For single images: recording.
    """
    # recordings: every image is a touch alone. By default names decide, and a few images.
    singles: bool = False
    videos: bool = False  # recordings: every folder of images is a video.
    # recordings: order frames by their names, or by the times of the files.
    order: Literal["names", "times"] = "names"
    labels: Path | None = None
    """recordings: CSV table with a column object, sequence or both. Each other column becomes
    label.NAME, but unit, touch and text keep their names.
    """
    # gelsight_mini_pretrain, fota, webdataset: address of the shards, as s3://BUCKET/FOLDER.
    url: str | None = None
    keys: tuple[str, ...] = ()
    """lerobot, freetacman: tactile cameras. bags: topics of tactile images. webdataset: fields, as
    left.jpg. hdf5, zarr: arrays of tactile images, as obs/tactile.
    """
    values: tuple[str, ...] = ()
    """lerobot, hdf5, zarr: features or arrays that become labels. bags: labels from other topics,
    as force_z=/ft:wrench.force.z.
    """


def run_index(options: DatasetOptions) -> int:
    """Read the dataset, write its manifest, and print the counts with the paper's."""
    from anytouch_jax.datasets import readers
    from anytouch_jax.encoder.sensor_words import resolve_sensor

    place = ("name", "root", "out", "keep")
    settings = readers.IndexOptions(
        **{name: value for name, value in vars(options).items() if name not in place}
    )
    if options.sensor is not None:  # a manifest has the name of a fitted sensor, not its folder
        settings = replace(settings, sensor=resolve_sensor(options.sensor).name)
    report = readers.index(
        options.name, options.root, options.out, options=settings, keep=options.keep
    )
    if report.written:
        output.log(f"{report.written:,} images were written into {options.root}")
    print("\n".join(report.lines()))
    return 0


@dataclass(frozen=True)
class ContactOptions:
    """Mark the frames in contact by their difference from the untouched gel, without markers.

    Example: anytouch data contact ycb_slide.parquet --drop --out ycb_touched.parquet --image
    contact.png

    The manifest gets the columns label.contact_score and label.contact: 1, 0, or empty if unknown.
    Images of the untouched gel that had to be estimated are stored next to it, as the
    background_path of their rows.
    """

    manifest: Positional[Path]  # Manifest to mark (.csv, .parquet).
    out: Path | None = None  # Manifest to write (default: NAME_contact, next to the manifest).
    # Drop frames without contact. The split background and unknown frames stay.
    drop: bool = False
    threshold: NotNegative[tuple[tuple[str, float], ...]] = ()
    """Contact threshold of the score by sensor, as in: digit 5 gelsight 7."""
    background: tuple[str, ...] = ()
    """Image of the untouched gel for recordings without one: FILE for all, or UNIT=FILE for each
    sensor unit.
    """
    fraction: Ratio = 0.0
    """Also require this fraction (0 to 1) of the highest score of the recording. This removes the
    start and end of a contact. --image and --check ignore it.
    """
    # PNG of kept and dropped frames by score. Look at it before you trust a threshold.
    image: Path | None = None
    # Print precision and recall against a reference column. Writes a manifest only with --out.
    check: bool = False
    # Column for --check (default: label.force, label.contact or label.contact_score).
    reference: str | None = None
    # Value of the reference column above which a frame is in contact.
    above: Finite[float | None] = None
    threads: Threads = 2  # Threads that read images.


def run_contact(options: ContactOptions) -> int:
    """Score every frame, then write the marked manifest, the image, or the comparison with a
    column.
    """
    import numpy as np

    from anytouch_jax.data.background import contact
    from anytouch_jax.data.manifest import manifest as manifests

    if not options.check:
        output.refuse_unused(options, ("reference", "above"), "without --check")
    elif options.out is None:
        output.refuse_unused(
            options, ("drop",), "on --check, which writes a manifest only with --out"
        )
    manifest = manifests.read(options.manifest)
    target = options.out or (
        None if options.check else output.default_target(options.manifest, "contact")
    )
    if target is not None:
        output.check_new(manifest, target)
    output.check_apart(out=target, image=options.image)
    if options.image is not None:
        frames = map(manifest.file, range(len(manifest))) if options.image.exists() else ()
        output.check_folder(
            options.image, "--image", read=(*manifest.files, *frames), suffix=".png"
        )
    thresholds = dict(options.threshold)
    # raises for a mistake, before the work
    contact.threshold_of_rows(manifest, thresholds, options.fraction)
    if options.check:
        contact.reference_contact(manifest, options.reference)
    if not np.isnan(contact.known_contact(manifest)).any() and not options.check:
        output.refuse_unused(
            options,
            ("threshold", "fraction", "background"),
            "on rows that all have a label.contact, which is kept",
        )
    backgrounds = contact.read_backgrounds(manifest, options.background)
    scores = contact.contact_scores(manifest, backgrounds=backgrounds, workers=options.threads)
    if target is not None and scores.backgrounds:
        folder = target.with_name(f"{target.stem}_backgrounds")
        manifest = contact.store_backgrounds(manifest, scores, folder)
        output.log(
            f"{folder}: {len(scores.backgrounds)} images of the untouched gel, now the "
            "background_path of their rows"
        )
    fraction = options.fraction
    drop = options.drop
    marked, report = contact.mark_contact(
        manifest, scores, thresholds=thresholds, fraction=fraction, drop=drop
    )
    print("\n".join(report.lines()))
    if options.check:
        quality = contact.contact_quality(
            manifest,
            scores,
            reference=options.reference,
            above=options.above,
            thresholds=thresholds,
        )
        print("\n".join(quality.lines()))
    if options.image is not None:
        image = contact.contact_sheet(manifest, scores, options.image, thresholds=thresholds)
        output.log(f"{image}: kept and dropped frames")
    if target is not None:
        print(
            f"{output.write_new(marked, target)}: {len(marked):,} rows, with label.contact_score "
            "and label.contact"
        )
    return 0


@dataclass(frozen=True)
class VerifyOptions:
    """Check manifests and their files: missing, broken, repeated, swapped, or leaking between
    splits.

    Example: anytouch data verify touch.parquet --repair touch_clean.parquet

    Exits with 1 if there are errors, or errors that --repair could not remove. Ends with the
    licences of the data.
    """

    manifests: Positional[tuple[Path, ...]]  # Manifests to check together (.csv, .parquet).
    repair: Path | None = None
    """Write a repaired copy: without unusable rows and files and repeated rows, with swapped
    folders exchanged.
    """
    # Write a copy with rows that certainly allow commercial use, after --repair.
    commercial_only: Path | None = None
    # With --repair: exchange touch image and RGB image in these datasets. Look first.
    swap: tuple[str, ...] = ()
    decode: bool = True  # Decode every image. --no-decode only checks that the files exist.
    objects: bool = False  # Report an object in two splits as an error.
    threads: Threads = 4  # Threads that read files.
    out: Path | None = None  # Write the report as JSON too.


def run_verify(options: VerifyOptions) -> int:
    """Print the report; 1 if errors remain."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.datasets import verify

    if options.swap and options.repair is None:
        raise UserError(
            "--swap exchanges files in the repaired copy. Name that copy with --repair."
        )
    output.check_apart(
        repair=options.repair, commercial_only=options.commercial_only, out=options.out
    )
    manifest = manifests.read(options.manifests)
    verify.check_swap(manifest, options.swap)
    for target in (options.repair, options.commercial_only):
        if target is not None:
            output.check_new(manifest, target)
    if options.commercial_only is not None:
        # raises for a manifest without such rows, before the work
        verify.commercial_only(manifest)
    output.check_folder(options.out, read=manifest.files)
    report = verify.verify(
        manifest, decode=options.decode, objects=options.objects, threads=options.threads
    )
    print(report.to_markdown(), end="")
    if options.out is not None:
        atomic_write(options.out, report.to_json())
        output.log(f"{options.out}: the report")
    errors = [finding.sentence for finding in report.findings if finding.level == "error"]
    if options.repair is not None:
        repaired = verify.repair(manifest, report, swap=options.swap)
        target = output.write_new(repaired.manifest, options.repair)
        print(f"\n{target}: {len(repaired.manifest):,} of {len(manifest):,} rows")
        print("\n".join(f"* {sentence}" for sentence in repaired.done or ("nothing to repair",)))
        for sentence in repaired.left:
            print(f"* left to you: {sentence}")
        manifest = repaired.manifest
        errors = [sentence for sentence in errors if sentence in repaired.left]
    if options.commercial_only is not None:
        commercial = verify.commercial_only(manifest)
        target = output.write_new(commercial.manifest, options.commercial_only)
        print(
            f"{target}: {len(commercial.manifest):,} rows, without {commercial.non_commercial:,} "
            f"non-commercial rows and {commercial.unknown:,} rows of unknown licence"
        )
    if errors:
        return 1
    return 0


@dataclass(frozen=True)
class AnnotateOptions:
    """Caption every touch without a text by a vision-language model, as the paper did with GPT-4o.

    Example: anytouch data annotate tacquad.parquet --vlm gpt-4o --limit 20 --sheet look.html

    Prints an estimate of the cost and asks before it starts. The key comes from the environment and
    is never stored. Run the same command again to continue: answers are kept. Exits with 1 if a
    caption is missing.
    """

    manifest: Positional[Path]  # Manifest with RGB images or phrases (.csv, .parquet).
    out: Path | None = None  # Manifest to write (default: NAME_captions, next to the manifest).
    # Folder that keeps every answer (default: NAME_answers, next to the manifest).
    answers: Path | None = None
    # Base address of an OpenAI-compatible endpoint. A local one needs no key.
    url: str = "https://api.openai.com/v1"
    vlm: str = "gpt-4o"  # Name of the vision-language model.
    key_variable: str = "OPENAI_API_KEY"  # Environment variable that holds the key.
    yes: bool = False  # Do not ask for confirmation.
    estimate: bool = False  # Print the estimate and stop.
    # Price of a million input tokens, for the estimate.
    price_in: NotNegative[float | None] = None
    price_out: NotNegative[float | None] = None  # Price of a million output tokens.
    limit: Count[int | None] = None  # Number of captions to ask for, to look at a sample first.
    captions: Path | None = None
    """Read captions from this table (.csv, .parquet) with a key column and `text`, and ask no
    model.
    """
    # Column that joins --captions and the manifest: caption_id, sequence, object, path, ...
    key: str | None = None
    sheet: Path | None = None  # HTML page of captions with their images, to check by eye.
    sheet_count: Count[int] = 40  # Captions on that page.
    split: str | None = None  # Only rows of this split.
    family: tuple[tuple[str, Literal["photograph", "object", "phrase"]], ...] = ()
    """Prompt of your dataset, as in: mydata photograph."""
    second_image: str = "image2_path"  # Column of a second RGB image, for the prompt object.
    overwrite: bool = False  # Also ask for rows that have a caption.
    threads: Threads = 4  # Questions at a time.
    # Longest side of the images that are sent, pixels.
    side: Annotated[int, Range(16, math.inf, "16 or more")] = 512
    timeout: Above0[float] = 60.0  # Seconds to wait for an answer.
    tries: Count[int] = 5  # Tries for a question.
    max_tokens: Count[int] = 200  # Largest number of tokens of an answer.
    # Name of that limit in the protocol. Newer models need max_completion_tokens.
    token_field: str = "max_tokens"
    temperature: NotNegative[float | None] = 0.0  # Temperature. None is not sent.
    json_mode: bool = True  # Ask for a JSON object. Use --no-json-mode for servers without it.


# Only these have an effect with --captions, which asks no model.
_WITH_CAPTIONS = ("manifest", "out", "captions", "key", "overwrite", "sheet_count")


def run_annotate(options: AnnotateOptions) -> int:
    """Estimate, ask for consent, annotate, and write the manifest with its captions."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.datasets.captions import annotate, sample_sheet
    from anytouch_jax.datasets.prompts import attach_text

    if options.captions is not None:
        asking = [name for name in vars(options) if name not in _WITH_CAPTIONS]
        output.refuse_unused(options, asking, "with --captions, which asks no model")
    else:
        output.refuse_unused(options, ("key",), "without --captions")
    if options.sheet is None:
        output.refuse_unused(options, ("sheet_count",), "without --sheet")
    if (options.price_in is None) != (options.price_out is None):
        raise UserError("--price-in needs --price-out, and the reverse: both count in the estimate")
    manifest = manifests.read(options.manifest)
    target = options.out or output.default_target(options.manifest, "captions")
    if not options.estimate:
        output.check_new(manifest, target)
        output.check_folder(target, read=() if options.captions is None else (options.captions,))
    output.check_apart(out=target, sheet=options.sheet)
    output.check_folder(options.sheet, "--sheet", read=manifest.files)
    if options.captions is not None:
        table = options.captions
        overwrite = options.overwrite
        captioned, notes = attach_text(manifest, table, key=options.key, overwrite=overwrite)
        for note in notes:
            output.log(note)
        count = int(captioned.present("text").sum())
        print(
            f"{output.write_new(captioned, target)}: {count:,} of {len(captioned):,} rows have a "
            "caption"
        )
        return 0
    annotated = annotate(
        manifest,
        _endpoint(options),
        options.answers or output.default_target(options.manifest, "answers", ""),
        confirm=lambda estimate: _confirm(options, estimate),
        price_in=options.price_in,
        price_out=options.price_out,
        threads=options.threads,
        side=options.side,
        split=options.split,
        families=dict(options.family),
        overwrite=options.overwrite,
        second_image=options.second_image,
        limit=options.limit,
        log=output.log,
    )
    _print_summary(annotated)
    if options.sheet is not None:
        sheet = sample_sheet(manifest, annotated.captions, options.sheet, count=options.sheet_count)
        output.log(f"{sheet}: captions to check")
    print(f"{output.write_new(annotated.manifest, target)}: {len(annotated.captions):,} captions")
    if annotated.failures:
        return 1
    return 0


def _endpoint(options: AnnotateOptions) -> Endpoint:
    from anytouch_jax.datasets.captions import Endpoint

    _, _, *names = (field.name for field in fields(Endpoint))
    return Endpoint(options.url, options.vlm, **{name: getattr(options, name) for name in names})


def _confirm(options: AnnotateOptions, estimate: CostEstimate) -> bool:
    print(f"{options.vlm} at {options.url}: {estimate}", flush=True)
    if options.estimate:
        raise SystemExit(0)  # nothing is sent
    if not estimate.questions:
        return True
    # raises for a missing key, before the question
    _endpoint(options).read_key()
    if options.yes:
        return True
    if not sys.stdin.isatty():
        raise UserError(
            "There is no terminal to confirm on. Add --yes, or --estimate to print the estimate "
            "only."
        )
    try:
        return input("Ask now? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _print_summary(annotated: CaptionResult) -> None:
    print(
        f"{annotated.requests:,} questions, {annotated.tokens_in:,} tokens in, "
        f"{annotated.tokens_out:,} tokens out"
    )
    for reason, count in annotated.left_out.items():
        print(f"left out, {reason}: {count:,} rows")
    for failure in annotated.failures[:5]:
        output.log(
            f"no caption for {failure.where} and the {failure.rows} rows of its touch: "
            f"{failure.reason}"
        )
    if len(annotated.failures) > 5:
        output.log(f"and {len(annotated.failures) - 5} more, listed in failures.jsonl")


@dataclass(frozen=True)
class PackOptions:
    """Store millions of small files in a few ZIP shards, from which training reads the same
    batches.

    Example: anytouch data pack touch.parquet --out packed

    Run the same command again to continue after an interruption.
    """

    manifests: Positional[tuple[Path, ...]]  # Manifests to pack into one (.csv, .parquet).
    # Folder for manifest.parquet and the shards (default: NAME_packed, next to the manifest).
    out: Path | None = None
    shard_mb: Count[int] = 256  # Size of a shard, MiB.
    threads: Threads = 4  # Threads that read files.


def run_pack(options: PackOptions) -> int:
    """Pack the files, or continue an interrupted pack."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.datasets.shards import pack

    manifest = manifests.read(options.manifests)
    folder = options.out or output.default_target(options.manifests[0], "packed", "")
    target = pack(
        manifest,
        folder,
        shard_bytes=options.shard_mb << 20,
        threads=options.threads,
        log=output.log,
    )
    print(
        f"{target}: {len(manifest):,} rows. Train on it as on any manifest. Check a copy with "
        "sha256sum -c SHA256SUMS."
    )
    return 0
