"""Engines that step one world at a time, for `throughput.py`: how each builds, steps and reads a scene.

In those of space a flat scene is the plane y = 0 with z up, its discs are balls and its boxes as deep as high.
"""

import math

from peer_engines import damping_of

STIFFNESS = {True: 3e3, False: 5e4}  # [1/s^2] of MuJoCo's contacts, with friction and without


def is_flat(scene):
    return len(scene.x[0]) == 2


def in_space(point):
    return (point[0], 0.0, point[1]) if len(point) == 2 else tuple(point)


def half_sides(scene):
    """Of a box in space [m]."""
    return (*scene.size, scene.size[-1])[:3]


def back(scene, x, v):
    """Positions and velocities in space as the scene has them."""
    keep = (0, 2) if is_flat(scene) else (0, 1, 2)
    return tuple([[float(point[k]) for k in keep] for point in points] for points in (x, v))


def half_length(scene):
    """Of the bars that stand for walls [m]."""
    return max([10.0, *(abs(1.1 * offset) for _, offset in scene.walls)])


def build_pymunk(scene):
    import pymunk

    space = pymunk.Space()
    space.gravity = (0.0, -scene.gravity)
    space.collision_slop = 0.005  # [m] as Box2D's; the default of 0.1 is meant for pixels
    shapes = []
    half = half_length(scene)
    for (nx, ny), offset in scene.walls:  # a bar 20 m long, or longer, and 1 m thick
        cx, cy = nx * (offset - 0.5), ny * (offset - 0.5)
        ends = (cx - half * ny, cy + half * nx), (cx + half * ny, cy - half * nx)
        shapes.append(pymunk.Segment(space.static_body, *ends, 0.5))
    sides = tuple(2 * half for half in scene.size)
    disc = len(sides) == 1
    moment = (
        pymunk.moment_for_circle(scene.mass, 0.0, *scene.size) if disc else pymunk.moment_for_box(scene.mass, sides)
    )
    bodies = [pymunk.Body(scene.mass, moment) for _ in scene.x]
    shapes += [pymunk.Circle(b, *scene.size) if disc else pymunk.Poly.create_box(b, sides) for b in bodies]
    for body, x, v in zip(bodies, scene.x, scene.v, strict=True):
        body.position, body.velocity = x, v
    for shape in shapes:  # pymunk multiplies the numbers of the two shapes
        shape.elasticity, shape.friction = math.sqrt(scene.restitution), math.sqrt(scene.friction)
        shape.filter = pymunk.ShapeFilter(group=int(bool(scene.chain)))
    space.add(*bodies, *shapes)
    for before, body in zip([None, *bodies], bodies, strict=False) if scene.chain else ():
        hook = (space.static_body, body, (0, 0)) if before is None else (before, body, (scene.size[0], 0))
        space.add(pymunk.PivotJoint(*hook, (-scene.size[0], 0)))
    return space, bodies


def build_box2d(scene):
    import pyb2d3

    world = pyb2d3.World(gravity=(0.0, -scene.gravity), restitution_threshold=0.0)
    world.sleeping_enabled = False
    material = pyb2d3.surface_material(friction=scene.friction, restitution=scene.restitution)
    ground = world.create_static_body(position=(0.0, 0.0))
    for (nx, ny), offset in scene.walls:  # a bar 20 m long, or longer, and 1 m thick
        center = nx * (offset - 0.5), ny * (offset - 0.5)
        bar = pyb2d3.box(hx=0.5, hy=half_length(scene), center=center, rotation=math.atan2(ny, nx))
        ground.create_shape(pyb2d3.shape_def(material=material), bar)
    disc = len(scene.size) == 1
    area = math.pi * scene.size[0] ** 2 if disc else 4 * math.prod(scene.size)
    apart = {"filter": pyb2d3.make_filter(group_index=-1)} if scene.chain else {}
    stuff = pyb2d3.shape_def(density=scene.mass / area, material=material, **apart)
    pairs = zip(scene.x, scene.v, strict=True)
    bodies = [world.create_dynamic_body(position=x, linear_velocity=v) for x, v in pairs]
    half = scene.size[0]
    for body in bodies:
        body.create_shape(stuff, pyb2d3.circle(radius=half) if disc else pyb2d3.box(hx=half, hy=scene.size[-1]))
    for before, body in zip([None, *bodies], bodies, strict=False) if scene.chain else ():
        hook = {"body_a": ground, "local_anchor_a": (0.0, 0.0)}
        hook = hook if before is None else {"body_a": before, "local_anchor_a": (half, 0.0)}
        world.create_revolute_joint(body_b=body, local_anchor_b=(-half, 0.0), **hook)
    return world, bodies


