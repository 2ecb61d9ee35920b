"""A reading: a list of all code and values that a function or an object can reach, with one digest.

A digest is a short text that is equal for equal content. If the digest is the same as before, and
nothing was left unread, then nothing has changed. If it differs, the function may still compute the
same: `meaning.py`, which calls this module, then compares traces.

What is not read must be listed in `unread`, never left out; and a digest must be the same in every
process, so no address or order of a set may enter. A further type of objects is a method of
`Reading` and a line in `_OF_THIS_TYPE` or `_OF_SUBTYPES`; a package whose functions depend on their
arguments only is a name in `_PURE`.

If a change of a value is not noticed, look at the method that reads objects of its type
(`_reader_of`), then at `_PURE`; if a function is refused without need, at `_suspect` and
`_is_hidden` with the words in `_HIDDEN` and `_FILES`; if a system is traced at each call, at its
`unread`; if a user's file counts as one of a package, or the reverse, at `is_of_package`.
"""

import builtins
import contextlib
import contextvars
import dis
import functools as ft
import hashlib
import importlib.metadata
import importlib.util
import inspect
import itertools
import os
import pathlib
import random
import re
import sys
import sysconfig
import threading
import types
import weakref
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from .executor import is_tracer
from .programs import digest_of_array


_PLAIN = bool, int, float, complex, str, bytes, type(None), type(Ellipsis), range, slice
# Objects of these types that are no more than their values, if a class is made of them.
_VALUES: tuple[Any, ...] = bool, int, float, complex, str, bytes
_JITTED: Any = type(jax.jit(len))

# Functions that read files, the names of values, or the system.
_HIDDEN = re.compile(
    "eval|exec|globals|__import__|import_module|getenv|check_output|urlopen|popen"
)
_FILES = re.compile(
    "open|(read|open|load)_.+|load|loadtxt|loadmat|genfromtxt|fromfile|memmap|fromregex"
)
_FRAMES = frozenset(("__globals__", "f_globals", "f_locals"))
_FILE_METHODS = frozenset(("read_text", "read_bytes"))
# Built-in functions whose result depends on more than the values that are read here.
_UNSURE = frozenset(
    "open eval exec globals locals vars dir getattr hasattr __import__ input compile id hash "
    "breakpoint memoryview".split()
)
# Packages and modules whose functions compute from their arguments only, but for those above and
# the ones with these names.
_PURE = frozenset(
    "builtins math cmath operator _operator functools _functools itertools dataclasses typing "
    "collections _collections abc enum numbers fractions decimal string re reprlib copy types "
    "contextlib numpy jax jaxlib equinox jaxtyping lineax optimistix diffrax hybridjax "
    "_thread".split()
)
_DRAWN = frozenset(
    "random default_rng pure_callback io_callback now config devices ctypeslib".split()
)
_CLOCKS = frozenset("now today utcnow".split())
_MOVING = frozenset("time random secrets uuid".split())
# Functions of JAX and its libraries that remember the trace of a function by its identity.
_RETRACED = frozenset(
    "jit filter_jit scan cond switch while_loop fori_loop map associative_scan checkpoint remat "
    "filter_checkpoint custom_jvp custom_vjp filter_custom_jvp filter_custom_vjp piecewise reduce "
    "closure_convert filter_closure_convert odeint diffeqsolve root_find fixed_point minimise "
    "least_squares linear_solve FunctionLinearOperator".split()
)
# What Python and its tools write into classes.
_DESCRIPTIONS = frozenset(
    "_abc_impl __doc__ __module__ __dict__ __weakref__ __annotations__ __annotate__ "
    "__annotate_func__ __annotations_cache__ __firstlineno__ __static_attributes__ __qualname__ "
    "__orig_bases__ __parameters__ __abstractmethods__ __abstractclassvars__ __abstractvars__ "
    "__dataclass_fields__ __dataclass_params__ __match_args__ __slots__ __classcell__".split()
)
# Objects after which a reading ends as incomplete. More: what holds a whole library (a
# figure, a session) is read for longer than tracing takes. Fewer: large systems are traced again
# at each call.
_MOST = 20_000
# Notes of which a hash is taken at once. Fewer: readings take longer. More: long lists of numbers
# fill the memory.
_AT_ONCE = 1000
# Bytes of an array that is still read with `marks`. More: calls take longer than tracing does.
# Fewer: systems with tables are traced again at each call.
_LARGE = 1_000_000

