"""The command line. Nothing heavy is imported before the arguments are known to be good."""

import _thread
import argparse
import contextlib
import os
import sys
import threading
from collections.abc import Iterator, Sequence

from .. import __version__
from .option_types import (
    assignment,
    axis,
    count,
    crossing,
    formats,
    model,
    names,
    positive,
    seed,
    two_names,
    two_numbers,
    two_sizes,
)


# Sizes of the paper's protocol, and of its short form.
_SIZES = {
    "experiments": ("S", "number of experiments", 80, 20),
    "cycles": ("C", "cycles in each experiment", 84, 36),
    "keep": ("P", "last cycles used for estimation", 64, 16),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `hybridjax` command.

    **Returns:** the exit status: 0, or 1 if results were written that a fit has not converged to.
    Otherwise nothing is written, and it exits with a sentence: with 1 where something failed, 2 for
    options that are wrong or contradict each other, 130 where it was interrupted.
    """
    options = _parser().parse_args(arguments)
    from ..errors import HybridJaxError

    try:
        with _interruptible():
            return options.run(options)
    except HybridJaxError as error:
        sys.exit(f"hybridjax: {error}")
    except KeyboardInterrupt:
        print("hybridjax: interrupted.", file=sys.stderr)
        sys.exit(130)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """An interruption that Python ignores, since it came in a callback (as JAX has one in the
    collector of garbage), comes again."""
    usual = sys.unraisablehook

    def hook(unraisable):
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            threading.Timer(0.1, _thread.interrupt_main).start()  # when the callback is over
        else:
            usual(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hybridjax",
        description="Identify the dynamics of rhythmic hybrid systems.",
    )
    parser.add_argument("--version", action="version", version=f"hybridjax {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_reproduce(commands)
    _add_identify(commands)
    _add_sweep(commands)
    return parser


def _add_reproduce(commands) -> None:
    reproduce = commands.add_parser(
        "reproduce",
        help="reproduce Ankarali & Cowan's paper on the vertical hopper",
        description="Reproduce Ankarali & Cowan, 'System Identification of Rhythmic Hybrid "
        "Dynamical Systems via Discrete Time Harmonic Transfer Functions', on their vertical "
        "hopper: figures, summary.json and results.npz, laid over the exact answer.",
    )
    add = reproduce.add_argument
    add("--out", required=True, metavar="DIR", help="folder for the results; made if needed")
    add("--family", choices=("isochron", "kinematic", "both"), default="both",
        help="Poincaré sections (default: %(default)s)")  # fmt: skip
    for name, (metavar, what, paper, quick) in _SIZES.items():
        add(f"--{name}", type=count, metavar=metavar,
            help=f"{what} (default: {paper}; {quick} with --quick)")  # fmt: skip
    add("--sections", type=count, default=32, metavar="N",
        help="sections in each cycle (default: %(default)s)")  # fmt: skip
    add("--amplitude", type=positive, default=0.01, metavar="A",
        help="of each cosine, in N (default: %(default)s)")  # fmt: skip
    add("--seed", type=seed, default=0,
        help="of the random subsets and phases (default: %(default)s)")  # fmt: skip
    add("--param", action="append", default=[], metavar="NAME=VALUE", type=assignment,
        help="change a parameter of the hopper, e.g. M=1.8; may be repeated")  # fmt: skip
    add("--quick", action="store_true", help="a short form, with other defaults")
    _add_formats(reproduce)
    reproduce.set_defaults(run=_reproduce, parser=reproduce)


def _add_formats(command) -> None:
    command.add_argument("--formats", type=formats, default=("png",), metavar="NAMES",
        help="of the figures: png, pdf, svg, or several with commas (default: png)")  # fmt: skip


def _add_identify(commands) -> None:
    identify = commands.add_parser(
        "identify",
        help="find the multipliers of a recorded rhythm",
        description="From recorded signals (CSV, NPZ or Parquet, a trial in each file) to Floquet "
        "multipliers, harmonic transfer functions and impulse responses, with a report.",
    )
    add = identify.add_argument
    add("files", nargs="+", metavar="FILE", help="one trial in each: CSV, Excel, Parquet, MATLAB, "
        "HDF5, C3D, OpenSim, ROS and more")  # fmt: skip
    add("--input", required=True, type=names, metavar="NAMES", help="measured perturbations")
    add("--outputs", required=True, type=names, metavar="NAMES", help="measured outputs")
    phase = identify.add_mutually_exclusive_group(required=True)
    phase.add_argument("--phase", type=two_names, metavar="X,V",
        help="two signals whose angle about the center is the phase")  # fmt: skip
    phase.add_argument("--crossing", type=crossing, metavar="X:DIRECTION[:VALUE]",
        help="a cycle begins where signal X crosses a value, rising or falling")  # fmt: skip
    phase.add_argument("--event", metavar="NAME", help="event at which a cycle begins")
    add("--center", type=two_numbers, metavar="X,V",
        help="of the angle of --phase; estimated by default")  # fmt: skip
    add("--scale", type=two_sizes, metavar="X,V",
        help="of the angle of --phase; estimated by default")  # fmt: skip
    add("--out", required=True, metavar="DIR", help="folder for the results; made if needed")
    add("--sections", type=count, default=32, metavar="N",
        help="sections in each cycle (default: %(default)s)")  # fmt: skip
    add("--order", type=count, metavar="D", help="number of multipliers; found by default")
    add("--bandwidth", type=positive, metavar="HZ", help="of the splines through the outputs; by "
        "default N per period")  # fmt: skip
    add("--time", default="time", metavar="NAME",
        help="column with the times (default: %(default)s)")  # fmt: skip
    add("--timing", choices=("clock", "duration"), help="an extra output, from when "
        "sections are crossed: for systems with a clock, or without")  # fmt: skip
    add("--drift", type=positive, metavar="CYCLES", help="remove changes of the cycle that take "
        "longer than this")  # fmt: skip
    _add_formats(identify)
    identify.set_defaults(run=_identify, parser=identify)


def _add_sweep(commands) -> None:
    sweep = commands.add_parser(
        "sweep",
        help="map the limit cycles of a system over its parameters",
        description="Limit cycles at all combinations of some parameters' values, into a Zarr "
        "store, which a later call goes on with, and pictures beside it.",
    )
    add = sweep.add_argument
    add("model", type=model, metavar="FILE.py:NAME",
        help="a system, its class, or a function of parameters that gives one")  # fmt: skip
    add("--over", required=True, action="append", type=axis, metavar="NAME=LOW:HIGH:COUNT",
        help="values of a parameter, evenly spaced; may be repeated")  # fmt: skip
    add("--want", type=names, default=("spectral_radius", "period"), metavar="NAMES",
        help="period, state, multipliers, spectral_radius, events, residual; with "
        "commas (default: spectral_radius,period)")  # fmt: skip
    add("--out", required=True, metavar="STORE", help="the Zarr store, e.g. map.zarr")
    add("--scheduler", metavar="ADDRESS", help="of a Dask cluster that does the work")
    add("--force", action="store_true", help="also more than 50 million points")
    sweep.set_defaults(run=_sweep, parser=sweep)


def _sweep(options) -> int:
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import matplotlib

    matplotlib.use("Agg")  # files only
    from .._core.compilation.compilation_cache import enable_compilation_cache
    from .._core.precision import enable_x64
    from .map_command import run

    enable_x64()
    enable_compilation_cache()
    found, pictures = run(
        options.model, options.over, options.want, options.out, options.scheduler, options.force
    )
    print(found)
    count = int((found.result == 0).sum())
    print(f"{count} of {found.result.size} points have a limit cycle")
    print("\n".join(pictures))
    return 0


def _identify(options) -> int:
    if options.phase is None and (options.center or options.scale):
        options.parser.error("--center and --scale are of the angle of --phase, which is not given")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import matplotlib

    matplotlib.use("Agg")  # files only
    from .._core.precision import enable_x64
    from .._core.results import Result
    from ..orbits.crossing import AtEvent, Crossing
    from ..recordings.identification import identify_recording
    from ..recordings.read import read_recording
    from ..sections.families import KinematicPhase
    from .recording_report import PAGE, report_folder, write_results

    enable_x64()
    with report_folder(options.out, options.input, options.formats) as folder:
        named = (*options.input, *options.outputs, *(options.phase or (options.crossing or ())[:1]))
        signals = tuple(dict.fromkeys(named))
        recording = read_recording(*options.files, time=options.time, signals=signals)
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
        write_results(folder, found, options.formats)
    print(os.path.join(options.out, PAGE))
    return _status(found.fit.result == Result.OK)


def _reproduce(options) -> int:
    changed = [name for name, _ in options.param]
    if len(set(changed)) < len(changed):
        options.parser.error("--param gives a parameter twice")
    # XLA reports, at the level of errors, that cached programs name CPU features of its own.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # The matrices are small: more BLAS threads than one only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from .helper import Helper

    helper = Helper("hybridjax.apps.reproduce", "hybridjax.apps.paper_figures")
    from .reproduce import Protocol, reproduce

    sizes = {
        name: getattr(options, name) or (quick if options.quick else paper)
        for name, (_, _, paper, quick) in _SIZES.items()
    }
    both = ("isochron", "kinematic")
    summary = reproduce(
        options.out,
        Protocol(
            families=both if options.family == "both" else (options.family,),
            n_sections=options.sections,
            amplitude=options.amplitude,
            seed=options.seed,
            parameters=dict(options.param),
            **sizes,
        ),
        options.formats,
        helper,
    )
    return _status(all(family["converged"] for family in summary["families"].values()))


def _status(converged: bool) -> int:
    if not converged:
        print(
            "hybridjax: a fit did not converge: do not rely on its numbers, which were written.",
            file=sys.stderr,
        )
    return 0 if converged else 1
