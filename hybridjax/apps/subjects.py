"""`identify_subjects`: recordings of several subjects, listed in a table, with one report for each
and one for all.

Each report is a job (`_report`, by `apps/identify.py`), done here or by a client (`_failures`); its
failure becomes a sentence and does not stop the others. The fits are then read from the reports
(`_population`), compared (`_effects`) and written (`_write`). If a report is not made anew although
something has changed, or made anew without need, look at `job` in `_report`; if a row of the table
is refused, at `_rows`. Wrong means have their cause in `recordings/population/`.

All on which a report depends must be in `job`. A further figure, of a quantity of `Population`, is
a line in `_FOREST`; a further column of the table one in `_COLUMNS`, with its key in `summary.json`
(`_summary_of_data` in `identify.py`).
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import inspect
import itertools
import json
import multiprocessing
import os
import re
from collections.abc import Callable, Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any, cast

from .. import __version__
from .._core import html
from .._core.arguments import package
from .._core.boundary.checked import WrongArguments, checked
from .._core.boundary.kinds import FilePath, OptionalNames
from .._core.boundary.leads import about_keyword
from .._core.pieces.description import digest_of
from .._core.pieces.run import DaskClient
from .._core.precision import enable_x64
from .._core.progress import counted, working
from .._core.showable import Showable
from .._core.text import folded
from .._core.writing import Format, require_free, results_folder
from ..errors import ComputationError, DefinitionError, HybridJaxError
from ..identify.series.fit import SeriesFit
from ..io import load
from ..plot.look import AxesLike, Plot, save_and_close
from ..plot.subjects import forest
from ..recordings.identification import identify_recording
from ..recordings.natural import NaturalMultipliers
from ..recordings.population.population import Population
from ..recordings.population.tables import Columns, factors_of, table_of
from ..recordings.read import read_recording
from .identify import (
    PAGE,
    converged,
    page_of,
    report_folder,
    steps_of,
    with_png,
    write_results,
)


# Columns of the table of a study, and their names in the summaries.
_COLUMNS = {
    "strides": "cycles",
    "period": "period",
    "period_error": "period_standard_error",
}
# Columns of the results that are printed. (The file has all.)
_SHOWN = ["effect", "subjects", "estimate", "standard_error", "low", "high", "p"]
# The name of the list of these files, by which a later call knows them.
_POPULATION = "population"
_FILES = ("subjects.csv", "population.csv", "population.html")
_TESTS = (
    "The p value of each difference is that of one test: with several quantities, groups or "
    "conditions, some are small by chance."
)
# The file of a report that says of which files and options it was made.
_JOB = "job.json"
# The quantities that have a figure, each with its caption.
_FOREST = {
    "modulus": "Modulus of the leading multiplier",
    "angle": "Angle of the leading multiplier, if it is complex",
    "decay": "Decay of a deviation per stride (half of it is left after 0.69 / decay strides)",
}


@dataclasses.dataclass(frozen=True, repr=False)
class SubjectStudy(Showable):
    """Results of `identify_subjects`.

    **Fields:** `population` of the subjects that were identified; its table also has `report`,
    `strides`, `period` and `period_error` (s). `fits`, one for each row; `failures`: sentences by
    name of the report, and of "population" if a mean has too few subjects; `results`: data frame of
    means, and differences of all pairs of groups and conditions, of each quantity of the
    population; `folder`.
    """

    population: Population
    fits: tuple[SeriesFit | NaturalMultipliers, ...]
    failures: dict[str, str]
    results: Any
    folder: Path

    @property
    def remarks(self) -> list[str]:
        """Failures, and the fits to doubt, in sentences."""
        fits = zip(self.population.table["report"], self.fits, strict=True)
        remarks = [f"{name} failed: {text}" for name, text in self.failures.items()]
        for name, fit in fits:
            remarks += [f"{name} is doubtful: {doubt.text}" for doubt in fit.findings]
        return remarks

    @checked
    def plot(self, quantity: str = "modulus", *, ax: AxesLike | None = None) -> Plot:
        """Draw a quantity of all subjects, as `Population.plot` does."""
        return forest(self.population, quantity, ax=ax)

    def to_pandas(self) -> Any:
        """Return the table of the population: a row for each report."""
        return self.population.to_pandas()

    def __repr__(self) -> str:
        lines = [
            f"SubjectStudy({len(self.fits)} reports in {self.folder}, {len(self.failures)} failed)"
        ]
        lines += [folded(f"  {text}", "  ") for text in self.remarks]
        if len(self.results):
            shown = self.results[["quantity", *_SHOWN]]
            lines.append(shown.to_string(index=False, float_format="{:.4g}".format))
        return "\n".join(lines)


def _cause(write: Callable[..., str], *arguments: Any) -> str:
    """Return the cause of a failure, or "": files, functions of users and workers may all fail."""
    try:
        return write(*arguments)
    except Exception as error:
        if isinstance(error, HybridJaxError):
            return str(error)
        return f"{type(error).__name__}: {error}"


def _report(
    files: list[Path],
    folder: Path,
    identify: Callable,
    reading: dict,
    formats,
) -> str:
    """Identify the trials of one subject in one condition, and write the report.

    **Returns:** the cause of a failure, or "". Results of the same files and options are kept.
    """
    sources = []
    for file in filter(Path.exists, files):
        about = file.stat()
        sources.append((str(file), about.st_size, about.st_mtime_ns))
    job = json.dumps([__version__, sources, digest_of(identify), reading, formats])
    needed = [folder / name for name in (_JOB, PAGE, "fit.npz", "summary.json")]
    if all(x.is_file() for x in needed) and needed[0].read_text() == job:
        return ""
    enable_x64()
    result = identify(read_recording(*files, **reading))
    is_minimum = converged(result)
    with report_folder(folder, result.data.inputs, formats) as new:
        write_results(new, result, formats)
        (new / _JOB).write_text(job if is_minimum else "")
    return "" if is_minimum else "the fit did not converge."


def run(options: Any) -> int:
    """Identify the subjects of a table, from the options of the command, and print the results.

    **Returns:** the exit status: 1 if a subject failed.
    """
    signals, identify = steps_of(options)
    reading: Any = {
        "time": options.time,
        "signals": signals,
        "formats": options.formats,
    }
    spawn = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(options.workers, mp_context=spawn)
    try:
        reading["client"] = pool if options.workers > 1 else None
        study = identify_subjects(options.table, options.out, identify, **reading)
    finally:
        pool.shutdown(cancel_futures=True)  # after an interruption
    print(study)
    print(Path(options.out) / _FILES[-1])
    return 1 if study.failures else 0


@checked
@working("identify_subjects")
def identify_subjects(
    table: FilePath | Columns,
    folder: FilePath,
    identify: Callable | None = None,
    *,
    time: str = "time",
    signals: OptionalNames = (),
    formats: tuple[Format, ...] = ("png",),
    client: DaskClient | concurrent.futures.Executor | None = None,
    **options: Any,
) -> SubjectStudy:
    """Identify all subjects of a table, write a report for each, and one for all of them.

    Rows with the same subject, group and condition are trials of one recording. A subject that
    fails is named and does not stop the others. A later call continues an interrupted one: reports
    are kept unless files, options or the version have changed.

    Files in `folder`: `SUBJECT-GROUP-CONDITION/` with the files of `Identification.write_report`;
    `subjects.csv`, a row for each report; `population.csv`, means and differences;
    `population.html`, the report for all.

    **Arguments:**

    - `table`: CSV file with the columns `file` (relative to the table) and `subject`; `condition`
      and `group`, if there are any; other columns (age, speed) are kept in
      `SubjectStudy.population.table`. It may also be a data frame, or a dictionary of columns;
      files are then relative to the folder of this process.
    - `folder`: folder of the results, which is made if it does not exist.
    - `identify`: function from a `Recording` to the result of `identify_recording`. Default:
      `identify_recording` itself, with all further keywords, `options`, such as `sections`,
      `inputs` and `outputs`; without `inputs`, multipliers are those of variability.
    - `time`: name of the column with the times. Default: "time".
    - `signals`: names of the signals to be read. Default: all.
    - `formats`: formats of the figures. Default: PNG.
    - `client`: a client of Dask, or an executor of `concurrent.futures`, whose processes do the
      work and can read the same files. Default: this process.

    **Returns:** `hj.recordings.SubjectStudy`: the `population`, one `SeriesFit` per subject in
    `fits` (`NaturalMultipliers` without inputs), data frames of means and differences in `results`,
    and sentences in `failures`.

    **Raises:** `DefinitionError` for a table without these columns or rows, a subject in two
    groups, a folder that cannot be written or holds other files of these names, and if pandas is
    not installed; `ComputationError` if all subjects fail.

    **Example:**

    ```python
    recording.to_pandas().to_csv("S1.csv")
    with open("subjects.csv", "w") as table:
        print("file,subject", file=table)
        print("S1.csv,S1", file=table)
    options = {"inputs": "u", "outputs": outputs, "n_sections": 8, "order": 2}
    study = hj.identify_subjects("subjects.csv", "study", sections=apex, **options)
    ```

    **Before:** `hj.identify_recording` of one subject. **After:** `study.population.difference`,
    `study.plot(quantity)`.
    """
    identify = _identify_by(identify, options)
    rows = _rows(table)
    place = Path(table).parent if isinstance(table, str | os.PathLike) else Path()
    root = Path(folder)
    require_free(root, _POPULATION, _files(formats))
    jobs: dict[str, Callable[[], str]] = {}
    reading: dict[str, Any] = {"time": time, "signals": tuple(signals) or None}
    for name, trials in rows.groupby("report", sort=False):
        if (trials[["subject", *factors_of(rows)]].nunique() > 1).any():
            raise DefinitionError(
                f"two subjects would have the report '{name}': rename one."
            )
        files = [place / file for file in trials["file"]]
        jobs[name] = functools.partial(
            _cause, _report, files, root / name, identify, reading, formats
        )
    failures = _failures(jobs, client)
    is_identified = ~rows["report"].isin(failures)
    frame = rows[is_identified].drop_duplicates("report", ignore_index=True)
    if not len(frame):
        causes = "; ".join(f"{name}: {cause}" for name, cause in failures.items())
        raise ComputationError(f"all subjects fail: {causes}")
    population, fits = _population(frame, root)
    parts = []
    lacking = []
    for quantity in population.values:
        try:
            parts += _effects(population, quantity)
        except DefinitionError as error:  # too few subjects: the report shows its text
            if quantity == "modulus":
                failures["population"] = str(error)
            else:
                lacking.append(f"Not compared: {quantity} ({error})")
    pandas = package("pandas")
    results = pandas.concat([pandas.DataFrame(), *parts], ignore_index=True)
    study = SubjectStudy(population, fits, failures, results, root)
    methods = dict.fromkeys(part.attrs["methods"] for part in parts)
    _write(study, [*methods, _TESTS, *lacking], formats)
    return study


def _effects(population: Population, quantity: str) -> list[Any]:
    """Return the means of a quantity, and its differences of all pairs of groups and conditions.

    **Raises:** `DefinitionError` for too few subjects.
    """
    table = population.table
    parts = [population.mean(quantity)]
    for factor in factors_of(table):
        pairs = itertools.combinations(table[factor].unique()[::-1], 2)
        parts += [population.difference(quantity, a, b) for a, b in pairs]
    return parts


def _failures(jobs: Mapping[str, Callable[[], str]], client: Any) -> dict[str, str]:
    """Do the jobs, here or by a client, and return the causes of those that failed."""
    calls = dict(jobs)
    if client:
        calls = {name: client.submit(job).result for name, job in jobs.items()}
    failures = {}
    for name in counted(list(calls), "subjects", len(calls)):
        cause = _cause(calls[name])
        if cause:
            failures[name] = cause
    return failures


def _population(frame: Any, root: Path) -> tuple[Population, tuple[SeriesFit, ...]]:
    """The fits in the reports of a table's rows, and a population of them."""
    fits = []
    summaries = []
    for name in frame["report"]:
        folder = root / name
        fits.append(cast(Any, load(folder / "fit.npz")))
        summaries.append(json.loads((folder / "summary.json").read_text()))
    for name, key in _COLUMNS.items():
        frame[name] = [float(summary[key]) for summary in summaries]
    facts = frame.drop(columns=["file", "trial"], errors="ignore")
    return Population.from_fits(fits, facts), tuple(fits)


