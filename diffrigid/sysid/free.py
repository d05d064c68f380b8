"""Kinds of free parameters: the map from unbounded numbers z to a parameter, and the spread of random starts.

A kind of parameter is a frozen record with the verbs

    size(shape)               how many numbers z a parameter of this shape takes
    value(z, reference)       the parameter for z (k,); `reference` is its value at the start
    unbounded(reference)      the z whose value is the reference, pulled off its bounds
    draw(reference, random)   z of a random start
    at_bound(value)           true if a result lies on a bound
    log_volume(z, reference)  log |d value / d z|: volume of the parameter per volume of z
    check(where, value)       raises ValueError for a start that the kind does not allow
    scale(reference)          (k,) a large change of z: the measure of how well the data determine it

`each(kind)` gives every record a value of its own; `prior(kind, mean, deviation)` adds prior knowledge.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import so2, so3
from diffrigid.convert import coefficient, known_number, numbers
from diffrigid.linear import matmul

NEAR_BOUND = 1e-3  # [-] of an interval: a start on a bound is pulled off it, a result this close is reported
PULL = 1e-3  # a start on the bound of a positive parameter begins this far above it, in its unit


@dataclass(frozen=True)
class Free:
    """A free parameter: any real number, one > low, or one between low and high. `spread` is that of random starts."""

    low: float = -np.inf
    high: float = np.inf
    spread: float = 1.0

    def size(self, shape: tuple[int, ...]) -> int:
        return int(np.prod(shape))

    def value(self, z: Any, reference: Any = None) -> Any:
        """z itself, low + exp(z), or low + (high - low) / (1 + exp(-z)), in the shape of the reference."""
        z = z if reference is None else z.reshape(jnp.shape(reference))
        if np.isfinite(self.high):
            return self.low + (self.high - self.low) * (_sigmoid(z) if isinstance(z, np.ndarray) else jax.nn.sigmoid(z))
        return z if np.isinf(self.low) else self.low + (np if isinstance(z, np.ndarray) else jnp).exp(z)

    def unbounded(self, reference: np.ndarray) -> np.ndarray:
        value = np.asarray(reference, float)
        if np.isfinite(self.high):
            share = np.clip((value - self.low) / (self.high - self.low), NEAR_BOUND, 1.0 - NEAR_BOUND)
            return np.log(share / (1.0 - share)).ravel()
        if np.isinf(self.low):
            return value.ravel()
        return np.log(np.where(value > self.low, value - self.low, PULL)).ravel()

    def check(self, where: str, value: np.ndarray) -> None:
        if not ((value >= self.low) & (value <= self.high)).all():
            raise ValueError(f"{where} starts at {value}, expected from {self.low:g} to {self.high:g}: move the start")

    def draw(self, reference: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Uniform in an interval; a factor exp(spread N) about value - low if positive; normal with standard
        deviation spread * max(rms, 1) about the value if real."""
        value = np.asarray(reference, float)
        if np.isfinite(self.high):
            return self.unbounded(random.uniform(self.low, self.high, value.shape))
        return self.unbounded(value) + self.spread * self.scale(value) * random.standard_normal(value.size)

    def log_volume(self, z: Array, reference: Any = None) -> Array:
        if np.isfinite(self.high):
            return (jax.nn.log_sigmoid(z) + jax.nn.log_sigmoid(-z)).sum()
        return jnp.zeros((), z.dtype) if np.isinf(self.low) else z.sum()

    def at_bound(self, value: np.ndarray) -> bool:
        if not np.isfinite(self.high):
            return False
        edge = NEAR_BOUND * (self.high - self.low)
        return bool(np.any(value - self.low < edge) or np.any(self.high - value < edge))

    def scale(self, reference: np.ndarray) -> np.ndarray:
        value = np.asarray(reference, float)
        real = np.isinf(self.low) and np.isinf(self.high)
        rms = float(np.sqrt(np.mean(value**2))) if value.size else 1.0
        return np.full(value.size, max(rms, 1.0) if real else 1.0)


@dataclass(frozen=True)
class Chart:
    """A parameter with a condition on it, as a smooth map of z about the reference, which is at z = 0."""

    name: str
    size_of: Callable[[tuple[int, ...]], int]  # raises ValueError for a shape that the map does not take
    map: Callable[[Array, Array], Array]  # (z, reference) -> value
    spread: float  # standard deviation of the z of random starts

    def size(self, shape: tuple[int, ...]) -> int:
        return self.size_of(shape)

    def value(self, z: Array, reference: Array) -> Array:
        return self.map(z, reference)

    def check(self, where: str, value: np.ndarray) -> None:
        if not value.any():
            raise ValueError(f"{where} starts at {value}, expected a {self.name} that is not zero")

    def unbounded(self, reference: np.ndarray) -> np.ndarray:
        return np.zeros(self.size(np.shape(reference)))

    def draw(self, reference: np.ndarray, random: np.random.Generator) -> np.ndarray:
        return self.spread * random.standard_normal(self.size(np.shape(reference)))

    def log_volume(self, z: Array, reference: Array) -> Array:
        slopes = jax.jacfwd(self.map)(z, reference).reshape(-1, z.shape[0])
        return 0.5 * jnp.linalg.slogdet(matmul(slopes.T, slopes))[1]

    def at_bound(self, value: np.ndarray) -> bool:
        return False

    def scale(self, reference: np.ndarray) -> np.ndarray:
        return np.ones(self.size(np.shape(reference)))


