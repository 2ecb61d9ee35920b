"""A study: recordings of several subjects, listed in a table, with one report for each and one for
all."""

import concurrent.futures
import contextlib
import csv
import dataclasses
import json
import multiprocessing
import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, plot
from .._core import html
from .._core.boundary.checked import checked
from .._core.boundary.kinds import FilePath, OptionalNames
from .._core.pieces.description import digest_of
from .._core.pieces.run import DaskClient
from .._core.precision import enable_x64
from .._core.progress import counted, working
from .._core.results import Result
from .._core.writing import Format, results_folder
from ..errors import DefinitionError, HybridJaxError
from ..identify.series.fit import SeriesFit
from ..io import load
from ..recordings.identification import Identification
from ..recordings.population.maps import PopulationMaps
from ..recordings.population.population import Population
from ..recordings.population.quantities import measured
from ..recordings.population.summary import PopulationTable
from ..recordings.population.table import FACTORS, as_columns
from ..recordings.read import read_recording
from ..recordings.recording import Recording
from .identify import _STYLE, PAGE, picture_of, report_folder, steps_of, write_results


_JOB = "job.json"


@dataclasses.dataclass(frozen=True, repr=False)
class Study:
    """Results of `identify_subjects`.

    **Fields:** `table`: columns of the subjects that were identified, with `strides`; `fits`, one
    for each row; `population`: their modulus, period, and, where all have them, angle and
    coefficients (None for fewer than two rows); `maps`: responses of each output to each input held
    for a section, (phase, lag); `failures`: sentences by name of the report; `tables`: means, and
    differences of all pairs of groups and conditions; `folder`.
    """

    table: dict[str, np.ndarray]
    fits: tuple[SeriesFit, ...]
    population: Population | None
    maps: dict[tuple[str, str], PopulationMaps]
    failures: dict[str, str]
    tables: tuple[PopulationTable, ...]
    folder: Path

    def __repr__(self) -> str:
        lines = [f"Study({len(self.fits)} reports in {self.folder}, {len(self.failures)} failed)"]
        lines += [f"  {name} failed: {text}" for name, text in self.failures.items()]
        return "\n".join([*lines, *map(repr, self.tables)])


@dataclasses.dataclass(frozen=True)
class Job:
    """One report: the trials of one subject in one condition."""

    name: str
    files: tuple[Path, ...]
    identify: Callable[[Recording], Identification]
    time: str
    signals: tuple[str, ...]
    folder: Path
    formats: tuple[Format, ...]

    def key(self) -> str:
        """Return JSON from which results can be told from those of other files or options."""
        files = [(str(x.resolve()), x.stat().st_size, x.stat().st_mtime_ns) for x in self.files]
        options = digest_of(self.identify), self.time, self.signals, self.formats
        return json.dumps([__version__, files, options])

    def is_done(self) -> bool:
        with contextlib.suppress(OSError):
            files = (self.folder / name for name in (PAGE, "fit.npz", "summary.json"))
            same = (self.folder / _JOB).read_text() == self.key()
            return same and all(file.is_file() for file in files)
        return False

    def run(self) -> str:
        """Identify, write the report, and return the cause of a failure, or ""."""
        import matplotlib

        enable_x64()
        try:
            with matplotlib.rc_context({"backend": "agg"}):
                signals = self.signals or None
                recording = read_recording(*self.files, time=self.time, signals=signals)
                result = self.identify(recording)
                with report_folder(self.folder, result.data.inputs, self.formats) as new:
                    write_results(new, result, self.formats)
                    (new / _JOB).write_text(self.key())
        except HybridJaxError as error:
            return str(error)
        except Exception as error:  # of a library that reads files, or of the user's function
            return f"{type(error).__name__}: {error}"
        return ""


def run(options: Any) -> int:
    """Identify the subjects of a table, from the options of the command, and print the results.

    **Returns:** the exit status: 1 if a subject failed.
    """
    signals, identify = steps_of(options)
    more = {"time": options.time, "signals": signals, "formats": options.formats}
    with contextlib.ExitStack() as stack:
        if options.workers > 1:
            spawn = multiprocessing.get_context("spawn")
            pool = concurrent.futures.ProcessPoolExecutor(options.workers, mp_context=spawn)
            more["client"] = stack.enter_context(pool)
        study = identify_subjects(options.table, options.out, identify, **more)
    print(study)
    print(Path(options.out) / "population.html")
    return 1 if study.failures else 0


