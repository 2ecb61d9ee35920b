"""Compile functions of users and of this package, with the options that pay off for each.

All rooms call it. A lane is one of many states that a program computes at once, on the last axis of
each array; the host is this process's Python with NumPy, in place of a compiled program.

- `quick_jit` compiles with few optimizations: for functions that run a few times.
- `host_first` runs a function on the host until compiling it is worth its time.
- `Program` compiles experiments: with few optimizations, or for loops that run many times.
- `kernel` compiles single functions of users for code that runs on the host; `whole` programs that
  do more at once.

Options change the time, and results by rounding only: this must stay so, as must `in_turn`, without
which two programs may wait for each other for ever. If a program is compiled again without need, or
one is run that was compiled for something else, look at `kind` and `identity`, by which programs
are found again; if a function stays slow, at `WORTH_COMPILING` in `host_first`; if threads wait for
ever, at `alone` and `_calls_lapack`.
"""

import collections
import contextlib
import functools as ft
import gc
import hashlib
import os
import threading
import time
import weakref
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np

from . import executor, jax_compat
from .call import once_in_call
from .exceptions import ComputationError
from .executor import as_numpy, from_host, is_hidden, on_cpu, on_the_cpu, to_host
from .meaning import program_digest
from .progress import say_compiling


# Seconds of host time after which a function is compiled, which takes about as long. Less: programs
# are compiled that are not used again. More: repeated calls stay slow for longer.
WORTH_COMPILING = 6.0
# Programs that are kept of `Program`, and as many of `kernel` and `whole`. Fewer: calls that
# alternate between many systems compile again.
_KEPT = 1024


