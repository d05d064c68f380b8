"""What the data cannot determine, in words, and whether residuals look like noise."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffrigid.sysid.covariance import ROUNDING, SAME_EFFECT, TINY, Linear, eliminated
from diffrigid.sysid.free import Free

NEGLIGIBLE = 0.05  # [-] parts of a direction below this share of its largest are rounding, each as large as its effect
LARGE = 1.0  # standard deviation, in the scale of a parameter (a factor e, or its size), that hardly determines it
RARE = 1e-3  # chance below which residuals are not taken for noise
LAGS = 5  # largest lag of the autocorrelation of residuals
SAME_POWER = 0.02  # [-] changes or exponents that differ by less are taken as equal
TOO_LARGE, TOO_SMALL = 1.2, 0.5  # [-] of the noise that was given: residuals beyond these are reported
ANY_FACTOR = 20.0  # standard deviation of a logarithm beyond which the factor is not quoted


@dataclass(frozen=True)
class Coordinate:
    """The parameter that one number of z belongs to."""

    name: str
    path: str
    logarithmic: bool  # z is the logarithm of the parameter
    bounded: bool  # on both sides
    scale: float  # a large change


@dataclass(frozen=True)
class Blind:
    """Numbers that can change together without any effect on what was measured."""

    direction: np.ndarray  # (n,) of z
    names: tuple[str, ...]
    words: str


def coordinates(slots: Sequence, references: Sequence[np.ndarray]) -> list[Coordinate]:
    """Coordinates of all numbers of z, in order."""
    out = []
    for slot, reference in zip(slots, references, strict=True):
        bounded = isinstance(slot.kind, Free) and bool(np.isfinite(slot.kind.high))
        log = isinstance(slot.kind, Free) and slot.kind.low == 0 and not bounded
        sizes = slot.kind.scale(reference)
        shape = np.shape(reference) if np.size(reference) == slot.size else (slot.size,)  # of charts: that of z
        for k, index in enumerate(np.ndindex(shape)):
            name = slot.name if slot.size == 1 else f"{slot.name}[{', '.join(map(str, index))}]"
            out.append(Coordinate(name, slot.name, log, bounded, float(sizes[k])))
    return out


def blind_directions(linear: Linear, coordinates: Sequence[Coordinate]) -> list[Blind]:
    """Directions of z, of shared numbers and those of the first record, that nothing measured depends on.

    The columns of the Jacobian are scaled to length one; a direction in which they cancel is not determined.
    """
    J = _first_record(linear, len(coordinates))
    sizes = np.sqrt((J**2).sum(0))
    top = max(sizes.max(), TINY)
    unseen = sizes < ROUNDING * top
    out = []
    for path in dict.fromkeys(c.path for c in coordinates):
        mine = np.array([c.path == path for c in coordinates])
        if (unseen & mine).any():
            names = [c.name for c, off in zip(coordinates, unseen & mine, strict=True) if off]
            label = path if unseen[mine].all() else ", ".join(names)
            words = f"nothing that was measured depends on {label}"
            if path.endswith("friction"):
                words += ": at the best fit nothing slips, so that any larger value fits as well"
            out.append(Blind((unseen & mine).astype(float), (path,), words))
    seen = np.flatnonzero(~unseen)
    scaled = J[:, seen] / sizes[seen]
    values, vectors = np.linalg.eigh(scaled.T @ scaled) if len(seen) else (np.zeros(0), np.zeros((0, 0)))
    for vector in reduced(vectors[:, values < SAME_EFFECT * values.max(initial=TINY)].T):
        direction = np.zeros(len(coordinates))
        kept = np.abs(vector) >= NEGLIGIBLE * np.abs(vector).max()
        direction[seen] = np.where(kept, vector, 0.0) / sizes[seen]
        out.append(_blind(direction, coordinates))
    return out


def reduced(rows: np.ndarray) -> np.ndarray:
    """Reduce the rows (k, n) to another basis of their span: each has a number that is 1 there and 0 in the others.

    Unrelated directions, which an eigenvector may mix, are separated. Source: Gauss-Jordan elimination with complete
    pivoting.
    """
    rows, left = rows.copy(), list(range(len(rows)))
    while left:
        k, pivot = np.unravel_index(np.abs(rows[left]).argmax(), rows[left].shape)
        k = left.pop(k)
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, pivot], rows[k])
    return rows


def _first_record(linear: Linear, numbers: int) -> np.ndarray:
    """Jacobian with respect to the shared numbers and those of the first record, with the rows of all records.

    The own numbers of the other records are projected out of their rows.
    """
    others = [eliminated(linear, k)[0] for k in range(1, len(linear.rows))]
    wide = [np.concatenate([rest, np.zeros((len(rest), numbers - linear.shared))], axis=1) for rest in others]
    return np.concatenate([linear.slopes[0], *wide])


def _blind(direction: np.ndarray, coordinates: Sequence[Coordinate]) -> Blind:
    parts = [(c, v) for c, v in zip(coordinates, direction, strict=True) if v != 0]
    names = tuple(dict.fromkeys(c.path for c, _ in parts))
    return Blind(direction, names, _words(parts))


def _words(parts: Sequence[tuple[Coordinate, float]]) -> str:
    """Describe what is determined of a few numbers that change together, and what is not."""
    names = [c.name for c, _ in parts]
    steps = np.array([v for _, v in parts])
    steps = steps / steps[np.argmax(np.abs(steps))]
    if len(parts) == 1:
        return f"nothing that was measured depends on {names[0]}"
    scales = steps[[c.name.endswith((".inertia[0]", ".inertia[1]", ".inertia[2]")) for c, _ in parts]]
    # see `charts.inertia`
    if len(scales) == 3 and len({c.path for c, _ in parts}) == 1 and np.ptp(scales) < SAME_POWER:
        return f"only the ratios of {parts[0][0].path} are seen: all times one factor is the same motion"
    if all(c.logarithmic for c, _ in parts):
        if len(parts) == 2:
            power = steps[0] / steps[1]  # a^p with b^1 move together: a / b^p is seen
            if abs(power) < 1.0 - SAME_POWER:
                names, power = names[::-1], 1 / power
            exponent = "" if abs(abs(power) - 1) < SAME_POWER else f"^{abs(power):.3g}"
            what = "ratio" if power > 0 and not exponent else "product" if not exponent else "combination"
            return f"only the {what} {names[0]} {'/' if power > 0 else '*'} {names[1]}{exponent} is seen"
        if np.all(np.abs(steps - 1) < SAME_POWER):
            return f"only the ratios of {', '.join(names)} are seen: all times one factor is the same motion"
    changes = ", ".join(
        f"{c.name} {s:+.2g}{' (relative)' if c.logarithmic else ''}" for (c, _), s in zip(parts, steps, strict=True)
    )
    return f"these change together without effect: {changes}"


def weak(covariance: np.ndarray, coordinates: Sequence[Coordinate], ended: Collection[str] = ()) -> list[str]:
    """Notes on shared parameters that the data barely determine, but for those that ended at a bound."""
    notes = []
    for c, s in zip(coordinates, np.sqrt(np.diag(covariance)), strict=True):
        if not LARGE * c.scale < s < np.inf or c.path in ended:
            continue
        factor = f"a factor {np.exp(s):.2g}" if s < ANY_FACTOR else "any factor"
        known = f"known to {factor if c.logarithmic else f'+- {s:.2g}'}"
        wide = "its interval is as wide as its bounds let it be; dr.profile shows whether a side of it is excluded"
        words = wide if c.bounded else known
        notes.append(f"{c.name} is hardly seen: {words}")
    return notes


def correlations(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix (n, n); rows of numbers without variance are zero."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(deviation > 0, deviation, np.inf)
    return covariance / safe / safe[:, None]


# ---- residuals


def whiteness(series: Sequence[np.ndarray]) -> float:
    """Chance (p-value) of autocorrelations as large as those of the residuals in independent noise.

    The autocorrelations of n numbers are normal with variance 1 / n about 0; those over 5 lags are summed, over all
    series. One-sided: errors of a model make neighbours similar, while the fitted numbers make them slightly
    dissimilar, so that many short series of noise are not doubted. NaN is left out of the products.
    """
    total, count = 0.0, 0
    for r in series:
        n = int(np.isfinite(r).sum())
        if n > 3 * LAGS and np.nanmax(np.abs(r)) > 0:
            r = np.nan_to_num(r)
            total += np.sqrt(n) * sum((r[k:] * r[:-k]).sum() for k in range(1, LAGS + 1)) / (r**2).sum()
            count += LAGS
    return 1.0 if count == 0 else 0.5 * math.erfc(total / math.sqrt(2.0 * count))


def normality(r: np.ndarray) -> float:
    """Chance (p-value) of such skewness and kurtosis in normal noise. Source: Jarque and Bera 1987."""
    r = r[np.isfinite(r)]
    if len(r) < 20 or np.std(r) == 0:
        return 1.0
    u = (r - r.mean()) / r.std()
    statistic = len(r) / 6 * ((u**3).mean() ** 2 + 0.25 * ((u**4).mean() - 3.0) ** 2)
    return float(np.exp(-0.5 * statistic))  # chi^2 with two degrees of freedom


def doubts(series: Sequence[np.ndarray], robust: bool = False) -> list[str]:
    """Reasons to doubt intervals that take residuals as independent normal noise; empty if there are none.

    Args:
        series: residuals in standard deviations, one array a component of a column, in order of time.
        robust: do not ask whether they are normal: the loss gives the tails less weight, or units are in doubt.
    """
    out = []
    if (p := whiteness(series)) < RARE:
        out.append(
            f"residuals are autocorrelated (p = {p:.1g}), so intervals are too narrow: the model misses something, or "
            "the fit is in a local minimum (compare starts=16, or windows that end between impacts)"
        )
    joined = np.concatenate([np.zeros(0), *(r[np.isfinite(r)] for r in series)])
    if not robust and (p := normality(joined)) < RARE:
        out.append(f"residuals are not normal (p = {p:.1g}): huber() or student() would give the tails less weight")
    return out


def misjudged(columns: Mapping[str, np.ndarray], expected: float) -> list[str]:
    """Remark on columns whose residuals are not as large as the noise that was given for them.

    A mean square of n residuals varies by sqrt(2 / n): what three times that explains is not reported.

    Args:
        columns: residuals of each by its name, in standard deviations as given.
        expected: mean square that they should have.
    """
    words = []
    for name, r in columns.items():
        square, chance = float(np.mean(r**2)) / expected, 3.0 * np.sqrt(2.0 / len(r))
        if square > max(TOO_LARGE**2, 1.0 + chance) or square < min(TOO_SMALL**2, 1.0 - chance):
            words.append(f"{np.sqrt(square):.2g} times the noise that was given for {name}")
    return [f"residuals are {', '.join(words)}"] if words else []


def infinite_where_blind(covariance: np.ndarray, blind: Sequence[Blind], numbers: slice) -> np.ndarray:
    """Covariance of some numbers of z, with infinite variance for those of an undetermined direction."""
    parts = np.zeros(len(covariance), bool)
    for b in blind:
        parts |= b.direction[numbers] != 0
    covariance = covariance.copy()
    covariance[parts, parts] = np.inf
    return covariance
