"""Data to which systems are fitted. Each type converts a limit cycle to weighted residuals.

`fit_model` calls `prepare` once, outside of JAX, for checks; then `residuals(cycle)` at each point
of the parameters, under JAX transformations. A further type of data is a subclass of
`AbstractObservation`; if its residuals need a search for events, it is also named in `_can_repeat`
(`beside.py`). Residuals must stay prediction minus measurement, always equally many, and
differentiable in forward mode.

A fit that is biased for one type of data has its cause in the `residuals` of this type. If data
weigh too much, look at `_scale`, and for HTFs at `error_weights`; if times are wrong by whole
periods, at `_without_turns`; if data are refused, at `__init__` and `prepare` of their type.
"""

import abc
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float
from scipy.linalg import helmert

from .._core.arguments import Numbers, require_axes, require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import OptionalNames, PositiveScalar
from .._core.boundary.values import Reals
from .._core.text import fields
from ..engine.settings import Settings
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..experiments.plan import Plan
from ..experiments.record import require_deviations
from ..experiments.response import Course, flow_batch, response_function
from ..identify.weights import check_values, error_weights, largest_misfit
from ..linear.htf import HTF
from ..orbits.cycle import LimitCycle
from ..orbits.linear_flow import last_turn
from ..sections.families import AbstractSections, FamilyLike, as_family
from ..sections.linearization import Delayed, Delays, linearize
from ..sections.place import observed_at, place_sections


Deviations = Annotated[Numbers, Reals("...", sign="positive")]


class AbstractObservation(eqx.Module):
    """A measurement, for `fit_model`. Subclass it for data of other types.

    **Fields:** `weighted`: whether residuals are in units of their standard deviations, as an array
    (fields that are arrays may change without another compilation). Residuals should be
    dimensionless: where there are no standard deviations, divide by the size of the measured
    values.

    The example observes multipliers by the coefficients of their polynomial, because multipliers
    have no derivative where two of them coincide:

    ```python
    class ObservedMultipliers(hj.fitting.AbstractObservation):
        measured: Array  # numpy.poly(multipliers)[1:]
        sections: hj.ClockPhase
        weighted: Array

        def residuals(self, cycle):
            polynomial = hj.linearize(cycle, self.sections).characteristic_polynomial()
            return polynomial[1 : 1 + len(self.measured)] - self.measured
    ```
    """

    weighted: eqx.AbstractVar[Bool[Array, ""]]

    @abc.abstractmethod
    def residuals(self, cycle: LimitCycle) -> Float[Array, " r"]:
        """Return the prediction from this limit cycle minus the measurement, weighted.

        The method is called under JAX transformations and differentiated in forward mode, once. The
        parameters of `cycle.system`, `period`, `anchor`, and the results of `linearize` and
        `place_sections` have derivatives with respect to the free parameters. `cycle.pieces` and
        `cycle.factors` are NaN, because computing them would triple the compile time. Functions
        that need concrete values raise an error, such as `cycle.multipliers`. Linearize the cycle
        instead: `model = hj.linearize(cycle, sections)`, then `model.characteristic_polynomial()`
        or `hj.fitting.spectral_radius(model)`.

        Return NaN or infinity where the system cannot produce the measurement. The fit then takes a
        shorter step, or gives up a guess at which this happens.
        """

    def prepare(self, cycle: LimitCycle) -> "AbstractObservation":
        """Return the observation for a fit that starts from this limit cycle.

        Called once, for checks and for computations outside of JAX transformations.
        """
        return self

    __repr__ = fields


