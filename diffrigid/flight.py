"""The free motion of bodies within a step, as functions of the time s since its start.

A `Flight` anchors every body at its own time t0, the start of the step or its latest impact, and says where it
goes from there, with t = s - t0 and T its whole duration:

    x(s) = x + v t + a t^2 / 2 + jerk t^3 / 6        exact under a constant force
    v(s) = v + a t + jolt t^2 / 2
    L(s) = L + tau t + twist t^2 / 2                 world axes; L is kept, not w (3D: w wanders)
    q(s) = exp(carry t) o q o exp(sum_k turn[k] t^(k+1))    exponential map

A constant force has none of jerk, jolt and twist, and `free_turn` for the rotation, or `turn_series` with a torque.
Forces that vary, and those of joints, are integrated by the classical Runge-Kutta method, in the rotation vector for
the orientation (Munthe-Kaas 1998): fourth order. Then jerk, jolt, twist and turn are those of curves that end where
the integration ends.
"""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid import so3
from diffrigid.fence import at_hand
from diffrigid.forces import is_constant, total_wrench, within
from diffrigid.linkage import joint_wrench
from diffrigid.numerics import safe_divide
from diffrigid.pytree import array, pytree, replace, static
from diffrigid.state import State, Wrench, rotations, spin

if TYPE_CHECKING:
    from diffrigid.world import World


@pytree
class Flight:
    """Motion of N bodies through a step. Trailing batch axes as everywhere."""

    t0: Array = array("N")  # [s] anchor
    x: Array = array("N", "D")
    q: Array = array("N", "Q")
    v: Array = array("N", "D")
    L: Array = array("N", "A")
    a: Array = array("N", "D")  # [m/s^2] at the anchor
    tau: Array | None = array("N", "A", default=None)  # [N m] at the anchor; None: no torques in this world
    jerk: Array | None = array("N", "D", default=None)  # [m/s^3]; None: constant forces
    jolt: Array | None = array("N", "D", default=None)  # [m/s^3]
    twist: Array | None = array("N", "A", default=None)  # [N m/s]
    carry: Array | None = array("N", "A", default=None)  # [rad/s] world axes; None: 2D, or torques
    turn: Array = array("N", "K", "A")  # [rad/s, rad/s^2, ...] body axes; K terms of a series
    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Array = array(lambda f: ("N",) if f.dim == 2 else ("N", "D", "D"))
    dim: int = static()


@jax.jit  # so that it is traced once for all passes of a step
def launch(world: "World", state: State, controls: Any, t0: Array, t1: Array) -> Flight:
    """Free motion of all bodies from `state`, each at its own time t0 (N, *batch), to t1 (*batch) [s]."""
    bodies, varies = world.bodies, not is_constant(world.forces) or bool(world.joints)
    so = rotations(bodies.dim)
    inverse = jax.vmap(so.inverse_inertia)(bodies.inertia)
    L = spin(bodies, state)
    still = Wrench(F=jnp.zeros_like(state.v), tau=None)  # until the stages of Runge-Kutta
    wrench = still if varies else total_wrench(world.forces, bodies, state, controls)
    if wrench.tau is None:
        carry, turn = jax.vmap(so.free_turn)(inverse, state.q, L, t1[None] - t0)
    else:
        carry, turn = None, jax.vmap(so.turn_series)(inverse, state.q, L, wrench.tau)
    flight = Flight(
        t0=t0, x=state.x, q=state.q, v=state.v, L=L, a=wrench.F / bodies.mass[:, None], tau=wrench.tau,
        carry=carry, turn=turn, inverse_mass=1.0 / bodies.mass, inverse_inertia=inverse, dim=bodies.dim,
    )  # fmt: skip
    if not varies:
        return flight
    span = t1[None] - t0
    return at_hand(_along(flight, *_runge_kutta(world, flight, controls, span), span, has_torque(world)))


def _wrench(world: "World", state: State, controls: Any, span: Array) -> Wrench:
    """All forces on free bodies, and those of the joints, for an integration over span (*batch) [s]."""
    wrench = total_wrench(within(world.forces, span), world.bodies, state, controls)
    return joint_wrench(world.joints, world.statics, world.bodies, state, wrench, span) if world.joints else wrench


@pytree
class Motion:
    """Position, rotation vector since the anchor (body axes), velocity, angular momentum; or their rates."""

    x: Array = array("N", "D")
    phi: Array = array("N", "A")
    v: Array = array("N", "D")
    L: Array = array("N", "A")


def has_torque(world: "World") -> bool:
    """Whether joints or forces exert torques. Static."""
    return bool(world.joints) or any(getattr(force, "twists", True) for force in world.forces)


