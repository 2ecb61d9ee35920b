"""Limit cycles: fixed points of the return map, by Newton with its exact Jacobian."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Int

from .._core.compile import quick_jit
from .._core.errors import ComputationError, DefinitionError
from .._core.precision import require_x64
from .._core.results import Result
from .._core.tracing import is_traced
from ..flow.events import start_lanes
from ..flow.lanes import Lanes
from ..flow.move import Settings, move
from ..flow.sections import AtEvent, Crossing, ListLevels
from ..flow.target import toward
from ..flow.trajectory import Trajectory, simulate
from ..periodic.multipliers import product_eigenvalues
from ..systems.structure import Structure, check_system
from ..systems.system import Guess, HybridSystem
from ..systems.transition import Scheduled
from .return_map import solve


class _Plane(eqx.Module):
    """The hyperplane through a point, across the flow."""

    point: Array
    normal: Array

    def __call__(self, t, q):
        return jnp.dot(q - self.point, self.normal)


class LimitCycle(eqx.Module):
    """A periodic orbit of a hybrid system.

    **Fields:**

    - `period`: in the system's unit of time.
    - `start`: the state at which it is anchored, on the section `base` (a clock section at
        `start.t` if `base` is `None`).
    - `legs`: states at the beginnings of the pieces into which the turn is cut.
    - `factors`, `dims`: Jacobians of the flow over the pieces, padded with zeros. The valid block
        of `factors[n]` is [:dims[n+1], :dims[n]].
    - `residual`: largest distance between `start` and where it is after one period.
    - `iterations`: Newton steps taken.
    - `result`: a `Result` code.
    - `settings`: accuracy of the flow.
    """

    system: HybridSystem
    base: Crossing | AtEvent | None
    period: Float[Array, ""]
    start: Lanes
    legs: Lanes
    factors: Float[Array, "K d d"]
    dims: Int[Array, " K"]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]
    order: tuple[int, ...] = eqx.field(static=True)
    """Transitions of one turn, in order, from the start."""
    settings: Settings

    @property
    def clocked(self) -> bool:
        """Whether a clock drives the system."""
        return self.system.period() is not None

    @property
    def multipliers(self) -> Complex[np.ndarray, " r"]:
        """The non-zero Floquet multipliers, the largest first (on the host).

        Computed from the factors without forming their product, so that small ones are right
        too; zeros that stem from resets and sections are counted by rank and left out.
        """
        _require_values(self, "multipliers")
        dims = np.asarray(self.dims)
        factors = np.asarray(self.factors)
        after = np.roll(dims, -1)
        blocks = [f[: after[n], : dims[n]] for n, f in enumerate(factors)]
        return product_eigenvalues(blocks, rtol=1e-9)

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie inside the unit circle."""
        return bool(np.all(np.abs(self.multipliers) < 1))

    @property
    def state(self) -> dict[str, float]:
        """The state at `start`, by name."""
        _require_values(self, "state")
        chart = Structure(self.system).charts[int(self.start.chart[0])]
        return dict(zip(chart.states, self.start.q[:, 0].tolist(), strict=False))

    def trajectory(self, periods: float = 1.0) -> Trajectory:
        """The orbit from `start` on, with its events, dense enough to plot."""
        _require_values(self, "trajectory")
        s = Structure(self.system)
        a = int(self.start.chart[0])
        return simulate(
            self.system,
            s.names[a],
            self.start.q[: s.dims[a], 0],
            float(self.period) * periods,
            time=float(self.start.t[0]),
            settings=self.settings,
        )

    def __repr__(self):
        if is_traced(self):
            return f"LimitCycle({type(self.system).__name__}, traced)"
        names = [tr.name for tr in Structure(self.system).transitions]
        events = ", ".join(names[g] for g in self.order) or "none"
        state = ", ".join(f"{k} = {v:.9g}" for k, v in self.state.items())
        multipliers = ", ".join(_format(z) for z in self.multipliers) or "none but zero"
        return (
            f"LimitCycle({type(self.system).__name__}: {Result(int(self.result)).message})\n"
            f"  period       {float(self.period):.12g}\n"
            f"  at t = {float(self.start.t[0]):.6g}   {state}\n"
            f"  events       {events}\n"
            f"  multipliers  {multipliers}\n"
            f"  residual     {float(self.residual):.2g} after {int(self.iterations)} Newton steps"
        )


