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
from diffrigid.parts import Piece
from diffrigid.pytree import replace
from diffrigid.shapes import HeightField, Hull, Polygon, traced
from diffrigid.state import rotations
from diffrigid.world import Offset

MOST_CELLS = 256  # to each side: of more, the nodes alone fill gigabytes


def looking_around(pieces: Mapping[str, tuple[Piece, ...]], moving: Iterable[str]) -> dict[str, tuple[Piece, ...]]:
    """Height fields with `cells` filled in: how far to each side the bodies look."""
    found: dict[str, tuple[Piece, ...]] = {}
    for name, of_name in pieces.items():
        shape = of_name[0].shape if of_name else None
        if not isinstance(shape, HeightField):
            continue
        sizes = [known(lambda s: reach(s, 3), piece.shape) for body in moving for piece in pieces[body]]
        parts = [known(cells_for, shape.spacing, size) for size in sizes]
        if shape.cells is None and traced(parts):
            raise ValueError(
                f"{name}.shape.spacing or the size of a body is traced, so how far it looks around cannot be found: "
                "give the HeightField cells=..., above the largest size of a body over the spacing by 1"
            )
        if not traced(parts) and (cells := float(max(parts, default=1))) > MOST_CELLS:
            raise ValueError(
                f"{name}.shape.spacing is {float(shape.spacing):g} m, so that a body reaches over {cells:.3g} cells to "
                f"each side: expected {MOST_CELLS} at most; leave out nodes between others"
            )
        least = None if traced(parts) else int(max(parts, default=1))
        if shape.cells is not None and least is not None and shape.cells < least:
            raise ValueError(f"{name}.shape.cells is {shape.cells}: expected {least} or more, or leave it out")
        if shape.cells is not None and shape.cells > MOST_CELLS:
            raise ValueError(f"{name}.shape.cells is {shape.cells}: expected {MOST_CELLS} at most, or leave it out")
        found[name] = (Piece("", replace(shape, cells=least if shape.cells is None else shape.cells)),)
    return found


def stack_shapes(pieces: Mapping[str, tuple[Piece, ...]], solids: Mapping[str, Solid | None], dim: int):
    """Stack the shapes of each kind (type and static fields) in one record; also their offsets, owners and names.

    A moving collider has its centre of mass, a static one the origin of its shape, at its x.
    """
    groups: dict[Any, list[tuple[int, Piece, Any]]] = {}
    for index, (name, of_name) in enumerate(pieces.items()):
        solid = solids.get(name)
        center = np.zeros(dim, jnp.result_type(float)) if solid is None else solid.center
        for piece in of_name:
            leaves, kind = jax.tree.flatten(piece.shape)
            # Round shapes about their centre of mass, whose impacts are found in closed form, remain among themselves.
            key = kind, tuple(leaf.shape for leaf in leaves), bool(piece.name), piece.q is None
            origin = -center if piece.x is None else piece.x - center
            groups.setdefault(key, []).append((index, piece, origin))
    records, offsets, owners, names = [], [], [], []
    for rows in groups.values():
        owner, same, origins = zip(*rows, strict=True)
        records.append(jax.tree.map(lambda *leaves: stack(leaves), *(piece.shape for piece in same)))
        owners.append(owner)
        names.append(tuple(piece.name for piece in same))
        placed = same[0].name or isinstance(same[0].shape, Polygon | Hull)
        turns = None if same[0].q is None else stack([piece.q for piece in same])
        offsets.append(Offset(r=stack(origins), q=turns) if placed else None)
    parts = tuple(names) if any(map(any, names)) else ()
    return tuple(records), tuple(offsets), tuple(owners), parts


def contact_count(records: Sequence, dim: int, i: int, j: int) -> int:
    """Number of contacts that the pair function of two of the records returns."""
    x, q = np.zeros(dim, jnp.result_type(float)), np.zeros(rotations(dim).Q, jnp.result_type(float))
    a, b = (jax.tree.map(lambda leaf: leaf[0], records[k]) for k in (i, j))
    contacts = jax.eval_shape(COLLIDERS[type(a), type(b)], a, x, q, b, x, q)
    return contacts.gap.shape[0]
