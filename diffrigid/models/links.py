"""Links as in files of robots, and the scene made of them.

A link has a frame of its own; mass, shapes and the joint to its parent are given in it. A `Body` has its origin at its
centre of mass, and the axes of its only shape, or those of the link.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from diffrigid import joints
from diffrigid.contact import Contact
from diffrigid.models.frames import Frame, to_quaternion
from diffrigid.parts import Part
from diffrigid.scene import RESERVED, Body, Static, scene
from diffrigid.shapes import HalfSpace
from diffrigid.state import State
from diffrigid.world import World

CENTRED = 1e-6  # [-] of a shape's size: how far it may be off the centre of mass


@dataclass(frozen=True)
class Mass:
    """Mass [kg], its centre (3,) [m] and the inertia (3, 3) [kg m^2] about that, in the axes of a link."""

    mass: float
    center: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Geometry:
    """A shape on a link; `shape` is None for a kind that does not collide here."""

    name: str
    shape: Any
    frame: Frame
    friction: float = 0.0
    bits: tuple[int, int] = (1, 1)  # two collide if the first of one and the second of the other have one in common


@dataclass(frozen=True)
class Joint:
    """kind: "hinge", "slide", "ball", "weld" or "free"; point and axis in the frame of the link."""

    kind: str
    name: str = ""
    point: np.ndarray = field(default_factory=lambda: np.zeros(3))
    axis: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    lower: float | None = None
    upper: float | None = None
    damping: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True)
class Link:
    """A rigid part: its initial pose, and the link that it is joined to (None: the world)."""

    name: str
    frame: Frame
    parent: str | None
    joint: Joint
    mass: Mass | None
    geometry: tuple[Geometry, ...] = ()
    still: bool = False  # does not move


def total(parts: Sequence[Mass]) -> Mass:
    """Combine several masses into one, by the parallel axis theorem."""
    mass = sum(part.mass for part in parts)
    center = sum((part.mass * part.center for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        r = part.center - center
        inertia += part.inertia + part.mass * (r @ r * np.eye(3) - np.outer(r, r))
    return Mass(mass, center, inertia)


def turned(inertia: np.ndarray, R: np.ndarray) -> np.ndarray:
    """R I R^T, symmetric to rounding."""
    out = R @ inertia @ R.T
    return 0.5 * (out + out.T)


def assemble(
    where: str,
    links: Sequence[Link],
    left_out: Sequence[str],
    apart: Sequence[tuple[str, str]],
    gravity: Any,
    restitution: Any,
    contact: Contact | None,
) -> tuple[World, State]:
    """Make the scene of these links.

    Args:
        where: the file, for messages. left_out: what of it has no counterpart; one warning names all.
        apart: pairs of links that pass through each other.
    """
    skipped = list(left_out)
    bodies: dict[str, Any] = {}
    shapes: dict[str, tuple[str, list[Geometry]]] = {}  # of each collider: its link and its shapes
    frames: dict[str, Frame] = {}
    for link in links:
        if link.still:
            for geometry in link.geometry:
                if geometry.shape is None:
                    continue
                placed = link.frame @ geometry.frame
                bodies[geometry.name] = Static(
                    geometry.shape, x=placed.x, q=to_quaternion(placed.R), friction=geometry.friction
                )
                shapes[geometry.name] = link.name, [geometry]
        else:
            bodies[link.name], frames[link.name], chosen = _body(where, link, skipped)
            shapes[link.name] = link.name, chosen
    made: dict[str, Any] = {}
    for link in links:
        if not link.still and link.joint.kind != "free":
            name = free_name(link.joint.name or f"{link.name}_joint", {*bodies, *made}, "_joint")
            made[name] = _joint(link, frames, skipped)
    if skipped:
        # At the call of `load_mjcf` or `load_urdf`, which `np.errstate` wraps.
        warnings.warn(f"{where}: left out: {'; '.join(dict.fromkeys(skipped))}", stacklevel=4)
    return scene(
        bodies, gravity=gravity, restitution=restitution, contact=contact, joints=made,
        ignore=_ignored(shapes, set(map(frozenset, apart))),
    )  # fmt: skip


def free_name(name: str, taken: Any, suffix: str) -> str:
    """A name that `scene` accepts: no dots, not reserved, not taken."""
    name = name.replace(".", "_") or suffix.strip("_")
    while name in taken or name in (*RESERVED, "gravity"):
        name += suffix
    return name


def _body(where: str, link: Link, skipped: list[str]) -> tuple[Body, Frame, list[Geometry]]:
    """Make a body of a moving link; return its axes in the world, and the shapes that it collides with, too."""
    if link.mass is None or not link.mass.mass > 0:
        raise ValueError(f"{where}: {link.name!r} moves and has no mass: give it an inertial, or fix it")
    mass, chosen = link.mass, []
    for geometry in link.geometry:
        if isinstance(geometry.shape, HalfSpace):
            skipped.append(f"{geometry.name}, a plane that moves")
        elif geometry.shape is not None and any(geometry.bits):
            chosen.append(geometry)
    if len({geometry.friction for geometry in chosen}) > 1:
        skipped.append(f"the friction of all shapes of {link.name} but {chosen[0].name}")
    R, shape, center = np.eye(3), None, None
    if len(chosen) == 1 and _is_centred(chosen[0], mass):
        R, shape = chosen[0].frame.R, chosen[0].shape
    elif chosen:
        shape, center = _parts(chosen), mass.center
    axes = link.frame @ Frame(mass.center, R)
    body = Body(
        shape, mass=mass.mass, inertia=turned(mass.inertia, R.T), center=center, x=axes.x, q=to_quaternion(axes.R),
        friction=chosen[0].friction if chosen else None,
    )  # fmt: skip
    return body, axes, chosen


def _is_centred(geometry: Geometry, mass: Mass) -> bool:
    """Whether the origin of a shape is the centre of mass."""
    size = max(float(np.linalg.norm(geometry.frame.x)), float(np.sqrt(np.trace(mass.inertia) / mass.mass)))
    return float(np.linalg.norm(geometry.frame.x - mass.center)) <= CENTRED * size


def _parts(chosen: Sequence[Geometry]) -> dict[str, Part]:
    """The shapes of a link by name, in the axes of the link."""
    parts: dict[str, Part] = {}
    for geometry in chosen:
        name = geometry.name.replace(".", "_")
        while not name or name in parts:
            name += "_shape"
        q = None if np.array_equal(geometry.frame.R, np.eye(3)) else to_quaternion(geometry.frame.R)
        parts[name] = Part(geometry.shape, x=geometry.frame.x, q=q)
    return parts


def _joint(link: Link, frames: dict[str, Frame], skipped: list[str]) -> Any:
    """Make the joint of a link to its parent, or to the world where the parent does not move."""
    joint, axes = link.joint, frames[link.name]
    parent = link.parent if link.parent in frames else None
    point, axis = link.frame.x + link.frame.R @ joint.point, link.frame.R @ joint.axis
    ends: dict[str, Any] = {"a": link.name, "b": parent, "anchor_a": axes.R.T @ (point - axes.x)}
    if joint.kind in ("ball", "weld"):
        return (joints.Ball if joint.kind == "ball" else joints.Weld)(**ends)
    drive: dict[str, Any] = {name: value for name in ("damping", "friction") if (value := getattr(joint, name)) > 0}
    limits = {side: value for side in ("lower", "upper") if (value := getattr(joint, side)) is not None}
    if joint.kind == "hinge" and limits and not _are_told_apart(**limits):
        texts = " and ".join(f"{side} limit {value:g} rad" for side, value in limits.items())
        skipped.append(f"{texts} of {joint.name or link.name}, which is known up to full turns")
    else:
        drive |= limits
    if joint.kind == "hinge":
        return joints.Revolute(**ends, **drive, axis_a=axes.R.T @ axis)
    return joints.Prismatic(**ends, **drive, axis_b=axis if parent is None else frames[parent].R.T @ axis)


def _are_told_apart(lower: float | None = None, upper: float | None = None) -> bool:
    """Whether limits suit an angle known up to full turns: less than a turn, and about a middle within pi of 0."""
    spans = np.inf if lower is None or upper is None else upper - lower
    return abs(joints.middle_of(lower, upper)) < np.pi and not 2 * np.pi <= spans < np.inf


def _ignored(shapes: dict[str, tuple[str, list[Geometry]]], apart: set[frozenset[str]]) -> list[tuple[str, str]]:
    """Pairs of colliders that pass through each other."""
    names, out = list(shapes), []
    for i, first in enumerate(names):
        for second in names[:i]:
            (link_a, a), (link_b, b) = shapes[first], shapes[second]
            meet = any(one.bits[0] & two.bits[1] or two.bits[0] & one.bits[1] for one in a for two in b)
            if not meet or frozenset((link_a, link_b)) in apart:
                out.append((first, second))
    return out
