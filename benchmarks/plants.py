"""Plants: accuracy, overhead, processes and memory, of the paper's hopper and of MuJoCo's models.

python -m benchmarks.plants [overhead] [accuracy] [mujoco] [walker] [stairs]
"""

import math
import pathlib
import resource
import sys
import time

import mujoco as mj
import numpy as np

import hybridjax as hj
from tests.plants.hopper import Hopper
from tests.plants.walker import coordinates, walker as make_walker


OUTPUTS = ("yM", "vM")
FAMILIES = (
    hj.ClockPhase(32, anchor=0.7233423518),  # (the apex)
    hj.KinematicPhase(32, "yM", "vM", center=(1.9, 0.0), scale=(0.3, 1.9)),
)


class Timed(Hopper):
    """Measures the time that it computes itself."""

    spent, calls = 0.0, 0

    def step(self, u, duration):
        began = time.process_time()
        observation = super().step(u, duration)
        Timed.spent += time.process_time() - began
        Timed.calls += 1
        return observation


def loop(plant, cycle, inputs):
    """The shortest loop that a user would write, for clock sections."""
    for u in inputs:
        plant.reset(0)
        plant.set_state(cycle.state)
        for held in u:
            plant.step(held, 1 / 32)


def cpu(work, *arguments):
    began = time.process_time()
    work(*arguments)
    return time.process_time() - began


def overhead(cycles=84, experiments=80):
    """Time of the package beside that of the plant, in one process; and of two processes."""
    design = hj.experiments.paper_design(seed=0)
    u = design.signals(cycles)[:experiments]
    for family in FAMILIES:
        cycle = hj.plants.find_cycle(Timed(), family, OUTPUTS)
        few = u[:4]
        Timed.spent, Timed.calls = 0.0, 0
        total = cpu(lambda: cycle.run_experiments(few, discard=20, processes=0))  # noqa: B023
        print(
            f"{family.label}: 4 experiments {total:.2f} CPU s, {total / Timed.spent:.3f} times the "
            f"plant's own; {Timed.calls / few[..., 0].size:.2f} steps per section"
        )
        if family.label == "isochron":
            plain = hj.plants.find_cycle(Hopper(dt=1 / 32), family, OUTPUTS)
            experiments = lambda: plain.run_experiments(few, discard=20, processes=0)  # noqa: B023, E731
            alone, total = (
                min(cpu(*work) for _ in range(5))
                for work in ((loop, Hopper(dt=1 / 32), plain, few), (experiments,))
            )
            print(
                f"  {total / alone:.3f} times a loop of its steps from section to section"
            )
    cycle = hj.plants.find_cycle(Hopper(dt=1 / 32), FAMILIES[0], OUTPUTS)
    walls: dict[int, list[float]] = {1: [], 2: []}
    for processes in (1, 2) * 3:
        began, before = (
            time.perf_counter(),
            resource.getrusage(resource.RUSAGE_CHILDREN),
        )
        data = cycle.run_experiments(u, discard=20, processes=processes)
        walls[processes].append(time.perf_counter() - began)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(
            f"{len(u)} experiments, {processes} processes: {walls[processes][-1]:.1f} s, "
            f"{spent:.1f} CPU s in workers; {data.summary()}"
        )
    # (The shortest of three, because other programs may run beside them.)
    print(f"two processes are {min(walls[1]) / min(walls[2]):.2f} times as fast")
    for name, who in (
        ("this process", resource.RUSAGE_SELF),
        ("a worker", resource.RUSAGE_CHILDREN),
    ):
        print(f"memory of {name}: {resource.getrusage(who).ru_maxrss / 1024:.0f} MB")


def accuracy():
    """Perturbed returns and HTFs against the exact linearization."""
    hopper = hj.find_limit_cycle(hj.models.VerticalHopper())
    for family in FAMILIES:
        cycle = hj.plants.find_cycle(Hopper(), family, OUTPUTS)
        returns = cycle.perturbed_returns()
        error = returns.compare(hopper.multipliers).max_error
        print(f"{family.label}: {returns}\n  error {error:.1e}")
        model = hj.linearize(hopper, family, outputs=OUTPUTS)
        inside = []
        # Experiments with few lines are no test of discs: products of few cosines are not Gaussian,
        # hit few lines, and are smaller than the bias of third order.
        for seed in range(4):
            design = hj.multisine(
                32, periods=32, frequencies=(0, 4), amplitude=0.002, seed=seed
            )
            data = cycle.run_experiments(design.realizations(4, seed), discard=48)
            estimate = hj.estimate_htf(data)
            exact = model.htf(estimate.frequencies, harmonics=estimate.harmonics)
            inside += [
                np.mean(
                    np.abs(estimate.H - exact.H) <= estimate.confidence_radius(0.95)
                )
            ]
            print(
                f"  {data.summary()}; {100 * inside[-1]:.1f} % of HTFs within their discs"
            )
        error = np.std(inside, ddof=1) / 2
        print(
            f"  mean {100 * np.mean(inside):.1f} % (standard error {100 * error:.1f} %)"
        )
        design = hj.multisine(32, periods=16, frequencies=(0, 8), amplitude=0.002)
        estimate = hj.estimate_htf(cycle.run_experiments(design, discard=40))
        fit = hj.fit_multipliers(estimate, order=2)
        print(
            f"  {fit}\n  true ones within the region: {fit.contains(hopper.multipliers)}"
        )


