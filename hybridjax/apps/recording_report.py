"""The results of a recording in files, and in one page of HTML that needs no other file."""

import base64
import contextlib
import csv
import json
import os
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, plot
from .._core import html
from .._core.boundary.checked import checked
from .._core.text import listed
from .._core.writing import Format, results_folder
from ..io import save
from ..linear.htf import HTF
from ..plot import look
from ..recordings.identification import Identification
from ..recordings.recording import Recording


PAGE = "report.html"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 1rem auto; padding: 0 1rem; }
body .hybridjax { font-size: 1rem; }
.main strong { display: block; font-size: 1.2rem; }
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
    "sections": "Average cycle; deviations with twice their standard deviation; power of inputs, "
    "and outputs from cycle to cycle at the section where they vary most.",
}


@checked
def write_report(
    folder: str | os.PathLike, found: Identification, formats: Sequence[Format] = ("png",)
) -> Path:
    """Write all results of a recording into a folder. They appear when all of them are ready.

    - `report.html`: everything in one page that needs no other file.
    - `sections.csv`: deviations of inputs and outputs at the sections. `cycle.csv`: their average.
    - `htf.npz`, `fit.npz`: for `hj.load`. `summary.json`: the numbers.
    - `figures/`: in each of the `formats` of `hj.plot.save`, and as PNG for the page.

    Other files in the folder stay as they are. Results of an earlier report are replaced, unless
    they were changed since; a hidden list in the folder holds their names and digests.

    **Returns:** the path of the page.

    **Raises:** `DefinitionError` if a file that is not of an earlier report has one of these names,
    or the folder cannot be written.
    """
    with report_folder(folder, found.data.inputs, formats) as new:
        write_results(new, found, formats)
    return Path(folder) / PAGE


def report_folder(
    folder: str | os.PathLike, inputs: Sequence[str], formats: Sequence[Format]
) -> contextlib.AbstractContextManager[Path]:
    """Return a context with a new folder for the results, which at the end replace those in
    `folder`."""
    files = (PAGE, "sections.csv", "cycle.csv", "htf.npz", "fit.npz", "summary.json")
    figures = ["phase", "sections", "multipliers", "impulse_responses", "validation"]
    for suffix in _suffixes(inputs):
        figures += [f"bode{suffix}", f"harmonics{suffix}"]
    images = [f"figures/{name}.{format}" for name in figures for format in _with_png(formats)]
    return results_folder(Path(folder), "report", [*files, *images])


def _with_png(formats: Sequence[Format]) -> tuple[Format, ...]:
    """Return the formats with PNG, which the page shows, first."""
    return tuple(dict.fromkeys(("png", *formats)))


def _suffixes(inputs: Sequence[str]) -> list[str]:
    """Return the ends of the names of each input's figures."""
    return [f"_{x.replace('/', '-')}" for x in inputs] if len(inputs) > 1 else [""]


def write_results(folder: Path, found: Identification, formats: Sequence[Format]) -> None:
    """Write all results into a folder that is new."""
    from matplotlib import pyplot

    (folder / "figures").mkdir()
    data, recording = found.data, found.recording
    # 240 frequencies, up to the edge of the band that the inputs excited.
    edge = min(max(found.advice.band), data.n_sections / 2)
    htf = found.fit.htf(np.linspace(0, edge, 241)[1:])
    images = {}
    for name, drawn in _figures(found, htf).items():
        image, *_ = look.save(folder / "figures" / name, drawn, _with_png(formats))
        images[name] = base64.b64encode(image.read_bytes()).decode()
        pyplot.close(drawn.figure)
    save(folder / "htf.npz", htf)
    save(folder / "fit.npz", found.fit)
    header = [f"{n} ({u})" if u else n for n, u in zip(data.signals, data.units, strict=True)]
    rows = (
        (recording.trials[trial].name, k, *divmod(record.first_section + i, data.n_sections), *row)
        for k, (record, times, trial) in enumerate(
            zip(data.records, data.times, data.trials, strict=True)
        )
        for i, row in enumerate(_written(times[:, None], record.u, record.y))
    )
    first = ["trial", "record", "cycle", "section", "time (s)"]
    _write_table(folder / "sections.csv", [*first, *header], rows)
    cycle = enumerate(_written(data.cycle_inputs, data.cycle_outputs))
    average = ((n, n / data.n_sections, *row) for n, row in cycle)
    _write_table(folder / "cycle.csv", ["section", "phase (cycles)", *header], average)
    (folder / "summary.json").write_text(json.dumps(summarize(found), indent=1) + "\n")
    (folder / PAGE).write_text(_page(found, images), encoding="utf-8")


