"""Sustained contact in closed form: sliding to rest, slopes, slipping that turns into rolling, balls that touch."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import vector, with_slopes
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import diffrigid as dr
from diffrigid import so3
from diffrigid.state import rotations

G = 9.81


def floor(slope=0.0):
    return dr.Static(dr.HalfSpace(normal=vector(-jnp.sin(slope), jnp.cos(slope)), offset=0.0))


def block(mu, v, slope, t, metre):
    """Distance up the slope at t, 60 steps, of a block that starts there with speed v along it; a metre is `metre`."""
    up, normal = vector(jnp.cos(slope), jnp.sin(slope)), vector(-jnp.sin(slope), jnp.cos(slope))
    shape = dr.Box(half=0.5 * metre * vector(1.0, 1.0))
    body = dr.Body(shape, mass=1.3, x=0.5 * metre * normal, angle=slope, v=v * metre * up)
    gravity, contact = metre * vector(0.0, -G), dr.Contact(rest_speed=1e-3 * metre)
    world, state = dr.scene({"block": body, "floor": floor(slope)}, gravity=gravity, friction=mu, contact=contact)
    times = jnp.stack([jnp.zeros_like(t), t])
    return dr.rollout(world, state, dt=1 / 60, times=times, substeps=(60,)).state.x[-1, 0] @ up / metre


block_with_slopes = jax.jit(jax.value_and_grad(block, (0, 1, 2, 3)))


def block_in_closed_form(mu, v, slope, t):
    braking, pull = mu * G * jnp.cos(slope), -G * jnp.sin(slope)
    stop = v / (braking - pull)  # on its way up
    up = jnp.minimum(t, stop)
    way = v * up - 0.5 * (braking - pull) * up**2
    return way + 0.5 * jnp.minimum(pull + braking, 0.0) * (t - up) ** 2


@pytest.mark.parametrize("metre", [1.0, 1e-7])
@pytest.mark.parametrize(
    "case",
    [
        # mu, v, angle, time of 60 steps
        (0.3, 5.0, 0.0, 1.0),  # still moving
        (0.3, 0.6, 0.0, 0.25),  # stopped within a step, of 1/240 s
        (0.3, 1.0, 0.0, 1.0),
        (0.3, 1.0, 0.5, 1.0),  # up and back, turning within a step
        (0.2, 0.5, 0.5, 0.25),
        (0.3, 0.0, 0.2, 1.0),  # held below tan(angle) = mu
        (0.3, 0.0, 0.35, 1.0),  # slides above
    ],
)
def test_block_on_a_slope(case, metre):
    p = tuple(map(jnp.asarray, case))
    distance, slopes = block_with_slopes(*p, jnp.asarray(metre))
    expected, true_slopes = jax.value_and_grad(block_in_closed_form, (0, 1, 2, 3))(*p)
    assert_allclose(distance, expected, atol=1e-12)
    if case[1] == 0.0:  # at the start on the switch from rest to slip: only the slopes by mu and the angle exist
        slopes, true_slopes = (slopes[0], slopes[2]), (true_slopes[0], true_slopes[2])
    assert_allclose(slopes, true_slopes, atol=1e-9)


def welded(up, normal, slope, v):
    first, second = (
        dr.Body(dr.Box(half=(0.2, 0.5)), mass=mass, x=0.5 * normal + s * up, angle=slope, v=v * up)
        for mass, s in ((1.0, 0.0), (3.0, 0.7))
    )
    return {"block": first, "other": second, "floor": floor(slope)}, [dr.Weld("other", "block")]


def on_tiles(up, normal, slope, v):
    tiles = (dr.Static(dr.Box(half=(1.0, 0.2)), x=s * up - 0.2 * normal, angle=slope) for s in (-0.95, 1.05))
    body = dr.Body(dr.Box(half=(0.2, 0.1)), mass=1.0, x=0.1 * normal, angle=slope, v=v * up)
    return {"block": body, "left": next(tiles), "right": next(tiles)}, []


@pytest.mark.slow
@pytest.mark.parametrize("made", [welded, on_tiles])
def test_what_slides_as_one(made):
    """Two boxes that are welded, or one on two floors: up a slope, over the gap, to a stop within a step, and back."""

    def end(mu, v, slope):
        up, normal = vector(jnp.cos(slope), jnp.sin(slope)), vector(-jnp.sin(slope), jnp.cos(slope))
        bodies, joints = made(up, normal, slope, v)
        world, state = dr.scene(bodies, gravity=(0.0, -G), friction=mu, joints=joints)
        x = dr.rollout(world, state, dt=1 / 60, steps=30).state.x
        return (x[-1, 0] - x[0, 0]) @ up

    value_and_slopes = with_slopes(end)
    for case in ((0.3, 1.0, 0.0), (0.1, 1.0, 0.2)):
        p, t = tuple(map(jnp.asarray, case)), jnp.asarray(0.5)
        x, slopes = value_and_slopes(*p)
        expected, true_slopes = jax.value_and_grad(block_in_closed_form, (0, 1, 2))(*p, t)
        assert_allclose(x, expected, atol=1e-12)
        assert_allclose(slopes, true_slopes, atol=1e-9)


@pytest.mark.slow
def test_block_on_a_slope_in_space():
    """Thrown up a slope that rises in no plane of the world, it stops within a step and slides back."""

    def motion(mu, v, slope):
        ahead = vector(jnp.cos(0.7), jnp.sin(0.7), 0.0)
        up = jnp.cos(slope) * ahead + vector(0.0, 0.0, jnp.sin(slope))
        normal = vector(0.0, 0.0, jnp.cos(slope)) - jnp.sin(slope) * ahead
        q = so3.compose(so3.exp(vector(0.0, 0.0, 0.7)), so3.exp(vector(0.0, -slope, 0.0)))
        body = dr.Body(dr.Box(half=(0.5, 0.4, 0.3)), mass=1.3, x=0.3 * normal, q=q, v=v * up)
        hill = dr.Static(dr.HalfSpace(normal=normal))
        world, state = dr.scene({"block": body, "hill": hill}, gravity=(0.0, 0.0, -G), friction=mu)
        return dr.rollout(world, state, dt=1 / 60, steps=30).state.x[-1, 0] @ up

    p = tuple(map(jnp.asarray, (0.3, 1.3, 0.5)))
    distance, slopes = with_slopes(motion)(*p)
    expected, true_slopes = with_slopes(lambda mu, v, slope: block_in_closed_form(mu, v, slope, 0.5))(*p)
    assert_allclose(distance, expected, atol=1e-9)
    assert_allclose(slopes, true_slopes, atol=1e-5)


@pytest.mark.slow
def test_a_box_that_spins_flat_on_a_floor():
    """Its corners, at a distance r and with a quarter of the weight each, brake it by mu m g r: until it stops."""
    half, times = (0.3, 0.2, 0.1), (0.2, 0.5)  # it moves, and stands still
    ground = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
    box = dr.Body(dr.Box(half=half), mass=2.0, x=(0.0, 0.0, half[2]))

    def motion(mu, w):
        spinning = dr.replace(box, w=vector(0.0, 0.0, w))
        world, state = dr.scene({"box": spinning, "ground": ground}, gravity=(0.0, 0.0, -G), friction=mu)
        path = dr.rollout(world, state, dt=1 / 60, steps=round(60 * times[-1])).state
        end = jax.tree.map(lambda leaf: leaf[jnp.array([round(60 * t) for t in times]), 0], path)
        return jnp.concatenate([2.0 * jnp.arctan2(end.q[:, 3:], end.q[:, :1]), end.w, end.x[:, :2]], axis=1)

    def expected(mu, w):
        brake = mu * G * np.hypot(*half[:2]) / ((half[0] ** 2 + half[1] ** 2) / 3.0)
        moves = jnp.minimum(jnp.array(times), w / brake)
        rest = jnp.zeros_like(moves)
        return jnp.stack([w * moves - 0.5 * brake * moves**2, rest, rest, w - brake * moves, rest, rest], axis=1)

    p = jnp.asarray(0.2), jnp.asarray(6.0)
    end, slopes = with_slopes(motion)(*p)
    assert_allclose(end, expected(*p), atol=1e-9)
    assert_allclose(slopes, jax.jacfwd(expected, (0, 1))(*p), atol=1e-7)


@pytest.mark.slow
def test_a_top_that_turns_stands_on_its_point():
    """A hull that stands on a vertex with much friction, spins and precesses: the point stays, to second order."""
    rim = [(0.3 * np.cos(t), 0.3 * np.sin(t), 0.5) for t in np.arange(3) * 2.0 * np.pi / 3.0]
    top = dr.Body(dr.Hull(vertices=np.array([(0.0, 0.0, 0.0), *rim])), mass=1.0, inertia=(0.03, 0.035, 0.05))
    ground = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
    bodies = {"top": dr.replace(top, x=(0.0, 0.0, 1.0)), "ground": ground}
    world, state = dr.scene(bodies, gravity=(0.0, 0.0, -G), friction=5.0)
    q = so3.exp(jnp.array([0.1, 0.03, 0.0]))
    point = world.offsets[0].r[0] + world.shapes[0].vertices[0, 0]  # from the centre of mass, body axes
    arm, w = so3.rotate(q, point), so3.rotate(q, jnp.array([0.1, -0.2, 15.0]))
    state = dr.replace(state, x=-arm[None], q=q[None], v=-so3.cross(w, arm)[None], w=w[None])

    def slid(rate):
        end = jax.tree.map(lambda leaf: leaf[-1, 0], dr.rollout(world, state, dt=1 / rate, steps=rate // 4).state)
        return np.linalg.norm(end.x + so3.rotate(end.q, point))

    assert slid(240) < 3e-4 and slid(960) < 0.1 * slid(240)


@with_slopes
def thrown(mu, v, t):
    """Place, speed and spin of a disc after t, 60 steps."""
    body = dr.Body(dr.Disc(radius=0.5), mass=1.0, x=vector(0.0, 0.5), v=vector(v, 0.0))
    world, state = dr.scene({"ball": body, "floor": floor()}, gravity=(0.0, -G), friction=mu)
    times = jnp.stack([jnp.zeros_like(t), t])
    path = dr.rollout(world, state, dt=1 / 60, times=times, substeps=(60,)).state
    return jnp.stack([path.x[-1, 0, 0], path.v[-1, 0, 0], path.w[-1, 0, 0]])


def test_a_slip_that_turns_is_of_second_order():
    """A ball thrown across a slope: its slip turns downhill while it lasts."""
    normal = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    ball = dr.Body(dr.Sphere(radius=0.03), mass=0.2, x=0.03 * normal, v=(0.0, 2.0, 0.0))
    world, start = dr.scene(
        {"ball": ball, "slope": dr.Static(dr.HalfSpace(normal=normal))}, gravity=(0.0, 0.0, -G), friction=0.05
    )
    step = jax.jit(dr.step)

    def end(rate):
        state = start
        for _ in range(rate // 2):
            state = step(world, state, 1 / rate)
        return state.x

    right = end(960)
    for rate, bound in ((60, 1.5e-4), (120, 4e-5), (240, 1e-5)):
        assert_allclose(end(rate), right, rtol=0.0, atol=bound)


@pytest.mark.parametrize("case", [(0.3, 3.0, 1.0), (0.3, 0.75, 0.25)])
def test_ball_slips_then_rolls(case):
    """A disc thrown along the floor without spin: rolls at 2/3 of its speed from v / (3 mu g) on, whatever mu."""

    def expected(mu, v, t):
        rolls = v / (3 * mu * G)
        speed = 2 * v / 3
        return jnp.stack([v * rolls - 0.5 * mu * G * rolls**2 + speed * (t - rolls), speed, -speed / 0.5])

    p = tuple(map(jnp.asarray, case))
    end, slopes = thrown(*p)
    assert_allclose(end, expected(*p), atol=1e-12)
    assert_allclose(slopes, jax.jacfwd(expected, (0, 1, 2))(*p), atol=1e-9)


@pytest.mark.parametrize("rounding", [0.0, 1e-18])
def test_cradle_of_touching_balls(rounding):
    """Five that touch, struck by a sixth: the last flies off, the others stay."""
    speeds = [0.0, 0.0, rounding, -rounding, 0.0]
    bodies = {f"b{k}": dr.Body(dr.Disc(radius=0.5), mass=1.0, x=(1.0 * k, 0.0), v=(speeds[k], 0.0)) for k in range(5)}
    bodies["cue"] = dr.Body(dr.Disc(radius=0.5), mass=1.0, x=(-3.0, 0.0), v=(2.0, 0.0))
    world, state = dr.scene(bodies, restitution=1.0)
    end = dr.rollout(world, state, dt=1 / 60, steps=120).state
    assert_allclose(end.v[-1], np.eye(6)[4][:, None] * [2.0, 0.0], atol=1e-9)
    assert_allclose(end.x[-1, :, 0], [0.0, 1.0, 2.0, 3.0, 6.0, -1.0], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("tilt", [2e-4, 1e-3])
def test_a_cube_tilted_by_little_falls_flat(tilt, dtype):
    """About its lower edge, faster and faster at 3 g / 8 h, within the first step of 1/240 s or the second."""
    h, half = 0.05, 0.5 * tilt
    pose = dict(x=(0.0, 0.0, h * (np.cos(tilt) + np.sin(tilt))), q=(np.cos(half), 0.0, np.sin(half), 0.0))
    cube = dr.Body(dr.Box(half=(h, h, h)), mass=0.4, **pose)
    ground = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
    world, state = dr.scene({"cube": cube, "ground": ground}, gravity=(0.0, 0.0, -G), friction=1.0)
    world, state = jax.tree.map(lambda leaf: leaf.astype(dtype), (world, state))
    path = dr.rollout(world, state, dt=1 / 240, steps=4).state
    angle = 2.0 * path.q[:, 0, 2]
    assert_allclose(angle[1], max(tilt - 0.5 * 3 * G / (8 * h) / 240**2, 0.0), atol=1e-6)
    assert_allclose(angle[2:], 0.0, atol=1e-6)
    assert_allclose([path.v[2:], path.w[2:]], 0.0, atol=1e-5)


def tipping(mu, w, inertia):
    """Angle and angular velocity of a box of mass 1 after 0.2 s in which it tips over its corner, from 0.3 rad and w."""
    corner, lean = vector(0.1, -0.3), jnp.asarray(0.3)
    r = -rotations(2).rotate(vector(jnp.cos(lean), -jnp.sin(lean)), corner)
    box = dr.Body(
        dr.Box(half=(0.1, 0.3)), mass=1.0, inertia=inertia, x=r, angle=-lean, v=-w * vector(-r[1], r[0]), w=-w
    )  # fmt: skip
    world, state = dr.scene({"box": box, "floor": floor()}, gravity=(0.0, -G), friction=mu)
    end = dr.rollout(world, state, dt=1 / 240, steps=48).state
    return -jnp.stack([jnp.arctan2(end.q[-1, 0, 1], end.q[-1, 0, 0]), end.w[-1, 0, 0]])


def tipping_in_theory(mu, w, inertia):
    """The equation of motion of the corner's angle, by the rule of Runge and Kutta; the corner sticks, or is free."""
    length, corner = jnp.sqrt(0.1), jnp.arctan2(0.1, 0.3)

    def rate(y):
        angle, w = y
        pull = G * length * jnp.sin(angle)
        across = (length * jnp.sin(angle)) ** 2
        sliding = (pull - across / jnp.tan(angle) * w**2) / (inertia + across)
        return jnp.stack([w, jnp.where(mu > 0, pull / (inertia + length**2), sliding)])

    return runge_kutta(rate, jnp.stack([0.3 - corner, w]), 0.2) + jnp.stack([corner, 0.0])


