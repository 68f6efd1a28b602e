"""Captions from a vision-language model, as the paper had GPT-4o write them: one for each touch, paid for once.

Answers are kept in `answers.jsonl`, by a hash of the model, the words of the prompt and the bytes of the pictures, so
the same call goes on after a kill and asks nothing twice.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest.manifest import Manifest, replace_column
from anytouch_jax.data.prepare.endpoint import AnswerError, Client, Endpoint, EndpointError
from anytouch_jax.data.prepare.prompts import Nonsense, caption_of
from anytouch_jax.data.prepare.questions import (
    PHRASE,
    SECOND_IMAGE,
    Job,
    data_url,
    find_jobs,
    picture_bytes,
    small_jpeg,
)
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, lock

_NONSENSE_TRIES = 3
_STREAK = 25  # failures in a row after which the run stops instead of paying on
_TILE = 512  # the model's price of a picture: a base and so much for each tile of 512 pixels
_BASE_TOKENS, _TILE_TOKENS, _ANSWER_TOKENS = 85, 170, 80


class Estimate(NamedTuple):
    """What is about to be asked: questions, those answered before, tokens, and their price where prices are given."""

    questions: int
    cached: int
    tokens_in: int
    tokens_out: int
    cost: float | None

    def __str__(self) -> str:
        price = "no prices given" if self.cost is None else f"about {self.cost:.2f}"
        return (
            f"{self.questions} questions ({self.cached} answered before), about {self.tokens_in} tokens in and "
            f"{self.tokens_out} out: {price}"
        )


class Caption(NamedTuple):
    """A caption, the object that the model saw, and the job that it answers."""

    job: Job
    text: str
    object: str


class Failure(NamedTuple):
    """A caption that could not be had: where its first row is, how many rows lack it, why, and the question's key."""

    where: str
    rows: int
    reason: str
    key: str = ""


class Annotated(NamedTuple):
    """The manifest with its captions, what could not be had, rows left out by reason, and what was used."""

    manifest: Manifest
    captions: tuple[Caption, ...]
    failures: tuple[Failure, ...]
    left_out: dict[str, int]
    asked: int
    tokens_in: int
    tokens_out: int


class AnnotateError(UserError):
    """An annotation that was not begun, or stopped; answers that were given are kept."""


def annotate(
    manifest: Manifest,
    endpoint: Endpoint,
    folder: str | Path,
    *,
    confirm: Callable[[Estimate], bool],
    price_in: float | None = None,
    price_out: float | None = None,
    threads: int = 4,
    side: int = 512,
    split: str | None = None,
    families: Mapping[str, str] | None = None,
    overwrite: bool = False,
    second_image: str = SECOND_IMAGE,
    limit: int | None = None,
    log: Callable[[str], None] | None = None,
) -> Annotated:
    """Ask `endpoint` for every caption that is lacking, after `confirm(estimate)`, which is also told where nothing is
    lacking; answers and failures in `folder`.

    One question for each touch (else each sequence), `threads` at a time; pictures are sent with no side longer than
    `side`. Prices are for a million tokens. `limit`: only the first so many captions (to look at a sample first).
    A phrase that was expanded moves to the column `phrase`. Raises AnnotateError when it is not confirmed or too many
    questions in a row fail, EndpointError when the endpoint cannot be used, UserError when no caption is lacking.
    """
    if threads < 1 or side < 16:
        raise AnnotateError(f"threads {threads} must be at least 1 and side {side} at least 16")
    if limit is not None and limit < 1:
        raise AnnotateError(f"limit {limit} must be at least 1; leave it away for all captions")
    exposed = endpoint.exposes_key  # a mistake in the address is told at once; a key is needed only to ask
    store = _Store(Path(folder).expanduser().resolve())
    found = find_jobs(manifest, split=split, families=families, overwrite=overwrite, second_image=second_image)
    run = _Run(manifest, endpoint, store, side)
    jobs = found.jobs[:limit]
    keys = run.keys(jobs, threads)
    asking: dict[str, Job] = {}  # equal questions about equal pictures are one
    for job, key in zip(jobs, keys, strict=True):
        if key and key not in store.answers:
            asking.setdefault(key, job)
    lacking = [(job, key) for key, job in asking.items()]
    if log and exposed:
        log(f"the key travels unencrypted to {endpoint.url}; use https")
    cached = sum(key in store.answers for key in keys)
    estimate = _estimate([job for job, _ in lacking], cached, side, price_in, price_out)
    if not confirm(estimate):
        raise AnnotateError("not confirmed: nothing was asked")
    lacking.sort(key=lambda one: one[1] in store.failed)  # what failed the last time bars no other question
    if lacking:
        with store.alone():
            lacking = [one for one in lacking if one[1] not in store.answers]  # another process may have been faster
            try:
                run.ask(Client(endpoint), lacking, threads, log)
            finally:
                store.write_failures(run.failures, keys)
    elif run.failures or store.failed:
        store.write_failures(run.failures, keys)
    captions = tuple(
        Caption(job, store.answers[key]["caption"], store.answers[key]["object"])
        for job, key in zip(jobs, keys, strict=True) if key in store.answers
    )  # fmt: skip
    return Annotated(
        _attach(manifest, captions), captions, tuple(run.failures), found.left_out,
        run.asked, run.tokens[0], run.tokens[1],
    )  # fmt: skip


