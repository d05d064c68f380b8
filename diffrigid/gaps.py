"""Gaps between the parts of two convex shapes, for many poses at once. NumPy.

A shape is the hull of its corners, rounded. Its parts are corners, sides (in 3D edges; of a disc or sphere one, without
length), and in 3D faces.
"""

from typing import NamedTuple

import numpy as np


class Convex(NamedTuple):
    """R shapes of one kind, in body axes from the centres of their bodies; a half space has no corners."""

    corners: np.ndarray | None  # (R, V, D) [m]
    normal: np.ndarray | None  # (R, D) of a half space
    rounding: np.ndarray  # (R,) [m]; of a half space its offset
    sides: tuple  # pairs of corners
    faces: tuple  # triples of corners, counter-clockwise from outside
    size: np.ndarray  # (R,) [m] radius that encloses it

    def take(self, rows: np.ndarray) -> "Convex":
        """Select some rows."""
        return self._replace(
            corners=None if self.corners is None else self.corners[rows],
            normal=None if self.normal is None else self.normal[rows],
            rounding=self.rounding[rows], size=self.size[rows],
        )  # fmt: skip


OVER = 1e-8  # [-] of an edge: a corner that is no further beside a face is over it

Pose = tuple[np.ndarray, np.ndarray]


def gaps(a: Convex, pose_a: Pose, b: Convex, pose_b: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Signed gaps (M, C) [m] and points (M, C, D) of C candidates for a contact, M poses."""
    if a.corners is None:
        return gaps(b, pose_b, a, pose_a)
    corners_a = placed(a.corners, pose_a)
    if b.corners is None:
        return _on_plane(a, corners_a, b, pose_b)
    corners_b = placed(b.corners, pose_b)
    if a.corners.shape[2] == 2:
        found = [(b, _on_sides(corners_a, corners_b, b.sides)), (a, _on_sides(corners_b, corners_a, a.sides))]
    else:
        crossing, foot, top = _crossing(corners_a, a.sides, corners_b, b.sides)
        if a.faces and b.faces:  # else the cores do not enter each other
            inside = _inside(foot, corners_a, a.faces, _inside(top, corners_b, b.faces, np.full(crossing.shape, True)))
            crossing = np.where(inside, -crossing, crossing)
        found = [(b, (crossing, foot, top))]
        found += [(b, _on_faces(corners_a, corners_b, b.faces))] if b.faces else []
        found += [(a, _on_faces(corners_b, corners_a, a.faces))] if a.faces else []
    rounding, parts = (a.rounding + b.rounding)[:, None], []
    for owner, (gap, foot, top) in found:
        share = np.minimum(owner.rounding[:, None] / np.maximum(np.abs(gap), 1e-12), 1.0)
        parts.append((gap - rounding, foot + share[..., None] * (top - foot)))
    gap, point = (np.concatenate(both, axis=1) for both in zip(*parts, strict=True))
    return gap, point


def parting_normals(a: Convex, pose_a: Pose, b: Convex, pose_b: Pose) -> np.ndarray:
    """Normal of the side or face, of either, that the other is most beyond: (M, D), from b to a; zero if none."""
    corners_a, corners_b = (side.corners if side.corners is None else placed(side.corners, pose)
                            for side, pose in ((a, pose_a), (b, pose_b)))  # fmt: skip
    best, found = np.full(len(pose_a[0]), -np.inf), np.zeros_like(pose_a[0])
    for own, of, others, sign in ((corners_b, b, corners_a, 1.0), (corners_a, a, corners_b, -1.0)):
        if own is None or others is None or len(of.faces or of.sides) < 3:
            continue
        on, normals = _outward(own, of)
        apart = ((others[:, :, None] - on[:, None]) * normals[:, None]).sum(3).min(1)
        face = apart.argmax(1)[:, None]
        most = np.take_along_axis(apart, face, 1)[:, 0]
        normal = sign * np.take_along_axis(normals, face[..., None], 1)[:, 0]
        found = np.where((most > best)[:, None], normal, found)
        best = np.maximum(best, most)
    return found


def _outward(corners: np.ndarray, shape: Convex) -> tuple[np.ndarray, np.ndarray]:
    """A point on each side, in 3D each face, and its unit normal (M, F, D)."""
    if corners.shape[2] == 3:
        (on, *_), normals = _planes(corners, shape.faces)
        return on, normals
    start, end = (corners[:, [side[n] for side in shape.sides]] for n in (0, 1))
    normals = np.stack([end[..., 1] - start[..., 1], start[..., 0] - end[..., 0]], axis=-1)
    return start, normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)


def placed(points: np.ndarray, pose: Pose) -> np.ndarray:
    """Points (M, V, D) of bodies at poses (M, D), (M, Q), in the world."""
    return pose[0][:, None] + rotated(pose[1][:, None], points)


def rotated(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Vectors (..., D) from body to world axes; q (..., Q) and r broadcast."""
    if q.shape[-1] == 2:
        c, s, x, y = q[..., 0], q[..., 1], r[..., 0], r[..., 1]
        return np.stack([c * x - s * y, s * x + c * y], axis=-1)
    t = 2.0 * np.cross(q[..., 1:], r)
    return r + q[..., :1] * t + np.cross(q[..., 1:], t)


def _on_plane(a: Convex, corners: np.ndarray, b: Convex, pose: Pose):
    assert b.normal is not None
    normal = rotated(pose[1], b.normal)
    gap = ((corners - pose[0][:, None]) * normal[:, None]).sum(2) - (b.rounding + a.rounding)[:, None]
    return gap, corners - (gap + a.rounding[:, None])[..., None] * normal[:, None]


def _on_sides(corners: np.ndarray, others: np.ndarray, sides: tuple):
    """For each corner and the nearest side of the other in 2D: signed distance (M, V), foot on the side, corner."""
    start, end = (others[:, [side[n] for side in sides]] for n in (0, 1))
    along = (end - start)[:, None]
    to = corners[:, :, None] - start[:, None]
    share = np.clip((to * along).sum(3) / np.maximum((along**2).sum(3), 1e-30), 0.0, 1.0)
    foot = start[:, None] + share[..., None] * along
    distance = np.linalg.norm(corners[:, :, None] - foot, axis=3)
    nearest = distance.argmin(2)[..., None]
    inside = (along[..., 0] * to[..., 1] > along[..., 1] * to[..., 0]).all(2) & (len(sides) > 2)
    gap = np.take_along_axis(distance, nearest, 2)[..., 0] * np.where(inside, -1.0, 1.0)
    return gap, np.take_along_axis(foot, nearest[..., None], 2)[:, :, 0], corners


def _on_faces(corners: np.ndarray, others: np.ndarray, faces: tuple):
    """As `_on_sides` for each corner and the nearest face that it is over in 3D; infinite distance if over none."""
    (p, r, s), normal = _planes(others, faces)
    height = ((corners[:, :, None] - p[:, None]) * normal[:, None]).sum(3)
    foot = corners[:, :, None] - height[..., None] * normal[:, None]
    over = np.ones(height.shape, bool)
    for one, two in ((p, r), (r, s), (s, p)):
        inward = np.cross(normal, two - one)
        beside = -OVER * ((two - one) ** 2).sum(2)[:, None]
        over &= ((foot - one[:, None]) * inward[:, None]).sum(3) >= beside
    # Inside, the face that is least deep; outside, the one it stands over.
    inside = (height < 0).all(2, keepdims=True)
    gap = np.where(over & (inside | (height >= 0)), np.abs(height), np.inf)
    nearest = gap.argmin(2)[..., None]
    least = np.take_along_axis(gap, nearest, 2)[..., 0] * np.where(inside[..., 0], -1.0, 1.0)
    return least, np.take_along_axis(foot, nearest[..., None], 2)[:, :, 0], corners


def _planes(corners: np.ndarray, faces: tuple) -> tuple[list[np.ndarray], np.ndarray]:
    """Corners of faces (M, F, 3), three for each, and their normals (M, F, 3)."""
    p, r, s = (corners[:, [face[n] for face in faces]] for n in range(3))
    normal = np.cross(r - p, s - p)
    return [p, r, s], normal / np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-30)


