"""Friction against rolling and spinning, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import vector, with_slopes
from motions import sums
from numpy.testing import assert_allclose

import diffrigid as dr

G, RADIUS, MASS = 9.81, 0.3, 1.3
EXACT = 1e-9
SHARE = {2: 0.5, 3: 0.4}  # I / (m r^2)


def ball(dim, v=0.0, w=0.0, height=RADIUS, down=0.0):
    """A disc or sphere that moves with v along the floor, turns forwards with w, and falls with `down`."""
    up, ahead = np.eye(dim)[-1], np.eye(dim)[0]
    shape = (dr.Disc if dim == 2 else dr.Sphere)(radius=RADIUS)
    turn = -w if dim == 2 else vector(0.0, 1.0, 0.0) * w
    return dr.Body(shape, mass=MASS, x=height * up, v=v * ahead - down * up, w=turn)


def floor(dim):
    return dr.Static(dr.HalfSpace(normal=np.eye(dim)[-1]))


def at(t, scene, steps=60):
    world, state = scene
    times = jnp.stack([jnp.zeros_like(t), t])
    states = dr.rollout(world, state, dt=1 / steps, times=times, substeps=(steps,)).state
    return jax.tree.map(lambda leaf: leaf[-1, 0], states)


def check_with_slopes(got, expected, cases, derivative):
    """Two functions of the same numbers, and their slopes."""
    programs = with_slopes(got, derivative), with_slopes(expected, derivative)
    for case in cases:
        jax.tree.map(lambda a, b: assert_allclose(a, b, atol=EXACT), *(run(*case) for run in programs))


def rolling(dim, mu, c, v, slope, t, about=0.0, w=0.0):
    """Way of a ball on a plane that falls ahead by `slope`, which it does not leave, and its turn about the normal.

    Args:
        about: [m] spinning friction, in space. w: [rad/s] with which it spins.
    """
    ahead, up = np.eye(dim)[0], np.eye(dim)[-1]
    rolls = ball(dim, v, jnp.where(mu > 0.4, v / RADIUS, 0.0))
    if dim == 3:
        rolls = dr.replace(rolls, w=rolls.w + w * up)
    gravity = G * (jnp.sin(slope) * ahead - jnp.cos(slope) * up)
    kinds = {"rolling_friction": c} | ({"spinning_friction": about} if dim == 3 else {})
    end = at(t, dr.scene({"ball": rolls, "floor": floor(dim)}, gravity=gravity, friction=mu, **kinds))
    return jnp.stack([end.x[0], 2 * jnp.arctan2(end.q[-1], end.q[0])])


def rolls(dim, mu, c, v, slope, t):
    """Rolling from the start, under the torque c m g cos(slope), which can only stop it."""
    braking = G * (c / RADIUS * jnp.cos(slope) - jnp.sin(slope)) / (1 + SHARE[dim])
    moves = jnp.minimum(t, v / braking) if v > 0 else t if braking < 0 else 0.0
    return v * moves - 0.5 * braking * moves**2


def rolls_back(dim, mu, c, v, slope, t):
    """Up a slope until it stops, and down again against the same torque."""
    stop = v * (1 + SHARE[dim]) / (G * (c / RADIUS * jnp.cos(slope) - jnp.sin(slope)))
    back = G * (c / RADIUS * jnp.cos(slope) + jnp.sin(slope)) / (1 + SHARE[dim])
    return 0.5 * v * stop + 0.5 * back * (t - stop) ** 2


def slips_and_rolls(dim, mu, c, v, slope, t):
    """From no turning: r w grows by (mu - c / r) g cos(slope) / (I / m r^2) until it is v."""
    braking = G * (mu * jnp.cos(slope) - jnp.sin(slope))
    slips = v / (braking + G * jnp.cos(slope) * (mu - c / RADIUS) / SHARE[dim])
    way = v * slips - 0.5 * braking * slips**2
    return way + rolls(dim, mu, c, v - braking * slips, slope, t - slips)


def slips_both_ways(dim, mu, c, v, slope, t):
    """Up a slope that is too steep for rolling: the slip falls to zero, and goes on the other way."""
    up, rub, torque = -jnp.sin(slope), mu * jnp.cos(slope), c / RADIUS * jnp.cos(slope)
    slips = v / G / (rub + up + (rub - torque) / SHARE[dim])
    there, then = v - G * (rub + up) * slips, t - slips
    return 0.5 * (v + there) * slips + there * then - 0.5 * G * (up - rub) * then**2


CASES = {
    "rolls on": (rolls, (0.5, 0.02, 1.0, 0.0, 1.0)),
    "stops within a step": (rolls, (0.5, 0.1, 1.0, 0.0, 0.97)),
    "turns back on a slope": (rolls_back, (0.5, 0.02, 1.0, -0.25, 1.0)),
    "slips at first": (slips_and_rolls, (0.3, 0.02, 3.0, 0.0, 1.0)),
    "slips both ways up a slope": (slips_both_ways, (0.1, 0.005, 3.0, -0.5, 0.6)),
    "is held on a slope": (rolls, (0.5, 0.29 * RADIUS, 0.0, 0.28, 1.0)),
    "rolls down a slope": (rolls, (0.5, 0.27 * RADIUS, 0.0, 0.28, 1.0)),
}


def spins(about, w, t):
    """Turned about the normal until t: it stops after I w / (about m g)."""
    braking = about * G / (SHARE[3] * RADIUS**2)
    turns = jnp.minimum(t, w / braking)
    return w * turns - 0.5 * braking * turns**2


SPINS = {"spins on": (0.004, 2.0, 1.0), "stops spinning within a step": (0.02, 2.0, 0.97)}


def motions(dim, derivative, rows):
    """Of balls on a plane, and their slopes by all numbers, compiled once."""
    run = with_slopes(lambda *row: rolling(dim, *row), derivative)
    values, slopes = zip(*(run(*row) for row in rows), strict=True)
    return np.stack(values), np.array(slopes)


def check_ways(dim, values, slopes):
    for (name, (law, row)), value, slope in zip(CASES.items(), values[:, 0], slopes[:, :5, 0], strict=True):
        true_slope = jnp.stack(jax.jacfwd(law, tuple(range(1, 6)))(dim, *row))
        seen = np.array([True, True, row[2] > 0.0, True, True])  # at rest the slope by speed has two sides
        assert_allclose(value, law(dim, *row), atol=EXACT, err_msg=name)
        assert_allclose(slope[seen], true_slope[seen], atol=EXACT, err_msg=name)


@pytest.mark.slow
def test_a_disc_on_a_plane():
    """Cases, and slopes by both frictions, speed, slope and time, in reverse mode."""
    check_ways(2, *motions(2, jax.jacrev, [row for _, row in CASES.values()]))


def test_a_ball_on_a_plane():
    """The same cases and two that spin on the spot, and slopes, in forward mode."""
    rows = [(*row, 0.01, 0.0) for _, row in CASES.values()] + [
        (0.5, 0.0, 0.0, 0.0, t, c, w) for c, w, t in SPINS.values()
    ]
    values, slopes = motions(3, jax.jacfwd, rows)
    check_ways(3, values[: len(CASES)], slopes[: len(CASES)])
    for (name, row), value, slope in zip(SPINS.items(), values[len(CASES) :], slopes[len(CASES) :], strict=True):
        assert_allclose(value[1], spins(*row), atol=EXACT, err_msg=name)
        assert_allclose(slope[np.array([5, 6, 4]), 1], jax.jacfwd(spins, (0, 1, 2))(*row), atol=EXACT, err_msg=name)


@pytest.mark.slow
def test_an_impact_stops_some_of_the_turning():
    """By at most the coefficient times the normal impulse."""

    def turn(c, w, e):
        spinning = dr.replace(ball(2, height=1.0, down=2.0), w=w)
        scene = dr.scene({"ball": spinning, "floor": floor(2)}, restitution=e, rolling_friction=c)
        return at(jnp.asarray(0.5), scene).w[0]

    def expected(c, w, e):
        return jnp.maximum(w - c * (1 + e) * 2.0 / (SHARE[2] * RADIUS**2), 0.0)

    check_with_slopes(turn, expected, [(0.01, 3.0, 0.6), (0.1, 3.0, 0.6)], jax.jacfwd)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_energy_falls_and_momenta_are_kept(dim):
    """Two bodies that meet with spin, with restitution and without."""

    def scene(e, turn):
        other = dr.Box(half=(0.2, 0.3)) if dim == 2 else dr.Sphere(radius=0.25)
        w = turn if dim == 2 else turn * vector(1.0, -0.5, 2.0)
        a = dr.replace(ball(dim, 1.5, 2.0, 0.1), w=w)
        b = dr.Body(other, mass=0.8, x=1.2 * np.eye(dim)[0], v=-1.0 * np.eye(dim)[0], w=-0.5 * w)
        kinds = {"rolling_friction": 0.03} | ({} if dim == 2 else {"spinning_friction": 0.02})
        return dr.scene({"a": a, "b": b}, restitution=e, friction=0.4, **kinds)

    worlds, states = jax.vmap(scene)(jnp.array([0.0, 0.6, 0.6]), jnp.array([2.0, 2.0, -4.0]))
    path = dr.rollout_batch(worlds, states, dt=1 / 60, steps=45)
    p, L, energy = jax.vmap(jax.vmap(sums, (None, 0)))(worlds, path)
    assert_allclose(p, np.broadcast_to(p[:, :1], p.shape), atol=1e-12)
    assert_allclose(L, np.broadcast_to(L[:, :1], L.shape), atol=1e-10)
    assert (np.diff(energy, axis=1) < 1e-8 * energy[:, :1]).all()
    assert (energy[:, -1] < 0.9 * energy[:, 0]).all()


def test_mistakes_are_named():
    bodies = {"ball": ball(2), "floor": floor(2)}
    with pytest.raises(ValueError, match="rolling_friction is -1: expected 0 or above"):
        dr.scene(bodies, rolling_friction=-1.0)
    with pytest.raises(ValueError, match="in 2D nothing turns about a normal; give rolling_friction"):
        dr.scene(bodies, spinning_friction=0.1)


@pytest.mark.slow
def test_two_contacts_share_the_friction_against_turning():
    """A capsule that lies on a floor and rolls sideways, or spins about the vertical: its way, and its turn."""
    r, time, ground = 0.1, 0.4, {"floor": floor(3)}

    def motion(c, w, spin, mu):
        capsule = dr.Body(
            dr.Capsule(radius=r, half_length=0.3), mass=MASS, inertia=(0.4 * MASS * r**2, 0.05, 0.05), x=(0.0, 0.0, r),
            v=vector(0.0, -r * w, 0.0), w=vector(w, 0.0, spin),
        )  # fmt: skip
        kinds = {"rolling_friction": c, "spinning_friction": 2.0 * c}
        world, state = dr.scene({"capsule": capsule} | ground, gravity=(0.0, 0.0, -G), friction=mu, **kinds)
        end = jax.tree.map(lambda leaf: leaf[-1, 0], dr.rollout(world, state, dt=1 / 60, steps=24).state)
        return jnp.stack([end.x[1], *(2.0 * jnp.arctan2(end.q[k], end.q[0]) for k in (1, 3))])

    def expected(c, w, spin, mu):
        del mu
        rolled = w * time - jnp.sign(w) * 0.5 * c * G / (1.4 * r**2) * time**2
        spun = spin * time - jnp.sign(spin) * 0.5 * 2.0 * c * MASS * G / 0.05 * time**2
        return jnp.stack([-r * rolled, rolled, spun])

    for case in ((0.005, 5.0, 0.0, 0.5), (0.005, 0.0, 3.0, 0.0)):
        assert_allclose(motion(*map(jnp.asarray, case)), expected(*case), atol=EXACT)
