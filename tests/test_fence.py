"""What is not to be fused stays a call of its own in the compiled program, in both modes, and changes nothing."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from diffrigid.fence import at_hand, unfused

X = jnp.array([0.3, 1.2, -0.7])


def plain(x):
    return jnp.cos(jnp.sin(x) * x) * x


def fenced(x):
    return unfused(jnp.cos, unfused(lambda x: jnp.sin(x) * x, x)) * x


def held(x):
    return jnp.cos(at_hand(jnp.sin(x) * x)) * x


TRANSFORMS = {
    "value": (lambda fn: fn, 1),
    "vmap": (jax.vmap, 1),
    "forward": (lambda fn: lambda x: jax.jvp(fn, (x,), (jnp.ones_like(x),))[1], 1),
    "reverse": (lambda fn: jax.grad(lambda x: fn(x).sum()), 2),  # each call, and its transpose
    "twice": (lambda fn: jax.jacfwd(jax.grad(lambda x: fn(x).sum())), 2),
    "recomputed": (lambda fn: jax.grad(lambda x: jax.checkpoint(fn)(x).sum()), 2),
}


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("fn, calls", [(fenced, 2), (held, 1)])
def test_a_call_stays_one(fn, calls, transform):
    transformed, times = TRANSFORMS[transform]
    program = jax.jit(transformed(fn)).lower(X).compile()
    assert program.as_text().count(" call(") >= calls * times
    assert_allclose(program(X), transformed(plain)(X), rtol=1e-14)


def test_outside_a_program_it_is_the_function():
    assert_allclose(fenced(X), plain(X), rtol=1e-14)
    assert_allclose(unfused(lambda pair: pair["a"] - pair["b"][0], {"a": X, "b": (2.0,)}), X - 2.0, rtol=1e-14)
