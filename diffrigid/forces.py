"""Forces: each a record with its coefficients as float leaves, and a call that returns a `Wrench`.

A force is called as `force(bodies, state, controls)`. To add one, write such a record; three class
attributes let the step skip work, and all default to the general case when absent:

    constant   the wrench does not change within a step, so the flight of the step is exact
    uniform    every body has the same constant acceleration, so that relative paths are straight
    twists     the wrench has a torque

One between two bodies has their names in the fields a and b; one of each body on all others is `mutual`, a fourth class
attribute: where one is struck, its partners fly on from that time too. A `planar` one is for 2D only. One that depends
on the length of the step has `within`, see `GroundFriction`. Below 0, fields that `resist` motion are refused.
"""

import itertools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.numerics import dot, norm, normalise, safe_divide, safe_sqrt
from diffrigid.pytree import Leaf, array, pytree, replace, static
from diffrigid.state import Bodies, State, Wrench, material_point, material_velocity, rotations

SPREAD = 0.94  # [-] mean distance from the centre over the radius of gyration: 0.943 of a disc, 0.937 of a square


@pytree
class Gravity:
    """F = m g.

    Example:
        >>> made, start = dr.scene({"ball": ball}, forces={"moon": dr.Gravity(g=(0.0, -1.62))})  # path "moon.g"
        >>> round(float(dr.step(made, start, 1.0).x[0, 1]), 6)
        0.19
    """

    g: Leaf = array("D")  # (D, *batch) [m/s^2]
    constant: ClassVar[bool] = True
    uniform: ClassVar[bool] = True
    twists: ClassVar[bool] = False

    def __call__(self, bodies: Bodies, state: State, controls: Any) -> Wrench:
        del state, controls
        return Wrench(F=bodies.mass[:, None] * self.g[None])


@pytree
class Drag:
    """F = -linear * v - quadratic * |v| * v and tau = -angular * w, on every body, world axes.

    The linear part is viscous drag; the quadratic one that of air on what is thrown, rho c A / 2 of a ball.

    A linear part that is the same along all axes is one number of a fit by a tuple of its components: in 2D
    free={("drag.linear[0]", "drag.linear[1]"): dr.positive()}; "drag.linear" is one number for each axis.

    Example:
        >>> puck = dr.Body(dr.Disc(radius=0.1), mass=2.0, x=(0.0, 0.0), v=(1.0, 0.0))
        >>> made, start = dr.scene({"puck": puck}, forces=[dr.Drag(linear=0.5)])
        >>> round(float(dr.step(made, start, 1.0).v[0, 0]), 4), round(float(np.exp(-0.5 / 2.0)), 4)
        (0.7788, 0.7788)
    """

    linear: Leaf = array("D", default=0.0)  # (D, *batch) [N s/m] by axis; a number is for all, and fitted as a tuple
    angular: Leaf = array(default=0.0)  # (*batch) [N m s/rad]
    quadratic: Leaf = array(default=None)  # (*batch) [N s^2/m^2]; None: none
    resist: ClassVar[tuple[str, ...]] = ("linear", "angular", "quadratic")
    constant: ClassVar[bool] = False
    uniform: ClassVar[bool] = False
    twists: ClassVar[bool] = True

    def __call__(self, bodies: Bodies, state: State, controls: Any) -> Wrench:
        del bodies, controls
        F = -self.linear[None] * state.v
        if self.quadratic is not None:
            F = F - self.quadratic * jax.vmap(lambda v: norm(v) * v)(state.v)
        return Wrench(F=F, tau=-self.angular[None, None] * state.w)


