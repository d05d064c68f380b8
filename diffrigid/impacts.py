"""Contacts between the bodies of a trajectory, and their impulses. NumPy, but where steps are made again.

A trajectory stores states, not impulses, so they are inferred, one interval between two stored times after the other:

    who touches    shapes that meet or lie together, see `touch`
    impulses       the smallest that, at these points and in the joints, explain the changes of momentum, see `impulses`

Where impacts follow each other within an interval, a step to the time right after each tells them apart.

Contacts with a `Profile` or a `HeightField` are not found, and their effect is attributed to other contacts of the same
bodies. Nor are contacts within a crowd, which lists no pairs.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np

from diffrigid.contact.materials import material, mixed
from diffrigid.convert import numbers
from diffrigid.impulses import Changes, Touching, changes_of, impulses_at
from diffrigid.pytree import replace
from diffrigid.state import State
from diffrigid.step import step
from diffrigid.tables import lined_up, moment
from diffrigid.touch import Touch, sampled, touches
from diffrigid.trajectory import Trajectory, checked
from diffrigid.world import World

SHOWN = 30  # impacts that are printed
WORK = 4_000_000  # pairs times intervals beyond which not all stored times are examined
PARTS = 2  # times at most that intervals are divided,
CUTS = 200  # of these at most so many, one time
AFTER = 0.01  # [-] of an interval: so long after an impact,
ALIKE = 1e-3  # [-] of it: impacts that are closer are one
REMAINS = 0.02  # [-] of the largest change of momentum in an interval, and of the impulse of the forces
LEAST = 1e-6  # [-] of the largest impulse: what is listed
ROUGH = 5.0  # [-] an impulse that exceeds that of the forces in an interval by this factor is an impact


class Meetings(NamedTuple):
    """Contacts of a trajectory, in order of time; M of them. Colliders are numbered as in `World`."""

    t: np.ndarray  # (M,) [s]
    impact: np.ndarray  # (M,) bool: an impact, else rest
    a: np.ndarray  # (M,) colliders
    b: np.ndarray
    point: np.ndarray  # (M, D) [m]
    impulse: np.ndarray  # (M, D) [N s] on one that moves
    names: tuple[str, ...]  # of the colliders

    def __repr__(self) -> str:
        """A table of the first impacts, and when which pairs rest on each other."""
        pairs = np.array([f"{self.names[a]}-{self.names[b]}" for a, b in zip(self.a, self.b, strict=True)], object)
        strikes = np.flatnonzero(self.impact)
        rows = [
            (moment(self.t[k]), pairs[k], _numbers(self.point[k]), _numbers(self.impulse[k])) for k in strikes[:SHOWN]
        ]
        lines = lined_up(("impact at t [s]", "pair", "point [m]", "impulse [N s]"), rows)
        lines += [f"and {len(strikes) - SHOWN} more"] if len(strikes) > SHOWN else []
        for pair in dict.fromkeys(pairs[~self.impact]):
            t = self.t[~self.impact & (pairs == pair)]
            lines.append(f"at rest: {pair}, {len(t)} contacts from {moment(t[0], 3)} to {moment(t[-1], 3)} s")
        return "\n".join(lines)


def _numbers(vector: np.ndarray) -> str:
    seen = np.where(np.abs(vector) > 1e-9 * np.abs(vector).max(), vector, 0.0)  # without rounding
    return "  ".join(f"{number:.3g}" for number in seen)


def contacts(trajectory: Trajectory, times: np.ndarray | None = None) -> Meetings:
    """Find when, where and with what impulses bodies of a trajectory touch: M contacts in order of time.

    `t` (M,) [s], `impact` (M,) or else rest, colliders `a` and `b` (M,) numbered as bodies, then statics; in world axes
    `point` (M, D) [m] and `impulse` (M, D) [N s] on `a`, or on `b` where only that moves; and `names` of all colliders.
    NumPy, without derivatives. It prints as a table.

    A trajectory stores states, and not impulses: these are the least that push, rub within their cones of friction, and
    explain its changes of momentum. Where a body is struck while it rests on another, or by two at once, how friction
    is shared between them is not unique. Contacts with a `Profile` or a `HeightField`, and those within a crowd (256
    bodies and more, see `Contact`), are not found.

    Args:
        times: (F,) [s] resting contacts are given only for intervals that begin then; default all.

    Raises:
        ValueError: not what `rollout` returns, traced, or a batch; times that are not numbers.

    Example:
        >>> bounce = dr.contacts(trajectory)
        >>> [(round(t, 2), bounce.names[a], bounce.names[b]) for t, a, b in zip(bounce.t.tolist(), bounce.a, bounce.b)]
        [(0.43, 'ball', 'floor')]
        >>> bounce.impulse.round(2).tolist()  # m (1 + e) u
        [[0.0, 7.56]]
    """
    return meetings(trajectory, times, PARTS)


def order_of_impacts(trajectory: Trajectory) -> tuple[str, ...]:
    """Names of the pairs that strike each other, in order of time: ("cue-ball", "ball-wall").

    Several points of one pair at a time are one impact. Those of different pairs that are closer in time than a
    hundredth of a step count as simultaneous, and are listed by name, so that rounding does not tell them apart.
    """
    found = meetings(trajectory, np.zeros(0))
    near = 0.01 * float(np.median(np.diff(trajectory.t)))
    whole = np.cumsum(np.diff(found.t[found.impact], prepend=0.0) > near)  # times that are near share a number
    pairs = [
        f"{found.names[a]}-{found.names[b]}" for a, b in zip(found.a[found.impact], found.b[found.impact], strict=True)
    ]
    return tuple(pair for _, pair in sorted(set(zip(whole.tolist(), pairs, strict=True))))


def meetings(trajectory: Trajectory, times: np.ndarray | None = None, parts: int = 0) -> Meetings:
    """As `contacts`; with 0 `parts` no step is compiled, and impacts that follow others within an interval may lack."""
    checked(trajectory)
    if times is not None:
        numbers("times", times, None)  # checked, but used in double precision
    world, names = trajectory.world, trajectory.world.names + trajectory.world.static_names
    some = _thinned(trajectory)
    shortest, seen = np.diff(some.t).min(), _seen(some)
    for _ in range(parts):
        parted = _parted(some, seen)
        if len(parted.t) == len(some.t):
            break
        some, seen = parted, _seen(parted)
    touch, k, ends = seen.touch, seen.touch.interval, np.stack([seen.touch.a, seen.touch.b])
    impulse = np.where(touch.a[:, None] < len(world.names), seen.impulse, -seen.impulse)
    size, push = np.linalg.norm(impulse, axis=1), seen.changes.push
    moved = np.concatenate([push, np.zeros((len(push), len(world.static_names)))], axis=1)
    passes_on = ~touch.new & (size > ROUGH * moved[k, ends].max(0))  # an impact, at that of a third
    impact, s = touch.new | passes_on, np.full(len(push), np.inf)
    np.minimum.at(s, k[touch.new], touch.s[touch.new])
    s = np.where(passes_on & np.isfinite(s[k]), s[k], touch.s)
    drawn = np.ones(len(s), bool)
    if times is not None:
        drawn = np.isin(k, np.searchsorted(some.t, np.asarray(times, float) - 0.5 * shortest))
    kept, t = (size > LEAST * size.max(initial=0.0)) & (impact | drawn), np.asarray(some.t)[k] + s
    kept = np.flatnonzero(kept)[np.argsort(t[kept], kind="stable")]
    return Meetings(t[kept], impact[kept], touch.a[kept], touch.b[kept], touch.point[kept], impulse[kept], names)


class Seen(NamedTuple):
    """What is found in the intervals of a trajectory."""

    changes: Changes
    touch: Touch
    impulse: np.ndarray  # (M, D) [N s] on a
    left: np.ndarray  # (T, N) [N s] sizes of the changes that the impulses do not explain


def _seen(trajectory: Trajectory) -> Seen:
    changes = changes_of(trajectory)
    motion = sampled(trajectory, changes)
    touch = touches(trajectory.world, motion, changes)
    k, ends = touch.interval, np.stack([touch.a, touch.b])
    arms = touch.point - motion.x[k, ends] - touch.s[:, None] * motion.v[k, ends]
    mu = _friction(trajectory.world, ends)
    return Seen(changes, touch, *impulses_at(changes, Touching(k, ends, arms, touch.normal, mu, touch.new)))


def _parted(trajectory: Trajectory, seen: Seen) -> Trajectory:
    """With the states right after impacts, in intervals whose impacts do not tell their impulses.

    There a body strikes two others, or something remains that a second impact has done.
    """
    touch, h, (steps, moving) = seen.touch, np.diff(trajectory.t), seen.left.shape[:2]
    first, last = np.full((steps, moving), np.inf), np.full((steps, moving), -np.inf)
    for side in (touch.a, touch.b):
        rows = np.flatnonzero(touch.new & (side < moving))
        np.minimum.at(first, (touch.interval[rows], side[rows]), touch.s[rows])
        np.maximum.at(last, (touch.interval[rows], side[rows]), touch.s[rows])
    whole = seen.changes.sizes()
    remains = seen.left > REMAINS * (whole.max(1, keepdims=True) + seen.changes.push)
    unclear = ((last - first > ALIKE * h[:, None]) | remains).any(1)
    cuts = []
    for k in np.unique(touch.interval[touch.new & unclear[touch.interval]]):
        times = np.unique(touch.s[touch.new & (touch.interval == k)])
        times = times[np.diff(times, prepend=-np.inf) > ALIKE * h[k]]
        after = np.minimum(times + AFTER * h[k], 0.5 * (times + np.append(times[1:], np.inf)))
        cuts += [(k, s) for s in after if s < (1 - AFTER) * h[k]]
    return _with_states(trajectory, cuts[:CUTS])


def _with_states(trajectory: Trajectory, cuts: list[tuple[int, float]]) -> Trajectory:
    """With the states at times s [s] after the beginnings of intervals k, where the world moves as it is stored."""
    world, lengths = trajectory.world, np.diff(trajectory.t)

    def stored(k: int) -> State:
        return jax.tree.map(lambda leaf: leaf[k], trajectory.state)

    def moved(k: int, s: float) -> State:
        return step(world, stored(k), s, jax.tree.map(lambda leaf: leaf[k], trajectory.controls))

    @functools.cache
    def as_stored(k: int) -> bool:
        off, change = (np.abs(state.v - stored(k + 1).v).max() for state in (moved(k, lengths[k]), stored(k)))
        return off <= REMAINS * change

    kept = [(k, s, moved(k, s)) for k, s in cuts if as_stored(k)]
    if not kept:
        return trajectory
    rows, since, new = zip(*kept, strict=True)
    at = np.array(rows) + 1
    state = jax.tree.map(lambda leaf, *new: np.insert(leaf, at, np.stack(new), axis=0), trajectory.state, *new)
    controls = jax.tree.map(lambda leaf: np.insert(leaf, at, leaf[at - 1], axis=0), trajectory.controls)
    t = np.insert(trajectory.t, at, trajectory.t[at - 1] + np.array(since))
    return replace(trajectory, t=t, state=state, controls=controls)


def _friction(world: World, ends: np.ndarray) -> np.ndarray:
    """Coefficients (M,) between the colliders `ends` (2, M)."""
    of_all = material(world, "friction", tuple(range(len(world.names + world.static_names))))
    of_all = jax.tree.map(lambda leaf: np.asarray(leaf, float), of_all)
    a, b = (jax.tree.map(lambda leaf, side=side: leaf[side], of_all) for side in ends)
    return np.asarray(mixed(a, b))


def _thinned(trajectory: Trajectory) -> Trajectory:
    pairs = sum(len(group.a) for group in trajectory.world.pairs)
    every = 1 + pairs * len(trajectory.t) // WORK
    t, state = jax.tree.map(lambda leaf: np.asarray(leaf, float)[::every], (trajectory.t, trajectory.state))
    controls = jax.tree.map(lambda leaf: leaf[::every][: len(t) - 1], trajectory.controls)
    return replace(trajectory, t=t, state=state, controls=controls)
