"""The decorators of public functions and classes: `checked`, `checked_methods`, `check_fields`.

A *kind* describes the values that an argument may have; annotations stand for kinds (`kinds.py`).
A call of a decorated function goes through `_wrapped`, in this order:

1. Arguments that are unknown, too many or too few raise `WrongArguments`.
2. Where JAX traces a program but none of the arguments, the call is computed now (`_constant`).
3. Each argument is brought to the form of its kind (`parameters.py`), or a `DefinitionError` of one
   sentence is raised. The function is called.
4. An error of JAX because it traces what the function needs becomes `NeedsValues`.

A function or class that users call gets `checked`; a result, whose constructor only this package
calls, `checked_methods`; the constructor of a user's own system calls `check_fields`. The order of
the steps must stay: step 2 leaves the traced program, so that step 3 sees values.

If a good argument is refused, or a bad one taken, look at its kind (`kinds.py`); if the end of a
message leads to the wrong thing, at `leads.py`; if `NeedsValues` is raised without need, at what
the function does with values, and at `_is_constant`.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

import equinox as eqx
import jax

from .. import jax_compat
from ..call import public_call
from ..exceptions import DefinitionError
from ..executor import as_numpy, is_hidden, is_inside_program, is_traced
from ..memo import Memory
from . import leads
from .members import Bound, fixed_attribute, missing_attribute
from .parameters import Fields, Parameters
from .signature import ShortSignature
from .values import Misfit


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

    The error for an argument that does not fit names the function, the argument, what is allowed
    and what was given. What fits is handed on in one form: see `Kind.take`. Defaults are not
    checked, nor are arguments without annotation, or with `Any`. Errors suggest what may have been
    meant (`leads.py`, `words.py`).

    If JAX transforms a call: numbers, words and switches must not be traced; arrays (`Reals`) may
    be, and their values are then not looked at.

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
    fields = _fields.recall(cls, None, lambda: Fields(constructor, cls))
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
    kinds: Parameters = getattr(function, "kinds")  # noqa: B009
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
    """A function whose calls take the steps above.

    **Arguments:** `name`: of the function in errors. `cls`: its class, if it is a constructor.
    """
    kinds = Parameters(function, cls)

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


def _constant(kinds: Parameters, args: tuple, kwargs: dict[str, Any]) -> Any:
    """The result of a call that does not depend on what JAX traces. It is computed now and enters
    the program as a constant, so that code which needs its values has them."""
    try:
        with jax_compat.outside():
            return kinds.call(args, dict(kwargs))
    except jax.errors.UnexpectedTracerError:
        # (A function among the arguments reads a value that JAX traces.)
        return kinds.call(args, kwargs)


_fields = Memory()
"""The fields of classes whose constructors check them."""
