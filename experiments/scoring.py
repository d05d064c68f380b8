"""What the experiments with measured tosses share: simulation of all records, a search, and intervals."""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

import diffrigid as dr

POPULATION, GENERATIONS = 4, 40  # points of a generation for each number, made up to a power of 2
DRAWS = 1000  # resampled records


def open_loop(make, start, dt, steps):
    """Function of arrays (P,) by name -> x and q of the one body, (P, records, T+1, ...).

    Args:
        make: the world of one point, from its numbers by name.
        start: states of the records, a leading axis.
    """
    count = len(start.x)

    @jax.jit
    def simulate(values, start):
        points = len(next(iter(values.values())))
        worlds = jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), jax.vmap(make)(values))
        starts = jax.tree.map(lambda leaf: jnp.tile(leaf, (points, *[1] * (leaf.ndim - 1))), start)
        states = dr.rollout_batch(worlds, starts, dt=dt, steps=steps)
        return tuple(path[:, :, 0].reshape(points, count, *path[0, :, 0].shape) for path in (states.x, states.q))

    def of(values):
        values = {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
        return jax.tree.map(np.asarray, simulate(values, start))

    return of


def search(loss, ranges):
    """Values that minimise the mean of a loss over records, by differential evolution (Storn and Price 1997).

    Args:
        loss: function of arrays (P,) by name -> (P, records).
        ranges: by name, (low, high); no value leaves them.

    Returns:
        by name, (best, low, high): 95 % of the best of all points tried, for records drawn again with replacement.
    """
    tried, losses = [], []

    def mean_loss(points):  # (numbers, P), or one point
        points = points.reshape(len(ranges), -1)
        tried.append(points.T)
        losses.append(loss(dict(zip(ranges, points, strict=True))))
        return losses[-1].mean(1)

    differential_evolution(
        mean_loss, list(ranges.values()), init="sobol", popsize=POPULATION, maxiter=GENERATIONS, tol=1e-3,
        polish=False, updating="deferred", vectorized=True, seed=0,
    )  # fmt: skip
    points, by_record = np.concatenate(tried), np.concatenate(losses)
    best, count = points[by_record.mean(1).argmin()], by_record.shape[1]
    draws = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    again = points[[by_record[:, draw].mean(1).argmin() for draw in draws]]
    ends = np.quantile(again, [0.025, 0.975], axis=0)
    return {name: (best[k], *ends[:, k]) for k, name in enumerate(ranges)}


def angle_between(q, other):
    """Angle of the rotation from one orientation (..., 4) to another [degrees]."""
    return 2 * np.degrees(np.arccos(np.clip(np.abs((q * other).sum(-1)), 0, 1)))


def arguments(title, data, test=104):
    """Of the command line: the file, and how many of its records are fitted, and how many then scored.

    To be called before anything else uses JAX, which compiles for speed from here on: a search takes minutes.
    """
    dr.compile_for_speed()
    parser = argparse.ArgumentParser(description=title)
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--train", type=int, default=100)
    parser.add_argument("--test", type=int, default=test)
    return parser.parse_args()


def show(found):
    for name, (value, low, high) in found.items():
        print(f"{name:20} {value:.4g}   95 % of draws {low:.4g} to {high:.4g}")
