"""Checks of forces given by users, and the names of forces and joints."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffrigid.convert import numbers
from diffrigid.pytree import map_arrays, refuse_missing, replace, undeclared_fields
from diffrigid.shapes import traced
from diffrigid.spelling import nearest
from diffrigid.state import axis_sizes


def by_name(what: str, records: Any, taken: Iterable[str]) -> dict[str, Any]:
    """Forces or joints (`what`) by name: the given one, or the class in lower case, numbered from the second on."""
    if not isinstance(records, Mapping):
        if isinstance(records, str) or not isinstance(records, Sequence):
            raise ValueError(f"{what} is {records!r}: expected a sequence or a dict of {what}; add brackets")
        kinds = [type(record).__name__.lower() for record in records]
        later = [kinds[:i].count(kind) for i, kind in enumerate(kinds)]
        records = {k + (str(i) if i else ""): r for k, i, r in zip(kinds, later, records, strict=True)}
    for name in records:
        if not isinstance(name, str) or not name or "." in name or name in taken:
            raise ValueError(
                f"{what}: {name!r} is not a name, or is taken: expected a string without dots that no body, force or "
                "joint has; choose another"
            )
    return dict(records)


def force_of(name: str, force: Any, bodies: list[str], dim: int) -> Any:
    """Convert a force: indices for the names of bodies, and arrays with the axes of their fields for numbers."""
    if isinstance(force, type) or not callable(force) or not hasattr(force, "__dataclass_fields__"):
        raise ValueError(f"forces: {name!r} is {force!r}: expected a record such as Drag(linear=0.1)")
    refuse_missing(force, name)
    if undeclared := undeclared_fields(force):
        raise ValueError(
            f"{name}.{undeclared[0]} is not declared: write a force of your own with `array` and `static` of "
            f"diffrigid.pytree, @pytree class {type(force).__name__}: {undeclared[0]}: Leaf = array(); arrays of a "
            "dict or a tuple are a field each"
        )
    if not isinstance(getattr(force, "control", None), str | None):
        raise ValueError(f"{name}.control is {force.control!r}: expected the name of a control, or None")
    if getattr(force, "planar", False) and dim != 2:
        raise ValueError(f"{name} is a {type(force).__name__}, for 2D: in 3D let bodies slide on a HalfSpace")
    changes: dict[str, Any] = {}
    needed = [field.name for field in dataclasses.fields(force) if field.default is dataclasses.MISSING]
    for field in ("body", "a", "b"):
        target = getattr(force, field, None)
        if (field in needed or target is not None) and (not isinstance(target, str) or target not in bodies):
            raise ValueError(
                f"{name}.{field} is {target!r}, which is not a moving body: {nearest(str(target), bodies)}"
            )
        if target is not None:
            changes[field] = bodies.index(target)
    if "a" in changes and changes["a"] == changes.get("b"):
        raise ValueError(f"{name} ties {force.a!r} to itself: expected two bodies, or b=None for the world")
    sizes = {"N": len(bodies)} | axis_sizes(dim)

    def fill(leaf, letters, path):
        axes = tuple(sizes.get(letter) for letter in letters)
        array = numbers(path, leaf, None)
        if array.ndim == 0 and None not in axes:  # a number stands for all components
            array = (jnp if traced(array) else np).broadcast_to(array, axes)
        if path.rpartition(".")[2] in getattr(force, "resist", ()) and not traced(array) and (array < 0).any():
            raise ValueError(f"{path} is {leaf}: expected 0 or above, or the force would drive what it resists")
        return numbers(path, array, None if None in axes else axes)

    return map_arrays(fill, replace(force, **changes), name)
