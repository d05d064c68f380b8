"""Do the derivatives of thrown bodies agree with finite differences?

    python experiments/slopes.py [--kind NAME] [--throws 24]

Bodies of some kind are thrown at a floor and at each other, for a second at 1/60 s: they strike, slip, roll and come to
rest. Forward mode gives how their places and orientations change, at every step, along one random direction of the
start, of masses, restitution and friction; beside it stand central differences of three sizes. At the end of a throw

    right   the derivatives agree with the best of the three, to 1e-4 of the largest one of the throw
    kinked  they do not, but neither do the differences of 1e-6 and 1e-7: the paths that these compare part
    wrong   they do not

Each kind takes about a minute on one core, most of it to compile.
"""

import argparse
import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=1")

import jax
import jax.numpy as jnp
import numpy as np

import diffrigid as dr

DT, STEPS = 1 / 60, 60
SIZES = 1e-6, 1e-7, 1e-8  # of the differences
RIGHT = 1e-4
G = 9.81

BOX, ROD, BALL = dr.Box(half=(0.2, 0.15, 0.1)), dr.Capsule(radius=0.1, half_length=0.2), dr.Sphere(radius=0.2)
CORNERS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
GEM = dr.Hull(vertices=np.array(CORNERS) * (0.2, 0.15, 0.25) + 0.02 * np.random.default_rng(0).normal(size=(6, 3)))
TILE = dr.Box(half=(0.2, 0.1))
PENTAGON = dr.Polygon(vertices=[(0.2 * np.cos(t), 0.2 * np.sin(t)) for t in 0.4 * np.pi * np.arange(5)])
HILLS = dr.HeightField(heights=0.15 * np.random.default_rng(7).normal(size=(6, 6)), spacing=0.5)
RIDGES = dr.Profile(points=np.stack([np.linspace(-3, 3, 9), 0.2 * np.random.default_rng(3).normal(size=9)], 1))
FLOOR, LINE = dr.HalfSpace(normal=(0.0, 0.0, 1.0)), dr.HalfSpace(normal=(0.0, 1.0))

KINDS = {  # the ground, what is thrown at it, and the joint between two
    "box and ball": (FLOOR, (BOX, BALL), None),
    "box and rod": (FLOOR, (BOX, ROD), None),
    "box and gem": (FLOOR, (BOX, GEM), None),
    "boxes": (FLOOR, (BOX, dr.Box(half=(0.15, 0.15, 0.2))), None),
    "gems": (FLOOR, (GEM, GEM), None),
    "rods": (FLOOR, (ROD, ROD), None),
    "ball joint": (FLOOR, (ROD, BOX), dr.Ball),
    "hinge": (FLOOR, (ROD, BOX), dr.Revolute),
    "weld": (FLOOR, (ROD, BOX), dr.Weld),
    "ball on hills": (HILLS, (BALL,), None),
    "box on hills": (HILLS, (BOX,), None),
    "gem on hills": (HILLS, (GEM,), None),
    "pentagon and rod": (LINE, (PENTAGON, ROD), None),
    "hinge in 2D": (LINE, (PENTAGON, TILE), dr.Revolute),
    "pentagon and tile on ridges": (RIDGES, (PENTAGON, TILE), None),
}


def thrown(kind, seed):
    """World and state, and a direction in which both change."""
    ground, shapes, joint = KINDS[kind]
    random = np.random.default_rng(seed)
    D = 2 if ground in (LINE, RIDGES) else 3
    Q, A = (2, 1) if D == 2 else (4, 3)
    up, v = np.eye(D)[-1], random.normal(size=D)
    bodies = {"ground": dr.Static(ground)}
    for number, shape in enumerate(shapes):
        q = random.normal(size=Q)
        w = 2.0 * random.normal(size=A)
        x = 0.6 * up + number * (0.7 * up + 0.1 * np.eye(D)[0])
        if joint is not None:  # as one, without a turn, so that the joint holds
            x, w = 0.9 * up + number * (0.4 * np.eye(D)[0] + 0.1 * up), np.zeros(A)
        if number and joint is None:
            v = -2.0 * up
        bodies["ab"[number]] = dr.Body(shape, mass=1.0 + 0.3 * number, x=x, q=q / np.linalg.norm(q), v=v, w=w)
    limits = {"lower": -0.5, "upper": 0.5} if joint is dr.Revolute else {}
    axis = {"axis_a": (0.0, 1.0, 0.0)} if joint is dr.Revolute and D == 3 else {}
    joints = [] if joint is None else [joint("a", "b", anchor_a=0.25 * np.eye(D)[0], **axis, **limits)]
    world, state = dr.scene(bodies, gravity=-G * up, restitution=0.4, friction=0.5, joints=joints)

    change = jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)), state)
    if joint is None:
        along = (change.q * state.q).sum(1, keepdims=True)
        change = dr.replace(change, q=change.q - along * state.q)
    else:
        alike = {name: getattr(change, name)[:1] + 0.0 * getattr(change, name) for name in "xv"}
        change = dr.replace(change, **alike, q=0.0 * change.q, w=0.0 * change.w)
    still = jax.tree.map(jnp.zeros_like, world)
    some = {
        name: jnp.asarray(0.1 * random.normal(size=getattr(world.bodies, name).shape))
        for name in ("mass", "restitution", "friction")
    }
    return (world, state), (dr.replace(still, bodies=dr.replace(still.bodies, **some)), change)


def judged(kind, throws):
    """Which of the throws are right, kinked, and wrong, and how far off each is."""
    given, change = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[thrown(kind, k) for k in range(throws)])

    def places(world, state):
        states = dr.rollout(world, state, dt=DT, steps=STEPS).state
        return jnp.concatenate([states.x, states.q], -1)[1:]

    def one(both):
        return jax.jvp(places, *both)

    @jax.jit
    def along(given, change, size):
        moved = jax.tree.map(lambda leaf, d: leaf + size * d, given, change)
        return jax.lax.map(one, (moved, change))

    slopes = np.asarray(along(given, change, 0.0)[1])
    differences = [
        np.asarray((along(given, change, size)[0] - along(given, change, -size)[0]) / (2.0 * size)) for size in SIZES
    ]
    scale = np.abs(differences[1]).max((1, 2, 3)) + 1e-3

    def apart(a, b):
        return np.abs(a[:, -1] - b[:, -1]).max((1, 2)) / scale

    error = np.minimum.reduce([apart(slopes, each) for each in differences])
    parts = apart(*differences[:2]) > RIGHT
    right = error < RIGHT
    return right, ~right & parts, ~right & ~parts, error


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--throws", type=int, default=24)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'of ' + str(args.throws):28} right  kinked  wrong  (throw: error)")
    for kind in [args.kind] if args.kind else KINDS:
        right, kinked, wrong, error = judged(kind, args.throws)
        which = ", ".join(f"{k}: {error[k]:.0e}" for k in np.flatnonzero(wrong))
        print(f"{kind:28} {right.sum():5}  {kinked.sum():6}  {wrong.sum():5}  {which}", flush=True)


if __name__ == "__main__":
    main()
