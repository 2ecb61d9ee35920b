"""A loop whose derivatives run along agrees with JAX's own derivatives of the loop."""

import jax
import jax.numpy as jnp
import numpy as np

from hybridjax._core.loops import loop, pushed


def step(constants, k, x, steps):
    wave = jnp.sin(constants["a"] * x)
    drift = k * x**2 / 10
    return wave + drift, steps + 1


def step_along(constants, by_constants, k, x, columns, steps):
    def one(constants, x, steps):
        return step(constants, k, x, steps)

    return pushed(one, constants, by_constants, x, columns, steps)


def with_own_derivatives(a, x):
    start = jnp.asarray(0.0)
    end, steps = loop(step, step_along, {"a": a}, x, start, 7)
    return end


def with_derivatives_of_jax(a, x):
    def run(k, x):
        return step({"a": a}, k, x, 0)[0]

    return jax.lax.fori_loop(0, 7, run, x)


def test_first_and_second_derivatives_are_those_of_jax():
    a = jnp.asarray(1.3)
    x = jnp.array([0.2, -0.4])
    for order in (jax.jacfwd, lambda f, n: jax.jacfwd(jax.jacfwd(f, n), n)):
        for argument in (0, 1):
            found = jax.jit(order(with_own_derivatives, argument))(a, x)
            expected = order(with_derivatives_of_jax, argument)(a, x)
            np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_lanes_have_derivatives_of_their_own():
    a = jnp.array([0.7, 1.3, 2.0])
    x = jnp.array([0.2, -0.4])
    slope = jax.jacfwd(with_own_derivatives)
    slopes = jax.vmap(slope, in_axes=(0, None))(a, x)
    expected = [jax.jacfwd(with_derivatives_of_jax)(each, x) for each in a]
    np.testing.assert_allclose(slopes, expected, rtol=1e-13)
