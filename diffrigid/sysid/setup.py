"""The problem that a fit solves, as data: the free parameters, all records in arrays, starts and fitted scenes."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.convert import numbers
from diffrigid.devices import everywhere
from diffrigid.paths import write as write_path
from diffrigid.state import State
from diffrigid.step import floats
from diffrigid.sysid.first_rows import begun
from diffrigid.sysid.free import Free
from diffrigid.sysid.levenberg import Numbers
from diffrigid.sysid.parameters import Scene, Slot, knows, make_slots, put, reference, write, written_by
from diffrigid.sysid.problem import Group, full_turn, known, make_groups
from diffrigid.sysid.records import Run, noise_guess, runs, series_of
from diffrigid.sysid.times import longest_step
from diffrigid.world import World

MANY_STEPS = 50_000  # steps of a record beyond which the unit of its times is doubted
SPARSE, TOO_SPARSE = 40, 400  # likewise steps from one row to the next, where their length was not given; and refused


@dataclass(frozen=True)
class Problem:
    """The free parameters, and all records in arrays."""

    runs: tuple[Run, ...]
    shared: tuple[Slot, ...]
    own: tuple[Slot, ...]
    groups: tuple[Group, ...]
    dt: float  # [s] the longest step
    width: float  # [m] of smooth impacts
    window: float  # [s] from the start of each record, the shortest; later values have no weight
    noise: dict[str, float]  # of columns whose noise is not given with their record
    free: Mapping[Any, Any]  # as the user gave it
    observe: Mapping[str, Any]  # likewise

    def __repr__(self) -> str:
        """What is free, in how many records."""
        a, b = self.sizes
        names = [slot.name for slot in self.shared] + [f"{slot.name} of each record" for slot in self.own]
        return f"<Problem of {a + b * len(self.runs)} numbers z and {len(self.runs)} records: {', '.join(names)}>"

    @property
    def slots(self) -> tuple[Slot, ...]:
        """All free parameters, in the order of z."""
        return (*self.shared, *self.own)

    @property
    def sizes(self) -> tuple[int, int]:
        """Shared numbers a, and numbers b of each record."""
        return sum(slot.size for slot in self.shared), sum(slot.size for slot in self.own)

    @property
    def dtype(self) -> np.dtype:
        """Precision of the simulation."""
        return self.runs[0].state.x.dtype


def make_problem(
    world: World,
    state: State,
    observations: Any,
    *,
    free: Mapping[Any, Any],
    observe: Mapping[str, Any] | None = None,
    noise: Mapping[str, Any] | None = None,
    dt: float | None = None,
    resume: Any = None,
    places: Sequence[int | None] | None = None,
    begin: bool = True,
) -> Problem:
    """Check the arguments, which are those of `fit`, and put all records into arrays.

    Args:
        begin: a record without a state of its own begins as its first rows show it, in what is free by `each`.
        places: for each record, the record of `resume` whose own numbers it takes; None: none. Default in order.

    Raises:
        ValueError: what `fit` does not take.
    """
    found = runs(world, state, observations, observe or {}, noise)
    pairs = [floats(run.world, run.state) for run in found]
    written = written_by(free, pairs[0][1].x.dtype)
    found = [replace(run, world=w, state=s, written=written) for run, (w, s) in zip(found, pairs, strict=True)]
    shared, own = make_slots(free, [scene_of(run) for run in found])
    if begin:
        found = [run if run.stated else begun(run, own) for run in found]
    if resume is not None:
        found = _resumed(found, resume, (*shared, *own), range(len(found)) if places is None else places)
        make_slots(free, [scene_of(run) for run in found])  # checks where it goes on from
    longest = longest_step(found, dt)
    _doubt_times(found, longest, dt is not None)
    groups = make_groups(found, (*shared, *own), len(shared), longest)
    problem = Problem(
        tuple(found), shared, own, tuple(groups), longest, _common_width(found), np.inf, {}, dict(free),
        dict(observe or {}),
    )  # fmt: skip
    return with_noise(problem, noise_guesses(found))


def _doubt_times(found: Sequence[Run], longest: float, given: bool) -> None:
    """Warn of times that would take very many steps of `longest` [s], whose length the user gave or not.

    Raises:
        ValueError: so many between two rows that it is hardly meant.
    """
    lasts = max(float(series.t[-1]) - run.start for run in found for series in run.series)
    apart = float(np.median(np.concatenate([np.diff(series.t) for run in found for series in run.series])))
    if lasts > MANY_STEPS * longest or (apart > SPARSE * longest and not given):
        text = (
            f"a record lasts {lasts:.3g} s, with rows {apart:.2g} s apart, which takes {lasts / longest:.2g} steps of "
            f"{longest:.2g} s: if its times are in ms, or numbers of frames, make them seconds; otherwise give dt"
        )
        if apart > TOO_SPARSE * longest and not given:
            raise ValueError(text)
        warnings.warn(text, stacklevel=4)


def _common_width(found: Sequence[Run]) -> float:
    """Width [m] of smooth impacts, which all worlds share."""
    widths = sorted({float(run.world.contact.width) for run in found})
    if len(widths) > 1:
        raise ValueError(f"the worlds of the records have contact.width {widths}: expected the same in all of them")
    return widths[0]


def scene_of(run: Run) -> Scene:
    """The scene of a record."""
    return Scene(run.world, run.state, run.channels, run.written)


def with_noise(problem: Problem, noise: Mapping[str, float], window: Any = None, width: float | None = None) -> Problem:
    """Set the weights of a problem for this noise.

    Args:
        window: [s] of each record from its start, a number or (R,); None: as it is.
        width: [m] of smooth impacts; None: as it is. Until one is positive, only exact impacts are compiled.
    """
    windows = np.broadcast_to(problem.window if window is None else window, len(problem.runs))
    width = problem.width if width is None else float(width)
    groups = []
    for group in problem.groups:
        weights = {}
        for name, old in group.data.weights.items():
            rows = [_weights(problem.runs[k], name, noise, windows[k], old.shape[0]) for k in group.members]
            weights[name] = jax.device_put(np.stack(rows, axis=-1).astype(old.dtype))
        exact = width == 0 and group.data.width is None
        width_now = None if exact else jnp.asarray(width, group.data.lengths.dtype)
        data = group.data._replace(weights=weights, width=width_now)
        groups.append(replace(group, data=data))
    return replace(problem, groups=tuple(groups), noise=dict(noise), width=width, window=float(windows.min()))


def _weights(run: Run, name: str, noise: Mapping[str, float], window: float, rows: int) -> np.ndarray:
    """1 / standard deviation, (rows, size), 0 where missing, beyond the window, or padded."""
    here = known(run, name)
    series = series_of(run, name)
    sigma = np.asarray(numbers(f"noise[{name!r}]", run.noise.get(name, noise.get(name, 1.0)), None, finite=False))
    sigma = sigma[:, None] if sigma.ndim == 1 and len(sigma) == len(here) else sigma
    try:
        sigma = np.broadcast_to(sigma, here.shape)
    except ValueError:
        raise ValueError(
            f"noise[{name!r}] has shape {sigma.shape}, expected a number or {here.shape} like the column"
        ) from None
    if not (sigma[here] > 0).all():
        raise ValueError(f"noise[{name!r}]: expected standard deviations above 0; NaN in the column is for missing")
    use = here & (series.t <= run.start + window)[:, None]
    out = np.zeros((rows, here.shape[1]))
    out[: len(here)] = np.where(use, 1.0 / np.where(here, sigma, 1.0), 0.0)
    return out


def noise_guesses(found: Sequence[Run]) -> dict[str, float]:
    """Noise guessed for each column whose noise is not given: the median over the records."""
    guesses: dict[str, list[float]] = {}
    for run in found:
        for series in run.series:
            if series.name not in run.noise and np.isfinite(series.values).any():
                guesses.setdefault(series.name, []).append(noise_guess(series.values, full_turn(run, series.name)))
    return {name: float(np.median(values)) for name, values in guesses.items()}


def _resumed(found: list[Run], saved: Any, slots: Sequence[Slot], places: Sequence[int | None]) -> list[Run]:
    """Records whose scenes hold the values of an earlier fit, for parameters that are free again."""
    parameters = {p.name: p for p in saved.parameters}
    out = []
    for place, run in zip(places, found, strict=True):
        scene = scene_of(run)
        for slot in slots:
            p = parameters.get(slot.name)
            if p is not None and not (p.records and (place is None or place >= p.records)):
                value = p.value[place] if p.records else p.value
                for k, path in enumerate(slot.paths):
                    scene = write(scene, path, jnp.asarray(value[k] if slot.is_vector else value, scene.state.x.dtype))
        out.append(replace(run, **scene._asdict()))
    return out


# ---- z


def first_numbers(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Numbers z of the values in the scenes: (a,), (b, R)."""
    return _numbers(problem, lambda kind, value: kind.unbounded(value))


