"""When any two shapes meet: conservative advancement towards the first contact, then the parabola of its gap.

Searched without derivatives; `impact.py` gives the time that is found that of the implicit function theorem. A pair of
a world goes through three stages, each some looks at its gaps:

    ADVANCING    by what no contact can close earlier, until one is near and closing, or the step is over
    NEARING      towards the closest approach of the two paths, which sets the level of a smooth impact
    POLISHING    along the parabola of the gap, to where it is at its level

Above a half-space, where a look is cheap, each stage is a loop. Else the gaps are most of the program, and all stages
are one loop, so that the gaps are compiled once; every world is in a stage of its own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world, choose, opaque_true
from diffrigid.contact.approach import (
    Closest,
    Polish,
    Task,
    clearance,
    closest,
    deepest,
    if_smooth,
    polish,
    resting,
    task_of,
)
from diffrigid.contact.gaps import Gaps, gaps_at
from diffrigid.contact.sides import Side, earliest
from diffrigid.numerics import FOUND, safe_divide
from diffrigid.shapes import HalfSpace, HeightField

CROSSED = 3  # advances for each node along a side of a grid: the length of its diagonal in half cells
ADVANCES = 48  # conservative advances at most, each at least the gap over a bound on the closing speed
POLISH = 12  # steps along the local parabola of the gap at most; near the impact the error is squared by each
TURN = 3  # looks for one step towards the closest approach
TURNS = 6  # of these steps at most
ETA = 0.25  # [-] of the step: how far before and after it the rates are taken
ADVANCING, NEARING, POLISHING, DONE = range(4)


def approach_search(
    a: Side, b: Side, t1: Array, width: Array | None, rest_speed: Array, at_end: Array
) -> tuple[Array, Array, Array, Array]:
    """Any two shapes: time of the next impact, level of the gap then, whether there is one, which contacts rest.

    Nothing is looked for `at_end`, a bool. Only the level has a gradient.
    """
    task, live = task_of(a, b, t1, width, rest_speed), opaque_true(t1)
    search = _stage_by_stage if isinstance(b.shape, HalfSpace) else _in_one_loop
    end = search(task, jnp.where(at_end, task.t1, task.start), at_end, live)
    level = jnp.zeros_like(end.s)
    if end.closest is not None:

        def smooth(t: Array) -> Array:
            return closest(a, b, t, ETA * task.span, live).level(width)  # type: ignore[arg-type]

        level = if_smooth(width, smooth, jnp.zeros_like, checkpoint_name(end.closest, FOUND))
    s, (_, bound) = jnp.where(end.found, end.s, end.near), earliest(task.a, task.b)
    rests = checkpoint_name(end.rests, FOUND)
    return jnp.where(s < bound, task.start, s), level, end.found | end.inside, rests


class Found(NamedTuple):
    """What a search ends with."""

    s: Array  # (*batch) [s] where they meet, if `found`
    near: Array  # (*batch) [s] where the advances ended
    found: Array  # (*batch) bool: some contact is at its level
    inside: Array  # (*batch) bool: some contact was within its level and closing when the advances ended
    rests: Array  # (K, *batch) bool: contacts that rest, which are left out
    closest: Array | None  # (*batch) [s] of the closest approach; None: exact


def _stage_by_stage(task: Task, start: Array, at_end: Array, live: Array) -> Found:
    clear, no = clearance(task), start < start

    def flying(carry):
        count, s, dt, _ = carry
        return ~at_end & ((count == 0) | ((count < ADVANCES) & any_world((dt > 0) & (s < task.t1))))

    def advance(carry):
        count, s, dt, rests = carry
        s = jnp.where(s < task.t1, jnp.minimum(s + jnp.maximum(dt, 0.0), task.t1), s)
        gaps = gaps_at(task.a, task.b, s, live)
        rests = jnp.where(count == 0, resting(task, gaps), rests)
        return count + 1, s, clear(gaps, rests, s), rests

    first = (0, start, jnp.zeros_like(start), jnp.zeros((_count(task, start, live), *start.shape), bool))
    _, near, _, rests = lax.while_loop(flying, advance, first)

    def approach(near):
        def nearer(_, t):
            step = closest(task.a, task.b, t, ETA * task.span, live).step()
            return jnp.clip(t + step, near - task.span, near + task.span)

        t = lax.fori_loop(0, TURNS, nearer, near)
        return t, closest(task.a, task.b, t, ETA * task.span, live).level(task.width)  # type: ignore[arg-type]

    nearest, level = if_smooth(task.width, approach, lambda near: (near, jnp.zeros_like(near)), near)

    def polishing(carry):
        count, _, look = carry
        return ~at_end & ((count == 0) | ((count <= POLISH) & any_world(~look.converged(task))))

    def along(carry):
        count, s, before = carry
        look = polish(task, gaps_at(task.a, task.b, s, live), rests, level, s)
        return count + 1, s + look.dt, look._replace(inside=jnp.where(count == 0, look.inside, before.inside))

    _, s, look = lax.while_loop(polishing, along, (0, near, Polish(jnp.zeros_like(near), no, no)))
    return Found(s, near, look.found(task), look.inside, rests, None if task.width is None else nearest)


def _count(task: Task, start: Array, live: Array) -> int:
    """Number of contacts."""
    return len(jax.eval_shape(lambda: gaps_at(task.a, task.b, start, live).gap))


class Turn(NamedTuple):
    """One step towards the closest approach, of which looks at three times are part."""

    t: Array  # (*batch) [s]
    chosen: Array  # (K, *batch) 1 for the contact with the least gap, else 0
    gap: Array  # (*batch) [m] at t
    rate: Array  # (*batch) [m/s] at t
    before: Array  # (*batch) [m/s] a quarter of the step before


class Search(NamedTuple):
    """How far it has come."""

    count: Any  # int: looks
    stage: Array  # (*batch) int
    tries: Array  # (*batch) int: looks in this stage
    s: Array  # (*batch) [s] of the next look; at last where they meet
    rests: Array  # (K, *batch), and so on as in `Found`
    near: Array
    found: Array
    inside: Array
    level: Array  # (*batch) [m]
    turn: Turn | None


def _in_one_loop(task: Task, start: Array, at_end: Array, live: Array) -> Found:
    none, zero, no = (
        jnp.zeros((_count(task, start, live), *start.shape), start.dtype),
        jnp.zeros_like(start),
        start < start,
    )
    stage = jnp.full(start.shape, ADVANCING, np.int32)
    turn = None if task.width is None else Turn(start, none, zero, zero, zero)
    first = Search(0, stage, jnp.zeros_like(stage), start, none > 0, start, no, no, zero, turn)
    follow = _follower(task)

    def busy(now: Search) -> Array:
        return ~at_end & any_world(now.stage < DONE)

    end = lax.while_loop(busy, lambda now: follow(now, gaps_at(task.a, task.b, now.s, live)), first)
    return Found(end.s, end.near, end.found, end.inside, end.rests, None if end.turn is None else end.turn.t)


def _follower(task: Task) -> Callable[[Search, Gaps], Search]:
    """What follows from the gaps at one time; a search is in a later stage as soon as it comes to it."""
    clear = clearance(task)

    def follow(now: Search, gaps: Gaps) -> Search:
        rests = jnp.where(now.count == 0, resting(task, gaps), now.rests)
        now = now._replace(count=now.count + 1, rests=rests)
        now = choose(now.stage == ADVANCING, _advanced(task, now, clear(gaps, rests, now.s)), now)
        following = choose(now.stage == POLISHING, _polished(task, now, gaps), now)
        if task.width is None:
            return following
        nears = now.stage == NEARING

        def nearer(following: Search) -> Search:
            return choose(nears, _nearer(task, following, gaps), following)

        return lax.cond(any_world(nears), nearer, lambda following: following, following)

    return follow


def _advanced(task: Task, now: Search, dt: Array) -> Search:
    """After an advance by dt; where there is none, or no more, the next stage begins."""
    # Across a grid an advance ends after half a cell, or in contact.
    grid = task.b.shape.heights.shape[:2] if isinstance(task.b.shape, HeightField) else ()
    arrived = (dt <= 0) | (now.s >= task.t1) | (now.count >= ADVANCES + CROSSED * sum(grid))
    following = POLISHING if task.width is None else jnp.where(task.width > 0, NEARING, POLISHING)
    s = jnp.where(arrived, now.s, jnp.minimum(now.s + dt, task.t1))
    return now._replace(s=s, near=now.s, stage=jnp.where(arrived, following, ADVANCING).astype(np.int32))


def _polished(task: Task, now: Search, gaps: Gaps) -> Search:
    """After a step to where the first contact that does not rest comes to its level, if one does."""
    look = polish(task, gaps, now.rests, now.level, now.s)
    done = look.converged(task) | (now.tries >= POLISH)
    return now._replace(
        s=now.s + look.dt, found=look.found(task), inside=jnp.where(now.tries == 0, look.inside, now.inside),
        tries=now.tries + 1, stage=jnp.where(done, DONE, POLISHING).astype(np.int32),
    )  # fmt: skip


def _nearer(task: Task, now: Search, gaps: Gaps) -> Search:
    """After one of three looks of a step towards the closest approach: at its time, before, and after it."""
    eta, look, c = ETA * task.span, now.tries % TURN, now.turn
    assert c is not None
    first, last = look == 0, look == TURN - 1
    chosen = jnp.where(first[None], deepest(gaps.gap), c.chosen)
    t, rate = jnp.where(now.tries == 0, now.near, c.t), (chosen * gaps.rate).sum(0)
    gap, before = jnp.where(first, (chosen * gaps.gap).sum(0), c.gap), jnp.where(last, c.before, rate)
    c = Turn(t=t, chosen=chosen, gap=gap, rate=jnp.where(first, rate, c.rate), before=before)
    seen = Closest(c.gap, c.rate, safe_divide(rate - c.before, 2.0 * eta))
    onward = jnp.clip(t + seen.step(), now.near - task.span, now.near + task.span)
    ends = last & ((jnp.abs(onward - t) <= task.slack * task.span) | (now.tries >= TURN * TURNS))
    c = c._replace(t=jnp.where(last & ~ends, onward, t))
    s = jnp.where(ends, now.near, jnp.where(last, c.t, jnp.where(first, t - eta, t + eta)))
    level = jnp.where(ends, seen.level(task.width), now.level)  # type: ignore[arg-type]
    return now._replace(
        s=s, turn=c, level=level, tries=jnp.where(ends, 0, now.tries + 1),
        stage=jnp.where(ends, POLISHING, NEARING).astype(np.int32),
    )  # fmt: skip
