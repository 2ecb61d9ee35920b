"""LDTP: simulation, periodic states, transformations, bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj

from .conftest import blocks_at_random, simulate_blocks


# Few shapes, so that few programs are compiled: (dimensions, outputs, inputs).
SHAPES = [((3, 2, 4, 1), 2, 1), ((2, 2, 3), 1, 2), ((2,), 1, 1)]
seeds = st.integers(0, 2**32)


@settings(max_examples=6)
@given(seeds, st.sampled_from(SHAPES), st.sampled_from([0, 1, -3]))
def test_simulation_follows_the_definition(seed, shape, first_section):
    dims, ny, nu = shape
    blocks = blocks_at_random(seed, dims, ny, nu, gain=1.0)
    ldtp = hj.linear.LDTP.from_blocks(*blocks)
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(11, nu))
    x0 = rng.normal(size=dims[first_section % len(dims)])
    expected_states, expected_outputs = simulate_blocks(blocks, u, x0, first_section)

    states = np.asarray(ldtp.states(u, x0, first_section))
    for padded, expected in zip(states, expected_states, strict=True):
        d = len(expected)
        assert_allclose(padded[:d], expected, rtol=0, atol=1e-12)
        assert_array_equal(padded[d:], 0)
    outputs = ldtp.simulate(u, x0, first_section)
    assert_allclose(outputs, expected_outputs, rtol=0, atol=1e-12)


def test_periodic_state_of_an_unstable_system():
    # A^20 has the entries 1e20 and 1e-20; the stable part must not drown.
    A = np.array([[10.0, 0.0], [3.0, 0.1]])
    B = np.ones((2, 1))
    C = np.eye(2)
    ldtp = hj.linear.LDTP.from_blocks([A], [B], [C])
    rng = np.random.default_rng(0)
    u = rng.normal(size=(20, 1))
    # One linear system for the states of all periods: x[k+1] = A x[k] + B u[k], cyclically.
    next_period = np.roll(np.eye(20), 1, axis=0)
    states = np.linalg.solve(
        np.eye(40) - np.kron(next_period, A), np.kron(next_period, B) @ u[:, 0]
    )
    periodic = ldtp.periodic_state(u, 20)
    assert_allclose(periodic, states[:2], rtol=1e-12)


def test_jit_vmap_and_gradients(synthetic):
    u = np.random.default_rng(1).normal(size=(18, 2))
    plain = synthetic.simulate(u)
    assert_allclose(
        eqx.filter_jit(hj.linear.LDTP.simulate)(synthetic, u), plain, atol=1e-14
    )
    inputs = np.stack([u, 2 * u])
    many = jax.vmap(synthetic.simulate)(inputs)
    expected = np.stack([plain, 2 * plain])
    assert_allclose(many, expected, atol=1e-13)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), synthetic)
    direct = batch.D.at[1].set(0.0)
    batch = eqx.tree_at(lambda ldtp: ldtp.D, batch, direct)
    many = eqx.filter_vmap(lambda ldtp: ldtp.simulate(u))(batch)
    assert_allclose(many[0], plain, atol=1e-14)
    assert not np.allclose(many[1], plain)

    @jax.jit
    def scaled(s):
        ldtp = hj.linear.LDTP(
            s * synthetic.A, synthetic.B, synthetic.C, synthetic.D, synthetic.dims
        )
        end = ldtp.simulate(u)[-1]
        periodic = ldtp.periodic_state(u, 3)
        return jnp.concatenate([end, periodic])

    jax.test_util.check_grads(scaled, (0.9,), order=1, modes=("rev",), eps=1e-6)


def test_jit_and_vmap(synthetic):
    rng = np.random.default_rng(1)
    u = rng.normal(size=(18, 2))
    plain = synthetic.simulate(u)
    compiled = eqx.filter_jit(hj.linear.LDTP.simulate)(synthetic, u)
    assert_allclose(compiled, plain, atol=1e-14)
    inputs = np.stack([u, 2 * u])
    two_inputs = jax.vmap(synthetic.simulate)(inputs)
    expected = np.stack([plain, 2 * plain])
    assert_allclose(two_inputs, expected, atol=1e-13)

    # The second system of a batch has no feedthrough.
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), synthetic)
    direct = batch.D.at[1].set(0.0)
    batch = eqx.tree_at(lambda ldtp: ldtp.D, batch, direct)
    two_systems = eqx.filter_vmap(lambda ldtp: ldtp.simulate(u))(batch)
    assert_allclose(two_systems[0], plain, atol=1e-14)
    assert not np.allclose(two_systems[1], plain)


def test_gradients(synthetic):
    rng = np.random.default_rng(1)
    u = rng.normal(size=(18, 2))

    @jax.jit
    def response(s):
        A = s * synthetic.A
        ldtp = hj.linear.LDTP(A, synthetic.B, synthetic.C, synthetic.D, synthetic.dims)
        last = ldtp.simulate(u)[-1]
        periodic = ldtp.periodic_state(u, 3)
        return jnp.concatenate([last, periodic])

    jax.test_util.check_grads(response, (0.9,), order=1, modes=("rev",), eps=1e-6)


def test_systems_known_outside_of_jit_work_inside(synthetic):
    s = synthetic
    f = [0.3, 0.4]
    harmonics = (0, 1)

    @jax.jit
    def inside(u):
        ldtp = hj.linear.LDTP(s.A, s.B, s.C, s.D, s.dims)
        htf = ldtp.htf(f, harmonics)
        for printed in (ldtp, htf, s.htf([0.3])):
            repr(printed)
        x0 = s.periodic_state(u, 2)
        outputs = ldtp.simulate(u, x0[:3])
        error = htf.error(s.htf(f, harmonics))
        return outputs, error

    rng = np.random.default_rng(2)
    u = rng.normal(size=(12, 2))
    y, error = inside(u)
    expected = s.simulate(u, s.periodic_state(u, 2))
    assert_allclose(y, expected, atol=1e-13)
    assert_allclose(error, 0, atol=1e-14)


A = np.zeros((2, 3, 3))


B = np.zeros((2, 3, 1))


C = np.zeros((2, 1, 3))


GOOD = {"A": A, "B": B, "C": C}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"C": np.zeros((2, 0, 3))}, "without empty axes"),
        ({"dims": [3, 4]}, "`dims` must lie between 0 and 3"),
        ({"dims": [3, 2], "A": A + 1}, r"`A\[0\]` has entries outside"),
        ({"dims": [3, 2], "B": B + 1}, r"`B\[0\]` has entries outside"),
        ({"dims": [3, 2], "C": C + 1}, r"`C\[1\]` has entries outside"),
    ],
)
def test_bad_definitions(change, message):
    with pytest.raises(hj.errors.DefinitionError, match=message):
        hj.linear.LDTP(**(GOOD | change))


def test_single_precision_is_refused():
    with pytest.raises(hj.errors.PrecisionError, match="A.*float32"):
        single = jnp.zeros((2, 3, 3), jnp.float32)
        hj.linear.LDTP(**(GOOD | {"A": single}))


def test_a_response_without_bounds_is_refused():
    quarter_turn = [[[0.0, -1.0], [1.0, 0.0]]]
    B = np.ones((1, 2, 1))
    C = np.ones((1, 1, 2))
    rotation = hj.linear.LDTP(quarter_turn, B, C)
    rotation.periodic_state(np.ones((3, 1)), 3)
    with pytest.raises(
        hj.errors.DefinitionError, match="f = 0.25 cycles per period is unbounded"
    ):
        rotation.periodic_state(np.ones((4, 1)), 4)
