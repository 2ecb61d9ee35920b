"""What the cosines of a design measure, and how exactly."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ...linear.frequency_response import Harmonics
from ...linear.htf import HTF
from ..candidates import Candidates
from ..noise import Noise
from ..signals import Model


class Measured(NamedTuple):
    """The HTFs of one input and the measured outputs."""

    htf: HTF
    """With the variances that power 1 gives."""
    cosines: Int[np.ndarray, " F"]
    """Which of the candidates these frequencies are."""
    channel: int


def measured(
    model: Model, cosines: Candidates, harmonics: Harmonics | None, noise: Noise
) -> Iterator[Measured]:
    r"""Of each input that is used.

    The variance is $v = 4 S / (N P \sum a^2)$ (`Design.expected_variance`), where the sum of
    a^2/2 over all experiments is the power times their number, and S the noise's spectrum at the
    harmonic.
    """
    for i in np.unique(cosines.channel):
        here = np.flatnonzero(cosines.channel == i)
        htf = model.htf(cosines.f[here], harmonics)
        H = np.asarray(htf.H)[:, :, noise.seen, i : i + 1]
        spectrum = noise.spectrum(cosines.f[here], htf.harmonics)
        variance = 2 * spectrum[..., None] / (cosines.n_sections * cosines.strides)
        found = HTF(
            htf.f, H, htf.harmonics, htf.n_sections, (model.inputs[i],),
            tuple(model.outputs[k] for k in noise.seen), variance=variance,
        )  # fmt: skip
        yield Measured(found, here, int(i))
