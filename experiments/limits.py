"""How inexact are the cases that notebooks/limits.md names?

    python experiments/limits.py [--case NAME ...]

Each case prints the figures of one sentence there: how far a motion, or a derivative, at steps of 1/60 and 1/240 s is
from the same at steps of 1/3840 s, or how much energy it gains or loses. Double precision; some minutes for all, most
of them compiling.
"""

import argparse

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import diffrigid as dr  # noqa: E402

STEPS = (1 / 60, 1 / 240)  # [s]
FINE = 1 / 3840  # [s]
G = 9.81
DOWN = {"gravity": (0.0, -G)}
FLOOR = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))


def end(pair, dt, seconds):
    return jax.tree.map(lambda leaf: leaf[-1], dr.rollout(*pair, dt=dt, steps=round(seconds / dt)).state)


def off(pair, seconds, what):
    """How far `what` of the last state is from that at fine steps, for each of STEPS."""
    right = what(end(pair, FINE, seconds))
    return [float(np.abs(what(end(pair, dt, seconds)) - right).max()) for dt in STEPS]


def energy(world, state):
    """Kinetic and potential energy [J] of one state."""
    lift = (world.bodies.mass * state.x[:, -1]).sum() * G
    return float(dr.kinetic_energy(world.bodies, state).sum() + lift)


def rod():
    """A rod of 1 m that falls over from 0.1 rad on a floor without friction, 0.5 s: part of its energy lost."""
    body = dr.Body(dr.Box(half=(0.5, 0.0)), mass=1.0, x=(0.0, 0.5 * np.cos(0.1)), angle=np.pi / 2 - 0.1)
    pair = dr.scene({"rod": body, "floor": FLOOR}, **DOWN)
    return [1.0 - energy(pair[0], end(pair, dt, 0.5)) / energy(*pair) for dt in STEPS], "of the energy"


def dome():
    """A disc that slides down a round dome without friction for half a second: its angle about the centre."""
    at = 1.1 * np.array([np.sin(0.3), np.cos(0.3)])
    disc = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=at)
    pair = dr.scene({"disc": disc, "dome": dr.Static(dr.Disc(radius=1.0))}, **DOWN)
    return off(pair, 0.5, lambda state: np.arctan2(state.x[0, 0], state.x[0, 1])), "rad"


def across():
    """A ball that rolls across a slope of 0.2 rad against rolling friction: its velocity after 0.8 s."""
    slope = dr.Static(dr.HalfSpace(normal=(np.sin(0.2), 0.0, np.cos(0.2))))
    start = 0.1 * np.array([np.sin(0.2), 0.0, np.cos(0.2)])
    ball = dr.Body(
        dr.Sphere(radius=0.1), mass=1.0, x=start, v=(0.0, 1.0, 0.0), w=(-10.0 * np.cos(0.2), 0.0, 10.0 * np.sin(0.2))
    )
    pair = dr.scene({"ball": ball, "slope": slope}, gravity=(0.0, 0.0, -G), friction=0.5, rolling_friction=0.01)
    return off(pair, 0.8, lambda state: state.v), "m/s"


def rider():
    """A heavy block on a light one that slides on the floor, until its slip stops: where the light one is.

    100, 1000 and 10,000 times as heavy; at 1/60 s.
    """
    found = []
    for mass in (1e2, 1e3, 1e4):
        light = dr.Body(dr.Box(half=(0.5, 0.1)), mass=1.0, x=(0.0, 0.1), friction=0.3)
        heavy = dr.Body(dr.Box(half=(0.1, 0.1)), mass=mass, x=(0.0, 0.3), v=(1.0, 0.0), friction=0.3)
        pair = dr.scene({"light": light, "heavy": heavy, "floor": dr.replace(FLOOR, friction=0.1)}, **DOWN)
        found.append(off(pair, 0.5, lambda state: state.x[0])[0])
    return found, "m"


