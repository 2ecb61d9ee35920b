"""`PopulationMaps`: curves and maps of several subjects, their mean, and tests of differences."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated

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
from ..impulse import ImpulseResponses
from .permutations import clusters, exceeding, largest, point_threshold, relabelings, statistics
from .tables import Columns, as_columns, require, rows_with


@dataclasses.dataclass(frozen=True, repr=False)
class MapResult:
    """A mean, or a tested difference, of the maps of subjects.

    **Fields:** `values` (*grid): the mean or difference. `each` (n, *grid): maps of the subjects,
    or paired differences (none of groups). `reach` (*grid): half the width of the band (a radius
    for complex maps) of a mean, NaN of a difference. `t` (*grid): the statistic; `p` (*grid): of
    each point, by the largest statistic. `labels` (*grid): number of the cluster, 0 outside;
    `cluster_p` (clusters,). `significant` (*grid): points of significant clusters, or where the
    band does not contain zero. `axes`, `unit`, `methods`.
    """

    values: Inexact[np.ndarray, "*grid"]
    each: Inexact[np.ndarray, "n *grid"]
    reach: Float[np.ndarray, "*grid"]
    t: Float[np.ndarray, "*grid"]
    p: Float[np.ndarray, "*grid"]
    labels: Int[np.ndarray, "*grid"]
    cluster_p: Float[np.ndarray, " clusters"]
    significant: Bool[np.ndarray, "*grid"]
    axes: dict[str, np.ndarray]
    unit: str
    methods: str

    def __repr__(self) -> str:
        size = f"{np.abs(self.values).max():.4g} {self.unit}".rstrip()
        band = f"band of +- {np.median(self.reach):.3g} (median)"
        test = f"largest |t| {np.abs(self.t).max():.3g}, {p_value(float(self.p.min()))}"
        end = test if np.isnan(self.reach).all() else band
        lines = [f"MapResult({' x '.join(self.axes)}: largest {size}, {end})"]
        for k in 1 + np.argsort(self.cluster_p, stable=True)[:3]:
            places = zip(self.axes.items(), np.nonzero(self.labels == k), strict=True)
            where = ", ".join(f"{n} {a[i].min():.3g} to {a[i].max():.3g}" for (n, a), i in places)
            lines.append(f"  cluster {k}: {(self.labels == k).sum()} points, {where}, "
                         f"{p_value(float(self.cluster_p[k - 1]))}")  # fmt: skip
        more = len(self.cluster_p) - 3
        return "\n".join([*lines, *[f"  and {more} more clusters"] * (more > 0)])


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
        self, table: Columns, values: Annotated[Numbers, Complexes()], axes: Mapping[str, Vector],
        cyclic: OptionalNames = (), unit: str = "",
    ):  # fmt: skip
        values = np.asarray(values)
        values = values if values.imag.any() else values.real
        self.axes = {str(name): np.asarray(x, float) for name, x in axes.items()}
        grid = tuple(map(len, self.axes.values()))
        if values.shape[1:] != grid:
            raise DefinitionError(
                f"`values` must have the shape (rows, {', '.join(axes)}), with {grid} after the "
                f"rows, but has {values.shape}."
            )
        self.table, self.values = as_columns(table, len(values)), values
        self.cyclic, self.unit = tuple(cyclic), unit

    @classmethod
    def from_responses(
        cls, responses: Sequence[ImpulseResponses], table: Columns, *, output: str | int = 0,
        input: str | int = 0,
    ) -> "PopulationMaps":  # fmt: skip
        """Return the maps (phase, lag) of impulse responses of one output to one input, with a row
        of the table for each.

        **Raises:** `DefinitionError` if names, units or grids differ between subjects.
        """
        subjects = as_columns(table, len(responses))["subject"]
        first = responses[0]
        i = channel_index("output", output, first.outputs)
        j = channel_index("input", input, first.inputs)
        y, u = first.outputs[i], first.inputs[j]
        axes = {"phase": first.phase, "lag": first.lag}
        expected = [(str(n), unit_of(n)) for n in (*first.outputs, *first.inputs)]
        for subject, x in zip(subjects, responses, strict=True):
            alike = np.array_equal(x.phase, first.phase) and np.array_equal(x.lag, first.lag)
            signals = [(str(n), unit_of(n)) for n in (*x.outputs, *x.inputs)]
            if not alike or signals != expected:
                raise DefinitionError(
                    f"{'units or signals' if alike else 'grids'} of subject '{subject}' differ "
                    f"from those of '{subjects[0]}': compute all responses alike."
                )
        unit = f"{unit_of(y)}/({unit_of(u)} s)" if ratio(y, u) else ""
        values = np.stack([x.values[:, :, i, j] for x in responses])
        return cls(table, values, axes, ("phase",), unit)

    def __repr__(self) -> str:
        count = len(set(self.table["subject"]))
        return f"PopulationMaps({count} subjects, {len(self.values)} maps: {' x '.join(self.axes)})"

    def mean(
        self, label: str | None = None, *, level: Probability = 0.95, draws: Count = 10_000,
        seed: Seed = 0,
    ) -> MapResult:  # fmt: skip
        """Return the mean of a group or condition with a simultaneous band.

        The band has the width at which the largest statistic of sign flips of the deviations from
        the mean stays inside: all flips for up to 12 subjects, else `draws`.

        **Arguments:** `label`: a group or condition. Default: all rows.

        **Raises:** `DefinitionError` for an unknown label, or fewer than three subjects.
        """
        all_rows = np.ones(len(self.values), bool)
        rows = all_rows if label is None else rows_with(self.table, (label,))[1]
        subjects, _, maps = self._by_subject(rows)
        n = len(maps)
        require(np.full(n, label or "all"), subjects, 3)
        signs = relabelings(np.ones(n), True, draws, np.random.default_rng(seed))
        mean = maps.mean(axis=0)
        points, _ = largest(maps - mean, signs[1:], True, np.inf, self._cyclic())
        error = np.sqrt(np.sum(np.abs(maps - mean) ** 2, axis=0) / n / (n - 1))
        reach = np.quantile(points, level, method="higher") * error
        t = statistics(maps.reshape(n, -1), signs[:1], True).reshape(mean.shape)
        text = f"Mean of {n} subjects with a simultaneous band of {100 * level:g} % from {{}}."
        return MapResult(
            mean, maps, reach, t, exceeding(points, np.abs(t)), np.zeros(t.shape, int), np.zeros(0),
            np.abs(mean) > reach, self.axes, self.unit, _methods(text, signs, "sign flips"),
        )  # fmt: skip

    def difference(
        self, a: str, b: str, *, point_level: Probability = 0.01, level: Probability = 0.05,
        draws: Count = 10_000, seed: Seed = 0,
    ) -> MapResult:  # fmt: skip
        """Test the difference a - b of two conditions (sign flips of paired differences) or two
        groups (permutations of labels), with the family-wise error held over all points.

        Clusters are connected points beyond the threshold of `point_level`, with the sum of |t| as
        their mass.

        **Arguments:**

        - `point_level`: probability with which a single point exceeds the threshold. Default: 0.01.
        - `level`: family-wise error. Default: 0.05.
        - `draws`: number of relabelings for more than 12 subjects (all for fewer). Default: 10000.

        **Raises:** `DefinitionError` for labels that are no two conditions or groups, and for fewer
        than three subjects in both conditions, or in a group.
        """
        factor, rows = rows_with(self.table, (a, b))
        subjects, labels, y = self._by_subject(rows, factor)
        paired = factor == "condition"
        if paired:
            side = [dict(zip(subjects[labels == x], y[labels == x], strict=True)) for x in (a, b)]
            both = [s for s in side[0] if s in side[1]] or [""]
            require(np.full(len(both), f"{a} and {b}"), np.array(both), 3)
            y = np.stack([side[0][s] - side[1][s] for s in both])
        else:
            require(labels, subjects, 3)
        n = len(y)
        true = np.ones(n) if paired else np.where(labels == a, 1.0, -1.0)
        signs = relabelings(true, paired, draws, np.random.default_rng(seed))
        threshold = point_threshold(point_level, n - 2 + paired, np.iscomplexobj(y))
        t = statistics(y.reshape(n, -1), signs[:1], paired).reshape(1, *y.shape[1:])
        points, masses = largest(y, signs, paired, threshold, self._cyclic())
        (regions,), (t,) = clusters(t, threshold, self._cyclic()), t
        mass = np.bincount(regions.ravel(), np.abs(t).ravel())
        cluster_p = exceeding(masses, mass[1:])
        value = y.mean(axis=0) if paired else y[true > 0].mean(axis=0) - y[true < 0].mean(axis=0)
        text = (
            f"Maps of {n} subjects ({a} - {b}) were compared by cluster mass (points beyond "
            f"p = {point_level:g}) with a family-wise error of {100 * level:g} %, from {{}}."
        )
        return MapResult(
            value, y if paired else y[:0], np.full(t.shape, np.nan), t,
            exceeding(points, np.abs(t)), regions, cluster_p,
            np.append(1.0, cluster_p)[regions] <= level,
            self.axes, self.unit,
            _methods(text, signs, "sign flips" if paired else "permutations of labels"),
        )  # fmt: skip

    def _cyclic(self) -> tuple[bool, ...]:
        return tuple(name in self.cyclic for name in self.axes)

    def _by_subject(self, rows: np.ndarray, factor: str = ""):
        """Return subjects, labels and the mean map of each subject (in each label of a factor)."""
        subjects = self.table["subject"]
        labels = self.table[factor] if factor else np.full(len(subjects), "")
        keys = list(dict.fromkeys(zip(subjects[rows], labels[rows], strict=True)))
        maps = [self.values[rows & (subjects == s) & (labels == c)].mean(axis=0) for s, c in keys]
        return *map(np.array, zip(*keys, strict=True)), np.stack(maps)


def _methods(text: str, signs: np.ndarray, way: str) -> str:
    amount = "all" if signs.shape[1] <= 12 else "random"
    return f"{text.format(f'{amount} {len(signs)} {way}')} Computed by hybridjax {__version__}."
