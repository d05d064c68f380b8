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
import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import joint_motion, so3
from diffrigid.convert import nearest, numbers, unit_quaternion
from diffrigid.numerics import norm
from diffrigid.paths import component
from diffrigid.pytree import Leaf, array, array_fields, letters_of, pytree, replace, static
from diffrigid.state import State, material_point, rotations
from diffrigid.world import World, axis_sizes

FIELDS = ("x", "v", "w", "q", "angle")


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
    return channel.scale[None, None] * jax.vmap(partial(_seen, channel.observer, world))(states) + channel.bias[None]


def _seen(observer: Any, world: World, state: State) -> Array:
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


def channel_of(name: str, what: Any, world: World) -> Channel:
    """Make the channel of a column from what a user says that it observes.

    Args:
        what: "ball.x", an observer, a function of the state, or a Channel around one of these.
    """
    channel = what if isinstance(what, Channel) else Channel(observer=what)
    sizes = {"D": world.dim, "Q": 2 if world.dim == 2 else 4, "H": 3, "P": 2}
    observer = _resolved(name, channel.observer, world, sizes)
    try:
        sizes["M"] = size_of(observer, world)
    except (TypeError, AttributeError, LookupError) as error:
        raise ValueError(f"observe[{name!r}] fails for a state of this world: {error}") from error
    channel = replace(channel, observer=observer, classes=tuple(_classes(observer)), **_filled(name, channel, sizes))
    if is_turn(channel) and not (np.all(channel.bias == 0) and np.all(channel.scale == 1)):
        raise ValueError(f"observe[{name!r}] has a bias or a scale, expected none for an orientation: turn the shape")
    return channel


def _filled(name: str, record: Any, sizes: dict[str, int]) -> dict[str, Any]:
    """Arrays for the declared leaves of a record."""
    leaves = ((field, getattr(record, field)) for field in array_fields(record))
    return {f: _fill(sizes, leaf, letters_of(record, f), f"{name}.{f}") for f, leaf in leaves if leaf is not None}


def parts_of(observer: Any) -> dict[str, Any]:
    """What an observer is made of, which may be fitted: its float leaves, and other observers, by field."""
    found, _ = jax.tree_util.tree_flatten_with_path(observer, is_leaf=lambda node: node is not observer)
    return {getattr(keys[0], "name", str(keys[0])): part for keys, part in found}


def is_record(part: Any) -> bool:
    """Whether a part of an observer is an observer, not a float leaf."""
    return dataclasses.is_dataclass(part)


def _classes(observer: Any) -> Iterator[type]:
    yield type(observer)
    for part in filter(is_record, parts_of(observer).values()):
        yield from _classes(part)


def _fill(sizes: dict[str, int], leaf: Any, letters: tuple[str, ...], path: str) -> Any:
    """Convert a leaf to an array with its axes; a number stands for all components."""
    axes = tuple(sizes[letter] for letter in letters)
    value = np.asarray(numbers(path, leaf, None))
    value = numbers(path, np.broadcast_to(value, axes) if value.ndim == 0 else value, axes)
    return unit_quaternion(path, value) if letters == ("Q",) else value


def size_of(observer: Any, world: World) -> int:
    """Number of values that an observer returns for one time."""
    sizes, count = axis_sizes(world), len(world.names)
    shapes = {name: (count, sizes[letter]) for name, letter in zip("xqvw", "DQDA", strict=True)}
    dtype = jnp.result_type(world.bodies.mass)
    leaves: dict[str, Any] = {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()}
    value = jax.eval_shape(partial(_seen, observer, world), State(**leaves))
    if value.ndim != 1:
        raise ValueError(f"an observer returned the shape {value.shape}, expected a number or a vector for one state")
    return value.shape[0]


def _resolved(name: str, what: Any, world: World, sizes: dict[str, int]) -> Any:
    """An observer with indices for the names of bodies, and arrays for numbers."""
    if isinstance(what, str):
        return _by_name(name, what, world)
    if not callable(what) or isinstance(what, type):
        raise ValueError(f"observe[{name!r}] is {what!r}: expected 'ball.x', Marker(body='ball'), or a function")
    if not is_record(what):
        return Function(fn=what)
    if jax.tree_util.all_leaves([what]) or not set(parts := parts_of(what)) <= set(what.__dataclass_fields__):
        raise ValueError(
            f"observe[{name!r}] is a {type(what).__name__}, of which JAX does not know the fields: write "
            "@jax.tree_util.register_dataclass above its @dataclass"
        )
    changes = _filled(name, what, sizes)
    target = None if "body" in parts else getattr(what, "body", None)
    if isinstance(target, str):
        if target not in world.names:
            hint = nearest(target, world.names)
            raise ValueError(f"observe[{name!r}].body is {target!r}, which is not a moving body: {hint}")
        changes["body"] = world.names.index(target)
    for field, part in parts.items():
        if field not in changes and part is not None:
            observes = isinstance(part, str) or callable(part)
            changes[field] = _resolved(name, part, world, sizes) if observes else numbers(f"{name}.{field}", part, None)
    return replace(what, **changes)


def _by_name(name: str, what: str, world: World) -> Any:
    """The observer of a body's or a joint's field, or of one number of it; a body alone stands for its position."""
    whole, index = component(what)
    if index is not None and what != name:  # components by those names were joined before
        observer = _by_name(name, whole, world)
        if index >= (size := size_of(observer, world)) or isinstance(observer, JointPart):
            raise ValueError(f"observe[{name!r}] is {what!r}: {whole} has {size} numbers, from [0] on")
        return Component(of=observer, index=index)
    possible: dict[str, Part | JointPart] = {
        f"{body}.{field}": Part(body=k, field=field)
        for k, body in enumerate(world.names)
        for field in FIELDS
        if field != "angle" or world.dim == 2
    }
    for joints, joint in zip(world.joint_names, world.joints, strict=True):
        for field in joint_motion.fields_of(joint):
            possible |= {f"{j}.{field}": JointPart(joint=j, field=field) for j in joints}
    wanted = what if "." in what else f"{what}.x"
    if wanted not in possible:
        raise ValueError(
            f"observations: no column {name!r} in this {world.dim}D world"
            + ("" if name == what else f", which observes {what!r}")
            + f": {_hint(what, possible)} Say what other columns observe by observe={{{name!r}: ...}}."
        )
    return possible[wanted]


def _hint(what: str, possible: Iterable[str]) -> str:
    """Text on what was meant by the name of a column: by "ball.y", "ball.x1", "ball.x_1" a component."""
    match = re.fullmatch(r"(.+)\.([xvwq]?)[_.]?([xyz]|\d)", what)
    whole = f"{match[1]}.{match[2] or 'x'}" if match else ""
    if match and whole in possible:
        index = "xyz".index(match[3]) if match[3] in "xyz" else match[3]
        return f"did you mean '{whole}[{index}]'?"
    return nearest(what, possible)
