"""A hundred ways to change what a system computes: each is seen, or the system is refused."""

import importlib
import sys
import types

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core.meaning import code_digest

from ..sessions import run_python
from ..toys import Field
from .test_meaning import WAYS


SYSTEM = """
import dataclasses, datetime, functools, io, os, pathlib, random, sqlite3, subprocess, threading
import time, typing
import equinox as eqx, h5py, jax, jax.numpy as jnp, numpy as np
import hybridjax as hj

class Line(hj.Chart):
    states = ("x",)
    def field(self, t, q, u):
        return (f(q[0]),)

class Uses(hj.HybridSystem):
    def charts(self):
        return {"line": Line()}
"""

PAIR = "class Pair(typing.NamedTuple):\n    a: float\n    b: float\n"
NUMBER = "class Number({base}):\n    factor = 1.0\n    def twice(self): return 2.0\n"

# By kind, pairs of a program that defines f(x) and of a statement that changes what it computes.
CHANGES = {
    "a method of a named tuple": [
        (
            PAIR + "    def sum(self): return self.a + self.b\n"
            "p = Pair(1.0, 2.0)\ndef f(x): return p.sum() * x",
            "Pair.sum = lambda self: self.a - self.b",
        ),
        (
            PAIR + "    @staticmethod\n    def k(): return 1.0\np = Pair(1.0, 2.0)\n"
            "def f(x): return p.k() * x",
            "Pair.k = staticmethod(lambda: 2.0)",
        ),
        (
            PAIR + "    @classmethod\n    def k(cls): return 1.0\n"
            "def make():\n    p = Pair(1.0, 2.0)\n    return lambda x: p.k() * x\nf = make()",
            "Pair.k = classmethod(lambda cls: 2.0)",
        ),
    ],
    "a name that `__getattr__` looks up, which raises another error for unknown ones": [
        (
            "names = {'k': 1.0}\nclass Names:\n"
            "    def __getattr__(self, name): return names[name]\n"
            "n = Names()\ndef f(x): return n.k * x",
            "names['k'] = 2.0",
        ),
    ],
    "a property of a named tuple": [
        (
            PAIR + "    @property\n    def k(self): return self.a\n"
            "p = Pair(1.0, 2.0)\ndef f(x): return p.k * x",
            "Pair.k = property(lambda self: self.b)",
        ),
        (
            PAIR + "    scale = 1.0\np = Pair(1.0, 2.0)\ndef f(x): return p.scale * x",
            "Pair.scale = 2.0",
        ),
        (
            PAIR + "class Inner(Pair):\n    @property\n    def k(self): return self.a\n"
            "def f(x, p=Inner(1.0, 2.0)): return p.k * x",
            "Inner.k = property(lambda self: self.b)",
        ),
    ],
    "the order of the fields of a named tuple": [
        (
            PAIR + "p = Pair(1.0, 2.0)\ndef f(x): return p.a * x",
            "Pair.a, Pair.b = Pair.b, Pair.a",
        ),
        (
            PAIR + "p = Pair(1.0, 2.0)\ndef f(x): return p.a * x",
            "class Pair(typing.NamedTuple):\n    b: float\n    a: float\np = Pair(1.0, 2.0)",
        ),
        (
            PAIR + "def f(x): return Pair(1.0, 2.0).a * x",
            "class Pair(typing.NamedTuple):\n    b: float\n    a: float",
        ),
    ],
    **{
        f"a subclass of {base}": [
            (
                NUMBER.format(base=base)
                + f"n = Number({value})\ndef f(x): return n.twice() * x",
                "Number.twice = lambda self: 3.0",
            ),
            (
                NUMBER.format(base=base)
                + f"n = Number({value})\ndef f(x): return n.factor * x",
                "n.factor = 3.0",
            ),
            (
                NUMBER.format(base=base)
                + f"n = Number({value})\ndef f(x): return {use} * x",
                f"n = Number({other})",
            ),
        ]
        for base, value, other, use in (
            ("float", "1.0", "2.0", "n"),
            ("int", "1", "2", "n"),
            ("str", "'a'", "'ab'", "len(n)"),
            ("list", "[1.0]", "[2.0]", "n[0]"),
            ("dict", "{'k': 1.0}", "{'k': 2.0}", "n['k']"),
        )
    },
    "a subclass of an array": [
        (
            "class A(np.ndarray):\n    def k(self): return 1.0\n"
            "a = np.ones(2).view(A)\ndef f(x): return a.k() * x",
            "A.k = lambda self: 2.0",
        ),
        (
            "class A(np.ndarray):\n    pass\na = np.ones(2).view(A)\na.k = 1.0\n"
            "def f(x): return a.k * x",
            "a.k = 2.0",
        ),
        (
            "class A(np.ndarray):\n    pass\na = np.ones(2).view(A)\ndef f(x): return a[0] * x",
            "a[0] = 2.0",
        ),
    ],
    "the arguments of jax.grad": [
        (
            "def V(a, b): return a**2 * b\ng = jax.grad(V, argnums=0)\n"
            "def f(x): return g(x, 3.0)",
            "g = jax.grad(V, argnums=1)",
        ),
        (
            "def V(a, b): return a**2 * b\nk = 0\ndef f(x): return jax.grad(V, k)(x, 3.0)",
            "k = 1",
        ),
        (
            "def V(a, b): return a**2 * b\ng = jax.jacfwd(V, argnums=0)\n"
            "def f(x): return g(x, 3.0)",
            "g = jax.jacfwd(V, argnums=1)",
        ),
    ],
    "the arguments of jax.value_and_grad": [
        (
            "def V(a, b): return a**2 * b\ng = jax.value_and_grad(V)\n"
            "def f(x): return g(x, 3.0)[1]",
            "g = jax.value_and_grad(V, argnums=1)",
        ),
        (
            "def V(a): return a**2, 3 * a\ng = jax.value_and_grad(V, has_aux=True)\n"
            "def f(x): return g(x)[0][1]",
            "g = jax.value_and_grad(lambda a: (a**2, 4 * a), has_aux=True)",
        ),
        (
            "def V(a, b): return a**2 * b\ng = functools.partial(jax.grad(V, argnums=0), b=3.0)\n"
            "def f(x): return g(x)",
            "g = functools.partial(jax.grad(V, argnums=0), b=4.0)",
        ),
    ],
    "the axes of jax.vmap": [
        (
            "M = np.array([[1.0, 2.0], [3.0, 4.0]])\ng = jax.vmap(lambda r: r[0], in_axes=0)\n"
            "def f(x): return g(M)[1] * x",
            "g = jax.vmap(lambda r: r[0], in_axes=1)",
        ),
        (
            "M = np.array([[1.0, 2.0], [3.0, 4.0]])\ng = jax.vmap(lambda r: 2 * r, out_axes=0)\n"
            "def f(x): return g(M)[1, 0] * x",
            "g = jax.vmap(lambda r: 2 * r, out_axes=1)",
        ),
        (
            "M = np.array([[1.0, 2.0], [3.0, 4.0]])\n"
            "g = jax.vmap(lambda d: d['r'][0], in_axes=({'r': 0},))\n"
            "def f(x): return g({'r': M})[1] * x",
            "g = jax.vmap(lambda d: d['r'][0], in_axes=({'r': 1},))",
        ),
    ],
    "the signature of jnp.vectorize": [
        (
            "M = np.array([[1.0, 2.0], [3.0, 5.0]])\n"
            "g = jnp.vectorize(lambda r: jnp.sum(r**2), signature='(n)->()')\n"
            "def f(x): return jnp.ravel(g(M))[1] * x",
            "g = jnp.vectorize(lambda r: jnp.sum(r**2))",
        ),
        (
            "g = jnp.vectorize(lambda a, b: a * b, excluded={1})\n"
            "def f(x): return g(x, 3.0)",
            "g = jnp.vectorize(lambda a, b: a + b, excluded={1})",
        ),
        (
            "M = np.ones((2, 2))\ng = jnp.vectorize(jnp.size, signature='(n)->()')\n"
            "def f(x): return jnp.sum(g(M)) * x",
            "g = jnp.vectorize(jnp.size, signature='(n,m)->()')",
        ),
    ],
    "a class attribute with two underscores": [
        (
            "class A:\n    __k__ = 1.0\na = A()\ndef f(x): return a.__k__ * x",
            "A.__k__ = 2.0",
        ),
        (
            "class A:\n    __k = 1.0\n    def k(self): return self.__k\na = A()\n"
            "def f(x): return a.k() * x",
            "A._A__k = 2.0",
        ),
        (
            "class A:\n    __slots__ = ('__k',)\n    def __init__(self, k): self.__k = k\n"
            "    def k(self): return self.__k\na = A(1.0)\ndef f(x): return a.k() * x",
            "a = A(2.0)",
        ),
    ],
    "a file of HDF5": [
        (
            "with h5py.File('k.h5', 'w') as file: file['k'] = 1.0\n"
            "def f(x):\n    with h5py.File('k.h5') as file: return float(file['k'][()]) * x",
            "with h5py.File('k.h5', 'w') as file: file['k'] = 2.0",
        ),
        (
            "with h5py.File('k.h5', 'w') as file: file['k'] = 1.0\n"
            "def f(x):\n    from h5py import File\n"
            "    with File('k.h5') as file: return float(file['k'][()]) * x",
            "with h5py.File('k.h5', 'w') as file: file['k'] = 2.0",
        ),
        (
            "file = h5py.File('k.h5', 'w')\nfile['k'] = 1.0\n"
            "def f(x): return float(file['k'][()]) * x",
            "file['k'][...] = 2.0",
        ),
    ],
    "a file of pathlib": [
        (
            "P = pathlib.Path('k')\nP.write_text('1')\n"
            "def f(x):\n    with P.open() as file: return float(file.read()) * x",
            "P.write_text('2')",
        ),
        (
            "P = pathlib.Path('k')\nP.write_text('1')\ndef f(x): return float(P.read_text()) * x",
            "P.write_text('2')",
        ),
        (
            "P = pathlib.Path('k')\nP.write_text('1')\ndef f(x): return P.stat().st_size * x",
            "P.write_text('22')",
        ),
    ],
    "a file that is opened": [
        (
            "pathlib.Path('k').write_text('1')\n"
            "def f(x):\n    with open('k') as g: return float(g.read()) * x",
            "pathlib.Path('k').write_text('2')",
        ),
        (
            "np.savetxt('k', [1.0])\ndef f(x): return float(np.loadtxt('k')) * x",
            "np.savetxt('k', [2.0])",
        ),
        (
            "np.save('k.npy', [1.0])\ndef f(x): return np.load('k.npy')[0] * x",
            "np.save('k.npy', [2.0])",
        ),
    ],
    "another program": [
        (
            "pathlib.Path('k').write_text('1')\n"
            "def f(x):\n    with os.popen('cat k') as pipe: return float(pipe.read()) * x",
            "pathlib.Path('k').write_text('2')",
        ),
        (
            "pathlib.Path('k').write_text('1')\n"
            "def f(x): return float(subprocess.check_output(['cat', 'k'])) * x",
            "pathlib.Path('k').write_text('2')",
        ),
        (
            "pathlib.Path('k').write_text('1')\nrun = subprocess.run\n"
            "def f(x): return float(run(['cat', 'k'], capture_output=True).stdout) * x",
            "pathlib.Path('k').write_text('2')",
        ),
    ],
    "a database": [
        (
            "base = sqlite3.connect(':memory:')\nbase.execute('create table k (x real)')\n"
            "base.execute('insert into k values (1.0)')\n"
            "def f(x): return base.execute('select x from k').fetchone()[0] * x",
            "base.execute('update k set x = 2.0')",
        ),
        (
            "base = sqlite3.connect('k.db')\nbase.execute('create table k (x real)')\n"
            "base.execute('insert into k values (1.0)')\nbase.commit()\n"
            "def f(x):\n    with sqlite3.connect('k.db') as b:\n"
            "        return b.execute('select x from k').fetchone()[0] * x",
            "base.execute('update k set x = 2.0')\nbase.commit()",
        ),
        (
            "base = sqlite3.connect(':memory:')\nbase.execute('create table k (x real)')\n"
            "rows = base.execute\nrows('insert into k values (1.0)')\n"
            "def f(x): return rows('select x from k').fetchone()[0] * x",
            "rows('update k set x = 2.0')",
        ),
    ],
    "random numbers": [
        ("def f(x): return np.random.normal() * x", ""),
        ("rng = np.random.default_rng(0)\ndef f(x): return rng.normal() * x", ""),
        ("def f(x): return random.random() * x", ""),
    ],
    "the clock": [
        ("def f(x): return time.time() * x", ""),
        ("def f(x): return datetime.datetime.now().timestamp() * x", ""),
        ("from time import perf_counter\ndef f(x): return perf_counter() * x", ""),
    ],
    "a trace that JAX remembers": [
        (
            "K = 1.0\n@jax.jit\ndef h(x): return K * x\nh(1.0)\ndef f(x): return h(x)",
            "K = 2.0",
        ),
        (
            "K = 1.0\ndef step(c, _): return K * c, None\n"
            "def f(x): return jax.lax.scan(step, x, None, length=3)[0]",
            "K = 2.0",
        ),
        (
            "pathlib.Path('k').write_text('1')\n@jax.jit\ndef h(x):\n"
            "    with open('k') as file: return float(file.read()) * x\n"
            "def f(x): return h(x)",
            "pathlib.Path('k').write_text('2')",
        ),
    ],
    "a trace that a function of JAX remembers": [
        (
            "K = 1.0\ndef h(x): return K * x\n"
            "def f(x): return jnp.piecewise(x, [x < 0], [h, h])",
            "K = 2.0",
        ),
        (
            "K = 1.0\ndef h(x, y): return x + K * y\n"
            "def f(x): return jax.lax.reduce(jnp.stack([x, x]), np.float64(0.0), h, (0,))",
            "K = 2.0",
        ),
        (
            "K = 1.0\ndef h(x): return K * x\ndef f(x):\n"
            "    g, constants = jax.closure_convert(h, x)\n    return g(x, *constants)",
            "K = 2.0",
        ),
    ],
    "a trace that a wrapper remembers": [
        (
            "K = 1.0\ng = jax.checkpoint(lambda x: K * jnp.sin(x))\ndef f(x): return g(x)",
            "K = 2.0",
        ),
        (
            "K = 1.0\ng = eqx.filter_jit(lambda x: K * x)\ndef f(x): return g(x)",
            "K = 2.0",
        ),
        (
            "K = [1.0]\nG = {'g': jax.vmap(jax.jit(lambda x: K[0] * x))}\n"
            "def f(x): return G['g'](jnp.stack([x]))[0]",
            "K[0] = 2.0",
        ),
    ],
    "an object of a data class": [
        (
            "@dataclasses.dataclass\nclass A:\n    k: float = 1.0\na = A()\n"
            "def f(x): return a.k * x",
            "a.k = 2.0",
        ),
        (
            "@dataclasses.dataclass(frozen=True)\nclass A:\n    k: float = 1.0\na = A()\n"
            "def f(x): return a.k * x",
            "A.k = property(lambda self: 2.0)",
        ),
        (
            "@dataclasses.dataclass\nclass A:\n    k: float = 1.0\n"
            "    def twice(self): return 2 * self.k\na = A()\ndef f(x): return a.twice() * x",
            "A.twice = lambda self: 3 * self.k",
        ),
    ],
    "a cached property": [
        (
            "class A:\n    @functools.cached_property\n    def k(self): return 1.0\na = A()\n"
            "def f(x): return a.k * x",
            "vars(a)['k'] = 2.0",
        ),
        (
            "class A:\n    c = 1.0\n    @functools.cached_property\n"
            "    def k(self): return self.c\na = A()\ndef f(x): return a.k * x",
            "A.c = 2.0\na = A()",
        ),
        (
            "class A:\n    def __init__(self): self.lock, self.k = threading.RLock(), 1.0\n"
            "a = A()\ndef f(x):\n    with a.lock: return a.k * x",
            "a.k = 2.0",
        ),
    ],
    "a function of numpy that a user makes": [
        (
            "g = np.frompyfunc(lambda a: 2.0 * a, 1, 1)\ndef f(x): return float(g(1.0)) * x",
            "g = np.frompyfunc(lambda a: 3.0 * a, 1, 1)",
        ),
        (
            "g = np.vectorize(lambda a: 2.0 * a)\ndef f(x): return float(g(1.0)) * x",
            "g = np.vectorize(lambda a: 3.0 * a)",
        ),
        (
            "g = np.poly1d([1.0, 2.0])\ndef f(x): return g(1.0) * x",
            "g.coeffs[0] = 3.0",
        ),
    ],
    "the rule of a derivative": [
        (
            "K = 1.0\n@jax.custom_jvp\ndef h(x): return x\nh.defjvps(lambda dx, _, x: K * dx)\n"
            "def f(x): return h(x)",
            "K = 2.0",
        ),
        (
            "@jax.custom_jvp\ndef h(x): return x\nh.defjvps(lambda dx, _, x: dx)\n"
            "def f(x): return h(x)",
            "h.defjvps(lambda dx, _, x: 2 * dx)",
        ),
        (
            "K = 1.0\n@jax.custom_vjp\ndef h(x): return x\n"
            "h.defvjp(lambda x: (x, x), lambda x, dy: (K * dy,))\ndef f(x): return h(x)",
            "K = 2.0",
        ),
    ],
    "a function of the host": [
        (
            "K = 1.0\ndef h(x): return np.asarray(K * x)\n"
            "def f(x): return jax.pure_callback(h, x, x)",
            "K = 2.0",
        ),
        (
            "K = [1.0]\n"
            "def f(x): return jax.pure_callback(lambda y: np.asarray(K[0] * y), x, x)",
            "K[0] = 2.0",
        ),
        (
            "from jax.experimental import io_callback\nK = 1.0\n"
            "def f(x): return io_callback(lambda y: np.asarray(K * y), x, x)",
            "K = 2.0",
        ),
    ],
}
CASES = [(kind, k) for kind, ways in CHANGES.items() for k in range(len(ways))]


