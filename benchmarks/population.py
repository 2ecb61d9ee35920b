"""Populations of hoppers: intervals of means and spreads, maps, power and predictions of subjects.

A pool of hoppers is simulated and fitted once; its spring and damper have a spread of 4 %. Each is
a subject with 60 to 300 strides (uniform), with white inputs between 8 isochrons (rms 0.03) and
white measurement noise (2 mm, 2 cm/s). Every third is also fitted with its first 40 strides.
Populations are drawn from the pool without replacement, so that the truth is the mean, the spread
or the map of the pool. `command` times `hybridjax identify --table` on 20 subjects with 3 trials of
5 minutes.

Printed: `name value` lines; `p` is that of the binomial test of 95 %.

    python benchmarks/population.py [--pool pool.npz] [--subjects 1500] [--only means maps ...]
"""

import argparse
import contextlib
import pathlib
import resource
import subprocess
import sys
import tempfile
import time

import equinox as eqx
import jax
import numpy as np
from scipy import stats

import hybridjax as hj


N, LAGS, LONGEST, SHORT = 8, 16, 300, 40
OUTPUTS = ("yM", "vM")
NOISE = (2e-3, 2e-2)


def make_pool(path: pathlib.Path, subjects: int, chunk: int = 100) -> None:
    """Simulate and fit the subjects, and write true and estimated values."""
    rng = np.random.default_rng(0)
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    sections = hj.ClockPhase(N, anchor=hj.Crossing("vM", "falling"))
    response = hj.experiments.response_function(cycle, sections, OUTPUTS)
    run = eqx.filter_jit(
        eqx.filter_vmap(lambda hopper, u: response(u[None], system=hopper).y)
    )
    rows = []
    for first in range(0, subjects, chunk):
        k, b = (value * (1 + 0.04 * rng.normal(size=chunk)) for value in (10.0, 5.0))
        hoppers = eqx.filter_vmap(lambda k, b: hj.models.VerticalHopper(k=k, b=b))(k, b)
        true = np.asarray(
            hj.orbits.find_limit_cycles(hoppers, guess=cycle).multipliers
        )[:, 0]
        u = 0.03 * rng.normal(size=(chunk, LONGEST * N, 1))
        y = np.asarray(jax.block_until_ready(run(hoppers, u) - run(hoppers, 0 * u)))[
            :, 0
        ]
        y = y + rng.normal(size=y.shape) * NOISE
        for s in range(chunk):
            strides = int(rng.integers(60, LONGEST + 1))
            fit = fitted(u[s], y[s], strides)
            short = fitted(u[s], y[s], SHORT) if s % 3 == 0 else None
            rows.append(
                {
                    "true": true[s],
                    "strides": strides,
                    "fit": fit.multipliers[0],
                    "covariance": fit.multiplier_covariances[0],
                    "dof": fit.covariance_dof,
                    "short": short.multipliers[0] if short else np.nan,
                    "short_covariance": short.multiplier_covariances[0]
                    if short
                    else np.eye(2),
                    "short_freedom": short.covariance_dof if short else np.nan,
                    "map": fit.impulse_response(LAGS)[:, :, 0, 0],
                }
            )
        print(f"{first + chunk} of {subjects} subjects", flush=True)
    np.savez(path, **{name: np.array([row[name] for row in rows]) for name in rows[0]})


def fitted(u, y, strides):
    record = hj.experiments.SectionSeries(
        u[: strides * N],
        y[: strides * N],
        n_sections=N,
        inputs={"u": "N"},
        outputs={"yM": "m", "vM": "m/s"},
    )
    return hj.fit_series(record, 2, extra_lags=0, start="cycle", check=False)


def moduli(pool, kind="fit") -> tuple[np.ndarray, np.ndarray]:
    """Return moduli and their standard errors, as `Population.from_fits` computes them."""
    z = pool[kind]
    covariance = pool["covariance" if kind == "fit" else "short_covariance"]
    slope = np.stack([z.real, z.imag], axis=1) / np.abs(z)[:, None]
    return np.abs(z), np.sqrt(np.einsum("ni,nij,nj->n", slope, covariance, slope))


def show(name: str, value) -> None:
    print(f"population.{name} {value:.4g}", flush=True)


def show_held(name: str, held) -> None:
    held = np.asarray(held)
    show(f"{name}.held_percent", 100 * held.mean())
    show(f"{name}.populations", len(held))
    show(f"{name}.p", stats.binomtest(int(held.sum()), len(held), 0.95).pvalue)


