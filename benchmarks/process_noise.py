"""Multipliers from series of a system that noise drives: innovations against output error.

`synthetic_ldtp`, with every A 1.145 times as large, which makes multipliers of modulus
0.75; 300 cycles of white inputs of variance one. Noise enters where the first input does, white or
colored (0.8 of it is left after a section, which takes one state more), with a standard deviation
of `--size`; noise of the sensors, 0.1. The states at the starts are unknown. Printed, as `name
value` lines, beginning with the color, over `--draws` draws:

- `bound`: Cramer-Rao bound of the first multiplier for whoever knows the dimensions of the states.
- `ldtp.rms`, `ldtp.ratio` (to the bound), `ldtp.said`, `ldtp.covered`, `ldtp.p`: of
  `fit_ldtp(noise="innovations")` with given dimensions: rms error, rms standard error, how often
  its 95 % region holds the true multiplier, and the p-value of 95 % (binomial test).
- `series.rms`, `series.covered`, `series.p`: the same of `fit_series`, which takes what is left for
  noise of the sensors; `strides`: the square of the ratio of the rms errors.
- `white.fit`: how often `validate` calls the predictions of the fit white at the level of 5 %, on
  other data. `white.simulated`: how often it calls the residuals of the true model white.
- `ldtp.seconds`: CPU seconds of a fit; `ldtp.unconverged`.

    python benchmarks/process_noise.py [--draws 200] [--size 0.3] [--colors white colored]
"""

import argparse
import time

import equinox as eqx
import numpy as np
from scipy import stats

import hybridjax as hj
from hybridjax.identify.denominator import multipliers_of
from hybridjax.identify.multiplier_estimate import MultiplierEstimate
from hybridjax.identify.periodic import (
    PeriodicModel,
    characteristic_slopes,
    local_coordinates,
)
from hybridjax.identify.series.prediction import SeriesPart, SeriesProblem
from hybridjax.identify.series.records import CycleGrid


CYCLES, SENSOR, COLOR, GROWTH = 300, 0.1, 0.8, 1.145


def system() -> hj.linear.LDTP:
    model = hj.testing.synthetic_ldtp()
    return eqx.tree_at(lambda m: m.A, model, GROWTH * model.A)


def truth(
    size: float, color: float
) -> tuple[hj.linear.LDTP, hj.linear.LDTP, hj.linear.LDTP]:
    """The system, the same with the states of the noise, and the noise, with the states of both."""
    plant = system()
    own = PeriodicModel.of(plant, np.ones(2))
    N, nu, ny = plant.n_sections, 1, 2  # (of the noise)
    A, B, C, inputs = [], [], [], []
    for n in range(N):
        a, b = own.A[n], own.B[n][:, :1]
        if color:
            zero = np.zeros((nu, a.shape[1]))
            A.append(np.block([[a, b], [zero, color * np.eye(nu)]]))
            B.append(np.concatenate([0 * b, size * np.sqrt(1 - color**2) * np.eye(nu)]))
            C.append(np.concatenate([own.C[n], own.D[n][:, :1]], axis=1))
            inputs.append(np.pad(own.B[n], [(0, nu), (0, 0)]))
        else:
            A.append(a)
            B.append(size * b)
            C.append(own.C[n])
            inputs.append(own.B[n])
    direct = [np.zeros((ny, nu)) if color else size * D[:, :1] for D in own.D]
    B = [np.concatenate([b, np.zeros((len(b), ny))], axis=1) for b in B]
    D = [np.concatenate([d, SENSOR * np.eye(ny)], axis=1) for d in direct]
    noise = hj.linear.LDTP.from_blocks(A, B, C, D, outputs=plant.outputs)
    return (
        plant,
        hj.linear.LDTP.from_blocks(A, inputs, C, own.D, plant.inputs, plant.outputs),
        noise,
    )


def draw(
    plant: hj.linear.LDTP, noise: hj.linear.LDTP, rng: np.random.Generator
) -> hj.experiments.SectionSeries:
    n, before = 6 * CYCLES, 6 * 20
    u = rng.normal(size=(n + before, 2))
    y = np.asarray(plant.simulate(u)) + np.asarray(
        noise.simulate(rng.normal(size=(len(u), 3)))
    )
    return hj.experiments.SectionSeries(
        u[before:], y[before:], n_sections=6, outputs=plant.outputs
    )


