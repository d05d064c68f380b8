"""Gradient-safe arithmetic, and arithmetic that XLA makes fast programs of on a CPU.

The pattern for gradients is the two-sided `where`: the argument is made harmless *before* the singular operation,
because reverse mode multiplies the derivative of the branch not taken by zero, and 0 * inf is NaN.

Vectors carry their components on the leading axis, `(D, *batch)`.

Functions called in many places are jitted, here and elsewhere, so that JAX traces, differentiates and transposes them
once; XLA inlines them. Tracing a gradient takes a quarter less time.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

TINY = 6  # rows of a matrix, up to which its elimination is written out
SMALL = 9  # rows of a matrix, up to which all of a batch at once are faster than a library that takes one by one
FEW, MANY = 12, 40  # terms of a sum that is written out: where there are many such sums, where there are few
FOUND = "found"  # name of what searches and iterations arrive at: reverse mode saves it, and nothing else of a pass


@jax.jit
def dot(a: Array, b: Array) -> Array:
    """Inner product over the leading axis, (D, *batch), (D, *batch) -> (*batch)."""
    return _dot(a, b)


@jax.custom_jvp
def _dot(a: Array, b: Array) -> Array:
    # Component by component: XLA does not vectorise a loop with a reduction of length 2 or 3 inside.
    total = a[0] * b[0]
    for i in range(1, a.shape[0]):
        total = total + a[i] * b[i]
    return total


@_dot.defjvp
def _dot_jvp(primals, tangents):
    # As a reduction, whose transpose is a broadcast; that of picking a component is a padded sum.
    (a, b), (da, db) = primals, tangents
    return _dot(a, b), (a * db + da * b).sum(0)


def unit_vector(like: Array, axis: int) -> Array:
    """The constant unit vector along an axis, (D, *batch) like `like`. Not `.at[].set`, which is a scatter."""
    return (lax.broadcasted_iota(np.int32, like.shape, 0) == axis % like.shape[0]).astype(like.dtype)


@jax.jit
def components(*parts: Array) -> Array:
    """Numbers (*batch) as the components of a vector, (D, *batch).

    By `lax.select` and not `jnp.stack`: on a CPU XLA does not vectorise loops that concatenate, and a cross product
    took ten times as long.
    """
    alike = parts if all(part.shape == parts[0].shape for part in parts) else jnp.broadcast_arrays(*parts)
    shape, across = (len(parts), *alike[0].shape), tuple(range(1, alike[0].ndim + 1))
    index = lax.broadcasted_iota(np.int32, shape, 0)
    whole = [lax.broadcast_in_dim(part, shape, across) for part in alike]
    vector = whole[-1]
    for k in range(len(parts) - 2, -1, -1):
        vector = lax.select(lax.eq(index, lax.full_like(index, k)), whole[k], vector)
    return vector


def rows(values: Array, index: tuple) -> Array:
    """values[index] along the leading axis, for an index known when tracing: a tuple, or a tuple of tuples.

    A NumPy array made on the spot would be an argument of every loop and branch around it, and one of what
    reverse mode saves: a program of some hundred contacts took three times as long to compile. This one is
    made once.
    """
    first, flat = index[0], not isinstance(index[0], tuple)
    if flat and index == (first,) * len(index):
        return jnp.broadcast_to(values[first : first + 1], (len(index), *values.shape[1:]))
    if flat and index == tuple(range(first, first + len(index))):
        return values[first : first + len(index)]
    return values.at[constant(index, "int32")].get(mode="promise_in_bounds", wrap_negative_indices=False)


def sum_rows(values: Array, index: tuple) -> Array:
    """Sums of rows of values (M, ...), for an index known when tracing, (len(index), ...); M stands for nothing.

    Where each sum is over a run of rows and one run follows the other, it is written out. Else rows are gathered,
    padded to the most that any sum has: forward that is one fused loop, where a scatter is a serial one.
    """
    distinct = tuple(dict.fromkeys(index))
    runs = [tuple(i for i in row if i < len(values)) for row in distinct]
    start, length = min(runs[0], default=0), len(runs[0])
    regular = all(len(run) == length for run in runs)
    if length and regular and sum(runs, ()) == tuple(range(start, start + length * len(runs))):
        part = values[start : start + length * len(runs)]
        sums = fold(jnp.add, part.reshape(len(runs), length, *part.shape[1:]), 1)
    else:
        table = rows(jnp.concatenate([values, jnp.zeros_like(values[:1])]), distinct)
        sums = fold(jnp.add, table, 1) if len(distinct[0]) <= FEW else table.sum(1)
    if distinct == index:
        return sums
    if index == tuple(row for row in distinct for _ in range(len(index) // len(distinct))):
        return jnp.repeat(sums, len(index) // len(distinct), axis=0)
    return rows(sums, tuple(distinct.index(row) for row in index))


def fold(op: Any, table: Array, axis: int) -> Array:
    """Reduction over one axis in front of the batch. Written out: XLA's own is slow."""
    return functools.reduce(op, (lax.index_in_dim(table, k, axis, keepdims=False) for k in range(table.shape[axis])))


