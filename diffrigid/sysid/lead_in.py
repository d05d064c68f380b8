"""Windows that grow from the start of each record, for fits that end in a local minimum.

Where a first guess strikes another corner, or another body, than the measured motion did, all that follows is wrong,
and a fit of the whole record ends there. Up to the first impacts a record is easily fitted, and each window begins
where the last one ended.
"""

import jax
import numpy as np

from diffrigid.branches import choose
from diffrigid.sysid.diagnosis import RARE, whiteness
from diffrigid.sysid.levenberg import Point, cost_of
from diffrigid.sysid.losses import Loss
from diffrigid.sysid.points import by_column
from diffrigid.sysid.setup import Problem

PARTS = 8  # windows of a record
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


def growing(problem: Problem) -> list[float]:
    """Windows [s] up to the whole of the longest record, which is inf."""
    longest = max(float(series.t[-1]) - run.start for run in problem.runs for series in run.series)
    return [*(longest * np.arange(1, PARTS) / PARTS), np.inf]


def better(loss: Loss, first: Point, second: Point) -> Point:
    """Of each start the point with the lower cost."""
    return _chosen(cost_of(loss, first.residuals) <= cost_of(loss, second.residuals), first, second)


_chosen = jax.jit(choose)