def runge_kutta(rate, y, t, steps=2000):
    """y after t of y' = rate(y)."""
    h = t / steps

    def step(_, y):
        a = rate(y)
        b = rate(y + 0.5 * h * a)
        c = rate(y + 0.5 * h * b)
        return y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))

    return jax.lax.fori_loop(0, steps, step, y)


def test_a_box_tips_over_its_corner():
    """With the corner at rest, and sliding without friction: of second order in the step, and so are the slopes."""
    way = with_slopes(tipping)
    for mu, value, slope in ((0.0, 3e-5, 3e-3), (100.0, 5e-6, 5e-5)):
        p = tuple(map(jnp.asarray, (mu, 0.5, 0.04)))
        motion, slopes = way(*p)
        assert_allclose(motion, tipping_in_theory(*p), atol=value)
        assert_allclose(slopes[1:], jax.jacfwd(tipping_in_theory, (1, 2))(*p), atol=slope)


def rocking(half, mu, e, angle, w):
    """Energy of a box after it has rocked from one corner onto the other, at a time within a step."""
    so, (a, b) = rotations(2), half
    inertia = (a**2 + b**2) / 3
    x = so.rotate(so.exp(angle[None]), half)
    kept = jnp.where(mu > 0, 1.0, jnp.array([0.0, 1.0]))  # without friction it slips below the centre
    v = so.cross(w[None], x) * kept
    body = dr.Body(dr.Box(half=half), mass=1.0, x=x, angle=angle, v=v, w=w)
    world, state = dr.scene({"box": body, "floor": floor()}, gravity=(0.0, -G), friction=mu, restitution=e)
    end = jax.tree.map(lambda leaf: leaf[-1, 0], dr.rollout(world, state, dt=1 / 480, steps=16).state)
    return 0.5 * (end.v @ end.v + inertia * end.w[0] ** 2) + G * end.x[1]


