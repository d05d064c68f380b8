"""The parts of a fit that have exact answers on their own: kinds, orders, losses, tests of residuals, tables."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import diffrigid as dr
from diffrigid import sysid
from diffrigid.impacts import order_of_impacts
from diffrigid.sysid.diagnosis import Blind, coordinates, doubts, misjudged, normality, whiteness
from diffrigid.sysid.intervals import interval_of, unseen_of
from diffrigid.sysid.lead_in import before_jumps, ways_in
from diffrigid.sysid.levenberg import Numbers, Point, minimise
from diffrigid.sysid.losses import Squares
from diffrigid.sysid.orders import in_words
from diffrigid.sysid.parameters import Slot
from diffrigid.sysid.sampling import Posterior
from diffrigid.sysid.summary import Parameter, Summary
from diffrigid.sysid.table import BLIND, rows_of

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
    for plate in (np.diag([0.1, 0.2, 0.3]), np.diag([0.1, 0.2, 0.3]).astype(np.float32)):
        with pytest.raises(ValueError, match="expected that of a body with thickness; else principal=True"):
            kind.check("free", plate)
    kind.check("free", np.asarray(reference))


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


def test_numbers_of_kinds_losses_and_starts_are_those_given_in_single_precision_too():
    """They are no arrays, and double precision may be set later."""
    with jax.enable_x64(False):
        assert (dr.interval(0.1, 0.3).low, dr.interval(0.1, 0.3).high) == (0.1, 0.3)
        prior = dr.prior(dr.real(0.7), (1.2, 0.1), 0.3)
        assert (prior.kind.spread, prior.mean, prior.deviation) == (0.7, (1.2, 0.1), (0.3,))
        assert (dr.huber(1.1).at, dr.student(4.7).nu) == (1.1, 4.7)
        kinds = (dr.positive, dr.direction, dr.rotation, dr.inertia, dr.shares)
        assert [kind(0.7).spread for kind in kinds] == [0.7] * 5
        with pytest.raises(ValueError, match=r"interval\(0.3, 0.1\): expected low < high"):
            dr.interval(0.3, 0.1)
        pair = dr.scene({"p": dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0))})
        record = dr.Record({"t": [0.1, 0.2], "p.x": np.zeros((2, 2))}, start=0.1)  # not after the first time
        assert sysid.make_problem(*pair, [record], free={"p.x": dr.real()}).runs[0].start == 0.1


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


def test_a_table_hides_no_single_record():
    def names(records):
        values = np.arange(float(records))
        return [row[0] for row in rows_of(Parameter("a", values, values, values, "", "", records))]

    assert names(3) == ["a{0}", "a{1}", "a{2}"] and names(4) == [*names(3), "a{3}"] and names(5) == [*names(3), "a"]


def test_rows_are_all_numbers_unrounded_and_one_prints_as_in_the_table():
    own = np.arange(10.0).reshape(5, 2) + 1.0 / 3.0
    speeds = Parameter("a.v", own, own - 1.0, own + np.pi, "m/s", "", 5)
    bounce = Parameter("restitution", *(np.asarray(end) for end in (0.75, 0.7, 0.80001)), "", "at its bound")
    rows = Summary((bounce, speeds), {}, np.zeros(1), 1, (), (), 0, 1.0, {}).rows()
    assert len(rows) == 11  # of all records, also those that the table hides
    assert rows[0] == dict(parameter="restitution", value=0.75, low=0.7, high=0.80001, unit="", note="at its bound")
    assert (rows[-1]["parameter"], rows[-1]["value"], rows[-1]["high"]) == ("a.v{4}[1]", own[4, 1], own[4, 1] + np.pi)
    assert repr(bounce).splitlines()[2].split() == [
        "restitution",
        "0.75",
        "0.7",
        "..",
        "0.8",
        "-",
        *"at its bound".split(),
    ]


def test_a_posterior_of_a_component_prints_its_table():
    parameter = Parameter("a.v[1]", *(np.asarray(end) for end in (1.0, 0.9, 1.1)), "m/s", "")
    fit = Summary((parameter,), {}, np.zeros(1), 1, (), (), 0, 1.0, {})
    lines = repr(Posterior({}, (parameter,), {"a.v[1]": 1.002}, {"a.v[1]": 345.0}, fit, ())).splitlines()
    assert lines[2].startswith("a.v[1]") and "1.002" in lines[2] and "345" in lines[2]


def test_a_start_at_zero_of_a_positive_parameter_is_moved_off():
    assert_allclose(np.exp(dr.positive().unbounded(np.array([0.0, 0.2]))), [1e-3, 0.2])


# ---- order of impacts


def test_orders_of_impacts_in_words():
    bounces, hit = ("b-floor",) * 3, ("a-b", "b-floor")
    assert in_words(((bounces,),), 1) == "impacts: b-floor x 3"
    some = ((hit,), (hit,), ((),))
    assert in_words(some, 3) == "impacts, 2 of 3 starts: a-b, b-floor; 1 of 3: none"
    assert in_words(some, 9) == "impacts, 2 of the best 3 of 9 starts: a-b, b-floor; 1 of 3: none"
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
    assert doubts(noise[:3]) == []
    drift = noise[0] + np.sin(np.arange(300) / 20)
    assert "autocorrelated" in doubts([drift])[0]
    assert any("not normal" in text for text in doubts([noise[0] ** 3]))
    assert not any("not normal" in text for text in doubts([noise[0] ** 3], robust=True))


def test_noise_that_was_given_wrongly_is_said_by_column():
    """Of a few residuals the size is not known well enough to say so: of 200 such columns hardly any is reported."""
    random = np.random.default_rng(0)
    a, b, c = random.standard_normal((3, 300))
    (remark,) = misjudged({"encoder": 10.0 * a, "ball.x": b, "camera": 0.1 * c}, 1.0)
    assert [name in remark for name in ("encoder", "ball.x", "camera")] == [True, False, True]
    assert remark.startswith("residuals are 9.") or remark.startswith("residuals are 10 times the noise")
    few = [misjudged({"tip": random.standard_normal(6)}, 1.0) for _ in range(200)]
    assert sum(map(bool, few)) <= 6


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
    names = [row[0] for row in rows_of(Parameter("die.inertia", value, low, high, "kg m^2", ""))]
    assert names == [f"die.inertia[{k}, {k}]" for k in range(3)]


def test_windows_end_before_what_was_measured_jumps():
    """A ball that bounces, a third of its rows missing; another column shows a spin, as q or as -q, that an impact ends."""
    random, t = np.random.default_rng(4), np.arange(120) / 120
    height = 0.5 - 4.9 * t**2 + np.where(t < 0.3, 0.0, 5.2 * (t - 0.3))
    x = np.stack([0.4 * t, 0.0 * t, height], 1) + 1e-3 * random.standard_normal((120, 3))
    x[random.random(120) < 0.33] = np.nan
    half = 2.0 * np.minimum(t, 0.7)
    q = np.stack([np.cos(half), np.sin(half), 0.0 * t, 0.0 * t], 1) * random.choice([-1.0, 1.0], 120)[:, None]
    q = q + 1e-3 * random.standard_normal((120, 4))
    die, free = dr.scene({"die": dr.Body(dr.Sphere(0.05), mass=1.0, x=(0.0, 0.0, 0.5))}), {"die.x": dr.real()}

    def ends(data):
        return [before_jumps(run) for run in sysid.make_problem(*die, data, free=free).runs][0]

    (bounce,) = ends({"t": 5.0 + t, "die.x": x})
    assert 0.3 - 3 / 120 <= bounce <= 0.3
    assert_allclose(ends({"t": 5.0 + t, "die.x[2]": x[:, 2]}), [bounce], atol=1e-9)
    both = ends({"t": 5.0 + t, "die.x": x, "die.q": q})
    assert_allclose(both, [bounce, 0.7], atol=2.5 / 120)
    assert (both < [0.3, 0.7 + 1e-9]).all()
    smooth = np.stack([0.4 * t, np.sin(3.0 * t), 0.5 - 4.9 * t**2], 1)
    assert not len(ends({"t": t, "die.x": smooth + 1e-3 * random.standard_normal((120, 3))}))
    at_jumps, windows, evenly = ways_in(
        sysid.make_problem(*die, [{"t": t, "die.x": x}, {"t": t, "die.x": x, "die.q": q}], free=free)
    )
    assert_allclose(np.stack(at_jumps[:-1]), [[bounce, bounce], [np.inf, both[1]]], atol=1e-9)
    assert_allclose(windows[0], [bounce, bounce], atol=1e-9)
    assert np.abs(np.stack(windows[:-1])[:, 1] - both[1]).min() < 1e-9 and windows[-1] == evenly[-1] == np.inf
    assert (np.diff(np.stack(windows[:-1])[:, 1]) < 1.01 * t[-1] / 16).all()


def test_a_symmetric_matrix_is_in_the_table_once():
    values = np.stack([np.full((3, 3), 0.1) + np.eye(3)] * 2)
    rows = rows_of(Parameter("die.inertia", values, values, values, "kg m^2", "", 2))
    upper = ("0, 0", "0, 1", "0, 2", "1, 1", "1, 2", "2, 2")
    assert [row[0] for row in rows] == [f"die.inertia{{{k}}}[{part}]" for k in range(2) for part in upper]


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


def test_degrees_in_a_column_of_angles_are_noticed_and_so_is_data_without_noise():
    wheel = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.0), w=1.0)
    t = np.arange(60) / 30
    found = dr.fit(
        *dr.scene({"wheel": wheel}), {"t": t, "wheel.angle": np.degrees(2.0 * t)}, free={"wheel.w": dr.real()}
    )
    assert found.notes[0].startswith("the fit failed") and "degrees" in found.notes[0]
    assert "no two shapes of this scene can meet" in found.notes[0] and "it has no gravity" in found.notes[0]
    measured, free = {"t": t, "wheel.angle": 2.0 * t}, {"wheel.w": dr.real()}
    exact = dr.fit(*dr.scene({"wheel": wheel}), measured, free=free)
    (note,) = exact.notes  # rounding is neither white nor normal, which says nothing of the model
    assert note.startswith("residuals of wheel.angle are rounding")
    given = dr.fit(*dr.scene({"wheel": wheel}), measured, free=free, noise={"wheel.angle": 1e-3})
    (note,) = given.notes  # nor does it make intervals too narrow
    assert note.startswith("residuals are") and note.endswith("times the noise that was given for wheel.angle")


def test_times_in_milliseconds_are_doubted_before_the_fit():
    bodies = {
        "ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    free = {"ball.v": dr.real()}
    data = {"t": np.linspace(0.0, 2000.0, 61), "ball.x": np.zeros((61, 2))}
    with pytest.raises(ValueError, match=r"takes 1e.05 steps of 0.02 s: if its times are in ms"):
        sysid.make_problem(*dr.scene(bodies), data, free=free)
    data["t"] = np.arange(61.0)
    with pytest.warns(UserWarning, match=r"takes 3e.03 steps of 0.02 s: if .* numbers of frames"):
        sysid.make_problem(*dr.scene(bodies), data, free=free)
    sysid.make_problem(*dr.scene(bodies), data, free=free, dt=0.02)  # no warning: the steps are as they were asked for
