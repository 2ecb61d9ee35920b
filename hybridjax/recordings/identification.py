"""All steps from a recording to multipliers, in one call."""

import textwrap
from typing import Literal

import equinox as eqx

from .._core.boundary.checked import checked
from .._core.boundary.kinds import OptionalNames, Order, SectionCount, SignalNames
from .._core.findings import Finding, refuse, warn_of
from .._core.precision import require_x64
from .._core.progress import say, working
from .._core.text import listed
from ..errors import DefinitionError
from ..identify.series.fit import SeriesFit, fit_series
from ..identify.series.in_loop import best_order
from ..identify.series.records import SLOW
from .beats.response import PhaseResponse, phase_response
from .data import SectionData
from .findings import untried_orders
from .fit_warnings import Advice, advise, undamped
from .held_out import HeldOut, split
from .impulse import ImpulseResponses, impulse_responses
from .inspection.inspect import inspect, inspect_cycles
from .phase import Phase
from .phase_estimation import PhaseDefinition, estimate_phase, signals_of
from .recording import Recording
from .sampling import DriftCycles, section_data, without_drift
from .smoothing import Bandwidth


# The meaning of the numbers, in prints and in the report.
MEANING = (
    "A multiplier is the factor by which a deviation from the average cycle changes in one cycle. "
    "A modulus below 1 is stable; the smaller, the faster the return.",
    "For the validation, a model of most strides is simulated on the strides that were held out. "
    "Small p-values show that the model leaves something unexplained (process noise, nonlinearity, "
    "smoothing), not that the multipliers are wrong.",
)


class Identification(eqx.Module):
    """The results of `identify_recording`, step by step.

    **Fields:** `recording`, without the samples that `inspect` leaves out; `findings` of the
    inspection; `phase`; `data`, at the sections; `fit`, to all of it; `held_out`, a fit to the
    first three quarters, tried on the last; `responses` to pushes; `curve`, the phase response
    curve of events alone under one input (else None); `advice`.
    """

    recording: Recording
    findings: tuple[Finding, ...]
    phase: Phase
    data: SectionData
    fit: SeriesFit
    held_out: HeldOut
    responses: ImpulseResponses
    curve: PhaseResponse | None
    advice: Advice

    def __repr__(self) -> str:
        parts = (self.phase, self.data, self.fit, self.held_out.validation, self.advice)
        prints = list(map(repr, parts))
        prints[3:3] = (textwrap.fill(x, 100) for x in MEANING)
        return "\n".join(prints)


@checked
@working("identify_recording")
def identify_recording(
    recording: Recording,
    phase: Phase | PhaseDefinition,
    *,
    inputs: SignalNames,
    outputs: OptionalNames,
    order: Order | None = None,
    n_sections: SectionCount | None = None,
    bandwidth: Bandwidth | None = None,
    timing: Literal["clock", "duration"] | None = None,
    drift: DriftCycles | None = None,
    reference: SignalNames | None = None,
) -> Identification:
    """Identify multipliers, transfer functions and impulse responses from a recording, and list the
    reasons to doubt them. The recording is inspected first (`hj.recordings.inspect`).

    **Arguments:** those of `section_data`, and

    - `order`: the number of multipliers. Default: the result of `choose_order`; in a loop, the most
      that the reference determines, up to 4.
    - `drift`: number of cycles; slower changes are drift, not responses to the inputs. Drift is
      removed from the outputs and from the signals that define the phase, the phase is estimated
      from the result, and the fit allows for drift that remains. Default: None.
    - `reference`: signals that enter a control loop from outside, at least as many as inputs. The
      controller makes the inputs; the plant is fitted, see `fit_series`. Default: None.

    **Raises:** `DefinitionError` for errors that the inspection finds, and as `estimate_phase`,
    `section_data` and `fit_series`; `PrecisionError` in single precision.
    """
    require_x64()
    say("inspection")
    outside = None if reference is None else tuple(reference)
    if both := [x for x in outside or () if x in (*inputs, *outputs)]:
        text = f"other signals than `inputs` and `outputs`, not {listed(both)}"
        raise DefinitionError(f"`reference` must name {text}.")
    signals = (*inputs, *(outside or ()))
    inspection = inspect(recording, inputs=signals, outputs=outputs)
    refuse(inspection.findings)
    recording = inspection.recording
    say("phase")
    definition = None if isinstance(phase, Phase) else phase
    phase = phase if isinstance(phase, Phase) else estimate_phase(recording, phase)
    if drift is not None:
        drifting = set(outputs) | (
            set() if definition is None else signals_of(definition)
        )
        recording = without_drift(recording, phase, sorted(drifting), drift)
        phase = phase if definition is None else estimate_phase(recording, definition)
    say("data at the sections")
    whole = section_data(
        recording,
        phase,
        inputs=signals,
        outputs=outputs,
        n_sections=n_sections,
        bandwidth=bandwidth,
        timing=timing,
    )
    whole = whole if drift is None else whole.with_drift(drift)
    # In a loop all that happens begins at the reference.
    driving = whole if outside is None else whole.of_inputs(outside)
    findings = (*inspection.findings, *inspect_cycles(recording, phase, driving))
    refuse(findings)
    say("order")
    data, parts, most = (
        whole.of_inputs(inputs),
        split(whole),
        4 if order is None else order + 2,
    )
    best, obstacle = (
        best_order(whole, outside, most) if outside else parts.best_order(most)
    )
    if order is None:
        order, findings = best, (*findings, *untried_orders(best, obstacle))
    elif best > order:
        text = (
            "the reference determines"
            if outside
            else "held-out strides are predicted better by"
        )
        text = f"{text} {best} multipliers, not {order}: "
        text += f"{order} may be biased, and their intervals too narrow. Compare order={best}"
        slow = (
            outside is None
            and split(whole.with_drift(SLOW)).best_order(most)[0] <= order
        )
        text += (
            f", and drift={SLOW:g}, with which {order} are as good." if slow else "."
        )
        findings = (*findings, Finding("drift" if slow else "order", text))
    say("fit to the first three quarters")
    held = parts.fit(order, outside)
    say("fit to all")
    fit = fit_series(whole, order, check=False, reference=outside)
    findings = (*findings, *undamped(data, fit))
    curve = None
    of_events = all(w.linear for parts in phase.stretches for w in parts)
    if data.outputs == ("duration",) and len(data.inputs) == 1 and of_events:
        curve = phase_response(recording, phase, input=data.inputs[0])
        findings = (*findings, *curve.warnings)
    responses = impulse_responses(fit, data)
    warn_of(findings[len(inspection.findings) :])
    advice = advise(data, fit, held.validation, findings)
    return Identification(
        recording, findings, phase, data, fit, held, responses, curve, advice
    )
