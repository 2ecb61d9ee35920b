"""What designs made for the question are worth, in strides.

The nonlinear hopper between the paper's two families of sections, white noise on both outputs (20
dB in the usual design), and multipliers by `fit_multipliers`. "Saved" is the ratio of the squared
rms errors at equal numbers of strides (and equal rms of the input). Printed, as `name value` lines:

- `bound`: Cramer-Rao bounds of the usual design (620 lines, 20 experiments) and of the optimal one,
  input or output limited, what is saved, the certificate, and seconds of the process to find it.
- `known`: rms errors of draws with new noise, four draws of the phases; the model is known. The
  input's rms is 0.001, on odd lines (P = 128), so that distortion is below noise.
- `nothing`: from nothing: 1280 strides of equal amplitudes, a design from what they say, 2560 of
  that, and one fit to both, against the bound of as many strides of equal amplitudes. Four
  first blocks; the harmonic mean of what they save, and the least.

    python benchmarks/designs.py [--draws 200] [--only bound known nothing]
"""

import argparse
import time

import numpy as np
from second_order import OUTPUTS, sections

import hybridjax as hj


HARMONICS = (-2, -1, 0, 1, 2)
RMS = 0.001
PHASES = 4
# First blocks from which a design is made.
BLOCKS = 4


class Family:
    """The hopper between the sections of one family."""

    def __init__(self, name: str, cycle, definition):
        self.name, self.cycle = name, cycle
        self.placed = hj.place_sections(cycle, definition)
        self.model = hj.linearize(cycle, self.placed, OUTPUTS)

    def show(self, name: str, value: float) -> None:
        print(f"designs.{self.name}.{name} {value:.4g}", flush=True)

    def recorded(self, design: hj.Design, seed: int = 1) -> list[hj.ExperimentData]:
        """Without noise, for some draws of the phases."""
        drawn = [design.realizations(1, seed=seed + k) for k in range(PHASES)]
        return [
            hj.run_experiments(self.cycle, self.placed, one, OUTPUTS, start="steady")
            for one in drawn
        ]

    def noise(self, data: hj.ExperimentData) -> dict[str, float]:
        """20 dB below the outputs."""
        rms = np.sqrt(np.mean(data.y**2, axis=(0, 1)))
        return dict(zip(OUTPUTS, 0.1 * rms, strict=True))


def measured(data, design: hj.Design, noise: dict[str, float], rng) -> hj.HTF:
    """HTFs from data with noise, whose variance is known."""
    std = np.array(list(noise.values()))
    noisy = hj.experiments.add_noise(data, std=std, seed=int(rng.integers(2**31)))
    found = hj.estimate_htf(noisy, HARMONICS, variance="auto")
    variance = design.expected_variance()[:, None, :] * std[:, None] ** 2
    return with_variance(found, np.broadcast_to(variance, found.H.shape))


def with_variance(htf: hj.HTF, variance) -> hj.HTF:
    return hj.HTF(
        htf.f, htf.H, htf.harmonics, htf.n_sections, htf.inputs, htf.outputs, variance=variance
    )


def joined(one: hj.HTF, other: hj.HTF) -> hj.HTF:
    """Estimates at different frequencies as one."""
    order = np.argsort(np.concatenate([one.f, other.f]))
    H, v = (
        np.concatenate([np.asarray(a), np.asarray(b)], axis=1)[:, order]
        for a, b in ((one.H, other.H), (one.variance, other.variance))
    )
    f = np.concatenate([one.f, other.f])[order]
    return hj.HTF(f, H, one.harmonics, one.n_sections, one.inputs, one.outputs, variance=v)


def rms_error(family: Family, fit, draws: int, seed: int) -> float:
    """Of the pair of multipliers, over draws of `fit(rng)`."""
    truth = family.model.multipliers

    def error(rng):
        return fit(rng).compare(truth).error[0]

    return float(np.sqrt(np.mean(hj.monte_carlo(error, draws, seed).value.values ** 2)))


def bounds(family: Family, draws: int) -> None:
    for limit in ("input", "output"):
        begin = time.process_time()
        plan = hj.optimal_design(family.model, limit=limit)
        seconds = time.process_time() - begin
        family.show(f"bound.{limit}.usual", np.linalg.norm(plan.usual_standard_errors))
        family.show(f"bound.{limit}.optimal", np.linalg.norm(plan.standard_errors))
        family.show(f"bound.{limit}.saved", plan.saved)
        family.show(f"bound.{limit}.certificate", plan.certificate)
        for name in OUTPUTS:
            family.show(f"bound.{limit}.deviation.{name}", plan.rms[name] / plan.usual_rms[name])
        family.show(f"bound.{limit}.cpu_seconds", seconds)


def known(family: Family, draws: int) -> None:
    usual = hj.multisine(periods=128, lines="odd").scaled(RMS)
    before = family.recorded(usual)
    noise = family.noise(before[0])
    plan = hj.optimal_design(family.model, usual, noise=noise)
    found = []
    for name, design, data in (
        ("usual", usual, before),
        ("optimal", plan.design, family.recorded(plan.design)),
    ):

        def fit(rng, data=data, design=design):
            htf = measured(data[rng.integers(PHASES)], design, noise, rng)
            return hj.fit_multipliers(htf, 2)

        found.append(rms_error(family, fit, draws, seed=3))
        family.show(f"known.{name}.rms_error", found[-1])
    family.show("known.usual.bound", np.linalg.norm(plan.usual_standard_errors))
    family.show("known.optimal.bound", np.linalg.norm(plan.standard_errors))
    family.show("known.saved", (found[0] / found[1]) ** 2)


def nothing(family: Family, draws: int) -> None:
    usual = hj.multisine(periods=128, lines="odd").scaled(RMS)
    first = hj.multisine(periods=64, lines="odd").scaled(RMS)
    begun = family.recorded(first)
    noise = family.noise(begun[0])
    strides, saved = [], []

    def guess(rng):
        return measured(begun[rng.integers(PHASES)], first, noise, rng)

    for seed in range(BLOCKS):
        known = guess(np.random.default_rng(seed))
        plan = hj.optimal_design(hj.fit_multipliers(known, 2), usual, noise=noise)
        data = family.recorded(plan.design)

        def fit(rng, data=data, plan=plan):
            block = measured(data[rng.integers(PHASES)], plan.design, noise, rng)
            return hj.fit_multipliers(joined(guess(rng), block), 2)

        error = rms_error(family, fit, draws // BLOCKS, seed)
        strides.append(first.cycles(0) + plan.strides)
        truth = hj.optimal_design(family.model, usual, noise=noise)
        equal = truth.usual_criterion * usual.cycles(0) / strides[-1]
        saved.append(equal / error**2)
    family.show("nothing.first_strides", first.cycles(0))
    family.show("nothing.strides", strides[0])
    family.show("nothing.saved", len(saved) / np.sum(1 / np.array(saved)))
    family.show("nothing.saved.least", np.min(saved))


STEPS = {"bound": bounds, "known": known, "nothing": nothing}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS))
    options = parser.parse_args()
    hj.enable_x64()
    hj.enable_compilation_cache()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for name, definition in sections().items():
        family = Family(name, cycle, definition)
        for step in options.only:
            STEPS[step](family, options.draws)


if __name__ == "__main__":
    main()
