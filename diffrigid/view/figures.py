"""Pictures for papers, with matplotlib: each draws into `ax`, or new axes, and returns them; and a film of a motion.

view.strobe(trajectory).figure.savefig("motion.pdf")
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from diffrigid import state as of_state
from diffrigid.convert import at_least_one, positive
from diffrigid.gaps import rotated
from diffrigid.trajectory import Trajectory, checked
from diffrigid.view.frames import energies, turns
from diffrigid.view.outline import outline
from diffrigid.world import World, seated, seats


def strobe(trajectory: Trajectory, pictures: int = 10, ax: Any = None) -> Any:
    """Draw the outlines of all bodies at evenly spaced stored times, the later the darker, and their paths [m]. 2D.

    Raises:
        ValueError: a motion in 3D, or many; pictures < 1.
    """
    world, pictures = checked(trajectory).world, at_least_one("pictures", pictures)
    if world.dim != 2:
        raise ValueError("strobe draws 2D motions: for 3D use play, or plot components of state.x")
    (x, q), shapes, ax = _poses(trajectory), _outlines(world, range(len(world.names))), _axes(ax)
    rows = np.unique(np.rint(np.linspace(0, len(x) - 1, pictures)).astype(int))
    for owner, lines in shapes:
        for n in rows:
            shade = 0.25 + 0.75 * n / max(rows[-1], 1)
            ax.plot(*(x[n, owner] + rotated(q[n, owner], lines)).T, color=f"C{owner}", alpha=shade, linewidth=1.2)
    for body, name in enumerate(world.names):
        ax.plot(*x[:, body].T, color=f"C{body}", linewidth=0.6, label=name)
    _stage(ax, world, x, shapes)
    return _labelled(ax, "x [m]", "y [m]")


def film(trajectory: Trajectory, path: str | Path, speed: float = 1.0, rate: int = 30) -> Path:
    """Write a 2D motion as .gif, or as .mp4 if ffmpeg is there, at `rate` pictures a second; `speed` 1 is real time.

    Raises:
        ValueError: a motion in 3D, or many; speed that is not above 0, or rate < 1; a file that cannot be written.
    """
    world, path = checked(trajectory).world, Path(path)
    speed, rate = float(positive("speed", speed, "1 is real time")), at_least_one("rate", rate)
    if world.dim != 2:
        raise ValueError("film draws 2D motions: for 3D use play")
    animation, figure, _ = _matplotlib()
    kinds: dict[str, Any] = {".gif": animation.PillowWriter, ".mp4": animation.FFMpegWriter}
    if path.suffix not in kinds or not kinds[path.suffix].isAvailable():
        raise ValueError(f"film: cannot write {path.name!r}: use .gif, which needs pillow, or .mp4, which needs ffmpeg")
    (x, q), t = _poses(trajectory), np.asarray(trajectory.t, float)
    shapes = _outlines(world, range(len(world.names)))
    ax = figure.Figure().subplots()
    _stage(ax, world, x, shapes)
    curves = [ax.plot([], [], color=f"C{owner}")[0] for owner, _ in shapes]
    writer = kinds[path.suffix](fps=rate)
    with writer.saving(ax.figure, path, dpi=100):
        for now in np.arange(t[0], t[-1] + 1e-9, speed / rate):
            n = int(np.abs(t - now).argmin())
            for (owner, lines), curve in zip(shapes, curves, strict=True):
                curve.set_data(*(x[n, owner] + rotated(q[n, owner], lines)).T)
            writer.grab_frame()
    return path


def energy(trajectory: Trajectory, ax: Any = None) -> Any:
    """Plot kinetic, potential (gravity and springs) and total energy [J] of all bodies over time.

    Raises:
        ValueError: many motions.
    """
    world, ax, t = checked(trajectory).world, _axes(ax), np.asarray(trajectory.t)
    for column, name in zip(energies(world, trajectory.state).T, ("kinetic", "potential", "total"), strict=True):
        ax.plot(t, column, label=name, color="k" if name == "total" else None)
    return _labelled(ax, "time [s]", "energy [J]")


def momentum(trajectory: Trajectory, angular: bool = False, ax: Any = None) -> Any:
    """Plot the momentum of all bodies [N s] over time, or their angular momentum about the origin [N m s].

    Raises:
        ValueError: many motions.
    """
    world, ax, t = checked(trajectory).world, _axes(ax), np.asarray(trajectory.t)
    of = of_state.angular_momentum if angular else of_state.momentum
    total = np.asarray(of(world.bodies, trajectory.state)).sum(1)  # (T, D or A)
    for column, name in zip(total.T, "xyz" if total.shape[1] > 1 else "z", strict=False):
        ax.plot(t, column, label=name)
    return _labelled(ax, "time [s]", "angular momentum [N m s]" if angular else "momentum [N s]")


def phase(trajectory: Trajectory, body: str, axis: str = "x", ax: Any = None) -> Any:
    """Plot velocity [m/s] against position [m] of a body along an axis, or angular velocity against "angle" (2D).

    Raises:
        ValueError: many motions; no such body or axis.
    """
    world, state = checked(trajectory).world, trajectory.state
    names = ["x", "y", "angle"] if world.dim == 2 else ["x", "y", "z"]
    if body not in world.names or axis not in names:
        raise ValueError(f"phase: no {axis!r} of {body!r}: bodies are {world.names}, axes {names}")
    k, row, ax = world.names.index(body), names.index(axis), _axes(ax)
    if axis == "angle":
        w = np.asarray(state.w, float)
        ax.plot(turns(np.asarray(trajectory.t, float), np.asarray(state.q, float), w)[:, k, 0], w[:, k, 0], label=body)
        return _labelled(ax, "angle [rad]", "angular velocity [rad/s]")
    ax.plot(np.asarray(state.x)[:, k, row], np.asarray(state.v)[:, k, row], label=body)
    return _labelled(ax, f"{axis} [m]", f"v_{axis} [m/s]")


def _poses(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(trajectory.state.x, float), np.asarray(trajectory.state.q, float)


def _outlines(world: World, colliders: range, reach: float = 0.0) -> list[tuple[int, np.ndarray]]:
    """Collider and closed outline (P, 2) [m], about its centre, of every shape of these colliders."""
    found = []
    for seat in (seat for seat in seats(world) if seat.owner in colliders):
        shape, r, q = jax.tree.map(np.asarray, seated(world, seat))
        lines = outline(shape, 2, reach=reach)
        lines = lines if q is None else rotated(q, lines)
        found.append((seat.owner, lines if r is None else lines + r))
    return found


def _stage(ax: Any, world: World, x: np.ndarray, shapes: list) -> None:
    """Draw the statics, and set limits that contain the whole motion of bodies with these outlines."""
    pad = max((1.1 * float(np.linalg.norm(lines, axis=1).max()) for _, lines in shapes), default=0.0)
    low, high = np.nanmin(x, axis=(0, 1)) - pad, np.nanmax(x, axis=(0, 1)) + pad
    pad = 0.05 * float((high - low).max())
    low, high = low - pad, high + pad
    still_x, still_q = (np.asarray(leaf, float) for leaf in (world.statics.x, world.statics.q))
    corners, moving = np.maximum(np.abs(low - still_x), np.abs(high - still_x)), len(world.names)  # the farthest
    reach = float(np.linalg.norm(corners, axis=1).max(initial=0.0))
    for owner, lines in _outlines(world, range(moving, moving + len(still_x)), reach):
        x, q = still_x[owner - moving], still_q[owner - moving]
        ax.plot(*(x + rotated(q, lines)).T, color="0.4", linewidth=1.2)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")


def _axes(ax: Any) -> Any:
    return _matplotlib()[2].subplots()[1] if ax is None else ax


def _matplotlib() -> tuple[Any, Any, Any]:
    """The modules animation, figure and pyplot."""
    try:
        from matplotlib import animation, figure, pyplot
    except ImportError:
        raise ImportError('figures need matplotlib: pip install "diffrigid[notebook]"') from None
    return animation, figure, pyplot


def _labelled(ax: Any, across: str, up: str) -> Any:
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.legend(frameon=False)
    return ax