@pytree
class GroundFriction:
    """Dry friction of bodies that slide on level ground, seen from above: pucks, cars, billiard balls. In 2D.

    F = -c v and tau = -c arm^2 w with c = friction m g / sqrt(v^2 + arm^2 w^2 + slow^2), so that a spin makes a slide
    longer, and both end together, within the step by a displacement of the order of friction g dt^2. Several records on
    one body add up. A body pushed with less than `friction m g` creeps, at most at the speed `slow`.
    Differentiable everywhere, also at rest; a `scene` in 3D refuses it.
    Source: Howe and Cutkosky, Int. J. Robotics Research 15 (1996) 557, the ellipsoid as limit surface.

    Args:
        body: the name of one; None: all bodies.
        friction: (*batch) [-]
        arm: (*batch) [m] mean distance of the pressure from the centre of mass; None: 0.94 radii of gyration, as of
            discs and squares whose weight is spread evenly, 2/3 of the radius of a disc.
        g: (*batch) [m/s^2] by which weight presses on the ground.
        slow: (*batch) [m/s] speed below which friction falls to zero; at least friction g dt / 2.

    Example:
        >>> puck = dr.Body(dr.Disc(radius=0.1), mass=2.0, x=(0.0, 0.0), v=(1.0, 0.0))
        >>> made, start = dr.scene({"puck": puck}, forces={"ice": dr.GroundFriction(friction=0.1)})
        >>> end = dr.rollout(made, start, dt=1 / 60, steps=120)["puck.x"][-1, 0]
        >>> round(float(end), 3), round(1.0**2 / (2 * 0.1 * 9.81), 3)  # v^2 / (2 friction g)
        (0.51, 0.51)
    """

    body: str | None = static(None, kw_only=False)
    friction: Leaf = array()
    arm: Leaf = array(default=None)
    g: Leaf = array(default=9.81)
    slow: Leaf = array(default=0.0)
    resist: ClassVar[tuple[str, ...]] = ("friction", "arm", "g", "slow")
    constant: ClassVar[bool] = False
    uniform: ClassVar[bool] = False
    twists: ClassVar[bool] = True
    planar: ClassVar[bool] = True

    def __call__(self, bodies: Bodies, state: State, controls: Any) -> Wrench:
        del controls
        arm = SPREAD * jnp.sqrt(bodies.inertia / bodies.mass) if self.arm is None else self.arm[None]
        most = self.friction[None] * bodies.mass * self.g[None]
        if self.body is not None:
            most = jnp.zeros_like(most).at[self.body].set(most[self.body])
        v, w = state.v, state.w
        drag = safe_divide(most, safe_sqrt((v**2).sum(1) + (arm * w[:, 0]) ** 2 + self.slow[None] ** 2))
        return Wrench(F=-drag[:, None] * v, tau=-(drag * arm**2)[:, None] * w)

    def within(self, span: Array) -> "GroundFriction":
        """The force for a step of length span (*batch) [s]: otherwise bodies would oscillate as they stop."""
        return replace(self, slow=jnp.maximum(self.slow, 0.5 * self.friction * self.g * span))


@pytree
class Force:
    """A force at a point fixed to a body; with `control`, plus what `controls[control]` holds, (D, *batch) [N].

    Example:
        >>> made, start = dr.scene({"ball": ball}, forces=[dr.Force("ball", control="push")])
        >>> push = jnp.array([[1.0, 0.0], [0.0, 0.0]])  # (T, D) [N] held over a step
        >>> dr.rollout(made, start, dt=0.5, steps=2, controls={"push": push}).state.v[:, 0, 0].tolist()
        [0.0, 0.5, 0.5]
    """

    body: str = static(kw_only=False)
    F: Leaf = array("D", default=0.0)  # (D, *batch) [N] world axes
    point: Leaf = array("D", default=None)  # (D, *batch) [m] body axes; None: the centre of mass
    control: str | None = static(default=None)
    uniform: ClassVar[bool] = False

    @property
    def constant(self) -> bool:
        """True for a force at the centre of mass; with an arm the torque varies as the body turns."""
        return self.point is None

    @property
    def twists(self) -> bool:
        """True for a force at a point, which may have an arm."""
        return self.point is not None

    def __call__(self, bodies: Bodies, state: State, controls: Any) -> Wrench:
        so, i = rotations(bodies.dim), self.body
        F = self.F if self.control is None else self.F + controls[self.control]
        F_all, tau_all = jnp.zeros_like(state.v), jnp.zeros_like(state.w)
        if self.point is not None:
            tau_all = tau_all.at[i].add(so.moment(so.rotate(state.q[i], self.point), F))
        return Wrench(F=F_all.at[i].add(F), tau=tau_all)


@pytree
class Torque:
    """A torque on a body; with `control`, plus what `controls[control]` holds, (A, *batch) [N m].

    Example:
        >>> made, start = dr.scene({"ball": ball}, forces=[dr.Torque(body="ball", tau=0.01)])
        >>> round(float(dr.step(made, start, 0.5).w[0, 0]), 6)  # I = m r^2 / 2
        1.0
    """

    body: str = static(kw_only=False)
    tau: Leaf = array("A", default=0.0)  # (A, *batch) [N m] world axes
    control: str | None = static(default=None)
    constant: ClassVar[bool] = True  # controls are held over a step
    uniform: ClassVar[bool] = False
    twists: ClassVar[bool] = True

    def __call__(self, bodies: Bodies, state: State, controls: Any) -> Wrench:
        del bodies
        tau = self.tau if self.control is None else self.tau + controls[self.control]
        return Wrench(F=jnp.zeros_like(state.v), tau=jnp.zeros_like(state.w).at[self.body].add(tau))


