"""Which parameters a world has: the paths of `paths`, what each stands for, and its unit."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from diffrigid import joint_motion
from diffrigid.forces import Gravity
from diffrigid.joints import Revolute
from diffrigid.pytree import array_fields
from diffrigid.spelling import nearest
from diffrigid.state import COEFFICIENTS
from diffrigid.world import Seat, World, seats

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


def hint(world: World, path: str, known: Iterable[str]) -> str:
    """Hint on what was meant by a path that is not `known`."""
    owner, _, field = path.rpartition(".")
    joints = [(name, group) for names, group in zip(world.joint_names, world.joints, strict=True) for name in names]
    owners: dict[str, Any] = dict(zip(world.force_names, world.forces, strict=True)) | dict(joints)
    of_body = owner in world.names and field in COEFFICIENTS
    if of_body or (owner in owners and field in array_fields(owners[owner])):
        return f"it was left out when the scene was made: give {owner} a {field} to begin with"
    if owner in dict(joints) and field in joint_motion.fields_of(owners[owner]):
        return f"{owner} is part of a closed loop, so that what hangs on it cannot be moved alone: set bodies instead"
    if path == "gravity" and (several := _gravities(world)):
        return f"there are {len(several)}: use {' or '.join(f'{name}.g' for name in several)}"
    return nearest(path, known)


def _gravities(world: World) -> list[str]:
    """Names of the forces that are gravity."""
    return [name for name, force in zip(world.force_names, world.forces, strict=True) if isinstance(force, Gravity)]


def component(path: str) -> tuple[str, int | None]:
    """Path of the whole and index: "ball.v[0]" is ("ball.v", 0), "ball.v" is ("ball.v", None)."""
    if not isinstance(path, str):
        raise ValueError(f"path is {path!r}: expected the name of a parameter, such as 'ball.v'")
    match = re.fullmatch(r"(.+)\[(\d+)\]", path, re.DOTALL)
    return (match[1], int(match[2])) if match else (path, None)


def leaf_of(pair: tuple[World, Any], place: Place) -> Any:
    """The whole leaf of which a place is a part."""
    leaf: Any = pair
    for key in place.chain:
        leaf = leaf[key] if isinstance(key, int) else getattr(leaf, key)
    return leaf
