"""The record that every pair function returns."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.pytree import array, pytree
from diffrigid.state import rotations

ALERT = 4e-3  # [-] of the size: least gap of a feature that may be met within the step; above `NEAR` of the search
FAR = 1e6  # [m] gap of features that cannot meet, and reach of unbounded shapes
THERE = 0.5 * FAR  # [m] contacts with a smaller gap exist


@pytree
class Contacts:
    """K contacts of one pair of shapes a and b, world frame."""

    gap: Array = array("K")  # (K, *batch) [m] signed distance, negative in penetration
    normal: Array = array("K", "D")  # (K, D, *batch) [-] unit, from b to a
    point: Array = array("K", "D")  # (K, D, *batch) [m] midway between the two surfaces
    feature: Any = array("K", default=None)  # (K, *batch) [-] number of the corner or crossing; None: always the same


def joined(*parts: Contacts) -> Contacts:
    """One list of several."""
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *parts)


def transferred(flags: Array, then: Array | None, now: Array | None) -> Array:
    """Flags (K, *batch) bool of contacts with the features `then`, at the same features `now`."""
    return flags if then is None or now is None else ((now[:, None] == then[None]) & flags[None]).any(1)


def in_world(contacts: Contacts, x: Array, q: Array) -> Contacts:
    """Contacts in the axes of a body at x (D, *batch) [m] and q (Q, *batch), in those of the world."""
    so = rotations(len(x))
    normal, point = (jax.vmap(so.rotate, (None, 0))(q, r) for r in (contacts.normal, contacts.point))
    return Contacts(gap=contacts.gap, normal=normal, point=point + x[None])


def slack_of(size: Array) -> Array:
    """Distance within which two features of shapes of this size coincide, sqrt(rounding) of it, (*batch) [m]."""
    return _share(size) * size


def size_of(slack: Array) -> Array:
    """Size of the shapes that have this slack, (*batch) [m]."""
    return slack / _share(slack)


def _share(like: Array) -> np.floating:
    return np.sqrt(np.finfo(like.dtype).eps).astype(like.dtype)
