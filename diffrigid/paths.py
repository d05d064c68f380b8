"""Names of parameters: a path such as "ball.mass" and the leaf, or the part of one, that it stands for.

restitution, friction, ...               a coefficient of all bodies and statics, their own too
gravity                                  the gravity vector, of the one force that is gravity
contact.width, contact.rest_speed        numbers of the contact model
FORCE.field                              a force of the scene, by its name: "drag.linear"
JOINT.field                              a joint of the scene, by its name: "revolute.anchor_a"
JOINT.angle | rate, JOINT.translation | rate    initial state of a hinge, of a slider, and of all attached to it
BODY.mass | inertia | restitution | friction | ... | shape.FIELD
BODY.shape.PART.FIELD | x | angle | q    one of several shapes, and where it sits: x from the centre of mass, body axes
BODY.density                             of a body that is solid: sets its mass, and its inertia by its shape
BODY.x | v | q | w | angle               initial state (angle: 2D)
STATIC.x | q | angle | restitution | friction | ... | shape.FIELD
PATH[k]                                  number k of a vector: "ball.v[0]"

The dots stand for the coefficients that only some worlds have: restitution_falloff, rolling_friction,
spinning_friction.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import joint_motion, so2
from diffrigid.catalogue import Place, catalogue, component, leaf_of, places, unit
from diffrigid.convert import Numbers, known, numbers
from diffrigid.moments import assembly_properties, volume_properties
from diffrigid.pytree import letters_of, replace
from diffrigid.shapes import traced
from diffrigid.state import COEFFICIENTS, State
from diffrigid.world import Seat, World, seated

__all__ = ["catalogue", "read", "unit", "write"]


def read(world: World, state: State, path: str) -> Array:
    """Value of a parameter in one world, with the shape of its leaf: (), (D,), (3, 3), (V, D) or another.

    A coefficient without the name of a body, such as "restitution", gives that of the first body.

    Example:
        >>> dr.paths.read(world, state, "ball.x").tolist()
        [0.0, 1.0]
    """
    whole, index = component(path)
    if index is not None:
        return _item(read(world, state, whole), whole, index)
    place = places(world, path)[0]
    if place.joint:
        return joint_motion.read(world, state, *place.joint)
    if place.solid:
        return world.bodies.mass[place.row] / _solid(world, place.solid)[0]
    leaf = leaf_of((world, state), place)
    value: Any = leaf if place.row is None else _row(leaf, place.row)
    if path in COEFFICIENTS:
        return _row(value, 0)
    return so2.log(value)[0] if place.angle else value


def write(world: World, state: State, path: str, value: Any) -> tuple[World, State]:
    """World and state with a parameter changed; everything else shared. Works on traced values.

    Values are neither checked nor normalised: a mass has to be above 0, and a normal, an axis or a quaternion of length
    one.

    Raises:
        ValueError: there is no such parameter, or the value has another shape. Coefficients without the name of a
            body take a number for all.

    Example:
        >>> thrown = dr.paths.write(world, state, "ball.v", (0.0, 2.0))  # world and state; those before do not change
        >>> dr.rollout(*thrown, dt=1 / 60, steps=30).state.x[-1, 0].round(2).tolist()
        [0.0, 0.77]
    """
    whole, index = component(path)
    if index is not None:
        vector = read(world, state, whole)
        part = numbers(path, value, _item(vector, whole, index).shape, finite=False)
        return write(world, state, whole, _with_rows(vector, index, part.astype(vector.dtype)))
    if (place := places(world, path)[0]).joint or place.solid:
        number = jnp.asarray(numbers(path, value, (), finite=False), state.x.dtype)
    if place.joint:
        return world, joint_motion.write(world, state, *place.joint, number)
    if place.solid:
        volume, gyration = _solid(world, place.solid)
        bodies, mass = world.bodies, number * volume
        mass, inertia = bodies.mass.at[place.row].set(mass), bodies.inertia.at[place.row].set(mass * gyration)
        return replace(world, bodies=replace(bodies, mass=mass, inertia=inertia)), state
    pair: Any = (world, state)
    for place in places(world, path):
        pair = _update(pair, place.chain, lambda record, field, place=place: _set(record, field, place, path, value))
    return pair


@functools.partial(jax.jit, static_argnames="solid")
def _solid(world: World, solid: tuple[Seat, ...]) -> tuple[Array, Array]:
    """Volume [m^D] and inertia over mass [m^2] of the shapes of a body."""
    shapes, r, q = zip(*(seated(world, seat) for seat in solid), strict=True)
    if len(solid) == 1:
        volume, _, gyration = volume_properties(shapes[0], world.dim)
    else:
        volume, _, gyration = assembly_properties(shapes, r, q, None, world.dim)
    return volume, gyration


def _item(vector: Array, path: str, index: int) -> Array:
    """Component `index` of a vector; `path` is that of the whole."""
    if not vector.ndim or index >= vector.shape[0]:
        raise ValueError(f"{path}[{index}] is not a number: {path} has the shape {vector.shape}")
    return _row(vector, index)


def _update(node: Any, chain: tuple, change) -> Any:
    key, rest = chain[0], chain[1:]
    if isinstance(key, int):
        return (*node[:key], _update(node[key], rest, change), *node[key + 1 :])
    return replace(node, **{key: _update(getattr(node, key), rest, change) if rest else change(node, key)})


def _set(record: Any, field: str, place: Place, path: str, value: Any) -> Array:
    """The leaf `record.field` with the value put into its place."""
    leaf = getattr(record, field)
    value = numbers(path, value, None, finite=False).astype(leaf.dtype)
    expected, batch = _axes(record, field, place)
    if place.row is None and path in COEFFICIENTS and value.ndim == 0:
        return _with_rows(leaf, ..., value)
    if value.ndim == 0 and expected == (1,):
        value = value[None]
    if value.shape not in (expected, expected + batch):
        many = ""
        if value.shape[1:] == expected:
            many = f" For many worlds: jax.vmap(lambda value: dr.paths.write(world, state, {path!r}, value))(values)"
        raise ValueError(f"{path} was given the shape {value.shape}: expected {expected}, as `read` returns it.{many}")
    value = known(so2.exp, value[None]) if place.angle else value
    value = value.reshape(value.shape + (1,) * (leaf.ndim - (place.row is not None) - value.ndim))
    return _with_rows(leaf, ... if place.row is None else place.row, value)


def _row(leaf: Array, row: int) -> Array:
    """One row of a leaf; without compiling anything if the leaf is known."""
    return leaf[row] if traced(leaf) else jax.device_put(np.asarray(leaf)[row])


def _with_rows(leaf: Array, rows: Any, value: Numbers) -> Array:
    """A leaf with some rows changed; without compiling anything if the leaf is known."""
    if traced((leaf, value)):
        return jnp.asarray(leaf).at[rows].set(value)
    changed = np.array(leaf)
    changed[rows] = value
    return jax.device_put(changed)


def _axes(record: Any, field: str, place: Place) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Shape of the value of a place in one world, and the batch axes that its leaf has behind it."""
    letters = letters_of(record, field)
    rank = len(letters) - (letters[:1] in (("N",), ("S",), ("M",)) and place.row is not None)
    shape = getattr(record, field).shape[place.row is not None :]
    return () if place.angle else shape[:rank], shape[rank:]
