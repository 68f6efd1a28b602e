"""`anytouch data contact`: contact scores by difference from the untouched gel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from anytouch_jax.cli import output
from anytouch_jax.cli.output import log, refuse_unused
from anytouch_jax.config.parsing import Finite, NotNegative, Share, Threads


@dataclass(frozen=True)
class ContactOptions:
    """Mark the frames in contact by their difference from the untouched gel, without markers.

    Example: anytouch data contact ycb_slide.parquet --drop --out ycb_touched.parquet --picture contact.png

    The manifest gets the columns label.contact_score and label.contact: 1, 0, or empty if unknown. Pictures of the
    untouched gel that had to be estimated are stored next to it, as the background_path of their rows.
    """

    manifest: Positional[Path]  # Manifest to mark (.csv, .parquet).
    out: Path | None = None  # Manifest to write (default: NAME_contact, next to the manifest).
    drop: bool = False  # Drop frames without contact. The split background and unknown frames stay.
    threshold: NotNegative[tuple[tuple[str, float], ...]] = ()
    """Contact threshold of the score by sensor, as in: digit 5 gelsight 7."""
    background: tuple[str, ...] = ()
    """Picture of the untouched gel for recordings without one: FILE for all, or UNIT=FILE for each sensor unit."""
    share: Share = 0.0
    """Also require this share (0 to 1) of the highest score of the recording. This removes the start and end of a
    contact. --picture and --check ignore it."""
    picture: Path | None = None
    """PNG of kept and dropped frames by rising score. Look at it before you trust a threshold."""
    check: bool = False  # Print precision and recall against a reference column. Writes a manifest only with --out.
    reference: str | None = None  # Column for --check (default: label.force, label.contact or label.contact_score).
    above: Finite[float | None] = None
    """Value of the reference column above which a frame is in contact."""
    threads: Threads = 2  # Threads that read pictures.


def run(options: ContactOptions) -> int:
    """Score every frame, then write the marked manifest, the picture, or the comparison with a column."""
    import numpy as np

    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare import contact

    if not options.check:
        refuse_unused(options, ("reference", "above"), "without --check")
    elif options.out is None:
        refuse_unused(options, ("drop",), "on --check, which writes a manifest only with --out")
    manifest = manifests.read(options.manifest)
    target = options.out or (None if options.check else output.default_target(options.manifest, "contact"))
    if target is not None:
        output.check_new(manifest, target)
    output.check_apart(out=target, picture=options.picture)
    if options.picture is not None:
        frames = map(manifest.file, range(len(manifest))) if options.picture.exists() else ()
        output.check_folder(options.picture, "--picture", read=(*manifest.files, *frames), suffix=".png")
    thresholds = dict(options.threshold)
    contact.threshold_of_rows(manifest, thresholds, options.share)  # raises for a mistake, before the work
    if options.check:
        contact.reference_contact(manifest, options.reference)
    if not np.isnan(contact.known_contact(manifest)).any() and not options.check:
        refuse_unused(
            options, ("threshold", "share", "background"), "on rows that all have a label.contact, which is kept"
        )
    backgrounds = contact.read_backgrounds(manifest, options.background)
    scores = contact.contact_scores(manifest, backgrounds=backgrounds, workers=options.threads)
    if target is not None and scores.gels:
        folder = target.with_name(f"{target.stem}_backgrounds")
        manifest = contact.store_backgrounds(manifest, scores, folder)
        log(f"{folder}: {len(scores.gels)} pictures of the untouched gel, now the background_path of their rows")
    marked, report = contact.mark_contact(
        manifest, scores, thresholds=thresholds, share=options.share, drop=options.drop
    )
    print("\n".join(report.lines()))
    if options.check:
        quality = contact.contact_quality(
            manifest, scores, reference=options.reference, above=options.above, thresholds=thresholds
        )
        print("\n".join(quality.lines()))
    if options.picture is not None:
        picture = contact.contact_sheet(manifest, scores, options.picture, thresholds=thresholds)
        log(f"{picture}: kept and dropped frames")
    if target is not None:
        print(f"{output.write_new(marked, target)}: {len(marked):,} rows, with label.contact_score and label.contact")
    return 0
