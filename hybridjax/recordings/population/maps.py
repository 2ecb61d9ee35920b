"""`PopulationMaps`: curves and maps of several subjects, their mean, and tests of differences."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Inexact, Int

from ... import __version__
from ..._core.arguments import Numbers, channel_index
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, OptionalNames, Probability, Seed, Vector
from ..._core.boundary.values import Complexes
from ..._core.signal import ratio, unit_of
from ..._core.text import p_value
from ...errors import DefinitionError
from ...linear.htf import HTF
from ..beats.response import PhaseResponse, curve_unit
from ..impulse import ImpulseResponses
from .permutations import (
    clusters,
    in_parts,
    label_permutations,
    masses,
    point_threshold,
    sign_flips,
    statistics,
)
from .table import Columns, as_columns, require_subjects, rows_with


Curves = Sequence[ImpulseResponses] | Sequence[PhaseResponse] | Sequence[HTF]


@dataclasses.dataclass(frozen=True, repr=False)
class MapMean:
    """Mean of the maps of n subjects, with a band that holds all of the true mean.

    **Fields:** `values` (*grid); `reach` (*grid): half the width of the band (a radius for complex
    maps); `each` (n, *grid): the maps; `axes`, `unit`; `level`; `methods`.
    """

    values: Inexact[np.ndarray, "*grid"]
    reach: Float[np.ndarray, "*grid"]
    each: Inexact[np.ndarray, "n *grid"]
    axes: dict[str, np.ndarray]
    unit: str
    level: float
    methods: str

    def __repr__(self) -> str:
        size = np.abs(self.values).max()
        return (
            f"MapMean({len(self.each)} subjects, {' x '.join(self.axes)}: largest "
            f"{size:.4g} {self.unit}".rstrip()
            + f", {100 * self.level:g} % band of +- {np.median(self.reach):.3g} (median))"
        )


@dataclasses.dataclass(frozen=True, repr=False)
class MapTest:
    """Difference of maps, tested with a family-wise error over all points.

    **Fields:** `values` (*grid): the mean difference. `t` (*grid): its statistic. `p` (*grid):
    p-value of each point by the largest statistic. `labels` (*grid): number of the cluster, 0
    outside; `cluster_p` (clusters,): their p-values. `significant` (*grid): points of the chosen
    method at `level`. `relabelings`, `exact`; `each`: paired differences (none of
    groups); `axes`, `unit`, `methods`.
    """

    values: Inexact[np.ndarray, "*grid"]
    t: Float[np.ndarray, "*grid"]
    p: Float[np.ndarray, "*grid"]
    labels: Int[np.ndarray, "*grid"]
    cluster_p: Float[np.ndarray, " clusters"]
    significant: Bool[np.ndarray, "*grid"]
    level: float
    relabelings: int
    exact: bool
    each: Inexact[np.ndarray, "n *grid"]
    axes: dict[str, np.ndarray]
    unit: str
    methods: str

    def __repr__(self) -> str:
        lines = [
            f"MapTest({' x '.join(self.axes)}, {self.relabelings} relabelings"
            f"{' (all)' * self.exact}: largest |t| {np.abs(self.t).max():.3g}, "
            f"{p_value(float(self.p.min()))})"
        ]
        for k in 1 + np.argsort(self.cluster_p, stable=True)[:3]:
            p = float(self.cluster_p[k - 1])
            inside = self.labels == k
            places = zip(self.axes.items(), np.nonzero(inside), strict=True)
            where = ", ".join(f"{n} {a[i].min():.3g} to {a[i].max():.3g}" for (n, a), i in places)
            lines.append(f"  cluster {k}: {inside.sum()} points, {where}, {p_value(p)}")
        more = len(self.cluster_p) - 3
        return "\n".join([*lines, *([f"  and {more} more clusters"] if more > 0 else [])])


@checked
class PopulationMaps:
    """Curves or maps of several subjects on one grid.

    **Arguments:**

    - `table`: as for `Population`; several rows of a subject, group and condition are averaged.
    - `values` (rows, *grid): real or complex.
    - `axes`: coordinates by name, in the order of the grid. `cyclic`: names of axes whose end
      meets their beginning, so that clusters continue there. Default: none.
    - `unit` of the values. Default: none.

    **Raises:** `DefinitionError` for shapes that do not fit together, and as `Population`.
    """

    def __init__(
        self,
        table: Columns,
        values: Annotated[Numbers, Complexes()],
        axes: Mapping[str, Vector],
        cyclic: OptionalNames = (),
        unit: str = "",
    ):
        values = np.asarray(values)
        values = values if values.imag.any() else values.real
        grid = tuple(len(np.asarray(x)) for x in axes.values())
        if values.shape[1:] != grid:
            raise DefinitionError(
                f"`values` must have the shape (rows, {', '.join(axes)}), with {grid} after the "
                f"rows, but has {values.shape}."
            )
        named = {str(name): np.asarray(x, float) for name, x in axes.items()}
        columns = as_columns(table, len(values))
        self.table, self.values, self.axes = columns, values, named
        self.cyclic, self.unit = tuple(cyclic), unit

    @classmethod
    def from_responses(
        cls, responses: Curves, table: Columns, *, output: str | int = 0, input: str | int = 0
    ) -> "PopulationMaps":
        """Return the maps of impulse responses (phase, lag), phase response curves (phase) or HTFs
        (harmonic, frequency) of one output to one input, with a row of the table for each.

        **Raises:** `DefinitionError` if names, units or grids differ between subjects.
        """
        rows = [_map_of(x, output, input) for x in responses]
        subjects = as_columns(table, len(rows))["subject"]
        for k, (_, axes, _, unit, names) in enumerate(rows):
            alike = all(np.array_equal(axes[n], a) for n, a in rows[0][1].items() if n in axes)
            differs = (
                "signals" if names != rows[0][4] else "units" if unit != rows[0][3]
                else "" if alike and axes.keys() == rows[0][1].keys() else "grids"
            )  # fmt: skip
            if differs:
                raise DefinitionError(
                    f"{differs} of subject '{subjects[k]}' differ from those of '{subjects[0]}': "
                    "compute all responses with the same signals, units, sections and lags."
                )
        _, axes, cyclic, unit, _ = rows[0]
        return cls(table, np.stack([row[0] for row in rows]), axes, cyclic, unit)

    def __repr__(self) -> str:
        count = len(set(self.table["subject"]))
        return f"PopulationMaps({count} subjects, {len(self.values)} maps: {' x '.join(self.axes)})"

    def mean(
        self,
        label: str | None = None,
        *,
        level: Probability = 0.95,
        draws: Count = 10_000,
        seed: Seed = 0,
    ) -> MapMean:
        """Return the mean of a group or condition with a simultaneous band.

        The band has the width at which the largest statistic of sign flips of the deviations from
        the mean stays inside: all flips for up to 12 subjects, else `draws`.

        **Arguments:** `label`: a group or condition. Default: all rows.

        **Raises:** `DefinitionError` for an unknown label, or fewer than three subjects.
        """
        rows = None if label is None else rows_with(self.table, (label,))[1]
        _, maps = self._by_subject(rows)
        n, flat = len(maps), maps.reshape(len(maps), -1)
        relabelings = sign_flips(n, draws, np.random.default_rng(seed))
        mean = flat.mean(axis=0)
        largest = _largest(flat - mean, relabelings.signs[1:], True)
        error = np.sqrt(np.sum(np.abs(flat - mean) ** 2, axis=0) / n / (n - 1))
        reach = np.quantile(largest, level, method="higher") * error
        grid = maps.shape[1:]
        text = (
            f"Mean over {n} subjects with a simultaneous band of {100 * level:g} % from the "
            f"largest statistic of {len(relabelings.signs)} sign flips"
            f"{' (all)' * relabelings.exact}; hybridjax {__version__}."
        )
        return MapMean(
            mean.reshape(grid), reach.reshape(grid), maps, self.axes, self.unit, level, text
        )

    def difference(
        self,
        a: str,
        b: str,
        *,
        statistic: Literal["clusters", "maximum"] = "clusters",
        point_level: Probability = 0.01,
        level: Probability = 0.05,
        draws: Count = 10_000,
        seed: Seed = 0,
    ) -> MapTest:
        """Test the difference a - b of two conditions (sign flips of paired differences) or two
        groups (permutations of labels), with the family-wise error held over all points.

        **Arguments:**

        - `statistic`: "clusters": mass (sum of |t|) of connected points beyond the threshold of
          `point_level`; "maximum": largest |t|. Default: "clusters".
        - `point_level`: probability with which a single point exceeds the threshold. Default: 0.01.
        - `level`: family-wise error. Default: 0.05.
        - `draws`: number of relabelings for more than 12 subjects (all for fewer). Default: 10000.

        **Raises:** `DefinitionError` for labels that are no two conditions or groups, and for fewer
        than three subjects in both conditions, or in a group.
        """
        factor, rows = rows_with(self.table, (a, b))
        rng = np.random.default_rng(seed)
        keys, maps = self._by_subject(rows, factor)
        if factor == "condition":
            index = {key: i for i, key in enumerate(keys)}
            both = [s for s, label in keys if label == a and (s, b) in index]
            if len(both) < 3:
                raise DefinitionError(
                    f"{len(both)} subjects have both '{a}' and '{b}': three or more are needed."
                )
            y = np.stack([maps[index[s, a]] - maps[index[s, b]] for s in both])
            relabelings, paired = sign_flips(len(y), draws, rng), True
        else:
            labels = np.array([label for _, label in keys])
            require_subjects(labels, np.array([s for s, _ in keys]), 3)
            y, paired = maps, False
            relabelings = label_permutations(labels == a, draws, rng)
        grid, cyclic = y.shape[1:], tuple(name in self.cyclic for name in self.axes)
        flat = y.reshape(len(y), -1)
        threshold = point_threshold(point_level, len(y), paired, np.iscomplexobj(y))
        t = statistics(flat, relabelings.signs[:1], paired).reshape(grid)
        largest: list[np.ndarray] = []
        mass: list[np.ndarray] = []
        observed = np.zeros(0)
        for part in in_parts(len(relabelings.signs), flat.shape[1]):
            drawn = statistics(flat, relabelings.signs[part], paired)
            largest.append(np.abs(drawn).max(axis=1))
            drawn = drawn.reshape(-1, *grid)
            heaviest, first = masses(drawn, clusters(drawn, threshold, cyclic))
            observed = first if not mass else observed
            mass.append(heaviest)
        p = _exceeding(np.concatenate(largest), np.abs(t).ravel()).reshape(grid)
        cluster_p = _exceeding(np.concatenate(mass), observed)
        labels = clusters(t[None], threshold, cyclic)[0]
        numbers = np.unique(labels[labels > 0])
        labels = np.searchsorted(numbers, labels) + 1 if len(numbers) else labels
        labels = np.where(np.abs(t) > threshold, labels, 0)
        by_cluster = np.append(1.0, cluster_p)[labels]
        significant = (p if statistic == "maximum" else by_cluster) <= level
        way = "sign flips of paired differences" if paired else "permutations of group labels"
        method = "cluster mass" if statistic == "clusters" else "the maximum statistic"
        beyond = f" (points beyond p = {point_level:g})" if statistic == "clusters" else ""
        amount = "all" if relabelings.exact else "random"
        text = (
            f"Maps of {len(y)} subjects ({a} - {b}) were compared by {method}{beyond} with a "
            f"family-wise error of {100 * level:g} %, from {amount} {len(relabelings.signs)} "
            f"{way}; hybridjax {__version__}."
        )
        value = (
            y.mean(axis=0)
            if paired
            else (
                y[relabelings.signs[0] > 0].mean(axis=0) - y[relabelings.signs[0] < 0].mean(axis=0)
            )
        )
        return MapTest(
            value, t, p, labels, cluster_p, significant, level, len(relabelings.signs),
            relabelings.exact, y if paired else y[:0], self.axes, self.unit, text,
        )  # fmt: skip

    def _by_subject(self, rows=None, factor: str = "") -> tuple[list[tuple[str, str]], np.ndarray]:
        """Return the mean map of each subject (in each label of a factor)."""
        subjects = self.table["subject"]
        rows = np.ones(len(subjects), bool) if rows is None else rows
        labels = self.table[factor] if factor else np.full(len(subjects), "")
        keys = list(dict.fromkeys(zip(subjects[rows], labels[rows], strict=True)))
        require_subjects(np.array([k[1] or "all" for k in keys]), np.array([k[0] for k in keys]), 2)
        maps = [self.values[rows & (subjects == s) & (labels == c)].mean(axis=0) for s, c in keys]
        return keys, np.stack(maps)


def _largest(y, signs, paired: bool) -> np.ndarray:
    parts = in_parts(len(signs), y.shape[1])
    return np.concatenate([np.abs(statistics(y, signs[i], paired)).max(axis=1) for i in parts])


def _exceeding(draws: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the fraction of draws that are at least as large, up to rounding."""
    draws = np.sort(draws)
    return 1 - np.searchsorted(draws, values * (1 - 1e-9)) / len(draws)


def _map_of(x, output: str | int, input: str | int):
    """Return values, axes, cyclic axes, unit and names of one subject's response."""
    if isinstance(x, PhaseResponse):
        return x.values, {"phase": x.phase}, (), curve_unit(x.input), (str(x.input),)
    i, j = channel_index("output", output, x.outputs), channel_index("input", input, x.inputs)
    signals = (x.outputs[i], x.inputs[j])
    unit, names = ratio(*signals), tuple(map(str, signals))
    if isinstance(x, HTF):
        axes = {"harmonic": np.asarray(x.harmonics, float), "frequency": np.asarray(x.f)}
        return np.asarray(x.H)[:, :, i, j], axes, (), unit, names
    unit = unit and f"{unit_of(signals[0])}/({unit_of(signals[1])} s)"
    axes = {"phase": x.phase, "lag": x.lag}
    return x.values[:, :, i, j], axes, ("phase",), unit, names
