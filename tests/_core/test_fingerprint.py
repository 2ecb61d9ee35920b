"""Programs have the same digest if they compute the same, and never otherwise."""

import subprocess
import sys
import types
from typing import Any

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.compilation import fingerprint
from hybridjax._core.compilation.fingerprint import IndescribableError, Program, digest
from hybridjax._core.precision import single_precision


NUMBER, THREE = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((3,), float)


def program(function, shape=NUMBER):
    return Program(lambda numbers, x: function(x), [], shape)


def ruled(slope):
    @jax.custom_jvp
    def function(x):
        return 2 * x

    function.defjvp(lambda x, dx: (2 * x[0], slope * dx[0]))
    return function


def table(last):
    values = np.array([1.0, 2.0, last])
    return lambda x: jnp.dot(values, x)


scaled = jax.extend.core.Primitive("scaled")
scaled.def_abstract_eval(lambda x, by: x)


def branches(number):
    return lambda x: jax.lax.cond(x > 0, lambda: number * x, lambda: x)


def rows(k):
    return lambda x: x.at[k].set(0.0)


DIFFERENT = {
    "a number": (lambda x: 2.0 * x, lambda x: 2.0000000000000004 * x, NUMBER),
    "a sign": (lambda x: x - 1, lambda x: 1 - x, NUMBER),
    "the sign of zero": (lambda x: x * 0.0, lambda x: x * -0.0, NUMBER),
    "a function": (jnp.sin, jnp.cos, NUMBER),
    "which of two": (lambda x: x[0] - x[1], lambda x: x[1] - x[0], THREE),
    "a constant array": (table(3.0), table(3.0000000000000004), THREE),
    "a rule for derivatives": (ruled(2.0), ruled(3.0), NUMBER),
    "a rule inside of a loop": (
        *(lambda x, s=s: jax.lax.fori_loop(0, 3, lambda _, x: ruled(s)(x), x) for s in (2.0, 3.0)),
        NUMBER,
    ),
    "a branch": (branches(2.0), branches(3.0), NUMBER),
    "what is inside of jit": (
        *(lambda x, k=k: jax.jit(lambda x: k * x)(x) for k in (2.0, 3.0)),
        NUMBER,
    ),
    "an index": (rows(1), rows(2), THREE),
    "the order of axes": (
        lambda x: jnp.outer(x, jnp.ones(3)),
        lambda x: jnp.outer(jnp.ones(3), x),
        THREE,
    ),
    "a number of NumPy's that an operation holds": (
        *(lambda x, k=k: scaled.bind(x, by=np.float64(k)) for k in (2, 3)),
        NUMBER,
    ),
    "a type": (lambda x: x.astype(jnp.int32), lambda x: x.astype(jnp.int64), NUMBER),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_programs_that_differ_have_digests_that_differ(what):
    one, other, shape = DIFFERENT[what]
    assert program(one, shape) != program(other, shape)
    assert program(one, shape) == program(one, shape)


def test_programs_are_known_by_what_they_compute():
    first, second = (types.FunctionType((lambda x: 3 * x).__code__, {}) for _ in range(2))
    assert program(first) == program(second) == program(lambda anything: 3 * anything)
    assert program(first, THREE) != program(first)
    assert program(first) != program(first, jax.ShapeDtypeStruct((), jnp.float32))


def with_zeros(x):
    function = jax.custom_jvp(lambda x: 2 * x)
    function.defjvp(lambda x, dx: (2 * x[0], 2 * dx[0]), symbolic_zeros=True)
    return function(x)


def with_batches(x):
    function = jax.custom_batching.custom_vmap(lambda x: 2 * x)
    function.def_vmap(lambda size, batched, x: (3 * x, True))
    return function(x)


REFUSED = {
    "a callback": lambda x: jax.pure_callback(np.sin, NUMBER, x),
    "a print": lambda x: (jax.debug.print("{}", x), x)[1],
    "a batching rule": with_batches,
    "a rule that may look at more": with_zeros,
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_described_in_full_is_refused(what):
    with pytest.raises(IndescribableError):
        program(REFUSED[what])


class Own(eqx.Module):
    x: Any = 1.0


@pytest.mark.parametrize("thing", [Own(), lambda: 0, object(), {1, 2}, Own, np.random.default_rng])
def test_what_users_write_has_no_digest_of_its_own(thing):
    with pytest.raises(IndescribableError):
        digest(thing)


def test_nor_has_what_calls_itself_one_of_ours():
    scope = {"__name__": "hybridjax.models.hoppers", "eqx": eqx}
    exec("class VerticalHopper(eqx.Module): pass", scope)
    with pytest.raises(IndescribableError):
        digest(scope["VerticalHopper"]())
    assert digest(hj.models.VerticalHopper()) == digest(hj.models.VerticalHopper(k=9))


def test_arguments_differ_by_value_and_type_and_arrays_by_shape():
    things = [1, 1.0, True, "1", b"1", None, (1,), [1], {1: 1}, ((1,), 1), (1, (1,)), (1, 1, ()),
              jnp.ones(1), jnp.ones((1, 1)), jnp.ones(1, int), 1j, ("ab", "c"), ("a", "bc"),
              hj.Guess("a", (1.0,)), hj.Guess("b", (1.0,))]  # fmt: skip
    assert len({digest(x) for x in things}) == len(things)
    assert digest(jnp.ones(3)) == digest(jnp.zeros(3)) == digest(np.zeros(3))


def test_surroundings(monkeypatch):
    seen = [fingerprint.surroundings()]
    assert fingerprint.surroundings() == seen[0]

    def note():
        seen.append(fingerprint.surroundings())

    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        note()
    with jax.default_matmul_precision("highest"):
        note()
    with single_precision():
        note()
    with monkeypatch.context() as patch:
        patch.setattr(fingerprint.rewrite, "_enabled", False)
        note()
    for name, value in (("_processor", lambda: ["another"]), ("__file__", __file__)):
        with monkeypatch.context() as patch:
            patch.setattr(fingerprint, name, value)
            fingerprint._installed.cache_clear()
            note()
        fingerprint._installed.cache_clear()
    assert len(set(seen)) == len(seen)
    assert fingerprint.surroundings() == seen[0]
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    assert fingerprint.surroundings() == seen[0]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


SCRIPT = """
import hybridjax as hj
hj.enable_x64()
from hybridjax._core.compilation.fingerprint import digest, surroundings
from hybridjax.engine.closed import close

class Flight(hj.Chart):
    states = ("y", "v")

    def field(self, t, q, u):
        return q[1], u[0] - {g}

class Ball(hj.HybridSystem):
    e: hj.Parameter = hj.parameter({e})

    def charts(self):
        return {{"flight": Flight()}}

    def transitions(self):
        bounce = lambda t, q, u: (q[0], -self.e * q[1])
        return [hj.Transition("b", "flight", "flight", lambda t, q, u: q[0], reset=bounce)]

found = digest(close(Ball(), ("y",), None), surroundings())
"""


def test_a_class_that_is_defined_anew_is_another_one_only_if_it_computes_something_else():
    def found(**numbers):
        scope = {"__name__": "__main__"}
        exec(SCRIPT.format(**numbers), scope)
        return scope["found"]

    here = found(g=9.81, e=0.5)
    assert here == found(g=9.81, e=0.5)
    assert here == found(g=9.81, e=0.6)  # a parameter is an argument
    assert here != found(g=9.82, e=0.5)
    script = SCRIPT.format(g=9.81, e=0.5) + "print(found)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == here
