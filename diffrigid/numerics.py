"""Gradient-safe arithmetic, written so that XLA makes fast programs of it on a CPU.

The pattern for gradients is the two-sided `where`: the argument is made harmless *before* the singular operation,
because reverse mode multiplies the derivative of the branch not taken by zero, and 0 * inf is NaN.

Vectors carry their components on the leading axis, `(D, *batch)`.

Functions called in many places are jitted, here and elsewhere, so that JAX traces, differentiates and transposes them
once, which shortens the tracing of a gradient; XLA inlines them.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

FOUND = "found"  # names results of searches and iterations: reverse mode saves these, and nothing else of a pass
PASSED = "passed"  # names what a pass hands on to the next; with both saved, no step is recomputed


def saving(*names: str) -> Callable[[Callable], Callable]:
    """Decorator of a loop's or branch's body: reverse mode saves what has these names, and recomputes the rest."""
    policy = jax.checkpoint_policies.save_only_these_names(*names)
    return functools.partial(jax.checkpoint, prevent_cse=False, policy=policy)


def recomputed(branch: Callable, of_world: Array) -> Callable:
    """`branch` of a `lax.cond`, which reverse mode recomputes for one world, where `of_world` (*batch) is ().

    Else the branches hand on all intermediate results: a sixth more to trace, but in a batch a tenth faster.
    """
    return branch if of_world.ndim else saving(FOUND)(branch)


@jax.jit
def dot(a: Array, b: Array) -> Array:
    """Inner product over the leading axis, (D, *batch), (D, *batch) -> (*batch)."""
    return _dot(a, b)


@jax.custom_jvp
def _dot(a: Array, b: Array) -> Array:
    if a.ndim == b.ndim == 1:  # one world: fewer operations to compile
        return (a * b).sum(0)
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

    By `lax.select` and not `jnp.stack`: on a CPU XLA does not vectorise loops that concatenate, which makes cross
    products much slower.
    """
    alike = parts if all(part.shape == parts[0].shape for part in parts) else jnp.broadcast_arrays(*parts)
    shape, across = (len(parts), *alike[0].shape), tuple(range(1, alike[0].ndim + 1))
    index = lax.broadcasted_iota(np.int32, shape, 0)
    whole = [lax.broadcast_in_dim(part, shape, across) for part in alike]
    vector = whole[-1]
    for k in range(len(parts) - 2, -1, -1):
        vector = lax.select(lax.eq(index, lax.full_like(index, k)), whole[k], vector)
    return vector


@jax.custom_jvp
def with_tangents(tree: Any, by: Any) -> Any:
    """Return `tree`, with tangents for all its leaves as soon as one of them or of `by` has a tangent.

    Forward mode traces the body of a loop again until it knows which parts of its carry have a tangent. With this each
    has one from the beginning, which shortens tracing.
    """
    del by
    return tree


@with_tangents.defjvp
def _with_tangents_jvp(primals, tangents):
    return primals[0], tangents[0]


def _least(like: Array) -> float:
    """Smallest normal number: below it digits are lost, and a number may be taken as zero; then 0 * inf is NaN."""
    return float(jnp.finfo(like.dtype).tiny)


@jax.jit
def safe_sqrt(x: Array) -> Array:
    """Square root; 0 with zero derivative for x <= 0 (the derivative of sqrt at 0 is infinite), or just above.

    Two results of one program that both need x may each have a copy of it, which XLA rounds differently: 0 in one,
    1e-17 in the other. The stand-in for an x that is not positive has to be tiny: otherwise the root of one copy would
    be 1, and of the other 0.
    """
    least = _least(x)
    positive = x >= least
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, least)), 0.0)


@jax.custom_jvp
def cos_sin(phi: Array) -> tuple[Array, Array]:
    """Cosine and sine, to rounding for |phi| up to a few thousand turns.

    XLA calls the scalar library for them on a CPU, which is slow. Reduction to |r| <= pi / 2 in three parts of pi
    (Cody & Waite 1980), then Taylor's series by Horner's rule, whose remainder there is below rounding after twelve
    terms (single precision: seven).
    """
    halves = jnp.round(phi * (1.0 / np.pi))
    r = phi
    for part in _PI[jnp.finfo(phi.dtype).bits]:
        r = r - halves * part
    r = jnp.clip(r, -1.6, 1.6)  # beyond those turns the phase is lost, but not the length
    square = r * r
    count = 7 if phi.dtype == jnp.float32 else 12
    cosine, sine = (jnp.full_like(r, (-1) ** count / math.factorial(2 * count + odd)) for odd in (0, 1))
    for k in range(count - 1, -1, -1):
        cosine = (-1) ** k / math.factorial(2 * k) + square * cosine
        sine = (-1) ** k / math.factorial(2 * k + 1) + square * sine
    sign = 1.0 - 2.0 * (halves - 2.0 * jnp.floor(0.5 * halves))
    return sign * cosine, sign * (r * sine)


@cos_sin.defjvp
def _cos_sin_jvp(primals, tangents):
    c, s = cos_sin(*primals)
    return (c, s), (-s * tangents[0], c * tangents[0])


def half_turn(square: Array) -> tuple[Array, Array]:
    """Cosine of half the angle |phi|, with |phi|^2 = `square`, and the factor that gives phi the length of its sine."""
    small = square < 1e-8  # there the series below is exact to rounding, and sqrt has no derivative at 0
    half = 0.5 * safe_sqrt(jnp.where(small, 1e-8, square))
    cosine, sine = cos_sin(half)
    return jnp.where(small, 1.0 - square / 8.0, cosine), jnp.where(small, 0.5 - square / 48.0, 0.5 * sine / half)


# pi as a sum whose first parts have trailing zeros, so that their products with small integers are exact
_PI = {
    32: (3.140625, 9.67502593994140625e-4, 1.509957990978376432e-7),
    64: (3.14159265346825122834, 1.21542010126079319532e-10, 4.04453249759190126308e-21),
}


@jax.jit
def safe_divide(a: Array, b: Array) -> Array:
    """a / b for a finite a; 0 with zero derivative where b == 0 (0 / 0 in both modes), or nearly so."""
    return _quotient(a, jnp.where(jnp.abs(b) >= _least(b), b, jnp.inf))


@jax.custom_jvp
def _quotient(a: Array, b: Array) -> Array:
    """a / b, whose derivative does not divide by b^2: below 1e-19 that is 0 in single precision, and 0 * inf is NaN."""
    return a / b


@functools.partial(_quotient.defjvp, symbolic_zeros=True)
def _quotient_jvp(primals, tangents):
    (a, b), (da, db) = primals, tangents
    q = a / b
    change = 0.0 if isinstance(da, SymbolicZero) else da
    change = change if isinstance(db, SymbolicZero) else change - q * db
    return q, jnp.broadcast_to(change / b, q.shape)


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


def softplus(x: Array, width: Array) -> Array:
    """width * log(1 + exp(x / width)), and its limit max(x, 0) at width == 0 (which would be 0 / 0).

    Smooth and above max(x, 0) by at most width * log 2. Same unit as x.
    """
    wide = width > 0
    smooth = width * jax.nn.softplus(_quotient(x, jnp.where(wide, width, 1.0)))
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
    """The slope, which can be differentiated no further."""
    del error
    return slope


@_once.defjvp
def _once_jvp(primals, tangents):
    raise NotImplementedError(
        "second derivatives (jax.hessian, jax.jvp of jax.grad) through the time of an impact are not available: "
        "take differences of first ones"
    )
