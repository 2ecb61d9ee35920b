"""Mean squares of the signals of a model, per unit of each cosine's power."""

import numpy as np
from jaxtyping import Float

from ..identify.multipliers import StructuredFit
from ..linear.ldtp import LDTP
from .candidates import Candidates


Model = LDTP | StructuredFit
Squares = dict[str, Float[np.ndarray, " K"]]
"""By name."""


def rate_of(name: str) -> str:
    return f"rate of {name}"


def mean_squares(model: Model, cosines: Candidates) -> Squares:
    """Of inputs, outputs, changes of inputs from one section to the next, and states.

    A cosine of f changes by $2 \\sin(\\pi f / N)$ times its amplitude. States are those with a name
    that no output has; where a section lacks one it does not deviate.
    """
    inputs = {n: (cosines.channel == i).astype(float) for i, n in enumerate(model.inputs)}
    change = 4 * np.sin(np.pi * cosines.f / cosines.n_sections) ** 2
    rates = {rate_of(name): one * change for name, one in inputs.items()}
    return {**inputs, **_responses(model, cosines), **rates, **_states(model, cosines)}


def rms_of(
    squares: list[Squares], names: list[str], power: Float[np.ndarray, " K"]
) -> dict[str, float]:
    """Of some signals; of several models the root of the mean square."""
    return {n: float(np.sqrt(np.mean([one[n] @ power for one in squares]))) for n in names}


def _responses(model: Model, cosines: Candidates) -> Squares:
    H = np.asarray(model.htf(cosines.f).H)
    squares = (np.abs(H) ** 2).sum(axis=0)[np.arange(len(cosines.f)), :, cosines.channel]
    return dict(zip(model.outputs, squares.T, strict=True))


def _states(model: Model, cosines: Candidates) -> Squares:
    if not isinstance(model, LDTP) or model.coordinates is None:
        return {}
    names = sorted({x for here in model.coordinates for x in here} - set(model.outputs))
    if not names:
        return {}
    C = np.zeros((model.n_sections, len(names), model.A.shape[-1]))
    for n, here in enumerate(model.coordinates):
        for k, name in enumerate(here):
            if name in names:
                C[n, names.index(name), k] = 1.0
    dims = np.asarray(model.dims)
    shown = LDTP(model.A, model.B, C, dims=dims, inputs=model.inputs, outputs=names)
    return _responses(shown, cosines)
