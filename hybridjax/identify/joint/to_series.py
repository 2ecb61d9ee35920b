"""The fit of a linear periodic model to recorded series."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from ..._core.results import Result
from ...errors import DefinitionError
from ...experiments.record import RecordedData
from ...linear.frequency_response import all_harmonics
from ...linear.ldtp import LDTP
from ..multipliers.denominator import multipliers_of
from ..series.parts import Parts
from .characteristic import characteristic_slopes
from .coordinates import local_coordinates
from .ldtp_fit import LDTPFit
from .minimize import minimize
from .noise import noise_model
from .periodic_model import PeriodicModel
from .series import SeriesProblem
from .series_part import SeriesPart
from .subspace import subspace_model
from .to_htf import require_same_kind


def fit_to_series(
    data: RecordedData, guess, innovations: bool, free_start: bool, direct: bool, max_steps: int
) -> LDTPFit:
    """As `fit_ldtp`."""
    parts = Parts(data)
    if parts.lead:
        raise DefinitionError(
            f"the outputs of the records depend on inputs up to {parts.lead} samples later "
            "(`lead`), those of an LDTP on earlier ones only: use `fit_series`."
        )
    N = parts.n_sections
    series = ScaledSeries(parts)
    if isinstance(guess, LDTP):
        require_same_kind(guess, parts)
        model = PeriodicModel.of(guess, series.scale)
        if innovations:
            ny = len(parts.outputs)
            model = model._replace(K=[np.zeros((len(A), ny)) for A in model.A])
    else:
        model = subspace_model(series, np.broadcast_to(np.asarray(guess), N), innovations)
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
    ny = len(parts.outputs)
    same = np.tile(np.eye(ny), (N, 1, 1))
    problem = SeriesProblem(series, same, innovations, free_start, series.numbers)
    if not np.isfinite(problem.cost(model)):
        raise DefinitionError("the predictions of the guess grow beyond all numbers.")
    found = minimize(problem.reweighted(model), model, direct, max_steps)
    c, slopes = characteristic_slopes(found.coordinates)
    root = np.sqrt(found.cost / freedom) * found.equations.covariance_root()
    model = found.coordinates.model
    return LDTPFit(
        model=model.to_ldtp(series.scale, parts.inputs, parts.outputs),
        multipliers=multipliers_of(c),
        coefficients=c,
        covariance=slopes @ root @ (slopes @ root).T,
        covariance_freedom=float(freedom),
        cost=float(freedom),
        freedom=freedom,
        result=Result.OK if found.converged else Result.NOT_CONVERGED,
        harmonics=all_harmonics(N),
        noise=noise_model(model, found.problem.S, series.scale, parts.outputs),
        _coordinates=found.coordinates,
        _root=root,
        _scale=series.scale,
    )


class ScaledSeries:
    """Records with the outputs in units of their rms, which can be gone through again and again.

    **Fields:** `scale` (ny,): the rms. `numbers`: samples less those that a drift takes.
    `sampled` (N, ny): of each output at each section. `first`: where each record starts.
    """

    def __init__(self, parts: Parts):
        """**Raises:** `DefinitionError` for an output that is zero or missing."""
        self._parts = parts
        N, ny = parts.n_sections, len(parts.outputs)
        square, count = np.zeros(ny), np.zeros(ny)
        for grid in parts:
            square += np.nansum(grid.y**2, axis=(0, 1, 2))
            count += np.isfinite(grid.y).sum(axis=(0, 1, 2))
        self.scale: Float[np.ndarray, " ny"] = np.sqrt(square / np.maximum(count, 1))
        for name, size in zip(parts.outputs, self.scale, strict=True):
            if not size:
                raise DefinitionError(f"the output {name} is zero or missing at every sample.")
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
