"""Guards that turn many times while the states hardly change: step control must look at them."""

import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj


class Straight(hj.Chart):
    states = ("x",)

    def field(self, t, q, u):
        return (1.0,)


class Sine(hj.HybridSystem):
    rate: hj.Parameter = hj.parameter(10.0)

    def charts(self):
        return {"line": Straight()}

    def transitions(self):
        return [hj.Transition("fall", "line", "line", lambda t, q, u: jnp.sin(self.rate * q[0]))]


@pytest.mark.parametrize("rate", [10.0, 61.0])
def test_every_turn_of_a_fast_guard_is_seen(rate):
    run = hj.simulate(Sine(rate=rate), "line", (0.1,), 9.9)
    k = np.arange(1000)
    falls = (2 * k + 1) * np.pi / rate - 0.1
    falls = falls[(falls > 0) & (falls < 9.9)]
    np.testing.assert_allclose([event.time for event in run.events], falls, atol=1e-12)
