"""Falling points: the fit is linear, so values, intervals, noise and diagnosis have exact answers in plain algebra."""

import json
import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.special import stdtrit

import diffrigid as dr
from diffrigid import sysid
from diffrigid.sysid.covariance import Linear, from_jacobian, own_covariance
from diffrigid.sysid.intervals import spanning
from diffrigid.sysid.levenberg import Numbers, point_at
from diffrigid.sysid.profile import ProfileLikelihood
from diffrigid.sysid.remarks import beside_a_jump, failed

NOISE, RECORDS = 0.01, 6  # [m]
FREE = {"gravity": dr.real(), "p.x": dr.each(dr.real()), "p.v": dr.each(dr.real())}
GRAVITY = np.array([0.3, -9.7])


def point(x=(0.0, 0.0), v=(0.0, 0.0)):
    return dr.scene({"p": dr.Body(None, mass=1.0, inertia=1.0, x=x, v=v)}, gravity=(0.0, -9.8))


def record(random, count, start):
    """Positions of a fall from a random start, a tenth of the numbers missing, and the state to begin with."""
    t, x, v = start + np.arange(count) / 20, random.normal(size=2), random.normal(size=2)
    s = (t - start)[:, None]
    measured = x + v * s + 0.5 * GRAVITY * s**2 + NOISE * random.standard_normal((count, 2))
    measured[random.random(measured.shape) < 0.1] = np.nan
    return dr.Record({"t": t, "p.x": measured}, state=point(x + 0.1, v - 0.2)[1])


def many(seed=0):
    random = np.random.default_rng(seed)
    return [record(random, 20 + 3 * k, 0.1 * k) for k in range(RECORDS)]


def algebra(records):
    """The same least squares: matrix, right side, and the record of each row. Columns: gravity, then x, v of each."""
    rows, right, owner = [], [], []
    for k, r in enumerate(records):
        t, x = r.observations["t"], r.observations["p.x"]
        for i, j in np.argwhere(np.isfinite(x)):
            row, s = np.zeros(2 + 4 * len(records)), t[i] - t[0]
            row[[j, 2 + 4 * k + j, 4 + 4 * k + j]] = 0.5 * s**2, 1.0, s
            rows.append(row)
            right.append(x[i, j])
            owner.append(k)
    return np.array(rows), np.array(right), np.array(owner)


@pytest.fixture(scope="module")
def records():
    return many()


@pytest.fixture(scope="module")
def fit(records):
    return dr.fit(*point(), records, free=FREE, progress=False)


@pytest.fixture(scope="module")
def exact(records):
    matrix, right, owner = algebra(records)
    return matrix, right, owner, np.linalg.lstsq(matrix, right, rcond=None)[0]


def test_values_are_those_of_least_squares(fit, exact):
    # 1e-6 of the noise: where the iteration stops.
    assert_allclose(fit["gravity"].value, exact[3][:2], atol=1e-6)
    own = exact[3][2:].reshape(RECORDS, 4)
    assert_allclose(fit["p.x"].value, own[:, :2], atol=1e-7)
    assert_allclose(fit["p.v"].value, own[:, 2:], atol=1e-6)


def test_noise_and_intervals_are_those_of_linear_regression(fit, exact):
    matrix, right, _, best = exact
    freedom = len(right) - matrix.shape[1]
    variance = ((right - matrix @ best) ** 2).sum() / freedom
    covariance = variance * np.linalg.inv(matrix.T @ matrix)
    assert_allclose(fit.noise["p.x"], np.sqrt(variance), rtol=1e-7)
    assert_allclose(fit.covariance, covariance[:2, :2], rtol=1e-6, atol=1e-12)
    for k in (0, RECORDS - 1):
        block = covariance[2 + 4 * k : 6 + 4 * k, 2 + 4 * k : 6 + 4 * k]
        assert_allclose(own_covariance(fit.linear, k, fit.covariance), block, rtol=1e-6, atol=1e-12)
    half = 0.5 * (fit["gravity"].high - fit["gravity"].low)
    assert_allclose(half, stdtrit(freedom, 0.975) * np.sqrt(np.diag(covariance)[:2]), rtol=1e-6)


def test_noise_far_below_the_unit_of_its_column_is_found():
    """An interferometer: 0.1 nm of noise on a micrometre, by linear regression."""
    t, random = np.linspace(0.0, 1.0, 40), np.random.default_rng(0)
    x = 1e-6 * t[:, None] * (1.0, -1.0) + 1e-10 * random.standard_normal((40, 2))
    world, state = dr.scene({"p": dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0), v=(1e-6, 0.0))})
    found = dr.fit(world, state, {"t": t, "p.x": x}, free={"p.x": dr.real(), "p.v": dr.real()}, progress=False)
    matrix = np.stack([np.ones(40), t], axis=1)
    squares = ((matrix @ np.linalg.lstsq(matrix, x)[0] - x) ** 2).sum()
    assert_allclose(found.noise["p.x"], np.sqrt(squares / (80 - 4)), rtol=1e-4)
    assert not any("rounding" in note for note in found.notes)


def test_akaike_of_a_linear_regression(fit, exact):
    matrix, right, *_ = exact
    squares = ((matrix @ np.linalg.lstsq(matrix, right)[0] - right) ** 2).sum() / fit.noise["p.x"] ** 2
    expected = squares + len(right) * np.log(2 * np.pi * fit.noise["p.x"] ** 2) + 2 * (matrix.shape[1] + 1)
    assert_allclose(fit.aic, expected, rtol=1e-6)
    with pytest.raises(ValueError, match="least squares"):
        dr.replace(fit, loss=dr.huber()).aic  # noqa: B018


def test_a_derived_number_has_the_interval_of_the_delta_method(fit, exact):
    """When the point of a record would turn round, -v / g, of a number of its own and a shared one."""
    matrix, right, _, best = exact
    freedom = len(right) - matrix.shape[1]
    covariance = ((right - matrix @ best) ** 2).sum() / freedom * np.linalg.inv(matrix.T @ matrix)
    for k in (0, RECORDS - 1):
        turn = fit.derived(lambda world, state: -state.v[0, 1] / dr.paths.read(world, state, "gravity")[1], record=k)
        at = [1, 5 + 4 * k]  # g and v in the algebra
        g, v = best[at]
        slope = np.array([v / g**2, -1.0 / g])
        half = stdtrit(freedom, 0.975) * np.sqrt(slope @ covariance[np.ix_(at, at)] @ slope)
        assert_allclose(turn.value, -v / g, rtol=1e-6)
        assert_allclose([turn.value - turn.low, turn.high - turn.value], half, rtol=1e-5)


