"""Shapes of bodies: dimensions, corners and edges.

All coordinates are in the shape's own axes [m]. Every shape but the boundless ones is a core, the convex hull of
`vertices(shape, dim)`, rounded by `radius(shape)`; contacts see only these two.

Float leaves are differentiable, the topology of a hull (`faces`, `edges`) is static.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.hull import apexes, hull_edges, hull_faces, triples
from diffrigid.pytree import Leaf, array, pytree, replace, static

_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))
_CUBE = tuple((*corner, z) for z in (-1, 1) for corner in _SQUARE)
_CUBE_EDGES = tuple(  # corners that differ in one sign
    (i, j) for i, j in itertools.combinations(range(8), 2) if np.dot(_CUBE[i], _CUBE[j]) == 1
)
_CUBE_FACES = ((0, 3, 2), (4, 5, 6), (0, 1, 5), (1, 2, 6), (2, 3, 7), (3, 0, 4))
_BESIDE = {*_CUBE_EDGES, *((j, i) for i, j in _CUBE_EDGES)}


@pytree
class Disc:
    """Disc in 2D, centred on the origin.

    Example:
        >>> dr.Disc(radius=0.1).radius  # what can be fitted as "ball.shape.radius"
        0.1
    """

    radius: Leaf = array(kw_only=False)  # (*batch) [m] > 0


@pytree
class Sphere:
    """Ball in 3D, centred on the origin.

    Example:
        >>> made, _ = dr.scene({"ball": dr.Body(dr.Sphere(radius=0.1), mass=1.0, x=(0.0, 0.0, 0.0))})
        >>> made.bodies.inertia[0].diagonal().round(6).tolist()  # 2 m r^2 / 5
        [0.004, 0.004, 0.004]
    """

    radius: Leaf = array(kw_only=False)  # (*batch) [m] > 0


@pytree
class Box:
    """Rectangle (2D) or cuboid (3D) along the axes, centred on the origin; a zero extent makes it thin.

    Example:
        >>> cube = dr.Body(dr.Box(half=(0.5, 0.5, 0.5)), density=700.0, x=(0.0, 0.0, 1.0))  # three numbers: 3D
        >>> round(float(dr.scene({"cube": cube})[0].bodies.mass[0]), 3)
        700.0
    """

    half: Leaf = array("D")  # (D, *batch) [m] >= 0, half of each side


@pytree
class Capsule:
    """Segment from (-half_length, 0[, 0]) to (half_length, 0[, 0]), rounded by `radius`. In 2D a stadium.

    Example:
        >>> stadium = dr.Body(dr.Capsule(radius=0.5, half_length=1.0), density=1.0, x=(0.0, 0.0))
        >>> round(float(dr.scene({"stadium": stadium})[0].bodies.mass[0]), 4)  # 2 x 1 and a disc
        2.7854
    """

    radius: Leaf = array()  # (*batch) [m] >= 0; 0 is a thin rod
    half_length: Leaf = array()  # (*batch) [m] > 0, without the round ends


@pytree
class Polygon:
    """Strictly convex polygon in 2D, its vertices counter-clockwise.

    Example:
        >>> corner = dr.Polygon(vertices=((0.0, 0.0), (3.0, 0.0), (0.0, 3.0)))
        >>> made, start = dr.scene({"corner": dr.Body(corner, density=1.0, x=(5.0, 5.0))})
        >>> made.offsets[0].r.tolist()  # its origin, from x, the centre of mass
        [[-1.0, -1.0]]
    """

    vertices: Leaf = array("V", "D")  # (V, 2, *batch) [m], V >= 3


@pytree
class Hull:
    """Convex polyhedron in 3D, each of its vertices a corner. `with_topology` fills in faces and edges.

    Example:
        >>> tetrahedron = dr.Hull(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)))
        >>> made, _ = dr.scene({"die": dr.Body(tetrahedron, density=6.0, x=(0.0, 0.0, 0.0))})
        >>> round(float(made.bodies.mass[0]), 6), len(made.shapes[0].edges)
        (1.0, 6)
    """

    vertices: Leaf = array("V", "D")  # (V, 3, *batch) [m], V >= 4
    faces: tuple | None = static(None)  # triples of vertices, counter-clockwise seen from outside; see hull_faces
    edges: tuple | None = static(None)  # pairs of vertices; see hull_edges


@pytree
class HalfSpace:
    """The solid {r : normal . r <= offset}, 2D or 3D. For bodies that do not move.

    Example:
        >>> low = dr.Static(dr.HalfSpace(normal=(0.0, 1.0), offset=-2.0))  # the solid is y <= -2
        >>> made, start = dr.scene({"ball": ball, "floor": low}, gravity=(0.0, -9.81), restitution=1.0)
        >>> round(float(dr.step(made, start, 2 * np.sqrt(2 * 2.9 / 9.81)).x[0, 1]), 6)  # down 2.9 m and up again
        1.0
    """

    normal: Leaf = array("D")  # (D, *batch) unit vector out of the solid
    offset: Leaf = array(default=0.0)  # (*batch) [m]


@pytree
class Profile:
    """The solid below a polyline in 2D, which goes on straight beyond its ends. For bodies that do not move.

    Example:
        >>> step = dr.Profile(points=((0.0, 0.0), (1.0, 0.0), (1.1, 0.2), (2.0, 0.2)))
        >>> made, _ = dr.scene({"ball": ball, "ground": dr.Static(step)}, gravity=(0.0, -9.81))
        >>> made.shapes[1].points.shape  # fitted as "ground.shape.points"
        (1, 4, 2)
    """

    points: Leaf = array("V", "D")  # (V, 2, *batch) [m], V >= 3, from left to right


@pytree
class HeightField:
    """The solid below a grid of heights in 3D. For bodies that do not move.

    Node (i, j) is at (i spacing, j spacing, heights[i, j]); each cell is two flat triangles, cut from node (i, j) to
    (i + 1, j + 1). Beyond the grid the heights of its border go on level. (Straight on, as a `Profile` does, cells of
    different slope would tear.)

    Example:
        >>> x, y = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9), indexing="ij")
        >>> bowl = dr.Static(dr.HeightField(heights=0.3 * (x**2 + y**2), spacing=0.25), x=(-1.0, -1.0, 0.0))
        >>> marble = dr.Body(dr.Sphere(radius=0.2), mass=1.0, x=(0.5, 0.0, 0.5))
        >>> made, _ = dr.scene({"marble": marble, "bowl": bowl}, gravity=(0.0, 0.0, -9.81))
        >>> made.shapes[1].heights.shape  # fitted as "bowl.shape.heights"
        (1, 9, 9)
    """

    heights: Leaf = array("R", "C")  # (R, C, *batch) [m], R rows and C columns, 2 or more
    spacing: Leaf = array()  # (*batch) [m] > 0
    cells: int | None = static(None)  # how far to each side a body looks, in cells; None: `scene` finds it, if it can


SHAPES = (Disc, Sphere, Box, Capsule, Polygon, Hull, HalfSpace, Profile, HeightField)
Shape = Disc | Sphere | Box | Capsule | Polygon | Hull | HalfSpace | Profile | HeightField
BOUNDLESS = (HalfSpace, Profile, HeightField)  # for bodies that do not move
UNEVEN = (Profile, HeightField)  # solids that are not convex


def dimension(shape: Shape) -> int | None:
    """Dimension of a shape, 2 or 3; None for a capsule, which may have either."""
    match shape:
        case Disc() | Polygon() | Profile():
            return 2
        case Sphere() | Hull() | HeightField():
            return 3
        case Box():
            return len(shape.half)
        case HalfSpace():
            return len(shape.normal)
    return None


# ---- the core and its rounding


def vertices(shape: Shape, dim: int) -> Array:
    """Corners of the core, (V, D, *batch) [m]: the shape is their convex hull, rounded by `radius(shape)`.

    A disc or sphere has one, a capsule two, a box 4 (counter-clockwise) or 8. Linear in every leaf.
    """
    match shape:
        case Disc() | Sphere():
            size = floats(shape.radius)
            return jnp.zeros((1, dim, *size.shape), size.dtype)
        case Capsule():
            x = jnp.stack([-floats(shape.half_length), floats(shape.half_length)])
            return jnp.stack([x] + [jnp.zeros_like(x)] * (dim - 1), axis=1)
        case Box():
            half = floats(shape.half)
            return jnp.asarray(_box_signs(dim, half.ndim - 1, half.dtype)) * half[None]
        case Polygon() | Hull():
            return floats(shape.vertices)
    raise ValueError(f"{type(shape).__name__} has no vertices; it needs its own colliders")


@functools.cache
def _box_signs(dim: int, batch_rank: int, dtype) -> np.ndarray:
    signs = np.array(_SQUARE if dim == 2 else _CUBE, dtype)
    return signs.reshape(signs.shape + (1,) * batch_rank)


def radius(shape: Shape) -> Array:
    """Rounding radius, (*batch) [m]: the distance from the core to the surface, 0 for flat-sided shapes."""
    match shape:
        case Disc() | Sphere() | Capsule():
            return floats(shape.radius)
        case Box():
            return jnp.zeros_like(floats(shape.half)[0])
        case Polygon() | Hull():
            return jnp.zeros_like(floats(shape.vertices)[0, 0])
        case Profile():
            return jnp.zeros_like(floats(shape.points)[0, 0])
        case HeightField():
            return jnp.zeros_like(floats(shape.spacing))
    return jnp.zeros_like(floats(shape.offset))


def edges(shape: Shape, dim: int) -> tuple:
    """Pairs (i, j), i < j, of `vertices` joined by an edge, for edge-edge contacts in 3D; static.

    In 2D edges meet at vertices only, so there are none but the segment of a capsule.
    """
    if isinstance(shape, Capsule):
        return ((0, 1),)
    if isinstance(shape, Box) and dim == 3:
        return _CUBE_EDGES
    return _topology(shape)[1] if isinstance(shape, Hull) else ()


def faces(shape: Shape, dim: int) -> tuple:
    """For each face of the core, `dim` of its `vertices`, counter-clockwise seen from outside; static.

    In 2D the segment of a capsule has two; in 3D it has none, like the point of a disc or sphere.
    """
    if isinstance(shape, Hull):
        return _topology(shape)[0]
    if dim == 3:
        return _CUBE_FACES if isinstance(shape, Box) else ()
    count = len(vertices(shape, dim))
    return tuple((k, (k + 1) % count) for k in range(count)) if count > 1 else ()


def edge_apexes(shape: Shape, dim: int) -> tuple:
    """For each of `edges`, a corner off it in each of the two faces that meet there; static.

    For the segment of a capsule, which has no faces, one of its own ends.
    """
    if isinstance(shape, Hull):
        apex = apexes(_topology(shape)[0])
        return tuple((apex[i, j], apex[j, i]) for i, j in edges(shape, dim))
    if isinstance(shape, Box) and dim == 3:
        return tuple(tuple(k for k in range(8) if (i, k) in _BESIDE and k != j) for i, j in _CUBE_EDGES)
    return tuple((i, i) for i, _ in edges(shape, dim))


# ---- topology of hulls


def with_topology(shape: Shape) -> Shape:
    """The shape, with `faces` and `edges` filled in if it is a hull that lacks them.

    For traced vertices the faces must be given; the edges then include the diagonals of flat faces.
    """
    if not isinstance(shape, Hull):
        return shape
    faces, edges = _topology(shape)
    return replace(shape, faces=faces, edges=edges)


def _topology(hull: Hull) -> tuple[tuple, tuple]:
    """Faces and edges of a hull, found where they are not given."""
    unknown = traced(hull.vertices)
    if hull.faces is None and unknown:
        raise ValueError(
            "Hull.vertices is traced, so its faces cannot be found: outside the traced function make "
            "hull = with_topology(Hull(vertices=...)), inside it replace(hull, vertices=...)"
        )
    # static fields must hash, and faces may come as an array
    faces = hull_faces(hull.vertices) if hull.faces is None else triples(hull.faces)
    if hull.edges is not None:
        return faces, hull.edges
    return faces, hull_edges(faces, None if unknown else hull.vertices)


def traced(leaf) -> bool:
    """Whether a leaf, or a number in a tuple given for one, is a tracer, known only when the program runs."""
    return any(isinstance(part, jax.core.Tracer) for part in jax.tree.leaves(leaf))


def floats(leaf) -> Array:
    """A leaf as a float array; records may hold plain numbers and tuples until they are put into a world."""
    # Through numpy, which joins numbers of different kinds even where JAX is told not to.
    leaf = jnp.asarray(np.asarray(leaf) if isinstance(leaf, list | tuple) and not traced(leaf) else leaf)
    return leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.astype(float)
