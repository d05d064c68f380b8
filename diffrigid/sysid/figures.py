"""Figures of a fit, with matplotlib: each returns a `matplotlib.figure.Figure`."""

from typing import Any

import numpy as np

from diffrigid.sysid.diagnosis import correlations
from diffrigid.sysid.intervals import number_names
from diffrigid.sysid.orders import alike
from diffrigid.sysid.profile import ProfileLikelihood
from diffrigid.sysid.result import Fit, checked_fit, checked_record


def _axes(width: float = 6.0, height: float = 3.5) -> tuple[Any, Any]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError('figures need matplotlib: pip install "diffrigid[notebook]"') from None
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def residual_figure(fit: Fit, record: int = 0) -> Any:
    """Residuals of a record over time, in standard deviations.

    Raises:
        ValueError: a loaded fit; there is no such record.
    """
    checked_fit(fit, "residual_figure")
    figure, axes = _axes()
    for series in fit.problem.runs[checked_record(fit, record)].series:
        values = fit.residuals[record][series.name][: len(series.t)]
        for k in range(values.shape[1]):
            label = series.name if values.shape[1] == 1 else f"{series.name}[{k}]"
            axes.plot(series.t, values[:, k], ".", label=label)
    for level in (-2, 0, 2):
        axes.axhline(level, color="0.7", linewidth=0.8)
    axes.set(xlabel="time [s]", ylabel="residual [standard deviations]")
    axes.legend(fontsize="small")
    return figure


def cost_figure(fit: Fit) -> Any:
    """Cost at which each start ended, lowest first; a colour for each order of impacts, grey where it is not known."""
    figure, axes = _axes()
    for number, members in enumerate(alike(fit.orders)):
        at = np.array(members)
        axes.semilogy(at + 1, fit.costs[at], "o", label=f"order of impacts {number + 1}")
    if len(rest := np.arange(len(fit.orders), np.isfinite(fit.costs).sum())):
        axes.semilogy(rest + 1, fit.costs[rest], "o", color="0.6", label="not looked at")
    axes.set(xlabel="start", ylabel="cost")
    if len(axes.lines) > 1:
        axes.legend(fontsize="small")
    return figure


def correlation_figure(fit: Fit) -> Any:
    """Correlations of the shared numbers.

    Raises:
        ValueError: a loaded fit.
    """
    checked_fit(fit, "correlation_figure")
    figure, axes = _axes(5.0, 4.2)
    names = number_names(fit.problem)
    image = axes.imshow(correlations(fit.covariance), vmin=-1, vmax=1, cmap="RdBu")
    axes.set_xticks(range(len(names)), names, rotation=90)
    axes.set_yticks(range(len(names)), names)
    figure.colorbar(image)
    return figure


def profile_figure(found: ProfileLikelihood) -> Any:
    """Rise of the cost about the best value, and the level of the 95 % interval."""
    figure, axes = _axes()
    axes.plot(found.values, found.rise, "o-")
    axes.axhline(found.level, color="0.5", linewidth=0.8)
    ends = found.values[[0, -1]]
    axes.axvspan(max(found.low, ends[0]), min(found.high, ends[1]), alpha=0.15)
    axes.set(xlabel=" ".join([found.name, *(f"(open {side})" for side in found.open)]), ylabel="rise of the cost")
    return figure
