"""Which tool finds restitution, a mass and a velocity from noisy positions of three colliding discs, and at what cost?

    python experiments/sysid_vs_peers.py [--runs 40] [--cases "NAME;..."] [--out FILE]

Free: restitution, the mass of the middle disc, v of the first; given: positions of all at 60 Hz over 2 s, in closed
form, with normal noise of 3 mm. Each record, with noise of its own, is fitted from one random start of its own.
Success: all four errors below NEAR. In interval: how many of the 95 % intervals of the successes hold the truth. CPU
seconds, all threads: from the start of a process, imports and compiling included, to the best of eight starts on one
record; and for one fit more from one start. Each case in a process of its own.

The peers minimise the same residuals: MuJoCo with its own toolbox (`mujoco.sysid`), pymunk and Box2D with
`scipy.optimize.least_squares`. What helped them most was found by trial: differences of 1 % on both sides of a number
instead of 1.5e-8, so that the jumps which a fixed step makes where an impact crosses it average out; numbers scaled by
the Jacobian; 64 steps a frame (pymunk and Box2D are then 0.6 and 0.3 mm from the closed form at worst, with 16 steps
1.9 and 1.0). MuJoCo has no restitution: a spring of 1e6 / s^2 and the damper that rebounds alike take its place, at 128
steps a frame; softer springs bias it (1e5: restitution by 0.007). Its own differences are on one side only.
"As it comes" leaves the optimiser as it is.

Result (2026-11-28, 40 records; mujoco 4.0.0, pymunk 7.3.1, pyb2d3 0.11.1, scipy 1.17.1, jaxlib 0.10.1; one core of a
slow Xeon beside other work, the cases in two runs, so CPU-seconds are good to some tens of per cent):

                                     success  in interval  error e, mass     CPU-s: answer, one fit more
    diffrigid                          100 %        95 %    0.0005  0.0008      10.1     0.17
    diffrigid, smooth impacts first    100 %        96 %    0.0005  0.0008      13.5     0.65
    mujoco.sysid, as it comes            0 %          -                         71.4     8.23
    mujoco.sysid, large differences     45 %        43 %    0.0014  0.0032      92.7    12.10
    pymunk, as SciPy comes              60 %        29 %    0.0023  0.0046       3.0     0.28
    pymunk, large differences           98 %        95 %    0.0006  0.0009      17.3     2.01
    Box2D v3, as SciPy comes             0 %          -                          1.8     0.13
    Box2D v3, large differences         98 %        95 %    0.0005  0.0010      14.8     2.12

So on this small job pymunk and Box2D find nearly the same once their differences are large, most of the time of
diffrigid being compiling; it needs no step of differences and is ten times faster from then on. Box2D computes in
float32, in which a difference of 1.5e-8 is none. MuJoCo's step is 0.01 or 1 % of a number, the larger: 10 % of v_y.
With v_y in units of 0.1 m/s 3 of the first 6 records are found instead of 2, and with SciPy and the settings of
pymunk on its rollouts 1 of the first 4; starts that fail end at a bound of the restitution or far from it. There may
be better ones.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from importlib.metadata import distributions
from pathlib import Path

import numpy as np
from peer_discs import FITS, NOISE, exact

TRUTH = np.array([0.8, 2.0, 2.0, 0.1])  # restitution, mass [kg], v [m/s]
NEAR = np.array([0.01, 0.02, 0.02, 0.002])  # an error below this is a success: 1 % (v_y 2 %), seven half widths
GUESS, SPREAD, SEVERAL = (1.5, 0.0), 0.5, 8  # [m/s] velocity about which starts lie; starts of one answer
LARGE = {"diff_step": 1e-2, "jac": "3-point", "x_scale": "jac"}
CASES = {
    "diffrigid": ("diffrigid", {}),
    "diffrigid, smooth impacts first": ("diffrigid", {"widths": (0.5, 0.1, 0.0)}),
    "mujoco.sysid, as it comes": ("mujoco", {"steps": 128, "stiffness": 1e6}),
    "mujoco.sysid, large differences": ("mujoco", {"steps": 128, "stiffness": 1e6, "eps": 1e-2, "x_scale": "jac"}),
    "pymunk, as SciPy comes": ("pymunk", {"steps": 16}),
    "pymunk, large differences": ("pymunk", {"steps": 64} | LARGE),
    "Box2D v3, as SciPy comes": ("pyb2d3", {"steps": 16}),
    "Box2D v3, large differences": ("pyb2d3", {"steps": 64} | LARGE),
}
HEADER = f"{'':32} success  in interval  error e, mass      CPU-s: answer, one fit more"


def record(seed):
    """Positions in closed form, with normal noise."""
    x = exact(TRUTH)
    return x + NOISE * np.random.default_rng(seed).standard_normal(x.shape)


def start(seed):
    """Restitution uniform, mass a factor exp(N / 2) from 1, velocity about the guess."""
    random = np.random.default_rng(1000 + seed)
    return [random.uniform(), np.exp(0.5 * random.standard_normal()), *(GUESS + SPREAD * random.standard_normal(2))]


def run_case(engine, settings, runs):
    """One answer from several starts, timed from the start of the process; then a fit of each record from one start."""
    fit = FITS[engine]
    if engine == "diffrigid":  # its starts are one batch, and its own draw
        answer, _ = fit(record(0), (0.5, 1.0, *GUESS), starts=SEVERAL, **settings)
    else:
        answer, _ = min((fit(record(0), start(k), **settings) for k in range(SEVERAL)), key=lambda found: found[1])
    cpu = time.process_time()
    if engine == "diffrigid":
        fit(record(0), start(0), **settings)  # compiles for one start
    began = time.process_time()
    found = np.stack([fit(record(k), start(k), **settings)[0] for k in range(runs)])
    each = (time.process_time() - began) / runs
    error, inside = found[:, 0] - TRUTH, (found[:, 1] <= TRUTH) & (TRUTH <= found[:, 2])
    near = (np.abs(error) < NEAR).all(1)
    return {
        "answer": answer[0].tolist(), "answer_cpu_s": cpu, "fit_cpu_s": each, "success": float(near.mean()),
        "coverage": float(inside[near].mean()) if near.any() else None,
        "error": np.median(np.abs(error[near]), axis=0).tolist() if near.any() else None,
        "values": found.tolist(), "runs": runs,
    }  # fmt: skip


def measure(name, runs):
    """A case in a process of its own, or why it did not run."""
    engine, settings = CASES[name]
    case = {"name": name, "engine": engine, "settings": settings}
    if importlib.util.find_spec(engine) is None:
        return case | {"error": "not installed"}
    command = [sys.executable, __file__, "--case", json.dumps([engine, settings, runs])]
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    if done.returncode:
        return case | {"error": (done.stderr.splitlines() or [f"exit status {done.returncode}"])[-1]}
    return case | json.loads(done.stdout.splitlines()[-1])


def line(row):
    if "error" in row and "success" not in row:
        return f"{row['name']:32} {row['error']}"
    text = f"{row['name']:32} {100 * row['success']:5.0f} %"
    cpu = f"{row['answer_cpu_s']:8.1f} {row['fit_cpu_s']:8.2f}"
    if row["coverage"] is None:
        return f"{text} {'-':>10} {'-':>18}   {cpu}"
    return f"{text} {100 * row['coverage']:9.0f} % {row['error'][0]:10.5f} {row['error'][1]:8.5f}   {cpu}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--cases", default=";".join(CASES), help="names, separated by semicolons")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)  # one case, in this process
    args = parser.parse_args()
    if args.case:
        return print(json.dumps(run_case(*args.case)))
    print(HEADER)
    rows = []
    for name in args.cases.split(";"):
        rows.append(measure(name, args.runs))
        print(line(rows[-1]), flush=True)
    packages = ("diffrigid", "jax", "jaxlib", "numpy", "scipy", "mujoco", "pymunk", "pyb2d3")
    versions = {d.name: d.version for d in distributions() if d.name in packages}
    args.out.write_text(json.dumps({"date": time.strftime("%Y-%m-%d"), "versions": versions, "cases": rows}, indent=1))


if __name__ == "__main__":
    main()
