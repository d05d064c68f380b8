"""Contacts that share a body, solved together: velocities that do not close, and impulses inside the friction cone.

With y the relative velocities at the contacts after all impulses P, k > 0 any number for each contact, and `allowed`
what Coulomb allows of an impulse,

    P = allowed(z),   z = P - (y - target n) / k,   y = v_rel + W P,   W = J G J^T

says at once that contacts do not pull, do not close, and slip only against all of their friction. It is solved by
Newton's method with the derivative D of `allowed`. Sticking makes (1 - D) + D W / k singular where contacts repeat
each other, as four corners on a floor do, so the method of multipliers is mixed in: D is taken (1 - e) D, with a
small e. Then B = 1 - (1 - e) D has an inverse contact by contact, and with u = G J^T dP, the change of the twists of
the bodies,

    (1 + G J^T B^-1 D J / k) u = G J^T B^-1 r,    dP = B^-1 (r - D J u / k)

so what is solved is as large as the bodies are many, and not the contacts.
Source: Alart & Curnier, Computer Methods in Applied Mechanics and Engineering 92 (1991) 353, for the equation;
Bertsekas, Constrained Optimization and Lagrange Multiplier Methods, 1982, for e.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world
from diffrigid.contact.cone import Cone, allowed, loaded, put, split, turning
from diffrigid.contact.mobility import Arms, Mobility, at_contacts, bodies_matrix, moved, twists
from diffrigid.contact.multipliers import solve_roughly
from diffrigid.gathers import fold
from diffrigid.linear import solve_regular
from diffrigid.numerics import FOUND, dot, norm, safe_divide
from diffrigid.pytree import array, pytree, replace, static

ROUNDS = 90  # at most, of Newton's method
CIRCLES = 10  # rounds after which `solve_roughly` gives it another start: the first time
ROUGH = 1e-2  # with this relative error, and then with as little as it can
PILE = 4  # bodies; with fewer it is enough to go back to the best, and the other method need not be compiled
SMOOTHING = 3  # rounds before the first Newton step, and after one that gained little
DOUBLES = 5  # Newton's rounds after which these are twice as many, where it does not get on
SMOOTHEST = 384  # of them at most
LITTLE = 0.9  # of the error before: a step that leaves more gained little
PATIENCE = 3  # rounds that do not halve the error: then a small one is rounding, and else the best is smoothed
# The power of the spacing of numbers that e is. A step leaves an error of relative size e / least eigenvalue of W / k,
# which for a tower is 1e-4 and less, and one of rounding / e.
SMALLNESS = 0.55
REFINEMENTS = 8  # of the linear system of the derivative


@pytree
class Slope:
    """D, the derivative of `allowed` at z, contact by contact, as numbers and directions."""

    on: Array = array("C")  # 1 where the contact pushes, else 0
    slides: Array = array("C")  # 1 where it does at its bound of friction
    bends: Array = array("C")  # [-] how far the direction of sliding follows z; 1 where it sticks
    normal: Array = array("C", "D")
    along: Array = array("C", "D")  # of the sliding
    mu: Array = array("C")
    free: Any = array("K", default=None)  # rows that turn: 1 where along the normal they are within their bounds
    spin: Any = array("K", default=None)  # [m] else how that follows the load
    small: float = static(default=0.0)  # e


def _excess(cone: Cone, P: Array, v_rel: Array, arms: Arms, mobility: Mobility) -> Array:
    """z, (C, D, *batch) [N s]."""
    y = v_rel + moved(P, arms, mobility)
    return P - (y - cone.target[:, None] * cone.normal) / cone.scale[:, None]


def _slope(cone: Cone, z: Array) -> Slope:
    """D at z."""
    z_n, z_t = split(cone.normal, z)
    size, bound = jax.vmap(norm)(z_t), cone.mu * jnp.maximum(z_n, 0.0)
    if cone.spin is not None:
        bound = loaded(cone, jnp.maximum(z_n, 0.0), z_n, bound)[1]
    follows = z_n > 0 if cone.most is None else jnp.where(jnp.isinf(cone.most), z_n > 0, jnp.abs(z_n) < cone.most)
    on, slides = jnp.where(follows, cone.on, 0.0), (size >= bound).astype(z.dtype)
    bends, along = jnp.where(size < bound, 1.0, safe_divide(bound, size)), z_t / jnp.where(size > 0, size, 1.0)[:, None]
    small = float(jnp.finfo(z.dtype).eps) ** SMALLNESS
    slope = Slope(on=on, slides=slides, bends=bends, normal=cone.normal, along=along, mu=cone.mu, small=small)
    if cone.spin is None:
        return slope
    load, about = jnp.maximum(z_n[: len(cone.spin)], 0.0), turning(cone.spin, z_n)
    free = (jnp.abs(about) < cone.spin * load).astype(z.dtype)
    on = put(cone.spin, on, turning(cone.spin, cone.on))
    return replace(slope, on=on, free=free, spin=(1.0 - free) * cone.spin * jnp.sign(about))


def _sloped(slope: Slope, r: Array) -> Array:
    """D r, (C, D, *batch)."""
    r_n, r_t = split(slope.normal, r)
    load = r_n
    if slope.spin is not None:
        load = put(slope.spin, r_n, (slope.on * r_n)[: len(slope.spin)])
        r_n = put(slope.spin, r_n, slope.free * turning(slope.spin, r_n) + slope.spin * turning(slope.spin, load))
    along = slope.slides * (slope.mu * load - slope.bends * jax.vmap(dot)(slope.along, r_t))
    return slope.on[:, None] * (r_n[:, None] * slope.normal + slope.bends[:, None] * r_t + along[:, None] * slope.along)


def _unsloped(slope: Slope, r: Array) -> tuple[Array, Array]:
    """B^-1 r and B^-1 D r, by components: normal, along the sliding, and across both."""
    r_n, r_t = split(slope.normal, r)
    r_along = slope.slides * jax.vmap(dot)(slope.along, r_t)
    r_across = r_t - r_along[:, None] * slope.along
    e, on = slope.small, slope.on
    kept = 1.0 - on * (1.0 - e)
    rest = 1.0 - on * (1.0 - e) * slope.bends  # e where it sticks
    if slope.spin is not None:
        kept = put(slope.spin, kept, 1.0 - turning(slope.spin, on) * slope.free * (1.0 - e))
        return _unsloped_rows(slope, r_n / kept, r_along, r_across, rest)
    drag = slope.slides * slope.mu * r_n / kept * on
    B_r = (r_n / kept)[:, None] * slope.normal + r_across / rest[:, None]
    BD_r = (on * r_n / kept)[:, None] * slope.normal + (on * slope.bends / rest)[:, None] * r_across
    return B_r + (r_along + (1.0 - e) * drag)[:, None] * slope.along, BD_r + drag[:, None] * slope.along


def _unsloped_rows(slope: Slope, x_n: Array, r_along: Array, r_across: Array, rest: Array):
    """The same where rows turn: what loads them is the first of the results, at their contacts.

    Args:
        x_n: normal components of B^-1 r but for what rows get from their load.
    """
    e, on, count = slope.small, slope.on, len(slope.spin)
    load = put(slope.spin, x_n, (on * x_n)[:count])
    more = put(slope.spin, jnp.zeros_like(x_n), slope.spin * turning(slope.spin, on * load))
    own = put(slope.spin, on, turning(slope.spin, on) * slope.free) * x_n
    drag = on * slope.slides * slope.mu * load
    B_r = (x_n + (1.0 - e) * more)[:, None] * slope.normal + r_across / rest[:, None]
    BD_r = (own + more)[:, None] * slope.normal + (on * slope.bends / rest)[:, None] * r_across
    return B_r + (r_along + (1.0 - e) * drag)[:, None] * slope.along, BD_r + drag[:, None] * slope.along


def _answer(slope: Slope, cone: Cone) -> Callable[[Array], Array]:
    """B^-1 D / k: impulses for relative velocities, (C, D, *batch)."""
    return lambda y: _unsloped(slope, y / cone.scale[:, None])[1]


def _pushed_back(slope: Slope, cone: Cone, arms: Arms, twist: Array) -> Array:
    """B^-1 D J / k of the twists (C, *batch) of all bodies: impulses, (C, D, *batch)."""
    return _answer(slope, cone)(at_contacts(arms, twist))


def _newton_step(r: Array, matrix: Array, slope: Slope, cone: Cone, arms: Arms, mobility: Mobility) -> Array:
    """dP of (B + D W / k) dP = r, (C, D, *batch); the matrix is that of the twists."""
    direct = _unsloped(slope, r)[0]
    return direct - _pushed_back(slope, cone, arms, solve_regular(matrix, twists(direct, arms, mobility)))


class Search(NamedTuple):
    """How far Newton's method has come in every world of a batch."""

    count: Any  # int: rounds
    P: Array  # (C, D, *batch) [N s]
    z: Array  # its `_excess`
    r: Array  # what is missing: allowed(z) - P
    best: Array  # of all P
    error: Array  # (*batch) [m/s] of the best
    since: Array  # (*batch) int: rounds since the error was halved
    mark: Array  # (*batch) [m/s] error then


