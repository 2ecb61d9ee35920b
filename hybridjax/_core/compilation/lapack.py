"""Programs that call LAPACK, which run one at a time.

XLA hands factorizations that are left in a program (`_core/vector_math/rewrite.py`) to LAPACK, on
the threads of its pool. Two such programs in threads of their own can wait for each other for ever.
"""

import contextlib
import io
import os
import threading
from collections.abc import Callable, Hashable, Iterator
from typing import Any

from .compile import kind


_turn = threading.Lock()
_known: dict[Hashable, bool] = {}


def calls_lapack(module: Any) -> bool:
    """Whether a program that was lowered, as a module of MLIR, calls LAPACK."""
    module.operation.write_bytecode(code := io.BytesIO())
    return b"lapack_" in code.getvalue()


def is_left_to_lapack(program: Callable, *arguments: Any) -> bool:
    """Whether a program calls LAPACK for arguments of this kind.

    **Arguments:** `program`, as `quick_jit` and `equinox.filter_jit` make it.
    """
    name = program, kind(arguments)
    if name not in _known:
        _known[name] = calls_lapack(program.lower(*arguments).lowered.compiler_ir())
    return _known[name]


@contextlib.contextmanager
def in_turn(wanted: bool) -> Iterator[None]:
    """A context in which no other thread is at the same time, if `wanted`."""
    with _turn if wanted else contextlib.nullcontext():
        yield


def _renew() -> None:
    """A forked process has none of the other threads, one of which may have held the lock."""
    global _turn
    _turn = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
