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
    network = eqx.nn.MLP(2, 1, 4, 1, activation=jnp.tanh, key=jax.random.key(1))
    coefficients = jnp.array([-0.1, 0.2, 0.3])

    def learned(t, q, u):
        def horner(value, c):
            return (value * q[0] + c, None)

        value, _ = jax.lax.scan(horner, 0.0 * q[0], coefficients)
        return (-q[0] + network(jnp.stack([q[0], jnp.cos(t)]))[0] + value + u[0],)

    system = toy({"a": Field(("x",), learned)}, period=2 * np.pi)
    cycle = hj.find_limit_cycle(system, hj.Guess("a", (0.3,)))
    (W, a), (V, b) = (
        (np.asarray(x.weight), np.asarray(x.bias)) for x in network.layers
    )

    def field(t, z):
        x = z[0]
        hidden = np.tanh(W @ [x, np.cos(t)] + a)
        slope = V @ ((1 - hidden**2) * W[:, 0]) - 1 - 0.2 * x + 0.2
        return [-x + (V @ hidden + b)[0] - 0.1 * x**2 + 0.2 * x + 0.3, slope[0]]

    start = [cycle.state["x"], 0.0]
    there = solve_ivp(field, (0, 2 * np.pi), start, "DOP853", rtol=1e-12, atol=1e-12).y[
        :, -1
    ]
    assert_allclose(there[0], start[0], rtol=1e-10)
    assert_allclose(cycle.multipliers, [np.exp(there[1])], rtol=1e-9)
