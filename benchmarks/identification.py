"""How well the hopper's multipliers are identified, and how honest the regions are.

Printed, as `name value` lines: distances of the estimated first multiplier from the true one (for
fits with several estimates of it, the closest).

- `paper`: the paper's own 80 experiments (amplitude 0.01, 84 cycles, 20 discarded), without noise:
  the structured fit of all harmonics, the rational fit of H_0 (two poles, one zero), AAA, and the
  output-error fit of the first 20 experiments with all of their cycles.
- `small`: 20 experiments of 64 cycles at amplitude 0.001, with all 620 lines and with the odd ones,
  from the periodic start that the linearization predicts and from the nonlinear one (`steady`).
- `noise.S`: 20 experiments of 84 cycles (odd lines, rms 0.02, predicted periodic start) with white
  noise at S dB (`none`: without), `--seeds` draws of it and of the phases. `bound`: the Cramer-Rao
  bound of the rms error with all numerators unknown. `rms`: of the structured fit, which is told no
  variances; `said`: the rms of its standard errors; `covered`: how often its 95 % region holds the
  true multiplier, and `covered.p`: the p-value of that. `ratio`: rms / bound.
- `white`: 300 cycles of white input (rms 0.002) from the limit cycle: output error without noise
  and at 20 dB, `--series` draws.
- `coverage`: as in estimation.py, of the multiplier: `--runs` runs at 20 dB, each four realizations
  of 20 experiments with new phases and noise; the truth is the fit to the mean over 2000
  realizations without noise, with the mean variances of the runs. `p`: that of the binomial test,
  times the number of tests (4). `bias`: the truth less the multiplier for small inputs.
- `realized`: error of H_0 of the state-space model found from the series at 20 dB, relative to
  max |H_0|, and its fit in percent to noise-free validation data.

    python benchmarks/identification.py [--seeds 200] [--series 100] [--runs 1000] [--skip STEP ...]
"""

import argparse

import numpy as np
from estimation import Family, N
from scipy import stats
from scipy.interpolate import AAA
from second_order import OUTPUTS, sections

import hybridjax as hj


# rms of the inputs where distortion is a small and a large part of the variance.
RMS = {"isochron": (0.005, 1.0), "kinematic": (0.005, 0.2)}
STEPS = ("paper", "noise", "white", "coverage")
SEED = {"isochron": 501, "kinematic": 502}  # of the series
BAND = (
    -4,
    -3,
    -2,
    -1,
    0,
    1,
    2,
    3,
    4,
)  # further harmonics tell nothing more about multipliers


class Identification(Family):
    @property
    def true(self) -> np.ndarray:
        return np.asarray(self.model.multipliers)[:1]

    def error(self, estimate, true=None) -> float:
        true = self.true if true is None else true
        return float(np.abs(np.asarray(estimate.multipliers) - true).min())

    def show(self, name: str, value) -> None:
        print(f"identification.{self.name}.{name} {value:.2e}", flush=True)


def paper(family: Identification) -> None:
    data = family.run(hj.experiments.paper_design())
    estimate = hj.estimate_htf(data)
    family.show("paper.structured", family.error(hj.fit_multipliers(estimate, 2)))
    rational, H = hj.identify.fit_rational(estimate), np.asarray(estimate[0])[..., 0]
    z = np.exp(2j * np.pi * np.asarray(estimate.frequencies) / N)
    inner = z.imag > 1e-12
    z, H = np.append(z, z[inner].conj()), np.concatenate([H, H[inner].conj()])
    for k, output in enumerate(OUTPUTS):
        aaa = AAA(z, H[:, k], rtol=1e-4, clean_up=False).poles() ** N
        for name, multipliers in (("rational", rational.multipliers[k]), ("aaa", aaa)):
            family.show(
                f"paper.{name}.{output}", np.nanmin(abs(multipliers - family.true))
            )
    some = hj.experiments.ExperimentData(
        data.u[:20],
        data.y[:20],
        n_sections=N,
        periods=64,
        inputs=data.inputs,
        outputs=OUTPUTS,
    )
    family.show("paper.series", family.error(hj.fit_series(some, 2, start="cycle")))
    for lines in ("all", "odd"):
        for label, start in (("predicted", "periodic"), ("steady", "steady")):
            data = family.run(hj.multisine(lines=lines, amplitude=0.001), start=start)
            error = family.error(hj.fit_multipliers(hj.estimate_htf(data), 2))
            family.show(f"small.{lines}.{label}", error)


def noise(family: Identification, seeds: int) -> None:
    """Phases are drawn anew in each run: distortion is random only where they are."""
    design = hj.multisine(periods=84, lines="odd").scaled(0.02)
    exact = family.model.htf(design.frequencies, BAND)
    clean, fits, size = [], {snr: [] for snr in (40, 20, 0)}, []
    for seed in range(seeds):
        data = family.run(design.realizations(1, seed), start="periodic")
        size.append(np.var(data.y, axis=(0, 1)))
        clean.append(hj.fit_multipliers(hj.estimate_htf(data, BAND), 2))
        for snr, found in fits.items():
            noisy = hj.experiments.add_noise(data, snr=snr, seed=seed)
            found.append(hj.fit_multipliers(hj.estimate_htf(noisy, BAND), 2))
    report(family, "noise.none", clean)
    for snr, found in fits.items():
        # Of white noise; distortion comes on top.
        variance = np.mean(size, axis=0)[:, None] * 10 ** (-snr / 10)
        variance = variance * design.expected_variance()[:, None, :]
        bound = hj.identify.cramer_rao(
            family.model,
            hj.linear.HTF(
                exact.frequencies,
                exact.H,
                BAND,
                N,
                exact.inputs,
                OUTPUTS,
                variance=np.broadcast_to(variance, exact.H.shape),
            ),
        ).standard_errors[0]
        report(family, f"noise.{snr}", found, bound)


