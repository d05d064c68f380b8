"""Scenes in TOML files, and what to fit in them:

gravity = [0.0, -9.81]
restitution = 0.5

[bodies.ball]
shape = { disc = { radius = 0.1 } }
mass = 1.0
x = [0.0, 1.0]

[bodies.hammer]                             # a body of several shapes
mass = 0.5
x = [1.0, 1.0]
parts.handle = { shape = { box = { half = [0.15, 0.01] } } }
parts.head = { shape = { box = { half = [0.02, 0.05] } }, x = [0.15, 0.0] }

[statics.floor]
shape = { half_space = { normal = [0.0, 1.0] } }

[forces]
air = { drag = { linear = 0.1 } }

[values]                                    # other numbers of the scene, by their paths
"ball.w" = 2.0

[free]                                      # what `fit` may vary
restitution = { interval = [0, 1] }
"ball.v" = { each = "real" }                # a launch of its own for every file of data
"ball.inertia" = { inertia = { principal = true } }    # arguments by name; or one, or a list of them, in order
"ball.mass" = { prior = ["positive", 1.0, 0.1] }
"a.mass = b.mass" = "positive"              # one value for both
"a.mass : b.mass" = "shares"                # their ratio

[observe]                                   # columns that are not named for what they observe
tip = { marker = { body = "ball", point = [0.1, 0.0] } }
pixels = { homography = { of = "ball", matrix = [[...], [...], [...]] } }
note = false                                # left out, whatever it holds

[columns]                                   # columns of the files, where they have other names or units; no others
t = { time = 0.001 }                        # "time" in ms
"ball.x[0]" = "X"

[fit]                                       # further arguments of `fit`
starts = 8
loss = "huber"
noise = { "ball.x" = 0.001 }

A robot is read from its own file, beside this one; it has the bodies, joints and gravity, so [values], [free],
[observe], [columns], [fit] and contact are left for here:

robot = { urdf = { path = "arm.urdf", friction = 0.3 } }    # arguments of `load_urdf`; or mjcf = { path = "arm.xml" }

[values]
"elbow.angle" = 0.9
"""

import inspect
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffrigid import forces, joints, paths, shapes, sysid
from diffrigid.contact import Contact
from diffrigid.convert import numbers
from diffrigid.models import load_mjcf, load_urdf
from diffrigid.parts import Part
from diffrigid.scene import Body, Static, scene
from diffrigid.spelling import nearest
from diffrigid.state import COEFFICIENTS, State
from diffrigid.world import World


def _words(kind: type) -> str:
    """Name of a record in a file: half_space of HalfSpace."""
    return re.sub("(?<=.)([A-Z])", r"_\1", kind.__name__).lower()


TABLES = ("bodies", "statics", "forces", "joints", "robot", "values", "free", "observe", "columns", "fit")
ARGUMENTS = ("gravity", *COEFFICIENTS, "ignore", "contact")
OPTIONS = ("starts", "dt", "noise", "widths", "windows", "iterations", "seed", "loss")
KINDS: dict[str, Callable] = {
    name: getattr(sysid, name)
    for name in ("interval", "positive", "real", "direction", "rotation", "inertia", "shares")
}
SHAPES = {_words(kind): kind for kind in shapes.SHAPES}
FORCES = {_words(kind): kind for kind in forces.FORCES if kind is not forces.Gravity}
FORCES["spring"] = FORCES.pop("spring_damper")
ROBOTS: dict[str, Callable] = {"urdf": load_urdf, "mjcf": load_mjcf}
JOINTS = {_words(kind): kind for kind in joints.JOINTS}
OBSERVERS: dict[str, Callable] = {
    _words(kind): kind for kind in (sysid.Marker, sysid.Separation, sysid.Homography, sysid.Pinhole)
}
LOSSES: dict[str, Callable] = {"squares": sysid.squares, "huber": sysid.huber, "student": sysid.student}


@dataclass(frozen=True)
class SceneFile:
    """Content of a scene file."""

    world: World
    state: State
    free: dict[Any, Any]
    observe: dict[str, Any]
    columns: dict[str, tuple[str, float]]  # name in the files, and factor, of each column
    options: dict[str, Any]  # further arguments of `fit`


