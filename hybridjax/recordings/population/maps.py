"""`PopulationMaps`: curves and maps of several subjects, their mean, and tests of differences.

Sign flips of paired differences, and permutations of the labels of groups, leave the joint
distribution of a map unchanged if there is no difference. The largest |t| of each relabeling
therefore gives p-values and bands that hold the family-wise error at each point (Nichols and Holmes
2002).
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Inexact

from ..._core.arguments import Numbers, require_axes
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Seed, Vector
from ..._core.boundary.values import Complexes
from ..._core.text import p_value
from .tables import Columns, require, rows_with, signed, table_of


@dataclasses.dataclass(frozen=True, repr=False)
class MapResult:
    """A mean, or a tested difference, of the maps of subjects.

    **Fields:** `values` (*grid): the mean or difference. `each` (n, *grid): maps of the subjects,
    or paired differences (none of groups). `reach` (*grid): half the width of the simultaneous 95 %
    band (a radius for complex maps). `t` (*grid): the statistic; `p` (*grid): of each point, by the
    largest statistic. `significant` (*grid): points where the band does not contain zero. `axes`,
    `unit`, `methods`.
    """

    values: Inexact[np.ndarray, "*grid"]
    each: Inexact[np.ndarray, "n *grid"]
    reach: Float[np.ndarray, "*grid"]
    t: Float[np.ndarray, "*grid"]
    p: Float[np.ndarray, "*grid"]
    significant: Bool[np.ndarray, "*grid"]
    axes: dict[str, np.ndarray]
    unit: str
    methods: str

    def __repr__(self) -> str:
        size, t = np.abs(self.values).max(), np.abs(self.t).max()
        inside = zip(self.axes.items(), np.nonzero(self.significant), strict=True)
        spans = (
            f"{n} {x[i].min():.3g} to {x[i].max():.3g}"
            for (n, x), i in inside
            if len(i)
        )
        where = ", ".join(spans) or "none"
        largest = f"largest {size:.4g} {self.unit}".rstrip()
        half_width = f"{np.median(self.reach):.3g} {self.unit}".rstrip()
        return (
            f"MapResult({' x '.join(self.axes)}: {largest}\n"
            f"  median half-width of the 95 % band {half_width}\n"
            f"  largest |t| {t:.3g}, {p_value(float(self.p.min()))}\n"
            f"  significant: {self.significant.sum()} of {self.t.size} points, {where})"
        )


@checked
class PopulationMaps:
    """Curves or maps of several subjects on one grid.

    **Arguments:**

    - `table`: as for `Population`; several rows of a subject, group and condition are averaged.
    - `values` (rows, *grid): real or complex; `response.values[:, :, 0, 0]` of an
      `ImpulseResponses`, `htf.H[:, :, 0, 0]` of an `HTF` or `curve.values` of a `PhaseResponse`,
      stacked by `np.stack`.
    - `axes`: coordinates by name, in the order of the grid. `unit` of the values. Default: none.

    **Raises:** `DefinitionError` for shapes that do not fit together, and as `Population`.
    """

    def __init__(
        self,
        table: Columns,
        values: Annotated[Numbers, Complexes()],
        axes: Mapping[str, Vector],
        unit: str = "",
    ):
        values = np.asarray(values)
        self.values = values if values.imag.any() else values.real
        self.axes = {str(name): np.asarray(x, float) for name, x in axes.items()}
        self.table, self.unit = table_of(table, len(values)), unit
        grid = {name: len(x) for name, x in self.axes.items()}
        require_axes("`values`", values, {"rows": len(values)} | grid)

    def __repr__(self) -> str:
        count = self.table["subject"].nunique()
        return f"PopulationMaps({count} subjects, {len(self.values)} maps: {' x '.join(self.axes)})"

    def mean(
        self, label: str | None = None, *, draws: Count = 10_000, seed: Seed = 0
    ) -> MapResult:
        """Return the mean of a group or condition with a simultaneous 95 % band.

        The band has the width at which the largest |t| of sign flips of the deviations from the
        mean stays inside: all flips for up to 12 subjects, else `draws`.

        **Arguments:** `label`: a group or condition. Default: all rows.

        **Raises:** `DefinitionError` for an unknown label, or fewer than three subjects.
        """
        rows = ... if label is None else rows_with(self.table, label)[1].to_numpy()
        each = self._by_subject(np.arange(len(self.values))[rows])
        require({label or "all": each}, 3)
        y = np.stack(list(each.values()))
        text = f"Mean of {len(y)} subjects with a simultaneous 95 % band"
        return self._result(y, np.ones(len(y)), y - y.mean(axis=0), draws, seed, text)

    def difference(
        self, a: str, b: str, *, draws: Count = 10_000, seed: Seed = 0
    ) -> MapResult:
        """Test the difference a - b of two conditions (sign flips of paired differences) or two
        groups (permutations of labels), with a family-wise error of 5 % over all points.

        **Arguments:** `draws`: number of relabelings for more than 12 subjects (all for fewer).
        Default: 10000.

        **Raises:** `DefinitionError` for labels that are no two conditions or groups, and for fewer
        than three subjects in both conditions, or in a group.
        """
        factor, _ = rows_with(self.table, a, b)
        label = self.table[factor].to_numpy()
        first, second = (self._by_subject(np.flatnonzero(label == x)) for x in (a, b))
        if factor == "condition":
            pairs = {s: y - second[s] for s, y in first.items() if s in second}
            require({f"{a} and {b}": pairs}, 3)
            y, true = np.stack(list(pairs.values())), np.ones(len(pairs))
        else:
            require({a: first, b: second}, 3)
            y = np.stack([*first.values(), *second.values()])
            true = np.repeat([1.0, -1.0], [len(first), len(second)])
        text = f"Maps of {len(y)} subjects ({a} - {b}) with a family-wise error of 5 %"
        return self._result(y, true, y, draws, seed, text)

    def _by_subject(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        groups = self.table.iloc[rows].groupby("subject", sort=False).groups
        return {
            str(name): self.values[index].mean(axis=0) for name, index in groups.items()
        }

    def _result(
        self, y, true: np.ndarray, null, draws: int, seed: int, text: str
    ) -> MapResult:
        """Return the mean, or of two groups the difference, with the band and p-values of the
        largest statistics of relabeled maps `null`."""
        paired, grid = bool((true > 0).all()), y.shape[1:]
        signs = relabelings(true, paired, draws, np.random.default_rng(seed))
        step = max(1, 8_000_000 // y[0].size)  # statistics of a part fit into 64 MB
        parts = (signs[i : i + step] for i in range(0, len(signs), step))
        largest = [np.abs(moments(null, part, paired)[2]).max(axis=1) for part in parts]
        largest = np.sort(np.concatenate(largest))
        value, error, t = (x.reshape(grid) for x in moments(y, true[None], paired))
        # Up to rounding; the true labels count, too.
        count = len(largest) - np.searchsorted(largest, np.abs(t) * (1 - 1e-9))
        reach = np.quantile(largest, 0.95, method="higher") * error
        amount = "all" if len(true) <= 12 else "random"
        way = f"{len(signs)} {'sign flips' if paired else 'permutations of labels'}"
        methods = signed(f"{text}, by the largest |t| of {amount} {way}.")
        each, p = y if paired else y[:0], np.maximum(count, 1) / len(largest)
        inside = np.abs(value) > reach
        return MapResult(
            value, each, reach, t, p, inside, self.axes, self.unit, methods
        )


def relabelings(
    true: Float[np.ndarray, " n"], paired: bool, draws: int, rng: np.random.Generator
) -> Float[np.ndarray, "P n"]:
    """Return weights +1 and -1 of the subjects, the true ones among them: of up to 12 subjects all
    flips of signs (those of all signs alike give the same) or divisions into two groups."""
    if len(true) > 12:
        signs = rng.permuted(np.tile(true, (draws, 1)), axis=1)
        signs = rng.choice([-1.0, 1.0], signs.shape) if paired else signs
        return np.concatenate([true[None], signs[1:]])
    signs = np.array(list(itertools.product([1.0, -1.0], repeat=len(true))))
    return signs[signs[:, 0] > 0] if paired else signs[signs.sum(axis=1) == true.sum()]


def moments(
    y: Inexact[np.ndarray, "n *grid"], signs: Float[np.ndarray, "P n"], paired: bool
):
    """Return means or differences of two means, standard errors and Student's t for each relabeling
    (P, V); of complex maps |t|, the root of the F ratio of a complex mean."""
    n, y = len(y), y.reshape(len(y), -1)
    square = np.sum(np.abs(y) ** 2, axis=0)
    if paired:
        mean = signs @ y / n
        variance = (square / n - np.abs(mean) ** 2) / (n - 1)
    else:
        is_first = (signs > 0).astype(float)
        k = is_first[0].sum()
        a, b = is_first @ y / k, (1 - is_first) @ y / (n - k)
        mean = a - b
        inside = square - k * np.abs(a) ** 2 - (n - k) * np.abs(b) ** 2
        variance = inside / (n - 2) * (1 / k + 1 / (n - k))
    # A map that is zero in all subjects has no statistic.
    error = np.sqrt(np.maximum(variance, 1e-24 * np.maximum(square / n, 1e-290)))
    return mean, error, (np.abs(mean) if np.iscomplexobj(mean) else mean) / error