def means(pool, populations: int = 400) -> None:
    """Intervals of the mean and the spread of the modulus."""
    y, error = moduli(pool)
    true, dof = np.abs(pool["true"]), pool["dof"]
    show("pool.subjects", len(y))
    show("pool.spread", true.std())
    show("pool.rms_standard_error", np.sqrt(np.mean(error**2)))
    show("pool.rms_error", np.sqrt(np.mean((y - true) ** 2)))
    show("pool.bias", np.mean(y - true))
    for n in (8, 12, 20):
        rng = np.random.default_rng(n)
        held, spread, plain = [], [], []
        for _ in range(populations):
            i = rng.choice(len(y), n, replace=False)
            row = population(y[i], error[i], dof[i], pool["strides"][i]).mean("modulus")
            held.append(row["low"][0] <= true.mean() <= row["high"][0])
            spread.append(row["spread_low"][0] <= true.std() <= row["spread_high"][0])
            plain.append(
                abs(y[i].mean() - true.mean())
                < stats.t.isf(0.025, n - 1) * stats.sem(y[i])
            )
        show_held(f"mean.{n}", held)
        show_held(f"mean_of_single_estimates.{n}", plain)
        show_held(f"spread.{n}", spread)


def population(y, error, dof, strides):
    table = {"subject": np.arange(len(y)), "strides": strides}
    return hj.recordings.Population(table, {"modulus": y}, {"modulus": error}, dof=dof)


def differences(pool, populations: int = 1000, n: int = 12) -> None:
    """Tests between two groups of 12 subjects, and of paired differences (two subjects stand for
    one), beside Student's t test of the estimates. Lengths: 60 to 300 strides, or half of the
    subjects with 40 and half with 190 to 210."""
    y, error = moduli(pool)
    short, short_error = moduli(pool, "short")
    spread = np.abs(pool["true"]).std()
    has = np.flatnonzero(np.isfinite(short) & np.isfinite(short_error))
    long = np.flatnonzero(np.abs(pool["strides"] - 200) <= 10)
    labels = np.repeat(["a", "b"], n)
    is_short = np.arange(2 * n) % 2 == 0
    for lengths in ("60_to_300", "40_and_200"):
        for design in ("groups", "paired"):
            factor = "group" if design == "groups" else "condition"
            subject = (
                np.arange(2 * n) if design == "groups" else np.tile(np.arange(n), 2)
            )
            for shift in (0.0, 1.0, 1.5):
                rng, rejected = np.random.default_rng(7), []
                for _ in range(populations):
                    i = rng.choice(len(y), 2 * n, replace=False)
                    data = [y[i], error[i], pool["dof"][i], pool["strides"][i]]
                    if lengths == "40_and_200":
                        i, j = (
                            rng.choice(x, 2 * n, replace=False) for x in (has, long)
                        )
                        few = short[i], short_error[i], pool["short_freedom"][i], SHORT
                        many = y[j], error[j], pool["dof"][j], pool["strides"][j]
                        data = [
                            np.where(is_short, *x) for x in zip(few, many, strict=True)
                        ]
                    values = data[0] + shift * spread * (labels == "a")
                    table = {"subject": subject, factor: labels, "strides": data[3]}
                    study = hj.recordings.Population(
                        table,
                        {"modulus": values},
                        {"modulus": data[1]},
                        dof=data[2],
                    )
                    p = study.difference("modulus", "a", "b")["p"][0]
                    two = values[:n], values[n:]
                    plain = (
                        stats.ttest_ind if design == "groups" else stats.ttest_rel
                    )(*two)
                    rejected.append((p < 0.05, plain.pvalue < 0.05))
                name = f"difference.{lengths}.{design}.{shift:g}_spreads"
                ours, plain = 100 * np.mean(rejected, axis=0)
                show(f"{name}.rejected_percent", ours)
                show(f"{name}.rejected_percent_by_t_test", plain)


def predictions(pool, populations: int = 400) -> None:
    """Predictions of a subject with 40 strides, one of 12 of which the others have 60 to 300; and
    of 12 subjects with 40 strides each."""
    y, error = moduli(pool)
    short, short_error = moduli(pool, "short")
    true, has = (
        np.abs(pool["true"]),
        np.flatnonzero(np.isfinite(short) & np.isfinite(short_error)),
    )
    show("prediction.spread", true.std())
    show(
        "prediction.rms_standard_error_of_40_strides",
        np.sqrt(np.mean(short_error[has] ** 2)),
    )
    show("prediction.median_standard_error_of_40_strides", np.median(short_error[has]))
    for name, count in (("one_of_12", 1), ("all_12", 12)):
        rng, errors, held = np.random.default_rng(3), [], []
        for _ in range(populations):
            few = rng.choice(has, count, replace=False)
            others = rng.choice(
                np.setdiff1d(np.arange(len(y)), few), 12 - count, replace=False
            )
            study = population(
                np.r_[short[few], y[others]],
                np.r_[short_error[few], error[others]],
                np.r_[pool["short_freedom"][few], pool["dof"][others]],
                np.r_[np.full(count, SHORT), pool["strides"][others]],
            )
            table = study.predictions("modulus")
            value = table["prediction"][:count]
            errors += [*zip(value - true[few], short[few] - true[few], strict=True)]
            held += [
                *(
                    (table["low"][:count] <= true[few])
                    & (true[few] <= table["high"][:count])
                )
            ]
        predicted, single = np.sqrt(np.mean(np.square(errors), axis=0))
        show(f"prediction.{name}.rms_error", predicted)
        show(f"prediction.{name}.rms_error_of_fit", single)
        show(f"prediction.{name}.ratio", predicted / single)
        show_held(f"prediction.{name}", held)


