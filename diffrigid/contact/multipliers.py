"""Impulses of contacts that share bodies, to a few digits and from any start: the method of multipliers.

With modified velocities in which a slip opens the contact too, y + mu |y_t| n, Coulomb's law is that between a cone
and its dual: P lies in the cone of friction, y + mu |y_t| n - target n in its dual, and the two are orthogonal. With
`nearest` the projection onto the cone and any sigma > 0 that is

    P = nearest(z),   z = P - sigma (y + mu |y_t| n - target n),   y = v_rel + J u,   u = G J^T P

For given multipliers P inside z and given slip, u = G J^T nearest(z) is where a convex function of u is least, so
Newton's method with a line search finds it from anywhere, however many contacts repeat each other. Then nearest(z) are
the next multipliers.
Source: De Saxce & Feng, Mathematical and Computer Modelling 28 (1998) 225, for the law; Bertsekas, Constrained
Optimization and Lagrange Multiplier Methods, 1982, for the method.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.contact.cone import Cone, nearest, put, split
from diffrigid.contact.mobility import Mobility, at_contacts, bodies_matrix, twists
from diffrigid.linear import solve_regular
from diffrigid.numerics import norm
from diffrigid.state import rotations

MULTIPLIER_ROUNDS = 40  # at most
SOFTNESS = 1e-2  # [-] 1 / (sigma k): about the fraction of the error in P that a round leaves
READY = 1e-2  # [-] of u: error of the inner problem below which the multipliers are updated
HALVINGS = 10  # bisections of the line search


def solve_roughly(cone: Cone, v_rel: Array, arms: Any, mobility: Mobility, error: Callable, enough: Array) -> Array:
    """Impulses of the C contacts, (C, D, *batch) [N s].

    Args:
        error: function of impulses, (*batch); the impulses with the least error are returned.
        enough: (*batch) error at which to stop.
    """
    sigma = (1.0 / (SOFTNESS * cone.scale))[:, None]
    D = v_rel.shape[1]

    def pushed(P: Array, y: Array) -> Array:
        _, y_t = split(cone.normal, y)
        opening = cone.mu * jax.vmap(norm)(y_t) - cone.target
        if cone.spin is not None:
            opening = put(cone.spin, opening, jnp.zeros_like(cone.spin))
        return nearest(cone, P - sigma * (y + opening[:, None] * cone.normal))

    def again(carry):
        count, u, P, best, least = carry
        y = v_rel + at_contacts(arms, u)
        F = pushed(P, y)
        new = error(F)
        best, least = jnp.where((new < least)[None, None], F, best), jnp.minimum(new, least)
        ready = _size(u - twists(F, arms, mobility), mobility, D) < READY * _size(u, mobility, D)
        P = jnp.where(ready[None, None], F, P)
        F = pushed(P, y)
        off = u - twists(F, arms, mobility)
        matrix = bodies_matrix(lambda dy: -jax.jvp(lambda y: pushed(P, y), (y,), (dy,))[1], arms, mobility)
        du = -solve_regular(matrix, off)
        dy, weight = at_contacts(arms, du), _momenta(du, mobility, D)

        def ahead(share: Array) -> Array:  # slope of the convex function there
            F = pushed(P, y + share[None, None] * dy)
            return (weight * (u + share[None] * du - twists(F, arms, mobility))).sum(0)

        return count + 1, u + _down(ahead, jnp.ones_like(least))[None] * du, P, best, least

    nothing = jnp.zeros_like(v_rel)
    u, least = twists(nothing, arms, mobility), jnp.full(v_rel.shape[2:], jnp.inf, v_rel.dtype)

    def busy(carry):
        return (carry[0] < MULTIPLIER_ROUNDS) & any_world(carry[-1] > enough)

    return lax.while_loop(busy, again, (0, u, nothing, nothing, least))[3]


def _down(slope: Callable, whole: Array) -> Array:
    """Line search: largest share of a step, at most `whole`, before the slope turns positive (bisection)."""

    def halved(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        over = slope(middle) > 0
        return jnp.where(over, low, middle), jnp.where(over, middle, high)

    def search():
        return lax.fori_loop(0, HALVINGS, halved, (jnp.zeros_like(whole), whole))[1]

    over = slope(whole) > 0
    return jnp.where(over, lax.cond(any_world(over), search, lambda: whole), whole)


def _momenta(u: Array, mobility: Mobility, D: int) -> Array:
    """Momenta M u for the stacked twists u (R, *batch)."""
    so, by_body = rotations(D), u.reshape(-1, D + rotations(D).A, *u.shape[1:])
    inertia = jax.vmap(so.inverse_inertia)(mobility.inverse_inertia)
    angular = jax.vmap(so.apply)(inertia, by_body[:, D:])
    return jnp.concatenate([by_body[:, :D] / mobility.inverse_mass[:, None], angular], axis=1).reshape(u.shape)


def _size(u: Array, mobility: Mobility, D: int) -> Array:
    """Norm sqrt(u . M u) of the stacked twists u, (*batch)."""
    return jnp.sqrt(jnp.maximum((u * _momenta(u, mobility, D)).sum(0), 0.0))
