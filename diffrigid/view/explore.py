"""`explore`: sliders for parameters of a scene, beside its motion and the linear prediction of it.

Sliders set arguments of one compiled program, so a new motion takes milliseconds. The player shows two motions: the
motion itself, and its linear prediction, by the derivative with respect to the parameter moved last.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import paths
from diffrigid.compiling import QUICK, compiled, uncollected
from diffrigid.convert import at_least_one
from diffrigid.state import State
from diffrigid.step import floats, rollout, step_length
from diffrigid.trajectory import Trajectory
from diffrigid.view.frames import record
from diffrigid.view.play import Player, play
from diffrigid.world import World, check

AHEAD = 0.05  # [-] of the range of a parameter: how far the linear prediction goes
FRAMES = 240  # times that are sent to the browser, at most


class Explorer:
    """Result of `explore`: a notebook shows it; `values` holds the numbers by name, `scene` the scene with them."""

    def __init__(
        self, world: World, state: State, ranges: Mapping[str, tuple[float, float]], *, dt: float, steps: int
    ) -> None:
        check(world, state)
        self._start = floats(world, state)
        step_length(dt, state)
        if not isinstance(ranges, Mapping) or not ranges:
            raise ValueError(f"ranges is {ranges!r}: expected a dict of parameters, {{'restitution': (0, 1)}}")
        self.ranges = {name: _range(name, span) for name, span in ranges.items()}
        run = partial(_with_slope, tuple(ranges), dt=dt, steps=at_least_one("steps", steps))
        self._run = uncollected(compiled(QUICK)(run))
        read = {name: paths.read(*self._start, name) for name in self.ranges}
        for name, value in read.items():
            if jnp.ndim(value):
                raise ValueError(f"{name} is not a number but has the shape {value.shape}: choose one, as '{name}[0]'")
        self.values = {name: float(value) for name, value in read.items()}
        for name, (low, high) in self.ranges.items():
            if not low <= self.values[name] <= high:
                raise ValueError(f"{name} is {self.values[name]:g}, outside its range ({low:g}, {high:g})")
        self.move(next(iter(self.ranges)), None)

    def move(self, name: str, value: float | None) -> None:
        """Set a parameter (None: leave its value), and show the linear prediction along it from now on.

        Raises:
            ValueError: there is no slider of this name.
        """
        if name not in self.ranges:
            raise ValueError(f"no slider {name!r}, there are {list(self.ranges)}")
        self.leading, (low, high) = name, self.ranges[name]
        self.values[name] = self.values[name] if value is None else float(np.clip(value, low, high))
        ahead = np.array([AHEAD * (high - low) * (other == name) for other in self.ranges])
        self.trajectory, self.slope = self._run(*self._start, np.array(list(self.values.values())), ahead)

    @property
    def scene(self) -> tuple[World, State]:
        """World and initial state with the values put in."""
        return self.trajectory.world, jax.tree.map(lambda leaf: leaf[0], self.trajectory.state)

    @property
    def widget(self) -> Any:
        """The sliders and the player; needs anywidget."""
        from diffrigid.view.widget import widget_of

        return widget_of(self)

    def unit(self, name: str) -> str:
        """SI unit of a parameter."""
        return paths.unit(self.trajectory.world, name)

    def sliders(self) -> list[dict[str, Any]]:
        """Name, range, value and unit of every slider."""
        return [
            {"name": name, "low": low, "high": high, "value": self.values[name], "unit": self.unit(name)}
            for name, (low, high) in self.ranges.items()
        ]

    def runs(self) -> dict[str, Trajectory]:
        """The motion, and its linear prediction under a name that says how far it goes."""
        low, high = self.ranges[self.leading]
        step = f"{AHEAD * (high - low):.3g} {self.unit(self.leading)}".strip()
        return {"motion": self.trajectory, f"its slope by {self.leading}, + {step}": self.slope}

    def sources(self) -> list[dict[str, Any]]:
        """Data that the player draws of both; contacts of the motion only."""
        return [record(run, name, None, FRAMES, run is self.trajectory) for name, run in self.runs().items()]

    def player(self) -> Player:
        """Player of both motions as they are now."""
        return play(self.runs(), frames=FRAMES, show=("trails", "contacts"), plot="")

    def _repr_mimebundle_(self, **options: Any) -> Any:
        """The widget, and, where no kernel runs, the motions as they were."""
        data, metadata = self.widget._repr_mimebundle_(**options)
        return data | {"text/html": self.player()._repr_html_()}, metadata


def explore(
    world: World, state: State, ranges: Mapping[str, tuple[float, float]], *, dt: float, steps: int
) -> Explorer:
    """Make sliders for parameters of a scene, beside the motion, which follows as they are dragged, and its slope.

    The slope is drawn as a second motion: the linear prediction of where bodies would be if the parameter moved last
    grew by a twentieth of its range. Where the two diverge, as at an impact that appears or vanishes, it fails.

    Args:
        ranges: lowest and highest value of each parameter by its path, "restitution", "ball.mass" or "ball.v[0]".
        dt: [s] length of a step. steps: number of steps.

    Returns:
        An `Explorer`, which a notebook shows (pip install "diffrigid[notebook]").

    Raises:
        ValueError: no such parameter, one that is not a number, or one that starts outside its range.

    Example:
        >>> dr.explore(world, state, {"restitution": (0, 1), "ball.v[1]": (-2, 2)}, dt=1 / 60, steps=30).values
        {'restitution': 0.8, 'ball.v[1]': 0.0}
    """
    return Explorer(world, state, ranges, dt=dt, steps=steps)


def _range(name: str, span: Any) -> tuple[float, float]:
    try:
        low, high = map(float, span)
    except (TypeError, ValueError):
        raise ValueError(f"ranges[{name!r}] is {span!r}: expected two numbers, (low, high)") from None
    if not (np.isfinite([low, high]).all() and low < high):
        raise ValueError(f"ranges[{name!r}] is ({low:g}, {high:g}): expected low < high, finite")
    return low, high


def _with_slope(
    names: tuple[str, ...], world: World, state: State, values: Array, ahead: Array, *, dt: float, steps: int
) -> tuple[Trajectory, Trajectory]:
    """The motion, and the motion plus its derivative along `ahead`."""

    def path(values: Array) -> Trajectory:
        changed = world, state
        for name, number in zip(names, values, strict=True):
            changed = paths.write(*changed, name, number)
        return rollout(*changed, dt=dt, steps=steps)

    dtype = state.x.dtype
    motion, slope = jax.jvp(path, (values.astype(dtype),), (ahead.astype(dtype),))
    moved: State = jax.tree.map(jnp.add, motion.state, slope.state)
    q = moved.q / jnp.sqrt((moved.q**2).sum(-1, keepdims=True))
    return motion, Trajectory(t=motion.t, state=State(x=moved.x, q=q, v=moved.v, w=moved.w), world=motion.world)
