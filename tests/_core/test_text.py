"""What objects print."""

import pytest

from hybridjax._core.text import p_value


@pytest.mark.parametrize(
    ("p", "text"),
    [(0.0, "p < 0.001"), (4e-11, "p < 0.001"), (0.001, "p = 0.001"), (0.0314, "p = 0.031"),
     (0.5, "p = 0.5"), (0.98, "p = 0.98"), (0.997, "p > 0.99"), (1.0, "p > 0.99")],
)  # fmt: skip
def test_p_values(p, text):
    assert p_value(p) == text
