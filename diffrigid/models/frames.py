"""Poses in files, in NumPy: x (3,) [m] and R (3, 3), from the axes of a frame to those around it."""

from typing import NamedTuple

import numpy as np


class Frame(NamedTuple):
    """Where a frame is in another."""

    x: np.ndarray = np.zeros(3)
    R: np.ndarray = np.eye(3)

    def __matmul__(self, inner: "Frame") -> "Frame":
        """A frame inside this one, seen from around this one."""
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
    """(w, x, y, z) with w >= 0: the eigenvector of Bar-Itzhack's matrix (2000), good for any rotation."""
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
    """Turns about x, y, z one after the other: lower case about the axes as they have turned, upper case fixed ones."""
    R = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        turn = about(np.eye(3)["xyz".index(letter.lower())], angle)
        R = R @ turn if letter.islower() else turn @ R
    return R


def from_axes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x as given; y made perpendicular to it."""
    x = x / np.linalg.norm(x)
    y = y - (y @ x) * x
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def onto(z: np.ndarray) -> np.ndarray:
    """The least rotation that takes the z axis to this direction."""
    z = z / np.linalg.norm(z)
    axis, cosine = np.cross([0.0, 0.0, 1.0], z), z[2]
    size = np.linalg.norm(axis)
    if size < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return about(axis, np.arctan2(size, cosine))
