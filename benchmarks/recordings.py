"""Recordings to multipliers: errors, dirt, mishaps, spikes, coverage, a walker, cost.

python benchmarks/recordings.py [errors] [dirt] [mishaps] [spikes] [walker] [size] [bag] [coverage]
[quiet] [short] [real]

does all of these by default. The systems are simulated and their multipliers known. Beside
`fit_series` stands plain ARX: least squares on the same section data.
"""

import itertools
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import equinox as eqx
import numpy as np
from dirty_recordings import MORE, MORE_EVENTS
from real_recordings import real  # noqa: F401 (called by its name)
from scipy import stats

import hybridjax as hj
from hybridjax.recordings.sampling import without_drift
from hybridjax.testing import add_artifacts


sys.path.append(str(Path(__file__).parents[1] / "tests/recordings"))
from mishaps import (
    EVENT_MISHAPS,
    MISHAPS,
    mishandle,
    misjudged,
    signals as change_signals,  # noqa: E402
)


N_SECTIONS = 32
APEX = hj.AtEvent("apex")
PHASES = ("apex", "angle")
RATE, BANDWIDTH, RMS = 500, 8.0, 0.0205  # Hz, Hz, N: outputs deviate by 9.7e-4 m (rms)
NOISES = (1e-4, 1e-3)
# Causes of warnings that clean recordings have too.
HINTS = {"band", "outputs", "left over"}


