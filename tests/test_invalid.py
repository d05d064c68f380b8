"""Nonsense in every argument: it is refused in words of the library, never by an error from inside or in silence.

`INVALID=10000 pytest -n0 tests/test_invalid.py` tries as many; the test run takes a few hundred of them.
"""

import linecache
import os
import warnings
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrigid as dr
from diffrigid.scene_file import read_scene

COUNT = int(os.environ.get("INVALID", "400"))
PACKAGE = str(Path(dr.__file__).parent)

# ---- values that are wrong for an argument of a kind

HUGE = 10**400
ODD = (
    "text", b"bytes", object(), {}, {"a": 1.0}, set(), lambda: 1.0, [None], "1.0", 1j, np.nan, [[1.0], [1.0, 2.0]],
    np.array("x"), np.zeros((2, 3)), np.zeros(0), (), dr.Disc, dr.Disc(radius=1.0), Path("nowhere"), np.array([object()]),
    np.datetime64("2020-01-01"), (np.nan,) * 2, (np.nan,) * 3, [np.inf, 0.0], ["a", "b"], np.zeros((1, 2, 3, 4)), range(7),
    np.ma.masked, b"", slice(None), Exception("x"), np.full(5, np.nan), type, np.array([True, False, True, False, True]),
    HUGE,
)  # fmt: skip
NUMBER = (*ODD, np.inf, -np.inf, (1.0, 2.0), [[1.0]], True)
POSITIVE = (*NUMBER, 0.0, -1.0, -1e300, -1e-300, 0, -0.0)
NOT_NEGATIVE = (*NUMBER, -1.0, -1e300, -1e-12)
FRACTION = (*NOT_NEGATIVE, 1.0001, 2, 1e300)
VECTOR = (*ODD, 1.0, (1.0,), (1.0, 2.0, 3.0, 4.0), (1.0, None), (1.0, "a"), ((1.0, 2.0),), (np.inf, 1.0), (0.0, np.nan))
VECTOR_2 = (*VECTOR, (1.0, 2.0, 3.0))
VECTOR_3 = (*VECTOR, (1.0, 2.0))
INTEGER = (*ODD, None, 0, -1, 1.5, 1.0, "3", np.float64(2.0), True)
WORDS = ("text", b"bytes", object(), {}, set(), [None], 1j, np.nan, np.inf, (), np.zeros(0), dr.Disc, None, ("a",))
NAME = (1, 1.5, b"ball", ("ball",), "", "bal", "ball.x", object(), np.nan, ["ball"], {}, np.zeros(2), dr.Disc)
RECORD = ("text", 1.0, 3, object(), dr.Disc, lambda: None, [1.0], {"radius": 1.0}, np.zeros(3), np.nan, (), b"")


def optional(pool):
    """Values that are wrong for an argument that may be None, or empty where that is the default."""
    return tuple(value for value in pool if value is not None)


# ---- scenes

TRIANGLE = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
PYRAMID = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def flat(shape=None, *, options=None, others=None, **changes):
    """A scene in the plane with one argument of its body, or of `scene`, changed."""
    body = dr.Body(dr.Disc(radius=0.1) if shape is None else shape, **{"mass": 1.0, "x": (0.0, 1.0)} | changes)
    return dr.scene({"ball": body, **(others or {})}, **(options or {}))


def deep(shape=None, *, options=None, others=None, **changes):
    body = dr.Body(dr.Sphere(radius=0.1) if shape is None else shape, **{"mass": 1.0, "x": (0.0, 0.0, 1.0)} | changes)
    return dr.scene({"ball": body, **(others or {})}, **(options or {}))


def still(shape=None, **changes):
    static = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)) if shape is None else shape, **changes)
    return flat(others={"floor": static})


def joined(joint):
    """Two discs that are joined, in the plane."""
    other = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(1.0, 1.0))
    return flat(others={"other": other}, options={"joints": {"joint": joint}})


def joined_in_space(joint):
    other = dr.Body(dr.Sphere(radius=0.1), mass=1.0, x=(1.0, 0.0, 1.0))
    return deep(others={"other": other}, options={"joints": {"joint": joint}})


def forced(force):
    return flat(options={"forces": {"force": force}})


def option(name):
    return lambda value: flat(options={name: value})


