"""Powers within limits, against closed forms and another optimizer."""

import numpy as np
import pytest
from scipy.optimize import minimize

import hybridjax as hj
from hybridjax.designs.allocation import allocate, certify
from hybridjax.designs.candidates import Candidates
from hybridjax.designs.limits.limits import PowerLimits
from hybridjax.designs.questions.question import Question
from hybridjax.designs.questions.sensitivities import DirectSensitivities
from hybridjax.experiments.design.partition import line_class


def question(slopes, criterion="A"):
    """Unknowns with these derivatives (d, K), one row for each cosine."""
    d, K = slopes.shape
    names = tuple(f"x{k}" for k in range(d))
    return Question(DirectSensitivities(np.arange(K), slopes), np.eye(d), names, names, criterion)


def limits(cost):
    cost = np.atleast_2d(cost)
    return PowerLimits(tuple("abc"[: len(cost)]), cost, np.zeros((0, cost.shape[1], cost.shape[1])))


@pytest.mark.parametrize("criterion", ["A", "D"])
def test_unknowns_that_are_measured_one_by_one(criterion):
    """The sum of 1 / (s^2 p) within w p = 1 is smallest for p ~ 1 / (s sqrt(w)); the product for
    equal shares."""
    s, w = np.array([1.0, 2.0, 5.0, 0.3]), np.array([1.0, 3.0, 0.5, 1.0])
    found = allocate(question(np.diag(s), criterion), limits(w), np.ones(4), 300)
    best = 1 / (s * np.sqrt(w)) if criterion == "A" else 1 / w
    np.testing.assert_allclose(found.power, best / (w @ best), rtol=0.05)
    assert 1 - 1e-9 < found.certificate.excess < 1.021
    np.testing.assert_allclose(found.certificate.relative, 1, atol=0.03)


@pytest.mark.filterwarnings("ignore:Values in x were outside bounds")  # SLSQP of older SciPy
@pytest.mark.parametrize("criterion", ["A", "D"])
@pytest.mark.parametrize("largest", [np.inf, 0.12])
def test_several_limits(criterion, largest):
    """Against sequential quadratic programming, which knows nothing of majorization."""
    rng = np.random.default_rng(3)
    slopes, cost = rng.normal(size=(3, 14)), rng.uniform(0.2, 2, (3, 14))

    def value(p):
        covariance = np.linalg.inv(slopes * p @ slopes.T)
        return np.trace(covariance) if criterion == "A" else np.linalg.det(covariance) ** (1 / 3)

    within = {"type": "ineq", "fun": lambda p: 1 - cost @ p}
    start = np.full(14, 0.5 / cost.sum(axis=1).max())
    other = minimize(
        value, start, method="SLSQP", bounds=[(1e-9, min(largest, 9))] * 14, constraints=[within],
        options={"maxiter": 500, "ftol": 1e-10},
    )  # fmt: skip
    every = np.concatenate([cost, np.eye(14) / largest]) if np.isfinite(largest) else cost
    found = allocate(question(slopes, criterion), limits(every), np.ones(14), 2000)
    assert limits(cost).use(found.power).max() < 1 + 1e-9
    assert found.power.max() <= largest * (1 + 1e-9)
    assert found.certificate.excess < 1.021
    assert other.fun * (1 - 1e-6) < found.answer.criterion < other.fun * found.certificate.excess
    assert value(found.power) == pytest.approx(found.answer.criterion)


def test_amplitudes_leave_place_for_one_cosine_of_each_class():
    """In every experiment. Where all are as large as they may be, nothing is left."""
    largest = [0.1, 0.2]
    design = hj.Design.from_lines(
        [[1 / 8, 2 / 8], [9 / 8, 6 / 8], [7 / 8, 2 / 8]],
        [largest] * 3,
        0.0,
        n_sections=4,
        periods=8,
    )
    cosines = Candidates.of(design)
    most = np.where(line_class(cosines.line, 8) == 1, *largest)
    both = limits(np.zeros(len(most))).and_of_amplitudes(most, cosines)
    np.testing.assert_allclose(both.use(cosines.power_of(design)), [0, 1, 1])


def test_the_certificate_bounds_every_other_choice():
    """Also far from the optimum."""
    rng = np.random.default_rng(0)
    slopes, some = rng.normal(size=(2, 9)), limits(rng.uniform(0.2, 2, 9))
    asked = question(slopes)
    poor = some.within(np.ones(9))
    now = asked.answer(poor)
    e = certify(now, poor, some).excess
    others = [asked.answer(some.within(rng.exponential(size=9) ** 4)) for _ in range(200)]
    best = allocate(asked, some, poor, 300).answer.criterion
    assert now.criterion / e < best < min(other.criterion for other in others)


def test_what_cannot_be_seen_is_named():
    same = question(np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]))
    with pytest.raises(hj.DefinitionError, match=r"combination: .*x0 .*x1"):
        allocate(same, limits(np.ones(3)), np.ones(3), 10)
    with pytest.raises(hj.DefinitionError, match="cannot see x1 at all"):
        allocate(question(np.array([[1.0, 2], [0, 0]])), limits(np.ones(2)), np.ones(2), 10)
