"""What users write in fields: networks, loops, and matrices that become singular on the way."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import hybridjax as hj

from ..toys import Field, toy


def test_a_network_and_a_scan():
    """x' = -x + network(x, cos t) + a polynomial in x, computed by a scan; against the same in
    NumPy, integrated by scipy; the multiplier by the divergence."""
    key = jax.random.key(1)
    network = eqx.nn.MLP(2, 1, 4, 1, activation=jnp.tanh, key=key)
    coefficients = jnp.array([-0.1, 0.2, 0.3])

    def learned(t, q, u):
        x = q[0]

        def horner(value, coefficient):
            return (value * x + coefficient, None)

        polynomial, _ = jax.lax.scan(horner, 0.0 * x, coefficients)
        state = jnp.stack([x, jnp.cos(t)])
        output = network(state)[0]
        return (-x + output + polynomial + u[0],)

    charts = {"a": Field(("x",), learned)}
    system = toy(charts, period=2 * np.pi)
    cycle = hj.find_limit_cycle(system, hj.Guess("a", (0.3,)))

    first, second = network.layers
    W = np.asarray(first.weight)
    V = np.asarray(second.weight)

    def rates(t, state):
        """Of x, and of the logarithm of a deviation."""
        x = state[0]
        before = W @ [x, np.cos(t)]
        hidden = np.tanh(before + np.asarray(first.bias))
        output = V @ hidden + np.asarray(second.bias)
        slope_of_tanh = 1 - hidden**2
        by_hidden = slope_of_tanh * W[:, 0]
        slope = V @ by_hidden
        square = -0.1 * x**2
        polynomial = square + 0.2 * x + 0.3
        rate = -x + output[0] + polynomial
        by_x = -1 + slope[0] - 0.2 * x + 0.2
        return [rate, by_x]

    start = cycle.state["x"]
    path = solve_ivp(
        rates, (0, 2 * np.pi), [start, 0.0], method="DOP853", rtol=1e-12, atol=1e-12
    )
    end, growth = path.y[:, -1]
    assert_allclose(end, start, rtol=1e-10)
    assert_allclose(cycle.multipliers, [np.exp(growth)], rtol=1e-9)
