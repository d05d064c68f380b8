"""Outlines of shapes: the lines that a drawing needs. NumPy."""

import numpy as np

from diffrigid.shapes import Capsule, Disc, HalfSpace, HeightField, Profile, Shape, Sphere, edges, vertices

REACH = 50.0  # [m] half width of a half space where it is not said how far it is seen


def outline(shape: Shape, dim: int, points: int = 48, reach: float = REACH):
    """Lines that draw a shape, NumPy: in 2D one closed polyline (P, 2) [m], in 3D a list of polylines (P_i, 3) [m].

    Round parts have about `points` points a turn. A half space is a segment (2, 2), or a square, that goes
    `reach` [m] to each side; a profile is its line between its ends, a height field the lines of its grid.
    """
    return _outline_2d(shape, points, reach) if dim == 2 else _outline_3d(shape, points, reach)


def _outline_2d(shape, points, reach):
    match shape:
        case Disc():
            return _circle(float(shape.radius), points)
        case Capsule():
            return _stadium(float(shape.radius), float(shape.half_length), points)
        case HalfSpace():
            normal = np.asarray(shape.normal)
            along = np.array([-normal[1], normal[0]])
            return float(shape.offset) * normal + reach * np.stack([along, -along])
        case Profile():
            return np.asarray(shape.points)
    return _closed(np.asarray(vertices(shape, 2)))


def _outline_3d(shape, points, reach):
    match shape:
        case Sphere():
            return [_raised(_circle(float(shape.radius), points), axes) for axes in ((0, 1), (1, 2), (2, 0))]
        case Capsule():
            return _capsule_lines(float(shape.radius), float(shape.half_length), points)
        case HalfSpace():
            normal = np.asarray(shape.normal)
            across = np.linalg.svd(normal[None])[2][1:]  # two unit vectors that span the surface
            square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
            return [float(shape.offset) * normal + reach * square @ across]
        case HeightField():
            grid = nodes(shape)
            return [*grid, *grid.swapaxes(0, 1)]
    corners = np.asarray(vertices(shape, 3))
    return [corners[list(pair)] for pair in edges(shape, 3)]


def nodes(shape: HeightField) -> np.ndarray:
    """Nodes of a height field in its axes, (R, C, 3) [m]."""
    z = np.asarray(shape.heights, float)
    return np.stack([*(float(shape.spacing) * np.indices(z.shape)), z], axis=2)


def _capsule_lines(r, h, points):
    """A ring at each end of the cylinder, and the two stadiums along it."""
    ring, along = _raised(_circle(r, points), (1, 2)), _stadium(r, h, points)
    end = np.array([h, 0.0, 0.0])
    return [ring - end, ring + end, _raised(along, (0, 1)), _raised(along, (0, 2))]


def _circle(r, points):
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    return _closed(r * np.stack([np.cos(turn), np.sin(turn)], axis=1))


def _stadium(r, h, points):
    turn = np.linspace(-np.pi / 2, np.pi / 2, points // 2 + 1)
    right = np.stack([h + r * np.cos(turn), r * np.sin(turn)], axis=1)
    return _closed(np.concatenate([right, -right]))


def _closed(polyline):
    return np.concatenate([polyline, polyline[:1]])


def _raised(polyline, axes):
    """Put a plane polyline (P, 2) into the plane of two of the three axes, (P, 3)."""
    raised = np.zeros((len(polyline), 3))
    raised[:, axes] = polyline
    return raised
