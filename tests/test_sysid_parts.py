"""The parts of a fit that have exact answers on their own: kinds, sensors, records, losses, tests of residuals, files."""

import contextlib
import io
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import diffrigid as dr
from diffrigid import sysid
from diffrigid.__main__ import main
from diffrigid.impacts import order_of_impacts
from diffrigid.scene_file import read_scene
from diffrigid.step import steps_in
from diffrigid.sysid.columns import columns, read_csv
from diffrigid.sysid.diagnosis import Blind, coordinates, doubts, normality, whiteness
from diffrigid.sysid.intervals import interval_of, unseen_of
from diffrigid.sysid.levenberg import Numbers, Point, minimise
from diffrigid.sysid.losses import Squares
from diffrigid.sysid.orders import in_words
from diffrigid.sysid.parameters import Slot
from diffrigid.sysid.sampling import Posterior
from diffrigid.sysid.sensors import channel_of, difference, predict
from diffrigid.sysid.summary import Parameter, Summary
from diffrigid.sysid.table import BLIND, rows_of

WORLD, STATE = dr.scene(
    {
        "cue": dr.Body(None, mass=1.0, inertia=1.0, x=(1.0, 2.0), angle=0.5, v=(3.0, 0.0)),
        "ball": dr.Body(None, mass=2.0, inertia=1.0, x=(4.0, 6.0)),
    }
)
SOLID, SOLID_STATE = dr.scene({"die": dr.Body(None, mass=1.0, inertia=(1.0, 1.0, 1.0), x=(0.2, -0.4, 5.0))})
T = np.arange(6) / 10


# ---- kinds of parameters


@pytest.mark.parametrize("shape, kind", [((2,), dr.direction()), ((3,), dr.direction())])
def test_directions_keep_their_length(shape, kind):
    reference = jnp.arange(1.0, 1 + shape[0])
    value = kind.value(0.7 * jnp.ones(kind.size(shape)), reference)
    assert_allclose((value**2).sum(), (reference**2).sum(), rtol=1e-12)
    assert_allclose(kind.value(jnp.zeros(kind.size(shape)), reference), reference, atol=1e-14)
    turn = np.arccos(value @ reference / (reference @ reference))
    assert_allclose(turn, 0.7 * np.sqrt(kind.size(shape)), rtol=1e-9)  # z is the angle


def test_every_inertia_is_one_of_some_masses():
    random, kind = np.random.default_rng(0), dr.inertia()
    reference = jnp.diag(jnp.array([0.2, 0.3, 0.25]))
    assert_allclose(kind.value(jnp.zeros(6), reference), reference, atol=1e-15)
    for _ in range(20):
        principal = np.linalg.eigvalsh(kind.value(jnp.asarray(2 * random.normal(size=6)), reference))
        assert principal[0] > 0 and principal[2] < principal[0] + principal[1]
    slopes = jax.jacfwd(kind.value)(jnp.zeros(6), reference)[np.triu_indices(3)]
    assert np.linalg.matrix_rank(slopes) == 6  # every symmetric change is reached
    with pytest.raises(ValueError, match=r"expected \(3, 3\)"):
        kind.size(())


def test_principal_moments_of_an_inertia_change_along_axes_that_stay():
    random, kind = np.random.default_rng(0), dr.inertia(principal=True)
    axes = np.asarray(dr.so3.rotate(dr.so3.exp(jnp.array([0.3, -0.5, 0.8]))[:, None], jnp.eye(3)))
    reference = jnp.asarray(axes @ np.diag([0.2, 0.3, 0.25]) @ axes.T)
    assert kind.size((3, 3)) == 3
    assert_allclose(kind.value(jnp.zeros(3), reference), reference, atol=1e-15)
    for _ in range(20):
        along = axes.T @ np.asarray(kind.value(jnp.asarray(2 * random.normal(size=3)), reference)) @ axes
        assert_allclose(along - np.diag(np.diag(along)), 0.0, atol=1e-12)
        principal = np.sort(np.diag(along))
        assert principal[0] > 0 and principal[2] < principal[0] + principal[1]
    ball = 0.1 * jnp.eye(3)
    assert np.isfinite(jax.jacfwd(kind.value)(jnp.zeros(3), ball)).all()  # whose axes are any
    with pytest.raises(ValueError, match="principal is 3"):
        dr.inertia(principal=3)


