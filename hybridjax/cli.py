"""The command line. Nothing heavy is imported before the arguments are known to be good."""

import argparse
import os
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `hybridjax` command."""
    options = _parser().parse_args(arguments)
    from ._core.errors import HybridJaxError

    try:
        options.run(options)
    except HybridJaxError as error:
        sys.exit(f"hybridjax: {error}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hybridjax",
        description="Identify the dynamics of rhythmic hybrid systems.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    reproduce = commands.add_parser(
        "reproduce",
        help="reproduce Ankarali & Cowan's paper on the vertical hopper",
        description="Reproduce Ankarali & Cowan, 'System Identification of Rhythmic Hybrid "
        "Dynamical Systems via Discrete Time Harmonic Transfer Functions', on their vertical "
        "hopper: figures, summary.json and results.npz, laid over the exact answer.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = reproduce.add_argument
    add("--out", required=True, metavar="DIR", help="folder for the results; made if needed")
    add("--family", choices=("isochron", "kinematic", "both"), default="both",
        help="Poincaré sections")  # fmt: skip
    add("--experiments", type=_count, default=80, metavar="S", help="number of experiments")
    add("--cycles", type=_count, default=84, metavar="C", help="cycles in each experiment")
    add("--keep", type=_count, default=64, metavar="P", help="last cycles used for estimation")
    add("--sections", type=_count, default=32, metavar="N", help="sections in each cycle")
    add("--amplitude", type=float, default=0.01, metavar="A", help="of each cosine, in N")
    add("--seed", type=int, default=0, help="of the random subsets and phases")
    add("--param", action="append", default=[], metavar="NAME=VALUE", type=_assignment,
        help="change a parameter of the hopper, e.g. M=1.8; may be repeated")  # fmt: skip
    add("--quick", action="store_true",
        help="a short form: 20 experiments of 36 cycles, the last 16 kept")  # fmt: skip
    reproduce.set_defaults(run=_reproduce)
    return parser


def _reproduce(options) -> None:
    # XLA reports, at the level of errors, that cached programs name CPU features of its own.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # The matrices are small: more BLAS threads than one only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from .reproduce import Protocol, reproduce

    sizes = (options.experiments, options.cycles, options.keep)
    if options.quick:
        sizes = (20, 36, 16)
    both = ("isochron", "kinematic")
    reproduce(
        options.out,
        Protocol(
            families=both if options.family == "both" else (options.family,),
            experiments=sizes[0],
            cycles=sizes[1],
            keep=sizes[2],
            sections=options.sections,
            amplitude=options.amplitude,
            seed=options.seed,
            parameters=dict(options.param),
        ),
    )


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not a positive whole number")
    return value


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number") from None
