"""Digests of what users' definitions compute, to notice that a function has changed.

A digest is a short text that is equal for equal content. A user's function reads constants of a
notebook, calls helpers and methods, and holds arrays. JAX traces the function once, and does not
notice later that one of these has changed. So in each public call, `current` traces a system's
functions again and compares the programs (`programs.py`). It skips this if a reading of the code
(`reading.py`) proves that nothing has changed. Definitions that are no systems are known by their
code alone.

A class of definitions that is to be traced registers its parts with `parts_of`. The conditions in
`_digest_of` under which nothing is traced must stay: each stands for a change that would be missed.

If a change is not noticed, look at what `reading.py` has read (`Reading.unread` must name the
rest), then at `programs.py`; if a function is refused because it "computes another value each
time", at `_require_the_same`; if it is refused because of what it reads, at `Reading.hidden`,
`moving` and `traced`; if each call traces a system again, print `unread` of the reading in
`_digest_of`.
"""

import collections
import contextlib
import dataclasses
import functools as ft
import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import keystr, tree_leaves_with_path

from . import jax_compat
from .call import once_in_call
from .exceptions import DefinitionError
from .executor import Definition
from .memo import Memory
from .programs import Digests, digest_of_words
from .reading import Reading


Thing = TypeVar("Thing")

# Definitions whose digests are kept. Fewer: calls that alternate between many systems trace them
# again.
_KEPT = 1024
# Further traces of a function that may draw random numbers; the function is refused unless all are
# the same. Fewer: a function that draws one of two numbers is missed more often. More: time.
_DRAWS = 3


class Part(NamedTuple):
    """A part of a definition: its name, as in "the guard of 'touchdown'", and either words that
    define it, or a function without arguments that JAX traces."""

    name: str
    words: str = ""
    function: Callable[[], Any] | None = None


@ft.singledispatch
def parts_of(definition: Any, t: Any, q: Any, u: Any) -> Iterator[Part] | None:
    """Parts of a definition that can be traced, at a time t, and at states and inputs that are the
    first numbers of q and u. (A class of definitions registers its own.)"""
    return None


def current(x: Thing) -> Thing:
    """Return a `Definition` with the digest of its code as it is now; other things as they are.

    **Raises:** `DefinitionError`, as `code_digest`.
    """
    if not isinstance(x, Definition):
        return x
    digest = code_digest(x)
    thing = cast(Any, x)
    if x.code_digest == digest:
        return thing
    return _marked.recall(x, digest, lambda: _mark(x, digest))


def current_of_many(x: Thing) -> Thing:
    """As `current`, of systems side by side, whose arrays have a leading axis."""
    single: Any = first_of(x)
    return cast(Thing, _mark(x, code_digest(single)))


def first_of(x: Thing) -> Thing:
    """The first of systems side by side."""
    return jax.tree_util.tree_map(lambda y: y[0] if eqx.is_array(y) else y, x)


def _require_values(reading: Reading) -> None:
    """**Raises:** `DefinitionError` for a function that reads a value which JAX traces: derivatives
    by it would be lost."""
    for function in reading.traced:
        raise DefinitionError(
            f"the function `{function}` reads a value that JAX traces, and that is none of its "
            "arguments: make this value a parameter of the system, or of a `hj.Crossing` the "
            "`value`."
        )


def _mark(x: Any, digest: str) -> Any:
    """Return a copy of a definition with this digest as its `code_digest`."""
    leaves, structure = jax.tree_util.tree_flatten(x)
    marked = jax.tree_util.tree_unflatten(structure, leaves)
    object.__setattr__(marked, "code_digest", digest)
    return marked


# The marked copy of each object, so that the same object always has the same copy: values are
# remembered by the copy.
_marked = Memory()


