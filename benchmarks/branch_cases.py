"""The branches of `branches.py`: systems, parameters, ranges, and what is known of them."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import hybridjax as hj
from hybridjax.systems.chart import FieldChart


m = hj.models
OVER = "end of the parameter range"


@dataclasses.dataclass
class Case:
    """A branch.

    **Fields:** `find`: options of its first search. `ends`: a part of the message of the first and
    the last end. `marks`: kinds and values of marked points in their order, or none where they are
    not known; NaN for a value that is not known. `border`: the value of the parameter at the first
    and the last end, NaN where it is not known. `exact`: a number of a cycle and what it is by a
    closed form.
    """

    system: hj.HybridSystem
    parameter: str
    values: tuple[float, ...]
    find: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    ends: tuple[str, str] = (OVER, OVER)
    marks: list[tuple[str, float]] | None = None
    border: tuple[float, float] = (np.nan, np.nan)
    exact: Callable[[hj.orbits.LimitCycle], tuple[float, float]] | None = None
    within: float = 1e-6
    """Relative error of `marks`, `border` and `exact` that is allowed."""


class Smooth(hj.HybridSystem):
    """A system with two or three states and one smooth field."""

    def charts(self):
        return {"all": FieldChart(self.field, self.states())}

    def states(self):
        return ("x", "y")


class Rayleigh(Smooth):
    eps: hj.Parameter = hj.parameter(1.0)

    def field(self, t, q, u):
        x, y = q
        return y, self.eps * (1 - y**2 / 3) * y - x

    def guess(self):
        return hj.Guess("all", (0.0, 2.0))


class Lorenz(Smooth):
    r: hj.Parameter = hj.parameter(28.0)

    def states(self):
        return ("x", "y", "z")

    def field(self, t, q, u):
        x, y, z = q
        return 10 * (y - x), self.r * x - y - x * z, x * y - 8 / 3 * z

    def guess(self):
        return hj.Guess("all", (-13.7636, -19.5788, 27.0))


class Brusselator(Smooth):
    b: hj.Parameter = hj.parameter(3.0)

    def field(self, t, q, u):
        x, y = q
        return 1 - (self.b + 1) * x + x**2 * y, self.b * x - x**2 * y

    def guess(self):
        return hj.Guess("all", (1.0, 4.0))


class Predators(Smooth):
    """Rosenzweig and MacArthur's: prey x with the capacity K, predators y."""

    K: hj.Parameter = hj.parameter(3.0)
    death: hj.Parameter = hj.parameter(0.4)

    def field(self, t, q, u):
        x, y = q
        eaten = x * y / (1 + x)
        return x * (1 - x / self.K) - eaten, eaten - self.death * y

    def guess(self):
        return hj.Guess("all", (0.667, 0.8))


class MorrisLecar(Smooth):
    """J. Rinzel and B. Ermentrout, in: Methods in neuronal modeling, 1989 (Hopf's parameters)."""

    current: hj.Parameter = hj.parameter(150.0)

    def states(self):
        return ("v", "w")

    def field(self, t, q, u):
        v, w = q
        open_calcium = 0.5 * (1 + jnp.tanh((v + 1.2) / 18))
        open_potassium = 0.5 * (1 + jnp.tanh((v - 2) / 30))
        rate = 0.04 * jnp.cosh((v - 2) / 60)
        calcium = 4.4 * open_calcium * (v - 120)
        total = self.current - calcium - 8 * w * (v + 84) - 2 * (v + 60)
        return total / 20, rate * (open_potassium - w)

    def guess(self):
        return hj.Guess("all", (0.0, 0.2))


