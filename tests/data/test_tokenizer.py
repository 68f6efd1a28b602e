import json

import numpy as np
import pytest
import tokenizers
from places import SHARED
from refused import refused

from anytouch_jax.data import tokenizer as text

CLIP = SHARED / "clip"
CAPTIONS = [
    "A soft, springy surface.",
    "A hard, smooth surface with ridges.",
    "A soft and smooth edge.",
    "rough rough",
]


@pytest.mark.parametrize("folder", [CLIP] if CLIP.is_dir() else [])
def test_the_ids_are_those_of_clip(folder):
    tokenizer = text.load_tokenizer(folder)
    assert (tokenizer.vocab_size, tokenizer.start_id, tokenizer.end_id) == (49408, 49406, 49407)
    cases = json.loads((folder / "token_ids.json").read_text())
    ids, mask = tokenizer.encode([case["text"] for case in cases], 77)
    assert ids.dtype == np.int32 and mask.dtype == bool and len(cases) > 5
    for case, row, real in zip(cases, ids, mask, strict=True):
        want = case["ids"] if len(case["ids"]) <= 77 else [*case["ids"][:76], 49407]
        assert row.tolist() == want + [49407] * (77 - len(want))
        assert real.tolist() == [True] * len(want) + [False] * (77 - len(want))
        assert case["length"] == len(case["ids"])


def test_padding_and_the_mask():
    tokenizer = text.train_tokenizer(CAPTIONS, 300)
    ids, mask = tokenizer.encode(["", "rough"], 16)
    assert ids[0].tolist() == [tokenizer.start_id] + [tokenizer.end_id] * 15
    assert mask[0].tolist() == [True, True] + [False] * 14
    used = int(mask[1].sum())
    assert ids[1, 0] == tokenizer.start_id and ids[1, used - 1] == tokenizer.end_id
    assert (ids[1, used:] == tokenizer.end_id).all() and tokenizer.end_id not in ids[1, : used - 1]
    assert ids[1].argmax() == used - 1  # CLIP pools at the first largest id


@pytest.mark.parametrize("length", [2, 3, 5])
def test_truncation_keeps_the_end_token_last(length):
    tokenizer = text.train_tokenizer(CAPTIONS, 300)
    full, _ = tokenizer.encode([CAPTIONS[1]], 64)
    ids, mask = tokenizer.encode([CAPTIONS[1]], length)
    assert ids[0].tolist() == [*full[0, : length - 1].tolist(), tokenizer.end_id]
    assert mask.all()


def test_training_is_deterministic_and_covers_any_text(tmp_path):
    tokenizer = text.train_tokenizer(CAPTIONS, 320)
    again = text.train_tokenizer([*reversed(CAPTIONS), CAPTIONS[0]], 320)
    texts = [*CAPTIONS, "Ünïcode ½ 触覚 \U0001f91a", "  MANY   spaces\n\tand TABS "]
    np.testing.assert_array_equal(tokenizer.encode(texts, 77)[0], again.encode(texts, 77)[0])
    assert 258 < tokenizer.vocab_size <= 320 and tokenizer.end_id == tokenizer.vocab_size - 1
    assert (
        tokenizer.encode(["many spaces and tabs"], 77)[0].tolist()
        == tokenizer.encode(texts[-1:], 77)[0].tolist()
    )
    different = {tuple(row) for row in tokenizer.encode(texts, 77)[0].tolist()}
    assert len(different) == len(texts)
    for target in (tmp_path / "new", tmp_path / "new" / "other.json"):
        tokenizer.save(target)
        loaded = text.load_tokenizer(target)
        np.testing.assert_array_equal(loaded.encode(texts, 77)[0], tokenizer.encode(texts, 77)[0])
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "other.json",
        "tokenizer.json",
    ]


def test_mistakes_are_errors(tmp_path):
    refused(
        r"there is no tokenizer .*none.*tokenizer\.json", text.load_tokenizer, tmp_path / "none"
    )
    (tmp_path / "tokenizer.json").write_text("{}")
    refused("is not a tokenizer", text.load_tokenizer, tmp_path)
    plain = tokenizers.Tokenizer(tokenizers.models.WordLevel({"a": 0}, unk_token="a"))
    plain.save(str(tmp_path / "plain.json"))
    refused("not of CLIP's kind", text.load_tokenizer, tmp_path / "plain.json")
    refused("without captions", text.train_tokenizer, [], 300)
    refused("at least 258", text.train_tokenizer, CAPTIONS, 257)
    refused("length of 1", text.train_tokenizer(CAPTIONS, 300).encode, ["x"], 1)
