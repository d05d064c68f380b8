"""The two identifications of `python -m diffrigid`, one measured and one synthetic, as sections of its report."""

from collections.abc import Sequence
from typing import Any

import numpy as np

import diffrigid as dr
from diffrigid.data import FRAME, SquareDrops, square_drops
from diffrigid.state import State
from diffrigid.view.report import Curve, Section, chart, row

SIGMA = 0.5  # [mm], [degrees] weight of a residual of a drop: about its size
FINE = 4  # simulated and drawn steps of a drop per measured frame
CAMERA = 3e-3  # [m] noise of the three discs
HERTZ, FRAMES, SEED = 60, 120, 7  # of the three discs
TRUTH = {"restitution": 0.8, "middle.mass": 2.0, "left.v": (2.0, 0.1)}

LEAD = """
Two identifications by diffrigid, from positions and angles alone: a measured one, whose answer can be
compared with what others published, and a synthetic one, whose answer is known. Both are least squares with
exact derivatives through the impacts. This file is self-contained.
"""

DROP_TEXT = """
Fitted: one restitution, one friction coefficient, one moment of inertia and one height of the floor for all
drops, and the initial position, velocity, angle and angular velocity of each; {count} numbers from eight
records of up to 25 frames at 250 Hz. Given: the side, 60 mm, gravity, and the drag of the two plates
between which the square falls. Data: N. Fazeli et al. (arXiv 1710.05947), from DAIRLab/ImpactModeling,
BSD-3-Clause.

Each record begins three frames before the first contact and ends 80 ms after it, before the second. To end
it after 32 or 96 ms moves the restitution by less than 0.01; to begin it 28 ms earlier moves it to 0.43 and
the radius of gyration to 19 mm, within the intervals: how the misfit is shared between impact and fall
matters more than noise. A second impact would multiply what one restitution for all impacts gets wrong by a
flight of 100 ms and more.

What the data cannot tell: the mass. Gravity, drag and impacts are all in proportion to it, so it is set to
1, and only inertia over mass, the radius of gyration squared, is found. Friction shows only where the
corner slides: a contact that sticks gives a lower bound at best.

Residuals (rms): {x:.2f} mm across, {height:.2f} mm in height, {angle:.2f} degrees. The tracking scatters by
some 0.05 mm and 0.05 degrees about a free flight, so what remains is the model: one restitution for all
angles, Coulomb friction, an impact without duration, a sharp corner. Given a restitution each, the drops
take 0.36 to 0.56, the height is met to 0.41 mm, and the radius of gyration becomes 22.5 mm.

Residuals of a drop therefore go together, and an interval that takes them as independent is {narrow:.0f}
times too narrow. The intervals here come from leaving out each drop in turn (jackknife, to first order,
Student's t with 7 degrees of freedom).

The floor comes out more than 3 mm below that under squares at rest. For a corner it stands for more than
the floor: one that is rounded, or yields, strikes later than a sharp one. Among 134 recordings where it can be
seen, 78 lack a frame at the first impact, and no model of an impact fits them; the eight here are the first
of those that are complete (diffrigid.data says how they were chosen).
"""

DISC_TEXT = """
Simulated: {frames} positions of each disc at {hertz} Hz, with normal noise of {camera:.0f} mm. The left
disc strikes the middle one, which strikes the right one. Fitted: the restitution of all discs, the mass of
the middle one and the initial velocity of the left one, from {starts} random starts; {agree} end at the
best cost. So that one that misses can find the impact, the fit begins with impacts smoothed over 0.5 m,
goes on with 0.1 m, and ends with exact ones.

Residuals (rms): {noise}, the noise that was put in: they are independent, and these intervals can be taken
at their word. What the data cannot tell: the scale of the masses (the outer two are given), the inertias
(discs without friction never spin), and, had the discs missed each other, the restitution.
"""


def paragraphs(text: str, **values: Any) -> list[str]:
    """Split a text into paragraphs, with values put in."""
    return [" ".join(paragraph.format(**values).split()) for paragraph in text.strip().split("\n\n")]


# ---- measured: a square that drops


def drop_scene(record: SquareDrops, drop: int) -> tuple[dr.World, State]:
    """The square at the start of a drop, of mass 1, uniform, and the floor."""
    start = {"x": record.x[drop, 0], "angle": record.angle[drop, 0], "v": record.v[drop], "w": record.w[drop]}
    inertia = 2 / 3 * record.half**2
    return dr.scene(
        {
            "square": dr.Body(dr.Box(half=(record.half, record.half)), mass=1.0, inertia=inertia, **start),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
        },
        gravity=(0.0, -record.gravity), restitution=0.5, friction=0.1,
        forces=[dr.Drag(linear=record.drag, angular=record.spin_drag * inertia)],
    )  # fmt: skip


