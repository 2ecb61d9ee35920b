"""Digests of what functions compute: their code, and all values that the code can read.

A user's function reads constants of a notebook, calls helpers and methods, and holds arrays. JAX
traces it once, and does not notice that one of these has changed. A digest of all of them does.
"""

import builtins
import contextlib
import contextvars
import dis
import functools as ft
import hashlib
import importlib.metadata
import inspect
import itertools
import os
import pathlib
import re
import sys
import sysconfig
import types
import weakref
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import DefinitionError
from .executor import Definition, is_tracer
from .memo import Memory


# Functions by which code reads values that are not named in it, and functions that read files.
_HIDDEN = re.compile(
    "eval|exec|globals|__import__|import_module|getenv|check_output|urlopen"
)
_READING = re.compile(
    "open|(read|open|load)_.+|load|loadtxt|loadmat|genfromtxt|fromfile|memmap"
)
_FRAMES = {"__globals__", "f_globals", "f_locals"}
_PLAIN = bool, int, float, complex, str, bytes, type(None), type(Ellipsis), range
_PACKAGE = os.path.join(pathlib.Path(__file__).parents[1], "")
_MODELS = os.path.join(_PACKAGE, "models")
_FOLDERS = _PACKAGE, *(sysconfig.get_paths()[x] for x in ("stdlib", "platstdlib"))
# Packages of a user and of a distribution lie elsewhere than those of Python.
_INSTALLED = re.compile(
    "|".join([*map(re.escape, _FOLDERS), r".*[\\/](site|dist)-packages[\\/]"])
)


Thing = TypeVar("Thing")
Names = tuple[str, ...]
"""Also a global name with the attributes that code reads of it: `("np", "linalg", "norm")`."""


def current(x: Thing) -> Thing:
    """Return a `Definition` with the digest of its code as it is now; other things as they are.

    **Raises:** `DefinitionError`, as `meaning`.
    """
    if not isinstance(x, Definition):
        return x
    digest, thing = code_digest(x), cast(Any, x)
    return (
        thing
        if x.code_digest == digest
        else _marked.recall(x, digest, lambda: _mark(x, digest))
    )


def _mark(x: Any, digest: str) -> Any:
    leaves, structure = jax.tree_util.tree_flatten(x)
    marked = jax.tree_util.tree_unflatten(structure, leaves)
    object.__setattr__(marked, "code_digest", digest)
    return marked


_marked = (
    Memory()
)  # an object that is given again has the same copy, which others may remember


def code_digest(x: Definition) -> str:
    """Return the digest of all of a definition but the values of its arrays.

    If a function computes something else than when it was last seen, JAX's caches are cleared.

    **Raises:** `DefinitionError`, as `meaning`.
    """
    digests: dict[tuple, str] | None = _of_call.get(None)
    leaves, structure = jax.tree_util.tree_flatten(x)
    key = structure, *(None if eqx.is_array(y) else (type(y), y) for y in leaves)
    with contextlib.suppress(TypeError):  # (something in it has no hash)
        if digests is not None and key in digests:
            return digests[key]
    walk = _Walk(jax.tree_util.tree_map(lambda x: None if eqx.is_array(x) else x, x))
    _clear_old_traces(walk.alive, walk.result)
    with contextlib.suppress(TypeError):
        if digests is not None:
            digests[key] = walk.result
    return walk.result


_of_call: contextvars.ContextVar[dict[tuple, str]] = contextvars.ContextVar("of_call")


@contextlib.contextmanager
def unchanged_code() -> Iterator[None]:
    """A context of a single call, in which definitions that differ in arrays only have one digest.
    (Thousands of systems of a sweep are given at once.)"""
    token = _of_call.set({})
    try:
        yield
    finally:
        _of_call.reset(token)


_JITTED: Any = type(jax.jit(len))
# Of functions, since JAX's caches were last cleared: their digests by those of definitions.
_meanings: weakref.WeakKeyDictionary[Any, dict[str, str]] = weakref.WeakKeyDictionary()


