"""Checks of shapes given by users: each message names the leaf, what was expected, and the fix."""

import math

import numpy as np

from diffrigid.convert import TYPED, largest, numbers
from diffrigid.hull import FLAT, extent, faces_problem, first, hull_problem, triples
from diffrigid.pytree import map_arrays, refuse_missing
from diffrigid.shapes import (
    SHAPES,
    Box,
    Capsule,
    Disc,
    HalfSpace,
    HeightField,
    Hull,
    Polygon,
    Profile,
    Shape,
    Sphere,
    dimension,
    floats,
    traced,
)


def check_shape(shape: Shape, where: str) -> None:
    """Raise ValueError if the shape is not valid, naming the leaf as `where.field`.

    Ranks and lengths are always checked; values only where they are concrete.
    """
    if not isinstance(shape, SHAPES):
        names = ", ".join(kind.__name__ for kind in SHAPES)
        raise ValueError(f"{where} is {shape!r}: expected one of {names}")
    refuse_missing(shape, where)

    def check(leaf, letters, path):
        _check_axes(leaf, letters, path, dimension(shape) if len(letters) == 2 else None)
        if not traced(leaf):
            value = np.asarray(leaf, floats(leaf).dtype)  # not through jax: under jit that makes a tracer
            _check_values(shape, value, path, path[len(where) + 1 :])
        return leaf

    map_arrays(check, shape, where)
    if isinstance(shape, HeightField) and shape.cells is not None:
        if not isinstance(shape.cells, int) or isinstance(shape.cells, bool) or shape.cells < 1:
            raise ValueError(f"{where}.cells is {shape.cells!r}: expected an integer above 0; leave it out")
    if isinstance(shape, Hull) and shape.faces is not None and not traced(shape.vertices):
        if problem := faces_problem(np.asarray(shape.vertices, float), triples(shape.faces)):
            raise ValueError(f"{where}.faces {problem}")


def _check_axes(leaf, letters, path, dim):
    """Raise ValueError unless the shape of `leaf` is that of `letters` in one world."""
    try:
        shape = numbers(path, leaf, None, finite=False).shape
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is {leaf!r}: expected numbers in rows of equal length") from error
    fits, expected = {
        (): (shape == (), "one number"),
        ("D",): (shape in ((2,), (3,)), "2 or 3 numbers"),
        ("V", "D"): (len(shape) == 2 and shape[-1] == dim and dim < shape[0], f"(V, {dim}) with V > {dim}"),
        ("R", "C"): (len(shape) == 2 and min(shape) > 1, "(R, C), both above 1"),
    }[letters]
    if not fits:
        raise ValueError(f"{path} has shape {shape}: expected {expected}, without batch axes")


def _check_values(shape, value, path, field):
    """Raise ValueError for the first thing that is wrong with the concrete `value` of one leaf."""
    if not np.isfinite(value).all():
        raise ValueError(f"{path} is not finite ({value}): look for a division by zero where it was made")
    size = np.abs(value) if value.ndim < 2 else np.ptp(value, axis=0)
    most = largest(value.dtype)
    if (np.abs(value) > most).any() or ((size > 0) & (size < 1 / most)).any() and not isinstance(shape, HalfSpace):
        raise ValueError(f"{path} is {value} m: its cube leaves the range of {value.dtype}; use other units")
    rule = _RULES.get((type(shape), field))
    if rule and (problem := rule(value)):
        raise ValueError(f"{path} {problem}")


def _radius_problem(value):
    if value <= 0:
        return f"is {value} m: expected above 0; for a body without geometry use None as its shape."


def _rounding_problem(value):
    if value < 0:
        return f"is {value} m: expected 0 (a thin rod) or above; give the radius without sign."


def _length_problem(value):
    if value <= 0:
        return f"is {value} m: expected above 0; a capsule without length is a Disc or a Sphere."


def _half_problem(value):
    if (value < 0).any():
        return f"is {value} m: expected 0 or above; give half of each side, without sign."
    if not value.any():
        return f"is {value} m: expected one half extent above 0; a box without any is a point."


def _normal_problem(value):
    length = math.sqrt(np.square(value, dtype=float).sum())
    if abs(length - 1) > TYPED:
        return f"has length {length:.9g}: expected a unit vector; divide it (and the offset) by its length."


def _spacing_problem(value):
    if value <= 0:
        return f"is {value} m: expected above 0; give the distance of neighbouring nodes."


def _profile_problem(value):
    if (n := first(np.diff(value[:, 0]) <= FLAT * extent(value))) is not None:
        return f"does not go to the right from point {n}: sort them by x; a steep step needs two different x."


def _polygon_problem(value):
    side = np.roll(value, -1, axis=0) - value
    if (n := first(np.linalg.norm(side, axis=1) <= FLAT * extent(value))) is not None:
        return f"repeats vertex {n}: leave out {(n + 1) % len(value)}; the last need not close the polygon."
    before = np.roll(side, 1, axis=0)
    turn = np.arctan2(before[:, 0] * side[:, 1] - before[:, 1] * side[:, 0], (before * side).sum(1))
    if (n := first(np.abs(np.sin(turn)) <= FLAT)) is not None:
        return f"has vertex {n} in line with its neighbours: leave it out."
    if turn.sum() < -FLAT:
        return "goes clockwise: reverse the order of the vertices, vertices[::-1]."
    if (n := first(turn < 0)) is not None:
        return f"is not convex at vertex {n}: split it into convex polygons, or sort the vertices by angle."
    if turn.sum() > 3 * math.pi:  # one convex round turns by 2 pi
        return "crosses itself: sort the vertices by angle about their mean."


_RULES = {  # text of what is wrong with a concrete leaf, None if nothing is
    (Disc, "radius"): _radius_problem,
    (Sphere, "radius"): _radius_problem,
    (Box, "half"): _half_problem,
    (Capsule, "radius"): _rounding_problem,
    (Capsule, "half_length"): _length_problem,
    (Polygon, "vertices"): _polygon_problem,
    (Hull, "vertices"): hull_problem,
    (HalfSpace, "normal"): _normal_problem,
    (Profile, "points"): _profile_problem,
    (HeightField, "spacing"): _spacing_problem,
}
