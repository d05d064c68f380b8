"""Files of robots: masses, inertias, poses and motion against MuJoCo where it is installed, and what is refused."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.models.frames import from_quaternion, to_quaternion
from diffrigid.paths import read
from diffrigid.state import rotations

SAME = 1e-6  # of masses, inertias [-] and positions [m]
STEP = 1e-3  # [s] of MuJoCo with Runge-Kutta, and of diffrigid
FOLLOWS = 1e-8  # [m] after 0.5 s: both are of fourth order

TREE = """
<mujoco model="tree">
  <compiler angle="degree" eulerseq="XYZ"/>
  <option gravity="0 0.5 -9.7"/>
  <default>
    <geom density="500" friction="0.4 0.1 0.1"/>
    <default class="arm">
      <geom type="capsule" size="0.05" contype="0" conaffinity="0"/>
      <joint axis="0 1 0" damping="0.02"/>
      <default class="hand"><geom rgba="1 0 0 1" density="800"/></default>
    </default>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="ground" type="plane" size="5 5 0.1" pos="0 0 -3"/>
    <body name="post" pos="0.1 0.2 0.3" euler="10 20 30">
      <geom type="box" size="0.02 0.03 0.1" contype="0" conaffinity="0"/>
      <body name="upper" pos="0 0 0.1" quat="0.9 0.1 0.3 -0.2" childclass="arm">
        <joint name="shoulder" pos="0 0 0" range="-170 170"/>
        <geom fromto="0 0 0 0.3 0 -0.1"/>
        <body name="lower" pos="0.3 0 -0.1" axisangle="0 0 1 35">
          <joint name="elbow" type="ball"/>
          <geom fromto="0 0 0 0 0 -0.3"/>
          <geom type="ellipsoid" size="0.05 0.06 0.07" pos="0.01 0.02 -0.3" euler="5 0 9" mass="0.4"/>
          <body name="hand" pos="0 0 -0.3" xyaxes="0 1 0 -1 0 0.2" childclass="hand">
            <joint name="reach" type="slide" axis="0 0.6 0.8" range="-0.2 0.3" damping="0.1"/>
            <geom type="cylinder" fromto="0 0 0 0 0.1 -0.1" size="0.03"/>
          </body>
        </body>
      </body>
    </body>
    <body name="crate" pos="1 1 0.5" zaxis="0.1 0.2 1">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3"/>
    </body>
    <body name="odd" pos="2 -1 1">
      <joint type="free"/>
      <inertial pos="0.1 0.2 0.3" mass="2" fullinertia="0.3 0.4 0.5 0.01 0.02 -0.03"/>
      <body name="stuck" pos="0.5 0 0"><geom type="sphere" size="0.1" mass="0.3"/></body>
    </body>
  </worldbody>
</mujoco>
"""
LINKS = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="RK4"/>
  <default><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" contype="0" conaffinity="0"/>
    <joint axis="0 1 0" damping="0.01"/></default>
  <worldbody>
    <body name="a"><joint/><geom/>
      <body name="b" pos="0.3 0 0" euler="0.3 0 0"><joint/><geom/>
        <body name="c" pos="0.3 0 0"><joint axis="0 0 1"/><geom/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
ROBOT = """
<robot name="arm">
  <link name="base"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0.05" rpy="0.1 0.2 0.3"/><mass value="1.5"/>
      <inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="-0.002" izz="0.04"/></inertial>
    <collision><origin xyz="0.1 0 0.05" rpy="0 1.5 0"/><geometry><sphere radius="0.05"/></geometry></collision>
  </link>
  <link name="lower"><inertial><mass value="0.5"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="tip"/>
  <link name="tool"><inertial><mass value="0.2"/><inertia ixx="0.001" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0.3 -0.2 0.5"/><axis xyz="0 1 0"/><limit lower="-1" upper="1.5" effort="1" velocity="1"/>
    <dynamics damping="0.1" friction="0.05"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.3 0 0.1" rpy="0 0 1"/><axis xyz="1 0 0"/></joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0 0.2 0" rpy="0 0.5 0"/></joint>
  <joint name="reach" type="prismatic"><parent link="tip"/><child link="tool"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/><limit lower="-0.1" upper="0.2"/></joint>
