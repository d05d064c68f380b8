"""`step` and `rollout`: the whole simulator, pure functions of (world, state).

state -> forces -> flight -> contact [impact times -> impulses -> lever -> rest] -> state
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.compiling import LASTING, QUICK, WIDE, compiled, is_for_speed, is_own_program, uncollected
from diffrigid.contact.crowd import without_room
from diffrigid.controls import as_controls
from diffrigid.convert import Numbers, at_least_one, largest, numbers
from diffrigid.devices import on_cpu
from diffrigid.pytree import Number, Vector, batch_rank, map_arrays
from diffrigid.scan import MEMORY, advance, aligned, joined, scan_steps
from diffrigid.shapes import traced
from diffrigid.state import State
from diffrigid.trajectory import Trajectory
from diffrigid.world import World, check, check_kinds, check_leaves, shape_of_leaf

MUCH = 100_000_000  # [-] of `work`: beyond it a longer compilation pays
# Work, in numbers that contacts in the plane find: of a body, a joint in the plane, one in space, and of a number that
# contacts in space find. Measured, and weighted by how much longer such programs take to compile for speed.
A_BODY, A_JOINT, A_JOINT_IN_SPACE, IN_SPACE = 100, 2_000, 20_000, 12
CALLS = 3000  # expected number of calls of `step`


@uncollected
def step(world: World, state: State, dt: Number, controls: Mapping[str, Any] | None = None) -> State:
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
    world: World, state: State, *, dt: Number, steps: int | None = None, times: Vector | None = None,
    substeps: Sequence[int] | None = None, controls: Mapping[str, Any] | None = None, memory: int = MEMORY,
) -> Trajectory:  # fmt: skip
    """Trajectory from `state`, at every step or at given times.

    If `state` violates the joints, poses are projected onto them first, and impulses make the velocities consistent
    with them.

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
        ValueError: shapes or types of world and state do not fit; dt <= 0; steps < 1; times not increasing; both steps
            and times, or neither; substeps without times, not one integer >= 1 for each interval, or missing where
            times or dt is traced; memory < 1; controls that forces do not take, or lack.

    Both modes of differentiation work.

    Example:
        >>> trajectory = dr.rollout(world, state, dt=1 / 60, steps=30)
        >>> round(float(trajectory.state.x[-1, 0, 1]), 6)  # the same as in one step
        0.315678
    """
    check(world, state)
    if (steps is None) == (times is None):
        raise ValueError(f"rollout: give either steps or times, got {'neither' if steps is None else 'both'}")
    if times is None and substeps is not None:
        raise ValueError("rollout: substeps divide the intervals of times; without these, make dt smaller instead")
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


def missed_pairs(world: World, state: State, dt: Number) -> Array:
    """Number of neighbours, summed over the bodies, without room in a step of dt [s] from `state`, (...): should be 0.

    In a crowd, 256 discs or spheres and more without forces that meet only each other and half-spaces, pairs are
    found by a grid, and each body has room for `Contact(neighbours=...)` others that it could touch within the step at
    the speeds of its start. More are left out, and may be passed through: raise `neighbours`. Elsewhere every pair is
    tested.

    Args:
        state: of one world, or with leading axes, as `rollout` and `rollout_batch` return it.

    Raises:
        ValueError: not one world and its states; dt <= 0.
    """
    check_kinds(world, state)
    leading = shape_of_leaf(state.x, "state.x")[:-2]

    def in_one_row(leaf: Any, letters: tuple[str, ...], path: str) -> Array:
        shape = shape_of_leaf(leaf, path)
        return jnp.reshape(leaf, (int(np.prod(shape[: len(leading)])), *shape[len(leading) :]))

    states = map_arrays(in_one_row, state, "state")
    check_leaves(world, states, batch_first=True)
    if batch_rank(world):
        raise ValueError("missed_pairs: world has a batch: expected one world and its states; pick one")
    world, states = floats(world, states)
    length = step_length(dt, states)
    if not world.crowd:
        return jnp.zeros(leading, jnp.int32)
    return _missed_jit(world, states, length).reshape(leading)


def floats(world: World, state: State) -> tuple[World, State]:
    """Convert every leaf to an array of the type of state.x, so that a Python number does not cause another trace."""
    dtype = jnp.result_type(state.x)

    def converted(leaf: Any) -> Array:
        ready = isinstance(leaf, Array) and leaf.dtype == dtype and not leaf.weak_type
        return leaf if ready else lax.convert_element_type(jnp.asarray(leaf), dtype)

    return jax.tree.map(converted, (world, state))


def step_length(dt: Number, state: State, batch: bool = False) -> Numbers:
    """dt as an array of the type of the state, checked where it is known; a number, or with `batch` also (*batch)."""
    length = numbers("dt", dt, None, finite=False).astype(state.x.dtype)
    allowed = state.x.shape[2:] if batch else ()
    if length.ndim and length.shape != allowed:
        raise ValueError(f"dt has shape {length.shape}, expected a number" + batch * f" or {allowed} like the batch")
    if not traced(length) and not ((length > 0) & (length < largest(length.dtype))).all():
        raise ValueError(f"dt is {length}, expected > 0 [s] and finite")
    return length


def _given_substeps(substeps: Any, intervals: int) -> tuple[int, ...]:
    """Number of steps of each interval, as given."""
    try:
        in_order = isinstance(substeps, tuple | list | np.ndarray)  # which a set is not
        counts = tuple(at_least_one("substeps", count) for count in substeps) if in_order else ()
    except (TypeError, ValueError):
        counts = ()
    if len(counts) != intervals:
        raise ValueError(
            f"substeps is {substeps!r}, expected {intervals} integers >= 1, one for each interval of times"
        )
    return counts


def _intervals(times: Any, dtype: Any) -> tuple[Any, Numbers]:
    """Times (T+1,) and intervals [s], the former in double precision where known, for a clock that began long ago."""
    t = numbers("times", times, None)
    if t.ndim != 1 or t.shape[0] < 2:
        raise ValueError(f"times has shape {t.shape}, expected (T+1,) with T >= 1")
    between = jnp.diff(t).astype(dtype) if traced(t) else np.diff(np.asarray(times, float)).astype(dtype)
    gaps = _concrete(between)
    if gaps is not None and not (gaps > 0).all():
        raise ValueError(f"times must increase, got steps of {gaps.min():g} s or NaN: sort them and drop repeats")
    return t if traced(t) else np.asarray(times, float), between


def _substeps(intervals: Numbers, longest: Numbers) -> tuple[int, ...]:
    """Number of steps of each interval."""
    gaps, most = _concrete(intervals), _concrete(longest)
    if gaps is None or most is None:
        raise ValueError("times or dt is traced by jit or vmap: give rollout the number of steps, substeps=(...)")
    return tuple(steps_in(gaps, most).tolist())


def _concrete(value: Numbers) -> np.ndarray | None:
    """The numbers of an array, which it has under `jax.grad`; None: it is traced by jit or vmap."""
    if not traced(value):
        return np.asarray(value)  # within jit, JAX would trace it
    try:
        return np.asarray(lax.stop_gradient(value))
    except jax.errors.TracerArrayConversionError:
        return None


def steps_in(gaps: np.ndarray, longest: Any) -> np.ndarray:
    """Number of equal steps no longer than `longest` in each gap; a thousandth more is rounding of single precision."""
    return np.maximum(np.ceil(np.asarray(gaps, float) / np.asarray(longest, float) - 1e-3), 1).astype(int)


@jax.jit
def _missed_jit(world, states, dt):
    return lax.map(lambda state: without_room(world, state, dt), states)


def _step(world, state, dt, controls):
    world, state = aligned(world, state)
    return advance(world, joined(world, state), jnp.broadcast_to(dt, state.x.shape[2:]), controls)


def _rollout(world, state, intervals, controls, counts, memory):
    return scan_steps(*aligned(world, state), intervals, controls, counts, memory)


OPTIONS = QUICK, LASTING, WIDE, None
STEP = tuple(compiled(options)(_step) for options in OPTIONS)
ROLLOUT = tuple(compiled(options, "counts", "memory")(_rollout) for options in OPTIONS)


def options_for(inputs: tuple, steps: int, worlds: int) -> int:
    """Index of the OPTIONS to compile with: for few or small steps those that compile sooner, if not the faster ones.

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
    """Estimate of the work of a step, in numbers found by contacts in the plane."""
    found, joints = world.contact.saved_numbers(world), sum(map(len, world.joint_names))
    of_a_number, of_a_joint = (1, A_JOINT) if world.dim == 2 else (IN_SPACE, A_JOINT_IN_SPACE)
    return of_a_number * found + A_BODY * len(world.names) + of_a_joint * joints
