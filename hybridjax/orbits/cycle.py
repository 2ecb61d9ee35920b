"""Limit cycles: fixed points of the return map, with their multipliers.

`LimitCycle` is what searches return. It holds the numbers of the last *turn* (the flow once around
the cycle), cut into *pieces*. All other results are computed at first use: multipliers here, from
the Jacobians of the pieces (`factors`; or `fine_factors` if a piece contracts too much); responses,
sensitivities, fluctuations and HTFs in files of these names. A further result is a method here that
calls a file of its own with `_checked`. The fields must stay in their order: searches and sweeps
make cycles from arguments by position. *Sizes* of states are their magnitudes (`scale.py`).

A wrong cycle has its cause in the search (`find.py`, `newton.py`); `findings` are those of
`verdict.py`. If multipliers are wrong, look at `_multipliers`, and at `fine_factors` if small ones
are; if a cycle counts as changed and is not, at `what_changed`.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .._core.boundary.checked import NeedsValues, checked_methods
from .._core.boundary.kinds import Count, Index, Numbers, Positive, SignalNames
from .._core.boundary.values import Reals
from .._core.call import once_in_call
from .._core.executor import is_traced, is_tracer, to_host
from .._core.findings import Finding
from .._core.html import (
    CHARTS,
    Curve,
    card,
    facts,
    multiplier_table,
    picture,
    unit_circle,
)
from .._core.meaning import change_of, require_as_made
from .._core.memo import Memory, remembered
from .._core.precision import require_x64
from .._core.results import Result
from .._core.showable import WithMultipliers
from .._core.signal import unit_of, with_unit
from .._core.text import how_many, number
from ..engine.lanes import Lanes, Tape
from ..engine.replay import linear_moves, recorded_moves
from ..engine.settings import Settings
from ..engine.trajectory import Trajectory, observed, recorded, simulate
from ..engine.watch import slopes
from ..errors import DefinitionError
from ..linear.frequency_response import Frequencies, Harmonics
from ..linear.htf import HTF
from ..linear.multipliers import product_eigenvalues
from ..systems.structure import Structure
from ..systems.system import HybridSystem, OutputNames, arrays_of, name_of
from .asymptotic_phase import asymptotic_phase
from .coincidence import SimultaneousEvents, simultaneous_events
from .continuous_htf import continuous_htf
from .crossing import AtEvent, Crossing
from .fluctuations import Fluctuations, Given, GivenResets, fluctuations
from .linear_flow import hosted, last_turn, linear_flow, recorded_ends, rule
from .responses import Responses, responses
from .return_map import ReturnMap
from .scale import ROUNDING, has_implicit, in_sizes, sizes_of, stiff_charts
from .sensitivity import Sensitivity, sensitivity
from .verdict import verdict


Matrix = Float[np.ndarray, "_ _"]
_trajectories = Memory()

# Codes of searches that end on a cycle.
_FOUND = Result.OK, Result.SINGULAR
# If a factor contracts its weakest direction by more than this, it is replaced by products of
# Jacobians of single steps, each over as many steps as possible without contracting more than this.
# Larger: more cycles have many factors. Smaller: small multipliers lose digits.
WEAKEST = 1e-5
# With implicit methods, multipliers below this are smaller than their errors. Smaller: errors are
# taken for multipliers. Larger: multipliers that are accurate are given as 0.
_LEAST_OF_IMPLICIT = 1e-10

# Residuals below this are rounding errors, which differ between machines, and are not printed.
# Larger: the print hides how well a cycle closes. Smaller: prints of the same cycle differ.
_ROUNDING = 1e-12


@checked_methods
class LimitCycle(WithMultipliers, eqx.Module):
    """A periodic orbit of a hybrid system.

    **Fields:**

    - `period`: in the system's unit of time, until the cycle closes (see `multiplicity`).
    - `anchor`: the time, chart and state at which the cycle begins, on the section `base` (a clock
        section at `anchor.t` if `base` is `None`).
    - `pieces`: states at the beginnings of the K pieces into which the cycle is divided.
    - `factors`: Jacobians of the flow over the pieces, padded with zeros. The valid block of
        `factors[n]` is [:dims[n+1], :dims[n]].
    - `residual`: largest distance between `anchor` and the end of one period, relative to the
        magnitudes of the states.
    - `iterations`: number of Newton steps.
    - `result`: a `Result` code.
    - `event_sequence`: indices of the transitions of one period, in order from the anchor.
    - `settings`: accuracy of the flow, with the magnitudes of the states.
    - `conserved`: requested values of conserved quantities, by name.
    - `multiplicity`: periods of the clock, or crossings of the section, in one period of the
        cycle.
    - `numbers`: the arrays of the system for which the cycle was found, by name.
    """

    system: HybridSystem
    base: Crossing | AtEvent | None
    period: Float[Array, ""]
    anchor: Lanes
    pieces: Lanes
    factors: Float[Array, "K d d"]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]
    event_sequence: tuple[int, ...] = eqx.field(static=True)
    settings: Settings
    conserved: dict[str, Float[Array, ""]]
    multiplicity: int = eqx.field(static=True)
    numbers: dict[str, Array]

    @property
    def return_map(self) -> ReturnMap:
        """The map that has the cycle as a fixed point."""
        return ReturnMap(
            self.system,
            self.settings,
            self.anchor,
            self.base,
            self.period,
            self.conserved,
            self.multiplicity,
        )

    def require_current(self) -> None:
        """**Raises:** `DefinitionError` if the system's code, its section's, or a parameter, has
        changed since the cycle was found."""

        def compare():
            require_unchanged(self.system, self.numbers)
            require_as_made(self.base, "this limit cycle was found")

        once_in_call(("compared", id(self)), self, compare)

    def require_found(self) -> None:
        """**Raises:** `DefinitionError` if the search failed, and in the cases of
        `require_current`."""
        self.require_current()
        code = Result.OK if is_traced(self.result) else Result(int(self.result))
        if code not in _FOUND:
            raise DefinitionError(
                f"the search for this cycle failed ({code.message}): `find_limit_cycle` of its "
                "system raises an error that says what to do."
            )

    def _require_period(self) -> None:
        """**Raises:** `DefinitionError` if the search for a cycle of a sweep failed, so that it has
        no period."""
        if not np.isfinite(float(self.period)):
            self.require_found()

    @property
    def structure(self) -> Structure:
        """The system in its normal form, with indices of charts and transitions. (It is computed at
        each access, because JAX tracers of an earlier trace are invalid in the next.)"""
        return self.return_map.structure

    @property
    def scale(self) -> dict[str, float]:
        """Magnitude of each state, by name, relative to which errors are measured: the given one,
        or the largest on the cycle."""
        _require_values(self, "scale")
        return sizes_of(self.structure, self.return_map.scale)

    @property
    def clocked(self) -> bool:
        """True if a clock drives the system."""
        return self.system.period() is not None

    @property
    def dims(self) -> Int[np.ndarray, " K"]:
        """Numbers of states at the beginnings of the pieces."""
        _require_values(self, "dims")
        return np.array(self.structure.dims)[np.asarray(self.pieces.chart)]

    @property
    def multipliers(self) -> Complex[np.ndarray, " r"]:
        """The non-zero Floquet multipliers, by decreasing modulus, without derivatives.

        They are computed from the factors without forming their product, so that small multipliers
        are accurate. If a factor contracts too strongly for double precision, the Jacobians of
        single steps of another period are used. Multipliers that are zero because of resets and
        sections are identified by rank and left out. A 0 represents values below 1e-308 or, with an
        implicit method, below 1e-10. Each conserved quantity with a given value has a multiplier of
        exactly 1.
        """
        _require_values(self, "multipliers")
        self.require_found()
        return self._multipliers

    @remembered
    def _multipliers(self) -> Complex[np.ndarray, " r"]:
        blocks = self._scaled_factors()
        # (In an autonomous system the direction of the flow was projected out, and is not counted
        # as the weakest one.)
        weaker = 0 if self.clocked else 1
        strong = bool(np.isfinite(self.residual)) and any(
            weakest(block, weaker) < WEAKEST for block in blocks
        )
        if strong:
            blocks = fine_factors(self)
        values = product_eigenvalues(blocks, rtol=ROUNDING)
        if strong and has_implicit(self.structure):
            values = self._without_lost(values)
        # Each conserved quantity has a multiplier that is known to be 1.
        order = np.argsort(np.abs(values - 1))
        near_one = order[: len(self.conserved)]
        values[near_one] = 1
        values = values[np.argsort(-np.abs(values), kind="stable")]
        values.flags.writeable = False  # they are kept
        return values

    def _scaled_factors(self) -> list[Matrix]:
        """The factors in sizes of the states, without padding."""
        dims = self.dims
        scale = np.asarray(self.settings.scale)[np.asarray(self.pieces.chart)]
        after = np.roll(np.arange(len(dims)), -1)
        factors = np.asarray(self.factors)
        scaled = factors * scale[:, None, :]
        factors = scaled / scale[after, :, None]
        return [
            factor[: dims[end], : dims[begin]]
            for begin, (end, factor) in enumerate(zip(after, factors, strict=True))
        ]

    def _without_lost(
        self, values: Complex[np.ndarray, " r"]
    ) -> Complex[np.ndarray, " r"]:
        """Multipliers, with zeros in place of those that are lost in errors of implicit steps. If
        only one is lost on a cycle without events, it is computed from the product of all
        multipliers."""
        lost = np.abs(values) < _LEAST_OF_IMPLICIT
        values = np.where(lost, 0.0, values)
        if lost.sum() == 1 and not self.event_sequence:
            resolved = np.prod(values[~lost]).real
            values[lost] = np.exp(log_determinant(self)) / resolved
        return values

    @property
    def log_multipliers(self) -> Float[np.ndarray, " r"]:
        """Natural logarithms of the moduli of `multipliers`.

        The logarithm of a multiplier below 1e-308 follows from Liouville's formula if the cycle has
        no events: the sum of all logarithms is the integral of the divergence of the vector field
        over a period. Otherwise it is minus infinity."""
        with np.errstate(divide="ignore"):
            logs = np.log(np.abs(self.multipliers))
        if not self.event_sequence and np.sum(np.isneginf(logs)) == 1:
            others = np.sum(logs[:-1])
            logs[-1] = log_determinant(self) - others
        return logs

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Doubts about the cycle. They are the results of a second integration along
        it, by another method with other steps, which is made at the first access.

        A cycle that `find_limit_cycle` returns has passed these checks, so that no finding is
        "refused". A cycle of a sweep or of a branch was checked at its guards only; here it is
        checked in full.
        """
        _require_values(self, "findings")
        self.require_current()
        self._require_period()
        return verdict(self).findings

    @property
    def not_reached(self) -> tuple[str, ...]:
        """Names of transitions out of charts of the cycle that do not happen on it."""
        _require_values(self, "not_reached")
        self.require_current()
        self._require_period()
        return verdict(self).not_reached

    @property
    def is_stable(self) -> bool:
        """True if all multipliers lie inside the unit circle. Multipliers of exactly 1 that belong
        to conserved quantities do not count."""
        inside = np.abs(self.multipliers) < 1
        free = len(inside) - len(self.conserved)
        return bool(np.sum(inside) == free)

    @property
    def state(self) -> dict[str, float]:
        """The state at `anchor`, by name. A simulation or a flow that starts with it begins at the
        time of `anchor`, and stays on the cycle."""
        _require_values(self, "state")
        anchor = to_host(self.anchor)
        chart = int(anchor.chart[0])
        return self.structure.by_name(chart, anchor.q[:, 0], float(anchor.t[0]))

    def trajectory(self, periods: Positive = 1.0) -> Trajectory:
        """The orbit from `anchor` on, with its events, dense enough to plot.

        **Raises:** `DefinitionError` if the system's code has changed since the cycle was found.
        """
        _require_values(self, "trajectory")
        self.require_current()
        if periods == 1 and int(self.result) == Result.OK:
            return orbit(self)
        s = self.structure
        anchor = to_host(self.anchor)
        a = int(anchor.chart[0])

        def simulated() -> Trajectory:
            return simulate(
                self.system,
                s.names[a],
                anchor.q[: s.dims[a], 0],
                float(self.period) * periods,
                time=float(anchor.t[0]),
                settings=self.settings,
            )

        return _trajectories.recall(self, periods, simulated)

    def responses(self, modes: Index | None = None) -> Responses:
        """Responses to brief pushes, at every phase: of the phase, and of the amplitudes of modes.

        They come from the steps of the last turn, which are linearized, and are exact through
        events; inputs that resets and guards use act at events (`Responses.impulses`).

        **Arguments:** `modes`: number of modes, those with the largest multipliers. Default: all
        with multipliers above 1e-6; inside of `grad` and `jvp` it must be given.

        **Raises:** `ComputationError` for a double multiplier 1, where phase has no meaning, and
        for modes whose multipliers coincide; `DefinitionError` for more modes than have amplitudes,
        and inside of `jit` and `vmap`.
        """
        return responses(self._checked(), modes)

    def asymptotic_phase(
        self, chart: str, state: Annotated[Numbers, Reals("n")], cycles: Count = 1000
    ) -> float:
        """The phase, in cycles, of the state on the cycle that a state off it approaches. It flows
        until it meets the section near the anchor, where phases are linear.

        **Arguments:** `chart`, `state`: as of `simulate`; in a chart of sliding, on its surface.
        `cycles`: largest number of crossings of the section. Default: 1000.

        **Raises:** `DefinitionError` for a cycle that is driven by a clock; `ComputationError` for
        a state that does not reach the cycle.
        """
        return asymptotic_phase(self._checked(), chart, np.asarray(state), cycles)

    def htf(
        self,
        frequencies: Frequencies,
        harmonics: Harmonics = 0,
        outputs: OutputNames | None = None,
        inputs: SignalNames | None = None,
    ) -> HTF:
        r"""Harmonic transfer functions in continuous time, exact through events.

        An input $e^{2 \pi i f t / T}$ has the response
        $\sum_m H_m(f) e^{2 \pi i (f + m) t / T}$, with the period T and the time t of the system's
        clock, or since the anchor of an autonomous cycle. Inputs that guards and resets use act at
        events. An output that jumps at an event whose time moves has an impulse there, which its
        harmonics include: their moduli do not decay.

        **Arguments:**

        - `frequencies`: input frequencies, in cycles per period.
        - `harmonics`: m of the H_m, one integer or several: 2 is H_2 alone, `range(-2, 3)` all up
          to it. Default: 0.
        - `outputs`: names or `Output`s. Default: all states that every chart defines.
        - `inputs`: names. Default: all.

        **Raises:** `DefinitionError` for an output that a chart of the cycle does not define, an
        input that does not exist, and frequencies at a pole, as whole ones of autonomous cycles.
        """
        return continuous_htf(self._checked(), frequencies, harmonics, outputs, inputs)

    def sensitivity(self, parameter: str) -> Sensitivity:
        """Derivatives of the period, of times of events and of the shape by a parameter.

        Phase 0 stays on the section of the cycle, or at the anchor's phase of the clock, and
        phases are times in parts of the period.

        **Arguments:** `parameter`: the name of a parameter of the system, or of a part of it with
        dots.

        **Raises:** `DefinitionError` for a parameter that does not exist; `ComputationError` for
        cycles that are not isolated.
        """
        return sensitivity(self._checked(), parameter)

    def simultaneous_events(self) -> list[SimultaneousEvents]:
        """Return groups of events that coincide on the cycle, with derivatives for each order.

        If the orders of a group commute, `find_limit_cycle`, sweeps and `continuation` treat the
        cycle as ok; otherwise its result is `Result.SIMULTANEOUS` (`find_limit_cycle` returns it
        with `throw=False`). A group contains at least one event that is not scheduled.

        **Returns:** a list of `SimultaneousEvents`, with the `time`, the `orders` of the events,
        and a derivative of the map over the group for each; empty if no events coincide.

        **Example:**

        ```python
        groups = cycle.simultaneous_events()
        print([group.orders for group in groups])  # [], since no events of this cycle coincide
        ```
        """
        return simultaneous_events(self)

    def fluctuations(
        self, white: Given = None, guards: Given = None, resets: GivenResets = None
    ) -> Fluctuations:
        """Stationary deviations from the cycle under independent noise, to first order in it:
        covariances at every phase and from period to period, of durations, and phase diffusion.

        **Arguments:**

        - `white`: strengths of white noise by name of a state or an input, in units of a rate of
            the state, or of the input, times the square root of time. Default: none.
        - `guards`: standard deviations of the level of a transition's guard, or of the time of a
            scheduled event, by name. Default: none.
        - `resets`: standard deviations of states after a transition, by names of transitions and
          states. Default: none.

        **Raises:** `DefinitionError` for names that do not exist; `ComputationError` for cycles
        that are not stable.
        """
        return fluctuations(self._checked(), white or {}, guards or {}, resets or {})

    def _checked(self) -> "LimitCycle":
        """The cycle with its arrays on the host, unless JAX traces it.

        **Raises:** as `require_found` and `require_x64`.
        """
        require_x64()
        self.require_found()
        return hosted(self)

    def __repr__(self):
        if is_traced(self):
            return f"LimitCycle({name_of(self.system)}, traced)"
        if what_changed(self.system, self.numbers) or int(self.result) not in _FOUND:
            return f"LimitCycle({self._title()})"
        shown = {"multipliers": self._multipliers_text()}
        lines = []
        for name, value in self._facts(shown).items():
            heading = name if name.startswith("at t") else f"{name:<11}"
            space = "   " if name.startswith("at t") else "  "
            lines.append(f"\n  {heading}{space}{value}")
        return f"LimitCycle({self._title()}){''.join(lines)}"

    def _multipliers_text(self) -> str:
        """The multipliers, printed."""
        least = "1e-10" if has_implicit(self.structure) else "1e-308"
        shown = [number(z, 9) if z else f"below {least}" for z in self.multipliers]
        text = ", ".join(shown) or "none but zero"
        if self.conserved:
            text += f" (1: conserved {', '.join(self.conserved)})"
        return text

    def _repr_html_(self) -> str | None:
        if is_traced(self):
            return None
        if what_changed(self.system, self.numbers) or int(self.result) != Result.OK:
            return card("LimitCycle", self._title(), facts(self._facts()))
        return card(
            "LimitCycle",
            self._title(),
            facts(self._facts()),
            orbit_picture(self.trajectory()),
            multiplier_table(self.multipliers),
            unit_circle(self.multipliers),
        )

    def _title(self) -> str:
        name = name_of(self.system)
        change = what_changed(self.system, self.numbers)
        if change:
            return f"{name}: {change}"
        message = Result(int(self.result)).message
        if message != Result.OK.message:
            return f"{name}: {message}"
        refused = verdict(self).refused
        if refused:
            return f"{name}: refused ({refused[0].cause})"
        # (By rounding, those of neutral cycles are a little larger than 1.)
        grows = np.abs(self.multipliers).max(initial=0) > 1 + 1e-6
        return f"{name}: {message}{', unstable' if grows else ''}"

    def _facts(self, multipliers: Mapping[str, str] = {}) -> dict[str, str]:  # noqa: B006
        """The printed lines, by their headings."""
        time_unit = self.system.time_unit
        names = [transition.name for transition in self.structure.transitions]
        events = [names[g] for g in self.event_sequence]
        begin = number(to_host(self.anchor).t[0], 6, time_unit)
        residual = float(self.residual)
        is_rounding = residual < _ROUNDING
        closes = f"below {_ROUNDING:g}" if is_rounding else f"{residual:.2g}"
        steps = how_many(int(self.iterations), "Newton step", "Newton steps")
        lines = {
            "period": number(self.period, 12, time_unit),
            f"at t = {begin}": self._state_text(),
            "events": ", ".join(events) or "none",
            **multipliers,
            "residual": f"{closes} after {steps}",
            **self._checks(),
        }
        stiff = stiff_charts(self.structure, to_host(self.pieces), float(self.period))
        if stiff:
            sentences = (
                f"chart '{name}': a mode that decays in {1 / rate:.2g} limits the steps of an "
                'explicit method; `Settings(solver="auto")` takes an implicit one'
                for name, rate in stiff.items()
            )
            lines["stiff"] = "; ".join(sentences)
        return lines

    def _state_text(self) -> str:
        """The state at the anchor, printed, with zeros for what is only rounding."""
        chart = int(to_host(self.anchor).chart[0])
        units = [unit_of(state) for state in self.structure.states(chart)]
        rounding = np.finfo(float).eps
        scale = self.scale
        texts = []
        for (name, x), unit in zip(self.state.items(), units, strict=True):
            shown = 0.0 if abs(x) <= rounding * scale[name] else x
            texts.append(f"{name} = {number(shown, 9, unit)}")
        return ", ".join(texts)

    def _checks(self) -> dict[str, str]:
        """The printed lines on the checks of a cycle that was found."""
        changed = what_changed(self.system, self.numbers)
        if changed or int(self.result) not in _FOUND:
            return {}
        checked = verdict(self)
        lines = {"checked by": str(checked)}
        if checked.not_reached:
            lines["not reached"] = ", ".join(checked.not_reached)
        for finding in checked.findings:
            lines[finding.cause] = finding.text
        return lines


