"""Conservation laws and symmetries, in two and three dimensions."""

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import bouncing, disc_and_plane, final, made, simulated, steps_near, two_discs, vector, with_slopes
from marks import some_later
from motions import sums
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid import so3
from diffrigid.pytree import Leaf, array, pytree, static

ROUNDING = 1e-12  # relative: sums of some hundred terms
PUSHED = 3e-6  # relative energy: what a side that turns presses is held by an even force, whose error falls as dt^3
SPIN_SERIES = 1e-7  # relative energy: the turn of a box within a step is a series; 5 rad/s at 1/60 s
GROWN = 1e-9  # relative: rounding, grown by a few impacts of bodies with corners
EXACT = 1e-9  # relative: rounding of a few hundred steps
TOP = 1e-6  # the same series as SPIN_SERIES at 3 rad/s and 1/240 s, over 3 s


# ---- a crowd of bodies in free space, from random starts

WORLDS, MIRRORED, SMOOTH, ELASTIC, LIVELY = 24, 4, 8, 16, 20
# Of the 24 worlds, the first 8 have e = 1 without friction, the next 8 e = 1 with friction, then 4 with 0.3 < e < 1
# and 4 with e < 0.1, where bodies stay together. Four more repeat the first ones of ELASTIC with bodies swapped, and
# the last four those where bodies stay together, seen from a frame that moves.
BOOST = np.array([3.0, -2.0, 1.0])  # [m/s]


def crowd(p):
    """Two round bodies (in space one) and two boxes."""
    dim = p["x"].shape[1]
    ball = dr.Disc if dim == 2 else dr.Sphere
    count = p["x"].shape[0]
    shapes = [ball(radius=r) for r in p["radius"]] + [dr.Box(half=half) for half in p["half"]]
    bodies = {
        str(i): dr.Body(shapes[i], mass=p["mass"][i], x=p["x"][i], q=p["q"][i], v=p["v"][i], w=p["w"][i])
        for i in range(count)
    }
    return dr.scene(bodies, restitution=p["e"], friction=p["mu"])


def starts(dim):
    """Bodies around the origin that fly towards it, 1.5 m/s, and spin."""
    rng = np.random.default_rng(dim)
    balls = 2 if dim == 2 else 1
    places = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]) if dim == 2 else np.array([(0, 0, -1), (1, 0, 0), (0, 1, 0)])
    shape = (WORLDS, len(places))
    q = rng.normal(size=(*shape, 2 if dim == 2 else 4))
    e, mu = rng.uniform(0.3, 0.95, WORLDS), rng.uniform(0.1, 1.0, WORLDS)
    e[:ELASTIC], mu[:SMOOTH], e[LIVELY:] = 1.0, 0.0, rng.uniform(0.0, 0.1, WORLDS - LIVELY)
    p = dict(
        x=places + 0.1 * rng.normal(size=(*shape, dim)), v=-1.5 * places + 0.2 * rng.normal(size=(*shape, dim)),
        w=3.0 * rng.normal(size=shape if dim == 2 else (*shape, 3)), q=q / np.linalg.norm(q, axis=-1, keepdims=True),
        mass=rng.uniform(0.5, 2.0, shape), radius=rng.uniform(0.2, 0.35, (WORLDS, balls)),
        half=rng.uniform(0.15, 0.35, (WORLDS, 2, dim)), e=e, mu=mu,
    )  # fmt: skip
    swap = swapped(dim)
    twin = {name: values[SMOOTH : SMOOTH + MIRRORED] for name, values in p.items()}
    twin |= {name: twin[name][:, swap] for name in ("x", "v", "w", "q", "mass")}
    twin |= {"radius": twin["radius"][:, ::-1], "half": twin["half"][:, ::-1]}
    seen = {name: values[LIVELY:] for name, values in p.items()}
    seen["v"] = seen["v"] + BOOST[:dim]
    return jax.tree.map(lambda *rows: jnp.asarray(np.concatenate(rows)), p, twin, seen)


def swapped(dim):
    """Order of the bodies with the two of each kind exchanged."""
    return [1, 0, 3, 2] if dim == 2 else [0, 2, 1]


