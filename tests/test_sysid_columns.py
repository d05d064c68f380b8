"""What columns observe and records hold, and what is refused of them and of the arguments of a fit."""

import dataclasses
import re
import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import diffrigid as dr
from diffrigid import sysid
from diffrigid.state import rotations
from diffrigid.step import steps_in
from diffrigid.sysid.channels import channel_of
from diffrigid.sysid.columns import columns
from diffrigid.sysid.csv_file import read_csv
from diffrigid.sysid.parameters import channel_paths
from diffrigid.sysid.remarks import _averaged
from diffrigid.sysid.sensors import difference, predict
from diffrigid.sysid.setup import make_problem

WORLD, STATE = dr.scene(
    {
        "cue": dr.Body(None, mass=1.0, inertia=1.0, x=(1.0, 2.0), angle=0.5, v=(3.0, 0.0)),
        "ball": dr.Body(None, mass=2.0, inertia=1.0, x=(4.0, 6.0)),
    }
)
SOLID, SOLID_STATE = dr.scene({"die": dr.Body(None, mass=1.0, inertia=(1.0, 1.0, 1.0), x=(0.2, -0.4, 5.0))})
T = np.arange(6) / 10


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


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """Pixels of a point of the plane in a camera that is turned."""

    scale: float  # [pixel/m]
    angle: float  # [rad]
    origin: tuple = (0.0, 0.0)  # [pixel]
    of: Any = "cue"

    def __call__(self, state):
        x, y = self.of(state)
        c, s = self.scale * jnp.cos(self.angle), self.scale * jnp.sin(self.angle)
        return self.origin + jnp.stack([c * x + s * y, s * x - c * y])


@dataclasses.dataclass(frozen=True)
class Unregistered(Camera):
    pass


def test_a_record_of_the_user_reads_and_has_its_numbers_as_parameters():
    camera = Camera(scale=100, angle=0.2, origin=(320.0, 240.0), of=dr.Marker("cue"))
    c, s = np.cos(0.2), np.sin(0.2)
    pixels = (320 + 100 * (c + 2 * s), 240 + 100 * (s - 2 * c))
    assert_allclose(reading(camera), pixels)
    assert_allclose(reading(dr.Channel(Camera(scale=100, angle=0.2), bias=(320.0, 240.0))), pixels)
    columns = channel_paths({"px": channel_of("px", camera, WORLD)})
    assert {"px.scale", "px.angle", "px.origin", "px.of.point"} <= set(columns)


def test_the_camera_of_the_guide_is_fitted():
    """To a body that glides; pixels have a noise of 0.3."""
    guide = (Path(__file__).parent.parent / "notebooks" / "guide.md").read_text()
    (code,) = re.findall(r"^    @jax.*?\n\n(?=\S)", guide, re.M | re.S)
    exec(textwrap.dedent(code), names := {"jax": jax, "jnp": jnp, "dataclasses": dataclasses})
    t, c, s = np.arange(40) / 40, 100.0 * np.cos(0.2), 100.0 * np.sin(0.2)
    x, y = 1.0 + 3.0 * t, 2.0
    pixels = np.stack([320.0 + c * x + s * y, 240.0 + s * x - c * y], 1)
    data = {"t": t, "px": pixels + 0.3 * np.random.default_rng(0).normal(size=(40, 2))}
    free = {"px.scale": dr.positive(), "px.angle": dr.real(), "px.origin": dr.real()}
    guess = names["Camera"](scale=80, angle=0, origin=(300.0, 250.0))
    found = dr.fit(WORLD, STATE, data, free=free, observe={"px": guess}, progress=False)
    for name, truth in (("px.scale", 100.0), ("px.angle", 0.2), ("px.origin", (320.0, 240.0))):
        # Four standard deviations, for four numbers.
        assert (np.abs(found[name].value - truth) < 2 * (found[name].high - found[name].value)).all(), name


