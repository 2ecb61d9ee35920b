"""Accuracy against long doubles and exact fractions, derivatives, and substitution in programs."""

import functools as ft
import math
import re
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from hybridjax._core import trigonometry
from hybridjax._core.trigonometry import vectorized


BOUNDS = {"sin": 2, "cos": 2, "tan": 4, "arctan": 2, "arcsin": 4, "arccos": 4}
NAMES = list(BOUNDS)
PI = Fraction("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899")
RNG = np.random.default_rng(0)
ANY = st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)


@ft.cache
def compiled(name):
    return jax.jit(getattr(trigonometry, name))


def ulps(value, truth):
    """Distance in units in the last place of the truth."""
    unit = np.spacing(np.abs(np.asarray(truth, float)))
    return np.asarray(np.abs(np.asarray(value).astype(np.longdouble) - truth) / unit, float)


def arguments(name):
    if name in ("arcsin", "arccos"):
        return np.concatenate([RNG.uniform(-1, 1, 20000), 1 - np.exp(RNG.uniform(-36, 0, 2000))])
    spread = np.exp(RNG.uniform(-700, math.log(1e6), 20000)) * RNG.choice([-1, 1], 20000)
    near = np.arange(-20000, 20000, 7) * (math.pi / 4)
    return np.concatenate([spread, RNG.uniform(-10, 10, 20000), RNG.uniform(-1e6, 1e6, 9000), near])


@pytest.mark.parametrize("name", NAMES)
def test_accuracy(name):
    x = arguments(name)
    truth = getattr(np, name)(x.astype(np.longdouble))
    assert np.max(ulps(compiled(name)(x), truth)) <= BOUNDS[name]


def single(name):
    if name == "arctan2":
        return RNG.normal(size=(2, 40000)) * np.exp(RNG.uniform(-20, 20, (2, 40000)))
    x = arguments(name)
    return x[(np.abs(x) < 1.2e4) & (np.abs(x) > 1e-30)][None]


@pytest.mark.parametrize("name", [*NAMES, "arctan2"])
def test_accuracy_in_single_precision(name):
    xs = single(name).astype(np.float32)
    truth = getattr(np, name)(*xs.astype(float))
    value = compiled(name)(*xs)
    assert value.dtype == np.float32
    error = np.abs(np.asarray(value, float) - truth) / np.spacing(np.abs(truth.astype(np.float32)))
    assert np.max(error) <= (BOUNDS | {"arctan": 3, "arctan2": 3})[name]


def test_accuracy_of_arctan2():
    y, x = RNG.normal(size=(2, 40000)) * np.exp(RNG.uniform(-20, 20, (2, 40000)))
    truth = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
    assert np.max(ulps(compiled("arctan2")(y, x), truth)) <= 3


def test_hardest_arguments():
    """Near multiples of pi/2, where sin or cos is x - k pi/2: the closest doubles, and others."""
    k = np.concatenate([29 * 2 ** np.arange(7), np.arange(1, 640000, 997)])
    x = np.array([float(int(i) * PI / 2) for i in k])
    truth = np.array([float(Fraction(v) - int(i) * PI / 2) for v, i in zip(x, k, strict=True)])
    sign = np.array([1, -1, -1, 1])[k % 4]  # sin(k pi/2 + r) = r, cos r, -r, ..., and so on
    small = np.where(k % 2 == 0, compiled("sin")(x), compiled("cos")(x))
    np.testing.assert_array_less(ulps(small * sign, truth), 2)
    assert np.min(np.abs(truth)) < 1e-18


def test_huge_arguments_are_those_of_a_neighbour():
    x = np.exp(RNG.uniform(math.log(1e6), 53 * math.log(2), 20000))
    for name in ("sin", "cos"):
        truth = getattr(np, name)(x.astype(np.longdouble))
        error = np.abs(np.asarray(compiled(name)(x)) - truth.astype(float))
        assert np.all(error <= np.where(x < 2.0**45, 1, 2) * np.spacing(x) + 1e-15)


SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e300, -1e300, 1e-300, 5e-324])


@pytest.mark.parametrize("name", NAMES)
def test_special_values(name):
    x = SPECIAL[np.abs(SPECIAL) != 1e300] if name in ("sin", "cos", "tan") else SPECIAL
    with np.errstate(invalid="ignore"):
        truth = getattr(np, name)(x)
    value = np.asarray(compiled(name)(x))
    np.testing.assert_allclose(value, truth, rtol=1e-15, atol=1e-307)
    finite = np.isfinite(truth)
    np.testing.assert_array_equal(np.signbit(value)[finite], np.signbit(truth)[finite])


