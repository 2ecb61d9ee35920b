"""Designs whose distortion is limited: a row of `designs.py`."""

import time

import numpy as np
from second_order import OUTPUTS

import hybridjax as hj


# White noise of the outputs, and rms of their distortion: a tenth of it.
NOISE = {"yM": 6e-6, "vM": 1.2e-5}
ALLOWED = {"yM": 6e-7, "vM": 1.2e-6}


def distortion(family, draws: int) -> None:
    """All lines, and odd ones."""
    limit = hj.designs.Distortion(family.cycle, family.placed.family, ALLOWED)
    kept = hj.designs.Limits(distortion=limit)
    designs = {"all": hj.multisine(), "odd": hj.multisine(periods=128, lines="odd")}
    for name, usual in designs.items():
        row = f"distortion.{name}"
        begin = time.process_time()
        plan = hj.optimal_design(family.model, usual, limit=kept, noise=NOISE)
        family.show(f"{row}.cpu_seconds", time.process_time() - begin)
        family.show(f"{row}.saved", plan.saved)
        family.show(f"{row}.certificate", plan.certificate)
        for signal in ("u", *OUTPUTS):
            family.show(f"{row}.rms.{signal}", plan.rms[signal])
            family.show(f"{row}.rms.{signal}.usual", plan.usual_rms[signal])
        for output, found, odd in zip(
            OUTPUTS, *not_linear(family, plan.design), strict=True
        ):
            said = plan.rms[f"distortion of {output}"]
            family.show(f"{row}.predicted.{output}", said)
            family.show(f"{row}.simulated_to_predicted.{output}", found / said)
            family.show(f"{row}.odd_part.{output}", odd / found)
        # The design for a limited input, as strong as its distortion allows.
        other = hj.optimal_design(family.model, usual, noise=NOISE).design
        scaled = hj.optimal_design(family.model, other, limit=kept, noise=NOISE)
        family.show(
            f"{row}.saved_beside_input", scaled.usual_criterion / plan.criterion
        )


def not_linear(family, design: hj.experiments.Design) -> tuple[np.ndarray, np.ndarray]:
    """rms of what is not linear in the response of the hopper, one draw of the phases, and of what
    is odd in it."""
    u, model = design.signals(), family.model
    starts = model.periodic_states(u, design.periods)
    linear = np.stack(
        [model.simulate(one, x0) for one, x0 in zip(u, starts, strict=True)]
    )
    up, down = (
        hj.run_experiments(
            family.cycle, family.placed, one, OUTPUTS, start="steady", accuracy=1e-11
        ).y
        for one in (u, -u)
    )
    return tuple(
        np.sqrt(np.mean(x**2, axis=(0, 1)))
        for x in (up - linear, (up - down) / 2 - linear)
    )
