"""What `test_devices` computes, on however many devices and processes:  shared_work.py DEVICES [ADDRESS COUNT RANK]."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather

import diffrigid as dr

WORLDS = 5  # on two devices one has a world more to do
STEPS = 24


def results():
    """Final states, the derivatives of a sum of squares, and fitted numbers, as lists."""
    disc = {"disc": dr.Body(dr.Disc(radius=0.2), mass=1.0, x=(0.0, 0.5))}
    floor = {"floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}
    world, state = dr.scene(disc | floor, gravity=(0.0, -9.81), restitution=0.7)
    v = jnp.stack([jnp.linspace(-1.0, 1.0, WORLDS), jnp.linspace(0.0, 5.0, WORLDS)], axis=1)[:, None]
    ends = dr.rollout_batch(world, dr.replace(state, v=v), dt=1 / 60, steps=STEPS, final_only=True)
    free, state = dr.scene(disc, gravity=(0.0, -9.81))

    def squares(world, v):
        return (dr.rollout_batch(world, dr.replace(state, v=v), dt=1 / 60, steps=STEPS).x ** 2).sum()

    slopes = jax.grad(squares, argnums=(0, 1))(free, v)
    t = np.linspace(0.0, 0.4, 9)
    seen = {"t": t, "disc.x": np.stack([0.3 * t, 0.5 + t - 4.9 * t**2], axis=1)}
    fit = dr.fit(free, state, seen, free={"disc.v": dr.real(), "gravity": dr.real()}, starts=3, progress=False)
    gathered = process_allgather((ends.x, ends.v, slopes[0].forces[0].g, slopes[1]), tiled=True)
    return jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), (*gathered, fit["disc.v"].value, fit["gravity"].value))


def main():
    devices, *processes = sys.argv[1:]
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", int(devices))
    if processes:
        address, count, rank = processes
        jax.distributed.initialize(address, int(count), int(rank), initialization_timeout=60)
    print(json.dumps({"devices": jax.device_count(), "results": results()}))


if __name__ == "__main__":
    main()
