"""Impulses of many contacts at once, some of which share a body, in an impact or at rest."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.contact.cone import Cone
from diffrigid.contact.gain import solve_without_gain
from diffrigid.contact.impulse import impulses
from diffrigid.contact.mobility import Arms, Mobility, moved
from diffrigid.contact.sums import at_colliders
from diffrigid.gathers import flags
from diffrigid.numerics import dot, recomputed, safe_divide, safe_sqrt
from diffrigid.pytree import array, pytree, static


@pytree
class Strikes:
    """C contacts of all kinds in one list, each at its own time."""

    active: Array = array("C")  # (C, *batch) bool: touching at s; later, whether it takes part in the pass
    s: Array = array("C")  # (C, *batch) [s]
    gap: Array = array("C")  # [m]
    rounding: Array = array("C")  # [m] gap that may be due to rounding
    deepest: Array = array("C")  # [m] largest penetration that one step resolves
    normal: Array = array("C", "D")  # from b to a
    # [m] contact point from the centre of mass of a, world axes; where it is held, that of changes of velocity.
    arm_a: Array = array("C", "D")
    arm_b: Array = array("C", "D")
    mid_a: Any = array("C", "D", default=None)  # [m] arm of impulses, half the held time before s; None: arm_a
    mid_b: Any = array("C", "D", default=None)
    turn: Any = array("C", "A", default=None)  # [rad] rotation of the impulse at s to where it acts; None: none
    lean: Any = array("C", "D", default=None)  # [-] change of the normal until changes of velocity act; None: none
    K: Array = array("C", "D", "D")  # [1/kg] effective matrix
    # [m/s] of a against b at the contact point, before the impulse; where gaps are closed (PUSH) the gap along the
    # normal, [m], so that an impulse is [kg m] and changes positions.
    v_rel: Array = array("C", "D")
    press: Array = array("C")  # [m/s^2] acceleration at which forces close the gap, without what spins do
    pull: Array = array("C", "D")  # [m/s^2] rate of v_rel without impulses; along the normal that of its component
    rests: Array = array("C")  # bool: it touches from the start of the path on
    now: Array = array("C")  # bool: it is the turn of this impact
    held: Array = array("C")  # bool: s is the time until which it is held, not that of an impact
    drift: Array = array("C", "D")  # [m/s] half the velocity of centre a relative to centre b; 0 at a static
    a: tuple[int, ...] = static(default=())  # collider of each contact: bodies, then statics
    b: tuple[int, ...] = static(default=())
    wholes: tuple = static(default=())  # label of each contact and row: those with the same label slip as one
    jac: Any = array("R", "2", "D + A", default=None)  # of the last R, the rows of joints; see `Arms`
    mid_jac: Any = array("R", "2", "D + A", default=None)
    spin: Any = array("K", default=None)  # [m] of the K rolling rows, behind the first K contacts; see `Cone`


class Law(NamedTuple):
    """Contact law of contacts and rows, each (C, *batch)."""

    target: Array  # [m/s] normal velocity after the impulse
    mu: Array  # [-]
    most: Array | None  # [N s] bound of a two-sided normal impulse; infinite: it only pushes, unbounded. None: all so


def solve_impulses(
    strikes: Strikes, law: Law, mobility: Mobility, count: Array, rest_speed: Array, guess: Array, T: Array
) -> Array:
    """Impulses of all active contacts, (C, D, *batch) [N s] on body a of each.

    A contact that is alone on its bodies, if these have no joints, follows `contact_law`. Others are solved together
    (`together.py`). What a world never needs is not even compiled, as the latter for one disc over a floor.

    Args:
        count: (N, *batch) number of active contacts of each body.
        rest_speed: (*batch) [m/s] speed that is slow in these worlds.
        guess: (C, D, *batch) [N s] impulses to begin with; of many solutions the one near to it is taken.
        T: (C, *batch) [s] time over which the impulse of a resting contact has acted, else 0.
    """
    target, mu, most = law
    began = None
    if strikes.normal.shape[1] == 3:
        began = jnp.where(T > 0, 1.0, 0.0)[:, None] * (strikes.v_rel - T[:, None] * strikes.pull)
    if not mobility.joined and are_alone(strikes.a, strikes.b, len(count)):
        return impulses(strikes.active, strikes.K, strikes.normal, strikes.v_rel, target, mu, began)
    if most is not None and len(strikes.a) == 1:
        return _only_row(strikes, target, most, mobility)
    joined = tuple(not mobility.joined.isdisjoint(pair) for pair in zip(strikes.a, strikes.b, strict=True))
    others = jnp.maximum(at_colliders(count, strikes.a, 1.0), at_colliders(count, strikes.b, 1.0))
    others = lax.stop_gradient(others)
    shared = strikes.active & ((others > 1) | flags(joined, count))
    by_itself, alone = strikes.active & ~shared, jnp.zeros_like(strikes.v_rel)
    if not all(joined):
        given = by_itself, strikes.K, strikes.normal, strikes.v_rel, target, mu, began
        alone = lax.cond(any_world(by_itself), recomputed(impulses, rest_speed), _none, *given)
    cone = Cone(
        on=shared.astype(others.dtype), sharing=jnp.maximum(others, 1.0), scale=_scale(strikes), normal=strikes.normal,
        target=target, mu=mu, most=most, spin=strikes.spin, rest_speed=rest_speed,
    )  # fmt: skip
    deep = strikes.gap < -strikes.deepest
    return alone + solve_without_gain(cone, deep, strikes.v_rel, guess, _arms(strikes), mobility)


def _arms(strikes: Strikes) -> Arms:
    return Arms(
        arm_a=strikes.arm_a, arm_b=strikes.arm_b, mid_a=strikes.mid_a, mid_b=strikes.mid_b, turn=strikes.turn,
        normal=strikes.normal, lean=strikes.lean, jac=strikes.jac, mid_jac=strikes.mid_jac, spin=strikes.spin,
        a=strikes.a, b=strikes.b,
    )  # fmt: skip


def _only_row(strikes: Strikes, target: Array, most: Array, mobility: Mobility) -> Array:
    """Impulse of the only row of a world, (1, D, *batch) [N s]: a motor or the dry friction of one joint."""
    n, on = strikes.normal, strikes.active[:, None]
    per_impulse = jax.vmap(dot)(n, moved(n, _arms(strikes), mobility))
    wanted = safe_divide(target - jax.vmap(dot)(n, strikes.v_rel), per_impulse)
    return jnp.where(on, jnp.clip(wanted, -most, most)[:, None] * n, 0.0)


def barely(strikes: Strikes, rest_speed: Array) -> Array:
    """Small impulses (C, D, *batch) [N s], which change the velocities of active contacts by about `rest_speed`.

    As a start for Newton's method, which takes contacts that push to stick. From zero it would find out layer by layer
    that a pile does.
    """
    on = strikes.active.astype(strikes.s.dtype)
    return (on * safe_divide(rest_speed[None], _scale(strikes)))[:, None] * strikes.normal


def _scale(strikes: Strikes) -> Array:
    """Frobenius norm of the effective matrices, (C, *batch) [1/kg]."""
    return safe_sqrt((strikes.K**2).sum((1, 2)))


def are_alone(a: tuple[int, ...], b: tuple[int, ...], moving: int) -> bool:
    """Whether no body is in more than one of the contacts between colliders a and b. Static."""
    bodies = [i for i in a + b if i < moving]
    return len(set(bodies)) == len(bodies)


def _none(on: Array, K: Array, n: Array, v: Array, target: Array, mu: Array, began: Array | None) -> Array:
    del on, K, n, target, mu, began
    return jnp.zeros_like(v)