@checked
class ObservedHTF(AbstractObservation):
    r"""Harmonic transfer functions, exact or estimated.

    Residuals are real and imaginary parts of $H^{model}_m(f) - H_m(f)$, in units of their standard
    deviations $\sqrt{v/2}$ where the HTFs have variances v, otherwise relative to the rms of each
    output's HTFs over all inputs. In the second case, choose units in which the inputs have effects
    of similar magnitude.

    With `delay`, a pair, inputs act later, and outputs are measured later. `fit_model` fits these
    delays if `free` contains "input_delay" or "output_delay".

    **Example:**

    ```python
    observed = hj.fitting.ObservedHTF(htf, sections)
    ```

    **Before:** `hj.estimate_htf`. **After:** `hj.fit_model`, `hj.fitting.identifiability`.
    """

    frequencies: Float[Array, " F"]
    H: Complex[Array, "M F ny nu"]
    harmonics: tuple[int, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    sections: AbstractSections
    weights: Float[Array, "M F ny nu"]
    weighted: Bool[Array, ""]
    most: Float[Array, ""]
    """Largest mean square of the residuals that the scatter of estimated variances can explain."""
    delay: Float[Array, "2"] | None

    def __init__(self, htf: HTF, sections: FamilyLike, delay: Delays | None = None):
        """**Arguments:** `htf`: of outputs and inputs of the system, by name. `sections`: the
        family of sections at which it was measured. `delay`: as for `linearize`; the first guess
        of what is free. Default: none.

        **Raises:** `DefinitionError` for NaN, bad variances, or another number of sections.
        """
        self.delay = None if delay is None else jnp.asarray(delay, float)
        self.frequencies = htf.frequencies
        self.H = htf.H
        self.sections = as_family(sections)
        self.harmonics = htf.harmonics
        self.inputs = htf.inputs
        self.outputs = htf.outputs
        require_same("HTFs and `sections`", htf, self.sections, ("n_sections",))
        self.weights = jnp.asarray(error_weights(htf, check_values(htf)))
        self.weighted = jnp.asarray(htf.variance is not None)
        self.most = jnp.asarray(largest_misfit(htf))

    def residuals(self, cycle: LimitCycle) -> Float[Array, " r"]:
        where = cycle, self.sections, self.outputs, self.inputs
        if self.delay is None:
            H = linearize(*where).htf(self.frequencies, self.harmonics).H
        else:
            H = Delayed.of(*where, self.delay).htf(self.frequencies, self.harmonics)
        return _real(H, self.H, self.weights)

    def prepare(self, cycle: LimitCycle) -> "ObservedHTF":
        cycle.structure.resolve_outputs(self.outputs)
        cycle.structure.inputs_among(self.inputs)
        if self.delay is None:
            place_sections(cycle, self.sections)
        else:
            Delayed.of(cycle, self.sections, self.outputs, self.inputs, self.delay)
        return self


@checked
class ObservedSeries(AbstractObservation):
    """Outputs at the sections in experiments that begin on the limit cycle.

    If the data hold the outputs on the cycle (`ExperimentData.cycle_outputs`), the outputs of data
    and model are compared, otherwise only their deviations from the cycle. Residuals are in units
    of `std`, or relative to the rms of each output's deviations. Experiments that failed are left
    out.

    **Example:**

    ```python
    observed = hj.fitting.ObservedSeries(data, sections, std=1e-5)
    ```

    **Before:** `hj.run_experiments`. **After:** `hj.fit_model`, `hj.fitting.identifiability`.
    """

    u: Float[Array, "S n nu"]
    y: Float[Array, "S n ny"]
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    absolute: bool = eqx.field(static=True)
    sections: AbstractSections
    scale: Float[Array, " ny"]
    weighted: Bool[Array, ""]
    flow: tuple[Plan, Settings] | None

    def __init__(
        self, data: ExperimentData, sections: FamilyLike, std: Deviations | None = None
    ):
        """**Arguments:** `data`: from experiments with `start="cycle"`. `sections`: their family.
        `std`: standard deviation of the measurement noise, one number or one for each output.

        **Raises:** `DefinitionError` if no experiment ran well, for another number of sections,
        an `std` that is not one for each output, outputs that are no deviations from the cycle,
        or experiments that do not begin on it.
        """
        self.sections = as_family(sections)
        require_same("data and `sections`", data, self.sections, ("n_sections",))
        data.require_ok()
        require_deviations(data.records)
        self.inputs = data.inputs
        self.outputs = data.outputs
        y = data.y[data.ok]
        rows = jnp.asarray(y.reshape(-1, y.shape[2]))
        self.scale = _scale("outputs", std, rows)
        self.weighted = jnp.asarray(std is not None)
        noise = 0.0 if std is None else 3.0 * np.asarray(std)
        rms = np.sqrt((y**2).mean(axis=(0, 1)))
        most = np.maximum(rms / 2, noise)
        if ((y[:, 0] / most) ** 2).mean() > 1:
            raise DefinitionError(
                "the experiments do not begin on the cycle: their outputs deviate as much at "
                'sample 0 as later. Apply them with `start="cycle"`, and keep the first cycle.'
            )
        self.absolute = data.cycle_outputs is not None
        if data.cycle_outputs is not None:
            periods = y.shape[1] // data.n_sections
            y = y + np.tile(data.cycle_outputs, (periods, 1))
        self.u = jnp.asarray(data.u[data.ok])
        self.y = jnp.asarray(y)
        self.flow = None

    def residuals(self, cycle: LimitCycle) -> Float[Array, " r"]:
        placed = place_sections(cycle, self.sections)
        start = jnp.tile(placed.section_zero[:, None], len(self.u))
        assert self.flow is not None, "`prepare` was not called"
        plan, settings = self.flow
        course = Course.of(placed, self.outputs)
        y = flow_batch(course, plan, start, self.u, settings).y
        if not self.absolute:
            y = y - jnp.tile(
                placed.observe(self.outputs), (y.shape[1] // placed.n_sections, 1)
            )
        return ((y - self.y) / self.scale).ravel()

    def prepare(self, cycle: LimitCycle) -> "ObservedSeries":
        require_same("data and system", self, cycle.system, ("inputs",))
        stepping = response_function(cycle, self.sections, self.outputs).stepping
        flow = stepping.plan, stepping.settings
        return eqx.tree_at(lambda o: o.flow, self, flow, is_leaf=lambda x: x is None)


@checked
class ObservedCycle(AbstractObservation):
    """Measurements of the limit cycle itself: outputs at sections, times, the period.

    Times of events are times of their sections: `ObservedCycle([hj.AtEvent("liftoff"),
    hj.AtEvent("touchdown")], times=(0.5163, 1.3510))`. In a system with a clock, times are those of
    the clock, modulo the period. In an autonomous system, they may count from any moment, since
    only their differences matter.

    Residuals are in units of the standard deviations, if these are given. Otherwise they are
    relative. Residuals of values are divided by the rms of the output, that of the period by the
    measured period, and residuals of times by the period of the guess.

    **Example:**

    ```python
    events = [hj.AtEvent("liftoff"), hj.AtEvent("touchdown")]
    observed = hj.fitting.ObservedCycle(events, times=(0.5163, 1.3510), times_std=0.001)
    ```

    **After:** `hj.fit_model`, `hj.fitting.identifiability`.
    """

    sections: AbstractSections
    outputs: tuple[str, ...] = eqx.field(static=True)
    measured: tuple[Float[Array, "..."], ...]
    scales: tuple[Float[Array, "..."], ...]
    which: tuple[str, ...] = eqx.field(static=True)
    weighted: Bool[Array, ""]

    def __init__(
        self,
        sections: FamilyLike,
        outputs: OptionalNames = (),
        values: Annotated[Numbers, Reals("sections outputs")] | None = None,
        *,
        times: Annotated[Numbers, Reals("sections")] | None = None,
        period: PositiveScalar | None = None,
        std: Deviations | None = None,
        times_std: Deviations | None = None,
        period_std: PositiveScalar | None = None,
    ):
        """**Arguments:**

        - `sections`: a family of N sections, or a list of `Crossing` and `AtEvent`.
        - `outputs`: names. `values` (N, ny): their values at the sections.
        - `times` (N,) at which the cycle crosses the sections. `period`.
        - `std`: standard deviation of the values, one number or one for each output; `times_std`;
          `period_std`.

        **Raises:** `DefinitionError` without any measurement, for shapes that do not fit, NaN,
        standard deviations that are not positive or not given for all, or none for something that
        is zero throughout.
        """
        self.sections = as_family(sections)
        self.outputs = tuple(outputs)
        N = self.sections.n_sections
        ny = len(self.outputs)
        given = {
            "values": (values, std, {"sections": N, "outputs": ny}),
            "times": (times, times_std, {"sections": N}),
            "period": (period, period_std, {}),
        }
        given = {name: entry for name, entry in given.items() if entry[0] is not None}
        if not given or ("values" in given) != bool(ny):
            raise DefinitionError(
                "give `outputs` with their `values`, `times`, or a `period`."
            )
        self.which = tuple(given)
        for name, (x, _, axes) in given.items():
            require_axes(f"`{name}`", x, axes)
        self.measured = tuple(jnp.asarray(x, float) for x, *_ in given.values())
        self.scales = tuple(
            _scale(k, std, jnp.asarray(x)) for k, (x, std, _) in given.items()
        )
        weights = {std is not None for _, std, _ in given.values()}
        if len(weights) > 1:
            raise DefinitionError(
                "give standard deviations of all measurements, or of none."
            )
        self.weighted = jnp.asarray(weights.pop())

    @classmethod
    def of(
        cls, cycle: LimitCycle, sections: FamilyLike, outputs: OptionalNames = ()
    ) -> "ObservedCycle":
        """Return the error-free measurement of a given cycle.

        **Raises:** as `place_sections`; `DefinitionError` for an output that is zero throughout.
        """
        placed = place_sections(cycle, sections)
        values = placed.observe(outputs) if outputs else None
        times = placed.lanes.t if np.any(placed.lanes.t) else None
        return cls(placed.family, outputs, values, times=times, period=cycle.period)

    def residuals(self, cycle: LimitCycle) -> Float[Array, " r"]:
        t, y = observed_at(cycle, self.sections, self.outputs, last_turn(cycle))
        predicted = {"values": y, "times": t, "period": cycle.period}
        parts = []
        for name, measured, scale in zip(
            self.which, self.measured, self.scales, strict=True
        ):
            error = predicted[name] - measured
            if name == "times":
                error = _without_turns(cycle, error)
            parts.append((error / scale).ravel())
        return jnp.concatenate(parts)

    def prepare(self, cycle: LimitCycle) -> "ObservedCycle":
        place_sections(cycle, self.sections)
        scales = tuple(jnp.where(jnp.isnan(x), cycle.period, x) for x in self.scales)
        return eqx.tree_at(lambda o: o.scales, self, scales)


def _without_turns(cycle: LimitCycle, error: Float[Array, " N"]) -> Float[Array, " r"]:
    """Errors of times modulo the period. For an autonomous cycle, whose zero of time is arbitrary,
    only their differences."""
    apart = error if cycle.clocked else error - error[0]
    turns = jnp.round(apart / cycle.period)
    error = error - jax.lax.stop_gradient(turns) * cycle.period
    return error if cycle.clocked else helmert(len(error)) @ error


@jax.jit
def _real(H: Array, measured: Array, weights: Array) -> Float[Array, " r"]:
    error = ((H - measured) * weights).ravel()
    return jnp.concatenate([error.real, error.imag])


def _scale(name: str, std: Numbers | None, seen: Array) -> Float[Array, "..."]:
    """Return the standard deviation of a measurement, or the size of its values without one, of
    the shape `seen.shape[1:]`."""
    if std is None and name == "times":
        # (Any moment may be zero: `prepare` knows the period.)
        return jnp.asarray(jnp.nan)
    if std is None:
        size = jnp.sqrt(jnp.mean(jnp.atleast_1d(seen) ** 2, axis=0))
        if not jnp.all(size > 0):
            raise DefinitionError(
                f"`{name}` are zero throughout and have no size: leave them out, or give their "
                "standard deviation."
            )
        return size
    std = jnp.asarray(std, float)
    outputs = ({"outputs": n} for n in seen.shape[1:])
    require_axes(f"the standard deviation of `{name}`", std, {}, *outputs)
    return jnp.broadcast_to(std, seen.shape[1:])
