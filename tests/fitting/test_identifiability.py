"""What cannot be seen is found, and said in words."""

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from hybridjax.fitting.model_fit import diagnose


def blind(rows, residuals=30, seed=0):
    """Sensitivities with a given null space."""
    rows = np.atleast_2d(np.asarray(rows, float))
    rng = np.random.default_rng(seed)
    S = rng.normal(size=(residuals, rows.shape[1]))
    return S - S @ np.linalg.pinv(rows) @ rows


@pytest.mark.parametrize(
    "rows, words",
    [
        ([[0, 0, 1, 0]], ["c"]),
        ([[1, 0, 0, 1]], ["a common factor of (a, d), only a/d"]),
        ([[1, 1, 0, 1]], ["a common factor of (a, b, d)"]),
        ([[0, 1, -1, 0]], ["b and c apart, only their product"]),
        ([[0, 1, -2, 0]], ["a common factor, with these powers, of (b, c^-2)"]),
        ([[1, 1, 1, 0], [0, 0, 0, 1]], ["a common factor of (a, b, c)", "d"]),
        (
            [[1, 1, 1, 1], [0, 0, 1, 1]],
            [
                "a common factor of (a, b), only a/b",
                "a common factor of (c, d), only c/d",
            ],
        ),
    ],
)
def test_directions_are_said_in_words(rows, words):
    found = diagnose(
        tuple("abcd"), blind(rows, 300_000)
    )  # (whose square no memory holds)
    assert found.rank == 4 - len(rows)
    assert not found.complete
    assert sorted(found.descriptions()) == sorted(words)
    for text in words:
        assert f"not identified: {text}" in repr(found)


@given(
    st.lists(
        st.lists(st.integers(-3, 3), min_size=5, max_size=5), min_size=1, max_size=3
    )
)
def test_the_basis_spans_what_is_not_seen(rows):
    rows = np.array(rows, float)
    sizes = np.linalg.svd(rows, compute_uv=False)
    assume(sizes[-1] > 1e-3)
    S = blind(rows)
    found = diagnose(tuple("abcde"), S)
    assert found.unseen.shape == rows.shape
    left = np.abs(S @ found.unseen.T).max()
    size = np.abs(S).max()
    assert left < 1e-2 * size
    assert np.linalg.matrix_rank(np.concatenate([rows, found.unseen]), tol=1e-2) == len(
        rows
    )
