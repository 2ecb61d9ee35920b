"""All steps from a recording to multipliers, in one call."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx

from ..identify.series.fit import fit_series
from ..identify.series.series_fit import SeriesFit
from .advice import ENOUGH, Advice, HeldOut, advise, choose_order, hold_out
from .drift import without_drift
from .impulse import ImpulseResponses, impulse_responses
from .phase import AnglePhase, CrossingPhase, Definition, Phase, estimate_phase
from .recording import Recording
from .sampling import SectionData, section_data


class Identification(eqx.Module):
    """What was found in a recording, step by step.

    **Fields:** `recording`; `phase`; `data`, at the sections; `fit`, to all of it; `held_out`, a
    fit to the first three quarters, tried on the last; `responses` to pushes; `advice`.
    """

    recording: Recording
    phase: Phase
    data: SectionData
    fit: SeriesFit
    held_out: HeldOut
    responses: ImpulseResponses
    advice: Advice

    def __repr__(self) -> str:
        parts = (self.phase, self.data, self.fit, self.held_out.validation, self.advice)
        return "\n".join(map(repr, parts))


def identify_recording(
    recording: Recording,
    phase: Phase | Definition,
    *,
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    n_sections: int = 32,
    order: int | None = None,
    drift: int | float | None = None,
    **options: Any,
) -> Identification:
    """From a recording to multipliers, transfer functions, impulse responses and what to think of
    them.

    **Arguments:** as for `section_data`, and

    - `order`: the number of multipliers; None lets `choose_order` find it.
    - `drift`: changes that take longer than so many cycles are no response to the inputs: they are
      taken out of the outputs, and of the signals of an `AnglePhase`, before the phase is found;
      the fit allows for what is left.

    **Raises:** `DefinitionError` as `estimate_phase`, `section_data` and `fit_series`.
    """
    definition = phase
    if not isinstance(phase, Phase):
        phase = estimate_phase(recording, definition)
    if drift is not None:
        moved = {outputs} if isinstance(outputs, str) else set(outputs)
        if isinstance(definition, AnglePhase):
            moved |= {definition.position, definition.velocity}
        if isinstance(definition, CrossingPhase):
            moved |= {definition.signal}
        recording = without_drift(recording, phase, sorted(moved), drift)
        if not isinstance(definition, Phase):
            phase = estimate_phase(recording, definition)
    about = {"inputs": inputs, "outputs": outputs, "n_sections": n_sections, "drift": drift}
    data = section_data(recording, phase, **about, **options)
    order = choose_order(data) if order is None else order
    held = hold_out(data, order)
    # A long recording need not be asked again whether it has a part of second order that pays.
    known = data.cycles > ENOUGH and not held.fit.distortion
    fit = fit_series(data, order, check=False, distortion=False if known else None)
    return Identification(
        recording,
        phase,
        data,
        fit,
        held,
        impulse_responses(fit, data),
        advise(data, fit),
    )
