"""Loss of predicted depth, shear, contact and force. Not in the paper."""

from __future__ import annotations

from typing import cast

import jax
import jax.numpy as jnp
from jax import Array

from anytouch_jax.batch import FieldBatch, FieldOutput
from anytouch_jax.config import Config
from anytouch_jax.fields.module import FieldDecoder, SlopeOutput
from anytouch_jax.fields.outputs import FORCE, LENGTH, STATES, STRESS, TORQUE
from anytouch_jax.fields.poisson import differences
from anytouch_jax.nn.functional import Net
from anytouch_jax.objectives import (
    AnyBatch,
    Metrics,
    Objective,
    Params,
    draw_sensor_rows,
    normalise_touch,
)
from anytouch_jax.ops import losses

TOUCHED = 1e-3  # of the gel's modulus: a pressure that counts as contact
# Of modulus times width squared, some 0.05 N: smaller forces have no meaningful ratio.
LEAST_FORCE = 1e-3
# Weights of the squared errors of the slope and of the depth, over LENGTH.
SQUARED_SLOPE = 10.0
SQUARED_DEPTH = 4.0
FAR = 2.0  # from this error of the depth on, over LENGTH, its square becomes a line


def field_terms(params: Params, batch: FieldBatch, *, net: Net) -> tuple[Array, Metrics]:
    """Return the loss of predicted fields and force, and errors in contact.

    Every error has a predicted Laplace deviation (Kendall and Gal 2017, "What uncertainties do we
    need"). `batch` has normalised pixels and drawn sensor rows.
    """
    batch = jax.tree.map(jnp.asarray, batch)
    network = net.bind(params)
    states = network.touch.states(batch.clip, batch.sensor, STATES)
    decoder = cast(FieldDecoder, network.fields)
    out, slope = decoder.with_slope(states, batch.clip, batch.aspect)
    return output_terms(out, slope, batch)


def output_terms(out: FieldOutput, slope: SlopeOutput, batch: FieldBatch) -> tuple[Array, Metrics]:
    """Return `field_terms` of the outputs for a batch."""
    touched = (batch.pressure > TOUCHED).astype(jnp.float32)
    pressed = (jnp.max(touched, (1, 2)) > 0).astype(jnp.float32)
    depth = (out.depth - batch.depth) / LENGTH
    # A press of half the force is as wrong as one of twice the force.
    ratio = jnp.log((out.force[:, 2] + LEAST_FORCE) / (batch.force[:, 2] + LEAST_FORCE))
    terms = _map_terms(out, slope, batch, touched) | _whole_terms(out, batch, pressed, ratio)
    predicted = (out.contact > 0).astype(jnp.float32)
    both = jnp.sum(predicted * touched)
    either = jnp.sum(jnp.maximum(predicted, touched))
    depth_error = LENGTH * jnp.sum(jnp.abs(depth) * touched) / jnp.maximum(jnp.sum(touched), 1)
    force_error = jnp.sum(jnp.abs(ratio) * pressed) / jnp.maximum(jnp.sum(pressed), 1)
    metrics = {f"field_{name}": value for name, value in terms.items()}
    metrics |= {
        "contact_iou": both / jnp.maximum(either, 1),
        "depth_error": depth_error,
        "force_error": force_error,
    }
    return jnp.sum(jnp.stack(list(terms.values()))), metrics


def _map_terms(out: FieldOutput, slope: SlopeOutput, batch: FieldBatch, touched: Array) -> Metrics:
    """Return the terms of the maps (B, h, w)."""
    depth = (out.depth - batch.depth) / LENGTH
    ratio = losses.mean(touched)
    # Contact covers little of an image. Pixels in contact weigh as much as all others together, so
    # that zero everywhere is no good answer.
    inside = 0.5 * touched / jnp.maximum(ratio, 1e-2)
    weight = inside + 0.5 * (1 - touched) / jnp.maximum(1 - ratio, 1e-2)

    def over_pixels(values: Array) -> Array:
        return losses.mean(weight * values)

    shear = (out.shear - batch.shear) / LENGTH
    own = slope.values - differences(batch.depth / LENGTH)
    slope_y = losses.mean(jnp.abs(jnp.diff(depth, axis=1)))
    slope_x = losses.mean(jnp.abs(jnp.diff(depth, axis=2)))
    shear_loss = losses.laplace_loss(shear, out.shear_log[..., None])
    # The likelihood of Laplace errors asks for the median, and hardly weighs places whose deviation
    # is large, such as the flanks of a flat top. Both read it too shallow. A squared error asks for
    # the mean, and means of slopes add up to the mean of the depth.
    steep = jnp.mean(jnp.square(own), -1)
    return {
        "depth": over_pixels(losses.laplace_loss(depth, out.depth_log)),
        # An edge in the wrong place costs little in depth and much in slope.
        "slopes": slope_y + slope_x,
        "slope": over_pixels(jnp.mean(losses.laplace_loss(own, slope.log), -1)),
        "squared_slope": SQUARED_SLOPE * over_pixels(steep),
        "squared_depth": SQUARED_DEPTH * over_pixels(_squared(depth)),
        "shear": over_pixels(jnp.mean(shear_loss, -1)),
        # Unweighted, because the output is a probability.
        "contact": 2 * losses.mean(losses.binary_loss(out.contact, touched)),
        # A few deep presses have a hundred times the pressure of others: high ones as a ratio.
        "pressure": over_pixels(jnp.abs(_squeezed(out.pressure) - _squeezed(batch.pressure))),
    }


def _squared(error: Array) -> Array:
    """Return squared errors that are lines from FAR on (Huber), so that no press takes a batch."""
    near = jnp.minimum(jnp.abs(error), FAR)
    return near * (2 * jnp.abs(error) - near)


def _squeezed(pressure: Array) -> Array:
    """Return pressures over STRESS where they are small, and their logarithm where they are not."""
    return jnp.log1p(pressure / STRESS)


def _whole_terms(out: FieldOutput, batch: FieldBatch, pressed: Array, ratio: Array) -> Metrics:
    """Return the terms of force, torque and slip (B,). `ratio` is the logarithm of the forces'."""
    sideways = (out.force[:, :2] - batch.force[:, :2]) / FORCE
    torque = (out.torque - batch.torque) / TORQUE
    # Nothing slides without contact.
    slip = jnp.where(pressed > 0, jax.nn.sigmoid(out.slip) - batch.slip, 0.0)
    return {
        "normal": losses.mean(losses.laplace_loss(ratio, out.force_log[:, 1])),
        "tangential": losses.mean(losses.laplace_loss(sideways, out.force_log[:, :1])),
        "torque": losses.mean(losses.laplace_loss(torque, out.torque_log)),
        "slip": losses.mean(losses.laplace_loss(slip, out.slip_log)),
    }


def _term(
    params: Params, batch: AnyBatch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics] | None:
    """Return `field_terms` of the touches of a batch that have fields."""
    fields = batch.fields
    if fields is None:
        return None
    _, sensor = draw_sensor_rows(fields.sensor, key, progress, net=net, config=config)
    fields = fields._replace(clip=normalise_touch(fields.clip), sensor=sensor)
    return field_terms(params, fields, net=net)


def _trains(batch: AnyBatch) -> tuple[str, ...]:
    """Return the parameters of the head and of the encoder's states, which precede its norm."""
    if batch.fields is None:
        return ()
    return ("^fields/", "^touch/(?!post_norm/)")


OBJECTIVE = Objective(_term, _trains)