@cache
def crowds(dim):
    """States, momenta and energies of all worlds over 1.5 s at 1/60 s, leading axes (world, time)."""

    def one(p):
        world, state = crowd(p)
        states = dr.rollout(world, state, dt=1 / 60, steps=90).state
        return states, *jax.vmap(partial(sums, world))(states)

    return jax.jit(lambda p: jax.lax.map(one, p))(starts(dim))


@some_later("dim", [2, 3], 3)
def test_crowds_meet(dim):
    """The tests below say something: in nearly every world bodies collide, and lose energy where they may."""
    states, _, _, energy = crowds(dim)
    struck = np.abs(states.v[:, -1] - states.v[:, 0]).max((1, 2)) > 0.1
    assert struck.mean() > 0.9
    assert (energy[LIVELY:WORLDS, -1] < 0.8 * energy[LIVELY:WORLDS, 0]).all()


@some_later("dim", [2, 3], 3)
def test_a_frame_that_moves_sees_the_same(dim):
    states = crowds(dim)[0]
    home, moved = (
        jax.tree.map(lambda leaf, of=of: leaf[of], states) for of in (slice(LIVELY, WORLDS), slice(-4, None))
    )
    way = np.arange(91)[:, None, None] / 60 * BOOST[:dim]
    for name, more in dict(x=way, q=0.0, v=BOOST[:dim], w=0.0).items():
        assert_allclose(getattr(moved, name), np.asarray(getattr(home, name)) + more, atol=GROWN, err_msg=name)


@some_later("dim", [2, 3], 3)
def test_momentum_is_kept(dim):
    _, momentum, _, _ = crowds(dim)
    assert_allclose(momentum, np.broadcast_to(momentum[:, :1], momentum.shape), atol=10 * ROUNDING)  # [kg m/s], about 1


@some_later("dim", [2, 3], 3)
def test_angular_momentum_is_kept_in_elastic_collisions(dim):
    _, _, L, _ = crowds(dim)
    L = L[:ELASTIC]
    assert_allclose(L, np.broadcast_to(L[:, :1], L.shape), atol=10 * ROUNDING)  # [kg m^2/s], about 1


@some_later("dim", [2, 3], 3)
def test_angular_momentum_is_kept_where_bodies_may_stay_together(dim):
    _, _, L, _ = crowds(dim)
    L = L[ELASTIC:WORLDS]
    assert_allclose(L, np.broadcast_to(L[:, :1], L.shape), atol=10 * ROUNDING)


@some_later("dim", [2, 3], 3)
def test_energy_is_kept_by_elastic_collisions_without_friction(dim):
    energy = crowds(dim)[3][:SMOOTH]
    assert_allclose(energy / energy[:, :1], 1.0, atol=ROUNDING if dim == 2 else SPIN_SERIES)


@some_later("dim", [2, 3], 3)
def test_energy_never_rises(dim):
    """Friction and e = 1 included, where Newton's law with Coulomb friction could make energy (Kane's paradox)."""
    energy = crowds(dim)[3]
    rise = np.diff(energy, axis=1).max(1) / energy[:, 0]
    assert rise[:LIVELY].max() < (ROUNDING if dim == 2 else SPIN_SERIES)
    assert rise.max() < (PUSHED if dim == 2 else SPIN_SERIES)


@pytest.mark.slow
def test_energy_rises_less_in_smaller_steps():
    """Where bodies stay together, an eighth of the step leaves less than 1 / 300 of what may come of the even force."""
    slow = jax.tree.map(lambda leaf: leaf[LIVELY:WORLDS], starts(2))

    def energies(p):
        world, state = crowd(p)
        states = dr.rollout(world, state, dt=1 / 480, steps=720).state
        return jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state).sum())(states)

    energy = jax.jit(lambda p: jax.lax.map(energies, p))(slow)
    assert (np.diff(energy, axis=1).max(1) / energy[:, 0]).max() < PUSHED / 300


