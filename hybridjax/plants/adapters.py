"""Simulators of other packages as plants: MuJoCo, FMI 2.0 (co-simulation), Gymnasium.

Each class has the methods of the protocol `Plant` (`drive.py`), which `find_cycle` and experiments
call: `reset(seed)` begins again, and `step(u, duration)` holds the inputs u and returns the signals
by name. If the state can be set, there are `get_state` and `set_state`, too. A simulator of another
package becomes a plant by one more class of this kind.

If a run is not repeated exactly, look at `reset` and `set_state`; if a signal is late by a step, at
the order in `step` and `_step_once`.
"""

import dataclasses
import functools
import os
import shutil
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import package, require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import (
    Count,
    FilePath,
    NewOptionalNames,
    Positive,
    SignalNames,
)
from ..errors import ComputationError, DefinitionError


class _Made:
    """Base of plants that are pickled by their fields, so that another process makes the plant
    again."""

    def __reduce__(self) -> Any:
        fields = {x.name: getattr(self, x.name) for x in dataclasses.fields(self)}  # type: ignore[arg-type]
        return functools.partial(type(self), **fields), ()


def _numbered(names: Sequence[str], sizes: Any) -> list[str]:
    """Return a name for each number: several of the same name get an index."""
    numbered = []
    for name, size in zip(names, sizes, strict=True):
        if size == 1:
            numbered.append(name)
        else:
            numbered += [f"{name}[{k}]" for k in range(size)]
    return numbered


@checked
@dataclasses.dataclass(eq=False)
class MuJoCoPlant(_Made):
    """A model of MuJoCo as a plant (`pip install 'hybridjax[mujoco]'`).

    The signals are positions and velocities of all joints (`hip`, `hip_rate`; several numbers are
    `root[0]`, `root[1]`, ...), then all sensors of the model by name. `reset` begins at the first
    keyframe, or at `qpos0`. The last step before a section is shorter than the others. `data` is
    the `mujoco.MjData`.

    **Fields:**

    - `model`: a `mujoco.MjModel`.
    - `inputs`: names of actuators, or units by name. An input is added to what `control` returns.
    - `control`: function of (model, data) that returns the controls of all actuators in each time
        step. It may read `data.time` if `period` is given, and keeps memory in
        `data.userdata` only. An error that it raises (a fall) ends an experiment. Default: zero.
    - `period`: period of the clock in seconds. Default: no clock.
    - `substeps`: number of time steps between two readings of the signals. Default: 1.

    **Raises:** `DefinitionError` for other models, and for unknown actuators.
    """

    model: Any
    inputs: NewOptionalNames
    _: dataclasses.KW_ONLY
    control: Callable[[Any, Any], Any] | None = None
    period: Positive | None = None
    substeps: Count = 1

    def __post_init__(self) -> None:
        mujoco = package("mujoco")
        model = self.model
        if not isinstance(model, mujoco.MjModel):
            raise DefinitionError(
                "`model` must be a `mujoco.MjModel`: see `from_xml_path`."
            )
        actuators = [model.actuator(i).name for i in range(model.nu)]
        require_among("actuator", list(self.inputs), actuators, "MuJoCoPlant: ")
        self._actuators = [actuators.index(name) for name in self.inputs]
        self.data = mujoco.MjData(model)
        self.dt = model.opt.timestep * self.substeps
        joints = [model.joint(i).name or f"joint{i}" for i in range(model.njnt)]
        rates = [f"{name}_rate" for name in joints]
        sensors = [model.sensor(i).name or f"sensor{i}" for i in range(model.nsensor)]
        positions = _numbered(joints, np.diff([*model.jnt_qposadr, model.nq]))
        velocities = _numbered(rates, np.diff([*model.jnt_dofadr, model.nv]))
        readings = _numbered(sensors, model.sensor_dim)
        self._names = [*positions, *velocities, *readings]
        activations = [f"act{i}" for i in range(model.na)]
        self.states = ("time", *positions, *velocities, *activations)
        # (The full state: it includes the memory of controllers, and the start of the contact
        # solver.)
        self._kept = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        # Positions of bodies, contacts and sensors belong to the present state after `mj_step1`,
        # but not after `mj_step`. So a step is divided in two, which is not possible with
        # integrator 1 (Runge-Kutta).
        if model.opt.integrator == 1:
            self._integrate = mujoco.mj_step
        else:
            self._integrate = mujoco.mj_step2
        self._mujoco = mujoco

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin at the first keyframe."""
        # (MuJoCo takes `qpos0` if there is no keyframe.)
        self._mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self._mujoco.mj_step1(self.model, self.data)
        return self._observe()

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Hold the inputs for some time."""
        whole_step = self.dt / self.substeps
        # (A duration of n steps up to rounding gives n steps. The small number keeps rounding from
        # adding a very short step.)
        count = int(duration / whole_step + 1e-9)
        rest = duration - count * whole_step
        for _ in range(count):
            self._step_once(u)
        if rest > 1e-9 * whole_step:
            self.model.opt.timestep = rest
            self._step_once(u)
            self.model.opt.timestep = whole_step
        return self._observe()

    def _step_once(self, u: Sequence[float]) -> None:
        """Set the controls, integrate over one time step of the model, and update positions of
        bodies, contacts and sensors to the new state."""
        controls = self.data.ctrl
        controls[:] = 0.0
        if self.control is not None:
            controls[:] = self.control(self.model, self.data)
        controls[self._actuators] += u
        self._integrate(self.model, self.data)
        self._mujoco.mj_step1(self.model, self.data)

    def _observe(self) -> Mapping[str, float]:
        values = self.data.qpos, self.data.qvel, self.data.sensordata
        return dict(zip(self._names, np.concatenate(values).tolist(), strict=True))

    def get_state(self) -> np.ndarray:
        """Return `states`, then all other numbers from which MuJoCo continues."""
        x = np.empty(self._mujoco.mj_stateSize(self.model, self._kept))
        self._mujoco.mj_getState(self.model, self.data, x, self._kept)
        return x

    def set_state(self, x: np.ndarray) -> None:
        """Continue from a state."""
        self._mujoco.mj_setState(self.model, self.data, x, self._kept)
        self._mujoco.mj_step1(self.model, self.data)


