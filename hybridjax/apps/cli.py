"""The command line `hybridjax`: options, and the sentences for those that are wrong.

`main` reads the options and calls the function of a command (`_reproduce`, `_identify`, `_sweep`).
Nothing heavy is imported before the arguments are known to be good, so imports stand inside of
these functions, and must stay there. An option is added in the `_add_...` of its command, with a
converter made by `_option`, which also has the words of its error; one of `identify` is used in
`steps_of` of `identify.py`. If a good option is refused,
look at its converter. Options that contradict each other are refused in `_identify` and
`_require_signals`. If an error is printed with its traceback, it is no `HybridJaxError`, the only
kind of which `main` makes a sentence.
"""

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, get_args

from .. import __version__
from .._core import limits
from .._core.writing import Format


def _between(convert: Callable[[str], Any], low: Any, high: Any = math.inf) -> Callable:
    """A function that converts a text to a number between two bounds."""

    def number(text: str) -> Any:
        value = convert(text)
        if not low <= value <= high:  # NaN included
            raise ValueError
        return value

    return number


def _different(text: str) -> tuple[str, ...]:
    """Different names with commas in between."""
    names = tuple(name.strip() for name in text.split(","))
    if "" in names or len(set(names)) < len(names):
        raise ValueError
    return names


def _option(
    kind: str, pattern: str, *convert: Callable[[str], Any]
) -> Callable[[str], Any]:
    """A function that converts the groups of a regular expression in the text of an option, and
    refuses a text that is no `kind`. The result of a single group is no tuple."""

    def option(text: str) -> Any:
        match = re.fullmatch(pattern, text)
        try:
            groups = () if match is None else match.groups()
            first, *more = (f(group) for f, group in zip(convert, groups, strict=True))
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {kind}") from None
        return (first, *more) if more else first

    return option