GROUND = {  # below y = 0, or z = 0
    "box": (2, dr.Box(half=(3.0, 0.5)), (0.0, -0.5)),
    "polygon": (2, dr.Polygon(vertices=((-3.0, -1.0), (3.0, -1.0), (3.0, 0.0), (-3.0, 0.0))), (0.0, 0.0)),
    "profile": (2, dr.Profile(points=((-3.0, 0.0), (0.5, 0.0), (3.0, 0.0))), (0.0, 0.0)),
    "box in space": (3, dr.Box(half=(3.0, 3.0, 0.5)), (0.0, 0.0, -0.5)),
    "height field": (3, dr.HeightField(heights=np.zeros((3, 3)), spacing=1.0), (-1.2, -1.2, 0.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", GROUND)
def test_what_is_round_and_smooth_strikes_as_if_it_did_not_spin(kind):
    """Slow impacts of a fast spin: w^2 r is far above gravity."""
    dim, shape, at = GROUND[kind]
    round_shape, up = (dr.Disc if dim == 2 else dr.Sphere)(radius=0.15), np.eye(dim)[dim - 1]
    ball, ground = dr.Body(round_shape, mass=0.9, x=0.2 * up), dr.Static(shape, x=at)
    world, state = dr.scene({"ball": ball, "ground": ground}, gravity=-9.81 * up, restitution=0.6)

    def after(gap, speed, spin):
        w = jnp.stack([spin] if dim == 2 else [spin, -0.3 * spin, spin])
        start = dr.replace(state, x=((0.15 + gap) * up)[None], v=(speed * up)[None], w=w[None])
        end = dr.step(world, start, 1 / 120)
        return jnp.stack([end.x[0] @ up, end.v[0] @ up])

    gap, speed = jnp.array([2e-4, 1e-3, 5e-5]), jnp.array([-0.0346, -0.2, -0.02])
    both = jax.jit(
        jax.vmap(jax.vmap(lambda *z: jax.jvp(after, z, (1.0, 0.3, 0.0)), (0, 0, None)), (None, None, 0)),
        compiler_options=dr.QUICK,
    )
    ends, slopes = both(gap, speed, jnp.array([0.0, 15.0, 40.0]))
    for leaf in (ends, slopes):
        assert_allclose(leaf, np.broadcast_to(leaf[0], leaf.shape), atol=ROUNDING)
    s = (speed + np.sqrt(speed**2 + 2 * 9.81 * gap)) / 9.81  # of the fall to the ground
    rebound = 0.6 * np.sqrt(speed**2 + 2 * 9.81 * gap) - 9.81 * (1 / 120 - s)
    assert_allclose(ends[2, :2, 1], rebound[:2], atol=ROUNDING)  # the third comes down again


@some_later("dim", [2, 3], 3)
def test_swapping_bodies_swaps_their_motions(dim):
    """Each pair then has its sides a and b exchanged."""
    states = crowds(dim)[0]
    got = jax.tree.map(lambda leaf: leaf[WORLDS : WORLDS + MIRRORED], states)
    expected = jax.tree.map(lambda leaf: leaf[SMOOTH : SMOOTH + MIRRORED][:, :, np.array(swapped(dim))], states)
    jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=GROWN, atol=GROWN), got, expected)


# ---- a planar scene, in the plane and in space, turned and shifted

GRAVITY = 9.81


def yard(dim, turn, shift, friction, e):
    """Two round bodies that collide and bounce on the floor, and beside them a box that lands on a corner, spinning.

    Args:
        turn: orientation of the whole scene. shift: of its origin [m].
    """
    flat = dim == 2
    so = dr.state.rotations(dim)
    ball, inertia = (dr.Disc, lambda z: z) if flat else (dr.Sphere, lambda z: vector(0.7 * z, 0.8 * z, z))

    def place(*r):
        return so.rotate(turn, vector(*r, *[0.0] * (dim - 2)))

    def body(shape, mass, z, x, v, w, angle=0.0):
        phi = vector(angle) if flat else vector(0.0, 0.0, angle)
        w = w if flat else so.rotate(turn, vector(0.0, 0.0, w))
        q = so.compose(turn, so.exp(phi))
        return dr.Body(shape, mass=mass, inertia=inertia(z), x=shift + place(*x), v=place(*v), w=w, q=q)

    half = vector(0.3, 0.2) if flat else vector(0.3, 0.2, 0.4)
    normal = place(0.0, 1.0)
    # In the plane the floor is posed by its numbers, in space as a body would be.
    floor = dr.HalfSpace(
        normal=normal if flat else vector(0.0, 1.0, 0.0), offset=jnp.dot(normal, shift) if flat else 0.0
    )
    bodies = {
        "left": body(ball(radius=0.2), 1.0, 0.03, (-1.5, 0.5), (2.0, 0.5), 4.0),
        "right": body(ball(radius=0.3), 2.0, 0.1, (0.0, 0.6), (-1.0, 0.2), -3.0),
        "box": body(dr.Box(half=half), 1.5, 0.07, (3.0, 0.8), (0.7, -1.0), 2.0, 0.4),
        "floor": dr.Static(floor) if flat else dr.Static(floor, x=shift, q=turn),
    }
    apart = [("left", "box"), ("right", "box")]
    return dr.scene(bodies, gravity=place(0.0, -GRAVITY), restitution=e, friction=friction, ignore=apart)


@cache
def compiled_yard(dim):
    def states(turn, shift, friction, e):
        world, state = yard(dim, turn, shift, friction, e)
        states = dr.rollout(world, state, dt=1 / 60, steps=48).state
        energy = jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state).sum())(states)
        return states, energy, world.bodies.mass

    return jax.jit(states)


