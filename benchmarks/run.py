"""How fast and how accurate hybridjax is, beside other libraries. Prints `name.metric value` lines.

    python benchmarks/run.py                                  everything but jaxonomy
    python benchmarks/run.py --only experiments,grid          some cases
    python benchmarks/run.py --with jaxonomy=ENV/bin/python   jaxonomy, from its own environment
    python benchmarks/run.py --quick                          small: does all of it work?
    python benchmarks/run.py --baseline                       keep the numbers in baseline.json
    python benchmarks/run.py --table                          put baseline.json into the docs

Times are seconds: `cpu` of the processor, `wall` of the wall's clock, each the least of several
calls, and `compile`, by how much the first call was longer. Everything but the cases `cores` and
`compile` runs on one core. `error` is the largest difference from a closed form (benchmarks/
truth.py). The cases are described in benchmarks/cases, the figures in docs/benchmarks.md.
"""

import argparse
import importlib
import json
import pathlib
import sys
import time
import traceback

import one_thread
from cases import NAMES, Options
from report import Report, hardware, software, today
from tables import fill


HERE = pathlib.Path(__file__).parent
BASELINE = HERE / "baseline.json"
PAGE = HERE.parent / "docs" / "benchmarks.md"


def main() -> int:
    options = arguments()
    if options.table:
        fill(PAGE, json.loads(BASELINE.read_text()))
        return 0
    machine = hardware()
    one_thread.pin()
    import hybridjax as hj

    hj.enable_x64()
    report = Report()
    about = {"date": today(), "hardware": machine, "software": software()}
    for group in ("hardware", "software"):
        for name, value in about[group].items():
            report.under(group)(name, value)
    chosen = Options(options.repeat, options.quick, options.jaxonomy)
    found, failed = {}, False
    for name in options.only:
        show, begin = report.under(name), time.perf_counter()
        try:
            importlib.import_module(f"cases.{name}").run(show, chosen)
        except Exception:  # the other cases are worth having
            failed = True
            traceback.print_exc()
            show("failed", "see the traceback")
            continue
        show("seconds", time.perf_counter() - begin)
        values = {x: v for x, v in report.values.items() if x.startswith(f"{name}.")}
        found[name] = about | {
            "repeat": options.repeat,
            "quick": options.quick,
            "values": values,
        }
        if options.json:
            options.json.write_text(json.dumps(found, indent=1) + "\n")
        if options.baseline:
            keep_baseline(found)
    return int(failed)


def keep_baseline(found: dict) -> None:
    """Cases that did not run keep their numbers, with the date and the machine they are from."""
    old = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    new = {name: (old | found)[name] for name in NAMES if name in old | found}
    BASELINE.write_text(json.dumps(new, indent=1) + "\n")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", type=names, default=NAMES, help=f"of {','.join(NAMES)}"
    )
    parser.add_argument(
        "--with", dest="peer", metavar="jaxonomy=PYTHON", help="add jaxonomy"
    )
    parser.add_argument(
        "--repeat", type=int, default=5, help="calls, the least time of which counts"
    )
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--json", type=pathlib.Path, help="a file for all numbers")
    parser.add_argument(
        "--baseline", action="store_true", help="keep them in baseline.json"
    )
    parser.add_argument(
        "--table", action="store_true", help="only update docs/benchmarks.md"
    )
    options = parser.parse_args()
    if options.table and not BASELINE.exists():
        parser.error("there is no baseline.json yet: measure it by --baseline")
    if options.baseline and options.quick:
        parser.error("a baseline is not measured with --quick")
    options.jaxonomy = None
    if options.peer is not None:
        peer, _, python = options.peer.partition("=")
        if peer != "jaxonomy":
            parser.error(f"--with knows jaxonomy, not {peer}")
        options.jaxonomy = python or sys.executable
    return options


def names(text: str) -> list[str]:
    """Names of cases, separated by commas."""
    chosen = text.split(",")
    for name in chosen:
        if name not in NAMES:
            raise argparse.ArgumentTypeError(
                f"there is no case {name}: {', '.join(NAMES)}"
            )
    return [name for name in NAMES if name in chosen]


if __name__ == "__main__":
    sys.exit(main())
