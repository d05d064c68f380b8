"""What does a first fit look like?

    python experiments/first_fit.py

Writes a file of positions as a camera would give them, of a ball that is dropped with some speed and bounces once (2 mm
of noise, some frames missing), fits it as the README does, prints the table that is shown there, and draws
first_fit.svg: what was measured, the fitted motion, and its impact.
"""

import re
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import diffrigid as dr

jax.config.update("jax_enable_x64", True)
plt.rcParams["svg.hashsalt"] = "first fit"  # the same file from the same data

README = Path(__file__).parent.parent / "README.md"
TRUTH = 0.75  # restitution
HERTZ, FRAMES, NOISE = 60, 55, 2e-3  # [1/s], and [m]


def measured():
    """Rows t, x, y, NaN where the ball was not seen."""
    ball = dr.Body(dr.Disc(radius=0.05), mass=0.2, x=(0.0, 1.2), v=(0.4, 0.0))
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    scene = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), restitution=TRUTH)
    x = np.array(dr.rollout(*scene, dt=1 / HERTZ, steps=FRAMES - 1)["ball.x"])
    x += NOISE * np.random.default_rng(0).standard_normal(x.shape)
    x[20:23] = np.nan
    return np.column_stack([12.5 + np.arange(FRAMES) / HERTZ, x])


def main():
    rows, example = measured(), re.search(r"```python\n(.*?)```", README.read_text(), flags=re.S)[1]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drop.csv"
        lines = [",".join("" if np.isnan(number) else f"{number:.4f}" for number in row) for row in rows]
        file.write_text("\n".join(["t,ball.x[0],ball.x[1]", *lines]) + "\n")
        found = {}
        exec(example.replace("drop.csv", str(file)).replace("fit.html", str(Path(folder) / "fit.html")), found)
    fit = found["fit"]
    motion = fit.predict(times=np.linspace(rows[0, 0], rows[-1, 0], 400))
    impact = dr.contacts(motion).t[0]
    figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
    axes.plot(rows[:, 0], rows[:, 2], ".", color="0.3", label="measured")
    axes.plot(motion.t, motion["ball.x[1]"], label="fitted")
    axes.axvline(impact, color="0.6", linestyle="--", linewidth=1, label=f"impact, {impact:.3f} s")
    axes.set(xlabel="time [s]", ylabel="height of the centre [m]")
    axes.legend()
    figure.savefig(Path(__file__).with_suffix(".svg"), metadata={"Date": None})


if __name__ == "__main__":
    main()