Kind = Free | Chart


@dataclass(frozen=True)
class Each:
    """A parameter of which every record has its own value."""

    kind: Any


@dataclass(frozen=True)
class Prior:
    """A parameter with a prior: normal about `mean`, with a standard deviation, in its unit."""

    kind: Any
    mean: Any  # a number or a tuple
    deviation: Any


def interval(low: float, high: float) -> Free:
    """A parameter between two bounds.

    Example:
        >>> dr.interval(0, 2).value(np.array([-50.0, 0.0, 50.0])).round(3)  # of what is fitted, which has no bounds
        array([0., 1., 2.])
    """
    low, high = (float(known_number(f"interval: {end}", value)) for end, value in (("low", low), ("high", high)))
    if not low < high:
        raise ValueError(f"interval({low}, {high}): expected low < high")
    return Free(low=low, high=high)


def positive(spread: float = 0.5) -> Free:
    """A parameter > 0; random starts are a factor exp(spread N(0, 1)) away.

    Example:
        >>> dr.positive().value(np.array([-50.0, 0.0, 1.0])).round(3)  # exp of what is fitted
        array([0.   , 1.   , 2.718])
    """
    return Free(low=0.0, spread=_spread(spread))


def real(spread: float = 0.5) -> Free:
    """Any number; random starts are spread * max(rms, 1) N(0, 1) away.

    Example:
        >>> dr.real(spread=0.1).draw(np.array([3.0, 4.0]), np.random.default_rng(0)).round(2)  # a random start
        array([3.04, 3.95])
    """
    return Free(spread=_spread(spread))


def direction(spread: float = 0.5) -> Chart:
    """A vector of which only the direction varies, by an angle in 2D and by two in 3D: {"gravity": direction()}.

    Example:
        >>> down = dr.direction().value(jnp.array([0.3]), jnp.array([0.0, -9.81]))  # turned by 0.3 rad
        >>> round(float(jnp.hypot(*down)), 6)
        9.81
    """
    return Chart(name="direction", size_of=_direction_size, map=_turned_vector, spread=_spread(spread))


def rotation(spread: float = 0.5) -> Chart:
    """An orientation, turned by exp(z) in world axes, one angle in 2D and three in 3D: {"die.q": rotation()}.

    Example:
        >>> dr.rotation().value(jnp.array([np.pi / 2]), jnp.array([1.0, 0.0])).round(6).tolist()
        [0.0, 1.0]
    """
    return Chart(name="rotation", size_of=_rotation_size, map=_turned, spread=_spread(spread))


def inertia(spread: float = 0.3, *, principal: bool = False) -> Chart:
    """A (3, 3) inertia that remains that of a mass distribution: {"die.inertia": inertia()}.

    Args:
        principal: True: the principal axes stay as they are, as those of a body with planes of symmetry; three numbers
            instead of six.

    Example:
        >>> flat = dr.inertia(principal=True).value(jnp.array([-50.0, 0.0, 0.0]), jnp.eye(3))
        >>> flat.diagonal().round(6).tolist()  # of a plate; none can be larger than the sum of the others
        [1.0, 0.5, 0.5]
    """
    if not isinstance(principal, bool):
        raise ValueError(f"inertia: principal is {principal!r}, expected True or False")
    size_of, physical = (_moments_size, _principal_moments) if principal else (_inertia_size, _physical_inertia)
    return Chart(name="inertia", size_of=size_of, map=physical, spread=_spread(spread))


def shares(spread: float = 0.5) -> Chart:
    """Ratios of several numbers: {("cue.mass", "ball.mass"): shares()} keeps the sum of both.

    Example:
        >>> masses = dr.shares().value(jnp.array([np.log(3.0)]), jnp.array([1.0, 1.0]))  # impacts tell the ratio only
        >>> masses.round(6).tolist()
        [0.5, 1.5]
    """
    return Chart(name="shares", size_of=_shares_size, map=_same_sum, spread=_spread(spread))


def each(kind: Any) -> Each:
    """A parameter with a value of its own in each record: {"ball.v": each(real())}.

    Example:
        >>> own = {"restitution": dr.interval(0, 1), "ball.v": dr.each(dr.real())}
        >>> dr.sysid.make_problem(world, state, [measured] * 3, free=own).sizes  # shared numbers, those of each record
        (1, 2)
    """
    return Each(kind=kind)


