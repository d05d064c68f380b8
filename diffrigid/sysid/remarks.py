"""Remarks of a fit on its result as a whole, apart from the uncertainty of its numbers."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.catalogue import catalogue, component
from diffrigid.constraints import joint_errors, placed
from diffrigid.flight import has_torque
from diffrigid.forces import Gravity, GroundFriction
from diffrigid.joint_motion import fields_of, moving_side
from diffrigid.paths import read, write
from diffrigid.shapes import Disc, Sphere
from diffrigid.state import rotations
from diffrigid.sysid.covariance import ROUNDING, Linear
from diffrigid.sysid.diagnosis import LARGE, RARE, whiteness
from diffrigid.sysid.first_rows import is_begun
from diffrigid.sysid.levenberg import Numbers, Point, cost_of, point_at
from diffrigid.sysid.losses import Squares
from diffrigid.sysid.noise import exact_columns
from diffrigid.sysid.parameters import Scene, pieces
from diffrigid.sysid.points import linear_of
from diffrigid.sysid.problem import full_turn
from diffrigid.sysid.records import Run
from diffrigid.sysid.sensors import JointPart
from diffrigid.sysid.setup import Problem
from diffrigid.sysid.table import ENDED, FAILED
from diffrigid.world import World, seats

AS_LARGE = 0.5  # [-] of the spread of a column: larger residuals, if they are autocorrelated, mean that the fit failed
ANYWHERE = 0.25  # [-] of a turn: residuals of uniformly random angles are 1 / sqrt(12) of a turn
OTHER = 1.1  # [-] change of the mass of a solid body beyond which an unchanged inertia is doubted
ONE_SIDED = 0.1  # [-] of the information on a friction at the best fit: less a little above it is an end of slip
WILD = 1e8  # [unit of a column] by one unit of a number: no motion that the steps resolve changes by so much
FALLS = (1e-6, 1e-2)  # [-] of the cost, by its slopes: least that is worth a look there, and about the most of a look
JUMPS = 2.0  # [-] a rise of the cost there: a jump
TORN = 1e-3  # [m or rad] largest error of a joint at the fitted start without a remark


def remarks_on(
    problem: Problem, scenes: Sequence[Scene], residuals: Sequence[dict[str, np.ndarray]], strikes: bool
) -> list[str]:
    """Remarks on a fit, the worst first.

    Args:
        scenes: fitted, of every record.
        residuals: of every record by column, (K, size), in units of the column, NaN where missing.
        strikes: whether anything strikes in the fitted motion.
    """
    failure = failed(problem, residuals, strikes)
    out = [failure] if failure else []
    out += _torn(scenes[0]) + _light_inertia(problem, scenes[0]) + _averaged(problem)
    if np.isfinite(problem.window):
        out.append(f"only the first {problem.window:g} s of each record are fitted")
    return out


def sticking(problem: Problem, point: Point, best: int, linear: Linear, covariance: np.ndarray) -> list[str]:
    """Remarks on frictions that ended where what slipped begins to stick, so that larger ones fit as well.

    Not on those that are hardly seen, as at a bound: a little above them is then no longer near them.
    """
    information, out = sum((slopes**2).sum(0) for slopes in linear.slopes), []
    for slot, rows in pieces(problem.shared):
        one = rows.start
        if not component(slot.paths[0])[0].endswith("friction") or not 0 < covariance[one, one] < LARGE**2:
            continue
        up = 2.0 * np.sqrt(covariance[one, one]) * np.eye(len(point.z.shared))[one]
        above = _beside(problem, point, best, up, np.zeros(point.z.own.shape[:-1]))
        slopes = linear_of(problem, above, best, Squares(), False).slopes
        if sum((jacobian[:, one] ** 2).sum() for jacobian in slopes) < ONE_SIDED * information[one]:
            out.append(
                f"{slot.name}{ENDED}: larger values fit as well, and the lower end of its interval is of slopes beside "
                f'a kink; see dr.profile(fit, "{slot.name}")'
            )
    return out


def _beside(problem: Problem, point: Point, best: int, shared: np.ndarray, own: np.ndarray) -> Point:
    """The point of the best start moved by `shared` (a) and `own` (b, R), in the places of all."""
    by = Numbers(*(jnp.asarray(part, problem.dtype) for part in (shared, own)))
    return point_at(problem.groups, _moved(point.z, best, by))


@jax.jit
def _moved(z: Numbers, best: Array, by: Numbers) -> Numbers:
    return jax.tree.map(lambda leaf, by: jnp.broadcast_to((leaf[..., best] + by)[..., None], leaf.shape), z, by)


def beside_a_jump(problem: Problem, point: Point, best: int, linear: Linear, loss: Any) -> list[str]:
    """Remarks on a best fit whose slopes mislead: they are enormous, or the cost rises where by them it falls."""
    a = linear.shared
    g = np.stack([slopes.T @ rows for slopes, rows in zip(linear.slopes, linear.rows, strict=True)])  # (R, a + b)
    h = np.stack([(slopes**2).sum(0) for slopes in linear.slopes])
    noise = [*problem.noise.values(), *(np.nanmin(sigma) for run in problem.runs for sigma in run.noise.values())]
    if not np.isfinite(h).all() or np.sqrt(h.max(initial=0.0)) * min(noise) > WILD:
        return [
            "the slopes of the residuals are enormous: the motion is unstable, or chaotic; make dt smaller, or begin "
            "with a short part, windows=(0.5, 1, inf)"
        ]
    if len(exact_columns(problem)) == len(noise):  # rounding jumps everywhere
        return []
    shared = -_ratio(g[:, :a].sum(0), h[:, :a].sum(0))
    own = -_ratio(g[:, a:], h[:, a:])
    falls = -(g[:, :a].sum(0) @ shared + (g[:, a:] * own).sum())
    if falls < FALLS[0]:
        return []
    share = min(1.0, FALLS[1] / falls)
    beside = _beside(problem, point, best, share * shared, share * own.T)
    here, there = (float(cost_of(loss, p.residuals)[k]) for p, k in ((point, best), (beside, 0)))
    if there - here < JUMPS:
        return []
    return [
        "the cost jumps beside the best fit, as where another corner strikes, or another body: intervals hold on one "
        "side at most; see dr.profile, and more starts"
    ]


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a / b, 0 where b is 0 or, of squares of slopes, rounding: what nothing measured shows is not moved."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > ROUNDING**2 * b.max(initial=0.0))


def failed(problem: Problem, residuals: Sequence[dict[str, np.ndarray]], strikes: bool, least: float = AS_LARGE) -> str:
    """Say which residuals are so large that this is no fit; "" if none are.

    Args:
        residuals, strikes: as in `remarks_on`.
        least: [-] of the spread of a column, from which on residuals that are not noise are too large.
    """
    names = [
        series.name
        for run, record in zip(problem.runs, residuals, strict=True)
        for series in run.series
        if _is_lost(run, series.name, series.values, record[series.name], least)
    ]
    if not names:
        return ""
    size = "as large as" if least >= AS_LARGE else "not small beside"
    several = ", each() where records differ" if len(problem.runs) > 1 else ""
    if unseen := [k for k, run in enumerate(problem.runs) if not is_begun(run, problem.own)]:
        several += (
            f"; record {', '.join(map(str, unseen[:3]))}{', ...' if unseen[3:] else ''} began at the state of the "
            "scene, as the first rows do not show one: give a guess, dr.Record(..., state=first)"
        )
    return (
        f"{FAILED}: residuals of {', '.join(dict.fromkeys(names))} are {size} the motion; look at units (m, s, "
        "rad; degrees need scale=180 / pi), at signs, and at the values to begin with, or try more starts; the start "
        f"has to be free where it is not known{several}{''.join(_lacking(problem, strikes))}"
    )


def _lacking(problem: Problem, strikes: bool) -> Iterator[str]:
    """What the scene of a fit that failed may lack, or be given the other way round."""
    world, channels = problem.runs[0].world, problem.runs[0].channels
    if not (world.pairs or world.crowd):
        yield "; no two shapes of this scene can meet: does it lack a floor?"
    elif not strikes:
        yield "; nothing strikes in the motion it ended with: if something did, begin where it does, or with widths="
    if not any(isinstance(force, Gravity | GroundFriction) for force in world.forces):
        yield "; it has no gravity"
    if any(isinstance(channel.observer, JointPart) for channel in channels.values()):
        yield "; an angle of a hinge is that of its first body relative to its second: look at their order"


def _is_lost(run: Run, name: str, values: np.ndarray, residuals: np.ndarray, least: float) -> bool:
    """Whether residuals are at least this share of the spread of the measured values, and are not noise."""
    residuals, values = (part[:, np.isfinite(part).any(0)] for part in (residuals, values))
    if turn := full_turn(run, name):
        values = np.unwrap(values[np.isfinite(values).all(1)], axis=0, period=turn)
    spread, size = (np.sqrt(part.sum()) for part in (np.nanvar(values, axis=0), np.nanmean(residuals**2, axis=0)))
    if turn and bool(size > ANYWHERE * turn):
        return True
    turned = residuals.shape[1] != values.shape[1]  # by twice the change of a unit quaternion
    return bool(size > least * spread * (1.0 + turned)) and whiteness(list(residuals.T)) < RARE


def _torn(scene: Scene) -> list[str]:
    """Remarks on joints that the fitted start violates, which the motion corrects before it begins."""
    world, state = scene.world, scene.state
    if not world.joints:
        return []
    errors = np.asarray(joint_errors(rotations(world.dim), placed(world.joints, world.statics, state.x, state.q)))
    joints = [(name, joint) for names, joint in zip(world.joint_names, world.joints, strict=True) for name in names]
    out = []
    for (name, joint), size in zip(joints, np.abs(errors).max(1), strict=True):
        if size > TORN:
            own = [f", or {name}.{field}" for field in fields_of(joint)[:1] if moving_side(world, name)[1]]
            out.append(
                f"the fitted start is {size:.2g} m (or rad) off the joint {name}, onto which bodies are moved before "
                "all else: free what moves with it too, a position with an angle, anchor_b with anchor_a" + "".join(own)
            )
    return out


def _light_inertia(problem: Problem, scene: Scene) -> list[str]:
    """Remarks on solid bodies whose mass has changed in the fit, but not their inertia."""
    before, after = problem.runs[0], scene.world
    paths = {path for slot in problem.slots for path in slot.paths}
    out = []
    for i, name in enumerate(after.names):
        if f"{name}.mass" not in paths or f"{name}.density" not in catalogue(after):
            continue
        factor = float(after.bodies.mass[i] / before.world.bodies.mass[i])
        if max(factor, 1.0 / factor) <= OTHER or not _is_turned(after, i):
            continue
        density = read(before.world, before.state, f"{name}.density")
        solid, _ = write(before.world, before.state, f"{name}.density", density)
        was, would_be, is_now = (np.asarray(world.bodies.inertia[i]) for world in (before.world, solid, after))
        if np.allclose(was, would_be) and (is_now == was).all():
            out.append(
                f"{name}.mass is {factor:.2g} times what it was, {name}.inertia is as it was: where {name} is solid, "
                f"free {name}.density instead, which sets both"
            )
    return out


def _averaged(problem: Problem) -> list[str]:
    """Remarks on coefficients of one body that count half, as the scene's own are the other half."""
    world, out = problem.runs[0].world, []
    names = world.names + world.static_names
    for path in (path for slot in problem.slots for path in slot.paths):
        owner, _, coefficient = path.rpartition(".")
        own = dict(world.own).get(coefficient)
        if own is not None and owner in names and not own[names.index(owner)]:
            out.append(
                f"{path} counts half: in each pair it is averaged with the {coefficient} of the other, as {owner} was "
                f'given none of its own; give it one, {coefficient}=..., or free "{coefficient}"'
            )
    return out


def _is_turned(world: World, body: int) -> bool:
    """Whether anything can turn a body: friction, joints, torques of forces, or a shape that is not round."""
    shapes = [(world.shapes[seat.group], world.offsets[seat.group]) for seat in seats(world) if seat.owner == body]
    is_round = all(isinstance(shape, Disc | Sphere) and offset is None for shape, offset in shapes)
    rubs = bool((np.asarray(world.bodies.friction) > 0).any() or (np.asarray(world.statics.friction) > 0).any())
    return rubs or bool(world.joints) or has_torque(world) or not is_round
