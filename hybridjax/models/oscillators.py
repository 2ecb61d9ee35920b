"""Oscillators: clocked and autonomous, smooth and piecewise smooth.

Each class is one system and cites its source; where its equation is short, it stands in the
docstring. Examples and tests rely on the default parameters and guesses. A further oscillator is
one more class, with its name in `models/__init__.pyi`.

If one has no cycle, look at its guess first. If a motion or a multiplier is wrong, look at the
field in `charts`. Two have several charts: if the chart is wrong, look at `BeltOscillator._parts`,
or at the directions in `ChuaCircuit.transitions`.
"""

import jax.numpy as jnp
from jaxtyping import Array

from ..systems.chart import FieldChart
from ..systems.drawing import Drawing
from ..systems.surfaces import FilippovParts, filippov
from ..systems.system import Guess, HybridSystem, Parameter, parameter
from ..systems.transition import Transition


def _block(
    x: Array, reach: Parameter | float, speed: Parameter | float = 0.0
) -> Drawing:
    """A block at x on a spring, whose rest length is twice the `reach`, above a ground that moves
    with this speed."""
    half = 0.25 * reach
    wall = -2 * reach
    corners = (-1, 0), (-1, 2), (1, 2), (1, 0), (-1, 0)
    lines = {
        "ground": [(wall, 0.0), (-wall, 0.0)],
        "block": [(x + a * half, b * half) for a, b in corners],
        "wall": [(wall, 0.0), (wall, reach)],
        "spring": Drawing.spring((wall, half), (x - half, half), 0.4 * half),
    }
    return Drawing(lines, velocity=(-speed, 0.0))


class Duffing(HybridSystem):
    """x'' + delta x' + alpha x + beta x^3 = gamma cos(omega t) + u, smooth and clocked.

    With a hardening spring (beta > 0) the resonance leans over to higher frequencies: at each
    driving frequency `rate` (omega) between two folds there are three responses, the middle one
    unstable.

    G. Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz, Vieweg 1918; A. H. Nayfeh,
    D. T. Mook, Nonlinear oscillations, Wiley 1979, Sec. 4.1.
    """

    input_units = ("m/s^2",)
    time_unit = "s"

    alpha: Parameter = parameter(1.0, unit="1/s^2", doc="linear stiffness")
    beta: Parameter = parameter(0.05, unit="1/(m^2 s^2)", doc="cubic stiffness")
    damping: Parameter = parameter(0.1, unit="1/s", doc="delta")
    amplitude: Parameter = parameter(0.5, unit="m/s^2", doc="gamma, of the force")
    rate: Parameter = parameter(0.5, unit="rad/s", doc="omega, of the force")

    def charts(self):
        return {"line": FieldChart(self._line, ("x", "v"), ("m", "m/s"))}

    def _line(self, t, q, u):
        x, v = q
        force = self.amplitude * jnp.cos(self.rate * t) + u[0]
        spring = force - self.damping * v - self.alpha * x
        return v, spring - self.beta * x**3

    def period(self):
        return 2 * jnp.pi / self.rate

    def draw(self, chart, t, q):
        return _block(q["x"], self.amplitude)

    def guess(self):
        """The response of the linear oscillator, far from resonance."""
        return Guess("line", (self.amplitude / (self.alpha - self.rate**2), 0.0))


class Mathieu(HybridSystem):
    """x'' + 2 c x' + (delta + epsilon cos t) x = u, with the period 2 pi; its cycle is the
    equilibrium x = 0.

    At delta = 0.25, epsilon = 0.1 both multipliers are negative: no real N-th root of the monodromy
    matrix exists, and the argument of a multiplier does not determine the number of revolutions of
    a deviation.

    A. H. Nayfeh, D. T. Mook, Nonlinear oscillations, Wiley 1979, Ch. 5.
    """

    delta: Parameter = parameter(1.0, doc="stiffness")
    epsilon: Parameter = parameter(0.4, doc="amplitude of the stiffness's oscillation")
    damping: Parameter = parameter(0.1, doc="c")

    def charts(self):
        return {"line": FieldChart(self._line, ("x", "v"))}

    def _line(self, t, q, u):
        x, v = q
        return v, u[0] - 2 * self.damping * v - (
            self.delta + self.epsilon * jnp.cos(t)
        ) * x

    def period(self):
        return jnp.asarray(2 * jnp.pi)

    def guess(self):
        return Guess("line", (0.0, 0.0))


class RotorFlap(HybridSystem):
    """The flapping angle `b` of a rigid blade; time in radians of its rotation.

    Input `u` is a flapping moment, such as one due to pitch, divided by the moment of inertia.

    D. A. Peters, K. H. Hohenemser, Application of the Floquet transition matrix to problems of
    lifting rotor stability, J. American Helicopter Society 16(2), 1971; here without the region of
    reversed flow.
    """

    lock: Parameter = parameter(
        12.0, doc="Lock number, aerodynamic over inertial forces"
    )
    p: Parameter = parameter(1.0, doc="natural frequency over the rotor's")
    mu: Parameter = parameter(0.3, doc="advance ratio")

    def charts(self):
        return {"blade": FieldChart(self._blade, ("b", "vb"), ("rad", ""))}

    def _blade(self, t, q, u):
        b, vb = q
        lock = self.lock / 8
        mu = self.mu
        damping = lock * (1 + 4 / 3 * mu * jnp.sin(t))
        stiffness = self.p**2 + lock * (
            4 / 3 * mu * jnp.cos(t) + mu**2 * jnp.sin(2 * t)
        )
        return vb, u[0] - damping * vb - stiffness * b

    def period(self):
        return jnp.asarray(2 * jnp.pi)

    def guess(self):
        return Guess("blade", (0.0, 0.0))


