"""What the experiments with measured tosses share: simulation of all records, a search on a grid, and intervals."""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import diffrigid as dr

POINTS, FINER, DRAWS = 7, 4, 1000  # of the coarse grid each way; times as fine about its best; resampled records


def open_loop(world, start, dt, steps):
    """Function of arrays (P,) by name -> x and q of the one body, (P, records, T+1, ...).

    Args:
        start: states of the records, a leading axis.
    The names are "friction", "restitution" and, if it is to be moved, "floor": its height [m] along the last axis.
    """
    count = len(start.x)

    @jax.jit
    def simulate(world, start):
        states = dr.rollout_batch(world, start, dt=dt, steps=steps)
        return states.x[:, :, 0], states.q[:, :, 0]

    def of(values):
        points = len(values["friction"])
        each = {name: jnp.repeat(jnp.asarray(value, jnp.float32), count)[:, None] for name, value in values.items()}
        height = each.pop("floor", None)
        bodies, statics = dr.replace(world.bodies, **each), dr.replace(world.statics, **each)
        if height is not None:
            statics = dr.replace(statics, x=height[..., None] * jnp.eye(world.dim, dtype=jnp.float32)[-1])
        starts = jax.tree.map(lambda leaf: jnp.tile(leaf, (points, *[1] * (leaf.ndim - 1))), start)
        paths = simulate(dr.replace(world, bodies=bodies, statics=statics), starts)
        return tuple(np.asarray(path).reshape(points, count, *path.shape[1:]) for path in paths)

    return of


def search(loss, ranges, points=POINTS, finer=FINER):
    """Values that minimise the mean of a loss over records, with intervals.

    Args:
        loss: function of arrays (P,) by name -> (P, records).
        ranges: by name, (low, high); no value leaves them.

    Returns:
        by name, (best, low, high): the interval holds 95 % of the best values for records drawn again with replacement.
    """
    coarse = _grid({name: np.linspace(*span, points) for name, span in ranges.items()})
    best = loss(coarse).mean(1).argmin()
    steps = {name: (high - low) / (points - 1) for name, (low, high) in ranges.items()}
    near = {name: coarse[name][best] + steps[name] * np.linspace(-1, 1, 2 * finer + 1) for name in ranges}
    fine = _grid({name: np.unique(np.clip(near[name], *ranges[name])) for name in ranges})
    by_record = loss(fine)
    best, count = by_record.mean(1).argmin(), by_record.shape[1]
    draws = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    again = np.array([by_record[:, draw].mean(1).argmin() for draw in draws])
    return {name: (values[best], *np.quantile(values[again], [0.025, 0.975])) for name, values in fine.items()}


def angle_between(q, other):
    """Angle of the rotation from one orientation (..., 4) to another [degrees]."""
    return 2 * np.degrees(np.arccos(np.clip(np.abs((q * other).sum(-1)), 0, 1)))


def arguments(title, data, train=100, test=104):
    """Of the command line: the file, and how many of its records are fitted, and how many then scored."""
    parser = argparse.ArgumentParser(description=title)
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--train", type=int, default=train)
    parser.add_argument("--test", type=int, default=test)
    return parser.parse_args()


def _grid(axes):
    whole = np.meshgrid(*axes.values(), indexing="ij")
    return {name: values.ravel() for name, values in zip(axes, whole, strict=True)}


def show(found):
    for name, (value, low, high) in found.items():
        print(f"{name:12} {value:.4g}   95 % of draws {low:.4g} to {high:.4g}")
