"""The plant and its controller apart: regions and errors of what is identified in a loop.

The vertical hopper, linearized at 8 clock sections, with the feedback `GAIN` of height and speed,
u = r - K y, at work. r is white, and process noise as large as r acts beside it; sensors have noise
of a tenth of the outputs' rms, which goes round the loop. Printed, as `name value` lines, over
`--draws` draws:

- `bound`: Cramer-Rao bound of the plant's first multiplier, for 300 strides of the loop.
- `ldtp.rms`, `ldtp.ratio` (to the bound), `ldtp.covered`, `ldtp.p`: of `fit_ldtp(references="r")`:
  rms error, how often its 95 % region holds the true multiplier, p-value of 95 % (binomial test).
  `without.covered`: without the reference, and with D free. `series.*`: of
  `fit_series(references="r")`.
- `plant.covered`, `plant.p`, `controller.*`: how often the 95 % discs of HTFs hold the truth, of
  `hj.identify.estimate_loop` with two references, and noise of a fifth of r in what the controller
  does; the p-value is that of their mean over draws (t test).
- `seconds.*`: CPU seconds of fits.
- with `--random 20`: `short_gait.*`, errors of the multiplier 4.00386 of the simplest walker's
  short gait, from nonlinear experiments in a loop that stabilizes it; and of random plants (2 to 5
  states, 1 to 2 inputs, 8 to 24 sections, every tenth unstable) in random loops, how many are
  identified (`right`: the region of 99.99 % holds), refused or not converged (`reported`), `wrong`,
  and how many regions of 95 % hold; and `recording.*`, CPU seconds of `identify_recording`.

- with `--orders 100`: how often `fit_series` doubts the order (`doubted`). As many random plants
  have 2 to 4 multipliers, 1 to 3 outputs, and noise of sensors and process: without feedback
  (`open`), with nonlinear outputs (`bent`), and in a loop (`loop`); the hopper has amplitudes at
  which it distorts (`hopper`). Orders that `fit_series` refuses are not counted. `wrong`: fits of
  too low an order with an error above 5 standard errors; `near`: the others; `right`: those of the
  right order. `seconds`: CPU time relative to fits without this test.

    python benchmarks/in_loop.py [--draws 400] [--size 1.0] [--first 0] [--random 20] [--orders 100]
"""

import argparse
import time
import warnings
from collections import Counter, defaultdict
from unittest import mock

import equinox as eqx
import numpy as np
from process_noise import innovations
from scipy import stats

import hybridjax as hj
from hybridjax.identify.denominator import multipliers_of
from hybridjax.identify.instrument import in_loop
from hybridjax.identify.joint.realization import realized_htf
from hybridjax.identify.multiplier_estimate import MultiplierEstimate
from hybridjax.identify.periodic import (
    PeriodicModel,
    characteristic_slopes,
    local_coordinates,
)
from hybridjax.identify.realization import realized
from hybridjax.identify.series import fit as series_fit
from hybridjax.identify.series.prediction import SeriesPart, SeriesProblem
from hybridjax.identify.series.records import CycleGrid


N, STRIDES, BEFORE, SENSOR, MOTOR = 8, 300, 20, 0.1, 0.2
GAIN = np.array([[0.3, 1.0]])


def hopper() -> hj.linear.LDTP:
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    phase = hj.ClockPhase(N, anchor=hj.Crossing("vM", "falling"))
    exact = hj.linearize(cycle, phase, ("yM", "vM"))
    minimal = realized_htf(exact.htf(np.arange(1, 128) / 32 + 1 / 77), order=2)
    return eqx.tree_at(lambda x: x.D, minimal, 0 * minimal.D)  # (1e-17)


def respond(model: hj.linear.LDTP, r, d, w, e) -> tuple[np.ndarray, np.ndarray]:
    """u and y of the loop u = r - K y, y = C x + d + e, for signals (S, n, .)."""
    A, B, C = (np.asarray(x) for x in (model.A, model.B, model.C))
    x, u, y = np.zeros((len(r), A.shape[1])), np.zeros(r.shape), np.zeros(d.shape)
    for i in range(r.shape[1]):
        n = i % N
        y[:, i] = x @ C[n].T + d[:, i] + e[:, i]
        u[:, i] = r[:, i] - y[:, i] @ GAIN.T
        x = x @ A[n].T + (u[:, i] + w[:, i]) @ B[n].T
    return u, y


