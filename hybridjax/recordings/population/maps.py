"""`PopulationMaps`: curves and maps of several subjects, their mean, and tests of differences.

The tests use the largest |t| over a map. If there is no difference, its distribution is that of the
largest |t| over maps that are drawn from the measured ones. The quantiles of this distribution give
p-values for each point, and bands, with a family-wise error over all points (Nichols and Holmes,
Human Brain Mapping 15, 2002). The draws are

- sign flips of paired differences, which are symmetric if there is no difference (exact), and of
  deviations from a mean;
- rotations of the deviations of each group from the common mean, for two groups. Normal maps keep
  their distribution under rotations (Langsrud, Statistics and Computing 15, 2005). Spreads and
  sizes of the groups may differ: t is Welch's (Biometrika 34, 1947), and no subject changes its
  group;
- subjects with replacement, where values are skewed: the studentized bootstrap (Hall, *The
  Bootstrap and Edgeworth Expansion*, 1992), whose bands are wider.

The first flip or rotation must stay the one that changes nothing: in tests of differences it stands
for the measured maps, without which p-values would be too small.

If a band is too narrow or a p-value too small, look at `_largest` and the weights of the draws
(`flips`, `_rotations`, `_resampled`); if the wrong kind of draws is used, at `_are_skewed`.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Inexact

from ..._core.arguments import Numbers, require_axes
from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Seed, Vector
from ..._core.boundary.values import Complexes
from ..._core.showable import Showable
from ..._core.text import number, p_value
from .tables import Columns, require, rows_with, signed, table_of


# Up to this number of subjects, all sign flips are tried (4096 at most). More: time. Fewer:
# p-values scatter although they could be exact.
_ALL = 12
# With more subjects than this, values count as skewed without a test. More: time. Fewer: wider
# bands for values that are not skewed (by 2 % with 30 subjects, 18 % with 12).
_MANY = 30
# Levels of the test for skewed values, for means and for groups. Larger: wider bands where normal
# values seem skewed by chance. Smaller: bands of skewed values of few subjects are too narrow.
_SKEWED_MEAN = 0.2
_SKEWED_GROUPS = 0.05
# Random rotations in the test for skewed values. Fewer: its p-values are coarse. More: time.
_ROTATIONS = 200

Maps = Inexact[np.ndarray, "n V"]
Weights = Float[np.ndarray, "P n"]
"""One row for each draw, with a weight for each subject."""


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

    @checked
    def plot(self, *, ax: object = None) -> Any:
        """Draw the mean or difference over subjects.

        For a curve, the figure shows each subject as a thin line, the mean with its band, and a bar
        at the significant points. For a map, it shows the values, with outlined significant points.
        For complex values, it shows the magnitude.

        **Arguments:** `ax`: one Axes. Default: a new figure.

        **Returns:** `hj.plot.Plot` with `axes` (1, 1), the values in `unit`.

        **Raises:** `DefinitionError` for maps with more than two axes, or if `ax` is not one Axes.

        **Example:**

        ```python
        phase = np.arange(8) / 8
        curves = np.sin(2 * np.pi * phase) + 0.1 * np.random.default_rng(0).normal(size=(5, 8))
        table = {"subject": ["S1", "S2", "S3", "S4", "S5"]}
        maps = hj.recordings.PopulationMaps(table, curves, {"phase": phase}, "mm/N")
        maps.mean().plot()
        ```
        """
        return super().plot(ax=ax)

    def __repr__(self) -> str:
        spans = []
        places = np.nonzero(self.significant)
        for (name, x), place in zip(self.axes.items(), places, strict=True):
            if len(place):
                values = x[place]
                spans.append(f"{name} {values.min():.3g} to {values.max():.3g}")
        where = ", ".join(spans) or "none"
        largest = number(np.abs(self.values).max(), 4, self.unit)
        half_width = number(np.median(self.reach), 3, self.unit)
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

    **Raises:** `DefinitionError` for shapes that do not fit together, and in the cases of
    `Population`.

    **Example:**

    ```python
    phase = np.arange(8) / 8
    curves = np.sin(2 * np.pi * phase) + 0.1 * np.random.default_rng(0).normal(size=(5, 8))
    table = {"subject": ["S1", "S2", "S3", "S4", "S5"]}
    maps = hj.recordings.PopulationMaps(table, curves, {"phase": phase}, "mm/N")
    print(maps.mean())
    ```

    **Before:** `hj.recordings.impulse_responses`, `hj.recordings.phase_response`. **After:**
    `maps.mean().plot()`.
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

        The band has the width at which the largest |t| of draws stays inside: of sign flips of the
        deviations from the mean or, where values are skewed, of subjects with replacement.
        `methods` says which. Bands of skewed values are wide for few subjects: those of their
        logarithms are not.

        **Arguments:** `label`: a group or condition. Default: all rows. `draws`: number of draws,
        if there are more than 12 subjects or values are skewed. Default: 10000.

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
        rng = np.random.default_rng(seed)
        deviation = (y - y.mean(axis=0)).reshape(len(y), -1)
        if _are_skewed([deviation], _SKEWED_MEAN, rng):
            largest = _resampled([deviation], draws, rng)
            kind = f"{draws} random draws of subjects (values are skewed, or subjects many)"
        else:
            signs = flips(len(y), draws, rng)
            largest = _largest([deviation], [signs])
            kind = f"{_amount(len(y))} {len(signs)} sign flips"
        return self._result([y], largest, f"{text}, by the largest |t| of {kind}.")

    def difference(
        self,
        a: str,
        b: str,
        *,
        draws: Count = 10_000,
        seed: Seed = 0,
    ) -> MapResult:
        """Test the difference a - b of two conditions (sign flips of paired differences) or two
        groups (rotations of the deviations within groups), with a family-wise error of 5 % over all
        points.

        Spreads and numbers of subjects of two groups may differ. Where values are skewed, subjects
        are drawn with replacement within groups, which makes fewer errors than 5 % if they are few.

        **Arguments:** `draws`: number of draws, for conditions with more than 12 subjects (all
        flips for fewer) and for groups. Default: 10000.

        **Raises:** `DefinitionError` for labels that are no two conditions or groups, and for fewer
        than three subjects in both conditions, or in a group.
        """
        rng = np.random.default_rng(seed)
        factor, _ = rows_with(self.table, a, b)
        first = self._by_subject(np.flatnonzero(self.table[factor] == a))
        second = self._by_subject(np.flatnonzero(self.table[factor] == b))
        if factor == "condition":
            pairs = {s: y - second[s] for s, y in first.items() if s in second}
            require({f"{a} and {b}": pairs}, 3)
            y = np.stack(list(pairs.values()))
            signs = flips(len(y), draws, rng)
            largest = _largest([y.reshape(len(y), -1)], [signs])
            kind = f"{_amount(len(y))} {len(signs)} sign flips"
            parts = [y]
        else:
            require({a: first, b: second}, 3)
            parts = [np.stack(list(group.values())) for group in (first, second)]
            largest, kind = _of_groups(parts, draws, rng)
        count = sum(map(len, parts))
        text = f"Maps of {count} subjects ({a} - {b}) with a family-wise error of 5 %"
        return self._result(parts, largest, f"{text}, by the largest |t| of {kind}.")

    def _by_subject(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        by_subject = self.table.iloc[rows].groupby("subject", sort=False)
        return {
            str(name): self.values[index].mean(axis=0)
            for name, index in by_subject.groups.items()
        }

    def _result(
        self, parts: list[np.ndarray], largest: Float[np.ndarray, " P"], text: str
    ) -> MapResult:
        """Return the mean of one part, or the difference of two, with the band and p-values of the
        largest statistics of draws.

        **Arguments:** `parts`: maps of the subjects of each group. `largest`: in ascending order.
        """
        flat = [y.reshape(len(y), -1) for y in parts]
        each_once = [np.ones((1, len(y))) for y in flat]
        value, error, t = moments(flat, each_once)
        # Up to rounding.
        below = np.searchsorted(largest, np.abs(t) * (1 - 1e-9))
        above = np.maximum(len(largest) - below, 1)
        reach = np.quantile(largest, 0.95, method="higher") * error
        grid = parts[0].shape[1:]
        return MapResult(
            values=np.reshape(value, grid),
            each=parts[0] if len(parts) == 1 else parts[0][:0],
            reach=np.reshape(reach, grid),
            t=np.reshape(t, grid),
            p=(above / len(largest)).reshape(grid),
            significant=(np.abs(value) > reach).reshape(grid),
            axes=self.axes,
            unit=self.unit,
            methods=signed(text),
        )


def _of_groups(
    parts: list[np.ndarray], draws: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " P"], str]:
    """Return the largest statistics of draws of two groups without a difference, and their kind."""
    flat = [y.reshape(len(y), -1) for y in parts]
    deviations = [y - y.mean(axis=0) for y in flat]
    if _are_skewed(deviations, _SKEWED_GROUPS, rng):
        kind = "subjects within groups (values are skewed, or subjects many)"
        return _resampled(deviations, draws, rng), f"{draws} random draws of {kind}"
    # The common mean of both groups, weighted by their precision at each point.
    precisions = []
    for y, deviation in zip(flat, deviations, strict=True):
        squares = np.sum(np.abs(deviation) ** 2, axis=0)
        square = squares / (len(y) - 1)
        precisions.append(len(y) / np.maximum(square, _least(y)))
    means = [y.mean(axis=0) for y in flat]
    first = precisions[0] * means[0]
    second = precisions[1] * means[1]
    weighted = first + second
    common = weighted / (precisions[0] + precisions[1])
    null = [y - common for y in flat]
    rotations = [_rotations(len(y), draws, rng) for y in null]
    kind = f"{draws} random rotations of deviations within groups (Welch's t)"
    return _largest(null, rotations), kind


def _largest(parts: list[Maps], weights: list[Weights]) -> Float[np.ndarray, " P"]:
    """Return the largest |t| over the grid of each draw, in ascending order."""
    at_once = max(1, 8_000_000 // parts[0].shape[1])  # statistics fit into 64 MB
    largest = []
    for first in range(0, len(weights[0]), at_once):
        some = [w[first : first + at_once] for w in weights]
        _, _, t = moments(parts, some)
        largest.append(np.abs(t).max(axis=1))
    return np.sort(np.concatenate(largest))


def _resampled(
    parts: list[Maps], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, " P"]:
    """Return the largest |t| of deviations of subjects drawn with replacement, ascending."""
    at_once = max(1, 8_000_000 // parts[0].shape[1])
    largest = []
    for first in range(0, draws, at_once):
        count = min(at_once, draws - first)
        numbers = [
            rng.multinomial(len(y), np.full(len(y), 1 / len(y)), size=count)
            for y in parts
        ]
        _, _, t = moments(parts, [x.astype(float) for x in numbers], drawn=True)
        largest.append(np.abs(t).max(axis=1))
    return np.sort(np.concatenate(largest))


def _amount(subjects: int) -> str:
    return "all" if subjects <= _ALL else "random"


def flips(n: int, draws: int, rng: np.random.Generator) -> Weights:
    """Return weights +1 and -1 of n subjects, including those without a flip. For up to 12
    subjects, these are all flips. (Of two opposite flips only one is needed.)"""
    if n > _ALL:
        signs = rng.choice([-1.0, 1.0], (draws, n))
        signs[0] = 1.0
        return signs
    signs = np.array(list(itertools.product([1.0, -1.0], repeat=n)))
    return signs[signs[:, 0] > 0]


def _rotations(n: int, draws: int, rng: np.random.Generator) -> Weights:
    """Return weights with which the mean of the values is the mean of rotated values: a random
    direction for each draw; the first draw has no rotation. (A rotation keeps the sum of
    squares.)"""
    direction = rng.normal(size=(draws, n))
    direction[0] = 1.0
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return direction / length * np.sqrt(n)


def _are_skewed(parts: list[Maps], level: float, rng: np.random.Generator) -> bool:
    """Return whether values are skewed: the third moments of deviations from means, summed over the
    grid, exceed those of rotated deviations. With too many subjects for this test, return True."""
    if max(map(len, parts)) > _MANY:
        return True
    found = 0.0
    rotated = np.zeros(_ROTATIONS)
    for part in parts:
        n = len(part)
        values = np.concatenate([np.real(part), np.imag(part)], axis=1)
        # Deviations from a mean have n - 1 dimensions.
        basis, _ = np.linalg.qr(np.eye(n) - 1 / n)
        contrasts = basis[:, : n - 1]
        drawn = rng.normal(size=(_ROTATIONS, n - 1, n - 1))
        rotation, _ = np.linalg.qr(drawn)
        found += _skewness(values[None])[0]
        rotated += [_skewness(contrasts @ q @ (contrasts.T @ values)) for q in rotation]
    return bool((1 + (rotated >= found).sum()) <= level * (1 + _ROTATIONS))


def _skewness(deviation: Float[np.ndarray, "... n V"]) -> Float[np.ndarray, "..."]:
    """Return the sum over the grid of squared skewness, times the number of subjects."""
    second = np.mean(deviation**2, axis=-2)
    third = np.mean(deviation**3, axis=-2)
    least = np.finfo(float).tiny ** 0.25
    square = third**2 / np.maximum(second, least) ** 3
    return deviation.shape[-2] * square.sum(axis=-1)


def _least(y: Maps) -> Float[np.ndarray, " V"]:
    """Return the least variance that is used as a divisor, for points at which all subjects are
    zero."""
    square = np.mean(np.abs(y) ** 2, axis=0)
    return 1e-24 * np.maximum(square, 1e-290)


def moments(parts: list[Maps], weights: list[Weights], drawn: bool = False):
    """Return the mean of one part, or the difference between the means of two parts; with standard
    errors and t for each draw (P, V). For two parts, t is Welch's. For complex maps, |t| is the
    square root of the F ratio of a complex mean.

    **Arguments:** `weights`: weights of the subjects in the mean. `drawn`: whether weights are
    numbers of times that subjects were drawn; otherwise weights keep the sum of squares.
    """
    value = 0.0
    variance = 0.0
    for sign, y, weight in zip((1.0, -1.0), parts, weights, strict=False):
        n = len(y)
        mean = weight @ y / n
        repeated = weight if drawn else np.ones((1, n))
        square = repeated @ np.abs(y) ** 2 / n
        own = (square - np.abs(mean) ** 2) / (n - 1)
        value = value + sign * mean
        variance = variance + np.maximum(own, _least(y))
    error = np.sqrt(variance)
    if np.iscomplexobj(value):
        return value, error, np.abs(value) / error
    return value, error, value / error