def _require_values(cycle: LimitCycle, name: str) -> None:
    if is_traced(cycle):
        raise DefinitionError(
            f"`{name}` of a limit cycle needs its values, which a JAX transformation hides: use "
            "its arrays (`start`, `period`, `factors`) there, or `linearize(...).monodromy()`."
        )


def _format(z: complex) -> str:
    return f"{z.real:.9g}" if z.imag == 0 else f"{z.real:.9g}{z.imag:+.9g}j"


def find_limit_cycle(
    system: HybridSystem,
    guess: Guess | LimitCycle | None = None,
    *,
    section: Crossing | AtEvent | None = None,
    settle: ArrayLike = 0.0,
    max_period: ArrayLike = 100.0,
    settings: Settings | None = None,
    throw: bool = True,
) -> LimitCycle:
    """Find a limit cycle by Newton on the return map; stable or not makes no difference.

    Where Newton fails, as it does if it steps out of the domain of the return map, the search is
    repeated with the smaller steps of Levenberg and Marquardt.

    A clocked system has its clock's period, and the return map is taken at the guess's phase of
    the clock. The period of an autonomous one is found; its return map lives on `section`.

    **Arguments:**

    - `guess`: a rough `Guess`, by default the model's own. A `LimitCycle` of a similar system is
        the best guess.
    - `section`: for autonomous systems: where the return map is taken, e.g. `Crossing("v",
        "falling")` or `AtEvent("heelstrike")`. By default the plane through the guess across the
        flow. Newton starts at the guess if it lies on the section, else where the flow from the
        guess first meets it.
    - `settle`: time to simulate before Newton begins, so that transients die out (the paper
        takes 60 s). No help where the cycle is unstable.
    - `max_period`: for autonomous systems: give up if no return is seen in this time.
    - `settings`: accuracy of the flow; 1e-12 by default.
    - `throw`: raise on failure; otherwise the cycle's `result` says what went wrong.

    **Raises:** `DefinitionError` for bad arguments, `ComputationError` if no isolated cycle is
    found: no convergence, an event or section that does not come, grazing, an equilibrium in
    place of a cycle, or a singular J - I (there is a whole family of cycles, from a conserved
    quantity or a symmetry).

    Under a JAX transformation of `system`, give a `LimitCycle` as the guess: the cycle is then
    followed by implicit differentiation. Its `result` says whether it was found; derivatives of a
    cycle that was not found mean nothing, and are NaN as a rule.
    """
    settings = Settings(rtol=1e-12, atol=1e-12) if settings is None else settings
    traced = is_traced(system)
    if not traced:
        require_x64(system)
        check_system(system)
    clocked = system.period() is not None
    if isinstance(guess, LimitCycle):
        base = guess.base if section is None else section
        start, expected, order = guess.start, guess.period, guess.order
    elif traced:
        raise DefinitionError(
            "under a JAX transformation find_limit_cycle needs a LimitCycle as its guess: find "
            "one outside, and pass it as `guess`."
        )
    else:
        start, base, expected = _prepare(system, guess, section, settle, max_period, settings)
        order = None
    if clocked:
        expected = jnp.asarray(system.period(), float)
    solution = solve(system, start, base, expected, settings, False, traced)
    if not traced and int(solution[-1]) not in (Result.OK, Result.SINGULAR, Result.EQUILIBRIUM):
        # Newton may have stepped out of the domain of the return map: smaller steps.
        second = solve(system, start, base, expected, settings, True, False, 64)
        solution = second if int(second[-1]) == Result.OK else solution
    start, period, factors, seen, steps, result = solution
    if not traced:
        order = tuple(int(g) for g in np.ravel(seen.codes) if g >= 0)
    dims = jnp.array(Structure(system).dims)[seen.legs.chart]
    cycle = LimitCycle(
        system, base, period, start, seen.legs, factors, dims, seen.distance, steps, result,
        order, settings,
    )  # fmt: skip
    if not traced and int(result) in (Result.OK, Result.SINGULAR):
        _check_clock(cycle)
    if not traced and throw and (code := Result(int(result))) != Result.OK:
        raise ComputationError(_explain(cycle, code))
    return cycle