def enable_loop_kernels() -> None:
    """Have XLA compile each loop on CPU into one function of machine code, for this process.

    XLA otherwise makes a function of every few operations in a loop, and calls one after the other
    in each iteration, which takes up to half of the time of an experiment. With whole loops,
    experiments run 1.5 to 1.7 times as fast; programs compile 1.1 to 4 times as long (figures:
    docs/benchmarks.md). It is worthwhile for long studies. Results are the same up to rounding.
    (The XLA of JAX 0.12 compiles whole loops by default.)

    Call it before JAX computes anything: XLA reads its options once. The option is set in the
    environment variable `XLA_FLAGS`, so it holds for all programs of JAX in this process and in
    those that it starts. On other devices than CPU it changes nothing.

    **Returns:** None.

    **Raises:** `ComputationError`, on CPU, if XLA has read its options already, or does not have
    this option.

    **Example:**

    ```python
    import hybridjax as hj

    hj.scale.enable_loop_kernels()
    ```

    **After:** every function that computes.
    """
    before = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = " ".join(
        dict.fromkeys([*before.split(), jax_compat.LOOP_KERNELS])
    )
    if jax.default_backend() == "cpu" and not jax_compat.loops_are_kernels():
        os.environ["XLA_FLAGS"] = before
        raise ComputationError(
            "XLA has read its options already (call `enable_loop_kernels()` before JAX computes "
            "anything), or is of another version."
        )


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """A context in which Python's collector of cyclic garbage rests.

    Tracing makes hundreds of thousands of objects that live until the program is compiled, and the
    collector would visit all of them repeatedly: an eighth of the time of a first limit cycle. If
    threads share it, the collector may start early, and runs when all of them have left.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def quick_jit(function: Callable) -> Callable:
    """`equinox.filter_jit`, compiled with few optimizations, for functions that run a few times.

    Finding a cycle or linearizing it takes milliseconds, and compiling the program for it seconds.
    Inside of another transformation of JAX this is `filter_jit`: there the outer program decides.
    """

    @ft.wraps(function)
    def traced(*arguments):
        say_compiling(True)
        return function(*arguments)

    plain: Any = eqx.filter_jit(traced)

    @ft.cache
    def quick() -> Any:
        # (`filter_jit` hands options on to `jax.jit`.)
        options: Any = {"compiler_options": jax_compat.quick_options()}
        return eqx.filter_jit(traced, **options)

    @ft.wraps(function)
    def call(*arguments):
        with uncollected():
            # JAX allows options of the compiler at the top level only, and refuses them elsewhere
            # after it has traced the function.
            if not on_cpu() or is_hidden(arguments):
                return plain(*arguments)
            result = quick()(*arguments)
            say_compiling(False)
            return result

    def lower(*arguments):
        program = quick() if on_cpu() else plain
        return program.lower(*arguments)

    setattr(call, "lower", lower)  # noqa: B010 (that of a function is not declared)
    return call


def one_program(function: Callable) -> Callable:
    """A function that runs on the host. Where JAX traces its arguments, it is one program:
    otherwise each operation would be compiled by itself."""
    program = quick_jit(function)

    @ft.wraps(function)
    def call(*arguments):
        if is_hidden(arguments):
            return program(*arguments)
        return function(*arguments)

    return call


def on_the_host(
    function: Callable, derived: Callable = lambda compiled: compiled
) -> Callable:
    """A function that runs on the host (see `executor.py`); inside of a transformation of JAX
    `quick_jit`, or that `derived`, as by `by_columns`."""
    transformed = derived(quick_jit(function))

    @ft.wraps(function)
    def call(*arguments):
        if is_hidden(arguments):
            return transformed(*arguments)
        with on_the_cpu(), jax_compat.outside(), uncollected(), at_ease():
            return from_host(function(*to_host(arguments)))

    return call


def host_first(
    function: Callable, derived: Callable = lambda compiled: compiled
) -> Callable:
    """A function of few lanes, run on the host (see `executor.py`) while that is faster in total;
    compiled by `quick_jit` once the host has spent as much on arguments of the same kind as
    compiling takes: in a thread, or at once if a single call has taken so long. Both give the same
    result up to rounding.

    Inside of a transformation of JAX this is `quick_jit`, or that `derived`.
    """
    compiled: Any = quick_jit(function)
    transformed = derived(compiled)
    hosted = on_the_host(function)
    spent: dict[tuple, float] = collections.defaultdict(float)
    programs: dict[tuple, Callable] = {}

    def compile_(arguments):
        # (It is not run: programs with factorizations may run in one thread only, see `in_turn`.)
        with on_the_cpu(), as_numpy():  # (under JAX's settings of this thread)
            programs[kind(arguments)] = compiled.lower(*arguments).compile()

    @ft.wraps(function)
    def call(*arguments):
        if is_hidden(arguments):
            return transformed(*arguments)
        with on_the_cpu():
            return on_host(*arguments)

    def on_host(*arguments):
        key = kind(arguments)
        before = spent[key]
        begin = time.thread_time()
        if key in programs:
            return programs[key](*arguments)
        try:
            with executor.at_most(WORTH_COMPILING):
                return hosted(*arguments)
        except executor.OutOfTimeError:
            programs[key] = compiled
            return compiled(*arguments)
        finally:
            spent[key] += time.thread_time() - begin
            if before <= WORTH_COMPILING < spent[key] and key not in programs:
                threading.Thread(target=compile_, args=(arguments,)).start()

    return call


def at_ease() -> contextlib.AbstractContextManager:
    """A context in which NumPy, like JAX, does not warn of infinite and undefined numbers. (Tests
    replace it, to skip checks of types.)"""
    return np.errstate(all="ignore")


def kind(arguments) -> tuple:
    """All that a program is compiled for: everything of the arguments but the values of arrays, and
    JAX's settings (in a thread: those of all threads)."""
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    types = []
    for x in leaves:
        types.append((x.shape, x.dtype) if _is_array(x) else (type(x), x))
    return structure, *jax_compat.settings_of_programs(), *types


class Program:
    """`function(*arguments)`, compiled once for all arguments of a kind.

    **Arguments:** `loops`: whether it runs through loops many times, and is optimized for these.
    Otherwise it compiles in 60 % of the time, and takes four times as long to run.
    """

    def __init__(self, function: Callable, loops: bool):
        self._function, self._loops = function, loops
        self._plain = eqx.filter_jit(function)

    def __call__(self, *arguments: Any) -> Any:
        if not _is_simple() or is_hidden(arguments):
            return self._plain(*arguments)
        lowered, leaves = _lowered(self._function, arguments)
        executable = lowered.executable(self._loops)
        with in_turn(lowered.alone):
            return jax.block_until_ready(executable(leaves))


class _Lowered:
    """A program that is lowered, and its executables, with and without optimized loops.

    **Fields:** `alone`: whether it calls LAPACK (see `in_turn`).
    """

    def __init__(self, lowered: jax.stages.Lowered, alone: bool):
        self._lowered, self.alone = lowered, alone
        self._executables: dict[bool, jax.stages.Compiled] = {}

    def executable(self, loops: bool) -> jax.stages.Compiled:
        with _choosing:
            if loops not in self._executables:
                options = jax_compat.quick_options()
                if loops:
                    options = jax_compat.loop_options()
                say_compiling(True)
                compiled = self._lowered.compile(compiler_options=options)
                self._executables[loops] = compiled
                say_compiling(False)
            return self._executables[loops]