</robot>
"""


@pytest.fixture
def write(tmp_path):
    def written(text):
        path = tmp_path / "model.xml"
        path.write_text(text)
        return path

    return written


def compare(mujoco, model, world, state):
    """Masses, inertias in world axes, and centres of mass of all bodies of diffrigid."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for row, name in enumerate(world.names):
        body = model.body(name).id
        R = data.ximat[body].reshape(3, 3)
        own = from_quaternion(np.asarray(state.q[row]))
        assert_allclose(world.bodies.mass[row], model.body_mass[body], rtol=SAME)
        assert_allclose(state.x[row], data.xipos[body], atol=SAME)
        inertia = own @ np.asarray(world.bodies.inertia[row]) @ own.T
        expected = R @ np.diag(model.body_inertia[body]) @ R.T
        assert_allclose(inertia, expected, atol=SAME * expected.max())


def test_a_tree_is_that_of_mujoco(write):
    mujoco = pytest.importorskip("mujoco")
    path = write(TREE)
    with pytest.warns(UserWarning, match="left out: damping of joint 'elbow'$"):
        world, state = dr.load_mjcf(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    compare(mujoco, model, world, state)
    assert set(world.names) == {"upper", "lower", "hand", "crate", "odd", "stuck"}
    assert_allclose(world.forces[0].g, [0.0, 0.5, -9.7])
    assert_allclose(world.bodies.friction[world.names.index("crate")], 0.4)
    assert_allclose(read(world, state, "shoulder.upper"), np.deg2rad(170.0))
    assert_allclose(read(world, state, "reach.lower"), -0.2)
    assert_allclose(read(world, state, "shoulder.damping"), 0.02)


def test_three_links_swing_as_in_mujoco(write):
    mujoco = pytest.importorskip("mujoco")
    path = write(LINKS)
    with pytest.warns(UserWarning, match="timestep of option; integrator of option"):
        world, state = dr.load_mjcf(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    end = jax.tree.map(lambda leaf: leaf[-1], dr.rollout(world, state, dt=STEP, steps=500).state)
    bodies = [model.body(name).id for name in world.names]
    assert np.abs(end.x - state.x).max() > 0.2
    assert_allclose(end.x, data.xipos[bodies], atol=FOLLOWS)


def test_angles_and_translations_count_as_those_of_mujoco(write):
    mujoco = pytest.importorskip("mujoco")
    path = write(LINKS.replace('<joint axis="0 0 1"/>', '<joint type="slide" axis="0 0 1"/>'))
    with pytest.warns(UserWarning, match="timestep of option; integrator of option"):
        world, state = dr.load_mjcf(path)
    values = {"a_joint.angle": 0.4, "b_joint.angle": -0.7, "c_joint.translation": 0.1}
    for name, value in values.items():
        world, state = dr.paths.write(world, state, name, value)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = list(values.values())
    mujoco.mj_forward(model, data)
    assert_allclose(state.x, data.xipos[[model.body(name).id for name in world.names]], atol=SAME)


def test_a_urdf_is_that_of_mujoco(write):
    mujoco = pytest.importorskip("mujoco")
    path = write(ROBOT)
    world, state = dr.load_urdf(path, friction=0.3)
    model = mujoco.MjModel.from_xml_string(
        ROBOT.replace('<link name="base">', '<mujoco><compiler fusestatic="false"/></mujoco><link name="base">')
    )
    compare(mujoco, model, world, state)
    assert world.names == ("upper", "lower", "tool") and world.static_names == ("base_collision0",)
    for field, value in (("lower", -1.0), ("upper", 1.5), ("damping", 0.1), ("friction", 0.05)):
        assert_allclose(read(world, state, f"shoulder.{field}"), value)
    world_axis = rotations(3).rotate(state.q[0], read(world, state, "shoulder.axis_a"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert_allclose(world_axis, data.xaxis[model.joint("shoulder").id], atol=SAME)


def test_shapes_that_share_a_name_are_all_there(write):
    """With each other, or with a link."""
    shapes = "".join(
        f'<collision name="{name}"><geometry><sphere radius="0.1"/></geometry></collision>'
        for name in ("tip", "tip", "upper")
    )
    world, _ = dr.load_urdf(write(ROBOT.replace('<link name="base">', f'<link name="base">{shapes}')))
    assert world.names == ("upper", "lower", "tool")
    assert world.static_names == ("tip_", "tip__", "upper_", "base_collision3")


def test_equal_limits_are_those_of_a_weld(write):
    """Both default to 0, as the parser of ROS has it."""
    for limit in ("", '<limit effort="1"/>', '<limit lower="0.0" upper="0"/>'):
        with pytest.warns(UserWarning, match="model.xml: left out: motion of joint 'shoulder', whose limits are equal"):
            world, _ = dr.load_urdf(
                write(ROBOT.replace('<limit lower="-1" upper="1.5" effort="1" velocity="1"/>', limit))
            )
        assert (
            world.names == ("lower", "tool") and "upper_collision0" in world.static_names
        )  # as its base does not move


def test_a_floating_root_falls(write):
    text = ROBOT.replace(
        '<link name="base">',
        '<link name="base"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1"/></inertial>',
    )
    world, _ = dr.load_urdf(write(text), floating=True)
    assert world.names == ("base", "upper", "lower", "tool")
    fixed, _ = dr.load_urdf(write(text))
    assert fixed.names == ("upper", "lower", "tool")


def mjcf(body, before=""):
    return f"<mujoco>{before}<worldbody>{body}</worldbody></mujoco>"


BALL = '<body name="ball"><freejoint/><geom size="0.1"/></body>'
LEFT_OUT = {
    "actuator": (mjcf(BALL) .replace("</mujoco>", '<actuator><motor joint="a"/></actuator></mujoco>'), r"actuator \(motor\)"),
    "stiffness": (mjcf('<body name="a"><joint name="j" stiffness="3"/><geom size="0.1" pos="1 0 0"/></body>'), "stiffness of joint 'j'"),
    "margin": (mjcf(BALL.replace("size", 'name="g" margin="0.1" size')), "margin of geom 'g'"),
    "a full turn": (mjcf('<body name="a"><joint name="j" range="-180 180"/><geom size="0.1" pos="1 0 0"/></body>'), "lower limit -3.14159 rad and upper limit 3.14159 rad of j"),
    "a limit a turn away": (mjcf('<body name="a"><joint name="j" range="300 400"/><geom size="0.1" pos="1 0 0"/></body>'), "lower limit 5.23599 rad and upper"),
    "friction of a second geom": (mjcf(BALL.replace("</body>", '<geom name="g2" size="0.1" friction="0.3"/></body>').replace("<geom size", '<geom name="g" size')), "the friction of all shapes of ball but g"),
}  # fmt: skip


def test_all_geoms_of_a_body_collide(write):
    """A hammer whose head is turned, off the centre of mass: each corner is where MuJoCo has it."""
    hammer = (
        '<body name="hammer" pos="0 0 1" euler="0 0 30"><freejoint/><inertial pos="0.1 0 0" mass="1" diaginertia="1 2 2"/>'
        '<geom name="handle" type="capsule" fromto="-0.2 0 0 0.2 0 0" size="0.02"/>'
        '<geom name="head" type="box" pos="0.2 0 0" euler="0 90 0" size="0.1 0.02 0.03"/></body>'
    )
    world, state = dr.load_mjcf(write(mjcf('<geom name="floor" type="plane" size="1 1 1"/>' + hammer)))
    assert_allclose(state.x[0], [0.1 * np.cos(np.pi / 6), 0.1 * np.sin(np.pi / 6), 1.0], rtol=SAME)
    assert_allclose(dr.gap(world, state, "hammer", "floor"), 0.9, rtol=SAME)  # the long side of the head, turned down
    assert_allclose(read(world, state, "hammer.shape.head.x"), [0.1, 0.0, 0.0], atol=SAME)
    assert_allclose(read(world, state, "hammer.shape.handle.x"), [-0.1, 0.0, 0.0], atol=SAME)


@pytest.mark.parametrize("case", LEFT_OUT)
def test_what_is_left_out_is_named(case, write):
    text, message = LEFT_OUT[case]
    with pytest.warns(UserWarning, match=f"model.xml: left out: .*{message}"):
        dr.load_mjcf(write(text))


@pytest.mark.parametrize(
    ("load", "text"),
    [(dr.load_mjcf, LEFT_OUT["margin"][0]), (dr.load_urdf, ROBOT.replace("</robot>", "<odd/></robot>"))],
)
def test_the_warning_is_at_the_line_that_loads(load, text, write):
    with pytest.warns(UserWarning, match="left out") as caught:
        load(write(text))
    assert caught[0].filename == __file__


def test_limits_of_a_hinge_may_lie_beyond_half_a_turn(write):
    world, state = dr.load_mjcf(
        write(mjcf('<body name="a"><joint name="j" range="-20 270"/><geom size="0.1" pos="1 0 0"/></body>'))
    )
    assert_allclose([read(world, state, f"j.{side}") for side in ("lower", "upper")], np.deg2rad([-20.0, 270.0]))


@pytest.mark.parametrize("limits", ["0 0", "1 -1"])
def test_a_range_that_is_none_is_no_limit(write, limits):
    """As MuJoCo reads it, where `limited` is not given."""
    body = mjcf(f'<body name="a"><joint name="j" range="{limits}"/><geom size="0.1" pos="1 0 0"/></body>')
    (hinge,) = dr.load_mjcf(write(body))[0].joints
    assert hinge.lower is None and hinge.upper is None
    with pytest.raises(ValueError, match="expected lower < upper"):
        dr.load_mjcf(write(body.replace("range", 'limited="true" range')))


def test_a_mesh_weighs_nothing_beside_an_inertial(tmp_path):
    body = '<body name="a"><freejoint/><inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/><geom name="g" type="mesh" mesh="m"/></body>'
    path = tmp_path / "model.xml"
    path.write_text(mjcf(body))
    with pytest.warns(UserWarning, match="a mesh"):
        world, _ = dr.load_mjcf(path)
    assert_allclose(world.bodies.mass, [2.0])


REFUSED = {
    "no XML": ("<mujoco", "is not an XML file"),
    "another root": ("<robot/>", "starts with <robot>: expected <mujoco>"),
    "nothing": ("<mujoco/>", "bodies"),
    "two joints": (mjcf('<body name="a"><joint/><joint/><geom size="1"/></body>'), "'a' has 2 joints: expected one"),
    "no mass": (mjcf('<body name="a"><joint/></body>'), "'a' moves and has no mass"),
    "mesh": (mjcf('<body name="a"><freejoint/><geom name="g" type="mesh" mesh="m"/></body>'), "<geom 'g'> is a mesh, whose mass"),
    "numbers": (mjcf('<body name="a" pos="1 2"><freejoint/><geom size="1"/></body>'), "<body 'a'>: pos is '1 2': expected 3 numbers"),
    "words": (mjcf(BALL.replace("0.1", "big")), "size is 'big': expected finite numbers"),
    "size": (mjcf(BALL.replace("0.1", "-1")), "size is '-1': expected 1 numbers above 0"),
    "type": (mjcf('<body name="a"><joint type="screw"/><geom size="1"/></body>'), "type is 'screw': expected one of hinge"),
    "class": (mjcf(BALL.replace("<geom", '<geom class="red"')), "class 'red', which is not in <default>"),
    "orientations": (mjcf('<body name="a" quat="1 0 0 0" euler="0 0 0"><freejoint/><geom size="1"/></body>'), "quat and euler: expected one"),
    "axis": (mjcf('<body name="a"><joint axis="0 0 0"/><geom size="1"/></body>'), "axis is zero"),
    "axis of a turn": (mjcf('<body name="a" axisangle="0 0 0 90"><freejoint/><geom size="1"/></body>'), "axisangle is zero"),
    "one axis twice": (mjcf('<body name="a" xyaxes="1 0 0 2 0 0"><freejoint/><geom size="1"/></body>'), "xyaxes is '1 0 0 2 0 0': expected two directions"),
    "one end twice": (mjcf('<body name="a"><freejoint/><geom type="capsule" fromto="1 1 1 1 1 1" size="1"/></body>'), "fromto is '1 1 1 1 1 1': expected two points"),
    "huge": (mjcf(BALL.replace("0.1", "1e200")), "size is '1e200': expected finite numbers"),
    "overflow": (mjcf(BALL.replace("0.1", "3e102")), "expected finite numbers"),
    "angles": (mjcf(BALL, '<compiler angle="degrees"/>'), "angle is 'degrees': expected one of degree, radian"),
    "order of turns": (mjcf(BALL, '<compiler eulerseq="abc"/>'), "eulerseq is 'abc': expected three letters of x, y, z"),
    "include": ("<mujoco><include/></mujoco>", "an <include> has no file"),
    "frame": (mjcf("<frame/>" + BALL), "<frame> in 'world' cannot be loaded"),
    "global": (mjcf(BALL, '<compiler coordinate="global"/>'), "expected local"),
    "a file that is cut short": ('<mujoco><include file="part.xml"/></mujoco>', "part.xml is not an XML file"),
    "a rope of 300 bodies": (mjcf('<body><joint/><geom size="1"/>' * 300 + "</body>" * 300), "is nested in 200 elements"),
    "circle of files": ('<mujoco><include file="model.xml"/></mujoco>', "includes itself"),
}  # fmt: skip


URDF_REFUSED = {
    "no mass": (ROBOT.replace("inertial>", "visual>"), "moves and has no mass"),
    "type": (ROBOT.replace('"continuous"', '"planar"'), "joint 'elbow' has the type 'planar'"),
    "parent": (ROBOT.replace('parent link="tip"', 'parent link="tap"'), "joint 'reach' has the parent 'tap'"),
    "circle": (ROBOT.replace('child link="upper"', 'child link="base"'), "form a loop"),
    "two parents": (ROBOT.replace('child link="lower"', 'child link="upper"'), "child of two joints"),
    "value": (ROBOT.replace('value="1.5"', 'value="heavy"'), "value is 'heavy': expected finite numbers"),
    "no value": (ROBOT.replace('<mass value="1.5"/>', ""), "<mass of inertial of upper> has no value: expected a number"),
}  # fmt: skip


@pytest.mark.parametrize(
    "load, refused, case",
    [(dr.load_mjcf, REFUSED, case) for case in REFUSED] + [(dr.load_urdf, URDF_REFUSED, case) for case in URDF_REFUSED],
)
def test_what_cannot_be_loaded_is_named(load, refused, case, write):
    text, message = refused[case]
    path = write(text)
    path.with_name("part.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(ValueError, match=message):
        load(path)


def test_quaternions_of_all_rotations():
    for q in np.random.default_rng(0).normal(size=(50, 4)).tolist() + np.eye(4).tolist():
        R = from_quaternion(np.array(q))
        assert_allclose(from_quaternion(to_quaternion(R)), R, atol=1e-12)
        assert_allclose(
            rotations(3).rotate(to_quaternion(R), np.array([1.0, 2.0, 3.0])), R @ [1.0, 2.0, 3.0], atol=1e-12
        )
