"""jit, vmap, batches, types, times and controls change no numbers; forces that vary are fourth order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import BALL, CASES, bouncing, disc_and_plane, made, numpy_motion, vector, with_slopes
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.pytree import pytree
from diffrigid.scan import WORLDS
from diffrigid.step import ROLLOUT, STEP, floats

ROUNDING = 1e-11  # absolute, of values about 1: the same operations in another order
EXACT = 1e-9  # relative: rounding of a few hundred steps
SINGLE = 1e-5  # relative: the rounding of float32, over 30 steps and a bounce
STEPS = 30


def assert_same(got, expected, atol):
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=atol, rtol=0), got, expected)


# ---- transformations


PUCK = dr.Body(dr.Disc(radius=0.1), mass=2.0, x=(0.0, 0.0))
RUB = CASES["bounce that slides"].parameters


def variants():
    """Worlds and states that differ in everything, each bouncing within half a second."""
    rng = np.random.default_rng(0)
    return [made(disc_and_plane, {k: v * rng.uniform(0.8, 1.2) for k, v in RUB.items()}) for _ in range(4)]


def rolled(world, state):
    return dr.rollout(world, state, dt=1 / 60, steps=STEPS).state


def test_jit_is_no_jit():
    """One step with an impact in it, every operation on its own."""
    world, state = made(disc_and_plane, RUB | dict(y=0.12, vy=-2.0))
    compiled = dr.step(world, state, 1 / 60)
    assert compiled.v[0, 1] > 1.0
    assert_same(jax.jit(dr.step)(world, state, 1 / 60), compiled, 0.0)
    with jax.disable_jit():
        assert_same(dr.step(world, state, 1 / 60), compiled, ROUNDING)


@pytest.mark.slow
def test_what_reverse_mode_saves():
    """The passes of all steps, or only the states between them, as memory allows: the same slopes."""
    world, state = floats(*made(disc_and_plane, RUB))
    room = STEPS * world.contact.saved_numbers(world) * state.x.dtype.itemsize
    saved, slopes = [], []
    for memory in (WORLDS * room, WORLDS * room - 1):

        def end(world, state, memory=memory):
            return dr.rollout(world, state, dt=1 / 60, steps=STEPS, memory=memory).state.x[-1].sum()

        pull = jax.jit(lambda *inputs, end=end: jax.vjp(end, *inputs)[1])(world, state)
        saved.append(sum(leaf.nbytes for leaf in jax.tree.leaves(pull)))
        slopes.append(jax.jit(lambda pull: pull(1.0))(pull))
    assert saved[0] <= room and saved[1] < 0.2 * saved[0]
    assert_same(*slopes, ROUNDING)


@pytest.mark.parametrize("axis", [0, -1], ids=["vmap", "trailing axis"])
def test_batch_is_loop(axis):
    """Worlds and states together; a trailing axis is what the library itself works on."""
    alone = [rolled(*variant) for variant in variants()]
    assert all(states.v[-1, 0, 1] > 0 for states in alone)  # all have bounced
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis), *variants())
    together = jax.jit(jax.vmap(rolled))(*batch) if axis == 0 else rolled(*batch)
    assert_same(together, jax.tree.map(lambda *leaves: jnp.stack(leaves, axis), *alone), ROUNDING)


@pytest.mark.slow
def test_vmap_keeps_branches():
    """One that no world needs is left out, forward and in reverse mode; else vmap would compute every one for all."""

    def energy(world, state):
        return dr.kinetic_energy(world.bodies, dr.step(world, state, 1 / 60)).sum()

    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *variants())
    for fn in (energy, jax.grad(energy)):
        alone = jax.jit(fn).lower(*variants()[0]).as_text()
        together = jax.jit(jax.vmap(fn)).lower(*batch).as_text()
        assert together.count("stablehlo.case") == alone.count("stablehlo.case") > 0
        assert together.count("stablehlo.while") == alone.count("stablehlo.while")


def test_motion_is_the_same_with_derivatives():
    """4096 slender and thick tops: a number that is near to a switch may be rounded to its other side."""
    rng = np.random.default_rng(0)

    def top(radius, half_length):
        return dr.scene({"top": dr.Body(dr.Capsule(radius=radius, half_length=half_length), mass=2.0, x=(0.0,) * 3)})

    world, state = jax.jit(jax.vmap(top))(*jnp.asarray(rng.uniform(0.01, 1.0, (2, 4096))))
    q = rng.normal(size=state.q.shape)
    q = jnp.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))
    world_and_state = world, dr.replace(state, q=q, w=jnp.asarray(rng.normal(size=state.w.shape) * 10))

    def end(world, state):
        return dr.rollout_batch(world, state, dt=1 / 60, steps=1, final_only=True).q

    of_jvp = jax.jit(lambda given, along: jax.jvp(end, given, along)[0])
    assert_same(of_jvp(world_and_state, world_and_state), end(*world_and_state), ROUNDING)


def test_batch_of_states_shares_a_world():
    world, _ = variants()[0]
    states = [state for _, state in variants()]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves, -1), *states)
    alone = jax.tree.map(lambda *leaves: jnp.stack(leaves, -1), *[rolled(world, state) for state in states])
    assert_same(rolled(world, batch), alone, ROUNDING)


def test_other_values_do_not_compile_again():
    """Values as users write them: Python integers and floats, NumPy numbers."""

    def scene(radius, mass, gravity, e):
        ball = dr.Body(dr.Disc(radius=radius), mass=mass, x=(0, 1))
        floor = dr.Static(dr.HalfSpace(normal=(0, 1)))
        return dr.scene({"ball": ball, "floor": floor}, gravity=gravity, restitution=e)

    quick = ROLLOUT[0], STEP[0]
    before = [fn.program()._cache_size() for fn in quick]
    for values, dt in (((1, 2, (0, -10), 0), 0.01), ((0.5, np.float32(2.5), (0.1, -9.81), 0.7), np.float64(0.02))):
        world, state = scene(*values)
        dr.rollout(world, state, dt=dt, steps=3)
        dr.rollout(dr.replace(world, contact=dr.Contact(width=dt)), state, dt=dt, steps=3)
        dr.step(world, state, dt)
    assert [fn.program()._cache_size() for fn in quick] == [count + 1 for count in before]


def test_float32_stays_float32():
    world, state = variants()[0]
    single = rolled(*jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (world, state)))
    assert {leaf.dtype for leaf in jax.tree.leaves(single)} == {jnp.dtype(jnp.float32)}
    assert_same(single, jax.tree.map(np.float32, rolled(world, state)), 30 * SINGLE)  # angles of some ten radians


def test_rollout_is_steps():
    world, state = variants()[0]
    states = rolled(world, state)
    for k in range(STEPS):
        state = dr.step(world, state, 1 / 60)
        assert_same(jax.tree.map(lambda leaf, k=k: leaf[k + 1], states), state, ROUNDING)


# ---- times


def test_an_orientation_counts_by_its_direction():
    """A state made by hand may have one that is not of unit length."""
    world, state = made(disc_and_plane, RUB)
    longer = dr.replace(state, q=3.0 * state.q)
    assert_same(dr.step(world, longer, 1 / 60), dr.step(world, state, 1 / 60), ROUNDING)


def test_rollout_lands_on_given_times_and_is_differentiable_in_them():
    times = jnp.asarray([0.1, 0.15, 0.3, 0.417, 0.5])  # the state is that at 0.1 s; the ball bounces 0.23 s later
    p = BALL | dict(vy=0.0)
    world, state = made(disc_and_plane, p)

    def heights(times):
        return dr.rollout(world, state, times=times, dt=1 / 60).state.x[:, 0, 1]

    def exact(t):
        return jnp.stack([0.3 - 9.81 * t * t / 2, bouncing(1)(t, **p).x[0, 1]])

    since = times - times[0]
    hit = jnp.sqrt(2 * 0.2 / 9.81)
    after = (since > hit).astype(int)
    value, speed = jax.vmap(exact)(since), jax.vmap(jax.jacfwd(exact))(since)
    value, speed = (jnp.take_along_axis(a, after[:, None], 1)[:, 0] for a in (value, speed))
    trajectory = dr.rollout(world, state, times=times, dt=1 / 60)
    assert_allclose(trajectory.t, times, rtol=0)
    assert_allclose(heights(times), value, atol=EXACT)
    by_time = np.diag(speed)
    by_time[:, 0] -= speed  # the state is given at the first time: all later motion moves with it
    assert_allclose(jax.jacfwd(heights)(times), by_time, atol=EXACT)
    with pytest.raises(ValueError, match="increase"):
        heights(times[::-1])


def test_controls_hold_through_the_substeps_of_an_interval():
    """A torque tau + u_k in interval k: the spin is the sum of tau T_k / I; the angle that of a constant acceleration."""
    inertia, tau = 0.4, 0.3
    body = dr.Body(None, mass=1.0, inertia=inertia, x=(0.0, 0.0), w=0.5)
    world, state = dr.scene({"wheel": body}, forces=[dr.Torque(body="wheel", tau=tau, control="motor")])
    times = jnp.asarray([0.0, 0.1, 0.25, 0.3])
    u = jnp.asarray([[1.0], [-2.0], [0.5]])

    def spins(u):
        states = dr.rollout(world, state, times=times, dt=0.04, controls={"motor": u}).state
        return states.w[:, 0, 0], jnp.arctan2(states.q[:, 0, 1], states.q[:, 0, 0])

    T, a = np.diff(times), (tau + np.asarray(u[:, 0])) / inertia
    w = 0.5 + np.concatenate([[0.0], np.cumsum(a * T)])
    angle = np.concatenate([[0.0], np.cumsum(w[:-1] * T + a * T**2 / 2)])
    assert_allclose(jax.jit(spins)(u)[0], w, rtol=EXACT)  # where times, which it closes over, are known too
    assert_allclose(spins(u)[1], angle, atol=EXACT)
    by_control = jax.jacrev(lambda u: spins(u)[1][-1])(u)
    assert_allclose(by_control[:, 0], T * (T / 2 + (times[-1] - times[1:])) / inertia, rtol=EXACT)


def pushed():
    return dr.scene({"ball": PUCK}, forces=[dr.Force(body="ball", F=(0.0, 0.0), control="push")])


def test_controls_of_a_batch():
    """Each world its own, or one for all; with trailing axes in `rollout` and `step`, as their states have them."""
    world, state = pushed()
    push = jnp.asarray(np.random.default_rng(0).normal(size=(3, 5, 2)))  # (B, T, D)
    v = jnp.linspace(0.0, 1.0, 6).reshape(3, 1, 2)
    states, run = dr.replace(state, v=v), {"dt": 0.1, "steps": 5}
    alone = jnp.stack(
        [dr.rollout(world, dr.replace(state, v=v[k]), controls={"push": push[k]}, **run).state.v for k in range(3)]
    )
    for chunk in (1, 2, 3):
        batch = dr.rollout_batch(world, states, controls={"push": push}, chunk=chunk, **run)
        assert_allclose(batch.v, alone, rtol=EXACT)
    worlds = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), world)
    assert_allclose(dr.rollout_batch(worlds, states, controls={"push": push}, **run).v, alone, rtol=EXACT)
    same = dr.rollout_batch(world, states, controls={"push": push[0]}, final_only=True, **run)
    assert_allclose(same.v[0], alone[0, -1], rtol=EXACT)
    last = dr.replace(jax.tree.map(lambda leaf: jnp.stack([leaf] * 3, -1), state), v=jnp.moveaxis(v, 0, -1))
    trailing = dr.rollout(world, last, controls={"push": jnp.moveaxis(push, 0, -1)}, **run).state.v
    assert_allclose(jnp.moveaxis(trailing, -1, 0), alone, rtol=EXACT)
    first = dr.step(world, last, 0.1, {"push": jnp.moveaxis(push[:, 0], 0, -1)}).v
    assert_allclose(first, trailing[1], rtol=EXACT)
    assert_allclose(dr.rollout(world, last, controls={"push": push[0]}, **run).state.v[..., 0], alone[0], rtol=EXACT)


def test_controls_may_be_lists():
    rows = [[1.0, -2.0], [0.0, 0.5], [0.0, 0.0], [3.0, 1.0]]
    found, same = (dr.rollout(*pushed(), dt=0.1, steps=4, controls={"push": c}).state.v for c in (rows, np.array(rows)))
    assert_allclose(found, same, rtol=0)
    with pytest.raises(ValueError, match=r"has shape \(1,\): expected \(2,\)"):
        dr.step(*pushed(), 0.1, controls={"push": [1.0]})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Undeclared:
    """A force of one's own whose number was not declared."""

    k: float

    def __call__(self, bodies, state, controls):
        return dr.Wrench(F=-self.k * state.v)


