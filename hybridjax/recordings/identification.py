"""`identify_recording`: all steps from a recording to multipliers, in one call.

It calls the functions of the steps in the order in which its source lists them, and returns their
results as an `Identification` (or, without inputs, as a `NaturalIdentification`). A further result
is a field of these. The order must stay: the phase is estimated without the samples that the
inspection leaves out, drift is removed before sections are sampled, and errors in the recording are
refused before a fit.

To find a wrong step, call the functions one by one. Only two things are decided here: if the number
of multipliers is wrong, look at `_order`, `_order_in_loop` and `_first_that_agrees`; if drift is
left, or too much is removed, at `_phase_without_drift`.
"""

import dataclasses
import importlib
import itertools
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

import equinox as eqx

from .._core.boundary.checked import checked
from .._core.boundary.kinds import (
    FilePath,
    OptionalNames,
    Order,
    SectionCount,
    SignalNames,
)
from .._core.findings import Finding, print_findings, refuse, warn_of
from .._core.precision import require_x64
from .._core.progress import say, working
from .._core.text import listed
from ..errors import DefinitionError
from ..identify.multiplier_estimate import OfFit
from ..identify.series.fit import SeriesFit, fit_series
from ..identify.series.in_loop import best_order
from ..identify.series.records import SLOW, PreparedRecords
from .beats.response import PhaseResponse, phase_response
from .data import SectionData
from .findings import untried_orders
from .fit_warnings import Diagnosis, diagnosis_of, slow_sampling, undamped
from .held_out import HeldOut, Split, split
from .impulse import ImpulseResponses, impulse_responses
from .inspection.inspect import check_recording, inspect_cycles
from .natural import NaturalMultipliers, natural_multipliers
from .phase import Phase
from .phase_estimation import PhaseDefinition, estimate_phase, signals_of
from .read import RecordingLike, as_recording
from .recording import Recording
from .sampling import DriftCycles, sample_sections, without_drift
from .smoothing import Bandwidth


# Sentences on the meaning of the numbers, in prints and in the report.
MEANING = (
    "A multiplier is the factor by which a deviation from the average cycle changes in one cycle. "
    "A modulus below 1 is stable; the smaller, the faster the return.",
    "For the validation, a model of most strides is simulated on the strides that were held out. "
    "Small p-values show that the model leaves something unexplained (process noise, nonlinearity, "
    "smoothing), not that the multipliers are wrong.",
)


# Largest number of multipliers that is tried without inputs. More: noise of four numbers and more
# hides in the largest modulus. Fewer: gait with two pairs is doubted.
_MOST_NATURAL = 4


class Identification(OfFit, eqx.Module):
    """The results of `identify_recording`, step by step.

    **Fields:** `recording`, without the samples that `check_recording` leaves out; `findings`
    of that check; `phase`; `data`, at the sections; `fit`, to all of it; `held_out`, a fit to the
    first three quarters, tried on the last; `responses` to pushes; `curve`, the phase response
    curve of events alone under one input (else None); `diagnosis`.

    It has `multipliers`, `modulus`, `standard_errors`, `interval`, `contains` and `compare` of the
    fit. Functions that take a fit or data take it, too.
    """

    _stands_for: ClassVar = ("fit", "data")

    recording: Recording
    findings: tuple[Finding, ...] = eqx.field()
    phase: Phase
    data: SectionData
    fit: SeriesFit
    held_out: HeldOut
    responses: ImpulseResponses
    curve: PhaseResponse | None
    diagnosis: Diagnosis

    @checked
    def write_report(self, folder: FilePath, formats: Sequence[str] = ("png",)) -> Path:
        """Write all results into a folder. They appear when all of them are ready.

        - `report.html`: everything in one page that needs no other file.
        - `sections.csv`: deviations of inputs and outputs from the average cycle at the sections.
          `cycle.csv`: the average cycle.
        - `htf.npz`, `fit.npz`: transfer functions and fit, for `hj.load`. `summary.json`: the
          numbers.
        - `figures/`: in each of `formats`, as `plot.save` takes them, and as PNG for the page.

        Other files in the folder stay as they are. Results of an earlier report are replaced; a
        hidden list in the folder holds their names.

        **Returns:** the path of the page.

        **Raises:** `DefinitionError` if a file that is not of an earlier report has one of these
        names, or the folder cannot be written.
        """
        # (Reports are made of figures, which are drawn above this layer.)
        report = importlib.import_module("hybridjax.apps.identify")
        return report.write_report(folder, self, formats)

    def __repr__(self) -> str:
        meaning = [textwrap.fill(text, 100) for text in MEANING]
        results = [
            repr(self.phase),
            repr(self.data),
            repr(self.fit),
            *meaning,
            repr(self.held_out.validation),
            repr(self.diagnosis),
        ]
        return "\n".join(results)