def test_shares_keep_their_sum_and_take_any_ratio():
    kind, reference = dr.shares(), jnp.array([1.0, 3.0, 4.0])
    value = kind.value(jnp.array([0.4, -1.0]), reference)
    assert_allclose(value.sum(), 8.0, rtol=1e-12)
    assert_allclose(np.log(value[1:] / value[0]), np.log([3.0, 4.0]) + [0.4, -1.0], rtol=1e-12)


def test_rotation_is_a_turn_of_the_start():
    kind, q = dr.rotation(), jnp.array([0.6, 0.8, 0.0, 0.0])
    value = kind.value(jnp.array([0.0, 0.0, 0.3]), q)
    assert_allclose(value, dr.so3.compose(dr.so3.exp(jnp.array([0.0, 0.0, 0.3])), q), atol=1e-14)


def test_what_is_not_finite_is_kept_in_a_file(tmp_path):
    parameter = Parameter("a", np.array([1.0, 2.0]), np.array([-np.inf, 0.0]), np.array([np.inf, np.nan]), "m", "")
    kept = Summary((parameter,), {"ball.x": np.nan}, np.array([1.0, np.inf]), 1, (), (), 0, 1.0, {})
    path = kept.save(tmp_path / "fit.json")
    json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    again = dr.load_fit(path)
    for field in ("value", "low", "high"):
        assert_array_equal(getattr(again["a"], field), getattr(parameter, field))
    assert_array_equal(again.costs, kept.costs)
    assert np.isnan(again.noise["ball.x"])


def test_numbers_that_were_fitted_together_have_their_own_names():
    ends = [np.array(pair) for pair in ([1.0, 3.0], [0.9, 2.9], [1.1, 3.1])]
    shares, tied = Parameter("a.mass : b.mass", *ends, "kg", ""), Parameter("a.x = b.x", *ends, "m", "")
    fit = Summary((shares, tied), {}, np.zeros(1), 1, (), (), 0, 1.0, {})
    assert (fit["b.mass"].value, fit["b.mass"].low, fit["a.mass"].high) == (3.0, 2.9, 1.1)
    assert_array_equal(fit["b.x"].value, [1.0, 3.0])


def test_a_posterior_of_a_component_prints_its_table():
    parameter = Parameter("a.v[1]", *(np.asarray(end) for end in (1.0, 0.9, 1.1)), "m/s", "")
    fit = Summary((parameter,), {}, np.zeros(1), 1, (), (), 0, 1.0, {})
    lines = repr(Posterior({}, (parameter,), {"a.v[1]": 1.002}, {"a.v[1]": 345.0}, fit, ())).splitlines()
    assert lines[2].startswith("a.v[1]") and "1.002" in lines[2] and "345" in lines[2]


def test_a_clock_that_jitters_takes_one_step_for_each_frame():
    """Times to a tenth of a millisecond, and in single precision."""
    t = np.round(np.arange(60) / 60 * 1.0003, 4)
    data = {"t": t, "cue.x": np.zeros((60, 2))}
    problem = sysid.make_problem(WORLD, STATE, data, free={"cue.v": dr.real()})
    assert problem.groups[0].data.lengths.shape[0] == 59
    single = (np.arange(36, dtype=np.float32) / np.float32(30)).astype(float)
    assert (steps_in(np.diff(single), 1 / 30) == 1).all() and steps_in(np.array([35 / 30]), np.float32(1 / 30)) == 35


def test_a_start_at_zero_of_a_positive_parameter_is_moved_off():
    assert_allclose(np.exp(dr.positive().unbounded(np.array([0.0, 0.2]))), [1e-3, 0.2])


# ---- sensors


def reading(what, world=WORLD, state=STATE):
    channel = jax.tree.map(jnp.asarray, channel_of("c", what, world))
    return np.asarray(predict(channel, world, jax.tree.map(lambda leaf: leaf[None], state)))[0]