def at_home(dim, friction, e=0.8):
    so = dr.state.rotations(dim)
    return compiled_yard(dim)(so.exp(jnp.zeros(so.A)), jnp.zeros(dim), jnp.asarray(friction), jnp.asarray(e))


@pytest.mark.parametrize(
    "friction, e", [(0.3, 0.8), *(pytest.param(*two, marks=pytest.mark.slow) for two in ((0.0, 0.8), (0.5, 1.0)))]
)
def test_planar_scene_in_space_is_the_scene_in_the_plane(friction, e):
    """At e = 1 friction would make energy, at one corner in the plane, at the two of an edge in space."""
    flat, deep = at_home(2, friction, e)[0], at_home(3, friction, e)[0]
    assert (np.abs(np.diff(flat.v, axis=0)).max((0, 2)) > 1.0).all()  # every body was struck
    assert_allclose(deep.x, np.pad(flat.x, ((0, 0), (0, 0), (0, 1))), atol=GROWN)
    assert_allclose(deep.v, np.pad(flat.v, ((0, 0), (0, 0), (0, 1))), atol=GROWN)
    assert_allclose(deep.w, np.pad(flat.w, ((0, 0), (0, 0), (2, 0))), atol=GROWN)
    s, z = deep.q[..., 0], deep.q[..., 3]
    assert_allclose(np.stack([s * s - z * z, 2 * s * z], -1), flat.q, atol=GROWN)
    assert_allclose(deep.q[..., 1:3], 0.0, atol=GROWN)


@pytest.mark.parametrize("dim", [2, 3])
def test_turning_and_shifting_everything_changes_nothing(dim):
    so, friction = dr.state.rotations(dim), 0.3
    turn = so.exp(vector(0.7) if dim == 2 else vector(0.5, -0.8, 0.3))
    shift = vector(2.0, -5.0) if dim == 2 else vector(2.0, -5.0, 1.0)
    home, moved = at_home(dim, friction)[0], compiled_yard(dim)(turn, shift, jnp.asarray(friction), jnp.asarray(0.8))[0]

    def everywhere(verb, r):
        return jax.vmap(jax.vmap(lambda r: verb(turn, r)))(r)

    assert_allclose(moved.x, everywhere(so.rotate, home.x) + shift[None, None], atol=GROWN)
    assert_allclose(moved.v, everywhere(so.rotate, home.v), atol=GROWN)
    assert_allclose(moved.w, home.w if dim == 2 else everywhere(so.rotate, home.w), atol=GROWN)
    assert_allclose(moved.q, everywhere(so.compose, home.q), atol=GROWN)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("friction, e, kept", [(0.0, 0.8, 0.9), (0.3, 0.8, 0.9), (0.5, 1.0, 1.0)])
def test_energy_with_the_potential_never_rises_on_a_floor(dim, friction, e, kept):
    states, kinetic, mass = at_home(dim, friction, e)
    energy = kinetic + GRAVITY * (mass[None] * states.x[:, :, 1]).sum(1)
    assert np.diff(energy).max() < GROWN * energy[0]
    assert energy[-1] < kept * energy[0]