_PACKAGE = os.path.join(pathlib.Path(__file__).parents[1], "")
_MODELS = os.path.join(_PACKAGE, "models")
_FOLDERS = _PACKAGE, *(sysconfig.get_paths()[x] for x in ("stdlib", "platstdlib"))
# Packages of a user and of a distribution lie elsewhere than those of Python.
_INSTALLED = re.compile(
    "|".join([*map(re.escape, _FOLDERS), r".*[\\/](site|dist)-packages[\\/]"])
)

Names = tuple[str, ...]
"""Also a global name with the attributes that code reads of it: `("np", "linalg", "norm")`."""


class _TooMany(Exception):
    """A reading would visit more than `_MOST` objects."""


class Reading:
    """What some things read.

    - `digest`: of all that was read, the same in every process.
    - `unread`: what could not be read, so that a change of it would not be seen.
    - `hidden`: of these, what reads files, or values by computed names, as sentences.
    - `moving`: of these, what draws random numbers or reads the clock, as sentences.
    - `retraced`: whether JAX may remember the trace of a function that was read.
    - `traced`: names of functions that read a value which JAX traces.

    **Arguments:** `marks`: do not read what takes longer than tracing (large arrays, objects of
    other libraries); it counts as unread.
    """

    def __init__(self, *things: Any, marks: bool = False):
        self.unread: list[str] = []
        self.hidden: list[str] = []
        self.moving: list[str] = []
        self.retraced = False
        self.traced: list[str] = []
        self._marks = marks
        self._hash = hashlib.blake2b(digest_size=16)
        self._words: list[tuple] = []  # of which the hash is not yet taken
        self._number: dict[int, int] = {}
        self._alive: list[Any] = []  # an id belongs to an object while this lives
        self._attributes: set[tuple[int, Names]] = set()
        self._classes = 0  # around what is visited
        self._function_name = ""
        try:
            self._visit_all(things)
        except (_TooMany, RecursionError):
            text = f"`{self._function_name}` reads too many objects to compare"
            self.unread.append(text)
            self.hidden.append(text)
        self._take_hash()
        self.digest = self._hash.hexdigest()
        self._alive.clear()

    def _note(self, *words: Any) -> None:
        self._words.append(words)
        if len(self._words) == _AT_ONCE:
            self._take_hash()

    def _take_hash(self) -> None:
        self._hash.update(repr(self._words).encode())
        self._words.clear()

    def _visit_all(self, things: Iterable[Any]) -> None:
        things = list(things)
        self._note(len(things))
        for x in things:
            self._visit(x)

    def _visit_items(self, items: Iterable[tuple[Any, Any]]) -> None:
        self._visit_all(itertools.chain.from_iterable(items))

    def _visit(self, x: Any) -> None:
        """Read a value and what it refers to; of an object that was visited before, note its
        number."""
        kind = type(x)
        if kind in _PLAIN:
            return self._note(kind.__name__, x)
        if id(x) in self._number:
            return self._note(self._number[id(x)])
        self._number[id(x)] = len(self._number)
        self._alive.append(x)
        if len(self._alive) > _MOST:
            raise _TooMany
        self._note(kind.__qualname__)
        if is_tracer(x):
            self.traced.append(self._function_name)
            return self._note(str(x.aval))
        reader: Any = _reader_of(kind)  # type: ignore[arg-type]  # (a class)
        return reader(self, x)

    def _table(self, x: dict) -> None:
        self._visit_items(x.items())

    def _code_object(self, x: types.CodeType) -> None:
        self._note(_code(x))

    def _cell(self, x: types.CellType) -> None:
        with contextlib.suppress(ValueError):  # an empty cell
            self._visit(x.cell_contents)

    def _property(self, x: property) -> None:
        self._visit_all((x.fget, x.fset))

    def _method(self, x: types.MethodType) -> None:
        self._visit_all((x.__func__, x.__self__))

    def _reference(self, x: weakref.ref) -> None:
        self._visit(x())

    def _variable(self, x: contextvars.ContextVar) -> None:
        with contextlib.suppress(LookupError):  # of one that is not set
            self._visit(x.get())

    def _memory(self, x: memoryview) -> None:
        self._note(x.format, x.shape, x.tobytes())

    def _ufunc(self, x: np.ufunc) -> None:
        self._note(x.__name__)
        if getattr(np, x.__name__, None) is not x:  # (made of a user's function)
            self.unread.append(f"`{x.__name__}`")

    def _of_c(self, x: Any) -> None:
        self._note(x.__name__, x.__objclass__.__qualname__)

    def _dtype(self, x: np.dtype) -> None:
        self._note(str(x))

    def _lock(self, x: Any) -> None:
        pass

    def _set(self, x: Any) -> None:
        parts = [Reading(y, marks=self._marks) for y in x]
        self._note(sorted(part.digest for part in parts))
        for part in parts:
            self._join(part)

    def _join(self, other: "Reading") -> None:
        self.unread += other.unread
        self.hidden += other.hidden
        self.moving += other.moving
        self.traced += other.traced
        self.retraced = self.retraced or other.retraced

    def _array(self, x: Any) -> None:
        if isinstance(x, jax.Array):  # (whose digest is kept with it)
            return self._note(digest_of_array(x))
        if x.dtype.hasobject:
            self._note(x.shape)
            return self._visit_all(x.ravel().tolist())
        if self._marks and x.nbytes > _LARGE:
            self.unread.append("a large array")
            return None
        return self._note(digest_of_array(x))

    def _builtin(self, x: Any) -> None:
        self._note(x.__name__)
        owner = x.__self__
        if owner is not None and not isinstance(owner, types.ModuleType):
            return self._visit(owner)
        self._packaged(x.__module__ or "builtins", x.__name__)
        return None

    def _packaged(self, module: str, name: str) -> None:
        """Note a function or a class of a package, which is known by the version of this."""
        root = module.partition(".")[0]
        self._note(module, name, _version(root))
        if root not in _PURE or (root == "builtins" and name in _UNSURE):
            self.unread.append(f"`{module}.{name}`")
        if name.partition(".")[0] in _RETRACED and root in ("jax", "equinox"):
            self.retraced = True

    def _function(self, x: types.FunctionType) -> None:
        is_installed = is_of_package(x.__code__.co_filename)
        if is_installed:
            # (A wrapper of a package may bear the names of a user's function.)
            module = str(x.__globals__.get("__name__"))
            self._packaged(module, x.__code__.co_qualname)
        else:
            self._function_name = x.__qualname__
            self._visit(x.__code__)
            self._globals(x)
        # The functions of one that dispatches by type.
        registered = vars(x).get("registry")
        self._visit_all((getattr(x, "__wrapped__", None), registered))
        self._visit_all((x.__defaults__, x.__kwdefaults__))
        cells = x.__closure__ or ()
        if is_installed:
            # (Wrappers of a package may remember there what they have been called with.)
            cells = tuple(filter(_is_option, cells))
        else:
            self._function_name = x.__qualname__
        self._visit_all(cells)
        if not is_installed:
            own = {k: v for k, v in vars(x).items() if k != "__wrapped__"}
            self._visit(own)

    def _globals(self, x: types.FunctionType) -> None:
        """Visit what a function, and the functions written in it, read of their module."""
        read = _names(x.__code__)
        space = x.__globals__
        self._suspect(x, frozenset(read.names), frozenset(read.attributes))
        for path in read.paths:
            name = path[0]
            if name in space:
                self._global(x, path, space[name], read.names)
            elif hasattr(builtins, name):
                self._global(x, path, getattr(builtins, name), read.names)
        for name, level in read.imports:
            module = _imported(name, level, space)
            if module is None:
                self.unread.append(f"the module `{name}`, which is not imported yet")
            else:
                self._global(x, (name, ""), module, read.names)

    def _suspect(
        self,
        x: types.FunctionType,
        names: frozenset[str],
        attributes: frozenset[str],
    ) -> None:
        """List reads that names show."""
        if names & _FRAMES:
            self._hide(x, "globals")
        if not self._classes and names & _FILE_METHODS:
            self._hide(x, "read_text")
        if attributes & _RETRACED or "getattr" in names:
            self.retraced = True
        for name in attributes:
            if name in _DRAWN or _FILES.fullmatch(name):
                self.unread.append(f"`{name}` in `{x.__qualname__}`")

    def _hide(self, x: types.FunctionType, name: str) -> None:
        text = f"`{x.__qualname__}` uses `{name}`, whose changes cannot be noticed"
        self.hidden.append(text)
        self.unread.append(text)

    def _global(
        self,
        x: types.FunctionType,
        path: Names,
        value: Any,
        names: Names,
    ) -> None:
        self._note(path[0])
        if self._is_hidden(x, path, value):
            return None
        if not isinstance(value, types.ModuleType):
            return self._visit(value)
        self._module_names(value, names)
        if path[1:] == () or path[1][:2] == "__":
            self._visit(value)
        return None

    def _is_hidden(self, x: types.FunctionType, path: Names, value: Any) -> bool:
        """Test for values that cannot be read here, and list them."""
        for name in path[1:]:
            if isinstance(value, types.ModuleType | type):
                value = _attribute(value, name)
        if value is sys.modules:
            self._hide(x, "sys.modules")
            return True
        if _moves(value):
            name = str(_attribute(value, "__name__") or "")
            text = f"`{x.__qualname__}` uses `{name}`, which changes by itself"
            self.moving.append(text)
            self.unread.append(text)
        if not callable(value) or not is_packaged(_attribute(value, "__module__")):
            return False
        name = str(_attribute(value, "__name__") or "")
        reads_file = _FILES.fullmatch(name) and not self._classes
        if _HIDDEN.fullmatch(name) or reads_file:
            self._hide(x, name)
        return False

    def _module_names(self, module: types.ModuleType, names: Names) -> None:
        """Visit the attributes of a module that a function names."""
        if (id(module), names) in self._attributes:
            return
        self._attributes.add((id(module), names))
        self._alive.append(module)
        name = module.__name__
        root = name.partition(".")[0]
        is_installed = is_packaged(name)
        self._note(name, _version(root))
        if is_installed and root not in _PURE:
            self.unread.append(f"the module `{name}`")
        if type(module) is not types.ModuleType:
            self._visit(type(module))
        if not is_installed and hasattr(module, "__getattr__"):
            self._visit(module)
        for key in names:
            if key not in vars(module) and key not in _lazy_names(module):
                continue
            value = getattr(module, key)
            if is_installed and callable(value):
                continue
            self._note(key)
            if isinstance(value, types.ModuleType):
                self._module_names(value, names)
            else:
                self._visit(value)

    def _module(self, x: types.ModuleType) -> None:
        self._note(x.__name__, _version(x.__name__.partition(".")[0]))
        self.unread.append(f"the module `{x.__name__}` as a value")
        if not is_packaged(x.__name__):
            items = vars(x).items()
            self._visit({k: v for k, v in items if not _is_description(k, v)})

    def _class(self, x: type) -> None:
        self._classes += 1
        for base in inspect.getmro(x):
            module = str(base.__module__)  # (of a metaclass it may be a descriptor)
            if is_packaged_class(base):
                self._packaged(module, base.__qualname__)
                continue
            self._note(module, base.__qualname__)
            items = vars(base).items()
            self._visit({k: v for k, v in items if not _is_description(k, v)})
        if type(x) is not type:
            self._visit(type(x))
        self._classes -= 1

    def _object(self, x: Any) -> None:
        kind = type(x)
        if isinstance(x, _JITTED | jax.custom_jvp | jax.custom_vjp):
            return self._wrapper_of_jax(x)
        self._visit(kind)
        self._value(x)
        state = _state_of(x)
        root = str(kind.__module__).partition(".")[0]
        is_foreign = is_packaged_class(kind) and root not in _PURE
        if is_foreign and self._marks:
            self.unread.append(f"an object of `{kind.__module__}.{kind.__qualname__}`")
            return None
        if is_packaged_class(kind) and (is_foreign or not state):
            return self._pickled(x, state)
        self._visit(state)
        if not state and not is_packaged_class(kind):
            # (A user's class is made of a type of C whose values are not known here.)
            known = (object, *_VALUES, list, tuple, dict, set, frozenset, np.ndarray)
            made_of = {b for b in kind.__mro__ if b.__flags__ & _HEAP == 0}
            if not made_of <= set(known):
                self.unread.append(f"an object of `{kind.__qualname__}`")
        return None

    def _wrapper_of_jax(self, x: Any) -> None:
        function = x.__wrapped__
        code = getattr(function, "__code__", None)
        is_own = code is not None and is_of_package(code.co_filename)
        if not is_own or function.__closure__:
            self.retraced = True
        self._visit(function)
        callables = {k: v for k, v in vars(x).items() if callable(v)}
        self._visit(callables)

    def _value(self, x: Any) -> None:
        """Visit the value of an object whose class is made of a type of Python or NumPy."""
        for base in _VALUES:
            if isinstance(x, base):
                self._note(base.__name__, base.__repr__(x))
        if isinstance(x, list):
            self._visit_all(list.__iter__(x))
        elif isinstance(x, tuple):
            self._visit_all(tuple.__iter__(x))
        elif isinstance(x, set):
            self._set(list(set.__iter__(x)))
        elif isinstance(x, frozenset):
            self._set(list(frozenset.__iter__(x)))
        elif isinstance(x, dict):
            self._visit_items(dict.items(x))
        elif isinstance(x, types.MappingProxyType):
            self._visit_items(x.items())
        elif isinstance(x, np.ndarray):
            self._array(x.view(np.ndarray))

    def _pickled(self, x: Any, state: Any) -> None:
        """Visit the parts from which `pickle` makes an object, or what its attributes hold."""
        try:
            parts = [_listed(y) for y in x.__reduce_ex__(4)[1:]]
        except Exception:  # whatever an object raises that cannot be pickled
            self.unread.append(f"an object of `{type(x).__qualname__}`")
            return self._visit(state)
        return self._visit_all(parts)


