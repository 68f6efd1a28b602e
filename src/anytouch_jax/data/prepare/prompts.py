"""What is asked of a vision-language model, one prompt a family of datasets (AnyTouch, appendix: GPT-4o annotation).

The wording is our own; the inputs are the paper's: one photograph for Touch and Go and TacQuad; two photographs and
the tactile image for ObjectFolder Real, where the touched place can be hidden; photograph and phrase for TVL, SSVTP
and Octopi.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from anytouch_jax.errors import UserError

Family = Literal["photograph", "object", "phrase"]
MOST_WORDS = 60  # CLIP reads 77 tokens
_FEWEST_WORDS = 3

FAMILIES: dict[str, Family] = {
    "touch_and_go": "photograph",
    "tacquad": "photograph",
    "objectfolder_real": "object",
    "tvl": "phrase",
    "ssvtp": "phrase",
    "octopi": "phrase",
}

_SYSTEM = (
    "You describe how surfaces feel to the touch. You look at what you are given, name the material, and say what a "
    "fingertip would feel: texture, roughness, hardness, shape of edges and bumps, elasticity. You do not mention "
    "colours, cameras, sensors, images or who is touching."
)
_FORM = (
    'Answer with one JSON object and nothing else: {"object": "<what is touched, at most six words>", "caption": '
    '"<one or two sentences, at most 40 words, that say how the touched place feels>"}.'
)
_TEXTS: dict[Family, str] = {
    "photograph": (
        "The photograph shows an object or a surface at the moment when it is touched. Decide what is touched, near "
        "where the finger or the sensor is, and describe the tactile properties of that place."
    ),
    "object": (
        "{views} The place that is touched may be hidden there. The last picture "
        "is the imprint of the touched place on a soft gel with coloured light from its sides: it shows the local "
        "shape (edges, bumps, grooves, grain) of a patch about as large as a fingertip, and its colours mean nothing. "
        "Take the object and the material from the photographs and the local shape from the imprint, and describe the "
        "tactile properties of the touched place. Where they disagree, trust the imprint for shape and texture."
    ),
    "phrase": (
        "A person described how this touch feels by the words: {phrase}. {view}Expand these words into a full "
        "description of the tactile properties. Keep every property that is named, contradict none, and add only what "
        "follows from the material."
    ),
}
_REFUSAL = re.compile(
    r"\b(i'?m sorry|i am sorry|as an ai|i can(not|'?t) (see|assist|help|determine|identify|describe|provide|view)|"
    r"unable to (see|assist|help|determine|identify|describe|provide|view))\b",
    re.IGNORECASE,
)


class Question(NamedTuple):
    """A prompt of a family: the system's and the user's words; pictures go along in the order photographs, touch."""

    family: Family
    system: str
    text: str

    def hash(self) -> str:
        """The first 16 hex digits of the SHA-256 of the words."""
        return hashlib.sha256(f"{self.system}\0{self.text}".encode()).hexdigest()[:16]

    def messages(self, pictures: list[str]) -> list[dict[str, Any]]:
        """The chat; `pictures` are data URLs."""
        parts: list[dict[str, Any]] = [{"type": "text", "text": self.text}]
        parts += [{"type": "image_url", "image_url": {"url": url}} for url in pictures]
        return [{"role": "system", "content": self.system}, {"role": "user", "content": parts}]


def family_of(dataset: str | None, families: Mapping[str, str] | None = None) -> Family | None:
    """The family of a dataset: of `families` (dataset -> family), else of FAMILIES; None for one that is unknown.

    Raises UserError for a family that does not exist.
    """
    chosen = (families or {}).get(dataset or "") or FAMILIES.get(dataset or "")
    if chosen is not None and chosen not in _TEXTS:
        raise UserError(f"there is no family of prompts {chosen!r}; use one of {', '.join(_TEXTS)}")
    return chosen


def question(family: Family, photographs: int, phrase: str | None = None) -> Question:
    """The prompt of a family for so many photographs and, for family phrase, the words to expand."""
    views = "The first two pictures are photographs of the same object from two sides."
    if photographs == 1:
        views = "The first picture is a photograph of the object."
    view = "The photograph shows the place that is touched. " if photographs else ""
    quoted = json.dumps(" ".join((phrase or "").split()), ensure_ascii=False)
    text = _TEXTS[family].format(views=views, phrase=quoted, view=view)
    return Question(family, _SYSTEM, f"{text}\n\n{_FORM}")


class Nonsense(ValueError):
    """An answer that is no caption; the message says why."""


def caption_of(text: str, finish: str) -> tuple[str, str]:
    """(caption, object) of a model's answer. Raises Nonsense: empty, cut off, refused, no JSON, too short or long."""
    if finish in ("refusal", "content_filter") or _REFUSAL.search(text):
        raise Nonsense("refused")
    if not text.strip():
        raise Nonsense("empty")
    if finish == "length":
        raise Nonsense("cut off")
    bare = re.sub(r"\A\s*```(?:json)?\s*|\s*```\s*\Z", "", text)
    try:
        answer = json.loads(bare)
    except (ValueError, RecursionError):
        raise Nonsense("not JSON") from None
    caption = answer.get("caption") if isinstance(answer, dict) else None
    if not isinstance(caption, str):
        raise Nonsense("JSON without a caption")
    caption = " ".join(caption.split())
    words = len(caption.split())
    if words < _FEWEST_WORDS or not re.search(r"[^\W\d_]{2}", caption):
        raise Nonsense("too short")
    if words > MOST_WORDS or len(caption) > 12 * MOST_WORDS:
        raise Nonsense(f"too long ({words} words)")
    if "\ufffd" in caption or any(ord(letter) < 32 for letter in caption):
        raise Nonsense("not text")
    return caption, " ".join(str(answer.get("object") or "").split())[:100]
