"""Several processes share a batch: joined in order, their parts are the batch of one process."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.data.loading import samples
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.loading.sampling import Shard
from anytouch_jax.errors import UserError


def _leaves(batch):
    if batch is None or isinstance(batch, np.ndarray):
        return [] if batch is None else [batch]
    return [leaf for part in batch for leaf in _leaves(part)]


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize(("stage", "recipe"), [(1, "paper"), (2, "paper"), (2, "release")])
@pytest.mark.parametrize("bad", ["error", "skip"])
def test_the_parts_joined_are_the_whole(make, settings, stage, recipe, count, bad, rich):
    manifest = make(rich)
    if bad == "skip":
        for row in (2, 7, 30):
            manifest.file(row).unlink()
        manifest.file(4, "image_path").unlink()
    config = settings(stage, recipe, plain=False, batch_size=8, on_bad_sample=bad)
    whole = Loader(manifest, config, devices=4)
    parts = [Loader(manifest, config, devices=4, shard=(i, count)) for i in range(count)]
    skipped = 0
    for (step, batch, info), *rest in zip(*(one.stream(0, 8) for one in (whole, *parts)), strict=True):
        joined = [np.concatenate(arrays) for arrays in zip(*(_leaves(one) for _, one, _ in rest), strict=True)]
        wanted = _leaves(batch)
        assert len(joined) == len(wanted) and step == rest[0][0]
        for got, want in zip(joined, wanted, strict=True):
            np.testing.assert_array_equal(got, want)
        assert sum(one["skipped_samples"] for _, _, one in rest) == info["skipped_samples"]
        assert all(one.get("images") == info.get("images") for _, _, one in rest)
        skipped += info["skipped_samples"]
    assert (skipped > 0) == (bad == "skip")


def test_a_shard_reads_its_own_files_only(make, settings, monkeypatch, rich):
    manifest, read = make(rich), []
    decode = samples.decode
    monkeypatch.setattr(samples, "decode", lambda path: read.append(path) or decode(path))
    counts = {}
    for shard in ((0, 1), (0, 2), (1, 2)):
        read.clear()
        loader = Loader(manifest, settings(2, batch_size=8, cache=0), devices=4, shard=shard)
        for step in range(6):
            loader.batch(step)
        counts[shard] = len(read)
    assert counts[0, 2] + counts[1, 2] == counts[0, 1] and 0.3 < counts[0, 2] / counts[0, 1] < 0.7


@pytest.mark.parametrize(
    ("size", "devices", "shard", "told"),
    [
        (6, 4, (0, 4), "batch_size 6 cannot be shared by 4 processes"),
        (8, 3, (0, 2), "devices 3 cannot be shared by 2 processes"),
        (8, 2, (2, 2), "there is no shard 2 of 2"),
        (8, 2, (0, 0), "there is no shard 0 of 0"),
    ],
)
def test_shares_that_do_not_add_up_are_told(make, settings, size, devices, shard, told, rich):
    with pytest.raises(UserError, match=told):
        Loader(make(rich), settings(batch_size=size), devices=devices, shard=shard)


def test_half_batches_of_matching_must_be_shared_too(make, settings, rich):
    loader = Loader(make(rich), settings(2, "release", batch_size=2), devices=2, shard=(0, 2))
    with pytest.raises(UserError, match="the rows of a matching batch 1 cannot be shared by 2"):
        for step in range(40):
            loader.batch(step)


def test_slots_fall_into_the_parts_in_order():
    places = [Shard(i, 3).place(slot, 9) for slot in range(9) for i in range(3)]
    assert [place for place in places if place is not None] == [0, 1, 2] * 3
    assert [i for slot in range(9) for i in range(3) if Shard(i, 3).place(slot, 9) is not None] == sorted([0, 1, 2] * 3)
    assert Shard(1, 3).place(None, 9) is None and Shard(1, 3).cut(np.arange(9)).tolist() == [3, 4, 5]
