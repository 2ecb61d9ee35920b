"""The parameters of a public function, and the arguments of a call of it.

`checked.py` makes `Parameters` of each function. `take` brings arguments to the form of their kinds
(`values.py`, `containers.py`), or raises a `Misfit` for the first that does not fit; `_lead` ends
its sentence with what may have been meant. `is_wrong` and `about_wrong` are for arguments that are
unknown, too many or too few. If a good argument is refused, look at its kind first
(`Parameters.by_name`); if a message speaks of a wrong order of arguments without need, at `_lead`.

Kinds must not be determined before the first call: only then do all names in annotations exist.
What `_lead` and `about_wrong` find out may take time, since an error is raised; `is_wrong` and
`take` are part of each public call.
"""

import functools
import inspect
import sys
import typing
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, cast

from . import leads
from .kinds import kind_of
from .values import Kind, Misfit


class Parameters:
    """The kinds of a function's parameters, determined at its first call, when all names that its
    annotations use exist."""

    def __init__(self, function: Callable, cls: type | None):
        self.function = function
        self.cls = cls

    def hints(self) -> dict[str, Any]:
        where = vars(sys.modules[self.cls.__module__]) if self.cls else None
        return typing.get_type_hints(self.function, where, include_extras=True)

    @functools.cached_property
    def by_name(self) -> dict[str, Kind | None]:
        """Kinds of all parameters that can be given by name."""
        hints = self.hints()
        parameters = inspect.signature(self.function).parameters.values()
        named = (p.name for p in parameters if p.kind is not p.VAR_KEYWORD)
        return {name: kind_of(hints.get(name, Any)) for name in named}

    @functools.cached_property
    def in_order(self) -> tuple[list[tuple[str, Kind | None]], tuple[str, Kind | None]]:
        """Names and kinds of the parameters that can be given by position, and of `*args`."""
        named = []
        rest = ""
        for parameter in inspect.signature(self.function).parameters.values():
            name = parameter.name
            if parameter.kind <= parameter.POSITIONAL_OR_KEYWORD:
                named.append((name, self.by_name[name]))
            elif parameter.kind is parameter.VAR_POSITIONAL:
                rest = name
        return named, (rest, self.by_name.get(rest))

    @functools.cached_property
    def of_parameters(self) -> Kind:
        """The kind of further keywords, `**parameters`, which `taken_parameters` checks."""
        return cast(Kind, kind_of(self.hints()["parameters"]))

    def call(self, args: tuple, kwargs: dict[str, Any]) -> Any:
        """The result of the function, which gets the arguments in one form."""
        taken, by_name = self.take(args, kwargs)
        return self.function(*taken, **by_name)

    def take(self, args: tuple, kwargs: dict[str, Any]) -> tuple[list, dict[str, Any]]:
        """The arguments in the form in which the function gets them: those by position, and
        `kwargs` itself, whose values are replaced.

        **Raises:** `Misfit` for the first that does not fit.
        """
        positional, further = self.in_order
        taken = []
        by_name = False
        name = ""
        kind: Kind | None = None
        value: Any = None
        try:
            for k, value in enumerate(args):
                name, kind = positional[k] if k < len(positional) else further
                taken.append(value if kind is None else kind.take(value))
            by_name = True
            for name, value in kwargs.items():
                kind = self.by_name.get(name)
                kwargs[name] = value if kind is None else kind.take(value)
        except Misfit as misfit:
            lead = functools.partial(self._lead, name, kind, value, args, by_name)
            raise misfit.of(name).leading(lead) from None
        return taken, kwargs

    def is_wrong(self, args: tuple, kwargs: dict[str, Any]) -> bool:
        """Test whether arguments are unknown, too many or too few. (One that is given twice is left
        to Python.)"""
        names = self._names
        count = min(len(args), len(names.positional))
        if count < len(args) and not names.any_number:
            return True
        if not names.needed_after[count] <= kwargs.keys():
            return True
        return not names.any_name and not kwargs.keys() <= names.all

    def about_wrong(self, function: str, args: tuple, kwargs: dict[str, Any]) -> str:
        """Return the sentence about arguments that are unknown, too many or too few.

        **Raises:** `Misfit` if one of the others does not fit: this tells more.
        """
        names = self._names
        visible = [name for name in names.in_order if name not in ("self", "cls")]
        unknown = [name for name in kwargs if name not in names.all]
        if unknown and not names.any_name:
            first = args[0] if args else None
            return leads.about_keyword(function, unknown[0], visible, first)
        if not names.any_number and len(args) > len(names.positional):
            self.take(args[: len(names.positional)], {})
            positional = [name for name in names.positional if name in visible]
            by_name = [name for name in visible if name not in positional]
            return _about_too_many(function, positional, by_name)
        given = {*kwargs, *names.positional[: len(args)]}
        self.take(args, dict(kwargs))
        name = next(x for x in names.in_order if x in names.required - given)
        return leads.about_missing(function, name, self.by_name[name], args)

    def _lead(
        self, name: str, kind: Kind | None, value: Any, args: tuple, by_name: bool
    ) -> str:
        """Return the rest of the sentence about a value that does not fit."""
        percent = leads.about_percent(kind, value)
        if percent:
            return percent
        called = self.function if self.cls is None else self.cls
        certain = leads.about_argument(called.__qualname__, name, value, args)
        if certain:
            return certain
        # (What is given by name is not in the wrong order.)
        positional = [] if by_name else self.in_order[0]
        for (other, other_kind), given in zip(positional, args, strict=False):
            if other == name or kind is None or other_kind is None:
                continue
            if _fits(kind, given) and _fits(other_kind, value):
                return f": `{name}` and `{other}` may be in the wrong order"
        return leads.about_object(called.__qualname__, kind, value, args)

    @functools.cached_property
    def _names(self) -> "Names":
        return Names.of(inspect.signature(self.function))


