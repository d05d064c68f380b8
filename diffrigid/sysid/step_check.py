"""Whether the steps of a fit are short enough: what it would find with steps half as long.

The change of the residuals gives that of the numbers by one Gauss-Newton step. A first look is at the first half of
the steps, each in two: as many steps as before, so that nothing is compiled for it. Only if that moves a number, or
residuals are correlated, the whole is simulated with twice as many.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffrigid.devices import everywhere
from diffrigid.forces import is_constant
from diffrigid.shapes import Disc, Sphere
from diffrigid.sysid.covariance import Linear, Uncertainty, eliminated, information, inverse
from diffrigid.sysid.intervals import coordinates_of
from diffrigid.sysid.levenberg import Numbers, Point, point_at
from diffrigid.sysid.losses import Squares
from diffrigid.sysid.noise import exact_columns
from diffrigid.sysid.parameters import pieces
from diffrigid.sysid.points import linear_of, row_mask
from diffrigid.sysid.problem import Data, Group, evaluate, make_groups
from diffrigid.sysid.setup import Problem, first_value, with_noise
from diffrigid.sysid.table import LONG
from diffrigid.tables import digits
from diffrigid.world import World

FAR = 1.0  # [-] of a standard deviation: numbers that move by more with steps half as long are doubted
LOOK = 0.3  # [-] likewise in the first half, with the deviations that it would give: more is worth the whole
LEAST = 1e-5  # [-] of a large change of a number: less does not matter, however well it is known
# [-] of the step, at most, and of a deviation: the step that is proposed has an error, of second order, below that.
SHORTER, ENOUGH = 0.25, 0.25


def too_long(
    problem: Problem, point: Point, best: int, linear: Linear, uncertainty: Uncertainty, correlated: bool
) -> list[str]:
    """Remark on the shared number that steps half as long would change most, if by more than its standard deviation.

    Args:
        correlated: residuals are, so that the whole is simulated in any case.
    """
    few = any(len(group.data.lengths) < 2 for group in problem.groups)
    if few or all(_is_exact(run.world) for run in problem.runs) or exact_columns(problem):
        return []
    scales = np.array([number.scale for number in coordinates_of(problem)[: linear.shared]])

    def in_deviations(moved: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        deviations, size = np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.abs(moved)
        where = (deviations > 0) & (size > LEAST * scales)
        return np.divide(size, deviations, out=np.zeros_like(moved), where=where)

    if not correlated and in_deviations(*_first_look(problem, point, best)).max(initial=0.0) < LOOK:
        return []
    moved = _moved(linear, _changes(problem, point, best))
    ratios = in_deviations(moved, uncertainty.covariance)
    if not ratios.max(initial=0.0) > FAR:
        return []
    worst = int(np.argmax(ratios))
    slot, rows = next((slot, rows) for slot, rows in pieces(problem.shared) if rows.start <= worst < rows.stop)
    z, about = np.asarray(point.z.shared, float)[rows, best], first_value(problem, slot)
    ends = (jnp.asarray(each, jnp.result_type(about)) for each in (z, z + moved[rows]))
    value, would_be = (np.asarray(slot.kind.value(end, about), float) for end in ends)
    part = np.unravel_index(np.argmax(np.abs(would_be - value)), value.shape)
    name = slot.name + (f"[{', '.join(map(str, part))}]" if part else "")
    change = abs(would_be[part] - value[part])
    places = digits(value[part], value[part] - change, value[part] + change, 3)
    shorter = problem.dt * min(SHORTER, float(np.sqrt(ENOUGH / ratios[worst])))
    return [
        f"{LONG}: with half of {problem.dt:.3g} s {name} would be {would_be[part]:.{places}g} instead of "
        f"{value[part]:.{places}g}, {ratios[worst]:.2g} standard deviations away: give dt={shorter:.2g}"
    ]


def _is_exact(world: World) -> bool:
    """Whether its motion does not depend on the length of the steps: round bodies in the plane, or without friction."""
    solid = [world.shapes[kind] for kind, owners in enumerate(world.owners) if min(owners) < len(world.names)]
    centred = all(offset is None for offset in world.offsets)
    smooth = not any((np.asarray(rough.friction) > 0).any() for rough in (world.bodies, world.statics))
    free = not (world.pairs or world.crowd)
    round_ones = all(isinstance(shape, Disc | Sphere) for shape in solid) and centred and (world.dim == 2 or smooth)
    return is_constant(world.forces) and not world.joints and (free or round_ones)


def _moved(linear: Linear, changes: Sequence[np.ndarray]) -> np.ndarray:
    """Change (a,) of the shared numbers by changes (m,) of the residuals of each record; 0 where not finite."""
    pull: Any = sum(eliminated(linear, k)[0].T @ change for k, change in enumerate(changes))
    moved = -inverse(information(linear)) @ pull
    return moved if np.isfinite(moved).all() else np.zeros(linear.shared)


def _first_look(problem: Problem, point: Point, best: int) -> tuple[np.ndarray, np.ndarray]:
    """Change (a,) of the shared numbers by steps half as long in the first half of the records, and the covariance that
    this half alone would give."""
    z = everywhere(Numbers(*(jnp.repeat(part[..., best : best + 1], part.shape[-1], -1) for part in point.z)))
    pairs = [_first_half(group) for group in problem.groups]
    before, after = (
        linear_of(replace(problem, groups=groups), point_at(groups, z), best, Squares(), False)
        for groups in zip(*pairs, strict=True)
    )
    seen = [k for k, rows in enumerate(before.rows) if len(rows)]
    changes = [after.rows[k] - before.rows[k] for k in seen]
    rows, slopes, times = (tuple(of[k] for k in seen) for of in (before.rows, before.slopes, before.times))
    half = replace(before, rows=rows, slopes=slopes, times=times)
    return _moved(half, changes), inverse(information(half))


def _first_half(group: Group) -> tuple[Group, Group]:
    """The group with what is measured in the first half of its steps, and the same with each of these in two."""
    data: Data = jax.tree.map(np.asarray, group.data)
    count = len(data.lengths) // 2

    def in_two(values: np.ndarray, share: float) -> np.ndarray:
        return np.concatenate([np.repeat(share * values[:count], 2, axis=0), values[2 * count :]]).astype(values.dtype)

    weights: dict[str, Any] = {}
    rows: dict[str, Any] = {}
    for name, weight in data.weights.items():
        within = data.rows[name] <= count
        rows[name] = np.where(within, 2 * data.rows[name], 0).astype(data.rows[name].dtype)
        if weight.shape[-1] == 1:  # one for all records: the shape is kept
            within = within.all(-1, keepdims=True)
        weights[name] = np.where(within[:, None], weight, 0.0).astype(weight.dtype)
    before = data._replace(weights=weights)
    controls = jax.tree.map(lambda values: in_two(values, 1.0), data.controls)
    after = before._replace(lengths=in_two(data.lengths, 0.5), rows=rows, controls=controls)
    return replace(group, data=jax.device_put(before)), replace(group, data=jax.device_put(after))


def _changes(problem: Problem, point: Point, best: int) -> list[np.ndarray]:
    """Changes (m,) of the residuals of each record by steps half as long."""
    groups = make_groups(problem.runs, problem.slots, len(problem.shared), 0.5 * problem.dt)
    halved = with_noise(replace(problem, groups=tuple(groups)), problem.noise, width=problem.width).groups
    z = Numbers(*(part[..., best : best + 1] for part in point.z))
    out: list[Any] = [None] * len(problem.runs)
    for group, other, before in zip(problem.groups, halved, point.residuals, strict=True):
        after = np.asarray(evaluate(other.plan, z.of(other.members), other.data), float)[..., 0]
        change = after - np.asarray(before, float)[..., best]
        for k, member in enumerate(group.members):
            use, _ = row_mask(problem, group, k, len(change))
            out[member] = change[use, k]
    return out
