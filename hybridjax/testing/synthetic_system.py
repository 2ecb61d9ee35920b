"""A made-up periodic system whose dimension varies, to try things on.

Tests of models, designs, fits and figures call `synthetic_ldtp`, and some rely on its numbers,
which must therefore stay. For another system, call `LDTP.from_blocks` with other matrices. If its
multipliers are not those of the docstring below, look at `LDTP.from_blocks` and at
`LDTP.multipliers` (`linear/ldtp.py`): here nothing is computed.
"""

import numpy as np

from ..linear.ldtp import LDTP


# The matrices of each section, in the order of the arguments of `LDTP.from_blocks`.
_BLOCKS = {
    "A": (
        ((0.5, -0.3, 0.2), (0.4, 0.6, -0.1)),
        ((0.7, 0.2), (-0.5, 0.8), (0.3, 0.1)),
        ((0.6, 0.1, -0.4), (-0.2, 0.9, 0.3)),
        ((0.8, -0.6), (0.5, 0.7), (-0.1, 0.4)),
        ((0.9, 0.2, 0.1), (-0.3, 0.7, 0.5)),
        ((1.1, -0.4), (0.3, 0.9), (0.2, -0.7)),
    ),
    "B": (
        ((1, 0), (0.5, -0.2)),
        ((0.3, 0.1), (0, 1), (-0.4, 0.2)),
        ((0.2, 0.6), (-1, 0.1)),
        ((0.5, 0), (0.1, -0.3), (0, 0.7)),
        ((-0.6, 0.4), (0.2, 0.8)),
        ((0, 0.5), (1, -0.1), (0.3, 0.2)),
    ),
    "C": (
        ((1, 0, 0), (0, 1, -1)),
        ((1, 0.5), (0, 1)),
        ((0, 1, 0.2), (1, 0, 0)),
        ((0.5, 1), (-1, 0)),
        ((1, 0, 0.3), (0.2, -1, 0)),
        ((0, 1), (1, 1)),
    ),
    "D": (
        ((0, 0), (0, 0)),
        ((0.1, 0), (0, 0)),
        ((0, 0), (0, -0.2)),
        ((0, 0), (0.3, 0)),
        ((0, 0), (0, 0)),
        ((0, 0.1), (0, 0)),
    ),
}


def synthetic_ldtp() -> LDTP:
    """Return an `LDTP` of 6 sections, two inputs and two outputs, with the dimensions 3, 2, 3, 2,
    3, 2.

    Its matrices are arbitrary, without a physical system and without symmetries that could hide an
    error. Its multipliers are 0.3270675 ± 0.05964059j; at the sections of dimension 3 there is a
    structural zero, too.

    **Returns:** `hj.linear.LDTP`, without units.

    **Raises:** nothing; there are no arguments.

    **Example:**

    ```python
    system = hj.testing.synthetic_ldtp()
    print(system.multipliers)
    ```

    **Before:** none. **After:** `hj.experiments.simulate_experiments`.
    """
    A, B, C, D = ([np.array(x, float) for x in blocks] for blocks in _BLOCKS.values())
    return LDTP.from_blocks(A, B, C, D)
