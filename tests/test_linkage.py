"""Joints by elimination: any graph of joints against a dense solve, loops, and long chains."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import numpy_motion, with_slopes
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid import linkage, so3
from diffrigid.elimination import factorise, plan_of, solve

STILL = 10**6  # a collider that does not move
GRAPHS = {  # colliders a and b of every joint, and the number of bodies
    "one": ([(0, STILL)], 1),
    "chain": ([(0, STILL)] + [(i, i - 1) for i in range(1, 20)], 20),
    "tree": ([(i, (i - 1) // 2) for i in range(1, 15)], 15),
    "star": ([(i, 0) for i in range(1, 6)], 6),
    "ring": ([(i, (i + 1) % 6) for i in range(6)], 6),
    "apart": ([(0, 1), (2, 3), (4, STILL)], 5),
    "twice": ([(0, 1), (1, 0), (0, STILL)], 2),
}


def system(ends, moving, rows, rng, repeated=False):
    """Random J M^-1 J^T (n, R, n, R, 3 worlds), as a matrix and as the blocks that `factorise` takes."""
    n = len(ends)
    jac = np.zeros((n, rows, moving, 6, 3))
    for i, pair in enumerate(ends):
        for body in set(pair) - {STILL}:
            jac[i, :, body] = rng.normal(size=(rows, 6, 3))
    if repeated:
        jac[1:] = jac[:1]
    matrix = np.einsum("iecx...,jfcx...->iejf...", jac, jac)
    pairs = [(i, i) for i in range(n)] + list(plan_of(ends, moving).pairs)
    return matrix, jnp.stack([matrix[i, :, j] for i, j in pairs])


@partial(jax.jit, static_argnums=0)
def solved(plan, blocks, matrix, right):
    def product(x):
        return jnp.einsum("iejf...,jf...->ie...", matrix, x)

    return solve(plan, factorise(plan, blocks), product, right)


@pytest.mark.parametrize("name", GRAPHS)
def test_elimination_is_the_dense_solution(name):
    ends, moving = tuple(GRAPHS[name][0]), GRAPHS[name][1]
    matrix, blocks = system(ends, moving, 2, rng := np.random.default_rng(0))
    right = rng.normal(size=(len(ends), 2, 3))
    x = solved(plan_of(ends, moving), blocks, matrix, right)
    size = 2 * len(ends)
    for k in range(3):
        dense = np.linalg.solve(matrix[..., k].reshape(size, size), right[..., k].ravel())
        assert_allclose(x[..., k].ravel(), dense, rtol=1e-6, atol=1e-9 * np.abs(dense).max())


def test_half_of_a_chain_goes_at_once():
    levels = plan_of(tuple(GRAPHS["chain"][0]), 20).levels
    assert [len(level.pivots) for level in levels] == [10, 5, 3, 1, 1]


def test_repeated_equations_have_one_of_their_solutions():
    """The same joint three times: finite, and a solution."""
    ends = ((0, 1),) * 3
    matrix, blocks = system(ends, 2, 5, np.random.default_rng(1), repeated=True)
    right = np.einsum("iejf...,jf...->ie...", matrix, np.random.default_rng(2).normal(size=(3, 5, 3)))
    x = solved(plan_of(ends, 2), blocks, matrix, right)
    assert_allclose(np.einsum("iejf...,jf...->ie...", matrix, x), right, atol=1e-9)


def test_loops_in_space_are_closed_wherever_they_are_turned():
    """Four bars on hinges that are parallel: three of its equations repeat others, which by rounding they do not."""
    corners = np.array([(0.0, 0.0, 0.0), (1.0, 0.1, 0.0), (0.8, 0.9, 0.0), (-0.1, 0.6, 0.0)])
    middle = (corners + np.roll(corners, -1, 0)) / 2
    bars = {f"{i}": dr.Body(None, mass=1.0 + i, inertia=(0.05, 0.06, 0.08), x=tuple(middle[i])) for i in range(4)}
    joints = [
        dr.Revolute(f"{i}", f"{i - 1 & 3}", anchor_a=tuple(corners[i] - middle[i]), axis_a=(0.0, 0.0, 1.0))
        for i in range(4)
    ]
    world, state = dr.scene(bars, joints=joints)
    rng = np.random.default_rng(0)
    turns, twists = rng.normal(size=(4, 300)), jnp.asarray(rng.normal(size=(4, 6)))

    def torn(turn):
        q = turn / jnp.sqrt((turn**2).sum())
        x, q = so3.rotate(q[:, None], state.x.T).T, jnp.broadcast_to(q, (4, 4))
        link = linkage.linkage(world.joints, world.statics, world.bodies, x, q)
        v, w = twists[:, :3], twists[:, 3:]
        dv, dw, _ = linkage.spread(link, v, w)
        return jnp.abs(linkage._rates(link, jnp.concatenate([v + dv, w + dw], axis=1))).max()

    assert jax.jit(jax.vmap(torn, 1))(turns).max() < 1e-11  # [m/s]


def hanging(count):
    """A chain of rods of 0.2 m that lies level, as links of the plane."""
    bodies = {f"{i}": dr.Body(None, mass=1.0, inertia=0.003, x=(0.2 * i + 0.1, 0.0)) for i in range(count)}
    names = [None, *bodies]
    joints = [dr.Revolute(a, b, anchor_a=(-0.1, 0.0)) for a, b in zip(names[1:], names[:-1], strict=True)]
    return dr.scene(bodies, gravity=(0.0, -9.81), joints=joints)


def test_twenty_links_keep_together_and_keep_their_energy():
    world, state = hanging(20)
    path = dr.rollout(world, state, dt=1 / 240, steps=120).state
    along = jnp.stack([path.q[:, :, 0], path.q[:, :, 1]], axis=2) * 0.1
    ends, starts = path.x + along, path.x - along
    assert_allclose(starts[:, 1:], ends[:, :-1], atol=1e-11)
    assert_allclose(starts[:, 0], 0.0, atol=1e-11)
    energy = jax.vmap(lambda s: dr.kinetic_energy(world.bodies, s).sum() + 9.81 * s.x[:, 1].sum())(path)
    assert_allclose(energy, energy[0], atol=1e-4)  # [J] of 400 that pass from one kind to the other; fourth order


def four_bars(mass):
    """A parallelogram: two cranks of 1 m on the ground and a coupler, which stays level; one loop."""
    down, rod = np.array([0.6, -0.8]), {"inertia": 0.1}
    tilt = np.arctan2(0.6, 0.8)
    bodies = {
        "left": dr.Body(None, mass=1.0, x=0.5 * down, angle=tilt, **rod),
        "right": dr.Body(None, mass=1.0, x=0.5 * down + (2.0, 0.0), angle=tilt, **rod),
        "coupler": dr.Body(None, mass=mass, x=down + (1.0, 0.0), **rod),
    }
    joints = [
        dr.Revolute("left", anchor_a=(0.0, 0.5)),
        dr.Revolute("right", anchor_a=(0.0, 0.5)),
        dr.Revolute("coupler", "left", anchor_a=(-1.0, 0.0)),
        dr.Revolute("coupler", "right", anchor_a=(1.0, 0.0)),
    ]
    return dr.scene(bodies, gravity=(0.0, -9.81), joints=joints)


def test_a_loop_swings_as_the_pendulum_that_it_is():
    """(2 I + m_r l^2 / 2 + m l^2) a'' = -(m_r + m) g l sin a, for cranks of mass m_r = 1; and its slope by m."""

    def end(mass):
        world, state = four_bars(mass)
        return dr.rollout(world, state, dt=1 / 120, steps=60).state.x[-1, 2]

    def exact(mass):
        pull = 9.81 * (1.0 + mass) / (0.2 + 0.5 + mass)
        angle = numpy_motion(lambda y: np.array([y[1], -pull * np.sin(y[0])]), (np.arctan2(0.6, 0.8), 0.0), 0.5)[0]
        return np.array([1.0 + np.sin(angle), -np.cos(angle)])

    got, slope = jax.jit(lambda m: jax.jvp(end, (m,), (1.0,)))(1.5)
    assert_allclose(got, exact(1.5), atol=1e-6)
    assert_allclose(slope, (exact(1.5 + 1e-4) - exact(1.5 - 1e-4)) / 2e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_the_slope_by_one_entry_of_an_inertia_is_that_of_the_motion(mode):
    """Also by an entry whose mirror image stays: only the symmetric part acts."""
    inertia = np.diag([0.05, 0.06, 0.08]) + 0.01 * np.array([(0.0, 1.0, -1.0), (1.0, 0.0, 0.5), (-1.0, 0.5, 0.0)])
    bodies = {"arm": dr.Body(None, mass=1.0, inertia=inertia, x=(0.0, 0.0, 0.0), w=(0.6, -0.2, -0.4))}
    world, state = dr.scene(bodies, gravity=(0.0, 1.0, -9.81), joints=[dr.Ball("arm", None, anchor_a=(-0.3, 0.1, 0.2))])

    def end(inertia):
        changed = dr.replace(world, bodies=dr.replace(world.bodies, inertia=inertia[None]))
        state_after = dr.rollout(changed, state, dt=1 / 60, steps=10).state
        return jnp.concatenate([state_after.q[-1, 0], state_after.w[-1, 0]])

    run, steps = with_slopes(end, mode), 1e-5 * np.eye(9).reshape(9, 3, 3)
    _, (by_entry,) = run(inertia)
    differences = [(run(inertia + step)[0] - run(inertia - step)[0]) / 2e-5 for step in steps]
    assert_allclose(by_entry.reshape(-1, 9).T, differences, atol=1e-8)
    assert_allclose(by_entry, jnp.swapaxes(by_entry, 1, 2), atol=1e-12)
