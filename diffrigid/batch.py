"""Many worlds at once: the only place where the batch axis moves.

Inside, the batch is the last axis, because on a CPU XLA vectorises the innermost one, and a batch runs in chunks whose
temporaries stay in the cache (of a GPU: fit its memory), divided among the devices. Outside, the JAX convention holds:
a leading batch axis. Plain `jax.vmap(rollout)` gives the same numbers; its batch axis comes first, in one chunk on one
device.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from diffrigid.compiling import compiled, is_for_speed, uncollected
from diffrigid.controls import as_controls, controlled
from diffrigid.convert import at_least_one, numbers
from diffrigid.devices import cut, devices, join, on_cpu, over_devices, pieces_of
from diffrigid.pytree import Number, map_arrays
from diffrigid.scan import MEMORY, aligned, final_state, scan_steps
from diffrigid.shapes import Disc, HalfSpace, Sphere
from diffrigid.state import State, rotations
from diffrigid.step import OPTIONS, floats, options_for, step_length
from diffrigid.world import World, check_kinds, check_leaves

LANES, LANES_GPU = 2**15, 2**23  # of a chunk: one for each contact, or more, and four for each body of its worlds
# Lanes of a contact of shapes with corners, which needs a search and is rarely alone; least and most worlds of a chunk.
# Compiled for speed, small chunks cost no more calls, and what one world needs is computed for fewer others.
CORNER, CORNER_FOR_SPEED, CORNER_GPU = 32, 512, 8
LEAST, LEAST_FOR_SPEED = 2**5, 2**4
MOST, MOST_FOR_SPEED, MOST_GPU = 2**12, 2**6, 2**20


@uncollected
def rollout_batch(
    world: World, state: State, *, dt: Number, steps: int, final_only: bool = False,
    controls: Mapping[str, Any] | None = None, chunk: int | None = None, memory: int = MEMORY,
) -> State:  # fmt: skip
    """States of B worlds; any leaf of `world` and `state` may have a leading batch axis.

    States that are off their joints are brought onto them first, as in `rollout`.

    Args:
        dt: [s].
        steps: T >= 1.
        final_only: return only the last state, (B, N, ...), instead of all of them, (B, T+1, N, ...).
        controls: values that forces with a `control` add, by its name; held over each step: (T, D or A) for all
            worlds, or (B, T, D or A).
        chunk: worlds that run together; default: as many as fit the cache and `memory`.
        memory: [bytes] that reverse mode may use for saved states on each device. If a batch needs more, only the start
            of each chunk is kept and the chunk is recomputed; if one chunk needs more, see `rollout`.

    All JAX devices share the work, including those of other processes: then every process makes the same call, and the
    result stays where it was computed (`jax.experimental.multihost_utils.process_allgather` brings it together).

    Raises:
        ValueError: no leaf has a batch axis, or two differ in its length; dt <= 0; steps, chunk or memory < 1;
            controls that forces do not take, or lack.

    Example:
        >>> thrown = dr.replace(state, v=jnp.array([[[0.0, 0.0]], [[1.0, 0.0]], [[2.0, 0.0]]]))  # (B, N, D)
        >>> ends = dr.rollout_batch(world, thrown, dt=1 / 60, steps=30, final_only=True)
        >>> ends.x[:, 0, 0].round(6).tolist()
        [0.0, 0.5, 1.0]
        >>> states = dr.rollout_batch(world, thrown, dt=1 / 60, steps=30)  # (B, T+1, N, D); to look at the last world:
        >>> last = jax.tree.map(lambda leaf: leaf[2], states)
        >>> page = dr.play(dr.Trajectory(t=jnp.arange(31) / 60, state=last, world=world))
    """
    check_kinds(world, state)
    batches = check_leaves(world, state, batch_first=True)
    world, state = floats(world, state)
    length, steps, memory = step_length(dt, state), at_least_one("steps", steps), at_least_one("memory", memory)
    sizes = {size for batch in batches for size in batch}
    if len(sizes) != 1:
        raise ValueError(
            f"rollout_batch: expected one leading batch axis on some leaf, got lengths {sorted(sizes)}"
            + ("" if sizes else ": make one by jax.vmap of dr.paths.write, or use rollout for one world")
        )
    count, most = sizes.pop(), _chunk(world) if chunk is None else at_least_one("chunk", chunk)
    controls = _controls(world, controls, state.x.dtype, steps, count)
    if chunk is None:
        least = 2 * int(np.sqrt(steps)) * _state_bytes(world, state)  # of one world, saved at every so many steps
        most = max(min(most, memory // least), 1)
    inputs = world, state, controls, length
    return RUN[options_for(inputs, steps, count)](*inputs, steps, final_only, count, pieces_of(count, most), memory)


def _controls(world: World, controls: Any, dtype: Any, steps: int, count: int) -> Any:
    """Controls of the whole batch, with the batch last: (T, D or A, B), or of length 1 where all worlds share them."""
    if isinstance(controls, Mapping):
        sizes = controlled(world.forces, -1)
        controls = {k: _batch_last(k, v, (steps, sizes[k]), count) if k in sizes else v for k, v in controls.items()}
    return as_controls(world.forces, controls, dtype, (steps,), (count,), axis=-1)


def _batch_last(name: str, value: Any, own: tuple[int, int], count: int) -> Any:
    """Move the batch of a control last, (B, T, D or A) to (T, D or A, B); one that all worlds share stays."""
    array = numbers(f"controls[{name!r}]", value, None)
    if array.shape not in (own, (count, *own)):
        raise ValueError(f"controls[{name!r}] has shape {array.shape}: expected {own} or {(count, *own)}")
    return array if array.ndim == 2 else jnp.moveaxis(jnp.asarray(array), 0, -1)


def _chunk(world: World) -> int:
    """Number of worlds of a chunk, a power of two, whose contacts and bodies fill LANES."""
    full, corner, least, most = LANES, CORNER, LEAST, MOST
    if not on_cpu():
        full, corner, most = LANES_GPU, CORNER_GPU, MOST_GPU
    elif is_for_speed():
        corner, least, most = CORNER_FOR_SPEED, LEAST_FOR_SPEED, MOST_FOR_SPEED

    def lanes(pairs):
        rounds = all(
            isinstance(world.shapes[kind], Disc | Sphere | HalfSpace) for kind in (pairs.shape_a, pairs.shape_b)
        )
        return len(pairs.a) * pairs.count * (1 if rounds else corner)

    contacts = sum(map(lanes, world.pairs))
    filling = 2 ** np.round(np.log2(full / (contacts + 4 * len(world.names))))
    return int(np.clip(filling, 1 if world.crowd else least, most))  # a crowd is wide enough by itself


def _state_bytes(world: World, state: State) -> int:
    so = rotations(world.dim)
    return len(world.names) * (2 * so.D + so.Q + so.A) * state.x.dtype.itemsize


def _batch_axes(world: World, controls: Any, count: int) -> list[int | None]:
    """For each leaf of the controls, its batch axis or None."""
    names, leaves = controlled(world.forces), jax.tree_util.tree_leaves_with_path(controls)
    keys = [getattr(path[0], "key", None) if path else None for path, _ in leaves]
    own = [key in names and leaf.shape[-1] == count for key, (_, leaf) in zip(keys, leaves, strict=True)]
    return [leaf.ndim - 1 if many else None for many, (_, leaf) in zip(own, leaves, strict=True)]


def _run(world, state, controls, dt, steps, final_only, count, pieces, memory):
    leaves, tree = jax.tree.flatten((world, state, controls))
    batched = jax.tree.leaves(map_arrays(lambda leaf, letters, _: leaf.ndim > len(letters), (world, state)))
    axes = [0 if many else None for many in batched] + _batch_axes(world, controls, count)
    split = [cut(leaf, axis, *pieces) for leaf, axis in zip(leaves, axes, strict=True) if axis is not None]
    alike = [leaf for leaf, axis in zip(leaves, axes, strict=True) if axis is None]

    def one_chunk(own, alike, dt):
        own, alike = iter(own), iter(alike)
        world, state, controls = jax.tree.unflatten(tree, [next(alike if axis is None else own) for axis in axes])
        world, state = aligned(world, state)
        if final_only:
            return final_state(world, state, dt, controls, steps, memory)
        return scan_steps(world, state, jnp.full((steps,), dt), controls, (1,) * steps, memory)

    if _state_bytes(world, state) * steps * pieces[0] * pieces[1] > memory * len(devices()):
        one_chunk = jax.checkpoint(one_chunk)

    def chunks(parts, whole):
        return lax.map(lambda own: one_chunk(own, *whole), parts)

    return jax.tree.map(lambda leaf: join(leaf, 0, count), over_devices(chunks, split, (alike, dt)))


RUN = tuple(compiled(options, "steps", "final_only", "count", "pieces", "memory")(_run) for options in OPTIONS)