class Boost(hj.HybridSystem):
    """A boost converter whose clock closes the switch, for a share `duty` of its period. Once the
    coil's current is zero, it stays so until then (discontinuous conduction)."""

    R: hj.Parameter = hj.parameter(40.0, unit="ohm")
    Vin: hj.Parameter = hj.parameter(10.0, unit="V")
    L: hj.Parameter = hj.parameter(100e-6, unit="H")
    C: hj.Parameter = hj.parameter(100e-6, unit="F")
    T: hj.Parameter = hj.parameter(20e-6, unit="s")
    duty: hj.Parameter = hj.parameter(0.5)
    v_guess: float = eqx.field(static=True, default=20.0)

    def charts(self):
        load = self.R * self.C

        def on(t, q, u):
            return -q[0] / load, self.Vin / self.L

        def off(t, q, u):
            return q[1] / self.C - q[0] / load, (self.Vin - q[0]) / self.L

        def idle(t, q, u):
            return (-q[0] / load,)

        return {
            "on": FieldChart(on, ("v", "i"), ("V", "A")),
            "off": FieldChart(off, ("v", "i"), ("V", "A")),
            "idle": FieldChart(idle, ("v",), ("V",), absent={"i": 0.0}),
        }

    def transitions(self):
        tick = hj.systems.Scheduled(self.T)
        opens = hj.systems.Scheduled(self.T, self.duty * self.T)
        return (
            hj.Transition("opens", "on", "off", opens),
            hj.Transition("closes", "off", "on", tick),
            hj.Transition(
                "empty",
                "off",
                "idle",
                lambda t, q, u: q[1],
                reset=lambda t, q, u: q[:1],
            ),
            hj.Transition(
                "closes again", "idle", "on", tick, reset=lambda t, q, u: (q[0], 0.0)
            ),
        )

    def period(self):
        return self.T

    def guess(self):
        current = 0.75 if self.v_guess == 20.0 else 0.5
        return hj.Guess("on", (self.v_guess, current), 0.25 * self.T)


class ImpactOscillator(hj.HybridSystem):
    """x'' + 0.1 x' + x = cos(rate t), with a wall at x = 1."""

    rate: hj.Parameter = hj.parameter(1.2)
    restitution: hj.Parameter = hj.parameter(0.8)

    def charts(self):
        def free(t, q, u):
            x, v = q
            return v, jnp.cos(self.rate * t) - 0.1 * v - x

        return {"free": FieldChart(free, ("x", "v"))}

    def transitions(self):
        def rebound(t, q, u):
            return 1.0, -self.restitution * q[1]

        wall = lambda t, q, u: 1 - q[0]  # noqa: E731
        return (hj.Transition("impact", "free", "free", wall, reset=rebound),)

    def period(self):
        return 2 * jnp.pi / self.rate

    def guess(self):
        return hj.Guess("free", (0.0, 1.0), 0.0)


class IntegrateAndFire(hj.HybridSystem):
    """v' = 1.5 - v + a sin(2 pi t / T), reset to 0 at v = 1: one spike in each period."""

    a: hj.Parameter = hj.parameter(0.6)
    T: hj.Parameter = hj.parameter(1.2)

    def charts(self):
        def leak(t, q, u):
            return (1.5 - q[0] + self.a * jnp.sin(2 * jnp.pi * t / self.T),)

        return {"leak": FieldChart(leak, ("v",))}

    def transitions(self):
        return (
            hj.Transition(
                "spike",
                "leak",
                "leak",
                lambda t, q, u: 1 - q[0],
                reset=lambda t, q, u: (0.0,),
            ),
        )

    def period(self):
        return self.T

    def guess(self):
        return hj.Guess("leak", (0.3,), 0.0)


class SchmittTrigger(hj.HybridSystem):
    """v' = 1 - v or -1 - v, switched at thresholds that move with a clock."""

    width: hj.Parameter = hj.parameter(0.31)
    T: hj.Parameter = hj.parameter(1.3)

    def charts(self):
        def toward(goal):
            return FieldChart(lambda t, q, u: (goal - q[0],), ("v",))

        return {"up": toward(1.0), "down": toward(-1.0)}

    def transitions(self):
        def threshold(t):
            return self.width + 0.05 * jnp.cos(2 * jnp.pi * t / self.T)

        return (
            hj.Transition("high", "up", "down", lambda t, q, u: threshold(t) - q[0]),
            hj.Transition("low", "down", "up", lambda t, q, u: q[0] + self.width),
        )

    def period(self):
        return self.T

    def guess(self):
        return hj.Guess("up", (0.0,), 0.0)


def _juggler_marks() -> list[tuple[str, float]]:
    """Holmes's fold and flip (see tests/orbits/test_continuation.py)."""
    a, g = 0.7, 9.81
    speed = (1 - a) * g / 2 / (1 + a)
    acceleration = 2 * (1 + a**2) / (1 + a) ** 2 * g
    flip = np.hypot(speed / (2 * np.pi), acceleration / (2 * np.pi) ** 2)
    return [("fold", speed / (2 * np.pi)), ("flip", float(flip))]