def test_observers_read_what_geometry_says():
    c, s = np.cos(0.5), np.sin(0.5)
    point = (1.0 + 0.3 * c - 0.1 * s, 2.0 + 0.3 * s + 0.1 * c)
    assert_allclose(reading("cue.x"), (1.0, 2.0))
    assert_allclose(reading("cue.angle"), (0.5,))
    assert_allclose(reading(dr.Marker("cue", point=(0.3, 0.1))), point)
    assert_allclose(reading(dr.Separation("cue", dr.Marker("ball"))), (5.0,))
    assert_allclose(reading(lambda state: state.x[1] - state.x[0]), (3.0, 4.0))
    assert_allclose(reading(lambda state: state.v[0, 0]), (3.0,))
    assert_allclose(reading(dr.Channel("cue.x", bias=(0.1, 0.0), scale=2.0)), (2.1, 4.0))
    assert_allclose(reading("cue.x[1]"), (2.0,))
    with pytest.raises(ValueError, match=r"cue.x has 2 numbers"):
        reading("cue.x[2]")


def test_cameras():
    matrix = np.array([[200.0, 10.0, 5.0], [0.0, -150.0, 400.0], [0.1, 0.0, 1.0]])
    u = matrix @ (1.0, 2.0, 1.0)
    assert_allclose(reading(dr.Homography("cue", matrix=matrix)), u[:2] / u[2])
    camera = dr.Pinhole("die", x=(0.0, 0.0, 1.0), q=(1.0, 0.0, 0.0, 0.0), focal=800.0, center=(320.0, 240.0))
    assert_allclose(reading(camera, SOLID, SOLID_STATE), (320 + 800 * 0.2 / 4, 240 - 800 * 0.4 / 4))


def test_angles_are_compared_up_to_full_turns():
    states = jax.tree.map(lambda leaf: leaf[None], STATE)
    channel = jax.tree.map(jnp.asarray, channel_of("cue.angle", "cue.angle", WORLD))
    assert_allclose(difference(channel, WORLD, states, jnp.array([[0.4 + 6 * np.pi]])), [[0.1]], atol=1e-12)
    channel = jax.tree.map(jnp.asarray, channel_of("cue.q", "cue.q", WORLD))
    measured = jnp.array([[np.cos(0.4), np.sin(0.4)]])
    assert_allclose(difference(channel, WORLD, states, measured), [[0.1]], atol=1e-12)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("cue.z", "did you mean"),
        (dr.Marker("coe"), "did you mean 'cue'"),
        (3.0, "expected 'ball.x', Marker"),
        (dr.Marker("cue", point=(1.0, 2.0, 3.0)), "shape"),
        (dr.Channel("cue.q", scale=2.0), "expected none for an orientation"),
        (dr.Pinhole("cue", x=(0.0, 0.0), q=(2.0, 0.0), focal=800.0), "q has length 2: expected 1"),
        (lambda state: state.x, "expected a number or a vector"),
    ],
)
def test_bad_observers(what, message):
    with pytest.raises(ValueError, match=message):
        channel_of("c", what, WORLD)


# ---- records


class Table:
    """What pandas looks like from here."""

    columns = ("t", "cue.x[1]", "cue.angle")

    def __getitem__(self, name):
        return {"t": T, "cue.x[1]": T**2, "cue.angle": 0 * T}[name]


def test_tables_files_and_dictionaries_say_the_same(tmp_path):
    file = tmp_path / "data.csv"
    rows = [f"{t},{t**2},{'' if k == 2 else 0.0}" for k, t in enumerate(T)]
    file.write_text("\n".join(["t,cue.x[1],cue.angle", *rows]) + "\n")
    for data in (Table(), file, read_csv(str(file))):
        series, *_ = columns(WORLD, data, {})
        x, angle = series
        assert (x.name, angle.name) == ("cue.x", "cue.angle")
        assert np.isnan(x.values[:, 0]).all()
        assert_allclose(x.values[:, 1], T**2)
        assert np.isnan(angle.values[2]).all() == (not isinstance(data, Table))


