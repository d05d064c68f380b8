"""When any two shapes meet: conservative advancement towards the first contact, then the parabola of its gap.

Searched without derivatives; `impact.py` gives the time that is found that of the implicit function theorem.
Each pair of each world goes through three stages. The gaps are most of the program, so that all stages are one loop;
but above a half-space, where gaps are little, a batch is faster with a loop for each.

    ADVANCING    by what no contact can close earlier, until one is near and closing, or the step is over
    NEARING      towards the closest approach of the two paths, which sets the level of a smooth impact
    POLISHING    along the parabola of the gap, to where it is at its level

Source: Mirtich, Impulse-based Dynamic Simulation of Rigid Body Systems (1996), for the advancement.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world, choose, opaque_true
from diffrigid.collide.heights import height_over, unseen_for
from diffrigid.contact.gaps import NEAR, Gaps, gaps_at
from diffrigid.contact.sides import Side, centre, earliest, reach_of
from diffrigid.gathers import MANY, fold
from diffrigid.numerics import FOUND, norm, safe_divide, safe_sqrt, softplus
from diffrigid.shapes import HalfSpace, HeightField
from diffrigid.state import rotations

CROSSED = 3  # advances for each node along a side of a grid: the length of its diagonal in half cells
ADVANCES = 48  # conservative advances at most, each at least the gap over a bound on the closing speed
POLISH = 6  # steps along the local parabola of the gap; error squared by each
TURN = 3  # evaluations for one step towards the closest approach, of which there are no more than POLISH
ROUNDING = 1e5  # [-] of the last digit of NEAR: how far rounding of their places may hold bodies apart
ADVANCING, NEARING, POLISHING, DONE = range(4)


class Task(NamedTuple):
    """What is searched: the first impact of two colliders from `start` to t1."""

    a: Side
    b: Side
    start: Array  # (*batch) [s]
    t1: Array  # (*batch) [s]
    size: Array  # (*batch) [m] the smaller reach
    slow: Array  # (*batch) [m/s] contacts that close no faster rest
    width: Array | None  # (*batch) [m] None: exact

    @property
    def span(self) -> Array:
        """(*batch) [s]"""
        return self.t1 - self.start

    @property
    def slack(self) -> Array:
        """What is small beside 1: the root of rounding."""
        return jnp.sqrt(jnp.finfo(self.t1.dtype).eps)


class Closest(NamedTuple):
    """The closest approach, of the contact with the least gap."""

    t: Array  # (*batch) [s]
    chosen: Array  # (K, *batch) 1 for that contact, else 0
    gap: Array  # (*batch) [m] at t
    rate: Array  # (*batch) [m/s] at t
    before: Array  # (*batch) [m/s] a quarter of the step before


class Search(NamedTuple):
    """How far it has come."""

    count: Any  # int: evaluations
    stage: Array  # (*batch) int
    tries: Array  # (*batch) int: evaluations in this stage
    s: Array  # (*batch) [s] of the next evaluation; at last where they meet
    rests: Array  # (K, *batch) bool: contacts that rest, which are left out
    near: Array  # (*batch) [s] where the advances ended
    found: Array  # (*batch) bool: some contact is at its level
    inside: Array  # (*batch) bool: some contact was within its level and closing when the advances ended
    level: Array  # (*batch) [m]
    closest: Closest | None


def approach_search(
    a: Side, b: Side, t1: Array, width: Array | None, rest_speed: Array, at_end: Array
) -> tuple[Array, Array, Array, Array]:
    """Any two shapes: time of the next impact, level of the gap then, whether there is one, which contacts rest.

    Nothing is looked for `at_end`, a bool. Only the level has a gradient.
    """
    task = lax.stop_gradient(_task(a, b, t1, width, rest_speed))  # else the loop would carry tangents in vain
    live, follow = opaque_true(t1), _follower(task)
    start = jnp.where(at_end, task.t1, task.start)

    def again(stages: range, now: Search) -> Search:
        return follow(stages, now, gaps_at(task.a, task.b, now.s, live))

    def busy(stages: range, now: Search) -> Array:
        return ~at_end & any_world(now.stage < stages.stop)

    count = len(jax.eval_shape(lambda: gaps_at(task.a, task.b, start, live).gap))
    end = _beginning(start, count, width is not None)
    apart = isinstance(b.shape, HalfSpace) and t1.ndim > 0
    for stages in [range(stage, stage + 1) for stage in range(DONE)] if apart else [range(DONE)]:
        end = lax.while_loop(partial(busy, stages), partial(again, stages), end)
    level = jnp.zeros_like(start)
    rests = checkpoint_name(end.rests, FOUND)
    if end.closest is not None:

        def smooth(t: Array) -> Array:
            return _level(*_closest_approach(a, b, t, 0.25 * task.span, live), width)

        level = if_smooth(width, smooth, jnp.zeros_like, checkpoint_name(end.closest.t, FOUND))
    s, (_, bound) = jnp.where(end.found, end.s, end.near), earliest(task.a, task.b)
    return jnp.where(s < bound, task.start, s), level, end.found | end.inside, rests


def _task(a: Side, b: Side, t1: Array, width: Array | None, slow: Array) -> Task:
    return Task(a, b, earliest(a, b)[0], t1, jnp.minimum(reach_of(a), reach_of(b)), slow, width)


def _beginning(s: Array, count: int, smooth: bool) -> Search:
    none, zero, no = jnp.zeros((count, *s.shape), s.dtype), jnp.zeros_like(s), jnp.zeros(s.shape, bool)
    stage = jnp.full(s.shape, ADVANCING, np.int32)
    closest = Closest(s, none, zero, zero, zero) if smooth else None
    return Search(0, stage, jnp.zeros_like(stage), s, none > 0, s, no, no, zero, closest)


def if_smooth(width: Array | None, smooth, exact, *args: Array) -> Array:
    """smooth(*args) if any width is positive, else exact(*args)."""
    return exact(*args) if width is None else lax.cond(any_world(width > 0), smooth, exact, *args)


def touches(gap: Array, v: Array, acc: Array, near: Array, slow: Array) -> Array:
    """Whether a gap is closed, or about to close, no faster than `slow` [m/s]; rounding does not keep it open."""
    open_by = jnp.maximum(gap - ROUNDING * jnp.finfo(gap.dtype).eps * near, 0.0)
    return (gap <= near) & (v * v + 2.0 * open_by * jnp.abs(acc) <= slow**2)


def _follower(task: Task) -> Callable[[range, Search, Gaps], Search]:
    """What follows from the gaps at one time in some stages; a search is in a later one as soon as it comes to it."""
    safe_time = _advancer(task)

    def follow(stages: range, now: Search, gaps: Gaps) -> Search:
        if ADVANCING in stages:
            rests = jnp.where(now.count == 0, _resting(task, gaps), now.rests)
            now = now._replace(count=now.count + 1, rests=rests)
            now = choose(now.stage == ADVANCING, _advanced(task, now, safe_time(gaps, rests, now.s)), now)
        following = now
        if POLISHING in stages:
            following = choose(now.stage == POLISHING, _polished(task, now, gaps), now)
        if task.width is None or NEARING not in stages:
            return following
        nears = now.stage == NEARING

        def nearer(following: Search) -> Search:
            return choose(nears, _nearer(task, following, gaps), following)

        return lax.cond(any_world(nears), nearer, lambda following: following, following)

    return follow


def _resting(task: Task, gaps: Gaps) -> Array:
    """Contacts (K, *batch) that touch, or are about to, and close no faster than what is slow; bool.

    Beside one that rests, so do those slow enough to come to rest anyway. In unsupported flight they would always close
    next, and hide the fast impact of another corner.
    """
    gap, v, acc, _ = gaps
    near, slow = (NEAR * task.size)[None], task.slow[None]
    touching = touches(gap, v, acc, near, slow)
    # What closes by a third of its fall would be back within the step, whatever e <= 1.
    least = slow + jnp.maximum(-acc, 0.0) * jnp.maximum(task.span, 0.0)[None] / 3.0
    return touching | (touches(gap, v, acc, near, least) & touching.any(0)[None])


def _time_to(height: Array, v: Array, acc: Array) -> Array:
    """Time until height + v t + acc t^2 / 2 next falls through zero; negative if inside and closing; inf: never."""
    D = v * v - 2.0 * acc * height
    root = safe_sqrt(D)
    closing = jnp.where((D < 0) & (height > 0), jnp.inf, safe_divide(2.0 * height, root - v))
    returning = jnp.where(acc < 0, safe_divide(v + root, -acc), jnp.inf)
    sunk = (height < 0) & (acc < 0) & (D < 0)
    return jnp.where(sunk, 0.0, jnp.where(v < 0, closing, returning))


def _advancer(task: Task) -> Callable[[Gaps, Array, Array], Array]:
    """How long from s no contact can close that does not rest, (*batch) [s]; <= 0 if one is near and closing.

    It is the least, over the contacts, of the gap over a bound on the closing speed for the present normal (Mirtich
    1996), so that a body that only translates arrives in one advance. The gap of a corner and a plane is a smooth
    function of time: until t1 it stays above the parabola that is its own, bent down further by as much as its third
    derivative can be, which takes two or three advances. A contact that touches and separates may be passed for as long
    as its parabola stays open.
    """
    a, b, t1, near = task.a, task.b, task.t1, NEAR * task.size
    (spin_a, jerk_a), (spin_b, jerk_b) = (_unsteady(side, jnp.maximum(task.span, 0.0)) for side in (a, b))
    spinning, jerk = spin_a + spin_b, jerk_a + jerk_b

    def unseen(s: Array) -> Array:
        x, v = centre(a, s)
        height = height_over(b.shape, x, b.x, b.q) - reach_of(a)
        return jnp.where(s < t1, unseen_for(b.shape, b.q, height, v, spinning), jnp.inf)

    def safe_time(gaps: Gaps, rests: Array, s: Array) -> Array:
        gap, v, acc, normal = gaps
        if normal is None:
            apart = _time_to(gap, v, acc - jerk[None] * jnp.maximum(t1 - s, 0.0)[None] / 3.0)
        else:
            approach = centre(a, s)[1] - centre(b, s)[1]
            bound = jnp.maximum(-(normal * approach[None]).sum(1), 0.0) + spinning[None]
            apart = jnp.where(bound > 0, safe_divide(gap, bound), jnp.inf)
        returns = jnp.where(v < 0, 0.0, _time_to(gap, v, acc))
        first = _least(jnp.where(rests, jnp.inf, jnp.where(gap > near[None], apart, returns)))
        return jnp.minimum(first, unseen(s)) if isinstance(b.shape, HeightField) else first

    return safe_time


def _advanced(task: Task, now: Search, dt: Array) -> Search:
    """After an advance by dt; where there is none, or no more, the next stage begins."""
    # Across a grid an advance ends after half a cell, or in contact.
    grid = task.b.shape.heights.shape[:2] if isinstance(task.b.shape, HeightField) else ()
    arrived = (dt <= 0) | (now.s >= task.t1) | (now.count >= ADVANCES + CROSSED * sum(grid))
    following = POLISHING if task.width is None else jnp.where(task.width > 0, NEARING, POLISHING)
    s = jnp.where(arrived, now.s, jnp.minimum(now.s + dt, task.t1))
    return now._replace(s=s, near=now.s, stage=jnp.where(arrived, following, ADVANCING).astype(np.int32))


def _least(times: Array) -> Array:
    """Of the contacts (K, *batch). Written out only where they are few: the program is not to grow with a grid."""
    return fold(jnp.minimum, times, 0) if len(times) <= MANY else times.min(0)


def _unsteady(side: Side, span: Array) -> tuple[Array, Array]:
    """Bounds within the step on what spin and acceleration add to the speed of a point, and on its third derivative.

    (*batch) [m/s], [m/s^3]. Without a torque a rigid body has no greater angular acceleration than w^2, which bounds
    the third derivative of an arm r by 6 w^3 r.
    """
    f = side.flight
    if f is None:
        return jnp.zeros_like(span), jnp.zeros_like(span)
    so, reach = rotations(f.dim), reach_of(side)
    w, a = norm(so.unspin(f.inverse_inertia, f.q, f.L)), norm(f.a)
    jerk = 8.0 * w * w * w * reach
    if f.jerk is not None:
        a, jerk = a + span * norm(f.jerk), jerk + norm(f.jerk)
    if f.tau is not None:
        jerk = jerk + 4.0 * w * reach * norm(so.unspin(f.inverse_inertia, f.q, f.tau))
    return 1.1 * w * reach + a * span, jerk


def _polished(task: Task, now: Search, gaps: Gaps) -> Search:
    """After a step to where the first contact that does not rest comes to gap = level, if one does."""
    (gap, v, acc, _), slack, small, level = gaps, task.slack, task.slack * task.span, now.level[None]
    height = gap - level
    there = (jnp.abs(height) <= 8.0 * slack**2 * task.size[None]) & (v < 0)  # to rounding
    dt = _least(jnp.where(now.rests, jnp.inf, jnp.where(there, 0.0, _time_to(height, v, acc))))
    dt = jnp.where(jnp.isfinite(dt) & ((dt < 0) | (now.s < task.t1 + small)), dt, 0.0)  # what is later is no impact
    at_level = (gap <= level + (slack * task.size)[None]) & ((v < 0) | (acc < 0)) & ~now.rests
    inside = ((gap <= level) & (v < 0) & ~now.rests).any(0)
    done = (jnp.abs(dt) <= small) | (now.tries >= POLISH)
    # Where it converges the last step closes the gap, which at its start may have been wider than the slack.
    found = at_level.any(0) | ((dt != 0) & (jnp.abs(dt) <= small))
    return now._replace(
        s=now.s + dt, found=found, inside=jnp.where(now.tries == 0, inside, now.inside), tries=now.tries + 1,
        stage=jnp.where(done, DONE, POLISHING).astype(np.int32),
    )  # fmt: skip


def _nearer(task: Task, now: Search, gaps: Gaps) -> Search:
    """After one of three evaluations of a step towards the closest approach: at its time, before, and after it.

    The curvature of the gap is a difference of its rate over a quarter of the step: it holds what corners and turning
    faces add.
    """
    eta, turn, c = 0.25 * task.span, now.tries % TURN, now.closest
    assert c is not None
    first, last = turn == 0, turn == TURN - 1
    chosen = jnp.where(first[None], _deepest(gaps.gap), c.chosen)
    t, rate = jnp.where(now.tries == 0, now.near, c.t), (chosen * gaps.rate).sum(0)
    gap, before = jnp.where(first, (chosen * gaps.gap).sum(0), c.gap), jnp.where(last, c.before, rate)
    c = Closest(t=t, chosen=chosen, gap=gap, rate=jnp.where(first, rate, c.rate), before=before)
    curvature = safe_divide(rate - c.before, 2.0 * eta)
    step = jnp.where(curvature > 0, safe_divide(c.rate, curvature), 0.0)
    onward = jnp.clip(t - step, now.near - task.span, now.near + task.span)
    ends = last & ((jnp.abs(onward - t) <= task.slack * task.span) | (now.tries >= TURN * POLISH))
    c = c._replace(t=jnp.where(last & ~ends, onward, t))
    s = jnp.where(ends, now.near, jnp.where(last, c.t, jnp.where(first, t - eta, t + eta)))
    return now._replace(
        s=s, closest=c, level=jnp.where(ends, _level(c.gap, c.rate, curvature, task.width), now.level),
        tries=jnp.where(ends, 0, now.tries + 1), stage=jnp.where(ends, POLISHING, NEARING).astype(np.int32),
    )  # fmt: skip


def _deepest(gap: Array) -> Array:
    """1 for the least of the gaps (K, *batch), else 0."""
    return jax.nn.one_hot(jnp.argmin(gap, 0), len(gap), axis=0, dtype=gap.dtype)


def _closest_approach(a: Side, b: Side, t: Array, eta: Array, live: Array) -> tuple[Array, Array, Array]:
    """Gap at t of the contact with the least, its rate and its curvature, as in `_nearer` but with their gradients."""
    gaps = jax.vmap(lambda t: gaps_at(a, b, t, live)[:2])(jnp.stack([t - eta, t, t + eta]))
    chosen = _deepest(gaps[0][1])
    before, rate, after = (chosen[None] * gaps[1]).sum(1)
    return (chosen * gaps[0][1]).sum(0), rate, safe_divide(after - before, 2.0 * eta)


def _level(gap: Array, rate: Array, curvature: Array, width: Any) -> Array:
    """Level of a smooth impact, (*batch) [m], from a gap near its closest approach."""
    turns_back = curvature > 0
    gap_min = gap - 0.5 * safe_divide(rate * rate, jnp.where(turns_back, curvature, 0.0))
    return jnp.where(turns_back, softplus(gap_min, width), 0.0)