def _least_restitution() -> float:
    """The restitution at Holmes's fold, where the paddle's largest speed is just enough."""
    ratio = 4 * np.pi * float(m.PaddleJuggler().A) / 9.81
    return (1 - ratio) / (1 + ratio)


def _van_der_pol(cycle: hj.orbits.LimitCycle) -> tuple[float, float]:
    """Published periods (H. T. Davis, Introduction to nonlinear differential and integral
    equations, 1962, and others)."""
    known = {1.0: 6.6632868593, 5.0: 11.6122306678, 10.0: 19.0783695673}
    period = float(cycle.period)
    return period, known.get(float(cycle.system.mu), period)


def _largest_multiplier(cycle: hj.orbits.LimitCycle) -> float:
    return float(cycle.multipliers[0].real)


# Sections that contain the equilibrium at every value of the parameter.


def _potassium_rate(t, q):
    v, w = q
    return 0.5 * (1 + jnp.tanh((v - 2) / 30)) - w


def _recovery_rate(t, q):
    v, w = q
    return v + 0.7 - 0.8 * w


def _spike_margin() -> float:
    """The least amplitude of `IntegrateAndFire` with a spike in each period: the sine, passed
    through the leak, makes up for the mean."""
    T = 1.2
    gain = 1 / np.hypot(1, 2 * np.pi / T)
    return abs(1 / (1 - np.exp(-T)) - 1.5) / gain


def _widest() -> float:
    """The largest width of `SchmittTrigger` that its clock locks: at the lowest threshold, the ways
    up and down last a period together."""

    def late(w):
        high = w - 0.05
        return np.log((1 + w) / (1 - high)) + np.log((1 + high) / (1 - w)) - 1.3

    return brentq(late, 0.3, 0.4)


def _shallowest(alpha: float) -> float:
    """The slope at which the wheel, after an impact, just comes to the top of its spoke."""

    def surplus(slope):
        energy = 2 * np.sin(alpha) * np.sin(slope) / np.tan(2 * alpha) ** 2
        return energy - (1 - np.cos(alpha - slope))

    return brentq(surplus, 1e-6, alpha)


_VDP = (0.05, 1.0, 5.0, 10.0)
_AT_FALL = hj.Crossing("v", "falling")
# The current of FitzHugh and Nagumo's equilibrium at v, where its trace is zero.
_TURNS = np.sqrt(1 - 0.08 * 0.8) * np.array([-1.0, 1.0])
_HOPF = (_TURNS + 0.7) / 0.8 - _TURNS + _TURNS**3 / 3
_REST = "equilibrium"