def _require_values(cycle: LimitCycle, name: str) -> None:
    if is_traced(cycle):
        raise NeedsValues(
            f"`{name}` of a limit cycle needs its values, which a JAX transformation hides: use "
            "its arrays (`anchor`, `period`, `factors`) there, or `linearize(...).monodromy()`."
        )


def what_changed(
    system: HybridSystem,
    numbers: Mapping[str, Any],
    single: HybridSystem | None = None,
) -> str:
    """A sentence on the parts of a system that have changed since its cycle was found; empty if
    none has. For systems side by side, `single` is one of them."""
    now = arrays_of(system)
    changed = change_of(system if single is None else single)
    for key in now.keys() | numbers.keys():
        if _differ(now.get(key), numbers.get(key)):
            changed = f"`{key}` of {name_of(system)}"
    if changed is None:
        return ""
    return (
        f"{changed} has changed since this limit cycle was found: find it again, with this one as "
        "the guess"
    )


def as_found(cycle: LimitCycle) -> LimitCycle:
    """The cycle with the parameters for which it was found."""
    arrays, static = eqx.partition(cycle.system, eqx.is_array)
    before = [cycle.numbers.get(name, x) for name, x in arrays_of(cycle.system).items()]
    arrays = jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(arrays), before)
    return eqx.tree_at(lambda x: x.system, cycle, eqx.combine(arrays, static))


