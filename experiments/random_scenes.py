"""Do random valid scenes stay finite, forward and in both gradients, and obey the conservation laws?

    python experiments/random_scenes.py                                  # 10,000 scenes, about an hour on one core
    python experiments/random_scenes.py --structure free2 --bits 32 --batches 1 --first 3    # one batch again

A structure fixes which shapes, statics and joints there are; all numbers are random: masses 1e-3 to 1e3 kg, sizes 1e-2
to 1e1 m, speeds 0 to 50 m/s, restitution 0 and 1, friction 0 and 100, faces that touch exactly and in parallel, grazing
paths, spin, zero velocity, width 0 and above, steps of 1/60 and 1/240 s, float32 and float64. Each line of the output
counts what failed; each failure is printed with the batch and the number of its world.
"""

import argparse
import json
import os
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path

STEPS, BATCH = 24, 128
STRUCTURES = ("round2", "free2", "yard2", "round3", "hull3", "boxes3", "chain2", "arm3", "crowd2", "parts2")
PENTAGON = tuple(2.0 * 3.141592653589793 * i / 5 for i in range(5))
OCTAHEDRON = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
KINDS = {  # shapes in the order in which they stand in a line; a capital is a static. Few: compiling takes the time
    "round2": ("disc", "capsule"),
    "free2": ("box", "polygon"),
    "yard2": ("box", "DISC"),
    "round3": ("sphere", "capsule"),
    "hull3": ("hull",),
    "boxes3": ("box", "box"),
    "chain2": ("box", "box", "disc", "disc"),
    "arm3": ("sphere", "sphere", "sphere"),
    "crowd2": ("disc",) * 8,
    "parts2": ("hammer", "disc"),
}
LINKED, SECOND_ORDER = ("chain2", "arm3"), 1e-5  # what limits and friction leave of angular momentum, relative
FLOOR = ("yard2", "hull3", "arm3", "crowd2", "parts2")


def draw(structure, batch):
    """The numbers of BATCH worlds, each with a leading axis."""
    import numpy as np

    rng = np.random.default_rng([STRUCTURES.index(structure), batch])
    kinds, dim = KINDS[structure], int(structure[-1])
    shape = (BATCH, len(kinds))

    def some(*values, size=(BATCH,)):  # one of these numbers, or of these arrays
        return np.choose(rng.integers(0, len(values), size), values)

    def logs(low, high, size):
        return np.exp(rng.uniform(np.log(low), np.log(high), size))

    alike = logs(1e-2, 1e1, (BATCH, 1)) * np.ones(shape)
    like = rng.integers(0, 2, (BATCH, 1))
    size = np.where(like, np.clip(alike * rng.uniform(0.3, 3.0, shape), 1e-2, 1e1), logs(1e-2, 1e1, shape))
    q = rng.normal(size=(*shape, 2 if dim == 2 else 4))
    unturned = np.eye(q.shape[-1])[0]
    q = np.where(rng.integers(0, 2, (BATCH, 1, 1)), unturned, q / np.linalg.norm(q, axis=-1, keepdims=True))
    to = rng.normal(size=(*shape, dim))
    line = -np.eye(dim)[0] * np.linspace(-1, 1, len(kinds))[:, None]
    to = some(0.0, line, np.eye(dim)[-1], -np.eye(dim)[-1], to, size=(BATCH, 1, 1))
    w = rng.normal(size=(*shape, 1 if dim == 2 else 3)) * some(0.0, 1.0, 10.0, size=(BATCH, 1, 1))
    gentle = structure in ("chain2", "arm3")  # what spins faster than a step resolves is not accurate with joints
    return dict(
        mass=np.where(rng.integers(0, 2, (BATCH, 1)), logs(1e-3, 1e3, shape), logs(1e-1, 1e1, shape)), size=size, q=q,
        aspect=some(1.0, rng.uniform(0.2, 1.0, (*shape, 3)), logs(1e-2, 1.0, (*shape, 3)), size=(*shape, 3)),
        jitter=rng.uniform(-0.1, 0.1, (*shape, 6, 3)), upright=rng.integers(0, 2, BATCH).astype(float),
        slack=size * some(0.0, logs(1e-6, 1e-1, shape), rng.uniform(0, 2, shape), size=shape),
        height=size * some(0.0, rng.uniform(0, 1, shape), size=shape),
        aside=size * some(0.0, 1.0, rng.uniform(-1, 1, shape), size=shape),
        v=to * some(0.0, logs(1e-3, 50.0, (BATCH, 1, 1)), size=(BATCH, 1, 1)) * (0.05 if gentle else 1.0),
        w=w * (0.2 if gentle else np.minimum(1.0, 5.0 / size[..., None])),
        e=some(0.0, 1.0, rng.uniform(0, 1, BATCH)), mu=some(0.0, 100.0, rng.uniform(0, 1, BATCH)),
        width=some(0.0, 0.0, logs(1e-4, 1.0, BATCH)), g=some(0.0, 9.81),
        axis=rng.normal(size=(*shape, 3)),
        limit=rng.uniform(0.05, 1.0, (BATCH, 2)), drive=rng.uniform(0, 0.5, (BATCH, 2)),
    )  # fmt: skip