def test_a_file_as_spreadsheets_write_it(tmp_path):
    (tmp_path / "marked.csv").write_bytes(b"\xef\xbb\xbft,cue.x[0]\r\n0,1\r\n1,2\r\n")
    assert list(read_csv(tmp_path / "marked.csv")) == ["t", "cue.x[0]"]
    (tmp_path / "semicolons.csv").write_text("t;cue.x[0]\n0,5;1,5\n1;\n")
    read = read_csv(tmp_path / "semicolons.csv")
    assert_array_equal(read["t"], [0.5, 1.0])
    assert_array_equal(read["cue.x[0]"], [1.5, np.nan])


def test_columns_may_have_times_of_their_own():
    slow = T[::2] + 0.03
    series, *_ = columns(WORLD, {"t": T, "cue.x": np.zeros((6, 2)), "ball.x": (slow, np.ones((3, 2)))}, {})
    assert_allclose([s.t[-1] for s in series], [T[-1], slow[-1]])


GOOD = {"t": T, "cue.x": np.zeros((6, 2))}


@pytest.mark.parametrize(
    ("data", "arguments", "message"),
    [
        ({"cue.x": np.zeros((6, 2))}, {}, 'expected a column "t"'),
        ({"time": T, "cue.x": np.zeros((6, 2))}, {}, r"got \['time', 'cue.x'\]; rename"),
        (GOOD | {"t": T[::-1]}, {}, "increasing times"),
        (GOOD | {"cue.x": np.zeros((6, 3))}, {}, r"expected \(6, 2\) like t in this 2D world"),
        (GOOD | {"cue.x[0]": T}, {}, "leave one out"),
        ({"t": T, "cue.x[2]": T}, {}, r"component \[2\] of 2"),
        (GOOD | {"cu.x": T}, {}, "did you mean 'cue.x'"),
        (GOOD | {"ball.x": np.full((6, 2), np.nan)}, {}, "every value is NaN"),
        ({"t": T, "cue.x": np.outer(T, (3.0, 0.0)), "cue.v": np.full((6, 2), 3000.0)}, {}, "metres and seconds"),
        ({"t": T}, {}, "nothing is measured"),
        ([], {}, "empty list"),
        (5.0, {}, "expected a dict, a table or the path"),
        (GOOD, {"noise": {"cue.y": 1.0}}, "no column 'cue.y'"),
        (GOOD, {"noise": {"cue.x": 0.0}}, "above 0"),
        (GOOD, {"noise": {"cue.x": np.ones(5)}}, "shape"),
        (GOOD, {"observe": {"tip": "cue.x"}}, "no column 'tip'"),
        (GOOD, {"starts": 0}, "integer >= 1"),
        (GOOD, {"widths": ()}, "widths"),
        (GOOD, {"windows": (0.0,)}, "windows"),
        (GOOD, {"dt": -1.0}, "dt is -1: expected above 0"),
        ([dr.Record(GOOD, start=0.2)], {}, "make it earlier"),
        ([dr.Record(GOOD, world=SOLID)], {}, "2D|3D"),
    ],
)
def test_bad_input_of_a_fit(data, arguments, message):
    with pytest.raises(ValueError, match=message):
        dr.fit(WORLD, STATE, data, free={"cue.v": dr.real()}, progress=False, **arguments)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ({"tip.point": dr.real()}, "no parameter 'tip.point'"),
        ({"cue.x": dr.direction(), "cue.mass": dr.direction()}, "expected a vector"),
        ({("cue.mass",): dr.shares()}, "two or more"),
        ({"cue.x": dr.each(3)}, "expected interval"),
        ({"cue.mass": dr.positive(), "restitution": dr.real(), "cue.restitution": dr.real()}, "set the same number"),
        ({"cue.q": dr.rotation(), "cue.angle": dr.real()}, "set the same number"),
        ({"cue.v[0]": dr.real(), "cue.v": dr.real()}, "set the same number"),
        ({"cue.v[2]": dr.real()}, r"cue.v\[2\] is not a number"),
        ({"contact.width": dr.positive()}, "the widths to go through"),
        ({"ball.v": dr.direction()}, "a direction that is not zero"),
        ({"cue.mass": dr.interval(2, 3)}, "starts at 1.0, expected from 2 to 3"),
    ],
)
def test_bad_parameters_of_a_fit(free, message):
    with pytest.raises(ValueError, match=message):
        dr.fit(WORLD, STATE, GOOD, free=free, progress=False)
    with pytest.raises(ValueError, match="deviation"):
        dr.prior(dr.real(), 0.0, 0.0)


