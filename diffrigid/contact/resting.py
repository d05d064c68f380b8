"""Many contacts at once: those that share a body at the same time, in an impact or at rest."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.contact.impulse import impulses, times
from diffrigid.contact.sides import at_colliders, side_sum
from diffrigid.joints import Linkage, spread
from diffrigid.numerics import FOUND, safe_divide, safe_sqrt
from diffrigid.pytree import array, pytree, static
from diffrigid.state import rotations

ROUNDS = 256  # at most, of the iteration; one is exact for contacts that are alone on their bodies


@pytree
class Strikes:
    """C contacts of all kinds in one list, each at its own time."""

    active: Array = array("C")  # (C, *batch) bool: touching at s
    s: Array = array("C")  # (C, *batch) [s]
    gap: Array = array("C")  # [m]
    normal: Array = array("C", "D")  # from b to a
    arm_a: Array = array("C", "D")  # [m] contact point from the centre of mass of a, world axes
    arm_b: Array = array("C", "D")
    K: Array = array("C", "D", "D")  # [1/kg] effective matrix
    v_rel: Array = array("C", "D")  # [m/s] of a against b at the contact point, before the impulse
    pull: Array = array("C", "D")  # [m/s^2] acceleration of a against b, of the centres
    drift: Array = array("C", "D")  # [m/s] half the velocity of a against b, of the centres; 0 at a static
    a: tuple[int, ...] = static(default=())  # collider of each contact: bodies, then statics
    b: tuple[int, ...] = static(default=())


@pytree
class Arms:
    """Where C contacts act on their bodies; fields as in `Strikes`."""

    arm_a: Array = array("C", "D")
    arm_b: Array = array("C", "D")
    a: tuple[int, ...] = static()
    b: tuple[int, ...] = static()


@pytree
class Mobility:
    """What turns impulses on the N moving bodies into changes of velocity."""

    inverse_mass: Array = array("N")  # [1/kg]
    inverse_inertia: Any = None  # [1/(kg m^2)] world axes
    link: Linkage | None = None  # of the joints between them


def momentum_changes(arms: Strikes | Arms, P: Array, moving: int) -> tuple[Array, Array]:
    """Changes of m v (N, D) [N s] and L (N, A) [N m s] of the moving bodies by the impulses P on side a."""
    so = rotations(P.shape[1])
    on_a = jnp.concatenate([P, jax.vmap(so.moment)(arms.arm_a, P)], axis=1)
    on_b = jnp.concatenate([-P, jax.vmap(so.moment)(arms.arm_b, -P)], axis=1)
    total = side_sum(on_a, on_b, arms.a, arms.b, moving)
    return total[:, : so.D], total[:, so.D :]


def velocities(mobility: Mobility, dp: Array, dL: Array) -> tuple[Array, Array, Array]:
    """Changes of v [m/s], w [rad/s] and L by impulses dp and dL on the bodies, and by what the joints make of them."""
    apply = rotations(dp.shape[1]).apply
    dv, dw = mobility.inverse_mass[:, None] * dp, jax.vmap(apply)(mobility.inverse_inertia, dL)
    if mobility.link is None:
        return dv, dw, dL
    more = spread(mobility.link, dv, dw)
    return dv + more[0], dw + more[1], dL + more[2]


def relative_changes(arms: Strikes | Arms, dv: Array, dw: Array) -> Array:
    """Change of the relative velocity at every contact, (C, D, *batch) [m/s], for changes of the bodies'."""
    so, both = rotations(dv.shape[1]), jnp.concatenate([dv, dw], axis=1)
    at_a, at_b = at_colliders(both, arms.a, 0.0), at_colliders(both, arms.b, 0.0)

    def point_velocity(at, arm):
        return at[: so.D] + so.cross(at[so.D :], arm)

    return jax.vmap(point_velocity)(at_a, arms.arm_a) - jax.vmap(point_velocity)(at_b, arms.arm_b)


