from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import used_parameters as usage
from used_parameters import used_parameters

X = np.ones(3, np.float32)


def used(loss, **params):
    result = used_parameters(loss, params)
    assert all(type(value) is bool for value in jax.tree.leaves(result))
    return {name for name, value in result.items() if value}


def metrics(p):
    dead = jnp.sum(p["dead"]) * 2  # noqa: F841
    return jnp.sum(p["read"]), {"metric": jnp.sum(p["shown"]), "both": p["read"]}


def no_gradient(p):
    return p["picked"][jnp.argmax(p["index"])] * jnp.sum(jax.lax.stop_gradient(p["held"])) * jnp.sum(p["gate"] > 0)


def branches(p):
    chosen = jnp.where(p["a"] > 0, p["a"], p["b"])
    return jnp.sum(jax.lax.cond(X[0] > 0, lambda c, d: c * 2, lambda c, d: jnp.sin(c), p["c"], p["d"]) + chosen)


def calls(p):
    out, other = jax.jit(lambda a, b, c: (a * 2, c))(p["a"], p["b"], p["c"])
    return jnp.sum(jax.checkpoint(lambda x, y: jnp.sin(x))(out, p["d"])), other


@pytest.mark.parametrize(
    ("loss", "names", "expected"),
    [(metrics, "read dead shown idle", "read"), (no_gradient, "picked index held gate", "picked"),
     (branches, "a b c d", "a b c"), (calls, "a b c d", "a")],
)  # fmt: skip
def test_what_no_gradient_reaches_is_unused(loss, names, expected):
    assert used(loss, **dict.fromkeys(names.split(), X)) == {*expected.split()}


def test_a_scan_passes_on_what_its_carry_needs_rounds_later():
    def loss(p):
        def body(carry, x):
            first, second, third, lost = carry
            scanned, ignored = x
            return (first + second, second + third, third * p["const"], lost + scanned), ignored * p["dead"]

        init = (p["first"], p["second"], p["third"], p["lost"])
        (first, *_), out = jax.lax.scan(body, init, (p["scanned"], p["ignored"]), length=3)
        return jnp.sum(first), out

    names = ["first", "second", "third", "lost", "const", "dead"]
    many = {"scanned": np.ones((3, 3), np.float32), "ignored": np.ones((3, 3), np.float32)}
    assert used(loss, **dict.fromkeys(names, X), **many) == {"first", "second", "third", "const"}


def test_custom_derivatives_are_entered():
    @jax.custom_vjp
    def double(a, b):
        return a * 2

    double.defvjp(lambda a, b: (a * 2, b), lambda b, g: (g * 2, jnp.zeros_like(b)))

    @jax.custom_jvp
    def sine(a, b):
        return jnp.sin(a)

    sine.defjvp(lambda primals, tangents: (jnp.sin(primals[0]), jnp.cos(primals[0]) * tangents[0]))

    def loss(p):
        return jnp.sum(double(p["a"], p["b"]) + sine(p["c"], p["d"]) + jax.nn.relu(p["e"]))

    assert used(loss, a=X, b=X, c=X, d=X, e=X) == {"a", "c", "e"}


def test_a_scan_is_read_in_the_words_of_either_jax():
    """jax 0.11 has the lengths of a scan's operands in a tree; what is unused must be the same."""
    scanned = lambda x, used, unused: jax.lax.scan(lambda c, _: (c * used, unused), x, None, length=3)[0]  # noqa: E731
    jaxpr = jax.make_jaxpr(scanned)(1.0, 2.0, 3.0)
    (scan,) = (eqn for eqn in jaxpr.jaxpr.eqns if eqn.primitive.name == "scan")
    outputs = [True] + [False] * (len(scan.outvars) - 1)
    expected = usage._live_operands(scan, outputs)
    assert True in expected and False in expected
    if "num_consts" in scan.params:
        consts, carry = scan.params["num_consts"], scan.params["num_carry"]
        parts = [[0] * consts, [0] * carry, []]
        rest = {name: value for name, value in scan.params.items() if name not in ("num_consts", "num_carry")}
        later = SimpleNamespace(
            primitive=scan.primitive, invars=scan.invars, params=rest | {"ft_in": SimpleNamespace(unpack=lambda: parts)}
        )
        assert usage._live_operands(later, outputs) == expected
