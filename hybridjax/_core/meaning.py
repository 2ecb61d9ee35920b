"""Digests of what functions compute: their code, and all values that the code can read.

A user's function reads constants of a notebook, calls helpers and methods, and holds arrays. JAX
traces it once, and does not notice that one of these has changed. A digest of all of them does.
"""

import contextlib
import dis
import functools as ft
import hashlib
import inspect
import itertools
import os
import pathlib
import sys
import sysconfig
import types
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import DefinitionError
from .executor import Definition, is_tracer
from .memo import Memory


# Names by which code reads values that are not named in it.
_HIDDEN = frozenset(("eval", "exec", "globals", "__import__"))
_PLAIN = bool, int, float, complex, str, bytes, type(None), type(Ellipsis), range
_PACKAGE = str(pathlib.Path(__file__).parents[1])
_MODELS = os.path.join(_PACKAGE, "models")
_FOLDERS = _PACKAGE, *(sysconfig.get_paths()[x] for x in ("stdlib", "platstdlib", "purelib"))


Thing = TypeVar("Thing")
Names = tuple[str, ...]


def current(x: Thing) -> Thing:
    """Return a `Definition` with the digest of its code as it is now; other things as they are.

    **Raises:** `DefinitionError`, as `meaning`.
    """
    if not isinstance(x, Definition):
        return x
    digest, thing = code_digest(x), cast(Any, x)
    return thing if x.code_digest == digest else _marked.recall(x, digest, lambda: _mark(x, digest))


def _mark(x: Any, digest: str) -> Any:
    leaves, structure = jax.tree_util.tree_flatten(x)
    marked = jax.tree_util.tree_unflatten(structure, leaves)
    object.__setattr__(marked, "code_digest", digest)
    return marked


_marked = Memory()  # an object that is given again has the same copy, which others may remember


def code_digest(x: Definition) -> str:
    """Return the digest of all of a definition but the values of its arrays.

    **Raises:** `DefinitionError`, as `meaning`.
    """
    return meaning(jax.tree_util.tree_map(lambda x: None if eqx.is_array(x) else x, x))


def meaning(*things: Any) -> str:
    """Return a digest of functions, classes and objects: of their code, and of all values that they
    read. Two of the same digest compute the same.

    Installed packages are known by the names of their functions; what users replace in them is not
    noticed, except in `hybridjax.models`.

    **Raises:** `DefinitionError` if code calls `eval`, `exec`, `globals` or `__import__`.
    """
    walk = _Walk()
    walk.visit_all(things)
    return walk.digest.hexdigest()


