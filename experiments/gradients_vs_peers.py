"""Are the gradients of other differentiable simulators right where bodies strike each other?

    python experiments/gradients_vs_peers.py [--engines NAME,...] [--cases NAME,...] [--python ENGINE=PATH ...]

Their versions of shared packages conflict, so each has an environment of its own, whose Python is told by --python with
the name in front; an engine that is not there is left out, with the reason:

    brax     pip install brax==0.14.2 mujoco==4.0.0 mujoco-mjx==3.17.0 jax==0.10.1 jaxlib==0.10.1
    mjx      pip install mujoco==4.0.0 mujoco-mjx==3.17.0 jax==0.10.1 jaxlib==0.10.1
    jax2d    pip install jax2d==1.0.2 chex==0.1.92 jax==0.10.1 jaxlib==0.10.1
    newton   pip install newton==1.8.0 warp-lang==1.19.0 mujoco-warp==4.0.0

Where bodies are after one bounce of a ball on a floor, or after two or three discs (spheres in the engines of space)
struck each other once or twice, all without friction, by restitution, start, velocity and gravity, or by restitution, a
mass and a velocity. The closed form gives the derivatives, with those of the impact times in them; five starts that
differ by 0.1 %, because where in a step an impact falls matters to the peers. Columns, medians over the starts:

    off      [mm] the largest distance from the closed form
    dy/dy0   of the bounce: by the height of the start
    error    |J - exact| / |exact|, Frobenius norms; 1 is as wrong as no gradient at all
    finite   derivatives in forward and in reverse mode; refused: an error
    CPU-s    to trace and compile all derivatives in forward mode, and one gradient in reverse mode

Each peer has the settings that helped it most: Brax without drags and Baumgarte's term; MJX, which has no restitution,
a spring and the damper that rebounds alike, one iteration of its solver, without which there is no reverse mode, and
derivatives of that damper by e. Where float64 works it is used; Jax2D and Newton are in float32.

Result (2026-11-22; two cores of an AMD EPYC beside other work, so CPU-seconds are good to some tens of per cent; of two
and three discs those that are not listed were not run; exact is dy/dy0 = -0.310):

                                         off [mm]   dy/dy0     error  finite f / r   CPU-s f, r
    one bounce   diffrigid                1.7e-13   -0.310   5.3e-16  yes / yes       16.6  18.2
    one bounce   diffrigid float32        0.00013   -0.310   4.6e-07  yes / yes       15.7  19.9
    one bounce   Brax spring                  8.7    1.000   2.3e+00  yes / yes        8.2  16.3
    one bounce   Brax positional              3.6   -0.000   5.4e-01  yes / yes       27.2  47.2
    one bounce   Brax positional 1/2400      0.34   -0.000   5.4e-01  yes / yes       23.7  54.0
    one bounce   Brax generalized         3.3e+02      nan       nan  NaN / NaN       22.4  34.5
    one bounce   MJX spring 1e4                75   -1.605   2.3e+00  yes / yes       20.7  29.7
    one bounce   MJX spring 1e6               1.6  -16.415   2.8e+01  yes / yes       18.4  30.9
    one bounce   Jax2D                         12   -4.600   7.5e+00  yes / NaN       23.3  46.0
    one bounce   Newton XPBD                  4.1  -10.987   1.9e+01  - / yes         41.9, 0.6 with kernels kept
    two discs    diffrigid                2.7e-12            7.9e-16  yes / yes       23.0  25.2
    two discs    diffrigid float32         0.0024            4.0e-07  yes / yes       18.6  22.8
    two discs    Brax spring                   13            2.4e-01  yes / yes       10.6  17.3
    two discs    Brax positional               10            1.5e-01  yes / yes       30.2  54.0
    two discs    Jax2D                        7.1            1.8e-01  yes / NaN       30.2  54.6
    two discs    MJX spring 1e4                30            1.4e+00  yes / yes       19.8  37.8
    two discs    Newton XPBD                  3.2            1.6e+01  - / yes          3.3
    three discs  diffrigid                7.1e-12            1.5e-15  yes / yes       22.3  25.7
    three discs  Brax spring                   86            3.7e-01  yes / yes       13.0  18.2
    three discs  Newton XPBD                  3.4            2.8e+01  - / yes          0.9

Ten times smaller steps leave the error of Brax where it is. Newton's error is that of one way to ask it: its
restitution gets no gradient, and what a tape through its other solvers gives was not tried.
"""

import argparse
import json
import os
import subprocess
import sys
import time

import numpy as np
import peer_engines
from peer_engines import CASES, RADIUS, STARTS, start, thetas

ENGINES = {  # function, its options, steps per second
    "diffrigid": ("diffrigid", {}, 60),
    "diffrigid float32": ("diffrigid", {"x64": False}, 60),
    "Brax spring": ("brax", {"pipeline": "spring"}, 240),
    "Brax positional": ("brax", {"pipeline": "positional"}, 240),
    "Brax positional 1/2400": ("brax", {"pipeline": "positional"}, 2400),
    "Brax generalized": ("brax", {"pipeline": "generalized"}, 240),
    "MJX spring 1e4": ("mjx", {"stiffness": 1e4}, 960),
    "MJX spring 1e6": ("mjx", {"stiffness": 1e6}, 2400),
    "Jax2D": ("jax2d", {"x64": False}, 240),
    "Newton XPBD": ("newton", {"x64": False}, 240),
}


