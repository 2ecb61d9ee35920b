"""Simulators of other packages as plants: MuJoCo, FMI 2.0 (co-simulation), Gymnasium."""

import dataclasses
import os
import shutil
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import package, require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, FilePath, NewOptionalNames, Positive, SignalNames
from ..errors import ComputationError, DefinitionError


Names = Sequence[str] | Mapping[str, str]


class Made:
    """A dataclass that another process makes again from its arguments."""

    def __reduce__(self) -> Any:
        arguments: Any = self
        return type(self), tuple(getattr(self, x.name) for x in dataclasses.fields(arguments))


@checked
def from_mujoco(
    model: Any, inputs: NewOptionalNames, *, control: Callable[[Any, Any], Any] | None = None,
    fallen: Callable[[Any], Any] | None = None, period: Positive | None = None,
    substeps: Count = 1,
) -> "MuJoCoPlant":  # fmt: skip
    """Make a plant of a MuJoCo model (`pip install 'hybridjax[mujoco]'`).

    The signals are positions and velocities of all slides and hinges (`hip`, `hip_rate`), then all
    sensors of the model by name. `reset` begins at the first keyframe, or at `qpos0`. The last step
    before a section is shorter than the others.

    **Arguments:**

    - `model`: an `mujoco.MjModel`, a file, or XML.
    - `inputs`: names of actuators, or units by name. An input is added to what `control` returns.
    - `control`: function of (model, data) that returns the controls of all actuators in each time
        step. It may read `data.time` if `period` is given, and must keep nothing between calls.
        Default: zero.
    - `fallen`: function of data that returns True where an experiment ends. Default: never.
    - `period`: period of the clock in seconds. Default: no clock.
    - `substeps`: number of time steps between two looks at the signals. Default: 1.

    **Raises:** `DefinitionError` for a model that MuJoCo does not read, and for unknown actuators.
    """
    mujoco = package("mujoco")
    try:
        if isinstance(model, str) and model.lstrip().startswith("<"):
            model = mujoco.MjModel.from_xml_string(model)
        elif isinstance(model, str | os.PathLike):
            model = mujoco.MjModel.from_xml_path(os.fspath(model))
    except ValueError as error:
        raise DefinitionError(f"`model` is no model of MuJoCo: {error}") from error
    if not isinstance(model, mujoco.MjModel):
        given = type(model).__name__
        raise DefinitionError(f"`model` must be an MjModel, a file, or XML, not of type {given}.")
    actuators = [model.actuator(i).name for i in range(model.nu)]
    require_among("actuator", list(inputs), actuators, "from_mujoco: ")
    return MuJoCoPlant(model, inputs, control, fallen, period, substeps)


@dataclasses.dataclass(eq=False)
class MuJoCoPlant(Made):
    """A model of MuJoCo as a plant: see `from_mujoco`."""

    model: Any
    inputs: Names
    control: Any
    fallen: Any
    period: float | None
    substeps: int

    def __post_init__(self) -> None:
        self._mujoco, model = package("mujoco"), self.model
        self.data, self.dt = self._mujoco.MjData(model), float(model.opt.timestep) * self.substeps
        kinds, parts = self._mujoco.mjtJoint, self._mujoco.mjtState
        whole = model.opt.integrator == self._mujoco.mjtIntegrator.mjINT_RK4
        self._integrate = self._mujoco.mj_step if whole else self._mujoco.mj_step2
        self._actuators = [model.actuator(name).id for name in self.inputs]
        scalar = np.isin(model.jnt_type, [int(kinds.mjJNT_SLIDE), int(kinds.mjJNT_HINGE)])
        self._q, self._v = model.jnt_qposadr[scalar], model.jnt_dofadr[scalar]
        names = [model.joint(i).name or f"joint{i}" for i in np.flatnonzero(scalar)]
        self._names = [*names, *(f"{x}_rate" for x in names)]
        for i in range(model.nsensor):
            name, n = model.sensor(i).name or f"sensor{i}", int(model.sensor_dim[i])
            self._names += [name] if n == 1 else [f"{name}[{k}]" for k in range(n)]
        q, v = [f"q{i}" for i in range(model.nq)], [f"v{i}" for i in range(model.nv)]
        for name, i, j in zip(names, self._q, self._v, strict=True):
            q[i], v[j] = name, f"{name}_rate"
        self.states = ("time", *q, *v, *(f"act{i}" for i in range(model.na)))
        # (The last part is where the solver of contacts begins.)
        kept = "TIME", "QPOS", "QVEL", "ACT", "WARMSTART"
        self._kept = sum(int(getattr(parts, f"mjSTATE_{x}")) for x in kept)

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin at the first keyframe."""
        self._mujoco.mj_resetData(self.model, self.data)
        if self.model.nkey:
            self._mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.data.time = 0.0
        self._mujoco.mj_step1(self.model, self.data)
        return self._observe()

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Hold the inputs for some time."""
        model, data, whole = self.model, self.data, float(self.model.opt.timestep)
        steps = int(duration / whole + 1e-9)
        left = duration - steps * whole
        try:
            for h in [whole] * steps + [left] * (left > 1e-9 * whole):
                model.opt.timestep = h
                data.ctrl[:] = 0.0 if self.control is None else self.control(model, data)
                for i, x in zip(self._actuators, u, strict=True):
                    data.ctrl[i] += x
                # The positions of bodies, contacts and sensors then belong to the present state,
                # which they do not after `mj_step`. (Runge-Kutta steps cannot be divided.)
                self._integrate(model, data)
                self._mujoco.mj_step1(model, data)
        finally:
            model.opt.timestep = whole
        if self.fallen is not None and self.fallen(data):
            raise ComputationError("the walker has fallen")
        return self._observe()

    def _observe(self) -> Mapping[str, float]:
        data = self.data
        values = np.concatenate([data.qpos[self._q], data.qvel[self._v], data.sensordata])
        return dict(zip(self._names, values.tolist(), strict=True))

    def get_state(self) -> np.ndarray:
        """Return `states`, and then what the solver of contacts keeps."""
        x = np.empty(self._mujoco.mj_stateSize(self.model, self._kept))
        self._mujoco.mj_getState(self.model, self.data, x, self._kept)
        return x

    def set_state(self, x: Any) -> None:
        """Continue from a state."""
        self._mujoco.mj_setState(self.model, self.data, x, self._kept)
        self._mujoco.mj_step1(self.model, self.data)


