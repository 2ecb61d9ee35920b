r"""The output-error problem in time: numerators and unknown starts projected out.

With $\chi(q^{-N}) y = B_{n \bmod N}(q^{-1}) u$ and $v = \chi^{-1} u$, filtered from cycle to cycle,

$$y[n] = \sum_r b_{n \bmod N}[r]\, v[n-r] + (\chi^{-1} g)[n] + \varepsilon[n],$$

where g is free in the first cycles of each record: it stands for inputs and outputs before the
record. For given c every section is a linear regression of its own, in b and g.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..._core.execution import core_count, on_all_cores
from ...errors import DefinitionError
from ..descent import Coefficients
from .cycle_filters import lagged_inputs, start_responses
from .cycle_grid import CycleGrid
from .parts import Parts
from .section_regression import RANK, SectionRegression


class Part(NamedTuple):
    """Some of the records."""

    u: Float[np.ndarray, "S T N nu"]
    y: Float[np.ndarray, "S T N ny"]
    """In units of `scale`; zero where there is no sample."""
    weight: Float[np.ndarray, "S T N ny"]
    """What each sample's equation is multiplied by: 1, less for outliers, zero where there is no
    sample."""
    first: Int[np.ndarray, "S N"]
    """The cycle in which a record first meets a section."""
    drift: Float[np.ndarray, "S T K"]
    """What an unknown drift of the outputs is composed of."""


class OutputErrorProblem(NamedTuple):
    """What does not depend on c."""

    data: Parts
    weights: list[Float[np.ndarray, "S T N ny"]] | None
    """Those of each part; None: 1 where there is a sample."""
    lags: int
    """R: numerators have the lags -lead..R-1-lead."""
    lead: int
    free: int
    """K: the cycles at the start of each record in which g is free."""
    to_lags: list[Float[np.ndarray, "columns r"]]
    """For each section: the combinations of lagged inputs that are linearly independent."""
    alike: list[list[list[int]]]
    """For each section: the outputs, in lists of those that have the same weights."""
    cycles: int
    """Of the longest record."""
    scale: Float[np.ndarray, " ny"]

    @classmethod
    def from_data(
        cls, data: Parts, order: int, overhang: int, free_start: bool
    ) -> "OutputErrorProblem":
        """**Arguments:** `order`: d. `overhang`: lags of the numerators beyond d N. `free_start`:
        whether the state at the start of records is unknown, or zero.

        **Raises:** `DefinitionError` for signals that are zero, or records too short for the lags.
        """
        N, nu, ny = data.n_sections, len(data.inputs), len(data.outputs)
        lags = data.lead + order * N + overhang + 1
        free = order + -(-overhang // N) if free_start else 0
        triangles = [np.zeros((0, lags * nu))] * N
        equal = np.ones((N, ny, ny), bool)
        square, count, excited = np.zeros(ny), np.zeros(ny), np.zeros(nu, bool)
        cycles = 0
        for grid in data:
            sampled = np.isfinite(grid.y)
            cycles = max(cycles, grid.y.shape[1])
            square += np.nansum(grid.y**2, axis=(0, 1, 2))
            count += sampled.sum(axis=(0, 1, 2))
            excited |= grid.u.any(axis=(0, 1, 2))
            for i in range(ny):
                equal[:, i] &= (sampled == sampled[..., [i]]).all(axis=(0, 1))
            if lags <= cycles * N:
                triangles = _with_rows(triangles, grid, lags, free)
        _require_signals(data, excited, square)
        if lags > cycles * N:
            raise DefinitionError(
                f"numerators of {lags} lags reach beyond the longest record, of {cycles * N} "
                "samples: lower `order` or `overhang`."
            )
        return cls(
            data=data,
            weights=None,
            lags=lags,
            lead=data.lead,
            free=free,
            to_lags=on_all_cores(_independent, triangles),
            alike=[_classes(x) for x in equal],
            cycles=cycles,
            scale=np.sqrt(square / count),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """N, and the numbers of inputs and outputs."""
        return self.data.n_sections, len(self.data.inputs), len(self.data.outputs)

    def parts(self) -> Iterator[Part]:
        """All records, a part at a time."""
        for k, grid in enumerate(self.data):
            sampled = np.isfinite(grid.y)
            yield Part(
                grid.u,
                np.where(sampled, grid.y, 0.0) / self.scale,
                sampled.astype(float) if self.weights is None else self.weights[k],
                np.argmax(grid.inside, axis=1),
                grid.drift,
            )

    def rescale(self, noise: Float[np.ndarray, " ny"]) -> "OutputErrorProblem":
        """The same with each output in units of its noise, which was `noise` units before."""
        return self._replace(scale=self.scale * noise)

    def weighed(self, weights: Sequence[Float[np.ndarray, "S T N ny"]]) -> "OutputErrorProblem":
        """The same with other weights of samples."""
        N, _, ny = self.shape
        return self._replace(weights=list(weights), alike=[[[i] for i in range(ny)]] * N)

    def regression(
        self, part: Part, v: Float[np.ndarray, "S T N nu"], c: Coefficients, n: int, output: int
    ) -> SectionRegression:
        """That of section n, and of all outputs with the weights of this one; `v`: the inputs over
        chi."""
        inputs = lagged_inputs(v, n, self.lags, self.lead) @ self.to_lags[n]
        T = part.y.shape[1]
        starts = start_responses(c, part.first[:, n], T, min(self.free, T))
        return SectionRegression.make(inputs, starts, part.drift, part.weight[:, :, n, output])


def _with_rows(
    triangles: list[np.ndarray], grid: CycleGrid, lags: int, free: int
) -> list[np.ndarray]:
    """Triangles of the lagged inputs of each section, with those of more records."""
    sampled, first = np.isfinite(grid.y), np.argmax(grid.inside, axis=1)
    cycle = np.arange(grid.y.shape[1])

    def section(n: int):
        tells = sampled[:, :, n].any(axis=2) & (cycle >= first[:, n, None] + free)
        rows = lagged_inputs(grid.u, n, lags, grid.lead)[tells]
        return np.linalg.qr(np.concatenate([triangles[n], rows]), mode="r")

    return on_all_cores(section, range(len(triangles)))


def _independent(triangle: np.ndarray) -> np.ndarray:
    _, s, vh = np.linalg.svd(triangle, full_matrices=False)
    kept = s > RANK * s.max(initial=0)
    return vh[kept].T / s[kept]


def _classes(equal: np.ndarray) -> list[list[int]]:
    """Outputs in lists of those that are equal."""
    return [list(x) for x in dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in equal)]


def _require_signals(data: Parts, excited: np.ndarray, square: np.ndarray) -> None:
    for name, there in zip(data.inputs, excited, strict=True):
        if not there:
            raise DefinitionError(f"the input {name} is zero at every sample.")
    for name, size in zip(data.outputs, square, strict=True):
        if not size:
            raise DefinitionError(f"the output {name} is zero or missing at every sample.")


def in_passes(
    problem: OutputErrorProblem,
    passes: Sequence[Callable[[int, Part, int, Any], Any]],
    regress: Callable[[Part, Any, int], Any],
    prepare: Callable[[Part], Any],
    collect: Callable[[int, list[Any]], None] | None = None,
) -> None:
    """Go through all parts several times, and each time through all sections.

    **Arguments:**

    - `passes`: what is done with the number and the data of a part, a section, and what `regress`
      makes of these and of what `prepare` makes of the part.
    - `collect`: takes what they return for all sections of a part.

    Of data that are in memory some sections are looked at together, whose regressions are kept from
    pass to pass. Others are read once in each pass.
    """
    kept = problem.data.in_memory
    prepared = [(part, prepare(part)) for part in problem.parts()] if kept else None
    together = core_count() if kept else problem.data.n_sections
    for begin in range(0, problem.data.n_sections, together):
        some = range(begin, min(begin + together, problem.data.n_sections))
        regressions: dict[tuple[int, int], Any] = {}
        for work in passes:
            parts = prepared if kept else ((part, prepare(part)) for part in problem.parts())
            for k, (part, ready) in enumerate(parts):
                missing = [n for n in some if (k, n) not in regressions]
                made = on_all_cores(functools.partial(regress, part, ready), missing)
                regressions |= {(k, n): one for n, one in zip(missing, made, strict=True)}
                each = [(n, regressions[k, n]) for n in some]
                results = on_all_cores(functools.partial(_on_pair, work, k, part), each)
                if collect is not None:
                    collect(k, results)
                if not kept:
                    regressions.clear()


def _on_pair(work: Callable, k: int, part: Part, pair: tuple[int, Any]) -> Any:
    return work(k, part, *pair)
