"""Fits of bodies that are pushed: columns with the name of a control act, and are not compared with anything."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid import sysid
from diffrigid.impacts import contacts

MASS, SPEED = 1.7, 0.3
CHANGES = np.array([0.0, 0.11, 0.37, 0.52, 0.8])  # [s] and the pushes from then on
PUSHES = np.array([[2.0, 0.5], [-3.0, 1.0], [0.0, -4.0], [5.0, 0.0], [1.0, 1.0]])
T = np.arange(21) / 20


def puck(mass=1.0, speed=0.0):
    body = dr.Body(None, mass=mass, inertia=1.0, x=(0.0, 0.0), v=(speed, 0.0))
    return dr.scene({"p": body}, forces=[dr.Force(body="p", control="push")])


def place(t):
    """Of the puck: twice the integral of the pushes."""
    since = np.clip(np.asarray(t)[:, None] - CHANGES, 0.0, None)
    steps = np.diff(PUSHES, axis=0, prepend=np.zeros((1, 2)))
    return np.array([SPEED, 0.0]) * np.asarray(t)[:, None] + 0.5 / MASS * since**2 @ steps


RECORD = {"t": T, "p.x": place(T), "push": (CHANGES, PUSHES)}
FREE = {"p.mass": dr.positive(), "p.v": dr.real()}


def test_pushes_that_change_between_the_measured_times_tell_the_mass():
    found = dr.fit(*puck(), RECORD, free=FREE, noise={"p.x": 1e-6}, progress=False)
    assert_allclose(found["p.mass"].value, MASS, rtol=1e-9)
    assert_allclose(found["p.v"].value, (SPEED, 0.0), atol=1e-9)
    times = np.array([0.2, 0.45, 0.9])
    motion = found.predict(times)
    assert_allclose(motion.state.x[:, 0], place(times), atol=1e-9)
    mean = (0.17 * PUSHES[1] + 0.08 * PUSHES[2]) / 0.25, (0.07 * PUSHES[2] + 0.28 * PUSHES[3] + 0.1 * PUSHES[4]) / 0.45
    assert_allclose(motion.controls["push"], mean, rtol=1e-12)
    assert_allclose(found.score(RECORD)["p.x"], 0.0, atol=1e-9)


def test_records_have_pushes_of_their_own():
    shift = np.array([1.5, 0.0])  # pushes harder from the start on
    harder = {"t": T, "p.x": place(T) + 0.5 * T[:, None] ** 2 * shift / MASS, "push": (CHANGES, PUSHES + shift)}
    found = dr.fit(*puck(), [RECORD, harder], free=FREE, progress=False)
    assert_allclose(found["p.mass"].value, MASS, rtol=1e-9)


def test_a_late_clock_of_what_is_pushed():
    late, free = 0.013, {"p.mass": dr.positive(), "p.x.clock": dr.real()}
    record = dr.Record({"t": T[1:], "p.x": place(T[1:] - late), "push": (CHANGES, PUSHES)}, start=0.0)
    found = dr.fit(*puck(speed=SPEED), record, free=free, noise={"p.x": 1e-6}, progress=False)
    assert_allclose(found["p.mass"].value, MASS, rtol=1e-7)
    assert_allclose(found["p.x.clock"].value, late, rtol=1e-7)


def test_pushes_in_a_file(tmp_path):
    """One column for each component; each value holds until the next row."""
    rows = np.column_stack([T, np.repeat(PUSHES, 5, axis=0)[: len(T)]])
    x = 0.5 / MASS * np.clip(T[:, None] - T, 0, None) ** 2 @ np.diff(rows[:, 1:], axis=0, prepend=np.zeros((1, 2)))
    table = np.column_stack([rows[:, :1], x, rows[:, 1:]])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="t,p.x[0],p.x[1],push[0],push[1]", comments="")
    found = dr.fit(*puck(), tmp_path / "run.csv", free=FREE, progress=False)
    assert_allclose(found["p.mass"].value, MASS, rtol=1e-7)


def test_pieces_of_a_record_are_pushed_as_the_whole():
    found = sysid.fit_in_pieces(*puck(), RECORD, 3, free=FREE, progress=False)
    assert_allclose(found["p.mass"].value, MASS, rtol=1e-8)


def test_what_pushes_is_not_taken_for_contact():
    """A ball on the ground that is pressed down: the ground carries the weight and the push."""
    ball = dr.Body(dr.Disc(radius=0.1), mass=MASS, x=(0.0, 0.1))
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    press = dr.Force(body="ball", F=(0.0, 0.0), control="press")
    world, state = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), forces=[press])
    down = jnp.stack([jnp.zeros(6), jnp.array([0.0, 3.0, 8.0, 0.0, -5.0, 1.0])], 1)
    motion = dr.rollout(world, state, dt=0.1, steps=6, controls={"press": -down})
    found = contacts(motion, np.asarray(motion.t))
    assert_allclose(found.impulse[:, 1], 0.1 * (9.81 * MASS + down[:, 1]), rtol=1e-8)
    assert not found.impact.any()


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"pushes": np.zeros(30)}, r"no column 'pushes' in .*did you mean 'push'"),
        ({"push": None}, r"observations has no column 'push', which a force takes as its control: give zeros"),
        ({"push": (CHANGES + 0.01, PUSHES)}, r"observations\['push'\] begins at 0.01 s, after the start 0 s"),
        ({"push": (CHANGES, PUSHES * np.nan)}, r"observations\['push'\] has NaN: expected numbers"),
        ({"push": (CHANGES, PUSHES[:, :1])}, r"observations\['push'\] has one number a row, expected 2"),
        ({"p.x": None}, "nothing is measured"),
    ],
)
def test_mistakes_are_named(changed, message):
    record = {name: value for name, value in (RECORD | changed).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        dr.fit(*puck(), record, free=FREE, progress=False)
