"""How well experiments identify the hopper, the paper's protocol beside: designs, starts, noise.

Printed, as `name value` lines: errors of estimated H_m over all lines, the largest, relative to the
largest modulus of the exact H_0 of that output (`H0`), or, for every m = -2..2 by itself, of the
exact H_m (`each`, the worst of them). Names say `family.protocol.rms.what.output`.

- `paper`: 80 experiments of 84 cycles from the limit cycle, the first 20 discarded.
- `full`: 620 lines (P = 64), 20 experiments; `odd`: 640 lines (f = odd/128), 20 experiments. Both
  without discarded cycles, from the start that the linearization predicts (`predicted`) and from
  the nonlinear periodic response (`steady`).
- `unknown`: 20 experiments of 84 cycles that start on the limit cycle and know nothing: with the
  first 20 cycles discarded, with the transient fitted and removed, and with it interpolated between
  lines that are not excited, by local polynomials (odd lines, all 84 cycles). All 620 lines or odd
  ones.
- `crest`: crest factors of signals of 31 lines.
- `discs`: how often 95 % discs about means of some complex errors hold zero. Errors are normal, of
  constant modulus (`constant`), or sums of both, with the rms of the normal part relative to the
  other. Discs of `size` look at the size of the variance_dof alone, those of `shape` are
  `HTF.confidence_radius`; `wider` is the ratio of their mean radii.
- `coverage`: 1000 runs at 20 dB, each some realizations of 20 experiments (P = 32, 300 lines) with
  new phases and new noise. How often the 95 % regions of H_0, H_1 and H_-1 at ten fixed frequencies
  (`disc`) hold the best linear approximation, the mean over
  2000 realizations without noise. `p`: the smallest binomial p-value times the number of tests
  (60, for each family and amplitude), which is above 0.01 where the regions are right.
  `distortion`: the part of the variance that is not noise. `bias`: the best linear approximation
  less the exact H_0, at these frequencies.

    python benchmarks/estimation.py [--skip coverage ...] [--runs 1000]
"""

import argparse

import numpy as np
from scipy import stats
from second_order import OUTPUTS, sections

import hybridjax as hj


HARMONICS = (-2, -1, 0, 1, 2)
N = 32
STEPS = ("crest", "discs", "periodic", "unknown", "coverage")
SEED = {"isochron": 41 * 10**6, "kinematic": 57 * 10**6}
# rms of the inputs where distortion is a small and a large part of the variance, and realizations.
COVERAGE = {
    "isochron": ((0.005, 4), (2.0, 4)),
    "kinematic": ((0.005, 4), (0.6, 4), (0.2, 4), (0.2, 8)),
}


class Family:
    """The hopper between the sections of one family."""

    def __init__(self, name: str, cycle, definition):
        self.name, self.cycle = name, cycle
        self.placed = hj.sections.place_sections(cycle, definition)
        self.model = hj.linearize(cycle, self.placed, OUTPUTS)

    def run(self, design, **options):
        data = hj.run_experiments(self.cycle, self.placed, design, OUTPUTS, **options)
        assert data.ok.all(), data.summary()
        return data

    def report(self, name: str, data) -> None:
        estimate = hj.estimate_htf(data, HARMONICS)
        exact = self.model.htf(estimate.frequencies, HARMONICS)
        error = np.abs(estimate.H - exact.H).max(axis=(1, 3))
        own = np.abs(exact.H).max(axis=(1, 3))
        for k, output in enumerate(OUTPUTS):
            self.show(f"{name}.H0.{output}", error[2, k] / own[2, k])
            self.show(f"{name}.each.{output}", np.max(error[:, k] / own[:, k]))

    def show(self, name: str, value) -> None:
        print(f"estimation.{self.name}.{name} {value:.3g}", flush=True)


def periodic(family: Family) -> None:
    """Nothing is random here but the design."""
    full, odd = hj.multisine(), hj.multisine(periods=128, lines="odd")
    for rms in (0.002, 0.02, 0.06):
        family.report(
            f"paper.{rms}", family.run(hj.experiments.paper_design().scaled(rms))
        )
        for name, design in (("full", full), ("odd", odd)):
            for label, start in (("predicted", "periodic"), ("steady", "steady")):
                data = family.run(design.scaled(rms), start=start)
                family.report(f"{name}.{label}.{rms}", data)


def unknown(family: Family) -> None:
    """Records of 84 cycles that begin on the limit cycle."""
    rms = 0.002
    for name, lines in (("full", "all"), ("odd", "odd")):
        data = family.run(hj.multisine(lines=lines).scaled(rms), discard=20)
        family.report(f"unknown.{name}.discarded.{rms}", data)
        fit = hj.identify.remove_transient(data)
        family.report(f"unknown.{name}.removed.{rms}", fit.data)
        error = np.abs(fit.multipliers - family.cycle.multipliers[0]).min()
        family.show(f"unknown.{name}.removed.{rms}.multiplier", error)
    data = family.run(hj.multisine(periods=84, lines="odd").scaled(rms), discard=0)
    for degree in (2, 4):
        family.report(
            f"unknown.odd.local_polynomial_{degree}.{rms}", interpolated(data, degree)
        )


