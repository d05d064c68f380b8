"""Where a record begins, as its first rows show it: poses, and velocities by a line through a few rows."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diffrigid import paths
from diffrigid.catalogue import component, order_of
from diffrigid.convert import known
from diffrigid.models.frames import to_quaternion
from diffrigid.state import State, rotations
from diffrigid.sysid.columns import Series
from diffrigid.sysid.free import Free
from diffrigid.sysid.parameters import Slot
from diffrigid.sysid.records import SAME_TIME, Run
from diffrigid.sysid.sensors import Channel, JointPart, Marker, Part
from diffrigid.world import World

ROWS = 5  # rows of a column that the line is laid through
THIN = 1e-2  # [-] of the length of a cloud of markers: a thinner one does not show how it is turned about its line
BENT = 10.0  # [-] times the squares left by a parabola: of noise about a line, a line leaves as many 5 % of the time
RATES = {"x": "v", "angle": "w", "q": "w"}  # of a body
COORDINATES = ("angle", "translation")  # of a hinge, and of a slider


def begun(run: Run, slots: Sequence[Slot]) -> Run:
    """The record begun as its first rows show it, in those of the free parameters that they show."""
    seen = shown(run.world, run.series, run.channels, run.start)
    values: dict[str, np.ndarray] = {}
    for slot in slots:
        if isinstance(slot.kind, Free) or slot.kind.name == "rotation":
            whole, index = component(slot.paths[0])
            if whole in seen:
                value = seen[whole] if index is None else seen[whole][index]
                values |= dict.fromkeys(slot.paths, np.clip(value, *_ends(slot)))
    return replace(run, state=with_values(run.world, run.state, values)) if values else run


def _ends(slot: Slot) -> tuple[float, float]:
    return (slot.kind.low, slot.kind.high) if isinstance(slot.kind, Free) else (-1.0, 1.0)


def is_begun(run: Run, slots: Sequence[Slot]) -> bool:
    """Whether a record has a state to begin with, or its first rows show all that is free of it."""
    if run.stated:
        return True
    seen, there = shown(run.world, run.series, run.channels, run.start), paths.catalogue(run.world)
    wholes = {component(path)[0] for slot in slots for path in slot.paths}
    initial = [whole for whole in wholes if whole in there and there[whole][0].chain[0] == 1]
    return all(np.isfinite(seen.get(whole, np.nan)).all() for whole in initial)


def with_values(world: World, state: State, values: Mapping[str, np.ndarray]) -> State:
    """A state with these values by path, except where they are NaN."""
    for path in sorted(values, key=lambda path: order_of(world, path)):
        now = np.asarray(paths.read(world, state, path))
        value = np.reshape(values[path], now.shape).astype(now.dtype)
        state = paths.write(world, state, path, np.where(np.isfinite(value), value, now))[1]
    return state


def shown(
    world: World, series: Sequence[Series], channels: Mapping[str, Channel], start: float
) -> dict[str, np.ndarray]:
    """Poses and velocities at `start` [s] by path, (size,), NaN where the next rows do not show them.

    From columns that read the position or the angle of a body or a joint, or from enough markers on a body.
    """
    out: dict[str, np.ndarray] = {}
    for body, (t, x, q) in _marked(world, series, channels, start).items():
        out |= dict(zip((f"{body}.x", f"{body}.v"), _line(t, x), strict=True))
        out |= dict(zip((f"{body}.q", f"{body}.w"), _turning(world.dim, t, q), strict=True))
        if world.dim == 2:
            out[f"{body}.angle"] = _line(t, np.arctan2(q[:, 1:], q[:, :1]), "angle")[0]
    for s in series:
        channel, observer = channels[s.name], channels[s.name].observer
        if isinstance(observer, JointPart) and observer.field in COORDINATES:
            owner, rate = observer.joint, "rate"
        elif isinstance(observer, Part) and observer.field in RATES:
            owner, rate = world.names[observer.body], RATES[observer.field]
        else:
            continue
        later = s.t >= start - SAME_TIME
        t, values = s.t[later] - start, (s.values[later] - channel.bias) / channel.scale
        pose, slope = _turning(world.dim, t, values) if observer.field == "q" else _line(t, values, observer.field)
        out |= {f"{owner}.{observer.field}": pose, f"{owner}.{rate}": slope}
    there = paths.catalogue(world)  # without joints of closed loops
    return {path: value for path, value in out.items() if path in there}


def _marked(
    world: World, series: Sequence[Series], channels: Mapping[str, Channel], start: float
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Times from the start, positions and orientations in the first rows, of bodies of which these show enough markers.

    Source: the turn that brings points nearest to others, Kabsch 1976.
    """
    out, by_body = {}, dict[int, list[Series]]()
    for s in series:
        if isinstance(channels[s.name].observer, Marker):
            by_body.setdefault(channels[s.name].observer.body, []).append(s)
    for body, markers in by_body.items():
        t = np.unique(np.concatenate([s.t[s.t >= start - SAME_TIME] for s in markers]))
        places = np.full((len(t), len(markers), world.dim), np.nan)
        for k, s in enumerate(markers):
            channel, later = channels[s.name], s.t >= start - SAME_TIME
            places[np.searchsorted(t, s.t[later]), k] = (s.values[later] - channel.bias) / channel.scale
        points = np.stack([np.asarray(channels[s.name].observer.point, float) for s in markers])
        known_rows = np.flatnonzero(np.isfinite(places).all(2).sum(1) >= world.dim)[:ROWS]
        poses = [_pose(points, places[row]) for row in known_rows]
        if poses:
            x, q = map(np.stack, zip(*poses, strict=True))
            out[world.names[body]] = t[known_rows] - start, x, q
    return out


