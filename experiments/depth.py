"""How deep are bodies inside what they fall on, at the ends of steps?

    python experiments/depth.py [--sweeps 4] [--only plate]

Rods and boxes fall into a right angle between two half-spaces, and plates of three thicknesses on a box; turned and
spun at random, with restitution 0 or 0.3 and friction 0 or 0.2: 4 times 128 of each, of plates 4 times 32, for a second
and a half. What is struck more often than a step has sweeps ends it inside. Prints how many of each were ever deeper
than a thousandth of their radius or half thickness, and the deepest, in per cent of it.
"""

import argparse
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

import diffrigid as dr

SECONDS, THICK, LONG = 1.5, 0.1, 0.35  # [m] half thickness, half length
COEFFICIENTS = tuple(product((0.0, 0.3), (0.0, 0.2)))  # restitution, friction
C = np.sqrt(0.5)


def valley(dim):
    level = (0.0,) * (dim - 2)
    return {name: dr.Static(dr.HalfSpace(normal=(sign * C, *level, C))) for name, sign in (("left", 1), ("right", -1))}


BOX = {"box": dr.Static(dr.Box(half=(LONG, LONG, LONG)), x=(0.0, 0.0, -0.1))}
# Number, dimensions, shape, its radius or half thickness, and what it falls on.
SCENES = {
    "rod, 2D": (128, 2, dr.Capsule(radius=THICK, half_length=LONG - THICK), THICK, valley(2)),
    "box, 2D": (128, 2, dr.Box(half=(LONG, THICK)), THICK, valley(2)),
    "rod, 3D": (128, 3, dr.Capsule(radius=THICK, half_length=LONG - THICK), THICK, valley(3)),
    "box, 3D": (128, 3, dr.Box(half=(LONG, THICK, THICK)), THICK, valley(3)),
} | {f"plate, {1000 * h:.0f} mm": (32, 3, dr.Box(half=(LONG, 0.7 * LONG, h)), h, BOX) for h in (0.1, 0.035, 0.01)}


def starts(state, count, dim):
    rng, so = np.random.default_rng(0), dr.state.rotations(dim)
    x = np.asarray(state.x) + np.eye(dim)[0] * rng.uniform(-0.2, 0.2, (count, 1, 1))
    q = jax.vmap(so.exp)(jnp.asarray(rng.uniform(-np.pi, np.pi, (count, so.A))))[:, None]
    v, w = rng.uniform(-1.0, 1.0, x.shape), rng.uniform(-5.0, 5.0, (count, 1, so.A))
    return dr.State(**{name: jnp.asarray(leaf, state.x.dtype) for name, leaf in dict(x=x, q=q, v=v, w=w).items()})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sweeps", type=int, default=4)
    parser.add_argument("--only", default="", help="kinds that begin like this")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'':12} steps/s  inside  of  deepest")
    kinds = {name: of for name, of in SCENES.items() if name.startswith(options.only)}
    for (name, (count, dim, shape, thick, ground)), rate in product(kinds.items(), (60, 240)):
        deepest, level = [], (0.0,) * (dim - 2)
        for restitution, friction in COEFFICIENTS:
            world, state = dr.scene(
                {"body": dr.Body(shape, mass=1.0, x=(0.0, *level, 0.8)), **ground},
                gravity=(0.0, *level, -9.81),
                restitution=restitution,
                friction=friction,
                contact=dr.Contact(sweeps=options.sweeps),
            )
            states = dr.rollout_batch(world, starts(state, count, dim), dt=1 / rate, steps=int(SECONDS * rate))

            def gap(state, world=world, ground=tuple(ground)):
                return jnp.stack([dr.gap(world, state, "body", side) for side in ground]).min(0)

            deepest.append(-np.asarray(jax.jit(jax.vmap(jax.vmap(gap)))(states)).min(1) / thick)
        deepest = np.concatenate(deepest)
        print(f"{name:12} {rate:7}  {(deepest > 1e-3).sum():6} {len(deepest)}  {100 * deepest.max():.2g} %", flush=True)


if __name__ == "__main__":
    main()
