"""Double precision: switched on by the user, required by the solvers."""

from typing import Any

import jax
import jax.numpy as jnp

from .errors import PrecisionError


def enable_x64() -> None:
    """Switch JAX to 64-bit floating point for this process.

    hybridjax never does this at import, since the switch is global to JAX. Call it once, before
    any model is built: arrays made earlier stay 32 bit.
    """
    jax.config.update("jax_enable_x64", True)


def require_x64(*trees: Any) -> None:
    """Refuse to compute in single precision.

    **Raises:** `PrecisionError` if JAX runs in 32-bit mode, or if a floating-point leaf of one
    of `trees` is 32 bit (a model that was built before `enable_x64()`).
    """
    if not jax.config.read("jax_enable_x64"):
        raise PrecisionError(
            "JAX is in 32-bit mode, too coarse for limit cycles and their derivatives: call "
            "`hybridjax.enable_x64()` before building the model."
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path(trees):
        dtype = getattr(leaf, "dtype", None)
        if dtype is not None and jnp.issubdtype(dtype, jnp.floating) and dtype != jnp.float64:
            name = jax.tree_util.keystr(path[1:]).lstrip(".") or "argument"
            raise PrecisionError(
                f"`{name}` is {dtype}: it was built before `hybridjax.enable_x64()`. Switch 64-bit "
                "mode on first, then build it again."
            )
