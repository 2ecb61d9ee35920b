"""Floquet multipliers and ranks of factor chains, against constructed and published truths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import linear_sum_assignment

import hybridjax as hj
from hybridjax.linear.multipliers import product_eigenvalues, product_rank


RTOL = 1e-12


def basis_at_random(rng, d):
    """A matrix with condition number at most 9."""
    draws = rng.normal(size=(d, d))
    left, _ = np.linalg.qr(draws)
    others = rng.normal(size=(d, d))
    right, _ = np.linalg.qr(others)
    widest = np.log(3)
    logarithms = rng.uniform(-widest, widest, d)
    sizes = np.exp(logarithms)
    return left * sizes @ right


def chain(rng, multipliers, extra):
    """Factors `S[n+1] diag(d[n], ...) S[n]^-1`; `extra[n]` more coordinates at section `n`.

    The product has the multipliers given (a complex number stands for a pair); the extra
    coordinates drive the others and die at a section where there are none.
    """
    N = len(extra)
    modes = sum(2 if np.iscomplex(m) else 1 for m in multipliers)
    S = [basis_at_random(rng, modes + more) for more in extra]
    share = rng.dirichlet(np.full(N, 10.0))
    factors = []
    for n in range(N):
        after = (n + 1) % N
        rows = modes + extra[after]
        columns = modes + extra[n]
        core = rng.normal(size=(rows, columns)) / 2
        core[:, :modes] = 0
        k = 0
        for m in multipliers:
            size = abs(m) ** share[n]
            if np.iscomplex(m):
                z = size * np.exp(1j * np.angle(m) * share[n])
                core[k : k + 2, k : k + 2] = [[z.real, -z.imag], [z.imag, z.real]]
                k += 2
            else:
                signed = np.sign(m) * size
                core[k, k] = signed if n == 0 else size
                k += 1
        inverse = np.linalg.inv(S[n])
        factors.append(S[after] @ core @ inverse)
    return factors


def largest_difference(found, true, relative):
    """The largest difference in the best pairing of two sets of numbers."""
    differences = np.abs(found[:, None] - true)
    if relative:
        differences = differences / np.abs(true)
    rows, columns = linear_sum_assignment(differences)
    return differences[rows, columns].max()


def relative_error(found, multipliers):
    true = []
    for m in multipliers:
        true.append(m)
        if np.iscomplex(m):
            true.append(np.conj(m))
    assert len(found) == len(true)
    return largest_difference(found, np.array(true), relative=True)


def assert_conjugate_and_sorted(found):
    moduli = np.abs(found)
    steps = np.diff(moduli)
    rounding = 1e-15 * np.abs(found[:-1])
    assert np.all(steps <= rounding)
    values = list(found)
    for value in values:
        assert np.conj(value) in values


@pytest.mark.parametrize(
    "multipliers",
    [
        [1.0, 7e-16],
        [1.0, -7e-16],
        [0.3 + 0.7j, 1e-10],
        [0.9, 0.5 + 0.1j, -1e-3, 1e-6],
        [1e8, 1.0, 1e-8],
        [1.0, 1e-20, 1e-40],
        [0.5, 0.500001],
        [-1.0, 1.0],
        [1j, -0.5],
    ],
)
def test_widely_spread_multipliers_keep_their_digits(multipliers, sections=32):
    rng = np.random.default_rng(sections)
    factors = chain(rng, multipliers, np.zeros(sections, int))
    found = product_eigenvalues(factors, RTOL)
    assert relative_error(found, multipliers) < 1e-11
    assert_conjugate_and_sorted(found)


@pytest.mark.parametrize(
    "multipliers", [[1.0, 1e-9], [0.3 + 0.7j, -1e-6], [0.9, 0.5 + 0.1j, 2.0]]
)
def test_dimensions_that_vary_add_no_multipliers(multipliers):
    # The extra coordinates drive the modes: the smaller a mode, the more its digits depend on them.
    rng = np.random.default_rng(5)
    extra = rng.integers(0, 3, 32)
    extra[5] = 0
    factors = chain(rng, multipliers, extra)
    found = product_eigenvalues(factors, RTOL)
    assert relative_error(found, multipliers) < 1e-10
    rotated = factors[5:] + factors[:5]
    assert product_rank(rotated, RTOL) == len(found)


@settings(max_examples=20)
@given(st.integers(0, 2**32), st.integers(1, 7), st.integers(1, 9))
def test_random_products_of_few_factors_agree_with_numpy(seed, d, sections):
    rng = np.random.default_rng(seed)
    factors = [rng.normal(size=(d, d)) for _ in range(sections)]
    found = product_eigenvalues(factors, RTOL)
    product = np.eye(d)
    for factor in factors:
        product = factor @ product
    expected, vectors = np.linalg.eig(product)
    # Backward error of the product, magnified by the sensitivity of its eigenvalues.
    norms = [np.linalg.norm(factor, 2) for factor in factors]
    size = np.prod(norms)
    condition = np.linalg.cond(vectors)
    bound = 1e-14 * d * sections * size * condition
    assert largest_difference(found, expected, relative=False) <= bound
    assert_conjugate_and_sorted(found)


def test_structural_zeros_are_counted_not_guessed():
    nilpotent = np.diag([1.0, 1.0], 1)  # dies after three cycles
    assert len(product_eigenvalues([nilpotent], RTOL)) == 0
    lengths = (1, 2, 3)
    ranks = [product_rank([nilpotent] * cycles, RTOL) for cycles in lengths]
    assert ranks == [2, 1, 0]

    mixed = np.zeros((4, 4))
    mixed[:3, :3] = nilpotent
    mixed[:, 3] = [3, 2, 5, 0.5]
    change = basis_at_random(np.random.default_rng(0), 4)
    mixed = change @ mixed @ np.linalg.inv(change)
    assert_allclose(product_eigenvalues([mixed], RTOL), [0.5], rtol=1e-12)
    assert product_rank([mixed], RTOL) == 3

    # A true multiplier of 1e-20 is none of them, a zero factor is.
    small = np.diag([1, 1e-2])
    assert len(product_eigenvalues([small] * 10, RTOL)) == 2
    zero = np.diag([1.0, 0.0])
    assert len(product_eigenvalues([zero] * 10, RTOL)) == 1


def test_products_that_leave_the_range_of_numbers():
    tiny = np.diag([1.0, 1e-200])
    huge = np.diag([1.0, 1e150])
    found = product_eigenvalues([tiny, tiny, huge, huge, tiny, huge], 0.0)
    assert_allclose(found, [1, 1e-150], rtol=1e-12, atol=0)
    assert_array_equal(product_eigenvalues([tiny, tiny], 0.0), [1, 0])


def test_defective_and_cyclic_products():
    block = np.array([[0.9, 0.3], [0.0, 0.9]])
    jordan = [block] * 8
    assert_allclose(product_eigenvalues(jordan, RTOL), 0.9**8, rtol=1e-6)
    shift = np.roll(np.eye(6), 1, axis=0)
    roots = product_eigenvalues([shift], RTOL)
    assert_allclose(roots**6, 1, atol=1e-13)
    assert_conjugate_and_sorted(roots)
    measured = product_eigenvalues([np.eye(3)] * 4, RTOL)
    assert_array_equal(measured, np.ones(3))


def test_hopper(hopper, reference):
    data = reference("ldtp_isochron")
    found = hopper.multipliers
    assert_allclose(found, data["eig_nonzero"][0], rtol=0, atol=1e-13)
    ranks = [hopper.rank(n) for n in range(32)]
    assert ranks == list(data["rank_monodromy"])
    expected = data["monodromy"][7]
    assert_allclose(hopper.monodromy(7), expected, rtol=0, atol=1e-14)


def test_the_synthetic_system(synthetic):
    dims = list(synthetic.dims)
    assert dims == [3, 2, 3, 2, 3, 2]
    pair = 0.3270675 + 0.0596405918293070j
    assert_allclose(synthetic.multipliers, [pair, pair.conjugate()], rtol=1e-13)


def test_characteristic_polynomial(synthetic, hopper):
    for ldtp in (synthetic, hopper):
        r = len(ldtp.multipliers)
        coefficients = np.asarray(ldtp.characteristic_polynomial())
        expected = np.poly(ldtp.multipliers).real
        assert_allclose(coefficients[: r + 1], expected, rtol=0, atol=1e-13)
        assert_allclose(coefficients[r + 1 :], 0, atol=1e-13)


def test_factors_that_are_not_finite():
    for function in (product_eigenvalues, product_rank):
        with pytest.raises(
            hj.errors.ComputationError, match="1\\] holds NaN or infinity"
        ):
            unknown = np.full((2, 2), np.nan)
            function([np.eye(2), unknown], RTOL)


def test_multipliers_refuse_to_be_traced(synthetic):
    with pytest.raises(hj.errors.DefinitionError, match="works on the host"):
        jax.jit(lambda ldtp: ldtp.multipliers)(synthetic)
    with pytest.raises(hj.errors.DefinitionError, match="one LDTP at a time"):
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), synthetic)
        batch.rank()
