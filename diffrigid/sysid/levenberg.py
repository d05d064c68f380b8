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

from diffrigid.sysid.problem import Group, linearise

STIFF = 1e7  # a damping at which no step is taken any more
SMALL = 1e-9  # a decrease still to be had, relative to the cost of one residual, that is nothing


class Numbers(NamedTuple):
    """z of a number of starts S."""

    shared: Array  # (a, S)
    own: Array  # (b, R, S)

    def of(self, members: Sequence[int]) -> Array:
        """All numbers of some records, (a + b, R of them, S)."""
        own = self.own[:, jnp.asarray(members)]
        shared = jnp.broadcast_to(self.shared[:, None], (self.shared.shape[0], *own.shape[1:]))
        return jnp.concatenate([shared, own])


class Point(NamedTuple):
    """Residuals and Jacobians at z, one of each for every group."""

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
    """Where the starts are after some iterations."""

    point: Point
    cost: Array  # (S)
    damping: Array  # (S)
    done: Array  # (S) bool: nothing more to gain


def point_at(groups: Sequence[Group], z: Numbers) -> Point:
    """Residuals and Jacobians of all groups."""
    pairs = [linearise(group.plan, z.of(group.members), group.data) for group in groups]
    return Point(z, tuple(r for r, _ in pairs), tuple(j for _, j in pairs))


@partial(jax.jit, static_argnames="loss")
def cost_of(loss: Any, residuals: tuple[Array, ...]) -> Array:
    """Sum of the loss over all residuals, (S); inf where one is not finite."""
    total = sum(loss.rho(r).sum((0, 1)) for r in residuals)
    return jnp.where(jnp.isfinite(total), total, jnp.inf)


def arrow(loss: Any, point: Point, members: tuple[tuple[int, ...], ...]) -> Arrow:
    """Normal equations at a point, each residual weighted as the loss asks."""
    a, count = point.z.shared.shape[0], point.z.own.shape[1]
    rows, pulls = [], []
    for r, jac in zip(point.residuals, point.jacobians, strict=True):
        ok = jnp.isfinite(jac).all((0, 1)) & jnp.isfinite(r).all(0)
        r, jac = _choose(ok, r, jnp.zeros_like(r)), _choose(ok, jac, jnp.zeros_like(jac))
        weighted = jac * loss.weight(r)[:, None]
        rows.append(jnp.einsum("mirs,mjrs->srij", weighted, jac))
        pulls.append(jnp.einsum("mirs,mrs->sri", weighted, r))
    order = np.argsort(np.concatenate([np.asarray(m) for m in members]))
    H, g = jnp.concatenate(rows, 1), jnp.concatenate(pulls, 1)
    if not np.array_equal(order, np.arange(count)):
        H, g = H[:, order], g[:, order]
    return Arrow(H[..., :a, :a].sum(1), H[..., :a, a:], H[..., a:, a:], g[..., :a].sum(1), g[..., a:])


def eliminate(eq: Arrow) -> tuple[Array, Array, Array]:
    """What is left for the shared numbers, (S, a, a) and (S, a), and D^-1 (B^T | h), (S, R, b, a + 1)."""
    if eq.h.shape[-1] == 0:
        return eq.A, eq.g, jnp.zeros((*eq.h.shape[:2], 0, eq.g.shape[-1] + 1), eq.g.dtype)
    right = jnp.concatenate([jnp.swapaxes(eq.B, -1, -2), eq.h[..., None]], axis=-1)
    solved = jnp.linalg.solve(eq.D, right)
    taken = jnp.einsum("srab,srbc->sac", eq.B, solved)
    return eq.A - taken[..., :-1], eq.g - taken[..., -1], solved


