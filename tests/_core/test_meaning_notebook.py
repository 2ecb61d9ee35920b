"""Ordinary cells of a notebook, after which a system computes what it did: nothing has changed."""

import sys
import types

import matplotlib
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core import meaning
from hybridjax._core.meaning import change_of, code_digest, current

from ..conftest import no_compilation


@pytest.fixture(autouse=True)
def options_of_numpy():
    """Cells may change options of NumPy, for themselves."""
    with np.printoptions(), np.errstate():
        yield


matplotlib.use("agg")

IMPORTS = """
import copy, functools, gc, importlib, logging, os, pickle, sys, threading, time, typing, warnings
import equinox as eqx, jax, jax.numpy as jnp, numpy as np, pandas as pd
import matplotlib.pyplot as plt
import hybridjax as hj
import users_helpers
"""
CONSTANTS = """
K, J = 1.5, 2.0
TABLE = np.linspace(0.0, 1.0, 7)
calls, seen, log, figure = {"n": 0}, [], logging.getLogger("users"), plt.figure()
class Pair(typing.NamedTuple):
    a: float
    b: float
    def product(self):
        return self.a * self.b
pair = Pair(1.0, 2.0)
"""
HELPER = """
def helper(x):
    return K * x + users_helpers.gain(x) + pair.product()
"""
SYSTEM = """
class Line(hj.Chart):
    states = ("x",)
    system: "Uses"
    def field(self, t, q, u):
        return (-self.system.k * helper(q[0]),)

class Uses(hj.HybridSystem):
    k: hj.Parameter = hj.parameter(1.0)
    def charts(self):
        return {"line": Line(self)}
    def transitions(self):
        return [hj.Transition("hit", "line", "line", lambda t, q, u: q[0] - 1.0)]
    def outputs(self):
        return [hj.Output("z", lambda t, q, u: TABLE[2] * q[0])]
"""
HELPERS = "C = 0.5\ndef gain(x):\n    return C * x**2\n"

# Cells by what they do. Two cells: the first belongs to the notebook from the start.
CELLS = {
    "imports again": IMPORTS,
    "constants again": CONSTANTS,
    "a helper again": HELPER,
    "the same class again": SYSTEM,
    "all cells again": IMPORTS + CONSTANTS + HELPER + SYSTEM,
    "blank lines": HELPER.replace("\n", "\n\n"),
    "comments": HELPER.replace("(x):", "(x):  # of x"),
    "a text that describes a helper": HELPER.replace("(x):", '(x):\n    """Of x."""'),
    "a text that describes a class": SYSTEM.replace(
        "(hj.HybridSystem):", '(hj.HybridSystem):\n    """A line."""'
    ),
    "annotations": HELPER.replace("(x):", "(x: float) -> float:"),
    "another name of a variable": HELPER.replace("(x)", "(y)").replace("* x", "* y"),
    "a name for a step": (
        "def helper(x):\n    first = K * x\n    gained = users_helpers.gain(x)\n"
        "    return first + gained + pair.product()"
    ),
    "a helper that is compiled": "helper = jax.jit(helper)",
    "a helper that is wrapped": (
        "plain = helper\n@functools.wraps(plain)\ndef helper(x):\n    return plain(x)"
    ),
    "a helper of a helper": (
        "def first(x):\n    return K * x\n"
        "def helper(x):\n    return first(x) + users_helpers.gain(x) + pair.product()"
    ),
    "a method that is not used": SYSTEM
    + "    def energy(self, q):\n        return q[0]",
    "an attribute that is not used": "Uses.note = 'first try'",
    "a guess": "Uses.guess = lambda self: hj.Guess('line', (0.2,))",
    "a picture": "Uses.draw = lambda self, chart, t, q: hj.systems.Drawing([])",
    "a subclass": "class Other(Uses):\n    def period(self):\n        return 2.0",
    "another value of a parameter": "system = Uses(k=3.0)",
    "a parameter by tree_at": (
        "system = eqx.tree_at(lambda x: x.k, Uses(), jnp.asarray(3.0))"
    ),
    "a copy": "system = copy.deepcopy(Uses())",
    "an equal constant of numpy": "K = np.float64(1.5)",
    "an equal array": "TABLE = TABLE.copy()",
    "an array of which one entry is used": "TABLE = np.array([9.0, 9.0, TABLE[2]])",
    "a global that is not read": "unused = 3.0",
    "a global that is deleted": ("unused = 3.0", "del unused"),
    "a constant that is not read": "J = 7.0",
    "an attribute of a module that is not read": "users_helpers.note = 3.0",
    "a module again": "importlib.reload(users_helpers)",
    "a class in place, as autoreload does": (
        "class Again(hj.Chart):\n    states = ('x',)\n    system: 'Uses'\n"
        "    def field(self, t, q, u):\n        return (-self.system.k * helper(q[0]),)\n"
        "Line.field = Again.field"
    ),
    "a plot": "figure.gca().plot(TABLE)",
    "numbers drawn elsewhere": "np.random.seed(1)\nnoise = np.random.normal(size=9)",
    "options of numpy": "np.seterr(all='ignore')\nnp.set_printoptions(precision=3)",
    "filters of warnings": "warnings.simplefilter('ignore')",
    "caches of JAX cleared": "jax.clear_caches()",
    "garbage collected": "gc.collect()",
    "a variable of the environment": "os.environ['USERS_NOTE'] = '1'",
    "a timer around a call": "begin = time.time()\nhelper(1.0)\ntook = time.time() - begin",
    "a thread": (
        "thread = threading.Thread(target=helper, args=(1.0,))\nthread.start()\nthread.join()"
    ),
    "a table that is shown": "pd.DataFrame({'x': TABLE}).describe()",
    "a call of a helper by hand": "helper(jnp.ones(3))",
    "a derivative by hand": "jax.vmap(jax.grad(helper))(jnp.ones(3))",
    "a print in the helper": HELPER.replace(
        "    return", "    jax.debug.print('{}', x)\n    return"
    ),
    "a counter in the helper": (
        "def helper(x):\n    calls['n'] += 1\n    return K * x",
        "helper(1.0)",
    ),
    "a list that the helper fills": (
        "def helper(x):\n    seen.append(str(x.dtype))\n    return K * x",
        "seen.clear()",
    ),
    "a log in the helper": (
        "def helper(x):\n    log.debug('%s', x)\n    return K * x",
        "log.debug('another cell')\nlog.setLevel(logging.ERROR)",
    ),
    "a timer in the helper": (
        "def helper(x):\n    begin = time.time()\n    y = K * x\n"
        "    calls['took'] = time.time() - begin\n    return y",
        "helper(1.0)",
    ),
    "a figure that the helper reads": (
        "def helper(x):\n    figure.number\n    return K * x",
        "figure.gca().plot(TABLE)\nfigure.suptitle('a title')",
    ),
    "a table of pandas that the helper reads": (
        "frame = pd.DataFrame({'k': [1.0, 2.0]})\n"
        "def helper(x):\n    return float(frame.k[1]) * x",
        "frame['note'] = 0.0",
    ),
    "a file that the helper reads": (
        "np.savetxt('k', [1.0])\ndef helper(x):\n    return np.loadtxt('k') * x",
        "np.savetxt('k', [1.0])\nnp.savetxt('other', [2.0])",
    ),
}


