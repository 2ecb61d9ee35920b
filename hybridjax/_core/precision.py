"""Double precision: switched on by the user, required by the solvers.

Functions that compute call `require_x64` first; `real` converts fields of systems, transitions,
guesses, sections and settings. The precision must not be switched when the package is imported,
since the switch holds for all programs of JAX in the process.

If an array is refused without need, look at the leaf that `require_x64` names; if numbers of a
definition that was made before `enable_x64` have lost digits, look whether their field has the
converter `real`; if a worker or a thread computes in single precision, at its start
(`pieces/cluster.py`, `execution.py`).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import jax_compat
from .exceptions import PrecisionError


def enable_x64() -> None:
    """Switch JAX to 64-bit floating point for this process.

    hybridjax never does this at import, since the switch is global to JAX. Call it once, before
    anything is computed. Models, guesses, sections and settings may be built earlier; arrays of
    `jax.numpy` that were made earlier stay 32 bit, and raise an error.

    **Returns:** None.

    **Example:**

    ```python
    hj.enable_x64()
    ```

    **After:** every function that computes.
    """
    jax_compat.use_double_precision()


def require_x64(*trees: Any) -> None:
    """Refuse to compute in single precision.

    **Raises:** `PrecisionError` if JAX runs in 32-bit mode, or if a floating-point leaf of one
    of `trees` is of less than 64 bits (an array of JAX that was made before `enable_x64()`).
    """
    if not jax_compat.has_double_precision():
        raise PrecisionError(
            "JAX is in 32-bit mode: call `hybridjax.enable_x64()` first."
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path(trees):
        dtype = getattr(leaf, "dtype", None)
        if dtype is None or not jnp.issubdtype(dtype, jnp.inexact):
            continue
        if dtype not in (jnp.float64, jnp.complex128):
            name = jax.tree_util.keystr(path[1:]).lstrip(".") or "argument"
            raise PrecisionError(
                f"`{name}` is {dtype}: it was built before `hybridjax.enable_x64()`: build it "
                "again."
            )


def real(x: Any) -> jax.Array:
    """`x` as an array of floating-point numbers: a converter for fields of definitions.

    Numbers of Python and NumPy keep their digits also where JAX is switched to 64 bits later, so
    that a definition may be built before. They keep their values while a program is traced, so that
    what depends on them alone is computed outside of it. Arrays of JAX remain what they are.
    """
    leaves = jax.tree_util.tree_leaves(x)
    if any(isinstance(leaf, jax.Array) for leaf in leaves):
        return jnp.asarray(x, float)
    # (No program is compiled for numbers of Python and NumPy.)
    with jax_compat.outside(), jax.enable_x64(True):
        return jax.device_put(np.asarray(x, float))