def _written(*arrays: np.ndarray) -> Iterable[list[str]]:
    return ([f"{x:.9g}" for x in row] for row in np.concatenate(arrays, axis=1))


def _write_table(path: Path, header: list[str], rows: Iterable[Sequence]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])


def summarize(found: Identification) -> dict[str, Any]:
    """Return the numbers of the report, ready for JSON."""
    data, fit, held = found.data, found.fit, found.held_out
    return {
        "version": __version__,
        "trials": [t.name for t in found.recording.trials],
        "sampling_rates": _sampling_rates(found.recording),
        "left_out": _left_out(found),
        "notes": list(found.recording.notes),
        "units": {"time": "s"} | dict(zip(data.signals, data.units, strict=True)),
        "inputs": list(data.inputs),
        "outputs": list(data.outputs),
        "sections": data.n_sections,
        "cycles": round(data.cycles, 2),
        "records": len(data.records),
        "missing": data.missing,
        "period": data.period,
        "period_jitter": found.phase.jitter,
        "period_drift_per_cycle": found.phase.drift,
        "multipliers": [[z.real, z.imag] for z in fit.multipliers],
        "standard_errors": fit.standard_errors.tolist(),
        "covariance_of_coefficients": fit.covariance.tolist(),
        "multipliers_of_plain_regression": [[z.real, z.imag] for z in found.advice.plain],
        "multipliers_of_held_out_fit": [[z.real, z.imag] for z in held.fit.multipliers],
        "held_out_fit_percent": held.validation.fit.tolist(),
        "input_band": list(found.advice.band),
        "warnings": list(map(repr, found.advice.warnings)),
    }


def _figures(found: Identification, htf: HTF) -> dict[str, look.Plot]:
    import matplotlib

    with matplotlib.rc_context({"backend": "agg"}):
        figures = {
            "multipliers": plot.multipliers(found.fit, {"plain regression": found.advice.plain}),
            "validation": plot.validation(found.held_out.validation),
            "impulse_responses": plot.impulse_responses(found.responses),
        }
        for i, suffix in enumerate(_suffixes(htf.inputs)):
            figures[f"bode{suffix}"] = plot.bode(htf, input=i)
            size = {"width": look.COLUMN, "height": 0.3 + 1.6 * len(htf.outputs)}
            with look.panels(None, len(htf.outputs), 1, **size) as axes:
                for k, output in enumerate(htf.outputs):
                    plot.magnitude(htf, output=output, input=i, decades=3, ax=axes[k, 0])
            figures[f"harmonics{suffix}"] = look.Plot(axes)
        figures["phase"] = plot.phase(found.phase)
        figures["sections"] = plot.section_data(found.data)
    return figures