def test_a_number_of_ones_own_is_as_sure_as_what_it_sets(fit, records):
    """Sum and difference of the components of each launch, instead of these."""

    def launch(world, state, value):
        return dr.paths.write(world, state, "p.v", jnp.stack([value[0] + value[1], value[0] - value[1]]) / 2)

    free = {key: kind for key, kind in FREE.items() if key != "p.v"}
    free["launch"] = dr.each(dr.through(launch, dr.real(), (0.1, 0.0), "m/s"))
    found = dr.fit(*point(), records, free=free, progress=False)
    again = dr.fit(*point(), records, free=free, resume=found, iterations=1, progress=False)
    assert_allclose(found["gravity"].value, fit["gravity"].value, atol=1e-6)
    assert found["launch"].unit == "m/s"
    for k in (0, RECORDS - 1):
        expected = fit.derived(lambda _, state: jnp.stack([state.v[0].sum(), state.v[0, 0] - state.v[0, 1]]), record=k)
        for end in ("value", "low", "high"):
            assert_allclose(getattr(found["launch"], end)[k], getattr(expected, end), atol=3e-6)
        assert_allclose(again["launch"].value[k], expected.value, atol=3e-6)


@pytest.mark.parametrize("intervals", [sysid.from_jacobian, dr.sandwich])
def test_a_parameter_that_is_derived_has_its_own_interval(fit, intervals):
    fit = fit.with_intervals(intervals)
    gravity = fit.derived(lambda world, state: dr.paths.read(world, state, "gravity"))
    position = fit.derived(lambda world, state: state.x[0], record=2)
    for end in ("value", "low", "high"):
        assert_allclose(getattr(gravity, end), getattr(fit["gravity"], end), rtol=1e-12)
        assert_allclose(getattr(position, end), getattr(fit["p.x"], end)[2], rtol=1e-12)


def test_a_vector_of_another_length_is_refused(records):
    problem = sysid.make_problem(*point(), records, free=FREE)
    with pytest.raises(
        ValueError, match=r"z has shape \(3,\): expected \(26,\), 2 shared numbers and 4 of each record"
    ):
        sysid.residual_vector(problem, np.zeros(3))


def test_questions_to_a_fit_that_have_no_answer(fit, records):
    for ask in (partial(fit.derived, lambda world, state: state.x[0]), fit.predict):
        for record in (RECORDS, -1):
            with pytest.raises(ValueError, match=f"record is {record}: expected 0 to 5"):
                ask(record=record)
    with pytest.raises(ValueError, match="expected from_jacobian, sandwich or bootstrap"):
        fit.with_intervals(dr.Disc)
    with pytest.raises(ValueError, match="starts is 0, expected an integer >= 1"):
        fit.score(records, starts=0)


def test_what_lies_beyond_the_last_window_is_left_out(records, fit):
    """The fit of the first half a second of each record is that of records which end there."""
    early = [dr.Record({k: v[r.observations["t"] <= r.observations["t"][0] + 0.5] for k, v in r.observations.items()},
                       state=r.state) for r in records]  # fmt: skip
    found = dr.fit(*point(), records, free=FREE, windows=(0.5,), progress=False)
    matrix, right, _ = algebra(early)
    best = np.linalg.lstsq(matrix, right, rcond=None)[0]
    variance = ((right - matrix @ best) ** 2).sum() / (len(right) - matrix.shape[1])
    assert_allclose(found["gravity"].value, best[:2], atol=1e-6)
    assert_allclose(found.noise["p.x"], np.sqrt(variance), rtol=1e-6)
    assert_allclose(found.covariance, variance * np.linalg.inv(matrix.T @ matrix)[:2, :2], rtol=1e-5, atol=1e-12)
    assert all(np.isnan(r["p.x"][11:]).all() for r in found.residuals)
    assert "only the first 0.5 s of each record are fitted" in found.notes and not any("only" in n for n in fit.notes)


def test_numbers_of_a_fit_by_the_names_of_its_table(fit):
    assert fit["gravity[1]"].value == fit["gravity"].value[1] and fit["gravity[1]"].low == fit["gravity"].low[1]
    assert_allclose(fit["p.v[0]"].value, fit["p.v"].value[:, 0])
    assert_allclose(fit["p.v{1}"].value, fit["p.v"].value[1])
    assert fit["p.v{1}[0]"].high == fit["p.v"].high[1, 0]
    for name in ("gravity[2]", "p.v[2]", "p.w", "p.v{9}", "gravity{0}"):
        with pytest.raises(KeyError, match="there are"):
            fit[name]


def test_an_angle_in_degrees_is_one_in_radians():
    """Over several turns, and read modulo a turn."""
    t = np.arange(40) / 20
    angle = 0.4 + 7.0 * t + 0.02 * np.random.default_rng(1).standard_normal(40)
    free = {"p.angle": dr.real(), "p.w": dr.real()}
    world, state = dr.scene({"p": dr.Body(None, mass=1.0, inertia=1.0, x=(0.0, 0.0), angle=0.3, w=6.8)})
    degrees = {"deg": dr.Channel("p.angle", scale=180 / np.pi)}
    fits = [
        dr.fit(world, state, {"t": t, "p.angle": angle}, free=free, progress=False),
        dr.fit(world, state, {"t": t, "deg": np.degrees(angle) % 360}, observe=degrees, free=free, progress=False),
    ]
    for name in free:
        assert_allclose(fits[1][name].value, fits[0][name].value, atol=1e-7)
        assert_allclose(fits[1][name].high, fits[0][name].high, atol=1e-7)
    assert_allclose(fits[1].noise["deg"], np.degrees(fits[0].noise["p.angle"]), rtol=1e-6)


