"""`anytouch verify`: is a manifest fit to train on? And copies of it, repaired or for commercial use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anytouch_jax.cli.options_data import Verify
from anytouch_jax.cli.output import check_apart, check_folder, check_new, write_new, write_text
from anytouch_jax.cli.words import log
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.data.prepare.verify import VerifyReport


def run(options: Verify) -> int:
    """Print the report; 1 when there are errors that no repair took away."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare import verify
    from anytouch_jax.data.prepare.licences import commercial_only
    from anytouch_jax.data.prepare.repair import check_swap

    if options.swap and options.repair is None:
        raise UserError("--swap exchanges files in the repaired copy: say where it goes with --repair OUT")
    check_apart(repair=options.repair, commercial_only=options.commercial_only, out=options.out)
    manifest = manifests.read(options.manifests)
    check_swap(manifest, options.swap)  # before the work
    for target in (options.repair, options.commercial_only):
        if target is not None:
            check_new(manifest, target)
    if options.commercial_only is not None:
        commercial_only(manifest)  # a manifest without such rows is told before the work
    if options.out is not None:
        check_folder(options.out, read=manifest.files)
    report = verify.verify(manifest, decode=options.decode, objects=options.objects, threads=options.threads, log=log)
    print(report.to_markdown(), end="")
    if options.out is not None:
        log(f"{write_text(report.to_json(), options.out)}: the report")
    errors = [finding.sentence for finding in report.findings if finding.level == "error"]
    if options.repair is not None:
        manifest, errors = _repair(options, manifest, report, errors)
    if options.commercial_only is not None:
        _commercial(options, manifest)
    return 1 if errors else 0


def _repair(options: Verify, manifest: Manifest, report: VerifyReport, errors: list[str]) -> tuple[Manifest, list[str]]:
    """Write the repaired copy: (the manifest, the errors that are left)."""
    from anytouch_jax.data.prepare.repair import repair

    assert options.repair is not None
    repaired = repair(manifest, report, swap=options.swap)
    target = write_new(repaired.manifest, options.repair)
    print(f"\n{target}: {len(repaired.manifest):,} of {len(manifest):,} rows")
    print("\n".join(f"* {sentence}" for sentence in repaired.done or ("nothing had to be repaired",)))
    print("\n".join(f"* left to you: {sentence}" for sentence in repaired.left), end="\n" if repaired.left else "")
    return repaired.manifest, [sentence for sentence in errors if sentence in repaired.left]


def _commercial(options: Verify, manifest: Manifest) -> None:
    from anytouch_jax.data.prepare.licences import commercial_only

    assert options.commercial_only is not None
    kept = commercial_only(manifest)
    target = write_new(kept.manifest, options.commercial_only)
    print(
        f"{target}: {len(kept.manifest):,} rows; left out {kept.non_commercial:,} that are not for commercial use and "
        f"{kept.unknown:,} that do not say"
    )
