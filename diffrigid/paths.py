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

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import joint_motion, so2
from diffrigid.convert import Numbers, known, nearest, numbers
from diffrigid.forces import Gravity
from diffrigid.joints import Revolute
from diffrigid.moments import assembly_properties, volume_properties
from diffrigid.pytree import array_fields, letters_of, replace
from diffrigid.shapes import traced
from diffrigid.state import COEFFICIENTS, State
from diffrigid.world import Seat, World, seated, seats

UNITS = {
    "mass": "kg", "inertia": "kg m^2", "gravity": "m/s^2", "g": "m/s^2",
    "x": "m", "v": "m/s", "angle": "rad", "w": "rad/s",
    "radius": "m", "half": "m", "half_length": "m", "vertices": "m", "points": "m", "offset": "m", "width": "m",
    "heights": "m", "spacing": "m",
    "linear": "N s/m", "quadratic": "N s^2/m^2", "angular": "N m s/rad", "stiffness": "N/m", "damping": "N s/m",
    "length": "m", "arm": "m", "slow": "m/s",
    "translation": "m", "F": "N", "tau": "N m", "point": "m", "anchor_a": "m", "anchor_b": "m", "rest_speed": "m/s",
    "restitution_falloff": "s/m", "rolling_friction": "m", "spinning_friction": "m",
}  # fmt: skip
ABOUT_AXIS = {
    "lower": "rad", "upper": "rad", "rate": "rad/s", "speed": "rad/s", "friction": "N m", "damping": "N m s/rad",
}  # fmt: skip
ALONG_AXIS = {"lower": "m", "upper": "m", "rate": "m/s", "speed": "m/s", "friction": "N", "damping": "N s/m"}


class Place(NamedTuple):
    """The leaf that a path names, and the row of it. Chain: attribute names and tuple indices from (world, state)."""

    chain: tuple[str | int, ...]
    row: int | None  # None: all of it
    angle: bool = False  # the leaf is q, the value an angle
    joint: tuple[str, str] | None = None  # name and "angle", "translation" or "rate": the leaf moves with the joint
    solid: tuple[Seat, ...] = ()  # shapes of a body: the value is their density


class Catalogue(dict[str, list[Place]]):
    """Places by path. It prints its paths, those of one owner in a line."""

    def __repr__(self) -> str:
        owners: dict[str, list[str]] = {}
        for path in self:
            owner, _, field = path.partition(".")
            owners.setdefault(f"{owner}: " if field else "", []).append(field or owner)
        return "\n".join(owner + ", ".join(fields) for owner, fields in owners.items())


