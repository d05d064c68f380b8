"""Bodies made of several shapes: each of them at its place, and all together as one solid."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, NamedTuple

import jax

from diffrigid.convert import Numbers, Solid, known, numbers, orientation, positive, shape_of
from diffrigid.moments import assembly_properties, volume_properties
from diffrigid.pytree import Number, Vector
from diffrigid.shape_checks import check_shape
from diffrigid.shapes import BOUNDLESS, Shape, dimension, traced
from diffrigid.spelling import in_words


@in_words
@dataclass(frozen=True)
class Part:
    """One of several shapes of a body, at its place.

    Args:
        x: [m] the origin of the shape, in axes of the body, from any point that all parts share. Default: that point.
        angle: [rad] (2D), or q: (cos, sin) in 2D, unit quaternion (w, x, y, z) in 3D, from axes of the shape to axes
            of the body. Default: unturned.
        mass: [kg] where parts differ in density: then give it to every part, and none to the body.

    Example:
        >>> head = dr.Part(dr.Box(half=(0.02, 0.05)), x=(0.15, 0.0), mass=0.4)
        >>> handle = dr.Part(dr.Box(half=(0.15, 0.01)), mass=0.1)
        >>> hammer = dr.Body({"handle": handle, "head": head}, x=(0.0, 1.0))
        >>> made, start = dr.scene({"hammer": hammer})
        >>> round(float(dr.paths.read(made, start, "hammer.shape.head.x")[0]), 4)  # from the centre of mass
        0.03
    """

    shape: Shape
    _: KW_ONLY
    x: Vector | None = None
    angle: Number | None = None
    q: Vector | None = None
    mass: Number | None = None


class Piece(NamedTuple):
    """A shape on its collider."""

    name: str  # of the part; "" of the only shape
    shape: Any
    x: Numbers | None = None  # (D,) [m] None: at the origin
    q: Numbers | None = None  # (Q,) None: unturned
    mass: Numbers | None = None  # [kg]


def check_shapes(name: str, shape: Any) -> None:
    """Raise ValueError if a body, or a static, cannot have this shape or these parts."""
    several = isinstance(shape, Mapping)
    if isinstance(shape, Part):
        raise ValueError(f"{name}.shape is a Part: expected a shape, or parts by name, {{'head': Part(...)}}")
    if several and not shape:
        raise ValueError(f"{name}.shape is empty: expected parts by name, {{'head': Part(...)}}, or None")
    for key in shape if several else ():
        if not isinstance(key, str) or not key or "." in key:
            raise ValueError(f"{name}.shape: {key!r} is not a name: expected a string without dots; rename the part")
    for path, part in _by_path(name, shape).items():
        check_shape(part.shape, path)
        if several and isinstance(part.shape, BOUNDLESS):
            kind = type(part.shape).__name__
            raise ValueError(f"{path} is a {kind}, which has no mass: make it a Static of its own")


def _by_path(name: str, shape: Any) -> dict[str, Part]:
    """The parts of a body, or its only shape as one, by their paths."""
    if not isinstance(shape, Mapping):
        return {} if shape is None else {f"{name}.shape": Part(shape)}
    parts = {key: part if isinstance(part, Part) else Part(part) for key, part in shape.items()}
    return {f"{name}.shape.{key}": part for key, part in parts.items()}


def dimensions(name: str, shape: Any) -> dict[str, int]:
    """Dimensions of those shapes of a body that have one, by their paths."""
    return {path: size for path, part in _by_path(name, shape).items() if (size := dimension(part.shape))}


def pieces_of(name: str, shape: Any, dim: int) -> tuple[Piece, ...]:
    """The shapes of a collider, none for None."""
    parts = _by_path(name, shape)
    if not isinstance(shape, Mapping):
        return tuple(Piece("", shape_of(path, part.shape, dim)) for path, part in parts.items())
    return tuple(_piece(path, key, part, dim) for key, (path, part) in zip(shape, parts.items(), strict=True))


def _piece(where: str, key: str, part: Part, dim: int) -> Piece:
    turned = part.angle is not None or part.q is not None
    return Piece(
        name=key,
        shape=shape_of(where, part.shape, dim),
        x=numbers(f"{where}.x", [0.0] * dim if part.x is None else part.x, (dim,)),
        q=orientation(where, part, dim) if turned else None,
        mass=None if part.mass is None else positive(f"{where}.mass", part.mass, "leave out what weighs nothing"),
    )


def solid_of(name: str, body: Any, pieces: Sequence[Piece], dim: int) -> Solid | None:
    """The solid that the pieces of a body make together; None for none. Where two of them overlap, both count."""
    if body.center is not None:
        if not pieces or not pieces[0].name or body.inertia is None:
            raise ValueError(
                f"{name}.center: expected parts, in whose axes it is, and an inertia about it: give "
                "shape={'ball': Part(...)} and inertia, or leave center out"
            )
        center = numbers(f"{name}.center", body.center, (dim,))
        return _solid(name, pieces, dim)._replace(center=center)
    if not pieces:
        return None
    solid = _solid(name, pieces, dim)
    if pieces[0].name and solid.mass is None and not traced(solid.volume) and not solid.volume > 0:
        raise ValueError(f"{name}.shape: its parts have no volume to share the mass by: give each part a mass")
    return solid


def _solid(name: str, pieces: Sequence[Piece], dim: int) -> Solid:
    if not pieces[0].name:
        volume, center, gyration = known(partial(_volume_properties, dim=dim), pieces[0].shape)
        return Solid(volume, center, gyration)
    given = [piece.mass for piece in pieces if piece.mass is not None]
    if given and len(given) < len(pieces):
        none = next(piece.name for piece in pieces if piece.mass is None)
        raise ValueError(f"{name}.shape.{none} has no mass, but other parts have: give one to all parts, or to none")
    shapes, x, q = zip(*((piece.shape, piece.x, piece.q) for piece in pieces), strict=True)
    masses = given or None
    volume, center, gyration = known(partial(_assembly_properties, dim=dim), shapes, x, q, masses)
    return Solid(volume, center, gyration, mass=sum(masses) if masses else None)


# One program each, in place of some dozen.
_volume_properties = jax.jit(volume_properties, static_argnames="dim")
_assembly_properties = jax.jit(assembly_properties, static_argnames="dim")
