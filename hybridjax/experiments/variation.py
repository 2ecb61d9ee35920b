"""Experiments that start in their periodic response, or with process noise beside the input."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..errors import ComputationError
from ..systems.output import Output
from ..systems.structure import Structure
from .campaign import Campaign
from .data import ExperimentData
from .noise import draw_process_noise


_MOST = 12  # steps towards the periodic response


@dataclasses.dataclass(frozen=True)
class Given(Campaign):
    """Experiments with given starts."""

    begin: Float[np.ndarray, "n S"]

    def _start(self, u):
        return self.begin


@dataclasses.dataclass(frozen=True)
class Variation(Campaign):
    """A campaign that starts where the nonlinear response is periodic, or has process noise."""

    steady: bool
    process_noise: float
    seed: int

    def run(self, rows: slice, progress: bool = False) -> ExperimentData:
        u = self.inputs(rows)
        begin = self._start(u)
        if self.steady:
            begin = self._settle(u, begin, rows.start)
        kicks = draw_process_noise(u.shape, self.process_noise, self.seed, rows.start)
        data = self._given(u + kicks, begin).run(slice(0, len(u)), progress)
        return dataclasses.replace(data, u=u) if self.process_noise else data

    def _given(self, u, begin, **changes) -> Given:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(Campaign)}
        return Given(**fields | dict(source=u, count=len(u)) | changes, begin=begin)

    def _settle(self, u, begin, first: int):
        r"""Starts from which the responses repeat after P periods: zeros of $F(x) - x$.

        Newton's method with the Jacobian of the linearization, $\Phi^P$, as precise as the response
        is linear. Experiments that fail keep the start that they had.
        """
        N, P = self.placed.n_sections, self.periods
        once = np.concatenate([u[:, : N * P], u[:, :N]], axis=1)
        lanes = self.placed.lanes
        cycle = np.concatenate([lanes.t[None], lanes.q])[:, :1]
        outputs = Structure(self.placed.cycle.system).resolve_outputs(states(len(cycle) - 1))
        embed, back = (np.asarray(x[0]) for x in self.placed.frames())
        phi = np.asarray(self.model.monodromy())
        power = np.linalg.matrix_power(phi, P)
        d = len(phi)
        gain = embed[:, :d] @ np.linalg.solve(np.eye(d) - power, power) @ back[:d]
        scale = np.asarray(self.scales[0])[:, None]
        for _ in range(_MOST):
            run = self._given(once, begin, outputs=outputs)
            data = run.run(slice(0, len(u)))
            defect = np.where(data.ok, cycle + data.y[:, N * P].T - begin, 0.0)
            if not embed[0].any():  # time is no state, and an autonomous system may gain or lose it
                defect[0] = 0.0
            begin = begin + defect + gain @ defect
            worst = (np.abs(defect) / scale).max(axis=0)
            if worst.max() <= self.accuracy:
                return begin
        s = int(np.argmax(worst))
        raise ComputationError(
            f"experiment {first + s}: no periodic response was found near the one that the "
            f"linearization predicts (after {P} periods the state differs by {worst[s]:.1e} of its "
            "size): make the input smaller, or discard cycles instead."
        )


def states(count: int) -> list[Output]:
    """Time and all states as outputs, zero where a chart has fewer states."""

    def state(k):
        return lambda t, q, u: q[k] if k < len(q) else 0.0 * t

    some = [Output(f"state {k}", state(k)) for k in range(count)]
    return [Output("time", lambda t, q, u: t), *some]


def vary(campaign: Campaign, steady: bool, process_noise: float, seed: int) -> Campaign:
    """The campaign, changed where something else than usual is asked for."""
    draw_process_noise((0,), process_noise, seed)
    if not (steady or process_noise):
        return campaign
    fields = {f.name: getattr(campaign, f.name) for f in dataclasses.fields(Campaign)}
    return Variation(**fields, steady=steady, process_noise=float(process_noise), seed=seed)
