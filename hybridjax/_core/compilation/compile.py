"""How programs are compiled."""

import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax

from ..device import on_cpu
from ..progress import say_compiling
from ..tracing import is_inside_program, is_traced
from .garbage_collector import uncollected


# What makes XLA compile for the CPU in a third of the time: no optimization passes of LLVM, and
# the older of its two code generators. Options that an XLA does not know are left out.
_QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def quick_jit(function: Callable) -> Callable:
    """`equinox.filter_jit` for programs that run a few times: compiled with little optimization.

    Finding a cycle or linearizing it takes milliseconds, and compiling the program for it
    seconds. Inside of another jit, or under any other transformation of JAX, this is
    `filter_jit`: there the outer program decides.
    """

    @ft.wraps(function)
    def traced(*arguments):
        say_compiling(True)
        return function(*arguments)

    plain = eqx.filter_jit(traced)

    @ft.cache
    def quick():
        return eqx.filter_jit(traced, compiler_options=_options())

    def run(*arguments):
        # JAX allows options of the compiler at the top level only, and refuses them elsewhere after
        # it has traced the function.
        if not on_cpu() or is_traced(arguments) or is_inside_program():
            return plain(*arguments)
        result = quick()(*arguments)
        say_compiling(False)
        return result

    @ft.wraps(function)
    def call(*arguments):
        with uncollected:
            return run(*arguments)

    call.lower = lambda *arguments: (quick() if on_cpu() else plain).lower(*arguments)
    return call


@ft.cache
def _options() -> dict[str, int | bool]:
    def known(option):
        try:
            jax.jit(lambda: 0, compiler_options=dict([option]))()
        except Exception:  # whatever this XLA raises for an option that it does not have
            return False
        return True

    return dict(filter(known, _QUICK.items()))
