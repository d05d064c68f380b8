"""Test settings: double precision, no silent promotion of types or ranks, and what keeps compiling short."""

import gc
import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 --xla_backend_optimization_level=0 "
    "--xla_disable_hlo_passes=reshape-mover,while-loop-constant-sinking,tree_reduction_rewriter",
)

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_in_locations_limit", 0)  # XLA carries along where every operation came from
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

gc.disable()  # else a third of the time of tracing goes into looking for garbage in what tracing holds


@pytest.fixture(scope="module", autouse=True)
def _memory():
    """Programs of one file are of no use to the next."""
    yield
    jax.clear_caches()
    gc.collect()
