"""Experiments whose signals stay below a peak."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..experiments.design.crest import optimize_phases
from ..experiments.design.design import Design


def below_peaks(design: Design, peak: dict[str, float], seed: int) -> Design:
    """The design with phases for low peaks, and with experiments that still exceed one made
    smaller."""
    phase = np.array(design.phase)
    for e in range(design.experiments):
        here = np.flatnonzero(design.experiment == e)
        # (Alone, so that a line that stands in several experiments may have any phase.)
        phase[here] = optimize_phases(_one(design, here), seed).phase
    design = dataclasses.replace(design, phase=phase)
    return scaled_below(design, peak, each=True)


def scaled_below(design: Design, peak: dict[str, float], each: bool) -> Design:
    """The design with amplitudes made smaller where a signal exceeds its peak.

    **Arguments:** `each`: each experiment by itself, else all by the same factor.
    """
    factor = np.ones(design.experiments)
    for name, most in peak.items():
        u = design.inputs()[:, :, design.input_names.index(name)]
        factor = np.minimum(factor, most / np.maximum(np.abs(u).max(axis=1), most))
    factor = factor if each else np.full(design.experiments, factor.min())
    amplitude = np.asarray(design.amplitude) * factor[design.experiment]
    return dataclasses.replace(design, amplitude=amplitude)


def _one(design: Design, here: Float[np.ndarray, " k"]) -> Design:
    """One experiment."""
    parts = {n: getattr(design, n)[here] for n in ("line", "channel", "amplitude", "phase")}
    return dataclasses.replace(design, experiment=0 * here, experiments=1, **parts)
