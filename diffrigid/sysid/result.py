"""The result of a fit: numbers with intervals, notes on them, and functions of the result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

from diffrigid.paths import component, unit
from diffrigid.state import State
from diffrigid.sysid.covariance import Intervals, Linear, Uncertainty, own_covariance
from diffrigid.sysid.diagnosis import (
    Blind,
    blind_directions,
    coordinates,
    correlations,
    doubts,
    infinite_where_blind,
    weak,
)
from diffrigid.sysid.free import Free
from diffrigid.sysid.levenberg import best_by_record, levenberg
from diffrigid.sysid.losses import Squares
from diffrigid.sysid.orders import Orders
from diffrigid.sysid.parameters import Scene, Slot, reference
from diffrigid.sysid.points import by_column
from diffrigid.sysid.records import SAME, runs, same_data
from diffrigid.sysid.setup import (
    Problem,
    make_problem,
    make_starts,
    reach_of,
    scene_having,
    scene_of,
    with_noise,
)
from diffrigid.sysid.summary import Parameter, Summary
from diffrigid.sysid.table import BLIND, html_table, text_table
from diffrigid.sysid.times import all_times, motion
from diffrigid.trajectory import Trajectory
from diffrigid.world import World

SCORED = 30  # iterations for the own numbers of a record that was held out
UNSEEN = 1e-6  # [-] part of a slope along undetermined directions: more is not rounding
CLOSE = 0.95  # [-] correlation from which on two parameters are reported to go together


@dataclass(frozen=True)
class Fit:
    """Result of `fit`.

    Example:
        >>> bool(found["restitution"].low < 0.8 < found["restitution"].high), found.agree  # starts that ended there
        (True, 1)
        >>> round(found.score(measured)["ball.x"], 4)  # better on a record that was held out
        0.0009
    """

    summary: Summary
    problem: Problem
    scenes: tuple[Scene, ...]  # of every record, with the parameters written in
    shared: np.ndarray  # (a,) z of the shared numbers
    own: np.ndarray  # (b, R) z of those of each record
    linear: Linear
    uncertainty: Uncertainty  # of the shared numbers z
    residuals: tuple[dict[str, np.ndarray], ...]  # of each record by column, (K, size), in standard deviations
    starts: np.ndarray  # (a, starts) z of the shared numbers where every start ended, the best first, as `costs`
    loss: Any
    remarks: tuple[str, ...]  # those of `notes` that do not depend on the intervals

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.summary.parameters

    @property
    def noise(self) -> dict[str, float]:
        return self.summary.noise

    @property
    def costs(self) -> np.ndarray:
        return self.summary.costs

    @property
    def agree(self) -> int:
        return self.summary.agree

    @property
    def orders(self) -> Orders:
        """Pairs that strike, in order, for each start, the best first, and for each of the first three records."""
        return self.summary.orders

    @property
    def notes(self) -> tuple[str, ...]:
        return self.summary.notes

    @property
    def world(self) -> World:
        """Fitted world of the first record."""
        return self.scenes[0].world

    @property
    def state(self) -> State:
        """Fitted initial state of the first record."""
        return self.scenes[0].state

    @property
    def t(self) -> np.ndarray:
        """Times (T+1,) [s] of the first record, from its start on."""
        return all_times(self.problem.runs[0])

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the shared unbounded numbers z, (a, a)."""
        return self.uncertainty.covariance

    @property
    def correlation(self) -> np.ndarray:
        """Correlations of the shared numbers, (a, a)."""
        return correlations(self.uncertainty.covariance)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The fitted motion of the first record at its measured times."""
        return self.predict()

    def predict(self, times: Any = None, record: int = 0, dt: float | None = None) -> Trajectory:
        """Fitted motion of a record from its start on.

        Args:
            times: [s] increasing, the first at or after the start of the record; default its measured times.
            dt: [s] longest step; default that of the fit.

        Raises:
            ValueError: times begin before the record.
        """
        scene, run = self.scenes[record], self.problem.runs[record]
        wanted = all_times(run) if times is None else np.asarray(times, float)
        if wanted.ndim != 1 or not len(wanted) or wanted[0] < run.start - SAME or not (np.diff(wanted) > 0).all():
            given = f"times has shape {wanted.shape}" + (f" and begins at {wanted.flat[0]:g} s" if wanted.size else "")
            raise ValueError(
                f"{given}: expected increasing times from {run.start:g} s on, where record {record} starts"
            )
        return motion(scene, run, wanted, self.problem.dt if dt is None else dt)

    def score(self, observations: Any, starts: int = 1, seed: int = 0) -> dict[str, float]:
        """Root mean square of the residuals of other records by column, in its unit, with the shared numbers held.

        Numbers that each record has for itself are fitted anew, from several starts if asked for, the first from its
        state, by default that of the first record of the fit; for a record that was fitted, from the values found.
        """
        free, observe = self.problem.free, self.problem.observe
        scored = runs(self.world, self.state, observations, observe, None)
        fitted = [[k for k, run in enumerate(self.problem.runs) if same_data(run, other)] for other in scored]
        problem = make_problem(
            self.world, self.state, observations, free=free, observe=observe, resume=self.summary,
            dt=self.problem.dt, places=[found[0] if found else None for found in fitted],
        )  # fmt: skip
        problem = with_noise(problem, {name: self.noise.get(name, s) for name, s in problem.noise.items()})
        z, reach = make_starts(problem, starts, seed), reach_of(problem, range(problem.sizes[0]))
        z = z._replace(shared=jnp.repeat(z.shared[:, :1], starts, axis=1))
        iterations = SCORED if problem.own else 0
        point, _ = levenberg(problem.groups, z, self.loss, iterations, reach, lambda count, costs: None)
        best = best_by_record(problem.groups, point, self.loss)
        found = [by_column(problem, point, start, in_units=True)[k] for k, start in enumerate(best)]
        names = dict.fromkeys(name for columns in found for name in columns)
        values = {
            name: np.concatenate([columns[name].ravel() for columns in found if name in columns]) for name in names
        }
        return {name: float(np.sqrt(np.nanmean(residuals**2))) for name, residuals in values.items()}

    def with_intervals(self, intervals: Intervals) -> "Fit":
        """The same fit with intervals by another function: from_jacobian, sandwich, bootstrap."""
        uncertainty = intervals(self.linear)
        parameters, notes = describe(
            self.problem, self.shared, self.own, self.linear, uncertainty, self.residuals, self.loss
        )
        summary = replace(self.summary, parameters=parameters, notes=(*self.remarks, *notes))
        return replace(self, summary=summary, uncertainty=uncertainty)

    def save(self, path: str | Path) -> Path:
        """Write what is in the table, with versions and seed, as JSON."""
        return self.summary.save(path)

    def report(self, path: str | Path, title: str = "A fit", profiles: Sequence[str] = ()) -> Path:
        """Write one HTML file that opens offline: the table, what the data cannot tell, the motion, and residuals.

        Args:
            profiles: shared numbers whose profile likelihood is drawn, each some more fits.
        """
        from diffrigid.view import fit_report  # points down, so that a result draws itself

        return fit_report.report(self, path, title, profiles)

    def __getitem__(self, name: str) -> Parameter:
        return self.summary[name]

    def __repr__(self) -> str:
        return text_table(self.summary)

    def _repr_html_(self) -> str:
        return html_table(self.summary)


# ---- intervals and notes


def describe(
    problem: Problem, shared: np.ndarray, own: np.ndarray, linear: Linear, uncertainty: Uncertainty,
    residuals: tuple[dict[str, np.ndarray], ...], loss: Any,
) -> tuple[tuple[Parameter, ...], tuple[str, ...]]:  # fmt: skip
    """Parameters with intervals, and the notes under the table."""
    places = coordinates((*problem.shared, *problem.own), references(problem))
    blind = blind_directions(linear, places)
    quantile = float(stdtrit(uncertainty.freedom, 0.975))
    covariance = infinite_where_blind(uncertainty.covariance, blind, slice(0, linear.shared))
    parameters = [
        _shared_parameter(problem, slot, shared[rows], uncertainty.covariance[rows, rows], quantile, blind, rows)
        for slot, rows in pieces(problem.shared)
    ]
    if problem.own:
        blocks = [own_covariance(linear, k, uncertainty.covariance) for k in range(len(problem.runs))]
        parameters += _own_parameters(problem, own, blocks, quantile, blind, linear.shared)
    notes = [b.words for b in blind]
    if uncertainty.freedom < linear.shared:
        notes.append(f"{uncertainty.freedom:.0f} degrees of freedom for {linear.shared} intervals: fit more records")
    notes += weak(covariance, places[: linear.shared])
    notes += _together(uncertainty.covariance, places[: linear.shared], blind)
    series = [column[:, k] for record in residuals for column in record.values() for k in range(column.shape[1])]
    series = [r for r in series if np.isfinite(r).any()]
    given = all(name in run.noise for run in problem.runs for name in run.channels)
    lost = linear.shared + sum(s.shape[1] - linear.shared for s in linear.slopes)
    count = sum(map(len, linear.rows))
    notes += doubts(series, max(1.0 - lost / count, 0.05) if given else None, not isinstance(loss, Squares))
    return tuple(parameters), tuple(notes)


def references(problem: Problem) -> list[np.ndarray]:
    """Value of each parameter in the scene of the first record that has it."""
    return [np.asarray(reference(slot, scene_having(problem, slot))) for slot in (*problem.shared, *problem.own)]


def number_names(problem: Problem) -> list[str]:
    """Names of the shared numbers of z, in order."""
    return [place.name for place in coordinates(problem.shared, references(problem)[: len(problem.shared)])]


def pieces(slots: tuple[Slot, ...], first: int = 0) -> list[tuple[Slot, slice]]:
    """Slices of z that belong to each parameter, from `first` on."""
    ends = np.cumsum([first, *(slot.size for slot in slots)])
    return [(slot, slice(*pair)) for slot, *pair in zip(slots, ends[:-1], ends[1:], strict=True)]


def _shared_parameter(
    problem: Problem, slot: Slot, z: np.ndarray, covariance: np.ndarray, quantile: float, blind: Sequence[Blind],
    rows: slice,
) -> Parameter:  # fmt: skip
    about = reference(slot, scene_having(problem, slot))
    value, low, high = interval_of(slot, z, covariance, about, quantile, unseen_of(blind, rows))
    return Parameter(slot.name, value, low, high, unit_of(problem, slot), _note(slot, value, blind))


def _own_parameters(
    problem: Problem, own: np.ndarray, blocks: list[np.ndarray], quantile: float, blind: Sequence[Blind], shared: int
):
    for (slot, rows), (_, of_z) in zip(pieces(problem.own), pieces(problem.own, shared), strict=True):
        unseen = unseen_of(blind, of_z)
        triples = [
            interval_of(slot, own[rows, k], blocks[k][rows, rows], reference(slot, scene_of(run)), quantile, unseen)
            for k, run in enumerate(problem.runs)
        ]
        value, low, high = (np.stack(parts) for parts in zip(*triples, strict=True))
        note = _note(slot, value, blind)
        yield Parameter(slot.name, value, low, high, unit_of(problem, slot), note, len(problem.runs))


def _note(slot: Slot, value: np.ndarray, blind: Sequence[Blind]) -> str:
    if any(slot.name in b.names for b in blind):
        return BLIND
    return "at its bound" if slot.kind.at_bound(value) else ""


def unseen_of(blind: Sequence[Blind], rows: slice) -> np.ndarray:
    """Orthonormal basis (n, k), n directions, of the undetermined changes of k numbers of z."""
    parts = np.stack([np.zeros(rows.stop - rows.start), *(b.direction[rows] for b in blind)])
    parts = parts / np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), 1e-300)
    _, sizes, basis = np.linalg.svd(parts, full_matrices=False)
    return basis[sizes > UNSEEN]


def interval_of(
    slot: Slot, z: np.ndarray, covariance: np.ndarray, about: Any, quantile: float, unseen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, and low and high end of its interval: by the map of z where it acts number by number, else to first order.

    Infinite where a value changes along `unseen` (n, k); changes without these have an interval.
    """
    if isinstance(slot.kind, Free):
        deviation = np.where(np.abs(unseen).max(0, initial=0.0) > UNSEEN, np.inf, np.sqrt(np.diag(covariance)))
        ends = (z, z - quantile * deviation, z + quantile * deviation)
        with np.errstate(over="ignore"):  # of numbers that are hardly determined
            value, low, high = (np.asarray(slot.kind.value(end, about), float) for end in ends)
        return value, low, high
    centre = jnp.asarray(z, jnp.result_type(about))
    value = np.asarray(slot.kind.value(centre, about), float)
    slope = np.asarray(jax.jacfwd(slot.kind.value)(centre, about), float)
    along = slope @ unseen.T
    blind = np.linalg.norm(along, axis=-1) > UNSEEN * np.linalg.norm(slope, axis=-1)
    slope = slope - along @ unseen
    half = quantile * np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", slope, covariance, slope), 0.0))
    half = np.where(blind, np.inf, half)
    return value, value - half, value + half


def unit_of(problem: Problem, slot: Slot) -> str:
    """SI unit of a parameter; for a column the user's, unless its name is that of a quantity, and it is not scaled."""
    path, scene = slot.paths[0], scene_having(problem, slot)
    column, _, field = component(path)[0].rpartition(".")
    if field == "bias" and np.all(np.asarray(scene.channels[column].scale) == 1):
        return unit(scene.world, column)
    return "s" if field == "clock" else unit(scene.world, path)


def _together(covariance: np.ndarray, places, blind) -> list[str]:
    """Notes on pairs of shared numbers whose errors are correlated, except those not determined at all."""
    rho, out = correlations(covariance), []
    bad = {name for b in blind for name in b.names}
    for i, first in enumerate(places):
        for j in range(i):
            if abs(rho[i, j]) > CLOSE and first.path not in bad and places[j].path not in bad:
                out.append(
                    (abs(rho[i, j]), f"{places[j].name} and {first.name} go together (correlation {rho[i, j]:.3f})")
                )
    return [text for _, text in sorted(out, reverse=True)[:3]]