def code_digest(x: Definition) -> str:
    """Return the digest of all of a definition but the values of its arrays.

    If JAX remembers a trace of a function that computes something else now, its caches are cleared.

    **Raises:** `DefinitionError` for a part of a system that computes another value each time, for
    a function that reads a value which JAX traces, and for another definition whose code reads
    files, the clock, random numbers, or values by names that are computed (`eval`, `globals`,
    `sys.modules`, ...).
    """
    digest = once_in_call(("digest", _identity(x)), x, lambda: _digest_of(x))
    if x.code_digest not in ("", digest) and _are_many(x):
        # (Systems side by side have the digest of each.)
        single = _digest_of(first_of(x))
        digest = single if single == x.code_digest else digest
    return digest


_NUMBERS_AND_WORDS = bool, int, float, complex, str, bytes, type(None)


def _identity(x: Any) -> Hashable:
    """Which object a definition is, but for the values of its arrays: what thousands of systems of
    a sweep, which are given at once, have in common. (Objects that are equal may differ.)"""
    kind = type(x)
    if kind in _NUMBERS_AND_WORDS:
        return kind, repr(x)
    if eqx.is_array(x):
        return x.shape, x.dtype
    if kind in (tuple, list):
        return kind, *map(_identity, x)
    if kind is dict:
        return kind, *((_identity(k), _identity(y)) for k, y in x.items())
    if isinstance(x, eqx.Module):
        names = (field.name for field in dataclasses.fields(x))
        values = (getattr(x, name, None) for name in names if name != "code_digest")
        return kind, *map(_identity, values)
    return id(x)


def _digest_of(x: Definition) -> str:
    """Return the digest of a definition, without looking whether it is known in this public call.

    A system is read; it has the digest of before if nothing can have changed. Otherwise it is
    traced; what is new is compared with further traces, to find functions that compute another
    value each time. Other definitions have the digest of their reading.
    """
    if parts_of.dispatch(type(x)) is parts_of.dispatch(object):
        reading = Reading(_without_arrays(x))
        _refuse((*reading.hidden, *reading.moving))
        _require_values(reading)
        return reading.digest
    reading = Reading(_with_forms(x), marks=True)
    _require_values(reading)
    # (A new class is always traced, even if its code is equal to that of another one.)
    read: collections.OrderedDict[str, None]
    read = _read.recall(type(x), None, collections.OrderedDict)
    known = _digests.get(reading.digest) if reading.digest in read else None
    # (JAX may remember traces of a time between, when a function computed something else.)
    remembered = reading.digest in _remembered
    if known is not None and not reading.unread and remembered:
        return known
    arrays = _shapes(x)
    anew = reading.retraced or not remembered
    programs = _traced(x, arrays, reading, anew)
    names = [keystr(path) for path, _ in tree_leaves_with_path(arrays)]
    digest = digest_of_words(*names, *itertools.chain(*programs.items()))
    if digest != known or not remembered:
        # (A function may change a value that it reads.)
        after = Reading(_with_forms(x), marks=True)
        moves = bool(reading.unread) or after.digest != reading.digest
        _require_the_same(x, arrays, reading, programs, anew, moves)
    _keep(read, reading.digest, None)
    _keep(_digests, reading.digest, digest)
    _keep(_programs, digest, programs)
    return digest


# From the digest of a definition's reading to the digest of the definition, and from names of its
# parts to their digests. (They hold no object of a user.)
_digests: collections.OrderedDict[str, str] = collections.OrderedDict()
_programs: collections.OrderedDict[str, dict[str, str]] = collections.OrderedDict()
# By class, digests of readings of its objects.
_read = Memory()
# Digests of readings of what JAX traces now as it remembers it.
_remembered: collections.OrderedDict[str, None] = collections.OrderedDict()


def _keep(table: collections.OrderedDict[str, Any], key: str, value: Any) -> None:
    table[key] = value
    while len(table) > _KEPT:
        table.popitem(last=False)


def _shapes(x: Definition) -> Any:
    """Shapes of the arrays of a definition."""

    def shape(y):
        return jax.ShapeDtypeStruct(y.shape, y.dtype)

    return jax.tree_util.tree_map(shape, eqx.filter(x, eqx.is_array))


