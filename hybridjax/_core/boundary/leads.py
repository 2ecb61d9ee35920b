"""What an error message says to try instead: the call, argument or attribute that was probably
meant.

Such a hint is called a lead here. Users guess with the words of other libraries, or give the result
of an earlier step. `checked.py`, `members.py` and `public.py` ask for one when they raise an error.
The tables in `guesses` are read only where an error is raised.

Leads are tried in an order, the certain ones first (`_leads_of_name`, `_leads_of_attribute`,
`_leads_of_argument`): if a message leads to the wrong thing, look there; if it leads nowhere, add a
line to a table in `guesses`. A new way to find a lead is one more `yield` at its place in an order.
"""

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from ..public import about_word, is_namespace, place_of
from ..spelling import same_word, spelled_alike
from . import words
from .guesses.attributes import ATTRIBUTES
from .guesses.functions import CALLED, IN_NAMESPACES, NAMES
from .guesses.keywords import KEYWORDS, NEEDS
from .guesses.objects import MAKERS, OBJECTS, STEPS
from .values import Kind, Number, show, with_article


# Attributes or arguments that a message lists. Fewer: the right one is left out. More: the message
# is longer than a line.
_LISTED = 24


# Likeness of two spellings above which one is suggested for the other when nothing else was found;
# see `spelling.py`. Lower: names of other things are suggested. Higher: fewer guesses lead
# anywhere.
_ALIKE = 0.7


def about_name(package: str, name: str, places: Mapping[str, str]) -> str:
    """Return the rest of the sentence about a name that a namespace has not.

    **Arguments:** `places`: the places of all public names, such as `hj.plot.bode`; those of the
    namespace first.
    """
    namespace = package.rpartition(".")[2]
    for lead in _leads_of_name(namespace, name, places):
        if lead is not None:
            return lead
    return IN_NAMESPACES.get(namespace, f"`dir(hj.{namespace})` lists its names")


def other_than(package: str, name: str) -> str | None:
    """Return what the package calls that which a name of one namespace most often means there; None
    if the name of the namespace itself is meant."""
    is_class = name[0].isupper()
    if package != "hybridjax" or is_class:
        return None
    return words.lead_of(NAMES, [""], name)


def _leads_of_name(
    namespace: str, name: str, places: Mapping[str, str]
) -> Iterator[str | None]:
    """Iterate over leads, certain ones first; None where there is none."""

    def place(meant: str | None) -> str | None:
        return None if meant is None else f"did you mean {places[meant]}?"

    own = "" if namespace == "hybridjax" else namespace
    yield words.lead_of(NAMES, [own], name)
    yield place(same_word(name, places))
    yield words.lead_of(NAMES, [""], name)
    yield place(spelled_alike(name, places))
    yield words.lead_of_library([""], name)
    for part in words.parts(name):
        yield words.lead_of(NAMES, [own, ""], part)
    yield place(spelled_alike(name, places, _ALIKE))
    for part in words.parts(name):
        yield place(words.with_part(part, places))


def about_called(package: str) -> str:
    """Return the sentence about a module that was called like a function."""
    name = package.rpartition(".")[2]
    lead = CALLED.get(name, f"`dir(hj.{name})` lists its names")
    return f"`hj.{name}` is a module: {lead}."


def about_attribute(cls: type, name: str, thing: Any = None) -> str:
    """Return the sentence about an attribute that a class has not.

    **Arguments:** `thing`: the object, whose system may have a parameter or a state of this name.
    """
    earlier = about_word(cls.__name__, name)
    if earlier is not None:
        return earlier
    head = f"{with_article(cls.__name__)} has no `{name}`"
    head = head[0].upper() + head[1:]
    part = _about_part(thing, name)
    return f"{head}{part or _meant_attribute(cls, name)}."


def about_setting(thing: Any, name: str, value: Any) -> str:
    """Return the sentence about an attribute that a user sets."""
    cls = type(thing)
    kind = with_article(cls.__name__)
    head = f"{kind[0].upper()}{kind[1:]} does not change"
    if name not in attributes_of(cls):
        return f"{head}, and has no `{name}`{_meant_attribute(cls, name)}."
    if _is_system(thing):
        new = show(value) if isinstance(value, int | float | str) else "..."
        return (
            f"{head}: `system.replace({name}={new})` returns one with another `{name}`."
        )
    for base in cls.__mro__:
        if base.__name__ in MAKERS:
            return f"{head}: {MAKERS[base.__name__]}."
    return f"{head}: functions return new ones."


