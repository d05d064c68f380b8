"""Many devices and many processes: the same call, to the same numbers."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose
from shared_work import results

import diffrigid as dr

ROUNDING = 1e-9  # loops over other lengths, and sums over devices, add in another order; fits end within 1e-9 of it


@pytest.fixture(scope="module")
def expected():
    return results()


def started(*args):
    command = [sys.executable, str(Path(__file__).with_name("shared_work.py")), *map(str, args)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def check(process, expected):
    found = json.loads(process.communicate(timeout=300)[0].splitlines()[-1])
    assert found["devices"] == 2
    for a, b in zip(found["results"], expected, strict=True):
        assert_allclose(a, b, rtol=ROUNDING, atol=ROUNDING)


def test_two_devices_of_one_process(expected):
    check(started(2), expected)


def test_two_processes(expected):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    for process in [started(1, address, 2, rank) for rank in range(2)]:
        check(process, expected)


@pytest.mark.parametrize("memory, share", [(10**9, 1.5), (200_000, 0.1)])
def test_memory_that_reverse_mode_saves(memory, share):
    """Of 256 worlds of 400 steps, 7 numbers each: all states or, bounded, what comes with a chunk; the same slopes."""
    world, state = dr.scene({"disc": dr.Body(dr.Disc(radius=0.2), mass=1.0, x=(0.0, 0.5))}, gravity=(0.0, -9.81))
    worlds, steps, dt = 256, 400, 1 / 60
    v = jnp.ones((worlds, 1, 2)) * jnp.linspace(0.0, 1.0, worlds)[:, None, None]

    def ends(v):
        states = dr.replace(state, v=v)
        return dr.rollout_batch(world, states, dt=dt, steps=steps, final_only=True, memory=memory).x.sum()

    compiled = jax.jit(jax.grad(ends)).lower(v).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < share * worlds * steps * 7 * 8
    assert_allclose(compiled(v), steps * dt, rtol=1e-12)  # x = v t
