"""What a design would get wrong on a linear system that is known."""

import numpy as np
from jaxtyping import Float

from ..._core.boundary.checked import checked
from ...errors import DefinitionError
from ...experiments.data import ExperimentData
from ...experiments.design.design import Design
from ...experiments.noise import simulate_experiments
from ...linear.frequency_response import Harmonics
from ...linear.htf import HTF
from ...linear.ldtp import LDTP
from .nonparametric import estimate_htf


@checked
def predict_leakage(
    design: Design, model: LDTP | HTF, harmonics: Harmonics | None = None
) -> Float[np.ndarray, "M ny"]:
    """The error of every harmonic that comes from those which the design takes as zero.

    The design is run on the model, in its periodic response and without noise, and estimated as its
    data would be. A design without `highest_harmonic` makes no such error.

    **Arguments:**

    - `model`: exact, or a first estimate: an `LDTP`, or an `HTF` that has the frequencies of the
      design and all harmonics that matter, symmetric about 0 (`HTF.interpolate` fills gaps).
    - `harmonics`: by default all up to `highest_harmonic` (or all that the HTF has).

    **Returns:** the largest error over frequencies and inputs, relative to the largest |H_0| of
    that output, per harmonic and output.

    **Raises:** `DefinitionError` if design and model do not fit together.
    """
    if isinstance(model, LDTP):
        data = simulate_experiments(model, design, start="periodic")
    else:
        if (model.n_sections, len(model.inputs)) != (design.n_sections, len(design.input_names)):
            raise DefinitionError(
                f"the design is for N = {design.n_sections} and {len(design.input_names)} inputs, "
                f"the HTF has N = {model.n_sections} and {len(model.inputs)}."
            )
        u = design.inputs()
        y = np.stack([np.asarray(model.predict(x)) for x in u])
        data = ExperimentData(
            u, y, n_sections=design.n_sections, periods=design.periods,
            inputs=model.inputs, outputs=model.outputs,
        )  # fmt: skip
    if harmonics is None and isinstance(model, HTF) and design.highest_harmonic is None:
        harmonics = model.harmonics
    estimate = estimate_htf(data, harmonics, highest=design.highest_harmonic)
    if isinstance(model, LDTP):
        exact = model.htf(estimate.f, estimate.harmonics)
    else:
        exact = model.interpolate(estimate.f).select(estimate.harmonics)
    return np.asarray(estimate.harmonic_errors(exact))
