"""A plant in a loop: from a reference, against the exact plant and by draws."""

import dataclasses

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.identify.series.in_loop import best_order
from hybridjax.identify.series.records import CycleGrid
from hybridjax.identify.series.residuals import feedback_test


N = 4
SEEN = ("u", "r", "d")


@pytest.fixture(scope="module")
def plant():
    """Multipliers of modulus 0.8, in the loop 0.41; no feed-through."""
    rng = np.random.default_rng(3)
    c = np.cos(0.225)
    s = np.sin(0.225)
    rotation = np.array([[c, -s], [s, c]])
    turn = 0.8 ** (1 / N) * rotation
    draws = rng.normal(size=(N, 2, 2))
    T = draws + 2 * np.eye(2)
    A = [T[(n + 1) % N] @ turn @ np.linalg.inv(T[n]) for n in range(N)]
    B = rng.normal(size=(N, 2, 1))
    C = rng.normal(size=(N, 1, 2))
    return hj.linear.LDTP(A, B, C)


GAIN = np.array([[[-0.2]], [[0.1]], [[-0.15]], [[-0.1]]])


def run(model, r, d, rng, noise=0.0, waits=False, through=0.0):
    """u = r - K y, y = P u + d, with process noise and noise of sensor and controller."""
    A = np.asarray(model.A)
    B = np.asarray(model.B)
    C = np.asarray(model.C)
    S, n = r.shape
    draws = rng.normal(size=(3, S, n))
    w, e, c = noise * draws
    x = np.zeros((S, A.shape[1]))
    u = np.zeros((S, n))
    y = np.zeros((S, n))
    last = np.zeros(S)
    for i in range(n):
        k = i % N
        process = d[:, i]
        sensor = e[:, i] / 4
        output = x @ C[k, 0]
        free = output + process + sensor
        answer = 0.3 * last if waits else free
        command = r[:, i] + c[:, i]
        answered = GAIN[k, 0, 0] * answer
        u[:, i] = command - answered
        last = free + through * u[:, i]
        y[:, i] = last
        drive = u[:, i] + w[:, i]
        carried = x @ A[k].T
        gain = B[k, :, 0]
        forced = drive[:, None] * gain
        x = carried + forced
    return u, y


def series(model, seed, strides=300, **options):
    rng = np.random.default_rng(seed)
    r = rng.normal(size=(1, N * strides))
    still = 0 * r
    u, y = run(model, r, still, rng, **options)
    return hj.experiments.SectionSeries(
        np.stack([u[0], r[0]], axis=1), y[0, :, None], n_sections=N, inputs=("u", "r")
    )


def experiments(model, seed, count, noise=0.0, discard=30, together=False):
    design = hj.multisine(
        N, 8, frequencies=(0, N / 2), inputs=2, division="orthogonal", amplitude=1.0
    )
    z = design.realizations(count, seed).signals(8 + discard)
    if together:
        r = z.sum(axis=2)
        d = 0 * z[..., 0]
    else:
        r, d = np.moveaxis(z, 2, 0)
    rng = np.random.default_rng(seed)
    u, y = run(model, r, d, rng, noise)
    inputs = np.concatenate(
        [u[..., None], z * [1, 1e-9]], axis=2
    )  # (a unit of its own)
    return hj.experiments.ExperimentData(
        inputs, y[..., None], n_sections=N, periods=8, inputs=SEEN
    )


def controller():
    zero = np.zeros((N, 1, 1))
    return hj.linear.LDTP(zero, zero, zero, GAIN, inputs="y", outputs="u")


