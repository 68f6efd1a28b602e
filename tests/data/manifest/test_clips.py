import numpy as np
import pytest

from anytouch_jax.data.manifest import content as w
from anytouch_jax.data.manifest import manifest as manifests


def _brute(sequence, frame, stride, length):
    at = {pair: i for i, pair in enumerate(zip(sequence.tolist(), frame.tolist(), strict=True))}
    want = [
        [at.get((s, f - b * d), -1) for b in range(length - 1, -1, -1)]
        for s, f, d in zip(sequence.tolist(), frame.tolist(), stride.tolist(), strict=True)
    ]
    return [row for row in want if -1 not in row]


@pytest.mark.parametrize(
    "start", [0, 10**17]
)  # 10**17: too far apart for one number, so each sequence has its own zero
@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize("block", [7, 1 << 18])
def test_windows_are_what_the_words_say(monkeypatch, start, shuffle, block):
    monkeypatch.setattr(w, "_BLOCK", block)
    rng = np.random.default_rng(0)
    sequence = np.repeat(np.arange(60), 9)
    frame = np.tile(np.sort(rng.choice(14, 9, replace=False)), 60) + start * sequence
    stride = rng.choice([1, 2, 3, 10**18], 540, p=[0.4, 0.3, 0.2, 0.1])
    if shuffle:
        order = rng.permutation(540)
        sequence = sequence[order]
        frame = frame[order]
        stride = stride[order]
    for length in (1, 2, 3):
        want = _brute(sequence, frame, stride, length)
        assert w.clip_windows(sequence, frame, stride, length).tolist() == want and len(want) > 20
        ends = rng.random(540) < 0.5
        assert w.clip_windows(sequence, frame, stride, length, ends=ends).tolist() == [
            one for one in want if ends[one[-1]]
        ]


def test_what_no_64_bits_hold_is_one_sentence(tmp_path):
    columns = {
        "path": ["a"] * 4,
        "sensor": ["digit"] * 4,
        "sequence": ["s", "s", "r", "r"],
        "frame_index": [0, 1 << 62, 0, 1 << 62],
        "split": ["train"] * 4,
    }
    with pytest.raises(manifests.ManifestError, match="more than 64 bits hold"):
        manifests.from_columns(columns, tmp_path / "m.csv").clips(2)


def test_no_rows_and_clips_longer_than_every_recording_take_no_memory():
    one = np.arange(4)
    assert w.clip_windows(one[:0], one[:0], one[:0], 3).shape == (0, 3)
    assert w.clip_windows(0 * one, one, 0 * one + 1, 10**12).shape == (0, 10**12)
    assert w.clip_windows(0 * one, one, 0 * one + 1, 4).tolist() == [[0, 1, 2, 3]]
    with pytest.raises(OverflowError, match="no clip has"):
        w.clip_windows(0 * one, one, 0 * one + 1, 10**20)