@checked
def from_fmu(
    file: FilePath, inputs: NewOptionalNames, signals: SignalNames, *, dt: Positive,
    period: Positive | None = None,
) -> "FMUPlant":  # fmt: skip
    """Make a plant of an FMU (`pip install 'hybridjax[fmu]'`).

    Running an FMU runs the machine code in it. Units come from the file. If the FMU can save its
    state, experiments begin at the settled state; if it also takes steps of any size, steps end on
    the sections.

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
    inputs: Names
    signals: tuple[str, ...]
    dt: float
    period: float | None

    def __post_init__(self) -> None:
        fmpy = package("fmpy")
        try:
            about = fmpy.read_model_description(self.file)
        except Exception as error:  # (of many kinds)
            raise DefinitionError(
                f"'{self.file}' is not there, or no FMU: give a file of FMI 2.0 for co-simulation."
            ) from error
        can = about.coSimulation
        if not about.fmiVersion.startswith("2.") or can is None:
            text = f"'{self.file}' is no FMU of FMI 2.0 for co-simulation"
            raise DefinitionError(f"{text}: export it as one.")
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


@checked
def from_gymnasium(
    environment: str | Callable[[], Any], inputs: NewOptionalNames, signals: SignalNames, *,
    dt: Positive, policy: Callable[[Any], Any] | None = None, period: Positive | None = None,
) -> "GymnasiumPlant":  # fmt: skip
    """Make a plant of a Gymnasium environment (`pip install 'hybridjax[gym]'`).

    Environments have fixed steps and states that cannot be set: sections are interpolated between
    two steps, inputs change at the step after a section, and each experiment settles anew. An
    experiment ends where the environment is terminated or truncated.

    **Arguments:**

    - `environment`: a registered name, or a function that makes the environment.
    - `inputs`: names of the actions, or units by name. An input is added to what `policy` returns.
    - `signals`: names of the entries of an observation.
    - `dt`: time between two steps in seconds.
    - `policy`: function of the observation that returns the actions, without memory. Default:
        zero.
    - `period`: period of the clock in seconds. Default: no clock.

    **Raises:** `DefinitionError` for names that do not fit.
    """
    return GymnasiumPlant(environment, inputs, tuple(signals), dt, policy, period)


@dataclasses.dataclass(eq=False)
class GymnasiumPlant(Made):
    """An environment as a plant: see `from_gymnasium`."""

    fixed_step = True
    environment: Any
    inputs: Names
    signals: tuple[str, ...]
    dt: float
    policy: Any
    period: float | None

    def __post_init__(self) -> None:
        gym, make = package("gymnasium"), self.environment
        # (Time limits of a registered environment would end experiments.)
        try:
            self._made = gym.make(make).unwrapped if isinstance(make, str) else make()
        except gym.error.Error as error:
            text = f"Gymnasium has no environment '{make}'"
            raise DefinitionError(f"{text}: `gymnasium.pprint_registry()` lists them.") from error
        shapes = self._made.observation_space.shape, self._made.action_space.shape
        if shapes != ((len(self.signals),), (len(self.inputs),)):
            text = f"observations and actions have the shapes {shapes}"
            raise DefinitionError(f"{text}: give as many `signals` and `inputs`.")

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin an episode."""
        self._z, _ = self._made.reset(seed=seed)
        return dict(zip(self.signals, self._z.tolist(), strict=True))

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Take one step."""
        action = np.array(u, float)
        if self.policy is not None:
            action += self.policy(self._z)
        action = action.astype(self._made.action_space.dtype)
        self._z, _, terminated, truncated, _ = self._made.step(action)
        if terminated or truncated:
            raise ComputationError(f"the episode was {'terminated' if terminated else 'truncated'}")
        return dict(zip(self.signals, self._z.tolist(), strict=True))
