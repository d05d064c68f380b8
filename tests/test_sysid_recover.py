"""Known parameters come back from noisy and partly missing records, and what cannot be known is said in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.sysid.diagnosis import reduced

WIDE = 1.7  # half widths of the 95 % interval within which a truth has to lie: 99.9 %, with the seed fixed


def check(fit, truth, widest):
    """Every truth lies near its interval, and no interval is wider than this share of the truth, or of one."""
    for name, value in truth.items():
        p, value = fit[name], np.asarray(value)
        half = 0.5 * (p.high - p.low)
        assert np.all(np.abs(p.value - value) < WIDE * half), (name, p)
        assert np.all(half < widest * np.maximum(np.abs(value), 1.0)), (name, p)


def missing(random, values, noise):
    """Values with noise, a tenth of them lost."""
    measured = values + noise * random.standard_normal(values.shape)
    return np.where(random.random(values.shape) < 0.1, np.nan, measured)


def test_a_friction_at_the_end_of_slip_has_no_upper_limit():
    """A disc that sticks when it strikes from some friction on: just below it all larger ones fit as well.

    Beyond it nothing depends on the friction, which it does where the fit begins. Without friction the fit ends at the
    lower bound, where larger ones do not fit.
    """

    def disc(friction):
        ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0), v=(2.0, 0.0))
        floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
        return dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), restitution=0.7, friction=friction)

    sticks = 2.0 / (3.0 * 1.7 * np.sqrt(2 * 9.81 * 0.9))  # v / 3 over (1 + e) times the speed of the impact
    t = np.arange(36) / 60
    free = {"friction": dr.interval(0, 1)}
    ends = ("begins to stick: larger values fit as well", "friction ended at a bound", "nothing slips")
    for share, said in ((0.995, ends[0]), (0.8, ""), (0.0, ends[1]), (1.3, ends[2])):
        measured = np.asarray(dr.rollout(*disc(share * sticks), dt=1 / 60, steps=35)["ball.x"])
        guess, data = disc(np.clip(share, 0.1, 0.995) * sticks), {"t": t, "ball.x": measured}
        found = dr.fit(*guess, data, free=free, noise={"ball.x": 1e-3}, progress=False)
        assert (found["friction"].high == 1.0) == bool(said)
        notes = repr(found)
        assert [words in notes for words in ends] == [words == said for words in ends]
        assert "hardly seen" not in notes


# ---- a ball that bounces, slips and spins in air, under a tilted gravity

BALL = {
    "restitution": 0.7, "friction": 0.07, "ball.inertia": 0.003, "ball.shape.radius": 0.1, "air.linear": (0.3, 0.3),
    "gravity": (0.6, -9.8), "ball.x": (0.0, 0.6), "ball.v": (1.2, 0.4), "ball.w": (6.0,), "ball.angle": 0.3,
    "tip.point": (0.05, 0.02),
}  # fmt: skip


def ball(restitution, friction, inertia, radius, drag, gravity, motion):
    body = dr.Body(dr.Disc(radius=radius), mass=0.5, inertia=inertia, **motion)
    return dr.scene(
        {"ball": body, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))},
        gravity=gravity, restitution=restitution, friction=friction, forces={"air": dr.Drag(linear=drag)},
    )  # fmt: skip


def test_a_bouncing_ball_tells_eleven_parameters():
    random, t = np.random.default_rng(0), np.arange(121) / 80
    motion = {"x": (0.0, 0.6), "v": (1.2, 0.4), "w": 6.0, "angle": 0.3}
    world, state = ball(0.7, 0.07, 0.003, 0.1, 0.3, (0.6, -9.8), motion)
    seen = dr.rollout(world, state, dt=1 / 80, times=t).state
    marker = jax.vmap(lambda s: dr.material_point(s, 0, np.array([0.05, 0.02])))(seen)[3::2]
    angle = np.unwrap(np.arctan2(seen.q[:, 0, 1], seen.q[:, 0, 0]))
    data = {
        "t": t,
        "ball.x": missing(random, np.asarray(seen.x[:, 0]), 1e-3),
        "ball.angle": missing(random, angle, 5e-3),
        "tip": (t[3::2], missing(random, np.asarray(marker), 1e-3)),  # by a second camera, at half the rate
    }
    free = {
        "restitution": dr.interval(0, 1), "friction": dr.positive(), "ball.inertia": dr.positive(),
        "ball.shape.radius": dr.positive(), "air.linear": dr.positive(), "gravity": dr.direction(), "ball.x": dr.real(),
        "ball.v": dr.real(), "ball.w": dr.real(), "ball.angle": dr.real(), "tip.point": dr.real(),
    }  # fmt: skip
    motion = {"x": (0.02, 0.62), "v": (1.0, 0.2), "w": 5.0, "angle": 0.2}
    start = ball(0.6, 0.05, 0.004, 0.11, 0.1, (0.0, -np.hypot(0.6, 9.8)), motion)
    fit = dr.fit(*start, data, free=free, observe={"tip": dr.Marker("ball", point=(0.04, 0.0))}, progress=False)
    check(fit, BALL, widest=0.04)
    assert_allclose(np.linalg.norm(fit["gravity"].value), np.hypot(0.6, 9.8), rtol=1e-12)  # a direction: its size stays
    assert_allclose([fit.noise[name] for name in data if name != "t"], [1e-3, 5e-3, 1e-3], rtol=0.2)
    assert not any("residuals" in note for note in fit.notes)


# ---- two points on a spring


def pair(mass_a=1.0, mass_b=1.5, stiffness=8.0, length=1.0):
    bodies = {
        name: dr.Body(None, mass=m, inertia=1.0, x=(x, 0.0)) for name, m, x in (("a", mass_a, 0.0), ("b", mass_b, 1.3))
    }
    ends = {"anchor_a": (0.0, 0.0), "anchor_b": (0.0, 0.0)}
    return dr.scene(
        bodies, forces={"spring": dr.SpringDamper(a="a", b="b", stiffness=stiffness, length=length, **ends)}
    )


def pair_record(names=("a", "b")):
    t = np.arange(40) / 20
    x = np.asarray(dr.rollout(*pair(), dt=1 / 20, times=t).state.x)
    random = np.random.default_rng(1)
    return {"t": t, **{f"{n}.x": missing(random, x[:, "ab".index(n)], 1e-3) for n in names}}


def test_mass_ratio_spring_constant_and_length():
    free = {("a.mass", "b.mass"): dr.shares(), "spring.stiffness": dr.positive(), "spring.length": dr.positive()}
    fit = dr.fit(*pair(1.25, 1.25, 10.0, 0.9), pair_record(), free=free, progress=False)
    truth = {"a.mass : b.mass": (1.0, 1.5), "spring.stiffness": 8.0, "spring.length": 1.0}
    check(fit, truth, widest=0.01)
    assert_allclose(fit["a.mass : b.mass"].value.sum(), 2.5, rtol=1e-12)


def test_a_ruler_with_a_wrong_scale_and_a_late_clock():
    """Nothing but the distance of the two points is measured, 2 % too large, and 7 ms late."""
    t = np.arange(40) / 20
    early = np.maximum(t - 0.007, 0.0)[1:]
    x = np.asarray(dr.rollout(*pair(), dt=1 / 20, times=np.concatenate([[0.0], early])).state.x)[1:]
    apart = 1.02 * np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
    data = {"gap": (t[1:], missing(np.random.default_rng(2), apart, 1e-3))}
    free = {"spring.stiffness": dr.positive(), "gap.scale": dr.positive(), "gap.clock": dr.real()}
    observe = {"gap": dr.Separation(dr.Marker("a"), "b")}
    records = [dr.Record(data, start=0.0)]
    fit = dr.fit(*pair(stiffness=7.0), records, free=free, observe=observe, progress=False)
    check(fit, {"spring.stiffness": 8.0, "gap.scale": 1.02, "gap.clock": 0.007}, widest=0.01)
    assert fit["gap.clock"].unit == "s"


def test_only_ratios_of_masses_and_stiffness_are_seen():
    free = {"a.mass": dr.positive(), "b.mass": dr.positive(), "spring.stiffness": dr.positive()}
    before = dr.sysid.blind_spots(*pair(1.2, 1.2, 10.0), pair_record(), free=free)
    fit = dr.fit(*pair(1.2, 1.2, 10.0), pair_record(), free=free, progress=False)
    assert before == fit.notes[:1]
    assert "only the ratios of a.mass, b.mass, spring.stiffness are seen" in repr(fit)
    assert np.isinf(fit["a.mass"].high) and "not determined" in fit["a.mass"].note
    ratios = [fit[name].value / fit["a.mass"].value for name in ("b.mass", "spring.stiffness")]
    assert_allclose(ratios, [1.5, 8.0], rtol=0.01)


def test_only_the_ratio_of_stiffness_and_mass_is_seen():
    body = {"p": dr.Body(None, mass=2.0, inertia=1.0, x=(1.0, 0.0))}
    spring = dr.SpringDamper(a="p", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=5.0)
    t = np.arange(30) / 15
    data = {"t": t, "p.x[0]": np.cos(2.0 * t) + 1e-3 * np.random.default_rng(0).standard_normal(30)}
    free = {"p.mass": dr.positive(), "spring.stiffness": dr.positive(), "p.v": dr.real()}
    fit = dr.fit(*dr.scene(body, forces={"spring": spring}), data, free=free, progress=False)
    assert any("only the ratio" in note and "p.mass" in note and "spring.stiffness" in note for note in fit.notes)
    assert any(note == "nothing that was measured depends on p.v[1]" for note in fit.notes)
    assert_allclose(fit["spring.stiffness"].value / fit["p.mass"].value, 4.0, rtol=0.01)
    assert np.isfinite(fit["p.v"].high[0]) and np.isinf(fit["p.v"].high[1])


def test_two_ambiguities_at_once_are_named_apart():
    """Two points, each on a spring of its own: two ratios, which have nothing to do with each other."""
    bodies = {n: dr.Body(None, mass=2.0, inertia=1.0, x=(x, 0.0)) for n, x in (("a", 1.0), ("b", 1.5))}
    springs = {
        f"{n}_spring": dr.SpringDamper(a=n, anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=k)
        for n, k in (("a", 8.0), ("b", 3.0))
    }
    t = np.arange(30) / 15
    random = np.random.default_rng(0)
    data = {"t": t} | {
        f"{n}.x[0]": x * np.cos(w * t) + 1e-3 * random.standard_normal(30)
        for n, x, w in (("a", 1.0, 2.0), ("b", 1.5, 1.2))
    }
    paths = ("a.mass", "b.mass", "a_spring.stiffness", "b_spring.stiffness")
    fit = dr.fit(*dr.scene(bodies, forces=springs), data, free={path: dr.positive() for path in paths}, progress=False)
    seen = [note for note in fit.notes if "seen" in note]
    assert len(seen) == 2
    for name, note in zip("ab", sorted(seen, key=lambda note: "b.mass" in note), strict=True):
        assert "only the ratio" in note and f"{name}.mass" in note and f"{name}_spring.stiffness" in note
    ratios = [fit[f"{n}_spring.stiffness"].value / fit[f"{n}.mass"].value for n in "ab"]
    assert_allclose(ratios, [4.0, 1.44], rtol=0.01)


def test_mixed_directions_come_apart():
    random = np.random.default_rng(1)
    apart = np.array([[1.0, -0.5, 0, 0, 0], [0, 0, 0.2, 1.0, 0]])
    assert_allclose(
        sorted(np.abs(reduced(random.normal(size=(2, 2)) @ apart)).tolist()), sorted(np.abs(apart).tolist()), atol=1e-12
    )


def test_a_change_that_two_numbers_share_is_written_out():
    """A bias of the column and the start of the point: their sum is seen."""
    body = {"p": dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0), v=(1.0, 0.0))}
    t = np.arange(20) / 10
    data = {"t": t, "p.x": np.stack([0.3 + t, 0 * t], 1) + 1e-3 * np.random.default_rng(0).standard_normal((20, 2))}
    fit = dr.fit(*dr.scene(body), data, free={"p.x": dr.real(), "p.x.bias": dr.real()}, progress=False)
    assert sum("change together without effect" in note for note in fit.notes) == 2
    assert_allclose(fit["p.x"].value + fit["p.x.bias"].value, (0.3, 0.0), atol=2e-3)
    assert fit["p.x.bias"].unit == "m"


# ---- a body that tumbles in space under a known torque


def tumbling(inertia, q, w):
    body = {"die": dr.Body(None, mass=1.0, inertia=inertia, x=(0.0, 0.0, 0.0), q=q, w=w)}
    return dr.scene(body, forces=[dr.Torque(body="die", tau=(0.4, -0.3, 0.2))])


def test_of_a_body_in_free_flight_only_ratios_of_the_inertia_are_seen():
    body = {"die": dr.Body(None, mass=1.0, inertia=np.diag([0.2, 0.3, 0.25]), x=(0.0, 0.0, 0.0), w=(3.0, -1.0, 2.0))}
    world, state = dr.scene(body)
    t = np.arange(20) / 20
    data = {"t": t, "die.q": np.asarray(dr.rollout(world, state, dt=1 / 20, times=t)["die.q"])}
    words = dr.sysid.blind_spots(world, state, data, free={"die.inertia": dr.inertia(), "die.w": dr.real()})
    assert words == ("only the ratios of die.inertia are seen: all times one factor is the same motion",)
    with pytest.raises(ValueError, match=r"expected inertia\(\)"):
        dr.sysid.blind_spots(world, state, data, free={"die.inertia": dr.real()})


def test_inertia_and_orientation_of_a_tumbling_body():
    tensor = np.array([[0.20, 0.02, 0.0], [0.02, 0.30, -0.03], [0.0, -0.03, 0.25]])
    q, w = np.array([0.9, 0.1, -0.3, 0.2]), (3.0, -1.0, 2.0)
    q = q / np.linalg.norm(q)
    t, random = np.arange(60) / 30, np.random.default_rng(3)
    seen = np.asarray(dr.rollout(*tumbling(tensor, q, w), dt=1 / 30, times=t).state.q[:, 0])
    noise = jax.vmap(dr.so3.exp)(2e-3 * random.standard_normal((60, 3)))
    data = {"t": t, "die.q": np.array(jax.vmap(dr.so3.compose)(noise, jax.numpy.asarray(seen)))}
    data["die.q"][7] = np.nan
    free = {"die.inertia": dr.inertia(), "die.q": dr.rotation(), "die.w": dr.real()}
    start = tumbling(np.diag([0.25, 0.26, 0.27]), (1.0, 0.0, 0.0, 0.0), (2.5, -0.5, 1.5))
    fit = dr.fit(*start, data, free=free, progress=False)
    check(fit, {"die.inertia": tensor, "die.w": w}, widest=0.03)
    assert_allclose(abs(fit["die.q"].value @ q), 1.0, atol=1e-5)  # 1 - angle^2 / 8
    assert_allclose(fit.noise["die.q"], 2e-3, rtol=0.2)
    principal = np.linalg.eigvalsh(fit["die.inertia"].value)
    assert principal[0] > 0 and principal[2] < principal[0] + principal[1]


# ---- a pendulum


def pendulum(arm, **hinge):
    body = {"rod": dr.Body(None, mass=1.0, inertia=0.05, x=(0.3, 0.0))}
    return dr.scene(body, gravity=(0.0, -9.81), joints={"hinge": dr.Revolute("rod", anchor_a=(-arm, 0.0), **hinge)})


def test_where_the_hinge_of_a_pendulum_is_on_the_rod():
    t = np.arange(40) / 40
    truth = dr.rollout(*pendulum(0.4), dt=1 / 80, times=t).state
    angle = np.unwrap(np.arctan2(truth.q[:, 0, 1], truth.q[:, 0, 0]))
    data = {"t": t, "rod.angle": angle + 2e-3 * np.random.default_rng(4).standard_normal(40)}
    fit = dr.fit(*pendulum(0.5), data, free={"hinge.anchor_a": dr.real()}, dt=1 / 40, progress=False)
    half = 0.5 * (fit["hinge.anchor_a"].high - fit["hinge.anchor_a"].low)
    assert "the fitted start is 0.1 m (or rad) off the joint hinge" in fit.notes[0]  # its anchor_b stays where it was
    assert fit.notes[0].endswith("or hinge.angle")
    assert np.all(np.abs(fit["hinge.anchor_a"].value - (-0.4, 0.0)) < WIDE * half) and half[0] < 0.02


def swing(times, friction, damping):
    """Angles of `pendulum(0.4)` by Runge-Kutta on I angle'' = -m g l cos(angle) - friction sign(w) - damping w."""
    length, inertia, h = 0.4, 0.05 + 1.0 * 0.4**2, 5e-4

    def rate(y):
        angle, w = y
        return np.array([w, (-9.81 * length * np.cos(angle) - friction * np.sign(w) - damping * w) / inertia])

    y, path = np.array([0.0, -1e-12]), []
    for _ in range(round(times[-1] / h) + 1):
        path.append(y[0])
        k1 = rate(y)
        k2 = rate(y + 0.5 * h * k1)
        k3 = rate(y + 0.5 * h * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + h * k3))
    return np.interp(times, h * np.arange(len(path)), path)


@pytest.mark.slow
def test_a_hinge_that_rubs_tells_dry_friction_from_damping():
    """Three seconds in which swings shorten by a constant, which is dry friction, and by a share, which is damping.

    The angles of a simulation at 1/240 s are right to 3e-3, at 1/60 s to 1e-2, which is twice the noise.
    """
    t = np.arange(90) / 30
    data = {"t": t, "rod.angle": missing(np.random.default_rng(5), swing(t, 0.25, 0.06), 5e-3)}
    free = {"hinge.friction": dr.positive(), "hinge.damping": dr.positive()}
    fit = dr.fit(*pendulum(0.4, friction=0.1, damping=0.02), data, free=free, dt=1 / 240, progress=False)
    check(fit, {"hinge.friction": 0.25, "hinge.damping": 0.06}, widest=0.02)
    assert_allclose(fit.noise["rod.angle"], 5e-3, rtol=0.2)
    assert fit["hinge.friction"].unit == "N m" and "hinge.friction and hinge.damping go together" in repr(fit)


@pytest.mark.slow
def test_a_score_leads_in_where_the_whole_record_ends_in_a_local_minimum():
    """A ball into a corner, whose first rows tell little of its spin: eight held-out records, each to its noise."""
    ball = dr.Body(dr.Disc(radius=0.03), mass=0.1, inertia=3.6e-5, x=(0.3, 0.9), v=(1.0, 0.0))

    def scene(floor, wall, friction):
        walls = {
            "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)), restitution=floor),
            "wall": dr.Static(dr.HalfSpace(normal=(-1.0, 0.0), offset=-0.9), restitution=wall),
        }
        return dr.scene({"ball": ball, **walls}, gravity=(0.0, -9.81), friction=friction)

    world, state = scene(0.8, 0.6, 0.2)
    thrown = dr.replace(state, v=jnp.array([[1.3, 0.4]]), w=jnp.array([[-5.0]]))
    t = np.arange(84) / 60
    motion = dr.rollout(world, thrown, dt=1 / 120, times=t)
    x, angle = np.asarray(motion.state.x[:, 0]), np.asarray(motion["ball.angle"])
    random = np.random.default_rng(0)

    def record():
        places, turns = x + 2e-3 * random.normal(size=x.shape), angle + 0.05 * random.normal(size=t.shape)
        return {"t": t, "ball.x": places, "ball.angle": np.angle(np.exp(1j * turns))}

    free = {f"ball.{field}": dr.each(dr.real()) for field in ("x", "v", "w", "angle")}
    free |= dict.fromkeys(("floor.restitution", "wall.restitution", "friction"), dr.interval(0, 1))
    found = dr.fit(*scene(0.7, 0.7, 0.3), [record(), record()], free=free, progress=False)
    assert not found.doubts
    for _ in range(8):
        assert found.score(record())["ball.x"] < 2.6e-3


@pytest.mark.slow
def test_two_throws_of_a_box_with_markers_from_poor_guesses():
    """Two corners strike within 2 ms. Markers are known to 8 mm, the floor is 13 mm higher, the inertia another."""
    places = np.array([[0.052, 0.031, 0.022], [-0.047, 0.024, 0.021], [0.004, -0.036, 0.019]])
    inertia = 0.1 * np.array([0.00224, 0.004, 0.004836])
    throws = [
        {"x": (0.0, 0.0, 0.5), "v": (0.5, 0.2, 0.3), "q": np.array([0.9, 0.3, 0.2, 0.1]), "w": (3.0, 5.0, 2.0)},
        {"x": (0.1, 0.0, 0.6), "v": (-0.3, 0.5, 0.0), "q": np.array([0.5, -0.4, 0.6, 0.1]), "w": (-6.0, 2.0, 4.0)},
    ]

    def scene(height, restitution, friction, **body):
        box = dr.Body(dr.Box(half=(0.06, 0.04, 0.02)), mass=0.3, **body)
        floor = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0), offset=height))
        coefficients = {"restitution": restitution, "friction": friction}
        return dr.scene({"box": box, "floor": floor}, gravity=(0.0, 0.0, -9.81), **coefficients)

    random, t, records = np.random.default_rng(5), np.arange(73) / 120, []
    for throw in throws:
        throw["q"] = throw["q"] / np.linalg.norm(throw["q"])
        states = dr.rollout(*scene(0.013, 0.5, 0.25, inertia=inertia, **throw), dt=1 / 480, times=t).state
        seen = [jax.vmap(lambda state, r=r: dr.material_point(state, 0, r))(states) for r in places]
        seen = np.stack(seen) + 1e-3 * random.normal(size=(3, 73, 3))
        seen[random.random((3, 73)) < 0.08] = np.nan
        records.append({"t": t, **{f"m{k}": seen[k] for k in range(3)}})
    guessed = places + np.random.default_rng(11).uniform(-0.008, 0.008, (3, 3))
    free = {"restitution": dr.interval(0, 1), "friction": dr.interval(0, 1), "floor.shape.offset": dr.real()}
    free |= {"box.inertia": dr.inertia(principal=True), "box.q": dr.each(dr.rotation())}
    free |= {f"box.{field}": dr.each(dr.real()) for field in ("x", "v", "w")}
    free |= {f"m{k}.point": dr.prior(dr.real(), tuple(guessed[k]), 0.01) for k in range(3)}
    markers = {f"m{k}": dr.Marker("box", point=tuple(guessed[k])) for k in range(3)}
    start = scene(0.0, 0.35, 0.4, x=(0.0, 0.0, 0.5))
    found = dr.fit(*start, records, free=free, observe=markers, progress=False)
    for name, truth in (("restitution", 0.5), ("friction", 0.25), ("floor.shape.offset", 0.013)):
        p = found[name]
        assert abs(p.value - truth) < 2.0 * (p.high - p.low)  # eight standard deviations
        assert p.high - p.low < 0.02
    assert_allclose(np.diag(found["box.inertia"].value), inertia, rtol=0.02)
    assert found.noise["m0"] < 1.2e-3 and not found.doubts
