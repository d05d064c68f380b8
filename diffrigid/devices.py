"""Divide work over all JAX devices, those of other processes too; with one device this does nothing.

Devices do not communicate while they work, so each takes its own branches, and a pass that none of its worlds needs is
skipped, which it would not be if XLA divided the program.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

ALONG_DEVICES = PartitionSpec("devices")


def devices() -> list[jax.Device]:
    """The devices that share the work: all of the default platform, or the one that `jax.default_device` names."""
    chosen = jax.config.jax_default_device  # type: ignore[attr-defined]
    return [chosen] if isinstance(chosen, jax.Device) else jax.devices(chosen)


def on_cpu() -> bool:
    """Whether the devices that do the work are CPUs."""
    return devices()[0].platform == "cpu"


def over_devices(fn: Callable, parts: Any, whole: Any) -> Any:
    """Evaluate fn(parts, whole), each device on its share.

    Args:
        parts: arrays divided along their leading axis, a multiple of the number of devices; so are the results.
        whole: arrays of which every device gets all; their derivatives are added up.
    """
    if len(devices()) == 1:
        return fn(parts, whole)
    # Without the check of which values vary between devices: it does not support the loops and solves inside.
    specs = (ALONG_DEVICES, PartitionSpec())
    return jax.shard_map(fn, mesh=_mesh(), in_specs=specs, out_specs=ALONG_DEVICES, check_vma=False)(parts, whole)


def everywhere(tree: Any) -> Any:
    """Replicate arrays on every device, so that every process can read them."""
    if len(devices()) == 1:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(_mesh(), PartitionSpec()))


def _mesh() -> Mesh:
    return Mesh(np.array(devices()), ("devices",))


def pieces_of(count: int, most: int) -> tuple[int, int]:
    """Number of pieces, a multiple of that of devices, and their length, at most `most`, for `count` worlds or more."""
    many = len(devices())
    pieces = many * -(-count // (many * most))
    return pieces, -(-count // pieces)


def cut(leaf: Array, axis: int, pieces: int, length: int) -> Array:
    """Cut one axis into `pieces`, (pieces, ..., length), filled up with copies of the last world."""
    leaf = jnp.moveaxis(leaf, axis, 0)
    short = pieces * length - leaf.shape[0]
    leaf = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], short, axis=0)]) if short else leaf
    return jnp.moveaxis(leaf.reshape(pieces, length, *leaf.shape[1:]), 1, -1)


def join(leaf: Array, axis: int, count: int) -> Array:
    """Undo `cut`: (pieces, ..., length) to one axis of `count`."""
    leaf = jnp.moveaxis(leaf, -1, 1)
    return jnp.moveaxis(leaf.reshape(-1, *leaf.shape[2:])[:count], 0, axis)
