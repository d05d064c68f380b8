"""The two colliders of a pair on their paths."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.collide import COLLIDERS, Contacts, PairGroup
from diffrigid.collide.contacts import FAR
from diffrigid.collide.distance import reach
from diffrigid.collide.heights import candidates
from diffrigid.collide.penetration import core_separation
from diffrigid.fence import unfused
from diffrigid.flight import Flight, angular_momentum, orientation, position, velocity
from diffrigid.gathers import rows
from diffrigid.numerics import dot, norm
from diffrigid.pytree import array, pytree, replace
from diffrigid.shapes import BOUNDLESS, Capsule, Disc, HalfSpace, HeightField, Sphere, faces, radius
from diffrigid.state import at_place, rotations

if TYPE_CHECKING:
    from diffrigid.world import World

GAP_ROUNDING = 1e2  # [-] times eps times (size + a tenth of the coordinates): accuracy to which gaps are known


@pytree
class Side:
    """One collider of a pair: its path, its shape in the shape's own axes, and where that sits on the body."""

    flight: Any  # Flight, None: it does not move, and x, q hold its pose
    since: Any = array(default=None)  # [s] earliest time for which the path holds
    shape: Any
    offset: Any = array("D", default=None)  # [m] shape origin from the centre of mass, body axes
    turn: Any = array("Q", default=None)  # from the shape's own axes to body axes
    supported: Any = array(default=None)  # bool: it rests on something where its path begins; None: not asked for
    x: Any = array("D", default=None)
    q: Any = array("Q", default=None)


@pytree
class Placed:
    """A collider at one time. For one that does not move, velocities and inverse inertias are None."""

    x: Array = array("D")  # [m]
    q: Array = array("Q")
    v: Any = array("D", default=None)  # [m/s]
    w: Any = array("A", default=None)  # [rad/s]
    a: Any = array("D", default=None)  # [m/s^2]
    dw: Any = array("A", default=None)  # [rad/s^2]
    inverse_mass: Any = array(default=None)  # [1/kg]
    inverse_inertia: Any = None  # [1/(kg m^2)] world axes


def sides_of(
    world: "World", pairs: PairGroup, flight: Flight, since: Array, supported: Array | None = None
) -> tuple[Side, Side]:
    """Both sides of P pairs of one kind, every array with a leading axis P. `supported`: (N, *batch) bool."""
    a = side_of(world, flight, since, pairs.shape_a, pairs.row_a, pairs.a)
    b = side_of(world, flight, since, pairs.shape_b, pairs.row_b, pairs.b)
    if supported is None or not have_faces(type(a.shape), type(b.shape)):
        return a, b
    a, b = (
        replace(side, supported=None if side.flight is None else rows(supported, colliders))
        for side, colliders in ((a, pairs.a), (b, pairs.b))
    )
    return a, b


def side_of(world: "World", flight: Flight, since: Array, kind: int, shape_rows: tuple, colliders: tuple) -> Side:
    """Side with shapes `shape_rows` of world.shapes[kind], on colliders that all move or are all static."""
    moving = flight.t0.shape[0]

    def chosen(tree, index):
        return jax.tree.map(lambda leaf: rows(leaf, index), tree)

    shape, offset = chosen((world.shapes[kind], world.offsets[kind]), shape_rows)
    if min(colliders) >= moving:
        x, q = chosen((world.statics.x, world.statics.q), tuple(i - moving for i in colliders))
        return Side(flight=None, shape=shape, x=x, q=q)
    r, turn = (None, None) if offset is None else (offset.r, offset.q)
    path = chosen((flight, since), colliders)
    return Side(flight=path[0], since=path[1], shape=shape, offset=r, turn=turn)


@jax.jit
def place(side: Side, s: Array) -> Placed:
    """The collider at time s (*batch) [s]."""
    f = side.flight
    if f is None:
        return Placed(x=side.x, q=side.q)
    so = rotations(f.dim)
    q = unfused(orientation, f, s)
    inverse = unfused(so.world_inverse, f.inverse_inertia, q)
    L = angular_momentum(f, s)
    w = so.apply(inverse, L)
    # A torque that varies is left out: its curve may be steep where little is left of the step.
    turning = so.precession(L, w) if f.tau is None or f.twist is not None else so.precession(L, w) + f.tau
    dw = so.apply(inverse, turning)
    x, v = position(f, s), velocity(f, s)
    return Placed(x=x, q=q, v=v, w=w, a=f.a, dw=dw, inverse_mass=f.inverse_mass, inverse_inertia=inverse)


def centre(side: Side, s: Array) -> tuple[Array, Array]:
    """Centre of mass [m] and its velocity [m/s] at time s."""
    if side.flight is None:
        return side.x, jnp.zeros_like(side.x)
    return position(side.flight, s), velocity(side.flight, s)


def earliest(a: Side, b: Side) -> tuple[Array, Array]:
    """Time from which both paths hold, and the earliest time at which a late impact may be repaired; (*batch) [s]."""
    start = began(a, b)
    if b.flight is None or a.flight is None:
        return start, (a if b.flight is None else b).since
    return start, jnp.maximum(a.since, b.since)


def began(a: Side, b: Side) -> Array:
    """Time from which both paths hold, (*batch) [s]: the later of their beginnings."""
    if b.flight is None or a.flight is None:
        return (a if b.flight is None else b).flight.t0
    return jnp.maximum(a.flight.t0, b.flight.t0)


