"""Poses in files, in NumPy: x (3,) [m] and R (3, 3), from the axes of a frame to those of its parent."""

from typing import NamedTuple

import numpy as np


class Frame(NamedTuple):
    """Pose of a frame in its parent."""

    x: np.ndarray = np.zeros(3)
    R: np.ndarray = np.eye(3)

    def __matmul__(self, inner: "Frame") -> "Frame":
        """Pose in the parent of this frame of an `inner` one, given in this frame."""
        return Frame(self.x + self.R @ inner.x, self.R @ inner.R)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about an axis of any length. Source: Rodrigues' formula."""
    k = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def from_quaternion(q: np.ndarray) -> np.ndarray:
    """Rotation of q = (w, x, y, z), of any length."""
    s, *u = q / np.linalg.norm(q)
    x, y, z = u
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * s * cross + 2.0 * cross @ cross


def to_quaternion(R: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z), w >= 0: the eigenvector of Bar-Itzhack's matrix (2000), good for any rotation."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    return q if q[0] >= 0 else -q


def from_euler(angles: np.ndarray, sequence: str) -> np.ndarray:
    """Successive rotations about x, y, z: lower case about the rotated axes, upper case about the fixed ones."""
    R = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        turn = about(np.eye(3)["xyz".index(letter.lower())], angle)
        R = R @ turn if letter.islower() else turn @ R
    return R


def from_axes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rotation with the x axis along x, and the y axis along y made perpendicular to it."""
    x = x / np.linalg.norm(x)
    y = y - (y @ x) * x
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def onto(z: np.ndarray) -> np.ndarray:
    """Smallest rotation that takes the z axis to this direction."""
    z = z / np.linalg.norm(z)
    axis, cosine = np.cross([0.0, 0.0, 1.0], z), z[2]
    size = np.linalg.norm(axis)
    if size < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return about(axis, np.arctan2(size, cosine))