def read_scene(path: str | Path) -> SceneFile:
    """Read the scene of a file, and the free parameters of it.

    Raises:
        ValueError: names the file, the table and the key, what was expected, and the nearest name.
    """
    try:
        with open(Path(path), "rb") as file:  # a Path, for a number would be an open file
            data = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is not a TOML file: {error}") from None
    for key in data:
        if key not in (*TABLES, *ARGUMENTS):
            raise ValueError(f"{path}: unknown key {key!r}: {nearest(key, (*TABLES, *ARGUMENTS))}")
    for key in TABLES:
        if not isinstance(data.get(key, {}), Mapping):
            raise ValueError(f"{path}: {key} is {data[key]!r}: expected a table")
    if "contact" in data:
        data["contact"] = _made(f"{path}: contact", Contact, data["contact"])
    world, state = (_robot if "robot" in data else _scene)(path, data)
    for key, value in data.get("values", {}).items():
        world, state = _with(f"{path}: values.{key}", world, state, key, value)
    return SceneFile(
        world=world,
        state=state,
        free={_paths(key): _kind(f"{path}: free.{key}", entry) for key, entry in data.get("free", {}).items()},
        observe={
            k: None if entry is False else _observer(f"{path}: observe.{k}", entry)
            for k, entry in data.get("observe", {}).items()
        },
        columns={k: _column(f"{path}: columns.{k}", entry) for k, entry in data.get("columns", {}).items()},
        options=_options(f"{path}: fit", data.get("fit", {})),
    )


def _scene(path: str | Path, data: Mapping[str, Any]) -> tuple[World, State]:
    bodies = {name: _body(f"{path}: bodies.{name}", Body, entry) for name, entry in data.get("bodies", {}).items()}
    statics = {name: _body(f"{path}: statics.{name}", Static, entry) for name, entry in data.get("statics", {}).items()}
    return scene(
        {**bodies, **statics},
        forces={k: _one_of(f"{path}: forces.{k}", FORCES, entry) for k, entry in data.get("forces", {}).items()},
        joints={k: _one_of(f"{path}: joints.{k}", JOINTS, entry) for k, entry in data.get("joints", {}).items()},
        **{key: data[key] for key in ARGUMENTS if key in data},
    )


def _robot(path: str | Path, data: Mapping[str, Any]) -> tuple[World, State]:
    for key in ("bodies", "statics", "forces", "joints", *ARGUMENTS):
        if key in data and key != "contact":
            raise ValueError(f"{path}: {key} beside robot: the file of the robot says what there is")
    contact = {"contact": data["contact"]} if "contact" in data else {}
    entry = data["robot"]
    if len(entry) == 1 and isinstance(fields := next(iter(entry.values())), Mapping) and "path" in fields:
        entry = {next(iter(entry)): {**fields, **contact, "path": Path(path).parent / str(fields["path"])}}
    return _one_of(f"{path}: robot", ROBOTS, entry)


def _with(where: str, world: World, state: State, key: str, value: Any) -> tuple[World, State]:
    """World and state with another value of a parameter."""
    try:
        return paths.write(world, state, key, numbers(key, value, None))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _column(where: str, entry: Any) -> tuple[str, float]:
    """Parse "name", or { name = factor }."""
    given = {entry: 1.0} if isinstance(entry, str) else entry
    if not isinstance(given, Mapping) or [isinstance(factor, int | float) for factor in given.values()] != [True]:
        raise ValueError(f"{where} is {entry!r}: expected the name of a column, or {{ name = factor }}")
    ((name, factor),) = given.items()
    return name, float(factor)


def _body(where: str, kind: Any, entry: Any) -> Any:
    if not isinstance(entry, Mapping):
        raise ValueError(f"{where} is {entry!r}: expected a table with a shape")
    shape, parts, made = entry.get("shape"), entry.get("parts"), None
    if shape is not None and parts is not None:
        raise ValueError(f"{where}: got both a shape and parts: move the shape to the parts")
    if shape is not None:
        made = _one_of(f"{where}.shape", SHAPES, shape)
    if parts is not None:
        if not isinstance(parts, Mapping):
            raise ValueError(f"{where}.parts is {parts!r}: expected a table of parts by name")
        made = {name: _part(f"{where}.parts.{name}", part) for name, part in parts.items()}
    return _made(where, kind, {"shape": made, **{k: v for k, v in entry.items() if k not in ("shape", "parts")}})


