r"""Multipliers and transfer functions of a plant in a loop, from time series and a reference.

With a controller at work the noise of the outputs goes round the loop into u. In

$$\chi(q^{-N})\, y[n] = B_{n \bmod N}(q^{-1})\, u[n] + \varepsilon[n]$$

the earlier outputs and u depend on $\varepsilon$, but the reference r does not. A model from r to
(u, y) predicts $\hat u$ and $\hat y$ from r alone, so that they do not depend on $\varepsilon$,
either. They are the instruments of u and of the earlier y (instrumental variables: Söderström and
Stoica 1983; Gilson and Van den Hof 2005). If the model is inaccurate, this costs efficiency, but
causes no bias. It has few dimensions, since a model of many parameters would fit noise, which is
correlated with $\varepsilon$.

`fit_series` makes `LoopEquations` if references are given, and calls `fit`. B is eliminated section
by section (`_section`), and the rest is linear in c (`solution`).

The instruments must be simulated from the references alone (`predicted`, with a model without K):
measured outputs in them would bias the fit. If multipliers are refused as not determined, look at
`solution`; if numerators lack a part, at `kept` in `_section`; if error bars are wrong, at
`_scores`.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..._core.results import Result
from ...errors import DefinitionError
from ...experiments.record import RecordedData, SectionSeries
from .. import denominator
from ..denominator import Covariance, in_blocks, multipliers_of
from ..descent import Coefficients
from ..instrument import in_loop
from ..multiplier_estimate import RoughFit
from .output_error import RANK, SectionRegression
from .prediction import Predictor
from .records import PreparedRecords, delay_cycles, lagged_inputs
from .subspace import subspace_model, without_drift


# The coefficient of a combination of lagged inputs is estimated if its signal-to-noise ratio
# exceeds this. Smaller: noise by combinations that the reference hardly excites. Larger: bias by
# combinations that are left out.
_EXCITED = 5.0
# Least number of cycles in a block. Fewer: dependent errors of neighboring cycles count as
# independent. More: few blocks.
_BLOCK = 10
# The instruments determine a multiplier if its squared signal-to-noise ratio exceeds this. Smaller:
# noise counts as multipliers. Larger: weak multipliers are refused.
_DETERMINED = 10.0


def predicted(
    plant: list[SectionSeries], drive: list[SectionSeries], order: int
) -> Float[np.ndarray, "S T N nuy"]:
    """Return the inputs and outputs that the references predict. They are simulated from zero by a
    model with `order` dimensions.

    **Raises:** `DefinitionError` for too few cycles.
    """
    closed = []
    for r, p in zip(drive, plant, strict=True):
        y = np.concatenate([r.y, p.y], axis=1)
        closed.append(dataclasses.replace(r, y=y, outputs=(*r.outputs, *p.outputs)))
    records = PreparedRecords(closed)
    grid = without_drift(records.whole())
    # (In units of the outputs without drift: otherwise outputs with a large drift would dominate
    # the model.)
    square = (grid.y**2).mean(axis=(0, 1, 2))
    size = np.sqrt(square)
    records.scale = np.maximum(size, RANK * records.scale)
    model = subspace_model(records, [order] * records.n_sections, False)
    unit = np.eye(len(records.outputs))
    S = np.tile(unit, (records.n_sections, 1, 1))
    return Predictor(model, S).predicted(grid, False) * records.scale


class SectionEquations(NamedTuple):
    """The equations of a section without B: errors are `outputs` @ (1, c)."""

    outputs: Float[np.ndarray, "rows ny d1"]
    """The outputs 0, ..., d cycles earlier, without the parts that inputs explain."""
    instruments: Float[np.ndarray, "rows ny d"]
    numerators: Float[np.ndarray, "columns ny d1"]
    """The coefficients of these parts."""
    root: Float[np.ndarray, "columns r"]
    """A root of the covariance of these coefficients, root @ root.T, for noise of variance one."""
    taken: tuple[Float[np.ndarray, "rows r"], Float[np.ndarray, "rows r"]]
    """The first matrix, times the transposed second one, maps errors to the part of them that
    numerators fit."""
    dof: int


class Solution(NamedTuple):
    """The solution of the equations of all sections."""

    c: Coefficients
    along: Float[np.ndarray, "d d"]
    """Products of instruments and earlier outputs."""
    scale: Float[np.ndarray, " ny"]
    """Standard deviations of the outputs' errors."""
    determined: int
    """The number of multipliers that the references determine."""


