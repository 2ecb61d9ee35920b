"""What does not fit the annotations of a public function is refused with one sentence; what fits
arrives in one form."""

import dataclasses
import inspect
import pickle
import pydoc
import typing
from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Annotated, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from numpy.testing import assert_array_equal

import hybridjax as hj
from hybridjax._core.boundary.checked import checked
from hybridjax._core.boundary.containers import Names
from hybridjax._core.boundary.kinds import (
    Count,
    FilePath,
    Numbers,
    Positive,
    Scalar,
    SignalNames,
)
from hybridjax._core.boundary.values import Complexes, Integers, Number, Reals


NAN = float("nan")
INF = float("inf")
MATRIX = Annotated[Numbers, Reals("N d")]
GAPS = Annotated[Numbers, Reals("n", missing=True)]

# An annotation, what is given, and what arrives.
TAKEN = [
    (int, np.int32(3), 3),
    (Count | None, None, None),
    (float, 3, 3.0),
    (float, jnp.array(0.5), 0.5),
    (
        Annotated[
            float, Number("no bound or a positive number", above=0, infinite=True)
        ],
        INF,
        INF,
    ),
    (bool, np.True_, True),
    (Literal["a", "b"], "b", "b"),
    (Sequence[int], np.arange(2), [0, 1]),
    (Iterable[str], iter("ab"), ("a", "b")),
    (tuple[float, float], [1, 2], (1.0, 2.0)),
    (Mapping[str, float], {"a": 1}, {"a": 1.0}),
    (SignalNames, "a", ("a",)),
    (SignalNames, ["a", "b"], ("a", "b")),
    (Annotated[SignalNames, Names(empty=True)], (), ()),
    (Annotated[Numbers, Reals()], [1, 2], np.array([1.0, 2.0])),
    (Annotated[Numbers, Reals("n 2")], np.ones((3, 2), np.float32), np.ones((3, 2))),
    (GAPS, np.ma.masked_less([1, 2], 2), np.array([NAN, 2.0])),
    (
        Annotated[Numbers, Reals("n", missing=True, infinite=True)],
        [INF, NAN],
        np.array([INF, NAN]),
    ),
    (Annotated[Numbers, Reals("n")], jnp.arange(2), jnp.arange(2.0)),
    (Annotated[Numbers, Complexes("n")], [1, 2j], np.array([1, 2j])),
    (Annotated[Numbers, Integers("n")], np.arange(2, dtype=np.uint8), np.arange(2)),
]

# An annotation, what is given, and what is said of it.
REFUSED = [
    (int, 8.5, "must be an integer, not 8.5"),
    (int, True, "must be an integer, not True"),
    (Count, 0, "must be an integer from 1 to 1000000000, not 0"),
    (float, NAN, "must be a finite number, not nan"),
    (float, 10**400, "must be a finite number, not 1000"),
    (Positive, 0, "must be a positive number, not 0"),
    (bool, 1, "must be True or False, not 1"),
    (Literal["a", "b"], "c", "must be 'a' or 'b', not 'c'"),
    (int | str | None, 0.5, "must be an integer, a string or None, not 0.5"),
    (FilePath, "", "must be the name of a file or folder, not ''"),
    (Sequence[str], "ab", "must be a sequence (each item a string), not 'ab'"),
    (
        tuple[float, float],
        (1.0,),
        "must be a tuple of 2 (a finite number, a finite number)",
    ),
    (Mapping[str, Positive], {"a": -1}, "`x['a']` must be a positive number, not -1"),
    (Mapping[str, int], {1: 2}, "[1]` must be a string, not 1"),
    (SignalNames, ["a", "a"], "must name each only once, not ('a', 'a')"),
    (hj.Output, 3, "must be an Output, not 3"),
    (hj.HybridSystem, hj.models.VerticalHopper, "not the class VerticalHopper itself"),
    (MATRIX, [1.0], "must be of shape (N, d), not of shape (1,)"),
    (MATRIX, [[1], [1, 2]], "must be rectangular: its rows differ in length"),
    (MATRIX, np.zeros((2, 2), complex), "must be real, not an array of complex128"),
    (MATRIX, "x", "must be an array of real numbers with shape (N, d), not 'x'"),
    (MATRIX, [[0, 1], [NAN, 0]], "must be finite, but is nan at index (1, 0)"),
    (
        MATRIX,
        SimpleNamespace(columns=["b"]),
        "not a table: give `table[names].to_numpy()`",
    ),
    (GAPS, [0, INF], "must be finite, but is inf at index 1"),
    (
        Annotated[Numbers, Reals("n", sign="positive")],
        [1, 0],
        "must be positive, but is 0 at",
    ),
    (
        Annotated[Numbers, Reals("n", sign="nonnegative")],
        [1, -2],
        "must be zero or positive, but",
    ),
    (
        Annotated[Numbers, Reals("N N")],
        np.zeros((2, 3)),
        "must be of shape (N, N), not of",
    ),
    (Annotated[Numbers, Integers("n")], [0.5], "must hold integers, not float64"),
]