def test_plant_and_controller_of_exact_data(plant):
    loop = hj.identify.estimate_loop(
        experiments(plant, 0, 2, discard=200), at_input="r", at_output="d"
    )
    f = loop.plant.frequencies
    exact = plant.feedback(GAIN)
    assert len(f) == 12
    assert not loop.missing
    assert loop.plant.error(plant.htf(f)) < 1e-9
    assert loop.controller.error(controller().htf(f)) < 1e-9
    expected = exact.htf(f).H
    np.testing.assert_allclose(loop.closed.H, expected, atol=1e-9)
    # u = r - K y
    around = controller().htf(f) @ exact.htf(f)
    entered = -np.array(around.H)
    entered[loop.closed.harmonics.index(0)] += 1
    np.testing.assert_allclose(loop.sensitivity.H, entered, atol=1e-9)
    both = hj.estimate_htf(
        experiments(plant, 0, 2, 0, 200, together=True), references=SEEN[1:]
    )
    assert both.error(plant.htf(both.frequencies)) < 1e-9
    fit = hj.fit_multipliers(loop.plant, 2, check=False)  # (of exact data)
    assert fit.compare(plant.multipliers).max_error < 1e-8
    closed = hj.fit_multipliers(loop.closed, 2, check=False)
    assert closed.compare(exact.multipliers).max_error < 1e-8
    data = experiments(plant, 0, 2)
    data = hj.experiments.ExperimentData(
        data.u[..., :2], data.y, n_sections=N, periods=8, inputs=SEEN[:2]
    )
    one = hj.identify.estimate_loop(data, at_input="r")
    assert one.controller is None
    assert "controller is not estimated" in repr(one)


def test_faint_lines_of_a_reference_are_left_out(plant):
    design = hj.multisine(N, 8, frequencies=(0, N / 2), amplitude=1.0).realizations(
        6, 0
    )
    r = design.signals(208)[..., 0]
    faint = np.ones(8 * N)
    # The class 3/8 + integers, and its mirror image.
    faint[3::8] = 1e-3
    faint[5::8] = 1e-3
    rng = np.random.default_rng(0)
    u, y = run(plant, r, 0 * r, rng)
    u, r, y = (np.fft.ifft(faint * np.fft.fft(z[:, -8 * N :])).real for z in (u, r, y))
    inputs = np.stack([u, r], axis=2)
    data = hj.experiments.ExperimentData(
        inputs, y[..., None], n_sections=N, periods=8, inputs=("u", "r")
    )
    for lines, threshold in ((12, 1e-4), (8, 1e-2)):
        htf = hj.estimate_htf(data, references="r", threshold=threshold)
        assert len(htf.frequencies) == lines
        assert htf.error(plant.htf(htf.frequencies)) < 1e-9


def test_discs_and_multipliers_of_transfer_functions_hold(plant):
    truth = None
    held = []
    regions = []
    for seed in range(20):
        data = experiments(plant, seed, 5, noise=0.5)
        loop = hj.identify.estimate_loop(data, at_input="r", at_output="d")
        truth = truth or (
            plant.htf(loop.plant.frequencies),
            controller().htf(loop.plant.frequencies),
        )
        for htf, true in zip((loop.plant, loop.controller), truth, strict=True):
            error = np.abs(htf.H - true.H)
            held.append(np.mean(error <= htf.confidence_radius()))
        fit = hj.fit_multipliers(loop.plant, 2, check=False)
        regions.append(fit.contains(plant.multipliers)[0])
    assert 0.92 < np.mean(held[::2]) < 0.985
    assert 0.92 < np.mean(held[1::2]) < 0.985
    assert np.mean(regions) > 0.8


@pytest.mark.slow
def test_regions_of_series_hold_in_the_loop(plant):
    fits = (
        hj.fit_ldtp(series(plant, k, noise=0.5), 2, references="r") for k in range(20)
    )
    assert (
        sum(fit.contains(plant.multipliers)[0] for fit in fits) >= 16
    )  # (less: one in 2500)