class HopfOscillator(HybridSystem):
    """A smooth oscillator with a circular cycle of radius sqrt(mu) and multiplier exp(-2 mu T).

    Input `u` is added to the rate of x.

    J. Guckenheimer, P. Holmes, Nonlinear oscillations, dynamical systems, and bifurcations of
    vector fields, Springer 1983, Sec. 3.4.
    """

    time_unit = "s"

    mu: Parameter = parameter(0.1, unit="1/s", doc="growth rate at the origin")
    T: Parameter = parameter(1.0, unit="s", doc="period")

    def charts(self):
        return {"plane": FieldChart(self._plane, ("x", "y"))}

    def _plane(self, t, q, u):
        x, y = q
        growth = self.mu - x**2 - y**2
        rate = 2 * jnp.pi / self.T
        x_rate = growth * x - rate * y + u[0]
        y_rate = rate * x + growth * y
        return x_rate, y_rate

    def guess(self):
        return Guess("plane", (1.1 * jnp.sqrt(self.mu), 0.0))


class VanDerPol(HybridSystem):
    """x'' = mu (1 - x^2) x' - x + u, with an attracting cycle for mu > 0.

    B. van der Pol, On relaxation-oscillations, Phil. Mag. 2 (1926).
    """

    mu: Parameter = parameter(1.0, doc="strength of the nonlinear damping")

    def charts(self):
        return {"oscillation": FieldChart(self._plane, ("x", "v"))}

    def _plane(self, t, q, u):
        x, v = q
        damping = self.mu * (1 - x**2) * v
        return v, damping - x + u[0]

    def guess(self):
        return Guess("oscillation", (2.0, 0.0))


class BeltOscillator(HybridSystem):
    """A block on a spring, carried along by a belt until the spring tears it off.

    States: extension `x` of the spring and speed `v`. Dry friction decreases with the speed
    relative to the belt. On the belt (chart "sticks") both sides push towards the same speed
    (`hj.systems.filippov`). After sticking, the block always leaves the belt at x = friction / k,
    so that all multipliers are zero. Input `u` is a force.

    R. I. Leine, D. H. van Campen, A. de Kraker, L. van den Steen, Stick-slip vibrations induced by
    alternate friction models, Nonlinear Dynamics 16, 1998.
    """

    input_units = ("N",)
    time_unit = "s"

    m: Parameter = parameter(1.0, unit="kg", positive=True, doc="mass")
    k: Parameter = parameter(1.0, unit="N/m", doc="stiffness")
    belt: Parameter = parameter(0.2, unit="m/s", doc="speed of the belt")
    friction: Parameter = parameter(
        1.0, unit="N", doc="friction of a block that begins to slip"
    )
    decay: Parameter = parameter(
        3.0, unit="s/m", doc="how fast friction decreases with the speed"
    )

    def charts(self):
        return self._parts().charts

    def transitions(self):
        return self._parts().transitions

    def _parts(self) -> FilippovParts:
        sides = {"ahead": self._slips(1.0), "behind": self._slips(-1.0)}
        return filippov(sides, lambda t, q: q[1] - self.belt, "sticks")

    def _slips(self, side: float) -> FieldChart:
        def field(t, q, u):
            friction = self.friction / (1 + self.decay * side * (q[1] - self.belt))
            spring = self.k * q[0]
            force = u[0] - spring - side * friction
            return q[1], force / self.m

        return FieldChart(field, ("x", "v"), ("m", "m/s"))

    def draw(self, chart, t, q):
        return _block(q["x"], self.friction / self.k, self.belt)

    def guess(self):
        stretch = 0.5 * self.friction / self.k
        return Guess("sticks", jnp.stack([stretch, self.belt]))


class ChuaCircuit(HybridSystem):
    """x' = alpha (y - h(x)) + u, y' = x - y + z, z' = -beta y, with a resistor h of slope `inner`
    where |x| < 1 (chart "middle"), and `outer` beyond (charts "left" and "right").

    The field is continuous across x = 1 and x = -1; its derivative jumps. States: voltages `x` and
    `y` of both capacitors, and current `z` of the coil, without dimensions.

    T. Matsumoto, L. O. Chua, M. Komuro, The double scroll, IEEE Trans. Circuits and
    Systems 32, 1985, the source of this dimensionless form. Their double scroll is at
    alpha = 9. At alpha = 8, where periods have not yet doubled, there are two cycles,
    one around each of two equilibria.
    """

    alpha: Parameter = parameter(8.0, doc="ratio of the capacitors")
    beta: Parameter = parameter(100 / 7, doc="of a capacitor to the coil")
    inner: Parameter = parameter(-1 / 7, doc="slope of h for small voltages")
    outer: Parameter = parameter(2 / 7, doc="the same for large ones")

    def charts(self):
        sides = {"left": -1.0, "middle": 0.0, "right": 1.0}
        return {name: self._slab(side) for name, side in sides.items()}

    def _slab(self, side: float) -> FieldChart:
        def field(t, q, u):
            x, y, z = q
            if side:
                resistor = self.outer * (x - side) + self.inner * side
            else:
                resistor = self.inner * x
            x_rate = self.alpha * (y - resistor) + u[0]
            y_rate = x - y + z
            return x_rate, y_rate, -self.beta * y

        return FieldChart(field, ("x", "y", "z"))

    def transitions(self):
        right, left = (lambda t, q, u, x=x: q[0] - x for x in (1.0, -1.0))
        return (
            Transition("in from the right", "right", "middle", right),
            Transition("out to the right", "middle", "right", right, "rising"),
            Transition("in from the left", "left", "middle", left, "rising"),
            Transition("out to the left", "middle", "left", left),
        )

    def guess(self):
        return Guess("right", (2.1, 0.1, -3.0))
