"""`Trajectory`, the result of a rollout."""

from typing import Any

import jax
import numpy as np
from jax import Array

from diffrigid.paths import read
from diffrigid.pytree import array, batch_rank, pytree
from diffrigid.shapes import traced
from diffrigid.state import State
from diffrigid.tables import moment
from diffrigid.world import World


@pytree
class Trajectory:
    """States at the T + 1 times of a rollout; every leaf of `state` has a leading time axis, and of `controls`, of T.

    Example:
        >>> trajectory.t.shape, trajectory.state.x.shape  # the start and 30 steps
        ((31,), (31, 1, 2))
        >>> trajectory["ball.x"].shape, trajectory["ball.v[1]"].shape  # by path, as `dr.paths` and `fit` name them
        ((31, 2), (31,))
    """

    t: Array = array("T")  # (T+1,) [s], from 0, or the given times
    state: State
    world: World
    controls: Any = None  # of each interval, by name, as arrays

    def __getitem__(self, path: str) -> Array:
        """Value of a path at every time, (T+1, ...), or (B, T+1, ...) by `vmap` of `rollout`; see `diffrigid.paths`."""
        if not isinstance(path, str):
            raise ValueError(
                f"trajectory[{path!r}]: expected a path such as 'ball.x'; of states pick a time by "
                f"jax.tree.map(lambda leaf: leaf[{path!r}], trajectory.state)"
            )
        if np.ndim(self.t) > 1:  # then every leaf has that axis, of the world too
            return jax.vmap(lambda one: one[path])(self)
        shape, expected = np.shape(self.state.x)[:3], (len(self.t), len(self.world.names), self.world.dim)
        if shape != expected:
            raise ValueError(
                f"trajectory[{path!r}]: state.x begins with the axes {shape}, expected (T+1, N, D) = {expected}; of "
                f"many worlds: jax.vmap(lambda states: dr.Trajectory(t=t, state=states, world=world)[{path!r}])(states)"
            )
        return jax.vmap(lambda state: read(self.world, state, path))(self.state)

    def __repr__(self) -> str:
        """What it holds, and when; `state` and `world` print their numbers."""
        when = f"t of shape {np.shape(self.t)}"
        if isinstance(self.t, Array | np.ndarray) and not traced(self.t) and self.t.ndim == 1 and len(self.t):
            when = f"{len(self.t)} times, {moment(float(self.t[0]))} to {moment(float(self.t[-1]))} s"
        return f"Trajectory of {', '.join(self.world.names)}: {when}; state.x of shape {np.shape(self.state.x)}"

    def _repr_html_(self) -> str | None:
        """The motion itself, in a notebook; a batch is shown as text."""
        from diffrigid.view import play  # points down, so that a result draws itself

        try:
            checked(self)
        except ValueError:
            return None
        return play(self)._repr_html_()


def checked(trajectory: Any, name: str = "trajectory") -> Trajectory:
    """Check that a trajectory is one of a single world with known values, and return it.

    Raises:
        ValueError: not a trajectory, traced, or a batch.
    """
    if isinstance(trajectory, State):
        raise ValueError(
            f"{name} is a State: expected what `rollout` returns; of states of `rollout_batch` pick a world, "
            "Trajectory(t=t, state=jax.tree.map(lambda leaf: leaf[0], states), world=world)"
        )
    if not isinstance(trajectory, Trajectory):
        raise ValueError(f"{name} is a {type(trajectory).__name__}: expected what `rollout` returns, or a dict of them")
    if traced(trajectory):
        raise ValueError(f"{name} is traced by jit, vmap or grad: expected known values; use it outside, on the result")
    if np.ndim(trajectory.t) != 1:
        raise ValueError(
            f"{name}.t has shape {np.shape(trajectory.t)}, a batch in front: "
            f"pick one with jax.tree.map(lambda leaf: leaf[0], {name})"
        )
    if np.ndim(trajectory.state.x) != 3 or batch_rank(trajectory.world):
        shape = np.shape(trajectory.state.x)
        first = "0" if len(shape) == 4 and len(trajectory.t) == shape[1] != shape[0] else "..., 0"
        raise ValueError(
            f"{name}.state.x has shape {shape}, expected (T+1, N, D), and {name}.world without "
            f"a batch: pick one with replace({name}, state=jax.tree.map(lambda leaf: leaf[{first}], {name}.state)), "
            "and likewise in the leaves of the world that have the batch axis"
        )
    return trajectory
