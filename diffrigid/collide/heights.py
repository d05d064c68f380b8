"""A rounded convex shape and the solid below a grid of heights, in 3D.

The surface is made of triangles, two to a cell. They are flat, so that distances are exact and in closed form, and
one fits any three nodes; patches of second order would be smooth inside a cell, but kinked at its border all the same.
The normal turns continuously over convex edges and nodes, as that of the distance to the solid does.

Contacts are those of

    every corner of the shape      with the faces it is over, and with the convex edges and nodes it is beyond
    convex nodes of the grid       with the core of the shape, unless that is a point
    convex edges of the grid       with the edges of the shape that cross them

Only the nodes around a body, or a corner without rounding, are looked up: a fixed number, `HeightField.cells` to each
side, whatever the size of the grid. Nodes beyond are not reached within the time that `unseen_for` gives.
A search for an impact needs all of the `candidates`; the nearest few of them are contacts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrigid.collide.contacts import ALERT, FAR, Contacts, in_world, joined, slack_of
from diffrigid.collide.distance import core_distance, reach
from diffrigid.collide.edges import CROSSINGS, Edges, are_outermost, crossing, edges_of
from diffrigid.numerics import components, dot, norm, normalise, safe_divide
from diffrigid.shapes import Capsule, HeightField, Sphere, edges, radius, vertices
from diffrigid.so3 import cross
from diffrigid.state import rotations

FEATURES = 6  # of a cell: two faces, three edges, a node
TOUCHES = 4  # contacts of a corner at most: a pit has three faces or more
PEAKS = 4  # nodes at most that touch a body
ONE_PLANE = 1e-6  # [-] 1 - cosine: faces whose normals differ by less than 1.4 mrad are one plane
SIGHT = 0.5  # [cells] that are looked up beyond the reach of a body, at least


@jax.jit
def convex_heights(a, x_a: Array, q_a: Array, b: HeightField, x_b: Array, q_b: Array) -> Contacts:
    """The nearest contacts: TOUCHES of every corner and, unless a is a sphere, PEAKS of nodes, CROSSINGS of edges.

    Without features at ALERT, which do not touch yet.
    """
    return _contacts(a, x_a, q_a, b, x_b, q_b, _nearest, searched=False)


@jax.jit
def candidates(a, x_a: Array, q_a: Array, b: HeightField, x_b: Array, q_b: Array) -> Contacts:
    """All contacts that a may reach within the step; no gap is larger than the way left to it."""
    return _contacts(a, x_a, q_a, b, x_b, q_b, lambda contacts, count, slack: contacts, searched=True)


def of_nearest(a, b: HeightField, flags: Array, count: int) -> Array:
    """Transfer flags (K, *batch) bool of the `candidates` to the `count` contacts that `convex_heights` selects.

    To those of a corner from its own candidates; to and from nodes and edges, which may take over from any, from all.
    """
    corners = len(vertices(a, 3))
    own = corners * FEATURES * (2 * _cells_of_corners(a, b)) ** 2
    others = flags[own:].any(0)
    touching = flags[:own].reshape(corners, -1, *flags.shape[1:]).any(1) | others[None]
    rest = jnp.broadcast_to(flags.any(0), (count - corners * TOUCHES, *flags.shape[1:]))
    return jnp.concatenate([jnp.repeat(touching, TOUCHES, 0), rest])


def unseen_for(b: HeightField, q_b: Array, height: Array, v: Array, spinning: Array) -> Array:
    """Lower bound on the time until the body can reach cells that were not examined, (*batch) [s].

    Args:
        height: (*batch) [m] of the whole body over the highest node.
        v: (3, *batch) [m/s] of its centre.
        spinning: (*batch) [m/s] what spin and acceleration may add to the speed of its points.
    """
    along = rotations(3).unrotate(q_b, v)
    level, down = norm(along[:2]) + spinning, jnp.maximum(-along[2], 0.0) + spinning
    border = jnp.where(level > 0, safe_divide(SIGHT * b.spacing, level), jnp.inf)
    return jnp.maximum(border, jnp.where(down > 0, safe_divide(height, down), jnp.inf))


def height_over(b: HeightField, x: Array, x_b: Array, q_b: Array) -> Array:
    """Height of a point over the highest node, (*batch) [m]."""
    return rotations(3).unrotate(q_b, x - x_b)[2] - b.heights.max((0, 1))


def cells_for(spacing: Array, size: Array) -> Array:
    """Number `HeightField.cells` that covers a body of this reach [m], and SIGHT beyond it."""
    return jnp.ceil(size / spacing + 0.5 + SIGHT)


def _contacts(
    a, x_a: Array, q_a: Array, b: HeightField, x_b: Array, q_b: Array, some: Callable, *, searched: bool
) -> Contacts:
    """Contacts of all kinds; `some(contacts, count, slack)` selects those of each kind.

    Args:
        searched: with features that may be met within the step, but do not touch yet.
    """
    so, size = rotations(3), lax.stop_gradient(reach(a, 3))
    slack = slack_of(size)
    alert = ALERT * size if searched else jnp.full_like(size, FAR)
    middle = so.unrotate(q_b, x_a - x_b)
    corners = jax.vmap(lambda r: middle + so.unrotate(q_b, so.rotate(q_a, r)))(vertices(a, 3))
    cells = _cells_of_corners(a, b)

    def touching(p: Array) -> Contacts:
        around, rounding = _around(b, p, cells), radius(a)
        parts = _faces(around, slack, alert, rounding), _edges(around, slack, rounding), _tops(around, slack, rounding)
        return some(_moved(joined(*parts), p), TOUCHES, slack)

    c = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), jax.vmap(touching)(corners))
    if not isinstance(a, Sphere):
        around = _around(b, middle, b.cells)

        def distance(p: Array, inward: Array) -> tuple[Array, Array]:
            p, inward = (so.unrotate(q_a, so.rotate(q_b, r)) for r in (p, inward))
            gap, n = core_distance(a, p, inward, slack)
            return gap, so.unrotate(q_b, so.rotate(q_a, n))

        count = CROSSINGS if len(edges(a, 3)) > 1 else 2
        peaks = some(_peaks(b, around, distance, slack, alert, radius(a)), PEAKS, None)
        deepest = lax.stop_gradient(c.gap.min(0)) + radius(a)
        own = edges_of(a, corners - middle[None])
        ridges = _nearest(_ridges(own, around, deepest, size, slack, radius(a)), count, None)
        c = joined(c, _moved(joined(peaks, ridges), middle))
    return in_world(c, x_b, q_b)


def _cells_of_corners(a, b: HeightField) -> Any:
    """Number of cells to each side of a corner that are looked up; static."""
    return b.cells if isinstance(a, Sphere | Capsule) else 1


def _moved(c: Contacts, p: Array) -> Contacts:
    return Contacts(gap=c.gap, normal=c.normal, point=c.point + p[None])


def _nearest(c: Contacts, count: int, slack: Array | None) -> Contacts:
    """Select the `count` contacts with the least gaps; with `slack`, only one of those with the same gap and normal."""
    gap, normal = lax.stop_gradient((c.gap, c.normal))

    def pick(left, _):
        index = jnp.argmin(left, 0)
        chosen = jax.nn.one_hot(index, len(left), axis=0, dtype=left.dtype)
        taken, found = chosen > 0, (chosen * left).sum(0)
        if slack is not None:
            along = jax.vmap(dot, (0, None))(normal, (chosen[:, None] * normal).sum(0))
            taken = taken | ((along > 1.0 - ONE_PLANE) & (jnp.abs(gap - found[None]) <= slack[None]))
        return jnp.where(taken, FAR, left), (index, found)

    _, (index, found) = lax.scan(pick, gap, length=min(count, len(gap)))

    def row(leaf):
        inner = leaf.ndim - index.ndim
        where = lax.expand_dims(index, range(1, 1 + inner))
        return jnp.take_along_axis(leaf, where, axis=0)

    chosen = jax.tree.map(row, c)
    return Contacts(gap=jnp.where(found < FAR, chosen.gap, FAR), normal=chosen.normal, point=chosen.point)


class Around(NamedTuple):
    """The nodes about a point: at(i, j) are those of all F cells, i and j cells further, (3, F, *batch) [m] from it."""

    nodes: Array  # (3, M, M, *batch)

    def at(self, i: int, j: int) -> Array:
        size = self.nodes.shape[1] - 3
        part = self.nodes[:, 1 + i : 1 + i + size, 1 + j : 1 + j + size]
        return part.reshape(3, size * size, *part.shape[3:])


def _around(b: HeightField, p: Array, cells: Any) -> Around:
    """Nodes `cells` to each side of the one nearest to p, and one more; the border's heights go on beyond the grid."""
    batch = jnp.broadcast_shapes(p.shape[1:], b.heights.shape[2:], b.spacing.shape)
    count, lead = 2 * cells + 3, (1,) * len(batch)
    steps = np.arange(-cells - 1, cells + 2).astype(p.dtype).reshape(-1, *lead)

    def along(k: int) -> tuple[Array, Array]:
        nearest = jnp.round(lax.stop_gradient(p[k] / b.spacing))
        number = nearest[None] + steps
        return number * b.spacing[None], jnp.clip(number, 0, b.heights.shape[k] - 1).astype(np.int32)

    (x, row), (y, column) = along(0), along(1)
    place = row[:, None] * b.heights.shape[1] + column[None]
    place = jnp.broadcast_to(place, (count, count, *batch)).reshape(count**2, *batch)
    heights = jnp.broadcast_to(b.heights, b.heights.shape[:2] + batch).reshape(-1, *batch)
    z = jnp.take_along_axis(heights, place, axis=0).reshape(count, count, *batch)
    nodes = components(x[:, None] + jnp.zeros_like(z), y[None] + jnp.zeros_like(z), z)
    return Around(nodes - p[:, None, None])


