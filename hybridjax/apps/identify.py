"""The command `hybridjax identify`: what it prints, and the files and the report that it writes.

`run` reads the recording, identifies it (`steps_of` turns options into a call of
`identify_recording`) and writes the results (`write_results`): tables, `summary.json`
(`summarize`), figures, and a page of HTML (`_page`, `_natural_page`). `Identification.write_report`
calls `write_report`. Numbers and the text about a result are those of
`recordings.identification.Identification`: if one is wrong, look there.

A further figure is a line in `_figures` (or `_natural_figures`), its caption in `_CAPTIONS` and its
name in `report_folder`, which replaces the files of an earlier report. Keys of `summary.json` must
stay: `subjects.py` and users read it. If a figure is written but not on the page, its name begins
with no key of `_CAPTIONS` (`_shown`); if a folder is refused, look at `report_folder` and at
`_core/writing.py`.
"""

import base64
import contextlib
import csv
import functools
import itertools
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, plot
from .._core import html
from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath
from .._core.findings import Finding
from .._core.results import Result
from .._core.signal import with_unit
from .._core.text import listed, rounded, standard_error
from .._core.writing import Format, results_folder
from ..io import save
from ..linear.htf import HTF
from ..orbits.crossing import AtEvent, Crossing
from ..plot import look
from ..recordings.identification import (
    MEANING,
    Identification,
    NaturalIdentification,
    identify_recording,
)
from ..recordings.read import read_recording
from ..recordings.recording import Recording
from ..sections.families import KinematicPhase
from .paper_report import complex_pairs


Results = Identification | NaturalIdentification

