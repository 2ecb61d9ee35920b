"""Numbers, indices and names as users give them, checked beyond their types; and whether two
objects belong to the same system.

Called by public functions whose arguments depend on each other (an index and a count, names and the
system that has them). Each function raises the sentence that a user reads. If a name is not
suggested, look at `spelling.py`. Types of single arguments are checked earlier, in `boundary/`.

Names by default (`_LETTERS`) must stay, since users' scripts and files have them. If the message
about a library that is missing names a wrong extra, add a line to `_EXTRAS`.
"""

import importlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .exceptions import ComputationError, DefinitionError
from .spelling import slip_of


if TYPE_CHECKING:
    Numbers: TypeAlias = Any  # users give what becomes an array, functions get an array
else:
    Numbers = npt.ArrayLike | Sequence | int | float
    """What becomes an array: arrays, numbers, sequences of them. (numpy's `ArrayLike` leaves `int`
    and `float` to the promotion of static type checkers, which checks at run time do not know.)"""


_LETTERS = {"inputs": "u", "outputs": "y", "references": "r"}


def names(kind: str, given: Collection[str] | None, count: int) -> tuple[str, ...]:
    """`count` names, with units where these are given; by default `u`, `y` or `r` for one, and
    `u0, u1, ...` for several.

    **Raises:** `DefinitionError` if `given` has another length.
    """
    if given is None:
        letter = _LETTERS[kind]
        if count == 1:
            return (letter,)
        return tuple(f"{letter}{i}" for i in range(count))
    if len(given) != count:
        raise DefinitionError(
            f"{count} {kind} need {count} names, but `{kind}` is {given}."
        )
    return tuple(given)


def input_and_output_names(
    inputs: Collection[str] | None,
    outputs: Collection[str] | None,
    nu: int,
    ny: int,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """`names` of nu inputs and of ny outputs.

    **Raises:** `DefinitionError` in the cases of `names`, and for an output that is an input.
    """
    u = names("inputs", inputs, nu)
    y = names("outputs", outputs, ny)
    require_apart(u, y)
    return u, y


def require_apart(inputs: Collection[str], outputs: Collection[str]) -> None:
    """**Raises:** `DefinitionError` for an output that is an input."""
    shared = [name for name in outputs if name in inputs]
    if shared:
        raise DefinitionError(
            f"'{shared[0]}' is in `inputs` and in `outputs`: name it in one."
        )


def require_same(
    what: str,
    a: Any,
    b: Any,
    fields: Iterable[str] = ("n_sections", "inputs", "outputs"),
) -> None:
    """**Raises:** `DefinitionError` if two things ("model and data") differ in a field."""
    for name in fields:
        require_equal(what, name, getattr(a, name), getattr(b, name))


def require_equal(what: str, name: str, x: Any, y: Any) -> None:
    """**Raises:** `DefinitionError` if numbers or names of two things ("model and data") differ."""
    if x != y:
        raise DefinitionError(
            f"{what} have different {name}: {x} and {y}; they must be the same."
        )


def require_index(kind: str, index: int, count: int) -> None:
    """**Raises:** `DefinitionError` for an index of a kind of which there are only `count`."""
    if not -count <= index < count:
        raise DefinitionError(
            f"there is no {kind} {index}: there are {count}, counted from 0."
        )


def require_axes(what: str, array: Any, *axes: Mapping[str, int]) -> None:
    """**Raises:** `DefinitionError` for an array of another shape.

    **Arguments:** `axes`: a shape that is allowed, as the number of entries along each named axis;
    empty for a single number.
    """
    if np.shape(array) not in [tuple(x.values()) for x in axes]:
        shapes = []
        for sizes in axes:
            written = ", ".join(f"{n} {axis}" for axis, n in sizes.items())
            shapes.append(f"of shape ({written})" if sizes else "one number")
        raise DefinitionError(
            f"{what} must be {' or '.join(shapes)}, not of shape {np.shape(array)}."
        )


def require_among(
    kind: str,
    names: Iterable[str],
    among: Collection[str],
    where: str = "",
) -> None:
    """**Raises:** `DefinitionError` for the first name that is not among those of a kind (a noun).

    **Arguments:** `where`: how the sentence begins. Default: nothing.
    """
    for name in names:
        if name not in among:
            known = ", ".join(among) or "none"
            meant = slip_of(name, among)
            # (A signal may have the name, and another unit.)
            is_other = meant is not None and meant != str(name)
            lead = f": use '{meant}'" if is_other else ""
            raise DefinitionError(
                f"{where}there is no {kind} '{name}'; {kind}s are {known}{lead}."
            )


def channel_index(kind: str, wanted: str | int, names: Sequence[str]) -> int:
    """Return the index of an input or output that is given by its name or index.

    **Raises:** `DefinitionError` if it is not there.
    """
    if isinstance(wanted, str) and wanted in names:
        return names.index(wanted)
    if not isinstance(wanted, str) and 0 <= wanted < len(names):
        return int(wanted)
    raise DefinitionError(
        f"there is no {kind} {wanted!r}; the {kind}s are {', '.join(names)}."
    )


@contextmanager
def searching(place: str, errors: tuple = (ComputationError,)) -> Iterator[None]:
    """Search for a limit cycle on behalf of a function that takes a cycle in a `place`, but not all
    arguments of `find_limit_cycle`, which these `errors` name."""
    try:
        yield
    except errors as error:
        raise type(error)(
            f"{error} (These arguments are those of `find_limit_cycle`: call it, and give its "
            f"cycle {place}.)"
        ) from error


def package(name: str) -> ModuleType:
    """A library, or a module of one.

    **Raises:** `DefinitionError` if it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        name = name.split(".")[0]
        extra = _EXTRAS.get(name, name)
        raise DefinitionError(
            f"this needs {name}: `pip install 'hybridjax[{extra}]'`."
        ) from error


# The extra of a library that is not called like it.
_EXTRAS = {
    "distributed": "scale",
    "zarr": "scale",
    "ezc3d": "c3d",
    "h5py": "mat",
    "rosbags": "ros",
}
_EXTRAS |= {"fmpy": "fmu", "gymnasium": "gym", "anywidget": "explore"}
_EXTRAS |= dict.fromkeys(("pandas", "pyarrow", "openpyxl"), "tables")
