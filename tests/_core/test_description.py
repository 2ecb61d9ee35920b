"""Digests of functions: what makes them differ, and what does not."""

import dataclasses
import functools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybridjax._core.pieces.description import (
    IndescribableError,
    function_digest,
    program_digest,
)


def module(source, **held):
    """The function f of a module with this source."""
    space = {"__name__": "mine", **held}
    exec(source, space)
    return space["f"]


@dataclasses.dataclass(frozen=True)
class Plain:
    k: float


class Module(eqx.Module):
    k: float


class Slots:
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k

    def __call__(self, q):
        return self.k * q


def around(held):
    return lambda q: held.k * q


HELPER = "def h(x):\n    return {} * x\n\ndef f(q):\n    return [h(x) for x in q]"
MADE = {
    "a constant": lambda k: module("def f(q):\n    return G * q", G=k),
    "a constant in a function within": lambda k: module(
        "def f(q):\n    return list(map(lambda x: G * x, q))", G=(k, "m")
    ),
    "a table": lambda k: module("def f(q):\n    return G @ q", G=np.array([k, 1.0])),
    "a key": lambda k: module("def f(q):\n    return G", G=jax.random.key(int(k))),
    "a model": lambda k: module("def f(q):\n    return G.k * q", G=Module(k)),
    "a function": lambda k: module(HELPER.format(k)),
    "a compiled function": lambda k: module("import jax\n@jax.jit\n" + HELPER.format(k)),
    "a dataclass around it": lambda k: around(Plain(k)),
    "an equinox module around it": lambda k: around(Module(k)),
    "a dictionary around it": lambda k: functools.partial(lambda q, d: d, d={"k": k}),
    "words around it": lambda k: functools.partial(lambda q, d: d, d=np.array([str(k)], object)),
    "an object with slots": Slots,
}


@pytest.mark.parametrize("make", MADE.values(), ids=MADE)
def test_a_digest_says_what_a_function_does(make):
    """Another number makes another digest; the same made again, at another place, does not."""
    assert function_digest(make(1.0)) == function_digest(make(1.0)) != function_digest(make(2.0))
    same, other = ((Plain(0.0), make(k)) for k in (1.0, 2.0))
    assert function_digest(same) == function_digest((Plain(0.0), make(1.0)))
    assert function_digest(same) != function_digest(other)


def test_functions_that_call_each_other_are_described_once():
    """Sixty of them, each calling the ten before."""
    lines = [" + ".join(f"g{j}(x)" for j in range(max(i - 10, 0), i)) or "x" for i in range(60)]
    source = "\n".join(f"def g{i}(x): return {line}" for i, line in enumerate(lines))
    before = time.process_time()
    function_digest(module(source + "\ndef f(x): return g59(x)"))
    assert time.process_time() - before < 1.0


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
    "constant": lambda t, q: t * q + 1e-9,
    "last digit": lambda t, q: t * q + 1.0000000000000002e-9,
    "branch": lambda t, q: jnp.where(t > 0, q, 0.0),
    "table": lambda t, q: jnp.interp(t, TABLE, TABLE**2),
    "other table": lambda t, q: jnp.interp(t, TABLE, TABLE**2 + 1e-15),
    "rule": lambda t, q: with_rule(2.0)(q),
    "other rule": lambda t, q: with_rule(3.0)(q),
    "loop": lambda t, q: jax.lax.fori_loop(0, 3, lambda _, x: jnp.sin(x), q),
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
