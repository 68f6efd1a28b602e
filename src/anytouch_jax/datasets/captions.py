"""Captions from a vision-language model, one for each touch (AnyTouch, appendix: annotation by
GPT-4o).

Answers are stored in `answers.jsonl` under a hash of the model, the prompt and the image bytes. The
same call therefore continues after an interruption, and no question is paid for twice.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import html
import json
import math
import os
import urllib.parse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import pyarrow as pa

from anytouch_jax.config.parsing import Count, Range, check, parse_json
from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest.manifest import Manifest, replace_column
from anytouch_jax.datasets import prompts
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, lock
from anytouch_jax.progress import bar

if TYPE_CHECKING:
    import openai

_BAD_ANSWER_TRIES = 3
_MAX_STREAK = 25  # failures in a row after which the run stops instead of paying for more
_LONGEST_WAIT = 120.0  # seconds between two tries; the client obeys no longer Retry-After
_TILE = 512  # an image costs a base price and a price for each tile of 512 pixels
_BASE_TOKENS = 85
_TILE_TOKENS = 170
_ANSWER_TOKENS = 80
_LOCAL = ("localhost", "127.0.0.1", "::1")
_REFUSED = {
    401: "the key is not accepted",
    403: "access is denied",
    404: "there is no such address or model",
}
_SHEET_SIDE = 256
_SHEET_STYLE = (
    "body{font:15px/1.4 sans-serif;max-width:1000px;margin:2em "
    "auto}article{display:flex;gap:1em;margin:1em 0;"
    "border-top:1px solid #ccc;padding-top:1em}figure{margin:0}img{max-width:200px;display:block}"
    "figcaption,small{color:#666}"
)


class CostEstimate(NamedTuple):
    """The questions to ask, those answered before, their tokens, and their price if prices are
    known.
    """

    questions: int
    cached: int
    tokens_in: int
    tokens_out: int
    cost: float | None

    def __str__(self) -> str:
        price = "no prices given" if self.cost is None else f"about {self.cost:.2f}"
        return (
            f"{self.questions} questions ({self.cached} answered before), about {self.tokens_in} "
            f"tokens in and {self.tokens_out} out: {price}"
        )


class Caption(NamedTuple):
    """A caption, the object that the model named, and the job that it answers."""

    job: prompts.CaptionJob
    text: str
    object: str


class CaptionFailure(NamedTuple):
    """A missing caption: its first row, the number of rows that share it, the reason, and the
    question's key.
    """

    where: str
    rows: int
    reason: str
    key: str = ""


class CaptionResult(NamedTuple):
    """The manifest with its captions, the failures, rows left out by reason, and the requests and
    tokens used.
    """

    manifest: Manifest
    captions: tuple[Caption, ...]
    failures: tuple[CaptionFailure, ...]
    left_out: dict[str, int]
    requests: int
    tokens_in: int
    tokens_out: int


class AnnotateError(UserError):
    """An annotation that did not start, or that stopped. Answers that arrived are stored."""


class _QuestionError(Exception):
    """A question that got no answer after all tries. The message gives the reason."""


@dataclass(frozen=True)
class Endpoint:
    """An OpenAI-compatible chat endpoint, see `anytouch data annotate --help`.

    Raises AnnotateError for a bad one.
    """

    url: str
    model: str
    key_variable: str = "OPENAI_API_KEY"
    timeout: Annotated[
        float, Range(math.ulp(0.0), 86_400, "above 0 seconds and at most 86,400")
    ] = 60.0
    tries: Count[int] = 5
    max_tokens: Count[int] = 200
    temperature: float | None = 0.0
    json_mode: bool = True
    token_field: str = "max_tokens"

    def __post_init__(self) -> None:
        check(self, "--")
        try:
            parts = urllib.parse.urlsplit(self.url)
            valid = (
                parts.scheme in ("http", "https")
                and parts.hostname
                and parts.port != 0
                and self.url.isascii()
            )
            # rejects names that the resolver would reject
            (parts.hostname or "").encode("idna")
        except ValueError:
            valid = False
        if not valid:
            raise AnnotateError(
                f"{self.url!r} is not an http or https address, such as https://api.openai.com/v1"
            )
        if parts.username or parts.password:
            raise AnnotateError(
                f"Set the environment variable {self.key_variable} to the key. Remove it from "
                "--url."
            )

    @property
    def is_local(self) -> bool:
        """Whether the endpoint is on this machine, which needs no key."""
        return urllib.parse.urlsplit(self.url).hostname in _LOCAL

    @property
    def exposes_key(self) -> bool:
        """Whether a key is set and would travel unencrypted to another machine."""
        return (
            self.url.startswith("http:")
            and not self.is_local
            and bool(os.environ.get(self.key_variable))
        )

    def read_key(self) -> str:
        """Return the key, "" if a local endpoint has none.

        Raises AnnotateError for a wrong key, and without openai.
        """
        key = os.environ.get(self.key_variable, "").strip()
        if not key and not self.is_local:
            raise AnnotateError(
                f"set the environment variable {self.key_variable} to the key of {self.url}"
            )
        if key and not (key.isascii() and key.isprintable() and " " not in key):
            raise AnnotateError(f"the environment variable {self.key_variable} does not hold a key")
        try:
            import openai  # noqa: F401
        except ImportError:
            raise AnnotateError(
                "captions need the package openai: install it with pip install "
                "'anytouch_jax[annotate]'"
            ) from None
        return key


class _Client:
    """The openai client for one endpoint. The key is read once and removed from every message."""

    def __init__(self, endpoint: Endpoint, log: Callable[[str], None] = lambda _: None) -> None:
        self.endpoint = endpoint
        self._key = endpoint.read_key()
        self._log = log

    def connect(self) -> openai.AsyncOpenAI:
        """Return a client. It follows no redirect, which would take the key to another host."""
        import openai

        return openai.AsyncOpenAI(
            api_key=self._key or "none",
            base_url=self.endpoint.url.rstrip("/").removesuffix("/chat/completions"),
            timeout=self.endpoint.timeout,
            max_retries=self.endpoint.tries - 1,
            http_client=openai.DefaultAsyncHttpxClient(
                follow_redirects=False, event_hooks={"response": [self._report_wait]}
            ),
        )

    async def _report_wait(self, response: Any) -> None:
        if response.status_code >= 400 and (wait := _asked_wait(response)):
            self._log(f"the endpoint answers {response.status_code}{wait}")

    async def ask(
        self, connection: openai.AsyncOpenAI, messages: list[dict[str, Any]]
    ) -> tuple[str, str, int, int]:
        """Return text, finish reason, tokens in and out.

        Raises _QuestionError, BadAnswer or AnnotateError.
        """
        import openai

        end = self.endpoint
        body: dict[str, Any] = {
            "model": end.model,
            "messages": messages,
            end.token_field: end.max_tokens,
        }
        if end.temperature is not None:
            body["temperature"] = end.temperature
        if end.json_mode:
            body["response_format"] = {"type": "json_object"}
        try:
            # The client's timeout is for one read: a server that sends a byte now and then would
            # hold us for ever.
            async with asyncio.timeout(end.tries * end.timeout + (end.tries - 1) * _LONGEST_WAIT):
                reply = await connection.post("/chat/completions", body=body, cast_to=object)
        except (TimeoutError, openai.APITimeoutError):
            reason = f"no answer within {end.timeout:g} seconds"
        except openai.APIConnectionError as error:
            reason = f"the endpoint cannot be reached: {error.__cause__ or error}"
        except openai.APIStatusError as error:
            reason = self._judge(error)
        except (ValueError, RecursionError):
            raise prompts.BadAnswer("not JSON") from None
        else:
            text, finish, tokens_in, tokens_out = _parse_reply(reply)
            return self.redact(text), finish, tokens_in, tokens_out
        raise _QuestionError(f"{self.redact(reason)} (at most {end.tries} tries)")

    def redact(self, text: str) -> str:
        """Return `text` without the key, which a server may quote."""
        if self._key:
            return text.replace(self._key, "[key]")
        return text

    def _judge(self, error: openai.APIStatusError) -> str:
        """Return the reason of an error status.

        Raises AnnotateError for one that concerns every question.
        """
        code = error.status_code
        try:
            content = parse_json(error.response.content)["error"]
            message = content["message"] if isinstance(content, dict) else content
        except (ValueError, KeyError, TypeError):
            message = error.response.text[:10_000]
        message = _one_line(self.redact(str(message)))[:200]
        reason = f"the endpoint answers {code}{f': {message}' if message else ''}"
        if code in _REFUSED:
            raise AnnotateError(f"{self.endpoint.url}: {_REFUSED[code]}; {reason}")
        if 300 <= code < 400:
            raise AnnotateError(
                f"{self.endpoint.url} redirects to another address; give that address"
            )
        return reason + _asked_wait(error.response)


def _one_line(text: str) -> str:
    return " ".join(text.encode("utf-8", "replace").decode().split())


def _asked_wait(response: Any) -> str:
    wait = response.headers.get("retry-after")
    if wait:
        return f" and asks to wait (Retry-After: {_one_line(wait)[:40]})"
    return ""


def _parse_reply(reply: Any) -> tuple[str, str, int, int]:
    try:
        choice = reply["choices"][0]
        message = choice["message"]
        usage = reply.get("usage")
        text = message.get("content")
        refusal = message.get("refusal")
        if isinstance(text, list):  # some servers answer in parts
            text = "".join(str(part.get("text", "")) for part in text)
        text = str(refusal or text or "")
        finish = "refusal" if refusal else str(choice.get("finish_reason") or "")
        text.encode()  # raises for half of a Unicode pair
    except (ValueError, KeyError, IndexError, TypeError, AttributeError):
        raise prompts.BadAnswer("not a chat completion") from None
    counts = [
        usage.get(name) if isinstance(usage, dict) else 0
        for name in ("prompt_tokens", "completion_tokens")
    ]
    # An answer with odd numbers is paid for too.
    tokens_in, tokens_out = (n if isinstance(n, int) and 0 <= n < 1 << 40 else 0 for n in counts)
    return text, finish, tokens_in, tokens_out


@dataclass(frozen=True)
class CaptionOptions:
    """What is asked, and how.

    Args:
        price_in: price of a million tokens of questions, for the estimate; None if unknown.
        price_out: price of a million tokens of answers.
        threads: questions that are open at a time.
        side: pixels of the long side of an image, which is scaled down to it.
        split: only rows of this split; None for all.
        families: family of prompts by the name of a data set, where it is not known.
        overwrite: ask also for rows that have a caption.
        second_image: column of a second RGB image.
        limit: at most so many questions.
    """

    price_in: float | None = None
    price_out: float | None = None
    threads: int = 4
    side: int = 512
    split: str | None = None
    families: Mapping[str, str] | None = None
    overwrite: bool = False
    second_image: str = prompts.SECOND_IMAGE
    limit: int | None = None


def annotate(
    manifest: Manifest,
    endpoint: Endpoint,
    folder: str | Path,
    *,
    confirm: Callable[[CostEstimate], bool],
    options: CaptionOptions | None = None,
    log: Callable[[str], None] = lambda _: None,
    **settings: Any,
) -> CaptionResult:
    """Ask a vision-language model for every missing caption.

    Each touch, or each sequence without a touch, is one question. A phrase that was expanded moves
    to the column `phrase`.

    Args:
        manifest: the rows to caption.
        endpoint: the model's server.
        folder: where answers and failures are stored. What is stored there is not asked again.
        confirm: is always called with the estimate of the cost; False ends it.
        options: what is asked, and how.
        log: gets sentences.
        **settings: fields of `CaptionOptions`, which take the place of those in `options`.

    Returns:
        The manifest with all captions, and what was asked and failed.

    Raises:
        AnnotateError: `confirm` returned False, the first questions all failed, or the endpoint
            cannot be used.
        UserError: no caption is missing.
    """
    options = replace(options or CaptionOptions(), **settings)
    jobs, left_out = prompts.find_caption_jobs(
        manifest,
        split=options.split,
        families=options.families,
        overwrite=options.overwrite,
        second_image=options.second_image,
    )
    jobs = jobs[: options.limit]
    store = _AnswerStore(Path(folder).expanduser().resolve())
    run = _Run(manifest, endpoint, store, options.side, log)
    keys = run.keys(jobs, options.threads)
    # Equal questions about equal images are one.
    missing: dict[str, prompts.CaptionJob] = {}
    for job, key in zip(jobs, keys, strict=True):
        if key and key not in store.answers:
            missing.setdefault(key, job)
    if endpoint.exposes_key:
        log(f"the key travels unencrypted to {endpoint.url}; use https")
    cached = sum(key in store.answers for key in keys)
    if not confirm(_estimate(list(missing.values()), cached, options)):
        raise AnnotateError("not confirmed: nothing was asked")
    with store.exclusive() if missing else nullcontext():
        try:
            # Another process may have stored answers while this one waited for the lock.
            questions = [(key, job) for key, job in missing.items() if key not in store.answers]
            # Earlier failures come last, so that they do not hold up the rest.
            questions.sort(key=lambda question: question[0] in store.failed)
            if questions:
                # A thread of its own, because a notebook has a running event loop in this one.
                asked = run.ask(_Client(endpoint, log), questions, options.threads)
                with ThreadPoolExecutor(1) as pool:
                    pool.submit(asyncio.run, asked).result()
        finally:
            store.write_failures(run.failures, keys)
    captions = []
    for job, key in zip(jobs, keys, strict=True):
        answer = store.answers.get(key)
        if answer:
            captions.append(Caption(job, answer["caption"], answer["object"]))
    annotated = _attach(manifest, tuple(captions))
    return CaptionResult(
        annotated, tuple(captions), tuple(run.failures), left_out, run.requests, *run.tokens
    )


def _estimate(
    missing: Sequence[prompts.CaptionJob], cached: int, options: CaptionOptions
) -> CostEstimate:
    """Return what the questions will cost: four letters are about a token, and an image has a base
    price and one for each of its tiles.
    """
    tiles = (-(-options.side // _TILE)) ** 2
    image = _BASE_TOKENS + _TILE_TOKENS * tiles
    tokens_in = 0
    for job in missing:
        letters = len(job.prompt.system + job.prompt.text)
        tokens_in += letters // 4 + image * len(job.images) + 20
    tokens_out = _ANSWER_TOKENS * len(missing)
    cost = None
    if options.price_in is not None and options.price_out is not None:
        cost = (tokens_in * options.price_in + tokens_out * options.price_out) / 1e6
    return CostEstimate(len(missing), cached, tokens_in, tokens_out, cost)


class _Run:
    """One pass over the questions. `failures` and the counts grow during the pass."""

    def __init__(
        self,
        manifest: Manifest,
        endpoint: Endpoint,
        store: _AnswerStore,
        side: int,
        log: Callable[[str], None],
    ) -> None:
        self.manifest = manifest
        self.endpoint = endpoint
        self.store = store
        self.side = side
        self.log = log
        self.failures: list[CaptionFailure] = []
        self.requests = 0
        self.tokens = [0, 0]
        self.done = self.streak = 0

    def keys(self, jobs: list[prompts.CaptionJob], threads: int) -> list[str]:
        """Return the key of each job's answer. An unreadable image is a failure with the key ""."""

        def key_of(job: prompts.CaptionJob) -> tuple[str, str]:
            try:
                return self._images(job)[0], ""
            except UserError as error:
                return "", str(error)

        keys = []
        with closing(bounded_map(key_of, jobs, threads)) as results:
            for job, (key, reason) in zip(jobs, results, strict=True):
                keys.append(key)
                if reason:
                    self._fail(job, "", reason)
        return keys

    def _images(self, job: prompts.CaptionJob) -> tuple[str, list[bytes]]:
        """Return the key of a job's answer, and its images as JPEG. Raises UserError for an
        unreadable image.
        """
        end = self.endpoint
        jpegs = []
        parts = [end.model, job.prompt.fingerprint(), self.side, end.max_tokens]
        digest = hashlib.sha256(json.dumps(parts).encode())
        for row, column in job.images:
            try:
                data = prompts.image_bytes(self.manifest, row, column)
                jpegs.append(prompts.small_jpeg(data, column, self.side))
            except (OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or error
                raise UserError(
                    f"{column} {self.manifest.value(row, column)!r} cannot be read: {reason}"
                ) from None
            digest.update(hashlib.sha256(data).digest())
        return digest.hexdigest()[:32], jpegs

    async def ask(
        self, client: _Client, questions: list[tuple[str, prompts.CaptionJob]], workers: int
    ) -> None:
        """Ask all questions. The first error of a worker ends the others."""
        queue = iter(questions)

        async def work() -> None:
            for key, job in queue:
                reason = await self._ask_one(client, connection, job, key)
                self.done += 1
                self.streak = self.streak + 1 if reason else 0
                if reason:
                    self._fail(job, key, reason)
                if self.streak >= _MAX_STREAK:
                    if not self.store.answers:
                        raise AnnotateError(
                            f"{self.streak} questions in a row failed, the last one: {reason}"
                        )
                    for later_key, later_job in queue:
                        self._fail(
                            later_job, later_key, f"not asked: {_MAX_STREAK} before it failed"
                        )
                advance(self.done)
                if self.done % 100 == 0 or self.done == len(questions):
                    self.log(
                        f"{self.done} of {len(questions)} questions, {len(self.failures)} failed"
                    )

        try:
            with bar(len(questions), "captions") as advance:
                async with client.connect() as connection, asyncio.TaskGroup() as group:
                    for _ in range(workers):
                        group.create_task(work())
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None

    async def _ask_one(
        self, client: _Client, connection: openai.AsyncOpenAI, job: prompts.CaptionJob, key: str
    ) -> str:
        """Get and store one answer. Returns the reason if there is none, else ""."""
        try:
            _, jpegs = await asyncio.to_thread(self._images, job)
        except UserError as error:
            return str(error)
        reason = ""
        for _ in range(_BAD_ANSWER_TRIES):
            text = ""
            try:
                text, finish, *tokens = await client.ask(connection, job.prompt.messages(jpegs))
                self.requests += 1
                self.tokens = [self.tokens[0] + tokens[0], self.tokens[1] + tokens[1]]
                caption, named = prompts.parse_caption(text, finish)
            except _QuestionError as error:
                return str(error)
            except prompts.BadAnswer as error:
                reason = f"bad answer ({error}): {text[:100]!r}"
                continue
            self.store.add(
                key,
                {
                    "model": self.endpoint.model,
                    "prompt": job.prompt.fingerprint(),
                    "family": job.prompt.family,
                    "caption": caption,
                    "object": named,
                    "tokens_in": tokens[0],
                    "tokens_out": tokens[1],
                },
            )
            return ""
        return f"{reason} ({_BAD_ANSWER_TRIES} times)"

    def _fail(self, job: prompts.CaptionJob, key: str, reason: str) -> None:
        self.failures.append(
            CaptionFailure(self.manifest.where(int(job.rows[0])), len(job.rows), reason, key)
        )


class _AnswerStore:
    """The answers of a folder, one JSON line each. A line that was cut off is asked for again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / "answers.jsonl"
        self._line_break = ""
        self.answers: dict[str, dict[str, Any]] = {}
        # The line of each failed question by its key.
        self.failed = {
            str(entry.get("key")): line for line, entry in _entries(folder / "failures.jsonl")
        }
        self._read_answers()

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Lock the folder while the block runs.

        Raises AnnotateError if another process holds it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with lock(self.folder / ".lock") as free:
            if not free:
                raise AnnotateError(
                    f"another process asks for {self.folder}: wait for it, or name another "
                    "--answers"
                )
            self._read_answers()
            yield

    def _read_answers(self) -> None:
        for line, entry in _entries(self._path):
            self._line_break = "" if line.endswith("\n") else "\n"
            if isinstance(entry.get("caption"), str) and isinstance(entry.get("object"), str):
                self.answers[str(entry.get("key"))] = entry

    def add(self, key: str, entry: dict[str, Any]) -> None:
        """Store an answer. It is on the disk when this returns."""
        line = json.dumps({"key": key, **entry}, ensure_ascii=False)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{self._line_break}{line}\n")
        self._line_break = ""
        self.answers[key] = entry

    def write_failures(self, failures: list[CaptionFailure], keys: list[str]) -> None:
        """Write failures.jsonl: the new failures, and earlier ones among `keys` that are still
        open.
        """
        closed = {failure.key for failure in failures} | self.answers.keys() | {""}
        lines = [json.dumps(failure._asdict(), ensure_ascii=False) for failure in failures]
        lines += [
            self.failed[key].strip()
            for key in dict.fromkeys(keys)
            if key in self.failed and key not in closed
        ]
        if lines or self.failed:
            atomic_write(self.folder / "failures.jsonl", "".join(f"{line}\n" for line in lines))


def _entries(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the lines of a JSON-lines file and their objects, {} for a line that is damaged."""
    if not path.is_file():
        return
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            entry: Any = {}
            with suppress(UserError):
                entry = parse_json(line)
            yield line, entry if isinstance(entry, dict) else {}


def _attach(manifest: Manifest, captions: tuple[Caption, ...]) -> Manifest:
    texts = [one.text for one in captions]
    phrases = [one.job.phrase for one in captions]
    for name, words in (("text", texts), (prompts.PHRASE, phrases)):
        if any(word is not None for word in words):
            known = name in manifest.table.column_names
            cells = np.array(
                manifest.column(name).to_pylist() if known else [None] * len(manifest), object
            )
            for caption, word in zip(captions, words, strict=True):
                cells[caption.job.rows] = cells[caption.job.rows] if word is None else word
            manifest = replace_column(manifest, name, pa.array(cells, pa.string()))
    return manifest


def sample_sheet(
    manifest: Manifest, captions: Sequence[Caption], path: str | Path, *, count: int = 40
) -> Path:
    """Write an HTML page of `count` random captions with their images.

    Raises UserError without captions.

    Args:
        manifest: the frames.
        captions: of groups of its rows.
        path: of the page.
        count: most captions on it.
    """
    if not captions:
        raise UserError("there are no captions to look at; leave out --sheet, or ask for some")
    chosen = np.sort(np.random.default_rng(0).permutation(len(captions))[:count])
    title = f"{len(chosen)} of {len(captions)} captions"
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_SHEET_STYLE}</style>"
        f"<h1>{title}</h1><p>Tick what is wrong.</p>"
    )
    page += "".join(_article(manifest, captions[i], number) for number, i in enumerate(chosen, 1))
    atomic_write(target := Path(path).expanduser().resolve(), f"{page}</html>\n")
    return target


