"""The impulse at one contact: effective mass, Newton's restitution and Coulomb friction.

With K the matrix that turns an impulse P on body a (and -P on b) into a change of the relative velocity at
the contact point,

    n . v+ = target,  the normal law:    target = -e n . v-  (Newton)
    P = gamma n + kappa Q,               gamma = (target - n . v-) / (n . K n),  1 / (n . K n): effective mass
    sticks:  K Q = -(slip after gamma n)                            if then |P_t| <= mu P_n
    slides:  P_t = -mu P_n slip+ / |slip+|                          else; slip+: what P leaves of the slip
    kinetic energy does not rise         a bound kappa <= 1 that acts rarely (Kane's paradox)

Friction of a contact that is held for a time acts against the mean slip of that time: see `_friction_impulse`.

For a round body, and in the plane, this is the textbook law: |gamma_t| <= mu gamma, stick if the impulse that stops the
slip fits, else slide against it. Where a corner couples the directions Newton's law still holds exactly, and friction
turns the slip. It acts against the slip that is left, as where contacts are solved together: so impulses are continuous
from slipping to sticking.
Source: Chatterjee & Ruina, J. Applied Mechanics 65 (1998) 939, for the splitting; Kane & Levinson 1985.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.contact.levers import Levers
from diffrigid.contact.sides import Placed
from diffrigid.linear import matvec
from diffrigid.numerics import dot, implicit_root, norm, safe_divide, safe_sqrt
from diffrigid.so2 import perp
from diffrigid.so3 import tangents
from diffrigid.state import rotations

ROUNDS = 10  # of Newton's method for the direction in which friction acts in space
NEAR = 1e-3  # [-] by which a step may leave the bracket of the root: rounding does, at the root


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


def effective_matrix(at_a: Placed, at_b: Placed, normal: Array, lever: Levers) -> Array:
    """K, (D, D, *batch) [1/kg]: change of relative velocity at the late arms for a unit impulse at the middle arms."""
    K: Any = 0.0
    for at, arm, mid in ((at_a, lever.late_a, lever.mid_a), (at_b, lever.late_b, lever.mid_b)):
        if at.v is not None:
            dim = at.x.shape[0]
            unit = jnp.eye(dim, dtype=at.x.dtype).reshape(dim, dim, *[1] * (at.x.ndim - 1))
            turned = rotations(dim).mobility(at.inverse_inertia, arm, arm if mid is None else mid)
            K = K + at.inverse_mass[None, None] * unit + turned
    if lever.turn is None:
        return K
    K = K - jax.vmap(lambda row: rotations(len(K)).cross(lever.turn, row))(K)
    if lever.lean is None:
        return K
    return K + normal[:, None] * matvec(jnp.swapaxes(K, 0, 1), lever.lean)[None]


def impulses(on: Array, K: Array, n: Array, v: Array, target: Array, mu: Array, began: Array | None = None) -> Array:
    """`contact_law` of C contacts, (C, D, *batch) [N s]; 0 with zero derivative for those not `on` (C, *batch).

    These are solved at rest, because far apart the derivative of the law may overflow, and 0 * inf is NaN.
    """
    v, target = jnp.where(on[:, None], v, 0.0), jnp.where(on, target, 0.0)
    began = None if began is None else jnp.where(on[:, None], began, 0.0)
    return jnp.where(on[:, None], jax.vmap(contact_law)(K, n, v, target, mu, began), 0.0)


def contact_law(K: Array, n: Array, v: Array, target: Array, mu: Array, began: Array | None = None) -> Array:
    """Impulse of one contact, (D, *batch) [N s]; see the module's docstring. Zero if it separates anyway.

    Args:
        v: (D, *batch) [m/s] relative velocity before.
        target: (*batch) [m/s] normal velocity after, >= 0.
        began: (D, *batch) [m/s] relative velocity at the beginning of the time for which it is held, or 0 in
            an impact; None: the slip keeps its direction.

    Differentiable except at the switches: separating to closing, stick to slip.
    """
    basis, k, effective_mass = _in_contact_frame(K, n)
    axes = range(len(basis))
    v_n, *v_t = [dot(e, v) for e in basis]
    gamma = jnp.maximum(target - v_n, 0.0)
    after = [v_i + gamma * k_in for v_i, (k_in, *_) in zip([v_n, *v_t], k, strict=True)]
    Q = _friction_impulse(k, gamma, after[1:], mu, None if began is None else [dot(e, began) for e in basis[1:]])
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


def _friction_impulse(k: list, gamma: Array, slip: list, mu: Array, began: list | None) -> list:
    """Impulse that friction adds to gamma n, in the contact frame; the normal velocity is unchanged.

    A slip in space may turn while the contact is held. Friction against the slip at the end would be of first order, so
    it acts against the sum of that and the one in the beginning. The less it lacks to stop the slip, the less the
    latter counts, so that impulses are continuous from slipping to sticking.

    Args:
        k, gamma: scaled as in `_in_contact_frame`, like the result.
        slip: tangential velocity after gamma n [m/s].
        began: tangential velocity in the beginning [m/s]; None: where the slip keeps its direction, as in the plane.
    """
    stop = _stopping_impulse(k, slip)
    needed, bound = safe_sqrt(sum(P * P for P in stop[1:])), mu * (gamma + stop[0])
    sticks = needed <= bound
    if began is not None:
        at_end, first = jnp.stack(slip), jnp.stack(began)
        alike = safe_divide(jnp.maximum(dot(at_end, first), 0.0), norm(at_end) * norm(first))  # 0 where it turns back
        lacks = alike * jnp.clip(1.0 - safe_divide(bound, needed), 0.0, 1.0)
        slip = [s + lacks * s0 for s, s0 in zip(slip, began, strict=True)]
    # Where it sticks no slip is left, and it has no direction: another one slides there, without friction.
    slip, gamma = [jnp.where(sticks, 1.0, s) for s in slip], jnp.where(sticks, 0.0, gamma)
    slide = (_slide_in_plane if len(k) == 2 else _slide_in_space)(k, gamma, slip, mu)
    return [jnp.where(sticks, P, Q) for P, Q in zip(stop, slide, strict=True)]


def _slide_in_plane(k: list, gamma: Array, slip: list, mu: Array) -> list:
    """Friction impulse against a slip in the plane, which keeps its direction."""
    k_nt, bound = k[0][1], jnp.where(slip[0] < 0, mu, -mu)
    P_t = bound * safe_divide(gamma, 1.0 + bound * k_nt)
    return [-k_nt * P_t, P_t]


def _slide_in_space(k: list, gamma: Array, slip: list, mu: Array) -> list:
    """Friction impulse against what it leaves of a slip s in space.

    With A the mobility along the contact if the normal velocity is kept, P_t = -rho (I + rho A)^-1 s: with rho = 0
    there is no friction, and it sticks as rho grows. The unknown is x = 1 / (1 + rho a), a = tr(A) / 2, for which
    |P_t| = mu P_n; this equation is linear for a round body.
    """
    (_, *k_n), *rows = k
    A = jnp.stack([jnp.stack([row[j + 1] - row[0] * k_n[j] for j in range(2)]) for row in rows])
    a = 0.5 * (A[0, 0] + A[1, 1])
    A = safe_divide(A, a[None, None])
    s = jnp.stack(slip)
    stopped = jnp.stack([A[1, 1] * s[0] - A[0, 1] * s[1], A[0, 0] * s[1] - A[1, 0] * s[0]])  # adj(A) s
    sliding = Sliding(s, stopped, A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0], jnp.stack(k_n), a * gamma, mu)
    x = lax.stop_gradient(sliding).root()
    x = implicit_root(x, sliding.excess(x), sliding.slope(x))
    P = -safe_divide(1.0 - x, a * sliding.det_at(x))[None] * sliding.left(x)
    return [-dot(sliding.k_n, P), *P]


class Sliding(NamedTuple):
    """The equation for x of `_slide_in_space`, times a det_at(x)."""

    slip: Array  # (2, *batch) [m/s]
    stopped: Array  # (2, *batch) [m/s] adj(A / a) slip
    det: Array  # (*batch) [-] of A / a
    k_n: Array  # (2, *batch) [-] of the normal velocity by P_t
    gamma: Array  # (*batch) [m/s] a gamma
    mu: Array  # (*batch) [-]

    def left(self, x: Array) -> Array:
        """The slip that is left, times det_at(x), (2, *batch)."""
        return self.stopped + x[None] * (self.slip - self.stopped)

    def det_at(self, x: Array) -> Array:
        """Determinant of x I + (1 - x) A / a."""
        return 1.0 - (1.0 - x) ** 2 * (1.0 - self.det)

    def excess(self, x: Array) -> Array:
        """Of |P_t| over mu P_n: negative at x = 1, positive at x = 0."""
        left = self.left(x)
        return (1.0 - x) * (norm(left) - self.mu * dot(self.k_n, left)) - self.mu * self.gamma * self.det_at(x)

    def slope(self, x: Array) -> Array:
        """Derivative of `excess` by x."""
        left, turning = self.left(x), self.slip - self.stopped
        growing = safe_divide(dot(left, turning), norm(left)) - self.mu * dot(self.k_n, turning)
        falling = norm(left) - self.mu * dot(self.k_n, left)
        return (1.0 - x) * (growing - 2.0 * self.mu * self.gamma * (1.0 - self.det)) - falling

    def root(self) -> Array:
        """x of the sliding contact, (*batch), by Newton's method within a bracket that is halved where it fails."""

        def improved(_, now: tuple) -> tuple:
            low, high, x = now
            excess = self.excess(x)
            low, high = jnp.where(excess > 0, x, low), jnp.where(excess > 0, high, x)
            slope = self.slope(x)
            following = x - safe_divide(excess, slope)
            far = (slope >= 0) | (following < low - NEAR) | (following > high + NEAR)
            return low, high, jnp.where(far, 0.5 * (low + high), jnp.clip(following, low, high))

        zero = jnp.zeros_like(self.mu)
        first = 1.0 - safe_divide(self.mu * self.gamma, norm(self.slip))  # exact for a round body
        return lax.fori_loop(0, ROUNDS, improved, (zero, zero + 1.0, jnp.clip(first, 0.0, 1.0)))[2]


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
