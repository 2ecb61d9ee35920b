"""The results of a recording in files, and in one page for a colleague."""

import base64
import csv
import html
import io
import json
import os
import shutil
import uuid
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, plot
from .._core.boundary.checked import checked
from ..errors import DefinitionError
from ..io import save
from ..linear.htf import HTF
from ..plot import look
from ..recordings.identification import Identification


_PAGE = "report.html"
_POINTS = 240  # frequencies at which transfer functions are written


@checked
def write_report(folder: str | os.PathLike, found: Identification) -> Path:
    """Write all results of a recording into a folder, which appears complete or not at all.

    - `report.html`: everything in one page that needs no other file.
    - `sections.csv`: deviations of inputs and outputs at the sections. `cycle.csv`: their average.
    - `htf.npz`, `fit.npz`: for `hj.load`. `summary.json`: the numbers.
    - `figures/`: PNG and PDF.

    **Returns:** the path of the page.

    **Raises:** `DefinitionError` if the folder holds other files, or cannot be written.
    """
    folder = Path(folder)
    check_folder(folder)
    temporary = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}")
    try:
        (temporary / "figures").mkdir(parents=True)
        from matplotlib import pyplot

        htf = _htf(found)
        images = {}
        for name, drawn in _figures(found, htf).items():
            image, _ = look.save(temporary / "figures" / name, drawn)
            images[name] = base64.b64encode(image.read_bytes()).decode()
            pyplot.close(drawn.figure)
        save(temporary / "htf.npz", htf)
        save(temporary / "fit.npz", found.fit)
        _write_sections(found, temporary)
        summary = summarize(found)
        (temporary / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
        (temporary / _PAGE).write_text(_page(found, images), encoding="utf-8")
        _take_place(temporary, folder)
    except OSError as error:
        raise DefinitionError(f"cannot write '{folder}': {error.strerror}.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder / _PAGE


def check_folder(folder: Path) -> None:
    """**Raises:** `DefinitionError` unless results may be written there."""
    if folder.is_dir():
        if any(folder.iterdir()) and not (folder / _PAGE).exists():
            raise DefinitionError(f"'{folder}' holds other files: choose a new folder.")
    elif folder.exists():
        raise DefinitionError(f"'{folder}' is a file: choose a new folder.")


def _take_place(temporary: Path, folder: Path) -> None:
    old = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}")
    if folder.exists():
        os.replace(folder, old)
    os.replace(temporary, folder)
    shutil.rmtree(old, ignore_errors=True)


def summarize(found: Identification) -> dict[str, Any]:
    """The numbers of the report, ready for JSON."""
    data, fit, held = found.data, found.fit, found.held_out
    return {
        "version": __version__,
        "trials": [t.name for t in found.recording.trials],
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
        "warnings": list(found.advice.warnings),
    }


def _htf(found: Identification) -> HTF:
    """Up to the edge of the band that the inputs excited."""
    edge = min(max(found.advice.band), found.data.n_sections / 2)
    return found.fit.htf(np.arange(1, _POINTS + 1) * (edge / _POINTS))


def _figures(found: Identification, htf: HTF) -> dict[str, look.Plot]:
    import matplotlib

    with matplotlib.rc_context({"backend": "agg"}):
        figures = {
            "phase": plot.phase(found.phase),
            "sections": plot.section_data(found.data),
            "multipliers": plot.multiplier_regions(found.fit, found.advice.plain),
            "impulse_responses": plot.impulse_responses(found.responses),
            "validation": plot.validation(found.held_out.validation),
        }
        for i, name in enumerate(htf.inputs):
            suffix = f"_{name}" if len(htf.inputs) > 1 else ""
            figures[f"bode{suffix}"] = plot.bode(htf, input=i)
            size = {"width": look.COLUMN, "height": 0.3 + 1.6 * len(htf.outputs)}
            with look.panels(None, len(htf.outputs), 1, **size) as axes:
                for k, output in enumerate(htf.outputs):
                    plot.magnitude(htf, output=output, input=i, decades=3, ax=axes[k, 0])
            figures[f"harmonics{suffix}"] = look.Plot(axes)
    return figures


def _write_sections(found: Identification, folder: Path) -> None:
    data = found.data
    names = data.inputs + data.outputs
    header = [f"{n} ({u})" if u else n for n, u in zip(names, data.units, strict=True)]
    with open(folder / "sections.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["trial", "record", "cycle", "section", "time", *header])
        numbers = ",".join(["%d", "%d", "%.9g", *["%.9g"] * len(names)])
        for k, (record, times) in enumerate(zip(data.records, data.times, strict=True)):
            place = np.divmod(record.first_section + np.arange(len(record.u)), data.n_sections)
            start = io.StringIO()
            trial = found.recording.trials[data.trials[k]].name
            csv.writer(start, lineterminator=",").writerow([trial, k])
            line = start.getvalue().replace("%", "%%") + numbers
            np.savetxt(
                file, np.column_stack([*place, times, record.u, record.y]), line, newline="\r\n"
            )
    with open(folder / "cycle.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["section", "phase", *header])
        cycle = np.concatenate([data.cycle_inputs, data.cycle_outputs], axis=1)
        for n, row in enumerate(cycle):
            table.writerow([n, n / data.n_sections, *(f"{x:.9g}" for x in row)])


_CAPTIONS = {
    "bode": "Magnitude and phase of H₀, with bands of 95 %.",
    "harmonics": "Magnitudes of H₀, H₁ and H₋₁, with bands of 95 %.",
}
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; } h1, h2 { line-height: 1.2; } h2 { margin-top: 2.5rem; }
table { border-collapse: collapse; margin: 1rem 0; } th, td { padding: .25rem .8rem;
  border-bottom: 1px solid #ddd; text-align: right; } th:first-child, td:first-child
  { text-align: left; } img { max-width: 100%; } .warn { border-left: 4px solid #D55E00;
  padding: .3rem 1rem; background: #fdf3ec; } .fine { border-left: 4px solid #009E73;
  padding: .3rem 1rem; background: #edf8f4; } figcaption { color: #555; font-size: .9rem; }
figure { margin: 1rem 0; } code { background: #f3f3f3; padding: 0 .2em; }
"""


def _page(found: Identification, images: dict[str, str]) -> str:
    data, fit, advice = found.data, found.fit, found.advice
    held = found.held_out.validation
    trials = ", ".join(t.name for t in found.recording.trials)
    pairs = [
        (i, z, s)
        for i, (z, s) in enumerate(zip(fit.multipliers, fit.standard_errors, strict=True))
        if z.imag >= 0
    ]
    rows = []
    for i, z, s in pairs:
        border = fit.ellipse(i)
        half = np.abs(border - z).max()
        pair = " (and its conjugate)" if z.imag > 0 else ""
        rows.append((_complex(z) + pair, f"{abs(z):.4f}", f"{s:.1e}", f"{half:.1e}",
                     _complex(advice.plain[i])))  # fmt: skip
    parts = [
        "<h1>Floquet multipliers from a recording</h1>",
        f"<p>{_safe(trials)}: {data.cycles:.0f} cycles in {len(data.records)} uninterrupted "
        f"stretches, {data.n_sections} sections per cycle; inputs {_safe(', '.join(data.inputs))}; "
        f"outputs {_safe(', '.join(data.outputs))}.</p>",
        "<h2>Multipliers</h2>",
        "<p>A multiplier says what is left of a deviation from the average cycle one cycle later. "
        "A modulus below 1 is stable; the smaller, the faster the return.</p>",
        _table(
            ("multiplier", "modulus", "standard error", "95 % region reaches", "plain regression"),
            rows,
        ),
        _figure(images["multipliers"], "Multipliers with 95 % regions in the unit circle."),
        "<h2>What to keep in mind</h2>",
        *(f'<p class="warn">{_safe(w)}</p>' for w in advice.warnings),
        *([] if advice.warnings else ['<p class="fine">Nothing speaks against the fit.</p>']),
        "<p>Standard errors to be expected from other numbers of strides like these:</p>",
        _table(
            ("strides", *(_complex(z) for _, z, _ in pairs)),
            [
                (str(n), *(f"{e[i]:.1e}" if np.isfinite(e[i]) else "too few" for i, *_ in pairs))
                for n, e in zip(advice.strides, advice.expected, strict=True)
            ],
        ),
        "<h2>Validation on strides that were held out</h2>",
        "<p>A model of the first three quarters of each stretch, simulated on the last. The tests "
        "look for what it leaves unexplained; small p-values say that there is something "
        "(process noise, nonlinearity, smoothing), not that the multipliers are wrong.</p>",
        _table(
            ("output", "explained", "rms left", "p: white", "p: independent of the input"),
            [
                (
                    name,
                    f"{held.fit[i]:.1f} %",
                    f"{held.noise[i]:.2e}",
                    f"{held.whiteness[i]:.2g}",
                    f"{held.independence[i]:.2g}",
                )
                for i, name in enumerate(held.outputs)
            ],
        ),  # fmt: skip
        _figure(
            images["validation"],
            "Measured and simulated deviations; correlations of what is left.",
        ),
        "<h2>Responses to a push</h2>",
        f"<p>What a brief push of area 1 (standard deviation {found.responses.width:.2g} cycles) "
        "does at each phase of the cycle.</p>",
        _figure(images["impulse_responses"], "Bands hold the true response with 95 %."),
        "<h2>Harmonic transfer functions</h2>",
        *(
            _figure(image, _CAPTIONS[name.split("_")[0]])
            for name, image in images.items()
            if name.startswith(("bode", "harmonics"))
        ),
        "<h2>The recording</h2>",
        _table(
            ("signal", "rms deviation from the average cycle"),
            [
                (name, f"{x:.3g} {unit}")
                for name, x, unit in zip(
                    data.inputs + data.outputs, np.concatenate(data.rms()), data.units, strict=True
                )
            ],
        ),
        f"<p>{_phase(found)}</p>",
        _figure(images["phase"], "Durations of the cycles."),
        _figure(
            images["sections"],
            "Average cycle; deviations with twice their standard deviation; power of inputs, and "
            "outputs from cycle to cycle at the section where they vary most.",
        ),
        f"<p>hybridjax {__version__}. Deviations are smoothed with a bandwidth of "
        f"{data.bandwidth:.3g} Hz; output-error fit with {fit.numerators.shape[1]} lags"
        f"{', with a part of second order' if fit.distortion else ''}; regions from the residuals, "
        "cycle by cycle.</p>",
    ]
    title = _safe(f"Multipliers of {trials}")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _safe(text: str) -> str:
    return html.escape(text)


def _phase(found: Identification) -> str:
    phase = found.phase
    parts = [
        f"{phase.cycles} whole cycles. Period {phase.period:.4g} (median), with a standard "
        f"deviation of {100 * phase.jitter:.2g} % from cycle to cycle and a drift of "
        f"{100 * phase.drift:.2g} % per cycle."
    ]
    if phase.backwards:
        parts.append(f"The phase ran backwards at {100 * phase.backwards:.2g} % of the samples.")
    if phase.dropped:
        parts.append(f"{phase.dropped} doubled events were left out.")
    if phase.missed:
        parts.append(f"{phase.missed} cycles were left out, since an event was missed.")
    if found.data.missing:
        parts.append(f"{100 * found.data.missing:.2g} % of the section data are missing.")
    return " ".join(parts)


def _complex(z: complex) -> str:
    shown = f"{z.real:.4f}" + (
        f" {z.imag:+.4f}i".replace("+", "+ ").replace("-", "- ") if z.imag else ""
    )
    return shown.replace("-", "−")


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells, tag):
        return "<tr>" + "".join(f"<{tag}>{_safe(c)}</{tag}>" for c in cells) + "</tr>"

    return "<table>" + line(header, "th") + "".join(line(r, "td") for r in rows) + "</table>"


def _figure(image: str, caption: str) -> str:
    return (
        f'<figure><img alt="{_safe(caption)}" src="data:image/png;base64,{image}">'
        f"<figcaption>{_safe(caption)}</figcaption></figure>"
    )