def solve_impulses(strikes: Strikes, target: Array, mu: Array, mobility: Mobility, crowd: Array) -> Array:
    """Impulses of all active contacts, (C, D, *batch) [N s] on body a of each.

    Each contact solves its own law against a share of the mass of its bodies (mass splitting; Tonge et al.
    2012), all at once, until nothing changes: one round where contacts are alone on their bodies. Momentum is
    kept whatever the number of rounds. The derivative is that of the fixed point (implicit function theorem),
    so it costs no memory and does not depend on how the iteration got there.

    Args:
        target: (C, *batch) [m/s] normal velocity after the impulse.
        mu: (C, *batch) [-].
        crowd: (N, *batch) number of active contacts of each body.
    """
    one = strikes.active.astype(strikes.s.dtype)
    split = jnp.maximum(at_colliders(crowd, strikes.a, 1.0), at_colliders(crowd, strikes.b, 1.0))
    split = lax.stop_gradient(jnp.maximum(split, 1.0))
    arms = Arms(arm_a=strikes.arm_a, arm_b=strikes.arm_b, a=strikes.a, b=strikes.b)
    # On a shared body K is replaced by a multiple of the unit matrix that is no smaller: the fixed point is the
    # same, but two corners that slide together do not squeeze each other sideways on the way to it.
    size = safe_sqrt((strikes.K**2).sum((1, 2)))
    unit = jnp.eye(strikes.K.shape[1], dtype=size.dtype).reshape(1, *strikes.K.shape[1:3], *[1] * (size.ndim - 1))
    K = jnp.where((split > 1)[:, None, None], (split * size)[:, None, None] * unit, strikes.K)
    law = Law(K=K, normal=strikes.normal, target=target, mu=mu, on=one)
    together = strikes.active & ((split > 1) | (mobility.link is not None))
    return _fixed_point(jnp.any(together), law, strikes.v_rel, arms, mobility)


@pytree
class Law:
    """Arguments of the contact law at every contact, but for the velocity."""

    K: Array = array("C", "D", "D")
    normal: Array = array("C", "D")
    target: Array = array("C")
    mu: Array = array("C")
    on: Array = array("C")  # 1 where active, else 0


def _apply_law(law: Law, v: Array) -> Array:
    return impulses(law.on > 0, law.K, law.normal, v, law.target, law.mu)


def _others(law: Law, P: Array, arms: Arms, mobility: Mobility) -> Array:
    """Change of the relative velocity at every contact by the impulses at all others, (C, D, *batch) [m/s]."""
    changes = momentum_changes(arms, P, mobility.inverse_mass.shape[0])
    dv, dw, _ = velocities(mobility, *changes)
    return relative_changes(arms, dv, dw) - jax.vmap(times)(law.K, P)


@jax.custom_jvp
def _fixed_point(shared: Array, law: Law, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """P = law(v_rel + what the others do), iterated until nothing changes if any body is shared."""

    def one_round(P):
        return _apply_law(law, v_rel + _others(law, P, arms, mobility))

    return _repeat(one_round, _apply_law(law, v_rel), shared)


@_fixed_point.defjvp
def _fixed_point_jvp(primals, tangents):
    """dP = A dP + (law moved at fixed P), with A = (d law / dv) (what others do), solved by the same iteration."""
    shared, law, v_rel, arms, mobility = primals
    _, dlaw, dv_rel, darms, dmobility = tangents
    P = checkpoint_name(_fixed_point(*primals), FOUND)

    def others(law, arms, mobility):
        return _others(law, P, arms, mobility)

    change, dchange = jax.jvp(others, (law, arms, mobility), (dlaw, darms, dmobility))
    v = v_rel + change
    moved = jax.jvp(_apply_law, (law, v), (dlaw, dv_rel + dchange))[1]
    units = jnp.eye(v.shape[1], dtype=v.dtype).reshape(v.shape[1], 1, v.shape[1], *[1] * (v.ndim - 2))
    units = units + jnp.zeros_like(v)[None]
    columns = jax.vmap(lambda unit: jax.jvp(lambda v: _apply_law(law, v), (v,), (unit,))[1])(units)
    columns = lax.stop_gradient(columns)

    def linear(x):
        y = _others(law, x, arms, mobility)
        return x - sum(columns[i] * y[:, i : i + 1] for i in range(y.shape[1]))

    def solve(matvec, b):
        return _repeat(lambda x: x + b - matvec(x), b, shared)

    return P, lax.custom_linear_solve(linear, moved, solve, transpose_solve=solve)


def _repeat(one_round, first: Array, shared: Array) -> Array:
    """Repeat from the result of the first round until the change is rounding; not at all if no body is shared.

    Each world extrapolates over its last two rounds (Anderson 1965, depth one), which takes a tenth of the rounds.
    """

    def unsettled(x, change):
        largest = jnp.max(jnp.abs(change), (0, 1))
        return largest, largest > 4.0 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x), (0, 1))

    def busy(carry):
        # The change is measured here, on stored arrays: beside the round, XLA would compute the law again for it.
        count, x, _, change = carry
        return shared & (count < ROUNDS) & jnp.any(unsettled(x, change)[1])

    def again(carry):
        count, x, before, change_before = carry
        after = one_round(x)
        change = after - x
        # A world that has settled waits for the others: what is left there is rounding, and not to be extrapolated.
        size, moves = unsettled(x, change)
        scale = jnp.where(moves, 1.0 / jnp.where(moves, size, 1.0), 0.0)[None, None]  # squares do not underflow
        turn = scale * (change - change_before)
        share = safe_divide((scale * change * turn).sum((0, 1)), (turn * turn).sum((0, 1)))
        return count + 1, after - share[None, None] * (after - before), after, change

    return lax.while_loop(busy, again, (0, first, first, first))[1]
