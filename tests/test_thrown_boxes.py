"""Two boxes thrown at each other over a floor, in space: slopes of the whole motion beside differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrigid as dr

RATE, STEPS = 60, 60  # it lands, is struck, slips, sticks and rests
SIZES, RIGHT = (1e-6, 1e-7), 1e-4  # of the differences, and how near the slopes are to one of them
HALVES, PLACES = ((0.2, 0.15, 0.1), (0.15, 0.15, 0.2)), ((0.0, 0.0, 0.4), (0.1, 0.05, 1.0))


def thrown(seed):
    """Two boxes of any orientation and motion, and a direction in which to change them."""
    random = np.random.default_rng(seed)
    bodies = {}
    for name, half, x in zip(("low", "high"), HALVES, PLACES, strict=True):
        q, w = random.normal(size=4), 2.0 * random.normal(size=3)
        v = random.normal(size=3) if name == "low" else (0.0, 0.0, -2.0)
        bodies[name] = dr.Body(dr.Box(half=half), mass=1.0, x=x, q=q / np.linalg.norm(q), w=w, v=v)
    floor = {"floor": dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))}
    world, state = dr.scene(bodies | floor, gravity=(0.0, 0.0, -9.81), restitution=0.4, friction=0.5)
    change = jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)), state)
    q = change.q - (change.q * state.q).sum(1, keepdims=True) * state.q
    return world, state, dr.replace(change, q=q)


@pytest.mark.slow
def test_slopes_are_those_of_differences():
    """Contacts that repeat each other share their impulses in many ways; the motion and its slopes know of none.

    Where one of the paths that are compared has an impact, or slips, that the other has not, they may differ. Then so do
    differences of two sizes.
    """

    def moved(world, state, change):
        return jax.jvp(lambda state: dr.step(world, state, 1 / RATE), (state,), (change,))

    @jax.jit
    def slopes(world, state, change, small):
        """Of the last step, and the differences, by leaf."""

        def one(carry, _):
            paths, change = carry
            changes = jax.tree.map(lambda leaf: jnp.stack([leaf, 0.0 * leaf, 0.0 * leaf]), change)
            paths, changes = jax.lax.map(lambda each: moved(world, *each), (paths, changes))
            return (paths, jax.tree.map(lambda leaf: leaf[0], changes)), None

        start = jax.tree.map(lambda x, dx: jnp.stack([x, x + small * dx, x - small * dx]), state, change)
        (paths, change), _ = jax.lax.scan(one, (start, change), None, length=STEPS)
        return change, jax.tree.map(lambda leaf: (leaf[1] - leaf[2]) / (2.0 * small), paths)

    def errors(seed):
        """Of the slopes beside differences of both sizes, and of these beside each other."""
        (slope, wide), (_, narrow) = (slopes(*thrown(seed), size) for size in SIZES)
        size = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(slope))

        def apart(a, b):
            return max(float(jnp.abs(each).max()) for each in jax.tree.leaves(jax.tree.map(jnp.subtract, a, b))) / size

        return apart(slope, wide), apart(slope, narrow), apart(wide, narrow)

    wide, narrow, between = np.array([errors(seed) for seed in range(20)]).T
    right, kinked = np.minimum(wide, narrow) < RIGHT, between > RIGHT
    assert (right | kinked).all(), (wide, narrow, between)
    assert right.sum() >= 16, (wide, narrow)