def drop_columns(record: SquareDrops, drop: int) -> dict[str, np.ndarray]:
    """Measured columns of a drop."""
    return {"t": record.t, "square.x": record.x[drop], "square.angle": record.angle[drop]}


def fit_drops(record: SquareDrops, progress: bool | None) -> dr.Fit:
    """Restitution, friction, inertia and floor shared by all drops, and the initial state of each."""
    drops = [dr.Record(drop_columns(record, k), state=drop_scene(record, k)[1]) for k in range(len(record.trial))]
    return dr.fit(
        *drop_scene(record, 0), drops, progress=progress,
        noise={"square.x": 1e-3 * SIGMA, "square.angle": float(np.radians(SIGMA))},
        free={
            "restitution": dr.interval(0, 1), "friction": dr.positive(), "square.inertia": dr.positive(),
            "floor.shape.offset": dr.real(0.001),
            "square.x": dr.each(dr.real(0.001)), "square.v": dr.each(dr.real(0.02)),
            "square.angle": dr.each(dr.real(0.01)), "square.w": dr.each(dr.real(0.1)),
        },
    )  # fmt: skip


def drop_section(progress: bool | None) -> Section:
    """Fit the drops and show them."""
    record = square_drops()
    fit = fit_drops(record, progress)
    scattered = fit.with_intervals(dr.sandwich)
    pairs = zip(scattered.parameters, fit.parameters, strict=True)
    narrow = np.median([float((p.high - p.low) / (q.high - q.low)) for p, q in pairs if not p.records])
    t = np.linspace(0, record.t[-1], FINE * (len(record.t) - 1) + 1)
    motions = [fit.predict(times=t, record=k) for k in range(len(record.trial))]
    residuals = SIGMA * np.stack([np.concatenate([r["square.x"], r["square.angle"]], axis=1) for r in fit.residuals])
    rms = dict(zip(("x", "height", "angle"), np.sqrt(np.nanmean(residuals**2, axis=(0, 1))), strict=True))
    numbers = sum(fit.problem.sizes) + (len(motions) - 1) * fit.problem.sizes[1]
    return Section(
        title="Measured: a square that drops, eight times",
        paragraphs=paragraphs(DROP_TEXT, count=numbers, narrow=narrow, **rms),
        table=drop_table(scattered),
        player=dr.play(
            {f"drop {k + 1}": motion for k, motion in enumerate(motions)},
            {f"drop {k + 1}": drop_columns(record, k) for k in range(len(motions))},
            beside=True, speed=0.02, plot="angle", height=620,
        ),
        charts=drop_charts(motions, record, residuals),
        details={"All fitted numbers, with intervals that take residuals as independent": fit._repr_html_()},
    )  # fmt: skip


def drop_table(fit: dr.Fit) -> list[tuple[str, ...]]:
    """Rows of the four shared numbers."""

    def numbers(name: str) -> np.ndarray:
        return np.array([fit[name].value, fit[name].low, fit[name].high], float)

    gyration, floor = 1e3 * np.sqrt(numbers("square.inertia")), 1e3 * numbers("floor.shape.offset")
    return [
        row("square: restitution", numbers("restitution"), "-", "0.47 (middle half of impacts: 0.43 to 0.51)"),
        row("square: friction", numbers("friction"), "-", "at most 0.14 (95 % of |Pt / Pn|)"),
        row("square: radius of gyration", gyration, "mm", "24.5 (uniform square)"),
        row("square: height of the floor", floor, "mm", "1.75 (under squares at rest; a round corner: see the report)"),
    ]


