"""What the five-link biped costs beside the hopper: a limit cycle, and experiments per state and
stage.

80 experiments of 50 cycles between 16 sections. `nanoseconds` are those of one experiment, section,
step, stage and state, in which the numbers of steps (planned) and of states are averages over
sections. `ratio` is how many times as long the biped takes.
"""

import numpy as np

import hybridjax as hj
from hybridjax.experiments import run as batched
from hybridjax.experiments.run import RunOptions, prepare

from .problems import first_and_later


EXPERIMENTS, CYCLES, SECTIONS, ACCURACY = 80, 50, 16, 1e-9


def run(show, options) -> None:
    angles = np.linspace(-0.16, 0.16, SECTIONS - 1)
    at_angles = [hj.Crossing("leg", "rising", angle) for angle in angles]
    phase = hj.KinematicPhase(
        SECTIONS,
        position="yM",
        velocity="vM",
        center=(1.9, 0.0),
        scale=(0.3, 1.9),
        anchor=hj.Crossing("vM", "falling"),
    )
    cases = {
        "hopper": (hj.models.VerticalHopper(), phase, "yM", 5e-4),
        "biped": (
            hj.models.FiveLinkBiped(),
            [hj.AtEvent("touchdown"), *at_angles],
            "leg",
            1e-2,
        ),
    }
    found = {}
    for name, case in cases.items():
        found[name] = _costs(
            lambda key, x, name=name: show(f"{name}.{key}", x), case, options
        )
    for key, value in found["biped"].items():
        show(f"ratio.{key}", value / found["hopper"][key])


def _costs(show, case, options) -> dict[str, float]:
    model, sections, output, amplitude = case
    cycle, compiling, seconds = first_and_later(
        lambda: hj.find_limit_cycle(model), options.repeat
    )
    costs = {"cycle.first": compiling + seconds.wall, "cycle.cpu": seconds.cpu}
    placed = hj.sections.place_sections(cycle, sections)
    count, cycles = (16, 4) if options.quick else (EXPERIMENTS, CYCLES)
    u = amplitude * np.random.default_rng(0).standard_normal(
        (count, cycles * SECTIONS, 1)
    )
    batched._LARGE = 0
    how = {
        "discard": 0,
        "accuracy": ACCURACY,
        "execution": hj.scale.Execution(workers=1),
    }
    _, _, seconds = first_and_later(
        lambda: hj.run_experiments(cycle, placed, u, output, **how), options.repeat
    )
    prepared = prepare(
        cycle, placed, u, output, RunOptions(discard=0, accuracy=ACCURACY)
    )
    s, chart = placed.structure(), np.asarray(placed.lanes.chart)
    steps = np.ceil(np.asarray(placed.duration) / np.asarray(prepared.stepping.plan.h))
    stages = [len(s.method(a).c) for a in chart]
    work = u.size / SECTIONS * np.sum(steps * stages * np.array(s.dims)[chart])
    costs |= {
        "experiments.cpu": seconds.cpu,
        "experiments.nanoseconds": 1e9 * seconds.cpu / work,
    }
    for key, value in costs.items():
        show(key, value)
    return costs
