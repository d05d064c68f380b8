"""Uncertainty of fitted numbers: covariances of z by the Jacobian, by clusters of residuals, and by resampling.

Each is a function of a `Linear` and returns the `Uncertainty` of the numbers that all records share. The covariance of
a record's own numbers follows from it (`own_covariance`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

BLOCKS = 20  # pieces of time that stand for independent runs where there is only one record
LITTLE_INFORMATION = 0.01  # [-] of that in a direction: if all clusters but one have less, they do not determine it
DRAWS = 2000  # of the bootstrap
LEAST_FREE = 0.05  # [-] least share of degrees of freedom that is taken to be left
NORMAL_FREEDOM = 1e6  # degrees of freedom for which Student's distribution is the normal one
SAME_EFFECT = (
    1e-8  # [-] eigenvalue of the scaled information below which effects are the same: a correlation of 1 - 1e-8
)
ROUNDING = 1e-12  # [-] of the largest effect: a smaller one counts as none
NO_EFFECT = 1e-10  # [-] likewise of the largest singular value of a scaled Jacobian
TINY = 1e-300  # in place of a 0 in a denominator or a logarithm


@dataclass(frozen=True)
class Linear:
    """A fit linearised at its best point: residuals in standard deviations and Jacobians, record by record.

    With a robust loss the residuals are pseudo-residuals rho'(r) over the mean of rho''(r), with which least squares
    moves as the fit does. Source: Huber and Ronchetti, Robust Statistics, 2009, section 7.6.
    """

    rows: tuple[np.ndarray, ...]  # of each record, (m,) residuals, those missing left out
    slopes: tuple[np.ndarray, ...]  # of each record, (m, a + b) Jacobian
    times: tuple[np.ndarray, ...]  # of each record, (m,) [s]; NaN for a prior
    shared: int  # a
    variance: float  # of the residuals: 1, or estimated with a robust loss
    estimated: bool  # the noise comes from the residuals


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of the shared numbers, (a, a), and the degrees of freedom of Student's t for the intervals."""

    covariance: np.ndarray
    freedom: float

    @property
    def quantile(self) -> float:
        """Half width of a 95 % interval, in standard deviations."""
        return float(stdtrit(self.freedom, 0.975))


Intervals = Callable[[Linear], Uncertainty]


def check_intervals(intervals: Intervals) -> None:
    """Raise ValueError unless this can be a function that gives intervals."""
    if not callable(intervals) or isinstance(intervals, type):
        raise ValueError(f"intervals is {intervals!r}, expected from_jacobian, sandwich or bootstrap")


def from_jacobian(linear: Linear) -> Uncertainty:
    """Covariance (J^T J)^-1: right where residuals are independent and the model holds. The usual one."""
    numbers = linear.shared + sum(s.shape[1] - linear.shared for s in linear.slopes)
    freedom = max(sum(map(len, linear.rows)) - numbers, 1) if linear.estimated else NORMAL_FREEDOM
    return Uncertainty(linear.variance * inverse(information(linear)), float(freedom))


def information(linear: Linear) -> np.ndarray:
    """Information J^T J of the shared numbers, (a, a), with the own numbers of each record eliminated."""
    return np.sum(_blocks(linear)[0], axis=0)


def sandwich(linear: Linear) -> Uncertainty:
    """Covariance from the scores of records: right where the model is wrong, or residuals correlate within a record.

    Leaves out each record in turn, to first order; with one record, each of 20 pieces of its time, which is right if
    residuals of different pieces are independent; likewise where one record alone determines some number. Numbers that
    a single piece determines have the variance of `from_jacobian`. Source: jackknife of clusters, CR3 of Bell and
    McCaffrey 2002.

    Example:
        >>> careful = found.with_intervals(dr.sandwich)["restitution"]  # of one record: by pieces of its time
        >>> bool(careful.low < 0.8 < careful.high)
        True
    """
    H, pull = _clusters(linear)
    count, root = len(H), _root(np.sum(H, axis=0))
    moved = np.stack(
        [root @ _inverted(np.eye(root.shape[1]) - root.T @ h @ root) @ root.T @ p for h, p in zip(H, pull, strict=True)]
    )
    moved = moved - moved.mean(0)
    covariance = (count - 1) / count * moved.T @ moved
    return Uncertainty(covariance + linear.variance * _told_by_one(H, root), float(count - 1))