def test_special_values_of_arctan2():
    y, x = np.meshgrid(SPECIAL[:-1], SPECIAL[:-1])
    value, truth = np.asarray(compiled("arctan2")(y, x)), np.arctan2(y, x)
    np.testing.assert_allclose(value, truth, rtol=1e-15)
    number = ~np.isnan(truth)
    np.testing.assert_array_equal(np.signbit(value)[number], np.signbit(truth)[number])


@given(ANY)
def test_sin_and_cos_lie_on_the_circle(x):
    s, c = float(compiled("sin")(x)), float(compiled("cos")(x))
    assert abs(s) <= 1 and abs(c) <= 1 and abs(s * s + c * c - 1) < 1e-15
    assert float(compiled("sin")(-x)) == -s and float(compiled("cos")(-x)) == c


@given(ANY, ANY)
def test_arctan2_agrees_with_the_standard_library(y, x):
    assert math.isclose(compiled("arctan2")(y, x), math.atan2(y, x), rel_tol=1e-15, abs_tol=1e-306)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives(name):
    ours, plain = getattr(trigonometry, name), getattr(jnp, name)
    x = jnp.linspace(-0.9, 0.9, 8)
    for derivative in (
        lambda f: jax.vmap(jax.grad(f)),
        lambda f: jax.jacfwd(jax.jacfwd(f)),
        lambda f: jax.hessian(lambda x: (f(x) ** 2).sum()),
    ):
        value, truth = jax.jit(lambda x, d=derivative: (d(ours)(x), d(plain)(x)))(x)
        np.testing.assert_allclose(value, truth, rtol=1e-12, atol=1e-13)


def test_derivatives_of_arctan2():
    points = jnp.array([[0.3, -0.7], [2.0, 0.1], [-1.0, 1.0]])
    for derivative in (jax.grad, jax.hessian, lambda f, n: jax.jacfwd(jax.jacrev(f, n), n)):
        ours, plain = (
            jax.jit(jax.vmap(derivative(f, (0, 1))))(*points.T)
            for f in (trigonometry.arctan2, jnp.arctan2)
        )
        np.testing.assert_allclose(np.ravel(ours), np.ravel(plain), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("x", [1, np.float16(0.5), jnp.float16(0.5), 0.5 + 1j], ids=repr)
def test_other_types_are_left_to_jnp(x):
    value, truth = trigonometry.sin(x), jnp.sin(x)
    assert value == truth and value.dtype == truth.dtype


def plain(x, y):
    return jnp.stack([jnp.sin(x) * y**3, jnp.arctan2(y, x) + jnp.cos(x), jnp.exp(x) * x**-2])


def several(x, y):
    return {"sin": jnp.sin(x), "rest": (jnp.arcsin(y / 9), jnp.arctan(y) / jnp.arccos(x / 9))}


@jax.jit
def inner(x):
    return jnp.tan(x) + jax.jit(jnp.cos)(x)


def jitted(x, y):
    return inner(x) * inner(y) * inner(x)


def branches(x, y):
    return jax.lax.cond(x > y, lambda: jnp.sin(x), lambda: y * jnp.cos(x))


def looped(x, y):
    z = jax.lax.fori_loop(0, 3, lambda _, z: jnp.sin(z) + y, x)
    return jax.lax.while_loop(lambda z: jnp.cos(z) > 2, lambda z: z + 1, z)


def no_trigonometry(x, y):
    return x * y + jnp.sqrt(y)


FUNCTIONS = [plain, several, jitted, branches, looped, no_trigonometry]
TRANSFORMATIONS = {
    "jit": lambda f: f,
    "vmap": jax.vmap,
    "vmap of jit": lambda f: jax.vmap(jax.jit(f), in_axes=-1, out_axes=-1),
    "jvp": lambda f: lambda x, y: jax.jvp(f, (x, y), (y, x)),
    "vmap of jvp": lambda f: jax.vmap(lambda x, y: jax.jvp(f, (x, y), (y, x))),
    "vjp": lambda f: jax.jacrev(f, (0, 1)),
    "second": lambda f: jax.vmap(jax.jacfwd(jax.jacrev(f, (0, 1)), (0, 1))),
    "checkpoint": lambda f: jax.jacrev(jax.checkpoint(f)),
}


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("transformation", TRANSFORMATIONS)
def test_vectorised_agrees_under_transformations(function, transformation):
    if function is looped and transformation in ("vjp", "second", "checkpoint"):
        pytest.skip("JAX does not reverse while_loop")
    transform = TRANSFORMATIONS[transformation]
    x, y = jnp.array([0.3, 1.1, -2.0]), jnp.array([0.7, 2.0, 0.4])
    if "vmap" not in transformation and transformation != "second":
        x, y = x[0], y[0]
    both = jax.jit(lambda *xs: [transform(f)(*xs) for f in (vectorized(function), function)])
    ours, truth = both(x, y)
    assert jax.tree.structure(ours) == jax.tree.structure(truth)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(truth), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)


