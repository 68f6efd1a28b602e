"""One question to an OpenAI-compatible chat endpoint: bounded in time and size, retried, and the key kept to itself."""

from __future__ import annotations

import email.utils
import http.client
import json
import math
import os
import random
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from anytouch_jax.errors import UserError

_MOST = 4 << 20  # bytes of an answer
_LOCAL = ("localhost", "127.0.0.1", "::1")
_REFUSED = {401: "the key is not accepted", 403: "access is denied", 404: "there is no such address or model"}


class EndpointError(UserError):
    """The endpoint cannot be used at all: no further question makes sense."""


class AnswerError(Exception):
    """This one question got no answer, also after all tries; the message says why."""


class Answer(NamedTuple):
    """The text of an answer, why the model stopped, and the tokens that it counted (0 where it does not say)."""

    text: str
    finish: str
    tokens_in: int
    tokens_out: int


@dataclass(frozen=True)
class Endpoint:
    """Where and how to ask. `url` is the base address (https://api.openai.com/v1); the key comes from `key_variable`.

    `timeout`: seconds for a whole answer; `tries`: for each question; `wait`: seconds before the second try, doubled
    for each further one; `longest_wait`: the most that a server may ask for. `json_mode` asks for a JSON object;
    `token_field` is the name of the limit (newer models want max_completion_tokens); `temperature` None is not sent.
    """

    url: str
    model: str
    key_variable: str = "OPENAI_API_KEY"
    timeout: float = 60.0
    tries: int = 5
    wait: float = 1.0
    longest_wait: float = 120.0
    max_tokens: int = 200
    temperature: float | None = 0.0
    json_mode: bool = True
    token_field: str = "max_tokens"

    def __post_init__(self) -> None:
        if not 0 < self.timeout <= 86_400:
            raise EndpointError(f"timeout {self.timeout} must be above 0 seconds and at most 86,400")
        if self.tries < 1 or self.max_tokens < 1:
            raise EndpointError(f"tries {self.tries} and max-tokens {self.max_tokens} must be at least 1")

    @property
    def address(self) -> str:
        """The address that questions go to. Raises EndpointError for one that is no http(s) address."""
        url = self.url.rstrip("/")
        try:
            parts = urllib.parse.urlsplit(url)
            good = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0 and url.isascii()
            (parts.hostname or "").encode("idna")  # as the resolver will: no empty and no endless part
        except ValueError:
            good = False
        if not good:
            raise EndpointError(f"{self.url!r} is not an http or https address, such as https://api.openai.com/v1")
        if parts.username or parts.password:
            raise EndpointError(f"give the key by the environment variable {self.key_variable}, not in the address")
        return url if url.endswith("/chat/completions") else f"{url}/chat/completions"

    @property
    def local(self) -> bool:
        """Whether the endpoint is on this machine."""
        return urllib.parse.urlsplit(self.url).hostname in _LOCAL

    @property
    def exposes_key(self) -> bool:
        """Whether a key is set and would travel unencrypted to another machine. Raises EndpointError as `address`."""
        return self.address.startswith("http:") and not self.local and bool(os.environ.get(self.key_variable, ""))


