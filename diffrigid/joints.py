"""Joints: each a record of anchors and axes, and its error function; everything else is derived from that.

A joint is called as `joint(so, a, b)` with the poses (x, q) of its two bodies and returns its error, (E, *batch)
[m or rad], which is zero where the joint holds. To add one, write such a record and its entry in `JOINTS`.

A joint with a `coordinate`, an angle or a translation, may have limits, friction, a motor and damping along it:

    lower, upper    the coordinate stays between; it rebounds there with `restitution`. Orientations do not tell how
                    often a hinge has turned round: its angle is counted within half a turn of the middle of its limits,
                    and with one limit from an eighth of a turn beyond it
    friction        largest force or torque against a rate other than `speed`: dry friction; a motor if there is a speed
    damping         force or torque per rate: viscous friction
"""

from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from diffrigid.numerics import dot, norm
from diffrigid.pytree import Leaf, array, pytree, static
from diffrigid.so2 import perp
from diffrigid.so3 import tangents


class Pose(NamedTuple):
    """Pose of a body."""

    x: Array  # (D, *batch) [m] centre of mass
    q: Array  # (Q, *batch)


@pytree
class Revolute:
    """A hinge: two points stay together and, in 3D, two axes stay parallel.

    Anchors and axes are in body axes, from the centre of mass; for `b=None`, the world, anchor_b is a world
    point. Anchors and axes of b that are not given follow from the initial poses of the bodies.

    The angle is that of a relative to b, counter-clockwise in 2D and right-handed about the axis in 3D. For angles as a
    robot has them, the child comes first: `Revolute("forearm", "arm")`. In 3D or with limits it is 0 in the initial
    poses; otherwise it is the angle of a minus that of b.

    Example:
        >>> door = dr.Body(None, mass=9.0, inertia=0.6, x=(0.4, 0.0))
        >>> hinge = dr.Revolute("door", anchor_a=(-0.4, 0.0), upper=1.5, friction=0.2)
        >>> made, start = dr.scene({"door": door}, joints={"hinge": hinge})  # path "hinge.friction"
        >>> made.joints[0].anchor_b.tolist()  # of the world, from where the door is
        [[0.0, 0.0]]
    """

    a: Any = static(kw_only=False)  # name of a body; in a World, the colliders of all joints of a group
    b: Any = static(None, kw_only=False)
    anchor_a: Leaf = array("D")  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]
    axis_a: Leaf = array("D", default=None)  # (3, *batch) [-] 3D
    axis_b: Leaf = array("D", default=None)  # (3, *batch) [-] 3D
    zero: Leaf = array("Q", default=None)  # (Q, *batch) orientation of a in the axes of b at angle 0
    lower: Leaf = array(default=None)  # (*batch) [rad]
    upper: Leaf = array(default=None)  # (*batch) [rad]
    restitution: Leaf = array(default=None)  # (*batch) [-] at the limits; None: 0
    friction: Leaf = array(default=None)  # (*batch) [N m]
    speed: Leaf = array(default=None)  # (*batch) [rad/s] of the motor; None: 0
    damping: Leaf = array(default=None)  # (*batch) [N m s/rad]
    period = 2.0 * jnp.pi  # [rad] after which the coordinate is the same again

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        apart = separation(self, so, a, b)
        if so.D == 2:
            return apart
        along = so.rotate(a.q, self.axis_a)
        return jnp.concatenate([apart, jnp.stack([dot(so.rotate(b.q, t), along) for t in tangents(self.axis_b)])])

    def coordinate(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        """Angle of a relative to b about the axis, (*batch) [rad], within pi of the middle of its limits, or of 0."""
        turned, zero = so.difference(b.q, a.q), self.zero
        middle = middle_of(*(None if limit is None else jnp.asarray(limit) for limit in (self.lower, self.upper)))
        if middle is not None:
            zero = so.turn_in_body(zero, middle[None] if so.D == 2 else middle[None] * self.axis_a)
        angle = so.log(turned if zero is None else so.difference(zero, turned))
        along = angle[0] if so.D == 2 else dot(self.axis_a, angle)
        return along if middle is None else middle + along

    def scale(self, a: Pose, b: Pose) -> Array:
        """What the rounding of the coordinate is relative to, (*batch) [rad]."""
        del b
        return jnp.ones_like(a.x[0])


def middle_of(lower: Any, upper: Any) -> Any:
    """Middle [rad] of the turn in which the angle of a hinge is counted, by its limits; None: there are none."""
    if lower is not None and upper is not None:
        return 0.5 * (lower + upper)
    if lower is not None:
        return lower + 0.75 * jnp.pi
    return None if upper is None else upper - 0.75 * jnp.pi


@pytree
class Ball:
    """A ball and socket: two points stay together. Fields as in `Revolute`.

    Example:
        >>> bob = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, -1.0))
        >>> made, start = dr.scene({"bob": bob}, joints=[dr.Ball("bob", anchor_a=(0.0, 1.0))])
        >>> made.joint_names  # what was not named is called by its class
        (('ball',),)
    """

    a: Any = static(kw_only=False)  # name of a body; in a World, the colliders of all joints of a group
    b: Any = static(None, kw_only=False)
    anchor_a: Leaf = array("D")  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        return separation(self, so, a, b)


@pytree
class Weld:
    """Two bodies move as one. Fields as in `Revolute`.

    Example:
        >>> parts = {"plate": dr.replace(puck, v=None), "knob": dr.replace(puck, x=(0.3, 0.0), v=None)}
        >>> made, start = dr.scene(parts, joints=[dr.Weld("knob", "plate")])  # as they lie
        >>> made.joints[0].anchor_b.tolist()
        [[0.3, 0.0]]
    """

    a: Any = static(kw_only=False)  # name of a body; in a World, the colliders of all joints of a group
    b: Any = static(None, kw_only=False)
    anchor_a: Leaf = array("D", default=0.0)  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]
    q: Leaf = array("Q", default=None)  # (Q, *batch) orientation of a in the axes of b

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        return jnp.concatenate([separation(self, so, a, b), _turn(self, so, a, b)])


