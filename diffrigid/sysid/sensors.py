"""What a measured column observes: a function of the state, and the errors of the instrument.

An observer is a callable record `observer(state) -> (size, *batch)` for one time; its float leaves can be fitted by
the path COLUMN.field: the `point` of a Marker in the column "tip" is "tip.point". One of your own is a dataclass that
JAX knows, whose numbers have, like those of the state, trailing batch axes:

    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Height:
        floor: float                              # free={"h.floor": dr.real()}
        body: int = dataclasses.field(metadata={"static": True})  # the index of a body; its name is replaced by it

        def __call__(self, state):
            return state.x[self.body, 1] - self.floor

    observe={"h": Height(floor=0.1, body="ball")}

Every column has besides

    COLUMN.bias     (size,)  what it reads where it should read 0, in its unit
    COLUMN.scale    [-]      what it reads per unit
    COLUMN.clock    [s]      how far its clock is ahead: its time t is t - clock in the simulation
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid import joint_motion, so3
from diffrigid.numerics import norm
from diffrigid.pytree import Leaf, array, pytree, static
from diffrigid.state import State, material_point, rotations
from diffrigid.world import World


def _first(metadata: dict[str, Any] | None = None) -> Any:
    """Field that may be given by position."""
    return dataclasses.field(kw_only=False, metadata=metadata)


@pytree
class Part:
    """A field of a body's state: "ball.x", "ball.v", "ball.w", or "ball.angle" (2D) and "ball.q", up to full turns."""

    body: Any = static()
    field: str = static()

    def __call__(self, state: State) -> Array:
        if self.field == "angle":
            return jnp.arctan2(state.q[self.body, 1:], state.q[self.body, :1])
        return getattr(state, self.field)[self.body]


@pytree
class JointPart:
    """Coordinate or rate of a joint: "hinge.angle" (up to full turns), "slider.translation", or the rate of either."""

    joint: str = static()
    field: str = static()

    def __call__(self, state: State, world: World) -> Array:
        return joint_motion.read(world, state, self.joint, self.field)[None]


@pytree
class Component:
    """One number of another observer: "ball.x[0]"."""

    of: Any = _first()
    index: int = static()

    def __call__(self, state: State) -> Array:
        return self.of(state)[self.index : self.index + 1]


@pytree
class Marker:
    """World position of a point fixed to a body, (D,) [m].

    Example:
        >>> dr.Marker(0, point=jnp.array([0.1, 0.0]))(state).tolist()  # for `fit` by name: Marker("ball", point=...)
        [0.1, 1.0]
    """

    body: Any = _first({"static": True})
    point: Leaf = array("D", default=0.0)  # (D, *batch) [m] body axes, from the centre of mass

    def __call__(self, state: State) -> Array:
        return material_point(state, self.body, self.point)


@pytree
class Separation:
    """Distance between two observed points, (1,) [m]; each a Marker or the name of a body.

    Example:
        >>> ends = (dr.Marker(0, point=jnp.array(point)) for point in ((0.3, 0.0), (0.0, 0.4)))
        >>> round(float(dr.Separation(*ends)(state)[0]), 6)  # for `fit` by name: Separation("cue", "ball")
        0.5
    """

    a: Any = _first()
    b: Any = _first()

    def __call__(self, state: State) -> Array:
        return norm(self.a(state) - self.b(state))[None]


@pytree
class Homography:
    """Pixels of a point of the plane in a camera that looks at it: (u, v) = (h0, h1) / h2, h = matrix (x, y, 1).

    Example:
        >>> camera = jnp.array([[100.0, 0.0, 320.0], [0.0, -100.0, 240.0], [0.0, 0.0, 1.0]])
        >>> dr.Homography(dr.Marker(0, point=jnp.zeros(2)), matrix=camera)(state).tolist()
        [320.0, 140.0]
    """

    of: Any = _first()
    matrix: Leaf = array("H", "H")  # (3, 3, *batch)

    def __call__(self, state: State) -> Array:
        x = self.of(state)
        h = self.matrix[:, 0] * x[:1] + self.matrix[:, 1] * x[1:] + self.matrix[:, 2]
        return h[:2] / h[2:]


