"""`find_limit_cycle` with the arguments of an earlier call, as in a cell of a notebook that is run
again: the cycle is remembered if nothing that it depends on has changed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.orbits import find, near


RADIUS = 1.0


def spiral(t, q):
    """It leads to the circle of radius `RADIUS`, which takes a period of 2 pi."""
    x, y = q
    inward = RADIUS**2 - x**2 - y**2
    return inward * x - y, inward * y + x


@pytest.fixture
def searches(monkeypatch):
    """The searches that happen, as a list that grows."""
    seen = []
    search = find._from_guess

    def counted(request):
        seen.append(request)
        return search(request)

    monkeypatch.setattr(find, "_from_guess", counted)
    return seen


def circle(guess=(1.1, 0.2), **options):
    system = hj.HybridSystem.from_functions(("x", "y"), spiral)
    return hj.find_limit_cycle(system, guess, **options)


def test_the_same_call_is_searched_once(searches):
    first = circle()
    again = circle()
    assert len(searches) == 1
    assert_allclose(again.period, 2 * np.pi, rtol=0, atol=1e-10)
    assert again.period == first.period
    assert (again.multipliers == first.multipliers).all()


@pytest.mark.parametrize(
    ("guess", "options"),
    [
        ((1.0, 0.3), {}),
        ((1.1, 0.2), {"section": hj.Crossing("x", "falling")}),
        ((1.1, 0.2), {"settle": 1.0}),
        ((1.1, 0.2), {"settings": hj.orbits.Settings(rtol=1e-9)}),
        ((1.1, 0.2), {"max_period": 20.0}),
        ((1.1, 0.2), {"scale": {"x": 2.0}}),
    ],
)
def test_other_arguments_are_searched(searches, guess, options):
    circle()
    circle(guess, **options)
    assert len(searches) == 2


def test_a_constant_that_the_field_reads_has_changed(searches, monkeypatch):
    assert circle().trajectory().after.max() == pytest.approx(1.0, abs=1e-3)
    monkeypatch.setitem(globals(), "RADIUS", 2.0)
    assert circle().trajectory().after.max() == pytest.approx(2.0, abs=1e-3)
    assert len(searches) == 2


def test_another_parameter_is_another_cycle(searches):
    for rate in (1.0, 2.0, 1.0):

        def field(t, q, u, p):
            x, y = q
            inward = 1 - x**2 - y**2
            return inward * x - p.rate * y, inward * y + p.rate * x

        system = hj.HybridSystem.from_functions(
            ("x", "y"), field, parameters={"rate": rate}
        )
        cycle = hj.find_limit_cycle(system, (1.1, 0.2))
        assert_allclose(cycle.period, 2 * np.pi / rate, rtol=0, atol=1e-10)
    assert len(searches) == 2


def make_class(name):
    """A class that is defined again, as by a cell of a notebook, with an output of that name."""

    class Plane(hj.Chart):
        states = ("x", "y")

        def field(self, t, q, u):
            return spiral(t, q)

    class Spiral(hj.HybridSystem):
        def charts(self):
            return {"plane": Plane()}

        def outputs(self):
            return [hj.Output(name, lambda t, q, u: jnp.hypot(q[0], q[1]))]

        def guess(self):
            return hj.Guess("plane", (1.1, 0.2))

    return Spiral


def test_a_class_that_is_defined_again_keeps_its_own_outputs(searches):
    for name in ("radius", "distance", "radius"):
        system = make_class(name)()
        cycle = hj.find_limit_cycle(system)
        assert type(cycle.system) is type(system)
        _, values = cycle.trajectory()(name)
        assert_allclose(values, 1.0, rtol=0, atol=1e-6)  # (an interpolation)
    assert len(searches) == 2


def test_a_search_that_fails_is_searched_again(searches):
    """A fall is the same fall each time, with its reason."""
    for _ in range(2):
        with pytest.raises(hj.errors.ComputationError, match="leads to an equilibrium"):
            hj.find_limit_cycle(lambda t, q: (-q[0], -q[1]), (1.0, 0.5))


def test_few_cycles_near_a_known_one_are_not_worth_compiling(monkeypatch):
    """Compiling takes seconds: a user who changes a constant a few times does not wait for it."""

    def compiles(*_, **__):
        raise AssertionError("a program is compiled")

    cycle = hj.find_limit_cycle(hj.models.VanDerPol(mu=1.0))
    monkeypatch.setattr(near, "whole", compiles)
    monkeypatch.setattr(near, "_searching", near.collections.defaultdict(float))
    for mu in (1.01, 1.02, 1.03, 1.04):
        near_it = hj.find_limit_cycle(hj.models.VanDerPol(mu=mu), cycle)
        assert near_it.result == hj.errors.Result.OK
    monkeypatch.setattr(near, "_WORTH_COMPILING", 0.0)
    with pytest.raises(AssertionError, match="a program is compiled"):
        hj.find_limit_cycle(hj.models.VanDerPol(mu=1.05), cycle)


def oscillation():
    return hj.find_limit_cycle(hj.models.VanDerPol(mu=1.0))


@pytest.mark.parametrize("given_away", ["first", "second"])
def test_calls_share_no_numbers(searches, given_away):
    """A user may let JAX write over the numbers of one cycle, and has the others still."""
    cycles = {"first": oscillation(), "second": oscillation()}
    lost = cycles.pop(given_away)
    (kept,) = cycles.values()
    for x in jax.tree_util.tree_leaves(lost):
        if isinstance(x, jax.Array):
            x.delete()
        elif isinstance(x, np.ndarray):
            x[...] = np.nan
    for cycle in (kept, oscillation()):
        assert_allclose(cycle.period, 6.6632868593, rtol=0, atol=1e-9)
        assert np.isfinite(cycle.settings.rtol)
        assert len(cycle.multipliers) == 1
    assert len(searches) == 1


@pytest.mark.slow
def test_systems_with_callbacks_are_searched_each_time(searches):
    """What a callback reads may have changed, and no program shows it."""
    rate = np.ones(200_000)  # (too large to be read)

    def told(x):
        return rate[0] * x

    @jax.custom_jvp
    def scaled(x):
        return jax.pure_callback(
            told, jax.ShapeDtypeStruct((), x.dtype), x, vmap_method="sequential"
        )

    @scaled.defjvp
    def along(primals, tangents):
        return scaled(*primals), scaled(*tangents)

    def field(t, q):
        x, y = q
        inward = 1 - x**2 - y**2
        return inward * x - scaled(y), inward * y + scaled(x)

    for speed in (1.0, 2.0):
        rate[:] = speed
        cycle = hj.find_limit_cycle(field, (1.1, 0.2))
        assert_allclose(cycle.period, 2 * np.pi / speed, rtol=0, atol=1e-9)
    assert len(searches) == 2
