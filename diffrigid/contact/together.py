"""Contacts that share a body, solved together: velocities that do not close, and impulses inside the friction cone.

With y the relative velocities at the contacts after all impulses P, k > 0 any number for each contact, and `allowed`
the part of an impulse that Coulomb's law allows,

    P = allowed(z),   z = P - (y - target n) / k,   y = v_rel + W P,   W = J G J^T

states at once that contacts do not pull, do not close, and slip only against their full friction. Where contacts are
redundant, like four corners on a floor, many P satisfy it. A small compliance e selects one of them, with the least
impulses (those nearest to a guess):

    z = P - e (P - rest) - (y - target n) / k,   rest: first the guess, then the P that this leads to

The second P is that of rigid contacts, to the order of e^2. Both are found by Newton's method (`slope.py`).
Source: Alart & Curnier, Computer Methods in Applied Mechanics and Engineering 92 (1991) 353, for the equation;
Rockafellar, SIAM J. Control and Optimization 14 (1976) 877, for `rest`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world, choose
from diffrigid.contact.cone import Cone, allowed, split
from diffrigid.contact.mobility import Arms, Mobility, bodies_matrix, moved
from diffrigid.contact.multipliers import solve_roughly
from diffrigid.contact.slope import answer, newton_step, slope_at, sloped
from diffrigid.gathers import fold
from diffrigid.numerics import FOUND, safe_divide

ROUNDS = 90  # of Newton's method, at most
CIRCLES = 10  # rounds after which, each time, `solve_roughly` gives it another start: the first one
ROUGH = 1e-2  # with this relative error, later ones with the least that it reaches
PILE = 4  # bodies; with fewer the guess is near enough, it suffices to go back to the best, and less is compiled
SMOOTHING = 3  # rounds before the first Newton step, in piles, and after one that gained little
DOUBLES = 5  # Newton rounds after which the smoothing rounds are doubled, where it makes no progress
SMOOTHEST = 384  # smoothing rounds, at most
LITTLE = 0.9  # [-] of the error before: a step that leaves more gained little
PATIENCE = 3  # rounds without halving the error: then a small one is rounding, and else the best is smoothed
# e: in double precision such that e^2 is below rounding, in single precision as small as its inverse allows.
COMPLIANCE, ROUNDINGS = 1.5e-8, 100.0
REFINEMENTS = 4  # iterative ones, of the linear system of the derivative


def _excess(cone: Cone, P: Array, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """z without its term e rest, (C, D, *batch) [N s]."""
    y = v_rel + moved(P, arms, mobility)
    return (1.0 - _compliance(P)) * P - (y - cone.target[:, None] * cone.normal) / cone.scale[:, None]


def _compliance(P: Array) -> float:
    """Compliance e [-]: a contact yields to P with the velocity e k P."""
    return max(COMPLIANCE, ROUNDINGS * float(jnp.finfo(P.dtype).eps))


def _yielded(cone: Cone, P: Array) -> Array:
    """Velocities e k P with which compliant contacts yield to P, (C, D, *batch) [m/s]."""
    return _compliance(P) * cone.scale[:, None] * P


class Newton(NamedTuple):
    """State of Newton's method in every world of a batch."""

    count: Any  # int: rounds
    rigid: Array  # (*batch) bool: the compliant solution is found, and the rigid one is being solved
    rest: Array  # (C, D, *batch) [N s] impulses at which contacts do not yield: the guess, then the compliant solution
    tried: Array  # (*batch) bool: a step from here left the cones of contacts, so that another one is tried
    at: Array  # (C, D, *batch) [N s] where `allowed` is linearised: z, or where that step left a cone
    P: Array  # (C, D, *batch) [N s]
    z: Array  # its `_excess`
    r: Array  # residual allowed(z) - P, linearised at `at`
    best: Array  # of all P
    error: Array  # (*batch) [m/s] of the best
    since: Array  # (*batch) int: rounds since the error was halved
    mark: Array  # (*batch) [m/s] error then