@pytree
class SpringDamper:
    """Spring and damper along the line between two points: F = -stiffness (l - length) - damping dl/dt.

    Anchors are in body axes, from the centre of mass; `b=None` ties to the world, and `anchor_b` is a world
    point. Where the two points coincide, the line is that of their relative velocity, or none if they rest: the force
    is differentiable there if `length` is 0, and has a kink otherwise.

    Example:
        >>> spring = dr.SpringDamper(a="ball", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=4 * np.pi**2)
        >>> made, start = dr.scene({"ball": ball}, forces={"spring": spring})  # paths "spring.stiffness", ...
        >>> dr.rollout(made, start, dt=0.01, steps=100).state.x[-1, 0].round(4).tolist()  # a period later
        [0.0, 1.0]
    """

    a: str = static(kw_only=False)
    b: str | None = static(None, kw_only=False)
    anchor_a: Leaf = array("D")  # (D, *batch) [m]
    anchor_b: Leaf = array("D")  # (D, *batch) [m]
    stiffness: Leaf = array()  # (*batch) [N/m]
    damping: Leaf = array(default=0.0)  # (*batch) [N s/m]
    length: Leaf = array(default=0.0)  # (*batch) [m] at rest
    resist: ClassVar[tuple[str, ...]] = ("damping",)
    constant: ClassVar[bool] = False
    uniform: ClassVar[bool] = False
    twists: ClassVar[bool] = True

    def __call__(self, bodies: Bodies, state: State, controls: Any) -> Wrench:
        del controls
        so = rotations(bodies.dim)
        point_a, v_a = self._end(state, self.a, self.anchor_a)
        point_b, v_b = self._end(state, self.b, self.anchor_b)
        span, parting = point_a - point_b, v_a - v_b
        apart = dot(span, span)[None] > 0
        along = normalise(jnp.where(apart, span, parting))
        # Vectors rather than a length times a direction, whose product has no derivative where both are 0.
        stretch = span - self.length[None] * along
        rate = jnp.where(apart, dot(along, parting)[None] * along, parting)
        F = -self.stiffness[None] * stretch - self.damping[None] * rate
        F_all, tau_all = jnp.zeros_like(state.v), jnp.zeros_like(state.w)
        for body, point, sign in ((self.a, point_a, 1.0), (self.b, point_b, -1.0)):
            if body is not None:
                F_all = F_all.at[body].add(sign * F)
                tau_all = tau_all.at[body].add(so.moment(point - state.x[body], sign * F))
        return Wrench(F=F_all, tau=tau_all)

    @staticmethod
    def _end(state: State, body: Any, anchor: Array) -> tuple[Array, Array]:
        if body is None:
            return anchor + jnp.zeros_like(state.x[0]), jnp.zeros_like(state.v[0])
        return material_point(state, body, anchor), material_velocity(state, body, anchor)


def ties(forces: tuple, moving: int) -> list[tuple[int, int]]:
    """Pairs of bodies whose forces depend on the motion of both."""
    pairs = []
    for force in forces:
        a, b = getattr(force, "a", None), getattr(force, "b", None)
        if a is not None and b is not None:
            pairs.append((a, b))
        if getattr(force, "mutual", False):
            pairs += list(itertools.pairwise(range(moving)))
    return pairs


def is_constant(forces: tuple) -> bool:
    """Whether no wrench changes within a step."""
    return all(getattr(force, "constant", False) for force in forces)


def is_uniform(forces: tuple) -> bool:
    """Whether all bodies have the same constant acceleration."""
    return all(getattr(force, "uniform", False) for force in forces)


def within(forces: tuple, span: Array) -> tuple:
    """The forces for a step of length span (*batch) [s]."""
    return tuple(force.within(span) if hasattr(force, "within") else force for force in forces)


def total_wrench(forces: tuple, bodies: Bodies, state: State, controls: Any) -> Wrench:
    """Sum of all wrenches; the torque is None when no force has one."""
    F, tau = jnp.zeros_like(state.v), None
    for force in forces:
        wrench = force(bodies, state, controls)
        _check_wrench(force, wrench, state)
        F = F + wrench.F
        if wrench.tau is not None and getattr(force, "twists", True):
            tau = wrench.tau if tau is None else tau + wrench.tau
    return Wrench(F=F, tau=tau)


def _check_wrench(force: Any, wrench: Any, state: State) -> None:
    """Refuse what broadcasting would spread over all bodies, or fail on without a name."""
    where = f"force {type(force).__name__}"
    if not isinstance(wrench, Wrench):
        raise TypeError(f"{where} returned a {type(wrench).__name__}, expected Wrench(F=..., tau=...)")
    for name, found, like in (("F", wrench.F, state.v), ("tau", wrench.tau, state.w)):
        if found is not None and jnp.shape(found)[:2] != like.shape[:2]:
            raise ValueError(
                f"{where}: {name} has shape {jnp.shape(found)}, expected {like.shape}, a row for each body"
            )


FORCES = Gravity, Drag, GroundFriction, Force, Torque, SpringDamper
