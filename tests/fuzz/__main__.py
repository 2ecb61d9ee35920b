"""Random hybrid systems, hybridjax against scipy: `python -m tests.fuzz --systems 1000`."""

import argparse
import sys

import hybridjax as hj

from .campaign import ACCURACY, Report, check, shares


ROW = "{:10} {:>7} {:>8} {:>7} {:>8} {:>9.1e} {:>9.1e} {:>8} {:>7.1f} {:>7.1f}"
HEAD = ROW.replace(".1e", "").replace(".1f", "").format(
    "structure", "systems", "compared", "events", "excluded", "time", "state", "failures",
    "scipy s", "engine s",
)  # fmt: skip


def line(reports: list[Report], name: str) -> str:
    """A row of the table: one structure, or their sum."""
    return ROW.format(
        name,
        sum(r.systems for r in reports),
        sum(r.compared for r in reports),
        sum(r.events for r in reports),
        sum(r.systems - r.compared for r in reports),
        max(r.time_error for r in reports),
        max(r.state_error for r in reports),
        sum(len(r.failures) for r in reports),
        sum(r.scipy_seconds for r in reports),
        sum(r.engine_seconds for r in reports),
    )


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--systems", type=int, default=1000, help="how many, over all structures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--accuracy", type=float, default=ACCURACY, help="tolerances of hybridjax")
    parser.add_argument("--only", help="one structure, or one system of it: dips or dips:17")
    arguments = parser.parse_args()
    hj.enable_x64()
    jobs = shares(arguments.systems)
    if arguments.only:
        name, _, number = arguments.only.partition(":")
        jobs = {name: [int(number)] if number else jobs[name]}
    print(HEAD)
    reports = []
    for name, numbers in jobs.items():
        if numbers:
            reports.append(check(name, numbers, arguments.seed, arguments.accuracy))
            print(line(reports[-1:], name), flush=True)
    print(line(reports, "all"))
    for r in reports:
        for reason, numbers in r.excluded.items():
            print(f"excluded, {reason}:", *(f"{r.name}:{k}" for k in numbers))
    excluded = sum(r.systems - r.compared for r in reports) / sum(r.systems for r in reports)
    print(f"excluded {excluded:.2%} (by scipy alone)")
    for r in reports:
        for k, what in r.failures.items():
            print(f"FAILED {r.name}:{k} (seed {arguments.seed}): {what}")
    return int(any(r.failures for r in reports))


if __name__ == "__main__":
    sys.exit(main())
