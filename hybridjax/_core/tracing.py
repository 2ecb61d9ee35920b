"""Whether JAX is transforming something at the moment."""

from typing import Any

import jax


def is_traced(*trees: Any) -> bool:
    """Whether some leaf of `trees` is a tracer, so that its value cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(trees))


def is_inside_program() -> bool:
    """Whether JAX is tracing a program (of `jit`, `scan`, `cond` ...) at the moment: whatever is
    computed then becomes part of it, even a constant."""
    return is_traced(_constant())


@jax.jit
def _constant():
    return 0.0
