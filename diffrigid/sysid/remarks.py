"""What a fit says of its result as a whole, before it says how sure its numbers are."""

from collections.abc import Sequence

import numpy as np

from diffrigid.constraints import joint_errors, placed
from diffrigid.joint_motion import fields_of, moving_side
from diffrigid.state import rotations
from diffrigid.sysid.diagnosis import RARE, whiteness
from diffrigid.sysid.parameters import Scene
from diffrigid.sysid.problem import full_turn
from diffrigid.sysid.records import Run
from diffrigid.sysid.setup import Problem

AS_LARGE = 0.5  # [-] of the spread of a column: residuals from which on, if they follow each other, nothing is fitted
ANYWHERE = 0.25  # [-] of a turn: angles that are anywhere have residuals of 1 / sqrt(12) of one
TORN = 1e-3  # [m or rad] by which a joint may be off at the fitted start


def remarks_on(problem: Problem, scenes: Sequence[Scene], residuals: Sequence[dict[str, np.ndarray]]) -> list[str]:
    """Remarks on a fit, the worst first.

    Args:
        scenes: fitted, of every record.
        residuals: of every record by column, (K, size), in units of the column, NaN where missing.
    """
    names = [
        series.name
        for run, record in zip(problem.runs, residuals, strict=True)
        for series in run.series
        if _is_lost(run, series.name, series.values, record[series.name][: len(series.t)])
    ]
    out = []
    if names:
        out.append(
            f"this is no fit: residuals of {', '.join(dict.fromkeys(names))} are as large as the motion; look at units "
            "(m, s, rad; degrees need scale=180 / pi) and at the values to begin with, or try more starts"
        )
    out += _torn(scenes[0])
    if np.isfinite(problem.window):
        out.append(f"only the first {problem.window:g} s of each record are fitted")
    return out


def _is_lost(run: Run, name: str, values: np.ndarray, residuals: np.ndarray) -> bool:
    """Whether residuals are as large as what was seen varies, and are not noise."""
    residuals, values = (part[:, np.isfinite(part).any(0)] for part in (residuals, values))
    if turn := full_turn(run, name):
        values = np.unwrap(values[np.isfinite(values).all(1)], axis=0, period=turn)
    spread, size = (np.sqrt(part.sum()) for part in (np.nanvar(values, axis=0), np.nanmean(residuals**2, axis=0)))
    if turn and bool(size > ANYWHERE * turn):
        return True
    turned = residuals.shape[1] != values.shape[1]  # by twice the change of a unit quaternion
    return bool(size > AS_LARGE * spread * (1.0 + turned)) and whiteness(list(residuals.T)) < RARE


def _torn(scene: Scene) -> list[str]:
    """Joints that the bodies at the fitted start are off, which the first step puts right at once."""
    world, state = scene.world, scene.state
    if not world.joints:
        return []
    errors = np.asarray(joint_errors(rotations(world.dim), placed(world.joints, world.statics, state.x, state.q)))
    joints = [
        (name, "".join(f"{name}.{field}" for field in fields_of(joint)[:1] if moving_side(world, name)[1]))
        for names, joint in zip(world.joint_names, world.joints, strict=True)
        for name in names
    ]
    return [
        f"the fitted start is {size:.2g} m (or rad) off the joint {name}, onto which the first step moves the bodies: "
        "free what moves with it too, a position with an angle, anchor_b with anchor_a" + (f", or {own}" if own else "")
        for (name, own), size in zip(joints, np.abs(errors).max(1), strict=True)
        if size > TORN
    ]
