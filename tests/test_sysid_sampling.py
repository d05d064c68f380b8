"""Draws from a posterior: where it is known in closed form, and where it can be summed on a grid."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_sysid_exact import NOISE, algebra, many, point

import diffrigid as dr
from diffrigid import sysid
from diffrigid.sysid.sampling import agreement

EXTRA = 'blackjax comes with the extra: pip install -e ".[sampling]"'


def test_draws_of_a_linear_problem_are_those_of_its_normal_posterior():
    """Two falls, and a prior: mean and covariance of (gravity, x and v of each) by plain algebra."""
    pytest.importorskip("blackjax", reason=EXTRA)
    records, known, sure = many()[:2], np.array([0.2, -9.8]), 0.03
    free = {"gravity": dr.prior(dr.real(), known, sure), "p.x": dr.each(dr.real()), "p.v": dr.each(dr.real())}
    fit = dr.fit(*point(), records, free=free, noise={"p.x": NOISE}, progress=False)
    posterior = dr.sample(fit, draws=600, chains=4)
    matrix, right, _ = algebra(records)
    matrix = np.concatenate([matrix / NOISE, np.eye(10)[:2] / sure])
    covariance = np.linalg.inv(matrix.T @ matrix)
    mean = covariance @ matrix.T @ np.concatenate([right / NOISE, known / sure])
    own = np.concatenate([posterior["p.x"], posterior["p.v"]], axis=3).reshape(4, 600, 8)
    drawn = np.concatenate([posterior["gravity"], own], axis=2).reshape(-1, 10)
    deviation = np.sqrt(np.diag(covariance))
    size = min(posterior.size.values())
    assert size > 800 and max(posterior.r_hat.values()) < 1.01 and not posterior.notes
    # Four standard errors of a mean, and of a variance or a correlation.
    assert_allclose(drawn.mean(0) / deviation, mean / deviation, atol=4 / np.sqrt(size))
    scaled = np.cov(drawn.T) / deviation / deviation[:, None]
    assert_allclose(scaled, covariance / deviation / deviation[:, None], atol=4 * np.sqrt(2 / size))
    lines = repr(posterior).splitlines()
    assert "of the fit" in lines[0] and lines[2].startswith("gravity[0]") and lines[4].startswith("p.x{0}[0]")


def drop(restitution):
    """A ball 0.1 m over the floor."""
    bodies = {
        "ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.2)),
        "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0))),
    }
    return dr.scene(bodies, gravity=(0.0, -9.81), restitution=restitution)


def test_draws_of_a_restitution_near_its_bound_are_those_of_the_density():
    """A coarse record of a bounce that loses next to nothing: the posterior is cut off at 1, and flat before the data.

    Expected values are sums of exp(-loss) on a grid of the restitution.
    """
    pytest.importorskip("blackjax", reason=EXTRA)
    t, noise = np.arange(13) / 40, 0.02
    height = np.asarray(dr.rollout(*drop(0.97), dt=1 / 40, times=t).state.x[:, 0, 1])
    data = {"t": t, "ball.x[1]": height + noise * np.random.default_rng(3).standard_normal(13)}
    free = {"restitution": dr.interval(0, 1)}
    fit = dr.fit(*drop(0.8), data, free=free, noise={"ball.x": noise}, progress=False)
    posterior = dr.sample(fit, draws=1000, chains=4)
    e = np.linspace(0.005, 0.9999, 200)
    cost = [0.5 * (sysid.residual_vector(fit.problem, np.array([np.log(k / (1 - k))])) ** 2).sum() for k in e]
    density = np.exp(min(cost) - np.array(cost))
    density /= density.sum()
    mean, cumulative = density @ e, np.cumsum(density)
    deviation = np.sqrt(density @ (e - mean) ** 2)
    drawn, size = posterior["restitution"], posterior.size["restitution"]
    assert size > 400 and posterior.r_hat["restitution"] < 1.01
    assert_allclose(drawn.mean(), mean, atol=4 * deviation / np.sqrt(size))
    for share in (0.1, 0.5, 0.9):  # a share of draws scatters by sqrt(p (1 - p) / size)
        below = (drawn < np.interp(share, cumulative, e)).mean()
        assert_allclose(below, share, atol=4 * np.sqrt(share * (1 - share) / size) + 0.01)  # and the grid
    parameter = posterior.parameters[0]
    assert parameter.high < 1.0 and np.interp(0.025, cumulative, e) == pytest.approx(float(parameter.low), abs=0.02)


@pytest.mark.parametrize("kind", [dr.interval(-1, 3), dr.positive(), dr.real()])
def test_volumes_of_single_numbers_are_slopes(kind):
    z, h = np.array([0.4, -1.3]), 1e-6
    slopes = (kind.value(z + h) - kind.value(z - h)) / (2 * h)
    constant = np.log(4.0) if np.isfinite(kind.high) else 0.0  # the width of the interval, which no draw depends on
    assert_allclose(kind.log_volume(jnp.asarray(z)), np.log(slopes / np.exp(constant)).sum(), atol=1e-8)


def test_volumes_on_curved_sets_are_areas():
    """Up to constants: sin r / r on a sphere of directions, (sin(r / 2) / (r / 2))^2 of rotations, 1 - u of shares."""
    near, far = (jnp.asarray(0.1 * np.eye(3)[0]), jnp.asarray((0.5, 1.0, -0.7)))
    r = np.array([0.1, np.sqrt(1.74)])

    def rise(kind, reference, cut=3):
        return kind.log_volume(far[:cut], jnp.asarray(reference)) - kind.log_volume(near[:cut], jnp.asarray(reference))

    area = np.log(np.sinc(np.array([0.1, np.sqrt(1.25)]) / np.pi))
    assert_allclose(rise(dr.direction(), (0.0, 3.0, 4.0), 2), np.diff(area)[0], atol=1e-9)
    assert_allclose(rise(dr.direction(), (3.0, 4.0), 1), 0.0, atol=1e-12)
    haar = 2 * np.log(np.sinc(r / 2 / np.pi))
    assert_allclose(rise(dr.rotation(), (0.5, 0.5, -0.5, 0.5)), np.diff(haar)[0], atol=1e-9)
    u = 1 / (1 + np.exp(-np.array([0.1, 0.5])))
    assert_allclose(rise(dr.shares(), (2.0, 2.0), 1), np.diff(np.log(u * (1 - u)))[0], atol=1e-12)


def test_agreement_of_chains():
    """Of x' = r x + noise the draws are worth (1 - r) / (1 + r) of their number; R-hat shows a chain that is elsewhere."""
    random, r = np.random.default_rng(0), 0.6
    x = np.zeros((4, 20000))
    noise = random.standard_normal(x.shape)
    for k in range(1, x.shape[1]):
        x[:, k] = r * x[:, k - 1] + noise[:, k]
    found, size = agreement(x)
    assert abs(found - 1) < 1e-3
    assert_allclose(size, x.size * (1 - r) / (1 + r), rtol=0.1)
    apart = noise + np.array([0.0, 0.0, 0.0, 2.0])[:, None]
    assert_allclose(agreement(apart)[0], np.sqrt(1 + 6 / 7), rtol=0.01)  # 6 / 7: variance of 0 (six halves) and 2 (two)


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "blackjax.mcmc", None)
    with pytest.raises(ImportError, match=r"diffrigid\[sampling\]"):
        dr.sample(object.__new__(dr.Fit))