def have_faces(a: type, b: type) -> bool:
    """Whether flat faces of shapes of two kinds may meet that end somewhere; that of a half-space does not.

    A capsule has none, but its ends go from one face of a grid to the next.
    """
    if b is HeightField:
        return a is not Sphere
    return b is not HalfSpace and not {a, b} & {Disc, Sphere, Capsule}


def is_ball(side: Any) -> bool:
    """Whether a collider, with `shape` and `offset`, is a disc or sphere about its centre of mass. Static."""
    return isinstance(side.shape, Disc | Sphere) and side.offset is None


def contacts_of(a: Side, at_a: Placed, b: Side, at_b: Placed) -> Contacts:
    """Contacts of the pair where its colliders are placed."""
    return COLLIDERS[type(a.shape), type(b.shape)](a.shape, *_origin(a, at_a), b.shape, *_origin(b, at_b))


def candidates_of(a: Side, at_a: Placed, b: Side, at_b: Placed) -> Contacts:
    """Contacts that a search for an impact must examine: all candidates, where the contacts are a selection of them."""
    if isinstance(b.shape, HeightField):
        return candidates(a.shape, *_origin(a, at_a), b.shape, *_origin(b, at_b))
    return contacts_of(a, at_a, b, at_b)


def have_depth(a: Side, b: Side) -> bool:
    """Whether two shapes are convex and bounded, and one of their cores has faces. Static."""
    dim = (a if b.flight is None else b).flight.dim
    return not isinstance(b.shape, BOUNDLESS) and bool(faces(a.shape, dim) or faces(b.shape, dim))


def separation_of(a: Side, at_a: Placed, b: Side, at_b: Placed) -> Contacts:
    """The contact along the direction of the largest separation of two cores that `have_depth`, (1, ...)."""
    return core_separation(a.shape, *_origin(a, at_a), b.shape, *_origin(b, at_b))


def _origin(side: Side, at: Placed) -> tuple[Array, Array]:
    return at_place(at.x, at.q, side.offset, side.turn)


def relative_velocity(at_a: Placed, arm_a: Array, at_b: Placed, arm_b: Array) -> Array:
    """Velocity of a against b at these arms from their centres of mass, (D, *batch) [m/s]."""
    cross = rotations(arm_a.shape[0]).cross
    return difference(lambda at, arm: at.v + cross(at.w, arm), at_a, arm_a, at_b, arm_b)


def relative_acceleration(at_a: Placed, at_b: Placed, point_a: Array, point_b: Array) -> Array:
    """Acceleration of a at a world point against b at another, a + dw x r + w x (w x r) of each, (D, *batch) [m/s^2].

    It only guides the search for an impact, and so need not be exact.
    """

    def one(at, arm):
        cross = rotations(arm.shape[0]).cross
        return at.a + cross(at.dw, arm) + cross(at.w, cross(at.w, arm))

    return difference(one, at_a, point_a - at_a.x, at_b, point_b - at_b.x)


def difference(of: Callable, at_a: Placed, given_a: Any, at_b: Placed, given_b: Any) -> Array:
    """of(at_a, given_a) - of(at_b, given_b), without the term of a static."""
    if at_b.v is None:
        return of(at_a, given_a)
    return -of(at_b, given_b) if at_a.v is None else of(at_a, given_a) - of(at_b, given_b)


@jax.jit
def gap_rates(contacts: Contacts, at_a: Placed, at_b: Placed) -> Array:
    """d(gap)/ds of every contact, (K, *batch) [m/s]: the normal velocity of a against b at the contact point."""

    def one(n, p):
        return dot(n, relative_velocity(at_a, p - at_a.x, at_b, p - at_b.x))

    return jax.vmap(one)(contacts.normal, contacts.point)


def moving_along(side: Side, at: Placed, s: Array) -> Placed:
    """The collider at time s (*batch) [s] with the rates of its path.

    With varying forces these differ slightly from its velocities: position and velocity are then separate curves, both
    of which end where the integration does.
    """
    f = side.flight
    if f is None or f.jerk is None:
        return at
    so = rotations(f.dim)

    def path(s: Array) -> tuple[Array, Array]:
        return position(f, s), so.chord(so.difference(at.q, orientation(f, s)))

    v, w = jax.jvp(path, (s,), (jnp.ones_like(s),))[1]
    return replace(at, v=v, w=so.rotate(at.q, w) if so.D == 3 else w)


def core_reach_of(side: Side) -> Array:
    """Radius about the centre of mass that encloses the core; the rounding around the core does not feel a spin."""
    return reach_of(side) - lax.stop_gradient(radius(side.shape))


def reach_of(side: Side) -> Array:
    """Radius about the centre of mass that encloses the shape, (*batch) [m]; huge for unbounded shapes."""
    if isinstance(side.shape, BOUNDLESS):
        return jnp.full_like(side.x[0], FAR)
    shape, offset = lax.stop_gradient((side.shape, side.offset))
    dim = side.x.shape[0] if side.flight is None else side.flight.dim
    return reach(shape, dim) if offset is None else reach(shape, dim) + norm(offset)


def smaller_size(a: Side, b: Side) -> Array:
    """The smaller reach of two colliders, (*batch) [m]."""
    return lax.stop_gradient(jnp.minimum(reach_of(a), reach_of(b)))


def gap_rounding(a: Side, at_a: Placed, b: Side, at_b: Placed) -> Array:
    """Accuracy to which gaps between two colliders are known, (*batch) [m]."""
    far = smaller_size(a, b) + 0.1 * lax.stop_gradient(jnp.abs(at_a.x).max(0) + jnp.abs(at_b.x).max(0))
    return GAP_ROUNDING * jnp.finfo(far.dtype).eps * far
