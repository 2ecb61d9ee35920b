"""Models of MuJoCo as plants."""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import package, require_among
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, NewOptionalNames, Positive
from ..errors import ComputationError, DefinitionError


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
        model.opt.timestep  # noqa: B018
    except (ValueError, AttributeError) as error:
        raise DefinitionError(f"`model` is no model of MuJoCo: {error}") from error
    actuators = [model.actuator(i).name for i in range(model.nu)]
    require_among("actuator", list(inputs), actuators, "from_mujoco: ")
    return MuJoCoPlant(model, inputs, control, fallen, period, substeps)


class MuJoCoPlant:
    """A model of MuJoCo as a plant: see `from_mujoco`."""

    def __init__(
        self,
        model: Any,
        inputs: Sequence[str] | Mapping[str, str],
        control: Any,
        fallen: Any,
        period: float | None,
        substeps: int,
    ):
        self.model, self.inputs, self.period = model, inputs, period
        self.control, self.fallen = control, fallen
        self.dt = float(model.opt.timestep) * substeps
        self.substeps = substeps
        self._make()

    def _make(self) -> None:
        self._mujoco = mujoco = package("mujoco")
        model = self.model
        self.data = mujoco.MjData(model)
        whole = int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
        self._integrate = mujoco.mj_step if whole else mujoco.mj_step2
        self._refresh = mujoco.mj_step1
        self._actuators = [model.actuator(name).id for name in self.inputs]
        scalar = {int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)}
        single = [i for i in range(model.njnt) if int(model.jnt_type[i]) in scalar]
        names = [model.joint(i).name or f"joint{i}" for i in single]
        self._positions = [int(model.jnt_qposadr[i]) for i in single]
        self._velocities = [int(model.jnt_dofadr[i]) for i in single]
        sensors = [
            (model.sensor(i).name or f"sensor{i}", int(model.sensor_dim[i]))
            for i in range(model.nsensor)
        ]
        several = [x if n == 1 else f"{x}[{k}]" for x, n in sensors for k in range(n)]
        self._names = [*names, *(f"{x}_rate" for x in names), *several]
        q = [f"q{i}" for i in range(model.nq)]
        v = [f"v{i}" for i in range(model.nv)]
        for name, i, j in zip(names, self._positions, self._velocities, strict=True):
            q[i], v[j] = name, f"{name}_rate"
        self.states = ("time", *q, *v, *(f"act{i}" for i in range(model.na)))

    def __getstate__(self) -> dict[str, Any]:
        kept = "model", "inputs", "period", "control", "fallen", "dt", "substeps"
        return {name: getattr(self, name) for name in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._make()

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin at the first keyframe."""
        if self.model.nkey:
            self._mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        else:
            self._mujoco.mj_resetData(self.model, self.data)
        self.data.time = 0.0
        self._refresh(self.model, self.data)
        return self._observe()

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Hold the inputs for some time."""
        model, data, whole = self.model, self.data, float(self.model.opt.timestep)
        steps = int(duration / whole + 1e-9)
        left = duration - steps * whole
        for _ in range(steps):
            self._advance(u)
        if left > 1e-9 * whole:
            model.opt.timestep = left
            try:
                self._advance(u)
            finally:
                model.opt.timestep = whole
        if self.fallen is not None and self.fallen(data):
            raise ComputationError("the walker has fallen")
        return self._observe()

    def _advance(self, u: Sequence[float]) -> None:
        model, data = self.model, self.data
        data.ctrl[:] = 0.0 if self.control is None else self.control(model, data)
        for i, x in zip(self._actuators, u, strict=True):
            data.ctrl[i] += x
        # The positions of bodies, contacts and sensors then belong to the present state, which they
        # do not after `mj_step`. (Runge-Kutta steps cannot be divided.)
        self._integrate(model, data)
        self._refresh(model, data)

    def _observe(self) -> Mapping[str, float]:
        data = self.data
        q, v = data.qpos[self._positions], data.qvel[self._velocities]
        return dict(
            zip(self._names, [*q.tolist(), *v.tolist(), *data.sensordata.tolist()], strict=True)
        )

    def get_state(self) -> np.ndarray:
        """Return `states`, then where the solver of contacts begins."""
        x = self.data
        return np.concatenate([[x.time], x.qpos, x.qvel, x.act, x.qacc_warmstart])

    def set_state(self, x: Any) -> None:
        """Continue from a state."""
        data, model = self.data, self.model
        sizes = np.cumsum([1, model.nq, model.nv, model.na])
        time, data.qpos[:], data.qvel[:], data.act[:], data.qacc_warmstart[:] = np.split(x, sizes)
        data.time = float(time[0])
        self._refresh(model, data)
