"""Batches: a leading batch axis outside, chunks inside, and the numbers of one world after another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr

WORLDS = 5
ROUNDING = 1e-11  # loops over other lengths add in another order
# States (x, q, v, w) of two bodies
HITS = [
    [[0.060167493984, 0.10415523469], [0.203023812444, 0.351918470195]],
    [[0.999843890291, -0.017669042066], [0.95562462771, -0.294587119396]],
    [[-0.322288076727, 0.134206803629], [0.457752583558, -0.119053276436]],
    [[0.865787501446], [-3.896623990177]],
]
RESTS = [
    [[0.880800443596, 0.101898974279], [0.461256159192, 0.151880557045]],
    [[0.999954707403, 0.009517517695], [-0.156132115974, 0.987736180547]],
    [[0.625152393249, 0.195476755976], [-0.34752633448, 0.915854093146]],
    [[0.982734128622], [2.316842229868]],
]
PARTS = [  # a capsule leaves the end of another, on which it rested
    [[0.2191997377364504, 0.0030249709465789993], [0.5249613490080055, -0.18039153922249168]],
    [[0.24103671416954064, -0.970515998024943], [-0.195364774452538, 0.9807306484978987]],
    [[1.095418206176527, -0.006659960285699331], [1.4073625132814451, 0.14281186737105478]],
    [[0.4413922775133421], [-3.3741013160241793]],
]
SUNK = [[[0.2202, 0.0], PARTS[0][1]], *PARTS[1:]]


@pytest.fixture(scope="module")
def many():
    """Discs that collide on a floor, with other velocities and other restitutions in every world."""
    world, state = dr.scene(
        {
            "a": dr.Body(dr.Disc(radius=0.2), mass=1.0, x=(0.0, 0.5), v=(1.0, 0.0)),
            "b": dr.Body(dr.Disc(radius=0.3), mass=2.0, x=(1.0, 0.6)),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
        },
        gravity=(0.0, -9.81),
        friction=0.3,
    )
    v = state.v[None] + jnp.linspace(0.0, 0.5, WORLDS)[:, None, None]
    e = jnp.linspace(0.2, 0.9, WORLDS)[:, None] * jnp.ones((1, 2))
    bodies = dr.replace(world.bodies, restitution=e)
    return world, state, dr.replace(world, bodies=bodies), dr.replace(state, v=v), v, e


def one_by_one(world, state, v, e):
    for i in range(WORLDS):
        bodies = dr.replace(world.bodies, restitution=e[i])
        yield dr.rollout(dr.replace(world, bodies=bodies), dr.replace(state, v=v[i]), dt=1 / 60, steps=40).state


@pytest.mark.parametrize("chunk", [2, pytest.param(None, marks=pytest.mark.slow)])
def test_batch_equals_loop(many, chunk):
    world, state, worlds, states, v, e = many
    batch = dr.rollout_batch(worlds, states, dt=1 / 60, steps=40, chunk=chunk)
    for i, alone in enumerate(one_by_one(world, state, v, e)):
        for name in ("x", "q", "v", "w"):
            assert_allclose(getattr(batch, name)[i], getattr(alone, name), atol=ROUNDING, err_msg=name)


def box_and_disc():
    bodies = {
        "box": dr.Body(dr.Box(half=(0.2, 0.1)), mass=1.0, x=(0.0, 0.5)),
        "disc": dr.Body(dr.Disc(radius=0.15), mass=2.0, x=(0.1, 1.0)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    return dr.scene(bodies, gravity=(0.0, -9.81), restitution=0.5, friction=0.3)[0]


def two_capsules():
    first = dr.Body(dr.Capsule(radius=0.1, half_length=0.3), mass=1.0, x=(0.0, 0.0))
    other = dr.Body(dr.Capsule(radius=0.15, half_length=0.2), mass=0.0421505171309037, x=(1.0, 0.0))
    return dr.scene({"first": first, "other": other})[0]


@pytest.mark.slow
@pytest.mark.parametrize("made, both", [(box_and_disc, (HITS, RESTS)), (two_capsules, (PARTS, SUNK))])
def test_other_worlds_change_nothing(made, both):
    """A box hits a floor and a disc more often than a step has sweeps; in the world beside it, one rests.

    Or a contact opens at the end of a step, for the world beside it to close its own.
    """
    world = made()
    states = [dr.State(**{n: jnp.array(v) for n, v in zip("xqvw", leaves, strict=True)}) for leaves in both]
    both = dr.rollout_batch(world, jax.tree.map(lambda *s: jnp.stack(s), *states), dt=1 / 60, steps=1, final_only=True)
    for k, state in enumerate(states):
        alone = dr.step(world, state, 1 / 60)
        for name in "xqvw":
            assert_allclose(getattr(both, name)[k], getattr(alone, name), atol=ROUNDING, err_msg=name)


@pytest.mark.slow
def test_final_state_is_the_last(many):
    _, _, worlds, states, _, _ = many
    last = dr.rollout_batch(worlds, states, dt=1 / 60, steps=40, final_only=True)
    every = dr.rollout_batch(worlds, states, dt=1 / 60, steps=40)
    assert_allclose(last.x, every.x[:, -1], atol=ROUNDING)


def test_gradient_of_a_batch_is_that_of_each_world():
    world, state = dr.scene(
        {
            "ball": dr.Body(dr.Disc(radius=0.2), mass=1.0, x=(0.0, 0.5)),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
        },
        gravity=(0.0, -9.81),
        restitution=0.7,
    )
    v = jnp.stack([jnp.linspace(-1.0, 1.0, WORLDS), jnp.linspace(0.0, 0.5, WORLDS)], axis=1)[:, None]

    def total(v):
        last = dr.rollout_batch(world, dr.replace(state, v=v), dt=1 / 60, steps=24, final_only=True)
        return jnp.sum(last.x**2)

    def alone(v):
        return jnp.sum(dr.rollout(world, dr.replace(state, v=v), dt=1 / 60, steps=24).state.x[-1] ** 2)

    one = jax.jit(jax.jacfwd(alone))
    assert_allclose(jax.jit(jax.grad(total))(v), np.stack([one(w) for w in v]), atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_momenta_and_points_of_a_batch_are_those_of_each_world(dim):
    """As many worlds as bodies and dimensions: then arrays that are aligned wrongly broadcast all the same."""
    shape, rng = dr.Box(half=(0.1, 0.2, 0.3)[:dim]), np.random.default_rng(0)
    world, state = dr.scene({str(k): dr.Body(shape, mass=1.0 + k, x=np.full(dim, k)) for k in range(dim)})
    states = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=(*leaf.shape, dim))), state)
    points = jnp.asarray(rng.normal(size=(dim, dim)))
    for k in range(dim):
        alone = jax.tree.map(lambda leaf, k=k: leaf[..., k], states)
        for fn in (dr.kinetic_energy, dr.momentum, dr.angular_momentum):
            assert_allclose(fn(world.bodies, states)[..., k], fn(world.bodies, alone), rtol=ROUNDING)
        for fn in (dr.material_point, dr.material_velocity):
            assert_allclose(fn(states, 1, points)[..., k], fn(alone, 1, points[:, k]), rtol=ROUNDING)
            assert_allclose(fn(states, 1, points[:, 0])[..., k], fn(alone, 1, points[:, 0]), rtol=ROUNDING)
            assert_allclose(fn(alone, 1, points)[..., k], fn(alone, 1, points[:, k]), rtol=ROUNDING)


@pytest.mark.parametrize("axes", [(1,), (2,), (3,), (2, 3)])
@pytest.mark.parametrize("dim", [2, 3])
def test_states_of_a_trajectory_are_read_one_by_one(axes, dim):
    """Axes of times, and of worlds, in front, of any length, also that of the bodies or of space."""
    shape, rng = dr.Box(half=(0.1, 0.2, 0.3)[:dim]), np.random.default_rng(0)
    world, state = dr.scene({str(k): dr.Body(shape, mass=1.0 + k, x=np.full(dim, k)) for k in range(dim)})
    states = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=(*axes, *leaf.shape))), state)
    point = np.ones(dim)
    for index in np.ndindex(axes):
        alone = jax.tree.map(lambda leaf, index=index: leaf[index], states)
        for fn in (dr.kinetic_energy, dr.momentum, dr.angular_momentum):
            assert_allclose(fn(world.bodies, states)[index], fn(world.bodies, alone), rtol=ROUNDING)
        for fn in (dr.material_point, dr.material_velocity):
            assert_allclose(fn(states, 1, point)[index], fn(alone, 1, point), rtol=ROUNDING)


def test_states_of_other_bodies_are_refused():
    world, state = dr.scene({str(k): dr.Body(dr.Disc(radius=0.1), mass=1.0 + k, x=(k, 0.0)) for k in range(3)})
    fewer = jax.tree.map(lambda leaf: leaf[:2], state)
    for states in (fewer, jax.tree.map(lambda leaf: leaf[None], fewer)):
        for fn in (dr.kinetic_energy, dr.momentum, dr.angular_momentum):
            with pytest.raises(ValueError, match=r"state\.x has shape \(2, 2\): expected \(3, 2\)"):
                fn(world.bodies, states)
    for fn in (dr.material_point, dr.material_velocity):
        for body in (3, -4, "0", 0.0, None):
            for states in (state, jax.tree.map(lambda leaf: leaf[None], state)):
                with pytest.raises(ValueError, match="body is .*expected the number of a body, from 0 to 2"):
                    fn(state=states, body=body, point=(0.1, 0.0))
        with pytest.raises(ValueError, match=r"point has shape \(3,\): expected \(2,\)"):
            fn(state, 0, (0.1, 0.0, 0.0))


def test_a_trajectory_of_many_worlds_is_read_by_path_in_each():
    """By `vmap` of `rollout`; states of `rollout_batch` have no times of their own, and are refused."""
    bodies = {name: dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(x, 1.0)) for name, x in (("a", 0.0), ("b", 3.0))}
    world, state = dr.scene(bodies)
    speed, dt = np.arange(3.0), 0.1
    heavier = jax.vmap(lambda m: dr.paths.write(world, state, "b.mass", m)[0])(1.0 + speed)
    moving = jax.vmap(lambda v: dr.replace(state, v=jnp.ones((2, 2)) * v))(speed)
    runs = jax.vmap(lambda world, state: dr.rollout(world, state, dt=dt, steps=4))(heavier, moving)
    expected = 3.0 + speed[:, None] * dt * np.arange(5)
    assert_allclose(runs["b.x[0]"], expected, atol=1e-12)
    assert_allclose(runs["b.mass"], np.repeat(1.0 + speed[:, None], 5, axis=1))
    states = dr.rollout_batch(world, moving, dt=dt, steps=4)
    run = dr.Trajectory(t=jnp.asarray(dt * np.arange(5)), state=states, world=world)
    with pytest.raises(ValueError, match=r"state.x begins with the axes \(3, 5, 2\), expected .* \(5, 2, 2\); .*vmap"):
        run["b.x"]
    assert_allclose(jax.vmap(lambda states: dr.replace(run, state=states)["b.x[0]"])(states), expected, atol=1e-12)


def test_bad_batches(many):
    world, state, _, states, _, _ = many
    with pytest.raises(ValueError, match="one leading batch axis.*or use rollout for one world"):
        dr.rollout_batch(world, state, dt=1 / 60, steps=3)
    with pytest.raises(ValueError, match="one leading batch axis"):
        dr.rollout_batch(world, dr.replace(states, x=jnp.zeros((3, 2, 2))), dt=1 / 60, steps=3)
    with pytest.raises(ValueError, match=r"dt is 0\.0, expected > 0"):
        dr.rollout_batch(world, states, dt=0.0, steps=3)
    with pytest.raises(ValueError, match="steps is 0, expected an integer >= 1"):
        dr.rollout_batch(world, states, dt=1 / 60, steps=0)


def test_controls_of_a_batch_are_those_of_each_world():
    puck = dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0))
    world, state = dr.scene({"puck": puck}, forces=[dr.Force("puck", F=(0.0, 0.0), control="push")])
    states = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], 2, axis=0), state)
    push = [[[1.0, 0.0]] * 3, [[0.0, 2.0]] * 3]  # (B, T, D)
    run = dr.rollout_batch(world, states, dt=1.0, steps=3, controls={"push": push})
    assert_allclose(run.v[:, -1, 0], [[3.0, 0.0], [0.0, 6.0]], atol=1e-12)
    with pytest.raises(ValueError, match=r"shape \(3, 2, 2\): expected \(3, 2\) or \(2, 3, 2\)"):
        dr.rollout_batch(world, states, dt=1.0, steps=3, controls={"push": np.zeros((3, 2, 2))})


def hinged_and_rolling():
    """An arm that falls onto its stop, and a disc that rolls on a floor."""
    bodies = {
        "arm": dr.Body(None, mass=0.5, inertia=0.02, x=(1.0, 0.8)),
        "disc": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.1), v=(1.0, 0.0)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    hinge = dr.Revolute("arm", anchor_a=(-0.3, 0.0), upper=0.4, lower=-0.02, friction=0.01)
    return dr.scene(bodies, gravity=(0.0, -9.81), friction=0.3, rolling_friction=0.01, joints={"hinge": hinge})


@pytest.mark.slow
def test_any_leaf_may_be_batched_where_joints_and_contacts_meet():
    """Some of them, each by itself, by shapes; and values, with the velocities of three worlds."""
    world, state = hinged_and_rolling()
    leaves, tree = jax.tree.flatten((world, state))
    for k, leaf in list(enumerate(leaves))[::4]:
        batched = jax.tree.unflatten(
            tree, [jnp.stack([leaf] * 3) if i == k else other for i, other in enumerate(leaves)]
        )
        ends = jax.eval_shape(lambda pair: dr.rollout_batch(*pair, dt=1 / 60, steps=2, final_only=True), batched)
        assert ends.x.shape == (3, 2, 2)
    v = state.v[None] * jnp.array([0.5, 1.0, 2.0])[:, None, None]
    ends = dr.rollout_batch(world, dr.replace(state, v=v), dt=1 / 60, steps=20, final_only=True)
    one = dr.rollout(world, dr.replace(state, v=v[2]), dt=1 / 60, steps=20).state
    jax.tree.map(lambda a, b: assert_allclose(a[2], b[-1], rtol=1e-10, atol=1e-12), ends, one)
    assert abs(one.v[-1, 1, 0] - 2.0) > 0.1 and abs(one.w[10, 0, 0] - one.w[2, 0, 0]) > 1e-3


@pytest.mark.slow
def test_a_box_of_many_worlds_comes_down_on_one_that_all_share():
    bodies = {
        "box": dr.Body(dr.Box(half=(0.2, 0.1)), mass=1.0, x=(0.0, 1.0)),
        "block": dr.Static(dr.Box(half=(0.5, 0.5))),
    }
    world, state = dr.scene(bodies, gravity=(0.0, -9.81), restitution=0.5)
    heights = jnp.array([0.8, 0.9, 1.1])
    states = dr.replace(state, x=jnp.stack([state.x.at[0, 1].set(y) for y in heights]))
    got = dr.rollout_batch(world, states, dt=1 / 30, steps=9, final_only=True)
    fall = np.sqrt(2 * (np.asarray(heights) - 0.6) / 9.81)
    left = np.maximum(0.3 - fall, 0.0)
    bounced = 0.6 + 0.5 * fall * 9.81 * left - 0.5 * 9.81 * left**2
    assert_allclose(got.x[:, 0, 1], np.where(left > 0, bounced, heights - 0.5 * 9.81 * 0.3**2), atol=1e-9)