def _part(where: str, entry: Any) -> Part:
    if not isinstance(entry, Mapping):
        raise ValueError(f"{where} is {entry!r}: expected a table with a shape")
    shape = _one_of(f"{where}.shape", SHAPES, entry.get("shape"))
    return _made(where, Part, {**entry, "shape": shape})


def _one_of(where: str, kinds: Mapping[str, Callable], entry: Any) -> Any:
    """Make a record from { kind = { field = value } }."""
    if not isinstance(entry, Mapping) or len(entry) != 1:
        raise ValueError(
            f"{where} is {entry!r}: expected one kind and its fields, such as {{ {next(iter(kinds))} = {{ }} }}"
        )
    ((name, fields),) = entry.items()
    if name not in kinds:
        raise ValueError(f"{where}: no {name!r}: {nearest(name, kinds)}")
    return _made(where, kinds[name], fields)


def _made(where: str, kind: Callable, fields: Any) -> Any:
    try:
        return kind(**fields)
    except TypeError as error:
        taken = inspect.signature(kind).parameters
        unknown = [name for name in fields if name not in taken] if isinstance(fields, Mapping) else []
        text = f"no field {unknown[0]!r}: {nearest(unknown[0], taken)}" if unknown else str(error).split(".")[-1]
        raise ValueError(f"{where}: {text}") from None


def _paths(key: str) -> str | tuple[str, ...]:
    names = tuple(part.strip() for part in re.split(r"=|\s:\s", key))
    return names if len(names) > 1 else names[0]


def _options(where: str, entries: Mapping[str, Any]) -> dict[str, Any]:
    for key in entries:
        if key not in OPTIONS:
            raise ValueError(f"{where}.{key} is not an option: {nearest(key, OPTIONS)}")
    loss = {"loss": _named(f"{where}.loss", LOSSES, entries["loss"])} if "loss" in entries else {}
    return dict(entries) | loss


def _kind(where: str, entry: Any) -> Any:
    """Make a kind of free parameter, which may be wrapped by `each` or `prior`."""
    if isinstance(entry, Mapping) and set(entry) == {"each"}:
        return sysid.each(_kind(where, entry["each"]))
    if isinstance(entry, Mapping) and set(entry) == {"prior"}:
        if not isinstance(entry["prior"], list) or len(entry["prior"]) != 3:
            raise ValueError(f"{where} is {entry!r}: expected {{ prior = [kind, mean, deviation] }}")
        kind, mean, deviation = entry["prior"]
        return sysid.prior(_kind(where, kind), mean, deviation)
    return _named(where, KINDS, entry)


def _named(where: str, kinds: Mapping[str, Callable], entry: Any) -> Any:
    """Make what a name alone, or { name = arguments }, stands for."""
    if not isinstance(entry, str) and not (isinstance(entry, Mapping) and len(entry) == 1):
        raise ValueError(
            f"{where} is {entry!r}: expected one kind, a name or {{ name = arguments }}: {', '.join(kinds)}"
        )
    name, arguments = (entry, []) if isinstance(entry, str) else next(iter(entry.items()))
    if name not in kinds:
        raise ValueError(f"{where} is {name!r}: {nearest(name, kinds)}")
    try:
        if isinstance(arguments, Mapping):
            return kinds[name](**arguments)
        return kinds[name](*(arguments if isinstance(arguments, list) else [arguments]))
    except TypeError as error:
        raise ValueError(f"{where}: {error}") from None


def _observer(where: str, entry: Any) -> Any:
    """Make an observer, with others among its fields."""
    if isinstance(entry, str):
        return entry
    if isinstance(entry, Mapping) and len(entry) == 1 and isinstance(fields := next(iter(entry.values())), Mapping):
        inner = {k: _observer(f"{where}.{k}", v) for k, v in fields.items() if k in ("of", "a", "b")}
        entry = {next(iter(entry)): {**fields, **inner}}
    return _one_of(where, OBSERVERS, entry)