class NaturalIdentification(OfFit, eqx.Module):
    """The results of `identify_recording` without inputs, step by step.

    **Fields:** `recording`, without the samples that `check_recording` leaves out; `phase`; `data`,
    at the sections; `fit`, the `NaturalMultipliers`; `findings` of all steps.

    It has `multipliers`, `modulus`, `standard_errors`, `interval`, `contains` and `compare` of the
    fit. Functions that take such data take it, too.
    """

    _stands_for: ClassVar = ("fit", "data")

    recording: Recording
    phase: Phase
    data: SectionData
    fit: NaturalMultipliers
    findings: tuple[Finding, ...] = eqx.field()

    @checked
    def write_report(self, folder: FilePath, formats: Sequence[str] = ("png",)) -> Path:
        """Write all results into a folder, as `Identification.write_report` does, without the
        files of transfer functions.

        **Returns:** the path of the page.

        **Raises:** `DefinitionError` as `Identification.write_report`.
        """
        report = importlib.import_module("hybridjax.apps.identify")
        return report.write_report(folder, self, formats)

    def __repr__(self) -> str:
        findings = [x for x in self.findings if x not in self.fit.findings]
        results = [
            repr(self.phase),
            repr(self.data),
            repr(self.fit),
            textwrap.fill(MEANING[0], 100),
            print_findings(findings),
        ]
        return "\n".join(filter(None, results))


