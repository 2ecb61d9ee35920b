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
from ..._core.showable import Showable
from ..._core.text import p_value
from .tables import Columns, require, rows_with, signed, table_of


# Subjects up to which all relabelings are tried, 4096 at most. More: time. Fewer: p-values scatter
# where they could be exact.
_ALL = 12

Maps = Inexact[np.ndarray, "n *grid"]
Signs = Float[np.ndarray, "P n"]
"""A relabeling in each row: the weight +1 or -1 of each subject."""


@dataclasses.dataclass(frozen=True, repr=False)
class MapResult(Showable):
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
        spans = []
        places = np.nonzero(self.significant)
        for (name, x), place in zip(self.axes.items(), places, strict=True):
            if len(place):
                spans.append(f"{name} {x[place].min():.3g} to {x[place].max():.3g}")
        where = ", ".join(spans) or "none"
        largest = f"{np.abs(self.values).max():.4g} {self.unit}".rstrip()
        half_width = f"{np.median(self.reach):.3g} {self.unit}".rstrip()
        return (
            f"MapResult({' x '.join(self.axes)}: largest {largest}\n"
            f"  median half-width of the 95 % band {half_width}\n"
            f"  largest |t| {np.abs(self.t).max():.3g}, {p_value(float(self.p.min()))}\n"
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

    **Example:**

    ```python
    phase = np.arange(8) / 8
    curves = np.sin(2 * np.pi * phase) + 0.1 * np.random.default_rng(0).normal(size=(5, 8))
    table = {"subject": ["S1", "S2", "S3", "S4", "S5"]}
    maps = hj.recordings.PopulationMaps(table, curves, {"phase": phase}, "mm/N")
    print(maps.mean())
    ```

    **Before:** `hj.recordings.impulse_responses`, `hj.recordings.phase_response`. **After:**
    `hj.plot.subject_maps`.
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
        self.table = table_of(table, len(values))
        self.unit = unit
        grid = {name: len(x) for name, x in self.axes.items()}
        require_axes("`values`", values, {"rows": len(values)} | grid)

    def __repr__(self) -> str:
        count = self.table["subject"].nunique()
        return f"PopulationMaps({count} subjects, {len(self.values)} maps: {' x '.join(self.axes)})"

    def mean(
        self,
        label: str | None = None,
        *,
        draws: Count = 10_000,
        seed: Seed = 0,
    ) -> MapResult:
        """Return the mean of a group or condition with a simultaneous 95 % band.

        The band has the width at which the largest |t| of sign flips of the deviations from the
        mean stays inside: all flips for up to 12 subjects, else `draws`.

        **Arguments:** `label`: a group or condition. Default: all rows.

        **Raises:** `DefinitionError` for an unknown label, or fewer than three subjects.
        """
        rows = np.arange(len(self.values))
        if label is not None:
            _, has_label = rows_with(self.table, label)
            rows = np.flatnonzero(has_label)
        each = self._by_subject(rows)
        require({label or "all": each}, 3)
        y = np.stack(list(each.values()))
        text = f"Mean of {len(y)} subjects with a simultaneous 95 % band"
        return self._result(y, np.ones(len(y)), y - y.mean(axis=0), draws, seed, text)

    def difference(
        self,
        a: str,
        b: str,
        *,
        draws: Count = 10_000,
        seed: Seed = 0,
    ) -> MapResult:
        """Test the difference a - b of two conditions (sign flips of paired differences) or two
        groups (permutations of labels), with a family-wise error of 5 % over all points.

        **Arguments:** `draws`: number of relabelings for more than 12 subjects (all for fewer).
        Default: 10000.

        **Raises:** `DefinitionError` for labels that are no two conditions or groups, and for fewer
        than three subjects in both conditions, or in a group.
        """
        factor, _ = rows_with(self.table, a, b)
        first = self._by_subject(np.flatnonzero(self.table[factor] == a))
        second = self._by_subject(np.flatnonzero(self.table[factor] == b))
        if factor == "condition":
            pairs = {s: y - second[s] for s, y in first.items() if s in second}
            require({f"{a} and {b}": pairs}, 3)
            y = np.stack(list(pairs.values()))
            true = np.ones(len(y))
        else:
            require({a: first, b: second}, 3)
            y = np.stack([*first.values(), *second.values()])
            true = np.repeat([1.0, -1.0], [len(first), len(second)])
        text = f"Maps of {len(y)} subjects ({a} - {b}) with a family-wise error of 5 %"
        return self._result(y, true, y, draws, seed, text)

    def _by_subject(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        by_subject = self.table.iloc[rows].groupby("subject", sort=False)
        return {
            str(name): self.values[index].mean(axis=0)
            for name, index in by_subject.groups.items()
        }

    def _result(
        self,
        y: np.ndarray,
        true: np.ndarray,
        null: np.ndarray,
        draws: int,
        seed: int,
        text: str,
    ) -> MapResult:
        """Return the mean, or of two groups the difference, with the band and p-values of the
        largest statistics of relabeled maps `null`."""
        paired = bool((true > 0).all())
        signs = relabelings(true, paired, draws, np.random.default_rng(seed))
        largest = _largest(null, signs, paired)
        value, error, t = moments(y, true[None], paired)
        # Up to rounding; the true labels count, too.
        below = np.searchsorted(largest, np.abs(t) * (1 - 1e-9))
        above = np.maximum(len(largest) - below, 1)
        reach = np.quantile(largest, 0.95, method="higher") * error
        amount = "all" if len(true) <= _ALL else "random"
        kind = "sign flips" if paired else "permutations of labels"
        grid = y.shape[1:]
        return MapResult(
            values=value.reshape(grid),
            each=y if paired else y[:0],
            reach=reach.reshape(grid),
            t=t.reshape(grid),
            p=(above / len(largest)).reshape(grid),
            significant=(np.abs(value) > reach).reshape(grid),
            axes=self.axes,
            unit=self.unit,
            methods=signed(
                f"{text}, by the largest |t| of {amount} {len(signs)} {kind}."
            ),
        )


def _largest(y: Maps, signs: Signs, paired: bool) -> Float[np.ndarray, " P"]:
    """Return the largest |t| over the grid of each relabeling, in ascending order."""
    at_once = max(1, 8_000_000 // y[0].size)  # statistics of a part fit into 64 MB
    largest = []
    for first in range(0, len(signs), at_once):
        _, _, t = moments(y, signs[first : first + at_once], paired)
        largest.append(np.abs(t).max(axis=1))
    return np.sort(np.concatenate(largest))


def relabelings(
    true: Float[np.ndarray, " n"],
    paired: bool,
    draws: int,
    rng: np.random.Generator,
) -> Signs:
    """Return weights +1 and -1 of the subjects, the true ones among them: of up to 12 subjects all
    flips of signs (those of all signs alike give the same) or divisions into two groups."""
    n = len(true)
    if n > _ALL:
        signs = rng.permuted(np.tile(true, (draws, 1)), axis=1)
        if paired:
            signs = rng.choice([-1.0, 1.0], signs.shape)
        signs[0] = true
        return signs
    signs = np.array(list(itertools.product([1.0, -1.0], repeat=n)))
    if paired:
        return signs[signs[:, 0] > 0]
    return signs[signs.sum(axis=1) == true.sum()]


def moments(y: Maps, signs: Signs, paired: bool):
    """Return means or differences of two means, standard errors and Student's t for each relabeling
    (P, V); of complex maps |t|, the root of the F ratio of a complex mean."""
    n = len(y)
    y = y.reshape(n, -1)
    square = np.sum(np.abs(y) ** 2, axis=0)
    if paired:
        mean = signs @ y / n
        variance = (square / n - np.abs(mean) ** 2) / (n - 1)
    else:
        is_first = (signs > 0).astype(float)
        k = is_first[0].sum()
        first = is_first @ y / k
        second = (1 - is_first) @ y / (n - k)
        mean = first - second
        within = square - k * np.abs(first) ** 2 - (n - k) * np.abs(second) ** 2
        variance = within / (n - 2) * (1 / k + 1 / (n - k))
    # A map that is zero in all subjects has no statistic.
    least = 1e-24 * np.maximum(square / n, 1e-290)
    error = np.sqrt(np.maximum(variance, least))
    if np.iscomplexobj(mean):
        return mean, error, np.abs(mean) / error
    return mean, error, mean / error