def _about_part(thing: Any, name: str) -> str:
    """Return the rest of the sentence about a parameter or a signal of what a result is about; ""
    for other names."""
    if _is_system(thing):
        return ""
    if name in parameter_names(thing):
        return f": `.system.{name}` is a parameter of its system"
    if name not in _signals(thing):
        return ""
    if hasattr(type(thing), "trajectory"):
        return f": `cycle.trajectory()('{name}')` has times and values of a signal"
    if callable(thing):
        return f": `trajectory('{name}')` has times and values of a signal"
    if not hasattr(type(thing), "__getitem__"):
        return (
            ": `state` has the states at the end, in the order of its chart's `states`"
        )
    return f": `['{name}']` has the values of a signal"


def _meant_attribute(cls: type, name: str) -> str:
    """Return the rest of the sentence: the most certain lead, or all attributes."""
    attributes = attributes_of(cls)
    for lead in _leads_of_attribute(cls, name, attributes):
        if lead is not None:
            return f": {lead}"
    return f"; it has {_some(attributes)}"


def _leads_of_attribute(
    cls: type, name: str, attributes: Collection[str]
) -> Iterator[str | None]:
    """Iterate over leads, certain ones first; None where there is none."""
    owners = [base.__name__ for base in cls.__mro__]
    yield words.lead_of(ATTRIBUTES, owners, name)
    yield _use(_synonym(name, attributes))
    yield _use(_error_bars(name, attributes))
    yield _use(_attribute_of_part(cls, name))
    yield words.lead_of_library(owners, name)
    yield _use(spelled_alike(name, attributes))
    yield _use(_documented(cls, name))
    for part in words.parts(name):
        yield words.lead_of(ATTRIBUTES, owners, part)
        yield _use(words.with_part(part, attributes))
    yield _use(spelled_alike(name, attributes, _ALIKE))
    function = place_of(name)
    if function is not None and not is_namespace(name):
        yield f"`{function}` is a function that may take it"


def _error_bars(name: str, attributes: Collection[str]) -> str | None:
    """Return the attribute that has what a name such as `multipliers_ci` ends with."""
    _, separator, last = name.rpartition("_")
    is_error = last in ("ci", "se", "sd", "std", "err", "error", "errors", "interval")
    return _synonym(last, attributes) if separator and is_error else None


def _use(name: str | None) -> str | None:
    return None if name is None else f"use `{name}`"


def about_parameter(cls: type, name: str, known: Sequence[str]) -> str:
    """Return the sentence about a parameter that a class has not."""
    if name in getattr(cls, "__dataclass_fields__", {}):
        return (
            f"{cls.__name__}: the field `{name}` is no parameter: declare it by "
            f"`{name}: hj.Parameter = hj.parameter(...)`."
        )
    alike = (
        _synonym(name, known),
        spelled_alike(name, known),
        _documented(cls, name),
        spelled_alike(name, known, _ALIKE),
    )
    meant = next((x for x in alike if x is not None), None)
    lead = "" if meant is None else f": use `{meant}`"
    return (
        f"{cls.__name__}: there is no parameter '{name}'; parameters are "
        f"{', '.join(known) or 'none'}{lead}."
    )


def _documented(cls: type, name: str) -> str | None:
    """Return the parameter of a system whose description has this word or a similar one."""
    if not dataclasses.is_dataclass(cls):
        return None
    parameters: dict[str, str] = {}
    for field in dataclasses.fields(cls):
        for word in field.metadata.get("doc", "").split():
            parameters.setdefault(word, field.name)
    word = name if name in parameters else spelled_alike(name, parameters)
    return None if word is None else parameters[word]


def _attribute_of_part(cls: type, name: str) -> str | None:
    """Return the attribute of this name of a field, such as `fit.interval`."""
    if not dataclasses.is_dataclass(cls):
        return None
    for field in dataclasses.fields(cls):
        known = attributes_of(field.type) if isinstance(field.type, type) else []
        for word in (name, *words.synonyms(name)):
            if word in known:
                return f"{field.name}.{word}"
    return None


def attributes_of(cls: type) -> list[str]:
    """Return the public attributes of a class, its fields first."""
    fields: list[str] = []
    if dataclasses.is_dataclass(cls):
        fields = [field.name for field in dataclasses.fields(cls) if field.repr]
    names = dict.fromkeys([*fields, *dir(cls)])
    hidden = {"code_digest"}
    return [name for name in names if name[0] != "_" and name not in hidden]