def _are_many(x: Definition) -> bool:
    """Test for what may be systems side by side: all arrays have the same leading axis."""
    leaves = jax.tree_util.tree_leaves(eqx.filter(x, eqx.is_array))
    return len({y.shape[:1] for y in leaves}) == 1 and leaves[0].ndim > 0


# The name of what is known by its code, and not by a program.
_RULE = "a rule of a derivative, or a callback,"
# States and inputs of a part are the first of so many numbers. Fewer: larger systems cannot be
# traced.
_NUMBERS = 1 << 20
_calls = itertools.count()


def _traced(x: Definition, arrays: Any, reading: Reading, anew: bool) -> dict[str, str]:
    """Digests of the parts of a definition, by name.

    **Arguments:** `anew`: let JAX use no trace that it remembers.
    """
    static = eqx.filter(x, eqx.is_array, inverse=True)
    words: list[tuple[str, str, int]] = []

    def every(arrays: Any, *point: Any) -> list[Any]:
        words.clear()
        results: list[Any] = []
        # (An error of the user's functions is raised again by the call that follows.)
        try:
            for part in parts_of(eqx.combine(arrays, static), *point) or ():
                values, failure = _values(part, reading)
                results += values
                words.append((part.name, part.words + failure, len(values)))
        except Exception as error:
            failure = _failure(error, reading)
            words.append(("the charts and transitions", failure, 0))
        return results

    with jax.enable_x64(True), _own_traces() if anew else contextlib.nullcontext():
        number = jax.ShapeDtypeStruct((), jnp.float64)
        numbers = jax.ShapeDtypeStruct((_NUMBERS,), jnp.float64)
        point = number, numbers, numbers
        program = jax.make_jaxpr(lambda *y: every(*y))(arrays, *point)
        leaves = tree_leaves_with_path(arrays)
        arguments = [f"{keystr(path)}:{y.dtype}{y.shape}" for path, y in leaves]
        digests = Digests(program, [*arguments, "t", "q", "u"])
        rule = ""
        # A rule for derivatives is no part of the program: it is seen in that of a derivative.
        if digests.rules:

            def along(a, *y):
                return jax.jvp(lambda *z: every(a, *z), y, y)

            pushed = jax.make_jaxpr(along)(arrays, *point)
            rule = digest_of_words(
                *Digests(pushed, [*arguments, "t", "q", "u"]).results
            )
    if digests.hosted:
        rule += reading.digest
    results = iter(digests.results)
    parts: dict[str, str] = {}
    for name, about, count in words:
        values = itertools.islice(results, count)
        # (Two transitions may have one name.)
        before = parts.get(name, "")
        parts[name] = digest_of_words(about, before, *values)
    if rule:
        parts[_RULE] = rule
    return parts


def _values(part: Part, reading: Reading) -> tuple[list[Any], str]:
    """Numbers that a part returns, and words on the error that it raises instead."""
    if part.function is None:
        return [], ""
    try:
        leaves = jax.tree_util.tree_leaves(part.function())
        return [jnp.asarray(x) for x in leaves], ""
    except Exception as error:  # of the user's, which the call that follows raises, too
        return [], _failure(error, reading)


def _failure(error: Exception, reading: Reading) -> str:
    """Words that stand for a program that cannot be traced: those of its code."""
    return f" {type(error).__name__} {reading.digest}"


def _own_traces() -> contextlib.AbstractContextManager:
    """A context in which JAX uses no trace from outside: it remembers traces by the words that
    belong to their operations, too."""
    return jax_compat.own_traces(str(next(_calls)))


