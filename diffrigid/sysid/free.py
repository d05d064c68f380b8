"""Kinds of free parameters: the map from unbounded numbers z to a parameter, and the spread of random starts.

A kind of parameter is a frozen record with the verbs

    size(shape)               how many numbers z a parameter of this shape takes
    value(z, reference)       the parameter for z (k,); `reference` is its value at the start
    unbounded(reference)      the z whose value is the reference, pulled off its bounds
    draw(reference, random)   z of a random start
    at_bound(value)           true if a result lies on a bound of an interval
    log_volume(z, reference)  log |d value / d z|: volume of the parameter per volume of z
    check(where, value)       raises ValueError for a start that the kind does not allow
    scale(reference)          (k,) a large change of z: the measure of how well the data determine it

`each(kind)` gives every record a value of its own; `prior(kind, mean, deviation)` adds prior knowledge;
`through(write, kind, start)` is a number that is no leaf of the scene, but sets some. Kinds with a condition on the
value, such as directions, are in `charts`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.convert import coefficient, known_number, numbers
from diffrigid.pytree import Number, Vector
from diffrigid.state import State
from diffrigid.world import World

NEAR_BOUND = 1e-3  # [-] of an interval: a start is pulled so far off a bound, a result this close is reported
ON_BOUND = 0.1  # [-] likewise a start that is on it: what hardly rebounds comes to rest, and shows no restitution
PULL = 1e-3  # a start on the bound of a positive parameter begins this far above it, in its unit


@dataclass(frozen=True)
class Free:
    """A free parameter: any real number, one > low, or one between low and high. `spread` is that of random starts."""

    low: float = -np.inf
    high: float = np.inf
    spread: float = 1.0

    def size(self, shape: tuple[int, ...]) -> int:
        return int(np.prod(shape))

    def value(self, z: Any, reference: Any = None) -> Any:
        """z itself, low + exp(z), or low + (high - low) / (1 + exp(-z)), in the shape of the reference."""
        z = z if reference is None else z.reshape(jnp.shape(reference))
        if np.isfinite(self.high):
            return self.low + (self.high - self.low) * (_sigmoid(z) if isinstance(z, np.ndarray) else jax.nn.sigmoid(z))
        return z if np.isinf(self.low) else self.low + (np if isinstance(z, np.ndarray) else jnp).exp(z)

    def unbounded(self, reference: np.ndarray) -> np.ndarray:
        value = np.asarray(reference, float)
        if np.isfinite(self.high):
            share = (value - self.low) / (self.high - self.low)
            off = np.where((share <= 0) | (share >= 1), ON_BOUND, NEAR_BOUND)
            share = np.clip(share, off, 1.0 - off)
            return np.log(share / (1.0 - share)).ravel()
        if np.isinf(self.low):
            return value.ravel()
        return np.log(np.where(value > self.low, value - self.low, PULL)).ravel()

    def check(self, where: str, value: np.ndarray) -> None:
        if not ((value >= self.low) & (value <= self.high)).all():
            raise ValueError(f"{where} starts at {value}, expected from {self.low:g} to {self.high:g}: move the start")

    def draw(self, reference: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Uniform in an interval; a factor exp(spread N) about value - low if positive; normal with standard
        deviation spread * max(rms, 1) about the value if real."""
        value = np.asarray(reference, float)
        if np.isfinite(self.high):
            return self.unbounded(random.uniform(self.low, self.high, value.shape))
        return self.unbounded(value) + self.spread * self.scale(value) * random.standard_normal(value.size)

    def log_volume(self, z: Array, reference: Any = None) -> Array:
        del reference
        if np.isfinite(self.high):
            return (jax.nn.log_sigmoid(z) + jax.nn.log_sigmoid(-z)).sum()
        return jnp.zeros((), z.dtype) if np.isinf(self.low) else z.sum()

    def at_bound(self, value: np.ndarray) -> bool:
        if not np.isfinite(self.high):
            return False
        edge = NEAR_BOUND * (self.high - self.low)
        return bool(np.any(value - self.low < edge) or np.any(self.high - value < edge))

    def scale(self, reference: np.ndarray) -> np.ndarray:
        value = np.asarray(reference, float)
        real = np.isinf(self.low) and np.isinf(self.high)
        rms = float(np.sqrt(np.mean(value**2))) if value.size else 1.0
        return np.full(value.size, max(rms, 1.0) if real else 1.0)


@dataclass(frozen=True)
class Each:
    """A parameter of which every record has its own value."""

    kind: Any


@dataclass(frozen=True)
class Prior:
    """A parameter with a prior: normal about `mean`, with a standard deviation, in its unit."""

    kind: Any
    mean: Any  # a number or a tuple
    deviation: Any


@dataclass(frozen=True)
class Through:
    """A parameter of the user's own, which a function writes into the scene."""

    write: Callable[[World, State, Array], tuple[World, State]]
    kind: Any
    start: Any  # a number or a tuple
    unit: str


def interval(low: float, high: float) -> Free:
    """A parameter between two bounds, in its unit; random starts are anywhere between.

    Raises:
        ValueError: bounds that are not finite numbers, or not low < high.

    Example:
        >>> dr.interval(0, 2).value(np.array([-50.0, 0.0, 50.0])).round(3)  # of what is fitted, which has no bounds
        array([0., 1., 2.])
    """
    low, high = as_given(known_number, "interval: low", low), as_given(known_number, "interval: high", high)
    if not low < high:
        raise ValueError(f"interval({low}, {high}): expected low < high")
    return Free(low=low, high=high)


