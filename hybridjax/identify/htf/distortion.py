"""Nonlinear distortion where a linear system would be silent."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Count
from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...experiments.design.partition import line_class


# Part of the largest line of an input below which a line is not excited. Doubled: none but
# rounding.
_SILENT_LINE = 1e-6


class OutputLevels(eqx.Module):
    """Rms of one line of the output spectrum, by the kind of line; NaN where there is none.

    A linear periodic system answers only at lines whose class (distance of f from the nearest
    integer) is excited. What stands at others is noise or nonlinear distortion: of even order at
    even j, of odd order at odd j. What stands at the excited ones hides as much distortion.

    **Fields**, one entry per output: `excited`, `odd`, `even`; `noise`, from repeated windows, of
    their mean; `outputs`, names.
    """

    excited: Float[np.ndarray, " ny"]
    odd: Float[np.ndarray, " ny"]
    even: Float[np.ndarray, " ny"]
    noise: Float[np.ndarray, " ny"]
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        rows = [f"{'output':>12}  {'excited':>9}  {'odd':>9}  {'even':>9}  {'noise':>9}"]
        for k, name in enumerate(self.outputs):
            levels = (self.excited[k], self.odd[k], self.even[k], self.noise[k])
            rows.append(f"{name:>12}  " + "  ".join(f"{x:9.2e}" for x in levels))
        return "\n".join(rows)


@checked
def output_levels(data: ExperimentData, repeats: Count = 1) -> OutputLevels:
    """How much of the output stands at excited lines, and at odd and even ones that are not.

    Only where P is even and all excited lines are odd (`multisine(lines="odd")`) are the two kinds
    of distortion told apart. Integer f are left out: an error of the limit cycle stands there.
    Transients stand at all lines: remove them first.

    **Arguments:** `repeats`, windows that are averaged; from two on they give the noise.

    **Raises:** `DefinitionError` for excited lines that are not odd, an odd P, records that are
    too short, or no good experiment.
    """
    N, P = data.n_sections, data.periods
    if P % 2 or not data.ok.any():
        raise DefinitionError(
            f"output_levels needs an even number of periods (P = {P}) and a good experiment."
        )
    windows = data.windows(repeats)
    u, y = data.u[data.ok], data.y[data.ok]
    size = np.abs(np.fft.rfft(u[:, windows[-1]], axis=1)).max(axis=2)
    experiment, line = np.nonzero(size > _SILENT_LINE * size.max(axis=1, keepdims=True))
    if (line % 2 == 0).any():
        raise DefinitionError(
            f"f = {line[line % 2 == 0][0] / P:.10g} is an even line (j = f P), which hides even "
            "distortion: use a design of odd lines (multisine(lines='odd'))."
        )
    each = np.stack([np.fft.rfft(y[:, w], axis=1) for w in windows]) / (N * P / 2)
    Y = each.mean(axis=0)
    classes = line_class(np.arange(Y.shape[1]), P)
    excited = np.zeros((len(u), P // 2 + 1), bool)
    excited[experiment, line_class(line, P)] = True
    excited, integer = excited[:, classes], classes == 0
    odd = (classes % 2 == 1)[None]

    def level(where):
        where = np.broadcast_to(where, Y.shape[:2]) & ~integer
        if not where.any():
            return np.full(Y.shape[2], np.nan)
        return np.sqrt(np.mean(np.abs(Y[where]) ** 2, axis=0))

    noise = np.full(Y.shape[2], np.nan)
    if repeats > 1:
        noise = np.sqrt(np.mean(np.var(each, axis=0, ddof=1), axis=(0, 1)) / repeats)
    return OutputLevels(
        level(excited), level(~excited & odd), level(~excited & ~odd), noise, data.outputs
    )
