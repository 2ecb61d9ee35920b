"""One estimate of the multipliers from all blocks of a study, whose noise nobody knows."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...identify.htf_errors import check_values, error_weights, require_frequencies
from ...identify.multipliers import StructuredFit, fit_multipliers
from ...identify.order import require_order
from ...identify.spectral_sums import spectral_sums
from ...identify.variable_projection import HTFGroup, group_htf, maximum_likelihood, misfit_of
from ...linear.htf import HTF
from ..goals import Multipliers
from ..questions.multipliers import FEW


# Estimates of the noise, at most, each from the misfit of a fit weighted by the last one; and the
# relative change that ends them. Doubled: no more estimates, as a rule; one less at times.
_SWEEPS = 10
_SETTLED = 0.02
# Steps of each of these fits. Doubled: nothing, since the next one goes on.
_MAX_STEPS = 50


class Block(NamedTuple):
    """What a study keeps of one block of experiments: R responses to one cosine each, which stands
    in one experiment."""

    f: Float[np.ndarray, " R"]
    H: Complex[np.ndarray, "M R ny"]
    variance: Float[np.ndarray, " R"]
    """Of each H for white noise of variance 1 on each sample: what the inputs alone say."""
    harmonics: tuple[int, ...]
    n_sections: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    strides: int
    """All cycles of the records, those that are discarded too."""


def block_of(data: ExperimentData, goal: Multipliers, repeats: int) -> Block:
    """**Raises:** `DefinitionError` as `estimate_htf`, and if no experiment ran to its end."""
    harmonics = FEW if goal.harmonics is None else goal.harmonics
    each = []
    for s in np.flatnonzero(data.ok):
        one = ExperimentData(
            data.u[s : s + 1], data.y[s : s + 1], n_sections=data.n_sections,
            periods=data.periods, inputs=data.inputs, outputs=data.outputs,
        )  # fmt: skip
        each.append(spectral_sums(one, harmonics, repeats=repeats))
    if not each:
        raise DefinitionError(f"no experiment ran well, so nothing was learnt: {data.summary()}.")
    power = np.concatenate([sums.gram[:, 0, 0].real for sums in each])
    H = np.concatenate([sums.along[:, 0] for sums in each]) / power[:, None, None]
    return Block(
        f=np.concatenate([sums.line for sums in each]) / data.periods,
        H=np.moveaxis(H, 1, 0),
        variance=data.n_sections * data.periods / repeats / power,
        harmonics=each[0].harmonics,
        n_sections=data.n_sections,
        inputs=data.inputs,
        outputs=data.outputs,
        strides=data.u.shape[0] * data.u.shape[1] // data.n_sections,
    )


class Estimate(NamedTuple):
    """What all blocks together say."""

    fit: StructuredFit
    by_level: StructuredFit
    """The same, as sure as white noise of these levels lets it be."""
    noise: Float[np.ndarray, "B ny"]
    """Standard deviation of each output's noise in each block."""
    doubt: str
    """Why nothing should be built on it, or nothing."""


def estimate(blocks: tuple[Block, ...], order: int, goal: Multipliers) -> Estimate:
    """The fit of `fit_multipliers` to all responses of all blocks, each weighted by the power of
    its cosine and by the noise of its block.

    A line that was measured in several experiments counts several times: the least-squares problem
    is that of the weighted mean. The variance that weighs is one number for each block and output,
    from the misfit of all of its lines and harmonics (less the part that numerators take of it).
    With hundreds of degrees of freedom it does not depend on the errors of single lines, as
    variances of their own would, and does not bias.

    How sure the multipliers are is said twice, and the larger is believed: by the scatter of noise
    and distortion at the lines that matter, whatever the spectrum of the noise is, which tells too
    little where these are few; and by the levels of the noise, as if it were white.
    """
    N, d = blocks[0].n_sections, order
    size = d * N + (N if goal.overhang is None else goal.overhang) + 1
    member = np.repeat(np.arange(len(blocks)), [len(block.f) for block in blocks])
    H = np.concatenate([block.H for block in blocks], axis=1)
    # All of it may be noise, to begin with.
    square = [np.mean(np.abs(b.H) ** 2 / b.variance[:, None], axis=(0, 1)) for b in blocks]
    noise, c = np.sqrt(square), None
    for _ in range(_SWEEPS):
        htf = _joined(blocks, noise, H)
        require_frequencies(htf, d, size)
        groups = group_htf(htf, error_weights(htf, check_values(htf)), size)
        c, _ = maximum_likelihood(groups, d, _MAX_STEPS, c)
        change = _misfit(groups, c, member, noise.shape)
        noise = noise * change
        if np.abs(np.log(change)).max() < _SETTLED:
            break
    htf = _joined(blocks, noise, H)
    by_scatter = fit_multipliers(htf, d, overhang=goal.overhang, check=False)
    by_level = fit_multipliers(htf, d, overhang=goal.overhang, check=False, errors="variance")
    fit = max(by_scatter, by_level, key=lambda fit: fit.standard_errors.max())
    groups = group_htf(htf, error_weights(htf, check_values(htf)), size)
    return Estimate(fit, by_level, noise, _doubt(groups, htf, fit))


def _joined(
    blocks: tuple[Block, ...], noise: Float[np.ndarray, "B ny"], H: Complex[np.ndarray, "M F ny"]
) -> HTF:
    """All lines of all blocks, one after the other, with their variances."""
    one = blocks[0]
    variance = [b.variance[:, None] * std**2 for b, std in zip(blocks, noise, strict=True)]
    f, v = np.concatenate([b.f for b in blocks]), np.concatenate(variance)
    return HTF(
        f, H[..., None], one.harmonics, one.n_sections, one.inputs, one.outputs,
        variance=np.broadcast_to(v[..., None], (*H.shape, 1)),
    )  # fmt: skip


def _misfit(
    groups: list[HTFGroup], c: Float[np.ndarray, " d"], member: np.ndarray, shape: tuple[int, int]
) -> Float[np.ndarray, "B ny"]:
    """Root of the mean square of each block's misfit, in units of the noise supposed."""
    square, freedom = np.zeros(shape), np.zeros(shape)
    for group in groups:
        found, block = misfit_of(group, c), member[group.line]
        for k, output in enumerate(group.channel[:, 0]):
            np.add.at(square[:, output], block, (found.residual[:, :, k] ** 2).sum(axis=0))
            np.add.at(freedom[:, output], block, (1 - found.leverage).sum(axis=0))
    return np.sqrt(square / freedom)


def _doubt(groups: list[HTFGroup], htf: HTF, fit: StructuredFit) -> str:
    """The objection of `fit_multipliers` to an order that the data do not carry."""
    try:
        require_order(groups, htf, len(fit.coefficients), fit.cost / fit.freedom)
    except DefinitionError as refused:
        return str(refused)
    return ""