def maps(pool, populations: int = 1000, n: int = 12) -> None:
    """Family-wise error of maps (phase, lag) of 12 subjects without a difference, and bands."""
    values, N = pool["map"], pool["map"].shape[1]
    axes = {"phase": np.arange(N) / N, "lag": np.arange(values.shape[2]) / N}
    truth = values.mean(axis=0)
    rng = np.random.default_rng(5)
    results = {"paired": [], "groups": [], "band": []}
    for _ in range(populations):
        i = rng.choice(len(values), 2 * n, replace=False)
        table = {
            "subject": np.tile(np.arange(n), 2),
            "condition": np.repeat(["a", "b"], n),
        }
        paired = hj.recordings.PopulationMaps(table, values[i], axes).difference(
            "a", "b"
        )
        table = {"subject": np.arange(n), "group": np.repeat(["a", "b"], n // 2)}
        one = hj.recordings.PopulationMaps(table, values[i[:n]], axes)
        for name, test in (("paired", paired), ("groups", one.difference("a", "b"))):
            results[name].append(test.significant.any())
        band = one.mean()
        results["band"].append((np.abs(band.values - truth) <= band.reach).all())
    for name in ("paired", "groups"):
        show(f"maps.{name}.family_wise_error_percent", 100 * np.mean(results[name]))
    show("maps.populations", populations)
    show_held("maps.band", results["band"])


def command(
    subjects: int = 20, trials: int = 3, strides: int = 300, rate: int = 100
) -> None:
    """Time and memory of `hybridjax identify --table`, with two processes."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder, rows = pathlib.Path(name), ["file,subject,group"]
        for s in range(subjects):
            hopper = hj.models.VerticalHopper(k=10 * (1 + 0.04 * rng.normal()))
            cycle = hj.find_limit_cycle(hopper)
            force = [
                hj.experiments.random_input(
                    strides, rate, bandwidth=8, rms=0.02, seed=100 * s + k
                )
                for k in range(trials)
            ]
            made = np.stack(force)
            made = hj.testing.simulate_recording(
                cycle, made, OUTPUTS, rate=rate, steps=1
            )
            made = hj.testing.add_artifacts(made, OUTPUTS, noise=3e-4, seed=s)
            for k, trial in enumerate(made.trials):
                header = ",".join(("time", *made.signals))
                np.savetxt(
                    folder / f"{s}_{k}.csv",
                    np.column_stack([trial.time, trial.values]),
                    "%.7g",
                    delimiter=",",
                    header=header,
                    comments="",
                )
                rows.append(f"{s}_{k}.csv,S{s},{'young' if s % 2 else 'old'}")
        (folder / "subjects.csv").write_text("\n".join(rows) + "\n")
        options = (
            "--inputs u --outputs yM,vM --crossing vM:falling --sections 16 --workers 2"
        )
        line = [
            sys.executable,
            "-m",
            "hybridjax",
            "identify",
            "--table",
            "subjects.csv",
        ]
        start = time.perf_counter()
        process = largest_memory(
            subprocess.Popen([*line, *options.split(), "--out", "out"], cwd=folder)
        )
        show("command.peak_memory_MB", process)
        show("command.wall_seconds", time.perf_counter() - start)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        show("command.cpu_seconds", used.ru_utime + used.ru_stime)
        show("command.subjects", len(list((folder / "out").glob("*/report.html"))))


def largest_memory(process) -> float:
    """Return the largest sum of the proportional memory of a process and its children, in MB."""
    largest = 0.0
    while process.poll() is None:
        total = 0
        for status in pathlib.Path("/proc").glob("[0-9]*/status"):
            with contextlib.suppress(OSError):
                if is_inside(int(status.parent.name), process.pid):
                    text = (status.parent / "smaps_rollup").read_text()
                    total += int(text.split("Pss:")[1].split()[0])
        largest = max(largest, total / 1024)
        time.sleep(0.5)
    return largest


def is_inside(pid: int, ancestor: int) -> bool:
    while pid > 1 and pid != ancestor:
        fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        pid = int(fields[1])
    return pid == ancestor


PARTS = {f.__name__: f for f in (means, differences, predictions, maps, command)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pool", type=pathlib.Path, default=pathlib.Path("pool.npz"))
    parser.add_argument("--subjects", type=int, default=1500)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    options = parser.parse_args()
    hj.enable_x64()
    if not options.pool.exists() and options.only != ["command"]:
        make_pool(options.pool, options.subjects)
    for name in options.only:
        if name == "command":
            command()
        else:
            PARTS[name](np.load(options.pool))


if __name__ == "__main__":
    main()
