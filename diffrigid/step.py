"""`step` and `rollout`: the whole simulator, pure functions of (world, state).

state -> forces -> flight -> contact [impact times -> impulses -> lever -> rest] -> state
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.branches import opaque_true
from diffrigid.compiling import LASTING, QUICK, is_for_speed, is_own_program, uncollected
from diffrigid.contact.crowd import without_room
from diffrigid.contact.strikes import ends, is_rolling
from diffrigid.controls import as_controls
from diffrigid.convert import Numbers, largest, numbers
from diffrigid.devices import on_cpu
from diffrigid.flight import Flight, launch
from diffrigid.linkage import onto_joints
from diffrigid.numerics import FOUND, PASSED, saving, with_tangents
from diffrigid.pytree import align, batch_rank
from diffrigid.shapes import traced
from diffrigid.state import State
from diffrigid.trajectory import Trajectory
from diffrigid.world import World, check, check_kinds

MEMORY = 2**31  # [bytes] of states that reverse mode saves before it rather computes steps again
MUCH = 100_000_000  # [-] of `work`: beyond it a longer compilation pays
A_BODY = 100  # work for a body or a joint, in numbers found by contacts
CALLS = 3000  # expected number of calls of `step`
WORLDS = 1024  # under `jax.vmap`: `memory` has room for so many worlds where the passes of one are saved


@uncollected
def step(world: World, state: State, dt: Array, controls: Any = None) -> State:
    """State after dt [s]. A state that is off its joints is brought onto them first, as in `rollout`.

    Args:
        controls: values (D or A, *batch) that forces with a `control` add, by its name; held over the step.

    Raises:
        ValueError: shapes or types of world and state do not fit; dt <= 0; controls that forces do not take, or lack.

    Source: Newton-Euler equations. Differentiable in everything; see `Contact` for where
    it is kinked.

    Example:
        >>> after = dr.step(world, state, 0.5)  # with the bounce at its time, 0.428 s
        >>> round(float(after.x[0, 1]), 6)
        0.315678
    """
    check(world, state)
    world, state = floats(world, state)
    controls = as_controls(world.forces, controls, state.x.dtype, (), state.x.shape[2:])
    inputs = world, state, step_length(dt, state, batch=True), controls
    return STEP[options_for(inputs, CALLS, _worlds(state))](*inputs)


@uncollected
def rollout(
    world: World, state: State, *, dt: Any, steps: int | None = None, times: Any = None,
    substeps: tuple[int, ...] | None = None, controls: Any = None, memory: int = MEMORY,
) -> Trajectory:  # fmt: skip
    """Trajectory from `state`, at every step or at given times.

    Where joints do not hold in `state`, the bodies are moved onto them first, and struck by the impulses that make
    their velocities fit.

    Args:
        dt: [s] length of a step, or with `times` the longest step allowed.
        steps: number of steps T >= 1; or
        times: (T+1,) [s] increasing; times[0] is the time of `state`. Each interval is divided into equal steps no
            longer than dt (to a thousandth). Differentiable. Inside jit or vmap, give `substeps`, the number of steps
            of each interval, because it has to be known when tracing.
        controls: values (T, D or A, *batch) that forces with a `control` add, by its name; held over each interval.
        memory: [bytes] that reverse mode may use for saved states. If the states of all T steps do not fit, only about
            sqrt(T) are kept, and the steps between them are recomputed. If what the contacts of one world find in all
            steps fits into a thousandth of it, no step is recomputed, which compiles faster.

    Raises:
        ValueError: shapes or types of world and state do not fit; dt <= 0; steps < 1; times not increasing; memory < 1;
            controls that forces do not take, or lack.

    Both modes of differentiation work.

    Example:
        >>> trajectory = dr.rollout(world, state, dt=1 / 60, steps=30)
        >>> round(float(trajectory.state.x[-1, 0, 1]), 6)  # the same as in one step
        0.315678
    """
    check(world, state)
    if (steps is None) == (times is None):
        raise ValueError(f"rollout: give either steps or times, got {'neither' if steps is None else 'both'}")
    world, state = floats(world, state)
    longest, memory = step_length(dt, state), at_least_one("memory", memory)
    if times is None:
        count = at_least_one("steps", steps)
        t = longest * jnp.arange(count + 1, dtype=longest.dtype)
        intervals, counts = jnp.broadcast_to(longest, (count,)), (1,) * count
    else:
        t, intervals = _intervals(times, state.x.dtype)
        counts = _substeps(intervals, longest) if substeps is None else _given_substeps(substeps, len(intervals))
    controls = as_controls(world.forces, controls, state.x.dtype, (len(intervals),), state.x.shape[2:])
    inputs = world, state, intervals, controls
    states = ROLLOUT[options_for(inputs, sum(counts), _worlds(state))](*inputs, counts, memory)
    return Trajectory(t=t, state=states, world=world, controls=controls)


def missed_pairs(world: World, state: State, dt: Any) -> Array:
    """Number of neighbours, summed over the bodies, without room in a step of dt [s] from `state`, (...): should be 0.

    In a crowd, 256 discs or spheres and more without forces that meet only each other and half-spaces, pairs are
    found by a grid, and each body has room for `Contact(neighbours=...)` others that it could touch within the step at
    the speeds of its start. More are left out, and may be passed through: raise `neighbours`. Elsewhere every pair is
    tested.

    Args:
        state: of one world, or with leading axes, as `rollout` and `rollout_batch` return it.

    Raises:
        ValueError: not a world and a state; dt <= 0.
    """
    check_kinds(world, state)
    world, state = floats(world, state)
    length, leading = step_length(dt, state), state.x.shape[:-2]
    if not world.crowd:
        return jnp.zeros(leading, jnp.int32)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(leading) :]), state)
    return _missed_jit(world, flat, length).reshape(leading)


def floats(world: World, state: State) -> tuple[World, State]:
    """Convert every leaf to an array of the type of state.x, so that a Python number does not cause another trace."""
    dtype = jnp.result_type(state.x)

    def converted(leaf: Any) -> Array:
        ready = isinstance(leaf, Array) and leaf.dtype == dtype and not leaf.weak_type
        return leaf if ready else lax.convert_element_type(jnp.asarray(leaf), dtype)

    return jax.tree.map(converted, (world, state))


def step_length(dt: Any, state: State, batch: bool = False) -> Numbers:
    """dt as an array of the type of the state, checked where it is known; a number, or with `batch` also (*batch)."""
    length = numbers("dt", dt, None, finite=False).astype(state.x.dtype)
    allowed = state.x.shape[2:] if batch else ()
    if length.ndim and length.shape != allowed:
        raise ValueError(f"dt has shape {length.shape}, expected a number" + batch * f" or {allowed} like the batch")
    if not traced(length) and not ((length > 0) & (length < largest(length.dtype))).all():
        raise ValueError(f"dt is {length}, expected > 0 [s] and finite")
    return length


def at_least_one(name: str, count: Any) -> int:
    """Check a count of steps, of worlds, or of bytes, and return it as int."""
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise ValueError(f"{name} is {count!r}, expected an integer >= 1")
    return int(count)


def _given_substeps(substeps: Any, intervals: int) -> tuple[int, ...]:
    """Number of steps of each interval, as given."""
    try:
        counts = tuple(at_least_one("substeps", count) for count in substeps)
    except (TypeError, ValueError):
        counts = ()
    if len(counts) != intervals:
        raise ValueError(
            f"substeps is {substeps!r}, expected {intervals} integers >= 1, one for each interval of times"
        )
    return counts


def _intervals(times: Any, dtype: Any) -> tuple[Any, Array]:
    """Times (T+1,) and intervals [s], the former in double precision where known, for a clock that began long ago."""
    t = numbers("times", times, None)
    if t.ndim != 1 or t.shape[0] < 2:
        raise ValueError(f"times has shape {t.shape}, expected (T+1,) with T >= 1")
    between = jnp.diff(t) if traced(t) else np.diff(np.asarray(times, float))
    return t if traced(t) else np.asarray(times, float), jnp.asarray(between, dtype)


def _substeps(intervals: Array, longest: Array) -> tuple[int, ...]:
    """Number of steps of each interval, where these are concrete (as they are under `jax.grad`)."""
    try:
        gaps, dt_known = np.asarray(lax.stop_gradient(intervals)), np.asarray(lax.stop_gradient(longest))
    except jax.errors.TracerArrayConversionError:
        raise ValueError(
            "times or dt is traced by jit or vmap: give rollout the number of steps, substeps=(...)"
        ) from None
    if not (gaps > 0).all():
        raise ValueError(f"times must increase, got steps of {gaps.min():g} s or NaN: sort them and drop repeats")
    return tuple(steps_in(gaps, dt_known).tolist())


def steps_in(gaps: np.ndarray, longest: Any) -> np.ndarray:
    """Number of equal steps no longer than `longest` in each gap; a thousandth more is rounding of single precision."""
    return np.maximum(np.ceil(np.asarray(gaps, float) / np.asarray(longest, float) - 1e-3), 1).astype(int)


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

    The world, too, has all of the batch where rows of joints or rolling rows are listed beside contacts.
    """
    rank = max(batch_rank(world), batch_rank(state))
    world, state = align(world, rank), align(state, rank)
    batches = [leaf.shape[leaf.ndim - rank :] for leaf in jax.tree.leaves((world, state))]
    batch = np.broadcast_shapes(*batches)

    def fill(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, leaf.shape[: leaf.ndim - rank] + batch)

    rows = (world.joints and ends(world)["a"]) or is_rolling(world)
    return jax.tree.map(fill, world) if rows else world, jax.tree.map(fill, state)