rocking_with_slopes = with_slopes(rocking)


def rocking_in_theory(half, mu, e, angle, w):
    """Sticking and inelastic it goes on about the other corner (Housner 1963); without friction it turns back."""
    a, b = half
    arm, flat, inertia = a * jnp.cos(angle) - b * jnp.sin(angle), a**2 + b**2, (a**2 + b**2) / 3
    height = a * jnp.sin(angle) + b * jnp.cos(angle)
    before, struck = (inertia + jnp.where(mu > 0, flat, arm**2)), (inertia + jnp.where(mu > 0, flat, a**2))
    energy = 0.5 * before * w**2 + G * (height - b)
    share = jnp.where(mu > 0, (inertia + b**2 - a**2) / struck, e)
    return share**2 * energy + G * b


@pytest.mark.parametrize(
    "half, mu, e, atol", [((0.2, 0.3), 100.0, 0.0, (1e-9, 1e-4, 2e-6)), ((0.3, 0.2), 0.0, 0.6, (3e-7, 3e-5, 6e-7))]
)
def test_a_box_rocks_from_corner_to_corner(half, mu, e, atol):
    """What rests is held until another corner strikes, whatever share of a step is left then, and held right then.

    With the velocity of the corner at the strike off by g dt^2, slopes would be off by 1e-2, as they depend on that
    share. The second column of them is by the angle.
    """
    for angle in (0.0165, 0.018, 0.019, 0.021):
        p = tuple(map(jnp.asarray, (half, mu, e, angle, -1.0)))
        value, slopes = rocking_with_slopes(*p)
        assert_allclose(value, rocking_in_theory(*p), atol=1e-6)
        for slope, expected, bound in zip(slopes[2:], jax.jacfwd(rocking_in_theory, (2, 3, 4))(*p), atol, strict=True):
            assert_allclose(slope, expected, rtol=0.0, atol=bound)


