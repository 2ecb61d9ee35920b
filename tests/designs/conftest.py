import numpy as np
import pytest

import hybridjax as hj


@pytest.fixture(scope="module")
def model():
    """Two states, slow and with little damping, pushed and seen in changing directions."""
    turn = 2 * np.pi * np.arange(8) / 8
    A = 0.97 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    B = np.stack([np.cos(turn), np.sin(turn)], axis=1)[:, :, None]
    C = np.stack([np.ones((8, 2)), np.stack([np.sin(turn), np.cos(turn)], axis=1)], axis=1)
    return hj.LDTP(np.broadcast_to(A, (8, 2, 2)), B, C, inputs="u", outputs=("x", "v"))


def expected_htf(model, design, noise, harmonics=None):
    """The exact HTFs at the lines of a design, with the variance that they are measured with."""
    htf = model.htf(design.frequencies, harmonics)
    variance = design.expected_variance()[:, None, :] * np.square(list(noise.values()))[:, None]
    return hj.HTF(
        htf.f, htf.H, htf.harmonics, htf.n_sections, model.inputs, model.outputs,
        variance=np.broadcast_to(variance, htf.H.shape),
    )  # fmt: skip