SHAPES = {
    "Disc.radius": (lambda v: flat(dr.Disc(radius=v)), (*POSITIVE, None)),
    "Sphere.radius": (lambda v: deep(dr.Sphere(radius=v)), (*POSITIVE, None)),
    "Box.half 2D": (lambda v: flat(dr.Box(half=v)), (*VECTOR_2, None, (-1.0, 1.0), (0.0, 0.0))),
    "Box.half 3D": (lambda v: deep(dr.Box(half=v)), (*VECTOR_3, None, (-1.0, 1.0, 1.0), (0.0, 0.0, 0.0))),
    "Capsule.radius": (lambda v: flat(dr.Capsule(radius=v, half_length=1.0)), (*NOT_NEGATIVE, None)),
    "Capsule.half_length": (lambda v: deep(dr.Capsule(radius=0.1, half_length=v)), (*POSITIVE, None)),
    "Polygon.vertices": (
        lambda v: flat(dr.Polygon(vertices=v)),
        (*VECTOR_2, None, TRIANGLE[:2], TRIANGLE[::-1], PYRAMID, (TRIANGLE,), (*TRIANGLE, (np.nan, 0.0)), TRIANGLE * 2),
    ),
    "Hull.vertices": (
        lambda v: deep(dr.Hull(vertices=v)),
        (*VECTOR_3, None, PYRAMID[:3], TRIANGLE, (PYRAMID,), (*PYRAMID, (0.1, 0.1, 0.1)), (*PYRAMID[:3], (1.0, 1.0, 0.0))),
    ),
    "Hull.faces": (
        lambda v: deep(dr.Hull(vertices=PYRAMID, faces=v)),
        (*optional(ODD), 1, 1.0, ((0, 1, 2),), ((0, 1, 7),) * 4, ((0, 1),) * 4, ((0.5, 1, 2),) * 4, "0123"),
    ),
    "HalfSpace.normal": (lambda v: still(dr.HalfSpace(normal=v)), (*VECTOR_2, None, (0.0, 0.0), (0.0, 2.0))),
    "HalfSpace.offset": (lambda v: still(dr.HalfSpace(normal=(0.0, 1.0), offset=v)), (*NUMBER, None)),
    "HeightField.heights": (
        lambda v: deep(others={"ground": dr.Static(dr.HeightField(heights=v, spacing=0.5))}),
        (*(v for v in VECTOR_3 if not isinstance(v, np.ndarray) or v.ndim != 2), None, ((1.0, 2.0),), ((0.0, 0.0), (0.0, np.nan))),
    ),
    "HeightField.spacing": (
        lambda v: deep(others={"ground": dr.Static(dr.HeightField(heights=np.eye(3), spacing=v))}),
        (*POSITIVE, None, 1e-3, 1e-320),
    ),
    "HeightField.cells": (
        lambda v: deep(others={"ground": dr.Static(dr.HeightField(heights=np.eye(3), spacing=0.5, cells=v))}),
        (*optional(INTEGER), 257),
    ),
    "Body.shape": (lambda v: dr.scene({"ball": dr.Body(v, mass=1.0, x=(0.0, 0.0))}), (*RECORD, None)),
    "Static.shape": (lambda v: flat(others={"floor": dr.Static(v)}), (*RECORD, None)),
}  # fmt: skip
BODIES = {
    "mass": (lambda v: flat(mass=v), (*POSITIVE, None)),
    "density": (lambda v: flat(mass=None, density=v), (*POSITIVE, None)),
    "inertia": (lambda v: flat(inertia=v), optional(POSITIVE)),
    "inertia 3D": (
        lambda v: deep(inertia=v),
        (*ODD, (1.0, 1.0), (1.0, 1.0, 3.0), -np.eye(3), np.ones((3, 3)), 0.0, -1.0, np.inf),
    ),
    "x": (lambda v: flat(x=v), (*VECTOR, None)),
    "x 3D": (lambda v: deep(x=v), (*VECTOR_3, None)),
    "v": (lambda v: flat(v=v), VECTOR_2),
    "v 3D": (lambda v: deep(v=v), VECTOR_3),
    "w": (lambda v: flat(w=v), (*ODD, np.inf, (1.0, 2.0), (1.0, 2.0, 3.0))),
    "w 3D": (lambda v: deep(w=v), (*VECTOR_3, 1.0)),
    "angle": (lambda v: flat(angle=v), NUMBER),
    "angle 3D": (lambda v: deep(angle=v), (*NUMBER, 0.1)),
    "q": (lambda v: flat(q=v), (*VECTOR_2, (2.0, 0.0), (0.0, 0.0))),
    "q 3D": (lambda v: deep(q=v), (*VECTOR_3, (2.0, 0.0, 0.0, 0.0), (0.0,) * 4)),
    "restitution": (lambda v: flat(restitution=v), FRACTION),
    "friction": (lambda v: flat(friction=v), NOT_NEGATIVE),
    "Static.x": (lambda v: still(x=v), VECTOR_2),
    "Static.angle": (lambda v: still(angle=v), NUMBER),
    "Static.q": (lambda v: still(q=v), (*VECTOR_2, (2.0, 0.0))),
    "Static.friction": (lambda v: still(friction=v), NOT_NEGATIVE),
}
SCENES = {
    "bodies": (dr.scene, (*RECORD, None, {}, {"a": 1.0}, {1: dr.Body(dr.Disc(radius=1.0), mass=1.0, x=(0.0, 0.0))})),
    "names": (lambda v: dr.scene({v: dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.0))}), (1, "", "a.b", "gravity", 1.5, None, b"a", "contact")),
    "gravity": (option("gravity"), VECTOR_2),
    "scene restitution": (option("restitution"), (*FRACTION, None)),
    "scene friction": (option("friction"), (*NOT_NEGATIVE, None)),
    "contact": (option("contact"), RECORD),
    "forces": (option("forces"), ("text", 1.0, object(), [1.0], {"a": 1.0}, {1: dr.Drag()}, {"ball": dr.Drag()}, dr.Drag(), [dr.Drag], {"a.b": dr.Drag()}, b"x", np.zeros(3))),
    "joints": (option("joints"), ("text", 1.0, object(), [1.0], {"a": 1.0}, {"ball": dr.Weld("ball")}, dr.Weld("ball"), [dr.Weld], b"x", np.zeros(3))),
    "ignore": (option("ignore"), ("text", 1.0, np.ma.masked, object(), [1.0], ["ball"], [("ball",)], [("ball", "bal")], [("ball", 1)], [None], {"a": 1}, [("ball", "ball", "ball")], [[("ball",), "ball"]])),
    "width": (lambda v: flat(options={"contact": dr.Contact(width=v)}), (*NOT_NEGATIVE, None)),
    "rest_speed": (lambda v: flat(options={"contact": dr.Contact(rest_speed=v)}), (*NOT_NEGATIVE, None)),
    "sweeps": (lambda v: flat(options={"contact": dr.Contact(sweeps=v)}), INTEGER),
    "neighbours": (lambda v: flat(options={"contact": dr.Contact(neighbours=v)}), INTEGER),
}  # fmt: skip
FORCES = {
    "Drag.linear": (
        lambda v: forced(dr.Drag(linear=v)),
        (*ODD, None, np.inf, (1.0, 2.0, 3.0), (np.nan, 0.0), -0.1, (0.1, -0.1)),
    ),
    "Drag.angular": (lambda v: forced(dr.Drag(angular=v)), (*NUMBER, None)),
    "GroundFriction.body": (lambda v: forced(dr.GroundFriction(v, friction=0.1)), NAME),
    "GroundFriction.friction": (lambda v: forced(dr.GroundFriction(friction=v)), (*NUMBER, None, -0.1)),
    "GroundFriction.arm": (lambda v: forced(dr.GroundFriction(friction=0.1, arm=v)), (*NUMBER, -0.1)),
    "Force.body": (lambda v: forced(dr.Force(body=v, F=(1.0, 0.0))), (*NAME, None)),
    "Force.F": (lambda v: forced(dr.Force(body="ball", F=v)), (*ODD, None, (1.0, 2.0, 3.0), np.inf)),
    "Force.point": (lambda v: forced(dr.Force(body="ball", F=1.0, point=v)), (*ODD, (1.0, 2.0, 3.0))),
    "Force.control": (lambda v: forced(dr.Force(body="ball", F=1.0, control=v)), (1.0, ["a"], {}, object())),
    "Torque.tau": (lambda v: forced(dr.Torque(body="ball", tau=v)), (*ODD, None, (1.0, 2.0), np.inf)),
    "Torque.body": (lambda v: forced(dr.Torque(body=v, tau=1.0)), (*NAME, None)),
    "Spring.stiffness": (
        lambda v: forced(dr.SpringDamper(a="ball", anchor_a=0.0, anchor_b=0.0, stiffness=v)),
        (*NUMBER, None),
    ),
    "Spring.a": (lambda v: forced(dr.SpringDamper(a=v, anchor_a=0.0, anchor_b=0.0, stiffness=1.0)), (*NAME, None)),
    "Spring.b": (
        lambda v: forced(dr.SpringDamper(a="ball", b=v, anchor_a=0.0, anchor_b=0.0, stiffness=1.0)),
        (*NAME, "ball"),
    ),
    "Spring.anchor_b": (
        lambda v: forced(dr.SpringDamper(a="ball", anchor_a=0.0, anchor_b=v, stiffness=1.0)),
        (*ODD, None),
    ),
}