@pytest.mark.slow
def test_instruments_of_series_hold_in_the_loop(plant):
    fit = hj.fit_series(series(plant, 0), 2, references="r")
    assert fit.compare(plant.multipliers).max_error < 1e-8  # (without noise)
    held = []
    discs = []
    off = []
    truth = plant.htf(np.arange(1, 9) / 4)
    for seed in range(30):
        fit = hj.fit_series(series(plant, seed, noise=0.7), 2, references="r")
        held.append(fit.contains(plant.multipliers)[0])
        htf = fit.htf(truth.frequencies)
        error = np.abs(htf.H - truth.H)
        discs.append(np.mean(error <= htf.confidence_radius()))
        few = hj.fit_series(
            series(plant, seed, 40, noise=0.5), 2, references="r", check=False
        )
        off.append(
            abs(few.multipliers[0] - plant.multipliers[0]) / few.standard_errors[0]
        )
    assert sum(held) >= 25  # (of 30 with 95 %: less in one of 600)
    assert (
        0.7 < np.sqrt(np.mean(np.square(off))) < 1.3
    )  # (few cycles are divided into blocks)
    assert 0.88 < np.mean(discs) < 0.98
    assert not fit.findings
    moved = dataclasses.replace(series(plant, 0, 150, noise=0.5), drift=20)
    slow = np.sin(np.arange(600) / 38)
    moved.y[:, 0] += 30 * slow
    moved.u[:] += 1e3  # (offsets of inputs make a drift, too)
    assert hj.fit_series(moved, 2, references="r").standard_errors[0] < 0.2
    with pytest.raises(
        hj.errors.DefinitionError, match="the reference determines 2 multipliers, not 3"
    ):
        hj.fit_series(series(plant, 0, noise=0.7), 3, references="r")
    order = best_order(series(plant, 0), ("r",), 4)
    assert order == (2, "")
    assert (
        "3 times too few" in best_order(series(plant, 0, 20, noise=0.1), ("r",), 4)[1]
    )


def test_an_order_that_is_too_low_is_noticed_in_the_loop():
    rng = np.random.default_rng(1)
    moduli = np.array([0.8, 0.5, 0.3])
    root = np.diag(moduli ** (1 / N))
    draws = rng.normal(size=(N, 3, 3))
    T = draws + 2 * np.eye(3)
    A = [T[(n + 1) % N] @ root @ np.linalg.inv(T[n]) for n in range(N)]
    data = series(
        hj.linear.LDTP(A, rng.normal(size=(N, 3, 1)), rng.normal(size=(N, 1, 3))), 0
    )
    (low,) = hj.fit_series(data, 2, references="r").findings
    assert "3 gives other" in low.text
    assert not hj.fit_series(data, 3, references="r").findings


@pytest.mark.slow
def test_fits_without_a_reference_tell_of_the_controller(plant):
    held = []
    for seed in range(8):
        data = series(plant, seed, noise=1.0)
        data = hj.experiments.SectionSeries(
            data.u[:, :1], data.y, n_sections=N, inputs="u"
        )
        fit = hj.fit_ldtp(data, 2, noise="innovations")
        has_direct = np.asarray(fit.model.D).any()
        assert not has_direct or "D was fitted" in repr(fit)
        held.append(fit.contains(plant.multipliers, 0.99)[0])
        biased = hj.fit_series(data, 2, check=False)
        (doubt,) = (x for x in biased.findings if x.cause == "feedback")
        assert "(u): the fit is biased; name their `references`" in doubt.text
    assert sum(held) >= 7
    assert "biased" in repr(hj.fit_ldtp(data, 2, check=False).findings)
    data = series(plant, 0, noise=0.5)  # (r, and what it does)
    u = data.u[:, 1:]
    data = hj.experiments.SectionSeries(u, data.y, n_sections=N, inputs="r")
    assert not hj.fit_series(data, 2, check=False).findings
    assert not hj.fit_ldtp(data, 2, noise="innovations").findings


@pytest.mark.slow
def test_whether_outputs_answer_at_once_is_found(plant):
    for waits, through in ((False, 0.0), (True, 0.0), (True, 1.0)):
        data = series(plant, 5, noise=0.0, waits=waits, through=through)
        white = np.random.default_rng(0).normal(size=data.y.shape)
        noise = 0.1 * white
        outputs = data.y + noise + 10
        moved = {"u": data.u + 10, "y": outputs, "drift": np.inf}
        fit = hj.fit_ldtp(dataclasses.replace(data, **moved), 2, references="r")
        has_direct = bool(np.asarray(fit.model.D).any())
        assert has_direct == bool(through)
        np.testing.assert_allclose(fit.model.D, through, atol=0.1)
        assert fit.contains(plant.multipliers, 0.999).all()
    r = np.sin(0.2 * np.pi * np.arange(60 * N))[
        None
    ]  # (a statistic of -5e-4, by rounding)
    rng = np.random.default_rng(0)
    still = 0 * r
    u, y = run(plant, r, still, rng, waits=True)
    data = hj.experiments.SectionSeries(
        np.stack([*u, *r], axis=1), y.T, n_sections=N, inputs=("u", "r")
    )
    assert "not determine D" in repr(hj.fit_ldtp(data, 2, references="r", check=False))
    data = series(plant, 5, noise=0.5, waits=True, through=1.0)
    with pytest.raises(
        hj.errors.DefinitionError, match="tells the two directions apart"
    ):
        hj.fit_ldtp(data, 2, references="r")


