"""Multipliers from natural variability, and inputs that are feedback."""

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.recordings import natural
from hybridjax.recordings.inspection.answers import feedback


N = 8


def variable(noise, strides=(300, 300), multiplier=0.6, seed=0, drift=0.0):
    """The sections of a rhythm that nobody perturbs."""
    recording = recorded(noise, strides, multiplier, seed, drift)
    options = {
        "inputs": (),
        "outputs": recording.signals,
        "n_sections": N,
        "bandwidth": np.inf,
    }
    return hj.recordings.sample_sections(recording, hj.AtEvent("e"), **options)


def recorded(noise, strides=(300, 300), multiplier=0.6, seed=0, drift=0.0):
    """A linear rhythm with one multiplier, disturbed at every section, seen by three signals."""
    rng = np.random.default_rng(seed)
    gains = np.random.default_rng(5).normal(size=(N, 3))
    trials = []
    for count in strides:
        x = 0.0
        y = []
        for n in range(count * N):
            value = gains[n % N] * np.real(x)
            y.append(value)
            decayed = multiplier ** (1 / N) * x
            x = decayed + rng.normal()
        y = np.array(y)
        places = np.arange(len(y))[:, None]
        slow = drift * np.sin(places / 800)
        errors = noise * rng.normal(size=y.shape)
        y += y.std(axis=0) * (errors + slow)
        signals = {f"y{i}": column for i, column in enumerate(y.T)}
        t = np.arange(len(y)) / N
        events = {"e": np.arange(count)}
        name = f"{len(trials)}"
        trials.append(hj.Recording(t, signals, events=events, name=name))
    return hj.Recording.join(trials)


@pytest.mark.slow
def test_a_recording_without_inputs_is_identified_by_its_variability(tmp_path):
    recording = recorded(0.2, strides=(120,))
    options = {"outputs": recording.signals, "n_sections": N, "bandwidth": np.inf}
    result = hj.identify_recording(recording, hj.AtEvent("e"), order=1, **options)
    low, high = result.fit.interval()[0]
    assert low < 0.6 < high
    assert abs(result.multipliers[0] - 0.6) < 0.15
    result.write_report(tmp_path / "report")
    page = (tmp_path / "report" / "report.html").read_text()
    assert "without a measured input" in page
    fit = hj.load(tmp_path / "report" / "fit.npz")
    population = hj.recordings.Population.from_fits([fit], {"subject": ["S1"]})
    modulus = result.fit.modulus[0]
    decay = population.values["decay"][0]
    half_life = np.log(2) / decay
    assert modulus**half_life == pytest.approx(0.5)
    with pytest.raises(hj.errors.DefinitionError, match="name `inputs`, too"):
        hj.identify_recording(recording, hj.AtEvent("e"), references="y0", **options)


