"""Motions in closed form, as trajectories that need no simulation."""

import numpy as np

import diffrigid as dr

G, E, MASS, RADIUS = 9.81, 0.5, 2.0, 0.4
HEIGHT = 1.0  # [m] under the ball at the start
IMPACT = np.sqrt(2 * HEIGHT / G)
DOWN = G * IMPACT  # [m/s] at the impact
T = np.linspace(0.0, 0.9, 55)


def sums(world, state):
    """Momentum, angular momentum and kinetic energy of all bodies together."""
    laws = dr.momentum, dr.angular_momentum, dr.kinetic_energy
    return tuple(law(world.bodies, state).sum(0) for law in laws)


def trajectory(world, t, x, q, v, w):
    state = dr.State(**{name: np.asarray(value, float) for name, value in dict(x=x, q=q, v=v, w=w).items()})
    return dr.Trajectory(t=np.asarray(t), state=state, world=world)


def bounce(dim=2, t=T, spin=3.0):
    """A ball that falls, bounces once and turns about the last axis; a solid at rest on the floor beside it. Closed form."""
    up = np.eye(dim)[-1]
    floor = dr.Static(dr.HalfSpace(normal=up))
    solid = dr.Polygon(vertices=((0.0, 0.0), (0.6, 0.0), (0.0, 0.3))) if dim == 2 else dr.Box(half=(0.2, 0.2, 0.1))
    rest = np.array([1.2, 0.1]) if dim == 2 else np.array([1.2, 0.0, 0.1])
    ball = dr.Disc(radius=RADIUS) if dim == 2 else dr.Sphere(radius=RADIUS)
    bodies = {
        "ball": dr.Body(ball, mass=MASS, x=(HEIGHT + RADIUS) * up),
        "block": dr.Body(solid, mass=1.0, x=rest),
        "floor": floor,
    }
    world, _ = dr.scene(bodies, gravity=-G * up, restitution=E, friction=0.0)
    after = np.maximum(t - IMPACT, 0.0)
    height = np.where(t < IMPACT, HEIGHT - G * t**2 / 2, E * DOWN * after - G * after**2 / 2)
    speed = np.where(t < IMPACT, -G * t, E * DOWN - G * after)
    x = np.stack([np.outer(height + RADIUS, up), np.tile(rest, (len(t), 1))], axis=1)
    v = np.stack([np.outer(speed, up), np.zeros((len(t), dim))], axis=1)
    half = spin * t / (1 if dim == 2 else 2)
    turn = np.zeros((len(t), 2 if dim == 2 else 4))
    turn[:, 0], turn[:, -1] = np.cos(half), np.sin(half)
    turn *= 1 if dim == 2 else np.where(np.arange(len(t)) % 2, -1.0, 1.0)[:, None]  # q and -q are one orientation
    q = np.stack([turn, np.tile(np.eye(turn.shape[1])[0], (len(t), 1))], axis=1)
    w = np.zeros((len(t), 2, 1 if dim == 2 else 3))
    w[:, 0, -1] = spin
    return trajectory(world, t, x, q, v, w)


def height(t):
    """Of the ball's centre in `bounce` [m], at one time."""
    after = t - IMPACT
    return RADIUS + (HEIGHT - G * t**2 / 2 if after < 0 else E * DOWN * after - G * after**2 / 2)
