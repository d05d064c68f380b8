"""Many worlds at once: the one place where the batch axis moves.

Inside, the batch is the last axis, because on a CPU XLA vectorises the innermost one, and a batch runs in
chunks whose temporaries stay in the cache. Outside, the JAX convention holds: a leading batch axis. Plain
`jax.vmap(rollout)` gives the same numbers, but slower than one after the other where bodies meet: a branch under it
computes both ways.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.pytree import map_arrays
from diffrigid.state import State
from diffrigid.step import aligned, at_least_one, final_state, floats, scan_steps, step_length
from diffrigid.world import World, axis_sizes, check_kinds, shape_of_leaf

LANES = 2**15


def rollout_batch(
    world: World, state: State, *, dt: Any, steps: int, final_only: bool = False, chunk: int | None = None
) -> State:
    """States of B worlds, from `world` and `state` of which any leaf may have a leading batch axis.

    Args:
        dt: [s].
        steps: T >= 1.
        final_only: return only the last state, (B, N, ...); else all of them, (B, T+1, N, ...).
        chunk: worlds that run together; default: as many as fit the cache.

    Raises:
        ValueError: no leaf has a batch axis, or two differ in its length; dt <= 0; steps < 1.

    Example:
        >>> thrown = dr.replace(state, v=jnp.array([[[0.0, 0.0]], [[1.0, 0.0]], [[2.0, 0.0]]]))  # (B, N, D)
        >>> ends = dr.rollout_batch(world, thrown, dt=1 / 60, steps=30, final_only=True)
        >>> ends.x[:, 0, 0].round(6).tolist()
        [0.0, 0.5, 1.0]
    """
    _check_leaves(world, state)
    world, state = floats(world, state)
    sizes = {size for tree in (world, state) for size in _batch_sizes(tree)}
    if len(sizes) != 1:
        raise ValueError(f"rollout_batch: expected one leading batch axis on some leaf, got lengths {sorted(sizes)}")
    length, steps = step_length(dt, state), at_least_one("steps", steps)
    count = sizes.pop()
    chunk = min(_chunk(world) if chunk is None else at_least_one("chunk", chunk), count)
    return _run(world, state, length, steps, final_only, count, chunk)


def _check_leaves(world: World, state: State) -> None:
    """Raise ValueError for what is no world or state, and for a leaf that has more than a batch axis and its own."""
    check_kinds(world, state)
    sizes = axis_sizes(world)

    def compare(leaf, letters, path):
        shape = shape_of_leaf(leaf, path)
        own = shape[max(len(shape) - len(letters), 0) :]
        wanted = [sizes.get(letter, size) for letter, size in zip(letters, own, strict=False)]
        if len(own) < len(letters) or list(own) != wanted or len(shape) > len(letters) + 1:
            raise ValueError(f"{path} has shape {shape}, expected ([B,] {', '.join(letters)}) in this world")
        return leaf

    map_arrays(compare, state, "state")
    map_arrays(compare, world, "world")


def _batch_sizes(tree) -> list[int]:
    sizes: list[int] = []
    map_arrays(lambda leaf, letters, _: sizes.extend(leaf.shape[: leaf.ndim - len(letters)]), tree)
    return sizes


def _chunk(world: World) -> int:
    """Power of two of worlds whose contacts and bodies fill LANES."""
    contacts = sum(len(pairs.a) * pairs.count for pairs in world.pairs)
    return int(2 ** np.clip(np.round(np.log2(LANES / (contacts + 4 * len(world.names)))), 4, 12))


@jax.jit(static_argnames=("steps", "final_only", "count", "chunk"))
def _run(world, state, dt, steps, final_only, count, chunk):
    pieces = -(-count // chunk)
    leaves, tree = jax.tree.flatten((world, state))
    batched = jax.tree.leaves(map_arrays(lambda leaf, letters, _: leaf.ndim > len(letters), (world, state)))
    split = [_split(leaf, pieces, chunk) for leaf, many in zip(leaves, batched, strict=True) if many]

    def one_chunk(pieces_of):
        rest = iter(pieces_of)
        filled = [next(rest) if many else leaf for leaf, many in zip(leaves, batched, strict=True)]
        world, state = aligned(*jax.tree.unflatten(tree, filled))
        if final_only:
            return final_state(world, state, dt, steps)
        return scan_steps(world, state, jnp.full((steps,), dt), None, (1,) * steps)

    return jax.tree.map(lambda leaf: _join(leaf, count), lax.map(one_chunk, split))


def _split(leaf: Array, pieces: int, chunk: int) -> Array:
    """(B, ...) to (pieces, ..., chunk), the last piece filled up with copies of the last world."""
    short = pieces * chunk - leaf.shape[0]
    leaf = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], short, axis=0)]) if short else leaf
    return jnp.moveaxis(leaf.reshape(pieces, chunk, *leaf.shape[1:]), 1, -1)


def _join(leaf: Array, count: int) -> Array:
    """(pieces, ..., chunk) to (B, ...)."""
    leaf = jnp.moveaxis(leaf, -1, 1)
    return leaf.reshape(-1, *leaf.shape[2:])[:count]