def _estimate(jobs: list[Job], cached: int, side: int, price_in: float | None, price_out: float | None) -> Estimate:
    picture = _BASE_TOKENS + _TILE_TOKENS * (-(-side // _TILE)) ** 2
    tokens_in = sum(
        len(job.question.system + job.question.text) // 4 + picture * len(job.pictures) + 20 for job in jobs
    )
    tokens_out = _ANSWER_TOKENS * len(jobs)
    cost = None if price_in is None or price_out is None else (tokens_in * price_in + tokens_out * price_out) / 1e6
    return Estimate(len(jobs), cached, tokens_in, tokens_out, cost)


class _Run:
    """One pass over the questions; `failures` and the counts grow as it goes."""

    def __init__(self, manifest: Manifest, endpoint: Endpoint, store: _Store, side: int) -> None:
        self.manifest, self.endpoint, self.store, self.side = manifest, endpoint, store, side
        self.failures: list[Failure] = []
        self.asked, self.tokens = 0, [0, 0]

    def keys(self, jobs: list[Job], threads: int) -> list[str]:
        """The name of each job's answer; "" and a failure where a picture cannot be read."""
        keys = []
        with closing(bounded_map(self._key, jobs, threads)) as found:
            for job, key in zip(jobs, found, strict=True):
                if isinstance(key, UserError):
                    self._fail(job, "", str(key))
                keys.append(key if isinstance(key, str) else "")
        return keys

    def _key(self, job: Job) -> str | UserError:
        end = self.endpoint
        digest = hashlib.sha256(json.dumps([end.model, job.question.hash(), self.side, end.max_tokens]).encode())
        for row, column in job.pictures:
            try:
                data = picture_bytes(self.manifest, row, column)
                digest.update(hashlib.sha256(data).digest())
                small_jpeg(data, f"{column} of row {row}", self.side)  # what cannot be decoded is not to be paid for
            except (UserError, OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or error
                return UserError(f"{column} {self.manifest.value(row, column)!r} cannot be read: {reason}")
        return digest.hexdigest()[:32]

    def ask(
        self, client: Client, lacking: list[tuple[Job, str]], threads: int, log: Callable[[str], None] | None
    ) -> None:
        """Ask all questions; stops at an endpoint that is of no use. In the end no thread is left.

        A row of questions that had failed in the last run too says nothing of the endpoint: those behind it are left.
        """
        streak, left = 0, lacking[:0]
        with closing(bounded_map(partial(self._ask_one, client), lacking, threads)) as reasons:
            try:
                for count, ((job, key), reason) in enumerate(zip(lacking, reasons, strict=True), 1):
                    streak = streak + 1 if reason else 0
                    if reason:
                        self._fail(job, key, client.redact(reason))
                    if streak >= _STREAK and key in self.store.failed and self.store.answers:
                        left = lacking[count:]
                        break
                    if streak >= _STREAK:
                        raise AnnotateError(f"{streak} questions in a row failed, the last one: {reason}")
                    if log and (count % 100 == 0 or count == len(lacking)):
                        log(f"{count} of {len(lacking)} questions, {len(self.failures)} failed")
            finally:
                client.stop.set()  # before the threads are waited for: none goes on waiting for a server
        for job, key in left:
            if key not in self.store.answers:
                self._fail(job, key, f"not asked again: {_STREAK} before it failed, all in the last run too")

    def _ask_one(self, client: Client, item: tuple[Job, str]) -> str:
        """Get one answer and keep it; why there is none, or ""."""
        job, key = item
        try:
            pictures = [
                data_url(small_jpeg(picture_bytes(self.manifest, row, column), f"{column} of row {row}", self.side))
                for row, column in job.pictures
            ]
        except (UserError, OSError, ValueError) as error:
            return str(error)
        reason = ""
        for _ in range(_NONSENSE_TRIES):
            try:
                answer = client.ask(job.question.messages(pictures))
            except AnswerError as error:
                return str(error)
            except EndpointError:
                client.stop.set()
                raise
            with self.store.lock:
                self.asked += 1
                self.tokens[0] += answer.tokens_in
                self.tokens[1] += answer.tokens_out
            text = client.redact(answer.text)
            try:
                caption, seen = caption_of(text, answer.finish)
            except Nonsense as error:
                reason = f"nonsense ({error}): {text[:100]!r}"
                continue
            self.store.keep(key, {
                "model": self.endpoint.model, "prompt": job.question.hash(), "family": job.question.family,
                "caption": caption, "object": seen, "tokens_in": answer.tokens_in, "tokens_out": answer.tokens_out,
            })  # fmt: skip
            return ""
        return f"{reason} ({_NONSENSE_TRIES} times)"

    def _fail(self, job: Job, key: str, reason: str) -> None:
        self.failures.append(Failure(self.manifest.where(int(job.rows[0])), len(job.rows), reason, key))


class _Store:
    """The answers of a folder: one JSON line each, added as they come; a line that was cut off is asked again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.lock = folder, threading.Lock()
        self.answers: dict[str, dict[str, Any]] = {}
        self._path, self._begin = folder / "answers.jsonl", ""
        self.failed: dict[str, str] = {}
        self._read_failures()
        self._read_answers()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from asking the same while the block runs. Raises AnnotateError when one does."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with lock(self.folder / ".lock") as mine:
            if not mine:
                raise AnnotateError(f"another process asks for {self.folder}: wait for it, or name another --answers")
            self._read_answers()
            yield

    def _read_answers(self) -> None:
        if self._path.is_file():
            with self._path.open(encoding="utf-8", errors="replace") as file:
                for line in file:
                    self._begin = "" if line.endswith("\n") else "\n"
                    self._load(line)

    def _load(self, line: str) -> None:
        try:
            entry = json.loads(line)
            if isinstance(entry["caption"], str) and isinstance(entry["object"], str):
                self.answers[str(entry["key"])] = entry
        except (ValueError, KeyError, TypeError, RecursionError):
            return

    def _read_failures(self) -> None:
        """The questions that earlier runs could not get an answer to: the line of each by its key."""
        path = self.folder / "failures.jsonl"
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                self.failed[str(json.loads(line)["key"])] = line

    def keep(self, key: str, entry: dict[str, Any]) -> None:
        """Add an answer, from any thread: what was paid for is on the disk when this returns."""
        line = json.dumps({"key": key, **entry}, ensure_ascii=False)
        with self.lock, self._path.open("a", encoding="utf-8") as file:
            file.write(f"{self._begin}{line}\n")
            self._begin = ""
            self.answers[key] = entry

    def write_failures(self, failures: list[Failure], keys: list[str]) -> None:
        """failures.jsonl: what this run could not get, and of its `keys` what an earlier one could not and it did not
        come to."""
        met = {failure.key for failure in failures} | self.answers.keys() | {""}
        lines = [json.dumps(failure._asdict(), ensure_ascii=False) for failure in failures]
        lines += [self.failed[key] for key in dict.fromkeys(keys) if key in self.failed and key not in met]
        atomic_write(self.folder / "failures.jsonl", "".join(f"{line}\n" for line in lines))


def _attach(manifest: Manifest, captions: tuple[Caption, ...]) -> Manifest:
    text = manifest.column("text").to_pylist()
    kept = manifest.column(PHRASE) if PHRASE in manifest.table.column_names else [None] * len(manifest)
    phrase = kept if isinstance(kept, list) else kept.to_pylist()
    for caption in captions:
        for row in caption.job.rows:
            text[row] = caption.text
            phrase[row] = caption.job.phrase if caption.job.phrase is not None else phrase[row]
    result = replace_column(manifest, "text", pa.array(text, pa.string()))
    if any(caption.job.phrase is not None for caption in captions):
        result = replace_column(result, PHRASE, pa.array(phrase, pa.string()))
    return result