# ---- a corner, which is at the origin


def _faces(around: Around, slack: Array, alert: Array, rounding: Array) -> Contacts:
    """Contacts with both faces of all cells: over one, the distance to its plane; else, in front, at least ALERT."""
    near, far = around.at(0, 0), around.at(1, 1)
    rows = (near, near), (around.at(1, 0), far), (far, around.at(0, 1))
    start = jnp.stack([jnp.concatenate(row, 1) for row in rows], 1)  # (3, 3, 2 F, *batch): component, side, face
    along = jnp.roll(start, -1, axis=1) - start
    up = normalise(cross(along[:, 0], along[:, 1]))
    height, square = -dot(up, start[:, 0]), dot(along, along)
    over = (-dot(cross(up[:, None] + jnp.zeros_like(along), along), start) >= -slack * jnp.sqrt(square)).all(0)
    below = (along[1] * start[0] - along[0] * start[1] >= 0).all(0)
    foot = -(start + jnp.clip(-dot(start, along) / square, 0.0, 1.0)[None] * along)
    side = jax.nn.one_hot(jnp.argmin(dot(foot, foot), 0), 3, axis=0, dtype=foot.dtype)
    away = (side[None] * foot).sum(1)
    distance = norm(away)
    inside = (below & (height < 0)).any(0)
    # In the crease of a valley it may be over none: then it counts as over the faces straight above it.
    over = over | (below & ~over.any(0)[None] & inside[None])
    best = jnp.where(over & (height < 0), height, -jnp.inf).max(0)
    # `slack`: values that are computed twice may be rounded differently.
    touches = over & ((height >= -slack[None]) | (inside[None] & (height >= (best - slack)[None])))
    gap = jnp.where(height > slack[None], jnp.maximum(distance - rounding[None], alert[None]), FAR)
    gap = jnp.where(touches, height - rounding[None], gap)
    return _placed(gap, jnp.where(touches[None], up, normalise(away)), rounding)


