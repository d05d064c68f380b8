"""Overlap of bodies: the exact signed distance of two rounded convex shapes, in NumPy, for known scenes.

The distance of two convex cores is the largest separation along any direction, and the largest is found along
one of finitely many: normals of faces, perpendiculars of two edges or of an edge and a vertex, lines through
two vertices (separating axes). For cores that overlap it is minus the least translation that parts them.
"""

import itertools
import warnings
from typing import Any, NamedTuple

import numpy as np

from diffrigid.convert import known
from diffrigid.gaps import rotated
from diffrigid.shapes import UNEVEN, HalfSpace, edges, radius, traced, vertices
from diffrigid.state import State, rotations
from diffrigid.world import World, seated, seats

DEEP = 1e-4  # [-] of the smaller size: penetration at the start that is worth a warning
SHOWN = 8  # pairs that a warning lists


class Outline(NamedTuple):
    """A collider in the world; V corners, E edges."""

    corners: np.ndarray  # (V, D) [m]; of a half space (1, D), a point of its surface
    sides: np.ndarray  # (E, D) [m] its edges, as vectors
    starts: np.ndarray  # (E, D) [m] and where they start
    rounding: float  # [m]
    normal: np.ndarray | None  # (D,) of a half space

    @property
    def size(self) -> float:
        """Radius [m] about the mean corner that encloses it."""
        if self.normal is not None:
            return np.inf
        return np.linalg.norm(self.corners - self.corners.mean(0), axis=1).max() + self.rounding


def place(shape: Any, x: np.ndarray, q: np.ndarray) -> Outline:
    """Outline of a shape whose origin is at x (D,) [m], with orientation q."""
    dim = len(x)
    if isinstance(shape, HalfSpace):
        normal = rotated(q, np.asarray(shape.normal))
        none = np.zeros((0, dim))
        return Outline((x + shape.offset * normal)[None], none, none, 0.0, normal)
    corners = x + rotated(q, known(lambda s: vertices(s, dim), shape))
    if dim == 3:
        pairs = edges(shape, dim)
    else:
        pairs = tuple((i, (i + 1) % len(corners)) for i in range(len(corners)) if len(corners) > 1)
    ends = np.array(pairs, int).reshape(-1, 2)
    starts = corners[ends[:, 0]]
    return Outline(corners, corners[ends[:, 1]] - starts, starts, float(known(radius, shape)), None)


def separation(a: Outline, b: Outline) -> float:
    """Signed distance [m], negative in penetration. One of the two may be a half space."""
    for solid, other in ((a, b), (b, a)):
        if solid.normal is not None:
            return ((other.corners - solid.corners) @ solid.normal).min() - other.rounding
    directions = _directions(a, b)
    length = np.linalg.norm(directions, axis=1)
    scale = max(a.size, b.size)
    n = directions[length > 1e-12 * scale] / length[length > 1e-12 * scale, None]
    n = np.concatenate([n, -n])
    apart = (a.corners @ n.T).min(0) - (b.corners @ n.T).max(0)
    return (apart.max() if len(n) else 0.0) - a.rounding - b.rounding  # two points at one place


def _directions(a: Outline, b: Outline) -> np.ndarray:
    """Candidates for the direction of the closest approach, of any length, (M, D)."""
    dim = a.corners.shape[1]
    between = (a.corners[:, None] - b.corners[None]).reshape(-1, dim)
    sides = np.concatenate([a.sides, b.sides])
    if dim == 2:
        return np.concatenate([between, sides[:, ::-1] * [1.0, -1.0]])
    i, j = np.triu_indices(len(sides), 1)  # of one body: normals of its faces
    return np.concatenate([between, np.cross(sides[i], sides[j]), _across(a, b), _across(b, a)])


def _across(a: Outline, b: Outline) -> np.ndarray:
    """Vectors from each edge of b to each corner of a, perpendicular to the edge."""
    to = a.corners[:, None] - b.starts[None]
    square = (b.sides**2).sum(1)
    share = (to * b.sides).sum(2) / np.where(square > 0, square, 1.0)
    return (to - share[:, :, None] * b.sides).reshape(-1, 3)


