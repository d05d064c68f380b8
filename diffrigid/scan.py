"""The loop over the steps of a rollout, and what reverse mode keeps of it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.contact.strikes import ends, is_rolling
from diffrigid.fence import unfused
from diffrigid.flight import Flight, launch
from diffrigid.linkage import onto_joints
from diffrigid.numerics import FOUND, PASSED, normalise, saving, with_tangents
from diffrigid.pytree import align_all, replace
from diffrigid.state import State
from diffrigid.world import World

MEMORY = 2**31  # [bytes] of states that reverse mode saves before it rather computes steps again
WORLDS = 1024  # under `jax.vmap`: `memory` has room for so many worlds where the passes of one are saved


def advance(world: World, state: State, dt: Array, controls: Any) -> State:
    """Advance by one step, on arrays with aligned batch axes; dt (*batch)."""

    def launch_from(state: State, t0: Array) -> Flight:
        return launch(world, state, controls, t0, dt)

    return joined(world, world.contact(world, state, launch_from, dt))


def joined(world: World, state: State) -> State:
    """Bring poses and velocities onto the joints: a start as it was given, and the end of a step."""
    return onto_joints(world.joints, world.statics, world.bodies, state) if world.joints else state


def aligned(world: World, state: State) -> tuple[World, State]:
    """World and state with the same number of batch axes, and the state with all of the batch.

    The world, too, has all of the batch where rows of joints or rolling rows are listed beside contacts. Inertias are
    made symmetric here, so that they are whatever entry is changed, and have symmetric gradients; and orientations are
    brought to unit length, as all that follows takes for granted.
    """
    state = replace(state, q=jax.vmap(normalise)(state.q))
    if world.dim == 3:
        inertia = world.bodies.inertia
        inertia = 0.5 * (inertia + jnp.swapaxes(inertia, 1, 2))
        world = replace(world, bodies=replace(world.bodies, inertia=inertia))
    world, state = align_all(world, state)
    rank = state.x.ndim - 2
    batches = [leaf.shape[leaf.ndim - rank :] for leaf in jax.tree.leaves((world, state))]
    batch = np.broadcast_shapes(*batches)

    def fill(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, leaf.shape[: leaf.ndim - rank] + batch)

    rows = (world.joints and ends(world)["a"]) or is_rolling(world)
    return jax.tree.map(fill, world) if rows else world, jax.tree.map(fill, state)


def scan_steps(
    world: World, state: State, intervals: Array, controls: Any, counts: tuple[int, ...], memory: int = MEMORY
) -> State:
    """`state` and the states at the ends of intervals (T, *batch) [s]; interval k takes counts[k] equal steps."""
    owner = np.repeat(np.arange(len(counts)), counts)
    lengths = intervals[owner] / np.array(counts, intervals.dtype)[owner].reshape(-1, *[1] * (intervals.ndim - 1))
    controls = jax.tree.map(lambda leaf: leaf[owner], controls)
    start, _, states = _scan(world, state, lengths, controls, memory, record=lambda state: state)
    if len(owner) != len(counts):
        last = np.cumsum(counts) - 1
        states = jax.tree.map(lambda leaf: leaf[last], states)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)


def final_state(world: World, state: State, dt: Array, controls: Any, steps: int, memory: int) -> State:
    """State after `steps` steps of dt (), without the ones between; controls have an axis of `steps` in front."""
    return _scan(world, state, jnp.full((steps,), dt), controls, memory, record=lambda _: None)[1]


def _scan(
    world: World, state: State, lengths: Array, controls: Any, memory: int, record: Callable
) -> tuple[State, State, Any]:
    """`state` on its joints, the state after steps of these lengths (T, *batch) [s], and the `record` of each."""
    steps = len(lengths)
    one_step = fenced(world, saves_passes(world, state, steps, memory))

    def recorded(state, inputs):
        state = one_step(state, *inputs)
        return state, record(state)

    start = joined(world, with_tangents(state, (world, lengths, controls)))
    block = _block_length(start, steps, memory)
    return start, *_blocked_scan(recorded, start, (lengths, controls), steps, block)


def fenced(world: World, saves: bool) -> Callable[[State, Array, Any], State]:
    """`advance`, which reverse mode recomputes from the state; on a CPU in a call that is not inlined.

    If it `saves` what the passes of a step find and hand on, each pass is recomputed from that.

    Otherwise XLA fuses the read of the saved state into every loop of the backward step, which then
    does not vectorise and costs several times as much.
    """

    again = saving(*(FOUND, PASSED) * saves)

    @again
    def one_step(state: State, dt: Array, controls: Any) -> State:
        @again
        def stepped(state):
            return advance(world, state, jnp.broadcast_to(dt, state.x.shape[2:]), controls)

        return unfused(stepped, state)

    return one_step


def saves_passes(world: World, state: State, steps: int, memory: int) -> bool:
    """Whether reverse mode saves the passes of all steps: for one world, if they take little of `memory` [bytes].

    In a batch they would not stay in the cache.
    """
    if state.x.ndim > 2 or world.crowd:
        return False
    return steps * world.contact.saved_numbers(world) * state.x.dtype.itemsize * WORLDS <= memory


def _block_length(state: State, steps: int, memory: int) -> int:
    """Number of steps between saved states: 1 while all fit into `memory` [bytes], else about sqrt(steps)."""
    saved = steps * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    return 1 if saved <= memory else int(np.sqrt(steps))


def _blocked_scan(record, state, inputs, steps: int, block: int):
    """lax.scan whose reverse pass keeps the state at every `block` steps and recomputes the rest."""
    if block <= 1:
        return lax.scan(record, state, inputs)
    whole = steps // block * block

    def split(leaf):
        return leaf[:whole].reshape(whole // block, block, *leaf.shape[1:])

    inner = jax.checkpoint(lambda state, inputs: lax.scan(record, state, inputs), prevent_cse=False)
    state, states = lax.scan(inner, state, jax.tree.map(split, inputs))
    states = jax.tree.map(lambda leaf: leaf.reshape(whole, *leaf.shape[2:]), states)
    if whole < steps:
        state, rest = lax.scan(record, state, jax.tree.map(lambda leaf: leaf[whole:], inputs))
        states = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), states, rest)
    return state, states
