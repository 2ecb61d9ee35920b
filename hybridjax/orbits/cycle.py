"""Limit cycles: fixed points of the return map, by Newton with its exact Jacobian."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Int

from .._core.compile import quick_jit
from .._core.memo import remembered
from .._core.precision import require_x64
from .._core.results import Result
from .._core.tracing import is_traced
from ..engine.lanes import Lanes
from ..engine.settings import LIMIT_CYCLE, Settings
from ..engine.target import until
from ..engine.trajectory import Trajectory, simulate
from ..engine.watch import slopes, watch
from ..errors import ComputationError, DefinitionError
from ..linear.multipliers import product_eigenvalues
from ..sections.families import AtEvent, Crossing
from ..systems.structure import Structure, check_system
from ..systems.system import Guess, HybridSystem
from .guess import begin
from .return_map import ReturnMap, solve


class LimitCycle(eqx.Module):
    """A periodic orbit of a hybrid system.

    **Fields:**

    - `period`: in the system's unit of time; of all its `turns`.
    - `start`: the state at which it is anchored, on the section `base` (a clock section at
        `start.t` if `base` is `None`).
    - `legs`: states at the beginnings of the pieces into which the turn is cut.
    - `factors`: Jacobians of the flow over the pieces, padded with zeros. The valid block of
        `factors[n]` is [:dims[n+1], :dims[n]].
    - `residual`: largest distance between `start` and where it is after one period.
    - `iterations`: Newton steps taken.
    - `result`: a `Result` code.
    - `settings`: accuracy of the flow.
    - `conserved`: values of conserved quantities that were asked for, by name.
    - `turns`: periods of the clock, or meetings with the section, in one period of the cycle.
    """

    system: HybridSystem
    base: Crossing | AtEvent | None
    period: Float[Array, ""]
    start: Lanes
    legs: Lanes
    factors: Float[Array, "K d d"]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]
    order: tuple[int, ...] = eqx.field(static=True)
    """Transitions of one turn, in order, from the start."""
    settings: Settings
    conserved: dict[str, Float[Array, ""]]
    turns: int = eqx.field(static=True)

    @property
    def clocked(self) -> bool:
        """Whether a clock drives the system."""
        return self.system.period() is not None

    @property
    def dims(self) -> Int[np.ndarray, " K"]:
        """Numbers of states at the beginnings of the pieces."""
        _require_values(self, "dims")
        return np.array(Structure(self.system).dims)[np.asarray(self.legs.chart)]

    @remembered
    def multipliers(self) -> Complex[np.ndarray, " r"]:
        """The non-zero Floquet multipliers, the largest first (on the host).

        Computed from the factors without forming their product, so that small ones are right
        too; zeros that stem from resets and sections are counted by rank and left out. Each
        conserved quantity that the cycle was chosen by stands for a multiplier of exactly 1.
        """
        _require_values(self, "multipliers")
        dims, factors = self.dims, np.asarray(self.factors)
        after = np.roll(dims, -1)
        blocks = [f[: after[n], : dims[n]] for n, f in enumerate(factors)]
        values = product_eigenvalues(blocks, rtol=1e-9)
        values[np.argsort(np.abs(values - 1))[: len(self.conserved)]] = 1
        values = values[np.argsort(-np.abs(values), kind="stable")]
        values.flags.writeable = False  # they are kept
        return values

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie inside the unit circle, but for those of exactly 1 that
        stand for conserved quantities."""
        inside = np.abs(self.multipliers) < 1
        return bool(np.sum(inside) == len(inside) - len(self.conserved))

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
        if self.conserved:
            multipliers += f" (1: conserved {', '.join(self.conserved)})"
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
    turns: int | None = None,
    conserved: Mapping[str, ArrayLike] | None = None,
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
    - `turns`: periods of the clock, or returns to the section, until the cycle closes: 2 for the
        cycle that a period doubling leaves behind. By default 1, or the guess's.
    - `conserved`: the values at which conserved quantities are wanted, by the names of outputs,
        e.g. `{"energy": 1784.8}`. Cycles then come in families, with a multiplier of exactly 1 for
        each quantity, and this picks one of them. By default none, or the guess's.
    - `settle`: time to simulate before Newton begins, so that transients die out (the paper
        takes 60 s). No help where the cycle is unstable.
    - `max_period`: for autonomous systems: give up if no return is seen in this time.
    - `settings`: accuracy of the flow; 1e-12 by default.
    - `throw`: raise on failure; otherwise the cycle's `result` says what went wrong.

    **Raises:** `DefinitionError` for bad arguments, `ComputationError` if no isolated cycle is
    found: no convergence, an event or section that does not come, grazing, an equilibrium in
    place of a cycle, or a singular J - I (there is a whole family of cycles, from a conserved
    quantity or a symmetry; see `conserved`).

    Under a JAX transformation of `system`, give a `LimitCycle` as the guess: the cycle is then
    followed by implicit differentiation. Its `result` says whether it was found; derivatives of a
    cycle that was not found mean nothing, and are NaN as a rule.
    """
    settings = Settings(rtol=LIMIT_CYCLE, atol=LIMIT_CYCLE) if settings is None else settings
    traced = is_traced((system, conserved))
    if not traced:
        require_x64(system)
        check_system(system)
    clocked = system.period() is not None
    if isinstance(guess, LimitCycle):
        base = guess.base if section is None else section
        start, expected, order = guess.start, guess.period, guess.order
        if turns not in (None, guess.turns):
            raise DefinitionError(
                f"the guess closes after {guess.turns} turns, not {turns}: give a Guess."
            )
        turns = guess.turns
        conserved = guess.conserved if conserved is None else conserved
    elif traced:
        raise DefinitionError(
            "under a JAX transformation find_limit_cycle needs a LimitCycle as its guess: find "
            "one outside, and pass it as `guess`."
        )
    else:
        turns = 1 if turns is None else turns
        start, base, expected = begin(system, guess, section, turns, settle, max_period, settings)
        order = None
    if clocked:
        expected = turns * jnp.asarray(system.period(), float)
    conserved = {k: jnp.asarray(v, float) for k, v in (conserved or {}).items()}
    if not traced:
        _check_values(system, start, conserved)
    kind = ReturnMap(base, conserved, turns)
    solution = solve(system, start, kind, expected, settings, False, traced)
    if not traced and int(solution[-1]) == Result.EXTRA_TURNS:
        seen = solution[3]
        expected = seen.period * turns / seen.meetings
        solution = solve(system, solution[0], kind, expected, settings, False, False)
    if not traced and int(solution[-1]) not in (Result.OK, Result.SINGULAR, Result.EQUILIBRIUM):
        # Newton may have stepped out of the domain of the return map: smaller steps.
        second = solve(system, start, kind, expected, settings, True, False, 64)
        solution = second if int(second[-1]) == Result.OK else solution
    start, period, factors, seen, steps, result = solution
    if not traced:
        order = tuple(int(g) for g in np.ravel(seen.codes) if g >= 0)
    cycle = LimitCycle(
        system, base, period, start, seen.legs, factors, seen.distance, steps, result, order,
        settings, conserved, turns,
    )  # fmt: skip
    if not traced and int(result) in (Result.OK, Result.SINGULAR):
        if clocked:
            _check_clock(cycle)
        if conserved:
            _check_conserved(cycle)
    if not traced and throw and (code := Result(int(result))) != Result.OK:
        raise ComputationError(_explain(cycle, code))
    return cycle


def _check_values(system: HybridSystem, start: Lanes, conserved) -> None:
    s = Structure(system)
    s.resolve_outputs(tuple(conserved)).require(int(start.chart[0]))
    for name, value in conserved.items():
        if value.shape != () or not np.isfinite(value):
            raise DefinitionError(f"the conserved '{name}' must be one finite number; got {value}.")


def _check_conserved(cycle: LimitCycle) -> None:
    """Raise where a quantity that should be conserved is not: its gradient is then no left
    eigenvector of the monodromy."""
    s = Structure(cycle.system)
    a, t = int(cycle.start.chart[0]), cycle.start.t[0]
    q, u = cycle.start.q[: s.dims[a], 0], jnp.zeros(s.nu)
    monodromy = np.eye(s.d)
    for factor in np.asarray(cycle.factors):
        monodromy = factor @ monodromy
    outputs = s.resolve_outputs(tuple(cycle.conserved))
    gradients = np.asarray(jax.jacfwd(lambda q: outputs(a, t, q, u))(q))
    for name, gradient in zip(outputs.names, gradients, strict=True):
        after = gradient @ monodromy[: s.dims[a], : s.dims[a]]
        if not np.allclose(after, gradient, rtol=0, atol=1e-6 * np.max(np.abs(gradient))):
            raise DefinitionError(
                f"'{name}' is not conserved by {type(cycle.system).__name__}: neighbors of the "
                "cycle change it in one turn. Leave it out of `conserved`."
            )


def _check_clock(cycle: LimitCycle) -> None:
    """Raise where the cycle of a clocked system is not what it seems to be."""
    s, system = Structure(cycle.system), cycle.system
    a, t = int(cycle.start.chart[0]), float(cycle.start.t[0])
    f, later, guards, rates = jax.device_get(_at_start(cycle))
    f, later = f[: s.dims[a]], later[: s.dims[a]]
    if not np.allclose(f, later, rtol=1e-6, atol=1e-9):
        raise ComputationError(
            f"the field of chart '{s.names[a]}' does not have the period {float(cycle.period):.6g} "
            f"that {type(system).__name__}.period() states: at t = {t:.6g} it is {f}, one period "
            f"later {later}."
        )
    due = (rates < 0) & (np.abs(guards) <= -1e-9 * float(cycle.period) * rates)
    if due.any():
        raise ComputationError(
            f"the search begins exactly at the event '{s.transitions[int(np.argmax(due))].name}', "
            "which may or may not belong to the turn: give a guess at another time."
        )


@quick_jit
def _at_start(cycle: LimitCycle):
    """The field at the start (d,) and one period later, the guards there (G,) and their rates."""
    s, start = Structure(cycle.system), cycle.start
    u, later = jnp.zeros((s.nu, 1)), start.t + cycle.period
    f = [slopes(s, t, start.chart, start.q, u)[:, 0] for t in (start.t, later)]
    seen = watch(s, start.t, start.chart, start.q, u, until(start.t), jnp.ones(1, bool))
    return *f, seen.value[:-1, 0], seen.rate[:-1, 0]


def _explain(cycle: LimitCycle, code: Result) -> str:
    name = type(cycle.system).__name__
    if code == Result.SINGULAR:
        return (
            f"the return map of {name} has a multiplier of exactly 1 (J - I is singular), so its "
            "cycles form a family: a quantity is conserved, or there is a symmetry. Say which one "
            "is wanted by the value of the quantity (an output of the system), e.g. "
            "`conserved={'energy': 1.0}`, or take the one nearest to the guess with `throw=False`."
        )
    reason = code.message
    if code == Result.NOT_CONVERGED and np.isnan(cycle.residual):
        reason = "Newton came to a state from where one period ends in another chart"
    elif code == Result.NOT_CONVERGED:
        reason = f"Newton did not converge (residual {float(cycle.residual):.2g})"
        if cycle.conserved:
            reason += f"; perhaps not all of {', '.join(cycle.conserved)} are conserved"
    return (
        f"no limit cycle of {name} was found: {reason}. Try a better guess, or let it settle first "
        "if the cycle is stable, e.g. `settle=60 * period`."
    )
