"""Real recordings (notebooks/data): the numbers of docs/real-data.md.

python benchmarks/recordings.py real
"""

import pathlib
import time

import equinox as eqx
import numpy as np
from scipy import stats

import hybridjax as hj
from hybridjax.recordings.beats.estimation import WAVES, fit_curve
from hybridjax.recordings.beats.model import basis, intervals_of


DATA = pathlib.Path(__file__).parents[1] / "notebooks/data"
STRIDES = (39, 40)  # of the two segments of walking that the simulations imitate


def neuron(cell, every=1):
    """Spikes under a sine current, one trial for each frequency, and the published curve."""
    a = np.load(DATA / "pacemaker_neurons.npz")
    edges = np.cumsum(a[f"cell{cell}_counts"], dtype=int)[:-1]
    t, trials = np.arange(0, 10.0002, 2e-4), []
    for k, steps in enumerate(np.split(a[f"cell{cell}_steps"], edges)):
        spikes, f = np.cumsum(steps, dtype=int) / 1e4, k + 1
        current = 20 * np.sin(2 * np.pi * f * t)
        if k % every == 0:
            about = dict(
                events={"spike": spikes}, units={"current": "pA"}, name=f"{f} Hz"
            )
            trials.append(hj.Recording(t, {"current": current}, **about))
    places = np.arange(200) / 200
    curve = np.interp(
        places, a["published_phase"], a[f"cell{cell}_published"], period=1
    )
    return hj.Recording.join(trials), curve


def robot():
    """Twelve runs of five strides; a stride begins when the outer leg becomes the stance leg."""
    a, runs = np.load(DATA / "compass_gait_robot.npz"), []
    for run in np.unique(a["run"]):
        rows = a["run"] == run
        t, outer = a["time"][rows], a["outer"][rows].astype(int)
        begins = t[np.flatnonzero(np.diff(outer, prepend=1 - outer[0]) > 0)]
        steps = t[np.flatnonzero(np.diff(outer, prepend=1 - outer[0]))]
        signals = {
            name: a[name][rows].astype(float) for name in ("voltage", "hip", "stance")
        }
        units = {"voltage": "V", "hip": "rad", "stance": "rad"}
        events = {"stride": np.append(begins, t[-1]), "step": np.append(steps, t[-1])}
        runs.append(
            hj.Recording(t, signals, events=events, units=units, name=f"run {run}")
        )
    return hj.Recording.join(runs)


def walking():
    """Both segments of the treadmill; a stride begins at a strike of the left heel."""
    a, trials = np.load(DATA / "human_walk.npz"), []
    for s, (first, last) in enumerate([(6, 61), (1, 54)]):
        t, left = a[f"time{s}"].astype(float), a[f"left{s}"]
        rows = (t >= first) & (t <= last)
        angles = np.where(a[f"gap{s}"][:, None], np.nan, a[f"angles{s}"])[rows].astype(
            float
        )
        signals = dict(zip(map(str, a["names"]), angles.T, strict=True))
        events = {"strike": left[(left >= first) & (left <= last)]}
        units = dict.fromkeys(signals, "rad")
        trials.append(
            hj.Recording(
                t[rows], signals, events=events, units=units, name=f"segment {s}"
            )
        )
    return hj.Recording.join(trials)


def plain_curve(recording, phase, name):
    """The curve by regression of durations on the input at phases that grow linearly from event to
    event, as smooth as that of `phase_response`.

    An interval that ends late has other regressors than it would have had: they contain its noise,
    so that the curve is biased.
    """
    intervals = intervals_of(recording, phase, name)
    fit = fit_curve(intervals, WAVES, fit_curve(intervals, 0))
    across = np.zeros((len(intervals.start), WAVES + 1))
    for k, u in enumerate(intervals.inputs):
        phase = k * intervals.step / 2 / intervals.duration
        acting = np.where(phase < 1, u, 0.0) * intervals.step / 2
        across += acting[:, None] * basis(phase, WAVES)
    # In cycles, as errors of `phase_response` are.
    across *= -1.0 * fit.used[:, None]
    duration = intervals.duration * fit.rates[intervals.trial]
    count = np.maximum(intervals.sums(1.0 * fit.used), 1.0)
    both = np.column_stack([across, duration * fit.used])
    mean = np.stack([intervals.sums(x) for x in both.T], axis=1) / count[:, None]
    both -= mean[intervals.trial] * fit.used[:, None]
    across, deviation = both[:, :-1], both[:, -1]
    # The penalty of the fit stands beside whitened errors, whose variance is `noise`.
    variance = fit.missed[fit.used].var() * fit.smoothness.excess
    penalty = fit.penalty * variance / fit.smoothness.noise
    a = np.linalg.lstsq(across.T @ across + np.diag(penalty), across.T @ deviation)[0]
    return basis(np.arange(200) / 200, WAVES) @ a


