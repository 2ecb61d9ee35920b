"""The decorators of public functions and classes: `checked`, `checked_methods`, `check_fields`.

They compare each argument of a call with the `Kind` that the annotation stands for, and pass it on
in one form, or raise a `DefinitionError` of one sentence. A kind is a description of the values
that an argument may have (`values.py`, `containers.py`; the names used in annotations are in
`kinds.py`).
"""

import functools
import inspect
import sys
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple, TypeVar, cast

import equinox as eqx
import jax

from .. import jax_compat
from ..call import public_call
from ..exceptions import DefinitionError
from ..executor import as_numpy, is_hidden, is_inside_program, is_traced
from ..memo import Memory
from . import leads
from .kinds import kind_of
from .members import Bound, fixed_attribute, missing_attribute
from .signature import ShortSignature
from .values import Kind, Misfit


Thing = TypeVar("Thing", bound=Callable)
Class = TypeVar("Class", bound=type)

_OPERATORS = (
    "__call__",
    "__getitem__",
    "__matmul__",
    "__add__",
    "__repr__",
    "_repr_html_",
)
_JAX_ERRORS = jax.errors.JAXTypeError, jax.errors.JAXIndexError


class NeedsValues(DefinitionError):
    """A function that needs values was called where JAX knows none."""


class WrongArguments(DefinitionError, TypeError):
    """Arguments that a function has not, too many, or too few."""


def checked(thing: Thing) -> Thing:
    """A public function whose arguments are checked against its annotations when it is called; a
    class whose constructor and public methods are.

    What does not fit is refused with one sentence, which names the function, the argument, what
    is allowed and what was given. What fits is handed on in one form: see `Kind.take`. Defaults
    are not checked, nor are arguments without annotation, or with `Any`. Arguments that are
    missing, too many or unknown raise an error, which leads on as that of a wrong object does
    (`leads.py`, `words.py`).

    How a call is put right if JAX transforms it: numbers, words and switches refuse to be traced;
    arrays (`Reals`) may be, and their values are then not looked at. Where a function needs values
    nevertheless, JAX's error becomes one sentence that says so.

    It stands above all other decorators, except `classmethod` and `staticmethod`.
    """
    if not isinstance(thing, type):
        return cast(Thing, _wrapped(thing, thing.__qualname__))
    makers = ["__new__"] if issubclass(thing, tuple) else ["__init__", "__check_init__"]
    for maker in makers:
        if maker in vars(thing):
            wrapped = _wrapped(getattr(thing, maker), thing.__name__, thing)
            setattr(thing, maker, wrapped)
    return cast(Thing, checked_methods(thing))


def checked_methods(cls: Class) -> Class:
    """A class whose public methods are checked, but not its constructor. For results: only this
    package, and JAX when it rebuilds a pytree, call their constructors."""
    for name, member in list(vars(cls).items()):
        if name.startswith("_") and name not in _OPERATORS:
            continue
        is_bound_otherwise = isinstance(member, classmethod | staticmethod | Bound)
        function = member.__func__ if is_bound_otherwise else member
        if not inspect.isfunction(function):
            continue
        if getattr(function, "__isabstractmethod__", False):
            continue
        wrapped = _wrapped(function, f"{cls.__name__}.{name}")
        if is_bound_otherwise:
            wrapped = type(member)(wrapped)
        elif issubclass(cls, eqx.Module) and not name.startswith("_"):
            wrapped = Bound(wrapped)
        setattr(cls, name, wrapped)
    if not hasattr(cls, "__getattr__"):
        setattr(cls, "__getattr__", missing_attribute)  # noqa: B010
    if cls.__setattr__ is eqx.Module.__setattr__:
        setattr(cls, "__setattr__", fixed_attribute)  # noqa: B010
    return cls


def check_fields(cls: type, args: tuple, kwargs: dict[str, Any]) -> None:
    """Check what the constructor of a class is given for those of its fields whose converters say
    by a `Kind` what they take. (Its other annotations are its author's business.)

    **Raises:** `DefinitionError`, also for a name that is none of its fields.
    """
    constructor = cls.__init__  # type: ignore[misc]
    fields = _fields.recall(cls, None, lambda: _Fields(constructor, cls))
    unknown = [name for name in kwargs if name not in fields.by_name]
    if unknown and inspect.getfullargspec(constructor).varkw is None:
        known = list(fields.by_name)[1:]
        raise DefinitionError(leads.about_parameter(cls, unknown[0], known))
    try:
        fields.take((None, *args), dict(kwargs))
    except Misfit as misfit:
        raise DefinitionError(
            f"{cls.__name__}: `{misfit.path}` {misfit.problem}."
        ) from None