def hopper(strides, seeds):
    """Recordings of the paper's hopper, one for each seed, and its multipliers."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    u = [
        hj.experiments.random_input(strides, RATE, BANDWIDTH, rms=RMS, seed=seed)
        for seed in seeds
    ]
    both = hj.testing.simulate_recording(
        cycle, np.stack(u), ("yM", "vM"), rate=RATE, steps=1
    )
    return [
        eqx.tree_at(lambda r: r.trials, both, (t,)) for t in both.trials
    ], cycle.multipliers


def noisy(recording, noise, seed):
    """With white noise, in which the apex of each stride is marked."""
    dirty = add_artifacts(recording, ("yM", "vM"), noise=noise, seed=seed)
    return dirty.mark("apex", hj.Crossing("vM", "falling"), bandwidth=16)


def phase_of(name, n_sections=N_SECTIONS):
    """From apex to apex, or the angle of position and velocity."""
    if name == "apex":
        return APEX
    return hj.KinematicPhase(
        n_sections, position="yM", velocity="vM", center=(1.9, 0.0), scale=(0.3, 1.9)
    )


def start_of(recording, strides):
    def cut(t):
        rows = t.time < strides
        events = {k: v[v < strides] for k, v in t.events.items()}
        parts = (t.time[rows], t.values[rows], events)
        return eqx.tree_at(lambda t: (t.time, t.values, t.events), t, parts)

    return eqx.tree_at(lambda r: r.trials, recording, tuple(map(cut, recording.trials)))


def at_sections(recording, name, n_sections=N_SECTIONS):
    about = {"inputs": "u", "outputs": ("yM", "vM"), "n_sections": n_sections}
    return hj.recordings.sample_sections(recording, phase_of(name, n_sections), **about)


def distance(multipliers, true):
    return np.abs(multipliers - true).max()


def errors(seeds=10):
    print(
        f"\nHopper, {RATE} Hz, force of {BANDWIDTH:g} Hz and rms {RMS} N; {seeds} seeds"
    )
    recordings, true = hopper(1000, range(seeds))
    print("phase  strides  noise    rms error  (median)   said     plain ARX, rms")
    for name, strides, noise in itertools.product(PHASES, (1000, 300), NOISES):
        found, said, plain = [], [], []
        for seed, recording in enumerate(recordings):
            dirty = noisy(start_of(recording, strides), noise, seed)
            data = at_sections(dirty, name)
            fit = hj.fit_series(data.records, 2, check=False)
            found.append(distance(fit.multipliers, true))
            said.append(fit.standard_errors[0])
            plain.append(distance(hj.recordings.diagnose(data, fit).plain, true))
        row = [rms(found), np.median(found), rms(said), rms(plain)]
        row = "  ".join(f"{x:9.1e}" for x in row)
        print(f"{name:5s}  {strides:7d}  {noise:6.0e}  {row}", flush=True)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def coverage(
    draws=400, strides=300, noise=1e-4, chunk=50, n_sections=16, phases=PHASES
):
    print(
        f"\nCoverage of 95 % regions: {draws} draws, {strides} strides, {n_sections} sections, "
        f"noise {noise:g}"
    )

    def some(rng):
        """So many recordings, simulated side by side."""
        recordings, true = hopper(strides, rng.integers(2**31, size=chunk).tolist())
        seeds = rng.integers(2**31, size=chunk).tolist()
        dirty = [
            noisy(r, noise, seed) for r, seed in zip(recordings, seeds, strict=True)
        ]
        return {
            name: [
                found_in(at_sections(d, name, n_sections).records, true) for d in dirty
            ]
            for name in phases
        }

    found = hj.scale.monte_carlo(some, draws // chunk)
    for name in phases:
        print(
            f"{name}: {tally(found[name].values.reshape(draws, 3, -1)[..., 0])}",
            flush=True,
        )


def quiet(draws=200):
    """Next to no noise: distortion is the misfit."""
    coverage(draws, noise=0.0, n_sections=N_SECTIONS, phases=PHASES)
    walks("van der Pol", *oscillator(), draws, 100, 5, 1e-4)


def short(draws=40):
    """Few strides for many lags, and no noise: distortion is the misfit."""
    coverage(draws, strides=120, noise=0.0, chunk=20, phases=("apex",))


def found_in(records, true):
    """Of each multiplier whether its region holds it, the error, and the standard error (3, d)."""
    fit = hj.fit_series(records, len(true), check=False)
    return np.stack([fit.contains(true), fit.compare(true).error, fit.standard_errors])


def tally(found):
    """Of one multiplier, for all draws (n, 3): how often it was held, and the errors."""
    hits, n = int(found[:, 0].sum()), len(found)
    p = stats.binomtest(hits, n, 0.95).pvalue
    error, said = rms(found[:, 1]), rms(found[:, 2])
    return (
        f"{hits} of {n} ({100 * hits / n:.1f} %), p = {p:.2g}; rms error {error:.1e}, said "
        f"{said:.1e}, {said / error:.2f} of it"
    )


def dirt(seeds=5, strides=500, noise=1e-4):
    print(f"\nDirt: hopper, {strides} strides, noise {noise:g}, {seeds} seeds")
    recordings, true = hopper(strides, range(seeds))
    gap = (strides / 2, strides / 2 + 20)
    poor, third = {"missing": 0.01, "gap": gap}, "a third of the samples not there"
    sine = change_signals(
        "y",
        lambda x, s: x + 5e-3 * np.sin(2 * np.pi * s.trial.time / np.ptp(s.trial.time)),
    )
    cases = {  # phase, how it is spoiled, mishap, drift
        "clean": ("angle", {}, None, None),
        "1 % of samples lost, gap of 20 strides": ("angle", poor, None, None),
        "the same, a third not there": ("angle", poor, third, None),
        "the same, rounded to 1e-4": ("angle", poor | {"quantum": 1e-4}, third, None),
        "drift of 5e-3, removed": ("angle", {}, sine, 50),
        "period that grows by 5 %": ("angle", {}, "clock slows down", None),
        "cycles from apex to apex, clean": ("apex", {}, None, None),
        "1 % lost, gap, 5 events lost, 5 doubled": (
            "apex",
            poor,
            misjudged(lost=0.01, doubled=0.01),
            None,
        ),
    }
    for label, (name, spoiled, mishap, drift) in cases.items():
        found, said, hits = [], [], 0
        for seed, recording in enumerate(recordings):
            if name == "apex":
                dirty = noisy(recording, noise, seed)
                dirty = add_artifacts(dirty, ("yM", "vM"), seed=seed, **spoiled)
            else:
                dirty = add_artifacts(
                    recording, ("yM", "vM"), noise=noise, seed=seed, **spoiled
                )
            if mishap is not None:
                names = {"input": "u", "outputs": ("yM", "vM"), "event": "apex"}
                dirty = mishandle(dirty, mishap, seed=seed, **names)
            if drift is not None:
                rough = hj.recordings.estimate_phase(dirty, phase_of(name))
                dirty = without_drift(dirty, rough, ("yM", "vM"), drift)
            data = at_sections(dirty, name)
            data = data if drift is None else data.with_drift(drift)
            fit = hj.fit_series(data.records, 2, check=False)
            found.append(distance(fit.multipliers, true))
            said.append(fit.standard_errors[0])
            hits += bool(fit.contains(true[:1])[0])
        print(
            f"{label:42s} rms error {rms(found):.1e}, said {rms(said):.1e}, region holds the truth "
            f"{hits}/{seeds}",
            flush=True,
        )


def mishaps(seeds=3, trials=4, strides=75, rate=128, noise=1e-4, n_sections=16):
    """Whether each is right, refused, or named; a table for docs/recordings.md."""
    print(
        f"\n{trials} trials of {strides} strides at {rate} Hz, noise {noise:g}, {n_sections} "
        f"sections; {seeds} seeds\n"
    )
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    force = [
        hj.experiments.random_input(strides, rate, BANDWIDTH, rms=RMS, seed=k)
        for k in range(seeds * trials)
    ]
    made = hj.testing.simulate_recording(
        cycle, np.stack(force), ("yM", "vM"), rate=rate, steps=1
    )
    names = {"input": "u", "outputs": ("yM", "vM"), "event": "apex"}
    verdicts = []
    print(
        "| mishap | rms error | said | verdict | what is said |\n|---|---|---|---|---|"
    )
    of_events = EVENT_MISHAPS | MORE_EVENTS
    every = MISHAPS | MORE | of_events
    for kind in ["none", *every]:
        found, said, verdict, causes = [], [], [], {}
        for seed in range(seeds):
            own = made.trials[seed * trials : (seed + 1) * trials]
            one = noisy(eqx.tree_at(lambda r: r.trials, made, own), noise, seed)
            try:
                if kind != "none":
                    one = mishandle(one, every[kind], seed=seed, **names)
                phase = APEX if kind in of_events else hj.Crossing("vM", "falling")
                result = hj.identify_recording(
                    one,
                    phase,
                    inputs="u",
                    outputs=("yM", "vM"),
                    n_sections=n_sections,
                    order=2,
                )
            except hj.errors.DefinitionError as error:
                verdict.append("refused")
                causes[str(error)] = None
                continue
            right = result.fit.contains(cycle.multipliers, 0.999).all()
            doubts = {f.cause for f in result.diagnosis.findings} - HINTS
            causes |= dict.fromkeys(sorted(doubts))
            verdict.append(
                "right" if right else "named" if doubts else "SILENTLY WRONG"
            )
            found.append(distance(result.fit.multipliers, cycle.multipliers))
            said.append(result.fit.standard_errors[0])
        verdicts += verdict
        numbers = [f"{rms(x):.1e}" if x else "" for x in (found, said)]
        told = ", ".join(causes) if found else next(iter(causes))
        print(
            f"| {kind} | {' | '.join(numbers)} | {', '.join(dict.fromkeys(verdict))} | {told} |",
            flush=True,
        )
    counts = {v: verdicts.count(v) for v in dict.fromkeys(verdicts)}
    print("\n" + ", ".join(f"{n} {v}" for v, n in counts.items()), flush=True)


def spikes(seeds=50, strides=300, noise=1e-4, n_sections=16):
    print(
        f"\nSpikes of 20 standard deviations: {seeds} seeds, {strides} strides, noise {noise:g}"
    )
    recordings, true = hopper(strides, range(seeds))
    crossing = hj.Crossing("vM", "falling")
    for name, phase in (("apex", crossing), ("angle", phase_of("angle", n_sections))):
        for signals in (("yM", "vM"), ("u", "yM", "vM")):
            clean = None
            for share in (0.0, 1e-3, 1e-2):
                found, said, left_out = [], [], 0
                for seed, recording in enumerate(recordings):
                    dirty = add_artifacts(
                        recording, ("yM", "vM"), noise=noise, seed=seed
                    )
                    dirty = add_artifacts(dirty, signals, spikes=share, seed=seed)
                    data = hj.recordings.sample_sections(
                        dirty,
                        phase,
                        inputs="u",
                        outputs=("yM", "vM"),
                        n_sections=n_sections,
                    )
                    fit = hj.fit_series(data.records, 2, check=False)
                    found.append(distance(fit.multipliers, true))
                    said.append(fit.standard_errors[0])
                    left_out += sum(data.spikes)
                clean = clean or rms(found)
                print(
                    f"{name:5s} {100 * share:3g} % of {', '.join(signals)}: rms error "
                    f"{rms(found):.1e} ({rms(found) / clean:.2f} times the clean one), said "
                    f"{rms(said):.1e}, {left_out / seeds:.0f} samples left out",
                    flush=True,
                )


def walker(draws=30, strides=100, trials=5, noise=1e-4):
    print(f"\nWithout a clock: {trials} trials of {strides} strides, noise {noise:g}")
    wheel, gait = hj.models.RimlessWheel(), hj.models.CompassGait()
    middle = hj.AtEvent("middle")
    # Section of the cycle, outputs, phase, event to mark, rms of the force, order, extra lags
    # in cycles (what smaller multipliers leave after it is neglected).
    systems = {
        "rimless wheel": (
            wheel,
            "impact",
            ("th", "w"),
            middle,
            ("th", "rising"),
            0.0015,
            1,
            1,
        ),
        "compass gait": (
            gait,
            "heelstrike",
            ("n", "s", "vn", "vs"),
            middle,
            ("s", "falling"),
            0.05,
            2,
            2,
        ),
        "van der Pol": oscillator(),
    }
    for label, about in systems.items():
        walks(label, *about, draws, strides, trials, noise)


def oscillator():
    """Van der Pol's, as `walks` takes it."""
    angle = hj.KinematicPhase(16, position="x", velocity="v")
    return hj.models.VanDerPol(mu=0.1), None, ("x", "v"), angle, None, 0.02, 1, 1


