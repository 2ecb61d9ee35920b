"""Experiments whose signals stay below a peak."""

import dataclasses

import numpy as np
from jaxtyping import Int

from ...experiments.design.design import Design
from ...experiments.design.multisine import optimize_phases


def below_peaks(design: Design, peak: dict[str, float], seed: int) -> Design:
    """The design with phases for low peaks, and with experiments that still exceed one made
    smaller."""
    phase = np.array(design.phase)
    for e in range(design.experiments):
        here = np.flatnonzero(design.experiment == e)
        # (Alone, so that a line that stands in several experiments may have any phase.)
        phase[here] = optimize_phases(_one(design, here), seed).phase
    design = dataclasses.replace(design, phase=phase)
    highest = np.abs(design.inputs()).max(axis=1)
    factor = np.ones_like(highest)
    for name, most in peak.items():
        i = design.input_names.index(name)
        factor[:, i] = most / np.maximum(highest[:, i], most)
    amplitude = np.asarray(design.amplitude) * factor[design.experiment, design.channel]
    return dataclasses.replace(design, amplitude=amplitude)


def _one(design: Design, here: Int[np.ndarray, " k"]) -> Design:
    """One experiment."""
    parts = {n: getattr(design, n)[here] for n in ("line", "channel", "amplitude", "phase")}
    return dataclasses.replace(design, experiment=0 * here, experiments=1, **parts)