def sizes(model: hj.linear.LDTP) -> np.ndarray:
    """Return the rms of the outputs without noise."""
    r, zero = (
        np.random.default_rng(1).normal(size=(1, N * STRIDES, 1)),
        np.zeros((N * STRIDES, 2)),
    )
    return respond(model, r, zero[None], 0 * r, zero[None])[1].std(axis=(0, 1))


def draw(
    model: hj.linear.LDTP, size: float, sensor: np.ndarray, rng: np.random.Generator
) -> hj.experiments.SectionSeries:
    n, left = N * (STRIDES + BEFORE), slice(N * BEFORE, None)
    r, w = rng.normal(size=(2, 1, n, 1))
    e = sensor * rng.normal(size=(1, n, 2))
    u, y = respond(model, r, 0 * e, size * w, e)
    z = np.concatenate([u, r], axis=2)[0, left]
    return hj.experiments.SectionSeries(
        z, y[0, left], n_sections=N, inputs=("u", "r"), outputs=model.outputs
    )


def bound(
    model: hj.linear.LDTP,
    size: float,
    sensor: np.ndarray,
    records: list[hj.experiments.SectionSeries],
) -> float:
    """Of the first multiplier, from the information of the predictions in some records."""
    B = np.concatenate(
        [size * np.asarray(model.B), np.zeros((N, model.A.shape[1], 2))], axis=2
    )
    D = np.tile(np.concatenate([np.zeros((2, 1)), np.diag(sensor)], axis=1), (N, 1, 1))
    noise = hj.linear.LDTP(model.A, B, model.C, D, model.dims, outputs=model.outputs)
    K, S = innovations(PeriodicModel.of(noise, np.ones(2)))
    coordinates = local_coordinates(
        PeriodicModel.of(model, np.ones(2))._replace(K=K), False
    )
    plant = [record for r in records for record in in_loop(r, ("r",))[0]]
    parts = [SeriesPart.of(CycleGrid.from_records([r]), np.ones(2)) for r in plant]
    problem = SeriesProblem(parts, S, True, True, 0)
    c, slopes = characteristic_slopes(coordinates)
    root = slopes @ problem.linearize(coordinates).spread().root * np.sqrt(len(records))
    least = MultiplierEstimate(multipliers_of(c), c, root @ root.T, np.inf)
    return float(least.standard_errors[0])


def parametric(model, size, sensor, rng) -> dict[str, float]:
    data, true = draw(model, size, sensor, rng), np.asarray(model.multipliers)[:1]
    results = {}

    def record(name, fit):
        began = time.process_time()
        fit = fit()
        results[f"{name}.seconds"] = time.process_time() - began
        results[f"{name}.error"] = float(np.abs(fit.multipliers - true).min())
        results[f"{name}.covered"] = float(fit.contains(true).all())

    dims = np.asarray(model.dims)
    record("series", lambda: hj.fit_series(data, 2, check=False, references="r"))
    record("ldtp", lambda: hj.fit_ldtp(data, dims, references="r"))
    alone = hj.experiments.SectionSeries(
        data.u[:, :1], data.y, n_sections=N, inputs="u", outputs=data.outputs
    )
    record("without", lambda: hj.fit_ldtp(alone, dims, noise="innovations"))
    return results


def discs(model, size, sensor, design, truths, rng) -> dict[str, float]:
    """Return the shares of discs of HTFs that hold the truth."""
    both = design.realizations(6, seed=int(rng.integers(1 << 31)))
    z = both.signals(both.periods + BEFORE)
    w, e = (
        rng.normal(size=(*z.shape[:2], 1)),
        sensor * rng.normal(size=(*z.shape[:2], 2)),
    )
    d = sizes(model) * z[..., 1:]
    c = MOTOR * rng.normal(size=w.shape)
    u, y = respond(model, z[..., :1] + c, d, size * w, e)
    inputs = np.concatenate([u, z[..., :1], d], axis=2)
    data = hj.experiments.ExperimentData(
        inputs,
        y,
        n_sections=N,
        periods=both.periods,
        outputs=model.outputs,
        inputs=("u", "r", "d0", "d1"),
    )
    loop = hj.identify.estimate_loop(data, at_input="r", at_output=("d0", "d1"))
    return {
        name: float((np.abs(htf.H - truths[name]) <= htf.confidence_radius()).mean())
        for name, htf in (("plant", loop.plant), ("controller", loop.controller))
    }


