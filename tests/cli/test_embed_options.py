"""`anytouch embed`: options that mean nothing for what is embedded are refused, before the encoder is loaded."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["m.csv", "--sensor", "digit"], "--sensor does nothing with a manifest, whose rows name their sensor"),
        (["m.parquet", "--sensor", "digit", "--stride", "2"], "--sensor, --stride do nothing with a manifest"),
        (["m.csv", "--rotate", "90", "--flip", "across"], "--rotate, --flip do nothing with a manifest"),
        (["frames", "--split", "test"], "--split does nothing with a folder or a video: only a manifest has splits"),
        (["touch.mp4", "--stride", "5"], "--stride does nothing without --stream"),
        (["0", "--stream", "--on-bad-sample", "skip"], "--on-bad-sample does nothing with --stream"),
        (["0", "--stream", "--stride", "5"], "--stride does nothing for single frames"),
        (["0", "--stream", "--split", "test", "--batch", "8"], "--split, --batch do nothing with --stream"),
    ],
)
def test_what_would_do_nothing_is_refused(mistake, words, told):
    assert told in mistake("embed", "--run", "nowhere", "--out", "f.npz", "--input", *words)


def test_features_are_written_as_npz(mistake):
    assert "features are written as .npz" in mistake("embed", "--run", "r", "--input", "m.csv", "--out", "f.csv")
    assert "features are written as .npz" in mistake("embed", "--run", "r", "--input", "m.csv", "--out", "-")


@pytest.mark.parametrize(
    "words",
    [
        ["m.csv", "--split", "test", "--frames", "3", "--batch", "8"],
        ["frames", "--sensor", "digit", "--batch", "8", "--rotate", "270", "--flip", "down"],
        ["0", "--stream", "--stride", "2", "--frames", "3", "--sensor", "digit"],
    ],
)
def test_what_is_used_is_not_refused(mistake, words):
    assert "nowhere" in mistake("embed", "--run", "nowhere", "--out", "f.npz", "--input", *words)  # the run is missing
