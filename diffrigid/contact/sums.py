"""Sums of per-contact values over bodies, and over the contacts of two bodies."""

import functools
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid.gathers import fold, rows, sum_rows


def side_sum(values_a: Array, values_b: Array, a: tuple[int, ...], b: tuple[int, ...], moving: int) -> Array:
    """Sum of per-contact values over the contacts of each moving body, (N, ...)."""
    values = jnp.concatenate([pair_sum(values_a, a, b), pair_sum(values_b, a, b)])
    return sum_rows(values, body_sides(*pairs_of(a, b), moving))


def pair_sum(values: Array, a: tuple[int, ...], b: tuple[int, ...]) -> Array:
    """Sum of per-contact values over each run of contacts between the same two, (P, ...); see `pairs_of`."""
    parts, start = [], 0
    for length, pairs in itertools.groupby(_runs(a, b)):
        count = len(list(pairs))
        part = values[start : start + count * length].reshape(count, length, *values.shape[1:])
        parts.append(fold(jnp.add, part, 1))
        start += count * length
    return jnp.concatenate(parts)


def pairs_of(a: tuple[int, ...], b: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Colliders a and b of each run of contacts between the same two."""
    ends = np.cumsum(_runs(a, b)) - 1
    return tuple(a[i] for i in ends), tuple(b[i] for i in ends)


def at_pairs(values: Array, a: tuple[int, ...], b: tuple[int, ...]) -> Array:
    """Values of the pairs (P, ...) at each of their contacts, (C, ...)."""
    return rows(values, tuple(pair for pair, length in enumerate(_runs(a, b)) for _ in range(length)))


@functools.cache
def _runs(a: tuple[int, ...], b: tuple[int, ...]) -> tuple[int, ...]:
    """Lengths of the runs of contacts between the same two colliders."""
    return tuple(len(list(run)) for _, run in itertools.groupby(zip(a, b, strict=True)))


@functools.cache
def body_sides(a: tuple[int, ...], b: tuple[int, ...], moving: int) -> tuple[tuple[int, ...], ...]:
    """For each moving body, the rows of [contacts as a, contacts as b, nothing] that touch it, (N, most)."""
    sides: list[list[int]] = [[] for _ in range(moving)]
    for row, body in enumerate(a + b):
        if body < moving:
            sides[body].append(row)
    most = max(map(len, sides), default=0)
    return tuple(tuple(rows + [2 * len(a)] * (most - len(rows))) for rows in sides)


@functools.cache
def between_bodies(a: tuple[int, ...], b: tuple[int, ...], moving: int) -> tuple[tuple[int, ...], ...] | None:
    """For every two moving bodies, the rows of [contacts of a with b, of b with a, nothing], (N * N, most).

    None if contacts are with statics only.
    """
    between: dict[tuple[int, int], list[int]] = {}
    for row, pair in enumerate(zip(a + b, b + a, strict=True)):
        if max(pair) < moving:
            between.setdefault(pair, []).append(row)
    if not between:
        return None
    most, every = max(map(len, between.values())), [(i, j) for i in range(moving) for j in range(moving)]
    return tuple(tuple((found := between.get(pair, [])) + [2 * len(a)] * (most - len(found))) for pair in every)


@functools.cache
def alike(labels: tuple) -> tuple[tuple[int, ...], ...]:
    """For each of C contacts, those with the same label, itself included, padded by C; (C, most)."""
    members: dict[Any, list[int]] = {}
    for contact, label in enumerate(labels):
        members.setdefault(label, []).append(contact)
    most = max(map(len, members.values()))
    return tuple(tuple(members[label] + [len(labels)] * (most - len(members[label]))) for label in labels)


def at_colliders(values: Array, colliders: tuple[int, ...], fill: float) -> Array:
    """Values of the moving bodies (N, ...) at each contact's collider, (C, ...); `fill` for statics."""
    still = max(colliders) + 1 - values.shape[0]
    if still > 0:
        values = jnp.concatenate([values, jnp.full((still, *values.shape[1:]), fill, values.dtype)])
    return rows(values, colliders)
