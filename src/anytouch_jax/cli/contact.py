"""`anytouch contact`: which frames are touched, by difference from the untouched gel."""

from __future__ import annotations

import math

import numpy as np

from anytouch_jax.cli.options_data import Contact
from anytouch_jax.cli.output import beside, check_apart, check_folder, check_new, write_new
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config.parsing import Range, in_range
from anytouch_jax.errors import UserError


def run(options: Contact) -> int:
    """Score every frame; write the marked manifest, the picture of both sides, or compare with what is known."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare import contact

    if not options.check:
        refuse(options, ("reference", "above"), "without --check, which compares with a column")
    elif options.out is None:
        refuse(options, ("drop",), "with --check alone, which writes no manifest", "; or name one with --out")
    in_range("--", options, above=Range(-math.inf, math.inf, "a number"))
    manifest = manifests.read(options.manifest)
    target = options.out or (None if options.check else beside(options.manifest, "contact"))
    if target is not None:
        check_new(manifest, target)
    check_apart(out=target, picture=options.picture)
    if options.picture is not None:
        if options.picture.suffix.lower() != ".png":
            raise UserError(f"--picture {options.picture} must end in .png")
        frames = map(manifest.file, range(len(manifest))) if options.picture.exists() else ()
        check_folder(options.picture, "--picture", read=(*manifest.files, *frames))
    limits = dict(options.threshold)
    contact.threshold_of_rows(manifest, limits, options.share)  # mistakes are told before the work
    if options.check:
        contact.reference_contact(manifest, options.reference)
    if not np.isnan(contact.known_contact(manifest)).any() and not options.check:
        refuse(options, ("threshold", "share"), "where every row has a label.contact, which is kept")
    scores = contact.contact_scores(manifest, workers=options.threads)
    marked, report = contact.mark_contact(manifest, scores, thresholds=limits, share=options.share, drop=options.drop)
    print("\n".join(report.lines()))
    if options.check:
        quality = contact.contact_quality(
            manifest, scores, reference=options.reference, above=options.above, thresholds=limits
        )
        print("\n".join(quality.lines()))
    if options.picture is not None:
        log(f"{contact.contact_sheet(manifest, scores, options.picture, thresholds=limits)}: kept and dropped frames")
    if target is not None:
        print(f"{write_new(marked, target)}: {len(marked):,} rows, with label.contact_score and label.contact")
    return 0
