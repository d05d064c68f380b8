"""Ordering within a step: each body takes its first impact, and until then its supports hold it up.

Bodies that rest on each other, or are joined, do not fall freely until one of them is struck: one pass holds them until
then, as the end of a step does, and a later pass applies the impact. An inelastic impact acts on the whole cluster at
once, because passed on from body to body it would never end. An elastic one is passed on, as in Newton's cradle.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from diffrigid.branches import any_world
from diffrigid.contact.sums import alike, at_colliders, body_sides
from diffrigid.elimination import islands
from diffrigid.forces import ties
from diffrigid.gathers import rows
from diffrigid.linkage import ends_of
from diffrigid.pytree import array, pytree, replace

if TYPE_CHECKING:
    from diffrigid.world import World

# Times no longer than eps ** SOON of a step need not be held. Else a gap of rounding would take a sweep.
SOON = 0.4
EARLY = 0.1  # [-] share of a longer time until an impact that is left to the next pass, see `_of_clusters`


@pytree
class Meeting:
    """When two colliders meet, or a joint reaches its limit; many with a leading axis."""

    s: Array = array()  # [s] of the impact, if there is one before the end of the step; else its end
    hit: Array = array()  # bool: there is one, or the contacts are those at the end
    fast: Array = array()  # bool: an impact that is not slow
    rests: Array = array("K")  # bool, of each contact: it touches from the start of the path on
    feature: Any = array("K", default=None)  # of these contacts, as in `Contacts`
    level: Any = array(default=None)  # [m] gap at which they meet
    slack: Any = array(default=None)  # [m] contacts whose gaps differ by no more are simultaneous
    now: Any = array(default=None)  # bool: this impact is handled in this pass
    joins: Any = array(default=None)  # bool: the resting contacts take part in an impact of this pass
    held: Any = array(default=None)  # bool: s is the time until which the resting contacts are held


def companions(world: "World") -> tuple[tuple[int, ...], ...]:
    """For each body, those whose paths begin at one time with its own, itself included. Static.

    They are connected by joints, or by forces: of two bodies that are at different times no force is known.
    """
    moving = len(world.names)
    return islands([*ends_of(world.joints), *ties(world.forces, moving)], moving)


class Links(NamedTuple):
    """Which bodies may act on each other: M links between two colliders, and N bodies with their companions."""

    a: tuple[int, ...]  # colliders of each link: bodies, then statics
    b: tuple[int, ...]
    islands: tuple[tuple[int, ...], ...]  # of each body, its `companions`

    def of_bodies(self, reduce: Callable, values: Array, none: Any) -> Array:
        """Reduce values (M, *batch) over the links of each body's island, (N, *batch); `none` if it has no links."""
        padded = jnp.concatenate([values, values, jnp.full_like(values[:1], none)])
        sides = body_sides(self.a, self.b, len(self.islands))
        return over_islands(reduce, reduce(rows(padded, sides), axis=1), self.islands, none)

    def least(self, of_bodies: Array, still: Any) -> Array:
        """Smaller value (N, *batch) of the two bodies of each link, (M, *batch); `still` stands in for a static."""
        return jnp.minimum(at_colliders(of_bodies, self.a, still), at_colliders(of_bodies, self.b, still))


def in_order(
    meetings: list[Meeting], links: Links, t0: Array, dt: Array, at_end: Array, bounces: Array | None
) -> list[Meeting]:
    """Set `now`, `joins` and `held` of the meetings: whose turn it is in this pass.

    Args:
        meetings: of the links, M in all.
        links: an impact reaches all companions of a body.
        t0: (N, *batch) [s] where their paths begin.
        at_end: bool; True: all are at the end of the step.
        bounces: (M, *batch) bool: there is restitution between them. None: no bodies have to be held until an impact.
    """
    s, fast, rests = (
        jnp.concatenate(parts) for parts in zip(*((m.s, m.fast, m.rests.any(1)) for m in meetings), strict=True)
    )
    tie = jnp.sqrt(jnp.finfo(dt.dtype).eps) * dt[None]

    def first_of(impacts: Array) -> Array:
        return links.of_bodies(jnp.min, jnp.where(impacts, s, jnp.inf), jnp.inf)

    first = first_of(fast)
    # Contacts that close slowly at the time of an impact, as by rounding, take no part: touching balls pass it on.
    now = fast & (jnp.abs(lax.stop_gradient(s - links.least(first, jnp.inf))) <= tie)
    held = jnp.broadcast_to(at_end, s.shape)
    joins = jnp.zeros_like(now)
    if bounces is not None:

        def of_clusters(first: Array, first_bounce: Array) -> tuple[Array, Array]:
            return _of_clusters(first, first_bounce, rests, links, t0, dt)

        def free(first: Array, _: Array) -> tuple[Array, Array]:
            return (jnp.full_like(first, jnp.inf),) * 2

        of_both = lax.cond(any_world(rests) & any_world(fast), of_clusters, free, first, first_of(fast & bounces))
        until, along = (links.least(of_bodies, jnp.inf) for of_bodies in of_both)
        waits, joins = until < jnp.inf, (rests | now) & ~bounces & (along < jnp.inf)
        now, held = (now & ~waits) | joins, held | (waits & rests)
        s = jnp.where(waits & rests, until, jnp.where(joins, along, s))
    return [
        replace(m, s=s, hit=m.hit | held | joins, now=now & ~at_end, joins=joins & ~at_end, held=held)
        for m, s, now, joins, held in _with_own(meetings, s, now, joins, held)
    ]


