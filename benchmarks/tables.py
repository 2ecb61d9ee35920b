"""The tables of docs/benchmarks.md, made from baseline.json, so that they cannot drift apart."""

import pathlib
import re
from collections.abc import Callable
from typing import Any


JOBS = ("hopper.isochron", "hopper.kinematic", "bar.isochron", "bar.kinematic")
NONE = "-"


def fill(page: pathlib.Path, baseline: dict[str, Any]) -> None:
    """Write all tables between the marks of the page, `<!-- table: name -->` and `<!-- end -->`.

    **Raises:** `KeyError` for a mark that names no table.
    """
    values = {}
    for case in baseline.values():
        values |= case["values"]

    def table(found: re.Match) -> str:
        return f"{found[1]}\n{TABLES[found[2]](values, baseline)}\n{found[3]}"

    marks = r"(<!-- table: (\w+) -->)\n.*?(<!-- end -->)"
    page.write_text(re.sub(marks, table, page.read_text(), flags=re.DOTALL))


def machines(values: dict, baseline: dict) -> str:
    lines = []
    for name, case in baseline.items():
        about = ", ".join(f"{k} {v}" for k, v in case["software"].items())
        machine = f"{case['hardware']['cpu']}, {case['hardware']['cores']} cores"
        lines.append((f"{machine}; {about}; {case['date']}", name))
    found = {}
    for line, name in lines:
        found.setdefault(line, []).append(name)
    return (
        "\n".join(f"- {', '.join(names)}: {line}." for line, names in found.items())
        or NONE
    )


def experiments(values: dict, baseline: dict) -> str:
    """Seconds and errors of each at its fastest setting with errors below 1e-9."""
    who = {
        "run": "`run_experiments`",
        "program": "its compiled program",
        "loops": "`run_experiments`, loop kernels",
        "c": "C loop",
        "heyoka.scalar": "heyoka, one by one",
        "heyoka.simd": "heyoka, batches of 8",
        "heyoka.batch": "heyoka, batches of 80",
        "scipy": "scipy DOP853",
        "jaxonomy": "jaxonomy",
    }
    rows = []
    for key, name in who.items():
        row = [name]
        for job in JOBS:
            seconds = values.get(f"experiments.{job}.at_1e-09.{key}.cpu")
            ratio = values.get(
                f"experiments.{job}.at_1e-09.ratio_{key.replace('.', '_')}.run"
            )
            error = values.get(f"experiments.{job}.at_1e-09.{key}.error")
            text = number(seconds)
            if error is not None:
                text += f" ({error:.0e})"
            row.append(text if ratio is None else f"{text}, {number(ratio)}x")
        rows.append(row)
    return markdown(("", *(job.replace(".", ", ") for job in JOBS)), rows)


def loops(values: dict, baseline: dict) -> str:
    """Seconds of compiling the program of experiments, and of running it, without and with."""
    rows = []
    for job in JOBS:
        name = f"experiments.{job}"
        keys = [f"{name}.{x}.compile" for x in ("run", "loops")]
        keys += [f"{name}.at_1e-09.{x}.cpu" for x in ("run", "loops")]
        rows.append((job.replace(".", ", "), *(number(values.get(x)) for x in keys)))
    head = "job", "compile", "compile, loop kernels", "run", "run, loop kernels"
    return markdown(head, rows)


def honesty(values: dict, baseline: dict) -> str:
    rows = []
    own = [x for x in values if x.startswith("honesty.")]
    names = [x.removesuffix(".bounded") for x in own if x.endswith(".bounded")]
    for name in (name for name in names if ".amplitude_0.1." in name):
        _, model, family, rest = name.split(".", 3)
        accuracy = rest.partition(".accuracy_")[2]
        columns = ("ok", "true_error", "bounded", "met", "median_ratio")
        measured = [number(values.get(f"{name}.{x}")) for x in columns]
        rows.append((f"{model}, {family}", accuracy, *measured))
    head = (
        "job",
        "accuracy",
        "ran well",
        "largest error",
        "error <= estimate",
        "error <= accuracy",
        "estimate / error",
    )
    return markdown(head, rows)


def derivatives(values: dict, baseline: dict) -> str:
    rows = []
    for job in JOBS:
        name = f"jacobians.{job}"
        found = {
            "program at 1e-10": f"{name}.program.rtol_1e-10",
            "program at 1e-12": f"{name}.program.rtol_1e-12",
            "sections and program at 1e-12": f"{name}.placing.rtol_1e-12",
            "`linearize`": f"{name}.linearize",
            "heyoka at 1e-6": f"{name}.{job}.heyoka.jacobians.tol_1e-06",
            "heyoka at 1e-9": f"{name}.{job}.heyoka.jacobians.tol_1e-09",
        }
        for who, key in found.items():
            key = key.replace(f"{job}.{job}", job)
            measured = [
                number(values.get(f"{key}.{x}")) for x in ("cpu", "error", "compile")
            ]
            rows.append((job.replace(".", ", "), who, *measured))
    return markdown(("job", "", "seconds", "error", "compile"), rows)


TABLES: dict[str, Callable[[dict, dict], str]] = {
    "machines": machines,
    "experiments": experiments,
    "loops": loops,
    "honesty": honesty,
    "derivatives": derivatives,
}


def number(value: Any, unit: str = "") -> str:
    if isinstance(value, int | float):
        text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
        return f"{text} {unit}".strip()
    return NONE if value is None else str(value).strip('"')


def markdown(head, rows) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
