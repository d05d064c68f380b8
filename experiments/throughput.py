"""How many world-steps a second does one core reach beside pymunk and Box2D, and what does a gradient cost?

    python experiments/throughput.py [--scenes S1,S2] [--out FILE] [--core N]

One core; each case in a process of its own, so that compile time and peak memory are its own. A world-step is
one step of one world, whatever its sub-steps. The native engines (pyb2d3 is Box2D v3) step their worlds in
turn, from Python; diffrigid steps a batch in one call. pymunk computes in float64, the others in float32. The
gradient is `value_and_grad` of the sum of squared final positions with respect to all initial velocities; its
memory is that of the temporaries of the compiled program. Peaks of the process, in the JSON, hold the compiler too.

One sweep a step: a body that is struck twice in 4 ms is repaired in the next step, as the peers do.

2026-11-21, one core of an AMD EPYC (Zen 5): pymunk 1.6e6 (S1), 6.8e5 (S2); Box2D 7.0e5, 2.6e5; diffrigid 1.4e8 to
1.7e8 and 1.3e6, that is 90 to 106 and 2.0 times pymunk; gradient over forward 4 (S1) and 7 (S2).
"""

import argparse
import importlib.util
import itertools
import json
import math
import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections import defaultdict, namedtuple
from dataclasses import replace
from importlib.metadata import distributions
from pathlib import Path

DT = 1 / 240  # [s]
RUNS, MIN_SECONDS = 5, 1.0  # a median is over at least this many runs and this much time, after a warm-up
PEER_WORLDS, BATCHES = 32, (1024, 4096)  # worlds in a timed run; Box2D holds 128 at most
HEADER = "scene engine    worlds  steps/s over peer | compile s  gradient | grad/fwd temp MB | sanity"
ROW = "{rate:8.3g} {over_peer:9.3g} | {compile_s:9.2f} {grad_compile_s:9.2f} | "
ROW += "{grad_over_forward:8.2f} {grad_temp_mb:7.0f} | "

# Frictionless discs of 1 kg, N pairs x and v, between walls (normal, offset) that keep normal . x >= offset.
# SI units. check(final x, v) -> dict with "ok": did the engine do the same physics? To add a scene: a
# function of the world's number (each starts a little differently) and a line in SCENES. For a new kind of
# shape or joint: a field here, and its lines in the three `build_` functions.
Scene = namedtuple("Scene", "steps radius restitution gravity walls x v check")


def bounce(world):
    def check(x, v):  # exact: 0.553 s down, rebound at 0.7 of 5.42 m/s, 0.447 s up
        return {"height": round(x[0][1], 4), "exact": 1.217, "ok": abs(x[0][1] - 1.217) < 0.02}

    start = {"x": [(0.0, 2.0 + 0.001 * (world % 97))], "v": [(0.3, 0.0)], "walls": (((0.0, 1.0), 0.0),)}
    return Scene(steps=240, radius=0.5, restitution=0.7, gravity=9.81, check=check, **start)


