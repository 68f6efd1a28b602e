"""`anytouch annotate`: captions from a vision-language model behind an OpenAI-compatible endpoint."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from anytouch_jax.cli.options_data import Annotate
from anytouch_jax.cli.output import beside, check_apart, check_folder, check_new, write_new
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config.parsing import COUNT, NOT_NEGATIVE, in_range
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.data.prepare.captions import CaptionResult, CostEstimate, Endpoint


_ASKING = (
    "split", "limit", "sheet", "estimate", "family", "answers", "second_image", "url", "model", "key_variable", "yes",
    "price_in", "price_out", "threads", "side", "timeout", "tries", "max_tokens", "token_field", "temperature",
    "json_mode",
)  # fmt: skip


class _OnlyAnEstimate(Exception):
    """What was asked for has been printed; nothing goes out."""


def run(options: Annotate) -> int:
    """Estimate, ask for consent, annotate, write the manifest with its captions; 1 when a caption could not be had."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare.captions import annotate, sample_sheet

    if options.captions is not None:
        refuse(options, _ASKING, "with --captions, which asks nothing")
    else:
        refuse(options, ("key",), "without --captions, the table that it is a column of")
    if options.sheet is None:
        refuse(options, ("sheet_count",), "without --sheet")
    if (options.price_in is None) != (options.price_out is None):
        raise UserError("--price-in and --price-out go together: a question costs by what is sent and what comes back")
    in_range("--", options, price_in=NOT_NEGATIVE, price_out=NOT_NEGATIVE, sheet_count=COUNT)
    manifest = manifests.read(options.manifest)
    target = options.out or beside(options.manifest, "captions")
    if not options.estimate:
        check_new(manifest, target)
        check_folder(target, read=() if options.captions is None else (options.captions,))
    check_apart(out=target, sheet=options.sheet)
    if options.sheet is not None:
        check_folder(options.sheet, "--sheet", read=manifest.files)
    if options.captions is not None:
        return _attach(options, manifest, target)
    try:
        found = annotate(
            manifest, _endpoint(options), options.answers or beside(options.manifest, "answers", ""),
            confirm=lambda estimate: _consent(options, estimate), price_in=options.price_in,
            price_out=options.price_out, threads=options.threads, side=options.side, split=options.split,
            families=dict(options.family), overwrite=options.overwrite, second_image=options.second_image,
            limit=options.limit, log=log,
        )  # fmt: skip
    except _OnlyAnEstimate:
        return 0
    _tell(found)
    if options.sheet is not None:
        log(f"{sample_sheet(manifest, found.captions, options.sheet, count=options.sheet_count)}: captions to check")
    print(f"{write_new(found.manifest, target)}: {len(found.captions):,} captions")
    return 1 if found.failures else 0


def _attach(options: Annotate, manifest: Manifest, target: Path) -> int:
    """Captions that are there already, in a table."""
    from anytouch_jax.data.manifest.manifest import attach_text

    assert options.captions is not None
    named, notes = attach_text(manifest, options.captions, key=options.key, overwrite=options.overwrite)
    for note in notes:
        log(note)
    print(f"{write_new(named, target)}: {int(named.present('text').sum()):,} of {len(named):,} rows have a caption")
    return 0


def _endpoint(options: Annotate) -> Endpoint:
    from anytouch_jax.data.prepare.captions import Endpoint

    return Endpoint(
        options.url, options.model, key_variable=options.key_variable, timeout=options.timeout, tries=options.tries,
        max_tokens=options.max_tokens, temperature=options.temperature, json_mode=options.json_mode,
        token_field=options.token_field,
    )  # fmt: skip


def _consent(options: Annotate, estimate: CostEstimate) -> bool:
    print(f"{options.model} at {options.url}: {estimate}", flush=True)
    if options.estimate:
        raise _OnlyAnEstimate
    if not estimate.questions:
        return True
    _endpoint(options).check()  # a missing key is reported before the question
    if options.yes:
        return True
    if not sys.stdin.isatty():
        raise UserError("nobody is there to confirm this; add --yes, or --estimate to see the estimate only")
    try:
        return input("Ask now? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _tell(found: CaptionResult) -> None:
    print(f"{found.asked:,} questions asked, {found.tokens_in:,} tokens in, {found.tokens_out:,} tokens out")
    for reason, count in found.left_out.items():
        print(f"left out, {reason}: {count:,} rows")
    for failure in found.failures[:5]:
        log(f"no caption for {failure.where} and the {failure.rows} rows of its touch: {failure.reason}")
    if len(found.failures) > 5:
        log(f"... and {len(found.failures) - 5} more: failures.jsonl has them all")