def report(family: Identification, name: str, fits, bound=None) -> None:
    errors = np.array([family.error(fit) for fit in fits])
    rms = np.sqrt(np.mean(errors**2))
    if bound is not None:
        family.show(f"{name}.bound", bound)
        family.show(f"{name}.ratio", rms / bound)
    family.show(f"{name}.rms", rms)
    family.show(
        f"{name}.said", np.sqrt(np.mean([f.standard_errors[0] ** 2 for f in fits]))
    )
    hits = sum(int(f.contains(family.true).all()) for f in fits)
    family.show(f"{name}.covered", hits / len(fits))
    family.show(f"{name}.covered.p", stats.binomtest(hits, len(fits), 0.95).pvalue)


def white(family: Identification, draws: int) -> None:
    rng = np.random.default_rng(SEED[family.name])
    u = 0.002 * rng.normal(size=(draws + 2, 300 * N, 1))
    data = family.run(u, start="cycle", discard=0)

    def one(s, y):
        return hj.experiments.SectionSeries(
            data.u[s], y[s], n_sections=N, inputs=data.inputs, outputs=OUTPUTS
        )

    family.show("white.clean", family.error(hj.fit_series(one(0, data.y), 2)))
    noisy = hj.experiments.add_noise(data, snr=20, seed=SEED[family.name] + 1)
    fits = [hj.fit_series(one(s, noisy.y), 2) for s in range(draws)]
    report(family, "white.20", fits)
    model = fits[0].model
    f = np.arange(0.05, 10, 0.1)
    exact = family.model.htf(f, 0)
    for k, error in enumerate(np.asarray(model.htf(f, 0).error(exact))):
        family.show(f"realized.20.H0.{OUTPUTS[k]}", error)
    for k, fit in enumerate(hj.validate(model, one(draws + 1, data.y)).fit):
        family.show(f"realized.20.fit.{OUTPUTS[k]}", fit)


def coverage(family: Identification, rms: float, runs: int) -> None:
    design = hj.multisine(periods=32, seed=1).scaled(rms)
    chosen = (-1, 0, 1)

    def run(count, seed):
        return family.run(
            design.realizations(count, seed), start="periodic", discard=32
        )

    mean = hj.estimate_htf((run(100, 10**6 + k) for k in range(20)), chosen)

    def draw(rng):
        phases, noise = rng.integers(2**31, size=2).tolist()
        noisy = hj.experiments.add_noise(run(4, phases), snr=20, seed=noise)
        estimate = hj.estimate_htf(noisy, chosen, repeats=2)
        dof = estimate.variance_dof.dof
        return {"H": estimate.H, "variance": estimate.variance, "dof": dof}

    def fitted(H, variance, dof):
        htf = hj.linear.HTF(
            mean.frequencies,
            H,
            chosen,
            N,
            mean.inputs,
            mean.outputs,
            variance=variance,
            variance_dof=hj.linear.VarianceDof(dof),
        )
        return hj.fit_multipliers(htf, 2)

    found = hj.scale.monte_carlo(draw, runs)
    dof = float(found.dof[0])
    fits = [
        fitted(H, variance, dof)
        for H, variance in zip(found.H.values, found.variance.values, strict=True)
    ]
    # Where distortion matters the HTFs are not of the structure exactly, and the fit to them
    # depends on the weights: the truth has those of the runs.
    weighted = fitted(mean.H, found.variance.mean("draw").values, dof)
    truth = weighted.multipliers[:1]
    hits = sum(int(fit.contains(truth).all()) for fit in fits)
    errors = np.array([family.error(fit, truth) for fit in fits])
    family.show(f"coverage.{rms}.multiplier", hits / runs)
    family.show(
        f"coverage.{rms}.p", min(4 * stats.binomtest(hits, runs, 0.95).pvalue, 1.0)
    )
    family.show(f"coverage.{rms}.rms", np.sqrt(np.mean(errors**2)))
    family.show(
        f"coverage.{rms}.said",
        np.sqrt(np.mean([f.standard_errors[0] ** 2 for f in fits])),
    )
    family.show(f"coverage.{rms}.bias", abs(truth - family.true)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--series", type=int, default=100)
    parser.add_argument("--runs", type=int, default=1000, help="for coverage")
    parser.add_argument("--skip", nargs="*", default=(), help=", ".join(STEPS))
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for name, definition in sections().items():
        family = Identification(name, cycle, definition)
        if "paper" not in options.skip:
            paper(family)
        if "noise" not in options.skip:
            noise(family, options.seeds)
        if "white" not in options.skip:
            white(family, options.series)
        if "coverage" not in options.skip:
            for rms in RMS[name]:
                coverage(family, rms, options.runs)


if __name__ == "__main__":
    main()