def test_a_component_of_a_vector_is_free_alone():
    found = dr.fit(WORLD, STATE, GOOD, free={"cue.v[1]": dr.real()}, progress=False)
    assert found["cue.v[1]"].unit == "m/s" and found.state.v[0, 0] == STATE.v[0, 0]


def test_a_column_that_is_called_as_a_parameter_is_refused():
    seen = {"die": dr.Pinhole(dr.Marker("die"), x=(0.0, 0.0, 0.0), q=(1.0, 0.0, 0.0, 0.0), focal=100.0)}
    with pytest.raises(ValueError, match="give the column another name"):
        dr.fit(
            SOLID,
            SOLID_STATE,
            {"t": T, "die": np.ones((6, 2))},
            observe=seen,
            free={"die.x": dr.real()},
            progress=False,
        )


def test_pieces_of_a_long_record_start_where_it_was_measured():
    t = np.arange(41) / 20
    data = {"t": t, "cue.x": np.stack([t, 2 - t], 1), "cue.angle": 0.5 + 4.0 * t}
    pieces = dr.segments(WORLD, STATE, data, 4)
    assert len(pieces) == 4 and pieces[0].state is STATE
    assert_allclose([p.start for p in pieces], [0.0, 0.5, 1.0, 1.5])
    for piece in pieces[1:]:
        assert_allclose(piece.state.x[0], (piece.start, 2 - piece.start), atol=1e-9)
        assert_allclose(piece.state.v[0], (1.0, -1.0), atol=1e-9)
        assert_allclose(piece.state.w[0], 4.0, atol=1e-9)
        assert_allclose(piece.observations["cue.x"][0][[0, -1]], (piece.start, piece.start + 0.5))


# ---- order of impacts


def test_orders_of_impacts_in_words():
    bounces, hit = ("b-floor",) * 3, ("a-b", "b-floor")
    assert in_words(((bounces,),), 1) == "impacts: b-floor x 3"
    assert in_words(((hit,), (hit,), ((),)), 4) == "impacts, 2 of 4 starts: a-b, b-floor; 1 of 4: none"
    assert in_words((((),), ((),)), 2) == ""
    two_records = ((hit, bounces), (hit, hit), (hit, bounces))
    assert in_words(two_records, 3) == "impacts of record 1, 2 of 3 starts: b-floor x 3; 1 of 3: a-b, b-floor"
    many = tuple((tuple(f"{k}-{n}" for n in range(10)),) for k in range(5))
    assert in_words(many, 5).endswith("2-6, 2-7, and 2 more; 2 in other orders")


