"""Random arguments for public functions, drawn from their annotations: each call returns or is
refused, and never ends in another error. `python -m tests.hostile.fuzz --examples 100` prints the
calls that do, as {function: [arguments, error]} in JSON; they become rows of the table."""

import argparse
import functools as ft
import json
import os
import signal
import sys
import tempfile
import warnings

import hypothesis
import matplotlib
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib import pyplot

import hybridjax as hj
from hybridjax._core.boundary import containers, values as kinds

from . import about_data, about_models, about_plots, about_rhythms
from .run import Hang, ring
from .things import Things
from .values import Other, label


SECONDS = 20  # of computing, for one call
# What compiles, or computes for seconds, where its arguments are right.
SLOW = {
    "LimitCycle.trajectory", "ObservedCycle.of", "ResponseFunction", "SectionMap", "continuation",
    "find_limit_cycle", "find_limit_cycles", "fit_model", "identifiability", "identify_recording",
    "linearize", "place_sections", "response_function", "run_experiments", "section_map",
    "simulate", "simulate_recording", "steady_start", "stream_experiments",
    "sweep", "monte_carlo",
    "write_report", "ObservedCycle.prepare", "ObservedCycle.residuals", "ObservedHTF.prepare",
    "ObservedHTF.residuals", "fit_rational", "enable_vector_math", "enable_compilation_cache",
}  # fmt: skip
WORDS = st.sampled_from(["x", "y", "u", "f", "y0", "nope", ""])
NUMBERS = st.floats(-3, 30) | st.sampled_from([0.0, 1e-300, 1e300, -1.0])
JUNK = st.sampled_from([None, "1", 1j, float("nan"), float("inf"), True, [], {}, Other()])


@ft.singledispatch
def allowed(kind, good) -> st.SearchStrategy:
    """Values of a kind, or nearly so. (Objects, functions and the like: the good one.)"""
    return st.just(good)


@allowed.register
def _(kind: kinds.Whole, good):
    return st.integers(-2, 40) | st.sampled_from([good, 10**12])


@allowed.register
def _(kind: kinds.Number, good):
    return NUMBERS


@allowed.register
def _(kind: kinds.OneOf, good):
    return st.sampled_from([*kind.words, "nope"])


@allowed.register
def _(kind: kinds.Switch, good):
    return st.booleans()


@allowed.register
def _(kind: kinds.Text, good):
    return WORDS


@allowed.register
def _(kind: kinds.Nothing, good):
    return st.none()


@allowed.register
def _(kind: containers.Names, good):
    return WORDS | st.lists(WORDS, max_size=3)


@allowed.register
def _(kind: containers.Either, good):
    return st.one_of([allowed(one, good) for one in kind.kinds])


@allowed.register
def _(kind: containers.Items, good):
    return st.just(good) | st.lists(allowed(kind.item, good), max_size=3)


@allowed.register
def _(kind: containers.Tuple, good):
    return st.tuples(*(allowed(one, good) for one in kind.kinds))


@allowed.register
def _(kind: containers.Table, good):
    return st.just(good) | st.dictionaries(WORDS, allowed(kind.value, good), max_size=2)


@allowed.register
def _(kind: kinds.Reals, good):
    """Of some shape, and the good values with one of them replaced, or cut."""
    axes = len(kind.shape) if "..." not in kind.shape else 2
    shape = st.tuples(*(st.integers(0, 4) for _ in range(axes)))
    drawn = arrays(float, shape, elements=NUMBERS)
    if good is None or np.size(good) == 0 or np.ndim(good) == 0:
        return drawn
    return drawn | st.builds(_changed, st.just(np.asarray(good)), st.integers(0, 99), NUMBERS)


def _changed(good, where, number):
    if where % 3 == 0:
        return good[: where % (len(good) + 1)]
    out = np.array(good, np.result_type(good, float))
    out.flat[where % out.size] = number
    return out


def checker(function):
    """What checks the arguments of a function, or of a class."""
    return getattr(function.__init__ if isinstance(function, type) else function, "kinds", None)


def fuzz(function, good: dict, examples: int) -> list[str]:
    """The smallest call found that ends in an error of another kind; empty if there is none."""
    kinds = {
        name: kind
        for name, kind in checker(function).by_name.items()
        if name not in ("self", "cls")
    }
    changes = {
        name: (st.none() if kind is None else allowed(kind, good.get(name))) | JUNK
        for name, kind in kinds.items()
    }
    drawn = st.lists(st.sampled_from(sorted(changes)), min_size=1, max_size=3, unique=True)
    drawn = drawn.flatmap(
        lambda some: st.fixed_dictionaries({name: changes[name] for name in some})
    )
    found, refusals = [], (hj.HybridJaxError,)
    if function.__name__ == "__getitem__":  # iteration ends by it
        refusals += (IndexError,)

    @hypothesis.settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @hypothesis.given(
        drawn.flatmap(lambda some: st.fixed_dictionaries({k: changes[k] for k in some}))
    )
    def attempt(given):
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # (of overflows, which huge numbers deserve)
                function(**(good | given))
        except refusals:
            pass
        except (Exception, Hang) as error:
            shown = ", ".join(f"{name}={label(value)}" for name, value in given.items())
            found[:] = [shown, f"{type(error).__name__}: {error}"[:200]]
            raise
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            pyplot.close("all")

    try:
        attempt()
    except BaseException:  # noqa: B036  (hypothesis groups and flags what was raised)
        if not found:
            raise
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.hostile.fuzz", description=__doc__)
    parser.add_argument("--examples", type=int, default=100, help="for each function")
    parser.add_argument("names", nargs="*", help="functions; by default all that are fast")
    arguments = parser.parse_args()
    hj.enable_x64()
    matplotlib.use("agg")
    signal.signal(signal.SIGPROF, ring)
    found, home, things = {}, os.getcwd(), Things()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for about in (about_models, about_data, about_plots, about_rhythms):
            for name, function, good, _ in about.calls(things):
                wanted = name in arguments.names if arguments.names else name not in SLOW
                if wanted and checker(function):
                    print(name, file=sys.stderr, flush=True)
                    if wrong := fuzz(function, good, arguments.examples):
                        found[name] = wrong
        os.chdir(home)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
