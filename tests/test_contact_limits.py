"""Where contact is singular or rare: very fast, at rest, grazing, exactly parallel, coincident."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import (
    PAIR,
    bouncing,
    box_and_plane,
    disc_and_plane,
    fall,
    final,
    made,
    pulled_back,
    steps_near,
    two_boxes,
    two_discs,
    vector,
    with_slopes,
)  # fmt: skip
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.contact.impulse import contact_law, impulses
from diffrigid.contact.slipping import lost_to_stops
from diffrigid.overlap import place, separation

EXACT = 1e-9  # relative: rounding of a few hundred steps
AT_REST = 1e-9  # [m], [m/s]: rounding of a body that is held for a thousand steps
G = 9.81


def run(make, parameters, t, rate=60):
    """State at t and its Jacobian by all float leaves, as a pair (world, state) of arrays with the outputs in front."""
    world, state = made(make, parameters)
    blocks, dt = steps_near(t, rate)
    end, by_leaf = final(world, state, dt, blocks)
    return ravel_pytree(state)[1](end), jax.vmap(ravel_pytree((world, state))[1])(by_leaf)


# ---- no tunnelling


def bullets(speed, angle, spin):
    """A disc and a spinning box shot at a thin wall, and a disc shot at its like: each less thick than it flies in a step."""
    wall = dr.Box(half=vector(0.01, 50.0))
    small = dr.Disc(radius=0.1)
    bodies = {
        "disc": dr.Body(small, mass=1.0, x=vector(0.0, 0.0), v=vector(speed, 0.0)),
        "box": dr.Body(
            dr.Box(half=vector(0.2, 0.1)), mass=1.0, x=vector(0.0, 3.0), v=vector(speed, 0.0), angle=angle, w=spin
        ),
        "shot": dr.Body(small, mass=1.0, x=vector(0.0, 6.0), v=vector(speed, 0.0)),
        "target": dr.Body(small, mass=2.0, x=vector(20.0, 6.0)),
        "wall": dr.Static(wall, x=vector(15.0, 0.0)),
    }
    lanes = [("disc", "box"), ("disc", "shot"), ("disc", "target"), ("box", "shot"), ("box", "target")]
    return dr.scene(bodies, restitution=1.0, ignore=lanes + [("shot", "wall"), ("target", "wall")])


def test_nothing_tunnels():
    rng = np.random.default_rng(0)
    speeds = np.concatenate([[500.0], rng.uniform(50.0, 500.0, 15)])
    angles, spins = rng.uniform(0.0, 6.3, 16), rng.uniform(-60.0, 60.0, 16)

    @jax.jit
    @jax.vmap
    def shots(speed, angle, spin):
        world, state = bullets(speed, angle, spin)
        states = dr.rollout(world, state, dt=40.0 / speed / 8, steps=8).state  # 5 m a step, 40 m in all
        corner = jax.vmap(jax.vmap(dr.material_point, (None, None, 0)), (0, None, None))
        corners = corner(states, 1, jnp.asarray([(0.2, 0.1), (-0.2, 0.1), (0.2, -0.1), (-0.2, -0.1)]))
        return (
            states,
            corners[:, :, 0].max(),
            dr.kinetic_energy(world.bodies, jax.tree.map(lambda leaf: leaf[-1], states)),
        )

    states, furthest, energy = shots(speeds, angles, spins)
    face = 15.0 - 0.01 - 0.1
    assert_allclose(states.x[:, -1, 0, 0], 2 * face - 40.0, rtol=EXACT)
    assert_allclose(states.v[:, -1, 0, 0], -speeds, rtol=EXACT)
    assert_allclose(states.v[:, -1, 2:, 0], speeds[:, None] * np.array([-1 / 3, 2 / 3]), rtol=EXACT)  # elastic, 1 to 2
    assert_allclose(states.x[:, -1, 3, 0], 20.0 + 2 / 3 * (40.0 - 19.8), rtol=EXACT)
    assert furthest.max() < 14.99 + EXACT
    assert (states.v[:, -1, 1, 0] < 0).all()
    inertia = (0.4**2 + 0.2**2) / 12
    assert_allclose(energy[:, 1], 0.5 * speeds**2 + 0.5 * inertia * spins**2, rtol=EXACT)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.0, 1e-3])
def test_a_rod_that_a_torque_spins_up_does_not_pass_a_peg(width):
    """It stands still where the step begins: how fast its end comes follows from the torque alone."""
    bodies = {
        "rod": dr.Body(dr.Box(half=(0.5, 0.01)), mass=1.0, inertia=1.0, x=(0.0, 0.0)),
        "peg": dr.Static(dr.Box(half=(0.02, 0.01)), x=(0.4, 0.15)),
    }
    torque, contact = [dr.Torque(body="rod", tau=200.0)], dr.Contact(width=width)
    world, state = dr.scene(bodies, forces=torque, restitution=0.5, contact=contact)
    once, often = (dr.rollout(world, state, dt=0.1 / n, steps=n).state.w[-1, 0, 0] for n in (1, 4))
    assert_allclose(once, often, rtol=EXACT)
    assert 17.0 < once < 18.0  # 20 without the peg


@pytest.mark.slow
@pytest.mark.parametrize("shape", [dr.Box(half=(0.01, 0.006)), dr.Capsule(radius=0.004, half_length=0.01)], ids=type)
def test_what_is_small_and_fast_does_not_tunnel_in_single_precision(shape):
    """Thrown at a thin slab, one after the other: together in a batch each would search as long as the slowest."""
    rng, dt, speed = np.random.default_rng(3), 1 / 60, 9.0
    bodies = {"a": dr.Body(shape, mass=0.01, x=(0.0, 0.1)), "slab": dr.Static(dr.Box(half=(2.0, 0.01)))}
    world, state = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32), dr.scene(bodies, restitution=0.5, friction=0.3)
    )

    def thrown(height, angle, w):
        q = jnp.stack([jnp.cos(angle), jnp.sin(angle)])[None]
        start = dr.replace(state, x=jnp.stack([0.0 * height, height])[None], q=q, w=w[None, None])
        start = dr.replace(start, v=jnp.array([[0.2, -speed]], jnp.float32))
        return dr.step(world, dr.step(world, start, dt), dt).v[0, 1]

    ranges = (0.03, 0.03 + 0.9 * speed * dt), (0.0, 6.3), (-5.0, 5.0)
    starts = tuple(jnp.asarray(rng.uniform(*limits, 300), jnp.float32) for limits in ranges)
    after = jax.jit(lambda starts: jax.lax.map(lambda start: thrown(*start), starts))(starts)
    assert (after > -0.6 * speed).all()


# ---- rest


@pytest.mark.parametrize("rate", [60, 240])
def test_ball_comes_to_rest_on_the_floor_and_stays(rate):
    """Infinitely many bounces end at 1.2 s. Then the height is the radius, whatever it started from."""
    state, jac = run(disc_and_plane, dict(e=0.6, y=0.9, r=0.1, g=G), 6.0, rate)
    assert_allclose(state.x[0], [0.0, 0.1], atol=AT_REST)
    assert_allclose(state.v[0], 0.0, atol=AT_REST)
    y = 1  # row of the outputs
    assert_allclose(jac[1].x[y], 0.0, atol=1e-6)  # d y / d start
    assert_allclose(jac[0].shapes[0].radius[y], 1.0, atol=1e-6)
    assert_allclose(jac[0].bodies.restitution[y], 0.0, atol=1e-6)
    assert np.isfinite(ravel_pytree(jac)[0]).all()


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_box_on_the_ground_stays(angle):
    """On the level and, with friction above tan(angle), on a slope."""
    n = np.array([np.sin(angle), np.cos(angle)])
    p = dict(mu=0.5, e=0.5, half_y=0.1, x=0.1 * n[0], y=0.1 * n[1], angle=-angle, tilt=angle, g=G)
    state, jac = run(box_and_plane, p, 5.0)
    assert_allclose(state.x[0], 0.1 * n, atol=AT_REST)
    assert_allclose(state.q[0], [np.cos(angle), -np.sin(angle)], atol=AT_REST)
    assert_allclose(np.concatenate([state.v[0], state.w[0]]), 0.0, atol=AT_REST)
    assert np.isfinite(ravel_pytree(jac)[0]).all()


def test_flat_box_rebounds_flat():
    """Both corners strike at once and share the impulse: v = -e v, no spin, with friction or without."""
    for mu in (0.0, 0.4):
        p = dict(e=0.5, mu=mu, half_y=0.05, y=0.5, vy=-1.0, g=G, m=2.0, inertia=0.06)
        state, _ = run(box_and_plane, p, 0.35)
        exact = bouncing(1)(0.35, 0.5, 0.5, -1.0, G, 0.05)
        jax.tree.map(lambda a, b: assert_allclose(a, b, atol=EXACT), state, exact)


def box_on_floor(seconds, half, x, v, e, mu, w=(0.0, 0.0, 0.0)):
    """States of a box in space, one program for each second."""
    box = dr.Body(dr.Box(half=half), mass=2.0, x=x, v=v, w=w)
    floor = dr.Static(dr.HalfSpace(normal=vector(0.0, 0.0, 1.0)))
    world, state = dr.scene({"box": box, "floor": floor}, gravity=(0.0, 0.0, -G), restitution=e, friction=mu)
    parts = [jax.tree.map(lambda leaf: leaf[None], state)]
    for _ in range(seconds):
        last = jax.tree.map(lambda leaf: leaf[-1], parts[-1])
        parts.append(jax.tree.map(lambda leaf: leaf[1:], dr.rollout(world, last, dt=1 / 60, steps=60).state))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@pytest.mark.slow
def test_flat_box_rebounds_flat_and_then_rests_in_space():
    """Four corners at once; between the first two impacts, and long after the last."""
    speed, hit = fall(0.2, -1.0, G)
    between = slice(8, 21)  # frames after the first impact, at 0.12 s, and before the second, at 0.35 s
    after = np.arange(61)[between] / 60 - hit
    for mu in (0.0, 0.4):
        s = box_on_floor(4, (0.3, 0.4, 0.1), (1.0, 2.0, 0.3), (0.0, 0.0, -1.0), 0.5, mu)
        assert_allclose(s.x[between, 0, 2], 0.1 + 0.5 * speed * after - G * after**2 / 2, atol=EXACT)
        assert_allclose(s.v[between, 0, 2], 0.5 * speed - G * after, atol=EXACT)
        assert_allclose(s.w, 0.0, atol=EXACT)
        assert_allclose(s.x[-60:, 0], np.broadcast_to([1.0, 2.0, 0.1], (60, 3)), atol=AT_REST)
        assert_allclose(s.v[-60:], 0.0, atol=AT_REST)


# ---- where a formula could divide by zero


DISCS = PAIR | dict(
    mu=0.3, ra=0.2, rb=0.2, xa=0.0, ya=0.0, xb=1.0, yb=0.0, vxa=2.0, vya=0.0, vxb=0.0, vyb=0.0, wa=0.0, wb=0.0
)
SINGULAR_DISCS = {
    "graze": dict(yb=0.4),
    "almost graze": dict(yb=0.4 - 1e-12),
    "concentric": dict(xb=0.0),
    "concentric at rest": dict(xb=0.0, vxa=0.0),
    "no velocity": dict(vxa=0.0),
    "touch at rest": dict(xb=0.4, vxa=0.0),
    "touch and part": dict(xb=0.4, vxa=-1.0),
    "touch and close": dict(xb=0.4),
    "touch and slide past": dict(xb=0.4, vxa=0.0, vya=1.0),
    "same velocity": dict(vxb=2.0),
    "no friction": dict(mu=0.0, yb=0.1),
    "no restitution": dict(e=0.0, yb=0.1),
    "neither": dict(e=0.0, mu=0.0, yb=0.1),
    "head on, no slip": dict(mu=0.5),
}


@pytest.mark.parametrize("name", SINGULAR_DISCS)
def test_singular_discs_have_finite_state_and_gradient(name):
    """In both modes, by every float leaf of World and State."""
    p = DISCS | SINGULAR_DISCS[name]
    state, jac = run(two_discs, p, 1.0)
    assert np.isfinite(ravel_pytree(state)[0]).all()
    assert np.isfinite(ravel_pytree(jac)[0]).all()
    world, start = made(two_discs, p)
    blocks, dt = steps_near(1.0, 60)
    weights = jnp.ones_like(ravel_pytree(start)[0])
    assert np.isfinite(pulled_back(world, start, dt, 60, weights)).all()
    assert_allclose(state.v[0] * p["ma"] + state.v[1] * p["mb"], [p["vxa"] + p["mb"] * p["vxb"], p["vya"]], atol=EXACT)


BOXES = dict(
    e=0.5, mu=0.3, xa=0.0, ya=0.0, xb=1.0, yb=0.0, vxa=2.0, vya=0.0, vxb=0.0, vyb=0.0, angle_a=0.0, angle_b=0.0, wa=0.0, wb=0.0
)  # fmt: skip
SINGULAR_BOXES = {
    "parallel faces": dict(),
    "parallel faces, offset": dict(yb=0.2),
    "parallel faces that rest": dict(e=0.0),
    "parallel faces that touch": dict(xb=0.6, vxa=0.0),
    "parallel faces that slide past": dict(xb=0.6, vxa=0.0, vya=1.0),
    "no velocity": dict(vxa=0.0),
    "corner on corner": dict(yb=0.4),
    "corner on face": dict(angle_b=np.pi / 4),
    "same place": dict(xb=0.0),
    "neither restitution nor friction": dict(e=0.0, mu=0.0, angle_b=0.3, yb=0.1),
}


@pytest.mark.parametrize("name", SINGULAR_BOXES)
def test_singular_boxes_have_finite_state_and_gradient(name):
    p = BOXES | SINGULAR_BOXES[name]
    state, jac = run(two_boxes, p, 0.5)
    assert np.isfinite(ravel_pytree(state)[0]).all()
    assert np.isfinite(ravel_pytree(jac)[0]).all()
    assert_allclose(state.v[0] + 1.5 * state.v[1], [p["vxa"], p["vya"]], atol=EXACT)


def test_parallel_faces_share_the_impulse():
    """Centred boxes rebound as points do; the gradient by the velocities is that of the one-dimensional law."""
    state, jac = run(two_boxes, BOXES, 0.5)
    m, e = np.array([1.0, 1.5]), 0.5
    by_speed = np.array([[m[0] - e * m[1], (1 + e) * m[1]], [(1 + e) * m[0], m[1] - e * m[0]]]) / m.sum()
    assert_allclose(state.v[:, 0], 2.0 * by_speed[:, 0], rtol=EXACT)
    assert_allclose(state.w, 0.0, atol=EXACT)
    rows = np.array([8, 10])  # the x components of v, after x and q
    assert_allclose(jac[1].v[rows, :, 0], by_speed, atol=EXACT)


def test_law_without_friction_is_smooth_where_the_target_makes_energy():
    """As for a contact that is not active, whose velocity the impulses at others have changed."""
    K, n, v, target = jnp.eye(2), vector(0.0, 1.0), vector(0.3, -1.0), jnp.asarray(2.0)
    P, *slopes = law_and_slopes(K, n, v, target, jnp.zeros(()))
    assert_allclose(P, [0.0, 3.0])
    assert all(np.isfinite(slope).all() for slope in slopes)


@jax.jit
def law_and_slopes(*arguments):
    return contact_law(*arguments), *jax.jacrev(contact_law, (0, 1, 2, 3, 4))(*arguments)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("mass", "speed"), [(1e-9, 1e-7), (1.0, 1e-9), (1e12, 1.0)])
def test_law_is_the_same_in_any_unit(dim, mass, speed):
    """In float32, whose range squares of K [1/kg] and of energies would leave: impulses, and slopes by all arguments."""
    K = np.array([[3.0, 0.4, -0.7], [0.4, 2.0, 0.5], [-0.7, 0.5, 2.5]])[:dim, :dim]
    n, mu = np.array([0.6, 0.8, 0.0])[:dim], 0.3
    for slip, closing in ((0.2, -1.0), (2.0, -1.0), (1e-3, 1.0)):  # sticks, slides, parts
        v = closing * n + slip * np.array([0.8, -0.6, 0.5])[:dim]

        def slopes(dtype, mass, speed, K=K, v=v):
            return law_and_slopes(*(jnp.asarray(a, dtype) for a in (K / mass, n, v * speed, 0.5 * speed, mu)))

        P = mass * speed
        for unit, one, other in zip(
            (P, mass * P, P, mass, mass, P),
            slopes(jnp.float64, 1.0, 1.0),
            slopes(jnp.float32, mass, speed),
            strict=True,
        ):
            assert_allclose(np.asarray(other, np.float64) / unit, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())


def test_friction_in_space_acts_against_the_slip_that_it_leaves():
    """Where a corner couples the directions: Newton's and Coulomb's law, no gain of energy, and slopes."""
    rng, count = np.random.default_rng(0), 400
    factor = rng.normal(size=(3, 3, count))
    K = np.einsum("ijc,kjc->ikc", factor, factor) + 0.1 * np.eye(3)[..., None]
    n, v = (r / np.linalg.norm(r, axis=0) for r in rng.normal(size=(2, 3, count)))
    v = np.where((n * v).sum(0) > 0, -v, v)
    e, mu = rng.uniform(0.0, 1.0, (2, count))
    given = K, n, v, -e * (n * v).sum(0), mu
    way = tuple(rng.normal(size=np.shape(value)) for value in given)

    jitted = jax.jit(contact_law)

    def law(step):
        return jitted(*(jnp.asarray(value) + step * by for value, by in zip(given, way, strict=True)))

    P, slope = jax.jvp(law, (0.0,), (1.0,))
    assert_allclose(slope, (law(1e-7) - law(-1e-7)) / 2e-7, atol=1e-5 * np.abs(slope).max())
    P = np.asarray(P)
    P_n, after = (n * P).sum(0), v + np.einsum("ijc,jc->ic", K, P)
    v_n, P_t = (n * after).sum(0), P - P_n * n
    slip, size = after - v_n * n, np.linalg.norm(P_t, axis=0)
    assert_allclose(v_n, -e * (n * v).sum(0), atol=EXACT)
    assert (size <= mu * P_n + EXACT).all()
    sticks = np.linalg.norm(slip, axis=0) < EXACT
    slides = ~sticks & (size > mu * P_n - EXACT)  # the others are bounded by their energy
    assert sticks.sum() > 30
    assert slides.sum() > 200
    assert_allclose((P_t * slip).sum(0)[slides], -(size * np.linalg.norm(slip, axis=0))[slides], atol=EXACT)
    assert (((v + after) * P).sum(0) < EXACT).all()  # twice the energy that it adds


def test_sticking_turns_to_slipping_without_a_jump():
    """In space, where the impulse that would stop the slip has another direction than the slip."""
    K = np.array([[3.0, 1.4, -0.7], [1.4, 2.0, 0.9], [-0.7, 0.9, 1.5]])
    mu = np.linspace(0.0, 2.0, 8001)
    n, v = np.array([0.0, 0.0, 1.0]), np.array([0.5, -0.4, -1.0])
    P = jax.jit(jax.vmap(lambda mu: contact_law(*map(jnp.asarray, (K, n, v, 0.5)), mu)))(mu)
    assert_allclose(P[0, :2], 0.0)
    assert np.abs(np.diff(P, axis=0)).max() < 2e-3 * np.abs(P).max()
    assert_allclose(P[-1], P[-500])  # it sticks at last


def test_a_contact_that_is_off_has_no_derivative():
    """In a list of contacts most are far apart, where the law overflows in float32: 0, and not 0 * inf."""
    far = {"K": jnp.diag(jnp.array([2.0, 9.0]))[None], "n": jnp.array([[0.6, 0.8]]), "v": jnp.full((1, 2), -1e25)}
    far = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), far | {"target": jnp.ones(1), "mu": jnp.zeros(1)})
    P, back = jax.vjp(lambda far: impulses(jnp.array([False]), **far), far)
    assert not P.any()
    assert all(not leaf.any() for leaf in jax.tree.leaves(back(jnp.ones_like(P))))


def test_second_derivatives_through_an_impact_are_an_error():
    """Not numbers that leave out how the time of the impact curves; those of a free body are right."""
    ball, floor = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0)), dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))

    def fall(g, bodies):
        world, state = dr.scene(bodies, gravity=jnp.stack([jnp.zeros_like(g), -g]))
        return dr.step(world, state, 0.1).x[0, 1] ** 2

    free = jax.jit(jax.hessian(lambda g: fall(g, {"ball": ball})))(jnp.asarray(10.0))
    assert_allclose(free, 2.0 * (0.5 * 0.1**2) ** 2)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.eval_shape(jax.hessian(lambda g: fall(g, {"ball": ball, "floor": floor})), jnp.asarray(10.0))


def test_friction_of_rounding_has_finite_slopes():
    """In float32, without friction: quotients of what is left of it, whose squares are below the least number."""
    pair = SimpleNamespace(wholes=("pair",), active=jnp.array([True]))
    slip, at_end, friction = (jnp.full((1, 2), size, jnp.float32) for size in (1e-3, 0.9e-3, 1e-16))
    arguments = jnp.full(1, 4e-3, jnp.float32), slip, at_end, friction, jnp.zeros(1, jnp.float32)
    given = {"most_to_stop": jnp.ones(1, jnp.float32), "rest_speed": jnp.float32(1e-3)}
    lost, back = jax.vjp(functools.partial(lost_to_stops, pair, **given), *arguments)
    assert not lost.any()
    assert all(np.isfinite(slope).all() for slope in back(jnp.ones_like(lost)))


@pytest.mark.slow
def test_slopes_after_an_impact_at_the_very_end_of_a_step():
    """In float32 and with drag, what is left of the step after the impact is too short for its third power."""
    dt = 1 / 240

    def landing(height):
        ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=vector(0.0, 0.1), v=vector(0.1, -2.0), w=3.0)
        floor = dr.Static(dr.HalfSpace(normal=vector(0.0, 1.0)))
        drag = dr.Drag(linear=0.1, angular=0.001)
        world, state = dr.scene({"ball": ball, "floor": floor}, forces=[drag], restitution=0.8, friction=0.3)
        world, state = jax.tree.map(lambda leaf: leaf.astype(height.dtype), (world, state))
        return dr.step(world, dr.replace(state, x=state.x.at[0, 1].add(height)), dt)

    def slopes(height, dtype):
        run = with_slopes(lambda h: ravel_pytree(landing(h))[0])
        return np.stack([run(jnp.asarray(h, dtype))[1][0] for h in height])

    # A fall by v dt less these ends the step; none of them is in float64, so all struck.
    before = np.float32(2.0 * dt) * (1.0 - np.array([3e-8, 1e-7, 1e-6, 1e-5, 1e-4]))
    exact, single = (slopes(before, dtype) for dtype in (jnp.float64, jnp.float32))
    assert np.isfinite(single).all()
    assert_allclose(single, exact, rtol=1e-3, atol=1e-3 * np.abs(exact).max())


def test_a_corner_that_rests_hides_no_impact_of_another():
    """A box that comes to rest on corners and edges, by turns: every other corner is struck in the step in which it lands."""
    half = np.array([0.5, 0.3, 0.2])
    s = box_on_floor(1, half, (0.0, 0.0, 0.9), (1.0, 0.3, 0.0), 0.4, 0.3, w=(1.0, 2.0, 0.5))
    corners = half * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)
    rotate = jax.vmap(jax.vmap(dr.state.rotations(3).rotate, (None, 0)), (0, None))
    lowest = s.x[:, 0, 2] + rotate(s.q[:, 0], jnp.asarray(corners))[..., 2].min(1)
    assert lowest.min() > -1e-5  # 15 mm where an impact is found a step late


@pytest.mark.slow
def test_a_tip_that_slides_down_one_side_of_a_valley_hides_no_impact_of_the_other():
    """One tip of a rod slides down one side of a valley, the other side strikes the rod, and then its other tip."""
    c, rod = np.sqrt(0.5), dr.Capsule(radius=0.1, half_length=0.25)
    sides = {name: dr.Static(dr.HalfSpace(normal=(sign * c, c))) for name, sign in (("left", 1), ("right", -1))}
    starts = [  # x, q, v, w
        (0.173778970276597, 0.32114578301298985, -0.7188977065829815, -0.6951158806053344, 0.8003576539828867, -0.7717112530464109, 4.4472204935081905),
        (-0.1753060073618868, 0.319656604682597, -0.7012240294167759, 0.712940993749483, -0.687823684629512, -0.6740201956935066, 3.852074029070639),
        (-0.1704820085919278, 0.324276175039948, -0.6819280342977271, 0.7314192751348831, -0.8795377394096214, -0.8175918974164866, 4.80340403591766),
    ]  # fmt: skip
    bodies = sides | {"rod": dr.Body(rod, mass=1.0, x=(0.0, 1.0))}
    world, _ = dr.scene(bodies, gravity=(0.0, -G), friction=0.2)

    @jax.jit
    def gaps(start):
        x, q, v, w = jnp.split(start, (2, 4, 6))
        state = dr.State(x=x[None], q=q[None] / jnp.linalg.norm(q), v=v[None], w=w[None])
        return jnp.stack([dr.gap(world, dr.step(world, state, 1 / 60), "rod", side) for side in sides])

    for start in starts:
        assert gaps(jnp.array(start)).min() > -1e-6  # 24 to 30 mm where an impact is found a step late


@pytest.mark.slow
def test_an_edge_that_rests_hides_no_impact_of_another():
    """An edge of a box tips over one edge of another box and strikes a second, beside a corner: the nearer is first."""
    box, block = dr.Box(half=(0.15, 0.1, 0.08)), dr.Box(half=(0.4, 0.3, 0.2))
    start = {
        "x": (0.40018397933968075, -0.3, 0.37207707846845434),
        "q": (-0.22018465723828828, 0.5848283496874436, 0.3991205097914665, 0.6709674632815801),
        "v": (0.011091838253897457, 0.0, -0.4060603726482718),
        "w": (4.550815093491126, 0.40151602668759034, -3.27105393217865),
    }
    body = dr.Body(box, mass=1.0, inertia=(0.01, 0.012, 0.014), **start)
    world, state = dr.scene({"box": body, "block": dr.Static(block)}, gravity=(0.0, 0.0, -G))
    end = dr.step(world, state, 1 / 480)
    x, q = np.asarray(end.x[0]), np.asarray(end.q[0])
    apart = separation(place(box, x, q), place(block, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))
    assert apart > -1e-6  # 0.5 mm where the second is taken for the first


@pytest.mark.slow
def test_a_plate_that_lands_on_a_box_almost_flat_does_not_sink_in():
    """Crossings of edges change places in their list while the plate turns: those that rest are known by number."""
    first = {
        "x": (-0.029593956882871596, -0.04235542057804695, 0.21374301828153336),
        "q": (-0.026085342274905214, 0.8125823465671257, 0.5819902065539119, 0.017801248304529733),
        "v": (-0.2884458722350718, 0.19639899157514573, -1.539786919589135),
        "w": (-17.11625600569474, -10.151671549128768, -0.6121868387353928),
    }
    second = {
        "x": (0.04128442734044063, 0.004850838157021067, 0.22977054028433605),
        "q": (-0.023569157962878447, -0.9297876597558893, -0.35307696664508803, 0.10137089416243047),
        "v": (0.3769981918190906, 0.4191800350524024, -1.300707833685499),
        "w": (4.137567803759058, -16.09276239304208, 1.1616765712937251),
    }
    plate, box = dr.Box(half=(0.1, 0.07, 0.01)), dr.Static(dr.Box(half=(0.1, 0.1, 0.1)), x=(0.0, 0.0, 0.1))
    for start in (first, second):
        bodies = {"plate": dr.Body(plate, mass=0.3, **start), "box": box}
        world, state = dr.scene(bodies, gravity=(0.0, 0.0, -G), restitution=0.2, friction=0.4)
        end = dr.step(world, state, 1 / 240)
        assert dr.gap(world, end, "plate", "box") > -1e-6  # 4.2 mm, and 52 um growing to 15 mm


def test_boxes_that_their_spins_bring_together_do_not_sink_in():
    """They bounce ever more often within a step, more often than it has sweeps, and roll on from there."""
    bodies = {
        "a": dr.Body(
            dr.Box(half=(0.1823, 0.0775)), density=10.0, x=(0.0, 0.0), angle=-1.872, v=(1.0525, -1.698), w=0.1723
        ),
        "b": dr.Body(
            dr.Box(half=(0.1208, 0.1719)), density=10.0, x=(0.3767, -0.5757), angle=1.3147, v=(-1.2215, 1.663), w=2.6417
        ),
    }
    world, state = dr.scene(bodies, restitution=0.484)
    states = dr.rollout(world, state, dt=1 / 60, steps=20).state
    gaps = jax.jit(jax.vmap(lambda state: dr.gap(world, state, "a", "b")))(states)
    assert gaps.min() > -1e-8
    energy = jax.vmap(lambda state: dr.kinetic_energy(world.bodies, state).sum())(states)
    assert (np.diff(energy) < 1e-12 * energy[0]).all()


@pytest.mark.slow
def test_an_edge_of_a_plate_that_tips_over_a_box_strikes_at_its_time():
    """Of two crossings of edges that touch by turns the one that strikes comes nearer than the one that rested."""
    start = {
        "x": (0.7335753266951958, -0.02936037819418516, 0.05304783315657637),
        "q": (0.9139449573427564, 0.05350130364943985, 0.11453316998582871, 0.38564799808705724),
        "v": (1.1623862765270023, -0.363152212783107, -2.1489223759540987),
        "w": (-4.591230076408363, 0.8826684519115975, 1.3725770827202728),
    }
    plate = dr.Body(dr.Box(half=(0.4, 0.3, 0.01)), mass=1.0, **start)
    bodies = {"plate": plate, "box": dr.Static(dr.Box(half=(0.5, 0.5, 0.1)))}
    world, state = dr.scene(bodies, gravity=(0.0, 0.0, -G), restitution=0.15, friction=0.53)
    coarse, fine = (dr.rollout(world, state, dt=1 / 240 / n, steps=2 * n).state for n in (1, 16))
    for leaf, exact in zip(jax.tree.leaves(coarse), jax.tree.leaves(fine), strict=True):
        assert_allclose(leaf[-1], exact[-1], atol=2e-4)  # 0.8 m/s off, and 15 mm deep, where it strikes late


@pytest.mark.slow
def test_what_tumbles_on_a_box_does_so_as_on_a_half_space():
    """A wheel with twelve corners drops, slides, rocks and rolls: which corners act is found in two ways."""
    angles = 2.0 * np.pi * np.arange(12) / 12
    wheel = dr.Polygon(vertices=0.1 * np.stack([np.cos(angles), np.sin(angles)], 1))
    body = dr.Body(wheel, mass=1.0, x=(0.0, 0.2), v=(0.3, 0.0), w=2.0, angle=0.01)
    grounds = dr.Static(dr.HalfSpace(normal=(0.0, 1.0))), dr.Static(dr.Box(half=(5.0, 1.0)), x=(0.0, -1.0))
    paths = []
    for ground in grounds:
        scene = dr.scene({"wheel": body, "ground": ground}, gravity=(0.0, -G), friction=0.5, restitution=0.3)
        paths.append(dr.rollout(*scene, dt=1 / 60, steps=90).state)
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-10), *paths)
    assert abs(paths[0].q[-1, 0, 1] - paths[0].q[0, 0, 1]) > 0.1


@pytest.mark.slow
def test_in_single_precision_too_one_corner_strikes_after_the_other():
    """A box that lands 1e-4 rad from flat: its second corner is 0.1 mm up when the first strikes."""
    box = dr.Body(dr.Box(half=(0.5, 0.35)), mass=1.0, x=(0.0, 0.3501), angle=1e-4, v=(0.3, -1.0))
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    double = dr.scene({"box": box, "floor": floor}, restitution=0.5, friction=0.3)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), double)
    exact, rounded = (dr.rollout(*scene, dt=1 / 60, steps=1).state for scene in (double, single))
    assert abs(exact.w[-1, 0, 0]) > 0.5  # at once they would not turn it
    assert_allclose(rounded.w[-1], exact.w[-1], atol=1e-3)
    assert_allclose(rounded.v[-1], exact.v[-1], atol=1e-3)


@pytest.mark.slow
def test_two_capsules_roll_over_each_other_without_falling_into_each_other():
    """Their sides come to rest on one another within the step, then close as fast as they turn: slopes, and the gap."""
    poses = {
        "a": ((0.0654, -0.0064, -0.0184), (-0.7173, 0.6060, -0.3286, -0.1011)),
        "b": ((0.1493, 0.1641, 0.2646), (-0.5521, -0.2545, 0.6558, 0.4475)),
    }
    moves = {
        "a": ((1.038, -0.1727, -0.5138), (-0.4698, 0.7554, 0.3224)),
        "b": ((-0.1294, 0.4461, 0.7320), (-2.2192, -6.7351, -2.1631)),
    }
    capsule = dr.Capsule(radius=0.15, half_length=0.3)
    bodies = {
        name: dr.Body(capsule, mass=1.5, inertia=(0.055, 0.058, 0.067), x=x, q=q / np.linalg.norm(q), v=v, w=w)
        for (name, (x, q)), (v, w) in zip(poses.items(), moves.values(), strict=True)
    }
    world, state = dr.scene(bodies, restitution=0.3)
    apart = dr.gap(world, state, "a", "b") - 1.8e-5
    line = jax.grad(lambda state: dr.gap(world, state, "a", "b"))(state).x[0]  # along it they nearly touch
    state = dr.replace(state, x=state.x.at[0].add(-apart * line))
    along = jnp.array([[1.0, 0.5, -0.3], [0.0, 0.0, 0.0]])

    @jax.jit
    def moved(h):
        def end(h):
            after = dr.step(world, dr.replace(state, v=state.v + h * along), 0.7 / 60)
            return jnp.concatenate([after.v, after.w]), dr.gap(world, after, "a", "b")

        (motion, gap), (slope, _) = jax.jvp(end, (h,), (1.0,))
        return motion, slope, gap

    ahead, behind = moved(1e-5)[0], moved(-1e-5)[0]
    _, slope, gap = moved(0.0)
    assert_allclose(slope, (ahead - behind) / 2e-5, atol=1e-6)
    assert abs(gap) < 1e-4
