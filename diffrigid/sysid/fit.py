"""`fit`: parameters of a world and its initial state from measured columns, with 95 % intervals."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffrigid.paths import read, unit, write
from diffrigid.state import State
from diffrigid.step import Trajectory, _substeps, aligned, floats, rollout, scan_steps
from diffrigid.sysid.free import Free
from diffrigid.sysid.levenberg import Progress, cost, least_squares
from diffrigid.sysid.residuals import columns, noise_guess
from diffrigid.sysid.table import html_table, text_table
from diffrigid.world import World, check

Z95 = 1.959964  # two-sided 95 % quantile of the normal distribution


@dataclass(frozen=True)
class Parameter:
    """One fitted number, or vector."""

    name: str
    value: np.ndarray
    low: np.ndarray  # 95 % interval
    high: np.ndarray
    unit: str
    note: str  # "" or why not to trust it


@dataclass(frozen=True)
class Fit:
    """Result of `fit`: `world` and `state` with the parameters put in, and what is known of them."""

    parameters: tuple[Parameter, ...]
    world: World
    state: State
    t: np.ndarray  # (T+1,) [s] measured times
    noise: dict[str, float]  # standard deviation of each column's residuals, in its unit
    costs: np.ndarray  # (starts,) half the weighted sum of squares, lowest first; inf: diverged
    agree: int  # starts that ended at the best cost
    covariance: np.ndarray  # of the unbounded parameters z
    substeps: tuple[int, ...]  # steps of each interval of t
    seconds: float

    @cached_property
    def trajectory(self) -> Trajectory:
        """The fitted motion at the measured times."""
        return rollout(self.world, self.state, dt=float(np.diff(self.t).max()), times=self.t, substeps=self.substeps)

    def __getitem__(self, name: str) -> Parameter:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"no parameter {name!r}; there are {[p.name for p in self.parameters]}")

    def __repr__(self) -> str:
        return text_table(self)

    def _repr_html_(self) -> str:
        return html_table(self)


def fit(
    world: World,
    state: State,
    observations: Mapping[str, Any],
    *,
    free: Mapping[str | tuple[str, ...], Free],
    starts: int = 1,
    dt: float | None = None,
    noise: Mapping[str, float] | None = None,
    widths: Sequence[float] = (0.0,),
    iterations: int = 60,
    seed: int = 0,
    progress: bool | None = None,
) -> Fit:
    """Fit parameters to a record by least squares, from several starts in one batch.

    Args:
        observations: "t" [s] and columns "body.x", "body.v", "body.angle", "body.q", "body.w"; NaN is missing.
            t[0] is the time of `state`.
        free: what may vary: a path (see `diffrigid.paths`), or a tuple of paths that share one value.
        starts: the first is at the values of `world` and `state`, the others are random.
        dt: [s] longest step; default the median of the intervals of t.
        noise: standard deviation of each column, in its unit; default: estimated from the residuals.
        widths: [m] of the smooth impacts, one fit after the other, each from the last: (0.5, 0.1, 0.0) lets
            starts that miss an impact find it.
        seed: of the random starts.
        progress: print a line as it goes; default: if the output is a terminal or a notebook.

    Raises:
        ValueError: unknown names, wrong shapes, or a parameter that nothing measured depends on.
    """
    began = time.time()
    check(world, state)
    world, state = floats(world, state)
    t, measured = columns(world, observations)
    problem = _Problem.of(world, state, t, measured, dict(free), dt)
    z = problem.starts(starts, np.random.default_rng(seed))
    sigma = np.array([(noise or {}).get(column.name, noise_guess(column)) for column in measured])
    report, result = _printer(progress, starts), None  # type: Any, Any
    for width in widths:
        # Twice if the noise is estimated: with the guess, then with what the residuals say.
        for again in range(1 if noise is not None or width != widths[-1] else 2):
            if again:
                sigma = problem.noise(result, sigma)
            data = (world, state, jnp.asarray(1.0 / sigma, state.x.dtype), jnp.asarray(width, state.x.dtype))
            result = least_squares(problem.residuals, z, data, iterations, report)
            z = np.asarray(result.z)
    report(-1, result)
    return problem.result(result, sigma, noise is None, began)


class _Problem:
    """The maps z -> parameters -> world -> residuals, with all that does not change."""

    def __init__(self, world, state, t, measured, free, counts):
        self.world, self.state, self.t, self.measured = world, state, t, measured
        self.free, self.counts = free, counts
        self.paths = [(path,) if isinstance(path, str) else tuple(path) for path in free]
        self.shapes = [np.shape(read(world, state, path[0])) for path in self.paths]
        self.known = [column.known for column in measured]

    @classmethod
    def of(cls, world, state, t, measured, free, dt) -> "_Problem":
        if not free:
            raise ValueError('free: nothing to fit; give paths, for example {"restitution": interval(0, 1)}')
        for path, kind in free.items():
            if not isinstance(kind, Free):
                raise ValueError(f"free[{path!r}]: expected interval(low, high), positive() or real(), got {kind!r}")
        dt = float(np.median(np.diff(t))) if dt is None else dt
        return cls(world, state, t, measured, free, _substeps(jnp.asarray(t), jnp.asarray(dt)))

    def split(self, z):
        """z (n, ...) in pieces of the parameters' shapes."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])
        pieces = np.split(z, ends[:-1]) if isinstance(z, np.ndarray) else jnp.split(z, ends[:-1])
        return [piece.reshape(shape) for piece, shape in zip(pieces, self.shapes, strict=True)]

    def put(self, world, state, z):
        """World and state with the parameters of one start, z (n,)."""
        for paths, kind, piece in zip(self.paths, self.free.values(), self.split(z), strict=True):
            for path in paths:
                world, state = write(world, state, path, kind.value(piece))
        return world, state

    def starts(self, count: int, random: np.random.Generator) -> np.ndarray:
        """z of every start, (n, S)."""
        values = [np.asarray(read(self.world, self.state, paths[0]), float) for paths in self.paths]
        kinds = list(self.free.values())
        first = [kind.unbounded(value).ravel() for kind, value in zip(kinds, values, strict=True)]
        others = [
            [kind.draw(value, random).ravel() for kind, value in zip(kinds, values, strict=True)]
            for _ in range(count - 1)
        ]
        z = np.stack([np.concatenate(start) for start in [first, *others]], axis=1)
        return z.astype(self.state.x.dtype)

    def simulate(self, world, state):
        """States at the measured times, (T+1, N, ..., *batch)."""
        intervals = jnp.asarray(np.diff(self.t), state.x.dtype)
        return scan_steps(*aligned(world, state), intervals, None, self.counts)

    def residuals(self, z, data):
        """Weighted residuals of S starts, (m, S)."""
        world, state, weights, width = data
        world, state = write(world, state, "contact.width", width)
        world, state = jax.vmap(lambda z: self.put(world, state, z), in_axes=-1, out_axes=-1)(z)
        states = self.simulate(world, state)
        parts = []
        for index, (column, known) in enumerate(zip(self.measured, self.known, strict=True)):
            difference = column.predicted_minus_measured(states)
            parts.append(weights[index] * difference[np.nonzero(known)])
        return jnp.concatenate(parts)

    def noise(self, result: Progress, sigma: np.ndarray) -> np.ndarray:
        """Standard deviation of every column's residuals at the best start."""
        best = np.asarray(result.residuals)[:, int(np.argmin(cost(result)))]
        ends = np.cumsum([known.sum() for known in self.known])
        pieces = np.split(best, ends[:-1])
        lost = result.z.shape[0] / len(best)
        rms = [np.sqrt(np.mean(piece**2) / max(1.0 - lost, 0.05)) if piece.size else 1.0 for piece in pieces]
        return np.maximum(sigma * np.array(rms), 1e-9)

    def result(self, progress: Progress, sigma: np.ndarray, estimated: bool, began: float) -> Fit:
        costs = np.asarray(cost(progress), float)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best = int(np.argmin(costs))
        z, jac = np.asarray(progress.z)[:, best], np.asarray(progress.jacobian, float)[:, :, best]
        self._refuse_blind(jac)
        dof = max(jac.shape[0] - jac.shape[1], 1)
        scale = 2.0 * costs[best] / dof if estimated else 1.0
        covariance = scale * np.linalg.pinv(jac.T @ jac, rcond=1e-12)
        world, state = jax.jit(self.put)(self.world, self.state, jnp.asarray(z))
        names = [column.name for column in self.measured]
        return Fit(
            parameters=self.parameters(z, np.sqrt(np.diag(covariance))),
            world=world,
            state=state,
            t=self.t,
            substeps=self.counts,
            noise=dict(zip(names, sigma.tolist(), strict=True)),
            costs=np.sort(costs),
            agree=int((costs <= costs[best] + 0.5 + 1e-3 * costs[best]).sum()),
            covariance=covariance,
            seconds=time.time() - began,
        )

    def parameters(self, z: np.ndarray, error: np.ndarray) -> tuple[Parameter, ...]:
        out = []
        rows = zip(self.paths, self.free.values(), self.split(z), self.split(error), strict=True)
        for paths, kind, centre, spread in rows:
            value, low, high = np.asarray(kind.value(np.stack([centre + k * spread for k in (0.0, -Z95, Z95)])))
            name = " = ".join(paths)
            note = "at its bound" if kind.at_bound(value) else ""
            out.append(Parameter(name=name, value=value, low=low, high=high, unit=unit(paths[0]), note=note))
        return tuple(out)

    def _refuse_blind(self, jac: np.ndarray) -> None:
        """A parameter that no residual depends on is an error, not a number with an infinite interval."""
        norms = self.split(np.sqrt((jac**2).sum(0)))
        for paths, norm in zip(self.paths, norms, strict=True):
            if not np.any(norm > 0):
                raise ValueError(
                    f"free: nothing that was measured depends on {' = '.join(paths)} at the best fit: "
                    "leave it out, or give a record with an impact that shows it"
                )


def _printer(progress: bool | None, starts: int) -> Callable[[int, Progress], None]:
    """Prints the iteration and the best cost, over one line."""
    if progress is None:
        progress = sys.stdout.isatty() or "ipykernel" in sys.modules

    def report(count: int, result: Progress) -> None:
        if progress:
            best = float(np.min(cost(result)))
            end = "\n" if count < 0 else "\r"
            label = "done" if count < 0 else f"iteration {count:3d}"
            print(f"fit: {label}, {starts} starts, best cost {best:.6g}      ", end=end, flush=True)

    return report
