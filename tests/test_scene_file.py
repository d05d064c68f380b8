"""A scene and a fit from files."""

import contextlib
import io
from pathlib import Path

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.__main__ import main
from diffrigid.scene_file import read_scene

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
note = false
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
        "tip": dr.Marker("b", point=[0.1, 0.0]), "note": None, "far": dr.Separation("a", dr.Marker("b")),
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


ROD = """<robot name="r"><link name="base"/><link name="rod"><inertial><mass value="2"/><origin xyz="0 0 -0.5"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>"""
SWINGS = """
robot = { urdf = { path = "rod.urdf", gravity = [0.0, 0.0, -9.8] } }
contact = { width = 0.01 }

[values]
"hinge.angle" = 0.9
"rod.mass" = 3.0

[free]
"hinge.rate" = "real"
"rod.inertia" = { inertia = { principal = true } }
"""


def test_a_scene_file_may_name_the_file_of_a_robot(tmp_path):
    (tmp_path / "rod.urdf").write_text(ROD)
    (tmp_path / "scene.toml").write_text(SWINGS)
    found = read_scene(tmp_path / "scene.toml")
    made = dr.load_urdf(tmp_path / "rod.urdf", gravity=(0.0, 0.0, -9.8), contact=dr.Contact(width=0.01))
    made = dr.paths.write(*dr.paths.write(*made, "hinge.angle", 0.9), "rod.mass", 3.0)
    assert jax.tree.structure((found.world, found.state)) == jax.tree.structure(made)
    jax.tree.map(assert_allclose, (found.world, found.state), made)
    assert found.free == {"hinge.rate": dr.real(), "rod.inertia": dr.inertia(principal=True)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("contact =", "friction ="), "friction beside robot"),
        (("urdf =", "udrf ="), "robot: no 'udrf': did you mean 'urdf'"),
        (("gravity =", "gravitation ="), "robot: no field 'gravitation': did you mean 'gravity'"),
        (("{ urdf = {", "3 #"), "robot is 3: expected a table"),
        (('path = "rod.urdf", ', ""), "robot: .*path"),
        (("principal =", "principle ="), "free.rod.inertia: .*principle"),
        (("hinge.angle", "hinge.angel"), "values.hinge.angel: .*did you mean 'hinge.angle'"),
        (("= 0.9", '= "right"'), "values.hinge.angle: .*expected numbers"),
    ],
)
def test_mistakes_in_scene_files_of_robots(tmp_path, change, message):
    (tmp_path / "rod.urdf").write_text(ROD)
    (tmp_path / "scene.toml").write_text(SWINGS.replace(*change, 1))
    with pytest.raises(ValueError, match=message):
        read_scene(tmp_path / "scene.toml")


def test_fit_from_the_command_line(tmp_path):
    """A fall: x = v t, y = 1 - g t^2 / 2."""
    (tmp_path / "scene.toml").write_text(
        'gravity = [0.0, -9.0]\n[bodies.p]\nmass = 1.0\ninertia = 1.0\nx = [0.0, 1.0]\n[free]\n"gravity" = "real"\n'
        '[columns]\nt = { time = 0.001 }\n"p.x[0]" = "x"\n"p.x[1]" = "p.x[1]"\n'
    )
    lines = [f"{1e3 * t:.3f},0.0,{1 - 9.81 * t**2 / 2:.9f},free" for t in np.arange(12) / 20]
    (tmp_path / "fall.csv").write_text("\n".join(["time,x,p.x[1],note", *lines]) + "\n")
    lines = [f"{1e3 * t:.3f},2.0,{4 - 9.81 * t**2 / 2:.9f},free" for t in np.arange(12) / 20]
    (tmp_path / "risen.csv").write_text("\n".join(["time,x,p.x[1],note", *lines]) + "\n")
    files, said = [str(tmp_path / name) for name in ("scene.toml", "fall.csv")], io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["fit", *files, "--out", str(tmp_path / "fit.json"), "--report", str(tmp_path / "fit.html")]) == 0
        with pytest.warns(UserWarning, match="record 0 began at the fitted start"):  # 2 m to the right, 3 m higher
            assert main(["fit", *files, "--held-out", str(tmp_path / "risen.csv")]) == 0
    assert "gravity[1]" in said.getvalue()
    assert "held out: root mean square of p.x 2.55 (" in said.getvalue()
    saved = dr.load_fit(tmp_path / "fit.json")
    assert_allclose(saved["gravity"].value, (0.0, -9.81), atol=1e-6)
    assert "scene: fall.csv" in (tmp_path / "fit.html").read_text(encoding="utf-8")
    lines = [f"{1e3 * t:.3f},{np.sin(9 * t):.6f},1.0" for t in np.arange(60) / 60]
    (tmp_path / "swings.csv").write_text("\n".join(["time,x,p.x[1]", *lines]) + "\n")
    with contextlib.redirect_stdout(said):
        assert main(["fit", files[0], str(tmp_path / "swings.csv")]) == 1
    assert "! the fit failed" in said.getvalue()
    with pytest.raises(SystemExit), contextlib.redirect_stderr(said):
        main(["fit", files[0], str(Path(tmp_path) / "none.csv")])
    assert "none.csv" in said.getvalue()
    (tmp_path / "other.csv").write_text("times,x,p.x[1]\n0,0,0\n1,0,0\n")
    with pytest.raises(SystemExit), contextlib.redirect_stderr(said):
        main(["fit", files[0], str(tmp_path / "other.csv")])
    assert "has no column 'time', which is 't' here: did you mean 'times'?" in said.getvalue()
