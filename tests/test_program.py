"""The size of the programs that are compiled, which their compile time goes with, in operations of JAX."""

import functools
import itertools

import jax
import numpy as np

import diffrigid as dr

STEPS, DT = 20, 1 / 240
MARGIN = 1.1  # what a change may add without a thought


def discs(side):
    """A box full of discs, as in S2 of experiments/throughput.py with side 4."""
    disc = dr.Disc(radius=0.1)
    bodies = {
        f"{i}{j}": dr.Body(disc, mass=1.0, x=(0.25 + 0.5 * i, 0.25 + 0.5 * j))
        for i, j in itertools.product(range(side), repeat=2)
    }
    for name, (x, y) in {"left": (1, 0), "right": (-1, 0), "floor": (0, 1), "lid": (0, -1)}.items():
        bodies[name] = dr.Static(dr.HalfSpace(normal=(x, y), offset=min(0.5 * side * (x + y), 0.0)))
    return dr.scene(bodies, restitution=1.0, contact=dr.Contact(sweeps=1))


def cube():
    """Over a floor, as in S4."""
    body = dr.Body(dr.Box(half=np.full(3, 0.05)), mass=0.37, x=(0.0, 0.0, 0.3))
    bodies = {"cube": body, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))}
    return dr.scene(bodies, gravity=(0.0, 0.0, -9.81), friction=0.2, restitution=0.3)


def operations(jaxpr):
    """With those of functions, branches and loops, as often as they are written."""
    known = {}

    def count(jaxpr):
        if id(jaxpr) not in known:
            inside = [leaf for eqn in jaxpr.eqns for leaf in jax.tree.leaves(tuple(eqn.params.values()))]
            bodies = [getattr(leaf, "jaxpr", leaf) for leaf in inside]
            known[id(jaxpr)] = len(jaxpr.eqns) + sum(count(body) for body in bodies if hasattr(body, "eqns"))
        return known[id(jaxpr)]

    return count(jaxpr.jaxpr)


@functools.cache
def size(scene, *args, steps=STEPS):
    """Operations of the gradient of a rollout, most of which are those of rollouts."""

    def end(world, state):
        return (dr.rollout(world, state, dt=DT, steps=steps).state.x[-1] ** 2).sum()

    return operations(jax.jit(jax.grad(end, (0, 1))).trace(*scene(*args)).jaxpr)


def test_programs_do_not_grow_unnoticed():
    assert size(discs, 4) < MARGIN * 28200
    assert size(cube) < MARGIN * 31400


def test_programs_do_not_grow_with_bodies_and_steps():
    assert size(discs, 4) < MARGIN * size(discs, 3, steps=2 * STEPS)
