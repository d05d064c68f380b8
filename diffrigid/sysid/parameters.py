"""Free parameters of a scene: where each is, and how a vector z of numbers is written into the scene.

Paths are those of `diffrigid.paths`, COLUMN.field for what `sensors` says of a column, "clock" for the clock of all
columns, and the names of what functions write into the scene (`through`). Numbers that all records share come first in
z, then those of which each record has its own.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import paths
from diffrigid.catalogue import component, hint, order_of
from diffrigid.pytree import replace, static
from diffrigid.state import COEFFICIENTS, State
from diffrigid.sysid.channels import is_record, parts_of
from diffrigid.sysid.charts import Chart
from diffrigid.sysid.free import Each, Free, Prior, Through, meant
from diffrigid.sysid.sensors import Channel, is_turn
from diffrigid.world import World

# Fields of length one, and the kind that keeps it.
CONDITIONED = {"normal": "direction", "axis_a": "direction", "axis_b": "direction", "q": "rotation", "zero": "rotation"}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Written:
    """A parameter that a function writes into the scene."""

    value: Array
    write: Callable[[World, State, Array], tuple[World, State]] = static(kw_only=False)
    unit: str = static(kw_only=False)


class Scene(NamedTuple):
    """World, state and columns: all that parameters are part of; and those that functions write into them."""

    world: World
    state: State
    channels: dict[str, Channel]
    written: dict[str, Written]


@dataclass(frozen=True)
class Slot:
    """One free parameter."""

    name: str
    paths: tuple[str, ...]
    kind: Free | Chart
    size: int  # numbers of z
    prior: Prior | None = None

    @property
    def is_vector(self) -> bool:
        """Whether the paths are components of one vector, not several names of one value."""
        return isinstance(self.kind, Chart) and self.kind.name == "shares"


def read(scene: Scene, path: str) -> Array:
    """Value of a parameter of the world, the initial state, or a column."""
    if path in scene.written:
        return scene.written[path].value
    of_columns = channel_paths(scene.channels)
    if path not in of_columns:
        return paths.read(scene.world, scene.state, path)
    node: Any = scene.channels
    for key in of_columns[path][0]:
        node = _child(node, key)
    return jnp.asarray(node)


def write(scene: Scene, path: str, value: Array) -> Scene:
    """The scene with one parameter changed."""
    if path in scene.written:
        own = replace(scene.written[path], value=value)
        world, state = own.write(scene.world, scene.state, value)
        return scene._replace(world=world, state=state, written={**scene.written, path: own})
    of_columns, channels = channel_paths(scene.channels), scene.channels
    if path not in of_columns:
        world, state = paths.write(scene.world, scene.state, path, value)
        return scene._replace(world=world, state=state)
    for chain in of_columns[path]:
        channels = _updated(channels, chain, value)
    return scene._replace(channels=channels)


def knows(scene: Scene, path: str) -> bool:
    """Whether the scene has such a parameter."""
    known = channel_paths(scene.channels), scene.written
    return any(path in names for names in known) or component(path)[0] in paths.catalogue(scene.world)


def channel_paths(channels: dict[str, Channel]) -> dict[str, list[tuple[str, ...]]]:
    """Every path of the columns, and the chains of attributes that it stands for."""
    out: dict[str, list[tuple[str, ...]]] = {"clock": [(name, "clock") for name in channels]}
    for name, channel in channels.items():
        fields = ("clock",) if is_turn(channel) else ("bias", "scale", "clock")
        out |= {f"{name}.{field}": [(name, field)] for field in fields}
        out |= {f"{name}.{'.'.join(chain)}": [(name, "observer", *chain)] for chain in _leaves(channel.observer)}
    return out


def _leaves(observer: Any) -> list[tuple[str, ...]]:
    """Chains of attributes to the float leaves of an observer, and of those that it is made of."""
    chains: list[tuple[str, ...]] = []
    for field, part in parts_of(observer).items():
        chains += [(field, *chain) for chain in _leaves(part)] if is_record(part) else [(field,)]
    return chains


def _child(node: Any, key: str) -> Any:
    return node[key] if isinstance(node, dict) else getattr(node, key)


def _updated(node: Any, chain: tuple[str, ...], value: Array) -> Any:
    key, rest = chain[0], chain[1:]
    child = _child(node, key)
    child = _updated(child, rest, value) if rest else jnp.reshape(value, jnp.shape(child))
    return {**node, key: child} if isinstance(node, dict) else replace(node, **{key: child})


def reference(slot: Slot, scene: Scene) -> Array:
    """Value of a slot's parameter in a scene."""
    if slot.is_vector:
        return jnp.stack([jnp.reshape(read(scene, path), ()) for path in slot.paths])
    return read(scene, slot.paths[0])


