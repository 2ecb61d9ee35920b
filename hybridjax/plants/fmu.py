"""Functional mock-up units (FMI 2.0, co-simulation) as plants."""

import dataclasses
import os
import shutil
import weakref
from collections.abc import Mapping, Sequence

from .._core.arguments import package, require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath, NewOptionalNames, Positive, SignalNames
from ..errors import DefinitionError
from .plant import Made


@checked
def from_fmu(
    file: FilePath,
    inputs: NewOptionalNames,
    signals: SignalNames,
    *,
    dt: Positive,
    period: Positive | None = None,
) -> "FMUPlant":
    """Make a plant of an FMU (`pip install 'hybridjax[fmu]'`).

    Running an FMU runs the machine code in it. Units come from the file. If the FMU can save its
    state, experiments begin at the settled state; if it takes steps of any size, steps end on the
    sections.

    **Arguments:**

    - `file`: an FMU of FMI 2.0 for co-simulation.
    - `inputs`, `signals`: names of real variables.
    - `dt`: longest communication step in seconds.
    - `period`: period of the clock in seconds. Default: no clock.

    **Raises:** `DefinitionError` for another kind of FMU, and for unknown variables.
    """
    return FMUPlant(os.path.abspath(file), inputs, tuple(signals), dt, period)


@dataclasses.dataclass(eq=False)
class FMUPlant(Made):
    """An FMU as a plant: see `from_fmu`."""

    file: str
    inputs: Sequence[str] | Mapping[str, str]
    signals: tuple[str, ...]
    dt: float
    period: float | None

    def __post_init__(self) -> None:
        fmpy = package("fmpy")
        try:
            about = fmpy.read_model_description(self.file)
        except Exception as error:  # (of many kinds)
            raise DefinitionError(f"'{self.file}' is no FMU: {error}") from error
        can = about.coSimulation
        if not about.fmiVersion.startswith("2.") or can is None:
            raise DefinitionError(
                f"'{self.file}' is no FMU of FMI 2.0 for co-simulation: export it as one."
            )
        groups = self.inputs, self.signals
        variables = {x.name: x for x in about.modelVariables if x.type == "Real"}
        require_among("real variable", [x for y in groups for x in y], variables, "from_fmu: ")
        self._at = [[variables[x].valueReference for x in group] for group in groups]
        self.units = {x: variables[x].unit for x in self.signals if variables[x].unit}
        self.fixed_step = not can.canHandleVariableCommunicationStepSize
        if can.canGetAndSetFMUstate and can.canSerializeFMUstate:
            self.get_state, self.set_state = self._get_state, self._set_state
        folder = fmpy.extract(self.file)
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._slave = fmpy.instantiate_fmu(folder, about, "CoSimulation")
        self._t = 0.0

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin at time 0."""
        self._slave.reset()
        self._t = 0.0
        self._slave.setupExperiment(startTime=0.0)
        self._slave.enterInitializationMode()
        self._slave.exitInitializationMode()
        return self._observe()

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Hold the inputs for some time."""
        if u:
            self._slave.setReal(self._at[0], list(u))
        self._slave.doStep(self._t, duration)
        self._t += duration
        return self._observe()

    def _observe(self) -> Mapping[str, float]:
        return dict(zip(self.signals, self._slave.getReal(self._at[1]), strict=True))

    def _get_state(self) -> tuple[float, bytes]:
        state = self._slave.getFMUState()
        kept = self._slave.serializeFMUState(state)
        self._slave.freeFMUState(state)
        return self._t, bytes(kept)

    def _set_state(self, x: tuple[float, bytes]) -> None:
        state = self._slave.deserializeFMUState(x[1])
        self._slave.setFMUState(state)
        self._slave.freeFMUState(state)
        self._t = x[0]
