"""The table of a fit: each number with its interval and unit, and notes on what the data cannot determine."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.catalogue import component, unit
from diffrigid.compiling import QUICK, compiled, uncollected
from diffrigid.paths import write
from diffrigid.state import State
from diffrigid.sysid.columns import Series
from diffrigid.sysid.covariance import LEAST_FREE, TINY, Linear, Uncertainty, joint_covariance, own_covariance
from diffrigid.sysid.diagnosis import (
    Blind,
    Coordinate,
    blind_directions,
    coordinates,
    correlations,
    doubts,
    infinite_where_blind,
    misjudged,
    weak,
)
from diffrigid.sysid.free import Free
from diffrigid.sysid.losses import Loss, Squares
from diffrigid.sysid.noise import exact_columns
from diffrigid.sysid.parameters import Slot, pieces, put, reference
from diffrigid.sysid.setup import Problem, first_value, noise_guesses, scene_having, scene_of
from diffrigid.sysid.summary import Parameter
from diffrigid.sysid.table import BLIND, BOUND, ENDED, FAILED, FLAT, STICKS
from diffrigid.world import World

UNSEEN = 1e-6  # [-] part of a slope along undetermined directions: more is not rounding
FAINT = 0.1  # [-] of a deviation: residuals that are all smaller do not make intervals too narrow, white or not
SCATTERED = 2.0  # [-] of the noise guessed from neighbouring rows: larger residuals, if no noise, are reported
OUTSTANDING = 2.0  # [-] of the median of the records: larger residuals are reported, where residuals are no noise
CLOSE = 0.95  # [-] correlation from which on two parameters are reported to go together


def describe(
    problem: Problem, shared: np.ndarray, own: np.ndarray, linear: Linear, uncertainty: Uncertainty,
    residuals: tuple[dict[str, np.ndarray], ...], loss: Loss, remarks: Sequence[str],
) -> tuple[tuple[Parameter, ...], tuple[str, ...]]:  # fmt: skip
    """Parameters with intervals, and the notes under the table, besides the `remarks` on the fit as a whole.

    Why not to believe them comes before what they say of single numbers.
    """
    lost = any(remark.startswith(FAILED) for remark in remarks)  # then slopes tell nothing of the measured motion
    blind = [] if lost else blind_directions(linear, coordinates_of(problem))
    found = tuple(_parameters(problem, shared, own, linear, uncertainty, blind))
    if lost:
        return tuple(map(without_interval, found)), tuple(_doubts(problem, linear, residuals, loss))
    parameters = tuple(
        _sticks(p, slot) if any(r.startswith(p.name + ENDED) for r in remarks) else p
        for p, slot in zip(found, problem.slots, strict=True)
    )
    ended = [p.name for p in parameters if p.note == BOUND]
    notes = _notes(problem, linear, uncertainty, blind, ended)
    return parameters, (*_doubts(problem, linear, residuals, loss), *notes)


def spanning(
    problem: Problem, parameters: Sequence[Parameter], shared: np.ndarray
) -> tuple[tuple[Parameter, ...], list[str]]:
    """Widen intervals to the values of all starts that fit as well, shared numbers (a, S), and say of which.

    An interval by slopes knows one motion only; another one, that sticks for instance, may fit as well.
    """
    out, notes = {p.name: p for p in parameters}, []
    for slot, rows in pieces(problem.shared):
        p = out[slot.name]
        if not isinstance(slot.kind, Free) or not np.isfinite(p.high - p.low).all():
            continue
        about = first_value(problem, slot)
        values = np.stack([np.asarray(slot.kind.value(z, about), float) for z in shared[rows].T])
        if component(slot.paths[0])[0].endswith(".angle"):  # a turn more is the same motion
            values = p.value + np.remainder(values - p.value + np.pi, 2 * np.pi) - np.pi
        low, high = values.min(0), values.max(0)
        if ((low < p.low) | (high > p.high)).any():
            out[slot.name] = replace(p, low=np.minimum(p.low, low), high=np.maximum(p.high, high))
            notes.append(f"{slot.name}: starts that fit as well ended elsewhere; its interval spans where they did")
    return tuple(out.values()), notes


def without_interval(p: Parameter) -> Parameter:
    """A number of a fit that failed, which may be anything."""
    return replace(p, low=np.full_like(p.low, -np.inf), high=np.full_like(p.high, np.inf))


def _parameters(
    problem: Problem, shared: np.ndarray, own: np.ndarray, linear: Linear, uncertainty: Uncertainty,
    blind: Sequence[Blind],
) -> Iterator[Parameter]:  # fmt: skip
    quantile, covariance = uncertainty.quantile, uncertainty.covariance
    for slot, rows in pieces(problem.shared):
        about, unseen = first_value(problem, slot), unseen_of(blind, rows)
        ends = interval_of(slot, shared[rows], covariance[rows, rows], about, quantile, unseen)
        yield Parameter(slot.name, *ends, unit_of(problem, slot), _note(slot, ends[0], blind))
    blocks = [own_covariance(linear, k, covariance) for k in range(len(problem.runs))] if problem.own else []
    for (slot, rows), (_, of_z) in zip(pieces(problem.own), pieces(problem.own, linear.shared), strict=True):
        unseen = unseen_of(blind, of_z)
        triples = [
            interval_of(slot, own[rows, k], blocks[k][rows, rows], reference(slot, scene_of(run)), quantile, unseen)
            for k, run in enumerate(problem.runs)
        ]
        value, low, high = (np.stack(parts) for parts in zip(*triples, strict=True))
        note = _note(slot, value, blind)
        yield Parameter(slot.name, value, low, high, unit_of(problem, slot), note, len(problem.runs))


def _sticks(p: Parameter, slot: Slot) -> Parameter:
    """A friction that ended where what slips begins to stick: it may be as large as its kind allows."""
    most = slot.kind.high if isinstance(slot.kind, Free) else np.inf
    return replace(p, high=np.full_like(p.high, most), note=STICKS)


def _notes(
    problem: Problem, linear: Linear, uncertainty: Uncertainty, blind: Sequence[Blind], ended: Sequence[str]
) -> list[str]:
    """What the data cannot determine."""
    notes, places = [b.words for b in blind], coordinates_of(problem)[: linear.shared]
    if uncertainty.freedom < linear.shared:
        degrees = "1 degree" if round(uncertainty.freedom) == 1 else f"{uncertainty.freedom:.0f} degrees"
        notes.append(f"{degrees} of freedom for {linear.shared} intervals: fit more records")
    notes += weak(infinite_where_blind(uncertainty.covariance, blind, slice(0, linear.shared)), places, ended)
    if ended:
        notes.append(
            f"{', '.join(ended)} ended at a bound, where the interval in the table says little: widen interval(low, "
            "high) if values beyond it are possible; if not, dr.profile gives an interval that ends there"
        )
    return notes + _together(uncertainty.covariance, places, blind)


def _is_flat(series: Sequence[Series], names: list[str]) -> bool:
    """Whether no column of these names changes."""
    values = [s.values[:, np.isfinite(s.values).any(0)] for s in series if s.name in names]
    return all((np.nanmax(v, axis=0) == np.nanmin(v, axis=0)).all() for v in values)


def _doubts(problem: Problem, linear: Linear, residuals: tuple[dict[str, np.ndarray], ...], loss: Loss) -> list[str]:
    """Why not to believe the intervals, as residuals show."""
    notes = []
    if exact := exact_columns(problem):
        names = ", ".join(exact)
        if all(_is_flat(run.series, exact) for run in problem.runs):
            notes.append(f"{FLAT}, and fitted exactly ({names}): by a body at rest, too; look whether it moves")
        notes.append(f"residuals of {names} are rounding, as for simulated data without noise: intervals mean nothing")
    tested = [column for record in residuals for name, column in record.items() if name not in exact]
    series = [r for column in tested for r in column.T if np.nanmax(np.abs(r), initial=0.0) > FAINT]
    lost = linear.shared + sum(s.shape[1] - linear.shared for s in linear.slopes)
    count = sum(map(len, linear.rows))
    given: dict[str, list[np.ndarray]] = {}
    for run, record in zip(problem.runs, residuals, strict=True):
        for name in run.noise:
            given.setdefault(name, []).append(record[name][np.isfinite(record[name])])
    columns = {name: r for name, parts in given.items() if len(r := np.concatenate(parts))}
    wrong = misjudged(columns, max(1.0 - lost / count, LEAST_FREE))  # then columns together are not normal in any case
    doubted = doubts(series, bool(wrong) or not isinstance(loss, Squares))
    return notes + wrong + doubted + [*_scattered(problem), *_worst(residuals)] * bool(doubted)


def _scattered(problem: Problem) -> list[str]:
    """Remark on columns whose residuals are much larger than what their neighbouring rows scatter."""
    guesses = noise_guesses(problem.runs)
    ratios = {name: sigma / guesses[name] for name, sigma in problem.noise.items()}
    words = [f"{ratio:.2g} times in {name}" for name, ratio in ratios.items() if ratio > SCATTERED]
    return [f"residuals are larger than neighbouring rows scatter: {', '.join(words)}"] if words else []


def _worst(residuals: Sequence[dict[str, np.ndarray]]) -> list[str]:
    """Remark on records whose residuals are much larger than those of most."""
    parts = [np.concatenate([column.ravel() for column in record.values()]) for record in residuals]
    sizes = np.array([np.sqrt(np.nanmean(part**2)) if np.isfinite(part).any() else np.nan for part in parts])
    most = np.nanmedian(sizes)
    worst = np.flatnonzero(sizes > OUTSTANDING * most)
    if not len(worst):
        return []
    named = ", ".join(f"{k} ({sizes[k] / most:.2g} times)" for k in worst[:3])
    return [f"residuals are larger than in most records in {named}{', ...' if len(worst) > 3 else ''}"]


def coordinates_of(problem: Problem) -> list[Coordinate]:
    """Coordinates of all numbers of z, in order."""
    return coordinates(problem.slots, [np.asarray(first_value(problem, slot)) for slot in problem.slots])


def number_names(problem: Problem) -> list[str]:
    """Names of the shared numbers of z, in order."""
    return [place.name for place in coordinates_of(problem)[: problem.sizes[0]]]


def _note(slot: Slot, value: np.ndarray, blind: Sequence[Blind]) -> str:
    if any(slot.name in b.names for b in blind):
        return BLIND
    return BOUND if slot.kind.at_bound(value) else ""


def unseen_of(blind: Sequence[Blind], rows: slice) -> np.ndarray:
    """Orthonormal basis (n, k), n directions, of the undetermined changes of k numbers of z."""
    parts = np.stack([np.zeros(rows.stop - rows.start), *(b.direction[rows] for b in blind)])
    parts = parts / np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), TINY)
    _, sizes, basis = np.linalg.svd(parts, full_matrices=False)
    return basis[sizes > UNSEEN]


def interval_of(
    slot: Slot, z: np.ndarray, covariance: np.ndarray, about: Any, quantile: float, unseen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, low and high end of its interval: by the map of z if it acts number by number, otherwise to first order.

    Infinite where a value changes along `unseen` (n, k); changes without these have an interval.
    """
    if isinstance(slot.kind, Free):
        deviation = np.where(np.abs(unseen).max(0, initial=0.0) > UNSEEN, np.inf, np.sqrt(np.diag(covariance)))
        ends = (z, z - quantile * deviation, z + quantile * deviation)
        with np.errstate(over="ignore"):  # of numbers that are hardly determined
            value, low, high = (np.asarray(slot.kind.value(end, about), float) for end in ends)
        return value, low, high
    centre = jnp.asarray(z, jnp.result_type(about))
    return _to_first_order(lambda z: slot.kind.value(z, about), centre, covariance, quantile, unseen)