def neurons(every=2):
    for cell in (8, 6):
        recording, published = neuron(cell, every)
        phase = hj.recordings.estimate_phase(recording, hj.AtEvent("spike"))
        print(f"\nNeuron {cell}: {phase}")
        start = time.process_time()
        found = hj.recordings.phase_response(recording, phase, input="current")
        print(found, f"({time.process_time() - start:.0f} CPU s)", sep="\n")
        at = np.array([0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95])
        low, high = found.interval(at)
        place, linear = (at * 200).astype(int), plain_curve(recording, phase, "current")
        rows = zip(
            at, found(at), low, high, published[place], linear[place], strict=True
        )
        for x, z, a, b, other, plain in rows:
            print(
                f"  Z({x:.2f}) = {z:.2f} [{a:.2f}, {b:.2f}], published {other:.2f}, "
                f"plain {plain:.2f}"
            )
        low, high = found.interval(found.phase)
        held, (own, plain) = (
            (low <= published) & (published <= high),
            (np.sqrt(np.mean((x - published) ** 2)) for x in (found.values, linear)),
        )
        print(
            f"the published curve is in the band at {100 * held.mean():.0f} % of the phases; rms "
            f"difference {own:.2f}, of plain regression {plain:.2f}"
        )
        print(
            f"R2 of intervals left out: {found.left_out:.3f}; flat: {found.left_out_flat:.3f}"
        )
        both, _ = neuron(cell)
        others = tuple(x for k, x in enumerate(both.trials) if k % every)
        left_out = eqx.tree_at(lambda r: r.trials, both, others)
        ahead = found.forecast(left_out, hj.AtEvent("spike"))
        print(f"R2 of the trials that were not fitted: {ahead.explained:.3f}")
        for first, last in ((0, 5), (10, 20), (40, 70)):
            some = eqx.tree_at(lambda r: r.trials, both, both.trials[first:last])
            part = hj.recordings.phase_response(
                some, hj.AtEvent("spike"), input="current"
            )
            error = np.sqrt(part.covariance[0, 0])
            print(
                f"mean of Z, {first + 1} to {last} Hz: {part.coefficients[0]:.3f} ± {error:.3f}"
            )


def robots():
    recording = robot()
    print("\nRobot:", hj.recordings.estimate_phase(recording, hj.AtEvent("stride")))
    steps = [np.diff(t.events["step"]) for t in recording.trials]
    sizes, within, dof = [], 0.0, 0
    for duration in steps:  # a line and an alternation, which is that of the legs
        k = np.arange(len(duration))
        columns = np.stack([np.ones(len(k)), k, (-1.0) ** k], axis=1)
        fit, left, *_ = np.linalg.lstsq(columns, duration)
        sizes.append(2 * fit[2])
        within += float(left[0])
        dof += len(k) - 3
    spread = np.sqrt(within / dof)
    ratio = (
        np.mean([len(d) * (x / 2) ** 2 for d, x in zip(steps, sizes, strict=True)])
        / spread**2
    )
    rms, low, high = 1000 * np.array(
        [np.sqrt(np.mean(np.square(sizes))), min(sizes), max(sizes)]
    )
    print(
        f"alternate steps differ by {rms:.0f} ms (rms over runs; from {low:.0f} to {high:.0f}), "
        f"steps of a leg scatter by {1000 * spread:.0f} ms: F = {ratio:.0f} of {len(steps)} and "
        f"{dof} degrees of freedom, p = {stats.f.sf(ratio, len(steps), dof):.1g}"
    )
    phase = hj.recordings.estimate_phase(recording, hj.AtEvent("stride"))
    data = hj.recordings.sample_sections(
        recording,
        phase,
        inputs="voltage",
        outputs=("hip", "stance"),
        n_sections=5,
        bandwidth=np.inf,
    )
    looked = hj.recordings.check_recording(
        recording, inputs=data.inputs, outputs=data.outputs, phase=phase, data=data
    )
    print(data, looked, sep="\n")
    try:
        hj.recordings.hold_out(data, 1)
    except hj.errors.DefinitionError as error:
        print("to hold a quarter out:", error)
    try:
        hj.fit_series(data, 1, check=False)
    except hj.errors.DefinitionError as error:
        print("to fit all of it:", error)
    data = hj.recordings.sample_sections(
        recording,
        phase,
        inputs=(),
        outputs=("hip", "stance"),
        n_sections=7,
        bandwidth=np.inf,
    )
    print(
        "The closed loop, its input a part of it:",
        hj.recordings.natural_multipliers(data, 1),
    )


