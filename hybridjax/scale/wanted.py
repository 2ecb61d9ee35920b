"""What a sweep keeps of limit cycles."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from .._core.pieces.layout import Constant, Variable
from .._core.results import Result
from .._core.signal import unit_of
from ..errors import ComputationError, DefinitionError
from ..orbits.cycle import LimitCycle
from ..orbits.limit_cycles import LimitCycles
from ..systems.structure import Structure


Want = Literal["period", "state", "multipliers", "spectral_radius", "events", "residual"]
Measure = Callable[[LimitCycle], Any]

# Events of a cycle that are kept, for each of those that the longest one of the coarse pass has.
_MORE_EVENTS = 4


class Wanted:
    """What is kept of each cycle: quantities by name, and what users' functions say of it."""

    def __init__(self, names: Sequence[Want], measures: Mapping[str, Measure]):
        self.names, self.measures = tuple(dict.fromkeys(names)), dict(measures)
        for name in {*self.names, "result", "chart"} & set(self.measures):
            raise DefinitionError(
                f"`measures` has a function of the name `{name}`, which is taken."
            )

    def variables(self, cycles: LimitCycles) -> dict[str, Variable]:
        """What results look like, as a few cycles show.

        **Raises:** `ComputationError` if none of these was found, where that has to be known.
        """
        s = Structure(cycles[0].system)
        codes = {"flag_values": [int(x) for x in Result], "flag_meanings": _meanings(Result)}
        found = {"result": Variable("<i8", attributes=codes)}
        unit = {"units": str(s.system.time_unit)} if s.system.time_unit else {}
        d = cycles.multipliers.shape[1]
        charts = {"flag_values": list(range(len(s.names))), "flag_meanings": " ".join(s.names)}
        names = [t.name for t in s.transitions]
        events = {"flag_values": list(range(len(names))), "flag_meanings": " ".join(names)}
        known: dict[str, dict[str, Variable]] = {
            "period": {"period": Variable("<f8", attributes=unit)},
            "state": {
                "state": Variable("<f8", ("state_name",), (len(_states(s)),)),
                "chart": Variable("<i8", attributes=charts),
            },
            "multipliers": {"multipliers": Variable("<c16", ("multiplier",), (d,))},
            "spectral_radius": {"spectral_radius": Variable("<f8")},
            "events": {
                "events": Variable(
                    "<i8", ("event",), (_MORE_EVENTS * cycles.codes.shape[1],), events
                )
            },
            "residual": {"residual": Variable("<f8")},
        }
        for name in self.names:
            found |= known[name]
        for name, values in self._first(cycles).items():
            dims = tuple(f"{name}_{i}" for i in range(values.ndim))
            found[name] = Variable(values.dtype.str, dims, values.shape)
        return found

    def constants(self, cycles: LimitCycles) -> dict[str, Constant]:
        """Coordinates of results, beside the parameters."""
        if "state" not in self.names:
            return {}
        states = _states(Structure(cycles[0].system))
        units = np.array([str(unit_of(x)) for x in states])
        return {
            "state_name": Constant(("state_name",), np.array([str(x) for x in states])),
            "state_unit": Constant(("state_name",), units),
        }

    def _first(self, cycles: LimitCycles) -> dict[str, np.ndarray]:
        """What users' functions say of the first cycle on which they succeed."""
        found: dict[str, np.ndarray] = {}
        for name, measure in self.measures.items():
            error = None
            for i in np.flatnonzero(cycles.ok):
                try:
                    found[name] = _numbers(name, measure(cycles[i]))
                    break
                except ComputationError as failure:
                    error = failure
            else:
                raise ComputationError(
                    f"`{name}` succeeds on none of {len(cycles)} points that are spread over all, "
                    f"so it is not known what it gives ({error or 'none has a limit cycle'})."
                )
        return found

    def values(
        self, cycles: LimitCycles, variables: Mapping[str, Variable]
    ) -> dict[str, np.ndarray]:
        """Results of some cycles."""
        found: dict[str, np.ndarray] = {"result": np.asarray(cycles.result, int)}
        for name in self.names:
            found |= getattr(self, f"_{name}")(cycles, variables)
        for name, measure in self.measures.items():
            found[name] = self._measured(cycles, name, measure, variables[name])
        return found

    def _period(self, cycles, variables):
        return {"period": np.where(cycles.ok, cycles.period, np.nan)}

    def _residual(self, cycles, variables):
        return {"residual": np.asarray(cycles.residual)}

    def _multipliers(self, cycles, variables):
        return {"multipliers": cycles.multipliers}

    def _spectral_radius(self, cycles, variables):
        return {"spectral_radius": np.abs(cycles.multipliers).max(axis=1)}

    def _events(self, cycles, variables):
        width = variables["events"].shape[0]
        codes = np.where(cycles.ok[:, None], cycles.codes, -1)[:, :width]
        fill = ((0, 0), (0, width - codes.shape[1]))
        return {"events": np.pad(codes.astype(int), fill, constant_values=-1)}

    def _state(self, cycles, variables):
        s = Structure(cycles[0].system)
        names, chart = _states(s), np.asarray(cycles.anchor.chart)[:, 0]
        q = np.asarray(cycles.anchor.q)[..., 0]
        state = np.full((len(cycles), len(names)), np.nan)
        for a in np.unique(chart[cycles.ok]):
            rows = np.flatnonzero(cycles.ok & (chart == a))
            own = [names.index(x) for x in s.charts[a].states]
            state[np.ix_(rows, own)] = q[rows, : len(own)]
        return {"state": state, "chart": np.where(cycles.ok, chart, -1).astype(int)}

    def _measured(self, cycles, name: str, measure: Measure, variable: Variable) -> np.ndarray:
        out = np.full((len(cycles), *variable.shape), variable.fill, variable.dtype)
        for i in np.flatnonzero(cycles.ok):
            try:
                values = _numbers(name, measure(cycles[i]))
            except ComputationError:
                continue
            if values.shape != variable.shape:
                raise DefinitionError(
                    f"`{name}` must give arrays of one shape, not {variable.shape} and "
                    f"{values.shape}."
                )
            if values.dtype.kind == "c" and out.dtype.kind != "c":
                raise DefinitionError(
                    f"`{name}` must give real numbers or complex ones, not both: let it always "
                    "return complex ones."
                )
            out[i] = values
        return out


def _numbers(name: str, values: Any) -> np.ndarray:
    found = np.asarray(values)
    if found.dtype.kind not in "biufc":
        raise DefinitionError(f"`{name}` must give numbers, not a {type(values).__name__}.")
    return found.astype(complex if found.dtype.kind == "c" else float)


def _states(s: Structure) -> list[str]:
    """Names of the states of all charts."""
    return list(dict.fromkeys(x for a in range(len(s.charts)) for x in s.states(a)))


def _meanings(codes: Any) -> str:
    return " ".join(x.name.lower() for x in codes)