def at_once(meetings: list[Meeting], a: tuple[int, ...], b: tuple[int, ...]) -> list[Meeting]:
    """Let all shapes of two colliders meet when the first of them do, as the corners of one shape do.

    Args:
        meetings: of the pairs of shapes, between the colliders a and b (P,).
    """
    both = tuple(tuple(sorted(pair)) for pair in zip(a, b, strict=True))
    if len(set(both)) == len(both):
        return meetings
    s, fast, hit = (jnp.concatenate([getattr(m, name) for m in meetings]) for name in ("s", "fast", "hit"))
    impacts = jnp.where(fast, s, jnp.inf)
    first = rows(jnp.concatenate([impacts, jnp.full_like(s[:1], jnp.inf)]), alike(both)).min(1)
    strikes = first < jnp.inf
    s, fast, hit = jnp.where(strikes, first, s), fast | strikes, hit | strikes
    return [replace(m, s=s, fast=fast, hit=hit) for m, s, fast, hit in _with_own(meetings, s, fast, hit)]


def _with_own(meetings: list[Meeting], *values: Array) -> Iterator[tuple]:
    """Each of the meetings, with its own rows of values over all of them (M, *batch)."""
    start = 0
    for m in meetings:
        own = slice(start, start + len(m.s))
        yield (m, *(value[own] for value in values))
        start = own.stop


def hanging_together(on: Array, links: Links) -> Array:
    """Connected component of each of N bodies, (N, *batch) int: the smallest index of the bodies in it.

    Args:
        on: (M, *batch) bool: the link connects its two bodies. Statics connect nothing.
    """
    moving = len(links.islands)
    number = lax.broadcasted_iota(jnp.int32, (moving, *on.shape[1:]), 0)

    def spread(carry: tuple) -> tuple:
        label, _ = carry
        least = jnp.where(on, links.least(label, moving), moving)
        least = jnp.minimum(label, links.of_bodies(jnp.min, least, moving))
        return least, any_world(least < label)

    return lax.while_loop(lambda carry: carry[1], spread, (number, jnp.asarray(True)))[0]


def _of_clusters(
    first: Array, first_bounce: Array, rests: Array, links: Links, t0: Array, dt: Array
) -> tuple[Array, Array]:
    """Until when each body is held, and when it takes part in an impact without restitution; (N, *batch) [s].

    inf where a body is not held, or takes part in no such impact. Bodies that are held strike somewhat later or earlier
    than in the free fall that tells the time; if earlier, they would fall back to it. So they are held for most of it
    first, and then, from there, for the rest, which is a hundred times as accurate.

    Args:
        first, first_bounce: (N, *batch) [s] its own next impact, and that with restitution.
        rests: (M, *batch) bool: the two of a link touch.
    """
    label = hanging_together(rests, links)
    member = label[None] == label[:, None]
    until, bounce, begins = (jnp.where(member, t[None], jnp.inf).min(1) for t in (first, first_bounce, t0))
    supported = (member & links.of_bodies(jnp.max, rests, False)[None]).any(1) & (until < jnp.inf)
    wait = until - begins
    waits = wait > jnp.finfo(dt.dtype).eps ** SOON * dt[None]
    held, along = supported & waits, supported & ~waits & (until < bounce)
    most = jnp.where(wait > EARLY * dt[None], until - EARLY * wait, until)
    return jnp.where(held, most, jnp.inf), jnp.where(along, until, jnp.inf)


def over_islands(reduce: Callable, values: Array, islands: tuple, none: Any) -> Array:
    """Reduce values of the bodies (N, ...) over the island of each, (N, ...)."""
    most = max(map(len, islands))
    if most == 1:
        return values
    padded = jnp.concatenate([values, jnp.full_like(values[:1], none)])
    return reduce(rows(padded, tuple(i + (len(islands),) * (most - len(i)) for i in islands)), axis=1)
