"""Multiple shooting: a record of which a fit from start to end is lost is found in pieces, and ends as one motion."""

import importlib

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_sysid_exact import FREE, GRAVITY, NOISE, point

import diffrigid as dr
from diffrigid import sysid
from diffrigid.sysid.covariance import Linear

TRUTH, COARSE = {"restitution": 0.95, "ball.v": (3.0, 0.7)}, 2e-3  # [m]


def billiard(restitution, v):
    """A ball on a table of 1 m by 0.8 m with a round post near its middle, which parts paths as Sinai's billiard does."""
    sides = {"left": ((1, 0), -0.5), "right": ((-1, 0), -0.5), "near": ((0, 1), -0.4), "far": ((0, -1), -0.4)}
    walls = {name: dr.Static(dr.HalfSpace(normal=n, offset=offset)) for name, (n, offset) in sides.items()}
    ball = dr.Body(dr.Disc(radius=0.04), mass=0.2, x=(-0.35, 0.0), v=v)
    post = dr.Static(dr.Disc(radius=0.15), x=(0.05, 0.02))
    return dr.scene({"ball": ball, "post": post, **walls}, restitution=restitution)


@pytest.mark.slow
def test_eleven_impacts_are_found_through_pieces_and_not_at_once():
    t = np.arange(66) / 60
    x = np.asarray(dr.rollout(*billiard(*TRUTH.values()), dt=1 / 60, steps=65).state.x[:, 0])
    data = {"t": t, "ball.x": x + COARSE * np.random.default_rng(0).standard_normal(x.shape)}
    free = {"restitution": dr.interval(0, 1), "ball.v": dr.real()}
    for guess in (billiard(0.9, (2.8, 0.6)), billiard(0.9, (3.2, 0.8))):
        at_once = dr.fit(*guess, data, free=free, windows=(np.inf,), progress=False)
        assert at_once.noise["ball.x"] > 10 * COARSE
        found = sysid.fit_in_pieces(*guess, data, 8, free=free, progress=False)
        assert len(found.orders[0][0]) == 11
        for name, truth in TRUTH.items():
            p = found[name]
            assert np.all(np.abs(p.value - truth) < p.high - p.low) and np.all(p.high - p.low < 0.01), p
        assert_allclose(found.noise["ball.x"], COARSE, rtol=0.15)  # of one motion, from the start to the end
        assert found.notes[0].startswith("fitted in 8 pieces first, which jumped by up to ")
        assert not any("as one motion residuals" in note for note in found.notes)


def test_jumps_are_how_far_ends_are_from_beginnings():
    """Falls in closed form: where a piece ends, and what was fitted to the next."""
    t = np.arange(31) / 20
    x = np.array([1.0, 2.0]) * t[:, None] + 0.5 * GRAVITY * t[:, None] ** 2
    data = {"t": t, "p.x": x + NOISE * np.random.default_rng(4).standard_normal((31, 2))}
    start = point((0.0, 0.0), (1.0, 2.0))
    found = dr.fit(*start, dr.segments(*start, data, 3), free=FREE, progress=False)
    g, x, v = (found[name].value for name in ("gravity", "p.x", "p.v"))
    jumps, h = sysid.jumps(found), 0.5
    assert_allclose(jumps["p.x"], x[1:] - (x[:-1] + h * v[:-1] + 0.5 * h**2 * g), atol=1e-12)
    assert_allclose(jumps["p.v"], v[1:] - (v[:-1] + h * g), atol=1e-12)
    assert_allclose(jumps["p.angle"], 0.0, atol=1e-12)
    assert np.abs(jumps["p.x"]).max() > 1e-4  # of noise


def test_what_is_not_measured_has_no_pieces():
    world, state = dr.scene({n: dr.Body(None, mass=1.0, inertia=1.0, x=(x, 0.0)) for n, x in (("a", 0.0), ("b", 1.0))})
    data = {"t": np.arange(9) / 8, "a.x": np.zeros((9, 2))}
    with pytest.raises(ValueError, match="no column 'b.x'"):
        sysid.fit_in_pieces(world, state, data, 3, free={"a.mass": dr.positive()})


def test_a_component_of_the_initial_state_is_of_the_whole_record_too(monkeypatch):
    """The pieces have their own velocities, so it is not free in these."""
    given, module = [], importlib.import_module("diffrigid.sysid.segments")  # not the function of that name
    monkeypatch.setattr(module, "fit", lambda *_, free, **options: given.append(free) or 1 / 0)
    data = {"t": np.arange(9) / 8, "p.x": np.zeros((9, 2))}
    with pytest.raises(ZeroDivisionError):
        sysid.fit_in_pieces(*point(), data, 2, free={"gravity": dr.real(), "p.v[0]": dr.real()})
    assert list(given[0]) == ["gravity", "p.x", "p.v"]


@pytest.mark.parametrize("intervals", [sysid.sandwich, sysid.bootstrap])
def test_what_one_record_alone_tells_is_not_taken_for_certain(intervals):
    """Of seven records one tells the second number, in the other six its slopes are rounding: as from that record."""
    random, shares = np.random.default_rng(3), []
    for _ in range(20):
        slopes = [np.stack([np.ones(200), random.normal(size=200) * (1.0 if k == 0 else 1e-40)], 1) for k in range(7)]
        rows = [random.normal(size=200) for _ in slopes]
        best = np.linalg.lstsq(np.concatenate(slopes), np.concatenate(rows), rcond=None)[0]
        rows, times = [r - s @ best for r, s in zip(rows, slopes, strict=True)], [np.arange(200) / 60.0] * 7
        linear = Linear(tuple(rows), tuple(slopes), tuple(times), shared=2, variance=1.0, estimated=False)
        shares.append(np.diag(intervals(linear).covariance) / np.diag(sysid.from_jacobian(linear).covariance))
    # Twenty pieces tell the second number, so that each share scatters by a third, and their mean by 7 %.
    assert_allclose(np.mean(shares, 0), 1.0, atol=0.25)
