"""Friction against rolling and spinning: one row ("rolling row") per contact, for its two bodies' relative rotation.

The torque on body a at a contact with the normal force N is at most rolling_friction N across the normal and, in
space, spinning_friction N about it, and it stops the turning w_a - w_b if it can; likewise impulses in an impact. Rows
follow their contacts in the list, one each, before those of joints. In the plane the torque is the first component.
Source: the documentation of MuJoCo, whose coefficients of spinning and rolling friction are these lengths.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.contact.cone import put, split, turning, without_turning
from diffrigid.contact.impulse import sticking_impulse
from diffrigid.contact.known import Known, beside, reversing
from diffrigid.contact.mobility import Mobility, moved
from diffrigid.contact.resting import Law, Strikes
from diffrigid.contact.slipping import STICKS, in_all, least_slip, lost_to_stops, reversal, stopping_early
from diffrigid.contact.strikes import coefficients, contact_count
from diffrigid.contact.sums import at_colliders
from diffrigid.flight import Flight, angular_momentum
from diffrigid.numerics import dot, norm, normalise, safe_divide, unit_vector
from diffrigid.pytree import replace
from diffrigid.state import rotations

if TYPE_CHECKING:
    from diffrigid.world import World


def with_rows(
    world: "World", strikes: Strikes, law: Law, T: Array, flight: Flight, t: Array, mobility: Mobility, kick: Array
) -> tuple[Strikes, Law, Array]:
    """Add the rolling rows to the strikes, law and times T of `solve_impulses`.

    Args:
        T: (C, *batch) [s] time over which the impulse of a resting contact has acted, else 0.
        t: (N, *batch) [s] of each body, at which `mobility` is.
        kick: 0 where gaps are closed (PUSH), which turns nothing; else 1.
    """
    so, count, batch, flat = rotations(world.dim), contact_count(world), t.shape[1:], world.dim == 2
    zero = jnp.zeros((count, *batch), t.dtype)
    roll, spin = (kick * _of_contacts(world, f"{name}_friction", zero)[:count] for name in ("rolling", "spinning"))
    roll, spin = (zero, roll) if flat else (roll, spin)
    a, b, own = strikes.a[:count], strikes.b[:count], strikes.wholes[:count]

    def turns(values: Array) -> Array:  # values of the bodies, (N, A, *batch), to those of a minus b as vectors
        change = at_colliders(values, a, 0.0) - at_colliders(values, b, 0.0)
        return jnp.pad(change, [(0, 0), (0, so.D - so.A), *[(0, 0)] * len(batch)])

    L = jax.vmap(angular_momentum)(flight, t)
    w = jax.vmap(so.apply)(mobility.inverse_inertia, L)
    tau = jax.vmap(so.precession)(L, w) + (0.0 if flight.tau is None else flight.tau)
    pull = jax.vmap(so.apply)(mobility.inverse_inertia, tau)
    along = jax.vmap(lambda n: unit_vector(n, 0) if flat else n)(strikes.normal[:count])
    none = jnp.zeros_like(along)
    mid, turn = None if strikes.mid_a is None else none, None if strikes.turn is None else none[:, : so.A]
    rows = Strikes(
        active=strikes.active[:count], s=strikes.s[:count], gap=zero, rounding=zero, deepest=zero, normal=along,
        arm_a=none, arm_b=none, mid_a=mid, mid_b=mid, turn=turn, lean=None if strikes.lean is None else none,
        K=_mobility_of_turns(mobility, a, b, so),
        v_rel=kick * turns(w), press=zero, pull=turns(pull), drift=none, rests=strikes.rests[:count],
        now=strikes.now[:count], held=strikes.held[:count],
    )  # fmt: skip
    strikes = replace(
        jax.tree.map(partial(_behind, count), _arrays(strikes), rows),
        a=a + a + strikes.a[count:], b=b + b + strikes.b[count:], jac=strikes.jac, mid_jac=strikes.mid_jac, spin=spin,
        wholes=own + tuple(("turn", *label) for label in own) + strikes.wholes[count:],
    )  # fmt: skip
    target, mu, most = law
    mu = jnp.broadcast_to(mu, target.shape)
    most = None if most is None else _behind(count, most, jnp.full_like(zero, jnp.inf))
    law = Law(_behind(count, target, zero), _behind(count, mu, roll), most)
    return strikes, law, _behind(count, T, T[:count])


def _of_contacts(world: "World", name: str, zero: Array) -> Array:
    """Coefficient `name` of all contacts, zero if the world does not have it."""
    if getattr(world.bodies, name) is None:
        return zero
    return coefficients(world, name, zero.shape[1:])


def _behind(count: int, values: Array, rows: Array) -> Array:
    return jnp.concatenate([values[:count], rows, values[count:]])


def _mobility_of_turns(mobility: Mobility, a: tuple[int, ...], b: tuple[int, ...], so: Any) -> Array:
    """Change of w_a - w_b per torque impulse, (K, D, D, *batch) [1/(kg m^2)]."""
    inverse = at_colliders(mobility.inverse_inertia, a, 0.0) + at_colliders(mobility.inverse_inertia, b, 0.0)
    if so.D == 3:
        return inverse
    return jnp.pad(inverse[:, None, None], [(0, 0), (0, 1), (0, 1), *[(0, 0)] * (inverse.ndim - 1)])


def rolling_stops(mobility: Mobility, strikes: Strikes, P: Array, law: Law, T: Array, rest_speed: Array) -> Array:
    """`stopping_early`, extended to rolling and spinning that stop early, (C, D, *batch) [N s^2].

    Where a contact sticks, the torque of its row comes with an impulse that keeps the contact from slipping. Both have
    the same centroid in time. Exact for one contact of two bodies.
    """
    spin, torque = strikes.spin, turning(strikes.spin, P)
    sticks = _sticks(strikes, P, law.mu)
    pair = rows_of(strikes)
    start, at_end = _turns(mobility, strikes, sticks, P, T)
    lost = jnp.zeros_like(torque)
    for part, bound in _parts(strikes, P, law.mu):
        slip, end, acting = (part(pair.normal, r) for r in (start, at_end, torque))
        of_all = in_all(pair, pair.active, bound)
        lost = lost + lost_to_stops(pair, turning(spin, T), slip, end, acting, bound, of_all, rest_speed)
    return _with_reaction(mobility, strikes, sticks, lost) + _of_slips(mobility, strikes, P, law, T, rest_speed)


def rolling_reversing(
    mobility: Mobility, strikes: Strikes, P: Array, changes: tuple[Array, Array], law: Law, T: Array, rest_speed: Array
) -> Known:
    """`reversing`, extended to rolling that stops and turns back within T, as that of a ball up a slope.

    Spinning about the normal is left out: no force at a contact turns it back. Exact for one contact of two bodies.
    """
    free, others, by_torques = _contacts_alone(mobility, strikes, P, T)
    slips = reversing(mobility, free, others(P), changes, others(law), others(T), rest_speed, by_torques)
    sticks, pair, of_rows = _sticks(strikes, P, law.mu), rows_of(strikes), turning(strikes.spin, T)
    part, bound = _parts(strikes, P, law.mu)[-1]
    slip, at_end = (part(pair.normal, turn) for turn in _turns(mobility, strikes, sticks, P, T))
    back = jax.vmap(normalise)(at_end - slip)
    stops = pair.active & pair.held & (of_rows > 0) & (-jax.vmap(dot)(slip, back) > least_slip(rest_speed)[None])
    full = jnp.where(stops[:, None], -bound[:, None] * back, 0.0)
    braked = moved(_with_reaction(mobility, strikes, sticks, full), strikes, mobility)
    drag = -jax.vmap(dot)(turning(strikes.spin, braked), back)
    torque, early, turns = reversal(slip, at_end, bound, drag, stops, of_rows)
    between = partial(_behind, len(torque))
    return Known(
        P=between(slips.P, torque),
        early=between(slips.early, jnp.zeros_like(torque)) + _with_reaction(mobility, strikes, sticks, early),
        rubs=between(slips.rubs, turns.astype(T.dtype)),
    )


def beside_rolling(mobility: Mobility, strikes: Strikes, law: Law, known: Known, T: Array) -> tuple[Strikes, Law]:
    """`beside`, where torques may be known: they pull evenly at what slips, and are not bounded by the load as well."""
    spin, bound = strikes.spin, strikes.spin
    by_torque = moved(put(spin, jnp.zeros_like(known.P), turning(spin, known.P)), strikes, mobility)
    if known.P.shape[1] == 2:
        bound = jnp.where(turning(spin, known.rubs) > 0, 0.0, spin)
    strikes, law = beside(mobility, strikes, law, known)
    pull = strikes.pull + safe_divide(by_torque, T[:, None])
    return replace(strikes, pull=pull, spin=bound), law


def _turns(mobility: Mobility, strikes: Strikes, sticks: Array, P: Array, T: Array) -> tuple[Array, Array]:
    """Turning w_a - w_b (K, D, *batch) [rad/s] at the beginning, and after T without the torques of the rows."""
    pair, torque = rows_of(strikes), turning(strikes.spin, P)
    rest = P - _with_reaction(mobility, strikes, sticks, torque)
    at_end = pair.v_rel + turning(strikes.spin, moved(rest, strikes, mobility))
    return pair.v_rel - turning(strikes.spin, T)[:, None] * pair.pull, at_end


def _parts(strikes: Strikes, P: Array, mu: Array) -> list[tuple[Callable, Array]]:
    """Spinning, and in space rolling: the part of a vector that it is, and the bounds (K, *batch) [N m s] against it.

    In the plane all turning is about what counts as the normal of a row.
    """
    load = jax.vmap(dot)(strikes.normal, P)[: len(strikes.spin)]
    parts = [(_about, strikes.spin * load), (_across, turning(strikes.spin, mu) * load)]
    return parts[: P.shape[1] - 1]


def rows_of(strikes: Strikes) -> Strikes:
    """The rolling rows alone."""
    spin, count = strikes.spin, len(strikes.spin)
    a, b, wholes = (of_all[:count] for of_all in (strikes.a, strikes.b, strikes.wholes))
    return replace(jax.tree.map(partial(turning, spin), _arrays(strikes)), a=a, b=b, wholes=wholes)


def _arrays(strikes: Strikes) -> Strikes:
    """Only what each contact and row has for itself."""
    return replace(strikes, a=(), b=(), wholes=(), jac=None, mid_jac=None, spin=None)


def _about(n: Array, r: Array) -> Array:
    return split(n, r)[0][:, None] * n


def _across(n: Array, r: Array) -> Array:
    return split(n, r)[1]


def _sticks(strikes: Strikes, P: Array, mu: Array) -> Array:
    """1 for contacts that stick, else 0; (K, *batch)."""
    P_n, P_t = (part[: len(strikes.spin)] for part in split(strikes.normal, P))
    return (jax.vmap(norm)(P_t) < STICKS * mu[: len(P_n)] * P_n).astype(P.dtype)


def _with_reaction(mobility: Mobility, strikes: Strikes, sticks: Array, torque: Array) -> Array:
    """Torques of the rows (K, D, *batch), with impulses that prevent slip at their contacts, (C, D, *batch) [N s]."""
    so, count = rotations(torque.shape[1]), len(torque)

    def dragged(side: tuple[int, ...], arm: Array) -> Array:  # velocity of the contact point by the torque
        inverse = at_colliders(mobility.inverse_inertia, side[:count], 0.0)
        return jax.vmap(lambda inverse, tau, arm: so.cross(so.apply(inverse, tau[: so.A]), arm))(inverse, torque, arm)

    slip = dragged(strikes.a, strikes.arm_a[:count]) + dragged(strikes.b, strikes.arm_b[:count])
    P = jax.vmap(sticking_impulse)(strikes.K[:count], strikes.normal[:count], slip)
    zero = jnp.zeros((len(strikes.a) - 2 * count, *P.shape[1:]), P.dtype)
    return jnp.concatenate([sticks[:, None] * P, torque, zero])


def _of_slips(mobility: Mobility, strikes: Strikes, P: Array, law: Law, T: Array, rest_speed: Array) -> Array:
    """`stopping_early` of contacts and rows of joints, with the torques of the rolling rows as an even pull."""
    spin, count = strikes.spin, len(strikes.spin)
    free, others, _ = _contacts_alone(mobility, strikes, P, T)
    early = stopping_early(mobility, free, others(P), others(law), others(T), rest_speed)
    return jnp.concatenate([early[:count], jnp.zeros_like(turning(spin, P)), early[count:]])


def _contacts_alone(mobility: Mobility, strikes: Strikes, P: Array, T: Array) -> tuple[Strikes, Callable, Array]:
    """Contacts and rows of joints, with the torques of rolling rows as an even pull; a map of values to theirs; what
    their v_rel gains by it."""
    spin, count = strikes.spin, len(strikes.spin)
    by_torque = moved(put(spin, jnp.zeros_like(P), turning(spin, P)), strikes, mobility)
    pull = strikes.pull + by_torque / jnp.where(T > 0, T, 1.0)[:, None]

    def others(values: Any) -> Any:
        return jax.tree.map(partial(without_turning, count), values)

    free = others(replace(_arrays(strikes), v_rel=strikes.v_rel + by_torque, pull=pull))
    a, b, wholes = (of_all[:count] + of_all[2 * count :] for of_all in (strikes.a, strikes.b, strikes.wholes))
    return replace(free, a=a, b=b, wholes=wholes, jac=strikes.jac, mid_jac=strikes.mid_jac), others, others(by_torque)
