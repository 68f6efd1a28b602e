"""`anytouch data verify`: problems of a manifest and its files, with repaired and commercial copies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from anytouch_jax.cli.output import check_apart, check_folder, check_new, log, write_new
from anytouch_jax.config.parsing import Threads
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write


@dataclass(frozen=True)
class VerifyOptions:
    """Check manifests and their files: missing, broken, repeated, swapped, or leaking between splits.

    Example: anytouch data verify touch.parquet --repair touch_clean.parquet

    Exits with 1 if there are errors, or errors that --repair could not remove. Ends with the licences of the data.
    """

    manifests: Positional[tuple[Path, ...]]  # Manifests to check together (.csv, .parquet).
    repair: Path | None = None
    """Write a repaired copy: without unusable rows and files and repeated rows, with swapped folders exchanged."""
    commercial_only: Path | None = None
    """Write a copy with the rows that certainly allow commercial use, after any --repair."""
    swap: tuple[str, ...] = ()
    """With --repair: exchange touch image and photograph in these datasets. Look at them first."""
    decode: bool = True  # Decode every picture. --no-decode only checks that the files exist.
    objects: bool = False  # Report an object in two splits as an error.
    threads: Threads = 4  # Threads that read files.
    out: Path | None = None  # Write the report as JSON too.


def run(options: VerifyOptions) -> int:
    """Print the report; 1 if errors remain."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare import verify
    from anytouch_jax.data.prepare.licences import commercial_only
    from anytouch_jax.data.prepare.repair import check_swap, repair

    if options.swap and options.repair is None:
        raise UserError("--swap exchanges files in the repaired copy. Name that copy with --repair.")
    check_apart(repair=options.repair, commercial_only=options.commercial_only, out=options.out)
    manifest = manifests.read(options.manifests)
    check_swap(manifest, options.swap)
    for target in (options.repair, options.commercial_only):
        if target is not None:
            check_new(manifest, target)
    if options.commercial_only is not None:
        commercial_only(manifest)  # raises for a manifest without such rows, before the work
    check_folder(options.out, read=manifest.files)
    report = verify.verify(manifest, decode=options.decode, objects=options.objects, threads=options.threads)
    print(report.to_markdown(), end="")
    if options.out is not None:
        atomic_write(options.out, report.to_json())
        log(f"{options.out}: the report")
    errors = [finding.sentence for finding in report.findings if finding.level == "error"]
    if options.repair is not None:
        repaired = repair(manifest, report, swap=options.swap)
        target = write_new(repaired.manifest, options.repair)
        print(f"\n{target}: {len(repaired.manifest):,} of {len(manifest):,} rows")
        print("\n".join(f"* {sentence}" for sentence in repaired.done or ("nothing to repair",)))
        for sentence in repaired.left:
            print(f"* left to you: {sentence}")
        manifest, errors = repaired.manifest, [sentence for sentence in errors if sentence in repaired.left]
    if options.commercial_only is not None:
        commercial = commercial_only(manifest)
        target = write_new(commercial.manifest, options.commercial_only)
        print(
            f"{target}: {len(commercial.manifest):,} rows, without {commercial.non_commercial:,} non-commercial rows "
            f"and {commercial.unknown:,} rows of unknown licence"
        )
    return 1 if errors else 0