def require_unchanged(
    system: HybridSystem,
    numbers: Mapping[str, Any],
    single: HybridSystem | None = None,
) -> None:
    """**Raises:** `DefinitionError` if the code or a parameter of the system, or systems, has
    changed."""
    change = what_changed(system, numbers, single)
    if change:
        raise DefinitionError(f"{change}.")


def _differ(x: Any, y: Any) -> bool:
    """Test whether an array of a system is another one than that for which the cycle was found."""
    # (If a parameter was replaced inside of a transformation, only this parameter is traced.)
    if is_tracer(x) or is_tracer(y):
        return not is_tracer(y)
    if x is y:
        return False
    return np.asarray(x).tobytes() != np.asarray(y).tobytes()


def orbit_picture(
    orbit: Trajectory,
    sections: tuple[
        Float[np.ndarray, " N"], Int[np.ndarray, " N"], Float[np.ndarray, "N d"]
    ]
    | None = None,
) -> str:
    """An SVG for notebooks, in the plane of the first two states that every chart has. If there is
    only one such state, it is drawn against time; if there is none, the text is empty.
    (`hj.plot.cycle` draws a large figure.)

    **Arguments:** `sections`: times, charts and states at sections, as of `Trajectory.dense`.
    """
    s = orbit.structure
    turn = orbit.dense()
    everywhere = [
        name
        for name in s.state_names()
        if all(name in chart.states for chart in s.charts)
    ]
    names = everywhere[:2]
    if not names:
        return ""

    def axes(t, chart, q) -> list:
        return [t, *observed(s, names, t, chart, q)][-2:]

    chart = turn[1]
    x, y = axes(*turn)
    curves = []
    for a in np.unique(chart):
        name = s.names[a] if len(s.names) > 1 else ""
        color = CHARTS[a % len(CHARTS)]
        in_chart = np.where(chart == a, x, np.nan)
        curves.append(Curve(in_chart, y, name, color))
    if sections is not None:
        x, y = axes(*sections)
        curves.append(Curve(x, y, color="currentColor", points=True))
    units = [("t", orbit.system.time_unit), *((name, unit_of(name)) for name in names)]
    labels = [with_unit(name, unit) for name, unit in units[-2:]]
    return picture(curves, *labels)


