"""Distance between the surfaces of two bodies, in a state."""

import operator
from typing import Any

import jax
from jax import Array

from diffrigid.collide import COLLIDERS
from diffrigid.convert import nearest
from diffrigid.pytree import align_all
from diffrigid.shapes import UNEVEN
from diffrigid.state import State, rotations
from diffrigid.step import floats
from diffrigid.world import World, check


def gap(world: World, state: State, a: str, b: str) -> Array:
    """Find the distance between the surfaces of two bodies, or of a body and a static, (*batch) [m].

    Negative where they overlap, then of the deepest contact. For `jit`, `vmap` and `grad`: what a controller sees.

    Raises:
        ValueError: a name that is not there, or twice the same, a body without a shape, two statics, or a `Profile` or
            `HeightField`, of which a body knows only the parts that it may touch within a step.

    Differentiable, with a kink where the closest points jump.

    Example:
        >>> round(float(dr.gap(world, state, "ball", "floor")), 6)  # from a height of 1 m, less the radius
        0.9
    """
    check(world, state)
    if a == b:
        raise ValueError(f"gap: {a!r} twice: name two bodies, or a body and a static")
    world, state = align_all(*floats(world, state))
    sides = [_placed(world, state, name) for name in (a, b)]
    for (shape, x, q), (other, x_other, q_other) in (sides, sides[::-1]):
        if find := COLLIDERS.get((type(shape), type(other))):
            return find(shape, x, q, other, x_other, q_other).gap.min(0)
    raise ValueError(f"gap: no distance between {a!r}, and {b!r}, neither of which moves")


def _placed(world: World, state: State, name: str) -> tuple[Any, Array, Array]:
    """Shape of a body or static, and where its origin is: x (D, *batch) [m], q (Q, *batch)."""
    names = (*world.names, *world.static_names)
    if name not in names:
        raise ValueError(f"gap: {name!r} is neither a body nor a static: {nearest(name, names)}")
    k, moving = names.index(name), len(world.names)
    x, q = (state.x[k], state.q[k]) if k < moving else (world.statics.x[k - moving], world.statics.q[k - moving])
    for shapes, offset, owners in zip(world.shapes, world.offsets, world.owners, strict=True):
        if k in owners:
            row = owners.index(k)
            if isinstance(shapes, UNEVEN):
                raise ValueError(f"gap: {name!r} is a {type(shapes).__name__}, to which there is no distance")
            if offset is not None:
                x = x + rotations(world.dim).rotate(q, offset.r[row])
            return jax.tree.map(operator.itemgetter(row), shapes), x, q
    raise ValueError(f"gap: {name!r} has no shape, from which to find a distance")
