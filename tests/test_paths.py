"""Names of parameters: what is written is read back, and nothing else has moved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import diffrigid as dr
from diffrigid import paths, so2
from diffrigid.state import COEFFICIENTS

FLAT = dr.scene(
    {
        "cue": dr.Body(dr.Disc(radius=0.4), mass=1.0, x=(0.0, 0.0), v=(1.5, 0.0), restitution=0.3),
        "ball": dr.Body(dr.Disc(radius=0.3), mass=1.2, x=(1.5, 0.1), angle=0.4, w=0.2),
        "block": dr.Body(dr.Polygon(vertices=((0, 0), (1, 0), (0, 1))), density=2.0, x=(5.0, 0.0)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0), offset=-1.0)),
        "wall": dr.Static(dr.Box(half=(0.1, 2.0)), x=(-3.0, 0.0), angle=0.1, friction=0.9),
    },
    gravity=(0.0, -9.81),
    friction=0.2,
    forces={
        "air": dr.Drag(linear=0.1),
        "rope": dr.SpringDamper(a="cue", b="ball", anchor_a=(0, 0), anchor_b=(0.1, 0), stiffness=3.0),
        "push": dr.Force(body="block", F=(1.0, 0.0)),
        "motor": dr.Torque(body="cue", tau=0.5),
    },
)
SOLID = dr.scene(
    {
        "die": dr.Body(dr.Box(half=(0.1, 0.1, 0.1)), mass=0.02, x=(0, 0, 1), restitution_falloff=0.2),
        "rod": dr.Body(dr.Capsule(radius=0.1, half_length=0.4), density=500, x=(1, 0, 1), w=(0, 0, 2)),
        "point": dr.Body(None, mass=1.0, inertia=(1, 1, 1), x=(9, 0, 0)),
        "ground": dr.Static(dr.HalfSpace(normal=(0, 0, 1))),
    },
    gravity=(0, 0, -9.81),
    forces=[dr.Drag(linear=(0.1, 0.2, 0.3), angular=0.01), dr.Drag()],
)
CASES = [(scene, path) for scene in (FLAT, SOLID) for path in sorted(paths.catalogue(scene[0]))]
cases = pytest.mark.parametrize("scene, path", CASES, ids=[f"{s[0].dim}D {path}" for s, path in CASES])
BODIES = {"mass", "inertia", "restitution", "friction", "x", "q", "v", "w"}


def test_every_leaf_has_a_path():
    expected = {f"{name}.{field}" for name in ("cue", "ball", "block") for field in BODIES | {"angle"}}
    expected |= {
        f"{name}.{field}" for name in ("floor", "wall") for field in ("x", "q", "angle", "restitution", "friction")
    }
    expected |= {"cue.shape.radius", "ball.shape.radius", "block.shape.vertices", "wall.shape.half"}
    expected |= {"floor.shape.normal", "floor.shape.offset", "restitution", "friction", "gravity", "gravity.g"}
    expected |= {"air.linear", "air.angular", "push.F", "motor.tau", "contact.width", "contact.rest_speed"}
    expected |= {f"{name}.density" for name in ("cue", "ball", "block")}
    expected |= {f"rope.{field}" for field in ("anchor_a", "anchor_b", "stiffness", "damping", "length")}
    assert set(paths.catalogue(FLAT[0])) == expected
    assert {"restitution_falloff", "ground.restitution_falloff"} < set(paths.catalogue(SOLID[0]))
    assert {"die.inertia", "rod.shape.half_length", "drag.linear", "drag1.angular"} < set(paths.catalogue(SOLID[0]))


def changed_rows(before, after):
    """Leaves that differ, as {number of the leaf: rows of it}."""
    assert jax.tree.structure(before) == jax.tree.structure(after)
    found = {}
    for i, (a, b) in enumerate(zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)):
        assert a.dtype == b.dtype and a.shape == b.shape
        if rows := {int(at[0]) if len(at) else 0 for at in np.argwhere(a != b)}:
            found[i] = rows
    return found


@cases
def test_round_trip(scene, path):
    world, state = scene
    old = np.asarray(paths.read(world, state, path))
    new = old + 0.125 + 0.25 * np.arange(old.size).reshape(old.shape)
    changed = paths.write(world, state, path, new)
    assert_allclose(paths.read(*changed, path), new, rtol=1e-15)
    moved = changed_rows(scene, changed)
    several = path in COEFFICIENTS or path.endswith(".density")  # of bodies and statics; mass and inertia
    assert len(moved) == (2 if several else 1)
    if path.split(".")[0] in world.names + world.static_names:
        assert {len(rows) for rows in moved.values()} == {1}  # no other body


@pytest.mark.parametrize("scene", (FLAT, SOLID), ids=("2D", "3D"))
def test_write_traces_and_is_differentiable(scene):
    values = {path: paths.read(*scene, path) for path in paths.catalogue(scene[0])}

    def total(values):
        return sum(paths.read(*paths.write(*scene, path, v), path).sum() for path, v in values.items())

    for slope in jax.tree.leaves(jax.jit(jax.grad(total))(values)):
        assert_allclose(slope, 1.0, rtol=1e-14)


def test_material_of_all_is_that_of_each():
    world, state = paths.write(*FLAT, "restitution", 0.7)
    assert_array_equal(world.bodies.restitution, 0.7)
    assert_array_equal(world.statics.restitution, 0.7)
    assert_array_equal(world.statics.friction, FLAT[0].statics.friction)


def test_angle_is_another_name_for_q():
    pair = paths.write(*FLAT, "wall.angle", -2.0)
    assert_allclose(paths.read(*pair, "wall.q"), so2.exp(jnp.array([-2.0])), rtol=1e-15)
    assert_allclose(paths.read(*FLAT, "ball.angle"), 0.4, rtol=1e-15)


def test_a_name_may_have_lines():
    scene = dr.scene({"a\nb": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0))})
    assert paths.read(*scene, "a\nb.x[1]") == 1.0


def test_values_may_carry_the_batch_of_their_leaf():
    world = dr.replace(FLAT[0], bodies=dr.replace(FLAT[0].bodies, mass=jnp.ones((3, 4))))
    one, each = (paths.write(world, FLAT[1], "ball.mass", value)[0] for value in (2.0, jnp.arange(4.0)))
    assert_array_equal(one.bodies.mass[1], 2.0)
    assert_array_equal(each.bodies.mass, [[1.0] * 4, range(4), [1.0] * 4])


@pytest.mark.parametrize(
    "path, near",
    [
        ("bal.mass", "'ball.mass'"),
        ("ball.raduis", "'ball.shape.radius'"),
        ("gravty", "'gravity'"),
        ("rope.stifness", "'rope.stiffness'"),
        ("ball.shape.half", "'wall.shape.half'"),
        ("floor.mass", "'floor.x'|'ball.mass'"),
        ("zzz", "there are air.angular"),
    ],
)
def test_unknown_paths_list_the_nearest(path, near):
    with pytest.raises(ValueError, match=f"no parameter '{path}' in this world: .*({near})"):
        paths.read(*FLAT, path)


def test_of_two_gravities_each_has_its_own_path():
    bodies = {"a": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.0))}
    scene = dr.scene(bodies, gravity=(0.0, -9.81), forces={"moon": dr.Gravity(g=(0.0, -1.62))})
    assert paths.read(*scene, "gravity.g[1]") == -9.81
    with pytest.raises(ValueError, match="no parameter 'gravity' in this world: there are 2: use gravity.g or moon.g"):
        paths.read(*scene, "gravity")


@pytest.mark.parametrize(
    "path, value, message",
    [
        ("gravity", 9.81, r"gravity was given the shape \(\): expected \(2,\)"),
        ("ball.mass", (1.0, 2.0), r"ball.mass was given the shape \(2,\): expected \(\).*For many worlds: jax.vmap"),
        ("ball.angle", (1.0, 0.0), r"ball.angle was given the shape \(2,\): expected \(\)"),
        ("restitution", (0.1, 0.2), r"restitution was given the shape \(2,\): expected \(3,\)"),
        ("ball.mass", "heavy", "ball.mass is 'heavy': expected numbers"),
    ],
)
def test_wrong_shapes(path, value, message):
    with pytest.raises(ValueError, match=message):
        paths.write(*FLAT, path, value)


def test_paths_print_by_owner():
    lines = repr(paths.catalogue(FLAT[0])).splitlines()
    assert lines[0] == "restitution, friction, gravity"
    assert "cue: mass, inertia, restitution, friction, x, q, v, w, angle, density, shape.radius" in lines


def test_units():
    assert [paths.unit(FLAT[0], p) for p in ("ball.mass", "ball.shape.radius", "air.linear", "restitution")] == [
        "kg",
        "m",
        "N s/m",
        "",
    ]


def test_units_of_joints_are_those_of_an_axis_or_a_way():
    along = {"lower": -1.0, "friction": 0.1, "speed": 0.5, "damping": 0.2}
    bodies = {name: dr.Body(None, mass=1.0, inertia=1.0, x=(x, 0.0)) for name, x in (("a", 0.0), ("b", 1.0))}
    joints = {"hinge": dr.Revolute("a", anchor_a=0.0, **along), "rail": dr.Prismatic("b", axis_b=(1.0, 0.0), **along)}
    world, _ = dr.scene(bodies, joints=joints)
    fields = (*along, "anchor_a")
    assert [paths.unit(world, f"hinge.{f}") for f in fields] == ["rad", "N m", "rad/s", "N m s/rad", "m"]
    assert [paths.unit(world, f"rail.{f}") for f in fields] == ["m", "N", "m/s", "N s/m", "m"]


def test_a_path_of_what_was_left_out_says_so():
    rod = dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0))
    hinged = dr.scene({"rod": rod}, joints={"hinge": dr.Revolute("rod", anchor_a=0.0)})
    for scene, path, field in (
        (hinged, "hinge.damping", "hinge a damping"),
        (FLAT, "cue.rolling_friction", "cue a roll"),
    ):
        with pytest.raises(ValueError, match=f"left out when the scene was made: give {field}"):
            paths.read(*scene, path)


def test_a_density_sets_mass_and_inertia_by_the_shape():
    box = dr.Body(dr.Box(half=(0.2, 0.3)), density=5.0, x=(0.0, 0.0))
    corners = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    for body, size in ((box, "shape.half"), (dr.Body(dr.Hull(vertices=corners), density=5.0, x=(0.0,) * 3), None)):
        floor = dr.Static(dr.HalfSpace(normal=np.eye(len(body.x))[-1], offset=-2.0))
        world, state = dr.scene({"floor": floor, "body": body})
        assert_allclose(dr.paths.read(world, state, "body.density"), 5.0, rtol=1e-12)
        assert dr.paths.unit(world, "body.density") == f"kg/m^{world.dim}"
        denser, _ = dr.paths.write(world, state, "body.density", 15.0)
        for leaf in ("mass", "inertia"):
            assert_allclose(getattr(denser.bodies, leaf), 3.0 * getattr(world.bodies, leaf), rtol=1e-12)
        if size:
            larger, _ = dr.paths.write(*dr.paths.write(world, state, f"body.{size}", (0.4, 0.6)), "body.density", 5.0)
            assert_allclose(larger.bodies.inertia, 16.0 * world.bodies.inertia, rtol=1e-12)  # of an area, m r^2
        assert "floor.density" not in dr.paths.catalogue(world)
    with pytest.raises(ValueError, match="set the same number"):
        free = {"body.density": dr.positive(), "body.inertia": dr.inertia()}
        dr.sysid.make_problem(world, state, {"t": np.arange(3.0), "body.x": np.zeros((3, 3))}, free=free)


def test_a_trajectory_asked_for_a_row_says_how_to_pick_it():
    world, state = dr.scene({"ball": dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0))})
    alone = dr.Trajectory(t=np.zeros(1), state=state, world=world)
    with pytest.raises(ValueError, match=r"trajectory\[0\]: expected a path .* leaf\[0\], trajectory.state"):
        alone[0]


def test_a_world_prints_its_parameters():
    lines = repr(FLAT[0]).splitlines()
    assert lines[0] == "World, 2D"
    assert "rope (SpringDamper): anchor_a [0, 0] m, anchor_b [0.1, 0] m, stiffness 3 N/m" in "\n".join(lines)
    assert "cue (Disc): mass 1 kg, inertia 0.08 kg m^2, restitution 0.3 (own), friction 0.2, radius 0.4 m" in lines
    listed = {path for path in paths.catalogue(SOLID[0]) if "." in path} - {
        f"{name}.{field}" for name in SOLID[0].names for field in ("x", "q", "v", "w", "density")
    }
    shown = {line.split(" (")[0].split(":")[0]: line for line in repr(SOLID[0]).splitlines()[1:]}
    for path in listed:
        owner, _, field = path.partition(".")
        assert f" {field.removeprefix('shape.')} " in shown[owner]


@pytest.mark.parametrize("world", [FLAT[0], SOLID[0]], ids=["2D", "3D"])
def test_a_world_prints_whatever_its_leaves_hold(world):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 20, -1), world)
    assert "mass of shape (20,)" in repr(batch)
    for leaf in (None, 0.0, "a", jax.ShapeDtypeStruct((3,), float)):
        assert repr(jax.tree.map(lambda _, leaf=leaf: leaf, world)).startswith("World")
    jax.make_jaxpr(lambda world: repr(world) and world)(world)


def test_worlds_with_equal_numbers_are_equal():
    world, state = FLAT
    assert world == jax.tree.map(jnp.copy, world) and state == dr.replace(state) and world != state
    assert world != paths.write(world, state, "ball.mass", 1.3)[0]
    assert world != dr.replace(world, names=("a", "b", "c"))
