"""Windows that grow from the start of each record, for fits that end in a local minimum.

Where a first guess strikes another corner, or another body, than the measured motion did, all that follows is wrong,
and a fit of the whole record ends there. Up to the first impacts a record is easily fitted, and each window begins
where the last one ended. Where the columns jump in their slope, something struck: windows end just before, the first of
them at the end of the flight. One that ends just after an impact would be fitted as well by a bent flight.
"""

import itertools
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from diffrigid.branches import choose
from diffrigid.sysid.columns import Series
from diffrigid.sysid.diagnosis import RARE, whiteness
from diffrigid.sysid.levenberg import Numbers, Point, cost_of, point_at
from diffrigid.sysid.losses import Loss
from diffrigid.sysid.points import by_column
from diffrigid.sysid.problem import full_turn
from diffrigid.sysid.records import MEDIAN, Run
from diffrigid.sysid.sensors import is_turn
from diffrigid.sysid.setup import Problem, with_noise
from diffrigid.sysid.times import all_times

PARTS = 8  # windows of a record
JUMP = 5.0  # [-] standard deviations of the change of a slope by noise
TOGETHER = 2.5  # [-] times the usual interval: jumps that follow each other sooner are one
LEAST_ROWS, MANY = 8, 0.3  # rows of a column in which jumps are looked for, and share of them that are none
SUSPECT = 2.0  # [-] of the noise: residuals beyond this that are not noise suggest a local minimum


def is_suspect(problem: Problem, point: Point, loss: Loss) -> bool:
    """Whether the residuals of the best start are larger than the noise, given or guessed, and autocorrelated."""
    costs = np.asarray(cost_of(loss, point.residuals))
    if not np.isfinite(costs.min()):
        return True
    best = int(costs.argmin())
    columns = [column for record in by_column(problem, point, best) for column in record.values()]
    series = [r for column in columns for r in column.T if np.isfinite(r).any()]
    return bool(np.nanmean(np.concatenate(series) ** 2) > SUSPECT**2) and whiteness(series) < RARE


def ways_in(problem: Problem) -> list[list[Any]]:
    """Lists of growing windows [s], each for all records or (R,), the last inf.

    If the columns jump, first up to each of their jumps, then with short parts after the first; last of all evenly.
    """
    ends = [before_jumps(run) for run in problem.runs]
    longest = max(float(series.t[-1]) - run.start for run in problem.runs for series in run.series)
    evenly = [*(longest * np.arange(1, PARTS) / PARTS), np.inf]
    if not all(map(len, ends)):
        return [evenly]
    parted = [_parted(own, longest, longest / (2 * PARTS)) for own in ends]
    most = max(map(len, ends))
    chosen = np.unique(np.linspace(0, most - 1, min(most, PARTS)).round().astype(int))
    return [_of_all(ends, chosen), _of_all(parted, range(max(map(len, parted)))), evenly]


def _of_all(ends: list[np.ndarray], chosen: Iterable[int]) -> list[Any]:
    """The chosen ones of the ends of each record [s], inf where it has fewer, as windows (R,), and the whole."""
    return [*(np.array([own[k] if k < len(own) else np.inf for own in ends]) for k in chosen), np.inf]


def _parted(jumps: np.ndarray, end: float, most: float) -> np.ndarray:
    """Jumps, and between and after them times that are no more than `most` [s] apart."""
    edges = np.append(jumps, end)
    parts = [np.linspace(a, b, int(np.ceil((b - a) / most)) + 1)[:-1] for a, b in itertools.pairwise(edges) if b > a]
    return np.concatenate(parts)


def before_jumps(run: Run) -> np.ndarray:
    """Times [s] since the start of a record of the last rows before its columns jump in their slope, increasing."""
    found = np.unique(np.concatenate([np.zeros(0), *(_jumps(run, series) for series in run.series)]))
    apart = np.diff(found, prepend=-np.inf) > TOGETHER * float(np.median(np.diff(all_times(run))))
    return found[apart] - run.start


def _jumps(run: Run, series: Series) -> np.ndarray:
    """Times of the rows of a column before its slope jumps by much more than it usually does."""
    values = series.values[:, np.isfinite(series.values).any(0)]  # some components of a column may never be seen
    known = np.isfinite(values).all(1)
    t, values = series.t[known], values[known]
    if len(t) < LEAST_ROWS:
        return np.zeros(0)
    if is_turn(run.channels[series.name]):  # q and -q are one
        signs = np.where((values[1:] * values[:-1]).sum(1) < 0, -1.0, 1.0)
        values = values * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    if turn := full_turn(run, series.name):
        values = np.unwrap(values, axis=0, period=turn)
    h = np.diff(t)[:, None]
    slopes = np.diff(values, axis=0) / h
    scale = np.sqrt(h[1:] ** -2 + h[:-1] ** -2 + (1.0 / h[1:] + 1.0 / h[:-1]) ** 2)  # of the noise in their differences
    change = np.diff(slopes, axis=0) / scale
    change = np.abs(change - np.median(change, axis=0))
    rows = np.flatnonzero((change > JUMP * np.median(change, axis=0) / MEDIAN).any(1))  # row k + 1 is in the middle
    return t[rows[rows > 0]] if len(rows) < MANY * len(change) else np.zeros(0)


def unseen_until(problem: Problem, z: Numbers, window: float) -> list[int]:
    """Shared numbers that nothing before that time [s] depends on, such as a restitution: held until the first impact.

    Otherwise flights that a poor first guess bends to the floor are fitted by moving the floor.
    """
    point = point_at(with_noise(problem, problem.noise, window).groups, z)
    seen = [(np.asarray(jacobian)[:, : problem.sizes[0]] != 0).any((0, 2, 3)) for jacobian in point.jacobians]
    return np.flatnonzero(~np.any(seen, axis=0)).tolist()


def better(loss: Loss, first: Point, second: Point) -> Point:
    """Of each start the point with the lower cost."""
    return _chosen(cost_of(loss, first.residuals) <= cost_of(loss, second.residuals), first, second)


_chosen = jax.jit(choose)
