"""Losses of a residual r, in standard deviations: records with `rho(r)`, and `weight(r)` = rho'(r) / r.

Least squares has rho = r^2 / 2. The others grow more slowly, so that outliers pull less. They are minimised by least
squares with the weights of the last point (Holland and Welsch 1977).
"""

from dataclasses import dataclass
from typing import Any, Protocol

import jax.numpy as jnp
from jax import Array

from diffrigid.convert import positive
from diffrigid.sysid.free import as_given


class Loss(Protocol):
    """Verbs of a loss."""

    def rho(self, r: Array) -> Array: ...

    def weight(self, r: Array) -> Array: ...


@dataclass(frozen=True)
class Squares:
    """rho = r^2 / 2: normal noise."""

    def rho(self, r: Array) -> Array:
        return 0.5 * r**2

    def weight(self, r: Array) -> Array:
        return jnp.ones_like(r)


@dataclass(frozen=True)
class Huber:
    """rho = r^2 / 2 up to `at`, linear beyond."""

    at: float

    def rho(self, r: Array) -> Array:
        size = jnp.abs(r)
        return jnp.where(size < self.at, 0.5 * r**2, self.at * (size - 0.5 * self.at))

    def weight(self, r: Array) -> Array:
        return self.at / jnp.maximum(jnp.abs(r), self.at)


@dataclass(frozen=True)
class Student:
    """rho = (nu + 1) / 2 log(1 + r^2 / nu): noise of Student's distribution with nu degrees of freedom."""

    nu: float

    def rho(self, r: Array) -> Array:
        return 0.5 * (self.nu + 1.0) * jnp.log1p(r**2 / self.nu)

    def weight(self, r: Array) -> Array:
        return (self.nu + 1.0) / (self.nu + r**2)


def squares() -> Squares:
    """Loss for normal noise: least squares."""
    return Squares()


def huber(at: float = 1.345) -> Huber:
    """Loss quadratic up to `at` standard deviations, linear beyond; 1.345 has 95 % efficiency in normal noise.

    Raises:
        ValueError: at is not a number above 0.

    Example:
        >>> dr.huber().rho(jnp.array([1.0, 10.0])).round(3).tolist()  # squares: 0.5, 50
        [0.5, 12.545]
    """
    return Huber(at=_above_zero("huber", at))


def student(nu: float = 4.0) -> Student:
    """Loss for heavy tails: noise of Student's distribution with nu degrees of freedom.

    Raises:
        ValueError: nu is not a number above 0.

    Example:
        >>> dr.student(nu=4.0).rho(jnp.array([1.0, 10.0])).round(3).tolist()  # squares: 0.5, 50
        [0.558, 8.145]
    """
    return Student(nu=_above_zero("student", nu))


def _above_zero(name: str, value: Any) -> float:
    return as_given(positive, name, value, "it counts standard deviations or degrees of freedom")
