"""Measured records that come with the package, each with its licence beside it."""

from dataclasses import dataclass
from importlib.resources import files

import numpy as np

FRAME = 1 / 250  # [s] between two frames of the square drops


@dataclass(frozen=True)
class SquareDrops:
    """Eight drops of a square, each over its first impact. NaN: after the end of a drop's record."""

    trial: np.ndarray  # (B,) number of the recording in the source
    t: np.ndarray  # (T+1,) [s] from 0 for every drop
    x: np.ndarray  # (B, T+1, 2) [m] centre, second component up
    angle: np.ndarray  # (B, T+1) [rad] counter-clockwise, 0 = flat on a face
    v: np.ndarray  # (B, 2) [m/s] at t = 0, from the first fall: a start for a fit
    w: np.ndarray  # (B,) [rad/s] at t = 0, likewise
    half: float = 0.03  # [m] half the side
    gravity: float = 9.81  # [m/s^2]
    drag: tuple[float, float] = (0.557, 0.325)  # [1/s] of x and of z, from the plates: a = -drag v
    spin_drag: float = 0.455  # [1/s] of the angular velocity, likewise


def square_drops() -> SquareDrops:
    """Measured drops of a 60 mm square between two vertical plates: planar motion, metres, radians, 250 Hz.

    Source: github.com/DAIRLab/ImpactModeling, `Wang-Mason Square`, BSD-3-Clause (`LICENSE-square-drop` beside
    this file); measured by N. Fazeli et al. at MIT, arXiv 1710.05947. The mass is not published; gravity and
    drag are those of 1021 free flights of the same record.

    The first eight recordings, in the order of the source, in which
        one corner strikes, the nearest face being turned by more than 15 degrees, and strikes alone: at least
        22 frames of free flight follow;
        no frame is lost at the impact: the arcs of the 7 frames before and the 12 frames after it meet, in x, z
        and angle at one time, to 0.35 mm and 0.35 degrees. Among 134 recordings where it can be seen, 78 only do so
        when one arc is shifted by a frame: tracking lost one, and no model of an impact fits those 4 ms.
    Each begins three frames before the first contact and ends twenty frames after the impact.
    """
    with (files(__package__) / "square_drops.npz").open("rb") as file, np.load(file) as arrays:
        x, angle, v, w = (np.asarray(arrays[name], float) for name in ("x", "angle", "v", "w"))
        return SquareDrops(trial=arrays["trial"], t=FRAME * np.arange(x.shape[1]), x=x, angle=angle, v=v, w=w)