def drive(model, data):
    return [20 * math.sin(2 * math.pi * data.time), 0.0]


def mujoco():
    """Perturbed returns against experiments, on ground of several hardness."""
    file = pathlib.Path(__file__).parents[1] / "tests" / "plants" / "hopper.xml"
    for solref in ("0.02 1", "0.1 1"):
        model = mj.MjModel.from_xml_string(file.read_text().replace("0.02 1", solref))
        plant = hj.plants.MuJoCoPlant(
            model, {"push": "N"}, control=drive, period=1.0, substeps=20
        )
        cycle = hj.plants.find_cycle(
            plant, hj.ClockPhase(10, anchor=0.7), ("yM", "yM_rate")
        )
        returns = cycle.perturbed_returns()
        print(f"solref {solref}: {returns}")
        design = hj.multisine(n_sections=10, periods=16, amplitude=0.02)
        estimate = hj.estimate_htf(cycle.run_experiments(design))
        fit = hj.fit_multipliers(estimate, order=2)
        print(f"  {fit}")
        print(
            f"  returns within the region of HTFs: {fit.contains(returns.multipliers)}"
        )
        print(
            f"  HTFs within the region of returns: {returns.contains(fit.multipliers)}"
        )


def walker():
    """Perturbed returns of a planar walker against experiments, at three kinds of sections."""
    plant, touchdowns = make_walker(), [f"{side}_foot[2]" for side in ("left", "right")]
    for sections in (
        hj.ClockPhase(8),
        hj.KinematicPhase(8, "left", "left_rate", scale=(0.2, 2.0)),
        [hj.Crossing(name, "falling") for name in touchdowns],
    ):
        cycle = hj.plants.find_cycle(plant, sections, ("x_rate", "pitch"), cycles=40)
        clocked = isinstance(sections, hj.ClockPhase)
        returns = cycle.perturbed_returns(coordinates(plant) + ["time"] * (not clocked))
        print(f"{cycle}\n  {returns}")
        N = cycle.sections.n_sections
        for amplitude in (0.1, 1.0):
            design = hj.multisine(
                n_sections=N, periods=16, amplitude=amplitude, lines="odd"
            )
            data = cycle.run_experiments(design, discard=24)
            fit = hj.fit_multipliers(hj.estimate_htf(data), order=2)
            print(f"  {amplitude} N: {data.summary()}; {fit}")
            print(
                f"  returns within its region: {fit.contains(returns.multipliers[:2])}"
            )
            print(
                f"  experiments within that of returns: {returns.contains(fit.multipliers)}"
            )


def stairs():
    """Fixed time steps: returns and experiments by time step, integrator and amplitude."""
    text = (
        pathlib.Path(__file__).parents[1] / "tests" / "plants" / "hopper.xml"
    ).read_text()
    for step, integrator in (
        (2e-3, "Euler"),
        (5e-4, "Euler"),
        (5e-4, "implicit"),
        (1e-4, "Euler"),
    ):
        change = f'timestep="{step}" integrator="{integrator}"'
        model = mj.MjModel.from_xml_string(text.replace('timestep="0.0005"', change))
        plant = hj.plants.MuJoCoPlant(
            model, {"push": "N"}, control=drive, period=1.0, substeps=round(0.01 / step)
        )
        cycle = hj.plants.find_cycle(
            plant, hj.ClockPhase(10, anchor=0.7), ("yM", "yM_rate"), cycles=40
        )
        returns = cycle.perturbed_returns()
        print(
            f"{step} {integrator}: returns {returns.multipliers[0]:.6f}, noise {returns.noise}"
        )
        for amplitude in (1e-4, 2e-2):
            design = hj.multisine(n_sections=10, periods=8, amplitude=amplitude)
            fit = hj.fit_multipliers(
                hj.estimate_htf(cycle.run_experiments(design)), order=2
            )
            inside = fit.contains(returns.multipliers[:2])[0]
            print(
                f"  {amplitude} N: {fit.multipliers[0]:.6f}, returns within the region: {inside}"
            )


if __name__ == "__main__":
    hj.enable_x64()
    subjects = dict(
        overhead=overhead,
        accuracy=accuracy,
        mujoco=mujoco,
        walker=walker,
        stairs=stairs,
    )
    for name in sys.argv[1:] or subjects:
        subjects[name]()