@jax.jit
def _missed_jit(world, states, dt):
    return lax.map(lambda state: without_room(world, state, dt), states)


def _step(world, state, dt, controls):
    world, state = aligned(world, state)
    return advance(world, joined(world, state), jnp.broadcast_to(dt, state.x.shape[2:]), controls)


def _rollout(world, state, intervals, controls, counts, memory):
    return scan_steps(*aligned(world, state), intervals, controls, counts, memory)


OPTIONS = QUICK, LASTING, None
STEP = tuple(jax.jit(_step, compiler_options=options) for options in OPTIONS)
ROLLOUT = tuple(
    jax.jit(_rollout, static_argnames=("counts", "memory"), compiler_options=options) for options in OPTIONS
)


def options_for(inputs: tuple, steps: int, worlds: int) -> int:
    """Index of the OPTIONS to compile with: for few or small steps, of one world or a few, those that compile sooner.

    For a crowd or a GPU, which would run slower, and where JAX was told to compile for speed, those of JAX; also for
    traced inputs, which may not have options of their own: reverse mode makes a part of another program of them.

    Args:
        inputs: arguments of the program, a world first.
    """
    world = inputs[0]
    if world.crowd or is_for_speed() or not on_cpu() or traced(inputs) or not is_own_program():
        return OPTIONS.index(None)
    return (worlds > 1) + (steps * worlds * work(world) > MUCH)


