"""Populations: closed forms, other software's numbers, exact permutations, and refusals."""

import dataclasses
import itertools
import json
import re

import numpy as np
import pandas
import pytest
from matplotlib import pyplot
from scipy import linalg, stats

import hybridjax as hj
from hybridjax._core.findings import Finding
from hybridjax._core.results import Result
from hybridjax._core.signal import Signal
from hybridjax.apps import subjects
from hybridjax.apps.cli import main
from hybridjax.apps.identify import summarize
from hybridjax.identify.multiplier_estimate import MultiplierEstimate
from hybridjax.recordings import Population, PopulationMaps
from hybridjax.recordings.population.reml import mixed, moderated


RNG = np.random.default_rng(0)
N = 10


class Fit(MultiplierEstimate):
    outputs: tuple


def fit_of(c, scale=1e-4, outputs=("y",)):
    c = np.asarray(c, float)
    roots = np.roots([1.0, *c])
    order = np.argsort(-np.abs(roots))
    roots = roots[order].astype(complex)
    covariance = scale * np.eye(len(c))
    return Fit(roots, c, covariance, np.inf, outputs)


def study(y, error, **columns):
    columns = {name: list(column) for name, column in columns.items()}
    names = [f"s{i}" for i in range(len(y))]
    table = {"subject": names} | columns
    return Population(table, {"gain": y}, {"gain": error}, {"gain": "m/N"})


def test_equal_errors_give_the_t_interval():
    """Hartung and Knapp's interval is then Student's, and the spread what errors leave."""
    y = RNG.normal(size=N)
    people = study(y, np.full(N, 0.3))
    row = people.mean("gain")
    error_of_mean = stats.sem(y)
    interval = stats.t.interval(0.95, N - 1, y.mean(), error_of_mean)
    found = (row["low"][0], row["high"][0])
    assert found == pytest.approx(interval)
    left = y.var(ddof=1) - 0.09
    expected = np.sqrt(left)
    assert row["spread"][0] == pytest.approx(expected)


def test_an_outlier_among_subjects_is_named():
    y = np.random.default_rng(0).normal(size=N)
    study(y, np.full(N, 0.3)).mean("gain")
    y[3] += 8.0
    with pytest.warns(hj.errors.FindingWarning, match="gain of the subjects .all. is"):
        study(y, np.full(N, 0.3)).mean("gain")


def test_equal_estimates_have_the_error_of_their_fits():
    errors = np.full(N, 0.3)
    row = study(np.ones(N), errors).mean("gain")
    expected = 0.3 / np.sqrt(N)
    assert row["standard_error"][0] == pytest.approx(expected)
    assert row["spread"][0] == 0


def test_the_bcg_trials():
    """Vaccination trials of the R package metafor (Viechtbauer 2010): `rma(yi, vi, test="knha")`
    prints -0.7145 (0.1808), tau^2 0.3132, and `confint` tau 0.3460 to 1.0543."""
    y = [
        -0.8893,
        -1.5854,
        -1.3481,
        -1.4416,
        -0.2175,
        -0.7861,
        -1.6209,
        0.0120,
        -0.4694,
        -1.3713,
        -0.3394,
        0.4459,
        -0.0173,
    ]
    v = [
        0.3256,
        0.1946,
        0.4154,
        0.0200,
        0.0512,
        0.0069,
        0.2230,
        0.0040,
        0.0564,
        0.0730,
        0.0124,
        0.5325,
        0.0714,
    ]
    errors = np.sqrt(v)
    row = study(np.array(y), errors).mean("gain")
    estimate = row["estimate"][0]
    assert estimate == pytest.approx(-0.7145, abs=2e-4)
    assert row["standard_error"][0] == pytest.approx(0.1808, abs=2e-4)
    variance = row["spread"][0] ** 2
    assert variance == pytest.approx(0.3132, abs=2e-4)
    assert (row["spread_low"][0], row["spread_high"][0]) == pytest.approx(
        (0.346, 1.0543), abs=2e-4
    )


