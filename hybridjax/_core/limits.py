"""How much one call may ask for, and how much a file may declare.

More is a typing error, a damaged file or an attack, and is refused in a sentence before memory is
taken. Smaller limits would refuse what a large computer can do. Read by the functions that take
counts, and by readers of files.
"""

COUNT = 10**9
"""Steps, and whatever has no limit below."""
SECTIONS = 10**5
"""Sections of a family."""
PERIODS = 10**7
"""Cycles, periods and samples in one record or experiment; experiments of a design; systems of a
sweep; any whole number in the header of a file."""
ORDER = 1000
"""Multipliers of a model; threads."""
WINDOW = 2**26
"""Samples of one input in one window of a design."""
RECORDED = 2**29
"""Samples of all signals of one trial, on one axis of time."""
NESTED = 64
"""Groups, structs or cells of a file, each within the one before."""
TEXT = 2**26
"""Bytes of a header or a manifest."""


def unpacked(size: int) -> int:
    """Return the bytes that a packed file of `size` bytes may hold. Recorded signals are packed to
    a half or a twentieth, and only emptiness to a thousandth."""
    return 2**26 + 100 * size
