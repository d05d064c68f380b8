"""Many contacts at rest and in motion: what stands, stands still, and what slides together stops together."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import with_slopes
from marks import some_later
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.contact import together
from diffrigid.contact.apply import _no_further_than_flown
from diffrigid.contact.cone import Cone, split
from diffrigid.contact.mobility import Arms, Mobility, moved
from diffrigid.flight import launch

G, RATE = 9.81, 60
STANDS = 1e-9  # [m] drift in two seconds; the solver works to rounding
STILL = (3e-9) ** 2  # [J] at any time
FLOOR = {"floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}


def drift_and_energy(bodies, friction, seconds=2.0):
    world, state = dr.scene(bodies | FLOOR, gravity=(0.0, -G), friction=friction)
    path = dr.rollout(world, state, dt=1 / RATE, steps=int(seconds * RATE)).state
    energy = jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state).sum())(path)
    return float(jnp.abs(path.x - state.x[None]).max()), float(energy.max())


PILES = {  # places and masses of unit boxes
    "a tower under 100 times its weight": [(0.0, 0.5 + i, 100.0 if i == 5 else 1.0) for i in range(6)],
    # Every box shares its load between two, and its neighbours in the row may push or not.
    "a pyramid of touching boxes": [(i + 0.5 * row, 0.5 + row, 1.0) for row in range(4) for i in range(4 - row)],
}


@some_later("pile", PILES, "a tower under 100 times its weight")
def test_a_pile_stands(pile):
    box = dr.Box(half=(0.5, 0.5))
    drift, energy = drift_and_energy(
        {f"{i}": dr.Body(box, mass=m, x=(x, y)) for i, (x, y, m) in enumerate(PILES[pile])}, 0.5
    )
    assert drift < STANDS
    assert energy < STILL


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_stack_takes_a_fall(dtype):
    """Boxes fall apart from each other and land one on the other, without rebound: each stops where it lands."""
    box, count = dr.Box(half=(0.25, 0.25)), 6
    bodies = {f"{i}": dr.Body(box, mass=1.0, x=(0.1 * (i % 3 - 1), 0.25 + 0.6 * i)) for i in range(count)}
    scene = dr.scene(bodies | FLOOR, gravity=(0.0, -G), friction=0.5)
    world, state = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), scene)
    end = dr.rollout(world, state, dt=1 / 240, steps=130).state
    speed = max(float(jnp.abs(leaf[-1]).max()) for leaf in (end.v, end.w))
    rounding = float(jnp.finfo(dtype).eps) ** 0.5
    places = np.stack([state.x[:, 0], 0.25 + 0.5 * np.arange(count)], axis=1)
    np.testing.assert_allclose(end.x[-1], places, atol=3 * rounding)
    assert speed < 30 * rounding


@pytest.mark.slow
def test_a_house_of_cards_stands():
    """Two cards lean on each other; friction of their feet and of the ridge keeps them up."""
    half, lean = (0.5, 0.02), np.radians(70.0)
    height, reach = half[0] * np.sin(lean) + half[1] * np.cos(lean), half[0] * np.cos(lean) + half[1] * np.sin(lean)
    cards = {
        name: dr.Body(dr.Box(half=half), mass=0.1, x=(side * reach, height), angle=float(angle))
        for name, side, angle in (("left", -1.0, lean), ("right", 1.0, np.pi - lean))
    }
    drift, energy = drift_and_energy(cards, 0.8)
    assert drift < STANDS
    assert energy < STILL
    assert drift_and_energy(cards, 0.05)[0] > 0.1  # and falls where its feet slip


@pytest.mark.slow
def test_two_blocks_slide_as_one():
    """Closed form: a rider that sticks to a block slows down with it, by mu g, whatever the masses.

    Under a heavy rider, a light block rubs more within a step than would stop it alone.
    """
    time = 0.2

    def at_end(p):
        bodies = {
            "block": dr.Body(dr.Box(half=(0.5, 0.2)), mass=p["m"], x=(0.0, 0.2), v=jnp.stack([p["v"], 0.0 * p["v"]])),
            "rider": dr.Body(
                dr.Box(half=(0.2, 0.1)), mass=0.7, x=(0.1, 0.5), v=jnp.stack([p["v"], 0.0 * p["v"]]), friction=0.9
            ),
        }
        world, state = dr.scene(bodies | FLOOR, gravity=(0.0, -G), friction=p["mu"])
        end = dr.rollout(world, state, dt=1 / RATE, steps=round(time * RATE)).state
        return jnp.stack([end.x[-1, :, 0] - end.x[0, :, 0], end.v[-1, :, 0]])

    both = with_slopes(at_end)
    right = {"m": [[0.0], [0.0]], "v": [[time], [1.0]], "mu": [[-0.5 * G * time**2], [-G * time]]}
    for mass, rounding in ((1.3, 1e-12), (1e-3, 1e-9)):
        p = {name: jnp.asarray(value) for name, value in {"m": mass, "v": 3.0, "mu": 0.4}.items()}
        got, (slopes,) = both(p)
        expected = [p["v"] * time - 0.5 * p["mu"] * G * time**2], [p["v"] - p["mu"] * G * time]
        np.testing.assert_allclose(got, np.broadcast_to(expected, (2, 2)), rtol=rounding)
        for name, slope in right.items():
            np.testing.assert_allclose(slopes[name], np.broadcast_to(slope, (2, 2)), atol=1e3 * rounding)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_begins_deep_inside_each_other_parts_gently(dtype):
    """Four boxes of 1 cm to 10 m and 1 g to 1 t in one heap, where no impulses, and no displacements, can do what their
    contacts ask for: they make next to no energy, but for one in 150, and slopes are finite."""
    random = np.random.default_rng(35)

    def heap():
        h, mass, x, v = 10 ** random.uniform(-2, 1, 4), 10 ** random.uniform(-3, 3, 4), *random.normal(size=(2, 4, 2))
        turns = random.uniform(0, 6, (4, 2))
        bodies = {
            f"{i}": dr.Body(dr.Box(half=(h[i], 0.5 * h[i])), mass=mass[i], x=0.2 * x[i], angle=turn, v=v[i], w=w - 3)
            for i, (turn, w) in enumerate(turns)
        }
        with pytest.warns(UserWarning, match="overlap at the start"):
            scene = dr.scene(bodies | FLOOR, restitution=0.5, friction=0.3)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), scene)

    def energies(world, state):
        path = dr.rollout(world, state, dt=1 / RATE, steps=30).state
        return jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state).sum())(path)

    with_slopes = jax.jit(lambda scene: jax.jvp(energies, scene, jax.tree.map(jnp.ones_like, scene)))
    made = []
    for _ in range(20):
        energy, slope = with_slopes(heap())
        made.append(energy.max() / energy[0])
        assert jnp.isfinite(slope).all()
    assert np.sort(made)[-2] < 1.5


@pytest.mark.slow
def test_a_box_on_a_box_is_solved_at_any_speed():
    """Contacts that repeat each other, some stick and some slide: none closes, pulls, or rubs more than it may."""
    random, worlds = np.random.default_rng(0), 400
    corners = np.array([(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    low, high = (
        np.column_stack([corners * size, np.full(4, h)]) for size, h in (((0.2, 0.15), -0.1), ((0.15, 0.12), 0.1))
    )
    edge = np.array([(-0.15, 0.0, 0.1), (0.02, 0.12, 0.1)])
    arm_a = np.concatenate([low, high, edge])[..., None] + 0.004 * random.normal(size=(10, 3, worlds))
    tilt = 0.03 * random.normal(size=(10, 3, worlds)) * (np.arange(10) > 3)[:, None, None]
    normal = np.where(np.arange(10) < 4, 1.0, -1.0)[:, None, None] * np.array([0.0, 0.0, 1.0])[:, None] + tilt
    normal = jnp.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    arms = Arms(
        arm_a=jnp.asarray(arm_a), arm_b=jnp.asarray(arm_a - np.array([0.03, 0.02, 0.3])[:, None]),
        a=(0,) * 10, b=(2,) * 4 + (1,) * 6,
    )  # fmt: skip
    inverse = jnp.broadcast_to(jnp.diag(jnp.array([50.0, 58.0, 92.0]))[None, ..., None], (2, 3, 3, worlds))
    mobility = Mobility(inverse_mass=jnp.ones((2, worlds)), inverse_inertia=inverse)
    sizes, none = np.array([0.6, 0.6, 0.6, 3.0, 3.0, 3.0])[:, None], jnp.zeros((10, worlds))
    v, w = jnp.split(jnp.asarray(sizes * random.normal(size=(2, 6, worlds))), 2, axis=1)
    point_a, point_b = (
        v[i][None] + jnp.cross(w[i][None], arm, axis=1) for i, arm in ((0, arms.arm_a), (1, arms.arm_b))
    )
    v_rel = point_a - jnp.where(jnp.arange(10)[:, None, None] < 4, 0.0, point_b)
    mu = jnp.asarray(random.uniform(0.0, 1.2, worlds))[None] + none
    cone = Cone(
        on=1.0 + none, rest_speed=jnp.full(worlds, 1e-3), sharing=10.0 + none, scale=20.0 + none, normal=normal,
        target=none, mu=mu,
    )  # fmt: skip
    solve = jax.jit(together.solve_together)
    P = solve(jnp.asarray(True), cone, v_rel, 1e-4 * normal, arms, mobility)
    (y_n, y_t), (P_n, P_t) = (split(normal, x) for x in (v_rel + moved(P, arms, mobility), P))
    rubs, slips = (jnp.linalg.norm(x, axis=1) for x in (P_t, y_t))
    wrong = jnp.stack([-y_n, jnp.abs(P_n * y_n), -P_n, rubs - mu * P_n, slips * (mu * P_n - rubs), (P_t * y_t).sum(1)])
    assert (wrong.max((0, 1)) < 1e-6).mean() > 0.99
    assert wrong.max() < 1e-3  # [m/s], [N s], and their products


def test_no_body_is_displaced_further_than_it_flies():
    """Forces that began at different times all but cancel on a light body between heavy ones: 1 m is not its way.

    Nor is 1 rad its turn, unless it spins.
    """
    world, state = dr.scene({"light": dr.Body(dr.Disc(radius=0.1), mass=1e-3, x=(0.0, 1.0), v=(3.0, 0.0), w=-2.0)})
    dt = jnp.asarray(1 / 60)
    flight = launch(world, state, None, jnp.zeros(1), dt)
    shifts = jnp.array([[[0.0, 1.0]], [[0.02, 0.0]]])  # [m]; (3 + 5) m/s for a step are 0.13 m
    by = jnp.array([[0.0, 4.0]]), jnp.array([[5.0]])  # [m/s], [rad/s]: it spins with -2 and 3, 0.08 rad in a step
    mobility = Mobility(inverse_mass=flight.inverse_mass, inverse_inertia=flight.inverse_inertia)
    # On a static; on what flies as it does only the change of its velocity counts, 4 m/s; where gaps are closed nothing.
    cases = (1.0, True, (8 * dt, 0.02)), (1.0, False, (4 * dt, 0.02)), (0.0, True, (1.0, 0.02))
    for kick, touches, ways in cases:
        turns = (5 * dt, 0.07) if kick else (1.0, 0.07)
        strikes = SimpleNamespace(a=(0,), b=(1,), active=jnp.array([touches]))
        for shift, way, turn, angle in zip(shifts, ways, turns, (1.0, 0.07), strict=True):
            moved = shift, jnp.full((1, 1), angle)
            there = _no_further_than_flown(flight, dt[None], mobility, strikes, by, moved, jnp.asarray(kick))
            assert_allclose(there[0], way * shift / jnp.linalg.norm(shift))
            assert_allclose(there[1], [[turn]])