@checked
@working("identify_recording")
def identify_recording(
    recording: RecordingLike,
    sections: Phase | PhaseDefinition,
    inputs: OptionalNames = (),
    outputs: OptionalNames = (),
    *,
    order: Order | None = None,
    n_sections: SectionCount | None = None,
    bandwidth: Bandwidth | None = None,
    timing: Literal["clock", "duration"] | None = None,
    drift: DriftCycles | None = None,
    references: SignalNames | None = None,
) -> Identification | NaturalIdentification:
    """Identify multipliers, transfer functions and impulse responses from a recording, and list the
    reasons to doubt them. The recording is inspected first (`hj.recordings.check_recording`).

    Without inputs, multipliers are estimated from the variability from cycle to cycle
    (`hj.recordings.natural_multipliers`).

    **Arguments:**

    - `recording`: the recording, perturbed by the inputs, if there are any; or the path of its
      file, or a table (`hj.Recording.from_frame`).
    - `sections`, `inputs`, `outputs`, `n_sections`, `bandwidth`, `timing`: those of
      `sample_sections`, with the same defaults.
    - `order`: the number of multipliers. Default: that of `select_order`; in a loop, the most that
      the reference determines, up to 4; without inputs, the first number from 1 to 4 whose largest
      modulus agrees with that of the next number.
    - `drift`: number of cycles; slower changes are drift, not responses to the inputs. Drift is
      removed from the outputs and from the signals that define the phase, the phase is estimated
      from the result, and the fit allows for drift that remains. Default: None.
    - `references`: signals that enter a control loop from outside, at least as many as inputs. The
      controller then sets the inputs, and the plant is fitted: see `fit_series`. Default: None.

    **Returns:** `hj.recordings.Identification` with the results of all steps: `phase`, `data`,
    `fit` (a `SeriesFit` with `multipliers` (d,)), `held_out`, `responses` and `diagnosis`. Its
    method `write_report` writes a page. Without inputs, `hj.recordings.NaturalIdentification` with
    `phase`, `data`, `fit` (`NaturalMultipliers`) and `findings`.

    **Raises:** `DefinitionError` for errors that the inspection finds, for `references`
    without inputs, and in the cases of `estimate_phase`, `sample_sections`,
    `fit_series` and `natural_multipliers`; `PrecisionError` in single precision.

    **Example:**

    ```python
    options = {"inputs": "u", "outputs": ("yM", "vM"), "order": 2, "n_sections": 8}
    result = hj.identify_recording(recording, apex, **options)
    print(result.fit.multipliers)
    ```

    **Before:** `hj.read_recording`. **After:** `result.write_report`, `hj.identify_subjects`.
    """
    require_x64()
    say("inspection")
    outside = None if references is None else tuple(references)
    if outside and not inputs:
        raise DefinitionError(
            "`references` act on a controller that makes the inputs: name `inputs`, too."
        )
    _require_outside(outside or (), (*inputs, *outputs))
    signals = (*inputs, *(outside or ()))
    recording = as_recording(recording)
    inspection = check_recording(recording, inputs=signals, outputs=outputs)
    refuse(inspection.findings)
    say("phase")
    recording, phase = _phase_without_drift(
        inspection.recording, sections, outputs, drift
    )
    say("data at the sections")
    whole = sample_sections(
        recording,
        phase,
        inputs=signals,
        outputs=outputs,
        n_sections=n_sections,
        bandwidth=bandwidth,
        timing=timing,
    )
    if not inputs:
        natural = _natural(recording, phase, whole, order)
        warn_of(natural.findings)
        findings = (*inspection.findings, *natural.findings)
        return dataclasses.replace(natural, findings=findings)
    if drift is not None:
        whole = whole.with_drift(drift)
    data = whole.of_inputs(inputs)
    # (In a loop, responses begin at the reference.)
    driving = data if outside is None else whole.of_inputs(outside)
    findings = inspect_cycles(recording, phase, driving)
    refuse([*inspection.findings, *findings])
    say("order")
    parts = split(whole)
    if outside is None:
        order, doubts = _order(order, whole, parts)
    else:
        order, doubts = _order_in_loop(order, whole, outside)
    findings += doubts
    say("fit to the first three quarters")
    held_out = parts.fit(order, outside)
    say("fit to all")
    prepared = PreparedRecords(data, free_start=True)
    fit = fit_series(
        prepared if outside is None else whole, order, check=False, references=outside
    )
    findings += undamped(data, fit)
    curve = None
    if _is_of_events_alone(data, phase):
        curve = phase_response(recording, phase, input=data.inputs[0])
        findings += curve.findings
    diagnosis = diagnosis_of(data, prepared, fit, held_out.validation)
    warn_of([*findings, *diagnosis.findings])
    findings = [*inspection.findings, *findings]
    return Identification(
        recording=recording,
        findings=tuple(findings),
        phase=phase,
        data=data,
        fit=fit,
        held_out=held_out,
        responses=impulse_responses(fit, data),
        curve=curve,
        diagnosis=diagnosis.with_earlier([*findings, *slow_sampling(data)]),
    )


