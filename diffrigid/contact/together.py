"""Contacts that share a body, solved together: velocities that do not close, and impulses inside the friction cone.

With y the relative velocities at the contacts after all impulses P, k > 0 any number for each contact, and `allowed`
what Coulomb allows of an impulse,

    P = allowed(z),   z = P - (y - target n) / k,   y = v_rel + W P,   W = J G J^T

says at once that contacts do not pull, do not close, and slip only against all of their friction. Where contacts repeat
each other, as four corners on a floor do, many P do. One of them is chosen by a small compliance e, which asks for the
least impulses (those nearest to a guess):

    z = P - e (P - rest) - (y - target n) / k,   rest: first the guess, then the P that this leads to

The second P is as if nothing yielded, to the order of e^2. It is solved by Newton's method (`slope.py`), for both.
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

ROUNDS = 90  # at most, of Newton's method
CIRCLES = 10  # rounds after which `solve_roughly` gives it another start: the first time
ROUGH = 1e-2  # with this relative error, and then with as little as it can
PILE = 4  # bodies; with fewer the guess is near enough, it suffices to go back to the best, and less is compiled
SMOOTHING = 3  # rounds before the first Newton step, in piles, and after one that gained little
DOUBLES = 5  # Newton's rounds after which these are twice as many, where it does not get on
SMOOTHEST = 384  # of them at most
LITTLE = 0.9  # of the error before: a step that leaves more gained little
PATIENCE = 3  # rounds that do not halve the error: then a small one is rounding, and else the best is smoothed
# e: in double precision what leaves e^2 below rounding, in single precision what its own inverse allows.
COMPLIANCE, ROUNDINGS = 1.5e-8, 100.0
REFINEMENTS = 4  # of the linear system of the derivative


def _excess(cone: Cone, P: Array, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """z, (C, D, *batch) [N s]."""
    y = v_rel + moved(P, arms, mobility)
    return (1.0 - _compliance(P)) * P - (y - cone.target[:, None] * cone.normal) / cone.scale[:, None]


def _compliance(P: Array) -> float:
    """e [-], what a contact yields to as a share of k P."""
    return max(COMPLIANCE, ROUNDINGS * float(jnp.finfo(P.dtype).eps))


def _yielded(cone: Cone, P: Array) -> Array:
    """Velocities (C, D, *batch) [m/s] to which compliance yields."""
    return _compliance(P) * cone.scale[:, None] * P


class Newton(NamedTuple):
    """How far Newton's method has come in every world of a batch."""

    count: Any  # int: rounds
    rigid: Array  # (*batch) bool: the compliant solution is found, and nothing yields any more
    rest: Array  # (C, D, *batch) [N s] impulses at which nothing is yielded to: the guess, and then that solution
    tried: Array  # (*batch) bool: a step from here left the cones of contacts, so that another is tried
    at: Array  # (C, D, *batch) [N s] where `allowed` is linearised: z, or where that step left a cone
    P: Array  # (C, D, *batch) [N s]
    z: Array  # its `_excess`
    r: Array  # what P lacks: allowed(z) - P, linearised at `at`
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
    """Of `solve_together`, and of what is compliant."""

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
    """A Newton step, from which P is brought back into the cones.

    Where it gains little
        because contacts leave their cones: the step is taken again, these contacts linearised where it led them;
        otherwise: half of the step is tried too, and the better of both smoothed;
        again: the best P so far is smoothed, by more rounds the longer it takes;
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

    stays = _lacks(cone, now) & (now.since >= PATIENCE)
    rounds = jnp.where(any_world(stays), SMOOTHING << (now.count // DOUBLES), SMOOTHING)

    def smoothed(P, _, r):
        half = allowed(cone, now.P + 0.5 * dP)
        nearer = _speed(cone, _missing(half, *given)[1]) < _speed(cone, r)
        before = jnp.where(now.since == PATIENCE, now.best, now.P)
        P = jnp.where(now.since >= PATIENCE, before, jnp.where(nearer[None, None], half, P))
        P = _smoothed(P, jnp.minimum(rounds, SMOOTHEST), *given)
        return P, *_missing(P, *given)

    poor = _lacks(cone, now) & (_speed(cone, r) > LITTLE * now.error)
    again = poor & leaves.any(0) & ~now.tried
    strays = (now.error <= _compliance(P) * _speed(cone, now.best)) & (now.since < PATIENCE)
    P, z, r = lax.cond(any_world(poor & ~again & ~strays), smoothed, lambda *kept: kept, P, z, r)
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


def _yields(cone: Cone, now: Newton) -> Array:
    """Whether the compliant solution is found, and yields to more than rounding, (*batch) bool."""
    found = ~now.rigid & ~_lacks(cone, now) & (_speed(cone, now.r) <= now.error)
    yielded = _compliance(now.P) * _speed(cone, now.P - now.rest)
    return found & (yielded > 16.0 * jnp.finfo(now.P.dtype).eps * _speed(cone, now.P) + _least(cone))


def _made_rigid(cone: Cone, now: Newton) -> Newton:
    """Where what yields is found, nothing yields any more: the solution then is next to it."""
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
    """Another start, by the method of multipliers, in worlds that are `lost`."""
    cone = given[0]

    def wrong(P):
        return _speed(cone, _missing(P, *given)[1])

    share = jnp.where(now.count > CIRCLES, 0.0, ROUGH).astype(P.dtype)
    enough = jnp.where(lost, share * _speed(cone, now.best) + _least(cone), jnp.inf)
    P = jnp.where(lost[None, None], solve_roughly(*given, wrong, enough), P)
    return P, *_missing(P, *given), jnp.where(lost, 0, since)


def _missing(P: Array, cone: Cone, v_rel: Array, arms: Arms, mobility: Mobility) -> tuple[Array, Array]:
    """z, and what P lacks to be what is allowed of it; (C, D, *batch) [N s]."""
    z = _excess(cone, P, v_rel, arms, mobility)
    return z, allowed(cone, z) - P


def _smoothed(P: Array, rounds: Any, cone: Cone, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """After rounds in which each contact takes a share of the masses of its bodies (Tonge et al. 2012).

    They go on in the direction of the round before (Nesterov 1983), unless that leads back (O'Donoghue & Candes 2015).
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
    """The largest change of velocity by impulses at their contacts, (*batch) [m/s]."""
    return jnp.max(cone.scale * fold(jnp.maximum, jnp.abs(P), 1), 0)


def _least(cone: Cone) -> Array:
    """An error that is none, (*batch) [m/s]."""
    return jnp.finfo(cone.scale.dtype).eps ** 0.6 * cone.rest_speed


def _lacks(cone: Cone, now: Newton) -> Array:
    """Whether the best is not yet as good as rounding allows, (*batch) bool: the longer it takes, the less is asked.

    Beside the compliant solution another one is soon found, or not at all.
    """
    rounding = jnp.finfo(now.P.dtype).eps
    first = rounding * jnp.where(now.rigid, 16.0, 1e3)
    small = jnp.where(~now.rigid & (now.since < 5 * PATIENCE), jnp.maximum(rounding**0.6, first), jnp.inf)
    small = jnp.where(~now.rigid & (now.since < 2 * PATIENCE), jnp.maximum(rounding**0.75, first), small)
    small = jnp.where(now.since < PATIENCE, first, small)
    return now.error > small * _speed(cone, now.best) + _least(cone)


def _circles(cone: Cone, now: Newton) -> Array:
    """Whether the error of the best is more than of rounding, (*batch) bool."""
    return now.error > 3.0 * jnp.finfo(now.P.dtype).eps ** 0.5 * _speed(cone, now.best) + _least(cone)


@_solutions.defjvp
def _solutions_jvp(primals, tangents):
    """With A = 1 - D ((1 - e) - W / k): A dP_1 = change of the compliant one, A dP = change + e D dP_1."""
    shared, cone, v_rel, guess, arms, mobility = primals
    P, compliant = checkpoint_name(_solutions(*primals), FOUND)
    e = _compliance(P)
    yielding = _excess(cone, compliant, v_rel, arms, mobility) + e * guess
    z = _excess(cone, P, v_rel, arms, mobility) + e * compliant
    # What creeps, or lets go, by as much as it yields does so in the limit too, where z is on the bound.
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