def test_a_force_says_how_to_declare_its_numbers():
    with pytest.raises(ValueError, match=r"air.k is not declared: .*k: Leaf = array\(\)"):
        dr.scene({"ball": PUCK}, forces={"air": Undeclared(k=0.1)})
    with pytest.raises(ValueError, match=r"air.k is not declared: .*arrays of a dict or a tuple are a field each"):
        dr.scene({"ball": PUCK}, forces={"air": Undeclared(k={"layer": np.ones(2)})})


@pytree
class Wind:
    """A force of one's own, which reads a matrix for each step."""

    def __call__(self, bodies, state, controls):
        return dr.Wrench(F=jnp.broadcast_to(jnp.diag(controls["axes"])[None, :, None] * state.v, state.v.shape))


def test_a_batch_leaves_controls_of_other_forces_as_they_are():
    """Those have the axes that their force asks for: three are no batch."""
    world, state = dr.scene({"ball": PUCK}, forces=[Wind()])
    states, run = dr.replace(state, v=jnp.ones((3, 1, 2))), {"dt": 0.1, "steps": 5}
    axes = jnp.broadcast_to(jnp.diag(jnp.array([-1.0, 2.0])), (5, 2, 2))
    v = dr.rollout_batch(world, states, controls={"axes": axes}, final_only=True, **run).v
    assert_allclose(v[:, 0], np.broadcast_to(np.exp(np.array([-1.0, 2.0]) * 0.5 / PUCK.mass), (3, 2)), rtol=1e-5)