def test_a_pair_has_one_interval_that_contains_the_estimate():
    """Half of the draws are pairs of modulus 0.5, the others two real numbers with the product
    0.25: the modulus of the pair is 0.5 in each of them."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.2, 0.6, 500)
    ratio = rng.uniform(1.1, 1.8, 500)
    angles = np.stack([angle, -angle], axis=1)
    pairs = 0.5 * np.exp(1j * angles)
    both_real = 0.5 * np.stack([1 / ratio, ratio], axis=1)
    draws = np.concatenate([pairs, both_real])
    noise = 1 + 0.1 * rng.normal(size=(1000, 1))
    estimate = 0.5 * np.exp(np.array([0.4j, -0.4j]))
    found = hj.recordings.NaturalMultipliers(
        estimate, estimate, draws * noise, draws * noise, 0.9, 200, 1, 5
    )
    first, second = found.interval()
    assert first.tolist() == second.tolist()
    assert 0.38 < first[0] < 0.42
    assert 0.58 < first[1] < 0.62
    # Printed as by other fits: each of the pair, with the root of its mean squared distance.
    shown = repr(found)
    error = np.sqrt(np.linalg.trace(found.multiplier_covariances))[0]
    assert found.standard_errors == pytest.approx([error, error])
    assert f"by instruments  0.46+0.19j ± {error:.2f}  modulus 0.500, 95 %" in shown
    assert f"by instruments  0.46-0.19j ± {error:.2f}\n" in shown
    assert "±0" not in shown
    table = found.to_pandas()
    parts = np.hypot(table["real_error"], table["imaginary_error"])
    assert parts.values == pytest.approx([error, error])


@pytest.mark.slow
def test_instruments_have_no_bias_by_noise():
    found = [hj.recordings.natural_multipliers(variable(0.7, seed=k)) for k in range(3)]
    (low, high) = found[0].interval(0.99)[0]
    (_, top) = found[0].interval(plain=True)[0]
    assert low < 0.6 < high
    assert top < 0.6
    by_instruments = [fit.multipliers[0].real for fit in found]
    by_regression = [fit.plain[0].real for fit in found]
    assert abs(np.mean(by_instruments) - 0.6) < 0.05
    assert np.mean(by_regression) < 0.53
    for fit in found:
        require_no_finding("order", fit)


@pytest.mark.slow
def test_too_few_multipliers_are_a_finding():
    pair = variable(0.1, multiplier=0.3 + 0.5j)
    single = hj.recordings.natural_multipliers(pair, 1)
    assert "Order: 2 multipliers give 0.5" in repr(single)
    require_no_finding("order", hj.recordings.natural_multipliers(pair, 2))
    # (One of two intervals is enough.)
    recording = variable(0.1, (60, 60), 0.3 + 0.5j, 2)
    half = hj.recordings.natural_multipliers(recording)
    require_no_finding("order", half)


@pytest.mark.slow
def test_a_drift_of_outputs_is_a_finding():
    for seed in range(3):
        drifting = hj.recordings.natural_multipliers(variable(0.1, seed=seed, drift=1))
        assert "if outputs drift" in drifting.findings[-1].text


def require_no_finding(cause, fit):
    assert cause not in [finding.cause for finding in fit.findings]


@pytest.mark.slow
def test_short_records_are_drawn_whole():
    """No interval is narrow because a record holds only one block."""
    short = variable(0.1, strides=(5,) * 12)
    found = hj.recordings.natural_multipliers(short)
    assert np.ptp(found.interval()) > 0.2
    assert any(text.cause == "few cycles" for text in found.findings)
    assert found.block * found.records == found.cycles
    assert (
        np.ptp(hj.recordings.natural_multipliers(variable(0.1, (11,))).interval()) > 0.2
    )
    longer = variable(0.1, (20,) * 60)
    many = hj.recordings.natural_multipliers(longer)
    assert abs(many.multipliers[0] - 0.6) < 0.06  # (0.13 without the correction)


def test_intervals_of_few_blocks_are_wider_than_percentiles():
    found = hj.recordings.natural_multipliers(variable(0.3, strides=(39, 40)))
    moduli = np.abs(found.draws[:, 0])
    plain = np.ptp(np.quantile(moduli, [0.025, 0.975]))
    length = np.ptp(found.interval()[0])
    assert 1.1 < length / plain < 1.4


def test_draws_keep_blocks_of_successive_cycles():
    """What successive cycles have in common stays: counts of two neighbors in blocks of b cycles
    have a correlation of 1 - 1 / b. No block reaches over the end of a record."""
    records = np.repeat([0, 1], [150, 50])
    counts = natural._resampled(records, 10, np.random.default_rng(0))
    assert np.all(counts[:, :150].sum(axis=1) == 150)
    assert np.all(counts[:, 150:].sum(axis=1) == 50)
    inside = counts[:, 20:130] - counts[:, 20:130].mean()
    products = inside[:, 1:] * inside[:, :-1]
    correlation = products.mean() / inside.var()
    np.testing.assert_allclose(correlation, 0.9, atol=0.01)


def turning(modulus, angle, cycles, seed):
    """The sections of a rhythm whose two states turn by an angle in each cycle."""
    rng = np.random.default_rng(seed)
    z = np.zeros(cycles * N, complex)
    for k in range(1, len(z)):
        noise = rng.normal() + 1j * rng.normal()
        turn = modulus ** (1 / N) * np.exp(1j * angle / N)
        turned = turn * z[k - 1]
        z[k] = turned + noise
    signals = {"a": z.real, "b": z.imag}
    recording = hj.Recording(
        np.arange(len(z)) / N, signals, events={"e": np.arange(cycles)}
    )
    options = {"inputs": (), "outputs": recording.signals, "n_sections": N}
    return hj.recordings.sample_sections(
        recording, hj.AtEvent("e"), bandwidth=np.inf, **options
    )


@pytest.mark.slow
def test_pairs_in_short_records_have_no_bias():
    """The formula for disturbances along the eigenvectors does not hold for those of a pair."""
    found = [
        hj.recordings.natural_multipliers(turning(0.9, 1.0, 60, seed), 2).modulus[0]
        for seed in range(6)
    ]
    assert abs(np.mean(found) - 0.9) < 0.04


def test_an_input_that_repeats_with_the_rhythm_is_named(rhythm):
    sections = {"sections": hj.AtEvent("turn"), "n_sections": N}
    marked = rhythm.mark("turn", hj.Crossing("v", "falling"))
    given = hj.recordings.sample_sections(
        marked, inputs="force", outputs=("x", "v"), **sections
    )
    assert list(feedback(given)) == []
    loop = hj.recordings.sample_sections(marked, inputs="x", outputs="v", **sections)
    (finding,) = feedback(loop)
    assert finding.cause == "feedback"
    assert "repeats with the cycle" in finding.text