def drop_charts(motions: Sequence[dr.Trajectory], record: SquareDrops, residuals: np.ndarray) -> list[str]:
    """Height and angle of a typical and of the worst drop, and the residuals of all."""
    order = np.argsort(np.nanmean(residuals**2, axis=(1, 2)))
    charts = []
    for kind, k in (("typical", order[len(order) // 2]), ("worst", order[-1])):
        charts += drop_curves(f"drop {k + 1} ({kind})", motions[k], record, k)
    for column, (name, unit) in enumerate((("x", "mm"), ("height", "mm"), ("angle", "degrees"))):
        label = f"fitted - measured [{unit}]"
        lines = [Curve(1e3 * record.t, each[:, column]) for each in residuals]
        charts.append(chart(f"Residuals of {name}, all drops", "time [ms]", label, lines))
    return charts


def drop_curves(title: str, motion: dr.Trajectory, record: SquareDrops, k: int) -> list[str]:
    """Height and angle of one drop, as long as it was measured."""
    t = np.asarray(motion.t, float)
    known = t < record.t[np.isfinite(record.angle[k])][-1] + 0.5 * FRAME / FINE
    x, q = np.asarray(motion.state.x, float)[known, 0], np.asarray(motion.state.q, float)[known, 0]
    angle = np.unwrap(np.arctan2(q[:, 1], q[:, 0]))
    angle += 2 * np.pi * np.round((record.angle[k, 0] - angle[0]) / (2 * np.pi))
    charts = []
    for name, unit, curve, points in (
        ("Height", "mm", 1e3 * x[:, 1], 1e3 * record.x[k, :, 1]),
        ("Angle", "degrees", np.degrees(angle), np.degrees(record.angle[k])),
    ):
        lines = [Curve(1e3 * t[known], curve, "fitted"), Curve(1e3 * record.t, points, "measured", 1, True)]
        charts.append(chart(f"{name}, {title}", "time [ms]", f"{name.lower()} [{unit}]", lines))
    return charts


# ---- synthetic: three discs that collide


def disc_world(restitution: float, mass: float, v: tuple[float, float]) -> tuple[dr.World, State]:
    """Three discs in a row on a plane without friction; the left one moves."""
    disc = dr.Disc(radius=0.4)
    return dr.scene(
        {
            "left": dr.Body(disc, mass=1.0, x=(0.0, 0.0), v=v),
            "middle": dr.Body(disc, mass=mass, x=(1.5, 0.1)),
            "right": dr.Body(disc, mass=1.0, x=(3.2, 0.35)),
        },
        restitution=restitution,
    )


def disc_section(progress: bool | None) -> Section:
    """Simulate, add noise, fit from random starts, and show it."""
    truth = dr.rollout(*disc_world(0.8, 2.0, (2.0, 0.1)), dt=1 / HERTZ, steps=FRAMES)
    random, t = np.random.default_rng(SEED), np.arange(FRAMES + 1) / HERTZ
    measured = np.asarray(truth.state.x, float) + CAMERA * random.standard_normal(truth.state.x.shape)
    world, state = disc_world(0.5, 1.0, (1.5, 0.0))
    observations = {"t": t} | {f"{name}.x": measured[:, k] for k, name in enumerate(world.names)}
    fit = dr.fit(
        world, state, observations, starts=8, widths=(0.5, 0.1, 0.0), progress=progress,
        free={"restitution": dr.interval(0, 1), "middle.mass": dr.positive(), "left.v": dr.real()},
    )  # fmt: skip
    noise = ", ".join(f"{1e3 * value:.2f} mm ({name.split('.')[0]})" for name, value in fit.noise.items())
    values = {"frames": len(t), "hertz": HERTZ, "camera": 1e3 * CAMERA, "starts": len(fit.costs), "agree": fit.agree}
    return Section(
        title="Synthetic: three discs that collide",
        paragraphs=paragraphs(DISC_TEXT, noise=noise, **values),
        table=disc_table(fit),
        player=dr.play(fit.trajectory, observations, speed=0.5, plot="x"),
        charts=disc_charts(fit, t, measured),
    )


def disc_table(fit: dr.Fit) -> list[tuple[str, ...]]:
    """One row for every number, with the truth."""
    rows = []
    for p in fit.parameters:
        truth = np.asarray(TRUTH[p.name])
        for index in np.ndindex(p.value.shape):
            label = f"discs: {p.name}{('_x', '_y')[index[0]] if index else ''}"
            numbers = float(p.value[index]), float(p.low[index]), float(p.high[index])
            rows.append(row(label, numbers, p.unit or "-", f"{truth[index]:g}"))
    return rows


def disc_charts(fit: dr.Fit, t: np.ndarray, measured: np.ndarray) -> list[str]:
    """Positions over time, and residuals."""
    x = np.asarray(fit.trajectory.state.x, float)
    charts = []
    for axis, name in enumerate("xy"):
        lines = []
        for k, body in enumerate(fit.world.names):
            lines += [Curve(t, measured[:, k, axis], "", k, True), Curve(t, x[:, k, axis], body, k)]
        charts.append(chart(f"Position {name}", "time [s]", f"{name} [m]", lines))
    for axis, name in enumerate("xy"):
        away = 1e3 * (x - measured)[:, :, axis]
        lines = [Curve(t, away[:, k], body, k) for k, body in enumerate(fit.world.names)]
        charts.append(chart(f"Residuals of {name}", "time [s]", "fitted - measured [mm]", lines))
    return charts