def called(annotation, value):
    @checked
    def function(x: annotation):
        return x

    return function(value)


@pytest.mark.parametrize("annotation, given, expected", TAKEN)
def test_what_fits_arrives_in_one_form(annotation, given, expected):
    found = called(annotation, given)
    assert type(found) is type(expected)
    assert_array_equal(found, expected)
    assert getattr(found, "dtype", None) == getattr(expected, "dtype", None)


def test_arrays_that_may_hold_any_number_are_not_read(monkeypatch):
    monkeypatch.setattr(np, "sum", None)  # (They may lie on disk.)
    hint = Annotated[Numbers, Reals("n", missing=True, infinite=True)]
    called(hint, np.zeros(2))


@pytest.mark.parametrize("annotation, given, said", REFUSED)
def test_what_does_not_fit_is_refused_in_one_sentence(annotation, given, said):
    with pytest.raises(hj.errors.DefinitionError) as caught:
        called(annotation, given)
    text = str(caught.value)
    assert said in text, text
    assert "function: `x" in text
    assert text.endswith(".")
    assert "\n" not in text


@checked
def several(a: int, /, b: Count = 0, *rest: str, c: Literal["x"] = "x", **options: int):
    """What it does."""
    return a, b, rest, c, options


def test_every_parameter_is_checked_however_it_is_given():
    found = several(1, 2, "r", c="x", other=3)
    assert found == (1, 2, ("r",), "x", {"other": 3})
    for bad, name in [
        (lambda: several("1"), "a"),
        (lambda: several(1, -2), "b"),
        (lambda: several(1, b=-2), "b"),
        (lambda: several(1, 2, "r", 3), "rest"),
        (lambda: several(1, c="y"), "c"),
    ]:
        with pytest.raises(
            hj.errors.DefinitionError, match=f"^several: `{name}` must be "
        ):
            bad()


def test_a_checked_function_looks_as_before():
    assert several.__doc__ == "What it does."
    assert several.__name__ == "several"
    assert list(inspect.signature(several).parameters) == [
        "a",
        "b",
        "rest",
        "c",
        "options",
    ]
    assert pickle.loads(pickle.dumps(several)) is several


def test_signatures_are_short():
    """Kinds have their names, in `help` as well; type checkers see the whole annotations."""
    assert str(inspect.signature(several)) == (
        "(a: int, /, b: Count = 0, *rest: str, c: Literal['x'] = 'x', **options: int)"
    )
    # (The constructor that `dataclasses` makes has no source; its fields have.)
    fields = str(inspect.signature(hj.scale.Execution))
    assert fields.startswith("(batch: ExperimentCount | None = None, workers: Worker")
    text = pydoc.render_doc(hj.run_experiments)
    page = pydoc.plain(text)
    first_line = page.split("\n")[2]
    assert len(first_line) < 600
    assert first_line.startswith(
        "run_experiments(cycle: LimitCycle, sections: SectionsLike"
    )
    hints = typing.get_type_hints(several, include_extras=True)
    assert hints["b"] == Count