def rolling_hexagon(w, frames):
    """Energies of a hexagon that rolls down a slope of 0.25 rad over its corners, after so many steps of 1/120 s."""
    normal, down = (jnp.array([f, g]) for f, g in ((jnp.sin(0.25), jnp.cos(0.25)), (jnp.cos(0.25), -jnp.sin(0.25))))
    corners = 0.2 * np.stack([f(np.pi / 3 * np.arange(2, 8)) for f in (np.cos, np.sin)], axis=1)
    x = 0.2 * np.cos(np.pi / 6) * normal
    v = rotations(2).cross(w[None], x - 0.1 * down)
    wheel = dr.Body(dr.Polygon(vertices=corners), mass=1.0, x=x, v=v, w=w, angle=-0.25)
    slope = dr.Static(dr.HalfSpace(normal=normal))
    world, state = dr.scene({"wheel": wheel, "slope": slope}, gravity=(0.0, -G), friction=2.0)
    states = dr.rollout(world, state, dt=1 / 120, steps=frames[-1]).state
    energies = jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state).sum() + G * state.x[0, 1])(states)
    return energies[np.array(frames)]


def rolling_hexagon_in_theory(w, impacts):
    """Its energy after so many impacts; each keeps (I + r^2 / 2) / (I + r^2) of the spin. McGeer 1990."""
    r, inertia = 0.2, 5.0 / 12.0 * 0.2**2
    height = r * np.cos(np.pi / 6) * np.cos(0.25) - r * np.sin(0.25) * np.arange(impacts + 1)
    energy = 0.5 * (inertia + r**2) * w**2 + G * height[0]
    for at_impact in G * height[1:]:
        energy = at_impact + ((inertia + r**2 / 2) / (inertia + r**2)) ** 2 * (energy - at_impact)
    return energy


