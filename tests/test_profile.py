"""Bodies on the solid below a polyline: distances, and motions in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import vector, with_slopes
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.collide import COLLIDERS

G = 9.81
EXACT = 1e-9
HILLS = np.array([(-2.0, 0.3), (-1.0, 0.0), (0.0, 1.0), (0.4, 0.9), (1.2, -0.5), (2.0, -0.5), (3.0, 0.2)])


def distances(points, line):
    """From points (P, 2) to the polyline that goes on straight beyond its ends, by many points on it; outside."""
    ends = np.array(line)
    ends[0] += 20 * (line[0] - line[1])
    ends[-1] += 20 * (line[-1] - line[-2])
    start, along = ends[:-1], np.diff(ends, axis=0)
    share = ((points[:, None] - start) * along).sum(2) / (along**2).sum(1)
    closest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(points[:, None] - closest, axis=2).min(1)


def height_of(x, line):
    slopes = np.diff(line, axis=0)
    left, right = slopes[0, 1] / slopes[0, 0], slopes[-1, 1] / slopes[-1, 0]
    y = np.interp(x, line[:, 0], line[:, 1])
    return y + np.minimum(x - line[0, 0], 0.0) * left + np.maximum(x - line[-1, 0], 0.0) * right


def test_a_disc_has_the_distance_of_the_line():
    """Least gap of all contacts, from anywhere outside; turned and moved."""
    rng = np.random.default_rng(0)
    p = rng.uniform((-3.0, -1.0), (4.0, 2.0), (400, 2))
    p = p[p[:, 1] > height_of(p[:, 0], HILLS) + 0.01]
    c, s, x = np.cos(0.3), np.sin(0.3), np.array([0.5, -0.2])
    world = p @ np.array([[c, s], [-s, c]]) + x
    disc, profile = dr.Disc(radius=jnp.asarray(0.1)), dr.Profile(points=jnp.asarray(HILLS))
    collide = COLLIDERS[dr.Disc, dr.Profile]

    def gap(x_a):
        return collide(disc, x_a, vector(1.0, 0.0), profile, jnp.asarray(x), vector(c, s)).gap.min()

    assert_allclose(jax.vmap(gap)(jnp.asarray(world)), distances(p, HILLS) - 0.1, atol=1e-12)


@pytest.mark.parametrize("shape", [dr.Box(half=(0.3, 0.2)), dr.Capsule(radius=0.1, half_length=0.3)])
def test_a_solid_has_the_distance_of_its_outline(shape):
    """Against the nearest of many points of its outline to the line, and of the vertices to it."""
    rng = np.random.default_rng(1)
    shape = jax.tree.map(jnp.asarray, shape, is_leaf=lambda leaf: isinstance(leaf, tuple))
    turn = np.linspace(0.0, 1.0, 400)[:, None]
    core = np.array([(-0.3, -0.2), (0.3, -0.2), (0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2)])
    if isinstance(shape, dr.Capsule):
        core = np.array([(-0.3, 0.0), (0.3, 0.0)])
    outline = np.concatenate([a + turn * (b - a) for a, b in zip(core[:-1], core[1:], strict=True)])
    rounding = 0.1 if isinstance(shape, dr.Capsule) else 0.0
    collide, profile = COLLIDERS[type(shape), dr.Profile], dr.Profile(points=jnp.asarray(HILLS))
    place = jax.jit(lambda x, q: collide(shape, x, q, profile, vector(0.0, 0.0), vector(1.0, 0.0)).gap.min())
    seen = 0
    for x, angle in zip(rng.uniform((-2.0, 0.0), (3.0, 1.8), (120, 2)), rng.uniform(0, 2 * np.pi, 120), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        around = outline @ np.array([[c, s], [-s, c]]) + x
        if (around[:, 1] > height_of(around[:, 0], HILLS) + rounding).all():
            expected = distances(around, HILLS).min() - rounding
            assert_allclose(place(jnp.asarray(x), vector(c, s)), expected, atol=3e-3)  # steps of the outline
            seen += 1
    assert seen > 30


def end(shape, points, x, v, e, mu, t):
    """Where a body is at t on a profile."""
    body = dr.Body(shape, mass=1.3, x=x, v=v)
    bodies = {"body": body, "ground": dr.Static(dr.Profile(points=points))}
    world, state = dr.scene(bodies, gravity=(0.0, -G), restitution=e, friction=mu)
    times = jnp.stack([jnp.zeros_like(t), t])
    return dr.rollout(world, state, dt=1 / 60, times=times, substeps=(60,)).state.x[-1, 0]


def bounced(points, x, e, t, radius):
    """A disc that falls on the first segment, without friction."""
    along = points[1] - points[0]
    n = jnp.stack([-along[1], along[0]]) / jnp.sqrt((along**2).sum())
    down = vector(0.0, -G)
    s = jnp.sqrt(2 * (n @ (x - points[0]) - radius) / (n[1] * G))
    v = s * down - (1 + e) * (s * n @ down) * n
    return x + 0.5 * s**2 * down + v * (t - s) + 0.5 * (t - s) ** 2 * down


@pytest.mark.parametrize("mode", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
def test_a_disc_bounces_off_a_segment(mode):
    """Slopes by the points of the profile, by where it falls and by its restitution."""
    points = jnp.array([(-2.0, 0.1), (0.3, 0.5), (2.0, 2.0)])
    arguments, disc = (points, vector(-0.7, 1.0), jnp.asarray(0.6), jnp.asarray(0.7)), dr.Disc(radius=0.1)

    def both(fn):
        return with_slopes(fn, mode)(*arguments)

    got = both(lambda points, x, e, t: end(disc, points, x, vector(0.0, 0.0), e, 0.0, t))
    expected = both(lambda points, x, e, t: bounced(points, x, e, t, 0.1))
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=EXACT), got, expected)


IN_LINE = np.array([(-5.0, 0.0), (-0.31, 0.0), (0.17, 0.0), (0.6, 0.0), (0.601, 0.0), (5.0, 0.0)])
VALLEY = np.array([(-5.0, 2.0), (-0.5, 0.6), (0.0, 0.0), (0.5, 0.6), (0.7, 0.6), (5.0, 2.0)])
PEAK = np.array([(-5.0, -2.0), (-0.5, -0.2), (0.0, 0.0), (0.5, -0.2), (0.7, -0.2), (5.0, -2.0)])


@pytest.mark.slow
@pytest.mark.parametrize("shape", [dr.Disc(radius=0.2), dr.Box(half=(0.3, 0.2))])
def test_on_vertices_in_line_in_a_valley_and_on_a_peak(shape):
    """Vertices in line are not felt; a disc rests between two slopes, a box on two points or balanced on one."""
    box = isinstance(shape, dr.Box)
    slope = np.hypot(0.5, 0.6) / 0.5
    places = (0.2, 0.2), (0.0, 0.3 * 0.6 / 0.5 + 0.2 if box else 0.2 * slope), (0.0, 0.2)
    speeds = (0.9, 0.0, 0.0)
    cases = [np.stack(rows) for rows in ((IN_LINE, VALLEY, PEAK), places, [(v, 0.0) for v in speeds])]
    mu = np.array([0.0, 0.5, 0.5])
    run = jax.jit(jax.vmap(lambda points, x, v, mu: end(shape, points, x - 0.4 * v, v, 0.0, mu, jnp.asarray(1.0))))
    x = run(*map(jnp.asarray, (*cases, mu)))
    expected = np.array(places) + 0.6 * cases[2]
    assert_allclose(x, expected, atol=EXACT)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [dr.Disc(radius=0.2), dr.Box(half=(0.3, 0.2))])
def test_what_slips_over_vertices_in_line_slips_as_on_a_plane(shape):
    """With friction and restitution; also its slopes."""
    grounds = dr.Profile(points=IN_LINE), dr.HalfSpace(normal=(0.0, 1.0))

    def path(ground, v, mu):
        bodies = {"body": dr.Body(shape, mass=1.3, x=(0.0, 0.2), v=vector(v, 0.0)), "ground": dr.Static(ground)}
        world, state = dr.scene(bodies, gravity=(0.0, -G), restitution=0.5, friction=mu)
        path = dr.rollout(world, state, dt=1 / 60, steps=30).state
        return jnp.concatenate([path.x[:, 0], path.q[:, 0], path.w[:, 0]], axis=1)

    p = jnp.asarray(1.9), jnp.asarray(0.15)
    (got, slopes), (expected, true_slopes) = (
        with_slopes(lambda *p, ground=ground: path(ground, *p))(*p) for ground in grounds
    )
    assert_allclose(got, expected, atol=EXACT)
    assert_allclose(slopes, true_slopes, atol=EXACT)


@pytest.mark.slow
def test_a_slope_that_begins_beside_a_body_is_not_felt():
    """Thrown boxes that come down, slip and tip on a level face beside one that rises by 0.001."""
    flat = np.array([(-3.0, 0.0), (0.0, 0.0), (3.0, 0.0)])
    level, beside = jnp.asarray(flat), jnp.asarray(flat + [(0.0, 3e-3), (0.0, 0.0), (0.0, 0.0)])
    rng = np.random.default_rng(0)
    x, v = rng.uniform((0.5, 0.4), (0.9, 0.7), (16, 2)), rng.uniform((-0.3, -1.0), (0.5, 0.0), (16, 2))

    def path(points, x, v, w):
        body = dr.Body(dr.Box(half=(0.2, 0.1)), mass=1.3, x=x, v=v, w=w)
        bodies = {"body": body, "ground": dr.Static(dr.Profile(points=points))}
        scene = dr.scene(bodies, gravity=(0.0, -G), restitution=0.5, friction=0.4)
        return dr.rollout(*scene, dt=1 / 60, steps=45).state

    both = jax.jit(jax.vmap(lambda *start: (path(level, *start), path(beside, *start))))
    expected, got = both(*map(jnp.asarray, (x, v, rng.uniform(-4.0, 4.0, 16))))
    stays = np.asarray(expected.x[:, :, 0, 0].min(1) > np.hypot(0.2, 0.1))
    assert stays.sum() > 10
    jax.tree.map(lambda a, b: assert_allclose(a[stays], b[stays], atol=1e-8), got, expected)


VEE, ROOF = np.array([(-3.0, 2.1), (0.1, 0.0), (3.0, 1.2)]), np.array([(-3.0, -2.1), (0.1, 0.0), (3.0, -1.2)])


def planes(points):
    """The same valley by two half-spaces."""
    along = np.diff(points, axis=0)
    n = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    return {str(k): dr.Static(dr.HalfSpace(normal=n[k], offset=n[k] @ points[1])) for k in range(2)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape, points, other",
    [
        (dr.Box(half=(0.3, 0.2)), VEE, planes(VEE)),
        (dr.Capsule(radius=0.1, half_length=0.3), ROOF, {"0": dr.Static(dr.Polygon(vertices=ROOF[::-1]))}),
    ],
)
def test_a_valley_is_two_planes_and_a_roof_a_polygon(shape, points, other):
    """Of a spinning body that bounces and slides, 0.6 s."""
    body = dr.Body(shape, mass=1.3, x=(-0.3, 0.9), v=(0.5, 0.0), w=2.0)

    def run(ground):
        scene = dr.scene({"body": body, **ground}, gravity=(0.0, -G), restitution=0.5, friction=0.3)
        return dr.rollout(*scene, dt=1 / 60, steps=36).state

    got, expected = run({"ground": dr.Static(dr.Profile(points=points))}), run(other)
    assert abs(got.w[-1, 0, 0] - 2.0) > 0.1  # it was struck
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-8), got, expected)


def test_a_corner_that_has_fallen_into_a_valley_is_held_by_both_slopes():
    """As far below as a step of free fall, under the vertex and beside it: as deep in both as in two half-spaces."""
    box, place = dr.Box(half=vector(0.2, 0.2)), (vector(0.0, 0.0), vector(1.0, 0.0))
    standing = vector(np.sqrt(0.5), np.sqrt(0.5))
    grounds = [dr.Profile(points=jnp.asarray(VEE)), *(jax.tree.map(jnp.asarray, p.shape) for p in planes(VEE).values())]

    @jax.jit
    def gaps(corner):
        x = VEE[1] + corner + vector(0.0, 0.2 * np.sqrt(2.0))
        return [COLLIDERS[dr.Box, type(ground)](box, x, standing, ground, *place).gap for ground in grounds]

    for corner in ((0.0, -1e-4), (3e-5, -1e-4), (-9e-5, -1e-4), (2e-4, -1e-4), (-2e-4, -1e-4)):
        first, *others = map(np.asarray, gaps(jnp.asarray(corner)))
        deep = np.concatenate(others)
        assert_allclose(np.sort(first[first < 0]), np.sort(deep[deep < 0]), atol=1e-12)


def test_mistakes_are_named():
    ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0))
    with pytest.raises(ValueError, match=r"points does not go to the right from point 1: sort them by x"):
        dr.scene({"ball": ball, "ground": dr.Static(dr.Profile(points=((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))))})
    with pytest.raises(ValueError, match="ball.shape is a Profile, which has no mass: make ball a Static"):
        dr.scene({"ball": dr.Body(dr.Profile(points=HILLS), mass=1.0, x=(0.0, 1.0))})
