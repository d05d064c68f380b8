"""Noise of the columns of a fit, from its residuals, and the fit in units of another noise."""

from collections.abc import Mapping

import numpy as np

from diffrigid.sysid.covariance import LEAST_FREE, TINY, Linear, eliminated, information, inverse
from diffrigid.sysid.levenberg import Point, cost_of
from diffrigid.sysid.losses import Loss, Squares
from diffrigid.sysid.points import by_column, linear_of, row_mask
from diffrigid.sysid.records import series_of
from diffrigid.sysid.setup import Problem

LEAST_NOISE = 1e-12  # [-] of the largest value of its column: smaller noise is rounding, in double precision
FROM_MEDIAN = 1.4826  # standard deviation of normal noise over the median of its absolute values


def estimated_noise(problem: Problem, point: Point, loss: Loss) -> dict[str, float]:
    """Standard deviation of the residuals of each column whose noise is not given, at the best start.

    Each column loses as many degrees of freedom as its residuals determine numbers (the trace of its part of the hat
    matrix), so that the estimate is unbiased. With a robust loss, from the median of the absolute values.
    """
    best = int(np.argmin(np.asarray(cost_of(loss, point.residuals))))
    linear, residuals = linear_of(problem, point, best, loss, True), by_column(problem, point, best)
    lost, found = _lost(problem, linear), {}
    for name, sigma in problem.noise.items():
        free = [r[name] for run, r in zip(problem.runs, residuals, strict=True) if name in r and name not in run.noise]
        values = np.concatenate([piece[np.isfinite(piece)] for piece in free])
        share = max(1.0 - lost[name] / max(len(values), 1), LEAST_FREE)
        size = np.mean(values**2) if isinstance(loss, Squares) else (FROM_MEDIAN * np.median(np.abs(values))) ** 2
        found[name] = max(float(sigma * np.sqrt(size / share)), least_noise(problem, name)) if len(values) else sigma
    return found


def least_noise(problem: Problem, name: str) -> float:
    """Smallest noise of a column that is estimated, in its unit: rounding of the simulation."""
    values = [np.nan_to_num(series_of(run, name).values) for run in problem.runs if name in run.channels]
    size = max(float(np.abs(part).max()) for part in values)
    return max(LEAST_NOISE, 8 * float(np.finfo(problem.dtype).eps)) * (size or 1.0)


def exact_columns(problem: Problem) -> list[str]:
    """Columns whose estimated noise is rounding, as that of simulated data."""
    return [name for name, sigma in problem.noise.items() if sigma <= least_noise(problem, name)]


def _lost(problem: Problem, linear: Linear) -> dict[str, float]:
    """Number of parameters that the residuals of each column determine: the sum of their leverages."""
    lost = dict.fromkeys(problem.noise, 0.0)
    shared = inverse(information(linear))
    for group in problem.groups:
        columns = np.concatenate([np.full(w.shape[0] * w.shape[1], n) for n, w in group.data.weights.items()])
        for k, member in enumerate(group.members):
            hat = _leverages(linear, member, shared)
            names = columns[row_mask(problem, group, k, len(columns))[0]]
            for name in lost:
                lost[name] += float(hat[: len(names)][names == name].sum())
    return lost


def _leverages(linear: Linear, record: int, shared: np.ndarray) -> np.ndarray:
    """Diagonal of J (J^T J)^-1 J^T for the rows of a record, (m,)."""
    J = eliminated(linear, record)[0]
    own = linear.slopes[record][:, linear.shared :]
    hat = np.einsum("mi,ij,mj->m", J, shared, J)
    if own.shape[1]:
        basis = np.linalg.svd(own / np.maximum(np.abs(own).max(0), TINY), full_matrices=False)[0]
        hat = hat + (basis**2).sum(1)
    return hat


def rescaled(problem: Problem, point: Point, noise: Mapping[str, float]) -> Point:
    """Rescale the residuals and Jacobians of a point to another noise."""
    residuals, jacobians = [], []
    for group, r, jac in zip(problem.groups, point.residuals, point.jacobians, strict=True):
        ratios = []
        for name, w in group.data.weights.items():
            change = [
                1.0 if name in problem.runs[k].noise else problem.noise[name] / noise[name] for k in group.members
            ]
            ratios.append(np.broadcast_to(change, (w.shape[0] * w.shape[1], len(change))))
        ratio = np.concatenate(ratios)
        ratio = np.concatenate([ratio, np.ones((len(r) - len(ratio), ratio.shape[1]))]).astype(r.dtype)
        residuals.append(np.asarray(r) * ratio[:, :, None])
        jacobians.append(np.asarray(jac) * ratio[:, None, :, None])
    return Point(point.z, tuple(residuals), tuple(jacobians))


def all_noise(problem: Problem) -> dict[str, float]:
    """Noise by column: estimated, or the median of the given one."""
    noise = dict(problem.noise)
    for run in problem.runs:
        for name in run.channels:
            noise.setdefault(name, float(np.nanmedian(run.noise[name])) if name in run.noise else np.nan)
    return noise
