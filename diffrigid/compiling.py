"""Tracing and compiling sooner."""

import functools
import gc
from collections.abc import Callable
from typing import ParamSpec, TypeVar

QUICK = {"xla_cpu_use_fusion_emitters": False}  # half the time to compile; a quarter slower to run where large
QUICKEST = QUICK | {"xla_backend_optimization_level": 1}  # a fifth less; slower by another quarter

Inputs = ParamSpec("Inputs")
Result = TypeVar("Result")


def uncollected(fn: Callable[Inputs, Result]) -> Callable[Inputs, Result]:
    """`fn` with Python's garbage collector paused, for functions that may trace a program.

    Tracing creates hundreds of thousands of objects that all survive; scanning them takes a third of its time.
    """

    @functools.wraps(fn)
    def called(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Result:
        if not gc.isenabled():
            return fn(*args, **kwargs)
        gc.disable()
        try:
            return fn(*args, **kwargs)
        finally:
            gc.enable()

    return called
