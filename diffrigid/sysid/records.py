"""Measured records: columns with the scene, the start and the noise that belong to them, checked."""

import warnings
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

from diffrigid.catalogue import component
from diffrigid.controls import controlled
from diffrigid.convert import known_number, numbers, positive
from diffrigid.spelling import in_words
from diffrigid.state import State
from diffrigid.sysid.columns import Series, check_mapping, columns, odd_places, odd_speeds
from diffrigid.sysid.free import as_given
from diffrigid.sysid.sensors import Channel
from diffrigid.tables import moment
from diffrigid.world import World, check

SAME_TIME = 1e-9  # [s] times of different columns that are this close are the same
MEDIAN = 0.6745  # of the absolute values of normal noise, over its standard deviation


@in_words
@dataclass(frozen=True)
class Record:
    """One measured run, where several are fitted together.

    Args:
        observations: as of `fit`.
        state: its own initial state; default that of `fit`, with parameters that are free by `each` as its first rows
            show them.
        world: its own; default that of `fit`.
        start: [s] time of the initial state; default the first time of its columns.
        noise: standard deviations of its columns, numbers or arrays like the columns; default those of `fit`.

    Example:
        >>> drops = [dr.Record(measured), dr.Record(measured, state=state, noise={"ball.x": 1e-3})]
        >>> drops[0].state is None  # then that of the fit
        True
    """

    observations: Any
    _: KW_ONLY
    state: State | None = None
    world: World | None = None
    start: float | None = None
    noise: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Run:
    """A record, read and checked, with its scene."""

    world: World
    state: State
    channels: dict[str, Channel]
    series: tuple[Series, ...]
    start: float  # [s]
    noise: Mapping[str, Any]
    controls: tuple[Series, ...] = ()  # each held from one of its times to the next
    stated: bool = False  # its initial state was given with it
    written: dict[str, Any] = field(default_factory=dict)  # see `parameters.Written`


def series_of(run: Run, name: str) -> Series:
    """The measured column of this name."""
    return next(series for series in run.series if series.name == name)


def runs(world: World, state: State, observations: Any, observe: Mapping[str, Any], noise: Mapping | None) -> list[Run]:
    """Read and check all records of a fit.

    Args:
        observations: of one record, or a list of such and of Records.

    Raises:
        ValueError: unknown names, wrong shapes, times that do not increase, a column without any number.
    """
    check(world, state)
    check_mapping("noise", noise)
    several = isinstance(observations, list | tuple)
    records = [r if isinstance(r, Record) else Record(r) for r in (observations if several else [observations])]
    if not records:
        raise ValueError("observations is an empty list: expected at least one record")
    where = [f"observations[{index}]" if several else "observations" for index in range(len(records))]
    found = [
        _run(world, state, record, observe, noise or {}, part) for record, part in zip(records, where, strict=True)
    ]
    odd = [odd_places(run.series, run.channels) or odd_speeds(run.series, run.channels) for run in found]
    if any(odd):
        warnings.warn(next(part + text for part, text in zip(where, odd, strict=True) if text), stacklevel=4)
    everywhere = sorted({s.name for run in found for s in run.series})
    if unknown := {name for name in noise or {} if not {name, component(name)[0]} & set(everywhere)}:
        raise ValueError(f"noise: no column {sorted(unknown)[0]!r} in observations, there are {everywhere}")
    _refuse_empty_columns(found)
    return found