def _clear_old_traces(things: Iterable[Any], definition: str) -> None:
    """Clear JAX's caches if a function, or an object whose method is one, has changed: `jax.jit`,
    `lax.cond`, `lax.scan` and others remember the trace of a function by its identity."""
    now: dict[Any, dict[str, str]] = {}
    for x in filter(_is_traced_by_identity, things):
        seen = _meanings.setdefault(x, {})
        if not seen and isinstance(x, _JITTED):
            x.clear_cache()  # which a call by the user may have filled
        if definition not in seen:
            seen[definition] = _Walk(
                x, classes=1
            ).result  # (hidden reads have been refused before)
        now[x] = {definition: seen[definition]}
    if any(len({*_meanings[x].values()}) > 1 for x in now):
        _meanings.clear()
        _meanings.update(now)
        jax.clear_caches()


def _is_traced_by_identity(x: Any) -> bool:
    # (A function of `exec` without a `__name__` has no module.)
    module = getattr(x, "__module__", None) or "exec" * isinstance(
        x, types.FunctionType
    )
    by_identity = type(x).__hash__ is object.__hash__ and bool(
        type(x).__weakrefoffset__
    )
    return by_identity and (isinstance(x, _JITTED) or not is_packaged(module))


def meaning(*things: Any) -> str:
    """Return a digest of functions, classes and objects: of their code, and of all values that they
    read. Two of the same digest compute the same.

    Installed packages are known by their versions and the names of their functions; what users
    replace in them is not noticed, except in `hybridjax.models`.

    **Raises:** `DefinitionError` if code uses `eval`, `exec`, `globals`, `__import__`,
    `import_module`, `sys.modules` or `getenv`, or if a function that is no method reads a file.
    """
    return _Walk(*things).result


