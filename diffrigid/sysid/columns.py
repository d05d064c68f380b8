"""Measured columns by name, from a dictionary, a table or a file, checked."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffrigid.catalogue import component
from diffrigid.controls import controlled
from diffrigid.sysid.channels import channel_of
from diffrigid.sysid.csv_file import is_number, read_csv
from diffrigid.sysid.sensors import Channel, Homography, Marker, Part, Pinhole
from diffrigid.world import World

MARKS = (0.0, -1.0)  # what trackers write where they have lost a point
FAR = 20.0  # [-] times the usual way between rows: marks that are farther from the rows beside them are reported
SPEED_RATIO = 20.0  # [-] speeds that differ by more than this factor from those of the positions have another unit


@dataclass(frozen=True)
class Series:
    """One measured column, or a control."""

    name: str
    t: np.ndarray  # (K,) [s], increasing
    values: np.ndarray  # (K, size), NaN where missing


def columns(
    world: World, observations: Any, observe: Mapping[str, Any], where: str = "observations"
) -> tuple[tuple[Series, ...], dict[str, Channel], tuple[Series, ...]]:
    """Measured columns of a record, what each observes, and its columns that are controls, by their names in forces.

    Args:
        observations: a mapping or a table (anything with `columns`), or the path of a CSV file. "t" (K,) [s], and by
            name (K,) or (K, size), NaN where missing; or a pair (t, values) for a column with times of its own. A
            component stands alone as "ball.x[0]", which may be such a pair too.
        observe: what a column observes if it is not named for that; None: it is left out.
    """
    check_mapping("observe", observe)
    left_out = {name for name, what in observe.items() if what is None}
    table = {name: values for name, values in _table(observations, where, left_out).items() if name not in left_out}
    check_mapping(where, table)
    shared = None if "t" not in table else as_times(table.pop("t"), f'{where}["t"]')
    gathered = _gather(table)
    if shared is None and not any(isinstance(values, tuple) for values in table.values()):
        raise ValueError(f'{where}: expected a column "t" of times [s], got {list(table)}; rename yours, {{"t": ...}}')
    found, channels, controls, sizes = [], {}, [], controlled(world.forces)
    for name, values in gathered.items():
        if isinstance(values, dict):
            t, values = _at_all_times(values, shared, f"{where}[{name!r}]")
        elif isinstance(values, tuple) and len(values) == 2:
            t, values = as_times(values[0], f"{where}[{name!r}]"), values[1]
        else:
            t = shared
        if t is None:
            raise ValueError(f'{where}: expected a column "t" of times [s], got {sorted(gathered)}')
        if name in sizes:
            controls.append(Series(name, t, _filled(values, len(t), sizes[name], name, where, world)))
            if not np.isfinite(controls[-1].values).all():
                raise ValueError(f"{where}[{name!r}] has NaN: expected numbers in every row of a control")
            continue
        channel = channel_of(name, observe.get(name, name), world)
        values = _filled(values, len(t), channel.bias.shape[0], name, where, world)
        found.append(Series(name, t, values))
        channels[name] = channel
    if unused := set(observe) - set(gathered) - left_out:
        raise ValueError(f"observe: no column {sorted(unused)[0]!r} in {where}, there are {sorted(gathered)}")
    if not found:
        raise ValueError(f"{where}: nothing is measured: expected a column beside the times")
    return tuple(found), channels, tuple(controls)


def _table(observations: Any, where: str, left_out: Collection[str]) -> dict[str, Any]:
    if isinstance(observations, str | Path):
        return dict(read_csv(observations, left_out))
    if hasattr(observations, "columns"):
        return {str(name): np.asarray(observations[name]) for name in observations.columns}
    if not isinstance(observations, Mapping):
        raise ValueError(
            f"{where} is a {type(observations).__name__}: expected a dict, a table or the path of a CSV file"
        )
    return dict(observations)


def as_times(t: Any, where: str) -> np.ndarray:
    """Check and convert times (K,) [s]."""
    t = as_floats(t, where)
    if t.ndim != 1 or len(t) < 2:
        alone = "" if t.shape != (1,) else ": if the motion began earlier, put a row of NaN there, and start= says so"
        raise ValueError(f"{where} has shape {t.shape}: expected at least two increasing times{alone}")
    if len(bad := np.flatnonzero(~(np.diff(t) > 0))):
        k = int(bad[0])
        raise ValueError(
            f"{where}: expected increasing times without NaN, got {t[k]:g}, then {t[k + 1]:g} in row {k + 1}: "
            + _fix_of_times(t[k], t[k + 1])
        )
    return t


def _fix_of_times(one: float, next_: float) -> str:
    if np.isnan(one) or np.isnan(next_):
        return "leave out rows without a time"
    if one == next_:
        return "leave out one of the two, every column[np.append(True, np.diff(t) > 0)]"
    return "if another run begins there, give each as a record, [first, second]; else sort by time"


def as_floats(values: Any, where: str) -> np.ndarray:
    """Convert a column to floats; masked values of a table are missing."""
    try:
        array: np.ndarray = np.asarray(np.ma.filled(np.ma.asarray(values, float), np.nan))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{where} is {values!r:.80}{_odd_one(values)}: expected numbers, NaN where missing") from None
    if np.isinf(array).any():
        raise ValueError(f"{where} has infinite values: expected numbers, NaN where missing")
    return array


def _odd_one(values: Any) -> str:
    """Say which of several values is no number; "" if that is not to be seen."""
    rows = isinstance(values, list | tuple) or isinstance(values, np.ndarray) and values.ndim > 0
    for row, value in enumerate(values if rows else ()):
        if isinstance(value, str) and not is_number(value):
            return f", with {value!r} in row {row}"
    return ""


def check_mapping(where: str, value: Any) -> None:
    """Raise ValueError unless a value is a dict by column, or None."""
    if value is not None and not isinstance(value, Mapping):
        raise ValueError(f"{where} is {value!r:.80}: expected a dict by name of column")
    if odd := [name for name in value or () if not isinstance(name, str)]:
        raise ValueError(f"{where} has a column {odd[0]!r}: expected names of columns, such as 'ball.x'")


def _gather(table: Mapping[str, Any]) -> dict[str, Any]:
    """Collect components "ball.x[0]", "ball.x[1]" under "ball.x", as {component: values}."""
    out: dict[str, Any] = {}
    for name, values in table.items():
        if isinstance(values, Mapping):
            raise ValueError(f"observations[{name!r}] is a dict: expected an array, or a pair (t, values)")
        whole, index = component(name)
        if index is not None:
            parts = out.setdefault(whole, {})
            if not isinstance(parts, dict):
                raise ValueError(f"observations: both {whole!r} and {name!r} are given: leave one out")
            parts[index] = values
        elif name in out:
            raise ValueError(f"observations: both {name!r} and a component of it are given: leave one out")
        else:
            out[name] = values
    return out


def _at_all_times(
    parts: dict[int, Any], shared: np.ndarray | None, where: str
) -> tuple[np.ndarray | None, dict[int, Any]]:
    """Times of a column whose components may have their own, (t, values), and its components then, NaN between."""
    pairs = {index: part for index, part in parts.items() if isinstance(part, tuple) and len(part) == 2}
    if not pairs or (shared is None and len(pairs) < len(parts)):
        return shared, parts
    times = {index: as_times(part[0], f"{where}[{index}]") for index, part in pairs.items()}
    if shared is not None:
        times |= {index: shared for index in parts if index not in pairs}
    t, whole = np.unique(np.concatenate(list(times.values()))), {}
    for index, part in parts.items():
        measured = as_floats(part[1] if index in pairs else part, f"{where}[{index}]")
        if measured.shape != (rows := times[index].shape):
            raise ValueError(f"{where}[{index}] has shape {measured.shape}, expected {rows} like its times")
        whole[index] = np.full(len(t), np.nan)
        whole[index][np.searchsorted(t, times[index])] = measured
    return t, whole


def _filled(values: Any, rows: int, size: int, name: str, where: str, world: World) -> np.ndarray:
    """Fill a column (K, size) from an array or from some of its components."""
    where = f"{where}[{name!r}]"
    if isinstance(values, dict):
        if bad := [index for index in values if index >= size]:
            raise ValueError(f"{where}: component [{bad[0]}], expected [0] to [{size - 1}] in this {world.dim}D world")
        whole = np.full((rows, size), np.nan)
        for index, part in values.items():
            part = as_floats(part, f"{where}[{index}]")
            if part.shape != (rows,):
                raise ValueError(f"{where}[{index}] has shape {part.shape}, expected ({rows},) like t")
            whole[:, index] = part
        return whole
    values = as_floats(values, where)
    values = values[:, None] if values.ndim == 1 else values
    if values.shape == (rows, 1) != (rows, size):
        parts = " and ".join(f"{name}[{k}]" for k in range(size))
        raise ValueError(
            f"{where} has one number a row, expected {size} in this {world.dim}D world: name the columns {parts}"
        )
    if values.shape != (rows, size):
        raise ValueError(
            f"{where} has shape {values.shape}, expected ({rows}, {size}) like t in this {world.dim}D world"
        )
    return values


def odd_speeds(found: Sequence[Series], channels: Mapping[str, Channel]) -> str:
    """Say which velocities are far from the slopes of the body's positions, as in another unit; "" if none are."""
    parts = {(c.observer.body, c.observer.field): name for name, c in channels.items() if isinstance(c.observer, Part)}
    by_name = {s.name: s for s in found}
    for (body, field), name in parts.items():
        if field == "v" and (body, "x") in parts:
            x, v = by_name[parts[body, "x"]], by_name[name]
            # Noise makes the positions of neighbours differ, but less so over a tenth of the record.
            near, far = (_median_size(_slopes(x, lag)) for lag in (1, max(len(x.t) // 10, 1)))
            speeds = _median_size(v.values)
            if near > 0 and speeds > 0 and (speeds > SPEED_RATIO * near or SPEED_RATIO * speeds < min(near, far)):
                return (
                    f"[{name!r}]: speeds of about {speeds:.3g}, but {parts[body, 'x']!r} moves at {far:.3g} a second: "
                    "are both in metres and seconds? If so, it is a motion faster than its rows show"
                )
    return ""


def odd_places(found: Sequence[Series], channels: Mapping[str, Channel]) -> str:
    """Say which column of places has rows that hold one of `MARKS` far from those beside them; "" if none has."""
    for series in found:
        observer = channels[series.name].observer
        if not isinstance(observer, Marker | Homography | Pinhole) and getattr(observer, "field", "") != "x":
            continue
        known = np.isfinite(series.values).all(1)
        t, values = series.t[known], series.values[known]
        for mark in MARKS:
            marked = (values == mark).all(1)
            if marked.any() and (~marked).sum() > 1:
                rest = values[~marked]
                beside = np.stack([np.interp(t[marked], t[~marked], column) for column in rest.T], axis=1)
                way = FAR * _median_size(np.diff(rest, axis=0))
                if many := int((np.linalg.norm(beside - mark, axis=1) > way).sum()):
                    return (
                        f"[{series.name!r}] is {mark:g} in {many} row{'s' * (many > 1)}, far from the rows beside: if "
                        "it is not measured there, make it NaN"
                    )
    return ""


def _slopes(series: Series, lag: int) -> np.ndarray:
    """Difference quotients of values that are `lag` rows apart, (K - lag, size)."""
    return (series.values[lag:] - series.values[:-lag]) / (series.t[lag:] - series.t[:-lag])[:, None]


def _median_size(vectors: np.ndarray) -> float:
    """Median length of the vectors (K, D) that are complete; 0 if none is."""
    complete = vectors[np.isfinite(vectors).all(1)]
    return float(np.median(np.sqrt((complete**2).sum(1)))) if len(complete) else 0.0
