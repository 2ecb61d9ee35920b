"""How large the noise is with which outputs are measured."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .._core.boundary.kinds import Positive
from .._core.text import listed
from ..errors import DefinitionError
from ..identify.joint.ldtp_fit import LDTPFit
from ..identify.joint.noise import noise_spectrum
from ..linear.ldtp import LDTP
from .signals import Model


NoiseLike = Mapping[str, Positive | Callable[[np.ndarray], np.ndarray]] | LDTP | LDTPFit

# Noise that nobody gave, relative to the rms of the output in the usual design: 20 dB. Doubled: all
# standard errors are.
_NOISE = 0.1


class Noise(NamedTuple):
    """Of the outputs that are measured."""

    seen: Int[np.ndarray, " seen"]
    """Which ones."""
    spectrum: Callable[[Float[np.ndarray, " F"], tuple[int, ...]], Float[np.ndarray, "M F seen"]]
    """At the harmonics m of lines f: the variance of white noise that is as strong there."""


def make_noise(model: Model, noise: NoiseLike | None, rms: dict[str, float]) -> Noise:
    """**Arguments:** `rms`, of the signals in the usual design.

    **Raises:** `DefinitionError` for outputs that do not exist, and spectra that are not positive.
    """
    outputs, N = model.outputs, model.n_sections
    if isinstance(noise, LDTP | LDTPFit):
        return _estimated(noise, outputs, N)
    if noise is None:
        noise = {name: _NOISE * rms[name] for name in outputs if rms[name] > 0}
    unknown = [name for name in noise if name not in outputs]
    if unknown or not noise:
        what = f"names '{unknown[0]}'" if unknown else "names no output"
        raise DefinitionError(f"`noise` {what}; the outputs are {', '.join(outputs)}.")
    seen = [name for name in outputs if name in noise]

    def spectrum(f, harmonics):
        at = f + np.array(harmonics)[:, None]
        at = np.abs((at + N / 2) % N - N / 2)
        return np.stack([_level(name, noise[name], at) for name in seen], axis=2) ** 2

    return Noise(np.array([outputs.index(name) for name in seen]), spectrum)


def _estimated(noise: LDTP | LDTPFit, outputs: tuple[str, ...], n_sections: int) -> Noise:
    if noise.n_sections != n_sections or any(name not in outputs for name in noise.outputs):
        raise DefinitionError(
            f"`noise` is of {noise.n_sections} sections and the outputs {listed(noise.outputs)}, "
            f"the model of {n_sections} and {listed(outputs)}."
        )

    def spectrum(f, harmonics):
        if isinstance(noise, LDTPFit):
            return noise.noise_spectrum(f, harmonics)
        return noise_spectrum(noise, f, harmonics)

    return Noise(np.array([outputs.index(name) for name in noise.outputs]), spectrum)


def _level(name: str, level, f: Float[np.ndarray, "M F"]) -> Float[np.ndarray, "M F"]:
    if not callable(level):
        return np.full(f.shape, float(level))
    found = np.asarray(level(f))
    if found.dtype.kind not in "fiu" or found.shape not in ((), f.shape):
        raise DefinitionError(f"`noise` of {name} must give a real number for each frequency.")
    if not ((found > 0) & np.isfinite(found)).all():
        raise DefinitionError(f"`noise` of {name} must give positive numbers at all frequencies.")
    return np.broadcast_to(found, f.shape).astype(float)
