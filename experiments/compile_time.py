"""How many CPU-seconds does a first rollout, a first Jacobian column and a first gradient take to compile?

    python experiments/compile_time.py

Tracing, lowering and compiling, without the persistent cache, of 120 steps of: one disc over a floor, three discs that
collide, a cube over a floor, and a double pendulum. Each line is a process of its own.
"""

import json
import os
import subprocess
import sys
import time

STEPS, DT = 120, 1 / 60


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


def measure(name):
    import jax

    import diffrigid as dr

    world, state = scenes()[name]()

    def path(world, state):
        return dr.rollout(world, state, dt=DT, steps=STEPS).state.x

    jobs = {
        "rollout": path,
        "column": lambda *pair: jax.jvp(path, pair, pair)[1],
        "gradient": jax.grad(lambda *pair: (path(*pair) ** 2).sum()),
    }
    seconds = {}
    for job, function in jobs.items():
        jax.clear_caches()
        start = time.process_time()
        jax.jit(function).lower(world, state).compile()
        seconds[job] = time.process_time() - start
    return seconds


def main():
    if len(sys.argv) > 1:
        return print(json.dumps(measure(sys.argv[1])))
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    print(f"{'CPU-seconds':16} rollout  column  gradient")
    for name in scenes():
        done = subprocess.run([sys.executable, __file__, name], env=env, capture_output=True, text=True, check=True)
        seconds = json.loads(done.stdout.splitlines()[-1])
        print(f"{name:16} {seconds['rollout']:7.1f} {seconds['column']:7.1f} {seconds['gradient']:9.1f}", flush=True)


if __name__ == "__main__":
    main()