_choosing = threading.Lock()
_by_kind: dict[tuple, _Lowered] = {}
_by_text: dict[Hashable, _Lowered] = {}


def _lowered(function: Callable, arguments: tuple) -> tuple[_Lowered, list]:
    """The program of a function for arguments of this kind, and their arrays.

    Objects that hold the same functions written anew (an `Output` with a `lambda`) are of other
    kinds, but have the same text and share executables.
    """
    key = function, kind(arguments)
    arrays, static = eqx.partition(arguments, _is_array)
    leaves, structure = jax.tree_util.tree_flatten(arrays)

    def run(leaves):
        arrays = jax.tree_util.tree_unflatten(structure, leaves)
        return function(*eqx.combine(arrays, static))

    with _choosing:
        if key not in _by_kind:
            if len(_by_kind) >= _KEPT:
                _by_kind.clear()
                _by_text.clear()
            with uncollected():
                say_compiling(True)
                traced = jax.jit(run).trace(leaves)
                lowered = traced.lower()
                say_compiling(False)
            needed, _ = jax_compat.needed_part(traced.jaxpr.jaxpr)
            text = lowered.as_text()
            digest = function, hashlib.sha256(text.encode()).digest()
            new = _Lowered(lowered, jax_compat.calls_lapack(needed))
            _by_kind[key] = _by_text.setdefault(digest, new)
        return _by_kind[key], leaves


def _is_simple() -> bool:
    """Return whether JAX computes on the first CPU, and runs programs as they are."""
    device = executor.default_device()
    first = device in (None, "cpu") or device == jax.local_devices(backend="cpu")[0]
    return on_cpu() and first and jax_compat.runs_programs_as_they_are()


# XLA hands factorizations that are left in a program (`vector_math/rewrite.py`) to LAPACK, on the
# threads of its pool. Two programs with factorizations, run by two threads, can wait for each other
# for ever.
_turn = threading.Lock()


@contextlib.contextmanager
def in_turn(alone: bool) -> Iterator[None]:
    """A context for running a program; one that must be `alone` waits until no other such program
    runs."""
    with _turn if alone else contextlib.nullcontext():
        yield


def kernel(
    function: Callable,
    form: Callable,
    static: tuple[Hashable, ...],
    trees: Any,
    lanes: int,
) -> Callable:
    """`function(*static, *trees, *point)` of single points, brought to lanes by a `form` and
    compiled, as a function of NumPy's arrays.

    `form(function, *trees)` is a function of arrays with lanes on their last axis, as its result is
    (see `engine/kernels.py`). An argument may have one lane where others have more. `some` is a
    mask of the lanes that are needed; all others get the results of one needed lane. `function` and
    `form` have to be the same objects in each call, so they are defined at the top of modules.

    One program serves everything of the same structure: the same classes, static fields, functions,
    and shapes and types of arrays. The arrays themselves are arguments. Two classes that compute
    the same share it, such as a class whose notebook cell has run again.

    The program is for this number of `lanes`: more lanes are done in several calls, fewer are
    filled up with copies. (XLA runs the smallest programs, of a thousand operations, in the thread
    that calls them, and hands larger ones to another thread, which takes longer than they do.)
    """
    program, arrays = _bound(function, form, static, trees, lanes)
    return ft.partial(_run_lanes, program, [_of_jax(x) for x in arrays], lanes)