@jax.custom_jvp
def solve_together(shared: Array, cone: Cone, v_rel: Array, guess: Array, arms: Arms, mobility: Mobility) -> Array:
    """Impulses of all contacts that take part, (C, D, *batch) [N s]; zero for the others.

    Args:
        shared: bool: there is such a contact in some world of the batch.
        v_rel: (C, D, *batch) [m/s] before the impulses.
        guess: (C, D, *batch) [N s] impulses to begin with.
    """

    def solved(guess):
        P = _smoothed(guess, SMOOTHING, cone, v_rel, arms, mobility)
        z, r = _missing(P, cone, v_rel, arms, mobility)
        error = _speed(cone, r)
        start = Search(0, P, z, r, P, error, jnp.zeros_like(error, np.int32), error)
        again = functools.partial(_again, given=(cone, v_rel, arms, mobility))
        return lax.while_loop(lambda now: (now.count < ROUNDS) & any_world(_lacks(cone, now)), again, start).best

    return lax.cond(shared, solved, jnp.zeros_like, guess)


def _again(now: Search, given: tuple[Cone, Array, Arms, Mobility]) -> Search:
    """A Newton step, from which P is brought back into the cones.

    Where that gains little, half of the step is tried too, and the better of both made smoother; where that does not
    help, it is the best P that is made smoother, and more so the longer it takes. Else P may go round in circles.
    """
    cone, v_rel, arms, mobility = given
    slope = _slope(cone, now.z)
    matrix = bodies_matrix(_answer(slope, cone), arms, mobility)
    dP = _newton_step(now.r, matrix, slope, cone, arms, mobility)
    P, since = allowed(cone, now.P + dP), now.since
    z, r = _missing(P, *given)

    lost = _lacks(cone, now) & (now.since >= PATIENCE)
    rounds = jnp.where(any_world(lost), SMOOTHING << (now.count // DOUBLES), SMOOTHING)

    def smoothed(P, _, r):
        half = allowed(cone, now.P + 0.5 * dP)
        nearer = _speed(cone, _missing(half, *given)[1]) < _speed(cone, r)
        before = jnp.where(now.since == PATIENCE, now.best, now.P)
        P = jnp.where(now.since >= PATIENCE, before, jnp.where(nearer[None, None], half, P))
        P = _smoothed(P, jnp.minimum(rounds, SMOOTHEST), *given)
        return P, *_missing(P, *given)

    poor = _lacks(cone, now) & (_speed(cone, r) > LITTLE * now.error)
    P, z, r = lax.cond(any_world(poor), smoothed, lambda *kept: kept, P, z, r)
    if mobility.inverse_mass.shape[0] >= PILE:
        circles = (now.count > 0) & (now.count % CIRCLES == 0) & any_world(_circles(cone, now))
        P, z, r, since = lax.cond(
            circles, functools.partial(_elsewhere, now, given), lambda *kept: kept, P, z, r, since
        )
    size = _speed(cone, r)
    best, halved = jnp.where((size < now.error)[None, None], P, now.best), size < 0.5 * now.mark
    since, mark = jnp.where(halved, 0, since + 1), jnp.where(halved, size, now.mark)
    return Search(now.count + 1, P, z, r, best, jnp.minimum(size, now.error), since, mark)


def _elsewhere(now: Search, given: tuple[Cone, Array, Arms, Mobility], P: Array, z: Array, r: Array, since: Array):
    """Another start, by the method of multipliers, in worlds that go round in circles."""
    cone, lost = given[0], _circles(given[0], now)

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


def _lacks(cone: Cone, now: Search) -> Array:
    """Whether the best is not yet as good as rounding allows, (*batch) bool: the longer it takes, the less is asked."""
    rounding = jnp.finfo(now.P.dtype).eps
    small = jnp.where(now.since < 5 * PATIENCE, rounding**0.6, jnp.inf)
    small = jnp.where(now.since < 2 * PATIENCE, rounding**0.75, small)
    small = jnp.where(now.since < PATIENCE, 16.0 * rounding, small)
    return now.error > small * _speed(cone, now.best) + _least(cone)


def _circles(cone: Cone, now: Search) -> Array:
    """Whether the error of the best is more than of rounding, (*batch) bool."""
    return now.error > 3.0 * jnp.finfo(now.P.dtype).eps ** 0.5 * _speed(cone, now.best) + _least(cone)


@solve_together.defjvp
def _solve_together_jvp(primals, tangents):
    """(1 - D + D W / k) dP = what the parameters change of `allowed(z)` at fixed P."""
    shared, cone, v_rel, _, arms, mobility = primals
    P = checkpoint_name(solve_together(*primals), FOUND)

    def projected(cone, v_rel, arms, mobility):
        return allowed(cone, _excess(cone, P, v_rel, arms, mobility))

    of, by = ((cone, v_rel, arms, mobility) for _, cone, v_rel, _, arms, mobility in (primals, tangents))
    change = jax.jvp(projected, of, by)[1]
    slope = lax.stop_gradient(_slope(cone, _excess(cone, P, v_rel, arms, mobility)))
    fixed = lax.stop_gradient((slope, cone, arms, mobility))

    def linear(x):
        return x - _sloped(slope, x - moved(x, arms, mobility) / cone.scale[:, None])

    def refined(system, b, transposed):
        matrix = bodies_matrix(_answer(*fixed[:2]), *fixed[2:])

        def step(r):
            return _newton_step(r, matrix, *fixed)

        approximate = (lambda r: jax.linear_transpose(step, b)(r)[0]) if transposed else step
        return lax.fori_loop(0, REFINEMENTS, lambda _, x: x + approximate(b - system(x)), jnp.zeros_like(b))

    def solve(system, b, transposed=False):
        return lax.cond(shared, lambda b: refined(system, b, transposed), jnp.zeros_like, b)

    return P, lax.custom_linear_solve(linear, change, solve, transpose_solve=functools.partial(solve, transposed=True))
