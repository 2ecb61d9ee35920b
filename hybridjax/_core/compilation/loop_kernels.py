"""Whole loops as single kernels: an option of XLA on CPU, switched on by request."""

import os

import jax
import jax.numpy as jnp

from ...errors import ComputationError


# Loops that touch fewer bytes than this in one iteration become one kernel: all of them. (XLA's own
# value is 1024.)
_FLAG = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"


def enable_loop_kernels() -> None:
    """Have XLA compile every loop on CPU into one function of machine code, for this process.

    XLA otherwise makes a function of every few operations in a loop, and calls one after the other
    whenever the loop goes round: up to half of the time of an experiment. With whole loops,
    experiments run 1.3 to 1.5 times as fast; programs compile 1.1 to 2.4 times as long, since large
    functions do (docs/benchmarks.md has figures). So it pays for long computations of your own,
    around `response_function`; `run_experiments` has such programs made where they pay. Results are
    the same up to rounding. (The XLA of JAX 0.12 makes whole loops without being asked.)

    Call it before JAX computes anything: XLA reads its options once. It concerns all programs of
    JAX in this process and in those that it starts, by the environment variable `XLA_FLAGS`. On
    other devices than CPU it changes nothing.

    **Raises:** `ComputationError`, on CPU, if it comes too late, or if this version of XLA cannot
    do it.
    """
    before = os.environ.get("XLA_FLAGS")
    os.environ["XLA_FLAGS"] = with_loop_kernels(before)
    if jax.default_backend() == "cpu" and not _in_use():
        os.environ.pop("XLA_FLAGS")
        if before is not None:
            os.environ["XLA_FLAGS"] = before
        raise ComputationError(
            "XLA does not make single kernels of loops: it has read its options already (call "
            "`enable_loop_kernels()` before JAX computes anything), or it is of another version."
        )


def with_loop_kernels(flags: str | None) -> str:
    """`XLA_FLAGS` with the option."""
    words = (flags or "").split()
    return " ".join(words if _FLAG in words else [*words, _FLAG])


def _in_use() -> bool:
    """Whether a loop that is larger than XLA's own limit is one kernel."""

    def loop(x, count):
        return jax.lax.fori_loop(0, count, lambda _, x: x * x[0], x)

    program = jax.jit(loop).lower(jnp.ones(1000), 9).compile()
    return "xla_cpu_small_call" in program.as_text()
