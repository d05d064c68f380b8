"""Measured columns against a trajectory: one residual for every number that was measured."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import so2, so3
from diffrigid.state import State
from diffrigid.world import World

FIELDS = ("x", "v", "w", "q", "angle")


@dataclass(frozen=True)
class Column:
    """One measured quantity of a body at all times."""

    name: str  # "ball.x"
    row: int  # of the body in State
    field: str  # one of FIELDS
    measured: np.ndarray  # (T+1, size), NaN where missing

    def predicted_minus_measured(self, states: State) -> Array:
        """Differences at all times, (T+1, size, *batch), in the unit of the column; angles and turns in rad."""
        leaf = getattr(states, "q" if self.field == "angle" else self.field)[:, self.row]
        measured = jnp.asarray(np.nan_to_num(self.measured), leaf.dtype)
        measured = jnp.reshape(measured, (*measured.shape, *[1] * (leaf.ndim - 2)))
        if self.field == "angle":
            c, s = jnp.cos(measured), jnp.sin(measured)
            return jnp.arctan2(leaf[:, 1:] * c - leaf[:, :1] * s, leaf[:, :1] * c + leaf[:, 1:] * s)
        if self.field == "q":
            so = so2 if leaf.shape[1] == 2 else so3
            flip = jnp.concatenate([jnp.ones_like(measured[:, :1]), -jnp.ones_like(measured[:, 1:])], axis=1)
            turned, back = (jnp.moveaxis(x, 1, 0) for x in (leaf, measured * flip))
            return jnp.moveaxis(so.log(so.compose(back + jnp.zeros_like(turned), turned)), 0, 1)
        return leaf - measured

    @property
    def known(self) -> np.ndarray:
        """(T+1, size of the residual) bool."""
        finite = np.isfinite(self.measured)
        if self.field != "q":
            return finite
        return np.repeat(finite.all(1, keepdims=True), 1 if self.measured.shape[1] == 2 else 3, axis=1)


def columns(world: World, observations: Mapping[str, Any]) -> tuple[np.ndarray, tuple[Column, ...]]:
    """Times (T+1,) [s] and columns of a record.

    Args:
        observations: "t" and, by name, arrays of T + 1 rows: "ball.x" (T+1, D) [m], "ball.v", "ball.w" [rad/s],
            "ball.angle" (T+1,) [rad], "ball.q" (T+1, Q). NaN is missing. t[0] is the time of the initial state.

    Raises:
        ValueError: no "t", an unknown name (the nearest are listed), wrong lengths, nothing measured at all.
    """
    if "t" not in observations:
        raise ValueError(f'observations: expected a column "t" of times [s], got {sorted(observations)}')
    t = np.asarray(observations["t"], float)
    if t.ndim != 1 or len(t) < 2 or not (np.diff(t) > 0).all():
        raise ValueError('observations["t"]: expected at least two increasing times, without NaN')
    sizes = {"x": world.dim, "v": world.dim, "w": 1 if world.dim == 2 else 3, "q": 2 if world.dim == 2 else 4}
    possible = [f"{name}.{field}" for name in world.names for field in FIELDS if field != "angle" or world.dim == 2]
    found = []
    for name, values in observations.items():
        if name == "t":
            continue
        if name not in possible:
            near = difflib.get_close_matches(name, possible, n=3, cutoff=0.3) or possible
            raise ValueError(f"observations: no column {name!r} in this world: did you mean {', '.join(near)}?")
        body, field = name.rsplit(".", 1)
        size = sizes.get(field, 1)
        values = np.asarray(values, float)
        values = values[:, None] if values.ndim == 1 else values
        if values.shape != (len(t), size):
            raise ValueError(f"observations[{name!r}] has shape {values.shape}, expected ({len(t)}, {size}) like t")
        found.append(Column(name=name, row=world.names.index(body), field=field, measured=values))
    if not any(column.known.any() for column in found):
        raise ValueError("observations: nothing is measured, every column is NaN or absent")
    return t, tuple(found)


def noise_guess(column: Column) -> float:
    """Standard deviation of the noise of a column from its second differences, which smooth motion hardly has."""
    values = np.unwrap(column.measured, axis=0) if column.field == "angle" else column.measured
    second = np.abs(np.diff(values, n=2, axis=0))
    second = second[np.isfinite(second)]
    if second.size == 0:
        return 1.0
    floor = 1e-9 + 1e-6 * float(np.nanmax(np.abs(values)))
    return max(float(np.median(second)) / (0.6745 * np.sqrt(6.0)), floor)
