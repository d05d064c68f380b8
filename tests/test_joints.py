"""Joints: motions in closed form or of an integrator in NumPy, impacts of what is joined, and mistakes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import numpy_motion, vector, with_slopes
from jax import lax
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.state import rotations

G = 9.81
EXACT = 1e-9


def end_of(scene, t, rate):
    world, state = scene
    times = jnp.stack([jnp.zeros_like(jnp.asarray(t, float)), t])
    trajectory = dr.rollout(world, state, dt=1 / rate, times=times, substeps=(round(1.0 * rate),))
    return jax.tree.map(lambda leaf: leaf[-1], trajectory.state)


# ---- motion


def pendulum(mass, inertia, length, angle, dim=2):
    """A body on a hinge at the origin, in the plane or in space about the third axis."""
    x = jnp.stack([length * jnp.sin(angle), -length * jnp.cos(angle)])
    anchor, zero = jnp.stack([jnp.zeros_like(length), length]), jnp.zeros_like(length)[None]
    if dim == 2:
        body = dr.Body(None, mass=mass, inertia=inertia, x=x, angle=angle)
        return dr.scene({"bob": body}, gravity=(0.0, -G), joints=[dr.Revolute("bob", anchor_a=anchor)])
    q = jnp.stack([jnp.cos(angle / 2), 0.0 * angle, 0.0 * angle, jnp.sin(angle / 2)])
    tensor = jnp.diag(jnp.array([0.7, 0.8, 1.0])) * inertia
    body = dr.Body(None, mass=mass, inertia=tensor, x=jnp.concatenate([x, zero]), q=q)
    hinge = dr.Revolute("bob", anchor_a=jnp.concatenate([anchor, zero]), axis_a=(0.0, 0.0, 1.0))
    return dr.scene({"bob": body}, gravity=(0.0, -G, 0.0), joints=[hinge])


PENDULUM = (1.3, 0.2, 0.7, 2.0)  # kg, kg m^2, m, rad


def true_angle(mass, inertia, length, angle):
    torque, about_hinge = mass * G * length, inertia + mass * length**2
    return numpy_motion(lambda y: np.array([y[1], -torque / about_hinge * np.sin(y[0])]), (angle, 0.0), 1.0)[0]


def angle_of(q):
    return jnp.arctan2(q[1], q[0])


def test_pendulum_and_its_derivatives():
    """Over most of a swing from 115 degrees, by mass, inertia, length and start; both modes."""

    def angle(*p):
        return angle_of(end_of(pendulum(*p), 1.0, 240).q[0])

    numbers = tuple(map(jnp.asarray, PENDULUM))
    value, slopes = jax.value_and_grad(angle, argnums=(0, 1, 2, 3))(*numbers)
    assert_allclose(value, true_angle(*PENDULUM), atol=1e-7)
    for k in range(4):
        shift = 1e-5 * np.eye(4)[k]
        slope = (true_angle(*(PENDULUM + shift)) - true_angle(*(PENDULUM - shift))) / 2e-5
        assert_allclose(slopes[k], slope, atol=1e-6)
    forward = jax.jacfwd(angle, argnums=(0, 1, 2, 3))(*numbers)
    assert_allclose(forward, slopes, rtol=EXACT)


@pytest.mark.slow
def test_hinge_in_space_is_the_hinge_in_the_plane():
    flat, space = (end_of(pendulum(*map(jnp.asarray, PENDULUM), dim=dim), 1.0, 60) for dim in (2, 3))
    assert_allclose(space.x[0, :2], flat.x[0], atol=1e-6)  # rotations are integrated in other numbers
    assert_allclose(space.w[0], (0.0, 0.0, flat.w[0, 0]), atol=1e-5)


def test_pendulum_keeps_its_energy_for_a_minute():
    body = dr.Body(None, mass=1.0, inertia=0.1, x=(0.5, 0.0))
    world, state = dr.scene({"bob": body}, gravity=(0.0, -G), joints=[dr.Revolute("bob", anchor_a=(-0.5, 0.0))])
    states = dr.rollout(world, state, dt=1 / 60, steps=3600).state
    energy = jax.vmap(lambda s: dr.kinetic_energy(world.bodies, s).sum() + G * s.x[0, 1])(states)
    assert float(energy.max() - energy.min()) < 1e-5 * G
    assert_allclose(jnp.linalg.norm(states.x[:, 0], axis=1), 0.5, atol=1e-12)


def test_double_pendulum():
    """Two rods of 1 m and 1 kg, from over the top: chaotic, against the Lagrangian equations in NumPy."""
    start = np.array([2.0, 2.5])

    def down(angle):
        return np.array([np.sin(angle), -np.cos(angle)])

    def rates(y):
        (a, b), w = y[:2], y[2:]
        c, s = 0.5 * np.cos(a - b), 0.5 * np.sin(a - b)
        mass = np.array([[4 / 3, c], [c, 1 / 3]])
        force = np.array([-s * w[1] ** 2 - 1.5 * G * np.sin(a), s * w[0] ** 2 - 0.5 * G * np.sin(b)])
        return np.concatenate([w, np.linalg.solve(mass, force)])

    rod = {"mass": 1.0, "inertia": 1 / 12}
    bodies = {
        "upper": dr.Body(None, x=0.5 * down(start[0]), angle=start[0], **rod),
        "lower": dr.Body(None, x=down(start[0]) + 0.5 * down(start[1]), angle=start[1], **rod),
    }
    joints = [dr.Revolute("upper", anchor_a=(0.0, 0.5)), dr.Revolute("lower", "upper", anchor_a=(0.0, 0.5))]
    world, state = dr.scene(bodies, gravity=(0.0, -G), joints=joints)
    x = dr.rollout(world, state, dt=1 / 240, steps=480).state.x[-1]
    a, b = numpy_motion(rates, (*start, 0.0, 0.0), 2.0)[:2]
    assert_allclose(x, [0.5 * down(a), down(a) + 0.5 * down(b)], atol=1e-6)


def test_gyroscope_precesses_steadily():
    """A spinning top with its axis level, on a ball joint: m g l = I3 spin precession, exactly where it turns so."""
    inertia, arm, mass, spin = (0.02, 0.02, 0.03), 0.1, 1.0, 40.0
    precession = mass * G * arm / (inertia[2] * spin)
    level = {"q": (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0), "w": (spin, 0.0, precession)}
    top = dr.Body(None, mass=mass, inertia=inertia, x=(arm, 0.0, 0.0), v=(0.0, arm * precession, 0.0), **level)
    scene = dr.scene({"top": top}, gravity=(0.0, 0.0, -G), joints=[dr.Ball("top", anchor_a=(0.0, 0.0, -arm))])
    end = end_of(scene, 1.0, 240)
    at = np.array([np.cos(precession), np.sin(precession), 0.0])
    assert_allclose(end.x[0], arm * at, atol=1e-5)
    assert_allclose(end.w[0], spin * at + [0.0, 0.0, precession], atol=1e-3)


def test_slider_rod_and_weld():
    """A block falls down a slanted rail; a mass on a massless rod swings; two welded bodies turn about their centre."""
    along, mass = np.array([0.8, -0.6]), {"mass": 2.0, "inertia": 0.3}
    bodies = {
        "block": dr.Body(None, x=(0.0, 0.0), **mass),
        "bob": dr.Body(None, x=(5.7, 0.0), w=0.4, **mass),
        "left": dr.Body(None, x=(9.0, 0.0), v=(0.0, -3.0), w=3.0, **mass),
        "right": dr.Body(None, x=(11.0, 0.0), v=(0.0, 3.0), w=3.0, angle=0.5, **mass),
    }
    joints = {
        "rail": dr.Prismatic("block", axis_b=along),
        "rod": dr.Distance("bob", anchor_b=(5.0, 0.0)),
        "weld": dr.Weld("left", "right"),
    }
    end = end_of(dr.scene(bodies, gravity=(0.0, -G), joints=joints), 1.0, 120)
    assert_allclose(end.x[0], 0.5 * 0.6 * G * along, atol=EXACT)
    angle = numpy_motion(lambda y: np.array([y[1], -G / 0.7 * np.sin(y[0])]), (np.pi / 2, 0.0), 1.0)[0]
    assert_allclose(end.x[1], [5.0 + 0.7 * np.sin(angle), -0.7 * np.cos(angle)], atol=1e-6)
    assert_allclose(end.w[1], 0.4, atol=EXACT)
    turned = np.array([np.cos(3.0), np.sin(3.0)])
    centre = np.array([10.0, -0.5 * G])
    assert_allclose(end.x[2:], [centre - turned, centre + turned], atol=1e-6)
    assert_allclose([angle_of(q) for q in end.q[2:]], [3.0, 3.5 - 2 * np.pi], atol=1e-6)


# ---- contact


@pytest.mark.slow
def test_a_block_slips_both_ways_on_a_plank_that_a_motor_pulls():
    """The motor never reaches its speed: until the slip is zero the block drags the plank along, from then on back."""

    def end(force, speed):
        plank = dr.Body(dr.Box(half=(1.5, 0.05)), mass=1.28, x=(0.0, 0.0), v=jnp.stack([speed, 0.0]))
        block = dr.Body(dr.Box(half=(0.15, 0.05)), mass=1.087, x=(0.0, 0.1), v=(1.95, 0.0))
        motor = dr.Prismatic("plank", axis_b=(1.0, 0.0), speed=100.0, friction=force)
        scene = dr.scene({"plank": plank, "block": block}, gravity=(0.0, -9.81), friction=0.15, joints=[motor])
        state = dr.rollout(*scene, dt=1 / 60, steps=30).state
        return jnp.concatenate([state.x[-1, :, 0], state.v[-1, :, 0]])

    def exact(force, speed):
        mass, v = jnp.array([1.28, 1.087]), jnp.stack([speed, 1.95])
        pull, rub = jnp.stack([force, 0.0]), 0.15 * 1.087 * 9.81 * jnp.array([1.0, -1.0])
        before, after = (pull + rub) / mass, (pull - rub) / mass
        slips = (v[1] - v[0]) / (before[0] - before[1])
        there, then = v + before * slips, 0.5 - slips
        return jnp.concatenate([0.5 * (v + there) * slips + there * then + 0.5 * after * then**2, there + after * then])

    (got, slopes), (expected, true_slopes) = (with_slopes(f)(8.62, -0.937) for f in (end, exact))
    assert_allclose(got, expected, rtol=1e-12)
    assert_allclose(jnp.stack(slopes), jnp.stack(true_slopes), rtol=1e-9)


def test_hinged_rod_rebounds():
    """No gravity: the tip strikes a wall, w -> -e w at once, whatever the hinge takes up; exact, with its slopes."""

    def angle(e, w, offset):
        rod = dr.Capsule(half_length=0.5, radius=0.05)
        bodies = {
            "rod": dr.Body(rod, mass=1.0, x=vector(0.5, 0.0), v=vector(0.0, 0.5 * w), w=w),
            "wall": dr.Static(dr.HalfSpace(normal=(0.0, 1.0), offset=offset)),
        }
        scene = dr.scene(bodies, restitution=e, joints=[dr.Revolute("rod", anchor_a=(-0.5, 0.0))])
        return angle_of(end_of(scene, 1.0, 240).q[0])

    def expected(e, w, offset):
        strikes = jnp.arcsin(offset + 0.05)
        return strikes - e * w * (1.0 - strikes / w)

    p = tuple(map(jnp.asarray, (0.8, -1.1, -0.4)))
    value, slopes = with_slopes(angle)(*p)
    assert_allclose(value, expected(*p), atol=EXACT)
    assert_allclose(slopes, jax.grad(expected, (0, 1, 2))(*p), atol=1e-8)


@pytest.mark.slow
def test_slopes_of_a_thrown_arm_are_those_of_differences():
    """Two hinged boxes strike the floor with their corners, and slide."""
    bodies = {
        "a": dr.Body(dr.Box(half=(0.3, 0.2)), mass=1.0, x=(0.0, 1.0)),
        "b": dr.Body(dr.Box(half=(0.3, 0.2)), mass=1.5, x=(0.8, 1.0)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    joints = [dr.Revolute("a", "b", anchor_a=(0.4, 0.0))]
    world, state = dr.scene(bodies, gravity=(0.0, -G), restitution=0.6, friction=0.3, joints=joints)

    def thrown(w, angle):
        q = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        arms = jnp.stack([-0.4 * q, 0.4 * q])
        x = jnp.array([[0.0, 1.0]]) + arms
        v = jnp.array([[0.5, 0.0]]) + w * jnp.stack([-arms[:, 1], arms[:, 0]], axis=1)
        start = dr.State(x=x, q=jnp.stack([q, q]), v=v, w=jnp.stack([w, w])[:, None])
        return lax.fori_loop(0, 36, lambda _, state: dr.step(world, state, 1 / 60), start).x

    @jax.jit
    @jax.vmap
    def ends_and_slopes(w, angle):
        return jax.jvp(lambda w: thrown(w, angle), (w,), (jnp.ones_like(w),))

    w, angle, h = jnp.array([-2.0, -0.5, 1.0, 3.0]), jnp.array([0.3, 1.1, 2.0, -0.7]), 1e-6
    ends, slopes = ends_and_slopes(jnp.concatenate([w, w + h, w - h]), jnp.tile(angle, 3))
    assert_allclose(slopes[:4], (ends[4:8] - ends[8:]) / (2 * h), atol=1e-7)


@pytest.mark.slow
def test_a_joint_of_others_changes_nothing():
    """A box that strikes the floor with a corner, and slides there, does the same beside two bodies with a joint."""
    q = jnp.array([0.95, 0.2, 0.15, 0.1])
    box = dr.Box(half=(0.3, 0.2, 0.1))
    thrown = dr.Body(box, mass=1.0, x=(0.0, 0.0, 0.3), q=q / jnp.linalg.norm(q), v=(2.0, 0.5, -1.0), w=(1.0, 2.0, 3.0))
    others = {
        name: dr.Body(None, mass=1.0, inertia=jnp.eye(3), x=(x, 0.0, 5.0)) for name, x in (("b", 0.0), ("c", 1.0))
    }
    bodies = {"a": thrown, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0))), **others}
    velocities = []
    for joints in ([], [dr.Ball("b", "c", anchor_a=(0.5, 0.0, 0.0))]):
        world, state = dr.scene(bodies, gravity=(0.0, 0.0, -G), friction=0.2, joints=joints)
        after = dr.step(world, state, 0.05)
        velocities.append(jnp.concatenate([after.v[0], after.w[0]]))
    alone, beside = velocities
    assert alone[2] > -1.0  # struck
    assert_allclose(beside, alone, atol=1e-4)  # the free motion is integrated where there are joints


@pytest.mark.slow
def test_an_arm_falls_on_the_floor_and_rests():
    """Two boxes and a hinge: the hinge holds, and energy never rises by more than to lift them by g dt^2 / 8.

    So far a corner rises that takes off and lands within a step, beside one that rests: its force is even over the step.
    """
    bodies = {
        "a": dr.Body(dr.Box(half=(0.5, 0.1)), mass=1.0, x=(0.0, 1.0)),
        "b": dr.Body(dr.Box(half=(0.5, 0.1)), mass=2.0, x=(1.0, 1.0), v=(0.0, 0.5), w=1.0),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    joints = [dr.Revolute("a", "b", anchor_a=(0.5, 0.0))]
    world, state = dr.scene(bodies, gravity=(0.0, -G), restitution=0.3, friction=0.4, joints=joints)
    states = dr.rollout(world, state, dt=1 / 120, steps=240).state
    potential = G * (states.x[:, :, 1] @ world.bodies.mass)
    energy = jax.vmap(lambda s: dr.kinetic_energy(world.bodies, s).sum())(states) + potential
    assert float(jnp.diff(energy).max()) < G * float(world.bodies.mass.sum()) * G * (1 / 120) ** 2 / 8
    ends = [
        jax.vmap(lambda s, k=k, r=r: dr.material_point(s, k, vector(r, 0.0)))(states) for k, r in ((0, 0.5), (1, -0.5))
    ]
    assert_allclose(ends[0], ends[1], atol=2e-5)
    assert float(jnp.abs(states.v[-1]).max()) < 1e-9


@pytest.mark.slow
def test_repeated_joints_are_harmless():
    """Two hinges between the same two bodies, and a third: more equations than freedoms."""
    body = {"mass": 1.0, "inertia": 0.2}
    bodies = {"a": dr.Body(None, x=(0.0, 0.0), **body), "b": dr.Body(None, x=(1.0, 0.0), w=2.0, v=(0.0, 1.0), **body)}
    bodies["a"] = dr.Body(None, x=(0.0, 0.0), w=2.0, v=(0.0, -1.0), **body)
    joints = [dr.Revolute("a", "b", anchor_a=(0.5, y)) for y in (0.0, 0.4, 0.8)]
    world, state = dr.scene(bodies, joints=joints)

    def far(world):
        return dr.rollout(world, state, dt=1 / 60, steps=60).state.x[-1]

    assert_allclose(
        far(world),
        [[0.5 - 0.5 * np.cos(2.0), -0.5 * np.sin(2.0)], [0.5 + 0.5 * np.cos(2.0), 0.5 * np.sin(2.0)]],
        atol=1e-6,
    )
    slopes = jax.grad(lambda world: far(world).sum())(world)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


# ---- mistakes

ARM = {"arm": dr.Body(None, mass=1.0, inertia=1.0, x=(1.0, 0.0)), "wall": dr.Static(dr.HalfSpace(normal=(1.0, 0.0)))}
ARM["post"] = dr.Static(dr.Disc(radius=0.1), x=(0.0, 5.0))
MISTAKES = {
    "unknown": (r"revolute\.a is 'arn'.* did you mean 'arm'", dr.Revolute("arn", anchor_a=(0.0, 0.0))),
    "statics": (r"revolute joins 'wall' to 'post': expected one that moves", dr.Revolute("wall", "post", anchor_a=(0.0, 0.0))),
    "world first": (r"revolute.a is None: expected a body; name it first", dr.Revolute(None, "arm", anchor_a=(0.0, 0.0))),
    "itself": (r"joins 'arm' to itself", dr.Revolute("arm", "arm", anchor_a=(0.0, 0.0))),
    "half a turn off": ("weld does not hold at the start: it is off by 2 ", dr.Weld("arm", q=(-1.0, 0.0))),
    "apart": (r"revolute does not hold at the start: it is off by 0\.5 .*move a body, or leave out anchor_b,", dr.Revolute("arm", anchor_a=(0.0, 0.0), anchor_b=(1.0, 0.5))),
    "of another length": (r"distance .* off by 0\.01 .* leave out length, which", dr.Distance("arm", anchor_b=(-1.0, 0.0), length=2.01)),
    "axis": (r"prismatic\.axis_b has no length", dr.Prismatic("arm", axis_b=(0.0, 0.0))),
    "shape": (r"revolute\.anchor_a has shape \(3,\)", dr.Revolute("arm", anchor_a=(0.0, 0.0, 0.0))),
    "name": (r"joints: 'arm' is not a name, or is taken", {"arm": dr.Ball("arm", anchor_a=(0.0, 0.0))}),
    "kind": (r"joints: 'float' is 3\.0: expected one of Revolute", 3.0),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named_with_their_fix(name):
    message, joint = MISTAKES[name]
    with pytest.raises(ValueError, match=message):
        dr.scene(ARM, joints=joint if isinstance(joint, dict) else [joint])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_weld_far_off_is_put_right_the_short_way(dim):
    """By more than a quarter of a turn, where the sine of the angle would lead to half a turn."""
    unturned, inertia = np.eye(2 if dim == 2 else 4)[0], 1.0 if dim == 2 else (1.0,) * 3
    bodies = {name: dr.Body(None, mass=1.0, inertia=inertia, x=np.full(dim, x)) for name, x in (("a", 0.0), ("b", 0.5))}
    world, state = dr.scene(bodies, joints=[dr.Weld("a", "b")])
    turn = np.array([2.5]) if dim == 2 else 2.5 * np.array([0.48, 0.64, 0.6])
    off = dr.replace(state, q=state.q.at[0].set(rotations(dim).exp(turn)))
    q = dr.rollout(world, off, dt=1 / 60, steps=5).state.q[-1]
    assert_allclose(jnp.abs(rotations(dim).difference(q[1], q[0])), unturned, atol=1e-9)
    assert rotations(dim).difference(q[1], q[0])[0] > 0 or dim == 3  # q and -q are one turn in space


def test_a_start_that_tears_a_joint_is_reported():
    still = dr.Body(None, mass=1.0, inertia=1.0, x=(1.0, 0.0), w=2.0)
    with pytest.warns(UserWarning, match=r"pin.*velocities at the start do not fit.*2 m/s"):
        world, state = dr.scene({"arm": still}, joints={"pin": dr.Revolute("arm", anchor_a=(-1.0, 0.0))})
    assert world.joint_names == (("pin",),)
    after = dr.step(world, state, 1e-3)
    assert_allclose(after.v[0, 1], after.w[0, 0], rtol=1e-5)  # the hinge holds; its impulse keeps L about the pin
    assert_allclose(after.w[0, 0], 1.0, rtol=EXACT)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_digits_of_a_joint_that_count_are_those_of_its_unit(kind):
    """A hinge far out in millimetres, rounded; one that is 90 um off on a body of 100 um."""
    place, w = np.array([2000.3, 1500.7], kind), kind(0.01)
    with jax.enable_x64(kind is np.float64):
        arm = dr.Body(None, mass=1.0, inertia=1.0, x=place + kind(0.7), v=0.7 * w * np.array([-1.0, 1.0]), w=w)
        hinge = dr.Revolute("arm", anchor_a=np.full(2, -0.7, kind), anchor_b=place)
        dr.scene({"arm": arm}, joints=[hinge])
        tiny = dr.Body(None, mass=1.0, inertia=1.0, x=(1e-4, 0.0))
        with pytest.raises(ValueError, match="does not hold at the start: it is off by 9e-05"):
            dr.scene({"arm": tiny}, joints=[dr.Revolute("arm", anchor_a=(-1e-4, 9e-5), anchor_b=(0.0, 0.0))])


@pytest.mark.filterwarnings("ignore:.*velocities at the start do not fit")
def test_an_impulse_of_the_joints_makes_velocities_fit_at_the_start():
    """Two free bodies on a hinge at the origin: the impulse by hand, and what keeps at any step afterwards."""
    masses, inertias, x = np.array([1.0, 3.0]), np.array([0.2, 0.7]), np.array([[0.6, 0.2], [-0.5, 0.3]])
    v, w = np.array([[0.3, 2.0], [-1.0, 0.4]]), np.array([5.0, -2.0])
    parts = zip(masses, inertias, x, v, w, strict=True)
    bodies = {str(i): dr.Body(None, mass=m, inertia=j, x=x, v=v, w=w) for i, (m, j, x, v, w) in enumerate(parts)}
    world, state = dr.scene(bodies, joints=[dr.Revolute("0", "1", anchor_a=-x[0])])
    arms = -np.stack([-x[:, 1], x[:, 0]], axis=1)  # of the hinge, turned by 90 degrees: its velocity is v + w arm
    K = (1 / masses).sum() * np.eye(2) + np.einsum("k,ki,kj->ij", 1 / inertias, arms, arms)
    apart = np.diff(v + w[:, None] * arms, axis=0)[0]
    P = np.linalg.solve(K, apart) * np.array([1.0, -1.0])[:, None]
    w_hand = w + (arms * P).sum(1) / inertias

    coarse, fine = (dr.rollout(world, state, dt=0.2 / n, steps=n).state for n in (40, 80))
    assert_allclose(coarse.v[0], v + P / masses[:, None], atol=EXACT)
    assert_allclose(coarse.w[0, :, 0], w_hand, atol=EXACT)
    assert_allclose(coarse.x[-1], fine.x[-1], atol=1e-7)
    L = [dr.angular_momentum(world.bodies, jax.tree.map(lambda leaf: leaf[k], fine)).sum(0) for k in (0, -1)]  # noqa: B023
    assert_allclose(L[1], L[0], atol=1e-9)
