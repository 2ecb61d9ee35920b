"""Rewritten programs of users' functions give what they gave before.

To try an older or a newer JAX, install it and run this file alone:
`python -m pytest -o addopts= tests/_core/test_rewrite.py`.
"""

import functools as ft
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core.vector_math.rewrite import vectorized


hj.enable_x64()


def same(function):
    return function


def left(function, *xs):
    """Names of the primitives of JAX that ours should have replaced."""
    program = str(jax.make_jaxpr(function)(*xs))
    return set(re.findall(r"= (sin|cos|tan|atan2?|asin|acos)[ \[]", program))


def looped(x, y):
    z = jax.lax.fori_loop(0, 3, lambda _, z: jnp.sin(z) + y, x)
    return jax.lax.while_loop(
        lambda z: jnp.cos(z) > 2, lambda z: jax.jit(jnp.tan)(z) + 1, z
    )


def test_vectorized_replaces_everything():
    assert left(looped, 0.3, 0.7)
    assert not left(vectorized(looped), 0.3, 0.7)
    found = vectorized(looped)(0.3, 0.7)
    assert_allclose(found, looped(0.3, 0.7), rtol=1e-13)


def test_other_types_and_requested_accuracies_stay():
    operations = left(vectorized(jnp.sin), jnp.float16(1))
    assert operations == {"sin"}
    exact = ft.partial(jax.lax.sin, accuracy=jax.lax.AccuracyMode.HIGHEST)
    assert left(vectorized(exact), 1.0) == {"sin"}


def test_types_are_kept():
    def function(x, n):
        return (
            jnp.sin(x),
            jnp.arctan2(x, 1.0),
            x**2,
            n + 1,
            n > 0,
            2.0,
            x.astype(jnp.float32),
            None,
        )

    for x in (0.5, jnp.float64(0.5), jnp.ones(3), jnp.ones((2, 0))):
        x = jnp.asarray(x)
        ours = jax.eval_shape(vectorized(function), x, 3)
        truth = jax.eval_shape(function, x, 3)
        assert ours == truth
        for found, expected in zip(
            jax.tree.leaves(ours), jax.tree.leaves(truth), strict=True
        ):
            assert found.weak_type == expected.weak_type
    for v in vectorized(lambda x: (x, 2.0, x + 1))(0.5):
        assert isinstance(v, jax.Array)


def test_closures_over_tracers():
    def response(f, a, x):
        return jax.vmap(f(lambda x: jnp.sin(a * x) * a**2))(x).sum()

    x = jnp.linspace(0, 1, 5)
    for transform, a in (
        (jax.hessian, 0.7),
        (lambda f: jax.vmap(jax.grad(f)), [0.7, 1.3]),
    ):
        ours, truth = (
            jax.jit(transform(lambda a, f=f: response(f, a, x)))(jnp.asarray(a))
            for f in (vectorized, same)
        )
        assert_allclose(ours, truth, rtol=1e-13)


def test_every_call_sees_the_present_parameters_and_traces_once():
    parameters = {"a": 1.0}
    traces = []

    @vectorized
    def function(x):
        traces.append(x)
        return parameters["a"] * jnp.sin(x)

    first = function(0.5)
    parameters["a"] = 2.0
    assert function(0.5) == 2 * first
    assert len(traces) == 2


def test_off_away_from_cpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    operations = left(vectorized(looped), 0.3, 0.7)
    assert operations == left(looped, 0.3, 0.7)


def test_vectors_of_several_functions_are_put_together_row_by_row():
    def field(t, q):
        a = jnp.sin(t) + q[0]
        b = jnp.cos(2 * t) * q[1]
        return jnp.stack([a, q[0], a * b, jnp.tan(b)]), jnp.concatenate(
            [q, jnp.sin(t)[None]]
        )

    t = jnp.asarray(0.7)
    q = jnp.array([0.3, -1.2])
    jaxpr = jax.make_jaxpr(vectorized(field))(t, q)
    program = str(jaxpr)
    assert "stack[" not in program.replace("_stack[", "")
    assert program.count("concatenate[") == 1  # with one function behind it
    for new, old in zip(vectorized(field)(t, q), field(t, q), strict=True):
        assert_allclose(new, old, rtol=1e-15)
    slope = jax.jacfwd(vectorized(field))
    new = slope(t, q)[0]
    old = jax.jacfwd(field)(t, q)[0]
    assert_allclose(new, old, rtol=1e-14)


ZOO = {
    "sin": lambda x, y: jnp.sin(x),
    "tan": lambda x, y: jnp.tan(0.4 * x),
    "arcsin": lambda x, y: jnp.arcsin(x / 5),
    "arccos": lambda x, y: jnp.arccos(x / 5),
    "arctan": lambda x, y: jnp.arctan(x),
    "arctan2": jnp.arctan2,
    "angle": lambda x, y: jnp.angle(x + 1j * y),
    "where": lambda x, y: jnp.where(x > 0, jnp.sin(x), jnp.cos(y)),
    "switch": lambda x, y: jax.lax.switch(1, [jnp.sin, jnp.cos, jnp.arctan], x),
    "cond": lambda x, y: jax.lax.cond(
        x > y, lambda: jnp.sin(x), lambda: y * jnp.cos(x)
    ),
    "scan": lambda x, y: jax.lax.scan(
        lambda c, k: (jnp.sin(k * c), c), x, jnp.arange(3)
    )[0],
    "gradient": lambda x, y: jax.grad(lambda x: jnp.sin(x) * jnp.arctan(x * y))(x),
    "checkpoint": lambda x, y: jax.checkpoint(lambda x: jnp.sin(jnp.cos(x)))(x),
    "custom jvp": lambda x, y: jax.nn.silu(x) * jnp.sin(y),
    "interp": lambda x, y: jnp.interp(
        jnp.sin(x), jnp.linspace(-1, 1, 5), jnp.arange(5.0)
    ),
    "matrix": lambda x, y: rotation(x) @ jnp.stack([y, 1.0 * y]),
    "concatenate": lambda x, y: jnp.concatenate(
        [jnp.sin(x)[None], jnp.cos(y)[None], y[None]]
    ),
    "integers": lambda x, y: jnp.sin(jnp.arange(4)) * x,
    "nothing": lambda x, y: {"exp": jnp.exp(x) * jnp.tanh(y)},
}


def rotation(angle):
    s = jnp.sin(angle)
    c = jnp.cos(angle)
    return jnp.array([[c, -s], [s, c]])


@pytest.mark.slow
def test_a_zoo_of_functions_gives_what_it_gave_before():
    """Values and derivatives of both orders of nesting, over 16 lanes."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-2, 2, (2, 16))

    def evaluated(f):
        values = jax.vmap(f)(x, y)
        rates = jax.vmap(lambda x, y: jax.jvp(f, (x, y), (y, x))[1])(x, y)
        slopes = jax.vmap(jax.jacrev(lambda x: f(x, 0.5 * x)))(x)
        return values, rates, slopes

    ours, truth = jax.jit(
        lambda: [
            {k: evaluated(wrap(f)) for k, f in ZOO.items()}
            for wrap in (vectorized, same)
        ]
    )()
    tolerance = 2e-14
    pairs = zip(
        jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(truth), strict=True
    )
    for (path, a), b in pairs:
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        largest = max(1.0, np.abs(b).max())
        atol = tolerance * largest
        assert_allclose(a, b, rtol=tolerance, atol=atol, err_msg=str(path))