def _page(found: Identification, images: dict[str, str]) -> str:
    """Return the page, with the figures given as PNG in base 64."""
    data, recording, warnings = found.data, found.recording, found.advice.warnings
    trials = escape(", ".join(t.name for t in recording.trials))
    remarks = _left_out(found) + [f"{note[0].upper()}{note[1:]}." for note in recording.notes]
    parts = [
        "<h1>Floquet multipliers from a recording</h1>",
        f"<p>{trials}: from {escape(listed(data.inputs))} to {escape(listed(data.outputs))}, "
        f"{data.n_sections} sections per cycle.</p>",
        *_multipliers(found),
        *(f'<p class="warn">{_sentence(repr(w))}</p>' for w in warnings),
        *([] if warnings else ['<p class="fine">Nothing speaks against the fit.</p>']),
        f"<p>Left out, and assumed: {'' if remarks else 'nothing.'}</p>",
        f"<ul>{''.join(f'<li>{_sentence(x)}</li>' for x in remarks)}</ul>" if remarks else "",
        html.card("Recording", "", html.facts(_facts(found)), *_accuracy(found)),
        "<p>A multiplier is the factor by which a deviation from the average cycle changes in one "
        "cycle. A modulus below 1 is stable; the smaller, the faster the return.</p>",
        "<p>For the validation, a model of most strides is simulated on the strides that were held "
        "out. Small p-values show that the model leaves something unexplained (process noise, "
        "nonlinearity, smoothing), not that the multipliers are wrong.</p>",
        found.held_out.validation._repr_html_(),
        *(
            f'<figure><img alt="{name}" src="data:image/png;base64,{image}">'
            f"<figcaption>{caption}</figcaption></figure>"
            for name, image in images.items()
            for figure, caption in _CAPTIONS.items()
            if name.startswith(figure)
        ),
        f"<p>hybridjax {__version__}. Deviations are smoothed with a bandwidth of "
        f"{data.bandwidth:.3g} Hz; output-error fit with {found.fit.numerators.shape[1]} lags; "
        "regions from the residuals, cycle by cycle.</p>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>Multipliers of {trials}</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _multipliers(found: Identification) -> list[str]:
    """Return a paragraph for each multiplier: value, 95 % region, modulus."""
    lines = []
    for i, z in _upper(found):
        border = found.fit.ellipse(i)
        pair = " and its conjugate" if z.imag else ""
        reach = f"±\u00a0{np.ptp(np.real(border)) / 2:.2g}"
        if z.imag:
            reach = f"real part {reach}, imaginary part ±\u00a0{np.ptp(np.imag(border)) / 2:.2g}"
        moduli = np.abs(border)
        lines.append(
            f'<p class="main"><strong>{_show(z)}{pair}</strong> <span>95 % region: {reach}; '
            f"modulus {abs(z):.4f}, from {moduli.min():.4f} to {moduli.max():.4f}</span></p>"
        )
    return lines


def _facts(found: Identification) -> dict[str, str]:
    data, phase, trials = found.data, found.phase, found.recording.trials
    rates = sorted({f"{rate:.4g}" for rate in _sampling_rates(found.recording)}, key=float)
    duration = sum(float(t.time[-1] - t.time[0]) for t in trials)
    deviations = zip(data.signals, np.concatenate(data.rms()), data.units, strict=True)
    return {
        "strides": f"{data.cycles:.0f} in {len(data.records)} records of {len(trials)} trials",
        "period": f"{phase.period:.4g} s, ± {_percent(phase.jitter)} from cycle to cycle, drift "
        f"{_percent(phase.drift)} per cycle",
        "sampled at": f"{' to '.join(dict.fromkeys((rates[0], rates[-1])))} Hz, for "
        f"{duration:.4g} s",
        **{f"rms deviation of {name}": f"{x:.3g} {unit}".rstrip() for name, x, unit in deviations},
    }


def _accuracy(found: Identification) -> list[str]:
    """Return tables of standard errors, and of those to be expected from more strides."""
    fit, advice, pairs = found.fit, found.advice, _upper(found)
    errors = [
        (_show(z), f"{fit.standard_errors[i]:.1e}", _show(complex(advice.plain[i])))
        for i, z in pairs
    ]
    expected = [
        (str(n), *(f"{e[i]:.1e}" if np.isfinite(e[i]) else "too few" for i, _ in pairs))
        for n, e in zip(advice.strides, advice.expected, strict=True)
    ]
    return [
        html.table(("multiplier", "standard error", "plain regression (ARX)"), errors),
        html.table(("expected from strides", *(_show(z) for _, z in pairs)), expected),
    ]


def _left_out(found: Identification) -> list[str]:
    """Return sentences on the data that were not used, and why."""
    phase, held = found.phase, found.held_out.validation
    causes = [
        (
            phase.dropped,
            f"{phase.dropped} doubled events: less than half a period after the one before.",
        ),
        (
            phase.missed,
            f"{phase.missed} cycles whose beginning or end is unknown: an event was missed, a "
            "crossing lies in a gap, or the instruments paused.",
        ),
        (
            found.data.missing,
            f"{_percent(found.data.missing)} of the samples at sections: they lie in gaps longer "
            "than the time between two sections.",
        ),
        (
            phase.backwards,
            f"The phase ran backwards, in noise, at {_percent(phase.backwards)} of the samples: it "
            "was replaced by the mean of two monotone envelopes.",
        ),
        (
            held.left_out,
            f"{held.left_out} stretches from the validation: too short to test more than their "
            "initial condition. They count in the fit.",
        ),
    ]
    return [sentence for amount, sentence in causes if amount]


def _sampling_rates(recording: Recording) -> list[float]:
    """Return one over the median time between samples for each trial, in Hz."""
    return [float(1 / np.median(np.diff(t.time))) for t in recording.trials]


def _upper(found: Identification) -> list[tuple[int, complex]]:
    """Return index and value of the multipliers; of conjugate pairs the first."""
    return [(i, complex(z)) for i, z in enumerate(found.fit.multipliers) if z.imag >= 0]


def _sentence(message: str) -> str:
    """Return a message with names of arguments, which stand between backticks, as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(message))


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2g}\u00a0%"


def _show(z: complex) -> str:
    imaginary = f" {'-' if z.imag < 0 else '+'} {abs(z.imag):.4f}i" if z.imag else ""
    return f"{z.real:.4f}{imaginary}"
