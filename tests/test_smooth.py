"""Contact(width > 0): Newton's law at a slightly larger distance, which a near miss feels too."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import PAIR, disc_and_plane, final, made, steps_near, two_boxes, two_discs, with_slopes
from jax.flatten_util import ravel_pytree
from marks import some_later
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.contact.impact import meet_on_line

ROUNDING = 1e-12  # relative: a few hundred operations
EXACT = 1e-9  # relative: rounding of a few hundred steps
DISCS = PAIR | dict(ra=0.2, rb=0.2, xa=0.0, ya=0.0, xb=1.0, yb=0.1, vxa=2.0, vya=0.0, vxb=0.0, vyb=0.0, wa=1.0, wb=-2.0)
BOXES = dict(
    e=0.8, mu=0.0, xa=0.0, ya=0.0, xb=1.2, yb=0.1, vxa=2.0, vya=0.0, vxb=0.0, vyb=0.0, angle_a=0.2, angle_b=-0.5, wa=0.5, wb=1.0
)  # fmt: skip
PASSES = {
    "discs": (two_discs, DISCS, dict(yb=0.45)),
    "boxes": (two_boxes, BOXES, dict(yb=0.75)),
}  # scene, hit, near miss


def smoothed(world, width):
    return dataclasses.replace(world, contact=dataclasses.replace(world.contact, width=jnp.asarray(width)))


def run(make, parameters, width, t=1.0):
    """World, states at 0 and t, and the Jacobian of the latter by all float leaves, outputs in front."""
    world, start = made(make, parameters)
    world = smoothed(world, width)
    blocks, dt = steps_near(t, 60)
    end, by_leaf = final(world, start, dt, blocks)
    return world, start, ravel_pytree(start)[1](end), jax.vmap(ravel_pytree((world, start))[1])(by_leaf)


def total(law, world, state):
    return np.asarray(law(world.bodies, state).sum(0))


@some_later("kind", PASSES, "discs")
@pytest.mark.parametrize("width", [0.003, 0.03, 0.3])
@pytest.mark.parametrize("path", ["hit", "near miss"])
def test_momentum_is_kept_and_no_energy_made(kind, width, path):
    make, hit, miss = PASSES[kind]
    for material in (dict(e=1.0, mu=0.0), dict(e=1.0, mu=0.5), dict(e=0.3, mu=0.5)):
        p = hit | material | (miss if path == "near miss" else {})
        world, start, end, _ = run(make, p, width)
        assert_allclose(total(dr.momentum, world, end), total(dr.momentum, world, start), atol=10 * ROUNDING)
        ratio = total(dr.kinetic_energy, world, end) / total(dr.kinetic_energy, world, start)
        assert ratio < 1 + ROUNDING
        if material["e"] == 1.0 and material["mu"] == 0.0:
            assert_allclose(ratio, 1.0, rtol=ROUNDING)


def test_error_of_a_full_hit_falls_exponentially():
    """Like width * exp(-depth / width), with the depth of the exact paths, (R^2 - offset^2) / 2 R."""
    _, _, exact, _ = run(two_discs, DISCS, 0.0)
    depth = (0.4**2 - 0.1**2) / 0.8
    widths = depth / np.array([6.0, 8.0, 10.0, 12.0])
    errors = [np.abs(run(two_discs, DISCS, width)[2].x - exact.x).max() for width in widths]
    slope = np.polyfit(1 / widths, np.log(errors / widths), 1)[0]
    assert_allclose(slope, -depth, rtol=1e-2)  # corrections of order exp(-6)
    assert 1e-7 < errors[-1] < 1e-5 < errors[0] < 1e-2


@some_later("kind", PASSES, "discs")
def test_small_width_is_exact(kind):
    make, hit, miss = PASSES[kind]
    for p in (hit, hit | miss):
        exact, exact_jac = run(make, p, 0.0)[2:]
        narrow, narrow_jac = run(make, p, 1e-4)[2:]  # hits and misses by more than a hundred widths
        jax.tree.map(lambda a, b: assert_allclose(a, b, atol=EXACT), narrow, exact)
        jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-6), narrow_jac[1], exact_jac[1])


@pytest.mark.parametrize("kind", ["discs", pytest.param("boxes", marks=pytest.mark.slow)])
def test_near_miss_moves_the_target(kind):
    """The target moves, and aiming closer moves it more; at width 0 neither."""
    make, hit, miss = PASSES[kind]
    p = hit | miss | dict(mu=0.0)
    target, y = 1, 1
    row = 2 * target + y  # of the flat outputs: x[target, y]
    _, start, end, jac = run(make, p, 0.05)
    assert end.x[target, y] - start.x[target, y] > 0.01
    assert jac[1].x[row, 0, y] > 0.01  # d(y of the target) / d(y of the shot), aimed from below
    assert jac[1].v[row, 0, y] > 0.01
    h = 1e-5
    ahead, behind = (run(make, p | dict(vya=step), 0.05)[2].x[target, y] for step in (h, -h))
    assert_allclose(jac[1].v[row, 0, y], (ahead - behind) / (2 * h), rtol=1e-5)  # h^2, and rounding / h
    _, start, end, jac = run(make, p, 0.0)
    free = start.x[target] + jnp.asarray([p["vxb"], p["vyb"]])
    assert_allclose(end.x[target], free, atol=EXACT)
    assert_allclose(jac[1].x[row, 0], 0.0, atol=0.0)
    assert_allclose(jac[1].v[row, 0], 0.0, atol=0.0)


def box_and_plane(e, y, vy, g):
    box = dr.Body(dr.Box(half=(0.1, 0.1)), mass=1.0, x=jnp.stack([0.0, y]), v=jnp.stack([0.0, vy]))
    bodies = {"box": box, "plane": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}
    return dr.scene(bodies, gravity=jnp.stack([0.0, -g]), restitution=e)


@pytest.mark.parametrize("make", [disc_and_plane, pytest.param(box_and_plane, marks=pytest.mark.slow)])
def test_what_turns_back_before_the_plane_feels_it(make):
    """Thrown at a plane from which gravity pulls away, it comes within 2 cm; a speed too low by that misses."""
    miss = dict(e=1.0, y=1.12, vy=-2.0, g=-2.0)  # gap_min = 1.02 - vy^2 / 2 g = 0.02 m; turns after 1 s
    _, _, exact, jac = run(make, miss, 0.0, 1.5)
    assert_allclose(exact.x[0, 1], 1.12 - 2.0 * 1.5 + 1.5**2, atol=EXACT)
    _, _, end, smooth_jac = run(make, miss, 0.02, 1.5)
    level = 0.02 * np.log1p(np.exp(1.0))  # width softplus(gap_min / width)
    speed = np.sqrt(4.0 - 4.0 * (1.02 - level))
    hit = (2.0 - speed) / 2.0
    since = 1.5 - hit
    assert_allclose(end.x[0, 1], 0.1 + level + speed * since + since**2, atol=EXACT)
    assert_allclose(jac[0].bodies.restitution[1], 0.0, atol=0.0)
    by_restitution = smooth_jac[0].bodies.restitution[1, 0] + smooth_jac[0].statics.restitution[1, 0]  # of both sides
    assert_allclose(by_restitution, speed * since, rtol=EXACT)


def test_annealing_compiles_once():
    traces = []

    @jax.jit
    def end(world, state):
        traces.append(None)
        return dr.rollout(world, state, dt=1 / 60, steps=6).state.x[-1]

    world, state = made(two_discs, DISCS | dict(xb=0.45))
    ends = [end(smoothed(world, width), state) for width in (0.2, 0.05, 0.01, 0.0)]
    assert len(traces) == 1
    assert np.abs(ends[0] - ends[-1]).max() > 1e-3


def test_a_disc_that_just_misses_a_corner_is_turned_as_by_a_larger_one():
    """Normal and time at the distance radius + level, level = width softplus(gap_min / width), and their slopes."""
    r, width, speed, e = 0.1, 0.02, 2.0, 0.7

    def simulated(miss):
        x = jnp.stack([-0.3, r + miss])
        disc = dr.Body(dr.Disc(radius=r), mass=1.0, x=x, v=(speed, 0.0))
        corner = dr.Static(dr.Box(half=(0.5, 0.5)), x=(0.0, -np.sqrt(0.5)), angle=np.pi / 4)  # at the origin
        world, state = dr.scene({"disc": disc, "corner": corner}, restitution=e, contact=dr.Contact(width=width))
        return dr.rollout(world, state, dt=1 / 60, steps=15).state.v[-1, 0]

    def expected(miss):
        R = r + width * jnp.logaddexp(miss / width, 0.0)
        n = jnp.stack([-jnp.sqrt(R**2 - (r + miss) ** 2), r + miss]) / R
        return jnp.stack([speed, 0.0]) - (1.0 + e) * speed * n[0] * n

    found, right = with_slopes(simulated), with_slopes(expected)
    for miss in (-0.01, 0.005, 0.02):
        jax.tree.map(lambda a, b: assert_allclose(a, b, atol=EXACT), found(miss), right(miss))


BOX = dict(shape=dr.Box(half=(0.2, 0.15)), y=0.36, angle=0.6)
PATHS = {  # shape and spin of what comes along the x axis, and what it passes
    "disc and box": (dr.Disc(radius=0.1), 0.0, BOX),
    "two capsules": (dr.Capsule(radius=0.05, half_length=0.1), 0.0, dict(shape=dr.Disc(radius=0.2), y=0.3, angle=0.0)),
    "two boxes": (dr.Box(half=(0.1, 0.1)), 3.0, BOX | dict(y=0.31, angle=0.3)),
}


def passed(since, kind, width):
    """Velocities (linear, angular) at 0.6 s, of what began its path `since` [s] earlier."""
    shape, spin, other = PATHS[kind]
    x, v, angle = jnp.stack([-2.0 * since, 0.0]), (2.0, 0.0), 0.5 - spin * since
    a = dr.Body(shape, mass=1.0, x=x, v=v, angle=angle, w=spin)
    b = dr.Body(other["shape"], mass=0.7, x=(0.7, other["y"]), angle=other["angle"])
    world, state = dr.scene({"a": a, "b": b}, restitution=0.8, friction=0.3, contact=dr.Contact(width=width))
    end = jax.tree.map(lambda leaf: leaf[-1], dr.rollout(world, state, dt=1 / 60, steps=36).state)
    return jnp.concatenate([end.v, end.w], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["disc and box", "two capsules", "two boxes"])
def test_the_phase_of_the_step_does_not_matter(kind):
    """What is struck and how does not depend on where on their paths steps begin, nor do its slopes."""

    def with_slope(since):
        return jax.jvp(lambda since: passed(since, kind, 0.01), (since,), (1.0,))

    ends, slopes = jax.jit(jax.vmap(with_slope), compiler_options=dr.QUICK)(jnp.linspace(0.0, 1 / 30, 41))
    assert np.abs(ends[0, 1]).max() > 0.01  # the other was struck
    assert_allclose(ends, np.broadcast_to(ends[0], ends.shape), atol=EXACT)
    assert_allclose(slopes, 0.0, atol=EXACT)


@pytest.mark.slow
def test_corners_that_turn_round_within_the_level_have_slopes():
    """Two pentagons begin a step nearer than their level, part, and come together again by their spins."""
    angles = 0.4 * np.pi * np.arange(5)
    shape = dr.Polygon(vertices=0.2 * np.stack([np.cos(angles), np.sin(angles)], 1))
    bodies = {
        "a": dr.Body(shape, mass=1.0, inertia=0.01, x=(0.0, 0.0), angle=5.46, w=-1.55),
        "b": dr.Body(shape, mass=1.0, inertia=0.01, x=(0.35, 0.09), v=(0.36, 0.08), angle=2.31, w=-3.26),
    }
    world, state = dr.scene(bodies, restitution=0.5, contact=dr.Contact(width=0.02))

    def velocities(spin):
        after = dr.step(world, dr.replace(state, w=state.w.at[0, 0].set(spin)), 1 / 60)
        return jnp.concatenate([after.v.ravel(), after.w.ravel()])

    program = with_slopes(velocities)
    (_, (slopes,)), (low, _), (high, _) = (program(spin) for spin in (-1.55, -1.55 - 1e-6, -1.55 + 1e-6))
    assert_allclose(slopes, (high - low) / 2e-6, atol=1e-7)


TUMBLING = np.array(  # place of the second box, orientations, velocity of the second, spins
    [
        [-0.17, -0.35, 0.08, -0.65, 1.3, -0.1, -0.7, 0.75, 0.7, 1.5, -1.0, 1.3, 1.7, -0.8, -1.6, -0.6, -3.2, 7.1, 6.4, 1.2],
        [-0.19, -0.27, 0.19, 0.05, 0.3, 1.3, -1.4, -2.1, 1.8, 1.4, 0.2, 1.5, 1.3, -1.4, -3.6, 8.1, 1.7, 6.6, 2.4, 0.7],
        [-0.28, -0.02, 0.14, -0.05, -1.2, 0.2, -0.6, -0.75, 1.9, -1.3, 1.7, 3.3, -0.7, -1.7, -2.3, -3.6, 7.0, -0.5, 4.6, 2.3],
        [-0.27, -0.22, 0.23, 1.7, -0.6, 0.0, 0.2, 0.35, 0.0, 0.3, -0.2, 2.9, 1.1, -1.7, -1.5, -1.3, 0.8, -0.1, -1.9, -1.0],
    ]
)  # fmt: skip


@pytest.mark.slow
def test_boxes_whose_paths_sink_into_each_other_have_slopes():
    """Where the predicted paths come closest, other corners and crossings touch than before; their depth has no jumps."""
    box = dr.Box(half=(0.2, 0.15, 0.1))
    bodies = {"a": dr.Body(box, mass=1.0, x=(0.0, 0.0, 0.0)), "b": dr.Body(box, mass=1.0, x=(1.0, 0.0, 0.0))}
    world, start = dr.scene(bodies, restitution=0.5, contact=dr.Contact(width=0.02))

    def velocities(row):
        q = row[3:11].reshape(2, 4)
        state = dr.replace(
            start, x=start.x.at[1].set(row[:3]), q=q / jnp.linalg.norm(q, axis=1)[:, None],
            v=start.v.at[1].set(row[11:14]), w=row[14:].reshape(2, 3),
        )  # fmt: skip
        after = dr.step(world, state, 1 / 60)
        return jnp.concatenate([after.v.ravel(), after.w.ravel()])

    spins = np.tile(np.repeat([0.0, 1.0], [14, 6]), (len(TUMBLING), 1))
    program = jax.jit(jax.vmap(lambda row, way: jax.jvp(velocities, (row,), (way,))))
    (_, slopes), (low, _), (high, _) = (program(TUMBLING + step * spins, spins) for step in (0.0, -1e-6, 1e-6))
    assert_allclose(slopes, (high - low) / 2e-6, atol=1e-7)


@pytest.mark.slow
def test_crossed_rods_strike_by_the_depth_of_their_rounding():
    """The axes of the predicted paths cross, so that they come as close as minus the sum of the radii."""
    rod, width = dr.Capsule(radius=0.05, half_length=0.2), 0.02
    across, down = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)), (0.0, 0.0, -2.0)
    bodies = {
        "a": dr.Body(rod, mass=1.0, x=(0.0, 0.0, 0.0)),
        "b": dr.Body(rod, mass=1.0, x=(0.1, 0.05, 0.12), q=across, v=down),
    }
    world, state = dr.scene(bodies, restitution=0.5, contact=dr.Contact(width=width))
    passing, _ = dr.scene(bodies, ignore=[("a", "b")])
    for spin in ((0.0, 0.0, 0.0), (0.0, 1.0, 1.0), (0.0, -1.0, 1.0)):
        turning, dt = dr.replace(state, w=state.w.at[1].set(jnp.array(spin))), 1 / 60
        after = dr.step(world, turning, dt)
        (z, v), (z_after, v_after) = ((s.x[1, 2], s.v[1, 2]) for s in (turning, after))
        at = dr.step(passing, turning, float((z_after - z - v_after * dt) / (v - v_after)))
        assert_allclose(dr.gap(world, at, "a", "b"), width * np.log1p(np.exp(-0.1 / width)), rtol=1e-6)


@pytest.mark.parametrize("speed", [1e-3, 1e-8, 1e-10, 1e-12, 1e-20, 0.0])
@pytest.mark.parametrize("width", [0.0, 0.01])
def test_slopes_of_discs_that_hardly_move_are_finite_in_single_precision(speed, width):
    """Where the square of the square of a speed is rounded to 0."""

    def meeting(P, W, R, width):
        s, level, _, closing = meet_on_line(P, W, R, width)
        return jnp.stack([jnp.where(s < 1.0, s, 0.0), level, closing])  # what does not meet soon has no part in a step

    numbers = (np.array([0.2, 0.0]), np.array([-speed, 0.0]), np.array(0.2), np.array(width))
    numbers = tuple(jnp.asarray(value, jnp.float32) for value in numbers)
    for jacobian in (jax.jacfwd, jax.jacrev):
        for slope in jax.jit(jacobian(meeting, (0, 1, 2, 3)))(*numbers):
            assert np.isfinite(slope).all()