@dataclass
class Client:
    """Asks an endpoint from many threads; `stop` ends all waiting. The key is read once and never shown."""

    endpoint: Endpoint
    stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        end = self.endpoint
        self._address = end.address
        self._key = os.environ.get(end.key_variable, "").strip()
        if not self._key and not end.local:
            raise EndpointError(f"set the environment variable {end.key_variable} to the key of {end.url}")
        if self._key and not (self._key.isascii() and self._key.isprintable() and " " not in self._key):
            raise EndpointError(f"the environment variable {end.key_variable} does not hold a key")
        # A redirect would take the key to another host, so none is followed.
        self._opener = urllib.request.build_opener(_NoRedirect)

    def ask(self, messages: list[dict[str, Any]]) -> Answer:
        """The answer to a chat. Raises AnswerError after all tries, EndpointError where no try can help."""
        end = self.endpoint
        body: dict[str, Any] = {"model": end.model, "messages": messages, end.token_field: end.max_tokens}
        if end.temperature is not None:
            body["temperature"] = end.temperature
        if end.json_mode:
            body["response_format"] = {"type": "json_object"}
        data = json.dumps(body).encode()
        reason = "it was stopped"
        for attempt in range(end.tries):
            if self.stop.is_set():
                break
            try:
                return _parse(self._send(data))
            except _Again as error:
                reason = self.redact(str(error))
                if attempt + 1 < end.tries:
                    self._sleep(attempt, error.after)
        raise AnswerError(f"{reason} (after {end.tries} tries)")

    def redact(self, text: str) -> str:
        """`text` without the key: a server may quote it."""
        return text.replace(self._key, "[key]") if self._key else text

    def _sleep(self, attempt: int, after: float | None) -> None:
        backoff = self.endpoint.wait * 2**attempt * random.uniform(0.75, 1.25)  # threads must not return in step
        self.stop.wait(min(backoff if after is None else max(after, 0.0), self.endpoint.longest_wait))

    def _send(self, data: bytes) -> bytes:
        request = urllib.request.Request(self._address, data, {"Content-Type": "application/json"}, method="POST")
        if self._key:
            request.add_unredirected_header("Authorization", f"Bearer {self._key}")
        deadline = time.monotonic() + self.endpoint.timeout
        try:
            with self._opener.open(request, timeout=self.endpoint.timeout) as response:
                return _read(response, deadline)
        except urllib.error.HTTPError as error:
            with error:
                raise self._judge(error, deadline) from None
        except TimeoutError as error:
            raise _Again(f"no answer within {self.endpoint.timeout:g} seconds") from error
        except urllib.error.URLError as error:
            raise _Again(f"the endpoint cannot be reached: {error.reason}") from None
        except (OSError, http.client.HTTPException) as error:
            raise _Again(f"the connection broke: {type(error).__name__}") from None

    def _judge(self, error: urllib.error.HTTPError, deadline: float) -> Exception:
        code = error.code
        try:
            said = _message(self.redact(_read(error, deadline).decode("utf-8", "replace")))
        except (_Again, OSError, http.client.HTTPException):
            said = ""
        said = self.redact(f"the endpoint answers {code}{f': {said}' if said else ''}")
        if code in (408, 409, 425, 429) or code >= 500:
            return _Again(said, _after(error.headers.get("Retry-After")))
        if code in _REFUSED:
            return EndpointError(f"{self.endpoint.url}: {_REFUSED[code]}; {said}")
        if 300 <= code < 400:
            return EndpointError(f"{self.endpoint.url} redirects to another address; give that one")
        return AnswerError(said)


class _Again(Exception):
    """A failure that may pass; `after`: seconds that the server asks to wait."""

    def __init__(self, message: str, after: float | None = None) -> None:
        super().__init__(message)
        self.after = after


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any) -> None:
        return None


def _read(response: Any, deadline: float) -> bytes:
    """The body, by pieces: a server that drips would otherwise hold a thread for ever."""
    parts, total = [], 0
    while part := response.read1(1 << 16):
        parts.append(part)
        total += len(part)
        if total > _MOST:
            raise _Again(f"the answer is longer than {_MOST} bytes")
        if time.monotonic() > deadline:
            raise TimeoutError
    return b"".join(parts)


def _parse(data: bytes) -> Answer:
    try:
        body = json.loads(data)
        choice = body["choices"][0]
        message = choice["message"]
        usage = body.get("usage") or {}
        text, refusal = message.get("content"), message.get("refusal")
        finish = "refusal" if refusal else str(choice.get("finish_reason") or "")
        if isinstance(text, list):  # some servers answer in parts
            text = "".join(str(part.get("text", "")) for part in text)
        counts = [int(usage.get(name) or 0) for name in ("prompt_tokens", "completion_tokens")]
        return Answer(str(refusal or text or ""), finish, *counts)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError):
        raise _Again("the endpoint does not answer in the form of a chat completion") from None


def _message(data: str) -> str:
    """The words of an error, in one line of at most 200 characters."""
    try:
        error = json.loads(data)["error"]
        text = error["message"] if isinstance(error, dict) else error
    except (ValueError, KeyError, TypeError, RecursionError):
        text = data[:400]
    return " ".join(str(text).split())[:200]


def _after(header: str | None) -> float | None:
    """Seconds of a Retry-After header, given as seconds or as a date."""
    if not header:
        return None
    try:
        seconds = float(header)
        return seconds if math.isfinite(seconds) else None
    except ValueError:
        pass
    try:
        return email.utils.parsedate_to_datetime(header).timestamp() - time.time()
    except (ValueError, TypeError):
        return None
