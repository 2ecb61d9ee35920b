"""What a file may declare. More is damage, or malice, and is refused before memory is taken."""

TEXT = 2**26
"""Bytes of a header or a manifest."""
COUNT = 10**6
"""Sections, periods, harmonics, experiments of a design, chunks: any whole number of a header."""
WINDOW = 2**26
"""Samples of one input in one window of a design."""


def unpacked(size: int) -> int:
    """Bytes that a packed file of `size` bytes may hold. Recorded signals are packed to a half or a
    twentieth, and only emptiness to a thousandth."""
    return 2**26 + 100 * size
