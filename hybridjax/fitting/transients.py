"""`ObservedTrajectory`: recorded trajectories that are no cycles, such as drops, first steps and
transients.

`fit_model` calls `residuals_of` for each trajectory: the flow from its start (`orbits/flow.py`),
with outputs at the measured times and times of events, minus the measurements. States at the start
may be unknown (`start_value`, `with_start`).

Residuals are NaN where the flow lacks a measurement, and must not be left out there, since their
number is fixed: `lack_of` says why. If a residual is wrong, look at `residuals_of` (which event is
compared with which) and `_outputs`; if it has a wrong weight, at `_sizes` and `_event_size`.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arguments import Numbers, require_axes
from .._core.boundary.checked import checked
from .._core.boundary.kinds import OptionalNames, PositiveScalar
from .._core.boundary.values import Reals
from .._core.results import Result
from .._core.text import fields
from ..engine.flow import Samples
from ..engine.lanes import Lanes, pace_of
from ..engine.settings import Settings
from ..errors import DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.flow import Flow, requested, sampled
from ..sections.placed import observe
from ..systems.structure import Structure
from ..systems.system import Guess, HybridSystem
from .observations import AbstractObservation, Deviations


# The flow ends later than the last measurement, by this part of the time until then. Larger:
# further events that were not measured happen. Smaller: if a measured event comes too late for some
# parameters, it is missed, and the fit cannot leave these parameters.
_AFTER = 0.2
# Number of events whose times are kept, in addition to the number of measured events. Fewer: a
# measured event is missed if many others come before it. More: programs take longer.
_MORE_EVENTS = 32


@checked
class ObservedTrajectory(AbstractObservation):
    """A recorded trajectory from any state: outputs at times, and times of events.

    Fits of it need no limit cycle. Residuals are in units of the standard deviations where these
    are given, otherwise relative to the rms of each output, and for times of events to the mean of
    the intervals between them.

    **Example:**

    ```python
    drop = hj.Guess("flight", (2.0, 1.0, 0.0, 0.0))
    observed = hj.fitting.ObservedTrajectory(
        drop, (0.1, 0.2, 0.3), "yM", [[2.03], [1.99], [1.88]], std=0.01, unknown_states="vM"
    )
    ```

    **After:** `hj.fit_model`, `hj.fitting.identifiability`.
    """

    start: Guess
    unknown_states: tuple[str, ...] = eqx.field(static=True)
    times: Float[Array, " K"]
    outputs: tuple[str, ...] = eqx.field(static=True)
    values: Float[Array, "K ny"]
    known: tuple[int, ...] = eqx.field(static=True, repr=False)
    """Indices, in `values.ravel()`, of the values that are not NaN."""
    scale: Float[Array, " ny"]
    events: tuple[str, ...] = eqx.field(static=True)
    event_times: tuple[Float[Array, " E"], ...]
    event_scale: Float[Array, ""]
    input: Any
    settings: Settings | None
    weighted: Bool[Array, ""]

    def __init__(
        self,
        start: Guess,
        times: Annotated[Numbers, Reals("K")] | None = None,
        outputs: OptionalNames = (),
        values: Annotated[Numbers, Reals(missing=True)] | None = None,
        *,
        std: Deviations | None = None,
        events: Mapping[str, Annotated[Numbers, Reals()]] | None = None,
        events_std: PositiveScalar | None = None,
        unknown_states: OptionalNames = (),
        input: Callable[[Any], Any] | Annotated[Numbers, Reals()] | None = None,
        settings: Settings | None = None,
    ):
        """**Arguments:**

        - `start`: chart, state and time at which the flow begins.
        - `times` (K,), `outputs`, `values` (K, ny): samples; NaN where they are missing. Those of
          one output may have the shape (K,).
        - `std`: their standard deviation, one number or one for each output.
        - `events`: times of the first events of each name, in order: `{"bounce": (0.45, 1.08)}`.
          `events_std`: their standard deviation, one number.
        - `unknown_states`: names of states at the start that are fitted, too; `start` has guesses.
        - `input`, `settings`: as in `hj.flow`.

        **Raises:** `DefinitionError` without any measurement, for several starts, for shapes that
        do not fit, times that do not increase or come before the start, and standard deviations
        that are not given for all.
        """
        if np.ndim(start.state) != 1:
            raise DefinitionError(
                "ObservedTrajectory: `start` must have one state: make an ObservedTrajectory of "
                "each trajectory, and give `hj.fit_model` the list."
            )
        self.start = start
        self.unknown_states = tuple(unknown_states)
        self.input = input
        self.settings = settings
        self.outputs = tuple(outputs)
        own_times, samples = _samples(times, self.outputs, values)
        if values is None and not events:
            raise DefinitionError(
                "ObservedTrajectory: give samples (`times`, `outputs`, `values`) or `events`."
            )
        missing = np.isnan(samples)
        self.known = tuple(np.flatnonzero(~missing).tolist())
        self.times = jnp.asarray(own_times)
        self.values = jnp.asarray(np.where(missing, 0.0, samples))
        self.events = tuple(events or ())
        lists = [_event_times(name, x) for name, x in (events or {}).items()]
        self.event_times = tuple(jnp.asarray(x) for x in lists)
        _require_times(start, own_times, *lists)
        self.scale = _sizes("values", std, samples)
        self.event_scale = _event_size(events_std, lists, start)
        deviations = []
        if len(own_times):
            deviations.append(std)
        if lists:
            deviations.append(events_std)
        given = [x is not None for x in deviations]
        if any(given) and not all(given):
            raise DefinitionError(
                "give standard deviations of the samples and of the events, or of neither."
            )
        self.weighted = jnp.asarray(all(given))

    __repr__ = fields

    def residuals(self, cycle: LimitCycle) -> Float[Array, " r"]:
        """Return the prediction minus the measurement, weighted, of the system of a cycle; NaN
        where its flow ends sooner, or lacks a measured event."""
        return residuals_of(self, cycle.system)


def residuals_of(
    observation: ObservedTrajectory, system: HybridSystem
) -> Float[Array, " r"]:
    """The prediction of a system minus the measurement, weighted; NaN where its flow ends sooner,
    or lacks a measured event."""
    found, samples = sampled(_request(observation, system), observation.times)
    parts = []
    if observation.outputs:
        values = _outputs(observation, found, samples)
        error = (values - observation.values) / observation.scale
        parts.append(error.ravel()[np.array(observation.known, int)])
    s = found.structure
    measurements = zip(observation.events, observation.event_times, strict=True)
    for name, measured in measurements:
        is_own = found.event_index == s.transition_index(name)
        count = jnp.cumsum(is_own)
        number = jnp.arange(1, len(measured) + 1)
        row = jnp.argmax(count == number[:, None], axis=1)
        has_come = count[-1] >= number
        time = jnp.where(has_come, found.event_times[row], jnp.nan)
        parts.append((time - measured) / observation.event_scale)
    return jnp.concatenate(parts)


def lack_of(observation: ObservedTrajectory, system: HybridSystem) -> str:
    """Why the flow of a system lacks measurements; empty if it has all."""
    if np.isfinite(residuals_of(observation, system)).all():
        return ""
    found, _ = sampled(_request(observation, system), observation.times)
    result = Result(int(found.result))
    if result == Result.OK:
        return "it lacks a measured event"
    more = ""
    if result == Result.STEP_LIMIT:
        more = (
            " (kinks of an `input` need many steps: pass a smoother one, or `settings` with larger "
            "`rtol`, `atol` and `max_steps` to `ObservedTrajectory`)"
        )
    return f"{result.message}{more}"


def _request(observation: ObservedTrajectory, system: HybridSystem) -> Any:
    """The flow until a little after the last measurement."""
    times = observation.times, *observation.event_times
    end = jnp.max(jnp.concatenate(times))
    if observation.events:
        end = end + _AFTER * (end - observation.start.time)
    count = sum(len(x) for x in observation.event_times)
    return requested(
        system,
        observation.start,
        until=end,
        events=None,
        within=None,
        input=observation.input,
        settings=observation.settings,
        max_events=count + _MORE_EVENTS,
        max_steps=None,
    )


def _outputs(
    observation: ObservedTrajectory, found: Flow, samples: Samples
) -> Float[Array, "K ny"]:
    """The outputs of the flow at the measured times."""
    s = found.structure
    K = len(observation.times)
    chart = samples.chart[:, 0]
    pace = pace_of(chart * 0)
    armed = jnp.zeros((len(s.transitions), K), bool)
    q = samples.q[..., 0].T
    lanes = Lanes(observation.times, chart, q, armed, chart * 0, pace)
    u = jnp.broadcast_to(found.request.u, (s.nu, K))
    return observe(s, s.resolve_outputs(observation.outputs), lanes, u).T


def require_names(observation: ObservedTrajectory, system: HybridSystem) -> None:
    """**Raises:** `DefinitionError` for names that the system does not have."""
    s = Structure(system)
    s.resolve_outputs(observation.outputs)
    for name in observation.events:
        s.transition_index(name)
    states = _states(observation, system)
    for name in observation.unknown_states:
        if name not in states:
            raise DefinitionError(
                f"`unknown_states` has '{name}', which is no state of chart "
                f"'{observation.start.chart}': its states are {', '.join(states)}."
            )


def _states(observation: ObservedTrajectory, system: HybridSystem) -> tuple[str, ...]:
    """Names of the states at the start."""
    s = Structure(system)
    return s.charts[s.chart_index(observation.start.chart)].states


def start_value(
    observation: ObservedTrajectory, system: HybridSystem, state: str
) -> Array:
    """The guess of an unknown state at the start."""
    place = _states(observation, system).index(state)
    return jnp.asarray(observation.start.state)[place]


def with_start(
    observation: ObservedTrajectory, system: HybridSystem, values: dict[str, Any]
) -> ObservedTrajectory:
    """The observation from a start with other states."""
    names = _states(observation, system)
    state = jnp.asarray(observation.start.state)
    for name, value in values.items():
        state = state.at[names.index(name)].set(value)
    return eqx.tree_at(lambda o: o.start.state, observation, state)


def _event_times(name: str, times: Any) -> Float[np.ndarray, " E"]:
    """The times of the events of one name.

    **Raises:** `DefinitionError` for none, and for a table.
    """
    times = np.atleast_1d(np.asarray(times, float))
    if times.ndim > 1 or not len(times):
        raise DefinitionError(
            f"`events['{name}']` must be one time or more, not of shape {times.shape}."
        )
    return times


def _require_times(start: Guess, *lists: np.ndarray) -> None:
    """**Raises:** `DefinitionError` for times that do not increase, or come before the start."""
    for times in lists:
        if not len(times):
            continue
        begin = float(start.time)
        if times[0] < begin:
            raise DefinitionError(
                f"a time, {times[0]:.6g}, comes before the start at {begin:.6g}."
            )
        steps = np.diff(times, prepend=begin - 1)
        if not (steps > 0).all():
            raise DefinitionError("times of a trajectory must increase.")


def _samples(
    times: Any, outputs: tuple[str, ...], values: Any
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K ny"]]:
    """Times and samples; without outputs, empty arrays.

    **Raises:** `DefinitionError` if one of the three lacks, for a shape that does not fit, and if
    all samples are missing.
    """
    given = [times is not None, bool(outputs), values is not None]
    if any(given) and not all(given):
        raise DefinitionError(
            "ObservedTrajectory: give `times`, `outputs` and `values` together."
        )
    if values is None:
        return np.zeros(0), np.zeros((0, 0))
    own_times = np.asarray(times, float)
    samples = np.asarray(values, float)
    if samples.ndim == 1 and len(outputs) == 1:
        samples = samples[:, None]
    axes = {"times": len(own_times), "outputs": len(outputs)}
    require_axes("`values`", samples, axes)
    if samples.size and np.isnan(samples).all():
        raise DefinitionError(
            "ObservedTrajectory: `values` are all missing: leave them out, or give `events` alone."
        )
    return own_times, samples


def _sizes(
    name: str, std: Any, samples: Float[np.ndarray, "K ny"]
) -> Float[Array, " ny"]:
    """Standard deviation of each output; if none is given, its rms value.

    **Raises:** `DefinitionError` for another number of them, and for an output that is zero
    throughout, without one.
    """
    ny = samples.shape[1]
    if std is not None:
        sizes = jnp.asarray(std, float)
        if sizes.shape not in ((), (ny,)):
            raise DefinitionError(
                f"`std` must be one number, or one for each of {ny} outputs, not of shape "
                f"{sizes.shape}."
            )
        return jnp.broadcast_to(sizes, (ny,))
    if not ny:
        return jnp.ones(0)
    known = np.isfinite(samples)
    mean_square = np.where(known, samples**2, 0.0).sum(axis=0) / np.maximum(
        known.sum(axis=0), 1
    )
    size = np.sqrt(mean_square)
    if not (size > 0).all():
        raise DefinitionError(
            f"`{name}` of an output are zero throughout, or all missing: leave it out, or give "
            "its standard deviation."
        )
    return jnp.asarray(size)


def _event_size(std: Any, lists: list[np.ndarray], start: Guess) -> Float[Array, ""]:
    """Standard deviation of times of events; if none is given, the mean of the intervals between
    events of one name, averaged over the names."""
    if std is not None:
        return jnp.asarray(std, float)
    if not lists:
        return jnp.ones(())
    begin = float(start.time)
    intervals = [(x[-1] - begin) / len(x) for x in lists]
    return jnp.asarray(np.mean(intervals) or 1.0)