def best_order(
    data: RecordedData, references: Sequence[str], most: int
) -> tuple[int, str]:
    """Return the largest number of multipliers, up to `most`, that the references determine; and
    the reason why a larger number cannot be tried, if there is one."""
    obstacle = ""
    for order in range(most, 1, -1):
        # (Too few cycles for this order: the text becomes a finding.)
        try:
            solution = LoopEquations(*in_loop(data, references), order, None).solution
        except DefinitionError as error:
            obstacle = str(error)
            continue
        if solution.determined >= order:
            return order, obstacle
        obstacle = ""
    return 1, obstacle


class LoopEquations:
    """The equations of all sections."""

    def __init__(
        self,
        plant: list[SectionSeries],
        drive: list[SectionSeries],
        order: int,
        extra_lags: int | None,
    ):
        self.records = PreparedRecords(plant)
        self.order = order
        self.references = drive[0].inputs
        self.grid = self.records.whole()
        N = self.records.n_sections
        z = predicted(plant, drive, order)
        span = N if extra_lags is None else extra_lags
        self.lags = self.records.lead + order * N + span + 1
        free = order + -(-span // N)
        self.sections = [self._section(n, z, free) for n in range(N)]

    def _section(
        self, n: int, z: Float[np.ndarray, "S T N nuy"], free: int
    ) -> SectionEquations:
        """Return the equations of section n.

        **Arguments:** `z`: inputs and outputs that the references predict. `free`: cycles at the
        start of each record that are left out.
        """
        grid = self.grid
        delays = range(self.order + 1)
        _, T, _, nu = grid.u.shape
        ny = grid.y.shape[3]
        lead = self.records.lead
        of_section = grid.sampled[:, :, n]
        sampled = [delay_cycles(of_section, j).all(axis=2) for j in delays]
        first = grid.first[:, n, None] + free
        begun = np.arange(T) >= first
        used = np.all(sampled, axis=0) & begun
        # Lagged inputs, predicted and measured, then outputs 0 to d cycles earlier, predicted and
        # measured; the drift is projected out of all.
        inputs_of_section = (z[..., :nu], grid.u)
        signals = [lagged_inputs(u, n, self.lags, lead) for u in inputs_of_section]
        for y in (z[..., nu:], grid.y):
            signals += [delay_cycles(y[:, :, n], j) for j in delays]
        columns = np.concatenate(signals, axis=2)
        no_starts = grid.drift[:, :, :0]
        rows = SectionRegression.make(columns, no_starts, grid.drift, used).remainder
        lags = self.lags * nu
        ends = [lags, 2 * lags]
        Z, U, late = np.split(rows, ends, axis=1)
        # Combinations of lagged inputs. Those whose response to the reference exceeds the noise are
        # used.
        _, size, V = np.linalg.svd(Z, full_matrices=False)
        unexplained = np.linalg.norm((U - Z) @ V.T, axis=0)
        noise = unexplained / np.sqrt(max(used.sum(), 1))
        by_noise = _EXCITED * noise
        by_rounding = RANK * size.max(initial=0)
        kept = size > np.maximum(by_noise, by_rounding)
        to_lags = V[kept].T / size[kept]
        # B is eliminated: outputs without what inputs explain, by the instruments.
        instruments = Z @ to_lags
        inputs = U @ to_lags
        inverse = np.linalg.inv(instruments.T @ inputs)
        late = late.reshape(len(late), 2, -1, ny).mT
        predictions = late[:, 0, :, 1:]
        y = late[:, 1]
        fitted = np.tensordot(inverse @ instruments.T, y, 1)
        explained = np.tensordot(inverse.T @ inputs.T, predictions, 1)
        return SectionEquations(
            outputs=y - np.tensordot(inputs, fitted, 1),
            instruments=predictions - np.tensordot(instruments, explained, 1),
            numerators=np.tensordot(to_lags, fitted, 1),
            root=to_lags @ inverse,
            taken=(inputs @ inverse, instruments),
            dof=int(used.sum() - kept.sum()),
        )

    def fit(self, check: bool) -> dict[str, Any]:
        """Return the fields of a `SeriesFit`.

        **Raises:** `DefinitionError` in the cases of `solve`.
        """
        c, covariance, noise = self.solve(check)
        N = len(self.sections)
        R = self.lags
        nu = self.grid.u.shape[3]
        ny = len(noise)
        numerators = [x.numerators.reshape(R, nu, ny, -1) for x in self.sections]
        b = np.swapaxes(numerators, 2, 3)
        widest = max(x.root.shape[1] for x in self.sections)
        roots = np.zeros((N, ny, R, nu, widest))
        for n, x in enumerate(self.sections):
            columns = x.root.shape[1]
            roots[n, ..., :columns] = x.root.reshape(R, nu, -1)
        return dict(
            multipliers=multipliers_of(c),
            coefficients=c,
            covariance=covariance.matrix,
            numerators=b @ np.append(1.0, c),
            slopes=np.moveaxis(b[..., 1:], -1, 0),
            roots=roots,
            noise=noise,
            covariance_dof=covariance.dof,
            dof=float(sum(x.dof for x in self.sections) * ny - len(c)),
            result=int(Result.OK),
            **self.records.about,
            references=self.references,
        )

    def coefficients(self) -> RoughFit:
        """**Raises:** `DefinitionError` in the cases of `solve`."""
        c, covariance, _ = self.solve(True)
        return c, lambda: covariance

    @cached_property
    def solution(self) -> Solution:
        """**Raises:** `DefinitionError` for too few cycles."""
        d = self.order
        sections = self.sections
        scale = self.records.scale
        least = min(x.dof for x in sections)
        if least <= d:
            raise DefinitionError(
                f"a section was sampled {d + 1 - least} times too few for numerators of "
                f"{self.lags} lags: record more, take fewer sections, or lower `order`."
            )
        dof = sum(x.dof for x in sections)
        outputs = np.array([x.outputs for x in sections])
        instruments = np.array([x.instruments for x in sections])
        for _ in range(2):  # the second time with the weights that the errors suggest
            scaled_outputs = outputs / scale[:, None]
            y = scaled_outputs.reshape(-1, d + 1)
            scaled_instruments = instruments / scale[:, None]
            W = scaled_instruments.reshape(-1, d)
            along = W.T @ y
            earlier = along[:, 1:]
            c, *_ = np.linalg.lstsq(earlier, along[:, 0])
            c = -c
            errors = outputs @ [1.0, *c]
            square = (errors**2).sum(axis=(0, 1))
            by_rounding = RANK * self.records.scale
            scale = np.maximum(np.sqrt(square / dof), by_rounding)
        along = along[:, 1:]
        # The squared correlations of the earlier outputs with the instruments (Cragg, Donald 1993).
        by_instruments = np.linalg.lstsq(W.T @ W, along)[0]
        part = along.T @ by_instruments
        others = y[:, 1:]
        part = np.linalg.pinv(others.T @ others, RANK) @ part
        part = np.clip(np.linalg.eigvals(part).real, 0, 1)
        evidence = part * dof * len(scale)
        seen = evidence > _DETERMINED * (1 - part)
        return Solution(c, along, scale, int(seen.sum()))

    def solve(
        self, check: bool
    ) -> tuple[Coefficients, Covariance, Float[np.ndarray, " ny"]]:
        """Return c, its covariance, and the standard deviations of the outputs' errors.

        **Raises:** `DefinitionError` for too few cycles, or, with `check`, for an order of which
        the reference does not determine all multipliers.
        """
        c, along, scale, determined = self.solution
        d = self.order
        if check and determined < d:
            raise DefinitionError(
                f"the reference determines {determined} multipliers, not {d}: try "
                f"`hj.fit_ldtp(data, {d}, references=...)`, whose errors are smaller, lower "
                "`order`, record longer, excite more, or pass check=False."
            )
        if determined < d:
            return c, Covariance.unknown(d), scale
        cycles = self.records.cycles
        correlated = denominator.correlated_cycles(multipliers_of(c), cycles) + 1
        blocks = max(1, cycles // max(correlated, _BLOCK))
        scores = [self._scores(x, c, scale, blocks) for x in self.sections]
        score = np.sum(scores, axis=0)
        score = score[score.any(axis=1)]
        half = np.linalg.solve(along, score.T)
        unit = np.eye(d) / len(score)
        share = np.tile(unit, (len(score), 1, 1))
        dof = denominator.block_freedom(score, share)
        return c, Covariance(half @ half.T, dof), scale

    def _scores(
        self, section: SectionEquations, c, scale, count: int
    ) -> Float[np.ndarray, "B d"]:
        """Return the sums of errors times instruments over blocks of cycles.

        The errors of a block are those with numerators that are fitted to the other blocks."""

        def blocks(x: np.ndarray) -> np.ndarray:
            grid_shape = self.grid.y.shape[:2]
            return in_blocks(x.reshape(*grid_shape, *x.shape[1:]), count)

        error = blocks(section.outputs @ [1.0, *c] / scale)
        instruments = blocks(section.instruments / scale[:, None])
        by_error, by_instrument = map(blocks, section.taken)
        taken = by_error @ by_instrument.mT
        symmetric = (taken + taken.mT) / 2
        error = denominator.inverse_of_remainder(symmetric) @ error
        return np.einsum("bki,bkid->bd", error, instruments)
