"""What `compile_for_speed` makes of a rollout, in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.compiling import LASTING, QUICK, WIDE, Options, is_own_program
from diffrigid.step import OPTIONS, options_for

SCRIPT = """
import json
import jax
import diffrigid as dr
from diffrigid.compiling import is_for_speed

assert not is_for_speed()
dr.compile_for_speed()
dr.compile_for_speed()  # once more changes nothing
assert is_for_speed()  # then batches run in smaller chunks
jax.config.update("jax_enable_x64", True)
from test_compiling import bounces, falling
from diffrigid.step import OPTIONS, options_for

assert OPTIONS[options_for(falling(), 1, 1)] is None  # what is called as it comes is not compiled to compile sooner
print(json.dumps(bounces()))
"""


def falling():
    """A spinning disc over a floor."""
    disc = dr.Body(dr.Disc(radius=0.2), mass=1.0, x=(0.0, 1.0), v=(1.0, 0.0), w=3.0)
    bodies = {"disc": disc, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}
    return dr.scene(bodies, gravity=(0.0, -9.81), restitution=0.8, friction=0.3)


def bounces():
    """How many loops XLA has left in the program of a rollout, and where a spinning disc ends that falls on a floor."""
    world, state = falling()
    program = jax.jit(lambda *start: dr.rollout(*start, dt=1 / 60, steps=60).state.x[-1]).lower(world, state).compile()
    return {"loops": program.as_text().partition("ENTRY")[2].count(" while("), "x": program(world, state).tolist()}


def test_a_rollout_is_one_function_and_the_same():
    where = Path(__file__).parent
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, cwd=where)
    assert not done.returncode, done.stderr
    found, expected = json.loads(done.stdout), bounces()
    assert found["loops"] == 0
    if jax.__version_info__ < (0, 12):  # from then on XLA makes one function of a loop by itself
        assert expected["loops"] == 1
    assert_allclose(found["x"], expected["x"], rtol=1e-9)


def test_too_late_is_an_error(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    jax.devices()
    with pytest.raises(RuntimeError, match="compile_for_speed: JAX was in use before"):
        dr.compile_for_speed()
    assert os.environ["XLA_FLAGS"] == ""  # else chunks were those of another program


def test_what_is_a_program_of_its_own():
    """It may have options to compile by, which JAX refuses within another program."""
    seen = []

    def look(x):
        seen.append(is_own_program())
        return x

    one, grad = jax.numpy.ones(2), jax.grad(look)
    look(1.0), grad(1.0), jax.vmap(grad)(one), jax.jvp(look, (1.0,), (1.0,)), jax.linearize(look, 1.0)
    assert all(seen)
    seen.clear()
    jax.jit(look)(1.0), jax.jit(grad)(1.0), jax.grad(jax.jit(look))(1.0), jax.lax.map(look, one)
    jax.grad(jax.checkpoint(look))(1.0), jax.eval_shape(look, 1.0)
    assert not any(seen)


def test_quick_changes_the_time_to_compile_and_nothing_else():
    world, state = dr.scene({"disc": dr.Body(dr.Disc(radius=0.2), mass=1.0, x=(0.0, 1.0), w=3.0)}, gravity=(0.0, -9.81))

    def height(world, state):
        return dr.rollout(world, state, dt=1 / 60, steps=6).state.x[-1, 0, 1]

    slopes = jax.grad(height, argnums=(0, 1))
    quick = jax.jit(slopes, compiler_options=dr.QUICK)(world, state)
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-15), quick, slopes(world, state))
    assert_allclose(quick[0].forces[0].g[..., 1].sum(), 0.1**2 / 2, rtol=1e-12)


def test_options_that_xla_does_not_have_are_left_out():
    """JAX 0.11.1, for one, dropped an option that 0.11.0 had, and refuses to compile with it."""
    old = {"xla_that_was_dropped": False, "xla_backend_optimization_level": 0}
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_that_was_dropped"):
        jax.jit(lambda x: 2 * x, compiler_options=old)(1.0)
    assert dict(Options(old)) == {"xla_backend_optimization_level": 0} and len(Options(old)) == 1
    assert jax.jit(lambda x: 2 * x, compiler_options=Options(old))(1.0) == 2.0
    assert jax.jit(lambda x: x * Options(old)["xla_backend_optimization_level"])(1.0) == 0.0  # asked while tracing


def test_importing_starts_no_xla():
    """Else it had read XLA_FLAGS, and `jax.distributed.initialize` came too late."""
    script = "import diffrigid, diffrigid.sysid, diffrigid.view.explore; from jax._src import xla_bridge; assert not xla_bridge._backends"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_what_runs_for_long_is_compiled_for_longer():
    """A disc in free fall runs for a million steps in a second; ten boxes that may pile up for ten thousand in ten."""

    def options(shape, count, steps, worlds=1):
        bodies = {f"{i}": dr.Body(shape, mass=1.0, x=(0.0, 3.0 * i)) for i in range(count)}
        return OPTIONS[options_for(dr.scene(bodies, gravity=(0.0, -9.81)), steps, worlds)]

    disc, box = dr.Disc(radius=0.2), dr.Box(half=(0.5, 0.5))
    assert options(disc, 1, 100_000) is QUICK
    assert [options(box, 10, steps) for steps in (1000, 10_000)] == [QUICK, LASTING]
    assert [options(box, 10, 10, worlds) for worlds in (100, 1000)] == [LASTING, WIDE]

    def traced(x):
        assert options(disc, 1, 1) is None  # JAX would refuse it options of its own
        return x

    jax.jit(traced)(1.0)
