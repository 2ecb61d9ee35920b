"""Errors about attributes of public objects: one that is missing, one that a user sets, and a
method that is used without calling it. Each message says in one line what to do instead.

`checked.py` and `showable.py` put these functions into public classes.

A missing attribute must stay an `AttributeError` (`UnknownAttribute` is one), and one whose name
begins with an underscore a plain one: Python and JAX ask for many that are not there. A `Method`
must stay a pytree whose child is its object, as equinox binds methods.

If a message leads to the wrong attribute, look at `leads.py`; if a property is said to be missing,
at the error that it raises (`missing_attribute`); if a result can be changed, whether its class has
`fixed_attribute`; if a method prints all numbers of its object, whether its class was given to
`bind_methods` or `checked_methods`.
"""

import dataclasses
import functools
import inspect
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx

from ..exceptions import HybridJaxError, UnknownAttribute
from . import leads
from .values import with_article


Class = TypeVar("Class", bound=type)


class FixedAttribute(HybridJaxError, dataclasses.FrozenInstanceError):
    """An attribute that a user sets, of an object that does not change."""


def missing_attribute(self: Any, name: str) -> Any:
    """`__getattr__` of public classes: an error that leads on."""
    if name.startswith("_"):
        raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
    if inspect.getattr_static(type(self), name, None) is not None:
        # A property raised an AttributeError, which Python hides: it is raised again.
        return object.__getattribute__(self, name)
    about = functools.partial(leads.about_attribute, type(self), name, self)
    raise UnknownAttribute(about)


class _Leading(type(eqx.Module)):  # type: ignore[misc]  # (It has no public name.)
    """The class of classes whose missing constructors lead on, such as `Recording.from_csv`."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("_") or name in leads.attributes_of(cls):
            # (Fields are attributes of objects, and not of their class.)
            raise AttributeError(
                f"type object {cls.__name__!r} has no attribute {name!r}"
            )
        raise UnknownAttribute(functools.partial(leads.about_attribute, cls, name))


if TYPE_CHECKING:
    # (This class tells checkers of types that modules are dataclasses; they do not pass it on to
    # the classes that are made of it.)
    from equinox._module._module import _ModuleMeta as Leading
else:
    Leading = _Leading


def leading_on(cls: Class) -> Class:
    """A class whose missing attributes lead on: a small part of a result."""
    setattr(cls, "__getattr__", missing_attribute)  # noqa: B010
    return cls


def fixed_attribute(self: Any, name: str, value: Any) -> None:
    """`__setattr__` of public classes: constructors set attributes, and nobody else does."""
    is_module = isinstance(self, eqx.Module)
    assign = eqx.Module.__setattr__ if is_module else object.__setattr__
    try:
        assign(self, name, value)
    except dataclasses.FrozenInstanceError:
        raise FixedAttribute(leads.about_setting(self, name, value)) from None


class Method(eqx.Module):
    """A method with its object, as equinox binds methods: a pytree whose child is the object. It
    prints how to call it. (That of equinox prints all numbers of the object.)"""

    __func__: Callable = eqx.field(static=True)
    __self__: eqx.Module

    def __post_init__(self):
        for name in ("__doc__", "__name__", "__qualname__"):
            setattr(self, name, getattr(self.__func__, name))

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self.__func__(self.__self__, *args, **options)

    def __get__(self, instance: Any, owner: Any = None) -> "Method":
        # (`help` takes an object for a method, and shows its signature, if it has a `__get__`.)
        return self

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"'Method' object has no attribute {name!r}")
        method = self.__func__.__name__
        raise AttributeError(
            f"`{method}` is a method: call it, as in `{method}().{name}`."
        )

    def __repr__(self) -> str:
        kept = list(inspect.signature(self.__wrapped__).parameters.values())
        given = [str(x.replace(annotation=x.empty)) for x in kept]
        name = self.__func__.__name__
        owner = with_article(type(self.__self__).__name__)
        return f"<method of {owner}: call it, as in `.{name}({', '.join(given)})`>"

    @property
    def __wrapped__(self) -> Callable:
        return self.__func__.__get__(self.__self__, type(self.__self__))


class Bound:
    """A public method: of the class the function, of an equinox module a `Method`, and of other
    objects as Python binds it."""

    def __init__(self, function: Callable):
        self.__func__ = function
        self.__doc__ = function.__doc__

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        if instance is None:
            return self.__func__
        if isinstance(instance, eqx.Module):
            return Method(self.__func__, instance)
        return types.MethodType(self.__func__, instance)


def bind_methods(cls: type) -> None:
    """Make the public methods of a class `Bound`."""
    for name, member in list(vars(cls).items()):
        is_method = inspect.isfunction(member) and not name.startswith("_")
        if is_method and not getattr(member, "__isabstractmethod__", False):
            setattr(cls, name, Bound(member))
