"""Pictures of a trajectory: what `HybridSystem.draw` draws, on the ground, as a camera sees it.

A model draws its body at an origin of its own, and says with each `Drawing` how fast this origin
moves (`velocity`) and where in the drawing the body is (`place`). Three vectors follow in time:

| | |
|---|---|
| `_origin` | where the origin is on the ground; at events it jumps such that the body stays |
| `camera(t)` | where the camera is: at constant velocity, by one `stride` in each period |
| their difference | by which each picture is shifted |

If pictures jump at events, look at `_origin_along`; if a body leaves the window, at `stride`. The
numbers of all drawings are computed by one program for each chart (`drawn`).
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.lanes import by_lane
from .._core.meaning import code_of
from ..engine.trajectory import Trajectory
from ..systems.check import evaluating
from ..systems.drawing import Drawing
from ..systems.structure import Structure
from ..systems.system import name_of


class Pictures:
    """The pictures of a trajectory, seen by a camera of constant velocity.

    The camera moves as far in a `period` as the body of the system does (of a trajectory without a
    period: in all of its time), so that the last picture of a cycle is followed by the first.
    """

    def __init__(self, trajectory: Trajectory, period: float = math.inf):
        self.trajectory = trajectory
        t, chart, q = trajectory.dense(6)
        drawings = drawn(trajectory.structure, t, chart, q)
        place = np.array([drawing.place for drawing in drawings])
        velocity = np.array([drawing.velocity for drawing in drawings])

        origin = _origin_along(t, place, velocity)
        length = t[-1] - t[0]
        self.period = min(period, length)
        # (The trajectory may be longer than a period.)
        moved_too_far = velocity[-1] * (length - self.period)
        self.stride = origin[-1] - moved_too_far
        if np.isinf(period):
            self.stride += place[-1] - place[0]
        self._t = t
        self._origin = origin
        self._velocity = velocity
        scenes = self._seen(t, origin, drawings)
        corners = np.vstack([_corners(x) for x in scenes])
        self.low = corners.min(axis=0)
        self.high = corners.max(axis=0)

    def at(self, t: Float[np.ndarray, " n"]) -> list[Drawing]:
        """The pictures at times of the trajectory."""
        chart, q = self.trajectory.at(t)
        drawings = drawn(self.trajectory.structure, t, chart, q)
        k = np.searchsorted(self._t, t, side="right") - 1
        since = t - self._t[k]
        moved = self._velocity[k] * since[:, None]
        return self._seen(t, self._origin[k] + moved, drawings)

    def camera(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """The places of the camera over the ground."""
        part = (t - self._t[0]) / self.period
        return part[:, None] * self.stride

    def _seen(self, t, origin, drawings: list[Drawing]) -> list[Drawing]:
        """The drawings as the camera sees them, with these origins on the ground."""
        return list(map(_shifted, drawings, origin - self.camera(t)))


def _origin_along(
    t: Float[np.ndarray, " n"],
    place: Float[np.ndarray, "n 2"],
    velocity: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n 2"]:
    """The origins of drawings on the ground: between events they move by their velocity, and at
    events (of no duration) such that the body stays."""
    durations = np.diff(t)[:, None]
    mean_velocity = (velocity[1:] + velocity[:-1]) / 2
    jumps = place[:-1] - place[1:]
    moves = np.where(durations == 0, jumps, mean_velocity * durations)
    return np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])


def _shifted(drawing: Drawing, shift: Float[np.ndarray, "2"]) -> Drawing:
    # (Circles are x, y and a radius, which stays.)
    way = np.append(shift, 0.0)
    return jax.tree_util.tree_map(lambda x: x + way[: x.shape[-1]], drawing)


def _corners(scene: Drawing) -> Float[np.ndarray, "k 2"]:
    """Places between which a picture lies, without its ground."""
    places = [line for name, line in scene.lines.items() if name != "ground"]
    for circle in scene.circles.values():
        center = circle[:2]
        radius = circle[2]
        places += [center - radius, center + radius]
    return np.vstack([*places, *scene.points.values()])


def drawn(
    s: Structure,
    t: Float[np.ndarray, " n"],
    chart: Int[np.ndarray, " n"],
    q: Float[np.ndarray, "n d"],
) -> list[Drawing]:
    """The drawings of states, on the host."""
    drawings: list[Any] = [None] * len(t)
    code = code_of(s.system)
    for a in np.unique(chart).tolist():
        rows = np.flatnonzero(chart == a)
        program = s.kernel(_flat, by_lane, a, code, lanes=4)
        states = q[rows, : s.dims[a]].T
        values = program(t[rows], states)
        for row, numbers in zip(rows, values.T, strict=True):
            drawings[row] = _drawing(drawing_of(s, a), numbers)
    return drawings


def _drawing(form: Any, numbers: Float[np.ndarray, " n"]) -> Any:
    """The drawing of this form with these numbers, which `_flat` has put one after the other."""
    shapes, structure = jax.tree_util.tree_flatten(form)
    arrays = []
    begin = 0
    for shape in shapes:
        end = begin + shape.size
        arrays.append(numbers[begin:end].reshape(shape.shape))
        begin = end
    return jax.tree_util.tree_unflatten(structure, arrays)


def drawing_of(s: Structure, a: int) -> Any:
    """The shapes of the drawings in chart a, or `None` if the system has none.

    **Raises:** `DefinitionError` if the system's `draw` raises an error.
    """
    time = jax.ShapeDtypeStruct((), float)
    state = jax.ShapeDtypeStruct((s.dims[a],), float)

    def shapes():
        return jax.eval_shape(lambda t, q: s.drawing(a, t, q), time, state)

    with evaluating(f"method `draw(self, chart, t, q)` of {name_of(s.system)}"):
        return s.once(("drawing", a), (), shapes)


def _flat(a: int, code: str, s: Structure, t, q):
    shapes = jax.tree_util.tree_leaves(s.drawing(a, t, q))
    return jnp.concatenate([jnp.ravel(x) for x in shapes])
