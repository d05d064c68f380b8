"""The scenes of `gradients_vs_peers.py`, and the engines of them that are written in JAX.

Each engine is a function of (case, steps per second, options) that returns theta -> positions at the end, (N, 2) [m].
"""

import numpy as np
from peer_discs import damping_of

STARTS, SEED, NEAR = 5, 0, 1e-3  # starts, and by how much of themselves their numbers differ
RADIUS = {"one bounce": 0.1, "two discs": 0.4, "three discs": 0.4}  # [m]
DISCS = ((0.0, 0.0), (1.5, 0.1), (3.2, 0.35))  # [m] where they start
CASES = {  # theta: (restitution, y, v_y, g) of a ball above a floor; (restitution, mass of b, v of a) of discs
    "one bounce": ((0.8, 1.0, 0.5, 9.81), 0.6),
    "two discs": ((0.8, 2.0, 2.0, 0.1), 1.2),
    "three discs": ((0.8, 2.0, 2.0, 0.1), 2.0),
}


def start(name, theta):
    """Positions and velocities (N, 2), masses (N,), restitution, gravity: what a simulation starts from."""
    import jax.numpy as jnp

    if name == "one bounce":
        e, y, v, g = theta
        return jnp.stack([0.0 * y, y])[None], jnp.stack([0.0 * v, v])[None], jnp.ones(1), e, g
    e, mass, *v = theta
    count = 2 if name == "two discs" else 3
    x = jnp.asarray(DISCS[:count], jnp.result_type(float))
    moving = jnp.zeros((count, 2)).at[0].set(jnp.stack(v))
    return x, moving, jnp.ones(count).at[1].set(mass), e, 0.0 * e


def thetas(name):
    """(STARTS, 4) the same for every engine."""
    spread = np.random.default_rng(SEED).uniform(-NEAR, NEAR, (STARTS, 4))
    return np.array(CASES[name][0]) * (1.0 + spread)


def diffrigid(name, rate):
    import diffrigid as dr

    steps = round(CASES[name][1] * rate)

    def end(theta):
        x, v, m, e, g = start(name, theta)
        disc = dr.Disc(radius=RADIUS[name])
        bodies = {str(k): dr.Body(disc, mass=m[k], x=x[k], v=v[k]) for k in range(len(m))}
        down = {}
        if name == "one bounce":
            bodies["floor"] = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
            down = {"gravity": [0.0 * g, -g]}
        world, state = dr.scene(bodies, restitution=e, **down)
        return dr.rollout(world, state, dt=CASES[name][1] / steps, steps=steps).state.x[-1]

    return end


def in_space(plane):
    """(N, 2) to (N, 3): y goes up."""
    import jax.numpy as jnp

    return jnp.stack([plane[:, 0], 0.0 * plane[:, 0], plane[:, 1]], axis=1)


def mjcf(name, rate, geom="", custom="", option=""):
    """The spheres, free, without friction."""
    count = len(DISCS[: {"one bounce": 1, "two discs": 2, "three discs": 3}[name]])
    sphere = f'<geom type="sphere" size="{RADIUS[name]}" mass="1"/>'
    bodies = "".join(f'<body pos="{3 * k} 0 9"><freejoint/>{sphere}</body>' for k in range(count))
    floor = '<geom type="plane" size="9 9 1"/>' if name == "one bounce" else ""
    steps = round(CASES[name][1] * rate)
    return (
        f'<mujoco><option timestep="{CASES[name][1] / steps:.12g}" {option}/><custom>{custom}</custom>'
        f'<default><geom condim="1" {geom}/></default><worldbody>{floor}{bodies}</worldbody></mujoco>'
    ), steps


def poses(name, theta):
    """q and qd of free joints."""
    import jax.numpy as jnp

    x, v, *_ = start(name, theta)
    unturned = jnp.zeros((len(x), 4)).at[:, 0].set(1.0)
    q = jnp.concatenate([in_space(x), unturned], axis=1).ravel()
    return q, jnp.concatenate([in_space(v), jnp.zeros((len(x), 3))], axis=1).ravel()