@checked
@working("identify_subjects")
def identify_subjects(
    table: FilePath,
    folder: FilePath,
    identify: Callable,
    *,
    time: str = "time",
    signals: OptionalNames = (),
    formats: tuple[Format, ...] = ("png",),
    client: DaskClient | concurrent.futures.Executor | None = None,
) -> Study:
    """Identify all subjects of a table, write a report for each, and one for all of them.

    Rows with the same subject, group and condition are trials of one recording. A subject that
    fails is named and does not stop the others. A later call goes on where an earlier one ended:
    reports are kept unless files, options or the version have changed.

    Files in `folder`: `SUBJECT-GROUP-CONDITION/` with the files of `hj.write_report`;
    `subjects.csv`, a row for each report; `population.csv`, means and differences; `failures.csv`;
    `population.html`, the report for all.

    **Arguments:**

    - `table`: CSV file with the columns `file` (relative to the table) and `subject`; `condition`
      and `group`, if there are any; other columns (age, speed) are handed on.
    - `identify`: function from a `Recording` to the result of `identify_recording`, e.g.
      `functools.partial(hj.identify_recording, phase=..., inputs=..., outputs=...)`.
    - `time`: name of the column with the times. Default: "time". `signals`: names of the signals
      to be read. Default: all.
    - `formats` of the figures. Default: PNG.
    - `client`: a client of Dask, or an executor of `concurrent.futures`, whose processes do the
      work and see the same files. Default: this process.

    **Raises:** `DefinitionError` for a table without these columns or rows, a subject in two
    groups, and a folder that cannot be written.
    """
    rows = _rows(Path(table))
    labels = as_columns({n: x for n, x in rows.items() if n != "file"}, len(rows["file"]))
    names = [n for n in ("subject", *FACTORS) if n in labels]
    keys = list(zip(*(labels[n] for n in names), strict=True))
    jobs: list[Job] = []
    first: list[int] = []
    for key in dict.fromkeys(keys):
        of = [i for i, other in enumerate(keys) if other == key]
        name = re.sub(r"[^\w.+-]+", "_", "-".join(key))
        if name in [job.name for job in jobs]:
            raise DefinitionError(f"two subjects would have the report '{name}': rename one.")
        files = tuple(Path(table).parent / rows["file"][i] for i in of)
        place = Path(folder) / name
        jobs.append(Job(name, files, identify, time, tuple(signals), place, tuple(formats)))
        first.append(of[0])
    failures = _run(jobs, client)
    done, fits, summaries = [], [], []
    for i, job in zip(first, jobs, strict=True):
        if job.name not in failures:
            fit: Any = load(job.folder / "fit.npz")
            if fit.result == Result.OK:
                done.append(i)
                fits.append(fit)
                summaries.append(json.loads((job.folder / "summary.json").read_text()))
            else:
                failures[job.name] = "the fit did not converge."
    columns = {n: x[done] for n, x in labels.items() if n != "trial"}
    columns["strides"] = np.array([float(s["cycles"]) for s in summaries])
    population, maps = None, {}
    if len(fits) > 1:
        population = _population(fits, columns, summaries)
        maps = _maps(fits, columns, summaries)
    tables = () if population is None else _tables(population)
    study = Study(columns, tuple(fits), population, maps, failures, tables, Path(folder))
    _write(study, [jobs[first.index(i)].name for i in done], summaries)
    return study