def exact(name, theta):
    """Where the bodies are in the end, (N, 2) [m]; impacts, whose order is known, at their true times."""
    import jax.numpy as jnp

    (x, v, m, e, g), (_, T) = start(name, theta), CASES[name]
    if name == "one bounce":
        height, up = x[0, 1] - RADIUS[name], v[0, 1]
        speed = jnp.sqrt(up**2 + 2.0 * g * height)
        since = T - (up + speed) / g
        return jnp.stack([0.0 * e, RADIUS[name] + e * speed * since - g * since**2 / 2])[None]
    for a, b in ((0, 1), (1, 2))[: len(m) - 1]:  # x + v t are the lines on which the bodies are
        P, W = x[a] - x[b], v[a] - v[b]
        A, B, C = W @ W, P @ W, P @ P - 4.0 * RADIUS[name] ** 2
        s = (-B - jnp.sqrt(B * B - A * C)) / A
        n = (P + W * s) / (2.0 * RADIUS[name])
        impulse = -(1.0 + e) * (n @ W) / (1.0 / m[a] + 1.0 / m[b]) * n
        v = v.at[a].add(impulse / m[a]).at[b].add(-impulse / m[b])
        x = x.at[a].add(-s * impulse / m[a]).at[b].add(s * impulse / m[b])
    return x + v * T


def of_jax(end, name):
    """Ends, Jacobians by forward mode, what reverse mode gives, and CPU-seconds to compile both."""
    import jax
    import jax.numpy as jnp

    starts = jnp.asarray(thetas(name), jnp.result_type(float))
    began = time.process_time()
    forward = jax.jit(jax.jacfwd(lambda t: 2 * (end(t),), has_aux=True)).lower(starts[0]).compile()
    seconds = [time.process_time() - began]
    jac, x = (np.asarray(part, float) for part in zip(*map(forward, starts), strict=True))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=x.shape[1:]), starts.dtype)
    began = time.process_time()
    try:
        reverse = jax.jit(jax.grad(lambda t: (weights * end(t)).sum())).lower(starts[0]).compile()
        back = np.asarray(reverse(starts[0]), float).tolist()
    except (ValueError, TypeError, NotImplementedError) as error:
        back = str(error).splitlines()[0]
    seconds.append(time.process_time() - began)
    return x, jac, back, seconds


def measure(engine, name):
    """In a process of its own: what `table` prints."""
    function, options, rate = ENGINES[engine]
    options = dict(options)
    os.environ["JAX_ENABLE_X64"] = "1" if options.pop("x64", True) else "0"
    if function == "newton":
        from peer_newton import of_newton

        x, jac, back, seconds = of_newton(name, rate, **options)
    else:
        x, jac, back, seconds = of_jax(getattr(peer_engines, function)(name, rate, **options), name)
    return {"x": x.tolist(), "jac": jac.tolist(), "reverse": back, "seconds": seconds}


def truths(name):
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    both = jax.vmap(lambda t: (exact(name, t), jax.jacfwd(lambda t: exact(name, t))(t)))(jnp.asarray(thetas(name)))
    return tuple(np.asarray(part) for part in both)


def line(engine, name, found):
    """One row of the table."""
    x, jac = truths(name)
    got, there = np.array(found["jac"], float), np.array(found["x"], float)
    off = np.linalg.norm((got - jac).reshape(STARTS, -1), axis=1) / np.linalg.norm(jac.reshape(STARTS, -1), axis=1)
    away = 1e3 * np.abs(there - x).max((1, 2))
    back = found["reverse"]
    reverse = "refused" if isinstance(back, str) else "yes" if np.isfinite(back).all() else "NaN"
    forward = "yes" if np.isfinite(got).all() else "NaN"
    finite = f"{forward if len(found['seconds']) > 1 else '-'} / {reverse}"
    slope = f"{np.median(got[:, 0, 1, 1]):8.3f}" if name == "one bounce" else " " * 8
    seconds = " ".join(f"{s:5.1f}" for s in found["seconds"])
    return f"{name:12} {engine:24} {np.median(away):9.2g} {slope} {np.median(off):9.1e}  {finite:14} {seconds}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", action="append", default=[], help="ENGINE=PATH of the Python that has it")
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        return print("RESULT " + json.dumps(measure(*chosen.one)))
    pythons = dict(pair.split("=", 1) for pair in chosen.python)
    env = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    print(f"exact: d y / d y0 of one bounce is {np.median(truths('one bounce')[1][:, 0, 1, 1]):.3f}")
    print(f"{'':37} {'off [mm]':>9} {'dy/dy0':>8} {'error':>9}  {'finite f / r':14} CPU-s f, r")
    for name in chosen.cases.split(","):
        for engine in chosen.engines.split(","):
            python = pythons.get(ENGINES[engine][0], sys.executable)
            run = subprocess.run([python, __file__, "--one", engine, name], env=env, capture_output=True, text=True)
            answers = [text for text in run.stdout.splitlines() if text.startswith("RESULT ")]
            if answers:
                print(line(engine, name, json.loads(answers[0].removeprefix("RESULT "))), flush=True)
            else:
                reason = (run.stderr.strip().splitlines() or ["no answer"])[-1]
                print(f"{name:12} {engine:24} left out: {reason[:90]}", flush=True)


if __name__ == "__main__":
    main()
