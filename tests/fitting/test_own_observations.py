"""Data of other kinds: what a user's subclass of `AbstractObservation` is promised."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import hybridjax as hj


TRUTH = hj.models.PaddleJuggler()


class MultipliersBetweenSections(hj.AbstractObservation):
    """Coefficients of the characteristic polynomial, from a linearization."""

    seen: Array
    weighted: Array

    def residuals(self, cycle):
        model = hj.linearize(cycle, hj.ClockPhase(2))
        return model.characteristic_polynomial()[1:3] - self.seen


@pytest.fixture(scope="module")
def juggling():
    return hj.find_limit_cycle(TRUTH)


@pytest.mark.slow
def test_a_parameter_comes_back_from_multipliers(juggling):
    exact = TRUTH.exact()[-1]
    data = MultipliersBetweenSections(jnp.poly(exact)[1:].real, jnp.asarray(False))
    wrong = eqx.tree_at(lambda s: s.restitution, TRUTH, 0.97 * TRUTH.restitution)
    fit = hj.fit_model(wrong, data, "restitution", guess=juggling)
    assert fit.result == hj.Result.OK and fit.identifiability.complete
    np.testing.assert_allclose(fit.values, TRUTH.restitution, rtol=1e-9)
    np.testing.assert_allclose(np.poly(fit.cycle.multipliers), np.poly(exact), rtol=1e-9)