def unlike(k: int) -> hj.linear.LDTP:
    """Return the k-th of random plants: 2 to 5 states, 1 or 2 inputs, 8 to 24 sections.

    Every tenth is unstable. All moduli are above 0.3, and the outputs tell all states.
    """
    rng = np.random.default_rng((5, k))
    d, nu, n = (
        int(rng.integers(2, 6)),
        int(rng.integers(1, 3)),
        int(rng.integers(8, 25)),
    )
    size = np.sort(rng.uniform(0.3, 0.9, d))[::-1]
    size[0] = 1.5 if k % 10 == 9 else size[0]
    T = rng.normal(size=(n, d, d)) / 2 + 1.5 * np.eye(d)
    turn = np.linalg.qr(rng.normal(size=(d, d)))[0]
    root = turn @ np.diag(size ** (1 / n)) @ turn.T
    A = [T[(i + 1) % n] @ root @ np.linalg.inv(T[i]) for i in range(n)]
    B, C = rng.normal(size=(n, d, nu)), rng.normal(size=(n, d, d)) / 2 + np.eye(d)
    return hj.linear.LDTP(A, B, C)


def regulator(model: hj.linear.LDTP, weight: float) -> np.ndarray:
    """Return gains of u = -K y that minimize the mean of |x|^2 + weight |u|^2 (Riccati)."""
    A, B, C = (np.asarray(x) for x in (model.A, model.B, model.C))
    P, K = np.eye(A.shape[1]), np.zeros((len(A), B.shape[2], A.shape[1]))
    for n in 40 * list(range(len(A)))[::-1]:
        K[n] = np.linalg.solve(
            weight * np.eye(B.shape[2]) + B[n].T @ P @ B[n], B[n].T @ P @ A[n]
        )
        P = np.eye(len(P)) + A[n].T @ P @ (A[n] - B[n] @ K[n])
    return np.stack([k @ np.linalg.pinv(c) for k, c in zip(K, C, strict=True)])


def in_a_loop(
    model: hj.linear.LDTP,
    gain: np.ndarray,
    rng,
    noise: float,
    strides: int,
    sensor=None,
) -> hj.experiments.SectionSeries:
    """Return a record with a white reference and white noise of process and sensors."""
    sensor = noise / 5 if sensor is None else sensor
    A, B, C = (np.asarray(x) for x in (model.A, model.B, model.C))
    n = len(A) * strides
    r, w = rng.normal(size=(2, n, B.shape[2]))
    x, u, y = np.zeros(A.shape[1]), np.zeros(r.shape), np.zeros((n, C.shape[1]))
    for i in range(n):
        k = i % len(A)
        y[i] = C[k] @ x + sensor * rng.normal(size=y.shape[1])
        u[i] = r[i] - gain[k] @ y[i]
        x = A[k] @ x + B[k] @ (u[i] + noise * w[i])
    names = tuple(f"u{j}" for j in range(r.shape[1])) + tuple(
        f"r{j}" for j in range(r.shape[1])
    )
    return hj.experiments.SectionSeries(
        np.concatenate([u, r], axis=1), y, n_sections=len(A), inputs=names
    )


