"""Coefficients of the material law between two colliders."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import Array, lax

from diffrigid.contact.impulse import restitution_at
from diffrigid.contact.resting import Strikes
from diffrigid.gathers import constant, rows
from diffrigid.numerics import dot
from diffrigid.pytree import array, pytree

if TYPE_CHECKING:
    from diffrigid.world import World


@pytree
class Material:
    """Values of one material coefficient for M colliders."""

    value: Array = array("M")  # (M, *batch) [-]
    given: Array = array("M")  # (M, *batch) 1 if it was given to the collider itself, 0 if it is the scene's


def material(world: "World", name: str, colliders: tuple[int, ...]) -> Material:
    """Look up the coefficient `name` for the given colliders."""
    moving, still = getattr(world.bodies, name), getattr(world.statics, name)
    batch = jnp.broadcast_shapes(moving.shape[1:], still.shape[1:])
    values = jnp.concatenate([jnp.broadcast_to(x, x.shape[:1] + batch) for x in (moving, still)])
    own = dict(world.own)[name]
    given = constant(tuple(float(own[i]) for i in colliders), str(values.dtype))
    return Material(value=rows(values, colliders), given=lax.expand_dims(given, range(1, values.ndim)))


LAW = ("restitution", "friction", "restitution_falloff")


def materials(world: "World", colliders: tuple[int, ...], names: tuple[str, ...] = LAW) -> list[Material]:
    """Look up those of `names` that the world has; by default the coefficients that `law` takes."""
    return [material(world, name, colliders) for name in names if getattr(world.bodies, name) is not None]


def law(a: list[Material], b: list[Material], strike: Strikes) -> tuple[Array, Array]:
    """Coefficients of restitution and friction between two colliders at their impact."""
    e, mu, *falloff = map(mixed, a, b)
    if falloff:
        e = restitution_at(-jax.vmap(dot)(strike.normal, strike.v_rel), e, *falloff)
    return e, mu


def mixed(a: Material, b: Material) -> Array:
    """Mean of the coefficients of two colliders; one given to a collider itself outweighs the scene's."""
    return 0.5 * ((1.0 + a.given - b.given) * a.value + (1.0 + b.given - a.given) * b.value)
