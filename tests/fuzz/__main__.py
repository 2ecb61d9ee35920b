"""Random hybrid systems, hybridjax against scipy: `python -m tests.fuzz --systems 1000`."""

import argparse
import sys

import hybridjax as hj

from .campaign import ACCURACY, check, shares


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--systems", type=int, default=1000, help="number, over all structures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--accuracy", type=float, default=ACCURACY, help="tolerances of hybridjax")
    arguments = parser.parse_args()
    hj.enable_x64()
    reports = []
    for name, numbers in shares(arguments.systems).items():
        if numbers:
            reports.append(check(name, numbers, arguments.seed, arguments.accuracy))
            print(reports[-1], flush=True)
    excluded = sum(r.systems - r.compared for r in reports) / sum(r.systems for r in reports)
    print(f"excluded {excluded:.2%} (by scipy alone)")
    return int(any(r.failures for r in reports))


if __name__ == "__main__":
    sys.exit(main())
