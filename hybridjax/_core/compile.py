"""How programs are compiled."""

import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax


def quick_jit(function: Callable) -> Callable:
    """`equinox.filter_jit` for programs that run a few times: compiled with little optimisation.

    Finding a cycle or linearising it takes milliseconds, and compiling the program for it
    seconds; on CPU, without LLVM's optimisation passes, half as many. Inside of another jit, or
    under any other transformation of JAX, this is `filter_jit`: there the outer program decides.
    """
    plain = eqx.filter_jit(function)
    quick = eqx.filter_jit(function, compiler_options={"xla_backend_optimization_level": 0})

    @ft.wraps(function)
    def call(*arguments):
        if jax.default_backend() != "cpu":
            return plain(*arguments)
        try:
            return quick(*arguments)
        except ValueError as error:
            if "compiler_options" not in str(error):  # JAX allows them at the top level only
                raise
            return plain(*arguments)

    return call
