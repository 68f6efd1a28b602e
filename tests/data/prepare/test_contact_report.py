from __future__ import annotations

import cv2
import numpy as np
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.prepare import contact_report as r
from anytouch_jax.data.prepare.contact import ContactScores, contact_scores
from anytouch_jax.errors import UserError


def _manifest(folder, splits=None, **columns):
    rows = len(next(iter(columns.values())))
    table = {"path": [f"{i}.png" for i in range(rows)], "sensor": ["digit"] * rows, "sequence": ["s"] * rows,
             "frame_index": list(range(rows)), "split": splits or ["train"] * rows}  # fmt: skip
    return manifests.from_columns({**table, **columns}, folder / "m.parquet")


def _scores(values, reason="given"):
    return ContactScores(np.array(values, np.float32), np.full(len(values), reason, object))


def test_precision_recall_and_correlation_on_a_table_of_hand(tmp_path):
    manifest = _manifest(tmp_path, **{"label.force": [0.0, 0.5, 2.0, 3.0, 0.0, None]})
    got = r.contact_quality(manifest, _scores([1, 2, 9, 9, 9, 9]))
    assert (got.reference, got.above, got.rows, got.skipped) == ("label.force", 0.0, 5, 1)
    assert (got.positives, got.found, got.hits) == (3, 3, 2)
    assert (got.precision, got.recall) == (2 / 3, 2 / 3)
    assert got.correlation == pytest.approx(np.corrcoef([1, 2, 9, 9, 9], [0, 0.5, 2, 3, 0])[0, 1])
    assert got.parts == {"sensor digit": (5, 2 / 3, 2 / 3), "background given": (5, 2 / 3, 2 / 3)}
    assert "precision 0.667, recall 0.667" in got.lines()[0]
    strict = r.contact_quality(manifest, _scores([1, 2, 9, 9, 9, 9]), above=1.0)
    assert (strict.positives, strict.recall) == (2, 1.0)


def test_splits_references_and_nothing_to_compare(tmp_path):
    manifest = _manifest(
        tmp_path,
        ["train", "test", "background"],
        **{"label.contact": [1, 0, 0], "label.contact_score": [9.0, 9.0, 1.0]},
    )
    scores = _scores([9, 9, 9])
    assert r.contact_quality(manifest, scores).rows == 2  # background rows say nothing
    free = r.contact_quality(_manifest(tmp_path, **{"label.contact": [0]}), _scores([9]))
    assert free.precision == 0 and np.isnan(free.recall)
    assert r.contact_quality(manifest, scores, reference="label.contact_score").precision == 1
    with pytest.raises(UserError, match=r"no column label\.depth"):
        r.contact_quality(manifest, scores, reference="label.depth")
    with pytest.raises(UserError, match=r"both a value in label\.contact and a score"):
        r.contact_quality(manifest, _scores([np.nan] * 3, "none"))
    with pytest.raises(UserError, match="holds something that is no number"):
        r.contact_quality(_manifest(tmp_path, **{"label.force": ["x"]}), _scores([1]))


def test_pressed_frames_with_known_force_are_told_from_free_ones(tmp_path):
    y, x = np.mgrid[:60, :80]
    force = np.array([0.0] * 6 + [1.0, 2.0, 4.0, 8.0])
    rng = np.random.default_rng(0)
    for i, one in enumerate(force):
        bump = 12 * one**0.5 * np.exp(-((y - 20 - 4 * (i % 5)) ** 2 + (x - 40) ** 2) / 90) * np.sign(x - 40)
        picture = 110 + bump[..., None] * np.array([1, 0, -1]) + rng.normal(0, 2, (60, 80, 3))
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.clip(picture, 0, 255).astype(np.uint8))
    manifest = _manifest(tmp_path, **{"label.force": force.tolist()})
    scores = contact_scores(manifest)  # no background is given: it is estimated from the ten frames
    got = r.contact_quality(manifest, scores)
    assert (got.precision, got.recall) == (1.0, 1.0)
    assert got.correlation > 0.85
    path = r.contact_picture(manifest, scores, tmp_path / "out" / "contact.png", rows=1)
    picture = decode(path)
    assert picture.shape == (2 * (28 + r.TILE), r.TILE * r.PER_ROW, 3)
    tile, shift = picture[28 : 28 + r.TILE, : r.TILE], picture[56 + r.TILE :, : r.TILE]
    red, green = tile[..., 0].astype(int) - tile[..., 1], shift[..., 1].astype(int) - shift[..., 0]
    assert red.max() > 100 and green.max() > 60  # a red border above, a green one below
    assert not [name for name in (tmp_path / "out").iterdir() if name.name.startswith(".")]


def test_one_sided_and_unreadable_pictures(tmp_path):
    manifest = _manifest(tmp_path, ["train", "background"], **{"label.contact": [1, 0]})
    picture = decode(r.contact_picture(manifest, _scores([9, 9]), tmp_path / "c.png", rows=2))
    assert picture.shape[0] == 28 + 28 + r.TILE  # one kept frame (its file is lost: a blank tile), no dropped one
    with pytest.raises(UserError, match="nothing to show"):
        r.contact_picture(manifest, _scores([np.nan, 9]), tmp_path / "c.png")
