"""Up to which amplitude a linear model holds."""

from collections.abc import Callable
from typing import Annotated, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._core.arguments import Numbers, require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import Positive
from .._core.boundary.values import Reals
from ..errors import DefinitionError
from ..experiments.data import ExperimentData
from ..linear.ldtp import LDTP
from .validate import simulate_record


class AmplitudeSweep(eqx.Module):
    """The misfit of a linear model for growing inputs. Printing it gives a table.

    **Fields:** `amplitudes` (A,): factors of the input; `rms` (A, nu): of the inputs; `misfit`
    (A, ny): rms of the difference from the model relative to the rms of the output, NaN where no
    experiment ran to its end; `failed` (A,): number of experiments that did not.
    """

    amplitudes: Float[np.ndarray, " A"]
    rms: Float[np.ndarray, "A nu"]
    misfit: Float[np.ndarray, "A ny"]
    failed: Float[np.ndarray, " A"]
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    @checked
    def limit(self, misfit: Positive) -> float:
        """Return the amplitude up to which no misfit exceeds this one, by log-log interpolation.

        **Raises:** `DefinitionError` if the smallest amplitude tried has a larger misfit.
        """
        worst = np.where(np.isnan(self.misfit), np.inf, self.misfit).max(axis=1)
        k = int(np.argmax(np.append(worst > misfit, True)))
        if k == 0:
            raise DefinitionError(
                f"the smallest amplitude tried has a misfit of {worst[0]:.2g} already: try smaller "
                "ones, or allow more."
            )
        if k == len(worst) or np.isinf(worst[k]) or worst[k - 1] == 0:
            return float(self.amplitudes[k - 1])
        x, y = np.log(self.amplitudes[k - 1 : k + 1]), np.log(worst[k - 1 : k + 1])
        return float(np.exp(np.interp(np.log(misfit), y, x)))

    def __repr__(self) -> str:
        head = "".join(f"  {name:>10}" for name in self.outputs)
        rows = [f"{'amplitude':>10}  {'rms input':>10}{head}  failed"]
        for a, u, misfit, failed in zip(
            self.amplitudes, self.rms, self.misfit, self.failed, strict=True
        ):
            values = "".join(f"  {x:10.2e}" for x in misfit)
            rows.append(f"{a:10.4g}  {np.max(u):10.2e}{values}  {int(failed):6d}")
        return "\n".join(rows)


@checked
def amplitude_sweep(
    run: Callable[[Float[np.ndarray, "S n nu"]], ExperimentData],
    model: LDTP,
    u: Annotated[Numbers, Reals("S n nu")],
    amplitudes: Annotated[Numbers, Reals("A", sign="positive")],
    *,
    start: Literal["free", "cycle"] = "cycle",
) -> AmplitudeSweep:
    """Apply an input at several amplitudes and compare the outputs with the linear model's.

    **Arguments:**

    - `run`: function that makes experiments from inputs (S, n, nu): a simulation, e.g.
      `lambda u: hj.run_experiments(cycle, sections, u, outputs)`, or a laboratory.
    - `model`: the linear one. `u` (S, n, nu): inputs at amplitude 1. `amplitudes` (A,): positive
      factors.
    - `start`: as in `validate`. Default: "cycle", experiments start on the limit cycle.

    **Raises:** `DefinitionError` for amplitudes that are not positive and finite.
    """
    free_start = start == "free"
    if 0 in np.shape(u):
        raise DefinitionError("`u` must hold one sample or more.")
    factors = np.sort(np.asarray(amplitudes))
    if not len(factors):
        raise DefinitionError("`amplitudes` must hold one amplitude or more.")
    misfit, rms, failed = [], [], []
    for a in factors:
        data = run(a * np.asarray(u))
        if not isinstance(data, ExperimentData):
            raise DefinitionError(
                f"`run` must return ExperimentData, but returned a {type(data).__name__}."
            )
        require_same("model and data", model, data)
        failed.append(float((~data.ok).sum()))
        rms.append(np.sqrt(np.mean(data.u**2, axis=(0, 1))))
        square = np.zeros((2, len(data.outputs)))
        for record in data.records:
            error = record.y - simulate_record(model, record, free_start)
            square += [(error**2).sum(axis=0), (record.y**2).sum(axis=0)]
        with np.errstate(invalid="ignore"):
            misfit.append(np.sqrt(square[0] / square[1]))
    return AmplitudeSweep(
        factors, np.array(rms), np.array(misfit), np.array(failed), model.inputs, model.outputs
    )
