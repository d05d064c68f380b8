"""Shapes against closed forms, quadrature, cuts and shifts; hulls against scipy and Euler's formula."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull

from diffrigid import shapes
from diffrigid.hull import hull_edges, hull_faces
from diffrigid.moments import volume_properties
from diffrigid.pytree import replace
from diffrigid.shape_checks import check_shape
from diffrigid.shapes import Box, Capsule, Disc, HalfSpace, Hull, Polygon, Sphere
from diffrigid.view.outline import outline

EXACT = 1e-12  # relative: sums of at most some hundred terms in double precision
DENSITY = 2.5
TURN = {2: np.array([(3, -4), (4, 3)]) / 5, 3: np.array([(2, -1, 2), (2, 2, -1), (-1, 2, 2)]) / 3}


@partial(jax.jit, static_argnames="dim")
def mass_properties(shape, density, dim):
    """Mass, centre of mass, inertia."""
    volume, center, gyration = volume_properties(shape, dim)
    return density * volume, center, density * volume * gyration


def circle(n):
    turn = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(turn), np.sin(turn)], axis=1)


TETRAHEDRON = np.array([(0, 0, 0), (1.0, 0, 0), (0, 1, 0), (0, 0, 1)])
CUBE = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
FACES = hull_faces(CUBE)
PRISM = np.concatenate([np.insert(circle(32), 2, z, axis=1) for z in (-1, 1)])
GOLDEN = (1 + math.sqrt(5)) / 2
ICOSAHEDRON = np.array([np.roll((0, a, b * GOLDEN), k) for a in (-1, 1) for b in (-1, 1) for k in range(3)])
CLOUD = np.random.default_rng(0).normal(size=(64, 3))
SPHERICAL = CLOUD / np.linalg.norm(CLOUD, axis=1, keepdims=True)
PENTAGON = np.array([(0, 0), (2, 0.3), (2.5, 1.5), (1.0, 2.2), (-0.5, 1.0)])
SOLIDS = {  # record, dimension
    "disc": (Disc(radius=0.7), 2),
    "sphere": (Sphere(radius=0.7), 3),
    "box 2D": (Box(half=np.array([0.5, 1.5])), 2),
    "box 3D": (Box(half=np.array([0.5, 1.5, 0.8])), 3),
    "stadium": (Capsule(radius=0.3, half_length=0.9), 2),
    "capsule": (Capsule(radius=0.3, half_length=0.9), 3),
    "polygon": (Polygon(vertices=PENTAGON), 2),
    "hull": (shapes.with_topology(Hull(vertices=ICOSAHEDRON * [1, 1.2, 0.7] + 0.3)), 3),
}
solids = pytest.mark.parametrize("shape, dim", SOLIDS.values(), ids=SOLIDS.keys())
HULLS = {  # corners, number of edges, volume; far off in float32, rounding tilts the thin triangles
    "tetrahedron": (TETRAHEDRON, 6, 1 / 6),
    "cube": (CUBE, 12, 8.0),
    "icosahedron": (ICOSAHEDRON, 30, 5 / 12 * (3 + math.sqrt(5)) * 2**3),
    "prism in float32": ((PRISM @ TURN[3] + 20.0).astype(np.float32), 96, 32 * math.sin(2 * math.pi / 32)),
    "64 on a sphere": (SPHERICAL, 186, ConvexHull(SPHERICAL).volume),
}


def assert_same_body(got, expected):
    for a, b in zip(got, expected, strict=True):
        assert_allclose(a, b, rtol=EXACT, atol=EXACT * float(expected[0]))


def glued(parts):
    """Mass properties of several bodies taken as one, by the parallel-axis theorem."""
    mass = sum(m for m, _, _ in parts)
    center = sum(m * c for m, c, _ in parts) / mass
    arms = [np.sqrt(m) * np.asarray(c - center) for m, c, _ in parts]
    steiner = sum(r @ r if len(r) == 2 else r @ r * np.eye(3) - np.outer(r, r) for r in arms)
    return mass, center, steiner + sum(inertia for _, _, inertia in parts)


CLOSED_FORMS = {  # volume, inertia per mass
    "disc": (math.pi * 0.7**2, 0.7**2 / 2),
    "sphere": (4 / 3 * math.pi * 0.7**3, 0.4 * 0.7**2 * np.eye(3)),
    "box 2D": (3.0, (1.0**2 + 3.0**2) / 12),
    "box 3D": (4.8, np.diag([3.0**2 + 1.6**2, 1.0**2 + 1.6**2, 1.0**2 + 3.0**2]) / 12),
}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_closed_forms(name):
    (shape, dim), (volume, gyration) = SOLIDS[name], CLOSED_FORMS[name]
    check_shape(shape, name)
    assert shapes.dimension(shape) == dim
    with pytest.raises(ValueError, match=f"is {dim}D but dim is {5 - dim}"):
        mass_properties(shape, 1.0, 5 - dim)
    expected = (DENSITY * volume, np.zeros(dim), DENSITY * volume * gyration)
    assert_same_body(mass_properties(shape, DENSITY, dim), expected)


def test_records_of_two_classes_are_never_alike():
    """Else `jit` may take what it compiled for the other."""
    assert jax.tree.structure(Disc(radius=1.0)) != jax.tree.structure(Sphere(radius=1.0))


def test_records_are_not_compared_while_their_numbers_are_unknown():
    disc = Disc(radius=1.0)
    assert disc == Disc(1.0) and disc != Disc(radius=2.0) and disc != Sphere(1.0)
    for trace in (jax.jit, jax.grad):
        with pytest.raises(TypeError, match="not known while JAX traces"):
            trace(lambda radius: 1.0 * (Disc(radius=radius) == disc))(1.0)


def test_regular_polygons_tend_to_the_disc():
    for n in (12, 48):
        volume, _, gyration = volume_properties(Polygon(vertices=circle(n)), 2)
        assert_allclose(gyration, 0.5 * (1 - 2 / 3 * math.sin(math.pi / n) ** 2), rtol=EXACT)
        missing = math.pi / 2 - volume * gyration  # 2 pi^3 / (3 n^2) (1 - O(pi^2 / n^2))
        assert_allclose(missing * n**2, 2 * math.pi**3 / 3, rtol=(math.pi / n) ** 2)


@pytest.mark.parametrize("dim", (2, 3))
def test_capsule_against_quadrature(dim):
    r, h = 0.3, 0.9
    node, weight = np.polynomial.legendre.leggauss(40)
    turn = np.pi / 4 * (node + 1)  # x = h + r sin(turn) in an end: smooth up to the tip
    x = np.concatenate([h * node, h + r * np.sin(turn), -h - r * np.sin(turn)])
    y = np.concatenate([np.full(40, r), r * np.cos(turn), r * np.cos(turn)])
    dx = np.concatenate([h * weight] + [np.pi / 4 * weight * r * np.cos(turn)] * 2)
    section, spread = (2 * y, y**2 / 3) if dim == 2 else (np.pi * y**2, y**2 / 4)
    axial, lateral = (section * x**2) @ dx, (section * spread) @ dx
    inertia = axial + lateral if dim == 2 else np.diag([2 * lateral, axial + lateral, axial + lateral])
    got = mass_properties(Capsule(radius=r, half_length=h), 1.0, dim)
    assert_same_body(got, (section @ dx, np.zeros(dim), inertia))


def test_bodies_without_volume_have_a_gyration():
    rod = np.diag([0.0, 3.0, 3.0])  # length 6: 6^2 / 12
    assert_allclose(volume_properties(Capsule(radius=0.0, half_length=3.0), 3)[2], rod)
    assert_allclose(volume_properties(Box(half=np.array([3.0, 0.0, 0.0])), 3)[2], rod)
    grad = jax.grad(lambda half: mass_properties(Box(half=half), 1.0, 3)[0])(jnp.array([1.0, 0.0, 2.0]))
    assert_allclose(grad, [0.0, 16.0, 0.0])  # volume 8 a b c


@solids
def test_scaling(shape, dim):
    mass, center, inertia = mass_properties(shape, DENSITY, dim)
    got = mass_properties(jax.tree.map(lambda leaf: 3.0 * leaf, shape), DENSITY, dim)
    assert_same_body(got, (3**dim * mass, 3 * center, 3 ** (dim + 2) * inertia))


@pytest.mark.parametrize("name", ("box 2D", "polygon", "box 3D"))
def test_shape_as_corners_whole_and_with_one_corner_cut_off(name):
    (shape, dim), kind = SOLIDS[name], Hull if name == "box 3D" else Polygon
    corners = np.asarray(shapes.vertices(shape, dim))
    cuts = corners, corners[[0, 1, -1] if dim == 2 else [0, 1, 3, 4]], corners[1:]
    parts = [shapes.with_topology(kind(vertices=part)) for part in cuts]
    whole, *halves = (mass_properties(part, DENSITY, dim) for part in parts)
    assert shapes.edges(parts[0], dim) == shapes.edges(shape, dim)
    assert_same_body(whole, mass_properties(shape, DENSITY, dim))
    assert_same_body(glued(halves), whole)


@pytest.mark.parametrize("name", ("polygon", "hull"))
def test_motion_of_the_vertices_moves_the_properties(name):
    shape, dim = SOLIDS[name]
    turn, shift = TURN[dim], np.array([30.0, -70.0, 20.0])[:dim]
    moved = mass_properties(replace(shape, vertices=shape.vertices @ turn.T + shift), DENSITY, dim)
    mass, center, inertia = mass_properties(shape, DENSITY, dim)
    assert_same_body(moved, (mass, turn @ center + shift, turn @ inertia @ turn.T if dim == 3 else inertia))


@solids
def test_gradients(shape, dim):
    leaves, tree = jax.tree.flatten(jax.tree.map(lambda leaf: jnp.asarray(leaf, float), shape))
    body = jax.jit(lambda density, *leaves: mass_properties(tree.unflatten(leaves), density, dim))
    # both modes against central differences, O(eps^2), along a random direction of density and all leaves
    check_grads(body, (DENSITY, *leaves), 1, ("fwd", "rev"), eps=1e-5, atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize("corners, n_edges, volume", HULLS.values(), ids=HULLS.keys())
def test_hull_topology(corners, n_edges, volume):
    faces = hull_faces(corners)
    sides = [side for i, j, k in faces for side in ((i, j), (j, k), (k, i))]
    assert len(sides) == len(set(sides)) and set(sides) == {(j, i) for i, j in sides}  # closed, in one sense
    a, b, c = (corners.astype(float)[np.array(faces)] - corners.mean(0)).transpose(1, 0, 2)
    parts = (a * np.cross(b, c)).sum(1) / 6
    assert (parts > 0).all()  # outward; and none overlap, else the sum would be too large
    assert_allclose(parts.sum(), volume, rtol=EXACT if corners.dtype == float else 1e-5)
    assert len(hull_edges(faces)) == 3 * len(corners) - 6  # Euler, diagonals included
    assert len(hull_edges(faces, corners)) == n_edges
    check_shape(shapes.with_topology(Hull(vertices=corners)), "hull")


@solids
def test_outline_is_the_rounded_core(shape, dim):
    # in 3D only along the axes: elsewhere a sphere bulges between its great circles
    directions = circle(100) if dim == 2 else np.concatenate([np.eye(3), -np.eye(3)])
    lines = outline(shape, dim, points=(n := 4000))
    drawn = (lines if dim == 2 else np.concatenate(lines)) @ directions.T
    core = np.asarray(shapes.vertices(shape, dim)) @ directions.T
    # support functions; the sagitta of a chord for a radius below 1
    assert_allclose(drawn.max(0), core.max(0) + shapes.radius(shape), atol=0.5 * (math.pi / n) ** 2)
    if dim == 2:
        assert (lines[0] == lines[-1]).all()
        area = 0.5 * np.sum(lines[:-1, 0] * lines[1:, 1] - lines[:-1, 1] * lines[1:, 0])
        assert_allclose(area, volume_properties(shape, 2)[0], rtol=(2 * math.pi / n) ** 2)


@solids
def test_core_with_batch_axes(shape, dim):
    sizes = np.array([[1.0, 2.0, 0.5], [3.0, 1.5, 0.25]], np.float32)
    batch = jax.tree.map(lambda leaf: jnp.asarray(np.multiply.outer(leaf, sizes), jnp.float32), shape)
    corners, rounding = shapes.vertices(batch, dim), shapes.radius(batch)
    assert corners.dtype == rounding.dtype == jnp.float32
    for at, size in np.ndenumerate(sizes):
        assert_allclose(corners[:, :, *at], float(size) * shapes.vertices(shape, dim), rtol=1e-6)
        assert_allclose(rounding[at], float(size) * shapes.radius(shape), rtol=1e-6)


def test_traced_leaves_are_checked_for_rank_only():
    check = jax.jit(lambda leaf: check_shape(Box(half=leaf), "box"))
    check(jnp.array([-1.0, 2.0]))
    with pytest.raises(ValueError, match=r"box.half has shape \(4,\)"):
        check(jnp.ones(4))
    with pytest.raises(ValueError, match="traced, so its faces cannot be found"):
        jax.jit(lambda corners: shapes.edges(Hull(vertices=corners), 3))(CUBE)


BAD = [  # shape, pattern of the message
    ("ball", r"ball.shape is 'ball': expected one of Disc, Sphere"),
    (Disc(radius=0.0), r"ball.shape.radius is 0.0 m: expected above 0"),
    (Disc(radius=np.nan), r"ball.shape.radius is not finite \(nan\)"),
    (Disc(radius=np.ones(3)), r"radius has shape \(3,\): expected one number"),
    (Sphere(radius=-1.0), r"ball.shape.radius is -1.0 m"),
    (Box(half=(1.0, -2.0)), r"ball.shape.half is .* give half of each side"),
    (Box(half=(0, 0, 0)), r"half is .* expected one half extent above 0"),
    (Capsule(radius=-0.1, half_length=1.0), r"ball.shape.radius is -0.1 m: expected 0 \(a thin rod\)"),
    (Capsule(radius=0.1, half_length=0.0), r"ball.shape.half_length is 0.0 m: .* a Disc or a Sphere"),
    (Polygon(vertices=PENTAGON[:2]), r"vertices has shape \(2, 2\): expected \(V, 2\) with V > 2"),
    (Polygon(vertices=((0, 0), (1, 0), (1,))), r"vertices is .* rows of equal length"),
    (Polygon(vertices=PENTAGON[::-1]), r"goes clockwise: reverse the order of the vertices"),
    (Polygon(vertices=PENTAGON[[0, 1, 1, 2]]), r"repeats vertex 1: leave out 2"),
    (Polygon(vertices=((0, 0), (1, 0), (2, 0), (1, 1))), r"has vertex 1 in line"),
    (Polygon(vertices=((0, 0), (2, 0), (0.5, 0.5), (0, 2))), r"is not convex at vertex 2"),
    (Polygon(vertices=PENTAGON[[0, 2, 4, 1, 3]]), r"crosses itself"),
    (Hull(vertices=TETRAHEDRON[[0, 1, 2, 3, 2]]), r"repeats a point, 2 and 4"),
    (Hull(vertices=CUBE[CUBE[:, 0] > 0]), r"ball.shape.vertices lies in one plane"),
    (Hull(vertices=np.append(CUBE, [(0.2, 0, 0)], 0)), r"has point 8 that is no corner"),
    (Hull(vertices=np.append(CUBE, [(1.0, 1.0, 0)], 0)), r"has point 8 that is no corner"),
    (Hull(vertices=CUBE, faces=FACES[:-1]), r"ball.shape.faces do not close"),
    (Hull(vertices=CUBE, faces=((0, 1, 8), *FACES)), r"different indices from 0 to 7"),
    (Hull(vertices=CUBE, faces=tuple(f[::-1] for f in FACES)), r"faces are inside out"),
    (Hull(vertices=CUBE, faces=hull_faces(TETRAHEDRON)), r"faces enclose .* of 8 in the hull"),
    (HalfSpace(normal=(0.0, 2.0)), r"ball.shape.normal has length 2: .* divide it .* by its length"),
    (HalfSpace(normal=np.array([0.6, 0.801], np.float32)), r"normal has length 1.0008"),
]


@pytest.mark.parametrize("shape, message", BAD)
def test_errors_name_the_leaf(shape, message):
    with pytest.raises(ValueError, match=message):
        check_shape(shape, "ball.shape")


@pytest.mark.parametrize("normal", [(0.6, 0.8), (0.0, 0.6, -0.8)])
def test_half_space_is_drawn_on_its_surface_and_has_no_mass(normal):
    shape, dim = HalfSpace(normal=normal, offset=-0.4), len(normal)
    check_shape(shape, "floor")
    lines = np.reshape(outline(shape, dim), (-1, dim))
    assert_allclose(lines @ np.array(normal), -0.4, atol=1e-12)
    with pytest.raises(ValueError, match="HalfSpace has no finite mass"):
        mass_properties(shape, 1.0, dim)
