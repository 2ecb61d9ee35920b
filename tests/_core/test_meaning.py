"""Whatever changes what a function computes changes its digest; what does not, leaves it."""

import sys
import types

import pytest

import hybridjax as hj
from hybridjax._core.boundary.containers import Instance, Items
from hybridjax._core.meaning import current, meaning
from hybridjax._core.reading import is_of_package
from hybridjax.errors import DefinitionError


# What a function computes, before and after one statement.
WAYS = {
    "a global of a helper": (
        "K = 1.0\ndef h(x): return K * x\ndef f(x): return h(x)",
        "K = 2.0",
    ),
    "a global in an inner function": (
        "K = 1\ndef f(x): return (lambda y: K * y)(x)",
        "K = 2",
    ),
    "a helper anew": (
        "def h(x): return x\ndef f(x): return h(x)",
        "def h(x): return 2 * x",
    ),
    "an array in place": (
        "import numpy as np\nK = np.ones(3)\ndef f(x): return K * x",
        "K[1] = 2",
    ),
    "an array of objects": (
        "import numpy as np\nK = np.array([{'k': 1}, None])\ndef f(x): return K[0]['k'] * x",
        "K[0]['k'] = 2",
    ),
    "a set": ("K = {1}\ndef f(x): return x in K", "K.add(2)"),
    "the cell of a closure": (
        "def make():\n    k = 1\n    def f(x): return k * x\n    def set(y):\n        nonlocal k\n"
        "        k = y\n    return f, set\nf, set = make()",
        "set(2)",
    ),
    "a default": ("def f(x, k=1): return k * x", "f.__defaults__ = (2,)"),
    "a default by name": (
        "def f(x, *, k=1): return k * x",
        "f.__kwdefaults__['k'] = 2",
    ),
    "the code": (
        "def f(x): return x\ndef g(x): return 2 * x",
        "f.__code__ = g.__code__",
    ),
    "an attribute of a function": ("def f(x): return f.k * x\nf.k = 1", "f.k = 2"),
    "a constant of a partial": (
        "import functools\nK = [1]\nf = functools.partial(lambda k, x: k[0] * x, K)",
        "K[0] = 2",
    ),
    "a method": (
        "class A:\n    def h(self, x): return x\n    def f(self, x): return self.h(x)\nf = A().f",
        "A.h = lambda self, x: 2 * x",
    ),
    "an attribute of a base class": (
        "class B:\n    k = 1\nclass A(B):\n    pass\na = A()\ndef f(x): return a.k * x",
        "B.k = 2",
    ),
    "a property": (
        "class A:\n    @property\n    def k(self): return 1\na = A()\ndef f(x): return a.k * x",
        "A.k = property(lambda self: 2)",
    ),
    "a class method": (
        "class A:\n    k = 1\n    @classmethod\n    def h(cls, x): return cls.k\nf = A.h",
        "A.k = 2",
    ),
    "what is called as a function": (
        "class A:\n    def __call__(self, x): return x\nf = A()",
        "A.__call__ = lambda self, x: 2 * x",
    ),
    "a slot": (
        "class A:\n    __slots__ = ('k',)\na = A()\na.k = 1\ndef f(x): return a.k * x",
        "a.k = 2",
    ),
    "a field that is not compared": (
        "import dataclasses\n@dataclasses.dataclass\nclass A:\n"
        "    k: float = dataclasses.field(default=1.0, compare=False)\n"
        "a = A()\ndef f(x): return a.k * x",
        "a.k = 2.0",
    ),
    "an environment variable": (
        "import os\ndef f(x): return float(os.environ.get('K', 1)) * x",
        "os.environ['K'] = '2'",
    ),
    "True for 1": ("K = 1\ndef f(x): return K + x", "K = True"),
    "-0.0 for 0.0": ("K = 0.0\ndef f(x): return K + x", "K = -0.0"),
    "another type of array": (
        "import numpy as np\nK = np.ones(2)\ndef f(x): return K",
        "K = np.ones(2, 'f4')",
    ),
    "a decorated function": (
        "import functools\nK = 1\ndef twice(g):\n    @functools.wraps(g)\n"
        "    def h(x): return 2 * g(x)\n    return h\n@twice\ndef f(x): return K * x",
        "K = 2",
    ),
    "a function of jax.jit": (
        "import jax\nK = 1\n@jax.jit\ndef f(x): return K * x",
        "K = 2",
    ),
    "a random key": (
        "import jax\nK = jax.random.key(1)\ndef f(x): return K",
        "K = jax.random.key(2)",
    ),
    "the rule of a derivative": (
        "import jax\nK = 1\n@jax.custom_jvp\ndef f(x): return x\n"
        "f.defjvps(lambda dx, _, x: K * dx)",
        "K = 2",
    ),
    "a name of a module that a function imports": (
        "import sys\nsys.modules['users_third'] = other.inner\n"
        "def f(x):\n    from users_third import K\n    return K",
        "other.inner.K = 2",
    ),
    "an attribute of a module": ("def f(x): return other.K * x", "other.K = 2"),
    "an attribute of a module, by a word": (
        "def f(x): return getattr(other, 'K')",
        "other.K = 2",
    ),
    "a function of a module": (
        "def f(x): return other.h(x)",
        "other.h = lambda x: 3 * x",
    ),
    "a module as an argument": (
        "def g(m, x): return m.h(x)\ndef f(x): return g(other, x)",
        "other.h = lambda x: 3 * x",
    ),
    "the table of a module": ("def f(x): return vars(other)['K']", "other.K = 2"),
    "another attribute of an inner module": (
        "other.inner.J = 1\ndef g(x): return other.inner.J\ndef f(x): return g(x) + other.inner.K",
        "other.inner.K = 2",
    ),
    "a weak reference": (
        "import weakref\nclass A:\n    pass\na = A()\na.k = 1\nr = weakref.ref(a)\n"
        "def f(x): return r().k",
        "a.k = 2",
    ),
    "a property of a metaclass": (
        "class M(type):\n    k = property(lambda c: 1)\nclass A(metaclass=M):\n    pass\n"
        "def f(x): return A.k * x",
        "M.k = property(lambda c: 2)",
    ),
    "a function by types": (
        "import functools\n@functools.singledispatch\ndef h(x): return x\ndef f(x): return h(x)",
        "h.register(float, lambda x: 2 * x)",
    ),
    "the owner of a built-in method": (
        "K = {'k': 1}\ng = K.get\ndef f(x): return g('k')",
        "K['k'] = 2",
    ),
    "a mask": (
        "import numpy as np\nK = np.ma.array([1.0, 2.0], mask=[0, 0])\ndef f(x): return K.sum()",
        "K[0] = np.ma.masked",
    ),
}


