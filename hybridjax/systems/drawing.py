"""`Drawing`: what a system looks like in one state, for animations. It has shapes by name, without
matplotlib.

`HybridSystem.draw` returns it. `plot/pictures.py` evaluates it for many states, and
`plot/motion.py` draws it for `hj.plot.animate`. A further kind of shape is a field made by
`_shapes` here, and a loop in `_picture` of `plot/motion.py`. Rows of a shape must begin with (x,
y): pictures are moved by these.

If a drawing is refused, look at `_array` and `_shapes`; if a picture jumps at events or stands
still, at `body` and `velocity`, which `plot/pictures.py` uses to place it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._core.boundary.values import show
from ..errors import DefinitionError


def _array(name: str, value: Any, shape: tuple[int | None, ...]) -> Any:
    """An array of numbers of this shape; `None` stands for any length.

    **Raises:** `DefinitionError` for something else.
    """
    try:
        array = jnp.asarray(value, float)
    except (TypeError, ValueError):
        raise DefinitionError(
            f"Drawing: '{name}' must be numbers in an array, not {show(value)}."
        ) from None
    pairs = zip(shape, array.shape, strict=False)
    fits = [n in (None, m) for n, m in pairs]
    if array.ndim != len(shape) or not all(fits):
        text = str(shape).replace("None", "k")
        raise DefinitionError(
            f"Drawing: '{name}' must have the shape {text}, not {array.shape}."
        )
    return array


def _shapes(*shape: int | None, **options: Any) -> Any:
    """A field of arrays by name, each of this shape (as in `_array`)."""

    def arrays(shapes: Mapping[str, Any]) -> dict[str, Any]:
        named = isinstance(shapes, Mapping) and all(isinstance(x, str) for x in shapes)
        if not named:
            raise DefinitionError(
                f"Drawing: shapes must be a dictionary of arrays by name, not {show(shapes)}."
            )
        return {name: _array(name, x, shape) for name, x in shapes.items()}

    return eqx.field(converter=arrays, default_factory=dict, **options)


def _velocity(value: ArrayLike | Sequence[ArrayLike]) -> Any:
    return _array("velocity", value, (2,))


class Drawing(eqx.Module):
    """A system seen from the side in one state, as `HybridSystem.draw` returns it.

    ```python
    def draw(self, chart, t, q):
        leg = hj.systems.Drawing.spring((0.0, q["foot"]), (0.0, q["body"]))
        return hj.systems.Drawing({"ground": [(-1.0, 0.0), (1.0, 0.0)], "leg": leg},
                          circles={"body": (0.0, q["body"], 0.2)})
    ```

    **Fields**, in meters:

    - `lines`: points (k, 2) that are joined, by name. The line `ground` is drawn to the borders of
        the picture.
    - `circles`: (x, y, radius) by name. `points`: (x, y) by name, drawn as dots.
    - `body`: the name of a circle or a point that no event moves. An event may move the origin of
        the coordinates (to the other foot): the picture is then moved such that the body stays
        where it was. Default: the origin stays.
    - `velocity`: that of the origin over the ground, (2,), in charts whose states hold no position
        along the ground. Default: 0.

    **Raises:** `DefinitionError` for other shapes, or a `body` that has no place.
    """

    lines: Mapping[str, Any] = _shapes(None, 2)
    circles: Mapping[str, Any] = _shapes(3, kw_only=True)
    points: Mapping[str, Any] = _shapes(2, kw_only=True)
    body: str | None = eqx.field(static=True, default=None, kw_only=True)
    velocity: Any = eqx.field(converter=_velocity, default=(0.0, 0.0), kw_only=True)

    def __check_init__(self):
        places = [*self.circles, *self.points]
        if self.body is not None and self.body not in places:
            raise DefinitionError(
                f"Drawing: `body` must be a circle or point, not {show(self.body)}."
            )

    @property
    def place(self) -> Float[Array, "2"]:
        """The position of the body; the origin without one."""
        if self.body is None:
            return 0 * self.velocity
        places = {**self.points, **self.circles}
        return places[self.body][:2]

    @staticmethod
    def spring(
        start: ArrayLike | Sequence[ArrayLike],
        end: ArrayLike | Sequence[ArrayLike],
        width: ArrayLike = 0.08,
    ) -> Float[Array, "15 2"]:
        """The points of a zigzag line of this half width, in meters. Default: 0.08.

        **Raises:** `DefinitionError` for ends that are no points of the plane.
        """
        a = _array("start", start, (2,))
        b = _array("end", end, (2,))
        width = _array("width", width, ())
        along = b - a
        # (`hypot` takes longer to compile.)
        length = jnp.sqrt(jnp.maximum(along @ along, 1e-18))
        normal = jnp.stack([-along[1], along[0]])
        across = width * normal / length
        part = np.array([0.0, *np.linspace(0.15, 0.85, 13), 1.0])
        side = np.zeros(15)
        side[2:13:2] = 1.0
        side[3:13:2] = -1.0
        sideways = side[:, None] * across
        return a + part[:, None] * along + sideways