def steps_of(name, arguments=lambda scene: ()):
    def run(world, scene):
        step, args = getattr(world[0], name), arguments(scene)
        for _ in range(scene.steps):
            step(*args)
        return world

    return run


def reader_of(velocity):
    # A body of Box2D does not outlive its world.
    return lambda world, scene: zip(*((tuple(b.position), tuple(getattr(b, velocity))) for b in world[1]), strict=True)


def build_bullet(scene):
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    world = BulletClient(pybullet.DIRECT)
    world.setGravity(0, 0, -scene.gravity)
    world.setTimeStep(scene.dt)
    world.setPhysicsEngineParameter(restitutionVelocityThreshold=0.0)
    if not scene.friction:  # its contacts ahead of the touch, and its repair of overlap, change the speed of a rebound
        world.setPhysicsEngineParameter(contactBreakingThreshold=1e-3, contactERP=0.0)
    stuff = {"restitution": math.sqrt(scene.restitution), "lateralFriction": math.sqrt(scene.friction)}  # multiplied
    undamped = {"linearDamping": 0, "angularDamping": 0, "jointDamping": 0}
    for n, offset in ((in_space(n), offset) for n, offset in scene.walls):
        plane = world.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=n)
        world.changeDynamics(world.createMultiBody(0, plane, basePosition=[offset * s for s in n]), -1, **stuff)
    half = half_sides(scene)
    if scene.chain:
        chain, links = chain_in_bullet(world, scene.mass, half[0], range(len(scene.x)))
        for k in links:
            world.setJointMotorControl2(chain, k, pybullet.VELOCITY_CONTROL, force=0)
            inertia = [scene.mass / 3 * (sum(h * h for h in half) - h * h) for h in half]
            world.changeDynamics(chain, k, localInertiaDiagonal=inertia, **undamped)
        return world, [(chain, k) for k in links]
    ball = {"shapeType": pybullet.GEOM_SPHERE, "radius": half[0]}
    box = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
    shape = world.createCollisionShape(**(ball if len(scene.size) == 1 else box))
    bodies = [world.createMultiBody(scene.mass, shape, basePosition=in_space(x)) for x in scene.x]
    for body, v, w in zip(bodies, scene.v, scene.w or [(0, 0, 0)] * len(bodies), strict=True):
        world.changeDynamics(body, -1, **stuff, **undamped)
        world.resetBaseVelocity(body, in_space(v), w)
    return world, [(body, -1) for body in bodies]


def chain_in_bullet(world, mass, half, links):
    import pybullet

    each = {
        "Masses": mass,
        "CollisionShapeIndices": -1,
        "VisualShapeIndices": -1,
        "Positions": (2 * half, 0, 0),
        "Orientations": (0, 0, 0, 1),
        "InertialFramePositions": (half, 0, 0),
        "InertialFrameOrientations": (0, 0, 0, 1),
        "JointTypes": pybullet.JOINT_REVOLUTE,
        "JointAxis": (0, -1, 0),
    }
    arguments = {f"link{name}": [value for _ in links] for name, value in each.items()}
    arguments["linkPositions"][0] = (0, 0, 0)
    return world.createMultiBody(0, -1, linkParentIndices=list(links), **arguments), links


def read_bullet(world, scene):
    world, bodies = world
    if scene.chain:
        states = [world.getLinkState(body, link, computeLinkVelocity=1) for body, link in bodies]
        return back(scene, [state[0] for state in states], [state[6] for state in states])
    x = [world.getBasePositionAndOrientation(body)[0] for body, _ in bodies]
    return back(scene, x, [world.getBaseVelocity(body)[0] for body, _ in bodies])


def build_rapier(scene):
    import rapier3d

    world = rapier3d.PhysicsWorld(gravity=(0.0, 0.0, -scene.gravity))
    world.integration_parameters.dt = scene.dt

    def stuff(collider):
        return collider.restitution(scene.restitution).friction(scene.friction)

    for n, offset in scene.walls:
        n = in_space(n)
        world.add_collider(stuff(rapier3d.Collider.halfspace(n)).translation([offset * s for s in n]).build())
    half, bodies = half_sides(scene), []
    for x, v, w in zip(scene.x, scene.v, scene.w or [(0.0, 0.0, 0.0)] * len(scene.x), strict=True):
        body = rapier3d.RigidBody.dynamic().translation(in_space(x)).linvel(in_space(v)).angvel(w).can_sleep(False)
        shape = rapier3d.Collider.ball(half[0]) if len(scene.size) == 1 else rapier3d.Collider.cuboid(*half)
        shape = shape.collision_groups(rapier3d.InteractionGroups.none()) if scene.chain else stuff(shape)
        bodies.append(world.add_body(body.build(), colliders=[shape.mass(scene.mass).build()]))
    if scene.chain:
        before, at = world.add_body(rapier3d.RigidBody.fixed().build()), (0.0, 0.0, 0.0)
        for body in bodies:
            joint = rapier3d.RevoluteJoint.builder((0.0, 1.0, 0.0)).local_anchor1(at)
            world.impulse_joints.insert(before, body, joint.local_anchor2((-half[0], 0.0, 0.0)).build(), True)
            before, at = body, (half[0], 0.0, 0.0)
    return world, bodies