def _check_clock(cycle: LimitCycle) -> None:
    """Raise where the cycle of a clocked system is not what it seems to be."""
    if not cycle.clocked:
        return
    s, system = Structure(cycle.system), cycle.system
    a = int(cycle.start.chart[0])
    t, q, u = cycle.start.t[0], cycle.start.q[: s.dims[a], 0], jnp.zeros(s.nu)
    f = s.field(a, t, q, u)
    later = s.field(a, t + cycle.period, q, u)
    if not np.allclose(f, later, rtol=1e-6, atol=1e-9):
        raise ComputationError(
            f"the field of chart '{s.names[a]}' does not have the period {float(cycle.period):.6g} "
            f"that {type(system).__name__}.period() states: at t = {float(t):.6g} it is {f}, one "
            f"period later {later}."
        )
    for g in s.guards(a):
        guard = lambda t, q, g=g: s.guard(g, t, q, u)  # noqa: E731
        value, rate = jax.jvp(guard, (t, q), (jnp.ones_like(t), f))
        if float(rate) < 0 and abs(float(value)) <= 1e-9 * float(cycle.period) * -float(rate):
            raise ComputationError(
                f"the search begins exactly at the event '{s.transitions[g].name}', which may or "
                "may not belong to the turn: give a guess at another time."
            )


def _prepare(system, guess, section, settle, max_period, settings):
    """Start state, base section and expected period, from a guess."""
    s = Structure(system)
    guess = system.guess() if guess is None else guess
    if not isinstance(guess, Guess | None):
        raise DefinitionError(
            f"the guess is a Guess(chart, state) or a LimitCycle, not {type(guess).__name__}."
        )
    if guess is None:
        raise DefinitionError(
            f"{type(system).__name__} has no guess of its own: pass `guess=Guess(chart, state)`."
        )
    a = s.chart_index(guess.chart)
    if guess.state.shape != (s.dims[a],) or not np.all(np.isfinite(guess.state)):
        raise DefinitionError(
            f"the guess must give finite values for the {s.dims[a]} states "
            f"{', '.join(s.charts[a].states)} of chart '{guess.chart}'; got {guess.state}."
        )
    if not np.isfinite(guess.time):
        raise DefinitionError(f"the guess's time must be finite; got {guess.time}.")
    for name, value in (("settle", settle), ("max_period", max_period)):
        if not (np.isfinite(value) and value >= 0):
            raise DefinitionError(f"{name} must be a finite time, not negative; got {value}.")
    period = system.period()
    if period is not None and not (np.isfinite(period) and period > 0):
        raise DefinitionError(f"the clock's period must be positive; it is {period}.")
    for transition in s.transitions:
        if isinstance(transition.guard, Scheduled):
            ratio = np.inf if period is None else float(period / transition.guard.period)
            if not abs(ratio - round(min(ratio, 1e9))) < 1e-6:
                raise DefinitionError(
                    f"the schedule of '{transition.name}' must divide the clock's period, which is "
                    f"{period}: otherwise no turn is like the last one."
                )
    if period is not None and section is not None:
        raise DefinitionError(
            "a clocked system returns to itself after its clock's period: leave out `section` "
            "(sections of any kind are for linearize and run_experiments)."
        )
    if section is not None:
        section.check(s)
    q = jnp.zeros((s.d, 1)).at[: s.dims[a], 0].set(guess.state)
    lanes = start_lanes(s, guess.time[None], jnp.array([a], jnp.int32), q)
    if settle:
        turns = float(settle) if period is None else np.ceil(settle / period) * float(period)
        moved = _go(system, lanes, None, toward(lanes.t + turns, -1, lanes.t + turns), settings)
        _require(moved, "settling", s)
        lanes = moved.lanes
        if period is not None:
            lanes = eqx.tree_at(lambda x: x.t, lanes, lanes.t - turns)
    if period is not None:
        return lanes, None, jnp.asarray(period, float)
    a = int(lanes.chart[0])
    t, q = lanes.t[0], lanes.q[: s.dims[a], 0]
    f = s.field(a, t, q, jnp.zeros(s.nu))
    if not jnp.any(f != 0):
        raise ComputationError(
            f"the search starts at an equilibrium of chart '{s.names[a]}', {q}, from where nothing "
            "moves: start elsewhere."
        )
    if section is None:
        section = Crossing(_Plane(q, f / jnp.linalg.norm(f)), "rising", charts=(s.names[a],))
    event = s.transition_index(section.name) if isinstance(section, AtEvent) else -1

    def next_meeting(lanes, doing):
        target = toward(jnp.full(1, jnp.inf), event, lanes.t + max_period)
        moved = _go(system, lanes, section, target, settings)
        _require(moved, f"{doing} ({section})", s)
        return moved.lanes

    if not _is_on(section, s, a, t, q, f, max_period):
        lanes = next_meeting(lanes, "looking for the section")
    back = next_meeting(lanes, "looking for the return to the section")
    return lanes, section, back.t[0] - lanes.t[0]


