"""Design of experiments: the intervals that a planned record would give, and the launch that gives the narrowest."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffrigid.catalogue import component, unit
from diffrigid.controls import controlled
from diffrigid.convert import at_least_one
from diffrigid.spelling import nearest
from diffrigid.state import State
from diffrigid.sysid.channels import channel_of
from diffrigid.sysid.columns import as_floats, as_times, check_mapping
from diffrigid.sysid.covariance import Linear, from_jacobian
from diffrigid.sysid.diagnosis import Coordinate, blind_directions, infinite_where_blind
from diffrigid.sysid.free import Each, each
from diffrigid.sysid.intervals import coordinates_of, interval_of, unit_of, unseen_of
from diffrigid.sysid.levenberg import point_at
from diffrigid.sysid.losses import Squares
from diffrigid.sysid.parameters import Scene, make_slots, pieces, put, reference, written_by
from diffrigid.sysid.points import linear_of
from diffrigid.sysid.records import Record
from diffrigid.sysid.setup import Problem, first_numbers, first_value, make_problem, make_starts, scene_of
from diffrigid.sysid.summary import Parameter
from diffrigid.sysid.table import rows_of
from diffrigid.tables import lined_up
from diffrigid.world import World, check

EXPECTED = ("parameter", "value", "expected 95 % interval", "unit")
NUDGE = 1e-3  # change of z for differences
UNDETERMINED = 1e6  # score where a number has no interval: finite, so that differences of scores are
FIRST_STEP = 0.3  # of u, from every start
SHRINK, GROW = 0.5, 1.5  # factor on the length of a step that loses, or gains


@dataclass(frozen=True)
class Launch:
    """A planned record: its scene, the values of its launch, and the intervals that it would give."""

    world: World
    state: State
    values: dict[str, np.ndarray]  # of the varied parameters, by name
    edges: tuple[str, ...]  # of them, those that ended at a bound of their interval
    parameters: tuple[Parameter, ...]  # at their present values, with the interval to expect
    score: float  # mean logarithm of the standard deviations of z; -1 is intervals e times as narrow

    def __repr__(self) -> str:
        launch = [
            (
                name + "".join(f"[{k}]" for k in index),
                f"{value[index]:.4g}",
                unit(self.world, name.split(" ")[0]) or "-",
                "at a bound" if name in self.edges else "",
            )
            for name, value in self.values.items()
            for index in np.ndindex(value.shape)
        ]
        expected = [row[:4] for parameter in self.parameters for row in rows_of(parameter)]
        return "\n".join([*lined_up(("launch", "value", "unit", ""), launch), "", *lined_up(EXPECTED, expected)])


def expected_intervals(
    world: World, state: State, planned: Mapping[str, Any], *, free: Mapping[Any, Any], noise: Mapping[str, float],
    observe: Mapping[str, Any] | None = None, dt: float | None = None,
) -> tuple[Parameter, ...]:  # fmt: skip
    """Intervals that a record would give if the world were as it is given: the Cramer-Rao bound.

    Args:
        planned: "t" and the columns, with None for values, or NaN where nothing will be measured.
        noise: standard deviation of every column.

    Raises:
        ValueError: no times, or a planned column without noise; what `fit` does not take.

    Example:
        >>> planned = {"t": np.linspace(0.0, 1.0, 11), "ball.x": None}
        >>> one = {"spring.stiffness": dr.positive()}
        >>> (told,) = dr.sysid.expected_intervals(made, start, planned, free=one, noise={"ball.x": 1e-3})
        >>> round(float(told.high - told.low), 3)  # [N/m]
        0.039
    """
    problem = _problem([(world, state)], planned, free, noise, observe, dt)
    linear, (z, _), out = _linear(problem), first_numbers(problem), []
    uncertainty, blind = from_jacobian(linear), blind_directions(linear, coordinates_of(problem))
    for slot, rows in pieces(problem.shared):
        about, unseen = first_value(problem, slot), unseen_of(blind, rows)
        ends = interval_of(slot, z[rows], uncertainty.covariance[rows, rows], about, uncertainty.quantile, unseen)
        out.append(Parameter(slot.name, *ends, unit_of(problem, slot), "expected"))
    return tuple(out)


def blind_spots(
    world: World, state: State, observations: Any, *, free: Mapping[Any, Any], noise: Mapping[str, Any] | None = None,
    observe: Mapping[str, Any] | None = None, dt: float | None = None,
) -> tuple[str, ...]:  # fmt: skip
    """Say what these observations cannot determine, before any fit, at the values of the scene. Arguments of `fit`.

    Raises:
        ValueError: what `fit` does not take.

    Example:
        >>> made, start = dr.scene({"ball": ball}, forces={"spring": spring})
        >>> seen = {"t": np.linspace(0.0, 1.0, 11), "ball.x": np.zeros((11, 2))}  # values do not matter
        >>> both = {"ball.mass": dr.positive(), "spring.stiffness": dr.positive()}
        >>> dr.sysid.blind_spots(made, start, seen, free=both)
        ('only the ratio ball.mass / spring.stiffness is seen',)
    """
    problem = make_problem(world, state, observations, free=free, noise=noise, observe=observe, dt=dt, begin=False)
    return tuple(blind.words for blind in blind_directions(_linear(problem), coordinates_of(problem)))


def best_launch(
    world: World, state: State, planned: Mapping[str, Any], *, free: Mapping[Any, Any], noise: Mapping[str, float],
    vary: Mapping[Any, Any], target: str | None = None, starts: int = 8, steps: int = 20, seed: int = 0,
    observe: Mapping[str, Any] | None = None, dt: float | None = None,
) -> Launch:  # fmt: skip
    """The launch whose record would give the narrowest intervals, by gradients from several starts.

    Args:
        vary: what can be chosen of the initial state or the world, as `free`: {"ball.v": interval(-3, 3)}. A parameter
            may be both varied and free, such as the velocity of a launch by hand: it is planned, but still has to be
            fitted.
        target: the free parameter to learn, while the others are unknown too; default all of them (D-optimal).
        starts: the first is the launch of `state`, the others are random.
        steps: along the gradient, of each start.
        seed: of the random starts.

    The gradient of the information comes from central differences of exact Jacobians, all launches in one batch.

    Raises:
        ValueError: the target is not free; starts or steps < 1; what `expected_intervals` does not take.
    """
    starts, steps = at_least_one("starts", starts), at_least_one("steps", steps)
    plan = partial(_problem, planned=planned, noise=noise, observe=observe, dt=dt)
    first_launch = plan([(world, state)], free=free)
    scene, shared, rows = scene_of(first_launch.runs[0]), first_launch.sizes[0], _rows_of(first_launch, target)
    scene = scene._replace(written=written_by(vary, scene.state.x.dtype))
    slots = [slot for some in make_slots(vary, [scene]) for slot in some]
    about = [np.asarray(reference(slot, scene)) for slot in slots]
    of_each = sorted(free.items(), key=lambda item: isinstance(item[1], Each))  # launches share nothing
    own = {key: kind if isinstance(kind, Each) else each(kind) for key, kind in of_each}
    count, random = sum(slot.size for slot in slots), np.random.default_rng(seed)

    def launched(u: np.ndarray) -> Scene:
        return put(slots, scene, jnp.asarray(u, scene.state.x.dtype))

    def scores(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scores of launches u (starts, count), and their gradients."""
        shifts = np.concatenate([np.zeros((1, count)), NUDGE * np.eye(count), -NUDGE * np.eye(count)])
        points = (u[:, None] + shifts[None]).reshape(-1, count)
        problem = plan([launched(point)[:2] for point in points], free=own)
        places = coordinates_of(problem)
        value = np.array([_score(linear, places, rows) for linear in _linears(problem, shared)]).reshape(starts, -1)
        return value[:, 0], (value[:, 1 : count + 1] - value[:, count + 1 :]) / (2 * NUDGE)

    drawn = [[slot.kind.draw(a, random) for slot, a in zip(slots, about, strict=True)] for _ in range(starts - 1)]
    first = [slot.kind.unbounded(a) for slot, a in zip(slots, about, strict=True)]
    u, score = _descended(scores, np.stack([np.concatenate(parts) for parts in (first, *drawn)]), steps)
    best = launched(u)
    values = {slot.name: np.asarray(reference(slot, best)) for slot in slots}
    found = expected_intervals(best.world, best.state, planned, free=free, noise=noise, observe=observe, dt=dt)
    edges = tuple(slot.name for slot in slots if slot.kind.at_bound(values[slot.name]))
    return Launch(best.world, best.state, values, edges, found, score)


