"""Hostile calls: each argument of each public function is replaced by what nobody should pass.

`python -m tests.hostile.run [--all]` prints as JSON, for each function, the calls that
neither return nor are refused by one sentence of this package that names what is wrong. It runs
without pytest, whose check of types would hide holes. Without `--all` an argument gets every 16th
of the values.
"""

import argparse
import inspect
import itertools
import json
import os
import pathlib
import re
import signal
import sys
import tempfile
import warnings

import equinox as eqx
import jax
import matplotlib
import numpy as np
from matplotlib import pyplot

import hybridjax as hj

from .calls import PARTS
from .things import Things


class Other:
    """An object that no argument takes."""

    def __repr__(self):
        return "Other()"


PACKAGE = str(pathlib.Path(hj.__file__).parent)
SECONDS = 5  # of computing, which no refusal takes
NAN = float("nan")
INF = float("inf")
HUGE = 10**12
TRACED = "the good argument, traced by JAX"
VALUES = [
    None,
    "missing/nope",
    "",
    ["x", "x"],
    3,
    -1,
    0,
    0.5,
    HUGE,
    NAN,
    INF,
    -INF,
    1j,
    True,
    [],
    (),
    {},
    {"x": NAN},
    {3: "x"},
    [[1.0, 2.0], [3.0]],
    np.zeros(3),
    np.zeros((2, 2, 2)),
    np.zeros((0, 2)),
    np.full((8, 2), NAN),
    np.array(["a"]),
    Other(),
    hj.scale.Execution(),
    lambda *_: "x",
    TRACED,
]
# What messages call an argument that they do not name.
CALLED = {
    "frequencies": "f =",
    "line": "f =",
    "frame": "column|signals",
}
# What compiles, or computes for seconds, where a value is right: a value must be wrong by its kind.
SLOW = {
    "LimitCycle.trajectory",
    "ObservedCycle.of",
    "ResponseFunction",
    "SectionMap",
    "continuation",
    "find_limit_cycle",
    "find_limit_cycles",
    "fit_model",
    "identifiability",
    "identify_recording",
    "linearize",
    "Design.optimize_phases",
    "place_sections",
    "response_function",
    "return_map",
    "run_experiments",
    "section_map",
    "simulate",
    "simulate_recording",
    "sweep",
    "monte_carlo",
    "Identification.write_report",
    "NaturalIdentification.write_report",
    "ObservedCycle.prepare",
    "ObservedCycle.residuals",
    "ObservedHTF.prepare",
    "ObservedHTF.residuals",
    "enable_compilation_cache",
}


class Hang(BaseException):
    """A call that should fail at once has not come back."""


def ring(*_):
    raise Hang


def name_of(function) -> str:
    """`Class`, `Class.method` or `function`."""
    owner = getattr(function, "__self__", None)
    if owner is None and not hasattr(function, "__qualname__"):
        return type(function).__name__  # an object that can be called
    if owner is not None and not isinstance(owner, type):
        return f"{type(owner).__name__}.{function.__name__}"
    return function.__qualname__


def kinds_of(function) -> dict:
    """The kinds by which the boundary checks the arguments, by name."""
    for place in (
        function,
        getattr(function, "__init__", None),
        type(function).__call__,
    ):
        if hasattr(place, "kinds"):
            return {
                k: v for k, v in place.kinds.by_name.items() if k not in ("self", "cls")
            }
    return {}


def attempt(function, good: dict, name: str, value) -> str:
    """What is wrong with a call in which one argument is replaced; "" if nothing is."""

    def call(given):
        return function(**(good | {name: given}))

    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of overflows, which huge numbers deserve
            if value is TRACED:
                arrays, rest = eqx.partition(traceable(good.get(name, 1)), eqx.is_array)
                jax.make_jaxpr(lambda given: (call(eqx.combine(given, rest)), 0)[1])(
                    arrays
                )
            else:
                call(value)
    except Hang:
        return "HANG"
    except hj.errors.HybridJaxError as error:
        return wrong_with(error, good, name, value)
    except Exception as error:
        if isinstance(error, IndexError) and function.__name__ == "__getitem__":
            return ""  # by which iteration ends
        text = f"FOREIGN: {type(error).__name__}: {error}"
        return text[:200]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        pyplot.close("all")
    return ""


