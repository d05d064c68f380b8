"""Volume, centre of mass and inertia of solid shapes. Letters: D space (2 or 3), V vertices, F faces."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.linear import einsum, matmul
from diffrigid.shapes import Box, Capsule, Disc, Hull, Polygon, Shape, Sphere, dimension, floats, with_topology
from diffrigid.state import rotations

_BALL = (1.0, 2.0, math.pi, 4 * math.pi / 3)  # volume of the unit ball by dimension


def volume_properties(shape: Shape, dim: int) -> tuple[Array, Array, Array]:
    """Area [m^2] or volume [m^3] (); centre of mass (D,) [m]; inertia per mass [m^2], () in 2D, (3, 3) in 3D.

    When the mass is given, `mass * gyration` is the inertia, also for a rod or plate, whose volume is zero.
    """
    if dimension(shape) not in (None, dim):
        name = type(shape).__name__
        raise ValueError(f"this {name} is {dimension(shape)}D but dim is {dim}: use a shape of {dim}D")
    volume, center, second = _moments(shape, dim)
    return volume, center, _gyration(second, dim)


def assembly_properties(
    shapes: Sequence[Shape], x: Sequence[Array], q: Sequence[Array | None], masses: Sequence[Array] | None, dim: int
) -> tuple[Array, Array, Array]:
    """Properties of several shapes as one solid, like `volume_properties`: parallel axes (Steiner).

    Args:
        x: (D,) [m] of each origin. q: (Q,) of each shape, None: unturned.
        masses: () [kg] of each; None: all have the same density.
    """
    so = rotations(dim)
    volumes, centers, seconds = [], [], []
    for shape, at, turn in zip(shapes, x, q, strict=True):
        volume, center, second = _moments(shape, dim)
        if turn is not None:
            R = jax.vmap(so.rotate, (None, 1), 1)(turn, jnp.eye(dim, dtype=center.dtype))
            center, second = matmul(R, center), matmul(matmul(R, second), R.T)
        volumes.append(volume)
        centers.append(at + center)
        seconds.append(second)
    weights = jnp.stack(volumes if masses is None else masses)
    share, places = weights / weights.sum(), jnp.stack(centers)
    center = matmul(share, places)
    away = places - center[None]
    second = einsum("p,pij->ij", share, jnp.stack(seconds)) + einsum("p,pi,pj->ij", share, away, away)
    return sum(volumes), center, _gyration(second, dim)


def _gyration(second: Array, dim: int) -> Array:
    """Inertia per mass [m^2], () or (3, 3), from the second moment per mass (D, D) [m^2]."""
    spread = (second * np.eye(dim, dtype=second.dtype)).sum()
    return spread if dim == 2 else spread * np.eye(3, dtype=second.dtype) - second


def _moments(shape, dim):
    """Volume (), centre (D,), and second moment about the centre per mass, <r r^T>, (D, D) [m^2]."""
    match shape:
        case Disc() | Sphere():
            size = floats(shape.radius)
            return _centred(_BALL[dim] * size**dim, jnp.full((dim,), size**2 / (dim + 2)))
        case Box():
            half = floats(shape.half)
            return _centred(jnp.prod(2 * half), half**2 / 3)
        case Capsule():
            return _capsule_moments(floats(shape.radius), floats(shape.half_length), dim)
        case Polygon():
            start = np.arange(len(shape.vertices))
            return _solid_moments(floats(shape.vertices), np.stack([start, np.roll(start, -1)], axis=1))
        case Hull():
            return _solid_moments(floats(shape.vertices), np.array(with_topology(shape).faces))
    raise ValueError(f"{type(shape).__name__} has no finite mass: make it Static, or give the body a thick Box")


def _centred(volume, spread):
    """Moments of a shape with its centre at the origin and mean squares of x, y, z `spread`, (D,) [m^2]."""
    return volume, jnp.zeros_like(spread), spread[:, None] * np.eye(len(spread), dtype=spread.dtype)


def _capsule_moments(r, h, dim):
    """Moments of a capsule of radius r and half length h, both () [m], in either dimension.

    A cylinder of length 2 h, whose cross-section is a ball of one dimension less, and one ball cut in two
    halves. In a ball of dimension n the mean of x_i^2 is r^2 / (n + 2), and the centroid of a half is
    2 B(n - 1) / ((n + 1) B(n)) r from the cut, with B(n) the volume of the unit ball.
    """
    ball, core = _BALL[dim] * r, 2 * _BALL[dim - 1] * h  # volumes over r^(dim - 1), which cancels in the fractions
    part = ball / (ball + core)  # fraction of the mass in the ends; finite for r = 0
    cut = 2 * _BALL[dim - 1] / ((dim + 1) * _BALL[dim]) * r
    axial = part * (h**2 + 2 * h * cut + r**2 / (dim + 2)) + (1 - part) * h**2 / 3
    lateral = part * r**2 / (dim + 2) + (1 - part) * r**2 / (dim + 1)
    return _centred((ball + core) * r ** (dim - 1), jnp.stack([axial] + [lateral] * (dim - 1)))


def _solid_moments(corners, faces):
    """Moments of a solid with corners (V, D) and faces (F, D): signed simplices, faces to an inner point.

    A simplex with one corner at the origin and the others a_1 ... a_D, with d = det(a) and s the sum of a_i,
    has volume d / D!, integral of r: d s / (D + 1)!, of r r^T: d (sum a_i a_i^T + s s^T) / (D + 2)!. In 2D
    these are the shoelace formulas. Source: Blow and Binstock, How to find the inertia tensor (2004).
    """
    dim = faces.shape[1]
    inner = corners.mean(0)  # any point will do, but a far one would lose digits
    a = corners[faces] - inner[None, None]
    det, total = jnp.linalg.det(a), a.sum(1)
    volume = det.sum() / math.factorial(dim)
    offset = matmul(det, total) / math.factorial(dim + 1) / volume
    squares = einsum("f,fci,fcj->ij", det, a, a) + einsum("f,fi,fj->ij", det, total, total)
    second = squares / math.factorial(dim + 2) / volume - jnp.outer(offset, offset)
    return volume, inner + offset, second
