"""Numbers as a paper writes them."""


def p_value(p: float) -> str:
    """`p < 0.001`, `p = 0.03`, `p > 0.99`: no more digits than it deserves."""
    if p < 1e-3:
        return "p < 0.001"
    return "p > 0.99" if p > 0.99 else f"p = {p:.2g}"
