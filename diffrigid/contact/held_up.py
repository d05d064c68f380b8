"""Colliders placed as if forces had not displaced them, where they are supported: to see which of their faces meet."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from diffrigid.branches import choose
from diffrigid.collide import Contacts
from diffrigid.contact.sides import Placed, Side, began
from diffrigid.flight import fall
from diffrigid.numerics import dot
from diffrigid.pytree import replace


class HeldUp(NamedTuple):
    """Two colliders placed as if forces had not displaced those that are supported.

    What rests falls on its path until it is held, into what it rests on: there a corner that slides past the end of a
    face may be nearer to another face, which it never strikes. Only which faces meet depends on it: between flat faces
    and straight edges the gaps of the paths themselves are larger by `way` along the normal, exactly.
    """

    at_a: Placed
    at_b: Placed
    way: Array | None  # (D, *batch) [m] of a against b; None: neither is moved
    speed: Array | None  # (D, *batch) [m/s] its rate

    def gaps(self, contacts: Contacts) -> Array:
        """Gaps of the paths, (K, *batch) [m], from contacts of the colliders as placed here."""
        return contacts.gap if self.way is None else contacts.gap + jax.vmap(dot, (0, None))(contacts.normal, self.way)


def held_up(a: Side, at_a: Placed, b: Side, at_b: Placed, s: Array) -> HeldUp:
    """Hold up what is supported of two colliders placed at s (*batch) [s]."""
    if a.supported is None and b.supported is None:
        return HeldUp(at_a, at_b, None, None)
    none = (jnp.zeros_like(at_a.x),) * 2
    falls = [none if side.supported is None else choose(side.supported, fall(side.flight, s), none) for side in (a, b)]
    at_a, at_b = (replace(at, x=at.x - way) for at, (way, _) in zip((at_a, at_b), falls, strict=True))
    return HeldUp(at_a, at_b, *map(jnp.subtract, *falls))


def is_supported(a: Side, b: Side) -> Array:
    """Whether one of two colliders is supported, (*batch) bool."""
    flags = [side.supported for side in (a, b) if side.supported is not None]
    return functools.reduce(jnp.logical_or, flags, jnp.zeros(began(a, b).shape, bool))
