"""Motions known in closed form, impact times explicit, and the scenes that should follow them.

A motion is a function of its parameters, so its exact gradient, with the motion of the impact time in it, is
`jax.jacfwd` of it. Scenes of one kind share one compiled function: every number in them is a leaf.
2D: x right, y up, gravity (0, -g). A plane has the normal (sin tilt, cos tilt): downhill is +x.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import diffrigid as dr

BLOCK = 6  # steps of one rollout; `final` chains as many as it needs, so that one compilation serves all times


class Case(NamedTuple):
    scene: Callable  # of the parameters, to (world, state)
    motion: Callable  # of the time and the parameters, to State
    t: float  # [s] away from any impact
    parameters: dict[str, float]


def numpy_motion(rates, start, t, steps=4000):
    """y(t) of y' = rates(y) by the classical Runge-Kutta rule in small steps, to about 1e-12."""
    y, h = np.asarray(start, float), t / steps
    for _ in range(steps):
        k1 = rates(y)
        k2 = rates(y + h / 2 * k1)
        k3 = rates(y + h / 2 * k2)
        k4 = rates(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y


def vector(*components):
    return jnp.stack([jnp.asarray(c, float) for c in components])


def units(tree):
    """For each number of a tree of arrays the tree that is 1 there, and 0 elsewhere."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([leaf.size for leaf in leaves])
    for row in np.eye(ends[-1]):
        parts = zip(np.split(row, ends[:-1]), leaves, strict=True)
        yield structure.unflatten([part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in parts])


def with_slopes(fn, derivative=jax.jacfwd):
    """A program of `fn` and its slopes by all arguments.

    In forward mode it has one column of them and is run for each, which compiles sooner than all columns at once.
    """

    def both(*args):
        slopes, value = derivative(lambda *args: (fn(*args),) * 2, tuple(range(len(args))), has_aux=True)(*args)
        return value, slopes

    along = jax.jit(lambda args, way: jax.jvp(fn, args, way))

    def column_by_column(*args):
        args = jax.tree.map(jnp.asarray, args)
        runs = [along(args, unit) for unit in units(args)]
        leaves, structure = jax.tree.flatten(args)
        ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

        def by_argument(*columns):
            parts = np.split(np.stack(columns, -1), ends, -1)
            shaped = (part.reshape(part.shape[:-1] + leaf.shape) for part, leaf in zip(parts, leaves, strict=True))
            return structure.unflatten(shaped)

        return runs[0][0], jax.tree.map(by_argument, *(columns for _, columns in runs))

    return column_by_column if derivative is jax.jacfwd else jax.jit(both)


def floats(parameters):
    return {name: jnp.asarray(value, float) for name, value in parameters.items()}


# ---- the simulator, compiled once for each kind of scene


@jax.jit
def several_steps(world, state, tangents, dt):
    """State after BLOCK steps, and its derivative along one direction."""

    def end(world, state):
        return jax.tree.map(lambda rows: rows[-1], dr.rollout(world, state, dt=dt, steps=BLOCK).state)

    return jax.jvp(end, (world, state), tangents)


def flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def final(world, state, dt, blocks, ways=None):
    """State after `blocks` rollouts in a row, flat, and its Jacobian.

    Args:
        ways: (leaves, K) directions, of all float leaves of (world, state), flat; None: along each leaf by itself.
    """
    pair, (leaves, unravel) = (world, state), ravel_pytree((world, state))
    columns = []
    for way in units(pair) if ways is None else map(unravel, ways.T.astype(leaves.dtype)):
        state, (by_world, by_state) = pair[1], way
        for _ in range(blocks):
            state, by_state = several_steps(world, state, (by_world, by_state), dt)
        columns.append(flat(by_state))
    return flat(state), np.stack(columns, 1)


@partial(jax.jit, static_argnames="steps")
def pulled_back(world, state, dt, steps, weights):
    """Gradient of weights . (flat state after one rollout) by all float leaves, flat, in reverse mode."""

    def score(leaves):
        states = dr.rollout(*unravel(leaves), dt=dt, steps=steps).state
        return weights @ ravel_pytree(jax.tree.map(lambda rows: rows[-1], states))[0]

    leaves, unravel = ravel_pytree((world, state))
    return jax.grad(score)(leaves)


def steps_near(t, rate):
    """Number of blocks, and step [s], that reach t with about `rate` steps a second."""
    blocks = max(round(t * rate / BLOCK), 1)
    return blocks, jnp.asarray(t / (blocks * BLOCK))


@partial(jax.jit, static_argnames="make")
def made(make, parameters):
    """World and state, traced: compiled once for each `make`, without the checks of values."""
    return make(**parameters)


def build(make, parameters):
    """World, state, and d(their float leaves) / d(parameters), in the order of `parameters`."""

    def leaves(parameters):
        pair = make(**parameters)
        return ravel_pytree(pair)[0], pair

    by_name, (world, state) = jax.jacfwd(leaves, has_aux=True)(floats(parameters))
    return world, state, jnp.stack([by_name[name] for name in parameters], axis=1)


def simulated(make, parameters, t, rate):
    """Flat state at t and its Jacobian by the parameters, (outputs, parameters)."""
    world, state, by_parameter = build(make, parameters)
    blocks, dt = steps_near(t, rate)
    return final(world, state, dt, blocks, by_parameter)


def exact(case):
    """Flat state of the closed form and its Jacobian by the parameters."""

    def end(parameters):
        state = ravel_pytree(case.motion(case.t, **parameters))[0]
        return state, state

    by_name, state = jax.jacfwd(end, has_aux=True)(floats(case.parameters))
    return state, jnp.stack([by_name[name] for name in case.parameters], axis=1)


# ---- one disc and one plane


def disc_and_plane(e=0.0, mu=0.0, m=1.0, inertia=0.005, r=0.1, x=0.0, y=0.0, vx=0.0, vy=0.0, w=0.0, tilt=0.0, g=0.0):
    disc = dr.Body(dr.Disc(radius=r), mass=m, inertia=inertia, x=vector(x, y), v=vector(vx, vy), w=w)
    plane = dr.Static(dr.HalfSpace(normal=vector(jnp.sin(tilt), jnp.cos(tilt))))
    return dr.scene({"disc": disc, "plane": plane}, gravity=vector(0.0, -g), restitution=e, friction=mu)


def one_body(x, angle, v, w):
    return dr.State(x=x[None], q=vector(jnp.cos(angle), jnp.sin(angle))[None], v=v[None], w=vector(w)[None])


def fall(height, up, g):
    """Speed at the end of a fall through `height`, started upwards with `up`, and its duration."""
    speed = jnp.sqrt(up * up + 2.0 * g * height)
    return speed, (up + speed) / g


def projectile(t, x, y, vx, vy, w, g):
    return one_body(vector(x + vx * t, y + vy * t - g * t * t / 2), w * t, vector(vx, vy - g * t), w)


def bouncing(bounces):
    def motion(t, e, y, vy, g, r):
        speed, first = fall(y - r, vy, g)
        last = first + 2.0 * speed / g * sum(e**k for k in range(1, bounces))
        up, since = e**bounces * speed, t - last
        return one_body(vector(0.0, r + up * since - g * since**2 / 2), 0.0, vector(0.0, up - g * since), 0.0)

    return motion


def off_wall(t, e, x, y, vx, vy, tilt, r):
    n, x, v = vector(jnp.sin(tilt), jnp.cos(tilt)), vector(x, y), vector(vx, vy)
    hit = (r - n @ x) / (n @ v)
    after = v - (1.0 + e) * (n @ v) * n
    return one_body(x + v * hit + after * (t - hit), 0.0, after, 0.0)


def rubbing_bounce(t, e, mu, m, inertia, r, x, y, vx, vy, w, g):
    speed, hit = fall(y - r, vy, g)
    slip, P_n = vx + r * w, m * (1.0 + e) * speed
    P_t = -jnp.sign(slip) * jnp.minimum(mu * P_n, jnp.abs(slip) / (1.0 / m + r * r / inertia))
    v, spin, since = vx + P_t / m, w + r * P_t / inertia, t - hit
    here = vector(x + vx * hit + v * since, r + e * speed * since - g * since**2 / 2)
    return one_body(here, w * hit + spin * since, vector(v, e * speed - g * since), spin)


# ---- two round bodies, in two or three dimensions


def two_discs(e, mu, ma, mb, ra, rb, ia, ib, xa, ya, xb, yb, vxa, vya, vxb, vyb, wa, wb):
    a = dr.Body(dr.Disc(radius=ra), mass=ma, inertia=ia, x=vector(xa, ya), v=vector(vxa, vya), w=wa)
    b = dr.Body(dr.Disc(radius=rb), mass=mb, inertia=ib, x=vector(xb, yb), v=vector(vxb, vyb), w=wb)
    return dr.scene({"a": a, "b": b}, restitution=e, friction=mu)


def two_spheres(e, mu, ma, mb, ra, rb, ia, ib, xa, ya, za, xb, vxa, vya, vxb, vzb, wxa, wya, wza, wxb):
    w_a, w_b = vector(wxa, wya, wza), vector(wxb, 0.0, 0.0)
    a = dr.Body(dr.Sphere(radius=ra), mass=ma, inertia=ia, x=vector(xa, ya, za), v=vector(vxa, vya, 0.0), w=w_a)
    b = dr.Body(dr.Sphere(radius=rb), mass=mb, inertia=ib, x=vector(xb, 0.0, 0.0), v=vector(vxb, 0.0, vzb), w=w_b)
    return dr.scene({"a": a, "b": b}, restitution=e, friction=mu)


def cross(w, r):
    return w[0] * vector(-r[1], r[0]) if len(r) == 2 else jnp.cross(w, r)


def moment(r, F):
    return vector(r[0] * F[1] - r[1] * F[0]) if len(r) == 2 else jnp.cross(r, F)


def turned(*phis):
    """Orientation after turns by rotation vectors in world axes, in the order given."""
    if phis[0].shape == (1,):
        angle = sum(phis)[0]
        return vector(jnp.cos(angle), jnp.sin(angle))
    q = vector(1.0, 0.0, 0.0, 0.0)
    for phi in phis:
        angle = jnp.sqrt(phi @ phi)
        s, u = jnp.cos(angle / 2), jnp.sin(angle / 2) / angle * phi
        q = jnp.concatenate([vector(s * q[0] - u @ q[1:]), s * q[1:] + q[0] * u + jnp.cross(u, q[1:])])
    return q


def round_pair(e, mu, m, inertia, r, x, v, w, t):
    """Two round bodies in free flight that collide once; every argument but e, mu and t is a pair (a, b)."""
    apart, v_rel, R = x[0] - x[1], v[0] - v[1], r[0] + r[1]
    A, B, C = v_rel @ v_rel, apart @ v_rel, apart @ apart - R * R
    hit = (-B - jnp.sqrt(B * B - A * C)) / A
    n = (apart + v_rel * hit) / R
    speed = -n @ v_rel
    slip = v_rel + speed * n - cross(w[0], r[0] * n) - cross(w[1], r[1] * n)
    rate = jnp.sqrt(slip @ slip)
    give = 1.0 / m[0] + 1.0 / m[1]
    P_n = (1.0 + e) * speed / give
    P_t = jnp.minimum(mu * P_n, rate / (give + r[0] ** 2 / inertia[0] + r[1] ** 2 / inertia[1]))
    P = P_n * n - P_t * slip / rate
    dv = (P / m[0], -P / m[1])
    dw = tuple(moment(-r[i] * n, P) / inertia[i] for i in (0, 1))
    return dr.State(
        x=jnp.stack([x[i] + v[i] * t + dv[i] * (t - hit) for i in (0, 1)]),
        q=jnp.stack([turned(w[i] * hit, (w[i] + dw[i]) * (t - hit)) for i in (0, 1)]),
        v=jnp.stack([v[i] + dv[i] for i in (0, 1)]),
        w=jnp.stack([w[i] + dw[i] for i in (0, 1)]),
    )


def discs_collide(t, e, mu, ma, mb, ra, rb, ia, ib, xa, ya, xb, yb, vxa, vya, vxb, vyb, wa, wb):
    x, v = (vector(xa, ya), vector(xb, yb)), (vector(vxa, vya), vector(vxb, vyb))
    return round_pair(e, mu, (ma, mb), (ia, ib), (ra, rb), x, v, (vector(wa), vector(wb)), t)


def spheres_collide(t, e, mu, ma, mb, ra, rb, ia, ib, xa, ya, za, xb, vxa, vya, vxb, vzb, wxa, wya, wza, wxb):
    x, v = (vector(xa, ya, za), vector(xb, 0.0, 0.0)), (vector(vxa, vya, 0.0), vector(vxb, 0.0, vzb))
    w = (vector(wxa, wya, wza), vector(wxb, 0.0, 0.0))
    return round_pair(e, mu, (ma, mb), (ia, ib), (ra, rb), x, v, w, t)


# ---- one box and one plane


def box_and_plane(
    e=0.0, mu=0.0, m=1.0, inertia=0.1, half_x=0.3, half_y=0.05, x=0.0, y=0.0, vx=0.0, vy=0.0, angle=0.0, w=0.0, tilt=0.0, g=9.81
):  # fmt: skip
    half = vector(half_x, half_y)
    box = dr.Body(dr.Box(half=half), mass=m, inertia=inertia, x=vector(x, y), v=vector(vx, vy), angle=angle, w=w)
    plane = dr.Static(dr.HalfSpace(normal=vector(jnp.sin(tilt), jnp.cos(tilt))))
    return dr.scene({"box": box, "plane": plane}, gravity=vector(0.0, -g), restitution=e, friction=mu)


def rod(m, inertia, l, angle, y, vy, e, g):
    return box_and_plane(e=e, m=m, inertia=inertia, half_x=l, half_y=0.0, y=y, vy=vy, angle=angle, g=g)


def rod_strikes(t, m, inertia, l, angle, y, vy, e, g):
    """Half length l, no spin; the lower end, at -l (cos, sin), hits y = 0."""
    arm = l * jnp.cos(angle)
    speed, hit = fall(y - l * jnp.sin(angle), vy, g)
    P = (1.0 + e) * speed / (1.0 / m + arm * arm / inertia)
    up, w, since = P / m - speed, -arm * P / inertia, t - hit
    here = vector(0.0, l * jnp.sin(angle) + up * since - g * since**2 / 2)
    return one_body(here, angle + w * since, vector(0.0, up - g * since), w)


def block(mu, v, g, tilt, s, h, m):
    """A block of height 2 h that lies on the slope with its centre at the distance s along it."""
    n, along = vector(jnp.sin(tilt), jnp.cos(tilt)), vector(jnp.cos(tilt), -jnp.sin(tilt))
    (x, y), (vx, vy) = s * along + h * n, v * along
    inertia = m * (0.3**2 + h * h) / 3
    return box_and_plane(mu=mu, m=m, inertia=inertia, half_y=h, x=x, y=y, vx=vx, vy=vy, angle=-tilt, tilt=tilt, g=g)


def block_slides(t, mu, v, g, tilt, s, h, m):
    n, along = vector(jnp.sin(tilt), jnp.cos(tilt)), vector(jnp.cos(tilt), -jnp.sin(tilt))
    slowing = g * (mu * jnp.cos(tilt) - jnp.sin(tilt))
    duration = jnp.minimum(t, v / slowing)
    here = (s + v * duration - slowing * duration**2 / 2) * along + h * n
    return one_body(here, -tilt, (v - slowing * duration) * along, 0.0 * m)


# ---- two boxes, without gravity


def two_boxes(e, mu, xa, ya, xb, yb, vxa, vya, vxb, vyb, angle_a, angle_b, wa, wb, half_x=0.3, half_y=0.2):
    half = vector(half_x, half_y)
    a = dr.Body(dr.Box(half=half), mass=1.0, inertia=0.05, x=vector(xa, ya), v=vector(vxa, vya), angle=angle_a, w=wa)
    b = dr.Body(dr.Box(half=half), mass=1.5, inertia=0.07, x=vector(xb, yb), v=vector(vxb, vyb), angle=angle_b, w=wb)
    return dr.scene({"a": a, "b": b}, restitution=e, friction=mu)


# ---- three balls in a row, and a top


def cradle(e, v, r, ma, mb, mc, gap_ab, gap_bc):
    x = (0.0, 2 * r + gap_ab, 4 * r + gap_ab + gap_bc)
    balls = {
        name: dr.Body(dr.Disc(radius=r), mass=m, inertia=0.5 * m * r * r, x=vector(here, 0.0), v=vector(go, 0.0))
        for name, m, here, go in zip("abc", (ma, mb, mc), x, (v, 0.0, 0.0), strict=True)
    }
    return dr.scene(balls, restitution=e)


def cradle_passes(t, e, v, r, ma, mb, mc, gap_ab, gap_bc):
    """a hits b, then b hits c; a ball that is hit was at rest."""

    def hit(v, m, m_next):
        return v * (m - e * m_next) / (m + m_next), v * (1.0 + e) * m / (m + m_next)

    t_ab = gap_ab / v
    v_a, v_b = hit(v, ma, mb)
    t_bc = t_ab + gap_bc / v_b
    v_b_end, v_c = hit(v_b, mb, mc)
    x_a, x_b = gap_ab + v_a * (t - t_ab), 2 * r + gap_ab + gap_bc + v_b_end * (t - t_bc)
    x_c = 4 * r + gap_ab + gap_bc + v_c * (t - t_bc)

    def row(*values):
        return jnp.stack([vector(value, 0.0) for value in values])

    return dr.State(x=row(x_a, x_b, x_c), q=row(1.0, 1.0, 1.0), v=row(v_a, v_b_end, v_c), w=jnp.zeros((3, 1)))


def top(across, along, wx, wz):
    """Body without geometry; principal inertia `along` its axis z, `across` it; axis and world z coincide at first."""
    body = dr.Body(None, mass=1.0, inertia=vector(across, across, along), x=jnp.zeros(3), w=vector(wx, 0.0, wz))
    return dr.scene({"top": body})


def top_precesses(t, across, along, wx, wz):
    """Precession about L at |L| / across, after a turn about the own axis at (1 - along / across) wz."""
    L = vector(across * wx, 0.0, along * wz)
    precession = L / across
    q = turned(vector(0.0, 0.0, (1.0 - along / across) * wz * t), precession * t)
    # w = L / across + (1 - along / across) wz axis: the axis precesses, its share does not change.
    s, u = q[0], q[1:]
    z = vector(0.0, 0.0, 1.0)
    axis = z + 2.0 * s * jnp.cross(u, z) + 2.0 * jnp.cross(u, jnp.cross(u, z))
    w = precession + (1.0 - along / across) * wz * axis
    zero = jnp.zeros((1, 3))
    return dr.State(x=zero, q=q[None], v=zero, w=w[None])


BALL = dict(e=0.8, y=0.3, vy=0.3, g=9.81, r=0.1)
RUB = dict(e=0.7, mu=0.15, m=0.8, inertia=0.0032, r=0.1, x=0.0, y=0.7, vx=3.0, vy=0.0, w=1.0, g=9.81)
PAIR = dict(e=0.8, mu=0.0, ma=1.0, mb=1.6, ra=0.12, rb=0.18, ia=0.007, ib=0.026)
PLANAR = dict(xa=0.0, ya=0.0, xb=1.0, yb=0.15, vxa=2.0, vya=0.1, vxb=-0.3, vyb=0.05, wa=3.0, wb=-2.0)
SPATIAL = dict(
    xa=0.0, ya=0.1, za=-0.08, xb=1.0, vxa=2.0, vya=0.1, vxb=-0.3, vzb=0.05, wxa=1.0, wya=-2.0, wza=3.0, wxb=1.5
)
BLOCK_ON_SLOPE = dict(mu=0.4, v=2.0, g=9.81, tilt=0.2, s=0.1, h=0.05, m=1.5)
CASES = {
    "projectile": Case(disc_and_plane, projectile, 0.8, dict(x=0.2, y=1.0, vx=3.0, vy=4.0, w=2.0, g=9.81)),
    "one bounce": Case(disc_and_plane, bouncing(1), 0.4, BALL),
    "three bounces": Case(disc_and_plane, bouncing(3), 1.0, BALL),
    "oblique wall": Case(disc_and_plane, off_wall, 0.8, dict(e=0.7, x=-0.4, y=1.0, vx=1.5, vy=-2.0, tilt=0.3, r=0.2)),
    "bounce that slides": Case(disc_and_plane, rubbing_bounce, 0.65, RUB),
    "bounce that sticks": Case(disc_and_plane, rubbing_bounce, 0.65, RUB | dict(mu=0.6, vx=0.8)),
    "smooth discs": Case(two_discs, discs_collide, 1.0, PAIR | PLANAR),
    "discs that slide": Case(two_discs, discs_collide, 1.0, PAIR | PLANAR | dict(mu=0.1)),
    "discs that stick": Case(two_discs, discs_collide, 1.0, PAIR | PLANAR | dict(mu=0.9)),
    "spheres that slide": Case(two_spheres, spheres_collide, 1.0, PAIR | SPATIAL | dict(mu=0.1)),
    "spheres that stick": Case(two_spheres, spheres_collide, 1.0, PAIR | SPATIAL | dict(mu=0.9)),
    "rod strikes": Case(
        rod, rod_strikes, 0.44, dict(m=1.3, inertia=0.2, l=0.35, angle=0.6, y=0.9, vy=-0.4, e=0.5, g=9.81)
    ),
    "block slides": Case(block, block_slides, 0.4, BLOCK_ON_SLOPE),
    "cradle": Case(
        cradle, cradle_passes, 0.6, dict(e=0.9, v=1.0, r=0.1, ma=1.0, mb=0.8, mc=0.5, gap_ab=0.1, gap_bc=0.15)
    ),
    "top": Case(top, top_precesses, 2.0, dict(across=0.8, along=1.3, wx=1.5, wz=3.0)),
}