@pytree
class Pinhole:
    """Pixels of a point of space: (u, v) = focal (X, Y) / Z + center, in camera axes x right, y down, z forward.

    Example:
        >>> lens = {"x": jnp.array([0.0, 0.0, -2.0]), "q": jnp.array([1.0, 0.0, 0.0, 0.0]), "focal": jnp.asarray(500.0)}
        >>> seen = dr.Pinhole(lambda _: jnp.array([0.1, 0.0, 0.0]), center=jnp.array([320.0, 240.0]), **lens)
        >>> seen(None).tolist()  # 0.1 m to its right, 2 m before it
        [345.0, 240.0]
    """

    of: Any = _first()
    x: Leaf = array("D")  # (3, *batch) [m] of the camera
    q: Leaf = array("Q")  # (4, *batch) camera axes to world
    focal: Leaf = array()  # (*batch) [pixel]
    center: Leaf = array("P", default=(0.0, 0.0))  # (2, *batch) [pixel]

    def __call__(self, state: State) -> Array:
        seen = so3.unrotate(self.q, self.of(state) - self.x)
        return self.focal[None] * seen[:2] / seen[2:] + self.center


@pytree
class Function:
    """Any function of the state (N, D, *batch), for one time, that returns a number or a vector."""

    fn: Callable = static()

    def __call__(self, state: State) -> Array:
        return self.fn(state)


@pytree
class Channel:
    """One column: what it observes, and its instrument.

    It reads scale times what is observed, plus `bias`. `clock` [s] is how far its clock is ahead: at its time t it sees
    the motion at t - clock. Each can be fitted, whether the column was given as a `Channel` or not: "COLUMN.clock".

    Example:
        >>> tip = dr.Channel(dr.Marker("ball", point=(0.1, 0.0)), clock=0.02)
        >>> columns, late = {"t": measured["t"], "tip": measured["ball.x"]}, {"tip.clock": dr.real()}
        >>> dr.sysid.make_problem(world, state, columns, free=late, observe={"tip": tip}).shared[0].name
        'tip.clock'
    """

    observer: Any = _first()
    bias: Leaf = array("M", default=0.0)  # (size, *batch) in the unit of the column
    scale: Leaf = array(default=1.0)  # (*batch) [-]
    clock: Leaf = array(default=0.0)  # (*batch) [s]
    # Filled in: classes of the observer and its parts. JAX takes equal records of two classes for one another, such as
    # those of a class before and after it was edited in a notebook.
    classes: tuple[type, ...] = static(default=())


def predict(channel: Channel, world: World, states: State) -> Array:
    """Readings of the instrument at K times, (K, size, *batch), for states with a leading axis of times."""
    return channel.scale[None, None] * jax.vmap(partial(seen, channel.observer, world))(states) + channel.bias[None]


def seen(observer: Any, world: World, state: State) -> Array:
    """What an observer reads in a state at one time, (size, *batch); it may return a number."""
    value = observer(state, world) if isinstance(observer, JointPart) else observer(state)
    return value if value.ndim > state.x.ndim - 2 else value[None]


def is_angle(channel: Channel) -> bool:
    """Whether a column is an angle, known up to full turns."""
    return isinstance(channel.observer, Part | JointPart) and channel.observer.field == "angle"


def difference(channel: Channel, world: World, states: State, measured: Array) -> Array:
    """Predicted minus measured, (K, size of the residual, *batch); at most half a turn for angles and orientations."""
    if is_turn(channel):
        so, q = rotations(states.x.shape[2]), states.q[:, channel.observer.body]
        return jax.vmap(lambda measured, q: so.log(so.difference(measured, q)))(measured + jnp.zeros_like(q), q)
    away = predict(channel, world, states) - measured
    if is_angle(channel):
        turn = away / channel.scale[None, None]
        away = channel.scale[None, None] * jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    return away


def is_turn(channel: Channel) -> bool:
    """Whether a column is a whole orientation, which has no bias or scale."""
    return isinstance(channel.observer, Part) and channel.observer.field == "q"