def bootstrap(linear: Linear) -> Uncertainty:
    """Spread of the fit over clusters drawn again with replacement, 2000 times, one Gauss-Newton step each.

    Example:
        >>> again = found.with_intervals(dr.bootstrap)["restitution"]  # of one record: its pieces
        >>> bool(again.low < 0.8 < again.high)
        True
    """
    H, pull = _clusters(linear)
    count, root = len(H), _root(np.sum(H, axis=0))
    times = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=DRAWS).astype(float)
    shares, pulls = (np.stack(part) for part in ([root.T @ h @ root for h in H], [root.T @ p for p in pull]))
    matrices, pulls = np.einsum("dk,kab->dab", times, shares), np.einsum("dk,ka->da", times, pulls)
    moved = np.stack([root @ _inverted(h) @ p for h, p in zip(matrices, pulls, strict=True)])
    covariance = np.atleast_2d(np.cov(moved.T)) * count / max(count - 1, 1)
    return Uncertainty(covariance + linear.variance * _told_by_one(H, root), float(count - 1))


def own_covariance(linear: Linear, record: int, shared: np.ndarray) -> np.ndarray:
    """Covariance (b, b) of a record's own numbers, given that of the shared ones."""
    return joint_covariance(linear, record, shared)[linear.shared :, linear.shared :]


def joint_covariance(linear: Linear, record: int, shared: np.ndarray) -> np.ndarray:
    """Covariance (a + b, a + b) of the shared numbers and a record's own, given that of the shared ones.

    The own numbers are those of the best fit to the shared ones, and follow them with the slope -D B^T A, where A and B
    are the Jacobians with respect to both and D = (B^T B)^-1; their own scatter is D.
    """
    shared_part, own = np.split(linear.slopes[record], [linear.shared], axis=1)
    D = inverse(own.T @ own)
    follow = np.concatenate([np.eye(linear.shared), -D @ own.T @ shared_part])
    covariance = follow @ shared @ follow.T
    covariance[linear.shared :, linear.shared :] += linear.variance * D
    return covariance


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix >= 0, scaled first so that units do not matter; 0 along what has no effect.

    Rounding gives a direction without effect a little of one, and a little of each number: its large variance would
    be theirs too.
    """
    root = _root(matrix)
    return root @ root.T


def _root(matrix: np.ndarray) -> np.ndarray:
    """R (a, rank) with R R^T the `inverse` of a matrix."""
    effects = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = np.where(effects > ROUNDING * effects.max(initial=0.0), effects, np.inf)
    sizes, vectors = np.linalg.eigh(matrix / scale / scale[:, None])
    seen = sizes > SAME_EFFECT * sizes.max(initial=TINY)
    return vectors[:, seen] / np.sqrt(sizes[seen]) / scale[:, None]


def _inverted(share: np.ndarray) -> np.ndarray:
    """Invert a share of the total information, scaled to 1 in every direction; 0 in directions with hardly any left."""
    sizes, vectors = np.linalg.eigh(share)
    left = sizes > LITTLE_INFORMATION
    return vectors[:, left] / sizes[left] @ vectors[:, left].T


def _told_by_one(H: list[np.ndarray], root: np.ndarray) -> np.ndarray:
    """Part of the inverse of the total information, in directions in which one cluster has nearly all of it."""
    out = np.zeros((len(root), len(root)))
    for h in H:
        shares, vectors = np.linalg.eigh(root.T @ h @ root)
        alone = root @ vectors[:, shares >= 1.0 - LITTLE_INFORMATION]
        out += alone @ alone.T
    return out


def _blocks(linear: Linear) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Information and score of the shared numbers for each record, with its own numbers eliminated."""
    found = [eliminated(linear, k) for k in range(len(linear.rows))]
    return [J.T @ J for J, _ in found], [-J.T @ r for J, r in found]


def _clusters(linear: Linear) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Information and score per cluster: per record, or per piece of time if there is one record, or one dominates."""
    H, pull = _blocks(linear)
    if len(H) > 1 and not _told_by_one(H, _root(np.sum(H, axis=0))).any():
        return H, pull
    H, pull = [], []
    for k, t in enumerate(linear.times):
        J, r = eliminated(linear, k)
        order = np.argsort(np.where(np.isfinite(t), t, np.nanmin(t)), kind="stable")
        pieces = np.array_split(order, min(BLOCKS, max(len(order) // 4, 2)))
        H += [J[p].T @ J[p] for p in pieces]
        pull += [-J[p].T @ r[p] for p in pieces]
    return H, pull


def eliminated(linear: Linear, record: int) -> tuple[np.ndarray, np.ndarray]:
    """Project a record's own numbers out of its Jacobian of the shared numbers (m, a) and out of its residuals (m,)."""
    J, r = linear.slopes[record], linear.rows[record]
    own = J[:, linear.shared :]
    if own.shape[1] == 0:
        return J, r
    scale = np.sqrt(np.maximum((own**2).sum(0), TINY))
    basis, sizes, _ = np.linalg.svd(own / scale, full_matrices=False)
    basis = basis[:, sizes > NO_EFFECT * max(sizes[0], TINY)]
    shared = J[:, : linear.shared]
    return shared - basis @ (basis.T @ shared), r - basis @ (basis.T @ r)
