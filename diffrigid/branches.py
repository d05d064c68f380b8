"""Branches of a program: their conditions, and choices between two trees."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


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


def choose(chosen: Array, new: Any, old: Any) -> Any:
    """Select one of two trees, by world or for all of them: chosen (*batch) or () bool, leaves (..., *batch)."""

    def one(new: Array, old: Array) -> Array:
        return new if new is old else jnp.where(jnp.broadcast_to(chosen, new.shape), new, old)

    return jax.tree.map(one, new, old)