class Names(NamedTuple):
    """The parameters of a function."""

    in_order: tuple[str, ...]
    all: frozenset[str]
    positional: tuple[str, ...]
    required: frozenset[str]
    needed_after: tuple[frozenset[str], ...]
    """At index n: the parameters that have to be given by name if n are given by position."""
    any_number: bool
    any_name: bool

    @classmethod
    def of(cls, signature: inspect.Signature) -> "Names":
        parameters = list(signature.parameters.values())
        kinds = [p.kind for p in parameters]
        named = [
            p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
        ]
        positional = [p.name for p in named if p.kind <= p.POSITIONAL_OR_KEYWORD]
        required = frozenset(p.name for p in named if p.default is p.empty)
        counts = range(len(positional) + 1)
        return cls(
            tuple(p.name for p in named),
            frozenset(p.name for p in named),
            tuple(positional),
            required,
            tuple(required.difference(positional[:count]) for count in counts),
            inspect.Parameter.VAR_POSITIONAL in kinds,
            inspect.Parameter.VAR_KEYWORD in kinds,
        )


def _about_too_many(function: str, positional: list[str], by_name: list[str]) -> str:
    """A sentence on what a function takes by position, and what by name."""
    taken = ", ".join(f"`{name}`" for name in positional)
    first = f"{function} takes {taken or 'nothing'} by position"
    if not by_name:
        return f"{first}, and no more."
    named = ", ".join(f"`{name}`" for name in by_name)
    return f"{first}; give others by name: {named}."


def _fits(kind: Kind, value: Any) -> bool:
    try:
        kind.take(value)
    except Misfit:
        return False
    return True


class Fields(Parameters):
    """The kinds of fields with converters."""

    def hints(self) -> dict[str, Any]:
        hints = self.function.__annotations__.items()
        return {name: x for name, x in hints if typing.get_origin(x) is Annotated}
