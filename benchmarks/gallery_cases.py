"""The gallery: for each model a cycle, sections, an input, an output, and what is known of it.

Truths are from the closed forms that the models give as `exact`, or were computed apart from
hybridjax, by Newton on the return map with DOP853 (relative tolerance 1e-13, events polished on the
true guard), refined with a high-order integrator in mpmath (34 digits); Duffing's by scipy alone,
as in tests/orbits/test_continuation.py.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import hybridjax as hj


m = hj.models


class Case(NamedTuple):
    """One entry.

    `sections` are for linearization and experiments, `output` and `input` name what is measured
    and pushed, `amplitude` is that of each cosine of the design. `truth` are multipliers. An
    experiment begins in the predicted periodic response, or where there is none, on the cycle
    (`start`); where the amplitude is zero there are no experiments. A walker is drawn as `sticks`:
    lines from joint to joint, by the lengths that each has along each link, whose angles from the
    vertical are the first states.
    """

    title: str
    system: hj.HybridSystem
    sections: object
    output: str
    push: str
    amplitude: float
    truth: list[complex]
    source: str
    plane: tuple[str, str] | None
    section: object = None
    guess: hj.Guess | None = None
    multiplicity: int | None = None
    conserved: dict[str, float] | None = None
    start: str = "periodic"
    max_period: float | None = None
    sticks: tuple[list[list[float]], ...] = ()


def _pair(z: complex) -> list[complex]:
    return [z, z.conjugate()]


def _levels(event: str, state: str, direction: str, first: float, last: float) -> list:
    """The event's section, and seven levels of a state that is monotone between events."""
    levels = np.linspace(first, last, 7)
    return [
        hj.AtEvent(event),
        *(hj.Crossing(state, direction, value) for value in levels),
    ]


# Stance leg, swing leg and torso, from the stance foot on.
_HIP, _KNEES = [1, 0, 0], [0.4, 0.4, 0, 0, 0]
_TORSO_WALKER = ([[0, 0, 0], _HIP], [_HIP, [1, -1, 0]], [_HIP, [1, 0, 0.5]])
_BIPED = (
    [[0, 0, 0, 0, 0], [0.4, 0, 0, 0, 0], _KNEES],
    [_KNEES, [0.4, 0.4, 0, -0.4, 0], [0.4, 0.4, 0, -0.4, -0.4]],
    [_KNEES, [0.4, 0.4, 0.24, 0, 0]],
)
_APEX = hj.Crossing("vM", "falling")
_MPMATH = "mpmath"
_CLOSED = "closed form"
_BUCK = ("v", "i")
_STIFF = "scipy (Radau)"

