"""Scenes that `throughput.py` runs, and how diffrigid builds them; `bench_peers.py` has the other engines.

SI units. `check(x, v)` of the final positions and velocities -> dict with "ok": did the engine do the same physics? To
add a scene: a function of the world's number (each starts a little differently) and a line in SCENES. `worlds` are the
batches that diffrigid is measured with.
"""

import itertools
import math
from collections import defaultdict, namedtuple

# Bodies of one shape, (radius,) of discs or the half sizes of boxes, N pairs or triples x, v and w, between walls
# (normal, offset) that keep normal . x >= offset. chain: each is joined to the one before, the first to the origin.
FIELDS = "worlds dt steps size mass friction restitution gravity walls x v w chain check"
Scene = namedtuple("Scene", FIELDS, defaults=[None] * len(FIELDS.split()))
FLOOR = (((0.0, 1.0), 0.0),)


def bounce(world):
    def check(x, v):  # exact: 0.553 s down, rebound at 0.7 of 5.42 m/s, 0.447 s up
        return {"height": round(x[0][1], 4), "exact": 1.217, "ok": abs(x[0][1] - 1.217) < 0.02}

    return Scene(
        worlds=(1024, 4096),
        dt=1 / 240,
        steps=240,
        size=(0.5,),
        mass=1.0,
        friction=0.0,
        restitution=0.7,
        gravity=9.81,
        walls=FLOOR,
        x=[(0.0, 2.0 + 0.001 * (world % 97))],
        v=[(0.3, 0.0)],
        check=check,
    )


