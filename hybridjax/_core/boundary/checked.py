"""The boundary between users and this package: what public functions take is checked there."""

import functools
import inspect
import sys
import typing
from collections.abc import Callable
from typing import Annotated, Any, TypeVar, cast

import jax

from ...errors import DefinitionError
from ..executor import is_inside_program, is_traced
from ..memo import Memory
from .kinds import kind_of
from .values import Kind, Misfit


Thing = TypeVar("Thing", bound=Callable)
Class = TypeVar("Class", bound=type)

_JAX_ERRORS = jax.errors.JAXTypeError, jax.errors.JAXIndexError


class NeedsValues(DefinitionError):
    """A function that needs values was called where JAX knows none."""


def checked(thing: Thing) -> Thing:
    """A public function whose arguments are checked against its annotations when it is called; a
    class whose constructor and public methods are.

    What does not fit is refused with one sentence, which names the function, the argument, what
    is allowed and what was given. What fits is handed on in one form: see `Kind.take`. Defaults
    are not checked, nor are arguments without annotation, or with `Any`. Arguments that are
    missing, too many or unknown are left to Python.

    How a call is put right if JAX transforms it: numbers, words and switches refuse to be traced;
    arrays (`Reals`) may be, and their values are then not looked at. Where a function needs values
    nevertheless, JAX's error becomes one sentence that says so.

    It stands above all other decorators, except `classmethod` and `staticmethod`.
    """
    if not isinstance(thing, type):
        return cast(Thing, _wrapped(thing, thing.__qualname__))
    maker = "__new__" if issubclass(thing, tuple) else "__init__"
    if maker in vars(thing):
        setattr(thing, maker, _wrapped(getattr(thing, maker), thing.__name__, thing))
    return cast(Thing, checked_methods(thing))


def checked_methods(cls: Class) -> Class:
    """A class whose public methods are checked, but not its constructor: results, which this
    package makes, and JAX."""
    for name, member in list(vars(cls).items()):
        if name.startswith("_") and name not in ("__call__", "__getitem__"):
            continue
        function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if not inspect.isfunction(function) or getattr(function, "__isabstractmethod__", False):
            continue
        wrapped = _wrapped(function, f"{cls.__name__}.{name}")
        setattr(cls, name, type(member)(wrapped) if function is not member else wrapped)
    return cls


def check_fields(cls: type, args: tuple, kwargs: dict[str, Any]) -> None:
    """Check what the constructor of a class is given for those of its fields whose converters say
    by a `Kind` what they take. (Its other annotations are its author's business.)

    **Raises:** `DefinitionError`.
    """
    constructor = cls.__init__  # type: ignore[misc]
    fields = _fields.recall(cls, None, lambda: _Fields(constructor, cls))
    try:
        fields.take((None, *args), dict(kwargs))
    except Misfit as misfit:
        raise DefinitionError(f"{cls.__name__}: `{misfit.path}` {misfit.problem}.") from None


def _wrapped(function: Callable, name: str, cls: type | None = None) -> Callable:
    kinds = _Kinds(function, cls)

    @functools.wraps(function)
    def call(*args, **kwargs):
        try:
            args, kwargs = kinds.take(args, kwargs)
            return function(*args, **kwargs)
        except Misfit as misfit:
            raise DefinitionError(f"{name}: `{misfit.path}` {misfit.problem}.") from None
        except (*_JAX_ERRORS, NeedsValues):
            if not is_traced(args, kwargs) and not is_inside_program():
                raise
        raise NeedsValues(
            f"{name} needs values, but JAX traces them here: call it outside of jit, vmap and grad."
        )

    setattr(call, "kinds", kinds)  # noqa: B010 (that of a function is not declared)
    return call


class _Kinds:
    """What a function's parameters may be, found out at its first call, when all names that its
    annotations use are known."""

    def __init__(self, function: Callable, cls: type | None):
        self.function, self.cls = function, cls

    @functools.cached_property
    def by_name(self) -> dict[str, Kind | None]:
        """Kinds of all parameters that can be given by name."""
        where = vars(sys.modules[self.cls.__module__]) if self.cls else None
        hints = typing.get_type_hints(self.function, where, include_extras=True)
        kinds = {}
        for name, parameter in inspect.signature(self.function).parameters.items():
            hint = hints.get(name, Any)
            if parameter.kind is not parameter.VAR_KEYWORD:
                kinds[name] = kind_of(hint)
            elif typing.get_origin(hint) is typing.Unpack:
                options = typing.get_type_hints(typing.get_args(hint)[0], include_extras=True)
                kinds |= {option: kind_of(hint) for option, hint in options.items()}
        return kinds

    @functools.cached_property
    def in_order(self) -> tuple[tuple[str, Kind | None], ...]:
        """Names and kinds of those that can be given by position."""
        parameters = inspect.signature(self.function).parameters.values()
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        return tuple((p.name, self.by_name[p.name]) for p in parameters if p.kind in positional)

    @functools.cached_property
    def variadic(self) -> tuple[str, Kind | None]:
        """Name and kind of all further ones: `*args`."""
        for parameter in inspect.signature(self.function).parameters.values():
            if parameter.kind is parameter.VAR_POSITIONAL:
                return parameter.name, self.by_name[parameter.name]
        return "", None

    def take(self, args: tuple, kwargs: dict[str, Any]) -> tuple[list, dict[str, Any]]:
        """The arguments in the form in which the function gets them.

        **Raises:** `Misfit` for the first that does not fit.
        """
        taken, name = [], ""
        try:
            for (name, kind), value in zip(self.in_order, args, strict=False):  # noqa: B007
                taken.append(value if kind is None else kind.take(value))
            for value in args[len(taken) :]:
                name, kind = self.variadic
                taken.append(value if kind is None else kind.take(value))
            for name, value in kwargs.items():
                kind = self.by_name.get(name)
                kwargs[name] = value if kind is None else kind.take(value)
        except Misfit as misfit:
            raise misfit.of(name) from None
        return taken, kwargs


class _Fields(_Kinds):
    """What fields with converters may be."""

    @functools.cached_property
    def by_name(self) -> dict[str, Kind | None]:
        hints = self.function.__annotations__
        kinds = dict.fromkeys(inspect.signature(self.function).parameters)
        annotated = {
            name: kind_of(x) for name, x in hints.items() if typing.get_origin(x) is Annotated
        }
        return kinds | annotated


_fields = Memory()