PAGE = "report.html"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 1rem auto; padding: 0 1rem; }
body .hybridjax { font-size: 1rem; }
.warn, .fine { border-left: 4px solid #D55E00; padding: .3rem 1rem; }
.fine { border-color: #009E73; }
figure { margin: 1rem 0; overflow-x: auto; } img { max-width: 100%; height: auto; }
figcaption { color: #555; font-size: .9rem; }
"""
_CAPTIONS = {
    "multipliers": "Multipliers with 95 % confidence regions in the unit circle.",
    "validation": "Measured and simulated deviations; correlations of the residuals.",
    "impulse_responses": "Responses to a brief push of area 1 at each phase of the cycle, with "
    "bands that contain the true response with 95 % probability.",
    "bode": "Magnitude and phase of H₀, with bands of 95 %.",
    "harmonics": "Magnitudes of H₀, H₁ and H₋₁, with bands of 95 %.",
    "phase": "Durations of the cycles.",
    "curve": "Phase response curve with its band of 95 %.",
    "sections": "Average cycle; deviations with twice their standard deviation; power of inputs, "
    "and outputs from cycle to cycle at the section where they vary most.",
}


def run(options: Any) -> bool:
    """Identify, print and write a report, from the options of the command; whether the fit has
    converged."""
    with report_folder(options.out, options.inputs, options.formats) as folder:
        signals, identify = steps_of(options)
        recording = read_recording(*options.files, time=options.time, signals=signals)
        print(recording)
        result = identify(recording)
        print(result)
        write_results(folder, result, options.formats)
    print(os.path.join(options.out, PAGE))
    return converged(result)


def converged(result: Results) -> bool:
    """Return whether the fit is a minimum. (Multipliers from variability follow without
    iterations.)"""
    return isinstance(result, NaturalIdentification) or result.fit.result == Result.OK


def steps_of(
    options: Any,
) -> tuple[tuple[str, ...], Callable[[Recording], Results]]:
    """Return the names of the signals to be read, and the function that identifies a recording."""
    named = (*options.inputs, *options.references, *options.outputs)
    named += options.phase or (options.crossing or ())[:1]
    if options.phase is not None:
        position, velocity = options.phase
        plane: Any = {"position": position, "velocity": velocity}
        plane |= {"center": options.center, "scale": options.scale}
        sections: Any = KinematicPhase(options.sections, **plane)
    elif options.crossing is not None:
        sections = Crossing(*options.crossing)
    else:
        sections = AtEvent(options.event)
    identify = functools.partial(
        identify_recording,
        sections=sections,
        inputs=options.inputs,
        outputs=options.outputs,
        n_sections=options.sections,
        order=options.order,
        bandwidth=options.bandwidth,
        timing=options.timing,
        drift=options.drift,
        references=options.references or None,
    )
    return tuple(dict.fromkeys(named)), identify


@checked
def write_report(
    folder: FilePath, result: Results, formats: Sequence[Format] = ("png",)
) -> Path:
    """Write all results of a recording into a folder, see `Identification.write_report`."""
    with report_folder(folder, result.data.inputs, formats) as new:
        write_results(new, result, formats)
    return Path(folder) / PAGE


def report_folder(
    folder: FilePath, inputs: Sequence[str], formats: Sequence[Format]
) -> contextlib.AbstractContextManager[Path]:
    """Return a context with a new folder for the results, which at the end replace those in
    `folder`."""
    files = (PAGE, "sections.csv", "cycle.csv", "htf.npz", "fit.npz", "summary.json")
    figures = [
        "phase",
        "sections",
        "multipliers",
        "impulse_responses",
        "validation",
        "curve",
    ]
    for suffix in _suffixes(inputs):
        figures += [f"bode{suffix}", f"harmonics{suffix}"]
    pairs = itertools.product(figures, with_png(formats))
    images = [f"figures/{name}.{format}" for name, format in pairs]
    return results_folder(Path(folder), "report", [*files, *images])


def with_png(formats: Sequence[Format]) -> tuple[Format, ...]:
    """Return the formats with PNG, which the page shows, first."""
    return tuple(dict.fromkeys(("png", *formats)))


def _suffixes(inputs: Sequence[str]) -> list[str]:
    """Return the ends of the names of each input's figures."""
    if len(inputs) == 1:
        return [""]
    return [f"_{x.replace('/', '-')}" for x in inputs]


def write_results(folder: Path, result: Results, formats: Sequence[Format]) -> None:
    """Write all results into a folder that is new."""
    (folder / "figures").mkdir()
    data = result.data
    if isinstance(result, NaturalIdentification):
        figures = _natural_figures(result)
    else:
        # 240 frequencies, up to the edge of the band that the inputs excited.
        edge = min(max(result.diagnosis.bandwidths), data.n_sections / 2)
        htf = result.fit.htf(np.linspace(0, edge, 241)[1:])
        save(folder / "htf.npz", htf)
        figures = _figures(result, htf)
    images = {}
    for name, drawn in figures:
        path = folder / "figures" / name
        image, *_ = look.save_and_close(path, drawn, with_png(formats))
        images[name] = base64.b64encode(image.read_bytes()).decode()
    save(folder / "fit.npz", result.fit)
    header = list(map(with_unit, data.signals, data.units))
    first = ["trial", "record", "cycle", "section", "time (s)"]
    _write_table(folder / "sections.csv", [*first, *header], _samples(result))
    average = []
    for n, row in enumerate(_written(data.cycle_inputs, data.cycle_outputs)):
        average.append((n, n / data.n_sections, *row))
    _write_table(folder / "cycle.csv", ["section", "phase (cycles)", *header], average)
    (folder / "summary.json").write_text(json.dumps(summarize(result), indent=1) + "\n")
    if isinstance(result, NaturalIdentification):
        page = _natural_page(result, images)
    else:
        page = _page(result, images)
    (folder / PAGE).write_text(page, encoding="utf-8")


def _samples(result: Results) -> Iterator[tuple]:
    """The rows of `sections.csv`."""
    data = result.data
    records = zip(data.records, data.times, data.trials, strict=True)
    for k, (record, times, trial) in enumerate(records):
        name = result.recording.trials[trial].name
        rows = _written(times[:, None], record.u, record.y)
        for section, row in enumerate(rows, record.first_section):
            yield name, k, *divmod(section, data.n_sections), *row


def page_of(title: str, parts: Iterable[str]) -> str:
    """Return a page that needs no other file."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(title)}</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head>\n<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _written(*arrays: np.ndarray) -> Iterator[list[str]]:
    for row in np.concatenate(arrays, axis=1):
        yield [f"{x:.9g}" for x in row]


def _write_table(path: Path, header: list[str], rows: Iterable[Sequence]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])


def summarize(result: Results) -> dict[str, Any]:
    """Return the numbers of the report, ready for JSON."""
    fit = result.fit
    numbers = _summary_of_data(result) | {
        "multipliers": complex_pairs(fit.multipliers),
        "standard_errors": fit.standard_errors.tolist(),
        "covariance_of_coefficients": fit.covariance.tolist(),
    }
    if isinstance(result, NaturalIdentification):
        return numbers | {
            "multipliers_of_plain_regression": complex_pairs(result.fit.plain),
            "warnings": list(map(repr, result.findings)),
        }
    held = result.held_out
    return numbers | {
        "references": list(result.fit.references),
        "multipliers_of_plain_regression": complex_pairs(result.diagnosis.plain),
        "multipliers_of_held_out_fit": complex_pairs(held.fit.multipliers),
        "held_out_fit_percent": held.validation.fit.tolist(),
        "input_band": list(result.diagnosis.bandwidths),
        "warnings": list(map(repr, result.diagnosis.findings)),
    }


def _summary_of_data(result: Results) -> dict[str, Any]:
    """Return the numbers of the recording, its phase and its data."""
    data = result.data
    periods = np.concatenate(result.phase.periods)
    return {
        "version": __version__,
        "trials": [t.name for t in result.recording.trials],
        "sampling_rates": [
            float(1 / np.median(np.diff(t.time))) for t in result.recording.trials
        ],
        "left_out": _left_out(result),
        "notes": [finding.text for finding in result.recording.findings],
        "units": {"time": "s"} | dict(zip(data.signals, data.units, strict=True)),
        "inputs": list(data.inputs),
        "outputs": list(data.outputs),
        "sections": data.n_sections,
        "cycles": round(data.cycles, 2),
        "records": len(data.records),
        "period": data.period,
        "period_jitter": result.phase.jitter,
        "period_mean": float(periods.mean()),
        "period_standard_error": float(
            periods.std() / np.sqrt(max(len(periods) - 1, 1))
        ),
        "period_drift_per_cycle": result.phase.drift,
    }


def _figures(result: Identification, htf: HTF) -> Iterable[tuple[str, look.Plot]]:
    """Yield names and figures, each drawn when the one before was saved."""
    shown = [m for m in (0, 1, -1) if m in htf.harmonics]
    yield (
        "multipliers",
        plot.multipliers(result.fit, {"plain regression": result.diagnosis.plain}),
    )
    yield "validation", result.held_out.validation.plot()
    yield "impulse_responses", result.responses.plot()
    for i, suffix in enumerate(_suffixes(htf.inputs)):
        yield f"bode{suffix}", plot.bode(htf, input=i)
        yield (
            f"harmonics{suffix}",
            plot.htf({"": htf}, harmonics=shown, input=i, decades=3),
        )
    yield "phase", result.phase.plot()
    yield "sections", result.data.plot()
    if result.curve is not None:
        yield "curve", plot.phase_response(result.curve)


def _natural_figures(
    result: NaturalIdentification,
) -> Iterable[tuple[str, look.Plot]]:
    """Yield names and figures of multipliers from variability."""
    fit = result.fit
    yield (
        "multipliers",
        plot.multipliers(fit.multipliers, {"plain regression": fit.plain}),
    )
    yield "phase", result.phase.plot()
    yield "sections", result.data.plot()


def _natural_page(result: NaturalIdentification, images: dict[str, str]) -> str:
    """Return the page of multipliers from variability."""
    data = result.data
    trials = escape(", ".join(t.name for t in result.recording.trials))
    parts = [
        f"<p>{trials}: variability of {escape(listed(data.outputs))} without a measured input, "
        f"{data.n_sections} sections per cycle.</p>",
        html.card("Multipliers", "from variability", html.text(repr(result.fit))),
        *_doubts(result.findings),
        *_about_data(result),
        f"<p>{MEANING[0]}</p>",
        *_shown(images),
        f"<p>hybridjax {__version__}. Deviations are smoothed with a bandwidth of "
        f"{data.bandwidth:.3g} Hz; return maps by instrumental variables, intervals by a block "
        "bootstrap. Disturbances are taken as independent from cycle to cycle.</p>",
    ]
    return page_of("Floquet multipliers from a recording", parts)


def _doubts(findings: Sequence[Finding]) -> list[str]:
    """Return the paragraphs about the reasons to doubt, or one that there are none."""
    if not findings:
        return ['<p class="fine">No reason to doubt the multipliers was found.</p>']
    return [f'<p class="warn">{_sentence(repr(x))}</p>' for x in findings]


def _about_data(result: Results) -> list[str]:
    """Return the parts of a page about data that were left out, the phase and the sections."""
    left_out = {}
    for reason, amount in _left_out(result).items():
        if amount:
            left_out[reason] = f"{amount:.3g}"
    about = "" if left_out else "nothing"
    parts = [html.card("Left out", about, html.facts(left_out))]
    notes = "".join(f"<li>{_sentence(x.text)}</li>" for x in result.recording.findings)
    if notes:
        parts.append(f"<ul>{notes}</ul>")
    parts.append(html.card("Phase", "", html.text(repr(result.phase))))
    parts.append(result.data._repr_html_())
    return parts


def _shown(images: dict[str, str]) -> list[str]:
    """Return the figures, given as PNG in base 64, with their captions."""
    shown = []
    for name, image in images.items():
        for figure, caption in _CAPTIONS.items():
            if name.startswith(figure):
                shown.append(
                    f'<figure><img alt="{escape(name)}" src="data:image/png;base64,{image}">'
                    f"<figcaption>{escape(caption)}</figcaption></figure>"
                )
    return shown


def _page(result: Identification, images: dict[str, str]) -> str:
    """Return the page, with the figures given as PNG in base 64."""
    data = result.data
    recording = result.recording
    trials = escape(", ".join(t.name for t in recording.trials))
    loop = result.fit.references
    if loop:
        method = f"instrumental variables of {escape(listed(loop))}"
    else:
        method = "output-error fit"
    expected = zip(result.diagnosis.cycles, result.diagnosis.expected, strict=True)
    parts = [
        f"<p>{trials}: from {escape(listed(data.inputs))} to {escape(listed(data.outputs))}, "
        f"{data.n_sections} sections per cycle.</p>",
        f"<p>A controller makes {escape(listed(data.inputs))}. These are the dynamics without it, "
        f"as {escape(listed(loop))} tells, which acts from outside.</p>" * bool(loop),
        result.fit._repr_html_(),
        *_doubts(result.diagnosis.findings),
        *_about_data(result),
        html.card(
            "Standard errors to be expected from more strides",
            "",
            html.table(
                (
                    "strides",
                    *map(rounded, result.fit.multipliers, result.fit.standard_errors),
                ),
                [
                    (str(n), *(standard_error(e) for e in x))
                    for n, x in expected
                    if np.isfinite(x).all()
                ],
            ),
        ),
        *(f"<p>{text}</p>" for text in MEANING),
        result.held_out.validation._repr_html_(),
        *_shown(images),
        f"<p>hybridjax {__version__}. Deviations are smoothed with a bandwidth of "
        f"{data.bandwidth:.3g} Hz; {method} with {result.fit.numerators.shape[1]} lags; "
        "regions from the residuals, cycle by cycle.</p>",
    ]
    return page_of("Floquet multipliers from a recording", parts)


def _left_out(result: Results) -> dict[str, Any]:
    """Return the amounts of data that were not used, by their causes."""
    amounts = {
        "doubled events (less than half a period after the one before)": result.phase.dropped,
        "cycles whose beginning or end is unknown (a missed event, a gap)": result.phase.missed,
        "fraction of the samples at sections (gaps longer than a section)": result.data.missing,
        "fraction of the samples whose phase ran backwards (replaced)": result.phase.backwards,
    }
    if isinstance(result, Identification):
        short = "stretches too short to validate (used in the fit)"
        amounts[short] = result.held_out.validation.left_out
    return amounts


def _sentence(message: str) -> str:
    """Return a message with names of arguments, which stand between backticks, as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(message))
