"""`World`: everything that a step does not change, and the checks of shape and type."""

import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.collide import PairGroup
from diffrigid.contact import Contact
from diffrigid.pytree import array, map_arrays, pytree, refuse_missing, stacked, static
from diffrigid.shapes import traced
from diffrigid.state import Bodies, State, axis_sizes


@pytree
class Statics:
    """Poses and materials of the S colliders that do not move."""

    x: Array = array("S", "D")  # (S, D, *batch) [m]
    q: Array = array("S", "Q")  # (S, Q, *batch)
    restitution: Array = array("S")  # (S, *batch) [-]
    friction: Array = array("S")  # (S, *batch) [-]
    restitution_falloff: Array | None = array("S", default=None)  # (S, *batch) [s/m]
    rolling_friction: Array | None = array("S", default=None)  # (S, *batch) [m]
    spinning_friction: Array | None = array("S", default=None)  # (S, *batch) [m]


@pytree
class World:
    """N moving bodies, S statics, their shapes, forces and contact model. Every float leaf can be fitted.

    Colliders are numbered bodies first, then statics. Shapes of one kind are stacked in one record, with a
    leading axis; `owners` says on which collider each sits, and `offsets` where, if its origin is not the
    centre of mass. Make it with `scene`; change it with `replace`.

    Example:
        >>> heavy = dr.replace(world, bodies=dr.replace(world.bodies, mass=2.0 * world.bodies.mass))
        >>> heavy.bodies.mass.tolist(), world.bodies.mass.tolist()  # a world does not change
        ([2.0], [1.0])
    """

    bodies: Bodies
    statics: Statics
    shapes: tuple = stacked("M")
    offsets: tuple  # of Offset or None, like shapes
    forces: tuple
    joints: tuple = stacked("M")  # of one record for all joints of a kind
    contact: Contact
    names: tuple[str, ...] = static()  # of the moving bodies, in the order of State
    static_names: tuple[str, ...] = static()
    force_names: tuple[str, ...] = static()
    joint_names: tuple[tuple[str, ...], ...] = static()  # of the rows of each record of `joints`
    owners: tuple[tuple[int, ...], ...] = static()
    parts: tuple[tuple[str, ...], ...] = static(default=())  # names, as `owners`; () if no body has several shapes
    pairs: tuple[PairGroup, ...] = static()
    crowd: bool = static(default=False)  # so many bodies that pairs are found in every step instead of listed
    # of each coefficient, whether it was given to each collider itself, and is not the scene's default
    own: tuple[tuple[str, tuple[bool, ...]], ...] = static()

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.bodies.dim

    def __repr__(self) -> str:
        """A list of its parameters, with values and units."""
        from diffrigid.listing import listing  # points down, so that a world prints itself

        return listing(self)


@pytree
class Offset:
    """Where M shapes of one kind sit on their bodies."""

    r: Array = array("M", "D")  # (M, D, *batch) [m] their origins from the centre of mass, body axes
    q: Any = array("M", "Q", default=None)  # (M, Q, *batch) from their axes to body axes; None: unturned


class Seat(NamedTuple):
    """A row of `World.shapes`, and the collider that it sits on."""

    group: int
    row: int
    owner: int
    part: str  # its name; "" of the only shape


def seats(world: World) -> list[Seat]:
    """All shapes of a world."""
    return [
        Seat(group, row, owner, world.parts[group][row] if world.parts else "")
        for group, owners in enumerate(world.owners)
        for row, owner in enumerate(owners)
    ]


def seated(world: World, seat: Seat) -> tuple[Any, Any, Any]:
    """A shape, its origin (D, *batch) [m] on its collider, and its orientation (Q, *batch); None: at x, unturned."""
    shape, offset = jax.tree.map(operator.itemgetter(seat.row), (world.shapes[seat.group], world.offsets[seat.group]))
    return (shape, None, None) if offset is None else (shape, offset.r, offset.q)


def check_kinds(world: Any, state: Any) -> None:
    """Raise ValueError unless these are a World and a complete State, and a crowd has no forces, joints or width."""
    if not isinstance(world, World) or not isinstance(state, State):
        raise ValueError(
            f"expected (world, state), got ({type(world).__name__}, {type(state).__name__}): "
            "both come from `diffrigid.scene`, in this order"
        )
    refuse_missing(state, "state")
    for name in ("width", "rest_speed"):  # as given with `replace`; arrays came through `scene`
        value = getattr(world.contact, name)
        if isinstance(value, int | float) and not value >= 0:
            raise ValueError(f"contact.{name} is {value:g}: expected 0 or above; 0 turns it off")
    if world.crowd and not traced(world.contact.width) and np.any(np.asarray(world.contact.width) > 0):
        raise ValueError(f"contact.width is {world.contact.width}: expected 0 for so many bodies; use fewer")
    if world.crowd and (world.forces or world.joints):
        raise ValueError("world has forces or joints, but was made as a crowd without: give them to `scene`")
    if not isinstance(world.bodies, Bodies):
        raise ValueError(f"world.bodies is a {type(world.bodies).__name__}: expected the Bodies that `scene` made")