def _edges(around: Around, slack: Array, rounding: Array) -> Contacts:
    """Contacts with edges, where the corner is over neither of the two faces that meet there."""
    start, along, left, right = _grid_edges(around)
    length = norm(along)
    unit = along / length[None]
    share = -dot(start, unit)
    away = -(start + share[None] * unit)
    beyond = away[2] > 0
    for side in (left, right):
        into = normalise(side - dot(side, unit)[None] * unit)
        beyond = beyond & (dot(away, into) < -slack[None])
    on = beyond & (share >= -slack[None]) & (share <= length + slack[None])
    return _placed(jnp.where(on, norm(away) - rounding[None], FAR), normalise(away), rounding)


def _tops(around: Around, slack: Array, rounding: Array) -> Contacts:
    """Contacts with nodes, where the corner is beyond the ends of all edges that meet there."""
    away = -around.at(0, 0)
    spokes = _spokes(around)
    on = (away[2] > 0) & (dot(away[:, None] + jnp.zeros_like(spokes), spokes) < -slack).all(0)
    return _placed(jnp.where(on, norm(away) - rounding[None], FAR), normalise(away), rounding)


def _placed(gap: Array, normal: Array, rounding: Array) -> Contacts:
    """Contacts of the corner at the origin, from components in front."""
    normal = jnp.swapaxes(normal, 0, 1)
    return Contacts(gap=gap, normal=normal, point=-(rounding[None] + 0.5 * gap)[:, None] * normal)


