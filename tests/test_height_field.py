"""Bodies on the solid below a grid of heights: distances, and motions in closed form."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import vector
from marks import some_later
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import diffrigid as dr
from diffrigid.collide import COLLIDERS
from diffrigid.collide.heights import TOUCHES, candidates, convex_heights, of_nearest
from diffrigid.impacts import contacts
from diffrigid.overlap import place, separation
from diffrigid.scene_file import read_scene
from diffrigid.shapes import vertices, with_topology
from diffrigid.view.frames import shapes

G = 9.81
EXACT = 1e-9
UNTURNED = (1.0, 0.0, 0.0, 0.0)
X, Y = np.meshgrid(0.5 * np.arange(9), 0.5 * np.arange(8), indexing="ij")  # [m] of the nodes
BUMPS = 0.3 * np.sin(2.1 * X + 0.4) * np.cos(1.7 * Y)
SHAPES = {
    dr.Sphere: dr.Sphere(radius=0.3),
    dr.Capsule: dr.Capsule(radius=0.15, half_length=0.4),
    dr.Box: dr.Box(half=(0.5, 0.3, 0.2)),
    dr.Hull: dr.Hull(vertices=((-0.6, -0.5, -0.4), (0.8, -0.3, -0.3), (-0.1, 0.9, -0.4), (0.1, 0.1, 0.8))),
}


def prisms():
    """The solid in convex parts, each a triangle of the surface with all below; beyond the grid it is level."""
    wide = np.pad(BUMPS, 3, mode="edge")
    for i, j in itertools.product(range(wide.shape[0] - 1), range(wide.shape[1] - 1)):
        for cell in (((0, 0), (1, 0), (1, 1)), ((0, 0), (1, 1), (0, 1))):
            top = np.array([(0.5 * (i + k - 3), 0.5 * (j + l - 3), wide[i + k, j + l]) for k, l in cell])
            solid = dr.Hull(vertices=np.concatenate([top, top * (1, 1, 0) - (0, 0, 2)]))
            yield top, place(with_topology(solid), np.zeros(3), np.array(UNTURNED))


@functools.cache
def parts():
    return list(prisms())


@some_later("kind", SHAPES, dr.Sphere, dr.Box)
def test_distance_is_that_of_the_nearest_part_of_the_solid(kind):
    """Least gap of all contacts, where bodies are apart: inside, over the border and beyond."""
    rng = np.random.default_rng(3)
    field = dr.HeightField(heights=jnp.asarray(BUMPS), spacing=jnp.asarray(0.5), cells=4)
    shape = jax.tree.map(jnp.asarray, with_topology(SHAPES[kind]), is_leaf=lambda leaf: isinstance(leaf, tuple))

    @jax.jit
    def gap(x, q):
        def least(x):
            return COLLIDERS[kind, dr.HeightField](shape, x, q, field, jnp.zeros(3), vector(*UNTURNED)).gap.min()

        return jax.value_and_grad(least)(x)

    seen = 0
    for x in rng.uniform((-0.6, -0.6, 0.3), (4.6, 4.1, 0.8), (60, 3)):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        body = place(with_topology(SHAPES[kind]), x, q)
        near = [solid for top, solid in parts() if np.linalg.norm(top[:, :2].mean(0) - x[:2]) < 1.8]
        wanted = min(separation(body, solid) for solid in near)
        if wanted > 1e-3:
            got, slope = gap(jnp.asarray(x), jnp.asarray(q))
            assert_allclose(got, wanted, atol=EXACT)
            assert_allclose(np.linalg.norm(slope), 1.0, atol=1e-7)  # the slope of a distance
            seen += 1
    assert seen > 15


@some_later("kind", SHAPES, dr.Box)
def test_gaps_are_finite_everywhere(kind):
    """Values and derivatives: on a node, on an edge, below the surface, beyond the grid, far away."""
    field = dr.HeightField(heights=jnp.asarray(BUMPS), spacing=jnp.asarray(0.5), cells=3)
    shape = jax.tree.map(jnp.asarray, with_topology(SHAPES[kind]), is_leaf=lambda leaf: isinstance(leaf, tuple))

    @jax.jit
    def both(x, field):
        def gaps(x, field):
            c = COLLIDERS[kind, dr.HeightField](shape, x, vector(*UNTURNED), field, jnp.zeros(3), vector(*UNTURNED))
            return jnp.concatenate([c.gap, c.normal.ravel(), c.point.ravel()]).sum()

        return jax.value_and_grad(gaps, (0, 1))(x, field)

    at_node, on_edge = (1.0, 1.0, BUMPS[2, 2]), (1.25, 1.0, 0.5 * (BUMPS[2, 2] + BUMPS[3, 2]))
    for x in (at_node, on_edge, (2.1, 1.7, -5.0), (-9.0, 40.0, 0.1), (1e7, -1e7, 1e7)):
        for flat in (0.0, 1.0):
            value, slopes = both(vector(*x), dr.replace(field, heights=flat * field.heights))
            assert all(np.isfinite(leaf).all() for leaf in (value, *jax.tree.leaves(slopes)))


@some_later("kind", SHAPES, dr.Box)
def test_a_corner_that_touches_says_nothing_of_another(kind):
    """On a flat grid: what the candidates of a corner are, its contacts are, and no others."""
    field = dr.HeightField(heights=jnp.zeros((9, 9)), spacing=jnp.asarray(0.5), cells=3)
    shape = jax.tree.map(jnp.asarray, with_topology(SHAPES[kind]), is_leaf=lambda leaf: isinstance(leaf, tuple))

    @jax.jit
    def touching(z):
        poses = vector(2.1, 1.9, z), vector(0.8, 0.36, -0.48, 0.0), field, jnp.zeros(3), vector(*UNTURNED)
        near = candidates(shape, *poses).gap < 1e-6
        gap = convex_heights(shape, *poses).gap
        return gap, of_nearest(shape, field, near, len(gap))

    height = touching(jnp.asarray(2.0))[0].min()
    gap, flags = touching(2.0 - height)
    touches, of_corners = np.flatnonzero(gap < 1e-6), np.flatnonzero(flags[: TOUCHES * len(vertices(shape, 3))])
    assert len(touches) == 1
    assert set(of_corners // TOUCHES) == set(touches // TOUCHES)


# ---- a sphere


RADIUS = 0.2


def scene_of(ground, shape, x, v, e, mu, **options):
    body = dr.Body(shape, mass=1.3, x=x, v=v, **options)
    bodies = {"body": body, "ground": ground}
    return dr.scene(bodies, gravity=(0.0, 0.0, -G), restitution=e, friction=mu)


def on_grid(heights, x, v, e, mu, t):
    """State of a ball after t, 60 steps."""
    ground = dr.Static(dr.HeightField(heights=heights, spacing=0.5))
    world, state = scene_of(ground, dr.Sphere(radius=RADIUS), x, v, e, mu)
    times = jnp.stack([jnp.zeros_like(t), t])
    return jax.tree.map(lambda leaf: leaf[-1], dr.rollout(world, state, dt=1 / 60, times=times, substeps=(60,)).state)


ball = jax.jit(on_grid)


@jax.jit
def slopes_and_state(*args):
    """Slopes of where it is, by the heights, the start, the restitution and the time."""

    def twice(*args):
        state = on_grid(*args)
        return state.x[0], state

    return jax.jacfwd(twice, (0, 1, 3, 5), has_aux=True)(*args)


def slopes_after(heights, x, v, e=0.0, mu=0.0, t=1.0):
    return slopes_and_state(*(jnp.asarray(value, float) for value in (heights, x, v, e, mu, t)))


def ball_after(heights, x, v, e=0.0, mu=0.0, t=1.0):
    return ball(*(jnp.asarray(value, float) for value in (heights, x, v, e, mu, t)))


def plane(slope, base):
    return jnp.asarray(base) + slope[0] * jnp.asarray(X) + slope[1] * jnp.asarray(Y)


def bounced(slope, base, x, v, e, t):
    """Where a ball is that bounces once, without friction, off z = base + slope . (x, y)."""
    n = jnp.concatenate([-slope, jnp.ones(1)]) / jnp.sqrt(1.0 + (slope**2).sum())
    down, gap, speed = vector(0.0, 0.0, -G), n @ x - n[2] * base - RADIUS, n @ v
    acc = n[2] * G
    s = (speed + jnp.sqrt(speed**2 + 2 * acc * gap)) / acc
    after = v + s * down - (1 + e) * (n @ (v + s * down)) * n
    return x + s * v + 0.5 * s**2 * down + after * (t - s) + 0.5 * (t - s) ** 2 * down


@pytest.mark.slow
def test_a_ball_bounces_off_a_tilted_plane():
    """Place and its slopes by the plane, the start, the restitution and the time, in closed form."""
    slope, base, x, v = vector(0.3, -0.2), jnp.asarray(0.4), vector(1.1, 1.8, 1.4), vector(0.4, -0.3, 0.2)
    e, t = jnp.asarray(0.7), jnp.asarray(0.7)
    (by_height, *got), end = slopes_after(plane(slope, base), x, v, e, 0.0, t)
    assert_allclose(end.x[0], bounced(slope, base, x, v, e, t), atol=EXACT)
    by_plane = jax.jacrev(plane, (0, 1))(slope, base)
    by_slope, by_base = (jnp.tensordot(by_height, part, 2) for part in by_plane)
    wanted = jax.jacrev(bounced, (0, 1, 2, 4, 5))(slope, base, x, v, e, t)
    for a, b in zip((by_slope, by_base, *got), wanted, strict=True):
        assert_allclose(a, b, atol=1e-8)


@pytest.mark.slow
def test_slopes_by_the_heights_are_those_of_differences():
    """Of a ball that bounces and rolls over bumps, with friction."""
    start = (1.8, 1.6, 0.9), (0.5, 0.4, 0.0), 0.5, 0.3, 0.8
    by_height = np.asarray(slopes_after(BUMPS, *start)[0][0])
    assert np.isfinite(by_height).all()
    chosen = np.argsort(np.abs(by_height).max(0).ravel())[-6:]
    for k in chosen:
        step = np.zeros(BUMPS.size)
        step[k] = 1e-6
        step = step.reshape(BUMPS.shape)
        ends = [ball_after(BUMPS + sign * step, *start).x[0] for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / 2e-6
        assert_allclose(by_height.reshape(3, -1)[:, k], difference, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_a_ball_slides_along_a_valley_and_keeps_its_energy():
    """Between two slopes, downhill, without friction: the acceleration is that along the valley."""
    valley = np.abs(X - 2.0) - 0.2 * Y
    height = RADIUS * np.sqrt(1.0 + 1.0 + 0.2**2)  # of its centre over the valley, by the normals (-+1, 0.2, 1)
    end = ball_after(valley, (2.0, 0.3, height - 0.06), (0.0, 0.9, -0.18))
    way = 0.9 + 0.5 * G * 0.2 / (1 + 0.2**2)  # level, in 1 s
    assert_allclose(end.x[0], (2.0, 0.3 + way, height - 0.2 * (0.3 + way)), atol=1e-8)
    start = 0.5 * (0.9**2 + 0.18**2) + G * (height - 0.06)
    assert_allclose(0.5 * (end.v**2).sum() + G * end.x[0, 2], start, rtol=1e-10)


def test_a_fast_ball_does_not_tunnel():
    """Into a wall one cell thick, 3 m of way in a step; over a plain, flat; straight down."""
    wall = np.where(np.abs(X - 2.0) < 0.1, 2.0, 0.0)
    for v in ((180.0, 0.0, 0.0), (180.0, 3.0, -1.0), (160.0, 80.0, 0.0)):
        x = np.asarray(ball_after(wall, (-0.7, 0.6, 0.5), v, t=0.05).x[0])
        assert x[0] < 2.0 and x[2] > 0.0
    assert_allclose(ball_after(0 * X, (1.0, 1.0, 150.0), (0.0, 0.0, -300.0)).x[0], (1.0, 1.0, RADIUS), atol=1e-7)


def test_beyond_the_grid_it_is_level():
    end = ball_after(BUMPS * 0 + 0.3, (6.0, -3.0, 0.3 + RADIUS), (1.0, -1.0, 0.0))
    assert_allclose(end.x[0], (7.0, -4.0, 0.3 + RADIUS), atol=EXACT)


# ---- against other grounds


FLAT = dr.Static(dr.HeightField(heights=np.full((7, 5), 0.1), spacing=0.4, cells=3), x=(-1.0, -0.8, -0.1))
FLOOR = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))


@pytest.mark.slow
def test_on_a_flat_grid_is_on_a_half_space():
    """States of a box that bounces, tumbles and slides; and of one that stands on a corner until the next strikes."""

    def thrown(ground, x, v, w, **turned):
        return dr.rollout(*scene_of(ground, SHAPES[dr.Box], x, v, 0.4, 0.3, w=w, **turned), dt=1 / 60, steps=48).state

    falls = {"x": (0.05, 0.03, 0.9), "v": (1.0, 0.3, 0.0), "w": (1.0, 2.0, 0.5)}
    tilt, still = np.array([1.0, 0.01, 0.02, 0.0]) / np.linalg.norm([1.0, 0.01, 0.02, 0.0]), (0.0, 0.0, 0.0)
    low = np.abs(Rotation.from_quat(tilt, scalar_first=True).as_matrix()[2]) @ SHAPES[dr.Box].half
    stands = {"x": (0.05, 0.03, low), "v": still, "w": still, "q": tilt}
    for start, atol in ((falls, 1e-8), (stands, 1e-6)):
        both = thrown(FLAT, **start), thrown(FLOOR, **start)
        jax.tree.map(lambda a, b, atol=atol: assert_allclose(a, b, atol=atol), *both)


LINE = np.array([(0.0, 0.5), (0.5, 0.5), (1.0, 0.1), (1.5, 0.0), (2.0, 0.4), (2.5, 0.2), (3.0, 0.2)])


@pytest.mark.slow
def test_a_capsule_that_slips_over_seams_slips_as_on_a_half_space():
    """Obliquely to its axis, a step, wherever the edges of the grid are below it."""
    capsule = dr.Body(
        dr.Capsule(radius=0.1, half_length=0.25), mass=1.3, x=(0.0, 0.0, 0.1), q=(np.cos(0.35), 0.0, 0.0, np.sin(0.35)),
        v=(1.0, 0.0, 0.0),
    )  # fmt: skip
    shifts = jnp.linspace(0.0, 0.4, 32, endpoint=False)

    def after(ground, shift):
        placed = dr.Static(ground, x=vector(shift - 4.0, 0.11 - 4.0, 0.0))
        world, state = dr.scene({"capsule": capsule, "ground": placed}, gravity=(0.0, 0.0, -G), friction=0.3)
        return dr.step(world, state, 1 / 60)

    grid = dr.HeightField(heights=np.zeros((21, 21)), spacing=0.4)
    got = jax.jit(jax.vmap(functools.partial(after, grid)))(shifts)
    expected = jax.jit(functools.partial(after, dr.HalfSpace(normal=(0.0, 0.0, 1.0))))(shifts[0])
    assert float(jnp.abs(expected.w).max()) > 0.1  # it begins to roll
    jax.tree.map(lambda a, b: assert_allclose(a, jnp.broadcast_to(b, a.shape), atol=1e-6), got, expected)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [dr.Sphere, dr.Box])
def test_a_profile_drawn_out_is_its_twin_in_the_plane(kind):
    """A ball, or a box that is wide across, that bounces, slides and turns over the same ground."""
    x, v, w, mass, inertia = (0.7, 1.2), (0.8, -0.5), -3.0, 1.3, 0.02
    round_ones = dr.Disc(radius=0.2), dr.Sphere(radius=0.2)
    boxes = dr.Box(half=(0.25, 0.15)), dr.Box(half=(0.25, 0.3, 0.15))
    flat_shape, deep_shape = round_ones if kind is dr.Sphere else boxes
    body = dr.Body(flat_shape, mass=mass, inertia=inertia, x=x, v=v, w=w)
    ground = dr.Static(dr.Profile(points=LINE))
    made = dr.scene({"body": body, "ground": ground}, gravity=(0.0, -G), restitution=0.5, friction=0.3)
    flat = dr.rollout(*made, dt=1 / 60, steps=48).state
    drawn = np.repeat(LINE[:, 1:], 5, axis=1)
    ground = dr.Static(dr.HeightField(heights=drawn, spacing=0.5, cells=3))
    start = (x[0], 1.1, x[1]), (v[0], 0.0, v[1])
    made = scene_of(ground, deep_shape, *start, 0.5, 0.3, w=(0.0, -w, 0.0), inertia=(inertia,) * 3)
    deep = dr.rollout(*made, dt=1 / 60, steps=48).state
    assert abs(flat.w[-1, 0, 0] - w) > 0.1  # it was struck
    assert_allclose(deep.x[:, 0, ::2], flat.x[:, 0], atol=1e-7)
    assert_allclose(deep.v[:, 0, ::2], flat.v[:, 0], atol=1e-6)
    assert_allclose(-deep.w[:, 0, 1], flat.w[:, 0, 0], atol=1e-5)


# ---- how it is given, read and drawn


def test_mistakes_are_named():
    ball = dr.Body(dr.Sphere(radius=0.1), mass=1.0, x=(0.0, 0.0, 1.0))

    def on(**fields):
        return dr.scene(
            {"ball": ball, "ground": dr.Static(dr.HeightField(**{"heights": BUMPS, "spacing": 0.5} | fields))}
        )

    for fields, message in (
        ({"spacing": 0.0}, r"ground.shape.spacing is 0.0 m: expected above 0"),
        ({"heights": BUMPS[:1]}, r"ground.shape.heights has shape \(1, 8\): expected \(R, C\), both above 1"),
        ({"heights": BUMPS[0]}, r"ground.shape.heights has shape \(8,\): expected \(R, C\)"),
        ({"heights": BUMPS * np.nan}, r"ground.shape.heights is not finite"),
        ({"cells": 0}, r"ground.shape.cells is 0: expected an integer above 0"),
        ({"cells": 1, "spacing": 0.05}, r"ground.shape.cells is 1: expected 3 or more, or leave it out"),
    ):
        with pytest.raises(ValueError, match=message):
            on(**fields)
    with pytest.raises(ValueError, match=r"ground.shape.spacing .* is traced.* give the HeightField cells="):
        jax.jit(lambda spacing: on(spacing=spacing)[1].x)(0.5)
    assert jax.jit(lambda spacing: on(spacing=spacing, cells=2)[0].shapes[1].spacing)(0.5) == 0.5
    with pytest.raises(ValueError, match="ball.shape is a HeightField, which has no mass: make ball a Static"):
        dr.scene({"ball": dr.Body(dr.HeightField(heights=BUMPS, spacing=0.5), mass=1.0, x=(0.0, 0.0, 1.0))})
    with pytest.raises(ValueError, match="ground.shape is a HeightField of 3D"):
        dr.scene({"ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0)), "ground": dr.replace(FLAT, x=None)})


def test_it_is_read_from_a_file_and_drawn(tmp_path):
    file = tmp_path / "hills.toml"
    rows = ", ".join(str(list(row)) for row in BUMPS.tolist())
    file.write_text(
        "[bodies.ball]\nshape = { sphere = { radius = 0.2 } }\nmass = 1.0\nx = [2.0, 2.0, 1.0]\n\n"
        f"[statics.hills]\nshape = {{ height_field = {{ heights = [{rows}], spacing = 0.5 }} }}\n"
    )
    scene = read_scene(file)
    field = jax.tree.map(lambda leaf: leaf[0], scene.world.shapes[1])
    assert_allclose(field.heights, BUMPS)
    lines = dr.view.outline(field, 3)
    assert len(lines) == 17
    for line in lines:
        i, j = np.rint(line[:, :2] / 0.5).astype(int).T
        assert_allclose(line[:, 2], BUMPS[i, j])
    drawn = next(shape for shape in shapes(scene.world) if shape["body"] == 1)
    corners = np.array(drawn["points"])[np.array(drawn["faces"])]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert_allclose(up[:, 2], 0.25)  # each half a cell, seen from above
    trajectory = dr.Trajectory(
        t=jnp.arange(2.0), state=jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), scene.state), world=scene.world
    )
    assert not len(contacts(trajectory, np.arange(2.0)).t)
    assert "height" not in dr.play(trajectory).page[:100]