def test_complete_pairs_give_the_paired_t_test():
    """And two groups with equal errors give Welch's, with nearly its degrees of freedom."""
    first = RNG.normal(size=N)
    second = RNG.normal(size=N) + RNG.normal(size=N)
    y = np.concatenate([first, second])
    error = np.full(2 * N, 0.01)
    labels = np.repeat(["a", "b"], N)
    names = np.tile(np.arange(N), 2)
    table = {"subject": names, "condition": labels}
    people = Population(table, {"q": y}, {"q": error})
    row = people.difference("q", "a", "b")
    paired = stats.ttest_rel(first, second)
    p_value = row["p"][0]
    assert p_value == pytest.approx(paired.pvalue, rel=1e-3)
    dof = row["dof"][0]
    assert dof == pytest.approx(N - 1, rel=1e-3)

    wide = 3 * second
    y = np.concatenate([first, wide])
    row = study(y, error, group=labels).difference("gain", "a", "b")
    welch = stats.ttest_ind(first, wide, equal_var=False)
    difference = first.mean() - wide.mean()
    expected = abs(difference / welch.statistic)
    assert row["standard_error"][0] == pytest.approx(expected, rel=1e-3)
    dof_of_groups = row["dof"][0]
    assert dof_of_groups == pytest.approx(welch.df, rel=0.02)


def test_the_mixed_model_maximizes_the_restricted_likelihood():
    """That of all contrasts without a mean, for errors that differ and missing conditions."""
    of_condition = RNG.normal(size=(8, 2))
    of_subject = RNG.normal(size=(8, 1))
    y = of_condition + of_subject
    v = RNG.uniform(0.02, 0.2, (8, 2))
    present = np.ones((8, 2), bool)
    present[0, 0] = False
    present[1, 1] = False
    (subjects, cells) = np.nonzero(present)
    y = y[present]
    v = v[present]
    x = np.eye(2)[cells]
    same = subjects[:, None] == subjects
    fit = mixed(y, v, x, subjects, cells)
    contrasts = linalg.null_space(x.T)

    def covariance(between):
        of_cells = between[np.ix_(cells, cells)]
        return same * of_cells + np.diag(v)

    def likelihood(between):
        part = contrasts.T @ covariance(between) @ contrasts
        return stats.multivariate_normal.logpdf(contrasts.T @ y, cov=part)

    for step in ([[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 1], [1, 0]]):
        for size in (-1e-2, 1e-2):
            assert likelihood(fit.between + size * np.array(step)) < likelihood(
                fit.between
            )
    w = np.linalg.inv(covariance(fit.between))
    np.testing.assert_allclose(
        fit.coefficients, np.linalg.solve(x.T @ w @ x, x.T @ w @ y)
    )
    added = np.linalg.eigvalsh(fit.covariance - fit.plain)
    assert (added > -1e-12).all()


def test_predictions_shrink_and_covariates_explain():
    age = np.linspace(20, 60, N)
    error = RNG.uniform(0.1, 0.4, N)
    noise = 0.01 * RNG.normal(size=N)
    people = study(0.1 * age + noise, error, age=age)
    row = people.mean("gain", covariates="age")
    assert list(row["effect"]) == ["mean", "slope of age"]
    assert row["estimate"][1] == pytest.approx(0.1, abs=0.01)
    assert row["p"][1] < 1e-4
    level = 5 + error * RNG.normal(size=N)
    flat = study(level, error).predictions("gain")
    overall = study(flat["estimate"], error).mean("gain")
    mean = overall["estimate"][0]
    predicted = np.abs(flat["prediction"] - mean)
    estimated = np.abs(flat["estimate"] - mean)
    assert (predicted <= estimated).all()


