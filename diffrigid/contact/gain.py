"""Impacts at several contacts at once, for which Newton's law with Coulomb's could add kinetic energy.

As for one contact (`impulse.py`), P is then taken between the impulses of both laws and P0, those without friction,
which never add any:

    P = P0 + kappa Q,   Q = P_both - P0,   T = P . (v_rel + W P / 2) <= 0,   the largest such kappa <= 1

For every kappa the normal velocities are those of Newton's law, and the impulses lie in the cone of friction, which
is convex. Contacts connected through bodies share one kappa. Bodies that are deep inside each other may demand what
no impulses can do: then P0 adds energy as well, and is scaled down likewise, towards zero impulse.
Source: Kane & Levinson, Dynamics: Theory and Applications (1985), for the gain.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.contact.cone import Cone
from diffrigid.contact.impulse import within_energy
from diffrigid.contact.mobility import Arms, Mobility, moved
from diffrigid.contact.order import Links, hanging_together
from diffrigid.contact.sums import at_pairs, pair_sum, pairs_of
from diffrigid.contact.together import solve_together
from diffrigid.numerics import FOUND, dot, saving
from diffrigid.pytree import replace


def solve_without_gain(cone: Cone, deep: Array, v_rel: Array, guess: Array, arms: Arms, mobility: Mobility) -> Array:
    """Impulses of contacts that share bodies, without energy gain, (C, D, *batch) [N s]; arguments of `solve_together`.

    Differentiable where these are, except where the bound on energy begins to act.

    Args:
        deep: (C, *batch) bool: contacts of bodies that are deep inside each other.
    """
    # Each number that a loop saves for reverse mode is one more operation, so all but the impulses are recomputed.
    again = saving(FOUND)
    may_gain = jnp.where((cone.target > 0) | deep, cone.on, 0.0)
    if cone.most is not None:
        may_gain = jnp.where(jnp.isinf(cone.most), may_gain, 0.0)
    any_may = any_world(may_gain > 0)

    def rounding(P: Array) -> Array:
        return jnp.finfo(P.dtype).eps ** 0.6 * jnp.abs(P * v_rel).sum((0, 1))[None]

    def gaining(P: Array) -> Array:
        P, v = lax.stop_gradient((P, v_rel))
        T = jax.vmap(dot)(P, v + 0.5 * lax.stop_gradient(moved(P, arms, mobility)))
        over, suspect = _summed(cone, arms, mobility, T, lax.stop_gradient(may_gain))
        return any_world((over > lax.stop_gradient(rounding(P))) & (suspect > 0))

    @again
    def one(needed: Array, rough: Array) -> tuple[Array, tuple[Array, Array]]:
        spin = None if cone.spin is None else rough * cone.spin
        P = solve_together(needed, replace(cone, mu=rough * cone.mu, spin=spin), v_rel, guess, arms, mobility)
        gains = lax.cond(any_may & (rough > 0), gaining, lambda _: jnp.asarray(False), P)
        return gains, (P, gains)

    @again
    def towards(P0: Array, goal: tuple[Array, Array]) -> tuple[Array, None]:
        P, allowance = goal
        both = jnp.stack([P0, P - P0])
        by_both = jax.vmap(lambda P: moved(P, arms, mobility))(both)
        factors = jnp.stack([v_rel + 0.5 * by_both[0], v_rel + by_both[0], by_both[1]], axis=1)
        terms = jnp.stack([P0, P - P0, P - P0], axis=1)
        T0, b, c, suspect = _summed(cone, arms, mobility, *jnp.moveaxis((terms * factors).sum(2), 1, 0), may_gain)
        gains = (suspect > 0) & (T0 + b + 0.5 * c > allowance * rounding(P))
        kappa = jnp.where(gains, within_energy(T0, b, c), 1.0)
        return P0 + kappa[:, None] * both[1], None

    def between(P: Array, P0: Array) -> Array:
        """Impulses from zero to P0, which adds energy only where there is no solution, and from there towards P."""
        goals = jnp.stack([P0, P]), jnp.array([1.0, 0.0], P.dtype)
        return lax.scan(towards, jnp.zeros_like(P), goals)[0]

    # Both solutions in one loop, so that the method is compiled once.
    _, ((P, P0), (gains, _)) = lax.scan(one, any_world(cone.on > 0), jnp.array([1.0, 0.0], v_rel.dtype))
    return lax.cond(gains, between, lambda P, _: P, P, P0)


def _summed(cone: Cone, arms: Arms, mobility: Mobility, *values: Array) -> list[Array]:
    """Sums of values (C, *batch) over all contacts connected through bodies with each of them, each (C, *batch)."""
    moving = mobility.inverse_mass.shape[0]
    by_pair = pair_sum(jnp.stack([cone.on, *values], axis=1), arms.a, arms.b)
    number = lax.broadcasted_iota(jnp.int32, (moving, *by_pair.shape[2:]), 0)
    if mobility.matrix is None:
        links = Links(*pairs_of(arms.a, arms.b), tuple((i,) for i in range(moving)))
        label = links.least(hanging_together(by_pair[:, 0] > 0, links), moving)
    else:  # joints may connect all of them
        label = jnp.zeros(by_pair[:, 0].shape, jnp.int32)
    member = (label[None] == number[:, None]).astype(by_pair.dtype)
    sums = (member[:, :, None] * by_pair[None]).sum(1)
    each = at_pairs((member[:, :, None] * sums[:, None]).sum(0), arms.a, arms.b)
    return [each[:, k] for k in range(1, each.shape[1])]
