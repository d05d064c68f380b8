"""Data that a player draws, ready for JSON: times, poses, shapes, joints, energies, measured columns. NumPy.

Columns of numbers are packed as 16-bit integers, see `pack`. Colliders are numbered as in `World`: bodies, then
statics; the world itself comes last.
"""

import base64
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from diffrigid import impacts
from diffrigid.forces import Gravity, SpringDamper
from diffrigid.gaps import rotated
from diffrigid.joints import Distance
from diffrigid.shapes import Box, Capsule, Disc, HalfSpace, HeightField, Profile, Shape, Sphere, with_topology
from diffrigid.state import State, kinetic_energy
from diffrigid.sysid.columns import columns
from diffrigid.sysid.sensors import Part
from diffrigid.trajectory import Trajectory
from diffrigid.view.outline import nodes
from diffrigid.world import World, seated, seats

LEVELS = 65534  # of a packed number; 65535 is NaN


def pack(table: np.ndarray) -> dict[str, Any]:
    """Columns of a table (T, K) as 16-bit integers in base64, column after column: low + step * integer.

    Each is rounded by at most half a step, 1/131068 of what the column spans. NaN is kept.
    """
    table = np.where(np.isfinite(table), table, np.nan)
    known = np.isfinite(table)
    low = np.where(known, table, np.inf).min(0, initial=np.inf)
    low = np.where(np.isfinite(low), low, 0.0)
    high = np.where(known, table, low).max(0, initial=-np.inf)
    step = np.array([float(f"{s:.9g}") for s in np.maximum(high - low, 0.0) / LEVELS])
    levels = np.rint((table - low) / np.where(step > 0, step, 1.0))
    whole = np.where(known, np.clip(np.nan_to_num(levels), 0, LEVELS), LEVELS + 1).astype("<u2")
    data = base64.b64encode(whole.T.tobytes()).decode()
    return {"low": low.tolist(), "step": step.tolist(), "rows": len(table), "data": data}


def times(t: np.ndarray) -> Any:
    """Times [s]: the first, the last and the number of equal steps; else all, as doubles in base64."""
    even = np.linspace(t[0], t[-1], len(t))
    if np.allclose(t, even, rtol=0, atol=1e-6 * (t[-1] - t[0]) / len(t)):
        return [t[0], t[-1], len(t) - 1]
    return base64.b64encode(t.astype("<f8").tobytes()).decode()


def record(
    trajectory: Trajectory, name: str, data: Mapping[str, Any] | None, frames: int, touching: bool = True
) -> dict[str, Any]:
    """All data drawn of one trajectory, at no more than `frames` of its times; with its contacts if `touching`."""
    world, t = trajectory.world, np.asarray(trajectory.t, float)
    kept = np.unique(np.rint(np.linspace(0, len(t) - 1, min(len(t), frames))).astype(int))
    some = jax.tree.map(lambda leaf: np.asarray(leaf, float)[kept], trajectory.state)
    table = poses(trajectory)[kept]
    marks = contacts(trajectory, t[kept]) if touching else np.zeros((0, 2 + 2 * world.dim))
    return {
        "name": name,
        "bodies": list(world.names),
        "t": times(t[kept]),
        "poses": pack(table),
        "statics": np.round(np.concatenate([world.statics.x, world.statics.q], axis=1), 7).tolist(),
        "shapes": shapes(world),
        "joints": links(world),
        "energy": pack(energies(world, some)),
        "contacts": pack(marks),
        "measured": None if data is None else measured(world, data, t[kept], table),
    }


def poses(trajectory: Trajectory) -> np.ndarray:
    """Columns of every body, in 2D x, y, angle, vx, vy, in 3D x, y, z, q (4), v (3); [m], [rad], [m/s]."""
    x, q, v, w = (np.asarray(getattr(trajectory.state, name), float) for name in "xqvw")
    turn = turns(np.asarray(trajectory.t, float), q, w) if x.shape[2] == 2 else _near(q)
    return np.concatenate([x, turn, v], axis=2).reshape(len(x), -1)


def contacts(trajectory: Trajectory, t_drawn: np.ndarray) -> np.ndarray:
    """Contacts by time: t [s], 1 for impact or 0 for rest, point (D) [m], impulse (D) [N s] on a body that moves."""
    found = impacts.meetings(trajectory, t_drawn)
    return np.column_stack([found.t, found.impact, found.point, found.impulse])