CASES: dict[str, Callable[[], Case]] = {
    "hopper": lambda: Case(
        "vertical hopper",
        m.VerticalHopper(),
        hj.ClockPhase(32, anchor=_APEX),
        "yM",
        "force",
        5e-4,
        _pair(-0.248983334735609 + 0.699333251798004j),
        _MPMATH,
        ("yM", "vM"),
    ),
    "lossy hopper": lambda: Case(
        "vertical hopper, retention 0.8",
        m.VerticalHopper(retention=0.8),
        hj.ClockPhase(32, anchor=_APEX),
        "yM",
        "force",
        5e-4,
        _pair(-0.317897006349938 + 0.694628822735891j),
        _MPMATH,
        ("yM", "vM"),
    ),
    "compliant hopper": lambda: Case(
        "hopper on a compliant ground",
        m.CompliantHopper(),
        hj.ClockPhase(32, anchor=_APEX),
        "yM",
        "force",
        5e-4,
        [
            *_pair(-0.24885118328047069434 + 0.69922500780850327787j),
            1.6159409134125691e-4,
        ],
        _MPMATH,
        ("yM", "vM"),
    ),
    "two hoppers": lambda: Case(
        "two coupled hoppers",
        m.HopperPair(),
        hj.ClockPhase(16, anchor=0.5),
        "yM1",
        "both forces",
        5e-4,
        [
            *_pair(-0.439196992225001708 + 0.611321029449368104j),
            *_pair(-0.248558676124545596 + 0.697949554160020074j),
            2.05187165619280217e-9,
            1.16996080957107642e-15,
        ],
        _MPMATH,
        ("yM1", "yM2"),
    ),
    "bar": lambda: Case(
        "two-legged bar",
        m.TwoLeggedBar(),
        hj.ClockPhase(16),
        "y",
        "force",
        1e-4,
        [
            *_pair(-0.153520955429110 + 0.361043052961495j),
            *_pair(0.151655665357578 + 0.227749294883360j),
        ],
        _MPMATH,
        ("y", "v"),
    ),
    "trot": lambda: Case(
        "trotting quadruped",
        m.TrottingQuadruped(),
        hj.ClockPhase(16, anchor=0.1),
        "y",
        "force",
        0.0,
        [
            *_pair(-0.08768800113731487 + 0.4750481690903344j),
            *_pair(0.18391330048481577 + 0.35828647799688856j),
        ],
        "scipy",
        ("y", "v"),
    ),
    "wheel": lambda: Case(
        "rimless wheel",
        m.RimlessWheel(),
        _levels("impact", "th", "rising", -0.25, 0.4),
        "w",
        "hip torque",
        2e-4,
        [0.5],
        _CLOSED,
        ("th", "w"),
        section=hj.AtEvent("impact"),
    ),
    "long gait": lambda: Case(
        "simplest walker, long gait",
        m.SimplestWalker(),
        _levels("heelstrike", "th", "falling", 0.15, -0.15),
        "w",
        "hip torque",
        2e-6,
        _pair(-0.190099841065888 + 0.557598776682068j),
        _MPMATH,
        ("th", "w"),
        section=hj.AtEvent("heelstrike"),
    ),
    "short gait": lambda: Case(
        "simplest walker, short gait",
        m.SimplestWalker(),
        _levels("heelstrike", "th", "falling", 0.15, -0.15),
        "w",
        "hip torque",
        0.0,
        [4.00386435892970, 0.459589589797671],
        _MPMATH,
        ("th", "w"),
        section=hj.AtEvent("heelstrike"),
        guess=m.SimplestWalker().short_gait(),
    ),
    "compass gait": lambda: Case(
        "compass gait",
        m.CompassGait(),
        _levels("heelstrike", "s", "falling", 0.15, -0.25),
        "vs",
        "hip torque",
        1e-3,
        [*_pair(-0.199726126830030 + 0.544476062094737j), 0.131572624077177],
        _MPMATH,
        ("s", "vs"),
        section=hj.AtEvent("heelstrike"),
    ),
    "torso walker": lambda: Case(
        "three-link walker with torso",
        m.TorsoWalker(),
        _levels("touchdown", "th1", "rising", -0.3, 0.3),
        "w1",
        "hip torque",
        1e-2,
        [0.558921496182006, 2.129597704e-06, 5.85308700e-07, 4.9e-09, 0.0],
        "scipy",
        ("th1", "w1"),
        sticks=_TORSO_WALKER,
    ),
    "biped": lambda: Case(
        "five-link biped",
        m.FiveLinkBiped(),
        _levels("touchdown", "leg", "rising", -0.15, 0.15),
        "leg",
        "hip torque",
        1e-2,
        [
            0.9365565991540,
            0.2106146374910,
            0.01714336047405,
            *_pair(0.005638528689762 + 0.004702903938051j),
            0.004783922552855,
            0.001857583000819,
            0.001466407402454,
            4.28e-07,
        ],
        "scipy",
        ("shin", "swing_shin"),
        sticks=_BIPED,
    ),
    "SLIP": lambda: Case(
        "SLIP runner at 1784.8 J",
        m.SLIPRunner(),
        [
            hj.Crossing("vy", "falling", charts=("flight",)),
            hj.AtEvent("touchdown"),
            hj.Crossing("vy", "rising", charts=("stance",)),
            hj.AtEvent("liftoff"),
        ],
        "vx",
        "angle of attack",
        1e-4,
        [1.0, -0.161307631037475],
        _MPMATH,
        ("y", "vy"),
        section=hj.Crossing("vy", "falling"),
        conserved={"energy": 1784.8},
        start="cycle",
    ),
    "juggler": lambda: Case(
        "paddle juggler",
        m.PaddleJuggler(),
        [hj.AtEvent("impact"), hj.Crossing("v", "falling")],
        "y",
        "paddle speed",
        1e-5,
        _pair(0.399920196836063 + 0.574511824214789j),
        _CLOSED,
        ("y", "v"),
    ),
    "buck": lambda: Case(
        "buck converter, 20 V",
        m.BuckConverter(),
        hj.ClockPhase(8, anchor=0.06),
        "v",
        "reference voltage",
        1e-5,
        _pair(-0.691894155835222 + 0.447746968999235j),
        _MPMATH,
        _BUCK,
    ),
    "buck, period 2": lambda: Case(
        "buck converter, 25 V, period 2",
        m.BuckConverter(Vin=25.0),
        hj.ClockPhase(16, anchor=0.03),
        "v",
        "reference voltage",
        2e-6,
        _pair(0.613891423607179 + 0.290590765487630j),
        _MPMATH,
        _BUCK,
        guess=hj.Guess("open", (12.04, 0.627, 3.8)),
        multiplicity=2,
    ),
    "Cuk": lambda: Case(
        "Ćuk converter",
        m.CukConverter(),
        hj.ClockPhase(8, anchor=5e-6),
        "v2",
        "reference current",
        1e-5,
        [
            *_pair(0.847302228159268509 + 0.427350687398246989j),
            -0.694479389634475538,
            0.643345392432610566,
        ],
        _MPMATH,
        ("v2", "i2"),
    ),
    "Chua": lambda: Case(
        "Chua's circuit, alpha = 8",
        m.ChuaCircuit(),
        hj.KinematicPhase(
            16,
            position="x",
            velocity="z",
            center=(1.3, -1.5),
            scale=(0.9, 1.3),
            anchor=hj.Crossing("x", "falling", 1.5),
        ),
        "x",
        "added to x'",
        1e-4,
        [-0.677312642613658609, -0.0195673404468831832],
        _MPMATH,
        ("x", "z"),
        section=hj.AtEvent("in from the right"),
    ),
    "belt": lambda: Case(
        "block on a belt",
        m.BeltOscillator(),
        [
            hj.AtEvent("sticks to behind"),
            hj.Crossing("x", "falling", charts=("behind",)),
            hj.AtEvent("behind to sticks"),
            hj.Crossing("x", "rising", charts=("sticks",)),
        ],
        "x",
        "force",
        1e-4,
        [],
        _CLOSED,
        ("v", "x"),
        section=hj.AtEvent("sticks to behind"),
    ),
    "Izhikevich": lambda: Case(
        "Izhikevich's neuron",
        m.IzhikevichNeuron(),
        hj.ClockPhase(16),
        "w",
        "current",
        1e-3,
        [0.48958210923116263, -1.5695975926619675e-11],
        "heyoka",
        ("v", "w"),
    ),
    "AdEx": lambda: Case(
        "adaptive exponential neuron",
        m.AdExNeuron(),
        hj.ClockPhase(16),
        "w",
        "current",
        1e-2,
        [0.7474603512727481, 0.17911718353685366],
        "heyoka",
        ("v", "w"),
    ),
    "Hopf": lambda: Case(
        "Hopf normal form",
        m.HopfOscillator(),
        hj.KinematicPhase(
            16, position="x", velocity="y", anchor=hj.Crossing("y", "rising")
        ),
        "x",
        "added to x'",
        1e-4,
        [0.818730753077982],
        _CLOSED,
        ("x", "y"),
        section=hj.Crossing("y", "rising"),
    ),
    "van der Pol": lambda: Case(
        "van der Pol, mu = 1",
        m.VanDerPol(),
        hj.KinematicPhase(
            16, position="x", velocity="v", anchor=hj.Crossing("v", "falling")
        ),
        "x",
        "force",
        1e-3,
        [8.59695063603805e-4],
        _MPMATH,
        ("x", "v"),
        section=hj.Crossing("v", "falling"),
    ),
    "van der Pol, 3": lambda: Case(
        "van der Pol, mu = 3",
        m.VanDerPol(mu=3.0),
        hj.KinematicPhase(
            16, position="x", velocity="v", anchor=hj.Crossing("v", "falling")
        ),
        "x",
        "force",
        1e-3,
        [6.98947562607979e-16],
        _MPMATH,
        ("x", "v"),
        section=hj.Crossing("v", "falling"),
    ),
    "van der Pol, 100": lambda: Case(
        "van der Pol, mu = 100",
        m.VanDerPol(mu=100.0, solver=hj.systems.Radau()),
        [
            *(hj.Crossing("x", "falling", x) for x in (0.5, 0.0, -0.5)),
            *(hj.Crossing("x", "rising", x) for x in (-0.5, 0.0, 0.5)),
        ],
        "v",
        "force",
        0.0,
        [0.0],
        _STIFF,
        ("x", "v"),
        section=hj.Crossing("v", "falling"),
        max_period=500.0,
    ),
    "FitzHugh-Nagumo": lambda: Case(
        "FitzHugh-Nagumo, eps = 0.01",
        m.FitzHughNagumo(),
        hj.KinematicPhase(
            16,
            position="v",
            velocity="w",
            center=(0.0, 0.5),
            scale=(2.0, 0.6),
            anchor=hj.Crossing("v", "rising"),
        ),
        "v",
        "current",
        0.0,
        [1.9834880445450845e-134],
        _STIFF,
        ("v", "w"),
        section=hj.Crossing("v", "rising"),
    ),
    "rotor flap": lambda: Case(
        "rotor flap",
        m.RotorFlap(),
        hj.ClockPhase(16),
        "b",
        "moment",
        1e-2,
        [-0.0215994758114450, -0.00373617944596341],
        _MPMATH,
        None,
    ),
    "Mathieu": lambda: Case(
        "damped Mathieu (0.25, 0.1)",
        m.Mathieu(delta=0.25, epsilon=0.1),
        hj.ClockPhase(16),
        "x",
        "force",
        1e-2,
        [-0.728150761133001, -0.390866230632208],
        _MPMATH,
        None,
    ),
    "Duffing": lambda: Case(
        "Duffing, rate 0.5",
        m.Duffing(),
        hj.ClockPhase(16),
        "x",
        "force",
        1e-3,
        _pair(0.524688411200482 + 0.096496707135258j),
        "scipy",
        ("x", "v"),
    ),
}
