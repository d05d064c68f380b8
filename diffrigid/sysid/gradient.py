"""Solvers by reverse mode, for many free numbers: any first-order optimiser of optax, and L-BFGS with backtracking.

A solver is a function of (groups, z, loss, iterations, reach, report) that returns the points found from the starts z,
and "", or why it ended early; `levenberg` is one too. Each start keeps the best point that it has seen.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from diffrigid.branches import choose
from diffrigid.compiling import LASTING, compiled, uncollected
from diffrigid.convert import at_least_one
from diffrigid.sysid.levenberg import INTERRUPTED, UNFINISHED, Numbers, Point, point_at
from diffrigid.sysid.losses import Loss
from diffrigid.sysid.problem import Group, Plan, residuals_of

ARMIJO = 1e-4  # [-] of the decrease predicted by the slope: what a step of L-BFGS has to achieve
HALVINGS = 20
SETTLED = 1e-4  # [-] relative decrease of the cost in the last tenth of the steps of an optimiser, at most
LBFGS_SETTLED = 1e-10  # [-] relative decrease of the cost at which it ends


def first_order(optimiser: optax.GradientTransformation, steps: int = 500) -> Callable:
    """Steps of an optimiser of optax on all starts at once: first_order(optax.adam(1e-2)).

    The number of steps is `iterations` of `fit` if given, otherwise `steps`.

    Raises:
        ValueError: steps < 1.
    """
    at_least_one("steps", steps)

    def solve(groups, z, loss, iterations, reach, report) -> tuple[Point, str]:
        state, best, move = optimiser.init(z), None, jax.jit(_as_optax_does(optimiser.update))
        most, lowest = steps if iterations is None else iterations, []
        try:
            for count in range(most):
                cost, slope = cost_and_slope(groups, z, loss)
                best = _best(best, (cost, z))
                report(count, np.asarray(best[0]))
                lowest.append(float(best[0].min()))
                change, state = move(_held(slope, reach), state, z)
                z = jax.tree.map(jnp.add, z, change)
        except KeyboardInterrupt:
            return point_at(groups, best[1] if best else z), INTERRUPTED
        best = _best(best, (cost_and_slope(groups, z, loss)[0], z))
        end = float(best[0].min())
        settled = bool(lowest) and lowest[-1 - most // 10] - end <= SETTLED * abs(end)
        return point_at(groups, best[1]), "" if settled else UNFINISHED.format(most)

    return solve


def lbfgs(steps: int = 200, memory: int = 10) -> Callable:
    """L-BFGS of optax, each start on its own, with steps halved until they gain (Armijo).

    The number of steps is at most `iterations` of `fit` if given, otherwise `steps`.

    Args:
        memory: earlier steps and gradients, of each start, from which the curvature is taken.

    Raises:
        ValueError: steps or memory < 1.
    """
    at_least_one("steps", steps)
    scale = optax.scale_by_lbfgs(memory_size=at_least_one("memory", memory))

    def solve(groups, z, loss, iterations, reach, report) -> tuple[Point, str]:
        flat, most = _flat(z), steps if iterations is None else iterations
        state = jax.vmap(scale.init)(flat)
        cost, slope = cost_and_slope(groups, z, loss)
        try:
            for count in range(most):
                report(count, np.asarray(cost))
                gradient = _flat(_held(slope, reach))
                change, state = _direction(scale, gradient, state, flat)
                flat, new, slope = _line_search(groups, z, loss, flat, -change, cost, gradient)
                ended = ~(cost - new > LBFGS_SETTLED * jnp.abs(cost))  # also one that diverged: inf - inf is NaN
                cost = new
                if bool(ended.all()):
                    break
        except KeyboardInterrupt:
            return point_at(groups, _unflat(flat, z)), INTERRUPTED
        return point_at(groups, _unflat(flat, z)), "" if bool(ended[jnp.argmin(cost)]) else UNFINISHED.format(most)

    return solve


def cost_and_slope(groups: Sequence[Group], z: Numbers, loss: Loss) -> tuple[Array, Numbers]:
    """Cost (S) and its gradient, by reverse mode."""
    total, shared, own = jnp.zeros_like(z.shared[0]), jnp.zeros_like(z.shared), jnp.zeros_like(z.own)
    for group in groups:
        cost, slope = _group_slope(group.plan, loss, z.of(group.members), group.data)
        total, shared = total + cost, shared + slope[: len(shared)].sum(1)
        own = own.at[:, jnp.asarray(group.members)].add(slope[len(shared) :])
    return jnp.where(jnp.isfinite(total), total, jnp.inf), Numbers(shared, own)


@uncollected
@compiled(LASTING, "plan", "loss")
def _group_slope(plan: Plan, loss: Loss, z: Array, data: Any) -> tuple[Array, Array]:
    def cost(z):
        by_start = loss.rho(residuals_of(plan, z, data)).sum((0, 1))
        return by_start.sum(), by_start

    (_, by_start), slope = jax.value_and_grad(cost, has_aux=True)(z)
    return by_start, jnp.where(jnp.isfinite(slope), slope, 0.0)


@partial(jax.jit, static_argnames="scale")
def _direction(scale: Any, gradient: Array, state: Any, flat: Array) -> Any:
    return jax.vmap(_as_optax_does(scale.update))(gradient, state, flat)


def _as_optax_does(fn: Callable) -> Callable:
    """Wrap a function so that it is traced with the promotion of types and ranks that optax relies on."""

    def promoting(*args: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return fn(*args)

    return promoting


def _line_search(groups, z, loss, flat: Array, direction: Array, cost: Array, gradient: Array):
    """Line search per start: the first of the steps 1, 1/2, 1/4, ... that gains enough; no step if none does."""
    slope = (direction * gradient).sum(1)
    downhill = slope < 0
    direction = jnp.where(downhill[:, None], direction, -gradient)
    slope = jnp.where(downhill, slope, -(gradient**2).sum(1))
    size, found = jnp.ones_like(cost), jnp.zeros_like(cost, bool)
    for _ in range(HALVINGS):
        trial = flat + size[:, None] * direction
        new, at = cost_and_slope(groups, _unflat(trial, z), loss)
        found = new <= cost + ARMIJO * size * slope
        if bool(found.all()):
            break
        size = jnp.where(found, size, 0.5 * size)
    if bool(found.all()):
        return trial, new, at
    flat = jnp.where(found[:, None], trial, flat)
    return flat, *cost_and_slope(groups, _unflat(flat, z), loss)


def _flat(z: Numbers) -> Array:
    """Flatten z to (S, a + b R)."""
    return jnp.concatenate([z.shared, z.own.reshape(-1, z.own.shape[-1])]).T


def _unflat(flat: Array, like: Numbers) -> Numbers:
    a = like.shared.shape[0]
    return Numbers(flat.T[:a], flat.T[a:].reshape(like.own.shape))


def _held(slope: Numbers, reach: Numbers) -> Numbers:
    return jax.tree.map(lambda g, most: jnp.where(most > 0, g, 0.0), slope, reach)


def _best(old: tuple[Array, Numbers] | None, new: tuple[Array, Numbers]) -> tuple[Array, Numbers]:
    if old is None:
        return new
    return choose(new[0] < old[0], new, old)