def random_loops(first: int, count: int) -> dict[str, int]:
    """Count random loops that are identified, refused or reported, and silently wrong."""
    counts = dict.fromkeys(("right", "reported", "wrong", "covered"), 0)
    for k in range(first, first + count):
        model, rng = unlike(k), np.random.default_rng((6, k))
        gain = regulator(model, 10 ** rng.uniform(-1, 2))
        data = in_a_loop(model, gain, rng, 0.5, 400)
        try:
            fit = hj.fit_ldtp(
                data, len(model.multipliers), references=data.inputs[gain.shape[1] :]
            )
        except hj.errors.DefinitionError:
            counts["reported"] += 1
            continue
        right = fit.contains(model.multipliers, 0.9999).all()
        name = (
            "reported"
            if fit.result != hj.errors.Result.OK
            else "right"
            if right
            else "wrong"
        )
        counts[name] += 1
        counts["covered"] += int(fit.contains(model.multipliers).all())
        print(
            f"in_loop.random.{k} {name}: {fit.compare(model.multipliers).max_error:.2g}",
            flush=True,
        )
    return counts


def few_outputs(k: int) -> hj.linear.LDTP:
    """Return the k-th of random plants: 2 to 4 multipliers, some complex, and 1 to 3 outputs."""
    rng = np.random.default_rng((7, k))
    d, nu, n, ny = (
        2 + k % 3,
        *(int(rng.integers(*x)) for x in ((1, 3), (4, 13), (1, 4))),
    )
    root, i = np.zeros((d, d)), 0
    while i < d:
        pair, size = i + 1 < d and rng.random() < 0.5, rng.uniform(0.3, 0.9) ** (1 / n)
        z = size * np.exp(1j * pair * rng.uniform(0.2, np.pi - 0.2) / n)
        part = np.array([[z.real, -z.imag], [z.imag, z.real]])[: 1 + pair, : 1 + pair]
        root[i : i + len(part), i : i + len(part)], i = part, i + len(part)
    T = rng.normal(size=(n, d, d)) / 2 + 1.5 * np.eye(d)
    turn = np.linalg.qr(rng.normal(size=(d, d)))[0]
    A = [T[(i + 1) % n] @ turn @ root @ turn.T @ np.linalg.inv(T[i]) for i in range(n)]
    return hj.linear.LDTP(A, rng.normal(size=(n, d, nu)), rng.normal(size=(n, ny, d)))


def noisy(
    model: hj.linear.LDTP, kind: str, rng
) -> tuple[hj.experiments.SectionSeries, tuple[str, ...] | None]:
    """Return 300 cycles of a random plant, and the names of its references."""
    (N, ny, _), nu = model.C.shape, model.B.shape[2]
    gain = rng.normal(size=(N, nu, ny)) * (kind == "loop")
    while np.abs(model.feedback(gain).multipliers).max() > 0.9:
        gain = gain / 1.5
    sensor, process = rng.choice([0.003, 0.03, 0.1, 0.3]), rng.choice([0.0, 0.1, 0.5])
    size = in_a_loop(model, gain, np.random.default_rng(0), 0.0, 300).y.std(axis=0)
    data = in_a_loop(model, gain, rng, process, 300, sensor * size)
    if kind == "loop":
        return data, data.inputs[nu:]
    x = data.y / size
    bent = 10 ** rng.uniform(-2, -0.5) * (0.7 * x**2 + 0.3 * x**3) * (kind == "bent")
    drift = np.inf if kind == "bent" else None  # (even powers have a mean)
    return hj.experiments.SectionSeries(
        data.u[:, :nu], data.y + size * bent, n_sections=N, drift=drift
    ), None


