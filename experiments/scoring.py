"""What the experiments with measured tosses share: a search on a grid, coarse then fine, and intervals from draws."""

import numpy as np

POINTS, FINER, DRAWS = 7, 4, 1000  # of the coarse grid each way; times as fine about its best; resampled records


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


def _grid(axes):
    whole = np.meshgrid(*axes.values(), indexing="ij")
    return {name: values.ravel() for name, values in zip(axes, whole, strict=True)}


def show(found):
    for name, (value, low, high) in found.items():
        print(f"{name:12} {value:.4g}   95 % of draws {low:.4g} to {high:.4g}")
