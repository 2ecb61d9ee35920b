"""How programs are compiled."""

import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from .collection import uncollected
from .tracing import is_traced


# What makes XLA compile for the CPU in a third of the time: no optimisation passes of LLVM, and
# the older of its two code generators. Options that an XLA does not know are left out.
_QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# What saves a tenth of the time, and makes programs that run as fast: fewer passes of LLVM.
_FULL = {"xla_backend_optimization_level": 1}


def quick_jit(function: Callable) -> Callable:
    """`equinox.filter_jit` for programs that run a few times: compiled with little optimisation.

    Finding a cycle or linearising it takes milliseconds, and compiling the program for it
    seconds. Inside of another jit, or under any other transformation of JAX, this is
    `filter_jit`: there the outer program decides.
    """
    program = _jit(function, _QUICK)

    @ft.wraps(function)
    def call(*arguments):
        with uncollected:
            return program(*arguments)

    call.lower = program.lower
    return call


def full_jit(function: Callable) -> Callable:
    """`equinox.filter_jit` for programs that run for long."""
    return _jit(function, _FULL)


def _jit(function: Callable, options: dict[str, Any]) -> Callable:
    plain = eqx.filter_jit(function)

    @ft.cache
    def optioned():
        return eqx.filter_jit(function, compiler_options=_known(options))

    @ft.wraps(function)
    def call(*arguments):
        # JAX refuses the options below the top level only after it has traced the function.
        if not _on_cpu() or is_traced(arguments):
            return plain(*arguments)
        try:
            return optioned()(*arguments)
        except ValueError as error:
            if "compiler_options" not in str(error):  # JAX allows them at the top level only
                raise
            return plain(*arguments)

    call.lower = lambda *arguments: (optioned() if _on_cpu() else plain).lower(*arguments)
    return call


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def _known(options: dict[str, Any]) -> dict[str, Any]:
    """Those that this XLA has."""
    return dict(item for item in options.items() if _is_known(*item))


@ft.cache
def _is_known(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options={name: value})()
    except Exception:  # whatever this XLA raises for an option that it does not have
        return False
    return True
