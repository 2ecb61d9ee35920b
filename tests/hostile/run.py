"""Every hostile call of the table, without pytest's check of types, which would hide holes:
`python -m tests.hostile.run` prints {call: what is wrong with what came of it} as JSON."""

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

from . import about_data, about_models, about_plots, about_rhythms
from .things import Things
from .values import Right, Traced, label


PACKAGE = str(pathlib.Path(hj.__file__).parent)
SECONDS = 5  # of computing, which no refusal takes
# What messages call an argument that they do not name.
CALLED = {
    "frequencies": "f =", "line": "f =", "channel": "input", "frame": "column|signals",
    "definition": "phase",
}  # fmt: skip


class Hang(BaseException):
    """A call that should fail at once has not come back."""


def ring(*_):
    raise Hang


def attempt(function, good: dict, name: str, value) -> str:
    """What is wrong with a call in which one argument is replaced; "" if nothing is."""
    right = isinstance(value, Right)
    value = value.value if right else value

    def call(given):
        return function(**(good | {name: given}))

    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            if isinstance(value, Traced):
                arrays, rest = eqx.partition(traceable(good.get(name, 1)), eqx.is_array)
                jax.make_jaxpr(lambda given: (call(eqx.combine(given, rest)), 0)[1])(arrays)
            else:
                call(value)
    except Hang:
        return "HANG"
    except hj.HybridJaxError as error:
        return f"REFUSED: {error}" if right else told(error, good, name, value)
    except Exception as error:
        return f"FOREIGN: {type(error).__name__}: {error}"[:200]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return "" if right or isinstance(value, Traced) else "ACCEPTED"


def traceable(value):
    """Numbers as arrays, so that `jit` traces them."""
    numbers = value if isinstance(value, tuple | list) else [value]
    return np.asarray(value) if all(isinstance(x, int | float) for x in numbers) else value


def told(error: hj.HybridJaxError, good: dict, name: str, value) -> str:
    """What is wrong with a refusal: it is text on one line, which names the argument, another that
    it does not go with, or what is wrong in it (tracing concerns the whole call), and is raised by
    this package."""
    text, last = str(error), error.__traceback__
    while last.tb_next is not None:
        last = last.tb_next
    if not last.tb_frame.f_code.co_filename.startswith(PACKAGE):
        return f"FRAME: {last.tb_frame.f_code.co_filename}"
    if "\n" in text or not text.endswith(".") or len(text) > 400:
        return f"TEXT: {text}"
    if isinstance(value, Traced) and re.search("JAX|jit", text):
        return ""
    quoted = re.findall(r"'(\w+)'", text)
    keys = map(str, value) if isinstance(value, dict) else ()
    words = [name.removesuffix("s"), CALLED.get(name, name), *keys]
    named = any(re.search(rf"\b({word})", text, re.IGNORECASE) for word in words)
    named = named or set(good) & set(re.findall(r"`(\w+)", text))
    named = named or any(word in repr(value) for word in quoted)
    named = named or (isinstance(value, str) and value != "" and value in text)
    return "" if named or repr(value) in text else f"UNNAMED {name}: {text}"


def rows(things: Things, only: list[str]):
    """Name, function, good arguments, argument and its value of each call."""
    for about in (about_models, about_data, about_plots, about_rhythms):
        for name, function, good, arguments in about.calls(things):
            for argument, values in arguments.items():
                for value in values if not only or name in only else ():
                    yield name, function, good, argument, value


def main() -> None:
    hj.enable_x64()
    matplotlib.use("agg")
    signal.signal(signal.SIGPROF, ring)
    found, home = {}, os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for name, function, good, argument, value in rows(Things(), sys.argv[1:]):
            wrong = attempt(function, good, argument, value)
            key = f"{name}({argument}={label(value)})"
            found[key] = found.get(key) or wrong
            pyplot.close("all")
            if wrong:
                print(f"{key}: {wrong}", file=sys.stderr, flush=True)
        left = sorted(path.name for path in pathlib.Path(folder).iterdir())
        os.chdir(home)
    print(json.dumps({"calls": found, "files": left}, indent=1))


if __name__ == "__main__":
    main()
