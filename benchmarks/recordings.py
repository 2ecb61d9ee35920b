"""Recordings to multipliers: errors, dirt, coverage, a walker, time and memory.

python benchmarks/recordings.py [errors] [dirt] [coverage] [walker] [size]      (all by default)

The systems are simulated and their multipliers known. Beside `fit_series` stands plain ARX: least
squares on the same section data.
"""

import resource
import sys
import time

import equinox as eqx
import numpy as np
from scipy import stats

import hybridjax as hj
from hybridjax.identify.estimate import roots_of
from hybridjax.identify.records import lay_out
from hybridjax.identify.regression import lagged, set_up
from hybridjax.recordings.spoil import spoil


PLANE = hj.AnglePhase("yM", "vM", center=(1.9, 0.0), scale=(0.3, 1.9))
RATE, BANDWIDTH, RMS = 500, 8.0, 0.0205  # Hz, Hz, N: outputs deviate by 9.7e-4 m (rms)
NOISES = (0.0, 1e-4, 1e-3)


def hopper(strides, seeds):
    """Recordings of the paper's hopper, one for each seed, and its multipliers."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    force = [random_force(strides, seed) for seed in seeds]
    both = hj.simulate_recording(cycle, np.stack(force), ("yM", "vM"), rate=RATE, steps=1)
    return [eqx.tree_at(lambda r: r.trials, both, (t,)) for t in both.trials], cycle.multipliers


def random_force(strides, seed):
    return hj.random_force(strides, RATE, BANDWIDTH, rms=RMS, seed=seed)


def start_of(recording, strides):
    def cut(t):
        rows = t.time < strides
        events = {k: v[v < strides] for k, v in t.events.items()}
        parts = (t.time[rows], t.values[rows], events)
        return eqx.tree_at(lambda t: (t.time, t.values, t.events), t, parts)

    return eqx.tree_at(lambda r: r.trials, recording, tuple(map(cut, recording.trials)))


def at_sections(recording, phase=PLANE, **options):
    return hj.section_data(
        recording, phase, inputs="u", outputs=("yM", "vM"), sections=32, **options
    )


def arx(data, order=2):
    """Multipliers by least squares on chi y = B u: what noise in y biases."""
    layout = lay_out(data.records)
    problem = set_up(layout, order, layout.y.shape[2], False)
    _, T, N, ny = problem.y.shape
    gram = np.zeros((order + 1, order + 1))
    for n in range(N):
        V = lagged(problem.u, n, problem.lags, problem.lead) @ problem.maps[n]
        for i in range(ny):
            good, y = problem.good[:, :, n, i], problem.y[:, :, n, i]
            rows, past = np.arange(T) >= problem.first[:, n, None] + problem.free, []
            for j in range(order + 1):
                past.append(np.roll(y, j, axis=1))
                rows = rows & np.roll(good, j, axis=1)
            Z = np.stack([p[rows] for p in past], axis=1)
            Z = Z - V[rows] @ np.linalg.lstsq(V[rows], Z)[0]
            gram += Z.T @ Z
    return roots_of(-np.linalg.solve(gram[1:, 1:], gram[1:, 0]))


def distance(multipliers, true):
    return np.abs(multipliers - true).max()


def errors(seeds=10):
    print(f"\nHopper, {RATE} Hz, force of {BANDWIDTH:g} Hz and rms {RMS} N; {seeds} seeds")
    recordings, true = hopper(1000, range(seeds))
    print("strides  noise    rms error  (median)   said     plain ARX, rms; on splines through all")
    for strides in (1000, 300):
        for noise in NOISES:
            found, said, plain, rough = [], [], [], []
            for seed, recording in enumerate(recordings):
                dirty = spoil(start_of(recording, strides), ("yM", "vM"), noise=noise, seed=seed)
                data = at_sections(dirty)
                fit = hj.fit_series(data.records, 2, check=False)
                found.append(distance(fit.multipliers, true))
                said.append(fit.standard_errors[0])
                plain.append(distance(arx(data), true))
                rough.append(distance(arx(at_sections(dirty, bandwidth=np.inf)), true))
            row = [rms(found), np.median(found), rms(said), rms(plain), rms(rough)]
            print(f"{strides:7d}  {noise:6.0e}  " + "  ".join(f"{x:9.1e}" for x in row), flush=True)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def coverage(seeds=500, strides=300, noise=1e-4, chunk=50):
    print(f"\nCoverage of 95 % regions: {seeds} seeds, {strides} strides, noise {noise:g}")
    hits, found, said = [], [], []
    for first in range(0, seeds, chunk):
        recordings, true = hopper(strides, range(1000 + first, 1000 + first + chunk))
        for seed, recording in enumerate(recordings, first):
            dirty = spoil(recording, ("yM", "vM"), noise=noise, seed=seed)
            fit = hj.fit_series(at_sections(dirty).records, 2, check=False)
            hits.append(bool(fit.contains(true[:1])[0]))
            found.append(distance(fit.multipliers, true))
            said.append(fit.standard_errors[0])
        p = stats.binomtest(sum(hits), len(hits), 0.95).pvalue
        print(
            f"{sum(hits)} of {len(hits)} ({100 * np.mean(hits):.1f} %), p = {p:.2g}; rms error "
            f"{rms(found):.1e}, said {rms(said):.1e}",
            flush=True,
        )


if __name__ == "__main__":
    hj.enable_x64()
    for name in sys.argv[1:] or ("errors", "coverage"):
        start = time.process_time()
        globals()[name]()
        print(f"({time.process_time() - start:.0f} CPU s)")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"\nlargest memory {memory:.2f} GiB")
