"""Contacts between the bodies of a trajectory, and their impulses. NumPy.

A trajectory stores states, not impulses, so they are inferred, one interval between two stored times after the other:

    who touches    shapes that come together on their free flight from the start of the interval, or lie together
                   through it; corner against side or face, and in 3D edge against edge, of the cores
    impulses       the smallest that, at these points and in the joints, explain the changes of momentum, see `impulses`

Contacts with a `Profile` or a `HeightField` are not found, and their effect is attributed to other contacts of the same
bodies. Nor are contacts within a crowd, which lists no pairs.
"""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from diffrigid.convert import numbers
from diffrigid.hull import hull_faces
from diffrigid.impulses import Changes, changes_of, impulses_at
from diffrigid.pytree import replace
from diffrigid.shapes import UNEVEN, Box, HalfSpace, Hull, edges, radius, vertices
from diffrigid.tables import lined_up, moment
from diffrigid.touch import Convex, gaps, rotated
from diffrigid.trajectory import Trajectory, checked
from diffrigid.world import World

SHOWN = 30  # impacts that are printed
SLOP = 2e-3  # [-] of the smaller size: gap up to which bodies touch
TOGETHER = 1e-2  # [-] of it: gap up to which other points take part in an impact
STRUCK = 1e-5  # [-] of the impulse of the forces: a smaller change of momentum is none
BEYOND = 1.1  # [-] times the sizes,
FASTER = 1.5  # [-] and times the path at the first speed: what is further apart does not meet
NO_SIZE = 1e-9  # [m, N s] where there is no size, no force
WORK = 4_000_000  # pairs times intervals beyond which not all stored times are examined
SUPPORTED = 1.2  # [-] of the impulse of the forces: a support balances them, an impact changes the momentum by more
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


class Touch(NamedTuple):
    """Contacts of all intervals, in any order; M of them."""

    interval: np.ndarray  # (M,)
    s: np.ndarray  # (M,) [s] since the start of the interval
    new: np.ndarray  # (M,) bool: apart at the start of the interval
    a: np.ndarray  # (M,) colliders
    b: np.ndarray
    point: np.ndarray  # (M, D) [m]


class Sampled(NamedTuple):
    """All colliders at the times looked at; those that do not move have no velocity."""

    t: np.ndarray  # (T+1,) [s]
    x: np.ndarray  # (T+1, N + S, D)
    q: np.ndarray  # (T+1, N + S, Q)
    v: np.ndarray  # (T+1, N + S, D)
    w: np.ndarray  # (T+1, N + S, A)
    a: np.ndarray  # (T, N + S, D) [m/s^2] before an impact in the interval; 0 where a support or a joint may balance it


def _numbers(vector: np.ndarray) -> str:
    seen = np.where(np.abs(vector) > 1e-9 * np.abs(vector).max(), vector, 0.0)  # without rounding
    return "  ".join(f"{number:.3g}" for number in seen)