def about_missing(
    function: str, name: str, kind: Kind | None, given: Sequence[Any]
) -> str:
    """Return the sentence about an argument that a function needs.

    **Arguments:** `given`: the arguments before it.
    """
    lead = NEEDS.get(f"{function.rpartition('.')[2]}.{name}", NEEDS.get(name))
    if lead is not None:
        return f"{function} needs `{name}`: {_in_names_of(given, lead)}."
    about = "" if kind is None else f" ({kind.allowed})"
    made = about_object(function, kind, None, given)
    return f"{function} needs `{name}`{about}{made}."


def _in_names_of(given: Sequence[Any], sentence: str) -> str:
    """Return a sentence on a signal 'y' and a parameter 'k' with names of what was given."""
    named = [x for x in given if isinstance(x, str)]
    for thing in given:
        for letter, names in (
            ("'y'", _signals(thing)),
            ("'k'", parameter_names(thing)),
        ):
            if names:
                meant = [name for name in named if name in names] or names
                sentence = sentence.replace(letter, f"'{meant[0]}'")
    return sentence


def _is_system(thing: Any) -> bool:
    return hasattr(type(thing), "charts") and hasattr(type(thing), "transitions")


def _signals(thing: Any) -> list[str]:
    """Return the names of the states of a system, or of the signals of a recording."""
    system = getattr(thing, "system", thing)
    if not _is_system(system):
        # (Outputs often stand behind inputs, which do not mark a phase.)
        signals = getattr(thing, "signals", None)
        return list(reversed(signals)) if isinstance(signals, tuple) else []
    try:
        charts = system.charts().values()
        return [str(name) for chart in charts for name in chart.states]
    except Exception:  # (An error in a user's charts has its own sentence elsewhere.)
        return []


def parameter_names(thing: Any) -> list[str]:
    """Return the parameters of a system, or of the system of a result; none of other things."""
    system = getattr(thing, "system", thing)
    if not _is_system(system):
        return []
    fields = dataclasses.fields(system)
    return [x.name for x in fields if x.repr and not x.metadata.get("static")]


def about_keyword(
    function: str, name: str, parameters: Sequence[str], first: Any = None
) -> str:
    """Return the sentence about an argument that a function has not.

    **Arguments:** `first`: the first argument; a system may have a parameter of this name.
    """
    earlier = about_word(function, name)
    if earlier is not None:
        return earlier
    lead = _meant_argument(function.rpartition(".")[2], name, parameters, first)
    return f"{function} has no argument `{name}`{lead}."


def _meant_argument(
    function: str, name: str, parameters: Sequence[str], first: Any
) -> str:
    """Return the rest of the sentence: the most certain lead, or all arguments."""
    for lead in _leads_of_argument(function, name, parameters, first):
        if lead is not None:
            return f": {lead}"
    return f"; it has {_some(parameters)}"


def _leads_of_argument(
    function: str, name: str, parameters: Sequence[str], first: Any
) -> Iterator[str | None]:
    """Iterate over leads, certain ones first; None where there is none."""
    own = [function]
    for word in (name, *words.synonyms(name)):
        yield words.lead_of(KEYWORDS, own, word)
    yield _about_parameter(own, _parameter_like(name, parameter_names(first)))
    yield _use(_synonym(name, parameters))
    is_figure = (place_of(function) or "").startswith("hj.plot.")
    owners = [function, "plot", ""] if is_figure else [function, ""]
    yield words.lead_of(KEYWORDS, owners, name)
    yield _about_parameter(own, _described(first, name))
    yield _use(spelled_alike(name, parameters))
    yield _about_parameter(own, _described(first, name, alike=True))
    for part in words.parts(name):
        yield _use(words.with_part(part, parameters))
        yield words.lead_of(KEYWORDS, owners, part)
    yield _use(spelled_alike(name, parameters, _ALIKE))


def _about_parameter(function: Sequence[str], parameter: str | None) -> str | None:
    """Return how a function gets a parameter of its system."""
    if parameter is None:
        return None
    about = words.lead_of(KEYWORDS, function, "parameter")
    if about is not None:
        return about.replace("'k'", f"'{parameter}'").replace("k=", f"{parameter}=")
    return (
        f"`system.replace({parameter}=...)` returns a system with another `{parameter}`"
    )


