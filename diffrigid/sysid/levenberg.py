"""Levenberg-Marquardt on a batch of starts at once, for numbers that all records share and those of each record.

The normal equations have the shape of an arrow: blocks A of the shared numbers, D_r of those of record r, and B_r
between both. Those of the records are eliminated (Schur's complement), so that a thousand records cost a thousand small
solves and one more.

Source: Levenberg 1944, Marquardt 1963; Triggs et al., Bundle Adjustment, 2000, for the arrow.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.branches import choose
from diffrigid.compiling import QUICK, compiled
from diffrigid.linear import einsum
from diffrigid.sysid.losses import Loss
from diffrigid.sysid.problem import Group, linearise

FAINT = 1e-2  # [-] of the largest slope: a number with a smaller slope is damped as if it had this one
LEAST_DAMPING = 1e-9  # holds slopes below 3e-7 of the largest: rounding, or yielding joints
MOST_DAMPING = 1e9
LESS_DAMPING, MORE_DAMPING = 0.2, 4.0  # factors after a step that was accepted, and one that was not
STIFF = 1e7  # a damping above which a start counts as converged
NO_GAIN = 1e-9  # predicted decrease, relative to the mean cost of a residual, below which a start has converged
COST_SETTLED = 1e-8  # decrease of the cost, relative to it, below which an accepted step was the last
GAIN_SETTLED = 1e-6  # decrease predicted for the next step, relative to the cost, above which it was not
ITERATIONS = 60  # at most, unless another number is asked for
INTERRUPTED = "interrupted: the best so far"
UNFINISHED = "not converged after {} iterations: raise iterations, or start elsewhere"

Report = Callable[[int, np.ndarray], None]  # called with the number of the iteration, and the cost of every start


class Numbers(NamedTuple):
    """Unbounded numbers z of S starts."""

    shared: Array  # (a, S)
    own: Array  # (b, R, S)

    def of(self, members: Sequence[int]) -> Array:
        """All numbers of some records, (a + b, R of them, S)."""
        return _of(self, tuple(members))

    def sorted(self, order: Any) -> "Numbers":
        """Reorder the starts."""
        return _sorted(self, order)


@partial(jax.jit, static_argnames="members")
def _of(z: Numbers, members: tuple[int, ...]) -> Array:
    own = z.own[:, np.array(members)]
    shared = jnp.broadcast_to(z.shared[:, None], (z.shared.shape[0], *own.shape[1:]))
    return jnp.concatenate([shared, own])


@jax.jit
def _sorted(z: Numbers, order: Array) -> Numbers:
    return Numbers(*(leaf[..., order] for leaf in z))


class Point(NamedTuple):
    """Residuals and Jacobians at z, one of each per group."""

    z: Numbers
    residuals: tuple[Array, ...]  # (m, R, S)
    jacobians: tuple[Array, ...]  # (m, a + b, R, S)


class Arrow(NamedTuple):
    """Normal equations of S starts."""

    A: Array  # (S, a, a)
    B: Array  # (S, R, a, b)
    D: Array  # (S, R, b, b)
    g: Array  # (S, a)
    h: Array  # (S, R, b)


class Progress(NamedTuple):
    """State of the starts after some iterations."""

    point: Point
    cost: Array  # (R, S)
    damping: Array  # (R, S)
    done: Array  # (R, S) bool: nothing more to gain


def point_at(groups: Sequence[Group], z: Numbers) -> Point:
    """Residuals and Jacobians of all groups."""
    found = [linearise(group.plan, z.of(group.members), group.data) for group in groups]
    return Point(z, tuple(r for r, _, _ in found), tuple(j for _, j, _ in found))


@partial(jax.jit, static_argnames="loss")
def cost_of(loss: Loss, residuals: tuple[Array, ...]) -> Array:
    """Sum of the loss over all residuals, (S); inf where one is not finite."""
    return jnp.concatenate([_costs(loss, r) for r in residuals]).sum(0)


def _costs(loss: Loss, residuals: Array) -> Array:
    """Cost of each record of a group, (R, S)."""
    total = loss.rho(residuals).sum(0)
    return jnp.where(jnp.isfinite(total), total, jnp.inf)


def arrow(loss: Loss, point: Point, members: tuple[tuple[int, ...], ...]) -> Arrow:
    """Normal equations at a point, with the residuals weighted by the loss."""
    a = point.z.shared.shape[0]
    rows, pulls = [], []
    for r, jac in zip(point.residuals, point.jacobians, strict=True):
        ok = jnp.isfinite(jac).all((0, 1)) & jnp.isfinite(r).all(0)
        r, jac = (choose(ok, leaf, jnp.zeros_like(leaf)) for leaf in (r, jac))
        weighted = jac * loss.weight(r)[:, None]
        rows.append(einsum("mirs,mjrs->rsij", weighted, jac))
        pulls.append(einsum("mirs,mrs->rsi", weighted, r))
    H, g = (jnp.swapaxes(_in_order(members, parts), 0, 1) for parts in (rows, pulls))
    return Arrow(H[..., :a, :a].sum(1), H[..., :a, a:], H[..., a:, a:], g[..., :a].sum(1), g[..., a:])


def eliminate(eq: Arrow) -> tuple[Array, Array, Array]:
    """Schur complement for the shared numbers, (S, a, a) and (S, a), and D^-1 (B^T | h), (S, R, b, a + 1)."""
    if eq.h.shape[-1] == 0:
        return eq.A, eq.g, jnp.zeros((*eq.h.shape[:2], 0, eq.g.shape[-1] + 1), eq.g.dtype)
    right = jnp.concatenate([jnp.swapaxes(eq.B, -1, -2), eq.h[..., None]], axis=-1)
    solved = jnp.linalg.solve(eq.D, right)
    taken = einsum("srab,srbc->sac", eq.B, solved)
    return eq.A - taken[..., :-1], eq.g - taken[..., -1], solved


def solve(eq: Arrow) -> tuple[Array, Array]:
    """Solve the normal equations for the step of the shared numbers (S, a), and of those of each record (S, R, b)."""
    matrix, right, solved = eliminate(eq)
    a = eq.g.shape[-1]
    shared = -jnp.linalg.solve(matrix, right[..., None])[..., 0] if a else right
    own = -solved[..., -1] - einsum("srba,sa->srb", solved[..., :-1], shared)
    return shared, own


def damped(eq: Arrow, damping: Array, held: Array) -> Arrow:
    """Enlarge the diagonal by damping (S, R), and fix the shared numbers (a,) that are held."""
    free = 1.0 - held
    A = eq.A * (free[:, None] * free[None])[None] + jnp.diag(held)[None]
    B = eq.B * free[None, None, :, None]

    def enlarged(block: Array, damping: Array) -> Array:
        scale = jnp.diagonal(block, axis1=-2, axis2=-1)
        scale = jnp.maximum(scale, FAINT**2 * scale.max(-1, keepdims=True) + 1e-12) if scale.size else scale
        unit = jnp.eye(block.shape[-1], dtype=block.dtype).reshape((1,) * (block.ndim - 2) + block.shape[-2:])
        return block + (damping * scale)[..., None] * unit

    A, D = enlarged(A, damping.max(1)[:, None]), enlarged(eq.D, damping[:, :, None])
    return Arrow(A, B, D, eq.g * free[None], eq.h)


@compiled(QUICK, "loss", "members")
def update(
    loss: Loss, members: tuple[tuple[int, ...], ...], progress: Progress, trial: Point, reach: Numbers
) -> tuple[Progress, Numbers]:
    """Accept the trial where it costs less, otherwise keep the old point and raise the damping; also the next trial.

    A start is accepted or not as a whole; where no shared number moves, each record by itself.
    """
    held = (reach.shared[:, 0] == 0).astype(progress.cost.dtype)
    alone = held.all()
    new_cost = _in_order(members, [_costs(loss, r) for r in trial.residuals])
    whole = new_cost.sum(0) < progress.cost.sum(0)
    better = jnp.where(alone, new_cost < progress.cost, whole[None])
    point = _chosen(better, whole, trial, progress.point, members)
    cost = jnp.where(better, new_cost, progress.cost)
    before, after = (jnp.where(alone, c, c.sum(0)[None]) for c in (progress.cost, cost))
    settled = better & (before - after <= COST_SETTLED * after)
    damping = jnp.clip(progress.damping * jnp.where(better, LESS_DAMPING, MORE_DAMPING), LEAST_DAMPING, MOST_DAMPING)
    eq = damped(arrow(loss, point, members), damping.T, held)
    shared, own = solve(eq)
    gain = -0.5 * (eq.h * own).sum(-1).T
    gain = jnp.where(alone, gain, (gain.sum(0) - 0.5 * (eq.g * shared).sum(-1))[None])
    level = after / sum(len(r) for r in point.residuals)
    settled = settled & (gain <= GAIN_SETTLED * after)
    done = (gain < NO_GAIN * level) | settled | (damping > STIFF) | ~jnp.isfinite(level)
    step = Numbers(shared.T, jnp.transpose(own, (2, 1, 0)))
    step = jax.tree.map(lambda dz, most: jnp.clip(jnp.where(jnp.isfinite(dz), dz, 0.0), -most, most), step, reach)
    return Progress(point, cost, damping, done), jax.tree.map(jnp.add, point.z, step)


def _chosen(better: Array, whole: Array, new: Point, old: Point, members: tuple[tuple[int, ...], ...]) -> Point:
    """Select the new point where better (R, S), by record; its shared numbers where the whole start is, (S)."""
    rows = [better[np.asarray(group)] for group in members]
    z = Numbers(choose(whole, new.z.shared, old.z.shared), choose(better, new.z.own, old.z.own))
    r = [choose(ok, a, b) for ok, a, b in zip(rows, new.residuals, old.residuals, strict=True)]
    jac = [choose(ok, a, b) for ok, a, b in zip(rows, new.jacobians, old.jacobians, strict=True)]
    return Point(z, tuple(r), tuple(jac))


@partial(jax.jit, static_argnames=("loss", "members"))
def better_by_record(loss: Loss, members: tuple[tuple[int, ...], ...], first: Point, second: Point) -> Point:
    """Of each record and start the point with the lower cost, where no shared number differs."""
    costs = [_in_order(members, [_costs(loss, r) for r in point.residuals]) for point in (first, second)]
    lower = costs[1] < costs[0]
    return _chosen(lower, jnp.zeros_like(lower[0]), second, first, members)


def best_by_record(groups: Sequence[Group], point: Point, loss: Loss) -> np.ndarray:
    """The start with the lowest cost for each record, (R,)."""
    members = tuple(group.members for group in groups)
    return np.asarray(_in_order(members, [_costs(loss, r) for r in point.residuals])).argmin(1)


def _in_order(members: tuple[tuple[int, ...], ...], parts: Sequence[Array]) -> Array:
    """Join the rows of all groups in the order of the records."""
    joined, order = jnp.concatenate(parts), np.argsort(np.concatenate([np.asarray(m) for m in members]))
    return joined if np.array_equal(order, np.arange(len(order))) else joined[order]


def silent(count: int, costs: np.ndarray) -> None:
    """Report nothing."""


def levenberg(
    groups: Sequence[Group], z: Numbers, loss: Loss, iterations: int | None, reach: Numbers, report: Report = silent
) -> tuple[Point, str]:  # fmt: skip
    """Minimise from the starts z: the lowest points, and "", or why it ended before the best of them converged.

    Starts whose residuals are not finite stay where they are, at infinite cost. It ends when no start has anything left
    to gain.

    Args:
        reach: longest step of each number, (a, 1) and (b, 1, 1); a shared number with a reach of 0 is held.
    """
    members = tuple(group.members for group in groups)
    return minimise(partial(point_at, groups), members, z, loss, iterations, reach, report)


def minimise(
    at: Callable[[Numbers], Point], members: tuple[tuple[int, ...], ...], z: Numbers, loss: Loss,
    iterations: int | None, reach: Numbers, report: Report = silent,
) -> tuple[Point, str]:  # fmt: skip
    """`levenberg` for any residuals: `at` gives them and their Jacobians, for groups of the records `members`."""
    trial, iterations = at(z), ITERATIONS if iterations is None else iterations
    progress = Progress(trial, *_nothing_yet(z.own))
    try:
        for count in range(iterations + 1):
            progress, z = update(loss, members, progress, trial, reach)
            report(count, costs := np.asarray(progress.cost).sum(0))
            done = np.asarray(progress.done)
            if count == iterations or done.all():
                break
            trial = at(z)
    except KeyboardInterrupt:
        return progress.point, INTERRUPTED
    return progress.point, "" if done[:, costs.argmin()].all() else UNFINISHED.format(iterations)


@jax.jit
def _nothing_yet(own: Array) -> tuple[Array, Array, Array]:
    """Cost, damping and `done` of `Progress` before the first step."""
    starts = jnp.zeros(own.shape[1:], own.dtype)
    return starts + jnp.inf, starts + 5e-2, starts > 0