@pytest.mark.parametrize(
    "controls, message",
    [
        (None, r"controls has no 'push': give controls=\{'push': ...\} of shape \(4, 2\)"),
        ({"pusch": np.zeros((4, 2))}, "controls has no 'push', but 'pusch': give"),
        ({"push": np.zeros((4, 2)), "pull": np.zeros((4, 2))}, "no force takes 'pull': did you mean 'push'"),
        ({"push": np.zeros((4, 2)), 0: np.zeros((4, 2)), "pull": 1.0}, "no force takes 0, 'pull': there are push"),
        ({"push": np.zeros((3, 2))}, r"controls\['push'\] has shape \(3, 2\): expected \(4, 2\)"),
        ({"push": np.full((4, 2), np.nan)}, r"(?s)controls\['push'\] is \[\[nan.*: expected finite numbers"),
        ({"push": "hard"}, "expected numbers"),
        (np.zeros((4, 2)), "controls has no 'push'"),
    ],
)
def test_wrong_controls(controls, message):
    with pytest.raises(ValueError, match=message):
        dr.rollout(*pushed(), dt=0.1, steps=4, controls=controls)
    many = np.zeros((40, 2))
    many[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"^controls\['push'\]\[3, 1\] is nan: expected finite numbers"):
        dr.rollout(*pushed(), dt=0.1, steps=40, controls={"push": many})
    with pytest.raises(ValueError, match="no force takes 'push': give Force or Torque a control"):
        dr.rollout(*dr.scene({"ball": PUCK}), dt=0.1, steps=4, controls={"push": np.zeros((4, 2))})


