"""How many world-steps a second does one core reach beside pymunk and Box2D, and what does a gradient cost?

    python experiments/throughput.py [--scenes S1,S2] [--forward] [--plain] [--runs 5] [--out FILE] [--core N]

One core; each case in a process of its own, so that compile time and peak memory are its own. A world-step is
one step of one world, whatever its sub-steps. The native engines (pyb2d3 is Box2D v3) step their worlds in
turn, from Python; diffrigid steps a batch in one call, compiled for speed (`dr.compile_for_speed`) unless `--plain`.
pymunk computes in float64, the others in float32. The gradient is `value_and_grad` of the sum of squared final
positions with respect to all initial velocities; its memory is that of the temporaries of the compiled program. Peaks
of the process, in the JSON, hold the compiler too.

One sweep a step: a body that is struck twice in 4 ms is repaired in the next step, as the peers do.

2026-11-24, one core of an AMD EPYC (Zen 5): pymunk 1.0e6 (S1), 4.9e5 (S2); Box2D 5.8e5, 2.1e5; diffrigid 1.9e8 and
1.9e6, that is 190 and 3.9 times pymunk; gradient over forward 6 to 7 (S1) and 9 (S2).
"""

import argparse
import importlib.util
import json
import math
import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import replace
from importlib.metadata import distributions
from pathlib import Path

from bench_scenes import PEERS, SCENES, build_diffrigid

MIN_SECONDS = 1.0  # a median is over at least so much time, after a warm-up
PEER_WORLDS, PEER_BODIES = 32, 1024  # worlds in a timed run, but no more than so many bodies; Box2D holds 128 worlds
HEADER = "scene engine    worlds  steps/s over peer | compile s  gradient | grad/fwd temp MB | sanity"
ROW = "{rate:8.3g} {over_peer:9.3g} | {compile_s:9.2f} {grad_compile_s:9.2f} | "
ROW += "{grad_over_forward:8.2f} {grad_temp_mb:7.0f} | "


def peer_rate(scenes, case):
    build, run, read = PEERS[case["engine"]]
    ends, row = timed(
        case["runs"], lambda worlds: [run(w, scenes[0]) for w in worlds], prepare=lambda: [build(s) for s in scenes]
    )
    return row | {"sanity": scenes[0].check(*read(ends[0]))}


def diffrigid_rate(scenes, case):
    import jax
    import jax.numpy as jnp

    import diffrigid as dr

    if not case["plain"]:
        dr.compile_for_speed()
    world, state = build_diffrigid(scenes[0])
    x, v = (jnp.array([getattr(s, key) for s in scenes], jnp.float32) for key in "xv")
    states = replace(jax.tree.map(lambda leaf: jnp.repeat(leaf[None], len(scenes), axis=0), state), x=x)

    def roll(v, world, states):
        return dr.rollout_batch(world, replace(states, v=v), dt=scenes[0].dt, steps=scenes[0].steps, final_only=True)

    end, row = timed_jit(case["runs"], roll, v, world, states)
    sanity = scenes[0].check(end.x[0].tolist(), end.v[0].tolist()) | {"dtype": str(end.x.dtype)}
    if case["forward"]:
        return row | {"sanity": sanity}
    jax.clear_caches()  # what was traced for the forward run must not shorten the gradient's compile time
    loss = jax.value_and_grad(lambda *args: jnp.sum(roll(*args).x ** 2))
    (_, grad), grad_row = timed_jit(case["runs"], loss, v, world, states)
    sanity |= {"grad_finite": bool(jnp.isfinite(grad).all())}
    row |= {f"grad_{key}": value for key, value in grad_row.items()}
    return row | {"grad_over_forward": row["grad_seconds"] / row["seconds"], "sanity": sanity}


def timed_jit(runs, function, *args):
    import jax

    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    seconds = time.perf_counter() - start
    result, row = timed(runs, lambda _: jax.block_until_ready(compiled(*args)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MB] on Linux, kB on macOS
    temporaries = compiled.memory_analysis().temp_size_in_bytes / 1e6
    return result, row | {"compile_s": seconds, "peak_rss_mb": peak, "temp_mb": temporaries}


def timed(runs, run, prepare=lambda: None):
    """A result of run(prepare()); median time (of run alone) and the distance of the quartiles over it."""
    result, times = run(prepare()), []
    while len(times) < runs or sum(times) < MIN_SECONDS:
        argument = prepare()
        start = time.perf_counter()
        run(argument)
        times.append(time.perf_counter() - start)
    low, median, high = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else times * 3
    return result, {"seconds": median, "quartile_spread": (high - low) / median, "runs": len(times)}


def run_case(case):
    start = time.perf_counter()
    importlib.import_module(case["engine"])
    case["import_s"] = time.perf_counter() - start
    scenes = [SCENES[case["scene"]](world) for world in range(case["worlds"])]
    case |= (peer_rate if case["engine"] in PEERS else diffrigid_rate)(scenes, case)
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


def measure(name, **options):
    best, rows, scene = 0.0, [], SCENES[name](0)
    peer_worlds = min(PEER_WORLDS, -(-PEER_BODIES // len(scene.x)))
    for engine, worlds in [(peer, peer_worlds) for peer in scene.peers] + [("diffrigid", n) for n in scene.worlds]:
        case = {"scene": name, "engine": engine, "worlds": worlds} | options
        row = run_in_process(case)
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
    parser.add_argument("--forward", action="store_true", help="no gradients")
    parser.add_argument("--plain", action="store_true", help="without `dr.compile_for_speed`")
    parser.add_argument("--runs", type=int, default=5, help="the least in a median")
    parser.add_argument("--core", type=int, help="core to pin to; the last one unless told")
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)  # one case, in this process
    args = parser.parse_args()
    if args.case:
        return print(json.dumps(run_case(args.case)))
    if hasattr(os, "sched_setaffinity"):  # before jax is imported: XLA's thread pool has as many threads
        args.core = max(os.sched_getaffinity(0)) if args.core is None else args.core
        os.sched_setaffinity(0, {args.core})
    print(HEADER)
    options = {"runs": args.runs, "forward": args.forward, "plain": args.plain}
    rows = [row for name in args.scenes.split(",") for row in measure(name, **options)]
    args.out.write_text(json.dumps(machine() | {"core": args.core, "cases": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
