"""Records: frozen, keyword-only dataclasses that JAX sees as pytrees.

A field is declared by what it holds:

    x: Array = array("N", "D")        # a float leaf, with the letters of its axes for ONE world
    names: tuple = static()           # compiled in: hashable, never differentiated
    bodies: Bodies                    # another record, or a tuple or dict of records

The letters serve twice. `world.check` compares them with what came, so that a wrong shape is reported by
name; and because they fix the rank of a leaf without a batch, any further trailing axes are known to be batch
axes (`batch_rank`, `align`). Records hold data; behaviour is functions.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

from diffrigid.spelling import in_words

replace = dataclasses.replace

Leaf = Any  # a field that a user fills with a number or a tuple, and `scene` with an array
Number = float | jax.Array
Vector = Sequence[float] | np.ndarray | jax.Array
Record = TypeVar("Record")


def array(*letters: Any, default: Any = dataclasses.MISSING, kw_only: bool = True) -> Any:
    """Field for a float array whose axes, for one world, are named by `letters` (none: a number)."""
    return dataclasses.field(default=default, metadata={"letters": letters}, kw_only=kw_only)


def static(default: Any = dataclasses.MISSING, kw_only: bool = True) -> Any:
    """Field for compiled-in data: integers, strings, tuples of them. Must hash and compare."""
    return dataclasses.field(default=default, metadata={"static": True}, kw_only=kw_only)


def stacked(letter: str) -> Any:
    """Field for records of which every array has one more leading axis, named by `letter`."""
    return dataclasses.field(metadata={"stacked": (letter,)}, kw_only=True)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(array, static, stacked))
def pytree(cls: type[Record]) -> type[Record]:
    """Make `cls` a frozen, keyword-only dataclass and register it with JAX.

    The name of the class is a static field: JAX treats records of different classes with equal fields as equal, and
    `jit` may then run the program compiled for the other.

    Two records are equal if all their fields and numbers are. As arrays, they do not hash.
    """
    made: Any = cls
    made.__eq__, made.__hash__ = _equal, None
    made.__annotations__ = {**cls.__annotations__, "_class": str}
    made._class = dataclasses.field(default=cls.__qualname__, repr=False, kw_only=True, metadata={"static": True})
    made = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(made)
    fields = dataclasses.fields(in_words(made))
    meta = [f.name for f in fields if f.metadata.get("static")]
    data = [f.name for f in fields if f.name not in meta]
    return jax.tree_util.register_dataclass(made, data_fields=data, meta_fields=meta)


def _equal(record: Any, other: Any) -> bool:
    tree: Any = jax.tree.structure(record)
    if type(record) is not type(other) or tree != jax.tree.structure(other):
        return False
    leaves = jax.tree.leaves(record), jax.tree.leaves(other)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in (*leaves[0], *leaves[1])):
        raise TypeError("==: the numbers of a record are not known while JAX traces; compare the arrays themselves")
    return all(map(np.array_equal, *leaves))


def map_arrays(fn: Callable, node: Any, where: str = "", stack: tuple[str, ...] = ()) -> Any:
    """Apply `fn(leaf, letters, path)` to every declared array of a record, tuple or dict of records."""
    if node is None:
        return None
    if isinstance(node, tuple):
        return tuple(map_arrays(fn, child, f"{where}[{i}]", stack) for i, child in enumerate(node))
    if isinstance(node, dict):
        return {key: map_arrays(fn, child, f"{where}[{key!r}]", stack) for key, child in node.items()}
    changed = {}
    for field in dataclasses.fields(node):
        if field.metadata.get("static"):
            continue
        value, path = getattr(node, field.name), f"{where}.{field.name}"
        if "letters" not in field.metadata:
            changed[field.name] = map_arrays(fn, value, path, stack + field.metadata.get("stacked", ()))
        elif value is not None:
            changed[field.name] = fn(value, stack + letters_of(node, field.name), path)
    return replace(node, **changed)


def batch_rank(node: Any) -> int:
    """Number of trailing batch axes: the largest surplus of a leaf over its declared letters."""
    surplus = [0]
    map_arrays(lambda leaf, letters, _: surplus.append(jax.numpy.ndim(leaf) - len(letters)), node)
    return max(surplus)


def align(node: Any, rank: int) -> Any:
    """Give every array `rank` trailing batch axes, of length one where it has none, so that all broadcast."""

    def expand(leaf: jax.Array, letters: tuple, _: str) -> jax.Array:
        missing = len(letters) + rank - jax.numpy.ndim(leaf)
        return leaf.reshape(leaf.shape + (1,) * missing) if missing else leaf

    return map_arrays(expand, node)


def align_all(*nodes: Any) -> list:
    """Give the arrays of several records the number of batch axes that the largest of them has."""
    rank = max(map(batch_rank, nodes))
    return [align(node, rank) for node in nodes]


def refuse_missing(record: Any, where: str) -> None:
    """Raise ValueError for a float leaf that is None, unless None is its default."""
    for field in dataclasses.fields(record):
        if "letters" in field.metadata and field.default is not None and getattr(record, field.name) is None:
            raise ValueError(f"{where}.{field.name} is None: expected numbers")


def undeclared_fields(record: Any) -> list[str]:
    """Names of the fields that are not said to be arrays or static, and hold no records."""
    plain = (f.name for f in dataclasses.fields(record) if not {"letters", "static", "stacked"} & set(f.metadata))
    return [name for name in plain if not _holds_records(getattr(record, name))]


def _holds_records(value: Any) -> bool:
    if isinstance(value, tuple | dict):
        return all(map(_holds_records, value.values() if isinstance(value, dict) else value))
    return value is None or dataclasses.is_dataclass(value)


def array_fields(record: Any) -> list[str]:
    """Names of the float leaves of a record."""
    return [field.name for field in dataclasses.fields(record) if "letters" in field.metadata]


def letters_of(record: Any, name: str) -> tuple:
    """Letters of the axes of a float leaf, for one world. They may depend on the dimension, a static field."""
    letters = next(field.metadata["letters"] for field in dataclasses.fields(record) if field.name == name)
    return letters[0](record) if letters and callable(letters[0]) else letters
