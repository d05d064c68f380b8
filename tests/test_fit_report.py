"""The report of a fit: a ball that is dropped twice, with a known bounce, seen by an instrument that is known to be wrong."""

import html
import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import parsed

import diffrigid as dr
from diffrigid.view.fit_report import impacts, measured
from diffrigid.view.report import matrix

HEIGHT, GRAVITY, RADIUS, NOISE = 0.6, 9.81, 0.1, 1e-3
SPEEDS = (0.0, 0.5)  # [m/s] upwards, of the two records
CHANNEL = dr.Channel("ball.x", scale=2.0, clock=0.01)


def scene(restitution, speed):
    ball, floor = dr.Disc(radius=RADIUS), dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    bodies = {"ball": dr.Body(ball, mass=1.0, x=(0.0, RADIUS + HEIGHT), v=(0.2, speed)), "floor": floor}
    return dr.scene(bodies, gravity=(0.0, -GRAVITY), restitution=restitution)


def record(speed, random):
    t = np.arange(40) / 60
    x = np.asarray(dr.rollout(*scene(0.7, speed), dt=1 / 60, times=t).state.x[:, 0])
    seen = 2.0 * (x + NOISE * random.standard_normal(x.shape))
    return dr.Record({"t": t + 0.01, "<cam>": seen}, state=scene(0.7, speed)[1], start=0.0)


@pytest.fixture(scope="module")
def fit():
    random = np.random.default_rng(0)
    records = [record(speed, random) for speed in SPEEDS]
    free = {"restitution": dr.interval(0, 1), "gravity": dr.real(), "ball.v": dr.each(dr.real())}
    observe = {"<cam>": CHANNEL}
    return dr.fit(*scene(0.5, 0.0), records, free=free, observe=observe, starts=3, progress=False)


@pytest.fixture(scope="module")
def page(fit, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "fit.html"
    assert fit.report(path, "A ball & a floor", profiles=["restitution"]) == path
    return path.read_text(encoding="utf-8")


def test_page_loads_nothing_and_holds_the_numbers_of_the_fit(fit, page):
    found = parsed(page)
    assert found.tags.count("svg") == 6  # by record, two residuals, costs, correlations, a profile
    cells = [html.unescape(cell) for cell in re.findall("<td>(.*?)</td>", page)]
    for name in ("restitution", "gravity[1]", "ball.v{1}[1]"):
        assert name in cells
    assert_allclose(float(cells[cells.index("restitution") + 1]), fit["restitution"].value, rtol=1e-2)
    assert f"{fit.agree} of 3 starts agree" in page and "seed 0" in page and "160 measured numbers" in page
    assert "A ball &amp; a floor" in page and "&lt;cam&gt;, record 1" in page
    for note in fit.notes:
        assert html.escape(note) in page


def test_player_shows_measured_over_fitted_motion(fit, page):
    (frame,) = re.findall(r'srcdoc="([^"]*)"', page)
    runs = json.loads(re.search(r'id="data">(.*?)</script>', html.unescape(frame), re.S)[1])["runs"]
    assert [run["name"] for run in runs] == ["record 0", "record 1"]
    assert all(run["measured"] for run in runs)
    for k in range(2):
        t, x = measured(fit, k)["ball.x"]  # freed of scale and clock
        assert_allclose(t, np.arange(40) / 60, atol=1e-12)
        assert_allclose(x, fit.predict(record=k, times=t).state.x[:, 0], atol=5 * NOISE)


def test_impacts_are_marked_at_their_times(fit, page):
    for k, speed in enumerate(SPEEDS):
        g, v = -fit["gravity"].value[1], fit["ball.v"].value[k, 1]
        down = np.sqrt(v**2 + 2 * g * HEIGHT)
        # The flight to it within a frame is drawn without gravity: late by g h^2 / 2 v at most.
        assert_allclose(impacts(fit.predict(record=k))[0], (v + down) / g, atol=g / 60**2 / 2 / down)
        assert abs(v - speed) < 0.02
    assert page.count('class="event"') == 4  # one impact a record, and two ends of the profile


def test_correlations_are_drawn_by_size_and_sign():
    svg = matrix("m", ["a", "b"], np.array([[1.0, -0.5], [-0.5, 1.0]]))
    assert re.findall(r'rect class="(c\d)" fill-opacity="([\d.]+)"', svg) == [
        ("c0", "0.70"),
        ("c1", "0.35"),
        ("c0", "0.70"),
    ]