# How objects of these types alone are read, and those of the types below and of their subclasses.
_OF_THIS_TYPE: dict[type, Callable] = {
    list: Reading._visit_all,
    tuple: Reading._visit_all,
    dict: Reading._table,
    set: Reading._set,
    frozenset: Reading._set,
    np.ndarray: Reading._array,
    # Objects without a value, which `functools.cached_property` holds.
    type(threading.Lock()): Reading._lock,
    type(threading.RLock()): Reading._lock,
    # What classes of C are made of.
    types.MethodDescriptorType: Reading._of_c,
    types.ClassMethodDescriptorType: Reading._of_c,
    types.WrapperDescriptorType: Reading._of_c,
    types.GetSetDescriptorType: Reading._of_c,
    types.MemberDescriptorType: Reading._of_c,
}
_OF_SUBTYPES: dict[type, Callable] = {
    np.generic: Reading._array,
    jax.Array: Reading._array,
    types.FunctionType: Reading._function,
    types.CodeType: Reading._code_object,
    types.CellType: Reading._cell,
    type: Reading._class,
    property: Reading._property,
    types.MethodType: Reading._method,
    # (Read by other means than the names of its attributes.)
    types.ModuleType: Reading._module,
    types.BuiltinFunctionType: Reading._builtin,
    weakref.ref: Reading._reference,
    contextvars.ContextVar: Reading._variable,
    memoryview: Reading._memory,
    np.ufunc: Reading._ufunc,
    np.dtype: Reading._dtype,
}


