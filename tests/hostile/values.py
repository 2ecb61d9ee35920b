"""What nobody should pass, by what an argument takes."""

from typing import Any, NamedTuple

import jax
import numpy as np

import hybridjax as hj


class Right(NamedTuple):
    """A value that is accepted, beside others of its kind that are not."""

    value: Any


class Traced(NamedTuple):
    """The good argument inside of `jit`: it works, or it is refused in one sentence."""


class Other:
    """An object that no argument takes."""

    def __repr__(self):
        return "Other()"


TRACED = Traced()
NAN, INF = float("nan"), float("inf")
HUGE = 10**12

FLAG = [None, "yes", 2, NAN, Other()]
WORD = [None, "nonsense", "", 1, ["free"], Other()]
NUMBER = [None, "1", 1j, NAN, True, [1.0, 2.0], Other(), TRACED]
FINITE = [*NUMBER, INF, -INF]
POSITIVE = [*NUMBER, INF, 0.0, -1.0]
NONNEGATIVE = [*NUMBER, INF, -1.0]
SHARE = [*NUMBER, INF, 0.0, -0.5, 1.5]
WHOLE = [None, "8", 8.5, NAN, True, 1j, [8], Other(), -1, TRACED]
COUNT = [*WHOLE, 0]
LIMITED = [*COUNT, HUGE]
INTEGER = [None, "1", 0.5, NAN, True, [0], TRACED]
SEED = [None, "0", 0.5, NAN, -1, True, Other()]
NAME = [None, 3, 1.5, "nope", ["nope"], Other()]
NEW_NAME = [None, 3, 1.5, ["x"], Other()]
NAMES = [None, 3, (), ("x", "x"), "nope", ("nope",), (3, 4), Other()]
OUTPUTS = [*NAMES, {"x": 1}]
NEW_NAMES = [3, ("x", "x"), (3, 4), Other()]
CALLABLE = [None, 3, "f", NAN, Other()]
PATH = [None, 3, NAN, ["file"], Other()]
UNITS = [3, "N", ["N"], {"x": 3}, {3: "N"}, Other()]
EXECUTION = ["fast", 3, 2.0, hj.Guess("flow", (1.0, 0.0))]
LABELS = [3, "x", ["x"], {"x": 3}, Other()]
OUTPUT = ["nope", 7, -9, 0.5, NAN, ["y0"], Other()]
AXES = [3, "ax", Other(), [Other()]]
HARMONICS = ["0", 0.5, NAN, (), (0, 0), (0.5,), ("0",), HUGE, Other()]


def optional(kind: list) -> list:
    """The same where `None` is allowed."""
    return [value for value in kind if value is not None]


def instance(*wrong: Any) -> list:
    """For an argument that takes an object of this package; `wrong`: others of its objects."""
    return [None, "thing", 3, NAN, np.zeros(3), Other(), hj.Execution(), *wrong, TRACED]


def array(good: Any, *, missing: bool = False, free: bool = False, empty: bool = False) -> list:
    """For an argument that takes real numbers in the shape of `good`.

    `missing`: NaN is right, where a sample is missing. `empty`: nothing at all is right.
    `free`: it takes other shapes, too.
    """
    good = np.asarray(good, float)
    spoiled = good.copy()
    spoiled.flat[-1] = NAN
    infinite = good.copy()
    infinite.flat[0] = INF
    ragged = [[1.0, 2.0], [3.0]]
    kind = [None, "abc", ["a", "b"], {}, Other(), ragged, infinite, good + 1j, good != 0, TRACED]
    kind += [] if missing else [spoiled]
    kind += [] if empty or free else [np.zeros(0)]
    return kind if free else [*kind, good[None, None]]


def label(value: Any) -> str:
    """A short name of a value, the same in each run."""
    if isinstance(value, Right):
        return f"{label(value.value)} is right"
    if isinstance(value, Traced):
        return "traced"
    if isinstance(value, np.ndarray | jax.Array):
        flat = np.asarray(value).ravel()
        bad = "" if flat.dtype.kind not in "fc" or np.isfinite(flat).all() else ", not finite"
        return f"{flat.dtype}{list(value.shape)}{bad}"
    text = repr(value).splitlines()[0]
    if len(text) > 40 or "0x" in text:
        return type(value).__name__
    return text