def bent_hopper(count: int, seed: int) -> list[hj.experiments.SectionSeries]:
    """Return 300 strides each, at amplitudes at which half a percent to half is distortion."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    phase = hj.ClockPhase(N, anchor=hj.Crossing("vM", "falling"))
    rng = np.random.default_rng((9, seed))
    u = rng.normal(size=(count, STRIDES * N, 1)) * 10 ** rng.uniform(
        -3, -1.5, (count, 1, 1)
    )
    data = hj.run_experiments(cycle, phase, u, ("yM", "vM"), start="cycle", discard=0)
    y = data.y + 0.01 * data.y.std(axis=1, keepdims=True) * rng.normal(
        size=data.y.shape
    )
    return [
        hj.experiments.SectionSeries(u[k], y[k], n_sections=N)
        for k in np.flatnonzero(data.ok)
    ]


def too_low(first: int, count: int) -> None:
    """Print how often orders that are too low are noticed, and right ones doubted."""
    cases = [
        (kind, few_outputs(k), k)
        for kind in ("open", "bent", "loop")
        for k in range(first, first + count)
    ]
    draws = [
        (
            kind,
            np.asarray(model.multipliers),
            *noisy(model, kind, np.random.default_rng((10, k))),
        )
        for kind, model, k in cases
    ]
    true = np.asarray(hopper().multipliers)
    draws += [("hopper", true, data, None) for data in bent_hopper(count, first)]
    counts: dict[str, Counter] = defaultdict(Counter)
    seconds = defaultdict(lambda: np.zeros(2))
    for kind, true, data, reference in draws:
        for order in range(2, len(true) + 1):
            try:
                began = time.process_time()
                fit = hj.fit_series(data, order, references=reference)
                whole = time.process_time() - began
                with (
                    mock.patch.object(series_fit, "order_doubts", lambda *_: []),
                    mock.patch.object(series_fit, "_about_drift", lambda *_: []),
                ):
                    began = time.process_time()
                    hj.fit_series(data, order, references=reference)
                    seconds[kind] += [whole, time.process_time() - began]
            except hj.errors.DefinitionError:
                continue
            error = (
                np.abs(fit.multipliers[:, None] - true).min(axis=1)
                / fit.standard_errors
            )
            name = (
                "right"
                if order == len(true)
                else "wrong"
                if error.max() > 5
                else "near"
            )
            counts[kind].update({name: 1, f"{name}.doubted": int(bool(fit.findings))})
    for kind, values in counts.items():
        for name, value in values.items():
            print(f"in_loop.orders.{kind}.{name} {value}", flush=True)
        print(
            f"in_loop.orders.{kind}.seconds {seconds[kind][0] / seconds[kind][1]:.3g}"
        )


def recording_seconds(rate: int = 100, strides: int = 300) -> dict[str, float]:
    """Return CPU seconds of `identify_recording`: of a plant in its loop by the reference, and of
    the loop itself, from the reference as its input (the least of three calls)."""
    n, r = (
        strides * rate,
        hj.experiments.random_input(strides + 1, rate, 8.0, seed=1)[:, 0],
    )
    t, x, u, y = np.arange(n) / rate, np.zeros(2), np.zeros(n), np.zeros((2, n))
    noise = np.random.default_rng(0).normal(size=(2, n))
    for i in range(n):  # x'' + 2 x' + (30 + 8 cos 2 pi t) x = u
        y[:, i] = x + np.array([0.002, 0.01]) * noise[:, i]
        u[i] = r[i] - 4 * y[0, i] - y[1, i]
        v = x[1] + (u[i] - 2 * x[1] - (30 + 8 * np.cos(2 * np.pi * t[i])) * x[0]) / rate
        x = np.array([x[0] + v / rate, v])
    signals = {"u": u, "r": r[:n], "x": y[0], "v": y[1], "clock": np.cos(2 * np.pi * t)}
    recording, section = hj.Recording(t, signals), hj.Crossing("clock", "rising")
    ways = {"with": dict(inputs="u", references="r"), "without": dict(inputs="r")}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for name, way in 3 * list(ways.items()):
        began = time.process_time()
        with warnings.catch_warnings(action="ignore"):
            hj.identify_recording(
                recording, section, outputs=("x", "v"), n_sections=16, **way
            )
        seconds[name].append(time.process_time() - began)
    least = {name: min(values) for name, values in seconds.items()}
    return least | {"ratio": least["with"] / least["without"]}


def short_gait() -> dict[str, float]:
    """Identify the unstable gait of the simplest walker, which a regulator stabilizes.

    Return errors of the multiplier 4.00386436, from HTFs and time series without noise, and with
    sensor noise of a thousandth of the outputs (`noisy`).
    """
    walker = hj.models.SimplestWalker()
    strike, outputs = hj.AtEvent("heelstrike"), ("phi", "w", "p")
    cycle = hj.find_limit_cycle(walker, walker.short_gait(), section=strike)
    levels = [hj.Crossing("th", "falling", th) for th in (0.1, 0.0, -0.1)]
    phase = hj.sections.SectionList([strike, *levels])
    exact = hj.linearize(cycle, phase, outputs)
    model = realized(np.asarray(exact.impulse_response(40)))
    design = hj.multisine(
        4, periods=8, frequencies=(0, 2), amplitude=1e-6
    ).realizations(3)
    data = hj.run_experiments(
        cycle, phase, design, outputs, feedback=regulator(model, 1.0), discard=30
    )
    htf = hj.estimate_htf(data, references="r")
    noisy = hj.experiments.add_noise(data, std=0.001 * data.y.std(axis=(0, 1)), seed=1)
    fits = {
        "htf": hj.fit_multipliers(htf, 2, check=False),
        "series": hj.fit_series(data, 2, references="r"),
        "ldtp": hj.fit_ldtp(data, model.dims, references="r"),
        "ldtp.noisy": hj.fit_ldtp(noisy, model.dims, references="r"),
    }
    return {
        x: float(fit.compare(cycle.multipliers).max_error) for x, fit in fits.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument(
        "--size", type=float, default=1.0, help="of process noise, relative to r"
    )
    parser.add_argument(
        "--random",
        type=int,
        default=0,
        help="only the short gait, and so many random loops",
    )
    parser.add_argument(
        "--first", type=int, default=0, help="seed of the first draw or loop"
    )
    parser.add_argument(
        "--orders",
        type=int,
        default=0,
        help="only orders that are too low, of so many plants",
    )
    options = parser.parse_args()
    hj.enable_x64()
    if options.orders:
        return too_low(options.first, options.orders)
    model, rng, draws = hopper(), np.random.default_rng(0), options.draws
    sensor = SENSOR * sizes(model)
    if options.random:
        for name, error in short_gait().items():
            print(f"in_loop.short_gait.{name} {error:.2g}")
        for name, seconds in recording_seconds().items():
            print(f"in_loop.recording.{name} {seconds:.3g}")
        for name, count in random_loops(options.first, options.random).items():
            print(f"in_loop.random.{name} {count}")
        return
    show = lambda what, value: print(f"in_loop.{what} {value:.4g}", flush=True)  # noqa: E731

    records = [draw(model, options.size, sensor, rng) for _ in range(10)]
    least = bound(model, options.size, sensor, records)
    show("bound", least)
    found: dict[str, list[float]] = {}
    for k in range(options.first, options.first + draws):
        one = parametric(model, options.size, sensor, np.random.default_rng((1, k)))
        for name, value in one.items():
            found.setdefault(name, []).append(value)
    for name in ("series", "ldtp", "without"):
        covered, error = (np.array(found[f"{name}.{x}"]) for x in ("covered", "error"))
        rms = np.sqrt((error**2).mean())
        show(f"{name}.rms", rms)
        show(f"{name}.ratio", rms / least)
        show(f"{name}.draws", len(covered))
        show(f"{name}.covered", covered.mean())
        show(
            f"{name}.p", stats.binomtest(int(covered.sum()), len(covered), 0.95).pvalue
        )
        show(f"{name}.seconds", np.median(found[f"{name}.seconds"]))
    design = hj.multisine(
        N,
        8,
        frequencies=(0, N / 2),
        inputs=3,
        division="orthogonal",
        amplitude=1.0,
        seed=1,
    )
    gain = hj.linear.LDTP(
        np.zeros((N, 1, 1)),
        np.zeros((N, 1, 2)),
        np.zeros((N, 1, 1)),
        np.tile(GAIN, (N, 1, 1)),
    )
    f = np.unique(design.line) / design.periods
    truths = {"plant": model.htf(f).H, "controller": gain.htf(f).H}
    shares = [
        discs(
            model, options.size, sensor, design, truths, np.random.default_rng((2, k))
        )
        for k in range(options.first, options.first + draws)
    ]
    for name in truths:
        share = np.array([x[name] for x in shares])
        show(f"{name}.covered", share.mean())
        show(f"{name}.p", stats.ttest_1samp(share, 0.95).pvalue)


if __name__ == "__main__":
    main()