def test_moderated_variances_are_closer_to_the_true_ones():
    strides = RNG.uniform(60, 300, 400)
    dof = np.full(400, 6.0)
    true = 1 / strides
    v = true * RNG.chisquare(6, 400) / 6
    ones = np.ones(400)
    trend = np.column_stack([ones, np.log(strides)])
    better = moderated(v, dof, trend)
    moderated_error = np.std(np.log(better / true))
    plain_error = np.std(np.log(v / true))
    assert moderated_error < 0.2 * plain_error
    bias = abs(np.log(better / true).mean())
    assert bias < 0.1
    infinite = np.full(400, np.inf)
    np.testing.assert_array_equal(moderated(v, infinite, trend), v)


def test_quantities_of_fits():
    """The modulus of a pair is the root of c2, whose error is known; orders may differ."""
    fits = [fit_of([0.5, 0.5 + 0.01 * k]) for k in range(4)]
    all_fits = [*fits, fit_of([0.5])]
    people = Population.from_fits(all_fits, {"subject": list("abcde")})
    modulus = np.sqrt([0.5, 0.51, 0.52, 0.53])
    found_moduli = people.values["modulus"]
    np.testing.assert_allclose(found_moduli, [*modulus, 0.5])
    expected = [*1e-2 / (2 * modulus), 1e-2]
    np.testing.assert_allclose(people.errors["modulus"], expected)
    cosines = np.cos(people.values["angle"][:4])
    np.testing.assert_allclose(cosines, -0.25 / modulus)
    assert [people.mean(name)["subjects"][0] for name in ("angle", "c1", "c2")] == [
        4,
        5,
        4,
    ]


def test_plans_agree_with_closed_forms():
    y = 1 + 0.2 * RNG.normal(size=12)
    errors = np.full(12, 0.1)
    people = study(y, errors, strides=np.full(12, 100))
    with pytest.raises(
        hj.errors.DefinitionError, match="subjects differ in 'gain' by no more than"
    ):
        strides = np.full(12, 100)
        few = study(y, np.ones(12), strides=strides)
        few.allocation("gain")
    between = np.sqrt(y.var(ddof=1) - 0.01)
    plan = people.allocation("gain", subject_cost=4, trial_cost=1e-9, stride_cost=0.01)
    expected_strides = np.sqrt(400) / between
    assert plan["strides"][0] == pytest.approx(expected_strides, rel=1e-4)
    spread = np.sqrt(between**2 + 0.01)
    (power,) = people.power("gain", 0.25, (12,), draws=40)["power"]
    expected = stats.nct.sf(
        stats.t.isf(0.025, 22), 22, 0.25 / (spread * np.sqrt(2 / 12))
    )
    variance = expected * (1 - expected)
    allowed = 3 * np.sqrt(variance / 40)
    assert abs(power - expected) < allowed


def test_trials_and_strides_have_the_smallest_variance_for_their_cost():
    of_subject = np.repeat(RNG.normal(size=12), 3)
    y = of_subject + 0.8 * RNG.normal(size=36)
    names = np.repeat(np.arange(12), 3)
    table = {"subject": names, "strides": np.full(36, 100)}
    errors = np.full(36, 0.1)
    people = Population(table, {"gain": y}, {"gain": errors})
    conditions = ["a" * 60, "b" * 60]
    wide = study([1.0, 2], [1.0, 1], condition=conditions)
    assert max(map(len, repr(wide).splitlines())) <= 100
    row = people.allocation(
        "gain", subject_cost=4, trial_cost=0.5, stride_cost=0.01
    ).iloc[0]
    y = y.reshape(12, 3)
    trials = y.var(axis=1, ddof=1).mean() - 0.01
    between_means = y.mean(axis=1).var(ddof=1)
    subjects = between_means - (trials + 0.01) / 3
    assert row["trial_spread"] ** 2 == pytest.approx(trials)
    assert row["subject_spread"] ** 2 == pytest.approx(subjects, rel=1e-4)
    trial_counts = np.arange(1, 30)
    stride_counts = np.arange(1, 400)
    k, m = np.meshgrid(trial_counts, stride_counts)
    by_stride = 1 / (k * m)
    spread = subjects + trials / k + by_stride
    cost = 4 + 0.5 * k + 0.01 * k * m
    product = spread * cost
    best = np.unravel_index(product.argmin(), product.shape)
    found = (row["trials"], round(row["strides"]))
    assert found == (k[best], m[best])


