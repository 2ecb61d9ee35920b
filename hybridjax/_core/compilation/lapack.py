"""Programs that call LAPACK, which run one at a time.

XLA hands factorizations that are left in a program (`_core/vector_math/rewrite.py`) to LAPACK, on
the threads of its pool. Two such programs in threads of their own can wait for each other for ever.
"""

import contextlib
import os
import threading
from collections.abc import Iterator


_turn = threading.Lock()


def calls_lapack(code: bytes) -> bool:
    """Whether a program that was lowered, as bytes, calls LAPACK."""
    return b"lapack_" in code


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