def _to_first_order(
    fn: Callable[[Array], Any], z: Array, covariance: np.ndarray, quantile: float, unseen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value of fn(z), and low and high end of its interval, infinite where it changes along `unseen` (n, k)."""
    value, slope = (np.asarray(part, float) for part in (fn(z), jax.jacfwd(fn)(z)))
    along = slope @ unseen.T
    blind = np.linalg.norm(along, axis=-1) > UNSEEN * np.linalg.norm(slope, axis=-1)
    slope = slope - along @ unseen
    half = quantile * np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", slope, covariance, slope), 0.0))
    half = np.where(blind, np.inf, half)
    return value, np.asarray(value - half), np.asarray(value + half)


def derived(
    problem: Problem, shared: np.ndarray, own: np.ndarray, linear: Linear, uncertainty: Uncertainty,
    fn: Callable[[World, State], Any], record: int,
) -> Parameter:  # fmt: skip
    """What `fn` makes of the fitted scene of a record, with its interval by the delta method."""
    group = next(group for group in problem.groups if record in group.members)
    scene = scene_of(problem.runs[record])

    def of_numbers(z: Array) -> Array:
        fitted = put(group.plan.slots, scene, z)
        return jnp.asarray(fn(*write(fitted.world, fitted.state, "contact.width", problem.width)))

    numbers = jnp.asarray(np.concatenate([shared, own[:, record]]), problem.dtype)
    covariance = joint_covariance(linear, record, uncertainty.covariance)
    unseen = unseen_of(blind_directions(linear, coordinates_of(problem)), slice(0, len(numbers)))
    quick = uncollected(compiled(QUICK)(of_numbers))
    ends = _to_first_order(quick, numbers, covariance, uncertainty.quantile, unseen)
    return Parameter(getattr(fn, "__name__", type(fn).__name__), *ends, unit="", note="")


def unit_of(problem: Problem, slot: Slot) -> str:
    """SI unit of a parameter; for a column the user's, unless its name is that of a quantity, and it is not scaled."""
    path, scene = slot.paths[0], scene_having(problem, slot)
    if path in scene.written:
        return scene.written[path].unit
    column, _, field = component(path)[0].rpartition(".")
    if field == "bias" and np.all(np.asarray(scene.channels[column].scale) == 1):
        return unit(scene.world, column)
    return "s" if field == "clock" else unit(scene.world, path)


def _together(covariance: np.ndarray, places: Sequence[Coordinate], blind: Sequence[Blind]) -> list[str]:
    """Notes on pairs of shared numbers whose errors are correlated, except those not determined at all."""
    rho, out = correlations(covariance), []
    bad = {name for b in blind for name in b.names}
    for k, two in enumerate(places):
        for j, one in enumerate(places[:k]):
            if abs(r := rho[k, j]) > CLOSE and not {one.path, two.path} & bad:
                out.append((abs(r), f"{one.name} and {two.name} go together (correlation {r:.3f})"))
    return [text for _, text in sorted(out, reverse=True)[:3]]