@ft.lru_cache(4096)
def _reader_of(kind: type) -> Callable:
    if kind in _OF_THIS_TYPE:
        return _OF_THIS_TYPE[kind]
    for type_, reader in _OF_SUBTYPES.items():
        if issubclass(kind, type_):
            return reader
    return Reading._object


def _moves(x: Any) -> bool:
    """Test for functions of packages that draw random numbers or read the clock."""
    if not callable(x):
        return False
    owner = _attribute(x, "__self__")
    if isinstance(owner, np.random.RandomState | random.Random):
        return True
    if isinstance(owner, type) and _attribute(x, "__name__") in _CLOCKS:
        return True
    module = str(_attribute(x, "__module__"))
    is_function = isinstance(x, types.FunctionType | types.BuiltinFunctionType)
    return is_function and module.partition(".")[0] in _MOVING


_HEAP = 1 << 9  # Python's flag of classes that are made while it runs


def _listed(x: Any) -> Any:
    return x if _attribute(x, "__next__") is None else list(x)


def _state_of(x: Any) -> dict[str, Any]:
    """The attributes of an object, in its dictionary and in slots."""
    attributes = getattr(x, "__dict__", {})
    state = dict(sorted(attributes.items(), key=lambda item: str(item)))
    state.pop("code_digest", None)
    for base in type(x).__mro__:
        slots = vars(base).get("__slots__", ())
        if isinstance(slots, str):
            slots = [slots]
        for name in slots:
            if name in ("__dict__", "__weakref__"):
                continue
            if name.startswith("__") and not name.endswith("__"):
                name = f"_{base.__name__.lstrip('_')}{name}"  # (as Python keeps it)
            with contextlib.suppress(AttributeError):  # of a slot that is not filled
                state[name] = getattr(x, name)
    wrapped = _attribute(x, "__wrapped__")
    if wrapped is not None and "__wrapped__" not in state:
        state["__wrapped__"] = wrapped
    return state