def _run(world: World, state: State, record: Record, observe: Mapping, noise: Mapping, where: str) -> Run:
    """Read and check one record, which takes from `world`, `state` and `noise` what it does not give."""
    world = world if record.world is None else record.world
    state = state if record.state is None else record.state
    check_mapping(f"{where}.noise", record.noise)
    check(world, state)
    for name, mass in zip(world.names, np.asarray(world.bodies.mass), strict=True):
        positive(f"{name}.mass", mass, "begin with another")
    series, channels, controls = columns(world, record.observations, observe, where)
    names = [s.name for s in series]
    own = _of_columns(record.noise or {}, series, f"{where}.noise")
    if unknown := set(own) - set(names):
        raise ValueError(f"{where}.noise: no column {sorted(unknown)[0]!r}, there are {names}")
    first = min(float(s.t[0]) for s in series)
    start = first if record.start is None else as_given(known_number, f"{where}.start", record.start)
    if start > first:
        raise ValueError(
            f"{where}: start is {moment(start)} s, after the first measured time {moment(first)} s: make it earlier"
        )
    if missing := controlled(world.forces).keys() - {control.name for control in controls}:
        raise ValueError(
            f"{where} has no column {min(missing)!r}, which a force takes as its control: give zeros where nothing "
            "acts, or leave the force out of the scene"
        )
    for control in controls:
        if control.t[0] > start + SAME_TIME:
            raise ValueError(
                f"{where}[{control.name!r}] begins at {moment(control.t[0])} s, after the start {moment(start)} s: "
                "what acts before?"
            )
    given = {name: sigma for name, sigma in _of_columns(noise, series, "noise").items() if name in names} | own
    return Run(world, state, channels, series, start, given, controls, record.state is not None)


def _of_columns(noise: Mapping[str, Any], series: tuple[Series, ...], where: str) -> dict[str, Any]:
    """Noise by column, where some was given by component: "ball.x[1]"."""
    by_name, whole = {s.name: s for s in series}, dict(noise)
    for name in noise:
        column, index = component(name)
        if index is None or name in by_name or column not in by_name:
            continue
        if column in noise:
            raise ValueError(f"{where}: both {column!r} and {name!r} are given: leave one out")
        values = by_name[column].values
        if index >= values.shape[1]:
            raise ValueError(f"{where}[{name!r}]: {column} has {values.shape[1]} numbers, from [0] on")
        del whole[name]
        sigma = whole.setdefault(column, np.where(np.isnan(values).all(0), 1.0, np.nan) * np.ones(values.shape))
        given = np.asarray(numbers(f"{where}[{name!r}]", noise[name], None))
        if given.shape not in ((), values.shape[:1]):
            raise ValueError(f"{where}[{name!r}] has shape {given.shape}, expected a number or {values.shape[:1]}")
        sigma[:, index] = given
    for column in whole.keys() - noise.keys():
        if lacks := np.flatnonzero(np.isnan(whole[column]).any(0)).tolist():
            raise ValueError(f"{where}: {column}[{lacks[0]}] has none: give it too, or one number for {column!r}")
    return whole


def same_data(one: Run, other: Run) -> bool:
    """Whether two records hold the same columns, times and values."""
    pairs = {s.name: s for s in one.series}, {s.name: s for s in other.series}
    return pairs[0].keys() == pairs[1].keys() and all(
        np.array_equal(s.t, pairs[1][name].t) and np.array_equal(s.values, pairs[1][name].values, equal_nan=True)
        for name, s in pairs[0].items()
    )


def _refuse_empty_columns(found: list[Run]) -> None:
    series = [s for run in found for s in run.series]
    measured = {s.name for s in series if np.isfinite(s.values).any()}
    if empty := [s.name for s in series if s.name not in measured]:
        raise ValueError(
            f"observations[{empty[0]!r}]: nothing is measured, every value is NaN: leave the column out, or look where "
            "the NaN come from"
        )


def noise_guess(values: np.ndarray, turn: float) -> float:
    """Standard deviation of the noise of a column (K, size) from second differences, which smooth motion hardly has.

    Those of independent noise have six times its variance.

    Args:
        turn: period after which values are the same again; 0: none.
    """
    first = np.diff(values, axis=0)
    first = first - turn * np.round(first / turn) if turn else first
    second = np.abs(np.diff(first, axis=0))
    second = second[np.isfinite(second)]
    if second.size == 0:
        return 1.0
    floor = 1e-6 * float(np.nanmax(np.abs(values))) or 1e-9
    return max(float(np.median(second)) / (MEDIAN * np.sqrt(6.0)), floor)