def contacts(trajectory: Trajectory, times: np.ndarray | None = None) -> Meetings:
    """Find when, where and with what impulses bodies of a trajectory touch: M contacts in order of time.

    `t` (M,) [s], `impact` (M,) or else rest, colliders `a` and `b` (M,) numbered as bodies, then statics; in world axes
    `point` (M, D) [m] and `impulse` (M, D) [N s] on `a`, or on `b` where only that moves; and `names` of all colliders.
    NumPy, without derivatives. It prints as a table.

    A trajectory stores states, and not impulses: these are the least that explain its changes of momentum. Where a body
    strikes two others between two stored times, only their sum is sure: store more times. Contacts with a `Profile` or
    a `HeightField`, and those within a crowd (256 bodies and more, see `Contact`), are not found.

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
    checked(trajectory)
    if times is not None:
        numbers("times", times, None)  # checked, but used in double precision
    world, dim = trajectory.world, trajectory.world.dim
    names = world.names + world.static_names
    some = _thinned(trajectory)
    changes = changes_of(some)
    motion = _motion(some, changes)
    groups = [group for group in world.pairs if not isinstance(world.shapes[group.shape_b], UNEVEN)]
    found = [_touches(world, group, motion, changes) for group in groups]
    touch = Touch(*(np.concatenate(parts) for parts in zip(*found, strict=True))) if found else None
    if touch is None or not len(touch.s):
        none = np.zeros(0, int)
        return Meetings(np.zeros(0), none > 0, none, none, np.zeros((0, dim)), np.zeros((0, dim)), names)
    k, ends = touch.interval, np.stack([touch.a, touch.b])
    arms = touch.point - motion.x[k, ends] - touch.s[:, None] * motion.v[k, ends]
    impulse = impulses_at(changes, k, ends, arms)
    impulse = np.where(touch.a[:, None] < len(world.names), impulse, -impulse)
    size, push = np.linalg.norm(impulse, axis=1), changes.push
    moved = np.concatenate([push, np.zeros((len(push), len(world.static_names)))], axis=1)
    rough = size > ROUGH * moved[k, ends].max(0)
    impact = touch.new | rough
    drawn = np.ones(len(touch.s), bool)
    if times is not None:
        begins = np.asarray(times, float) - 0.5 * np.diff(motion.t).min()
        drawn = np.isin(touch.interval, np.searchsorted(motion.t, begins))
    kept = (size > 1e-6 * size.max()) & (impact | drawn)
    t = motion.t[touch.interval] + touch.s
    kept = np.flatnonzero(kept)[np.argsort(t[kept], kind="stable")]
    return Meetings(t[kept], impact[kept], touch.a[kept], touch.b[kept], touch.point[kept], impulse[kept], names)


def order_of_impacts(trajectory: Trajectory) -> tuple[str, ...]:
    """Names of the pairs that strike each other, in order of time: ("cue-ball", "ball-wall").

    Several points of one pair at a time are one impact. Those of different pairs that are closer in time than a
    hundredth of a step count as simultaneous, and are listed by name, so that rounding does not tell them apart.
    """
    found = contacts(trajectory, np.zeros(0))
    near = 0.01 * float(np.median(np.diff(trajectory.t)))
    whole = np.cumsum(np.diff(found.t[found.impact], prepend=0.0) > near)  # times that are near share a number
    pairs = [
        f"{found.names[a]}-{found.names[b]}" for a, b in zip(found.a[found.impact], found.b[found.impact], strict=True)
    ]
    return tuple(pair for _, pair in sorted(set(zip(whole.tolist(), pairs, strict=True))))


def _thinned(trajectory: Trajectory) -> Trajectory:
    pairs = sum(len(group.a) for group in trajectory.world.pairs)
    every = 1 + pairs * len(trajectory.t) // WORK
    t, state = jax.tree.map(lambda leaf: np.asarray(leaf, float)[::every], (trajectory.t, trajectory.state))
    controls = jax.tree.map(lambda leaf: leaf[::every][: len(t) - 1], trajectory.controls)
    return replace(trajectory, t=t, state=state, controls=controls)


def _motion(trajectory: Trajectory, changes: Changes) -> Sampled:
    state, still = trajectory.state, trajectory.world.statics
    count, steps = len(trajectory.world.static_names), len(trajectory.t)

    def joined(moving, rest):
        return np.concatenate([moving, np.broadcast_to(rest, (steps, count, moving.shape[2]))], axis=1)

    x, q = (joined(*both) for both in ((state.x, np.asarray(still.x, float)), (state.q, np.asarray(still.q, float))))
    held = np.isin(np.arange(x.shape[1] - count), changes.joints.ends)
    hit = (np.linalg.norm(changes.p, axis=2) > SUPPORTED * changes.push) & ~held
    a = np.concatenate([hit[..., None] * changes.fall, np.zeros((steps - 1, count, x.shape[2]))], axis=1)
    return Sampled(np.asarray(trajectory.t), x, q, joined(state.v, 0.0), joined(state.w, 0.0), a)


def _touches(world: World, group: Any, motion: Sampled, changes: Changes) -> Touch:
    """Contacts of all pairs of one kind."""
    sides = _side(world, group.shape_a), _side(world, group.shape_b)
    a, b, rows = np.array(group.a), np.array(group.b), (np.array(group.row_a), np.array(group.row_b))
    h, size = np.diff(motion.t), np.minimum(sides[0].size[rows[0]], sides[1].size[rows[1]])
    change = np.linalg.norm(changes.p, axis=2) + np.linalg.norm(changes.L, axis=2) / max(size.min(), NO_SIZE)
    struck = change > STRUCK * (changes.push + NO_SIZE)
    struck = np.concatenate([struck, np.zeros((len(struck), len(world.static_names)), bool)], axis=1)
    apart = np.linalg.norm(motion.x[:-1, a] - motion.x[:-1, b], axis=2)
    path = h[:, None] * np.linalg.norm(motion.v[:-1, a] - motion.v[:-1, b], axis=2)
    reach = BEYOND * (sides[0].size[rows[0]] + sides[1].size[rows[1]]) + FASTER * path
    k, pair = np.nonzero((struck[:, a] | struck[:, b]) & (apart < reach))
    slop, row_a, row_b = SLOP * size[pair], rows[0][pair], rows[1][pair]

    def at(s, chosen=slice(None)):
        """Gaps (M, C) and points (M, C, D) when the bodies have flown freely for s (M,)."""
        poses = [_flown(motion, k[chosen], body[pair[chosen]], s) for body in (a, b)]
        return gaps(sides[0].take(row_a[chosen]), poses[0], sides[1].take(row_b[chosen]), poses[1])

    start, _ = at(np.zeros(len(k)))
    end, _ = at(h[k])
    new, meets = start.min(1, initial=np.inf) > slop, end.min(1, initial=np.inf) <= slop
    s = _meeting(at, h[k], new & meets)
    gap, point = at(s)
    near = (gap <= (2 * slop + TOGETHER * size[pair] * new)[:, None]) & (
        gap <= gap.min(1, keepdims=True, initial=np.inf) + 4 * slop[:, None]
    )
    near &= meets[:, None] & (new[:, None] | (end <= slop[:, None]))
    near &= ~_repeated(point, near, 10 * slop)
    row, c = np.nonzero(near)
    return Touch(k[row], s[row], new[row], a[pair[row]], b[pair[row]], point[row, c])


def _side(world: World, group: int) -> Convex:
    """Corners, edges and faces of the rows of one entry of `world.shapes`, from the centres of their bodies."""
    records, offset, dim = world.shapes[group], world.offsets[group], world.dim
    shapes = [
        jax.tree.map(lambda leaf, row=row: np.asarray(leaf)[row], records) for row in range(len(world.owners[group]))
    ]
    if isinstance(records, HalfSpace):
        normal = np.asarray(records.normal, float)
        return Convex(None, normal, np.asarray(records.offset, float), (), (), np.full(len(normal), np.inf))
    corners = np.array([vertices(shape, dim) for shape in shapes], float)
    if offset is not None:
        turned = corners if offset.q is None else rotated(np.asarray(offset.q, float)[:, None], corners)
        corners = turned + np.asarray(offset.r, float)[:, None]
    rounding = np.array([radius(shape) for shape in shapes], float)
    count = corners.shape[1]
    if dim == 2:
        sides = tuple((i, (i + 1) % count) for i in range(count if count > 2 else 1))
        faces: tuple = ()
    else:
        sides = edges(shapes[0], dim) or ((0, 0),)
        faces = (records.faces or ()) if isinstance(records, Hull) else _box_faces() if count > 3 else ()
    return Convex(corners, None, rounding, sides, faces, np.linalg.norm(corners, axis=2).max(1) + rounding)


@functools.cache
def _box_faces() -> tuple:
    """Faces of any box, one without thickness included."""
    return tuple(hull_faces(np.array(vertices(Box(half=(1.0, 1.0, 1.0)), 3), float)))


def _flown(motion: Sampled, k: np.ndarray, body: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (M, D), (M, Q) after a free flight of s (M,) without torques, which is near enough within an interval."""
    s = s[:, None]
    x = motion.x[k, body] + s * (motion.v[k, body] + 0.5 * s * motion.a[k, body])
    q, w = motion.q[k, body], s * motion.w[k, body]
    if q.shape[1] == 2:
        c, u = np.cos(w[:, 0]), np.sin(w[:, 0])
        return x, np.stack([c * q[:, 0] - u * q[:, 1], u * q[:, 0] + c * q[:, 1]], axis=1)
    half = 0.5 * np.linalg.norm(w, axis=1, keepdims=True)
    p0, p = np.cos(half), 0.5 * w * np.sinc(half / np.pi)
    first = p0 * q[:, :1] - (p * q[:, 1:]).sum(1, keepdims=True)
    return x, np.concatenate([first, p0 * q[:, 1:] + q[:, :1] * p + np.cross(p, q[:, 1:])], axis=1)


def _meeting(at, h: np.ndarray, flying: np.ndarray) -> np.ndarray:
    """Times (M,) at which the least gap becomes zero, by bisection; 0 for those that touch from the start."""
    s, chosen = np.zeros(len(h)), np.flatnonzero(flying)
    low, high = np.zeros(len(chosen)), h[chosen].copy()
    for _ in range(14 if len(chosen) else 0):
        middle = (low + high) / 2
        closed = at(middle, chosen)[0].min(1) <= 0
        low, high = np.where(closed, low, middle), np.where(closed, middle, high)
    s[chosen] = high
    return s


def _repeated(point: np.ndarray, near: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Whether candidates (M, C) are at the place of an earlier one of the same pair."""
    repeated, several = np.zeros_like(near), np.flatnonzero(near.sum(1) > 1)
    for row in several:
        chosen = np.flatnonzero(near[row])
        places = point[row, chosen]
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)
        repeated[row, chosen] = np.tril(apart < distance[row], -1).any(1)
    return repeated