def test_what_is_seen_only_together_has_no_interval():
    """Of a ball on a floor only the sum of its radius and the height of the floor."""

    def scene(height):
        ball = dr.Body(dr.Disc(radius=0.05), mass=1.0, inertia=1.0, x=(0.0, 0.55))
        floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0), offset=height))
        return dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), restitution=0.7)

    t = np.arange(40) / 60
    x = np.asarray(dr.rollout(*scene(0.0), dt=1 / 60, times=t)["ball.x"])
    free = {"floor.shape.offset": dr.real(), "ball.shape.radius": dr.positive(), "restitution": dr.interval(0, 1)}
    x = x + 1e-3 * np.random.default_rng(0).standard_normal(x.shape)
    found = dr.fit(*scene(0.01), {"t": t, "ball.x": x}, free=free, progress=False)
    assert np.isinf([found[name].high for name in list(free)[:2]]).all() and np.isfinite(found["restitution"].high)
    assert any("floor.shape.offset" in note and "ball.shape.radius" in note for note in found.notes)
    paths = list(free)[:2]
    top = found.derived(lambda world, state: sum(dr.paths.read(world, state, path) for path in paths))
    assert top.low < 0.05 < top.high < top.low + 0.01
    assert np.isinf(found.derived(lambda world, state: dr.paths.read(world, state, paths[0]) ** 2).high)


def test_what_each_record_shows_only_together_has_no_interval_in_any(records):
    """Where it begins, and by how much its column is off."""
    free = FREE | {"p.x.bias": dr.each(dr.real())}
    found = dr.fit(*point(), records[:2], free=free, noise={"p.x": NOISE}, progress=False)
    assert np.isinf(found["p.x"].high).all() and np.isinf(found["p.x.bias"].low).all()
    assert np.isfinite(found["p.v"].high).all() and np.isfinite(found["gravity"].high).all()


@pytest.mark.parametrize("column", ["p.x", "p.x[1]"])
def test_a_fit_that_is_none_says_so(records, column):
    """In millimetres, with the noise estimated; also where only the height is seen."""
    r = records[0].observations
    data = {"t": r["t"], column: 1e3 * (r["p.x"] if column == "p.x" else r["p.x"][:, 1])}
    found = dr.fit(*point(), data, free={"gravity[1]": dr.interval(-20, 20)}, progress=False)
    assert found.notes[0].startswith("the fit failed: residuals of p.x are as large")
    assert found.doubts[0] == "the fit failed" and np.isinf(found["gravity[1]"].high)
    assert found.notes[0].endswith("no two shapes of this scene can meet: does it lack a floor?")
    g = found.derived(lambda world, _: dr.paths.read(world, None, "gravity")[1])
    assert g.note == "the fit failed; residuals are autocorrelated"  # also where it stands alone
    assert np.isinf(g.low) and found.rows()[0]["note"] == f"at its bound; {g.note}"
    again = found.with_intervals(sysid.from_jacobian)
    assert again.notes == found.notes


def test_steps_that_are_too_long_are_doubted():
    """Of an arm in air, whose hinge rubs, at the default step: what steps half as long would give is said first.

    Where the residuals are noise to all appearance, as these are, nothing else shows it.
    """
    arm = dr.Body(dr.Capsule(radius=0.01, half_length=0.2), mass=0.3, x=(0.2, 0.0))
    hinge = dr.Revolute("arm", anchor_a=(-0.2, 0.0), friction=0.02)
    pair = dr.scene({"arm": arm}, joints=[hinge], gravity=(0.0, -9.81), forces={"air": dr.Drag(linear=0.4)})
    t = np.arange(60) / 20
    angle = np.asarray(dr.rollout(*pair, dt=1 / 960, times=t)["arm.angle"])
    data = {"t": t, "arm.angle": angle + 5e-5 * np.random.default_rng(0).standard_normal(len(t))}
    free = {"revolute.friction": dr.positive(), "air.linear": dr.positive()}
    found = dr.fit(*pair, data, free=free, progress=False)
    air, _, would_be = found["air.linear"], *found.notes[0].split(" air.linear[1] would be ")
    assert found.doubts == ("the steps are too long",) and air.low[1] > 0.4
    assert abs(float(would_be.split(" ")[0]) - 0.4) < 0.5 * abs(air.value[1] - 0.4)
    assert found.notes[0].endswith("give dt=0.005")
    shorter = dr.fit(*pair, data, free=free, dt=0.005, progress=False)
    assert not shorter.doubts and shorter["air.linear"].low[1] < 0.4


def test_a_fit_that_is_none_says_so_before_what_is_not_seen(records):
    r, free = records[0].observations, {"gravity[1]": dr.interval(-20, 20), "p.mass": dr.positive()}
    with pytest.raises(
        ValueError, match=r"^the fit failed: residuals of p.x are .* Besides, nothing .* depends on p.mass"
    ):
        dr.fit(*point(), {"t": r["t"], "p.x": 1e3 * r["p.x"]}, free=free, progress=False)


def test_sandwich_is_what_leaving_out_records_gives(fit, exact):
    """The jackknife of a linear fit is exact: the fit without each record, one after the other."""
    matrix, right, owner, _ = exact
    without = np.stack(
        [np.linalg.lstsq(matrix[owner != k], right[owner != k], rcond=None)[0][:2] for k in range(RECORDS)]
    )
    away = without - without.mean(0)
    expected = (RECORDS - 1) / RECORDS * away.T @ away
    assert_allclose(fit.with_intervals(dr.sandwich).covariance, expected, rtol=1e-6, atol=1e-12)


def test_bootstrap_is_near_the_sandwich(fit):
    # Draws with replacement, and a jackknife with few clusters, differ by some tens of per cent.
    ratio = np.diag(fit.with_intervals(dr.bootstrap).covariance) / np.diag(fit.with_intervals(dr.sandwich).covariance)
    assert ((ratio > 0.4) & (ratio < 2.5)).all()


@pytest.mark.parametrize("solver", [sysid.lbfgs(100), sysid.first_order(optax.adam(3e-2), 800)])
def test_other_solvers_find_the_same(fit, records, solver):
    other = dr.fit(*point(), records, free=FREE, progress=False, solver=solver)
    assert_allclose(other["gravity"].value, fit["gravity"].value, atol=1e-5)


