"""Time at which any two shapes meet: conservative advancement to the first contact, then the parabola of its gap.

The search has no derivatives; `impact.py` gives the time it finds that of the implicit function theorem. A pair of a
world goes through three stages, each with several evaluations ("looks") of its gaps:

    ADVANCING    by times within which no contact can close, until one is near and closing, or the step is over
    NEARING      towards the closest approach of the two paths, which sets the level of a smooth impact
    POLISHING    along the parabola of the gap, to the time at which it is at its level

Above a half-space, where a look is cheap, each stage is a loop. Otherwise the gaps are most of the program, and all
stages share one loop, so that the gaps are compiled once; every world is in a stage of its own.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world, choose
from diffrigid.collide.contacts import transferred
from diffrigid.contact.approach import (
    Polish,
    Task,
    clearance,
    falling,
    if_smooth,
    polish,
    resting,
    taking_over,
    task_of,
)
from diffrigid.contact.gaps import Gaps, gaps_at
from diffrigid.contact.nearing import Closest, Nearing, from_time, level_at, look_at, nearer
from diffrigid.contact.sides import Side, earliest
from diffrigid.numerics import FOUND
from diffrigid.shapes import HalfSpace, HeightField

CROSSED = 3  # advances for each node along a side of a grid: the length of its diagonal in half cells
ADVANCES = 48  # conservative advances at most, each at least the gap over a bound on the closing speed
POLISH = 12  # steps along the local parabola of the gap at most; near the impact the error is squared by each
ADVANCING, NEARING, POLISHING, DONE = range(4)


def approach_search(
    a: Side, b: Side, t1: Array, width: Array | None, rest_speed: Array, rested: Array, at_end: Array
) -> tuple[Array, Array, Array, Array, Array | None]:
    """Search the next impact of any two shapes: its time, level of the gap, whether there is one, which contacts rest.

    And the features of these contacts. With `at_end`, a bool, nothing is searched. Only the level has a gradient.
    """
    task = task_of(a, b, t1, width, rest_speed, rested)
    search = _stage_by_stage if isinstance(b.shape, HalfSpace) else _in_one_loop
    end = search(task, jnp.where(at_end, task.t1, task.start), at_end)
    level, closest = checkpoint_name((end.level, end.closest), FOUND)
    if width is not None:
        level = _differentiable(level, width, a, b, closest)
    s, (_, bound) = jnp.where(end.found, end.s, end.near), earliest(task.a, task.b)
    rests, feature = checkpoint_name((end.rests, end.feature), FOUND)
    inside = end.inside
    if width is not None:
        # What turns round within the level of a smooth impact waits for the next path: its time has no derivative.
        inside = inside & ((width <= 0) | (s <= task.start))
    return jnp.where(s < bound, task.start, s), level, end.found | inside, rests, feature


@jax.custom_jvp
def _differentiable(level: Array, width: Array, a: Side, b: Side, closest: Closest) -> Array:
    """The level (*batch) [m] that a search has found, with the derivatives of the gaps at the closest approach."""
    del width, a, b, closest
    return level


@_differentiable.defjvp
def _differentiable_jvp(primals, tangents):
    level, width, a, b, closest = primals

    def at_closest(width: Array, a: Side, b: Side) -> Array:
        looks = jax.vmap(lambda t: look_at(a, b, t, gaps_at(a, b, t)))(jnp.stack([closest.before, closest.after]))
        before, after = (jax.tree.map(operator.itemgetter(k), looks) for k in range(2))
        return jnp.where(closest.exists, level_at(before, after, width), 0.0)

    def smooth() -> Array:
        return jax.jvp(at_closest, primals[1:4], tangents[1:4])[1]

    return level, if_smooth(width, smooth, lambda: jnp.zeros_like(level))


class Found(NamedTuple):
    """Result of a search."""

    s: Array  # (*batch) [s] where they meet, if `found`
    near: Array  # (*batch) [s] where the polishing began
    level: Array  # (*batch) [m] level of the gap there
    found: Array  # (*batch) bool: some contact is at its level
    inside: Array  # (*batch) bool: some contact was within its level and closing there
    rests: Array  # (K, *batch) bool: contacts that rest, which are left out
    feature: Array | None  # (K, *batch) of these contacts, as in `Contacts`
    closest: Closest | None  # None: exact


def _stage_by_stage(task: Task, start: Array, at_end: Array) -> Found:
    near, over, rests = _come_near(task, start, at_end)

    def approach(near):
        def look(now):
            return nearer(task, now, gaps_at(task.a, task.b, now.t))

        seen = lax.while_loop(lambda now: ~at_end & any_world(~now.done), look, from_time(near))
        return _polished_from(task, near, seen), seen.level(task.width), seen.closest()

    def exact(near):
        return near, jnp.zeros_like(near), from_time(near).closest()

    near, level, nearest = if_smooth(task.width, approach, exact, near)
    nothing = over & (level <= 0)
    s, look = _closed_in(task, near, level, rests, nothing | at_end)
    found = look.found(task) & ~nothing
    return Found(s, near, level, found, look.inside & ~nothing, rests, None, None if task.width is None else nearest)


def _come_near(task: Task, start: Array, at_end: Array) -> tuple[Array, Array, Array]:
    """Where a pair that advances comes near [s], whether its step is over before, and which contacts rest."""
    clear = clearance(task)

    def safe(s, dt):  # the step is over long before anything closes: the normal of a half-space does not turn
        return dt >= 2.0 * (task.t1 - s)

    def flying(carry):
        count, s, dt, _ = carry
        return ~at_end & ((count == 0) | ((count < ADVANCES) & any_world((dt > 0) & (s < task.t1) & ~safe(s, dt))))

    def advance(carry):
        count, s, dt, rests = carry
        s = jnp.where(s < task.t1, jnp.minimum(s + jnp.maximum(dt, 0.0), task.t1), s)
        gaps = gaps_at(task.a, task.b, s)
        rests = jnp.where(count == 0, resting(task, gaps), rests)
        return count + 1, s, clear(gaps, rests, s), rests

    first = (0, start, jnp.zeros_like(start), jnp.zeros(_look(task, start).gap.shape, bool))
    _, near, dt, rests = lax.while_loop(flying, advance, first)
    over = (near < task.t1) & safe(near, dt)
    return jnp.where(over, task.t1, near), over, rests


def _closed_in(task: Task, near: Array, level: Array, rests: Array, nothing: Array) -> tuple[Array, Polish]:
    """The time [s] at which a pair that is near reaches its level, and the last look; `near` where there is nothing."""
    no = near < near

    def polishing(carry):
        count, _, look = carry
        return (count <= POLISH) & any_world(jnp.where(count == 0, ~nothing, ~look.converged(task)))

    def along(carry):
        count, s, before = carry
        look = polish(task, gaps_at(task.a, task.b, s), rests, level, s)
        return count + 1, s + look.dt, look._replace(inside=jnp.where(count == 0, look.inside, before.inside))

    _, s, look = lax.while_loop(polishing, along, (0, near, Polish(jnp.zeros_like(near), no, no, no)))
    return s, look


def _look(task: Task, start: Array) -> Gaps:
    """Shapes of a look."""
    return jax.eval_shape(lambda: gaps_at(task.a, task.b, start))


class Search(NamedTuple):
    """State of a search in one loop."""

    count: Any  # int: looks
    stage: Array  # (*batch) int
    tries: Array  # (*batch) int: looks in this stage
    s: Array  # (*batch) [s] of the next look; at last where they meet
    rests: Array  # (K, *batch), and so on as in `Found`
    feature: Array | None
    near: Array
    found: Array
    inside: Array
    level: Array  # (*batch) [m]
    nearing: Nearing | None  # None: exact


def _in_one_loop(task: Task, start: Array, at_end: Array) -> Found:
    look, zero, no = _look(task, start), jnp.zeros_like(start), start < start
    none = jnp.zeros(look.gap.shape, bool)
    feature = None if look.feature is None else jnp.zeros(look.feature.shape, look.feature.dtype)
    stage = jnp.full(start.shape, ADVANCING, np.int32)
    nearing = None if task.width is None else from_time(start)
    first = Search(0, stage, jnp.zeros_like(stage), start, none, feature, start, no, no, zero, nearing)
    follow = _follower(task)

    def busy(now: Search) -> Array:
        return ~at_end & any_world(now.stage < DONE)

    end = lax.while_loop(busy, lambda now: follow(now, gaps_at(task.a, task.b, now.s)), first)
    nearest = None if end.nearing is None else end.nearing.closest()
    return Found(end.s, end.near, end.level, end.found, end.inside, end.rests, end.feature, nearest)


def _follower(task: Task) -> Callable[[Search, Gaps], Search]:
    """Make the update of a search by the gaps at one time; it may go through several stages in one update."""
    clear = clearance(task)

    def follow(now: Search, gaps: Gaps) -> Search:
        if task.width is not None:  # what turns round inside the level of a smooth impact is to wait
            gaps = gaps._replace(acceleration=jnp.where(task.width > 0, gaps.pull, gaps.acceleration))
        before = transferred(now.rests, now.feature, gaps.feature)
        rests = taking_over(task, gaps, jnp.where(now.count == 0, resting(task, gaps), before))
        now = now._replace(count=now.count + 1, rests=rests, feature=gaps.feature)
        rests = falling(task, gaps, rests, now.s)
        now = choose(now.stage == ADVANCING, _advanced(task, now, clear(gaps, rests, now.s)), now)
        following = choose(now.stage == POLISHING, _polished(task, now, gaps, rests), now)
        if task.width is None:
            return following
        nears = now.stage == NEARING

        def look(following: Search) -> Search:
            return choose(nears, _nearer(task, following, gaps), following)

        return lax.cond(any_world(nears), look, lambda following: following, following)

    return follow


def _advanced(task: Task, now: Search, dt: Array) -> Search:
    """Search after an advance by dt; the next stage begins where dt <= 0, at the end, and after too many advances."""
    # Across a grid an advance ends after half a cell, or in contact.
    grid = task.b.shape.heights.shape[:2] if isinstance(task.b.shape, HeightField) else ()
    arrived = (dt <= 0) | (now.s >= task.t1) | (now.count >= ADVANCES + CROSSED * sum(grid))
    following = POLISHING if task.width is None else jnp.where(task.width > 0, NEARING, POLISHING)
    s = jnp.where(arrived, now.s, jnp.minimum(now.s + dt, task.t1))
    return now._replace(s=s, near=now.s, stage=jnp.where(arrived, following, ADVANCING).astype(np.int32))


def _polished(task: Task, now: Search, gaps: Gaps, rests: Array) -> Search:
    """Search after a step to where the first contact that does not rest reaches its level, if one does."""
    look = polish(task, gaps, rests, now.level, now.s)
    done = look.converged(task) | (now.tries >= POLISH)
    return now._replace(
        s=now.s + look.dt, found=look.found(task), inside=jnp.where(now.tries == 0, look.inside, now.inside),
        tries=now.tries + 1, stage=jnp.where(done, DONE, POLISHING).astype(np.int32),
    )  # fmt: skip


def _nearer(task: Task, now: Search, gaps: Gaps) -> Search:
    """Search after a look for the closest approach; where it is found the next stage begins."""
    assert now.nearing is not None
    seen = choose(now.tries == 0, from_time(now.near), now.nearing)
    seen = nearer(task, seen, gaps)
    near = jnp.where(seen.done, _polished_from(task, now.near, seen), now.near)
    return now._replace(
        s=jnp.where(seen.done, near, seen.t), near=near, level=seen.level(task.width), nearing=seen,
        tries=jnp.where(seen.done, 0, now.tries + 1), stage=jnp.where(seen.done, POLISHING, NEARING).astype(np.int32),
    )  # fmt: skip


def _polished_from(task: Task, near: Array, seen: Nearing) -> Array:
    """Time (*batch) [s] from which to polish: the end of the advances, or where the level is reached before it."""
    return jnp.maximum(jnp.minimum(near, seen.comes_to(seen.level(task.width))), task.start)
