"""Bodies of several shapes: one shape cut in two, welded bodies, closed forms, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form import with_slopes
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.paths import catalogue, read, write

SAME = 1e-10  # [m], [rad/s] between one motion computed in two ways
FLOOR = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
LAW = {"gravity": (0.0, -9.81), "restitution": 0.5, "friction": 0.3}
THROWN = {"x": (0.0, 1.0), "v": (1.0, 0.0), "w": 3.0, "angle": 0.3}
QUARTER = np.sqrt(0.5)


def same_motion(one, other, dt, steps):
    """Assert that the first bodies of two scenes move alike, and return where the first ends."""
    ends = [dr.rollout(*pair, dt=dt, steps=steps).state for pair in (one, other)]
    for name in "xqvw":
        first, second = (getattr(end, name)[:, 0] for end in ends)
        assert_allclose(second, first, atol=SAME)
    return ends[0].x[-1, 0]


def cut(half, turned):
    """A box cut in two by the plane x = 0, the right part written with its axes turned by a quarter."""
    half = np.array(half)
    part = half * np.where(np.arange(len(half)) == 0, 0.5, 1.0)
    away = np.eye(len(half))[0] * part[0]
    swapped = part[[1, 0, *range(2, len(half))]]
    return {"left": dr.Part(dr.Box(half=part), x=-away), "right": dr.Part(dr.Box(half=swapped), x=away, **turned)}


@pytest.mark.slow
def test_a_box_cut_in_two_moves_as_one():
    parts = cut((0.3, 0.1), {"angle": np.pi / 2})
    one, two = (
        dr.scene({"b": dr.Body(shape, density=2.0, **THROWN), "floor": FLOOR}, **LAW)
        for shape in (dr.Box(half=(0.3, 0.1)), parts)
    )
    assert_allclose(two[0].bodies.inertia, one[0].bodies.inertia)
    end = same_motion(one, two, 1 / 60, 180)
    assert_allclose(end[1], 0.3, atol=1e-9)  # it has come to rest on its short side


@pytest.mark.slow
def test_two_discs_on_a_rod_move_as_a_capsule():
    """Also where one end strikes while the other rests: the two are one impact, as for the ends of a capsule."""
    dumbbell = {
        "left": dr.Part(dr.Disc(radius=0.1), x=(-0.3, 0.0)),
        "right": dr.Part(dr.Disc(radius=0.1), x=(0.3, 0.0)),
    }
    one, two = (
        dr.scene({"b": dr.Body(shape, mass=1.0, inertia=0.05, **THROWN), "floor": FLOOR}, **LAW)
        for shape in (dr.Capsule(radius=0.1, half_length=0.3), dumbbell)
    )
    end = same_motion(one, two, 1 / 60, 180)
    assert_allclose(end[1], 0.1, atol=1e-9)  # flat


@pytest.mark.slow
def test_a_cuboid_cut_in_two_moves_as_one_in_space():
    q = np.array([0.9, 0.2, 0.3, -0.1])
    start = {"x": (0.0, 0.0, 1.0), "v": (1.0, 0.3, 0.0), "w": (1.0, 2.0, 3.0), "q": q / np.linalg.norm(q)}
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
    parts = cut((0.3, 0.1, 0.2), {"q": (QUARTER, 0.0, 0.0, QUARTER)})
    one, two = (
        dr.scene({"b": dr.Body(s, density=2.0, **start), "floor": floor}, **LAW | {"gravity": (0.0, 0.0, -9.81)})
        for s in (dr.Box(half=(0.3, 0.1, 0.2)), parts)
    )
    assert_allclose(two[0].bodies.inertia, one[0].bodies.inertia, atol=1e-15)
    same_motion(one, two, 1 / 60, 49)  # later it lies on more corners than a box has, and slides otherwise


def tumbler(shift, **start):
    """A ball with its centre of mass off its centre, on a floor on which it does not slip."""
    ball = dr.Body(
        {"ball": dr.Part(dr.Disc(radius=0.2))}, mass=1.0, inertia=0.02, center=(0.0, -shift), friction=10.0, **start
    )
    return dr.scene({"b": ball, "floor": FLOOR}, gravity=(0.0, -9.81))


def test_a_weighted_ball_rolls_to_and_fro():
    """Period of small swings: w^2 = m g d / (I + m (R - d)^2), from the energy about the point of contact."""
    R, d, small = 0.2, 0.08, 1e-3
    start = (-R * small + d * np.sin(small), R - d * np.cos(small))
    world, state = tumbler(d, x=start, angle=small)
    rate = np.sqrt(9.81 * d / (0.02 + (R - d) ** 2))
    motion = dr.rollout(world, state, dt=np.pi / rate / 200, steps=200)  # half a period
    assert_allclose(motion["b.angle"][-1], -small, rtol=1e-3)
    assert_allclose(motion["b.angle"][100], 0.0, atol=2e-3 * small)
    heights = motion.state.x[:, 0, 1] + d * motion.state.q[:, 0, 0]
    assert_allclose(heights, R, atol=1e-9)  # it stays on the floor


def test_mass_properties_are_those_of_the_whole():
    """An L of two bars, by the parallel axis theorem; turned parts, and parts of different density."""
    bars = {"foot": dr.Box(half=(0.3, 0.1)), "leg": dr.Part(dr.Box(half=(0.2, 0.1)), x=(0.2, 0.3), angle=np.pi / 2)}
    world, state = dr.scene({"L": dr.Body(bars, density=2.0, x=(5.0, 6.0))})
    areas, centers = np.array([0.12, 0.08]), np.array([(0.0, 0.0), (0.2, 0.3)])
    center = areas @ centers / 0.2
    own = areas * [(0.36 + 0.04) / 12, (0.16 + 0.04) / 12]
    inertia = 2.0 * (own + areas * ((centers - center) ** 2).sum(1)).sum()
    assert_allclose(world.bodies.mass, [0.4])
    assert_allclose(world.bodies.inertia, [inertia])
    assert_allclose(read(world, state, "L.shape.leg.x"), centers[1] - center)
    assert_allclose(read(world, state, "L.shape.leg.angle"), np.pi / 2)
    assert_allclose(read(world, state, "L.density"), 2.0)
    heavier, _ = write(world, state, "L.density", 3.0)
    assert_allclose(heavier.bodies.inertia, [1.5 * inertia])

    heavy = {"foot": dr.Part(bars["foot"], mass=1.0), "leg": dr.Part(dr.Box(half=(0.1, 0.2)), x=(0.2, 0.3), mass=3.0)}
    world, state = dr.scene({"L": dr.Body(heavy, x=(0.0, 0.0))})
    assert_allclose(world.bodies.mass, [4.0])
    assert_allclose(read(world, state, "L.shape.leg.x"), [0.05, 0.075])
    about = 1.0 * ((0.36 + 0.04) / 12 + 0.15**2 + 0.225**2) + 3.0 * ((0.16 + 0.04) / 12 + 0.05**2 + 0.075**2)
    assert_allclose(world.bodies.inertia, [about])


def two_dumbbells():
    disc = dr.Disc(radius=0.1)
    parts = {"low": dr.Part(disc, x=(-0.3, 0.0)), "high": dr.Part(disc, x=(0.3, 0.0))}
    one = dr.Body(parts, density=1.0, x=(0.0, 0.0), v=(1.0, 0.0), w=2.0)
    two = dr.Body(parts, density=2.0, x=(1.0, 0.3), angle=2.0, w=-4.0)
    return dr.scene({"one": one, "two": two}, restitution=1.0)


def two_hammers():
    """Bars and discs, so that of two pairs of their shapes either body comes first."""
    bar, disc = dr.Box(half=(0.3, 0.05)), dr.Part(dr.Disc(radius=0.15), x=(0.3, 0.0))
    one = dr.Body({"bar": bar, "head": disc}, density=1.0, x=(0.0, 0.0), v=(1.0, 0.0), w=2.0)
    two = dr.Body({"head": disc, "bar": bar}, density=2.0, x=(1.0, 0.3), angle=2.0, w=-4.0)
    return dr.scene({"one": one, "two": two}, restitution=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [two_dumbbells, two_hammers])
def test_bodies_of_parts_keep_momenta_and_energy_and_have_slopes(scene):
    """Slopes by where a part sits, how large it is, and a spin, against differences."""
    world, state = scene()
    part = "one.shape.high" if scene is two_dumbbells else "one.shape.head"
    names = f"{part}.radius", f"{part}.x[0]", "two.w[0]"

    def end(values):
        pair = world, state
        for name, value in zip(names, values, strict=True):
            pair = write(*pair, name, value)
        motion = dr.rollout(*pair, dt=1 / 30, steps=30).state
        return motion.x[-1].ravel(), motion

    run, steps = with_slopes(end), 1e-6 * np.eye(len(names))
    at = jnp.array([read(world, state, name) for name in names])
    (_, motion), ((slopes,), _) = run(at)
    assert np.abs(motion.w[-1] - motion.w[0]).max() > 0.5  # they met
    for law in (dr.momentum, dr.angular_momentum, dr.kinetic_energy):
        before, after = (law(world.bodies, jax.tree.map(lambda leaf, k=k: leaf[k], motion)).sum(0) for k in (0, -1))
        assert_allclose(after, before, atol=1e-12)
    differences = np.stack([(run(at + h)[0][0] - run(at - h)[0][0]) / 2e-6 for h in steps], axis=1)
    assert np.abs(differences).max(0).min() > 1e-3  # each of them matters
    assert_allclose(slopes, differences, atol=1e-7)


def test_gaps_and_contacts_know_all_parts():
    parts = {"low": dr.Part(dr.Disc(radius=0.1), x=(0.0, -0.5)), "high": dr.Part(dr.Disc(radius=0.1), x=(0.0, 0.5))}
    world, state = dr.scene({"b": dr.Body(parts, mass=1.0, x=(0.0, 1.0), angle=np.pi), "floor": FLOOR}, **LAW)
    assert_allclose(dr.gap(world, state, "b", "floor"), 0.4)
    shown = str(world)
    assert "b (Disc, Disc)" in shown and "high.x [0, 0.5] m" in shown
    found = dr.contacts(dr.rollout(world, state, dt=1 / 60, steps=30))
    assert found.point.shape == (1, 2)
    assert_allclose(found.point[0], [0.0, 0.0], atol=1e-6)
    assert_allclose(found.t[0], np.sqrt(2 * 0.4 / 9.81), atol=1e-3)


def test_scene_files_have_parts(tmp_path):
    text = """
    [bodies.hammer]
    mass = 0.5
    x = [1.0, 1.0]
    parts.handle = { shape = { box = { half = [0.15, 0.01] } } }
    parts.head = { shape = { box = { half = [0.05, 0.02] } }, x = [0.15, 0.0], angle = 1.5 }
    """
    (tmp_path / "hammer.toml").write_text(text)
    world, state = dr.load_scene(tmp_path / "hammer.toml")
    assert {"hammer.shape.head.half", "hammer.shape.head.angle", "hammer.shape.handle.x"} <= set(catalogue(world))
    assert dr.load_scene(dr.save_scene(tmp_path / "hammer.json", world, state)) == (world, state)


BAR = dr.Box(half=(0.1, 0.1))
REFUSED = {
    "no parts": ({"shape": {}, "mass": 1.0}, "b.shape is empty"),
    "a bare part": ({"shape": dr.Part(BAR), "mass": 1.0}, "b.shape is a Part: expected a shape, or parts by name"),
    "a name with a dot": ({"shape": {"a.b": BAR}, "mass": 1.0}, r"'a.b' is not a name"),
    "no shape": ({"shape": {"a": 3.0}, "mass": 1.0}, "b.shape.a is 3.0: expected one of Disc"),
    "boundless": ({"shape": {"a": dr.HalfSpace(normal=(0.0, 1.0))}, "mass": 1.0}, "b.shape.a is a HalfSpace, which has no"),
    "of 3D": ({"shape": {"a": dr.Sphere(radius=0.1)}, "mass": 1.0}, "all 2D or all 3D.*b.shape.a"),
    "place": ({"shape": {"a": dr.Part(BAR, x=(0.0, 0.0, 0.0))}, "mass": 1.0}, r"b.shape.a.x has shape \(3,\)"),
    "both turns": ({"shape": {"a": dr.Part(BAR, angle=1.0, q=(1.0, 0.0))}, "mass": 1.0}, "b.shape.a: got both angle and q"),
    "mass twice": ({"shape": {"a": dr.Part(BAR, mass=1.0)}, "mass": 1.0}, "b.mass: its parts have masses already"),
    "mass of some": ({"shape": {"a": dr.Part(BAR, mass=1.0), "c": BAR}}, "b.shape.c has no mass, but other parts have"),
    "no mass": ({"shape": {"a": BAR, "c": BAR}}, "b: expected either mass"),
    "thin": ({"shape": {"a": dr.Box(half=(0.1, 0.0))}, "mass": 1.0}, "no volume to share the mass by"),
    "centre without inertia": ({"shape": {"a": BAR}, "mass": 1.0, "center": (0.1, 0.0)}, "b.center: expected parts"),
    "centre of one shape": ({"shape": BAR, "mass": 1.0, "inertia": 1.0, "center": (0.1, 0.0)}, "b.center: expected parts"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    given, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        dr.scene({"b": dr.Body(x=(0.0, 0.0), **given)})


def test_a_static_has_one_shape():
    with pytest.raises(ValueError, match="wall.shape has parts: expected one shape; give each part a Static"):
        dr.scene({"b": dr.Body(BAR, mass=1.0, x=(0.0, 5.0)), "wall": dr.Static({"a": BAR})})