def taken_parameters(
    function: Callable, thing: Any, given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the keywords of a call that are no arguments of a public function, but parameters of a
    system, or of the system of a limit cycle, in the form of their kind. (Names of other things, as
    of a function that makes systems, are not checked.)

    **Raises:** `WrongArguments` for a name that is no parameter; `DefinitionError` for a value that
    does not fit, and if an option of the function is called like a parameter.
    """
    kinds: _Kinds = getattr(function, "kinds")  # noqa: B009
    known = leads.parameter_names(thing)
    called = function.__name__
    options = [x for x in known if x in kinds.by_name] if given else []
    if options:
        raise DefinitionError(
            f"{called}: `{options[0]}` is both an option of this function and a parameter of the "
            "system: give parameters as a dictionary, or by name and range, not as keywords."
        )
    taken = {}
    for name, value in given.items():
        if known and name not in known:
            visible = [x for x in kinds.by_name if x not in given]
            raise WrongArguments(leads.about_keyword(called, name, visible, thing))
        try:
            taken[name] = kinds.of_parameters.take(value)
        except Misfit as misfit:
            lead = leads.about_object(called, kinds.of_parameters, value)
            raise DefinitionError(
                f"{called}: `{misfit.of(name).path}` {misfit.problem}{lead}."
            ) from None
    return taken


def _wrapped(function: Callable, name: str, cls: type | None = None) -> Callable:
    kinds = _Kinds(function, cls)

    @functools.wraps(function)
    def call(*args, **kwargs):
        try:
            with public_call() as is_own, as_numpy():
                if kinds.is_wrong(args, kwargs):
                    raise WrongArguments(kinds.about_wrong(name, args, kwargs))
                if is_own and _is_constant(args, kwargs):
                    return _constant(kinds, args, kwargs)
                return kinds.call(args, kwargs)
        except Misfit as misfit:
            raise DefinitionError(
                f"{name}: `{misfit.path}` {misfit.problem}{misfit.lead}."
            ) from None
        except (*_JAX_ERRORS, NeedsValues):
            if not is_hidden(args, kwargs):
                raise
        raise NeedsValues(
            f"{name} needs values, but JAX traces them here: call it outside of jit, vmap and grad."
        )

    # (Those of a function are not declared.)
    setattr(call, "kinds", kinds)  # noqa: B010
    setattr(call, "__signature__", ShortSignature(function, cls))  # noqa: B010
    return call


def _is_constant(args: tuple, kwargs: dict[str, Any]) -> bool:
    """Test whether JAX traces a program in which a call would be a constant: it traces none of the
    arguments."""
    if jax_compat.is_outside() or is_traced(args, kwargs):
        return False
    return is_inside_program()


def _constant(kinds: "_Kinds", args: tuple, kwargs: dict[str, Any]) -> Any:
    """The result of a call that does not depend on what JAX traces. It is computed now and enters
    the program as a constant, so that code which needs its values has them."""
    try:
        with jax_compat.outside():
            return kinds.call(args, dict(kwargs))
    except jax.errors.UnexpectedTracerError:
        # (A function among the arguments reads a value that JAX traces.)
        return kinds.call(args, kwargs)


class _Kinds:
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
        """The arguments in the form in which the function gets them.

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
        """Return the sentence about arguments that are unknown, too many or too few."""
        names = self._names
        visible = [name for name in names.in_order if name not in ("self", "cls")]
        if not names.any_name:
            for name in kwargs:
                if name not in names.all:
                    first = args[0] if args else None
                    return leads.about_keyword(function, name, visible, first)
        positional = [name for name in names.positional if name in visible]
        by_name = [name for name in visible if name not in positional]
        if not names.any_number and len(args) > len(names.positional):
            # (An argument that does not fit tells more than their number.)
            self.take(args[: len(names.positional)], {})
            taken = ", ".join(f"`{name}`" for name in positional)
            first = f"{function} takes {taken or 'nothing'} by position"
            if not by_name:
                return f"{first}, and no more."
            named = ", ".join(f"`{name}`" for name in by_name)
            return f"{first}; give others by name: {named}."
        given = {*kwargs, *names.positional[: len(args)]}
        # (An argument that does not fit tells more than one that is missing.)
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
    def _names(self) -> "_Names":
        return _Names.of(inspect.signature(self.function))


class _Names(NamedTuple):
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
    def of(cls, signature: inspect.Signature) -> "_Names":
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


def _fits(kind: Kind, value: Any) -> bool:
    try:
        kind.take(value)
    except Misfit:
        return False
    return True


class _Fields(_Kinds):
    """The kinds of fields with converters."""

    def hints(self) -> dict[str, Any]:
        hints = self.function.__annotations__.items()
        return {name: x for name, x in hints if typing.get_origin(x) is Annotated}


_fields = Memory()