def _attribute(x: Any, name: str) -> Any:
    """An attribute of a user's object; None for none. (`__getattr__` may raise any error.)"""
    with contextlib.suppress(Exception):
        return getattr(x, name, None)
    return None


def _is_option(cell: types.CellType) -> bool:
    """Test for a cell of a package's wrapper that holds a function, a number, a name or several."""
    try:
        x = cell.cell_contents
    except ValueError:
        return False
    kinds = (*_PLAIN, tuple, list, dict, set, frozenset, types.FunctionType)
    is_function = isinstance(x, types.MethodType | _JITTED | ft.partial)
    return type(x) in kinds or is_function


def _imported(name: str, level: int, space: dict[str, Any]) -> types.ModuleType | None:
    """The module that code imports, from the package of its own module if there are dots."""
    if level:
        package = space.get("__package__") or ""
        with contextlib.suppress(ImportError):
            return sys.modules.get(
                importlib.util.resolve_name("." * level + name, package)
            )
        return None
    return sys.modules.get(name)


@ft.lru_cache(4096)
def _code(code: types.CodeType) -> str:
    """Return the digest of code, of the names in it and of its constants, but not of its lines and
    file."""
    names = (code.co_names, code.co_varnames, code.co_freevars)
    counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
    return Reading(code.co_code, *names, *counts, *code.co_consts).digest


