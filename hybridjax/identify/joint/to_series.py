"""The fit of a linear periodic model to recorded series."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from ..._core.arguments import require_same
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.frequency_response import all_harmonics
from ...linear.ldtp import LDTP
from ..series.realization import given_dims
from ..series.records import PreparedRecords
from .coordinates import local_coordinates
from .ldtp_fit import LDTPFit, finished
from .minimize import minimize
from .noise import noise_model
from .periodic_model import PeriodicModel
from .prediction.problem import SeriesProblem
from .prediction.series_part import SeriesPart
from .prediction.subspace import subspace_model


def fit_to_series(
    data: RecordedData, guess, innovations: bool, free_start: bool, direct: bool, max_steps: int
) -> LDTPFit:
    """As `fit_ldtp`."""
    parts = PreparedRecords(data)
    if parts.lead:
        raise DefinitionError(
            f"the outputs of the records depend on inputs up to {parts.lead} samples later "
            "(`lead`), those of an LDTP on earlier ones only: use `fit_series`."
        )
    N = parts.n_sections
    series = ScaledSeries(parts)
    same = np.tile(np.eye(len(parts.outputs)), (N, 1, 1))
    problem = SeriesProblem(series, same, innovations, free_start, series.numbers)
    if not isinstance(guess, LDTP):
        model = subspace_model(series, given_dims(guess, N, "guess"), innovations)
    else:
        require_same("guess and data", guess, parts)
        model = PeriodicModel.of(guess, series.scale)
        if innovations:
            model = _with_gain(model, problem, series)
    if not direct:
        model = model._replace(D=[0.0 * D for D in model.D])
    unknowns = local_coordinates(model, direct).size
    freedom = series.numbers - unknowns
    if free_start:
        freedom -= sum(model.dims[n] for n in series.first)
    fewest = series.sampled.min()
    if freedom < 1 or fewest <= len(parts.outputs) + unknowns / (N * len(parts.outputs)):
        raise DefinitionError(
            f"the series hold {series.numbers} numbers, {fewest} samples of an output at one of "
            f"the sections, too few for {unknowns} unknowns: record more, or fit fewer dimensions."
        )
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError("the predictions of the guess grow beyond all numbers.")
    found = minimize(problem.reweighted(model), model, direct, max_steps)
    model = found.coordinates.model
    fitted = model.to_ldtp(series.scale, parts.inputs, parts.outputs)
    sources = noise_model(model, found.problem.S, series.scale, parts.outputs)
    return finished(found, fitted, series.scale, all_harmonics(N), freedom, False, sources)


def _with_gain(
    model: PeriodicModel, problem: SeriesProblem, series: "ScaledSeries"
) -> PeriodicModel:
    """A guess without gain as it is, or what the subspace method finds with its dimensions, where
    the data suffice for that and it is more likely."""
    plain = model._replace(
        K=[np.zeros((len(A), len(C))) for A, C in zip(model.A, model.C, strict=True)]
    )
    try:
        found = subspace_model(series, model.dims, True)
    except DefinitionError:
        return plain

    def unlikely(one):
        return np.linalg.slogdet(problem.reweighted(one).S)[1].sum()

    return min(plain, found, key=unlikely)


class ScaledSeries:
    """Records with the outputs in units of their rms, which can be gone through again and again.

    **Fields:** `scale` (ny,): the rms. `numbers`: samples less those that a drift takes.
    `sampled` (N, ny): of each output at each section. `first`: where each record starts.
    """

    def __init__(self, parts: PreparedRecords):
        """**Raises:** `DefinitionError` for an output that is zero or missing."""
        self._parts = parts
        N, ny = parts.n_sections, len(parts.outputs)
        self.scale: Float[np.ndarray, " ny"] = parts.scale
        self._kept = [SeriesPart.of(g, self.scale) for g in parts] if parts.in_memory else None
        self.sampled: Int[np.ndarray, "N ny"] = np.zeros((N, ny), int)
        drift, self.first = 0, []
        for part in self:
            self.sampled += part.seen.sum(axis=(1, 2))
            drift += round(float((part.drift**2).sum()))
            self.first += part.first.tolist()
        self.numbers = int(self.sampled.sum()) - drift

    def __iter__(self) -> Iterator[SeriesPart]:
        if self._kept is not None:
            return iter(self._kept)
        return (SeriesPart.of(grid, self.scale) for grid in self._parts)