def shape_of(kind, p, i, dim):
    import jax.numpy as jnp

    import diffrigid as dr
    from diffrigid.shapes import with_topology

    size, half = p["size"][i], p["size"][i] * p["aspect"][i, :dim]
    match kind.lower():
        case "disc":
            return dr.Disc(radius=size)
        case "sphere":
            return dr.Sphere(radius=size)
        case "box":
            return dr.Box(half=half)
        case "capsule":
            return dr.Capsule(radius=half[1], half_length=size)
        case "hammer":
            head = dr.Part(dr.Disc(radius=0.5 * half[1]), x=half * jnp.asarray((1.0, 0.0), half.dtype))
            return {"handle": dr.Part(dr.Box(half=half), angle=p["jitter"][i, 0, 0]), "head": head}
        case "polygon":
            angle = jnp.asarray(PENTAGON, size.dtype) + 3.0 * p["jitter"][i, :5, 0]
            return dr.Polygon(vertices=half * jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1))
    hull = with_topology(dr.Hull(vertices=OCTAHEDRON))
    return dr.replace(hull, vertices=half * (jnp.asarray(OCTAHEDRON, size.dtype) + p["jitter"][i]))


def build(structure, p):
    """World and state of one world: bodies in a line, upwards or sideways, so that no two overlap."""
    import jax.numpy as jnp

    import diffrigid as dr
    from diffrigid.moments import volume_properties
    from diffrigid.shapes import radius, vertices
    from diffrigid.state import rotations

    kinds, dim, dtype = KINDS[structure], int(structure[-1]), p["size"].dtype
    so, up, along = rotations(dim), jnp.eye(dim, dtype=dtype)[-1], jnp.eye(dim, dtype=dtype)[0]
    bodies, top = {}, jnp.zeros((), dtype)
    for i, kind in enumerate(kinds):
        shape, q = shape_of(kind, p, i, dim), p["q"][i]
        if kind == "hammer":
            high = jnp.full(dim, 4.0 * p["size"][i])  # more than enough
            low = -high
        else:
            corners = vertices(shape, dim) - volume_properties(shape, dim)[1]
            corners = jnp.stack([so.rotate(q, corner) for corner in corners])
            low, high = corners.min(0) - radius(shape), corners.max(0) + radius(shape)
        upright = p["upright"]
        low_d, high_d = (jnp.where(upright, side[-1], side[0]) for side in (low, high))
        place = top - low_d + p["slack"][i]
        top = place + high_d
        x = jnp.where(upright, up * place + along * p["aside"][i], along * place + up * (p["height"][i] - low[-1]))
        name = f"{kind}{i}"
        if kind.isupper():
            bodies[name] = dr.Static(shape, x=x, q=q)
        else:
            bodies[name] = dr.Body(shape, mass=p["mass"][i], x=x, q=q, v=p["v"][i], w=p["w"][i])
    options = {}
    if structure in FLOOR:
        bodies["floor"] = dr.Static(dr.HalfSpace(normal=up))
        options["gravity"] = -p["g"] * up
    return dr.scene(
        bodies, restitution=p["e"], friction=p["mu"], contact=dr.Contact(width=p["width"]),
        joints=joints_of(structure, p, list(bodies)), **options,
    )  # fmt: skip