def test_scipy_finds_the_same_from_the_public_functions(fit):
    functions = (partial(f, fit.problem) for f in (sysid.residual_vector, sysid.jacobian_matrix))
    residuals, jacobian = functions
    found = least_squares(residuals, sysid.start_vector(fit.problem), jacobian)
    values = sysid.values_at(fit.problem, found.x)
    assert_allclose(values["gravity"], fit["gravity"].value, atol=1e-6)
    assert_allclose(values["p.v"], fit["p.v"].value, atol=1e-6)
    assert "p.v of each record" in repr(fit.problem)
    assert_allclose(found.cost, fit.costs[0], rtol=1e-9)


def test_jacobian_agrees_with_differences(fit):
    z = sysid.start_vector(fit.problem)
    step = 1e-5 * np.random.default_rng(0).normal(size=len(z))
    up, down = (sysid.residual_vector(fit.problem, z + s) for s in (step, -step))
    assert_allclose(0.5 * (up - down), sysid.jacobian_matrix(fit.problem, z) @ step, atol=1e-9)


def test_a_saved_fit_is_read_back_and_resumed(fit, records, tmp_path):
    saved = dr.load_fit(fit.save(tmp_path / "fit.json"))
    assert repr(saved) == repr(fit)
    assert {"diffrigid", "jax", "numpy"} <= set(json.loads((tmp_path / "fit.json").read_text())["versions"])
    again = dr.fit(*point(), records, free=FREE, progress=False, resume=saved, iterations=1)
    assert_allclose(again["p.x"].value, fit["p.x"].value, atol=1e-6)
    more = sysid.make_problem(*point(), [*records, records[0]], free=FREE, resume=saved)  # the last begins anew
    assert_allclose(more.runs[0].state.x, fit.scenes[0].state.x)
    assert_allclose(more.runs[-1].state.x, records[0].state.x)
    with pytest.raises(ValueError, match="resume is a fit of .*p.x.*: expected one of some of what is free here"):
        dr.fit(*point(), records, free={"p.mass": dr.positive()}, progress=False, resume=saved)
    for use in (lambda fit: dr.profile(fit, "gravity"), dr.sample, sysid.jumps):
        with pytest.raises(ValueError, match=r"expected a Fit; what load_fit read is its table only: dr.fit\("):
            use(saved)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="not a saved fit"):
        dr.load_fit(tmp_path / "other.json")


def test_interrupting_returns_the_best_so_far(records, monkeypatch):
    def stopped(problem, *rest):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return original(problem, *rest)

    levenberg = sys.modules["diffrigid.sysid.levenberg"]
    calls, original = [], levenberg.update
    monkeypatch.setattr(levenberg, "update", stopped)
    found = dr.fit(*point(), records, free=FREE, progress=False)
    assert found.notes[0].startswith("interrupted")
    assert np.isfinite(found.costs).all()


def test_progress_is_a_line_that_changes_or_one_now_and_then(fit, records, monkeypatch, capsys):
    """Over one line where it is asked for; where nobody watches only what takes long prints, and not to the output."""

    def printed(**progress):
        dr.fit(*point(), records, free=FREE, **progress)
        return capsys.readouterr()

    out, err = printed(progress=True)
    assert out.startswith("fit: iteration   0") and out.strip().splitlines()[-1].startswith("fit: done") and not err
    assert printed() == ("", "")
    monkeypatch.setattr(sys.modules["diffrigid.sysid.fit"], "SILENCE", -1.0)
    out, err = printed()
    assert not out and len(err.splitlines()) > 1 and "\r" not in err and err.startswith("fit: iteration")
    assert printed(progress=False) == ("", "")


def test_a_fit_that_has_not_converged_says_so(records):
    found = dr.fit(*point(), records, free=FREE, progress=False, iterations=1)
    assert found.notes[0].startswith("not converged after 1 iterations")
    few = dr.fit(*point(), records, free=FREE, progress=False, solver=sysid.lbfgs(), iterations=1)
    assert few.notes[0].startswith("not converged after 1 iterations")


def test_noise_that_is_given_does_not_change_a_score(records):
    """A score is in the unit of its column, whoever knows the noise."""
    rows = len(records[0].observations["t"])
    known = [dr.Record(records[0].observations, state=records[0].state, noise={"p.x": np.linspace(0.5, 2.0, rows)})]
    alike = [dr.Record(records[0].observations, state=records[0].state, noise={"p.x": 3.0})]
    free = {key: kind for key, kind in FREE.items() if key == "gravity"}
    held = dr.fit(*point(), records[:1], free=free, progress=False)
    assert_allclose([held.score(other)["p.x"] for other in (known, alike)], held.score(records[:1])["p.x"], rtol=1e-12)


@pytest.mark.slow
def test_a_fit_moves_as_it_was_fitted():
    """With the smooth impacts of its world, or of its last width: a near miss at a width of 0.1 m."""
    disc = dr.Disc(radius=0.2)
    scene = {"cue": dr.Body(disc, mass=1.0, x=(0.0, 0.0), v=(2.0, 0.0)), "ball": dr.Body(disc, mass=1.0, x=(1.0, 0.45))}
    world, state = dr.scene(scene, restitution=0.8)
    smooth = dr.replace(world, contact=dr.Contact(width=0.1))
    t = np.arange(31) / 30
    moved = np.asarray(dr.rollout(smooth, state, dt=1 / 30, times=t).state.x[:, 1])
    assert moved[-1, 1] > 0.5  # exactly they do not meet
    free = {"cue.v": dr.real()}
    for fitted in (
        dr.fit(smooth, state, {"t": t, "ball.x": moved}, free=free, progress=False),
        dr.fit(world, state, {"t": t, "ball.x": moved}, free=free, widths=(0.3, 0.1), progress=False),
    ):
        assert_allclose(fitted["cue.v"].value, (2.0, 0.0), atol=1e-6)
        assert_allclose(fitted.trajectory.state.x[:, 1], moved, atol=1e-6)
        assert fitted.score({"t": t, "ball.x": moved})["ball.x"] < 1e-6
    with pytest.raises(ValueError, match="expected the same in all of them"):
        dr.fit(world, state, [dr.Record({"t": t, "ball.x": moved}, world=w) for w in (world, smooth)], free=free)