def rows_or_zeros(values: Array, index: tuple) -> Array:
    """`rows`, where the index -1 stands for zeros."""
    table = np.array(index)
    if (table >= 0).all():
        return rows(values, index)
    some = np.maximum(table, 0).tolist()
    chosen = rows(values, tuple(some if table.ndim == 1 else map(tuple, some)))
    there = (constant(index, "int32") >= 0).reshape(*table.shape, *[1] * (chosen.ndim - table.ndim))
    return jnp.where(there, chosen, 0.0)


def pack(tree: Any, batch_rank: int) -> tuple[list[Array], Callable[[list[Array]], Any]]:
    """The leaves (M, ..., *batch) of a tree side by side, as one array (M, F, *batch) for each shape of the batch.

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


@jax.custom_batching.custom_vmap
def any_world(flags: Array) -> Array:
    """Whether any flag is set, in any of the worlds, a bool: what branches and loops depend on.

    Of all the worlds under `jax.vmap` as well, which else makes of every branch a choice between two results that are
    both computed: sixteen discs ran 600 times slower.
    """
    return jnp.any(flags)


@any_world.def_vmap
def _of_all_worlds(size: int, batched: list[bool], flags: Array) -> tuple[Array, bool]:
    del size, batched
    return any_world(flags), False


def opaque_true(like: Array) -> Array:
    """True, in a form that the compiler cannot know; see `unfused`. `like`: any array of the program, not infinite."""
    return any_world(~(jnp.ravel(like)[:1] > jnp.inf))


def unfused(live: Array, fn: Callable, *args: Any) -> Any:
    """fn(*args), computed by itself: XLA does not fuse across a branch.

    Where several results depend on one, XLA on a CPU computes it again inside each of them, and again for each
    component that is picked from it: in a chain of products of vectors this grows exponentially. An
    `optimization_barrier` is removed before fusion. So this is a choice that is always the same.

    Args:
        live: `opaque_true` of something.
    """

    def never(*args):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(once, *args))

    once = jax.jit(fn)  # traced once for both
    return lax.cond(live, once, never, *args)


@functools.cache
def constant(table: tuple, dtype: str) -> np.ndarray:
    """A tuple, or a tuple of tuples, as an array that is made once; see `rows`."""
    return np.array(table, dtype)


@jax.custom_jvp
def with_tangents(tree: Any, by: Any) -> Any:
    """`tree` itself, all of whose leaves have a tangent as soon as one of its own or of `by` has.

    Forward mode traces the body of a loop again until it knows which parts of what is carried have a tangent. So
    that each has one from the beginning: the gradient of three colliding discs is traced in 5.1 CPU-s instead of 6.2.
    """
    del by
    return tree


@with_tangents.defjvp
def _with_tangents_jvp(primals, tangents):
    return primals[0], tangents[0]


def _least(like: Array) -> float:
    """Numbers below it have lost digits, and may or may not be taken as zero: then 0 * inf is NaN, as at zero."""
    return float(jnp.finfo(like.dtype).tiny)


@jax.jit
def safe_sqrt(x: Array) -> Array:
    """Square root, 0 with zero derivative for x <= 0 (the derivative of sqrt at 0 is infinite), or next to it."""
    positive = x >= _least(x)
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def cos_sin(phi: Array) -> tuple[Array, Array]:
    """Cosine and sine, to rounding for |phi| up to some thousand turns.

    XLA calls the scalar library for them on a CPU, which was a third of the time of a step of a bouncing disc.
    Reduction to |r| <= pi / 4 in three parts of pi / 2 (Cody & Waite 1980), then Taylor's series, which there
    is below rounding after eight terms (single precision: four).
    """
    parts = _HALF_PI[jnp.finfo(phi.dtype).bits]
    turns = jnp.round(lax.stop_gradient(phi) * (2.0 / np.pi))
    r = phi
    for part in parts:
        r = r - turns * part
    square = r * r
    cosine, sine = jnp.ones_like(r), jnp.ones_like(r)
    for k in range(4 if phi.dtype == jnp.float32 else 8, 0, -1):
        cosine = 1.0 - square * (cosine * (1.0 / ((2 * k - 1) * (2 * k))))
        sine = 1.0 - square * (sine * (1.0 / ((2 * k) * (2 * k + 1))))
    sine = r * sine
    quarter = turns - 4.0 * jnp.floor(turns / 4.0)  # 0, 1, 2, 3
    odd = (quarter == 1) | (quarter == 3)
    c, s = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    return jnp.where((quarter == 1) | (quarter == 2), -c, c), jnp.where(quarter >= 2, -s, s)


# pi / 2 as a sum whose first parts have trailing zeros, so that their products with small integers are exact
_HALF_PI = {
    32: (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8),
    64: (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
}


@jax.jit
def safe_divide(a: Array, b: Array) -> Array:
    """a / b, and 0 with zero derivative where b == 0 (0 / 0 in both modes), or next to it."""
    nonzero = jnp.abs(b) >= _least(b)
    return jnp.where(nonzero, a / jnp.where(nonzero, b, 1.0), 0.0)


@jax.jit
def norm(a: Array) -> Array:
    """Euclidean length over the leading axis, with zero derivative at the zero vector."""
    return safe_sqrt(dot(a, a))


@jax.jit
def normalise(a: Array, fallback: Array | None = None) -> Array:
    """Unit vector along `a`; `fallback` (default: the zero vector) where |a|^2 is 0, with zero derivative."""
    square = dot(a, a)
    nonzero = square >= _least(square)
    unit = a / jnp.sqrt(jnp.where(nonzero, square, 1.0))[None]
    return jnp.where(nonzero[None], unit, jnp.zeros_like(a) if fallback is None else fallback)


def solve_regular(matrix: Array, right: Array) -> Array:
    """x of matrix x = right, for regular matrices, (R, R, *batch), (R, *batch) -> (R, *batch).

    Linear in `right`, also for transposition; without derivative by the matrix. Finite where a matrix is singular,
    but no solution.
    """
    matrix = lax.stop_gradient(matrix)

    def by(matrix: Array) -> Callable[[Any, Array], Array]:
        return lambda _, u: _eliminated(matrix, u)

    back = by(jnp.swapaxes(matrix, 0, 1))
    return lax.custom_linear_solve(functools.partial(matvec, matrix), right, by(matrix), transpose_solve=back)


def _eliminated(matrix: Array, right: Array) -> Array:
    system = jnp.concatenate([matrix, right[:, None]], axis=1)
    if len(matrix) <= TINY:
        return _written_out(system)
    if len(matrix) <= SMALL:
        return _gauss_jordan(system)
    # What elimination makes of the right side beside the matrix needs no permutation.
    upper, reduced = jnp.split(lax.linalg.lu(jnp.moveaxis(system, (0, 1), (-2, -1)))[0], [len(matrix)], axis=-1)
    x = lax.linalg.triangular_solve(upper, reduced, left_side=True)[..., 0]
    return jnp.moveaxis(jnp.where(jnp.isfinite(x), x, 0.0), -1, 0)


def matvec(matrix: Array, u: Array) -> Array:
    """(R, R, *batch) times (R, *batch)."""
    parts = matrix * u[None]
    return fold(jnp.add, parts, 1) if len(u) <= MANY else parts.sum(1)


def identity(like: Array) -> Array:
    """Unit matrices, (R, R, *batch)."""
    size, batch = like.shape[0], like.shape[2:]
    return jnp.eye(size, dtype=like.dtype).reshape(size, size, *[1] * len(batch)) + jnp.zeros_like(like)


def _written_out(system: Array) -> Array:
    """x of a matrix beside its right side, (R, R + 1, *batch) -> (R, *batch), without a choice of pivots.

    No choice is needed where the matrix is the product of a block-diagonal one and one with a positive definite
    symmetric part, as that of a body is but for strong friction. A direction whose pivot is 0 is left out.
    """
    eliminated = []
    while len(system):
        pivot = system[0, 0]
        eliminated.append(system[0, 1:] * safe_divide(jnp.ones_like(pivot), pivot)[None])
        system = system[1:, 1:] - system[1:, :1] * eliminated[-1][None]
    x: list[Array] = []
    for row in reversed(eliminated):
        x.insert(0, functools.reduce(jnp.subtract, [a * b for a, b in zip(row[:-1], x, strict=True)], row[-1]))
    return jnp.stack(x)


def _gauss_jordan(system: Array) -> Array:
    """x of a matrix beside its right side, (R, R + 1, *batch) -> (R, *batch).

    Pivots are chosen by column in each matrix of the batch; rows stay where they are. A direction whose pivot is 0 is
    left out.
    """
    count = system.shape[0]
    index = lax.broadcasted_iota(np.int32, (count, *system.shape[2:]), 0)

    def eliminate(k, carry):
        system, order = carry
        column = lax.dynamic_index_in_dim(system, k, 1, keepdims=False)
        best = jnp.argmax(jnp.where(order < count, -1.0, jnp.abs(column)), 0)
        chosen = index == best.astype(np.int32)[None]
        row = jnp.where(chosen[:, None], system, 0.0).sum(0)
        pivot = lax.dynamic_index_in_dim(row, k, 0, keepdims=False)
        row = row * safe_divide(jnp.ones_like(pivot), pivot)[None]
        system = jnp.where(chosen[:, None], row[None], system - column[:, None] * row[None])
        return system, jnp.where(chosen, k, order)

    system, order = lax.fori_loop(0, count, eliminate, (system, jnp.full_like(index, count)))
    return jnp.where(order[None] == index[:, None], system[None, :, count], 0.0).sum(1)


def softplus(x: Array, width: Array) -> Array:
    """width * log(1 + exp(x / width)), and its limit max(x, 0) at width == 0 (which would be 0 / 0).

    Smooth and above max(x, 0) by at most width * log 2. Same unit as x.
    """
    wide = width > 0
    smooth = width * jax.nn.softplus(x / jnp.where(wide, width, 1.0))
    return jnp.where(wide, smooth, jnp.maximum(x, 0.0))


@jax.custom_jvp
def implicit_root(s: Array, error: Array, slope: Array) -> Array:
    """The root s of error(s) = 0, with the derivative of the implicit function theorem: ds = -d(error) / slope.

    Args:
        s: the converged root, from any search; not differentiated.
        error: the equation at s, about zero; its tangent holds how the parameters move it at fixed s.
        slope: d(error)/ds at s. Where it is zero (grazing: the root is about to vanish) the derivative is
            cut to zero instead of infinite.

    Without derivatives nothing is evaluated but s, so a rollout does not pay for this. A second derivative needs the
    equation itself, where s moves, and not what is left of it here: it raises NotImplementedError.
    """
    del error, slope
    return s


@implicit_root.defjvp
def _implicit_root_jvp(primals, tangents):
    s, error, slope = primals
    return s, -safe_divide(tangents[1], _once(slope, error))


@jax.custom_jvp
def _once(slope: Array, error: Array) -> Array:
    """The slope, for a first derivative only."""
    del error
    return slope


@_once.defjvp
def _once_jvp(primals, tangents):
    raise NotImplementedError(
        "second derivatives (jax.hessian, jax.jvp of jax.grad) through the time of an impact are not available: "
        "take differences of first ones"
    )
