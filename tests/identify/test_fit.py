"""What all fits share: one base, and findings as the only form of doubt."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import hybridjax as hj
from hybridjax._core.findings import Finding
from hybridjax.identify.multiplier_estimate import MultiplierEstimate


N = 4
MULTIPLIERS = (0.8, 0.5)


@pytest.fixture(scope="module")
def plant():
    """A system with two multipliers, whose coordinates change from section to section."""
    rng = np.random.default_rng(1)
    moduli = np.array(MULTIPLIERS)
    root = np.diag(moduli ** (1 / N))
    draws = rng.normal(size=(N, 2, 2))
    T = draws + 2 * np.eye(2)
    A = [T[(n + 1) % N] @ root @ np.linalg.inv(T[n]) for n in range(N)]
    B = rng.normal(size=(N, 2, 1))
    C = rng.normal(size=(N, 1, 2))
    return hj.linear.LDTP(A, B, C)


def recorded(plant, noise=0.1, cycles=300, drift=0.0):
    rng = np.random.default_rng(0)
    u = rng.normal(size=(N * cycles, 1))
    clean = np.asarray(plant.simulate(u))
    y = clean + noise * rng.normal(size=u.shape)
    line = np.linspace(-1, 1, len(y))
    slow = drift * line**3
    drifting = y + slow[:, None]
    return hj.experiments.SectionSeries(u, drifting, n_sections=N)


def uncertain(plant):
    """Responses with errors of known variance."""
    exact = plant.htf(np.linspace(0.02, 1.98, 60))
    H = np.asarray(exact.H)
    power = np.mean(np.abs(H) ** 2)
    size = 1e-3 * np.sqrt(power)
    rng = np.random.default_rng(0)
    error = (
        size * np.sqrt(0.5) * (rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape))
    )
    return hj.linear.HTF(
        exact.frequencies,
        H + error,
        exact.harmonics,
        N,
        variance=np.full(H.shape, size**2),
    )


@pytest.fixture(scope="module")
def fits(plant):
    htf = uncertain(plant)
    record = recorded(plant)
    return {
        "multipliers": hj.fit_multipliers(htf, 2),
        "series": hj.fit_series(record, 2),
        "ldtp of HTFs": hj.fit_ldtp(htf, 2),
        "ldtp of series": hj.fit_ldtp(record, 2),
    }


def test_fits_of_multipliers_are_fits(fits):
    for name, fit in fits.items():
        assert isinstance(fit, hj.identify.Fit), name
        found = np.sort(fit.multipliers.real)
        apart = np.abs(found - np.sort(MULTIPLIERS))
        assert apart.max() < 0.02
        has_size = fit.covariance.shape == (2, 2)
        assert has_size and fit.dof > 100, name
        assert fit.findings == (), f"{name}: {fit.findings}"
        low, high = fit.interval(0.99).T
        covers_low = (low < fit.multipliers.real).all()
        covers_high = (high > MULTIPLIERS).all()
        assert covers_low and covers_high, name
    for name in ("series", "ldtp of series"):
        np.testing.assert_allclose(fits[name].noise, 0.1, rtol=0.1)
    assert fits["multipliers"].noise is None
    assert fits["ldtp of HTFs"].noise is None


def test_intervals_of_moduli():
    """Of a real multiplier with Student's distribution, and of a pair at an angle."""
    one = MultiplierEstimate(
        np.array([-0.5 + 0j]), np.array([0.5]), np.array([[0.01]]), 7.0
    )
    reach = 0.1 * stats.t.ppf(0.975, 7)
    expected = [[0.5 - reach, 0.5 + reach]]
    np.testing.assert_allclose(one.interval(), expected)
    z = 0.8 * np.exp(0.7j)
    c = np.array([-2 * z.real, abs(z) ** 2])  # (the modulus is the root of c_2 alone)
    roots = np.array([z, z.conj()])
    variances = np.diag([0.3, 0.04])
    pair = MultiplierEstimate(roots, c, variances, np.inf)
    error = 0.2 / (2 * 0.8)
    np.testing.assert_allclose(
        np.diff(pair.interval(0.6827), axis=1), 2 * error, rtol=1e-3
    )


def causes(fit):
    assert all(isinstance(finding, Finding) for finding in fit.findings)
    for finding in fit.findings:
        printed = " ".join(repr(fit).split())
        assert finding.text in printed, "it is printed"
        assert finding.text.split("`")[0][:40] in fit._repr_html_(), (
            "and shown in notebooks"
        )
    return {finding.cause for finding in fit.findings}


def test_an_order_that_is_too_low_is_a_finding(plant):
    few_multipliers = hj.fit_multipliers(uncertain(plant), 1)
    assert causes(few_multipliers) == {"order"}
    # (A missing multiplier may look like drift, too.)
    found = causes(hj.fit_series(recorded(plant), 1))
    assert found in ({"order"}, {"drift"})
    few_states = hj.fit_ldtp(recorded(plant), 1)
    assert causes(few_states) == {"left over"}


def test_an_order_that_is_too_high_is_a_finding(plant):
    fit = hj.fit_multipliers(uncertain(plant), 3, check=False)
    assert "support 2 multipliers, not 3" in fit.findings[0].text
    assert causes(fit) == {"order"}
    high_order = hj.fit_series(recorded(plant), 3, check=False)
    assert "order" in causes(high_order)
    low_order = hj.fit_ldtp(recorded(plant, noise=0.3), 3)
    assert causes(low_order) == {"order"}
    with pytest.raises(
        hj.errors.DefinitionError, match="support 2 multipliers.*check=False"
    ):
        hj.fit_series(recorded(plant), 3)


def test_drift_is_a_finding(plant):
    data = recorded(plant, drift=30.0)
    assert "drift" in causes(hj.fit_series(data, 2, check=False))
    assert "drift" in causes(hj.fit_ldtp(data, 2))


def test_a_controller_is_a_finding(plant):
    rng = np.random.default_rng(0)
    x = np.zeros(2)
    signals = []
    A = np.asarray(plant.A)
    B = np.asarray(plant.B)
    C = np.asarray(plant.C)
    for k in range(N * 500):
        n = k % N
        y = C[n] @ x + rng.normal(size=1)
        last = signals[-1][1] if signals else 0.0
        u = 0.3 * rng.normal(size=1) - 0.2 * last
        signals.append((u, y))
        forced = B[n] @ u
        x = A[n] @ x + forced
    u, y = np.swapaxes(signals, 0, 1)
    data = hj.experiments.SectionSeries(u, y, n_sections=N, inputs="force")
    for fit in (hj.fit_series(data, 2, check=False), hj.fit_ldtp(data, 2, check=False)):
        assert "feedback" in causes(fit)
        text = next(f.text for f in fit.findings if f.cause == "feedback")
        assert "(force)" in text
        assert "name their `references`" in text


def test_a_misfit_is_a_finding(plant):
    htf = uncertain(plant)
    smaller = np.asarray(htf.variance) / 100
    bold = dataclasses.replace(htf, variance=smaller)
    fit = hj.fit_ldtp(bold, 2)
    assert "misfit" in causes(fit)
    assert fit.cost > 50 * fit.dof


def test_findings_are_warned_of_and_saved(plant, tmp_path):
    with pytest.warns(hj.errors.FindingWarning, match="too low"):
        fit = hj.fit_multipliers(uncertain(plant), 1)
    hj.save(tmp_path / "fit.npz", fit)
    assert hj.load(tmp_path / "fit.npz").findings == fit.findings
