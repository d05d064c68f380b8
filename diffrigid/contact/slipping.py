"""Displacements by resting contacts and friction within a step, beyond those of a force that acts evenly."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.contact.cone import put, split, turning
from diffrigid.contact.mobility import Mobility, momentum_changes, moved
from diffrigid.contact.resting import Law, Strikes
from diffrigid.contact.sums import alike, at_colliders
from diffrigid.gathers import constant, sum_rows
from diffrigid.numerics import dot, norm, normalise, safe_divide
from diffrigid.pytree import replace

STICKS = 1.0 - 1e-6  # [-] of the bound of friction: below it a contact sticks
CREEP = 1e-3, 1e3  # [-] of `rest_speed`, the second times sqrt(eps): slip slower than both counts as none


def keeping_spin(strikes: Strikes, drift: Array, P: Array, moving: int) -> Array:
    """Changes of L (N, A, *batch) that balance displacements P / m of two bodies that move relative to each other.

    The displacements change the angular momentum about the origin by P x (v_a - v_b); each body gives back half of it.
    """
    jac = None if strikes.jac is None else jnp.zeros_like(strikes.jac)
    if strikes.spin is not None:  # torques displace nothing
        P = put(strikes.spin, P, jnp.zeros_like(turning(strikes.spin, P)))
    return momentum_changes(replace(strikes, mid_a=drift, mid_b=-drift, jac=jac, mid_jac=jac), P, moving)[1]


def drift_after(strikes: Strikes, dv: Array) -> Array:
    """Half the velocity of a against b after changes dv of the bodies (N, D, *batch), 0 at a static; (C, D, *batch)."""
    both = constant(tuple(float(max(pair) < len(dv)) for pair in zip(strikes.a, strikes.b, strict=True)), str(dv.dtype))
    change = 0.5 * (at_colliders(dv, strikes.a, 0.0) - at_colliders(dv, strikes.b, 0.0))
    return strikes.drift + both.reshape(-1, *[1] * (dv.ndim - 1)) * change


def stopping_early(mobility: Mobility, strikes: Strikes, P: Array, law: Law, T: Array, rest_speed: Array) -> Array:
    """Displacement missed by spreading friction evenly over T where a slip stops earlier, (C, D, *batch) [N s^2].

    In fact friction brakes with its full bound until the slip stops at tau, and then only balances the pull. The
    braking part acts earlier, with its centroid at tau / 2 instead of T / 2, so it moves the contact further, by
    (T - tau) / 2 times its change of velocity. Exact for one direction of slip under a constant pull.
    """
    strikes, _ = pulled(mobility, strikes, P, law.most, T)
    (part, bounds), most = rubbing(strikes, P, law), law.most
    at_end, slip = slips(part, strikes, law.target, T)
    most_to_stop = most_resisting(mobility, strikes) * jax.vmap(norm)(at_end)
    if most is not None:
        most_to_stop = jnp.where(jnp.isfinite(most), bounds, most_to_stop)
    return lost_to_stops(strikes, T, slip, at_end, part(P), bounds, most_to_stop, rest_speed)


def rubbing(strikes: Strikes, P: Array, law: Law) -> tuple[Callable, Array]:
    """Map to the part of a vector (C, D, *batch) along which friction acts, and its bounds (C, *batch) [N s].

    In rows of joint friction that is the whole vector, which lies along the joint's coordinate.
    """
    n, (_, mu, most) = strikes.normal, law
    bounds = mu * jax.vmap(dot)(n, P)

    def across(r: Array) -> Array:
        return split(n, r)[1]

    if most is None:
        return across, bounds
    of_joint = jnp.isfinite(most)
    return lambda r: jnp.where(of_joint[:, None], r, across(r)), jnp.where(of_joint, most, bounds)


def pulled(mobility: Mobility, strikes: Strikes, P: Array, most: Array | None, T: Array) -> tuple[Strikes, Array]:
    """Strikes with the pull by rows of joints that push with all they have, and what v_rel gains by it.

    A motor or joint friction that does not hold its speed acts as a constant force, on all but itself.
    """
    if most is None:
        return strikes, jnp.zeros_like(P)
    limited = jnp.isfinite(most)
    pushes = limited & (jax.vmap(norm)(P) >= STICKS * jnp.where(limited, most, 0.0))
    pushing = jnp.where(pushes[:, None], P, 0.0)
    by = moved(pushing, strikes, mobility)
    own = by if len(strikes.jac) == 1 else _by_themselves(pushing, strikes, mobility)
    by = by - jnp.where(limited[:, None], own, 0.0)
    pull = strikes.pull + by / jnp.where(T > 0, T, 1.0)[:, None]
    return replace(strikes, v_rel=strikes.v_rel + by, pull=pull), by


def _by_themselves(P: Array, strikes: Strikes, mobility: Mobility) -> Array:
    """What the slip of each row of a joint gains by its own impulse, (C, D, *batch) [m/s]; 0 for contacts."""
    alone = np.eye(len(P))[-len(strikes.jac) :].reshape(-1, *P.shape[:1], *[1] * (P.ndim - 1))
    each = jax.vmap(lambda one: one * moved(one * P, strikes, mobility))(alone.astype(P.dtype))
    return each.sum(0)


def slips(part: Callable, strikes: Strikes, target: Array, T: Array) -> tuple[Array, Array]:
    """Slip after T without impulses, and at the beginning, (C, D, *batch) [m/s]."""
    at_end = part(strikes.v_rel - target[:, None] * strikes.normal)
    return at_end, at_end - T[:, None] * part(strikes.pull)


def most_resisting(mobility: Mobility, strikes: Strikes) -> Array:
    """Largest mass that can resist a slip of each contact, (C, *batch) [kg]: the reduced mass; with joints, of all."""
    if mobility.matrix is not None:
        return jnp.broadcast_to((1.0 / mobility.inverse_mass).sum(0)[None], strikes.s.shape)
    a, b = (at_colliders(mobility.inverse_mass, side, 0.0) for side in (strikes.a, strikes.b))
    return 1.0 / (a + b)


def least_slip(rest_speed: Array) -> Array:
    """Speed (*batch) [m/s] below which a contact does not slip, where `rest_speed` is slow."""
    least, rounding = CREEP
    return rest_speed * max(least, rounding * float(jnp.finfo(rest_speed.dtype).eps) ** 0.5)


def reversal(
    slip: Array, at_end: Array, bounds: Array, drag: Array, stops: Array, T: Array
) -> tuple[Array, Array, Array]:
    """Friction where a slip stops and turns back within T: impulses, what they move in addition, and where.

    Until the stop, at a share of T, friction acts one way with its full bound, from then on the other way, evenly: the
    sum is (1 - 2 share) of the second, and moves the contact less, by share (1 - share) T of it. Exact for one
    direction of slip under a constant pull.

    Args:
        slip, at_end: (C, D, *batch) at the beginning, and at the end without friction.
        bounds: (C, *batch) of friction.
        drag: (C, *batch) change of the slip by the full bound.
        stops: (C, *batch) bool: where the slip may stop.
        T: (C, *batch) [s]

    Returns:
        (C, D, *batch) of friction; (C, D, *batch) of friction times [s]; (C, *batch) bool.
    """
    pull, back = jax.vmap(norm)(at_end - slip), jax.vmap(normalise)(at_end - slip)
    against = -jax.vmap(dot)(slip, back)
    turns = stops & (drag > 0) & (pull > drag) & (against < pull + drag)
    share = safe_divide(against, jnp.where(turns, pull + drag, 0.0))[:, None]
    after = jnp.where(turns[:, None], -bounds[:, None] * back, 0.0)
    return (1.0 - 2.0 * share) * after, -share * (1.0 - share) * T[:, None] * after, turns


def in_all(strikes: Any, slipping: Array, values: Array) -> Array:
    """Sums (C, *batch) over the `slipping` contacts between the same two rigid clusters, which slip as one."""
    return sum_rows(jnp.where(slipping, values, 0.0), alike(strikes.wholes))


def lost_to_stops(
    strikes: Any, T: Array, slip: Array, at_end: Array, friction: Array, bounds: Array, most_to_stop: Array,
    rest_speed: Array,
) -> Array:  # fmt: skip
    """Displacement missed by impulses `friction` (C, D, *batch) within `bounds` (C, *batch); see `stopping_early`.

    Args:
        slip, at_end: (C, D, *batch) [m/s] at the beginning, and at the end without friction.
        most_to_stop: (C, *batch) [N s] largest friction that can have stopped the slip. The rest resists what does not
            slip, as at a corner about which a body turns.
    """
    speed, at_end_speed = (jax.vmap(norm)(r) for r in (slip, at_end))
    slipping = speed > least_slip(rest_speed)[None]
    # Friction against the slip of two clusters, by its power, which is unique where its division among contacts is not.
    power, bound = (in_all(strikes, slipping, each) for each in (-jax.vmap(dot)(friction, at_end), bounds))
    most_power = in_all(strikes, slipping, bounds * at_end_speed)
    along = jax.vmap(dot)(at_end, slip / jnp.where(speed > 0, speed, 1.0)[:, None])
    least = float(jnp.finfo(T.dtype).tiny) ** 0.5  # the derivative of a quotient divides by the square of this
    total = bound * safe_divide(power, jnp.where(most_power > least, most_power, 0.0))
    size, sense = jnp.minimum(jnp.abs(total), most_to_stop), jnp.where(total < 0, -1.0, 1.0).astype(total.dtype)
    own = sense * size * safe_divide(bounds, jnp.where(bound > least, bound, 0.0))
    whole = at_end_speed * bound + size * (speed - along)
    stops = strikes.active & slipping & (jnp.abs(total) < STICKS * bound) & (T > 0)
    stops = stops & (at_end_speed > least) & (whole > least)
    share = safe_divide(speed * size, jnp.where(stops, whole, 0.0))  # tau / T
    per_speed = safe_divide(own, jnp.where(stops, at_end_speed, 0.0))
    lost = 0.5 * T * (1.0 - jnp.clip(share, 0.0, 1.0)) * per_speed
    return jnp.where(stops[:, None], -lost[:, None] * slip, 0.0)
