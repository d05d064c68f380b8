"""`python -m diffrigid`: one measured and one synthetic identification, and a report of both."""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import diffrigid as dr
from diffrigid.data import FRAME, SquareDrops, square_drops
from diffrigid.paths import read, write
from diffrigid.state import State
from diffrigid.sysid import Free, command
from diffrigid.view.report import Section, Series, chart, row, text_table, write_report

SIGMA = 0.5  # [mm], [degrees] weight of a residual of a drop: about its size
STEPS = np.array([5e-3, 2e-3, 1e-5, 1e-4])  # restitution, friction, inertia, floor
T95 = 2.365  # two-sided 95 % quantile of Student's t for eight drops, seven degrees of freedom
FINE = 4  # simulated and drawn steps of a drop per measured frame
CAMERA = 3e-3  # [m] noise of the three discs
HERTZ, FRAMES, SEED = 60, 120, 7  # of the three discs
TRUTH = {"restitution": 0.8, "middle.mass": 2.0, "left.v": (2.0, 0.1)}

LEAD = """
Two identifications by diffrigid, from positions and angles alone: a measured one, whose answer can be
compared with what others published, and a synthetic one, whose answer is known. Both are least squares with
exact derivatives through the impacts. This file needs nothing but itself.
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
the floor: one that is rounded, or yields, strikes later than a sharp one. Of 134 recordings where it can be
told, 78 lack a frame at the first impact, and no model of an impact fits them; the eight here are the first
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit both, print one table, and write the report; or, with `fit` first, fit what two files say."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["fit"]:
        return command.main(arguments[1:])
    options = _options(arguments)
    progress = False if options.quiet else None

    def say(text: str) -> None:
        if not options.quiet:
            print(text, flush=True)

    began = time.time()
    say("1 of 2: eight measured drops of a square, the first impact of each (20 s, mostly compiling)")
    drops = drop_section(progress, say)
    say("2 of 2: three discs, simulated with 3 mm of noise, from 8 starts (15 s)")
    discs = disc_section(progress)
    path = write_report(options.out, "From measured motion to physical parameters", paragraphs(LEAD)[0], [drops, discs])
    print(f"\n{text_table([*drops.table, *discs.table])}\n\nreport: {path.resolve()}")
    say(f"{time.time() - began:.0f} s")
    return 0


def paragraphs(text: str, **values: Any) -> list[str]:
    """A text in paragraphs, values put in."""
    return [" ".join(paragraph.format(**values).split()) for paragraph in text.strip().split("\n\n")]


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m diffrigid", description=__doc__)
    parser.add_argument("--out", default="diffrigid_report.html", metavar="FILE", help="default: %(default)s")
    parser.add_argument("--quiet", action="store_true", help="print the table only")
    return parser.parse_args(arguments)


# Measured: a square that drops.


def drop_world(record: SquareDrops) -> tuple[dr.World, State, list[str]]:
    """All drops in one world, where they do not see each other, and their names."""
    names = [f"drop{k + 1}" for k in range(len(record.trial))]
    square, inertia = dr.Box(half=(record.half, record.half)), 2 / 3 * record.half**2
    start = zip(names, record.x[:, 0], record.angle[:, 0], record.v, record.w, strict=True)
    bodies = {name: dr.Body(square, mass=1.0, x=x, angle=angle, v=v, w=w) for name, x, angle, v, w in start}
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    world, state = dr.scene(
        {**bodies, "floor": floor},
        gravity=(0.0, -record.gravity), restitution=0.5, friction=0.1,
        forces=[dr.Drag(linear=record.drag, angular=record.spin_drag * inertia)],
        ignore=[(a, b) for a in names for b in names if a < b],
    )  # fmt: skip
    return world, state, names


def fit_drops(record: SquareDrops, progress: bool | None) -> dr.Fit:
    """Restitution, friction, inertia and floor shared by all drops, and the initial state of each."""
    world, state, names = drop_world(record)
    observations, noise = {"t": record.t}, dict[str, float]()
    free: dict[str | tuple[str, ...], Free] = {"restitution": dr.interval(0, 1), "friction": dr.positive()}
    free |= {tuple(f"{name}.inertia" for name in names): dr.positive(), "floor.shape.offset": dr.real(0.001)}
    for k, name in enumerate(names):
        observations |= {f"{name}.x": record.x[k], f"{name}.angle": record.angle[k]}
        noise |= {f"{name}.x": 1e-3 * SIGMA, f"{name}.angle": float(np.radians(SIGMA))}
        free |= {f"{name}.x": dr.real(0.001), f"{name}.v": dr.real(0.02)}
        free |= {f"{name}.angle": dr.real(0.01), f"{name}.w": dr.real(0.1)}
    return dr.fit(world, state, observations, free=free, noise=noise, progress=progress)


def neighbours(fit: dr.Fit, record: SquareDrops) -> dr.Trajectory:
    """The fitted motion, and that a small step away in each number, up and down: 21 worlds on the last axis.

    First the four shared numbers, then a drop's own six, those of all drops at once, because no drop feels
    another. One batch to compile, for the differences here and for the picture.
    """
    names = fit.world.names
    own: dict[str, Any] = {"x": 1e-4 * np.eye(2), "v": 1e-2 * np.eye(2), "angle": [2e-3], "w": [[0.1]]}
    shared = ["restitution"], ["friction"], [f"{name}.inertia" for name in names], ["floor.shape.offset"]
    moves: list[tuple[list[str], Any]] = list(zip(shared, STEPS, strict=True))
    moves += [([f"{name}.{field}" for name in names], step) for field, steps in own.items() for step in steps]

    def moved(amounts: Array) -> tuple[dr.World, State]:
        world, state = fit.world, fit.state
        for (paths, step), amount in zip(moves, amounts, strict=True):
            for path in paths:
                value = read(world, state, path)
                world, state = write(world, state, path, value + amount * jnp.asarray(step, value.dtype))
        return world, state

    up = jnp.eye(len(moves), dtype=fit.state.x.dtype)
    amounts = jnp.concatenate([jnp.zeros_like(up[:, :1]), up, -up], axis=1)
    world, state = jax.jit(jax.vmap(moved, in_axes=-1, out_axes=-1))(amounts)
    return dr.rollout(world, state, dt=FRAME / FINE, steps=FINE * (len(record.t) - 1))


def leave_one_out(residuals: np.ndarray) -> np.ndarray:
    """How far each drop, left out, moves the four shared numbers, to first order, (B, 4), in STEPS.

    With A_b and r_b the derivatives and residuals of drop b, both freed of what its own six numbers can
    explain, the minimum moves by (H - A_b^T A_b)^-1 A_b^T r_b, H being the sum of all A^T A.

    Args:
        residuals: (21, B, m) of the batch of `neighbours`.
    """
    centre, ups, downs = np.split(residuals, [1, 1 + len(residuals) // 2])
    slopes = np.moveaxis((ups - downs) / 2, 0, -1)  # (B, m, 10)
    own = np.linalg.qr(slopes[:, :, 4:])[0]
    columns = np.concatenate([slopes[:, :, :4], centre[0][:, :, None]], axis=2)
    columns -= own @ (np.swapaxes(own, 1, 2) @ columns)
    A, r = columns[:, :, :4], columns[:, :, 4:]
    H, pull = np.swapaxes(A, 1, 2) @ A, np.swapaxes(A, 1, 2) @ r
    return np.linalg.solve(H.sum(0) - H, pull - pull.sum(0))[:, :, 0]


def drop_residuals(states: State, record: SquareDrops) -> np.ndarray:
    """Fitted minus measured x, height [mm] and angle [degrees], (B, T+1, 3, *batch), NaN where unmeasured."""
    x, q = np.asarray(states.x, float), np.asarray(states.q, float)
    ones = (1,) * (x.ndim - 3)
    place = x - np.swapaxes(record.x, 0, 1).reshape(*x.shape[:3], *ones)
    back = np.exp(-1j * record.angle.T).reshape(*x.shape[:2], *ones)
    turn = np.angle((q[:, :, 0] + 1j * q[:, :, 1]) * back)
    return np.swapaxes(np.concatenate([1e3 * place, np.degrees(turn)[:, :, None]], axis=2), 0, 1)


def drop_section(progress: bool | None, say: Callable[[str], None]) -> Section:
    """Fit the drops and show them."""
    record = square_drops()
    fit = fit_drops(record, progress)
    say("       leaving out each drop in turn, for intervals that know of the scatter between drops")
    near = neighbours(fit, record)
    residuals = drop_residuals(jax.tree.map(lambda leaf: leaf[::FINE], near.state), record)
    weighted = np.moveaxis(np.nan_to_num(residuals / SIGMA), -1, 0)
    moved = leave_one_out(weighted.reshape(*weighted.shape[:2], -1))
    spread = STEPS * np.sqrt((len(moved) - 1) * moved.var(0))
    table, narrow = drop_table(fit, spread)
    t, states, residuals = np.asarray(near.t), jax.tree.map(lambda leaf: leaf[..., 0], near.state), residuals[..., 0]
    rms = dict(zip(("x", "height", "angle"), np.sqrt(np.nanmean(residuals**2, axis=(0, 1))), strict=True))
    return Section(
        title="Measured: a square that drops, eight times",
        paragraphs=paragraphs(DROP_TEXT, count=len(fit.covariance), narrow=narrow, **rms),
        table=table,
        player=drop_player(fit, t, states, record),
        charts=drop_charts(t, states, record, residuals),
        details={"All fitted numbers, with intervals that take residuals as independent": fit._repr_html_()},
    )


def drop_table(fit: dr.Fit, spread: np.ndarray) -> tuple[list[tuple[str, ...]], float]:
    """Rows of the four shared numbers, and by how much intervals from independent residuals are too narrow."""
    shared = fit.parameters[: len(spread)]
    half = T95 * spread
    narrow = np.median([2 * h / float(p.high - p.low) for p, h in zip(shared, half, strict=True)])
    e, mu, inertia, floor = (float(p.value) + h * np.array([0.0, -1.0, 1.0]) for p, h in zip(shared, half, strict=True))
    gyration = 1e3 * np.sqrt(np.maximum(inertia, 0.0))
    table = [
        row("square: restitution", e, "-", "0.47 (middle half of impacts: 0.43 to 0.51)"),
        row("square: friction", mu, "-", "at most 0.14 (95 % of |Pt / Pn|)"),
        row("square: radius of gyration", gyration, "mm", "24.5 (uniform square)"),
        row("square: height of the floor", 1e3 * floor, "mm", "1.75 (under squares at rest)"),
    ]
    return table, float(narrow)


def drop_player(fit: dr.Fit, t: np.ndarray, states: State, record: SquareDrops) -> dr.Player:
    """The drops side by side, each in a world of its own."""
    shape = dr.HalfSpace(normal=(0.0, 1.0), offset=float(fit["floor.shape.offset"].value))
    drag = next(force for force in fit.world.forces if isinstance(force, dr.Drag))
    runs, measured = {}, {}
    for k in range(len(record.trial)):
        alone = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[:, k : k + 1], states)
        inertia, half = float(fit.world.bodies.inertia[k]), (record.half, record.half)
        square = dr.Body(dr.Box(half=half), mass=1.0, inertia=inertia, x=alone.x[0, 0], q=alone.q[0, 0])
        bodies: dict[str, dr.Body | dr.Static] = {"square": square, "floor": dr.Static(shape)}
        world, _ = dr.scene(bodies, gravity=(0.0, -record.gravity), forces=[drag])
        runs[f"drop {k + 1}"] = dr.Trajectory(t=jnp.asarray(t), state=alone, world=world)
        measured[f"drop {k + 1}"] = {"t": record.t, "square.x": record.x[k], "square.angle": record.angle[k]}
    return dr.play(runs, measured, beside=True, speed=0.02, plot="angle", height=620)


def drop_charts(fine_t: np.ndarray, states: State, record: SquareDrops, residuals: np.ndarray) -> list[str]:
    """Height and angle of a typical and of the worst drop, and the residuals of all."""
    order = np.argsort(np.nanmean(residuals**2, axis=(1, 2)))
    charts = []
    for kind, k in (("typical", order[len(order) // 2]), ("worst", order[-1])):
        charts += drop_curves(f"drop {k + 1} ({kind})", k, fine_t, states, record)
    for column, (name, unit) in enumerate((("x", "mm"), ("height", "mm"), ("angle", "degrees"))):
        label = f"fitted - measured [{unit}]"
        lines = [Series(1e3 * record.t, each[:, column]) for each in residuals]
        charts.append(chart(f"Residuals of {name}, all drops", "time [ms]", label, lines))
    return charts


def drop_curves(title: str, k: int, fine_t: np.ndarray, states: State, record: SquareDrops) -> list[str]:
    """Height and angle of one drop, as long as it was measured."""
    known = fine_t < record.t[np.isfinite(record.angle[k])][-1] + 0.5 * FRAME / FINE
    x, q = np.asarray(states.x, float)[known, k], np.asarray(states.q, float)[known, k]
    angle = np.unwrap(np.arctan2(q[:, 1], q[:, 0]))
    angle += 2 * np.pi * np.round((record.angle[k, 0] - angle[0]) / (2 * np.pi))
    charts = []
    for name, unit, curve, points in (
        ("Height", "mm", 1e3 * x[:, 1], 1e3 * record.x[k, :, 1]),
        ("Angle", "degrees", np.degrees(angle), np.degrees(record.angle[k])),
    ):
        lines = [Series(1e3 * fine_t[known], curve, "fitted"), Series(1e3 * record.t, points, "measured", 1, True)]
        charts.append(chart(f"{name}, {title}", "time [ms]", f"{name.lower()} [{unit}]", lines))
    return charts


# Synthetic: three discs that collide.


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
            lines += [Series(t, measured[:, k, axis], "", k, True), Series(t, x[:, k, axis], body, k)]
        charts.append(chart(f"Position {name}", "time [s]", f"{name} [m]", lines))
    for axis, name in enumerate("xy"):
        away = 1e3 * (x - measured)[:, :, axis]
        lines = [Series(t, away[:, k], body, k) for k, body in enumerate(fit.world.names)]
        charts.append(chart(f"Residuals of {name}", "time [s]", "fitted - measured [mm]", lines))
    return charts


if __name__ == "__main__":
    raise SystemExit(main())