def _require_the_same(
    x: Definition,
    arrays: Any,
    reading: Reading,
    programs: dict[str, str],
    anew: bool,
    moves: bool,
) -> None:
    """Compare programs, if they were traced `anew`, with those that JAX remembers, and with other
    traces if a value `moves`.

    **Raises:** `DefinitionError` for a part that computes another value each time.
    """
    if anew and _traced(x, arrays, reading, anew=False) != programs:
        jax.clear_caches()
        _remembered.clear()
    _keep(_remembered, reading.digest, None)
    for _ in range(_DRAWS if moves else 0):
        again = _traced(x, arrays, reading, anew)
        if again == programs:
            continue
        name, *_ = different(programs, again)
        raise DefinitionError(
            f"{name} of {type(x).__name__} computes another value each time (it draws a random "
            "number, or reads a clock or a file): compute the value before, and let the function "
            "read it from a variable."
        )


def different(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Names of the parts that are not the same."""
    names = [*before, *(name for name in after if name not in before)]
    return [name for name in names if before.get(name) != after.get(name)]


def change_of(x: Definition) -> str | None:
    """The name of a part of a definition that is not what it was when its digest was taken, as in
    "the guard of 'touchdown' of Hopper"; None if all are.

    **Raises:** `DefinitionError`, as `code_digest`.
    """
    digest = code_digest(x)
    if digest == x.code_digest:
        return None
    before = _programs.get(x.code_digest, {})
    after = _programs.get(digest, {})
    part = "a function, or a value that it reads,"
    if before and after:
        part = different(before, after)[0]
    name = getattr(x, "name", None)
    if isinstance(name, str):
        title = f"{type(x).__name__} '{name}'"
    else:
        title = type(x).__name__
    return f"{part} of {title}"


def program_digest(x: Any) -> str:
    """Return the digest of a definition that is known by its programs, "" for other things."""
    is_traced = isinstance(x, Definition) and x.code_digest in _programs
    return x.code_digest if is_traced else ""


def is_all_program(x: Any) -> bool:
    """Return whether a definition is known by its programs alone: it has no callbacks, which may
    read what no program shows (files, large arrays), and no rules for derivatives."""
    digest = program_digest(x)
    return bool(digest) and _RULE not in _programs[digest]


def code_of(x: Definition) -> str:
    """Return a digest of all code of a definition, for functions that are no part of it (pictures).
    (This digest may change although the programs have not changed.)"""
    return Reading(_without_arrays(x)).digest


def _without_arrays(x: Definition) -> Any:
    return jax.tree_util.tree_map(lambda y: None if eqx.is_array(y) else y, x)


def _with_forms(x: Definition) -> Any:
    """A definition with types and shapes in place of its arrays."""

    def form(y):
        return f"{y.dtype}{y.shape}" if eqx.is_array(y) else y

    return jax.tree_util.tree_map(form, x)


def require_as_made(things: Any, made: str) -> None:
    """**Raises:** `DefinitionError` if a definition in a tree of things that were `made` at some
    time, as in "this response function was made", computes something else now."""

    def is_definition(x):
        return isinstance(x, Definition)

    for x in jax.tree_util.tree_leaves(things, is_leaf=is_definition):
        if not is_definition(x) or not x.code_digest:
            continue
        change = change_of(x)
        if change is not None:
            raise DefinitionError(f"{change} has changed since {made}: make it again.")


def parts_by_name(x: Definition) -> dict[str, str]:
    """Digests of the parts of a definition, as they are now."""
    digest = code_digest(x)
    return dict(_programs.get(digest, {"code": digest}))


def meaning(*things: Any) -> str:
    """Return a digest of functions, classes and objects: of their code, and of all values that they
    read. Two of the same digest compute the same.

    Installed packages are known by their versions and the names of their functions; what users
    replace in them is not noticed, except in `hybridjax.models`.

    **Raises:** `DefinitionError` if code uses `eval`, `exec`, `globals`, `__import__`,
    `import_module`, `sys.modules` or `getenv`, or if a function that is no method reads a file.
    """
    reading = Reading(*things)
    _refuse(reading.hidden)
    return reading.digest


def _refuse(reads: Iterable[str]) -> None:
    for read in reads:
        raise DefinitionError(f"{read}: read values before, by their names.")
