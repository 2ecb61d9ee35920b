"""`Wanted`: the quantities that a sweep keeps of limit cycles, by name or as functions of users.

`sweeps.py` calls `variables` once for the names, axes and types of results, and `values` for the
cycles of each piece; `draws.py` uses the functions at the end. A new quantity is a name in `Want`,
a line in `Wanted._values`, and its axes and units in `Wanted.variables`. Both must agree on names,
types and shapes, since all pieces go into one store. If a value is NaN without need, look at
`_values` (cycles that were not found) or `_measured` (a user's function that raises
`ComputationError`); if a user's function is refused, at `Wanted.__init__` and `stacked`.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, cast, get_args

import numpy as np

from .._core.pieces.store import Constant, Variable, flags, result_flags
from .._core.signal import unit_of
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.limit_cycles import LimitCycles
from ..systems.structure import Structure
from ..systems.system import HybridSystem


Want = Literal["period", "state", "multipliers", "spectral_radius", "residual"]
Measure = Callable[[LimitCycle], Any]


class Wanted:
    """Quantities to keep of each cycle: those with a name, and users' functions."""

    def __init__(
        self,
        quantities: Want | Measure | Sequence[Want | Measure],
        system: HybridSystem,
    ):
        is_one = isinstance(quantities, str) or callable(quantities)
        items: list[Any] = [quantities] if is_one else list(cast(Sequence, quantities))
        self.names = tuple(dict.fromkeys(x for x in items if isinstance(x, str)))
        functions = [x for x in items if not isinstance(x, str)]
        self.measures = {getattr(f, "__name__", ""): f for f in functions}
        taken = {*get_args(Want), "result", "chart", "state_name", "state_unit"}
        own = [x for x in self.measures if x.isidentifier() and x not in taken]
        if len(own) < len(functions):
            raise DefinitionError(
                "functions of `quantities` need names of their own, other than "
                f"{', '.join(sorted(taken))}: define them by `def`."
            )
        # (Only the words that are needed are kept: workers get a copy of this object.)
        s = Structure(system)
        self._charts = tuple(s.names)
        self._time_unit = str(system.time_unit or "")
        self._states = [tuple(s.states(a)) for a in range(len(s.charts))]
        self._all_states = list(dict.fromkeys(itertools.chain(*self._states)))

    def variables(self, cycles: LimitCycles) -> dict[str, Variable]:
        """Return the form of results, given some cycles.

        **Raises:** `ComputationError` if a function succeeds on none of them.
        """
        values = self._values(cycles)
        for name, measure in self.measures.items():
            values[name] = self._first(cycles, name, measure)[None]
        dims = {"state": ("state_name",), "multipliers": ("multiplier",)}
        attributes = {
            "result": result_flags(),
            "period": {"units": self._time_unit} if self._time_unit else {},
            "chart": flags({name: code for code, name in enumerate(self._charts)}),
        }
        variables = {}
        for name, array in values.items():
            x = form(name, array[0])
            about = attributes.get(name, {})
            variables[name] = x._replace(dims=dims.get(name, x.dims), attributes=about)
        return variables

    def constants(self) -> dict[str, Constant]:
        """Return the coordinates of results beside the parameters."""
        if "state" not in self.names:
            return {}
        texts = {"state_name": map(str, self._all_states)}
        texts["state_unit"] = map(unit_of, self._all_states)
        return {
            name: (("state_name",), np.array([*x]), {}) for name, x in texts.items()
        }

    def values(
        self, cycles: LimitCycles, chosen: Mapping[str, Variable]
    ) -> dict[str, np.ndarray]:
        """Return the results of some cycles."""
        values = self._values(cycles)
        for name, measure in self.measures.items():
            values[name] = stacked(name, _measured(cycles, name, measure), chosen[name])
        return values

    def _values(self, cycles: LimitCycles) -> dict[str, np.ndarray]:
        """Return the quantities with a name."""
        ok = cycles.ok
        q = np.asarray(cycles.anchor.q)[..., 0]
        chart = np.asarray(cycles.anchor.chart)[:, 0]
        state = np.full((len(ok), len(self._all_states)), np.nan)
        for a, names in enumerate(self._states):
            rows = np.flatnonzero(ok & (chart == a))
            columns = np.array([self._all_states.index(x) for x in names], int)
            state[np.ix_(rows, columns)] = q[rows, : len(names)]
        every = {
            "period": np.where(ok, cycles.period, np.nan),
            "state": state,
            "multipliers": cycles.multipliers,
            "spectral_radius": np.abs(cycles.multipliers).max(axis=1),
            "residual": np.asarray(cycles.residual),
        }
        values: dict[str, np.ndarray] = {"result": np.asarray(cycles.result, int)}
        values |= {name: every[name] for name in self.names}
        if "state" in self.names:
            values["chart"] = np.where(ok, chart, -1).astype(int)
        return values

    def _first(self, cycles: LimitCycles, name: str, measure: Measure) -> np.ndarray:
        """Return the value of a function on the first cycle on which it succeeds."""
        error = None
        for i in np.flatnonzero(cycles.ok):
            try:
                return as_numbers(name, measure(cycles[i]))
            except ComputationError as failure:
                error = failure
        raise ComputationError(
            f"`{name}` succeeds on none of {len(cycles)} points over all "
            f"({error or 'none has a limit cycle'})."
        )


def _measured(
    cycles: LimitCycles, name: str, measure: Measure
) -> Iterator[np.ndarray | None]:
    """Yield the value of a function on each cycle, None where it fails."""
    for i, ok in enumerate(cycles.ok):
        try:
            yield as_numbers(name, measure(cycles[i])) if ok else None
        except ComputationError:
            yield None


def as_numbers(name: str, values: Any) -> np.ndarray:
    """Return what a user's function gives as an array of real or complex numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in "biufc":
        raise DefinitionError(
            f"`{name}` must give numbers, not a {type(values).__name__}."
        )
    return array.astype(complex if array.dtype.kind == "c" else float)


def form(name: str, values: np.ndarray) -> Variable:
    """Return the form of results of which these are one."""
    dims = tuple(f"{name}_{j}" for j in range(values.ndim))
    return Variable(values.dtype.str, dims, values.shape)


def stacked(
    name: str, values: Iterable[np.ndarray | None], variable: Variable
) -> np.ndarray:
    """Return values of a user's function in one array, the variable's fill where it failed (None).

    **Raises:** `DefinitionError` for another shape, and for complex numbers after real ones.
    """
    rows = [np.full(variable.shape, variable.fill) if x is None else x for x in values]
    for x in rows:
        if x.shape != variable.shape or not np.can_cast(x.dtype, variable.dtype):
            raise DefinitionError(
                f"`{name}` must always give one type and shape: first {variable.dtype} "
                f"{variable.shape}, then {x.dtype.str} {x.shape}."
            )
    return np.array(rows, variable.dtype)
