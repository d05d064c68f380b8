"""Multiple shooting: a long record cut into short ones, each with an initial state of its own.

Over a short time the motion depends on its start as a straight line does; over many impacts it does not, and a fit from
a poor start is lost. What all pieces share is found first, with `each` for their states; then a fit of the whole record
with growing `windows` starts from there:

    pieces = segments(world, state, observations, 8)
    own = {"ball.x": each(real()), "ball.v": each(real())}
    first = fit(world, state, pieces, free={"restitution": interval(0, 1), **own})
    whole = fit(first.world, first.state, observations, free=..., windows=(0.5, 1, 2, inf))
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from diffrigid import paths
from diffrigid.state import State
from diffrigid.step import at_least_one
from diffrigid.sysid.records import Record, Series, columns
from diffrigid.sysid.sensors import Part
from diffrigid.world import World, check

FRAMES = 5  # rows of a column that a guess of its start is made from


def segments(world: World, state: State, observations: Any, count: int) -> list[Record]:
    """Pieces of equal duration, with initial states guessed from the first rows of their "x" and "angle" columns.

    Example:
        >>> [piece.start for piece in dr.segments(world, state, measured, 3)]
        [0.0, 0.16666666666666666, 0.3333333333333333]
    """
    check(world, state)
    at_least_one("count", count)
    series, channels = columns(world, observations, {})
    if count > max(len(s.t) for s in series):
        raise ValueError(f"count is {count}: expected at most as many segments as there are times")
    first, last = min(s.t[0] for s in series), max(s.t[-1] for s in series)
    edges = np.linspace(first, last, count + 1)
    out = []
    for k, (start, end) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        start = max(s.t[s.t <= start + 1e-9][-1] for s in series if (s.t <= start + 1e-9).any())
        use = {s.name: (s.t >= start - 1e-9) & (s.t <= end + 1e-9) for s in series}
        pieces = {s.name: (s.t[use[s.name]], s.values[use[s.name]]) for s in series}
        own = state
        for s in series:
            if k and isinstance(channels[s.name].observer, Part):
                own = _guessed(world, own, s, start)
        out.append(Record(pieces, state=own, start=float(start)))
    return out


def _guessed(world: World, state: State, series: Series, start: float) -> State:
    """The state with position and velocity of one column's body from a straight line through its next rows."""
    body, _, field = series.name.rpartition(".")
    names = {"x": ("x", "v"), "angle": ("angle", "w")}
    if field not in names:
        return state
    later = (series.t >= start - 1e-9) & np.isfinite(series.values).all(1)
    t, values = series.t[later][:FRAMES] - start, series.values[later][:FRAMES]
    if len(t) < 2:
        return state
    values = np.unwrap(values, axis=0) if field == "angle" else values
    slope, value = np.polyfit(t, values, 1)
    shape = () if field == "angle" else value.shape
    for name, number in zip(names[field], (value.reshape(shape), slope), strict=True):
        _, state = paths.write(world, state, f"{body}.{name}", jnp.asarray(number, state.x.dtype))
    return state
