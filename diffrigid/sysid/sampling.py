"""Draws from the posterior of a fit, by NUTS of blackjax: intervals where the problem is far from linear.

    log density of z  =  - sum of the loss of all residuals, those of priors among them  +  log |d value / d z|

With the last term a flat density is flat in the parameters (in the volume that their values span: angles of a
direction, entries of an inertia), not in z. Noise that was estimated is held at what the fit found.

Source: Hoffman and Gelman, The No-U-Turn Sampler, 2014.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.compiling import LASTING, compiled, uncollected
from diffrigid.convert import at_least_one
from diffrigid.sysid.covariance import TINY
from diffrigid.sysid.intervals import coordinates_of, unit_of
from diffrigid.sysid.levenberg import Numbers, Point, arrow, cost_of
from diffrigid.sysid.losses import Loss
from diffrigid.sysid.parameters import Slot, reference, split
from diffrigid.sysid.problem import Data, Plan, linearised
from diffrigid.sysid.result import Fit, checked_fit
from diffrigid.sysid.setup import first_value, scene_of
from diffrigid.sysid.summary import Parameter
from diffrigid.sysid.table import rows_of
from diffrigid.tables import lined_up

ACCEPTED = 0.8  # [-] share of accepted proposals to which the length of the steps is tuned
R_HAT_AGREES = 1.01  # R-hat above which chains do not agree
WIDTH_RATIO = 1.25  # ratio of widths from which an interval differs from that of the fit
HEADER = ("parameter", "mean", "95 % interval", "of the fit", "unit", "R-hat", "draws worth")


@dataclass(frozen=True)
class Posterior:
    """Draws of the parameters of a fit, and how far to believe them."""

    draws: dict[str, np.ndarray]  # by name, (chains, draws, ...); of parameters that each record has (..., R, ...)
    parameters: tuple[Parameter, ...]  # mean, and the 2.5 and 97.5 % quantiles
    r_hat: dict[str, float]  # by name, the largest of its numbers: spread of all chains over that of each
    size: dict[str, float]  # by name, the least of its numbers: effective number of independent draws
    fit: Fit
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.draws[name]

    def __repr__(self) -> str:
        table = []
        for p, of_fit in zip(self.parameters, self.fit.parameters, strict=True):
            quality = f"{self.r_hat[p.name]:.3f}", f"{self.size[p.name]:.0f}"
            for (name, mean, interval, unit, _), fitted in zip(rows_of(p), rows_of(of_fit), strict=True):
                table.append((name, mean, interval, fitted[2], unit, *quality))
        return "\n".join([*lined_up(HEADER, table), *(f"! {note}" for note in self.notes)])


def sample(fit: Fit, draws: int = 1000, *, chains: int = 4, warmup: int = 300, seed: int = 0) -> Posterior:
    """Draw from the posterior of a fit; needs `pip install "diffrigid[sampling]"`.

    Priors are those of `free`, elsewhere flat in the parameter, within its bounds; the likelihood is exp(-loss). Chains
    begin about the fitted values, side by side, in the metric of their covariance. They explore one order of impacts,
    and seldom find another.

    Args:
        draws: four or more of each chain, after `warmup`.
        chains: two or more, which are compared.
        warmup: draws of each chain before, which tune the length of the steps.
        seed: of the chains' starts and of the draws.

    Returns:
        `.draws`, or by [name], (chains, draws, ...); `.parameters`, as those of the fit; `.r_hat`, `.size`, `.notes`.

    Raises:
        ValueError: a loaded fit; too few draws, chains or warmup.
        ImportError: blackjax is missing.

    Example:
        >>> posterior = dr.sample(found, draws=100, chains=2, warmup=100)
        >>> posterior["restitution"].shape, bool(posterior.parameters[0].low < 0.8 < posterior.parameters[0].high)
        ((2, 100), True)
    """
    checked_fit(fit, "sample")
    nuts = _nuts()
    for name, count in (("draws", draws), ("chains", chains), ("warmup", warmup)):
        at_least_one(name, count)
    if chains < 2 or draws < 4:
        raise ValueError(f"sample: {chains} chains of {draws} draws, expected two or more of four or more, to compare")
    problem, dtype = fit.problem, fit.problem.dtype
    about, covariance = np.concatenate([fit.shared, fit.own.T.ravel()]), _covariance(fit)
    random = np.random.default_rng(seed)
    first = about + random.standard_normal((chains, len(about))) @ np.linalg.cholesky(covariance).T
    parts = tuple((group.plan, group.members) for group in problem.groups)
    refer = [first_value(problem, slot) for slot in problem.shared]
    refer_own = [jnp.stack([reference(slot, scene_of(run)) for run in problem.runs]) for slot in problem.own]
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as blackjax relies on
        z, divergent = _chains(
            nuts, parts, problem.shared, problem.own, fit.loss, (int(warmup), int(draws)),
            jax.random.split(jax.random.key(seed), chains), jnp.asarray(first, dtype), jnp.asarray(covariance, dtype),
            tuple(group.data for group in problem.groups), refer, refer_own,
        )  # fmt: skip
        a = problem.sizes[0]
        values = _values(problem.shared, z[..., :a], refer)
        each = z[..., a:].reshape(*z.shape[:2], len(problem.runs), -1) if problem.own else z[:, :, None, a:]
        values |= _values(problem.own, each, refer_own)
    return _posterior(fit, values, int(np.asarray(divergent).sum()))


def _nuts() -> Any:
    try:
        from blackjax.mcmc import nuts
    except ImportError:
        raise ImportError('sample needs blackjax: pip install "diffrigid[sampling]"') from None
    return nuts


def _covariance(fit: Fit) -> np.ndarray:
    """Covariance of all z, (n, n), finite also where the data tell nothing: a large change of each is a prior."""
    linear, problem = fit.linear, fit.problem
    (a, b), records = problem.sizes, len(problem.runs)
    large = np.array([place.scale for place in coordinates_of(problem)])
    information = np.diag(1.0 / np.concatenate([large[:a], np.tile(large[a:], records)]) ** 2)
    for k, slopes in enumerate(linear.slopes):
        at = np.concatenate([np.arange(a), a + k * b + np.arange(b)])
        information[np.ix_(at, at)] += slopes.T @ slopes / linear.variance
    scale = np.sqrt(np.diag(information))  # so that units do not matter
    return np.linalg.pinv(information / scale / scale[:, None], hermitian=True) / scale / scale[:, None]


# ---- the density, of all chains at once


@uncollected
@compiled(LASTING, "nuts", "parts", "shared", "own", "loss", "counts")
def _chains(
    nuts: Any, parts: tuple[tuple[Plan, tuple[int, ...]], ...], shared: tuple[Slot, ...], own: tuple[Slot, ...],
    loss: Loss, counts: tuple[int, int], keys: Array, first: Array, covariance: Array, data: tuple[Data, ...],
    refer: list[Array], refer_own: list[Array],
) -> tuple[Array, Array]:  # fmt: skip
    """Draws of z, (chains, draws, n), and which of them diverged."""
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    kernel, (start, update, _) = nuts.build_kernel(), dual_averaging_adaptation(ACCEPTED)
    a, b = (sum(slot.size for slot in slots) for slots in (shared, own))
    cost, warmup, total = _side_by_side(parts, loss, a, b), counts[0], sum(counts)

    def density(z: Array) -> Array:
        volume = _log_volume(shared, z[:a], refer)
        if own:
            volume += jax.vmap(partial(_log_volume, own))(z[a:].reshape(-1, b), refer_own).sum()
        return volume - cost(z, data)

    def chain(key: Array, z: Array) -> tuple[Array, Array]:
        def move(carry: Any, inputs: Any) -> Any:
            (state, tuned), (key, warm) = carry, inputs
            size = jnp.exp(jnp.where(warm, tuned.log_step_size, tuned.log_step_size_avg))
            state, info = kernel(key, state, density, size, covariance)
            after = update(tuned, info.acceptance_rate)
            tuned = jax.tree.map(lambda new, old: jnp.where(warm, new, old), after, tuned)
            return (state, tuned), (state.position, info.is_divergent)

        begin = nuts.init(z, density), start(jnp.asarray(len(z) ** -0.25, z.dtype))
        inputs = jax.random.split(key, total), jnp.arange(total) < warmup
        return jax.lax.scan(move, begin, inputs)[1]

    z, divergent = jax.vmap(chain)(keys, first)
    return z[:, warmup:], divergent[:, warmup:]


def _log_volume(slots: Sequence[Slot], z: Array, refer: Sequence[Array]) -> Array:
    """log |d value / d z| of some parameters."""
    pieces = zip(slots, split(slots, z), refer, strict=True)
    return sum((slot.kind.log_volume(piece, about) for slot, piece, about in pieces), jnp.zeros((), z.dtype))


def _side_by_side(parts: Sequence[tuple[Plan, tuple[int, ...]]], loss: Loss, a: int, b: int) -> Any:
    """Make the cost of one z (n,), with its gradient by forward mode; `vmap` makes lanes on the last axis of it.

    Inside, the batch axis is last: steps with a leading batch axis are slower.
    """

    @jax.jit  # traced once, however often the loops around it are
    def lanes(z: Array, data: tuple[Data, ...]) -> tuple[Array, Array]:
        """Cost (S,) and gradient (n, S) at z (n, S)."""
        members = tuple(members for _, members in parts)
        own = jnp.swapaxes(z[a:].reshape(sum(map(len, members)), b, z.shape[1]), 0, 1)
        numbers = Numbers(z[:a], own)
        found = [linearised(plan, numbers.of(mine), one) for (plan, mine), one in zip(parts, data, strict=True)]
        point = Point(numbers, tuple(r for r, _, _ in found), tuple(jac for _, jac, _ in found))
        equations = arrow(loss, point, members)
        slope = jnp.concatenate([equations.g, equations.h.reshape(z.shape[1], -1)], axis=1)
        return cost_of(loss, point.residuals), slope.T

    @jax.custom_batching.custom_vmap
    def both(z: Array, data: tuple[Data, ...]) -> tuple[Array, Array]:
        cost, slope = lanes(z[:, None], data)
        return cost[0], slope[:, 0]

    @both.def_vmap
    def in_lanes(size: int, batched: Any, z: Array, data: tuple[Data, ...]) -> Any:
        del size, batched
        cost, slope = lanes(z.T, data)
        return (cost, slope.T), (True, True)

    @jax.custom_vjp
    def cost(z: Array, data: tuple[Data, ...]) -> Array:
        return both(z, data)[0]

    cost.defvjp(both, lambda slope, change: (change * slope, None))
    return cost


# ---- what the draws say


def _posterior(fit: Fit, values: dict[str, np.ndarray], divergent: int) -> Posterior:
    problem = fit.problem
    slots = {slot.name: slot for slot in problem.slots}
    parameters, r_hat, size = [], {}, {}
    for name, value in values.items():
        low, high = np.quantile(value, (0.025, 0.975), axis=(0, 1))
        records = len(problem.runs) if slots[name] in problem.own else 0
        parameters.append(Parameter(name, value.mean((0, 1)), low, high, unit_of(problem, slots[name]), "", records))
        r_hat[name], size[name] = _quality(value)
    notes = [f"{divergent} steps diverged: the density is too steep somewhere"] if divergent else []
    notes += [f"chains do not agree on {n} (R-hat {r:.3g}): draw more" for n, r in r_hat.items() if r > R_HAT_AGREES]
    notes += [note for p in parameters if (note := _compared(p, fit[p.name]))]
    return Posterior(values, tuple(parameters), r_hat, size, fit, tuple(notes))


def _values(slots: Sequence[Slot], z: Array, refer: Sequence[Array]) -> dict[str, np.ndarray]:
    """Parameters (chains, draws, ...) for z (chains, draws, n); those of each record for z (chains, draws, R, n)."""
    out = {}
    for slot, piece, about in zip(slots, split(slots, jnp.moveaxis(z, -1, 0)), refer, strict=True):
        value: Any = jax.vmap(jax.vmap(slot.kind.value, (0, None)), (0, None))
        value = jax.vmap(value, (2, 0), 2) if z.ndim == 4 else value
        out[slot.name] = np.asarray(value(jnp.moveaxis(piece, 0, -1), about), float)
    return out


def _quality(value: np.ndarray) -> tuple[float, float]:
    """Largest R-hat and least effective size of the numbers of a parameter, (chains, draws, ...)."""
    columns = value.reshape(*value.shape[:2], -1)
    found = [agreement(columns[..., k]) for k in range(columns.shape[2])]
    return max(r_hat for r_hat, _ in found), min(size for _, size in found)


def agreement(draws: np.ndarray) -> tuple[float, float]:
    """R-hat, and the effective number of independent draws, of draws (chains, draws); each chain is cut in two.

    R-hat is the standard deviation of all over that within the halves: 1 if they agree. The size is the number of draws
    over 1 + 2 (sum of the autocorrelations), as long as the sum of two successive ones is positive.
    Source: Gelman et al., Bayesian Data Analysis, 2013, sections 11.4 and 11.5; Geyer 1992.
    """
    half = draws.shape[1] // 2
    parts = np.concatenate([draws[:, :half], draws[:, -half:]])
    away = parts - parts.mean(1, keepdims=True)
    within = (away**2).sum(1).mean() / (half - 1)
    total = within * (half - 1) / half + parts.mean(1).var(ddof=1)
    if not within > 0:
        return float("inf"), 0.0
    power = np.abs(np.fft.rfft(away, 2 * half, axis=1)) ** 2
    covariance = np.fft.irfft(power, axis=1)[:, :half].mean(0) / half
    rho = 1.0 - (within - covariance * half / (half - 1)) / total
    pairs = rho[: half // 2 * 2].reshape(-1, 2).sum(1)
    pairs = np.minimum.accumulate(pairs[: np.argmax(np.append(pairs, -1.0) < 0)])
    return float(np.sqrt(total / within)), float(parts.size / max(2.0 * pairs.sum() - 1.0, 1.0 / np.log10(parts.size)))


def _compared(drawn: Parameter, fitted: Parameter) -> str:
    """Note if the interval of the fit is too narrow or too wide, else ""."""
    ratio = (drawn.high - drawn.low) / np.maximum(fitted.high - fitted.low, TINY)
    worst = float(ratio.flat[np.abs(np.log(np.maximum(ratio, TINY))).argmax()])
    if 1 / WIDTH_RATIO < worst < WIDTH_RATIO:
        return ""
    return f"the interval of {drawn.name} is {worst:.2g} times as wide as that of the fit"