class _Walk:
    def __init__(self):
        self.digest = hashlib.blake2b(digest_size=16)
        self.number: dict[int, int] = {}
        self.alive: list[Any] = []  # an id belongs to an object while this lives

    def note(self, *words: Any) -> None:
        self.digest.update(repr(words).encode())

    def visit_all(self, things: Iterable[Any]) -> None:
        things = list(things)
        self.note(len(things))
        for x in things:
            self.visit(x)

    def visit(self, x: Any) -> None:
        if type(x) in _PLAIN:
            return self.note(type(x).__name__, x)
        if id(x) in self.number:
            return self.note(self.number[id(x)])
        self.number[id(x)] = len(self.number)
        self.alive.append(x)
        self.note(type(x).__qualname__)
        match x:
            case np.ndarray() | np.generic() | jax.Array():
                self._array(x)
            case types.FunctionType():
                self._function(x)
            case types.CodeType():
                self.note(x.co_code, x.co_names, x.co_varnames, x.co_freevars, x.co_argcount)
                self.visit_all(x.co_consts)
            case types.CellType():
                with contextlib.suppress(ValueError):  # an empty cell
                    self.visit(x.cell_contents)
            case type():
                self._class(x)
            case list() | tuple():
                self.visit_all(x)
            case set() | frozenset():
                self.note(sorted(map(meaning, x)))
            case property():
                self.visit_all((x.fget, x.fset))
            case types.MethodType():
                self.visit_all((x.__func__, x.__self__))
            case types.ModuleType() | types.BuiltinFunctionType():
                self.note(x.__name__)
            case _:
                self._object(x)

    def _array(self, x: Any) -> None:
        if is_tracer(x):
            return self.note(str(x.aval))
        is_key = isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        values = np.asarray(jax.random.key_data(x) if is_key else x)
        self.note(values.dtype.str, values.shape)
        if values.dtype.hasobject:
            self.visit_all(values.ravel().tolist())
        else:
            self.digest.update(values.tobytes())

    def _function(self, x: types.FunctionType) -> None:
        is_installed = is_of_package(x.__code__.co_filename)
        if is_installed:
            self.note(x.__module__, x.__qualname__)
        else:
            self.visit(x.__code__)
            self._globals(x)
        wrapped = getattr(x, "__wrapped__", None)
        # A wrapper of a package may remember what it has been called with.
        self.visit_all((wrapped,) if is_installed and wrapped else (x.__closure__ or ()))
        self.visit_all((x.__defaults__, x.__kwdefaults__))
        if not is_installed:
            self.visit({k: v for k, v in vars(x).items() if k != "__wrapped__"})

    def _globals(self, x: types.FunctionType) -> None:
        """Visit what a function, and the functions written in it, read of their module."""
        read, imported, names = _names(x.__code__)
        package = x.__globals__.get("__package__")
        modules = {x: sys.modules.get(x, sys.modules.get(f"{package}.{x}")) for x in imported}
        for name in (*read, *imported):
            value = modules[name] if name in modules else x.__globals__.get(name)
            if value is not None:
                self.note(name)
                self.visit(value)
                if isinstance(value, types.ModuleType):
                    self._attributes(value, names)
            elif name in _HIDDEN:
                raise DefinitionError(
                    f"`{x.__qualname__}` calls `{name}`, so that a change of the values that it "
                    "reads cannot be noticed: read them by their names."
                )

    def _attributes(self, module: types.ModuleType, names: Names) -> None:
        """Visit the attributes of a module that a function names."""
        for name in names:
            if name not in vars(module) and name not in _lazy_names(module):
                continue
            value = getattr(module, name)
            if _is_installed(module.__name__) and callable(value):
                continue
            is_new = id(value) not in self.number
            self.note(name)
            self.visit(value)
            if isinstance(value, types.ModuleType) and is_new:
                self._attributes(value, names)

    def _class(self, x: type) -> None:
        for base in inspect.getmro(x):
            self.note(base.__module__, base.__qualname__)
            if not _is_installed(base.__module__):
                self.visit({k: v for k, v in vars(base).items() if not _is_description(k, v)})

    def _object(self, x: Any) -> None:
        self.visit(type(x))
        if isinstance(x, Mapping):
            self.visit_all(part for item in x.items() for part in item)
        is_wrapped = isinstance(x, eqx.Module) or hasattr(x, "__wrapped__")
        if _is_installed(type(x).__module__) and not is_wrapped:
            with contextlib.suppress(Exception):  # whatever an object raises that cannot be pickled
                _, arguments, *parts = x.__reduce_ex__(4)
                state, *items = parts or [None]
                return self.visit_all([arguments, state, *(list(y or ()) for y in items)])
        items = sorted(getattr(x, "__dict__", {}).items())
        state = {k: v for k, v in items if not _is_description(k, v)}
        if isinstance(x, Definition):
            state.pop("code_digest", None)
        self.visit_all((state, getattr(x, "__wrapped__", None)))
        slots = [vars(base).get("__slots__", ()) for base in type(x).__mro__]
        names = [y for z in slots for y in ((z,) if isinstance(z, str) else z)]
        self.visit_all(getattr(x, y, None) for y in names if y not in ("__dict__", "__weakref__"))


@ft.lru_cache(4096)
def _names(code: types.CodeType) -> tuple[Names, Names, Names]:
    """Global names that code reads, modules that it imports, and all names and words in it, with
    those of the functions that are written in it."""
    steps = [(step.opname, step.argval) for step in dis.get_instructions(code)]
    read = [x for name, x in steps if name == "LOAD_NAME" or name.startswith("LOAD_GLOBAL")]
    imported = [x for name, x in steps if name == "IMPORT_NAME"]
    words = [x for x in code.co_consts if isinstance(x, str) and x.isidentifier()]
    inner = [_names(x) for x in code.co_consts if isinstance(x, types.CodeType)]
    every = zip((read, imported, [*code.co_names, *words]), *inner, strict=True)
    read, imported, names = (tuple(dict.fromkeys(itertools.chain(*x))) for x in every)
    return read, imported, names


def _is_description(name: str, value: Any) -> bool:
    """Test for attributes that Python and its tools add to classes and objects."""
    return name == "_abc_impl" or (name.startswith("__") and not callable(value))


@ft.cache
def _lazy_names(module: types.ModuleType) -> frozenset[str]:
    """Names that a package imports when they are used."""
    return frozenset(dir(module)) if hasattr(module, "__getattr__") else frozenset()


def _is_installed(module: str | None) -> bool:
    name = module or "builtins"
    if name.startswith("hybridjax.models"):
        return False
    root = name.partition(".")[0]
    path = getattr(sys.modules.get(root), "__file__", None)
    return root in sys.stdlib_module_names or (path is not None and is_of_package(path))


@ft.cache
def is_of_package(path: str) -> bool:
    """Test whether a file belongs to Python or to a package, `hybridjax.models` excepted."""
    return path.startswith(_FOLDERS) and not path.startswith(_MODELS)
