"""The closest approach of two paths after a given time, which sets the level of a smooth impact.

The search goes forward by growing steps until the least gap opens, or back to the start if it opens already; then
false position finds the root of its rate, in the form that halves the retained rate (Dowell and Jarratt 1971). Two
convex bodies that do not turn have one closest approach, however far ahead; for bodies that turn it is the next one.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.branches import choose
from diffrigid.contact.approach import Task, spinning_up
from diffrigid.contact.gaps import Gaps, least_of
from diffrigid.contact.sides import Side, gap_rates, have_depth, place, separation_of
from diffrigid.numerics import safe_divide, safe_sqrt, softplus
from diffrigid.shapes import radius

LOOKS = 48  # evaluations of the gaps, at most
FIRST = 0.25  # [-] of the step: the first step forward
TURN = 0.5  # [rad] largest relative rotation of the two in one step forward
EXACT_BEYOND = 40.0  # [-] of the width: a hit as much deeper is exact to rounding, by exp(-40)


class Look(NamedTuple):
    """An evaluation of a pair's gaps: the least of them, and its rate."""

    t: Array  # (*batch) [s]
    gap: Array  # (*batch) [m]
    rate: Array  # (*batch) [m/s]


class Closest(NamedTuple):
    """Times that bracket the closest approach of two paths."""

    before: Array  # (*batch) [s]
    after: Array  # (*batch) [s]
    exists: Array  # (*batch) bool


class Nearing(NamedTuple):
    """State of the search for the closest approach."""

    t: Array  # (*batch) [s] of the next look
    looks: Array  # (*batch) int
    step: Array  # (*batch) [s] the last one forward
    closing: Look  # the latest at which it closes; time -inf: none yet
    opening: Look  # the earliest at which it opens; time inf: none yet
    closed: Array  # (*batch) bool: it closed at the last look
    kept: Array  # (*batch) [-] factor of false position on the retained rate
    later: Array  # (*batch) [m] with a gap below this, its level is reached after the end of the step
    done: Array  # (*batch) bool
    turns_back: Array  # (*batch) bool: there is a closest approach, between the two

    def closest(self) -> Closest:
        """The bracket alone; its times are always finite."""
        before, after = (jnp.where(self.turns_back, look.t, self.t) for look in (self.closing, self.opening))
        return Closest(before, after, self.turns_back)

    def level(self, width: Array | None) -> Array:
        """Level of a smooth impact, (*batch) [m], for a width (*batch) [m]."""
        assert width is not None
        return jnp.where(self.turns_back, level_at(self.closing, self.opening, width), 0.0)

    def comes_to(self, level: Array) -> Array:
        """Approximate time (*batch) [s] at which the closing gap is `level` [m]; inf: there is no closest approach."""
        low, high = self.closing, self.opening
        above = safe_divide(2.0 * jnp.maximum(level - low.gap, 0.0) * (high.t - low.t), high.rate - low.rate)
        return jnp.where(self.turns_back, low.t - safe_sqrt(above), jnp.inf)


def level_at(closing: Look, opening: Look, width: Array) -> Array:
    """Level of a smooth impact of `width` (*batch) [m], (*batch) [m], from looks just before and after the closest gap.

    The closest gap is where the two tangents meet: it may have a kink there, where another face becomes the nearest.
    """
    low, high, span = lax.stop_gradient((closing.rate, opening.rate, opening.t - closing.t))
    share = safe_divide(high, high - low)  # so weighted, it does not depend on the time
    return softplus(share * closing.gap + (1.0 - share) * opening.gap + share * low * span, width)


def look_at(a: Side, b: Side, t: Array, gaps: Gaps) -> Look:
    """The least of the gaps at t (*batch) [s]; where the two overlap minus their depth, which has no jumps."""
    chosen = lax.stop_gradient(least_of(gaps.gap))
    gap, rate = (chosen * gaps.gap).sum(0), (chosen * gaps.rate).sum(0)
    if not have_depth(a, b):
        return Look(t, gap, rate)
    at_a, at_b = place(a, t), place(b, t)
    cores = separation_of(a, at_a, b, at_b)
    inside = (cores.gap < 0)[0]
    depth, sinking = cores.gap[0] - radius(a.shape) - radius(b.shape), gap_rates(cores, at_a, at_b)[0]
    return Look(t, jnp.where(inside, depth, gap), jnp.where(inside, sinking, rate))


def from_time(t: Array) -> Nearing:
    """State of a search before its first look, which is at t (*batch) [s]."""
    zero, no = jnp.zeros_like(t), t < t
    never, looks = zero + jnp.inf, jnp.zeros(t.shape, np.int32)
    return Nearing(t, looks, zero, Look(-never, zero, zero), Look(never, zero, zero), no, zero + 1.0, -never, no, no)


def nearer(task: Task, now: Nearing, gaps: Gaps) -> Nearing:
    """State of the search after the look at `now.t`."""
    assert task.width is not None
    here, first = look_at(task.a, task.b, now.t, gaps), now.looks == 0
    closes, within = here.rate < 0, task.slack * task.span
    closing, opening = choose(closes, here, now.closing), choose(closes, now.opening, here)
    between = (closing.t > -jnp.inf) & (opening.t < jnp.inf)
    again = ~first & (closes == now.closed)  # a second time: else false position would come near from one side only
    kept = jnp.where(again, 0.5 * now.kept, 1.0)
    step = jnp.where(first, FIRST * task.span, 2.0 * now.step)
    for rate, most in (
        (spinning_up(task.a, task.span)[0] + spinning_up(task.b, task.span)[0], TURN),
        (-here.rate, _ahead(here.gap, task.width)),
    ):
        step = jnp.where(rate > 0, jnp.minimum(step, most / jnp.maximum(rate, task.slack)), step)
    root = jnp.clip(_root(closing, opening, closes, kept), closing.t + within, opening.t - within)
    following = jnp.where(between, root, jnp.where(closes, now.t + step, task.start))
    # Without an impact by the end of the step, a gap that shrinks by more than a width reaches its level later.
    later = jnp.where(first, jnp.where(now.t < task.t1, -jnp.inf, here.gap - task.width), now.later)
    deep = (jnp.maximum(here.gap, 0.0) < later) | (here.gap < -EXACT_BEYOND * task.width)
    opens = ~between & ~closes & (now.t <= task.start)
    ends = deep | opens | (between & (opening.t - closing.t <= 2.0 * within)) | (now.looks >= LOOKS)
    after = Nearing(
        t=following, looks=now.looks + 1, step=step, closing=closing, opening=opening, closed=closes, kept=kept,
        later=later, done=ends, turns_back=between & ~deep,
    )  # fmt: skip
    return choose(now.done, now, after)


def _ahead(gap: Array, width: Array) -> Array:
    """Decrease of the gap allowed until the next look, (*batch) [m]: to zero, and beyond that in small steps.

    In penetration the nearest corners and faces change, and the first of several minima is to be found.
    """
    return jnp.maximum(gap, 0.0) + jnp.maximum(0.5 * width, 0.25 * jnp.abs(gap))


def _root(closing: Look, opening: Look, closes: Array, kept: Array) -> Array:
    """Root of the rate on the line between the two, (*batch) [s]; the rate at the older end is weighted by `kept`."""
    low = closing.rate * jnp.where(closes, 1.0, kept)
    high = opening.rate * jnp.where(closes, kept, 1.0)
    share = safe_divide(low, low - high)
    return closing.t + share * jnp.where(share > 0, opening.t - closing.t, 0.0)