METERS, MICROMETERS = ((Signal("y", unit),) for unit in ("m", "um"))
PHASES = np.arange(6) / 6
AXES = {"phase": PHASES, "lag": np.arange(8.0)}


def maps_of(values, n, **labels):
    repeats = len(values) // n
    subjects = np.tile(np.arange(n), repeats)
    table = {"subject": subjects} | labels
    return PopulationMaps(table, values, AXES)


def test_all_sign_flips_give_the_exact_p_value():
    y = RNG.normal(size=(7, 6, 8))
    conditions = np.repeat(["a", "b"], 7)
    values = np.concatenate([y, 0 * y])
    both = maps_of(values, 7, condition=conditions)
    test = both.difference("a", "b")
    largest = [
        np.abs(stats.ttest_1samp(np.array(s)[:, None, None] * y, 0).statistic).max()
        for s in itertools.product([1, -1], repeat=7)
    ]
    t = stats.ttest_1samp(y, 0).statistic
    np.testing.assert_allclose(test.t, t)
    observed = np.abs(t) * (1 - 1e-9)
    largest_of_draws = np.array(largest)[:, None, None]
    expected = (largest_of_draws >= observed).mean(axis=0)
    np.testing.assert_allclose(test.p, expected)
    assert "all 64 sign flips" in test.methods


def test_groups_are_compared_by_the_statistic_of_welch():
    y = RNG.normal(size=(12, 6, 8))
    y[:5, [0, 5], 2:5] += 8.0
    groups = ["a"] * 5 + ["b"] * 7
    test = maps_of(y, 12, group=groups).difference("a", "b", draws=2000)
    assert "2000 random rotations" in test.methods
    inside = test.significant[[0, 5], 2:5]
    assert inside.all()
    np.testing.assert_array_equal(test.significant, test.p <= 0.05)
    welch = stats.ttest_ind(y[:5], y[5:], equal_var=False)
    np.testing.assert_allclose(test.t, welch.statistic)
    rotated = maps_of(y * np.exp(1j), 12, group=groups)
    turned = rotated.difference("a", "b", draws=100)
    np.testing.assert_allclose(turned.t, np.abs(test.t))


def smooth(rng, n):
    """Normal curves of n subjects at 24 points, correlated over four of them."""
    distance = np.arange(-8, 9) / 4
    kernel = np.exp(-0.5 * distance**2)
    kernel /= np.linalg.norm(kernel)
    rows = rng.normal(size=(n, 24 + 16))
    return np.array([np.convolve(row, kernel, "valid") for row in rows])


@pytest.mark.slow
def test_groups_of_other_sizes_and_spreads_raise_no_alarm():
    """Of 120 pairs of equal means 5 % differ. (By permutations of labels 36 %.)"""
    rng = np.random.default_rng(0)
    groups = ["a"] * 6 + ["b"] * 14
    table = {"subject": np.arange(20), "group": groups}
    alarms = 0
    for _ in range(120):
        y = smooth(rng, 20)
        y[:6] *= 2.0
        phases = np.arange(24) / 24
        maps = PopulationMaps(table, y, {"phase": phases})
        alarms += maps.difference("a", "b", draws=200).significant.any()
    assert stats.binomtest(alarms, 120, 0.05).pvalue > 0.01


