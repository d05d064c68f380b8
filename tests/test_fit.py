"""The fit: known parameters from noisy and partly missing records, honest intervals, clear errors."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid import sysid
from diffrigid.sysid.free import Free
from diffrigid.view.fit_report import cost_chart

NOISE = 3e-3  # [m]
TRUTH = {"restitution": 0.8, "d1.mass": 2.0, "d0.v": np.array([2.0, 0.1])}


def discs(restitution, mass, v):
    places = ((1.0, (0.0, 0.0), v), (mass, (1.5, 0.1), (0.0, 0.0)), (1.0, (3.2, 0.35), (0.0, 0.0)))
    return dr.scene(
        {f"d{i}": dr.Body(dr.Disc(radius=0.4), mass=m, x=x, v=w) for i, (m, x, w) in enumerate(places)},
        restitution=restitution,
    )


def record(seed):
    """Two impacts, 120 frames at 60 Hz, a tenth of the numbers missing."""
    random = np.random.default_rng(seed)
    x = np.asarray(dr.rollout(*discs(0.8, 2.0, (2.0, 0.1)), dt=1 / 60, steps=119).state.x)
    x = x + NOISE * random.standard_normal(x.shape)
    x[random.random(x.shape) < 0.1] = np.nan
    return {"t": np.arange(120) / 60, **{f"d{i}.x": x[:, i] for i in range(3)}}


@pytest.fixture(scope="module")
def fit():
    free = {"restitution": dr.interval(0, 1), "d1.mass": dr.positive(), "d0.v": dr.real()}
    widths = (0.5, 0.1, 0.0)  # from two thirds of the sum of the radii: starts that miss find the impacts
    return dr.fit(*discs(0.5, 1.0, (1.5, 0.0)), record(1), free=free, starts=8, widths=widths, progress=False)


def test_three_discs_find_the_truth_from_seven_of_eight_starts(fit):
    for name, truth in TRUTH.items():
        parameter = fit[name]
        width = parameter.high - parameter.low
        # Within twice the 95 % interval: four numbers each inside theirs would be too much to ask of one record.
        assert np.all(np.abs(parameter.value - truth) < width), name
        assert np.all(width < 0.01 * np.abs(parameter.value) + 0.01), name
    assert fit.agree >= 7


def test_noise_is_that_of_the_record(fit):
    # 108 x 2 numbers a column: the estimate scatters by 5 %.
    assert_allclose(list(fit.noise.values()), NOISE, rtol=0.15)


def test_fitted_world_moves_as_the_truth(fit):
    exact = dr.rollout(*discs(0.8, 2.0, (2.0, 0.1)), dt=1 / 60, steps=119)
    assert_allclose(fit.trajectory.state.x, exact.state.x, atol=NOISE)


def test_table_names_every_number_with_its_unit(fit):
    text = repr(fit)
    for word in ("restitution", "d1.mass", "kg", "d0.v[0]", "d0.v[1]", "m/s", "95 %", "of 8 starts agree"):
        assert word in text
    assert "density" not in text  # another inertia would change nothing: nothing turns these discs
    assert fit._repr_html_().count("<tr>") == 5


def test_a_parameter_nothing_depends_on_is_an_error():
    world, state = discs(0.5, 1.0, (1.5, 0.0))
    data = record(2)
    early = {name: values[:10] for name, values in data.items()}  # before the first impact
    with pytest.raises(ValueError, match="depends on restitution"):
        dr.fit(world, state, early, free={"restitution": dr.interval(0, 1), "d0.v": dr.real()}, progress=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {k: v for k, v in d.items() if k != "t"}, '"t"'),
        (lambda d: d | {"d0.y": d["d0.x"]}, "did you mean .d0"),
        (lambda d: d | {"d0.x": d["d0.x"][:5]}, r"expected \(120, 2\)"),
        (lambda d: d | {"t": d["t"][::-1]}, "increasing"),
        (lambda d: {k: v if k == "t" else np.full_like(v, np.nan) for k, v in d.items()}, "nothing is measured"),
    ],
)
def test_bad_records(change, message):
    with pytest.raises(ValueError, match=message):
        dr.fit(*discs(0.5, 1.0, (1.5, 0.0)), change(record(3)), free={"d0.v": dr.real()}, progress=False)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ({}, "nothing to fit"),
        ({"d0.mas": dr.positive()}, "did you mean 'd0.mass'"),
        ({"d0.mass": (0, 1)}, "expected interval"),
    ],
)
def test_bad_free(free, message):
    with pytest.raises(ValueError, match=message):
        dr.fit(*discs(0.5, 1.0, (1.5, 0.0)), record(4), free=free, progress=False)


@pytest.mark.parametrize("free", [Free(), Free(low=0.0), Free(low=-1.0, high=3.0)])
def test_transforms_are_inverse(free):
    values = np.array([0.3, 0.9, 2.5])
    assert_allclose(free.value(free.unbounded(values)), values, rtol=1e-12)


def test_a_start_on_a_bound_is_pulled_off_it():
    assert np.isfinite(dr.interval(0, 1).unbounded(np.array([0.0, 1.0]))).all()
    with pytest.raises(ValueError, match="low < high"):
        dr.interval(1, 0)


@pytest.mark.parametrize("guess", [(0.41, 0.61, (0.0, 0.0)), (0.63, 0.76, (-0.4, 0.6)), (0.5, 0.9, (2.0, -1.5))])
def test_windows_lead_in_from_a_start_that_strikes_nothing(guess):
    """At rest, on the way back, or past the second disc: the whole record alone is not fitted from there."""
    free = {"restitution": dr.interval(0, 1), "d1.mass": dr.positive(), "d0.v": dr.real()}
    with pytest.raises(ValueError, match="the fit failed"):
        dr.fit(*discs(*guess), record(1), free=free, windows=(np.inf,), progress=False)
    found = dr.fit(*discs(*guess), record(1), free=free, progress=False)
    assert found["restitution"].low < 0.8 < found["restitution"].high
    assert found["d1.mass"].low < 2.0 < found["d1.mass"].high


def test_a_restitution_that_was_not_given_begins_off_its_bound():
    """From 0 the ball would come to rest at its first impact, and no restitution would be seen."""
    ball, floor = dr.Body(dr.Disc(radius=0.05), mass=0.2, x=(0.0, 1.2)), dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    t = np.arange(0.0, 1.1, 1 / 60)
    hit = np.sqrt(2 * 1.15 / 9.81)
    height = np.where(t < hit, 1.2 - 4.905 * t**2, 0.05 + 0.75 * 9.81 * hit * (t - hit) - 4.905 * (t - hit) ** 2)
    measured = {"t": t, "ball.x": np.stack([0.0 * t, height], 1)}
    found = dr.fit(
        *dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -9.81)), measured,
        free={"restitution": dr.interval(0, 1)}, noise={"ball.x": 1e-3}, progress=False,
    )  # fmt: skip
    assert_allclose(found["restitution"].value, 0.75, atol=1e-4)


def test_starts_are_grouped_by_the_order_of_their_impacts(fit, tmp_path):
    """In truth the first strikes the second, and that the third."""
    assert all(order == (("d0-d1", "d1-d2"),) for order in fit.orders[: fit.agree])
    for text in (repr(fit), fit._repr_html_()):
        assert f"{fit.agree} of 8 starts: d0-d1, d1-d2" in text
    assert dr.load_fit(fit.save(tmp_path / "fit.json")).orders == fit.orders


def test_starts_that_miss_are_another_order():
    """From far and without a width some starts stay at a miss. What is not struck does not move."""
    free = {"restitution": dr.interval(0, 1), "d1.mass": dr.positive(), "d0.v": dr.real()}
    fit = dr.fit(*discs(0.5, 1.0, (1.5, 0.0)), record(1), free=free, starts=8, seed=2, progress=False)
    for (order,), (e, mass, *v) in zip(fit.orders, fit.starts.T, strict=False):
        world, state = discs(1 / (1 + np.exp(-e)), np.exp(mass), v)
        end = np.abs(np.asarray(dr.rollout(world, state, dt=1 / 60, steps=119).state.v[-1])).sum(1)
        assert {f"d{k}" for k in range(3) if end[k] > 0} - {"d0"} == set("-".join(order).split("-")) - {"d0", ""}, order
    groups = sysid.orders.alike(fit.orders)
    assert len(groups) > 1 and groups[0][0] == 0
    assert f"; {len(groups[1])} of 8: " in repr(fit)
    drawn = [part.count("<circle") for part in cost_chart(fit).split('<g class="c')[1:]]
    assert drawn[:2] == [len(members) for members in groups[:2]] and sum(drawn) == 8
    few = dataclasses.replace(fit, summary=dataclasses.replace(fit.summary, orders=fit.orders[:5]))  # as of 64 of more
    assert cost_chart(few).count("<circle") == 8 and "of the best 5 of 8 starts" in repr(few)
