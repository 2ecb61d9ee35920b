"""`select_order`: the number of multipliers that HTFs or data support.

HTFs are compared in `identify/multipliers.py` (`compare_orders`), data on held-out cycles
(`held_out.py`). Only the largest numbers that are tried by default stand here: 5 for HTFs, 4 for
data. Larger: more time. Smaller: numbers above them are never selected.

If a selected number is wrong, look at `compare_orders` for HTFs, and at `_misfit` in `held_out.py`
for data. If the warning about numbers that were not tried is needless, look at
`Split.compare_orders` there.
"""

from typing import overload

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Index, Order
from .._core.findings import warn_of
from ..errors import DefinitionError
from ..experiments.record import HasRecords
from ..identify.multipliers import OrderSelection, compare_orders
from ..linear.htf import HTF
from .findings import untried_orders
from .held_out import HeldOutOrders, split


@overload
def select_order(
    data: HTF, max_order: Order | None = None, *, extra_lags: Index | None = None
) -> OrderSelection: ...
@overload
def select_order(data: HasRecords, max_order: Order | None = None) -> HeldOutOrders: ...
@checked
def select_order(
    data: HTF | HasRecords,
    max_order: Order | None = None,
    *,
    extra_lags: Index | None = None,
) -> OrderSelection | HeldOutOrders:
    r"""Compare numbers of multipliers.

    *HTFs, by rank*: the part of $H, z^{-N} H, \ldots, z^{-DN} H$ that numerators explain is
    removed. The rest has one independent component for each multiplier (D at most), and noise. The
    number of components is the number of generalized singular values above the largest one of noise
    alone. *HTFs, by MDL*: Rissanen's criterion for a fit of each order, with numerators of the
    degree that belongs to this order. Without variances, the residuals of the largest order are
    taken for noise. `max_order` must then be at least the number of multipliers, and errors that
    are not random (a transient, or distortion by an input that was not drawn at random) look like
    multipliers.

    *Data*: for each number, the model is estimated by total least squares (which is consistent)
    without the last quarter of every record (see `hj.recordings.hold_out`), and then simulates this
    part. At most the first 1000 cycles are used. If the data are too few to try a larger number, a
    warning gives the reason.

    **Arguments:**

    - `data`: HTFs, or data as for `fit_series`, of experiments or recordings.
    - `max_order`: the largest number. Default: 5 of HTFs, 4 of data.
    - `extra_lags`: as in `fit_multipliers`, for HTFs. Default: N.

    **Returns:** `hj.identify.OrderSelection` for HTFs, `hj.recordings.HeldOutOrders` for data. Its
    `order` is the selected number; `orders` (k,) are the compared numbers.

    **Raises:** `DefinitionError` for HTFs as `fit_multipliers`; for data with too few cycles for
    one multiplier.

    **Example:**

    ```python
    print(hj.select_order(htf))
    fit = hj.fit_multipliers(htf, hj.select_order(htf).order)
    ```

    **Before:** `hj.estimate_htf` or `hj.recordings.sample_sections`. **After:**
    `hj.fit_multipliers`, `hj.fit_series`.
    """
    if isinstance(data, HTF):
        return compare_orders(data, max_order or 5, extra_lags)
    if extra_lags is not None:
        raise DefinitionError("`extra_lags` is for HTFs: leave it out for data.")
    compared, obstacle = split(data).compare_orders(max_order or 4)
    warn_of(untried_orders(compared.order, obstacle))
    return compared
