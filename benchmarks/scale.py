"""What sweeps, stores and clusters cost, and whether they survive.

Printed, as `name value` lines; ratios are of one run, CPU seconds are those of all processes.

- `sweep`: `--points` hoppers (k, b, M), by `find_limit_cycles` in memory and by `sweep` into a
  store, both in one process pinned to one core: microseconds of CPU per point, `overhead` of the
  second over the first, bytes per point on disk. Then on clusters of 1, 2 and 4 workers: seconds,
  `of_cpu`, the CPU seconds of one process over those of all workers (1: nothing is lost), the
  most MB that a worker has had, and whether all is `equal` to the last bit to one process.
- `kills`: 200 pieces, with a process killed (-9) at `--kills` random moments: once the scheduler,
  once the client, otherwise a worker. Pieces `lost` and done `twice`, and whether all is `equal`
  to the last bit to one process without interruptions.
- `experiments`: `--experiments` of 20 cycles, stored, estimated out of core: `linear`, CPU
  seconds of all over twice those of a half; MB of memory; and the largest difference from the
  estimate in memory of the first fiftieth, relative to the largest |H|.
- `workers`: a scheduler with `--workers` simulated ones, in threads of four processes, whose
  pieces sleep: `cost` of a task in CPU microseconds of scheduler and client, `busy` for tasks of
  some lengths, and `busy90`, how many seconds a task has to take for all workers to be busy 90 %
  of the time if nothing but that cost stops them.

    nice python benchmarks/scale.py [--skip STEP ...] [--points 1000000] [--experiments 100000]
"""

import argparse
import json
import os
import pathlib
import random
import resource
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
    return {"k": np.linspace(8, 13, n), "b": np.linspace(3, 7, n), "M": np.linspace(1.5, 2.5, n)}


def total(over) -> int:
    return int(np.prod([len(x) for x in over.values()]))


def megabytes() -> float:
    """The most that this process has had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def sweep(points: int, folder: pathlib.Path) -> None:
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    over = axes(points)
    count = total(over)
    show("sweep.points", count)

    def alone() -> None:
        values = (x.ravel() for x in np.meshgrid(*over.values(), indexing="ij"))
        make = lambda k, b, M: hj.models.VerticalHopper(k=k, b=b, M=M)  # noqa: E731
        hoppers = eqx.filter_vmap(make)(*map(jnp.asarray, values))
        one = hj.Execution(workers=1)
        found = hj.find_limit_cycles(hoppers, cycle, execution=one)
        assert np.isfinite(found.multipliers[found.ok]).all()

    def stored(client=None, name="alone.zarr") -> None:
        shutil.rmtree(folder / name, ignore_errors=True)
        found = hj.sweep(
            hj.models.VerticalHopper(), over, guess=cycle, store=folder / name, client=client
        )
        show(f"sweep.found.{name}", float((found.result == 0).mean()))

    few = {name: x[: max(len(x) // 3, 16)] for name, x in over.items()}
    hj.sweep(hj.models.VerticalHopper(), few, guess=cycle)  # compiled
    os.sched_setaffinity(0, {0})
    seconds = {}
    for name, work in (("alone", alone), ("stored", stored)):
        begin = time.process_time()
        work()
        seconds[name] = time.process_time() - begin
        show(f"sweep.{name}.cpu_us_per_point", seconds[name] / count * 1e6)
    show("sweep.overhead", seconds["stored"] / seconds["alone"] - 1)
    show("sweep.bytes_per_point", size(folder / "alone.zarr") / count)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    for workers in (1, 2, 4):
        with LocalCluster(n_workers=workers, **QUIET) as cluster, Client(cluster) as client:
            hj.sweep(hj.models.VerticalHopper(), few, guess=cycle, client=client)  # compiled
            before, begin = client.run(cpu_seconds), time.perf_counter()
            stored(client, f"{workers}.zarr")
            wall, after = time.perf_counter() - begin, client.run(cpu_seconds)
            cpu = sum(after[x] - before[x] for x in after)
            show(f"sweep.workers{workers}.seconds", wall)
            show(f"sweep.workers{workers}.cpu_us_per_point", cpu / count * 1e6)
            show(f"sweep.workers{workers}.of_cpu", seconds["stored"] / cpu)
            memory = max(client.run(megabytes).values())
            show(f"sweep.workers{workers}.memory", memory)
        same = [open_values(folder / x) for x in ("alone.zarr", f"{workers}.zarr")]
        show(f"sweep.workers{workers}.equal", np.array_equal(*same, equal_nan=True))


def cpu_seconds() -> float:
    return time.process_time()


def size(folder: pathlib.Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def open_values(store: pathlib.Path) -> np.ndarray:
    import xarray

    found = xarray.open_zarr(store, consolidated=False, chunks=None)
    return np.stack([found[name].values for name in ("period", "spectral_radius", "result")])


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
    hj.monte_carlo(scale.draw, 400, seed=1, chunk=2, store=sys.argv[2], client=client)
"""


