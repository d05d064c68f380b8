"""diffrigid: differentiable rigid bodies in JAX, from measured motion to physical parameters.

`scene` makes a world and a state, `rollout` moves it, `play` shows it, `fit` finds its numbers from measured columns;
`dr.paths.catalogue(world)` lists their names.

Letters of array axes, everywhere: N bodies, D space (2 or 3), A angular (1 or 3), Q orientation (2 or 4),
S statics, C contacts, P pairs, K contacts of a pair, R rows (of joints, or of a matrix), E equations of a joint,
V corners of a shape, T time steps, B worlds of a batch; trailing batch axes follow them. A module that needs others
says so.
"""

from importlib import metadata as _metadata

from diffrigid import paths as paths
from diffrigid import sysid as sysid
from diffrigid import view as view
from diffrigid.batch import rollout_batch
from diffrigid.compiling import QUICK, compile_for_speed
from diffrigid.contact import Contact
from diffrigid.forces import Drag, Force, Gravity, GroundFriction, SpringDamper, Torque
from diffrigid.gap import gap
from diffrigid.impacts import contacts
from diffrigid.joints import Ball, Distance, Prismatic, Revolute, Weld
from diffrigid.models import load_mjcf, load_urdf
from diffrigid.parts import Part
from diffrigid.pytree import replace
from diffrigid.saved_scene import load_scene, save_scene
from diffrigid.scene import Body, Static, scene
from diffrigid.shapes import Box, Capsule, Disc, HalfSpace, HeightField, Hull, Polygon, Profile, Sphere
from diffrigid.state import (
    State,
    Wrench,
    angular_momentum,
    kinetic_energy,
    material_point,
    material_velocity,
    momentum,
)
from diffrigid.step import missed_pairs, rollout, step
from diffrigid.sysid import (
    Channel,
    Fit,
    Homography,
    Marker,
    Pinhole,
    Record,
    Separation,
    bootstrap,
    direction,
    each,
    fit,
    huber,
    inertia,
    interval,
    load_fit,
    positive,
    prior,
    profile,
    read_csv,
    real,
    rotation,
    sample,
    sandwich,
    segments,
    shares,
    student,
    through,
)
from diffrigid.trajectory import Trajectory
from diffrigid.view import Player, explore, play
from diffrigid.world import World, check

__all__ = [
    "Ball",
    "Body",
    "Box",
    "Capsule",
    "Channel",
    "Contact",
    "Disc",
    "Distance",
    "Drag",
    "Fit",
    "Force",
    "Gravity",
    "GroundFriction",
    "HalfSpace",
    "HeightField",
    "Homography",
    "Hull",
    "Marker",
    "Part",
    "Pinhole",
    "Player",
    "Polygon",
    "Profile",
    "Prismatic",
    "QUICK",
    "Record",
    "Revolute",
    "Separation",
    "Sphere",
    "SpringDamper",
    "State",
    "Static",
    "Torque",
    "Trajectory",
    "Weld",
    "World",
    "Wrench",
    "angular_momentum",
    "bootstrap",
    "check",
    "compile_for_speed",
    "contacts",
    "direction",
    "each",
    "explore",
    "fit",
    "gap",
    "huber",
    "inertia",
    "interval",
    "kinetic_energy",
    "load_fit",
    "load_mjcf",
    "load_scene",
    "load_urdf",
    "material_point",
    "material_velocity",
    "missed_pairs",
    "momentum",
    "play",
    "positive",
    "prior",
    "profile",
    "read_csv",
    "real",
    "replace",
    "rollout",
    "rollout_batch",
    "rotation",
    "sample",
    "sandwich",
    "save_scene",
    "scene",
    "segments",
    "shares",
    "step",
    "student",
    "through",
]


def __getattr__(name: str) -> str:
    if name == "__version__":
        return _metadata.version("diffrigid")
    raise AttributeError(f"module 'diffrigid' has no attribute {name!r}")
