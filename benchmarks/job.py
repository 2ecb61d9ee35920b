"""The job that the package and its peers do: experiments around a limit cycle, as plain arrays.

A `Job` holds no object of hybridjax, so that a peer needs nothing but numpy to read it, and it
can be pickled for another process.
"""

from typing import NamedTuple

import numpy as np


class Job(NamedTuple):
    """S experiments of n intervals between N sections.

    In interval k of experiment s the input is `u[s, k]`; it ends where section (k + 1) mod N is
    met. The record is (S, n, 2): the first two states at the start of each interval, in each of
    the models the height and the speed of the body. An experiment starts on the cycle, at
    section 0.

    **Fields:**

    - `model`: "hopper" or "bar", and `parameters`, its numbers by name.
    - `family`: "isochron" (sections are instants) or "kinematic" (lines in the plane of the first
      two states).
    - `u` (S, n).
    - `period`, of the cycle and of the clock.
    - `times` (N,): of the cycle at its sections, in one turn that begins at section 0.
    - `charts` (N,): names of the charts in which the sections lie on the cycle.
    - `states` (N, 4): of the cycle at its sections, zero where a chart has fewer.
    - `planes` (N, 3): kinematic section i is where `planes[i] @ (y, v, 1)` falls through zero;
      zero for isochrons.
    """

    model: str
    parameters: dict[str, float]
    family: str
    u: np.ndarray
    period: float
    times: np.ndarray
    charts: tuple[str, ...]
    states: np.ndarray
    planes: np.ndarray

    @property
    def sections(self) -> int:
        return len(self.times)

    @property
    def clocked(self) -> bool:
        """Whether sections are instants."""
        return self.family == "isochron"

    @property
    def durations(self) -> np.ndarray:
        """(N,): time of the cycle from section i to the next."""
        return np.diff(self.times, append=self.times[0] + self.period)

    def part(self, experiments: int, cycles: int | None = None) -> "Job":
        """The first experiments, repeated where more are asked for, and their first cycles."""
        rows = np.arange(experiments) % len(self.u)
        n = self.u.shape[1] if cycles is None else cycles * self.sections
        return self._replace(u=self.u[rows, :n].copy())


MODELS = {"VerticalHopper": "hopper", "TwoLeggedBar": "bar"}


def make_job(cycle, sections, u) -> Job:
    """A job from a limit cycle of hybridjax, `PlacedSections` on it, and inputs (S, n[, 1])."""
    system, family = cycle.system, sections.family
    from hybridjax.systems.system import own_fields

    parameters = {x.name: float(getattr(system, x.name)) for x in own_fields(system)}
    states = np.asarray(sections.lanes.q, float).T
    names = list(system.charts())
    charts = tuple(names[a] for a in np.asarray(sections.lanes.chart))
    planes = np.zeros((sections.n_sections, 3))
    if family.label == "kinematic":
        planes = _planes(
            states[:, :2], np.asarray(family.center), np.asarray(family.scale)
        )
    return Job(
        model=MODELS[type(system).__name__],
        parameters=parameters,
        family=family.label,
        u=np.array(u, float).reshape(len(u), -1),
        period=float(cycle.period),
        times=np.array(sections.lanes.t, float),
        charts=charts,
        states=states,
        planes=planes,
    )


def _planes(records, center, scale):
    """Lines through the center, each at 2 pi / N from the last one in the scaled plane."""
    position, velocity = ((records - center) / scale).T
    angle = np.unwrap(np.arctan2(velocity, position))
    sense = np.sign(angle[1] - angle[0])
    angle = angle[0] + sense * 2 * np.pi / len(records) * np.arange(len(records))
    slopes = -sense * np.stack([-np.sin(angle) / scale[0], np.cos(angle) / scale[1]])
    return np.stack([*slopes, -center @ slopes], axis=1)
