"""What XLA says when it loads a compiled program.

It compares the processor's features with those that the program was compiled for, among which are
two preferences (`prefer-no-gather`, `prefer-no-scatter`) that no processor has, and so reports two
errors, a page each, for every program that it loads where it was compiled. There is no option of
the compiler that leaves them out; JAX's only switch is the level of all messages of XLA.
"""

import contextlib
import os
from collections.abc import Iterator

import jax


_LEVELS = {"0": "INFO", "1": "WARNING", "2": "ERROR", "3": "CRITICAL"}
_usual = _LEVELS.get(os.environ.get("TF_CPP_MIN_LOG_LEVEL", ""), "WARNING")


def silence_for_good() -> None:
    """From now on XLA reports errors by exceptions only."""
    global _usual
    _usual = "CRITICAL"
    _set(_usual)


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """A context in which XLA reports errors by exceptions only."""
    _set("CRITICAL")
    try:
        yield
    finally:
        _set(_usual)


def _set(level: str) -> None:
    """The level of messages of XLA. That of JAX's own loggers, which goes with it, is put back."""
    before = jax.config.jax_logging_level
    jax.config.update("jax_logging_level", level)
    jax.config.update("jax_logging_level", before)
