"""Read and set the angle of a hinge, the translation of a slider, and their rates, in a state.

Setting one moves all bodies on one side of the joint as a rigid body, against the body on the other side, and closes
the joint where its anchors do not meet. The side that moves is the one that no other joint holds to a static or to the
world; if both are free, that of body a.
"""

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.constraints import change, placed
from diffrigid.elimination import grounded, islands
from diffrigid.joints import Pose, Prismatic, Revolute
from diffrigid.linkage import ends_of, to_sides, twists_of
from diffrigid.numerics import dot
from diffrigid.pytree import replace
from diffrigid.state import State, rotations

if TYPE_CHECKING:
    from diffrigid.world import World

COORDINATE = {Revolute: "angle", Prismatic: "translation"}
RATE = "rate"


def fields_of(joint: Any) -> tuple[str, ...]:
    """Names of what can be read and set of a joint: "angle" or "translation", and "rate"."""
    return (COORDINATE[type(joint)], RATE) if type(joint) in COORDINATE else ()


@functools.partial(jax.jit, static_argnames=("name", "field"))  # else each of its operations is compiled by itself
def read(world: "World", state: State, name: str, field: str) -> Array:
    """The angle [rad], the translation [m] or the rate [rad/s, m/s] of a joint, (*batch)."""
    so, at = rotations(world.dim), _at(world, state, name)

    def coordinate(a: Pose, b: Pose) -> Array:
        return at.joint.coordinate(so, a, b)

    return change(so, coordinate, at.a, at.b, at.twists) if field == RATE else coordinate(at.a, at.b)


@functools.partial(jax.jit, static_argnames=("name", "field"))
def write(world: "World", state: State, name: str, field: str, value: Array) -> State:
    """Change a state, without batch axes, so that `read` gives the value. Velocities turn with the bodies."""
    side, bodies = moving_side(world, name)
    by, rows = value - read(world, state, name, field), jnp.array(bodies)
    motion = _motion(world, _at(world, state, name), side, by)
    moved = (_faster if field == RATE else _moved)(state, motion, rows)
    return replace(state, **{leaf: getattr(state, leaf).at[rows].set(new) for leaf, new in moved.items()})


def moving_side(world: "World", name: str) -> tuple[int, tuple[int, ...]]:
    """Side of a joint that moves when it is set, 0 for that of a, and its bodies, that of the joint first.

    No bodies if both sides are connected without the joint, so that neither moves alone.
    """
    index = [joint for names in world.joint_names for joint in names].index(name)
    return _moving_side(ends_of(world.joints), index, len(world.names))


@functools.cache
def _moving_side(ends: tuple[tuple[int, int], ...], index: int, moving: int) -> tuple[int, tuple[int, ...]]:
    pairs = grounded(ends, moving)
    a, b = pairs[index]
    sides = islands(pairs[:index] + pairs[index + 1 :], moving + 1)
    if b in sides[a]:
        return 0, ()
    side = 1 if moving in sides[a] else 0
    own = (a, b)[side]
    return side, (own, *(body for body in sides[own] if body != own))


class _At(NamedTuple):
    """A joint, and its bodies a and b."""

    joint: Any
    a: Pose
    b: Pose
    twists: Array  # (2, D + A, *batch)


def _at(world: "World", state: State, name: str) -> _At:
    group, row = next((g, names.index(name)) for g, names in enumerate(world.joint_names) if name in names)
    (at,) = placed(world.joints[group : group + 1], world.statics, state.x, state.q)
    twists = to_sides(ends_of(world.joints[group : group + 1]), twists_of(state))
    joint, a, b = jax.tree.map(lambda leaf: leaf[row], tuple(at))
    return _At(joint, a, b, twists[row])


class _Motion(NamedTuple):
    """Motion of one side of a joint against the other, the base, when its coordinate changes."""

    way: Array  # (D,) [m] displacement of the anchor along the axis of a slider, or its change of velocity
    turn: Array  # (A,) [rad] about the axis of a hinge, or its change of angular velocity
    along: Array | None  # (D,) axis along which the anchor may move; None: it stays on that of the base
    anchor: Array  # (D,) [m] on the side that moves
    own: Any  # twist (D + A,) and place (D,) of the body that it is on
    base: Any  # likewise
    pivot: Array  # (D,) [m] where the anchor belongs, before it moves


def _motion(world: "World", at: _At, side: int, by: Array) -> _Motion:
    so, joint = rotations(world.dim), at.joint
    anchors = [pose.x + so.rotate(pose.q, anchor) for pose, anchor in ((at.a, joint.anchor_a), (at.b, joint.anchor_b))]
    bodies = [(at.twists[0], at.a.x), (at.twists[1], at.b.x)]
    by = by if side == 0 else -by  # of b against a
    no_turn, pivot = jnp.zeros_like(at.twists[0, so.D :]), anchors[1 - side]
    if isinstance(joint, Revolute):
        axis = jnp.ones_like(no_turn) if so.D == 2 else so.rotate(at.b.q, joint.axis_b)
        way, turn, along = jnp.zeros_like(pivot), by * axis, None
    else:
        along = so.rotate(at.b.q, joint.axis_b)
        way, turn = by * along, no_turn
        pivot = pivot + dot(along, anchors[side] - pivot) * along
    return _Motion(way, turn, along, anchors[side], bodies[side], bodies[1 - side], pivot)


def _moved(state: State, motion: _Motion, rows: Array) -> dict[str, Array]:
    """Move the bodies `rows`, with the anchor closed first; velocities relative to the base turn with them."""
    so = rotations(state.x.shape[1])
    (own, own_x), (base, base_x) = motion.own, motion.base
    turned, target = so.exp(motion.turn), motion.pivot + motion.way

    def of_base(x: Array) -> Array:
        return base[: so.D] + so.cross(base[so.D :], x - base_x)

    def one(x: Array, q: Array, v: Array, w: Array) -> tuple[Array, ...]:
        there = target + so.rotate(turned, x - motion.anchor)
        w = base[so.D :] + (w - base[so.D :] if so.D == 2 else so.rotate(turned, w - base[so.D :]))
        return there, so.turn_by(motion.turn, q), of_base(there) + so.rotate(turned, v - of_base(x)), w

    x, q, v, w = jax.vmap(one)(state.x[rows], state.q[rows], state.v[rows], state.w[rows])
    # The anchor moves with that of the base, but along the axis of a slider.
    there, _, u, spin = one(own_x, state.q[rows[0]], own[: so.D], own[so.D :])
    apart = u + so.cross(spin, target - there) - of_base(target)
    if motion.along is not None:
        along = so.rotate(turned, motion.along)
        apart = apart - dot(along, apart) * along
    return {"x": x, "q": q, "v": v - apart[None], "w": w}


def _faster(state: State, motion: _Motion, rows: Array) -> dict[str, Array]:
    """Velocities of the bodies `rows`, changed along the joint."""
    so = rotations(state.x.shape[1])
    turning = jax.vmap(so.cross, (None, 0))(motion.turn, state.x[rows] - motion.anchor[None])
    return {"v": state.v[rows] + motion.way[None] + turning, "w": state.w[rows] + motion.turn[None]}
