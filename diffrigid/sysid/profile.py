"""Profile likelihood: the best cost when one number is held, and the interval that follows from it."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffrigid.sysid.covariance import student_quantile
from diffrigid.sysid.free import Free
from diffrigid.sysid.levenberg import Numbers, cost_of, levenberg
from diffrigid.sysid.result import Fit
from diffrigid.sysid.setup import reach_of

WIDE = 1.6  # of the half width of the interval from the Jacobian: how far the profile goes on either side


@dataclass(frozen=True)
class Profile:
    """Of one number: values, and by how much the cost rises when all others are fitted to each."""

    name: str
    values: np.ndarray  # (P,)
    rise: np.ndarray  # (P,)
    level: float  # of the rise, at the ends of the interval
    low: float  # 95 % interval; the edge of the values where the rise does not reach the level
    high: float


def profile(fit: Fit, name: str, points: int = 9) -> Profile:
    """Profile of a shared number, its interval being where the cost rises by less than t^2 / 2.

    Unlike an interval from the Jacobian it knows of curvature: it may be lopsided, or open on one side.

    Args:
        points: an odd number of values, the fitted one in the middle.
    """
    index = _index(fit, name)
    kind: Any = next(slot.kind for slot in fit.problem.shared if slot.name == name)
    quantile = student_quantile(fit.uncertainty.freedom)
    deviation = float(np.sqrt(fit.covariance[index, index]))
    half = WIDE * quantile * deviation if np.isfinite(deviation) and deviation < 10 else 5.0
    z = fit.shared[index] + np.linspace(-half, half, points)
    rise = np.maximum(_costs(fit, index, z) - fit.costs[0], 0.0)
    level = 0.5 * quantile**2
    low, high = _crossing(z, rise, level, -1), _crossing(z, rise, level, 1)
    values = kind.value(np.array([*z, low, high]))
    return Profile(name, values[:-2], rise, level, float(values[-2]), float(values[-1]))


def _index(fit: Fit, name: str) -> int:
    first = 0
    for slot in fit.problem.shared:
        if slot.name == name:
            if slot.size != 1 or not isinstance(slot.kind, Free):
                raise ValueError(f"profile: {name!r} is not one number; tie or fix its components first")
            return first
        first += slot.size
    raise ValueError(f"profile: no shared parameter {name!r}; there are {[slot.name for slot in fit.problem.shared]}")


def _costs(fit: Fit, index: int, z: np.ndarray) -> np.ndarray:
    """Lowest cost for each held value, as many at once as the fit had starts, so that nothing is compiled again."""
    count = fit.starts.shape[1]
    dtype = fit.problem.runs[0].state.x.dtype
    reach, out = reach_of(fit.problem, [index]), []
    for first in range(0, len(z), count):
        held = np.resize(z[first : first + count], count)
        shared = np.repeat(fit.shared[:, None], count, axis=1)
        shared[index] = held
        start = Numbers(jnp.asarray(shared, dtype), jnp.asarray(np.repeat(fit.own[..., None], count, axis=-1), dtype))
        point, _ = levenberg(fit.problem.groups, start, fit.loss, 30, reach, lambda count, costs: None)
        out.append(np.asarray(cost_of(fit.loss, point.residuals), float))
    return np.concatenate(out)[: len(z)]


def _crossing(z: np.ndarray, rise: np.ndarray, level: float, side: int) -> float:
    """Where the rise reaches the level on one side of the middle; sqrt(rise) is nearly straight."""
    middle = len(z) // 2
    z, rise = z[middle::side], np.sqrt(rise[middle::side])
    above = np.flatnonzero(rise > np.sqrt(level))
    if not len(above):
        return float(z[-1])
    k = above[0]
    return float(np.interp(np.sqrt(level), rise[k - 1 : k + 1], z[k - 1 : k + 1]))