def traceable(value):
    """Numbers as arrays, so that `jit` traces them."""
    numbers = value if isinstance(value, tuple | list) else [value]
    return (
        np.asarray(value) if all(isinstance(x, int | float) for x in numbers) else value
    )


def wrong_with(error: hj.errors.HybridJaxError, good: dict, name: str, value) -> str:
    """What is wrong with a refusal. It is one line of text, which names the argument, another with
    which it does not agree, or a part of the value, and is raised by this package. (Only a value
    that is wrong by its kind must be named.)"""
    text = str(error)
    last = error.__traceback__
    while last.tb_next is not None:
        last = last.tb_next
    if not last.tb_frame.f_code.co_filename.startswith(PACKAGE):
        return f"FRAME: {last.tb_frame.f_code.co_filename}"
    if "\n" in text or not text.endswith(".") or len(text) > 400:
        return f"TEXT: {text}"
    if value is TRACED and re.search("JAX|jit", text):
        return ""
    return "" if names(text, good, name, value) else f"UNNAMED {name}: {text}"


def names(text: str, good: dict, name: str, value) -> bool:
    """True if a text names an argument, another one, or its value or a part of it."""
    words = [name.removesuffix("s"), CALLED.get(name, name)]
    if isinstance(value, dict):
        words += map(str, value)
    for word in words:
        if re.search(rf"\b({word})", text, re.IGNORECASE):
            return True
    others = re.findall(r"`(\w+)", text)
    if set(good) & set(others):
        return True
    parts = re.findall(r"'(\w+)'", text)
    if any(part in repr(value) for part in parts):
        return True
    return repr(value) in text or str(value) in text


def refused_by(kind, value) -> bool:
    """Whether a value is wrong by its kind alone."""
    try:
        kind.take(value)
    except Exception:
        return True
    return False


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.hostile.run", description=__doc__
    )
    parser.add_argument(
        "--all", action="store_true", help="all values of all arguments"
    )
    options = parser.parse_args()
    hj.enable_x64()
    matplotlib.use("agg")
    signal.signal(signal.SIGPROF, ring)
    wrong = {}
    home = os.getcwd()
    things = Things()
    turn = 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for function, good in itertools.chain(*(part(things) for part in PARTS)):
            name = name_of(function)
            wrong.setdefault(name, [])
            for argument in named_arguments(function, good):
                values = VALUES if options.all else VALUES[turn % 16 :: 16]
                for shown in refusals_that_are_wrong(function, good, argument, values):
                    wrong[name].append(shown)
                    print(name, shown, file=sys.stderr, flush=True)
                turn += 1
        entries = pathlib.Path(folder).iterdir()
        left = sorted(path.name for path in entries)
        os.chdir(home)
    print(json.dumps({"calls": wrong, "files": left}, indent=1))


def named_arguments(function, good: dict) -> list[str]:
    """The arguments of a function, with the parameters of a system that a good call has among its
    keywords."""
    names = []
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            names.append(name)
        elif name == "parameters":
            names += [x for x in good if x not in names]
    return names


def refusals_that_are_wrong(function, good, argument, values):
    """Iterate over what is wrong with the refusals of some values of an argument."""
    kind = kinds_of(function).get(argument)
    if argument not in inspect.signature(function).parameters:
        kind = function.kinds.of_parameters
    is_slow = name_of(function) in SLOW
    for value in values:
        is_traced = value is TRACED
        alone = kind is not None and not is_traced and refused_by(kind, value)
        if is_slow and not (alone or is_traced):
            continue
        what = attempt(function, good, argument, value)
        if what and (alone or not what.startswith("UNNAMED")):
            yield f"{argument}={value!r}: {what}"


if __name__ == "__main__":
    main()