def walks(
    label,
    system,
    event,
    outputs,
    phase,
    mark,
    size,
    order,
    extra_lags,
    draws,
    strides,
    trials,
    noise,
):
    where = {} if event is None else {"section": hj.AtEvent(event)}
    cycle = hj.find_limit_cycle(system, **where)
    period, true = float(cycle.period), np.asarray(cycle.multipliers)[:order]
    rate = 200 / period

    def one(rng):
        force = [
            hj.experiments.random_input(
                strides * period, rate, 8 / period, rms=size, seed=seed
            )
            for seed in rng.integers(2**31, size=trials).tolist()
        ]
        made = hj.testing.simulate_recording(
            cycle, np.stack(force), outputs, rate=rate, steps=1
        )
        made = add_artifacts(made, outputs, noise=noise, seed=int(rng.integers(2**31)))
        if mark:
            made = made.mark("middle", hj.Crossing(*mark), bandwidth=20 / period)
        data = hj.recordings.sample_sections(
            made, phase, inputs="u", outputs=outputs, n_sections=16, timing="duration"
        )
        fit = hj.fit_series(data, order, extra_lags=16 * extra_lags, check=False)
        reach = [
            np.abs(fit.ellipse(i) - z).max() for i, z in enumerate(fit.multipliers)
        ]
        return {
            "held": int(fit.contains(true).all()),
            "error": float(fit.compare(true).max_error),
            "reach": np.array(reach),
        }

    found = hj.scale.monte_carlo(one, draws)
    print(
        f"{label} (multipliers {true}): rms error {rms(found.error.values):.1e}, 95 % regions "
        f"reach {found.reach.values.mean(axis=0)}, all held in {int(found.held.sum())}/{draws}",
        flush=True,
    )


