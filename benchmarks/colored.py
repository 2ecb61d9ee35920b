"""Do intervals hold where errors are colored? The hopper itself, with noise of several kinds.

Between 8 isochrons, 4 realizations of a multisine (odd lines, P = 32, rms of u 0.01); 95 % regions
of the multipliers. Two estimators see the same records: `fit_multipliers` of the HTFs, with the
variances that realizations show (`htf`) and without (`htf_plain`), and `fit_series`. The noise:

- `white`: process noise, white and the same at all sections.
- `colored`: process noise with a correlation time of one cycle, nine times as strong at one phase
  as at the opposite one.
- `sensor`: measurement noise with a correlation time of half a cycle.
- `drift`: white measurement noise, and a drift of each output with a correlation time of 30 cycles,
  five times as large. `fit_series` is also told of it (`SectionSeries(drift=20)`).

Printed, as `name value` lines: rms error, rms of the standard errors (`said`), how many of the
regions held the true multipliers (`held`), and `p` of the binomial test of 95 %; `doubted`: how
many fits of series doubt themselves (`fit.findings`).

    python benchmarks/colored.py [--draws 200] [--only white colored sensor drift]
"""

import argparse

import equinox as eqx
import numpy as np
from scipy import stats

import hybridjax as hj


N, PERIODS, RMS = 8, 32, 0.01
OUTPUTS = ("yM", "vM")
PHASE = hj.ClockPhase(N, anchor=hj.Crossing("vM", "falling"))
BY_SECTION = 0.002 * (1 + 0.8 * np.cos(2 * np.pi * np.arange(N) / N))
SENSOR = (1e-4, 1e-3)


def with_noise(
    case: str, clean: hj.experiments.ExperimentData, run, rng
) -> hj.experiments.ExperimentData:
    """**Arguments:** `run(process_noise)` runs the experiments."""
    seed = int(rng.integers(2**31))
    if case == "white":
        return run(hj.experiments.ProcessNoise(0.002, seed))
    if case == "colored":
        return run(hj.experiments.ProcessNoise(BY_SECTION, seed, memory=1.0))
    if case == "sensor":
        return hj.experiments.add_noise(clean, std=SENSOR, memory=0.5, seed=seed)
    noisy = hj.experiments.add_noise(clean, std=SENSOR, seed=seed)
    return hj.experiments.add_noise(
        noisy, std=5 * np.array(SENSOR), memory=30.0, seed=int(rng.integers(2**31))
    )


def told_of_drift(record: hj.experiments.SectionSeries) -> hj.experiments.SectionSeries:
    return hj.experiments.SectionSeries(
        record.u,
        record.y,
        n_sections=N,
        inputs=record.inputs,
        outputs=record.outputs,
        drift=20,
    )


def found(fit, truth) -> dict[str, float]:
    k = int(np.abs(fit.multipliers - truth).argmin())
    return {
        "error": float(abs(fit.multipliers[k] - truth)),
        "said": float(fit.standard_errors[k]),
        "held": float(fit.contains([truth, truth.conjugate()]).all()),
        "doubted": float(bool(fit.findings)),
    }


def show(name: str, values: dict[str, np.ndarray]) -> None:
    held = int(values["held"].sum())
    rows = {
        "rms_error": np.sqrt(np.mean(values["error"] ** 2)),
        "said": np.sqrt(np.mean(values["said"] ** 2)),
        "held": held,
        "draws": len(values["held"]),
        "p": stats.binomtest(held, len(values["held"]), 0.95).pvalue,
        "doubted": int(values["doubted"].sum()),
    }
    for what, value in rows.items():
        print(f"colored.{name}.{what} {value:.4g}", flush=True)


def one_case(case: str, draws: int) -> None:
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    truth = complex(cycle.multipliers[0])
    placed = hj.sections.place_sections(cycle, PHASE)
    design = hj.multisine(N, PERIODS, lines="odd").scaled(RMS).realizations(4)

    def run(process_noise=None):
        return hj.run_experiments(
            cycle, placed, design, OUTPUTS, process_noise=process_noise
        )

    clean = run()

    def one(rng):
        data = with_noise(case, clean, run, rng)
        htf = hj.estimate_htf(data, (-1, 0, 1))
        series = {"series": data}
        if case == "drift":
            series["series_told"] = [told_of_drift(r) for r in data.records]
        plain = eqx.tree_at(lambda h: (h.variance, h.noise_variance), htf, (None, None))
        fits = {
            "htf": hj.fit_multipliers(htf, 2, check=False),
            "htf_plain": hj.fit_multipliers(plain, 2, check=False),
        }
        fits |= {
            name: hj.fit_series(x, 2, start="cycle", check=False)
            for name, x in series.items()
        }
        return {
            f"{name}.{k}": x
            for name, fit in fits.items()
            for k, x in found(fit, truth).items()
        }

    values = hj.scale.monte_carlo(one, draws, seed=1)
    for name in ("htf", "htf_plain", "series", "series_told"):
        if name != "series_told" or case == "drift":
            kinds = ("error", "said", "held", "doubted")
            show(
                f"{case}.{name}",
                {k: np.asarray(values[f"{name}.{k}"].values) for k in kinds},
            )


def main() -> None:
    cases = ("white", "colored", "sensor", "drift")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", nargs="+", choices=cases, default=cases)
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    for case in options.only:
        one_case(case, options.draws)


if __name__ == "__main__":
    main()
