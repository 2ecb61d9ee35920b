"""Whether JAX is transforming something at the moment."""

from typing import Any

import jax


def is_traced(*trees: Any) -> bool:
    """Whether some leaf of `trees` is a tracer, so that its value cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(trees))
