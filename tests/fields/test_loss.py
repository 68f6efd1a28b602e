"""What the loss of fields asks for."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from anytouch_jax.batch import FieldBatch, FieldOutput
from anytouch_jax.fields import loss
from anytouch_jax.fields.loss import output_terms
from anytouch_jax.fields.module import SlopeOutput
from anytouch_jax.fields.outputs import LENGTH
from anytouch_jax.fields.poisson import differences, integrate

SIDE = 16
HEIGHTS = (0.4, 0.4, 0.4, 0.4, 0.5, 1.5, 2.0, 2.4)  # over LENGTH


def plateaus():
    """Return flat tops (8, SIDE, SIDE) over LENGTH, of which nothing tells the height."""
    x = np.abs(np.arange(SIDE) - (SIDE - 1) / 2) < 4
    return (np.array(HEIGHTS)[:, None, None] * x[:, None] * x).astype(np.float32)


def best_height():
    """Return the height of the one gradient that minimises the loss of all the flat tops."""
    true = jnp.asarray(plateaus())
    count = len(true)
    maps = jnp.zeros(true.shape)
    zeros = jnp.zeros(count)
    touched = (true > 0).astype(jnp.float32)
    batch = FieldBatch(
        clip=jnp.zeros((count, 1, SIDE, SIDE, 3)),
        sensor=zeros,
        aspect=zeros,
        depth=LENGTH * true,
        shear=jnp.zeros((*true.shape, 2)),
        pressure=touched,
        force=jnp.zeros((count, 3)),
        torque=zeros,
        slip=zeros,
    )

    def surface(slope):
        rise = integrate(slope)
        return rise - rise[:, :1, :1]

    def of(params):
        slope = jnp.broadcast_to(params["slope"], (count, SIDE, SIDE, 2))
        out = FieldOutput(
            depth=LENGTH * surface(slope),
            shear=jnp.zeros((*true.shape, 2)),
            contact=maps,
            pressure=maps,
            depth_log=jnp.broadcast_to(params["depth_log"], true.shape),
            shear_log=maps,
            force=jnp.zeros((count, 3)),
            torque=zeros,
            slip=zeros,
            force_log=jnp.zeros((count, 2)),
            torque_log=zeros,
            slip_log=zeros,
        )
        log = jnp.broadcast_to(params["log"], slope.shape)
        return output_terms(out, SlopeOutput(slope, log), batch)[0]

    params = {
        "slope": jnp.mean(differences(true), 0, keepdims=True) * 0.5,
        "log": jnp.zeros((1, SIDE, SIDE, 2)),
        "depth_log": jnp.zeros((1, SIDE, SIDE)),
    }
    optimiser = optax.adam(0.02)

    @jax.jit
    def descend(params):
        def step(carry, _):
            params, state = carry
            updates, state = optimiser.update(jax.grad(of)(params), state)
            return (optax.apply_updates(params, updates), state), None

        return jax.lax.scan(step, (params, optimiser.init(params)), None, length=600)[0][0]

    return float(surface(descend(params)["slope"])[0, SIDE // 2, SIDE // 2])


def test_a_flat_top_of_unknown_height_is_read_as_the_mean(monkeypatch):
    mean = np.mean(HEIGHTS)
    assert best_height() == pytest.approx(mean, rel=0.15)
    # The likelihood alone asks for the median.
    monkeypatch.setattr(loss, "SQUARED_SLOPE", 0.0)
    monkeypatch.setattr(loss, "SQUARED_DEPTH", 0.0)
    assert best_height() < 0.6 * mean