class _Names(NamedTuple):
    """What code, and the functions that are written in it, name."""

    paths: tuple[Names, ...]
    """Global names, each with the attributes that are read of it."""
    imports: tuple[tuple[str, int], ...]
    """Modules that are imported, and the numbers of dots before their names."""
    names: Names
    """All names and words."""
    attributes: Names
    """Names of attributes."""


_READING_ATTRIBUTES = frozenset(
    "LOAD_ATTR LOAD_METHOD LOAD_SUPER_ATTR LOAD_SUPER_METHOD IMPORT_FROM".split()
)


@ft.lru_cache(4096)
def _names(code: types.CodeType) -> _Names:
    """Return what code names, from its instructions: a path goes on as long as each next
    instruction reads an attribute."""
    paths: list[Names] = []
    imports: list[tuple[str, int]] = []
    attributes: list[str] = []
    steps = list(dis.get_instructions(code))
    is_open = False  # whether the next step may read an attribute of the last name
    for k, step in enumerate(steps):
        if step.opname in _READING_ATTRIBUTES:
            attributes.append(step.argval)
        if step.opname == "IMPORT_NAME":
            dots = steps[k - 2].argval if k > 1 else 0
            imports.append((step.argval, dots if isinstance(dots, int) else 0))
        if step.opname == "LOAD_NAME" or step.opname.startswith("LOAD_GLOBAL"):
            paths.append((step.argval,))
        elif is_open and step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            paths[-1] += (step.argval,)
        elif step.opname != "CACHE":
            is_open = False
            continue
        is_open = True
    words = [x for x in code.co_consts if isinstance(x, str) and x.isidentifier()]
    inner = [_names(x) for x in code.co_consts if isinstance(x, types.CodeType)]
    own = paths, imports, [*code.co_names, *words], attributes
    every: Any = zip(own, *inner, strict=True)
    return _Names(*(tuple(dict.fromkeys(itertools.chain(*x))) for x in every))