def solve_together(shared: Array, cone: Cone, v_rel: Array, guess: Array, arms: Arms, mobility: Mobility) -> Array:
    """Impulses of all contacts that take part, (C, D, *batch) [N s]; zero for the others.

    Args:
        shared: bool: there is such a contact in some world of the batch.
        v_rel: (C, D, *batch) [m/s] before the impulses.
        guess: (C, D, *batch) [N s] impulses to begin with; of many solutions the one near to it is taken.
    """
    return _solutions(shared, cone, v_rel, guess, arms, mobility)[0]


@jax.custom_jvp
def _solutions(
    shared: Array, cone: Cone, v_rel: Array, guess: Array, arms: Arms, mobility: Mobility
) -> tuple[Array, Array]:
    """Impulses of rigid and of compliant contacts, each (C, D, *batch) [N s]; see `solve_together`."""

    def solved(guess):
        at_guess = cone, v_rel - _yielded(cone, guess), arms, mobility
        P = guess if len(mobility.inverse_mass) < PILE else _smoothed(guess, SMOOTHING, *at_guess)
        z, r = _missing(P, *at_guess)
        error = _speed(cone, r)
        no = error < 0
        start = Newton(0, no, guess, no, z, P, z, r, P, error, jnp.zeros_like(error, np.int32), error)

        def again(now):
            now = _made_rigid(cone, now)
            return _again(now, (cone, v_rel - _yielded(cone, now.rest), arms, mobility))

        def goes_on(now):
            return (now.count < ROUNDS) & any_world(_lacks(cone, now) | _yields(cone, now))

        end = lax.while_loop(goes_on, again, start)
        return end.best, jnp.where(end.rigid[None, None], end.rest, end.best)

    return lax.cond(shared, solved, lambda guess: (jnp.zeros_like(guess),) * 2, guess)


def _again(now: Newton, given: tuple[Cone, Array, Arms, Mobility]) -> Newton:
    """Take a Newton step, and bring P back into the cones.

    Where it gains little
        because contacts leave their cones: the step is repeated, with these contacts linearised where it led them;
        otherwise: half of the step is tried too, and the better of both is smoothed;
        repeatedly: the best P so far is smoothed, by more rounds the longer it takes;
        for long, among four bodies or more: P may go round in circles, and another method gives it a new start.
    """
    cone, v_rel, arms, mobility = given
    slope = slope_at(cone, now.at, _compliance(now.P))
    matrix = bodies_matrix(answer(slope, cone), arms, mobility)
    dP = newton_step(now.r, matrix, slope, cone, arms, mobility)
    to, since = now.P + dP, now.since
    P = allowed(cone, to)
    leaves = (P != to).any(1) & ((slope.slides == 0) | (split(cone.normal, to)[0] < 0))
    z, r = _missing(P, *given)

    poor = _lacks(cone, now) & (_speed(cone, r) > LITTLE * now.error)
    again = poor & leaves.any(0) & ~now.tried
    strays = (now.error <= _compliance(P) * _speed(cone, now.best)) & (now.since < PATIENCE)
    improved = functools.partial(_improved, now, given, dP)
    P, z, r = lax.cond(any_world(poor & ~again & ~strays), improved, lambda *kept: kept, P, z, r)
    P, z, r = (jnp.where(again[None, None], old, new) for old, new in ((now.P, P), (now.z, z), (now.r, r)))
    if mobility.inverse_mass.shape[0] >= PILE:
        lost = (now.count > 0) & (now.count % CIRCLES == 0) & _circles(cone, now) & ~again
        P, z, r, since = lax.cond(
            any_world(lost), functools.partial(_elsewhere, now, given, lost), lambda *kept: kept, P, z, r, since
        )
    size = _speed(cone, r)
    best, halved = jnp.where((size < now.error)[None, None], P, now.best), size < 0.5 * now.mark
    since = jnp.where(halved, 0, jnp.where(again, since, since + 1))
    mark = jnp.where(halved, size, now.mark)

    def beyond(z, r):
        left = (again[None] & leaves)[:, None]
        along = allowed(cone, to) + sloped(slope_at(cone, to, _compliance(P)), z - to) - P
        return jnp.where(left, to, z), jnp.where(left, along, r)

    at, r = lax.cond(any_world(again), beyond, lambda z, r: (z, r), z, r)
    return Newton(
        now.count + 1, now.rigid, now.rest, again, at, P, z, r, best, jnp.minimum(size, now.error), since, mark
    )  # fmt: skip