def made(code, name="users_cells"):
    """The names of a module in which a program and a system that uses it have been executed."""
    module = types.ModuleType(name)
    system_code = compile(SYSTEM, f"{name}.py", "exec")
    exec(system_code, vars(module))
    user_code = compile(code, f"{name}.py", "exec")
    exec(user_code, vars(module))
    return vars(module)


def digest_or_refusal(space):
    """The digest of a system, or the sentence that refuses it."""
    try:
        return code_digest(space["Uses"]())
    except hj.errors.DefinitionError as error:
        return f"refused: {error}"


@pytest.mark.parametrize(("kind", "k"), CASES)
def test_a_change_is_seen_or_refused(kind, k, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    before, change = CHANGES[kind][k]
    space = made(before)
    first = digest_or_refusal(space)
    if change:
        assert not first.startswith("refused")
        assert digest_or_refusal(space) == first
    exec(change, space)
    second = digest_or_refusal(space)
    if not change:
        assert "the field of chart 'line' of Uses computes another value" in first
        return
    assert second != first
    assert digest_or_refusal(space) == second


CLOCKED = """
class Line(hj.Chart):
    states = ("x",)
    def field(self, t, q, u):
        return (jnp.cos(2 * jnp.pi * t) - f(q[0]) + u[0],)

class Uses(hj.HybridSystem):
    def charts(self):
        return {"line": Line()}
    def period(self):
        return 1.0
"""
FOLLOWED = (
    "a method of a named tuple",
    "a property of a named tuple",
    "the order of the fields of a named tuple",
    "a subclass of float",
    "a subclass of str",
    "a subclass of an array",
    "the axes of jax.vmap",
    "a class attribute with two underscores",
    "a file of HDF5",
    "a file of pathlib",
    "another program",
    "a database",
)


@pytest.mark.parametrize("kind", FOLLOWED)
def test_numbers_follow_the_code_or_the_cycle_is_refused(kind, monkeypatch, tmp_path):
    """The multiplier of x' = cos 2 pi t - k x is exp(-k), with k = f(1) as Python computes it."""
    monkeypatch.chdir(tmp_path)
    before, change = CHANGES[kind][0]
    space = made(f"{before}\n{CLOCKED}")
    sections = hj.ClockPhase(2)
    guess = hj.Guess("line", (0.0,))
    cycles = []
    for statement in ("", change):
        exec(statement, space)
        k = float(space["f"](1.0))
        for cycle in cycles:
            with pytest.raises(
                hj.errors.DefinitionError, match="the field of chart 'line'"
            ):
                hj.linearize(cycle, sections)
        cycles.append(hj.find_limit_cycle(space["Uses"](), guess))
        model = hj.linearize(cycles[-1], sections)
        assert_allclose(model.multipliers, [np.exp(-k)], rtol=1e-9)


# Changes that leave the numbers as they are, for an x that JAX traces.
SAME = "True for 1", "a function by types"


@pytest.mark.parametrize("way", WAYS)
def test_a_change_of_what_code_reads_is_seen_by_systems(way, monkeypatch):
    monkeypatch.setenv("K", "1")
    before, change = WAYS[way]
    other = types.ModuleType("users_other")
    inner = types.ModuleType("users_inner")
    inner.K = 1
    other.K = 1
    other.h = lambda x: x
    other.inner = inner
    space = made("")
    space["other"] = other
    exec(before, space)
    first = digest_or_refusal(space)
    assert digest_or_refusal(space) == first
    exec(change, space)
    assert (digest_or_refusal(space) == first) == (way in SAME)
    sys.modules.pop("users_third", None)


def test_systems_that_differ_in_numbers_of_their_classes_share_nothing():
    """Classes that `type` makes have the module of a package; a number may be anywhere."""

    def system(k):
        def field(t, q, u):
            return (k, 1.0)

        charts = {"line": Field(("x", "y"), field)}
        return type("Made", (hj.HybridSystem,), {"charts": lambda self, x=charts: x})()

    for k in (1.0, 1.0 + 1e-15, 2.0):
        way = hj.simulate(system(k), "line", (0.0, 0.0), 2.0)
        expected = [2 * k, 2.0]
        assert_allclose(way.after[-1], expected, rtol=1e-12)
    factors = (1.0, 1.0, 1.0 + 1e-15, 2.0)
    digests = [code_digest(system(k)) for k in factors]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


MIRRORED = """
K, SIZE, PUSH = 1.0, 1.0, 1.0

class Side(hj.Chart):
    states = ("x",)
    def field(self, t, q, u):
        return (-K * q[0] + PUSH,)

class Left(Side):
    def field(self, t, q, u):
        return (-K * q[0] + 1.0,)

class Both(hj.HybridSystem):
    def charts(self):
        return {"left": Left(), "right": Side()}
    def transitions(self):
        level = lambda t, q, u: q[0] - SIZE
        return [
            hj.Transition("step", "left", "right", level),
            hj.Transition("other step", "right", "left", level),
        ]

class Uses:
    def __new__(cls):
        return hj.systems.Symmetric(Both(), swap={"left": "right"})
"""


@pytest.mark.parametrize("change", ["K = 2.0", "SIZE = 2.0", "PUSH = 2.0"])
def test_a_change_inside_of_a_quotient_is_seen(change):
    """PUSH acts in the chart that is left out, whose symmetry is checked."""
    space = made(MIRRORED)
    first = digest_or_refusal(space)
    exec(change, space)
    assert digest_or_refusal(space) != first


# Programs of a module in a package of a user that define f(x) and read `constants.K`.
RELATIVE = {
    "a name": "def f(x):\n    from .constants import K\n    return K * x",
    "a module": "def f(x):\n    from . import constants\n    return constants.K * x",
    "a module of the package around": (
        "def f(x):\n    from ..users_package.constants import K as k\n    return k * x"
    ),
}


@pytest.mark.parametrize("way", RELATIVE)
def test_a_constant_of_a_relative_import_is_seen(way, monkeypatch, tmp_path):
    package = tmp_path / "around" / "users_package"
    package.mkdir(parents=True)
    (package / "constants.py").write_text("K = 1.0")
    (package / "system.py").write_text(SYSTEM + RELATIVE[way])
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("around.users_package.system")
    first = digest_or_refusal(vars(module))
    assert digest_or_refusal(vars(module)) == first
    constants = importlib.import_module("around.users_package.constants")
    constants.K = 2.0
    assert digest_or_refusal(vars(module)) != first
    for name in [x for x in sys.modules if x.partition(".")[0] == "around"]:
        sys.modules.pop(name)


# A script that changes what its system computes in three ways, and prints whether each was seen.
SCRIPT = """
import hybridjax as hj
from hybridjax._core.meaning import code_digest
{imports}
hj.enable_x64()
K = 1.0
class Line(hj.Chart):
    states = ("x",)
    factor = 1.0
    def field(self, t, q, u):
        return (K * {helper}(q[0]) * self.factor,)
class Uses(hj.HybridSystem):
    def charts(self):
        return {{"line": Line()}}
digests = [code_digest(Uses())]
K = 2.0
digests.append(code_digest(Uses()))
Line.factor = 2.0
digests.append(code_digest(Uses()))
{change}
digests.append(code_digest(Uses()))
print(len(set(digests)), "digests")
"""


@pytest.mark.parametrize("name", ["profile", "code", "calendar"])
def test_a_module_of_a_user_may_have_the_name_of_one_of_python(name, tmp_path):
    (tmp_path / f"{name}.py").write_text("C = 1.0\ndef h(x): return C * x")
    text = SCRIPT.format(
        imports=f"import {name}", helper=f"{name}.h", change=f"{name}.C = 2.0"
    )
    (tmp_path / "script.py").write_text(text)
    assert run_python("script.py", cwd=tmp_path).strip() == "4 digests"


@pytest.mark.parametrize("runner", ["cProfile", "profile", "pdb"])
@pytest.mark.slow
def test_what_a_script_changes_is_seen_under_a_runner(runner, tmp_path):
    text = SCRIPT.format(imports="", helper="float.__abs__", change="K = 3.0")
    text = text.replace("float.__abs__(q[0])", "q[0]")
    (tmp_path / "script.py").write_text(text)
    options = ["-c", "continue"] if runner == "pdb" else []
    assert "4 digests" in run_python(
        "-m", runner, *options, "script.py", cwd=tmp_path, input=""
    )


def test_parts_of_one_name_are_all_compared():
    def system(first, second):
        levels = [
            hj.Transition(
                "hit", "line", "line", lambda t, q, u, k=k: q[0] - k, "rising"
            )
            for k in (first, second)
        ]

        def line_rates(t, q, u):
            return (1.0,)

        charts = {"line": Field(("x",), line_rates)}
        names = {"charts": lambda self: charts, "transitions": lambda self: levels}
        return type("Made", (hj.HybridSystem,), names)()

    pairs = [(1.0, 2.0), (3.0, 2.0), (1.0, 3.0), (2.0, 1.0)]
    digests = {code_digest(system(*pair)) for pair in pairs}
    assert len(digests) == 4
