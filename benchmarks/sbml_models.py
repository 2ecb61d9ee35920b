"""A reader of SBML models with events (Level 3 Version 1), as functions of time, state and numbers.

`read` gives a `Model`; `Point` has the values of all its symbols at one time. States are the
symbols that change: amounts of species in reactions, and all that rate rules and events change.
`Skip` says why a model cannot be expressed: delays, priorities, algebraic rules, fast reactions,
and fields that jump without an event.

Math is kept as nested tuples, such as ("times", ("ci", "k1"), ("cn", 2.0)).
"""

import dataclasses
import functools as ft
import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np


Math = tuple
AVOGADRO = 6.02214179e23  # as SBML Level 3 Version 1 defines it


class Skip(Exception):
    """A model that the reader cannot express, and why."""


class Species(NamedTuple):
    compartment: str
    in_amounts: bool
    """Whether its symbol in formulas is the amount, and not the concentration."""
    initial_is_amount: bool
    fixed: bool
    """Whether reactions leave it as it is."""
    conversion: str | None
    """The symbol of its conversion factor."""


class Reaction(NamedTuple):
    law: Math
    stoichiometry: tuple[tuple[str, Math, float], ...]
    """Species, coefficient, and the sign: -1 for what is used up."""


class Event(NamedTuple):
    name: str
    trigger: Math
    begins_true: bool
    """Whether the trigger counts as true before the start, so that it does not fire there."""
    assignments: tuple[tuple[str, Math], ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A model, which is equal to itself alone."""

    numbers: dict[str, float]
    """Initial values, sizes, parameters, thresholds."""
    species: dict[str, Species]
    compartments: tuple[str, ...]
    reactions: dict[str, Reaction]
    functions: dict[str, tuple[tuple[str, ...], Math]]
    initial: dict[str, Math]
    assigned: dict[str, Math]
    rates: dict[str, Math]
    events: tuple[Event, ...]
    states: tuple[str, ...]


# Reading.


def read(path: Path) -> Model:
    """The model of a file.

    **Raises:** `Skip` for one that cannot be expressed.
    """
    (model,) = _children(ElementTree.parse(path).getroot(), "model")
    for kind, why in (
        ("algebraicRule", "algebraic rules"),
        ("delay", "delays"),
        ("priority", "priorities"),
    ):
        if any(_tag(x) == kind for x in model.iter()):
            raise Skip(why)
    if any(x.get("fast") == "true" for x in model.iter()):
        raise Skip("fast reactions")
    if any("/comp/" in x.tag for x in model.iter()):
        raise Skip("submodels")
    numbers: dict[str, float] = {}
    compartments = tuple(x.attrib["id"] for x in _of(model, "Compartments"))
    points = set()
    for x in _of(model, "Compartments"):
        numbers[x.attrib["id"]] = float(x.get("size", "nan"))
        if float(x.get("spatialDimensions", "3")) == 0:
            points.add(x.attrib["id"])
    for x in _of(model, "Parameters"):
        numbers[x.attrib["id"]] = float(x.get("value", "nan"))
    species = {}
    for x in _of(model, "Species"):
        name = x.attrib["id"]
        amount = x.get("initialAmount")
        numbers[name] = float(amount or x.get("initialConcentration", "nan"))
        place = x.attrib["compartment"]
        in_amounts = x.get("hasOnlySubstanceUnits") == "true" or place in points
        fixed = "true" in (x.get("boundaryCondition"), x.get("constant"))
        factor = x.get("conversionFactor", model.get("conversionFactor"))
        species[name] = Species(place, in_amounts, amount is not None, fixed, factor)
    reactions = {x.attrib["id"]: _reaction(x, numbers) for x in _of(model, "Reactions")}
    initial = _formulas(model, "InitialAssignments", "initialAssignment", "symbol")
    assigned = _formulas(model, "Rules", "assignmentRule", "variable")
    rates = _formulas(model, "Rules", "rateRule", "variable")
    functions = {
        x.attrib["id"]: _function(x) for x in _of(model, "FunctionDefinitions")
    }
    events = tuple(
        _event(k, x, numbers, functions) for k, x in enumerate(_of(model, "Events"))
    )
    changing = [*rates]
    for event in events:
        changing += [name for name, _ in event.assignments]
    for reaction in reactions.values():
        changing += [x for x, *_ in reaction.stoichiometry if not species[x].fixed]
    states = tuple(x for x in dict.fromkeys(changing) if x not in assigned)
    if not states:
        raise Skip("no state")
    for math in (
        *rates.values(),
        *assigned.values(),
        *(x.law for x in reactions.values()),
    ):
        if _jumps(math):
            raise Skip("a field that jumps without an event")
    return Model(
        # (What has no value has a formula, or no one asks for it.)
        {name: x for name, x in numbers.items() if not np.isnan(x)},
        species,
        compartments,
        reactions,
        functions,
        initial,
        assigned,
        rates,
        events,
        states,
    )


def _tag(x: ElementTree.Element) -> str:
    return x.tag.split("}")[-1]


def _children(x: ElementTree.Element, tag: str) -> list[ElementTree.Element]:
    return [child for child in x if _tag(child) == tag]


def _of(x: ElementTree.Element, plural: str) -> list[ElementTree.Element]:
    """The members of a list of SBML."""
    return [member for found in _children(x, f"listOf{plural}") for member in found]


def _formulas(model, plural: str, kind: str, key: str) -> dict[str, Math]:
    found = [x for x in _of(model, plural) if _tag(x) == kind]
    return {x.attrib[key]: _formula(x) for x in found}


def _formula(x: ElementTree.Element) -> Math:
    """The formula in an element."""
    found = _children(x, "math")
    if not found or not len(found[0]):
        raise Skip("formulas left out")
    return _math(found[0][0])


def _reaction(x: ElementTree.Element, numbers: dict[str, float]) -> Reaction:
    """A reaction. Its own parameters get the names of both in `numbers`."""
    name = x.attrib["id"]
    if not _children(x, "kineticLaw"):
        raise Skip("formulas left out")
    (kinetics,) = _children(x, "kineticLaw")
    own = {}
    for y in _of(kinetics, "LocalParameters"):
        full = f"{name}.{y.attrib['id']}"
        own[y.attrib["id"]] = ("ci", full)
        numbers[full] = float(y.get("value", "nan"))
    sides = []
    for plural, sign in (("Reactants", -1.0), ("Products", 1.0)):
        for y in _of(x, plural):
            if "id" in y.attrib:
                numbers[y.attrib["id"]] = float(y.get("stoichiometry", "nan"))
                coefficient = ("ci", y.attrib["id"])
            else:
                coefficient = ("cn", float(y.get("stoichiometry", "nan")))
            sides.append((y.attrib["species"], coefficient, sign))
    return Reaction(_put_in(_formula(kinetics), own), tuple(sides))


def _function(x: ElementTree.Element) -> tuple[tuple[str, ...], Math]:
    """The arguments of a function, and its body."""
    (body,) = _children(x, "math")
    *arguments, value = body[0]
    return tuple((y[0].text or "").strip() for y in arguments), _math(value)


def _event(
    k: int, x: ElementTree.Element, numbers: dict[str, float], functions: dict
) -> Event:
    """An event. Thresholds in its trigger become `numbers`."""
    name = x.get("id", f"event {k}")
    (trigger,) = _children(x, "trigger")
    counter = iter(range(1000))

    def threshold(math: Math) -> Math:
        if math[0] != "cn":
            return math
        own = f"{name}.threshold {next(counter)}"
        numbers[own] = math[1]
        return ("ci", own)

    def named(math: Math) -> Math:
        if math[0] in ORDERS:
            return (math[0], *map(threshold, math[1:]))
        return (math[0], *map(named, math[1:]))

    condition = _condition(_without_functions(_formula(trigger), functions))
    assignments = tuple(
        (y.attrib["variable"], _formula(y)) for y in _of(x, "EventAssignments")
    )
    begins_true = trigger.get("initialValue") == "true"
    return Event(name, named(condition), begins_true, assignments)


def _math(x: ElementTree.Element) -> Math:
    """MathML as nested tuples."""
    kind = _tag(x)
    text = (x.text or "").strip()
    if kind == "apply":
        head, *rest = x
        if _tag(head) == "ci":
            name = (head.text or "").strip()
            return ("call", ("name", name), *map(_math, rest))
        if _tag(head) == "csymbol":
            raise Skip(
                "delays" if "delay" in head.attrib["definitionURL"] else "rateOf"
            )
        return (_tag(head), *map(_math, rest))
    if kind == "ci":
        return ("ci", text)
    if kind == "csymbol":
        return (x.attrib["definitionURL"].split("/")[-1],)
    if kind == "cn":
        return ("cn", _number(x, text))
    if kind in ("degree", "logbase"):
        return _math(x[0])
    # (piecewise and its parts, true, false, pi, ...)
    return (kind, *map(_math, x))


def _number(x: ElementTree.Element, text: str) -> float:
    second = (x[0].tail or "").strip() if len(x) else ""
    if x.get("type") == "rational":
        return float(text) / float(second)
    return float(f"{text}e{second}") if x.get("type") == "e-notation" else float(text)


def _put_in(math: Math, own: dict[str, Math]) -> Math:
    """A formula with others in place of some symbols."""
    if math[0] == "ci":
        return own.get(math[1], math)
    if math[0] in ("cn", "name"):
        return math
    return (math[0], *(_put_in(x, own) for x in math[1:]))


def _without_functions(math: Math, functions: dict) -> Math:
    """A formula with the bodies of functions in place of their calls."""
    if math[0] in ("ci", "cn", "name"):
        return math
    parts = [_without_functions(x, functions) for x in math[1:]]
    if math[0] != "call":
        return (math[0], *parts)
    arguments, body = functions[parts[0][1]]
    own = dict(zip(arguments, parts[1:], strict=True))
    return _without_functions(_put_in(body, own), functions)


_JUMPS = {"piecewise", "floor", "ceiling", "lt", "gt", "leq", "geq", "eq", "neq"}


def _jumps(math: Math) -> bool:
    """Test whether a formula may have a step."""
    if math[0] in ("ci", "cn", "name"):
        return False
    return math[0] in _JUMPS or any(map(_jumps, math[1:]))


# Conditions.


ORDERS = {"lt", "gt", "leq", "geq"}
_OPPOSITE = {"lt": "geq", "gt": "leq", "leq": "gt", "geq": "lt"}
_DUAL = {"and": "or", "or": "and", "true": "false", "false": "true"}


def _condition(math: Math, negate: bool = False) -> Math:
    """A condition of `and`, `or`, `true`, `false` and inequalities of two sides, without `not`."""
    kind, *parts = math
    if kind == "not":
        return _condition(parts[0], not negate)
    if kind in ORDERS:
        own = _OPPOSITE[kind] if negate else kind
        pairs = [(own, x, y) for x, y in itertools.pairwise(parts)]
        if len(pairs) == 1:
            return pairs[0]
        return ("or" if negate else "and", *pairs)
    if kind in ("and", "or"):
        if not parts:
            kind = "true" if kind == "and" else "false"
        own = _DUAL[kind] if negate else kind
        return (own, *(_condition(x, negate) for x in parts))
    if kind in ("true", "false"):
        return (_DUAL[kind] if negate else kind,)
    if kind == "xor" and not parts:
        return ("true" if negate else "false",)
    raise Skip(f"triggers with {kind}")


def inequalities(condition: Math) -> list[Math]:
    """The inequalities of a condition, in their order."""
    if condition[0] in ORDERS:
        return [condition]
    return [y for x in condition[1:] for y in inequalities(x)]


def holds(condition: Math, values: Iterator[Any]) -> Any:
    """A condition from the `values` of its inequalities, in their order."""
    kind, *parts = condition
    if kind in ORDERS:
        return next(values)
    if kind in ("true", "false"):
        return kind == "true"
    known = [holds(x, values) for x in parts]
    return all_of(known) if kind == "and" else any_of(known)


# Values.


def _root(*parts):
    return jnp.sqrt(parts[0]) if len(parts) == 1 else parts[1] ** (1 / parts[0])


def _log(*parts):
    if len(parts) == 1:
        return jnp.log10(parts[0])
    return jnp.log(parts[1]) / jnp.log(parts[0])


def _chain(compare):
    """A comparison of each part with the next."""

    def all_hold(*parts):
        return all_of([compare(x, y) for x, y in itertools.pairwise(parts)])

    return all_hold


def all_of(found):
    return ft.reduce(jnp.logical_and, found, True)


def any_of(found):
    return ft.reduce(jnp.logical_or, found, False)


def _power(x, y):
    # (A whole exponent that is known has a derivative at negative numbers, too.)
    known = isinstance(y, float) and y == round(y)
    return x ** int(y) if known else x**y


OPERATORS: dict[str, Callable[..., Any]] = {
    "plus": lambda *x: sum(x),
    "times": lambda *x: ft.reduce(lambda a, b: a * b, x, 1.0),
    "minus": lambda *x: -x[0] if len(x) == 1 else x[0] - x[1],
    "divide": lambda x, y: x / y,
    "power": _power,
    "root": _root,
    "log": _log,
    "ln": jnp.log,
    "abs": jnp.abs,
    "exp": jnp.exp,
    "floor": jnp.floor,
    "ceiling": jnp.ceil,
    "factorial": lambda x: float(np.prod(np.arange(1, x + 1))),
    "sec": lambda x: 1 / jnp.cos(x),
    "csc": lambda x: 1 / jnp.sin(x),
    "cot": lambda x: 1 / jnp.tan(x),
    "sech": lambda x: 1 / jnp.cosh(x),
    "csch": lambda x: 1 / jnp.sinh(x),
    "coth": lambda x: 1 / jnp.tanh(x),
    "arcsec": lambda x: jnp.arccos(1 / x),
    "arccsc": lambda x: jnp.arcsin(1 / x),
    "arccot": lambda x: jnp.arctan(1 / x),
    "arcsech": lambda x: jnp.arccosh(1 / x),
    "arccsch": lambda x: jnp.arcsinh(1 / x),
    "arccoth": lambda x: jnp.arctanh(1 / x),
    "lt": _chain(jnp.less),
    "gt": _chain(jnp.greater),
    "leq": _chain(jnp.less_equal),
    "geq": _chain(jnp.greater_equal),
    "eq": _chain(jnp.equal),
    "neq": jnp.not_equal,
    "and": lambda *x: all_of(x),
    "or": lambda *x: any_of(x),
    "xor": lambda *x: ft.reduce(jnp.logical_xor, x, False),
    "not": jnp.logical_not,
    **{
        name: getattr(jnp, name)
        for stem in ("sin", "cos", "tan", "sinh", "cosh", "tanh")
        for name in (stem, f"arc{stem}")
    },
}
_CONSTANTS = {
    "pi": np.pi,
    "exponentiale": np.e,
    "avogadro": AVOGADRO,
    "infinity": np.inf,
    "notanumber": np.nan,
    "true": True,
    "false": False,
}


class Point:
    """The values of all symbols at a time, of a model with given numbers.

    Without `states` it is the start, before events.
    """

    def __init__(
        self, model: Model, numbers: dict[str, Any], t: Any, states: Any = None
    ):
        self.model = model
        self.numbers = numbers
        self.t = t
        self.states = None
        if states is not None:
            self.states = dict(zip(model.states, states, strict=True))
        self._known: dict[str, Any] = {}

    @ft.cached_property
    def start(self) -> "Point":
        """The start, on which constants depend."""
        return self if self.states is None else Point(self.model, self.numbers, 0.0)

    def symbol(self, name: str) -> Any:
        """The value of a symbol in formulas."""
        if name not in self._known:
            self._known[name] = self._symbol(name)
        return self._known[name]

    def _symbol(self, name: str) -> Any:
        model = self.model
        if name in model.assigned:
            return self.value(model.assigned[name])
        if name in model.reactions:
            return self.value(model.reactions[name].law)
        if self.states is None and name in model.initial:
            return self.value(model.initial[name])
        if name not in model.species:
            if self.states is None:
                return self.numbers.get(name, np.nan)
            return self.states[name] if name in self.states else self.start.symbol(name)
        if self.states is not None and name in self.states and name in model.rates:
            return self.states[name]
        about = model.species[name]
        if self.states is None:
            given = self.numbers.get(name, np.nan)
            if about.initial_is_amount == about.in_amounts:
                return given
            size = self.symbol(about.compartment)
            return given / size if about.initial_is_amount else given * size
        amount = self.amount(name)
        return amount if about.in_amounts else amount / self.symbol(about.compartment)

    def amount(self, name: str) -> Any:
        """The amount of a species."""
        about = self.model.species[name]
        if self.states is not None and name not in {
            *self.model.rates,
            *self.model.assigned,
        }:
            kept = self.states
            return kept[name] if name in kept else self.start.amount(name)
        value = self.symbol(name)
        return value if about.in_amounts else value * self.symbol(about.compartment)

    def concentration(self, name: str) -> Any:
        return self.amount(name) / self.symbol(self.model.species[name].compartment)

    def value(self, math: Math) -> Any:
        """The value of a formula."""
        kind, *parts = math
        if kind == "ci":
            return self.symbol(parts[0])
        if kind == "cn":
            return parts[0]
        if kind == "time":
            return self.t
        if kind in _CONSTANTS:
            return _CONSTANTS[kind]
        if kind == "call":
            return self.value(_without_functions(math, self.model.functions))
        if kind == "piecewise":
            return self._piecewise(parts)
        if kind not in OPERATORS:
            raise Skip(f"formulas with {kind}")
        return OPERATORS[kind](*map(self.value, parts))

    def _piecewise(self, parts: list[Math]) -> Any:
        out = jnp.nan
        for kind, *own in reversed(parts):
            value = self.value(own[0])
            out = (
                value
                if kind == "otherwise"
                else jnp.where(self.value(own[1]), value, out)
            )
        return out

    def state(self, name: str) -> Any:
        """What is integrated: the symbol itself, or the amount of a species without rate rule."""
        is_amount = name in self.model.species and name not in self.model.rates
        return self.amount(name) if is_amount else self.symbol(name)

    def rate(self, name: str) -> Any:
        """The derivative of a state by the time."""
        model = self.model
        if name in model.rates:
            return self.value(model.rates[name])
        total = 0.0
        if name not in model.species or model.species[name].fixed:
            return total
        for reaction, (_, sides) in model.reactions.items():
            for species, coefficient, sign in sides:
                if species == name:
                    total += sign * self.value(coefficient) * self.symbol(reaction)
        factor = model.species[name].conversion
        return total if factor is None else total * self.symbol(factor)

    def threshold(self, inequality: Math) -> Any:
        """A number that is negative where an inequality holds."""
        kind, left, right = inequality
        below = self.value(left) - self.value(right)
        return below if kind in ("lt", "leq") else -below

    def holds(self, condition: Math) -> Any:
        """Test whether a condition holds."""
        found = [
            self.threshold(x) <= 0 if x[0] in ("leq", "geq") else self.threshold(x) < 0
            for x in inequalities(condition)
        ]
        return holds(condition, iter(found))

    def after(self, event: Event) -> list[Any]:
        """The states after an event. It leaves the amounts of other species as they are."""
        model = self.model
        new = {name: self.value(math) for name, math in event.assignments}
        names = model.states
        now = [self.state(x) for x in names]
        kept = [
            new.get(x, old) if x not in model.species else old
            for x, old in zip(names, now, strict=True)
        ]
        sizes = Point(model, self.numbers, self.t, kept)
        return [
            _species_after(self, sizes, x, new) if x in model.species else value
            for x, value in zip(names, kept, strict=True)
        ]


def _species_after(before: Point, sizes: Point, name: str, new: dict[str, Any]) -> Any:
    """The state of a species after an event, by the `sizes` of compartments after it. (What is
    assigned is a concentration before compartments change, as in case 01779 of the suite.)"""
    about = before.model.species[name]
    old = 1.0 if about.in_amounts else before.symbol(about.compartment)
    amount = new[name] * old if name in new else before.amount(name)
    if name not in before.model.rates:
        return amount
    return amount if about.in_amounts else amount / sizes.symbol(about.compartment)


def events_at_start(model: Model) -> list[Event]:
    """The events that happen at the start, in their order.

    **Raises:** `Skip` if several are due at once: their order is left open.
    """
    numbers = model.numbers
    point = Point(model, numbers, 0.0)
    before = [event.begins_true for event in model.events]
    happened: list[Event] = []
    while True:
        now = [bool(point.holds(event.trigger)) for event in model.events]
        due = [
            event
            for event, was, true in zip(model.events, before, now, strict=True)
            if true and not was
        ]
        if not due:
            return happened
        if len(due) > 1 or len(happened) > 20:
            raise Skip("several events at the start")
        happened += due
        point = Point(model, numbers, 0.0, point.after(due[0]))
        before = now


def start(model: Model, numbers: dict[str, Any], first: list[Event]) -> Any:
    """The states at the start, after the events that happen `first`."""
    point = Point(model, numbers, 0.0)
    states = [point.state(x) for x in model.states]
    for event in first:
        states = Point(model, numbers, 0.0, states).after(event)
    return jnp.stack([jnp.asarray(x, float) for x in states])


# The settings and results of a case.


class Settings(NamedTuple):
    start: float
    duration: float
    steps: int
    variables: list[str]
    absolute: float
    relative: float
    amount: list[str]
    concentration: list[str]


def read_settings(path: Path) -> Settings:
    found = dict(re.findall(r"^(\w+):[ \t]*(.*)$", path.read_text(), re.M))
    names = [
        [x.strip() for x in found.get(key, "").split(",") if x.strip()]
        for key in ("variables", "amount", "concentration")
    ]
    return Settings(
        float(found["start"]),
        float(found["duration"]),
        int(found["steps"]),
        names[0],
        float(found["absolute"]),
        float(found["relative"]),
        names[1],
        names[2],
    )
