import pytest
from task_world import painted
from tiny_models import tiny_config

from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.evaluate import feature_cache


@pytest.fixture(scope="session")
def images(tmp_path_factory):
    return painted(tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="session")
def encoder():
    return random_encoder(tiny_config())


@pytest.fixture
def passes(monkeypatch):
    """How many rows each pass over a manifest reads."""
    counts = []

    def counting(encoder, table, rows, *args, **options):
        counts.append(len(rows))
        return embed_rows(encoder, table, rows, *args, **options)

    monkeypatch.setattr(feature_cache, "embed_rows", counting)
    return counts