def pieces(slots: Sequence[Slot], first: int = 0) -> list[tuple[Slot, slice]]:
    """Each slot and its rows of z, which are counted from `first` on."""
    ends = np.cumsum([first, *(slot.size for slot in slots)])
    return [(slot, slice(*pair)) for slot, *pair in zip(slots, ends[:-1], ends[1:], strict=True)]


def split(slots: Sequence[Slot], z: Any) -> list[Any]:
    """Split z (n, ...) into pieces, one for each slot."""
    return [z[rows] for _, rows in pieces(slots)]


def put(slots: Sequence[Slot], scene: Scene, z: Array) -> Scene:
    """Write the parameters for z (n,) into the scene."""
    numbers: list[tuple[str, Array]] = []
    for slot, rows in pieces(slots):
        if slot.paths:
            value = slot.kind.value(z[rows], reference(slot, scene))
            numbers += [(path, value[k] if slot.is_vector else value) for k, path in enumerate(slot.paths)]
    # In order: joints move bodies once anchors and velocities are as they will be.
    for path, value in sorted(numbers, key=lambda n: (order_of(scene.world, n[0]), n[0] in scene.written)):
        scene = write(scene, path, value)
    return scene


def written_by(free: Any, dtype: Any) -> dict[str, Written]:
    """The parameters of `free` that functions write into the scene, at their start."""
    own = {key: _kind_in(kind) for key, kind in free.items()} if isinstance(free, Mapping) else {}
    return {
        key: Written(jnp.asarray(kind.start, dtype), kind.write, kind.unit)
        for key, kind in own.items()
        if isinstance(kind, Through) and isinstance(key, str)
    }


def _kind_in(kind: Any) -> Any:
    """The kind inside `each` and `prior`."""
    while isinstance(kind, Each | Prior):
        kind = kind.kind
    return kind


def make_slots(free: Mapping[Any, Any], scenes: Sequence[Scene]) -> tuple[tuple[Slot, ...], tuple[Slot, ...]]:
    """Make slots of the parameters that all records share, and of those of which each record has its own.

    Raises:
        ValueError: nothing is free, a value of `free` is not a kind, a path is in no scene, two paths set the same
            number, or the kind does not allow the value in a scene.
    """
    if not isinstance(free, Mapping):
        raise ValueError(
            f'free is {free!r:.80}: expected a dict from path to kind, for example {{"restitution": interval(0, 1)}}'
        )
    if not free:
        raise ValueError('free: nothing to fit; give paths, for example {"restitution": interval(0, 1)}')
    # Most records have the same parameters.
    unlike = list({(jax.tree.structure((s.world, s.state)), tuple(s.channels)): s for s in scenes}.values())
    shared: list[Slot] = []
    own: list[Slot] = []
    for key, kind in free.items():
        several = isinstance(kind, Each)
        slot = _make_slot(key, kind.kind if several else kind, several, scenes, unlike)
        (own if several else shared).append(slot)
    for scene in unlike:
        _refuse_overlaps([*shared, *own], scene)
    return tuple(shared), tuple(own)


def _make_slot(key: Any, kind: Any, several: bool, scenes: Sequence[Scene], unlike: Sequence[Scene]) -> Slot:
    """Check one entry of `free`; one scene of each structure is in `unlike`."""
    names = (key,) if isinstance(key, str) else tuple(key) if isinstance(key, tuple | list) else ()
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"free has the key {key!r}: expected a path such as 'ball.mass', or a tuple of paths")
    prior, kind = (kind, kind.kind) if isinstance(kind, Prior) else (None, kind)
    own, kind = (kind, kind.kind) if isinstance(kind, Through) else (None, kind)
    if not isinstance(kind, Free | Chart):
        raise ValueError(
            f"free[{key!r}]: expected interval(low, high), positive(), real() or another kind, got {meant(kind)}"
        )
    if own is not None:
        _refuse_written(key, own, unlike)
    having = [scene for scene in scenes if all(knows(scene, name) for name in names)]
    if not having or several and len(having) < len(scenes):
        _refuse(names, having, scenes)
    _refuse_ambiguous(names, unlike)
    slot = Slot(" = ".join(names), names, kind, 0, prior)
    if slot.is_vector:
        slot = replace(slot, name=" : ".join(names))
    shapes = {read(having[0], name).shape for name in names}
    if len(shapes) > 1 or (slot.is_vector and shapes != {()}):
        expected = "numbers" if slot.is_vector else "one shape"
        raise ValueError(f"free[{key!r}]: paths of shapes {sorted(shapes)}, expected {expected}")
    shape = reference(slot, having[0]).shape
    size = kind.size(shape)
    if own is None:
        _refuse_kind(key, kind, component(names[0])[0].rpartition(".")[2], having[0].world.dim)
    for scene in having:
        kind.check(f"free[{key!r}]", np.asarray(reference(slot, scene)))
    if prior is not None and len(prior.mean) not in (1, int(np.prod(shape))):
        raise ValueError(f"free[{key!r}]: a prior with {len(prior.mean)} means, expected those of the shape {shape}")
    return replace(slot, size=size)


