"""Code is looked at once in a public call, and again in each call of a user's function."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core import meaning

from ..toys import Field


hj.enable_x64()
SECTIONS = hj.ClockPhase(2)
DRAG = [0.7]


@dataclasses.dataclass(frozen=True)
class Water:
    name: str
    drag: float = dataclasses.field(compare=False)


class Slowed(hj.HybridSystem):
    """x' = cos 2 pi t - k x, whose multiplier is exp(-k)."""

    water: Water | None = eqx.field(static=True, default=None)
    wind: hj.Parameter = hj.parameter(0.0)

    def period(self):
        return 1.0

    def charts(self):
        k = DRAG[0] if self.water is None else self.water.drag

        def force(t, u):
            push = jnp.cos(2 * jnp.pi * t)
            return push + self.wind + u[0]

        def air_rates(t, q, u):
            return (force(t, u) - k * q[0],)

        return {"air": Field(("x",), air_rates)}

    def guess(self):
        return hj.Guess("air", (0.1,))


@pytest.fixture(autouse=True)
def same_drag(monkeypatch):
    monkeypatch.setitem(globals(), "DRAG", [0.7])


def test_a_function_that_a_public_call_calls_may_change_what_a_system_computes():
    def multiplier(rng):
        DRAG[0] += 0.1
        cycle = hj.find_limit_cycle(Slowed())
        return {"drag": DRAG[0], "value": cycle.multipliers[0].real}

    draws = hj.scale.monte_carlo(multiplier, 3)
    assert len(np.unique(draws.drag)) == 3
    assert_allclose(draws.value, np.exp(-draws.drag), rtol=1e-9)


@pytest.mark.parametrize(
    "use",
    [
        lambda cycle: hj.linearize(cycle, SECTIONS, "x"),
        lambda cycle: cycle.trajectory(),
        lambda cycle: hj.continuation(cycle, "wind", (-0.01, 0.01)),
        lambda cycle: hj.sections.place_sections(cycle, SECTIONS).observe("x"),
    ],
)
def test_a_cycle_is_compared_in_each_call_of_a_users_function(use):
    cycle = hj.find_limit_cycle(Slowed())

    def changed(rng):
        use(cycle)
        DRAG[0] = 1.3
        use(cycle)
        return 0.0

    with pytest.raises(
        hj.errors.DefinitionError, match="of chart 'air' of Slowed has changed"
    ):
        hj.scale.monte_carlo(changed, 1)


def test_systems_given_together_that_are_equal_may_compute_something_else():
    systems = [Slowed(Water("lake", k)) for k in (0.7, 1.3)]
    assert systems[0].water == systems[1].water
    first = hj.find_limit_cycle(systems[0])
    with pytest.raises(hj.errors.DefinitionError, match="systems"):
        hj.orbits.find_limit_cycles(systems, first)
    for system, k in zip(systems, (0.7, 1.3), strict=True):
        cycle = hj.find_limit_cycle(system)
        assert_allclose(cycle.multipliers, [np.exp(-k)], rtol=1e-9)


@pytest.mark.parametrize(
    ("use", "most"),
    [
        (lambda cycle: hj.find_limit_cycle(Slowed(), cycle), 1),
        (lambda cycle: hj.linearize(cycle, SECTIONS, "x").multipliers, 2),
        (lambda cycle: hj.continuation(cycle, "wind", (-0.01, 0.01)), 1),
        (lambda cycle: hj.sweep(Slowed(), {"wind": [0.1, 0.2]}, guess=cycle), 1),
        (repr, 1),
    ],
)
def test_code_is_read_once_in_a_public_call(use, most, monkeypatch):
    cycle = hj.find_limit_cycle(Slowed())
    count = []
    digest_of = meaning._digest_of

    def counted(x):
        count.append(type(x).__name__)
        return digest_of(x)

    monkeypatch.setattr(meaning, "_digest_of", counted)
    use(cycle)
    assert 1 <= len(count) <= most, count
