"""Contacts that are written once: the same events as if each were written by itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core.executor import to_host
from hybridjax.engine.replay import chain
from hybridjax.systems.structure import Structure

from ..conftest import unchecked_host
from ..engine.test_chain import flow
from ..toys import Field


class Mark(eqx.Module):
    """Where the first coordinate of a point on a circle falls or rises through a level."""

    levels: jax.Array
    weight: jax.Array
    i: int

    def guard(self, t, q, u):
        return q[0] - self.levels[self.i]

    def reset(self, t, q, u):
        change = self.weight * 10.0**self.i
        return q.at[2].add(change)

    def enabled(self, t, q, u):
        return q[2] < 700.0


class Growing(Mark):
    """Multiplies with the weight."""

    def reset(self, t, q, u):
        return q.at[2].multiply(self.weight)


class Halving(Mark):
    """Adds 2^-i."""

    def reset(self, t, q, u):
        return q.at[2].add(2**-self.i)


class Circle(hj.HybridSystem):
    """A point that turns at rate 1, and counts marks in a third state."""

    mark: type = eqx.field(static=True, default=Mark)
    apart: bool = eqx.field(static=True, default=False)
    weights: jax.Array = eqx.field(default_factory=lambda: jnp.array([1.0, 2.0, 3.0]))
    levels: jax.Array = eqx.field(default_factory=lambda: jnp.array([0.6, -0.2, 0.1]))

    def charts(self):
        def turn_rates(t, q, u):
            return (-q[1], q[0], 0.0)

        return {"turn": Field(("x", "y", "n"), turn_rates)}

    def transitions(self):
        found = []
        for i, weight in enumerate(self.weights):
            x = self.mark(self.levels, weight, i)
            for way in ("falling", "rising"):
                functions = x.guard, x.reset, x.enabled
                if self.apart:
                    functions = [lambda t, q, u, f=f: f(t, q, u) for f in functions]
                guard, reset, enabled = functions
                name = f"{i} {way}"
                found.append(
                    hj.Transition(name, "turn", "turn", guard, way, reset, enabled)
                )
        return found


START = (0.9, (1 - 0.81) ** 0.5, 0.0)


def run(system):
    return hj.simulate(system, "turn", START, 9.0)


def test_kinds_are_found():
    circle = Structure(Circle())
    assert circle.kinds == [(0, 2, 4), (1, 3, 5)]
    apart = Structure(Circle(apart=True))
    assert apart.kinds == [(g,) for g in range(6)]
    chain = Structure(hj.models.BouncingChain(n=3))
    assert chain.kinds == [(0, 1, 2)]
    bar = Structure(hj.models.TwoLeggedBar())
    assert bar.kinds == [(g,) for g in range(8)]


@pytest.mark.parametrize("other", [Circle(apart=True)])
def test_events_are_those_of_transitions_of_their_own(other):
    one = run(Circle())
    two = run(other)
    assert len(one.events) == 8
    names = [e.name for e in one.events]
    other_names = [e.name for e in two.events]
    assert names == other_names
    times = [e.time for e in one.events]
    other_times = [e.time for e in two.events]
    assert_allclose(times, other_times)
    counts = [e.after["n"] for e in one.events]
    other_counts = [e.after["n"] for e in two.events]
    assert counts == other_counts


def test_numbers_are_those_of_python():
    """In JAX, an integer to the power of one that is negative is another number."""
    one = run(Circle(mark=Halving))
    two = run(Circle(mark=Halving, apart=True))
    counts = [e.after["n"] for e in one.events]
    other_counts = [e.after["n"] for e in two.events]
    assert counts == other_counts
    steps = np.diff([e.after["n"] for e in one.events])
    assert set(steps) == {1.0, 0.5, 0.25}


def test_jacobians_are_those_of_each():
    s = Structure(to_host(Circle(mark=Growing)))
    with unchecked_host():
        end, lanes, target, done = flow(
            s, 0.0, np.array([*START[:2], 1.0]), np.zeros(s.nu), 3.0
        )
        found = chain(s, lanes, target, done.tape, of_states=True)
        jacobian = found[0][0]
    assert end[3] == 6.0  # three different factors
    assert_allclose(jacobian[3], [0.0, 0.0, 6.0], atol=1e-12)
