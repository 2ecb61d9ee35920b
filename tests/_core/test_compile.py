"""Quick compilation, and where it is left to the program around."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybridjax._core.compilation.compile import quick_jit
from hybridjax._core.tracing import is_inside_program


@quick_jit
def double(x):
    return 2 * x


@quick_jit
def wrong(x):
    raise ValueError("compiler_options are not to blame")


X = jnp.arange(3.0)
WAYS = {
    "plain": lambda: double(X),
    "jit": lambda: jax.jit(double)(X),
    "jit without arguments": lambda: jax.jit(lambda: double(X))(),
    "scan": lambda: jax.lax.scan(lambda c, _: (c, double(X)), 0, None, length=1)[1][0],
    "cond": lambda: jax.lax.cond(True, lambda: double(X), lambda: X),
    "vmap": lambda: jax.vmap(double)(X),
    "vmap over something else": lambda: jax.vmap(lambda _: double(X))(X)[0],
    "jvp": lambda: jax.jvp(double, (X,), (X,))[1],
    "gradient over something else": lambda: jax.grad(lambda z: z * double(X).sum())(1.0) * X / 3,
}


@pytest.mark.parametrize("way", WAYS)
def test_it_works_wherever_it_is_called(way):
    np.testing.assert_array_equal(WAYS[way](), 2 * X)


def test_errors_of_the_function_come_through():
    for call in (wrong, jax.jit(wrong), lambda x: jax.jit(lambda: wrong(x))()):
        with pytest.raises(ValueError, match="not to blame"):
            call(X)


def test_inside_of_a_program():
    seen = []
    look = lambda: seen.append(is_inside_program())  # noqa: E731
    look()
    jax.jit(look)()
    jax.vmap(lambda x: (look(), x)[1])(X)
    assert seen == [False, True, False]