def _descended(scores: Callable, u: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
    """Descend from the starts u (S, n) along the gradient, each by steps of its own length: the best u, its score."""
    length = np.full(len(u), FIRST_STEP)
    value, slope = scores(u)
    for _ in range(steps):
        size = np.sqrt((slope**2).sum(1, keepdims=True))
        trial = u - length[:, None] * slope / np.maximum(size, 1e-12)
        new, new_slope = scores(trial)
        better = new < value
        u, slope = np.where(better[:, None], trial, u), np.where(better[:, None], new_slope, slope)
        value, length = np.where(better, new, value), length * np.where(better, GROW, SHRINK)
    return u[np.argmin(value)], float(value.min())


def _problem(scenes: Sequence[tuple[World, State]], planned, free, noise, observe, dt) -> Problem:
    """The problem of planned records, one of each scene."""
    world, state = scenes[0]
    check(world, state)
    for where, given in (("planned", planned), ("noise", noise), ("observe", observe)):
        check_mapping(where, given)
    if "t" not in (planned or {}):
        raise ValueError(f'planned is {planned!r:.80}: expected a dict with a column "t" of times [s]')
    t, acting, observe = as_times(planned["t"], 'planned["t"]'), controlled(world.forces), observe or {}
    columns = {name: values for name, values in planned.items() if name == "t" or name in acting}
    kept, wholes = set(), {name: _whole(name, observe) for name in planned if name not in columns}
    for name, whole in wholes.items():
        if not {name, whole} & (noise or {}).keys():
            raise ValueError(f"noise: expected a standard deviation for every planned column, {whole!r} has none")
        values = _zeros(world, name, planned[name], len(t), observe)
        if np.isfinite(values).any():  # otherwise nothing will be measured
            columns[name] = values
            kept.add(whole)
    gone = set(wholes.values()) - kept
    noise, observe = (
        {name: v for name, v in given.items() if not {name, component(name)[0]} & gone}
        for given in (noise or {}, observe)
    )
    records = [Record(columns, state=s, world=w) for w, s in scenes]
    return make_problem(world, state, records, free=free, noise=noise, observe=observe, dt=dt)


def _whole(name: str, observe: Mapping[str, Any]) -> str:
    """Name of the column that a planned one is, or is a component of."""
    return name if name in observe else component(name)[0]


def _zeros(world: World, name: str, values: Any, rows: int, observe: Mapping[str, Any]) -> np.ndarray:
    """Values of a planned column: zeros, NaN where nothing will be measured; as for all rows if they are None."""
    if values is not None:
        return np.where(np.isfinite(as_floats(values, f"planned[{name!r}]")), 0.0, np.nan)
    whole = _whole(name, observe)
    size = channel_of(whole, observe.get(whole, whole), world).bias.shape[0]
    return np.zeros((rows, size) if whole == name else rows)


def _linear(problem: Problem) -> Linear:
    return linear_of(problem, point_at(problem.groups, make_starts(problem, 1, 0)), 0, Squares(), False)


def _linears(problem: Problem, shared: int) -> list[Linear]:
    """Linearisation of each record alone, the first numbers of which count as shared."""
    linear = _linear(problem)
    rows = zip(linear.rows, linear.slopes, linear.times, strict=True)
    return [Linear((r,), (J,), (t,), shared, 1.0, False) for r, J, t in rows]


def _rows_of(problem: Problem, target: str | None) -> slice:
    """Rows of the shared numbers that are to be learnt."""
    if target is None:
        return slice(0, problem.sizes[0])
    rows = {slot.name: rows for slot, rows in pieces(problem.shared)}
    if target not in rows:
        raise ValueError(f"target: {target!r} is not free, {nearest(target, rows)}")
    return rows[target]


def _score(linear: Linear, places: Sequence[Coordinate], rows: slice) -> float:
    """Mean logarithm of the standard deviations along the axes of the ellipsoid; large where one is infinite."""
    blind = blind_directions(linear, places)
    covariance = infinite_where_blind(from_jacobian(linear).covariance, blind, slice(0, linear.shared))
    covariance = covariance[rows, rows]
    if not np.isfinite(covariance).all():
        return UNDETERMINED
    sign, logarithm = np.linalg.slogdet(covariance)
    return float(0.5 * logarithm / len(covariance)) if sign > 0 and np.isfinite(logarithm) else UNDETERMINED
