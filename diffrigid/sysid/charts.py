"""Kinds of free parameters under a condition, such as a fixed length, kept by a smooth map of z. Verbs: see `free`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import so2, so3
from diffrigid.convert import coefficient
from diffrigid.linear import matmul
from diffrigid.sysid.free import as_given


@dataclass(frozen=True)
class Chart:
    """A parameter with a condition on it, as a smooth map of z about the reference, which is at z = 0."""

    name: str
    size: Callable[[tuple[int, ...]], int]  # raises ValueError for a shape that the map does not take
    value: Callable[[Array, Array], Array]  # (z, reference) -> value
    spread: float  # standard deviation of the z of random starts
    allows: Callable[[np.ndarray], Any]  # whether a value can be the reference
    expected: str  # of it, in words

    def check(self, where: str, value: np.ndarray) -> None:
        if not self.allows(value):
            raise ValueError(f"{where} starts at {value}, expected {self.expected}")

    def unbounded(self, reference: np.ndarray) -> np.ndarray:
        return np.zeros(self.size(np.shape(reference)))

    def draw(self, reference: np.ndarray, random: np.random.Generator) -> np.ndarray:
        return self.spread * random.standard_normal(self.size(np.shape(reference)))

    def log_volume(self, z: Array, reference: Array) -> Array:
        slopes = jax.jacfwd(self.value)(z, reference).reshape(-1, z.shape[0])
        return 0.5 * jnp.linalg.slogdet(matmul(slopes.T, slopes))[1]

    def at_bound(self, value: np.ndarray) -> bool:
        del value
        return False

    def scale(self, reference: np.ndarray) -> np.ndarray:
        return np.ones(self.size(np.shape(reference)))


def direction(spread: float = 0.5) -> Chart:
    """A vector of which only the direction varies, by an angle in 2D and by two in 3D: {"gravity": direction()}.

    Args:
        spread: [rad] standard deviation of the angles by which random starts are turned.

    Raises:
        ValueError: spread is not a number from 0 on.

    Example:
        >>> down = dr.direction().value(jnp.array([0.3]), jnp.array([0.0, -9.81]))  # turned by 0.3 rad
        >>> round(float(jnp.hypot(*down)), 6)
        9.81
    """
    spread, expected = as_given(coefficient, "spread", spread), "a direction that is not zero"
    return Chart("direction", _direction_size, _turned_vector, spread, np.any, expected)


def rotation(spread: float = 0.5) -> Chart:
    """An orientation, turned by exp(z) in world axes, one angle in 2D and three in 3D: {"die.q": rotation()}.

    Args:
        spread: [rad] standard deviation of each of the angles by which random starts are turned.

    Raises:
        ValueError: spread is not a number from 0 on.

    Example:
        >>> dr.rotation().value(jnp.array([np.pi / 2]), jnp.array([1.0, 0.0])).round(6).tolist()
        [0.0, 1.0]
    """
    spread, expected = as_given(coefficient, "spread", spread), "an orientation that is not zero"
    return Chart("rotation", _rotation_size, _turned_orientation, spread, np.any, expected)


def inertia(spread: float = 0.3, *, principal: bool = False) -> Chart:
    """A (3, 3) inertia that remains that of a mass distribution, one with thickness: {"die.inertia": inertia()}.

    Args:
        spread: [-] standard deviation of the logarithms by which random starts are scaled along each axis, and of the
            shears between them.
        principal: True: the principal axes stay as they are, as those of a body with planes of symmetry; three numbers
            instead of six, and no thickness is needed.

    Raises:
        ValueError: spread is not a number from 0 on; principal is not a bool.

    Example:
        >>> flat = dr.inertia(principal=True).value(jnp.array([-50.0, 0.0, 0.0]), jnp.eye(3))
        >>> flat.diagonal().round(6).tolist()  # of a plate; none can be larger than the sum of the others
        [1.0, 0.5, 0.5]
    """
    if not isinstance(principal, bool):
        raise ValueError(f"inertia: principal is {principal!r}, expected True or False")
    spread, expected = as_given(coefficient, "spread", spread), "that of a body with thickness; else principal=True"
    if principal:
        return Chart("inertia", _moments_size, _scaled_inertia, spread, np.any, "an inertia that is not zero")
    return Chart("inertia", _inertia_size, _physical_inertia, spread, _has_thickness, expected)


def shares(spread: float = 0.5) -> Chart:
    """Ratios of several numbers above zero: {("cue.mass", "ball.mass"): shares()} keeps the sum of both.

    Args:
        spread: [-] standard deviation of the logarithms of the ratios to the first, of random starts.

    Raises:
        ValueError: spread is not a number from 0 on.

    Example:
        >>> masses = dr.shares().value(jnp.array([np.log(3.0)]), jnp.array([1.0, 1.0]))  # impacts tell the ratio only
        >>> masses.round(6).tolist()
        [0.5, 1.5]
    """
    spread, expected = as_given(coefficient, "spread", spread), "numbers above zero, whose sum is kept"
    return Chart("shares", _shares_size, _same_sum, spread, _all_positive, expected)


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


def _turned_orientation(z: Array, reference: Array) -> Array:
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


def _has_thickness(inertia: np.ndarray) -> bool:
    """Whether the second moments are positive by more than rounding, so that they have a Cholesky factor."""
    moments = np.asarray(_second_moments(jnp.asarray(inertia)))
    return bool(np.linalg.eigvalsh(moments)[0] > 16.0 * np.finfo(moments.dtype).eps * np.trace(moments))


def _inertia_of(moments: Array) -> Array:
    return jnp.trace(moments) * jnp.eye(3, dtype=moments.dtype) - moments


def _scaled_inertia(z: Array, reference: Array) -> Array:
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


def _all_positive(value: np.ndarray) -> bool:
    return bool((value > 0).all())


def _same_sum(z: Array, reference: Array) -> Array:
    logs = jnp.log(reference) + jnp.concatenate([jnp.zeros_like(z[:1]), z])
    return reference.sum() * jax.nn.softmax(logs)