def _worlds(state: State) -> int:
    return int(np.prod(state.x.shape[2:]))


def work(world: World) -> int:
    """Estimate of the work of a step, in numbers found by its contacts."""
    return world.contact.saved_numbers(world) + A_BODY * (len(world.names) + sum(map(len, world.joint_names)))


def scan_steps(
    world: World, state: State, intervals: Array, controls: Any, counts: tuple[int, ...], memory: int = MEMORY
) -> State:
    """`state` and the states at the ends of intervals (T, *batch) [s]; interval k takes counts[k] equal steps."""
    owner = np.repeat(np.arange(len(counts)), counts)
    lengths = intervals[owner] / np.array(counts, intervals.dtype)[owner].reshape(-1, *[1] * (intervals.ndim - 1))
    controls = jax.tree.map(lambda leaf: leaf[owner], controls)
    one_step = fenced(world, saves_passes(world, state, len(owner), memory))

    def record(state, inputs):
        state = one_step(state, *inputs)
        return state, state

    state = joined(world, with_tangents(state, (world, intervals, controls)))
    block = _block_length(state, len(owner), memory)
    _, states = _blocked_scan(record, state, (lengths, controls), len(owner), block)
    ends = np.cumsum(counts) - 1
    if len(owner) != len(counts):
        states = jax.tree.map(lambda leaf: leaf[ends], states)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, states)


def final_state(world: World, state: State, dt: Array, controls: Any, steps: int, memory: int) -> State:
    """State after `steps` steps of dt (), without the ones between; controls have an axis of `steps` in front."""
    one_step = fenced(world, saves_passes(world, state, steps, memory))

    def record(state, inputs):
        return one_step(state, *inputs), None

    state, lengths = joined(world, with_tangents(state, (world, dt, controls))), jnp.full((steps,), dt)
    return _blocked_scan(record, state, (lengths, controls), steps, _block_length(state, steps, memory))[0]


def fenced(world: World, saves: bool):
    """`advance`, which reverse mode recomputes from the state; on a CPU behind a `lax.cond` that is always true.

    If it `saves` what the passes of a step find and hand on, each pass is recomputed from that.

    Without the condition XLA fuses the read of the saved state into every loop of the backward step, which then
    does not vectorise and costs several times as much.
    """

    again = saving(*(FOUND, PASSED) * saves)

    @again
    def one_step(state: State, dt: Array, controls: Any) -> State:
        @again
        def stepped(state):
            return advance(world, state, jnp.broadcast_to(dt, state.x.shape[2:]), controls)

        if not on_cpu():
            return stepped(state)
        return lax.cond(opaque_true(dt), stepped, lambda state: state, state)

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
