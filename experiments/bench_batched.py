"""Engines in JAX that step a batch, for `throughput.py`.

Each gives the states of all worlds at the start, a step of one world, and positions and velocities from one state.
"""

import importlib
import math

from bench_native import coordinates, is_flat, mjcf, read_mujoco


def starts(scenes, free):
    """qpos and qvel of all worlds."""
    import jax.numpy as jnp
    import numpy as np

    return [jnp.array(np.array(part, np.float32)) for part in zip(*(coordinates(s, free) for s in scenes), strict=True)]


def mjx(scenes):
    """A body alone needs one iteration of the solver, a pile four to come to rest."""
    import jax
    import mujoco
    from mujoco import mjx as engine

    free = not is_flat(scenes[0])
    option = f'iterations="{1 if len(scenes[0].x) == 1 else 4}" ls_iterations="4"'
    model = mujoco.MjModel.from_xml_string(mjcf(scenes[0], free, option))
    there, data = engine.put_model(model), engine.make_data(model)
    start = jax.vmap(lambda q, v: data.replace(qpos=q, qvel=v))(*starts(scenes, free))
    return start, lambda d: engine.step(there, d), lambda d: read_mujoco((model, d.qpos, d.qvel), scenes[0])


def brax(pipeline):
    def build(scenes):
        import jax
        import jax.numpy as jnp
        import mujoco
        from brax.io import mjcf as reader

        scene, pipe = scenes[0], importlib.import_module(f"brax.{pipeline}.pipeline")
        model = mujoco.MjModel.from_xml_string(mjcf(scene, free=True))
        system = reader.load_model(model)
        system = system.replace(elasticity=jnp.full(system.ngeom, scene.restitution))
        if not scene.friction:
            system = system.replace(baumgarte_erp=0.0)  # it would add to the speed of a rebound
        if scene.chain:  # ten times the default, which lets the joints part by a link's length
            system = system.tree_replace({"link.constraint_stiffness": jnp.full(len(scene.x), 2e4)})
        start = jax.jit(jax.vmap(lambda q, v: pipe.init(system, q, v)))(*starts(scenes, free=True))
        act = jnp.zeros(0)
        return start, lambda s: pipe.step(system, s, act), lambda s: read_mujoco((model, s.q, s.qd), scene)

    return build


def jax2d(scenes):
    import jax
    import jax.numpy as jnp
    from jax2d.engine import PhysicsEngine
    from jax2d.sim_state import SimParams, StaticSimParams

    scene, count, disc = scenes[0], len(scenes[0].x), len(scenes[0].size) == 1
    walls = max(len(scene.walls), 1)  # a chain hangs from one
    static = StaticSimParams(  # as few as it takes: a body of each kind, and two discs
        num_polygons=walls + (1 if disc else count),
        num_static_fixated_polys=walls,
        num_circles=max(2, count * disc),
        num_joints=count if scene.chain else 1,
        num_thrusters=1,
    )
    engine, params, act = PhysicsEngine(static), SimParams(dt=scene.dt), jnp.zeros(static.num_joints + 1)
    if not scene.friction:
        params = params.replace(baumgarte_coefficient_collision=0.0)  # it would add to the speed of a rebound
    world = jax2d_world(scene, static, params.base_friction)
    kind, here = ("circle", slice(count)) if disc else ("polygon", slice(walls, walls + count))

    def placed(x, v):
        bodies = getattr(world, kind)
        bodies = bodies.replace(position=bodies.position.at[here].set(x), velocity=bodies.velocity.at[here].set(v))
        return world.replace(**{kind: bodies})

    def read(state):
        bodies = getattr(state, kind)
        return bodies.position[here].tolist(), bodies.velocity[here].tolist()

    start = jax.vmap(placed)(*(jnp.array([getattr(s, key) for s in scenes], jnp.float32) for key in "xv"))
    return start, lambda s: engine.step(s, params, act)[0], read


def jax2d_world(scene, static, base_friction):
    """The bars that stand for walls end within the 15 m to which it clips positions."""
    import jax.numpy as jnp
    from jax2d.engine import create_empty_sim
    from jax2d.scene import add_circle_to_scene, add_rectangle_to_scene, add_revolute_joint_to_scene

    friction = scene.friction / math.sqrt(2) / base_friction  # of two shapes it takes the root of the sum of squares
    stuff = {"friction": friction, "restitution": scene.restitution}  # and the lesser restitution
    world = create_empty_sim(static, add_floor=False, add_walls_and_ceiling=False)
    world = world.replace(gravity=jnp.array([0.0, -scene.gravity]))
    for (nx, ny), offset in scene.walls or [((0.0, 1.0), -13.5)]:
        sides = jnp.array((1.0, 20.0) if nx else (20.0, 1.0))
        at = jnp.array([nx * (offset - 0.5), ny * (offset - 0.5)])
        world, (_, before) = add_rectangle_to_scene(world, static, at, sides, fixated=True, **stuff)
    area = math.pi * scene.size[0] ** 2 if len(scene.size) == 1 else 4 * math.prod(scene.size)
    stuff["density"] = scene.mass / area
    hook, arm = jnp.array([0.0, 14.0]), jnp.array([scene.size[0], 0.0])
    for x in map(jnp.array, scene.x):
        if len(scene.size) == 1:
            world, _ = add_circle_to_scene(world, static, x, scene.size[0], **stuff)
            continue
        world, (_, body) = add_rectangle_to_scene(world, static, x, 2 * jnp.array(scene.size), **stuff)
        if scene.chain:
            world, _ = add_revolute_joint_to_scene(world, static, before, body, hook, -arm)
            before, hook = body, arm
    return world