def _grid_edges(around: Around) -> Edges:
    """Edges that begin at the nodes, along x, along y and across, and the third nodes of the faces left and right."""
    start = around.at(0, 0)
    families = ((1, 0), (1, 1), (0, -1)), ((0, 1), (-1, 0), (1, 1)), ((1, 1), (0, 1), (1, 0))
    along, left, right = (jnp.concatenate([around.at(*family[k]) - start for family in families], 1) for k in range(3))
    return Edges(jnp.concatenate([start] * 3, 1), along, left, right)


def _spokes(around: Around) -> Array:
    """Unit vectors along the six edges at each node, (3, 6, F, *batch)."""
    ends = (1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1)
    return normalise(jnp.stack([around.at(*end) for end in ends], 1) - around.at(0, 0)[:, None])


# ---- the core of a body, whose origin is at the origin


def _peaks(
    b: HeightField, around: Around, distance_of: Callable, slack: Array, alert: Array, rounding: Array
) -> Contacts:
    """Contacts of convex nodes with the core of a body, where its normal is among those of the node."""
    turn = np.sqrt(np.finfo(slack.dtype).eps)
    x, y = ((around.at(*end)[2] - around.at(*(-i for i in end))[2]) for end in ((1, 0), (0, 1)))
    up = normalise(components(-x, -y, 2.0 * b.spacing[None] + jnp.zeros_like(x)))

    def falls(normal, edges):
        slopes = dot(normal[:, None] + jnp.zeros_like(edges), edges)
        return (slopes.max(0) <= turn) & (slopes.min(0) < -turn)

    def one(p, up, edges):
        inward = lax.stop_gradient(-b.spacing[None] * up)
        distance, n = distance_of(p, inward)
        gap = distance - rounding
        far = jnp.where(falls(up, edges) & (distance > slack), jnp.maximum(gap, alert), FAR)
        gap = jnp.where(falls(-n, edges) & (n[2] < 0), gap, far)
        return Contacts(gap=gap, normal=-n, point=p - 0.5 * gap[None] * n)

    return jax.vmap(one, (1, 1, 2))(around.at(0, 0), up, _spokes(around))


def _ridges(own: Edges, around: Around, deepest: Array, size: Array, slack: Array, rounding: Array) -> Contacts:
    """Contacts where edges of the body cross convex edges of the grid, both extreme along the common normal."""
    grid = _grid_edges(around)
    convex = dot(cross(grid.along, grid.left), grid.right)
    steep = slack[None] * norm(cross(grid.along, grid.left))
    c = crossing(Edges(*(r[:, :, None] for r in own)), Edges(*(r[:, None] for r in grid)), slack[None, None])
    outermost = are_outermost(c, deepest[None, None], slack[None, None])
    there = c.within & outermost & (c.distance > -0.5 * size[None, None]) & (c.normal[2] > 0)
    gap = jnp.where(there & (convex < -steep)[None], c.distance - rounding[None, None], FAR)
    point = 0.5 * (c.on_a + c.on_b - rounding[None, None, None] * c.normal)

    def flat(leaf):
        return leaf.reshape(-1, *leaf.shape[2:])

    def rows(leaf):
        return jnp.moveaxis(leaf.reshape(3, -1, *leaf.shape[3:]), 0, 1)

    return Contacts(gap=flat(gap), normal=rows(c.normal), point=rows(point))
