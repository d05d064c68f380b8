"""Faces and edges of convex hulls, from concrete corners, in NumPy. V vertices, F faces, T triangles."""

import itertools
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

FLAT = 1e-5  # of a shape's size, or rad: less than this counts as flat; above the rounding of float32

Triple = tuple[int, int, int]


def hull_faces(vertices: Any) -> tuple[Triple, ...]:
    """Triangles (i, j, k) of the surface of a convex hull, counter-clockwise seen from outside.

    Args:
        vertices: (V, 3) concrete numbers, each a corner of the hull.

    A flat face with more than three corners becomes a fan from one of them.
    """
    corners = _corners(vertices)
    if problem := hull_problem(corners):
        raise ValueError(f"this hull {problem}")
    return tuple((f[0], *pair) for f in _flat_faces(corners) for pair in itertools.pairwise(f[1:]))


def hull_edges(faces: tuple[Triple, ...], vertices: Any = None) -> tuple[tuple[int, int], ...]:
    """The distinct edges (i, j), i < j, of a closed surface of triangles, sorted.

    With concrete `vertices` (V, 3), without those between two triangles in one plane.
    """
    apex = apexes(faces)
    pairs = sorted(pair for pair in apex if pair[0] < pair[1])
    if vertices is None:
        return tuple(pairs)
    corners = _corners(vertices)
    size = extent(corners)
    return tuple((i, j) for i, j in pairs if _bend(corners, i, j, apex[i, j], apex[j, i]) > FLAT * size)


def apexes(faces: tuple[Triple, ...]) -> dict[tuple[int, int], int]:
    """The third corner of the triangle to the left of each directed side (i, j)."""
    return {side: k for i, j, k in faces for side, k in (((i, j), k), ((j, k), i), ((k, i), j))}


def _corners(vertices: Any) -> np.ndarray:
    """Concrete vertices of one hull, (V, 3) in double precision."""
    corners = np.asarray(vertices, float)
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"hull vertices have shape {corners.shape}: expected (V, 3), one hull without batch")
    return corners


def _bend(corners: np.ndarray, i: int, j: int, k: int, l: int) -> float:
    """How far two triangles (i, j, k), (j, i, l) are from one plane [m].

    Measured at the apex nearer to the edge, from the plane of the other triangle: that does not magnify the
    rounding of a thin one.
    """
    left, right = (np.cross(corners[j] - corners[i], corners[m] - corners[i]) for m in (k, l))
    volume = abs(left @ (corners[l] - corners[i]))
    return volume / max(np.linalg.norm(left), np.linalg.norm(right))


def _flat_faces(corners: np.ndarray) -> list[list[int]]:
    """Flat faces of the hull of (V, 3) corners: lists of indices, counter-clockwise seen from outside."""
    hull = ConvexHull(corners)  # of triangles, several of which may lie in one face
    normals, (a, b, c) = hull.equations[:, :3], corners[hull.simplices].transpose(1, 0, 2)
    heights = normals @ corners.T + hull.equations[:, 3:]
    found: list[list[int]] = []
    # Larger triangles first: the plane of a face is not taken from three corners almost in line.
    for n in np.argsort(-np.linalg.norm(np.cross(b - a, c - a), axis=1), kind="stable"):
        if not any(set(hull.simplices[n]) <= set(face) for face in found):
            on = np.flatnonzero(heights[n] >= -FLAT * extent(corners))
            found.append(_around(corners, on, normals[n]))
    return found


def _around(corners: np.ndarray, on: np.ndarray, normal: np.ndarray) -> list[int]:
    """The indices `on` of corners in one plane, in counter-clockwise order about its unit normal."""
    r = corners[on] - corners[on].mean(0)
    u = r[0] / np.linalg.norm(r[0])
    angle = np.arctan2(r @ np.cross(normal, u), r @ u)
    return [int(i) for i in on[np.argsort(angle)]]


# ---- what can be wrong


def hull_problem(value: np.ndarray) -> str | None:
    """Say what is wrong with the vertices (V, 3) of a hull; None: nothing."""
    value = value.astype(float)
    apart = np.linalg.norm(value[:, None] - value[None], axis=2)
    if len(twins := np.argwhere(np.triu(apart <= FLAT * extent(value), k=1))):
        return f"repeats a point, {twins[0][0]} and {twins[0][1]}: leave one out."
    if np.linalg.svd(value - value.mean(0), compute_uv=False)[-1] <= FLAT * extent(value):
        return "lies in one plane: move a point out of it, or use a Box with a zero half extent for a plate."
    faces = _flat_faces(value)
    # a corner is where three faces meet; a point in an edge has two, in a face one, inside none
    count = np.bincount(list(itertools.chain(*faces)), minlength=len(value))
    if (n := first(count < 3)) is not None:
        return f"has point {n} that is no corner of the convex hull: leave it out."
    if len(value) - sum(map(len, faces)) // 2 + len(faces) != 2:  # Euler
        return f"is flat to {FLAT:g} of its size at some edges: leave out the points that stick out least."
    return None


def faces_problem(value: np.ndarray, faces: tuple[Triple, ...]) -> str | None:
    """Say what is wrong with the faces of a hull with vertices `value` (V, 3); None: nothing."""
    if any(len(set(face)) != 3 or not set(face) <= set(range(len(value))) for face in faces):
        return f"must be triples of different indices from 0 to {len(value) - 1}."
    sides = sorted(pair for i, j, k in faces for pair in ((i, j), (j, k), (k, i)))
    if len(set(sides)) < len(sides) or sides != sorted((j, i) for i, j in sides):
        return "do not close the surface in one sense: leave them out, and they are found."
    volume, expected = _volume(value, faces), _volume(value, hull_faces(value))
    if abs(volume + expected) <= FLAT * expected:
        return "are inside out: reverse each triple, (k, j, i)."
    if abs(volume - expected) > FLAT * expected:
        return f"enclose {volume:.6g} m^3 of {expected:.6g} in the hull: leave them out, and they are found."
    return None


def _volume(corners: np.ndarray, faces: tuple[Triple, ...]) -> float:
    """Signed volume [m^3] inside a closed surface of triangles."""
    return np.linalg.det(corners[np.array(faces)] - corners.mean(0)).sum() / 6


def first(wrong: np.ndarray) -> int | None:
    """Index of the first true entry, None if there is none."""
    return int(np.argmax(wrong)) if wrong.any() else None


def extent(corners: np.ndarray) -> float:
    """Longest side [m] of the box around corners (V, D)."""
    return np.ptp(corners, axis=0).max()


def triples(faces: Any) -> tuple[Triple, ...]:
    """`faces` as a tuple of triples of int."""
    try:
        rows = np.asarray(faces)
    except ValueError:
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1] != 3 or rows.dtype.kind not in "iu":
        raise ValueError(f"Hull.faces is {faces!r}: expected triples of indices of vertices; leave it out")
    return tuple(tuple(row) for row in rows.tolist())