def test_a_class_that_was_edited_is_another():
    """JAX alone takes equal records of classes of one name for one another, and may run the older program."""
    structures = set()
    for gain in (1.0, 2.0, 3.0):

        @jax.tree_util.register_dataclass
        @dataclasses.dataclass(frozen=True)
        class Gauge:
            zero: float

            def __call__(self, state, gain=gain):
                return gain * state.x[0, 1] - self.zero

        assert_allclose(reading(Gauge(0.5)), (2.0 * gain - 0.5,))
        structures.add(jax.tree.structure(channel_of("c", Gauge(0.5), WORLD)))
    assert len(structures) == 3


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (Unregistered(100.0, 0.2), "write @jax.tree_util.register_dataclass"),
        (Camera, "expected 'ball.x'"),
        (Camera(100.0, None, of=3.0), "fails for a state"),
        (Camera(100.0, "cue.z"), "did you mean"),
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
    (tmp_path / "lost.csv").write_text("# a remark\nt,cue.x[0]\n\n0,1\n1,lost\n")
    with pytest.raises(ValueError, match=r"lost.csv, line 5, column 'cue.x\[0\]' is 'lost': expected numbers"):
        read_csv(tmp_path / "lost.csv")
    (tmp_path / "number.csv").write_text("t,cue.x[0]\n0,1_5\n")
    with pytest.raises(ValueError, match=r"line 2, column 'cue.x\[0\]' is '1_5': expected numbers"):
        read_csv(tmp_path / "number.csv")
    (tmp_path / "twice.csv").write_text("t,cue.x[0],note,cue.x[0],note\n0,1,a,2,b\n")
    with pytest.raises(ValueError, match=r"two columns have the name 'cue.x\[0\]'"):
        read_csv(tmp_path / "twice.csv", ["note"])


def test_columns_that_are_none_of_the_fit_are_left_out(tmp_path):
    """Numbers of rows and remarks, as a logger writes them; other records may lack them, and a component may go too."""
    (tmp_path / "gates.csv").write_text("gate;t;cue.x[0];remark\nA;0,5;1,5;late\nB;1;2,5;\n")
    unread = {"gate": None, "remark": None}
    for data in (tmp_path / "gates.csv", {"gate": ["A", "B"], "t": [0.5, 1.0], "cue.x[0]": [1.5, 2.5]}):
        (x,), *_ = columns(WORLD, data, unread)
        assert_array_equal(x.values[:, 0], [1.5, 2.5])
    (x,), *_ = columns(WORLD, {"t": T, "cue.x[0]": T, "cue.x[1]": T}, {"cue.x[1]": None})
    assert np.isnan(x.values[:, 1]).all()
    with pytest.raises(ValueError, match="no column 'gate' in this 2D world.*None leaves it out"):
        columns(WORLD, {"t": T, "gate": T}, {})


def test_velocities_in_another_unit_are_doubted_and_fast_vibrations_fitted():
    """Of several records the first is named. A spring of 10 Hz filmed at 9.7 Hz moves faster than its rows."""
    data = {"t": T, "cue.x": np.outer(T, (3.0, 0.0)), "cue.v": np.full((6, 2), 3000.0)}
    problem = partial(make_problem, WORLD, STATE, free={"cue.v": dr.real()})
    with pytest.warns(UserWarning, match=r"observations\[1\]\['cue.v'\]: speeds of .* metres and seconds\?") as caught:
        problem([GOOD, data, data])
    assert len(caught) == 1
    t, w = np.arange(20) / 9.7, 2 * np.pi * 10.0
    x, v = (np.outer(wave, (1.0, 0.0)) for wave in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t)))
    with pytest.warns(UserWarning, match="a motion faster than its rows"):
        problem({"t": t, "cue.x": x, "cue.v": v})


def test_marks_for_lost_points_are_doubted():
    """A tracker writes (0, 0) or (-1, -1) where it sees nothing; what rests at the origin, or crosses it, is there."""
    t = np.arange(40) / 60
    x = np.outer(t, (3.0, 1.0)) + (1.0, 2.0)
    problem = partial(make_problem, WORLD, STATE, free={"ball.v": dr.real()})
    for mark in (0.0, -1.0):
        lost = np.where((np.arange(40) % 10 == 3)[:, None], mark, x)
        with pytest.warns(UserWarning, match=rf"\['ball.x'\] is {mark:g} in 4 rows, far from the rows beside"):
            problem({"t": t, "ball.x": lost})
        with pytest.warns(UserWarning, match=rf"\['tip'\] is {mark:g} in 4 rows.*make it NaN"):
            problem({"t": t, "tip": lost}, observe={"tip": dr.Marker("ball")})
    slides = np.maximum(0.5 - t, 0.0)
    problem(
        {"t": t, "ball.x": np.stack([slides, 0.0 * t], axis=1), "ball.v": np.where(slides, -1.0, 0.0)[:, None] * (1, 0)}
    )
    problem({"t": t, "ball.x": x - x[20]})


