"""Still pictures: the lines that are drawn are the numbers of the trajectory."""

import sys

import numpy as np
import pytest
from motions import DOWN, HEIGHT, IMPACT, MASS, RADIUS, E, G, T, bounce, trajectory

import diffrigid as dr
from diffrigid import view


@pytest.fixture
def ax():
    matplotlib = pytest.importorskip("matplotlib.figure")
    return matplotlib.Figure().subplots()


def lines(ax):
    return {line.get_label(): line.get_xydata() for line in ax.get_lines()}


def test_strobe_draws_bodies_where_they_are(ax):
    run = bounce()
    drawn = view.strobe(run, pictures=4, ax=ax)
    discs = [
        line.get_xydata() for line in drawn.get_lines() if line.get_color() == "C0" and len(line.get_xydata()) == 49
    ]
    assert len(discs) == 4
    for disc, row in zip(discs, (0, 18, 36, 54), strict=True):
        np.testing.assert_allclose(np.linalg.norm(disc - run.state.x[row, 0], axis=1), RADIUS, rtol=1e-6)
    np.testing.assert_allclose(lines(ax)["ball"], run.state.x[:, 0])
    (low, high) = ax.get_xlim()
    assert low < -RADIUS and high > 1.2 and high - low < 4  # the floor does not widen it


def test_energy_and_momentum_are_those_of_the_closed_form(ax):
    run = bounce()
    total = lines(view.energy(run, ax=ax))["total"]
    np.testing.assert_allclose(total[-1, 1] - total[0, 1], -MASS * DOWN**2 / 2 * (1 - E**2), atol=1e-9)
    p = lines(view.momentum(run, ax=ax))["y"]
    np.testing.assert_allclose(p[:, 1], MASS * np.where(T < IMPACT, -G * T, E * DOWN - G * (T - IMPACT)), atol=1e-9)
    L = lines(view.momentum(bounce(3, spin=3.0), angular=True, ax=ax))["z"]
    np.testing.assert_allclose(L[:, 1], 0.4 * MASS * RADIUS**2 * 3.0, rtol=1e-9)


def test_phase_is_velocity_against_position(ax):
    falling = T < IMPACT
    curve = lines(view.phase(bounce(), "ball", "y", ax=ax))["ball"][falling]
    np.testing.assert_allclose(curve[:, 1] ** 2, 2 * G * (HEIGHT + RADIUS - curve[:, 0]), atol=1e-9)


def test_phase_counts_the_turns_between_frames(ax):
    curve = lines(view.phase(bounce(spin=250.0), "ball", "angle", ax=ax))["ball"]
    np.testing.assert_allclose(curve[:, 0], 250.0 * T, atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_a_floor_is_drawn_as_far_as_the_picture_goes(ax, scale):
    """Wherever the motion is, and in millimetres too."""
    ball = dr.Body(dr.Disc(radius=0.1 * scale), mass=1.0, x=(100.0 * scale, scale))
    made, start = dr.scene({"ball": ball, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))})
    run = trajectory(made, [0.0], *(leaf[None] for leaf in (start.x, start.q, start.v, start.w)))
    (floor,) = (line.get_xydata() for line in view.strobe(run, ax=ax).get_lines() if line.get_color() == "0.4")
    assert floor[:, 0].min() < ax.get_xlim()[0] and floor[:, 0].max() > ax.get_xlim()[1]


def test_film_has_a_picture_for_every_thirtieth_of_a_second(tmp_path):
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    with image.open(view.film(bounce(), tmp_path / "motion.gif", speed=2.0)) as film:
        assert film.n_frames == 14


def test_what_is_refused_leaves_no_figure_open(tmp_path):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("Agg")
    run, file = bounce(), tmp_path / "motion.gif"
    for draw, message in (
        (lambda: view.strobe(bounce(3)), "2D"),
        (lambda: view.strobe(run, pictures=0), "pictures is 0, expected an integer >= 1"),
        (lambda: view.phase(run, "bal"), "bodies are"),
        (lambda: view.film(bounce(3), file), "2D"),
        (lambda: view.film(run, tmp_path / "motion.avi"), "ffmpeg"),
        (lambda: view.film(run, file, speed=0.0), "speed is 0: expected above 0; 1 is real time"),
        (lambda: view.film(run, file, rate=0), "rate is 0"),
    ):
        with pytest.raises(ValueError, match=message):
            draw()
    assert pyplot.get_fignums() == []


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"diffrigid\[notebook\]"):
        view.energy(bounce())
    with pytest.raises(ImportError, match=r"diffrigid\[notebook\]"):
        view.film(bounce(), "motion.gif")
    assert dr.play(bounce()).page  # and the player does not need it