def prior(kind: Any, mean: Any, deviation: Any) -> Prior:
    """A Gaussian prior beside the data: {"ball.mass": prior(positive(), 1.2, 0.1)}.

    Example:
        >>> dr.prior(dr.positive(), 1.2, 0.1).mean, dr.prior(dr.real(), (0.0, 1.0), 0.1).deviation
        ((1.2,), (0.1,))
    """
    means, deviations = numbers("prior: mean", mean, None).ravel(), numbers("prior: deviation", deviation, None).ravel()
    if not (deviations > 0).all():
        raise ValueError(f"prior: deviation is {deviation}, expected > 0, in the unit of the parameter")
    if not means.size or deviations.size not in (1, means.size):
        raise ValueError(
            f"prior: {means.size} means and {deviations.size} deviations, expected as many, or one for all"
        )
    return Prior(kind=kind, mean=tuple(means.tolist()), deviation=tuple(deviations.tolist()))


def _spread(spread: Any) -> float:
    """Check the spread of random starts."""
    return float(coefficient("spread", spread))


def _sigmoid(z: np.ndarray) -> np.ndarray:
    """Sigmoid in NumPy, without overflow: for the few numbers of a result, each of which JAX would compile."""
    small = np.exp(-np.abs(z))
    return np.where(z >= 0, 1.0, small) / (1.0 + small)


def _direction_size(shape: tuple[int, ...]) -> int:
    if shape not in ((2,), (3,)):
        raise ValueError(f"direction: the parameter has shape {shape}, expected a vector of 2 or 3 numbers")
    return shape[0] - 1


def _turned_vector(z: Array, reference: Array) -> Array:
    if reference.shape == (2,):
        return so2.rotate(so2.exp(z), reference)
    along = reference / jnp.sqrt((reference**2).sum())
    first, second = so3.tangents(along)
    return so3.rotate(so3.exp(z[0] * first + z[1] * second), reference)


def _rotation_size(shape: tuple[int, ...]) -> int:
    if shape not in ((2,), (4,)):
        raise ValueError(f"rotation: the parameter has shape {shape}, expected an orientation q of 2 or 4 numbers")
    return 1 if shape == (2,) else 3


def _turned(z: Array, reference: Array) -> Array:
    so = so2 if reference.shape == (2,) else so3
    return so.compose(so.exp(z), reference)


def _inertia_size(shape: tuple[int, ...]) -> int:
    if shape != (3, 3):
        raise ValueError(f"inertia: the parameter has shape {shape}, expected (3, 3); in 2D use positive()")
    return 6


def _moments_size(shape: tuple[int, ...]) -> int:
    return _inertia_size(shape) // 2


def _second_moments(inertia: Array) -> Array:
    """Second moments S = integral of r r^T dm, for which I = tr(S) 1 - S."""
    return 0.5 * jnp.trace(inertia) * jnp.eye(3, dtype=inertia.dtype) - inertia


def _inertia_of(moments: Array) -> Array:
    return jnp.trace(moments) * jnp.eye(3, dtype=moments.dtype) - moments


def _principal_moments(z: Array, reference: Array) -> Array:
    """Inertia with the second moments S along their principal axes scaled, each by exp(z)."""
    sizes, axes = jnp.linalg.eigh(_second_moments(reference))
    return _inertia_of(matmul(axes * (sizes * jnp.exp(z))[None], axes.T))


def _physical_inertia(z: Array, reference: Array) -> Array:
    """Inertia I = tr(S) 1 - S of second moments S that stay positive definite, so that I is physical.

    S = C T T^T C^T with the Cholesky factor C of that of the reference and T lower triangular, exp(z) on its diagonal.
    Source: Wensing, Kim, Slotine, Linear Matrix Inequalities for Physically Consistent Inertial Parameters, 2018.
    """
    zero = jnp.zeros_like(z[0])
    scale = jnp.exp(z[:3])
    factor = jnp.stack(
        [jnp.stack(row) for row in ([scale[0], zero, zero], [z[3], scale[1], zero], [z[4], z[5], scale[2]])]
    )
    half = matmul(jnp.linalg.cholesky(_second_moments(reference)), factor)
    return _inertia_of(matmul(half, half.T))


def _shares_size(shape: tuple[int, ...]) -> int:
    if len(shape) != 1 or shape[0] < 2:
        raise ValueError("shares: expected a tuple of two or more paths of numbers, whose sum is kept")
    return shape[0] - 1


def _same_sum(z: Array, reference: Array) -> Array:
    logs = jnp.log(reference) + jnp.concatenate([jnp.zeros_like(z[:1]), z])
    return reference.sum() * jax.nn.softmax(logs)