def test_a_hexagon_rolls_over_its_corners():
    w = jnp.asarray(-4.0)
    way = jax.jit(lambda w: jax.jvp(lambda w: rolling_hexagon(w, (48, 80, 108)), (w,), (jnp.ones_like(w),)))
    for impacts, energy, slope in zip((1, 2, 3), *way(w), strict=True):
        expected, by_spin = jax.value_and_grad(rolling_hexagon_in_theory)(w, impacts)
        assert_allclose(energy, expected, atol=3e-4)
        assert_allclose(slope, by_spin, rtol=0.0, atol=1e-4)


@pytest.mark.slow
def test_what_has_landed_flat_has_no_slope():
    """A gap that rounding opens is as closed as one that it does not."""

    def tilt(angle):
        body = dr.Body(dr.Box(half=(0.3, 0.2)), mass=1.0, x=(0.0, 0.6), angle=angle, w=0.3)
        world, state = dr.scene({"box": body, "floor": floor()}, gravity=(0.0, -G), friction=0.4)
        return dr.rollout(world, state, dt=1 / 60, steps=120).state.q[-1, 0, 1]

    angles = jnp.linspace(-0.6, 0.6, 16)
    value, slope = jax.jit(lambda angle: jax.jvp(jax.vmap(tilt), (angle,), (jnp.ones_like(angle),)))(angles)
    assert_allclose(value, 0.0, atol=1e-9)
    assert_allclose(slope, 0.0, atol=1e-9)


def over_a_dome(shape, mu, start, radius):
    """Angle from the top and speed of a disc or ball of radius 0.1 m, 0.5 s after it starts from rest on a fixed one."""
    flat = shape is dr.Disc
    up = vector(0.0, 1.0) if flat else vector(0.0, 0.0, 1.0)
    ahead = vector(1.0, 0.0) if flat else vector(jnp.cos(0.7), jnp.sin(0.7), 0.0)
    x = (0.1 + radius) * (jnp.sin(start) * ahead + jnp.cos(start) * up)
    ball, dome = dr.Body(shape(radius=0.1), mass=1.0, x=x), dr.Static(shape(radius=radius))
    world, state = dr.scene({"ball": ball, "dome": dome}, gravity=-G * up, friction=mu)
    end = dr.rollout(world, state, dt=1 / 240, steps=120).state
    x, v = end.x[-1, 0], end.v[-1, 0]
    return jnp.stack([jnp.arctan2(x @ ahead, x @ up), jnp.linalg.norm(v)])