@pytest.mark.parametrize("named", [{"__name__": "users_module"}, {}])
@pytest.mark.parametrize("way", WAYS)
def test_a_change_is_noticed(way, named, monkeypatch):
    monkeypatch.setenv("K", "1")
    before, change = WAYS[way]
    other = types.ModuleType("users_other")
    inner = types.ModuleType("users_inner")
    inner.K = 1
    other.K = 1
    other.h = lambda x: x
    other.inner = inner
    space = {**named, "other": other}
    exec(before, space)
    digest = meaning(space["f"])
    assert meaning(space["f"]) == digest
    exec("unused = 3\n" + before.replace("\n", "\n\n"), dict(space))
    assert meaning(space["f"]) == digest
    exec(change, space)
    assert meaning(space["f"]) != digest
    sys.modules.pop("users_third", None)


def test_what_is_not_read_is_not_noticed(monkeypatch, tmp_path):
    """A global, or a module of Python, that has the name of an attribute; code of packages."""
    assert is_of_package("/home/a/.local/lib/python3.11/site-packages/jax/x.py")
    assert is_of_package("/usr/lib/python3/dist-packages/x.py")
    assert not is_of_package("/home/x.py")
    (tmp_path / "a-1.dist-info").mkdir()  # of `pip install --target`
    (tmp_path / "a-1.dist-info/RECORD").write_text("a/x.py,sha256=k,4\nb.py,,")
    measured = [is_of_package(f"{tmp_path}/{x}") for x in ("a/x.py", "b.py", "mine.py")]
    assert measured == [1, 1, 0]
    space = {"__name__": "users_module", "m": 1.0}
    exec("class A:\n    m = 1\na = A()\ndef f(x): return a.m * x", space)
    digest = meaning(space["f"])
    space["m"] = 2.0
    monkeypatch.setitem(sys.modules, "m", types.ModuleType("m"))
    assert meaning(space["f"]) == digest


@pytest.mark.parametrize(
    "code",
    [
        "eval('K')",
        "importlib.import_module('K')",
        "open('K').read()",
        "np.loadtxt('K')",
        "sys.modules['K']",
        "os.getenv('K')",
        "pathlib.Path('K').read_bytes()",
        "P()",
        "f.__globals__['K']",
        "sys._getframe().f_globals['K']",
    ],
)
def test_values_that_are_not_named_are_refused(code):
    space = {"__name__": "users_module"}
    exec("import functools, importlib, os, pathlib, sys, numpy as np", space)
    exec(
        f"P = functools.partial(lambda: eval('K'))\ndef f(x): return {code} * x", space
    )
    with pytest.raises(DefinitionError, match="` uses `"):
        meaning(space["f"])


def test_systems_given_together_share_a_digest_if_they_differ_in_arrays_only():
    hopper = hj.models.VerticalHopper
    given = [hopper(k=9.0), hopper(k=10.0), hopper(solver=hj.systems.Radau())]
    taken = Items(Instance(hj.HybridSystem)).take(given)
    digests = [x.code_digest for x in taken]
    assert digests == [current(x).code_digest for x in given]
    assert digests[0] == digests[1] != digests[2]
