"""Keep XLA from computing things twice: functions that it does not fuse with what is around them."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from diffrigid.devices import on_cpu


def unfused(fn: Callable, *args: Any) -> Any:
    """Evaluate fn(*args) by itself on a CPU, and so its derivatives: a call that XLA does not inline.

    Where several results depend on one, XLA on a CPU computes it again inside each of them, and again for each
    component that is picked from it: in a chain of products of vectors this grows exponentially. An
    `optimization_barrier` is removed before fusion. On a GPU, where each call is made of launches of its own, fusion is
    left to XLA: S2 of `experiments/throughput.py` runs three times as fast.
    """
    if not on_cpu():
        return fn(*args)
    return jax.tree.map(_leave.bind, jax.jit(fn)(*jax.tree.map(_enter.bind, args)))


def at_hand(tree: Any) -> Any:
    """A tree of arrays that XLA on a CPU computes once, not again at each of its uses; see `unfused`."""
    return unfused(functools.partial(jax.tree.map, jnp.copy), tree)


def _as_it_is(name: str, lowered: Callable, transposed: Callable[[], Primitive]) -> Primitive:
    primitive = Primitive(name)
    primitive.def_impl(lambda value: value)
    primitive.def_abstract_eval(lambda value: value)
    ad.deflinear2(primitive, lambda cotangent, _: (transposed().bind(cotangent),))
    batching.defvectorized(primitive)
    mlir.register_lowering(primitive, mlir.lower_fun(lowered, multiple_results=False), cacheable=False)
    return primitive


# Around a call. What leaves it marks the operation that it comes from, the call. Transposed, cotangents enter where
# values leave, and leave where values enter: a call in reverse mode is marked in turn.
_enter: Primitive = _as_it_is("enter", lambda value: value, lambda: _leave)
_leave: Primitive = _as_it_is("leave", lambda value: set_xla_metadata(value, inlineable="false"), lambda: _enter)