def test_starts_that_fit_as_well_widen_an_interval(fit):
    """Elsewhere than the best, as friction that makes a ball grip does beside one that lets it slide."""
    p, elsewhere = fit.parameters[0], fit.shared.copy()
    elsewhere[0] += 1.0
    (found, *others), notes = spanning(fit.problem, fit.parameters, np.stack([fit.shared, elsewhere], axis=1))
    assert_allclose(found.high, [p.value[0] + 1.0, p.high[1]])
    assert_allclose(found.low, p.low)
    assert notes == [f"{p.name}: starts that fit as well ended elsewhere; its interval spans where they did"]
    assert others == list(fit.parameters[1:])
    same = spanning(fit.problem, fit.parameters, fit.starts[:, : fit.agree])
    assert same == (fit.parameters, [])


def test_an_angle_a_turn_away_is_the_same_motion():
    disc = {"d": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.0), w=2.0)}
    t = np.arange(20) / 20
    angle = 0.4 + 2.0 * t + 1e-3 * np.random.default_rng(0).normal(size=20)
    found = dr.fit(*dr.scene(disc), {"t": t, "d.angle": angle}, free={"d.angle": dr.real()}, progress=False)
    turned, other = (np.stack([found.shared, found.shared + more], axis=1) for more in (2 * np.pi, 1.0))
    assert spanning(found.problem, found.parameters, turned) == (found.parameters, [])
    assert spanning(found.problem, found.parameters, other)[1]


def test_score_and_prediction_of_held_out_records(fit):
    held = many(seed=9)[:2]
    scores = fit.score([dr.Record(r.observations, state=r.state) for r in held])
    # 37 numbers a column at most: the root mean square scatters by a tenth; own numbers are refitted.
    assert_allclose(scores["p.x"], NOISE, rtol=0.35)
    motion = fit.predict(times=[0.25, 0.5], record=1)
    t, x, v = np.asarray(motion.t) - 0.1, fit["p.x"].value[1], fit["p.v"].value[1]
    fall = x + v * t[:, None] + 0.5 * fit["gravity"].value * t[:, None] ** 2
    assert_allclose(motion.state.x[:, 0], fall, atol=1e-9)


def test_prediction_takes_the_steps_of_the_fit():
    """Over a hole in the record, and where times are those of a clock, too large for single precision."""
    world, state = (jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), part) for part in spring(2.0, 0.0))
    late, t = 1.7e9, np.concatenate([np.arange(10), np.arange(40, 50)]) / 20
    data = {"t": late + t, "p.x[0]": np.cos(2 * t)}
    found = dr.fit(world, state, data, free={"spring.stiffness": dr.positive()}, dt=0.05, progress=False)
    motion = found.predict()
    assert_allclose(motion.t, late + t, rtol=0, atol=1e-6)
    assert_allclose(motion.state.x[:, 0, 0], np.cos(2 * t), atol=1e-4)  # a step over the hole: 0.2
    assert_allclose(found.predict(times=[late + 1.0]).state.x[0, 0, 0], np.cos(2.0), atol=1e-4)
    with pytest.raises(ValueError, match="expected increasing times from 1.7e.09 s on, where record 0 starts"):
        found.predict(times=[1.0, 2.0])


def test_a_later_part_of_a_record_is_scored_from_the_start_of_the_motion():
    scene = dr.scene({"p": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.0), v=(1.0, 0.0))})
    t = np.arange(40) / 20
    x = np.stack([t, 0 * t], 1) + 1e-3 * np.random.default_rng(0).normal(size=(40, 2))
    found = dr.fit(*scene, {"t": t[:20], "p.x": x[:20]}, free={"p.v": dr.real()}, progress=False)
    later = {"t": t[20:], "p.x": x[20:]}
    with pytest.warns(UserWarning, match=r"record 0 began at the fitted start, at its first row; .*start=0.0"):
        assert found.score(later)["p.x"] > 0.5
    assert found.score(dr.Record(later, start=0.0))["p.x"] < 2e-3


def test_records_that_were_fitted_are_scored_from_what_was_found(fit, records, monkeypatch):
    monkeypatch.setattr(sys.modules["diffrigid.sysid.score"], "SCORE_ITERATIONS", 0)
    backwards = records[::-1]
    residuals = np.concatenate([columns["p.x"].ravel() for columns in fit.residuals])
    expected = fit.noise["p.x"] * np.sqrt(np.nanmean(residuals**2))
    assert_allclose(fit.score(backwards)["p.x"], expected, rtol=1e-6)
    held = many(seed=9)[0]
    assert fit.score([held])["p.x"] > 5 * expected  # one that was not begins at its own state
    assert fit.score(held.observations)["p.x"] > expected  # or as its first rows show
    with pytest.warns(UserWarning, match="record 0 began at the fitted state of record 0 of the fit"):
        fit.score([dr.Record(held.observations, start=-0.5)])  # which say little of what was long before


def test_profile_agrees_with_the_jacobian_where_the_problem_is_nearly_linear():
    free = {"spring.stiffness": dr.positive(), "spring.damping": dr.positive()}
    found = dr.fit(*spring(2.0), spring_record(), free=free, progress=False)
    profile = dr.profile(found, "spring.stiffness")
    value = found["spring.stiffness"]
    # The interval from the Jacobian, to second order in its relative half width.
    assert_allclose([profile.low, profile.high], [value.low, value.high], rtol=2e-3)
    assert profile.rise.argmin() == len(profile.rise) // 2
    assert profile.open == () and profile.doubts == ()
    doubtful = replace(
        found, summary=replace(found.summary, notes=("the cost jumps beside the best fit", *found.notes))
    )
    assert repr(dr.profile(doubtful, "spring.stiffness")).splitlines()[0].endswith("(profile; the cost jumps)")


def test_noise_may_be_missing_where_the_column_is():
    """NaN in both, as a table has them; the noise of a column is then the median of what is there."""
    fall = record(np.random.default_rng(3), 30, 0.0)
    missing = np.isnan(fall.observations["p.x"])
    noise = {"p.x": np.where(missing, np.nan, NOISE)}
    free = {"p.x": dr.real(), "p.v": dr.real()}
    found = dr.fit(*point(), [replace(fall, noise=noise)], free=free, progress=False)
    expected = dr.fit(*point(), [fall], free=free, noise={"p.x": NOISE}, progress=False)
    assert found.noise == {"p.x": NOISE}
    assert_allclose(found["p.v"].low, expected["p.v"].low, rtol=1e-9)