def _is_on(section, s: Structure, a: int, t, q, f, span) -> bool:
    """Whether (t, q) in chart a lies on a section, crossing it the right way."""
    if isinstance(section, AtEvent) or not section.in_chart(s, a):
        return False
    level = lambda t, q: section.level(s, a, t, q)  # noqa: E731
    value, rate = jax.jvp(level, (t, q), (jnp.ones_like(t), f))
    return bool((rate < 0) & (jnp.abs(value) <= -1e-9 * span * rate))


def _require(moved, doing: str, s: Structure) -> None:
    result = Result(int(moved.result[0]))
    if result != Result.OK:
        lanes = moved.lanes
        raise ComputationError(
            f"{doing} failed at t = {float(lanes.t[0]):.6g} in chart "
            f"'{s.names[int(lanes.chart[0])]}': {result.message}. Check the guess and the guards "
            "with `simulate(..., throw=False)`."
        )


@quick_jit
def _go(system, lanes, section, target, settings):
    """One lane to a time, or to one section, however many steps it takes."""
    s = Structure(system)
    settings = dataclasses.replace(settings, max_steps=1_000_000)
    if isinstance(section, Crossing):
        target = dataclasses.replace(target, levels=ListLevels((section,)))
    return move(system, lanes, jnp.zeros((s.nu, 1)), target, settings)


def _explain(cycle: LimitCycle, code: Result) -> str:
    name = type(cycle.system).__name__
    if code == Result.SINGULAR:
        return (
            f"the return map of {name} has a multiplier of exactly 1 (J - I is singular), so its "
            "cycles form a family: a quantity is conserved, or there is a symmetry. Fix that "
            "quantity in the model, or take the cycle nearest to the guess with `throw=False`."
        )
    reason = code.message
    if code == Result.NOT_CONVERGED and np.isnan(cycle.residual):
        reason = "Newton came to a state from where one period ends in another chart"
    elif code == Result.NOT_CONVERGED:
        reason = f"Newton did not converge (residual {float(cycle.residual):.2g})"
    return (
        f"no limit cycle of {name} was found: {reason}. Try a better guess, or let it settle first "
        "if the cycle is stable, e.g. `settle=60 * period`."
    )