def billiards(world):
    def check(x, v):  # chaotic: no exact end, but some energy is left, and nothing overlaps by 1 cm
        energy = sum(vx**2 + vy**2 for vx, vy in v) / (16 * 2.0**2)
        pairs = [0.2 - math.dist(a, b) for a, b in itertools.combinations(x, 2)]
        overlap = max(0.0, *pairs, *(abs(s - 1.0) - 0.9 for point in x for s in point))
        ok = 0.1 < energy < 0.5 and overlap < 0.01
        return {"energy_ratio": round(energy, 3), "overlap": round(overlap, 4), "ok": ok}

    angles = [2.399963 * i + 0.1 * world for i in range(16)]
    x = [(0.25 + 0.5 * (i % 4), 0.25 + 0.5 * (i // 4)) for i in range(16)]
    v = [(2 * math.cos(a), 2 * math.sin(a)) for a in angles]
    box = (((1.0, 0.0), 0.0), ((-1.0, 0.0), -2.0), ((0.0, 1.0), 0.0), ((0.0, -1.0), -2.0))
    return Scene(steps=600, radius=0.1, restitution=0.9, gravity=0.0, check=check, walls=box, x=x, v=v)


SCENES = {"S1": bounce, "S2": billiards}


def build_pymunk(scene):
    import pymunk

    space = pymunk.Space()
    space.gravity = (0.0, -scene.gravity)
    space.collision_slop = 0.005  # [m] as Box2D's; the default of 0.1 is meant for pixels
    shapes = []
    for (nx, ny), offset in scene.walls:  # a bar 20 m long and 1 m thick
        cx, cy = nx * (offset - 0.5), ny * (offset - 0.5)
        ends = (cx - 10 * ny, cy + 10 * nx), (cx + 10 * ny, cy - 10 * nx)
        shapes.append(pymunk.Segment(space.static_body, *ends, 0.5))
    bodies = [pymunk.Body(1.0, pymunk.moment_for_circle(1.0, 0.0, scene.radius)) for _ in scene.x]
    shapes += [pymunk.Circle(body, scene.radius) for body in bodies]
    for body, x, v in zip(bodies, scene.x, scene.v, strict=True):
        body.position, body.velocity = x, v
    for shape in shapes:
        shape.elasticity = math.sqrt(scene.restitution)  # pymunk multiplies those of the two shapes
    space.add(*bodies, *shapes)
    return space, bodies


def build_box2d(scene):
    import pyb2d3

    world = pyb2d3.World(gravity=(0.0, -scene.gravity), restitution_threshold=0.0)
    world.sleeping_enabled = False
    material = pyb2d3.surface_material(friction=0.0, restitution=scene.restitution)
    ground = world.create_static_body(position=(0.0, 0.0))
    for (nx, ny), offset in scene.walls:  # a bar 20 m long and 1 m thick
        center = nx * (offset - 0.5), ny * (offset - 0.5)
        bar = pyb2d3.box(hx=0.5, hy=10.0, center=center, rotation=math.atan2(ny, nx))
        ground.create_shape(pyb2d3.shape_def(material=material), bar)
    disc = pyb2d3.shape_def(density=1.0 / (math.pi * scene.radius**2), material=material)
    pairs = zip(scene.x, scene.v, strict=True)
    bodies = [world.create_dynamic_body(position=x, linear_velocity=v) for x, v in pairs]
    for body in bodies:
        body.create_shape(disc, pyb2d3.circle(radius=scene.radius))
    return world, bodies


# engine: build, arguments of `step` after dt (Box2D: its recommended 4 sub-steps), its name for the velocity
PEERS = {"pymunk": (build_pymunk, (), "velocity"), "pyb2d3": (build_box2d, (4,), "linear_velocity")}


def peer_rate(engine, scenes):
    build, arguments, velocity = PEERS[engine]

    def run(worlds):
        for world, _ in worlds:
            for _ in map(world.step, [DT] * scenes[0].steps, *map(itertools.repeat, arguments)):
                pass
        return worlds

    worlds, row = timed(run, prepare=lambda: [build(scene) for scene in scenes])
    x, v = zip(*((tuple(b.position), tuple(getattr(b, velocity))) for b in worlds[0][1]), strict=True)
    return row | {"sanity": scenes[0].check(x, v)}


def build_diffrigid(scene):
    import diffrigid as dr

    start = enumerate(zip(scene.x, scene.v, strict=True))
    discs = {f"b{i}": dr.Body(dr.Disc(radius=scene.radius), mass=1.0, x=x, v=v) for i, (x, v) in start}
    walls = {f"wall{i}": dr.Static(dr.HalfSpace(normal=n, offset=d)) for i, (n, d) in enumerate(scene.walls)}
    constants = {"gravity": (0.0, -scene.gravity), "restitution": scene.restitution, "friction": 0.0}
    return dr.scene(discs | walls, contact=dr.Contact(sweeps=1), **constants)


def diffrigid_rate(scenes):
    import jax
    import jax.numpy as jnp

    import diffrigid as dr

    world, state = build_diffrigid(scenes[0])
    x, v = (jnp.array([getattr(s, key) for s in scenes], jnp.float32) for key in "xv")
    states = replace(jax.tree.map(lambda leaf: jnp.repeat(leaf[None], len(scenes), axis=0), state), x=x)

    def roll(v, world, states):
        return dr.rollout_batch(world, replace(states, v=v), dt=DT, steps=scenes[0].steps, final_only=True)

    loss = jax.value_and_grad(lambda *args: jnp.sum(roll(*args).x ** 2))
    end, row = timed_jit(roll, v, world, states)
    jax.clear_caches()  # what was traced for the forward run must not shorten the gradient's compile time
    (_, grad), grad_row = timed_jit(loss, v, world, states)
    sanity = scenes[0].check(end.x[0].tolist(), end.v[0].tolist())
    sanity |= {"dtype": str(end.x.dtype), "grad_finite": bool(jnp.isfinite(grad).all())}
    row |= {f"grad_{key}": value for key, value in grad_row.items()}
    return row | {"grad_over_forward": row["grad_seconds"] / row["seconds"], "sanity": sanity}


def timed_jit(function, *args):
    import jax

    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    seconds = time.perf_counter() - start
    result, row = timed(lambda _: jax.block_until_ready(compiled(*args)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MB] on Linux, kB on macOS
    temporaries = compiled.memory_analysis().temp_size_in_bytes / 1e6
    return result, row | {"compile_s": seconds, "peak_rss_mb": peak, "temp_mb": temporaries}


def timed(run, prepare=lambda: None):
    """A result of run(prepare()); median time (of run alone) and the distance of the quartiles over it."""
    result, times = run(prepare()), []
    while len(times) < RUNS or sum(times) < MIN_SECONDS:
        argument = prepare()
        start = time.perf_counter()
        run(argument)
        times.append(time.perf_counter() - start)
    low, median, high = statistics.quantiles(times, n=4, method="inclusive")
    return result, {"seconds": median, "quartile_spread": (high - low) / median, "runs": len(times)}


def run_case(case):
    start = time.perf_counter()
    importlib.import_module(case["engine"])
    case["import_s"] = time.perf_counter() - start
    scenes = [SCENES[case["scene"]](world) for world in range(case["worlds"])]
    case |= peer_rate(case["engine"], scenes) if case["engine"] in PEERS else diffrigid_rate(scenes)
    return case | {"rate": len(scenes) * scenes[0].steps / case["seconds"]}


def run_in_process(case):
    """The case with its figures, from a process of its own (pinned as this one), or why there are none."""
    if importlib.util.find_spec(case["engine"]) is None:
        return case | {"error": "not installed"}
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": "0", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    env["JAX_TRACEBACK_FILTERING"] = "off"  # else an error does not come last
    command = [sys.executable, __file__, "--case", json.dumps(case)]
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    if done.returncode:
        return case | {"error": (done.stderr.splitlines() or [f"exit status {done.returncode}"])[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def measure(name):
    best, rows = 0.0, []
    for engine, worlds in [(peer, PEER_WORLDS) for peer in PEERS] + [("diffrigid", n) for n in BATCHES]:
        row = run_in_process({"scene": name, "engine": engine, "worlds": worlds})
        if engine in PEERS:
            best = max(best, row.get("rate", 0.0))
        elif best and "rate" in row:
            row["over_peer"] = row["rate"] / best
        text = ROW.format_map(defaultdict(lambda: math.nan, row)).replace("nan", "  -")
        text = row.get("error") or text + str(row["sanity"])
        print(f"{name:5} {engine:9} {worlds:6} {text}", flush=True)
        rows.append(row)
    return rows


def machine():
    cpuinfo = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    cpu = re.search(r"model name\s*: (.*)|$", cpuinfo)[1]
    packages = ("diffrigid", "jax", "jaxlib", "numpy", *PEERS)
    versions = {d.name: d.version for d in distributions() if d.name in packages}
    versions |= {"python": sys.version.split()[0], "XLA_FLAGS": os.environ.get("XLA_FLAGS", "")}
    return {"date": time.strftime("%Y-%m-%d"), "cpu": cpu, "versions": versions}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument("--core", type=int, help="core to pin to; the last one unless told")
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)  # one case, in this process
    args = parser.parse_args()
    if args.case:
        return print(json.dumps(run_case(args.case)))
    if hasattr(os, "sched_setaffinity"):  # before jax is imported: XLA's thread pool has as many threads
        args.core = max(os.sched_getaffinity(0)) if args.core is None else args.core
        os.sched_setaffinity(0, {args.core})
    print(HEADER)
    rows = [row for name in args.scenes.split(",") for row in measure(name)]
    args.out.write_text(json.dumps(machine() | {"core": args.core, "cases": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