@checked
class Module(eqx.Module):
    n: Count = eqx.field(static=True)
    x: Float[Array, ""] = eqx.field(
        converter=lambda x: jnp.asarray(x, float), default=0.0
    )

    def method(self, k: Count):
        return k

    @classmethod
    def make(cls, n: Count):
        return cls(n)

    @staticmethod
    def alone(n: Count):
        return n

    def __call__(self, k: Count):
        return k

    def _hidden(self, k: Count):
        return k


class Heir(Module):
    z: int = eqx.field(static=True, default=0)


def test_a_class_is_checked_where_it_is_built_and_used():
    module = Module(np.int64(3), 1)
    assert type(module.n) is int
    assert module.make(2).n == 2
    assert module.alone(1) == module(1) == 1
    for bad, name in [
        (lambda: Module(0), "Module: `n`"),
        (lambda: module.method(0), "Module.method: `k`"),
        (lambda: Module.make(0), "Module.make: `n`"),
        (lambda: Module.alone(0), "Module.alone: `n`"),
        (lambda: module(0), "Module.__call__: `k`"),
        (lambda: dataclasses.replace(module, n=0), "Module: `n`"),
    ]:
        with pytest.raises(
            hj.errors.DefinitionError, match=f"^{name} must be an integer"
        ):
            bad()
    assert module._hidden(0) == 0
    assert Heir(1, z=2).z == 2
    assert jax.tree_util.tree_map(lambda x: x, module).n == 3


@checked
class Pair(NamedTuple):
    first: Positive
    second: str = "b"


@checked
@dataclasses.dataclass(frozen=True)
class Data:
    first: Positive
    second: str = "b"


@pytest.mark.parametrize("cls", [Pair, Data])
def test_named_tuples_and_dataclasses_are_checked(cls):
    assert type(cls(1).first) is float
    copied = pickle.loads(pickle.dumps(cls(1)))
    assert copied == cls(1)
    with pytest.raises(
        hj.errors.DefinitionError, match=f"^{cls.__name__}: `second` must be a string"
    ):
        cls(1, second=2)


@checked
def summed(
    x: Annotated[Numbers, Reals("n")], scale: Scalar = 1.0, *, power: Positive = 1.0
):
    return jnp.sum(jnp.asarray(x) ** power) * scale


@checked
def on_host(x: Annotated[Numbers, Reals("n")]):
    return float(np.sum(x))


@checked
def around(x: Annotated[Numbers, Reals("n")]):
    return on_host(x)


def test_arrays_may_be_traced():
    x = jnp.arange(1.0, 4.0)
    assert jax.jit(summed)(x) == 6
    found = jax.grad(lambda s: summed(x, s))(2.0)
    assert found == 6
    slope = jax.grad(lambda s: summed([s, 1.0], s))(2.0)
    assert slope == 5
    stacked = jnp.stack([x, x])
    sums = jax.vmap(summed)(stacked)
    assert_array_equal(sums, [6, 6])
    with pytest.raises(
        hj.errors.DefinitionError, match=r"^summed: `x` must be of shape \(n,\)"
    ):
        jax.jit(summed)(1.0)


TRANSFORMS = {
    "jit": jax.jit,
    "vmap": lambda f: lambda x: jax.vmap(f)(x[None]),
    "grad": jax.grad,
}


@pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS)
def test_where_values_are_needed_a_sentence_says_so(transform):
    x = jnp.arange(3.0)
    with pytest.raises(
        hj.errors.DefinitionError, match="^summed: `power` must be .* traces it: call"
    ):
        transform(lambda x: summed(x, power=x[0]))(x)
    for function, name in [(on_host, "on_host"), (around, "around")]:
        with pytest.raises(
            hj.errors.DefinitionError,
            match=f"^{name} needs values, but JAX traces them",
        ):
            transform(function)(x)
    program = eqx.filter_jit(lambda n: several(1, n))
    assert program(2) == (1, 2, (), "x", {})