def test_what_happens_at_one_time_is_listed_by_name():
    """A ball falls on a corner of two planes, and two more strike each other at the same time, and then the planes."""
    bodies = {name: dr.Body(dr.Disc(radius=0.1), mass=1.0, x=x, v=v) for name, x, v in (
        ("b", (1.0, 1.0), (-1.0, -1.0)), ("a", (3.0, 5.0), (0.9, 0.0)), ("c", (5.0, 5.0), (-0.9, 0.0))
    )}  # fmt: skip
    walls = {"wall": dr.Static(dr.HalfSpace(normal=(1.0, 0.0))), "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}
    trajectory = dr.rollout(*dr.scene(bodies | walls, restitution=1.0), dt=1 / 60, steps=330)
    assert order_of_impacts(trajectory) == ("b-floor", "b-wall", "a-c", "a-wall")


# ---- losses and residuals


@pytest.mark.parametrize("loss", [sysid.squares(), dr.huber(), dr.student()])
def test_weights_are_slopes_over_residuals(loss):
    for r in (-4.0, -0.3, 0.9, 2.5):
        assert_allclose(jax.grad(loss.rho)(r), loss.weight(jnp.asarray(r)) * r, rtol=1e-12)


def test_residuals_of_noise_are_believed_and_others_are_not():
    random = np.random.default_rng(0)
    noise = [random.standard_normal(300) for _ in range(200)]
    chances = np.array([whiteness([r]) for r in noise])
    assert_allclose([(chances < p).mean() for p in (0.1, 0.5)], (0.1, 0.5), atol=0.08)  # uniform
    line = np.polynomial.polynomial.polyvander(np.linspace(-1, 1, 25), 2)
    basis = np.linalg.qr(line)[0]
    short = [r[:25] - basis @ (basis.T @ r[:25]) for r in noise]  # what a fit of a parabola leaves
    assert whiteness(short) > 0.5
    assert_allclose(np.mean([normality(r) < 0.1 for r in noise]), 0.1, atol=0.08)
    assert doubts(noise[:3], 1.0) == []
    drift = noise[0] + np.sin(np.arange(300) / 20)
    assert "autocorrelated" in doubts([drift], None)[0]
    assert any("not normal" in text for text in doubts([noise[0] ** 3], None))
    assert not any("not normal" in text for text in doubts([noise[0] ** 3], None, robust=True))
    assert any("times the noise" in text for text in doubts([3 * noise[1]], 1.0))


# ---- files

SCENE = """
gravity = [0.0, -9.81]
restitution = 0.5
ignore = [["a", "b"]]
contact = { width = 0.01 }

[bodies.a]
shape = { disc = { radius = 0.1 } }
mass = 1.0
x = [0.0, 1.0]

[bodies.b]
mass = 2.0
inertia = 0.1
x = [3.0, 1.0]
v = [1.0, 0.0]

[statics.floor]
shape = { half_space = { normal = [0.0, 1.0] } }

[forces]
air = { drag = { linear = 0.1 } }

[joints]
rod = { distance = { a = "b", anchor_a = [0.0, 0.0], anchor_b = [3.0, 2.0] } }

[free]
"b.v" = { each = "real" }
"a.v" = { prior = ["real", [0.0, 1.0], 0.1] }
restitution = { interval = [0, 1] }
"a.mass = b.mass" = { positive = 0.2 }

[observe]
tip = { marker = { body = "b", point = [0.1, 0.0] } }
far = { separation = { a = "a", b = { marker = { body = "b" } } } }

[fit]
starts = 2
loss = { student = 3.0 }
"""


def test_a_scene_file_is_the_scene_it_describes(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    found = read_scene(file)
    world, state = dr.scene(
        {
            "a": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0)),
            "b": dr.Body(None, mass=2.0, inertia=0.1, x=(3.0, 1.0), v=(1.0, 0.0)),
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
        },
        gravity=(0.0, -9.81), restitution=0.5, contact=dr.Contact(width=0.01), ignore=[("a", "b")],
        forces={"air": dr.Drag(linear=0.1)},
        joints={"rod": dr.Distance("b", anchor_a=(0.0, 0.0), anchor_b=(3.0, 2.0))},
    )  # fmt: skip
    assert jax.tree.structure((found.world, found.state)) == jax.tree.structure((world, state))
    for ours, theirs in zip(jax.tree.leaves((found.world, found.state)), jax.tree.leaves((world, state)), strict=True):
        assert_allclose(ours, theirs, rtol=1e-12)
    free = {
        "b.v": dr.each(dr.real()), "restitution": dr.interval(0, 1), ("a.mass", "b.mass"): dr.positive(0.2),
        "a.v": dr.prior(dr.real(), [0.0, 1.0], 0.1),
    }  # fmt: skip
    assert found.free == free and found.options == {"starts": 2, "loss": dr.student(3.0)}
    assert found.observe == {
        "tip": dr.Marker("b", point=[0.1, 0.0]), "far": dr.Separation("a", dr.Marker("b")),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[bodies.a]", "[bodys.a]"), "unknown key 'bodys': did you mean 'bodies'"),
        (("disc = {", "disk = {"), "no 'disk': did you mean 'disc'"),
        (("radius = 0.1", "radios = 0.1"), "no field 'radios': did you mean 'radius'"),
        (('"real" }', '"reel" }'), "did you mean 'real'"),
        (("starts = 2", "start = 2"), "did you mean 'starts'"),
        (("mass = 1.0", "mass = "), "not a TOML file"),
        (('{ each = "real" }', "3"), "free.b.v is 3: expected one kind"),
        (('["real", [0.0, 1.0], 0.1]', '["real"]'), "expected { prior = "),
        (("[fit]", "[columns]\nt = 3\n[fit]"), "columns.t is 3: expected the name of a column"),
        (("student", "studend"), "fit.loss is 'studend': did you mean 'student'"),
        (("body = ", "bodi = "), "no field 'bodi': did you mean 'body'"),
        (("mass = 1.0", "masss = 1.0"), "no field 'masss': did you mean 'mass'"),
        (("{ interval = [0, 1] }", "{}"), "free.restitution is {}: expected one kind"),
        (("{ interval = [0, 1] }", "{ interval = [0] }"), "free.restitution: .*high"),
        ((SCENE, "bodies = 3"), "bodies is 3: expected a table"),
    ],
)
def test_mistakes_in_scene_files(tmp_path, change, message):
    file = tmp_path / "scene.toml"
    file.write_text(SCENE.replace(*change, 1))
    with pytest.raises(ValueError, match=message):
        read_scene(file)