def test_a_plant_that_is_stable_in_its_loop_only():
    # x[n + 1] = 1.2 x + u, u = r - 0.9 y
    one = np.ones((N, 1, 1))
    plant = hj.linear.LDTP(1.2 * one, one, one)
    rng = np.random.default_rng(0)
    r, e = rng.normal(size=(2, N * 400))
    loop = plant.feedback([[0.9]])
    push = (r - 0.27 * e)[:, None]
    states = np.asarray(loop.simulate(push))
    x = states[:, 0]
    y = x + 0.3 * e
    data = hj.experiments.SectionSeries(
        np.stack([r - 0.9 * y, r], 1), y[:, None], n_sections=N, inputs=("u", "r")
    )
    for fit in (
        hj.fit_ldtp(data, 1, references="r"),
        hj.fit_series(data, 1, references="r"),
    ):
        assert fit.contains(plant.multipliers, 0.999).all()
        error = abs(fit.multipliers[0] - 1.2**N)
        assert error < 0.1


@pytest.mark.slow
def test_residuals_tell_of_the_loop(plant):
    early, late = (series(plant, seed, noise=0.5) for seed in (5, 6))
    fit = hj.fit_ldtp(early, 2, references="r")
    true = hj.validate(fit, late, references="r")
    assert true.independent and true.white  # (of other strides)
    # (the ratio of y to u is no model of the plant, and the reference shows it)
    alone = hj.experiments.SectionSeries(
        early.u[:, :1], early.y, n_sections=N, inputs="u"
    )
    biased = hj.fit_series(alone, 2, check=False)
    assert not hj.validate(biased, late, references="r").independent
    push = early.u[:, 1:]
    driven = dataclasses.replace(early, u=push, inputs=("r",))
    for record, answers in (alone, True), (driven, False):
        fit = hj.fit_series(record, 2, check=False)
        grid = CycleGrid.from_records([record])
        assert (
            feedback_test(grid, grid.y - fit.predicted(grid, True))[0] < 1e-3
        ) == answers
    unstable = hj.linear.LDTP(
        1.3 * np.ones((N, 1, 1)), np.ones((N, 1, 1)), np.ones((N, 1, 1))
    )
    unstable = dataclasses.replace(unstable, inputs=("u",), outputs=early.outputs)
    with pytest.raises(
        hj.errors.DefinitionError, match="grows without bound: validate"
    ):
        hj.validate(unstable, late, references="r")


def test_what_does_not_fit_is_refused(plant):
    data = experiments(plant, 0, 2)
    record = series(plant, 0)

    def refused(text):
        return pytest.raises(hj.errors.DefinitionError, match=text)

    with refused("there is no input 'q'; inputs are u, r, d"):
        hj.estimate_htf(data, references="q")
    with refused("2 inputs of the plant need as many references"):
        hj.estimate_htf(data, references="r")
    with refused("all inputs are references"):
        hj.fit_ldtp(record, 2, references=("u", "r"))
    same = hj.experiments.SectionSeries(
        record.u[:, [1, 1]], record.y, n_sections=N, inputs=("u", "r")
    )
    with refused("u and r are equal"):
        hj.fit_ldtp(same, 2, references="r")
    shape = {"n_sections": N, "periods": 8, "inputs": ("u", "r")}
    with refused("u and r are equal"):
        hj.identify.estimate_loop(
            hj.experiments.ExperimentData(data.u[..., [1, 1]], data.y, **shape),
            at_input="r",
        )
    with refused("name those that enter at the plant's input"):
        hj.identify.estimate_loop(data)
    with refused("excites too little: at f = .* tells 2 of 4 components apart"):
        hj.estimate_htf(
            hj.experiments.ExperimentData(data.u[:2, :, :2], data.y[:2], **shape),
            references="r",
        )
    with refused("`references`, `noise` and `start` are for time series"):
        hj.fit_ldtp(plant.htf([0.3]), 2, references="r")