@pytest.mark.slow
def test_slopes_where_friction_is_lessened():
    """A box in space that lands on an edge, on two corners at once, which with all of its friction would gain energy."""

    def after(p):
        v, turn = jnp.stack([p["v"], 0.0 * p["v"], -3.0 + 0.0 * p["v"]]), vector(0.0, p["turn"], 0.0)
        box = dr.Body(
            dr.Box(half=(0.3, 0.4, 0.2)), mass=p["mass"], inertia=(0.05,) * 3, x=(0.0, 0.0, 0.45), v=v,
            q=so3.exp(turn), w=(0.0, 4.47, 0.0),
        )  # fmt: skip
        floor = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
        world, state = dr.scene({"box": box, "floor": floor}, restitution=1.0, friction=p["friction"])
        end = dr.step(world, state, 0.06)
        gained = dr.kinetic_energy(world.bodies, end)[0] - dr.kinetic_energy(world.bodies, state)[0]
        return jnp.concatenate([end.v[0], end.w[0]]), gained

    p = jax.tree.map(jnp.asarray, {"v": 3.67, "turn": 1.3, "mass": 1.1, "friction": 0.5})
    run = with_slopes(after)
    (velocities, gained), (slopes, _) = run(p)
    assert velocities[0] < 3.0  # it was rubbed
    assert abs(gained) < 1e-12  # and neither gained nor lost: some of the friction is left out
    for name, slope in slopes[0].items():
        high, low = (run(p | {name: p[name] + h})[0][0] for h in (1e-6, -1e-6))
        assert_allclose(slope, (high - low) / 2e-6, atol=1e-6)


# ---- a free top


def euler_top(inertia, w, t, steps):
    """Orientation and world angular velocity of a free body by Runge-Kutta: q' = q w / 2, L' = l x w."""

    def rate(y):
        (s, u), w = (y[0], y[1:4]), y[4:]
        turning = 0.5 * np.concatenate([[-u @ w], s * w + np.cross(u, w)])
        return np.concatenate([turning, np.cross(inertia * w, w) / inertia])

    y, h = np.concatenate([[1.0, 0.0, 0.0, 0.0], w]), t / steps
    for _ in range(steps):
        k1 = rate(y)
        k2 = rate(y + h / 2 * k1)
        k3 = rate(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + h * k3))
    return y[:4], y[4:]


def test_asymmetric_top_follows_eulers_equations():
    inertia, w, t = np.array([0.5, 0.9, 1.2]), np.array([0.4, 3.0, -0.3]), 3.0  # about the unstable axis
    body = dr.Body(None, mass=1.0, inertia=inertia, x=np.zeros(3), w=w)
    world, state = dr.scene({"top": body})
    states = dr.rollout(world, state, dt=1 / 240, steps=720).state
    L = jax.vmap(lambda state: dr.angular_momentum(world.bodies, state))(states)
    assert_allclose(L, np.broadcast_to(L[:1], L.shape), atol=10 * ROUNDING)
    q, w_body = euler_top(inertia, w, t, 3000)  # its own error: about (3 rad/s * 1 ms)^4, 1e-10
    own = jax.vmap(dr.state.rotations(3).unrotate)(states.q[:, 0], states.w[:, 0])
    assert own[:, 1].min() < -2.0  # it tumbles
    assert_allclose(states.q[-1, 0], q, atol=TOP)
    assert_allclose(own[-1], w_body, atol=3 * TOP)


