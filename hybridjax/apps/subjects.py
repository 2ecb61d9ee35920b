"""A study: recordings of several subjects, listed in a table, with one report for each and one for
all."""

import concurrent.futures
import contextlib
import csv
import dataclasses
import functools
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
from ..recordings.population.population import Population
from ..recordings.population.tables import FACTORS, PopulationTable, as_columns
from ..recordings.read import read_recording
from ..recordings.recording import Recording
from .identify import PAGE, figure_of, off_screen, page_of, report_folder, steps_of, write_results


# Columns of the table of a study, and their names in the summaries.
_COLUMNS = {"strides": "cycles", "period": "period", "period_error": "period_standard_error"}


@dataclasses.dataclass(frozen=True, repr=False)
class Study:
    """Results of `identify_subjects`.

    **Fields:** `table`: columns of the subjects that were identified, with `strides` and `period`
    (s); `fits`, one for each row; `population`: their modulus (None for fewer than two rows);
    `failures`: sentences by name of the report; `tables`: means, and differences of all pairs of
    groups and conditions; `folder`.
    """

    table: dict[str, np.ndarray]
    fits: tuple[SeriesFit, ...]
    population: Population | None
    failures: dict[str, str]
    tables: tuple[PopulationTable, ...]
    folder: Path

    def __repr__(self) -> str:
        lines = [f"Study({len(self.fits)} reports in {self.folder}, {len(self.failures)} failed)"]
        lines += [f"  {name} failed: {text}" for name, text in self.failures.items()]
        return "\n".join([*lines, *map(repr, self.tables)])


@dataclasses.dataclass(frozen=True)
class Job:
    """Identifies the trials of one subject in one condition, and writes the report."""

    files: tuple[Path, ...]
    folder: Path
    identify: Callable[[Recording], Identification]
    options: dict[str, Any]
    formats: tuple[Format, ...]

    def __call__(self) -> str:
        """Return the cause of a failure, or "". Results of the same files and options are kept."""
        stats = [(str(x), x.stat().st_size, x.stat().st_mtime_ns) for x in self.files if x.exists()]
        what = digest_of(self.identify), self.options, self.formats
        key, mark = json.dumps([__version__, stats, what]), self.folder / "job.json"
        needed = [self.folder / name for name in (PAGE, "fit.npz", "summary.json", mark.name)]
        if all(x.is_file() for x in needed) and mark.read_text() == key:
            return ""
        enable_x64()
        result = self.identify(read_recording(*self.files, **self.options))
        with report_folder(self.folder, result.data.inputs, self.formats) as new:
            write_results(new, result, self.formats)
            (new / mark.name).write_text(key)
        return ""


def _cause(call: Callable[[], str]) -> str:
    """Return the cause of a failure, or "": files, functions of users and workers may all fail."""
    try:
        return call()
    except Exception as error:
        return (
            str(error) if isinstance(error, HybridJaxError) else f"{type(error).__name__}: {error}"
        )


def run(options: Any) -> int:
    """Identify the subjects of a table, from the options of the command, and print the results.

    **Returns:** the exit status: 1 if a subject failed.
    """
    signals, identify = steps_of(options)
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.workers, mp_context=spawn) as pool:
        study = identify_subjects(
            options.table, options.out, identify, time=options.time, signals=signals,
            formats=options.formats, client=pool if options.workers > 1 else None,
        )  # fmt: skip
    print(study)
    print(Path(options.out) / "population.html")
    return 1 if study.failures else 0


