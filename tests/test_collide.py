"""Every pair of the table against separating axes in NumPy: gap, normal, point, and the derivative of the gap."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import with_slopes
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid import so3
from diffrigid.collide import COLLIDERS, CONVEX_2D, CONVEX_3D
from diffrigid.collide.penetration import core_separation
from diffrigid.contact.approach import Task, polish
from diffrigid.contact.gaps import Gaps
from diffrigid.overlap import outlines, place, separation
from diffrigid.shapes import radius, with_topology
from diffrigid.state import rotations

POSES = 24
ROUNDING = 1e-9  # [m], of shapes about 1 m

SHAPES = {
    2: {
        dr.Disc: dr.Disc(radius=0.6),
        dr.Capsule: dr.Capsule(radius=0.2, half_length=0.7),
        dr.Box: dr.Box(half=(0.8, 0.3)),
        dr.Polygon: dr.Polygon(vertices=((-0.5, -0.4), (0.7, -0.6), (0.9, 0.2), (0.1, 0.8), (-0.6, 0.3))),
    },
    3: {
        dr.Sphere: dr.Sphere(radius=0.6),
        dr.Capsule: dr.Capsule(radius=0.2, half_length=0.7),
        dr.Box: dr.Box(half=(0.8, 0.3, 0.5)),
        dr.Hull: dr.Hull(vertices=((-0.6, -0.5, -0.4), (0.8, -0.3, -0.3), (-0.1, 0.9, -0.4), (0.1, 0.1, 0.8))),
    },
}
PAIRS = [(2, a, b) for a, b in itertools.combinations_with_replacement(CONVEX_2D, 2)]
PAIRS += [(3, a, b) for a, b in itertools.combinations_with_replacement(CONVEX_3D, 2)]
PAIRS += [(dim, a, dr.HalfSpace) for dim, kinds in ((2, CONVEX_2D), (3, CONVEX_3D)) for a in kinds]


def shape_of(dim, kind):
    shape = SHAPES[dim].get(kind, dr.HalfSpace(normal=(0.6, 0.8, 0.0)[:dim], offset=0.2))
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, float), with_topology(shape), is_leaf=lambda x: isinstance(x, tuple)
    )


def poses(dim, kind_a, kind_b):
    """Poses of both, (POSES, ...), and their signed distances: from 2 mm deep to far."""
    rng = np.random.default_rng(dim)
    a, b = shape_of(dim, kind_a), shape_of(dim, kind_b)
    q = rng.normal(size=(2, POSES, 2 if dim == 2 else 4))
    q /= np.linalg.norm(q, axis=2, keepdims=True)
    x = rng.normal(size=(POSES, dim))
    towards = np.array([so_rotate(dim, qb, b.normal) for qb in q[1]]) if kind_b is dr.HalfSpace else x
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    wanted, found = rng.choice([-0.002, 0.01, 0.3], POSES), np.zeros(POSES)
    for k in range(POSES):
        x[k] = 3.0 * towards[k]
        turned, other = (place(shape, np.zeros(dim), q[i, k]) for i, shape in enumerate((a, b)))
        for _ in range(60):  # the distance along a line out of a convex body rises no faster than the way
            found[k] = separation(moved(turned, x[k]), other)
            x[k] += (wanted[k] - found[k]) * towards[k]
        found[k] = separation(moved(turned, x[k]), other)
    return (a, x, q[0]), (b, np.zeros((POSES, dim)), q[1]), found


def so_rotate(dim, q, r):
    return np.asarray(rotations(dim).rotate(jnp.asarray(q), jnp.asarray(r)))


def moved(outline, x):
    return outline._replace(corners=outline.corners + x, starts=outline.starts + x)


def distance(dim, a, x_a, q_a, b, q_b):
    return separation(place(a, x_a, q_a), place(b, np.zeros(dim), q_b))


@pytest.mark.parametrize(("dim", "kind_a", "kind_b"), PAIRS, ids=lambda p: getattr(p, "__name__", f"{p}D"))
def test_pair(dim, kind_a, kind_b):
    (a, x_a, q_a), (b, x_b, q_b), expected = poses(dim, kind_a, kind_b)

    @jax.jit
    def closest(x_a, q_a, x_b, q_b):
        """The least gap of one pose, its normal and point, and how the gap moves with x_a."""

        def least(x_a):
            contacts = COLLIDERS[kind_a, kind_b](a, x_a, q_a, b, x_b, q_b)
            k = jnp.argmin(contacts.gap)
            return contacts.gap[k], (contacts.normal[k], contacts.point[k])

        (gap, rest), slope = jax.value_and_grad(least, has_aux=True)(x_a)
        return gap, *rest, slope

    gap, normal, point, slope = map(np.asarray, jax.vmap(closest)(x_a, q_a, x_b, q_b))
    assert_allclose(gap, expected, atol=ROUNDING)
    assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=ROUNDING)
    assert_allclose(slope, normal, atol=1e-7)  # the distance of convex bodies moves along their normal
    for k in range(POSES):  # moved back along the normal they touch, and at the point
        touching = distance(dim, a, x_a[k] - gap[k] * normal[k], q_a[k], b, q_b[k])
        assert_allclose(touching, 0.0, atol=ROUNDING if expected[k] > 0 else 1e-5)
        if expected[k] < 0:
            continue  # near an edge the point inside may be closer to another face
        speck = place(dr.Disc(radius=0.0) if dim == 2 else dr.Sphere(radius=0.0), point[k], q_a[k])
        assert_allclose(separation(speck, place(b, x_b[k], q_b[k])), 0.5 * gap[k], atol=1e-7)


SOLID = [(dim, a, b) for dim, a, b in PAIRS if {a, b} & {dr.Box, dr.Polygon, dr.Hull} and b is not dr.HalfSpace]
SOLID += [(2, dr.Capsule, dr.Capsule)]


@pytest.mark.parametrize(("dim", "kind_a", "kind_b"), SOLID, ids=lambda p: getattr(p, "__name__", f"{p}D"))
def test_overlapping_cores_are_as_deep_as_the_least_translation_that_parts_them(dim, kind_a, kind_b):
    (a, x_a, q_a), (b, x_b, q_b), _ = poses(dim, kind_a, kind_b)
    x_a = 0.1 * x_a
    rounding = float(radius(a) + radius(b))
    expected = np.array([distance(dim, a, x_a[k], q_a[k], b, q_b[k]) for k in range(POSES)]) + rounding
    assert (expected < 0).sum() > POSES / 2

    def cores(x_a, q_a, x_b, q_b):
        contact = core_separation(a, x_a, q_a, b, x_b, q_b)
        return contact.gap[0], contact.normal[0]

    (gap, normal), slope = jax.jit(jax.vmap(lambda *p: (cores(*p), jax.grad(lambda *p: cores(*p)[0])(*p))))(
        x_a, q_a, x_b, q_b
    )
    assert_allclose(np.minimum(gap, 0.0), np.minimum(expected, 0.0), atol=ROUNDING)
    assert_allclose(slope, normal, atol=1e-7)


@pytest.mark.parametrize("shift", [-1e-3, 1e-3])
@pytest.mark.parametrize("dim", [2, 3])
def test_capsules_that_meet_end_on_end_touch_once(dim, shift):
    """Also where one is a little beyond the end of the other: there is one contact, with or without a slip past it."""
    rod, up = shape_of(dim, dr.Capsule), jnp.eye(dim)[1]
    upright = jnp.array([0.0, 1.0] if dim == 2 else [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    x = jnp.eye(dim)[0] * (rod.half_length + shift) + up * (rod.half_length + 2 * rod.radius)
    contacts = COLLIDERS[dr.Capsule, dr.Capsule](rod, x, upright, rod, jnp.zeros(dim), jnp.eye(len(upright))[0])
    assert (contacts.gap < 1e-2).sum() == 1


@pytest.mark.parametrize(("dim", "kind"), [(dim, kind) for dim in SHAPES for kind in SHAPES[dim]])
def test_concentric_and_touching_poses_are_finite(dim, kind):
    """At the same place, and exactly face to face: values and derivatives are finite."""
    shape, q = shape_of(dim, kind), jnp.eye(2 if dim == 2 else 4)[0]

    def gaps(x):
        contacts = COLLIDERS[kind, kind](shape, x, q, shape, jnp.zeros(dim), q)
        return jnp.concatenate([contacts.gap, contacts.normal.ravel(), contacts.point.ravel()])

    both = with_slopes(gaps, jax.jacrev)
    for x in (jnp.zeros(dim), 1.2 * jnp.eye(dim)[0], 1.6 * jnp.eye(dim)[0], 0.6 * jnp.eye(dim)[1]):
        assert all(np.isfinite(leaf).all() for leaf in both(x))


@pytest.mark.parametrize("height", [1e-6, 1e-9, -1e-9, -1e-7, -1e-6, -3e-6])
def test_an_edge_that_comes_down_beside_a_corner_that_has_sunk_in_is_seen(height):
    """A box stands on another with one corner, 2e-6 m inside; an edge of it crosses one of the other at `height`."""
    high, low = dr.Box(half=jnp.array([0.4, 0.2, 0.1])), dr.Box(half=jnp.array([0.3, 0.3, 0.1]))
    yaw = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    corner = np.array([-0.1, -0.1])
    crosses, third = corner + 0.4 / yaw[0, 0] * yaw[:, 0], corner + 0.4 * yaw[:, 1]
    z, dx, dy = np.linalg.solve([[1.0, *p] for p in (corner, crosses, third)], [-2e-6, height, 1e-3])  # its lower face
    centre = corner + yaw @ (0.4, 0.2)
    q = so3.compose(so3.exp(jnp.array([dy, -dx, 0.0])), so3.exp(jnp.array([0.0, 0.0, 0.5])))
    x = jnp.array([*centre, z + centre @ (dx, dy)]) + so3.rotate(q, jnp.array([0.0, 0.0, 0.1]))
    contacts = COLLIDERS[dr.Box, dr.Box](high, x, q, low, jnp.array([0.0, 0.0, -0.1]), jnp.eye(4)[0])
    gap, normal, point = map(np.asarray, (contacts.gap, contacts.normal, contacts.point))
    there = (np.linalg.norm(point - (*crosses, 0.0), axis=1) < 1e-3) & (normal[:, 2] > 0.99) & (gap < 1e-3)
    assert there.sum() == 1
    assert_allclose(gap[there], height, atol=1e-9)


@pytest.mark.parametrize(("dim", "kind_a", "kind_b"), PAIRS, ids=lambda p: getattr(p, "__name__", f"{p}D"))
def test_a_body_of_many_worlds_meets_one_that_all_share(dim, kind_a, kind_b):
    """The one has a batch axis, the other an axis of length 1."""
    a, b = (jax.tree.map(lambda leaf: leaf[..., None], shape_of(dim, kind)) for kind in (kind_a, kind_b))
    x, q = jnp.zeros((dim, 1)), jnp.eye(2 if dim == 2 else 4)[0][:, None]
    many = jnp.zeros((dim, 5))
    for x_a, x_b in ((many, x), (x, many)):
        contacts = jax.eval_shape(COLLIDERS[kind_a, kind_b], a, x_a, q, b, x_b, q)
        assert contacts.gap.shape[1:] == (5,)
        if (dim, kind_a, kind_b) in SOLID:
            assert jax.eval_shape(core_separation, a, x_a, q, b, x_b, q).gap.shape == (1, 5)


def test_a_gap_that_opens_again_far_off_does_not_hold_up_the_search():
    """Beside one that closes: features that a list lacks are far, and turn with the body."""
    one, gaps = jnp.ones(()), jnp.array([[1e-6, 1e6], [-0.1, -1e-7], [0.0, 0.3]])
    task = Task(a=None, b=None, start=0 * one, t1=one / 60, size=one, slow=1e-3 * one, width=None, rested=one < 0)
    look = polish(task, Gaps(*gaps, pull=gaps[2], normal=jnp.zeros((2, 3))), jnp.zeros(2, bool), 0 * one, 0 * one)
    assert_allclose(look.dt, 1e-5, rtol=1e-9)
    assert look.closes


@pytest.mark.parametrize("names", [("tile", "box"), ("floor", "tile"), ("box", "post")])
def test_the_gap_of_two_bodies_is_their_distance_wherever_the_shape_sits(names):
    """A polygon whose origin is not its centre of mass; in either order, by `jit`, with its derivative by the poses."""
    bodies = {
        "tile": dr.Body(SHAPES[2][dr.Polygon], mass=1.0, x=(0.0, 2.0), angle=0.4),
        "box": dr.Body(SHAPES[2][dr.Box], mass=1.0, x=(1.9, 2.5), angle=1.0),
        "floor": dr.Static(dr.HalfSpace(normal=(0.6, 0.8)), x=(0.2, 0.1), angle=0.2),
        "post": dr.Static(SHAPES[2][dr.Capsule], x=(0.5, 4.0), angle=0.3),
    }
    world, state = dr.scene(bodies)

    placed = {
        list(bodies)[owner]: outline
        for (owner, *_), outline in outlines(*jax.tree.map(np.asarray, (world, state))).items()
    }
    found, slope = jax.jit(jax.value_and_grad(lambda state: dr.gap(world, state, *names)))(state)
    assert_allclose(found, separation(placed[names[0]], placed[names[1]]), atol=ROUNDING)
    assert_allclose(dr.gap(world, state, *names[::-1]), found, atol=ROUNDING)
    moves = np.linalg.norm(np.asarray(slope.x), axis=1)  # by one along the normal
    assert_allclose(moves[[world.names.index(name) for name in names if name in world.names]], 1.0, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_gaps_of_a_batch_are_those_of_each_world(dim):
    """As many worlds as dimensions, so that arrays that are aligned wrongly broadcast all the same."""
    bodies = {
        "box": dr.Body(SHAPES[dim][dr.Box], mass=1.0, x=(0.1, 2.0, 0.3)[:dim]),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0, 0.0)[:dim]), x=(0.0, -1.0, 0.0)[:dim]),
    }
    world, state = dr.scene(bodies)
    turns = jnp.linspace(0.1, 0.9, dim)[None] * jnp.ones((1 if dim == 2 else 3, dim))
    states = dr.replace(state, q=rotations(dim).exp(turns)[None])
    alone = [dr.gap(world, dr.replace(state, q=states.q[..., k]), "box", "floor") for k in range(dim)]
    assert_allclose(dr.gap(world, states, "box", "floor"), alone, atol=ROUNDING)


def test_a_gap_that_is_not_there_is_refused():
    world, state = dr.scene(
        {
            "ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(1.0, 1.0)),
            "dot": dr.Body(None, mass=1.0, inertia=1.0, x=(1.0, 2.0)),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
            "wall": dr.Static(dr.HalfSpace(normal=(1.0, 0.0))),
            "hill": dr.Static(dr.Profile(points=((-2.0, 0.0), (0.0, -1.0), (2.0, 0.0)))),
        }
    )
    for names, why in (
        (("ball", "hill"), "is a Profile, to which there is no distance"),
        (("ball", "flor"), "did you mean 'floor'"),
        (("ball", "dot"), "no shape"),
        (("floor", "wall"), "are half-spaces, which have no distance"),
        (("ball", "ball"), "twice"),
    ):
        with pytest.raises(ValueError, match=f"gap: .*{why}"):
            dr.gap(world, state, *names)