def read(world: World, state: State, path: str) -> Array:
    """Value of a parameter, without batch axes: shape () or (D,) or as its leaf has it.

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

    Values are not normalised: a normal, an axis or a quaternion has to have length one.

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


def unit(world: World, path: str) -> str:
    """SI unit of a parameter; "" where it has none or is unknown."""
    owner, _, field = component(path)[0].rpartition(".")
    kinds = [joint for names, joint in zip(world.joint_names, world.joints, strict=True) if owner in names]
    if field == "density":
        return f"kg/m^{world.dim}"
    along = {} if not kinds else ABOUT_AXIS if isinstance(kinds[0], Revolute) else ALONG_AXIS
    return along.get(field, UNITS.get(field, ""))


def places(world: World, path: str) -> list[Place]:
    """The leaves that a path names; for a component, those of the whole vector.

    Raises:
        ValueError: there is no such parameter; the message lists the nearest.
    """
    known, whole = catalogue(world), component(path)[0]
    if whole not in known:
        raise ValueError(f"no parameter {path!r} in this world: {hint(world, whole, known)}")
    return known[whole]


def order_of(world: World, path: str) -> int:
    """Rank in which to set a parameter: shapes before densities, all before joints, and their rates last."""
    known = catalogue(world).get(component(path)[0], [])
    place = known[0] if known else Place((), None)
    return (2 + (place.joint[1] == joint_motion.RATE)) if place.joint else int(bool(place.solid))


def _solid(world: World, solid: tuple[Seat, ...]) -> tuple[Array, Array]:
    """Volume [m^D] and inertia over mass [m^2] of the shapes of a body."""
    shapes, r, q = zip(*(seated(world, seat) for seat in solid), strict=True)
    if len(solid) == 1:
        volume, _, gyration = volume_properties(shapes[0], world.dim)
    else:
        volume, _, gyration = assembly_properties(shapes, r, q, None, world.dim)
    return volume, gyration


def hint(world: World, path: str, known: Iterable[str]) -> str:
    """Hint on what was meant by a path that is not `known`."""
    owner, _, field = path.rpartition(".")
    joints = [(name, group) for names, group in zip(world.joint_names, world.joints, strict=True) for name in names]
    owners: dict[str, Any] = dict(zip(world.force_names, world.forces, strict=True)) | dict(joints)
    of_body = owner in world.names and field in COEFFICIENTS
    if of_body or (owner in owners and field in array_fields(owners[owner])):
        return f"it was left out when the scene was made: give {owner} a {field} to begin with."
    if owner in dict(joints) and field in joint_motion.fields_of(owners[owner]):
        return f"{owner} is part of a closed loop, so that what hangs on it cannot be moved alone: set bodies instead."
    if path == "gravity" and (several := _gravities(world)):
        return f"there are {len(several)}: use {' or '.join(f'{name}.g' for name in several)}."
    return nearest(path, known)


def _gravities(world: World) -> list[str]:
    """Names of the forces that are gravity."""
    return [name for name, force in zip(world.force_names, world.forces, strict=True) if isinstance(force, Gravity)]


def component(path: str) -> tuple[str, int | None]:
    """Path of the whole and index: "ball.v[0]" is ("ball.v", 0), "ball.v" is ("ball.v", None)."""
    match = re.fullmatch(r"(.+)\[(\d+)\]", path, re.DOTALL)
    return (match[1], int(match[2])) if match else (path, None)


def _item(vector: Array, path: str, index: int) -> Array:
    """Component `index` of a vector; `path` is that of the whole."""
    if not vector.ndim or index >= vector.shape[0]:
        raise ValueError(f"{path}[{index}] is not a number: {path} has the shape {vector.shape}.")
    return _row(vector, index)


def catalogue(world: World) -> Catalogue:
    """Every path of a world, and the places it stands for; prints as a list of the paths.

    Example:
        >>> [path for path in dr.paths.catalogue(world) if path.startswith("ball.") and "shape" in path]
        ['ball.shape.radius']
    """
    out = Catalogue()
    coefficients = tuple(name for name in COEFFICIENTS if getattr(world.bodies, name) is not None)
    for name in coefficients:
        out[name] = [Place((0, "bodies", name), None)]
        if world.static_names:
            out[name].append(Place((0, "statics", name), None))
    for index, (name, force) in enumerate(zip(world.force_names, world.forces, strict=True)):
        for field in array_fields(force):
            if getattr(force, field) is not None:
                out[f"{name}.{field}"] = [Place((0, "forces", index, field), None)]
        if isinstance(force, Gravity) and len(_gravities(world)) == 1:
            out["gravity"] = [Place((0, "forces", index, "g"), None)]
    for group, (names, joint) in enumerate(zip(world.joint_names, world.joints, strict=True)):
        for row, name in enumerate(names):
            for field in array_fields(joint):
                if getattr(joint, field) is not None:
                    out[f"{name}.{field}"] = [Place((0, "joints", group, field), row)]
            _, moved = joint_motion.moving_side(world, name)
            for field in joint_motion.fields_of(joint) if moved else ():
                leaves = ("v", "w") if field == joint_motion.RATE else ("x", "q")
                out[f"{name}.{field}"] = [Place((1, leaf), moved[0], joint=(name, field)) for leaf in leaves]
    out |= {f"contact.{field}": [Place((0, "contact", field), None)] for field in array_fields(world.contact)}
    for row, name in enumerate(world.names):
        out |= {f"{name}.{f}": [Place((0, "bodies", f), row)] for f in ("mass", "inertia", *coefficients)}
        out |= {f"{name}.{f}": [Place((1, f), row)] for f in ("x", "q", "v", "w")}
        if world.dim == 2:
            out[f"{name}.angle"] = [Place((1, "q"), row, angle=True)]
    for row, name in enumerate(world.static_names):
        out |= {f"{name}.{f}": [Place((0, "statics", f), row)] for f in ("x", "q", *coefficients)}
        if world.dim == 2:
            out[f"{name}.angle"] = [Place((0, "statics", "q"), row, angle=True)]
    names = world.names + world.static_names
    solids: dict[int, tuple[Seat, ...]] = {}
    for seat in seats(world):
        solids[seat.owner] = (*solids.get(seat.owner, ()), seat)
    for owner, solid in solids.items():
        if owner < len(world.names):
            of_density = [(0, "bodies", leaf) for leaf in ("mass", "inertia")]
            out[f"{names[owner]}.density"] = [Place(leaf, owner, solid=solid) for leaf in of_density]
        for seat in solid:
            out |= _of_shape(world, seat, f"{names[owner]}.shape")
    return out


def _of_shape(world: World, seat: Seat, path: str) -> dict[str, list[Place]]:
    """Places of a shape: its dimensions and, of one of several, where it sits on its body."""
    fields = {
        field: Place((0, "shapes", seat.group, field), seat.row) for field in array_fields(world.shapes[seat.group])
    }
    if seat.part:
        path = f"{path}.{seat.part}"
        fields["x"] = Place((0, "offsets", seat.group, "r"), seat.row)
        if world.offsets[seat.group].q is not None:
            turn = (0, "offsets", seat.group, "q")
            fields["q"] = Place(turn, seat.row)
            if world.dim == 2:
                fields["angle"] = Place(turn, seat.row, angle=True)
    return {f"{path}.{field}": [place] for field, place in fields.items()}


def leaf_of(pair: tuple[World, Any], place: Place) -> Any:
    """The whole leaf of which a place is a part."""
    leaf: Any = pair
    for key in place.chain:
        leaf = leaf[key] if isinstance(key, int) else getattr(leaf, key)
    return leaf


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
    rank = len(letters) - (letters[:1] in (("N",), ("S",)) and place.row is not None)
    shape = getattr(record, field).shape[place.row is not None :]
    return () if place.angle else shape[:rank], shape[rank:]
