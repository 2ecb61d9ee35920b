"""What may be done to recorded experiments before an estimate: noise added, pairs combined."""

from typing import Annotated

import equinox as eqx
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import NonNegative, Numbers, Seed
from .._core.boundary.values import Reals
from .._core.results import Result
from ..errors import DefinitionError
from .data import ExperimentData, Simulated
from .noise import with_memory


@checked
def add_noise(
    data: ExperimentData,
    *,
    std: Annotated[Numbers, Reals(sign="nonnegative")] | None = None,
    snr: float | None = None,
    memory: NonNegative = 0.0,
    seed: Seed = 0,
) -> ExperimentData:
    """Measurement noise added to all outputs of all samples, independent from output to output.

    **Arguments:**

    - `std`: its standard deviation, one number, one for each output, or (N, ny) also by section; or
    - `snr`: 10 log10 of the ratio of the variances of the outputs' deviations from the cycle (over
      all samples and good experiments) and of the noise, in dB, for each output.
    - `memory`: its correlation time in cycles, as of `ProcessNoise`; 0 for white noise.

    **Raises:** `DefinitionError` unless exactly one of `std` and `snr` is given, for so many
    outputs and sections.
    """
    if (std is None) == (snr is None):
        raise DefinitionError("add_noise needs either `std` or `snr`.")
    if snr is not None:
        if not data.ok.any():
            raise DefinitionError("no experiment ran well, so there is no signal to compare with.")
        std = np.sqrt(np.mean(data.y[data.ok] ** 2, axis=(0, 1))) * 10 ** (-snr / 20)
    N, ny = data.n_sections, data.y.shape[2]
    if np.shape(std) not in ((), (ny,), (N, ny)):
        raise DefinitionError(
            f"`std` must be one number or {ny}, one for each output, or of shape ({N}, {ny}), not "
            f"{std}."
        )
    white = np.random.default_rng(seed).normal(size=data.y.shape)
    each = np.resize(np.broadcast_to(std, (N, ny)), data.y.shape[1:])
    return eqx.tree_at(lambda d: d.y, data, data.y + each * with_memory(white, memory, N))


@checked
def odd_part(data: ExperimentData) -> ExperimentData:
    """Half the difference of each pair of experiments with opposite inputs.

    Even-order distortion is the same for u and -u and cancels; so do offsets, such as an error of
    the limit cycle. A pair with a failed member counts as failed. Events belong to no pair and are
    left out.

    **Arguments:** `data` of a design `with_negatives()`: experiments 2k and 2k + 1 are a pair.

    **Raises:** `DefinitionError` for experiments that are no such pairs.
    """
    plus, minus = data.u[::2], data.u[1::2]
    if len(data.u) % 2:
        raise DefinitionError(f"{len(data.u)} experiments are not pairs: one has no partner.")
    sum_ = np.abs(plus + minus).max(axis=(1, 2))
    apart = ~(sum_ <= 1e-9 * np.maximum(np.abs(plus).max(axis=(1, 2)), 1e-300))
    if apart.any():
        k = 2 * int(np.argmax(apart))
        raise DefinitionError(
            f"experiments {k} and {k + 1} are no pair: their inputs are not opposite "
            "(`Design.with_negatives` makes pairs)."
        )
    first, second = data.result[::2], data.result[1::2]
    broken = first != Result.OK
    result = np.where(broken, first, second)
    failed_at = np.where(broken, data.failed_at[::2], data.failed_at[1::2])
    error = np.maximum(data.error[::2], data.error[1::2])
    return ExperimentData(
        plus,
        (data.y[::2] - data.y[1::2]) / 2,
        n_sections=data.n_sections,
        periods=data.periods,
        inputs=data.inputs,
        outputs=data.outputs,
        result=result,
        simulated=Simulated(failed_at, error),
        cycle_outputs=data.cycle_outputs,
        label=data.label,
    )