def over_a_dome_in_theory(shape, mu, start, radius):
    """Equation of motion of the angle; it slides, or rolls."""
    way = (0.1 + radius) * jnp.where(mu > 0, 1.5 if shape is dr.Disc else 1.4, 1.0)
    angle, w = runge_kutta(lambda y: jnp.stack([y[1], G / way * jnp.sin(y[0])]), jnp.stack([start, 0.0 * start]), 0.5)
    return jnp.stack([angle, w * (0.1 + radius)])


@pytest.mark.slow
@pytest.mark.parametrize("shape", [dr.Disc, dr.Sphere])
def test_what_is_round_slides_and_rolls_over_a_dome(shape):
    """The normal turns: of second order in the step, and so are the slopes."""
    motion, theory = partial(over_a_dome, shape), partial(over_a_dome_in_theory, shape)
    way = with_slopes(motion)
    for mu, value, slope in ((0.0, 4e-5, 1e-4), (100.0, 2e-5, 1e-4)):
        p = tuple(map(jnp.asarray, (mu, 0.2, 1.0)))
        end, slopes = way(*p)
        assert_allclose(end, theory(*p), atol=value)
        assert_allclose(slopes[1:], jax.jacfwd(theory, (1, 2))(*p), atol=slope)


HIGH = 0.3  # [m] of the centre of what slides over the middle of the rod


def on_a_rod_that_turns(start, om, u, steps):
    """Place [m] after 0.1 s of a disc that slips outwards along a rod, so heavy that it turns evenly; nothing rubs."""
    disc = dr.Body(dr.Disc(radius=0.1), mass=0.5, x=vector(start, HIGH), v=vector(u - om * HIGH, om * start))
    rod = dr.Body(dr.Box(half=(2.0, HIGH - 0.1)), mass=1e9, x=(0.0, 0.0), w=om)
    world, state = dr.scene({"disc": disc, "rod": rod}, restitution=0.4)
    return dr.rollout(world, state, dt=0.1 / steps, steps=steps)["disc.x"][-1]


def on_a_rod_in_closed_form(start, om, u):
    """Along the rod x'' = om^2 x; across, the rod presses with 2 om u - om^2 HIGH > 0 to begin with."""
    along, (cos, sin) = start * jnp.cosh(0.1 * om) + u / om * jnp.sinh(0.1 * om), (jnp.cos(0.1 * om), jnp.sin(0.1 * om))
    return jnp.stack([along * cos - HIGH * sin, along * sin + HIGH * cos])


@pytest.mark.slow
def test_a_side_that_turns_presses_without_any_force():
    """The Coriolis force holds them together: of second order in the step, slopes too."""
    p = tuple(map(jnp.asarray, (-0.3, 6.0, 3.0)))
    exact, exact_slopes = with_slopes(on_a_rod_in_closed_form)(*p)
    errors = []
    for steps in (12, 24):
        place, slopes = with_slopes(partial(on_a_rod_that_turns, steps=steps))(*p)
        errors.append(
            [np.abs(place - exact).max(), *(np.abs(a - b).max() for a, b in zip(slopes, exact_slopes, strict=True))]
        )
    coarse, fine = np.array(errors)
    assert np.all(fine < 1e-4)
    assert np.all(fine < 0.3 * coarse)


def after_a_step_that_missed_it(p):
    """Velocities after a step from where a disc has sunk into the side of a box that turns, and still closes."""
    x = vector(p["along"], 0.35 + p["gap"])
    v = vector(p["u"] - p["om"] * (0.35 + p["gap"]), p["om"] * p["along"] + p["speed"])
    bodies = {
        "box": dr.Body(dr.Box(half=(0.4, 0.2)), mass=1.5, x=(0.0, 0.0), w=p["om"]),
        "disc": dr.Body(dr.Disc(radius=0.15), mass=0.6, x=x, v=v),
    }
    world, state = dr.scene(bodies, restitution=0.4)
    return dr.step(world, state, 1 / 240).v


@pytest.mark.slow
def test_what_has_sunk_into_a_side_that_turns_has_the_slope_of_its_repair():
    """It parts, is pressed back, and closes again inside: that impact is not where the gap vanishes."""
    rng, count, h = np.random.default_rng(0), 64, 1e-7
    p = {
        "gap": -(10.0 ** rng.uniform(-5, -3, count)),
        "speed": -(10.0 ** rng.uniform(-2.5, -0.5, count)),
        "om": rng.uniform(4, 12, count),
        "u": rng.uniform(1, 5, count),
        "along": rng.uniform(-0.3, 0.3, count),
    }
    ways = {name: {other: jnp.full(count, float(other == name)) for other in p} for name in p}
    each = jax.jit(jax.vmap(lambda p, way: jax.jvp(after_a_step_that_missed_it, (p,), (way,))))
    for way in ways.values():
        value, slope = each(p, way)
        up, down = (each({n: p[n] + h * sign * way[n] for n in p}, way)[0] for sign in (1.0, -1.0))
        right = np.abs(slope - (up - down) / (2 * h)).max((1, 2)) < 1e-4 * (1.0 + np.abs(slope).max((1, 2)))
        assert np.mean(right) > 0.98, np.flatnonzero(~right)  # but for a kink


