"""`anytouch data annotate`: captions from a vision-language model behind an OpenAI-compatible endpoint."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional

from anytouch_jax.cli import output
from anytouch_jax.cli.output import log, refuse_unused
from anytouch_jax.config.parsing import Above0, Count, NotNegative, Range, Threads
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.data.prepare.captions import CaptionResult, CostEstimate, Endpoint


@dataclass(frozen=True)
class AnnotateOptions:
    """Caption every touch without a text by a vision-language model, as the paper did with GPT-4o.

    Example: anytouch data annotate tacquad.parquet --vlm gpt-4o --limit 20 --sheet look.html

    Prints an estimate of the cost and asks before it starts. The key comes from the environment and is never stored.
    Run the same command again to continue: answers are kept. Exits with 1 if a caption is missing.
    """

    manifest: Positional[Path]  # Manifest with photographs or phrases (.csv, .parquet).
    out: Path | None = None  # Manifest to write (default: NAME_captions, next to the manifest).
    answers: Path | None = None  # Folder that keeps every answer (default: NAME_answers, next to the manifest).
    url: str = "https://api.openai.com/v1"  # Base address of an OpenAI-compatible endpoint. A local one needs no key.
    vlm: str = "gpt-4o"  # Name of the vision-language model.
    key_variable: str = "OPENAI_API_KEY"  # Environment variable that holds the key.
    yes: bool = False  # Do not ask for confirmation.
    estimate: bool = False  # Print the estimate and stop.
    price_in: NotNegative[float | None] = None  # Price of a million input tokens, for the estimate.
    price_out: NotNegative[float | None] = None  # Price of a million output tokens.
    limit: Count[int | None] = None  # Number of captions to ask for, to look at a sample first.
    captions: Path | None = None
    """Read captions from this table (.csv, .parquet) with a key column and `text`, and ask no model."""
    key: str | None = None  # Column that joins --captions and the manifest: caption_id, sequence, object, path, ...
    sheet: Path | None = None  # HTML page of captions with their pictures, to check by eye.
    sheet_count: Count[int] = 40  # Captions on that page.
    split: str | None = None  # Only rows of this split.
    family: tuple[tuple[str, Literal["photograph", "object", "phrase"]], ...] = ()
    """Prompt of your dataset, as in: mydata photograph."""
    second_image: str = "image2_path"  # Column of a second photograph, for the prompt object.
    overwrite: bool = False  # Also ask for rows that have a caption.
    threads: Threads = 4  # Questions at a time.
    side: Annotated[int, Range(16, math.inf, "16 or more")] = 512  # Longest side of the pictures that are sent, pixels.
    timeout: Above0[float] = 60.0  # Seconds to wait for an answer.
    tries: Count[int] = 5  # Tries for a question.
    max_tokens: Count[int] = 200  # Largest number of tokens of an answer.
    token_field: str = "max_tokens"  # Name of that limit in the protocol. Newer models need max_completion_tokens.
    temperature: NotNegative[float | None] = 0.0  # Temperature. None is not sent.
    json_mode: bool = True  # Ask for a JSON object. Use --no-json-mode for servers without it.


class _EstimateOnly(Exception):
    """The estimate is printed and nothing is sent."""


# Only these have an effect with --captions, which asks no model.
_WITH_CAPTIONS = ("manifest", "out", "captions", "key", "overwrite", "sheet_count")


def run(options: AnnotateOptions) -> int:
    """Estimate, ask for consent, annotate, and write the manifest with its captions."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.prepare.captions import annotate, sample_sheet

    if options.captions is not None:
        asking = [name for name in vars(options) if name not in _WITH_CAPTIONS]
        refuse_unused(options, asking, "with --captions, which asks no model")
    else:
        refuse_unused(options, ("key",), "without --captions")
    if options.sheet is None:
        refuse_unused(options, ("sheet_count",), "without --sheet")
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
        captioned, notes = manifests.attach_text(
            manifest, options.captions, key=options.key, overwrite=options.overwrite
        )
        for note in notes:
            log(note)
        count = int(captioned.present("text").sum())
        print(f"{output.write_new(captioned, target)}: {count:,} of {len(captioned):,} rows have a caption")
        return 0
    try:
        annotated = annotate(
            manifest, _endpoint(options), options.answers or output.default_target(options.manifest, "answers", ""),
            confirm=lambda estimate: _confirm(options, estimate), price_in=options.price_in,
            price_out=options.price_out, threads=options.threads, side=options.side, split=options.split,
            families=dict(options.family), overwrite=options.overwrite, second_image=options.second_image,
            limit=options.limit, log=log,
        )  # fmt: skip
    except _EstimateOnly:
        return 0
    _print_summary(annotated)
    if options.sheet is not None:
        sheet = sample_sheet(manifest, annotated.captions, options.sheet, count=options.sheet_count)
        log(f"{sheet}: captions to check")
    print(f"{output.write_new(annotated.manifest, target)}: {len(annotated.captions):,} captions")
    return 1 if annotated.failures else 0


def _endpoint(options: AnnotateOptions) -> Endpoint:
    from anytouch_jax.data.prepare.captions import Endpoint

    _, _, *names = (field.name for field in fields(Endpoint))
    return Endpoint(options.url, options.vlm, **{name: getattr(options, name) for name in names})


def _confirm(options: AnnotateOptions, estimate: CostEstimate) -> bool:
    print(f"{options.vlm} at {options.url}: {estimate}", flush=True)
    if options.estimate:
        raise _EstimateOnly
    if not estimate.questions:
        return True
    _endpoint(options).read_key()  # raises for a missing key, before the question
    if options.yes:
        return True
    if not sys.stdin.isatty():
        raise UserError("There is no terminal to confirm on. Add --yes, or --estimate to print the estimate only.")
    try:
        return input("Ask now? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _print_summary(annotated: CaptionResult) -> None:
    print(f"{annotated.requests:,} questions, {annotated.tokens_in:,} tokens in, {annotated.tokens_out:,} tokens out")
    for reason, count in annotated.left_out.items():
        print(f"left out, {reason}: {count:,} rows")
    for failure in annotated.failures[:5]:
        log(f"no caption for {failure.where} and the {failure.rows} rows of its touch: {failure.reason}")
    if len(annotated.failures) > 5:
        log(f"and {len(annotated.failures) - 5} more, listed in failures.jsonl")