def revolute(**changes):
    return joined(dr.Revolute("other", "ball", **{"anchor_a": (0.0, 0.0)} | changes))


def slider(**changes):
    return joined(dr.Prismatic("other", "ball", **{"axis_b": (1.0, 0.0)} | changes))


def hinge(**changes):
    return joined_in_space(dr.Revolute("other", "ball", **{"anchor_a": 0.0, "axis_a": (0.0, 0.0, 1.0)} | changes))


JOINTS = {
    "joint a": (lambda v: joined(dr.Ball(v, "ball", anchor_a=0.0)), (*NAME, None)),
    "joint b": (lambda v: joined(dr.Ball("other", v, anchor_a=0.0)), (*NAME, "other")),
    "Revolute.anchor_a": (lambda v: revolute(anchor_a=v), (*ODD, None, (1.0, 2.0, 3.0))),
    "Revolute.anchor_b": (lambda v: revolute(anchor_b=v), (*ODD, (1.0, 2.0, 3.0), (7.0, 7.0))),
    "Revolute.lower": (lambda v: revolute(lower=v), (*NUMBER, 1.0)),
    "Revolute.upper": (lambda v: revolute(upper=v), (*NUMBER, -1.0)),
    "Revolute.restitution": (lambda v: revolute(lower=-1.0, restitution=v), FRACTION),
    "Revolute.friction": (lambda v: revolute(friction=v), NOT_NEGATIVE),
    "Revolute.speed": (lambda v: revolute(friction=1.0, speed=v), NUMBER),
    "Revolute.damping": (lambda v: revolute(damping=v), NOT_NEGATIVE),
    "Revolute.axis_a": (lambda v: hinge(axis_a=v), (*ODD, None, (0.0, 0.0, 0.0), (1.0, 0.0))),
    "Revolute.axis_b": (lambda v: hinge(axis_b=v), (*ODD, (0.0, 0.0, 0.0), (1.0, 0.0), (1.0, 0.0, 0.0))),
    "Prismatic.axis_b": (lambda v: slider(axis_b=v), (*ODD, None, (0.0, 0.0), (1.0, 0.0, 0.0))),
    "Prismatic.q": (lambda v: slider(q=v), (*ODD, (0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0))),
    "Prismatic.lower": (lambda v: slider(lower=v), (*NUMBER, 5.0)),
    "Distance.length": (lambda v: joined(dr.Distance("other", "ball", anchor_b=0.0, length=v)), POSITIVE),
    "Distance.anchor_b": (lambda v: joined(dr.Distance("other", "ball", anchor_b=v)), (*ODD, None)),
}  # fmt: skip

