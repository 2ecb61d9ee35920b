"""How programs are compiled."""

import collections
import contextlib
import functools as ft
import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from ..device import on_cpu
from ..executor import OutOfTimeError, at_most, from_host, to_host
from ..progress import say_compiling
from ..tracing import is_inside_program, is_traced
from .garbage_collector import uncollected


# What makes XLA compile for the CPU in a third of the time: no optimization passes of LLVM, and
# the older of its two code generators. Options that an XLA does not know are left out.
_QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}

# Seconds that the host spends before a program is compiled in its place, which takes about as long.
# Twice as much: repeated calls stay slow for twice as long, and fewer programs are made that are
# not worth it.
_WORTH_COMPILING = 3.0


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
        return eqx.filter_jit(traced, compiler_options=compiler_options())

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


def host_first(function: Callable) -> Callable:
    """A function of few lanes, run on the host (see `_core/executor.py`) as long as that is the
    quicker way; compiled as by `quick_jit` once the host has spent as much on arguments of the same
    kind as compiling takes. Which of the two gave a result makes no difference beyond rounding.

    Inside of a transformation of JAX, and on other devices than the CPU, this is `quick_jit`.
    """
    compiled = quick_jit(function)
    spent = collections.defaultdict(float)

    @ft.wraps(function)
    def call(*arguments):
        if not on_cpu() or is_traced(arguments) or is_inside_program():
            return compiled(*arguments)
        what, begin = kind(arguments), time.thread_time()
        left = _WORTH_COMPILING - spent[what]
        if left <= 0:
            return compiled(*arguments)
        try:
            with uncollected, at_ease(), at_most(left):
                return from_host(function(*to_host(arguments)))
        except OutOfTimeError:
            return compiled(*arguments)
        finally:
            spent[what] += time.thread_time() - begin

    return call


def at_ease() -> contextlib.AbstractContextManager:
    """A context in which NumPy, as JAX, says nothing of numbers that are infinite or not defined.

    (Tests replace it, so that checks of types rest, too.)
    """
    return np.errstate(all="ignore")


def kind(arguments) -> tuple:
    """What a program is compiled for: all but the values of arrays."""
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    array = lambda x: isinstance(x, jax.Array | np.ndarray | np.generic)  # noqa: E731
    return structure, *((x.shape, x.dtype) if array(x) else (type(x), x) for x in leaves)


@ft.cache
def compiler_options() -> dict[str, int | bool]:
    def known(options):
        try:
            jax.jit(lambda: 0, compiler_options=options)()
        except Exception:  # whatever this XLA raises for an option that it does not have
            return False
        return True

    if known(_QUICK):
        return _QUICK
    return {name: value for name, value in _QUICK.items() if known({name: value})}
