"""The impulse at one contact: effective mass, Newton's restitution and Coulomb friction.

With K the matrix that turns an impulse P on body a (and -P on b) into a change of the relative velocity at
the contact point,

    n . v+ = target,  the normal law:    target = -e n . v-  (Newton)
    P = gamma n + kappa Q,               gamma = (target - n . v-) / (n . K n),  1 / (n . K n): effective mass
    sticks:  K Q = -(slip after gamma n)                            if then |P_t| <= mu P_n
    slides:  P = gamma_s (n - mu slip / |slip|) = gamma n + Q       else; gamma_s such that the normal law holds
    kinetic energy does not rise         a bound kappa <= 1 that acts rarely (Kane's paradox)

For a round body this is the textbook law: |gamma_t| <= mu gamma, stick if the impulse that stops the slip
fits, else slide against it. Where a corner couples the directions, Newton's law still holds exactly.
Source: Chatterjee & Ruina, J. Applied Mechanics 65 (1998) 939, for the splitting; Kane & Levinson 1985.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.contact.levers import Levers
from diffrigid.contact.sides import Placed
from diffrigid.linear import matvec
from diffrigid.numerics import dot, safe_divide, safe_sqrt
from diffrigid.so2 import perp
from diffrigid.so3 import tangents
from diffrigid.state import rotations

JAMMED = 1e-3  # [-] of the normal mobility: sliding would close the contact as fast as its normal impulse opens it


def restitution_at(u: Array, restitution: Array, falloff: Array | None = None) -> Array:
    """Coefficient of restitution of an impact with closing speed u [m/s], e = restitution (1 + falloff u)^(-1/4).

    The power is that of impacts in which the material yields, whatever the solid: e ~ u^(-1/4). Slow impacts have the
    full restitution. Without falloff [s/m], or with 0, it is constant. All (*batch); smooth.
    Source: Johnson, Contact Mechanics (1985), 11.5.
    """
    if falloff is None:
        return restitution
    return restitution / jnp.sqrt(jnp.sqrt(1.0 + falloff * jnp.where(u > 0, u, 0.0)))


def comes_to_rest(u: Array, rebound: Array, closing_acc: Array, left: Array, rest_speed: Array) -> Array:
    """Whether an impact does not rebound, (*batch) bool: it is slow, or the bodies would meet again within the step.

    Args:
        u, rebound: [m/s] closing speed, and separation speed e u by the law of restitution.
        closing_acc: [m/s^2] acceleration at which the bodies close: after 2 rebound / closing_acc they are back.
        left: [s] remaining time of the step.
    """
    return (u <= rest_speed) | (2.0 * rebound <= closing_acc * left)


def effective_matrix(at_a: Placed, at_b: Placed, lever: Levers) -> Array:
    """K, (D, D, *batch) [1/kg]: change of relative velocity at the end arms for a unit impulse at the middle arms."""
    K: Any = 0.0
    for at, arm, mid in ((at_a, lever.arm_a, lever.mid_a), (at_b, lever.arm_b, lever.mid_b)):
        if at.v is not None:
            dim = at.x.shape[0]
            unit = jnp.eye(dim, dtype=at.x.dtype).reshape(dim, dim, *[1] * (at.x.ndim - 1))
            turned = rotations(dim).mobility(at.inverse_inertia, arm, arm if mid is None else mid)
            K = K + at.inverse_mass[None, None] * unit + turned
    if lever.turn is None:
        return K
    return K - jax.vmap(lambda row: rotations(len(K)).cross(lever.turn, row))(K)


def impulses(on: Array, K: Array, n: Array, v: Array, target: Array, mu: Array) -> Array:
    """`contact_law` of C contacts, (C, D, *batch) [N s]; 0 with zero derivative for those not `on` (C, *batch).

    These are solved at rest, because far apart the derivative of the law may overflow, and 0 * inf is NaN.
    """
    v, target = jnp.where(on[:, None], v, 0.0), jnp.where(on, target, 0.0)
    return jnp.where(on[:, None], jax.vmap(contact_law)(K, n, v, target, mu), 0.0)


def contact_law(K: Array, n: Array, v: Array, target: Array, mu: Array) -> Array:
    """Impulse of one contact, (D, *batch) [N s]; see the module's docstring. Zero if it separates anyway.

    Args:
        v: (D, *batch) [m/s] relative velocity before.
        target: (*batch) [m/s] normal velocity after, >= 0.

    Differentiable except at the switches: separating to closing, stick to slip.
    """
    basis, k, effective_mass = _in_contact_frame(K, n)
    axes = range(len(basis))
    v_n, *v_t = [dot(e, v) for e in basis]
    gamma = jnp.maximum(target - v_n, 0.0)
    after = [v_i + gamma * k_in for v_i, (k_in, *_) in zip([v_n, *v_t], k, strict=True)]
    Q = _friction_impulse(k, gamma, after[1:], mu)
    gained = sum(Q[i] * k[i][j] * Q[j] for i in axes for j in axes)
    kappa = within_energy(0.5 * gamma * (v_n + target), sum(Q[i] * after[i] for i in axes), gained)
    P = [gamma + kappa * Q[0], *(kappa * Q_t for Q_t in Q[1:])]
    return sum((effective_mass * P[i])[None] * basis[i] for i in axes)


def _in_contact_frame(K: Array, n: Array) -> tuple[list[Array], list[list[Array]], Array]:
    """Basis of n and unit tangents; K in it, divided by its normal component; the inverse of that, the effective mass.

    Impulses are then velocities [m/s] until they are multiplied by the effective mass: products of components of K
    itself exceed the range of single precision where bodies weigh milligrams.
    """
    basis = [n, perp(n)] if n.shape[0] == 2 else [n, *tangents(n)]
    moved = [matvec(K, e) for e in basis]
    mobility = dot(n, moved[0])
    effective_mass = safe_divide(jnp.ones_like(mobility), mobility)
    return basis, [[dot(e, m) * effective_mass for m in moved] for e in basis], effective_mass


def _friction_impulse(k: list, gamma: Array, slip: list, mu: Array) -> list:
    """Impulse that friction adds to gamma n, in the contact frame; the normal velocity is unchanged.

    Args:
        k, gamma: scaled as in `_in_contact_frame`, like the result.
        slip: tangential velocity after gamma n [m/s].
    """
    stop = _stopping_impulse(k, slip)
    # sliding: P = gamma_s (n - mu along), with gamma_s such that the normal law holds
    speed = safe_sqrt(sum(s * s for s in slip))
    along = [safe_divide(s, speed) for s in slip]
    share = 1.0 - mu * sum(k_nt * e for k_nt, e in zip(k[0][1:], along, strict=True))
    bound = mu * (gamma + stop[0])
    sticks = (safe_sqrt(sum(P * P for P in stop[1:])) <= bound) | (share < JAMMED)
    slides = gamma / jnp.where(sticks, 1.0, share)
    slide = [slides - gamma, *(-mu * slides * e for e in along)]
    return [jnp.where(sticks, P, Q) for P, Q in zip(stop, slide, strict=True)]


def _stopping_impulse(k: list, slip: list) -> list:
    """-K^-1 (0, slip), by cofactors, 2 x 2 or 3 x 3; 0 where K is singular."""
    if len(k) == 2:
        (nn, nt), (tn, tt) = k
        share = safe_divide(slip[0], nn * tt - nt * tn)
        return [nt * share, -nn * share]
    n, *others = k

    def minors(p: list, q: list) -> list:
        return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]

    # columns of the adjugate for the two tangents s and t
    by_s, by_t = minors(others[1], n), minors(n, others[0])
    det = sum(k_s * c for k_s, c in zip(others[0], by_s, strict=True))
    s, t = slip
    return [-safe_divide(c_s * s + c_t * t, det) for c_s, c_t in zip(by_s, by_t, strict=True)]


def sticking_impulse(K: Array, n: Array, slip: Array) -> Array:
    """Impulse (D, *batch) [N s] that stops a slip (D, *batch) [m/s] and leaves the normal velocity unchanged."""
    basis, k, effective_mass = _in_contact_frame(K, n)
    P = _stopping_impulse(k, [dot(e, slip) for e in basis[1:]])
    return sum((effective_mass * P_i)[None] * e for P_i, e in zip(P, basis, strict=True))


def within_energy(T0: Array, b: Array, c: Array) -> Array:
    """Largest kappa <= 1 for which the kinetic energy does not rise: T0 + b kappa + c kappa^2 / 2 <= 0."""
    scale = lax.stop_gradient(jnp.abs(T0) + jnp.abs(b) + jnp.abs(c))  # normalised: squares of joules may underflow
    T0, b, c = (safe_divide(term, scale) for term in (T0, b, c))
    gains = (T0 + b + 0.5 * c > 0) & (c > 0)
    root = (safe_sqrt(b * b - 2.0 * c * jnp.minimum(T0, 0.0)) - b) / jnp.where(gains, c, 1.0)
    return jnp.where(gains, jnp.clip(root, 0.0, 1.0), 1.0)