def arms():
    """Two bodies of 10 cm on arms of 10 m and 1 m that a hinge joins, at 4 rad/s for a second: energy changed."""
    small = {"mass": 1.0, "inertia": 0.5 * 0.1**2}
    one = dr.Body(None, x=(-10.0, 0.0), v=(0.0, -40.0), w=4.0, **small)
    two = dr.Body(None, x=(1.0, 0.0), **small)
    pair = dr.scene({"one": one, "two": two}, joints=[dr.Revolute("one", "two", anchor_a=(10.0, 0.0))])
    before = float(dr.kinetic_energy(pair[0].bodies, pair[1]).sum())
    after = [float(dr.kinetic_energy(pair[0].bodies, end(pair, dt, 1.0)).sum()) for dt in STEPS]
    return [abs(e / before - 1.0) for e in after], "of the energy"


def hold():
    """A box on an arm that the friction of a hinge holds: how fast it sinks."""
    arm = dr.Body(dr.Box(half=(0.5, 0.02)), mass=1.0, x=(0.5, 1.0), friction=0.5)
    box = dr.Body(dr.Box(half=(0.05, 0.05)), mass=1.0, x=(0.9, 1.07), friction=0.5)
    joint = dr.Revolute("arm", anchor_a=(-0.5, 0.0), friction=100.0)
    pair = dr.scene({"arm": arm, "box": box}, joints=[joint], **DOWN)
    return [float(pair[1].x[1, 1] - end(pair, dt, 2.0).x[1, 1]) / 2.0 for dt in STEPS], "m/s"


def wheel():
    """A hexagon that rolls down a slope over its corners, without slip or rebound, 0.9 s: a derivative.

    Of its angular velocity after three impacts, with respect to that at the start.
    """
    corners = 0.2 * np.stack([f(np.pi / 3 * np.arange(6) + 2 * np.pi / 3) for f in (np.cos, np.sin)], axis=1)
    normal, down = np.array([np.sin(0.25), np.cos(0.25)]), np.array([np.cos(0.25), -np.sin(0.25)])
    centre = 0.2 * np.cos(np.pi / 6) * normal
    x, y = centre - 0.1 * down  # from the corner that it begins to turn about
    wheel = dr.Body(dr.Polygon(vertices=corners), mass=1.0, x=centre, v=(4.0 * y, -4.0 * x), w=-4.0, angle=-0.25)
    pair = dr.scene({"wheel": wheel, "slope": dr.Static(dr.HalfSpace(normal=normal))}, friction=2.0, **DOWN)

    def slope(dt):
        def last(factor):
            start = dr.replace(pair[1], v=factor * pair[1].v, w=factor * pair[1].w)
            return dr.rollout(pair[0], start, dt=dt, steps=round(0.9 / dt)).state.w[-1, 0, 0] / -4.0

        return float(jax.jit(lambda: jax.jvp(last, (1.0,), (1.0,))[1], compiler_options=dr.QUICK)())

    right = slope(FINE)
    return [abs(slope(dt) - right) for dt in STEPS], f"of {right:.2g}"


def domino():
    """A domino that topples from 0.1 rad and slips back and forth (friction 0.3), 0.45 s: its angle."""
    b, h, tilt = 0.05, 0.3, 0.1
    x = np.array([b * np.cos(tilt) - h * np.sin(tilt), b * np.sin(tilt) + h * np.cos(tilt)])
    body = dr.Body(dr.Box(half=(b, h)), mass=1.0, x=x, angle=tilt, w=1.0, v=(-x[1], x[0]))
    pair = dr.scene({"domino": body, "floor": FLOOR}, friction=0.3, **DOWN)
    return off(pair, 0.45, lambda state: np.arctan2(state.q[0, 1], state.q[0, 0])), "rad"


CASES = {case.__name__: case for case in (rod, dome, across, rider, arms, hold, wheel, domino)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    for name in parser.parse_args().case:
        values, unit = CASES[name]()
        print(
            f"{name:8} {'  '.join(f'{value:.2g}' for value in values)}  {unit}: {CASES[name].__doc__.splitlines()[0]}"
        )


if __name__ == "__main__":
    main()