def solve(eq: Arrow) -> tuple[Array, Array]:
    """The step that the normal equations ask for: of the shared numbers (S, a), and of each record's (S, R, b)."""
    matrix, right, solved = eliminate(eq)
    a = eq.g.shape[-1]
    shared = -jnp.linalg.solve(matrix, right[..., None])[..., 0] if a else right
    own = -solved[..., -1] - jnp.einsum("srba,sa->srb", solved[..., :-1], shared)
    return shared, own


def damped(eq: Arrow, damping: Array, held: Array) -> Arrow:
    """With the diagonal enlarged, and shared numbers (a,) that are held left where they are."""
    free = 1.0 - held
    A = eq.A * (free[:, None] * free[None])[None] + jnp.diag(held)[None]
    B = eq.B * free[None, None, :, None]

    def enlarged(block: Array, damping: Array) -> Array:
        scale = jnp.maximum(jnp.diagonal(block, axis1=-2, axis2=-1), 1e-12)
        unit = jnp.eye(block.shape[-1], dtype=block.dtype).reshape((1,) * (block.ndim - 2) + block.shape[-2:])
        return block + (damping * scale)[..., None] * unit

    A, D = enlarged(A, damping[:, None]), enlarged(eq.D, damping[:, None, None])
    return Arrow(A, B, D, eq.g * free[None], eq.h)


@partial(jax.jit, static_argnames=("loss", "members"))
def update(
    loss: Any, members: tuple[tuple[int, ...], ...], progress: Progress, trial: Point, reach: Numbers
) -> tuple[Progress, Numbers]:
    """Per start, the trial if it costs less, else the old point with more damping; and what to try next."""
    new_cost = cost_of(loss, trial.residuals)
    better = new_cost < progress.cost
    point = jax.tree.map(lambda old, new: _choose(better, new, old), progress.point, trial)
    cost = jnp.where(better, new_cost, progress.cost)
    damping = jnp.clip(progress.damping * jnp.where(better, 0.2, 4.0), 1e-9, 1e9)
    eq = damped(arrow(loss, point, members), damping, (reach.shared[:, 0] == 0).astype(cost.dtype))
    shared, own = solve(eq)
    gain = -0.5 * ((eq.g * shared).sum(-1) + (eq.h * own).sum((-1, -2)))
    rows = sum(r.shape[0] * r.shape[1] for r in point.residuals)
    done = (gain < SMALL * cost / rows) | (damping > STIFF) | ~jnp.isfinite(cost)
    step = Numbers(shared.T, jnp.transpose(own, (2, 1, 0)))
    step = jax.tree.map(lambda dz, most: jnp.clip(jnp.where(jnp.isfinite(dz), dz, 0.0), -most, most), step, reach)
    return Progress(point, cost, damping, done), jax.tree.map(jnp.add, point.z, step)


def _choose(better: Array, new: Array, old: Array) -> Array:
    """By start, the last axis."""
    return jnp.where(better.reshape((1,) * (new.ndim - better.ndim) + better.shape), new, old)


def levenberg(
    groups: Sequence[Group], z: Numbers, loss: Any, iterations: int, reach: Numbers,
    report: Callable[[int, np.ndarray], None],
) -> tuple[Point, bool]:  # fmt: skip
    """The lowest points found from the starts z, and whether the user interrupted.

    Starts whose residuals are not finite stay where they are, at infinite cost. Ends when no start has anything to
    gain any more.

    Args:
        reach: the longest step of each number, (a, 1) and (b, 1, 1); a shared number of which it is 0 is held.
    """
    members = tuple(group.members for group in groups)
    trial = point_at(groups, z)
    starts = jnp.zeros_like(z.own, shape=z.own.shape[-1:])
    progress = Progress(trial, starts + jnp.inf, starts + 5e-2, starts > 0)
    try:
        for count in range(iterations + 1):
            progress, z = update(loss, members, progress, trial, reach)
            report(count, np.asarray(progress.cost))
            if count == iterations or bool(progress.done.all()):
                break
            trial = point_at(groups, z)
    except KeyboardInterrupt:
        return progress.point, True
    return progress.point, False