def _runge_kutta(world: "World", f: Flight, controls: Any, T: Array) -> tuple[Motion, Motion, Array, Array]:
    """Rates at the anchor, their mean over T (N, *batch) [s], the mean of the first three stages' accelerations
    (N, D, *batch) [m/s^2], which moves x by T^2 / 2, and the rate of phi at the end (N, A, *batch) [rad/s].

    The four stages are a loop, so that forces are compiled once.
    """
    so = rotations(f.dim)

    def placed(motion):
        q = jax.vmap(so.turn_in_body)(f.q, motion.phi)
        w = jax.vmap(so.unspin)(f.inverse_inertia, q, motion.L)
        return State(x=motion.x, q=q, v=motion.v, w=w)

    def turning(motion, state):
        return jax.vmap(lambda q, phi, w: so.turn_rate(phi, so.unrotate(q, w) if so.D == 3 else w))(
            state.q, motion.phi, state.w
        )

    def rates(motion):
        state = at_hand(placed(motion))
        wrench = _wrench(world, state, controls, T.max(0))
        tau = jnp.zeros_like(motion.L) if wrench.tau is None else wrench.tau
        return Motion(x=motion.v, phi=turning(motion, state), v=f.inverse_mass[:, None] * wrench.F, L=tau)

    def after(rate, share):
        return jax.tree.map(lambda y, k: y + share * T[:, None] * k, start, rate)

    def stage(rate, share):
        rate = rates(after(rate, share))
        return rate, rate

    start = Motion(x=f.x, phi=jnp.zeros_like(f.L), v=f.v, L=f.L)
    still = jax.tree.map(jnp.zeros_like, start)
    _, k = lax.scan(stage, still, jnp.array([0.0, 0.5, 0.5, 1.0], f.x.dtype))
    first = jax.tree.map(lambda k: k[0], k)
    mean = jax.tree.map(lambda k: (k[0] + 2.0 * (k[1] + k[2]) + k[3]) / 6.0, k)
    end = after(mean, 1.0)
    return first, mean, (k.v[0] + k.v[1] + k.v[2]) / 3.0, turning(end, placed(end))


def _along(f: Flight, first: Motion, mean: Motion, early: Array, last: Array, T: Array, has_torque: bool) -> Flight:
    """The flight along curves with these rates, as `_runge_kutta` returns them; straight where T is 0.

    From rates, not from positions, whose differences over a short time after an impact are smaller than their rounding.
    """
    T = T[:, None]
    f = replace(
        f, a=first.v, jerk=safe_divide(3.0 * (early - first.v), T), jolt=safe_divide(2.0 * (mean.v - first.v), T)
    )
    if not has_torque:  # then L is kept, and `free_turn` is better
        return f
    bend = safe_divide(3.0 * mean.phi - 2.0 * first.phi - last, T)
    turn = jnp.stack([first.phi, bend, safe_divide(first.phi + last - 2.0 * mean.phi, T**2)], axis=1)
    return replace(f, tau=first.L, twist=safe_divide(2.0 * (mean.L - first.L), T), carry=None, turn=turn)


@jax.jit
def position(f: Flight, s: Array) -> Array:
    """Centre of mass of one body at time s, (D, *batch) [m]."""
    t = (s - f.t0)[None]
    rate = f.a if f.jerk is None else f.a + t * f.jerk / 3.0
    return f.x + t * (f.v + 0.5 * t * rate)


def fall(f: Flight, s: Array) -> tuple[Array, Array]:
    """What forces alone have added at time s to the position [m] and the velocity [m/s] of one body, (D, *batch)."""
    t = (s - f.t0)[None]
    way = 0.5 * t * t * (f.a if f.jerk is None else f.a + t * f.jerk / 3.0)
    return way, t * (f.a if f.jolt is None else f.a + 0.5 * t * f.jolt)


@jax.jit
def orientation(f: Flight, s: Array) -> Array:
    """Orientation of one body at time s, (Q, *batch)."""
    so, t = rotations(f.dim), (s - f.t0)[None]
    phi = f.turn[-1]
    for k in range(f.turn.shape[0] - 2, -1, -1):
        phi = f.turn[k] + t * phi
    within = so.turn_in_body(f.q, t * phi)
    return within if f.carry is None else so3.carried(t * f.carry, within)


@jax.jit
def velocity(f: Flight, s: Array) -> Array:
    """Velocity of the centre of mass of one body at time s, (D, *batch) [m/s]."""
    t = (s - f.t0)[None]
    rate = f.a if f.jolt is None else f.a + 0.5 * t * f.jolt
    return f.v + t * rate


@jax.jit
def angular_momentum(f: Flight, s: Array) -> Array:
    """Angular momentum of one body about its centre of mass at time s, (A, *batch) [kg m^2/s]."""
    if f.tau is None:
        return f.L
    t = (s - f.t0)[None]
    rate = f.tau if f.twist is None else f.tau + 0.5 * t * f.twist
    return f.L + t * rate


def angular_velocity(f: Flight, q: Array, s: Array) -> Array:
    """Angular velocity of one body at time s, where its orientation is q, (A, *batch) [rad/s]."""
    return rotations(f.dim).unspin(f.inverse_inertia, q, angular_momentum(f, s))


def state_at(flight: Flight, s: Array) -> State:
    """State of all bodies at one time s (*batch) [s] of the step."""

    def one(f):
        q = orientation(f, s)
        return State(x=position(f, s), q=q, v=velocity(f, s), w=angular_velocity(f, q, s))

    return jax.vmap(one)(flight)