# ---- forces


def order(error_at, steps):
    """Observed order of an error that is a function of the number of steps, and the error at twice as many."""
    coarse, fine = error_at(steps), error_at(2 * steps)
    return np.log2(coarse / fine), fine


def assert_fourth_order(error_at, steps, finest):
    observed, fine = order(error_at, steps)
    assert 3.85 < observed < 4.15, f"order {observed:.2f}, error {fine:.1e}"
    assert fine < finest


def last(scene, t, steps):
    world, state = scene
    return jax.tree.map(lambda rows: rows[-1], dr.rollout(world, state, dt=t / steps, steps=steps).state)


def test_drag_is_exponential_decay():
    m, c, I, k, t = 1.5, np.array([0.9, 0.3]), 0.2, 0.25, 1.0
    body = dr.Body(None, mass=m, inertia=I, x=(0.0, 0.0), v=(2.0, -1.0), w=3.0)
    scene = dr.scene({"body": body}, forces=[dr.Drag(linear=c, angular=k)])
    v, w = np.array([2.0, -1.0]) * np.exp(-c * t / m), 3.0 * np.exp(-k * t / I)
    x, angle = m / c * (np.array([2.0, -1.0]) - v), I / k * (3.0 - w)

    def error(steps):
        s = last(scene, t, steps)
        turn = jnp.arctan2(s.q[0, 1], s.q[0, 0]) - angle
        turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
        errors = jnp.concatenate([s.x[0] - x, s.v[0] - v, s.w[0] - w, turn[None]])
        return np.abs(errors)

    coarse, fine = error(30), error(60)
    assert (np.abs(np.log2(coarse / fine) - 4.0) < 0.15).all()  # every component
    assert fine.max() < 1e-8