def slides_into(p):
    """Places at rest, (2,) [m], of a block that slides into another; both rub on the floor."""
    along, up = jnp.eye(2)
    box, sliding, steps = dr.Box(half=(0.1, 0.1)), 0.75, 45
    bodies = {
        "block": dr.Body(box, mass=1.0, x=0.1 * up, v=p["v"] * along),
        "other": dr.Body(box, mass=p["m"], x=0.1 * up + (0.2 + p["way"]) * along),
        "floor": dr.Static(dr.HalfSpace(normal=up), restitution=0.0),
    }
    world, state = dr.scene(bodies, gravity=-G * up, friction=p["mu"], restitution=p["e"])
    return dr.rollout(world, state, dt=sliding / steps, steps=steps).state.x[-1, :, 0]


def slides_into_in_closed_form(p):
    brake = p["mu"] * G
    v = jnp.sqrt(p["v"] ** 2 - 2 * brake * p["way"])
    after = v / (1 + p["m"]) * jnp.stack([1 - p["e"] * p["m"], 1 + p["e"]])
    return p["way"] + jnp.array([0.0, 0.2]) + after * jnp.abs(after) / (2 * brake)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_a_block_slides_into_another(mode):
    """They meet within a step: places and slopes of closed form."""
    p = jax.tree.map(jnp.asarray, {"v": 1.6, "m": 0.5, "way": 0.13, "mu": 0.3, "e": 0.6})
    places, slopes = with_slopes(slides_into, mode)(p)
    assert_allclose(places, slides_into_in_closed_form(p), atol=1e-9)
    for name, true_slope in jax.jacfwd(slides_into_in_closed_form)(p).items():
        assert_allclose(slopes[0][name], true_slope, atol=1e-6)  # both stop within a step


def test_a_disc_slides_into_a_slope():
    """Held by the floor until it strikes, at any time of the step: speed along the slope, and distance, in closed form."""
    angle, v, r, dt = 0.4, 4.0, 0.1, 1 / 60
    along = np.array([np.cos(angle), np.sin(angle)])

    def end(gap):
        bodies = {
            "disc": dr.Body(dr.Disc(radius=r), mass=1.0, x=jnp.stack([-gap, r + 0.0 * gap]), v=(v, 0.0)),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
            "slope": dr.Static(dr.HalfSpace(normal=(-np.sin(angle), np.cos(angle)), offset=r * np.cos(angle) - r)),
        }
        world, state = dr.scene(bodies, gravity=(0.0, -9.81))
        end = dr.step(world, state, dt)
        return end.v[0] @ along, (end.x[0] - np.array([0.0, r])) @ along

    gap = jnp.array([0.001, 0.0031, 0.01, 0.03, 0.06])
    left = dt - gap / v
    speed = v * np.cos(angle) - 9.81 * np.sin(angle) * left
    found = jax.jit(jax.vmap(end))(gap)
    assert_allclose(found[0], speed, atol=1e-8)
    assert_allclose(found[1], 0.5 * (v * np.cos(angle) + speed) * left, atol=1e-10)


@pytest.mark.slow
def test_a_ball_that_rests_is_struck():
    """From above and aside, so that it hits the floor at once: slopes by aim, speed and law are those of differences."""

    def end(p):
        disc = dr.Disc(radius=0.1)
        bodies = {
            "cue": dr.Body(
                disc, mass=1.0, x=jnp.stack([p[0], 0.1785 + 0.0 * p[0]]), v=jnp.stack([p[1], -2.6 + 0.0 * p[1]])
            ),
            "ball": dr.Body(disc, mass=0.5, x=(1.0, 0.1)),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
        }
        world, state = dr.scene(bodies, gravity=(0.0, -9.81), restitution=p[2], friction=p[3])
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(dr.step(world, state, 1 / 120))])

    at, run = jnp.array([0.809, 0.667, 0.7, 0.3]), with_slopes(end)
    h = 1e-6 * jnp.eye(4)
    differences = jnp.stack([(run(at + h[k])[0] - run(at - h[k])[0]) / 2e-6 for k in range(4)], axis=1)
    assert float(jnp.abs(differences).max()) > 10.0  # the ball does hit the floor
    assert_allclose(run(at)[1][0], differences, atol=1e-5)