def turns(t: np.ndarray, q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Angles (T, N, 1), unwrapped by means of the angular velocities, however fast."""
    angle = np.arctan2(q[:, :, 1:], q[:, :, :1])
    expected = np.diff(t)[:, None, None] * (w[1:] + w[:-1]) / 2
    away = np.diff(angle, axis=0) - expected
    steps = expected + away - 2 * np.pi * np.round(away / (2 * np.pi))
    return np.concatenate([angle[:1], angle[:1] + np.cumsum(steps, axis=0)])


def _near(q: np.ndarray) -> np.ndarray:
    """Quaternions (T, N, 4), each with the sign that is nearer to the one before."""
    dots = (q[1:] * q[:-1]).sum(2, keepdims=True)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    return np.concatenate([q[:1], signs * q[1:]])


def shapes(world: World) -> list[dict[str, Any]]:
    """Kind, collider and dimensions of every shape, and where and how turned it sits on the body."""
    found = []
    for seat in seats(world):
        shape, r, q = seated(world, seat)
        at = [0.0] * world.dim if r is None else _short(r)
        turn = {} if q is None else {"turn": _short(q)}
        found.append({"body": seat.owner, "at": at} | turn | _kind(shape))
    return found


def _kind(shape: Shape) -> dict[str, Any]:
    match shape:
        case Disc() | Sphere():
            return {"kind": "ball", "radius": _short(shape.radius)}
        case Capsule():
            return {"kind": "capsule", "radius": _short(shape.radius), "half": _short(shape.half_length)}
        case Box():
            return {"kind": "box", "half": _short(shape.half)}
        case HalfSpace():
            return {"kind": "plane", "normal": _short(shape.normal), "offset": _short(shape.offset)}
        case Profile():
            line = np.asarray(shape.points, float)
            left, right, low = line[0, 0], line[-1, 0], line[:, 1].min() - 0.1 * np.ptp(line[:, 0])
            return {"kind": "hull", "points": _short(np.concatenate([line, [(right, low), (left, low)]]))}
        case HeightField():
            return {"kind": "hull", "points": _short(nodes(shape).reshape(-1, 3)), "faces": _triangles(shape)}
    solid: Any = with_topology(shape)
    faces = {"faces": [list(face) for face in solid.faces]} if len(shape.vertices[0]) == 3 else {}
    return {"kind": "hull", "points": _short(shape.vertices)} | faces


def _triangles(shape: HeightField) -> list:
    """Both faces of each cell, as triples of nodes, counter-clockwise from above."""
    number = np.arange(np.size(shape.heights)).reshape(np.shape(shape.heights))
    near, right, left, far = (n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]))
    return np.concatenate([np.stack([near, right, far], 1), np.stack([near, far, left], 1)]).tolist()


def links(world: World) -> list[dict[str, Any]]:
    """Joints and springs: two colliders and a point on each, body axes [m]."""
    last, found = len(world.names) + len(world.static_names), []
    for group in world.joints:
        kind = "rod" if isinstance(group, Distance) else type(group).__name__.lower()
        for row, (a, b) in enumerate(zip(group.a, group.b, strict=True)):
            ends = _short(group.anchor_a[row]), _short(group.anchor_b[row])
            found.append({"kind": kind, "ends": [[a, ends[0]], [b, ends[1]]]})
    for force in world.forces:
        if isinstance(force, SpringDamper):
            a, b = ((last if body is None else body) for body in (force.a, force.b))
            ends = _short(force.anchor_a), _short(force.anchor_b)
            found.append({"kind": "spring", "ends": [[a, ends[0]], [b, ends[1]]]})
    return found


def energies(world: World, state: State) -> np.ndarray:
    """Columns [J]: kinetic, potential (gravity, and springs), their sum; of states with a leading time axis."""
    kinetic = np.asarray(kinetic_energy(world.bodies, state), float).sum(1)
    x, mass = np.asarray(state.x, float), np.asarray(world.bodies.mass, float)
    potential = np.zeros(len(x))
    for force in world.forces:
        if isinstance(force, Gravity):
            potential -= (mass[:, None] * x @ np.asarray(force.g, float)[:, None]).sum((1, 2))
        elif isinstance(force, SpringDamper):
            sides = (force.a, force.anchor_a), (force.b, force.anchor_b)
            ends = [_point(x, np.asarray(state.q, float), *side) for side in sides]
            stretch = np.linalg.norm(ends[0] - ends[1], axis=1) - float(force.length)
            potential += 0.5 * float(force.stiffness) * stretch**2
    return np.stack([kinetic, potential, kinetic + potential], axis=1)


def _point(x, q, body, anchor):
    """World positions (T, D) of an anchor on a body, or of a world point."""
    anchor = np.asarray(anchor, float)
    return np.broadcast_to(anchor, x[:, 0].shape) if body is None else x[:, body] + rotated(q[:, body], anchor)


def measured(world: World, data: Mapping[str, Any], t_drawn: np.ndarray, drawn: np.ndarray) -> dict[str, Any]:
    """Columns of a record, checked as `fit` does: poses like those of `poses` where they are known, else NaN.

    Angles are those of the turn that is nearest to what is drawn, `drawn` (T, K) at t_drawn (T,) [s].
    """
    found, channels, _ = columns(world, data, {})
    t, used = np.unique(np.concatenate([series.t for series in found])), set()
    table = np.full((len(t), len(world.names), 5 if world.dim == 2 else 10), np.nan)
    for series in found:
        observer = channels[series.name].observer
        if isinstance(observer, Part):
            used.add(observer.body)
            for place, values in _places(observer.field, series.values, world.dim):
                table[np.searchsorted(t, series.t), observer.body, place] = values
    if world.dim == 2:
        for row, angle in enumerate(table[:, :, 2].T):
            away = np.interp(t, t_drawn, drawn[:, 5 * row + 2]) - angle
            table[:, row, 2] += 2 * np.pi * np.round(away / (2 * np.pi))
    rows = sorted(used)
    return {"t": times(t), "bodies": rows, "poses": pack(table[:, rows].reshape(len(t), -1))}


def _places(field: str, values: np.ndarray, dim: int):
    """Yield the place of a column in the table of poses, and its values; angular velocities are not drawn."""
    turn = 1 if dim == 2 else 4
    if field == "x":
        yield slice(0, dim), values
    elif field == "v":
        yield slice(dim + turn, None), values
    elif field == "angle":
        yield slice(dim, dim + 1), values
    elif field == "q":
        yield slice(dim, dim + turn), np.arctan2(values[:, 1:], values[:, :1]) if dim == 2 else values


def _short(leaf: Any) -> Any:
    """Round to 7 digits: a number, or nested lists."""
    array = np.asarray(leaf, float)
    return float(f"{array:.7g}") if array.ndim == 0 else [_short(row) for row in array]
