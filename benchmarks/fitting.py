"""How well the hopper's parameters are fitted, what it costs, and how honest the errors are.

Free are m, M, k, b, l0, a and g, on 8 isochrons, from `htf`: harmonics -1, 0 and 1 of both outputs
at 20 frequencies, and `series`: two experiments of 8 cycles with white input (rms 0.05) from the
limit cycle. Printed, as `name value` lines:

- `seen`: how many combinations of the 7 parameters the data see; the others are named.
- `first`: CPU seconds of the first fit, nearly all of it for tracing and compiling.
- `exact`: fits to data without noise, `--seeds` systems with every parameter wrong by up to 20 %,
  each with up to 4 guesses (itself and others within 20 % of it). `worst`: largest relative error
  of a combination that is seen; `good`: how many are within 1e-6; `guesses` and `steps`:
  guesses and evaluations in all; `cpu`: seconds for each fit.
- `noise`: fits to `--draws` draws of white noise at 40 dB, starting at the truth. `covered`: how
  often the joint 95 % region holds the true parameters; `p`: of the two-sided binomial test;
  `mean`: mean chi square relative to its expectation.

    python benchmarks/fitting.py [--only htf,series] [--seeds 50] [--draws 200]
"""

import argparse
import time

import numpy as np
from scipy import stats

import hybridjax as hj


NAMES = ("m", "M", "k", "b", "l0", "a", "g")
OUTPUTS = ("yM", "vM")
SECTIONS = hj.ClockPhase(8, anchor=hj.Crossing("vM", "falling"))
SNR = 40


class HTFs:
    """Fits to harmonic transfer functions."""

    def __init__(self, cycle):
        model = hj.linearize(cycle, SECTIONS, OUTPUTS)
        self.exact = model.htf(np.arange(0.1, 4, 0.2), (-1, 0, 1))
        H = np.asarray(self.exact.H)
        rms = np.sqrt(np.mean(np.abs(H) ** 2, axis=(0, 1, 3), keepdims=True))
        self.std = np.broadcast_to(rms * 10 ** (-SNR / 20), H.shape)

    def clean(self):
        return hj.fitting.ObservedHTF(self.exact, SECTIONS)

    def noisy(self, seed: int):
        real, imag = np.random.default_rng(seed).normal(size=(2, *self.std.shape))
        H = np.asarray(self.exact.H) + self.std * (real + 1j * imag) / np.sqrt(2)
        noisy = hj.linear.HTF(
            self.exact.frequencies,
            H,
            self.exact.harmonics,
            SECTIONS.n_sections,
            self.exact.inputs,
            OUTPUTS,
            variance=self.std**2,
        )
        return hj.fitting.ObservedHTF(noisy, SECTIONS)


class Series:
    """Fits to outputs at the sections."""

    def __init__(self, cycle):
        u = 0.05 * np.random.default_rng(0).normal(size=(2, 8 * SECTIONS.n_sections, 1))
        self.data = hj.run_experiments(
            cycle, SECTIONS, u, OUTPUTS, start="cycle", discard=0
        )
        self.std = np.sqrt(np.mean(self.data.y**2, axis=(0, 1))) * 10 ** (-SNR / 20)

    def clean(self):
        return hj.fitting.ObservedSeries(self.data, SECTIONS)

    def noisy(self, seed: int):
        return hj.fitting.ObservedSeries(
            hj.experiments.add_noise(self.data, snr=SNR, seed=seed), SECTIONS, self.std
        )


def show(name: str, value) -> None:
    print(
        f"fitting.{name} {value:.4g}" if not isinstance(value, str) else value,
        flush=True,
    )


def exact(kind: str, data, cycle, seeds: int) -> None:
    true = np.array([float(getattr(cycle.system, name)) for name in NAMES])
    errors, guesses, steps, seconds = [], [], [], []
    for seed in range(seeds):
        factors = 1 + 0.2 * np.random.default_rng(seed).uniform(-1, 1, len(NAMES))
        wrong = hj.models.VerticalHopper(
            **dict(zip(NAMES, true * factors, strict=True))
        )
        begin = time.process_time()
        fit = hj.fit_model(
            wrong, data.clean(), NAMES, guess=cycle, guesses=4, seed=seed
        )
        seconds.append(time.process_time() - begin)
        if seed == 0:
            show(f"{kind}.first", seconds.pop())
            show(f"{kind}.seen", fit.identifiability.rank)
            for text in fit.identifiability.descriptions():
                print(f"fitting.{kind}.not_seen {text}")
        errors.append(np.abs(seen_errors(fit, true)).max())
        guesses.append(len(fit.guesses))
        steps.append(sum(guess.steps for guess in fit.guesses))
    show(f"{kind}.exact.worst", max(errors))
    show(f"{kind}.exact.good", np.sum(np.array(errors) < 1e-6))
    show(f"{kind}.exact.of", seeds)
    show(f"{kind}.exact.guesses", sum(guesses))
    show(f"{kind}.exact.steps", sum(steps))
    show(f"{kind}.exact.cpu", np.mean(seconds))


def seen_errors(fit, true) -> np.ndarray:
    """Relative errors of all that the data see: logarithms without their unseen part."""
    error = np.log(fit.values / true)
    unseen = fit.identifiability.unseen
    return error - np.linalg.pinv(unseen) @ (unseen @ error)


def noise(kind: str, data, cycle, draws: int) -> None:
    fits = [
        hj.fit_model(cycle.system, data.noisy(seed), NAMES, guess=cycle)
        for seed in range(draws)
    ]
    inside = sum(fit.contains(cycle.system) for fit in fits)
    show(
        f"{kind}.noise.converged",
        sum(fit.result == hj.errors.Result.OK for fit in fits),
    )
    show(f"{kind}.noise.covered", inside / draws)
    show(f"{kind}.noise.p", stats.binomtest(inside, draws, 0.95).pvalue)
    ratio = [fit.chi_square(cycle.system) / fit.identifiability.rank for fit in fits]
    show(f"{kind}.noise.mean", np.mean(ratio))
    cost = [fit.cost / fit.dof for fit in fits]
    show(f"{kind}.noise.cost", np.mean(cost))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = {"htf": HTFs, "series": Series}
    parser.add_argument("--only", default="htf,series", help="of htf,series")
    parser.add_argument(
        "--seeds", type=int, default=50, help="wrong systems without noise"
    )
    parser.add_argument("--draws", type=int, default=200, help="draws of noise")
    options = parser.parse_args()
    hj.enable_x64()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for kind in options.only.split(","):
        data = kinds[kind](cycle)
        exact(kind, data, cycle, options.seeds)
        noise(kind, data, cycle, options.draws)


if __name__ == "__main__":
    main()
