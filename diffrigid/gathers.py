"""Pick, sum and pack rows of arrays by indices that are known when tracing.

XLA does not vectorise a gather on a CPU, and runs a scatter, its transpose, row by row: each function here gathers only
where slices and reshapes do not suffice, and the transpose of a gather is a sum of gathered rows in turn.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

FEW, MANY = 12, 40  # terms up to which a sum is unrolled: where there are many such sums, where there are few


def rows(values: Array, index: tuple) -> Array:
    """Gather values[index] along the leading axis, for an index known when tracing: a tuple, or a tuple of tuples.

    The index -1 stands for zeros.
    """
    first = index[0]
    if not isinstance(first, tuple) and first >= 0:
        if index == (first,) * len(index):
            return jnp.broadcast_to(values[first : first + 1], (len(index), *values.shape[1:]))
        if index == tuple(range(first, first + len(index))):
            return values[first : first + len(index)]
    return _pick.bind(values, index=index, axis=0)


def _picked(values: Array, *, index: tuple, axis: int) -> Array:
    """Rows of values along an axis, zeros where the index is -1; a tuple, or a tuple of tuples."""
    table, front = np.array(index), (slice(None),) * axis
    some = np.maximum(table, 0).tolist()
    at = constant(tuple(some if table.ndim == 1 else map(tuple, some)), "int32")
    chosen = values.at[*front, at].get(mode="promise_in_bounds", wrap_negative_indices=False)
    if (table >= 0).all():
        return chosen
    there = constant(index, "int32") >= 0
    return jnp.where(there.reshape(*table.shape, *[1] * (values.ndim - 1 - axis)), chosen, jnp.zeros_like(chosen))


def _shape(values: Any, *, index: tuple, axis: int) -> ShapedArray:
    return ShapedArray((*values.shape[:axis], *np.shape(index), *values.shape[axis + 1 :]), values.dtype)


def _summed_back(cotangent: Array, values: Any, *, index: tuple, axis: int) -> tuple[Array]:
    """Transpose of `_picked`: for each row, the sum over its copies. JAX's own would be a scatter."""
    shape = values.aval.shape
    flat = cotangent.reshape(*shape[:axis], -1, *shape[axis + 1 :])
    return (_sums(flat, _places(index, shape[axis]), axis),)


def _batched(values: tuple[Array], batch: tuple[int], *, index: tuple, axis: int) -> tuple[Array, int]:
    before = batch[0] <= axis
    picked = _pick.bind(values[0], index=index, axis=axis + before)
    return picked, batch[0] if before else batch[0] + np.ndim(index) - 1


_pick = Primitive("pick_rows")
_pick.def_impl(jax.jit(_picked, static_argnames=("index", "axis")))
_pick.def_abstract_eval(_shape)
ad.deflinear2(_pick, _summed_back)
batching.primitive_batchers[_pick] = _batched
mlir.register_lowering(_pick, mlir.lower_fun(_picked, multiple_results=False))


@functools.cache
def _places(index: tuple, count: int) -> tuple[tuple[int, ...], ...]:
    """For each of `count` rows, its places in the flat index, padded by -1."""
    where: list[list[int]] = [[] for _ in range(count)]
    for place, i in enumerate(np.ravel(index).tolist()):
        if i >= 0:
            where[i].append(place)
    most = max(1, *map(len, where))
    return tuple(tuple(places + [-1] * (most - len(places))) for places in where)


def _sums(values: Array, index: tuple[tuple[int, ...], ...], axis: int = 0) -> Array:
    """Sums of rows of values along an axis, one for each row of the index."""
    table = _pick.bind(values, index=index, axis=axis)
    return fold(jnp.add, table, axis + 1) if len(index[0]) <= FEW else table.sum(axis + 1)


def sum_rows(values: Array, index: tuple) -> Array:
    """Sums of rows of values (M, ...), for an index known when tracing, (len(index), ...). An index of M adds 0.

    Where each sum is over a run of rows and one run follows the other, it is unrolled. Otherwise rows are gathered,
    padded to the largest number that any sum has: forward that is one fused loop, where a scatter is a serial one.
    """
    distinct = tuple(dict.fromkeys(index))
    runs = [tuple(i for i in row if i < len(values)) for row in distinct]
    start, length = min(runs[0], default=0), len(runs[0])
    regular = all(len(run) == length for run in runs)
    if length and regular and sum(runs, ()) == tuple(range(start, start + length * len(runs))):
        part = values[start : start + length * len(runs)]
        sums = fold(jnp.add, part.reshape(len(runs), length, *part.shape[1:]), 1)
    else:
        sums = _sums(values, tuple(tuple(-1 if i == len(values) else i for i in row) for row in distinct))
    if distinct == index:
        return sums
    if index == tuple(row for row in distinct for _ in range(len(index) // len(distinct))):
        return jnp.repeat(sums, len(index) // len(distinct), axis=0)
    return rows(sums, tuple(distinct.index(row) for row in index))


def fold(op: Any, table: Array, axis: int) -> Array:
    """Reduce over one axis in front of the batch. Unrolled: XLA's own reduction is slow."""
    return functools.reduce(op, (lax.index_in_dim(table, k, axis, keepdims=False) for k in range(table.shape[axis])))


def first_highest(values: list[Array]) -> list[Array]:
    """Whether each of some values (...) is the first of the highest, (...) bool."""
    highest, chosen = functools.reduce(jnp.maximum, values), []
    left = highest == highest
    for value in values:
        chosen.append(left & (value == highest))
        left = left & (value != highest)
    return chosen


def pack(tree: Any, batch_rank: int) -> tuple[list[Array], Callable[[list[Array]], Any]]:
    """Pack the leaves (M, ..., *batch) of a tree into one array (M, F, *batch) for each shape of the batch.

    Returns:
        the arrays, and the function that makes the tree from such arrays again, whatever their leading length.
    """
    leaves, treedef = jax.tree.flatten(tree)
    batches = [leaf.shape[leaf.ndim - batch_rank :] for leaf in leaves]
    insides = [leaf.shape[1 : leaf.ndim - batch_rank] for leaf in leaves]
    members = [[k for k in range(len(leaves)) if batches[k] == batch] for batch in dict.fromkeys(batches)]

    def column(k: int) -> Array:
        return leaves[k].reshape(leaves[k].shape[0], -1, *batches[k])

    def unpack(columns: list[Array]) -> Any:
        parts: dict[int, Array] = {}
        for whole, group in zip(columns, members, strict=True):
            start = 0
            for k in group:
                stop = start + int(np.prod(insides[k], dtype=int))
                part, start = whole[:, start:stop], stop
                parts[k] = part.reshape(part.shape[0], *insides[k], *part.shape[2:])
        return jax.tree.unflatten(treedef, [parts[k] for k in range(len(leaves))])

    return [jnp.concatenate([column(k) for k in group], axis=1) for group in members], unpack


@functools.cache
def constant(table: tuple, dtype: str) -> np.ndarray:
    """A tuple, or a tuple of tuples, as an array that is made only once.

    A NumPy array made on the spot would be an argument of every loop and branch around it, and among what reverse mode
    saves: a program with many contacts then takes much longer to compile.
    """
    return np.array(table, dtype)


def flags(values: tuple[bool, ...], like: Array) -> Array:
    """Flags known when tracing, as an array with the batch axes of `like`, (C, 1, ...)."""
    return jnp.asarray(constant(values, "bool")).reshape(len(values), *[1] * (like.ndim - 1))
