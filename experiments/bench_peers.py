"""The engines that `throughput.py` measures beside diffrigid. To add one: a line in PEERS."""

from collections import namedtuple

import bench_batched as batched
import bench_native as native

# package: without it the engine is not there. flat: it has no space. build, run and read of a native engine: a world,
# all its steps, and positions and velocities from what that returns. A batched engine has its build only.
Peer = namedtuple("Peer", "package flat build run read", defaults=[None, None])
PEERS = {
    "pymunk": Peer(
        "pymunk",
        True,
        native.build_pymunk,
        native.steps_of("step", lambda scene: (scene.dt,)),
        native.reader_of("velocity"),
    ),
    "Box2D v3": Peer(
        "pyb2d3",
        True,
        native.build_box2d,
        native.steps_of("step", lambda scene: (scene.dt, 4)),  # sub-steps
        native.reader_of("linear_velocity"),
    ),
    "MuJoCo": Peer("mujoco", False, native.build_mujoco, native.run_mujoco, native.read_mujoco),
    "Rapier": Peer("rapier3d", False, native.build_rapier, native.steps_of("step"), native.read_rapier),
    "Bullet": Peer("pybullet", False, native.build_bullet, native.steps_of("stepSimulation"), native.read_bullet),
    "MJX": Peer("mujoco-mjx", False, batched.mjx),
    "Brax spring": Peer("brax", False, batched.brax("spring")),
    "Brax positional": Peer("brax", False, batched.brax("positional")),
    "Jax2D": Peer("jax2d", True, batched.jax2d),
}


def kind(engine):
    if engine not in PEERS:
        return "diffrigid"
    return "native" if PEERS[engine].run else "batched"


def peers_of(scene):
    """No batched ones in a crowd: they compute every pair."""
    flat, few = native.is_flat(scene), len(scene.x) < 50
    return [name for name, peer in PEERS.items() if (flat or not peer.flat) and (few or kind(name) == "native")]
