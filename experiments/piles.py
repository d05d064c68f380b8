"""Do piles stand? Towers, a heavy load, a pyramid, a wall of bricks and a house of cards, 10 s at rest.

    python experiments/piles.py [pile ...]

Unit boxes (bricks 2 x 1, cards 1 x 0.04), friction 0.5 (cards 0.8), no rebound, 60 steps a second. Drift is the largest
displacement of any body at any time, energy the kinetic energy at the end. Boxes of a pyramid's row are 0.1 apart.
"""

import sys
import time

import numpy as np

SECONDS, RATE, G = 10.0, 60, 9.81


def piles():
    import diffrigid as dr

    def boxes(places, half=(0.5, 0.5), mass=1.0, tilt=0.0):
        masses, tilts = np.broadcast_to(mass, len(places)), np.broadcast_to(tilt, len(places))
        turned = [{"angle": float(angle)} if angle else {} for angle in tilts]
        return {
            f"{i}": dr.Body(dr.Box(half=half), mass=float(m), x=x, **turn)
            for i, (x, m, turn) in enumerate(zip(places, masses, turned, strict=True))
        }

    def tower(count):
        return [(0.0, 0.5 + i) for i in range(count)]

    def pyramid(rows):
        return [(1.1 * (i + 0.5 * row), 0.5 + row) for row in range(rows) for i in range(rows - row)]

    def wall(rows, columns):
        return [(2.0 * i + 0.5 * (row % 2), 0.5 + row) for row in range(rows) for i in range(columns)]

    def house():
        """Two pairs of cards that lean on each other, and a roof across them."""
        half, lean = (0.5, 0.02), np.radians(70.0)
        height = half[0] * np.sin(lean) + half[1] * np.cos(lean)
        reach = half[0] * np.cos(lean) + half[1] * np.sin(lean)
        places = [(foot + side * reach, height) for foot in (-2.0 * reach, 2.0 * reach) for side in (-1.0, 1.0)]
        roof = dr.Body(dr.Box(half=(2.0 * reach + 0.3, 0.02)), mass=0.2, x=(0.0, 2.0 * height + 0.02))
        return boxes(places, half, 0.1, [lean, np.pi - lean] * 2) | {"roof": roof}

    heavy = [1.0] * 4 + [100.0]
    return {
        "tower of 10": lambda: boxes(tower(10)),
        "tower of 5, load 100 : 1": lambda: boxes(tower(5), mass=heavy),
        "tower of 5 cubes": lambda: boxes([(0.0, *place) for place in tower(5)], (0.5, 0.5, 0.5)),
        "wall of 5 x 5 bricks": lambda: boxes(wall(5, 5), (1.0, 0.5)),
        "house of cards": house,
        "pyramid of 5 rows": lambda: boxes(pyramid(5)),
        "pyramid of 10 rows": lambda: boxes(pyramid(10)),
    }


def measure(bodies, friction):
    import jax
    import jax.numpy as jnp

    import diffrigid as dr

    dim = len(next(iter(bodies.values())).x)
    up = (0.0,) * (dim - 1) + (1.0,)
    floor = {"floor": dr.Static(dr.HalfSpace(normal=up))}
    gravity = tuple(-G * u for u in up)
    world, state = dr.scene(bodies | floor, gravity=gravity, restitution=0.0, friction=friction)
    start = time.perf_counter()
    path = dr.rollout(world, state, dt=1 / RATE, steps=int(SECONDS * RATE)).state
    jax.block_until_ready(path.x)
    end = jax.tree.map(lambda leaf: leaf[-1], path)
    drift = float(jnp.linalg.norm(path.x - state.x, axis=-1).max())
    energy = float(dr.kinetic_energy(world.bodies, end).sum())
    return drift, energy, time.perf_counter() - start


def main():
    import jax

    jax.config.update("jax_enable_x64", True)
    print(f"{'pile':26} drift [mm]  energy [J]  seconds, compiling included")
    for name, bodies in piles().items():
        if len(sys.argv) == 1 or name in sys.argv[1:]:
            drift, energy, seconds = measure(bodies(), 0.8 if "cards" in name else 0.5)
            print(f"{name:26} {1e3 * drift:10.3g}  {energy:10.2g}  {seconds:7.1f}", flush=True)


if __name__ == "__main__":
    main()
