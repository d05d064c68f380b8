"""Limits, friction, motors and damping of joints, against closed forms; and mistakes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import vector, with_slopes
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import diffrigid as dr
from diffrigid import so3

INERTIA, RATE = 0.5, 60
EXACT = 1e-9
START = jnp.array([0.5, 0.5, 0.5, -0.5])  # orientation, a third of a turn
AXIS = jnp.array([0.48, 0.64, 0.6])  # of the wheel, in its own axes


def wheel(w, dim=2, **along):
    """A wheel on an axle; in space turned at the start, about an axis that is none of the world's nor of the body's."""
    return wheels({"wheel": (w, along)}, dim)


def wheels(made, dim):
    """A wheel for every name, of which `made` has the spin [rad/s] and what its hinge is given."""
    bodies, joints = {}, []
    for name, (w, along) in made.items():
        if dim == 2:
            bodies[name] = dr.Body(None, mass=1.0, inertia=INERTIA, x=(0.0, 0.0), w=w)
            joints.append(dr.Revolute(name, anchor_a=0.0, **along))
        else:
            whole = dict(inertia=(INERTIA,) * 3, x=(0.0, 0.0, 0.0), q=START, w=w * so3.rotate(START, AXIS))
            bodies[name] = dr.Body(None, mass=1.0, **whole)
            joints.append(dr.Revolute(name, anchor_a=0.0, axis_a=AXIS, **along))
    return dr.scene(bodies, joints=joints)


def turned(scene, seconds, body=0):
    """Angle turned [rad], and at the end its rate [rad/s] and the whole angular velocity."""
    world, state = scene
    path = dr.rollout(world, state, dt=1 / RATE, steps=round(seconds * RATE)).state
    q, w = path.q[:, body], path.w[-1, body]
    if world.dim == 2:
        angle = jnp.arctan2(q[:, 1], q[:, 0])
    else:
        angle = jnp.sqrt((jax.vmap(so3.log)(jax.vmap(so3.difference, (None, 0))(START, q)) ** 2).sum(-1))
    return jnp.unwrap(angle)[-1], jnp.sqrt((w**2).sum()), w


def check_with_slopes(got, expected, arguments, derivative=jax.jacfwd, atol=EXACT):
    """Two functions of the same numbers, and their slopes, compiled at once."""
    numbers, which = tuple(map(jnp.asarray, arguments)), tuple(range(len(arguments)))
    value, slopes = with_slopes(got, derivative)(*numbers)
    assert_allclose(value, expected(*numbers), atol=atol)
    assert_allclose(slopes, jax.jacfwd(expected, which)(*numbers), atol=atol)


@pytest.mark.parametrize("mode", [jax.jacfwd, pytest.param(jax.grad, marks=pytest.mark.slow)])
def test_a_motor_reaches_its_speed_and_dry_friction_stops_it(mode):
    """By I dw / torque, which falls inside a step. Friction is a motor of speed 0."""
    check_with_slopes(
        lambda w, speed, torque: turned(wheel(w, friction=torque, speed=speed), 2.0)[0],
        lambda w, speed, torque: 2.0 * speed + INERTIA * (w - speed) * jnp.abs(w - speed) / (2 * torque),
        (1.7, 0.3, 0.473),
        mode,
    )


def test_a_wheel_without_a_motor_turns_on_beside_one_that_is_braked():
    """A motor or friction holds its body to the end of a step; what is joined to none flies there. Slopes by time too."""
    scene = wheels({"braked": (1.7, {"friction": 0.473}), "free": (0.9, {})}, 2)

    def angles(time):
        end = dr.rollout(*scene, dt=1.0, times=jnp.stack([0.0 * time, time]), substeps=(30,)).state.q[-1]
        return jnp.arctan2(end[:, 1], end[:, 0])

    check_with_slopes(angles, lambda t: jnp.stack([1.7 * t - 0.5 * 0.473 / INERTIA * t**2, 0.9 * t]), (0.7,))


@pytest.mark.slow
def test_a_limit_of_a_joint_that_does_not_rub_is_struck_at_its_time():
    check_with_slopes(
        lambda w, upper, e: turned(wheel(w, upper=upper, restitution=e), 1.0)[0],
        lambda w, upper, e: upper - e * (w - upper),
        (1.7, 1.0, 0.6),
    )


@with_slopes
def after_two_seconds(w, upper, e, torque):
    return turned(wheel(w, upper=upper, restitution=e, friction=torque), 2.0)[0]


@pytest.mark.parametrize(("numbers", "atol"), [((1.7, 2.0, 0.6, 0.0), EXACT), ((1.7, 1.0, 0.6, 0.4), 1e-8)])
def test_a_limit_is_struck_at_its_time(numbers, atol):
    """Friction of the joint acts until then, and from then on until the wheel stops."""

    def expected(w, upper, e, torque):
        if torque == 0.0:
            return upper - e * (2.0 * w - upper)
        return upper - e**2 * (INERTIA * w**2 / (2 * torque) - upper)

    numbers = tuple(map(jnp.asarray, numbers))
    value, slopes = after_two_seconds(*numbers)
    which = (0, 1, 2) if numbers[-1] == 0.0 else (0, 1, 2, 3)
    assert_allclose(value, expected(*numbers), atol=atol)
    assert_allclose([slopes[k] for k in which], jax.jacfwd(expected, which)(*numbers), atol=atol)


def test_damping_is_exponential():
    """To the fourth order of the integration."""
    check_with_slopes(
        lambda w, damping: turned(wheel(w, damping=damping), 1.0)[1],
        lambda w, damping: w * jnp.exp(-damping / INERTIA),
        (1.7, 0.3),
        atol=1e-8,
    )


@pytest.mark.slow
def test_damping_slows_what_friction_leaves():
    """A slider with both, v = (v0 + F / c) exp(-c t / m) - F / c: the damping acts on what friction has done so far."""
    t, F = 0.5, 2.0

    def end(c, v):
        body = dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0), v=v * jnp.array([0.6, 0.8]))
        slider = dr.Prismatic("body", None, axis_b=(0.6, 0.8), friction=F, damping=c)
        state = dr.rollout(*dr.scene({"body": body}, joints=[slider]), dt=1 / RATE, steps=round(t * RATE)).state
        return jnp.stack([jnp.sqrt((state.x[-1, 0] ** 2).sum()), jnp.sqrt((state.v[-1, 0] ** 2).sum())])

    def expected(c, v):
        all_of_it = (v + F / c) * jnp.array([-jnp.expm1(-c * t) / c, jnp.exp(-c * t)])
        return all_of_it - F / c * jnp.array([t, 1.0])

    check_with_slopes(end, expected, (0.8, 3.0), atol=3e-5)


def test_a_damping_that_no_step_resolves_stops_the_joint():
    """It acts within a thousandth of a step: an explicit integration would throw the wheel about, without bound."""
    value, slope = with_slopes(lambda damping: turned(wheel(1.7, damping=damping), 1.0)[:2])(jnp.asarray(3e4))
    assert abs(value[1]) < 1e-9 and abs(value[0]) < 2 * 1.7 / RATE
    assert np.isfinite(np.asarray(slope)).all()


@pytest.mark.slow
def test_a_hinge_in_space_stops_as_in_the_plane():
    along = {"upper": 1.0, "restitution": 0.6, "friction": 0.1, "damping": 0.02}
    flat, space = (jax.jit(lambda w, dim=dim: turned(wheel(w, dim, **along), 1.0))(1.7) for dim in (2, 3))
    assert_allclose(space[:2], flat[:2], atol=1e-9)
    axis = so3.rotate(START, AXIS)
    assert_allclose(space[2], flat[2][0] * axis, atol=1e-9)


@pytest.mark.slow
def test_a_pendulum_rests_on_its_stop():
    """After rebounds; and its stop is at the same place with an arm that hangs on it by a second joint."""

    def scene(hand):
        bodies = {"arm": dr.Body(None, mass=1.0, inertia=0.1, x=(0.5, 0.0))}
        joints = [dr.Revolute("arm", anchor_a=(-0.5, 0.0), lower=-1.0, restitution=0.3)]
        if hand:
            bodies["hand"] = dr.Body(None, mass=0.5, inertia=0.05, x=(1.4, 0.0))
            joints.append(dr.Revolute("hand", "arm", anchor_a=(-0.4, 0.0), friction=0.3, damping=0.1))
        return dr.scene(bodies, gravity=(0.0, -9.81), joints=joints)

    for hand in (False, True):
        world, state = scene(hand)
        path = dr.rollout(world, state, dt=1 / RATE, steps=6 * RATE).state
        angle = jnp.arctan2(path.q[:, 0, 1], path.q[:, 0, 0])
        assert float(angle.min()) > -1.0 - 1e-5
        assert_allclose(angle[-1], -1.0, atol=1e-6)
        assert float(dr.kinetic_energy(world.bodies, jax.tree.map(lambda leaf: leaf[-1], path)).sum()) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("metre", [1.0, 1e-9])
def test_a_slider_between_elastic_stops_keeps_its_energy(metre):
    body = dr.Body(None, mass=1.0, inertia=0.1, x=(0.1 * metre, 0.0), v=(1.3 * metre, 0.0))
    ends = dict(lower=-0.2 * metre, upper=0.3 * metre, restitution=1.0)
    slider = dr.Prismatic("body", axis_b=(1.0, 0.0), anchor_b=(0.0, 0.0), **ends)
    world, state = dr.scene({"body": body}, joints=[slider], contact=dr.Contact(rest_speed=1e-3 * metre))
    path = dr.rollout(world, state, dt=1 / RATE, steps=4 * RATE).state
    assert_allclose(jnp.abs(path.v[:, 0, 0]), 1.3 * metre, rtol=1e-12)
    way = 0.1 + 1.3 * np.arange(4 * RATE + 1) / RATE + 0.2  # of an image that is not thrown back
    assert_allclose(path.x[:, 0, 0] / metre, 0.5 - np.abs(way % 1.0 - 0.5) - 0.2, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [100.0, 120.0, 170.0])
def test_what_rests_on_the_stop_of_what_rests_on_its_stop(angle):
    """Two links: where both fall freely the second leaves its stop, as it turns more slowly, or goes through it."""
    first, second = vector(-1.0, 0.0), vector(np.cos(np.radians(angle)), np.sin(np.radians(angle)))
    bodies = {
        "first": dr.Body(None, mass=1.0, inertia=0.1, x=0.5 * first),
        "second": dr.Body(None, mass=1.0, inertia=0.1, x=first + 0.5 * second),
    }
    hinges = [
        dr.Revolute("first", anchor_a=-0.5 * first, upper=0.0),
        dr.Revolute("second", "first", anchor_a=-0.5 * second, upper=0.0),
    ]
    world, state = dr.scene(bodies, gravity=(0.0, -9.81), joints=hinges)
    states = dr.rollout(world, state, dt=1 / RATE, steps=20).state
    assert_allclose(states.x, jnp.broadcast_to(state.x[None], states.x.shape), atol=1e-6)
    assert_allclose(states.w, 0.0, atol=3e-4)


@pytest.mark.slow
def test_a_limit_that_the_floor_presses_shut_stays_shut():
    """Two rods on a hinge fall on a smooth floor as a tent, and open until the hinge lets them no further."""
    c, rod = np.sqrt(0.5), dr.Box(half=(0.5, 0.02))
    left, right = (
        dr.Body(rod, mass=1.0, x=(0.5 * side * c, 0.52 * c + 0.2), q=(c, -side * c), friction=0.0) for side in (-1, 1)
    )
    apex = dr.Revolute("right", "left", anchor_a=(-0.5, 0.0), anchor_b=(0.5, 0.0), upper=0.5, restitution=0.7)
    bodies = {"left": left, "right": right, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}
    world, state = dr.scene(bodies, joints={"apex": apex}, gravity=(0.0, -9.81))

    @jax.jit
    def angle(restitution):
        made = dr.paths.write(world, state, "apex.restitution", restitution)
        return dr.rollout(*made, dt=1 / 60, steps=90)["apex.angle"]

    for restitution in (0.0, 0.7):
        assert_allclose(angle(restitution)[60:], 0.5, atol=1e-9)


@pytest.mark.slow
def test_a_stiff_hinge_carries_a_load_that_stands_on_it():
    """Contact and the friction of a joint act on one body: the shelf holds below friction = m g r, else it turns."""

    def drop(friction):
        bodies = {
            "shelf": dr.Body(dr.Box(half=(0.5, 0.05)), mass=1.0, x=(0.5, 0.0)),
            "load": dr.Body(dr.Box(half=(0.1, 0.1)), mass=1.0, x=(0.6, 0.15)),
        }
        hinge = dr.Revolute("shelf", anchor_a=(-0.5, 0.0), friction=friction)
        world, state = dr.scene(bodies, gravity=(0.0, -9.81), friction=0.5, joints=[hinge])
        return dr.rollout(world, state, dt=1 / 240, steps=80).state.x[-1, :, 1] - state.x[:, 1]

    needed = 9.81 * (0.5 + 0.6)
    held, let_go = jax.jit(jax.vmap(drop))(needed * jnp.array([1.01, 0.9]))
    assert_allclose(held, 0.0, atol=1e-6)  # it creeps by 4e-7 m/s, at 1/60 s by 2e-5
    assert float(let_go.max()) < -1e-3


@pytest.mark.slow
def test_a_batch_in_single_precision():
    """Wheels of many speeds, of which some are thrown back by their limit."""
    world, state = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), wheel(1.7, upper=1.0, restitution=0.6))
    speeds = jnp.linspace(-2.0, 2.0, 5, dtype=jnp.float32)

    def end(w):
        return dr.rollout(world, dr.replace(state, w=w[None, None]), dt=1 / RATE, steps=RATE).state.q[-1, 0]

    c, s = jax.jit(jax.vmap(end))(speeds).T
    expected = np.where(speeds > 1.0, 1.0 - 0.6 * (speeds - 1.0), speeds)
    assert_allclose(np.arctan2(s, c), expected, atol=2e-5)


def test_an_angle_of_zero_is_no_full_turn_in_single_precision():
    with jax.enable_x64(False), pytest.raises(ValueError, match="starts at 0, outside its limits 6 to 6.5"):
        wheel(0.0, lower=6.0, upper=6.5)


@pytest.mark.parametrize(
    "along, message",
    [
        ({"lower": 1.0, "upper": -1.0}, "lower is 1 and upper -1: expected lower < upper"),
        ({"lower": 0.5}, "starts at 0, outside its limits 0.5"),
        ({"lower": -4.0, "upper": 4.0}, "expected less than a turn"),
        ({"friction": -0.1}, "friction is -0.1: expected 0 or above"),
        ({"damping": -0.1}, "damping is -0.1: expected 0 or above"),
        ({"upper": 1.0, "restitution": 1.5}, "restitution is 1.5"),
        ({"restitution": 0.5}, "give lower or upper"),
        ({"speed": 1.0}, "give friction"),
    ],
)
def test_mistakes_are_named(along, message):
    with pytest.raises(ValueError, match=message):
        wheel(1.0, **along)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_limits_may_lie_beyond_half_a_turn(dim):
    """Where the angle of an orientation jumps nothing happens, and what has one limit turns from it as long as it likes.

    Limits that leave out hardly anything of a turn are struck all the same.
    """
    both, one = {"lower": -0.5, "upper": 4.0, "restitution": 0.6}, {"upper": 0.5, "restitution": 0.6}
    nearly = {"lower": -3.14, "upper": 3.14, "restitution": 0.6}
    made = {"bounces": (4.5, both), "turns": (-4.5, one), "nearly": (4.5, nearly), "goes on": (-12.0, one)}
    bounced, gone, back, far = (turned(wheels(made, dim), 1.0, body)[0] for body in range(4))
    assert_allclose(bounced if dim == 2 else 2 * np.pi - bounced, 4.0 - 0.6 * 0.5, atol=EXACT)
    assert_allclose(jnp.abs(gone), 4.5 if dim == 2 else 2 * np.pi - 4.5, atol=EXACT)
    assert_allclose(back, 3.14 - 0.6 * (4.5 - 3.14), atol=EXACT)
    assert_allclose(jnp.abs(far), 12.0 if dim == 2 else 4 * np.pi - 12.0, atol=1e-7 if dim == 2 else 1e-6)


@pytest.mark.slow
def test_friction_of_a_slider_keeps_the_spin_of_its_rod():
    """A bead rubs on a rod that turns freely: its friction acts along the rod of the middle of each step."""
    mass, inertia, rub = 0.5, 0.21, 0.15
    rod = dr.Body(None, mass=1.0, inertia=0.2, x=(0.0, 0.0), w=3.0)
    bead = dr.Body(None, mass=mass, inertia=0.01, x=(0.3, 0.0), v=(0.0, 0.9), w=3.0)
    along = dr.Prismatic("bead", "rod", axis_b=(1.0, 0.0), anchor_b=(0.0, 0.0), friction=rub)
    world, state = dr.scene({"rod": rod, "bead": bead}, joints=[dr.Revolute("rod", anchor_a=(0.0, 0.0)), along])
    end = jax.tree.map(lambda leaf: leaf[-1], dr.rollout(world, state, dt=1 / 240, steps=120).state)

    def rate(_, y):
        return [y[1], y[0] * y[2] ** 2 - rub / mass, -2 * mass * y[0] * y[1] * y[2] / (inertia + mass * y[0] ** 2)]

    expected = solve_ivp(rate, (0.0, 0.5), [0.3, 0.0, 3.0], rtol=1e-11, atol=1e-11).y[:, -1]
    assert_allclose([end.x[1] @ end.q[0], end.v[1] @ end.q[0], end.w[0, 0]], expected, rtol=1e-5)
    spin = (inertia + mass * (end.x[1] @ end.x[1])) * end.w[0, 0]
    assert_allclose(spin, (inertia + mass * 0.09) * 3.0, rtol=1e-7)


@pytest.mark.slow
def test_friction_turns_back_with_the_motion():
    """A slider on a spring, with dry friction: each half of a swing is one of cosine about F / k, and loses 2 F / k."""
    t, rate = 1.4, 240

    def place(k, F, x):
        body = dr.Body(None, mass=1.0, inertia=1.0, x=jnp.stack([x, 0.0 * x]))
        spring = dr.SpringDamper(a="body", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=k)
        slider = dr.Prismatic("body", None, axis_b=(1.0, 0.0), friction=F)
        world, state = dr.scene({"body": body}, forces=[spring], joints=[slider])
        return dr.rollout(world, state, dt=1 / rate, steps=round(t * rate)).state.x[-1, 0, 0]

    def expected(k, F, x):
        w = jnp.sqrt(k)
        half = jnp.floor(t * w / jnp.pi)
        swing = (x - (2.0 * half + 1.0) * F / k) * jnp.cos(t * w - half * jnp.pi) + F / k
        return (-1.0) ** half * swing

    p = tuple(map(jnp.asarray, (40.0, 2.0, 1.0)))
    value, slopes = with_slopes(place)(*p)
    assert_allclose(value, expected(*p), atol=5e-5)
    assert_allclose(slopes, jax.grad(expected, (0, 1, 2))(*p), atol=5e-5)


@pytest.mark.slow
def test_friction_that_turns_back_feels_that_of_the_other_hinge():
    """Two links whose first hinge slips one way: its friction is a torque, by which the second stops a little sooner."""

    def after(rubs, size):
        bodies = {
            "a": dr.Body(None, mass=1.0, inertia=0.04, x=(0.3, 0.0)),
            "b": dr.Body(None, mass=0.6, inertia=0.02, x=(0.8, 0.05)),
        }
        joints = {
            "shoulder": dr.Revolute("a", anchor_a=(-0.3, 0.0), friction=size if rubs else None),
            "elbow": dr.Revolute("b", "a", anchor_a=(-0.2, -0.05), friction=0.6),
        }
        forces = [] if rubs else [dr.Torque("a", tau=-size)]
        world, state = dr.scene(bodies, gravity=(0.0, -9.81), joints=joints, forces=forces)
        for path, rate in {"shoulder.rate": 2.0, "elbow.rate": -3.0}.items():
            world, state = dr.paths.write(world, state, path, rate)
        return dr.rollout(world, state, dt=1 / 120, steps=8).state.w[-1, :, 0]

    rubs, turned = (jax.jit(lambda F, r=r: jax.jvp(lambda F: after(r, F), (F,), (1.0,)))(1.0) for r in (True, False))
    assert turned[0][1] > turned[0][0]  # the elbow has turned back
    assert_allclose(rubs[0], turned[0], atol=1e-4)  # [rad/s]
    assert_allclose(rubs[1], turned[1], atol=1e-3)


def test_air_answers_the_friction_of_a_hinge_within_the_step():
    """An arm that a hinge and the air slow: w' = -(c r^2 w + tau) / I; of first order, it would be off by 4e-3 rad/s."""

    def end(tau, c):
        arm = dr.Body(None, mass=0.3, inertia=0.004, x=(0.2, 0.0), v=(0.0, 1.0), w=5.0)
        hinge = dr.Revolute("arm", anchor_a=(-0.2, 0.0), friction=tau)
        world, state = dr.scene({"arm": arm}, joints=[hinge], forces={"air": dr.Drag(linear=c)})
        return dr.rollout(world, state, dt=1 / 120, steps=60).state.w[-1, 0, 0]

    def expected(tau, c):
        inertia = 0.004 + 0.3 * 0.2**2
        a, b = c * 0.2**2 / inertia, tau / inertia
        return (5.0 + b / a) * jnp.exp(-0.5 * a) - b / a

    p = jnp.asarray(0.02), jnp.asarray(0.4)
    (speed, slopes), (right, right_slopes) = (jax.value_and_grad(f, (0, 1))(*p) for f in (jax.jit(end), expected))
    assert_allclose(speed, right, atol=5e-5)
    assert_allclose(slopes, right_slopes, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 50.0])