@ft.cache
def _version(package: str) -> str:
    """Return the version of an installed package, "" for others and Python's own."""
    try:
        if package in sys.stdlib_module_names:
            return ""
        return importlib.metadata.version(package)
    except (importlib.metadata.PackageNotFoundError, ValueError):  # or no name
        return str(getattr(sys.modules.get(package), "__version__", ""))


def _is_description(name: str, value: Any) -> bool:
    """Test for attributes that Python and its tools add to modules and classes."""
    if name in _DESCRIPTIONS:
        return True
    is_special = name.startswith("__") and name.endswith("__")
    plain = (*_PLAIN, list, tuple, dict, set, frozenset, np.ndarray)
    return is_special and not callable(value) and type(value) not in plain


@ft.cache
def _lazy_names(module: types.ModuleType) -> frozenset[str]:
    """Names that a package imports when they are used."""
    return frozenset(dir(module)) if hasattr(module, "__getattr__") else frozenset()


def is_packaged(module: str | None) -> bool:
    """Test whether a module belongs to Python or to a package, `hybridjax.models` excepted."""
    name = module or "builtins"
    root = name.partition(".")[0]
    if name.startswith("hybridjax.models") or root == "__main__":
        return False
    # (A user's file may have the name of one of Python's modules.)
    path = getattr(sys.modules.get(root), "__file__", None)
    return root in sys.stdlib_module_names if path is None else is_of_package(path)


def is_packaged_class(x: type) -> bool:
    """Test whether a class belongs to Python or to a package, `hybridjax.models` excepted."""
    module = str(x.__module__)
    if not is_packaged(module):
        return False
    # (A class of `exec` without a `__name__`, or of `type(...)`, may have the module of a package.)
    found: Any = sys.modules.get(module)
    for name in x.__qualname__.split("."):
        found = getattr(found, name, None)
    if found is x or not x.__flags__ & _HEAP:
        return True
    functions = [y for y in vars(x).values() if isinstance(y, types.FunctionType)]
    return bool(functions) and all(
        is_of_package(y.__code__.co_filename) for y in functions
    )


@ft.cache
def is_of_package(path: str) -> bool:
    """Test whether a file belongs to Python or to a package, `hybridjax.models` excepted."""
    if path.startswith(_MODELS):
        return False
    if _INSTALLED.match(path):
        return True
    file = pathlib.Path(path)
    names = zip(reversed(file.parts), file.parents, strict=False)
    return any(name in _recorded(folder) for name, folder in names)


@ft.cache
def _recorded(folder: pathlib.Path) -> frozenset[str]:
    """Names of what pip has put into a folder (with `--target`)."""
    names: set[str] = set()
    for package in importlib.metadata.distributions(path=[str(folder)]):
        record = package.read_text("RECORD") or ""
        names.update(re.split("[/,]", line)[0] for line in record.splitlines())
    return frozenset(names)