class _Walk:
    def __init__(self, *things: Any, classes: int = 0):
        self.digest = hashlib.blake2b(digest_size=16)
        self.number: dict[int, int] = {}
        self.attributes: set[tuple[int, Names]] = set()
        self.classes = classes  # around what is visited
        self.alive: list[Any] = []  # an id belongs to an object while this lives
        self.visit_all(things)
        self.result = self.digest.hexdigest()

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
            case list() | tuple():
                self.visit_all(x)
            case dict() if type(x) is dict:
                self.visit_all(part for item in x.items() for part in item)
            case types.FunctionType():
                self._function(x)
            case types.CodeType():
                self.note(_code(x))
            case np.ndarray() | np.generic() | jax.Array():
                self._array(x)
            case types.CellType():
                with contextlib.suppress(ValueError):  # an empty cell
                    self.visit(x.cell_contents)
            case type():
                self._class(x)
            case set() | frozenset():
                self.note(sorted(map(meaning, x)))
            case property():
                self.visit_all((x.fget, x.fset))
            case types.MethodType():
                self.visit_all((x.__func__, x.__self__))
            case types.ModuleType():  # read by other means than the names of its attributes
                self._origin(x.__name__)
                self.visit(type(x))
                if not is_packaged(x.__name__):
                    self.visit(
                        {k: v for k, v in vars(x).items() if not _is_description(k, v)}
                    )
            case types.BuiltinFunctionType():
                self.note(x.__name__)
                if not isinstance(x.__self__, types.ModuleType):
                    self.visit(x.__self__)
            case weakref.ref():
                self.visit(x())
            case contextvars.ContextVar():
                with contextlib.suppress(LookupError):  # of one that is not set
                    self.visit(x.get())
            case memoryview():
                self.note(x.format, x.shape, x.tobytes())
            case _:
                self._object(x)

    def _array(self, x: Any) -> None:
        if is_tracer(x):
            return self.note(str(x.aval))
        is_key = isinstance(x, jax.Array) and jnp.issubdtype(
            x.dtype, jax.dtypes.prng_key
        )
        values = np.asarray(jax.random.key_data(x) if is_key else x)
        self.note(values.dtype.str, values.shape)
        if values.dtype.hasobject:
            self.visit_all(values.ravel().tolist())
        else:
            self.digest.update(values.tobytes())
        if isinstance(x, np.ndarray):
            self.visit(getattr(x, "__dict__", None))  # of a subclass: a mask

    def _origin(self, module: Any, *words: Any) -> None:
        self.note(str(module), _version(str(module).partition(".")[0]), *words)

    def _function(self, x: types.FunctionType) -> None:
        if is_installed := is_of_package(x.__code__.co_filename):
            self._origin(x.__module__, x.__qualname__)
        else:
            self.visit(x.__code__)
            self._globals(x)
        wrapped = getattr(x, "__wrapped__", None)
        # A wrapper of a package may remember what it has been called with.
        registered = vars(x).get(
            "registry"
        )  # the functions of one that dispatches by type
        self.visit_all(
            (wrapped, registered) if is_installed and wrapped else x.__closure__ or ()
        )
        self.visit_all((x.__defaults__, x.__kwdefaults__))
        if not is_installed:
            self.visit({k: v for k, v in vars(x).items() if k != "__wrapped__"})

    def _globals(self, x: types.FunctionType) -> None:
        """Visit what a function, and the functions written in it, read of their module."""
        paths, imported, names = _names(x.__code__)
        package = x.__globals__.get("__package__")
        modules = {
            x: sys.modules.get(x, sys.modules.get(f"{package}.{x}")) for x in imported
        }
        if _FRAMES & {*names}:
            self._refuse_hidden(x, (), globals)
        if not self.classes and {"read_text", "read_bytes"} & {*names}:
            self._refuse_hidden(x, (), pathlib.Path.read_text)
        for path in (*paths, *((name, "") for name in imported)):
            value = (
                modules[path[0]] if path[0] in modules else x.__globals__.get(path[0])
            )
            builtin = getattr(builtins, path[0], None)
            self._refuse_hidden(x, path, builtin if value is None else value)
            if value is None:
                continue
            self.note(path[0])
            if isinstance(value, types.ModuleType):
                self._attributes(value, names)
            if (
                not isinstance(value, types.ModuleType)
                or path[1:] == ()
                or path[1][:2] == "__"
            ):
                self.visit(value)

    def _refuse_hidden(self, x: types.FunctionType, path: Names, value: Any) -> None:
        for name in path[1:]:
            if isinstance(value, types.ModuleType):
                value = getattr(value, name, None)
        name = str(getattr(value, "__name__", "")) if callable(value) else ""
        is_hidden = _HIDDEN.fullmatch(name) or (
            not self.classes and _READING.fullmatch(name)
        )
        is_hidden = is_hidden and is_packaged(getattr(value, "__module__", None))
        if is_hidden or value is sys.modules:
            text = f"uses `{name or 'sys.modules'}`, whose changes cannot be noticed"
            raise DefinitionError(
                f"`{x.__qualname__}` {text}: read values before, by their names."
            )

    def _attributes(self, module: types.ModuleType, names: Names) -> None:
        """Visit the attributes of a module that a function names."""
        if (id(module), names) in self.attributes:
            return
        self.attributes.add((id(module), names))
        self._origin(module.__name__)
        self.visit(type(module))
        is_installed = is_packaged(module.__name__)
        if not is_installed and hasattr(module, "__getattr__"):
            self.visit(module)
        for name in names:
            if name not in vars(module) and name not in _lazy_names(module):
                continue
            value = getattr(module, name)
            if is_installed and callable(value):
                continue
            self.note(name)
            if isinstance(value, types.ModuleType):
                self._attributes(value, names)
            else:
                self.visit(value)

    def _class(self, x: type) -> None:
        self.classes += 1
        for base in inspect.getmro(x):
            module = str(base.__module__)  # (of a metaclass it may be a descriptor)
            self._origin(module, base.__qualname__)
            # (A class of `exec` without a `__name__` has the module of Python's own.)
            if not is_packaged(module) or (
                module == "builtins" and "__module__" in vars(base)
            ):
                self.visit(
                    {k: v for k, v in vars(base).items() if not _is_description(k, v)}
                )
        self.visit(type(x))
        self.classes -= 1

    def _object(self, x: Any) -> None:
        self.visit(type(x))
        if isinstance(x, Mapping):
            self.visit_all(part for item in x.items() for part in item)
        is_wrapped = isinstance(x, eqx.Module) or hasattr(x, "__wrapped__")
        if is_packaged(type(x).__module__) and not is_wrapped:
            parts = None
            with contextlib.suppress(
                Exception
            ):  # whatever an object raises that cannot be pickled
                parts = [
                    list(y) if isinstance(y, Iterator) else y
                    for y in x.__reduce_ex__(4)[1:]
                ]
            if parts is not None:
                return self.visit_all(parts)
        items = sorted(getattr(x, "__dict__", {}).items())
        state = {k: v for k, v in items if not _is_description(k, v)}
        if isinstance(x, Definition):
            state.pop("code_digest", None)
        self.visit_all((state, getattr(x, "__wrapped__", None)))
        slots = [vars(base).get("__slots__", ()) for base in type(x).__mro__]
        names = [y for z in slots for y in ((z,) if isinstance(z, str) else z)]
        self.visit_all(
            getattr(x, y, None) for y in names if y not in ("__dict__", "__weakref__")
        )