def robot_layout(seeds=40, multiplier=0.6):
    """Twelve records of five cycles with four sections, as the robot's."""
    print(f"\nThe robot's layout, simulated: multiplier {multiplier}, {seeds} draws")
    model = linear_rhythm((multiplier,), 4, 2)
    for label, gain in (("input given", 0.0), ("feedback", 0.6)):

        def one(rng, gain=gain):
            records = [in_loop(model, 5, gain, rng) for _ in range(12)]
            fit = hj.fit_series(records, 1, check=False)
            return {
                "held": int(fit.contains([multiplier])[0]),
                "value": float(fit.multipliers[0].real),
                "width": float(np.abs(fit.ellipse(0) - fit.multipliers[0]).max()),
            }

        found = hj.scale.monte_carlo(one, seeds)
        off = found.value.values - multiplier
        print(
            f"{label:12s} mean {found.value.values.mean():.3f}, rms error "
            f"{np.sqrt(np.mean(off**2)):.3f}, median half-width "
            f"{np.median(found.width):.3f}, held in {int(found.held.sum())}/{seeds}",
            flush=True,
        )


def linear_rhythm(multipliers, n_sections, outputs, seed=5):
    """Blocks A[n], C[n] of a random linear system with these multipliers; an input acts on all."""
    rng, d = np.random.default_rng(seed), len(multipliers)
    A = [np.linalg.qr(rng.normal(size=(d, d)))[0] for _ in range(n_sections - 1)]
    turn = rng.normal(size=(d, d)) + 2 * np.eye(d)
    rest = np.linalg.multi_dot([np.eye(d), *A[::-1], turn])
    A.append(turn @ np.diag(multipliers) @ np.linalg.inv(rest))
    return A, rng.normal(size=(n_sections, outputs, d))


def in_loop(model, cycles, gain, rng, noise=0.3):
    """A record whose input is white, or also answers the outputs; process and output noise."""
    A, C = model
    N, d = len(A), len(A[0])
    x, u, y = rng.normal(size=d), [], []
    for n in range((cycles + 10) * N):
        y.append(C[n % N] @ x)
        u.append([rng.normal() - gain * y[-1][0]])
        x = A[n % N] @ x + u[-1][0] + 0.5 * rng.normal(size=d)
    u, y = np.array(u[10 * N :]), np.array(y[10 * N :])
    y = y + noise * rng.normal(size=y.shape)
    return hj.experiments.SectionSeries(u, y, n_sections=N, drift=np.inf)


def variability():
    recording = walking()
    phase = hj.recordings.estimate_phase(recording, hj.AtEvent("strike"))
    print(f"\nWalking: {phase}")
    for trial, periods in zip(recording.trials, phase.periods, strict=True):
        print(
            f"  {trial.name}: {len(periods)} strides of {periods.mean():.3f} s, "
            f"standard deviation {periods.std(ddof=1):.3f} s"
        )
    for n_sections in (8, 16, 32):
        data = hj.recordings.sample_sections(
            recording,
            phase,
            inputs=(),
            outputs=recording.signals,
            n_sections=n_sections,
        )
        for order in (1, 2, 3):
            found = hj.recordings.natural_multipliers(data, order)
            print(f"{n_sections} sections: {found}", flush=True)


def walking_layout(seeds=100, multipliers=(0.6, 0.3), n_sections=16, outputs=6):
    """Records as long as the segments, of a system whose multipliers are known."""
    print(
        f"\nThe layout of walking, simulated: multipliers {multipliers}, {seeds} draws"
    )
    model = linear_rhythm(multipliers, n_sections, outputs)
    for noise in (0.0, 0.3, 0.5):

        def one(rng, noise=noise):
            found = hj.recordings.natural_multipliers(
                variable(model, STRIDES, noise, rng), len(multipliers)
            )
            modulus = np.stack([np.abs(found.multipliers), np.abs(found.plain)])
            low, high = np.moveaxis(
                [found.interval(), found.interval(plain=True)], 2, 0
            )
            held = (low <= np.array(multipliers)) & (np.array(multipliers) <= high)
            return {"modulus": modulus, "held": held.astype(float)}

        mean = hj.scale.monte_carlo(one, seeds).mean("draw")
        modulus, held = mean.modulus.values[:, 0], 100 * mean.held.values
        print(
            f"noise of {noise:.1f} of each output: by instruments {modulus[0]:.3f}, held in "
            f"{held[0, 0]:.1f} % (the second in {held[0, 1]:.1f} %); least squares "
            f"{modulus[1]:.3f}, held in {held[1, 0]:.1f} %",
            flush=True,
        )


