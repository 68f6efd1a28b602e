import json

import pytest
from chat_server import GOOD

from anytouch_jax.datasets.prompts import BadAnswer, parse_caption


@pytest.mark.parametrize(
    ("text", "finish", "words"),
    [
        ("", "stop", "empty"),
        ("  \n", "stop", "empty"),
        ('{"caption": "soft and', "length", "cut off"),
        (json.dumps(GOOD), "content_filter", "refused"),
        (json.dumps(GOOD), "refusal", "refused"),
        ('{"caption": "I cannot determine what is touched here."}', "stop", "refused"),
        ("[" * 100_000, "stop", "not JSON"),
        ('{"caption": "... -- !!"}', "stop", "too short"),
        ('{"caption": "soft soft"}', "stop", "too short"),
        (json.dumps({"caption": "soft " * 61}), "stop", "too long"),
        (json.dumps({"caption": "ab " + "x" * 800 + " b c"}), "stop", "too long"),
        ('{"caption": "soft \\u0007 and warm"}', "stop", "not text"),
        ("null", "stop", "without a caption"),
    ],
)
def test_bad_answers_have_a_reason(text, finish, words):
    with pytest.raises(BadAnswer, match=words):
        parse_caption(text, finish)


def test_a_caption_in_a_code_fence_is_a_caption():
    fenced = f"```json\n{json.dumps(GOOD | {'caption': ' Soft  and' + chr(10) + 'fuzzy. '})}\n```"
    assert parse_caption(fenced, "stop") == ("Soft and fuzzy.", "wool scarf")
    assert parse_caption('{"caption": "Soft and fuzzy.", "object": null}', "") == (
        "Soft and fuzzy.",
        "",
    )
