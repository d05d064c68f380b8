"""Poses in files, in NumPy: x (3,) [m] and R (3, 3), from the axes of a frame to those of its parent."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


class Frame(NamedTuple):
    """Pose of a frame in its parent."""

    x: np.ndarray = np.zeros(3)
    R: np.ndarray = np.eye(3)

    def __matmul__(self, inner: "Frame") -> "Frame":
        """Pose in the parent of this frame of an `inner` one, given in this frame."""
        return Frame(self.x + self.R @ inner.x, self.R @ inner.R)


def about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about an axis of any length."""
    return Rotation.from_rotvec(angle * np.asarray(axis, float) / np.linalg.norm(axis)).as_matrix()


def from_quaternion(q: np.ndarray) -> np.ndarray:
    """Rotation of q = (w, x, y, z), of any length."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def to_quaternion(R: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z), w >= 0."""
    return np.roll(Rotation.from_matrix(R).as_quat(canonical=True), 1)


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