def size(trials=10, minutes=10, rate=1000):
    print(
        f"\n{trials} trials of {minutes} minutes at {rate} Hz, CSV to report by the command"
    )
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / f"trial{k}.csv") for k in range(trials)]
        # In a process of its own: a child's largest memory counts from what its parent holds.
        making = multiprocessing.get_context("spawn").Process(
            target=write_trials, args=(files, minutes, rate)
        )
        making.start()
        making.join()
        command = [
            sys.executable,
            "-m",
            "hybridjax",
            "identify",
            *files,
            "--inputs",
            "force",
        ]
        command += [
            "--outputs",
            "yM,vM",
            "--phase",
            "yM,vM",
            "--out",
            str(Path(folder) / "out"),
        ]
        start = time.perf_counter()
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(running.pid, 0)
        wall = time.perf_counter() - start
        if status:
            raise RuntimeError("the command failed.")
        cpu = used.ru_utime + used.ru_stime
        print(
            f"{wall:.0f} s, {cpu:.0f} CPU s, largest memory {used.ru_maxrss / 2**20:.2f} GiB"
        )


def bag(sizes=(0.25, 2.0), minutes=10, rate=100):
    print(
        f"\nMCAP files of images: {minutes} minutes of forces at {rate} Hz are read out of each"
    )
    for gigabytes in sizes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            making = multiprocessing.get_context("spawn").Process(
                target=write_bag, args=(path, gigabytes, minutes, rate)
            )
            making.start()
            making.join()
            code = "import sys, hybridjax as hj; hj.read_recording(sys.argv[1], signals='plate')"
            (file,) = path.glob("*.mcap")
            reading = subprocess.Popen(
                [sys.executable, "-c", code, str(file)], stdout=subprocess.DEVNULL
            )
            _, status, used = os.wait4(reading.pid, 0)
            if status:
                raise RuntimeError("the file was not read.")
            cpu = used.ru_utime + used.ru_stime
            print(
                f"{file.stat().st_size / 1e9:.2f} GB: {cpu:.1f} CPU s, largest memory "
                f"{used.ru_maxrss / 2**20:.2f} GiB",
                flush=True,
            )


