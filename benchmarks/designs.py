"""What designs made for the question are worth, in strides.

The nonlinear hopper between the paper's two families of sections, white noise on both outputs (20
dB in the usual design), and multipliers by `fit_multipliers`. "Saved" is the ratio of the squared
rms errors at equal numbers of strides (and equal rms of the input). Printed, as `name value` lines:

- `bound`: Cramer-Rao bounds of the usual design (620 lines, 20 experiments) and of the optimal one,
  input or output limited, what is saved, the certificate, and seconds of the process to find it;
  `slow`: what is saved, input limited, over equal amplitudes up to f = 2 only.
- `known`: rms errors of draws with new noise, four draws of the phases; the model is known. The
  input's rms is 0.001, on odd lines (P = 128), so that distortion is below noise. `strong`: the
  same for a rms of 0.02 and 0.1.
- `nothing`: from nothing, by `hj.designs.SequentialDesign`, which is asked for a standard error of
  5e-5: 640 strides of equal amplitudes, then designs made from what was measured, until it stops.
  The noise is not known either. All strides are counted, and compared with those of equal
  amplitudes whose bound is the rms error that was reached.
- `stopping`: of the same studies, how many regions of 95 % held the true multipliers at the time of
  stopping, the p-value of that number, and the standard error that was asked for, said and true.
- `goals`: bounds of other goals, of both limits: multipliers by `fit_ldtp`, the harmonic transfer
  functions for f from 0.1 to 1, one multiplier or two. `peak`: multipliers, rms of u 0.01 and peak
  0.02; `price`: strides that the peak costs.
- `parameters`: stiffness and damping of the spring by `fit_model`, input limited.
- `deviation`: deviations of both outputs limited: all lines and `fit_multipliers` against a design
  for `fit_ldtp` and that fit. Beside it bounds of the multiplier by `fit_model`.
- `distortion`: the part of second order of both outputs limited, to a tenth of the noise: what is
  saved over equal amplitudes, and over the design for a limited input, as large as it allows; what
  is not linear in a simulation, relative to the prediction, and the part of it that is odd in u.
- `walkers`: the compass gait's leading pair and the rimless wheel, pushed by phase, input limited;
  `all`: the bound where all multipliers are wanted; `usual.quiet.ratio`: rms error to bound with a
  tenth of the noise.

    python benchmarks/designs.py [--draws 200] [--only bound known ...] [--families isochron ...]

(For 200 draws `walkers` takes 6 CPU minutes. `nothing` and `stopping` take some 5 CPU seconds for
each draw and family, `deviation` 12; `parameters` first compiles for a minute or two.)
"""

import argparse
import functools
import time

import numpy as np
from design_distortion import distortion
from design_questions import HARMONICS, deviation, goals, measured, parameters
from design_walkers import walkers
from scipy import stats
from second_order import OUTPUTS, sections

import hybridjax as hj


RMS = 0.001
PHASES = 4
# Standard error of the multiplier that studies are asked for.
PRECISION = 5e-5


class Family:
    """The hopper between the sections of one family."""

    def __init__(self, name: str, cycle, definition):
        self.name, self.cycle = name, cycle
        self.placed = hj.sections.place_sections(cycle, definition)
        self.model = hj.linearize(cycle, self.placed, OUTPUTS)

    def show(self, name: str, value: float) -> None:
        print(f"designs.{self.name}.{name} {value:.4g}", flush=True)

    def recorded(
        self, design: hj.experiments.Design, seed: int = 1
    ) -> list[hj.experiments.ExperimentData]:
        """Without noise, for some draws of the phases."""
        drawn = [design.realizations(1, seed=seed + k) for k in range(PHASES)]
        return [
            hj.run_experiments(self.cycle, self.placed, one, OUTPUTS, start="steady")
            for one in drawn
        ]

    def noise(self, data: hj.experiments.ExperimentData) -> dict[str, float]:
        """20 dB below the outputs."""
        rms = np.sqrt(np.mean(data.y**2, axis=(0, 1)))
        return dict(zip(OUTPUTS, 0.1 * rms, strict=True))


def rms_error(family: Family, fit, draws: int, seed: int) -> float:
    """Of the pair of multipliers, over draws of `fit(rng)`."""
    truth = family.model.multipliers

    def error(rng):
        return fit(rng).compare(truth).error[0]

    return float(
        np.sqrt(np.mean(hj.scale.monte_carlo(error, draws, seed).value.values ** 2))
    )


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
            family.show(
                f"bound.{limit}.deviation.{name}", plan.rms[name] / plan.usual_rms[name]
            )
        family.show(f"bound.{limit}.cpu_seconds", seconds)
    noise = {"yM": 6e-6, "vM": 1.2e-5}
    usual = (hj.multisine().scaled(RMS), hj.multisine(frequencies=(0, 2)).scaled(RMS))
    plan, slow = (hj.optimal_design(family.model, x, noise=noise) for x in usual)
    as_much = slow.usual_criterion * usual[1].cycles(0)
    family.show("bound.slow.saved", as_much / (plan.criterion * plan.design.cycles(0)))


