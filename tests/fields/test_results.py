import csv
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from anytouch_jax.encoder.measured import Fields
from anytouch_jax.fields.measure import stacked
from anytouch_jax.fields.results import Results


def measured(count: int, start: int = 0, side: int = 60) -> Fields:
    """Fields of `count` frames, whose depth is their number."""
    number = np.arange(start, start + count, dtype=np.float32)
    maps = np.broadcast_to(number[:, None, None], (count, side, side)).copy()
    shear = np.stack([maps, -maps], -1)
    each = {"depth": maps, "depth_std": maps, "shear": shear, "shear_std": maps, "contact": maps}
    pair = np.stack([number, number], 1)
    three = np.stack([number] * 3, 1)
    each |= {"force": three, "force_std": three, "centre": pair}
    for name in ("torque", "slip", "area"):
        each |= {name: number, f"{name}_std": number}
    return Fields(**each, centre_std=number, width_mm=20.0, shape=0.75)


def test_results_of_batches_are_those_of_all_frames(tmp_path):
    results = Results(tmp_path / "m.npz")
    for start in (0, 16, 32):
        names = [str(number) for number in range(start, start + 16)]
        results.add(measured(16, start), names, [0.1 * int(name) for name in names])
    assert len(results) == 48 and not (tmp_path / "m.npz").exists()
    results.save(tmp_path / "m.npz", tmp_path / "m.csv", {"encoder": "mine"})
    results.close()
    whole = stacked([measured(48)])
    with np.load(tmp_path / "m.npz") as arrays:
        assert set(arrays.files) == whole.keys() | {"name", "time", "about/encoder"}
        for name, array in whole.items():
            assert arrays[name].dtype == array.dtype
            np.testing.assert_array_equal(arrays[name], array)
        assert arrays["name"].tolist() == [str(number) for number in range(48)]
        assert str(arrays["about/encoder"]) == "mine"
    lines = list(csv.DictReader((tmp_path / "m.csv").read_text().splitlines()))
    assert [float(line["depth"]) for line in lines] == list(range(48))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["m.csv", "m.npz"]


def test_results_that_are_not_saved_leave_nothing(tmp_path):
    (tmp_path / "m.npz").write_bytes(b"earlier")
    results = Results(tmp_path / "m.npz")
    results.add(measured(3), ["a", "b", "c"], [np.nan] * 3)
    results.close()
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"earlier"]


def test_memory_does_not_grow_with_a_recording(tmp_path):
    """Maps of a frame take 60 x 60 x 6 numbers, and ten times as many frames no more memory."""
    peaks = []
    for count in (5, 50):
        results = Results(tmp_path / "m.npz")
        tracemalloc.start()
        for number in range(count):
            results.add(measured(16), [str(number)] * 16, [0.0] * 16)
        results.save(tmp_path / "m.npz", tmp_path / "m.csv", {})
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        results.close()
    assert peaks[1] < 1.2 * peaks[0] + 500_000
    assert (tmp_path / "m.npz").stat().st_size > 800 * 60 * 60 * 12


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_named_at_once(tmp_path):
    results = Results(tmp_path / "m.npz")
    results.add(measured(2), ["a", "b"], [0.0, 1.0])
    results._arrays._files["depth"].close()
    results._arrays._files["depth"] = open("/dev/full", "wb")  # noqa: SIM115
    with pytest.raises(OSError, match="No space left") as told:
        results.add(measured(2), ["c", "d"], [2.0, 3.0])
    assert told.value.filename == str(tmp_path / "m.npz")
    results.close()
    assert list(tmp_path.iterdir()) == []


def test_frames_of_another_form_are_not_mixed(tmp_path):
    results = Results(tmp_path / "m.npz")
    results.add(measured(2), ["a", "b"], [0.0, 1.0])
    with pytest.raises(AssertionError):
        results.add(measured(2, side=50), ["c", "d"], [2.0, 3.0])
    results.close()