def joints_of(structure, p, names):
    """A hinge with limits, friction and damping, a slider and a rod in the plane; two hinges and a ball in space."""
    import diffrigid as dr

    drive = {"friction": p["drive"][0], "damping": p["drive"][1]}
    stops = {"lower": -p["limit"][0], "upper": p["limit"][1]}
    a, b, c, *rest = [*names, None, None]
    half = p["size"][:, None] * p["aspect"]
    if structure == "chain2":
        return [
            dr.Revolute(b, a, anchor_a=-0.5 * half[1, :2], **stops, **drive, restitution=p["e"]),
            dr.Prismatic(c, b, axis_b=p["axis"][1, :2]),
            dr.Distance(rest[0], c, anchor_b=0.1 * half[2, :2], anchor_a=-half[3, :2]),
        ]
    if structure == "arm3":
        return [
            dr.Revolute(a, None, anchor_a=-half[0], axis_a=p["axis"][0]),
            dr.Ball(b, a, anchor_a=-0.5 * half[1]),
            dr.Revolute(c, b, anchor_a=-0.5 * half[2], axis_a=p["axis"][2], **stops, **drive),
        ]
    return []


# ---- what is checked


def laws(world, states):
    """Energy, and sums that an isolated system keeps with their sizes; leading axis time, for one world."""
    import jax
    import jax.numpy as jnp

    import diffrigid as dr

    def at(state):
        p, L = dr.momentum(world.bodies, state), dr.angular_momentum(world.bodies, state)
        down = sum((force.g for force in world.forces), jnp.zeros_like(state.x[0]))
        energy = dr.kinetic_energy(world.bodies, state).sum() - (world.bodies.mass[:, None] * state.x * down).sum()
        spins = jnp.abs(dr.state.spin(world.bodies, state)).sum()
        arms = (jnp.linalg.norm(state.x, axis=1) * jnp.linalg.norm(p, axis=1)).sum()
        lift = (world.bodies.mass[:, None] * jnp.abs(state.x * down)).sum()
        creep = 0.5 * world.bodies.mass.sum() * world.contact.rest_speed**2  # of worlds where nothing moves
        return energy, p.sum(0), L.sum(0), jnp.abs(p).sum(), arms + spins, lift + creep

    return jax.vmap(at)(states)


def depth(world, state, index):
    """Deepest penetration over the smaller size, of all pairs of one world, by separating axes in NumPy."""
    import jax
    import numpy as np

    from diffrigid.overlap import outlines, pairs_of, separation

    world, state = jax.tree.map(lambda leaf: np.asarray(leaf, float), (jax.tree.map(lambda l: l[index], world), state))
    placed, worst = outlines(world, state), 0.0
    for i, j in pairs_of(world):
        worst = max(worst, -separation(placed[i], placed[j]) / min(placed[i].size, placed[j].size))
    return worst