def read_rapier(world, scene):
    bodies = [world[0].rigid_bodies[body] for body in world[1]]
    x, v = ([(s.x, s.y, s.z) for s in (getattr(b, key) for b in bodies)] for key in ("translation", "linvel"))
    return back(scene, x, v)


def mjcf(scene, free, option=""):
    """The scene for MuJoCo, MJX and Brax. MuJoCo has no restitution: a spring, and the damper that rebounds alike.

    free: bodies have six degrees of freedom, else the three of the plane.
    """
    shape = "sphere" if len(scene.size) == 1 else "box"
    size = " ".join(map(str, half_sides(scene)))
    contact = f'condim="{3 if scene.friction else 1}" friction="{scene.friction or 1} 0.0001 0.0001"'
    if scene.restitution:
        stiffness = STIFFNESS[scene.friction > 0]
        contact += f' solimp="0.99 0.99 0.001" solref="{-stiffness} {-damping_of(scene.restitution, stiffness):.5g}"'
    geom = f'<geom type="{shape}" size="{size}" mass="{scene.mass}"'
    planar = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 -1 0"/>'
    walls = "".join(
        '<geom type="plane" size="50 50 1" pos="{} {} {}" zaxis="{} {} {}"/>'.format(*(s * offset for s in n), *n)
        for n, offset in ((in_space(n), offset) for n, offset in scene.walls)
    )
    bodies = f"<body>{'<freejoint/>' if free else planar}{geom}/></body>" * len(scene.x)
    if scene.chain:
        length = 2 * scene.size[0]
        bodies = "".join(
            f'<body pos="{length * (k > 0)} 0 0"><joint axis="0 -1 0"/>{geom} pos="{length / 2} 0 0" contype="0" '
            'conaffinity="0"/>'
            for k in range(len(scene.x))
        ) + "</body>" * len(scene.x)
    option += f' timestep="{scene.dt}" gravity="0 0 {-scene.gravity}"'
    return (
        f'<mujoco><option {option}><flag eulerdamp="disable"/></option><default><geom {contact}/></default>'  # undamped
        f"<worldbody>{walls}{bodies}</worldbody></mujoco>"
    )


def coordinates(scene, free):
    """qpos and qvel of `mjcf` at the start."""
    if scene.chain:
        return [0.0] * len(scene.x), [0.0] * len(scene.x)
    if not free:
        return [s for x in scene.x for s in (*x, 0.0)], [s for v in scene.v for s in (*v, 0.0)]
    w = scene.w or [(0.0, 0.0, 0.0)] * len(scene.x)
    q = [s for x in scene.x for s in (*in_space(x), 1.0, 0.0, 0.0, 0.0)]
    return q, [s for v, turn in zip(scene.v, w, strict=True) for s in (*in_space(v), *turn)]


def build_mujoco(scene):
    import mujoco
    import numpy as np
    from mujoco import rollout

    free = not is_flat(scene)
    model = mujoco.MjModel.from_xml_string(mjcf(scene, free))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = coordinates(scene, free)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros((1, mujoco.mj_stateSize(model, full)))
    mujoco.mj_getState(model, data, state[0], full)
    return rollout.Rollout(nthread=0), model, data, state


def run_mujoco(world, scene):
    roller, model, data, state = world
    states, sensors = roller.rollout(model, data, state, nstep=scene.steps)
    del sensors
    return model, states[0, -1, 1 : 1 + model.nq], states[0, -1, 1 + model.nq : 1 + model.nq + model.nv]


def read_mujoco(end, scene):
    import mujoco
    import numpy as np

    model, q, v = end
    data, six = mujoco.MjData(model), np.zeros((model.nbody, 6))
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    for k in range(1, model.nbody):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, k, six[k], 0)
    return back(scene, data.xipos[1:], six[1:, 3:])