def symmetric_top(p, t):
    """Orientation of a body with the moments across, across and along, after t: Goldstein, section 5.6."""
    L = jnp.stack([p["across"], p["across"], p["along"]]) * p["w"]
    within = (1.0 / p["along"] - 1.0 / p["across"]) * L[2] * jnp.array([0.0, 0.0, 1.0])
    return so3.compose(so3.exp(t * L / p["across"]), so3.exp(t * within))


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_a_symmetric_top_is_exact_at_any_spin(jacobian):
    dt = 1 / 60

    def own(p):
        inertia = jnp.stack([p["across"], p["across"], p["along"]])
        world, state = dr.scene({"top": dr.Body(None, mass=1.0, inertia=inertia, x=jnp.zeros(3), w=p["w"])})
        return dr.rollout(world, state, dt=dt, steps=10).state.q[-1, 0]

    run, closed_form = (
        jax.jit(lambda p, f=f: (f(p), jacobian(f)(p))) for f in (own, lambda p: symmetric_top(p, 10 * dt))
    )
    for along in (0.1, 2.0):
        p = {"across": jnp.asarray(1.2), "along": jnp.asarray(along), "w": jnp.array([300.0, -100.0, 200.0])}
        (q, slopes), (expected, true_slopes) = run(p), closed_form(p)
        assert_allclose(q, expected, atol=1e-11)  # rounding of an angle of 50 rad or more
        for name, slope in slopes.items():
            assert_allclose(slope, true_slopes[name], atol=1e-9)


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_what_rests_would_turn_by_its_spin(jacobian):
    """Slopes where nothing turns yet, of a cube, a top and a box."""
    inertias = jnp.array([(0.4, 0.4, 0.4), (0.4, 0.4, 0.7), (0.4, 0.5, 0.7)])

    def end(w):
        bodies = [dr.Body(None, mass=1.0, inertia=inertia, x=jnp.zeros(3), w=w) for inertia in inertias]
        state = dr.rollout(*dr.scene({f"body {i}": body for i, body in enumerate(bodies)}), dt=1 / 60, steps=6).state
        return state.q[-1]

    slopes = jax.jit(jacobian(end))(jnp.zeros(3))
    half = jnp.concatenate([jnp.zeros((1, 3)), 0.5 * jnp.eye(3)])  # dq/dphi at no turn
    assert_allclose(slopes, jnp.broadcast_to(0.1 * half, slopes.shape), atol=ROUNDING)


def test_what_spins_fast_about_nearly_a_principal_axis_turns_by_its_spin():
    """By 10 rad in each of ten steps, about each axis of a box of three moments."""

    @jax.jit
    @jax.vmap
    def turned(w):
        body = dr.Body(None, mass=1.0, inertia=(0.5, 0.9, 1.2), x=jnp.zeros(3), w=w)
        return dr.rollout(*dr.scene({"box": body}), dt=1 / 60, steps=10).state.q[-1, 0]

    w = 600.0 * jnp.eye(3)
    expected = jax.vmap(so3.exp)(w / 6)
    assert_allclose(turned(w + 1e-5), expected, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_box_that_turns_far_in_a_step_keeps_its_length_and_about_its_energy(dtype):
    turns = np.array([0.5, 1.0, 3.0, 10.0, 1e3, 1e4])  # [rad] in a step
    rng, dt = np.random.default_rng(0), 1 / 60
    sides = np.exp(rng.uniform(np.log(0.1), 0.0, (64, 3)))
    w = rng.normal(size=(64, 3))
    w = turns[:, None, None] / dt * w / np.linalg.norm(w, axis=1, keepdims=True)

    def run(sides, w):
        inertia = (jnp.sum(sides**2) - sides**2) / 12.0
        scene = dr.scene({"box": dr.Body(None, mass=1.0, inertia=inertia, x=np.zeros(3), w=w)})
        world, state = jax.tree.map(lambda leaf: leaf.astype(dtype), scene)
        states = dr.rollout(world, state, dt=dtype(dt), steps=60).state
        energy = jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state)[0])(states)
        return energy / energy[0] - 1.0, states.q[:, 0]

    change, q = jax.jit(jax.vmap(jax.vmap(run), in_axes=(None, 0)))(sides, w)
    assert change.dtype == dtype
    assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-6 if dtype == np.float32 else ROUNDING)
    change, rounding = np.abs(change).max(axis=2), 5e-5 if dtype == np.float32 else 0.0
    assert (change.max(1) < np.array([1e-5, 5e-4, 0.7, 0.7, 0.7, 0.7]) + rounding).all()
    assert (np.median(change, 1) < np.array([1e-5, 1e-5, 0.1, 0.1, 0.1, 0.1]) + rounding).all()


# ---- what a collision does to the motion, as a map


