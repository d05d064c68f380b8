"""Multiple shooting: a long record cut into short ones, each with an initial state of its own.

Over a short time the motion depends almost linearly on its start; over many impacts it does not, and a fit from a poor
start fails. The numbers that all pieces share are found first, with `each` for their states; then a fit of the whole
record with growing `windows` starts from there, and ends in one motion without jumps. `fit_in_pieces` does both, or by
hand:

    pieces = segments(world, state, observations, 8)
    own = {"ball.x": each(real()), "ball.v": each(real())}
    first = fit(world, state, pieces, free={"restitution": interval(0, 1), **own})
    jumps(first)  # how far the end of a piece is from where the next begins
    whole = fit(first.world, first.state, observations, free=..., windows=(0.5, 1, 2, inf))

Source: Bock 1981, multiple shooting for parameter identification.
"""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from diffrigid import paths
from diffrigid.catalogue import component
from diffrigid.convert import at_least_one
from diffrigid.state import State, rotations
from diffrigid.sysid.charts import rotation
from diffrigid.sysid.columns import columns
from diffrigid.sysid.covariance import TINY
from diffrigid.sysid.first_rows import shown, with_values
from diffrigid.sysid.fit import fit
from diffrigid.sysid.free import Each, each, real
from diffrigid.sysid.records import SAME_TIME, Record
from diffrigid.sysid.result import Fit, checked_fit
from diffrigid.sysid.sensors import Part
from diffrigid.sysid.times import motion
from diffrigid.world import World, check

LOST = 1.5  # [-] times the noise in pieces: residuals of the whole record beyond which it is reported as lost


def segments(world: World, state: State, observations: Any, count: int) -> list[Record]:
    """Cut a record into pieces of equal duration, each of which begins as its first rows show it, the first one too.

    That holds for measured positions, angles and orientations and their velocities; the others are those of `state`.

    Args:
        observations: as of `fit`, one record, whose columns are named for what they observe.

    Raises:
        ValueError: columns that `fit` does not take; count < 1, or a piece with fewer than two rows of a column.

    Example:
        >>> [piece.start for piece in dr.segments(world, state, measured, 3)]
        [0.0, 0.16666666666666666, 0.3333333333333333]
    """
    check(world, state)
    at_least_one("count", count)
    series, channels, controls = columns(world, observations, {})
    if count > max(len(s.t) for s in series):
        raise ValueError(f"count is {count}: expected at most as many segments as there are times")
    first, last = min(s.t[0] for s in series), max(s.t[-1] for s in series)
    edges = np.linspace(first, last, count + 1)
    out = []
    for start, end in itertools.pairwise(edges):
        start = max(s.t[s.t <= start + SAME_TIME][-1] for s in series if (s.t <= start + SAME_TIME).any())
        use = {s.name: (s.t >= start - SAME_TIME) & (s.t <= end + SAME_TIME) for s in series}
        if few := [name for name, rows in use.items() if rows.sum() < 2]:
            raise ValueError(
                f"count is {count}: rows of {few[0]!r} from {start:g} to {end:g} s: {use[few[0]].sum()}, expected two "
                "or more in each segment; use fewer"
            )
        pieces = {s.name: (s.t[use[s.name]], s.values[use[s.name]]) for s in series}
        pieces |= {c.name: (c.t, c.values) for c in controls}
        own = with_values(world, state, shown(world, series, channels, start))
        out.append(Record(pieces, state=own, start=float(start)))
    return out


def fit_in_pieces(
    world: World, state: State, observations: Any, count: int, *, free: Mapping[Any, Any], starts: int = 1,
    **options: Any,
) -> Fit:  # fmt: skip
    """Fit a long record through `count` pieces of it: first each with a state of its own, then all as one motion.

    The result is that of the whole record from its start: one motion. Its first note says how far the ends of the
    pieces were from where the next began, and another if the whole motion does not fit as its pieces did.

    Args:
        observations: of one record, its columns named for what they observe: "ball.x" of every body, which then has a
            position and a velocity in each piece; "ball.angle" or "ball.q" likewise. Spins that are not measured begin
            in each piece as in `state`.
        free: of the whole record, the initial state among it.
        starts: of the fit in pieces; the whole record is fitted from the best.
        options: others of `fit`, except `windows`, which grow with the pieces, `observe` and `resume`.

    Raises:
        ValueError: a body whose position is not a column; one of those options.
    """
    if taken := {"windows", "observe", "resume"} & set(options):
        raise ValueError(f"fit_in_pieces: expected no {min(taken)}: use segments and fit, as its module shows")
    pieces = segments(world, state, observations, count)
    shared = {key: kind for key, kind in free.items() if not _initial(world, key)}
    first = fit(world, state, pieces, free=shared | _own_states(world, observations), starts=starts, **options)
    ends = [run.start - first.problem.runs[0].start for run in first.problem.runs[2::2]]
    whole = fit(world, state, observations, free=free, windows=(*ends, np.inf), resume=first, **options)
    remarks = (_apart(first, count), *_lost(first, whole))
    summary = replace(whole.summary, notes=(*remarks, *whole.notes))
    return replace(whole, summary=summary, remarks=(*remarks, *whole.remarks))


