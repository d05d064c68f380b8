"""Laws and symmetries of scenes that hypothesis draws; see `drawn.py` for how many.

A scene here is a structure, compiled once, of which only the numbers are drawn; zeros, ends of ranges and faces that
touch come often.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import few_or_many, for_all
from hypothesis import assume
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import diffrigid as dr
from diffrigid import so2, so3

STEPS = 3
EPS = 2.0**-52

# ---- scenes: every number of one is a leaf of a dict


def own(p, i):
    return {name: p[name][i] for name in ("mass", "x", "q", "v", "w")}


def made(p, bodies, **more):
    contact = dr.Contact(width=p["width"], rest_speed=p["rest_speed"])
    return dr.scene(bodies, restitution=p["e"], friction=p["mu"], contact=contact, **more)


def discs(p):
    """Two discs over a floor."""
    bodies = {name: dr.Body(dr.Disc(radius=p["size"][i, 0]), **own(p, i)) for i, name in enumerate("ab")}
    floor = dr.Static(dr.HalfSpace(normal=p["normal"], offset=p["offset"]))
    return made(p, {**bodies, "floor": floor}, gravity=p["g"])


def flat(p):
    """A box and a capsule, free."""
    box = dr.Body(dr.Box(half=p["size"][0]), **own(p, 0))
    capsule = dr.Body(dr.Capsule(radius=p["size"][1, 0], half_length=p["size"][1, 1]), **own(p, 1))
    return made(p, {"a": box, "b": capsule})


def deep(p):
    """A box and a sphere, free in space."""
    box = dr.Body(dr.Box(half=p["size"][0]), **own(p, 0))
    return made(p, {"a": box, "b": dr.Body(dr.Sphere(radius=p["size"][1, 0]), **own(p, 1))})


def hinge(p):
    """Two bodies without shapes, on a hinge."""
    inertia = p["mass"] * p["size"][:, 0] ** 2
    bodies = {name: dr.Body(None, inertia=inertia[i], **own(p, i)) for i, name in enumerate("ab")}
    return made(p, bodies, joints=[dr.Revolute("b", "a", anchor_a=p["anchor"])])


SCENES = {"discs": discs, "flat": flat, "deep": deep, "hinge": hinge}
FREE = ("flat", "deep", "hinge")


def dim_of(name):
    return 3 if name == "deep" else 2


def motion(name, p):
    world, state = SCENES[name](p)
    return dr.rollout(world, state, dt=p["dt"], steps=STEPS).state


def with_sums(name, p):
    """States, and the sums over the bodies that laws are about."""
    (world, _), states = SCENES[name](p), motion(name, p)
    laws = {"P": dr.momentum, "L": dr.angular_momentum, "E": dr.kinetic_energy}
    sums = {key: jax.vmap(lambda state, law=law: law(world.bodies, state).sum(0))(states) for key, law in laws.items()}
    if name in ("flat", "deep"):
        sums["gap"] = jax.vmap(lambda state: dr.gap(world, state, "a", "b"))(states)
    return states, sums, world.bodies.inertia


@cache
def compiled(kind, name):
    """A program of a scene, as NumPy sees it."""
    programs = {
        "motion": partial(with_sums, name),
        "forward": lambda p, d: jax.jvp(partial(motion, name), (p,), (d,))[1],
        "reverse": lambda p, weights: jax.vjp(partial(motion, name), p)[1](weights)[0],
        "together": jax.vmap(partial(with_sums, name)),
    }
    program = jax.jit(programs[kind], compiler_options=dr.QUICK)
    return lambda *inputs: jax.tree.map(np.asarray, program(*inputs))


@pytest.fixture(scope="module", autouse=True)
def _forget():
    yield
    compiled.cache_clear()


# ---- numbers

# What is slower than this, and does not rest, has derivatives by its direction whose products overflow.
SLOW = 1e-60


def signed(size):
    return st.one_of(
        st.just(0.0), st.floats(SLOW, size), st.floats(-size, -SLOW), st.integers(-int(size), int(size)).map(float)
    )


def between(low, high):
    return st.one_of(st.sampled_from((low, high)), st.floats(low, high))


def vector(dim, size):
    return st.lists(signed(size), min_size=dim, max_size=dim).map(np.array)


def two(strategy):
    return st.tuples(strategy, strategy).map(np.array)


def turned_by(turn):
    so = so2 if len(turn) == 1 else so3
    return np.asarray(so.exp(jnp.asarray(turn)))


@st.composite
def scenes(draw, name, inside=False):
    """Two bodies that fly at each other, past each other, or rest; at a distance, or touching.

    Args:
        inside: they may also overlap, up to sitting in the same place, of which `scene` warns: nothing is said then of
            energy, but what comes out is to be finite.
    """
    dim = dim_of(name)
    turns = 1 if dim == 2 else 3
    size, mass = draw(two(st.tuples(*[between(1e-2, 10.0)] * dim))), draw(two(between(1e-3, 1e3)))
    dt = draw(st.sampled_from((1 / 240, 1 / 64, 1 / 60, 1 / 30)))
    q = np.array([turned_by(draw(vector(turns, 3.0))) for _ in "ab"])
    w = draw(two(vector(turns, 50.0 if dim == 2 else 0.25 / dt)))  # in space what turns further in a step is less exact
    to = draw(vector(dim, 1.0))
    to = to / np.linalg.norm(to) if np.linalg.norm(to) > 0.1 else np.eye(dim)[0]
    # No further apart than their corners reach.
    reach = size[:, 0] if name == "discs" else np.array([np.linalg.norm(size[0]), size[1, 0] + (dim == 2) * size[1, 1]])
    slack = draw(st.one_of(st.just(0.0), st.floats(1e-9, 2.0)))
    far = reach.sum() * draw(between(0.0, 1.0)) if inside and draw(st.booleans()) else reach.sum() + slack
    x = draw(vector(dim, 10.0))
    v = draw(st.sampled_from((0.0, 1.0))) * draw(two(vector(dim, 50.0)))
    v = v + draw(st.one_of(st.just(0.0), st.floats(1e-3, 50.0))) * np.array([to, -to])
    p = dict(
        size=size, mass=mass, q=q, v=v, w=w, x=np.array([x, x + far * to]), dt=dt, e=draw(between(0.0, 1.0)),
        mu=draw(st.one_of(between(0.0, 1.0), between(0.0, 100.0))), rest_speed=1e-3,
        width=size.min() * draw(st.one_of(st.just(0.0), st.floats(1e-4, 1.0))),
    )  # fmt: skip
    if name == "discs":
        p |= {
            "normal": np.array([0.0, 1.0]),
            "offset": 0.0,
            "g": draw(st.sampled_from(((0.0, 0.0), (0.0, -9.81), (3.0, -8.0)))),
        }
        p["x"] = p["x"] - np.array([0.0, (p["x"][:, 1] - size[:, 0]).min() - draw(between(0.0, 1.0))])
    if name == "hinge":  # arms and radii of gyration of a size, and no turn by more than a step resolves
        p["size"] = draw(two(st.tuples(between(0.5, 2.0), st.just(1.0))))
        arms = draw(two(vector(2, 1.0)))
        p["x"] = np.array([x, x + arms[0] - arms[1]])
        p["anchor"] = np.array(so2.unrotate(jnp.asarray(q[1]), jnp.asarray(arms[1])))  # on b
        w, u = 0.1 / dt / 50.0 * w, 0.1 / dt / 50.0 * v[0]
        p["v"], p["w"] = u - w * (arms[:, ::-1] * (-1.0, 1.0)), w  # the joint moves with u on both, else it is torn
    return {key: np.asarray(value, float) for key, value in p.items()}


# ---- laws


def assert_finite(tree, what):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)), f"{what}: {tree}"


def directions(p, seed=0):
    rng = np.random.default_rng(seed)
    return {key: rng.normal(size=value.shape) for key, value in p.items()}


# Compiling takes the time: tangents of two discs over a floor a quarter of a minute, reverse mode half a minute.
in_turn = pytest.mark.parametrize(
    "name, modes",
    [("hinge", ("forward", "reverse")), ("discs", ()), ("deep", ())]
    + [pytest.param(name, ("forward", "reverse"), marks=pytest.mark.slow) for name in ("discs", "flat")]
    + [pytest.param("deep", ("forward",), marks=pytest.mark.slow)],
)


@few_or_many
@in_turn
def test_values_and_slopes_are_finite(name, modes, count):
    def check(p):
        states, sums, _ = compiled("motion", name)(p)
        assert_finite((states, sums), "values")
        # Two roundings of q / |q|.
        assert_allclose(np.linalg.norm(states.q, axis=-1), 1.0, rtol=0, atol=2 * EPS)
        if "forward" in modes:
            assert_finite(compiled("forward", name)(p, directions(p)), "tangents")
        if "reverse" in modes:
            assert_finite(compiled("reverse", name)(p, states), "gradient")

    for_all(check, scenes(name, inside=True), count)


@few_or_many
@pytest.mark.parametrize(
    "name", ["hinge", pytest.param("discs", marks=pytest.mark.slow), pytest.param("flat", marks=pytest.mark.slow)]
)
def test_modes_agree(name, count):
    def check(p):
        d, weights = directions(p), compiled("motion", name)(p)[0]
        tangents, slopes = compiled("forward", name)(p, d), compiled("reverse", name)(p, weights)
        forward = [w * t for w, t in zip(jax.tree.leaves(weights), jax.tree.leaves(tangents), strict=True)]
        reverse = [slopes[key] * d[key] for key in p]
        size = sum(np.abs(part).sum() for part in forward + reverse)
        # The terms of both sums are rounded, and those within, which cancel to them.
        assert abs(sum(map(np.sum, forward)) - sum(map(np.sum, reverse))) <= 1e-9 * size

    for_all(check, scenes(name), count)


@few_or_many
@pytest.mark.parametrize("name", FREE)
def test_momenta_are_kept_and_energy_does_not_rise(name, count):
    def check(p):
        states, sums, inertia = compiled("motion", name)(p)
        # What turns so far in a step that it strikes more often than there are sweeps ends inside, and is pushed out.
        assume(name == "hinge" or sums["gap"].min() > -1e-3 * p["size"].min())
        P_size = (p["mass"][:, None] * np.abs(states.v)).sum((1, 2)).max()
        arms = np.abs(states.x).max() + p["size"].max()
        spin = (np.abs(inertia).reshape(2, -1).max(1)[:, None] * np.abs(states.w)).sum((1, 2)).max()
        L_size = spin + arms * P_size
        # Each of STEPS has some ten passes, each of which rounds what it adds.
        rounding = 10 * STEPS * 4 * EPS
        assert np.abs(sums["P"] - sums["P"][0]).max() <= rounding * P_size
        # A hinge is integrated to fourth order, so a turn of 0.1 in a step is off by 0.1^5 at most.
        assert np.abs(sums["L"] - sums["L"][0]).max() <= (1e-5 if name == "hinge" else rounding) * L_size
        # Bodies that rest on each other are moved apart by what a step overlooked: of random ones, up to 3e-5.
        assume(name != "deep" or np.abs(states.w).max() * p["dt"] < 0.5)  # beyond, the series is documented to be rough
        assert np.diff(sums["E"]).max() <= 1e-4 * sums["E"][0]

    for_all(check, scenes(name), count)


# ---- symmetries


def spread(name, p, scale):
    """The motion from p, and how far it moves if the numbers are rounded otherwise, each by EPS of `scale` or itself.

    What is computed in another way cannot be told from that.
    """
    rng, ends = np.random.default_rng(0), []
    for _ in range(8):
        q = {
            key: value + 8 * EPS * rng.choice((-1.0, 1.0), value.shape) * np.maximum(np.abs(value), scale.get(key, 0.0))
            for key, value in p.items()
        }
        q["q"] = q["q"] / np.linalg.norm(q["q"], axis=-1, keepdims=True)
        q["e"], q["dt"] = np.minimum(q["e"], 1.0), p["dt"]
        ends.append(compiled("motion", name)(q)[0])
    states = compiled("motion", name)(p)[0]
    return states, jax.tree.map(
        lambda leaf, *others: np.max([np.abs(other - leaf) for other in others], 0), states, *ends
    )


def assert_same_motion(name, p, q, back, shift=0.0, boost=0.0):
    """The motion from the numbers q is that from p after `back`, a function of its states."""
    least, t = p["size"].min(), STEPS * p["dt"]
    lengths = np.abs(p["x"]).max() + p["size"].max() + shift
    # Shapes that touch may overlap by rounding, which is mended within a step.
    speeds = np.abs(p["v"]).max() + boost + p["size"].max() * np.abs(p["w"]).max() + lengths / p["dt"]
    given = {
        "x": lengths,
        "v": speeds,
        "w": np.abs(p["w"]).max(),
        "q": 1.0,
        "anchor": 1.0,
        "g": np.abs(p.get("g", 0.0)).max(),
    }
    states, moved = spread(name, p, given)
    other = back(compiled("motion", name)(q)[0])
    # A normal turns by the rounding of places over a size; an impulse on a light body is that on a heavy one, rounded.
    v = speeds * lengths / least * p["mass"].max() / p["mass"].min()
    rounded = {"x": lengths + v * t, "v": v, "w": v / least, "q": 1.0 + v / least * t}
    # Where roundings part so far no motion is the right one: a ton is balanced on a gram, or a corner just misses.
    assume(all(getattr(moved, field).max() <= 1e-6 * size for field, size in rounded.items()))
    for field, size in rounded.items():
        off = np.abs(getattr(other, field) - getattr(states, field)).max()
        assert off <= 64 * EPS * size + 16 * getattr(moved, field).max(), field


def everywhere(fn, *args):
    """fn of vectors, for arrays of them (..., D)."""
    flat = [np.asarray(a).reshape(-1, np.shape(a)[-1]) for a in args]
    count = max(len(a) for a in flat)
    rows = [jnp.broadcast_to(a, (count, a.shape[1])) for a in flat]
    return np.asarray(jax.vmap(fn)(*rows)).reshape(*np.shape(args[-1])[:-1], -1)


@few_or_many
@pytest.mark.parametrize("name", SCENES)
def test_where_it_is_and_which_way_it_is_turned_is_nothing(name, count):
    dim = dim_of(name)
    so = so2 if dim == 2 else so3

    def check(drawn):
        p, shift, turn = drawn
        turn = turned_by(turn)

        def rotate(r):
            return everywhere(so.rotate, turn, r)

        q = p | {"x": rotate(p["x"]) + shift, "v": rotate(p["v"]), "q": everywhere(so.compose, turn, p["q"])}
        q["w"] = p["w"] if dim == 2 else rotate(p["w"])
        if name == "discs":
            q |= {"normal": rotate(p["normal"]), "g": rotate(p["g"])}
            q["offset"] = np.dot(q["normal"], shift)

        def back(states):
            inverse = turn * np.r_[1.0, -np.ones(len(turn) - 1)]

            def unrotate(r):
                return everywhere(so.rotate, inverse, r)

            w = states.w if dim == 2 else unrotate(states.w)
            return dr.State(
                x=unrotate(states.x - shift), v=unrotate(states.v), w=w, q=everywhere(so.compose, inverse, states.q)
            )

        assert_same_motion(name, p, q, back, shift=np.abs(shift).max())

    for_all(check, st.tuples(scenes(name), vector(dim, 100.0), vector(1 if dim == 2 else 3, 3.0)), count)


@few_or_many
@pytest.mark.parametrize("name", FREE)
def test_how_fast_the_observer_moves_is_nothing(name, count):
    def check(drawn):
        p, u = drawn
        t = p["dt"] * np.arange(STEPS + 1)[:, None, None]

        def back(states):
            return dr.replace(states, x=states.x - u * t, v=states.v - u)

        assert_same_motion(name, p, p | {"v": p["v"] + u}, back, shift=np.abs(u * t).max(), boost=np.abs(u).max())

    for_all(check, st.tuples(scenes(name), vector(dim_of(name), 50.0)), count)


@few_or_many
@pytest.mark.parametrize("name", SCENES)
def test_the_mirror_image_moves_as_the_mirror_image(name, count):
    across = np.r_[-1.0, np.ones(dim_of(name) - 1)]
    w_sign = np.array([-1.0]) if dim_of(name) == 2 else -across
    signs = {
        "x": across,
        "v": across,
        "g": across,
        "normal": across,
        "anchor": across,
        "w": w_sign,
        "q": np.r_[1.0, w_sign],
    }

    def mirrored(states):
        return dr.State(**{field: getattr(states, field) * signs[field] for field in ("x", "q", "v", "w")})

    def check(p):
        q = {key: value * signs.get(key, 1.0) for key, value in p.items()}
        assert_same_motion(name, p, q, mirrored)

    for_all(check, scenes(name), count)


@few_or_many
def test_the_order_of_bodies_is_nothing(count):
    def swapped(states):
        return jax.tree.map(lambda leaf: leaf[:, ::-1], states)

    def check(p):
        q = {key: value[::-1] if key in ("mass", "size", "x", "q", "v", "w") else value for key, value in p.items()}
        assert_same_motion("discs", p, q, swapped)

    for_all(check, scenes("discs"), count)


UNITS = {  # by what the numbers are multiplied if the unit is: powers of length, time and mass
    "mass": (0, 0, 1), "size": (1, 0, 0), "x": (1, 0, 0), "v": (1, -1, 0), "w": (0, -1, 0), "dt": (0, 1, 0),
    "width": (1, 0, 0), "rest_speed": (1, -1, 0), "g": (1, -2, 0), "offset": (1, 0, 0), "anchor": (1, 0, 0),
}  # fmt: skip


@few_or_many
@pytest.mark.parametrize("name", SCENES)
def test_units_are_nothing(name, count):
    """To the last bit, where they differ by powers of two.

    On a hinge those of all; of free bodies not that of time, and over a floor only that of mass: there a gram under a ton,
    where many contacts are solved together, came out 1e-12 m and 3e-10 m elsewhere.
    """

    def check(drawn):
        p, powers = drawn

        def factor(key):
            return 2.0 ** np.dot(UNITS.get(key, (0, 0, 0)), powers)

        states = compiled("motion", name)(p)[0]
        other = compiled("motion", name)({key: value * factor(key) for key, value in p.items()})[0]
        for field in ("x", "q", "v", "w"):
            assert_array_equal(getattr(other, field), getattr(states, field) * factor(field), field)

    some, none = st.integers(-3, 3), st.just(0)
    powers = st.tuples(none if name == "discs" else some, some if name == "hinge" else none, some)
    for_all(check, st.tuples(scenes(name), powers), count)


@few_or_many
def test_one_step_is_two_of_half_the_length_where_nothing_acts(count):
    """Of what flies apart; a hinge or an impact would be solved in other steps."""

    def check(p):
        p = p | {"v": np.array([-1.0, 1.0])[:, None] * (p["x"][1] - p["x"][0]), "width": np.zeros(())}
        once, twice = (compiled("motion", "flat")(p | {"dt": dt})[0] for dt in (p["dt"], 0.5 * p["dt"]))
        size = np.abs(once.x).max() + np.abs(once.w).max()
        for field in ("x", "q", "v", "w"):
            assert_allclose(getattr(twice, field)[2], getattr(once, field)[1], rtol=0, atol=8 * EPS * (1.0 + size))

    for_all(check, scenes("flat"), count)


@few_or_many
@pytest.mark.parametrize("name", ["hinge", pytest.param("discs", marks=pytest.mark.slow)])
def test_vmap_is_one_after_the_other(name, count):
    def check(worlds):
        together = compiled("together", name)(jax.tree.map(lambda *rows: np.stack(rows), *worlds))
        for k, p in enumerate(worlds):
            assert_same_motion(name, p, p, lambda _, k=k: jax.tree.map(lambda leaf: leaf[k], together[0]))  # noqa: B023

    for_all(check, st.tuples(*[scenes(name)] * 3), count)