def _natural(
    recording: Recording, phase: Phase, data: SectionData, order: int | None
) -> NaturalIdentification:
    """Return the multipliers from variability, with findings.

    **Raises:** `DefinitionError` for a number of multipliers that is given and too large, and for
    too few cycles.
    """
    findings = inspect_cycles(recording, phase, data)
    refuse(findings)
    say("multipliers from variability")
    if order is not None:
        fit = natural_multipliers(data, order)
    else:
        fit = _first_that_agrees(data)
    return NaturalIdentification(
        recording=recording,
        phase=phase,
        data=data,
        fit=fit,
        findings=tuple(dict.fromkeys([*findings, *fit.findings])),
    )


def _first_that_agrees(data: SectionData) -> NaturalMultipliers:
    """Return the estimate with the fewest multipliers (up to 4) whose largest modulus agrees with
    that of an estimate with one more. If there is none, return the largest number that the data
    allow."""
    fit = natural_multipliers(data, 1)
    for order in range(2, _MOST_NATURAL + 1):
        if not any(finding.cause == "order" for finding in fit.findings):
            break
        try:
            fit = natural_multipliers(data, order)
        except DefinitionError:
            break
    return fit


def _is_of_events_alone(data: SectionData, phase: Phase) -> bool:
    """Return whether the data are one input and the times of events, without other outputs."""
    stretches = itertools.chain.from_iterable(phase.stretches)
    of_events = all(stretch.linear for stretch in stretches)
    return data.outputs == ("duration",) and len(data.inputs) == 1 and of_events


def _require_outside(references: Sequence[str], signals: Sequence[str]) -> None:
    """**Raises:** `DefinitionError` for a reference that is an input or an output."""
    inside = [name for name in references if name in signals]
    if inside:
        raise DefinitionError(
            "`references` must name other signals than `inputs` and `outputs`, not "
            f"{listed(inside)}."
        )


def _phase_without_drift(
    recording: Recording,
    phase: Phase | PhaseDefinition,
    outputs: Sequence[str],
    drift: float | None,
) -> tuple[Recording, Phase]:
    """Return the recording without drift, and its phase.

    The phase of the drifting signals is only used to remove the drift. If a definition of the phase
    is given, the phase is then estimated again from the signals without drift.
    """
    if isinstance(phase, Phase):
        if drift is not None:
            recording = without_drift(recording, phase, sorted(set(outputs)), drift)
        return recording, phase
    rough = estimate_phase(recording, phase)
    if drift is None:
        return recording, rough
    drifting = set(outputs) | signals_of(phase)
    recording = without_drift(recording, rough, sorted(drifting), drift)
    return recording, estimate_phase(recording, phase)


def _order(
    order: int | None,
    data: SectionData,
    parts: Split,
) -> tuple[int, list[Finding]]:
    """Return the given order, or the order that predicts held-out strides best, and findings about
    it."""
    if order is None:
        best, obstacle = parts.best_order()
        return best, untried_orders(best, obstacle)
    most = order + 2
    best, _ = parts.best_order(most)
    if best <= order:
        return order, []
    too_few = (
        f"held-out strides are predicted better by {best} multipliers, not {order}: {order} may be "
        f"biased, and their intervals too narrow. Compare order={best}"
    )
    best_with_drift, _ = split(data.with_drift(SLOW)).best_order(most)
    if best_with_drift <= order:
        text = f"{too_few}, and drift={SLOW:g}, with which {order} are as good."
        return order, [Finding("drift", text)]
    return order, [Finding("order", f"{too_few}.")]


def _order_in_loop(
    order: int | None,
    data: SectionData,
    references: Sequence[str],
) -> tuple[int, list[Finding]]:
    """Return the given order, or the largest order that the reference determines, and findings
    about it."""
    if order is None:
        best, obstacle = best_order(data, references, most=4)
        return best, untried_orders(best, obstacle)
    best, _ = best_order(data, references, most=order + 2)
    if best <= order:
        return order, []
    return order, [
        Finding(
            "order",
            f"the reference determines {best} multipliers, not {order}: {order} may be biased, and "
            f"their intervals too narrow. Compare order={best}.",
        )
    ]
