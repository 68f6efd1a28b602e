"""What a head that was taught by few recordings may promise."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.live.page.accuracy import measure_head
from anytouch_jax.live.page.fitting import TaughtHead, fit_head
from anytouch_jax.live.page.naming import name_touch
from anytouch_jax.live.page.recorder import SCORE

ENCODER = SimpleNamespace(fingerprint="f", subtracts=False)
NAMES = ("cup", "ball", "key")
FRAMES = 6
WIDTH = 8


def taught(folder, recordings: int) -> TaughtHead:
    """A head of three things that are far apart, each recorded a few times."""
    rng = np.random.default_rng(0)
    middle = 3 * rng.standard_normal((len(NAMES), WIDTH))
    kind = np.repeat(np.arange(recordings) % len(NAMES), FRAMES)
    group = np.repeat(np.arange(recordings), FRAMES)
    shift = rng.standard_normal((recordings, WIDTH))[group]
    x = (middle[kind] + 0.3 * shift + 0.1 * rng.standard_normal((len(kind), WIDTH))).astype("f4")
    columns = {
        "path": [f"{row}.png" for row in range(len(kind))],
        "sensor": ["digit"] * len(kind),
        "sequence": [f"r{one}" for one in group],
        "frame_index": list(range(FRAMES)) * recordings,
        "split": ["train"] * len(kind),
        "object": [NAMES[one] for one in kind],
        SCORE: [20.0] * len(kind),
    }
    table = manifests.from_columns(columns, folder / "manifest.parquet")
    return fit_head(ENCODER, table, "digit", "class", lambda ids: x[ids], lambda _: None)


@pytest.mark.parametrize("recordings", [7, 8])
def test_under_nine_recordings_nothing_is_promised(tmp_path, recordings):
    """As docs/use/trust.md says: nothing is novel, and sets hold every class."""
    head = taught(tmp_path, recordings).head
    far = 100 * np.random.default_rng(1).standard_normal((20, WIDTH))
    assessed = head.assess(far)
    assert not assessed.novel.any() and assessed.in_set.all()
    about = name_touch(head, far[0])
    assert about["limit"] is None and about["recordings"] == recordings
    assert sorted(about["set"]) == sorted(NAMES)


def test_from_nine_recordings_on_something_new_is_new(tmp_path):
    found = taught(tmp_path, 12)
    far = 100 * np.random.default_rng(1).standard_normal((20, WIDTH))
    assert found.head.assess(far).novel.all()
    assert found.head.assess(found.x).novel.mean() < 0.2


@pytest.mark.parametrize("recordings", [6, 12, 30])
def test_few_recordings_are_modest(tmp_path, recordings):
    """All are right, however many there are, and the probability is what so many support."""
    found = taught(tmp_path, recordings)
    label, p = found.head(found.x)
    assert (label == found.rows.labels).all()
    most = (recordings + 1) / (recordings + 2)
    far = 100 * np.random.default_rng(1).standard_normal((20, WIDTH))
    assert all(name_touch(found.head, one)["p"] <= round(most, 3) for one in far)
    # those it was fitted on are met more surely than those that were left out
    assert p.max(1).mean() < most + 0.1
    assert p.max(1).mean() > 0.7


def test_all_right_is_no_certainty(tmp_path, monkeypatch):
    """An accuracy of 100 % from seven recordings has an interval."""
    found = taught(tmp_path, 7)
    monkeypatch.setattr(
        "anytouch_jax.live.page.accuracy.feature_cache.pixel_features", lambda *_, **__: None
    )
    monkeypatch.setattr(
        "anytouch_jax.live.page.accuracy.feature_cache.pixel_components", lambda *_: found.x
    )
    monkeypatch.setattr("anytouch_jax.live.page.accuracy.Backgrounds", lambda _: None)
    result = measure_head(None, found)
    assert result["right"] == result["right_high"] == 1.0
    # Clopper and Pearson: 2.5 % of p ** 7
    assert result["right_low"] == pytest.approx(0.025 ** (1 / 7), abs=0.01)