@checked
@dataclasses.dataclass(eq=False)
class FMUPlant(_Made):
    """An FMU as a plant (`pip install 'hybridjax[fmu]'`).

    Running an FMU runs the machine code in it. Units come from the file. States of FMUs are
    not saved: each experiment settles anew, and sections between two steps are interpolated.

    **Fields:**

    - `file`: an FMU of FMI 2.0 for co-simulation.
    - `inputs`, `signals`: names of real variables.
    - `dt`: longest communication step in seconds.
    - `period`: period of the clock in seconds. Default: no clock.

    **Raises:** `DefinitionError` for another kind of FMU, and for unknown variables.
    """

    file: FilePath
    inputs: NewOptionalNames
    signals: SignalNames
    dt: Positive
    period: Positive | None = None

    def __post_init__(self) -> None:
        fmpy = package("fmpy")
        self.file = os.path.abspath(self.file)
        try:
            about = fmpy.read_model_description(self.file)
            can = about.coSimulation if about.fmiVersion.startswith("2.") else None
        except Exception:  # (of many kinds)
            can = None
        if can is None:
            raise DefinitionError(
                f"'{self.file}' is no FMU of FMI 2.0 for co-simulation."
            )
        self.fixed_step = not can.canHandleVariableCommunicationStepSize
        real = {x.name: x for x in about.modelVariables if x.type == "Real"}
        names = [*self.inputs, *self.signals]
        require_among("real variable", names, real, "FMUPlant: ")
        self._inputs = [real[x].valueReference for x in self.inputs]
        self._signals = [real[x].valueReference for x in self.signals]
        self.units = {x: real[x].unit for x in self.signals if real[x].unit}
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
            self._slave.setReal(self._inputs, list(u))
        self._slave.doStep(self._t, duration)
        self._t += duration
        return self._observe()

    def _observe(self) -> Mapping[str, float]:
        values = self._slave.getReal(self._signals)
        return dict(zip(self.signals, values, strict=True))


@checked
@dataclasses.dataclass(eq=False)
class GymnasiumPlant(_Made):
    """A Gymnasium environment as a plant.

    Environments have fixed steps and states that cannot be set: sections are interpolated between
    two steps, inputs change at the step after a section, and each experiment settles anew. An
    experiment ends where the environment is terminated or truncated.

    **Fields:**

    - `environment`: a function that makes the environment, without a limit of time.
    - `inputs`: names of the actions, or units by name. An input is added to what `policy` returns.
    - `signals`: names of the entries of an observation.
    - `dt`: time between two steps in seconds.
    - `policy`: function of the observation that returns the actions, without memory. Default:
        zero.
    """

    fixed_step = True
    environment: Callable[[], Any]
    inputs: NewOptionalNames
    signals: SignalNames
    dt: Positive
    policy: Callable[[Any], Any] | None = None

    def __post_init__(self) -> None:
        self._made = self.environment()

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin an episode."""
        self._z, _ = self._made.reset(seed=seed)
        return dict(zip(self.signals, self._z.tolist(), strict=True))

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Take one step."""
        action = np.array(u)
        if self.policy is not None:
            action = action + self.policy(self._z)
        action = action.astype(self._made.action_space.dtype)
        self._z, _, terminated, truncated, _ = self._made.step(action)
        if terminated:
            raise ComputationError("the episode was terminated")
        if truncated:
            raise ComputationError("the episode was truncated")
        return dict(zip(self.signals, self._z.tolist(), strict=True))