def test_profile_of_a_component():
    """A fall is linear in its start and velocity, so that intervals are those of the Jacobian."""
    fall = record(np.random.default_rng(7), 30, 0.0)
    free = {"p.x": dr.real(), "p.v": dr.real()}
    found = dr.fit(*point(), [fall], free=free, noise={"p.x": NOISE}, progress=False)
    profile = dr.profile(found, "p.v[1]")
    value = found["p.v[1]"]
    assert_allclose([profile.low, profile.high], [value.low, value.high], rtol=1e-6)
    moved = replace(profile, low=-1.0, high=1.0)
    after = sysid.with_profiles(found, [moved])["p.v"]
    assert_allclose([after.low, after.high], [[found["p.v[0]"].low, -1.0], [found["p.v[0]"].high, 1.0]])
    assert after.note.endswith("[1] profile")
    with pytest.raises(ValueError, match=r"'p.v' has 2 numbers: expected one of them, such as 'p.v\[0\]'"):
        dr.profile(found, "p.v")
    with pytest.raises(ValueError, match=r"no shared number 'p.v\[2\]': expected one of \['p.x', 'p.v'\]"):
        dr.profile(found, "p.v[2]")


def test_profile_says_where_it_is_open():
    """Without damping, the cost rises by (a c)^2 / 2 with a = |slopes by c, freed of those by k| / noise, from c = 0."""
    t, sigma = np.arange(60) / 15, 2e-3
    data, free = {"t": t, "p.x[0]": np.cos(2 * t)}, {"spring.stiffness": dr.positive(), "spring.damping": dr.positive()}
    found = dr.fit(*spring(3.9, 0.01), data, free=free, noise={"p.x": sigma}, progress=False)
    profile = dr.profile(found, "spring.damping")
    by_c, by_k = 0.25 * np.sin(2 * t) - 0.5 * t * np.cos(2 * t), -0.25 * t * np.sin(2 * t)  # of x at k = 4, c = 0
    size = np.linalg.norm(by_c - by_k * (by_k @ by_c) / (by_k @ by_k)) / sigma
    assert profile.open == ("below",) and profile.low == 0.0
    assert_allclose(profile.high, 1.96 / size, rtol=0.01)  # between values that are refined twice
    assert f"0 to {profile.high:.5g} (profile, open below; not converged)" in repr(profile)
    table = repr(sysid.with_profiles(found, [profile]))
    assert "profile, open below" in table and f"0 .. {profile.high:.3g}" in table


def test_profile_ends_at_a_cliff(monkeypatch):
    """Where the cost rises at once, between two of the values that were tried, the end is looked for between them."""
    found = dr.fit(*spring(2.0), spring_record(), free={"spring.stiffness": dr.positive()}, progress=False)
    z, deviation = found.shared[0], np.sqrt(found.covariance[0, 0])

    def rises(fit, index, at):
        return np.where(at < z - 1.3 * deviation, 1e4, 0.5 * ((at - z) / deviation) ** 2)

    monkeypatch.setattr(sys.modules["diffrigid.sysid.profile"], "_rises", rises)
    profile = dr.profile(found, "spring.stiffness")
    assert_allclose(np.log(profile.low), z - 1.3 * deviation, rtol=0.0, atol=0.02 * deviation)
    assert_allclose(np.log(profile.high), z + found.uncertainty.quantile * deviation, rtol=0.0, atol=0.02 * deviation)


def spring(stiffness, damping=0.3):
    """A point on a damped spring to the world: x'' = -k x - c x'."""
    force = dr.SpringDamper(a="p", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=stiffness, damping=damping)
    return dr.scene({"p": dr.Body(None, mass=1.0, inertia=1.0, x=(1.0, 0.0))}, forces={"spring": force})


def spring_record():
    t = np.arange(60) / 15
    rate, decay = np.sqrt(4.0 - 0.1**2), 0.1  # k = 4, c = 0.2
    x = np.exp(-decay * t) * (np.cos(rate * t) + decay / rate * np.sin(rate * t))
    return {"t": t, "p.x[0]": x + 2e-3 * np.random.default_rng(0).standard_normal(len(t))}


def test_outliers_do_not_pull_with_a_robust_loss():
    data = spring_record()
    data["p.x[0]"][::9] += 0.3
    free = {"spring.stiffness": dr.positive(), "spring.damping": dr.positive()}
    for loss in (dr.huber(), dr.student()):
        found = dr.fit(*spring(5.0), data, free=free, loss=loss, progress=False)
        assert_allclose(found["spring.stiffness"].value, 4.0, rtol=5e-3)  # plain squares: 5 % off
        assert found.noise["p.x"] < 0.01


def test_intervals_of_a_robust_loss_are_those_of_an_m_estimator(exact, records):
    """Covariance mean(psi^2) / mean(psi')^2 (X^T X)^-1, with psi = rho', for given noise."""
    matrix, right, _, _ = exact
    found = dr.fit(*point(), records, free=FREE, noise={"p.x": NOISE}, loss=dr.huber(1.0), progress=False)
    z = np.concatenate([found["gravity"].value, np.hstack([found["p.x"].value, found["p.v"].value]).ravel()])
    r = (matrix @ z - right) / NOISE
    psi = np.clip(r, -1.0, 1.0)
    assert_allclose(matrix.T @ psi, 0.0, atol=1e-3 * np.sqrt(len(r)))
    factor = (psi**2).sum() / (len(r) - len(z)) / (np.abs(r) < 1.0).mean() ** 2 * NOISE**2
    assert_allclose(found.covariance, factor * np.linalg.inv(matrix.T @ matrix)[:2, :2], rtol=1e-5, atol=1e-12)


def test_a_prior_counts_as_one_more_measurement():
    """Precisions add: of the data, and of the prior."""
    data, noise = spring_record(), {"p.x": 2e-3}
    free = {"spring.stiffness": dr.real()}
    plain = dr.fit(*spring(4.1, 0.2), data, free=free, noise=noise, progress=False)
    with_prior = {"spring.stiffness": dr.prior(dr.real(), 4.1, 0.01)}
    found = dr.fit(*spring(4.1, 0.2), data, free=with_prior, noise=noise, progress=False)
    precision = 1 / plain.covariance[0, 0]
    assert_allclose(1 / found.covariance[0, 0], precision + 1 / 0.01**2, rtol=1e-3)
    mean = (precision * plain["spring.stiffness"].value + 4.1 / 0.01**2) / (precision + 1 / 0.01**2)
    assert_allclose(found["spring.stiffness"].value, mean, rtol=1e-4)