# ---- runs and fits


@cache
def pair():
    return flat(options={"gravity": (0.0, -9.81)})


@cache
def many():
    world, state = pair()
    return world, dr.replace(state, x=jnp.zeros((2, 1, 2)))


T = np.linspace(0.0, 1.0, 5)
DATA = {"t": T, "ball.x": np.zeros((5, 2))}
FREE = {"ball.v": dr.real()}


def fitted(**changes):
    arguments = {"observations": DATA, "free": FREE, "progress": False} | changes
    return dr.fit(*pair(), arguments.pop("observations"), **arguments)


def planned(**changes):
    arguments = {"planned": {"t": T, "ball.x": None}, "free": FREE, "noise": {"ball.x": 1.0}} | changes
    return dr.sysid.expected_intervals(*pair(), **arguments)


def roll(**changes):
    return dr.rollout(*pair(), **{"dt": 0.1, "steps": 2} | changes)


TIMES = (*WORDS, 1.0, (0.0,), (0.0, 0.0), (1.0, 0.0), (0.0, np.nan), (0.0, np.inf), ((0.0, 1.0),), "ab")
RUNS = {
    "step world": (lambda v: dr.step(v, pair()[1], 0.1), (*RECORD, None, pair)),
    "step state": (lambda v: dr.step(pair()[0], v, 0.1), (*RECORD, None, pair)),
    "step dt": (lambda v: dr.step(*pair(), v), (*POSITIVE, None)),
    "rollout dt": (lambda v: roll(dt=v), (*POSITIVE, None)),
    "rollout steps": (lambda v: roll(steps=v), INTEGER),
    "rollout times": (lambda v: roll(steps=None, times=v), (*TIMES, None)),
    "rollout substeps": (lambda v: roll(steps=None, times=(0.0, 0.1, 0.2), substeps=v), (*ODD, 1, (1,), (1, 1, 1), (0, 1), (1.5, 1), (-1, 1), "ab", (None, 1), {1, 2})),
    "rollout times, substeps": (lambda v: roll(steps=None, times=v, substeps=(1, 1)), ((0.0, 0.2, 0.1), (0.0, 0.1, 0.1))),
    "rollout steps, substeps": (lambda v: roll(substeps=v), ((1, 1), [2], 1)),
    "rollout state.x": (lambda v: dr.rollout(pair()[0], dr.replace(pair()[1], x=v), dt=0.1, steps=1), WORDS),
    "rollout world.mass": (lambda v: dr.rollout(dr.replace(pair()[0], bodies=v), pair()[1], dt=0.1, steps=1), RECORD),
    "batch world": (lambda v: dr.rollout_batch(v, many()[1], dt=0.1, steps=1), (*RECORD, None)),
    "batch state": (lambda v: dr.rollout_batch(many()[0], v, dt=0.1, steps=1), (*RECORD, None, pair()[1])),
    "batch state.v": (lambda v: dr.rollout_batch(many()[0], dr.replace(many()[1], v=v), dt=0.1, steps=1), (*ODD, np.zeros((3, 1, 2)), np.zeros((2, 1, 3)), 1.0)),
    "batch state.v type": (lambda v: dr.rollout_batch(many()[0], dr.replace(many()[1], v=v), dt=0.1, steps=1), (None, np.zeros((2, 1, 2), int))),
    "rollout world.shapes": (lambda v: dr.rollout(dr.replace(pair()[0], shapes=(dr.Disc(radius=v),)), pair()[1], dt=0.1, steps=1), (np.ones(2), np.ones((0,)), 1.0)),
    "batch dt": (lambda v: dr.rollout_batch(*many(), dt=v, steps=1), (*POSITIVE, None)),
    "batch steps": (lambda v: dr.rollout_batch(*many(), dt=0.1, steps=v), INTEGER),
    "batch chunk": (lambda v: dr.rollout_batch(*many(), dt=0.1, steps=1, chunk=v), tuple(v for v in INTEGER if v is not None and v is not HUGE)),
    "rollout memory": (lambda v: roll(steps=1, memory=v), tuple(v for v in INTEGER if v is not HUGE)),
    "batch memory": (lambda v: dr.rollout_batch(*many(), dt=0.1, steps=1, memory=v), tuple(v for v in INTEGER if v is not HUGE)),
    "missed_pairs world": (lambda v: dr.missed_pairs(v, pair()[1], 0.1), (*RECORD, None, pair)),
    "missed_pairs state.v": (lambda v: dr.missed_pairs(pair()[0], dr.replace(pair()[1], v=v), 0.1), (None,)),
    "missed_pairs dt": (lambda v: dr.missed_pairs(*pair(), v), (*POSITIVE, None)),
    "play": (dr.play, (*RECORD, None, {"a": 1.0}, {})),
}  # fmt: skip
FITS = {
    "observations": (lambda v: fitted(observations=v), (*RECORD, None, {}, [], {"t": T}, {"ball.x": T}, {**DATA, "bal.x": T}, [{}])),
    "t": (lambda v: fitted(observations={**DATA, "t": v}), (*TIMES, None)),
    "column": (lambda v: fitted(observations={"t": T, "ball.x": v}), (*ODD, None, 1.0, T, np.full((5, 2), np.nan), np.full((5, 2), np.inf), np.zeros((4, 2)), (T, T), (T,))),
    "column names": (lambda v: fitted(observations={"t": T, v: np.zeros((5, 2))}), ("", "bal", "ball.mass", "ball.x[7]", "ball.x[-1]", 1, None, ("a",))),
    "free": (lambda v: fitted(free=v), (*RECORD, None, {}, {"ball.v": 1.0}, {"bal": dr.real()}, {1: dr.real()}, {(): dr.real()}, {None: dr.real()}, {("ball.v", "ball.mass"): dr.real()}, {"ball.v": dr.direction(), "ball.mass": dr.inertia()}, {"ball.x": dr.rotation()}, {"ball.q": dr.real()}, {("ball.x", "ball.v"): dr.shares()})),
    "starts": (lambda v: fitted(starts=v), INTEGER),
    "iterations": (lambda v: fitted(iterations=v), tuple(v for v in optional(INTEGER) if v is not HUGE)),
    "seed": (lambda v: fitted(seed=v), ("a", -1, 1.5, None, object(), np.nan, [1.5])),
    "fit dt": (lambda v: fitted(dt=v), POSITIVE),
    "noise": (lambda v: fitted(noise=v), (*RECORD, {"ball.x": -1.0}, {"ball.x": 0.0}, {"bal": 1.0}, {"ball.x": "a"}, {"ball.x": np.nan}, {"ball.x": np.ones(3)}, {"ball.x": None})),
    "observe": (lambda v: fitted(observe=v), (*RECORD, {"ball.x": 1.0}, {"bal": "ball.x"}, {"ball.x": "bal.x"}, {"ball.x": dr.Marker("bal")}, {"ball.x": dr.Marker("ball", point=(1.0, 2.0, 3.0))}, {"ball.x": None}, {"ball.x": dr.Separation("ball", 1.0)}, {"ball.x": dr.Disc(radius=1.0)}, {"ball.x": lambda s: "a"}, {"ball.x": lambda: 1.0})),
    "widths": (lambda v: fitted(widths=v), ("a", 1.0, (), (-1.0,), ("a",), (np.nan,), (np.inf,), object(), (None,), ((0.1,),))),
    "windows": (lambda v: fitted(windows=v), ("a", 1.0, None, (), (0.0,), ("a",), (np.nan,), object(), (None,), (-1.0,), (2.0, 1.0))),
    "loss": (lambda v: fitted(loss=v), (*RECORD, None)),
    "solver": (lambda v: fitted(solver=v), ("a", 1.0, object(), {}, [])),
    "intervals": (lambda v: fitted(intervals=v), ("a", 1.0, object(), None, {})),
    "resume": (lambda v: fitted(resume=v), ("a", 1.0, object(), {}, [1.0], Path("x"))),
    "Record": (lambda v: fitted(observations=[dr.Record(v)]), (*RECORD, None)),
    "Record.state": (lambda v: fitted(observations=[dr.Record(DATA, state=v)]), RECORD),
    "Record.world": (lambda v: fitted(observations=[dr.Record(DATA, world=v)]), RECORD),
    "Record.start": (lambda v: fitted(observations=[dr.Record(DATA, start=v)]), (*NUMBER, 0.5)),
    "Record.noise": (lambda v: fitted(observations=[dr.Record(DATA, noise=v)]), (*RECORD, {"bal": 1.0}, {"ball.x": -1.0}, {"ball.x": "a"})),
    "interval": (lambda v: dr.interval(v, 1.0), (*NUMBER, None, 1.0, 2.0)),
    "interval high": (lambda v: dr.interval(0.0, v), (*NUMBER, None, 0.0, -1.0)),
    "positive": (dr.positive, (*NOT_NEGATIVE, None)),
    "real": (dr.real, (*NOT_NEGATIVE, None)),
    "direction": (dr.direction, (*NOT_NEGATIVE, None)),
    "each": (lambda v: fitted(free={"ball.v": dr.each(v)}), (*RECORD, None)),
    "prior": (lambda v: dr.prior(dr.real(), v, 1.0), WORDS),
    "prior deviation": (lambda v: dr.prior(dr.real(), 1.0, v), (*WORDS, 0.0, -1.0, (1.0, 2.0))),
    "prior kind": (lambda v: fitted(free={"ball.v": dr.prior(v, 1.0, 1.0)}), (*RECORD, None)),
    "prior of wrong size": (lambda v: fitted(free={"ball.v": dr.prior(dr.real(), v, 1.0)}), ((1.0, 2.0, 3.0),)),
    "through": (lambda v: dr.through(v, dr.real(), 1.0), (*RECORD, None)),
    "through start": (lambda v: dr.through(dr.paths.write, dr.real(), v), WORDS),
    "through kind": (lambda v: fitted(free={"own": dr.through(lambda w, s, _: (w, s), v, 1.0)}), (*RECORD, None)),
    "through write": (lambda v: fitted(free={"own": dr.through(lambda *_: v, dr.real(), 1.0)}), (*RECORD, None)),
    "huber": (dr.huber, (*POSITIVE, None)),
    "student": (dr.student, (*POSITIVE, None)),
    "load_fit": (dr.load_fit, ("nowhere.json", None, 1.5, 0, "", ".", object(), {}, [])),
    "profile fit": (lambda v: dr.profile(v, "ball.v"), (*RECORD, None)),
    "sample fit": (dr.sample, (*RECORD, None)),
    "jumps fit": (dr.sysid.jumps, (*RECORD, None)),
    "CSV": (lambda v: fitted(observations=v), ("nowhere.csv", "", ".", Path("nowhere"), "\udd00")),
    "load_scene": (dr.load_scene, ("nowhere.json", None, 1.5, 0, "", ".", object(), {}, [])),
    "read_scene": (read_scene, ("nowhere.toml", None, 1.5, 10**6, "", ".", object(), {}, [])),
    "planned": (lambda v: planned(planned=v), (*RECORD, None, {}, [], {"ball.x": None}, {"t": T}, {"t": T, 1: None}, {"t": T, "bal.x": None})),
    "planned t": (lambda v: planned(planned={"t": v, "ball.x": None}), (*TIMES, None)),
    "planned column": (lambda v: planned(planned={"t": T, "ball.x": v}), (*ODD, 1.0, T, np.zeros((4, 2)), (T, T))),
    "planned noise": (lambda v: planned(noise=v), (*RECORD, None, {}, {"bal": 1.0}, {1: 1.0}, {"ball.x": "a"}, {"ball.x": -1.0})),
    "launch planned": (lambda v: dr.sysid.best_launch(*pair(), v, free=FREE, noise={"ball.x": 1.0}, vary=FREE), (*RECORD, None, {"ball.x": None})),
    "segments count": (lambda v: dr.segments(*pair(), DATA, v), INTEGER),
    "segments": (lambda v: dr.segments(*pair(), v, 2), (*RECORD, None)),
}  # fmt: skip
TABLE = SHAPES | BODIES | SCENES | FORCES | JOINTS | RUNS | FITS