@pytree
class Prismatic:
    """A slider: anchor_a stays on the line through anchor_b along axis_b, and a does not turn against b.

    The translation is that of a relative to b: how far anchor_a is from anchor_b, positive along axis_b. For
    translations as a robot has them, the child comes first: `Prismatic("drawer", "desk", ...)`.

    Example:
        >>> slider = dr.Prismatic("puck", axis_b=(1.0, 0.0), lower=-1.0, upper=1.0, speed=0.5, friction=3.0)  # a motor
        >>> made, start = dr.scene({"puck": puck}, joints=[slider])
        >>> made.joints[0].anchor_b.tolist(), made.joints[0].q.tolist()  # from the start: 0 of the way, and no turn
        ([[0.0, 0.0]], [[1.0, 0.0]])
    """

    a: Any = static(kw_only=False)  # name of a body; in a World, the colliders of all joints of a group
    b: Any = static(None, kw_only=False)
    anchor_a: Leaf = array("D", default=0.0)  # (D, *batch) [m]
    anchor_b: Leaf = array("D", default=None)  # (D, *batch) [m]
    axis_b: Leaf = array("D")  # (D, *batch) [-] axes of b; of the world where b is None
    q: Leaf = array("Q", default=None)  # (Q, *batch) orientation of a in the axes of b
    lower: Leaf = array(default=None)  # (*batch) [m]
    upper: Leaf = array(default=None)  # (*batch) [m]
    restitution: Leaf = array(default=None)  # (*batch) [-] at the limits; None: 0
    friction: Leaf = array(default=None)  # (*batch) [N]
    speed: Leaf = array(default=None)  # (*batch) [m/s] of the motor; None: 0
    damping: Leaf = array(default=None)  # (*batch) [N s/m]
    period = None

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        apart = separation(self, so, a, b)
        across = [perp(self.axis_b)] if so.D == 2 else tangents(self.axis_b)
        off_line = jnp.stack([dot(so.rotate(b.q, t), apart) for t in across])
        return jnp.concatenate([off_line, _turn(self, so, a, b)])

    def coordinate(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        """Translation of anchor a relative to anchor b along the axis, (*batch) [m]."""
        return dot(so.rotate(b.q, self.axis_b), separation(self, so, a, b))

    def scale(self, a: Pose, b: Pose) -> Array:
        """What the rounding of the coordinate is relative to, (*batch) [m]."""
        return places(self, a, b)


@pytree
class Distance:
    """A massless rod between two points. Fields as in `Revolute`.

    Example:
        >>> rod = dr.Distance("ball", anchor_b=(0.0, 3.0))
        >>> made, start = dr.scene({"ball": ball}, joints=[rod])
        >>> made.joints[0].length.tolist()  # as at the start
        [2.0]
    """

    a: Any = static(kw_only=False)  # name of a body; in a World, the colliders of all joints of a group
    b: Any = static(None, kw_only=False)
    anchor_a: Leaf = array("D", default=0.0)  # (D, *batch) [m]
    anchor_b: Leaf = array("D")  # (D, *batch) [m]
    length: Leaf = array(default=None)  # (*batch) [m]; None: as at the start

    def __call__(self, so: ModuleType, a: Pose, b: Pose) -> Array:
        return (norm(separation(self, so, a, b)) - self.length)[None]


JOINTS = (Revolute, Ball, Weld, Prismatic, Distance)


def separation(joint: Any, so: ModuleType, a: Pose, b: Pose) -> Array:
    """Vector from anchor b to anchor a, (D, *batch) [m]."""
    return a.x + so.rotate(a.q, joint.anchor_a) - b.x - so.rotate(b.q, joint.anchor_b)


def places(joint: Any, a: Pose, b: Pose) -> Array:
    """Sum of the lengths that the separation of the anchors is the difference of, (*batch) [m]."""
    return norm(a.x) + norm(b.x) + norm(joint.anchor_a) + norm(joint.anchor_b)


def _turn(joint: Any, so: ModuleType, a: Pose, b: Pose) -> Array:
    """Rotation of a from its nominal orientation in b, (A, *batch) [rad], to first order."""
    return so.chord(so.difference(joint.q, so.difference(b.q, a.q)))
