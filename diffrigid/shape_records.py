"""From shapes by name to the records of a `World`: one for each kind, the place of each shape on its collider."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffrigid.collide import COLLIDERS
from diffrigid.collide.distance import reach
from diffrigid.collide.heights import cells_for
from diffrigid.convert import Solid, known, stack
from diffrigid.pytree import replace
from diffrigid.shapes import HeightField, Hull, Polygon, traced
from diffrigid.state import rotations
from diffrigid.world import Offset


def looking_around(shapes: Mapping[str, Any], moving: Iterable[str]) -> dict[str, Any]:
    """Height fields with `cells` filled in: how far to each side the bodies look."""
    found = {}
    for name, shape in shapes.items():
        if not isinstance(shape, HeightField):
            continue
        sizes = [known(lambda s: reach(s, 3), shapes[body]) for body in moving if shapes[body] is not None]
        parts = [known(cells_for, shape.spacing, size) for size in sizes]
        if shape.cells is None and traced(parts):
            raise ValueError(
                f"{name}.shape.spacing or the size of a body is traced, so how far it looks around cannot be found: "
                "give the HeightField cells=..., above the largest size of a body over the spacing by 1."
            )
        least = None if traced(parts) else int(max(parts, default=1))
        if shape.cells is not None and least is not None and shape.cells < least:
            raise ValueError(f"{name}.shape.cells is {shape.cells}: expected {least} or more, or leave it out.")
        found[name] = replace(shape, cells=least if shape.cells is None else shape.cells)
    return found


def stack_shapes(shapes: Mapping[str, Any], solids: Mapping[str, Solid | None], dim: int):
    """Stack the shapes of each kind (type and static fields) in one record; also their offsets and owners.

    A moving shape has its centre of mass, a static one its origin, at the x of its collider.
    """
    groups: dict[Any, list[tuple[int, Any, Any]]] = {}
    for index, (name, shape) in enumerate(shapes.items()):
        if shape is not None:
            key = (jax.tree.structure(shape), tuple(leaf.shape for leaf in jax.tree.leaves(shape)))
            solid = solids.get(name)
            origin = np.zeros(dim, jnp.result_type(float)) if solid is None else -solid.center
            groups.setdefault(key, []).append((index, shape, origin))
    records, offsets, owners = [], [], []
    for rows in groups.values():
        owner, same, offset = zip(*rows, strict=True)
        records.append(jax.tree.map(lambda *leaves: stack(leaves), *same))
        owners.append(owner)
        offsets.append(Offset(r=stack(offset)) if isinstance(same[0], Polygon | Hull) else None)
    return tuple(records), tuple(offsets), tuple(owners)


def contact_count(records: Sequence, dim: int, i: int, j: int) -> int:
    """Number of contacts that the pair function of two of the records returns."""
    x, q = np.zeros(dim, jnp.result_type(float)), np.zeros(rotations(dim).Q, jnp.result_type(float))
    a, b = (jax.tree.map(lambda leaf: leaf[0], records[k]) for k in (i, j))
    contacts = jax.eval_shape(COLLIDERS[type(a), type(b)], a, x, q, b, x, q)
    return contacts.gap.shape[0]
