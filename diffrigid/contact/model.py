"""`Contact`: from the free flight of a step to the state at its end, in passes over one list of contacts.

    IMPACT, up to `sweeps` times   the next impact of every body, at its true time, with restitution; resting contacts
                                   are held until then (`order.py`)
    HOLD                           resting contacts, at the end of the step: their normal velocities must not close
    WEIGH, REVERSE                 instead of HOLD where a slip stops and reverses within the step (`known.py`), the
                                   first only for bodies with joints
    PUSH                           resting contacts: gaps left by rounding or rotation are closed; momenta are kept,
                                   energy to the order of the gap

Every pass finds contacts at a time, solves for impulses, and re-anchors the struck bodies (`apply.py`); passes differ
in that time, the target of the contact law, and how long the impulse has acted. A pass that no world of the batch
needs is skipped, and so are all passes where no bodies come near each other. An impact beyond the sweeps is found by
the next step, at a negative time, and repaired.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name

from diffrigid.branches import any_world, choose
from diffrigid.contact.anchors import Anchors
from diffrigid.contact.apply import apply_impulses
from diffrigid.contact.crowd import step_crowd
from diffrigid.contact.impulse import comes_to_rest, restitution_at
from diffrigid.contact.isolated import goes_in_rounds, isolated_impacts
from diffrigid.contact.known import Known
from diffrigid.contact.resting import Law, Strikes
from diffrigid.contact.strikes import (
    coefficients,
    contact_count,
    driven,
    driving,
    ends,
    find_strikes,
    is_loaded,
    is_rolling,
    may_meet,
    waits,
)
from diffrigid.contact.sums import at_colliders
from diffrigid.contact.supported import find_supported, matters
from diffrigid.elimination import islands
from diffrigid.flight import Flight, state_at
from diffrigid.gathers import flags
from diffrigid.linkage import ends_of
from diffrigid.numerics import FOUND, PASSED, dot, recomputed, safe_divide, saving, with_tangents
from diffrigid.pytree import Leaf, array, pytree, replace, static
from diffrigid.state import State

if TYPE_CHECKING:
    from diffrigid.world import World

MOST = 1000  # sweeps, or neighbours
IMPACT, HOLD, WEIGH, REVERSE, PUSH = range(5)
LEFT = 1e-3  # [-] of the way of a fall in a step: a gap that passes before may have left at contacts that rest
HOLDS = 6  # passes to hold resting contacts until the first impact: for most of its time in free fall, then from there


@pytree
class Contact:
    """The contact model. Restitution and friction belong to the bodies; the numerical settings are here.

    Args:
        width: (*batch) [m] 0 is exact. Positive: smooth collision impulses, also for paths that narrowly miss. A
            traced number: anneal it to zero without recompiling.
        rest_speed: (*batch) [m/s] slower impacts do not rebound (at the limits of a hinge: this number in rad/s). Nor
            do faster ones after which the bodies would meet again before the step ends: they come to rest on each
            other. Bodies that only their spins bring together do so if all their bounces end within the step.
        sweeps: largest number of successive impacts of a body within a step. Later ones are found, and repaired, in
            the next step. A step that does not need its sweeps skips them; in a gradient each costs memory traffic.
        neighbours: capacity of the neighbour list of a body, in a crowd of 256 bodies or more: see `missed_pairs`.

    Differentiable at width > 0 wherever the paths are; at width = 0 with kinks where an impact appears or
    vanishes (grazing), where two coincide, and where sticking turns to slipping.

    Example:
        >>> widths = [dr.replace(world, contact=dr.Contact(width=width)) for width in (0.2, 0.05, 0.0)]
        >>> ends = [dr.rollout(w, state, dt=1 / 60, steps=30).state.x[-1, 0, 1] for w in widths]  # compiled once
        >>> [round(float(y), 4) for y in ends]  # full hits stay; near misses pull
        [0.3157, 0.3157, 0.3157]
    """

    width: Leaf = array(default=0.0)  # None in a fit that smooths nothing: known when tracing to be exact
    rest_speed: Leaf = array(default=1e-3)
    sweeps: int = static(default=4)
    neighbours: int = static(default=8)

    def __post_init__(self) -> None:
        for name in ("sweeps", "neighbours"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MOST:
                raise ValueError(
                    f"contact.{name} is {value!r}: expected an integer above 0, up to {MOST}; leave it out"
                )

    def __call__(self, world: "World", state: State, launch: Callable, dt: Array) -> State:
        """State after a step of length dt (*batch) [s].

        Args:
            launch: `(state, t0) -> Flight`, free motion to dt from states at their own times t0 (N, *batch).
        """
        if world.crowd:
            return step_crowd(world, state, dt)
        t0 = jnp.zeros_like(state.x[:, 0])
        if not ends(world)["a"]:
            return state_at(launch(state, t0), dt)
        start = with_tangents(Anchors(state=state, t0=t0, since=t0 - dt[None]), (world, dt))

        def passes(start: Anchors, done: Array | None = None) -> Anchors:
            return self._passes(world, start, done, launch, dt)

        def end(anchors: Anchors) -> State:
            return state_at(launch(anchors.state, anchors.t0), dt)

        if goes_in_rounds(world):  # among so many pairs some is always near, and times are found fast
            start, done = isolated_impacts(world, start, launch, dt, self.sweeps)
            # Each branch has its end: for one behind both, reverse mode would run the passes twice.
            others, none = map(jax.checkpoint, (lambda *of: end(passes(*of)), lambda start, _: end(start)))
            return lax.cond(done < self.sweeps, others, none, start, done)
        if all(driven(world)):
            return passes(start).state if _holds_all(world) else end(passes(start))
        near = may_meet(world, launch(state, t0), dt)
        return end(lax.cond(near, passes, lambda start: start, start))

    def _passes(self, world: "World", start: Anchors, done: Array | None, launch: Callable, dt: Array) -> Anchors:
        """The anchors after passes over all contacts; so many impact passes are `done` already, None: none."""
        always = driven(world)  # acts in every step, without an impact before
        resting = jnp.broadcast_to(flags(always, start.t0), (len(always), *start.t0.shape[1:]))

        # For reverse mode a pass is cheaper to recompute than to save, and compiles faster so, except for its searches.
        @saving(FOUND)
        def one_pass(now, phase):
            return _pass(world, now, launch, dt, phase)

        def maybe(now, following):
            now, (count, phase) = checkpoint_name(now, PASSED), following
            impacts = now.found if done is None else now.found & (count >= done)
            needed = jnp.where(phase == IMPACT, impacts, any_world(now.rests))
            if now.known is not None:
                again = (phase == WEIGH) | (phase == REVERSE)
                needed = jnp.where(again, any_world(now.known.reverses()), needed)
            return lax.cond(needed, lambda now: one_pass(now, phase), lambda now: now, now), None

        nothing = jnp.zeros((_rows(world), *start.state.x.shape[1:]), start.t0.dtype)
        trial = nothing if may_weigh(world) else None
        known = Known(P=nothing, early=nothing, rubs=nothing[:, 0], trial=trial) if is_loaded(world) else None
        known, rests = with_tangents(known, (world, dt)), jnp.full(dt.shape, any(always))
        supported = jnp.zeros(start.t0.shape, bool) if matters(world) else None
        first = Progress(start, resting, supported, known, jnp.asarray(True), rests)
        phases = jnp.array(list(enumerate(self._phases(world))), np.int32)
        return checkpoint_name(lax.scan(maybe, first, phases)[0].anchors, PASSED)

    def _phases(self, world: "World") -> list[int]:
        rows_only, loaded = all(driven(world)), is_loaded(world)  # motors and joint friction: no impacts, no gaps
        impacts = 0 if rows_only else self.sweeps + HOLDS * waits(world)
        again = [WEIGH] * may_weigh(world) + [REVERSE] * loaded
        return [IMPACT] * impacts + [HOLD] + again + [PUSH] * (not rows_only)

    def saved_numbers(self, world: "World") -> int:
        """Approximate count of numbers saved per step (FOUND, PASSED) for reverse mode without recomputing the step."""
        if not ends(world)["a"]:
            return 0
        of_bodies = (6 * world.dim - 3) * len(world.names)  # their states, and times
        of_rows = (5 * world.dim + 8) * _rows(world)  # impulses found, twice, and known, times, gaps
        return len(self._phases(world)) * (of_bodies + of_rows)


def _rows(world: "World") -> int:
    """Number of rows: contacts, rolling rows, and rows of joints. Static."""
    return len(driven(world)) + is_rolling(world) * contact_count(world)


def _holds_all(world: "World") -> bool:
    """Whether HOLD leaves all bodies of a world of motors and joint friction at the end of the step. Static.

    Each body is then joined, perhaps through others, to one on which such a row acts.
    """
    held = {*ends(world)["a"], *ends(world)["b"]}
    return all(not held.isdisjoint(bodies) for bodies in islands(ends_of(world.joints), len(world.names)))


def may_weigh(world: "World") -> bool:
    """Whether friction of contacts may change the normal forces of bodies that joints connect. Static."""
    return is_loaded(world) and bool(world.joints) and not (is_rolling(world) or all(driven(world)))


class Progress(NamedTuple):
    """State handed from pass to pass."""

    anchors: Anchors
    resting: Array  # (C, *batch) bool: contacts that rest
    supported: Array | None  # (N, *batch) bool: bodies that rest on something where their paths begin
    known: Known | None
    found: Array  # bool: in the pass before contacts were struck or held, or came to rest, in some world
    rests: Array  # (*batch) bool: some contact of a world rests


def _pass(world: "World", now: Progress, launch: Callable, dt: Array, phase: Array) -> Progress:
    anchors, resting, supported, known, _, rests = now
    impact, weigh, reverse, push = (phase == kind for kind in (IMPACT, WEIGH, REVERSE, PUSH))
    flight = launch(anchors.state, anchors.t0)
    if supported is not None:
        look = functools.partial(find_supported, world, flight, anchors.since, dt)
        supported = checkpoint_name(lax.cond(impact, look, lambda kept=supported: kept), FOUND)
    strikes = find_strikes(world, flight, anchors.since, dt, ~impact, resting, supported)
    opened = jnp.zeros(dt.shape, bool) if known is None else push & known.opened(strikes)
    # A world without resting contacts holds none at the end: on its own it would skip this pass.
    strikes = replace(strikes, gap=_closed(strikes, opened), held=strikes.held & (impact | rests)[None])
    rested = resting
    strikes, law, held_for, resting = _demanded(world, anchors, flight, strikes, resting, dt, phase)
    if known is not None:
        skips = (weigh | reverse) & ~known.reverses()
        unused = skips | (push & ~opened)
        strikes = replace(strikes, active=strikes.active & ~skips[None])

    def strike(anchors, known):
        kick = jnp.where(push, 0.0, 1.0).astype(dt.dtype)
        applied = functools.partial(apply_impulses, world, anchors, flight, strikes, law, kick, held_for)
        if known is None:
            return applied(None, weigh)[0], None
        nothing = jax.tree.map(jnp.zeros_like, known)
        after, friction, load = applied(choose(unused, nothing, known).there(strikes), weigh)
        friction = choose((phase == HOLD) | weigh, friction, nothing)
        reverses, load = friction.reverses(), jnp.where(impact | push, 0.0, load)
        following = replace(friction, P=jnp.where(reverses, friction.P, load))
        return choose(reverses, anchors, after), choose(skips, known, following)

    any_now = any_world(strikes.active)
    anchors, known = lax.cond(any_now, recomputed(strike, dt), lambda *kept: kept, anchors, known)
    # What comes to rest hid what the same two may do later in the step.
    found = any_now | any_world(impact & resting & ~rested)
    return Progress(anchors, resting, supported, known, found, (resting | strikes.rests).any(0))


def _closed(strikes: Strikes, opened: Array) -> Array:
    """Gaps (C, *batch) [m], zero where only rounding opened them (unless the world is `opened`); derivatives kept."""
    closed = (strikes.gap > 0) & (strikes.gap <= strikes.rounding) & ~opened[None]
    return jnp.where(closed, strikes.gap - lax.stop_gradient(strikes.gap), strikes.gap)


def _demanded(
    world: "World", anchors: Anchors, flight: Flight, strikes: Strikes, resting: Array, dt: Array, phase: Array
) -> tuple[Strikes, Law, Array, Array]:
    """Contacts that take part in a pass, their law, for how long [s] they are held, and which contacts rest.

    A contact is struck when it is its turn: its normal velocity becomes restitution times the closing speed, or 0 if it
    comes to rest. A resting contact is held: it must not close, except by as much as its gap is open.
    """
    push, drives = phase == PUSH, flags(driven(world), dt[None])
    u, closing_acc = (-jax.vmap(dot)(strikes.normal, motion) for motion in (strikes.v_rel, strikes.pull))
    restitution, friction = (coefficients(world, name, dt.shape) for name in ("restitution", "friction"))
    if world.bodies.restitution_falloff is not None:
        restitution = restitution_at(u, restitution, coefficients(world, "restitution_falloff", dt.shape))
    # Bodies that only a spin brings together again bounce: rest would cost them energy. But speeds and times shrink by
    # the restitution with each bounce, and what has lost all speed by the end of the step may lose it at once.
    presses = jnp.minimum(closing_acc, strikes.press)
    bounced_out = jnp.maximum(presses, (1.0 - restitution) * closing_acc)
    width = world.contact.width
    presses = bounced_out if width is None else jnp.where((width > 0)[None], presses, bounced_out)
    stays = comes_to_rest(u, restitution * u, presses, dt[None] - strikes.s, world.contact.rest_speed[None])
    held, resting = _held(world, strikes, resting, stays, u <= _fallen(world, flight, strikes, closing_acc, dt), phase)
    began = jnp.maximum(*(at_colliders(anchors.t0, side, -jnp.inf) for side in (strikes.a, strikes.b)))
    held_for = jnp.where(push | ~held, 0.0, strikes.s - began)
    # A gap that is open at the end may close by itself, which the impulse does in half of the time it is held for.
    opened = strikes.gap - LEFT * dt[None] ** 2 * jnp.maximum(closing_acc, 0.0)
    may_close = jnp.minimum(-u - 2.0 * safe_divide(jnp.maximum(opened, 0.0), held_for), 0.0)
    of_rest = jnp.where(push | (opened <= 0), 0.0, may_close)
    of_impact = jnp.where(stays, 0.0, restitution * u)
    target, force = driving(world, jnp.where(held, of_rest, of_impact))
    most = None if force is None else jnp.where(drives, force * held_for, jnp.inf)
    apart = jnp.maximum(strikes.gap, -strikes.deepest)
    v_rel = jnp.where(push, apart[:, None] * strikes.normal, strikes.v_rel)
    law = Law(target, jnp.where(push, 0.0, friction), most)
    now = held | (strikes.active & strikes.now)
    return replace(strikes, active=now, held=held, v_rel=v_rel), law, held_for, resting


def _held(
    world: "World", strikes: Strikes, resting: Array, stays: Array, fallen: Array, phase: Array
) -> tuple[Array, Array]:
    """Which contacts are held in this pass, and which rest after it, (C, *batch) bool.

    Args:
        resting: which rested before.
        stays: which would come to rest if they were struck now.
        fallen: which close no faster than after a step of free fall, so that they rested before it.
    """
    impact, again, drives = phase == IMPACT, (phase == WEIGH) | (phase == REVERSE), flags(driven(world), resting)
    held = strikes.active & strikes.held & (~impact | strikes.rests) & (resting | fallen)
    u, least = -jax.vmap(dot)(strikes.normal, strikes.v_rel), world.contact.rest_speed[None]
    slow = u <= least
    comes = strikes.active & ~strikes.held & (slow | (strikes.now & stays))
    # Where friction has slowed a body, other corners may touch at the end than those that were held. A contact that was
    # struck just then parts: its gap is zero, but not what it depends on.
    parts = (u < -least) & (strikes.gap >= -strikes.rounding)
    touches = strikes.active & (resting | (jnp.abs(u) <= least)) & ~parts & ~drives
    held = jnp.where(phase == PUSH, touches, held)
    return held, jnp.where(impact, resting | held | comes, jnp.where(again, resting, held))


def _fallen(world: "World", flight: Flight, strikes: Strikes, closing_acc: Array, dt: Array) -> Array:
    """Largest closing speed (C, *batch) [m/s] that a resting contact reaches in a step of free fall of both bodies.

    Along its normal: what two bodies on a floor do beside each other has nothing to do with their weight.
    """
    along = [
        jnp.abs(jax.vmap(dot)(strikes.normal, at_colliders(flight.a, side, 0.0))) for side in (strikes.a, strikes.b)
    ]
    return world.contact.rest_speed[None] + 2.0 * dt[None] * jnp.maximum(jnp.maximum(*along), closing_acc)
