"""`scene`: what it makes of what users write, and that each mistake is named together with its fix."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.paths import read, write

FLOOR = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
GROUND = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
SQUARE = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


def ball(shape=None, **changes):
    return dr.Body(shape or dr.Disc(radius=0.1), **{"mass": 1.0, "x": (0.0, 1.0)} | changes)


def brick(**changes):
    return dr.Body(dr.Box(half=(0.3, 0.2, 0.1)), **{"mass": 1.0, "x": (0.0, 0.0, 1.0)} | changes)


# ---- mistakes: (argument named in the message, what is expected and the fix, the scene)

MISTAKES = {
    "mass zero": (r"ball\.mass is 0: expected above 0; use Static", {"ball": ball(mass=0.0)}, {}),
    "mass negative": (r"ball\.mass is -2: expected above 0", {"ball": ball(mass=-2.0)}, {}),
    "density": (r"ball\.density is -1: expected above 0", {"ball": ball(mass=None, density=-1.0)}, {}),
    "mass and density": (r"ball: expected either mass .* got both", {"ball": ball(density=1.0)}, {}),
    "no mass": (r"ball: expected either mass .* got neither", {"ball": ball(mass=None)}, {}),
    "inertia in the plane": (r"ball\.inertia is -1: expected above 0", {"ball": ball(inertia=-1.0)}, {}),
    "inertia indefinite": (
        r"brick\.inertia has principal values -1, 1, 1: expected all above 0; check",
        {"brick": brick(inertia=(1.0, -1.0, 1.0))},
        {},
    ),
    "inertia triangle": (
        r"brick\.inertia .* larger than the sum of the others \(triangle inequality\).* check",
        {"brick": brick(inertia=(1.0, 1.0, 2.1))},
        {},
    ),
    "inertia skew": (r"brick\.inertia is not symmetric: .* average", {"brick": brick(inertia=np.eye(3) + np.eye(3, k=1) / 2)}, {}),
    "inertia shape": (r"brick\.inertia has shape \(2,\): expected a number, three", {"brick": brick(inertia=(1.0, 1.0))}, {}),
    "q in the plane": (r"ball\.q has length 1\.1: expected 1; divide", {"ball": ball(q=(1.1, 0.0))}, {}),
    "q in space": (r"brick\.q has length 2: expected 1; divide", {"brick": brick(q=(1.0, 1.0, 1.0, 1.0))}, {}),
    "angle and q": (r"ball: got both angle and q; give one", {"ball": ball(angle=0.1, q=(1.0, 0.0))}, {}),
    "angle in space": (r"brick\.angle: expected q", {"brick": brick(angle=0.1)}, {}),
    "restitution": (r"restitution is 1\.2: expected 0 .* to 1 .*; clip", {"ball": ball()}, {"restitution": 1.2}),
    "own restitution": (r"ball\.restitution is -0\.1: expected 0", {"ball": ball(restitution=-0.1)}, {}),
    "friction": (r"friction is -0\.3: expected 0 or above; drop the sign", {"ball": ball()}, {"friction": -0.3}),
    "own friction": (r"ball\.friction is -1: expected 0 or above", {"ball": ball(friction=-1.0)}, {}),
    "falloff": (r"falloff is -1: expected 0 or above", {"ball": ball()}, {"restitution_falloff": -1.0}),
    "own falloff": (r"ball\.restitution_falloff is -1: expected 0", {"ball": ball(restitution_falloff=-1.0)}, {}),
    "polygon clockwise": (
        r"ball\.shape\.vertices goes clockwise: reverse the order",
        {"ball": ball(dr.Polygon(vertices=SQUARE[::-1]))},
        {},
    ),
    "polygon not convex": (
        r"ball\.shape\.vertices is not convex at vertex 3: split it",
        {"ball": ball(dr.Polygon(vertices=(*SQUARE[:3], (0.5, 0.0))))},
        {},
    ),
    "radius": (r"ball\.shape\.radius is 0\.0 m: expected above 0; .* None", {"ball": ball(dr.Disc(radius=0.0))}, {}),
    "half space that moves": (r"ball\.shape is a HalfSpace.* make ball a Static", {"ball": ball(FLOOR.shape)}, {}),
    "normal": (
        r"floor\.shape\.normal has length 2: expected a unit vector; divide",
        {"ball": ball(), "floor": dr.Static(dr.HalfSpace(normal=(0.0, 2.0)))},
        {},
    ),
    "no position": (r"ball\.x is missing: expected the centre of mass", {"ball": ball(x=None)}, {}),
    "wrong shape": (r"ball\.v has shape \(3,\): expected numbers of shape \(2,\)", {"ball": ball(v=(1.0, 0.0, 0.0))}, {}),
    "not numbers": (r"ball\.v is 'fast': expected numbers", {"ball": ball(v="fast")}, {}),
    "NaN": (r"ball\.v is \[nan +0\.\]: expected finite numbers; look", {"ball": ball(v=(np.nan, 0.0))}, {}),
    "NaN in a shape": (r"ball\.shape\.radius is not finite", {"ball": ball(dr.Disc(radius=np.nan))}, {}),
    "NaN in gravity": (r"gravity is \[ 0\. nan\]: expected finite", {"ball": ball()}, {"gravity": (0.0, np.nan)}),
    "two dimensions": (r"all 2D or all 3D, but got \{'gravity': 3.*'ball\.x': 2", {"ball": ball()}, {"gravity": (0, 0, -9.81)}),
    "no name": (r"bodies: 'a\.b' is not a name: .* rename", {"a.b": ball()}, {}),
    "nothing moves": (r"bodies has no Body, only \['floor'\]: .* add", {"floor": FLOOR}, {}),
    "ignored stranger": (r"ignore names 'bal', .* did you mean 'ball'", {"ball": ball(), "floor": FLOOR}, {"ignore": [("bal", "floor")]}),
    "force on a stranger": (
        r"torque\.body is 'bal', which is not a moving body: did you mean 'ball'",
        {"ball": ball()},
        {"forces": [dr.Torque(body="bal", tau=1.0)]},
    ),
    "not a force": (r"forces: 'function' is .*: expected a record", {"ball": ball()}, {"forces": [lambda: None]}),
    "width": (r"contact\.width is -1: expected 0 or above", {"ball": ball()}, {"contact": dr.Contact(width=-1.0)}),
    "missing pair": (
        r"no collision function for Odd with Disc",
        {"ball": ball(), "other": ball(x=(5.0, 1.0))},
        {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(mistake, monkeypatch):
    message, bodies, options = MISTAKES[mistake]
    if mistake == "missing pair":
        monkeypatch.delitem(dr.scene.__globals__["COLLIDERS"], (dr.Disc, dr.Disc))
        message = "no collision function for Disc with Disc.*ignore"
    with pytest.raises(ValueError, match=message):
        dr.scene(bodies, **options)


CALLS = {
    r"Gravity takes nothing without a name: Gravity\(g=\.\.\.\)": lambda: dr.Gravity((0.0, -9.81)),
    r"Body takes only shape without a name: Body\(shape, mass=\.\.\.,": lambda: dr.Body(dr.Disc(radius=0.1), 1.0),
    r"Box has no 'size': there are half": lambda: dr.Box(size=(1.0, 1.0)),
    r"Revolute has no 'anchor': did you mean 'anchor_b' or 'anchor_a'\?": lambda: dr.Revolute("a", anchor=(0.0, 0.0)),
    r"Record has no 'strat': did you mean .*'start'": lambda: dr.Record({}, strat=1.0),
    r"Disc lacks radius: Disc\(radius=\.\.\.\)": lambda: dr.Disc(),
    r"Marker: body is given twice": lambda: dr.Marker("a", body="b"),
}


@pytest.mark.parametrize("message", CALLS)
def test_a_record_says_how_it_is_written(message):
    with pytest.raises(TypeError, match=message):
        CALLS[message]()


def one_ball():
    return dr.scene({"ball": ball()}, gravity=(0.0, -9.81))


RUNS = {
    "dt zero": (r"dt is 0.*expected > 0", lambda w, s: dr.step(w, s, 0.0)),
    "dt negative": (r"dt is -.*expected > 0", lambda w, s: dr.rollout(w, s, dt=-0.1, steps=2)),
    "dt NaN": (r"dt is nan.*expected > 0", lambda w, s: dr.step(w, s, np.nan)),
    "no steps": (r"steps is 0, expected an integer >= 1", lambda w, s: dr.rollout(w, s, dt=0.1, steps=0)),
    "half steps": (r"steps is 1\.5, expected an integer", lambda w, s: dr.rollout(w, s, dt=0.1, steps=1.5)),
    "steps and times": (r"either steps or times, got both", lambda w, s: dr.rollout(w, s, dt=0.1, steps=1, times=(0.0, 1.0))),
    "neither": (r"either steps or times, got neither", lambda w, s: dr.rollout(w, s, dt=0.1)),
    "times that turn": (r"times must increase", lambda w, s: dr.rollout(w, s, dt=0.1, times=(0.0, 1.0, 0.5))),
    "one time": (r"times has shape \(1,\)", lambda w, s: dr.rollout(w, s, dt=0.1, times=(0.0,))),
    "exchanged": (r"expected \(world, state\)", lambda w, s: dr.step(s, w, 0.1)),
    "unknown path": (r"no parameter 'ball\.mas' .* did you mean 'ball\.mass'", lambda w, s: read(w, s, "ball.mas")),
    "no path": (r"path is 3: expected the name of a parameter", lambda w, s: read(w, s, 3)),
    "energy of a world": (r"bodies is a World: expected world\.bodies", lambda w, s: dr.kinetic_energy(w, s)),
    "momentum exchanged": (r"bodies is a State: expected world\.bodies", lambda w, s: dr.momentum(s, w.bodies)),
    "point of no state": (r"state is a NoneType: expected a State", lambda *_: dr.material_point(None, 0, np.zeros(2))),
    "contacts at a name": (
        "times is 'impact': expected numbers",
        lambda w, s: dr.contacts(dr.rollout(w, s, dt=0.1, steps=1), times="impact"),
    ),
    "path of wrong shape": (r"ball\.v.*shape \(3,\): expected", lambda w, s: write(w, s, "ball.v", jnp.zeros(3))),
    "state of another dimension": (
        r"state\.x has shape \(1, 3\), expected \(N=1, D=2, \*batch\)",
        lambda w, _: dr.step(w, dr.scene({"brick": brick()})[1], 0.1),
    ),
    "state of other bodies": (
        r"state\.x has shape \(2, 2\), expected \(N=1",
        lambda w, _: dr.step(w, dr.scene({"a": ball(), "b": ball(x=(5.0, 0.0))})[1], 0.1),
    ),
    "one control of two sizes": (
        "'u' is the control of a Force and of a Torque",
        lambda *_: dr.step(
            *dr.scene({"ball": ball()}, forces=[dr.Force("ball", control="u"), dr.Torque("ball", control="u")]),
            0.1, {"u": np.ones(1)},
        ),
    ),
    "integers": (
        r"state\.v has type int.*, expected floating point: convert",
        lambda w, s: dr.step(w, dr.replace(s, v=jnp.zeros((1, 2), int)), 0.1),
    ),
    "batches that differ": (
        r"batch axes do not fit: .*length 3 .* 2",
        lambda w, s: dr.step(w, dr.replace(s, x=jnp.zeros((1, 2, 3)), v=jnp.zeros((1, 2, 2))), 0.1),
    ),
}  # fmt: skip


def test_times_of_a_clock_are_not_rounded_before_they_are_subtracted():
    world, state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), one_ball())
    t = np.arange(31) / 60
    late = dr.rollout(world, state, dt=1 / 60, times=1.7e9 + t)
    assert_allclose(late.state.x, dr.rollout(world, state, dt=1 / 60, times=t).state.x, atol=1e-5)


@pytest.mark.parametrize("mistake", RUNS)
def test_mistakes_in_a_run_are_named(mistake):
    message, run = RUNS[mistake]
    with pytest.raises(ValueError, match=message):
        run(*one_ball())


# ---- overlap at the start


@pytest.mark.parametrize("depth", [0.05, -0.05, 0.0])
def test_overlap_warns_with_names(depth):
    bodies = {"ball": ball(x=(0.0, 0.1 - depth)), "other": ball(x=(3.0, 1.0)), "floor": FLOOR}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dr.scene(bodies)
        dr.scene(bodies, ignore=[("ball", "floor")])
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == (depth > 0)
    assert all("ball and floor by 0.05 m;" in m and "other" not in m and "ignore" in m for m in messages)


# ---- what comes out


def test_every_leaf_is_a_strongly_typed_float():
    """So a changed value never traces anew."""
    world, state = dr.scene({"ball": ball(v=(1, 2)), "floor": FLOOR}, gravity=(0, -10), restitution=1, friction=0)
    for leaf in jax.tree.leaves((world, state)):
        assert leaf.dtype == jnp.float64 and not leaf.weak_type


def test_order_of_bodies_is_that_of_names():
    world, state = dr.scene({"b": ball(x=(2.0, 1.0)), "floor": FLOOR, "a": ball(x=(1.0, 5.0), mass=3.0)})
    assert world.names == ("b", "a") and world.static_names == ("floor",)
    assert_allclose(state.x[:, 0], [2.0, 1.0])
    assert_allclose(world.bodies.mass, [1.0, 3.0])


def test_centre_of_mass_off_the_origin_of_the_shape():
    """A triangle is posed by its centre of mass: its lowest corner is 1/3 of its height below it."""
    triangle = dr.Polygon(vertices=((0.0, 0.0), (1.0, 0.0), (0.0, 0.9)))
    below = {"corner": ball(triangle, x=(0.0, 0.3 + 1e-3)), "floor": FLOOR}
    world, state = dr.scene(below)
    moved = dr.step(world, dr.replace(state, v=jnp.array([[0.0, -1.0]])), 2e-3)
    assert abs(moved.v[0, 1]) < 1e-9  # struck flat after 1 mm, without rebound
    with pytest.warns(UserWarning, match="corner and floor"):
        dr.scene(below | {"corner": ball(triangle, x=(0.0, 0.3 - 1e-3))})


def test_mass_of_a_scene_from_traced_values():
    """A loss may build its scene: the derivative of the mass of a disc, pi r^2 density, by both."""

    def mass(radius, density):
        world, _ = dr.scene({"disc": dr.Body(dr.Disc(radius=radius), density=density, x=(0.0, 0.0))})
        return world.bodies.mass[0]

    by_radius, by_density = jax.grad(mass, (0, 1))(0.5, 2.0)
    assert_allclose(by_radius, 2 * np.pi * 0.5 * 2.0, rtol=1e-12)
    assert_allclose(by_density, np.pi * 0.25, rtol=1e-12)


def test_a_value_of_its_own_outweighs_the_default():
    """Mean of the two sides; what a body was given counts alone against what the scene gave."""

    def rebound(**own):
        bodies = {"ball": ball(x=(0.0, 0.1), v=(0.0, -1.0), **own), "floor": FLOOR}
        world, state = dr.scene(bodies, restitution=0.5)
        return dr.step(world, state, 1e-3).v[0, 1]

    assert_allclose(rebound(), 0.5, rtol=1e-12)
    assert_allclose(rebound(restitution=0.9), 0.9, rtol=1e-12)


@pytest.mark.parametrize("body", [ball(), brick()], ids=["2D", "3D"])
def test_a_body_without_a_shape_flies(body):
    dim = len(body.x)
    free = dr.Body(None, mass=2.0, inertia=0.5 if dim == 2 else (0.5, 0.6, 0.7), x=body.x, v=np.ones(dim))
    ground = FLOOR if dim == 2 else GROUND
    world, state = dr.scene({"free": free, "ground": ground}, gravity=-10.0 * np.eye(dim)[-1])
    after = dr.rollout(world, state, dt=0.1, steps=10).state
    assert_allclose(after.x[-1, 0], np.asarray(body.x) + 1.0 - 5.0 * np.eye(dim)[-1], rtol=1e-12)


@pytest.mark.slow
def test_plates_without_thickness_may_lie_side_by_side():
    """Some of their edges have no length."""
    plate = dr.Box(half=(0.5, 0.5, 0.0))
    bodies = {str(k): dr.Body(plate, mass=1.0, x=(1.001 * k, 0.0, 0.0)) for k in range(2)}
    world, state = dr.scene(bodies)
    assert_allclose(dr.gap(world, state, "0", "1"), 0.001, atol=1e-12)


def test_a_contact_is_checked_where_it_is_made_or_replaced():
    with pytest.raises(ValueError, match=r"contact\.sweeps is 0: expected an integer above 0"):
        dr.Contact(sweeps=0)
    world, state = dr.scene({"ball": ball()})
    with pytest.raises(ValueError, match=r"contact\.width is -0\.1: expected 0 or above"):
        dr.step(dr.replace(world, contact=dr.Contact(width=-0.1)), state, 1e-2)
