"""A small picture of a limit cycle, for notebooks; `hj.plot.cycle` draws a large one."""

import numpy as np
from jaxtyping import Float, Int

from .._core.html import COLORS, Curve, picture, thinned
from .._core.signal import unit_of, with_unit
from ..engine.trajectory import Trajectory
from ..systems.structure import Structure


def orbit_picture(
    orbit: Trajectory,
    sections: tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"], Float[np.ndarray, "N d"]]
    | None = None,
) -> str:
    """An SVG, in the plane of the first two states that every chart has, or of time and the only
    one; "" where there is no such state.

    **Arguments:** `sections`: times, charts and states at which the orbit meets some, as of
    `Trajectory.dense`.
    """
    s, turn = Structure(orbit.system), orbit.dense()
    names = [x for x in s.state_names() if all(x in c.states for c in s.charts)][:2]
    if not names:
        return ""

    def seen(t, chart, q):
        columns = [np.array([s.charts[a].states.index(x) for a in chart]) for x in names]
        values = [np.take_along_axis(q, c[:, None], axis=1)[:, 0] for c in columns]
        return values if len(names) == 2 else [t, *values]

    (t, chart, _), (x, y) = turn, seen(*turn)
    cuts = np.flatnonzero((np.diff(t) == 0) | (np.diff(chart) != 0)) + 1
    named: set[int] = set()
    curves = []
    for k in np.split(np.arange(len(t)), cuts):
        a = int(chart[k[0]])
        name = s.names[a] if len(s.names) > 1 and a not in named else ""
        named.add(a)
        k = k[thinned(len(k), len(k) / len(t))]
        curves.append(Curve(x[k], y[k], name, COLORS[a % len(COLORS)]))
    if sections is not None:
        curves.append(Curve(*seen(*sections), color="currentColor", points=True))
    labels = [with_unit(x, unit_of(x)) for x in names]
    if len(names) == 1:
        labels.insert(0, with_unit("t", orbit.system.time_unit))
    return picture(curves, *labels)
