"""Geoms of MJCF: shapes, and the masses of solids."""

from typing import Any, NamedTuple

import numpy as np

from diffrigid.convert import known
from diffrigid.models.frames import Frame, onto
from diffrigid.models.links import Mass, turned
from diffrigid.models.xml import Reader
from diffrigid.moments import volume_properties
from diffrigid.shapes import Box, Capsule, HalfSpace, Sphere

ALONG_Z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # the x axis of a capsule onto z
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
DENSITY = 1000.0  # [kg/m^3] of MuJoCo


class Made(NamedTuple):
    """A geom: its kind, a shape if it can collide, its pose, volume [m^3] and inertia per mass [m^2]."""

    kind: str
    shape: Any
    frame: Frame
    volume: float = 0.0
    gyration: np.ndarray = np.zeros((3, 3))


def geometry_of(reader: Reader, R: np.ndarray) -> Made:
    """The shape of a geom, turned by R.

    Raises:
        ValueError: a size is missing.
    """
    kind, frame = str(reader.text("type", "sphere")), Frame(reader.numbers("pos", 3, np.zeros(3)), R)
    if kind == "plane":
        reader.text("size")
        return Made(kind, HalfSpace(normal=(0.0, 0.0, 1.0)), frame)
    if kind not in SIZES:
        return Made(kind, None, frame)
    if reader.given("fromto") and kind != "sphere":
        ends = reader.numbers("fromto", 6)
        axis = ends[3:] - ends[:3]
        half, radius = float(0.5 * np.linalg.norm(axis)), float(reader.some("size")[0])
        if half == 0:
            raise ValueError(f"{reader.where}: fromto is {reader.text('fromto')!r}: expected two points")
        frame = Frame(0.5 * (ends[:3] + ends[3:]), onto(axis))
        size = np.array([radius, radius, half] if SIZES[kind] == 3 else [radius, half])
    else:
        size = reader.some("size")[: SIZES[kind]]
    if len(size) < SIZES[kind] or not (size > 0).all():
        raise ValueError(f"{reader.where}: size is {reader.text('size')!r}: expected {SIZES[kind]} numbers above 0")
    return _solid(kind, frame, size)


def _solid(kind: str, frame: Frame, size: np.ndarray) -> Made:
    """Solid with these half sizes; for round ones, radius and half length along z."""
    if kind == "cylinder":
        radius, half = size
        across = radius**2 / 4 + half**2 / 3
        return Made(kind, None, frame, 2 * np.pi * radius**2 * half, np.diag([across, across, radius**2 / 2]))
    if kind == "ellipsoid":
        squares = size**2
        return Made(kind, None, frame, 4 / 3 * np.pi * size.prod(), np.diag(squares.sum() - squares) / 5)
    shape: Any = Sphere(radius=size[0]) if kind == "sphere" else Box(half=size)
    if kind == "capsule":
        shape, frame = Capsule(radius=size[0], half_length=size[1]), Frame(frame.x, frame.R @ ALONG_Z)
    volume, _, gyration = known(lambda shape: volume_properties(shape, 3), shape)
    return Made(kind, shape, frame, float(volume), gyration)


def mass_of(reader: Reader, made: Made) -> Mass | None:
    """Mass of a geom from its mass or density, in the axes of its body."""
    if made.kind not in SIZES:
        if made.kind != "plane" and reader.text("mass") != "0":
            raise ValueError(f"{reader.where} is a {made.kind}, whose mass is not known: give the body an inertial")
        return None
    mass = reader.number("mass") if reader.given("mass") else reader.number("density", DENSITY) * made.volume
    return Mass(mass, made.frame.x, turned(mass * made.gyration, made.frame.R)) if mass > 0 else None
