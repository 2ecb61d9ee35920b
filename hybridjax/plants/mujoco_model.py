"""Models of MuJoCo as plants."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import package, require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, NewOptionalNames, Positive
from ..errors import ComputationError, DefinitionError
from .plant import Made


@checked
def from_mujoco(
    model: Any,
    inputs: NewOptionalNames,
    *,
    control: Callable[[Any, Any], Any] | None = None,
    fallen: Callable[[Any], Any] | None = None,
    period: Positive | None = None,
    substeps: Count = 1,
) -> "MuJoCoPlant":
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
    actuators = [model.actuator(i).name for i in range(model.nu)]
    require_among("actuator", list(inputs), actuators, "from_mujoco: ")
    return MuJoCoPlant(model, inputs, control, fallen, period, substeps)


@dataclasses.dataclass(eq=False)
class MuJoCoPlant(Made):
    """A model of MuJoCo as a plant: see `from_mujoco`."""

    model: Any
    inputs: Sequence[str] | Mapping[str, str]
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
        if self.model.nkey:
            self._mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        else:
            self._mujoco.mj_resetData(self.model, self.data)
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
