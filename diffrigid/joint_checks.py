"""From joints as users write them to the records of a `World`: names, values from the initial poses, and checks."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.constraints import joint_rates, placed
from diffrigid.convert import TYPED, known, numbers, positive, stack, unit_quaternion
from diffrigid.joints import JOINTS, Distance, Pose, Prismatic, Revolute, places, separation
from diffrigid.linkage import ends_of, to_sides, twists_of
from diffrigid.numerics import norm
from diffrigid.pytree import array_fields, letters_of, refuse_missing, replace
from diffrigid.shapes import traced
from diffrigid.spelling import nearest
from diffrigid.state import State, rotations

if TYPE_CHECKING:
    from diffrigid.world import World

FROM_START = ("anchor_b", "axis_b", "q", "zero", "length")  # fields that are as at the start if they are left out
SHORT = 4.0  # [1/m] times the arms of a joint: on short ones typed numbers are off by less


def joints_of(
    joints: Mapping[str, Any], moving: Sequence[str], still: Sequence[str], x: Any, q: Any, dim: int
) -> tuple:
    """Put the joints of each kind into one record; return the records, and the names in each.

    Args:
        x, q: poses of all bodies, then all statics.

    Raises:
        ValueError: a joint between two statics, with unknown names, with an axis of no length, or with anchors
            that do not meet at the start.
    """
    colliders = [*moving, *still]
    groups: dict[Any, list[tuple[str, Any]]] = {}
    for name, joint in joints.items():
        if not isinstance(joint, JOINTS):
            known_kinds = ", ".join(kind.__name__ for kind in JOINTS)
            raise ValueError(f"joints: {name!r} is {joint!r}: expected one of {known_kinds}")
        refuse_missing(joint, name)
        for side in ("a", "b"):
            body = getattr(joint, side)
            if side == "a" and body is None:
                raise ValueError(f"{name}.a is None: expected a body; name it first, and None, for the world, second")
            if body is not None and (not isinstance(body, str) or body not in colliders):
                raise ValueError(f"{name}.{side} is {body!r}, which is not a body: {nearest(body, colliders)}")
        if joint.a not in moving and joint.b not in moving:
            raise ValueError(f"{name} joins {joint.a!r} to {joint.b!r}: expected one that moves; name a Body")
        if joint.a == joint.b:
            raise ValueError(f"{name} joins {joint.a!r} to itself: expected two bodies")
        filled = _filled(name, joint, colliders, x, q, dim)
        groups.setdefault(jax.tree.structure(replace(filled, a=None, b=None)), []).append((name, filled))
    records, names = [], []
    for members in groups.values():
        names.append(tuple(name for name, _ in members))
        same = [joint for _, joint in members]
        ends = {side: tuple(getattr(joint, side) for joint in same) for side in ("a", "b")}
        bare = [replace(joint, a=None, b=None) for joint in same]
        records.append(replace(jax.tree.map(lambda *leaves: stack(leaves), *bare), **ends))
    return tuple(records), tuple(names)


def _filled(name: str, joint: Any, colliders: list[str], x: Any, q: Any, dim: int) -> Any:
    """The joint with collider indices for names, the world being the last, and arrays in all its fields."""
    so = rotations(dim)
    ends = {"a": colliders.index(joint.a), "b": len(colliders) if joint.b is None else colliders.index(joint.b)}
    world: Any = Pose(np.zeros(dim, jnp.result_type(float)), np.eye(so.Q, dtype=jnp.result_type(float))[0])  # type: ignore[arg-type]
    a, b = (Pose(x[k], q[k]) if k < len(colliders) else world for k in ends.values())
    fields = array_fields(joint)
    if dim == 2:
        fields = [field for field in fields if field != "axis_a" and not (field == "axis_b" and "axis_a" in fields)]
    elif "axis_a" in fields and joint.axis_a is None:
        raise ValueError(f"{name}.axis_a is missing: expected the axis of the hinge in the axes of {joint.a!r}, (3,)")
    given = _given(name, joint, fields, dim)
    filled = replace(joint, **given, **_from_start(so, fields, given, a, b), **ends)
    error = known(lambda joint, a, b: joint(so, a, b), filled, a, b)
    if not traced(error) and (np.abs(error) > _allowed(filled, so, a, b, joint.b is None, len(error))).any():
        optional = [field.name for field in dataclasses.fields(joint) if field.default is None]
        follow = [field for field in FROM_START if field in optional and field in given]
        raise ValueError(
            f"{name} does not hold at the start: it is off by {np.linalg.norm(error):.3g} (m, rad); move a body, or "
            f"leave out {' and '.join(follow)}, which the start then gives"
        )
    _check_drive(name, filled, so, a, b)
    return filled


def _allowed(joint: Any, so: Any, a: Pose, b: Pose, to_world: bool, rows: int) -> np.ndarray:
    """Errors (E,) [m, rad] that typed numbers, or the rounding of large ones, explain."""
    arms = float(np.linalg.norm(joint.anchor_a) + (0.0 if to_world else np.linalg.norm(joint.anchor_b)))
    metres = {Distance: 1, Prismatic: so.D - 1}.get(type(joint), so.D)
    of_places = max(TYPED * min(1.0, SHORT * arms), _rounding() * float(known(places, joint, a, b)))
    return np.where(np.arange(rows) < metres, of_places, TYPED)


def _rounding() -> float:
    """Rounding of what is computed of several numbers, [-] relative to them."""
    return float(64.0 * jnp.finfo(jnp.result_type(float)).eps)


def _given(name: str, joint: Any, fields: list[str], dim: int) -> dict[str, Any]:
    """Fields that the user gave, as arrays; axes and orientations have length one."""
    shapes = {(): (), ("D",): (dim,), ("Q",): (rotations(dim).Q,)}
    given: dict[str, Any] = {}
    for field in fields:
        if (value := getattr(joint, field)) is None:
            continue
        where, shape = f"{name}.{field}", shapes[letters_of(joint, field)]
        array = numbers(where, value, None)
        array = numbers(where, array * np.ones(shape, array.dtype) if array.ndim == 0 else array, shape)
        if field.startswith("axis"):
            array = _unit(where, array)
        elif field in ("q", "zero"):
            array = unit_quaternion(where, array)
        elif field == "length":
            array = positive(where, array, "for a length of 0 use a Ball")
        given[field] = array
    return given


def _from_start(so: Any, fields: list[str], given: dict[str, Any], a: Pose, b: Pose) -> dict[str, Any]:
    """Fields that were not given, from the initial poses of the bodies."""
    at_start = {
        "anchor_b": lambda a, b, given: so.unrotate(b.q, a.x + so.rotate(a.q, given["anchor_a"]) - b.x),
        "axis_b": lambda a, b, given: so.unrotate(b.q, so.rotate(a.q, given["axis_a"])),
        "q": lambda a, b, given: so.difference(b.q, a.q),
        "zero": lambda a, b, given: so.difference(b.q, a.q),
        "length": lambda a, b, given: norm(separation(Distance(a=None, **given), so, a, b)),
    }
    if so.D == 2 and not {"lower", "upper"} & set(given):  # otherwise the angle of a is counted from that of b
        at_start.pop("zero")
    return {field: known(at_start[field], a, b, given) for field in fields if field in at_start and field not in given}


def _check_drive(name: str, joint: Any, so: Any, a: Pose, b: Pose) -> None:
    """Raise ValueError for impossible limits, friction or damping."""
    given = {f: getattr(joint, f, None) for f in ("lower", "upper", "restitution", "friction", "speed", "damping")}
    number = {f: float(value) for f, value in given.items() if value is not None and not traced(value)}
    lower, upper = number.get("lower", -np.inf), number.get("upper", np.inf)
    if not lower < upper:
        fix = "use a Weld" if lower == upper else "swap them"
        raise ValueError(f"{name}.lower is {lower:g} and upper {upper:g}: expected lower < upper; {fix}")
    if isinstance(joint, Revolute) and 2.0 * np.pi <= upper - lower < np.inf:
        raise ValueError(
            f"{name} has limits from {lower:g} to {upper:g} rad: expected less than a turn; leave them out, or one"
        )
    for field in ("friction", "damping"):
        if number.get(field, 0.0) < 0:
            raise ValueError(f"{name}.{field} is {number[field]:g}: expected 0 or above; 0 turns it off")
    if not 0.0 <= number.get("restitution", 0.0) <= 1.0:
        raise ValueError(f"{name}.restitution is {number['restitution']:g}: expected a number from 0 to 1")
    if "speed" in number and given["friction"] is None:
        raise ValueError(f"{name}.speed needs friction, the most that the motor can do: give friction")
    if "restitution" in number and given["lower"] is None and given["upper"] is None:
        raise ValueError(f"{name}.restitution is that at its limits, and it has none: give lower or upper")
    if {"lower", "upper"} & set(number):
        at: Any = known(lambda joint, a, b: joint.coordinate(so, a, b), joint, a, b)
        if isinstance(joint, Revolute) and not traced(at):
            rest = np.remainder(at + np.pi, 2 * np.pi) - np.pi
            at = np.where(np.abs(rest) < TYPED, 0.0, at)  # an angle is known up to full turns; this one was meant as 0
        if not traced(at) and not lower - TYPED <= at <= upper + TYPED:
            raise ValueError(f"{name} starts at {float(at):g}, outside its limits {lower:g} to {upper:g}: move a body")


def warn_of_torn_joints(world: "World", state: State) -> None:
    """Warn of joints that the initial velocities violate."""
    if not world.joints:
        return

    rates, allowed = known(_speeds, jax.tree.map(jnp.asarray, world), jax.tree.map(jnp.asarray, state))
    names = [name for group in world.joint_names for name in group]
    for name, speed, most in zip(names, rates, allowed, strict=True):
        if speed > most:
            warnings.warn(
                f"{name}: velocities at the start do not fit, the joint comes apart at {speed:.3g} m/s or rad/s; the "
                "motion begins with the impulse that mends it; give the bodies v and w that fit",
                stacklevel=3,
            )


@jax.jit  # else each of its operations is compiled by itself
def _speeds(world: "World", state: State) -> Array:
    """How fast each joint comes apart, and how fast it may by rounding, (2, n) [m/s or rad/s]."""
    so, parts = rotations(world.dim), []
    for group in world.joints:
        at = placed((group,), world.statics, state.x, state.q)
        u = to_sides(ends_of((group,)), twists_of(state))
        rates, far = joint_rates(so, at, u), jax.vmap(places)(*at[0])
        sizes = jnp.sqrt((u[..., : so.D] ** 2).sum((1, 2))) + far * jnp.sqrt((u[..., so.D :] ** 2).sum((1, 2)))
        parts.append(jnp.stack([jnp.sqrt((rates**2).sum(1)), jnp.maximum(_rounding() * sizes, TYPED)]))
    return jnp.concatenate(parts, axis=1)


def _unit(where: str, axis: Any) -> Any:
    if traced(axis):
        return axis
    size = np.linalg.norm(axis)
    if size == 0:
        raise ValueError(f"{where} has no length: expected a direction")
    return axis / size
