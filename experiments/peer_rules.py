"""Which coefficient does a contact take from its two sides, and other rules of pymunk, Box2D and MuJoCo?

    pip install -e ".[experiments]" && python experiments/peer_rules.py

Measures what `notebooks/coming_from.md` says of them: a box slides on a floor for 0.25 s, with friction 0.1 on one side
and 0.4 on the other, and a ball falls on a floor with restitution 0.5 and 0.8.

Result (2026-11-22; pymunk 7.3.1, pyb2d3 0.11.1, mujoco 4.0.0):

    friction 0.1 and 0.4      diffrigid 0.250, pymunk 0.040, Box2D 0.200, MuJoCo 0.404
    restitution 0.5 and 0.8   diffrigid 0.650, pymunk 0.400, Box2D 0.797
    Box2D: an impact at 0.9 m/s does not rebound, unless restitution_threshold is lowered
    MuJoCo: angular velocities of free joints are in body axes
"""

import math

G, T = 9.81, 0.25
A, B = 0.1, 0.4  # of friction
DROP = 0.9  # [m]


def friction_diffrigid():
    import diffrigid as dr

    box = dr.Body(dr.Box(half=(0.5, 0.5)), mass=1.0, x=(0.0, 0.5), v=(2.0, 0.0), friction=A)
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)), friction=B)
    world, state = dr.scene({"box": box, "floor": floor}, gravity=(0.0, -G))
    return (2.0 - float(dr.rollout(world, state, dt=T / 60, steps=60).state.v[-1, 0, 0])) / (G * T)


def friction_pymunk():
    space, body = falling_pymunk(0.5, box=True)
    body.velocity = 2.0, 0.0
    for shape, mu in zip(space.shapes, (A, B), strict=True):
        shape.friction = mu
    for _ in range(240):
        space.step(T / 240)
    return (2.0 - body.velocity.x) / (G * T)


def falling_pymunk(height, box=False):
    """A body of 1 m or 0.2 m above a floor, and the space."""
    import pymunk

    space = pymunk.Space()
    space.gravity = 0.0, -G
    body = pymunk.Body(1.0, math.inf if box else 1.0)
    body.position = 0.0, height
    shape = pymunk.Poly.create_box(body, (1.0, 1.0)) if box else pymunk.Circle(body, 0.1)
    space.add(body, shape, pymunk.Segment(space.static_body, (-9, -0.5), (9, -0.5), 0.5))
    return space, body


def friction_box2d():
    world, body = falling_box2d(0.5, {"friction": A}, {"friction": B}, box=True)
    for _ in range(60):
        world.step(T / 60, 4)
    return (2.0 - body.linear_velocity[0]) / (G * T)


def falling_box2d(height, of_body, of_floor, box=False):
    import pyb2d3 as b2

    world = b2.World(gravity=(0.0, -G))
    body = world.create_dynamic_body(position=(0.0, height), linear_velocity=(2.0 if box else 0.0, 0.0))
    floor = world.create_static_body(position=(0.0, -0.5))
    shape = b2.box(0.5, 0.5) if box else b2.circle(radius=0.1)
    body.create_shape(b2.shape_def(density=1.0, material=b2.surface_material(**of_body)), shape)
    floor.create_shape(b2.shape_def(material=b2.surface_material(**of_floor)), b2.box(50.0, 0.5))
    return world, body


def friction_mujoco():
    import mujoco

    floor = f'<geom type="plane" size="9 9 1" friction="{A}"/>'
    box = f'<body pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1" friction="{B}" mass="1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{floor}{box}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    data.qvel[0] = 2.0
    while data.time < T - 1e-9:
        mujoco.mj_step(model, data)
    return (2.0 - data.qvel[0]) / (G * data.time)


def restitution(step, speed):
    """Speed after the first rebound over that before it."""
    for _ in range(10000):
        step()
        if speed() > 0:
            return speed() / math.sqrt(2 * G * DROP)
    return 0.0


def restitution_diffrigid():
    import diffrigid as dr

    ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, DROP + 0.1), restitution=0.5)
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)), restitution=0.8)
    world, state = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -G))
    t = math.sqrt(2 * DROP / G)
    return (float(dr.step(world, state, t + 0.1).v[0, 1]) + G * 0.1) / (G * t)


def restitution_pymunk():
    space, body = falling_pymunk(DROP + 0.1)
    for shape, e in zip(space.shapes, (0.5, 0.8), strict=True):
        shape.elasticity = e
    return restitution(lambda: space.step(1e-4), lambda: body.velocity.y)


def restitution_box2d(e=(0.5, 0.8), height=DROP + 0.1):
    world, body = falling_box2d(height, {"restitution": e[0]}, {"restitution": e[1]})
    return restitution(lambda: world.step(1e-3, 4), lambda: body.linear_velocity[1])


def axes_mujoco():
    """World components of the angular velocity (1, 0, 0) in qvel of a body that is turned by 90 degrees about z."""
    import mujoco
    import numpy as np

    ball = '<body quat="1 0 0 1"><freejoint/><geom type="sphere" size="0.1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
    data, w = mujoco.MjData(model), np.zeros(6)
    data.qvel[3] = 1.0
    mujoco.mj_forward(model, data)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, w, 0)
    return w[:3].round(6).tolist()


def main():
    found = {
        "diffrigid": friction_diffrigid,
        "pymunk": friction_pymunk,
        "Box2D": friction_box2d,
        "MuJoCo": friction_mujoco,
    }
    print("friction 0.1 and 0.4     ", ", ".join(f"{name} {of():.3f}" for name, of in found.items()))
    found = {"diffrigid": restitution_diffrigid, "pymunk": restitution_pymunk, "Box2D": restitution_box2d}
    print("restitution 0.5 and 0.8  ", ", ".join(f"{name} {of():.3f}" for name, of in found.items()))
    slow = 0.1 + 0.9**2 / (2 * G)
    print(f"Box2D: rebound of an impact at 0.9 m/s: {restitution_box2d((0.8, 0.8), slow) > 0.05}")
    print(f"MuJoCo: qvel (1, 0, 0) of a free body turned by 90 degrees about z is {axes_mujoco()} in the world")


if __name__ == "__main__":
    main()
