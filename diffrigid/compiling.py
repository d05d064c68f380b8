"""Options and helpers to trace and compile sooner, or to compile for speed."""

import functools
import gc
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax import lax
from jax.extend.backend import get_compile_options


class Options(Mapping[str, Any]):
    """Compiler options, without those that the installed XLA does not have.

    Options come and go between releases, even minor ones, and one that XLA does not have is an error. Which it has is
    found by compiling something when the options are first read, not before: XLA then reads XLA_FLAGS.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._options = options

    @functools.cached_property
    def _had(self) -> dict[str, Any]:
        return {option: value for option, value in self._options.items() if _is_option(option, value)}

    def __getitem__(self, option: str) -> Any:
        return self._had[option]

    def __iter__(self) -> Iterator[str]:
        return iter(self._had)

    def __len__(self) -> int:
        return len(self._had)


@functools.cache
def _is_option(option: str, value: Any) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options={option: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


# Without LLVM's optimisation one world runs slower, and a batch, of which nothing is vectorised then, much slower. Its
# higher levels take longer to compile than the first and are no faster.
PLAINER = {
    "xla_cpu_use_fusion_emitters": False,  # up to JAX 0.11.0; with them a batch runs faster, but compiling takes longer
    # They gain nothing here, and have all passes before them run again: half of the rounds of simplification are due to
    # a reshape that is moved by one operation in each.
    "xla_disable_hlo_passes": "reshape-mover,while-loop-constant-sinking,tree_reduction_rewriter",
}
LEVEL = "xla_backend_optimization_level"
QUICK: Any = Options(  # `jax.jit` is annotated to take a dict
    PLAINER | {LEVEL: 0, "xla_cpu_parallel_codegen_split_count": 1}
)
# For programs that run for longer than they compile; where XLA_FLAGS sets a level, as in the tests, that holds.
LASTING = Options(PLAINER | ({} if LEVEL in os.environ.get("XLA_FLAGS", "") else {LEVEL: 1}))
# For large batches: vectors are as wide as there are, where LLVM by itself takes half of that.
VECTORS = {"xla_cpu_prefer_vector_width": 512}
WIDE = Options(VECTORS)
# A loop whose step accesses fewer bytes is one function; short loops over the worlds are not written out one by one
# before they are vectorised, as LLVM otherwise does up to a few hundred.
SPEED = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000,-unroll-full-max-count=8",
    *(f"--{option}={value}" for option, value in VECTORS.items()),
)

Inputs = ParamSpec("Inputs")
Result = TypeVar("Result")


def compiled(options: Any, *static: str) -> Callable[[Callable], Callable]:
    """Decorator: `jax.jit` with compiler options and names of static arguments, made by `program()` at the first call.

    `jax.jit` itself reads the options at once, and so starts XLA when the module is imported.
    """

    def decorate(fn: Callable) -> Callable:
        @functools.wraps(fn)
        def called(*args: Any, **kwargs: Any) -> Any:
            return program()(*args, **kwargs)

        program = functools.cache(lambda: jax.jit(fn, static_argnames=static, compiler_options=options))
        called.program = program  # type: ignore[attr-defined]
        return called

    return decorate


def uncollected(fn: Callable[Inputs, Result]) -> Callable[Inputs, Result]:
    """`fn` with Python's garbage collector paused, for functions that may trace a program.

    Tracing creates hundreds of thousands of objects that all survive; scanning them takes much of its time.
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


def is_own_program() -> bool:
    """Whether JAX is outside jit, loops and branches: only there do compiler options apply.

    Inside another program `jax.jit` has the options of that one.
    """
    return not isinstance(lax.neg(np.float32(0)), jax.core.Tracer)  # within a trace every operation is traced


def compile_for_speed() -> None:
    """Have JAX compile for speed on a CPU, from here on in this process; call it before anything else uses JAX.

    A loop, and so a rollout, is then one function, where XLA up to JAX 0.11 makes one of every few operations: two to
    eight times as fast for a single world, 1.5 to 4 times for a batch. Compiling takes about as long as JAX by itself
    needs in 2D, and 1.6 times (a rollout) to three times (a gradient) as long in 3D. Do not use it for `fit`, which
    spends most of its time compiling. Sets XLA_FLAGS, which JAX reads when it is first used.

    Raises:
        RuntimeError: JAX was in use already, so that it did not read XLA_FLAGS.

    Example:
        >>> import diffrigid as dr  # doctest: +SKIP
        >>> dr.compile_for_speed()  # doctest: +SKIP
    """
    before = os.environ.get("XLA_FLAGS", "")
    flags = before.split()
    os.environ["XLA_FLAGS"] = " ".join(flags + [flag for flag in SPEED if flag not in flags])
    read = get_compile_options(num_replicas=1, num_partitions=1).SerializeAsString()
    if b"xla_cpu_small_while_loop_byte_threshold" in read:
        return
    os.environ["XLA_FLAGS"] = before
    raise RuntimeError(
        "compile_for_speed: JAX was in use before, and had read XLA_FLAGS: restart Python (the kernel of a notebook) "
        "and call it right after the imports"
    )


def is_for_speed() -> bool:
    """Whether JAX was told to compile as by `compile_for_speed`."""
    return set(SPEED) <= set(os.environ.get("XLA_FLAGS", "").split())
