"""`scene`: from bodies as users write them to `(World, State)`. All values are checked on the way."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from diffrigid.collide import COLLIDERS, pair_groups
from diffrigid.contact import Contact
from diffrigid.contact.crowd import is_many
from diffrigid.convert import (
    angular_velocity,
    mass_and_inertia,
    materials,
    numbers,
    orientation,
    stack,
)
from diffrigid.force_checks import by_name, force_of
from diffrigid.forces import Gravity
from diffrigid.joint_checks import joints_of, warn_of_torn_joints
from diffrigid.overlap import warn_of_overlap
from diffrigid.parts import Part, check_shapes, dimensions, pieces_of, solid_of
from diffrigid.pytree import Number, Vector, map_arrays, refuse_missing
from diffrigid.shape_records import contact_count, looking_around, stack_shapes
from diffrigid.shapes import BOUNDLESS, Shape, traced
from diffrigid.spelling import in_words, nearest
from diffrigid.state import COEFFICIENTS, Bodies, State, rotations
from diffrigid.world import Statics, World

TURNING = {"rolling_friction", "spinning_friction"}
RESERVED = (*COEFFICIENTS, "contact")  # paths, or the first part of one; and "gravity"


@in_words
@dataclass(frozen=True)
class Body:
    """A moving body, and its initial state.

    Args:
        shape: a shape; several by name, {"head": Part(...)}; or None for a body without geometry, which needs `mass`
            and `inertia`.
        mass: [kg]; or density: [kg/m^2] in 2D, [kg/m^3] in 3D. One of the two, unless its parts have masses.
        inertia: [kg m^2] about the centre of mass, body axes: a number in 2D; three principal values or a
            (3, 3) matrix in 3D. Default: that of the shape, uniform.
        center: [m] centre of mass in the axes of its parts; then give inertia. Default: that of the solid, uniform.
        x: [m] centre of mass. v: [m/s]. w: [rad/s], world frame, a number in 2D.
        angle: [rad] (2D), or q: (cos, sin) in 2D, unit quaternion (w, x, y, z) in 3D. Default: unturned.
        restitution, friction and the other coefficients: default: those of the scene.

    Example:
        >>> rod = dr.Body(dr.Box(half=(0.5, 0.0)), mass=3.0, x=(0.0, 0.0))  # thin: no area, so no density
        >>> round(float(dr.scene({"rod": rod})[0].bodies.inertia[0]), 6)  # m l^2 / 12, of its shape
        0.25
    """

    shape: Shape | Mapping[str, Part | Shape] | None
    _: KW_ONLY
    mass: Number | None = None
    density: Number | None = None
    inertia: Number | Vector | None = None
    center: Vector | None = None
    x: Vector | None = None
    v: Vector | None = None
    angle: Number | None = None
    q: Vector | None = None
    w: Number | Vector | None = None
    restitution: Number | None = None
    friction: Number | None = None
    restitution_falloff: Number | None = None
    rolling_friction: Number | None = None
    spinning_friction: Number | None = None


@in_words
@dataclass(frozen=True)
class Static:
    """A shape that does not move, its origin at x [m], turned by angle [rad] (2D) or q.

    Example:
        >>> slope = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)), angle=-0.2, friction=0.5)  # falls to the right
        >>> made, _ = dr.scene({"ball": ball, "slope": slope}, friction=0.1)
        >>> made.statics.friction.tolist()  # of their contact too: the ball has none of its own
        [0.5]
    """

    shape: Shape
    _: KW_ONLY
    x: Vector | None = None
    angle: Number | None = None
    q: Vector | None = None
    restitution: Number | None = None
    friction: Number | None = None
    restitution_falloff: Number | None = None
    rolling_friction: Number | None = None
    spinning_friction: Number | None = None


def scene(
    bodies: Mapping[str, Body | Static],
    *,
    gravity: Vector | None = None,
    restitution: Number = 0.0,
    friction: Number = 0.0,
    restitution_falloff: Number | None = None,
    rolling_friction: Number | None = None,
    spinning_friction: Number | None = None,
    contact: Contact | None = None,
    forces: Sequence[Any] | Mapping[str, Any] = (),
    joints: Sequence[Any] | Mapping[str, Any] = (),
    ignore: Sequence[tuple[str, str]] = (),
) -> tuple[World, State]:
    """Make a world and its initial state from named bodies.

    Args:
        gravity: (D,) [m/s^2]; None: none.
        restitution, friction: [-] of every body and static that does not set its own. A contact takes the
            mean of its two sides, or the one that was set if only one was.
        restitution_falloff: [s/m] c in e = restitution (1 + c u)^(-1/4), u the speed of the impact; None: constant.
        rolling_friction, spinning_friction: [m] largest torque per normal force, against rolling and, in 3D, against
            spinning about the normal; None: none. Mixed as restitution is.
        contact: the contact model; default `Contact()`, exact impacts.
        forces: records from `diffrigid.forces`, in a sequence or by name; a name is what a path to it starts
            with, by default the class in lower case. They name bodies as `bodies` does.
        joints: records from `diffrigid.joints`, in a sequence or by name, as forces are.
        ignore: pairs of names that pass through each other. The two bodies of a joint always do.

    Raises:
        ValueError: names the argument, what was expected, and the fix. Traced values are not checked.

    Warns:
        UserWarning: bodies that overlap at the start, and velocities that do not fit the joints: the motion
            then begins with the impulse that makes them fit.

    Example:
        >>> ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0))
        >>> floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
        >>> world, state = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), restitution=0.8)
        >>> world.names, world.static_names, state.x.shape  # arrays hold what moves
        (('ball',), ('floor',), (1, 2))
    """
    moving, still = _sorted(bodies)
    everything: dict[str, Body | Static] = {**moving, **still}
    dim, n = _dimension(moving, gravity), len(moving)
    named_forces = _forces(forces, gravity, everything, moving, dim)
    joined, linked, joint_names = _joints(joints, named_forces, moving, still, dim)
    passing = _passing([*_listed(ignore), *joined], list(everything))
    pieces = {name: pieces_of(name, body.shape, dim) for name, body in everything.items()}
    pieces |= looking_around(pieces, moving)
    solids = {name: solid_of(name, body, pieces[name], dim) for name, body in moving.items()}
    records, offsets, owners, parts = stack_shapes(pieces, solids, dim)
    kinds = [type(record) for record in records]
    numbers_of_all = restitution, friction, restitution_falloff, rolling_friction, spinning_friction
    material = materials(everything, dict(zip(COEFFICIENTS, numbers_of_all, strict=True)))
    if dim == 2 and "spinning_friction" in material:
        raise ValueError("spinning_friction: in 2D nothing turns about a normal; give rolling_friction")
    crowd = is_many(kinds, owners, n, not (named_forces or linked or passing or parts or {*material} & TURNING))
    pairs: tuple = ()
    if not crowd:
        pairs = pair_groups(kinds, owners, n, passing, COLLIDERS, partial(contact_count, records, dim))
    of_bodies, of_statics = ({k: c[part] for k, (c, _) in material.items()} for part in (slice(n), slice(n, None)))
    mass, inertia = zip(*(mass_and_inertia(k, b, solids[k], dim) for k, b in moving.items()), strict=True)
    made = World(
        bodies=Bodies(mass=stack(mass), inertia=stack(inertia), dim=dim, **of_bodies),
        statics=Statics(**_poses(still, dim), **of_statics),
        shapes=records, offsets=offsets, owners=owners, parts=parts, pairs=pairs, crowd=crowd,
        forces=tuple(named_forces.values()), force_names=tuple(named_forces),
        joints=linked, joint_names=joint_names,
        contact=_contact(Contact() if contact is None else contact),
        names=tuple(moving), static_names=tuple(still), own=tuple((k, own) for k, (_, own) in material.items()),
    )  # fmt: skip
    start = _state(moving, dim)
    warn_of_overlap(made, start)
    if not traced((made, start)):
        warn_of_torn_joints(made, start)
    return jax.tree.map(jax.device_put, (made, start))


# ---- names and dimension


def _sorted(bodies: Mapping[str, Body | Static]) -> tuple[dict[str, Body], dict[str, Static]]:
    """Moving bodies and statics, each in the order given."""
    if not isinstance(bodies, Mapping):
        raise ValueError(f"bodies is {bodies!r}: expected a dict of names, {{'ball': Body(...)}}")
    for name, body in bodies.items():
        if not isinstance(body, Body | Static):
            raise ValueError(f"bodies[{name!r}] is {body!r}: expected a Body or a Static around the shape")
        if not isinstance(name, str) or not name or "." in name or name in (*RESERVED, "gravity"):
            taken = ", ".join((*RESERVED, "gravity"))
            raise ValueError(f"bodies: {name!r} is not a name: expected a string without dots, not {taken}; rename it")
        if isinstance(body, Static) and body.shape is None:
            raise ValueError(f"{name}.shape is None: expected a shape; leave out a Static without one")
        if isinstance(body, Static) and isinstance(body.shape, Mapping):
            raise ValueError(f"{name}.shape has parts: expected one shape; give each part a Static of its own")
        if isinstance(body, Body) and isinstance(body.shape, BOUNDLESS):
            raise ValueError(f"{name}.shape is a {type(body.shape).__name__}, which has no mass: make {name} a Static")
        if isinstance(body, Body) and body.x is None:
            raise ValueError(f"{name}.x is missing: expected the centre of mass, (2,) or (3,) [m]; give x")
        if body.shape is not None:
            check_shapes(name, body.shape)
    moving = {name: body for name, body in bodies.items() if isinstance(body, Body)}
    if not moving:
        raise ValueError(f"bodies has no Body, only {list(bodies)}: expected one that moves; add a Body")
    return moving, {name: body for name, body in bodies.items() if isinstance(body, Static)}


def _listed(ignore: Any) -> list:
    try:
        if not isinstance(ignore, str):
            return list(ignore)
    except TypeError:  # also of an array without axes, which has `__iter__`
        pass
    raise ValueError(f"ignore is {ignore!r}: expected pairs of names, [('arm', 'hand')]")


def _passing(ignore: Any, names: list[str]) -> set[frozenset[int]]:
    """The pairs of `ignore` as sets of two colliders."""
    for pair in ignore:
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(f"ignore has {pair!r}: expected pairs of names, [('arm', 'hand')]; add a bracket")
        for name in pair:
            if not isinstance(name, str) or name not in names:
                raise ValueError(f"ignore names {name!r}, which is not a body: {nearest(name, names)}")
    return {frozenset(names.index(name) for name in pair) for pair in ignore}


def _dimension(moving: Mapping[str, Body], gravity: Any) -> int:
    """2 or 3: the number of components of gravity and every position, and the dimension of every shape."""
    sizes = {} if gravity is None else {"gravity": _length("gravity", gravity)}
    for name, body in moving.items():
        sizes[f"{name}.x"] = _length(f"{name}.x", body.x)
        sizes |= dimensions(name, body.shape)
    if len(set(sizes.values())) > 1:
        raise ValueError(f"a scene is all 2D or all 3D, but got {sizes}: use the same number of components")
    return next(iter(sizes.values()))


def _length(where: str, value: Any) -> int:
    array = numbers(where, value, None)
    if array.shape not in ((2,), (3,)):
        raise ValueError(f"{where} has shape {array.shape}: expected 2 or 3 numbers, one for each axis")
    return len(array)


# ---- the parts of a world


def _poses(bodies: Mapping[str, Body | Static], dim: int) -> dict[str, Any]:
    """Positions and orientations, stacked."""
    x = [numbers(f"{k}.x", np.zeros(dim) if b.x is None else b.x, (dim,)) for k, b in bodies.items()]
    q = [orientation(k, b, dim) for k, b in bodies.items()]
    return {"x": stack(x, (dim,)), "q": stack(q, (rotations(dim).Q,))}


def _state(moving: Mapping[str, Body], dim: int) -> State:
    v = [numbers(f"{k}.v", np.zeros(dim) if b.v is None else b.v, (dim,)) for k, b in moving.items()]
    w = [angular_velocity(k, b.w, dim) for k, b in moving.items()]
    return State(**_poses(moving, dim), v=stack(v), w=stack(w))


def _forces(forces: Any, gravity: Any, colliders: Mapping, moving: Mapping, dim: int) -> dict[str, Any]:
    """All forces by name."""
    made: dict[str, Any] = {} if gravity is None else {"gravity": Gravity(g=numbers("gravity", gravity, (dim,)))}
    for name, force in by_name("forces", forces, (*made, *colliders, *RESERVED)).items():
        made[name] = force_of(name, force, list(moving), dim)
    return made


def _joints(joints: Any, named: Mapping, moving: Mapping, still: Mapping, dim: int):
    """Pairs of names of the colliders that are joined, and the joints of a world with their names."""
    colliders, poses = {**moving, **still}, _poses({**moving, **still}, dim)
    joints = by_name("joints", joints, (*named, *colliders, *RESERVED))
    records, names = joints_of(joints, list(moving), list(still), poses["x"], poses["q"], dim)
    ends = [*colliders, None]
    joined = [(ends[a], ends[b]) for group in records for a, b in zip(group.a, group.b, strict=True)]
    return [(a, b) for a, b in joined if a is not None and b is not None], records, names


def _contact(contact: Any) -> Contact:
    if not isinstance(contact, Contact):
        raise ValueError(f"contact is {contact!r}: expected a Contact(width=0.0)")
    refuse_missing(contact, "contact")

    def check(leaf, letters, path):
        del letters
        array = numbers(path, leaf, ())
        if not traced(array) and array < 0:
            raise ValueError(f"{path} is {float(array):g}: expected 0 or above; 0 turns it off")
        return array

    return map_arrays(check, contact, "contact")
