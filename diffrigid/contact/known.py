"""Impulses that a pass knows from the one before it; the others are solved beside them.

Friction that reverses   Where a slip stops and reverses while the contact is held, friction acts first one way, then
                         the other. A trial pass, with friction one way, tells the total; the trial is discarded, and
                         the next pass uses the total.
                         Where bodies have joints, friction changes the normal force, and this the slip: a pass without
                         friction there tells by how much.
Loads                    A loaded contact must not move, in either direction. The displacement by its load is taken
                         back, and found anew with all gaps closed: this closes a gap that opened beside another
                         contact when the body turned within the step.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.contact.cone import put, split, turning, without_turning
from diffrigid.contact.mobility import Mobility, moved, relative_changes
from diffrigid.contact.resting import Law, Strikes
from diffrigid.contact.slipping import in_all, least_slip, most_resisting, pulled, reversal, rubbing, slips
from diffrigid.numerics import dot, norm, normalise, safe_divide
from diffrigid.pytree import array, pytree, replace

STOPPED = 1e-6  # [-] of the slip at the beginning: along it, less than this at the end is a stop
TELLS = 0.5  # [-] share of friction along the slip from which a trial tells how friction brakes it


@pytree
class Known:
    """Known impulses on body a of each contact and row; else 0."""

    P: Array = array("C", "D")  # [N s]; where gaps are closed (PUSH) [kg m]
    early: Array = array("C", "D")  # [N s^2] displacement beyond that of an even force, where friction reverses
    rubs: Array = array("C")  # 1 where friction reverses, so that all of it is known; -1 where it may not; else 0
    # Where bodies have joints: impulses with friction one way, for those that may reverse.
    trial: Array | None = array("C", "D", default=None)  # [N s]

    def reverses(self) -> Array:
        """Whether some friction of a world is to be found anew, (*batch) bool."""
        return (self.rubs != 0).any(0)

    def opened(self, strikes: Strikes) -> Array:
        """Whether a gap of a world is open, by more than rounding, where a contact carries a load, (*batch) bool."""
        gap = strikes.gap - strikes.rounding
        turning_rows = len(self.P) - len(gap)
        P = without_turning(turning_rows, self.P) if turning_rows else self.P
        return ((gap > 0) & (P != 0).any(1)).any(0)

    def there(self, strikes: Strikes) -> "Known":
        """Only the impulses of contacts that take part in this pass: no other would be found anew."""
        on = strikes.active
        turning_rows = len(self.P) - len(on)
        on = jnp.concatenate([on[:turning_rows], on]) if turning_rows else on
        return jax.tree.map(lambda leaf: jnp.where(on if leaf.ndim == on.ndim else on[:, None], leaf, 0.0), self)


def beside(mobility: Mobility, strikes: Strikes, law: Law, known: Known) -> tuple[Strikes, Law]:
    """Strikes and law for the unknown impulses: known ones are in `v_rel`, and known friction is switched off."""
    (target, mu, most), rubs = law, known.rubs > 0
    most = None if most is None else jnp.where(rubs & jnp.isfinite(most), 0.0, most)
    strikes = replace(strikes, v_rel=strikes.v_rel + moved(known.P, strikes, mobility))
    return strikes, Law(target, jnp.where(rubs, 0.0, mu), most)


def reversing(
    mobility: Mobility, strikes: Strikes, P: Array, changes: tuple[Array, Array], law: Law, T: Array,
    rest_speed: Array, by_torques: Array | float = 0.0, began: Callable | None = None,
) -> Known:  # fmt: skip
    """Friction where a slip stops and reverses within T, from trial impulses P with friction acting one way.

    See `reversal`. How much the full bound brakes the slip follows from the trial impulses.

    Args:
        changes: of v (N, D, *batch) [m/s] and w (N, A, *batch) [rad/s], by P and by torques of rolling rows.
        by_torques: (C, D, *batch) [m/s] what v_rel gains by the latter, which `strikes` have already.
        began: gives relative velocities when contacts began to be held, (C, D, *batch) [m/s]. If given, only name those
            where friction may reverse, for `weighed`; rows of joints as ever.
    """
    held, heaviest = strikes.active & strikes.held & (T > 0), most_resisting(mobility, strikes)

    def found(P: Array, changes: tuple[Array, Array], law: Law) -> Known:
        (friction, bounds), (free, by) = rubbing(strikes, P, law), pulled(mobility, strikes, P, law.most, T)
        at_end, slip = slips(friction, free, law.target, T)
        back = jax.vmap(normalise)(at_end - slip)
        rubbed = friction(P)
        against, braked, own = (
            -jax.vmap(dot)(r, back)
            for r in (slip, friction(relative_changes(strikes, *changes) - by - by_torques), rubbed)
        )
        stops = held & (against > least_slip(rest_speed)[None])
        # How the full bound brakes the slip, inferred from those impulses if they tell: where friction at all contacts
        # is roughly along it, and brakes as much as the heaviest mass allows.
        across = jax.vmap(norm)(rubbed + own[:, None] * back)
        rubs, bound, aside = (in_all(strikes, stops, part) for part in (own, bounds, across))
        tells = stops & (jnp.abs(rubs) > TELLS * aside + jnp.finfo(T.dtype).eps ** 0.5 * bound)
        per_impulse = safe_divide(braked, jnp.where(tells, rubs, 0.0))
        light = per_impulse * heaviest > TELLS
        if law.most is not None:
            light = light | jnp.isfinite(law.most)
        drag = jnp.where(light, bound * per_impulse, 0.0)
        turned, early, turns = reversal(slip, at_end, bounds, drag, stops, T)
        if began is None:
            return Known(P=turned, early=early, rubs=turns.astype(T.dtype))
        of_joint = jnp.zeros_like(held) if law.most is None else jnp.isfinite(law.most)
        left = strikes.v_rel + relative_changes(strikes, *changes)
        maybe = held & _stops(strikes, began(), left, rest_speed) & (rubbed != 0).any(1)
        turned, early = (jnp.where(of_joint[:, None], part, 0.0) for part in (turned, early))
        return Known(P=turned, early=early, rubs=jnp.where(of_joint, turns, maybe).astype(T.dtype), trial=P)

    def nothing(P: Array, changes: tuple[Array, Array], law: Law) -> Known:
        del changes, law
        none = jnp.zeros_like(P)
        return Known(P=none, early=none, rubs=jnp.zeros_like(T), trial=None if began is None else none)

    return lax.cond(any_world(held), found, nothing, P, changes, law)


def _stops(strikes: Strikes, began: Array, left: Array, rest_speed: Array) -> Array:
    """Whether a slip of contacts that began and is `left`, (C, D, *batch) [m/s], has stopped between, (C, *batch) bool.

    What the pull tells of the beginning would not do: it is off by more than the slip of what rests.
    """
    slip, after = (split(strikes.normal, r)[1] for r in (began, left))
    speed, onwards = jax.vmap(norm)(slip), jax.vmap(dot)(after, slip)
    return (speed > least_slip(rest_speed)[None]) & (onwards <= STOPPED * speed**2)


def weighed(mobility: Mobility, strikes: Strikes, P: Array, known: Known, law: Law, T: Array) -> Known:
    """Friction of contacts where a slip may stop and reverse within T, from impulses P without friction there.

    With friction f, of all contacts that slip as one, their normal forces and slips change linearly: its bound is
    b + kappa f, so that it is b / (1 - kappa) until the stop, and b / (1 + kappa) the other way. P tells b, and the
    trial the slopes. See `reversal`, of which this is the case with two bounds.
    """
    (_, mu, most), trial, n = law, jnp.asarray(known.trial), strikes.normal

    def across(r: Array) -> Array:
        return split(n, r)[1]

    maybe = (known.rubs > 0) & strikes.active & (True if most is None else jnp.isinf(most))
    free, by_trial = (across(strikes.v_rel + moved(each, strikes, mobility)) for each in (P, trial))
    slip = across(strikes.v_rel - T[:, None] * strikes.pull)
    pull, back = jax.vmap(norm)(free - slip), jax.vmap(normalise)(free - slip)
    against, gained, rubbed = (jax.vmap(dot)(r, back) for r in (-slip, by_trial - free, across(trial)))
    bound, bound_trial = (mu * jax.vmap(dot)(n, each) for each in (P, trial))
    f, b = (in_all(strikes, maybe, part) for part in (rubbed, bound))
    tells = maybe & (jnp.abs(f) > jnp.finfo(T.dtype).eps ** 0.5 * jnp.abs(b))
    kappa, gain = (safe_divide(part, jnp.where(tells, f, 0.0)) for part in (bound_trial - bound, gained))
    of_all = in_all(strikes, maybe, kappa)
    tells = tells & (jnp.abs(of_all) < 1.0) & (gain > 0)
    one_way, other_way = (b / jnp.where(tells, 1.0 + sign * of_all, 1.0) for sign in (-1.0, 1.0))
    rise = pull + gain * one_way
    turns = tells & (pull > gain * other_way) & (against > 0) & (against < rise)
    share = safe_divide(against, jnp.where(turns, rise, 0.0))
    first, second = bound + kappa * one_way, bound - kappa * other_way
    friction = share * first - (1.0 - share) * second
    early = 0.5 * share * (1.0 - share) * T * (first + second)
    P, early = (jnp.where(turns, part, 0.0)[:, None] * back for part in (friction, early))
    return Known(
        P=jnp.where(maybe[:, None], P, known.P), early=jnp.where(maybe[:, None], early, known.early),
        rubs=jnp.where(maybe, jnp.where(turns, 1.0, -1.0), known.rubs).astype(T.dtype), trial=trial,
    )  # fmt: skip


def loads(strikes: Strikes, P: Array, most: Array | None, T: Array) -> Array:
    """Corrections (C, D, *batch) [kg m] that cancel the displacement by the load of each contact held for T."""
    carries: Any = strikes.held if most is None else strikes.held & jnp.isinf(most)
    pushed = jnp.where(carries, 0.5 * T * jnp.maximum(split(strikes.normal, P)[0], 0.0), 0.0)
    if strikes.spin is not None:
        pushed = put(strikes.spin, pushed, jnp.zeros_like(turning(strikes.spin, pushed)))
    return -pushed[:, None] * strikes.normal