def test_quadratic_drag_bounds_the_speed_of_a_fall():
    """m v' = m g - k v^2 from rest: v = u tanh(g t / u) with u^2 = m g / k."""
    m, k, g, t = 0.06, 1e-3, 9.81, 2.0
    ball = dr.Body(None, mass=m, inertia=1.0, x=(0.0, 0.0))
    scene = dr.scene({"ball": ball}, gravity=(0.0, -g), forces=[dr.Drag(quadratic=k)])
    u = np.sqrt(m * g / k)
    end = last(scene, t, 60)
    assert_allclose(end.v[0], (0.0, -u * np.tanh(g * t / u)), rtol=1e-6)
    assert_allclose(end.x[0], (0.0, -(u**2) / g * np.log(np.cosh(g * t / u))), rtol=1e-6)


@pytest.mark.slow
def test_ground_friction_stops_slides_and_spins():
    """Where arm is the radius of gyration, v and arm w fall in one proportion, at friction g, and stop at once.

    Pucks that do not spin slide s = v^2 / (2 friction g); one strikes another, with the restitution e, after 0.3 m.
    """
    e, g, m, v, w, gyration = 0.8, 9.81, 1.5, np.array([1.2, -0.5]), 6.0, 0.12
    disc, at = dr.Disc(radius=0.1), {"first": (2.0, 0.0), "second": (2.5, 0.0), "free": (0.0, 3.0)}
    bodies = {name: dr.Body(disc, mass=1.0, x=x) for name, x in at.items()}
    bodies["free"] = dr.Body(disc, mass=1.0, x=at["free"], v=(0.3, 0.0))
    turning = dr.Body(disc, mass=m, inertia=m * gyration**2, x=(0.0, 0.0), v=v, w=w)
    grounds = {name: dr.GroundFriction(name, friction=0.2, arm=gyration) for name in ("turning", "first", "second")}

    def ends(mu, speed):
        start = bodies | {"turning": turning, "first": dr.replace(bodies["first"], v=speed * jnp.array([1.0, 0.0]))}
        forces = {f"under {name}": dr.replace(ground, friction=mu) for name, ground in grounds.items()}
        run = dr.rollout(*dr.scene(start, restitution=e, forces=forces), dt=1 / 120, steps=240)
        return jnp.stack([run["turning.x"][60, 0], run["turning.w"][60, 0], run["turning.angle"][-1],
                          run["first.x"][-1, 0], run["second.x"][-1, 0], run["free.x"][-1, 0]])  # fmt: skip

    def exact(mu, speed):
        t, u = 0.5, np.hypot(np.hypot(*v), gyration * w)
        slid, hit = mu * g * t / u, speed**2 - 2 * mu * g * 0.3
        halt = hit * np.array([(1 - e) / 2, (1 + e) / 2]) ** 2 / (2 * mu * g)
        turn = w * u / (2 * mu * g)
        return np.array([v[0] * t * (1 - slid / 2), w * (1 - slid), turn, 2.3 + halt[0], 2.5 + halt[1], 0.6])

    at = 0.2, 1.5
    slopes = [(exact(*(at + h)) - exact(*(at - h))) / 2e-6 for h in 1e-6 * np.eye(2)]
    found, found_slopes = with_slopes(ends)(*at)
    assert_allclose(found[jnp.array([0, 1, 5])], exact(*at)[[0, 1, 5]], rtol=3e-4)
    assert_allclose(found, exact(*at), atol=1e-3)  # slower than friction g dt / 2 it falls off
    assert_allclose(found_slopes, slopes, atol=5e-3, rtol=2e-3)


