"""Profile likelihood: the lowest cost when one number is held, and the interval that follows from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from diffrigid.catalogue import component
from diffrigid.convert import at_least_one
from diffrigid.sysid.free import Free
from diffrigid.sysid.levenberg import Numbers, cost_of, levenberg
from diffrigid.sysid.parameters import pieces
from diffrigid.sysid.result import Fit, checked_fit
from diffrigid.sysid.setup import reach_of
from diffrigid.sysid.summary import Parameter

EXTENT = 1.6  # [-] of the half width of the interval from the Jacobian: extent of the profile on either side
NOT_DETERMINED = 10.0  # standard deviation of z from which on that extent is not used
FAR = 5.0  # extent in z instead: a factor e^5
FURTHER = 3  # how often that is then doubled, where the cost has not risen to the level
REFINED = 2  # how often the level is bracketed again after such steps
STEEP = 4.0  # [-] of the level: beyond it a rise is that of a cliff, which is bracketed
CLIFF = 4  # how often, at most
PROFILE_ITERATIONS = 30  # iterations for the other numbers
AT_BOUND = 15.0  # z at which a bounded number is at its bound to single precision


@dataclass(frozen=True)
class ProfileLikelihood:
    """Values of one number, and the rise of the cost at each, all other numbers fitted to it."""

    name: str
    values: np.ndarray  # (P,) increasing
    rise: np.ndarray  # (P,)
    level: float  # of the rise, at the ends of the interval
    low: float  # 95 % interval; the bound of the parameter where the rise does not reach the level
    high: float
    open: tuple[str, ...] = ()  # "below", "above": where it does not
    doubts: tuple[str, ...] = ()  # of the fit: why not to believe it

    @property
    def apart(self) -> np.ndarray:
        """Values beyond the interval whose rise is below the level too: the cost has another valley there."""
        beyond = (self.values < self.low) | (self.values > self.high)
        return self.values[beyond & (self.rise <= self.level)]

    @property
    def note(self) -> str:
        """Note for a table."""
        parts = [f"open {' and '.join(self.open)}"] if self.open else []
        if len(self.apart):
            parts.append(f"{', '.join(f'{value:.4g}' for value in self.apart[:3])} fits as well")
        return ", ".join(["profile", *parts])

    def __repr__(self) -> str:
        remarks = "; ".join((self.note, *self.doubts))
        interval = f"{self.name}: 95 % interval {self.low:.5g} to {self.high:.5g} ({remarks})"
        head = f"{'value':>12} {'rise':>12}   of the cost; at the ends of the interval {self.level:.3g}"
        rows = (f"{value:12.5g} {rise:12.4g}" for value, rise in zip(self.values, self.rise, strict=True))
        return "\n".join([interval, head, *rows])


def profile(fit: Fit, name: str, points: int = 9) -> ProfileLikelihood:
    """Profile of a shared number, or of a component, "ball.v[0]": its interval is where the cost rises by less than
    t^2 / 2.

    Unlike an interval from the Jacobian it accounts for curvature: it may be lopsided, or open. Where the rise does not
    reach that level, however far the number goes, the data give no limit and the interval ends at the bound.

    Args:
        points: an odd number of values, the fitted one in the middle; more follow where the interval is wide.

    Raises:
        ValueError: a loaded fit; no such shared number, or a whole vector; points that are even, or fewer than 3.

    Example:
        >>> curve = dr.profile(found, "restitution")
        >>> bool(curve.low < 0.8 < curve.high), curve.open  # open: where the data give no limit
        (True, ())
    """
    checked_fit(fit, "profile")
    if at_least_one("points", points) % 2 == 0 or points < 3:
        raise ValueError(f"points is {points}: expected an odd number from 3 on, the fitted value in the middle")
    kind, index = _kind_and_index(fit, name)
    quantile = fit.uncertainty.quantile
    deviation = float(np.sqrt(fit.covariance[index, index]))
    half = EXTENT * quantile * deviation if deviation < NOT_DETERMINED else FAR
    level, most = 0.5 * quantile**2, np.inf if np.isinf(kind.low) else AT_BOUND
    z = fit.shared[index] + np.linspace(-half, half, points)
    z, rise = _extended(fit, index, z, level, points // 2, most)
    ends = [_crossing(z - fit.shared[index], rise, level, side) for side in (-1, 1)]
    low, high = (float(kind.value(np.array([fit.shared[index] + end]))[0]) for end in ends)
    opened = tuple(word for word, end in zip(("below", "above"), ends, strict=True) if np.isnan(end))
    low, high = kind.low if np.isnan(low) else low, kind.high if np.isnan(high) else high
    return ProfileLikelihood(name, kind.value(z), rise, level, low, high, opened, fit.doubts)


def with_profiles(fit: Fit, profiles: Sequence[ProfileLikelihood]) -> Fit:
    """The fit with the intervals of profiles in its table, and a note on those that are open.

    Raises:
        ValueError: a loaded fit.
    """
    checked_fit(fit, "with_profiles")

    def changed(p: Parameter) -> Parameter:
        for found in profiles:
            whole, k = component(found.name)
            if p.name in (found.name, whole):
                part = f"[{k}] " if p.name == whole and k is not None else ""
                low, high = np.array(p.low, float), np.array(p.high, float)
                at = k if part else ...
                low[at], high[at] = found.low, found.high
                p = replace(p, low=low, high=high, note="; ".join(filter(None, (p.note, part + found.note))))
        return p

    return replace(fit, summary=replace(fit.summary, parameters=tuple(map(changed, fit.parameters))))


def _extended(
    fit: Fit, index: int, z: np.ndarray, level: float, count: int, most: float
) -> tuple[np.ndarray, np.ndarray]:
    """z and the rise of the cost there, extended outwards by `count` points at a time until it reaches the level.

    Args:
        most: largest |z| of the points.
    """
    middle, rise, share = z[len(z) // 2], _rises(fit, index, z), np.arange(1, count + 1) / count

    def also(new: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.concatenate([z, new]), np.concatenate([rise, _rises(fit, index, new)])

    for side in (-1, 1):
        longer = 0
        while longer < FURTHER and rise[outer := np.argmax(side * z)] <= level and (last := side * z[outer]) < most:
            z, rise = also(side * np.minimum(last + (last - side * middle) * share, most))
            longer += 1
        for k in range(CLIFF if rise[np.argmax(side * z)] > level else 0):
            below = (side * z)[(rise <= level) & (side * z >= side * middle)].max()
            above = (side * z)[(rise > level) & (side * z > below)].min()
            # Again between the points about the level: the steps were long, or the cost rises at once.
            if not (longer and k < REFINED) and rise[side * z == above].min() <= STEEP * level:
                break
            z, rise = also(side * (below + (above - below) * share[:-1]))
    z, order = np.unique(z, return_index=True)
    rise = rise[order]
    return z[np.isfinite(rise)], rise[np.isfinite(rise)]


def _kind_and_index(fit: Fit, name: str) -> tuple[Free, int]:
    """Kind of a shared number, alone or a component of a vector, and its place in z."""
    whole, k = component(name)
    for slot, rows in pieces(fit.problem.shared):
        if not isinstance(slot.kind, Free):
            continue
        if slot.name == name and slot.size == 1:
            return slot.kind, rows.start
        if slot.name == name:
            raise ValueError(f"profile: {name!r} has {slot.size} numbers: expected one of them, such as '{name}[0]'")
        if slot.name == whole and k in range(slot.size) and fit[whole].value.ndim == 1:
            return slot.kind, rows.start + k
    there = [slot.name for slot in fit.problem.shared if isinstance(slot.kind, Free)]
    raise ValueError(f"profile: no shared number {name!r}: expected one of {there}, or a component, 'ball.v[0]'")


def _rises(fit: Fit, index: int, z: np.ndarray) -> np.ndarray:
    """Rise of the cost for each held value, as many at once as the fit had starts, so that nothing is recompiled."""
    count = fit.starts.shape[1]
    reach, out = reach_of(fit.problem, [index]), []
    for first in range(0, len(z), count):
        held = np.resize(z[first : first + count], count)
        shared = np.repeat(fit.shared[:, None], count, axis=1)
        shared[index] = held
        own = np.repeat(fit.own[..., None], count, axis=-1)
        start = Numbers(*(jnp.asarray(part, fit.problem.dtype) for part in (shared, own)))
        point, _ = levenberg(fit.problem.groups, start, fit.loss, PROFILE_ITERATIONS, reach)
        out.append(np.asarray(cost_of(fit.loss, point.residuals), float))
    return np.maximum(np.concatenate(out)[: len(z)] - fit.costs[0], 0.0)


def _crossing(away: np.ndarray, rise: np.ndarray, level: float, side: int) -> float:
    """Point at which the rise reaches the level on one side of zero, NaN if nowhere; sqrt(rise) is nearly linear."""
    use = side * away >= 0
    away, rise = away[use][::side], np.sqrt(rise[use][::side])
    above = np.flatnonzero(rise > np.sqrt(level))
    if not len(above):
        return np.nan
    k = above[0]
    return float(np.interp(np.sqrt(level), rise[k - 1 : k + 1], away[k - 1 : k + 1]))