def shape_of_leaf(leaf: Any, path: str) -> tuple[int, ...]:
    """Shape of an array or a number."""
    if not hasattr(leaf, "shape") and not isinstance(leaf, int | float):
        raise ValueError(f"{path} is a {type(leaf).__name__}: expected an array; convert it with jnp.asarray")
    if isinstance(leaf, np.ndarray) and leaf.dtype.kind not in "biuf":
        raise ValueError(f"{path} has type {leaf.dtype}: expected floating point")
    return leaf.shape if hasattr(leaf, "shape") else ()


def check(world: World, state: State) -> None:
    """Raise ValueError where shapes or types of `state` and `world` do not fit. Costs nothing at run time.

    Example:
        >>> dr.check(world, dr.replace(state, w=jnp.zeros((1, 3))))
        Traceback (most recent call last):
        ValueError: state.w has shape (1, 3), expected (N=1, A=1, *batch) in this 2D world of 1 bodies: ...
    """
    check_kinds(world, state)
    leaves, tree = jax.tree.flatten((world, state))
    if all(isinstance(leaf, Array) for leaf in leaves):
        _check_alike(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
    else:
        _check_batches(check_leaves(world, state))


@functools.lru_cache
def _check_alike(tree: Any, leaves: tuple) -> None:
    """`check`, cached for arguments of the same structure, shapes and types."""
    _check_batches(check_leaves(*jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*leaf) for leaf in leaves])))


def check_leaves(world: World, state: State, batch_first: bool = False) -> dict[tuple[int, ...], str]:
    """Raise ValueError unless every leaf has its own axes, and is of floating point numbers.

    Args:
        batch_first: leaves have at most one batch axis, and that comes first; else any number, which come last.

    Returns:
        All batch axes, each with the path of a leaf that has them.
    """
    batches: dict[tuple[int, ...], str] = {}
    fixed = {"N": len(world.names), "S": len(world.static_names)} | axis_sizes(world.dim)
    rows = [len(owners) for owners in world.owners], [len(group.a) for group in world.joints]
    stacks = {"shapes": rows[0], "offsets": rows[0], "joints": rows[1]}
    lengths = {f"world.{name}[{k}]": M for name, stack in stacks.items() for k, M in enumerate(stack)}

    def compare(leaf: Any, letters: tuple[str, ...], path: str):
        shape, sizes = shape_of_leaf(leaf, path), fixed | {"M": lengths.get(path.rpartition(".")[0])}
        count = max(len(shape) - len(letters), 0)
        batch, own = (shape[:count], shape[count:]) if batch_first else (shape[len(letters) :], shape[: len(letters)])
        known = [sizes.get(letter, size) for letter, size in zip(letters, own, strict=False)]
        if len(own) < len(letters) or list(own) != known or (batch_first and count > 1):
            wanted = [f"{l}={sizes[l]}" if l in sizes else l for l in letters]
            axes, where = (["[B]", *wanted], "first") if batch_first else ([*wanted, "*batch"], "last")
            raise ValueError(
                f"{path} has shape {shape}, expected ({', '.join(axes)}) in this {world.dim}D world of "
                f"{sizes['N']} bodies: make world and state with the same `scene`, and put batch axes {where}"
                + ("" if batch_first else " (or use rollout_batch)")
            )
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"{path} has type {jnp.result_type(leaf)}, expected floating point: convert it with "
                "jnp.asarray(..., float)"
            )
        batches.setdefault(batch, path)
        return leaf

    map_arrays(compare, state, "state")
    map_arrays(compare, world, "world")
    return batches


def _check_batches(batches: dict[tuple[int, ...], str]) -> None:
    """Raise ValueError unless all batch axes, compared from the first, are equal or of length one."""
    rank = max(map(len, batches))
    for axis in range(rank):
        lengths = {batch[axis]: path for batch, path in batches.items() if axis < len(batch) and batch[axis] != 1}
        if len(lengths) > 1:
            (n, first), (m, second), *_ = lengths.items()
            raise ValueError(
                f"batch axes do not fit: axis {axis} of the batch has length {n} in {first} but {m} in {second}; "
                "give both the same length, or one of them length 1"
            )
