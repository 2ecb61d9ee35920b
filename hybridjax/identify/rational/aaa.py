"""Rational approximation by AAA, to compare with: no structure, as many poles as it takes."""

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from scipy.interpolate import AAA

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count, Positive
from ..._core.precision import require_x64
from ...errors import DefinitionError
from ...linear.htf import HTF
from ..multipliers.compare import (
    MultiplierComparison,
    Multipliers,
    channel_index,
    compare_by_output,
)


# Imaginary part of z up to which it is real, so that it is its own mirror image. Doubled: none but
# rounding.
_REAL = 1e-12


class AAAFit(eqx.Module):
    r"""Rational functions of $z = e^{2 \pi i f / N}$ found by AAA, one per output.

    On exact data there is a cluster of N poles at the N-th roots of every multiplier; on noisy
    data there are pairs of a pole and a zero that nearly cancel, which stand for nothing.

    **Fields** (ny outputs on the first axis; rows are filled up with NaN):

    - `poles` (ny, p) in z, those closest to the unit circle first, and `residues` (ny, p).
    - `multipliers` (ny, p): poles to the power N.
    - `residual` (ny,): rms misfit relative to the rms of H.
    - `harmonic`, `n_sections`, `outputs`, `input`: what was fitted.
    """

    poles: Complex[np.ndarray, "ny p"]
    residues: Complex[np.ndarray, "ny p"]
    multipliers: Complex[np.ndarray, "ny p"]
    residual: Float[np.ndarray, " ny"]
    harmonic: int = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    input: str = eqx.field(static=True)

    @checked
    def compare(self, true: Multipliers, output: str | int | None = None) -> MultiplierComparison:
        """For each output (or one alone) the multipliers that come closest to the true ones.

        **Raises:** `DefinitionError` for an output that is not there.
        """
        rows = [row[np.isfinite(row)] for row in self.multipliers]
        return compare_by_output(rows, true, self.outputs, output)

    def __repr__(self) -> str:
        counts = np.isfinite(self.poles).sum(axis=1)
        rows = ", ".join(
            f"{name} {k} poles, residual {r:.1e}"
            for name, k, r in zip(self.outputs, counts, self.residual, strict=True)
        )
        return f"AAAFit(H_{self.harmonic} from {self.input}: {rows})"


@checked
def fit_aaa(
    htf: HTF,
    harmonic: int = 0,
    *,
    input: str | int = 0,
    tolerance: Positive = 1e-13,
    terms: Count = 100,
) -> AAAFit:
    """Approximate one harmonic by rational functions with the AAA algorithm.

    Nakatsukasa, Sete and Trefethen, SIAM J. Sci. Comput. 40 (2018), as scipy has it. For m = 0
    (and N/2) the values at negative frequencies are added.

    **Arguments:**

    - `tolerance`: largest misfit relative to max |H| at which it stops; on noisy data choose about
      the noise. `terms`: most support points, one more than poles.

    **Raises:** `DefinitionError` for a harmonic or input that is not there, or NaN.
    """
    require_x64(htf.H)
    column = channel_index("input", input, htf.inputs)
    H, N = np.asarray(htf.harmonic(harmonic))[:, :, column], htf.n_sections
    if not np.isfinite(H).all():
        raise DefinitionError(f"H_{harmonic} holds NaN or infinity.")
    z = np.exp(2j * np.pi * np.asarray(htf.f) / N)
    if 2 * harmonic % N == 0:
        both = np.abs(z.imag) > _REAL
        z, H = np.concatenate([z, z[both].conj()]), np.concatenate([H, H[both].conj()])
    found = []
    for values in H.T:
        fit = AAA(z, values, rtol=tolerance, max_terms=terms, clean_up=False)
        poles, residues = fit.poles(), fit.residues()
        order = np.argsort(np.abs(np.log(np.maximum(np.abs(poles), 1e-300))))
        misfit = np.sqrt(np.mean(np.abs(fit(z) - values) ** 2) / np.mean(np.abs(values) ** 2))
        found.append((poles[order], residues[order], float(misfit)))
    longest = max(len(poles) for poles, _, _ in found)

    def rows(index):
        out = np.full((len(found), longest), np.nan, complex)
        for row, one in zip(out, found, strict=True):
            row[: len(one[index])] = one[index]
        return out

    poles = rows(0)
    return AAAFit(
        poles=poles,
        residues=rows(1),
        multipliers=poles**N,
        residual=np.array([one[2] for one in found]),
        harmonic=harmonic,
        n_sections=N,
        outputs=htf.outputs,
        input=htf.inputs[column],
    )