@pytest.mark.parametrize("groups", [False, True])
@pytest.mark.slow
def test_bands_of_skewed_values_hold(groups):
    """Of 100 lognormal means, or differences of two; bands of sign flips hold 60 of the means."""
    rng = np.random.default_rng(1)
    table = {"subject": np.arange(20), "group": ["a"] * 7 + ["b"] * 13}
    held = 0
    for _ in range(100):
        y = np.exp(smooth(rng, 20))
        true = np.exp(0.5)
        if groups:
            y[:7] *= 2.0
        phases_of_maps = np.arange(24) / 24
        maps = PopulationMaps(table, y, {"phase": phases_of_maps})
        if groups:
            found = maps.difference("a", "b", draws=300)
        else:
            found = maps.mean(draws=300)
        apart = np.abs(found.values - true)
        held += (apart <= found.reach).all()
        assert "values are skewed" in found.methods
    assert stats.binomtest(held, 100, 0.95).pvalue > 0.01


def test_the_band_holds_the_mean_and_draws_repeat():
    y = RNG.normal(size=(15, 6, 8))
    first, second = (maps_of(y, 15).mean(draws=500, seed=1) for _ in range(2))
    np.testing.assert_array_equal(first.reach, second.reach)
    error = stats.sem(y)
    assert (first.reach > 1.2 * stats.t.isf(0.025, 14) * error).all()


@pytest.mark.parametrize(
    "sentence, call",
    {
        "'a' is in the groups 'x'": lambda: study(
            [1.0, 2], [1.0, 1], subject=["a", "a"], group="xy"
        ),
        "row 1 of `table` has no subj": lambda: study(
            [1.0, 2], [1.0, 1], subject=["a", None]
        ),
        "'x' has too few": lambda: study([1.0, 2, 3], np.ones(3), condition="xyy").mean(
            "gain"
        ),
        "has no covariance": lambda: fitted(fit_of([0.5], scale=np.inf)),
        "'a' and 'b' .*'y' .m.,. and .'y' .um.,": lambda: fitted(
            fit_of([0.5], outputs=METERS), fit_of([0.5], outputs=MICROMETERS)
        ),
        "'all' has too few subjects: 0 of 2": lambda: fitted(fit_of([0.5])).mean(
            "angle"
        ),
        "no column 'subject'": lambda: Population({}, {"q": [1.0]}, {"q": [1.0]}),
        "standard error 0: it must": lambda: study([1.0], [0.0]),
        "no two conditions": lambda: study([1.0, 2], [1.0, 1]).difference(
            "gain", "a", "b"
        ),
        "must be two": lambda: study([1.0, 2, 3], np.ones(3)).power(
            "gain", 1, labels=["a"]
        ),
        "no quantity 'x'": lambda: study([1.0, 2], [1.0, 1]).mean("x"),
    }.items(),
)
def test_refusals(sentence, call):
    with pytest.raises(hj.errors.DefinitionError, match=sentence):
        call()


def fitted(*fits):
    subjects = list("ab")[: len(fits)]
    return Population.from_fits(fits, {"subject": subjects})


@pytest.mark.slow
def test_a_table_of_files(tmp_path, rhythm, monkeypatch, capsys):
    """Each subject has a report, failures are named, and a second call computes nothing anew."""
    write_subjects(tmp_path, rhythm)
    # The figures of single reports are tested elsewhere and take long.
    monkeypatch.setattr(subjects, "write_results", write_numbers)
    monkeypatch.chdir(tmp_path)
    options = (
        "--inputs force --outputs x,v --phase x,v --sections 8 --order 1 --out out"
    )
    command = ["identify", "--table", "subjects.csv", *options.split()]
    assert main(command) == 1
    printed = capsys.readouterr().out
    assert "S9-a failed: cannot read" in printed
    assert re.search("a - b|b - a", printed)
    assert "S0-a is doubtful: odd." in printed
    require_results(tmp_path / "out")

    monkeypatch.setattr(subjects, "read_recording", lambda *files, **options: 1 / 0)
    assert main(command) == 1
    printed = capsys.readouterr().out
    assert "S9-a failed: ZeroDivisionError" in printed
    assert "S0-a failed" not in printed


