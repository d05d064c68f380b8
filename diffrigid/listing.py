"""A world as text: its parameters by path, with values and units."""

from typing import Any

import numpy as np
from jax import Array

from diffrigid.catalogue import catalogue, leaf_of, unit
from diffrigid.shapes import traced
from diffrigid.world import World, seats

LISTED = 9  # numbers that are listed, and not only their shape: of an inertia


def listing(world: World) -> str:
    """Values and units of all parameters, those of one owner in a line; of many numbers, or traced ones, the shape.

    A coefficient that a body or static was given is marked as its own: beside one that was not, it is that of both.
    """
    names, own_of = world.names + world.static_names, dict(world.own)
    none = (False,) * len(names)
    lines: dict[str, list[str]] = {}
    kinds: dict[str, Any] = dict(zip(world.force_names, world.forces, strict=True)) | {"contact": world.contact}
    for joints, joint in zip(world.joint_names, world.joints, strict=True):
        kinds |= dict.fromkeys(joints, joint)
    of_shapes: dict[str, list[str]] = {}
    for seat in seats(world):
        of_shapes.setdefault(names[seat.owner], []).append(type(world.shapes[seat.group]).__name__)
    for path, (place, *_) in catalogue(world).items():
        owner, _, field = path.partition(".")
        if field and place.chain[0] == 0 and not (place.angle or place.solid):
            value, measure = _shown(leaf_of((world, None), place), place.row), unit(world, path)
            own = "(own)" if owner in names and own_of.get(field, none)[names.index(owner)] else ""
            words = field.removeprefix("shape."), value, measure, own
            lines.setdefault(owner, []).append(" ".join(filter(None, words)))
    of_kind = {owner: [type(record).__name__] for owner, record in kinds.items()} | of_shapes
    kind = {owner: f" ({', '.join(of_kind[owner])})" if owner in of_kind else "" for owner in lines}
    listed = [f"{owner}{kind[owner]}: {', '.join(values)}" for owner, values in lines.items()]
    return "\n".join([f"World, {world.dim}D", *listed])


def _shown(leaf: Any, row: int | None) -> str:
    """A leaf, or a row of it, in a few characters."""
    shape = np.shape(leaf)[row is not None :]
    if not isinstance(leaf, Array | np.ndarray) or traced(leaf) or np.prod(shape) > LISTED:
        return f"of shape {shape}"
    of_row = np.asarray(leaf)[... if row is None else row]
    text = np.array2string(of_row, separator=", ", formatter={"float_kind": "{:.5g}".format})
    return " ".join(text.split())
