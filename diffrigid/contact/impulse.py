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
from jax import Array

from diffrigid.contact.sides import Placed
from diffrigid.numerics import dot, norm, normalise, safe_divide, safe_sqrt
from diffrigid.so2 import perp
from diffrigid.so3 import cross
from diffrigid.state import rotations

JAMMED = (
    1e-3  # [-] of the normal mobility: where sliding would close the contact as fast as its normal impulse opens it
)


def effective_matrix(at_a: Placed, arm_a: Array, at_b: Placed, arm_b: Array) -> Array:
    """K, (D, D, *batch) [1/kg]: change of the relative velocity for a unit impulse at these arms (D, *batch) [m]."""
    K: Any = 0.0
    for at, arm in ((at_a, arm_a), (at_b, arm_b)):
        if at.v is not None:
            dim = at.x.shape[0]
            unit = jnp.eye(dim, dtype=at.x.dtype).reshape(dim, dim, *[1] * (at.x.ndim - 1))
            K = K + at.inverse_mass[None, None] * unit + rotations(dim).mobility(at.inverse_inertia, arm)
    return K


def times(K: Array, P: Array) -> Array:
    """K P, (D, D, *batch), (D, *batch) -> (D, *batch). K is symmetric."""
    return jax.vmap(dot, in_axes=(1, None))(K, P)


def inverse_times(K: Array, r: Array) -> Array:
    """K^-1 r by cofactors, 2 x 2 or 3 x 3; 0 where K is singular."""
    if K.shape[0] == 2:
        adjoint = -perp(times(K, perp(r)))
        return safe_divide(adjoint, dot(perp(K[0]), K[1])[None])
    bc, ca, ab = cross(K[1], K[2]), cross(K[2], K[0]), cross(K[0], K[1])
    return safe_divide(jnp.stack([dot(bc, r), dot(ca, r), dot(ab, r)]), dot(K[0], bc)[None])


def contact_law(K: Array, n: Array, v: Array, target: Array, mu: Array) -> Array:
    """Impulse of one contact, (D, *batch) [N s]; see the module's docstring. Zero if it separates anyway.

    Args:
        v: (D, *batch) [m/s] relative velocity before.
        target: (*batch) [m/s] normal velocity after, >= 0.

    Differentiable except at the switches: separating to closing, stick to slip.
    """
    Kn, v_n = times(K, n), dot(n, v)
    gamma = jnp.maximum(safe_divide(target - v_n, dot(n, Kn)), 0.0)
    after = v + gamma[None] * Kn
    slip = after - dot(n, after)[None] * n
    Q = friction_impulse(K, n, Kn, gamma, slip, mu)
    kappa = _within_energy(0.5 * gamma * (v_n + target), dot(Q, after), dot(Q, times(K, Q)))
    return gamma[None] * n + kappa[None] * Q


def friction_impulse(K: Array, n: Array, Kn: Array, gamma: Array, slip: Array, mu: Array) -> Array:
    """What friction adds to the impulse gamma n, (D, *batch) [N s]. It leaves the normal velocity: n . K Q = 0."""
    stop = -inverse_times(K, slip)
    stop_n = dot(n, stop)
    # sliding: P = gamma_s (n - mu along), with gamma_s such that the normal law holds
    along = normalise(slip)
    share = 1.0 - mu * safe_divide(dot(Kn, along), dot(n, Kn))
    sticks = (norm(stop - stop_n[None] * n) <= mu * (gamma + stop_n)) | (share < JAMMED)
    slide = (gamma / jnp.where(sticks, 1.0, share))[None] * (n - mu[None] * along) - gamma[None] * n
    return jnp.where(sticks[None], stop, slide)


def _within_energy(T0: Array, b: Array, c: Array) -> Array:
    """Largest kappa <= 1 for which the kinetic energy does not rise: T0 + b kappa + c kappa^2 / 2 <= 0."""
    gains = (T0 + b + 0.5 * c > 0) & (c > 0)
    root = (safe_sqrt(b * b - 2.0 * c * jnp.minimum(T0, 0.0)) - b) / jnp.where(gains, c, 1.0)
    return jnp.where(gains, jnp.clip(root, 0.0, 1.0), 1.0)
