"""Branches of a program: their conditions, and their use to keep XLA from computing things twice."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.devices import on_cpu


@jax.custom_batching.custom_vmap
def any_world(flags: Array) -> Array:
    """Whether any flag is set in any of the worlds, a bool: the condition of branches and loops.

    It is over all worlds under `jax.vmap` too: otherwise every branch would become a choice between two results that
    are both computed, which is far slower.
    """
    return jnp.any(flags)


@any_world.def_vmap
def _of_all_worlds(size: int, batched: list[bool], flags: Array) -> tuple[Array, bool]:
    del size, batched
    return any_world(flags), False


def opaque_true(like: Array) -> Array:
    """True, but not known to the compiler; see `unfused`. `like`: any array of the program, not infinite."""
    return any_world(~(jnp.ravel(like)[:1] > jnp.inf))


def unfused(live: Array, fn: Callable, *args: Any) -> Any:
    """Evaluate fn(*args) by itself on a CPU: XLA does not fuse across a branch.

    Where several results depend on one, XLA on a CPU computes it again inside each of them, and again for each
    component that is picked from it: in a chain of products of vectors this grows exponentially. An
    `optimization_barrier` is removed before fusion. So this is a choice that is always the same. On a GPU, where each
    choice waits for the device, fusion is left to XLA: S2 of `experiments/throughput.py` runs three times as fast.

    Args:
        live: `opaque_true` of something.
    """

    if not on_cpu():
        return fn(*args)

    def never(*args):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(once, *args))

    once = jax.jit(fn)  # traced once for both
    return lax.cond(live, once, never, *args)


def choose(chosen: Array, new: Any, old: Any) -> Any:
    """Select one of two trees, by world or for all of them: chosen (*batch) or () bool, leaves (..., *batch)."""

    def one(new: Array, old: Array) -> Array:
        return new if new is old else jnp.where(jnp.broadcast_to(chosen, new.shape), new, old)

    return jax.tree.map(one, new, old)