@checked
@working("identify_subjects")
def identify_subjects(
    table: FilePath, folder: FilePath, identify: Callable, *, time: str = "time",
    signals: OptionalNames = (), formats: tuple[Format, ...] = ("png",),
    client: DaskClient | concurrent.futures.Executor | None = None,
) -> Study:  # fmt: skip
    """Identify all subjects of a table, write a report for each, and one for all of them.

    Rows with the same subject, group and condition are trials of one recording. A subject that
    fails is named and does not stop the others. A later call goes on where an earlier one ended:
    reports are kept unless files, options or the version have changed.

    Files in `folder`: `SUBJECT-GROUP-CONDITION/` with the files of `hj.write_report`;
    `subjects.csv`, a row for each report; `population.csv`, means and differences;
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
    texts = _rows(Path(table))
    files = texts.pop("file")
    labels = as_columns(texts, len(files))
    keys = list(zip(*(labels[n] for n in ("subject", *FACTORS) if n in labels), strict=True))
    jobs: dict[str, Callable[[], str]] = {}
    for key in dict.fromkeys(keys):
        name = re.sub(r"[^\w.+-]+", "_", "-".join(key))
        if name in jobs:
            raise DefinitionError(f"two subjects would have the report '{name}': rename one.")
        trials = tuple(Path(table).parent / f for f, k in zip(files, keys, strict=True) if k == key)
        reading = {"time": time, "signals": tuple(signals) or None}
        job = Job(trials, Path(folder) / name, identify, reading, tuple(formats))
        jobs[name] = functools.partial(_cause, job)
    names, firsts = list(jobs), dict(zip(jobs, dict.fromkeys(keys), strict=True))
    if client is not None:
        jobs = {name: client.submit(job).result for name, job in jobs.items()}
    causes = {name: _cause(jobs[name]) for name in counted(names, "subjects", len(names))}
    failures = {name: text for name, text in causes.items() if text}
    saved: dict[str, Any] = {
        name: load(Path(folder) / name / "fit.npz") for name in names if name not in failures
    }
    failures |= {n: "the fit did not converge." for n, x in saved.items() if x.result != Result.OK}
    done = [name for name in names if name not in failures]
    fits, rows = tuple(saved[name] for name in done), [keys.index(firsts[n]) for n in done]
    summaries = [json.loads((Path(folder) / n / "summary.json").read_text()) for n in done]
    columns = {n: x[rows] for n, x in labels.items() if n != "trial"}
    columns |= {n: np.array([float(s[k]) for s in summaries]) for n, k in _COLUMNS.items()}
    population = Population.from_fits(fits, columns) if len(fits) > 1 else None
    tables = _tables(population) if population else ()
    study = Study(columns, fits, population, failures, tables, Path(folder))
    _write(study, done)
    return study


def _rows(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the table; those with numbers in all rows as numbers."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DefinitionError(f"cannot read the table '{path}': {error}.") from None
    if not rows or not all(row.get("file") and row.get("subject") for row in rows):
        raise DefinitionError(
            f"the table '{path}' needs 'file' and 'subject' in each row, separated by commas."
        )
    columns = {n: np.array([row[n] or "" for row in rows]) for n in rows[0] if n}
    for name in columns.keys() - {"file", "subject", *FACTORS}:
        with contextlib.suppress(ValueError):
            columns[name] = columns[name].astype(float)
    return columns


def _pairs(population: Population) -> list[tuple[str, str]]:
    labels = (list(dict.fromkeys(population.table.get(factor, ()))) for factor in FACTORS)
    return [(b, a) for x in labels for i, a in enumerate(x) for b in x[i + 1 :]]


def _tables(population: Population) -> tuple[PopulationTable, ...]:
    """Return the means, and differences of all pairs; none for too few subjects."""
    tables = []
    with contextlib.suppress(DefinitionError):
        tables.append(population.mean("modulus"))
        tables += [population.difference("modulus", a, b) for a, b in _pairs(population)]
    return tuple(tables)


def _write(study: Study, names: list[str]) -> None:
    """Write the tables, and the report for all."""
    reports = {"report": np.array(names)} | study.table
    if study.population is not None:
        reports |= study.population.values
        reports["modulus_error"] = study.population.errors["modulus"]
    columns = study.tables[0].columns if study.tables else ()
    results = {n: np.concatenate([t[n] for t in study.tables]) for n in columns}
    links = "".join(f'<li><a href="{n}/{PAGE}">{escape(n)}</a></li>' for n in names)
    parts = [
        *(f'<p class="warn">{escape(f"{n} failed: {x}")}</p>' for n, x in study.failures.items()),
        f"<ul>{links}</ul>",
        *(html.text(repr(table)) for table in study.tables),
        *_figures(study),
        *(f"<p>{escape(x)}</p>" for x in dict.fromkeys(t.methods for t in study.tables)),
    ]
    files = ["subjects.csv", "population.csv", "population.html"]
    with results_folder(study.folder, "population", files) as new:
        PopulationTable(reports).write(new / files[0])
        PopulationTable(results).write(new / files[1])
        page = page_of(f"{len(names)} reports", parts)
        (new / files[2]).write_text(page, encoding="utf-8")


def _figures(study: Study) -> list[str]:
    """Return figures as HTML; those that need more subjects are left out."""
    figures: list[str] = []
    with off_screen(), contextlib.suppress(DefinitionError):
        if study.population is not None:
            drawn = plot.forest(study.population, "modulus")
            figures.append(figure_of(drawn, "Modulus of the leading multiplier"))
            for a, b in _pairs(study.population):
                drawn = plot.paired(study.population, "modulus", a, b)
                figures.append(figure_of(drawn, f"Modulus, {a} and {b}"))
    return figures
