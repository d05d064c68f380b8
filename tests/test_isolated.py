"""Crowds of discs: impacts that are alone on their bodies go a faster way, to the same states and derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import with_slopes
from marks import some_later
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.contact import isolated
from diffrigid.contact.blocks import blocks_of, grouped, of_all, soonest, sum_of_met, where_allowed
from diffrigid.contact.slots import Table
from diffrigid.scan import MEMORY

STEPS = 24
OTHER = MEMORY - 1  # as much, but another program: it is traced anew
ROUNDING = 1e-9  # relative: of some dozen impacts, each of which magnifies it


def crowd(angle):
    """Five spinning discs that differ in everything, between three walls and a floor, on their way to each other."""
    rng = np.random.default_rng(3)
    bodies = {}
    for k in range(5):
        phi = 2 * np.pi * k / 5 + angle
        at, radius = np.array([np.cos(phi), np.sin(phi)]), 0.2 + 0.02 * k
        own = {"mass": 1.0 + 0.3 * k, "w": rng.normal(), "restitution": 0.7 if k == 2 else None}
        bodies[f"d{k}"] = dr.Body(dr.Disc(radius=radius), x=0.6 * at, v=-1.5 * at + rng.normal(size=2), **own)
    for k, n in enumerate([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]):
        bodies[f"wall{k}"] = dr.Static(dr.HalfSpace(normal=n, offset=-1.0))
    return dr.scene(bodies, gravity=(0.3, -9.81), restitution=0.9, friction=0.3, restitution_falloff=0.1)


def weighted(x):
    return (x * jnp.arange(1.0, 1.0 + x.size).reshape(x.shape)).sum()


@pytest.mark.slow
def test_slopes_of_the_fast_way_are_those_of_differences():
    """In reverse mode, of weighted final positions, along one direction for all leaves of the start."""
    world, state = crowd(0.4)
    assert isolated.goes_in_rounds(world)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def run(state):
        path = dr.rollout(world, state, dt=1 / 60, steps=STEPS).state
        return weighted(path.x[-1]), path.v[-1]

    along = jax.tree.map(lambda leaf: jnp.cos(jnp.arange(1.0, 1.0 + leaf.size)).reshape(leaf.shape), state)
    (_, v), slopes = run(state)
    assert (np.abs(v - state.v).max(1) > 0.5).all()  # each was struck
    there, back = (run(jax.tree.map(lambda a, d, h=h: a + h * d, state, along))[0][0] for h in (1e-7, -1e-7))
    products = jax.tree.leaves(jax.tree.map(lambda a, b: (a * b).sum(), slopes, along))
    assert_allclose(sum(products), (there - back) / 2e-7, rtol=1e-5)


@pytest.fixture(scope="module")
def worlds():
    pairs = [crowd(angle) for angle in (0.0, 0.4, 0.9)]
    return pairs[0][0], jax.tree.map(lambda *leaves: jnp.stack(leaves), *(state for _, state in pairs))


def heights(world, states, memory=MEMORY):
    end = dr.rollout_batch(world, states, dt=1 / 60, steps=STEPS, final_only=True, memory=memory)
    return weighted(end.x), end


@pytest.mark.slow
def test_the_fast_way_is_the_general_way(worlds, monkeypatch):
    """States, and reverse mode of one against forward mode of the other, along one direction for all leaves."""
    (_, end), grad = jax.value_and_grad(heights, argnums=(0, 1), has_aux=True)(*worlds)
    along = jax.tree.map(lambda leaf: jnp.cos(jnp.arange(1.0, 1.0 + leaf.size)).reshape(leaf.shape), worlds)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grad))
    monkeypatch.setattr(isolated, "CROWDED", np.inf)
    _, slope, expected = jax.jvp(functools.partial(heights, memory=OTHER), worlds, along, has_aux=True)
    assert (np.abs(end.v - worlds[1].v).max(2) > 0.5).all()  # each was struck
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=ROUNDING), end, expected)
    products = jax.tree.leaves(jax.tree.map(lambda a, b: (a * b).sum(), grad, along))
    assert_allclose(sum(products), slope, rtol=100 * ROUNDING)


@pytest.mark.slow
def test_spheres_go_the_fast_way_as_well(monkeypatch):
    """Four that tumble, of unequal principal inertias, between six walls."""
    rng = np.random.default_rng(5)
    walls = [dr.Static(dr.HalfSpace(normal=tuple(sign * n), offset=-1.0)) for sign in (1.0, -1.0) for n in np.eye(3)]
    places = 0.5 * np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)])
    bodies = {
        f"s{k}": dr.Body(
            dr.Sphere(radius=0.25), mass=1.0 + k, inertia=(0.02, 0.03, 0.04), x=x, v=-3.0 * x + rng.normal(size=3),
            w=rng.normal(size=3),
        )
        for k, x in enumerate(places)
    }  # fmt: skip
    world, state = dr.scene(bodies | {f"wall{k}": wall for k, wall in enumerate(walls)}, restitution=0.9, friction=0.3)
    assert isolated.goes_in_rounds(world)
    end = dr.rollout(world, state, dt=1 / 60, steps=2 * STEPS).state
    monkeypatch.setattr(isolated, "CROWDED", np.inf)
    expected = dr.rollout(world, state, dt=1 / 60, steps=2 * STEPS, memory=OTHER).state
    assert (np.abs(end.v[-1] - state.v).max(1) > 0.5).all()
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=ROUNDING), end, expected)


@some_later("mode", [jax.jacfwd, jax.jacrev], jax.jacfwd)
def test_a_disc_falls_on_a_disc_that_stands_still(mode):
    """Two bodies fall alike, but not one and a static: bounce height e^2 h over the top of a peg, and its slope."""

    def height(e, drop, x):
        bodies = {
            "ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=jnp.stack([x, 0.3 + drop])),
            "peg": dr.Static(dr.Disc(radius=0.2)),
        }
        world, state = dr.scene(bodies, gravity=(0.0, -9.81), restitution=e)
        duration = jnp.sqrt(2 * drop / 9.81) * (1 + e)
        return dr.rollout(world, state, dt=1 / 60, times=jnp.stack([0.0, duration]), substeps=(30,)).state.x[-1, 0, 1]

    value, slopes = with_slopes(height, mode)(0.8, 0.5, 0.0)
    assert_allclose(value, 0.3 + 0.64 * 0.5, rtol=1e-12)
    assert_allclose(slopes[:2], (2 * 0.8 * 0.5, 0.64), rtol=1e-9)


def test_more_discs_than_sweeps_strike_one_floor_in_a_step():
    """Each at a time of its own: x = speed t, rebound with e = 1/2 from there on."""
    speed, gap, dt = 1.0 + np.arange(6.0), 0.01 * np.arange(1.0, 7.0), 0.05
    bodies = {
        f"d{k}": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(k, 0.1 + gap[k]), v=(0.0, -speed[k])) for k in range(6)
    }
    for k, (n, offset) in enumerate([((0.0, 1.0), 0.0), ((1.0, 0.0), -1.0), ((-1.0, 0.0), -9.0), ((0.0, -1.0), -9.0)]):
        bodies[f"wall{k}"] = dr.Static(dr.HalfSpace(normal=n, offset=offset))
    world, state = dr.scene(bodies, restitution=0.5)
    assert isolated.goes_in_rounds(world) and world.contact.sweeps < 6
    end = dr.rollout(world, state, dt=dt, steps=1).state
    assert_allclose(end.x[-1, :, 1] - 0.1, 0.5 * (speed * dt - gap), rtol=1e-12)


@pytest.mark.parametrize("moving", [2, 3, 6, 8])
def test_blocks_hold_each_two_bodies(moving):
    """The first that each meets, and the sum of all until a time, are those of a table in which two cannot meet."""
    rng, others = np.random.default_rng(moving), tuple(range(moving))
    table = rng.permutation(moving**2).reshape(moving, moving) + 1.0
    table = np.minimum(table, table.T)
    allowed = (table < table.max()) & ~np.eye(moving, dtype=bool)
    table = np.where(np.eye(moving, dtype=bool), np.inf, table)
    of_pairs = Table(None, others, others, others, tuple(map(tuple, allowed.astype(float))))
    until, first, met = rng.integers(1, moving**2, (moving, 1)).astype(float), [], []
    for block in blocks_of(of_pairs, moving):
        assert all((a == b).all() for a, b in zip(grouped(block, jnp.arange(moving)), block[:2], strict=True))
        times = jnp.array(table)[block.a[:, :, None], block.b[:, None], None]
        times = where_allowed(of_pairs, block, times)
        first.append(of_all(soonest(block, times)))
        met.append(of_all(sum_of_met(block, 100, times, jnp.array(until))))
    expected = np.where(allowed, table, np.inf)
    assert (np.min(first, 0)[:, 0] == expected.min(1)).all()
    assert (np.sum(met, 0)[:, 0] == np.where(expected <= until, 100.0 + np.arange(moving), 0.0).sum(1)).all()
