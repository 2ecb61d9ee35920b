"""What sweeps, stores and clusters cost, and whether they survive.

Printed, as `name value` lines; ratios are of one run, CPU seconds are those of all processes.

- `sweep`: `--points` hoppers (k, b, M), by `find_limit_cycles` in memory and by `sweep` into a
  store, each in a process of its own, pinned to one core: microseconds of CPU per point, MB of
  memory, `overhead` of the second over the first, bytes per point on disk. Then on clusters of 1, 2
  and 4 workers: seconds, `of_cpu`, the CPU seconds of one process over those of all workers (1:
  nothing is lost), the most MB that a worker has had, and whether all is `equal` to the last bit to
  one process.
- `kills`: 200 pieces, with a process killed (-9) at `--kills` random moments: once the scheduler,
  once the client, otherwise a worker. Pieces `lost` and done `twice`, and whether all is `equal`
  to the last bit to one process without interruptions.
- `experiments`: `--experiments` of 20 cycles, stored, estimated out of core: `linear`, CPU
  seconds of all over twice those of a half; MB of memory; and the largest difference from the
  estimate in memory of the first fiftieth, relative to the largest |H|. `fit`: the same of
  `fit_series` with `--fitted` experiments and half of them, and the largest difference of its
  coefficients from those of a fit in memory.
- `workers`: a scheduler with `--workers` simulated ones, in threads of four processes, whose
  pieces sleep: `cost` of a task in CPU microseconds of scheduler and client, and for tasks of some
  lengths how much of their time workers are `busy`: in the middle of a run of ten tasks for each,
  from when all had one until nothing is left to be given out. `busy90`: how many seconds a task has
  to take for 90 %, by a line through these.

    nice python benchmarks/scale.py [--skip STEP ...] [--points 1000000] [--experiments 100000]
        [--fitted 4000]
"""

import argparse
import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from dask.distributed import Client, LocalCluster, as_completed

import hybridjax as hj


STEPS = ("sweep", "kills", "experiments", "workers")
QUIET = {"dashboard_address": ":0", "threads_per_worker": 1}


def show(name: str, value: float) -> None:
    print(f"scale.{name} {value:.4g}", flush=True)


def axes(points: int) -> dict[str, np.ndarray]:
    n = round(points ** (1 / 3))
    return {
        "k": np.linspace(8, 13, n),
        "b": np.linspace(3, 7, n),
        "M": np.linspace(1.5, 2.5, n),
    }


def total(over) -> int:
    return int(np.prod([len(x) for x in over.values()]))


def megabytes() -> float:
    """The most that this process has had, in MB. (That of `getrusage` begins with its parent's.)"""
    lines = pathlib.Path("/proc/self/status").read_text().splitlines()
    return next(float(x.split()[1]) for x in lines if x.startswith("VmHWM")) / 1e3


