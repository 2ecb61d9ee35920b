"""The command line. Nothing heavy is imported before the arguments are known to be good."""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Literal


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `hybridjax` command."""
    options = _parser().parse_args(arguments)
    from ..errors import HybridJaxError

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
    _add_identify(commands)
    return parser


def _add_identify(commands) -> None:
    identify = commands.add_parser(
        "identify",
        help="find the multipliers of a recorded rhythm",
        description="From recorded signals (CSV, NPZ or Parquet, a trial in each file) to Floquet "
        "multipliers, harmonic transfer functions and impulse responses, with a report.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = identify.add_argument
    add("files", nargs="+", metavar="FILE", help="one trial in each; the first line of a CSV file "
        "names its columns")  # fmt: skip
    add("--input", required=True, type=_names, metavar="NAMES", help="measured perturbations")
    add("--outputs", required=True, type=_names, metavar="NAMES", help="measured outputs")
    phase = identify.add_mutually_exclusive_group(required=True)
    phase.add_argument("--phase", type=_names, metavar="X,V",
        help="two signals whose angle about the center is the phase")  # fmt: skip
    phase.add_argument("--crossing", type=_crossing, metavar="X:DIRECTION[:VALUE]",
        help="a cycle begins where signal X crosses a value, rising or falling")  # fmt: skip
    phase.add_argument("--event", metavar="NAME", help="event at which a cycle begins")
    add("--center", type=_numbers, metavar="X,V", help="of the angle; estimated by default")
    add("--scale", type=_numbers, metavar="X,V", help="of the angle; estimated by default")
    add("--out", required=True, metavar="DIR", help="folder for the results; made if needed")
    add("--sections", type=_count, default=32, metavar="N", help="sections in each cycle")
    add("--order", type=_count, metavar="D", help="number of multipliers; found by default")
    add("--bandwidth", type=float, metavar="HZ", help="of the splines through the outputs; by "
        "default N per period")  # fmt: skip
    add("--time", default="time", metavar="NAME", help="column with the times")
    add("--timing", choices=("clock", "duration"), help="an extra output, from when "
        "sections are crossed: for systems with a clock, or without")  # fmt: skip
    add("--drift", type=float, metavar="CYCLES", help="remove changes of the cycle that take "
        "longer than this")  # fmt: skip
    identify.set_defaults(run=_identify)


def _identify(options) -> None:
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import pathlib

    import matplotlib

    matplotlib.use("Agg")  # files only
    from .._core.precision import enable_x64
    from ..errors import DefinitionError
    from ..recordings.identification import identify_recording
    from ..recordings.read import read_recording
    from ..sections.crossing import AtEvent, Crossing
    from ..sections.kinematic import KinematicPhase
    from .recording_report import check_folder, write_report

    enable_x64()
    check_folder(pathlib.Path(options.out))
    for name in ("phase", "center", "scale"):
        value = getattr(options, name)
        if value is not None and len(value) != 2:
            raise DefinitionError(f"--{name} needs two entries with a comma in between.")
    recording = read_recording(*options.files, time=options.time)
    print(recording)
    if options.phase is not None:
        position, velocity = options.phase
        phase = KinematicPhase(
            options.sections, position=position, velocity=velocity,
            center=options.center, scale=options.scale,
        )  # fmt: skip
    elif options.crossing is not None:
        signal, direction, value = options.crossing
        phase = Crossing(signal, direction, value=value)
    else:
        phase = AtEvent(options.event)
    found = identify_recording(
        recording, phase, inputs=options.input, outputs=options.outputs,
        n_sections=options.sections, order=options.order, bandwidth=options.bandwidth,
        timing=options.timing, drift=options.drift,
    )  # fmt: skip
    print(found)
    print(write_report(options.out, found))


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
            n_sections=options.sections,
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


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(x) for x in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers") from None


def _crossing(text: str) -> tuple[str, Literal["rising", "falling"], float]:
    signal, *more = text.split(":")
    direction, value = (*more, *("rising", "0")[len(more) :])[:2]
    try:
        if len(more) > 2 or direction not in ("rising", "falling"):
            raise ValueError
        return signal, direction, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a signal, a direction and a value, as in x:falling:0.2"
        ) from None


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE with a number") from None
