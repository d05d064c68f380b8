"""How well do six numbers predict where a dropped square ends up, in the plane?

    python experiments/square_drop.py [--data FILE] [--train 100] [--test 100]

Measured drops of a square between two plates (MIT; see the README beside the data; the file is not part of this
project). Found on the first drops, by the loss below, are friction, restitution and how it falls with the speed of the
impact, the height of the floor, and the inertia and the size as multiples of those given with the data. They are scored
open loop on others: one simulation a drop from the state three frames before its first contact; mean over the frames up
to a horizon of the distance, in per cent of the side, and of the angle between model and measurement.

Box2D, tuned on the same record: 11.7 % and 19.6 degrees up to 0.1 s, 24.2 and 41.7 to 0.2 s, 40.0 and 69.7 to 0.4 s.
"""

import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scoring import arguments, open_loop, search, show

import diffrigid as dr

DATA = Path(__file__).parents[2] / "shared" / "data" / "square_drop_2d" / "square_drop_2d_train.npz"
FRAME, HORIZONS = 1 / 250, (0.1, 0.2, 0.4)  # [s]
PEERS = np.array([(11.7, 19.6), (24.2, 41.7), (40.0, 69.7)])  # [%], [degrees]
SIDE, INERTIA, GRAVITY = 0.06, 6e-4, 9.81  # [m], [m^2] of unit mass, [m/s^2]
DRAG, SPIN_DRAG = (0.557, 0.325), 0.455  # [1/s] from the plates
RANGES = {
    "friction": (0.0, 0.3), "restitution": (0.3, 1.0), "restitution_falloff": (0.0, 20.0), "floor": (-0.001, 0.004),
    "inertia": (0.7, 1.4), "size": (0.94, 1.02),
}  # fmt: skip


def drops(path: Path, rows: slice) -> dict:
    """Start states and frames from there on; NaN after the end. Recordings with lost frames are left out."""
    data = np.load(path)
    use = np.flatnonzero((data["ic_frame"] >= 0) & ~data["glitch"])[rows]
    frames = data["ic_frame"][use, None] + np.arange(int(HORIZONS[-1] / FRAME) + 1)
    inside = frames < data["pos"].shape[1]
    frames = np.where(inside, frames, 0)
    x, angle = data["pos"][use[:, None], frames], data["theta"][use[:, None], frames]
    turn = data["ic_theta"][use]
    start = {
        "x": data["ic_pos"][use], "q": np.stack([np.cos(turn), np.sin(turn)], -1),
        "v": data["ic_vel"][use], "w": data["ic_omega"][use][:, None],
    }  # fmt: skip
    return {
        "start": dr.State(**{k: jnp.asarray(v, jnp.float32)[:, None] for k, v in start.items()}),
        "x": np.where(inside[..., None], x, np.nan), "angle": np.where(inside, angle, np.nan),
    }  # fmt: skip


def square_world(v: dict) -> dr.World:
    """The square between the plates, with the numbers by the names of RANGES."""
    inertia = v["inertia"] * INERTIA
    box = dr.Body(dr.Box(half=v["size"] * SIDE / 2 * jnp.ones(2)), mass=1.0, inertia=inertia, x=(0.0, 1.0))
    plates = dr.Drag(linear=DRAG, angular=SPIN_DRAG * inertia)
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0), offset=v["floor"]))
    material = {name: v[name] for name in ("friction", "restitution", "restitution_falloff")}
    return dr.scene({"square": box, "floor": floor}, gravity=(0.0, -GRAVITY), forces=[plates], **material)[0]


def errors(record: dict):
    """Function of arrays (P,) by the names of RANGES -> errors in % and degrees, (P, drops, horizons, 2)."""
    simulate = open_loop(square_world, record["start"], FRAME, int(HORIZONS[-1] / FRAME))

    def of(values):
        x, q = simulate(values)
        distance = np.linalg.norm(x - record["x"], axis=-1) / SIDE * 100
        off = np.unwrap(np.arctan2(q[..., 1], q[..., 0]), axis=-1) - record["angle"]
        both = np.stack([distance, np.abs(np.degrees(off - 2 * np.pi * np.round(off[..., :1] / (2 * np.pi))))], -1)
        return np.stack([np.nanmean(both[:, :, : round(h / FRAME) + 1], axis=2) for h in HORIZONS], axis=2)

    return of


def main():
    args = arguments(__doc__.splitlines()[0], DATA, test=100)
    began = time.perf_counter()
    of = errors(drops(args.data, slice(0, args.train)))
    found = search(lambda values: (of(values) / PEERS).mean((-2, -1)), RANGES)
    print(f"fit of {args.train} drops: {time.perf_counter() - began:.0f} s, compilation included")
    show(found)
    test = errors(drops(args.data, slice(args.train, args.train + args.test)))
    scores = test({name: np.array([value]) for name, (value, *_) in found.items()})[0]
    print("horizon   of the side       degrees        Box2D")
    for horizon, mean, spread, peer in zip(HORIZONS, scores.mean(0), scores.std(0), PEERS, strict=True):
        error = spread / np.sqrt(len(scores))
        print(
            f"{horizon:.1f} s   {mean[0]:6.1f} +- {error[0]:.1f} %  {mean[1]:6.1f} +- {error[1]:.1f}"
            f"  {peer[0]:6.1f} %, {peer[1]:.1f}"
        )


if __name__ == "__main__":
    main()