def warn_of_overlap(world: World, state: State) -> None:
    """Warn of pairs that penetrate at the start, except those with uneven ground or a traced value."""
    placed = outlines(world, state)
    if deep := overlapping(placed, near_pairs(placed, len(world.names)) if world.crowd else pairs_of(world)):
        names = world.names + world.static_names
        depths: dict[tuple[int, int], float] = {}
        for (i, j), depth in deep.items():
            both = min(i[0], j[0]), max(i[0], j[0])
            depths[both] = max(depth, depths.get(both, 0.0))
        listed = sorted(depths.items())
        text = ", ".join(f"{names[i]} and {names[j]} by {depth:.2g} m" for (i, j), depth in listed[:SHOWN])
        text += f", and {len(listed) - SHOWN} more pairs" if len(listed) > SHOWN else ""
        warnings.warn(f"bodies overlap at the start: {text}; move them apart or list them in ignore", stacklevel=3)


def outlines(world: World, state: State) -> dict[tuple[int, int, int], Outline]:
    """Outlines by owner, group and row, except those of uneven ground or with a traced value."""
    poses = [*zip(state.x, state.q, strict=True), *zip(world.statics.x, world.statics.q, strict=True)]
    placed = {}
    for seat in seats(world):
        shape, r, turn = seated(world, seat)
        x, q = poses[seat.owner]
        if not isinstance(shape, UNEVEN) and not traced((shape, r, turn, x, q)):
            x = x if r is None else x + rotated(q, r)
            q = q if turn is None else known(rotations(world.dim).compose, q, turn)
            placed[seat.owner, seat.group, seat.row] = place(shape, x, q)
    return placed


def pairs_of(world: World) -> list[tuple[tuple[int, int, int], tuple[int, int, int]]]:
    """All pairs of shapes that can meet, as keys of `outlines`."""
    found: list = []
    for group in world.pairs:
        kinds = (group.a, group.shape_a, group.row_a), (group.b, group.shape_b, group.row_b)
        sides = ([(owner, kind, row) for owner, row in zip(owners, rows, strict=True)] for owners, kind, rows in kinds)
        found += zip(*sides, strict=True)
    return found


def overlapping(colliders: dict[tuple, Outline], pairs: list) -> dict[tuple[tuple, tuple], float]:
    """Pairs (i, j) of keys of `colliders` that penetrate deeply, and how deep [m]."""
    size = {key: collider.size for key, collider in colliders.items()}
    centre = {key: collider.corners.mean(0) for key, collider in colliders.items()}
    deep = {}
    for i, j in pairs:
        if i in size and j in size and np.linalg.norm(centre[i] - centre[j]) < size[i] + size[j]:
            depth = -separation(colliders[i], colliders[j])
            if depth > DEEP * min(size[i], size[j]):
                deep[i, j] = float(depth)
    return deep


def near_pairs(colliders: dict[tuple, Outline], moving: int) -> list[tuple[tuple, tuple]]:
    """All pairs that may overlap: bounded ones in the same or adjacent cells of a grid, and those with half-spaces.

    Keys begin with the number of the collider; that of the first of each pair is below `moving`.
    """
    round_ones = {key: collider for key, collider in colliders.items() if collider.normal is None}
    pairs = [(i, j) for i in round_ones if i[0] < moving for j in colliders if j not in round_ones]
    side = 2.0 * max((collider.size for collider in round_ones.values()), default=1.0)
    cells: dict[tuple, list[tuple]] = {}
    for key, collider in round_ones.items():
        cells.setdefault(tuple(np.floor(collider.corners[0] / side).astype(int).tolist()), []).append(key)
    for cell, keys in cells.items():
        around = itertools.product(*((k - 1, k, k + 1) for k in cell))
        others = [key for there in around for key in cells.get(there, [])]
        pairs += [(i, j) for i in keys for j in others if i < j and i[0] < moving]
    return pairs
