"""From z to residuals: the records in arrays, and the simulation of all of them at once.

    z -> parameters -> scene of every record -> states -> what each column reads -> weighted residuals

Records of one structure are one group: they are padded to one length and lie, like the starts and the directions of the
Jacobian, side by side on the last axis, so that the program does not grow with their number. All measured numbers are
arguments of the program: another record of the same shape costs no compilation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.compiling import LASTING, QUICK, compiled, uncollected
from diffrigid.devices import cut, devices, everywhere, join, on_cpu, over_devices, pieces_of
from diffrigid.pytree import replace
from diffrigid.scan import aligned, scan_steps
from diffrigid.state import State
from diffrigid.step import work
from diffrigid.sysid.clocks import states_at
from diffrigid.sysid.parameters import Scene, Slot, knows, put, reference, split
from diffrigid.sysid.records import Run, series_of
from diffrigid.sysid.sensors import difference, is_angle, is_turn
from diffrigid.sysid.times import controls_over, grid

SHOWN_RECORDS, SHOWN_STARTS = 3, 64  # at most, whose motions are returned
LITTLE_WORK = 10_000_000  # in all records, starts and directions: up to it a fit compiles for longer than it runs


@dataclass(frozen=True)
class Plan:
    """Static description of a group of records, which is compiled in."""

    slots: tuple[Slot, ...]  # shared ones first; those unknown to the scenes of the group have no paths
    clocked: tuple[str, ...]  # columns with times that are shifted
    priors: tuple[float, ...]  # of each slot: 1 / sqrt(records that share it)


class Data(NamedTuple):
    """Records of a group in arrays, with a last axis of R records, or of 1 where they are equal."""

    scene: Scene
    lengths: Any  # (S, R) [s] of the steps
    rows: dict[str, Array]  # (K, R) state of each row of a column
    times: dict[str, Array]  # (K, R) [s] since the start, of columns that are clocked
    controls: dict[str, Array] | None  # (S, D or A, R) over each step
    measured: dict[str, Array]  # (K, size, R)
    weights: dict[str, Array]  # (K, size of the residual, R) 1 / standard deviation, 0 where missing
    width: Any  # () [m] of smooth impacts; None: all are exact


@dataclass(frozen=True)
class Group:
    """Records that are simulated together, and their indices."""

    plan: Plan
    data: Data
    members: tuple[int, ...]


# ---- records in arrays


def make_groups(found: Sequence[Run], slots: Sequence[Slot], shared: int, longest: float) -> list[Group]:
    """Group the records by structure.

    Args:
        shared: how many of the slots belong to all records.
        longest: [s] the longest step allowed.
    """
    keys: dict[Any, list[int]] = {}
    for index, run in enumerate(found):
        scene = (run.world, run.state, run.channels)
        shapes = tuple(jnp.shape(leaf) for leaf in jax.tree.leaves(scene))
        keys.setdefault((jax.tree.structure(scene), shapes), []).append(index)
    priors = tuple(1.0 if k >= shared else float(len(found)) ** -0.5 for k in range(len(slots)))
    return [_group([found[i] for i in members], tuple(members), slots, priors, longest) for members in keys.values()]


def _group(
    found: list[Run], members: tuple[int, ...], slots: Sequence[Slot], priors: tuple[float, ...], longest: float
) -> Group:
    dtype = found[0].state.x.dtype
    scenes = [Scene(run.world, run.state, run.channels, run.written) for run in found]
    absent = [not all(knows(scenes[0], path) for path in slot.paths) for slot in slots]  # their z does nothing here
    here = tuple(replace(s, paths=(), prior=None) if off else s for s, off in zip(slots, absent, strict=True))
    freed = {path for slot in here for path in slot.paths}
    clocked = tuple(
        name
        for name in found[0].channels
        if {f"{name}.clock", "clock"} & freed or any(float(run.channels[name].clock) != 0 for run in found)
    )
    grids = [grid(run, longest) for run in found]
    steps = max(len(lengths) for lengths, _ in grids)
    lengths = [np.concatenate([a, np.full(steps - len(a), longest)]) for a, _ in grids]
    acting = [controls_over(run, run.start + np.cumsum(h) - h) for run, h in zip(found, lengths, strict=True)]
    names = list(found[0].channels)
    rows = {name: _roomy(max(len(series_of(run, name).t) for run in found)) for name in names}

    def stacked(make, names=names):
        return {name: _side_by_side([_padded(make(k, name), rows[name]) for k in range(len(found))]) for name in names}

    data = Data(
        scene=jax.tree.map(lambda *leaves: _side_by_side(leaves), *scenes),
        lengths=_side_by_side(lengths),
        rows=stacked(lambda k, name: grids[k][1][name]),
        times=stacked(lambda k, name: series_of(found[k], name).t - found[k].start, clocked),
        controls=jax.tree.map(lambda *values: _side_by_side(values), *acting),
        measured=stacked(lambda k, name: np.nan_to_num(series_of(found[k], name).values)),
        weights=stacked(lambda k, name: known(found[k], name).astype(float)),
        width=None,
    )
    data = jax.tree.map(lambda a: a.astype(dtype if np.issubdtype(a.dtype, np.floating) else np.int32), data)
    return Group(Plan(here, clocked, priors), jax.device_put(data), members)


def shaped_like(groups: Sequence[Group], others: Sequence[Group], longest: float) -> list[Group]:
    """The groups, padded to the shapes of others where they fit, so that what is compiled for these serves them too."""
    alike = [(a, b) for a, b in zip(groups, others, strict=False) if a.plan == b.plan and _fits(a.data, b.data)]
    if not len(alike) == len(groups) == len(others):
        return list(groups)
    return [replace(a, data=_shaped(a.data, b.data, longest)) for a, b in alike]


def _fits(data: Data, other: Data) -> bool:
    """Whether no array is larger, or has more axes or other inner ones."""
    tree: Any = jax.tree.structure(data)
    if tree != jax.tree.structure(other):
        return False
    shapes = [(a.shape, b.shape) for a, b in zip(jax.tree.leaves(data), jax.tree.leaves(other), strict=True)]
    same = all(len(a) == len(b) and a[1:-1] == b[1:-1] for a, b in shapes)
    return same and all(not a or (a[0] <= b[0] and a[-1] in (1, b[-1])) for a, b in shapes)


def _shaped(data: Data, other: Data, longest: float) -> Data:
    def shaped(leaf: Any, like: Array) -> Any:
        if not leaf.ndim:
            return leaf
        whole = np.broadcast_to(np.asarray(leaf), (*leaf.shape[:-1], like.shape[-1]))
        return _padded(whole, like.shape[0]) if leaf.ndim > 1 else whole

    found = jax.tree.map(shaped, data, other)
    lengths = np.where(found.lengths > 0, found.lengths, np.asarray(longest, found.lengths.dtype))
    return jax.device_put(found._replace(lengths=lengths))


def known(run: Run, name: str) -> np.ndarray:
    """Whether residuals of a column are measured, (K, size of the residual) bool."""
    finite = np.isfinite(series_of(run, name).values)
    if not is_turn(run.channels[name]):
        return finite
    return np.repeat(finite.all(1, keepdims=True), 1 if finite.shape[1] == 2 else 3, axis=1)


def full_turn(run: Run, name: str) -> float:
    """Change of the reading of a column of angles by a full turn; 0 for other columns."""
    channel = run.channels[name]
    return 2.0 * np.pi * abs(float(channel.scale)) if is_angle(channel) else 0.0


def _roomy(count: int) -> int:
    """Up to an eighth more, so that records with about as many rows have one shape."""
    unit = 1 << max(count.bit_length() - 4, 0)
    return -(-count // unit) * unit


def _padded(array: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([array, np.zeros((rows - len(array), *array.shape[1:]), array.dtype)])


def _side_by_side(leaves: Sequence[Any]) -> np.ndarray:
    """Stack arrays along a new last axis, of length 1 if all are equal."""
    leaves = [np.asarray(leaf) for leaf in leaves]
    alike = all(leaf is leaves[0] or np.array_equal(leaf, leaves[0]) for leaf in leaves)
    return np.stack(leaves[:1] if alike else leaves, axis=-1)


def of_record(array: Any, k: int) -> np.ndarray:
    """Record k of an array of a group, whose last axis is 1 where all records are equal."""
    return np.asarray(array)[..., k if array.shape[-1] > 1 else 0]


# ---- residuals


def _simulated(plan: Plan, z: Array, data: Data) -> tuple[Array, State]:
    """Weighted residuals (m, B) of B lanes z (n, B), over all devices; arrays of `data` have a last axis of 1 or B.

    Rows of priors come last, shared among the records so that their squares sum to one prior. Also the states
    (S+1, ..., B) that they come from, which stay where they were computed.
    """
    if len(devices()) == 1:
        return _simulated_here(plan, z, data)
    lanes, (leaves, tree) = z.shape[1], jax.tree.flatten((z, data))
    own = [leaf is z or (leaf.ndim > 0 and leaf.shape[-1] == lanes > 1) for leaf in leaves]
    pieces = pieces_of(lanes, lanes)
    parts = [cut(leaf, -1, *pieces) for leaf, many in zip(leaves, own, strict=True) if many]
    alike = [leaf for leaf, many in zip(leaves, own, strict=True) if not many]

    def share(parts, alike):
        mine, alike = iter(part[0] for part in parts), iter(alike)
        own_share = jax.tree.unflatten(tree, [next(mine if many else alike) for many in own])
        return jax.tree.map(lambda leaf: leaf[None], _simulated_here(plan, *own_share))

    found, states = jax.tree.map(lambda leaf: join(leaf, -1, lanes), over_devices(share, parts, alike))
    return everywhere(found), states


def _simulated_here(plan: Plan, z: Array, data: Data) -> tuple[Array, State]:
    lanes = z.shape[1]
    scene = _lanes(plan.slots, data.scene, z)
    contact = replace(scene.world.contact, width=data.width)
    world, start = aligned(replace(scene.world, contact=contact), scene.state)
    lengths = jnp.broadcast_to(data.lengths, (data.lengths.shape[0], lanes))
    states = scan_steps(world, start, lengths, data.controls, (1,) * lengths.shape[0])
    rows = []
    for name, channel in scene.channels.items():
        if name in plan.clocked:
            seen = states_at(world, states, lengths, data.controls, data.times[name] - channel.clock[None])
        else:
            seen = jax.tree.map(lambda leaf, index=data.rows[name]: _pick(leaf, index), states)
        away = difference(channel, world, seen, data.measured[name]) * data.weights[name]
        rows.append(away.reshape(-1, lanes))
    return jnp.concatenate([*rows, *_prior_rows(plan, data.scene, z)]), states


def _lanes(slots: Sequence[Slot], scene: Scene, z: Array) -> Scene:
    """Scenes of all lanes, with their parameters written in."""
    batched = jax.tree.map(lambda leaf: -1 if leaf.shape[-1] > 1 else None, scene)
    scene = jax.tree.map(lambda leaf: leaf if leaf.shape[-1] > 1 else leaf[..., 0], scene)
    return jax.vmap(lambda scene, z: put(slots, scene, z), in_axes=(batched, -1), out_axes=-1)(scene, z)


def _pick(leaf: Array, index: Array) -> Array:
    """Pick rows of states (S+1, ..., B) by index (K, 1) or (K, B)."""
    if index.shape[1] == 1:
        return leaf[index[:, 0]]
    return jnp.take_along_axis(leaf, index.reshape(len(index), *[1] * (leaf.ndim - 2), -1), axis=0)


def _prior_rows(plan: Plan, scene: Scene, z: Array) -> list[Array]:
    rows = []
    first = jax.tree.map(lambda leaf: leaf[..., 0], scene)
    for slot, piece, share in zip(plan.slots, split(plan.slots, z), plan.priors, strict=True):
        if slot.prior is not None:
            value = jax.vmap(slot.kind.value, (-1, None), -1)(piece, reference(slot, first))
            value = value.reshape(-1, z.shape[1])
            mean, deviation = (jnp.asarray(p, z.dtype)[:, None] for p in (slot.prior.mean, slot.prior.deviation))
            rows.append(share * (value - mean) / deviation)
    return rows


def linearised(plan: Plan, z: Array, data: Data) -> tuple[Array, Array, State]:
    """Residuals (m, R, S), their Jacobian (m, n, R, S), and the motions of the first few records and starts.

    At z (n, R, S), R records and S starts, by forward mode. Motions are states (steps + 1, ..., R, S).

    The n directions are lanes of the last axis too, each with its own copy of the state: slightly slower to run than
    one shared state, but much faster to trace.
    """
    n, R, S = z.shape
    wide = jnp.broadcast_to(z[:, None], (n, n, R, S)).reshape(n, -1)
    unit = jnp.broadcast_to(jnp.eye(n, dtype=z.dtype)[:, :, None, None], (n, n, R, S)).reshape(n, -1)
    spread_out = _spread(data, n, S)
    value, slope, states = jax.jvp(lambda z: _simulated(plan, z, spread_out), (wide,), (unit,), has_aux=True)
    few = (..., 0, *map(slice, (SHOWN_RECORDS, SHOWN_STARTS)))
    some = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], n, R, S)[few], states)
    return value.reshape(-1, n, R, S)[:, 0], slope.reshape(-1, n, R, S), everywhere(some)


def residuals_of(plan: Plan, z: Array, data: Data) -> Array:
    """Residuals (m, R, S) at z (n, R, S), without derivatives; differentiable in both modes."""
    n, R, S = z.shape
    return _simulated(plan, z.reshape(n, -1), _spread(data, 1, S))[0].reshape(-1, R, S)


def _versions(fn: Callable) -> tuple[Callable, ...]:
    """Two versions of `fn`: compiled as soon as possible, and compiled to run fast."""
    return tuple(uncollected(compiled(options, "plan")(fn)) for options in (QUICK, LASTING))


LINEARISE, EVALUATE = map(_versions, (linearised, residuals_of))


def linearise(plan: Plan, z: Array, data: Data) -> tuple[Array, Array, State]:
    """`linearised`, compiled as suits its amount of work."""
    return LINEARISE[_is_much(z, data)](plan, z, data)


def evaluate(plan: Plan, z: Array, data: Data) -> Array:
    """`residuals_of`, likewise."""
    return EVALUATE[_is_much(z, data)](plan, z, data)


def _is_much(z: Array, data: Data) -> bool:
    """Whether the simulation in the directions of all z takes longer than its compilation, or is for a GPU."""
    return not on_cpu() or z.size * len(data.lengths) * work(data.scene.world) > LITTLE_WORK


def _spread(data: Data, copies: int, starts: int) -> Data:
    """Spread arrays of R records over the lanes (copies, R, starts); those that all records share stay as they are."""

    def spread(leaf: Array) -> Array:
        if leaf.ndim == 0 or leaf.shape[-1] == 1:
            return leaf
        wide = jnp.broadcast_to(leaf[..., None, :, None], (*leaf.shape[:-1], copies, leaf.shape[-1], starts))
        return wide.reshape(*leaf.shape[:-1], -1)

    return jax.tree.map(spread, data)
