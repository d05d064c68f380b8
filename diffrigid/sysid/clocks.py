"""States at times that lie between those of a simulation, and that may depend on free parameters."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import choose
from diffrigid.flight import launch, state_at
from diffrigid.scan import advance
from diffrigid.state import State
from diffrigid.world import World


def states_at(world: World, states: State, lengths: Array, controls: Any, times: Array) -> State:
    """States at times (K, 1 or B) [s] since the first, from those after each step.

    Each is reached by one more step, of the missing time, from the state before it: what happens within that step, even
    an impact, is included, and the derivative with respect to time is the velocity. A time before the start is reached
    on the free flight that leads to it.

    Args:
        states: (S+1, N, ..., B). lengths: (S, B) [s]. controls: of each step, (S, size, 1 or B) by name.

    Returns:
        (K, N, ..., B).
    """
    lanes = lengths.shape[1]
    times = jnp.broadcast_to(times, (times.shape[0], lanes))
    ends = jnp.concatenate([jnp.zeros_like(lengths[:1]), jnp.cumsum(lengths, axis=0)])
    ends, count = lax.stop_gradient(ends), len(lengths)
    before = (lax.stop_gradient(times)[:, None] > ends[None]).sum(1) - 1  # strictly: so that no step has length 0
    before = jnp.clip(before, 0, count)
    missing = times - jnp.take_along_axis(ends, before, axis=0)
    late = missing > 0

    def flat(leaf: Array) -> Array:  # (K, N, ..., B) to (N, ..., K B)
        leaf = jnp.moveaxis(leaf, 0, -2)
        return leaf.reshape(*leaf.shape[:-2], -1)

    def again(leaf: Array) -> Array:
        return leaf if leaf.shape[-1] == 1 else jnp.tile(leaf, len(times))

    def pick(leaf: Array, row: Array) -> Array:
        return flat(jnp.take_along_axis(leaf, row.reshape(len(row), *[1] * (leaf.ndim - 2), -1), axis=0))

    start, worlds = jax.tree.map(lambda leaf: pick(leaf, before), states), jax.tree.map(again, world)
    acting = jax.tree.map(lambda leaf: pick(leaf, jnp.minimum(before, count - 1)), controls)
    dt = jnp.where(late, missing, lengths[0]).reshape(-1)
    after = advance(worlds, start, dt, acting)
    flight = launch(worlds, start, acting, jnp.zeros((start.x.shape[0], dt.shape[0]), dt.dtype), dt)
    earlier = state_at(flight, jnp.where(late, 0.0, missing).reshape(-1))

    def by_time(leaf: Array) -> Array:
        return jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], len(times), lanes), -2, 0)

    return jax.tree.map(by_time, choose(late.reshape(-1), after, earlier))
