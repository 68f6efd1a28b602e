from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from refused import refused

from anytouch_jax.config import Config
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.loading.samples import SampleReader
from anytouch_jax.data.loading.sampling import PartSampler, Shard
from anytouch_jax.data.manifest import manifest as manifests
from tests.data.manifest.test_containers import write_tar
from tests.support.tiny_models import touch_model


def test_64_hosts_fraction_a_corpus():
    """Shards of uneven size: each host reads its own, and an epoch draws each row once."""
    rng = np.random.default_rng(0)
    shard = rng.permutation(np.repeat(np.arange(640), rng.integers(20, 40, 640)))
    sampler = PartSampler(shard, 256, 64, 7, 1)
    batch = 256
    draws = sampler.take(0, batch * (len(shard) // batch * 2))
    again = PartSampler(shard, 256, 64, 7, 1)
    # no need to walk there
    assert again.take(batch * 50, batch) == draws[batch * 50 : batch * 51]
    assert PartSampler(shard, 256, 64, 8, 1).take(0, batch) != draws[:batch]
    first = Counter(item for item, epoch in draws if epoch == 0)
    assert len(first) == len(shard) and set(first.values()) == {1}
    slots = np.array([item for item, _ in draws]).reshape(-1, batch)
    homes = [set(shard[Shard(host, 64).cut(slots.T).ravel()]) for host in range(64)]
    assert sum(map(len, homes)) == 640 and set.union(*homes) == set(range(640))
    assert max(map(len, homes)) <= 12
    four = [set(shard[Shard(host, 4).cut(slots.T).ravel()]) for host in range(4)]
    assert sum(map(len, four)) == 640  # the same batches on fewer hosts
    sizes = np.bincount(
        [
            host
            for host, home in enumerate(homes)
            for one in home
            for _ in range((shard == one).sum())
        ]
    )
    assert sizes.max() - sizes.min() <= 40  # at most a shard
    own = slots[:, 0]  # one part: few shards at a time
    windows = [len(set(shard[own[at : at + 20]])) for at in range(0, 100, 20)]
    assert max(windows) <= 2 * PartSampler.MIXED


def test_too_few_shards_or_an_uneven_batch_is_an_error():
    shard = np.repeat(np.arange(3), 5)
    refused("divide", PartSampler, shard, 6, 4, 0, 0)
    refused("lower it", PartSampler, shard, 8, 4, 0, 0)


@pytest.fixture
def corpus(tmp_path):
    """Eight tars of four images, each a recording."""
    paths = [f"{shard}.tar/{2 * row}" for shard in range(8) for row in range(4)]
    for shard in range(8):
        write_tar(tmp_path / f"{shard}.tar", range(4 * shard, 4 * shard + 4))
    columns = {"path": paths, "sensor": ["digit"] * 32, "sequence": [path[:5] for path in paths]}
    columns |= {"frame_index": [0, 1, 2, 3] * 8, "split": ["train"] * 32, "dataset": ["mine"] * 32}
    file = tmp_path / "m.parquet"
    manifests.write(manifests.from_columns(columns, file), file)
    return manifests.read(file)


def config(**data) -> Config:
    plain = {"batch_size": 8, "jitter": (0, 0, 0, 0), "flip": 0.0, "cache": 0}
    return replace(
        Config(touch_model()),
        data=replace(
            Config(touch_model()).data, **(plain | {"parts": 4, "clip_fraction": 0.0} | data)
        ),
    )


def test_hosts_read_their_own_shards_and_together_the_batch_of_one(corpus, monkeypatch):
    whole = Loader(corpus, config())
    batches = [whole.batch(step) for step in range(6)]
    seen = {}
    for host in range(4):
        loader = Loader(corpus, config(), shard=(host, 4), devices=4)
        read = set()
        touch = SampleReader.touch
        monkeypatch.setattr(
            SampleReader,
            "touch",
            lambda self, rows, *rest, read=read, touch=touch: (
                read.update(corpus.value(row, "path").split("/")[0] for row in rows),
                touch(self, rows, *rest),
            )[1],
        )
        for step, batch in enumerate(batches):
            np.testing.assert_array_equal(loader.batch(step).clip, Shard(host, 4).cut(batch.clip))
        monkeypatch.setattr(SampleReader, "touch", touch)
        seen[host] = read
    assert sum(map(len, seen.values())) == 8 == len(set.union(*seen.values()))
    drawn = [int(clip[0, 0, 0, 0]) for batch in batches[:4] for clip in batch.clip]
    assert sorted(drawn) == list(range(32))


def test_parts_are_for_stage_1_without_weights(corpus):
    refused("leave one of them out", Loader, corpus, config(weights=(("mine", 2.0),)))
