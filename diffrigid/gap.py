"""Distance between the surfaces of two bodies, in a state."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.collide import COLLIDERS
from diffrigid.pytree import align_all
from diffrigid.shapes import UNEVEN
from diffrigid.spelling import nearest
from diffrigid.state import State, at_place
from diffrigid.step import floats
from diffrigid.world import World, check, seated, seats


def gap(world: World, state: State, a: str, b: str) -> Array:
    """Find the distance between the surfaces of two bodies, or of a body and a static, (*batch) [m].

    Negative where they overlap, then of the deepest contact. For `jit`, `vmap` and `grad`: what a controller sees.

    Raises:
        ValueError: a name that is not there, or twice the same, a body without a shape, two half-spaces, or a `Profile`
            or `HeightField`, of which a body knows only the parts that it may touch within a step.

    Differentiable, with a kink where the closest points jump. At least 0.4 % of the radius of the smaller shape where
    a corner of one lies in the plane of a face of the other, beside it: as a contact it then counts as not yet there.

    Example:
        >>> round(float(dr.gap(world, state, "ball", "floor")), 6)  # from a height of 1 m, less the radius
        0.9
    """
    check(world, state)
    names = (*world.names, *world.static_names)
    for name in (a, b):
        if name not in names:
            raise ValueError(f"gap: {name!r} is neither a body nor a static: {nearest(name, names)}")
    if a == b:
        raise ValueError(f"gap: {a!r} twice: name two bodies, or a body and a static")
    return _least(*align_all(*floats(world, state)), a, b)


@functools.partial(jax.jit, static_argnames=("a", "b"))  # else each of its operations is compiled by itself
def _least(world: World, state: State, a: str, b: str) -> Array:
    sides = [_placed(world, state, name) for name in (a, b)]
    gaps: list[Array] = []
    for one, other in itertools.product(*sides):
        shape, second = (one, other) if (type(one[0]), type(other[0])) in COLLIDERS else (other, one)
        find = COLLIDERS.get((type(shape[0]), type(second[0])))
        if find is None:
            raise ValueError(f"gap: {a!r} and {b!r} are half-spaces, which have no distance: name a body for one")
        gaps.append(find(*shape, *second).gap.min(0))
    return functools.reduce(lambda least, gap: jnp.minimum(least, gap), gaps)


def _placed(world: World, state: State, name: str) -> list[tuple[Any, Array, Array]]:
    """Shapes of a body or static, and where their origins are: x (D, *batch) [m], q (Q, *batch)."""
    k, moving = (*world.names, *world.static_names).index(name), len(world.names)
    x, q = (state.x[k], state.q[k]) if k < moving else (world.statics.x[k - moving], world.statics.q[k - moving])
    found = []
    for shape, r, turn in (seated(world, seat) for seat in seats(world) if seat.owner == k):
        if isinstance(shape, UNEVEN):
            raise ValueError(f"gap: {name!r} is a {type(shape).__name__}, to which there is no distance")
        found.append((shape, *at_place(x, q, r, turn)))
    if not found:
        raise ValueError(f"gap: {name!r} has no shape, from which to find a distance")
    return found