def _identify_by(identify: Callable | None, options: Mapping[str, Any]) -> Callable:
    """Return the function that identifies a recording: that given, or `identify_recording` with the
    options.

    **Raises:** `DefinitionError` for options beside a function, for those that `identify_recording`
    has not, and where it gets no sections.
    """
    if identify is not None and options:
        raise DefinitionError(
            f"`{next(iter(options))}` is for `hj.identify_recording`: pass it inside of "
            "`identify`, or leave `identify` out."
        )
    if identify is not None:
        return identify
    known = list(inspect.signature(identify_recording).parameters)[1:]
    for name in options:
        if name not in known:
            raise WrongArguments(about_keyword("identify_subjects", name, known))
    if "sections" not in options:
        raise DefinitionError(
            "identify_subjects needs `sections`, `outputs` and perhaps `inputs`, those of "
            "`hj.identify_recording`."
        )
    return functools.partial(identify_recording, **options)


def _rows(table: FilePath | Columns) -> Any:
    """Return the table with the names of reports; columns with numbers in all rows as numbers.

    **Raises:** `DefinitionError` for a file that cannot be read, and for a table without files or
    subjects.
    """
    if isinstance(table, str | os.PathLike):
        called = f"the table '{table}', with columns separated by commas,"
        rows = _read(Path(table))
    else:
        called = "`table`"
        columns = {str(name): list(values) for name, values in table.items()}
        rows = package("pandas").DataFrame(columns)
    needed = rows.reindex(columns=["file", "subject"], fill_value="")
    is_missing = needed.isna() | (needed == "")
    if rows.empty or is_missing.any(axis=None):
        raise DefinitionError(f"{called} needs 'file' and 'subject' in each row.")
    rows = table_of(rows, len(rows))
    names = rows[["subject", *factors_of(rows)]].agg("-".join, axis=1)
    rows.insert(0, "report", [re.sub(r"[^\w.+-]+", "_", name) for name in names])
    return rows