@pytest.mark.parametrize("name", ["population.csv", "forest_decay.png"])
def test_a_foreign_file_is_refused_before_any_subject(tmp_path, name):
    (tmp_path / name).write_text("mine")
    table = {"file": ["S1.csv"], "subject": ["S1"]}
    with pytest.raises(hj.errors.DefinitionError, match=f"{name}' is in the way"):
        hj.identify_subjects(table, tmp_path, lambda recording: 1 / 0)


def test_a_study_into_a_file_is_refused_before_any_subject(tmp_path):
    file = tmp_path / "study"
    file.write_text("mine")
    table = {"file": ["S1.csv"], "subject": ["S1"]}
    with pytest.raises(hj.errors.DefinitionError, match="study': it is a file"):
        hj.identify_subjects(table, file, lambda recording: 1 / 0)


def write_subjects(folder, rhythm):
    """Write recordings of six subjects in two groups, and a table that names a seventh, too."""
    rows = ["file,subject,group,age"]
    for k in range(6):
        noisy = hj.testing.add_artifacts(rhythm, ("x", "v"), noise=1e-3, seed=k)
        (trial,) = noisy.trials
        np.savetxt(
            folder / f"{k}.csv",
            np.column_stack([trial.time, trial.values]),
            "%.6g",
            delimiter=",",
            comments="",
            header="time (s),force (N),x (m),v (m/s)",
        )
        group = "ab"[k % 2]
        rows.append(f"{k}.csv,S{k},{group},{30 + k}")
    rows.append("none.csv,S9,a,40")
    (folder / "subjects.csv").write_text("\n".join(rows) + "\n")


def require_results(out):
    """The figures, the tables and the page of the population."""
    for quantity in ("modulus", "decay"):
        assert (out / f"forest_{quantity}.png").exists()
    assert not pyplot.get_fignums()
    compared = pandas.read_csv(out / "population.csv")
    assert {"modulus", "decay", "c1"} == set(compared["quantity"])
    page = (out / "population.html").read_text()
    assert "Not compared: angle" in page
    assert page.count("report.html") == 6
    assert "Hartung" in page
    assert "S9-a failed" in page
    table = (out / "subjects.csv").read_text()
    assert table.count("\n") == 7
    assert table.startswith("report,subject,group,age,strides,period")


def write_numbers(folder, result, formats):
    assert result.fit.result == Result.OK
    (folder / "report.html").write_text("")
    odd = (Finding("order", "odd."),)
    odd_fit = dataclasses.replace(result.fit, findings=odd)
    hj.save(folder / "fit.npz", odd_fit)
    (folder / "summary.json").write_text(json.dumps(summarize(result)))


def test_figures():
    subject = np.tile(np.arange(N), 2)
    condition = np.repeat(["a", "b"], N)
    table = {"subject": subject, "condition": condition}
    values = RNG.normal(size=2 * N)
    errors = np.ones(2 * N)
    people = Population(table, {"q": values}, {"q": errors})
    forest = people.plot("q").ax
    labels = [x.get_text() for x in forest.get_yticklabels()]
    assert labels.count("3") == 2
    assert {"mean, a", "mean, b"} < set(labels)
    lines = hj.plot.paired(people, "q", "a", "b").ax.get_lines()
    of_subjects = [line for line in lines if len(line.get_xdata()) == 2]
    assert len(of_subjects) >= N


def test_figures_of_maps():
    y = RNG.normal(size=(12, 6, 8))
    y[:6, 2:4, 2:5] += 4.0
    group = np.repeat(["a", "b"], 6)
    difference = maps_of(y, 12, group=group).difference("a", "b")
    ax = difference.plot().ax
    assert len(ax.collections) == 2, "the map and its outline"
    table = {"subject": np.arange(12)}
    lags = {"lag": AXES["lag"]}
    curves = PopulationMaps(table, y[:, 0], lags)
    ax = curves.mean().plot().ax
    assert len(ax.get_lines()) == 12 + 3
