"""A passive walker with knees."""

import jax.numpy as jnp
import numpy as np

import hybridjax as hj
from hybridjax.models.bipeds import chain, tips
from hybridjax.systems.chart import FieldChart


class KneedWalker(hj.HybridSystem):
    """Angles of the stance leg, which is straight, of the swing thigh and of the swing shank, which
    locks at the kneestrike; the input is a torque at the hip.

    V. F. H. Chen, Passive dynamic walking with knees: a point foot model, MIT, 2007.
    """

    slope: float = 0.0504

    def mechanism(self):
        arms = [
            (0.375, 0, 0),
            (0.675, 0, 0),
            (1, 0, 0),
            (1, -0.325, 0),
            (1, -0.5, -0.125),
        ]
        return chain(
            np.array(arms), np.array([0.05, 0.5, 0.5, 0.5, 0.05]), 0.0, 9.81, {}
        )

    def charts(self):
        torque = jnp.array([1.0, -1.0, 0.0])
        free, locked = (
            self.mechanism(),
            self.mechanism().along(lambda p: p[jnp.array([0, 1, 1])]),
        )
        bent = lambda t, q, u: (*q[3:], *free.acceleration(q[:3], q[3:], u[0] * torque))  # noqa: E731

        def straight(t, q, u):
            return (
                *q[2:],
                *locked.acceleration(q[:2], q[2:], u[0] * torque[:2]),
            )

        angles, rates = ("stance", "thigh", "shank"), ("v_stance", "v_thigh", "v_shank")
        return {
            "free": FieldChart(bent, angles + rates),
            "locked": FieldChart(straight, angles[:2] + rates[:2]),
        }

    def transitions(self):
        bend = lambda q: q[1:2] - q[2:3]  # noqa: E731

        def kneestrike(t, q, u):
            after = self.mechanism().impact(q[:3], q[3:], bend).velocity
            return (*q[:2], *after[:2])

        def heelstrike(t, q, u):
            contact = lambda q: jnp.concatenate([foot(q), bend(q)])  # noqa: E731
            foot = lambda q: q[3:] + tips(np.array([[1.0, -0.5, -0.5]]), q[:3])[:, 0]  # noqa: E731
            q, v = (jnp.array([x[0], x[1], x[1], 0.0, 0.0]) for x in (q[:2], q[2:]))
            after = self.mechanism().impact(q, v, contact).velocity
            return q[1], q[0], q[0], after[1], after[0], after[0]

        landing = lambda t, q, u: 2 * self.slope - q[0] - q[1]  # noqa: E731
        return (
            hj.Transition(
                "kneestrike",
                "free",
                "locked",
                lambda t, q, u: bend(q)[0],
                "rising",
                kneestrike,
            ),
            hj.Transition(
                "heelstrike",
                "locked",
                "free",
                landing,
                "falling",
                heelstrike,
                lambda t, q, u: q[0] > 0,
            ),
        )

    def guess(self):
        return hj.Guess("free", (-0.1877, 0.2884, 0.2884, 1.1014, 0.0399, 0.0399))
