import pytest

from anytouch_jax.encoder.encoder import load_encoder


@pytest.fixture(scope="module")
def encoder(tiny_run):
    """The encoder of the tiny run."""
    return load_encoder(tiny_run)
