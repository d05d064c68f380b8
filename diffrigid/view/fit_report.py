"""The page that `fit.report("fit.html")` writes: all that is known of a fit, from the parts of `view.report`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffrigid.impacts import meetings
from diffrigid.sysid.columns import Series
from diffrigid.sysid.covariance import TINY
from diffrigid.sysid.intervals import number_names
from diffrigid.sysid.orders import alike
from diffrigid.sysid.profile import ProfileLikelihood, profile, with_profiles
from diffrigid.sysid.sensors import Part
from diffrigid.sysid.table import HEADER, TABLE_RECORDS, below, rows
from diffrigid.trajectory import Trajectory
from diffrigid.view.play import Player, play
from diffrigid.view.report import Curve, Section, chart, matrix, write_report

if TYPE_CHECKING:
    from diffrigid.sysid.result import Fit

LASTS = 4.0  # [s] shorter motions are slowed down to last this long
PROFILE_HEIGHT = 4.0  # [-] times the level of the interval: up to there a profile is drawn
LEAD = """Values with 95 % intervals, what the data cannot tell, the fitted motion over what was measured, and what is
left of the residuals. This file needs nothing but itself."""


def report(fit: "Fit", path: str | Path, title: str, profiles: Sequence[str]) -> Path:
    """Write the page. The motion and the residuals are those of the first three records."""
    found = [profile(fit, name) for name in profiles]
    fit = with_profiles(fit, found)
    motions = [fit.predict(record=k) for k in range(min(len(fit.scenes), TABLE_RECORDS))]
    sections = [_numbers(fit), _unknown(fit), _motion(fit, motions), _residuals(fit, motions)]
    sections += [section for section in (_search(fit, found),) if section.charts]
    return write_report(path, title, " ".join(LEAD.split()), [*sections, _origin(fit)])


def _numbers(fit: "Fit") -> Section:
    return Section(
        title="What was found",
        table=rows(fit.summary),
        header=(*HEADER[:-1], "remark"),
        paragraphs=[line + "." for line in below(fit.summary)],
    )


def _unknown(fit: "Fit") -> Section:
    title = "What the data cannot tell"
    if fit.notes:
        return Section(title=title, notes=fit.notes)
    text = "Every free number is determined, and the residuals look like independent normal noise."
    return Section(title=title, paragraphs=[text])


def _motion(fit: "Fit", motions: Sequence[Trajectory]) -> Section:
    hidden = len(fit.scenes) - len(motions)
    text = "The fitted motion from the start of each record; dots are what was measured."
    return Section(
        title="Motion",
        player=motion_player(fit, motions),
        paragraphs=[f"{text} Records that are not drawn: {hidden}." if hidden else text],
    )


def motion_player(fit: "Fit", motions: Sequence[Trajectory]) -> Player:
    """The fitted motions side by side, over those columns that are poses or velocities of bodies."""
    data = {f"record {k}": measured(fit, k) for k in range(len(motions))}
    known = {name: columns for name, columns in data.items() if columns}
    x = np.asarray(motions[0].state.x, float)
    axis = "xyz"[int(np.ptp(x, axis=0).max(0).argmax())]  # along which bodies move most
    duration = float(motions[0].t[-1] - motions[0].t[0])
    speed = min(1.0, float(f"{duration / LASTS:.1g}"))
    if len(motions) == 1:
        return play(motions[0], known.get("record 0"), speed=speed, plot=axis)
    runs = dict(zip(data, motions, strict=True))
    return play(runs, known or None, beside=True, speed=speed, plot=axis, height=620)


def measured(fit: "Fit", record: int) -> dict[str, Any]:
    """Columns of a record that are parts of a state, by what they observe, corrected for bias, scale and clock."""
    scene = fit.scenes[record]
    out: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for series in fit.problem.runs[record].series:
        channel = scene.channels[series.name]
        if isinstance(channel.observer, Part):
            name = f"{scene.world.names[channel.observer.body]}.{channel.observer.field}"
            bias, scale, clock = (np.asarray(leaf, float) for leaf in (channel.bias, channel.scale, channel.clock))
            seen = out.get(name, (np.zeros(0), np.zeros((0, series.values.shape[1]))))  # by another instrument
            t, values = map(np.concatenate, zip(seen, (series.t - clock, (series.values - bias) / scale), strict=True))
            order = np.argsort(t, kind="stable")
            out[name] = (t[order], values[order])
    return out


def _residuals(fit: "Fit", motions: Sequence[Trajectory]) -> Section:
    charts = [
        part
        for k, motion in enumerate(motions)
        for series in fit.problem.runs[k].series
        if (part := residual_chart(fit, k, series, impacts(motion)))
    ]
    texts = ["Fitted minus measured, in standard deviations of the noise. Dashed: impacts of the fitted motion."]
    if len(fit.scenes) > 1:
        charts.insert(0, _by_record(fit))
    return Section(title="Residuals", paragraphs=texts, charts=charts)


def impacts(motion: Trajectory) -> np.ndarray:
    """Times [s] of the impacts of a motion."""
    found = meetings(motion, np.zeros(0))
    return np.unique(np.round(found.t[found.impact], 6))


def residual_chart(fit: "Fit", record: int, series: Series, events: np.ndarray) -> str:
    """Chart of the residuals of one column over time; "" where nothing of it was measured."""
    values = fit.residuals[record][series.name]
    if not np.isfinite(values).any():
        return ""
    count = values.shape[1]
    curves = [Curve(series.t, values[:, k], f"[{k}]" if count > 1 else "", k % 3, True) for k in range(count)]
    title = f"{series.name}, record {record}" if len(fit.scenes) > 1 else series.name
    return chart(title, "time [s]", "residual [standard deviations]", curves, events=events.tolist(), margin=0.02)


def _by_record(fit: "Fit") -> str:
    """Chart of the root mean square of the residuals of every record: it shows which of them do not fit."""
    joined = [np.concatenate([column.ravel() for column in record.values()]) for record in fit.residuals]
    size = np.array([np.sqrt(np.nanmean(r**2)) if np.isfinite(r).any() else np.nan for r in joined])
    curve = Curve(np.arange(len(size)), size, points=True)
    return chart("Root mean square of each record", "record", "[standard deviations]", [curve], margin=0.02)


def _search(fit: "Fit", found: Sequence[ProfileLikelihood]) -> Section:
    names = number_names(fit.problem)
    charts = [cost_chart(fit)] if len(fit.costs) > 1 else []
    if len(names) > 1:
        label = [f"{name}  {k + 1}" for k, name in enumerate(names)]
        charts.append(matrix("Correlations of the shared numbers", label, fit.correlation))
    charts += map(profile_chart, found)
    return Section(title="How well it is found", charts=charts)


def cost_chart(fit: "Fit") -> str:
    """Chart of the cost at which every start ended, lowest first, coloured by the order of impacts, grey if unknown."""
    over = np.round(np.log10(fit.costs / max(fit.costs[0], TINY)), 3)
    groups = [np.array(members) for members in alike(fit.orders)]
    groups = [*groups[:2], np.concatenate(groups[2:])] if len(groups) > 2 else groups
    rest = np.arange(len(fit.orders), np.isfinite(fit.costs).sum())
    names = ("order of the best", "another", "others") if len(groups) > 1 or len(rest) else ("",)
    curves = [Curve(at + 1.0, over[at], name, k, True) for k, (at, name) in enumerate(zip(groups, names, strict=False))]
    curves += [Curve(rest + 1.0, over[rest], "not looked at", 3, True)] if len(rest) else []
    return chart("Cost of each start", "start", "log10 of cost / lowest", curves, margin=0.02)


def profile_chart(found: ProfileLikelihood) -> str:
    """Chart of the rise of the cost when one number is held; dashed: the ends of its interval."""
    near = found.rise < PROFILE_HEIGHT * found.level
    values, rise = found.values[near], found.rise[near]
    level = Curve(values, np.full(len(values), found.level), "95 % level", 1)
    curves = [Curve(values, rise), Curve(values, rise, points=True), level]
    ends = [end for end, side in ((found.low, "below"), (found.high, "above")) if side not in found.open]
    words = f", open {' and '.join(found.open)}" if found.open else ""
    return chart(f"Profile of {found.name}{words}", found.name, "rise of the cost", curves, events=ends)


def _origin(fit: "Fit") -> Section:
    made = fit.summary
    versions = ", ".join(f"{name} {value}" for name, value in made.versions.items())
    many = f" in {len(fit.scenes)} records" if len(fit.scenes) > 1 else ""
    text = (
        f"{sum(map(len, fit.linear.rows))} measured numbers{many}; seed {made.seed}; {made.seconds:.1f} s; {versions}."
    )
    return Section(title="How it was made", paragraphs=[text])