@ft.lru_cache(4096)
def _code(code: types.CodeType) -> str:
    names = (code.co_names, code.co_varnames, code.co_freevars)
    return meaning(code.co_code, *names, code.co_argcount, *code.co_consts)


@ft.lru_cache(4096)
def _names(code: types.CodeType) -> tuple[tuple[Names, ...], Names, Names]:
    """Global names that code reads, modules that it imports, and all names and words in it, with
    those of the functions that are written in it."""
    paths: list[Names] = []
    is_open = False  # whether the next step may read an attribute of the last name
    for step in dis.get_instructions(code):
        if step.opname == "LOAD_NAME" or step.opname.startswith("LOAD_GLOBAL"):
            paths.append((step.argval,))
        elif is_open and step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            paths[-1] += (step.argval,)
        elif step.opname != "CACHE":
            is_open = False
            continue
        is_open = True
    imported = [
        x.argval for x in dis.get_instructions(code) if x.opname == "IMPORT_NAME"
    ]
    words = [x for x in code.co_consts if isinstance(x, str) and x.isidentifier()]
    inner = [_names(x) for x in code.co_consts if isinstance(x, types.CodeType)]
    every: Any = zip((paths, imported, [*code.co_names, *words]), *inner, strict=True)
    parts: Any = tuple(tuple(dict.fromkeys(itertools.chain(*x))) for x in every)
    return parts


@ft.cache
def _version(package: str) -> str:
    """Return the version of an installed package, "" for others and Python's own."""
    try:
        return (
            ""
            if package in sys.stdlib_module_names
            else importlib.metadata.version(package)
        )
    except (importlib.metadata.PackageNotFoundError, ValueError):  # or no name
        return str(getattr(sys.modules.get(package), "__version__", ""))


def _is_description(name: str, value: Any) -> bool:
    """Test for attributes that Python and its tools add to classes and objects."""
    return name == "_abc_impl" or (name.startswith("__") and not callable(value))


@ft.cache
def _lazy_names(module: types.ModuleType) -> frozenset[str]:
    """Names that a package imports when they are used."""
    return frozenset(dir(module)) if hasattr(module, "__getattr__") else frozenset()


def is_packaged(module: str | None) -> bool:
    """Test whether a module belongs to Python or to a package, `hybridjax.models` excepted."""
    name = module or "builtins"
    if name.startswith("hybridjax.models"):
        return False
    root = name.partition(".")[0]
    path = getattr(sys.modules.get(root), "__file__", None)
    return root in sys.stdlib_module_names or (path is not None and is_of_package(path))


@ft.cache
def is_of_package(path: str) -> bool:
    """Test whether a file belongs to Python or to a package, `hybridjax.models` excepted."""
    file = pathlib.Path(path)
    recorded = (file.parts[-k] in _recorded(x) for k, x in enumerate(file.parents, 1))
    return not path.startswith(_MODELS) and (
        _INSTALLED.match(path) is not None or any(recorded)
    )


@ft.cache
def _recorded(folder: pathlib.Path) -> frozenset[str]:
    """Names of what pip has put into a folder (with `--target`)."""
    records = [
        x.read_text("RECORD")
        for x in importlib.metadata.distributions(path=[str(folder)])
    ]
    return frozenset(
        re.split("[/,]", y)[0] for x in records for y in (x or "").splitlines()
    )
