"""How many CPU-seconds does a first rollout, a first Jacobian column and a first gradient take to compile?

    python experiments/compile_time.py [--plain | --speed] [--core N]

Tracing, lowering and compiling, without the persistent cache, of 120 steps of: one disc over a floor, three discs that
collide, a cube over a floor, and a double pendulum; and microseconds a step of one world, the median of repeated
calls on one core. With the options `dr.QUICK`; `--plain`: without; `--speed`: after `dr.compile_for_speed`, without.
Each line is a process of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import time

from throughput import timed

STEPS, DT = 120, 1 / 60
RUNS = 30  # the least in a median


def scenes():
    import diffrigid as dr

    disc, rod = dr.Disc(radius=0.4), {"mass": 1.0, "inertia": 0.1}
    flat, level = dr.Static(dr.HalfSpace(normal=(0.0, 1.0))), dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
    down = {"gravity": (0.0, -9.81), "restitution": 0.8}
    three = {
        "cue": dr.Body(disc, mass=1.0, x=(0.0, 0.0), v=(2.0, 0.1)),
        "ball": dr.Body(disc, mass=2.0, x=(1.5, 0.1)),
        "last": dr.Body(disc, mass=1.0, x=(3.2, 0.35)),
    }
    arm = {"upper": dr.Body(None, x=(0.5, 0.0), **rod), "lower": dr.Body(None, x=(1.5, 0.0), **rod)}
    hinges = [dr.Revolute("upper", anchor_a=(-0.5, 0.0)), dr.Revolute("lower", "upper", anchor_a=(-0.5, 0.0))]
    cube = dr.Body(dr.Box(half=(0.5, 0.5, 0.5)), mass=1.0, x=(0.0, 0.0, 2.0))
    return {
        "disc": lambda: dr.scene({"disc": dr.Body(disc, mass=1.0, x=(0.0, 1.0)), "floor": flat}, **down),
        "three discs": lambda: dr.scene(three, restitution=0.8),
        "cube": lambda: dr.scene({"cube": cube, "floor": level}, gravity=(0.0, 0.0, -9.81), friction=0.2),
        "double pendulum": lambda: dr.scene(arm, gravity=(0.0, -9.81), joints=hinges),
    }


def measure(name, how):
    """Of each job the CPU-seconds before it runs, and the microseconds a step then takes."""
    import jax

    import diffrigid as dr

    if how == "speed":
        dr.compile_for_speed()
    options = dr.QUICK if how == "quick" else None
    world, state = scenes()[name]()

    def path(world, state):
        return dr.rollout(world, state, dt=DT, steps=STEPS).state.x

    jobs = {
        "rollout": path,
        "column": lambda *pair: jax.jvp(path, pair, pair)[1],
        "gradient": jax.grad(lambda *pair: (path(*pair) ** 2).sum()),
    }
    costs = {}
    for job, function in jobs.items():
        jax.clear_caches()
        start = time.process_time()
        compiled = jax.jit(function, compiler_options=options).lower(world, state).compile()
        seconds = time.process_time() - start
        _, row = timed(RUNS, lambda _, c=compiled: jax.block_until_ready(c(world, state)))
        costs[job] = seconds, 1e6 / STEPS * row["seconds"]
    return costs


def main():
    parser = argparse.ArgumentParser()
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--plain", dest="how", action="store_const", const="plain", help="as JAX does by itself")
    how.add_argument("--speed", dest="how", action="store_const", const="speed", help="after `dr.compile_for_speed`")
    parser.set_defaults(how="quick")
    parser.add_argument("--core", type=int, help="core to pin to; the last one unless told")
    parser.add_argument("--scene", help=argparse.SUPPRESS)  # one line, in this process
    args = parser.parse_args()
    if args.scene:
        return print(json.dumps(measure(args.scene, args.how)))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0)) if args.core is None else args.core})
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    print(f"{'CPU-seconds, us per step':24} {'rollout':>13} {'column':>13} {'gradient':>13}")
    for name in scenes():
        command = [sys.executable, __file__, "--scene", name] + [f"--{args.how}"] * (args.how != "quick")
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
        costs = json.loads(done.stdout.splitlines()[-1]).values()
        print(f"{name:24} " + " ".join(f"{compiling:6.1f} {step:6.1f}" for compiling, step in costs), flush=True)


if __name__ == "__main__":
    main()