@pytest.fixture
def notebook(monkeypatch, tmp_path):
    """The names of a notebook whose first cells have run, with a module of the user beside it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "users_helpers.py").write_text(HELPERS)
    monkeypatch.syspath_prepend(tmp_path)
    module = types.ModuleType("users_notebook")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for cell in (IMPORTS, CONSTANTS, HELPER, SYSTEM):
        exec(cell, vars(module))
    yield vars(module)
    sys.modules.pop("users_helpers")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CELLS)
def test_an_ordinary_cell_changes_nothing(name, notebook):
    cells = CELLS[name]
    first, cell = ("", cells) if isinstance(cells, str) else cells
    exec(first, notebook)
    before = current(notebook["Uses"]())
    exec(cell, notebook)
    after = notebook.get("system", notebook["Uses"]())
    assert change_of(before) is None
    assert code_digest(after) == before.code_digest


# Helpers that a second call reads in full, so that it needs no trace.
READ = {
    "constants": HELPER,
    "an object of a dataclass": (
        "import dataclasses\n@dataclasses.dataclass\nclass Spring:\n    k: float = 1.5\n"
        "spring = Spring()\ndef helper(x):\n    return spring.k * x"
    ),
    "a named tuple": (
        "import collections\nnames = collections.namedtuple('names', 'a b')(1.0, 2.0)\n"
        "def helper(x):\n    return names.a * x"
    ),
    "a cached property": (
        "class Spring:\n    @functools.cached_property\n    def k(self):\n        return 1.5\n"
        "spring = Spring()\nspring.k\ndef helper(x):\n    return spring.k * x"
    ),
    "a function for each entry": (
        "doubled = jnp.vectorize(lambda x: 2 * x)\ndef helper(x):\n    return doubled(x)"
    ),
    "a function that is compiled": "@jax.jit\ndef helper(x):\n    return K * x",
    "a branch": (
        "def helper(x):\n"
        "    return jax.lax.cond(x > 0, lambda y: K * y, lambda y: y, x)"
    ),
    "a network": (
        "network = eqx.nn.MLP(1, 1, 4, 1, key=jax.random.key(0))\n"
        "def helper(x):\n    return network(jnp.stack([x]))[0]"
    ),
}


@pytest.mark.parametrize("name", READ)
def test_a_second_call_traces_nothing(name, notebook, monkeypatch):
    exec(READ[name], notebook)
    first = code_digest(notebook["Uses"]())
    monkeypatch.setattr(meaning, "_traced", None)
    assert code_digest(notebook["Uses"]()) == first


def test_a_cycle_of_a_class_whose_cell_runs_again_needs_no_compilation(notebook):
    clocked = (
        "class Uses(hj.HybridSystem):\n"
        "    def charts(self):\n        return {'line': Driven()}\n"
        "    def period(self):\n        return 1.0\n"
        "class Driven(hj.Chart):\n    states = ('x',)\n"
        "    def field(self, t, q, u):\n"
        "        return (jnp.cos(2 * jnp.pi * t) - K * q[0] + u[0],)"
    )
    cycles = []

    def find():
        exec(clocked, notebook)
        guess = hj.Guess("line", (0.0,))
        cycles.append(hj.find_limit_cycle(notebook["Uses"](), guess))
        return cycles[-1].multipliers

    with no_compilation(find):
        assert_allclose(find(), [np.exp(-1.5)], rtol=1e-9)
    first, second = cycles
    assert type(first.system) is not type(second.system)


def test_the_notebook_notices_what_is_changed(notebook):
    """Each value that the cells above leave alone is read."""
    before = current(notebook["Uses"]())
    changes = {
        "K = 2.5": "the field of chart 'line' of Uses",
        "pair = Pair(1.0, 3.0)": "the field of chart 'line' of Uses",
        "users_helpers.C = 1.5": "the field of chart 'line' of Uses",
        "TABLE[2] = 9.0": "the output 'z' in chart 'line' of Uses",
        "Uses.period = lambda self: 1.0": "the period of Uses",
    }
    for cell, part in changes.items():
        exec(cell, notebook)
        assert change_of(before) == part
        before = current(notebook["Uses"]())
    assert isinstance(before, hj.HybridSystem)