def _inside(points: np.ndarray, corners: np.ndarray, faces: tuple, asked: np.ndarray) -> np.ndarray:
    """Whether points (M, C, 3) are inside a shape, bool (M, C); False where not `asked` (M, C)."""
    row, column = np.nonzero(asked)
    (on, *_), normal = _planes(corners, faces)
    height = ((points[row, column][:, None] - on[row]) * normal[row]).sum(2)
    inside = np.zeros_like(asked)
    inside[row, column] = (height < 0).all(1)
    return inside


def _crossing(corners_a: np.ndarray, sides_a: tuple, corners_b: np.ndarray, sides_b: tuple):
    """For every two edges in 3D: distance (M, E F), and the nearest points on b and on a."""
    (p, d), (r, e) = ((c[:, [s[0] for s in sides]], c[:, [s[1] for s in sides]] - c[:, [s[0] for s in sides]])
                      for c, sides in ((corners_a, sides_a), (corners_b, sides_b)))  # fmt: skip
    p, d, r, e = p[:, :, None], d[:, :, None], r[:, None], e[:, None]
    dd, ee, de = (d * d).sum(3), (e * e).sum(3), (d * e).sum(3)
    between = p - r
    dp, ep = (d * between).sum(3), (e * between).sum(3)
    det = dd * ee - de**2
    s = np.clip(np.where(det > 1e-12 * dd * ee, (de * ep - ee * dp) / np.maximum(det, 1e-30), 0.5), 0, 1)
    u = np.clip((de * s + ep) / np.maximum(ee, 1e-30), 0, 1)
    s = np.clip((de * u - dp) / np.maximum(dd, 1e-30), 0, 1)
    top, foot = p + s[..., None] * d, r + u[..., None] * e
    shape = (len(corners_a), len(sides_a) * len(sides_b), 3)
    return np.linalg.norm(top - foot, axis=3).reshape(shape[:2]), foot.reshape(shape), top.reshape(shape)
