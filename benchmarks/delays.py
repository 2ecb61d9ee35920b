"""Delays of input and measurement of the hopper, no multiples of a section, told apart.

The vertical hopper between `N` = 8 clock sections: its input acts 0.037 periods after it is given,
and its outputs are measured 0.081 periods late. Experiments are those of the nonlinear hopper at
1000 sections, with inputs that are held for 125 of them: a multisine of rms 0.001, four draws of
its phases; noise 20 dB below the outputs. `fit_model` to HTFs with unknown stiffness, damping and
both delays, from 11, 4.5 and twice 0.06. Printed, as `name value` lines, over `--draws` draws of
the noise, for each of the four:

- `bias`, `rms`: mean and rms error. `said`: rms of the standard errors. `largest`: largest error in
  standard errors; `largest.p`: how often the largest of as many normal errors is larger.
- `covered`, `p`: how often the 95 % interval holds the truth, p-value of 95 % (binomial test);
  `joint.*`: the same of the joint region; `series.*`: of the multipliers by `fit_series`.
  `seconds`: CPU seconds of a fit (median).

    python benchmarks/delays.py [--draws 200] [--first 0]
"""

import argparse
import time

import numpy as np
from scipy import stats

import hybridjax as hj


N, FINE, DELAY, OUTPUTS = 8, 125, (0.037, 0.081), ("yM", "vM")
TRUE = {"k": 10.0, "b": 5.0, "input_delay": DELAY[0], "output_delay": DELAY[1]}


def experiments(
    cycle: hj.orbits.LimitCycle, settling: int = 20
) -> hj.experiments.ExperimentData:
    """Experiments without noise."""
    design = hj.multisine(N, 16, frequencies=(0, N / 2)).scaled(0.001).realizations(4)
    u = design.signals(design.periods + settling)
    late, early = (round(x * N * FINE) for x in DELAY)
    held = np.repeat(u, FINE, axis=1)
    held = np.concatenate([np.zeros((len(u), late, 1)), held], axis=1)[
        :, : held.shape[1]
    ]
    fine = hj.run_experiments(
        cycle, hj.ClockPhase(N * FINE), held, OUTPUTS, discard=settling, accuracy=1e-10
    )
    first = settling * N
    rows = FINE * np.arange(first, u.shape[1]) - early
    return hj.experiments.ExperimentData(
        u[:, first:],
        fine.y[:, rows],
        n_sections=N,
        periods=design.periods,
        inputs=fine.inputs,
        outputs=fine.outputs,
        result=fine.result,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    options = parser.parse_args()
    hj.enable_x64()
    cycle, phase = hj.find_limit_cycle(hj.models.VerticalHopper()), hj.ClockPhase(N)
    data = experiments(cycle)
    noise = 0.1 * data.y.std(axis=(0, 1))
    rows = []
    for k in range(options.first, options.first + options.draws):
        noisy = hj.experiments.add_noise(data, std=noise, seed=k)
        observed = hj.fitting.ObservedHTF(
            hj.estimate_htf(noisy), phase, delay=(0.06, 0.06)
        )
        began = time.process_time()
        start = hj.models.VerticalHopper(k=11.0, b=4.5)
        fit = hj.fit_model(start, observed, tuple(TRUE), guess=cycle)
        seconds = time.process_time() - began
        series = hj.fit_series(noisy, 2, check=False).contains(cycle.multipliers).all()
        rows.append(
            (fit.values, fit.standard_errors, fit.contains(TRUE), series, seconds)
        )
    values, said, joint, series, seconds = map(np.array, zip(*rows, strict=True))
    show = lambda name, value: print(f"delays.{name} {value:.4g}", flush=True)  # noqa: E731
    error = values - np.array(list(TRUE.values()))

    def held(name, inside):
        show(f"{name}.covered", inside.mean())
        show(f"{name}.p", stats.binomtest(int(inside.sum()), len(inside), 0.95).pvalue)

    for name, e, s in zip(TRUE, error.T, said.T, strict=True):
        show(f"{name}.bias", e.mean())
        show(f"{name}.rms", np.sqrt((e**2).mean()))
        show(f"{name}.said", np.sqrt((s**2).mean()))
        show(f"{name}.largest", largest := np.abs(e / s).max())
        show(f"{name}.largest.p", 1 - (1 - 2 * stats.norm.sf(largest)) ** len(e))
        held(name, np.abs(e / s) < stats.norm.ppf(0.975))
    held("joint", joint)
    held("series", series)
    show("draws", len(error))
    show("seconds", np.median(seconds))


if __name__ == "__main__":
    main()