def test_equal_elastic_balls_exchange_their_motions():
    p = dict(e=1.0, mu=0.0, ma=1.3, mb=1.3, ra=0.1, rb=0.1, ia=0.01, ib=0.01)
    p |= dict(xa=0.0, ya=0.0, xb=1.0, yb=0.0, vxa=2.0, vya=0.0, vxb=-0.5, vyb=0.0, wa=0.0, wb=0.0)
    end, jac = simulated(two_discs, p, 1.0, 60)
    column = list(p).index
    x, v = [0, 2], [8, 10]  # rows of the flat state: x components of both bodies; then q, 4 numbers, and v
    starts, speeds = [column("xa"), column("xb")], [column("vxa"), column("vxb")]
    exchange = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert_allclose(end[np.array(v)], [-0.5, 2.0], atol=EXACT)
    assert_allclose(jac[np.ix_(v, speeds)], exchange, atol=EXACT)
    assert_allclose(jac[np.ix_(v, starts)], 0.0, atol=EXACT)
    assert_allclose(jac[np.ix_(x, starts)], exchange, atol=EXACT)
    assert_allclose(jac[np.ix_(x, speeds)], 1.0 * exchange, atol=EXACT)  # times t = 1 s


def test_two_walls_struck_at_once_need_not_be():
    """A disc in a corner: what it does along one wall does not depend on when it strikes the other."""
    e, disc = 0.8, dr.Body(dr.Disc(radius=0.1), mass=1.3, x=(0.11, 0.11), v=(-2.0, -2.0))
    walls = {name: dr.Static(dr.HalfSpace(normal=n)) for name, n in (("left", (1.0, 0.0)), ("floor", (0.0, 1.0)))}
    world, state = dr.scene({"disc": disc, **walls}, restitution=e)
    slopes = jax.jit(jax.jacfwd(lambda x: dr.step(world, dr.replace(state, x=x), 1 / 60).x))(state.x)
    assert_allclose(slopes.reshape(2, 2), -e * np.eye(2), atol=ROUNDING)


@pytree
class Follow:
    """Each body is pulled towards the velocity of the others: F_i = -damping sum_j (v_i - v_j)."""

    damping: Leaf = array()
    mutual = True

    def __call__(self, bodies, state, controls):
        return dr.Wrench(F=self.damping * (state.v.sum(0, keepdims=True) - len(bodies.mass) * state.v))


@pytree
class Returns:
    """A force that returns `wrench(velocities)`."""

    wrench: Callable = static()

    def __call__(self, bodies, state, controls):
        return self.wrench(state.v)


@pytest.mark.parametrize(
    "wrench, message",
    [
        (lambda v: dr.Wrench(F=v[0]), r"force Returns: F has shape \(2,\), expected \(2, 2\), a row for each body"),
        (lambda v: dr.Wrench(F=v[:1]), r"F has shape \(1, 2\), expected \(2, 2\)"),
        (lambda v: dr.Wrench(F=v, tau=v), r"tau has shape \(2, 2\), expected \(2, 1\)"),
        (lambda v: v, r"force Returns returned a .*Tracer, expected Wrench\(F=..., tau=...\)"),
    ],
)
def test_a_force_that_is_no_wrench_of_all_bodies_is_refused(wrench, message):
    """One force for two bodies would be broadcast to both."""
    disc = dr.Disc(radius=0.1)
    bodies = {"a": dr.Body(disc, mass=1.0, x=(0.0, 0.0)), "b": dr.Body(disc, mass=1.0, x=(1.0, 0.0))}
    with pytest.raises((TypeError, ValueError), match=message):
        dr.step(*dr.scene(bodies, forces=[Returns(wrench=wrench)]), 0.1)