def one_batch(structure, dtype, programs, batch):
    """Failures of one batch: (check, world, size of what failed)."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    made, forward, reverse = programs
    eps = float(jnp.finfo(dtype).eps)
    p = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), draw(structure, batch))
    world, state = made(p)
    dt = jnp.asarray((1 / 60, 1 / 240)[batch % 2], dtype)
    keys = iter(jax.random.split(jax.random.key(batch), 200))
    leaves, tree = jax.tree.flatten((world, state))
    tangent = jax.tree.unflatten(tree, [jax.random.normal(next(keys), leaf.shape, dtype) for leaf in leaves])
    states, moved = forward(world, state, *tangent, dt)
    weights = jax.tree.map(lambda leaf: jax.random.normal(next(keys), leaf.shape, dtype), state)
    slopes = reverse(world, state, weights, dt)

    def finite(tree):
        return np.logical_and.reduce([np.isfinite(leaf).reshape(BATCH, -1).all(1) for leaf in jax.tree.leaves(tree)])

    def products(one, other):  # of all leaves: the terms of a sum over them, by world
        pairs = zip(*map(jax.tree.leaves, (one, other)), strict=True)
        return [(a * b).reshape(BATCH, -1) for a, b in pairs]

    ahead = products(weights, jax.tree.map(lambda leaf: leaf[:, -1], moved))
    back = [np.asarray(terms, float) for terms in products(slopes, tangent)]
    size = sum(np.abs(terms).sum(1) for terms in back) + sum(np.abs(terms).sum(1) for terms in ahead)
    unlike = np.abs(np.asarray(sum(t.sum(1) for t in ahead)) - sum(t.sum(1) for t in back)) / (size + 1e-30)
    found = {
        "finite forward": (~finite(states), np.zeros(BATCH)),
        "finite tangents": (~finite(moved), np.zeros(BATCH)),
        "finite gradients": (~finite(slopes), np.zeros(BATCH)),
        "modes": (unlike > (1e-7 if eps < 1e-10 else 1e-2), unlike),
    } | breaches(structure, world, states, eps)
    return [(name, k, float(how[k])) for name, (bad, how) in found.items() for k in np.flatnonzero(bad)]


def breaches(structure, world, states, eps):
    """By law: in which worlds it is broken, and by how much."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    energy, momentum, L, p_size, L_size, lift = map(np.asarray, jax.jit(jax.vmap(laws))(world, states))
    scale = np.abs(energy[:, :1]) + np.abs(lift).max(1, keepdims=True) + 1e-20
    rise = (np.maximum.accumulate(energy[:, ::-1], 1)[:, ::-1][:, 1:] - energy[:, :-1]) / scale
    off = np.abs(jnp.linalg.norm(states.q, axis=-1) - 1).reshape(BATCH, -1).max(1)
    found = {"length of q": (off > 8 * eps, off), "energy": (rise.max(1) > 1e4 * eps + 1e-6, rise.max(1))}
    if structure not in FLOOR and not any(k.isupper() for k in KINDS[structure]):
        for name, sums, sizes in (("momentum", momentum, p_size), ("angular momentum", L, L_size)):
            off = np.abs(sums - sums[:, :1]).max((1, 2)) / (sizes.max(1) + 1e-30)
            found[name] = (off > max(200 * eps, SECOND_ORDER if structure in LINKED else 0.0), off)
    last = jax.tree.map(lambda leaf: np.asarray(leaf[:, -1], float), states)
    deep = np.array([depth(world, jax.tree.map(lambda leaf: leaf[k], last), k) for k in range(BATCH)])  # noqa: B023
    return found | {"penetration": (deep > 1e4 * eps + 1e-6, deep)}


def programs_of(structure):
    """Made worlds, states with tangents, gradients of a weighted sum of the last state; compiled once."""
    import jax

    import diffrigid as dr

    def forward(world, state, d_world, d_state, dt):
        def run(world, state):
            return dr.rollout_batch(world, state, dt=dt, steps=STEPS)

        return jax.jvp(run, (world, state), (d_world, d_state))

    def reverse(world, state, weights, dt):
        def loss(world, state):
            end = dr.rollout_batch(world, state, dt=dt, steps=STEPS, final_only=True)
            return sum((w * leaf).sum() for w, leaf in zip(*map(jax.tree.leaves, (weights, end)), strict=True))

        return jax.grad(loss, (0, 1))(world, state)

    return jax.jit(jax.vmap(partial(build, structure))), jax.jit(forward), jax.jit(reverse)


def run(structure, bits, first, batches):
    """Print the failures of some batches, and their counts."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", bits == 64)
    programs, counts = programs_of(structure), Counter()
    for batch in range(first, first + batches):
        for name, world, how in one_batch(structure, jnp.float64 if bits == 64 else jnp.float32, programs, batch):
            counts[name] += 1
            print(f"  {structure} --bits {bits} batch {batch} world {world}: {name} {how:.3g}", flush=True)
    print(json.dumps({"structure": structure, "bits": bits, "worlds": batches * BATCH, "failed": counts}), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--structure", choices=STRUCTURES)
    parser.add_argument("--bits", type=int, choices=(32, 64))
    parser.add_argument("--first", type=int, default=0, help="number of the first batch")
    parser.add_argument("--batches", type=int, default=5, help=f"of {BATCH} worlds, of each structure and type")
    args = parser.parse_args()
    if args.structure and args.bits:
        return run(args.structure, args.bits, args.first, args.batches)
    env = os.environ | {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"}
    for bits in [args.bits] if args.bits else (64, 32):
        for structure in [args.structure] if args.structure else STRUCTURES:
            command = ["--structure", structure, "--bits", str(bits), "--first", str(args.first)]
            command = [sys.executable, Path(__file__), *command, "--batches", str(args.batches)]
            subprocess.run(command, env=env, check=True)


if __name__ == "__main__":
    main()
