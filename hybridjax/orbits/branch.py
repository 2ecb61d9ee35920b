"""A branch of limit cycles along a parameter, and the points at which its stability changes."""

from typing import Literal, NamedTuple, SupportsIndex, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from .._core.boundary.checked import checked_methods
from .._core.html import COLORS, Curve, card, complex_number, picture, table
from .._core.memo import remembered
from .._core.results import Result
from .coincidence import SAME
from .cycle import LimitCycle
from .limit_cycles import LimitCycles


Kind = Literal["fold", "branch point", "flip", "Neimark-Sacker"]
KINDS = get_args(Kind)


class BranchPoint(NamedTuple):
    """A point of a branch with a multiplier on the unit circle."""

    kind: str
    """"fold" (a multiplier +1: the branch turns back), "branch point" (+1: another branch crosses),
    "flip" (-1: a cycle of twice the period begins) or "Neimark-Sacker" (a complex pair)."""
    index: int  # type: ignore[assignment]  # (not the method of tuples)
    """Its row in the branch."""
    value: float
    """The value of the parameter."""
    multipliers: Complex[np.ndarray, " r"]
    """The critical ones among them lie on the unit circle to rounding."""

    @property
    def critical(self) -> Complex[np.ndarray, " c"]:
        """The multipliers on the unit circle."""
        return self.multipliers[np.abs(np.abs(self.multipliers) - 1) < SAME]


class BranchEnd(NamedTuple):
    """The end of a branch, and the reason."""

    value: float
    """The value of the parameter."""
    result: Result
    """`Result.OK` at the end of the values."""
    message: str


@checked_methods
class Branch(eqx.Module):
    """Limit cycles along one parameter, in their order on the branch.

    **Fields:**

    - `parameter`: its name. `values` (K,): its values.
    - `cycles`: the K cycles; `branch[k]` is one of them, with its system.
    - `points`: points at which multipliers cross the unit circle, each a row of the branch.
    - `ends`: the two ends of the branch, with their reasons.
    """

    parameter: str = eqx.field(static=True)
    values: Float[np.ndarray, " K"]
    cycles: LimitCycles
    points: tuple[BranchPoint, ...]
    ends: tuple[BranchEnd, BranchEnd]

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, k: SupportsIndex) -> LimitCycle:
        return self.cycles[k]

    def find(self, kind: Kind) -> tuple[BranchPoint, ...]:
        """The points of a kind: "fold", "branch point", "flip" or "Neimark-Sacker"."""
        return tuple(p for p in self.points if p.kind == kind)

    @remembered
    def multipliers(self) -> Complex[np.ndarray, "K r"]:
        """Floquet multipliers of every cycle, by decreasing modulus, padded with zeros."""
        rows = [self[k].multipliers for k in range(len(self))]
        width = max(map(len, rows))
        return np.array([np.pad(x.astype(complex), (0, width - len(x))) for x in rows])

    @remembered
    def stable(self) -> Bool[np.ndarray, " K"]:
        """True for each stable cycle. At a marked point itself rounding decides."""
        return np.array([self[k].stable for k in range(len(self))])

    def largest(self, output: str) -> Float[np.ndarray, " K"]:
        """The largest value of a state or output on each cycle, as accurate as a plot needs.

        **Raises:** `DefinitionError` for a name that does not exist.
        """
        return np.array([np.nanmax(self[k].trajectory()(output)[1]) for k in range(len(self))])

    def summary(self) -> str:
        """One line for each marked point and each end."""
        begin, end = self.ends
        lines = [f"from {self.parameter} = {begin.value:.9g}: {begin.message}"]
        for p in self.points:
            at = (f"{z.real:.6g}{z.imag:+.6g}j" if z.imag else f"{z.real:.9g}" for z in p.critical)
            at = ", ".join(at)
            lines.append(f"{p.kind} at {self.parameter} = {p.value:.12g} (multipliers {at})")
        lines.append(f"to {self.parameter} = {end.value:.9g}: {end.message}")
        return "\n  ".join(lines)

    def __repr__(self):
        name = type(self.cycles.systems).__name__
        return f"Branch({name} along {self.parameter}: {len(self)} cycles)\n  {self.summary()}"

    def _repr_html_(self) -> str:
        largest = np.abs(self.multipliers).max(axis=1)
        marks = [p.index for p in self.points]
        begin, end = self.ends
        rows = [("from", begin.value, begin.message)]
        rows += [(p.kind, p.value, ", ".join(map(complex_number, p.critical))) for p in self.points]
        rows += [("to", end.value, end.message)]
        rows = [(name, f"{value:.9g}", text) for name, value, text in rows]
        curves = [
            Curve(self.values[[0, -1]], np.ones(2), color=COLORS[-1]),
            Curve(self.values, largest),
            Curve(self.values[marks], largest[marks], color=COLORS[1], points=True),
        ]
        drawn = picture(curves, self.parameter, "largest modulus of multipliers")
        title = f"of {type(self.cycles.systems).__name__}: {len(self)} cycles"
        return card("Branch", title, table(("", self.parameter, ""), rows), drawn)
