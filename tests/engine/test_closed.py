"""A closed system computes what the one it was made of does, and is known by that."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.compilation.fingerprint import IndescribableError, digest
from hybridjax._core.precision import single, single_precision
from hybridjax.engine.closed import close
from hybridjax.engine.target import AbstractLevels
from hybridjax.orbits.crossing import ListLevels
from hybridjax.systems.structure import Structure
from hybridjax.systems.system import Driven


MODELS = [name for name in dir(hj.models) if name[0].isupper()]


def functions(s, z, a, levels=None):
    """All functions of chart a, by name, with the same arguments (t, q, u)."""
    found = {"field": lambda *x: s.field(a, *x), "outputs": lambda *x: z(a, *x)}
    for g, transition in enumerate(s.transitions):
        if transition.source == s.names[a]:
            if g in s.guards(a):
                found[f"guard {g}"] = lambda *x, g=g: s.guard(g, *x)
            found[f"reset {g}"] = lambda *x, g=g: s.reset(g, *x)
            found[f"enabled {g}"] = lambda *x, g=g: s.enabled(g, *x) * 1.0
    if levels is not None and levels.present(s, a):
        found["level"] = lambda t, q, u: levels.level(s, a, jnp.asarray(0), t, q)
    return found


@pytest.mark.parametrize("name", MODELS)
def test_values_and_derivatives_are_the_same(name):
    system = getattr(hj.models, name)()
    s = Structure(system)
    states = [str(x) for x in s.state_names()]
    first = hj.Crossing(states[0], "falling", 0.1)
    names, levels = tuple(states), ListLevels((first,))
    closed, closed_levels = close(system, names, levels)
    c = Structure(closed)
    assert c.names == s.names and c.dims == s.dims and c.inputs == s.inputs
    about = lambda s: [(x.name, x.source, x.target) for x in s.transitions]  # noqa: E731
    assert about(c) == about(s)
    rng = np.random.default_rng(0)
    for a, n in enumerate(s.dims):
        own = functions(s, s.resolve_outputs(names), a, levels)
        others = functions(c, c.resolve_outputs(names), a, closed_levels)
        assert own.keys() == others.keys()
        x = tuple(map(jnp.asarray, (0.3, rng.uniform(0.2, 1, n), rng.uniform(-0.1, 0.1, s.nu))))
        for what in own:
            push = x, tuple(map(jnp.ones_like, x))
            pairs = zip(jax.jvp(own[what], *push), jax.jvp(others[what], *push), strict=True)
            for mine, other in pairs:
                np.testing.assert_allclose(other, mine, rtol=1e-13, atol=1e-13, err_msg=what)
    for x, y in zip(s.transitions, c.transitions, strict=True):
        if isinstance(x.guard, hj.Scheduled):
            assert x.guard.period == y.guard.period and x.guard.offset == y.guard.offset


class Flight(hj.Chart):
    states = ("y", "v")
    falling: "Falling"

    def field(self, t, q, u):
        return q[1], u[0] - self.falling.g + self.falling.extra(q)


class Falling(hj.HybridSystem):
    g: hj.Parameter = hj.parameter(9.81)
    up: bool = eqx.field(static=True, default=False)
    e: float = eqx.field(static=True, default=0.5)
    enabled: bool = eqx.field(static=True, default=False)
    extra: object = eqx.field(static=True, default=lambda q: 0.0)
    output: object = eqx.field(static=True, default=lambda t, q, u: q[0])

    def charts(self):
        return {"flight": Flight(self)}

    def transitions(self):
        enabled = (lambda t, q, u: q[1] < 0) if self.enabled else None
        reset = lambda t, q, u: (q[0], -self.e * q[1])  # noqa: E731
        direction = "rising" if self.up else "falling"
        return [
            hj.Transition(
                "b", "flight", "flight", lambda t, q, u: q[0], direction, reset, enabled=enabled
            )
        ]

    def outputs(self):
        return [hj.Output("z", self.output)]


class Levels(AbstractLevels):
    """Somebody's own."""

    height: float = eqx.field(static=True, default=1.0)

    def present(self, s, a):
        return True

    def level(self, s, a, i, t, q):
        return q[0] - self.height


def known(system, levels=None, outputs=("z",)):
    return digest(close(system, outputs, levels))


def test_what_is_changed_makes_another_program():
    noise = lambda scale: lambda q: scale * jax.nn.softplus(q[0])  # noqa: E731
    systems = [
        Falling(),
        Falling(up=True),
        Falling(e=0.6),
        Falling(enabled=True),
        Falling(extra=lambda q: 1e-9),
        Falling(extra=noise(1.0)),
        Falling(extra=noise(2.0)),
        Falling(output=lambda t, q, u: q[1]),
        Driven(Falling(), lambda t: jnp.sin(t)),
    ]
    found = [known(x) for x in systems]
    found += [known(Falling(), Levels()), known(Falling(), Levels(2.0)), known(Falling(), None, ())]
    assert len(set(found)) == len(found)
    assert found == [known(x) for x in systems] + found[len(systems) :]
    assert known(Falling(g=1.0)) == found[0]  # a parameter is an argument


def test_in_single_precision():
    double = known(Falling())
    with single_precision():
        closed, _ = close(single(Falling()), ("z",), None)
        s = Structure(closed)
        point = jnp.asarray(0.0), jnp.ones(2), jnp.zeros(1)
        assert s.field(0, *point).dtype == jnp.float32
        assert digest(closed, None) != double


def test_a_system_with_a_callback_cannot_be_closed():
    look = lambda q: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), q[0])  # noqa: E731
    with pytest.raises(IndescribableError):
        close(Falling(extra=look), (), None)