def fine_factors(cycle: LimitCycle) -> list[Matrix]:
    """Jacobians over one turn from the anchor, each over a few steps of the flow, in sizes of the
    states. For an autonomous system the direction of the flow is left out.

    A single step of an explicit method does not contract much, so that every multiplier keeps its
    digits.
    """
    map = hosted(cycle).return_map
    structure = map.structure
    record = last_turn(cycle)
    moves = recorded_moves(*record)
    by = linear_moves(structure, moves, recorded_ends(map, record[0]))[1]
    frames = _frames(map, moves)
    factors: list[Matrix] = []
    for k, (size, basis) in enumerate(frames):
        size_after, basis_after = frames[(k + 1) % len(frames)]
        derivative = by[k, : len(size_after), : len(size)]
        scaled = in_sizes(derivative, size, size_after)
        parts = basis_after.T, scaled, basis
        factor = np.linalg.multi_dot(parts)
        # (Rounding errors in place of a zero would become a multiplier.)
        norms = [np.linalg.norm(x) for x in parts]
        least = np.finfo(float).eps * np.prod(norms)
        factor = np.where(np.abs(factor) > least, factor, 0.0)
        merged = factor @ factors[-1] if factors else factor
        if factors and weakest(merged) > WEAKEST:
            factors[-1] = merged
        else:
            factors.append(factor)
    return factors