def test_columns_may_have_times_of_their_own():
    slow = T[::2] + 0.03
    series, *_ = columns(WORLD, {"t": T, "cue.x": np.zeros((6, 2)), "ball.x": (slow, np.ones((3, 2)))}, {})
    assert_allclose([s.t[-1] for s in series], [T[-1], slow[-1]])


def test_components_may_have_times_and_noise_of_their_own():
    """Of one column: the fit is that of the whole column with NaN where a component was not measured."""
    t_x, t_y = np.array([0.0, 0.1, 0.2, 0.4]), np.array([0.0, 0.2, 0.3])
    parts = {"ball.x[0]": (t_x, 4.0 + 0 * t_x), "ball.x[1]": (t_y, 6.0 + t_y)}
    ((series,), _, _) = columns(WORLD, parts, {})
    assert_allclose(series.t, [0.0, 0.1, 0.2, 0.3, 0.4])
    assert_allclose(series.values, [[4, 6], [4, np.nan], [4, 6.2], [np.nan, 6.3], [4, np.nan]])
    ((mixed,), _, _) = columns(WORLD, {"t": t_x, "ball.x[0]": 0 * t_x, "ball.x[1]": parts["ball.x[1]"]}, {})
    assert_allclose(mixed.t, series.t)
    free = {"ball.v": dr.real()}
    noise = {"ball.x[0]": 0.1, "ball.x[1]": np.array([0.2, 0.2, 0.2, 0.3, 0.3])}
    whole = np.stack([np.full(5, 0.1), noise["ball.x[1]"]], axis=1)
    as_parts = make_problem(WORLD, STATE, parts, free=free, noise=noise)
    at_once = make_problem(WORLD, STATE, {"t": series.t, "ball.x": series.values}, free=free, noise={"ball.x": whole})
    for one, other in zip(as_parts.groups, at_once.groups, strict=True):
        assert_array_equal(one.data.weights["ball.x"], other.data.weights["ball.x"])
    alone = make_problem(WORLD, STATE, {"t": t_y, "ball.x[1]": 6.0 + t_y}, free=free, noise={"ball.x[1]": 0.2})
    assert alone.groups[0].data.weights["ball.x"].max() == 5.0
    for wrong, message in (
        ({"ball.x[0]": 0.1}, r"noise: ball.x\[1\] has none: give it too"),
        ({"ball.x[0]": 0.1, "ball.x": 0.1}, "both 'ball.x' and 'ball.x\\[0\\]' are given"),
        ({"ball.x[2]": 0.1}, r"noise\['ball.x\[2\]'\]: ball.x has 2 numbers"),
        ({"ball.x[0]": (0.1, 0.2), "ball.x[1]": 0.1}, r"has shape \(2,\), expected a number or \(5,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            make_problem(WORLD, STATE, parts, free=free, noise=wrong)
    with pytest.raises(ValueError, match=r"ball.x'\]\[1\] has shape \(2,\), expected \(3,\) like its times"):
        columns(WORLD, parts | {"ball.x[1]": (t_y, t_y[:2])}, {})


GOOD = {"t": T, "cue.x": np.zeros((6, 2))}


@pytest.mark.parametrize(
    ("data", "arguments", "message"),
    [
        ({"cue.x": np.zeros((6, 2))}, {}, 'expected a column "t"'),
        ({"time": T, "cue.x": np.zeros((6, 2))}, {}, r"got \['time', 'cue.x'\]; rename"),
        (GOOD | {"t": T[::-1]}, {}, "increasing times .* if another run begins there, give each as a record"),
        (GOOD | {"t": T[[0, 1, 1, 3, 4, 5]]}, {}, "in row 2: leave out one of the two"),
        (GOOD | {"t": np.where(T == T[2], np.nan, T)}, {}, "in row 2: leave out rows without a time"),
        ({"t": T, "cue.x": T, "cue.y": T}, {}, r"name the columns cue.x\[0\] and cue.x\[1\]"),
        ({"t": T, "cue.x": ["0", "lost", *"2345"]}, {}, "with 'lost' in row 1"),
        (GOOD | {"cue.x": np.zeros((6, 3))}, {}, r"expected \(6, 2\) like t in this 2D world"),
        (GOOD | {"cue.x[0]": T}, {}, "leave one out"),
        ({"t": T, "cue.x[2]": T}, {}, r"component \[2\], expected \[0\] to \[1\]"),
        (GOOD | {"cu.x": T}, {}, "did you mean 'cue.x'"),
        *(
            (GOOD | {name: T}, {}, r"did you mean 'ball.x\[1\]'")
            for name in ("ball.x1", "ball.x_1", "ball.y", "ball.xy")
        ),
        (GOOD | {"ball.x": np.full((6, 2), np.nan)}, {}, "every value is NaN"),
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
        (["cue.v"], "a dict from path to kind"),
        ({"tip.point": dr.real()}, "no parameter 'tip.point'"),
        ({"cue.x": dr.direction(), "cue.mass": dr.direction()}, "expected a vector"),
        ({("cue.mass",): dr.shares()}, "two or more"),
        ({"cue.x": dr.each(3)}, "expected interval"),
        ({"cue.mass": (0, 1)}, r"got \(0, 1\): did you mean interval\(0, 1\)\?"),
        ({"cue.mass": dr.positive}, r"the function positive: call it, positive\(\)"),
        (
            {"cue.mass": dr.positive(), "restitution": dr.real(), "cue.restitution": dr.real()},
            "set the same number: leave one out, or free restitution by bodies and statics only",
        ),
        ({"cue.q": dr.rotation(), "cue.angle": dr.real()}, "set the same number"),
        ({"cue.v[0]": dr.real(), "cue.v": dr.real()}, "set the same number"),
        ({"cue.mass": dr.through(dr.paths.write, dr.real(), 1.0)}, "expected a name of its own"),
        ({("a", "b"): dr.through(dr.paths.write, dr.real(), 1.0)}, "expected a name of its own"),
        ({"cue.v[2]": dr.real()}, r"cue.v\[2\] is not a number"),
        ({"contact.width": dr.positive()}, "the widths to go through"),
        ({"ball.v": dr.direction()}, "a direction that is not zero"),
        ({("cue.mass", "ball.v[0]"): dr.shares()}, "starts at .* expected numbers above zero, whose sum is kept"),
        ({"cue.mass": dr.interval(2, 3)}, "starts at 1.0, expected from 2 to 3"),
    ],
)
def test_bad_parameters_of_a_fit(free, message):
    with pytest.raises(ValueError, match=message):
        dr.fit(WORLD, STATE, GOOD, free=free, progress=False)
    with pytest.raises(ValueError, match="deviation"):
        dr.prior(dr.real(), 0.0, 0.0)
    with pytest.raises(ValueError, match="cue.mass is -1: expected above 0"):
        dr.fit(*dr.paths.write(WORLD, STATE, "cue.mass", -1.0), GOOD, free={"cue.v": dr.real()}, progress=False)
    with pytest.raises(ValueError, match="unit is 1.0, expected a string"):
        dr.through(dr.paths.write, dr.real(), 0.0, 1.0)


def test_a_component_of_a_vector_is_free_alone():
    found = dr.fit(WORLD, STATE, GOOD, free={"cue.v[1]": dr.real()}, progress=False)
    assert found["cue.v[1]"].unit == "m/s" and found.state.v[0, 0] == STATE.v[0, 0]


def test_a_column_that_is_called_as_a_parameter_is_refused():
    seen = {"die": dr.Pinhole(dr.Marker("die"), x=(0.0, 0.0, 0.0), q=(1.0, 0.0, 0.0, 0.0), focal=100.0)}
    data, free = {"t": T, "die": np.ones((6, 2))}, {"die.x": dr.real()}
    with pytest.raises(ValueError, match="give the column another name"):
        dr.fit(SOLID, SOLID_STATE, data, observe=seen, free=free, progress=False)


def test_pieces_of_a_long_record_start_where_it_was_measured():
    t = np.arange(41) / 20
    data = {"t": t, "cue.x": np.stack([t, 2 - t], 1), "cue.angle": 0.5 + 4.0 * t}
    pieces = dr.segments(WORLD, STATE, data, 4)
    assert len(pieces) == 4
    assert_allclose([p.start for p in pieces], [0.0, 0.5, 1.0, 1.5])
    for piece in pieces:
        assert_allclose(piece.state.x[0], (piece.start, 2 - piece.start), atol=1e-9)
        assert_allclose(piece.state.v[0], (1.0, -1.0), atol=1e-9)
        assert_allclose(piece.state.w[0], 4.0, atol=1e-9)
        assert_allclose(piece.observations["cue.x"][0][[0, -1]], (piece.start, piece.start + 0.5))


def test_pieces_without_enough_rows_are_refused():
    t = np.array([0.0, 0.1, 0.2, 0.3, 10.0])
    gap = {"t": t, "cue.x": np.zeros((5, 2))}
    late = {"cue.x": (10.0 * T, np.zeros((6, 2))), "cue.angle": (t[:4], t[:4])}
    for data, message in (
        (gap, "'cue.x' from 0.3 to 6.66667 s: 1, expected"),
        (late, "'cue.angle' from 1 to 3.33333 s: 0"),
    ):
        with pytest.raises(ValueError, match=message):
            dr.segments(WORLD, STATE, data, 3)


def states_to_begin_with(scene, records, free):
    kinds = {name: dr.each(kind) for name, kind in free.items()}
    return [run.state for run in sysid.make_problem(*scene, records, free=kinds).runs]


def test_records_begin_as_their_first_rows_show():
    """In what is free for each: five rows, a hole among them, on a line or in free fall; not with a state of its own."""
    t = np.arange(9) / 20
    x = np.stack([5.0 + 2.0 * t, 1.0 - t - 4.9 * t**2], 1)
    x[2] = np.nan
    thrown = {"t": t, "cue.x": x, "cue.angle": np.mod(3.0 + 4.0 * t, 2 * np.pi)}
    half = {"t": t, "cue.x[1]": x[:, 1], "ball.x": (t + 9.0, x + 1.0)}
    free = {"cue.x": dr.real(), "cue.v[0]": dr.interval(2.5, 4.0), "cue.angle": dr.real(), "cue.w": dr.real()}
    scene = (WORLD, STATE)
    state, given = states_to_begin_with(scene, [thrown, dr.Record(thrown, state=STATE)], free)
    assert_array_equal(given.x, STATE.x)
    assert_allclose(state.x[0], (5.0, 1.0), atol=1e-9)
    assert_allclose(state.v[0], (2.5, 0.0))  # the end of its interval; the other number is not free
    assert_allclose(state.q[0], (np.cos(3.0), np.sin(3.0)), atol=1e-9)
    assert_allclose(state.w[0], 4.0, atol=1e-9)
    (state,) = states_to_begin_with(scene, half, {"cue.x": dr.real(), "cue.v": dr.real(), "ball.x": dr.real()})
    assert_allclose(state.v[0], (3.0, -1.0), atol=1e-9)
    assert_allclose(state.x, ((1.0, 1.0), (4.0, 6.0)), atol=1e-9)  # not measured; measured much later


def test_a_tumbling_body_begins_as_its_first_rows_show():
    t, w, first = np.arange(9) / 60, np.array([3.0, -1.0, 2.0]), np.array([0.5, -0.5, 0.5, 0.5])
    q = np.asarray(jax.vmap(dr.so3.turn_by)(w * t[:, None], jnp.broadcast_to(first, (9, 4))))
    q = q * np.where(np.arange(9) % 2, 1.0, -1.0)[:, None]  # the same orientations
    free = {"die.q": dr.rotation(), "die.w": dr.real()}
    (state,) = states_to_begin_with((SOLID, SOLID_STATE), {"t": t, "die.q": q}, free)
    assert_allclose(abs(state.q[0] @ first), 1.0, atol=1e-9)
    assert_allclose(state.w[0], w, atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_begins_as_its_markers_show(dim):
    """Each row with enough of them, whichever they are; two in the plane, in space three that are not on a line."""
    scene = (WORLD, STATE) if dim == 2 else (SOLID, SOLID_STATE)
    name, so = scene[0].names[0], rotations(dim)
    t, v = np.arange(9) / 120, np.arange(1.0, dim + 1)
    w, first = (np.array([4.0]), np.array([0.6, 0.8])) if dim == 2 else (v[::-1], np.array([0.5, -0.5, 0.5, 0.5]))
    q = np.asarray(jax.vmap(so.turn_by)(w * t[:, None], jnp.broadcast_to(first, (9, len(first)))))
    points = 0.1 * np.eye(4, dim) - 0.02
    at = np.stack([v * t[:, None] + np.asarray(jax.vmap(so.rotate)(q, jnp.broadcast_to(p, (9, dim)))) for p in points])
    at[0, 1], at[1, 2] = np.nan, np.nan
    data = {"t": t} | {f"m{k}": 1e3 * values for k, values in enumerate(at)}
    seen = {f"m{k}": dr.Channel(dr.Marker(name, point=p), scale=1e3) for k, p in enumerate(points)}
    kinds = {"x": dr.real(), "v": dr.real(), "w": dr.real(), "q": dr.rotation()}
    free = {f"{name}.{field}": dr.each(kind) for field, kind in kinds.items()}
    state = sysid.make_problem(*scene, data, free=free, observe=seen).runs[0].state
    assert_allclose(abs(state.q[0] @ first), 1.0, atol=1e-9)
    for found, true in ((state.x, np.zeros(dim)), (state.v, v), (state.w, w)):
        assert_allclose(found[0], true, atol=1e-6)
    on_a_line = seen | {"m3": dr.Marker(name, point=0.5 * (points[0] + points[1]))}
    few = {k: data[k] for k in ("t", "m0", "m1", "m3")} if dim == 3 else {k: data[k] for k in ("t", "m0")}
    observe = {k: on_a_line[k] for k in few if k != "t"}
    assert_array_equal(sysid.make_problem(*scene, few, free=free, observe=observe).runs[0].state.x, scene[1].x)


def test_a_clock_that_jitters_takes_one_step_for_each_frame():
    """Times to a tenth of a millisecond, and in single precision."""
    t = np.round(np.arange(60) / 60 * 1.0003, 4)
    data = {"t": t, "cue.x": np.zeros((60, 2))}
    problem = sysid.make_problem(WORLD, STATE, data, free={"cue.v": dr.real()})
    assert problem.groups[0].data.lengths.shape[0] == 59
    single = (np.arange(36, dtype=np.float32) / np.float32(30)).astype(float)
    assert (steps_in(np.diff(single), 1 / 30) == 1).all() and steps_in(np.array([35 / 30]), np.float32(1 / 30)) == 35


def test_what_is_measured_to_be_constant_and_fitted_exactly_is_doubted():
    """As zeros midway between the clicks of a ball, which one that lies on the floor fits too."""
    still = {"t": T, "ball.x": np.tile([4.0, 6.0], (6, 1))}
    found = dr.fit(WORLD, STATE, still, free={"ball.v": dr.real()}, progress=False)
    assert found.doubts == ("what was measured is constant",)
    moving = {"t": T, "ball.x": still["ball.x"] + T[:, None]}
    assert dr.fit(WORLD, STATE, moving, free={"ball.v": dr.real()}, progress=False).doubts == ()


def test_a_coefficient_that_counts_half_is_noted():
    """Of a body that was given none of its own the scene's is half in each pair; a value of its own outweighs it."""
    floor = dr.HalfSpace(normal=(0.0, 1.0))
    ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0))
    for own, notes in ((None, 1), (0.3, 0)):
        scene = dr.scene({"ball": ball, "floor": dr.Static(floor, friction=own)}, friction=0.3)
        for free in ("floor.friction", "friction"):
            problem = make_problem(*scene, {"t": T, "ball.x": np.zeros((6, 2))}, free={free: dr.positive()})
            found = _averaged(problem)
            assert len(found) == notes * (free != "friction")
            assert all(note.startswith("floor.friction counts half") for note in found)