def billiards(world):
    def check(x, v):  # chaotic: no exact end, but some energy is left, and nothing overlaps by 1 cm
        energy = sum(vx**2 + vy**2 for vx, vy in v) / (16 * 2.0**2)
        pairs = [0.2 - math.dist(a, b) for a, b in itertools.combinations(x, 2)]
        overlap = max(0.0, *pairs, *(abs(s - 1.0) - 0.9 for point in x for s in point))
        ok = 0.1 < energy < 0.5 and overlap < 0.01
        return {"energy_ratio": round(energy, 3), "overlap": round(overlap, 4), "ok": ok}

    angles = [2.399963 * i + 0.1 * world for i in range(16)]
    return Scene(
        worlds=(1024, 4096),
        dt=1 / 240,
        steps=600,
        size=(0.1,),
        mass=1.0,
        friction=0.0,
        restitution=0.9,
        gravity=0.0,
        walls=(((1.0, 0.0), 0.0), ((-1.0, 0.0), -2.0), ((0.0, 1.0), 0.0), ((0.0, -1.0), -2.0)),
        x=[(0.25 + 0.5 * (i % 4), 0.25 + 0.5 * (i // 4)) for i in range(16)],
        v=[(2 * math.cos(a), 2 * math.sin(a)) for a in angles],
        check=check,
    )


def boxes(world):
    def check(x, v):  # a pile at rest, straight up or toppled
        heights, speed = [y for _, y in x], max(abs(s) for body in v for s in body)
        ok = min(heights) > 0.24 and max(heights) < 4.76 and speed < 0.1
        return {"top": round(max(heights), 3), "lowest": round(min(heights), 4), "speed": round(speed, 4), "ok": ok}

    return Scene(
        worlds=(64,),
        dt=1 / 240,
        steps=600,
        size=(0.25, 0.25),
        mass=1.0,
        friction=0.5,
        restitution=0.0,
        gravity=9.81,
        walls=FLOOR,
        x=[(0.1 * (i % 3 - 1) + 0.0005 * (world % 97), 0.25 + 0.6 * i) for i in range(10)],
        v=[(0.0, 0.0)] * 10,
        check=check,
    )


def cube_toss(world):
    def check(x, v):  # flat on the floor
        speed = max(map(abs, v[0]))
        return {"height": round(x[0][2], 4), "speed": round(speed, 4), "ok": abs(x[0][2] - 0.05) < 1e-3}

    return Scene(
        worlds=(512,),
        dt=1 / 148,
        steps=200,
        size=(0.05,) * 3,
        mass=0.37,
        friction=0.18,
        restitution=0.125,
        gravity=9.81,
        walls=(((0.0, 0.0, 1.0), 0.0),),
        x=[(0.0, 0.0, 0.3)],
        v=[(1.0 + 0.01 * (world % 97), 0.5, 0.0)],
        w=[(5.0, 3.0, 2.0)],
        check=check,
    )


def pendulum(world):
    del world  # all alike

    def check(x, v):  # without the energy of rotation; they fall by 61 J. Exact: MuJoCo's RK4, a sixteenth of the step
        energy = sum(9.81 * body[1] for body in x) + 0.5 * sum(s**2 for body in v for s in body)
        ok = math.dist(x[-1], (1.233, -1.074)) < 0.6 and abs(energy + 0.681) < 15
        return {"last": [round(s, 3) for s in x[-1]], "energy": round(energy, 3), "ok": ok}

    return Scene(
        worlds=(256,),
        dt=1 / 240,
        steps=600,
        size=(0.25, 0.025),
        mass=1.0,
        friction=0.0,
        restitution=0.0,
        gravity=9.81,
        walls=(),
        x=[(0.5 * (i + 0.5), 0.0) for i in range(5)],
        v=[(0.0, 0.0)] * 5,
        chain=True,
        check=check,
    )


def gas(count):
    """As many discs, square, between walls in the same proportion: S6 of 64, 256, 1024 and 4096."""
    across = math.isqrt(count)
    side = 0.5 * across

    def scene(world):
        def check(x, v):  # no overlap by 3 cm, of those in one cell or in two that touch; energy only falls
            cells = defaultdict(list)
            for point in x:
                cells[int(point[0] / 0.25), int(point[1] / 0.25)].append(point)
            near = (
                (a, b)
                for (i, j), here in cells.items()
                for di, dj in itertools.product((-1, 0, 1), repeat=2)
                for a, b in itertools.product(here, cells.get((i + di, j + dj), ()))
                if a != b
            )
            overlap = max(0.0, *(0.2 - math.dist(a, b) for a, b in near))
            out = max(0.0, *(abs(s - side / 2) - side / 2 + 0.1 for point in x for s in point))
            energy = sum(vx**2 + vy**2 for vx, vy in v) / (count * 2.0**2)
            ok = max(overlap, out) < 0.03 and 0.3 < energy < 1.0
            return {"energy_ratio": round(energy, 3), "overlap": round(overlap, 4), "out": round(out, 4), "ok": ok}

        angles = [2.399963 * i + 0.1 * world for i in range(count)]
        return Scene(
            worlds=(1,),
            dt=1 / 240,
            steps=240,
            size=(0.1,),
            mass=1.0,
            friction=0.0,
            restitution=0.9,
            gravity=0.0,
            walls=(((1.0, 0.0), 0.0), ((-1.0, 0.0), -side), ((0.0, 1.0), 0.0), ((0.0, -1.0), -side)),
            x=[(0.25 + 0.5 * (i % across), 0.25 + 0.5 * (i // across)) for i in range(count)],
            v=[(2 * math.cos(a), 2 * math.sin(a)) for a in angles],
            check=check,
        )

    return scene


SCENES = {"S1": bounce, "S2": billiards, "S3": boxes, "S4": cube_toss, "S5": pendulum}
SCENES |= {f"S6_{count}": gas(count) for count in (64, 256, 1024, 4096)}


def build_diffrigid(scene):
    import diffrigid as dr

    shape = dr.Disc(radius=scene.size[0]) if len(scene.size) == 1 else dr.Box(half=scene.size)
    start = enumerate(zip(scene.x, scene.v, scene.w or [None] * len(scene.x), strict=True))
    bodies = {f"b{i}": dr.Body(shape, mass=scene.mass, x=x, v=v, w=w) for i, (x, v, w) in start}
    walls = {f"wall{i}": dr.Static(dr.HalfSpace(normal=n, offset=d)) for i, (n, d) in enumerate(scene.walls)}
    names, half = list(bodies), scene.size[0]
    joints = [dr.Revolute(b, a, anchor_a=(-half, 0.0)) for a, b in zip([None, *names], names, strict=False)]
    return dr.scene(
        bodies | walls,
        contact=dr.Contact(sweeps=1),
        gravity=(0.0,) * (len(scene.x[0]) - 1) + (-scene.gravity,) if scene.gravity else None,
        restitution=scene.restitution,
        friction=scene.friction,
        joints=joints if scene.chain else (),
        ignore=list(itertools.combinations(names, 2)) if scene.chain else (),
    )