def _frames(map: ReturnMap, moves: Any) -> list[tuple[Float[np.ndarray, " m"], Matrix]]:
    """For the beginning of each move, the sizes of time and states, and a basis of deviations in
    these sizes. In an autonomous system, the basis is orthogonal to the flow, at equal times."""
    s = map.structure
    u = np.zeros((s.nu, 1))
    fields = slopes(s, moves.t, moves.chart, moves.q, u).T
    frames: list[tuple[np.ndarray, Matrix]] = []
    for chart, field, at_once in zip(moves.chart, fields, moves.at_once, strict=True):
        n = s.dims[chart]
        sizes = map.scale[chart, :n]
        if map.base is None:
            basis = np.eye(1 + n)
        elif at_once:  # (there is no flow before it)
            basis = np.eye(1 + n)[:, 1:]
        else:
            scaled = field[None, :n] / sizes
            _, _, directions = np.linalg.svd(scaled)
            across = directions[1:].T
            basis = np.pad(across, [(1, 0), (0, 0)])
        frames.append((np.append(map.expected, sizes), basis))
    return frames


def derived_if_found(cycle: LimitCycle) -> LimitCycle:
    """A traced cycle, with derivatives of NaN if the search has failed."""
    found = jnp.isin(cycle.result, jnp.array(_FOUND))

    def numbers(x: LimitCycle):
        return x.period, x.anchor.q, x.pieces.t, x.pieces.q, x.factors

    of_system = jax.tree_util.tree_leaves(
        eqx.filter(cycle.system, eqx.is_inexact_array)
    )
    derived = _derived_where(found, numbers(cycle), tuple(of_system))
    return eqx.tree_at(numbers, cycle, derived)


