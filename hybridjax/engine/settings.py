"""Accuracy and effort of the flow, and every default accuracy of the package.

`Settings` is the public class that users give to `simulate` and `find_limit_cycle`; `filled` puts a
default accuracy in. In each step, `search/attempt.py` asks `tolerance` for the error that the step
may have, in units of the states' magnitudes (`size`). The default accuracies may be changed here
only; results and times of all tests depend on them. If steps are too short or too long, look at
`tolerance` and at the magnitudes of the states (`size`), relative to which errors are judged.
"""

import functools as ft
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers, PositiveScalar, StepCount
from .._core.boundary.values import Reals
from .._core.executor import namespace
from .._core.precision import real
from .._core.text import fields
from ..errors import DefinitionError
from ..systems.solver import Solver, solvers
from ..systems.system import HybridSystem, integrated
from .arrays import AnyTimes, Array, States
from .runge_kutta import Step


# Default accuracies: the error that one step may have, relative to the magnitude of each state.
# With a ten times smaller error, there are about 1.4 times as many steps (the method has order 7).
SIMULATION = 1e-10
"""Single trajectories (`simulate`)."""
LIMIT_CYCLE = 1e-12
"""Limit cycles, and all that is linearized along them."""
SWEEP = 1e-9
"""Many limit cycles at once (`find_limit_cycles`)."""
TRANSIENT = 1e-6
"""Flows that have no effect on results: the flow to the section, and the first iterations of
Newton's method."""

# Accuracies of data: the error at every section, accumulated since the start of an experiment,
# relative to the size of each state on the limit cycle.
EXPERIMENT = 1e-9
"""Experiments and response functions."""


# Rounding errors of a time or a state, relative to it. Higher: separate events are taken for
# simultaneous ones. Lower: an event happens again by rounding.
ROUNDING = 4e-15


@checked
class Settings(eqx.Module):
    """Accuracy, largest number of steps and method of integration of the flow.

    The estimated error of a step in state k of chart a is at most
    `rtol * |q[k]| + atol * scale[a, k]`. Defaults of `rtol` and `atol` are those of the call.

    **Example:**

    ```python
    settings = hj.orbits.Settings(rtol=1e-8, atol=1e-8)
    print(hj.find_limit_cycle(hopper, settings=settings).residual)
    ```

    **After:** `hj.find_limit_cycle`, `hj.simulate`.
    """

    rtol: Float[Array, ""] | None
    """Error of a step relative to the size of each state."""
    atol: Float[Array, ""] | None
    """Error of a step relative to each state's `scale`."""
    max_steps: int = eqx.field(static=True)
    """Largest number of steps, accepted or rejected, in one piece of flow. If
    the default, 256, ends a search for a limit cycle, the search is repeated with 4096."""
    scale: Float[Array, "A d"] | None
    """Characteristic magnitudes of states, by chart, padded with positive numbers to the largest
    dimension. `None`: magnitudes in the current step."""
    solver: Any = eqx.field(static=True)
    """Method for the charts, which overrides that of the system: a Runge-Kutta method of diffrax
    with an error estimate, `hj.systems.Radau()`, a mapping from names of charts to methods, or
    "auto" (in `find_limit_cycle`), an implicit method in charts that are stiff on the cycle."""

    def __repr__(self):
        unset = [name for name in ("rtol", "atol") if getattr(self, name) is None]
        text = fields(self)
        if not unset:
            return text
        names = " and ".join(unset)
        default = f"default {names} of each call, {LIMIT_CYCLE} in find_limit_cycle"
        return f"{text[:-1]}; {default})"

    # (`rtol`, `atol` and `scale` may have lanes on a last axis of their own: see `PerLane`.)

    def __init__(
        self,
        rtol: PositiveScalar | None = None,
        atol: PositiveScalar | None = None,
        max_steps: StepCount = 256,
        scale: Annotated[Numbers, Reals("charts states", sign="nonnegative")]
        | None = None,
        solver: Solver | Mapping[str, Solver] | Literal["auto"] | None = None,
    ):
        self.rtol = _kept(rtol)
        self.atol = _kept(atol)
        self.scale = _kept(scale)
        self.max_steps = max_steps
        self.solver = solver if isinstance(solver, str) else solvers(solver)

    def filled(self, accuracy: float) -> "Settings":
        """Return the settings, with this accuracy for each tolerance that is None."""
        rtol, atol = (accuracy if x is None else x for x in (self.rtol, self.atol))
        return Settings(rtol, atol, self.max_steps, self.scale)

    def system(self, system: HybridSystem) -> HybridSystem:
        """The system, integrated by the solver that is asked for.

        **Raises:** `DefinitionError` for "auto".
        """
        if self.solver == "auto":
            raise DefinitionError(
                '`solver="auto"` is for `find_limit_cycle`: name one here, such as '
                "`hj.systems.Radau()`."
            )
        return system if self.solver is None else integrated(system, self.solver)


def _kept(x: Any) -> Any:
    """Arrays of the host unchanged, other numbers as arrays of JAX."""
    return (
        x
        if x is None or (isinstance(x, np.ndarray) and x.dtype == np.float64)
        else real(x)
    )


def size(settings: Settings, a: int, *q: States) -> States:
    """Magnitudes of states of chart a, relative to which errors are judged: the largest modulus
    among `q`, plus `atol / rtol` times the magnitude in `settings.scale`.

    If `settings.scale` is None, a state that is zero gets the magnitude of the largest state. If
    all states are zero, they get 1.
    """
    xp = namespace(q[0])
    largest = ft.reduce(xp.maximum, map(xp.abs, q))
    if settings.scale is None:
        most = xp.max(largest, axis=0, initial=0.0)
        most = xp.where(most > 0, most, 1.0)
        return xp.where(largest > 0, largest, most)
    assert settings.rtol is not None
    scale = settings.scale[a, : len(largest)]
    usual = scale.reshape(len(largest), -1)
    return largest + settings.atol / settings.rtol * usual


def tolerance(
    settings: Settings, a: int, q: States, tau: AnyTimes, step: Step, rounding: States
) -> States:
    """The error that a step over tau from states `q` of chart a may have.

    If `settings.scale` is None, the magnitude of a state is the largest of three: at both ends of
    the step, and where its rate at the start would lead. Rounding errors are added: of the state,
    and the `rounding` errors of its rate.
    """
    if settings.scale is not None:
        return settings.rtol * size(settings, a, q, step.q)
    xp = namespace(q)
    largest = xp.maximum(xp.abs(q), xp.abs(step.q))
    change = xp.abs(tau) * xp.abs(
        step.f0
    )  # (a step that is far too long may end anywhere)
    # Rounding errors of the rate may be ten times as large at the stages as at the start.
    rounding = ROUNDING * largest + 10.0 * xp.abs(tau) * rounding
    allowed = (
        settings.rtol * largest + settings.atol * xp.maximum(largest, change) + rounding
    )
    return xp.maximum(
        allowed, xp.finfo(largest.dtype).tiny
    )  # where all is at rest at zero