GROUNDS = {
    "profile": (dr.Profile(points=((-1.0, 0.0), (0.0, 0.0), (0.5, 0.0), (1.0, -1.0))), ((0.0, 0.0),), (0.2, 0.05)),
    "box": (dr.Box(half=(0.5, 0.4, 0.2)), ((0.0, 0.0, -0.2),), (0.2, 0.3, 0.05)),
    "tiles": (dr.Box(half=(0.5, 0.2)), ((0.0, -0.2), (1.0, -0.2)), (0.2, 0.05)),
    "slabs": (
        dr.Polygon(vertices=((-0.4, -0.2), (0.5, -0.2), (0.5, 0.2), (-0.5, 0.2))),
        ((0.0, -0.2), (1.0, -0.2)),
        (0.2, 0.05),
    ),
}  # shapes, their places, half sizes of the box that slides


@pytest.mark.slow
@pytest.mark.parametrize("ground", ["tiles", "box", "profile", "slabs"])
def test_a_box_slides_past_an_edge_as_over_one_face(ground):
    """Its centre stays over the ground; corners go beyond the edge at any phase of a step. Closed form v - mu g t."""
    shape, places, half = GROUNDS[ground]
    mu, level = 0.2, [0.0] * (len(half) - 1)
    statics = {f"ground{k}": dr.Static(shape, x=x) for k, x in enumerate(places)}

    def slid(x0, y0, v):
        place = (x0, *[y0][: len(level) - 1], half[-1])
        box = dr.Body(dr.Box(half=half), mass=1.0, x=place, v=(v, *level))
        return dr.scene({"box": box} | statics, gravity=(*level, -G), friction=mu)

    rng = np.random.default_rng(3)
    v = rng.uniform(0.4, 1.5, 16)
    starts = [slid(0.3 - 0.03 * v[k], rng.uniform(-0.12, 0.12), v[k]) for k in range(16)]
    world, state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    end = dr.rollout_batch(world, state, dt=1 / 60, steps=4, final_only=True)
    assert_allclose(end.w, 0.0, atol=1e-9)
    assert_allclose(end.x[:, 0, 1:], state.x[:, 0, 1:], atol=1e-9)
    assert_allclose(end.v[:, 0, 0], np.maximum(v - mu * G * 4 / 60, 0.0), atol=1e-9)
    assert (end.x[:, 0, 0] > 0.3).all()


def test_a_slip_turns_back_while_a_hinged_bob_swings():
    """A box slows down, stops and slides back; a bob on it changes the normal force, as friction does through the bob.

    Coulomb's law, with the stop as an event: two unknown accelerations, and the force in the hinge.
    """
    mu, inertia, arm, m, g, g_along, end = 0.15, 0.02, 0.25, 0.5, 9.81, 3.0, 0.3

    def expected(v):
        def rates(sense):  # of the slip; of x, the angle of the bob, and both rates
            def fn(_, y):
                s, c = np.sin(y[1]), np.cos(y[1])
                matrix = [[1, 0, 1, mu * sense], [m, -m * arm * s, -1, 0], [0, m * arm * c, 0, -1]]
                matrix = np.array([*matrix, [0, inertia, -arm * s, arm * c]])
                by_spin = m * arm * y[3] ** 2
                right = [g_along - mu * sense * g, m * g_along + by_spin * c, by_spin * s - m * g, 0.0]
                return [y[2], y[3], *np.linalg.solve(matrix, right)[:2]]

            return fn

        def stop(_, y):
            return y[2]

        stop.terminal = True
        tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
        there = solve_ivp(rates(-1.0), (0.0, end), [0.0, 0.0, -v, 0.0], events=stop, **tight)
        assert there.status == 1 and there.t[-1] * 60 % 1 > 0.1  # well within a step
        return solve_ivp(rates(1.0), (there.t[-1], end), there.y[:, -1], **tight).y[2, -1]

    def simulated(v):
        thrown = {"v": jnp.stack([-v, 0.0 * v])}
        bodies = {
            "box": dr.Body(dr.Box(half=(0.3, 0.1)), mass=1.0, x=(0.0, 0.1), **thrown),
            "bob": dr.Body(None, mass=m, inertia=inertia, x=(arm, 0.1), **thrown),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
        }
        hinge = dr.Revolute("bob", "box", anchor_a=(-arm, 0.0))
        scene = dr.scene(bodies, gravity=(g_along, -g), friction=mu, joints=[hinge])
        return dr.rollout(*scene, dt=1 / 240, steps=72).state.v[-1, 0, 0]

    v, h = jnp.asarray(1.1), 1e-5
    found, slope = jax.jit(lambda v: jax.jvp(simulated, (v,), (jnp.ones_like(v),)))(v)
    assert_allclose(found, expected(1.1), atol=3e-5)
    assert_allclose(slope, (expected(1.1 + h) - expected(1.1 - h)) / (2 * h), atol=3e-3)
