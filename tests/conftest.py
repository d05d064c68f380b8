"""Test settings: double precision, no silent promotion of types or ranks, and what keeps compiling short."""

import gc
import os
import subprocess
import sys

os.environ.setdefault("JAX_PLATFORMS", "cpu")
if "XLA_FLAGS" not in os.environ:  # those of QUICK that XLA has: it is asked elsewhere, because it then reads them
    flags = "from diffrigid import QUICK; print(*(f'--{k}={str(v).lower()}' for k, v in QUICK.items()))"
    asked = subprocess.run([sys.executable, "-c", flags], check=True, capture_output=True, text=True)
    os.environ["XLA_FLAGS"] = asked.stdout.strip()

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_in_locations_limit", 0)  # XLA carries along where every operation came from
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

LONG = (
    "batch", "closed_form", "contact_limits", "crowd", "docstrings", "fit", "friction", "height_field", "isolated",
    "joint_motion", "joints", "laws", "linkage", "main", "piles", "profile", "program", "readme", "rolling", "smooth",
    "stops", "sysid_recover", "transformations",
)  # fmt: skip

gc.disable()  # else a third of the time of tracing goes into looking for garbage in what tracing holds


def pytest_collection_modifyitems(items):
    """Files that take long first, so that the workers end together."""
    items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in LONG)


@pytest.fixture(scope="module", autouse=True)
def _memory(request):
    """Programs of files that take long are of no use to the next; small ones, of single operations, are."""
    yield
    if request.path.stem.removeprefix("test_") in LONG:
        jax.clear_caches()
        gc.collect()