@pytest.mark.parametrize("mutual", [False, True])
def test_what_is_tied_to_a_struck_body_feels_it_from_the_time_of_the_impact(mutual):
    """A puck strikes a disc to which a damper ties another. Their relative speed u falls as exp(-c t / mass).

    By a mutual force the puck is slowed before the impact already, and all three share one speed in the end.
    """
    m, e, c, end = jnp.array([0.4, 0.6, 0.9]), 0.8, 1.2, 0.5

    def simulated(v):
        places = {"puck": (-0.5, 0.0), "b": (0.0, 0.0), "c": (0.5, 0.0)}
        bodies = {k: dr.Body(dr.Disc(radius=0.1), mass=m[i], x=x) for i, (k, x) in enumerate(places.items())}
        bodies["puck"] = dr.replace(bodies["puck"], v=jnp.stack([v, 0.0 * v]))
        rod = {"anchor_a": (0.0, 0.0), "anchor_b": (0.0, 0.0), "stiffness": 0.0, "damping": c, "length": 0.5}
        tied = Follow(damping=c) if mutual else dr.SpringDamper("b", "c", **rod)
        state = dr.rollout(*dr.scene(bodies, restitution=e, forces={"tie": tied}), dt=1 / 60, steps=30).state
        return state.x[-1, :, 0], state.v[-1, :, 0]

    def expected(v):
        t = end - 0.3 / v  # since the impact
        p = (1 + e) * v / (1 / m[0] + 1 / m[1])
        v_puck, u, mean = v - p / m[0], p / m[1], p / (m[1] + m[2])
        rate = c * (1 / m[1] + 1 / m[2])
        left, way = jnp.exp(-rate * t), (1 - jnp.exp(-rate * t)) / rate
        share = m[2] / (m[1] + m[2])  # of the relative speed that is b's
        v_b, v_c = mean + share * u * left, mean - (1 - share) * u * left
        x_b, x_c = mean * t + share * u * way, 0.5 + mean * t - (1 - share) * u * way
        return jnp.stack([-0.2 + v_puck * t, x_b, x_c]), jnp.stack([v_puck, v_b, v_c])

    v = jnp.asarray(1.7)
    found, slopes = jax.jit(lambda v: jax.jvp(simulated, (v,), (jnp.ones_like(v),)))(v)
    if mutual:
        assert found[0][1] > 0.01  # it was struck
        assert_allclose((m @ found[1], m @ slopes[1]), (m[0] * v, m[0]), rtol=ROUNDING)
        return
    right, right_slopes = jax.jvp(expected, (v,), (jnp.ones_like(v),))
    jax.tree.map(partial(assert_allclose, rtol=1e-5), (found, slopes), (right, right_slopes))


def test_touching_balls_struck_just_where_a_step_ends():
    """The last ball leaves by as much later as the first comes later; the others stay. All numbers are binary."""
    x, v, dt, disc = (-9 / 32, 0.0, 1 / 4), 2.0, 1 / 64, dr.Disc(radius=1 / 8)
    start = [{"x": (x_i, 0.0), "v": (v_i, 0.0)} for x_i, v_i in zip(x, (v, 0.0, 0.0), strict=True)]
    world, state = dr.scene({f"ball{i}": dr.Body(disc, mass=1.0, **of) for i, of in enumerate(start)}, restitution=1.0)
    first = jax.tree.map(jnp.zeros_like, state)
    first = dr.replace(first, x=first.x.at[0, 0].set(1.0))
    end, change = jax.jit(lambda *of: jax.jvp(lambda s: dr.step(world, s, dt), *((part,) for part in of)))(state, first)
    assert_allclose(end.x[:, 0], (-1 / 4, 0.0, 1 / 4), atol=ROUNDING)
    assert_allclose(change.x[:, 0], (0.0, 0.0, 1.0), atol=ROUNDING)


@pytest.mark.slow
def test_final_height_is_smooth_in_the_initial_height():
    """No sawtooth as the impact moves through the steps: a straight line of slope -1 without gravity, else a curve."""
    heights, t = np.linspace(0.5, 0.6, 21), 0.6  # the impacts fall into 3 steps
    blocks, dt = steps_near(t, 60)

    def ends(**parameters):
        end, slope = [], []
        for y in heights:
            world, state = made(disc_and_plane, parameters | dict(y=y))
            state, jac = final(world, state, dt, blocks)
            end.append(state[1])
            slope.append(jac[1, -6])  # of the flat leaves, state.x[0, 1] is followed by q, v and w: 5 numbers
        return np.array(end), np.array(slope)

    y, slope = ends(e=1.0, vy=-2.0)
    assert_allclose(y, 0.2 - (heights - 2.0 * t), atol=EXACT)
    assert_allclose(slope, -1.0, atol=EXACT)
    y, slope = ends(e=0.8, vy=0.0, g=GRAVITY)

    def exact(y):
        return bouncing(1)(t, 0.8, y, 0.0, GRAVITY, 0.1).x[0, 1]

    assert_allclose(y, jax.vmap(exact)(heights), atol=EXACT)
    assert_allclose(slope, jax.vmap(jax.grad(exact))(heights), atol=EXACT)