def positive(spread: float = 0.5) -> Free:
    """A parameter > 0; random starts are a factor exp(spread N(0, 1)) away.

    Raises:
        ValueError: spread is not a number from 0 on.

    Example:
        >>> dr.positive().value(np.array([-50.0, 0.0, 1.0])).round(3)  # exp of what is fitted
        array([0.   , 1.   , 2.718])
    """
    return Free(low=0.0, spread=as_given(coefficient, "spread", spread))


def real(spread: float = 0.5) -> Free:
    """Any number; random starts are spread * max(rms, 1) N(0, 1) away.

    Raises:
        ValueError: spread is not a number from 0 on.

    Example:
        >>> dr.real(spread=0.1).draw(np.array([3.0, 4.0]), np.random.default_rng(0)).round(2)  # a random start
        array([3.04, 3.95])
    """
    return Free(spread=as_given(coefficient, "spread", spread))


def each(kind: Any) -> Each:
    """A parameter with a value of its own in each record: {"ball.v": each(real())}.

    Example:
        >>> own = {"restitution": dr.interval(0, 1), "ball.v": dr.each(dr.real())}
        >>> dr.sysid.make_problem(world, state, [measured] * 3, free=own).sizes  # shared numbers, those of each record
        (1, 2)
    """
    return Each(kind=kind)


def prior(kind: Any, mean: Number | Vector, deviation: Number | Vector) -> Prior:
    """A Gaussian prior beside the data: {"ball.mass": prior(positive(), 1.2, 0.1)}.

    Args:
        mean: a number, or those of a vector, in the unit of the parameter.
        deviation: its standard deviation, likewise; one number stands for all.

    Raises:
        ValueError: not numbers, deviations that are not above 0, or more than one and not as many as the means.

    Example:
        >>> dr.prior(dr.positive(), 1.2, 0.1).mean, dr.prior(dr.real(), (0.0, 1.0), 0.1).deviation
        ((1.2,), (0.1,))
    """
    means, deviations = numbers("prior: mean", mean, None).ravel(), numbers("prior: deviation", deviation, None).ravel()
    if not (deviations > 0).all():
        raise ValueError(f"prior: deviation is {deviation}, expected > 0, in the unit of the parameter")
    if not means.size or deviations.size not in (1, means.size):
        raise ValueError(
            f"prior: {means.size} means and {deviations.size} deviations, expected as many, or one for all"
        )
    given = (tuple(np.asarray(part, float).ravel().tolist()) for part in (mean, deviation))
    return Prior(kind, *given)


def through(
    write: Callable[[World, State, Array], tuple[World, State]], kind: Any, start: Number | Vector, unit: str = ""
) -> Through:
    """A number of your own that sets several of the scene: {"length": through(lengthen, positive(), 0.8, "m")}.

    Args:
        write: (world, state, value) -> (world, state) of one record, with the value, of the shape of `start`, written
            in by `dr.paths.write`. JAX traces and differentiates it, so it has to be smooth where a fit may go. It
            comes after the other free numbers, but before densities and the coordinates of joints.
        kind: `positive()`, `interval(low, high)` or another.
        start: the value to begin with, () or (k,), in the unit that `write` takes.
        unit: of the table.

    Raises:
        ValueError: write is no function, start not numbers, unit no string. In `fit`: the name is that of a parameter,
            or write returns other arrays.

    Example:
        >>> def lengthen(world, state, length):  # a thin rod
        ...     world, state = dr.paths.write(world, state, "rod.shape.half[0]", length / 2)
        ...     mass = dr.paths.read(world, state, "rod.mass")
        ...     return dr.paths.write(world, state, "rod.inertia", mass * length**2 / 12)
        >>> free = {"length": dr.through(lengthen, dr.positive(), start=0.8, unit="m")}
    """
    if not callable(write) or isinstance(write, type):
        raise ValueError(f"through: write is {write!r}, expected a function (world, state, value) -> (world, state)")
    if not isinstance(unit, str):
        raise ValueError(f"through: unit is {unit!r}, expected a string, such as 'm'")
    if not numbers("through: start", start, None).size:
        raise ValueError("through: start is empty, expected a number, or those of a vector")
    return Through(write, kind, np.asarray(start, float).tolist(), unit)


def as_given(check: Callable, where: str, value: Any, *more: Any) -> float:
    """The number itself, if `check(where, value, *more)` of `convert` takes it.

    What that returns is rounded to JAX's type of floats, which may still change, and 0.1 would print as
    0.10000000149011612.
    """
    check(where, value, *more)
    return float(np.asarray(value))


def _sigmoid(z: np.ndarray) -> np.ndarray:
    """Sigmoid in NumPy, without overflow: for the few numbers of a result, each of which JAX would compile."""
    small = np.exp(-np.abs(z))
    return np.where(z >= 0, 1.0, small) / (1.0 + small)


def meant(kind: Any) -> str:
    """What was given instead of a kind, and what may have been meant."""
    if isinstance(kind, tuple | list) and len(kind) == 2:
        return f"{kind!r}: did you mean interval{tuple(kind)!r}?"
    if isinstance(kind, FunctionType):
        return f"the function {kind.__name__}: call it, {kind.__name__}()"
    return f"{kind!r:.80}"
