"""Convert what users write to arrays of one type: NumPy where values are known, and then checked, else traced.

Functions that check take the name of the argument first, for their messages. Known values stay NumPy, because under
`jit` even a constant is traced as soon as JAX holds it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffrigid import so2
from diffrigid.pytree import map_arrays, replace
from diffrigid.shapes import HalfSpace, dimension, traced, with_topology
from diffrigid.state import rotations

TYPED = 1e-4  # [-] by which a length, or the triangle inequality, may be off: typed numbers have a few digits
FEW = 16  # numbers that a message shows in full
NO_THICKNESS = 1e-9  # [-] of the largest principal inertia: a body with a smaller one has no thickness

Numbers = Any  # np.ndarray where known, Array where traced


def known(fn: Callable, *args: Any) -> Any:
    """Evaluate fn(*args), in NumPy if all arguments are known, even inside a trace."""
    if traced(args):
        return fn(*args)
    with jax.ensure_compile_time_eval():
        return jax.tree.map(np.asarray, fn(*args))


def stack(rows: Sequence, shape: tuple[int, ...] = ()) -> Numbers:
    """Stack rows along a new first axis; `shape` is that of one row, needed where there are none."""
    if not rows:
        return np.zeros((0, *shape), jnp.result_type(float))
    return jnp.stack(rows) if traced(rows) else np.stack(rows)


def numbers(where: str, value: Any, shape: tuple[int, ...] | None, finite: bool = True) -> Numbers:
    """Check and convert `value` to floats, of this shape unless None, and finite."""
    expected = "numbers" if shape is None else "a number" if shape == () else f"numbers of shape {shape}"
    try:
        array = _array(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} is {value!r}: expected {expected}") from error
    if shape is not None and array.shape != shape:
        raise ValueError(f"{where} has shape {array.shape}: expected {expected}, without batch axes")
    if finite and not traced(array):
        if (wrong := ~np.isfinite(array)).any():
            raise ValueError(
                f"{_first(where, array, wrong)}: expected finite numbers; look for a NaN where it was made"
            )
        if (wrong := np.abs(array) > largest(array.dtype)).any():
            raise ValueError(
                f"{_first(where, array, wrong)}: too large for {array.dtype}, its cube overflows; use other units"
            )
    return array


def _first(where: str, array: Any, wrong: Any) -> str:
    """What is wrong in words: all numbers if they are few, otherwise the first wrong one."""
    if array.size <= FEW:
        return f"{where} is {array}"
    index = tuple(np.argwhere(wrong)[0].tolist())
    return f"{where}[{', '.join(map(str, index))}] is {array[index]}"


def largest(dtype: Any) -> float:
    """Largest number whose cube is finite; its inverse is about the smallest whose cube is not zero."""
    return float(np.cbrt(float(jnp.finfo(dtype).max)))


def _array(value: Any) -> Numbers:
    dtype = jnp.result_type(float)
    if not traced(value):
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" or np.ma.is_masked(value):
            raise TypeError(f"not numbers: {array.dtype}")
        with np.errstate(over="ignore"):  # of a longer type; inf is refused below
            return array.astype(dtype)
    if isinstance(value, tuple | list):
        return jnp.stack([jnp.asarray(_array(part)) for part in value])
    return jnp.asarray(value, dtype)


def known_number(where: str, value: Any) -> Numbers:
    """Check and convert a number that must not be traced."""
    if traced(value):
        raise ValueError(f"{where} is traced: expected a number that is known")
    return numbers(where, value, ())


def at_least_one(where: str, count: Any) -> int:
    """Check and convert a count of steps, of worlds, or of bytes."""
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or not 1 <= count < 2**62:
        raise ValueError(f"{where} is {count!r}, expected an integer >= 1 (and below 2^62)")
    return int(count)


def positive(where: str, value: Any, fix: str) -> Numbers:
    """Check and convert a number above zero."""
    array = numbers(where, value, ())
    if not traced(array) and not array > 0:
        raise ValueError(f"{where} is {float(array):g}: expected above 0; {fix}")
    if not traced(array) and array < 1 / largest(array.dtype):
        raise ValueError(
            f"{where} is {float(array):g}: too small for {array.dtype}, its cube vanishes; use other units"
        )
    return array


def fraction(where: str, value: Any) -> Numbers:
    """Check and convert a coefficient of restitution."""
    array = numbers(where, value, ())
    if not traced(array) and not 0 <= array <= 1:
        raise ValueError(f"{where} is {float(array):g}: expected 0 (no rebound) to 1 (no loss); clip it")
    return array


def coefficient(where: str, value: Any) -> Numbers:
    """Check and convert a coefficient of friction, or the fall-off of restitution."""
    array = numbers(where, value, ())
    if not traced(array) and not array >= 0:
        raise ValueError(f"{where} is {float(array):g}: expected 0 or above; drop the sign")
    return array


def materials(colliders: Mapping[str, Any], general: Mapping[str, Any]) -> dict[str, tuple[Any, tuple[bool, ...]]]:
    """For each coefficient, the values of all colliders, and whether each was given to the collider itself.

    Args:
        general: values for those colliders that have none of their own; None: 0, and if none of the colliders has one
            either, there is no such coefficient.
    """
    found = {}
    for field, default in general.items():
        check = fraction if field == "restitution" else coefficient
        own = {name: getattr(body, field) for name, body in colliders.items()}
        given = tuple(value is not None for value in own.values())
        if default is not None or any(given):
            rest = check(field, 0.0 if default is None else default)
            values = [rest if value is None else check(f"{name}.{field}", value) for name, value in own.items()]
            found[field] = stack(values), given
        elif field in ("restitution", "friction"):
            raise ValueError(f"{field} is None: expected a number, 0 for none")
    return found


def orientation(name: str, body: Any, dim: int) -> Numbers:
    """Orientation q of a body or static, from its q or angle, (2,) or (4,), of length one."""
    if body.angle is not None:
        if body.q is not None:
            raise ValueError(f"{name}: got both angle and q; give one of them")
        if dim == 3:
            raise ValueError(f"{name}.angle: expected q = (w, x, y, z), a unit quaternion, in a 3D scene")
        return known(so2.exp, numbers(f"{name}.angle", body.angle, ())[None])
    unturned = np.eye(rotations(dim).Q)[0]
    q = numbers(f"{name}.q", unturned if body.q is None else body.q, unturned.shape)
    return unit_quaternion(f"{name}.q", q)


def unit_quaternion(where: str, q: Numbers) -> Numbers:
    """Check q, (2,) or (4,), and scale it to length one to rounding."""
    length = _length(q)
    if not traced(q) and abs(length - 1) > TYPED:
        raise ValueError(f"{where} has length {length:.6g}: expected 1; divide it by its length")
    return q / length


def _length(vector: Numbers) -> Numbers:
    return (jnp if traced(vector) else np).sqrt((vector * vector).sum())


def angular_velocity(name: str, w: Any, dim: int) -> Numbers:
    """Check and convert w, (1,) or (3,); in 2D it may be a number."""
    size = rotations(dim).A
    array = numbers(f"{name}.w", np.zeros(size) if w is None else w, None)
    return numbers(f"{name}.w", array[None] if dim == 2 and array.ndim == 0 else array, (size,))


# ---- shapes, mass, inertia


class Solid(NamedTuple):
    """Properties of the shape of a body, or of all its parts; see `volume_properties`."""

    volume: Numbers
    center: Numbers
    gyration: Numbers
    mass: Numbers | None = None  # [kg] sum of what its parts were given


def shape_of(where: str, shape: Any, dim: int) -> Any:
    """Convert a shape: float leaves, and the topology of a hull filled in."""
    if dimension(shape) not in (None, dim):
        kind = type(shape).__name__
        raise ValueError(f"{where} is a {kind} of {dimension(shape)}D: use a shape of {dim}D, as the scene")
    shape = map_arrays(lambda leaf, letters, _: _array(leaf), with_topology(shape))
    return replace(shape, normal=shape.normal / _length(shape.normal)) if isinstance(shape, HalfSpace) else shape


def mass_and_inertia(name: str, body: Any, solid: Solid | None, dim: int) -> tuple[Numbers, Numbers]:
    """Mass () [kg] and inertia () or (3, 3) [kg m^2] from what a body was given.

    With the mass given, the inertia is mass * gyration: that is finite for a rod without volume.
    """
    of_parts = None if solid is None else solid.mass
    if of_parts is not None and (body.mass is not None or body.density is not None):
        field = "density" if body.mass is None else "mass"
        raise ValueError(f"{name}.{field}: its parts have masses already; leave it out, or take theirs away")
    if of_parts is None and (body.mass is None) == (body.density is None):
        came = "neither" if body.mass is None else "both"
        raise ValueError(f"{name}: expected either mass [kg] or density, got {came}; give one of them")
    if solid is None and (body.mass is None or body.inertia is None):
        raise ValueError(f"{name}.shape is None: expected both mass and inertia; give them, or a shape")
    if of_parts is not None:
        mass = of_parts
    elif body.mass is not None:
        mass = positive(f"{name}.mass", body.mass, "use Static for what does not move")
    else:
        density = positive(f"{name}.density", body.density, "use Static for what does not move")
        mass = density * solid.volume  # type: ignore[union-attr]
        if not traced(solid.volume) and not solid.volume > 0:  # type: ignore[union-attr]
            raise ValueError(f"{name}.shape has no volume, and so no mass: give mass instead of density")
    if body.inertia is not None:
        return mass, _inertia(f"{name}.inertia", body.inertia, dim)
    gyration = solid.gyration  # type: ignore[union-attr]
    if not traced(gyration) and dim == 3:
        low, _, high = np.linalg.eigvalsh(gyration)
        if low <= NO_THICKNESS * high:
            raise ValueError(f"{name}.shape has no thickness, and so no inertia about its line: give inertia")
    return mass, mass * gyration


def _inertia(where: str, value: Any, dim: int) -> Numbers:
    """Inertia about the centre of mass, () or (3, 3), from a number, principal values or a matrix."""
    if dim == 2:
        return positive(where, value, "a point has none; give that of a small disc, m r^2 / 2")
    array = numbers(where, value, None)
    if array.shape in ((), (3,)):
        array = array.reshape(-1, 1) * np.eye(3, dtype=array.dtype)
    if array.shape != (3, 3):
        raise ValueError(
            f"{where} has shape {array.shape}: expected a number, three principal values, or a (3, 3) matrix"
        )
    if traced(array):
        return array
    low, middle, high = np.linalg.eigvalsh(array)
    text = f"{where} has principal values {low:.4g}, {middle:.4g}, {high:.4g}"
    if not np.allclose(array, array.T, rtol=TYPED, atol=TYPED * abs(high)):
        raise ValueError(f"{where} is not symmetric: expected I = I^T; average it with its transpose")
    if low <= 0:
        raise ValueError(f"{text}: expected all above 0; check signs, products of inertia enter negative")
    if high > (low + middle) * (1 + TYPED):
        raise ValueError(
            f"{text}: expected none larger than the sum of the others (triangle inequality), "
            "as for any distribution of mass; check the order and the units"
        )
    return array
