"""Legged machines in MuJoCo and their multipliers, in plain MuJoCo and NumPy: no import of the
package.

Each machine has a clock, and a horizontal position `x` on which nothing depends. Its truth is that
of the map from one period of the clock to the next: central differences over several steps, and
the decay of a transient.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco as mj
import numpy as np


HEAD = """
<mujoco>
  <option timestep="{step}" integrator="{integrator}" cone="elliptic" tolerance="{tolerance}"/>
  <default>
    <geom solref="{solref}" solimp="{solimp}" friction="{friction} 0 0" contype="0"
      conaffinity="0"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="50 2 0.1" conaffinity="1"/>
"""

# A torso over one leg with a spring. Joints: x, z, pitch, hip, leg.
HOPPER = """
    <body pos="0 0 0">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom type="box" size="0.35 0.1 0.1" mass="10"/>
      <body>
        <joint name="hip" axis="0 1 0" damping="0.3" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.4"/>
        <body>
          <joint name="leg" type="slide" axis="0 0 1" stiffness="3500" damping="40"/>
          <geom type="capsule" fromto="0 0 -0.3 0 0 -0.55" size="0.02" mass="0.2"/>
          <geom type="sphere" pos="0 0 -0.6" size="0.04" mass="0.05" contype="1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="hip" joint="hip"/> <motor name="leg" joint="leg"/>
    <motor name="push" joint="x"/>
  </actuator>
  <keyframe><key qpos="0 0.72 0 0 0" qvel="0 0 0 0 0"/></keyframe>
</mujoco>
"""

LEG = """
      <body pos="{at} 0 0">
        <joint name="{name}" axis="0 1 0" damping="0.2" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
        <body>
          <joint name="{name}_leg" type="slide" axis="0 0 1" stiffness="{stiffness}"
            damping="{damping}"/>
          <geom type="sphere" pos="0 0 {down}" size="0.03" mass="0.2" contype="1"/>
        </body>
      </body>
"""

LONG_LEG = """
      <body>
        <joint name="{name}" axis="0 1 0" damping="0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1"/>
        <body>
          <joint name="{name}_leg" type="slide" axis="0 0 1" stiffness="7000" damping="150"/>
          <geom type="sphere" pos="0 0 -0.9" size="0.05" mass="0.4" contype="1"/>
        </body>
      </body>
"""

# A torso on two legs that swing in turn.
WALKER = (
    """
    <body>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0.05 0 0 0.45" size="0.07" mass="12"/>
"""
    + LONG_LEG.format(name="left")
    + LONG_LEG.format(name="right")
    + """
    </body>
  </worldbody>
  <actuator>
    <motor name="left" joint="left"/> <motor name="right" joint="right"/>
    <motor name="left_leg" joint="left_leg"/> <motor name="right_leg" joint="right_leg"/>
    <motor name="push" joint="x"/>
  </actuator>
  <keyframe><key qpos="0 0.92 0 0.25 0 -0.25 0" qvel="0.7 0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
)

