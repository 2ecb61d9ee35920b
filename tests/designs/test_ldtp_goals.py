"""Goals of whoever fits the matrices of the model itself."""

import numpy as np
import pytest

import hybridjax as hj

from .conftest import expected_htf
from .two_inputs import NOISE, model as model, usual as usual


@pytest.mark.parametrize("harmonics", [None, (-1, 0, 1)])
def test_standard_errors_are_the_bound_of_the_ldtp(model, usual, harmonics):
    """That of `ldtp_bound`, which sums information up without leaving parts of lines out."""
    assert model.outputs == tuple(NOISE)
    goal = hj.designs.Multipliers(estimator="fit_ldtp", harmonics=harmonics)
    plan = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    assert plan.certificate < 1.03
    bound = hj.identify.ldtp_bound(model, expected_htf(model, plan.usual, NOISE, harmonics))
    np.testing.assert_allclose(np.sum(plan.usual_variances), _total(bound), rtol=1e-5)
    free = hj.optimal_design(
        model, usual, goal=hj.designs.Multipliers(harmonics=(-1, 0, 1)), noise=NOISE
    )
    assert free.usual_criterion > plan.usual_criterion


def _total(bound):
    """The sum of the variances of real multipliers, or of real and imaginary parts, pairs once."""
    return sum(
        np.trace(c) for z, c in zip(bound.multipliers, bound.multiplier_covariances, strict=True)
        if z.imag >= 0
    )  # fmt: skip


def test_no_other_design_is_better_than_the_certificate_allows(model, usual):
    goal = hj.designs.Multipliers(estimator="fit_ldtp")
    limit = {"u0": 0.1, "u1": 0.1}
    plan = hj.optimal_design(model, usual, goal=goal, noise=NOISE, limit=limit)
    rng = np.random.default_rng(0)
    for _ in range(5):
        other = hj.multisine(
            6,
            32,
            band=(0, 3),
            inputs=model.inputs,
            amplitude=lambda f: rng.exponential(size=f.shape),
        ).scaled(0.1)
        bound = hj.identify.ldtp_bound(model, expected_htf(model, other, NOISE))
        assert _total(bound) > plan.criterion / plan.certificate


def test_only_outputs_that_are_measured_count(model, usual):
    goal = hj.designs.Multipliers(estimator="fit_ldtp")
    both = hj.optimal_design(model, usual, goal=goal, noise=NOISE)
    one = hj.optimal_design(model, usual, goal=goal, noise={"y1": 0.02})
    assert one.usual_criterion > both.usual_criterion


def test_multipliers_are_counted_as_the_model_has_them():
    """Of three, the first of which no input reaches."""
    A, one = np.diag([0.9, 0.6, 0.3]), np.array([0.0, 1.0, 1.0])
    model = hj.LDTP(np.stack([A, np.eye(3)]), np.stack([one, one])[..., None], np.ones((2, 1, 3)))
    usual = hj.multisine(2, 32, band=(0, 1))

    def plan(which):
        goal = hj.designs.Multipliers(which, estimator="fit_ldtp")
        return hj.optimal_design(model, usual, goal=goal, noise={"y": 0.01})

    assert plan(1).names == ("0.6",) and plan(2).names == ("0.3",)
    with pytest.raises(hj.DefinitionError, match=r"no input reaches.*the multiplier 0\.9"):
        plan(0)


def test_a_model_without_matrices_is_refused(model, usual):
    fit = hj.fit_multipliers(expected_htf(model, usual, NOISE, (-1, 0, 1)), 2, check=False)
    with pytest.raises(hj.DefinitionError, match="needs a model with matrices"):
        hj.optimal_design(fit, usual, goal=hj.designs.Multipliers(estimator="fit_ldtp"))