def test_design_finds_the_launch_that_tells_most():
    """Of one spring, started at rest, the amplitude is the signal: the best start is the farthest."""
    t = np.arange(30) / 15
    found = sysid.best_launch(
        *spring(4.0), {"t": t, "p.x": None}, free={"spring.stiffness": dr.positive()}, noise={"p.x": 1e-3},
        vary={"p.x": dr.interval(-2, 2)}, starts=3, steps=12,
    )  # fmt: skip
    assert (np.abs(found.values["p.x"]) > 1.7).all()
    here = sysid.expected_intervals(
        *spring(4.0), {"t": t, "p.x": None}, free={"spring.stiffness": dr.positive()}, noise={"p.x": 1e-3}
    )[0]
    best = found.parameters[0]
    assert best.high - best.low < 0.5 * (here.high - here.low)
    lines = [line.split() for line in repr(found).splitlines()]
    assert ["p.x[0]", f"{found.values['p.x'][0]:.4g}", "m", "at", "a", "bound"] in lines
    assert any(line[0] == "spring.stiffness" and line[-1] == "N/m" for line in lines if line)
    # Seen twice by a column of one number and another of its own name; what is NaN throughout will not be measured.
    planned = {"t": t, "p.x[0]": None, "p.x[1]": np.full(30, np.nan), "far": None, "p.angle": np.full(30, np.nan)}
    twice = sysid.expected_intervals(
        *spring(4.0), planned, free={"spring.stiffness": dr.positive()}, observe={"far": "p.x[0]"},
        noise={"p.x": 1e-3, "far": 1e-3, "p.angle": 1.0},
    )[0]  # fmt: skip
    assert_allclose(twice.high - twice.low, (here.high - here.low) / np.sqrt(2), rtol=1e-4)


def test_design_for_one_of_several_numbers():
    """The score is the logarithm of its deviation; aiming at both of them tells less of it."""
    free = {"spring.stiffness": dr.positive(), "spring.damping": dr.positive()}
    plan = partial(
        sysid.best_launch, *spring(4.0), {"t": np.arange(30) / 15, "p.x": None}, free=free, noise={"p.x": 1e-3},
        vary={"p.x[0]": dr.interval(-1, 1), "p.v[0]": dr.interval(-1, 1)}, starts=2, steps=12,
    )  # fmt: skip
    both, one = plan(), plan(target="spring.damping")
    widths = [np.log(launch.parameters[1].high / launch.parameters[1].low) for launch in (both, one)]
    assert_allclose(one.score, np.log(widths[1] / (2 * 1.959964)), rtol=1e-6)
    assert widths[1] < widths[0]
    with pytest.raises(ValueError, match="'spring.dampin' is not free, did you mean 'spring.damping'"):
        plan(target="spring.dampin")
    for few in ("starts", "steps"):
        with pytest.raises(ValueError, match=f"{few} is 0, expected an integer >= 1"):
            plan(**{few: 0})


def test_design_varies_what_is_of_the_world_and_what_is_free_itself():
    """A weak damping tells most of a spring, and the farthest start does, known or not."""
    free = {"spring.stiffness": dr.positive(), "p.x": dr.prior(dr.real(), 0.0, 1e-3)}
    found = sysid.best_launch(
        *spring(4.0), {"t": np.arange(30) / 15, "p.x": None}, free=free, noise={"p.x": 1e-3}, starts=2, steps=10,
        vary={"p.x": dr.each(dr.interval(-2, 2)), "spring.damping": dr.interval(0, 1)}, target="spring.stiffness",
    )  # fmt: skip
    assert (np.abs(found.values["p.x"]) > 1.7).all() and found.values["spring.damping"] < 0.1
    width = np.log(found.parameters[0].high / found.parameters[0].low)
    assert_allclose(found.score, np.log(width / (2 * 1.959964)), rtol=1e-6)


def test_a_jump_of_the_cost_beside_the_best_fit_is_noticed(fit, monkeypatch):
    """Residuals leap by 5 deviations as soon as the numbers go where the slopes say that the cost falls."""
    at = Numbers(jnp.asarray(fit.shared)[:, None], jnp.asarray(fit.own)[..., None])
    best = point_at(fit.problem.groups, at)

    def remarks(rows, leap, seen=1.0):
        def leaps(groups, z):
            moved = point_at(groups, z)
            return moved._replace(residuals=tuple(r + leap for r in moved.residuals))

        monkeypatch.setattr("diffrigid.sysid.remarks.point_at", leaps)
        slopes = tuple(slopes * np.append(np.ones(slopes.shape[1] - 1), seen) for slopes in fit.linear.slopes)
        linear = dr.replace(fit.linear, rows=tuple(row + rows for row in fit.linear.rows), slopes=slopes)
        return beside_a_jump(fit.problem, best, 0, linear, fit.loss)

    (jump,) = remarks(1e-2, 5.0)
    assert jump.startswith("the cost jumps beside the best fit")
    assert not remarks(1e-2, 0.0)  # it falls there, as the slopes say
    assert not remarks(0.0, 5.0)  # at the bottom there is nothing to look for
    assert not remarks(1e-2, 0.0, seen=1e-15)  # a number of which the slopes are rounding is left where it is
    steep = dr.replace(fit.linear, slopes=tuple(1e12 * slopes for slopes in fit.linear.slopes))
    (wild,) = beside_a_jump(fit.problem, best, 0, steep, fit.loss)
    assert wild.startswith("the slopes of the residuals are enormous: the motion is unstable")
    rows = dr.replace(fit.summary, notes=(jump,)).rows()
    assert {row["note"] for row in rows} == {"the cost jumps"}


