"""How long the main steps take, compile time apart from run time, with their accuracy beside.

Prints `name.metric value` lines. Times are in seconds: `compile` is the first call less a later
one, without a cache from earlier processes; `run` is the best of several calls. Every error is the
largest difference from the same computation at a tolerance of 1e-14.

    python benchmarks/run.py [--repeat 3] [--experiments 80] [--cycles 84]
"""

import argparse
import dataclasses
import os
import platform
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import hybridjax as hj


OUTPUTS = ("yM", "vM")
TIGHT = hj.Settings(rtol=1e-14, atol=1e-14)
APEX = hj.Crossing("vM", "falling")
FAMILIES = {
    "isochron": hj.ClockPhase(32, start=APEX),
    "kinematic": hj.KinematicPhase(
        32, position="yM", velocity="vM", center=(1.9, 0.0), scale=(0.3, 1.9), start=APEX
    ),
}


def show(name: str, value: Any) -> None:
    print(name, f"{value:.3g}" if isinstance(value, float) else value, flush=True)


def measure(name: str, work: Callable[[], Any], repeat: int) -> Any:
    """Time a first call and later ones, and return the result."""
    seconds = []
    for _ in range(repeat + 1):
        begin = time.perf_counter()
        result = jax.block_until_ready(work())
        seconds.append(time.perf_counter() - begin)
    run = min(seconds[1:])
    show(f"{name}.compile", seconds[0] - run)
    show(f"{name}.run", run)
    return result


def processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(x.split(":")[1].strip() for x in file if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--repeat", type=int, default=3, help="later calls, the best of which counts"
    )
    parser.add_argument("--experiments", type=int, default=80)
    parser.add_argument("--cycles", type=int, default=84)
    options = parser.parse_args()
    hj.enable_x64()
    show("hardware.cpu", f"{processor()}, {os.cpu_count()} cores")
    show("hardware.device", jax.devices()[0].device_kind)
    show("software", f"hybridjax {hj.__version__}, jax {jax.__version__}")

    hopper = hj.models.VerticalHopper()
    cycle = measure("find_limit_cycle", lambda: hj.find_limit_cycle(hopper), options.repeat)
    tight = hj.find_limit_cycle(hopper, settings=TIGHT)
    show("find_limit_cycle.error", distance(cycle.start.q, tight.start.q))
    show("find_limit_cycle.multiplier_error", distance(cycle.multipliers, tight.multipliers))

    periods = options.cycles - 20
    design = hj.paper_design(periods=periods, experiments=options.experiments)
    for name, family in FAMILIES.items():
        placed = measure(
            f"place_sections.{name}", lambda f=family: hj.place_sections(cycle, f), options.repeat
        )
        model = measure(
            f"linearize.{name}", lambda p=placed: hj.linearize(cycle, p, OUTPUTS), options.repeat
        )
        f = design.frequencies[:: max(1, len(design.frequencies) // 60)]
        error = model.htf(f).error(hj.linearize(tight, family, OUTPUTS).htf(f))
        show(f"linearize.{name}.htf_error", float(np.max(error)))

        def experiments(placed=placed, **settings):
            return hj.run_experiments(cycle, placed, design, OUTPUTS, **settings)

        data = measure(f"run_experiments.{name}", experiments, options.repeat)
        finer = experiments(settings=dataclasses.replace(TIGHT, max_steps=64))
        show(f"run_experiments.{name}.section_maps", data.u[..., 0].size)
        show(f"run_experiments.{name}.failed", int(np.sum(~data.ok)))
        show(f"run_experiments.{name}.error", distance(data.y, finer.y))


def distance(a, b) -> float:
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))


if __name__ == "__main__":
    main()
