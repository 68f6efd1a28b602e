"""Parameters that a loss uses, read from its jaxpr.

A parameter is used if a gradient can flow to it from the loss. PyTorch gives all others a gradient
of None. Dead code, integers and `stop_gradient` carry no gradient, and metrics do not count.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

Tree = Any
# Primitives whose inputs and outputs are, one by one, those of the program inside.
_CALLS = {
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "checkpoint",
    "remat",
    "remat2",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
    "shard_map",
}


def used_parameters(loss_fn: Callable[..., Any], params: Tree, *args: Any) -> Tree:
    """Return a tree like `params` of Python bools: whether the value of `loss_fn(params, *args)`
    depends on the leaf.

    `loss_fn` returns a scalar, or a scalar and anything else. Arguments may be arrays, tracers or
    shapes, and nothing is computed. Loops, branches, calls and custom derivatives are entered.
    """
    jaxpr = jax.make_jaxpr(loss_fn)(*jax.tree.map(_abstract, (params, *args))).jaxpr
    live = _live_inputs(jaxpr, [i == 0 for i in range(len(jaxpr.outvars))])
    treedef: Any = jax.tree.structure(params)
    return treedef.unflatten(live[: treedef.num_leaves])


def _abstract(leaf: Any) -> jax.ShapeDtypeStruct:
    leaf = leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


def _live_inputs(jaxpr: Any, live_outputs: list[bool]) -> list[bool]:
    """Return which inputs of a jaxpr reach one of its live outputs through differentiable
    values.
    """
    live = {
        var
        for var, on in zip(jaxpr.outvars, live_outputs, strict=True)
        if on and _carries_gradient(var)
    }
    for eqn in reversed(jaxpr.eqns):
        outputs = [var in live for var in eqn.outvars]
        if any(outputs):
            inputs = zip(eqn.invars, _live_operands(eqn, outputs), strict=True)
            live.update(var for var, on in inputs if on and _carries_gradient(var))
    return [var in live for var in jaxpr.invars]


def _carries_gradient(var: Any) -> bool:
    return not isinstance(var, Literal) and jnp.issubdtype(
        getattr(var.aval, "dtype", jnp.int32), jnp.inexact
    )


def _live_operands(eqn: Any, outputs: list[bool]) -> list[bool]:
    """Return which operands of an equation reach its live outputs.

    An unknown primitive uses all of them.
    """
    name = eqn.primitive.name
    params = eqn.params
    everything = [True] * len(eqn.invars)
    if name == "stop_gradient":
        return [False] * len(eqn.invars)
    if name == "scan":
        if "num_consts" in params:
            consts = params["num_consts"]
            carry = params["num_carry"]
        else:  # jax 0.11
            consts, carry = (len(part) for part in params["ft_in"].unpack()[:2])
        return _live_loop(params["jaxpr"].jaxpr, outputs, consts, carry)
    if name == "while":
        # The predicate is a bool: nothing flows through the condition.
        skip = params["cond_nconsts"]
        consts = params["body_nconsts"]
        return [False] * skip + _live_loop(
            params["body_jaxpr"].jaxpr, outputs, consts, len(outputs)
        )
    if name == "cond":
        branches = [_live_inputs(branch.jaxpr, outputs) for branch in params["branches"]]
        return [False] + [any(lives) for lives in zip(*branches, strict=True)]
    if name in _CALLS:
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        inner = getattr(inner, "jaxpr", inner)
        if inner is not None and len(inner.invars) == len(eqn.invars):
            return _live_inputs(inner, outputs)
    return everything


def _live_loop(body: Any, outputs: list[bool], consts: int, carry: int) -> list[bool]:
    """Return the live operands [constants, carry, scanned] of a loop, whose carry may be read
    rounds later.
    """
    needed = outputs[:carry]
    while True:
        inputs = _live_inputs(body, needed + outputs[carry:])
        more = [a or b for a, b in zip(needed, inputs[consts : consts + carry], strict=True)]
        if more == needed:
            return inputs[:consts] + needed + inputs[consts + carry :]
        needed = more