def few(over):
    return {name: x[: max(len(x) // 3, 16)] for name, x in over.items()}


def alone(points: int, store: pathlib.Path | None) -> None:
    """In this process, on one core: in memory, or into a store."""
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    over = axes(points)
    os.sched_setaffinity(0, {0})

    def work(over) -> None:
        if store is not None:
            hj.sweep(hj.models.VerticalHopper(), over, guess=cycle, store=store)
            return
        values = (x.ravel() for x in np.meshgrid(*over.values(), indexing="ij"))
        make = lambda k, b, M: hj.models.VerticalHopper(k=k, b=b, M=M)  # noqa: E731
        hoppers = eqx.filter_vmap(make)(*map(jnp.asarray, values))
        found = hj.orbits.find_limit_cycles(
            hoppers, cycle, execution=hj.scale.Execution(workers=1)
        )
        assert np.isfinite(found.multipliers[found.ok]).all()

    work(few(over))  # compiled
    if store is not None:
        shutil.rmtree(store)
    begin = time.process_time()
    work(over)
    name = "alone" if store is None else "stored"
    show(
        f"sweep.{name}.cpu_us_per_point",
        (time.process_time() - begin) / total(over) * 1e6,
    )
    show(f"sweep.{name}.memory", megabytes())


def by_itself(points: int, store: pathlib.Path | None) -> float:
    """`alone` in a process of its own; its microseconds per point."""
    command = [
        sys.executable,
        __file__,
        "--points",
        str(points),
        "--alone",
        str(store or ""),
    ]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    print(out, end="", flush=True)
    return float(out.split()[1])


def sweep(points: int, folder: pathlib.Path) -> None:
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    over = axes(points)
    count = total(over)
    show("sweep.points", count)
    in_memory = by_itself(points, None)
    one = by_itself(points, folder / "alone.zarr")
    show("sweep.overhead", one / in_memory - 1)
    show("sweep.bytes_per_point", size(folder / "alone.zarr") / count)
    for workers in (1, 2, 4):
        with (
            LocalCluster(n_workers=workers, **QUIET) as cluster,
            Client(cluster) as client,
        ):
            call = {"guess": cycle, "client": client}
            hj.sweep(hj.models.VerticalHopper(), few(over), **call)  # compiled
            before, begin = client.run(cpu_seconds), time.perf_counter()
            store = folder / f"{workers}.zarr"
            found = hj.sweep(hj.models.VerticalHopper(), over, store=store, **call)
            wall, after = time.perf_counter() - begin, client.run(cpu_seconds)
            cpu = sum(after[x] - before[x] for x in after) / count * 1e6
            show(f"sweep.workers{workers}.seconds", wall)
            show(f"sweep.workers{workers}.found", float((found.result == 0).mean()))
            show(f"sweep.workers{workers}.cpu_us_per_point", cpu)
            show(f"sweep.workers{workers}.of_cpu", one / cpu)
            show(f"sweep.workers{workers}.memory", max(client.run(megabytes).values()))
        same = [open_values(folder / x) for x in ("alone.zarr", f"{workers}.zarr")]
        show(f"sweep.workers{workers}.equal", np.array_equal(*same, equal_nan=True))


def cpu_seconds() -> float:
    return time.process_time()


def size(folder: pathlib.Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def open_values(store: pathlib.Path) -> np.ndarray:
    import xarray

    found = xarray.open_zarr(store, consolidated=False, chunks=None)
    return np.stack(
        [found[name].values for name in ("period", "spectral_radius", "result")]
    )


def draw(rng) -> np.ndarray:
    """A piece of work that takes a while, of which every run is noted."""
    time.sleep(0.1)
    return rng.normal(size=100)


CLIENT = """
import sys
from dask.distributed import Client
sys.path.insert(0, sys.argv[3])
import hybridjax as hj, scale
hj.enable_x64()
with Client(sys.argv[1]) as client:
    hj.scale.monte_carlo(scale.draw, 400, seed=1, chunk=2, store=sys.argv[2], client=client)
"""


def kills(count: int, folder: pathlib.Path) -> None:
    """The client is a process of its own, as the scheduler and the workers are."""
    here = str(pathlib.Path(__file__).parent)
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    store, rng = folder / "draws.zarr", random.Random(0)
    begin = time.perf_counter()
    reference = hj.scale.monte_carlo(draw, 400, seed=1, chunk=2)
    show("kills.seconds_alone", time.perf_counter() - begin)
    times: dict[str, set[int]] = {}
    done, killed, restarts = 0, 0, 0
    moments = sorted(rng.sample(range(3, 196), count))
    events = {moments[count // 3]: "scheduler", moments[2 * count // 3]: "client"}
    begin = time.perf_counter()
    while done < 200:
        scheduler, client, workers = start(folder, store)
        restarts += 1
        while client.poll() is None:
            time.sleep(0.02)
            for path in store.glob(
                "failed/c/*"
            ):  # (its last chunk: the piece is whole)
                stamp = path.stat().st_mtime_ns
                times.setdefault(path.name, set()).add(stamp)
            done = len(times)
            if moments and done >= moments[0]:
                victim = events.get(moments.pop(0), "worker")
                worker = rng.randrange(2)
                process = {"scheduler": scheduler, "client": client}.get(
                    victim, workers[worker]
                )
                process.send_signal(signal.SIGKILL)
                killed += 1
                if victim == "worker":
                    workers[worker] = worker_process(folder)
        for process in (*workers, scheduler, client):
            process.kill()
            process.wait()
    found = hj.scale.monte_carlo(draw, 400, seed=1, chunk=2, store=store).load()
    show("kills.seconds", time.perf_counter() - begin)
    show("kills.killed", killed)
    show("kills.starts", restarts)
    show("kills.twice", sum(len(x) - 1 for x in times.values()))
    show("kills.lost", float((found.failed != 0).sum()))
    show("kills.equal", found.identical(reference))


def start(folder: pathlib.Path, store: pathlib.Path):
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    scheduler = quiet(
        [*command, "--scheduler-file", file, "--port", "0", "--no-dashboard"]
    )
    while not file.exists():
        time.sleep(0.1)
    workers = [worker_process(folder) for _ in range(2)]
    address = json.loads(file.read_text())["address"]
    here = str(pathlib.Path(__file__).parent)
    return (
        scheduler,
        quiet([sys.executable, "-c", CLIENT, address, store, here]),
        workers,
    )


def worker_process(folder: pathlib.Path) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        "--no-nanny",
        "--nthreads",
        "1",
    ]
    return quiet(
        [*command, "--no-dashboard", "--scheduler-file", folder / "scheduler.json"]
    )


def quiet(command) -> subprocess.Popen:
    out = subprocess.DEVNULL
    return subprocess.Popen(list(map(str, command)), stdout=out, stderr=out)


def experiments(count: int, fitted: int, folder: pathlib.Path) -> None:
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    phase = hj.ClockPhase(32, anchor=hj.Crossing("vM", "falling"))
    placed = hj.sections.place_sections(cycle, phase)
    outputs, periods = ("yM", "vM"), 16

    def store(S: int):
        design = hj.multisine(experiments=20, periods=periods).realizations(S // 20)
        begin, cpu = time.perf_counter(), time.process_time()
        records = hj.run_experiments(
            cycle, placed, design, outputs, discard=4, store=folder / f"{S}.zarr"
        )
        wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
        show(f"experiments.{S}.run_cpu_seconds", cpu)
        show(f"experiments.{S}.run_seconds", wall)
        begin = time.process_time()
        estimate = hj.estimate_htf(records, (-2, -1, 0, 1, 2))
        show(f"experiments.{S}.estimate_cpu_seconds", time.process_time() - begin)
        show(f"experiments.{S}.gigabytes", size(folder / f"{S}.zarr") / 1e9)
        show(f"experiments.{S}.memory", megabytes())
        return design, estimate, time.process_time() - begin

    small = max(count // 50, 20) // 20 * 20
    design, estimate, _ = store(small)
    seconds = [store(count // 2 // 20 * 20)[2], store(count // 20 * 20)[2]]
    show("experiments.linear", seconds[1] / seconds[0] / 2)
    data = hj.run_experiments(cycle, placed, design, outputs, discard=4)
    whole = hj.estimate_htf(data, (-2, -1, 0, 1, 2))
    error = np.abs(estimate.H - whole.H).max() / np.abs(whole.H).max()
    show("experiments.difference", error)
    seconds = []
    for S in (fitted // 2, fitted):
        store(S)
        records = hj.experiments.StoredExperiments(folder / f"{S}.zarr")
        begin = time.process_time()
        found = hj.fit_series(records, 2, check=False)
        seconds.append(time.process_time() - begin)
        show(f"experiments.fit.{S}.cpu_seconds", seconds[-1])
        show(f"experiments.fit.{S}.memory", megabytes())
    show("experiments.fit.linear", seconds[1] / seconds[0] / 2)
    whole = hj.fit_series(list(records), 2, check=False)
    show(
        "experiments.fit.difference",
        np.abs(found.coefficients - whole.coefficients).max(),
    )


def workers(count: int) -> None:
    """One scheduler; the workers are threads' worth of processes that only sleep."""
    options = {
        "n_workers": 4,
        "threads_per_worker": count // 4,
        "dashboard_address": ":0",
    }
    rates = []
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        for seconds in (0.0, 1.0, 2.0, 4.0, 8.0):
            cpu, tasks = time.process_time(), 10 * count
            rate = keep_busy(client, seconds, tasks, 2 * count)
            cost = (time.process_time() - cpu) / tasks
            show(f"workers.{seconds:g}s.tasks_per_second", rate)
            show(f"workers.{seconds:g}s.busy", rate * seconds / count)
            if seconds == 0:
                # (Of the scheduler and the client, which are in this process.)
                show("workers.cost_us", cost * 1e6)
            rates.append((seconds, rate * seconds / count))
    tau, busy = np.array(rates).T
    show("workers.busy90_seconds", np.interp(0.9, np.maximum.accumulate(busy), tau))


def keep_busy(client: Client, seconds: float, tasks: int, waiting: int) -> float:
    """Tasks are given out as pieces are: a few wait for each worker. How many are done in a second,
    between the first time that as many are done as wait at once and the last that is given out."""
    done = as_completed()
    given, begin, first = 0, 0.0, 0
    for finished in range(tasks):
        while given < min(tasks, finished + waiting):
            done.add(client.submit(time.sleep, seconds, pure=False))
            given += 1
            end, last = time.perf_counter(), finished
        next(done)
        if finished + 1 == waiting:
            begin, first = time.perf_counter(), finished
    return (last - first) / (end - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--skip", nargs="*", choices=STEPS, default=[])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--experiments", type=int, default=100_000)
    parser.add_argument("--fitted", type=int, default=4_000)
    parser.add_argument("--alone", help=argparse.SUPPRESS)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1000)
    options = parser.parse_args()
    hj.enable_x64()
    hj.scale.enable_compilation_cache()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        if options.alone is not None:
            alone(
                options.points, pathlib.Path(options.alone) if options.alone else None
            )
            return
        if "sweep" not in options.skip:
            sweep(options.points, folder)
        if "kills" not in options.skip:
            kills(options.kills, folder)
        if "experiments" not in options.skip:
            experiments(options.experiments, options.fitted, folder)
        if "workers" not in options.skip:
            workers(options.workers)


if __name__ == "__main__":
    main()