def _read(path: Path) -> Any:
    try:
        return package("pandas").read_csv(
            path,
            encoding="utf-8-sig",
            dtype=dict.fromkeys(("file", "subject", "group", "condition"), str),
            keep_default_na=False,
            skipinitialspace=True,
            index_col=False,
        )
    except (OSError, ValueError) as why:
        raise DefinitionError(
            f"cannot read '{path}': {getattr(why, 'strerror', why)}."
        ) from None


def _files(formats: tuple[Format, ...]) -> list[str]:
    """Return the names of the files that `_write` may write."""
    pairs = itertools.product(_FOREST, with_png(formats))
    return [*_FILES, *(f"forest_{quantity}.{format}" for quantity, format in pairs)]


def _write(
    study: SubjectStudy, methods: Iterable[str], formats: tuple[Format, ...]
) -> None:
    """Write the tables, and the report for all."""
    population = study.population
    results = study.results
    names = [escape(name) for name in population.table["report"]]
    links = [f'<li><a href="{name}/{PAGE}">{name}</a></li>' for name in names]
    errors = {f"{name}_error": error for name, error in population.errors.items()}
    columns = results.to_html(
        index=False, border=0, float_format="{:.4g}".format, na_rep=""
    )
    parts = [
        *(f'<p class="warn">{escape(x)}</p>' for x in study.remarks),
        html.card("Means and differences", "of the leading multiplier", columns),
        *(f"<p>{escape(x)}</p>" for x in methods),
    ]
    subjects = population.table.assign(**population.values, **errors)
    with results_folder(study.folder, _POPULATION, _files(formats)) as new:
        for quantity, caption in _FOREST.items():
            with contextlib.suppress(DefinitionError):  # for too few subjects
                figure = population.plot(quantity)
                name = f"forest_{quantity}"
                save_and_close(new / name, figure, with_png(formats))
                parts.append(
                    f'<figure><img alt="{caption}" src="{name}.png"><figcaption>{caption}, of '
                    "each subject, with 95 % intervals.</figcaption></figure>"
                )
        items = f"<ul>{''.join(links)}</ul>"
        parts.append(html.card("Reports", "", items))
        subjects.to_csv(new / _FILES[0], index=False)
        results.to_csv(new / _FILES[1], index=False)
        page = page_of("Floquet multipliers of several subjects", parts)
        (new / _FILES[2]).write_text(page, encoding="utf-8")