def strong(family: Family, draws: int) -> None:
    for rms in (0.02, 0.1):
        known(family, draws, rms, f"strong.{rms}")


def known(family: Family, draws: int, rms: float = RMS, row: str = "known") -> None:
    usual = hj.multisine(periods=128, lines="odd").scaled(rms)
    before = family.recorded(usual)
    noise = family.noise(before[0])
    plan = hj.optimal_design(family.model, usual, noise=noise)
    found = []
    for name, design, data in (
        ("usual", usual, before),
        ("optimal", plan.design, family.recorded(plan.design)),
    ):

        def fit(rng, data=data, design=design):
            htf = measured(data[rng.integers(PHASES)], design, noise, HARMONICS, rng)
            return hj.fit_multipliers(htf, 2)

        found.append(rms_error(family, fit, draws, seed=3))
        family.show(f"{row}.{name}.rms_error", found[-1])
    family.show(f"{row}.usual.bound", np.linalg.norm(plan.usual_standard_errors))
    family.show(f"{row}.optimal.bound", np.linalg.norm(plan.standard_errors))
    family.show(f"{row}.saved", (found[0] / found[1]) ** 2)


def study(
    family: Family, rng, first, begun, noise: dict[str, float]
) -> hj.designs.SequentialDesign:
    """One, from nothing to its end; `begun`: responses to the first blocks, without noise."""
    k = int(rng.integers(PHASES))
    found = hj.designs.SequentialDesign(
        first[k], order=2, standard_error=PRECISION, seed=int(rng.integers(999))
    )
    data = begun[k]
    while not found.done:
        std, seed = list(noise.values()), int(rng.integers(2**31))
        found = found.add(hj.experiments.add_noise(data, std=std, seed=seed))
        if not found.done:
            data = hj.run_experiments(
                family.cycle, family.placed, found.design, OUTPUTS, start="steady"
            )
    return found


@functools.cache
def studies(family: Family, draws: int) -> np.ndarray:
    """Strides, blocks, error, and whether the region of 95 % held the truth, of each draw."""
    equal = hj.multisine(periods=32, lines="odd").scaled(RMS)
    first = [equal.realizations(1, seed=1 + k) for k in range(PHASES)]
    begun = family.recorded(equal)
    truth, rows = family.model.multipliers, []
    for seed in range(draws):
        done = study(
            family, np.random.default_rng(seed), first, begun, family.noise(begun[0])
        )
        error = done.fit.compare(truth).error[0]
        held = bool(done.fit.contains(truth)[0])
        rows.append(
            (done.cycles[-1], done.blocks, error, held, done.standard_errors[-1, 0])
        )
    return np.array(rows)


def nothing(family: Family, draws: int) -> None:
    strides, blocks, error, *_ = studies(family, draws).T
    equal = hj.multisine(periods=32, lines="odd").scaled(RMS)
    noise = family.noise(family.recorded(equal)[0])
    bound = hj.optimal_design(family.model, equal, noise=noise)
    as_much = bound.usual_criterion * equal.cycles(0) / np.mean(error**2)
    family.show("nothing.first_strides", equal.cycles(0))
    family.show("nothing.strides", np.mean(strides))
    family.show("nothing.strides.most", np.max(strides))
    family.show("nothing.blocks", np.mean(blocks))
    family.show("nothing.rms_error", np.sqrt(np.mean(error**2)))
    family.show("nothing.equal_strides", as_much)
    family.show("nothing.saved", as_much / np.mean(strides))


def stopping(family: Family, draws: int) -> None:
    *_, error, held, said = studies(family, draws).T
    family.show("stopping.draws", draws)
    family.show("stopping.held", np.sum(held))
    family.show("stopping.p", stats.binomtest(int(held.sum()), draws, 0.95).pvalue)
    family.show("stopping.asked", PRECISION)
    family.show("stopping.said", np.sqrt(np.mean(said**2)))
    family.show("stopping.rms_error", np.sqrt(np.mean(error**2)))


STEPS = {
    "bound": bounds,
    "known": known,
    "strong": strong,
    "nothing": nothing,
    "stopping": stopping,
    "goals": goals,
    "parameters": parameters,
    "deviation": deviation,
    "distortion": distortion,
}
ALL = [*STEPS, "walkers"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", nargs="+", choices=ALL, default=ALL)
    parser.add_argument("--families", nargs="+", default=("isochron", "kinematic"))
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for name in options.families:
        family = Family(name, cycle, sections()[name])
        for step in STEPS:
            if step in options.only:
                STEPS[step](family, options.draws)
    if "walkers" in options.only:
        walkers(options.draws)


if __name__ == "__main__":
    main()
