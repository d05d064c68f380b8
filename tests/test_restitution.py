"""Restitution that falls with the speed of the impact, against closed forms, and its fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import vector, with_slopes
from numpy.testing import assert_allclose

import diffrigid as dr

G, RADIUS = 9.81, 0.1
EXACT = 1e-9


def restitution_at(e, c, u):
    return e * (1 + c * u) ** (-0.25)


def drop(dim, h, e, c, **at):
    """Height of a ball at the top of its first bounce, above where it touches the floor."""
    up = vector(*[0.0] * (dim - 1), 1.0)
    shape = (dr.Disc if dim == 2 else dr.Sphere)(radius=RADIUS)
    bodies = {
        "ball": dr.Body(shape, mass=1.3, x=(RADIUS + h) * up, restitution_falloff=c),
        "floor": dr.Static(dr.HalfSpace(normal=up)),
    }
    world, state = dr.scene(bodies, gravity=-G * up, restitution=e)
    u = jnp.sqrt(2 * G * h)
    top = u / G * (1 + jax.lax.stop_gradient(restitution_at(e, c, u)))
    times = jnp.stack([jnp.zeros_like(top), top])
    return dr.rollout(world, state, dt=1 / 60, times=times, substeps=(60,)).state.x[-1, 0] @ up - RADIUS


@pytest.mark.parametrize("dim, derivative", [(2, jax.jacrev), pytest.param(3, jax.jacfwd, marks=pytest.mark.slow)])
def test_bounces_of_several_drops(dim, derivative):
    """e^2 h with e at the speed of each, and slopes by height, restitution and fall-off."""
    got = with_slopes(lambda h, e, c: drop(dim, h, e, c), derivative)
    expected = with_slopes(lambda h, e, c: restitution_at(e, c, jnp.sqrt(2 * G * h)) ** 2 * h, derivative)
    for h, c in ((0.02, 0.0), (0.3, 0.5), (1.0, 0.5), (2.0, 3.0)):  # 0 is constant
        jax.tree.map(lambda a, b: assert_allclose(a, b, atol=EXACT), got(h, 0.9, c), expected(h, 0.9, c))


@pytest.mark.parametrize("own, of_pair", [((0.4, 1.0), 0.7), ((0.4, None), 0.4), ((None, None), 0.2)])
def test_two_bodies_take_the_mean_or_the_one_that_was_given(own, of_pair):
    a, b = (
        dr.Body(dr.Disc(radius=RADIUS), mass=1.0, x=(x, 0.0), v=(v, 0.0), restitution_falloff=c)
        for x, v, c in zip((-0.5, 0.5), (1.5, -1.5), own, strict=True)
    )
    world, state = dr.scene({"a": a, "b": b}, restitution=0.8, restitution_falloff=0.2)
    v = dr.rollout(world, state, dt=1 / 60, steps=30).state.v[-1, :, 0]
    assert_allclose(v, np.array([-1.5, 1.5]) * restitution_at(0.8, of_pair, 3.0), rtol=EXACT)


def test_a_fit_finds_both_numbers():
    """From one ball that bounces on and on, so at ever lower speeds; 1 mm of noise."""

    def scene(e, c):
        up = np.array([0.0, 1.0])
        ball = dr.Body(dr.Disc(radius=RADIUS), mass=1.0, x=(RADIUS + 2.0) * up)
        bodies = {"ball": ball, "floor": dr.Static(dr.HalfSpace(normal=up))}
        return dr.scene(bodies, gravity=-G * up, restitution=e, restitution_falloff=c)

    height = np.asarray(dr.rollout(*scene(0.95, 0.15), dt=1 / 60, steps=240).state.x[:, 0])
    noisy = height + 1e-3 * np.random.default_rng(0).standard_normal(height.shape)
    free = {"restitution": dr.interval(0, 1), "restitution_falloff": dr.positive()}
    fit = dr.fit(*scene(0.9, 0.1), {"t": np.arange(241) / 60, "ball.x": noisy}, free=free, starts=1, progress=False)
    for name, truth in (("restitution", 0.95), ("restitution_falloff", 0.15)):
        parameter = fit[name]
        assert abs(parameter.value - truth) < parameter.high - parameter.low < 0.1 * truth, name
    assert "s/m" in repr(fit)


@pytest.mark.parametrize("early", [-1e-14, 0.0, 1e-14])
def test_an_impact_at_the_end_of_a_step_rebounds_beside_a_floor(early):
    """Discs that rest on it, which their weight does not press together: v (1 - e) / 2 and v (1 + e) / 2."""
    disc = dr.Disc(radius=0.1)
    bodies = {
        "a": dr.Body(disc, mass=1.0, x=(0.0, 0.1), v=(0.2, 0.0)),
        "b": dr.Body(disc, mass=1.0, x=(0.21 * (1 + early), 0.1)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    run = dr.rollout(*dr.scene(bodies, gravity=(0.0, -9.81), restitution=0.5), dt=1 / 60, steps=6)
    assert_allclose(run.state.v[-1], [[0.05, 0.0], [0.15, 0.0]], atol=1e-9)
