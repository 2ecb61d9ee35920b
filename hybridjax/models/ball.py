"""A ball that bounces on fixed ground: one chart, one event."""

from ..systems.chart import Chart
from ..systems.system import HybridSystem, Parameter, parameter
from ..systems.transition import Transition


class Fall(Chart):
    states = ("y", "v")
    units = ("m", "m/s")
    ball: "BouncingBall"

    def field(self, t, q, u):
        return q[1], u[0] - self.ball.g


class BouncingBall(HybridSystem):
    """A ball under gravity that keeps the share `restitution` of its speed at each bounce.

    Input `u` is an acceleration. With a restitution below 1 the bounces accumulate in finite time
    (Zeno), and the ball has no cycle but rest.
    """

    input_units = ("m/s^2",)
    time_unit = "s"

    g: Parameter = parameter(9.81, unit="m/s^2", doc="gravity")
    restitution: Parameter = parameter(0.7, doc="speed kept at a bounce")

    def charts(self):
        return {"fall": Fall(self)}

    def transitions(self):
        return (
            Transition(
                "bounce",
                "fall",
                "fall",
                guard=lambda t, q, u: q[0],
                reset=lambda t, q, u: (0.0, -self.restitution * q[1]),
            ),
        )
