"""How deep are bodies inside the sides of a valley at the ends of steps?

    python experiments/valley.py [--sweeps 4]

Rods and boxes fall into a right angle between two half-spaces, turned and spun at random, with restitution 0 or 0.3 and
friction 0 or 0.2: 4 times 128 of each, a second and a half. What is struck by both sides in turn, more often than a
step has sweeps, ends it inside. Prints how many of each were ever deeper than a thousandth of their radius or half
thickness, and the deepest, in per cent of it.
"""

import argparse
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

import diffrigid as dr

COUNT, SECONDS, THICK, LONG = 128, 1.5, 0.1, 0.35  # [m] half thickness, half length
COEFFICIENTS = tuple(product((0.0, 0.3), (0.0, 0.2)))  # restitution, friction
SHAPES = {
    "rod, 2D": (2, dr.Capsule(radius=THICK, half_length=LONG - THICK)),
    "box, 2D": (2, dr.Box(half=(LONG, THICK))),
    "rod, 3D": (3, dr.Capsule(radius=THICK, half_length=LONG - THICK)),
    "box, 3D": (3, dr.Box(half=(LONG, THICK, THICK))),
}


def valley(dim, shape, restitution, friction, sweeps):
    c, level = np.sqrt(0.5), (0.0,) * (dim - 2)
    sides = {name: dr.Static(dr.HalfSpace(normal=(sign * c, *level, c))) for name, sign in (("left", 1), ("right", -1))}
    body = dr.Body(shape, mass=1.0, x=(0.0, *level, 0.8))
    return dr.scene(
        {"body": body, **sides}, gravity=(0.0, *level, -9.81), restitution=restitution, friction=friction,
        contact=dr.Contact(sweeps=sweeps),
    )  # fmt: skip


def starts(state, dim):
    rng, so = np.random.default_rng(0), dr.state.rotations(dim)
    x = np.asarray(state.x) + np.eye(dim)[0] * rng.uniform(-0.2, 0.2, (COUNT, 1, 1))
    q = jax.vmap(so.exp)(jnp.asarray(rng.uniform(-np.pi, np.pi, (COUNT, so.A))))[:, None]
    v, w = rng.uniform(-1.0, 1.0, x.shape), rng.uniform(-5.0, 5.0, (COUNT, 1, so.A))
    return dr.State(**{name: jnp.asarray(leaf, state.x.dtype) for name, leaf in dict(x=x, q=q, v=v, w=w).items()})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sweeps", type=int, default=4)
    sweeps = parser.parse_args().sweeps
    jax.config.update("jax_enable_x64", True)
    print(f"{'':10} steps/s  inside  of  deepest")
    for (name, (dim, shape)), rate in product(SHAPES.items(), (60, 240)):
        deepest = []
        for restitution, friction in COEFFICIENTS:
            world, state = valley(dim, shape, restitution, friction, sweeps)
            states = dr.rollout_batch(world, starts(state, dim), dt=1 / rate, steps=int(SECONDS * rate))

            def gap(state, world=world):
                return jnp.minimum(*(dr.gap(world, state, "body", side) for side in ("left", "right")))

            deepest.append(-np.asarray(jax.jit(jax.vmap(jax.vmap(gap)))(states)).min(1) / THICK)
        deepest = np.concatenate(deepest)
        print(f"{name:10} {rate:7}  {(deepest > 1e-3).sum():6} {len(deepest)}  {100 * deepest.max():.2g} %", flush=True)


if __name__ == "__main__":
    main()