def left(function, *xs):
    """Names of the primitives of JAX that ours should have replaced."""
    program = str(jax.make_jaxpr(function)(*xs))
    return set(re.findall(r"= (sin|cos|tan|atan2?|asin|acos)[ \[]", program))


def test_vectorised_works_outside_of_jit():
    np.testing.assert_allclose(vectorized(plain)(0.3, 0.7), plain(0.3, 0.7), rtol=1e-15)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_vectorised_replaces_everything(function):
    assert bool(left(function, 0.3, 0.7)) == (function is not no_trigonometry)
    assert not left(vectorized(function), 0.3, 0.7)


def test_other_types_and_requested_accuracies_stay():
    assert left(vectorized(jnp.sin), jnp.float16(1)) == {"sin"}
    exact = ft.partial(jax.lax.sin, accuracy=jax.lax.AccuracyMode.HIGHEST)
    assert left(vectorized(exact), 1.0) == {"sin"}


def test_functions_with_their_own_derivative_rules_stay():
    curvature = jax.jit(jax.hessian(vectorized(jnp.sinc)))(0.0)
    np.testing.assert_allclose(curvature, -(np.pi**2) / 3)


def test_types_are_kept():
    def function(x, n):
        return jnp.sin(x), jnp.arctan2(x, 1.0), x**2, n + 1, n > 0, 2.0, x.astype(jnp.float32), None

    for x in (0.5, jnp.float64(0.5), jnp.ones(3), jnp.ones((2, 0))):
        x = jnp.asarray(x)
        ours, truth = (jax.eval_shape(f, x, 3) for f in (vectorized(function), function))
        assert ours == truth
        assert [v.weak_type for v in jax.tree.leaves(ours)] == [
            v.weak_type for v in jax.tree.leaves(truth)
        ]
    assert all(isinstance(v, jax.Array) for v in vectorized(lambda x: (x, 2.0, x + 1))(0.5))


def test_closures_over_tracers():
    def response(f, a, x):
        return jax.vmap(f(lambda x: jnp.sin(a * x) * a**2))(x).sum()

    x = jnp.linspace(0, 1, 5)
    for transform in (jax.grad, jax.hessian, lambda f: jax.vmap(jax.grad(f))):
        a = jnp.array([0.7, 1.3]) if transform not in (jax.grad, jax.hessian) else 0.7
        ours, truth = (
            jax.jit(transform(lambda a, f=f: response(f, a, x)))(a) for f in (vectorized, _same)
        )
        np.testing.assert_allclose(ours, truth, rtol=1e-13)


def _same(function):
    return function


def test_every_call_sees_the_present_parameters_and_traces_once():
    parameters, traces = {"a": 1.0}, []

    @vectorized
    def function(x):
        traces.append(x)
        return parameters["a"] * jnp.sin(x)

    first = function(0.5)
    parameters["a"] = 2.0
    assert function(0.5) == 2 * first and len(traces) == 2


def test_errors_of_the_function_come_through():
    def wrong(x):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        vectorized(wrong)(1.0)


def test_off_away_from_cpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert left(vectorized(plain), 0.3, 0.7) == left(plain, 0.3, 0.7)


def test_vectors_of_several_functions_are_put_together_row_by_row():
    def field(t, q):
        a, b = jnp.sin(t) + q[0], jnp.cos(2 * t) * q[1]
        return jnp.stack([a, q[0], a * b, jnp.tan(b)]), jnp.concatenate([q, jnp.sin(t)[None]])

    t, q = jnp.asarray(0.7), jnp.array([0.3, -1.2])
    program = str(jax.make_jaxpr(vectorized(field))(t, q))
    assert "stack[" not in program.replace("_stack[", "")
    assert program.count("concatenate[") == 1  # with one function behind it
    for new, old in zip(vectorized(field)(t, q), field(t, q), strict=True):
        np.testing.assert_allclose(new, old, rtol=1e-15)
    new, old = (jax.jacfwd(f)(t, q)[0] for f in (vectorized(field), field))
    np.testing.assert_allclose(new, old, rtol=1e-14)