def jumps(fit: Fit) -> dict[str, np.ndarray]:
    """Jumps from the end of each piece to the beginning of the next.

    Args:
        fit: of the pieces that `segments` made.

    Returns:
        By "ball.x" [m], "ball.v" [m/s], "ball.w" [rad/s], (pieces - 1, D or A) in world axes; and by "ball.angle" or
        "ball.q" [rad], as a rotation vector in axes of the body.

    Raises:
        ValueError: a loaded fit.
    """
    checked_fit(fit, "jumps")
    so, records = rotations(fit.world.dim), list(zip(fit.problem.runs, fit.scenes, strict=True))
    turned = "angle" if fit.world.dim == 2 else "q"
    out: dict[str, list[np.ndarray]] = {}
    for (run, scene), (next_run, later) in itertools.pairwise(records):
        end, next_ = motion(scene, run, np.array([next_run.start]), fit.problem.dt).state, later.state
        for k, name in enumerate(fit.world.names):
            apart = {field: getattr(next_, field)[k] - getattr(end, field)[-1, k] for field in ("x", "v", "w")}
            apart[turned] = so.log(so.difference(end.q[-1, k], next_.q[k]))
            for field, value in apart.items():
                out.setdefault(f"{name}.{field}", []).append(np.asarray(value, float))
    return {name: np.stack(rows) for name, rows in out.items()}


def _initial(world: World, key: Any) -> bool:
    """Whether a path, or a tuple of paths, is part of the initial state."""
    names = [key] if isinstance(key, str) else key
    known = paths.catalogue(world)
    return any(place.chain[0] == 1 for name in names for place in known.get(component(name)[0], []))


def _own_states(world: World, observations: Any) -> dict[str, Each]:
    """Free parameters that each piece has of its own: pose and velocity of the measured bodies.

    Raises:
        ValueError: a body whose position is not a column.
    """
    seen: dict[str, list[str]] = {}
    for channel in columns(world, observations, {})[1].values():
        if isinstance(channel.observer, Part):
            seen.setdefault(channel.observer.field, []).append(world.names[channel.observer.body])
    if missing := [name for name in world.names if name not in seen.get("x", ())]:
        raise ValueError(f"fit_in_pieces: no column {missing[0] + '.x'!r}, where each piece of it begins: use windows=")
    out = {f"{name}.{field}": each(real()) for name in world.names for field in ("x", "v")}
    out |= {f"{name}.{field}": each(real()) for name in seen.get("angle", ()) for field in ("angle", "w")}
    out |= {f"{name}.q": each(rotation()) for name in seen.get("q", ())}
    return out | {f"{name}.w": each(real()) for name in seen.get("q", ())}


def _apart(first: Fit, count: int) -> str:
    """Note on the largest jumps."""
    found = jumps(first)
    largest = []
    for field, unit in (("x", "m"), ("v", "m/s")):
        sizes = {name: np.linalg.norm(rows, axis=1).max() for name, rows in found.items() if name.endswith(f".{field}")}
        name = max(sizes, key=lambda name: sizes[name])
        largest.append(f"{sizes[name]:.2g} {unit} ({name})")
    return f"fitted in {count} pieces first, which jumped by up to {' and '.join(largest)}; then as one motion"


def _lost(first: Fit, whole: Fit) -> list[str]:
    """Note on the column whose residuals are largest for the whole motion compared with the pieces, if much larger."""
    sizes = {name: (_rms(whole, name), _rms(first, name)) for name in whole.noise}
    worst = max(sizes, key=lambda name: sizes[name][0] / sizes[name][1])
    ratio = sizes[worst][0] / sizes[worst][1]
    if ratio < LOST:
        return []
    return [f"residuals of {worst} are {ratio:.2g} times those in pieces: the motion is lost, or the model wrong"]


def _rms(fit: Fit, name: str) -> float:
    """Root mean square of the residuals of a column, in its unit."""
    values = [fit.noise[name] * record[name].ravel() for record in fit.residuals if name in record]
    return max(float(np.sqrt(np.nanmean(np.concatenate(values) ** 2))), TINY)
