"""What may vary in a fit: a bound, the map from an unbounded number z to it, and where random starts lie."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

NEAR_BOUND = 1e-3  # [-] of an interval: a start on a bound is pulled off it, a result this close is reported


@dataclass(frozen=True)
class Free:
    """A free parameter: any real number, one > low, or one between low and high. `spread` is that of the starts."""

    low: float = -np.inf
    high: float = np.inf
    spread: float = 1.0

    def value(self, z: Array) -> Array:
        """The parameter for z: z itself, low + exp(z), or low + (high - low) / (1 + exp(-z))."""
        if np.isfinite(self.high):
            return self.low + (self.high - self.low) * jax.nn.sigmoid(z)
        return z if np.isinf(self.low) else self.low + jnp.exp(z)

    def unbounded(self, value: np.ndarray) -> np.ndarray:
        """z for a value, which is first pulled off its bounds."""
        value = np.asarray(value, float)
        if np.isfinite(self.high):
            share = np.clip((value - self.low) / (self.high - self.low), NEAR_BOUND, 1.0 - NEAR_BOUND)
            return np.log(share / (1.0 - share))
        return value if np.isinf(self.low) else np.log(np.maximum(value - self.low, 1e-12))

    def draw(self, value: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """z of a random start: uniform in an interval; a factor exp(spread N) about value - low if positive;
        normal with standard deviation spread * max(|value|, 1) about the value if real."""
        value = np.asarray(value, float)
        if np.isfinite(self.high):
            return self.unbounded(random.uniform(self.low, self.high, value.shape))
        noise = self.spread * random.standard_normal(value.shape)
        if np.isinf(self.low):
            return value + noise * max(float(np.linalg.norm(value)) / max(value.size, 1) ** 0.5, 1.0)
        return self.unbounded(value) + noise

    def at_bound(self, value: np.ndarray) -> bool:
        """True if a value lies on a bound, to within NEAR_BOUND of the interval."""
        if not np.isfinite(self.high):
            return False
        edge = NEAR_BOUND * (self.high - self.low)
        return bool(np.any(value - self.low < edge) or np.any(self.high - value < edge))


def interval(low: float, high: float) -> Free:
    """A parameter between two bounds."""
    if not low < high:
        raise ValueError(f"interval({low}, {high}): expected low < high")
    return Free(low=float(low), high=float(high))


def positive(spread: float = 0.5) -> Free:
    """A parameter > 0; random starts are a factor exp(spread N(0, 1)) away."""
    return Free(low=0.0, spread=spread)


def real(spread: float = 0.5) -> Free:
    """Any number; random starts are spread * max(rms, 1) N(0, 1) away."""
    return Free(spread=spread)
