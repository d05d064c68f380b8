"""How much faster are two devices than one, and two processes than one? And what does the cache of compilations save?

    python experiments/scaling.py [--cores N]

Scene S2 of `throughput.py` (sixteen discs in a box), 2048 worlds, 60 steps, single precision, by one call of
`rollout_batch` that is the same in all cases: on 1 device, on N devices of one process, on N processes of one device
each (pinned to a core each, as launchers do); forward and gradient, median of five after a warm-up.

2026-11-27, two of 16 cores of an Intel Xeon, jax 0.11.2, world-steps/s: one device 9.0e5 forward, two devices 1.66e6
(1.85 times as many), two processes 1.67e6 (1.87 times); gradients 1.3e5, 2.8e5 and 4.4e5, more than twice as many, for
no reason that is known: on a Zen 5 a gradient of 1024 worlds is as fast by world as one of 2048. The cache (Zen 5): 29
CPU-seconds to the first result, then 7.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time

WORLDS, STEPS, RUNS = 2048, 60, 5


def measure(devices, address, count, rank):
    """World-steps per second, forward and with the gradient, and seconds from the import of jax to the first result."""
    start = time.perf_counter()
    import jax
    import jax.numpy as jnp
    from bench_scenes import SCENES, build_diffrigid

    import diffrigid as dr

    jax.config.update("jax_num_cpu_devices", devices)
    if count > 1:
        jax.distributed.initialize(address, count, rank)
    scene = SCENES["S2"](0)
    world, state = build_diffrigid(scene)
    angles = jnp.linspace(0.0, 6.0, WORLDS)[:, None] + 2.399963 * jnp.arange(16.0)
    v = 2.0 * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)

    @jax.jit
    def squares(v):
        end = dr.rollout_batch(world, dr.replace(state, v=v), dt=scene.dt, steps=STEPS, final_only=True)
        return (end.x**2).sum()

    result = {"devices": jax.device_count()}
    for name, function in (("forward", squares), ("gradient", jax.jit(jax.grad(squares)))):
        jax.block_until_ready(function(v))
        result.setdefault("first_s", time.perf_counter() - start)
        times = []
        for _ in range(RUNS):
            begin = time.perf_counter()
            jax.block_until_ready(function(v))
            times.append(time.perf_counter() - begin)
        result[name] = WORLDS * STEPS / statistics.median(times)
    return result


def run(devices, processes, cache=None):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": "0", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    env |= {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_ENABLE_COMPILATION_CACHE": "1"} if cache else {}
    cores, started = sorted(os.sched_getaffinity(0)), []
    for rank in range(processes):
        case = json.dumps([devices, address, processes, rank])
        pinned = ["taskset", "-c", str(cores[rank])] if devices == 1 else []
        command = [*pinned, sys.executable, __file__, "--case", case]
        started.append(subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True))
    return [json.loads(process.communicate()[0].splitlines()[-1]) for process in started][0]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cores", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)  # one process of a case
    args = parser.parse_args()
    if args.case:
        return print(json.dumps(measure(*args.case)))
    print("devices processes | forward over one | gradient over one  [world-steps/s]")
    one = None
    for devices, processes in ((1, 1), (args.cores, 1), (1, args.cores)):
        row = run(devices, processes)
        one = one or row
        ratios = "  | ".join(f"{row[key]:8.3g} {row[key] / one[key]:6.2f}" for key in ("forward", "gradient"))
        print(f"{devices:7} {processes:9} | {ratios}", flush=True)
    with tempfile.TemporaryDirectory() as cache:
        for name in ("first", "second"):
            print(f"cache of compilations, {name} process: {run(1, 1, cache)['first_s']:.1f} s to the first result")


if __name__ == "__main__":
    main()