def _rows(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the table; those with numbers in all rows as numbers."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DefinitionError(f"cannot read the table '{path}': {error}.") from None
    missing = [n for n in ("file", "subject") if not rows or not all(row.get(n) for row in rows)]
    if missing:
        raise DefinitionError(
            f"the table '{path}' needs rows with the columns 'file' and 'subject' (separated by "
            f"commas), but '{missing[0]}' is empty or not there."
        )
    columns = {n: np.array([row[n] or "" for row in rows]) for n in rows[0] if n}
    for name in columns.keys() - {"file", "subject", *FACTORS}:
        with contextlib.suppress(ValueError):
            columns[name] = columns[name].astype(float)
    return columns


def _run(jobs: list[Job], client: Any) -> dict[str, str]:
    """Run the jobs that are not done, and return the causes of failures by name."""
    missing = [job for job in jobs if not job.is_done()]
    failures = {}
    if client is None:
        results = [job.run() for job in counted(missing, "subjects", len(missing))]
    else:
        futures, results = [client.submit(Job.run, job) for job in missing], []
        for future in counted(futures, "subjects", len(futures)):
            try:
                results.append(future.result())
            except Exception as error:  # a worker that ended, or a function without a pickle
                results.append(f"{type(error).__name__}: {error}")
    for job, text in zip(missing, results, strict=True):
        if text:
            failures[job.name] = text
    return failures


def _population(fits, columns, summaries) -> Population:
    """Return the quantities that all fits have."""
    quantities: list[Any] = ["modulus"]
    quantities += ["angle"] * all(fit.multipliers[0].imag != 0 for fit in fits)
    quantities += ["coefficients"] * (len({len(fit.coefficients) for fit in fits}) == 1)
    values, errors, units = measured(fits, list(columns["subject"]), quantities)
    error = np.array([s["period_standard_error"] for s in summaries])
    if (error > 0).all():
        values["period"] = np.array([s["period_mean"] for s in summaries])
        errors["period"], units["period"] = error, "s"
    freedom = [fit.covariance_freedom for fit in fits]
    return Population(columns, values, errors, units, freedom)


def _maps(fits, columns, summaries) -> dict[tuple[str, str], PopulationMaps]:
    """Return responses over three cycles, by output and input, if all have the same sections."""
    N = fits[0].n_sections
    if any(fit.n_sections != N or fit.inputs != fits[0].inputs for fit in fits):
        return {}
    lags = 3 * N + 1
    m, r = np.arange(N)[:, None], np.arange(lags)
    areas = [s["period"] / N for s in summaries]
    # From the section of the response to that of the push.
    h = [f.impulse_response(lags)[(m + r) % N, r] / a for f, a in zip(fits, areas, strict=True)]
    axes = {"phase (cycles)": np.arange(N) / N, "lag (cycles)": r / N}
    return {
        (y, u): PopulationMaps(columns, np.stack(h)[..., i, j], axes, "phase (cycles)")
        for i, y in enumerate(fits[0].outputs)
        for j, u in enumerate(fits[0].inputs)
    }


def _pairs(population: Population) -> list[tuple[str, str]]:
    labels = (list(dict.fromkeys(population.table.get(factor, ()))) for factor in FACTORS)
    return [(b, a) for x in labels for i, a in enumerate(x) for b in x[i + 1 :]]


def _tables(population: Population) -> tuple[PopulationTable, ...]:
    """Return means, and differences of all pairs, for each quantity; none for too few subjects."""
    tables = []
    for name in population.values:
        with contextlib.suppress(DefinitionError):
            tables.append(population.mean(name))
        for a, b in _pairs(population):
            with contextlib.suppress(DefinitionError):
                tables.append(population.difference(name, a, b))
    return tuple(tables)


def _write(study: Study, names: list[str], summaries: list[dict]) -> None:
    """Write the tables, and the report for all."""
    reports = {"report": np.array(names)} | study.table
    if study.population is not None:
        for name, values in study.population.values.items():
            reports |= {name: values, f"{name}_error": study.population.errors[name]}
    reports["warnings"] = np.array([len(s["warnings"]) for s in summaries])
    columns = {n: np.concatenate([t[n] for t in study.tables]) for n in (
        study.tables[0].columns if study.tables else ())}  # fmt: skip
    failed = {"report": list(study.failures), "cause": list(study.failures.values())}
    images = _images(study)
    results = ["subjects.csv", "population.csv", "failures.csv", "population.html"]
    with results_folder(study.folder, "population", results) as new:
        contents: tuple[dict[str, Any], ...] = (reports, columns, failed)
        for name, each in zip(results, contents, strict=False):
            PopulationTable({k: np.array(x) for k, x in each.items()}, "").write(new / name)
        links = "".join(f'<li><a href="{n}/{PAGE}">{escape(n)}</a></li>' for n in names)
        failures = "".join(
            f'<p class="warn">{escape(n)} failed: {escape(text)}</p>'
            for n, text in study.failures.items()
        )
        methods = "".join(f"<p>{escape(x)}</p>" for x in dict.fromkeys(
            t.methods for t in study.tables))  # fmt: skip
        tables = "".join(html.text(repr(t)) for t in study.tables)
        figures = "".join(
            f'<figure><img alt="{escape(n)}" src="data:image/png;base64,{x}">'
            f"<figcaption>{escape(n)}</figcaption></figure>" for n, x in images.items()
        )  # fmt: skip
        (new / "population.html").write_text(
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Population'
            f"</title><style>{_STYLE}</style></head>\n<body>\n<h1>{len(names)} reports</h1>"
            f"{failures}<ul>{links}</ul>{tables}{figures}{methods}</body></html>\n",
            encoding="utf-8",
        )


def _images(study: Study) -> dict[str, str]:
    """Return figures as PNG in base 64 by caption; those that need more subjects are left out."""
    import matplotlib

    images = {}
    with matplotlib.rc_context({"backend": "agg"}), contextlib.suppress(DefinitionError):
        if study.population is not None:
            drawn = plot.forest(study.population, "modulus")
            images["Modulus of the leading multiplier"] = picture_of(drawn)
            for a, b in _pairs(study.population):
                drawn = plot.paired(study.population, "modulus", a, b)
                images[f"Modulus, {a} and {b}"] = picture_of(drawn)
            for (y, u), maps in study.maps.items():
                images[f"Response of {y} to {u}, mean"] = picture_of(plot.subject_maps(maps.mean()))
                for a, b in _pairs(study.population):
                    test = maps.difference(a, b)
                    images[f"Response of {y} to {u}, {a} - {b}: {test.methods}"] = picture_of(
                        plot.subject_maps(test)
                    )
    return images