def test_what_a_joint_of_a_linkage_does_acts_in_the_middle_of_a_step(speed):
    """The friction, or a motor, of the second hinge of a swinging chain, beside the same moment as a `Torque`.

    Between two bodies on one chain it was of first order as long as the chain answered it as it is at the end.
    """
    first, moment = np.array([-0.5, 0.0]), 0.8 if speed else -0.8
    hook, arm = np.array([0.4, 0.1]), np.array([-0.3, 0.0])
    bodies = {
        "upper": dr.Body(None, mass=1.3, inertia=0.1, x=-first, v=(0.0, 0.5), w=1.0),
        "lower": dr.Body(None, mass=0.7, inertia=0.05, x=hook - first - arm, v=(-0.1, 2.4), w=5.0),
    }

    def end(forces, dt, **along):
        joints = [dr.Revolute("upper", anchor_a=first), dr.Revolute("lower", "upper", anchor_a=arm, **along)]
        world, state = dr.scene(bodies, gravity=(0.0, -9.81), joints=joints, forces=forces)
        state = dr.rollout(world, state, dt=dt, steps=round(0.2 / dt)).state
        return jnp.concatenate([state.v[-1].ravel(), state.w[-1].ravel()])

    exact = end([dr.Torque(body="lower", tau=moment), dr.Torque(body="upper", tau=-moment)], 1 / 960)
    coarse, fine = (jnp.abs(end([], dt, friction=0.8, speed=speed) - exact).max() for dt in (1 / 60, 1 / 240))
    assert coarse < 1e-3 and fine < coarse / 12, (coarse, fine)
