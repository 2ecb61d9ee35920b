"""Populations of hoppers: intervals of means and spreads, maps, power and predictions of subjects.

A pool of hoppers is simulated and fitted once; its spring and damper have a spread of 4 %. Each is
a subject with 60 to 300 strides (uniform), with white inputs between 8 isochrons (rms 0.03) and
white measurement noise (2 mm, 2 cm/s). Every third is also fitted with its first 40 strides.
Populations are drawn from the pool without replacement, so that the truth is the mean, the spread
or the map of the pool. `command` times `hybridjax identify --table` on 20 subjects with 3 trials of
5 minutes.

Printed: `name value` lines; `p` is that of the binomial test of 95 %.

    python benchmarks/population.py [--pool pool.npz] [--subjects 1500] [--only mean maps ...]
"""

import argparse
import pathlib

import equinox as eqx
import jax
import numpy as np

import hybridjax as hj


N, LAGS, LONGEST, SHORT = 8, 16, 300, 40
OUTPUTS = ("yM", "vM")
NOISE = (2e-3, 2e-2)


def make_pool(path: pathlib.Path, subjects: int, chunk: int = 100) -> None:
    """Simulate and fit the subjects, and write true and estimated values."""
    rng = np.random.default_rng(0)
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    sections = hj.ClockPhase(N, anchor=hj.Crossing("vM", "falling"))
    response = hj.response_function(cycle, sections, OUTPUTS)
    run = eqx.filter_jit(eqx.filter_vmap(lambda hopper, u: response(u[None], system=hopper).y))
    rows = []
    for first in range(0, subjects, chunk):
        k, b = (value * (1 + 0.04 * rng.normal(size=chunk)) for value in (10.0, 5.0))
        hoppers = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)
        true = np.asarray(hj.find_limit_cycles(hoppers, guess=cycle).multipliers)[:, 0]
        u = 0.03 * rng.normal(size=(chunk, LONGEST * N, 1))
        y = np.asarray(jax.block_until_ready(run(hoppers, u) - run(hoppers, 0 * u)))[:, 0]
        y = y + rng.normal(size=y.shape) * NOISE
        for s in range(chunk):
            strides = int(rng.integers(60, LONGEST + 1))
            fit = fitted(u[s], y[s], strides)
            short = fitted(u[s], y[s], SHORT) if s % 3 == 0 else None
            rows.append({
                "true": true[s], "strides": strides, "fit": fit.multipliers[0],
                "covariance": fit.multiplier_covariances[0], "freedom": fit.covariance_freedom,
                "short": short.multipliers[0] if short else np.nan,
                "short_covariance": short.multiplier_covariances[0] if short else np.eye(2),
                "map": fit.impulse_response(LAGS)[:, :, 0, 0],
            })  # fmt: skip
        print(f"{first + chunk} of {subjects} subjects", flush=True)
    np.savez(path, **{name: np.array([row[name] for row in rows]) for name in rows[0]})


def fitted(u, y, strides):
    record = hj.Record(
        u[: strides * N], y[: strides * N], n_sections=N, inputs={"u": "N"},
        outputs={"yM": "m", "vM": "m/s"},
    )  # fmt: skip
    return hj.fit_series(record, 2, overhang=0, start="cycle", check=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pool", type=pathlib.Path, default=pathlib.Path("pool.npz"))
    parser.add_argument("--subjects", type=int, default=1500)
    options = parser.parse_args()
    hj.enable_x64()
    if not options.pool.exists():
        make_pool(options.pool, options.subjects)


if __name__ == "__main__":
    main()
