"""The free motion of bodies within a step, as functions of the time s since its start.

A `Flight` anchors every body at its own time t0, the start of the step or its latest impact, and says where it
goes from there:

    x(s) = x + v (s - t0) + a (s - t0)^2 / 2                       exact under a constant force
    v(s) = v + a (s - t0) + jolt (s - t0)^2 / 2                    jolt: (a at the end - a at the anchor) / T
    L(s) = L + tau (s - t0) + twist (s - t0)^2 / 2                 world axes; L is kept, not w (3D: w wanders)
    q(s) = q o exp(sum_k turn[k] (s - t0)^(k+1))                   exponential map; see turn_series

With forces that vary this is the velocity Verlet rule (Swope et al. 1982), second order and, where forces
depend on position alone, symplectic.
"""

from typing import Any

import jax
from jax import Array

from diffrigid.forces import is_constant, total_wrench
from diffrigid.numerics import safe_divide
from diffrigid.pytree import array, pytree, replace, static
from diffrigid.state import Bodies, State, rotations, spin


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
    jolt: Array | None = array("N", "D", default=None)  # [m/s^3]; None: constant forces
    twist: Array | None = array("N", "A", default=None)  # [N m/s]
    turn: Array = array("N", "K", "A")  # [rad/s, rad/s^2, ...]
    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Array = array(lambda f: ("N",) if f.dim == 2 else ("N", "D", "D"))
    dim: int = static()


def launch(forces: tuple, bodies: Bodies, state: State, controls: Any, t0: Array, t1: Array) -> Flight:
    """Free motion of all bodies from `state`, each at its own time t0 (N, *batch), to t1 (*batch) [s]."""
    so = rotations(bodies.dim)
    wrench = total_wrench(forces, bodies, state, controls)
    inverse = jax.vmap(so.inverse_inertia)(bodies.inertia)
    L = spin(bodies, state)
    turn = jax.vmap(so.turn_series)(inverse, state.q, L, wrench.tau)
    flight = Flight(
        t0=t0, x=state.x, q=state.q, v=state.v, L=L, a=wrench.F / bodies.mass[:, None],
        tau=wrench.tau, turn=turn, inverse_mass=1.0 / bodies.mass, inverse_inertia=inverse, dim=bodies.dim,
    )  # fmt: skip
    if is_constant(forces):
        return flight
    end = total_wrench(forces, bodies, state_at(flight, t1), controls)
    duration = (t1[None] - t0)[:, None]
    jolt = safe_divide(end.F - wrench.F, duration) / bodies.mass[:, None]
    turned = wrench.tau is not None and end.tau is not None
    twist = safe_divide(end.tau - wrench.tau, duration) if turned else None  # type: ignore[operator]
    return replace(flight, jolt=jolt, twist=twist)


def position(f: Flight, s: Array) -> Array:
    """Centre of mass of one body at time s, (D, *batch) [m]."""
    t = (s - f.t0)[None]
    return f.x + t * (f.v + 0.5 * t * f.a)


def orientation(f: Flight, s: Array) -> Array:
    """Orientation of one body at time s, (Q, *batch)."""
    so, t = rotations(f.dim), (s - f.t0)[None]
    phi = f.turn[-1]
    for k in range(f.turn.shape[0] - 2, -1, -1):
        phi = f.turn[k] + t * phi
    return so.compose(f.q, so.exp(t * phi))


def velocity(f: Flight, s: Array) -> Array:
    """Velocity of the centre of mass of one body at time s, (D, *batch) [m/s]."""
    t = (s - f.t0)[None]
    rate = f.a if f.jolt is None else f.a + 0.5 * t * f.jolt
    return f.v + t * rate


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
