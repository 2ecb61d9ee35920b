"""Where an experiment learns: at which frequencies, and at which phases of the cycle."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive
from .._core.html import card, facts
from ..errors import DefinitionError
from ..experiments.design.design import Design
from ..identify.multipliers.error_weights import check_values, error_weights, require_frequencies
from ..identify.multipliers.variable_projection import HTFGroup, group_htf, misfit_of
from ..linear.htf import HTF
from .goals import Multipliers
from .questions.multipliers import FEW, wanted_parts
from .questions.question import weighted
from .signals import Model


class InformationMap(eqx.Module):
    """Where what an experiment tells comes from. The sum of all shares is 1.

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

    def __repr__(self) -> str:
        return f"InformationMap({'; '.join(f'{a}: {b}' for a, b in self._facts().items())})"

    def _repr_html_(self) -> str:
        return card("InformationMap", "", facts(self._facts()))

    def _facts(self) -> dict[str, str]:
        by_line, by_phase = self.share.sum(axis=(0, 2)), self.share.sum(axis=(0, 1))
        order = np.argsort(-by_line)
        half = order[: 1 + int(np.argmax(np.cumsum(by_line[order]) >= 0.5))]
        among = f"{self.f[half].min():.3g} to {self.f[half].max():.3g}"
        shares = zip(self.outputs, self.share.sum(axis=(1, 2)), strict=True)
        return {
            "half of it": f"in {len(half)} of {len(self.f)} lines, f = {among}",
            "outputs": ", ".join(f"{name} {100 * x:.0f} %" for name, x in shares),
            "best section": f"{np.argmax(by_phase)} of {len(by_phase)}, "
            f"{100 * by_phase.max():.2g} % ({100 / len(by_phase):.2g} % on the average)",
        }


@checked
def information_map(
    model: Model,
    design: Design,
    *,
    noise: Mapping[str, Positive],
    goal: Multipliers | None = None,
) -> InformationMap:
    r"""At which input frequencies, and at which phases of the cycle, multipliers become known.

    The derivatives of the HTFs by the multipliers' polynomial, less what numerators can imitate,
    and weighted by what each means for the goal, are a residual $r_m(f)$ for every harmonic, output
    and cosine; the criterion of the goal is the sum of their squares. A cosine's response at
    section n is $\sum_m H_m e^{2 \pi i (f + m) n / N}$, so that by Parseval's theorem

    $$\sum_m |r_m(f)|^2 = \frac1N \sum_n \Big|\sum_m r_m(f)\, e^{2 \pi i m n / N}\Big|^2,$$

    a sum over the sections at which the output is measured. With few harmonics this is a smooth
    function of the phase.

    **Arguments:**

    - `model`: exact or estimated. `design`: one input, as in `optimal_design`.
    - `noise`: standard deviation of the white noise of each output that is measured, by name.
    - `goal`: by default all multipliers; for `fit_multipliers`.

    **Raises:** `DefinitionError` for names that do not exist, too few frequencies, other
    estimators, several inputs.
    """
    goal = Multipliers() if goal is None else goal
    if goal.estimator != "fit_multipliers":
        raise DefinitionError("`goal`: a map of information is made for fit_multipliers only.")
    if len(design.input_names) > 1 or len(model.inputs) > 1:
        raise DefinitionError("`model` and `design` must have one input for a map of information.")
    if model.n_sections != design.n_sections:
        raise DefinitionError(
            f"`model` has {model.n_sections} sections, but `design` {design.n_sections}."
        )
    unknown = [name for name in noise if name not in model.outputs]
    if unknown or not noise:
        what = f"names '{unknown[0]}'" if unknown else "names no output"
        raise DefinitionError(f"`noise` {what}; the outputs are {', '.join(model.outputs)}.")
    htf = _measured(model, design, noise, FEW if goal.harmonics is None else goal.harmonics)
    c = np.poly(np.asarray(model.multipliers)).real[1:]
    N, d = htf.n_sections, len(c)
    size = d * N + (N if goal.overhang is None else goal.overhang) + 1
    require_frequencies(htf, d, size)
    groups = group_htf(htf, error_weights(htf, check_values(htf)), size)
    jacobians = [misfit_of(group, c).jacobian for group in groups]
    rows = [x.reshape(d, -1) for x in jacobians]
    covariance = np.linalg.inv(sum(x @ x.T for x in rows))
    wanted, names = wanted_parts(goal, np.asarray(model.multipliers), c)
    wanted, _ = weighted(wanted, names, goal.weights)
    influence = wanted @ covariance
    if goal.criterion == "D":
        influence = np.linalg.solve(np.linalg.cholesky(influence @ wanted.T), influence)
    residual = _by_harmonic(htf, groups, [np.tensordot(influence, x, 1) for x in jacobians])
    turn = np.exp(2j * np.pi * np.outer(htf.harmonics, np.arange(N)) / N)
    share = (np.abs(np.einsum("gmfo,mn->gofn", residual, turn)) ** 2).sum(axis=0)
    return InformationMap(np.asarray(htf.f), share / share.sum(), htf.outputs, design.periods)


def _measured(model: Model, design: Design, noise: Mapping[str, float], harmonics) -> HTF:
    """The model's HTFs of the outputs that are measured, with their variances."""
    seen = [i for i, name in enumerate(model.outputs) if name in noise]
    htf = model.htf(design.frequencies, harmonics)
    H = np.asarray(htf.H)[:, :, seen]
    std = np.array([noise[model.outputs[i]] for i in seen])
    variance = design.expected_variance()[:, None, :] * std[:, None] ** 2
    if not {(-m) % htf.n_sections for m in htf.harmonics} == {
        m % htf.n_sections for m in htf.harmonics
    }:
        raise DefinitionError(f"the harmonics must be symmetric about 0, not {htf.harmonics}.")
    return HTF(
        htf.f, H, htf.harmonics, htf.n_sections, htf.inputs,
        tuple(model.outputs[i] for i in seen), variance=np.broadcast_to(variance, H.shape),
    )  # fmt: skip


def _by_harmonic(
    htf: HTF, groups: list[HTFGroup], parts: list[Float[np.ndarray, "g 2 _ _"]]
) -> Complex[np.ndarray, "g M F ny"]:
    """Of each harmonic at f alone. (Rows of pairs hold H_m at f, and then the conjugate of H_{-m},
    which is H_m at -f.)"""
    F = len(htf.f)
    out = np.zeros((len(parts[0]), len(htf.harmonics), F, len(htf.outputs)), complex)
    for group, part in zip(groups, parts, strict=True):
        value = part[:, 0] + 1j * part[:, 1]
        output = group.channel[:, 0]
        out[:, group.harmonic, :, output] = np.moveaxis(value[:, :F], 2, 0)
        if group.mirror is not None:
            out[:, group.mirror, :, output] = np.moveaxis(value[:, F:].conj(), 2, 0)
    return out
