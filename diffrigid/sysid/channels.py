"""Channels: from what a user says that a column observes to a record with arrays, or an error with the fix."""

import dataclasses
import re
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffrigid import joint_motion
from diffrigid.catalogue import component
from diffrigid.controls import controlled
from diffrigid.convert import numbers, unit_quaternion
from diffrigid.pytree import array_fields, letters_of, replace
from diffrigid.spelling import nearest
from diffrigid.state import State, axis_sizes
from diffrigid.sysid.sensors import Channel, Component, Function, JointPart, Part, is_turn, seen
from diffrigid.world import World

FIELDS = ("x", "v", "w", "q", "angle")


def channel_of(name: str, what: Any, world: World) -> Channel:
    """Make the channel of a column from what a user says that it observes.

    Args:
        what: "ball.x", an observer, a function of the state, or a Channel around one of these.
    """
    channel = what if isinstance(what, Channel) else Channel(observer=what)
    sizes = axis_sizes(world.dim) | {"H": 3, "P": 2}
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
    sizes, count = axis_sizes(world.dim), len(world.names)
    shapes = {name: (count, sizes[letter]) for name, letter in zip("xqvw", "DQDA", strict=True)}
    dtype = jnp.result_type(world.bodies.mass)
    leaves: dict[str, Any] = {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()}
    value = jax.eval_shape(partial(seen, observer, world), State(**leaves))
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
            + f": say what it observes by observe={{{name!r}: ...}}, None leaves it out; "
            + _hint(what, [*possible, *controlled(world.forces)])
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