def test_weight_is_spread_over_the_ground_as_over_a_disc():
    """tau = 2/3 friction m g R of a disc that spins on the spot."""
    R, m, mu = 0.3, 2.0, 0.4
    world, state = dr.scene(
        {"disc": dr.Body(dr.Disc(radius=R), mass=m, x=(0.0, 0.0), w=5.0)}, forces=[dr.GroundFriction(friction=mu)]
    )
    tau = world.forces[0](world.bodies, state, None).tau
    assert_allclose(tau, -2 / 3 * mu * m * 9.81 * R, rtol=4e-3)
    with pytest.raises(ValueError, match="groundfriction is a GroundFriction, for 2D: in 3D let bodies slide"):
        ball = dr.Body(dr.Sphere(radius=R), mass=m, x=(0.0, 0.0, 0.0))
        dr.scene({"ball": ball}, forces=[dr.GroundFriction(friction=mu)])


def test_spring_and_damper_oscillate():
    """Along x about the rest length: a damped harmonic oscillator, l - length = A exp(-gamma t) cos(omega t)."""
    m, k, c, length, t = 0.8, 30.0, 0.6, 1.0, 1.3
    gamma = c / (2 * m)
    omega = np.sqrt(k / m - gamma**2)
    body = dr.Body(None, mass=m, inertia=1.0, x=(1.4, 0.5), v=(-0.4 * gamma, 0.0))
    spring = dr.SpringDamper(a="body", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.5), stiffness=k, damping=c, length=length)
    scene = dr.scene({"body": body}, forces=[spring])
    x = length + 0.4 * np.exp(-gamma * t) * np.cos(omega * t)

    def error(steps):
        s = last(scene, t, steps)
        assert_allclose(s.x[0, 1], 0.5, atol=ROUNDING)
        return abs(float(s.x[0, 0]) - x)

    assert_fourth_order(error, 60, 1e-6)


def test_a_spring_may_begin_without_length():
    """From its anchor, at rest or not, r = v exp(-gamma t) sin(omega t) / omega in each direction, slopes too."""
    m, k, c, t = 1.0, 20.0, 1.0, 0.5
    gamma = c / (2 * m)
    omega = np.sqrt(k / m - gamma**2)

    def end(x, v):
        body = dr.Body(None, mass=m, inertia=1.0, x=x, v=v)
        spring = dr.SpringDamper(a="body", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=k, damping=c)
        return dr.rollout(*dr.scene({"body": body}, forces=[spring]), dt=1 / 240, steps=120).state.x[-1, 0]

    decay, sine = np.exp(-gamma * t), np.sin(omega * t) / omega
    values = jax.jit(jax.vmap(lambda v: (end(jnp.zeros(2), v), jax.jacfwd(end, (0, 1))(jnp.zeros(2), v))))
    v = jnp.array([[1.0, 0.0], [0.6, -0.8], [0.0, 0.0]])
    x, (by_x, by_v) = values(v)
    assert_allclose(x, decay * sine * v, atol=1e-8)
    assert_allclose(by_v[:2], np.broadcast_to(decay * sine * np.eye(2), (2, 2, 2)), atol=1e-4)
    by_place = decay * (np.cos(omega * t) + gamma * sine) * np.eye(2)
    assert_allclose(by_v[2], decay * sine * np.eye(2), atol=1e-8)
    assert_allclose(by_x[2], by_place, atol=1e-8)
    assert_allclose(jax.jit(jax.jacrev(end))(jnp.zeros(2), v[2]), by_place, atol=1e-8)


