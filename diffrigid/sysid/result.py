"""The result of a fit, and what can be asked of it: predictions, scores, other intervals, a report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from diffrigid.pytree import Vector
from diffrigid.state import State
from diffrigid.sysid.covariance import Intervals, Linear, Uncertainty, check_intervals
from diffrigid.sysid.diagnosis import correlations
from diffrigid.sysid.intervals import derived, describe, spanning, without_interval
from diffrigid.sysid.losses import Loss, Squares
from diffrigid.sysid.orders import Orders
from diffrigid.sysid.parameters import Scene
from diffrigid.sysid.records import SAME_TIME
from diffrigid.sysid.score import scored
from diffrigid.sysid.setup import Problem
from diffrigid.sysid.summary import Parameter, Summary
from diffrigid.sysid.table import FAILED, summary_html, summary_text
from diffrigid.sysid.times import all_times, motion
from diffrigid.trajectory import Trajectory
from diffrigid.world import World


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
    loss: Loss
    remarks: tuple[str, ...]  # those of `notes` that do not depend on the intervals
    motions: tuple[Trajectory, ...]  # of the first three records, at their measured times

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Fitted parameters with 95 % intervals, first those that all records share, then those of each record."""
        return self.summary.parameters

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the noise of each column, in its unit, estimated or the median of the given one."""
        return self.summary.noise

    @property
    def costs(self) -> np.ndarray:
        """Loss of all residuals [-] at the end of every start, (starts,), lowest first; inf where it diverged."""
        return self.summary.costs

    @property
    def aic(self) -> float:
        """Akaike's criterion, by which of two models of the same records that with the smaller value predicts better.

        2 k - 2 log L, with k the number of fitted numbers, including those of the noise, and L the likelihood. `costs`
        cannot compare models where the noise is estimated: each is then in units of its own residuals.

        Raises:
            ValueError: the loss is not that of normal noise.
        """
        if not isinstance(self.loss, Squares):
            raise ValueError(f"aic: expected a fit by least squares, got {self.loss!r}")
        fitted, total = self.shared.size + self.own.size + len(self.problem.noise), 0.0
        for run, columns in zip(self.problem.runs, self.residuals, strict=True):
            for name, r in columns.items():
                sigma = np.asarray(run.noise.get(name, self.problem.noise.get(name, np.nan)))
                sigma = sigma[:, None] if sigma.ndim == 1 and len(sigma) == len(r) else sigma
                total += float(np.nansum(r**2 + np.log(2 * np.pi * sigma**2) * np.where(np.isfinite(r), 1.0, np.nan)))
        return 2 * fitted + total

    @property
    def agree(self) -> int:
        """Number of starts that ended at the lowest cost, or near it."""
        return self.summary.agree

    @property
    def orders(self) -> Orders:
        """Pairs that strike, in order, for each of the best 64 starts, and for each of the first three records."""
        return self.summary.orders

    @property
    def notes(self) -> tuple[str, ...]:
        """What the data cannot determine, and why not to believe the intervals; the lines with "!" under the table."""
        return self.summary.notes

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why not to believe any of the numbers, in the first words of such `notes`: "the fit failed", "not converged",
        "the cost jumps", "what was measured is constant", "the steps are too long", "residuals are autocorrelated"; ()
        if there is none."""
        return self.summary.doubts

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

    def predict(self, times: Vector | None = None, record: int = 0, dt: float | None = None) -> Trajectory:
        """Fitted motion of a record from its start on.

        Args:
            times: [s] increasing, the first at or after the start of the record; default its measured times.
            dt: [s] longest step; default that of the fit.

        Raises:
            ValueError: times begin before the record; there is no such record.
        """
        scene, run = self.scenes[checked_record(self, record)], self.problem.runs[record]
        if times is None and dt is None and record < len(self.motions):
            return self.motions[record]
        wanted = all_times(run) if times is None else np.asarray(times, float)
        if wanted.ndim != 1 or not len(wanted) or wanted[0] < run.start - SAME_TIME or not (np.diff(wanted) > 0).all():
            given = f"times has shape {wanted.shape}" + (f" and begins at {wanted.flat[0]:g} s" if wanted.size else "")
            raise ValueError(
                f"{given}: expected increasing times from {run.start:g} s on, where record {record} starts"
            )
        return motion(scene, run, wanted, self.problem.dt if dt is None else dt)

    def score(self, observations: Any, starts: int = 1, seed: int = 0) -> dict[str, float]:
        """Root mean square of the residuals of other records by column, in its unit, with the shared numbers held.

        Parameters that each record has of its own are fitted anew, by growing windows where a fit of all rows fails.
        The first start is the `state` of the record if it has one, otherwise the state that its first rows show, if
        that is free by `each`, otherwise (with a warning if the score is poor) the fitted state of record 0. A record
        that was part of the fit starts from its fitted values. The motion starts at the first row: a later part of a
        record is `Record(data, start=...)`.

        Args:
            observations: one record or several, as `fit` takes them.
            starts: number of starts, from which the best is taken.
            seed: of the draw of the starts after the first.

        Raises:
            ValueError: starts < 1; observations that `fit` would not take.
        """
        return scored(self, observations, starts, seed)

    def derived(self, fn: Callable[[World, State], Any], record: int = 0) -> Parameter:
        """A number, or an array, that follows from the fitted scene of a record, with its 95 % interval.

        The interval is symmetric, to first order in the errors of the fit, and uses the covariance and quantile of
        those in the table (also after `with_intervals`). It is infinite where the data do not determine the number,
        and after a fit that failed. Its `note` says why not to trust it, if the fit as a whole is doubtful.

        Args:
            fn: of the world and the initial state, in operations of JAX.
            record: the one whose scene is used, if records have numbers of their own.

        Raises:
            ValueError: there is no such record.

        Example:
            >>> lost = found.derived(lambda world, state: 1.0 - dr.paths.read(world, state, "restitution") ** 2)
            >>> bool(lost.low < 1.0 - 0.8**2 < lost.high)  # share of the energy that an impact takes
            True
        """
        found = derived(
            self.problem, self.shared, self.own, self.linear, self.uncertainty, fn, checked_record(self, record)
        )
        return replace(without_interval(found) if FAILED in self.doubts else found, note="; ".join(self.doubts))

    def with_intervals(self, intervals: Intervals) -> "Fit":
        """The same fit with intervals by another function: from_jacobian, sandwich, bootstrap.

        Raises:
            ValueError: intervals is not a function.
        """
        check_intervals(intervals)
        uncertainty = intervals(self.linear)
        parameters, notes = describe(
            self.problem, self.shared, self.own, self.linear, uncertainty, self.residuals, self.loss, self.remarks
        )
        parameters, spans = spanning(self.problem, parameters, self.starts[:, : self.summary.agree])
        summary = replace(self.summary, parameters=parameters, notes=(*self.remarks, *spans, *notes))
        return replace(self, summary=summary, uncertainty=uncertainty)

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table, a dictionary for each number: parameter, value, low, high, unit, note; unrounded.

        Example:
            >>> [(row["parameter"], row["unit"]) for row in found.rows()]  # pandas.DataFrame(found.rows()).to_latex()
            [('restitution', '')]
        """
        return self.summary.rows()

    def save(self, path: str | Path) -> Path:
        """Write what is in the table, with versions and seed, as JSON."""
        return self.summary.save(path)

    def report(self, path: str | Path, title: str = "A fit", profiles: Sequence[str] = ()) -> Path:
        """Write one HTML file that opens offline: the table, what the data cannot tell, the motion, and residuals.

        Args:
            profiles: shared numbers whose profile likelihood is drawn, each some more fits.

        Raises:
            ValueError: no such shared number to profile.
        """
        from diffrigid.view import fit_report  # points down, so that a result draws itself

        return fit_report.report(self, path, title, profiles)

    def __getitem__(self, name: str) -> Parameter:
        return self.summary[name]

    def __repr__(self) -> str:
        return summary_text(self.summary)

    def _repr_html_(self) -> str:
        return summary_html(self.summary)


def checked_fit(fit: Any, what: str) -> Fit:
    """The fit, which `what` needs; a ValueError if it is something else, or only its table."""
    if isinstance(fit, Summary):
        raise ValueError(f"{what}: expected a Fit; what load_fit read is its table only: dr.fit(..., resume=saved)")
    if not isinstance(fit, Fit):
        raise ValueError(f"{what}: expected a Fit, got {fit!r:.80}")
    return fit


def checked_record(fit: Fit, record: int) -> int:
    """The number of a record of the fit; a ValueError if there is no such one."""
    if record not in range(len(fit.scenes)):
        raise ValueError(f"record is {record!r}: expected 0 to {len(fit.scenes) - 1}")
    return record
