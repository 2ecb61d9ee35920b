"""The distribution of information over input frequencies and phases of the cycle."""

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..identify.variable_projection import (
    HTFGroup,
    grouped,
    misfit_of,
)
from ..linear.htf import HTF
from .candidates import Model, NoiseLike, make_noise, with_variance
from .criteria import require_symmetric, wanted_parts
from .goals import Multipliers


class InformationMap(eqx.Module):
    """The distribution of information. The sum of all shares is 1.

    **Fields:**

    - `f` (F,): input frequencies, cycles per period; they are multiples of 1/`periods`.
    - `share` (ny, F, N): of the information that is in an output's response to a cosine, as it is
      measured at a section. If the noise there had a variance that is smaller by 1 %, the criterion
      of the goal would be smaller by this share of 1 %.
    - `outputs`; `periods`.
    """

    f: Float[np.ndarray, " F"]
    share: Float[np.ndarray, "ny F N"]
    outputs: tuple[str, ...] = eqx.field(static=True)
    periods: int = eqx.field(static=True)


@checked
def information_map(
    model: Model, design: Design, *, noise: NoiseLike, goal: Multipliers | None = None
) -> InformationMap:
    r"""Find the input frequencies, and the phases of the cycle, that identify multipliers.

    The multipliers are identified by the derivatives of the HTFs with respect to the coefficients
    of the multipliers' polynomial. Without the part that numerators can explain, and weighted by
    their effect on the goal, these derivatives are residuals $r_m(f)$ for each harmonic, output and
    cosine. The criterion of the goal is the sum of squares of the residuals. A cosine's response at
    section n is $\sum_m H_m e^{2 \pi i (f + m) n / N}$, so that by Parseval's theorem

    $$\sum_m |r_m(f)|^2 = \frac1N \sum_n \Big|\sum_m r_m(f)\, e^{2 \pi i m n / N}\Big|^2,$$

    a sum over the sections at which the output is measured. With few harmonics this is a smooth
    function of the phase.

    **Arguments:**

    - `model`: exact or estimated. `design`: one input, as in `optimal_design`.
    - `noise`: as in `optimal_design`.
    - `goal`: multipliers by `fit_multipliers`. Default: all.

    **Raises:** `DefinitionError` for names that do not exist, too few frequencies, other
    estimators, several inputs.
    """
    goal = Multipliers() if goal is None else goal
    if goal.estimator != "fit_multipliers":
        raise DefinitionError("`goal`: an information map needs the estimator fit_multipliers.")
    if len(design.input_names) > 1 or len(model.inputs) > 1:
        raise DefinitionError("`model` and `design` must have one input for a map of information.")
    if model.n_sections != design.n_sections:
        raise DefinitionError(
            f"`model` has {model.n_sections} sections, but `design` {design.n_sections}."
        )
    errors = make_noise(model, noise, {})
    htf = model.htf(design.frequencies, goal.fitted_harmonics)
    require_symmetric(htf.harmonics, htf.n_sections)
    variance = errors.spectrum(design.frequencies, htf.harmonics)[..., None]
    htf = with_variance(htf, errors, variance * design.expected_variance()[:, None], 0)

    c = np.poly(np.asarray(model.multipliers)).real[1:]
    N, d = htf.n_sections, len(c)
    groups = grouped(htf, d, goal.overhang)
    jacobians = [misfit_of(group, c).jacobian for group in groups]
    rows = np.concatenate([x.reshape(d, -1) for x in jacobians], axis=1)
    wanted, _ = wanted_parts(goal, np.asarray(model.multipliers), c)
    influence = wanted @ np.linalg.inv(rows @ rows.T)
    residual = _by_harmonic(htf, groups, [np.tensordot(influence, x, 1) for x in jacobians])
    turn = np.exp(2j * np.pi * np.outer(htf.harmonics, np.arange(N)) / N)
    share = (np.abs(np.einsum("gmfo,mn->gofn", residual, turn)) ** 2).sum(axis=0)
    return InformationMap(np.asarray(htf.f), share / share.sum(), htf.outputs, design.periods)


def _by_harmonic(
    htf: HTF, groups: list[HTFGroup], parts: list[Float[np.ndarray, "g 2 _ _"]]
) -> Complex[np.ndarray, "g M F ny"]:
    """Return the residuals of each harmonic at f alone. (Rows of pairs hold H_m at f, and then the
    conjugate of H_{-m}, which is H_m at -f.)"""
    F = len(htf.f)
    residual = np.zeros((len(parts[0]), len(htf.harmonics), F, len(htf.outputs)), complex)
    for group, part in zip(groups, parts, strict=True):
        value = part[:, 0] + 1j * part[:, 1]
        output = group.channel[:, 0]
        residual[:, group.harmonic, :, output] = np.moveaxis(value[:, :F], 2, 0)
        if group.mirror is not None:
            residual[:, group.mirror, :, output] = np.moveaxis(value[:, F:].conj(), 2, 0)
    return residual
