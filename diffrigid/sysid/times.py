"""Times of a record: measured ones, those at which a control changes, and the steps between them."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax import Array

from diffrigid.convert import positive
from diffrigid.forces import is_constant
from diffrigid.state import State
from diffrigid.step import rollout, steps_in
from diffrigid.sysid.parameters import Scene
from diffrigid.sysid.records import SAME_TIME, Run
from diffrigid.trajectory import Trajectory

LONGEST = 0.02  # [s] longest step, where its length is not given and matters
JITTER = 1.1  # [-] of the usual interval: a longer one up to this factor is still one step


def longest_step(found: Sequence[Run], dt: float | None) -> float:
    """Longest step [s]: as given, or the median interval between times, and a tenth more for a clock that jitters.

    Where forces vary or bodies may touch, no more than LONGEST.
    """
    if dt is not None:
        return float(positive("dt", dt, "it is the longest step in s"))
    frame = JITTER * float(np.median(np.concatenate([np.diff(all_times(run)) for run in found])))
    exact = all(is_constant(w.forces) and not (w.joints or w.pairs or w.crowd) for w in (run.world for run in found))
    return frame if exact else min(frame, LONGEST)


def controls_over(run: Run, t: np.ndarray) -> dict[str, np.ndarray] | None:
    """Controls (S, size) of a record over steps that begin at times t (S,) [s]: each value is held until the next."""
    rows = {c.name: np.searchsorted(c.t, t + SAME_TIME, side="right") - 1 for c in run.controls}
    return {c.name: c.values[np.maximum(rows[c.name], 0)] for c in run.controls} or None


def all_times(run: Run) -> np.ndarray:
    """Start and every measured time, once each."""
    return _once([run.start], *(series.t for series in run.series))


def _once(*times: Any) -> np.ndarray:
    t = np.unique(np.concatenate(times))
    return t[np.concatenate([[True], np.diff(t) > SAME_TIME])]


def _with_changes(run: Run, t: np.ndarray) -> np.ndarray:
    """Add to times t those between them at which a control changes."""
    return _once(t, *(c.t[(c.t > t[0]) & (c.t < t[-1])] for c in run.controls))


@jax.jit
def _rows_of(tree: Any, index: Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def motion(scene: Scene, run: Run, t: np.ndarray, longest: float) -> Trajectory:
    """Motion of a record from its start, at increasing times t (K,) [s] after it, with steps up to `longest` [s]."""
    since = _with_changes(run, _once([run.start], t))
    controls = controls_over(run, since[:-1])
    states = rollout(scene.world, scene.state, dt=longest, times=since - run.start, controls=controls).state
    wanted = np.searchsorted(since, t - SAME_TIME)
    return _of_rows(scene, t, _rows_of(states, wanted), wanted, since, controls)


def motion_of_steps(scene: Scene, run: Run, states: State, longest: float) -> Trajectory:
    """The same at all measured times, from the states (S+1, ...), of NumPy, at the ends of the steps of `grid`."""
    (steps, counts), t = _steps(run, longest), all_times(run)
    ends = np.concatenate([[0], np.cumsum(counts)])
    since = np.interp(np.arange(ends[-1] + 1), ends, steps)
    wanted = np.searchsorted(since, t - SAME_TIME)
    rows = jax.device_put(jax.tree.map(lambda leaf: leaf[wanted], states))
    return _of_rows(scene, t, rows, wanted, since, controls_over(run, since[:-1]))


def _of_rows(
    scene: Scene, t: np.ndarray, state: State, wanted: np.ndarray, since: np.ndarray, controls: dict | None
) -> Trajectory:
    """States at times t (K,) [s], the `wanted` ones of those `since` (S+1,), with the means of controls over steps."""
    gaps = np.diff(since)[:, None]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(gaps * values, wanted[:-1]) / np.diff(t)[:, None]

    return Trajectory(
        t=t,  # type: ignore[arg-type]
        state=state,
        world=scene.world,
        controls=jax.tree.map(mean, controls),
    )


def grid(run: Run, longest: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Lengths of steps that land on every measured time, and for each column the index of the state of each row."""
    t, counts = _steps(run, longest)
    gaps, ends = np.diff(t), np.concatenate([[0], np.cumsum(counts)])
    index = {s.name: ends[np.clip(np.searchsorted(t, s.t - SAME_TIME), 0, len(t) - 1)] for s in run.series}
    return np.repeat(gaps / counts, counts), index


def _steps(run: Run, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) [s] on which steps land, and the number of steps (K - 1,) between them."""
    t = _with_changes(run, all_times(run))
    return t, steps_in(np.diff(t), longest)
