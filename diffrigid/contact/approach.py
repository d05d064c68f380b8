"""The next impact of a pair, from its gaps at one time: how long none can close, when one does, which contacts rest.

Source: Mirtich, Impulse-based Dynamic Simulation of Rigid Body Systems (1996), for the advancement.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.collide.heights import height_over, unseen_for
from diffrigid.contact.gaps import NEAR, Gaps
from diffrigid.contact.held_up import is_supported
from diffrigid.contact.sides import Side, centre, core_reach_of, earliest, reach_of
from diffrigid.gathers import MANY, fold
from diffrigid.numerics import norm, safe_divide, safe_sqrt
from diffrigid.shapes import HeightField
from diffrigid.state import rotations

WANDER = 1.1  # [-] growth allowed to the angular speed of a free body in 3D within a step
FALLEN = 0.25  # [-] least depth over rate and time of what fell from rest, by an acceleration that grows as t^2
LITTLE = 0.1  # [-] of the height of a gap: one that opens again without having closed by more does not meet on its way
TOUCH_ROUNDING = 1e5  # [-] times eps times the near distance: gap that rounding may leave at touching bodies


class Task(NamedTuple):
    """The search problem: the first impact of two colliders from `start` to t1."""

    a: Side
    b: Side
    start: Array  # (*batch) [s]
    t1: Array  # (*batch) [s]
    size: Array  # (*batch) [m] the smaller reach
    slow: Array  # (*batch) [m/s] contacts that close no faster rest
    width: Array | None  # (*batch) [m] None: exact
    rested: Array  # (*batch) bool: a contact of the two rested before, in this step

    @property
    def span(self) -> Array:
        """Length of the interval searched, (*batch) [s]."""
        return self.t1 - self.start

    @property
    def slack(self) -> Array:
        """Relative tolerance [-], sqrt(eps)."""
        return jnp.sqrt(jnp.finfo(self.t1.dtype).eps)


def task_of(a: Side, b: Side, t1: Array, width: Array | None, slow: Array, rested: Array) -> Task:
    """Make the task, without derivatives: else a search loop would carry tangents in vain."""
    task = Task(a, b, earliest(a, b)[0], t1, jnp.minimum(reach_of(a), reach_of(b)), slow, width, rested)
    return lax.stop_gradient(task)


def if_smooth(width: Array | None, smooth, exact, *args: Array) -> Any:
    """Evaluate smooth(*args) if any width is positive, else exact(*args)."""
    return exact(*args) if width is None else lax.cond(any_world(width > 0), smooth, exact, *args)


def rounding(near: Array) -> Array:
    """Gap [m] that rounding of positions may leave at touching bodies, by the distance that is near."""
    return TOUCH_ROUNDING * jnp.finfo(near.dtype).eps * near


def touches(gap: Array, v: Array, acc: Array, near: Array, slow: Array) -> Array:
    """Whether a gap is closed, or about to close, and no faster than `slow` [m/s]; rounding does not keep it open."""
    open_by = jnp.maximum(gap - rounding(near), 0.0)
    return (gap <= near) & (v * v + 2.0 * open_by * jnp.abs(acc) <= slow**2)


def resting(task: Task, gaps: Gaps) -> Array:
    """Whether contacts rest, (K, *batch) bool: they touch, or are about to, and close slowly.

    If one contact of the pair rests, or rested before an impact with another body within the step, so do all that are
    slow enough to come to rest anyway. Else, in a free flight without support, they would be found to close first, and
    hide the fast impact of another corner.
    """
    gap, v, acc = gaps.gap, gaps.rate, gaps.pull
    near, slow = (NEAR * task.size)[None], task.slow[None]
    touching = touches(gap, v, acc, near, slow)
    # A contact that closes at a third of the speed of its fall would be back within the step, whatever e <= 1.
    least = slow + jnp.maximum(-acc, 0.0) * jnp.maximum(task.span, 0.0)[None] / 3.0
    return touching | (touches(gap, v, acc, near, least) & (touching.any(0) | task.rested)[None])


def taking_over(task: Task, gaps: Gaps, rests: Array) -> Array:
    """`rests` (K, *batch), and contacts that carry on where another comes to the end of a face: they do not close."""
    if gaps.held is None:
        return rests
    (gap, v), near, slow = gaps.held, (NEAR * task.size)[None], task.slow[None]
    return rests | (touches(gap, v, gaps.pull, near, slow) & is_supported(task.a, task.b)[None])


def falling(task: Task, gaps: Gaps, rests: Array, s: Array) -> Array:
    """`rests` (K, *batch) without contacts that close at time s faster than they can have fallen since the start.

    Crossings of edges are listed by their gaps: of those that touch, one that strikes may take the place of one that
    rested. What has fallen as fast as that is as deep inside.
    """
    least = task.slow[None] + 2.0 * jnp.abs(gaps.pull) * jnp.maximum(task.span, 0.0)[None]
    deep = gaps.gap <= FALLEN * gaps.rate * jnp.maximum(s - task.start, 0.0)[None]
    return rests & ((gaps.rate >= -least) | deep)


def clearance(task: Task) -> Callable[[Gaps, Array, Array], Array]:
    """Make the function: time from s before which only resting contacts can close, (*batch) [s]; <= 0: one is closing.

    It is the minimum over the contacts of the gap divided by a bound on the closing speed for the present normal
    (Mirtich 1996), so that a body that only translates arrives in one advance. The gap of a corner and a plane is a
    smooth function of time: until t1 it stays above its own parabola bent down further by a bound on its third
    derivative, which takes two or three advances. A contact that touches and separates may be passed for as long as its
    parabola stays open.
    """
    a, b, t1, near = task.a, task.b, task.t1, NEAR * task.size
    (spin_a, jerk_a), (spin_b, jerk_b) = (_unsteady(side, jnp.maximum(task.span, 0.0)) for side in (a, b))
    spinning, jerk = spin_a + spin_b, jerk_a + jerk_b

    def unseen(s: Array) -> Array:
        x, v = centre(a, s)
        height = height_over(b.shape, x, b.x, b.q) - reach_of(a)
        return jnp.where(s < t1, unseen_for(b.shape, b.q, height, v, spinning), jnp.inf)

    def clear(gaps: Gaps, rests: Array, s: Array) -> Array:
        gap, v, acc, normal = gaps.gap, gaps.rate, gaps.acceleration, gaps.normal
        if normal is None:
            apart = _time_to(gap, v, acc - jerk[None] * jnp.maximum(t1 - s, 0.0)[None] / 3.0)
        else:
            approach = centre(a, s)[1] - centre(b, s)[1]
            bound = jnp.maximum(-(normal * approach[None]).sum(1), 0.0) + spinning[None]
            apart = jnp.where(bound > 0, safe_divide(gap, bound), jnp.inf)
        returns = jnp.where(v < 0, 0.0, _time_to(gap, v, acc))
        first = _least(jnp.where(rests, jnp.inf, jnp.where(gap > near[None], apart, returns)))
        return jnp.minimum(first, unseen(s)) if isinstance(b.shape, HeightField) else first

    return clear


class Polish(NamedTuple):
    """A step along the parabola of the first gap to close, and what the gaps were before it."""

    dt: Array  # (*batch) [s] until the first contact that does not rest reaches its level; 0 if none does
    closes: Array  # (*batch) bool: it reaches it then; else its gap may turn back then
    at_level: Array  # (*batch) bool: some contact is at its level
    inside: Array  # (*batch) bool: some contact is within its level, and closing

    def converged(self, task: Task) -> Array:
        """Whether the step is within the tolerance in time, (*batch) bool."""
        return jnp.abs(self.dt) <= task.slack * task.span

    def found(self, task: Task) -> Array:
        """Whether an impact is found, (*batch) bool. The last step may close a gap that was wider than the slack."""
        return self.at_level | (self.closes & self.converged(task))


def polish(task: Task, gaps: Gaps, rests: Array, level: Array, s: Array) -> Polish:
    """Step from time s (*batch) [s] to where a gap is `level` (*batch) [m]."""
    (gap, v, acc, *_), slack, level = gaps, task.slack, level[None]
    height = gap - level
    there = (jnp.abs(height) <= 8.0 * slack**2 * task.size[None]) & (v < 0)  # to rounding
    closing = _least(jnp.where(rests, jnp.inf, jnp.where(there, 0.0, _time_to(height, v, acc))))
    dt = closing
    if gaps.normal is not None:  # it turns: whether the gap opens again is only known from a look at where it would
        falls = safe_divide(v * v, 2.0 * acc * height)  # [-] of its height, until then
        opens = (v < 0) & (height > 0) & (LITTLE < falls) & (falls < 1.0) & ~rests
        turns = jnp.where(opens, safe_divide(-v, acc), 0.0)
        dt = jnp.minimum(dt, _least(jnp.where(turns > (slack * task.span)[None], turns, jnp.inf)))
    # A later time is no impact; but a step to a little beyond the end does not decide that yet.
    within = (dt < 0) | ((s < task.t1 + slack * task.span) & (s + dt < task.t1 + task.span))
    at_level = (gap <= level + (slack * task.size)[None]) & ((v < 0) | (acc < 0)) & ~rests
    inside = (gap <= level) & (v < 0) & ~rests
    dt = jnp.where(jnp.isfinite(dt) & within, dt, 0.0)
    return Polish(dt, (dt == closing) & (dt != 0), at_level.any(0), inside.any(0))


def _time_to(height: Array, v: Array, acc: Array) -> Array:
    """Time until height + v t + acc t^2 / 2 next falls through zero; negative if inside and closing; inf: never."""
    D = v * v - 2.0 * acc * height
    root = safe_sqrt(D)
    until_closed = jnp.where((D < 0) & (height > 0), jnp.inf, safe_divide(2.0 * height, root - v))
    returning = jnp.where(acc < 0, safe_divide(v + root, -acc), jnp.inf)
    sunk = (height < 0) & (acc < 0) & (D < 0)
    return jnp.where(sunk, 0.0, jnp.where(v < 0, until_closed, returning))


def _least(times: Array) -> Array:
    """Minimum over the contacts (K, *batch); unrolled only for few, so that the program does not grow with a grid."""
    return fold(jnp.minimum, times, 0) if len(times) <= MANY else times.min(0)


def spinning_up(side: Side, span: Array) -> tuple[Array, Array]:
    """Bounds within a span [s] of its path: angular speed, and what torques add to it; (*batch) [rad/s], [rad/s^2]."""
    f = side.flight
    if f is None:
        return jnp.zeros_like(span), jnp.zeros_like(span)

    def speed(L: Array) -> Array:
        return norm(rotations(f.dim).unspin(f.inverse_inertia, f.q, L))

    alpha = jnp.zeros_like(span) if f.tau is None else speed(f.tau)
    if f.twist is not None:
        alpha = alpha + 0.5 * span * speed(f.twist)
    return WANDER * speed(f.L) + span * alpha, alpha


def _unsteady(side: Side, span: Array) -> tuple[Array, Array]:
    """Bounds within the step on what spin and acceleration add to a point's speed, and on its third derivative.

    (*batch) [m/s], [m/s^3]. Without a torque the angular acceleration of a rigid body does not exceed w^2, which bounds
    the third derivative of an arm r by 6 w^3 r. A torque that accelerates it by alpha adds 3 w alpha r, and as much as
    alpha turns with the body.
    """
    f = side.flight
    if f is None:
        return jnp.zeros_like(span), jnp.zeros_like(span)
    reach, a, (w, alpha) = core_reach_of(side), norm(f.a), spinning_up(side, span)
    jerk = (6.0 * w * w + 4.0 * alpha) * w * reach
    if f.jerk is not None:
        a, jerk = a + span * norm(f.jerk), jerk + norm(f.jerk)
    return w * reach + a * span, jerk
