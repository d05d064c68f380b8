"""The problem of a fit as plain functions of one vector, for any other optimiser:

problem = make_problem(world, state, observations, free={"restitution": interval(0, 1)}, noise={"ball.x": 1e-3})
residuals, jacobian = partial(residual_vector, problem), partial(jacobian_matrix, problem)
found = scipy.optimize.least_squares(residuals, start_vector(problem), jacobian)
values_at(problem, found.x)["restitution"]
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.sysid.levenberg import Numbers
from diffrigid.sysid.parameters import Scene, Slot, knows, pieces, reference
from diffrigid.sysid.problem import evaluate, linearise
from diffrigid.sysid.setup import Problem, first_numbers, scene_having, scene_of


def start_vector(problem: Problem) -> np.ndarray:
    """Start as one vector: z of the values in the scenes, shared numbers, then those of each record, (a + R b,)."""
    shared, own = first_numbers(problem)
    return np.concatenate([shared, own.T.ravel()])


def unpack(problem: Problem, z: np.ndarray) -> Numbers:
    """Unpack a vector (a + R b,) as one start."""
    (a, b), records = problem.sizes, len(problem.runs)
    if np.shape(z) != (a + b * records,):
        names = [slot.name for slot in (*problem.shared, *problem.own)]
        raise ValueError(
            f"z has shape {np.shape(z)}: expected ({a + b * records},), {a} shared numbers and {b} of each record, of "
            f"{', '.join(names)}"
        )
    own = np.asarray(z[a:]).reshape(len(problem.runs), b).T
    return Numbers(jnp.asarray(z[:a], problem.dtype)[:, None], jnp.asarray(own, problem.dtype)[:, :, None])


def residual_vector(problem: Problem, z: np.ndarray) -> np.ndarray:
    """Residuals in standard deviations, (m,); 0 where a value is missing. NumPy: `jacobian_matrix` is its derivative.

    Where no noise was given, in those of a guess from the scatter of the column.

    Raises:
        ValueError: z is not of the shape of `start_vector`.
    """
    numbers = unpack(problem, z)
    parts = [evaluate(g.plan, numbers.of(g.members), g.data)[..., 0].T.ravel() for g in problem.groups]
    return np.concatenate([np.asarray(part, float) for part in parts])


def jacobian_matrix(problem: Problem, z: np.ndarray) -> np.ndarray:
    """Derivatives of `residual_vector`, (m, a + R b).

    Raises:
        ValueError: z is not of the shape of `start_vector`.
    """
    numbers, (a, b) = unpack(problem, z), problem.sizes
    blocks = []
    for group in problem.groups:
        slopes = np.asarray(linearise(group.plan, numbers.of(group.members), group.data)[1], float)[..., 0]
        for k, member in enumerate(group.members):
            block = np.zeros((len(slopes), len(z)))
            block[:, :a] = slopes[:, :a, k]
            block[:, a + member * b : a + (member + 1) * b] = slopes[:, a:, k]
            blocks.append(block)
    return np.concatenate(blocks)


def values_at(problem: Problem, z: np.ndarray) -> dict[str, np.ndarray]:
    """Values of the parameters at z (a + R b,), by name, in SI units or those of a column, shaped as in the scene.

    Those of each record are stacked, (R, ...), NaN where it has no such. NumPy, not differentiable.

    Raises:
        ValueError: z is not of the shape of `start_vector`.
    """
    at, scenes = unpack(problem, z), [scene_of(run) for run in problem.runs]

    def value(slot: Slot, z: Array, scene: Scene) -> np.ndarray:
        found = np.asarray(slot.kind.value(z, reference(slot, scene)), float)
        return found.reshape(()) if found.size == 1 else found

    shared = [(slot, at.shared[rows, 0]) for slot, rows in pieces(problem.shared)]
    out = {slot.name: value(slot, z, scene_having(problem, slot)) for slot, z in shared}
    for slot, rows in pieces(problem.own):
        has = [all(knows(scene, path) for path in slot.paths) for scene in scenes]
        found = [value(slot, at.own[rows, r, 0], scenes[r]) for r in np.flatnonzero(has)]
        out[slot.name] = np.full((len(scenes), *found[0].shape), np.nan)
        out[slot.name][has] = found
    return out
