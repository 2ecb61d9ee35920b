"""Functions are known by what they compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybridjax._core.pieces.description import IndescribableError, program_digest


def with_rule(slope):
    @jax.custom_jvp
    def function(x):
        return x**2

    function.defjvps(lambda dx, _, x: slope * x * dx)
    return function


POINT = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((3,), float)
TABLE = np.linspace(0, 1, 100)
DIFFERENT = {
    "product": lambda t, q: t * q,
    "sum": lambda t, q: t + q,
    "constant": lambda t, q: t * q + 1e-9,
    "last digit": lambda t, q: t * q + 1.0000000000000002e-9,
    "part": lambda t, q: t * q[:2],
    "branch": lambda t, q: jnp.where(t > 0, q, 0.0),
    "integers": lambda t, q: q[jnp.asarray([0, 1])] * t,
    "other integers": lambda t, q: q[jnp.asarray([0, 2])] * t,
    "table": lambda t, q: jnp.interp(t, TABLE, TABLE**2),
    "other table": lambda t, q: jnp.interp(t, TABLE, TABLE**2 + 1e-15),
    "rule": lambda t, q: with_rule(2.0)(q),
    "other rule": lambda t, q: with_rule(3.0)(q),
    "loop": lambda t, q: jax.lax.fori_loop(0, 3, lambda _, x: jnp.sin(x), q),
    "longer loop": lambda t, q: jax.lax.fori_loop(0, 4, lambda _, x: jnp.sin(x), q),
    "jit": lambda t, q: jax.jit(lambda x: x * TABLE[3])(q),
}


def test_functions_that_differ_have_other_digests():
    digests = {name: program_digest(function, *POINT) for name, function in DIFFERENT.items()}
    assert len(set(digests.values())) == len(digests)
    shapes = [jax.ShapeDtypeStruct((2,), float), jax.ShapeDtypeStruct((3,), np.float32)]
    product = DIFFERENT["product"]
    others = [program_digest(product, POINT[0], shape) for shape in shapes]
    assert len({digests["product"], *others}) == 3


def test_functions_that_are_written_anew_have_the_same_digest():
    for make in (lambda: lambda t, q: t * q, lambda: lambda t, q: with_rule(2.0)(q)):
        assert program_digest(make(), *POINT) == program_digest(make(), *POINT)


def test_callbacks_into_python_have_none():
    def function(t, q):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), t)

    with pytest.raises(IndescribableError):
        program_digest(function, *POINT)
