"""Ten thousand steps, in both precisions: finite, inside, and without energy from nowhere."""

import jax
import jax.numpy as jnp
import numpy as np
from marks import some_later

import diffrigid as dr

STEPS, DT, G = 10_000, 1 / 240, 9.81
# Relative: rounding of 10,000 steps of a motion that goes on; what gaps that are closed again make of two discs that rest
# on each other and on the floor.
GAINED = {("float64", 1.0): 1e-11, ("float64", 0.9): 1e-6, ("float32", 1.0): 2e-3, ("float32", 0.9): 2e-3}


@some_later("dtype, restitution", GAINED, ("float32", 1.0), ("float64", 0.9))
def test_ten_thousand_steps(dtype, restitution):
    disc = dr.Disc(radius=0.3)
    wall = {
        str(n): dr.Static(dr.HalfSpace(normal=n, offset=o))
        for n, o in (((0.0, 1.0), 0.0), ((1.0, 0.0), 0.0), ((-1.0, 0.0), -2.0))
    }
    bodies = {
        "one": dr.Body(disc, mass=1.0, x=(0.5, 1.0), v=(2.0, 0.0), w=3.0),
        "other": dr.Body(disc, mass=3.0, x=(1.4, 0.9), v=(-1.0, 1.0)),
    }
    bodies |= {f"wall{k}": static for k, static in enumerate(wall.values())}
    pair = dr.scene(bodies, gravity=(0.0, -G), restitution=restitution, friction=0.0 if restitution == 1.0 else 0.3)
    world, state = jax.tree.map(lambda leaf: leaf.astype(dtype), pair)
    states = dr.rollout(world, state, dt=jnp.asarray(DT, dtype), steps=STEPS).state
    assert states.x.dtype == dtype and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
    x, v, w = (np.asarray(leaf, float) for leaf in (states.x, states.v, states.w))
    mass, inertia = np.asarray(world.bodies.mass, float), np.asarray(world.bodies.inertia, float)
    energy = (0.5 * mass * (v**2).sum(2) + 0.5 * inertia * w[..., 0] ** 2 + mass * G * x[..., 1]).sum(1)
    gained = GAINED[dtype, restitution] * energy[0]
    assert (energy - np.minimum.accumulate(energy)).max() < gained
    if restitution == 1.0:
        assert energy.min() > energy[0] - gained
    inside = 1e-9 if dtype == "float64" else 1e-4  # [m]
    assert x[..., 1].min() > 0.3 - inside and x[..., 0].min() > 0.3 - inside and x[..., 0].max() < 1.7 + inside
    assert np.abs(np.linalg.norm(states.q, axis=2) - 1).max() < 8 * np.finfo(dtype).eps
