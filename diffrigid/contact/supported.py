"""Which bodies rest on something where their paths begin: `held_up.py` needs to know before a search for impacts."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.contact.approach import resting, task_of
from diffrigid.contact.gaps import gaps_at
from diffrigid.contact.impact import closed_form, round_rests
from diffrigid.contact.sides import Side, earliest, have_faces, sides_of
from diffrigid.contact.strikes import pair_ends, relative_path_is_straight
from diffrigid.contact.sums import side_sum
from diffrigid.flight import Flight

if TYPE_CHECKING:
    from diffrigid.world import World


def matters(world: "World") -> bool:
    """Whether it matters which bodies are supported: where they fall and flat faces meet that end somewhere. Static."""
    falls = bool(world.forces or world.joints)
    return falls and any(have_faces(*(type(world.shapes[k]) for k in (p.shape_a, p.shape_b))) for p in world.pairs)


def find_supported(world: "World", flight: Flight, since: Array, dt: Array) -> Array:
    """Which bodies rest on something where their paths begin, (N, *batch) bool."""
    found = []
    for pairs in world.pairs:
        a, b = sides_of(world, pairs, flight, since)
        straight = relative_path_is_straight(world, a.flight is not None and b.flight is not None)
        rests: Callable = functools.partial(_rests, t1=dt, straight=straight, rest_speed=world.contact.rest_speed)
        found.append(jax.vmap(rests)(a, b))
    on = jnp.concatenate(found).astype(dt.dtype)
    return side_sum(on, on, *pair_ends(world), len(world.names)) > 0


def _rests(a: Side, b: Side, t1: Array, straight: bool, rest_speed: Array) -> Array:
    """Whether two colliders rest on each other where their paths begin, (*batch) bool."""
    a, b, t1, rest_speed = lax.stop_gradient((a, b, t1, rest_speed))
    if closed_form(a, b, straight):
        return round_rests(a, b, earliest(a, b)[0], rest_speed)
    task = task_of(a, b, t1, None, rest_speed, jnp.zeros(t1.shape, bool))
    return resting(task, gaps_at(a, b, task.start)).any(0)
