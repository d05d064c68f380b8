"""Angles, translations and rates of joints as parameters and as columns: "hinge.angle"."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.constraints import joint_errors, joint_rates, placed
from diffrigid.linkage import ends_of, onto_joints, to_sides
from diffrigid.paths import catalogue, read, unit, write
from diffrigid.state import rotations

ROUNDING = 1e-12
DISC = dr.Disc(radius=0.1)


def double_pendulum():
    bodies = {"upper": dr.Body(DISC, mass=1.0, x=(0.0, -1.0)), "lower": dr.Body(DISC, mass=0.5, x=(0.3, -2.0))}
    joints = {
        "hinge": dr.Revolute("upper", anchor_a=(0.0, 1.0)),
        "elbow": dr.Revolute("lower", "upper", anchor_a=(-0.3, 0.5), upper=2.0),
    }
    return dr.scene(bodies, joints=joints)


def flying_chain():
    """A door and a drawer on a box that tumbles: nothing is held."""
    random = np.random.default_rng(3)
    q = random.normal(size=(3, 4))
    bodies = {
        name: dr.Body(dr.Box(half=(0.1, 0.2, 0.3)), mass=mass, x=x, q=q / np.linalg.norm(q), v=0.2 * x, w=0.3 * x)
        for name, mass, x, q in zip(("door", "box", "drawer"), (1, 2, 3), random.normal(size=(3, 3)), q, strict=True)
    }
    joints = {
        "hinge": dr.Revolute("door", "box", anchor_a=(0.3, 0.1, 0.2), axis_a=(0.6, 0.0, 0.8)),
        "slider": dr.Prismatic("drawer", "box", anchor_a=(0.1, 0.4, 0.2), axis_b=(0.0, 0.6, -0.8)),
    }
    with pytest.warns(UserWarning, match="comes apart"):
        world, state = dr.scene(bodies, joints=joints)
    return world, onto_joints(world.joints, world.statics, world.bodies, state)


def held_from_a():
    """A slider whose body a hangs on a wall, so that setting it moves body b."""
    bodies = {
        "carriage": dr.Body(DISC, mass=1.0, x=(1.0, 0.0), angle=0.3, w=0.5),
        "rod": dr.Body(DISC, mass=1.0, x=(2.0, 0.5), angle=0.1, w=0.5, v=(-0.25, 0.5)),
        "wall": dr.Static(DISC, x=(-3.0, 0.0)),
    }
    joints = {
        "pivot": dr.Revolute("wall", "carriage", anchor_a=(4.0, 0.0)),
        "slider": dr.Prismatic("carriage", "rod", anchor_a=(0.1, 0.2), axis_b=(0.8, 0.6)),
    }
    return dr.scene(bodies, joints=joints)


SCENES = {"double pendulum": double_pendulum, "flying chain": flying_chain, "held from a": held_from_a}
LIGHT = "double pendulum", "held from a"  # to compile
COORDINATES = {
    "double pendulum": ("hinge.angle", "hinge.rate", "elbow.angle", "elbow.rate"),
    "flying chain": ("hinge.angle", "hinge.rate", "slider.translation", "slider.rate"),
    "held from a": ("pivot.angle", "pivot.rate", "slider.translation", "slider.rate"),
}


def off(world, state):
    """Errors of all joints, and their rates."""
    so, at = rotations(world.dim), placed(world.joints, world.statics, state.x, state.q)
    twists = to_sides(ends_of(world.joints), jnp.concatenate([state.v, state.w], axis=1))
    return np.stack([joint_errors(so, at), joint_rates(so, at, twists)])


@pytest.mark.parametrize("name", [*LIGHT, pytest.param("flying chain", marks=pytest.mark.slow)])
def test_what_is_set_is_read_and_all_else_about_the_joints_stays(name):
    world, state = SCENES[name]()
    values = {path: float(read(world, state, path)) for path in COORDINATES[name]}
    for path, value in zip(COORDINATES[name], (0.7, -1.5, 0.4, 0.9), strict=True):
        world, state = write(world, state, path, value)
        values[path] = value
        assert_allclose([read(world, state, p) for p in values], [*values.values()], atol=ROUNDING)
        assert_allclose(off(world, state), 0.0, atol=1e-10)  # of the flying chain as far as `onto_joints` brings it
    assert_allclose(np.linalg.norm(state.q, axis=1), 1.0, atol=ROUNDING)


def test_only_one_side_moves():
    """That which nothing else holds; of a free chain that of body a."""
    for name, path, moves in (
        ("double pendulum", "hinge.angle", [0, 1]),
        ("double pendulum", "elbow.angle", [1]),
        ("flying chain", "hinge.angle", [0]),
        ("held from a", "slider.translation", [1]),
    ):
        world, state = SCENES[name]()
        _, after = write(world, state, path, 0.3)
        moved = np.abs(after.x - state.x).max(1) > 1e-3
        assert np.flatnonzero(moved).tolist() == moves, (name, path)


def test_turned_pendulum_is_where_trigonometry_has_it():
    world, state = double_pendulum()
    world, state = write(*write(world, state, "hinge.angle", 0.5), "hinge.rate", 2.0)
    upper = np.array([np.sin(0.5), -np.cos(0.5)])
    assert_allclose(state.x[0], upper, atol=ROUNDING)
    assert_allclose(state.v[0], 2.0 * np.array([-upper[1], upper[0]]), atol=ROUNDING)
    arm = 0.3 * np.array([np.cos(0.5), np.sin(0.5)])
    assert_allclose(state.x[1], 2.0 * upper + arm, atol=ROUNDING)
    assert_allclose(state.w, 2.0, atol=ROUNDING)


@pytest.mark.parametrize(
    ("joint", "path", "value"),
    [
        (dr.Revolute("hand", "arm", anchor_a=(0.0, 0.0)), "j.angle", 0.7),
        (dr.Revolute("hand", "arm", anchor_a=(0.0, 0.0)), "j.rate", -1.0),
        (dr.Revolute("arm", "hand", anchor_a=(0.5 * np.cos(0.3), -0.5 * np.sin(0.3))), "j.angle", -0.7),
        (dr.Prismatic("hand", axis_b=(1.0, 0.0), anchor_b=(0.2, 0.0)), "j.translation", 0.3),
    ],
)
def test_a_coordinate_is_that_of_the_first_body_relative_to_the_second(joint, path, value):
    arm = dr.Body(DISC, mass=1.0, x=(0.0, 0.0), angle=0.3, v=(0.0, -0.5), w=1.0)
    hand = dr.Body(DISC, mass=1.0, x=(0.5, 0.0), angle=1.0)
    assert_allclose(read(*dr.scene({"arm": arm, "hand": hand}, joints={"j": joint}), path), value, atol=ROUNDING)


def test_a_joint_that_came_apart_is_closed():
    """A pendulum made longer: its bob follows, and so does its velocity."""
    world, state = double_pendulum()
    world, state = write(world, state, "hinge.rate", 1.5)
    world, state = write(world, state, "hinge.anchor_a", (0.0, 1.25))
    world, state = write(*write(world, state, "hinge.angle", 0.2), "hinge.rate", 1.5)
    assert_allclose(off(world, state), 0.0, atol=ROUNDING)
    assert_allclose(np.linalg.norm(state.x[0]), 1.25, atol=ROUNDING)
    assert_allclose(np.linalg.norm(state.v[0]), 1.25 * 1.5, atol=ROUNDING)


@pytest.mark.parametrize("name", SCENES)
def test_slopes_are_those_of_differences(name):
    world, state = SCENES[name]()

    @jax.jit
    def poses(values):
        pair = world, state
        for path, value in zip(COORDINATES[name], values, strict=True):
            pair = write(*pair, path, value)
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(pair[1])])

    at, h = jnp.array([0.7, -1.5, 0.4, 0.9]), 1e-5
    by_difference = np.stack([(poses(at + h * e) - poses(at - h * e)) / (2 * h) for e in np.eye(4)], axis=-1)
    for jacobian in (jax.jacfwd, jax.jacrev):
        assert_allclose(jax.jit(jacobian(poses))(at), by_difference, atol=1e-8)


def test_units_and_what_cannot_be_set():
    world, state = flying_chain()
    assert [unit(world, path) for path in COORDINATES["flying chain"]] == ["rad", "rad/s", "m", "m/s"]
    square = {k: dr.Body(DISC, mass=1.0, x=x) for k, x in zip("abc", ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), strict=True)}
    loop = {f"{a}{b}": dr.Revolute(a, b, anchor_a=(0.5, 0.5)) for a, b in ("ab", "bc", "ca")}
    world, state = dr.scene(square, joints=loop)
    assert "ab.angle" not in catalogue(world)
    with pytest.raises(ValueError, match="ab is part of a closed loop"):
        write(world, state, "ab.angle", 0.1)


def test_a_pendulum_is_fitted_from_its_encoder():
    """Length, damping and how it began, of which nothing is known before."""
    true = dict(
        zip(("hinge.angle", "hinge.rate", "hinge.damping", "hinge.anchor_a[1]"), (0.7, -0.4, 0.05, 1.0), strict=True)
    )

    def pendulum():
        bob = dr.Body(DISC, mass=1.0, x=(0.0, -0.8))
        hinge = dr.Revolute("bob", anchor_a=(0.0, 0.8), anchor_b=(0.0, 0.0), damping=0.01)
        return dr.scene({"bob": bob}, joints={"hinge": hinge}, gravity=(0.0, -9.81))

    world, state = pendulum()
    for path in ("hinge.damping", "hinge.anchor_a[1]", "hinge.angle", "hinge.rate"):
        world, state = write(world, state, path, true[path])
    t = np.arange(45) / 30
    states = dr.rollout(world, state, dt=1 / 60, times=t).state
    angle = jax.vmap(lambda state: read(world, state, "hinge.angle"))(states)
    noisy = np.asarray(angle) + 2e-3 * np.random.default_rng(1).normal(size=len(t))
    free = {path: dr.positive() if "damping" in path or "anchor" in path else dr.real() for path in true}
    found = dr.fit(
        *pendulum(), {"t": t, "hinge.angle": noisy + 2 * np.pi}, free=free, noise={"hinge.angle": 2e-3}, dt=1 / 60
    )
    for path, value in true.items():
        parameter = found[path]
        assert parameter.low < value < parameter.high, path
        assert parameter.high - parameter.low < 0.1
    assert not any("off the joint" in note for note in found.notes)
    with pytest.raises(ValueError, match="set the same number"):
        dr.fit(*pendulum(), {"t": t, "hinge.angle": noisy}, free={"hinge.angle": dr.real(), "bob.angle": dr.real()})
