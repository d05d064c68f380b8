"""Rotations of space: two forms of each verb, for one world and for a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffrigid import so2, so3

RANDOM = np.random.default_rng(0)
SIZES = {"vector": (3,), "quaternion": (4,), "matrix": (3, 3)}
VERBS = {
    so3.cross: ("vector", "vector"),
    so3.rotate: ("quaternion", "vector"),
    so3.unrotate: ("quaternion", "vector"),
    so3.compose: ("quaternion", "quaternion"),
    so3.exp: ("vector",),
    so3.turn_by: ("vector", "quaternion"),
    so3.turn_in_body: ("quaternion", "vector"),
    so3.matrix_product: ("matrix", "vector"),
    so3.spin: ("matrix", "quaternion", "vector"),
    so3.world_inverse: ("matrix", "quaternion"),
    so3.rate: ("vector", "quaternion"),
    so3.difference: ("quaternion", "quaternion"),
}


def some(kind):
    value = RANDOM.standard_normal(SIZES[kind])
    if kind == "quaternion":
        return value / np.linalg.norm(value)
    return value + value.T if kind == "matrix" else value


@pytest.mark.parametrize(("verb", "kinds"), VERBS.items(), ids=lambda value: getattr(value, "__name__", None))
@pytest.mark.parametrize("size", [1.0, 0.0])  # of vectors; zero is where series and roots change over
def test_one_world_is_a_batch_of_one(verb, kinds, size):
    args = [some(kind) * (size if kind == "vector" else 1.0) for kind in kinds]
    along = [some(kind) for kind in kinds]

    def with_slope(*args):
        return jax.jvp(verb, args, tuple(tangent.reshape(arg.shape) for tangent, arg in zip(along, args, strict=True)))

    alone, batch = with_slope(*args), with_slope(*(arg[..., None] for arg in args))
    assert_allclose(alone, [part[..., 0] for part in batch], rtol=1e-12, atol=1e-14)


def test_rotations_agree_with_their_matrix():
    q, r, inertia = some("quaternion"), some("vector"), some("matrix")
    R = np.stack([so3.rotate(q, unit) for unit in np.eye(3)], axis=1)
    assert_allclose(R @ R.T, np.eye(3), rtol=1e-12, atol=1e-15)
    assert_allclose(so3.unrotate(q, r), R.T @ r, rtol=1e-12, atol=1e-15)
    assert_allclose(so3.world_inverse(inertia, q), R @ inertia @ R.T, rtol=1e-12, atol=1e-14)
    assert_allclose(so3.spin(inertia, q, r), R @ inertia @ R.T @ r, rtol=1e-12, atol=1e-14)
    p = some("quaternion")
    assert_allclose(so3.rotate(so3.compose(q, p), r), R @ so3.rotate(p, r), rtol=1e-12, atol=1e-14)
    assert_allclose(so3.compose(p, so3.difference(p, q)), q, rtol=1e-12, atol=1e-14)


def test_logarithm_of_small_turns_is_exact():
    """On both sides of where it becomes a series."""
    angle = np.geomspace(1e-7, 1e-2, 41)
    r = angle * np.array([0.6, -0.48, 0.64])[:, None]
    assert_allclose(so3.log(so3.exp(jnp.asarray(r))), r, rtol=1e-14)


@pytest.mark.parametrize("so, D", [(so2, 2), (so3, 3)])
def test_mobility_is_the_velocity_at_one_arm_for_an_impulse_at_another(so, D):
    r, mid, impulse = RANDOM.normal(size=(3, D))
    inverse = np.asarray(0.7) if D == 2 else np.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 0.9]])
    expected = so.cross(so.apply(inverse, so.moment(mid, impulse)), r)
    assert_allclose(so.mobility(inverse, r, mid) @ impulse, expected, atol=1e-14)