CASES: dict[str, Callable[[], Case]] = {
    "van der Pol": lambda: Case(
        m.VanDerPol(), "mu", _VDP, {"section": _AT_FALL}, marks=[], exact=_van_der_pol
    ),
    "van der Pol from 6": lambda: Case(
        m.VanDerPol(mu=6.0), "mu", _VDP, marks=[], exact=_van_der_pol
    ),
    "Rayleigh": lambda: Case(Rayleigh(), "eps", (0.1, 8.0), marks=[]),
    "FitzHugh-Nagumo": lambda: Case(
        m.FitzHughNagumo(eps=0.08),
        "current",
        (0.2, 1.6),
        {"section": hj.Crossing(_recovery_rate, "rising")},
        ends=(_REST, _REST),
        border=tuple(_HOPF),
        within=1e-3,
    ),
    "Duffing, rate": lambda: Case(
        m.Duffing(amplitude=0.5),
        "rate",
        (0.5, 2.5),
        marks=[("fold", np.nan), ("fold", np.nan)],
    ),
    "Duffing, force": lambda: Case(
        m.Duffing(rate=1.5, amplitude=0.2),
        "amplitude",
        (0.1, 4.0),
        marks=[("fold", np.nan), ("fold", np.nan)],
    ),
    "Lorenz": lambda: Case(
        Lorenz(),
        "r",
        (28.0, 60.0),
        {"section": hj.Crossing("z", "rising", 27.0), "multiplicity": 2},
        ends=(OVER, "touches its section (z rising) tangentially"),
        marks=None,
    ),
    "Brusselator": lambda: Case(
        Brusselator(),
        "b",
        (1.8, 6.0),
        {"section": hj.Crossing("x", "rising", 1.0)},
        ends=(_REST, OVER),
        marks=[],
        border=(2.0, 6.0),
        within=1e-3,
    ),
    "Hopf": lambda: Case(
        m.HopfOscillator(),
        "mu",
        (-0.1, 2.0),
        ends=(_REST, OVER),
        marks=[],
        border=(np.nan, 2.0),
        exact=lambda c: (_largest_multiplier(c), float(np.exp(-2 * c.system.mu))),
        within=1e-5,
    ),
    "predators": lambda: Case(
        Predators(),
        "K",
        (2.0, 8.0),
        {"section": hj.Crossing("x", "rising", 2 / 3)},
        ends=(_REST, OVER),
        marks=[],
        border=(7 / 3, 8.0),
        within=1e-3,
    ),
    "Morris-Lecar": lambda: Case(
        MorrisLecar(),
        "current",
        (80.0, 230.0),
        {"section": hj.Crossing(_potassium_rate, "falling")},
        ends=(_REST, _REST),
        border=(93.86, 212.0),
        within=2e-3,
    ),
    "juggler, amplitude": lambda: Case(
        m.PaddleJuggler(), "A", (0.1, 0.4), marks=_juggler_marks()
    ),
    "juggler, restitution": lambda: Case(
        m.PaddleJuggler(),
        "restitution",
        (0.6, 1.1),
        marks=[("fold", _least_restitution()), ("Neimark-Sacker", 1.0)],
        exact=lambda c: (
            float(np.prod(c.multipliers).real),
            float(c.system.restitution**2),
        ),
    ),
    "buck, supply": lambda: Case(
        m.BuckConverter(), "Vin", (16.0, 26.0), marks=[("flip", 24.5165728285634)]
    ),
    "buck, load": lambda: Case(m.BuckConverter(), "R", (12.0, 40.0)),
    "boost": lambda: Case(
        Boost(),
        "R",
        (20.0, 200.0),
        ends=(OVER, "'empty'"),
        marks=[],
        border=(20.0, 80.0),
        within=1e-2,
    ),
    "boost, light load": lambda: Case(
        Boost(R=150.0, v_guess=24.0),
        "R",
        (20.0, 200.0),
        ends=("'empty'", OVER),
        marks=[],
        border=(80.0, 200.0),
        within=1e-2,
    ),
    "wheel": lambda: Case(
        m.RimlessWheel(),
        "slope",
        (0.01, 0.3),
        {"section": hj.AtEvent("impact")},
        ends=(_REST, OVER),
        marks=[],
        border=(_shallowest(m.RimlessWheel().alpha), 0.3),
        within=1e-5,
        exact=lambda c: (
            float(c.trajectory().events[0].after["w"]),
            float(c.system.exact()[0]),
        ),
    ),
    "compass gait": lambda: Case(
        m.CompassGait(),
        "slope",
        tuple(np.deg2rad([1.0, 6.0])),
        {"section": hj.AtEvent("heelstrike")},
        marks=[("flip", np.deg2rad(4.37))],
        within=5e-3,
    ),
    "simplest walker": lambda: Case(
        m.SimplestWalker(),
        "slope",
        (0.002, 0.03),
        {"section": hj.AtEvent("heelstrike")},
        marks=[("flip", 0.0151)],
        within=5e-3,
    ),
    "two hoppers": lambda: Case(m.HopperPair(), "coupling", (0.3, 3.0)),
    "hopper, damping": lambda: Case(
        m.VerticalHopper(), "b", (2.0, 12.0), ends=("come to the same time", OVER)
    ),
    "hopper, stiffness": lambda: Case(m.VerticalHopper(), "k", (5.0, 20.0)),
    "impact oscillator": lambda: Case(
        ImpactOscillator(),
        "rate",
        (0.9, 1.8),
        ends=("grazing", "grazing"),
        marks=[("fold", np.nan)],
        border=(np.nan, np.sqrt(1.99)),
        within=1e-3,
    ),
    "integrate and fire": lambda: Case(
        IntegrateAndFire(),
        "a",
        (0.2, 1.5),
        ends=("grazing", OVER),
        marks=[("fold", _spike_margin())],
    ),
    "Schmitt trigger": lambda: Case(
        SchmittTrigger(),
        "width",
        (0.3, 0.4),
        ends=(OVER, OVER),
        marks=[("fold", _widest())],
        border=(0.3, 0.3),
    ),
}
