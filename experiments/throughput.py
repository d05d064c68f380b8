"""How many world-steps a second does one core reach beside nine other engines, and what does a gradient cost?

    python experiments/throughput.py [--scenes S1,S2] [--forward] [--plain] [--runs 5] [--out FILE] [--core N]
        [--cpu] [--gpu] [--figure FILE] [--measured]

One core, or with --gpu one GPU, S1 to S5, and only the engines in JAX, in large batches; each case in a process of its
own, so that compile time and peak memory are its own. A world-step is one step of one world, whatever its sub-steps.
The native engines step their worlds in turn, from Python or, MuJoCo, by its rollout; diffrigid, MJX, Brax and Jax2D
step a batch in one call, compiled apart, all of them as `dr.compile_for_speed` has it unless `--plain`. Batches of the
peers grow as long as that is a gain. pymunk, Bullet and MuJoCo compute in float64, the others in float32. The gradient
is `value_and_grad` of the sum of squared final positions with respect to all initial velocities; its memory is that of
the temporaries of the compiled program. Peaks of the process, in the JSON, hold the compiler too. Figures are medians.

An engine counts as a peer of a scene where its bodies end as they should: `check` of the scene, "ok" in the line.
pymunk, Box2D and MuJoCo are in the extra `experiments`; of these, what is not installed is left out:

    pip install mujoco-mjx==3.17.0 brax==0.14.2 jax2d==1.0.2 chex==0.1.92 pybullet==3.2.7 rapier3d==0.36.1

One sweep a step: a body that is struck twice in 4 ms is repaired in the next step, as the peers do. Of Brax, the
generalized pipeline (2e3 steps a second of the cube) is left out.
"""

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import distributions
from pathlib import Path

from bench_peers import PEERS, kind, peers_of
from bench_report import HEADER, draw, line, summary
from bench_scenes import SCENES, build_diffrigid

MIN_SECONDS = 1.0  # a median is over at least so much time, after a warm-up
MAX_SECONDS = 900  # of a case
MAX_RUN = 30.0  # [s] that a larger batch may take at the rate of the one before
PEER_WORLDS, PEER_BODIES = 32, 1024  # worlds in a timed run, but no more than so many bodies; Box2D holds 128 worlds
BATCHES = (1, 64, 1024)  # of the batched peers, as long as the rate grows
GPU_BATCHES = (2**14, 2**16)
GPU_WORLDS = {"S1": 2**18, "S2": 2**16, "S3": 2**13, "S4": 2**17, "S5": 2**17}  # of diffrigid
CLOCKS = {False: time.perf_counter, True: time.process_time}
LONG = ("S3", "S4")  # their gradients take many minutes to compile
PACKAGES = {peer.package for peer in PEERS.values()} | {"diffrigid", "jax", "jaxlib", "numpy"}
VERSIONS = {d.name: d.version for d in distributions() if d.name in PACKAGES}


def native_rate(scenes, case):
    peer = PEERS[case["engine"]]
    ends, row = timed(
        case["runs"],
        lambda worlds: [peer.run(w, scenes[0]) for w in worlds],
        prepare=lambda: [peer.build(s) for s in scenes],
        clock=CLOCKS[case["cpu"]],
    )
    return row | {"sanity": scenes[0].check(*peer.read(ends[0], scenes[0]))}


def batched_rate(scenes, case):
    import jax

    import diffrigid as dr

    if not case["plain"]:
        dr.compile_for_speed()
    start, step, read = PEERS[case["engine"]].build(scenes)

    def roll(states):
        return jax.lax.scan(lambda s, _: (jax.vmap(step)(s), None), states, None, length=scenes[0].steps)[0]

    end, row = timed_jit(case, roll, start)
    return row | {"sanity": scenes[0].check(*read(jax.tree.map(lambda leaf: leaf[0], end)))}


def diffrigid_rate(scenes, case):
    import jax
    import jax.numpy as jnp
    import numpy as np

    import diffrigid as dr

    if not case["plain"]:
        dr.compile_for_speed()
    world, state = build_diffrigid(scenes[0])
    x, v = (jnp.array(np.array([getattr(s, key) for s in scenes], np.float32)) for key in "xv")
    states = replace(jax.tree.map(lambda leaf: jnp.repeat(leaf[None], len(scenes), axis=0), state), x=x)

    def roll(v, world, states):
        return dr.rollout_batch(world, replace(states, v=v), dt=scenes[0].dt, steps=scenes[0].steps, final_only=True)

    end, row = timed_jit(case, roll, v, world, states)
    sanity = scenes[0].check(end.x[0].tolist(), end.v[0].tolist()) | {"dtype": str(end.x.dtype)}
    if case["forward"]:
        return row | {"sanity": sanity}
    jax.clear_caches()  # what was traced for the forward run must not shorten the gradient's compile time
    loss = jax.value_and_grad(lambda *args: jnp.sum(roll(*args).x ** 2))
    (_, grad), grad_row = timed_jit(case, loss, v, world, states)
    sanity |= {"grad_finite": bool(jnp.isfinite(grad).all())}
    row |= {f"grad_{key}": value for key, value in grad_row.items()}
    return row | {"grad_over_forward": row["grad_seconds"] / row["seconds"], "sanity": sanity}


