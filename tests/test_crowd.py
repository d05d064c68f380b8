"""Crowds whose pairs a grid finds: the states of the way that tests all pairs, and derivatives of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import some_later
from numpy.testing import assert_allclose, assert_array_equal

import diffrigid as dr
from diffrigid.contact import crowd, grid

STEPS = 40
ROUNDING = 1e-8  # relative: of some dozen impacts in a row, each of which magnifies it


def box(count, seed=3, **options):
    """Discs that differ in everything, on a jittered lattice of 0.5 m with pegs, between walls, and fast: 5 m/s at 1/60 s.

    Statics of different kinds by turns.
    """
    rng, side = np.random.default_rng(seed), int(np.ceil(count**0.5))
    bodies = {
        f"d{k}": dr.Body(
            dr.Disc(radius=rng.uniform(0.12, 0.2)), mass=rng.uniform(0.5, 2.0), w=rng.normal(),
            x=0.5 * np.array([k % side, k // side]) + rng.uniform(-0.05, 0.05, 2), v=rng.uniform(-5.0, 5.0, 2),
            restitution=0.6 if k == 2 else None,
        )
        for k in range(count)
    }  # fmt: skip
    for k, (n, offset) in enumerate(
        [((1.0, 0.0), -0.3), ((-1.0, 0.0), -0.5 * side), ((0.0, 1.0), -0.3), ((0.0, -1.0), -0.5 * side)]
    ):
        bodies[f"wall{k}"] = dr.Static(dr.HalfSpace(normal=n, offset=offset))
        bodies[f"peg{k}"] = dr.Static(dr.Disc(radius=0.05), x=0.25 + 0.5 * np.array([k + 0.1 * k, k]))
    return dr.scene(bodies, restitution=0.9, friction=0.3, restitution_falloff=0.1, **options)


@pytest.fixture
def many(monkeypatch):
    """A few are many."""
    monkeypatch.setattr(crowd, "CROWD", 4)


def test_a_crowd_moves_as_all_pairs_do(monkeypatch):
    expected = dr.rollout(*box(20), dt=1 / 60, steps=STEPS).state
    monkeypatch.setattr(crowd, "CROWD", 4)
    world, state = box(20)
    assert world.crowd and not world.pairs
    found = dr.rollout(world, state, dt=1 / 60, steps=STEPS).state
    assert (np.abs(found.v[-1] - state.v).max(1) > 0.5).all()  # each was struck
    jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=ROUNDING, atol=ROUNDING), found, expected)


@some_later("modes", ["reverse", "both"], "reverse")
def test_derivatives_of_a_crowd_and_of_a_batch(many, modes):
    """Reverse = forward = central difference, along one direction for all leaves; a batch is one world after another."""
    worlds, state = box(20)
    v = jnp.stack([state.v, 0.7 * state.v])
    args = worlds, dr.replace(state, v=v)
    # Not of the contact model: differences of what is not above zero leave what is allowed.
    along = jax.tree.map(lambda leaf: 0.1 * jnp.cos(jnp.arange(1.0, 1.0 + leaf.size)).reshape(leaf.shape), args)
    along = (dr.replace(along[0], contact=jax.tree.map(jnp.zeros_like, worlds.contact)), along[1])

    def weighted(args):
        end = dr.rollout_batch(*args, dt=1 / 60, steps=STEPS // 4, final_only=True)
        return (end.x * jnp.arange(1.0, 1.0 + end.x.size).reshape(end.x.shape)).sum(), end.x

    @jax.jit
    def with_slope(args):
        (value, ends), grad = jax.value_and_grad(weighted, has_aux=True)(args)
        return value, sum(jax.tree.leaves(jax.tree.map(lambda a, b: (a * b).sum(), grad, along))), ends

    (_, slope, ends), h = with_slope(args), 1e-7
    there, back = (with_slope(jax.tree.map(lambda a, d, s=s: a + s * h * d, args, along))[0] for s in (1.0, -1.0))
    assert_allclose(slope, (there - back) / (2 * h), rtol=1e-4)  # impacts magnify what is of second order in h
    if modes == "both":
        forward = jax.jit(lambda args: jax.jvp(lambda args: weighted(args)[0], (args,), (along,))[1])(args)
        assert_allclose(slope, forward, rtol=ROUNDING)
    alone = dr.rollout(worlds, dr.replace(state, v=v[1]), dt=1 / 60, steps=STEPS // 4).state
    assert_allclose(ends[1], alone.x[-1], rtol=ROUNDING)


def test_a_fit_of_a_crowd_takes_steps_as_of_other_bodies_that_touch(many):
    world, state = box(20)
    data = {"t": np.arange(3) / 10, "d0.x": np.zeros((3, 2))}
    assert dr.sysid.make_problem(world, state, data, free={"d0.v": dr.real()}).dt == 0.02


@pytest.mark.slow
def test_spheres_keep_momentum_and_lose_energy(many):
    """27 spheres that fly into each other, of unequal principal inertias, with friction."""
    rng = np.random.default_rng(5)
    places = np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3), -1).reshape(-1, 3)
    bodies = {
        f"s{k}": dr.Body(
            dr.Sphere(radius=0.2), mass=1.0 + 0.1 * k, inertia=(0.02, 0.03, 0.04), x=x, v=-4.0 * x + rng.normal(size=3)
        )
        for k, x in enumerate(places)
    }
    world, state = dr.scene(bodies, restitution=0.8, friction=0.4)
    assert world.crowd
    end = jax.tree.map(lambda leaf: leaf[-1], dr.rollout(world, state, dt=1 / 60, steps=STEPS).state)
    assert (np.abs(end.v - state.v).max(1) > 0.1).sum() > 20
    for total in (dr.momentum, dr.angular_momentum):
        assert_allclose(total(world.bodies, end).sum(0), total(world.bodies, state).sum(0), atol=1e-11)
    assert dr.kinetic_energy(world.bodies, end).sum() < dr.kinetic_energy(world.bodies, state).sum()
    away = np.linalg.norm(end.x[:, None] - end.x[None], axis=-1) + np.eye(len(places))
    assert away.min() > 0.4 - 1e-9


def test_a_row_that_touches_is_struck_one_after_the_other(many):
    """Newton's cradle: with e = 1 the last of the row takes all; with e = 0 what is left of the momentum is shared."""
    row = {f"d{k}": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.2 * k, 0.0)) for k in range(5)}
    ball = {"ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(-0.25, 0.0), v=(3.0, 0.0))}
    world, state = dr.scene(row | ball, restitution=1.0)
    last = dr.rollout(world, state, dt=1 / 60, steps=6).state.v[-1]
    assert_allclose(last[:, 0], [0.0, 0.0, 0.0, 0.0, 3.0, 0.0], atol=1e-12)
    dull = dr.replace(world, bodies=dr.replace(world.bodies, restitution=jnp.zeros(6)))
    last = dr.rollout(dull, state, dt=1 / 60, steps=60).state.v[-1]
    assert_allclose(last[:, 0], 0.5, rtol=1e-3)  # found step by step, each of which parts what is left


@pytest.mark.parametrize("dim, worlds", [(2, 1), (2, 3), (3, 1), (3, 2)])
def test_neighbours_are_all_that_are_near(dim, worlds):
    """As all pairs say, also where one is far from the others, and where there is no room."""
    rng = np.random.default_rng(dim)
    x = rng.uniform(-1.0, 1.0, (dim, 90, worlds)) * np.array([3.0, 1.0, 1.0])[:dim, None, None]
    x[:, 7] = 50.0
    x, reach = x.reshape(dim, -1), rng.uniform(0.05, 0.2, 90 * worlds)
    away = np.linalg.norm(x[:, :, None] - x[:, None], axis=0)
    same = np.equal.outer(*[np.arange(x.shape[1]) % worlds] * 2) & ~np.eye(x.shape[1], dtype=bool)
    expected = same & (away < reach[:, None] + reach[None])
    near = grid.neighbours(jnp.asarray(x), jnp.asarray(reach), worlds, 12)
    assert_array_equal(near.found, expected.sum(1))
    for i, others in enumerate(np.asarray(near.other).T):
        assert_array_equal(np.sort(others[others >= 0]), np.flatnonzero(expected[i])[:12])
    few = grid.neighbours(jnp.asarray(x), jnp.asarray(reach), worlds, 2)
    assert_array_equal((few.other >= 0).sum(0), np.minimum(expected.sum(1), 2))


def test_what_has_no_room_is_counted(many):
    """Seven discs that touch: the middle one has six neighbours, those around it three."""
    angle = np.pi / 3 * np.arange(6)
    places = [(0.0, 0.0), *zip(0.2 * np.cos(angle), 0.2 * np.sin(angle), strict=True)]
    for room, missed in ((8, 0), (5, 1), (2, 4 + 6)):
        bodies = {
            f"d{k}": dr.Body(dr.Disc(radius=0.1 - 1e-9), mass=1.0, x=x, v=(0.1, 0.0)) for k, x in enumerate(places)
        }
        world, state = dr.scene(bodies, contact=dr.Contact(neighbours=room))
        states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
        assert_array_equal(dr.missed_pairs(world, states, 1 / 60), [missed, missed])
    assert dr.missed_pairs(*dr.scene({"a": bodies["d0"]}), 1 / 60) == 0
    with pytest.raises(ValueError, match="world has a batch"):
        dr.missed_pairs(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), world), states, 1 / 60)


def test_large_scenes_list_no_pairs():
    """A thousand are a crowd by themselves; those that overlap are still found, and a width is refused."""
    bodies = {f"d{k}": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.3 * (k % 32), 0.3 * (k // 32))) for k in range(1024)}
    world, _ = dr.scene(bodies)
    assert world.crowd and not world.pairs
    bodies["d40"] = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.1, 0.0))
    with pytest.warns(UserWarning, match="overlap at the start: d0 and d40 by [0-9.]+ m;"):
        dr.scene(bodies)
    del bodies["d40"]
    wide = dr.scene(bodies, contact=dr.Contact(width=0.1))
    with pytest.raises(ValueError, match="contact.width is 0.1: expected 0 for so many bodies"):
        dr.rollout(*wide, dt=0.1, steps=1)