def refused(call, *values):
    """None if the call is refused in the words of the library, else what happened instead."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            made = call(*values)
    except (ValueError, TypeError, OSError) as error:
        frame = error.__traceback__
        while frame.tb_next is not None:
            frame = frame.tb_next
        file = frame.tb_frame.f_code.co_filename
        line = linecache.getline(file, frame.tb_lineno)
        ours = file.startswith(PACKAGE) and "raise" in line or isinstance(error, OSError) or "os.PathLike" in str(error)
        return (
            None if ours and str(error) else f"{type(error).__name__} from {Path(file).name}:{frame.tb_lineno}: {error}"
        )
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return f"made {type(made).__name__}"


def cases():
    """(argument, value): all of them in a random order, COUNT at most."""
    pairs = [(name, k) for name, (_, pool) in TABLE.items() for k in range(len(pool))]
    return [pairs[i] for i in np.random.default_rng(0).permutation(len(pairs))[:COUNT]]


def report(failed, count):
    assert not failed, "\n".join([f"{len(failed)} of {count}:", *sorted(failed)])


def test_nonsense_is_refused_in_words():
    failed = []
    for number, (name, k) in enumerate(cases()):
        if number % 200 == 199:  # what some of them compile fills gigabytes
            jax.clear_caches()
        call, pool = TABLE[name]
        if problem := refused(call, pool[k]):
            failed.append(f"{name} = {pool[k]!r:.60}: {problem:.200}")
    report(failed, len(cases()))


def test_two_mistakes_are_as_good_as_one():
    rng, failed = np.random.default_rng(1), []
    fields = [name for name in BODIES if " " not in name and "." not in name and name != "density"]
    for _ in range(COUNT):
        pick = rng.choice(fields, 2, replace=False)
        values = {name: BODIES[name][1][rng.integers(len(BODIES[name][1]))] for name in pick}
        if problem := refused(lambda values: flat(**values), values):
            failed.append(f"{values!r:.80}: {problem:.200}")
    report(failed, COUNT)


# ---- numbers that overflow


EXTREME = (1e308, 1e200, 1e155, 1e-155, 1e-200, 1e-308, 5e-324, np.float64(1e300))
SCALED = {
    "Disc.radius": lambda v: flat(dr.Disc(radius=v)),
    "Disc.radius and density": lambda v: flat(dr.Disc(radius=v), mass=None, density=v),
    "Sphere.radius": lambda v: deep(dr.Sphere(radius=v), mass=None, density=1.0),
    "Box.half": lambda v: flat(dr.Box(half=(v, 1.0))),
    "Box.half 3D": lambda v: deep(dr.Box(half=(v, v, v)), mass=None, density=1.0),
    "Capsule": lambda v: deep(dr.Capsule(radius=v, half_length=v)),
    "Polygon": lambda v: flat(dr.Polygon(vertices=[[v * float(x) for x in row] for row in TRIANGLE])),
    "Hull": lambda v: deep(dr.Hull(vertices=[[v * float(x) for x in row] for row in PYRAMID])),
    "mass": lambda v: flat(mass=v),
    "inertia": lambda v: deep(inertia=v),
    "x": lambda v: flat(x=(v, v), others={"other": dr.Body(dr.Box(half=(1.0, 1.0)), mass=1.0, x=(-1.0, -1.0))}),
    "v": lambda v: flat(v=(v, v)),
    "w": lambda v: deep(w=(v, v, v)),
    "angle": lambda v: flat(angle=v),
    "q": lambda v: flat(q=(v, v)),
    "gravity": lambda v: flat(options={"gravity": (v, v)}),
    "friction": lambda v: flat(friction=v),
    "offset": lambda v: still(dr.HalfSpace(normal=(0.0, 1.0), offset=v)),
    "normal": lambda v: still(dr.HalfSpace(normal=(v, v))),
    "width": lambda v: flat(options={"contact": dr.Contact(width=v)}),
    "axis": lambda v: slider(axis_b=(v, v)),
    "anchor": lambda v: joined(dr.Revolute("other", "ball", anchor_a=(v, v))),
    "length": lambda v: joined(dr.Distance("other", "ball", anchor_b=0.0, length=v)),
    "spring": lambda v: forced(dr.SpringDamper(a="ball", anchor_a=v, anchor_b=v, stiffness=v)),
    "dt": lambda v: dr.rollout(*pair(), dt=v, steps=2).t,
}  # fmt: skip


@pytest.mark.parametrize("name", SCALED)
def test_extreme_numbers_are_refused_or_stay_finite(name):
    failed = []
    for value in EXTREME:
        problem = refused(lambda value: check_finite(SCALED[name](value)), value)
        if problem and problem != "made bool":
            failed.append(f"{value!r}: {problem:.200}")
    report(failed, len(EXTREME))


def check_finite(made):
    for leaf in jax.tree.leaves(made):
        assert np.isfinite(leaf).all(), f"silently made {leaf}"
    return True


# ---- files, which `test_nonsense` spoils


SCENE = """
gravity = [0.0, -9.81]
restitution = 0.5
ignore = [["ball", "floor"]]
contact = { width = 0.0 }
[bodies.ball]
shape = { disc = { radius = 0.1 } }
mass = 1.0
x = [0.0, 1.0]
[statics.floor]
shape = { half_space = { normal = [0.0, 1.0] } }
[forces]
air = { drag = { linear = 0.1 } }
[joints]
pin = { revolute = { a = "ball", anchor_a = [0.0, 0.5] } }
[free]
restitution = { interval = [0, 1] }
"ball.v" = "real"
[observe]
tip = { marker = { body = "ball", point = [0.1, 0.0] } }
[fit]
starts = 8
"""
SAVED = {
    "parameters": [{"name": "ball.mass", "value": 1.0, "low": 0.5, "high": 2.0, "unit": "kg", "note": ""}],
    "noise": {"ball.x": 1e-3}, "costs": [1.0], "agree": 1, "orders": [], "notes": [], "seed": 0, "seconds": 1.0,
    "versions": {},
}  # fmt: skip


def saved_scene():
    """What `save_scene` writes."""
    with TemporaryDirectory() as where:
        return dr.save_scene(Path(where, "scene.json"), *pair()).read_text()