def timed_jit(case, function, *args):
    import jax

    clock = CLOCKS[case["cpu"]]
    start = clock()
    compiled = jax.jit(function).lower(*args).compile()
    seconds = clock() - start
    result, row = timed(case["runs"], lambda _: jax.block_until_ready(compiled(*args)), clock=clock)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # [MB] on Linux, kB on macOS
    temporaries = compiled.memory_analysis().temp_size_in_bytes / 1e6
    return result, row | {"compile_s": seconds, "peak_rss_mb": peak, "temp_mb": temporaries}


def timed(runs, run, prepare=lambda: None, clock=time.perf_counter):
    """A result of run(prepare()); median time (of run alone) and the distance of the quartiles over it."""
    result, times = run(prepare()), []
    while len(times) < runs or sum(times) < MIN_SECONDS:
        argument = prepare()
        start = clock()
        run(argument)
        times.append(clock() - start)
    low, median, high = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else times * 3
    return result, {"seconds": median, "quartile_spread": (high - low) / median, "runs": len(times)}


def run_case(case):
    scenes = [SCENES[case["scene"]](world) for world in range(case["worlds"])]
    rates = {"native": native_rate, "batched": batched_rate, "diffrigid": diffrigid_rate}
    case |= rates[kind(case["engine"])](scenes, case)
    return case | {"rate": len(scenes) * scenes[0].steps / case["seconds"]}


def run_in_process(case):
    """The case with its figures, from a process of its own (pinned as this one), or why there are none."""
    if case["engine"] in PEERS and PEERS[case["engine"]].package not in VERSIONS:
        return case | {"error": "not installed"}
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": "0", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    if case["gpu"]:
        env["JAX_PLATFORMS"] = "cuda,cpu"
    env["JAX_TRACEBACK_FILTERING"] = "off"  # else an error does not come last
    command = [sys.executable, __file__, "--case", json.dumps(case)]
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=MAX_SECONDS)
    except subprocess.TimeoutExpired:
        return case | {"error": f"over {MAX_SECONDS} s"}
    if done.returncode:
        return case | {"error": (done.stderr.splitlines() or [f"exit status {done.returncode}"])[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def measure(name, **options):
    scene, rows, best = SCENES[name](0), [], {}  # rates of the best native and the best batched peer
    few = min(PEER_WORLDS, -(-PEER_BODIES // len(scene.x)))
    batches = {"native": (few,), "batched": BATCHES, "diffrigid": scene.worlds}
    if options["gpu"]:
        batches = {"native": (), "batched": GPU_BATCHES, "diffrigid": (GPU_WORLDS[name],)}
    for engine in [*peers_of(scene), "diffrigid"]:
        of, last = kind(engine), 0.0
        for worlds in batches[of]:
            if of == "batched" and last and scene.steps * worlds / last > MAX_RUN:
                break
            row = run_in_process({"scene": name, "engine": engine, "worlds": worlds} | options)
            rate = row.get("rate", 0.0)
            if engine == "diffrigid":
                row |= {f"over_{peer}": rate / best[peer] for peer in best if rate}
            elif rate and row["sanity"]["ok"]:
                best[of] = max(best.get(of, 0.0), rate)
            print(line(row), flush=True)
            rows.append(row)
            if of == "batched" and rate <= last:
                break
            last = rate
    return rows


def machine():
    cpuinfo = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    cpu = re.search(r"model name\s*: (.*)|$", cpuinfo)[1]
    versions = VERSIONS | {"python": sys.version.split()[0], "XLA_FLAGS": os.environ.get("XLA_FLAGS", "")}
    return {"date": time.strftime("%Y-%m-%d"), "cpu": cpu, "versions": versions}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument("--forward", action="store_true", help="no gradients")
    parser.add_argument("--plain", action="store_true", help="without `dr.compile_for_speed`")
    parser.add_argument("--cpu", action="store_true", help="CPU time, where other work shares the core")
    parser.add_argument("--gpu", action="store_true", help="on the GPU")
    parser.add_argument("--runs", type=int, default=5, help="the least in a median")
    parser.add_argument("--core", type=int, help="core to pin to; the last one unless told")
    parser.add_argument("--figure", type=Path, help="draw the rates to this file")
    parser.add_argument("--measured", action="store_true", help="table and figure of what OUT holds, nothing measured")
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)  # one case, in this process
    args = parser.parse_args()
    if args.case:
        return print(json.dumps(run_case(args.case)))
    if args.gpu:
        args.plain, args.scenes = True, ",".join(name for name in args.scenes.split(",") if name in GPU_WORLDS)
    elif hasattr(os, "sched_setaffinity"):  # before jax is imported: XLA's thread pool has as many threads
        args.core = max(os.sched_getaffinity(0)) if args.core is None else args.core
        os.sched_setaffinity(0, {args.core})
    print(HEADER)
    if args.measured:
        rows = json.loads(args.out.read_text())["cases"]
        print(*map(line, rows), sep="\n")
        return report(rows, args.figure)
    rows = []
    for name in args.scenes.split(","):
        forward = args.forward or name in LONG
        rows += measure(name, forward=forward, plain=args.plain, runs=args.runs, cpu=args.cpu, gpu=args.gpu)
        args.out.write_text(
            json.dumps(machine() | {"core": args.core, "cpu_time": args.cpu, "cases": rows}, indent=1) + "\n"
        )
    report(rows, args.figure)


def report(rows, figure):
    print(summary(rows))
    if figure:
        draw(rows, figure)


if __name__ == "__main__":
    main()
