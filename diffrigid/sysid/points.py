"""A point of a fit, which is on the devices, as NumPy arrays: by record and by column, without missing values."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.sysid.covariance import Linear
from diffrigid.sysid.levenberg import Point
from diffrigid.sysid.losses import Loss, Squares
from diffrigid.sysid.problem import Group, of_record
from diffrigid.sysid.records import series_of
from diffrigid.sysid.setup import Problem

LEAST_BEND = 0.05  # [-] least mean curvature of a loss, of squares 1: residuals are not blown up further


def linear_of(problem: Problem, point: Point, best: int, loss: Loss, estimated: bool) -> Linear:
    """Residuals and Jacobians of one start, record by record, without missing rows."""
    rows: list[Any] = [None] * len(problem.runs)
    for group, r, jac in zip(problem.groups, point.residuals, point.jacobians, strict=True):
        values, slopes = np.asarray(r, float)[..., best], np.asarray(jac, float)[..., best]
        for k, member in enumerate(group.members):
            use, t = row_mask(problem, group, k, len(values))
            rows[member] = (values[use, k], slopes[use][..., k], t[use])
    residuals, jacobians, times = zip(*rows, strict=True)
    residuals, variance = _as_least_squares(loss, residuals, problem.sizes[0] + problem.sizes[1] * len(rows))
    return Linear(residuals, jacobians, times, problem.sizes[0], variance, estimated)


@partial(jax.jit, static_argnames="loss")
def _slopes_of(loss: Loss, residuals: Array) -> tuple[Array, Array]:
    """First and second derivatives of the loss at each residual."""
    return jax.jvp(jax.grad(lambda r: loss.rho(r).sum()), (residuals,), (jnp.ones_like(residuals),))


def _as_least_squares(loss: Loss, residuals: tuple[np.ndarray, ...], numbers: int) -> tuple[Any, float]:
    """Pseudo-residuals with which least squares acts as the loss with these residuals, and their variance."""
    if isinstance(loss, Squares):
        return residuals, 1.0
    joined = jnp.asarray(np.concatenate(residuals))
    slopes, bends = _slopes_of(loss, joined)
    ends = np.cumsum([len(r) for r in residuals])[:-1]
    parts = tuple(np.split(np.asarray(slopes, float) / max(float(bends.mean()), LEAST_BEND), ends))
    variance = float(sum((part**2).sum() for part in parts) / max(len(joined) - numbers, 1))
    return parts, variance


def row_mask(problem: Problem, group: Group, k: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether rows of record k of a group are measured (or those of a prior), and their times (m,)."""
    use, times = [], []
    for name, weights in group.data.weights.items():
        w = of_record(weights, k)
        t = np.zeros(len(w))
        series = series_of(problem.runs[group.members[k]], name)
        t[: len(series.t)] = series.t
        use.append((w > 0).ravel())
        times.append(np.repeat(t, w.shape[1]))
    used, t = np.concatenate(use), np.concatenate(times)
    priors = rows - len(used)
    return np.concatenate([used, np.ones(priors, bool)]), np.concatenate([t, np.full(priors, np.nan)])


def by_column(problem: Problem, point: Point, best: int, in_units: bool = False) -> list[dict[str, np.ndarray]]:
    """Residuals of every record, by column, (K, size), NaN where missing; in standard deviations, or `in_units`."""
    out: list[Any] = [None] * len(problem.runs)
    for group, r in zip(problem.groups, point.residuals, strict=True):
        values = np.asarray(r, float)[..., best]
        for k, member in enumerate(group.members):
            first, found = 0, {}
            for name, weights in group.data.weights.items():
                w = of_record(weights, k)
                piece = values[first : first + w.size, k].reshape(w.shape)
                piece = np.where(w > 0, piece / (np.where(w > 0, w, 1.0) if in_units else 1.0), np.nan)
                found[name] = piece[: len(series_of(problem.runs[member], name).t)]
                first += w.size
            out[member] = found
    return out