def _improved(
    now: Newton, given: tuple[Cone, Array, Arms, Mobility], dP: Array, P: Array, z: Array, r: Array
) -> tuple[Array, Array, Array]:
    """Smooth the better of a whole step and half of it; without progress, the best so far."""
    del z
    cone = given[0]
    stays = _lacks(cone, now) & (now.since >= PATIENCE)
    rounds = jnp.where(any_world(stays), SMOOTHING << (now.count // DOUBLES), SMOOTHING)
    half = allowed(cone, now.P + 0.5 * dP)
    nearer = _speed(cone, _missing(half, *given)[1]) < _speed(cone, r)
    before = jnp.where(now.since == PATIENCE, now.best, now.P)
    P = jnp.where(now.since >= PATIENCE, before, jnp.where(nearer[None, None], half, P))
    P = _smoothed(P, jnp.minimum(rounds, SMOOTHEST), *given)
    return P, *_missing(P, *given)


def _yields(cone: Cone, now: Newton) -> Array:
    """Whether the compliant solution is found, and yields by more than rounding, (*batch) bool."""
    found = ~now.rigid & ~_lacks(cone, now) & (_speed(cone, now.r) <= now.error)
    yielded = _compliance(now.P) * _speed(cone, now.P - now.rest)
    return found & (yielded > 16.0 * jnp.finfo(now.P.dtype).eps * _speed(cone, now.P) + _least(cone))


def _made_rigid(cone: Cone, now: Newton) -> Newton:
    """Make contacts rigid where the compliant solution is found; the rigid solution is close to it."""
    found = _yields(cone, now)

    def rigid(now: Newton) -> Newton:
        z = now.z + _compliance(now.P) * (now.P - now.rest)
        r = allowed(cone, z) - now.P
        error, none = _speed(cone, r), jnp.zeros_like(now.since)
        after = now._replace(rigid=found, rest=now.P, at=z, z=z, r=r, error=error, since=none, mark=error)
        return choose(found, after, now)

    return lax.cond(any_world(found), rigid, lambda now: now, now)


def _elsewhere(
    now: Newton, given: tuple[Cone, Array, Arms, Mobility], lost: Array, P: Array, z: Array, r: Array, since: Array
) -> tuple[Array, Array, Array, Array]:
    """Restart the worlds that are `lost` from the method of multipliers."""
    cone = given[0]

    def wrong(P):
        return _speed(cone, _missing(P, *given)[1])

    share = jnp.where(now.count > CIRCLES, 0.0, ROUGH).astype(P.dtype)
    enough = jnp.where(lost, share * _speed(cone, now.best) + _least(cone), jnp.inf)
    P = jnp.where(lost[None, None], solve_roughly(*given, wrong, enough), P)
    return P, *_missing(P, *given), jnp.where(lost, 0, since)


def _missing(P: Array, cone: Cone, v_rel: Array, arms: Arms, mobility: Mobility) -> tuple[Array, Array]:
    """z and the residual allowed(z) - P, (C, D, *batch) [N s]."""
    z = _excess(cone, P, v_rel, arms, mobility)
    return z, allowed(cone, z) - P


def _smoothed(P: Array, rounds: Any, cone: Cone, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """P after smoothing rounds (projected Jacobi; each body's mass is split among its contacts, Tonge et al. 2012).

    Rounds are accelerated by momentum (Nesterov 1983), which restarts where it leads back (O'Donoghue & Candes 2015).
    """

    def smoother(_, carry):
        P, ahead, t = carry
        z = _excess(cone, ahead, v_rel, arms, mobility)
        new = allowed(cone, ahead + (z - ahead) / cone.sharing[:, None])
        step = new - P
        back = (cone.scale * ((ahead - new) * step).sum(1)).sum(0) > 0
        following = 0.5 * (1.0 + jnp.sqrt(1.0 + 4.0 * t * t))
        onward = jnp.where(back, 0.0, (t - 1.0) / following)
        return new, new + onward[None, None] * step, jnp.where(back, 1.0, following)

    return lax.fori_loop(0, rounds, smoother, (P, P, jnp.ones_like(P[0, 0])))[0]


def _speed(cone: Cone, P: Array) -> Array:
    """Largest change of velocity k P by impulses at their own contacts, (*batch) [m/s]."""
    return jnp.max(cone.scale * fold(jnp.maximum, jnp.abs(P), 1), 0)


def _least(cone: Cone) -> Array:
    """Error that counts as none, (*batch) [m/s]."""
    return jnp.finfo(cone.scale.dtype).eps ** 0.6 * cone.rest_speed


def _lacks(cone: Cone, now: Newton) -> Array:
    """Whether the best is not yet as good as required, (*batch) bool: rounding at first, less the longer it takes.

    Near the compliant solution the rigid one is found soon, or not at all.
    """
    rounding = jnp.finfo(now.P.dtype).eps
    first = rounding * jnp.where(now.rigid, 16.0, 1e3)
    small = jnp.where(~now.rigid & (now.since < 5 * PATIENCE), jnp.maximum(rounding**0.6, first), jnp.inf)
    small = jnp.where(~now.rigid & (now.since < 2 * PATIENCE), jnp.maximum(rounding**0.75, first), small)
    small = jnp.where(now.since < PATIENCE, first, small)
    return now.error > small * _speed(cone, now.best) + _least(cone)


def _circles(cone: Cone, now: Newton) -> Array:
    """Whether the error of the best is larger than that of rounding, (*batch) bool."""
    return now.error > 3.0 * jnp.finfo(now.P.dtype).eps ** 0.5 * _speed(cone, now.best) + _least(cone)


@_solutions.defjvp
def _solutions_jvp(primals, tangents):
    """A dP_1 = change of the compliant solution P_1, A dP = change + e D dP_1; A = 1 - D ((1 - e) - W / k)."""
    shared, cone, v_rel, guess, arms, mobility = primals
    P, compliant = checkpoint_name(_solutions(*primals), FOUND)
    e = _compliance(P)
    yielding = _excess(cone, compliant, v_rel, arms, mobility) + e * guess
    z = _excess(cone, P, v_rel, arms, mobility) + e * compliant
    # A contact that slips, or separates, by as much as it yields does so in the limit too, where z is on the bound.
    slope, before = slope_at(cone, z, e), slope_at(cone, yielding, e)
    differs = (slope.on != before.on) | (slope.slides != before.slides)
    at = jnp.where(differs[:, None], yielding, z)
    aside = lax.stop_gradient(at - z)

    def projected(cone, v_rel, arms, mobility):
        return allowed(cone, _excess(cone, P, v_rel, arms, mobility) + e * compliant + aside)

    of, by = ((cone, v_rel, arms, mobility) for _, cone, v_rel, _, arms, mobility in (primals, tangents))
    change = jax.jvp(projected, of, by)[1]
    slope = lax.stop_gradient(slope_at(cone, at, e))
    fixed = lax.stop_gradient((slope, cone, arms, mobility))
    by_scale = (safe_divide(tangents[1].scale, cone.scale))[:, None] * lax.stop_gradient(e * (compliant - guess))

    def linear(both):
        def A(x):
            return x - sloped(slope, (1.0 - e) * x - moved(x, arms, mobility) / cone.scale[:, None])

        return jnp.stack([A(both[0]), A(both[1]) - e * sloped(slope, both[0])])

    def refined(system, b, transposed):
        matrix = bodies_matrix(answer(*fixed[:2]), *fixed[2:])

        def step(r):
            return jax.vmap(lambda r: newton_step(r, matrix, *fixed))(r)

        approximate = (lambda r: jax.linear_transpose(step, b)(r)[0]) if transposed else step
        return lax.fori_loop(0, REFINEMENTS, lambda _, x: x + approximate(b - system(x)), jnp.zeros_like(b))

    def solve(system, b, transposed=False):
        return lax.cond(shared, lambda b: refined(system, b, transposed), jnp.zeros_like, b)

    both = jnp.stack([change - sloped(slope, by_scale), change])
    dP = lax.custom_linear_solve(linear, both, solve, transpose_solve=functools.partial(solve, transposed=True))
    return (P, compliant), (dP[1], dP[0])
