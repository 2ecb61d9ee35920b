"""`estimate_htf`: harmonic transfer functions from measured inputs and outputs (Sec. V).

It gets sums over all experiments from `spectral_sums.py`, one for each *line* k (the frequency k /
P), solves each line (`_solve_lines`), and returns an `HTF` with variances. With `references`,
`instrument.py` takes the place of both. A wrong H has its cause in `_solve_lines` or in the sums; a
wrong variance, in `variance` within `_solve_lines`; a variance that is missing, in
`_why_not_total`; lines that are missing, in `SpectralSums.solvable`. Each H must go on to have one
complex unknown for each input (two at mirrored lines): degrees of freedom are counted from these.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Count, Probability, SignalNames
from .._core.precision import require_x64
from ..errors import DefinitionError
from ..linear.frequency_response import Harmonics
from ..linear.htf import HTF, VarianceDof
from .descent import ROUNDING
from .instrument import htf_by_reference
from .spectral_sums import SILENT_LINE, Experiments, SpectralSums, spectral_sums


# Up to this number of realizations of a line, the shape of their scatter is estimated (see
# `roundness`). Smaller: if all errors have the same modulus, confidence regions are too small.
# Larger: needless, since the mean of many realizations is normally distributed.
_FEW_REALIZATIONS = 16


@checked
def estimate_htf(
    data: Experiments,
    harmonics: Harmonics | None = None,
    *,
    repeats: Count = 1,
    variance: Literal["auto", "noise", "total"] = "auto",
    threshold: Probability = SILENT_LINE,
    references: SignalNames | None = None,
) -> HTF:
    """Estimate all harmonic transfer functions at all frequencies that the inputs excite.

    `H_l(w_k) = Y[k + l P] / U[k]`, both DFTs over the same window of the last P whole periods. A
    line is an excited frequency f = k / P, in cycles per period. The lines are found from U itself,
    so that any experiments that obey the rules of a `Design` can be used. Where a line was measured
    more than once, the estimate is the least-squares one. If m inputs excite the same line, at
    least m experiments are needed to separate their responses. Failed experiments are left out, and
    so are lines that one of the inputs does not excite. At multiples of 1/2 (other than 0 and N/2)
    a line and its complex conjugate have responses at the same frequencies: `Y[k + l P] = H_l(w)
    U[k] + H_{l + 2f}(-w) conj(U[k])`. Two or more experiments with different phases determine both
    unknowns; if all have the same phase, these lines are left out.

    For a nonlinear system, this estimates the best linear approximation, for inputs of the kind
    that was applied (Pintelon and Schoukens 2012, ch. 3). With several realizations of random
    phases, `variance` contains noise and nonlinear distortion. With several windows (`repeats`),
    `noise_variance` contains noise alone. Without realizations, `variance` itself is that of noise
    alone.

    **Arguments:**

    - `data`: the experiments, or an iterable of parts of them, as `run_experiments` returns with
      `chunk` or `store`; only sums over experiments are kept in memory.
    - `harmonics`: m of the H_m to estimate, one integer or several: 2 is H_2 alone. Default: all N.
    - `repeats`: number of the last windows of P periods that are averaged. Default: 1.
    - `variance`: "noise" is computed from the repeats, "total" from the realizations; each raises
      an error if it is not available. "auto" is "total" if available, else "noise". Default:
      "auto".
    - `threshold`: a line counts as excited above this part of the largest |U| of its experiment.
      Raise it where the recorded input is noisy. Default: 1e-6.
    - `references`: names of the inputs that enter a control loop from outside. The controller sets
      the other inputs. The HTFs belong to the plant, from the other inputs to the outputs. Noise
      that the controller feeds back does not bias them (`identify/instrument.py`). References that
      excite f must also excite f + m for all integers m, up to N/2. Default: None; there is no
      controller.

    **Returns:** `hj.linear.HTF`: `H` (M, F, ny, nu), complex, in units of the output per unit of
    the input; `frequencies` (F,), ascending, in cycles per period; `variance`, of the shape of `H`.
    At a frequency that was measured in one realization only, `variance` is computed from the mean
    residual of the other frequencies. If this is so at most frequencies, `variance` is that of
    noise. Without `repeats`, it is then None, and fits use `power` as weights.

    **Raises:** `DefinitionError` if nothing was excited or no experiment is left, or if two lines
    of one experiment disturb each other (the message lists the pair). `DefinitionError` for too few
    periods or realizations for the requested variance; or for parts that do not belong together.

    **Example:**

    ```python
    htf = hj.estimate_htf(data, harmonics=(-1, 0, 1))
    print(htf.frequencies, htf[0].shape)
    ```

    **Before:** `hj.run_experiments`. **After:** `hj.select_order`, `hj.fit_multipliers` or
    `hj.fit_ldtp`.
    """
    if variance == "noise" and repeats < 2:
        raise DefinitionError(
            "the variance of noise alone needs two windows: record P periods more, pass repeats=2."
        )
    require_x64()
    if references is not None:
        htf = htf_by_reference(data, references, repeats, variance, threshold)
        return htf if harmonics is None else htf.select(harmonics)
    sums = spectral_sums(data, harmonics, threshold=threshold, repeats=repeats)
    rows = np.flatnonzero(sums.solvable())
    if len(rows) == 0:
        tried, ran = sums.experiments
        raise DefinitionError(
            f"no frequency can be estimated from {ran} experiments ({tried - ran} failed): excite "
            f"each frequency by each of the {len(sums.setup.inputs)} inputs, and multiples of 1/2 "
            "with two phases."
        )
    lines = _solve_lines(sums, rows)
    why_not = _why_not_total(sums, rows)
    if variance == "total":
        _require_total(why_not, sums.f[rows], lines.realizations)
    total = lines.noise
    noise = None
    variance_dof = None
    if variance != "noise" and np.median(lines.realizations) > 0 and not why_not:
        total = lines.total
        noise = lines.noise
        every = lines.realizations.sum()
        dof = np.where(lines.realizations < 1, every, lines.realizations)
        variance_dof = VarianceDof(dof.astype(float), _roundness(sums, rows, lines.H))
    elif lines.noise is not None:
        variance_dof = VarianceDof(sums.count[rows] * (repeats - 1.0))
    return HTF(
        sums.f[rows],
        lines.H,
        sums.harmonics,
        sums.setup.n_sections,
        sums.setup.inputs,
        sums.setup.outputs,
        "estimate",
        variance=total,
        noise_variance=noise,
        variance_dof=variance_dof,
        power=lines.power,
    )


def _require_total(
    why_not: str, f: Float[np.ndarray, " F"], realizations: Int[np.ndarray, " F"]
) -> None:
    """**Raises:** `DefinitionError` if the scatter of realizations does not show distortion."""
    if why_not:
        raise DefinitionError(why_not)
    single = realizations < 1
    if single.any():
        raise DefinitionError(
            f"a single realization, as at f = {f[single][0]:.10g}, does not show distortion: apply "
            "several (`Design.realizations`), or pass variance='noise'."
        )


class _LineEstimates(NamedTuple):
    """Least-squares estimates at F lines."""

    H: Complex[np.ndarray, "M F ny nu"]
    realizations: Int[np.ndarray, " F"]
    """Number of experiments less the number of unknowns: complex degrees of freedom of the
    residual."""
    total: Float[np.ndarray, "M F ny nu"]
    """Variance from the residual of a line; with one realization, from the mean residual of all
    lines."""
    noise: Float[np.ndarray, "M F ny nu"] | None
    """Variance from repeated windows; None where there was one window."""
    power: Float[np.ndarray, "F nu"]
    """Variance of white noise in the outputs, divided by the variance that it causes in H."""


def _solve_lines(sums: SpectralSums, rows: Int[np.ndarray, " F"]) -> _LineEstimates:
    r"""Solve `Y = H U + G conj(U)`, with G = 0 unless the line coincides with its mirror image (f
    is a multiple of 1/2).

    With p unknowns and R experiments the residuals have R - p complex degrees of freedom, and the
    variance of H is their mean square times the diagonal of the inverse of the normal matrix. The
    noise of each experiment, from repeated windows, is propagated in the same way.
    """
    nu = len(sums.setup.inputs)
    shape = sums.energy.shape[1:]
    mirrored = sums.mirrored[rows]
    H = np.zeros((len(rows), nu, *shape), complex)
    spread = np.zeros((len(rows), nu))
    residual = np.zeros((len(rows), *shape))
    for entries, unknowns in (
        (np.flatnonzero(~mirrored), nu),
        (np.flatnonzero(mirrored), 2 * nu),
    ):
        lines = rows[entries]
        right = sums.along[lines, :unknowns]
        inverse = np.linalg.inv(sums.gram[lines, :unknowns, :unknowns])
        solution = np.einsum("kij,kjml->kiml", inverse, right)
        explained = np.einsum("kiml,kiml->kml", solution.conj(), right).real
        H[entries] = solution[:, :nu]
        variances = np.real(np.linalg.diagonal(inverse))
        spread[entries] = variances[:, :nu]
        residual[entries] = np.maximum(sums.energy[lines] - explained, 0)

    def variance(square):
        by_input = square[:, None] * spread[:, :, None, None]
        return by_input.transpose(2, 0, 3, 1)

    count = sums.count[rows]
    realizations = count - np.where(mirrored, 2 * nu, nu)
    single = realizations < 1
    mean = residual / np.maximum(realizations, 1)[:, None, None]
    mean[single] = residual.sum(axis=0) / max(realizations.sum(), 1)
    noise = None
    if sums.repeats > 1:
        noise = variance(sums.noise[rows] / count[:, None, None])
    return _LineEstimates(
        H=H.transpose(2, 0, 3, 1),
        realizations=realizations,
        total=variance(mean),
        noise=noise,
        power=1 / spread,
    )


def _roundness(
    sums: SpectralSums, rows: Int[np.ndarray, " F"], H: Complex[np.ndarray, "M F ny nu"]
) -> Float[np.ndarray, "M F ny nu"] | None:
    r"""Return `VarianceDof.roundness` of the residuals of realizations.

    None if inputs share experiments, if lines coincide with their mirror images, or if there are
    many realizations. With the residuals $d_j = (Y_j - H U_j) \overline{U_j} / |U_j|$ of each
    input, $\sum_j |d_j|^2$ is the energy of Y less $|H|^2$ times the power of U, and $\sum_j d_j^2$
    follows in the same way.
    """
    nu = len(sums.setup.inputs)
    gram = sums.gram[rows, :nu, :nu]
    shared = (gram * ~np.eye(nu, dtype=bool)).any()
    if shared or sums.mirrored[rows].any() or sums.count.max() > _FEW_REALIZATIONS:
        return None
    power = np.real(np.linalg.diagonal(gram))[None, :, None]
    energy = sums.energies[rows].transpose(2, 0, 3, 1)
    turned = sums.turned[rows].transpose(2, 0, 3, 1)
    square = energy - np.abs(H) ** 2 * power
    square = np.where(square > ROUNDING * energy, square, 0.0)
    present = sums.present[rows][None, :, None]
    return roundness(square, turned - H**2 * power, present)


def roundness(
    square: Float[np.ndarray, "*shape"],
    turned: Complex[np.ndarray, "*shape"],
    count: Float[np.ndarray, "*#shape"],
) -> Float[np.ndarray, "*shape"]:
    r"""Return $1 - |\sum_j d_j^2|^2 / (\sum_j |d_j|^2)^2$ relative to its mean for Gaussian errors.

    The mean for n Gaussian errors is $(n - 2) / n$. (This is the square of Mauchly's criterion for
    their covariance in the plane, Annals of Mathematical Statistics 1940.) For two errors or fewer,
    the result is 1.

    **Arguments:** `square`: $\sum_j |d_j|^2$. `turned`: $\sum_j d_j^2$. `count`: n.
    """
    shaped = (count > 2) & (square > 0)
    part = np.divide(np.abs(turned), square, out=np.zeros_like(square), where=shaped)
    expected = 1 - 2 / np.maximum(count, 1)
    mean = np.where(count > 2, expected, 1)
    roundness = (1 - np.minimum(part, 1) ** 2) / mean
    return np.where(shaped, roundness, 1.0)


def _why_not_total(sums: SpectralSums, rows: Int[np.ndarray, " F"]) -> str:
    """Return the reason why the scatter over experiments does not show the effect of random phases;
    empty if it does."""
    nu = len(sums.setup.inputs)
    gram = sums.gram[rows]
    power = np.linalg.trace(gram[:, :nu, :nu])
    square = np.linalg.trace(gram[:, nu:, :nu])
    several = sums.count[rows] > nu
    # |sum of U^2| is the sum of |U|^2 where all phases are the same.
    alike = several & (np.abs(square) > (1 - SILENT_LINE) * power.real)
    tested, low = sums.crest_factors
    if several.any() and alike.sum() > several.sum() / 2:
        return (
            "the experiments repeat the same phases, so that their scatter does not show the "
            "distortion: apply realizations with new random phases (`Design.realizations`)."
        )
    if low >= max(2, tested / 2):  # by chance once in 10 000 times or less
        return (
            f"the phases are not random ({low} of {tested} signals have crest factors below those "
            "of 200 random draws), so that their scatter does not show the distortion: use random "
            "phases, or pass variance='noise'."
        )
    return ""