def interpolated(data, degree: int):
    """The transient at odd lines by a local polynomial through the even lines around them."""
    Y = np.fft.fft(data.y, axis=1)
    offsets = np.arange(-degree - 1, degree + 2, 2)
    powers = offsets[:, None] ** np.arange(degree + 1)
    weights = np.linalg.pinv(powers)[0]
    transient = sum(
        w * np.roll(Y, -k, axis=1) for w, k in zip(weights, offsets, strict=True)
    )
    y = np.fft.ifft(Y - transient, axis=1).real
    return hj.experiments.ExperimentData(
        data.u, y, n_sections=N, periods=data.periods, outputs=OUTPUTS
    )


def crest() -> None:
    random, low = hj.multisine(), hj.multisine().optimize_phases()
    for name, design in (("random", random), ("optimized", low)):
        factors = design.crest_factors()
        print(f"estimation.crest.{name}.mean {factors.mean():.2f}")
        print(f"estimation.crest.{name}.max {factors.max():.2f}")


def discs(draws: int = 200_000) -> None:
    rng = np.random.default_rng(0)
    kinds = {
        "normal": (0, 1),
        "constant": (1, 0),
        "0.3": (1, 0.3),
        "0.6": (1, 0.6),
        "1": (1, 1),
    }
    for count in (2, 3, 4, 6, 8, 16):
        dof = np.full(draws, count - 1.0)
        for kind, (constant, noise) in kinds.items():
            error = constant * np.exp(2j * np.pi * rng.random((count, draws)))
            error += (
                noise
                * rng.normal(size=(count, draws, 2))
                @ (np.array([1, 1j]) / np.sqrt(2))
            )
            mean = error.mean(axis=0)
            rest = error - mean
            power = np.sum(np.abs(rest) ** 2, axis=0)
            roundness = np.ones(draws)
            if count > 2:
                line = np.abs(np.sum(rest**2, axis=0)) / power
                roundness = (1 - np.minimum(line, 1) ** 2) * count / (count - 2)
            radii = []
            for name, shape in (
                ("size", None),
                ("shape", roundness[None, :, None, None]),
            ):
                quantile = np.asarray(hj.linear.VarianceDof(dof, shape).quantile(0.95))
                radii.append(np.sqrt(np.ravel(quantile) * power / count / (count - 1)))
                inside = np.mean(np.abs(mean) <= radii[-1])
                print(f"estimation.discs.{count}.{kind}.{name} {inside:.4f}")
            print(
                f"estimation.discs.{count}.{kind}.wider {radii[1].mean() / radii[0].mean():.3f}"
            )


def coverage(family: Family, rms: float, each: int, runs: int, seed: int) -> None:
    design = hj.multisine(periods=32, seed=1).scaled(rms)
    f = design.frequencies
    chosen = [f[np.argmin(np.abs(f - x))] for x in np.geomspace(0.06, 9.9, 10)]

    def run(count, seed):
        return family.run(
            design.realizations(count, seed), start="periodic", discard=32
        )

    truth = hj.estimate_htf((run(100, seed + k) for k in range(20)), (-1, 0, 1))
    rows = [int(np.argmin(np.abs(truth.frequencies - x))) for x in chosen]

    def draw(rng):
        phases, noise = rng.integers(2**31, size=2).tolist()
        noisy = hj.experiments.add_noise(run(each, phases), snr=20, seed=noise)
        estimate = hj.estimate_htf(noisy, (-1, 0, 1), repeats=2)
        error = np.abs(np.asarray(estimate.H) - np.asarray(truth.H))
        return {
            "disc": (error <= np.asarray(estimate.confidence_radius()))[:, rows],
            "variance": np.stack([estimate.variance, estimate.noise_variance])[
                :, :, rows
            ],
        }

    found = hj.scale.monte_carlo(draw, runs, seed)
    name = f"coverage.{rms}.{each}_realizations"
    hits = found["disc"].sum("draw").values
    tests = np.array([stats.binomtest(int(h), runs, 0.95).pvalue for h in hits.flat])
    family.show(f"{name}.disc.mean", hits.mean() / runs)
    family.show(f"{name}.disc.least", hits.min() / runs)
    family.show(f"{name}.disc.most", hits.max() / runs)
    family.show(f"{name}.disc.p", min(tests.min() * tests.size, 1.0))
    m, i, k, _ = worst = np.unravel_index(np.argmin(hits), hits.shape)
    print(f"# least: H_{m - 1} of {OUTPUTS[k]} at f = {chosen[i]}", flush=True)
    total, noise = found.variance.mean("draw").values
    family.show(f"{name}.distortion.mean", np.mean(1 - noise / total))
    family.show(f"{name}.distortion.most", np.max(1 - noise / total))
    family.show(f"{name}.distortion.least_covered", (1 - noise / total)[worst])
    exact, mean = (
        np.asarray(family.model.htf(chosen, (-1, 0, 1)).H),
        np.asarray(truth.H)[:, rows],
    )
    for k, output in enumerate(OUTPUTS):
        bias = np.abs(mean - exact)[1, :, k].max() / np.abs(exact)[1, :, k].max()
        family.show(f"{name}.bias.H0.{output}", bias)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000, help="for coverage")
    parser.add_argument("--skip", nargs="*", default=(), help=", ".join(STEPS))
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    if "crest" not in options.skip:
        crest()
    if "discs" not in options.skip:
        discs()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for name, definition in sections().items():
        family = Family(name, cycle, definition)
        for step in (periodic, unknown):
            if step.__name__ not in options.skip:
                step(family)
        if "coverage" not in options.skip:
            for k, (rms, realizations) in enumerate(COVERAGE[name]):
                coverage(
                    family, rms, realizations, options.runs, SEED[name] + 10**6 * k
                )


if __name__ == "__main__":
    main()