_COUNT = _between(int, 1, limits.PERIODS)
_FINITE = _between(float, -sys.float_info.max, sys.float_info.max)
_POSITIVE = _between(float, math.ulp(0.0), sys.float_info.max)
_place = _option("a name", "(.+)", str)
_count = _option(f"a whole number from 1 to {limits.PERIODS}", "(.*)", _COUNT)
_seed = _option("a whole number from 0 on", "(.*)", _between(int, 0))
_positive = _option("a positive number", "(.*)", _POSITIVE)
_CYCLES = _between(float, 4, sys.float_info.max)
_cycles = _option("a number of cycles, four or more", "(.*)", _CYCLES)
_names = _option("a list of different names", "(.*)", _different)
_two_names = _option("two names with a comma in between", "([^,]*,[^,]*)", _different)
_two_numbers = _option("two numbers as in 1.5,0", "([^,]*),([^,]*)", _FINITE, _FINITE)
_two_positive = _option(
    "two positive numbers as in 1.5,2", "([^,]*),([^,]*)", _POSITIVE, _POSITIVE
)
_model = _option("FILE.py:NAME", r"(.*\.py):([^\W\d]\w*)", str, str)
_axis = _option(
    "NAME=LOW:HIGH:COUNT", "([^=]+)=(.*):(.*):(.*)", str, _FINITE, _FINITE, _COUNT
)
_crossing = _option(
    "a signal, a direction and a value, as in x:falling:0.2",
    r"\s*([^:]*[^:\s])\s*(?::\s*(rising|falling)\s*(?::(.*))?)?",
    str,
    lambda direction: direction or "rising",
    lambda value: _FINITE(value or "0"),
)
_format = "|".join(get_args(Format))
_formats = _option(
    f"one or more of {', '.join(get_args(Format))}",
    f"((?:{_format})(?:, *(?:{_format}))*)",
    _different,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `hybridjax` command.

    **Returns:** the exit status: 0, or 1 if results were written that a fit has not converged to.
    Otherwise nothing is written, and it exits with a sentence: with 1 where something failed, 2 for
    options that are wrong or contradict each other, 130 where it was interrupted.
    """
    parser = argparse.ArgumentParser(
        prog="hybridjax",
        description="Identify the dynamics of rhythmic hybrid systems.",
    )
    parser.add_argument(
        "--version", action="version", version=f"hybridjax {__version__}"
    )
    commands = parser.add_subparsers(metavar="COMMAND")
    _add_reproduce(commands)
    _add_identify(commands)
    _add_sweep(commands)
    options, more = parser.parse_known_args(arguments)
    if not hasattr(options, "run"):
        parser.print_help(sys.stderr)
        parser.exit(2, "\nhybridjax: error: name one of the commands\n")
    if more:
        options.parser.error(
            f"unrecognized arguments: {' '.join(more)} (names need commas)"
        )
    # XLA reports, as errors, that cached programs name CPU features of its own; and for small
    # matrices more BLAS threads than one only wait for each other.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ..errors import HybridJaxError

    try:
        return options.run(options)
    except HybridJaxError as error:
        sys.exit(f"hybridjax: {error}")
    except KeyboardInterrupt:
        print("hybridjax: interrupted.", file=sys.stderr)
        sys.exit(130)


def _add_reproduce(commands) -> None:
    reproduce = commands.add_parser(
        "reproduce",
        help="reproduce Ankarali & Cowan's paper on the vertical hopper",
        description="Reproduce Ankarali & Cowan, 'System Identification of Rhythmic Hybrid "
        "Dynamical Systems via Discrete Time Harmonic Transfer Functions', on their vertical "
        "hopper: figures, numbers, and models for hj.load, laid over the exact answer.",
    )
    add = reproduce.add_argument
    add(
        "--seed",
        type=_seed,
        default=0,
        help="of random subsets and phases (default: %(default)s)",
    )
    add(
        "--quick",
        action="store_true",
        help="a short form: 20 experiments of 36 cycles, of which "
        "16 are used, in place of 80 experiments of 84, of which 64 are used",
    )
    _add_results(reproduce)
    reproduce.set_defaults(run=_reproduce, parser=reproduce)


def _add_results(command) -> None:
    command.add_argument(
        "--out",
        required=True,
        type=_place,
        metavar="DIR",
        help="folder for the results; made if needed",
    )
    command.add_argument(
        "--formats",
        type=_formats,
        default=("png",),
        metavar="NAMES",
        help="of the figures: png, pdf, svg, or several with commas (default: png)",
    )


def _add_identify(commands) -> None:
    identify = commands.add_parser(
        "identify",
        help="find the multipliers of a recorded rhythm",
        description="From recorded signals, a trial in each file, to Floquet "
        "multipliers, harmonic transfer functions and impulse responses, with a report. Without "
        "inputs, to multipliers from variability.",
    )
    _add_signals(identify.add_argument)
    _add_phase(identify)
    _add_estimate(identify.add_argument)
    _add_results(identify)
    identify.set_defaults(run=_identify, parser=identify)


def _add_signals(add: Callable[..., Any]) -> None:
    """Add the options about files and signals."""
    add(
        "files",
        nargs="*",
        metavar="FILE",
        help="one trial in each: CSV, Excel, Parquet, MATLAB, "
        "HDF5, C3D, OpenSim, ROS and more",
    )
    add(
        "--table",
        type=_place,
        metavar="TABLE.csv",
        help="in place of files: a table of a study, "
        "with the columns file and subject, and condition, group, age, ...; a report for each "
        "subject and one for all; a later call goes on",
    )
    add(
        "--workers",
        type=_count,
        default=1,
        metavar="N",
        help="processes for the subjects of --table (default: %(default)s)",
    )
    add(
        "--inputs",
        default=(),
        type=_names,
        metavar="NAMES",
        help="measured perturbations; by default none: multipliers from variability",
    )
    add(
        "--references",
        type=_names,
        default=(),
        metavar="NAMES",
        help="signals that act from "
        "outside on a loop, if a controller makes the inputs",
    )
    add(
        "--outputs",
        default=(),
        type=_names,
        metavar="NAMES",
        help="measured outputs; by default the durations between the events of --event",
    )


def _add_phase(identify) -> None:
    """Add the options about the phase of the cycle."""
    phase = identify.add_mutually_exclusive_group(required=True)
    phase.add_argument(
        "--phase",
        type=_two_names,
        metavar="X,V",
        help="two signals whose angle about the center is the phase",
    )
    phase.add_argument(
        "--crossing",
        type=_crossing,
        metavar="X:DIRECTION[:VALUE]",
        help="a cycle begins where signal X crosses a value, rising or falling",
    )
    phase.add_argument("--event", metavar="NAME", help="event at which a cycle begins")
    for name, kind in {"--center": _two_numbers, "--scale": _two_positive}.items():
        identify.add_argument(
            name,
            type=kind,
            metavar="X,V",
            help="of the angle of --phase; estimated by default",
        )


def _add_estimate(add: Callable[..., Any]) -> None:
    """Add the options about sections, sampling and the fit."""
    add(
        "--sections",
        type=_count,
        default=32,
        metavar="N",
        help="sections in each cycle (default: %(default)s)",
    )
    add(
        "--order",
        type=_count,
        metavar="D",
        help="number of multipliers; found by default",
    )
    add(
        "--bandwidth",
        type=_positive,
        metavar="HZ",
        help="of the splines through the outputs; by default N per period",
    )
    add(
        "--time",
        default="time",
        metavar="NAME",
        help="column of times (default: %(default)s)",
    )
    add(
        "--timing",
        choices=("clock", "duration"),
        help="an extra output, from when "
        "sections are crossed: for systems with a clock, or without",
    )
    add(
        "--drift",
        type=_cycles,
        metavar="CYCLES",
        help="remove changes of the cycle that take longer than this",
    )


def _add_sweep(commands) -> None:
    sweep = commands.add_parser(
        "sweep",
        help="map the limit cycles of a system over its parameters",
        description="Limit cycles at all combinations of some parameters' values, into a Zarr "
        "store, which a later call goes on with, and pictures beside it.",
    )
    add = sweep.add_argument
    add(
        "model",
        type=_model,
        metavar="FILE.py:NAME",
        help="a system, its class, or a function of parameters that gives one",
    )
    add(
        "--values",
        required=True,
        action="append",
        type=_axis,
        metavar="NAME=LOW:HIGH:COUNT",
        help="values of a parameter, evenly spaced; may be repeated",
    )
    add(
        "--quantities",
        type=_names,
        default=("spectral_radius", "period"),
        metavar="NAMES",
        help="period, state, multipliers, spectral_radius, residual; with commas "
        "(default: spectral_radius,period)",
    )
    add(
        "--out",
        required=True,
        type=_place,
        metavar="STORE",
        help="the Zarr store, e.g. map.zarr",
    )
    sweep.set_defaults(run=_sweep, parser=sweep)


def _begin(*, cache: bool) -> None:
    """Set up the process: figures go to files only, and results are in double precision."""
    import matplotlib

    matplotlib.use("Agg")
    from .._core.cache import enable_compilation_cache
    from .._core.precision import enable_x64

    enable_x64()
    if cache:
        enable_compilation_cache()


def _sweep(options) -> int:
    _begin(cache=True)
    from .sweep import run

    return run(options)


def _identify(options) -> int:
    _require_signals(options)
    if bool(options.files) == bool(options.table):
        options.parser.error("give either files of one subject or --table TABLE.csv")
    if not (options.outputs or options.event or options.timing):
        options.parser.error(
            "name --outputs, or choose --timing, which makes times an output"
        )
    _begin(cache=False)
    if options.table:
        from .subjects import run as run_table

        return run_table(options)
    from .identify import run

    return _status(run(options))


def _require_signals(options) -> None:
    """End with an error for names of signals that do not agree."""
    if options.phase is None and (options.center or options.scale):
        options.parser.error(
            "--center and --scale are of the angle of --phase, which is not given"
        )
    named = [*options.inputs, *options.references, *options.outputs]
    twice = ", ".join(x for x in dict.fromkeys(named) if named.count(x) > 1)
    if twice:
        options.parser.error(
            f"{twice}: name it once (omit --references without a controller)"
        )
    of_phase = options.phase
    if not of_phase:
        of_phase = (options.crossing or ())[:1]
    beside = {*options.inputs} & {*of_phase}
    if beside:
        options.parser.error(
            f"{', '.join(beside)} is an input: define the phase by another signal"
        )
    if options.references and not options.inputs:
        options.parser.error(
            "--references act on a controller that makes the inputs: name --inputs, too"
        )


def _reproduce(options) -> int:
    _begin(cache=True)
    from .reproduce import Protocol, reproduce

    sizes = (20, 36, 16) if options.quick else (80, 84, 64)
    summary = reproduce(options.out, Protocol(*sizes, options.seed), options.formats)
    return _status(all(family["converged"] for family in summary["families"].values()))


def _status(converged: bool) -> int:
    if not converged:
        print(
            "hybridjax: a fit did not converge: do not rely on its numbers, which were written.",
            file=sys.stderr,
        )
    return 0 if converged else 1