def _pose(points: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and orientation that bring points of a body (M, D) to their places, NaN where these do not show it."""
    dim, there = points.shape[1], np.isfinite(places).all(1)
    r, x = points[there], places[there]
    middle, center = r.mean(0), x.mean(0)
    spread = np.linalg.svd(r - middle, compute_uv=False)
    if spread[dim - 2] <= THIN * spread[0]:
        return np.full(dim, np.nan), np.full(rotations(dim).Q, np.nan)
    U, _, V = np.linalg.svd((x - center).T @ (r - middle))
    U[:, -1] *= np.sign(np.linalg.det(U @ V))  # not a mirror image
    R = U @ V
    return center - R @ middle, R[:, 0] if dim == 2 else to_quaternion(R)


def _line(t: np.ndarray, values: np.ndarray, field: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Value at t = 0 and slope of lines through the first rows, both (size,), NaN where there are too few."""
    found = np.full((2, values.shape[1]), np.nan)
    for k, column in enumerate(values.T):
        rows = np.flatnonzero(np.isfinite(column))[:ROWS]
        if len(rows) > 1 and t[rows[0]] <= t[rows[-1]] - t[rows[0]]:  # further off, a line says little
            found[:, k] = _through(t[rows], np.unwrap(column[rows]) if field == "angle" else column[rows])
    return found[1], found[0]


def _through(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Slope and value at t = 0 of a line through values, or of a parabola if it is much nearer: as in free fall."""
    line = np.polyfit(t, values, 1)
    bent = np.polyfit(t, values, 2) if len(t) == ROWS else line
    misfits = [float(((np.polyval(curve, t) - values) ** 2).sum()) for curve in (line, bent)]
    return bent[-2:] if misfits[0] > BENT * misfits[1] else line


def _turning(dim: int, t: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First orientation and angular velocity of quaternions (K, 2 or 4)."""
    so, rows = rotations(dim), np.flatnonzero(np.isfinite(q).all(1))[:ROWS]
    if not len(rows):
        return np.full(q.shape[1], np.nan), np.full(so.A, np.nan)
    q = q[rows] / np.linalg.norm(q[rows], axis=1, keepdims=True)
    first = np.broadcast_to(q[0], q.shape).T
    turned = known(lambda a, b: so.log(so.difference(a, b)), first, q.T)  # in axes of the body
    w = _line(t[rows], turned.T)[1]
    return q[0], w if dim == 2 else known(so.rotate, q[0], w)
