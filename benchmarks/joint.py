"""What the structure of a linear periodic model is worth, and whether its fit reaches the bound.

The hopper's LDTP between the sections of both families, HTFs of all 32 harmonics at the lines of 20
experiments of 84 cycles (odd lines, rms of u 0.02), with independent Gaussian errors: those of
white noise at `--snr` dB of each output. Printed, as `name value` lines, beginning with the family:

- `bound.numerators`, `bound.ldtp`: Cramer-Rao bounds of the first multiplier, all numerators free
  and the LDTP's matrices unknown; `strides`: the square of their ratio.
- `numerators.rms`, `ldtp.rms`: errors of `fit_multipliers` and of `fit_ldtp`, over `--draws` draws;
  `numerators.ratio`, `ldtp.ratio`: to their bounds. `ldtp.said`: rms of its standard errors.
  `ldtp.covered`: how often its 95 % region holds the true multiplier; `p`: of the binomial test.
- `ldtp.seconds`: CPU seconds of one fit without its start; `ldtp.unconverged`: fits that
  did not converge.

    python benchmarks/joint.py [--draws 200] [--snr 20] [--families isochron kinematic]
"""

import argparse
import time

import equinox as eqx
import numpy as np
from scipy import stats
from second_order import OUTPUTS, sections

import hybridjax as hj
from hybridjax.identify.joint.realization import realized_htf
from hybridjax.identify.realization import realized


N = 32


def with_variances(model: hj.linear.LDTP, snr: float) -> hj.linear.HTF:
    """Exact HTFs, with the variances that noise gives them in these experiments."""
    design = hj.multisine(periods=84, lines="odd").scaled(0.02)
    y = hj.experiments.simulate_experiments(model, design, start="periodic").y
    sigma = np.std(y, axis=(0, 1)) * 10 ** (-snr / 20)
    exact = model.htf(design.frequencies)
    each = 4 * sigma[:, None] ** 2 / (N * design.periods * design.amplitude[0] ** 2)
    return hj.linear.HTF(
        exact.frequencies,
        exact.H,
        exact.harmonics,
        N,
        model.inputs,
        model.outputs,
        variance=np.broadcast_to(each, exact.H.shape),
    )


def minimal_dims(model: hj.linear.LDTP) -> np.ndarray:
    """What is known of the structure: how many states there are at each section."""
    response = np.asarray(model.impulse_response(4 * N + 1))
    return np.asarray(realized(response).dims)


def one(
    htf: hj.linear.HTF, dims: np.ndarray, true: np.ndarray, rng: np.random.Generator
) -> dict[str, float]:
    error = rng.normal(size=(2, *htf.H.shape)) * np.sqrt(np.asarray(htf.variance) / 2)
    draw = eqx.tree_at(lambda h: h.H, htf, htf.H + error[0] + 1j * error[1])
    start = realized_htf(draw, dims)
    start = eqx.tree_at(lambda model: model.D, start, 0 * start.D)  # (and stays so)
    began = time.process_time()
    fit = hj.fit_ldtp(draw, initial=start)
    seconds = time.process_time() - began
    free = hj.fit_multipliers(draw.select(range(-4, 5)), 2)
    return {
        "numerators": float(np.abs(free.multipliers - true).min()),
        "ldtp": float(np.abs(fit.multipliers - true).min()),
        "said": float(fit.standard_errors[np.abs(fit.multipliers - true).argmin()]),
        "covered": float(fit.contains(true).all()),
        "unconverged": float(fit.result != hj.errors.Result.OK),
        "seconds": seconds,
    }


def family(name: str, model: hj.linear.LDTP, snr: float, draws: int) -> None:
    def show(what, value):
        print(f"joint.{name}.{what} {value:.4g}", flush=True)

    htf, true = with_variances(model, snr), np.asarray(model.multipliers)[:1]
    dims = minimal_dims(model)
    free = hj.identify.cramer_rao(model, htf.select(range(-4, 5))).standard_errors[0]
    joint = hj.identify.cramer_rao(model, htf, estimator="fit_ldtp").standard_errors[0]
    show("bound.numerators", free)
    show("bound.ldtp", joint)
    show("strides", (free / joint) ** 2)
    found = hj.scale.monte_carlo(lambda rng: one(htf, dims, true, rng), draws)
    rms = {
        k: float(np.sqrt((found[k] ** 2).mean()))
        for k in ("numerators", "ldtp", "said")
    }
    show("numerators.rms", rms["numerators"])
    show("numerators.ratio", rms["numerators"] / free)
    show("ldtp.rms", rms["ldtp"])
    show("ldtp.ratio", rms["ldtp"] / joint)
    show("ldtp.said", rms["said"])
    show("ldtp.covered", found["covered"].mean())
    show("p", stats.binomtest(int(found["covered"].sum()), draws, 0.95).pvalue)
    show("ldtp.unconverged", found["unconverged"].sum())
    show("ldtp.seconds", found["seconds"].median())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--snr", type=float, default=20.0, help="dB, of the series")
    parser.add_argument("--families", nargs="*", default=("isochron", "kinematic"))
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    for name, definition in sections().items():
        if name in options.families:
            model = hj.linearize(cycle, definition, OUTPUTS)
            family(name, model, options.snr, options.draws)


if __name__ == "__main__":
    main()