def test_fit_from_the_command_line(tmp_path):
    """A fall: x = v t, y = 1 - g t^2 / 2."""
    (tmp_path / "scene.toml").write_text(
        'gravity = [0.0, -9.0]\n[bodies.p]\nmass = 1.0\ninertia = 1.0\nx = [0.0, 1.0]\n[free]\n"gravity" = "real"\n'
        '[columns]\nt = { time = 0.001 }\n"p.x[0]" = "x"\n"p.x[1]" = "p.x[1]"\n'
    )
    lines = [f"{1e3 * t:.3f},0.0,{1 - 9.81 * t**2 / 2:.9f},7" for t in np.arange(12) / 20]
    (tmp_path / "fall.csv").write_text("\n".join(["time,x,p.x[1],frame", *lines]) + "\n")
    files, said = [str(tmp_path / name) for name in ("scene.toml", "fall.csv")], io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["fit", *files, "--out", str(tmp_path / "fit.json"), "--report", str(tmp_path / "fit.html")]) == 0
    assert "gravity[1]" in said.getvalue()
    saved = dr.load_fit(tmp_path / "fit.json")
    assert_allclose(saved["gravity"].value, (0.0, -9.81), atol=1e-6)
    assert "scene: fall.csv" in (tmp_path / "fit.html").read_text(encoding="utf-8")
    with pytest.raises(SystemExit), contextlib.redirect_stderr(said):
        main(["fit", files[0], str(Path(tmp_path) / "none.csv")])
    assert "none.csv" in said.getvalue()
    (tmp_path / "other.csv").write_text("times,x,p.x[1]\n0,0,0\n1,0,0\n")
    with pytest.raises(SystemExit), contextlib.redirect_stderr(said):
        main(["fit", files[0], str(tmp_path / "other.csv")])
    assert "has no column 'time', which is 't' here: did you mean 'times'?" in said.getvalue()


# ---- numbers that are hardly seen, or not


def test_a_number_that_is_seen_by_rounding_only_does_not_hold_up_the_others():
    """Its slope is 1e-8 of the largest, so that the step in which it helps is 1e8 long; one of 0.5 costs more."""

    def residuals(z):
        return 1e3 * jnp.stack([z[0] - 1.0 + 1e-8 * z[1], jnp.maximum(jnp.abs(z[1]) - 0.5, 0.0)])

    def at(z):
        line = z.shared[:, 0]
        r, jacobian = residuals(line), jax.jacfwd(residuals)(line)
        return Point(z, (r[:, None, None],), (jacobian[:, :, None, None],))

    start = Numbers(jnp.array([[0.0], [0.1]]), jnp.zeros((0, 1, 1)))
    reach = Numbers(jnp.full((2, 1), jnp.inf), jnp.zeros((0, 1, 1)))
    counts = []
    point, why = minimise(at, ((0,),), start, Squares(), None, reach, lambda count, costs: counts.append(count))
    assert why == ""
    assert_allclose(point.z.shared[0, 0], 1.0, atol=1e-6)
    assert len(counts) < 30


