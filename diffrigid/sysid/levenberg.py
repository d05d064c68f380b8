"""Levenberg-Marquardt on a batch of starts at once, with Jacobians by forward mode.

Source: Levenberg 1944, Marquardt 1963; damping as in Nielsen, IMM-REP-1999-05.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class Progress(NamedTuple):
    """S starts of n parameters after some iterations."""

    z: Array  # (n, S)
    residuals: Array  # (m, S)
    jacobian: Array  # (m, n, S)
    damping: Array  # (S)
    step: Array  # (S) relative decrease of the cost at the last accepted step


@jax.jit
def cost(progress: Progress) -> Array:
    """Half the sum of squares, (S)."""
    return 0.5 * (progress.residuals**2).sum(0)


@partial(jax.jit, static_argnames="residuals", compiler_options={"xla_cpu_use_fusion_emitters": False})
def linearise(residuals: Callable, z: Array, data: Any) -> tuple[Array, Array]:
    """Residuals (m, S) and Jacobian (m, n, S) of `residuals(z, data)`, a column of each start at a time."""
    units = jnp.eye(z.shape[0], dtype=z.dtype)[:, :, None] * jnp.ones_like(z)[None]
    value, columns = jax.vmap(lambda unit: jax.jvp(lambda z: residuals(z, data), (z,), (unit,)), out_axes=(None, 1))(
        units
    )
    return value, columns


@jax.jit
def begin(z: Array, residuals: Array, jacobian: Array) -> Progress:
    """Progress before the first iteration."""
    residuals = jnp.where(jnp.isfinite(residuals), residuals, jnp.inf)
    damping = jnp.full(z.shape[1], 1e-2, z.dtype)
    return Progress(z, residuals, jnp.nan_to_num(jacobian), damping, jnp.ones_like(damping))


@jax.jit
def finished(progress: Progress) -> Array:
    """True when every start has converged."""
    return jnp.all((progress.step < 1e-10) | (progress.damping > 1e7))


@jax.jit
def propose(progress: Progress) -> Array:
    """Every start after its damped Gauss-Newton step, (n, S)."""
    jac = jnp.moveaxis(progress.jacobian, -1, 0)  # (S, m, n)
    normal = jnp.swapaxes(jac, 1, 2) @ jac
    scale = jnp.maximum(jnp.diagonal(normal, axis1=1, axis2=2), 1e-12)
    damped = (
        normal + (progress.damping[:, None] * scale)[:, :, None] * jnp.eye(normal.shape[1], dtype=normal.dtype)[None]
    )
    gradient = (jac * progress.residuals.T[:, :, None]).sum(1)
    step = -jnp.linalg.solve(damped, gradient[:, :, None])[:, :, 0].T
    return progress.z + jnp.where(jnp.isfinite(step), step, 0.0)


@jax.jit
def accept(progress: Progress, z: Array, residuals: Array, jacobian: Array) -> Progress:
    """Per start: the new point if it costs less, else the old one with more damping."""
    new = Progress(z, residuals, jacobian, progress.damping, progress.step)
    old_cost, new_cost = cost(progress), cost(new)
    finite = jnp.isfinite(new_cost) & jnp.isfinite(jacobian).all((0, 1))
    better = finite & (new_cost < old_cost)
    damping = jnp.clip(progress.damping * jnp.where(better, 0.2, 4.0), 1e-9, 1e9)
    gain = jnp.where(better, (old_cost - new_cost) / jnp.maximum(old_cost, jnp.finfo(z.dtype).tiny), progress.step)
    z, residuals, jacobian = (jnp.where(better, b, a) for a, b in zip(progress[:3], new[:3], strict=True))
    return Progress(z, residuals, jacobian, damping, gain)


def least_squares(
    residuals: Callable, z: np.ndarray, data: Any, iterations: int, report: Callable[[int, Progress], None]
) -> Progress:
    """Minimise half the sum of squares of `residuals(z, data)` (m, S) from the starts z (n, S).

    Starts whose residuals are not finite stay where they are, at infinite cost. Stops when every start has
    converged, its last step gaining less than 1e-10 of its cost or its damping at the limit.
    """
    start = jnp.asarray(z)
    progress = begin(start, *linearise(residuals, start, data))
    for count in range(iterations):
        report(count, progress)
        trial = propose(progress)
        progress = accept(progress, trial, *linearise(residuals, trial, data))
        if bool(finished(progress)):
            break
    return progress
