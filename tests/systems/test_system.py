"""Systems as users write them: names, shapes and numbers checked, each error in one sentence."""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.systems.check import check_system
from hybridjax.systems.structure import Structure

from ..toys import Field, toy


def rates(t, q, u):
    return (q[1], -q[0])


def b_rates(t, q, u):
    return -q


ROOM = {
    "a": Field(("x", "v"), rates),
    "b": Field(("z",), b_rates),
}


def go_guard(t, q, u):
    return q[0]


def go_reset(t, q, u):
    return (q[0],)


TO_B = hj.Transition("go", "a", "b", go_guard, reset=go_reset)
SUM = hj.Output("sum", lambda t, q, u: q.sum())
HOPPER = hj.models.VerticalHopper()


def test_parameters_are_arrays_that_can_be_mapped_and_differentiated():
    hopper = hj.models.VerticalHopper(M=3)
    assert hopper.M == 3.0
    assert hopper.M.dtype == np.float64
    period = eqx.filter_grad(lambda h: h.period())(hopper)
    expected = -1 / (2 * np.pi)
    assert_allclose(period.omega, expected, rtol=1e-14)
    many = eqx.filter_vmap(lambda M: hj.models.VerticalHopper(M=M))(
        jnp.arange(1.0, 4.0)
    )
    assert_array_equal(many.M, [1.0, 2.0, 3.0])
    with pytest.raises(
        hj.errors.DefinitionError, match="no parameter 'K'; parameters are m, M, k"
    ):
        hj.models.VerticalHopper(K=1.0)
    with pytest.raises(hj.errors.DefinitionError, match="`period` must be a method"):
        type("Fixed", (hj.HybridSystem,), {"period": 1.0})


def replaced(**changes):
    """`TO_B` with some fields changed."""
    return toy(ROOM, (dataclasses.replace(TO_B, **changes),))


def moved(field, states=("x", "v")):
    return toy({"a": Field(states, field)})


class Early(hj.models.VerticalHopper):
    def charts(self):
        return super().charts() if self.k > 0 else {}


@pytest.mark.parametrize(
    "system, message",
    [
        (toy({}), "has no charts"),
        (moved(lambda t, q, u: (q[0], 1.0), ("x",)), r"field of chart 'a' returns"),
        (moved(lambda t, q, u: q, ("x", "x")), "states of the same name: 'x', 'x'"),
        (moved(lambda t, q, u: q, "xv"), "must be a tuple of names, not 'xv'"),
        (
            moved(lambda t, q, u: (q[1], math.sin(q[0]))),
            "write .* `jnp.sin` for `math.sin`",
        ),
        (
            moved(lambda t, q, u: (q[1], u - q[0])),
            r"`u\[0\]` are numbers, q and u are arrays",
        ),
        (moved(lambda t, q: q), r"fields, guards, resets and outputs take \(t, q, u\)"),
        (Early(), "uses a value that JAX does not know yet"),
        (toy(ROOM, outputs=(SUM, SUM)), "states and outputs of the same name"),
        (toy(ROOM, outputs=SUM), r"outputs\(\) must return a list"),
        (replaced(source="c"), "there is no chart 'c'; charts are a, b"),
        (
            replaced(reset=lambda t, q, u: q),
            r"reset of transition 'go' \(a -> b\) returns shape",
        ),
        (
            replaced(guard=lambda t, q, u: q),
            r"guard of transition 'go' \(a -> b\) returns shape",
        ),
        (
            replaced(guard=lambda t, q, u: q[0] > 0),
            "guard of 'go' must be `a - b`, not `a > b`",
        ),
        (
            replaced(enabled=lambda t, q, u: q > 0),
            r"`enabled` of transition 'go' .* returns shape",
        ),
        (
            moved(lambda t, q, u: (q[1], -q[2])),
            "field of chart 'a' cannot .* index 2 is out of",
        ),
        (toy(ROOM, (TO_B, TO_B)), "transitions of the same name: 'go', 'go'"),
        (
            eqx.tree_at(lambda s: s.k, HOPPER, jnp.array(np.inf)),
            "`k` of VerticalHopper is inf",
        ),
    ],
)
def test_what_is_wrong_is_said(system, message):
    with pytest.raises(hj.errors.DefinitionError, match=message):
        check_system(system)


def test_outputs_by_name_by_function_and_by_chart():
    energy = hj.Output(
        "energy", {"a": lambda t, q, u: q[0] ** 2 + q[1] ** 2 + t + u[0]}
    )
    s = Structure(toy(ROOM, outputs=(energy,)))
    z = s.resolve_outputs(("x", "energy", SUM))
    assert z.names == ("x", "energy", "sum")
    values = z(0, 1.0, jnp.array([2.0, 3.0]), jnp.array([10.0]))
    assert_array_equal(values, [2.0, 24.0, 5.0])
    assert z.defined(0)
    assert not z.defined(1)
    with pytest.raises(
        hj.errors.DefinitionError, match="output 'x' is not defined in chart 'b'"
    ):
        z.require(1)
    with pytest.raises(
        hj.errors.DefinitionError, match="there is no output 'y'; outputs are x, v"
    ):
        s.resolve_outputs("y")
