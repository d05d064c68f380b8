"""Impulses that a pass knows from the one before it; the others are solved beside them.

Friction that reverses   Where a slip stops and reverses while the contact is held, friction acts first one way, then
                         the other. A trial pass, with friction one way, tells the total; the trial is discarded, and
                         the next pass uses the total.
Loads                    A loaded contact must not move, in either direction. The displacement by its load is taken
                         back, and found anew with all gaps closed: this closes a gap that opened beside another
                         contact when the body turned within the step.
"""

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

TELLS = 0.5  # [-] share of friction along the slip from which a trial tells how friction brakes it


@pytree
class Known:
    """Known impulses on body a of each contact and row; else 0."""

    P: Array = array("C", "D")  # [N s]; where gaps are closed (PUSH) [kg m]
    early: Array = array("C", "D")  # [N s^2] displacement beyond that of an even force, where friction reverses
    rubs: Array = array("C")  # 1 where friction reverses, so that all of it is known, else 0

    def reverses(self) -> Array:
        """Whether some friction reverses in a world, (*batch) bool."""
        return (self.rubs > 0).any(0)

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
    rest_speed: Array, by_torques: Array | float = 0.0,
) -> Known:  # fmt: skip
    """Friction where a slip stops and reverses within T, from trial impulses P with friction acting one way.

    See `reversal`. How much the full bound brakes the slip follows from the trial impulses.

    Args:
        changes: of v (N, D, *batch) [m/s] and w (N, A, *batch) [rad/s], by P and by torques of rolling rows.
        by_torques: (C, D, *batch) [m/s] what v_rel gains by the latter, which `strikes` have already.
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
        P, early, turns = reversal(slip, at_end, bounds, drag, stops, T)
        return Known(P=P, early=early, rubs=turns.astype(T.dtype))

    def nothing(P: Array, changes: tuple[Array, Array], law: Law) -> Known:
        del changes, law
        return Known(P=jnp.zeros_like(P), early=jnp.zeros_like(P), rubs=jnp.zeros_like(T))

    return lax.cond(any_world(held), found, nothing, P, changes, law)


def loads(strikes: Strikes, P: Array, most: Array | None, T: Array) -> Array:
    """Corrections (C, D, *batch) [kg m] that cancel the displacement by the load of each contact held for T."""
    carries: Any = strikes.held if most is None else strikes.held & jnp.isinf(most)
    pushed = jnp.where(carries, 0.5 * T * jnp.maximum(split(strikes.normal, P)[0], 0.0), 0.0)
    if strikes.spin is not None:
        pushed = put(strikes.spin, pushed, jnp.zeros_like(turning(strikes.spin, pushed)))
    return -pushed[:, None] * strikes.normal
