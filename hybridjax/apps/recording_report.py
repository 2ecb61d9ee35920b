"""The results of a recording in files, and in one page for a colleague."""

import base64
import contextlib
import csv
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, plot
from .._core.boundary.checked import checked
from .._core.writing import Format, results_folder
from ..io import save
from ..linear.htf import HTF
from ..plot import look
from ..recordings.identification import Identification
from .recording_page import left_out, page, sampling_rates


PAGE = "report.html"
_POINTS = 240  # frequencies at which transfer functions are written


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
    they were changed since; a hidden list in the folder says which they are.

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
    """A new folder for the results, which at the end are put into `folder`."""
    files = (PAGE, "sections.csv", "cycle.csv", "htf.npz", "fit.npz", "summary.json")
    figures = ["phase", "sections", "multipliers", "impulse_responses", "validation"]
    for by_input in _by_input(inputs):
        figures += [f"bode{by_input}", f"harmonics{by_input}"]
    images = [f"figures/{name}.{format}" for name in figures for format in _shown(formats)]
    return results_folder(Path(folder), "report", [*files, *images])


def _shown(formats: Sequence[Format]) -> tuple[Format, ...]:
    """With the one that the page shows, first."""
    return tuple(dict.fromkeys(("png", *formats)))


def _by_input(inputs: Sequence[str]) -> list[str]:
    """What names of figures of each input end in."""
    return [f"_{x.replace('/', '-')}" for x in inputs] if len(inputs) > 1 else [""]


def write_results(folder: Path, found: Identification, formats: Sequence[Format]) -> None:
    """Write all results into a folder that is new."""
    from matplotlib import pyplot

    (folder / "figures").mkdir()
    htf = _htf(found)
    images = {}
    for name, drawn in _figures(found, htf).items():
        image, *_ = look.save(folder / "figures" / name, drawn, _shown(formats))
        images[name] = base64.b64encode(image.read_bytes()).decode()
        pyplot.close(drawn.figure)
    save(folder / "htf.npz", htf)
    save(folder / "fit.npz", found.fit)
    _write_sections(found, folder)
    (folder / "summary.json").write_text(json.dumps(summarize(found), indent=1) + "\n")
    (folder / PAGE).write_text(page(found, images), encoding="utf-8")


def summarize(found: Identification) -> dict[str, Any]:
    """The numbers of the report, ready for JSON."""
    data, fit, held = found.data, found.fit, found.held_out
    return {
        "version": __version__,
        "trials": [t.name for t in found.recording.trials],
        "sampling_rates": sampling_rates(found.recording),
        "left_out": left_out(found),
        "notes": list(found.recording.notes),
        "units": {"time": "s"} | dict(zip(data.inputs + data.outputs, data.units, strict=True)),
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
            "multipliers": plot.multipliers(found.fit, {"plain regression": found.advice.plain}),
            "impulse_responses": plot.impulse_responses(found.responses),
            "validation": plot.validation(found.held_out.validation),
        }
        for i, suffix in enumerate(_by_input(htf.inputs)):
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
        table.writerow(["trial", "record", "cycle", "section", "time (s)", *header])
        numbers = ",".join(["%d", "%d", "%.9g", *["%.9g"] * len(names)])
        for k, (record, times) in enumerate(zip(data.records, data.times, strict=True)):
            place = np.divmod(record.first_section + np.arange(len(record.u)), data.n_sections)
            start = io.StringIO()
            trial = found.recording.trials[data.trials[k]].name
            csv.writer(start, lineterminator="").writerow([trial, k])
            line = start.getvalue().replace("%", "%%") + "," + numbers
            np.savetxt(
                file, np.column_stack([*place, times, record.u, record.y]), line, newline="\r\n"
            )
    with open(folder / "cycle.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["section", "phase (cycles)", *header])
        cycle = np.concatenate([data.cycle_inputs, data.cycle_outputs], axis=1)
        for n, row in enumerate(cycle):
            table.writerow([n, n / data.n_sections, *(f"{x:.9g}" for x in row)])