@jax.custom_jvp
def _derived_where(found: Array, numbers: tuple, of_system: tuple) -> tuple:
    return numbers


@_derived_where.defjvp
def _derived_where_jvp(primals, tangents):
    """Derivatives by all parameters are NaN if there is no cycle. (A turn that fails stops early,
    so that reverse mode would give zero instead of NaN.)"""
    found, numbers, _ = primals
    _, by_numbers, by_system = tangents
    factor = jnp.where(found, 1.0, jnp.nan)
    spread = (factor - 1) * sum(jnp.sum(x) for x in by_system)
    return numbers, tuple(x * factor + spread for x in by_numbers)


def log_determinant(cycle: LimitCycle) -> float:
    """The logarithm of the determinant of the monodromy of a cycle without events: the divergence
    of the field, integrated over one turn.

    If a mode decays within one step of an implicit method, its multiplier is lost; the determinant
    contains it.
    """
    flow = linear_flow(cycle)
    divergence = np.trace(flow.by_state, axis1=2, axis2=3)
    return float(flow.length @ divergence @ rule().weights)


def orbit(cycle: LimitCycle) -> Trajectory:
    """One period from the anchor, in the steps that are also linearized."""
    map = to_host(cycle.return_map)
    _, tape = last_turn(cycle)

    def turn() -> Trajectory:
        begin = map.departure(map.anchor.q[:, 0])
        u = np.zeros((map.structure.nu, 1))
        count = tape.t.shape[-1]
        pieces = [Tape(*(x[..., k, None] for x in tape)) for k in range(count)]
        return recorded(map.structure, begin, pieces, u, Result.OK)

    return _trajectories.recall(cycle, 1.0, turn)


def weakest(factor: Matrix, weaker: int = 0) -> float:
    """The gain of a factor in its weakest direction, relative to the gain in its strongest
    direction, or to 1 if that is smaller. `weaker`: number of weakest directions that are left
    out."""
    singular = np.linalg.svd(factor, compute_uv=False)
    if len(singular) <= weaker:
        return np.inf
    return singular[-1 - weaker] / max(singular[0], 1.0)