def test_a_failed_fit_names_the_records_whose_beginning_nothing_showed():
    t, climb = np.arange(20) / 20, np.linspace(0.0, 5.0, 20)[:, None]
    seen = {"t": t, "height": climb}
    problem = sysid.make_problem(
        *point(), [dr.Record(seen), dr.Record(seen, state=point()[1]), dr.Record(seen)],
        free={"p.x": dr.each(dr.real())}, observe={"height": lambda state: 2.0 * state.x[0, 1:]},
    )  # fmt: skip
    assert "; record 0, 2 began at the state of the scene" in failed(problem, [{"height": climb}] * 3, False)
    with pytest.raises(ValueError, match="put a row of NaN there, and start= says so"):
        sysid.make_problem(*point(), {"t": [2.0], "p.x": [(0.0, 1.0)]}, free={"p.x": dr.real()})


@pytest.mark.slow
def test_which_side_of_a_tip_a_box_falls_to_makes_the_cost_jump():
    """Measured as from the place where it would have begun, beyond the tip, if it had still gone to this side."""
    tip = dr.Static(dr.Polygon(vertices=((-1.0, -1.0), (1.0, -1.0), (0.0, 0.0))))
    box = dr.Body(dr.Box(half=(0.1, 0.1)), mass=1.0, x=(3e-3, 0.1 * np.sqrt(2) + 0.3), angle=np.pi / 4)
    world, state = dr.scene({"box": box, "tip": tip}, gravity=(0.0, -9.81), restitution=0.5)

    def path(x):
        begun = dr.paths.write(world, state, "box.x[0]", x)
        return dr.rollout(*begun, dt=1 / 60, steps=39)["box.x"]

    seen = 2 * path(1e-6) - path(2e-3)
    found = dr.fit(
        world, state, {"t": np.arange(40) / 60, "box.x": seen}, free={"box.x[0]": dr.real()}, noise={"box.x": 1e-3},
        progress=False,
    )  # fmt: skip
    assert 0 < found["box.x[0]"].value < 1e-4
    assert any(note.startswith("the cost jumps beside the best fit") for note in found.notes)


def test_values_that_fit_as_well_beyond_another_valley_are_in_the_note_of_a_profile():
    rise = np.array([0.3, 2.0, 0.0, 2.0, 2.5])
    found = ProfileLikelihood("k", np.arange(5.0), rise, 1.9, 1.2, 2.8)
    assert found.apart == [0.0] and found.note == "profile, 0 fits as well"


@pytest.mark.slow
def test_a_late_clock_is_felt_across_an_impact():
    """A ball falls from 1 m (its centre 0.1 m above the floor at the impact) and comes back with 0.8 of its speed."""
    ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0))
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    world, state = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81), restitution=0.8)
    hit = np.sqrt(2 * 0.9 / 9.81)

    def height(t):
        after, speed = t - hit, 0.8 * 9.81 * hit
        return np.where(t < hit, 1 - 9.81 * t**2 / 2, 0.1 + speed * after - 9.81 * after**2 / 2)

    t = hit + np.array([-0.2, -0.015, 0.004, 0.1])
    record = dr.Record({"ball.x[1]": t, "t": t}, start=0.0)
    channel = dr.Channel("ball.x", clock=0.01)
    problem = sysid.make_problem(
        world,
        state,
        [record],
        free={"ball.x.clock": dr.real()},
        observe={"ball.x": channel},
        noise={"ball.x": 1.0},
        dt=0.05,
    )
    z = sysid.start_vector(problem)
    seen = sysid.residual_vector(problem, z).reshape(-1, 2)[:, 1] + t
    assert_allclose(seen, height(t - 0.01), atol=1e-9)
    slope = sysid.jacobian_matrix(problem, z)[:, 0].reshape(-1, 2)[:, 1]
    assert_allclose(slope, -(height(t - 0.01 + 1e-6) - height(t - 0.01 - 1e-6)) / 2e-6, rtol=1e-6)


def test_records_of_one_shape_share_what_is_compiled():
    from diffrigid.sysid.problem import LINEARISE

    def programs():
        return sum(fn.program()._cache_size() for fn in LINEARISE)

    dr.fit(*spring(3.0), spring_record(), free={"spring.stiffness": dr.positive()}, progress=False)
    before = programs()
    data = spring_record()
    data["p.x[0]"][3] = np.nan
    dr.fit(*spring(3.5), data, free={"spring.stiffness": dr.positive()}, progress=False)
    assert programs() == before


def test_what_has_no_effect_but_rounding_widens_no_interval():
    """Two columns that are the same but for 1e-6, and one of rounding: the numbers beside them keep their variances."""
    rng = np.random.default_rng(0)
    J, noise = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    blind = np.stack([J[:, 2] + 1e-6 * noise[:, 0], 1e-14 * noise[:, 1]], axis=1)
    linear = Linear((noise[:, 2],), (np.concatenate([J, blind], axis=1),), (np.arange(50.0),), 5, 1.0, False)
    for intervals in (from_jacobian, dr.sandwich, dr.bootstrap):
        alone = intervals(replace(linear, slopes=(J,), shared=3)).covariance
        assert_allclose(intervals(linear).covariance[:2, :2], alone[:2, :2], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("interval", [1 / 250, 1 / 59.94, 0.013, 0.1 / 3])
def test_the_fitted_motion_has_all_measured_times_in_single_precision(interval):
    """Lengths of steps that add up to a little more than the last of them too."""
    world, state = (jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), part) for part in spring(2.0, 0.0))
    t = interval * np.arange(25)
    data = {"t": t, "p.x[0]": np.cos(2 * t)}
    found = dr.fit(world, state, data, free={"spring.stiffness": dr.positive()}, progress=False)
    assert_allclose(found.trajectory.t, t)
    assert_allclose(found.trajectory.state.x[:, 0, 0], np.cos(2 * t), atol=1e-4)


def test_scores_and_motions_compile_nothing(fit, caplog):
    """Those of a record about as long as those that were fitted, and of the first three records of the fit."""
    with jax.log_compiles():
        assert fit.score(many(seed=9)[2].observations)["p.x"] < 2 * NOISE
        motions = [fit.predict(record=k) for k in range(3)]
    said = [entry.getMessage() for entry in caplog.records]
    assert said and not [text for text in said if "linearised" in text or "rollout" in text]
    for k, motion in enumerate(motions):
        again = fit.predict(times=motion.t, record=k)
        jax.tree.map(partial(assert_allclose, rtol=0, atol=1e-12), motion.state, again.state)
