"""Digests of functions: what makes them differ, and what does not."""

import dataclasses
import functools
import time

import equinox as eqx
import jax
import numpy as np
import pytest

from hybridjax._core.pieces.description import function_digest


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


def test_functions_that_call_each_other_are_looked_at_once():
    """Sixty of them, each calling the ten before; and two that call one another."""
    calls = (
        " + ".join([f"g{j}(x)" for j in range(max(i - 10, 0), i)] + [str(i)]) for i in range(60)
    )
    source = "\n".join(f"def g{i}(x): return {call}" for i, call in enumerate(calls))
    before = time.process_time()
    function_digest(module(source + "\ndef f(x): return g59(x)"))
    assert time.process_time() - before < 1.0
    mutual = "def f(n): return n and g(n - 1)\ndef g(n): return n or {} * f(n - 1)"
    assert function_digest(module(mutual.format(1))) != function_digest(module(mutual.format(2)))