# A long body on four legs that trot: fore left with hind right, and the other two.
QUADRUPED = (
    """
    <body>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom type="box" size="0.3 0.12 0.06" mass="9"/>
"""
    + "".join(
        LEG.format(at=at, name=name, stiffness=2500, damping=30, down=-0.35)
        for name, at in (("fl", 0.25), ("fr", 0.25), ("hl", -0.25), ("hr", -0.25))
    )
    + """
    </body>
  </worldbody>
  <actuator>
    <motor name="fl" joint="fl"/> <motor name="fr" joint="fr"/>
    <motor name="hl" joint="hl"/> <motor name="hr" joint="hr"/>
    <motor name="fl_leg" joint="fl_leg"/> <motor name="fr_leg" joint="fr_leg"/>
    <motor name="hl_leg" joint="hl_leg"/> <motor name="hr_leg" joint="hr_leg"/>
    <motor name="push" joint="x"/>
  </actuator>
  <keyframe><key qpos="0 0.37 0 0 0 0 0 0 0 0 0" qvel="0.3 0 0 0 0 0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
)


def hop(model: Any, data: Any) -> list[float]:
    """The leg is pushed by the clock; the hip places the foot in flight, and holds the torso
    upright while the spring is compressed."""
    speed, _, rate, hip_rate, _ = data.qvel
    _, z, pitch, hip, leg = data.qpos
    if z < 0.35 or abs(pitch) > 1:
        raise ValueError("fell")
    phase = math.sin(2 * math.pi * data.time / HOP)
    stance = 0.5 + 0.5 * math.tanh(150 * (leg - 0.02))
    target = -0.13 * speed - 0.04 * (speed - 0.3)
    swing = 25 * (target - pitch - hip) - 2.5 * (rate + hip_rate)
    upright = 40 * pitch + 8 * rate
    return [stance * upright + (1 - stance) * swing, -260 * max(0.0, phase), 0.0]


def walk(model: Any, data: Any) -> list[float]:
    """The legs swing and shorten in turn; the leg on the ground holds the torso upright."""
    _, z, pitch, left, _, right, _ = data.qpos
    speed, _, rate, left_rate, _, right_rate, _ = data.qvel
    if z < 0.5 or abs(pitch) > 1:
        raise ValueError("fell")
    phase = math.sin(2 * math.pi * data.time / WALK)
    swings = 0.5 + 0.5 * math.tanh(4 * phase)  # 1: the left leg, 0: the right leg
    ahead = -(speed * WALK / 4 + 0.3 * (speed - 0.4))
    torso = -150 * pitch - 20 * rate
    swing_left = 60 * (ahead - pitch - left) - 7 * (rate + left_rate)
    swing_right = 60 * (ahead - pitch - right) - 7 * (rate + right_rate)
    return [
        swings * swing_left - (1 - swings) * (torso + swing_right),
        (1 - swings) * swing_right - swings * (torso + swing_left),
        500 * max(0.0, phase) ** 2,
        500 * max(0.0, -phase) ** 2,
        0.0,
    ]


def trot(model: Any, data: Any) -> list[float]:
    """Servos follow the clock: hips swing, legs shorten while they swing forward."""
    angles = data.qpos[[3, 5, 7, 9]]
    rates = data.qvel[[3, 5, 7, 9]]
    if data.qpos[1] < 0.15 or abs(data.qpos[2]) > 1:
        raise ValueError("fell")
    phase = 2 * math.pi * data.time / TROT
    wave = math.cos(phase)
    lift = math.sin(phase)
    targets = 0.15 * np.array([wave, -wave, -wave, wave])
    hips = 60 * (targets - angles) - 3 * rates
    up = np.array([max(0.0, lift), max(0.0, -lift), max(0.0, -lift), max(0.0, lift)])
    return [*hips, *(150 * up), 0.0]


HOP = 0.5  # s
WALK = 0.8
TROT = 0.5


class Machine(NamedTuple):
    """A machine without the numbers of its contacts."""

    xml: str
    control: Callable[[Any, Any], list[float]]
    period: float
    """Of the clock, s."""


MACHINES = {
    "hopper": Machine(HOPPER, hop, HOP),
    "walker": Machine(WALKER, walk, WALK),
    "quadruped": Machine(QUADRUPED, trot, TROT),
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """A machine with contacts and a time step."""

    machine: str
    step: float = 5e-4
    integrator: str = "implicitfast"
    solref: str = "0.02 1"
    solimp: str = "0 0.95 0.01"
    friction: float = 1.5
    tolerance: float = 1e-10

    def model(self) -> Any:
        numbers = dataclasses.asdict(self)
        return mj.MjModel.from_xml_string(
            HEAD.format(**numbers) + MACHINES[self.machine].xml
        )


class Simulation:
    """A machine from one period of its clock to the next."""

    def __init__(self, setting: Setting):
        machine = MACHINES[setting.machine]
        self.model = setting.model()
        self.data = mj.MjData(self.model)
        self.control = machine.control
        self.step = setting.step
        self.count = round(machine.period / setting.step)
        mj.mj_resetDataKeyframe(self.model, self.data, 0)

    @property
    def state(self) -> np.ndarray:
        """Positions without x, and velocities."""
        return np.concatenate([self.data.qpos[1:], self.data.qvel])

    def period(
        self,
        state: np.ndarray | None = None,
        first: float = 0.0,
        rows: list[np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return the state after one period from a state, or from the present one.

        **Arguments:** `first`: length of a first, shorter step, in units of a step, which moves the
        grid of time. `rows`: the states before all steps are appended.
        """
        data = self.data
        if state is not None:
            nq = self.model.nq
            data.qpos[0] = 0.0
            data.qpos[1:] = state[: nq - 1]
            data.qvel[:] = state[nq - 1 :]
            data.qacc_warmstart[:] = 0.0
        lengths = [1.0] * self.count
        if first:
            lengths = [first, *lengths[1:], 1 - first]
        time = 0.0
        for length in lengths:
            data.time = time
            self.model.opt.timestep = length * self.step
            if rows is not None:
                rows.append(self.state)
            # (Contacts and sensors of the present state, for the controller.)
            mj.mj_step1(self.model, data)
            data.ctrl[:] = self.control(self.model, data)
            mj.mj_step2(self.model, data)
            time += length * self.step
        self.model.opt.timestep = self.step
        return self.state

    def settled(self, periods: int = 150) -> np.ndarray:
        """Return the state after some periods from the keyframe."""
        for _ in range(periods):
            state = self.period()
        return state


def jacobians(
    simulation: Simulation,
    state: np.ndarray,
    steps: np.ndarray,
    firsts: tuple[float, ...] = (0.0,),
) -> np.ndarray:
    """Return Jacobians (n, d, d) by central differences, one for each step (a part of the ranges of
    the coordinates) and each grid of time (`first`), in units of the ranges."""
    rows: list[np.ndarray] = []
    simulation.period(state, rows=rows)
    size = np.ptp(rows, axis=0)
    found = []
    for first in firsts:
        for step in steps:
            columns = []
            for k, width in enumerate(step * size):
                move = np.zeros(len(state))
                move[k] = width
                above = simulation.period(state + move, first)
                below = simulation.period(state - move, first)
                columns.append((above - below) / (2 * step * size))
            found.append(np.array(columns).T)
    return np.array(found)


class Truth(NamedTuple):
    """Multipliers of a setting, by differences and by a transient."""

    multipliers: np.ndarray
    """(d,) means over steps and grids of time."""
    errors: np.ndarray
    """(d,) standard errors: scatter over steps and grids, in so many grids."""
    by_decay: float
    """Modulus of the largest, by the decay of a transient; NaN if it decays into noise at once."""


# Phases of the grid of time, in units of a step, and steps of differences in units of ranges.
GRIDS = (0.0, 0.37, 0.71)
STEPS = np.array([0.002, 0.01])


def truth_of(setting: Setting, periods: int = 100) -> Truth:
    """Return the multipliers of a setting after some periods.

    **Raises:** `ValueError` for a machine that falls, or does not settle.
    """
    simulation = Simulation(setting)
    state = simulation.settled(periods)
    change = np.abs(simulation.period(state) - state).max()
    if not change < 1e-3:
        raise ValueError(f"did not settle: {change:.1e}")
    maps = jacobians(simulation, state, STEPS, GRIDS)
    mean = maps.mean(axis=0)
    values, right = np.linalg.eig(mean)
    left = np.linalg.inv(right)
    # (To first order, the same eigenvalue of each map.)
    each = np.einsum("ij,njk,ki->ni", left, maps - mean, right)
    errors = np.sqrt((np.abs(each) ** 2).mean(axis=0) / len(GRIDS))
    order = np.lexsort((-values.imag, -np.abs(values).round(9)))
    by_decay = decay(simulation, state)
    return Truth(values.astype(complex)[order], errors[order], by_decay)


def decay(simulation: Simulation, state: np.ndarray) -> float:
    """Return the modulus of the largest multiplier by the decay of a deviation of 3 % of the
    state: the geometric mean of its shrinking from period 4 to 16."""
    rng = np.random.default_rng(0)
    rows: list[np.ndarray] = []
    simulation.period(state, rows=rows)
    size = np.ptp(rows, axis=0)
    # (Over both senses, what is even cancels.)
    sizes = []
    for _ in range(3):
        move = 0.03 * size * rng.choice([-1.0, 1.0], len(state))
        above = state + move
        below = state - move
        for k in range(16):
            above = simulation.period(above)
            below = simulation.period(below)
            if k in (3, 15):
                sizes.append(np.linalg.norm((above - below) / size))
    first = np.log(sizes[::2]).mean()
    last = np.log(sizes[1::2]).mean()
    return math.exp((last - first) / 12) if min(sizes) > 1e-9 else math.nan


def settings(count: int, seed: int = 0) -> list[Setting]:
    """Return settings with other contacts, time steps and integrators, of all machines in turn."""
    rng = np.random.default_rng(seed)
    machines = list(MACHINES)
    found = []
    for k in range(count):
        found.append(
            Setting(
                machine=machines[k % len(machines)],
                step=float(rng.choice([5e-4, 1e-3, 2e-3])),
                integrator=str(rng.choice(["implicitfast", "Euler"])),
                solref=str(rng.choice(["0.02 1", "0.01 1", "0.04 1", "0.02 0.7"])),
                solimp=str(
                    rng.choice(["0 0.95 0.01", "0 0.95 0.003", "0.9 0.95 0.001"])
                ),
                friction=float(rng.choice([0.8, 1.5])),
                tolerance=float(rng.choice([1e-8, 1e-10])),
            )
        )
    return found
