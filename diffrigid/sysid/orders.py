"""Order in which bodies strike each other, in the motion at which each start ended.

A different order is another explanation of the same record. Costs alone do not tell one from a search that ended too
early: between two orders the cost has a kink, or a jump, that no gradient crosses.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from diffrigid.impacts import order_of_impacts
from diffrigid.sysid.levenberg import Numbers
from diffrigid.sysid.problem import SHOWN_RECORDS, SHOWN_STARTS, linearise
from diffrigid.sysid.setup import Problem, fitted_scene
from diffrigid.sysid.times import controls_over, grid, motion_of_steps
from diffrigid.trajectory import Trajectory

WRITTEN_ORDERS, WRITTEN_PAIRS = 3, 8  # orders that are written out, and pairs of each

Orders = tuple[tuple[tuple[str, ...], ...], ...]


def impact_orders(problem: Problem, z: Numbers, count: int) -> tuple[Orders, tuple[Trajectory, ...]]:
    """Pairs that strike, in order of time, for the first `count` starts z, 64 at most, and each of three records.

    Also the motions of the first start at the measured times of these records. Motions have the steps of the fit, so
    that what is compiled already gives them.
    """
    records, starts = min(SHOWN_RECORDS, len(problem.runs)), min(SHOWN_STARTS, count)
    shared, own = np.asarray(z.shared, float), np.asarray(z.own, float)
    found: dict[tuple[int, int], tuple[str, ...]] = {}
    motions: dict[int, Trajectory] = {}
    for group in problem.groups:
        chosen = [k for k, member in enumerate(group.members) if member < records]
        if not chosen:
            continue
        states = jax.tree.map(np.asarray, linearise(group.plan, z.of(group.members), group.data)[2])
        for k in chosen:
            run = problem.runs[group.members[k]]
            t: Any = np.concatenate([[0.0], np.cumsum(grid(run, problem.dt)[0])])  # shorter records are padded
            controls = controls_over(run, run.start + t[:-1])
            for start in range(starts):
                scene = fitted_scene(problem, group, k, shared[:, start], own[..., start])
                lane = (slice(len(t)), ..., k, start)
                state = jax.tree.map(lambda leaf, lane=lane: leaf[lane], states)
                motion = Trajectory(t=t, state=state, world=scene.world, controls=controls)
                found[start, group.members[k]] = order_of_impacts(motion)
                if start == 0:
                    motions[group.members[k]] = motion_of_steps(scene, run, state, problem.dt)
    orders = tuple(tuple(found[start, record] for record in range(records)) for start in range(starts))
    return orders, tuple(motions[record] for record in range(records)) if starts else ()


def alike(orders: Orders) -> list[tuple[int, ...]]:
    """Groups of starts with the same order in all records, that of the best start first."""
    groups: dict[tuple[tuple[str, ...], ...], list[int]] = {}
    for start, order in enumerate(orders):
        groups.setdefault(order, []).append(start)
    return [tuple(members) for members in groups.values()]


def in_words(orders: Orders, starts: int) -> str:
    """One line, "5 of 8 starts: cue-ball, ball-wall; 3 of 8: cue-wall"; "" where nothing strikes anything.

    With several records, the line is about the first one in which the starts differ. With more `starts` than orders,
    the orders are those of the best.
    """
    groups = alike(orders)
    if not any(any(order) for order in orders):
        return ""
    kinds = [orders[members[0]] for members in groups]
    record = next((k for k in range(len(kinds[0])) if len({order[k] for order in kinds}) > 1), 0)
    where = f" of record {record}" if len(kinds[0]) > 1 else ""
    if len(orders) == 1:
        return f"impacts{where}: {_listed(kinds[0][record])}"
    whole = f"{starts} starts" if len(orders) == starts else f"the best {len(orders)} of {starts} starts"
    parts = [
        f"{len(members)} of {len(orders) if n else whole}: {_listed(order[record])}"
        for n, (members, order) in enumerate(zip(groups[:WRITTEN_ORDERS], kinds, strict=False))
    ]
    others = sum(map(len, groups[WRITTEN_ORDERS:]))
    return f"impacts{where}, " + "; ".join([*parts, *([f"{others} in other orders"] if others else [])])


def _listed(order: Sequence[str]) -> str:
    """List pairs, with repeats of one pair joined."""
    runs: list[list] = []
    for pair in order:
        if runs and runs[-1][0] == pair:
            runs[-1][1] += 1
        else:
            runs.append([pair, 1])
    texts = [pair if count == 1 else f"{pair} x {count}" for pair, count in runs]
    more = [f"and {len(texts) - WRITTEN_PAIRS} more"] if len(texts) > WRITTEN_PAIRS else []
    return ", ".join([*texts[:WRITTEN_PAIRS], *more]) or "none"