def _run_lanes(
    program: Callable,
    arrays: list,
    lanes: int,
    *arguments,
    some=None,
) -> np.ndarray:
    """The results of a kernel for arguments of any number L of lanes, in blocks of `lanes`; `some`
    is a mask (L,), see `kernel`."""
    if some is not None:
        needed = [x[..., some] if x.shape[-1] == len(some) else x for x in arguments]
        values = _run_lanes(program, arrays, lanes, *needed)
        return values[..., np.maximum(np.cumsum(some) - 1, 0)]
    L = max(x.shape[-1] for x in arguments)
    if L == lanes == 1:
        return np.asarray(program(arrays, *arguments))
    filled = -(-L // lanes) * lanes
    columns = [_fill(x, L, filled) for x in arguments]
    if filled == lanes:
        return np.asarray(program(arrays, *columns))[..., :L]
    parts = []
    for begin in range(0, filled, lanes):
        block = [x[..., begin : begin + lanes] for x in columns]
        parts.append(program(arrays, *block))
    return np.concatenate(parts, axis=-1)[..., :L]


def whole(
    function: Callable,
    static: tuple,
    trees: Any,
    loops: bool = False,
) -> Callable[..., Any]:
    """`function(*static, *trees, *arguments)` of any arguments and results as one program, with
    arrays of NumPy.

    **Arguments:** `loops`: whether it runs through loops many times, and is optimized for these.
    """
    program, arrays = _bound(function, ft.partial, static, trees, 1, loops)

    def call(*arguments):
        with uncollected():
            if program not in _calls_lapack:
                traced = program.trace(arrays, *arguments).jaxpr.jaxpr
                _calls_lapack[program] = jax_compat.calls_lapack(traced)
            with in_turn(_calls_lapack[program]):
                result = program(arrays, *arguments)
                return jax.tree_util.tree_map(np.asarray, result)

    return call


_calls_lapack: weakref.WeakKeyDictionary[Any, bool] = weakref.WeakKeyDictionary()
"""Programs that must run one at a time."""


def _bound(
    function,
    form,
    static,
    trees,
    lanes,
    loops: bool = False,
) -> tuple[Callable, list]:
    """The program of a kernel, which is found again by all but the values of arrays, and the
    arrays of its trees."""
    leaves, structure = jax.tree_util.tree_flatten(trees)
    arrays = [_nearby(x) for x in leaves if _is_array(x)]
    key = function, form, static, lanes, identity(trees)
    if loops:
        options = jax_compat.loop_options()
    else:
        options = jax_compat.quick_options(small=True)
    with _kernels_lock:
        if key not in _kernels:
            _kernels[key] = _kernel_program(
                function, form, static, structure, leaves, options
            )
        _kernels.move_to_end(key)
        while len(_kernels) > _KEPT:
            _kernels.popitem(last=False)
        return _kernels[key], arrays


def _nearby(x: Any) -> Any:
    """An array on the CPU. (An accelerator's array is copied once, by way of NumPy, and not in each
    call. A NumPy array stays: converting it to JAX takes 20 times as long as calling with it.)"""
    device = getattr(x, "device", None)
    is_there = getattr(device, "platform", "") == "cpu"
    return x if is_there else np.asarray(x)


def _of_jax(x: Any) -> jax.Array:
    """An array of JAX, with which calls are faster: made once in a public call, since many kernels
    take the same arrays."""
    if isinstance(x, jax.Array):
        return x
    return once_in_call(("of JAX", id(x)), x, lambda: jax.device_put(x))


_kernels: collections.OrderedDict[tuple, Callable] = collections.OrderedDict()
_kernels_lock = threading.Lock()


def _kernel_program(function, form, static, structure, leaves, options) -> Callable:
    """The program of a kernel. Leaves that are no arrays (`still`) become part of it; arrays are
    its first argument."""
    still = [None if _is_array(x) else x for x in leaves]
    places = [k for k, x in enumerate(leaves) if _is_array(x)]

    def run(arrays, *arguments):
        leaves = list(still)
        for k, x in zip(places, arrays, strict=True):
            leaves[k] = x
        trees = jax.tree_util.tree_unflatten(structure, leaves)
        return form(ft.partial(function, *static), *trees)(*arguments)

    # (One for each number of lanes, as it is for arrays of one shape.)
    return jax.jit(run, compiler_options=options)


def identity(trees: Any) -> tuple:
    """All of trees but the values of arrays. Of a system: the digest of what it computes, whatever
    its code looks like."""
    parts, structure = jax.tree_util.tree_flatten(
        trees, is_leaf=lambda x: bool(program_digest(x))
    )
    return structure, *map(_identity_of_part, parts)


def _identity_of_part(x: Any) -> Hashable:
    digest = program_digest(x)
    if digest:
        arrays = filter(_is_array, jax.tree_util.tree_leaves(x))
        return digest, *((y.shape, y.dtype) for y in arrays)
    # (1, 1.0 and True are equal, and not the same.)
    return None if _is_array(x) else (type(x), x)


def computation(trees: Any) -> tuple:
    """All of trees, with the values of arrays: equal if the same is computed from the same."""
    arrays = filter(_is_array, jax.tree_util.tree_leaves(trees))
    return identity(trees), *(np.asarray(x).tobytes() for x in arrays)


def _fill(x: np.ndarray, L: int, filled: int) -> np.ndarray:
    """x with `filled` lanes: its L lanes, then copies of the first."""
    if x.shape[-1] == 1:
        return x.repeat(filled, axis=-1)
    if filled == L:
        return x
    padding = np.repeat(x[..., :1], filled - L, axis=-1)
    return np.concatenate([x, padding], axis=-1)


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)