def _refuse_kind(key: Any, kind: Free | Chart, field: str, dim: int) -> None:
    """Raise ValueError for a kind that does not keep the condition on such a field, or is of another."""
    if isinstance(kind, Chart):
        if kind.name == "rotation" and CONDITIONED.get(field) != "rotation":
            raise ValueError(f"free[{key!r}]: rotation() is for orientations, such as 'die.q'")
    elif field in CONDITIONED:
        raise ValueError(f"free[{key!r}]: expected {CONDITIONED[field]}(), which keeps its length")
    elif field == "inertia" and dim == 3:
        raise ValueError(f"free[{key!r}]: expected inertia(), which keeps the tensor one that a body can have")


def _refuse_written(key: Any, own: Through, scenes: Sequence[Scene]) -> None:
    """Raise ValueError for a parameter of the user's own that has the name of another, or does not give a scene."""

    def written(world: World, state: State, value: Array) -> None:
        before, made = (jax.tree.map(np.shape, pair) for pair in ((world, state), own.write(world, state, value)))
        if made != before:
            raise ValueError(
                f"free[{key!r}]: expected that write returns (world, state) with the same arrays as before, such as "
                "dr.paths.write(world, state, path, value) does"
            )

    for scene in scenes:
        if not isinstance(key, str) or knows(scene._replace(written={}), key):
            raise ValueError(f"free[{key!r}]: expected a name of its own for what `through` writes, not paths")
        jax.eval_shape(written, scene.world, scene.state, scene.written[key].value)


def _refuse_ambiguous(names: tuple[str, ...], scenes: Sequence[Scene]) -> None:
    """Raise ValueError for paths that the fit itself sets, or that name two things."""
    for name in names:
        if name == "contact.width":
            raise ValueError("free: 'contact.width' is not a property of a body: give `fit` the widths to go through")
        if any(name in channel_paths(s.channels) and component(name)[0] in paths.catalogue(s.world) for s in scenes):
            raise ValueError(
                f"free: {name!r} is a parameter of the world and of a column: give the column another name"
            )


def _refuse_overlaps(slots: Sequence[Slot], scene: Scene) -> None:
    """Raise ValueError if two paths set the same number."""
    known, of_columns = paths.catalogue(scene.world), channel_paths(scene.channels)
    taken: dict[tuple, list[tuple[Any, Any, str]]] = {}
    for path in (path for slot in slots for path in slot.paths if path not in of_columns):
        whole, index = component(path)
        for place in known.get(whole, []):
            for row, item, other in taken.setdefault(place.chain, []):
                if all(a is None or b is None or a == b for a, b in ((row, place.row), (item, index))):
                    general = {other, path} & {*COEFFICIENTS}
                    hint = f", or free {min(general)} by bodies and statics only" if general else ""
                    raise ValueError(f"free: {other!r} and {path!r} set the same number: leave one out{hint}")
            taken[place.chain].append((place.row, index, path))


def _refuse(names: tuple[str, ...], having: Sequence[Scene], scenes: Sequence[Scene]) -> None:
    for name in names:
        lacking = [scene for scene in scenes if not knows(scene, name)]
        if lacking:
            catalogue = [*channel_paths(lacking[0].channels), *paths.catalogue(lacking[0].world)]
            where = "this world" if not having else "the scene of every record, as a parameter of `each` has to be"
            raise ValueError(f"free: no parameter {name!r} in {where}: {hint(lacking[0].world, name, catalogue)}")
    raise ValueError(f"free: no scene has all of {names}: tie only what is in one scene")