def innovations(noise: PeriodicModel) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the Kalman gain and the covariance of the innovations of the steady state.

    The periodic Riccati equation is iterated (Bittanti and Colaneri 2009) from the covariance of
    the state without measurements, after as many periods as the state has coordinates: it has the
    units of the states, and all noise has reached it.
    """
    P = np.zeros((noise.dims[0], noise.dims[0]))
    for _ in range(noise.dims[0]):
        for A, B in zip(noise.A, noise.B, strict=True):
            P = A @ P @ A.T + B @ B.T
    unit, S = (
        np.sqrt(np.diag(P)),
        np.zeros((noise.n_sections, *noise.D[0].shape[:1] * 2)),
    )
    for _ in range(10_000):
        before, K = (P, S), []
        S = np.zeros_like(S)
        for n, (A, B, C, D) in enumerate(
            zip(noise.A, noise.B, noise.C, noise.D, strict=True)
        ):
            S[n] = C @ P @ C.T + D @ D.T
            K.append(np.linalg.solve(S[n], (A @ P @ C.T + B @ D.T).T).T)
            left, entering = A - K[-1] @ C, B - K[-1] @ D
            P = left @ P @ left.T + entering @ entering.T
        sizes = np.sqrt(np.diagonal(S, axis1=1, axis2=2))
        if all(
            (np.abs(new - old) <= 1e-12 * size[..., :, None] * size[..., None, :]).all()
            for new, old, size in zip((P, S), before, (unit, sizes), strict=True)
        ):
            return K, S
    raise ValueError("the noise has no steady state: give a stable model of it.")


def bound(
    joint: hj.linear.LDTP,
    noise: hj.linear.LDTP,
    records: list[hj.experiments.SectionSeries],
) -> float:
    """Of the first multiplier, from the information in some records."""
    K, S = innovations(PeriodicModel.of(noise, np.ones(2)))
    model = PeriodicModel.of(joint, np.ones(2))._replace(K=K)
    coordinates = local_coordinates(model, True)
    parts = [SeriesPart.of(CycleGrid.from_records([r]), np.ones(2)) for r in records]
    problem = SeriesProblem(parts, S, True, True, 0)
    c, slopes = characteristic_slopes(coordinates)
    root = slopes @ problem.linearize(coordinates).spread().root * np.sqrt(len(records))
    found = MultiplierEstimate(multipliers_of(c), c, root @ root.T, np.inf)
    true = system().multipliers[0]
    return float(found.standard_errors[np.abs(found.multipliers - true).argmin()])


def one(plant, joint, noise, rng) -> dict[str, float]:
    data, other = draw(plant, noise, rng), draw(plant, noise, rng)
    true = np.asarray(plant.multipliers)[:1]
    began = time.process_time()
    fit = hj.fit_ldtp(data, joint.dims, noise="innovations")
    seconds = time.process_time() - began
    free = hj.fit_series(data, 2, check=False)
    at = int(np.abs(fit.multipliers - true).argmin())
    checks = {
        "fit": hj.validate(fit, other, alpha=0.05),
        "simulated": hj.validate(plant, other, alpha=0.05),
    }
    return {
        "ldtp": float(np.abs(fit.multipliers - true)[at]),
        "said": float(fit.standard_errors[at]),
        "covered": float(fit.contains(true).all()),
        "series": float(np.abs(free.multipliers - true).min()),
        "series_covered": float(free.contains(true).all()),
        "unconverged": float(fit.result != hj.errors.Result.OK),
        "seconds": seconds,
    } | {name: float(check.white) for name, check in checks.items()}


def color(name: str, size: float, draws: int) -> None:
    def show(what, value):
        print(f"process_noise.{name}.{what} {value:.4g}", flush=True)

    def share(what, values):
        show(what, values.mean())
        p = stats.binomtest(int(values.sum()), draws, 0.95).pvalue
        show(f"{what.partition('.')[0]}.p", p)

    plant, joint, noise = truth(size, COLOR if name == "colored" else 0.0)
    rng = np.random.default_rng(0)
    least = bound(joint, noise, [draw(plant, noise, rng) for _ in range(10)])
    show("bound", least)
    found = hj.scale.monte_carlo(lambda rng: one(plant, joint, noise, rng), draws)
    rms = {
        k: float(np.sqrt((found[k] ** 2).mean())) for k in ("ldtp", "said", "series")
    }
    show("ldtp.rms", rms["ldtp"])
    show("ldtp.ratio", rms["ldtp"] / least)
    show("ldtp.said", rms["said"])
    share("ldtp.covered", found["covered"])
    show("series.rms", rms["series"])
    share("series.covered", found["series_covered"])
    show("strides", (rms["series"] / rms["ldtp"]) ** 2)
    show("white.fit", found["fit"].mean())
    show("white.simulated", found["simulated"].mean())
    show("ldtp.unconverged", found["unconverged"].sum())
    show("ldtp.seconds", found["seconds"].median())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument(
        "--size", type=float, default=0.1, help="of the noise that drives"
    )
    parser.add_argument("--colors", nargs="*", default=("white", "colored"))
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    for name in options.colors:
        color(name, options.size, options.draws)


if __name__ == "__main__":
    main()