def brax(name, rate, pipeline):
    """Drags and Baumgarte's term, which would change the motion, are off."""
    import importlib

    import jax
    import jax.numpy as jnp
    from brax.io import mjcf as reader

    pipeline = importlib.import_module(f"brax.{pipeline}.pipeline")
    off = "".join(f'<numeric name="{n}" data="0"/>' for n in ("vel_damping", "ang_damping", "baumgarte_erp"))
    text, steps = mjcf(name, rate, custom=off)
    system = reader.loads(text)

    def end(theta):
        _, _, m, e, g = start(name, theta)
        inertia = system.link.inertia.replace(mass=m, i=system.link.inertia.i * m[:, None, None])
        here = system.replace(
            elasticity=e + jnp.zeros(system.ngeom), link=system.link.replace(inertia=inertia),
            gravity=jnp.stack([0.0 * g, 0.0 * g, -g]),
        )  # fmt: skip
        state = pipeline.init(here, *poses(name, theta))
        act = jnp.zeros(0)
        state = jax.lax.scan(lambda s, _: (pipeline.step(here, s, act), None), state, None, length=steps)[0]
        return state.x.pos[:, ::2]

    return end


def mjx(name, rate, stiffness):
    """MuJoCo has no restitution: a spring and the damper that rebounds alike, to first order in e.

    With more than one iteration its solver is a loop, and there is no reverse mode.
    """
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    text, steps = mjcf(name, rate, geom='solimp="0.99 0.99 0.001"', option='iterations="1" ls_iterations="4"')
    model = mjx.put_model(mujoco.MjModel.from_xml_string(text))
    about = CASES[name][0][0]
    damping = damping_of(about, stiffness)
    slope = (damping_of(about + 1e-4, stiffness) - damping_of(about - 1e-4, stiffness)) / 2e-4

    def end(theta):
        _, _, m, e, g = start(name, theta)
        solref = jnp.stack([-stiffness + 0.0 * e, -damping - slope * (e - about)])
        mass = jnp.concatenate([jnp.zeros(1), m])
        here = model.tree_replace({
            "geom_solref": jnp.broadcast_to(solref, model.geom_solref.shape),
            "body_mass": mass,
            "body_inertia": model.body_inertia * mass[:, None],
            "body_invweight0": model.body_invweight0 / jnp.maximum(mass, 1e-9)[:, None],
            "opt.gravity": jnp.stack([0.0 * g, 0.0 * g, -g]),
        })  # fmt: skip
        q, qd = poses(name, theta)
        data = mjx.make_data(here).replace(qpos=q, qvel=qd)
        data = jax.lax.scan(lambda d, _: (mjx.step(here, d), None), data, None, length=steps)[0]
        return data.qpos.reshape(-1, 7)[:, :3:2]

    return end


def jax2d(name, rate):
    import jax
    import jax.numpy as jnp
    from jax2d.engine import PhysicsEngine, create_empty_sim
    from jax2d.scene import add_circle_to_scene, add_rectangle_to_scene
    from jax2d.sim_state import SimParams, StaticSimParams

    count = {"one bounce": 1, "two discs": 2, "three discs": 3}[name]
    static = StaticSimParams(
        num_polygons=2, num_static_fixated_polys=1, num_circles=max(count, 2), num_joints=1, num_thrusters=1
    )
    steps, engine = round(CASES[name][1] * rate), PhysicsEngine(static)
    empty = create_empty_sim(static, add_floor=False, add_walls_and_ceiling=False)
    if name == "one bounce":
        at, size = jnp.array([0.0, -0.5]), jnp.array([20.0, 1.0])
        empty, _ = add_rectangle_to_scene(empty, static, at, size, fixated=True, friction=0.0, restitution=1.0)
    for k in range(count):
        at = jnp.array([3.0 * k, 5.0])
        empty, _ = add_circle_to_scene(empty, static, at, RADIUS[name], friction=0.0, restitution=1.0)
    params = SimParams(dt=CASES[name][1] / steps)
    act = jnp.zeros(static.num_joints + static.num_thrusters)

    def end(theta):
        x, v, m, e, g = start(name, theta)
        c = empty.circle
        c = c.replace(
            position=c.position.at[:count].set(x + 5.0 * (name != "one bounce")),  # off the idle polygon
            velocity=c.velocity.at[:count].set(v), inverse_mass=c.inverse_mass.at[:count].set(1.0 / m),
            restitution=c.restitution.at[:count].set(e),
        )  # fmt: skip
        sim = empty.replace(circle=c, gravity=jnp.stack([0.0 * g, -g]))
        sim = jax.lax.scan(lambda s, _: (engine.step(s, params, act)[0], None), sim, None, length=steps)[0]
        return sim.circle.position[:count] - 5.0 * (name != "one bounce")

    return end
