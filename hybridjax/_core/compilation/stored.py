"""Large programs, which are compiled twice: quickly for a first answer, and thoroughly for more.

A program is known by a digest of all that it is made of (`fingerprint.py`). With
`enable_compilation_cache()` it is kept on disk under that name, where a later process finds it
without tracing anything.
"""

import contextlib
import functools as ft
import math
import os
import subprocess
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import equinox as eqx
import jax

from ..executor import Array
from ..progress import say_compiling
from ..tracing import is_inside_program, is_traced
from . import compilation_cache, kept, thorough
from .compile import compiler_options, kind, quick_jit
from .fingerprint import IndescribableError, digest, surroundings
from .garbage_collector import uncollected
from .lapack import in_turn, is_left_to_lapack
from .portable import Executable, Portable, build, trace


# Seconds that are spent in a program before it is compiled thoroughly, beside what goes on. Twice
# as much: repeated calls stay slow for twice as long, and fewer processes are started in vain.
_WORTH_A_PROCESS = 0.5
# Whether experiments that go into a store all wait for the thorough program: of two programs, which
# ran would depend on time.
ONE_PROGRAM = True
# Digests that are kept. Twice as many: twice as many kinds of jobs can be taken turns with.
_KEYS = 256


class Stored:
    """`function(*arguments)` for one job, all of which is done by the same program.

    A job that is `large` waits until the program is compiled thoroughly. Any other takes it if it
    is there, and otherwise the one that is compiled quickly. What has no digest, or is traced, is
    left to `equinox.filter_jit`, or `quick_jit` if it is not large.
    """

    def __init__(self, function: Callable, large: bool):
        self._function, self.large = function, large
        self._chosen: dict[str, Executable] = {}

    def __call__(self, *arguments: Any) -> Any:
        if is_traced(arguments) or is_inside_program() or not kept.is_simple():
            return self._plain(arguments)
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        leaves, structure = jax.tree_util.tree_flatten(arrays)

        def flat(*leaves):
            return self._function(*eqx.combine(structure.unflatten(leaves), rest))

        try:
            key = self._key(arguments)
            known = _programs.setdefault(key, _Known(key))
            with known.lock, uncollected:
                if key not in self._chosen:
                    self._chosen[key] = known.choose(lambda: trace(flat, leaves), self.large)
        except IndescribableError:
            return self._plain(arguments)
        return known.run(self._chosen[key], leaves)

    def _key(self, arguments) -> str:
        """What the program is known by."""
        about = surroundings()
        name = self._function, about, kind(arguments)
        if name not in _keys:
            if len(_keys) >= _KEYS:
                _keys.clear()
            _keys[name] = digest(self._function, about, arguments)
        return _keys[name]

    def _plain(self, arguments):
        program = _plain_program(self._function, self.large)
        with kept.one_by_one, uncollected:  # two threads would both compile it
            program.lower(*arguments).compile()
        if is_traced(arguments) or is_inside_program():
            return program(*arguments)
        with in_turn(alone := is_left_to_lapack(program, *arguments)):
            results = program(*arguments)
            return jax.block_until_ready(results) if alone else results


@ft.cache
def _plain_program(function: Callable, large: bool) -> Callable:
    return eqx.filter_jit(function) if large else quick_jit(function)


class _Known:
    """A program, and what this process has of it."""

    def __init__(self, key: str):
        self.key, self.lock = key, threading.Lock()
        self._programs: dict[str, Executable] = {}
        self._seconds = 0.0
        self._process: subprocess.Popen | None = None

    def choose(self, traced: Callable[[], Portable], large: bool) -> Executable:
        """The program for a job; `traced` gives what it is compiled from."""
        found = self._find("thorough")
        if found is None and large:
            self._compile_beside(traced)
            return self._find("thorough") or self._make("thorough", traced, {})
        return found or self._find("quick") or self._make("quick", traced, compiler_options())

    def run(self, program: Executable, arrays: list[Array]) -> Any:
        begin = time.perf_counter()
        results = jax.block_until_ready(program(*arrays))
        if program is self._programs.get("quick"):
            with self.lock:
                self._seconds += time.perf_counter() - begin
                if self._seconds > _WORTH_A_PROCESS:
                    self._start()
        return results

    def _find(self, tier: str) -> Executable | None:
        """The program, if it is in memory or on disk."""
        if tier not in self._programs:
            found = kept.find(self._name(tier))
            if found is not None:
                self._programs[tier] = found
        return self._programs.get(tier)

    def _make(self, tier: str, traced, options) -> Executable:
        to_keep = compilation_cache.folder() is not None
        with _compiling(), kept.once() if to_keep else contextlib.nullcontext():
            program = self._programs[tier] = build(self._traced(traced), options, to_keep)
        if to_keep:
            kept.store().write(self._name(tier), program.to_bytes())
        return program

    def _traced(self, traced) -> Portable:
        """What the program is compiled from, on disk from now on."""
        data = kept.store().read(self._name("traced"))
        if data is not None:
            return Portable.from_bytes(data)
        program = traced()
        kept.store().write(self._name("traced"), program.to_bytes())
        return program

    def _compile_beside(self, traced) -> None:
        """Wait for another process to compile the program thoroughly."""
        with _compiling():
            if self._process is None:
                self._traced(traced)
                self._start()
            if self._process is not None:
                self._process.wait()

    def _start(self) -> None:
        names = self._name("traced"), self._name("thorough")
        self._process = thorough.start(kept.store().folder, *names)
        self._seconds = -math.inf  # once is enough, whatever becomes of it

    def _name(self, what: str) -> str:
        return f"{self.key}-{what}"


_programs: dict[str, _Known] = {}
_keys: dict[Hashable, str] = {}


def _forget() -> None:
    """A forked process has none of the other threads, one of which may have held a lock."""
    _programs.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    say_compiling(True)
    try:
        yield
    finally:
        say_compiling(False)