def test_what_is_seen_of_an_inertia_has_an_interval():
    """Of three second moments the second is not seen: of the inertia, that about the second axis is without it."""
    slot = Slot("die.inertia", ("die.inertia",), dr.inertia(principal=True), 3)
    about = jnp.diag(jnp.array([3.0, 4.0, 5.0]))
    unseen = unseen_of([Blind(np.array([0.0, 1.0, 0.0]), ("die.inertia",), "")], slice(0, 3))
    value, low, high = interval_of(slot, np.zeros(3), 1e-4 * np.eye(3), about, 2.0, unseen)
    assert_allclose(value, about, atol=1e-12)
    wide = high - low
    assert np.isinf(wide[[0, 2], [0, 2]]).all()
    sizes = np.array([3.0, 1.0])  # second moments along axes 1 and 3: their sum is the inertia about axis 2
    assert_allclose(wide[1, 1], 2 * 2.0 * 1e-2 * np.sqrt((sizes**2).sum()), rtol=1e-6)
    assert_allclose(wide[0, 1], 0.0, atol=1e-12)


def test_numbers_have_the_names_of_the_table():
    """Of a matrix by row and column; of a chart, which has fewer numbers than the value, one by one."""
    corners = Slot("tile.shape.vertices", ("tile.shape.vertices",), dr.real(), 6)
    inertia = Slot("die.inertia", ("die.inertia",), dr.inertia(principal=True), 3)
    names = [place.name for place in coordinates([corners, inertia], [np.ones((3, 2)), np.eye(3)])]
    assert names[4:6] == ["tile.shape.vertices[2, 0]", "tile.shape.vertices[2, 1]"]
    assert names[6:] == [f"die.inertia[{k}]" for k in range(3)]


def test_only_numbers_without_an_interval_are_said_not_to_be_determined():
    p = Parameter("ball.x", np.array([1.0, 2.0]), np.array([0.9, -np.inf]), np.array([1.1, np.inf]), "m", BLIND)
    assert [row[-1] for row in rows_of(p)] == ["", BLIND]


@pytest.mark.parametrize("free", ["box.mass", "box.density"])
def test_a_mass_that_leaves_the_inertia_of_a_solid_body_is_noticed(free):
    """A box on a spring, twice as heavy as it is said to be."""
    box = dr.Body(dr.Box(half=(0.2, 0.1)), mass=1.0, x=(1.0, 0.0))
    spring = dr.SpringDamper(a="box", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=8.0)
    t = np.arange(40) / 30
    data = {"t": t, "box.x[0]": np.cos(2.0 * t)}
    found = dr.fit(*dr.scene({"box": box}, forces=[spring]), data, free={free: dr.positive()}, progress=False)
    assert_allclose(found.world.bodies.mass, 2.0, rtol=1e-4)
    inertia = 2.0 * (0.2**2 + 0.1**2) / 3
    if free == "box.density":
        assert_allclose(found.world.bodies.inertia, inertia, rtol=1e-4)
        assert not [note for note in found.notes if "density" in note]
    else:
        assert [note for note in found.notes if note.startswith("box.mass is 2 times what it was, box.inertia is as")]


def test_degrees_in_a_column_of_angles_are_noticed():
    wheel = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.0), w=1.0)
    t = np.arange(60) / 30
    found = dr.fit(
        *dr.scene({"wheel": wheel}), {"t": t, "wheel.angle": np.degrees(2.0 * t)}, free={"wheel.w": dr.real()}
    )
    assert found.notes[0].startswith("the fit failed") and "degrees" in found.notes[0]


def test_times_in_milliseconds_are_doubted_before_the_fit():
    bodies = {
        "ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    t, free = np.linspace(0.0, 2000.0, 61), {"ball.v": dr.real()}
    with pytest.warns(UserWarning, match="a record of 2e.03 s takes 1e.05 steps of 0.02 s: are its times seconds?"):
        sysid.make_problem(*dr.scene(bodies), {"t": t, "ball.x": np.zeros((61, 2))}, free=free)
