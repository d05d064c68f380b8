"""Tracing and compiling sooner."""

import functools
import gc
from collections.abc import Callable

QUICK = {"xla_cpu_use_fusion_emitters": False}  # half the time to compile; a quarter slower to run where large


def uncollected(fn: Callable) -> Callable:
    """`fn` for `jax.jit`: while it is traced, Python does not look for garbage.

    It would find next to none in what tracing holds, and take a third of the time.
    """

    @functools.wraps(fn)
    def traced(*args, **kwargs):
        if not gc.isenabled():
            return fn(*args, **kwargs)
        gc.disable()
        try:
            return fn(*args, **kwargs)
        finally:
            gc.enable()

    return traced