def test_spring_between_bodies_keeps_momentum():
    """Anchored off their centres, in space: forces opposite, torques about one point opposite."""
    rng = np.random.default_rng(0)
    bodies = {
        name: dr.Body(None, mass=m, inertia=np.array([0.2, 0.3, 0.4]), x=rng.normal(size=3), v=rng.normal(size=3), w=rng.normal(size=3))
        for name, m in (("a", 1.0), ("b", 2.5))
    }  # fmt: skip
    ends = dict(anchor_a=rng.normal(size=3) / 3, anchor_b=rng.normal(size=3) / 3)
    world, state = dr.scene(
        bodies, forces=[dr.SpringDamper(a="a", b="b", stiffness=20.0, damping=0.4, length=0.5, **ends)]
    )

    @jax.jit
    def drift(dt):
        states = dr.rollout(world, state, dt=dt, steps=40).state

        def sums(state):
            return dr.momentum(world.bodies, state).sum(0), dr.angular_momentum(world.bodies, state).sum(0)

        p, L = jax.vmap(sums)(states)
        return jnp.abs(p[-1] - p[0]).max(), jnp.abs(L[-1] - L[0]).max(), jnp.abs(states.v[-1] - states.v[0]).max()

    (p, L, pulled), (_, L_fine, _) = drift(0.01), drift(0.005)
    assert pulled > 0.5
    assert p < ROUNDING
    assert L < 1e-6 and L_fine < 0.08 * L  # fourth order over the same number of steps, half the time


def test_force_at_a_point_pushes_and_turns():
    """A constant force at a point of the body is a pendulum in the field of that force: I angle'' = -l F sin(angle)."""
    m, I, F, l, angle, t = 2.0, 0.3, 1.5, 0.4, 1.0, 1.5
    body = dr.Body(None, mass=m, inertia=I, x=(0.2, 0.1), v=(0.0, 0.3), angle=angle)
    scene = dr.scene({"body": body}, forces=[dr.Force(body="body", F=(F, 0.0), point=(l, 0.0))])
    y = numpy_motion(lambda y: np.array([y[1], -l * F / I * np.sin(y[0])]), (angle, 0.0), t)

    def error(steps):
        s = last(scene, t, steps)
        assert_allclose(s.x[0], [0.2 + F / m * t * t / 2, 0.1 + 0.3 * t], atol=ROUNDING)  # the force does not turn
        return abs(float(jnp.arctan2(s.q[0, 1], s.q[0, 0])) - y[0])

    assert_fourth_order(error, 60, 1e-8)


def test_torque_in_space_turns_about_its_axis():
    """About a principal axis, in world axes: exact."""
    body = dr.Body(None, mass=1.0, inertia=(0.2, 0.3, 0.4), x=jnp.zeros(3), w=(0.0, 0.0, 1.0))
    scene = dr.scene({"body": body}, forces=[dr.Torque(body="body", tau=(0.0, 0.0, 0.6))])
    s, t = last(scene, 1.0, 40), 1.0
    angle = 1.0 * t + 0.6 / 0.4 * t * t / 2
    assert_allclose(s.w[0], [0.0, 0.0, 1.0 + 0.6 / 0.4 * t], atol=EXACT)
    assert_allclose(s.q[0], vector(np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)), atol=EXACT)
