"""How well a fit predicts records that it did not see."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from diffrigid.convert import at_least_one
from diffrigid.sysid.first_rows import is_begun
from diffrigid.sysid.lead_in import is_suspect, ways_in
from diffrigid.sysid.levenberg import INTERRUPTED, Numbers, Point, best_by_record, better_by_record, levenberg
from diffrigid.sysid.losses import Loss
from diffrigid.sysid.points import by_column
from diffrigid.sysid.problem import shaped_like
from diffrigid.sysid.records import runs, same_data
from diffrigid.sysid.setup import Problem, make_problem, make_starts, reach_of, with_noise

if TYPE_CHECKING:
    from diffrigid.sysid.result import Fit

SCORE_ITERATIONS = 30  # iterations for the own numbers of a record that was held out
COPIES = 16  # records of a fit up to which those of a score are repeated, so that nothing is compiled
POOR = 3.0  # [-] times the noise of the fit: scores beyond which a start that was not the record's own is doubted


def scored(fit: "Fit", observations: Any, starts: int, seed: int) -> dict[str, float]:
    """Root mean square of the residuals of records by column, in its unit; see `Fit.score`."""
    starts = at_least_one("starts", starts)
    free, observe = fit.problem.free, fit.problem.observe
    held_out = runs(fit.world, fit.state, observations, observe, None)
    fitted = [[k for k, run in enumerate(fit.problem.runs) if same_data(run, other)] for other in held_out]
    records = list(observations) if isinstance(observations, list | tuple) else [observations]
    # As many records as were fitted, and padded like them: then what is compiled for the fit serves here.
    extra = max(len(fit.problem.runs) - len(records), 0) if len(fit.problem.runs) <= COPIES else 0
    problem = make_problem(
        fit.world, fit.state, [*records, *records[-1:] * extra], free=free, observe=observe, resume=fit.summary,
        dt=fit.problem.dt, places=[found[0] if found else None for found in [*fitted, *fitted[-1:] * extra]],
    )  # fmt: skip
    problem = with_noise(problem, {name: fit.noise.get(name, s) for name, s in problem.noise.items()})
    groups = shaped_like(problem.groups, fit.problem.groups, fit.problem.dt)
    problem = replace(problem, groups=tuple(groups))
    z, reach = make_starts(problem, starts, seed), reach_of(problem, range(problem.sizes[0]))
    z = z._replace(shared=jnp.repeat(z.shared[:, :1], starts, axis=1))
    iterations = SCORE_ITERATIONS if problem.own else 0
    point, early = levenberg(problem.groups, z, fit.loss, iterations, reach)
    if problem.own and early != INTERRUPTED and is_suspect(problem, point, fit.loss):
        point = _led_in(problem, fit.loss, z, point, reach)
    best = best_by_record(problem.groups, point, fit.loss)
    found = [by_column(problem, point, start, in_units=True)[k] for k, start in enumerate(best[: len(held_out)])]
    names = dict.fromkeys(name for columns in found for name in columns)
    values = {name: np.concatenate([columns[name].ravel() for columns in found if name in columns]) for name in names}
    sizes = {name: float(np.sqrt(np.nanmean(residuals**2))) for name, residuals in values.items()}
    own_runs = problem.runs[: len(held_out)]
    borrowed = [k for k, run in enumerate(own_runs) if not (fitted[k] or is_begun(run, problem.own))]
    late = [] if problem.own else [k for k, run in enumerate(own_runs) if not (fitted[k] or run.stated)]
    _warn_of_starts(fit, sizes, borrowed, late)
    return sizes


def _led_in(problem: Problem, loss: Loss, start: Numbers, point: Point, reach: Numbers) -> Point:
    """What windows that grow from the start of each record find where a fit of the whole is in a local minimum."""
    members = tuple(group.members for group in problem.groups)
    for way in ways_in(problem):
        z = start
        for window in way:
            groups = with_noise(problem, problem.noise, window).groups
            found, early = levenberg(groups, z, loss, SCORE_ITERATIONS, reach)
            if early == INTERRUPTED:  # its residuals are of a part
                return point
            z = found.z
        point = better_by_record(loss, members, point, found)
        if not is_suspect(problem, point, loss):
            break
    return point


def _warn_of_starts(fit: "Fit", sizes: dict[str, float], borrowed: list[int], late: list[int]) -> None:
    """Warn if a score is poor where records began at the state of the first record of the fit, perhaps too late."""
    ratios = {name: size / fit.noise.get(name, np.inf) for name, size in sizes.items()}
    worst = max(ratios, key=lambda name: ratios[name])
    if not (borrowed or late) or ratios[worst] <= POOR:
        return
    if borrowed:
        how = (
            f"record {borrowed[0]} began at the fitted state of record 0 of the fit, as its first rows do not show "
            "one: give it a first guess, dr.Record(..., state=first), or more starts"
        )
    else:
        how = (
            f"record {late[0]} began at the fitted start, at its first row; if that is later, give "
            "dr.Record(..., start=0.0), with the time of the start"
        )
    size = f"{ratios[worst]:.2g} times the noise of the fit"
    warnings.warn(f"score: residuals of {worst} are {size}, but {how}", stacklevel=4)
