"""`fit`: parameters of a world and its initial state from measured columns, with 95 % intervals."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from diffrigid.catalogue import component
from diffrigid.convert import at_least_one, numbers
from diffrigid.state import State
from diffrigid.sysid.charts import Chart
from diffrigid.sysid.columns import check_mapping
from diffrigid.sysid.covariance import Intervals, Linear, check_intervals, from_jacobian
from diffrigid.sysid.free import Each, Free, Prior, Through
from diffrigid.sysid.intervals import describe, spanning
from diffrigid.sysid.lead_in import better, is_suspect, unseen_until, ways_in
from diffrigid.sysid.levenberg import INTERRUPTED, Numbers, Point, cost_of, levenberg, point_at
from diffrigid.sysid.losses import Loss, Squares
from diffrigid.sysid.noise import all_noise, estimated_noise, rescaled
from diffrigid.sysid.orders import impact_orders
from diffrigid.sysid.parameters import pieces
from diffrigid.sysid.points import by_column, linear_of
from diffrigid.sysid.remarks import beside_a_jump, failed, remarks_on, sticking
from diffrigid.sysid.result import Fit
from diffrigid.sysid.setup import Problem, fitted_scenes, make_problem, make_starts, reach_of, with_noise
from diffrigid.sysid.step_check import too_long
from diffrigid.sysid.summary import Summary, versions
from diffrigid.sysid.table import CORRELATED, FAILED
from diffrigid.world import World

SQUARES = Squares()
NOT_SMALL = 0.1  # [-] of the spread of a column: larger residuals that are not noise are named before a blind parameter
SILENCE = 30.0  # [s] after which a line is printed where nobody watches
LINE = 80  # characters of a line of progress, so that one covers the one before
AGREES, AGREES_RELATIVE = 0.5, 1e-3  # of the loss, and of the best: a start within their sum agrees with the best


def fit(
    world: World,
    state: State,
    observations: Any,
    *,
    free: Mapping[str | tuple[str, ...], Free | Chart | Each | Prior | Through],
    starts: int = 1,
    dt: float | None = None,
    noise: Mapping[str, Any] | None = None,
    observe: Mapping[str, Any] | None = None,
    widths: Sequence[float] | None = None,
    windows: Sequence[float] | None = None,
    loss: Loss = SQUARES,
    solver: Callable | None = None,
    intervals: Intervals = from_jacobian,
    iterations: int | None = None,
    seed: int = 0,
    resume: Fit | Summary | None = None,
    progress: bool | None = None,
) -> Fit:
    """Fit parameters to records by least squares, from several starts in one batch.

    Args:
        observations: "t" [s] and columns "body.x", "body.v", "body.angle", "body.q", "body.w", arrays of K rows, or a
            table or CSV file with columns "t", "body.x[0]", ...; NaN is missing. A column, or a component, with times
            of its own is a pair (t, values). The first time is that of `state`. A column with the name of a `control`
            of a force is that control, each value held until the next. A list of such observations, or of `Record`, is
            fitted together.
        free: what may vary: a path (see `diffrigid.paths` and `diffrigid.sysid.sensors`), or a tuple of paths that
            share one value. `each(kind)` gives every record its own, which begins as its first rows show it;
            `through(write, kind, start)` is a number that sets several.
        starts: the first is at the values of `world` and `state`, the others are random.
        dt: [s] longest step; default 1.1 times the median of the intervals of t, but no more than 0.02 s where bodies
            touch, have joints, or forces vary.
        noise: standard deviation of each column or component, in its unit, a number or an array like it; noise that is
            not given is estimated from the residuals.
        observe: what a column observes if its name does not say so: {"tip": Marker("rod", point=(0.3, 0))};
            None leaves it out.
        widths: [m] of the smooth impacts, one fit after the other, each from the last: (0.5, 0.1, 0.0) lets starts that
            miss an impact find it. Default: the width of the world, 0 unless set.
        windows: [s] of each record from its start, one fit after the other: (0.5, 1, 2, inf) leads into a long one.
            Default: (inf,), and if residuals are left that are not noise, windows that end before the columns jump
            in their slope, and others in eighths of the longest record; each start keeps the best result. (inf,) alone
            leaves that out.
        loss: `diffrigid.sysid.squares()`, `dr.huber()` or `dr.student()`.
        solver: default Levenberg-Marquardt; for many numbers `diffrigid.sysid.first_order(optax.adam(1e-2))` or
            `diffrigid.sysid.lbfgs()`.
        intervals: `diffrigid.sysid.from_jacobian`, `dr.sandwich` or `dr.bootstrap`.
        iterations: at most, for each width and window; default 60, for other solvers the number they were made
            with. A fit that has not converged by then says so.
        seed: of the random starts.
        resume: an earlier Fit, or the result of `load_fit`: the first start is there.
        progress: print a line as it goes; default: where the output is a terminal or a notebook, elsewhere one to the
            standard error each half minute.

    Interrupting it returns the best so far.

    Raises:
        ValueError: unknown names, wrong shapes, or a parameter that nothing measured depends on.

    Example:
        >>> noise = np.random.default_rng(0).normal(size=(31, 2))
        >>> measured = {"t": np.asarray(trajectory.t), "ball.x": np.asarray(trajectory.state.x[:, 0]) + 1e-3 * noise}
        >>> guess, start = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), restitution=0.3)
        >>> found = dr.fit(guess, start, measured, free={"restitution": dr.interval(0, 1)}, progress=False)
        >>> round(float(found["restitution"].value), 2), round(found.noise["ball.x"], 4)
        (0.8, 0.0009)
    """
    began = time.time()
    at_least_one("starts", starts)
    if iterations is not None:
        at_least_one("iterations", iterations)
    _check_parts(loss, solver, intervals, seed, resume)
    check_mapping("observe", observe)
    problem = make_problem(world, state, observations, free=free, observe=observe, noise=noise, dt=dt, resume=resume)
    if resume is not None and not {p.name for p in resume.parameters} & {slot.name for slot in problem.slots}:
        theirs = ", ".join(p.name for p in resume.parameters)
        raise ValueError(f"resume is a fit of {theirs}: expected one of some of what is free here")
    stages = _stages((problem.width,) if widths is None else widths, (np.inf,) if windows is None else windows)
    if world.crowd and any(width > 0 for width, _ in stages):
        raise ValueError(f"widths is {widths!r}: expected (0.0,) for so many bodies; use fewer")
    solve = levenberg if solver is None else solver
    z, reach = make_starts(problem, starts, seed), reach_of(problem)
    report = _printer(progress, starts)

    def through(
        problem: Problem, z: Numbers, stages: Sequence[tuple[float, Any]], held: Sequence[int] = ()
    ) -> tuple[Problem, Point, str]:
        """Fits one after the other, in the first of them without the shared numbers that are held."""
        most = reach_of(problem, held)
        for width, window in stages:
            problem = with_noise(problem, problem.noise, window, width)
            point, early = solve(problem.groups, z, loss, iterations, most, partial(report, _stage(width, window)))
            z, most = point.z, reach
            if early == INTERRUPTED:
                break
        return problem, point, early

    problem, point, early = through(problem, z, stages)
    leads_in = windows is None and solver is None and early != INTERRUPTED and is_suspect(problem, point, loss)
    for way in ways_in(problem) if leads_in else ():
        held = unseen_until(problem, z, 0.5 * np.min(way[0]))
        _, other, early = through(problem, z, [(problem.width, window) for window in way], held)
        point = point if early == INTERRUPTED else better(loss, point, other)
        if early == INTERRUPTED or not is_suspect(problem, point, loss):
            break
    if early != INTERRUPTED and (problem.noise or leads_in):  # with the estimate of the noise from the residuals
        problem = with_noise(problem, estimated_noise(problem, point, loss))
        problem, point, early = through(problem, point.z, stages[-1:])
    report("", -1, np.asarray(cost_of(loss, point.residuals)))
    return finish(problem, point, loss, intervals, seed, began, [early] if early else [])


def _stages(widths: Sequence[float], windows: Sequence[float]) -> list[tuple[float, float]]:
    """(width, window) of the successive fits."""
    wide, long = _lengths("widths", widths, "[m], the last one usually 0"), _lengths("windows", windows, "[s]")
    if not (long > 0).all() or (np.diff(long) <= 0).any():
        raise ValueError(f"windows is {windows!r}, expected increasing times > 0 [s], the last one usually inf")
    return [(width, long[0]) for width in wide] + [(wide[-1], window) for window in long[1:]]


def _lengths(name: str, values: Any, unit: str) -> np.ndarray:
    """Check and convert numbers >= 0, (n,); times may be inf."""
    array = np.asarray(numbers(name, values, None, finite=name == "widths"))
    if array.ndim != 1 or not array.size or not (array >= 0).all():
        raise ValueError(f"{name} is {values!r}, expected a sequence of numbers >= 0 {unit}")
    return array


def _check_parts(loss: Any, solver: Any, intervals: Any, seed: Any, resume: Any) -> None:
    if isinstance(loss, type) or not hasattr(loss, "rho"):
        raise ValueError(f"loss is {loss!r}, expected squares(), huber() or student()")
    if solver is not None and (not callable(solver) or isinstance(solver, type)):
        raise ValueError(f"solver is {solver!r}, expected None, first_order(optax.adam(1e-2)) or lbfgs()")
    check_intervals(intervals)
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed is {seed!r}, expected an integer >= 0")
    if resume is not None and not isinstance(resume, Fit | Summary):
        raise ValueError(f"resume is a {type(resume).__name__}, expected a Fit, or what load_fit read")


def finish(
    problem: Problem, point: Point, loss: Loss, intervals: Intervals, seed: int, began: float, remarks: list[str]
) -> Fit:
    """Make the result at the best start, with noise estimated from the residuals."""
    if problem.noise:
        noise = estimated_noise(problem, point, loss)
        point, problem = rescaled(problem, point, noise), with_noise(problem, noise)
    costs = np.asarray(cost_of(loss, point.residuals), float)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        raise ValueError("fit: no start gives a finite motion: look at the values of the scene, or make dt smaller")
    order, alike = np.argsort(costs), costs <= costs[best] + AGREES + AGREES_RELATIVE * costs[best]
    orders, motions = impact_orders(problem, point.z.sorted(order), int(np.isfinite(costs).sum()))
    linear = linear_of(problem, point, best, loss, bool(problem.noise))
    in_units, strikes = by_column(problem, point, best, in_units=True), any(orders[0])
    _refuse_blind(problem, linear, in_units, strikes)
    shared, own = np.asarray(point.z.shared, float)[:, best], np.asarray(point.z.own, float)[..., best]
    uncertainty = intervals(linear)
    scenes = tuple(fitted_scenes(problem, shared, own))
    residuals = tuple(by_column(problem, point, best))
    stuck = sticking(problem, point, best, linear, uncertainty.covariance)
    if jump := beside_a_jump(problem, point, best, linear, loss):
        remarks = [*jump, *(remark for remark in remarks if remark == INTERRUPTED)]
    remarks = [*remarks, *remarks_on(problem, scenes, in_units, strikes), *stuck]
    parameters, notes = describe(problem, shared, own, linear, uncertainty, residuals, loss, remarks)
    if not any(remark.startswith(FAILED) for remark in remarks):
        correlated = any(note.startswith(CORRELATED) for note in notes)
        remarks = [*remarks, *too_long(problem, point, best, linear, uncertainty, correlated)]
    parameters, spans = spanning(problem, parameters, np.asarray(point.z.shared, float)[:, alike])
    summary = Summary(
        parameters=parameters, noise=all_noise(problem), costs=costs[order], orders=orders, agree=int(alike.sum()),
        notes=(*remarks, *spans, *notes), seed=seed, seconds=time.time() - began, versions=versions(),
    )  # fmt: skip
    return Fit(
        summary, problem, scenes, shared, own, linear, uncertainty, residuals,
        np.asarray(point.z.shared, float)[:, order], loss, tuple(remarks), motions,
    )  # fmt: skip


def _refuse_blind(problem: Problem, linear: Linear, residuals: Sequence[dict[str, np.ndarray]], strikes: bool) -> None:
    """Raise ValueError for a parameter that no residual depends on, at the best fit and at the first start.

    Where the fit failed, that comes first: a motion far from the measured one says nothing about what is seen.
    """
    seen = _seen(problem, linear)
    if not all(seen.values()):
        begun = point_at(problem.groups, make_starts(problem, 1, 0))
        began = _seen(problem, linear_of(problem, begun, 0, SQUARES, False))
    for slot in problem.slots:
        if not (seen[slot.name] or began[slot.name]):
            blind = f"nothing that was measured depends on {slot.name} at the best fit"
            if failure := failed(problem, residuals, strikes, NOT_SMALL):
                raise ValueError(f"{failure}. Besides, {blind}: begin it elsewhere")
            raise ValueError(f"free: {blind}: leave it out, or {_shown_by(slot.paths[0])}")


def _shown_by(path: str) -> str:
    """What a record needs to show a parameter."""
    field = component(path)[0].rpartition(".")[2]
    if field == "restitution":
        return "give a record with an impact; if there is one, begin where the simulation has it too"
    if field.endswith("friction"):
        return (
            "give a record in which something slips, or rolls; if it does, begin with less friction, so that it does "
            "in the simulation too, or from several starts"
        )
    if field in ("mass", "density"):
        return "give a record in which the body strikes, pushes or pulls one of known mass, or a known force acts on it"
    return "give a record that shows it; if one does, begin elsewhere, or from several starts"


def _seen(problem: Problem, linear: Linear) -> dict[str, bool]:
    """Whether any residual depends on a parameter."""
    sizes = sum((slopes**2).sum(0) for slopes in linear.slopes)
    return {slot.name: bool(np.any(sizes[rows] > 0)) for slot, rows in pieces(problem.slots)}


def _stage(width: float, window: Any) -> str:
    """What a stage of a fit is of, for the line of progress."""
    first = float(np.min(window))
    wide, long = f", {width:.3g} m wide", f", the first {first:.3g} s"
    return (wide if width > 0 else "") + (long if first < np.inf else "")


def _printer(progress: bool | None, starts: int) -> Callable[[str, int, np.ndarray], None]:
    """Make a function that prints the iteration of a stage and the best cost.

    Over one line; by default, where the output is neither a terminal nor a notebook, a line of long fits now and then.
    """
    watched = progress or (progress is None and (sys.stdout.isatty() or "ipykernel" in sys.modules))
    printed = time.monotonic()

    def report(stage: str, count: int, costs: np.ndarray) -> None:
        nonlocal printed
        label = "done" if count < 0 else f"iteration {count:3d}{stage}"
        line = f"fit: {label}, {starts} starts, best cost {float(np.min(costs)):.6g}"
        if watched:
            print(f"{line:<{LINE}}", end="\n" if count < 0 else "\r", flush=True)
        elif progress is None and time.monotonic() - printed > SILENCE:
            print(line, file=sys.stderr, flush=True)
            printed = time.monotonic()

    return report