def variable(model, strides, noise, rng):
    """Section data of a linear system that white noise disturbs at every section."""
    A, C = model
    N, trials = len(A), []
    for count in strides:
        x, y = np.zeros(len(A[0])), []
        for n in range((count + 20) * N):
            y.append(C[n % N] @ x)
            x = A[n % N] @ x + rng.normal(size=len(x))
        y = np.array(y[20 * N :])
        y += noise * y.std(axis=0) * rng.normal(size=y.shape)
        t = np.arange(len(y)) / N
        names = {f"y{i}": column for i, column in enumerate(y.T)}
        events = {"strike": np.arange(count) * 1.0}
        trials.append(
            hj.Recording(t, names, events=events, name=f"trial {len(trials)}")
        )
    recording = hj.Recording.join(trials)
    return hj.recordings.sample_sections(
        recording,
        hj.AtEvent("strike"),
        inputs=(),
        outputs=recording.signals,
        n_sections=N,
        bandwidth=np.inf,
    )


def phase_model(seeds=10, seconds=3, trials=20):
    """Coverage of the 95 % bands of phase response curves that are known."""
    x, at = np.arange(400) / 400, np.linspace(0.025, 0.975, 20)
    smooth = 1 - 0.45 * np.cos(2 * np.pi * x) + 0.15 * np.sin(2 * np.pi * x)
    smooth -= 0.25 * np.cos(4 * np.pi * x)
    t = np.arange(0, seconds + 5e-4, 1 / 2000)
    print(f"\nPhase model, simulated: {trials} trials of {seconds} s, {seeds} draws")
    for label, true, jitter in (
        ("sines of 3 to 97 Hz, smooth curve", smooth, 0.05),
        ("noise up to 100 Hz, smooth curve", smooth, 0.08),
        ("sines of 3 to 97 Hz, smooth curve", smooth, 0.1),
        ("sines of 3 to 97 Hz, a curve that jumps", 0.2 + 1.6 * x, 0.05),
        ("noise up to 100 Hz, a curve that jumps", 0.2 + 1.6 * x, 0.08),
    ):

        def one(rng, label=label, true=true, jitter=jitter):
            seed = int(rng.integers(2**31 - trials))
            force = 20 * np.sin(2 * np.pi * np.linspace(3, 97, trials)[:, None] * t)
            if "noise" in label:
                force = np.stack(
                    [
                        hj.experiments.random_input(
                            seconds, 2000, 100, rms=15, seed=seed + k
                        )[:, 0]
                        for k in range(trials)
                    ]
                )
                force = np.pad(force, ((0, 0), (0, 1)), mode="edge")
            rhythm = (45 + 10 * rng.uniform(size=trials)).tolist()
            made = hj.testing.simulate_beats(
                true, force, rate=2000, rhythm=rhythm, jitter=jitter, seed=seed
            )
            found = hj.recordings.phase_response(made, hj.AtEvent("beat"), input="u")
            low, high = found.interval(at)
            truth = np.interp(at, x, true)
            phase = hj.recordings.estimate_phase(made, hj.AtEvent("beat"))
            plain = np.interp(at, found.phase, plain_curve(made, phase, "u"))
            return {
                "held": ((low <= truth) & (truth <= high)).astype(float),
                "off": np.stack([found(at), plain]) - truth,
                "detail": found.detail,
                "excess": found.excess,
            }

        found = hj.scale.monte_carlo(one, seeds)
        off = found.off.values
        rms, bias = (
            np.sqrt(np.mean(off**2, axis=(0, 2))),
            np.abs(off.mean(axis=0)).max(axis=1),
        )
        print(
            f"{label}, jitter {jitter:g}: held {100 * found.held.values.mean():.1f} % of the time; "
            f"bias up to {bias[0]:.3f}, rms error {rms[0]:.3f} (plain regression {bias[1]:.3f}, "
            f"{rms[1]:.3f}); detail {found.detail.values.mean():.1f}, excess "
            f"{found.excess.values.mean():.2f}",
            flush=True,
        )


def real():
    for part in (
        neurons,
        robots,
        robot_layout,
        variability,
        walking_layout,
        phase_model,
    ):
        part()