def write_bag(path, gigabytes, minutes, rate):
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    vector = kinds["geometry_msgs/msg/Vector3"]
    layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
    samples, images = minutes * 60 * rate, int(1000 * gigabytes)  # of a megabyte
    rng = np.random.default_rng(0)
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        plate, camera = (
            (writer.add_connection(topic, kind, typestore=store), kind)
            for topic, kind in (
                ("/plate", "geometry_msgs/msg/WrenchStamped"),
                ("/camera", "std_msgs/msg/UInt8MultiArray"),
            )
        )
        for k in range(samples):
            t = int(k * 1e9 / rate)
            stamp = kinds["builtin_interfaces/msg/Time"](t // 10**9, t % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp, "")
            wrench = kinds["geometry_msgs/msg/Wrench"](vector(k, 0, 0), vector(0, 0, 0))
            message = kinds[plate[1]](header, wrench)
            writer.write(plate[0], t, store.serialize_cdr(message, plate[1]))
            if k * images // samples != (k + 1) * images // samples:
                image = kinds[camera[1]](layout, rng.integers(0, 256, 10**6, np.uint8))
                writer.write(camera[0], t, store.serialize_cdr(image, camera[1]))


def write_trials(files, minutes, rate):
    hj.enable_x64()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    force = [
        hj.experiments.random_input(minutes * 60, rate, BANDWIDTH, rms=RMS, seed=k)
        for k in range(len(files))
    ]
    made = hj.testing.simulate_recording(
        cycle, np.stack(force), ("yM", "vM"), rate=rate, steps=1
    )
    made = add_artifacts(made, ("yM", "vM"), noise=1e-4)
    for file, trial in zip(files, made.trials, strict=True):
        table = np.column_stack([trial.time, trial.values])
        header = "time (s),force (N),yM (m),vM (m/s)"
        np.savetxt(file, table, "%.7g", delimiter=",", header=header, comments="")


ALL = (
    "errors",
    "dirt",
    "mishaps",
    "spikes",
    "walker",
    "size",
    "bag",
    "coverage",
    "quiet",
    "short",
    "real",
)

if __name__ == "__main__":
    hj.enable_x64()
    for name in sys.argv[1:] or ALL:
        start = time.process_time()
        globals()[name]()
        print(f"({time.process_time() - start:.0f} CPU s)")
