"""Walkers without a clock: what designs for their leading multipliers are worth, in strides.

The compass gait and the rimless wheel are pushed by phase: sections are crossings of levels of the
stance leg's angle, N = 32 at equal times from mid-stance on, and the input is held from one to the
next. Samples of all angles and rates have white noise; so a noisy angle also finds each crossing
too early or too late, which moves the other outputs by their slope, all together.
"""

from typing import NamedTuple

import numpy as np

import hybridjax as hj


N = 32
# Draws of the phases.
PHASES = 4
# Part of a period by which differences are taken.
_ASIDE = 1e-3
# Noise with which errors are still proportional to it, relative to that of the benchmark.
_QUIET = 0.1


class Walker(NamedTuple):
    """What is known of a walker, and how it is pushed.

    `angle` of the stance leg, which grows in the `direction`; `order`, of the leading multipliers
    that are asked for; `rms` of the hip torque, so small that noise rules.
    """

    system: hj.HybridSystem
    event: str
    angle: str
    direction: str
    outputs: tuple[str, ...]
    order: int
    rms: float


WALKERS = {
    "compass": Walker(
        hj.models.CompassGait(),
        "heelstrike",
        "s",
        "falling",
        ("n", "vn", "vs"),
        2,
        0.002,
    ),
    "wheel": Walker(
        hj.models.RimlessWheel(), "impact", "th", "rising", ("w",), 1, 0.0002
    ),
}


def crossings(
    walker: Walker, cycle: hj.orbits.LimitCycle
) -> tuple[list[hj.Crossing], np.ndarray]:
    """The sections, and by how much each output changes per change of the angle there (N, ny)."""
    t, angle, *outputs = cycle.trajectory(3)(walker.angle, *walker.outputs, per_step=64)
    sign = 1 if walker.direction == "rising" else -1
    first = np.flatnonzero((sign * angle[:-1] < 0) & (sign * angle[1:] >= 0))[0]
    at = t[first] + np.arange(N) * float(cycle.period) / N
    aside = _ASIDE * float(cycle.period)
    change = [
        np.interp(at + aside, t, x) - np.interp(at - aside, t, x)
        for x in (angle, *outputs)
    ]
    levels = np.interp(at, t, angle)
    family = [hj.Crossing(walker.angle, walker.direction, x) for x in levels.tolist()]
    return family, np.stack(change[1:], axis=1) / change[0][:, None]


class Laboratory:
    """A walker between its sections, and what instruments say of it."""

    def __init__(self, walker: Walker):
        self.walker = walker
        self.cycle = hj.find_limit_cycle(
            walker.system, section=hj.AtEvent(walker.event)
        )
        family, self.slope = crossings(walker, self.cycle)
        self.placed = hj.sections.place_sections(self.cycle, family)
        self.model = hj.linearize(self.cycle, self.placed, walker.outputs)
        self.truth = np.asarray(self.cycle.multipliers)

    def recorded(
        self, design: hj.experiments.Design
    ) -> list[hj.experiments.ExperimentData]:
        """Without noise, for some draws of the phases."""
        drawn = [design.realizations(1, seed=k) for k in range(PHASES)]
        return [
            hj.run_experiments(
                self.cycle, self.placed, x, self.walker.outputs, start="steady"
            )
            for x in drawn
        ]

    def variance(self, std: float) -> np.ndarray:
        """Of each output, on the average over the sections."""
        return std**2 * (1 + (self.slope**2).mean(axis=0))

    def estimate(
        self,
        data: hj.experiments.ExperimentData,
        design: hj.experiments.Design,
        std: float,
        rng,
    ) -> hj.linear.HTF:
        """From noisy samples of everything."""
        S, n, ny = data.y.shape
        late = np.resize(self.slope, (n, ny)) * rng.normal(size=(S, n, 1))
        noisy = data.y + std * (rng.normal(size=(S, n, ny)) - late)
        data = hj.experiments.ExperimentData(
            data.u,
            noisy,
            n_sections=N,
            periods=data.periods,
            inputs=data.inputs,
            outputs=data.outputs,
        )
        htf = hj.estimate_htf(data, (-2, -1, 0, 1, 2), variance="auto")
        each = design.expected_variance()[:, None, :] * self.variance(std)[:, None]
        return hj.linear.HTF(
            htf.frequencies,
            htf.H,
            htf.harmonics,
            N,
            htf.inputs,
            htf.outputs,
            variance=np.broadcast_to(each, htf.H.shape),
        )

    def rms_error(self, design: hj.experiments.Design, std: float, draws: int) -> float:
        """Of the leading multipliers, over draws of noise."""
        records, leading = self.recorded(design), self.walker.order

        def error(rng):
            htf = self.estimate(records[rng.integers(PHASES)], design, std, rng)
            fit = hj.fit_multipliers(htf, len(self.truth), check=False)
            return fit.compare(self.truth).error[:leading].max()

        return float(
            np.sqrt(np.mean(hj.scale.monte_carlo(error, draws, 3).value.values ** 2))
        )


def walkers(draws: int) -> None:
    for name, walker in WALKERS.items():
        lab = Laboratory(walker)
        usual = hj.multisine(N, periods=128, lines="odd").scaled(walker.rms)
        rms = np.sqrt(np.mean(lab.recorded(usual)[0].y ** 2, axis=(0, 1)))
        std = float(0.1 * rms.min())
        noise = dict(
            zip(walker.outputs, np.sqrt(lab.variance(std)).tolist(), strict=True)
        )
        goal = hj.designs.MultiplierGoal(which=0)
        plan = hj.optimal_design(lab.model, usual, goal=goal, noise=noise)
        everything = hj.optimal_design(lab.model, usual, noise=noise)
        found = [lab.rms_error(design, std, draws) for design in (usual, plan.design)]
        quiet = lab.rms_error(usual, _QUIET * std, draws)
        bound = np.linalg.norm(plan.usual_standard_errors)
        for what, value in {
            "usual.bound": bound,
            "optimal.bound": np.linalg.norm(plan.standard_errors),
            "usual.rms_error": found[0],
            "usual.quiet.ratio": quiet / (_QUIET * bound),
            "optimal.rms_error": found[1],
            "bound.saved": plan.saved,
            "saved": (found[0] / found[1]) ** 2,
            "all.bound.saved": everything.saved,
        }.items():
            print(f"designs.{name}.{what} {value:.4g}", flush=True)