def _described(thing: Any, word: str, alike: bool = False) -> str | None:
    """Return the parameter of a system in whose description a word stands, or one like it."""
    system = getattr(thing, "system", thing)
    if not _is_system(system):
        return None
    described: dict[str, str] = {}
    for field in dataclasses.fields(system):
        for x in field.metadata.get("doc", "").split():
            described.setdefault(x, field.name)
    meant = spelled_alike(word, [x for x in described if len(x) > 4]) if alike else word
    return described.get(meant or "")


def _parameter_like(name: str, parameters: Collection[str]) -> str | None:
    return name if name in parameters else spelled_alike(name, parameters)


def _synonym(name: str, among: Collection[str]) -> str | None:
    """Return the name that means the same, or that is written otherwise."""
    for word in words.synonyms(name):
        if word in among:
            return word
    return same_word(name, among)


def about_object(
    function: str,
    kind: Kind | None,
    value: Any,
    given: Sequence[Any] = (),
) -> str:
    """Return the rest of a sentence about a value that a function cannot use: the call that makes
    the object it needs, or the part of the value that it needs; "" if none is known.

    **Arguments:** `function`: its name, of a method with its class. `given`: all arguments, whose
    names the call has.
    """
    return _in_names_of(given, _about_object(function, kind, value))


def about_argument(
    function: str, argument: str, value: Any, given: Sequence[Any]
) -> str:
    """Return what to do where one argument of a function was given a value of some type, as the
    rest of a sentence; "" if nothing is known.

    **Arguments:** as `about_object`.
    """
    lead = _of_type(f"{function.rpartition('.')[2]}.{argument}", value)
    return "" if lead is None else f": {_in_names_of(given, lead)}"


def _of_type(place: str, value: Any) -> str | None:
    """Return the sentence of the table for a place, and the type of a value."""
    leads = (OBJECTS.get(f"{place}.{base.__name__}") for base in type(value).__mro__)
    return next((lead for lead in leads if lead is not None), None)


def about_percent(kind: Kind | None, value: Any) -> str:
    """Return the number that a percentage means, as the rest of a sentence; "" for others."""
    if not isinstance(kind, Number) or not isinstance(value, int | float):
        return ""
    is_share = max(kind.low, kind.above) == 0 and min(kind.high, kind.below) == 1
    # (Smaller numbers may be no percentages.)
    return f": {value:g} % is {value / 100:g}" if is_share and 5 <= value <= 100 else ""


def _about_object(function: str, kind: Kind | None, value: Any) -> str:
    for name in (function, function.rpartition(".")[2]):
        lead = _of_type(name, value)
        if lead is not None:
            return f": {lead}"
    wanted = list(classes_in(kind))
    if _is_class_of(value, wanted):
        return f": make one, as `{value.__name__}()`"
    for cls in wanted:
        part = _part(value, cls)
        if part is not None:
            return f": pass its `{part}`"
    given = [cls.__name__ for cls in type(value).__mro__]
    for cls in wanted:
        for base in given:
            step = STEPS.get((cls.__name__, base))
            if step is not None:
                return f": {step}"
    makers = [MAKERS[cls.__name__] for cls in wanted if cls.__name__ in MAKERS]
    return f": {makers[0]}" if makers else ""


def _is_class_of(value: Any, wanted: Sequence[type]) -> bool:
    """Test whether a class was given in place of its object."""
    return isinstance(value, type) and issubclass(value, tuple(wanted))


def classes_in(kind: Kind | None) -> Iterable[type]:
    """Iterate over the classes of which a kind takes objects."""
    cls = getattr(kind, "cls", None)
    if cls is not None:
        yield cls
    item = getattr(kind, "item", None)
    for part in (*getattr(kind, "kinds", ()), *([item] if item else [])):
        yield from classes_in(part)


def _part(value: Any, cls: type) -> str | None:
    """Return the name of the field of an object that holds one of the class."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return None
    if getattr(cls, "_is_protocol", False):
        return None
    for field in dataclasses.fields(value):
        part = getattr(value, field.name, None)
        if not field.name.startswith("_") and isinstance(part, cls):
            return field.name
    return None


def _some(names: Collection[str]) -> str:
    """Return a list of names, or the first of many."""
    shown = [f"`{name}`" for name in list(names)[:_LISTED]]
    more = len(names) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
