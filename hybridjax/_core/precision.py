"""Double precision: switched on by the user, required by the solvers. Single precision, where it
will do."""

import contextlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import PrecisionError


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


def at_precision(double: float, single: float) -> float:
    """A threshold that is a matter of rounding, for the precision that JAX computes in."""
    return double if jax.config.read("jax_enable_x64") else single


def single_precision() -> contextlib.AbstractContextManager:
    """A context in which this thread computes in 32 bits, with what `single` returns."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(False)
    from jax.experimental import disable_x64  # before JAX 0.8

    return disable_x64()


def single(tree: Any) -> Any:
    """`tree` with its arrays rounded to 32 bits."""
    narrow = {"f": np.float32, "i": np.int32}

    def convert(x):
        if not eqx.is_array(x):
            return x
        x = np.asarray(x)
        return jnp.asarray(x.astype(narrow.get(x.dtype.kind, x.dtype)))

    return jax.tree_util.tree_map(convert, tree)
