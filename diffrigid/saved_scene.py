"""A world and a state in a JSON file, number by number.

{"format": "diffrigid scene", "version": 1, "diffrigid": "0.1.0", "world": RECORD, "state": RECORD}

RECORD      {"record": "Disc", "radius": ARRAY, ...}: the name of its class, and its fields
ARRAY       {"array": [[0.5]], "shape": [1, 1], "dtype": "float64"}: [] alone would not have a shape
the rest    numbers, strings, true, false, null, and lists of all these, which are tuples
"""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.collide import PairGroup
from diffrigid.contact import Contact
from diffrigid.forces import FORCES
from diffrigid.joints import JOINTS
from diffrigid.scene_file import read_scene
from diffrigid.shapes import SHAPES, traced
from diffrigid.spelling import nearest
from diffrigid.state import Bodies, State
from diffrigid.world import Offset, Statics, World, check

FORMAT, VERSION = "diffrigid scene", 1
DTYPES = "float16", "float32", "float64"
RECORDS = World, State, Bodies, Statics, Offset, Contact, PairGroup, *FORCES, *SHAPES, *JOINTS


def save_scene(path: str | Path, world: World, state: State) -> Path:
    """Write a world and a state as JSON, exactly; `load_scene` reads them. Also of batches.

    Raises:
        ValueError: not a world and a state; a value is traced, or not finite.

    Example:
        >>> file = dr.save_scene("drop.json", world, state)
        >>> dr.load_scene(file) == (world, state)
        True
    """
    check(world, state)
    head = {"format": FORMAT, "version": VERSION, "diffrigid": version("diffrigid")}
    data = head | {"world": _encoded(world, "world"), "state": _encoded(state, "state")}
    Path(path).write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return Path(path)


def load_scene(path: str | Path, kinds: Iterable[type] = ()) -> tuple[World, State]:
    """Read a world and a state from what `save_scene` wrote, or from a scene in TOML, a path that ends in ".toml".

    Args:
        kinds: classes of forces of your own that the saved world has.

    Raises:
        ValueError: not such a file, of a newer format, or a class in it that is neither of diffrigid nor of `kinds`.

    Example:
        >>> dr.load_scene("drop.json")[0].names
        ('ball',)
    """
    path = Path(path)
    if path.suffix == ".toml":
        scene = read_scene(path)
        return scene.world, scene.state
    known = {kind.__name__: kind for kind in (*RECORDS, *kinds)}
    content = path.read_bytes()
    try:
        data = json.loads(content)
        if data["format"] != FORMAT or data["version"] != VERSION:
            raise ValueError(f"its format is {data['format']!r}, {data['version']!r}, expected {FORMAT!r}, {VERSION}")
        world, state = (_decoded(data[key], known) for key in ("world", "state"))
        check(world, state)
    except (AttributeError, KeyError, OverflowError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a saved scene: {error}") from error
    return world, state


def _encoded(value: Any, where: str) -> Any:
    """A record, or a part of it, in the types of JSON."""
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value) if field.name != "_class"]
        fields = {name: _encoded(getattr(value, name), f"{where}.{name}") for name in names}
        return {"record": type(value).__name__} | fields
    if isinstance(value, Array | np.ndarray | np.generic):
        if traced(value):
            raise ValueError(f"{where} is traced by jit, vmap or grad: save it outside, from the result")
        if not np.isfinite(value).all():
            raise ValueError(f"{where} is {value}: expected finite numbers")
        if str(value.dtype) not in DTYPES:
            raise ValueError(f"{where} is of {value.dtype}: expected one of {', '.join(DTYPES)}")
        return {"array": np.asarray(value).tolist(), "shape": list(value.shape), "dtype": str(value.dtype)}
    if isinstance(value, tuple | list):
        return [_encoded(part, f"{where}[{k}]") for k, part in enumerate(value)]
    if value is None or isinstance(value, str | int | float):
        return value
    raise ValueError(f"{where} is a {type(value).__name__}: expected arrays, numbers, strings and records of them")


def _decoded(data: Any, kinds: Mapping[str, type]) -> Any:
    """What `_encoded` made this of."""
    if isinstance(data, list):
        return tuple(_decoded(part, kinds) for part in data)
    if not isinstance(data, dict):
        return data
    if "array" in data:
        if data["dtype"] not in DTYPES:
            raise ValueError(f"numbers of type {data['dtype']!r}, expected one of {DTYPES}")
        values = jnp.asarray(np.array(data["array"], data["dtype"]).reshape(data["shape"]))
        if not jnp.isfinite(values).all():
            raise ValueError(f"{values} are not finite numbers")
        return values
    fields = {name: _decoded(value, kinds) for name, value in data.items()}
    name = fields.pop("record")
    if name not in kinds:
        raise ValueError(f"no class {name!r}: {nearest(name, kinds)}; one of your own is given by kinds=({name},)")
    return kinds[name](**fields)