def _article(manifest: Manifest, caption: Caption, number: int) -> str:
    job = caption.job
    row = int(job.rows[0])
    images = list(job.images)
    if not any(column == "path" for _, column in images):  # the model did not see the touch
        images.append((images[0][0] if images else row, "path"))
    parts = []
    for image_row, column in images:
        word = "touch" if column == "path" else "photograph"
        try:
            jpeg = prompts.small_jpeg(
                prompts.image_bytes(manifest, image_row, column), column, _SHEET_SIDE
            )
        except (OSError, ValueError) as error:
            parts.append(f"<p>{html.escape(str(error))}</p>")
            continue
        data = base64.b64encode(jpeg).decode()
        parts.append(
            f'<figure><img src="data:image/jpeg;base64,{data}" alt="{word}">'
            f"<figcaption>{word}</figure>"
        )
    notes = [f"phrase: {job.phrase}"] if job.phrase else []
    notes += [
        f"{manifest.value(row, 'dataset')}, {manifest.where(row)}, {len(job.rows)} rows share it"
    ]
    parts += [
        f"<div><p><label><input type=checkbox> {number}. "
        f"<b>{html.escape(caption.object)}</b></label></p>"
    ]
    parts += [
        f"<p>{html.escape(caption.text)}</p>",
        *(f"<p><small>{html.escape(note)}</small></p>" for note in notes),
    ]
    return f"<article>{''.join(parts)}</div></article>"