def kills(count: int, folder: pathlib.Path) -> None:
    """The client is a process of its own, as the scheduler and the workers are."""
    here = str(pathlib.Path(__file__).parent)
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    store, rng = folder / "draws.zarr", random.Random(0)
    begin = time.perf_counter()
    reference = hj.monte_carlo(draw, 400, seed=1, chunk=2)
    show("kills.seconds_alone", time.perf_counter() - begin)
    times: dict[str, int] = {}
    twice, done, killed, restarts = 0, 0, 0, 0
    moments = sorted(rng.sample(range(3, 196), count))
    events = {moments[count // 3]: "scheduler", moments[2 * count // 3]: "client"}
    begin = time.perf_counter()
    while done < 200:
        scheduler, client, workers = start(folder, store)
        restarts += 1
        while client.poll() is None:
            time.sleep(0.02)
            for path in store.glob("failed/c/*"):  # (its last chunk: the piece is whole)
                stamp = path.stat().st_mtime_ns
                twice += times.get(path.name, stamp) != stamp
                times[path.name] = stamp
            done = len(times)
            if moments and done >= moments[0]:
                victim = events.get(moments.pop(0), "worker")
                worker = rng.randrange(2)
                process = {"scheduler": scheduler, "client": client}.get(victim, workers[worker])
                process.send_signal(signal.SIGKILL)
                killed += 1
                if victim == "worker":
                    workers[worker] = worker_process(folder)
        for process in (*workers, scheduler, client):
            process.kill()
            process.wait()
    found = hj.monte_carlo(draw, 400, seed=1, chunk=2, store=store).load()
    show("kills.seconds", time.perf_counter() - begin)
    show("kills.killed", killed)
    show("kills.starts", restarts)
    show("kills.twice", twice)
    show("kills.lost", float((found.failed != 0).sum()))
    show("kills.equal", found.identical(reference))


def start(folder: pathlib.Path, store: pathlib.Path):
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    scheduler = quiet([*command, "--scheduler-file", file, "--port", "0", "--no-dashboard"])
    while not file.exists():
        time.sleep(0.1)
    workers = [worker_process(folder) for _ in range(2)]
    address = json.loads(file.read_text())["address"]
    here = str(pathlib.Path(__file__).parent)
    return scheduler, quiet([sys.executable, "-c", CLIENT, address, store, here]), workers


def worker_process(folder: pathlib.Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-nanny", "--nthreads", "1"]
    return quiet([*command, "--no-dashboard", "--scheduler-file", folder / "scheduler.json"])


def quiet(command) -> subprocess.Popen:
    out = subprocess.DEVNULL
    return subprocess.Popen(list(map(str, command)), stdout=out, stderr=out)


def experiments(count: int, folder: pathlib.Path) -> None:
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    phase = hj.ClockPhase(32, anchor=hj.Crossing("vM", "falling"))
    placed = hj.place_sections(cycle, phase)
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


def workers(count: int) -> None:
    """One scheduler; the workers are threads' worth of processes that only sleep."""
    options = {"n_workers": 4, "threads_per_worker": count // 4, "dashboard_address": ":0"}
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        for seconds in (0.0, 1.0, 4.0, 16.0):
            tasks = (5 if seconds == 0 else 3) * count
            begin, cpu = time.perf_counter(), time.process_time()
            keep_busy(client, seconds, tasks, 2 * count)
            wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
            busy = tasks * seconds / count / wall
            show(f"workers.{seconds:g}s.tasks_per_second", tasks / wall)
            show(f"workers.{seconds:g}s.busy", busy)
            if seconds == 0:
                cost = cpu / tasks  # (of the scheduler and the client, which are in this process)
                show("workers.cost_us", cost * 1e6)
                show("workers.busy90_seconds", 0.9 * cost * count)


def keep_busy(client: Client, seconds: float, tasks: int, waiting: int) -> None:
    """As pieces are given out: a few tasks wait for each worker."""
    done = as_completed()
    given = 0
    while given < min(tasks, waiting):
        done.add(client.submit(time.sleep, seconds, pure=False))
        given += 1
    for _ in range(tasks):
        next(done)
        if given < tasks:
            done.add(client.submit(time.sleep, seconds, pure=False))
            given += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--skip", nargs="*", choices=STEPS, default=[])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--experiments", type=int, default=100_000)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1000)
    options = parser.parse_args()
    hj.enable_x64()
    hj.enable_compilation_cache()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        if "sweep" not in options.skip:
            sweep(options.points, folder)
        if "kills" not in options.skip:
            kills(options.kills, folder)
        if "experiments" not in options.skip:
            experiments(options.experiments, folder)
        if "workers" not in options.skip:
            workers(options.workers)


if __name__ == "__main__":
    main()