def make_starts(problem: Problem, count: int, seed: int) -> Numbers:
    """Starts: z of the values in the scenes, and of `count` - 1 random ones."""
    random = np.random.default_rng(seed)
    drawn = [_numbers(problem, lambda kind, value: kind.draw(value, random)) for _ in range(count - 1)]
    shared_and_own = zip(first_numbers(problem), *drawn, strict=True)
    # Replicated on all devices, like the results of a solver: otherwise everything would be compiled again for those.
    return everywhere(Numbers(*(jax.device_put(np.stack(rows, -1).astype(problem.dtype)) for rows in shared_and_own)))


def _numbers(problem: Problem, of: Callable[[Any, np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers `of(kind, value in the scene)` of the shared parameters (a,) and of each record's own (b, R)."""
    shared = [of(slot.kind, np.asarray(first_value(problem, slot))) for slot in problem.shared]
    own = [
        np.stack([of(slot.kind, np.asarray(reference(slot, scene_of(run)))) for run in problem.runs], 1)
        for slot in problem.own
    ]
    return _joined(shared), np.concatenate([np.zeros((0, len(problem.runs))), *own])


def reach_of(problem: Problem, held: Sequence[int] = ()) -> Numbers:
    """Longest step of each number: a factor e^2 for those of which z is a logarithm or similar; 0 if held."""
    parts = []
    for slots in (problem.shared, problem.own):
        real = [isinstance(slot.kind, Free) and np.isinf(slot.kind.low) for slot in slots]
        parts.append(_joined([np.full(slot.size, np.inf if r else 2.0) for slot, r in zip(slots, real, strict=True)]))
    parts[0][list(held)] = 0.0
    a, b = (part.astype(problem.dtype) for part in parts)
    return Numbers(jax.device_put(a[:, None]), jax.device_put(b[:, None, None]))


def first_value(problem: Problem, slot: Slot) -> Array:
    """Value of a parameter in the scene of the first record that has it."""
    return reference(slot, scene_having(problem, slot))


def scene_having(problem: Problem, slot: Slot) -> Scene:
    """The scene of the first record that has a parameter."""
    scenes = (scene_of(run) for run in problem.runs)
    return next(scene for scene in scenes if all(knows(scene, path) for path in slot.paths))


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *parts])


def fitted_scenes(problem: Problem, shared: np.ndarray, own: np.ndarray) -> list[Scene]:
    """Scenes of all records with the parameters z (a,), (b, R) written in."""
    out: list[Any] = [None] * len(problem.runs)
    for group in problem.groups:
        for k, member in enumerate(group.members):
            out[member] = fitted_scene(problem, group, k, shared, own)
    return out


def fitted_scene(problem: Problem, group: Group, k: int, shared: np.ndarray, own: np.ndarray) -> Scene:
    """Scene of record k of a group, with the fitted parameters written in."""
    run = problem.runs[group.members[k]]
    z = np.concatenate([shared, own[:, group.members[k]]]).astype(run.state.x.dtype)
    scene = _put(group.plan.slots, scene_of(run), z)
    world, state = write_path(scene.world, scene.state, "contact.width", problem.width)
    return scene._replace(world=world, state=state)


_put = jax.jit(put, static_argnames="slots")
