"""The systems, sections and inputs that are measured, and how calls of hybridjax are timed."""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import truth
from job import Job, make_job
from peers.c_peer import CHARTS, cycles as c_cycles
from peers.contest import Seconds, measure
from peers.errors import Unavailable

import hybridjax as hj
from hybridjax.experiments import run as batched
from hybridjax.experiments.response import Course, flow_batch
from hybridjax.experiments.run import RunOptions, prepare
from hybridjax.sections.placed import PlacedSections
from hybridjax.systems.system import own_fields


MODELS = {"hopper": hj.models.VerticalHopper, "bar": hj.models.TwoLeggedBar}
OUTPUTS = {"hopper": ("yM", "vM"), "bar": ("y", "v")}
# Where the kinematic sections meet, and the scales of the plane.
CENTERS = {"hopper": ((1.9, 0.0), (0.3, 1.9)), "bar": ((0.7, 0.0), (0.35, 2.0))}
ALL = tuple((model, family) for model in MODELS for family in ("isochron", "kinematic"))
HOPPER = ALL[:2]
N = 32


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """Experiments on a model, at sections that are placed on its cycle, with inputs (S, n, 1)."""

    label: str
    placed: PlacedSections
    outputs: tuple[str, str]
    u: np.ndarray

    @property
    def cycle(self) -> hj.orbits.LimitCycle:
        return self.placed.cycle

    @ft.cached_property
    def job(self) -> Job:
        return make_job(self.cycle, self.placed, self.u)

    @ft.cached_property
    def exact(self) -> np.ndarray:
        """The record (S, n, 2), by the closed form."""
        return truth.experiments(self.job)

    def part(self, experiments: int, cycles: int) -> "Problem":
        """The first experiments, repeated where more are asked for, and their first cycles."""
        rows = np.arange(experiments) % len(self.u)
        part = dataclasses.replace(self, u=self.u[rows, : N * cycles].copy())
        if "exact" in self.__dict__:
            part.__dict__["exact"] = self.exact[rows, : N * cycles]
        return part

    def scaled(self, factor: float) -> "Problem":
        return dataclasses.replace(self, u=factor * self.u)

    def run(
        self, accuracy: float = 1e-9, workers: int = 1
    ) -> hj.experiments.ExperimentData:
        """All experiments, as a user runs them, by the program that jobs find after a while."""
        batched._LARGE = 0
        return hj.run_experiments(
            self.cycle,
            self.placed,
            self.u,
            self.outputs,
            discard=0,
            accuracy=accuracy,
            execution=hj.scale.Execution(workers=workers),
        )

    def error(self, data: hj.experiments.ExperimentData) -> float:
        """Largest error of the outputs, in their own units."""
        return self.distance(record(data))

    def distance(self, y) -> float:
        return float(np.max(np.abs(np.asarray(y) - self.exact)))

    def response(self, accuracy: float = 1e-9) -> tuple:
        """Arguments of `program`: what `run` gives to it."""
        options = RunOptions(discard=0, accuracy=accuracy)
        prepared = prepare(self.cycle, self.placed, self.u, self.outputs, options)
        lanes = self.placed.lanes
        start = jnp.concatenate([lanes.t[None], lanes.q])[:, :1]
        start = jnp.repeat(start, len(self.u), axis=1)
        z = tuple(prepared.outputs)
        stepping = prepared.stepping
        return (
            self.placed,
            stepping.plan,
            start,
            jnp.asarray(self.u),
            z,
            stepping.settings,
        )


def responding(placed, plan, start, u, outputs, settings):
    """Outputs (S, n, 2) of experiments, to be differentiated."""
    return flow_batch(Course.of(placed, outputs), plan, start, u, settings).y


program = eqx.filter_jit(responding)
"""As JAX compiles it, without the options of `run_experiments`."""


def record(data: hj.experiments.ExperimentData) -> np.ndarray:
    """Outputs themselves, not their deviations from the cycle."""
    return data.y + np.resize(data.cycle_outputs, (data.y.shape[1], data.y.shape[2]))


@ft.cache
def cycle(model: str) -> hj.orbits.LimitCycle:
    return hj.find_limit_cycle(MODELS[model]())


def sections(model: str, family: str) -> hj.ClockPhase | hj.KinematicPhase:
    """32 sections, section 0 where the body is highest."""
    position, velocity = OUTPUTS[model]
    anchor = hj.Crossing(velocity, "falling")
    if family == "isochron":
        return hj.ClockPhase(N, anchor=anchor)
    center, scale = CENTERS[model]
    return hj.KinematicPhase(
        N,
        position=position,
        velocity=velocity,
        center=center,
        scale=scale,
        anchor=anchor,
    )


@ft.cache
def problem(model: str, family: str, quick: bool = False) -> Problem:
    """80 experiments of 84 cycles with the paper's multisines; `quick`, 16 of 24 cycles."""
    experiments, cycles = (16, 24) if quick else (80, 84)
    placed = hj.sections.place_sections(cycle(model), sections(model, family))
    u = hj.experiments.paper_design().signals(84)[:experiments, : N * cycles]
    return Problem(f"{model}.{family}", placed, OUTPUTS[model], u)


def first_and_later(work: Callable[[], Any], repeat: int) -> tuple[Any, float, Seconds]:
    """The result; by how many seconds of the wall's clock the first call took longer, for which it
    was compiled if nothing before had done so; and the least seconds of later calls."""
    wait = lambda: jax.block_until_ready(work())  # noqa: E731
    _, first = measure(wait)
    result, later = measure(wait, repeat)
    return result, max(first.wall - later.wall, 0.0), later


class InC(NamedTuple):
    """Cycles of hoppers by the sweep in C, and the seconds that it takes."""

    cycles: c_cycles.Cycles
    seconds: Seconds


def hoppers_in_c(cycle: hj.orbits.LimitCycle, k, b, repeat: int) -> InC | None:
    """The cycles of a grid of hoppers beginning near `cycle`; None without gcc."""
    try:
        sweep = c_cycles.setup()
    except Unavailable:
        return None
    system = cycle.system
    parameters = {x.name: float(getattr(system, x.name)) for x in own_fields(system)}
    chart = CHARTS["hopper"][int(cycle.anchor.chart[0])]
    state = np.array(cycle.anchor.q[:, 0])
    grid = parameters | {"k": k, "b": b}
    return InC(*measure(lambda: c_cycles.run(grid, chart, state, sweep), repeat))
